"""Picture of a completeness: the part of artificial stars that was found."""

import numpy as np

from . import elements


def plot_completeness(completeness, *, ax=None):
    """The part of artificial stars that was found against flux, or magnitude with a zero point, with errors.

    The upper axis has the ratio of signal to noise.

    Parameters
    ----------
    completeness : `~legdistort.photometry.artificial_stars.Completeness`
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    """
    ax = elements.new_axes(ax, (6.4, 4.2))
    table = completeness.by_flux[completeness.by_flux["n"] > 0]
    low, high, snr, part, error = (
        np.asarray(table[name], dtype=float)
        for name in ("flux_low", "flux_high", "snr", "completeness", "completeness_err")
    )
    middle, magnitudes = np.sqrt(low * high), "mag_low" in table.colnames
    if magnitudes:
        middle = (np.asarray(table["mag_low"]) + np.asarray(table["mag_high"])) / 2
        ax.set(xlabel="magnitude")
        ax.invert_xaxis()
    else:
        ax.set(xscale="log", xlabel="flux [units of the data]")
    bars = np.clip([error, error], 0, [part, 1 - part])
    ax.errorbar(middle, 100 * part, 100 * bars, fmt="o-", color="#0072B2", markersize=4, linewidth=1.2, capsize=2)
    ax.axhline(50, color=elements.GREY, linewidth=0.8, linestyle=":")
    ax.set(ylabel="artificial stars found [%]", ylim=(-3, 103))
    top = ax.twiny()
    top.set(xscale=ax.get_xscale(), xlim=ax.get_xlim(), xlabel="signal-to-noise ratio")
    top.set_xticks(middle, [f"{value:.2g}" if value < 10 else f"{value:.0f}" for value in snr])
    top.minorticks_off()
    return ax
