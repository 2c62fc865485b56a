"""Stars drawn from a luminosity function: how many of every magnitude there are on an area of the sky."""

import numpy as np
from astropy import units as u

from ...exceptions import InputError

#: Of a column without a unit.
UNIT = u.mag**-1 * u.arcmin**-2
_STEP = 0.01  # magnitudes
#: More stars are not planned with: memory.
MOST = 100_000


def is_counts(table):
    """Whether a table is a luminosity function, not a list of stars."""
    return "density" in table.colnames and "x" not in table.colnames


def draw_magnitudes(table, area, limits, rng):
    """Magnitudes of the stars on an area, between two limits.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Columns ``mag`` and ``density``, stars a magnitude and square arcmin, or arcsec if its unit says so; linear in
        between, none beyond its ends.
    area : float
        Square arcsec.
    limits : (float, float)
        Magnitudes.
    rng : `~numpy.random.Generator`

    Returns
    -------
    ndarray, shape (n,)

    Raises
    ------
    InputError
        For columns that are missing or have bad values, and for more stars than can be planned with.
    """
    if "mag" not in table.colnames:
        raise InputError(f"a luminosity function has the columns mag and density; it has {', '.join(table.colnames)}")
    mag = np.asarray(getattr(table["mag"], "value", table["mag"]), dtype=float)
    density = _density(table["density"])
    if len(mag) < 2 or not (np.isfinite(mag).all() and np.all(np.diff(mag) > 0)):
        raise InputError("mag of a luminosity function must increase from row to row, two or more of them")
    if not (np.isfinite(density).all() and np.all(density >= 0) and np.any(density > 0)):
        raise InputError("density of a luminosity function must not be negative, nor zero everywhere")
    low, high = max(mag[0], limits[0]), min(mag[-1], limits[1])
    if not low < high:
        raise InputError(
            f"the luminosity function from {mag[0]:g} to {mag[-1]:g} mag has no star that is measured, from "
            f"{limits[0]:.2f} to {limits[1]:.2f} mag: change exposure_time or min_snr"
        )
    fine = np.linspace(low, high, int((high - low) / _STEP) + 2)
    part = np.diff(fine) * (np.interp(fine, mag, density)[1:] + np.interp(fine, mag, density)[:-1]) / 2
    total = np.concatenate([[0.0], np.cumsum(part)])
    count = round(total[-1] * area)
    if count > MOST:
        raise InputError(
            f"{count} stars are measured on {area / 3600:.3g} square arcmin, more than {MOST}: give a higher min_snr, "
            "or a luminosity function that ends earlier"
        )
    return np.interp(rng.uniform(0, total[-1], count), total, fine)


def _density(column):
    """Stars a magnitude and square arcsec."""
    unit = getattr(column, "unit", None)
    if unit is None:
        return np.asarray(column, dtype=float) * UNIT.to(u.mag**-1 * u.arcsec**-2)
    unit = u.Unit(unit)
    for wanted in (u.mag**-1 * u.arcsec**-2, u.arcsec**-2):  # "per magnitude" need not be said
        if unit.is_equivalent(wanted):
            return np.asarray(getattr(column, "value", column), dtype=float) * unit.to(wanted)
    raise InputError(f"density must be stars a magnitude and square arcmin or arcsec, got the unit {unit}")
