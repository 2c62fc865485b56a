"""One detector image -> the output grid by drizzle (Fruchter & Hook 2002), with the package of STScI as the engine."""

import numpy as np

_EMPTY = 1e-3  # share of a drop with which an output pixel counts as empty: its value would be noise


def drizzle(data, good, variances, pixel_map, resampling):
    """Drizzle an image, surface brightness conserved.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
    good : ndarray, shape (ny, nx)
        Pixels that are false, or 0, do not fall.
    variances : sequence of ndarray, shape (ny, nx)
        Of independent pixels.
    pixel_map : `~legdistort.coaddition.resampling.pixel_maps.PixelMap`
        With corners.
    resampling : `~legdistort.coaddition.resampling.engines.Resampling`
        Its ``kernel`` and ``pixfrac`` determine what a pixel becomes before it falls.

    Returns
    -------
    data : ndarray of float32, shape (my, mx)
        NaN where nothing falls.
    variances : list of ndarray
        Of each output pixel by itself: with squared weights.
    coverage : ndarray
        Weight of each output pixel, about 1 where the detector covers it.
    """
    from drizzle.resample import Drizzle

    c = pixel_map.corners
    # Room for all drops: the package leaves out those beyond a straight-edged outline of the output; pieces are bent.
    ny, nx = pixel_map.area.shape
    low = np.minimum(np.floor(np.fmin.reduce(c, axis=(1, 2))), 0).astype(int) - 2
    high = np.maximum(np.ceil(np.fmax.reduce(c, axis=(1, 2))), (nx, ny)).astype(int) + 2
    centres = np.empty((*data.shape, 2))
    for place, at, first in zip(np.moveaxis(centres, -1, 0), c, low, strict=True):
        rows = at[:-1] + at[1:]
        place[:] = (rows[:, :-1] + rows[:, 1:]) / 4 - first  # to 1e-5 px
    shape = tuple(int(n) for n in (high - low)[::-1])
    onto = Drizzle(kernel=resampling.kernel, out_shape=shape, fillval=np.nan, disable_ctx=True)
    onto.add_image(
        np.ascontiguousarray(data, dtype=np.float32),
        exptime=1.0,
        pixmap=centres,
        data2=[np.ascontiguousarray(v, dtype=np.float32) for v in variances] or None,
        weight_map=good.astype(np.float32, copy=False),
        pixfrac=resampling.pixfrac,
        in_units="cps",
    )
    within = slice(-low[1], ny - low[1]), slice(-low[0], nx - low[0])
    coverage = onto.out_wht[within]
    empty = ~(np.abs(coverage) > _EMPTY * resampling.pixfrac**2) | ~pixel_map.inside
    out = [plane[within] for plane in (onto.out_img, *(onto.out_img2 or ()))]
    for plane in out:
        plane[empty] = np.nan
    coverage[empty] = 0
    return out[0], out[1:], coverage
