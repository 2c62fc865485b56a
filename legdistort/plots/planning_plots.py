"""Picture of a plan: error of a position against magnitude, in one exposure and of all together."""

import numpy as np

from . import elements

_MOST = 3000


def plot_errors(stars, medians, *, limits=None, title="", ax=None):
    """Errors of single positions and of stars in the solution, against their magnitudes.

    Of more than 3000 stars a random sample is drawn; lines are medians of all.

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        Columns ``mag``, ``error``, ``joint_error``.
    medians : `~astropy.table.QTable`
        The same in bins.
    limits : (float, float), optional
        Magnitudes between which stars are measured; infinite for none.
    title : str
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    """
    ax = elements.new_axes(ax, (6.4, 4.6))
    shown = np.arange(len(stars))
    if len(stars) > _MOST:
        shown = np.random.default_rng(0).choice(len(stars), _MOST, replace=False)
    unit = str(stars["error"].unit)
    for name, colour, label in (("error", elements.ORANGE, "one exposure"), ("joint_error", elements.BLUE, "joint")):
        ax.plot(stars["mag"][shown], stars[name].value[shown], ".", color=colour, markersize=3.5, alpha=0.4, mew=0)
        ax.plot(medians["mag"], medians[name].value, "-", color=colour, linewidth=1.6, label=label)
    ax.set(yscale="log", xlabel="magnitude", ylabel=f"error of a position, per axis [{unit}]")
    for limit, what in zip(limits or (), ("full well", "signal to noise"), strict=False):
        if np.isfinite(limit):
            ax.axvline(limit, color=elements.GREY, linestyle="--", linewidth=1)
            ax.annotate(f" {what}", (limit, 0.02), xycoords=("data", "axes fraction"), rotation=90, fontsize="small",
                        color="#555555", ha="right", va="bottom")  # fmt: skip
    ax.grid(linewidth=0.3)
    ax.legend(fontsize="small", frameon=False)
    elements.set_title(ax, title)
    return ax
