"""Pieces of detector images -> pieces of the output grid, with reproject as the engine.

It is handed tiny WCS objects whose world *is* the output grid, and a pixel map
(`legdistort.coaddition.resampling.pixel_maps`). For many pixels, compiled twins of its splines take over
(`legdistort.coaddition.resampling.compiled_splines`).
"""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.wcs.wcsapi import BaseLowLevelWCS
from numpy.polynomial.polynomial import polyfit, polyval
from scipy.ndimage import binary_dilation, map_coordinates

from ...runtime.optional import has_fast
from .drizzling import drizzle

_BAD_WEIGHT = 0.05  # an output pixel with a larger share of bad pixels is left empty
#: Pixels of all exposures from which compiled splines are used, if numba is installed.
COMPILED_FROM = 1 << 22


def is_compiled(algorithm, order, n_pixels):
    """Whether the compiled splines of `legdistort.coaddition.resampling.compiled_splines` serve so many pixels."""
    return algorithm == "interp" and order in (1, 3) and n_pixels >= COMPILED_FROM and has_fast()


class _TableWCS(BaseLowLevelWCS):
    """A WCS whose world is the output grid; a table of coordinates stands for the transformation.

    reproject asks at whole pixels of the grid (and at pixel corners, half a pixel off, for the exact
    algorithm), so that a look-up is exact, in whatever order or thread it asks.

    Parameters
    ----------
    to_pixel, to_world : ndarray, shape (2, ny, nx), optional
        Tables of the two directions; None = identity.
    margin : int, optional
        Pixels by which `to_pixel` extends beyond the grid on every side.
    scale : float, optional
        The world is ``scale`` times the grid, as degrees on the sky: the exact algorithm wants a sphere, of
        which so small a piece at the equator is flat. None = plain pixels.
    """

    def __init__(self, to_pixel=None, to_world=None, *, margin=0, scale=None):
        self._to_pixel, self._to_world, self._margin, self._scale = to_pixel, to_world, margin, scale

    pixel_n_dim = world_n_dim = 2
    world_axis_physical_types = (None, None)

    @property
    def world_axis_units(self):
        return ("deg", "deg") if self._scale else ("pix", "pix")

    @property
    def world_axis_object_classes(self):
        if self._scale:
            return {"sky": (SkyCoord, (), {"frame": "icrs", "unit": "deg"})}
        return {axis: (u.Quantity, (), {"unit": "pix", "copy": False}) for axis in "xy"}

    @property
    def world_axis_object_components(self):
        if self._scale:
            return [("sky", 0, "spherical.lon.degree"), ("sky", 1, "spherical.lat.degree")]
        return [("x", 0, "value"), ("y", 0, "value")]

    def pixel_to_world_values(self, x, y):
        if self._to_world is not None:
            x, y = _look_up(self._to_world, np.add(x, 0.5), np.add(y, 0.5))
        return (np.multiply(x, self._scale), np.multiply(y, self._scale)) if self._scale else (x, y)

    def world_to_pixel_values(self, x, y):
        if self._scale:
            x = (np.asarray(x) + 180) % 360 - 180
            return x / self._scale, np.divide(y, self._scale)
        return (x, y) if self._to_pixel is None else _look_up(self._to_pixel, x, y, self._margin)


def _look_up(table, x, y, margin=0):
    """Rows of a table (2, ny, nx) at whole pixels (x, y)."""
    planes = table.reshape(2, -1)
    x, y, nx = np.asarray(x), np.asarray(y), table.shape[2]
    some = np.arange(0, planes.shape[1], 997)
    if x.shape == planes[0].shape and np.array_equal(y[some] * nx + x[some], some):
        return tuple(planes)  # the whole grid in its order, as reproject_interp asks
    index = ((y + margin) * nx + (x + margin)).astype(np.intp)
    return tuple(plane[index] for plane in planes)


def resample(planes, pixel_map, *, algorithm="interp", order=1, compiled=False):
    """Images of one detector on the output grid, surface brightness conserved.

    Parameters
    ----------
    planes : sequence of ndarray, shape (ny, nx)
        The images.
    pixel_map : `~legdistort.coaddition.resampling.pixel_maps.PixelMap`
        With what the algorithm asks for.
    algorithm : {'interp', 'adaptive', 'exact'}
        One of reproject's.
    order : int
        Of the spline, for 'interp'.
    compiled : bool
        By compiled loops, see `is_compiled`.

    Returns
    -------
    ndarray, shape (k, my, mx)
        NaN outside the detector.
    """
    if compiled:
        from . import compiled_splines

        out = np.empty((len(planes), *pixel_map.area.shape))
        for plane, values in zip(planes, out, strict=True):
            compiled_splines.interpolate(plane, pixel_map.xy, order, values)
    else:
        out = _reproject(planes, pixel_map, algorithm, order)
    if not pixel_map.inside.all():
        out[:, ~pixel_map.inside] = np.nan
    return out


