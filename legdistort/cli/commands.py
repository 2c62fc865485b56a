"""What the commands do: a function for each, of the parsed command line, which returns the exit status if it is not 0.

The verbs are taken from the package itself, which loads each when it is called.
"""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import legdistort

from ..coaddition.mosaic import check_ending
from ..coaddition.options import CoaddOptions
from ..exceptions import InputError
from ..inputs import column_contract
from ..inputs.detector_files import warn_of_detectors
from ..inputs.star_lists.formats import stack
from ..inputs.table_files import named_after, names_of_images, records, shapes_for_match, write_stars
from ..results.check import WRONG, Check, worst
from ..runtime import outputs, parallel, provenance
from ..runtime.trees.codec import from_tree
from . import options
from .arguments import flagged, given, lines_of_images, wants_progress
from .given_files import (
    given_camera,
    given_plan,
    given_prior,
    given_solving,
    grid_in,
    known_file,
    read_lists,
    read_matches,
    refuse,
    stated_camera,
    without_options_of_prior,
)
from .repeating import again, repeatable
from .static_lists import asked_for, given_static, lists_of

#: What belongs to a reference.
_TYING = ("reference_error", "reference_degree", "epoch")
#: Size of frames from which further processes are worth their start, a second or two each.
_MANY_BYTES = 1 << 25


def do_demo(a):
    """``legdistort demo``."""
    from ..demo import run_demo
    from ..simulation.example_files import write_examples

    night = given(a, options.NIGHT)
    if kind := given(a, options.EXAMPLES):
        refuse({"small": a.small, "camera": a.camera}, "goes with a night that is solved, not with --as")
        written = write_examples(**kind, out=a.out, seed=a.seed or 0, overwrite=a.overwrite)
        _say(a, "\n".join(map(str, written)), {"files": [str(path) for path in written]})
        return
    workers = 1 if a.small else parallel.n_cores()
    result = run_demo(out=a.out, **night, workers=workers, overwrite=a.overwrite, progress=wants_progress(a))
    s = result.summary
    _report(a, result.solution, s)
    if not a.json:
        print(
            f"\nAgainst the truth of the simulation\n"
            f"  star positions, common cubic map removed   {s['b_px']:.4f} px  (bound {s['b_bound_px']:.4f})\n"
            f"  star positions, absolute                   {s['b_abs_px']:.4f} px  (reported {s['b_abs_err_px']:.4f})\n"
            f"  scatter of new positions                   {s['sigma_new_px']:.4f} px  "
            f"(expected {s['sigma_new_expected_px']:.4f})\n"
            f"  FWHM of stars in the mosaic                {s['fwhm_ratio']:.3f} x that of single frames\n"
            f"Results in {a.out}: open {Path(a.out) / 'report.html'}"
        )


def do_run(a):
    """``legdistort run``."""
    from .. import pipeline

    _refuse_ignored(a)
    measuring, matching, solving = (
        given(a, options.MEASURING),
        given(a, options.MATCHING),
        given_solving(a),
    )
    own = ("psf", "degree", "prior", "clip", "min_exposures", "reference", "pixel_scale", *_TYING)
    with pipeline.called_by(a.begun, repeatable(a), again(a)):
        result = legdistort.run(
            **given(a, options.RUN_FRAMES, options.FLAGGED, options.STOPPING, options.LEFT_OUT),
            out=a.out,
            **{name: group.pop(name) for group in (measuring, matching, solving) for name in own if name in group},
            measuring=measuring,
            matching=matching,
            solving=solving,
            camera=given_camera(a.camera),
            coadding=given(a, options.COADDING),
            **given(a, options.LAST_STEP),
            compare=a.compare,
            overwrite=a.overwrite,
            keep=a.keep,
            **_share(a),
        )
    _report(a, result.solution, result.summary)
    if a.compare and not a.json:
        print("\nScatter of corrected positions, mean and standard deviation over the stars, px per axis")
        for name, s in result.summary["comparison"].items():
            print(f"  {name:24s} {s['mean']:8.4f} {s['std']:8.4f}")
    if not a.json:
        print(f"Results in {a.out}: open {Path(a.out) / 'report.html'}")
    return _status(a, result.summary)


