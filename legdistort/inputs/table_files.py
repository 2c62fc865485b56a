"""Tables of positions from files of many kinds, and tables of stars into files of some."""

import io
import logging
import re
from numbers import Real
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import Column, QTable

from ..exceptions import InputError, some_of, without_astropy_warnings
from ..runtime import outputs, provenance
from ..runtime.checks import check_is_file
from . import column_contract, exposure_names
from .plain_columns import for_fits, with_text
from .star_lists import dialects, formats, list_images

log = logging.getLogger(__name__)

#: Formats that are written, by suffix.
WRITTEN = {
    ".ecsv": "ascii.ecsv", ".fits": "fits", ".csv": "ascii.csv", ".txt": "ascii.basic", ".dat": "ascii.basic",
    ".vot": "votable", ".xml": "votable",
}  # fmt: skip


def read_table(path, *, columns=None, origin=None, error=None):
    """Read a table of positions from a file.

    ECSV, FITS (FITS_LDAC too), VOTable, IPAC, CSV, all also packed with gzip or bzip2; lists of SExtractor, FlyStar,
    hst1pass, DAOPHOT and photutils, whose columns are understood (`legdistort.inputs.star_lists.dialects`); and any
    other text whose columns are named in its first line or in a comment. A table without a column ``exposure`` is taken
    for one exposure, named after the file; an LDAC file of several extensions that its headers (``LDAC_IMHEAD``) tell
    to be detectors of one camera gets a column ``detector``; another one, or a list of several chips, is taken for as
    many exposures, ``NAME_1``, ``NAME_2`` ...

    Parameters
    ----------
    path : str or path
    columns : dict, optional
        ``{contract name: name in the file}``, see `legdistort.inputs.column_contract.rename`.
    origin : {0, 1}, optional
        Coordinate of the centre of the first pixel in the file. By default 1 for SExtractor, hst1pass and DAOPHOT, else
        0.
    error : float, optional
        Standard deviation [pix] per axis of positions that come without one (no column, no value, or zero).

    Returns
    -------
    `~astropy.table.Table`
        Pixels from 0; ``meta["inputs"]`` has the checksum of the file, ``meta["shapes"]`` the size of the image if
        the file names it, ``meta["images"]`` what else the header of the image states.

    Raises
    ------
    InputError
        Naming the file, and the row and column that cannot be read.
    """
    path = Path(path)
    if origin not in (None, 0, 1):
        raise InputError(f"origin must be 0 or 1 (coordinate of the first pixel's centre), got {origin!r}")
    if error is not None and not (isinstance(error, Real) and 0 < error < np.inf):
        raise InputError(f"error must be a positive number of pixels, got {error!r}")
    check_is_file(path)
    try:
        with provenance.unchanged(path):
            found, own = formats.read(path), provenance.checksums(path)
        parts = dict(enumerate(found, start=1)) if len(found) > 1 else dialects.chips(found[0]) or {None: found[0]}
        parts = {k: _understood(part, columns or {}, origin, error) for k, part in parts.items()}
    except InputError as fault:
        raise InputError(f"{path}: {fault}") from None
    table = _united(parts, path)
    inputs = table.meta.get("inputs")
    table.meta["inputs"] = (inputs if isinstance(inputs, dict) else {}) | own
    return table


def named_after(table, exposures, path):
    """A table with its exposures called as frames are: each has the name of one of these, begins with it, or ends else.

    Of frames that one detector took each it gets a column ``detector``, too.

    Parameters
    ----------
    table : `~astropy.table.QTable`
    exposures : list of Exposure
    path : str or path
        Of the table, for messages.

    Raises
    ------
    InputError
        For an exposure of the table that is none of the frames.
    """
    known = {whole: (whole, None) for whole in map(exposure_names.whole_name, exposures)}
    known |= {each.name: (exposure_names.whole_name(each), each.detector) for each in exposures}
    labels, found = column_contract.labels(table, "exposure"), {}
    for name in np.unique(labels).tolist():
        if (frame := _frame_of(name, known)) is None:
            some = some_of(sorted(known), 6)
            raise InputError(
                f"{path}: exposure {name} is none of the frames ({some}): call the table as its frame, or give it a "
                "column exposure with the name of that"
            )
        found[name] = known[frame]
    out = table.copy(copy_data=False)
    out["exposure"] = np.array([found[name][0] for name in labels.tolist()])
    out["exposure"].description = table["exposure"].description
    detectors = [found[name][1] for name in labels.tolist()]
    if own := _by_image(table, found, exposures, path):
        detectors = [own[name] for name in list_images.names_of_rows(table)]
        out.remove_columns({"detector"} & set(out.colnames))
        whole, shapes = out["exposure"][0], table.meta.get("shapes", {})
        out.meta["shapes"] = {
            exposure_names.detector_name(whole, own[name]): shapes[name] for name in own if name in shapes
        }
    if "detector" not in out.colnames and None not in detectors:
        out["detector"] = np.array(detectors, dtype=str)
    return out


