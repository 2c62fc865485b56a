"""The exposures of a camera as those of one detector, its focal plane."""

from dataclasses import dataclass, field

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from ..geometry import similarity, tangent_plane
from ..inputs.sky_wcs import to_icrs
from .from_wcs import grid_of, stated_detectors


@dataclass(frozen=True, eq=False)
class FocalPlane:
    """What is known of an exposure of a camera beside its pixels.

    Attributes
    ----------
    name : str
    shape : tuple
        ``(ny, nx)`` of the focal plane.
    wcs : `~astropy.wcs.WCS` or None
        Linear, by the WCSs of the detectors.
    header : `~astropy.io.fits.Header`
        That of the first detector.
    """

    name: str
    shape: tuple
    wcs: WCS | None
    header: fits.Header = field(default_factory=fits.Header)
    has_gwcs = False


def focal_planes(camera, exposures):
    """The focal planes of exposures whose detectors are given, in the order in which they first appear.

    Parameters
    ----------
    camera : Camera
    exposures : list of Exposure
        With `exposure` and `detector`.

    Returns
    -------
    list of FocalPlane
        Or the exposures themselves where there is no focal plane beside their pixels.

    Raises
    ------
    InputError
        For an exposure that does not state its detector, a detector that the camera does not have, or one of another
        shape.
    """
    if not camera.has_focal_plane:
        return exposures
    planes = {}
    for exposure in exposures:
        camera.check(exposure)
        planes.setdefault(exposure.exposure, []).append(exposure)
    stated = stated_detectors(exposures) if camera.states_scale else {}
    return [
        FocalPlane(name, camera.field, _wcs(camera, parts, stated), parts[0].header) for name, parts in planes.items()
    ]


def _wcs(camera, parts, stated):
    """The linear WCS of the focal plane that fits those of its detectors best, or None if they have none.

    A detector whose header contradicts those of the others has no part in it. Where a reference told how the plane lies
    in which headers have the detectors, `stated` ``{id: Detector}``, pixels are where the headers have them.
    """
    places, sky, odd = [], [], () if camera.headers is None else camera.headers.odd
    known = [part for part in parts if part.wcs is not None]
    for part in known:
        if part.detector not in odd or all(each.detector in odd for each in known):
            xy, of_header = grid_of(part.shape), stated.get(part.detector)
            places.append(
                camera[part.detector].to_focal_plane(xy)
                if of_header is None
                else similarity.apply(camera.header_map, of_header.to_focal_plane(xy))
            )
            sky.append(to_icrs(part.wcs, xy))
    if not places:
        return None
    places, sky = np.concatenate(places), np.concatenate(sky, axis=1)
    centre = np.degrees(tangent_plane.angles(tangent_plane.directions(*np.radians(sky)).mean(axis=0)))
    pose = similarity.fit_similarity(places, np.stack(tangent_plane.gnomonic(*sky, *centre), axis=1))
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = "RA---TAN", "DEC--TAN"
    wcs.wcs.cunit = "deg", "deg"
    wcs.wcs.radesys = "ICRS"
    wcs.wcs.crval = centre
    wcs.wcs.crpix = similarity.invert(pose)[:, 2] + 1
    wcs.wcs.cd = pose[:, :2]
    wcs.wcs.set()
    return wcs
