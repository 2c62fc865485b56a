"""The options of the commands, each stated once, under the name of the argument of the function that takes it."""

from pathlib import Path

from ..runtime import words
from .arguments import (
    Group,
    Option,
    columns,
    extension,
    keywords,
    names,
    number_or_name,
    pairs,
    planes,
    some_words,
    word_or,
)

# -- options that several commands have

COMMON = {
    "json": Option("print figures as JSON", action="store_true"),
    "quiet": Option("no progress, only warnings", action="store_true"),
    "verbose": Option("a line for every image", action="store_true"),
    "debug": Option("full log and traceback", action="store_true"),
}
FRAMES = {
    "paths": Option(
        "FITS files, plain or compressed; ASDF files of Roman", "frames", nargs="+", metavar="FRAME", path="inputs"
    ),
    "ext": Option("extension: number, name, pattern such as 'IM*', or NAME,VERSION", type=extension),
}
RUN_FRAMES = {
    "paths": Option(
        "as for measure; with --from by default the frames of that run",
        "frames",
        none=[],
        nargs="*",
        metavar="FRAME",
        path="inputs",
    ),
    "ext": FRAMES["ext"],
    "earlier": Option(
        "results of an earlier run: positions are its own, not measured again; its options hold but for those given",
        "--from",
        metavar="FOLDER",
    ),
}
FORGETTING = {
    "forget": Option(
        "options of the earlier run that do not hold; all: none does", type=names, default=[], metavar="NAME,..."
    )
}
FLAGGED = {
    "dq_good": Option("flags that leave a pixel good: a sum, or 64,32", metavar="BITS"),
    "weight_maps": Option(
        "MAP_WEIGHT, MAP_VARIANCE or MAP_RMS beside every frame; none (default: NAME.weight.fits where there is one)",
        metavar="TYPE[,SUFFIX]",
    ),
}
STOPPING = {"stop_at_bad": Option("refuse blank and damaged frames, do not leave them out", action="store_true")}
STRICT = {"strict": Option("exit status 3 if a check of the result fails", action="store_true")}
NAMED_SOLUTION = {"solution": Option("solution.asdf, or the folder of the results with it", required=True, path="read")}
SOLUTION = {
    "solution": Option("solution.asdf, or the folder of the results with it", "solution", path="read"),
    "max_bytes": Option("accept arrays of so many bytes, unpacked (default 2147483648)", type=int),
}
SHOWN = {
    "solution": Option("solution.asdf, the folder of the results with it, or a FITS frame", "solution", path="read"),
    "ext": Option("of a frame: number, name, or NAME,VERSION; a name of several shows each detector", type=extension),
    "max_bytes": SOLUTION["max_bytes"],
}
COLUMNS = {
    "columns": Option("names of columns", type=columns, default=[], metavar="OURS=THEIRS,..."),
    "origin": Option("of pixels in the table (default: the program's, else 0)", type=int, choices=(0, 1)),
    "error": Option("of positions that come without one", type=float, metavar="PIXELS"),
}
TABLE = {**COLUMNS, "shape": Option("of the detector, pixels", type=int, nargs=2, metavar=("NY", "NX"))}
TABLES = {
    "tables": Option(
        "positions; without a column exposure, one exposure", "tables", nargs="+", metavar="TABLE", path="inputs"
    )
}
WCS_OF_TABLES = {
    "wcs": Option("frames of the tables: WCS, shape and time", nargs="+", metavar="FRAME", path="inputs"),
    "dates": Option("when lists were taken: their names, and years, MJD or dates", metavar="TABLE", path="read"),
    "ext": Option("extension of those frames: number, name, or NAME,VERSION", type=extension),
}
OF_STATIC = {
    "solution": Option("solution.asdf or its folder; or a camera, or what --prior takes", "solution", path="read"),
    "detector": Option("of a camera, which took lists without a column detector", metavar="NAME"),
}
MATCHED = {
    "tables": Option(
        "exposure, star, x, y, x_err, y_err; several: fields of one camera without a common star, solved together",
        "tables",
        nargs="+",
        metavar="TABLE",
        path="inputs",
    )
}
LEFT_OUT = {"without": Option("exposures or nights to leave out, * for any letters", nargs="+", metavar="NAME")}
WORKERS = {"workers": Option("cores to use (default: all, where frames are not few and small)", type=int, metavar="N")}


#: Endings of tables and of pictures.
TABLE_ENDINGS, PICTURE_ENDINGS = (".ecsv",), (".png", ".pdf", ".svg")


