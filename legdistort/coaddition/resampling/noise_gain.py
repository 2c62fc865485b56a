"""What resampling makes of noise: the variance of an output pixel, and the correlation of neighbours."""

from functools import lru_cache
from math import ceil

import numpy as np
from numpy.polynomial.polynomial import polyfit, polyval
from scipy.ndimage import map_coordinates


def noise_correlation(exposure_map, gain, resampling):
    """Noise of the sum of many pixels over that by the sum of their variances, in the middle of an exposure.

    Parameters
    ----------
    exposure_map : `~legdistort.coaddition.resampling.pixel_maps.ExposureMap`
    gain : float
        From `white_gain`.
    resampling : `~legdistort.coaddition.resampling.engines.Resampling`

    Returns
    -------
    float
    """
    x, y, _, _, area = exposure_map.middle()
    if resampling.algorithm != "interp":  # these lose no light: the sum has the noise of the pixels of the detector
        return float((gain * area.mean()) ** -0.5)
    along_x, along_y = (np.array([np.diff(p, axis=axis).mean() for p in (x, y)]) for axis in (1, 0))
    reach = min(200, ceil(20 / min(np.hypot(*along_x), np.hypot(*along_y))))
    i, k = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    step, correlation = _spline_correlation(resampling.order)
    lag = along_x[:, None, None] * k + along_y[:, None, None] * i
    both = [np.interp(np.abs(p), step * np.arange(len(correlation)), correlation, right=0) for p in lag]
    return float(np.sqrt((both[0] * both[1]).sum()))


@lru_cache
def _spline_correlation(order, n=32, reach=20):
    """Correlation of white noise after interpolation, at lags of so many n-th pixels: the step, and values."""
    impulse = np.zeros(4 * reach + 1)
    impulse[2 * reach] = 1
    kernel = map_coordinates(impulse, [np.arange(reach, 3 * reach, 1 / n)], order=order)
    values = np.correlate(kernel, kernel, "full")[len(kernel) - 1 :]
    return 1 / n, values / values[0]


def spline_gain(order, xy, compiled):
    """Variance of an interpolated pixel for unit white noise, from the fractions of its coordinates."""
    if compiled:
        from . import compiled_splines

        return compiled_splines.product(_gain_series(order), xy)
    fraction = xy.astype(np.float32)  # small numbers, since they count from the piece of the detector
    fraction -= np.floor(fraction)
    fraction *= 1 - fraction
    *rest, last = _gain_series(order)
    gain = np.full_like(fraction, last)
    for c in reversed(rest):  # in place: three times faster than polyval
        gain *= fraction
        gain += np.float32(c)
    return gain[0] * gain[1]


def mean_spline_gain(order):
    """The mean of `spline_gain` over the fractions of a pixel."""
    fraction = (np.arange(100) + 0.5) / 100
    return float(polyval(fraction * (1 - fraction), _gain_series(order)).mean() ** 2)


@lru_cache
def _gain_series(order, n=256, reach=20):
    """Sum of the squared weights of a spline at the fraction f of a pixel, as a polynomial in f (1 - f).

    It is one of that very degree for odd orders; even ones are met to 0.001.
    """
    impulse = np.zeros(2 * reach + 1)
    impulse[reach] = 1
    fraction = np.linspace(0, 1, n + 1)
    coordinates = reach + np.arange(-reach + 1, reach)[:, None] - fraction
    gain = (map_coordinates(impulse, [coordinates], order=order) ** 2).sum(axis=0)
    return polyfit(fraction * (1 - fraction), gain, order if order % 2 else 5)