def _by_image(table, found, exposures, path):
    """Detectors of frames by the images of an LDAC list, ``{name of an image: id}``; empty where names tell them."""
    images = table.meta.get("images", {})
    wholes = {whole for whole, detector in found.values() if detector is None}
    ids = {whole: [e.detector for e in exposures if exposure_names.whole_name(e) == whole] for whole in wholes}
    if not images or len(wholes) != 1 or len(wholes) < len(set(found.values())) or None in next(iter(ids.values())):
        return {}
    ((whole, known),) = ids.items()
    return list_images.detectors_by_frames(images, whole, known, path)


def told_apart(tables):
    """Tables of files with exposures whose names differ: those called as their files, by the folders of these.

    Parameters
    ----------
    tables : list of (Path, Table)
        As `read_table` gives them.

    Returns
    -------
    dict of Path to Table

    Raises
    ------
    InputError
        For a file that stands twice, naming it both ways.
    """
    real = {}
    for path, _ in tables:
        if (first := real.setdefault(path.resolve(), path)) is not path:
            raise InputError(f"{first} and {path} are one file: give it once")
    of_file = [path for path, table in tables if _is_of_file(table)]
    names = list(map(exposure_names.list_name, of_file))
    marks = dict(zip(of_file, exposure_names.folder_marks(names, of_file), strict=True))
    if any(marks.values()):
        log.info("%s", exposure_names.folders_in_words(marks[of_file[0]] + names[0]))
    return {path: with_mark(table, marks.get(path), path) for path, table in tables}


def names_of_images(tables):
    """Names of the exposures in tables of files, or of the parts of them that single detectors took.

    Raises
    ------
    InputError
        For one that is in two tables, ``{path: table}``, naming both.
    """
    origins = {}
    for path, table in tables.items():
        for name in _images_of(table):
            if (first := origins.setdefault(name, path)) is not path:
                raise InputError(
                    f"exposure {name} is in two tables, {first} and {path}: leave one out, rename a file, or give the "
                    "exposures other names in a column exposure"
                )
    return list(origins)


def shapes_for_match(tables, shapes):
    """Shapes by detector, where all tables distinguish these, else as they are, by exposure; None for none.

    Raises
    ------
    InputError
        For a detector that has two.
    """
    if not all("detector" in table.colnames for table in tables):
        return shapes or None
    out = {}
    for table in tables:
        for name, detector in zip(
            list_images.names_of_rows(table), np.asarray(table["detector"]).astype(str), strict=True
        ):
            if name in shapes and out.setdefault(str(detector), shapes[name]) != shapes[name]:
                raise InputError(
                    f"detector {detector} has {shapes[name]} pixels (ny, nx) in {name} and {out[str(detector)]} "
                    "elsewhere: match the lists of one readout apart"
                )
    return out or None


def with_mark(table, mark, path):
    """The table of a file with something before the names of its exposures, and of the file itself."""
    if not mark:
        return table
    out = table.copy(copy_data=False)
    out["exposure"] = Column(
        [mark + name for name in table["exposure"]], dtype=str, description=column_contract.OF_FILE
    )
    for name in set(out["exposure"]):
        exposure_names.check_exposure_name(name, path)
    for key in {"shapes", "images"} & set(out.meta):
        out.meta[key] = {mark + name: each for name, each in out.meta[key].items()}
    out.meta["inputs"] = {mark * (name == path.name) + name: each for name, each in out.meta["inputs"].items()}
    return out


def named_as_known(table, path, known):
    """The table of a file with its exposure called as known ones are, which may have a folder before their names.

    Parameters
    ----------
    table : Table
    path : str or path
        Of its file, of which the exposure has its name; other tables stay as they are.
    known : iterable of str
    """
    path = Path(path)
    if not _is_of_file(table):
        return table
    return with_mark(table, exposure_names.folder_mark(exposure_names.list_name(path), path, known), path)


def _is_of_file(table):
    return "exposure" in table.colnames and table["exposure"].info.description == column_contract.OF_FILE


def _images_of(table):
    """Names of the exposures in a table, or of the parts of them that single detectors took."""
    if "detector" not in table.colnames:
        return list(dict.fromkeys(table["exposure"]))
    pairs = zip(table["exposure"], table["detector"], strict=True)
    return list(dict.fromkeys(exposure_names.detector_name(*pair) for pair in pairs))


def _frame_of(name, frames):
    """The longest name of a frame that a name begins with, or the only one that differs by its last word; or None."""
    begins = [frame for frame in frames if re.match(rf"{re.escape(frame)}(?![A-Za-z0-9])", str(name))]
    return max(begins, key=len, default=exposure_names.alike(str(name), frames))


