"""Defects that no mask shows, found by their sharpness: hot pixels, bad columns and rows, cosmic rays.

No star is sharper than the point-spread function. A pixel is a defect if its two neighbours along x or along y have
less than half of the light that a star centred on it would leave them, and less by more than noise. Columns and rows
of which no pixel stands out are found by their means.
"""

from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from ..filters import fill_bad
from . import moffat

_HIGH = 8.0  # standard deviations of the sky from which pixels are asked
_CERTAIN = 3.0  # standard deviations by which light is missing beside a pixel
#: Part of the light beside a star centred on one pixel, and between two, that is asked for: in places stars may be
#: narrower than elsewhere. No more than half of what is beside stars of 3 pixels, and of a third of 2, is asked for.
_ASKED = (0.5, 0.3)
_AT_MOST = (0.4, 0.08)
_ROUNDS = 3
_LINE = 8  # pixels on either side, and two widths of the stars, of which half are defects: so is the one between
#: Means of columns and rows, cut at 3 sigma: by how many sigma they are off, and by how many times what is usual.
_WEAK, _ODD = 0.5, 8.0
_AROUND = 9  # columns or rows that one is compared with
_SPARED = 4  # of its pixels one is looked at
_LEAST = 25  # pixels that determine a mean
_POINT = 0.1  # of the light of a peak in either neighbour: less is no star of more than a pixel


def without_defects(frame, shape):
    """A frame in which defects have the light of the pixels around, and are marked.

    Parameters
    ----------
    frame : `~legdistort.measurement.detection.Frame`
    shape : ndarray, shape (4,)
        Of the stars of the frame.

    Returns
    -------
    Frame
        The same if there are none.
    """
    asked = _asked_of(shape)
    seen = frame.good & ~frame.saturated
    signal, defects = frame.signal, _weak_lines(frame, seen)
    if defects.any():
        signal = fill_bad(frame.signal, ~seen | defects, of=defects)
    for _ in range(_ROUNDS):
        found = _sharp(signal, seen, defects, frame, asked)
        if not len(found):
            break
        defects.flat[found] = True
        signal = fill_bad(frame.signal, ~seen | defects, of=defects)
    if not defects.any():
        return frame
    reach = _LINE + int(2 * moffat.fwhm(shape))
    lines = defects | _in_lines(defects, seen, reach) | _in_lines(defects.T, seen.T, reach).T
    return replace(frame, signal=fill_bad(frame.signal, ~seen | lines, of=lines), defects=lines)


def defect_peaks(data, frame):
    """The highest pixels of defects that are brighter than what is around them.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
    frame : `~legdistort.measurement.detection.Frame`
        Of these data, from `without_defects`.

    Returns
    -------
    pixels : ndarray of int, shape (n, 2)
        Pixels (x, y).
    height, sigma : ndarray, shape (n,)
        Above what is around, and the noise of that.
    """
    (ny, nx), (y, x) = data.shape, np.nonzero(frame.defects)
    height, sigma = data[y, x] - frame.sky[y, x] - frame.signal[y, x], np.sqrt(frame.variance[y, x])
    use = height > _HIGH * sigma
    y, x, height, sigma = y[use], x[use], height[use], sigma[use]
    highest = np.ones(len(x), dtype=bool)
    for k, (dy, dx) in enumerate(np.ndindex(3, 3)):
        beside = np.clip(y + dy - 1, 0, ny - 1), np.clip(x + dx - 1, 0, nx - 1)
        higher = (data[beside] >= data[y, x] if k < 4 else data[beside] > data[y, x]) & frame.defects[beside]
        highest &= ~higher | ((beside[0] == y) & (beside[1] == x))
    return np.column_stack([x, y])[highest], height[highest], sigma[highest]


