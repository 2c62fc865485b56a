"""What the commands do: one function a command, its argument the parsed command line."""

import json
import sys
from dataclasses import replace
from pathlib import Path

from ..exceptions import InputError

#: Arguments of `measure` by which it knows the detector.
_DETECTOR = ("threshold", "gain", "read_noise", "saturation")


def wants_progress(a):
    """Whether progress bars are shown: on a terminal, unless told to be quiet."""
    return not a.quiet and sys.stderr.isatty()


def do_demo(a):
    """``legdistort demo``."""
    from ..demo import run_demo

    result = run_demo(out=a.out, small=a.small, seed=a.seed, overwrite=a.overwrite, progress=wants_progress(a))
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
    from ..pipeline import run

    result = run(
        a.frames,
        out=a.out,
        ext=_extension(a.ext),
        degree=a.degree,
        prior=_prior_with_sigma(a),
        min_exposures=a.min_exposures,
        clip=_clip(a, 5.0),
        **_tying(a),
        measuring=_given(a, "fwhm", "profile", "blends", *_DETECTOR) | {"errors": a.position_errors},
        matching=_given(a, "isolation"),
        solving=_solving(a),
        coadding=_coadding(a),
        compare=a.compare,
        overwrite=a.overwrite,
        workers=a.workers,
        progress=wants_progress(a),
    )
    _report(a, result.solution, result.summary)
    if a.compare and not a.json:
        print("\nScatter of corrected positions, mean and standard deviation over the stars, px per axis")
        for name, s in result.summary["comparison"].items():
            print(f"  {name:24s} {s['mean']:8.4f} {s['std']:8.4f}")
    if not a.json:
        print(f"Results in {a.out}: open {Path(a.out) / 'report.html'}")


def do_measure(a):
    """``legdistort measure``."""
    from ..inputs.exposure_files import open_exposures
    from ..inputs.exposures import expand_paths
    from ..measurement.positions import measure
    from ..runtime.provenance import checksums

    exposures = open_exposures(a.frames, ext=_extension(a.ext), progress=wants_progress(a))
    given = _given(a, "fwhm", "profile", "blends", *_DETECTOR) | {"errors": a.position_errors}
    table = measure(exposures, workers=a.workers, progress=wants_progress(a), **given)
    shapes = {e.name: list(e.shape) for e in exposures}
    table.meta |= {"shapes": shapes, "inputs": checksums(expand_paths(a.frames))}
    _write_table(table, a)
    _say(a, f"{len(table)} detections in {len(exposures)} exposures", {"n_detections": len(table), "shapes": shapes})


def do_noise(a):
    """``legdistort noise``."""
    from ..inputs.exposure_files import open_exposures
    from ..measurement.noise_calibration import calibrate_noise
    from ..runtime.outputs import replacing

    curves = calibrate_noise(
        open_exposures(a.frames, ext=_extension(a.ext), progress=wants_progress(a)),
        **_given(a, "fluxes", "fwhm", "n_positions", "seed"),
        measuring=_given(a, *_DETECTOR),
        workers=a.workers,
        progress=wants_progress(a),
    )
    curves.write(a.out, overwrite=a.overwrite)
    if a.plot is not None:
        with replacing(a.plot, overwrite=a.overwrite) as file:
            curves.plot().figure.savefig(file, format="png", dpi=120)
    laws = [dict(zip(curves.laws.colnames, row, strict=True)) for row in curves.laws.as_array().tolist()]
    laws = [{key: value if value == value else None for key, value in law.items()} for law in laws]  # no NaN in JSON
    _say(a, curves, {"laws": laws, "out": str(a.out)})


def do_match(a):
    """``legdistort match``."""
    from ..inputs.table_files import stack
    from ..matching.matcher import match

    tables = [_read_table(path, a) for path in a.tables]
    names = [name for table in tables for name in set(table["exposure"])]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"exposure {twice} comes from two tables; rename a file, or give a column exposure")
    table = stack(tables)
    shapes = {name: shape for each in tables for name, shape in each.meta.get("shapes", {}).items()}
    matches = match(table, shape=tuple(a.shape) if a.shape else shapes or None, min_exposures=a.min_exposures,
                    **_given(a, "isolation"))  # fmt: skip
    empty = {name: "no star was detected in it" for name in shapes if name not in names}
    matches = replace(matches, left_out=matches.left_out | empty)
    out = matches.table.copy()
    inputs = {name: checksum for each in tables for name, checksum in each.meta["inputs"].items()}
    out.meta = matches.to_meta() | {"inputs": inputs}
    _write_table(out, a)
    figures = {"n_exposures": len(matches.names), "n_stars": len(matches.stars), "n_observations": len(out)}
    _say(a, repr(matches)[1:-1], figures | {"left_out": matches.left_out})


