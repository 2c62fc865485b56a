"""Cameras by the world coordinate systems of the detectors of one exposure: FITS WCSs and gwcs.

Every WCS leads to the sky. Seen from one tangent point in their middle the detectors lie in one plane, that of the
focus. Its pixels have the mean size of those of the detectors, and its axes their mean direction, so that nothing of
where the telescope pointed is left but the side of the sky that is up.
"""

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
    return kind(name or str(first.header.get("INSTRUME", "camera")).strip() or "camera", detectors)


def layouts_of(named):
    """Static distortion and layout, in one focal plane, of ``{detector: exposure}`` of one exposure, by their WCSs."""
    middles = [to_icrs(each.wcs, basis.denormalize(*np.zeros((2, 1)), each.shape))[:, 0] for each in named.values()]
    lon, lat = np.radians(middles).T
    centre = np.degrees(tangent_plane.angles(tangent_plane.directions(lon, lat).mean(axis=0)))
    found = {key: _expanded(each, centre) for key, each in named.items()}
    plane = _focal_plane([pose for _, pose in found.values()])
    return {key: (static, similarity.compose(pose, plane)) for key, (static, pose) in found.items()}


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
    scale = np.mean([similarity.describe(pose)["scale"] for pose in poses])
    parity = 1 if np.sum([np.sign(np.linalg.det(pose[:, :2])) for pose in poses]) >= 0 else -1
    pose = similarity.similarity_of(np.zeros(2), np.zeros(2), turned, parity)
    pose[:, :2] *= scale / similarity.describe(pose)["scale"]
    return similarity.invert(pose)