def out(what, *, path="file", endings=None):
    """The output of a command."""
    named = {
        "out": Option(what, required=True, type=Path, path=path, endings=endings),
        "overwrite": Option("replace what an earlier call left", action="store_true"),
    }
    keep = Option("keep other files that are in the folder, which are refused else", action="store_true")
    return named | ({"keep": keep} if path == "results" else {})


def picture(what):
    """A picture that is made if it is asked for."""
    return {"plot": Option(what, type=Path, metavar="FILE.png", path="file", endings=PICTURE_ENDINGS)}


MAPS = {
    "first": Option(
        "camera file, solution, or whatever the command prior reads as one file", "first", metavar="CAMERA", path="read"
    ),
    "second": Option("another, or the solution of a night", "second", metavar="NIGHT", path="read"),
}
BASE = {"base": Option("a finished solution that these come into; its options hold", metavar="RESULTS", path="read")}
COMPARED = {"degree": Option("of the series for a map that is none yet (default 5)", type=int)}
NIGHTS = {
    "results": Option(
        "solutions of nights or fields, folders with one, priors, and camera files that this command wrote before",
        "results",
        nargs="+",
        metavar="RESULTS",
        path="inputs",
    ),
    "name": Option("of the camera", metavar="NAME"),
    "covariate": Option("number of exposures, a column, on which the distortion may depend", metavar="NAME"),
}
AT_DATE = {
    "date": Option("of a camera of nights, a decimal year (default: of the last one)", type=float, metavar="YEAR"),
    "value": Option("of its covariate (default: mean of the exposures)", type=float, metavar="NUMBER"),
}
REPLACING = {"overwrite": Option("replace a picture that exists", action="store_true")}

KNOWN_STATIC = {
    "prior": Option("known static distortion, see the command prior; header: of the frames of run", path="read"),
    "static_sigma": Option(
        "uncertainty of a coefficient of it; without --prior its size, of every detector of a camera",
        type=float,
        metavar="PIXELS",
    ),
}

# -- options of the functions

NIGHT = {
    "small": Option("six frames of 512 x 512 instead of eleven of 2048 x 2048", action="store_true"),
    "seed": Option("of the random numbers (default 0)", type=int),
    "camera": Option("all detectors of this camera, in one file an exposure", choices=("gsaoi",)),
}
EXAMPLES = {
    "kind": Option("only write small example files of this form, and solve nothing", "--as", choices=words.EXAMPLES)
}
AT_EPOCH = {"epoch": Option("where they are at another time: a decimal year (default: of the solution)", type=float)}
CARRIED = {
    "epoch": Option(
        "carry positions to another time, a decimal year, by the motions of the stars in column star", type=float
    )
}
MOVING = {
    "epochs": Option("years, one for each frame; stars then move", type=float, nargs="+"),
    "motion": Option("scatter of the proper motions per axis, pixels a year", type=float),
    "parallax": Option("scatter of the parallaxes, pixels", type=float),
}
OPTICS = {
    "strehl": Option("adaptive optics: Strehl ratio of a core in a seeing halo (default: Moffat profiles)", type=float),
}
DETECTOR = {
    "threshold": Option("detection limit, signal-to-noise ratio (default 5)", type=float),
    "gain": Option("electrons per ADU (default: header)", type=float),
    "read_noise": Option("electrons (default: header)", type=float),
    "saturation": Option("ADU (default: header, or a piled-up maximum)", type=float),
}
MEASURING = Group(
    "measuring",
    {
        "fwhm": Option("full width at half maximum of the stars, pixels (default: estimated)", type=float),
        **DETECTOR,
        "profile": Option("shape of the stars: each its own, or one for the frame", choices=words.PROFILES),
        "psf": Option("auto (default), moffat, effective, or a file or folder with PSFs", path="read"),
        "blends": Option("how stars that touch are fitted (default together)", choices=words.BLENDS),
        "errors": Option(
            "errors of the fit, or from stars put into the frame at known positions (default fit)",
            "--position-errors",
            choices=words.POSITION_ERRORS,
        ),
    },
)
SCRATCH = Option("for pixels while work goes on (default: system's)", type=Path, metavar="FOLDER")
CATALOGUING = {
    **DETECTOR,
    "threshold": Option("signal-to-noise ratio of all exposures together (default 5)", type=float),
    "fwhm": MEASURING["fwhm"],
    "psf": Option("moffat, effective, or a file or folder with PSFs (default: as the solution's)", path="read"),
    "zero_point": Option("magnitude of unit flux in a mean exposure (default: no magnitudes)", type=float),
    "positions": Option("given stars, x, y or ra, dec: their fluxes and upper limits", path="read", metavar="TABLE"),
    "scratch": SCRATCH,
}
ARTIFICIAL = {
    "artificial": Option("so many artificial stars, which tell the bias of faint fluxes", type=int, metavar="N"),
    "seed": Option("of the random numbers (default 0)", type=int),
}
COMPLETENESS = {name: option for name, option in CATALOGUING.items() if name != "positions"} | {
    "artificial": Option("stars put in (default 1000)", "--stars", default=1000, type=int, metavar="N"),
    "seed": ARTIFICIAL["seed"],
}
PSF_FILES = {"write_psf": Option("folder for the effective PSF of every exposure", type=Path, path="folder")}
INJECTING = {
    "fwhm": Option("of the stars put in, pixels (default: that of the frame's)", type=float, nargs="+"),
    "fluxes": Option("in units of the data (default: chosen by the frame)", type=float, nargs="+"),
    "n_positions": Option("stars for every flux and width (default 100)", type=int),
    "seed": Option("of the random numbers (default 0)", type=int),
}
CAMERA = {
    "camera": Option(
        "of exposures with several detectors: a camera file, results that found one, or gsaoi (default: headers)",
        metavar="CAMERA",
    )
}
MATCHING = Group(
    "matching",
    {
        "min_exposures": Option("keep stars seen in so many exposures (default 4)", type=int),
        "tolerance": Option("largest distance of a star in two exposures, pixels (default: found)", type=float),
        "isolation": Option("largest crowding of a star; inf keeps all (default 3)", type=float),
        "start": Option(
            "where stars lie: exposure, xshift, yshift [pixels], rotation [degrees]", metavar="TABLE", path="read"
        ),
        "keywords": Option("numbers in headers of frames that become columns", type=keywords, metavar="NAME,..."),
    },
)


