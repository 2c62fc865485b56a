"""The sky of a frame, the smooth light around its stars (halos, unresolved stars), and the noise of both."""

import logging
import warnings
from typing import NamedTuple

import numpy as np
from astropy.stats import SigmaClip
from photutils.background import Background2D
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import maximum_filter1d, median_filter

from .filters import gaussian, gaussian_sums

log = logging.getLogger(__name__)

_DARK = 2.5  # filtered signal, in its noise, up to which a pixel determines the noise of the sky
_CLIP = 3.0  # standard deviations beyond which a pixel is left out of the noise
#: Variance of a unit normal clipped at `_CLIP` (0.973), then where the filtered image is within `_DARK` of its noise.
_REMAINS = 0.973 * 0.975
_SETTLED = 0.03
_ROUNDS = 5  # from a noise that is several times too high, in crowded fields
_BRIGHT = 5.0  # standard deviations of a binned pixel above the light around it: part of a star
_ENOUGH = 1_000_000  # pixels: of more every fourth serves
_FEWEST = 50  # pixels of a mesh that determine its noise
_POWERS = (0, 0), (1, 0), (0, 1), (2, 0), (0, 2), (1, 1)  # of y and x, of the moments of a plane
_STEPS = 12  # of light, for the photon noise
_BESIDE = 16  # columns or rows on either side that determine a step between amplifiers
_BLOCKS, _AGREE = 8, 6  # of rows, of a half; those that have about the same step
_AWAY = 0.5  # of a step, by which it may differ in a block
_SINGLE = 5  # columns of which the median is taken
_JUMP = 3  # of them next to it, which have the whole step
_SHOWN = 100_000  # pixels of either half of a frame that serve for that
_SURE = 10.5  # standard deviations: columns of dense fields, where a star is in every block, have up to 10


def amplifier_levels(data, mask):
    """Levels of the amplifiers of a detector, sharp steps of the sky: between columns, between rows, of quadrants.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
    mask : ndarray of bool, shape (ny, nx)
        Pixels that do not count.

    Returns
    -------
    ndarray, shape (ny, nx), or None
        None if there are no steps. The first amplifier is at 0.
    """
    by_columns = _half_levels(data, mask, 0.0)
    rest = 0.0 if by_columns is None else by_columns
    by_rows = _half_levels(data.T, mask.T, np.transpose(rest))
    if by_rows is None:
        return by_columns
    return np.asarray(rest + by_rows.T, dtype=data.dtype)


