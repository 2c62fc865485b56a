"""The exposures of a camera as those of one detector, its focal plane, with the sky that headers agree on.

Headers of detectors state where each lies on the sky, and how large its pixels are and how they are turned. Of
detectors that lie otherwise than their headers have them (two in each other's places, say) no similarity carries the
focal plane to the sky: one that is fitted to all has a scale that no header states.
"""

from dataclasses import dataclass, field

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS
from scipy.sparse.csgraph import connected_components

from ..geometry import similarity, tangent_plane
from ..inputs.sky_wcs import to_icrs
from .from_wcs import grid_of, stated_detectors

#: Headers of two detectors state one scale to this in its logarithm, and one orientation to so many degrees: static
#: distortions and layouts make up for as much.
_SAME_SCALE, _SAME_ANGLE = 0.03, 3.0
#: They put the plane at one place if they do so to so many pixels, and this part of the distance of the detectors.
_SAME_PLACE, _PART = 20.0, 0.03
#: Scale and orientation are those of single headers where places of detectors determine these worse [relative, rad].
_WORSE = 3e-3
#: The same of two detectors, whose places agree with any scale, so that a pixel or two is all that is granted.
_WORSE_OF_TWO = 1e-3


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
    odd : dict
        ``{detector: pixels}`` by which the WCSs of some contradict those of the others, which the sky is of.
    apart : float
        Error of the place of the plane on the sky [pix, per axis], where they contradict one another.
    """

    name: str
    shape: tuple
    wcs: WCS | None
    header: fits.Header = field(default_factory=fits.Header)
    odd: dict = field(default_factory=dict)
    apart: float = 0.0
    has_gwcs = False


@dataclass(frozen=True, eq=False)
class Agreed:
    """What most detectors agree on of how two planes lie to each other.

    Attributes
    ----------
    pose : ndarray, shape (2, 3), or None
        From the first plane to the second; None where as many are turned one way as another.
    agree : ndarray of bool, shape (n,)
        Detectors that it is of.
    off : ndarray, shape (n,)
        By how much the others are off, pixels of the first plane.
    apart : float
        Standard deviation of its place, by how those that it is of differ, where their places do not determine its
        scale and rotation; pixels of the first plane, per axis.
    """

    pose: np.ndarray | None
    agree: np.ndarray
    off: np.ndarray
    apart: float = 0.0


def agreed_similarity(source, target):
    """The `Agreed` similarity by places of detectors in two planes, each of which may be wrong of some.

    Scale, orientation and parity are those that most detectors have by themselves; a detector by which the planes lie
    elsewhere than by the largest number that agree has no part in it. Where no two agree it lies in the middle. The
    places of those that agree determine scale and rotation better, but where they scatter.

    Parameters
    ----------
    source, target : ndarray, shape (n, k, 2)
        Points of each detector.
    """
    n = len(source)
    own = np.array([similarity.fit_similarity(a, b) for a, b in zip(source, target, strict=True)])
    alike = similarity.alike(own, _SAME_SCALE, _SAME_ANGLE)
    number = alike.sum(axis=1)
    group = alike[np.argmax(number)]
    if np.any(number[~group] == number.max()):
        return Agreed(None, group, np.full(n, np.nan), np.nan)
    turn = own[group, :, :2].mean(axis=0)
    middles, there = source.mean(axis=1), target.mean(axis=1)
    shifts = there @ np.linalg.inv(turn).T - middles
    agree, undecided = _at_one_place(shifts, middles, group)
    apart = np.sqrt(np.var(shifts[agree], axis=0, ddof=1).mean() / np.count_nonzero(agree)) if agree.sum() > 1 else 0.0
    pose = similarity.fit_similarity(source[agree].reshape(-1, 2), target[agree].reshape(-1, 2))
    if undecided or not _determines(pose, turn, middles[agree], there[agree]):
        pose = np.column_stack([turn, there[agree].mean(axis=0) - turn @ middles[agree].mean(axis=0)])
    else:
        apart = 0.0
    back = similarity.apply(similarity.invert(pose), target)
    off = np.where(agree, 0.0, np.linalg.norm(back - source, axis=2).max(axis=1))
    return Agreed(pose, agree, off, float(apart))


def _at_one_place(shifts, middles, group):
    """Detectors of a group whose shifts (n, 2) are one: the most; or all, and that nothing shows which is right."""
    rows = np.flatnonzero(group)
    apart, far = (np.linalg.norm(each[rows, None] - each[rows], axis=2) for each in (shifts, middles))
    _, labels = connected_components(apart < _SAME_PLACE + _PART * far, directed=False)
    count = np.sort(np.bincount(labels))[::-1]
    if len(count) > 1 and count[0] == count[1]:
        return group, True
    agree = np.zeros(len(group), dtype=bool)
    agree[rows[labels == np.argmax(np.bincount(labels))]] = True
    return agree, False


def _determines(pose, turn, middles, there):
    """Whether a pose by the places of detectors has their own scale and rotation, or determines these better."""
    n = len(middles)
    if n < 2:
        return True
    if n == 2:
        change = np.linalg.inv(turn) @ pose[:, :2] - np.eye(2)
        return bool(np.sqrt(np.mean(change**2) * 2) < _WORSE_OF_TWO)
    left = (there - similarity.apply(pose, middles)) @ np.linalg.inv(turn).T
    arms = middles - middles.mean(axis=0)
    return bool(np.sum(left**2) / (2 * n - 4) < _WORSE**2 * np.sum(arms**2))


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
        FocalPlane(name, camera.field, header=parts[0].header, **_on_sky(camera, parts, stated))
        for name, parts in planes.items()
    ]


def _on_sky(camera, parts, stated):
    """The linear `wcs` of the focal plane on which its detectors agree, None if they have none, and what is `odd`.

    A detector whose header contradicts those of the others has no part in it. Where a reference told how the plane lies
    in which headers have the detectors, `stated` ``{id: Detector}``, pixels are where the headers have them.
    """
    places, sky, odd = [], [], () if camera.headers is None else camera.headers.odd
    known = [part for part in parts if part.wcs is not None]
    known = [part for part in known if part.detector not in odd or all(each.detector in odd for each in known)]
    for part in known:
        xy, of_header = grid_of(part.shape), stated.get(part.detector)
        places.append(
            camera[part.detector].to_focal_plane(xy)
            if of_header is None
            else similarity.apply(camera.header_map, of_header.to_focal_plane(xy))
        )
        sky.append(to_icrs(part.wcs, xy))
    if not places:
        return {"wcs": None}
    places, sky = np.array(places), np.array(sky)
    middle = np.median([tangent_plane.directions(*np.radians(each)).mean(axis=0) for each in sky], axis=0)
    agreed = agreed_similarity(places, _tangential(sky, middle))
    off = {part.detector: float(agreed.off[k]) for k, part in enumerate(known) if not agreed.agree[k]}
    if agreed.pose is None:
        return {"wcs": None, "odd": {part.detector: np.nan for part in known}, "apart": np.nan}
    places, sky = places[agreed.agree], sky[agreed.agree]
    middle = tangent_plane.directions(*np.radians(np.concatenate(sky, axis=1))).mean(axis=0)
    pose = agreed_similarity(places, _tangential(sky, middle)).pose
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = "RA---TAN", "DEC--TAN"
    wcs.wcs.cunit = "deg", "deg"
    wcs.wcs.radesys = "ICRS"
    wcs.wcs.crval = np.degrees(tangent_plane.angles(middle))
    wcs.wcs.crpix = similarity.invert(pose)[:, 2] + 1
    wcs.wcs.cd = pose[:, :2]
    wcs.wcs.set()
    return {"wcs": wcs, "odd": off, "apart": agreed.apart}


def _tangential(sky, middle):
    """Positions (n, 2, k) [deg] on the plane that touches the sky in a direction, (n, k, 2) [deg]."""
    centre = np.degrees(tangent_plane.angles(middle))
    flat = np.stack(tangent_plane.gnomonic(*np.concatenate(sky, axis=1), *centre), axis=1)
    return np.nan_to_num(flat, nan=180.0).reshape(len(sky), -1, 2)
