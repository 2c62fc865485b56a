"""Tables as they stand in files: which format a file has shows in its first bytes, seldom in its name.

A text file gives the names of its columns in a line above the numbers, commented or not. Comments may hold much more
than that (those of hst1pass fill 150 lines), so of the commented lines the last one is taken that has a name for every
column.
"""

import io
import re
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table, vstack

from ...exceptions import InputError
from ...runtime import checks
from ...runtime.fits_bytes import open_fits, unpacked

#: What missing values look like: empty fields, and the "null" of the Gaia archive.
_MISSING = [("", "0"), ("null", "0")]
_MOST_COLUMNS = 10_000
#: First words of the lists of DAOPHOT and ALLSTAR (Stetson), and the columns of ALLSTAR.
_STETSON = ["NL", "NX", "NY"]
_ALLSTAR = ("ID", "X", "Y", "MAG", "MERR", "SKY", "NITER", "CHI", "SHARP")
_NAME = re.compile(r"[A-Za-z_]\S*")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)
#: A name of one letter between dots, as wide as its column: ``#....u.... ....v....`` (hst1pass).
_DOTTED = re.compile(r"\.*[A-Za-z0-9]\.*")


def read(path):
    """Every table of a file, as it stands there, with what the file states about it.

    Parameters
    ----------
    path : `~pathlib.Path`

    Returns
    -------
    list of `~astropy.table.Table`
        One, or as many as an LDAC file has detections of images. ``meta`` has only what is understood: ``inputs``, and
        what `legdistort.matching.matches.Matches.to_meta` writes; ``shape`` of the image; ``program``, "hst1pass" or
        "DAOPHOT", where the columns do not show it.

    Raises
    ------
    InputError
        Without the name of the file.
    """
    content = path.read_bytes()
    try:
        file = unpacked(plain := io.BytesIO(content), "the file")
    except OSError as error:
        raise InputError(f"cannot be read as a table: damaged ({error})") from None
    content, name = file.getvalue(), path if file is plain else Path(path.stem)
    if not content.strip():
        raise InputError("the file is empty")
    suffix = name.suffix.lower()
    try:
        if content.startswith(b"SIMPLE") or suffix in (".fits", ".fit", ".fts", ".ldac"):
            return _read_fits(content)
        return [_read_text(content, suffix)]
    except InputError:
        raise
    except Exception as error:  # readers raise what they like
        raise InputError(f"cannot be read as a table: {checks.first_line(error)}") from None


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
        raise InputError(f"the tables do not go together: {checks.first_line(error)}") from None


# -- text


def _read_text(content, suffix):
    head = content[:2000]
    if head.startswith(b"# %ECSV") or suffix == ".ecsv":
        return _parsed(content, "ascii.ecsv", fill_values=_MISSING)
    if b"<VOTABLE" in head or suffix in (".vot", ".xml"):
        return _parsed(content, "votable")
    if suffix == ".csv" and not head.startswith(b"#"):
        return _parsed(content, "ascii.csv", fill_values=_MISSING)
    if re.match(rb"#\s+1\s+[A-Z]\w+", head):
        numbers = [int(n) for n in re.findall(rb"^#\s+(\d{1,30})\s", content, re.MULTILINE)]
        if max(numbers) > _MOST_COLUMNS:  # astropy would count them all
            raise InputError(f"cannot be read as a table: it has a column {max(numbers)}")
        return _parsed(content, "ascii.sextractor")
    if re.search(rb"^#N ", content, re.MULTILINE):
        table = _parsed(content, "ascii.daophot")
        for column in table.columns.values():
            if isinstance(column.unit, u.UnrecognizedUnit):  # "pixels", "magnitudes", "##"
                column.unit = u.pix if str(column.unit) == "pixels" else None
        return table
    lines = content.decode("utf-8", "replace").splitlines()
    if lines and lines[0].split()[:3] == _STETSON:
        return _read_stetson(lines)
    return _read_named(content, lines)


def _parsed(content, kind, **options):
    return Table.read(io.BytesIO(content), format=kind, **options)


def _read_stetson(lines):
    """A list of DAOPHOT: names of values and values in the first two lines, the size of the image among them."""
    values = lines[1].split()
    rows = [line.split() for line in lines[3:] if line.strip()]
    if any(len(row) != len(_ALLSTAR) for row in rows):
        raise InputError(
            f"a list of DAOPHOT whose rows are not the nine numbers of ALLSTAR ({' '.join(_ALLSTAR)}): give the list "
            "of ALLSTAR (.als), or a text with the names of its columns in the first line"
        )
    table = Table(np.array(rows, dtype=float).reshape(-1, len(_ALLSTAR)), names=_ALLSTAR)
    table.meta = {"program": "DAOPHOT", "shape": [int(values[2]), int(values[1])]}
    return table


def _read_named(content, lines):
    """A text whose comments, or whose first line, name the columns; without names they are ``col1``, ``col2`` ..."""
    comments = [line for line in lines if line.startswith("#")]
    first = next((line for line in lines if line.strip() and not line.startswith("#")), None)
    if first is None:
        raise InputError("cannot be read as a table: it has no rows")
    words = re.split(r"[\s,]+", first.strip())
    names = _commented_names(comments, len(words))
    if names is None and not all(_NUMBER.fullmatch(word) for word in words):
        return _parsed(content, "ascii")
    separator = {"delimiter": ","} if "," in first else {}
    given = {} if names is None else {"names": names}
    table = _parsed(content, "ascii.no_header", comment="#", guess=False, **given, **separator)
    table.meta = {}
    if names is not None and any(map(_is_dotted, comments)):
        table.meta["program"] = "hst1pass"
        epoch = re.search(r"^#\s*rDAT:\s*(\d{4}\.\d+)\s*$", "\n".join(comments), re.MULTILINE)
        if epoch:
            table["epoch"] = np.full(len(table), float(epoch[1]))
    return table


def _commented_names(comments, n_columns):
    """The names in the last comment line that has one for every column, or None."""
    for line in reversed(comments):
        words = [word.strip(".") for word in re.split(r"[\s,]+", line.lstrip("#").strip())]
        named = _is_dotted(line) or all(map(_NAME.fullmatch, words))
        if named and len(words) == len(set(words)) == n_columns:
            return words
    return None


def _is_dotted(line):
    return ".." in line and all(map(_DOTTED.fullmatch, line.lstrip("#").split()))


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