def do_measure(a):
    """``legdistort measure``."""
    from ..inputs.exposure_names import whole_name
    from ..measurement.earlier import write_detections
    from ..measurement.options import MeasureOptions

    measuring = given(a, options.MEASURING)
    asked = MeasureOptions(**measuring)  # which refuses them before a frame is read
    bad = {}
    exposures = _open(a, left_out=bad, stop_at_bad=a.stop_at_bad)
    table = legdistort.measure(exposures, **measuring, **given(a, options.PSF_FILES), **_share(a))
    shapes = {e.name: list(e.shape) for e in exposures}
    table.meta["left_out"] = bad
    reading = given(a, {"ext": options.FRAMES["ext"]}, options.FLAGGED)
    write_detections(a.out, table, exposures, a.out.parent, measuring=asked, **reading, overwrite=a.overwrite)
    whole, n = len({whole_name(each) for each in exposures}), len(exposures)
    images = f", {n} images" * (whole < n)
    _say(
        a,
        f"{len(table)} detections in {whole} exposure{'s' * (whole != 1)}{images}",
        {"n_detections": len(table), "shapes": shapes, "left_out": bad},
    )


def do_noise(a):
    """``legdistort noise``."""
    from ..measurement.noise_calibration import check_injection
    from ..measurement.options import MeasureOptions

    injecting, measuring = given(a, options.INJECTING), given(a, options.DETECTOR)
    check_injection(**injecting)  # before a frame is read
    MeasureOptions(**measuring)
    curves = legdistort.calibrate_noise(_open(a), **injecting, measuring=measuring, **_share(a))
    curves.write(a.out, overwrite=a.overwrite)
    _draw(curves, a)
    _say(a, curves, {"laws": records(curves.laws), "out": str(a.out)})


def do_match(a):
    """``legdistort match``."""
    if a.camera:
        refuse({"shape": a.shape}, "comes from --camera")
    from ..inputs.wcs_files import open_wcs
    from ..measurement.earlier import measured_frames
    from ..pipeline import timed, write_matched

    contract = column_contract.DETECTED | {name: column_contract.MATCHED[name] for name in ("epoch", "block")}
    read = read_lists(a, contract)
    camera = given_camera(a.camera) or _measured_with(read.values())
    if a.wcs is None:
        refuse({"ext": a.ext} | given(a, options.FLAGGED), "is for the frames of --wcs")
        exposures = None
    else:
        reading = given(a, {"ext": options.WCS_OF_TABLES["ext"]}, options.FLAGGED)
        exposures = open_wcs(a.wcs, **reading, shape=a.shape and tuple(a.shape))
        exposures = camera.of_detectors(exposures) if camera else exposures  # a list has the detector of its frame
        read = {path: named_after(table, exposures, path) for path, table in read.items()}
    tables = list(read.values())
    if not any(map(len, tables)):
        column_contract.check(tables[0], contract, str(a.tables[0]))
    names = names_of_images(read)
    shapes = {name: shape for each in tables for name, shape in each.meta.get("shapes", {}).items()}
    if camera:
        refuse({"shape": a.shape}, "comes from the camera of the run")
    given_shape = tuple(a.shape) if a.shape and a.wcs is None else shapes_for_match(tables, shapes)
    if exposures is None and (exposures := measured_frames(read)) is not None:
        refuse({"shape": a.shape}, "comes from the frames")
    elif exposures is None and camera is None:
        warn_of_detectors(tables)
    known = {"shape": given_shape, "camera": camera, "exposures": exposures, "progress": wants_progress(a)}
    with timed({}, "match"):
        matches = legdistort.match(stack(tables), **known, **given(a, options.MATCHING))
    seen = {*names, *(name for table in tables for name in table["exposure"])}
    empty = {name: "no star was detected in it" for name in shapes if name not in seen}
    bad = {name: reason for each in tables for name, reason in (each.meta.get("left_out") or {}).items()}
    bad = {name: reason for name, reason in bad.items() if name not in seen}
    matches = replace(matches, left_out=bad | matches.left_out | empty)
    inputs = {name: checksum for each in tables for name, checksum in each.meta["inputs"].items()}
    write_matched(a.out, matches, inputs, overwrite=a.overwrite)
    figures = {"n_exposures": len(matches.names), "n_stars": len(matches.stars), "n_observations": len(matches.table)}
    _say(a, repr(matches)[1:-1], figures | {"left_out": matches.left_out})