def _reproject(planes, pixel_map, algorithm, order):
    import reproject  # brings dask along, which takes a third of a second

    planes = np.asarray(planes)
    options = {"shape_out": (len(planes), *pixel_map.area.shape), "return_footprint": False}
    if algorithm == "exact":
        scale = 1 / max(pixel_map.area.shape)
        wcs_in, wcs_out = _TableWCS(to_world=pixel_map.corners, scale=scale), _TableWCS(scale=scale)
        return reproject.reproject_exact((planes, wcs_in), wcs_out, **options)
    options["roundtrip_coords"] = False
    if algorithm == "interp":
        return reproject.reproject_interp((planes, _TableWCS(pixel_map.xy)), _TableWCS(), order=order, **options)
    # asks one pixel beyond the grid
    return reproject.reproject_adaptive((planes, _TableWCS(pixel_map.wider, margin=1)), _TableWCS(), **options)


@dataclass(frozen=True, eq=False, repr=False)
class Resampled:
    """A piece of an exposure on the output grid, surface brightness conserved.

    Attributes
    ----------
    data : ndarray, shape (my, mx)
        NaN where there is nothing.
    variance : ndarray, shape (my, mx) or (k, my, mx)
        Of each output pixel by itself; interpolation lowers it and correlates neighbours.
    full : ndarray of bool or None
        Where saturated pixels have a share.
    coverage : ndarray or float
        Share of the pixel on which something fell, for drizzle.
    """

    data: np.ndarray
    variance: np.ndarray
    full: np.ndarray | None = None
    coverage: object = 1.0


def resample_exposure(
    data, masks, variance, pixel_map, *, algorithm="interp", order=3, compiled=False, gain=None, drop=None
):
    """A piece of an exposure on the output grid.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
        The image, bad pixels replaced (`fill_bad`), so that they do not ring through the spline.
    masks : dict of ndarray of bool, shape (ny, nx), or None
        ``bad``: output pixels where their share is above 5 % are NaN (of drizzle, they do not fall). ``full``:
        saturated ones. ``rough``: where a spline would ring (`rough_pixels`), which are interpolated linearly.
    variance : ndarray, shape (ny, nx) or (k, ny, nx), or float
        Of independent pixels.
    pixel_map : `~legdistort.coaddition.resampling.pixel_maps.PixelMap`
        Of its exposure.
    algorithm, order, compiled
        See `resample`; or 'drizzle'.
    gain : float, optional
        What the algorithm leaves of the variance of white noise (`white_gain`); not for 'interp', where it is known.
    drop : `~legdistort.coaddition.resampling.drizzling.Drop`, optional
        For drizzle.

    Returns
    -------
    Resampled
    """
    masks = {name: mask for name, mask in masks.items() if mask is not None and mask.any()}
    if algorithm == "drizzle":
        return _drizzle(data, masks, variance, pixel_map, drop)
    spoilt = [name for name in ("bad", "full") if name in masks]
    extra = list(np.reshape(variance, (-1, *data.shape)) if np.ndim(variance) else [])
    if algorithm == "interp" and order > 0:
        hits = [_hits(masks[name], pixel_map) for name in spoilt]
        out = [*resample(data[None], pixel_map, order=order, compiled=compiled)]
        out += [*resample(extra, pixel_map, order=1, compiled=compiled)] if extra else []
        value = out.pop(0)
    else:
        shares = [masks[name].astype(np.float32) for name in spoilt]
        value, *out = resample(np.array([data, *shares, *extra]), pixel_map, algorithm=algorithm, order=order)
        hits = [~(out.pop(0) <= _BAD_WEIGHT) for _ in spoilt]
    hits = dict(zip(spoilt, hits, strict=True))
    if algorithm == "interp":
        gain = _spline_gain(order, pixel_map.xy, compiled)
    if "rough" in masks and algorithm == "interp" and order > 1:
        place = [np.clip(np.rint(p), 0, n - 1) for p, n in zip(pixel_map.xy[::-1], data.shape, strict=True)]
        near = masks["rough"][tuple(np.array(place, dtype=np.intp))] & pixel_map.inside
        value[near] = map_coordinates(data, pixel_map.xy[::-1, near], order=1, mode="nearest")
        gain = np.where(near, _spline_gain(1, pixel_map.xy, compiled), gain)
    if "bad" in masks:
        value[hits["bad"]] = np.nan
    spread = np.reshape(out, (*np.shape(variance)[:-2], *value.shape)) if out else variance
    return Resampled(value, gain * spread, hits.get("full"))


