"""The command ``legdistort``: thin calls of the functions of the package."""

import argparse
import json
import logging
import sys
import warnings
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

from tqdm.contrib.logging import logging_redirect_tqdm

from .exceptions import InputError, LegdistortError, LegdistortWarning

log = logging.getLogger("legdistort")


def main(argv=None):
    """Run the command line; returns the exit status: 0, 1 for a failed run, 2 for wrong usage."""
    arguments = _parser().parse_args(argv)
    try:
        with _logging(arguments), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other packages
            warnings.simplefilter("default", LegdistortWarning)
            warnings.showwarning = lambda message, *_, **__: log.warning("%s", message)
            with logging_redirect_tqdm([log]) if _progress(arguments) else nullcontext():  # bars stay whole
                arguments.function(arguments)
    except LegdistortError as error:
        if arguments.debug:
            raise
        print(f"legdistort: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of our output has left, as in ``legdistort show FILE | head``
        sys.stdout = None
        return 0
    except OSError as error:
        if arguments.debug:
            raise
        print(f"legdistort: {error} (nothing was left half-written)", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("legdistort: interrupted; nothing was left half-written", file=sys.stderr)
        return 1
    return 0


@contextmanager
def _logging(arguments):
    """The log of the package on stderr while a command runs; afterwards as it was, for callers of `main`."""
    before = log.handlers[:], log.propagate, log.level
    level = logging.WARNING if arguments.quiet else logging.INFO
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    log.handlers[:], log.propagate = [handler], False
    log.setLevel(logging.DEBUG if arguments.debug else level)
    try:
        yield
    finally:
        log.handlers[:], log.propagate = before[:2]
        log.setLevel(before[2])


def _progress(arguments):
    return not arguments.quiet and sys.stderr.isatty()


# -- commands


def _demo(a):
    from .demo import run_demo

    result = run_demo(out=a.out, small=a.small, seed=a.seed, overwrite=a.overwrite, progress=_progress(a))
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


def _run(a):
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
        progress=_progress(a),
    )
    _report(a, result.solution, result.summary)
    if not a.json:
        print(f"Results in {a.out}: open {Path(a.out) / 'report.html'}")


def _measure(a):
    from .exposures import read_exposures
    from .measurement import measure

    given = {key: getattr(a, key) for key in ("fwhm", "threshold", "gain", "read_noise", "saturation")}
    exposures = read_exposures(a.frames, ext=_extension(a.ext), progress=_progress(a))
    table = measure(exposures, progress=_progress(a), **{k: v for k, v in given.items() if v is not None})
    shapes = {e.name: list(e.shape) for e in exposures}
    table.meta["shapes"] = shapes
    _write_table(table, a)
    _say(a, f"{len(table)} detections in {len(exposures)} exposures", {"n_detections": len(table), "shapes": shapes})


def _match(a):
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


def _solve(a):
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


def _coadd(a):
    from .coaddition import coadd
    from .exposures import read_exposures
    from .solution import Solution

    solution = Solution.read(a.solution)
    exposures = read_exposures(a.frames, ext=_extension(a.ext), progress=_progress(a))
    mosaic = coadd(exposures, solution, method=a.combine, order=a.order, progress=_progress(a))
    mosaic.write(a.out, overwrite=a.overwrite)
    figures = {"shape": list(mosaic.shape), "n_exposures": len(mosaic.exposures), "left_out": mosaic.left_out}
    _say(a, f"{mosaic!r}"[1:-1] + f" in {a.out}", figures)


def _simulate(a):
    from .files import replacing_folder
    from .simulation import simulate_exposures

    if Path(a.out, "truth.ecsv").exists() and not a.overwrite:
        raise InputError(f"{a.out} already holds a simulated night; give --overwrite or another folder")
    night = simulate_exposures(small=a.small, seed=a.seed, progress=_progress(a))
    with replacing_folder(a.out) as target:
        paths = night.write(target)
    _say(a, f"{len(paths)} frames and truth.ecsv in {a.out}", {"frames": [path.name for path in paths]})


def _show(a):
    from .pipeline import summarise
    from .solution import Solution

    solution = Solution.read(a.solution)
    _report(a, solution, summarise(solution))


def _make_report(a):
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


def _columns(text):
    pairs = [item.split("=") for item in text.split(",") if item]
    if not all(len(pair) == 2 and all(pair) for pair in pairs):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form star=name,x_err=xe")
    return pairs


# -- the parser


def _parser():
    parser = argparse.ArgumentParser(
        prog="legdistort",
        description="Star positions and image distortions from dithered exposures, as WCS and mosaic.",
        epilog="Start with: legdistort demo --out demo",
    )
    parser.add_argument("--version", action="version", version=f"legdistort {version('legdistort')}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    p = _command(commands, "demo", _demo, "simulate a night, solve it, compare with the truth", "--out demo")
    _out(p, "folder for frames and results")
    _night(p)
    p = _command(commands, "run", _run, "frames to WCS, mosaic and report", "frames/*.fits --out results --degree 3")
    _frames(p)
    _out(p, "folder for the results")
    _detection(p)
    _minimum(p)
    _fit(p, clip="5")
    _combination(p)
    p = _command(commands, "measure", _measure, "frames to a table of positions", "frames/*.fits --out stars.ecsv")
    _frames(p)
    _out(p, "table (ECSV) of detections")
    _detection(p)
    p = _command(
        commands, "match", _match, "tables of positions to matched stars",
        "A.lis B.lis C.lis --columns x_err=xe,y_err=ye --shape 1024 1024 --out matched.ecsv",
    )  # fmt: skip
    p.add_argument("tables", nargs="+", metavar="TABLE", help="positions; without a column exposure, one exposure")
    _out(p, "table (ECSV) of matched positions")
    _table(p)
    _minimum(p)
    p = _command(commands, "solve", _solve, "matched positions to distortions", "matched.ecsv --degree 2 --out results")
    p.add_argument("table", metavar="TABLE", help="exposure, star, x, y, x_err, y_err")
    _out(p, "folder for the results")
    _table(p)
    _fit(p, clip="no clipping")
    p = _command(commands, "coadd", _coadd, "frames and a solution to a mosaic",
                 "frames/*.fits --solution results/solution.asdf --out mosaic.fits")  # fmt: skip
    _frames(p)
    p.add_argument("--solution", required=True, help="solution.asdf")
    _out(p, "mosaic (FITS)")
    _combination(p)
    p = _command(commands, "simulate", _simulate, "frames of a simulated night with their truth", "--out night --small")
    _out(p, "folder for the frames")
    _night(p)
    p = _command(commands, "show", _show, "print a solution", "results/solution.asdf")
    p.add_argument("solution", help="solution.asdf")
    p = _command(commands, "report", _make_report, "HTML page of a solution", "results/solution.asdf --out report.html")
    p.add_argument("solution", help="solution.asdf")
    _out(p, "page (HTML)")
    return parser


def _command(commands, name, function, what, example):
    p = commands.add_parser(
        name, help=what, description=what[0].upper() + what[1:] + ".", epilog=f"Example: legdistort {name} {example}"
    )
    p.set_defaults(function=function)
    p.add_argument("--json", action="store_true", help="print figures as JSON")
    p.add_argument("--quiet", action="store_true", help="no progress, only warnings")
    p.add_argument("--debug", action="store_true", help="full log and traceback")
    return p


def _out(p, what):
    p.add_argument("--out", required=True, type=Path, help=what)
    p.add_argument("--overwrite", action="store_true", help="replace what an earlier call left")


def _frames(p):
    p.add_argument("frames", nargs="+", metavar="FRAME", help="FITS files, plain or compressed")
    p.add_argument("--ext", help="extension: number, name, or NAME,VERSION")


def _night(p):
    p.add_argument("--small", action="store_true", help="six frames of 512 x 512 instead of eleven of 2048 x 2048")
    p.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")


def _detection(p):
    p.add_argument("--fwhm", type=float, help="of the stars, pixels (default: found)")
    p.add_argument("--threshold", type=float, help="detection limit, signal-to-noise ratio (default 5)")
    p.add_argument("--gain", type=float, help="electrons per ADU (default: header)")
    p.add_argument("--read-noise", type=float, help="electrons (default: header)")
    p.add_argument("--saturation", type=float, help="ADU (default: header, or a piled-up maximum)")


def _minimum(p):
    p.add_argument("--min-exposures", type=int, default=4, help="keep stars seen in so many exposures (default 4)")


def _table(p):
    p.add_argument("--columns", type=_columns, default=[], metavar="OURS=THEIRS,...", help="names of columns")
    p.add_argument("--shape", type=int, nargs=2, metavar=("NY", "NX"), help="of the detector, pixels")


def _fit(p, *, clip):
    p.add_argument("--degree", type=int, default=3, help="total degree of the distortion (default 3)")
    p.add_argument("--prior", help="static distortion: gsaoi-1 ... gsaoi-4, or a solution.asdf")
    p.add_argument("--gauge", choices=("minimal", "mean"), default="minimal", help="see the docs (default minimal)")
    p.add_argument("--method", choices=("joint", "alternating"), default="joint", help="(default joint)")
    p.add_argument("--loss", choices=("linear", "huber", "cauchy"), default="linear", help="(default linear)")
    p.add_argument("--clip", type=float, help=f"leave out what deviates by more sigma; 0: nothing (default {clip})")
    p.add_argument("--errors", choices=("stated", "scale", "floor"), default="stated", help="(default stated)")
    p.add_argument("--error-floor", type=float, default=0.0, help="pixels, added in quadrature to every error")


def _combination(p):
    p.add_argument("--combine", choices=("mean", "median", "clipped"), default="clipped", help="(default clipped)")
    p.add_argument("--order", type=int, default=3, help="of the interpolating spline (default 3)")


if __name__ == "__main__":
    sys.exit(main())
