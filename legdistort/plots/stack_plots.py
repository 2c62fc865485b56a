"""Pictures of stacks: the mosaic, and the same stars as several corrections leave them (paper, Figure "stars2")."""

import numpy as np

from ..exceptions import InputError
from . import elements

_PANEL = 2.1  # inches
_PLAIN = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}


def plot_mosaic(mosaic, *, stars=None, max_size=900, ax=None):
    """Co-added image, asinh stretch, dark stars on light sky; pixels without data are pale blue.

    Parameters
    ----------
    mosaic : `~legdistort.coaddition.mosaic.Mosaic`
        Only its ``data``, shape (ny, nx), are looked at.
    stars : array_like, shape (n, 2), optional
        Positions to be circled, mosaic pixels.
    max_size : int
        Larger images are averaged in blocks for display; the axes stay in mosaic pixels.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    """
    ax = elements.new_axes(ax, (7.0, 7.0))
    data = np.asarray(mosaic.data, dtype=float)
    image = elements.block_mean(data, block := max(1, -(-max(data.shape) // max_size)))
    good = image[np.isfinite(image)]
    if not good.size:
        raise InputError(f"the mosaic of shape {data.shape} has no finite pixel to show")
    sky, high = np.percentile(good, [50, 99.9])
    soft = 2 * (sky - np.percentile(good, 16)) or 1.0  # twice the noise of the sky
    low, high = np.arcsinh(-1.2), max(np.arcsinh((high - sky) / soft), 4.0)
    height, width = (block * n for n in image.shape)
    extent = (-0.5, width - 0.5, -0.5, height - 0.5)
    elements.draw_image(ax, image, sky=sky, soft=soft, low=low, high=high, extent=extent)
    if stars is not None:
        ax.plot(*np.asarray(stars, dtype=float).T, "o", mfc="none", color=elements.RED, markersize=9, mew=0.9)
    ny, nx = data.shape
    ax.set(xlim=(-0.5, nx - 0.5), ylim=(-0.5, ny - 0.5), xlabel="x [px]", ylabel="y [px]")
    elements.set_title(ax, "Mosaic (asinh stretch)")
    return ax


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
    images = [image for image, _ in zoom.cuts.values()]
    best = images[-1]
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
        ax.tick_params(labelsize="x-small")
    x, y = zoom.place
    axes[0].set_ylabel(f"star at {x:.0f}, {y:.0f}\ny from it [px]", fontsize="small")


def _middle(image):
    """The pixels around the star, where its peak is."""
    ny, nx = image.shape
    return image[3 * ny // 8 : ny - 3 * ny // 8, 3 * nx // 8 : nx - 3 * nx // 8]
