"""Pieces of detector images -> pieces of the output grid, with reproject as the engine.

It is handed tiny WCS objects whose world *is* the output grid, and a pixel map
(`legdistort.coaddition.resampling.pixel_maps`), since coordinates through the sky would take most of its time. For many
pixels, compiled twins of its splines take over (`legdistort.coaddition.resampling.compiled_splines`).
"""

from dataclasses import dataclass, replace

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.wcs.wcsapi import BaseLowLevelWCS
from scipy.ndimage import map_coordinates

from .drizzling import drizzle
from .noise_gain import mean_spline_gain, spline_gain

_BAD_WEIGHT = 0.05  # an output pixel with a larger share of bad pixels is left empty
_FORGETS = 2, 2, 12, 16, 20, 24  # pixels by which a spline of that order has forgotten, to 1e-8
#: Pixels of all exposures from which compiled splines are used; below, loading numba takes longer than it saves.
COMPILED_FROM = 1 << 22


@dataclass(frozen=True)
class Resampling:
    """How exposures are resampled.

    Attributes
    ----------
    algorithm : {'interp', 'adaptive', 'exact', 'drizzle'}
        Which of reproject's, or that of STScI.
    order : int
        Of the spline, for 'interp'.
    kernel : {'square', 'turbo', 'point'}
        Of drizzle's drops: a square that turns and shears with the distortion, one along the axes of the output, or a
        point.
    pixfrac : float
        Side of a drop, as a fraction of the pixel's, above 0 up to 1.
    compiled : bool
        Splines by compiled loops, see `uses_compiled_splines`.
    """

    algorithm: str = "interp"
    order: int = 3
    kernel: str = "square"
    pixfrac: float = 1.0
    compiled: bool = False

    def __str__(self):
        kind = {"interp": f" {self.order}", "drizzle": f" {self.kernel} {self.pixfrac:g}"}
        return self.algorithm + kind.get(self.algorithm, "")

    @property
    def margin(self):
        """Pixels of an exposure, around those that are wanted, on which their values depend."""
        if self.algorithm == "drizzle":
            return 3  # drops reach no farther than their pixels
        return _FORGETS[self.order] if self.algorithm == "interp" else 10


def uses_compiled_splines(algorithm, order, n_pixels):
    """Whether the splines of `legdistort.coaddition.resampling.compiled_splines` serve so many pixels."""
    return algorithm == "interp" and order in (1, 3) and n_pixels >= COMPILED_FROM


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


def resample(planes, pixel_map, resampling):
    """Images of one detector on the output grid, surface brightness conserved.

    Parameters
    ----------
    planes : sequence of ndarray, shape (ny, nx)
        The images.
    pixel_map : `~legdistort.coaddition.resampling.pixel_maps.PixelMap`
        With what the algorithm asks for.
    resampling : Resampling
        By any algorithm but drizzle.

    Returns
    -------
    ndarray, shape (k, my, mx)
        NaN outside the detector.
    """
    if resampling.compiled:
        from . import compiled_splines

        out = np.empty((len(planes), *pixel_map.area.shape))
        for plane, values in zip(planes, out, strict=True):
            compiled_splines.interpolate(plane, pixel_map.xy, resampling.order, values)
    else:
        out = _reproject(planes, pixel_map, resampling)
    if not pixel_map.inside.all():
        out[:, ~pixel_map.inside] = np.nan
    return out


def _reproject(planes, pixel_map, resampling):
    import reproject  # brings dask along, which takes a third of a second

    planes = np.asarray(planes)
    options = {"shape_out": (len(planes), *pixel_map.area.shape), "return_footprint": False}
    if resampling.algorithm == "exact":
        scale = 1 / max(pixel_map.area.shape)
        wcs_in, wcs_out = _TableWCS(to_world=pixel_map.corners, scale=scale), _TableWCS(scale=scale)
        return reproject.reproject_exact((planes, wcs_in), wcs_out, **options)
    options["roundtrip_coords"] = False
    if resampling.algorithm == "interp":
        options["order"] = resampling.order
        return reproject.reproject_interp((planes, _TableWCS(pixel_map.xy)), _TableWCS(), **options)
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


