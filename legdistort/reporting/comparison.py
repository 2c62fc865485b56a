"""Corrections and stacks compared: sections of the report, and the picture of the scatter of every star."""

import numpy as np

from ..assessment import baselines
from ..inputs import column_contract
from ..plots import elements, stack_plots
from ..results import accuracy
from .svg import detached_figure
from .tables import Row, Table, count

#: Colour and marker of every correction, to be distinguished in grey print and by colour-blind readers (Okabe & Ito).
STYLES = {
    "shift": ("#000000", "o"),
    "static + shift": ("#0072B2", "s"),
    "relative polynomial": ("#D55E00", "^"),
    baselines.METHOD: ("#009E73", "x"),
}


def plot_comparison(solutions, *, noise=None, ax=None):
    """Scatter sigma_j of corrected positions against flux for several corrections, one marker each.

    Parameters
    ----------
    solutions : dict
        ``{name: Solution}`` as from `legdistort.assessment.baselines.compare`; the legend gives mean and standard
        deviation. Without fluxes the stated error takes their place.
    noise : callable, optional
        ``noise(flux)``: error of a measured position per axis, pixels, drawn as a curve; by default the median of
        the stated errors.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    """
    ax = elements.new_axes(ax, (7.0, 5.0))
    known = solutions[baselines.METHOD].estimate.star_names if baselines.METHOD in solutions else ()
    for (name, solution), spare in zip(solutions.items(), "Dv<>*" * len(solutions), strict=False):
        flux, error, label = _abscissa(solution)
        sigma = accuracy.scatter(accuracy.corrected_positions(solution))
        figures = accuracy.scatter_summary(solution)
        colour, marker = STYLES.get(name, ("#CC79A7", spare))
        text = f"{name}: {figures['mean']:.3f} ± {figures['std']:.3f} px"
        seen = np.flatnonzero(np.isfinite(flux) & (sigma > 0))
        marks = ax.scatter(flux[seen], sigma[seen], s=25, marker=marker, color=colour, alpha=0.8, label=text,
                           linewidths=1.3 if marker == "x" else 0)  # fmt: skip
        if np.array_equal(solution.estimate.star_names, known):
            elements.mark(marks, stars=seen)
    if noise is None:
        good = np.isfinite(sigma)
        at, curve = elements.running_median(flux[good], error[good])
    else:
        at = np.geomspace(np.nanmin(flux), np.nanmax(flux), 100)
        curve = noise(at)
    ax.plot(at, curve, color="#E69F00", linewidth=2, label="error of one measured position")
    ax.set(xscale="log", yscale="log", xlabel=label, ylabel="scatter σ_j of corrected positions, per axis [px]")
    elements.set_log_grid(ax)
    ax.legend(fontsize="small", loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)  # clear of the marks
    return ax


def _abscissa(solution):
    """Mean flux (or stated error) and mean stated error of every star, and what the axis is called."""
    table = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    star = np.searchsorted(solution.estimate.star_names, table["star"])
    n = np.maximum(np.bincount(star, minlength=len(solution.estimate.star_names)), 1)

    def mean(values):
        return np.bincount(star, values, len(n)) / n

    x_err, y_err = (column_contract.values(table, column, "pix") for column in ("x_err", "y_err"))
    error = np.sqrt(mean((x_err**2 + y_err**2) / 2))
    if "flux" not in table.colnames or not np.any(column_contract.values(table, "flux") > 0):
        return error, error, "stated error of a position, per axis [px]"
    flux = mean(column_contract.values(table, "flux"))
    return np.where(flux > 0, flux, np.nan), error, f"flux [{table['flux'].unit or 'unit of the input'}]"


def compared_corrections(comparison, gallery):
    """Scatter of corrected positions by correction: title, table and picture."""
    head = {
        "correction": "",
        "stars": "",
        "mean": "px per axis",
        "standard deviation": "px per axis",
        "mean ": "px, both axes",
        "standard deviation ": "px, both axes",
    }
    figures, shown = map(accuracy.scatter_summary, comparison.values()), ("mean", "std", "mean_total", "std_total")
    rows = [
        Row([name, str(s["n_stars"]), *(f"{s[key]:.4f}" for key in shown)])
        for name, s in zip(comparison, figures, strict=True)
    ]
    picture = gallery.add(
        plot_comparison(comparison, ax=detached_figure(7.0, 5.0).subplots()).figure,
        "Scatter of every star's corrected positions over the exposures, by correction, with the error of one "
        "measured position: a correction is as good as the data allow where its marks lie along the curve.",
    )
    note = "Scatter of corrected positions over the exposures, star by star, on the positions that the solution used."
    return "Corrections compared", Table(head, rows, note), picture


def compared_stacks(made, gallery):
    """Sharpness of stacks made with other corrections: title, table and zooms.

    Parameters
    ----------
    made : `~legdistort.assessment.stack_quality.Stacks`
    gallery : `~legdistort.reporting.pictures.Gallery`
    """
    head = {
        "image": "",
        "FWHM": "px",
        "FWHM ratio": "to single exposures",
        "peak ratio": "to single exposures",
        "ellipticity": "",
        "positions": "px per axis",
    }
    shown = "fwhm", "fwhm_ratio", "peak_ratio", "ellipticity"
    rows = [
        Row([name, *(f"{getattr(q, key):.3f}" for key in shown), f"{q.position:.4f}"])
        for name, q in made.qualities.items()
    ]
    n = next(iter(made.qualities.values())).n_stars
    removed = "similarity" if made.removed == "similarity" else f"map of degree {made.removed}"
    picture = None
    if made.zooms:
        picture = gallery.add(
            stack_plots.plot_zooms(made.zooms, fig=detached_figure())[0, 0].figure,
            "The same stars towards the corners of the field in every stack, each row in one stretch, cores "
            "saturated to show the wings; the line is half the height of the star: wide, long or ragged outlines "
            "are stars that the correction smeared.",
        )
    note = (
        f"Medians over the {count(n, 'star')} of the brighter half, isolated and unsaturated, measured in all "
        "stacks; the stacks differ in nothing but the correction. Peak: height over flux. Positions: scatter about "
        f"those solved, in single exposures after correction, in stacks after a common {removed}, which the images do "
        "not determine, was taken out."
    )
    return "Stacks compared", Table(head, rows, note), picture
