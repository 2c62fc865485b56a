"""Coefficients of maps as tables."""

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..geometry import basis


def mode_table(**columns):
    """One row a mode and axis: ``axis``, ``x_degree``, ``y_degree``, then columns (2, n_modes) in pixels.

    Of the first mode, a shift, there is no row.
    """
    n = next(iter(columns.values())).shape[1]
    i, j = (np.tile(np.asarray(each)[1:], 2) for each in basis.orders(basis.degree_of(n)))
    out = QTable({"axis": np.repeat(["x", "y"], n - 1), "x_degree": i, "y_degree": j})
    for name, values in columns.items():
        out[name] = values[:, 1:].ravel() * u.pix
        out[name].info.format = ".4f"
    return out
