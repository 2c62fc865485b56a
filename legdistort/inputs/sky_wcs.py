"""World coordinate systems of exposures: which are plausible, and where on the sky they lead.

`~astropy.wcs.WCS` objects of FITS headers, with their distortions or without, and any other that has astropy's shared
interface for world coordinates (APE 14) and leads to the sky, such as a gwcs.
"""

import logging
from contextlib import contextmanager
from contextvars import ContextVar

import gwcs
import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_scales, wcs_to_celestial_frame
from astropy.wcs.wcsapi import BaseHighLevelWCS, BaseLowLevelWCS, HighLevelWCSWrapper
from astropy.wcs.wcsapi.high_level_api import values_to_high_level_objects

from ..exceptions import AssumptionWarning, InputError, some_of, warn
from ..runtime.guards.offline import offline

log = logging.getLogger(__name__)

#: A WCS is plausible for pixel scales in this range [degrees]: 0.1 mas to 6 arcmin.
PIXEL_SCALES = (0.0001 / 3600, 0.1)
#: ... and a reference pixel not farther from the centre than this many frame sizes (mosaics need several).
REFERENCE_DISTANCE = 20
#: Part of a detector, at its border, that may see no sky (0.004 of that of MIRI).
BORDER = 0.02
#: Names of frames whose WCS is not used by the reason, within a block of `said_once`.
_UNUSED = ContextVar("_UNUSED", default=None)


@offline()
def believable_wcs(wcs, shape, name="", *, level=logging.INFO):
    """The celestial part of a WCS, or None with a log entry if it is not plausible.

    Believable is a WCS that has two celestial axes, a pixel scale in `PIXEL_SCALES` that is the same in x
    and y within a factor of two, and leads from the whole detector to the sky. One of a FITS header must also have its
    reference pixel within `REFERENCE_DISTANCE` frame sizes of the centre, and map corners and centre to the sky and
    back within 0.01 of the frame.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`, gwcs, any other WCS of the shared interface (APE 14), or None
    shape : tuple
        ``(ny, nx)``.
    name : str, optional
        For the log.
    level : int
        Of the log entry.

    Raises
    ------
    InputError
        For what is no WCS.
    """
    if wcs is None:
        return None
    if isinstance(wcs, WCS):
        wcs, reason = _believable_fits(wcs, shape)
    elif isinstance(wcs, BaseHighLevelWCS | BaseLowLevelWCS):
        wcs = wcs if isinstance(wcs, BaseHighLevelWCS) else HighLevelWCSWrapper(wcs)
        reason = _against_shared(wcs, shape)
    else:
        raise InputError(
            f"{name}: the WCS must be an astropy.wcs.WCS, a gwcs or another one of the shared interface (APE 14), got "
            f"{type(wcs).__name__}"
        )
    if reason:
        _say_unused(name, reason, level)
        return None
    return wcs


def header_wcs(header, hdulist, shape, name, *, level=logging.INFO):
    """The believable WCS of a header of a file, or None with a log entry."""
    try:
        return believable_wcs(image_wcs(header, hdulist), shape, name, level=level)
    except Exception as error:  # wcslib raises many kinds; a header WCS is a hint, never a must
        _say_unused(name, str(error), level)
        return None


@contextmanager
def said_once():
    """A block that reads frames; after it one line for each reason names those whose WCS is not used."""
    found = {}
    token = _UNUSED.set(found)
    try:
        yield
    finally:
        _UNUSED.reset(token)
        for (reason, level), names in found.items():
            log.log(level, "%s: WCS of the header not used: %s", some_of(names, 4), reason)


def _say_unused(name, reason, level):
    """Say why the WCS of a frame is not used, now or at the end of the block of `said_once`."""
    if (found := _UNUSED.get()) is not None:
        found.setdefault((reason, level), []).append(name)
    else:
        log.log(level, "%s: WCS of the header not used: %s", name, reason)


def image_wcs(header, hdulist=None):
    """The `~astropy.wcs.WCS` of a header; of its first two axes, if further ones have one pixel (``NAXIS3 = 1``)."""
    n_axes = max(header.get("NAXIS", 2), header.get("WCSAXES", 2))
    further = [header.get(f"NAXIS{axis}", 1) for axis in range(3, n_axes + 1)]
    if not further or any(n != 1 for n in further):
        return WCS(header, fobj=hdulist)
    wcs = WCS(header, fobj=hdulist, naxis=2)
    if wcs.pixel_shape is not None:
        wcs.pixel_shape = wcs.pixel_shape[:2]
    return wcs


@offline()
def to_icrs(wcs, xy, *, distortion=True):
    """Right ascension and declination (2, n) [deg, ICRS] of pixels (n, 2), counted from 0, by a believable WCS.

    Parameters
    ----------
    wcs : as `believable_wcs` gives it
    xy : array_like, shape (n, 2)
    distortion : bool
        False leaves the distortion of a FITS header out, its linear part and projection remain.
    """
    x, y = np.asarray(xy, dtype=float).T
    if isinstance(wcs, WCS):
        world = (wcs.all_pix2world if distortion else wcs.wcs_pix2world)(x, y, 0)
        lon, lat = world[wcs.wcs.lng] * u.deg, world[wcs.wcs.lat] * u.deg
        sky = SkyCoord(lon, lat, frame=wcs_to_celestial_frame(wcs)).icrs
    else:
        sky = _shared_to_icrs(wcs, x, y)
    return np.stack([sky.ra.deg, sky.dec.deg])


