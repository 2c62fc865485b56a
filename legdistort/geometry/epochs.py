"""When exposures were taken, in Julian years: from columns of tables and from headers."""

from numbers import Real

import numpy as np
from astropy import units as u
from astropy.time import Time

from ..exceptions import InputError, some_of

#: Keywords of headers that state it, the middle of the exposure before its beginning; those of HST are MJD too.
KEYWORDS = ("MJD-AVG", "MJD-MID", "MJD-OBS", "MJD-BEG", "EXPSTART", "DATE-AVG", "DATE-OBS")
#: Numbers between these are modified Julian dates (the years 1949 to 2132), as years they would be absurd.
_MJD = 33000.0, 100000.0
_FIRST, _LAST = 1800, 2200
#: Exposures that are nearer in time than this were taken at one epoch, years: a day.
ONE_EPOCH = 1 / 365.25
_MOST_NAMED = 6


def year(epoch):
    """An epoch as a decimal Julian year, None as None.

    Raises
    ------
    InputError
        If it is neither an `~astropy.time.Time` nor a year from 1800 to 2200.
    """
    if epoch is None:
        return None
    value = epoch.jyear if isinstance(epoch, Time) else epoch
    if isinstance(value, bool) or not isinstance(value, Real) or not _FIRST <= value <= _LAST:
        raise InputError(f"epoch must be a decimal year, such as 2013.25, or one astropy Time, got {epoch!r}")
    return float(value)


def years(column):
    """A column of epochs as a quantity in Julian years: of `~astropy.time.Time`, decimal years, or MJD.

    Raises
    ------
    InputError
        If it holds neither times nor numbers.
    """
    if isinstance(column, Time):
        return u.Quantity(np.ma.filled(column.jyear, np.nan), u.yr)
    unit = getattr(column, "unit", None)
    try:
        values = np.ma.filled(np.ma.asarray(getattr(column, "value", column), dtype=float), np.nan)
        values = values if unit in (None, u.dimensionless_unscaled, u.day) else (values * unit).to_value(u.yr)
    except (u.UnitConversionError, TypeError, ValueError) as error:
        raise InputError(f"column 'epoch' must hold decimal years, MJD or Time: {error}") from None
    with np.errstate(invalid="ignore"):
        days = (values > _MJD[0]) & (values < _MJD[1])
    if days.any() and np.all(days | ~np.isfinite(values)):
        values = np.where(days, Time(np.where(days, values, 51544.5), format="mjd").jyear, np.nan)
    return u.Quantity(values, u.yr)


def exposure_years(names, exposure, values):
    """Years (n_exposures,) of exposures from those of their rows.

    Parameters
    ----------
    names : tuple of str
    exposure : ndarray of int, shape (n,)
        Exposure of every row.
    values : ndarray, shape (n,)

    Raises
    ------
    InputError
        Naming exposures that have none, several, or one that cannot be.
    """
    known = np.isfinite(values)
    number = np.bincount(exposure[known], minlength=len(names))
    if missing := [name for name, n in zip(names, number, strict=True) if not n]:
        raise InputError(
            f"column 'epoch' has no value for {len(missing)} of {len(names)} exposures "
            f"({some_of(missing, _MOST_NAMED)}): give the time of all of them, or leave these out"
        )
    found = np.empty(len(names))
    found[exposure[known][::-1]] = values[known][::-1]  # of the first row of an exposure
    off = np.abs(values - found[exposure])[known]
    if off.max() > ONE_EPOCH:
        name = names[exposure[known][int(off.argmax())]]
        raise InputError(f"column 'epoch' has several values for exposure {name}, up to {off.max():.3g} yr off")
    absurd = [f"{name}: {value:g}" for name, value in zip(names, found, strict=True) if not _FIRST <= value <= _LAST]
    if absurd:
        raise InputError(
            f"column 'epoch' must hold decimal years from {_FIRST} to {_LAST}, MJD or Time, "
            f"got {some_of(absurd, _MOST_NAMED)}"
        )
    return found


def mean_epoch(headers):
    """Mean epoch of exposures by their headers (`KEYWORDS`), a Julian year, or None."""
    found = [value for value in map(header_epoch, headers) if value is not None]
    return float(np.mean(found)) if found else None


def header_epoch(header):
    """Epoch of an exposure by its header (`KEYWORDS`), a Julian year, or None; that of the day if it has no time."""
    for key in KEYWORDS:
        value = header.get(key)
        try:
            if isinstance(value, Real) and value > 1:
                return year(Time(value, format="mjd"))
            if isinstance(value, str):
                return year(Time(value.strip(), scale="utc"))
        except ValueError:  # what cannot be read counts as absent
            continue
    return None
