"""A mosaic block by block: the pieces of all exposures that meet a block, resampled and combined."""

from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np

from ..geometry.star_hull import supported
from ..runtime.scratch import Stored, forget, spill
from .background import Background
from .combination import PixelFlag, combine, margin
from .resampling.engines import Resampling, resample_exposure
from .resampling.pixel_maps import ExposureMap
from .weights import Weight

_SAMPLES = 1 << 23  # pixels of all exposures that are stacked at a time
_SIDES = 64, 320  # of blocks, px
_BITS = 32  # exposures in a plane of the context
_IN_MEMORY = 1 << 27  # bytes of planes up to which they need not go to the disk


@dataclass(frozen=True, eq=False, repr=False)
class Layer:
    """One exposure of the stack, ready to be resampled.

    Attributes
    ----------
    index : int
        Its place among all.
    stored : Stored
        Its planes: ``data``, with bad pixels filled; perhaps ``bad``, ``variance``.
    map : ExposureMap
    background : Background
    factor : float
        Flux scale.
    variance : float
        Of the background, at that scale, where there is no such plane.
    sky : float or None
        Background, at that scale, that is brought to the common level; None = left alone.
    weight : Weight
    fwhm : float or None
        Of its stars [px].
    gain : float or None
        See `legdistort.coaddition.resampling.engines.resample_exposure`.
    photons : float
        See `legdistort.coaddition.combination.combine`.
    support : ndarray or None
        Half-planes outside which the distortion is extrapolated; None = it does not matter.
    """

    index: int
    stored: Stored
    map: ExposureMap
    background: Background
    factor: float
    variance: float
    sky: float | None
    weight: Weight
    fwhm: float | None
    gain: float | None
    photons: float = 0.0
    support: np.ndarray | None = None


@dataclass(frozen=True)
class Recipe:
    """How exposures become a mosaic.

    Attributes
    ----------
    shape : tuple
        Of the mosaic.
    resampling : Resampling
    method, conserve : str
        See `legdistort.coadd`.
    level : float
        The common background level.
    mask : bool
        Whether extrapolated pixels are left out.
    widths : tuple or None
        The smallest and the largest FWHM of all exposures, if known.
    compiled : bool
        Whether there are so many pixels that compiled loops combine them.
    """

    shape: tuple
    resampling: Resampling
    method: str
    conserve: str
    level: float
    mask: bool
    widths: tuple | None
    compiled: bool


@dataclass(frozen=True, eq=False, repr=False)
class Block:
    """A piece of the output grid, ``window``, and the layers that may meet it."""

    window: tuple
    layers: list


def assemble(layers, recipe, folder, share):
    """The planes of a mosaic.

    Parameters
    ----------
    layers : list of Layer
    recipe : Recipe
    folder : path
        The planes are arrays on the disk of this folder, but for small ones.
    share : callable
        `legdistort.runtime.parallel.map_items`, which shares the work among threads or processes.

    Returns
    -------
    list of ndarray
        Data, variance, weight, count, flags, context and shares, as `stack` gives them for a block.
    """
    small, context = n_bytes(recipe.shape, len(layers)) <= _IN_MEMORY, (n_planes(len(layers)), *recipe.shape)
    empty = np.full if small else partial(spill, folder=folder)
    planes = [empty(recipe.shape, value, np.float32) for value in (np.nan, np.nan, 0)]
    planes += [empty(recipe.shape, 0, dtype) for dtype in (_count_type(len(layers)), np.uint8)]
    planes += [empty(context, 0, np.uint32), *(empty(recipe.shape, 0, np.uint8) for _ in range(2))]
    pieces = list(blocks(layers, recipe))
    work = partial(stack, recipe=recipe, n_exposures=len(layers))
    for block, values in zip(pieces, share(work, pieces, description="co-adding", unit="block"), strict=True):
        if values is None:  # the planes have what stands for nothing
            continue
        for plane, value in zip(planes, values, strict=True):
            plane[..., *block.window] = value
            forget(plane)
    return planes


def n_bytes(shape, n_exposures):
    """Of the planes of a mosaic."""
    return int(np.prod(shape)) * (3 * 4 + _count_type(n_exposures)().nbytes + 3 + 4 * n_planes(n_exposures))


def _count_type(n_exposures):
    """Integers that count so many exposures."""
    return np.int16 if n_exposures <= np.iinfo(np.int16).max else np.int32


