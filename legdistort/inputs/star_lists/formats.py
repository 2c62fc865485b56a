"""Tables as they stand in files: FITS or text, packed or not."""

import io
from pathlib import Path

from astropy.io import fits
from astropy.table import Table, vstack

from ...exceptions import InputError, without_astropy_warnings
from ...runtime import checks
from ...runtime.fits_bytes import open_fits, unpacked
from ...runtime.guards.offline import offline
from ..plain_columns import from_fits
from . import list_images, text_lists


def read(path):
    """Every table of a file, as it stands there, with what the file states about it.

    Parameters
    ----------
    path : `~pathlib.Path`

    Returns
    -------
    list of `~astropy.table.Table`
        One, or as many as an LDAC file has detections of images. ``meta`` has only what is understood: ``inputs``, and
        what `legdistort.matching.matches.Matches.to_meta` writes; ``image``, what its header states (`list_images`);
        ``program``, "hst1pass" or "DAOPHOT", where the columns do not show it.

    Raises
    ------
    InputError
        Without the name of the file.
    """
    try:
        with path.open("rb") as plain:
            file = unpacked(plain, "the file")
            content, name = file.read(), path if file is plain else Path(path.stem)
    except OSError as error:
        raise InputError(f"cannot be read as a table: damaged ({error})") from None
    if not content.strip():
        raise InputError("the file is empty; write it again, or leave it out")
    suffix = name.suffix.lower()
    try:
        with offline():
            return _tables(content, suffix)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # readers raise what they like
        raise InputError(f"cannot be read as a table: {checks.first_line(error)}{text_lists.AGAIN}") from None


def _tables(content, suffix):
    """The tables of the unpacked content of a file."""
    if content.startswith(b"SIMPLE") or suffix in (".fits", ".fit", ".fts", ".ldac"):
        return _read_fits(content)
    return [text_lists.read(content, suffix)]


def stack(tables):
    """Tables of positions one below the other; columns of those without rows need not go with the others.

    Raises
    ------
    InputError
        If columns of the same name do not go together.
    """
    try:
        return vstack([table for table in tables if len(table)] or tables[:1], metadata_conflicts="silent")
    except Exception as error:  # astropy raises what it likes
        raise InputError(f"the tables do not go together: {checks.first_line(error)}") from None


# -- FITS


def _read_fits(content):
    """The first table of a FITS file, or all detections of an LDAC file."""
    with open_fits(io.BytesIO(content), "cannot be read as a table") as hdus:
        tables = [k for k, hdu in enumerate(hdus) if isinstance(hdu, (fits.BinTableHDU, fits.TableHDU))]
        objects = [k for k in tables if hdus[k].name == "LDAC_OBJECTS"]
        if not tables:
            raise InputError(f"it has no table ({len(hdus)} HDUs, all images)")
        return [_table_of(hdus, k) for k in objects or tables[:1]]


def _table_of(hdus, k):
    """One table with what the header of its image states, if that stands before it (LDAC_IMHEAD)."""
    with without_astropy_warnings():  # of names of columns that are no words of ASCII, of units of other programs
        table = from_fits(Table.read(hdus[k]))
    table.meta = {key: value for key, value in table.meta.items() if key in ("shapes", "poses", "sky", "left_out")}
    if k and hdus[k - 1].name == "LDAC_IMHEAD":
        table.meta["image"] = list_images.stated(list_images.read_header(hdus[k - 1]))
    return table
