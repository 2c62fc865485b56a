"""The command ``legdistort``: thin calls of the functions of the package."""

import argparse
import logging
import signal
import sys
import threading
import warnings
from contextlib import contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path

from tqdm.contrib.logging import logging_redirect_tqdm

from ..coaddition.options import ALGORITHMS, CONSERVE, EXTRAPOLATED, ORDERS, SCALES, WEIGHTS
from ..coaddition.resampling.drizzling import KERNELS
from ..exceptions import LegdistortError, LegdistortWarning
from ..priors.source import DIRECTIONS
from ..runtime.outputs import RESULTS
from . import commands
from .arguments import check_paths, columns, number_or_name, spectrum, word_or

log = logging.getLogger("legdistort")


def main(argv=None):
    """Run the command line; returns the exit status: 0, 1 for a failed run, 2 for wrong usage."""
    arguments = _parser().parse_args(argv)
    try:
        with _stopping(), _logging(arguments), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other packages
            warnings.simplefilter("default", LegdistortWarning)
            warnings.showwarning = lambda message, *_, **__: log.warning("%s", message)
            with (
                logging_redirect_tqdm([log]) if commands.wants_progress(arguments) else nullcontext()
            ):  # bars stay whole
                check_paths(arguments)
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
def _stopping():
    """While a command runs, SIGTERM and SIGHUP (batch systems, lost terminals) are as Ctrl-C: temporary files go."""
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [n for n in numbers if signal.getsignal(n) is signal.SIG_DFL]  # as nohup ignores it, so do we
    if threading.current_thread() is not threading.main_thread():  # where signals do not arrive
        numbers = []
    for n in numbers:
        signal.signal(n, signal.default_int_handler)
    try:
        yield
    finally:
        for n in numbers:
            signal.signal(n, signal.SIG_DFL)


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
    _out(p, "folder for frames and results", leaves=())
    _night(p)


def _run(p):
    _frames(p)
    _out(p, "folder for the results", leaves=RESULTS)
    _detection(p)
    _minimum(p)
    _fit(p, clip="5")
    _combination(p)
    _workers(p)
    p.add_argument("--compare", action="store_true", help="also by shifts, static map and relative polynomial")


def _measure(p):
    _frames(p)
    _out(p, "table (ECSV) of detections")
    _detection(p)
    _workers(p)


def _noise(p):
    _frames(p)
    _out(p, "table (ECSV) of errors against flux")
    p.add_argument("--fwhm", type=float, nargs="+", help="of the stars put in, pixels (default: that of the frame's)")
    p.add_argument("--fluxes", type=float, nargs="+", help="in units of the data (default: chosen by the frame)")
    p.add_argument("--n-positions", type=int, default=100, help="stars for every flux and width (default 100)")
    p.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    p.add_argument("--plot", type=Path, metavar="FILE.png", help="picture of the curves")
    _detector(p)
    _workers(p)


def _match(p):
    p.add_argument("tables", nargs="+", metavar="TABLE", help="positions; without a column exposure, one exposure")
    _out(p, "table (ECSV) of matched positions")
    _table(p)
    _minimum(p)


def _solve(p):
    p.add_argument("table", metavar="TABLE", help="exposure, star, x, y, x_err, y_err")
    _out(p, "folder for the results", leaves=RESULTS)
    _table(p)
    _fit(p, clip="no clipping")


def _prior(p):
    p.add_argument("sources", nargs="+", metavar="SOURCE", help="a file or name, or the two maps of shifts in x and y")
    _out(p, "prior (ASDF)")
    p.add_argument("--shape", type=int, nargs=2, metavar=("NY", "NX"), help="of the detector, where it is not told")
    p.add_argument("--degree", type=int, help="total degree of the Legendre series (default 5)")
    p.add_argument("--direction", choices=DIRECTIONS, help="what the source does, where it is not told")
    p.add_argument("--origin", type=int, choices=(0, 1), help="coordinate of the first pixel (default 0)")
    p.add_argument("--ext", help="extension of FITS files, header of a text, or place in an ASDF tree")
    p.add_argument("--frame", help="where to end: frame of a gwcs, or idl or tel of an aperture")
    p.add_argument(
        "--sigma",
        type=word_or(float, "evidence"),
        help="scatter of single exposures around it, pixels, or the word evidence",
    )
    p.add_argument("--static-sigma", type=float, help="uncertainty of it, pixels")


def _coadd(p):
    _frames(p)
    p.add_argument("--solution", required=True, help="solution.asdf")
    _limit(p)
    _out(p, "mosaic (.fits, .fits.gz or .asdf)")
    p.add_argument("--grid", type=Path, metavar="FILE", help="image or header text whose grid is taken")
    _combination(p)
    _workers(p)


