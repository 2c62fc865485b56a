"""The command ``legdistort``: thin calls of the functions of the package."""

import argparse
import logging
import sys
import warnings
from contextlib import contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path

from tqdm.contrib.logging import logging_redirect_tqdm

from . import commands
from .exceptions import LegdistortError, LegdistortWarning

log = logging.getLogger("legdistort")


def main(argv=None):
    """Run the command line; returns the exit status: 0, 1 for a failed run, 2 for wrong usage."""
    arguments = _parser().parse_args(argv)
    try:
        with _logging(arguments), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other packages
            warnings.simplefilter("default", LegdistortWarning)
            warnings.showwarning = lambda message, *_, **__: log.warning("%s", message)
            with (
                logging_redirect_tqdm([log]) if commands.wants_progress(arguments) else nullcontext()
            ):  # bars stay whole
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


# -- the parser: one function a command, which adds its arguments


def _demo(p):
    _out(p, "folder for frames and results")
    _night(p)


def _run(p):
    _frames(p)
    _out(p, "folder for the results")
    _detection(p)
    _minimum(p)
    _fit(p, clip="5")
    _combination(p)


def _measure(p):
    _frames(p)
    _out(p, "table (ECSV) of detections")
    _detection(p)


def _match(p):
    p.add_argument("tables", nargs="+", metavar="TABLE", help="positions; without a column exposure, one exposure")
    _out(p, "table (ECSV) of matched positions")
    _table(p)
    _minimum(p)


def _solve(p):
    p.add_argument("table", metavar="TABLE", help="exposure, star, x, y, x_err, y_err")
    _out(p, "folder for the results")
    _table(p)
    _fit(p, clip="no clipping")


def _coadd(p):
    _frames(p)
    p.add_argument("--solution", required=True, help="solution.asdf")
    _out(p, "mosaic (FITS)")
    _combination(p)


def _simulate(p):
    _out(p, "folder for the frames")
    _night(p)


def _show(p):
    p.add_argument("solution", help="solution.asdf")


def _report(p):
    _show(p)
    _out(p, "page (HTML)")


#: Command: what it does, an example, its arguments.
_COMMANDS = {
    "demo": ("simulate a night, solve it, compare with the truth", "--out demo", _demo),
    "run": ("frames to WCS, mosaic and report", "frames/*.fits --out results --degree 3", _run),
    "measure": ("frames to a table of positions", "frames/*.fits --out stars.ecsv", _measure),
    "match": (
        "tables of positions to matched stars",
        "A.lis B.lis C.lis --columns x_err=xe,y_err=ye --shape 1024 1024 --out matched.ecsv",
        _match,
    ),
    "solve": ("matched positions to distortions", "matched.ecsv --degree 2 --out results", _solve),
    "coadd": (
        "frames and a solution to a mosaic",
        "frames/*.fits --solution results/solution.asdf --out mosaic.fits",
        _coadd,
    ),
    "simulate": ("frames of a simulated night with their truth", "--out night --small", _simulate),
    "show": ("print a solution", "results/solution.asdf", _show),
    "report": ("HTML page of a solution", "results/solution.asdf --out report.html", _report),
}


def _parser():
    parser = argparse.ArgumentParser(
        prog="legdistort",
        description="Star positions and image distortions from dithered exposures, as WCS and mosaic.",
        epilog="Start with: legdistort demo --out demo",
    )
    parser.add_argument("--version", action="version", version=f"legdistort {version('legdistort')}")
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, (what, example, add_arguments) in _COMMANDS.items():
        p = subparsers.add_parser(
            name,
            help=what,
            description=what[0].upper() + what[1:] + ".",
            epilog=f"Example: legdistort {name} {example}",
        )
        p.set_defaults(function=getattr(commands, f"do_{name}"))
        p.add_argument("--json", action="store_true", help="print figures as JSON")
        p.add_argument("--quiet", action="store_true", help="no progress, only warnings")
        p.add_argument("--debug", action="store_true", help="full log and traceback")
        add_arguments(p)
    return parser


def _columns(text):
    pairs = [item.split("=") for item in text.split(",") if item]
    if not all(len(pair) == 2 and all(pair) for pair in pairs):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form star=name,x_err=xe")
    return pairs


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
