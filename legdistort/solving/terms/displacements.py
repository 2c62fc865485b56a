"""Displacements by a unit of each number of the terms that the package has, (k, 2, n) pixels, from `Observed`."""

import numpy as np
from astropy import units as u

from ...results.motions import accelerated, smooth_paths

#: Waves of the fraction of a pixel.
_WAVES = 1, 2


def pixel_waves(observed):
    """First two waves of the fraction of a pixel, along the same axis: (8, 2, n); in the middle of a pixel it is 0."""
    phase = 2 * np.pi * (observed.places_alone + 0.5)
    waves = np.stack([f(k * phase) for k in _WAVES for f in (np.sin, np.cos)])
    along = (waves[:, None] * np.eye(2)[None, :, :, None]).reshape(-1, 2, phase.shape[1])
    return observed.from_detector(along)


#: Their names, in that order.
PIXEL_WAVES = tuple(f"{f} {k} {axis}" for k in _WAVES for f in ("sin", "cos") for axis in "xy")


def refraction(observed):
    """Towards the zenith, tan z times the colour of the star about the mean: (1, 2, n).

    The parallactic angle counts from north through east, without a sky from +y of the reference plane towards +x.
    """
    angle = np.radians(observed.values("parallactic_angle", u.deg))
    zenith = np.stack([np.sin(angle), np.cos(angle)])
    if observed.sky is not None:
        to_sky = observed.sky.matrix[:, :2] / np.sqrt(abs(np.linalg.det(observed.sky.matrix[:, :2])))
        zenith = np.linalg.inv(to_sky) @ zenith
    return observed.on_detector(observed.values("tan_z") * observed.colour_departure * zenith)[None]


def accelerations(observed):
    """Half the square of the time since the epoch, along x and along y of the reference plane: (2, 2, n)."""
    return _along_both(observed, accelerated(*observed.since_epoch))


def orbits(observed):
    """Smooth paths that leave the straight motion at the epoch, along x and y of the reference plane: (14, 2, n)."""
    return _along_both(observed, smooth_paths(*observed.since_epoch))


def _along_both(observed, paths):
    """Paths (m, n) in time as displacements along x and along y, (2 m, 2, n)."""
    along = np.eye(2)[:, :, None]
    return np.stack([observed.on_detector(path * each) for path in paths for each in along])