SOLVING = Group(
    "solving",
    {
        "degree": Option("total degree, or auto (default 3)", type=word_or(int, "auto")),
        **KNOWN_STATIC,
        "prior_sigma": Option(
            "scatter of exposures around it; evidence: found from them",
            type=word_or(float, "evidence"),
            metavar="PIXELS",
        ),
        "validate": Option("of the stars, kept out of the fit to test the errors", type=float, metavar="FRACTION"),
        "static": Option(
            "static distortion of a detector: hold what is known, as exact; with its uncertainty (prior); fit one",
            choices=words.CAMERA,
        ),
        "layout": Option(
            "the same for the layout of the detectors of a camera (default: that of headers is fitted)",
            choices=words.CAMERA,
        ),
        "layout_sigma": Option(
            "how well the layout is known: shift [pixels], rotation [degrees], scale of each detector",
            type=pairs,
            metavar="shift=S,rotation=R",
        ),
        "dynamic": Option("of a camera: what has a distortion of its own in every exposure", choices=words.DYNAMIC),
        "exposure_degree": Option(
            "with --static fit, of single detectors: degree of what every exposure has for itself (default 1)", type=int
        ),
        "loss": Option("(default linear)", choices=words.LOSSES),
        "clip": Option("leave out what deviates by more sigma; 0: nothing (default 5)", type=float, none=0),
        "errors": Option("(default stated)", choices=words.ERRORS),
        "error_floor": Option("pixels, added in quadrature to every error", type=float),
        "motion": Option("motions of the stars, fitted beside their positions", choices=words.MOTIONS),
        "motion_sigma": Option(
            "scatter of proper motions, pixels a year; evidence: found",
            type=word_or(float, "evidence"),
            metavar="PX/YR",
        ),
        "motion_epoch": Option("year of the positions (default: mean)", type=float, metavar="YEAR"),
        "night_sigma": Option(
            "what exposures of a night have in common, by coefficient; 0: nothing (default: found)",
            type=float,
            metavar="PX",
        ),
        "pose_sigma": Option(
            "errors of the poses, if they are known: shift [pixels], rotation [degrees], scale; 0: exact",
            type=pairs,
            metavar="shift=S,rotation=R",
        ),
        "reference": Option(
            "catalogue whose positions are known, a solution, or gaia: from its archive", metavar="TABLE", path="read"
        ),
        "reference_error": Option(
            "of its positions where it states none, mas, else pixels; found: their size is found, whatever it states",
            type=word_or(float, "found"),
            metavar="MAS",
        ),
        "reference_degree": Option(
            "of a map that belongs to the catalogue alone (default: none)", type=int, metavar="D"
        ),
        "epoch": Option("of the exposures, for proper motions (default: header)", type=float, metavar="YEAR"),
        "pixel_scale": Option(
            "figures in mas too; helps to find the stars of a catalogue without a header WCS",
            type=float,
            metavar="ARCSEC",
        ),
        "terms": Option(
            f"what displaces stars beside the distortion, found too: {', '.join(words.TERMS)}",
            "--term",
            type=some_words(words.TERMS),
            action="extend",
            metavar="NAME,...",
        ),
    },
)
COADDING = Group(
    "co-adding",
    {
        "method": Option("(default clipped)", "--combine", choices=words.COMBINATIONS),
        "order": Option("of the spline (default 3)", type=number_or_name, choices=(*range(6), *words.ORDERS)),
        "algorithm": Option("of resampling (default interp)", choices=words.ALGORITHMS),
        "pixfrac": Option("with drizzle: side of the drops (default 1)", type=float),
        "kernel": Option("with drizzle: shape of the drops (default square)", choices=words.KERNELS),
        "conserve": Option("when pixels change size (default flux)", choices=words.CONSERVE),
        "match_background": Option(
            "leave the levels of the sky as they are", "--no-match-background", action="store_false"
        ),
        "weights": Option("of exposures (default noise)", choices=(*words.WEIGHTS, "equal"), none="equal"),
        "scale": Option("of fluxes (default auto)", choices=(*words.SCALES, "none"), none="none"),
        "extrapolated": Option("pixels outside the stars used (default flag)", choices=words.EXTRAPOLATED),
        "planes": Option(
            f"beside the image in the file, or all, or none (default {','.join(words.USUAL_PLANES)})",
            type=planes,
            metavar="UNCERT,...",
        ),
        "scratch": SCRATCH,
    },
)
GRID = {"grid": Option("image or header text whose grid is taken", type=Path, metavar="FILE", path="read")}
COMPARING = {"compare": Option("also correct by shifts, static map and relative polynomial", action="store_true")}
LAST_STEP = {
    "mosaic": Option("co-add nothing", "--no-mosaic", action="store_false"),
    "catalogue": Option("joint: every star measured in all exposures at once (default none)", choices=words.CATALOGUES),
    "artificial": Option("so many artificial stars: what the catalogue misses, in the report", type=int, metavar="N"),
}
EXPANDING = {
    "where": Option(
        "a file or name; the two maps of shifts in x and y, and perhaps two of their errors; or several headers of one "
        "camera",
        "sources",
        nargs="+",
        metavar="SOURCE",
        path="read",
    ),
    "shape": Option("of the detector, where it is not stated", type=int, nargs=2, metavar=("NY", "NX")),
    "degree": Option("total degree of the Legendre series (default 5)", type=int),
    "direction": Option("what the source does, where it is not stated", choices=words.DIRECTIONS),
    "origin": Option("coordinate of the first pixel (default 0)", type=int, choices=(0, 1)),
    "ext": Option("extension of FITS files, header of a text, place in an ASDF tree, id of a detector", type=extension),
    "frame": Option("where to end: frame of a gwcs, or idl or tel of an aperture"),
    "offset": Option(
        "detector pixel (from 0) of the first pixel of a smaller source", type=float, nargs=2, metavar=("X", "Y")
    ),
    "sigma": Option(
        "scatter of single exposures around it, pixels, or the word evidence", type=word_or(float, "evidence")
    ),
    "static_sigma": Option("uncertainty of it, pixels", type=float),
}
ATTACHING = {
    "out": Option("folder for copies", type=Path, path="folder", one_of="where", required=True),
    "in_place": Option(
        "change the frames themselves; with --head put texts beside them",
        action="store_true",
        one_of="where",
        required=True,
    ),
    "tpv": Option("header for SWarp and SCAMP (default: SIP)", action="store_true", one_of="header"),
    "head": Option("texts NAME.head for SWarp, no copies of frames", action="store_true", one_of="header"),
    "asdf_only": Option("leave the header alone, add the exact WCS", action="store_true", one_of="header"),
    "max_error": Option("of the header, pixels (default 0.001)", type=float),
    "overwrite": Option("replace copies and ASDF extensions that exist", action="store_true"),
}
