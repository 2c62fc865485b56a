"""Pictures of residuals: what each step of a correction leaves, means over the detector, pulls.

As in `legdistort.plots.solution_plots`.
"""

import numpy as np
from scipy.special import chdtri

from ..exceptions import InputError
from ..geometry import similarity
from ..geometry.distortion import Distortion
from ..inputs import column_contract
from . import elements
from .camera_plots import outline_detectors

_DENSE = 4000  # arrows beyond which they are pixels
_CELLS, _PER_CELL = 10, 6  # along the longer side, and observations that a cell needs
_WORST = 10  # error of a cell that is drawn, over their median
_BAND = 0.95
_MOST = 6  # ratio of residuals to expected ones that is drawn


def plot_steps(solution, *, scale=None, registered=True, fig=None):
    """Arrows from the mean of each star to its single positions: similarities alone, static part removed, solved.

    The middle panel is there where a static distortion was known. A title has the rms of the arrows per axis and their
    magnification, a bar beside it a length in pixels.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        What is drawn; of motions that were fitted stars are carried to one epoch.
    scale : float, optional
        Magnification, the same in all panels; by default a round number that makes the longest tenth of the arrows of
        a panel a twentieth of the field at most, the last panel magnified like the one before it.
    registered : bool
        False leaves similarities alone out where a static distortion was known.
    fig : `~matplotlib.figure.Figure`, optional
        Where to draw; its size is set.

    Raises
    ------
    LegdistortError
        If a distortion folds.
    """
    known = np.any(solution.estimate.prior_mean)
    steps = {}
    if registered or not known:
        steps["Shift, rotation and scale only"] = _aligned(solution), elements.RED
    if known:
        steps["Known static distortion removed"] = _aligned(solution, static=True), elements.GREEN
    solved = _at_epoch(solution, lambda name, xy: solution[name].to_reference(xy))
    steps["Every distortion solved"] = _by_star(solution, solved), elements.BLUE
    fig = elements.new_figure(fig, (3.6 * len(steps) + 0.2, 4.3))
    panels = list(fig.subplots(1, len(steps), sharex=True, sharey=True, squeeze=False)[0])
    means = [_mean_positions(positions) for positions, _ in steps.values()]
    away = [positions - mean for (positions, _), mean in zip(steps.values(), means, strict=True)]
    field = (np.nanmax(means[0], axis=0) - np.nanmin(means[0], axis=0)).max()
    long = [np.nanpercentile(np.hypot(*off.T), 90) for off in away]
    long[-2:] = [max(long[-2:])] * 2  # what the last step does is seen
    scales = [scale or elements.round_down(0.05 * field / (each or 1)) for each in long]
    for ax, title, mean, off, (_, colour), by in zip(panels, steps, means, away, steps.values(), scales, strict=True):
        _draw_arrows(ax, mean, off, by, colour)
        rms = np.sqrt(np.nanmean(off**2))
        ax.set(xlabel="x [px]", aspect="equal")
        ax.locator_params(nbins=5)
        ax.set_title(f"{title}\n{rms:.3f} px rms per axis, × {by:g}", loc="left", fontsize="medium")
    panels[0].set_ylabel("y [px]")
    for ax, by in zip(panels, scales, strict=True):
        _draw_length(ax, elements.round_down(0.12 * field / by), by)
    return panels


def _draw_length(ax, length, scale):
    """A bar above the right corner as long as this many pixels magnified."""
    low, high = ax.get_xlim()
    ax.plot([1 - length * scale / (high - low), 1], [1.01, 1.01], transform=ax.transAxes, color="black", linewidth=1.5,
            clip_on=False)  # fmt: skip
    ax.annotate(f"{length:g} px", (1, 1), xycoords="axes fraction", xytext=(-4, 5), textcoords="offset points",
                ha="right", fontsize="small")  # fmt: skip


def _mean_positions(positions):
    """Means (n_stars, 2) of positions (n_exposures, n_stars, 2), NaN for a star without any."""
    number = np.isfinite(positions).sum(axis=0)
    return np.where(number > 0, np.nansum(positions, axis=0) / np.maximum(number, 1), np.nan)