def do_solve(a):
    """``legdistort solve``."""
    from ..inputs.matches import Matches
    from ..pipeline import check_folder, summarise, write_results, write_summary
    from ..reporting.page import write_report
    from ..runtime.outputs import replacing_folder
    from ..runtime.provenance import with_inputs
    from ..solving.estimation import solve

    check_folder(a.out, a.overwrite)
    table = _read_table(a.table, a)
    shape = tuple(a.shape) if a.shape else table.meta.get("shapes")
    if shape is None:
        raise InputError(f"{a.table} does not say how large the detectors are: give --shape NY NX")
    matches = Matches.from_table(table, shape=shape, **Matches.read_meta(table.meta))
    solution = solve(matches, degree=a.degree, prior=_prior_with_sigma(a, a.shape), clip=_clip(a, None),
                     **_tying(a), **_solving(a))  # fmt: skip
    solution = with_inputs(solution, table.meta["inputs"])
    summary = summarise(solution)
    with replacing_folder(a.out) as target:
        write_results(solution, target)
        write_report(target / "report.html", solution, summary=summary)
        write_summary(target / "summary.json", summary)
    (a.out / "mosaic.fits").unlink(missing_ok=True)  # of an earlier run: it does not belong to this solution
    _report(a, solution, summary)


def do_prior(a):
    """``legdistort prior``."""
    from ..priors.prior import Prior

    prior = Prior.from_file(
        a.sources,
        ext=_extension(a.ext),
        frame=a.frame,
        shape=a.shape,
        degree=a.degree,
        direction=a.direction,
        origin=a.origin,
        sigma=a.sigma,
        static_sigma=a.static_sigma,
    )
    prior.write(a.out, overwrite=a.overwrite)
    rms_x, rms_y = map(float, prior.rms)
    figures = {"degree": prior.degree, "truncation_px": prior.truncation, "rms_px": [rms_x, rms_y]}
    figures |= {"shape": prior.shape, "source": prior.source}
    words = f"degree {prior.degree}, truncation error {prior.truncation:.2g} px"
    _say(a, f"{words}; the distortion is {rms_x:.3g} px rms in x, {rms_y:.3g} in y; {a.out}", figures)


def _coadding(a):
    return _given(a, "order", "algorithm", "pixfrac", "kernel", "extrapolated", "conserve", "scratch") | {
        "method": a.combine,
        "match_background": not a.no_match_background,
        "weights": None if a.weights == "equal" else a.weights,
        "scale": None if a.scale == "none" else a.scale,
    }


def do_coadd(a):
    """``legdistort coadd``."""
    from ..coaddition.mosaic import check_ending
    from ..coaddition.mosaicking import coadd
    from ..inputs.exposure_files import open_exposures

    check_ending(a.out)
    solution = _solution(a)
    grid = _grid(a.grid, solution)
    exposures = open_exposures(a.frames, ext=_extension(a.ext), progress=wants_progress(a))
    share = {"workers": a.workers, "progress": wants_progress(a)}
    mosaic = coadd(exposures, solution, grid=grid, **_coadding(a), **share)
    mosaic.write(a.out, overwrite=a.overwrite)
    figures = {"shape": list(mosaic.shape), "n_exposures": len(mosaic.exposures), "left_out": mosaic.left_out}
    _say(a, f"{mosaic!r}"[1:-1] + f" in {a.out}", figures)


def do_attach(a):
    """``legdistort attach``."""
    from ..wcs.attachment import attach

    done = attach(
        _solution(a),
        a.frames,
        out=a.out,
        in_place=a.in_place,
        kind=None if a.asdf_only else "tpv" if a.tpv else "sip",
        max_error=a.max_error,
        ext=_extension(a.ext),
        overwrite=a.overwrite,
        progress=wants_progress(a),
    )
    errors = {item.exposure: {"path": str(item.path)} | item.errors for item in done}
    _say(a, "\n".join(repr(item)[1:-1].partition(": ")[2] for item in done), errors)


def do_predict(a):
    """``legdistort predict``."""
    from ..runtime.outputs import replacing
    from ..simulation.prediction import predict, show

    prediction = predict(
        n_exposures=a.n_exposures,
        stars=None if a.stars is None else _read_table(a.stars, a),
        n_stars=a.n_stars,
        density=a.density,
        sigma=a.sigma,
        degree=a.degree,
        shape=tuple(a.shape or (2048, 2048)),
        dithers=a.dither,
        prior=_prior(a.prior, a.shape, a.static_sigma),
        gauge=a.gauge,
        dynamic=a.dynamic,
        spectrum=a.spectrum,
        seed=a.seed,
    )
    if a.plot is not None:
        with replacing(a.plot, overwrite=a.overwrite) as file:
            prediction.plot().figure.savefig(file, format="png", dpi=120)
    plans = prediction.alternatives()
    rows = [dict(zip(plans.colnames, row, strict=True)) for row in plans.as_array().tolist()]
    own, *others = ({key: None if value != value else value for key, value in row.items()} for row in rows)  # no NaN
    own |= {"unknown": list(prediction.solution.gauge.unknown_names), "alternatives": others}
    _say(a, f"{prediction}\n\n{show(plans)}", own | {"failed": plans.meta["failed"]})


