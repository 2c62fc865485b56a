"""Picture of a comparison of corrections: scatter of every star (Bernard et al. 2017, Figure "ercomp")."""

import numpy as np

from ..assessment import baselines
from ..inputs import column_contract
from ..plots import elements
from ..results import accuracy

#: Colour and marker of every correction, told apart in grey print and by colour-blind readers (Okabe & Ito).
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
    for (name, solution), spare in zip(solutions.items(), "Dv<>*" * len(solutions), strict=False):
        flux, error, label = _abscissa(solution)
        sigma = accuracy.scatter(accuracy.corrected_positions(solution))
        figures = accuracy.scatter_summary(solution)
        colour, marker = STYLES.get(name, ("#CC79A7", spare))
        text = f"{name}: {figures['mean']:.3f} ± {figures['std']:.3f} px"
        ax.plot(flux, sigma, marker, color=colour, markersize=5, alpha=0.8, mew=1.3 if marker == "x" else 0, label=text)
    if noise is None:
        good = np.isfinite(sigma)
        at, curve = elements.running_median(flux[good], error[good])
    else:
        at = np.geomspace(np.nanmin(flux), np.nanmax(flux), 100)
        curve = noise(at)
    ax.plot(at, curve, color="#E69F00", linewidth=2, label="error of one measured position")
    ax.set(xscale="log", yscale="log", xlabel=label, ylabel="scatter σ_j of corrected positions, per axis [px]")
    ax.grid(linewidth=0.3)
    elements.set_log_ticks(ax.xaxis)
    elements.set_log_ticks(ax.yaxis)
    ax.legend(fontsize="small", loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)  # clear of the marks
    return ax


def _abscissa(solution):
    """Mean flux (or stated error) and mean stated error of every star, and what the axis is called."""
    table = solution.observations[np.asarray(solution.observations["used"], dtype=bool)]
    star = np.searchsorted(solution.star_names, table["star"])
    n = np.maximum(np.bincount(star, minlength=len(solution.star_names)), 1)

    def mean(values):
        return np.bincount(star, values, len(n)) / n

    x_err, y_err = (column_contract.values(table, column, "pix") for column in ("x_err", "y_err"))
    error = np.sqrt(mean((x_err**2 + y_err**2) / 2))
    if "flux" not in table.colnames or not np.any(column_contract.values(table, "flux") > 0):
        return error, error, "stated error of a position, per axis [px]"
    flux = mean(column_contract.values(table, "flux"))
    return np.where(flux > 0, flux, np.nan), error, f"flux [{table['flux'].unit or 'unit of the input'}]"