def _draw_arrows(ax, mean, off, scale, colour):
    """Lines from the mean of each star to its positions, magnified, with a point where they begin."""
    exposure, star = np.nonzero(np.isfinite(off[..., 0]))
    start, end = mean[star], mean[star] + scale * off[exposure, star]
    dense = len(star) > _DENSE
    lines = elements.draw_lines(ax, np.stack([start, end], axis=1), color=colour, linewidth=0.8, alpha=0.85)
    lines.set_rasterized(dense)
    if not dense:
        elements.mark(lines, stars=star, exposures=exposure)
    seen = np.flatnonzero(np.isfinite(mean[:, 0]))
    dots = ax.scatter(*mean[seen].T, s=5, color=colour, linewidths=0)
    elements.mark(dots, stars=seen)
    ax.margins(0.03)


def _aligned(solution, *, static=False):
    """Positions (n_exposures, n_stars, 2) in the reference plane by similarities that fit best to those solved."""

    def to_plane(name, xy):
        if static:
            xy = Distortion(
                solution.estimate.prior_mean[solution.names.index(name)], solution.estimate.shapes[name], name
            ).invert(xy)
        return similarity.apply(similarity.invert(solution.poses[name]), xy)

    positions = _by_star(solution, _at_epoch(solution, to_plane))
    for each in positions:
        seen = np.isfinite(each + solution.estimate.positions).all(axis=1)
        z, wanted = (xy[seen, 0] + 1j * xy[seen, 1] for xy in (each, solution.estimate.positions))
        if len(z):
            fit = np.linalg.lstsq(np.stack([z, np.ones(len(z))], axis=1), wanted, rcond=None)[0]
            moved = np.stack([z, np.ones(len(z))], axis=1) @ fit
            each[seen] = np.stack([moved.real, moved.imag], axis=1)
    return positions


def _at_epoch(solution, to_plane):
    """The same way to the reference plane, with stars whose motions were fitted carried to the epoch."""
    if solution.estimate.motions is None:
        return lambda name, xy, star: to_plane(name, xy)
    years = dict(zip(solution.names, solution.estimate.motions.years, strict=True))
    moved = {name: solution.estimate.motions.displacement(years[name], solution.sky) for name in solution.names}
    return lambda name, xy, star: to_plane(name, xy) - moved[name][star]


def _by_star(solution, to_plane):
    """Used positions (n_exposures, n_stars, 2) in the reference plane, NaN where a star was not used."""
    table = solution.residuals
    table = table[np.asarray(table["used"], dtype=bool)]
    x, y = (column_contract.values(table, axis, "pix") for axis in "xy")
    exposure, star = np.asarray(table["exposure"]), np.searchsorted(solution.estimate.star_names, table["star"])
    out = np.full((len(solution.names), len(solution.estimate.star_names), 2), np.nan)
    for i, name in enumerate(solution.names):
        rows = np.flatnonzero(exposure == name)
        if not len(rows):
            continue
        out[i, star[rows]] = to_plane(name, np.column_stack([x[rows], y[rows]]), star[rows])
    return out


def plot_mean_residuals(solution, *, scale=None, ax=None):
    """Weighted means of the residuals over cells of the detector, with their errors as circles.

    An arrow that ends inside its circle of one standard deviation is noise; of a cell that has none, nine in ten end
    within two radii (Rayleigh). Cells have six observations at least; those known ten times worse than others are left
    out.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        What is drawn.
    scale : float, optional
        Magnification; by default a round number that makes nine in ten arrows and radii shorter than a cell.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    """
    from matplotlib.collections import EllipseCollection

    ax = elements.new_axes(ax, (6.0, 6.0))
    places, mean, error = _cells(solution)
    ny, nx = np.max(list(solution.estimate.shapes.values()), axis=0)
    long = np.percentile([*np.hypot(*mean.T), *error], 90) if len(error) else 0
    scale = scale or elements.round_down(0.8 * max(nx, ny) / _CELLS / (long or 1))
    if solution.camera.has_focal_plane:
        outline_detectors(solution.camera, ax)
    size = 2 * scale * error
    ax.add_collection(
        EllipseCollection(size, size, np.zeros(len(size)), units="xy", offsets=places, transOffset=ax.transData,
                          facecolors=elements.GREY, alpha=0.3, edgecolors="none")
    )  # fmt: skip
    elements.draw_lines(ax, np.stack([places, places + scale * mean], axis=1), color=elements.BLUE, linewidth=1.6)
    ax.scatter(*places.T, s=6, color=elements.BLUE, linewidths=0)
    ax.set(xlim=(-0.5, nx - 0.5), ylim=(-0.5, ny - 0.5), xlabel="x [px]", ylabel="y [px]", aspect="equal")
    elements.set_title(ax, f"Mean residuals × {scale:g}, and 1σ of a mean")
    return ax