def do_solve(a):
    """``legdistort solve``."""
    from ..pipeline import (
        RESULTS,
        SOLVED,
        check_results,
        linked_files,
        timed,
        write_results,
    )
    from ..reporting.page import write_report
    from ..reporting.summary import summarise

    check_results(a.out, a.overwrite)
    _refuse_ignored(a)
    # a mosaic there does not belong to this solution
    with outputs.replacing_folder(a.out, results=RESULTS, keep=a.keep) as target:
        check_results(a.out, a.overwrite)  # again: nobody else writes there any more
        matches, inputs = read_matches(a)
        with timed({}, "solve"):
            asked = given(a, options.BASE) | given_solving(a, matches)
            solution = legdistort.solve(matches, **asked, progress=wants_progress(a))
        solution = provenance.with_inputs(solution, inputs)
        with timed({}, "assess"):
            summary = summarise(solution)
        with timed({}, "write"):
            write_results(solution, target, progress=wants_progress(a))
        files = linked_files((*SOLVED, "summary.json"))
        write_report(target / "report.html", solution, summary=summary, files=files)
        outputs.write_summary(target / "summary.json", summary := summary | outputs.listed_files(target))
    _report(a, solution, summary)
    return _status(a, summary)


def do_prior(a):
    """``legdistort prior``."""
    from ..priors.maps import errors_of, map_paths

    prior, of_several = given_prior(a)
    prior.write(a.out, overwrite=a.overwrite)
    rms_x, rms_y = rms = prior.rms.tolist()
    figures = {"degree": prior.degree, "truncation_px": prior.truncation, "rms_px": rms}
    figures |= {"shape": prior.shape, "source": prior.source}
    words = f"degree {prior.degree}{' and a table' * (prior.table is not None)}, truncation error"
    words += f" {prior.truncation:.2g} px; the distortion is {rms_x:.3g} px rms in x, {rms_y:.3g} in y"
    if (told := (prior.source if isinstance(prior.source, dict) else {}).get("common_map_px")) is not None:
        words += f", with the map of the focal plane that a reference told ({told:.3g} px rms per axis)"
    errors = ""
    if str(a.out).lower().endswith(".fits") and map_paths(a.out)[2].exists():
        figures["errors_of"], errors = errors_of(prior)
    _say(a, "; ".join(filter(None, [words, of_several, errors, str(a.out)])), figures)


def do_coadd(a):
    """``legdistort coadd``."""
    check_ending(a.out)
    _refuse_drops(a)
    solution = _solution(a)
    coadding = {"method": "clipped"} | given(a, options.COADDING) | {"grid": grid_in(a.grid, solution)}
    CoaddOptions(**coadding)  # which refuses them before a frame is read
    mosaic = legdistort.coadd(_open(a), solution, **coadding, **_share(a))
    mosaic.write(a.out, overwrite=a.overwrite)
    counts = {"n_exposures": mosaic.n_exposures, "n_images": len(mosaic.exposures)}
    figures = {"shape": list(mosaic.shape)} | counts | {"left_out": mosaic.left_out}
    _say(a, f"{mosaic!r}"[1:-1] + f" in {a.out}", figures)


def do_catalogue(a):
    """``legdistort catalogue``."""
    from ..photometry.catalogue import photometry_path

    outputs.check_file(photometry_path(a.out), overwrite=a.overwrite)
    if a.artificial is None:
        refuse({"seed": a.seed}, "is for the stars of --artificial")
    found = _catalogue(a, options.CATALOGUING, options.ARTIFICIAL)
    found.write(a.out, overwrite=a.overwrite)
    _say(a, f"{found}\n{a.out} and {photometry_path(a.out)}", found.stars.meta | {"left_out": dict(found.left_out)})


def do_completeness(a):
    """``legdistort completeness``."""
    from ..photometry.artificial_stars import table_paths

    for path in table_paths(a.out):
        outputs.check_file(path, overwrite=a.overwrite)
    found = _catalogue(a, options.COMPLETENESS).completeness
    found.write(a.out, overwrite=a.overwrite)
    _say(a, f"{found}\n{' and '.join(map(str, table_paths(a.out)))}", found.by_flux.meta)


def _catalogue(a, *groups):
    from ..measurement.options import MeasureOptions

    cataloguing = given(a, *groups)
    MeasureOptions(**{name: value for name, value in cataloguing.items() if name in options.MEASURING})
    return legdistort.catalogue(_open(a), _solution(a), **cataloguing, progress=wants_progress(a))


def do_attach(a):
    """``legdistort attach``."""
    from ..wcs.attachment import attach

    keywords = given(a, options.FRAMES, options.ATTACHING)
    tpv, head, asdf_only = (keywords.pop(name) for name in ("tpv", "head", "asdf_only"))
    if asdf_only:
        refuse({"max_error": a.max_error}, "is of the header, which --asdf-only leaves alone")
    kind = None if asdf_only else "head" if head else "tpv" if tpv else "sip"
    done = attach(_solution(a), **keywords, kind=kind, progress=wants_progress(a))
    errors = {item.exposure: {"path": str(item.path)} | item.errors for item in done}
    _say(a, "\n".join(lines_of_images(a, done)), errors)


