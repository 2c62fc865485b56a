"""What the commands do: one function a command, its argument the parsed command line."""

import json
import sys
from dataclasses import replace
from pathlib import Path

from .exceptions import InputError


def wants_progress(a):
    """Whether progress bars are shown: on a terminal, unless told to be quiet."""
    return not a.quiet and sys.stderr.isatty()


def do_demo(a):
    """``legdistort demo``."""
    from .demo import run_demo

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
    from .pipeline import run

    measuring = {key: getattr(a, key) for key in ("fwhm", "threshold", "gain", "read_noise", "saturation")}
    result = run(
        a.frames,
        out=a.out,
        ext=_extension(a.ext),
        degree=a.degree,
        prior=_prior(a.prior),
        min_exposures=a.min_exposures,
        clip=_clip(a, 5.0),
        measuring={key: value for key, value in measuring.items() if value is not None},
        solving=_solving(a),
        coadding={"method": a.combine, "order": a.order},
        overwrite=a.overwrite,
        progress=wants_progress(a),
    )
    _report(a, result.solution, result.summary)
    if not a.json:
        print(f"Results in {a.out}: open {Path(a.out) / 'report.html'}")


def do_measure(a):
    """``legdistort measure``."""
    from .exposures import read_exposures
    from .measurement import measure

    given = {key: getattr(a, key) for key in ("fwhm", "threshold", "gain", "read_noise", "saturation")}
    exposures = read_exposures(a.frames, ext=_extension(a.ext), progress=wants_progress(a))
    table = measure(exposures, progress=wants_progress(a), **{k: v for k, v in given.items() if v is not None})
    shapes = {e.name: list(e.shape) for e in exposures}
    table.meta["shapes"] = shapes
    _write_table(table, a)
    _say(a, f"{len(table)} detections in {len(exposures)} exposures", {"n_detections": len(table), "shapes": shapes})


def do_match(a):
    """``legdistort match``."""
    from astropy.table import vstack

    from .matching import match

    tables = [_read_table(path, a) for path in a.tables]
    names = [name for table in tables for name in set(table["exposure"])]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"exposure {twice} comes from two tables; rename a file, or give a column exposure")
    table = vstack(tables, metadata_conflicts="silent")
    shapes = {name: shape for each in tables for name, shape in each.meta.get("shapes", {}).items()}
    matches = match(table, shape=tuple(a.shape) if a.shape else shapes or None, min_exposures=a.min_exposures)
    empty = {name: "no star was detected in it" for name in shapes if name not in names}
    matches = replace(matches, left_out=matches.left_out | empty)
    out = matches.table.copy()
    out.meta = matches.to_meta()
    _write_table(out, a)
    figures = {"n_exposures": len(matches.names), "n_stars": len(matches.stars), "n_observations": len(out)}
    _say(a, repr(matches)[1:-1], figures | {"left_out": matches.left_out})


def do_solve(a):
    """``legdistort solve``."""
    from .estimation import solve
    from .files import replacing_folder
    from .matches import Matches
    from .pipeline import check_folder, summarise, write_results, write_summary
    from .report import write_report

    check_folder(a.out, a.overwrite)
    table = _read_table(a.table, a)
    shape = tuple(a.shape) if a.shape else table.meta.get("shapes")
    if shape is None:
        raise InputError(f"{a.table} does not say how large the detectors are: give --shape NY NX")
    matches = Matches.from_table(table, shape=shape, **Matches.read_meta(table.meta))
    solution = solve(matches, degree=a.degree, prior=_prior(a.prior), clip=_clip(a, None), **_solving(a))
    summary = summarise(solution)
    with replacing_folder(a.out) as target:
        write_results(solution, target)
        write_report(target / "report.html", solution, summary=summary)
        write_summary(target / "summary.json", summary)
    (a.out / "mosaic.fits").unlink(missing_ok=True)  # of an earlier run: it does not belong to this solution
    _report(a, solution, summary)


def do_coadd(a):
    """``legdistort coadd``."""
    from .coaddition import coadd
    from .exposures import read_exposures
    from .solution import Solution

    solution = Solution.read(a.solution)
    exposures = read_exposures(a.frames, ext=_extension(a.ext), progress=wants_progress(a))
    mosaic = coadd(exposures, solution, method=a.combine, order=a.order, progress=wants_progress(a))
    mosaic.write(a.out, overwrite=a.overwrite)
    figures = {"shape": list(mosaic.shape), "n_exposures": len(mosaic.exposures), "left_out": mosaic.left_out}
    _say(a, f"{mosaic!r}"[1:-1] + f" in {a.out}", figures)


def do_simulate(a):
    """``legdistort simulate``."""
    from .files import replacing_folder
    from .simulation import simulate_exposures

    if Path(a.out, "truth.ecsv").exists() and not a.overwrite:
        raise InputError(f"{a.out} already holds a simulated night; give --overwrite or another folder")
    night = simulate_exposures(small=a.small, seed=a.seed, progress=wants_progress(a))
    with replacing_folder(a.out) as target:
        paths = night.write(target)
    _say(a, f"{len(paths)} frames and truth.ecsv in {a.out}", {"frames": [path.name for path in paths]})


def do_show(a):
    """``legdistort show``."""
    from .pipeline import summarise
    from .solution import Solution

    solution = Solution.read(a.solution)
    _report(a, solution, summarise(solution))


def do_report(a):
    """``legdistort report``."""
    from .pipeline import summarise
    from .report import write_report
    from .solution import Solution

    solution = Solution.read(a.solution)
    write_report(a.out, solution, summary=summarise(solution), overwrite=a.overwrite)
    _say(a, f"report in {a.out}", {"out": str(a.out)})


# -- pieces of commands


def _report(a, solution, summary):
    print(json.dumps(summary, indent=1) if a.json else solution)


def _say(a, sentence, figures):
    print(json.dumps(figures, indent=1) if a.json else sentence)


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
    return {"gauge": a.gauge, "method": a.method, "loss": a.loss, "error_floor": a.error_floor, "errors": a.errors}


def _prior(text):
    """``gsaoi-2``, or a solution.asdf whose mean distortion serves as the static one."""
    from .instruments import gsaoi_static
    from .priors import Prior
    from .solution import Solution

    if text is None:
        return None
    if text.startswith("gsaoi-") and text[6:] in ("1", "2", "3", "4"):
        model = gsaoi_static(int(text[6:]))
        return Prior.from_model(model, shape=(2048, 2048), direction="detector_to_reference", degree=5)
    if not Path(text).is_file():
        raise InputError(f"--prior {text}: neither a file nor one of gsaoi-1, gsaoi-2, gsaoi-3, gsaoi-4")
    earlier = Solution.read(text)
    return Prior(earlier.coefficients.mean(axis=0), shape=earlier.shapes[earlier.names[0]])


def _read_table(path, a):
    from .catalogs import read_table

    return read_table(path, columns=dict(a.columns))


def _write_table(table, a):
    from .files import replacing

    with replacing(a.out, overwrite=a.overwrite) as temporary:
        table.write(temporary, format="ascii.ecsv")