def _cells(solution):
    """Centres (n, 2), weighted mean residuals (n, 2) and errors per axis (n,) of the cells of the detector."""
    table = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    x, y, dx, dy = (column_contract.values(table, c, "pix") for c in ("x", "y", "dx", "dy"))
    ny, nx = np.max(list(solution.estimate.shapes.values()), axis=0)
    weight = 2 / np.einsum("nkk->n", solution.diagnostics.errors_of(table))
    n = int(np.clip(np.sqrt(len(table) / (2 * _PER_CELL)), 3, _CELLS))
    side = max(nx, ny) / n
    columns, rows = -(-nx // side), -(-ny // side)
    cell = np.clip((x + 0.5) // side, 0, columns - 1) + columns * np.clip((y + 0.5) // side, 0, rows - 1)
    cell = cell.astype(int)
    count, total = np.bincount(cell), np.bincount(cell, weight)
    kept = count >= _PER_CELL
    mean = np.stack([np.bincount(cell, weight * each)[kept] / total[kept] for each in (dx, dy)], axis=1)
    at = np.flatnonzero(kept)
    places = np.stack([(at % columns + 0.5) * side - 0.5, (at // columns + 0.5) * side - 0.5], axis=1)
    error = 1 / np.sqrt(total[kept])
    known = error <= _WORST * np.median(error) if len(error) else np.zeros(0, dtype=bool)
    return places[known], mean[known], error[known]


def plot_pulls(pulls, *, against="brightness", ax=None):
    """Residuals over their own expected errors, rms of a star or of an exposure, with the band of 95 % around one.

    Marks of more than six are at the upper edge.

    Parameters
    ----------
    pulls : `~legdistort.assessment.pulls.Pulls`
        See `legdistort.assessment.pulls.pulls_of`.
    against : {"brightness", "time"}
        One mark a star, or one an exposure.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.

    Raises
    ------
    InputError
        For anything else to draw them against.
    """
    if against not in ("brightness", "time"):
        raise InputError(f"against must be 'brightness' or 'time', got {against!r}")
    ax = elements.new_axes(ax, (6.4, 4.2))
    by_star = against == "brightness"
    sums = pulls.by_star() if by_star else pulls.by_exposure()
    shown = np.flatnonzero((sums.freedom > 0.5) & np.isfinite(sums.at))
    rms, free, at = (each[shown] for each in (sums.rms, sums.freedom, sums.at))
    low, high = (np.sqrt(chdtri(free, p) / free) for p in (0.5 + _BAND / 2, 0.5 - _BAND / 2))
    if len(at):  # a band that follows the number of observations, not that of each star, from the first to the last
        (at_band, low), (_, high) = (elements.running_median(at, each) for each in (low, high))
        at_band = np.concatenate([[at.min()], at_band, [at.max()]])
        low, high = (np.pad(each, 1, mode="edge") for each in (low, high))
        ax.fill_between(at_band, low, high, color=elements.BLUE, alpha=0.15, linewidth=0, label="95 % by chance")
    ax.axhline(1, color="black", linewidth=0.6)
    top = max(2.2, min(1.05 * np.max(rms, initial=0), _MOST))
    dots = ax.scatter(at, np.minimum(rms, top), s=16, color=elements.BLUE, linewidths=0, alpha=0.8, clip_on=False)
    dots.set_rasterized(len(shown) > _DENSE)
    if len(shown) <= _DENSE:
        elements.mark(dots, **{"stars" if by_star else "exposures": shown})
    ax.set(xlabel=sums.label, ylabel="rms residual / expected")
    if by_star and np.all(at > 0):
        ax.set_xscale("log")
    ax.set_ylim(0, top)
    elements.set_log_grid(ax)
    ax.legend(fontsize="small", loc="upper right")
    elements.set_title(ax, f"Residuals over expected ones, {'stars by brightness' if by_star else 'exposures in time'}")
    return ax