def do_predict(a):
    """``legdistort predict``."""
    from ..simulation.prediction_text import describe_plans

    prediction = legdistort.predict(**given_plan(a))
    _draw(prediction, a)
    if a.plot_errors is not None:
        _write_picture(prediction.plot_errors().figure, a, a.plot_errors)
    plans = prediction.alternatives()
    own, *others = records(plans)
    own |= {"unknown": list(prediction.solution.gauge.unknown_names), "alternatives": others}
    own |= {"by_magnitude": records(prediction.by_magnitude())} if a.instrument else {}
    _say(a, f"{prediction}\n\n{describe_plans(plans)}", own | {"failed": plans.meta["failed"]})


def do_simulate(a):
    """``legdistort simulate``."""
    from ..simulation.pupil import PupilPSF

    if Path(a.out, "truth.ecsv").exists() and not a.overwrite:
        raise InputError(f"{a.out} already holds a simulated night; give --overwrite or another folder")
    optics = {"psf": PupilPSF(**optics)} if (optics := given(a, options.OPTICS)) else {}
    moving = given(a, options.MOVING)
    if "epochs" in moving:
        moving["n_exposures"] = len(moving["epochs"])
    night = legdistort.simulate_exposures(**given(a, options.NIGHT), **moving, **optics, progress=wants_progress(a))
    with outputs.replacing_folder(a.out, overwrite=a.overwrite) as target:
        paths = night.write(target)
    _say(a, f"{len(paths)} frames and truth.ecsv in {a.out}", {"frames": [path.name for path in paths]})


def do_show(a):
    """``legdistort show``."""
    from ..inputs.exposure_files import read_exposures
    from ..reporting.summary import summarise
    from ..runtime.fits_bytes import looks_like_fits

    if looks_like_fits(a.solution):
        refuse({"max_bytes": a.max_bytes, "strict": a.strict}, "is for a solution")
        exposures = read_exposures(str(a.solution), **given(a, {"ext": options.FRAMES["ext"]}, options.FLAGGED))
        stated = {exposure.name: exposure.stated for exposure in exposures}
        several = len(stated) > 1
        texts = [f"{name}\n{each}" if several else str(each) for name, each in stated.items()]
        _say(a, "\n\n".join(texts), {name: each.to_dict() for name, each in stated.items()})
        return 0
    refuse({"ext": a.ext, "dq_good": a.dq_good, "weight_maps": a.weight_maps}, "is for a frame")
    if (known := known_file(a.solution)) is not None:
        refuse({"max_bytes": a.max_bytes, "strict": a.strict}, "is for a solution")
        _say(a, known, known.to_dict())
        return 0
    solution = _solution(a)
    summary = summarise(solution)
    _report(a, solution, summary)
    return _status(a, summary)


def do_nights(a):
    """``legdistort nights``."""
    words = given(a, options.NIGHTS) | {"results": [each.rstrip("/") or each for each in a.results]}
    words["progress"] = wants_progress(a)
    found = legdistort.combine_nights(**words, workers=a.workers or min(parallel.n_cores(), len(a.results)))
    picture = _picture(found, a)  # refused before the camera is written
    found.write(a.out, date=a.date, value=a.value, overwrite=a.overwrite)
    _write_picture(picture, a)
    at = asked_for(found, a)
    at = f"\n\nThe camera in {a.out} is that of {at}." if at else ""
    figures, inside = found.to_dict(a.date, a.value), _nights_inside(found, a.results)
    if inside is not None:
        figures["nights_solved_together"] = records(inside)
        at = f"\n\nThe nights that were solved together, the worst first; departure: length of both axes:\n{inside}{at}"
    _say(a, f"{found}{at}", figures)
    return 3 if a.strict and found.odd else 0


def _nights_inside(found, results):
    """The nights of one solution of several, which count as one row of a combination; None of anything else."""
    alone = len(results) == len(found.nights) == 1 and found.nights[0].nightly is not None
    if not alone or known_file(results[0]) is not None:
        return None
    return legdistort.Solution.read(results[0]).nights


def do_difference(a):
    """``legdistort difference``."""
    with without_options_of_prior(a):
        found = legdistort.difference(a.first, a.second, **given(a, options.COMPARED))
    _draw(found, a)
    _say(a, found, found.to_dict())
    return 3 if a.strict and found.agrees is False else 0


def do_stars(a):
    """``legdistort stars``."""
    solution = _solution(a)
    write_stars(solution, a.out, epoch=a.epoch, overwrite=a.overwrite)
    n_stars = len(solution.estimate.star_names)
    _say(a, f"{n_stars} stars in {a.out}", {"n_stars": n_stars, "out": str(a.out)})


