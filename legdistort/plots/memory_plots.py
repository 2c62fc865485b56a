"""Coefficients of a camera against time."""

import numpy as np

from ..geometry import basis
from . import elements

_FINE = 100  # dates of a curve
_SHOWN = 0.3  # error of a coefficient [pix] up to which a night is drawn


def plot_memory(combined, *, fig=None):
    """Every coefficient of the static distortion against time: of single nights, and of all with its error.

    Of degree 1 the shears; errors of nights hold what nights scatter by, and those are left out that hardly tell.
    Nights of which one has no date stand side by side.

    Parameters
    ----------
    combined : `legdistort.assessment.nights.camera_memory.CombinedNights`
    fig : `~matplotlib.figure.Figure`, optional
        Where to draw.
    """
    i, j = (np.asarray(each)[1:] for each in basis.orders(combined.degree))
    fig = elements.new_figure(fig, (8.5, 0.6 + 1.15 * len(i)))
    panels = fig.subplots(len(i), 2, sharex=True, squeeze=False)
    seen = [combined.seen_by(n) for n in range(len(combined.nights))]
    dates, bad, dated = combined.dates, set(combined.odd), combined.dates.any()
    dates = dates if dated else np.arange(1, len(seen) + 1)
    colours = [elements.RED if each.name in bad else elements.BLUE for each in combined.nights]
    margin = 0.05 * np.ptp(dates) or 0.5
    fine = np.linspace(dates.min() - margin, dates.max() + margin, _FINE if combined.drifts else 2)
    curve = [combined.static(each if dated else None) for each in fine]
    for axis, column in enumerate(panels.T):
        for m, ax in enumerate(column, 1):
            mean = np.array([each[axis, m] for each, _ in curve])
            k = axis * (len(i) + 1) + m
            error = np.sqrt([covariance[k, k] for _, covariance in curve])
            ax.fill_between(fine, mean - error, mean + error, color=elements.BLUE, alpha=0.2, linewidth=0)
            ax.plot(fine, mean, color=elements.BLUE, linewidth=1)
            for date, (value, width), colour in zip(dates, seen, colours, strict=True):
                if width[axis, m] < _SHOWN:
                    ax.errorbar(date, value[axis, m], width[axis, m], fmt="o", markersize=3, color=colour, linewidth=1)
            ax.set_ylabel(f"L{i[m - 1]} L{j[m - 1]}", fontsize="small")
            ax.tick_params(labelsize="small")
        elements.set_title(column[0], f"along {'xy'[axis]} [pix]")
        column[-1].set_xlabel("year" if dated else "night")
        column[-1].ticklabel_format(axis="x", useOffset=False)
    fig.align_ylabels()
    return fig
