"""What is given on the command line: tables, cameras, priors, grids, matched positions, sized terms."""

import logging
import re
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy import units as u

import legdistort

from ..assessment.nights.night_data import EXACT
from ..coaddition.grids import given_grid, read_grid
from ..exceptions import AssumptionWarning, InputError, some_of, warn
from ..inputs import column_contract
from ..inputs.exposure_names import left_out_by
from ..inputs.frames.header_texts import headers_of, read_text
from ..inputs.sky_wcs import image_wcs
from ..inputs.star_lists.given_dates import read_dates, with_dates
from ..inputs.star_lists.list_images import with_own_dates
from ..inputs.table_files import read_table, told_apart
from ..priors.from_files import no_map
from ..priors.prior import EVIDENCE, HEADER, HeaderPrior
from ..priors.storage import open_prior
from ..runtime.asdf_files import entry_of
from ..runtime.checks import check_is_file
from ..runtime.fits_bytes import looks_like_fits
from ..runtime.words import UNSTATED
from ..solving.choices.degree_choice import AUTO, HIGHEST
from ..solving.options import DEGREE
from .arguments import given
from .options import EXPANDING, SOLVING
from .planning_options import EXPOSURES, INSTRUMENT, PREDICTING

log = logging.getLogger(__name__)

#: Median error of positions [pix] that none have: the column is another.
LARGE = 5.0


def refuse(given, reason):
    """Raise `InputError` for the first of ``{name: value}`` that was given: it would be ignored."""
    for name, value in given.items():
        if value not in (None, False):
            raise InputError(f"--{name.replace('_', '-')} {reason}: leave it out")


def sized_term(name, sizes):
    """A `legdistort.Term` of a forecast by its sizes, in order."""
    names = ("size", "length", "smoothness", "ratio", "angle") if name == "turbulence" else ("sigma",)
    if len(sizes) > len(names):
        raise InputError(f"--term {name} has {len(sizes)} sizes: it takes {', '.join(names)}")
    return legdistort.Term.named(name, **dict(zip(names, sizes, strict=False)))


def read_given(path, a, contract=None):
    """The table in a file; where it does not keep a contract, the message names the file."""
    table = read_table(path, columns=dict(a.columns), origin=a.origin, error=a.error)
    if contract is not None and len(table):
        column_contract.check(table, contract, str(path))
    return table


def read_lists(a, contract):
    """The tables of a command line by file, with names of exposures that differ, and the dates of ``--dates``."""
    read = told_apart([(Path(path), read_given(path, a, contract)) for path in a.tables])
    filled = [a.error is not None and len(table) and np.all(_errors(table) == a.error) for table in read.values()]
    if 0 < sum(filled) < len(filled):
        log.info("all positions come without an error in %s", _some(read, filled))
    undated = ["epoch" not in table.colnames for table in read.values()]
    if a.dates is None and not a.wcs and 0 < sum(undated) < len(undated):
        log.info("no date is known of %s: --dates TABLE, with those of all, states them", _some(read, undated))
    _warn_of_large_errors(read)
    if a.dates is not None:
        return with_dates(read, read_dates(a.dates), a.dates)
    return read if a.wcs else with_own_dates(read)


def _some(read, which):
    """Some of the lists ``{path: table}``, in words."""
    names = [path.name for path, is_one in zip(read, which, strict=True) if is_one]
    return f"{len(names)} of {len(read)} lists ({some_of(names, 6)})"


def _errors(table):
    """Errors of the positions of a table (2, n), pixels."""
    return np.array([column_contract.values(table, name, u.pix) for name in ("x_err", "y_err")])


def _warn_of_large_errors(read):
    """Warn of tables, ``{path: table}``, whose errors are none: lists of another width have another column there."""
    errors = {path: float(np.median(_errors(table))) for path, table in read.items() if len(table)}
    if large := {str(path): error for path, error in errors.items() if error > LARGE}:
        named = some_of([f"{path}: {error:.3g}" for path, error in large.items()], 6)
        warn(
            f"errors of positions are larger than {LARGE:g} pixels in the median in {len(large)} of {len(read)} lists "
            f"({named}): if another column stands where x_err and y_err are taken from, as in lists that have fewer "
            "columns, name it for these apart (--columns), or give an error (--error)",
            AssumptionWarning,
        )


def given_camera(given):
    """The camera of ``--camera``: gsaoi, that of a file, or what a solution found, its file or folder; None without."""
    if not given or given == "gsaoi":
        return legdistort.Camera.gsaoi() if given else None
    solved = Path(given).is_dir() or entry_of(given, ["legdistort"]) is not None
    return legdistort.Solution.read(given).camera if solved else legdistort.Camera.read(given)


