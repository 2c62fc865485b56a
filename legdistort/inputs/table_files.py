"""Tables of positions from files of many kinds, and tables of stars into files of some."""

import io
import logging
import re
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table, vstack

from ..exceptions import InputError
from ..runtime.checks import first_line
from ..runtime.outputs import replacing
from ..runtime.provenance import checksums
from . import column_contract, sextractor
from .exposure_names import check_exposure_name, exposure_name

log = logging.getLogger(__name__)

#: Formats that are written, by suffix.
WRITTEN = {".ecsv": "ascii.ecsv", ".fits": "fits", ".csv": "ascii.csv", ".vot": "votable", ".xml": "votable"}
_FITS = (".fits", ".fit", ".fts", ".ldac", ".gz")


def read_table(path, *, columns=None, origin=None):
    """Read a table of positions from a file.

    ECSV, FITS (FITS_LDAC too), VOTable, CSV, the text catalogues of SExtractor, and any other text with a header line,
    commented or not (star lists of FlyStar). Columns of SExtractor are understood by their names; so are ``xe`` and
    ``ye``. A table without a column ``exposure`` is taken for one exposure, named after the file; an LDAC file of
    several extensions for as many, ``NAME_1``, ``NAME_2`` ...

    Parameters
    ----------
    path : str or path
    columns : dict, optional
        ``{contract name: name in the file}``, see `legdistort.inputs.column_contract.rename`.
    origin : {0, 1}, optional
        Coordinate of the centre of the first pixel in the file. By default 1 for pixel columns of SExtractor, else 0.

    Returns
    -------
    `~astropy.table.Table`
        Pixels from 0; ``meta["inputs"]`` has the checksum of the file, ``meta["shapes"]`` the size of the image if
        the file tells.

    Raises
    ------
    InputError
        Naming the file.
    """
    path = Path(path)
    if origin not in (None, 0, 1):
        raise InputError(f"origin must be 0 or 1 (coordinate of the first pixel's centre), got {origin!r}")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        table = _understood(_read(path), columns or {}, origin)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if "exposure" not in table.colnames:
        name = exposure_name(path.stem)
        check_exposure_name(name, path)
        table["exposure"] = np.full(len(table), name)
        if "shape" in table.meta:
            table.meta["shapes"] = {name: table.meta.pop("shape")}
    inputs = table.meta.get("inputs")
    table.meta["inputs"] = (inputs if isinstance(inputs, dict) else {}) | checksums(path)
    return table


def stack(tables):
    """Tables of positions one below the other.

    Raises
    ------
    InputError
        If columns of the same name do not go together.
    """
    try:
        return vstack(tables, metadata_conflicts="silent")
    except Exception as error:  # astropy raises what it likes
        raise InputError(f"the tables do not go together: {first_line(error)}") from None


def _understood(table, columns, origin):
    """The table under the names of the contract, pixels from 0."""
    table, source = sextractor.understand(table, columns)
    source = columns.get("x", source)
    for ours, theirs in (("x_err", "xe"), ("y_err", "ye")):  # as FlyStar has it
        if theirs in table.colnames and ours not in {*columns, *table.colnames} and theirs not in columns.values():
            columns = columns | {ours: theirs}
    table = column_contract.rename(table, columns)
    if origin is None:
        origin = 1 if source is not None and sextractor.is_pixel(source) else 0
    if origin:
        log.info("pixels of the table count from 1; 1 is taken off")
        for name in ("x", "y"):
            if name in table.colnames:
                table[name] = column_contract.values(table, name, u.pix) - origin
    return table


def _read(path):
    """The table as it stands in the file; `InputError` without the name of the file."""
    with path.open("rb") as file:
        head = file.read(400)
    suffix = path.suffix.lower()
    try:
        if head.startswith(b"SIMPLE") or suffix in _FITS:
            return _read_fits(path)
        errors = []
        for kind in _text_formats(head, suffix):
            try:
                with path.open("rb") as file:
                    return Table.read(file, format=kind)
            except Exception as error:  # readers raise what they like
                errors.append(first_line(error))
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"cannot be read as a table: {first_line(error)}") from None
    raise InputError(f"cannot be read as a table: {errors[-1]}")


