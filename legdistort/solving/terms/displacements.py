"""Displacements by a unit of each number of the terms that the package has, (k, 2, n) pixels, from `Observed`."""

import numpy as np
from astropy import units as u

from ...exceptions import InputError
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
    zenith = _zenith(observed)
    if observed.sky is not None:
        to_sky = observed.sky.matrix[:, :2] / np.sqrt(abs(np.linalg.det(observed.sky.matrix[:, :2])))
        zenith = np.linalg.inv(to_sky) @ zenith
    return observed.on_detector(observed.values("tan_z") * observed.colour_departure * zenith)[None]


def differential_refraction(observed):
    """What all stars are lifted by more, or less, than those in the middle of their exposure, (1, 2, n).

    By arcseconds of the constant k of the refraction k tan z. A star in the direction s of the zenith Z moves by
    ``k (Z / Z.s - s)``, at places w on the plane that touches the sky in the middle, in radians, by
    ``k (1 + w.w) (e tan z - w) / (1 + tan z e.w)``, e the direction of the zenith.

    Raises
    ------
    InputError
        Without a sky.
    """
    if observed.sky is None:
        raise InputError(
            "term differential_refraction needs to know where on the sky the exposures lie: match frames that have a "
            "WCS, or give Matches.from_table a sky"
        )
    problem, scale = observed.problem, np.radians(observed.sky.matrix[:, :2])
    w = scale @ problem.placed(observed.state.stars)[:2]
    n = np.bincount(observed.exposure)
    tan_z = observed.values("tan_z")
    (*middle, tan_z) = (np.bincount(observed.exposure, each) / n for each in (*w, tan_z))
    w, tan_z = w - np.stack(middle)[:, observed.exposure], tan_z[observed.exposure]
    e = _zenith(observed)
    lifted = (1 + np.sum(w * w, axis=0)) * (e * tan_z - w) / (1 + tan_z * np.sum(e * w, axis=0))
    return observed.on_detector(np.radians(1 / 3600) * np.linalg.solve(scale, lifted - e * tan_z))[None]


def _zenith(observed):
    """Its direction, to east and north, or along x and y of the plane where no sky is known, (2, n)."""
    angle = np.radians(observed.values("parallactic_angle", u.deg))
    return np.stack([np.sin(angle), np.cos(angle)])


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
