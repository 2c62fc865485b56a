"""Exposures prepared for resampling: bad pixels replaced, their noise and background known, their pixels put aside."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from ..inputs.frames.working_units import in_working_unit
from ..measurement.filters import fill_bad
from ..runtime.scratch import Stored, store
from .background import Background, measure_background


@dataclass(frozen=True, eq=False, repr=False)
class Prepared:
    """What co-adding keeps of an exposure.

    Attributes
    ----------
    stored : Stored
        Its planes: ``data``, with bad pixels filled; perhaps ``variance``, and the masks ``bad``, ``full`` (saturated)
        and ``rough`` (`rough_pixels`), where they hold any pixel.
    background : Background
    """

    stored: Stored
    background: Background


def prepare(frame, folder, unit=1.0):
    """Prepare an exposure.

    Parameters
    ----------
    frame : Exposure or ExposureFile
    folder : path
        For its planes.
    unit : float
        Factor on its data, as on its gain before (`legdistort.inputs.frames.working_units`).

    Returns
    -------
    Prepared or str
        The reason why it cannot be used.
    """
    exposure = in_working_unit(frame.read(), unit)
    bad, full = ~np.isfinite(exposure.data), np.zeros(exposure.shape, dtype=bool)
    if exposure.mask is not None:
        bad |= exposure.mask
    if bad.all():
        return "every pixel is masked"
    data, variance = fill_bad(exposure.data, bad), None
    if not data.any():
        return "every pixel is 0"
    if exposure.saturation is not None:
        full = ~bad & (data >= exposure.saturation)
    background = measure_background(exposure, bad=bad, filled=data)
    rough = rough_pixels(data, bad, full, background.noise)
    if exposure.uncertainty is not None:
        variance = np.square(exposure.uncertainty, dtype=np.float32)
        variance[bad] = np.mean(variance, where=~bad)
    masks = {"bad": bad, "full": full, "rough": rough}
    planes = {"data": data, "variance": variance} | {name: mask for name, mask in masks.items() if mask.any()}
    return Prepared(store(folder, planes), background)


def rough_pixels(data, bad, full, noise):
    """Pixels within five of a saturated one, or of a hole in the slope of a star: splines ring there.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
        Bad pixels replaced.
    bad, full : ndarray of bool, shape (ny, nx)
        Bad pixels and saturated ones.
    noise : float
        Of the background: a slope is where data within two pixels differ by more than ten times this; a hole is where
        most of these pixels are bad. Single bad pixels are replaced well enough.

    Returns
    -------
    ndarray of bool, shape (ny, nx)
    """
    rough = full.copy()
    y, x = np.nonzero(bad)
    if len(y):
        around = [_around(plane, y, x) for plane in (data, bad)]
        rough[y, x] = (np.ptp(around[0], axis=0) > 10 * noise) & (around[1].mean(axis=0) > 0.5)
    return binary_dilation(rough, np.ones((11, 11), dtype=bool)) if rough.any() else rough


def _around(plane, y, x):
    padded = np.pad(plane, 2, mode="edge")
    return np.stack([padded[y + i, x + k] for i, k in np.ndindex(5, 5)])
