"""When exposures were taken, in Julian years: from columns of tables and from headers."""

import re
from functools import lru_cache
from numbers import Real

import numpy as np
from astropy import units as u
from astropy.time import Time

from ..exceptions import InputError, some_of
from ..runtime.guards.offline import offline

#: Keywords of headers that state it, the middle of the exposure before its beginning; those of HST are MJD too.
KEYWORDS = (
    "MJD-AVG", "MJD-MID", "MJD-OBS", "MJD-BEG", "EXPSTART", "DATE-AVG", "DATE-OBS", "DATE-BEG", "MJD_OBS", "DATE_OBS",
    "MJD", "JD", "JD-OBS", "JD_OBS",
)  # fmt: skip
#: Julian dates are between these (the years 1858 to 2132).
_JD = 2400000.5, 2500000.5
#: Dates as FITS had them before 2000, always of the years 1900 to 1999, and as others write them.
_OLD = re.compile(r"(\d{1,2})/(\d{1,2})/(\d{2})(\D.*)?")
_SLASHES = re.compile(r"(\d{4})/(\d{1,2})/(\d{1,2})(\D.*)?")
_ZONE = re.compile(r"(?<=\d)\s*([-+])(\d\d):?(\d\d)$")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?")
#: Dates that are some, to be known without reading them: that takes half a millisecond.
_PLAIN = re.compile(r"\d{4}-(0[1-9]|1[0-2])-(0[1-9]|1\d|2[0-8])(T([01]\d|2[0-3]):[0-5]\d(:[0-5]\d(\.\d*)?)?)?$")
#: Texts that state no date, and claim none.
_NOTHING = re.compile(r"[\s?*-]*|n/?a|none|null|nan|unknown|undef(ined)?|[0/:.T -]*", re.IGNORECASE)
#: Numbers between these are modified Julian dates (the years 1949 to 2132), as years they would be absurd.
_MJD = 33000.0, 100000.0
_FIRST, _LAST = 1800, 2200
#: Exposures that are nearer in time than this were taken at one epoch, years: a day.
ONE_EPOCH = 1 / 365.25
_MOST_NAMED = 6


@offline()
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


@offline()
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


def nights(years):
    """Numbers of the nights, integers (n,) from 0, of epochs (n,) in years: gaps of more than half a day part them.

    One night for all if some epoch is not known.
    """
    if not np.isfinite(years).all():
        return np.zeros(len(years), dtype=int)
    order = np.argsort(years, kind="stable")
    out = np.empty(len(years), dtype=int)
    out[order] = np.cumsum(np.diff(years[order], prepend=years[order[0]]) > ONE_EPOCH / 2)
    return out


def night_labels(years, number, names):
    """What nights are called: by their dates, in years (n,), else by the name (n,) of their first exposure.

    `number` (n,) is that of the night of an exposure, from 0. Several on a date have the time beside it.
    """
    begins = [np.flatnonzero(number == n) for n in range(number.max() + 1)]
    if not np.all((years > _FIRST) & (years < _LAST)):
        return [str(names[mine[0]]) for mine in begins]
    means = Time([years[mine].mean() for mine in begins], format="jyear")
    dates = means.to_value("iso", subfmt="date").tolist()
    times = means.to_value("iso", subfmt="date_hm").tolist()
    return [time if dates.count(date) > 1 else date for date, time in zip(dates, times, strict=True)]


def mean_epoch(headers):
    """Mean epoch of exposures by their headers (`KEYWORDS`), a Julian year, or None."""
    found = [value for value in map(header_epoch, headers) if value is not None]
    return float(np.mean(found)) if found else None


def header_epoch(header):
    """Epoch of an exposure by its header (`KEYWORDS`), a Julian year, or None; that of the day if it has no time."""
    return stated_epoch(header)[0]


def stated_epoch(header):
    """Epoch of an exposure by its header, and the keyword that states it; None, None if there is none."""
    for key in KEYWORDS:
        value = header.get(key)
        found = read_date(value) if isinstance(value, (str, Real)) else None
        if found is not None and _FIRST <= found.jyear <= _LAST:
            return float(found.jyear), key
    return None, None


def unreadable_dates(header):
    """What the header has in the place of dates and is none, in words."""
    for key in KEYWORDS:
        value = header.get(key)
        if not isinstance(value, (str, Real)) or value == 0 or _PLAIN.match(text := str(value).strip()):
            continue
        if not _NOTHING.fullmatch(text) and read_date(value) is None:
            yield f"{key} = {value!r} is no date"


@lru_cache(maxsize=1024)  # what is read is asked for again when exposures are matched
def read_date(value):
    """The `~astropy.time.Time` (UTC) that a value of a header means, or None.

    Parameters
    ----------
    value : str or float
        ``'2014-12-09T10:11:12.3'``, with ``Z``, a zone (``-0700``) or neither; ``'09/12/95'``, the 9th of December 1995
        as FITS had it before 2000; ``'2014/12/09'``; or a number, as text too: a Julian date between 2400000.5 and
        2500000.5, else a modified one.
    """
    if isinstance(value, str):
        value = value.strip()
        if not _NUMBER.fullmatch(value):
            return _of_text(value)
        value = float(re.sub("[dD]", "e", value))
        if not (_MJD[0] < value < _MJD[1] or _JD[0] < value < _JD[1]):
            return None
    if not isinstance(value, Real) or isinstance(value, bool) or not value > 1:
        return None
    try:
        return Time(float(value), format="jd" if _JD[0] < value < _JD[1] else "mjd", scale="utc")
    except ValueError:
        return None


def _of_text(text):
    if old := _OLD.fullmatch(text):
        text = f"19{old[3]}-{int(old[2]):02d}-{int(old[1]):02d}{old[4] or ''}"
    elif slashes := _SLASHES.fullmatch(text):
        text = f"{slashes[1]}-{int(slashes[2]):02d}-{int(slashes[3]):02d}{slashes[4] or ''}"
    zone = _ZONE.search(text) if ":" in text else None
    text = re.sub(r"\s*(Z|UTC?)$", "", text[: zone.start()] if zone else text)
    try:
        if zone:
            return Time(text, scale="utc") - int(f"{zone[1]}1") * (int(zone[2]) * u.hour + int(zone[3]) * u.min)
        return Time(text, scale="utc")
    except ValueError:
        return None
