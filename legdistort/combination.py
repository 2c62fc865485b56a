"""Combine resampled exposures: mean, median, clipped mean, each with its variance and footprint."""

import numpy as np

METHODS = ("mean", "median", "clipped")
_CLIP_SIGMA, _CLIP_FRACTION = 4.0, 0.3
_ROWS = 64  # rows combined at a time


def combiner(method, shape, level):
    """An empty combination.

    Parameters
    ----------
    method : {'mean', 'median', 'clipped'}
        One of `METHODS`.
    shape : tuple
        ``(ny, nx)`` of the result.
    level : float
        Background level, from which the signal is counted when clipping.

    Returns
    -------
    object
        With ``add(data, variance, window, weight)``, NaN in the data meaning nothing there, and
        ``result() -> data, variance, footprint``.
    """
    return _Mean(shape) if method == "mean" else _Stack(shape, method, level)


class _Mean:
    """Weighted mean as running sums."""

    def __init__(self, shape):
        self._sum, self._weight, self._variance = np.zeros((3, *shape))
        self._count = np.zeros(shape, dtype=np.int32)

    def add(self, data, variance, window, weight):
        good = np.isfinite(data)
        self._sum[window] += np.where(good, weight * data, 0)
        self._weight[window] += weight * good
        self._variance[window] += np.where(good, weight**2 * variance, 0)
        self._count[window] += good

    def result(self):
        with np.errstate(invalid="ignore", divide="ignore"):
            mean, variance = self._sum / self._weight, self._variance / self._weight**2
        return mean.astype(np.float32), variance.astype(np.float32), self._count


class _Stack:
    """Median or clipped mean; the resampled exposures are kept as float32 and combined by bands of rows."""

    def __init__(self, shape, method, level):
        self._shape, self._level = shape, level
        self._combine = {"median": self._median, "clipped": self._clipped}[method]
        self._pieces = []

    def add(self, data, variance, window, weight):
        variance = np.broadcast_to(variance, data.shape).astype(np.float32)
        self._pieces.append((data.astype(np.float32), variance, window, weight))

    def result(self):
        out = [np.full(self._shape, np.nan, dtype=np.float32) for _ in range(2)]
        out.append(np.zeros(self._shape, dtype=np.int32))
        for start in range(0, self._shape[0], _ROWS):
            band = self._band(start, min(start + _ROWS, self._shape[0]))
            if band is not None:
                for plane, value in zip(out, self._combine(*band), strict=True):
                    plane[start : start + _ROWS] = value
        return tuple(out)

    def _band(self, start, stop):
        """Data and variance (k, rows, nx) of the exposures in a band of rows, and their weights."""
        parts = [p for p in self._pieces if p[2][0].start < stop and p[2][0].stop > start]
        if not parts:
            return None
        stacks = np.full((2, len(parts), stop - start, self._shape[1]), np.nan, dtype=np.float32)
        for i, (data, variance, (rows, columns), _) in enumerate(parts):
            low, high = max(start, rows.start), min(stop, rows.stop)
            for stack, plane in zip(stacks, (data, variance), strict=True):
                stack[i, low - start : high - start, columns] = plane[low - rows.start : high - rows.start]
        return *stacks, np.array([p[3] for p in parts]).reshape(-1, 1, 1)

    def _median(self, data, variance, weights):
        good = np.isfinite(data)
        count = good.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = np.where(good, variance, 0).sum(axis=0) / count**2
            # Variance of a median of n over that of a mean: 1, 1, 1.35, 1.19, 1.43, 1.29 ... pi/2 (within 4 %).
            excess = np.where(count > 2, np.pi / 2 * count / (count + np.where(count % 2, 0.48, 1.3)), 1)
        return _median_of(data, count), excess * spread, count

    def _clipped(self, data, variance, weights):
        good = np.isfinite(data)
        count = good.sum(axis=0)
        centre = _median_of(data, count)
        with np.errstate(invalid="ignore", divide="ignore"):
            limit = _CLIP_SIGMA * np.sqrt(variance) + _CLIP_FRACTION * np.abs(centre - self._level)
            keep = good & ((np.abs(data - centre) <= limit) | (count < 3))
            keep |= good & ~keep.any(axis=0)
            w = weights * keep
            total = w.sum(axis=0)
            mean = np.where(keep, w * data, 0).sum(axis=0) / total
            return mean, np.where(keep, w**2 * variance, 0).sum(axis=0) / total**2, keep.sum(axis=0)


def _median_of(data, count):
    """Median along the first axis of what is not NaN, `count` of them."""
    ordered = np.sort(data, axis=0)  # NaN comes last
    low, high = (np.maximum(k, 0)[None] for k in ((count - 1) // 2, np.minimum(count // 2, len(data) - 1)))
    return (np.take_along_axis(ordered, low, 0)[0] + np.take_along_axis(ordered, high, 0)[0]) / 2