def leads_elsewhere(wcs, view):
    """Whether a believable WCS, or None, leads farther than a frame is large from where a view of a solution has it."""
    sky = view.solution.sky
    if wcs is None or sky is None:
        return False
    ny, nx = view.shape
    xy = np.array([[(nx - 1) / 2, (ny - 1) / 2], [0.0, 0.0]])
    here, edge = sky.to_sky(view.correct(xy))
    (there,) = SkyCoord(*to_icrs(wcs, xy[:1]), unit="deg")
    return bool(here.separation(there) > 2 * here.separation(edge))


def warn_of_another_field(names):
    """Warn of frames of which `leads_elsewhere` holds, if there are any."""
    if names:
        warn(
            f"{some_of(names, 3)}: by the header more than a frame away from where the solution has it; is this "
            "another field with the same names of frames, or is the pointing in the header that wrong?",
            AssumptionWarning,
        )


def _shared_to_icrs(wcs, x, y):
    """Places of pixels by a WCS of the shared interface, beyond a bounding box too.

    Pixels of an undistorted edge lie there, and columns of MIRI that see no sky.
    """
    if isinstance(wcs, gwcs.WCS):
        values = wcs(x, y, with_bounding_box=False)
        return _place(values_to_high_level_objects(*values, low_level_wcs=wcs)).icrs
    return _place(wcs.pixel_to_world(x, y)).icrs


def _place(found):
    """The place on the sky among what a WCS of the shared interface gives for pixels; `ValueError` without one."""
    for each in found if isinstance(found, (list, tuple)) else [found]:
        if isinstance(each, SkyCoord):
            return each
    raise ValueError("it does not lead to the sky")


def _is_smaller(wcs, shape):
    """Whether the bounding box of a gwcs leaves out more than columns at the border of a detector."""
    if not isinstance(wcs, gwcs.WCS) or wcs.bounding_box is None:
        return False
    sides = zip(wcs.bounding_box.bounding_box(order="F"), shape[::-1], strict=True)
    return any(low > BORDER * n or high < (1 - BORDER) * n for (low, high), n in sides)


def _against_shared(wcs, shape):
    """What speaks against a WCS of the shared interface, or None."""
    ny, nx = shape
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, nx - 1, 5), np.linspace(0, ny - 1, 5)))
    try:
        if getattr(wcs, "low_level_wcs", wcs).pixel_n_dim != 2:
            return "it has not two pixel axes"
        places = [_shared_to_icrs(wcs, x + dx, y + dy) for dx, dy in ((0, 0), (0.25, 0), (0, 0.25))]
    except Exception as error:  # WCSs raise what they like
        return str(error)
    covered = all(np.isfinite(place.ra.deg + place.dec.deg).all() for place in places)
    if not covered or _is_smaller(wcs, shape):
        return "it gives no place on the sky for a part of the detector"
    scales = np.array([places[0].separation(place).deg.mean() / 0.25 for place in places[1:]])
    if not (scales.min() > PIXEL_SCALES[0] and scales.max() < PIXEL_SCALES[1] and scales.max() < 2 * scales.min()):
        return f"pixel scale {scales[0]:.3g}, {scales[1]:.3g} degrees"
    return None


def _believable_fits(wcs, shape):
    """The celestial part of a WCS of a FITS header, and what speaks against it."""
    if not wcs.has_celestial:
        return None, "it has no celestial axes"
    wcs = wcs.celestial
    ny, nx = shape
    scales = proj_plane_pixel_scales(wcs)
    corners = np.array([[0, 0], [nx - 1, 0], [0, ny - 1], [nx - 1, ny - 1], [(nx - 1) / 2, (ny - 1) / 2]])
    off_centre = np.abs(wcs.wcs.crpix - 1 - corners[-1]).max() / max(ny, nx)
    reason = None
    if not (scales.min() > PIXEL_SCALES[0] and scales.max() < PIXEL_SCALES[1] and scales.max() < 2 * scales.min()):
        reason = f"pixel scale {scales[0]:.3g}, {scales[1]:.3g} degrees"
    elif not off_centre < REFERENCE_DISTANCE:
        reason = f"reference pixel {off_centre:.0f} frame sizes off the centre"
    else:
        try:
            back = wcs.all_world2pix(wcs.all_pix2world(corners, 0), 0, quiet=True)
        except Exception as error:  # singular matrices and the like, raised by wcslib under many names
            reason = str(error)
        else:
            if not np.all(np.abs(back - corners) < 0.01 * max(ny, nx)):
                reason = "it does not map the corners to the sky and back"
    return wcs, reason