def _attach(p):
    _show(p)
    _frames(p)
    where = p.add_mutually_exclusive_group(required=True)
    p.set_defaults(leaves=())
    where.add_argument("--out", type=Path, help="folder for copies")
    where.add_argument("--in-place", action="store_true", help="change the frames themselves")
    form = p.add_mutually_exclusive_group()
    form.add_argument("--tpv", action="store_true", help="header for SWarp and SCAMP (default: SIP)")
    form.add_argument("--asdf-only", action="store_true", help="leave the header alone, add the exact WCS")
    p.add_argument("--max-error", type=float, default=1e-3, help="of the header, pixels (default 0.001)")
    p.add_argument("--overwrite", action="store_true", help="replace copies and ASDF extensions that exist")


def _predict(p):
    p.add_argument("--n-exposures", type=int, required=True, help="how many")
    stars = p.add_mutually_exclusive_group(required=True)
    stars.add_argument("--n-stars", type=int, help="so many, drawn evenly over the field")
    stars.add_argument("--density", type=float, help="the same, as stars a detector")
    stars.add_argument("--stars", metavar="TABLE", help="x, y in the reference plane, perhaps x_err, y_err")
    p.add_argument("--sigma", type=float, help="error of one measured position, pixels (default: x_err, y_err)")
    p.add_argument("--degree", type=int, default=3, help="total degree to be fitted (default 3)")
    p.add_argument(
        "--dither", type=float, default=0.0, metavar="RMS", help="rms length of the shifts, pixels (default 0)"
    )
    _known_static(p)
    p.add_argument("--dynamic", type=float, help="rms of a coefficient from exposure to exposure, pixels")
    p.add_argument("--spectrum", type=spectrum, metavar="DEGREE=RMS,...", help="the same by degree, beyond the fit too")
    p.add_argument("--gauge", choices=("minimal", "mean"), default="minimal", help="see the docs (default minimal)")
    p.add_argument("--seed", type=int, default=0, help="of stars and shifts that are drawn (default 0)")
    p.add_argument("--plot", type=Path, metavar="FILE.png", help="map of the error over the field")
    p.add_argument("--overwrite", action="store_true", help="replace a picture that exists")
    _table(p)


def _simulate(p):
    _out(p, "folder for the frames", leaves=())
    _night(p)


def _show(p):
    p.add_argument("solution", help="solution.asdf")
    _limit(p)


def _stars(p):
    _show(p)
    _out(p, "table (.ecsv, .fits, .vot, .xml or .csv)")


def _correct(p):
    _show(p)
    p.add_argument("table", metavar="TABLE", help="exposure, x, y, x_err, y_err")
    _out(p, "table (.ecsv, .fits, .vot, .xml or .csv)")
    _columns(p)


def _report(p):
    _show(p)
    _out(p, "page (HTML)")