def _text_formats(head, suffix):
    if head.startswith(b"# %ECSV") or suffix == ".ecsv":
        return ["ascii.ecsv"]
    if b"<VOTABLE" in head or suffix in (".vot", ".xml"):
        return ["votable"]
    if suffix == ".csv":
        return ["ascii.csv"]
    if re.match(rb"#\s+1\s+[A-Z]\w+", head):
        return ["ascii.sextractor"]
    return ["ascii.commented_header", "ascii"]


def _read_fits(path):
    """The first table of a FITS file, or all detections of an LDAC file."""
    with path.open("rb") as file, fits.open(file, memmap=False) as hdus:
        tables = [k for k, hdu in enumerate(hdus) if isinstance(hdu, (fits.BinTableHDU, fits.TableHDU))]
        objects = [k for k in tables if hdus[k].name == "LDAC_OBJECTS"]
        if not tables:
            raise InputError(f"it has no table ({len(hdus)} HDUs, all images)")
        found = [_table_of(hdus, k) for k in objects or tables[:1]]
    if len(found) == 1:
        return found[0]
    shapes = {}
    for k, table in enumerate(found):
        name = f"{exposure_name(path.stem)}_{k + 1}"
        table["exposure"] = np.full(len(table), name)
        if "shape" in table.meta:
            shapes[name] = table.meta.pop("shape")
    out = stack(found)
    out.meta["shapes"] = shapes
    return out


def _table_of(hdus, k):
    """One table with the shape of its image, if the header of that stands before it (LDAC_IMHEAD)."""
    table = Table.read(hdus[k])
    table.meta = {key: value for key, value in table.meta.items() if key in ("shapes", "poses", "sky", "left_out")}
    if k and hdus[k - 1].name == "LDAC_IMHEAD":
        cards = np.asarray(hdus[k - 1].data.field(0)).astype("S").ravel().tolist()
        header = fits.Header.fromstring(b"".join(card.ljust(80) for card in cards))
        size = [header.get(f"Z{key}", header.get(key)) for key in ("NAXIS2", "NAXIS1")]
        if all(isinstance(n, int) and n > 0 for n in size):
            table.meta["shape"] = size
    return table


def write_stars(solution, path, *, overwrite=False):
    """Write the stars of a solution as ECSV, FITS, VOTable or CSV, by the suffix.

    Names, units and UCDs follow the Virtual Observatory (`legdistort.inputs.column_contract.STARS`).

    Parameters
    ----------
    solution : Solution
    path : str or path
        Ending in ``.ecsv``, ``.fits``, ``.vot``, ``.xml`` or ``.csv`` (without units).
    overwrite : bool

    Returns
    -------
    Path

    Raises
    ------
    InputError
        For another ending, or a file that exists.
    """
    write_by_ending(QTable(solution.stars), path, overwrite=overwrite)
    return Path(path)


def write_by_ending(table, path, *, overwrite=False):
    """Write a table in the format that the ending of the path says: as for `write_stars`."""
    kind = WRITTEN.get(Path(path).suffix.lower())
    if kind is None:
        raise InputError(f"{path}: the ending says the format, give one of {', '.join(WRITTEN)}")
    write_table(table, path, kind=kind, overwrite=overwrite)


def write_table(table, path, *, kind="ascii.ecsv", overwrite=False):
    """Write a table to a file, in any format that astropy knows; as `legdistort.runtime.outputs.replacing`."""
    with replacing(path, overwrite=overwrite) as file:
        if kind.startswith("ascii"):
            text = io.TextIOWrapper(file, encoding="utf-8", newline="")
            table.write(text, format=kind)
            text.detach()
        else:
            table.write(file, format=kind)
