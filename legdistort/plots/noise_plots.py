"""Picture of noise curves: error of a position against flux, with two regimes (the paper's Figure "noiseflux")."""

import numpy as np

from . import elements

#: Colour and marker of every width, to be distinguished in grey print and by colour-blind readers (Okabe & Ito).
_STYLES = (
    ("#000000", "o"),
    ("#E69F00", "s"),
    ("#0072B2", "^"),
    ("#D55E00", "D"),
    ("#009E73", "v"),
    ("#CC79A7", "P"),
)


def plot_noise(curves, *, exposure=None, ax=None):
    """Errors against flux, one curve a width: those measured as marks, the laws fitted as lines.

    Grey lines show the two parts of the law of the first width: 1/flux by sky and detector, 1/sqrt(flux) by the photons
    of the star.

    Parameters
    ----------
    curves : `~legdistort.measurement.noise_curves.NoiseCurves`
    exposure : str, optional
        By default the first one that was calibrated.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    """
    ax = elements.new_axes(ax, (6.4, 4.6))
    name = exposure or curves.exposures[0]
    widths = np.unique(curves.laws["fwhm"][curves.laws["exposure"] == name].value)
    table = curves.table[curves.table["exposure"] == name]
    ranges = []
    for k, width in enumerate(widths):
        colour, marker = _STYLES[k % len(_STYLES)]
        rows = table[table["fwhm"].value == width]
        error = np.sqrt((rows["x_sigma"].value ** 2 + rows["y_sigma"].value ** 2) / 2)
        flux = np.geomspace(rows["flux"].min(), rows["flux"].max(), 100)
        law = curves.sigma(flux, fwhm=width, exposure=name)
        ax.plot(rows["flux"], error, marker, color=colour, markersize=5, mew=0, label=f"FWHM {width:.2f} px")
        ax.plot(flux, law, "-", color=colour, linewidth=1.3)
        ranges.append([np.nanmin([error.min(), law.min()]), np.nanmax([error.max(), law.max()])])
    first = curves.laws[(curves.laws["exposure"] == name) & (curves.laws["fwhm"].value == widths[0])][0]
    a, b = (np.hypot(first[f"x_{key}"], first[f"y_{key}"]) / np.sqrt(2) for key in "ab")
    flux = np.geomspace(table["flux"].min(), table["flux"].max(), 50)
    ax.plot(flux, a / flux, "--", color=elements.GREY, linewidth=1.3, zorder=1, label="∝ 1 / flux: sky, detector")
    ax.plot(flux, b / np.sqrt(flux), ":", color=elements.GREY, linewidth=1.8, zorder=1, label="∝ 1 / √flux: photons")
    ax.set(xscale="log", yscale="log", xlabel="flux [units of the data]", ylabel="error of a position, per axis [px]")
    ax.set_ylim(0.6 * np.nanmin(ranges), 1.6 * np.nanmax(ranges))
    elements.set_log_grid(ax)
    ax.legend(fontsize="small", frameon=False)
    elements.set_title(ax, f"{elements.shorten(name)}: stars put in and measured again")
    return ax