#: Command: what it does, an example, its arguments.
_COMMANDS = {
    "demo": ("simulate a night, solve it, compare with the truth", "--out demo", _demo),
    "run": ("frames to WCS, mosaic and report", "frames/*.fits --out results --degree 3", _run),
    "measure": ("frames to a table of positions", "frames/*.fits --out stars.ecsv", _measure),
    "noise": ("error of a position against flux, by injected stars", "frames/a.fits --out noise.ecsv", _noise),
    "match": (
        "tables of positions to matched stars",
        "A.lis B.lis C.lis --columns x_err=xe,y_err=ye --shape 1024 1024 --out matched.ecsv",
        _match,
    ),
    "solve": ("matched positions to distortions", "matched.ecsv --degree 2 --out results", _solve),
    "prior": ("a known static distortion as a file for --prior", "x.fits y.fits --out prior.asdf", _prior),
    "coadd": (
        "frames and a solution to a mosaic",
        "frames/*.fits --solution results/solution.asdf --out mosaic.fits",
        _coadd,
    ),
    "attach": (
        "the WCS of a solution into its frames",
        "results/solution.asdf frames/*.fits --out calibrated",
        _attach,
    ),
    "predict": (
        "expected errors of a planned set of exposures",
        "--n-exposures 11 --n-stars 80 --sigma 0.02 --degree 3",
        _predict,
    ),
    "simulate": ("frames of a simulated night with their truth", "--out night --small", _simulate),
    "show": ("print a solution", "results/solution.asdf", _show),
    "stars": ("the stars of a solution as a table", "results/solution.asdf --out stars.fits", _stars),
    "correct": (
        "positions measured elsewhere in its exposures to the reference plane and the sky, with errors",
        "results/solution.asdf faint.ecsv --out corrected.ecsv",
        _correct,
    ),
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


def _out(p, what, *, leaves=None):
    """The argument of an output: a file; or a folder, with the names of what is replaced in it."""
    p.set_defaults(leaves=leaves)
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
    _detector(p)
    p.add_argument("--profile", choices=("own", "shared", "linear"), help="shape: of a star, or the whole frame")
    p.add_argument("--blends", choices=("together", "alone"), help="how stars that touch are fitted (default together)")
    p.add_argument(
        "--position-errors",
        choices=("fit", "injected", "scaled"),
        default="fit",
        help="of the fit, or by stars of known position put into the frame (default fit)",
    )


def _detector(p):
    p.add_argument("--threshold", type=float, help="detection limit, signal-to-noise ratio (default 5)")
    p.add_argument("--gain", type=float, help="electrons per ADU (default: header)")
    p.add_argument("--read-noise", type=float, help="electrons (default: header)")
    p.add_argument("--saturation", type=float, help="ADU (default: header, or a piled-up maximum)")


def _minimum(p):
    p.add_argument("--min-exposures", type=int, default=4, help="keep stars seen in so many exposures (default 4)")
    p.add_argument("--isolation", type=float, help="largest crowding of a star; inf keeps all (default 3)")


def _workers(p):
    p.add_argument("--workers", type=int, metavar="N", help="cores to use (default 1)")


def _limit(p):
    p.add_argument("--max-bytes", type=int, help="accept arrays of so many bytes, unpacked (default 2147483648)")


def _columns(p):
    p.add_argument("--columns", type=columns, default=[], metavar="OURS=THEIRS,...", help="names of columns")
    p.add_argument("--origin", type=int, choices=(0, 1), help="of pixels in the table (default 0; SExtractor 1)")


def _table(p):
    _columns(p)
    p.add_argument("--shape", type=int, nargs=2, metavar=("NY", "NX"), help="of the detector, pixels")


def _fit(p, *, clip):
    p.add_argument("--degree", type=word_or(int, "auto"), default=3, help="total degree, or auto (default 3)")
    _known_static(p)
    p.add_argument(
        "--prior-sigma",
        type=word_or(float, "evidence"),
        metavar="PIXELS",
        help="scatter of exposures around it; evidence: found from them",
    )
    p.add_argument("--validate", type=float, metavar="FRACTION", help="of the stars, kept out to test the errors")
    p.add_argument("--static", choices=("fit",), help="fit one static distortion for all exposures of a detector")
    p.add_argument("--exposure-degree", type=int, help="with --static fit: what every exposure adds (default 1)")
    p.add_argument("--gauge", choices=("minimal", "mean"), default="minimal", help="see the docs (default minimal)")
    p.add_argument("--method", choices=("joint", "alternating"), default="joint", help="(default joint)")
    p.add_argument("--loss", choices=("linear", "huber", "cauchy"), default="linear", help="(default linear)")
    p.add_argument("--clip", type=float, help=f"leave out what deviates by more sigma; 0: nothing (default {clip})")
    p.add_argument("--errors", choices=("stated", "scale", "floor"), default="stated", help="(default stated)")
    p.add_argument("--error-floor", type=float, default=0.0, help="pixels, added in quadrature to every error")
    p.add_argument("--reference", metavar="TABLE", help="catalogue to tie the positions to, such as one of Gaia")
    p.add_argument("--epoch", type=float, metavar="YEAR", help="of the exposures, for proper motions (default: header)")
    p.add_argument("--pixel-scale", type=float, metavar="ARCSEC", help="helps to find the stars without a header WCS")


def _known_static(p):
    p.add_argument("--prior", help="known static distortion: see the command prior")
    p.add_argument(
        "--static-sigma",
        type=float,
        metavar="PIXELS",
        help="uncertainty of a coefficient of it; without --prior its size, nothing else being known",
    )


def _combination(p):
    p.add_argument("--combine", choices=("mean", "median", "clipped"), default="clipped", help="(default clipped)")
    p.add_argument(
        "--order", type=number_or_name, choices=(*range(6), *ORDERS), default=3, help="of the spline (default 3)"
    )
    p.add_argument("--algorithm", choices=ALGORITHMS, default="interp", help="of resampling (default interp)")
    p.add_argument("--pixfrac", type=float, default=1.0, help="with drizzle: side of the drops (default 1)")
    p.add_argument(
        "--kernel", choices=KERNELS, default="square", help="with drizzle: shape of the drops (default square)"
    )
    p.add_argument("--conserve", choices=CONSERVE, default="flux", help="when pixels change size (default flux)")
    p.add_argument("--no-match-background", action="store_true", help="leave the levels of the sky as they are")
    p.add_argument("--weights", choices=(*WEIGHTS, "equal"), default="noise", help="of exposures (default noise)")
    p.add_argument("--scale", choices=(*SCALES, "none"), default="auto", help="of fluxes (default auto)")
    p.add_argument(
        "--extrapolated", choices=EXTRAPOLATED, default="flag", help="pixels outside the stars used (default flag)"
    )
    p.add_argument("--scratch", type=Path, metavar="FOLDER", help="for pixels while work goes on (default: system's)")


if __name__ == "__main__":
    sys.exit(main())
