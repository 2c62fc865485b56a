"""Pictures of the quality of stacks: the same stars as several corrections leave them (paper, Figure "stars2")."""

import numpy as np

from . import elements

_PANEL = 2.1  # inches
_PLAIN = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}


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
