"""The commands as the command line describes them: what each does, an example, its options.

`commands` has the functions that do it; it is not loaded before one is called for.
"""

from dataclasses import dataclass

from . import options, planning_options


@dataclass(frozen=True)
class Command:
    """A command: what it does, an example of its arguments, its groups of options."""

    what: str
    example: str
    groups: tuple


def _command(what, example, *groups):
    return Command(what, example, (options.COMMON, *groups))


#: Of ``camera``, which takes a solution or a frame.
_CAMERA_SOURCE = {
    "solution": options.Option(
        "solution.asdf or its folder, or a frame with all its detectors", "solution", path="read"
    ),
    "ext": options.Option("extensions of a frame that are its detectors: name, or pattern", type=options.extension),
    "headers": options.Option(
        "headers that take the place of those of the frame, one for every image, as SCAMP writes them (.head)",
        metavar="TEXT",
        path="read",
    ),
}

#: The commands by name, in the order of the help.
COMMANDS = {
    "demo": _command(
        "simulate a night, solve it, compare with the truth",
        "--out demo",
        options.out("folder for frames and results", path="folder"),
        options.NIGHT,
        options.EXAMPLES,
    ),
    "run": _command(
        "frames to WCS, mosaic and report",
        "frames/*.fits --out results --degree 3",
        options.RUN_FRAMES,
        options.FORGETTING,
        options.FLAGGED,
        options.STOPPING,
        options.STRICT,
        options.out("folder for the results", path="results"),
        options.CAMERA,
        options.MEASURING,
        options.MATCHING,
        options.LEFT_OUT,
        options.SOLVING,
        options.COADDING,
        options.WORKERS,
        options.LAST_STEP,
        options.COMPARING,
    ),
    "measure": _command(
        "frames to a table of positions",
        "frames/*.fits --out stars.ecsv",
        options.FRAMES,
        options.FLAGGED,
        options.STOPPING,
        options.out("table (ECSV) of detections", endings=options.TABLE_ENDINGS),
        options.MEASURING,
        options.PSF_FILES,
        options.WORKERS,
    ),
    "noise": _command(
        "error of a position against flux, by injected stars",
        "frames/a.fits --out noise.ecsv",
        options.FRAMES,
        options.FLAGGED,
        options.out("table (ECSV) of errors against flux", endings=options.TABLE_ENDINGS),
        options.INJECTING,
        options.picture("picture of the curves"),
        options.DETECTOR,
        options.WORKERS,
    ),
    "match": _command(
        "tables of positions to matched stars",
        "A.lis B.lis C.lis --columns x_err=xe,y_err=ye --shape 1024 1024 --out matched.ecsv",
        options.TABLES,
        options.out("table (ECSV) of matched positions", endings=options.TABLE_ENDINGS),
        options.TABLE,
        options.WCS_OF_TABLES,
        options.FLAGGED,
        options.CAMERA,
        options.MATCHING,
    ),
    "solve": _command(
        "matched positions to distortions",
        "matched.ecsv --degree 2 --out results",
        options.MATCHED,
        options.LEFT_OUT,
        options.BASE,
        options.STRICT,
        options.out("folder for the results", path="results"),
        options.TABLE,
        options.CAMERA,
        options.SOLVING,
    ),
    "prior": _command(
        "a known static distortion as a file for --prior",
        "x.fits y.fits --out prior.asdf",
        options.out(
            "prior (ASDF), or with .fits maps NAME_x.fits, NAME_y.fits, and NAME_x_err.fits, NAME_y_err.fits of their "
            "errors",
            endings=(".asdf", ".fits"),
        ),
        options.EXPANDING,
    ),
    "coadd": _command(
        "frames and a solution to a mosaic",
        "frames/*.fits --solution results/solution.asdf --out mosaic.fits",
        options.FRAMES,
        options.FLAGGED,
        options.SOLUTION | options.NAMED_SOLUTION,
        options.out("mosaic (.fits, .fits.gz or .asdf)"),
        options.GRID,
        options.COADDING,
        options.WORKERS,
    ),
    "catalogue": _command(
        "every star measured in all frames at once, by the maps of a solution",
        "frames/*.fits --solution results/solution.asdf --out catalogue.ecsv",
        options.FRAMES,
        options.FLAGGED,
        options.SOLUTION | options.NAMED_SOLUTION,
        options.out("table (ECSV) of stars; photometry.ecsv comes beside it", endings=options.TABLE_ENDINGS),
        options.CATALOGUING,
        options.ARTIFICIAL,
    ),
    "completeness": _command(
        "artificial stars in all frames, found again as the catalogue finds stars",
        "frames/*.fits --solution results/solution.asdf --out completeness.ecsv",
        options.FRAMES,
        options.FLAGGED,
        options.SOLUTION | options.NAMED_SOLUTION,
        options.out(
            "table (ECSV) by flux; tables by place and of the stars come beside it", endings=options.TABLE_ENDINGS
        ),
        options.COMPLETENESS,
    ),
    "attach": _command(
        "the WCS of a solution into its frames",
        "results/solution.asdf frames/*.fits --out calibrated",
        options.SOLUTION,
        options.FRAMES,
        options.ATTACHING,
    ),
    "predict": _command(
        "expected errors of a planned set of exposures",
        "--n-exposures 11 --n-stars 80 --sigma 0.02 --degree 3",
        planning_options.PREDICTING,
        planning_options.INSTRUMENT,
        planning_options.EXPOSURES,
        options.CAMERA,
        options.picture("map of the error over the field"),
        planning_options.PICTURE_OF_ERRORS,
        options.REPLACING,
        options.TABLE,
    ),
    "simulate": _command(
        "frames of a simulated night with their truth",
        "--out night --small",
        options.out("folder for the frames", path="folder"),
        options.NIGHT,
        options.MOVING,
        options.OPTICS,
    ),
    "show": _command(
        "print a solution, a camera, nights, a prior, or what a frame states and where",
        "results/solution.asdf",
        options.SHOWN,
        options.FLAGGED,
        options.STRICT,
    ),
    "nights": _command(
        "combine nights to one camera, and say which nights are odd",
        "night*/results --out camera.asdf --plot coefficients.png",
        options.NIGHTS,
        options.AT_DATE,
        options.WORKERS,
        options.STRICT,
        options.out("camera file (ASDF), for --prior and --camera, which also holds the nights"),
        options.picture("picture of all coefficients against time"),
    ),
    "difference": _command(
        "is an old distortion map still right? its difference from another, or from a night; two solutions, with stars",
        "camera.asdf results/solution.asdf --plot difference.png",
        options.MAPS,
        options.COMPARED,
        options.STRICT,
        options.picture("picture of the difference"),
        options.REPLACING,
    ),
    "stars": _command(
        "the stars of a solution as a table",
        "results/solution.asdf --out stars.fits",
        options.SOLUTION,
        options.out("table (.ecsv, .fits, .vot, .xml, .csv, .txt or .dat)"),
        options.AT_EPOCH,
    ),
    "camera": _command(
        "the camera that a solution found, or that the headers of a frame state, as a file",
        "results/solution.asdf --out camera.asdf",
        options.SOLUTION | _CAMERA_SOURCE,
        options.out("camera file (ASDF), for --camera"),
    ),
    "correct": _command(
        "positions in its exposures to the reference plane and the sky, or any lists by a camera alone, with errors",
        "results/solution.asdf faint.ecsv --out corrected.ecsv",
        options.SOLUTION | options.OF_STATIC,
        options.TABLES,
        options.out("table (.ecsv, .fits, .vot, .xml, .csv, .txt or .dat)"),
        options.COLUMNS,
        options.CARRIED,
        options.AT_DATE,
    ),
    "report": _command(
        "HTML page of a solution",
        "results/solution.asdf --out report.html",
        options.SOLUTION,
        options.out("page (HTML)", endings=(".html", ".htm")),
    ),
}
