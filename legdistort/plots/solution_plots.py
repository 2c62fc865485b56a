"""Pictures of a solution: residuals, distortions, coefficients, scatter, error maps.

Every function draws on the axes ``ax`` that it is given, or on new ones, and returns them; those that need
several take a figure ``fig``, set its size and return a list of axes. Nothing is shown or saved.
"""

from functools import partial

import numpy as np

from ..exceptions import InputError
from ..geometry import basis
from ..inputs import column_contract
from ..runtime.checks import check_positive
from . import elements
from .camera_plots import outline_detectors

#: Panels of one figure of small multiples.
PANELS = 12
_MAX_ARROWS = 3000
_NOTHING = 1e-3  # of the largest coefficient
_PARTS = {"total": "distortion", "nonlinear": "distortion of degree 2 and more", "dynamic": "dynamic distortion"}


def plot_residuals(view, *, scale=None, ax=None):
    """Arrows of the residuals (measured minus model) of an exposure; crosses mark positions not used.

    Over the detector; of several detectors over the focal plane, in which they are outlined.

    Of more than 3000 arrows a random sample is drawn.

    Parameters
    ----------
    view : `~legdistort.results.view.View`
        What is drawn.
    scale : float, optional
        Magnification; by default a round number that makes the longest tenth of the arrows 8 % of the detector.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; WCSAxes too, of the exposure or of another image of that sky, on which the arrows lie as they do
        over the detector.

    Raises
    ------
    InputError
        If none of the positions was used, the scale is not positive, or WCSAxes and exposure have no sky in common.
    """
    if scale is not None:
        check_positive(scale, "scale")
    ax = elements.new_axes(ax, (6.4, 6.4))
    table = view.residuals
    x, y, dx, dy = (column_contract.values(table, column, "pix") for column in ("x", "y", "dx", "dy"))
    used = np.asarray(table["used"], dtype=bool)
    rows = np.flatnonzero(used)
    if not len(rows):
        raise InputError(f"nothing to draw: no position of {view.label} was used")
    ny, nx = view.shape
    scale = scale or elements.round_down(0.08 * max(nx, ny) / (np.percentile(np.hypot(dx, dy)[rows], 90) or 1))
    if len(rows) > _MAX_ARROWS:
        rows = np.random.default_rng(0).choice(rows, _MAX_ARROWS, replace=False)
    if view.chip is None and view.solution.camera.has_focal_plane:
        outline_detectors(view.solution.camera, ax)
    xy, off, wcs = np.stack([x, y], axis=1), np.stack([dx, dy], axis=1), partial(getattr, view, "wcs")
    places = elements.to_axes(ax, xy, wcs)
    if elements.on_sky(ax):
        off = (elements.to_axes(ax, xy + scale * off, wcs) - places) / scale
    ax.plot(*places[~used].T, "x", color=elements.RED, markersize=4, label="not used", linestyle="none")
    arrows = ax.quiver(
        *places[rows].T,
        *off[rows].T,
        angles="xy",
        scale_units="xy",
        scale=1 / scale,
        width=0.002,
        color=elements.BLUE,
    )
    key = elements.round_down(0.1 * max(nx, ny) / scale)
    middle = np.array([[0, 0], [1, 0], [0, 1]]) + (nx / 2, ny / 2)
    pixel = np.sqrt(abs(np.linalg.det(np.diff(elements.to_axes(ax, middle, wcs), axis=0))))
    ax.quiverkey(arrows, 0.87, 1.025, key * pixel, f"{key:g} px", labelpos="E", coordinates="axes")
    elements.frame(ax, (-0.5, -0.5), (nx - 0.5, ny - 0.5), wcs)
    if not used.all():
        ax.legend(loc="upper right", fontsize="small")
    elements.set_title(ax, f"{elements.shorten(view.label)}: residuals × {scale:g}")
    return ax


