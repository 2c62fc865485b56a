"""Cameras by the world coordinate systems of the detectors of one exposure: FITS WCSs and gwcs.

Every WCS leads to the sky. Seen from one tangent point in their middle the detectors lie in one plane, that of the
focus. Its pixels have the median size of those of the detectors, and its axes their mean direction, so that nothing of
where the telescope pointed is left but the side of the sky that is up.
"""

from dataclasses import replace

import numpy as np

from ..exceptions import InputError, some_of
from ..geometry import basis, similarity, tangent_plane
from ..inputs.exposure_files import listed
from ..inputs.file_images import KEYWORDS, detector_ids
from ..inputs.sky_wcs import to_icrs
from ..runtime.words import DIRECTIONS
from .detector import Detector
from .expansion import expand
from .source import Source

#: The degree of the series of a distortion is raised to 9 at most until it leaves less than this out [pix].
SAME, HIGHEST = 1e-4, 9


def camera_of(kind, exposures, name=None):
    """Camera, the `kind`, from the WCSs of one exposure (see `legdistort.cameras.camera.Camera.from_exposures`)."""
    named = exposures if isinstance(exposures, dict) else _by_detector(listed(exposures, "Camera.from_exposures"))
    if not named:
        raise InputError("a camera needs the exposure of one detector at least, got none")
    for key, exposure in named.items():
        if exposure.wcs is None:
            raise InputError(f"{exposure.name} (detector {key}) has no celestial WCS, or none that is plausible")
    first = next(iter(named.values()))
    sigma = np.inf if len(named) > 1 else None  # headers are rarely better than a pixel
    detectors = {}
    for key, (static, layout) in layouts_of(named).items():
        stated = layout if len(named) > 1 else None
        known = {"static": static, "layout_sigma": sigma, "header_layout": stated}
        detectors[key] = Detector(named[key].shape, layout=layout, **known)
    camera = kind(name or str(first.header.get("INSTRUME", "camera")).strip() or "camera", detectors)
    return replace(camera, header_map=header_map(camera, detectors)) if len(named) > 1 else camera


def layouts_of(named):
    """Static distortion and layout, in one focal plane, of ``{detector: exposure}`` of one exposure, by their WCSs."""
    middles = [to_icrs(each.wcs, basis.denormalize(*np.zeros((2, 1)), each.shape))[:, 0] for each in named.values()]
    lon, lat = np.radians(middles).T
    centre = np.degrees(tangent_plane.angles(tangent_plane.directions(lon, lat).mean(axis=0)))
    found = {key: _expanded(each, centre) for key, each in named.items()}
    plane = _focal_plane([pose for _, pose in found.values()])
    return {key: (static, similarity.compose(pose, plane)) for key, (static, pose) in found.items()}


def stated_detectors(exposures):
    """``{id: Detector}`` by the headers of that of several exposures which has most of them, in one plane.

    Of fewer than two detectors with a WCS none: these are in no plane together.
    """
    named = {each.detector: each for each in fullest([each for each in exposures if each.wcs is not None])}
    return {
        key: Detector(named[key].shape, layout=layout, static=static, header_layout=layout)
        for key, (static, layout) in (layouts_of(named) if len(named) > 1 else {}).items()
    }


def fullest(exposures):
    """The detectors of the exposure that has most, of a list of `Exposure`; empty of none."""
    parts = {}
    for exposure in exposures:
        parts.setdefault(exposure.exposure, []).append(exposure)
    return max(parts.values(), key=len, default=[])


def header_map(camera, stated):
    """Similarity (2, 3) from the plane in which headers have ``{id: Detector}`` to the focal plane of a camera.

    It fits where both have pixels all over the detectors best, those aside whose header contradicts the others.
    """
    odd = () if camera.headers is None else camera.headers.odd
    known = [key for key in stated if key not in odd] or list(stated)
    pixels = {key: grid_of(stated[key].shape) for key in known}
    there = np.concatenate([stated[key].to_focal_plane(pixels[key]) for key in known])
    here = np.concatenate([camera[key].to_focal_plane(pixels[key]) for key in known])
    return similarity.invert(similarity.fit_similarity(here, there))


def moved_plane(new, old):
    """Similarity from the plane of the header layouts of new ``{id: Detector}`` to that of old, what it leaves [pix].

    The latter is the largest distance, over the corners of the detectors that both have.
    """
    both = [key for key in new if old[key].header_layout is not None]
    pixels = {key: basis.denormalize(*np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]]), new[key].shape) for key in both}
    new, old = (
        np.concatenate([similarity.apply(similarity.invert(each[key].header_layout), pixels[key]) for key in both])
        for each in (new, old)
    )
    step = similarity.fit_similarity(new, old)
    return step, float(np.hypot(*(similarity.apply(step, new) - old).T).max())


def grid_of(shape):
    """Pixels (25, 2) all over a detector."""
    t = np.linspace(-1, 1, 5)
    return basis.denormalize(*(a.ravel() for a in np.meshgrid(t, t)), shape)


def _by_detector(exposures):
    """``{id: exposure}`` of the detectors of one exposure."""
    ids = [each.detector for each in exposures]
    if None in ids or len(set(ids)) < len(ids):
        ids = detector_ids([each.header for each in exposures])
    if ids is None:
        groups = list(dict.fromkeys(each.exposure for each in exposures))
        if 1 < len(groups) < len(exposures):
            raise InputError(
                f"these are {len(groups)} exposures ({some_of(groups, 4)}), and a layout is that of one: give the "
                "detectors of one of them, or all to Camera.of_frames, which takes the one that has most detectors"
            )
        raise InputError(
            f"the headers of {some_of([each.name for each in exposures], 6)} do not distinguish their detectors by any "
            f"of {', '.join(KEYWORDS)}: give a dict {{id: exposure}} of the detectors of one exposure"
        )
    return dict(zip(ids, exposures, strict=True))


def _expanded(exposure, centre):
    """Static distortion, and the similarity from the tangent plane [degrees] to undistorted pixels."""

    def function(x, y):
        x, y = np.broadcast_arrays(x, y)
        sky = to_icrs(exposure.wcs, np.stack([x.ravel(), y.ravel()], axis=1))
        return tuple(a.reshape(x.shape) for a in tangent_plane.gnomonic(*sky, *centre))

    source = Source(exposure.name, "WCS", function, direction=DIRECTIONS[0], origin=0, shape=exposure.shape)
    for degree in range(1, HIGHEST + 1):
        static, pose, truncation = expand(source, degree)
        if truncation < SAME:
            break
    return static, pose


def _focal_plane(poses):
    """Similarity from the focal plane to the tangent plane, in which the detectors lie as upright as they can."""
    turned = np.mean([pose[:, :2] / np.sqrt(abs(np.linalg.det(pose[:, :2]))) for pose in poses], axis=0)
    scale = np.median([similarity.describe(pose)["scale"] for pose in poses])  # one that is wrong has no part in it
    parity = 1 if np.sum([np.sign(np.linalg.det(pose[:, :2])) for pose in poses]) >= 0 else -1
    pose = similarity.similarity_of(np.zeros(2), np.zeros(2), turned, parity)
    pose[:, :2] *= scale / similarity.describe(pose)["scale"]
    return similarity.invert(pose)
