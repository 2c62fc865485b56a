"""Where the header of an image has it on the sky before another WCS goes in: its WCS, its footprint ``S_REGION``."""

import logging
import re

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits

from ..exceptions import InputError, without_astropy_warnings
from ..inputs import file_images
from ..inputs.frames import wcs_cards
from ..inputs.sky_wcs import header_wcs, to_icrs

_POLYGON = re.compile(r"\s*(POLYGON\s+(?:ICRS\s+)?)((?:[-+\d.eE]+\s*)+)", re.IGNORECASE)
#: Pixels are whole or half ones (their corners) where they are so near: SIP headers of JWST are off by 0.1 pixels.
_NEAR = 0.3
_ROUNDS, _EXACT = 20, 1e-4  # steps of the inversion, and pixels


def former_wcs(view, hdulist, hdu):
    """The believable WCS of the header of an image that a view of a solution is of; None for none."""
    with without_astropy_warnings():
        header = wcs_cards.header_of_image(hdulist[0].header, hdu.header)
        try:
            wcs_cards.make_numbers(header, view.label)
        except InputError:  # it gives way
            return None
        return header_wcs(header, hdulist, file_images.plane_shape(hdu), view.label, level=logging.DEBUG)


def renewed_footprint(view, hdulist, hdu):
    """A `~astropy.io.fits.Header` with the footprint by the view, where that of the image has one; else it is empty."""
    text = hdu.header.get("S_REGION")
    former = former_wcs(view, hdulist, hdu) if isinstance(text, str) else None
    region = None if former is None else renewed_region(text, former, view)
    return fits.Header() if region is None else fits.Header({"S_REGION": region})


def renewed_region(text, former, view):
    """An ``S_REGION`` whose corners are where the WCS of a view has the pixels at which they were.

    Parameters
    ----------
    text : str
        ``POLYGON ICRS ra dec ra dec ...``, degrees; as many decimals are written as there are.
    former : WCS
        A believable one of the image, with which it was made.
    view : View

    Returns
    -------
    str or None
        None for what is no such polygon, or has corners that are off the image by more than its size.
    """
    found = _POLYGON.fullmatch(text)
    numbers = found[2].split() if found else []
    if len(numbers) < 6 or len(numbers) % 2:
        return None
    digits = max(len(each.partition(".")[2]) for each in numbers)
    with without_astropy_warnings():
        pixels = _pixels(former, np.array(numbers, dtype=float).reshape(-1, 2), view.shape)
        if pixels is None:
            return None
        sky = np.stack(view.wcs(*pixels.T, with_bounding_box=False), axis=1)
    return f"{found[1]}{' '.join(f'{each:.{digits}f}' for each in sky.ravel())}" if np.isfinite(sky).all() else None


def _pixels(wcs, sky, shape):
    """Pixels (n, 2) of places (n, 2) on the sky, degrees, by steps from the middle; None where they are not found."""
    size = np.array(shape[::-1], dtype=float)
    there, xy = SkyCoord(*sky.T, unit="deg"), np.repeat((size[None] - 1) / 2, len(sky), axis=0)
    for _ in range(_ROUNDS):
        here, *ends = (_offsets(wcs, xy + step, there) for step in np.concatenate([np.zeros((1, 2)), np.eye(2)]))
        step = np.linalg.solve(np.stack([end - here for end in ends], axis=2), -here[:, :, None])[:, :, 0]
        xy = xy + step
        if not np.isfinite(xy).all() or np.any(np.abs(xy - size / 2) > 2 * size):
            return None
        if np.abs(step).max() < _EXACT:
            whole = np.round(2 * xy) / 2
            return np.where(np.abs(whole - xy) < _NEAR, whole, xy)
    return None


def _offsets(wcs, xy, there):
    """From places on the sky to those of pixels (n, 2), arcsec, (n, 2)."""
    here = SkyCoord(*to_icrs(wcs, xy), unit="deg")
    return np.stack([each.arcsec for each in there.spherical_offsets_to(here)], axis=1)
