"""Compiled twins of loops over the exposures of a block, for mosaics of many pixels.

For few pixels, where loading numba would not pay, plain loops run. Both give the same numbers, but for rounding. The
inner loops run along rows, so that processors handle several pixels at a time.
"""

import numpy as np

from ..runtime.compiling import compiled_loop

#: Exposures up to which the median is found by exchanges, whose number grows with their square.
MOST = 32


@compiled_loop(nogil=True)
def _exchange(low, high):
    """Bring the lower one of each pair of values to the first row."""
    for c in range(len(low)):
        x, y = low[c], high[c]
        low[c] = x if x < y else y
        high[c] = y if x < y else x


@compiled_loop(nogil=True)
def median_and_noise(data, variance, use):
    """Lower median of what is used along the first axis, and the error of a median with these variances.

    Parameters
    ----------
    data, variance : ndarray of float32, shape (k, ny, nx)
    use : ndarray of bool, shape (k, ny, nx)

    Returns
    -------
    ndarray of float32, shape (ny, nx)
        Each; NaN where nothing is used.
    """
    k, ny, nx = data.shape
    centre, noise = np.empty((ny, nx), np.float32), np.empty((ny, nx), np.float32)
    rows, count, inverse = np.empty((k, nx), np.float32), np.empty(nx, np.int64), np.empty(nx, np.float32)
    for r in range(ny):
        count[:], inverse[:] = 0, 0
        for i in range(k):
            row, d, v, u = rows[i], data[i, r], variance[i, r], use[i, r]
            for c in range(nx):
                row[c] = d[c] if u[c] else np.float32(np.inf)
                count[c] += u[c]
                inverse[c] += np.float32(1) / np.sqrt(v[c]) if u[c] else np.float32(0)
        for first in range((k + 1) // 2):  # up to the median they are brought into order
            for other in range(first + 1, k):
                _exchange(rows[first], rows[other])
        for c in range(nx):
            n = count[c]
            centre[r, c] = rows[(n - 1) // 2, c] if n else np.nan
            noise[r, c] = np.sqrt(np.pi / 2 * n) / inverse[c] if n else np.nan
    return centre, noise


@compiled_loop(nogil=True)
def weighted_mean(data, variance, weight, keep, photons, level):
    """Weighted mean of what is kept along the first axis, its variance, and the sum of the weights.

    Parameters
    ----------
    data, variance, weight : ndarray of float32, shape (k, ny, nx)
    keep : ndarray of bool, shape (k, ny, nx)
    photons : ndarray of float32, shape (k,)
        Relative growth of each variance with the mean above the level.
    level : float

    Returns
    -------
    ndarray of float32, shape (3, ny, nx)
        The first two NaN where nothing is kept.
    """
    k, ny, nx = data.shape
    out = np.empty((3, ny, nx), np.float32)
    total, mean, spread, signal = np.empty(nx), np.empty(nx), np.empty(nx), np.empty(nx)
    for r in range(ny):
        total[:], mean[:], spread[:] = 0, 0, 0
        for i in range(k):
            d, w, used = data[i, r], weight[i, r], keep[i, r]
            for c in range(nx):
                total[c] += w[c] if used[c] else np.float32(0)
                mean[c] += w[c] * d[c] if used[c] else np.float32(0)
        for c in range(nx):
            mean[c] = mean[c] / total[c] if total[c] else np.nan
            signal[c] = max(mean[c] - level, 0.0)
        for i in range(k):
            v, w, used, p = variance[i, r], weight[i, r], keep[i, r], photons[i]
            for c in range(nx):
                spread[c] += w[c] * w[c] * v[c] * (1 + p * signal[c]) if used[c] else 0.0
        for c in range(nx):
            out[0, r, c], out[2, r, c] = mean[c], total[c]
            out[1, r, c] = spread[c] / total[c] ** 2 if total[c] else np.nan
    return out
