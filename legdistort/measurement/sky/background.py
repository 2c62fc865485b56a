"""The sky of a frame and its noise."""

import logging
import warnings

import numpy as np
from astropy.stats import SigmaClip
from photutils.background import Background2D
from scipy.interpolate import BSpline, make_interp_spline

log = logging.getLogger(__name__)

_DARK = 2.5  # filtered signal, in its noise, up to which a pixel determines the noise of the sky
_CLIP = 3.0  # standard deviations beyond which a pixel is left out of the noise
#: Variance of a unit normal clipped at `_CLIP` (0.973), then where the filtered image is within `_DARK` of its noise.
_REMAINS = 0.973 * 0.975
_SETTLED = 0.03
_ROUNDS = 5  # from a noise that is several times too high, in crowded fields
_ENOUGH = 1_000_000  # pixels: of more every fourth serves
_FEWEST = 50  # pixels of a mesh that determine its noise
_STEPS = 12  # of light, for the photon noise


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
