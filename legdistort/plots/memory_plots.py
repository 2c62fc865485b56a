"""Coefficients of a camera against time."""

import numpy as np

from ..geometry import basis
from . import elements

_FINE = 100  # dates of a curve
_SHOWN = 0.3  # error of a coefficient [pix] up to which a night is drawn
_MOST = 12  # detectors that a picture shows


def plot_memory(combined, *, fig=None):
    """Every coefficient of the static distortion against time: of single nights, and of all with its error.

    Of degree 1 the shears; errors of nights hold what nights scatter by, and those are left out that hardly tell.
    Nights of which one has no date stand side by side. Of several detectors changes from the camera of the first night,
    two rows a detector, those of order 0 and 1 of its layout; of more than twelve detectors those that change most.

    Parameters
    ----------
    combined : `legdistort.assessment.nights.camera_memory.CombinedNights`
    fig : `~matplotlib.figure.Figure`, optional
        Where to draw.
    """
    seen = [combined.seen_by(n) for n in range(len(combined.nights))]
    dates, bad, dated = combined.dates, set(combined.odd), combined.dates.any()
    dates = dates if dated else np.arange(1, len(seen) + 1)
    colours = [elements.RED if each.name in bad else elements.BLUE for each in combined.nights]
    margin = 0.05 * np.ptp(dates) or 0.5
    fine = np.linspace(dates.min() - margin, dates.max() + margin, _FINE if combined.drifts else 2)
    curve = [combined.static(each if dated else None) for each in fine]
    means, errors = (np.array(each) for each in zip(*((m.ravel(), np.sqrt(np.diag(c))) for m, c in curve), strict=True))
    values, widths = (np.array([each.ravel() for each in part]) for part in zip(*seen, strict=True))
    made = _of_detectors if combined.has_focal_plane else _of_one
    fig, panels, lowest = made(combined, fig, values, widths)
    for k, ax in panels.items():
        mean, error = means[:, k], errors[:, k]
        ax.fill_between(fine, mean - error, mean + error, color=elements.BLUE, alpha=0.2, linewidth=0)
        ax.plot(fine, mean, color=elements.BLUE, linewidth=1)
        for date, value, width, colour in zip(dates, values[:, k], widths[:, k], colours, strict=True):
            if width < _SHOWN:
                ax.errorbar(date, value, width, fmt="o", markersize=3, color=colour, linewidth=1)
        ax.tick_params(labelsize="small")
    for ax in lowest:
        ax.set_xlabel("year" if dated else "night")
        ax.ticklabel_format(axis="x", useOffset=False)
    fig.align_ylabels()
    return fig


def _of_one(combined, fig, *_):
    """The figure, its panels ``{number of the coefficient: axes}``, and the lowest of these, of a single detector."""
    i, j = (np.asarray(each) for each in basis.orders(combined.degree))
    n = len(i) - 1
    fig = elements.new_figure(fig, (8.5, 0.6 + 1.15 * n))
    axes, panels = fig.subplots(n, 2, sharex=True, squeeze=False), {}
    for axis, column in enumerate(axes.T):
        for m, ax in enumerate(column, 1):
            ax.set_ylabel(f"L{i[m]} L{j[m]}", fontsize="small")
            panels[axis * (n + 1) + m] = ax
        elements.set_title(column[0], f"along {'xy'[axis]} [pix]")
    return fig, panels, axes[-1]


def _of_detectors(combined, fig, values, widths):
    """The same of several detectors, a row an axis."""
    i, j = (np.asarray(each) for each in basis.orders(combined.degree))
    keys, n = list(combined.nights[0].camera.detectors), len(i)
    told = np.where(widths < _SHOWN, values / np.maximum(widths, np.finfo(float).tiny), 0.0)
    most = np.sum(told.reshape(len(told), len(keys), -1) ** 2, axis=(0, 2))
    drawn = np.sort(np.argsort(-most, kind="stable")[:_MOST])
    fig = elements.new_figure(fig, (1.0 + 1.7 * n, 0.8 + 3.0 * len(drawn)))
    axes, panels = fig.subplots(2 * len(drawn), n, sharex=True, squeeze=False), {}
    for row, line in enumerate(axes):
        detector, axis = drawn[row // 2], row % 2
        line[0].set_ylabel(f"detector {keys[detector]}\nalong {'xy'[axis]} [pix]", fontsize="small", parse_math=False)
        for m, ax in enumerate(line):
            panels[(2 * detector + axis) * n + m] = ax
    for m, ax in enumerate(axes[0]):
        elements.set_title(ax, f"L{i[m]} L{j[m]}")
    first = elements.shorten(combined.nights[0].name)
    fig.suptitle(f"Changes from the camera of {first}", fontsize="medium", parse_math=False)
    return fig, panels, axes[-1]
