"""How far from the zenith exposures were taken, and in which direction it lay: from their headers."""

import warnings
from numbers import Real

import numpy as np
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time

from ..runtime.guards.offline import offline
from .epochs import header_epoch

#: Keywords of the zenith distance, of the elevation, and of the parallactic angle, all in degrees, and of the airmass.
_DISTANCE, _ELEVATION, _AIRMASS = ("ZD",), ("ELEVATIO", "ESO TEL ALT"), ("AIRMASS", "ESO TEL AIRM START")
_ANGLE = "PARANGLE", "PARANG", "ESO TEL PARANG START"
#: The site as FITS has it: geocentric [m], or longitude to the east, latitude [deg] and height [m].
_GEOCENTRIC, _GEODETIC = ("OBSGEO-X", "OBSGEO-Y", "OBSGEO-Z"), ("OBSGEO-L", "OBSGEO-B", "OBSGEO-H")


def stated_zenith(header, *, reckoned=True):
    """Tangent of the zenith distance and parallactic angle [deg] of an exposure, NaN for what is not known.

    As its header states them, else `reckoned` from place (``RA``, ``DEC`` or the WCS), time and site (``OBSGEO``). The
    angle counts from north through east.
    """
    tangent, angle = _tangent(header), _number(header, _ANGLE)
    if reckoned and (np.isnan(tangent) or np.isnan(angle)):
        made = _reckoned(header)
        tangent = made[0] if np.isnan(tangent) else tangent
        angle = made[1] if np.isnan(angle) else angle
    return tangent, angle


def _number(header, keywords, low=-np.inf, high=np.inf):
    """Value of the first keyword with a number between limits; NaN without."""
    for key in keywords:
        value = header.get(key)
        if isinstance(value, Real) and not isinstance(value, bool) and low <= value <= high:
            return float(value)
    return np.nan


def _tangent(header):
    """Of the zenith distance that is stated."""
    distance = _number(header, _DISTANCE, 0, 89)
    distance = 90 - _number(header, _ELEVATION, 1, 90) if np.isnan(distance) else distance
    if np.isfinite(distance):
        return float(np.tan(np.radians(distance)))
    return float(np.sqrt(_number(header, _AIRMASS, 1, 57) ** 2 - 1))


@offline()
def _reckoned(header):
    """The same from place, time and site."""
    place, site, year = _place(header), _site(header), header_epoch(header)
    if place is None or site is None or year is None:
        return np.nan, np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rotation of the Earth to arcsec does not matter
        frame = AltAz(obstime=Time(year, format="jyear", scale="utc"), location=site)
        zenith = SkyCoord(az=0 * u.deg, alt=90 * u.deg, frame=frame).icrs
        distance, angle = place.separation(zenith), place.position_angle(zenith).wrap_at(180 * u.deg)
    if distance > 89 * u.deg:  # it was not observed from there
        return np.nan, np.nan
    return float(np.tan(distance.rad)), float(angle.deg)


def _place(header):
    ra, dec = _number(header, ("RA",), 0, 360), _number(header, ("DEC",), -90, 90)
    if np.isnan(ra + dec) and str(header.get("CTYPE1", "")).startswith("RA"):
        ra, dec = _number(header, ("CRVAL1",)), _number(header, ("CRVAL2",), -90, 90)
    return SkyCoord(ra, dec, unit="deg") if np.isfinite(ra + dec) else None


def _site(header):
    values = [_number(header, (key,)) for key in _GEOCENTRIC]
    if np.isfinite(values).all() and np.hypot(*values[:2]) > 0:
        return EarthLocation.from_geocentric(*values, unit="m")
    lon, lat, height = (_number(header, (key,)) for key in _GEODETIC)
    if np.isnan(lon + lat):
        return None
    return EarthLocation.from_geodetic(lon * u.deg, lat * u.deg, np.nan_to_num(height) * u.m)