def do_camera(a):
    """``legdistort camera``."""
    camera, unsettled = stated_camera(a)
    camera.write(a.out, overwrite=a.overwrite)
    _say(a, f"{camera!r}"[1:-1] + f" in {a.out}{unsettled}", camera.to_dict())


def do_correct(a):
    """``legdistort correct``."""
    from ..inputs.table_files import write_by_ending

    if (static := given_static(a.solution, a)) is not None:
        refuse({"epoch": a.epoch, "max_bytes": a.max_bytes}, "is for a solution")
        table, said, figures = static.corrected(a)
    else:
        solution, said, figures = _solution(a), "", {}
        table = solution.correct_table(lists_of(solution, a), epoch=a.epoch)
    write_by_ending(table, a.out, overwrite=a.overwrite)
    _say(a, f"{len(table)} positions in {a.out}{said}", {"n_positions": len(table), "out": str(a.out)} | figures)


def do_report(a):
    """``legdistort report``."""
    from ..reporting.page import write_report
    from ..reporting.summary import summarise

    solution = _solution(a)
    write_report(a.out, solution, summary=summarise(solution), overwrite=a.overwrite)
    _say(a, f"report in {a.out}", {"out": str(a.out)})


# -- pieces of commands


def _report(a, solution, summary):
    """Print a solution with its checks, those of a run included."""
    if a.json:
        print(json.dumps(summary, indent=1))
        for check in _checks(summary):
            if check.state in WRONG:
                print(check, file=sys.stderr)
    else:
        print(replace(solution, estimate=replace(solution.estimate, checked=_checks(summary))))


def _checks(summary):
    """Those of a summary."""
    return from_tree(tuple[Check, ...], summary["checks"], "checks")


def _refuse_ignored(a):
    """Options of `run` and `solve` that others leave without effect."""
    if a.reference is None:
        tying = {name: getattr(a, name) for name in _TYING}
        refuse(tying, "is for the catalogue of --reference")
    if a.command == "run":
        _refuse_drops(a)
        if not a.no_mosaic:
            coadding = {dest: getattr(a, dest) for _, _, dest, _ in flagged([options.COADDING]) if dest != "scratch"}
            refuse(coadding | {"no_match_background": None}, "is for a mosaic, and --no-mosaic wants none")


def _refuse_drops(a):
    """Options of one way of resampling with another."""
    if a.algorithm != "drizzle":
        refuse({"pixfrac": a.pixfrac, "kernel": a.kernel}, "is for --algorithm drizzle")
    if a.algorithm not in (None, "interp"):
        refuse({"order": a.order}, "is for --algorithm interp")


def _status(a, summary):
    """Exit status 3 where a check fails and `--strict` asks for it."""
    return 3 if a.strict and worst(_checks(summary)) == "fail" else 0


def _say(a, sentence, figures):
    print(json.dumps(figures, indent=1) if a.json else sentence)


def _share(a):
    """Who works on the frames: all cores, unless another number is given or the frames are few and small."""
    workers = a.workers
    if workers is None:
        size = sum(os.path.getsize(path) for path in a.frames if os.path.isfile(path))
        workers = parallel.n_cores() if size >= _MANY_BYTES or not a.frames else 1
    return {"workers": workers, "progress": wants_progress(a)}


def _open(a, **reading):
    if "workers" in a:
        parallel.check_workers(a.workers)
    return legdistort.open_exposures(**given(a, options.FRAMES, options.FLAGGED), **reading, progress=wants_progress(a))


def _measured_with(tables):
    """The camera that a run was given which left these tables; None if it was given none."""
    metas = [each.meta["camera"] for each in tables if each.meta.get("camera") is not None]
    if any(meta != metas[0] for meta in metas):
        raise InputError("the tables come from runs with different cameras: give the one that holds, --camera")
    return legdistort.Camera.from_meta(metas[0]) if metas else None


def _solution(a):
    return legdistort.Solution.read(a.solution, max_bytes=a.max_bytes)


def _picture(result, a):
    """The picture of a result, if it is asked for, not written yet."""
    return None if a.plot is None else result.plot().figure


def _draw(result, a):
    """Draw and write the picture of a result, if it is asked for."""
    _write_picture(_picture(result, a), a)


def _write_picture(figure, a, path=None):
    """Write a picture, if there is one, to the file of ``--plot`` or another."""
    if figure is not None:
        path = a.plot if path is None else path
        with outputs.replacing(path, overwrite=a.overwrite) as file:
            figure.savefig(file, format=path.suffix[1:].lower(), dpi=120)