def given_plan(a):
    """The arguments of `legdistort.predict`."""
    keywords = given(a, PREDICTING) | {"prior": read_prior(a), "instrument": _given_instrument(a)}
    keywords.pop("static_sigma", None)
    if a.stars is not None:
        keywords["stars"] = read_given(a.stars, a)
    else:
        refuse({"columns": a.columns or None, "origin": a.origin, "error": a.error}, "is for the table of --stars")
    if a.camera:
        refuse({"shape": a.shape}, "comes from --camera")
    if a.shape is not None:
        keywords["shape"] = tuple(a.shape)
    return keywords | {"camera": given_camera(a.camera), "terms": [sized_term(*each) for each in a.term or ()]}


def _given_instrument(a):
    """The instrument of ``--instrument`` and what goes with it; None without."""
    words = given(a, INSTRUMENT, EXPOSURES)
    if a.instrument is None:
        refuse({name.removeprefix("n_"): value for name, value in words.items()}, "is for --instrument")
        return None
    for needed in ("psf", "exposure_time"):
        if needed not in words:
            raise InputError(f"--instrument needs --{needed.replace('_', '-')} too")
    return legdistort.Instrument.named(**words)


def stated_camera(a):
    """The camera of ``legdistort camera``, that of a solution or by the headers of a frame, and a caution in words.

    Raises
    ------
    InputError
        For images without a focal plane, and for a text that has not one header for every image.
    """
    if Path(a.solution).is_dir() or not _is_frame(a.solution):
        refuse({"ext": a.ext, "headers": a.headers}, "is for a frame")
        solution = legdistort.Solution.read(a.solution, max_bytes=a.max_bytes)
        if not solution.camera.has_focal_plane:
            raise InputError(
                f"{a.solution} is of images without a focal plane: legdistort nights {a.solution} --out {a.out} writes "
                "what it found of their static distortion"
            )
        errors = solution.estimate.uncertainty.camera
        words = "; it did not settle (check camera), and its errors do not hold" if errors and errors.unsettled else ""
        return solution.camera, words
    exposures = legdistort.read_exposures([a.solution], ext=a.ext)
    if a.headers is not None:
        headers = headers_of(read_text(Path(a.headers)))
        if len(headers) != len(exposures):
            raise InputError(
                f"{a.headers} has {len(headers)} headers, and {a.solution} {len(exposures)} images: give the text of "
                "this frame, or choose the images (--ext)"
            )
        exposures = [
            replace(exposure, wcs=image_wcs(header, None)) for exposure, header in zip(exposures, headers, strict=True)
        ]
    if len(exposures) < 2:
        raise InputError(
            f"{a.solution} has one image: legdistort prior {a.headers or a.solution} --out {a.out} writes that"
        )
    return legdistort.Camera.from_exposures(exposures), "; errors are not known"


def _is_frame(path):
    check_is_file(path)
    return looks_like_fits(Path(path))


def read_matches(a):
    """The `Matches` in the tables of a command line, those of several fields joined, and their inputs."""
    paths = [Path(path) for path in a.tables]
    if len({path.resolve() for path in paths}) < len(paths):
        raise InputError("a table stands twice on the command line: every field has one of its own")
    read = {path: _read(path, a) for path in paths}
    inputs = {name: checksum for _, files in read.values() for name, checksum in files.items()}
    matches = _joined(read)
    reasons = left_out_by(a.without, matches.names, matches.nights)
    return matches.without(reasons) if reasons else matches, inputs


def _joined(read):
    """The matches of ``{path: (matches, inputs)}``, as fields if there are several."""
    if len(read) == 1:
        ((matches, _),) = read.values()
        return matches
    stems = [path.stem for path in read]
    labels = stems if len(set(stems)) == len(stems) else [path.resolve().parent.name for path in read]
    if len(set(labels)) < len(labels):
        raise InputError(f"tables of fields must differ in their names, or those of their folders: {', '.join(stems)}")
    fields = {label: matches for label, (matches, _) in zip(labels, read.values(), strict=True)}
    return legdistort.Matches.of_fields(fields)


@contextmanager
def without_options_of_prior(a):
    """A block that reads a prior; if it asks for an option that the command has not, `prior` is said to have it."""
    try:
        yield
    except InputError as error:
        asked = set(re.findall(r"\(--(\w+)", str(error))) & set(EXPANDING)
        if all(name in a for name in asked):
            raise
        raise InputError(f"{error}; legdistort prior has that option, and what it writes can be given here") from None


def read_prior(a, usual_shape=None):
    """The `Prior` of ``--prior``, as `Prior.from_file`; without that, a distortion of which only the size is known."""
    text, known = a.prior, {"shape": getattr(a, "shape", None), "static_sigma": a.static_sigma}
    if text == HEADER and not Path(text).exists():
        raise InputError(
            "--prior header is for run, which reads frames: write the distortion of one of them with legdistort prior "
            "FRAME --out prior.asdf, and give --prior prior.asdf; --static fit finds those of several detectors"
        )
    if text is None:
        return None if a.static_sigma is None else legdistort.Prior(None, static_sigma=a.static_sigma)
    with without_options_of_prior(a):
        return open_prior(text, legdistort.Prior, **known, usual_shape=usual_shape)