def _hits(mask, pixel_map):
    """Where more than 5 % of a linear interpolation come from a mask; evaluated only where it can be."""
    some = mask.copy()  # whether a pixel, the next, those above: what lies between them is interpolated from these four
    some[:-1] |= mask[1:]
    some[:, :-1] |= some[:, 1:].copy()
    y, x = (np.clip(p, 0, n - 1).astype(np.intp) for p, n in zip(pixel_map.xy[::-1], mask.shape, strict=True))
    near = some.ravel()[y * mask.shape[1] + x]
    hits = np.zeros(near.shape, dtype=bool)
    place = pixel_map.xy[::-1, near]
    hits[near] = map_coordinates(mask.astype(np.float32), place, order=1, mode="nearest") > _BAD_WEIGHT
    return hits


def _drizzle(data, masks, variance, pixel_map, drop):
    variances = np.broadcast_to(variance, (*np.shape(variance)[:-2], *data.shape))
    good = ~masks.get("bad", np.zeros(data.shape, dtype=bool))
    value, spread, coverage = drizzle(data, good, variances.reshape(-1, *data.shape), pixel_map, drop)
    full = None
    if "full" in masks:
        full = drizzle(masks["full"], good, [], pixel_map, drop)[0] > _BAD_WEIGHT
    return Resampled(value, np.reshape(spread, (*variances.shape[:-2], *value.shape)), full, coverage)


def white_gain(exposure_map, *, algorithm, order=None, drop=None):
    """What an algorithm leaves of the variance of white noise; found in the middle of an exposure, but for splines.

    The sum over many pixels keeps its variance: it is the inverse of this times the sum of the variances of single
    pixels, since neighbours are correlated.

    Parameters
    ----------
    exposure_map : `~legdistort.coaddition.resampling.pixel_maps.ExposureMap`
    algorithm, order, drop
        As for `resample_exposure`.

    Returns
    -------
    float
        The mean over 128 x 128 px of the output.
    """
    if algorithm == "interp":
        fraction = (np.arange(100) + 0.5) / 100
        return float(polyval(fraction * (1 - fraction), _gain_series(order)).mean() ** 2)
    middle = tuple(
        slice(max(s.start, (s.start + s.stop) // 2 - 64), (s.start + s.stop) // 2 + 64) for s in exposure_map.window
    )
    for window in (middle, exposure_map.window):  # an exposure may meet the grid with a corner only
        found = exposure_map.piece(window, margin=24, border=algorithm == "adaptive")
        if found is not None:
            noise = np.random.default_rng(1).standard_normal([s.stop - s.start for s in found[1]])
            if algorithm == "drizzle":
                return float(np.nanvar(drizzle(noise, np.ones(noise.shape, dtype=bool), [], found[0], drop)[0]))
            return float(np.nanvar(resample(noise[None], found[0], algorithm=algorithm)))
    return 1.0


def noise_correlation(exposure_map, gain, *, algorithm, order=None):
    """Noise of the sum of many pixels over that by the sum of their variances, in the middle of an exposure.

    Parameters
    ----------
    exposure_map : `~legdistort.coaddition.resampling.pixel_maps.ExposureMap`
    gain : float
        From `white_gain`.
    algorithm, order
        As for `resample_exposure`.

    Returns
    -------
    float
    """
    x, y, _, _, area = exposure_map.middle()
    if algorithm != "interp":  # these lose no light: the sum has the noise of the pixels of the detector
        return float((gain * area.mean()) ** -0.5)
    along_x, along_y = (np.array([np.diff(p, axis=axis).mean() for p in (x, y)]) for axis in (1, 0))
    reach = min(200, ceil(20 / min(np.hypot(*along_x), np.hypot(*along_y))))
    i, k = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    step, correlation = _spline_correlation(order)
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


def fill_bad(data, bad, radius=2):
    """Replace bad pixels by a weighted mean of the good ones near by, or the median of all good ones."""
    if not bad.any():
        return data
    (y, x), (ny, nx) = np.nonzero(bad), bad.shape
    total, norm = np.zeros(len(x)), np.zeros(len(x))
    for dy, dx in np.ndindex(2 * radius + 1, 2 * radius + 1):
        near = np.clip(y + dy - radius, 0, ny - 1), np.clip(x + dx - radius, 0, nx - 1)
        weight = np.exp(-((dy - radius) ** 2 + (dx - radius) ** 2) / 2) * ~bad[near]
        total += weight * np.where(weight > 0, data[near], 0)
        norm += weight
    lonely = norm == 0
    out = data.copy()
    out[y, x] = total / np.where(lonely, 1, norm)
    if lonely.any():
        out[y[lonely], x[lonely]] = np.median(data[~bad])
    return out


def _spline_gain(order, xy, compiled):
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
