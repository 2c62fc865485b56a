"""Columns of a table as plain arrays that any file can hold, and back."""

import numpy as np
from astropy import units as u
from astropy.table import Column, MaskedColumn
from astropy.utils.masked import Masked

from ..exceptions import AssumptionWarning, warn


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
