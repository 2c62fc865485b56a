"""Combine resampled exposures: mean, median, clipped mean, each with its variance, weight and count.

reproject's combinations reject nothing, and sigma clipping as in ccdproc takes all exposures to be equally sharp: where
the seeing varies it clips the cores of stars. Here what seeing and shifts can do is allowed for (`confirmed`), pixel by
pixel with the errors that are known.
"""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

_CLIP_SIGMA = 4.0  # limit of what is kept, in units of the noise
_GROW_SIGMA = 2.0  # ... beside what was rejected: the skirts of cosmic rays
_TOLERANCE = 0.15  # share of the signal by which equally sharp exposures may differ
_SLOPE = 0.4  # ... and of the step to the neighbours: shifts of some tenths of a pixel
_NEIGHBOUR_SIGMA = 3.0  # of such a step is noise
_UNKNOWN = 1.3  # ratio of the largest to the smallest FWHM that is allowed for where none is known


class PixelFlag(IntFlag):
    """What is to be known of a pixel of a mosaic."""

    EXTRAPOLATED = 1  #: the distortion of an exposure that contributes is extrapolated here
    SATURATED = 2  #: saturated in all exposures; their values are used for want of better ones
    REJECTED = 4  #: an exposure was rejected as a cosmic ray or the like


@dataclass(frozen=True, eq=False, repr=False)
class Combined:
    """A combination of exposures on a block of the output grid.

    Attributes
    ----------
    data, variance : ndarray of float32, shape (ny, nx)
        NaN where nothing contributes.
    weight : ndarray of float32, shape (ny, nx)
        Sum of the weights of what contributes.
    keep : ndarray of bool, shape (k, ny, nx)
        Which exposures contribute.
    """

    data: np.ndarray
    variance: np.ndarray
    weight: np.ndarray
    keep: np.ndarray

    @property
    def count(self):
        """Number of exposures that contribute, int32, shape (ny, nx)."""
        return self.keep.sum(axis=0, dtype=np.int32)

    def __repr__(self):
        k, ny, nx = self.keep.shape
        return f"<Combined: {nx} x {ny} px, {k} exposures>"


def combine(
    data,
    variance,
    weight,
    *,
    method="mean",
    level=0.0,
    photons=None,
    spare=None,
    fwhm=None,
    widths=None,
    compiled=False,
):
    """Combine exposures on a block of the output grid.

    Parameters
    ----------
    data : ndarray, shape (k, ny, nx)
        Resampled exposures at one flux scale and background; NaN where there are none.
    variance : array_like
        Of the data; broadcast to their shape.
    weight : array_like
        Of exposures (k, 1, 1) or of their pixels.
    method : {'mean', 'median', 'clipped'}
        Weighted mean; median; or weighted mean of what the median of at least three exposures confirms (`confirmed`).
    level : float
        Background, from which the signal is counted.
    photons : array_like, shape (k,), optional
        Relative growth of the variance of each exposure with the combined signal, by photons that are not in
        `variance`. Clipping does not allow for them.
    spare : ndarray of bool, shape (k, ny, nx), optional
        Pixels that are used only where no exposure has others, such as saturated ones.
    fwhm, widths
        As for `confirmed`.
    compiled : bool
        By the loops of `legdistort.coaddition.compiled_combination`; all arrays are then of float32.

    Returns
    -------
    Combined
        A pixel depends on data not farther away than `margin`: blocks that are to fit together must overlap by it.
    """
    use = np.isfinite(data)
    if spare is not None:
        first = use & ~spare
        use = np.where(first.any(axis=0), first, use)
        data = np.where(use, data, np.nan)
    weight = np.broadcast_to(np.asarray(weight, dtype=np.float32), data.shape)
    if method == "median":
        return _median(data, variance, weight, use, level=level, photons=photons)
    keep = use
    if method == "clipped":
        keep = confirmed(data, variance, use, level=level, fwhm=fwhm, widths=widths, compiled=compiled)
    if compiled:
        from . import compiled_combination

        growth = np.zeros(len(data), np.float32) if photons is None else np.asarray(photons, dtype=np.float32)
        return Combined(*compiled_combination.weighted_mean(data, variance, weight, keep, growth, level), keep)
    total, mean, spread = np.zeros((3, *data.shape[1:]))
    with np.errstate(invalid="ignore", divide="ignore"):
        for w, d, k in zip(weight, data, keep, strict=True):
            total += np.where(k, w, 0)
            mean += np.where(k, w * d, 0)
        mean /= total
        variance = np.broadcast_to(_with_photons(variance, photons, mean - level), data.shape)
        for w, v, k in zip(weight, variance, keep, strict=True):
            spread += np.where(k, w * w * v, 0)
        return Combined(*(plane.astype(np.float32) for plane in (mean, spread / total**2, total)), keep)