def plot_distortion(solution, name, *, part="total", scale=50, ax=None):
    """Regular grid of undistorted pixels as the distortion of one exposure carries it to the detector, magnified.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        What is drawn.
    name : str
        Exposure.
    part : {"total", "nonlinear", "dynamic"}
        The whole distortion (blue) over its prior mean (orange); the same without the constant and linear modes, as
        in the paper's Figure "disto"; or only the departure from the prior mean. The undistorted grid is grey.
    scale : float, optional
        Magnification of the displacements; None is a round number that makes the largest displacement
        about a tenth of the detector.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.

    Raises
    ------
    InputError
        If the exposure or the part is unknown.
    """
    ax = elements.new_axes(ax, (5.4, 5.4))
    coefficients, prior = _parts(solution, name, part)
    shape = solution.estimate.shapes[name]
    scale = scale or distortion_scale(solution, [name], part=part)
    elements.draw_grid(ax, shape, np.zeros_like(coefficients), color=elements.GREY, linewidth=0.5)
    if prior is not None:
        elements.draw_grid(ax, shape, scale * prior, color=elements.ORANGE, linewidth=2.4, alpha=0.7)
    elements.draw_grid(ax, shape, scale * coefficients, color=elements.BLUE, linewidth=0.9)
    ax.margins(0.03)
    ax.autoscale_view()
    ax.set(xlabel="x [px]", ylabel="y [px]", aspect="equal")
    elements.set_title(ax, f"{elements.shorten(name)}: {_heading(part, scale, prior is not None)}")
    return ax


def plot_distortions(solution, *, names=None, page=0, part="total", scale=50, fig=None):
    """Small multiples of `plot_distortion`, twelve exposures a page, all with one magnification.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        What is drawn.
    names : sequence of str, optional
        Exposures to draw, default all.
    page : int
        Which dozen of `names`, from 0.
    part, scale
        As in `plot_distortion`; None chooses one magnification for all of the page.
    fig : `~matplotlib.figure.Figure`, optional
        Where to draw.
    """
    names = list(solution.names if names is None else names)
    shown = names[page * PANELS : (page + 1) * PANELS]
    if not shown:
        raise InputError(f"page {page} is empty: {len(names)} exposures fill {-(-len(names) // PANELS)} pages from 0")
    columns = min(4, len(shown))
    rows = -(-len(shown) // columns)
    fig = elements.new_figure(fig, (2.3 * columns + 0.5, 2.3 * rows + 0.6))
    panels = list(fig.subplots(rows, columns, squeeze=False).flat)
    scale = scale or distortion_scale(solution, shown, part=part)
    for i, (ax, name) in enumerate(zip(panels, shown, strict=False)):
        plot_distortion(solution, name, part=part, scale=scale, ax=ax)
        elements.mark(ax, exposures=[solution.names.index(name)])
        elements.set_title(ax, elements.shorten(name, 26), size="small")
        ax.set(xlabel="", ylabel="")
        ax.tick_params(labelsize="small")
        ax.locator_params(nbins=3)
        if i % columns:
            ax.set_yticks([])
        if i + columns < len(shown):
            ax.set_xticks([])
    for ax in panels[len(shown) :]:
        ax.remove()
    limits = np.array([[ax.get_xlim(), ax.get_ylim()] for ax in panels[: len(shown)]])
    low, high = limits[..., 0].min(axis=0), limits[..., 1].max(axis=0)
    for ax in panels[: len(shown)]:  # one scale for the eye
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    fig.supxlabel("x [px]", fontsize="medium")
    fig.supylabel("y [px]", fontsize="medium")
    heading = _heading(part, scale, part != "dynamic" and np.any(solution.estimate.prior_mean))
    fig.suptitle(heading.capitalize(), fontsize="medium")
    return panels[: len(shown)]


def distortion_scale(solution, names, *, part="total"):
    """Round magnification that makes the largest displacement of some exposures about a tenth of the detector."""
    peak = max(elements.peak(_parts(solution, name, part)[0]) for name in names)
    size = max(max(solution.estimate.shapes[name]) for name in names)
    return elements.round_down(0.1 * size / peak) if peak > 0 else 1.0


def plot_coefficients(solution, name=None, *, lowest=0, fig=None):
    """Bars of the distortion coefficients beside the prior mean (the paper's Figure "coeff").

    Displacement along x above, along y below; modes are named by their orders in x and y. Where some are more than
    twenty times as large as the largest error bar, the axis is linear near zero only and logarithmic beyond.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        What is drawn.
    name : str, optional
        One exposure, with its 1-sigma errors, relative ones; by default the mean of all but those of nights that are
        odd, with the scatter of the exposures (standard deviation), and beside it the error of one, the median of a
        dozen.
    lowest : int
        Lowest degree that is drawn: 2 leaves out what is like shift, rotation, scale and shear.
    fig : `~matplotlib.figure.Figure`, optional
        Where to draw.

    Raises
    ------
    InputError
        If there is no such exposure, or no mode of that degree.
    """
    first = basis.n_modes(lowest - 1) if lowest else 0
    values, prior, label, bars = _coefficients(solution, name)
    n = _n_shown(values, first, solution.degree) - first
    if n < 1:
        raise InputError(f"lowest is {lowest}, but the distortion has modes up to degree {solution.degree} only")
    shown = slice(first, first + n)
    has_prior = prior is not None and np.any(prior)
    fig = elements.new_figure(fig, (max(6.4, 0.34 * n + 1.2), 4.8))
    panels = list(fig.subplots(2, 1, sharex=True, sharey=True))
    width = 0.4 if has_prior else 0.7
    for axis, ax in enumerate(panels):
        ax.axhline(0, color="black", linewidth=0.6)
        at = np.arange(n)
        if has_prior:
            ax.bar(at - width / 2, prior[axis, shown], width, color=elements.ORANGE, label="prior")
            at = at + width / 2
        ax.bar(at, values[axis, shown], width, color=elements.BLUE, label=label)
        for k, (words, (colour, size)) in enumerate(bars.items()):
            shift = (k - (len(bars) - 1) / 2) * width / 2
            ax.errorbar(at + shift, values[axis, shown], size[axis, shown], fmt="none", ecolor=colour, capsize=2,
                        elinewidth=1, label=words)  # fmt: skip
        ax.set_ylabel(f"along {'xy'[axis]} [px]")
        ax.grid(axis="y", linewidth=0.3)
        ax.set_axisbelow(True)
    largest = np.max([size[:, shown] for _, size in bars.values()], initial=0.0)
    if 0 < 20 * largest < np.abs(values[:, shown]).max():
        panels[0].set_yscale("symlog", linthresh=elements.round_down(largest))
        panels[0].yaxis.set_major_formatter("{x:g}")
    orders = list(zip(*basis.orders(basis.degree_of(n + first)), strict=True))[first:]
    tall = n > 15
    panels[1].set_xticks(range(n), [f"({i}, {j})" for i, j in orders], rotation=90 * tall, fontsize="small")
    panels[1].set_xlabel("orders of the mode in x, y")
    legend = panels[0].legend(fontsize="small", loc="lower right", bbox_to_anchor=(1, 1), ncols=4, frameon=False,
                              handlelength=1.3, columnspacing=1.2)  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)
    elements.set_title(panels[0], "Distortion coefficients" if not first else f"Coefficients of degree {lowest} and up")
    return panels