def are_points(signal, limit, peaks):
    """Whether peaks have next to nothing beside them, along x or along y: defects, whatever the width of the stars.

    Parameters
    ----------
    signal : ndarray, shape (ny, nx)
    limit : ndarray, shape (n,)
        Height from which this can be told.
    peaks : ndarray of int, shape (n, 2)
        Pixels (x, y).

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    (ny, nx), (x, y) = signal.shape, peaks.T
    x, y = np.clip(x, 1, nx - 2), np.clip(y, 1, ny - 2)
    height = signal[y, x]
    beside = np.minimum(signal[y, x - 1] + signal[y, x + 1], signal[y - 1, x] + signal[y + 1, x])
    return (height > limit) & (beside < 2 * _POINT * height)


def _asked_of(shape):
    """Light asked for beside one pixel and beside two, relative to them, along x and y; ((2,), (2,))."""
    params = moffat.parameters(np.ones(3), shape, np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]))
    stars = moffat.evaluate(params, 2, moffat.quadrature(float(moffat.fwhm(shape)))).reshape(3, 5, 5)
    stars = stars / stars[:, 2:3, 2:3]
    single, double = (stars[0, 2, 3], stars[0, 3, 2]), (stars[1, 2, 4], stars[2, 4, 2])
    return [
        [min(share * ratio, most) for ratio in ratios]
        for ratios, share, most in zip((single, double), _ASKED, _AT_MOST, strict=True)
    ]


def _sharp(signal, seen, known, frame, asked):
    """Indices of pixels that are sharper than stars."""
    ny, nx = signal.shape
    high = np.flatnonzero((np.abs(signal) > _HIGH * np.sqrt(frame.variance)) & seen & ~known)
    if not len(high):
        return high
    y, x = np.divmod(high, nx)
    inside = (x > 1) & (x < nx - 3) & (y > 1) & (y < ny - 3)
    edge, high = high[~inside], high[inside]
    flat, variance, good = signal.ravel(), frame.variance.ravel()[high], seen.ravel()
    # without a gain as many photons as there can be: one in every unit of noise
    photon = np.sqrt(variance) if frame.photon is None else frame.photon
    sign = np.sign(flat[high])

    def lacks(pixels, neighbours, ratio):
        """Whether neighbours have too little of the light of pixels."""
        height, beside = (sign * sum(flat[high + k] for k in each) / 2 for each in (pixels, neighbours))
        n = len(set(pixels))
        noise = variance * (ratio**2 / n + 0.5) + photon * np.maximum(height, 0) * (ratio**2 / n + ratio / 2)
        certain = ratio * height - beside > _CERTAIN * np.sqrt(noise)
        return certain & good[high + neighbours[0]] & good[high + neighbours[1]]

    found = [edge[:0]]
    for k, step in enumerate((1, nx)):
        found.append(high[lacks((0, 0), (-step, step), asked[0][k])])
        two = high[lacks((0, step), (-step, 2 * step), asked[1][k]) & good[high + step]]
        found += [two, two + step]
    return np.unique(np.concatenate(found))


def _weak_lines(frame, seen):
    """Whole columns and rows of which the mean is not that of the ones around."""
    sigma = np.sqrt(np.median(frame.variance[::8, ::8]))
    odd = []
    for signal, good in ((frame.signal, seen), (frame.signal.T, seen.T)):
        signal, good = signal[::_SPARED], good[::_SPARED]
        total, n = np.where(good, np.clip(signal, -3 * sigma, 3 * sigma), 0).sum(axis=0), np.count_nonzero(good, axis=0)
        mean = np.where(n >= _LEAST, total / np.maximum(n, 1), 0.0)
        off = np.abs(mean - median_filter(mean, _AROUND, mode="nearest"))
        odd.append(off > max(_WEAK * sigma, _ODD * 1.4826 * np.median(off)))
    return (odd[0] | odd[1][:, None]) & seen


def _in_lines(defects, seen, reach):
    """Pixels of columns between defects: half of those around are."""
    out = np.zeros_like(defects)
    for x in np.flatnonzero(np.count_nonzero(defects, axis=0) > reach):
        column, good = defects[:, x] & seen[:, x], seen[:, x]
        around, n = (np.convolve(each, np.ones(2 * reach + 1))[reach:-reach] for each in (column, good))
        share = 0.5 * np.count_nonzero(good)
        out[:, x] = (around >= 0.5 * np.maximum(n, reach)) | (np.count_nonzero(column) >= share)
    return out & seen