def do_simulate(a):
    """``legdistort simulate``."""
    from ..runtime.outputs import replacing_folder
    from ..simulation.observations import simulate_exposures

    if Path(a.out, "truth.ecsv").exists() and not a.overwrite:
        raise InputError(f"{a.out} already holds a simulated night; give --overwrite or another folder")
    night = simulate_exposures(small=a.small, seed=a.seed, progress=wants_progress(a))
    with replacing_folder(a.out) as target:
        paths = night.write(target)
    _say(a, f"{len(paths)} frames and truth.ecsv in {a.out}", {"frames": [path.name for path in paths]})


def do_show(a):
    """``legdistort show``."""
    from ..pipeline import summarise

    solution = _solution(a)
    _report(a, solution, summarise(solution))


def do_stars(a):
    """``legdistort stars``."""
    from ..inputs.table_files import write_stars

    solution = _solution(a)
    write_stars(solution, a.out, overwrite=a.overwrite)
    _say(a, f"{len(solution.star_names)} stars in {a.out}", {"n_stars": len(solution.star_names), "out": str(a.out)})


def do_correct(a):
    """``legdistort correct``."""
    from ..inputs.table_files import write_by_ending

    table = _solution(a).correct_table(_read_table(a.table, a))
    write_by_ending(table, a.out, overwrite=a.overwrite)
    _say(a, f"{len(table)} positions in {a.out}", {"n_positions": len(table), "out": str(a.out)})


def do_report(a):
    """``legdistort report``."""
    from ..pipeline import summarise
    from ..reporting.page import write_report

    solution = _solution(a)
    write_report(a.out, solution, summary=summarise(solution), overwrite=a.overwrite)
    _say(a, f"report in {a.out}", {"out": str(a.out)})


# -- pieces of commands


def _report(a, solution, summary):
    print(json.dumps(summary, indent=1) if a.json else solution)


def _say(a, sentence, figures):
    print(json.dumps(figures, indent=1) if a.json else sentence)


def _given(a, *names):
    """Those of the arguments that were given."""
    return {name: value for name in names if (value := getattr(a, name)) is not None}


def _extension(text):
    if text is None:
        return None
    name, comma, number = text.partition(",")
    if comma and number.isdigit():
        return name, int(number)
    return int(text) if text.isdigit() else text


def _clip(a, default):
    """The limit asked for, 0 for none; the published scheme has no clipping by default."""
    if a.clip is None:
        return None if a.method == "alternating" else default
    return a.clip or None


def _solving(a):
    names = ("static", "exposure_degree", "gauge", "method", "loss", "error_floor", "errors", "validate")
    return {name: getattr(a, name) for name in names}


def _tying(a):
    return {"reference": a.reference, "epoch": a.epoch, "pixel_scale": a.pixel_scale}


def _prior_with_sigma(a, shape=None):
    """The prior asked for, with the widths asked for at every degree fitted.

    A scatter of exposures alone is one around no distortion.
    """
    from ..priors.prior import EVIDENCE, Prior
    from ..solving.choices.degree_choice import AUTO, HIGHEST

    prior = _prior(a.prior, shape, a.static_sigma)
    if a.prior_sigma is None:
        return prior
    degree = 0 if a.prior_sigma == EVIDENCE else HIGHEST if a.degree == AUTO else a.degree
    return (prior or Prior([[0.0], [0.0]])).with_sigma(a.prior_sigma, degree=degree)


def _prior(text, shape, static_sigma):
    """Whatever `Prior.from_file` recognises; without a text, a distortion of which the size alone is known."""
    from ..priors.prior import Prior

    if text is None:
        return None if static_sigma is None else Prior(None, static_sigma=static_sigma)
    return Prior.from_file(text, shape=shape, static_sigma=static_sigma)


def _read_table(path, a):
    from ..inputs.table_files import read_table

    return read_table(path, columns=dict(a.columns), origin=a.origin)


def _solution(a):
    from ..results.solution import Solution

    return Solution.read(a.solution, max_bytes=a.max_bytes)


def _grid(path, solution):
    """The grid of a file, known to be one for the solution before any frame is read."""
    from ..coaddition.grids import given_grid, read_grid

    if path is None:
        return None
    grid = read_grid(path)
    try:
        given_grid(grid, solution)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return grid


def _write_table(table, a):
    from ..inputs.table_files import write_table

    write_table(table, a.out, overwrite=a.overwrite)