def _n_shown(values, first, fitted):
    """Modes up to the degree that was fitted, or a higher one that a prior has, if it is more than next to nothing."""
    size = np.abs(values).max(axis=0)
    seen = np.flatnonzero(size > _NOTHING * size[first:].max(initial=0))
    return basis.n_modes(max(fitted, int(np.add(*basis.orders(basis.degree_of(len(size))))[seen].max(initial=0))))


def _coefficients(solution, name):
    """Coefficients, those of the prior, what they are called, and ``{name of an error bar: (colour, its size)}``."""
    if name is not None:
        values, prior = _parts(solution, name, "total")
        return values, prior, elements.shorten(name), {"1σ": ("black", _padded(solution, [name]))}
    odd = {each for names in solution.nights["exposures"][solution.nights["odd"]] for each in names.split(", ")}
    like = [i for i, each in enumerate(solution.names) if each not in odd]
    values, prior = (np.mean(each[like], axis=0) for each in (solution.coefficients, solution.estimate.prior_mean))
    bars = {"scatter": ("black", np.std(solution.coefficients[like], axis=0))}
    some = [solution.names[i] for i in like[:: -(-len(like) // PANELS)]]
    bars["1σ error"] = elements.RED, _padded(solution, some)
    return values, prior, "mean" + " but for odd nights" * bool(odd), bars


def _padded(solution, names):
    """Median over exposures of the errors of their coefficients (2, n_modes); 0 for what was not fitted."""
    errors = np.median([solution[name].relative_errors for name in names], axis=0)
    return np.pad(np.nan_to_num(errors), [(0, 0), (0, solution.coefficients.shape[2] - errors.shape[1])])


def plot_scatter(solution, *, label="scatter of one star", color=elements.BLUE, ax=None):
    """Residual scatter of every star against its flux, with the reported error (the paper's Figure "ercomp").

    The scatter is the rms residual per axis over the used positions of a star (two at least), the curve the
    median reported error per axis. Without fluxes the reported error takes their place.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        What is drawn.
    label, color
        Of the points, so that several solutions can share the axes.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    """
    ax = elements.new_axes(ax, (6.4, 4.6))
    table = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    _, star = np.unique(column_contract.labels(table, "star"), return_inverse=True)
    n = np.bincount(star)

    def mean(values):
        return np.bincount(star, values) / n

    dx, dy, x_err, y_err = (column_contract.values(table, column, "pix") for column in ("dx", "dy", "x_err", "y_err"))
    scatter, error = np.sqrt(mean(dx**2 + dy**2) / 2), np.sqrt(mean(x_err**2 + y_err**2) / 2)
    flux = mean(column_contract.values(table, "flux")) if "flux" in table.colnames else np.full(len(n), np.nan)
    keep = n >= 2
    if np.any(flux[keep] > 0):
        keep &= flux > 0
        at, curve = elements.running_median(flux[keep], error[keep])
        abscissa, xlabel = flux, f"flux [{table['flux'].unit or 'unit of the input'}]"
    else:
        at = curve = np.sort(error[keep])
        abscissa, xlabel = error, "reported error per axis [px]"
    ax.loglog(abscissa[keep], scatter[keep], "o", color=color, markersize=4, alpha=0.7, mew=0, label=label)
    ax.loglog(at, curve, color=elements.RED, linewidth=2, label="reported error (median)")
    ax.set(xlabel=xlabel, ylabel="rms residual per axis [px]")
    elements.set_log_grid(ax)
    ax.legend(fontsize="small")
    elements.set_title(ax, "Residual scatter of the stars")
    return ax


def plot_sigma_map(x, y, sigma, *, stars=None, unit="px", wcs=None, ax=None):
    """Map of the error of a corrected position (the paper's Figure "ergrid").

    Drawn by ``plot_sigma_map(*view.sigma_map())``.

    Parameters
    ----------
    x, y : array_like, shape (n_x,), (n_y,)
        Pixels of the detector, increasing.
    sigma : array_like, shape (n_y, n_x) or (n_y, n_x, 2)
        Error per axis (of two axes their rms is shown); NaN where no star supports the correction.
    stars : array_like, shape (n, 2), optional
        Positions of the stars that were fitted, drawn as crosses.
    unit : str
        Of the errors, for the label.
    wcs : callable, optional
        Returns the WCS of the pixels, where the axes may be WCSAxes.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.

    Raises
    ------
    InputError
        If the shapes do not agree, or WCSAxes and pixels have no sky in common.
    """
    from matplotlib import colormaps

    ax = elements.new_axes(ax, (6.4, 5.4))
    x, y, sigma = (np.asarray(a, dtype=float) for a in (x, y, sigma))
    if sigma.shape not in ((len(y), len(x)), (len(y), len(x), 2)):
        raise InputError(f"sigma must have shape ({len(y)}, {len(x)}) or that and 2, got {sigma.shape}")
    if sigma.ndim == 3:
        sigma = np.sqrt(np.mean(sigma**2, axis=2))
    good = sigma[np.isfinite(sigma)]
    edges = (np.concatenate([[p[0]], (p[1:] + p[:-1]) / 2, [p[-1]]]) for p in (x, y))
    picture = elements.draw_cells(
        ax,
        *edges,
        sigma,
        wcs,
        cmap=colormaps["viridis"].with_extremes(bad="#e6e6e6"),
        vmax=np.percentile(good, 99) if good.size else None,  # a steep corner must not flatten the rest
    )
    ax.figure.colorbar(picture, ax=ax, label=f"error per axis [{unit}]", extend="max", shrink=0.85)
    if stars is not None:
        places = elements.to_axes(ax, stars, wcs).T
        ax.plot(*places, "x", color="white", markersize=7, mew=3)
        ax.plot(*places, "x", color="black", markersize=6, mew=1)
    elements.frame(ax, (x[0], y[0]), (x[-1], y[-1]), wcs)
    elements.set_title(ax, "Error of a corrected position")
    return ax


def _heading(part, scale, has_prior):
    return f"{_PARTS[part]} × {scale:g}{' (blue) over the prior (orange)' if has_prior else ''}"


def _parts(solution, name, part):
    """Coefficients to draw and those of the prior behind them (None without one)."""
    i = solution.names.index(name)
    if part not in _PARTS:
        raise InputError(f"part must be 'total', 'nonlinear' or 'dynamic', got {part!r}")
    if part == "dynamic":
        return solution.coefficients[i] - solution.estimate.prior_mean[i], None
    coefficients, prior = solution.coefficients[i].copy(), solution.estimate.prior_mean[i].copy()
    if part == "nonlinear":
        coefficients[:, :3] = prior[:, :3] = 0
    return coefficients, prior if np.any(prior) else None