def given_solving(a, matches=None):
    """The arguments of `solve`; the prior read, no static distortion if there is none, with the widths asked for.

    Without `matches`, of which the shape of the detector is known, those of `run`, which has the headers of its frames.
    """
    keywords = given(a, SOLVING)
    static_sigma = keywords.pop("static_sigma", None)
    sigma = keywords.pop("prior_sigma", None)
    if matches is None and a.prior == HEADER:
        return keywords | {"prior": HeaderPrior(sigma, static_sigma)}
    shapes = set() if matches is None else set(matches.shapes.values())
    prior = read_prior(a, usual_shape=shapes.pop() if len(shapes) == 1 else None)
    if sigma is not None:
        degree = 0 if sigma == EVIDENCE else HIGHEST if a.degree == AUTO else keywords.get("degree", DEGREE)
        prior = (prior or legdistort.Prior([[0.0], [0.0]], source=UNSTATED)).with_sigma(sigma, degree=degree)
    return keywords | {"prior": prior}


def given_prior(a):
    """The `Prior` of the sources of a command line, and how it was made, in words.

    One source, or maps of shifts, make it by themselves. Of several, such as headers of one camera, it is the mean,
    with their scatter as its width (`legdistort.combine_nights`).
    """
    asked = given(a, EXPANDING)
    paths = asked["where"]
    if len(paths) == 1 or (not any(map(_is_solved, paths)) and no_map(paths) is None):
        return legdistort.Prior.from_file(**asked), ""
    if len({Path(path).resolve() for path in paths}) < len(paths):
        raise InputError("a source stands twice on the command line: it would count twice")
    if solved := [path for path in paths if _is_solved(path)]:
        raise InputError(
            f"{solved[0]} is a solution, or of nights: legdistort nights combines such ones, with priors too, and the "
            "camera file that it writes is a prior"
        )
    each = [legdistort.Prior.from_file(**asked | {"where": path}) for path in paths]
    found = legdistort.combine_nights(each)
    made = found.prior()
    files = {name: checksum for prior in each for name, checksum in _files_of(prior).items()}
    record = made.source | {"kind": "several", "name": ", ".join(paths), "files": files}
    made = made.with_static_sigma(asked["static_sigma"]) if "static_sigma" in asked else made
    known = {"source": record, "truncation": max(prior.truncation for prior in each)}
    made = replace(made, **known | {name: asked[name] for name in ("sigma",) if name in asked})
    words = f"mean of {len(each)} sources"
    return made, words if a.static_sigma is not None else f"{words}; {_said_of_scatter(found.scatter, len(each))}"


def _is_solved(path):
    """Whether a path leads to a solution or to combined nights, which say more than a map."""
    return Path(path).is_dir() or entry_of(path, ["legdistort", "legdistort_nights"]) is not None


def _files_of(prior):
    return prior.source.get("files", {}) if isinstance(prior.source, dict) else {}


def _said_of_scatter(scatter, n):
    """The scatter of n sources, by degree from 1, and how well they tell it: that of Gaussian deviates."""
    count = [2 if degree == 1 else 2 * (degree + 1) for degree in range(1, len(scatter) + 1)]
    errors = [size / (2 * (n - 1) * k) ** 0.5 for size, k in zip(scatter, count, strict=True)]
    sizes = ", ".join(
        f"{size:.2g} +- {error:.1g}" if size >= EXACT else f"below {EXACT}"
        for size, error in zip(scatter, errors, strict=True)
    )
    degrees = "degree 1, 2, ..." if len(scatter) > 1 else "degree 1"
    return f"static_sigma is their scatter, {sizes} px a coefficient at {degrees}, with the error of the mean"


def grid_in(path, solution):
    """The grid in a file, or None, known to be one for the solution before any frame is read."""
    if path is None:
        return None
    grid = read_grid(path)
    try:
        given_grid(grid, solution.sky)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return grid


def known_file(path):
    """The camera, nights or prior in a file that holds one of these and no solution; else None."""
    kinds = {
        "legdistort_nights": legdistort.CombinedNights,
        "legdistort_camera": legdistort.Camera,
        "legdistort_prior": legdistort.Prior,
    }
    entry = entry_of(path, kinds)
    return None if entry is None else kinds[entry].read(path)


def _read(path, a):
    """The `Matches` in a table, and its inputs."""
    table = read_given(path, a, column_contract.MATCHED)
    known = legdistort.Matches.read_meta(table.meta)
    known |= {"shape": tuple(a.shape)} if a.shape else {}
    known |= {"camera": given_camera(a.camera)} if a.camera else {}
    if known["camera"]:
        refuse({"shape": a.shape}, "comes from the camera")
    else:
        refuse({"layout": a.layout}, "is for the detectors of a camera")
        if known["shape"] is None:
            raise InputError(f"{path} does not state the size of the detectors: give --shape NY NX")
    return legdistort.Matches.from_table(table, **known), table.meta["inputs"]