def side(n_exposures):
    """Side of a block [px], so that so many exposures of it are held at once, however the work is shared."""
    low, high = _SIDES
    return int(np.clip(np.sqrt(_SAMPLES / n_exposures) // low * low, low, high))


def blocks(layers, recipe):
    """The blocks of the output grid that exposures may meet."""
    ny, nx = recipe.shape
    step, edge = side(len(layers)), margin(recipe.method, recipe.widths)
    for y in range(0, ny, step):
        for x in range(0, nx, step):
            window = slice(y, min(y + step, ny)), slice(x, min(x + step, nx))
            near = [layer for layer in layers if _meet(_widen(window, edge, recipe.shape), layer.map.window)]
            if near:
                yield Block(window, near)


def n_planes(n_exposures):
    """Number of planes that the context of so many exposures has."""
    return ceil(n_exposures / _BITS)


def _meet(a, b):
    return all(s.start < t.stop and t.start < s.stop for s, t in zip(a, b, strict=True))


def _widen(window, edge, shape):
    return tuple(slice(max(0, s.start - edge), min(n, s.stop + edge)) for s, n in zip(window, shape, strict=True))


def _inner(window, outer):
    """A window counted from the start of another one."""
    return tuple(slice(s.start - o.start, s.stop - o.start) for s, o in zip(window, outer, strict=True))


def stack(block, *, recipe, n_exposures):
    """Combine the exposures that meet a block.

    Parameters
    ----------
    block : Block
    recipe : Recipe
    n_exposures : int
        Of the whole mosaic.

    Returns
    -------
    data, variance, weight : ndarray of float32, shape (ny, nx)
    count : ndarray of int32, shape (ny, nx)
    flags : ndarray of uint8, shape (ny, nx)
        Bits of `legdistort.coaddition.combination.PixelFlag`.
    context : ndarray of uint32, shape (n_planes, ny, nx)
        Bit i % 32 of plane i // 32 is set where exposure i contributes.
    extrapolated, rejected : ndarray of uint8, shape (ny, nx)
        Per cent of the exposures that contribute, and of those that are there, rounded up.

    It is None where no exposure meets the block.
    """
    outer = _widen(block.window, margin(recipe.method, recipe.widths), recipe.shape)
    shape = tuple(s.stop - s.start for s in outer)
    data, variance = np.full((2, len(block.layers), *shape), np.nan, dtype=np.float32)
    weight = np.zeros(data.shape, dtype=np.float32)
    doubt = np.zeros(data.shape, dtype=np.uint8)
    met = []
    for layer in block.layers:
        if _resample(layer, outer, recipe, [plane[len(met)] for plane in (data, variance, weight, doubt)]):
            met.append(layer)
    if not met:
        return None
    inner = _inner(block.window, outer)
    n = len(met)
    photons = [layer.photons for layer in met]
    spare = doubt[:n] & PixelFlag.SATURATED > 0
    combined = combine(
        data[:n],
        variance[:n],
        weight[:n],
        method=recipe.method,
        level=recipe.level,
        photons=photons if any(photons) else None,
        spare=spare if spare.any() else None,
        fwhm=None if recipe.widths is None else [layer.fwhm for layer in met],
        widths=recipe.widths,
        compiled=recipe.compiled,
    )
    keep = combined.keep[:, *inner]
    doubt = doubt[:n] * combined.keep
    flags = np.bitwise_or.reduce(doubt, axis=0)
    rejected = np.zeros(shape, dtype=int)
    if recipe.method == "clipped":
        rejected = np.count_nonzero(np.isfinite(data[:n]) & ~spare & ~combined.keep, axis=0)
        flags |= (rejected > 0) * np.uint8(PixelFlag.REJECTED)
    extrapolated = np.count_nonzero(doubt & PixelFlag.EXTRAPOLATED, axis=0)
    shares = _per_cent(extrapolated, combined.count), _per_cent(rejected, combined.count + rejected)
    context = np.zeros((n_planes(n_exposures), *keep.shape[1:]), dtype=np.uint32)
    for layer, used in zip(met, keep, strict=True):
        plane, bit = divmod(layer.index, _BITS)
        context[plane] |= used.astype(np.uint32) << np.uint32(bit)
    planes = combined.data, combined.variance, combined.weight, combined.count, flags
    return *(p[inner] for p in planes), context, *(share[inner] for share in shares)


def _per_cent(part, whole):
    """Rounded up, so that none is none; 0 of nothing."""
    return np.ceil(100 * part / np.maximum(whole, 1)).astype(np.uint8)


def _resample(layer, window, recipe, planes):
    """Fill the place of one exposure in the stacks of a window; False if it does not meet it."""
    data, variance, weight, doubt = planes
    edge = recipe.resampling.margin * ceil(layer.map.scale)
    found = layer.map.piece(window, margin=edge, border=recipe.resampling.algorithm == "adaptive")
    if found is None:
        return False
    pixel_map, part = found
    image, spread = layer.stored.piece("data", part), layer.stored.piece("variance", part)
    by_pixel = layer.weight.by_pixel and spread is not None
    if spread is None:
        spread = layer.variance / layer.factor**2
    elif by_pixel:
        spread = np.stack([spread, layer.background.sky_variance(image, spread)])
    masks = {plane: layer.stored.piece(plane, part) for plane in ("bad", "full", "rough")}
    found = resample_exposure(image, masks, spread, pixel_map, recipe.resampling, gain=layer.gain)
    value, spread = found.data, found.variance
    place = _inner(pixel_map.window, window)
    xy = pixel_map.xy + np.array([part[1].start, part[0].start]).reshape(2, 1, 1)
    weight[place] = layer.weight.at(xy) * found.coverage
    if by_pixel:
        spread, sky = spread
        weight[place] *= np.nan_to_num(layer.background.noise**2 / sky)
    if layer.support is not None:
        outside = ~supported(layer.support, xy)
        if recipe.mask:
            value[outside] = np.nan
        doubt[place] = outside * np.uint8(PixelFlag.EXTRAPOLATED)
    if found.full is not None:
        doubt[place] |= found.full * np.uint8(PixelFlag.SATURATED)
    factor = layer.factor * (pixel_map.area if recipe.conserve == "flux" else 1.0)
    if layer.sky is not None:
        value -= layer.sky / layer.factor
    value *= factor
    if layer.sky is not None:
        value += recipe.level
    data[place], variance[place] = value, spread * factor**2
    return True
