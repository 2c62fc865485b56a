"""Columns of a table as plain arrays that any file can hold, and back; columns of text as the numbers they state."""

import contextlib
import re

import numpy as np
from astropy import units as u
from astropy.table import Column, MaskedColumn
from astropy.utils.masked import Masked

from ..exceptions import AssumptionWarning, warn
from .exposure_names import in_header

#: A number as programs write it: with Fortran's D for E, and with three digits of an exponent that leave no place for
#: the letter (``1.5-103``).
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+))(?:[eEdD]([-+]?\d{1,4})|([-+]\d{3}))?|[-+]?inf(?:inity)?", re.I)
#: Words for no value: of archives, of IRAF (INDEF), of Fortran where a number is wider than its field (asterisks).
_NO_VALUE = re.compile(r"|null|none|[-+]?nan|n/?a|indef[a-z]*|\*+|-+|\.\.+", re.IGNORECASE)


def is_number(word):
    """Whether a word is a number, or stands for one that is not there (INDEF, asterisks, null)."""
    return bool(_NUMBER.fullmatch(word) or _NO_VALUE.fullmatch(word))


def is_text(column):
    """Whether a column holds text."""
    if not hasattr(column, "dtype"):
        return False
    if column.dtype.kind == "O":
        return any(isinstance(value, str | bytes) for value in np.ravel(column))
    return column.dtype.kind in "SU"


def numbers(column):
    """The numbers that a column of text states, and where it states none.

    Parameters
    ----------
    column : array_like of str

    Returns
    -------
    values : ndarray of float, shape (n,)
        NaN where there is no value: INDEF, asterisks, null, an empty cell.
    bad : ndarray of bool, shape (n,)
        Where there is something else than a number.
    """
    words = [word.strip().replace("\u2212", "-") for word in text(column).tolist()]  # a minus of typography
    if words and all(map(_NUMBER.fullmatch, words)):
        with contextlib.suppress(ValueError):  # of Fortran's forms
            return np.array(words, dtype=float), np.zeros(len(words), dtype=bool)
    values, bad = np.full(len(words), np.nan), np.zeros(len(words), dtype=bool)
    for k, word in enumerate(words):
        if found := _NUMBER.fullmatch(word):
            digits, exponent, bare = found.groups()
            values[k] = float(word if digits is None else f"{digits}e{exponent or bare or 0}")
        else:
            bad[k] = _NO_VALUE.fullmatch(word) is None
    return values, bad


def text(column):
    """A column of text, also as bytes or objects, as a plain array of str; empty where it is masked.

    Bytes are UTF-8; where one is not, those of the column are Latin-1, which keeps different names different.
    """
    mask = np.ma.getmaskarray(column) if np.ma.isMaskedArray(column) else np.zeros(np.shape(column), dtype=bool)
    words = np.asarray(column.filled("") if mask.any() and column.dtype.kind in "SU" else column)
    if words.dtype.kind == "O":
        flat = zip(words.ravel(), mask.ravel(), strict=True)
        kept = ["" if lost or word is None else word for word, lost in flat]
        kept = [word.decode("utf-8", "replace") if isinstance(word, bytes) else str(word) for word in kept]
        words = np.array(kept, dtype=str).reshape(words.shape)
    if words.dtype.kind == "S":
        try:
            words = np.char.decode(words, "utf-8")
        except UnicodeDecodeError:
            words = np.char.decode(words, "latin-1")
    return words


def with_text(table, words_of=text):
    """The table with a column that `words_of` makes of each that holds text, by default one of str."""
    out = table.copy(copy_data=False)
    for name in filter(lambda name: is_text(table[name]), table.colnames):
        column = table[name]
        mask = getattr(column, "mask", None)
        new = Column(words_of(column)) if mask is None else MaskedColumn(words_of(column), mask=mask)
        for attribute in ("unit", "description", "meta"):
            setattr(new.info, attribute, getattr(column.info, attribute))
        out.replace_column(name, new)
    return out


def for_fits(table):
    """The table with all text as FITS holds it: bytes, of UTF-8 where it is not ASCII; names of columns in ASCII."""
    out = with_text(table, lambda column: np.char.encode(text(column), "utf-8"))
    for name in table.colnames:
        if in_header(name) != name:
            out.rename_column(name, in_header(name))
    return out


def from_fits(table):
    """What `for_fits` made, with text as text again; of files of others too."""
    table = with_text(table)
    for name in table.colnames:
        if (own := re.sub(r"\\(x..|u....|U.{8})", _letter, name)) != name and own not in table.colnames:
            table.rename_column(name, own)
    return table


def _letter(escape):
    try:
        return escape[0].encode("ascii").decode("unicode_escape")
    except UnicodeError:
        return escape[0]


def plain_columns(table):
    """The table without columns of composed objects (coordinates, times), which plain arrays cannot hold.

    Warns
    -----
    AssumptionWarning
        Naming these columns.
    """
    others = [name for name in table.colnames if not _is_plain(table[name])]
    if others:
        warn(
            f"column{'s' * (len(others) > 1)} {', '.join(others)} of the observations: neither numbers nor text, "
            "left out of the file",
            AssumptionWarning,
        )
    return table[[name for name in table.colnames if name not in others]]


def _is_plain(column):
    """Whether a column holds numbers, booleans or text; text may be in objects."""
    if not isinstance(column, np.ndarray):
        return False
    if column.dtype.kind == "O":
        return all(isinstance(value, str) or value is np.ma.masked for value in column)
    return column.dtype.kind in "SU" or (column.dtype.kind in "biufc" and column.dtype != np.longdouble)


def plain(column):
    """A column as a dict of arrays: ``values``, ``unit`` (text, empty for none) and, if some are masked, ``mask``."""
    mask = np.asarray(getattr(column, "mask", np.zeros(column.shape, dtype=bool)))
    values = column.unmasked if isinstance(column, Masked) else getattr(column, "data", column)
    values = np.asarray(getattr(values, "value", values) if isinstance(values, u.Quantity) else np.ma.getdata(values))
    if values.dtype.kind == "O":
        values = np.where(mask, "", values).astype(str)
    out = {"values": values, "unit": str(getattr(column, "unit", None) or "")}
    return out | {"mask": mask} if mask.any() else out


def restored(tree):
    """What `plain` took apart."""
    values = np.array(tree["values"])
    unit = u.Unit(tree["unit"], parse_strict="silent") if tree["unit"] else None
    masked = "mask" in tree
    return MaskedColumn(values, mask=np.array(tree["mask"]), unit=unit) if masked else Column(values, unit=unit)
