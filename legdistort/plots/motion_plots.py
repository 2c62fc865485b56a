"""Pictures of the motions of stars: vector-point diagram, and errors against brightness.

As in `legdistort.plots.solution_plots`.
"""

import numpy as np
from astropy import units as u

from ..exceptions import InputError
from . import elements

_PLANE = (("vx", "vx_err"), ("vy", "vy_err"))
_SKY = (("pmra", "pmra_error"), ("pmdec", "pmdec_error"))


def _columns(solution):
    """Motions and relative errors (2, n) of stars that have them; names and unit of the axes; the table; which stars.

    Raises
    ------
    InputError
        If motions were not fitted.
    """
    if solution.estimate.motions is None:
        raise InputError("the motions of the stars were not fitted: call solve with motion='proper'")
    table, names = solution.stars, _PLANE if solution.sky is None else _SKY
    unit = u.pix / u.yr if solution.sky is None else u.mas / u.yr
    values, errors = (np.stack([table[pair[k]].to_value(unit) for pair in names]) for k in (0, 1))
    good = np.isfinite(values).all(axis=0)
    labels = [f"{pair[0]} [{'px' if solution.sky is None else 'mas'}/yr]" for pair in names]
    return values[:, good], errors[:, good], labels, table[good], np.flatnonzero(good)


def plot_motions(solution, *, ax=None):
    """Vector-point diagram: the proper motion of every star, with its relative errors.

    On the sky, east to the left, if that is known.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        Whose motions were fitted.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.

    Raises
    ------
    InputError
        If they were not.
    """
    ax = elements.new_axes(ax, (6.0, 6.0))
    (x, y), (x_err, y_err), labels, _, stars = _columns(solution)
    ax.errorbar(x, y, xerr=x_err, yerr=y_err, fmt="none", ecolor=elements.GREY, elinewidth=0.6)
    elements.mark(ax.scatter(x, y, s=16, color=elements.BLUE, linewidths=0, zorder=3), stars=stars)
    ax.axhline(0, color=elements.GREY, linewidth=0.6)
    ax.axvline(0, color=elements.GREY, linewidth=0.6)
    ax.set(xlabel=labels[0], ylabel=labels[1], aspect="equal")
    if solution.sky is not None:
        ax.invert_xaxis()
    elements.set_title(ax, f"Proper motions of {len(x)} stars")
    return ax


def plot_motion_errors(solution, *, ax=None):
    """Error of the proper motion of every star, rms of the axes, against its flux.

    Against its number of observations where there is no flux.

    Parameters and errors are those of `plot_motions`.
    """
    ax = elements.new_axes(ax, (6.4, 5.6))
    _, errors, labels, table, stars = _columns(solution)
    size = np.sqrt(np.mean(errors**2, axis=0))
    flux = np.asarray(table["flux"], dtype=float) if "flux" in table.colnames else np.full(len(table), np.nan)
    if np.any(flux > 0):
        stars, at, size = stars[flux > 0], flux[flux > 0], size[flux > 0]
        ax.set(xlabel="flux [unit of the input]", xscale="log", yscale="log")
    else:
        at = np.asarray(table["n"])
        ax.set(xlabel="observations used", yscale="log")
    elements.mark(ax.scatter(at, size, s=16, color=elements.BLUE, linewidths=0), stars=stars)
    elements.set_log_grid(ax)
    ax.set(ylabel=f"error per axis {labels[0].partition(' ')[2]}")
    elements.set_title(ax, "Errors of proper motions")
    return ax