def _with_photons(variance, photons, signal):
    if photons is None:
        return variance
    return variance * (1 + np.reshape(photons, (-1, 1, 1)) * np.fmax(signal, 0)).astype(np.float32)


def margin(method, widths=None):
    """Pixels by which blocks must overlap for their pixels not to depend on the blocks.

    Parameters
    ----------
    method : str
        As for `combine`.
    widths : tuple, optional
        As for `confirmed`.
    """
    return _reach(widths) + 1 if method == "clipped" else 0


def _reach(widths):
    """Half the side of the neighbourhood whose steps are allowed for, pixels."""
    return 1 if widths is None else max(1, round(widths[1] / 3))


def _median(data, variance, weight, use, *, level, photons):
    count = use.sum(axis=0)
    centre = (_ranked(data, count, low=True) + _ranked(data, count, low=False)) / 2
    variance = _with_photons(variance, photons, centre - level)
    with np.errstate(invalid="ignore", divide="ignore"):
        # That of the mean if errors are equal, else asymptotically less: with few exposures between the two. Then what
        # n is: 1, 1, 1.35, 1.19, 1.43, 1.29 ... pi/2 (within 4 %).
        of_mean = np.where(use, variance, 0).sum(axis=0) / count**2
        of_many = count / np.where(use, 1 / np.sqrt(variance), 0).sum(axis=0) ** 2
        few = np.where(count > 2, 1 / count, 1)
        spread = of_mean**few * of_many ** (1 - few)
        excess = np.where(count > 2, np.pi / 2 * count / (count + np.where(count % 2, 0.48, 1.3)), 1)
        spread = np.where(count > 0, excess * spread, np.nan)
    return Combined(centre.astype(np.float32), spread.astype(np.float32), np.where(use, weight, 0).sum(axis=0), use)


def confirmed(data, variance, use, *, level=0.0, fwhm=None, widths=None, compiled=False):
    """Which pixels of exposures the others confirm: cosmic rays, hot pixels and trails are not.

    Where at least three exposures meet, what differs from their median (of an even number, the lower of the
    two in the middle: more light is the usual fault) by more than the sum of these is rejected:

    - 4 sigma of the pixel and of the median;
    - a share of the step to the largest (smallest) median in the neighbourhood, less noise: 0.4 for stars that are
      shifted or sampled a little differently (as drizzlepac allows for the derivative of its blotted median), and
      more the more exposures differ in sharpness, for their wings;
    - a share of the signal: 15 %, and what the peak of a star differs by from that in the exposure of mean sharpness.

    What lies beside it is then held to 2 sigma instead of 4.

    Parameters
    ----------
    data, variance : ndarray, shape (k, ny, nx)
    use : ndarray of bool, shape (k, ny, nx)
        Which pixels take part; data are NaN elsewhere.
    level : float
        Background, from which the signal is counted.
    fwhm : array_like, shape (k,), optional
        Of stars in the exposures [px]. Without it, it is allowed to differ by 30 %: stars are spared, but so are
        cosmic rays on them that are fainter than the star.
    widths : tuple, optional
        The smallest and the largest FWHM of all exposures, if there are others elsewhere.
    compiled : bool
        As for `combine`.

    Returns
    -------
    ndarray of bool, shape (k, ny, nx)
        At least one wherever `use` has one.
    """
    count = use.sum(axis=0)
    if np.max(count, initial=0) < 3:
        return use
    if widths is None and fwhm is not None:
        widths = np.min(fwhm), np.max(fwhm)
    centre, noise = _median_and_noise(data, variance, use, count, compiled)
    slope = _SLOPE + 2.5 * ((_UNKNOWN if widths is None else widths[1] / widths[0]) - 1)
    rise, fall = _steps(centre, noise, _reach(widths))
    which, excess, sigma = _outlying(data, np.broadcast_to(variance, data.shape), use & (count >= 3), centre, noise)
    signal = np.maximum(centre.ravel()[which[1]] - level, 0)
    above, below = _shares(fwhm, use, count, which)
    rise, fall = rise.ravel()[which[1]], fall.ravel()[which[1]]
    high = excess > 0
    np.abs(excess, out=excess)
    excess -= np.where(high, above * signal + slope * rise, below * signal + slope * fall)
    keep = use.copy()
    bad = excess > _CLIP_SIGMA * sigma
    if bad.any():
        near = np.zeros(use.shape, dtype=bool)  # and eight neighbours: five times faster than binary_dilation
        near.reshape(len(near), -1)[which[0][bad], which[1][bad]] = True
        for axis in (1, 2):
            one = near.swapaxes(0, axis).copy()
            near.swapaxes(0, axis)[1:] |= one[:-1]
            near.swapaxes(0, axis)[:-1] |= one[1:]
        bad |= near.reshape(len(near), -1)[which] & (excess > _GROW_SIGMA * sigma)
        keep.reshape(len(keep), -1)[which[0][bad], which[1][bad]] = False
    return keep | (use & ~keep.any(axis=0))


