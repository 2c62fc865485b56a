"""Expected errors of planned observations against the magnitude of the stars."""

import numpy as np
from astropy import units as u
from astropy.table import QTable, Table

from ..exceptions import InputError
from ..inputs import column_contract


def star_errors(prediction):
    """Magnitude, error of one position and joint error of every star that serves, per axis, as a `QTable`.

    Columns ``mag``, ``error`` (rms over the exposures that it is on) and ``joint_error`` (of its place in the solution,
    relative), mas where the scale of a pixel is known, else pixels.

    Raises
    ------
    InputError
        If the stars have no magnitudes.
    """
    stars, scale = prediction.settings.stars, prediction.settings.pixel_scale
    if not (isinstance(stars, Table) and "mag" in stars.colnames):
        raise InputError("the stars of this plan have no magnitudes: give instrument, or stars with a column mag")
    solved, measured = prediction.solution.stars, prediction.solution.residuals
    number = np.asarray(solved["star"]).astype(int)
    rows = np.searchsorted(number, np.asarray(measured["star"]).astype(int))
    count = np.bincount(rows, minlength=len(number))
    single = np.sqrt(np.bincount(rows, _square(measured), minlength=len(number)) / count)
    unit = u.pix if scale is None else 1e3 * scale * u.mas
    return QTable(
        {
            "mag": column_contract.values(stars, "mag", u.mag)[number],
            "error": (single * unit).to(u.pix if scale is None else u.mas),
            "joint_error": (np.sqrt(_square(solved)) * unit).to(u.pix if scale is None else u.mas),
        }
    )


def _square(table):
    """Mean over both axes of the squared errors of positions [pix^2]."""
    return sum(column_contract.values(table, name, u.pix) ** 2 for name in ("x_err", "y_err")) / 2


def by_magnitude(prediction, step=1.0):
    """Medians of `star_errors` in bins of magnitudes, with the number ``n`` of stars in each."""
    stars = star_errors(prediction)
    low = np.floor(stars["mag"] / step) * step
    rows = [
        {"mag": (each + step / 2), "n": np.count_nonzero(low == each)}
        | {name: np.median(stars[name][low == each]) for name in ("error", "joint_error")}
        for each in np.unique(low)
    ]
    table = QTable(rows)
    for name in ("error", "joint_error"):
        table[name].info.format = ".4g"
    return table
