"""Pictures of stacks: the mosaic, and the same stars as several corrections leave them (paper, Figure "stars2")."""

from functools import partial

import numpy as np

from ..exceptions import InputError
from . import elements

_PANEL = 2.1  # inches
_PLAIN = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}


def plot_mosaic(mosaic, *, stars=None, max_size=900, ax=None):
    """Co-added image less its smooth sky, asinh stretch, dark stars on light sky; pixels without data are pale blue.

    Rows and columns without any data are cut off.

    Parameters
    ----------
    mosaic : `~legdistort.coaddition.mosaic.Mosaic`
        Only its ``data``, shape (ny, nx), are looked at.
    stars : array_like, shape (n, 2), optional
        Positions to be circled, mosaic pixels.
    max_size : int
        Larger images are averaged in blocks for display; the axes stay in mosaic pixels.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; WCSAxes too, of the mosaic or of another image of that sky.

    Raises
    ------
    InputError
        If no pixel has data, or WCSAxes and mosaic have no sky in common.
    """
    ax = elements.new_axes(ax, (7.0, 7.0))
    data = np.asarray(mosaic.data)
    image = elements.block_mean(data, block := max(1, -(-max(data.shape) // max_size)))
    if not np.isfinite(image).any():
        raise InputError(f"the mosaic of shape {data.shape} has no finite pixel to show")
    image = image - smooth_sky(image)
    good = image[np.isfinite(image)]
    sky, high = np.percentile(good, [50, 99.9])
    soft = 2 * (sky - np.percentile(good, 16)) or 1.0  # twice the noise of the sky
    low, high = np.arcsinh(-1.2), max(np.arcsinh((high - sky) / soft), 4.0)
    height, width = (block * n for n in image.shape)
    extent = (-0.5, width - 0.5, -0.5, height - 0.5)
    wcs = partial(getattr, mosaic, "wcs")
    elements.draw_image(ax, image, sky=sky, soft=soft, low=low, high=high, extent=extent, wcs=wcs)
    limits = np.array([_covered(image, axis, block) for axis in (0, 1)])
    if stars is not None:
        stars = np.asarray(stars, dtype=float)
        seen = np.flatnonzero(((stars > limits[:, 0]) & (stars < limits[:, 1])).all(axis=1))
        dots = ax.scatter(
            *elements.to_axes(ax, stars[seen], wcs).T, s=81, facecolors="none", edgecolors=elements.RED, linewidths=0.9
        )
        elements.mark(dots, stars=seen)
    elements.frame(ax, *limits.T, wcs)
    elements.set_title(ax, "Mosaic less its smooth sky (asinh stretch)")
    return ax


def smooth_sky(image, cells=8):
    """Smooth level of an image: medians of cells, those of cells that bright objects fill replaced, interpolated.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        NaN where there are no data.
    cells : int
        Along the longer side.

    Returns
    -------
    ndarray, shape (ny, nx)
    """
    from scipy import ndimage

    plane = _plane(image)
    side = max(1, -(-max(image.shape) // cells))
    padded = np.pad(image - plane, [(0, -n % side) for n in image.shape], constant_values=np.nan)
    blocks = padded.reshape(padded.shape[0] // side, side, -1, side).transpose(0, 2, 1, 3)
    blocks = blocks.reshape(*blocks.shape[:2], -1)
    enough = np.isfinite(blocks).sum(axis=2) > side**2 / 20
    if not enough.any():
        return plane
    level = np.full(enough.shape, np.nan)
    level[enough] = np.nanmedian(blocks[enough], axis=1)
    nearest = ndimage.distance_transform_edt(np.isnan(level), return_distances=False, return_indices=True)
    level = ndimage.median_filter(level[tuple(nearest)], 3, mode="nearest")
    at = np.meshgrid(*((np.arange(n) + 0.5) / side - 0.5 for n in image.shape), indexing="ij")
    return plane + ndimage.map_coordinates(level, at, order=1, mode="nearest")


def _plane(image, most=20_000):
    """The plane through the finite pixels of an image, bright ones left out, fitted to so many of them."""
    rows = np.flatnonzero(np.isfinite(image))
    y, x = np.unravel_index(rows[:: max(1, len(rows) // most)], image.shape)
    columns, values, kept = np.stack([np.ones(len(x)), y, x], axis=1), image[y, x], np.ones(len(x), dtype=bool)
    for _ in range(4):
        slope = np.linalg.lstsq(columns[kept], values[kept], rcond=None)[0]
        off = values - columns @ slope
        kept = np.abs(off - np.median(off)) <= 4.5 * np.median(np.abs(off - np.median(off)))  # 3 sigma
    v, u = np.ogrid[: image.shape[0], : image.shape[1]]
    return slope[0] + slope[1] * v + slope[2] * u


def _covered(image, axis, block):
    """Limits along x (axis 0) or y between which there are data, in pixels of the mosaic."""
    there = np.flatnonzero(np.isfinite(image).any(axis=axis))
    return block * there[0] - 0.5, block * (there[-1] + 1) - 0.5


def plot_zooms(zooms, *, fig=None):
    """Neighbourhoods of stars, one row a star, one column a correction, a row in one stretch.

    The line is where the image has half the height of the star.

    Parameters
    ----------
    zooms : sequence of Zoom
        From `legdistort.assessment.stack_quality.compare_stacks`.
    fig : `~matplotlib.figure.Figure`, optional
        Where to draw; its size is set.

    Returns
    -------
    ndarray of `~matplotlib.axes.Axes`, shape (n_zooms, n_stacks)
    """
    names = list(zooms[0].cuts)
    fig = elements.new_figure(fig, (_PANEL * len(names) + 0.4, _PANEL * len(zooms) + 0.7))
    axes = fig.subplots(len(zooms), len(names), squeeze=False, sharex="row", sharey="row")
    for row, zoom in zip(axes, zooms, strict=True):
        _draw_row(row, zoom)
    for ax, name in zip(axes[0], names, strict=True):
        elements.set_title(ax, name, size="small")
    for ax in axes[-1]:
        ax.set_xlabel("x from the star [px]", fontsize="small")
    return axes


def _draw_row(axes, zoom):
    *_, (best, _) = zoom.cuts.values()
    sky, low = np.nanpercentile(best, [50, 16])
    soft = 3 * (sky - low) or 1.0
    # the core is saturated to show the wings and faint stars
    low, high = np.arcsinh([-1.0, 0.3 * (np.nanmax(_middle(best)) - sky) / soft])
    for ax, (name, (image, extent)) in zip(axes, zoom.cuts.items(), strict=True):
        elements.draw_image(ax, image, sky=sky, soft=soft, low=low, high=high, extent=extent)
        own = np.nanmax(_middle(image)) - sky
        if own > 0:
            x, y = (a + 0.5 + np.arange(n) for a, n in zip(extent[::2], image.shape[::-1], strict=True))
            ax.contour(x, y, np.nan_to_num(image - sky), levels=[own / 2], colors=elements.ORANGE, linewidths=1.3)
        label = f"FWHM {zoom.fwhm[name]:.2f} px" if np.isfinite(zoom.fwhm[name]) else "no fit"
        ax.annotate(label, (0.04, 0.04), xycoords="axes fraction", fontsize="small", color=elements.BLUE, bbox=_PLAIN)
        ax.tick_params(labelsize="small")
    x, y = zoom.place
    axes[0].set_ylabel(f"star at {x:.0f}, {y:.0f}\ny from it [px]", fontsize="small")


def _middle(image):
    """The pixels around the star, where its peak is."""
    ny, nx = image.shape
    return image[3 * ny // 8 : ny - 3 * ny // 8, 3 * nx // 8 : nx - 3 * nx // 8]