def _median_and_noise(data, variance, use, count, compiled):
    """Lower median of what is used, `count` of them, and the error of a median with these variances."""
    if compiled:
        from . import compiled_combination

        if len(data) <= compiled_combination.MOST:
            return compiled_combination.median_and_noise(data, variance, use)
    with np.errstate(invalid="ignore", divide="ignore"):
        noise = np.where(use, 1 / np.sqrt(variance), 0).sum(axis=0)
        return _ranked(data, count, low=True), (np.sqrt(np.pi / 2 * count) / noise).astype(np.float32)


def _outlying(data, variance, use, centre, noise):
    """Pixels that differ from the median by about `_GROW_SIGMA` or more: the few that are to be judged.

    Returns
    -------
    which : tuple of ndarray of int, shape (n,)
        Exposures, and pixels of a flattened plane.
    excess, sigma : ndarray, shape (n,)
        Difference from the median, and its error.
    """
    which = []
    for d, v, used in zip(data, variance, use, strict=True):  # planes that stay in the processor's cache
        with np.errstate(invalid="ignore"):
            which.append(np.flatnonzero(used & ((d - centre) ** 2 > 0.99 * _GROW_SIGMA**2 * (v + noise**2))))
    which = np.repeat(np.arange(len(data)), [len(pixels) for pixels in which]), np.concatenate(which)
    data, variance = (planes.reshape(len(planes), -1)[which] for planes in (data, variance))
    return which, data - centre.ravel()[which[1]], np.sqrt(variance + noise.ravel()[which[1]] ** 2)


def _steps(centre, noise, reach):
    """Steps of an image up and down to the extremes of the neighbourhood of each pixel, less noise; at least zero."""
    seen, size = np.isfinite(centre), 2 * reach + 1
    high = maximum_filter(np.where(seen, centre, -np.inf), size, mode="nearest")
    low = minimum_filter(np.where(seen, centre, np.inf), size, mode="nearest")
    slack = np.where(seen, _NEIGHBOUR_SIGMA * noise, np.inf)
    with np.errstate(invalid="ignore"):
        return np.fmax(high - centre - slack, 0), np.fmax(centre - low - slack, 0)


def _shares(fwhm, use, count, which):
    """Shares of the signal by which pixels, as of `_outlying`, may lie above and below the median."""
    if fwhm is None:
        return _TOLERANCE + _UNKNOWN**2 - 1, _TOLERANCE + 1 - _UNKNOWN**-2
    fwhm, (exposure, pixel) = np.asarray(fwhm, dtype=np.float32), which
    with np.errstate(invalid="ignore", divide="ignore"):
        used = np.take(use.reshape(len(use), -1), pixel, axis=1) * fwhm[:, None]
        ratio = (used.sum(axis=0) / count.ravel()[pixel] / fwhm[exposure]) ** 2  # of peaks: as the inverse square
    return _TOLERANCE + 1.3 * np.fmax(ratio - 1, 0), _TOLERANCE + 1.3 * np.fmax(1 - ratio, 0)


def _ranked(data, count, *, low):
    """Lower or higher median along the first axis of what is not NaN, `count` of them; NaN where there is none."""
    ordered = np.sort(data, axis=0)  # NaN comes last
    index = (count - 1) // 2 if low else np.minimum(count // 2, len(data) - 1)
    return np.take_along_axis(ordered, np.maximum(index, 0)[None], 0)[0]