def resample_exposure(data, masks, variance, pixel_map, resampling, *, gain=None):
    """A piece of an exposure on the output grid.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
        The image, bad pixels replaced, so that they do not ring through the spline.
    masks : dict of ndarray of bool, shape (ny, nx), or None
        ``bad``: output pixels where their share is above 5 % are NaN (of drizzle, they do not fall). ``full``:
        saturated ones. ``rough``: where a spline would ring (`legdistort.coaddition.preparation.rough_pixels`), which
        are interpolated linearly.
    variance : ndarray, shape (ny, nx) or (k, ny, nx), or float
        Of independent pixels.
    pixel_map : `~legdistort.coaddition.resampling.pixel_maps.PixelMap`
        Of its exposure.
    resampling : `~legdistort.coaddition.resampling.engines.Resampling`
    gain : float, optional
        What the algorithm leaves of the variance of white noise
        (`white_gain`); not for 'interp', where it is known.

    Returns
    -------
    Resampled
    """
    masks = {name: mask for name, mask in masks.items() if mask is not None and mask.any()}
    if resampling.algorithm == "drizzle":
        return _drizzle(data, masks, variance, pixel_map, resampling)
    spline = resampling.algorithm == "interp"
    spoilt = [name for name in ("bad", "full") if name in masks]
    extra = list(np.reshape(variance, (-1, *data.shape)) if np.ndim(variance) else [])
    if spline and resampling.order > 0:
        hits = [_hits(masks[name], pixel_map) for name in spoilt]
        value = resample(data[None], pixel_map, resampling)[0]
        out = resample(extra, pixel_map, replace(resampling, order=1)) if extra else []
    else:
        shares = [masks[name].astype(np.float32) for name in spoilt]
        value, *out = resample(np.array([data, *shares, *extra]), pixel_map, resampling)
        hits = [~(out.pop(0) <= _BAD_WEIGHT) for _ in spoilt]
    hits = dict(zip(spoilt, hits, strict=True))
    if spline:
        gain = spline_gain(resampling.order, pixel_map.xy, resampling.compiled)
    if "rough" in masks and spline and resampling.order > 1:
        place = [np.clip(np.rint(p), 0, n - 1) for p, n in zip(pixel_map.xy[::-1], data.shape, strict=True)]
        near = masks["rough"][tuple(np.array(place, dtype=np.intp))] & pixel_map.inside
        value[near] = map_coordinates(data, pixel_map.xy[::-1, near], order=1, mode="nearest")
        gain = np.where(near, spline_gain(1, pixel_map.xy, resampling.compiled), gain)
    if "bad" in masks:
        value[hits["bad"]] = np.nan
    spread = np.reshape(out, (*np.shape(variance)[:-2], *value.shape)) if extra else variance
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


def _drizzle(data, masks, variance, pixel_map, resampling):
    variances = np.broadcast_to(variance, (*np.shape(variance)[:-2], *data.shape))
    good = ~masks["bad"] if "bad" in masks else np.ones(data.shape, dtype=np.float32)
    value, spread, coverage = drizzle(data, good, variances.reshape(-1, *data.shape), pixel_map, resampling)
    has_full = "full" in masks
    full = drizzle(masks["full"], good, [], pixel_map, resampling)[0] > _BAD_WEIGHT if has_full else None
    return Resampled(value, np.reshape(spread, (*variances.shape[:-2], *value.shape)), full, coverage)


def white_gain(exposure_map, resampling):
    """What an algorithm leaves of the variance of white noise; found in the middle of an exposure, but for splines.

    The sum over many pixels keeps its variance: it is the inverse of this times the sum of the variances of single
    pixels, since neighbours are correlated.

    Parameters
    ----------
    exposure_map : `~legdistort.coaddition.resampling.pixel_maps.ExposureMap`
    resampling : `~legdistort.coaddition.resampling.engines.Resampling`

    Returns
    -------
    float
        The mean over 128 x 128 px of the output.
    """
    if resampling.algorithm == "interp":
        return mean_spline_gain(resampling.order)
    middle = tuple(
        slice(max(s.start, (s.start + s.stop) // 2 - 64), (s.start + s.stop) // 2 + 64) for s in exposure_map.window
    )
    for window in (middle, exposure_map.window):  # an exposure may meet the grid with a corner only
        found = exposure_map.piece(window, margin=24, border=resampling.algorithm == "adaptive")
        if found is not None:
            noise = np.random.default_rng(1).standard_normal([s.stop - s.start for s in found[1]])
            if resampling.algorithm == "drizzle":
                out = drizzle(noise, np.ones(noise.shape, dtype=bool), [], found[0], resampling)[0]
            else:
                out = resample(noise[None], found[0], resampling)
            return float(np.nanvar(out))
    return 1.0