def _united(parts, path):
    """One table of the parts of a file, ``{number: table}``: detectors of one exposure, or exposures of their own."""
    shapes, images, detectors = {}, {}, list_images.detectors_of_tables(parts)
    for number, table in parts.items():
        image = table.meta.pop("image", {})
        if "exposure" not in table.colnames:
            apart = number is not None and number not in detectors
            name = exposure_names.list_name(path) + (f"_{number}" if apart else "")
            exposure_names.check_exposure_name(name, path)
            table["exposure"] = Column(np.full(len(table), name), description=column_contract.OF_FILE)
            if number in detectors:
                table["detector"] = np.full(len(table), detectors[number])
                name = exposure_names.detector_name(name, detectors[number])
            shape = table.meta.pop("shape", image.pop("shape", None))
            shapes |= {} if shape is None else {name: shape}
            images |= {name: image} if image else {}
    out = formats.stack(list(parts.values())) if len(parts) > 1 else next(iter(parts.values()))
    out.meta |= {key: value for key, value in (("shapes", shapes), ("images", images)) if value}
    return out


def _understood(table, columns, origin, error):
    """The table under the names of the contract, pixels from 0."""
    table, columns, usual = dialects.understand(table, columns, without_errors=error is not None)
    for ours, theirs in (("x_err", "xe"), ("y_err", "ye")):  # in other lists than those of FlyStar, too
        if theirs in table.colnames and ours not in {*columns, *table.colnames} and theirs not in columns.values():
            columns = columns | {ours: theirs}
    table = column_contract.rename(table, columns)
    origin = usual if origin is None else origin
    if origin:
        log.info("pixels of the table count from 1; 1 is taken off")
        for name in {"x", "y"} & set(table.colnames):
            table[name] = column_contract.values(table, name, u.pix) - origin
    if error is not None:
        _fill_errors(table, error)
    return table


def _fill_errors(table, error):
    """One error for all positions of a table that come without one."""
    if not {"x", "y"} <= set(table.colnames):
        return
    filled = np.zeros(len(table), dtype=bool)
    for name in ("x_err", "y_err"):
        stated = np.full(len(table), np.nan)
        if name in table.colnames:
            stated = column_contract.values(table, name, u.pix)
        bad = ~(np.isfinite(stated) & (stated > 0))
        table[name] = np.where(bad, error, stated) * u.pix
        filled |= bad
    if filled.any():  # in the same words of every list, which are said once
        words = "all positions of a list" if filled.all() else "some positions of a list"
        log.info("where %s come without an error, it is taken as %g pixels", words, error)


def write_stars(solution, path, *, epoch=None, overwrite=False):
    """Write the stars of a solution as ECSV, FITS, VOTable, CSV or plain text, by the suffix.

    Names, units and UCDs follow the Virtual Observatory (`legdistort.inputs.column_contract.STARS`).

    Parameters
    ----------
    solution : Solution
    path : str or path
        Ending in ``.ecsv``, ``.fits``, ``.vot``, ``.xml``, or without units ``.csv``, ``.txt``, ``.dat``.
    epoch : float or `~astropy.time.Time`, optional
        Where they are at this time instead: `Solution.stars_at`.
    overwrite : bool

    Returns
    -------
    Path

    Raises
    ------
    InputError
        For another ending, a file that exists, or an epoch where motions were not fitted.
    """
    stars = solution.stars if epoch is None else solution.stars_at(epoch)
    write_by_ending(QTable(stars), path, overwrite=overwrite)
    return Path(path)


def write_by_ending(table, path, *, overwrite=False):
    """Write a table in the format that the ending of the path selects: as for `write_stars`."""
    kind = WRITTEN.get(Path(path).suffix.lower())
    table = table[[name for name in table.colnames if not isinstance(table[name], SkyCoord)]]  # ra, dec are beside it
    if kind is None:
        raise InputError(f"{path}: the ending selects the format, give one of {', '.join(WRITTEN)}")
    write_table(table, path, kind=kind, overwrite=overwrite)


def write_table(table, path, *, kind="ascii.ecsv", overwrite=False):
    """Write a table to a file, in any format that astropy knows; as `legdistort.runtime.outputs.replacing`."""
    with outputs.replacing(path, overwrite=overwrite) as file:
        if kind.startswith("ascii"):
            text = io.TextIOWrapper(file, encoding="utf-8", newline="")
            table.write(text, format=kind)
            text.detach()
        elif kind == "fits":
            with without_astropy_warnings():  # of names of columns that are no words of ASCII
                for_fits(table).write(file, format=kind)
        elif kind == "votable":
            _as_votable(table).to_xml(file)
        else:
            with_text(table).write(file, format=kind)


def _as_votable(table):
    """A table as a VOTable with what its ``meta`` says in a word or a number, which astropy leaves out."""
    from astropy.io.votable import from_table, tree

    made = from_table(with_text(table))
    said = {key: str(value) for key, value in table.meta.items() if isinstance(value, str | float | int)}
    made.get_first_table().infos.extend(tree.Info(name=key, value=value) for key, value in said.items())
    return made


def records(table):
    """The rows of a table for JSON, which knows no NaN."""
    rows = [zip(table.colnames, row, strict=True) for row in table.as_array().tolist()]
    return [{name: value if value == value else None for name, value in row} for row in rows]