def _half_levels(data, mask, known):
    """Levels of columns, of the upper and the lower half by themselves where they differ; `known` ones are off."""
    ny, nx = data.shape
    if nx <= 4 * _BESIDE or ny < _BESIDE:
        return None
    halves = np.arange(ny // 2), np.arange(ny // 2, ny)
    steps = []
    for rows in halves:
        rows = rows[:: max(1, len(rows) * nx // _SHOWN)]
        steps.append(_steps(data[rows] - (known[rows] if np.ndim(known) else known), mask[rows]))
    tiny = np.finfo(float).tiny
    sure = np.sqrt(sum(each.agree * (each.step / max(each.noise, tiny)) ** 2 for each in steps))
    size = np.where(sure > _SURE, sum(np.abs(each.step) + each.edge for each in steps), 0)
    # beside a step there is half of it, the other way
    found = np.flatnonzero((size > 0) & (size == maximum_filter1d(size, 3 * _BESIDE + 1)))
    if not len(found):
        return None
    out = np.zeros_like(data)
    for rows, own, other in zip(halves, steps, steps[::-1], strict=True):
        step, beside = own.step[found], other.step[found]
        # stars on a step may hide it in one half
        same = np.abs(step - beside) < np.where(
            own.agree[found], 3.0 * np.hypot(own.noise, other.noise), _AWAY * np.abs(beside)
        )
        both = np.where(own.agree[found], (step + beside) / 2, beside)
        across = np.zeros(nx)
        across[found] = np.where(same, both, np.where(own.agree[found], step, 0))
        out[rows] = np.cumsum(across)
    return out


class _Steps(NamedTuple):
    """The step before every column, whether it is sharp and the same in all blocks; its noise; a sharper estimate."""

    step: np.ndarray
    agree: np.ndarray
    noise: float
    edge: np.ndarray


def _steps(data, mask):
    """`_Steps` of some rows: medians over blocks of them.

    Stars are in one block or two, amplifiers in all.
    """
    rows = len(data) // _BLOCKS * _BLOCKS
    few = np.count_nonzero(mask, axis=0) > len(data) / 2
    if np.count_nonzero(~few) <= 4 * _BESIDE:
        return _Steps(np.zeros(len(few)), np.zeros(len(few), dtype=bool), 0.0, np.zeros(len(few)))
    columns = np.array(data[:rows].T, dtype=np.float32)
    if mask.any():
        columns[mask[:rows].T] = np.median(columns[~mask[:rows].T])
    ordered = np.sort(columns.reshape(len(few), _BLOCKS, -1), axis=2)  # of a few values faster than their medians
    n = ordered.shape[2]
    level = (ordered[:, :, (n - 1) // 2] + ordered[:, :, n // 2]).T / 2
    level[:, few] = np.nan
    level = median_filter(np.where(few, np.nanmedian(level), level), (1, _SINGLE), mode="nearest")  # bad columns
    total = np.pad(np.cumsum(level, axis=1, dtype=float), ((0, 0), (1, 0)))

    def difference(width):
        out, at = np.zeros(level.shape), np.arange(width, len(few) - width)
        out[:, at] = (total[:, at + width] - 2 * total[:, at] + total[:, at - width]) / width
        return out

    wide, near = difference(_BESIDE), difference(_JUMP)
    slope = (np.roll(wide, _BESIDE, axis=1) + np.roll(wide, -_BESIDE, axis=1)) / 2
    each = wide - slope
    step = np.median(each, axis=0)
    noise = 1.25 / np.sqrt(_BLOCKS) * 1.4826 * np.median(np.abs(each - step)[:, 2 * _BESIDE : -2 * _BESIDE])
    step[: 2 * _BESIDE] = step[-2 * _BESIDE :] = 0
    agree = np.count_nonzero(np.abs(each - step) < _AWAY * np.abs(step), axis=0) >= _AGREE
    # a step is the same next to it and farther away, which the light of a star is not
    far = 2 * wide - difference(_BESIDE // 2) - 1.5 * slope
    for other in (near - slope * _JUMP / _BESIDE, far):
        agree &= np.abs(np.median(other, axis=0) - step) < 0.3 * np.abs(step) + 2.0 * noise
    return _Steps(step, agree, noise, np.abs(np.median(difference(1), axis=0)))


def sky_and_noise(data, mask, mesh, *, steep=False):
    """Sky and its standard deviation, smooth maps; of a steep sky no medians of meshes are taken.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
    mask : ndarray of bool, shape (ny, nx)
        Pixels that do not count.
    mesh : int
        Pixels over which the sky is taken as constant.
    steep : bool

    Returns
    -------
    sky, rms : ndarray, shape (ny, nx)
    """
    box, shape = tuple(min(mesh, n) for n in data.shape), data.shape
    clip = SigmaClip(sigma=3.0, maxiters=10)
    high = box[0]
    if data.size >= _ENOUGH and mesh % 8 == 0:  # whole rows, even and odd ones: detectors have patterns
        rows = np.flatnonzero(np.isin(np.arange(len(data)) % 8, (0, 3)))
        data, mask, high = data[rows], mask[rows], high // 4
    with warnings.catch_warnings(action="ignore"):  # of meshes without good pixels, which are interpolated
        for exclude in (50.0, 100.0):
            try:
                found = Background2D(
                    data,
                    (high, box[1]),
                    mask=mask,
                    sigma_clip=clip,
                    exclude_percentile=exclude,
                    filter_size=1,
                    bkg_estimator=_mode,
                )
            except ValueError:
                log.debug("background: too few good pixels with exclude_percentile=%g", exclude)
            else:
                sky, rms = found.background_mesh, found.background_rms_mesh
                if not steep:  # photutils would filter it with a loop in Python
                    sky, rms = _medians_around(sky), _medians_around(rms)
                return _enlarge(sky, box, shape, degree=3 if steep else 2), _enlarge(rms, box, shape).clip(rms.min())
    values = clip(data[~mask] if not mask.all() else data.ravel(), masked=False)
    return tuple(np.full(shape, value, dtype=data.dtype) for value in (np.median(values), np.std(values)))


def _mode(values, axis=None):
    """The estimate of `photutils.background.SExtractorBackground`, in a fifth of the time.

    2.5 medians less 1.5 means; the median where these differ by more than 0.3 standard deviations. NaN do not count.
    `numpy.nanmedian` would loop over the meshes in Python.
    """
    if not values.size:  # of a corner without a good pixel clipping leaves nothing
        return np.nan
    axes = range(values.ndim) if axis is None else np.atleast_1d(axis)
    ordered = np.moveaxis(values, axes, range(-len(axes), 0))
    ordered = np.sort(ordered.reshape(*ordered.shape[: -len(axes)], -1))  # NaN come last
    n, mean, std = np.count_nonzero(~np.isnan(ordered), axis=-1), np.nanmean(values, axis), np.nanstd(values, axis)
    middle = (np.take_along_axis(ordered, np.maximum(k, 0)[..., None], -1)[..., 0] for k in ((n - 1) // 2, n // 2))
    median = sum(middle) / 2
    mode = np.where(np.abs(mean - median) / std >= 0.3, median, 2.5 * median - 1.5 * mean)
    return np.where(std == 0, mean, mode)


def is_steep(sky, rms, mesh):
    """Whether the sky rises across a mesh by as much as the noise, somewhere."""
    step = max(1, mesh // 2)
    coarse, noise = sky[::step, ::step], rms[::step, ::step]
    return any(np.any(np.abs(np.diff(coarse, axis=i)) > 0.5 * np.delete(noise, 0, axis=i)) for i in (0, 1))


def _enlarge(mesh, box, shape, degree=2):
    """A mesh spread over all pixels (the function of photutils takes as long as all the fits).

    Degree 2: by quadratic B-splines that have the values of the mesh as coefficients, linear beyond its first and last
    centre. Interpolation of degree 1 would have edges, which pass for stars in crowded fields, and 3 would overshoot.
    """
    across = []
    for n_mesh, width, n in zip(mesh.shape, box, shape, strict=True):
        at = (np.arange(n) + 0.5) / width - 0.5
        if degree == 3 or n_mesh == 1:
            matrix = make_interp_spline(np.arange(n_mesh), np.eye(n_mesh), k=min(3, n_mesh - 1))(at)
        else:
            matrix = BSpline(np.arange(-2.5, n_mesh + 2), _extended(n_mesh), 2)(at)
        across.append(matrix.astype(np.float32))
    return across[0] @ mesh.astype(np.float32) @ across[1].T


def _extended(n):
    """Matrix (n + 2, n) that continues n values linearly by one on either side."""
    out = np.pad(np.eye(n), ((1, 1), (0, 0)))
    out[0, :2] = out[-1, :-3:-1] = 2, -1
    return out


def smooth_light(signal, good, sigma, *, variance=None):
    """The light around every pixel: of the plane fitted to its surroundings, the value at the pixel.

    A plane, because a mean would be wrong on slopes beside edges and gaps. The weights of the fit are Gaussian; it is
    made on pixels binned so that 2 to 4 of them make up `sigma`, and interpolated.

    Parameters
    ----------
    signal : ndarray, shape (ny, nx)
    good : ndarray of bool, shape (ny, nx)
        Pixels that count.
    sigma : float
        Standard deviation of the weights [pix].
    variance : ndarray, shape (ny, nx), optional
        Of a pixel. If given, the fit is made once more without what stands out by `_BRIGHT` standard deviations: the
        cores of stars.

    Returns
    -------
    level : ndarray, shape (ny, nx)
    extrapolated : ndarray, shape (ceil(ny / step), ceil(nx / step))
        By how much the plane differs from a mean, in the binned pixels.
    step : int
        Pixels binned along each axis.
    """
    step, (n, total), whole = _counted(signal, good, sigma)
    level, extrapolated = _planes(n, total, sigma / step, whole=whole)
    if variance is not None:
        faint = total - n * level < _BRIGHT * np.sqrt(n * variance[::step, ::step])
        level, extrapolated = _planes(n * faint, total * faint, sigma / step)
    return _spread(level, step, signal.shape), extrapolated, step


def mean_light(signal, good, sigma):
    """Means around binned pixels, with Gaussian weights; and the pixels binned along each axis."""
    step, (n, total), whole = _counted(signal, good, sigma)
    (total,) = gaussian_sums(total, sigma / step)
    weight = _moments(n, sigma / step, 0)[0] if whole else gaussian_sums(n, sigma / step)[0]
    return total / np.maximum(weight, np.finfo(n.dtype).eps), step


def _counted(signal, good, sigma):
    """Pixels binned along each axis; number of good ones and their sum in these bins; whether all are good."""
    step, whole = max(1, int(sigma / 2)), good.all()
    if whole:
        rows, columns = (np.add.reduceat(np.ones(n, signal.dtype), np.arange(0, n, step)) for n in signal.shape)
        return step, (np.outer(rows, columns), _binned(signal, step)), whole
    return step, (_binned(good.astype(signal.dtype), step), _binned(np.where(good, signal, 0), step)), whole


def _moments(n, width, order):
    """`gaussian_sums` of `n` up to an order, where `n` is a product of functions of y and of x."""
    out = []
    for part in (n[:, 0] / n[0, 0], n[0]):
        weights = [gaussian(width, power) for power in range(order + 1)]
        padded = np.pad(part, len(weights[0]) // 2)
        out.append([np.correlate(padded, weight, "valid").astype(n.dtype) for weight in weights])
    return [np.outer(out[0][i], out[1][j]) for i, j in _POWERS if i + j <= order]


def _planes(n, total, width, *, whole=False):
    """Values of planes fitted around all pixels, and how much they differ from means.

    Parameters
    ----------
    n, total : ndarray, shape (ny, nx)
        Number of measurements in a pixel, and their sum.
    width : float
        Standard deviation of the Gaussian weights.
    whole : bool
        Whether no measurement is missing; sums of `n` are then products.
    """
    area = width**2
    weight, *moments = _moments(n, width, 2) if whole else gaussian_sums(n, width, _POWERS)
    weight = 1 / (weight + np.finfo(n.dtype).eps)
    mean, by_y, by_x = (sums * weight for sums in gaussian_sums(total, width, _POWERS[:3]))
    y, x, yy, xx, xy = (moment * weight for moment in moments)
    # never narrower than a quarter of the Gaussian's width: what is left of a star beside a gap determines no slope
    xx, yy = np.maximum(xx - x**2, 0.06 * area), np.maximum(yy - y**2, 0.06 * area)
    xy, by_x, by_y = xy - x * y, by_x - x * mean, by_y - y * mean
    determinant = np.maximum(xx * yy - xy**2, 0.02 * area**2)
    shift = ((yy * by_x - xy * by_y) * x + (xx * by_y - xy * by_x) * y) / determinant
    return mean - shift, np.abs(shift)


def _binned(image, step):
    """Sums over squares of pixels, the last ones padded with zeros."""
    ny, nx = image.shape
    if step == 1:
        return image
    if ny % step or nx % step:
        image = np.pad(image, ((0, -ny % step), (0, -nx % step)))
    rows = sum(image[i::step] for i in range(step))
    return sum(rows[:, j::step] for j in range(step))


def _spread(image, step, shape):
    """Binned pixels interpolated linearly to all pixels."""
    for n in shape[::-1]:
        padded = np.pad(np.ascontiguousarray(image.T), ((1, 1), (0, 0)), mode="edge")
        image = np.empty((step * (len(padded) - 2), padded.shape[1]), dtype=image.dtype)
        for i in range(step):
            off = (i + 0.5) / step - 0.5  # from the middle of the bin
            beside = padded[2:] if off > 0 else padded[:-2]
            image[i::step] = (1 - abs(off)) * padded[1:-1] + abs(off) * beside
        image = image[:n]
    return image


def sky_variance(residual, filtered, light, good, *, start, noise, photon, mesh, floor):
    """Variance of the sky at the level 0, without the photons of halos, from pixels on which no star is seen.

    Parameters
    ----------
    residual : ndarray, shape (ny, nx)
        Signal without the smooth light.
    filtered : ndarray, shape (ny, nx)
        The same filtered, which determines where stars are.
    light : ndarray, shape (ny, nx)
        The smooth light.
    good : ndarray of bool, shape (ny, nx)
    start : ndarray, shape (ny, nx)
        Variance that may be too high.
    noise : float
        Variance of `filtered` where that of a pixel is 1.
    photon : float or None
        Variance per unit of light; None: estimated, for this purpose alone.
    mesh : int
        Pixels over which it is taken as constant.
    floor : float
        The least it can be.

    Returns
    -------
    variance : ndarray, shape (ny, nx)
    photon : float
        As given, or as estimated.
    """
    step = 1 if residual.size < _ENOUGH else 2
    square, filtered = residual[::step, ::step] ** 2, filtered[::step, ::step] ** 2
    light, good, variance = (np.ascontiguousarray(each[::step, ::step]) for each in (light, good, start))
    mesh, slope = mesh // step, photon or 0.0
    for _ in range(_ROUNDS):
        total = np.maximum(variance + slope * light, 0.25 * variance)
        dark = good & (filtered < _DARK**2 * noise * total) & (square < _CLIP**2 * total)
        if photon is None:
            slope = _photon_slope(square[dark], light[dark])
        means = _means_of_meshes(square / _REMAINS - slope * light, dark, mesh)
        if means is None:
            return start, slope
        before, variance = variance, np.maximum(_enlarge(means, (mesh, mesh), square.shape), np.float32(floor))
        if np.all(np.abs(variance - before)[::4, ::4] < _SETTLED * before[::4, ::4]):
            break
    return np.maximum(_enlarge(means, (mesh * step,) * 2, residual.shape), np.float32(floor)), slope


def _means_of_meshes(image, use, mesh):
    """Means over meshes, each the median of those around it; None if no mesh has enough pixels."""
    total, n = (
        np.add.reduceat(
            np.add.reduceat(values, np.arange(0, image.shape[1], mesh), axis=1),
            np.arange(0, image.shape[0], mesh),
            axis=0,
        )
        for values in (np.where(use, image, 0), use.astype(np.float32))
    )
    enough = n >= _FEWEST
    if not enough.any():
        return None
    mean = np.where(enough, total / np.maximum(n, 1), np.nan)
    smooth = _medians_around(mean)
    return np.where(np.isfinite(smooth), smooth, np.median(mean[enough]))


def _medians_around(mesh):
    """Median of every mesh and those around it, without NaN."""
    padded = np.pad(mesh, 1, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*mesh.shape, 9)
    around, n = np.sort(around, axis=-1), np.count_nonzero(~np.isnan(around), axis=-1)[..., None]  # NaN last
    low, high = (np.take_along_axis(around, middle, axis=-1) for middle in (np.maximum(n - 1, 0) // 2, n // 2))
    return ((low + high) / 2)[..., 0]  # NaN of a mesh with nothing around it


def _photon_slope(square, light):
    """Variance per unit of light, of pixels on which no star is seen: 0 where light does not differ by enough."""
    if len(light) < _STEPS * _FEWEST:
        return 0.0
    edges = np.quantile(light[:: max(1, len(light) // 100_000)], np.linspace(0, 1, _STEPS + 1)[1:-1])
    step = np.searchsorted(edges, light)
    n = np.maximum(np.bincount(step, minlength=_STEPS), 1)
    x, y = (np.bincount(step, weights=values, minlength=_STEPS) / n for values in (light, square))
    half = _STEPS // 2
    rise, run = y[half:] - y[:half].mean(), x[half:] - x[:half].mean()
    # the least of them: what is not noise, in cores that pass for light, only adds
    return max(float((rise / run).min()), 0.0) if (run > 0).all() else 0.0
