"""Pieces of exposures on the output grid: values, variances and what masks hold, by whichever engine."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import map_coordinates

from .drizzling import drizzle
from .engines import resample
from .noise_gain import spline_gain

_BAD_WEIGHT = 0.05  # an output pixel with a larger share of bad pixels is left empty


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
        (`legdistort.coaddition.resampling.noise_gain.white_gain`); not for 'interp', where it is known.

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
    good = ~masks.get("bad", np.zeros(data.shape, dtype=bool))
    value, spread, coverage = drizzle(data, good, variances.reshape(-1, *data.shape), pixel_map, resampling)
    full = None
    if "full" in masks:
        full = drizzle(masks["full"], good, [], pixel_map, resampling)[0] > _BAD_WEIGHT
    return Resampled(value, np.reshape(spread, (*variances.shape[:-2], *value.shape)), full, coverage)
