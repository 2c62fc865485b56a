"""The figures of Bernard et al. (2017), redrawn from what `simulations`, `gems`, `families` and `keck` return."""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from legdistort.geometry import basis
from legdistort.geometry.gsaoi import GsaoiMap
from legdistort.plots import elements
from legdistort.reporting.comparison import plot_comparison
from legdistort.results import accuracy

IMAGES = Path(__file__).parents[1] / "images" / "paper"
BLACK, BLUE, ORANGE, RED, GREEN, GREY = "#000000", "#0072B2", "#E69F00", "#D55E00", "#009E73", "#9a9a9a"


def save(fig, name, folder=None):
    """Write a figure as a small PNG with a palette."""
    from PIL import Image

    folder = IMAGES if folder is None else Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    fig.savefig(path, dpi=90, bbox_inches="tight", pad_inches=0.08)
    plt.close(fig)
    image = Image.open(path).convert("RGB")
    # "maximum coverage" keeps colours that cover little, such as those of marks and bars
    image.quantize(128, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"  {name}.png, {path.stat().st_size / 1024:.0f} kB", file=sys.stderr)
    return path


def new(columns=1, rows=1, *, size=(6.4, 4.4), **options):
    """Figure and its axes (one, or an array)."""
    return plt.subplots(rows, columns, figsize=size, layout="constrained", **options)


# -- section 2: the model


def first_modes(shape=(100, 100), amplitude=24.0):
    """Figure "leg": what the first modes do to a grid, along x."""
    fig, panels = new(4, size=(11, 3.1), sharex=True, sharey=True)
    titles = ["no distortion", "m = 0: L₀(x) L₀(y), shift", "m = 1: L₁(x) L₀(y), scale", "m = 2: L₀(x) L₁(y), shear"]
    for k, (ax, title) in enumerate(zip(panels, titles, strict=True)):
        coefficients = np.zeros((2, 3))
        elements.draw_grid(ax, shape, coefficients, color=GREY, linewidth=0.6)
        if k:
            coefficients[0, k - 1] = amplitude
        elements.draw_grid(ax, shape, coefficients, color=BLUE, linewidth=1.0)
        ax.autoscale_view()
        ax.set(aspect="equal", xlabel="x [px]")
        ax.set_title(title, loc="left", fontsize="medium")
    panels[0].set_ylabel("y [px]")
    return fig


def application(sim, magnified=30):
    """Figure "distoschem": reference positions, three distortion maps, the positions that they make."""
    truth = sim.truth
    fig, panels = new(4, 2, size=(11, 5.6), sharex=True, sharey=True)
    xy = truth.positions
    panels[1, 0].remove()
    panels[0, 0].plot(*xy.T, "o", color=BLACK, markersize=3)
    panels[0, 0].set_title("reference positions X_ref", loc="left", fontsize="medium")
    for i, name in enumerate(truth.names[:3]):
        ax = panels[0, i + 1]
        elements.draw_grid(ax, truth.shape, np.zeros_like(truth.coefficients[i]), color=GREY, linewidth=0.4)
        elements.draw_grid(ax, truth.shape, magnified * truth.coefficients[i], color=BLUE, linewidth=0.9)
        ax.set_title(f"distortion D_{i}, × {magnified}", loc="left", fontsize="medium")
        ax = panels[1, i + 1]
        moved = xy + magnified * (truth.distort(name, xy) - xy)
        ax.plot(*xy.T, "o", color=GREY, markersize=3)
        ax.quiver(*xy.T, *(moved - xy).T, angles="xy", scale_units="xy", scale=1, width=0.004, color=BLUE)
        ax.set_title(f"positions in exposure {i}", loc="left", fontsize="medium")
        ax.set_xlabel("x [px]")
    for ax in panels.flat[[0, 1, 2, 3, 5, 6, 7]]:
        ax.set(aspect="equal", xlim=(-280, 2330), ylim=(-280, 2330))
    panels[0, 0].tick_params(labelbottom=True)
    panels[1, 1].tick_params(labelleft=True)
    panels[0, 0].set(ylabel="y [px]", xlabel="x [px]")
    panels[1, 1].set_ylabel("y [px]")
    return fig


def one_star(sim, solution, star=0):
    """Figure "schema": one star in all exposures, before and after, and the two criteria."""
    truth = sim.truth
    raw = np.stack([truth.distort(name, truth.positions[[star]])[0] for name in truth.names])
    table = sim.matches.table[sim.matches.table["star"] == star]
    raw = np.column_stack([table["x"].value, table["y"].value])
    corrected = np.stack([solution[name].correct(p)[0] for name, p in zip(truth.names, raw, strict=True)])
    true, estimated = truth.positions[star], solution.estimate.positions[star]
    fig, panels = new(3, size=(11.5, 4.2))
    for ax, points, title in zip(
        panels, (raw, corrected, corrected), ("measured", "corrected", "corrected, enlarged"), strict=True
    ):
        ax.plot(*(points - true).T, "x", color=BLACK, markersize=6, label="one exposure each")
        ax.plot(0, 0, "+", color=RED, markersize=15, mew=2.5, label="true position")
        ax.set(aspect="equal", xlabel="x − true x [px]")
        ax.set_title(title, loc="left", fontsize="medium")
    half = 1.15 * np.abs(raw - true).max()
    for ax in panels[:2]:
        ax.set(xlim=(-half, half), ylim=(-half, half))
    panels[0].set_ylabel("y − true y [px]")
    ax = panels[2]
    half = 1.25 * np.abs(corrected - true).max()
    ax.set(xlim=(-half, half), ylim=(-half, half))
    ax.plot(*(estimated - true), "D", mfc="none", color=BLUE, markersize=11, mew=2, label="estimated X_ref")
    ax.plot(*(corrected.mean(axis=0) - true), ".", color=ORANGE, markersize=10, label="mean of corrected")
    sigma = np.sqrt(np.mean(np.sum((corrected - corrected.mean(axis=0)) ** 2, axis=1)))
    circle = plt.Circle(corrected.mean(axis=0) - true, sigma, fill=False, linestyle="--", color=BLACK)
    ax.add_patch(circle)
    b = np.hypot(*(estimated - true))
    ax.set_title(f"enlarged: b_j = {b:.3f} px, σ_j = {sigma:.3f} px (dashed)", loc="left", fontsize="medium")
    panels[0].legend(*ax.get_legend_handles_labels(), fontsize="small", loc="lower left")
    return fig


# -- section 4: simulations


def error_map(sim, grid, sigma, square):
    """Figure "ergrid": scatter of new stars over the field, with the contour."""
    n = round(np.sqrt(len(grid)))
    fig, ax = new(size=(6.6, 5.4))
    x, y = grid[:n, 0], grid[::n, 1]
    picture = ax.pcolormesh(x, y, sigma.reshape(n, n), cmap="viridis", vmin=0.05, vmax=0.4, rasterized=True)
    fig.colorbar(picture, ax=ax, label="σ_j' of a new star, per axis [px]", extend="max", shrink=0.9)
    ax.plot(*sim.truth.positions.T, "x", color="white", markersize=9, mew=3)
    ax.plot(*sim.truth.positions.T, "x", color="black", markersize=8, mew=1.2)
    ax.add_patch(plt.Rectangle(square[0], *np.ptp(square, axis=0), fill=False, color=RED, linewidth=2))
    ax.set(aspect="equal", xlabel="x [px]", ylabel="y [px]")
    inside = accuracy.in_contour(grid, square)
    rms = [np.sqrt(np.mean(part**2)) for part in (sigma, sigma[inside])]
    ax.set_title(f"σ_grid = {rms[0]:.3f} px, σ_contour = {rms[1]:.3f} px (red square)", loc="left", fontsize="medium")
    return fig


def noise_propagation(propagation):
    """Figure "erbilan": both criteria against the noise."""
    fig, ax = new()
    at = np.concatenate([[0], propagation.levels])
    for k, colour, marker, name in ((2, BLACK, "o", "σ"), (0, BLUE, "s", "b")):
        slope, error = propagation.slope(k)
        ax.plot(at, np.concatenate([[0], propagation.curves[:, k]]), marker, color=colour, label=f"{name}, measured")
        ax.plot(at, slope * at, "-", color=colour, linewidth=1, label=f"slope s_{name} = {slope:.3f} ± {error:.3f}")
    ax.set(xlabel="error of a measured position σ_meas, per axis [px]", ylabel="criterion, per axis [px]")
    ax.legend(fontsize="small")
    ax.grid(linewidth=0.3)
    return fig


def slopes(table, variable, *, law=None, law_label=""):
    """Figures "erim" and "erstar": slopes against the number of exposures or of stars, ``{n: Propagation}``."""
    fig, ax = new()
    n = np.array(list(table))
    for k, colour, marker, name in ((2, BLACK, "o", "s_σ"), (0, BLUE, "s", "s_b")):
        value, error = np.array([p.slope(k) for p in table.values()]).T
        ax.errorbar(n, value, error, fmt=f"{marker}-", color=colour, label=name, capsize=3)
    if law is not None:
        fine = np.geomspace(n.min(), n.max(), 100)
        ax.plot(fine, law(fine), ":", color=GREY, linewidth=2, label=law_label)
    ax.set(xscale="log", xlabel=variable, ylabel="slope of the noise propagation")
    ax.set_ylim(0, None)
    ax.set_xticks(n, [str(k) for k in n])
    ax.minorticks_off()
    ax.legend(fontsize="small")
    ax.grid(linewidth=0.3)
    return fig


def aliasing(found):
    """Figure "spec1": rms errors of the coefficients for three kinds of x^4, ``{kind: (errors, b)}``."""
    titles = {
        "monomial": "plain x⁴, another sign in every other exposure",
        "legendre": "orthogonal mode L₄(x), another sign in every other exposure",
        "common": "orthogonal mode L₄(x), the same in all exposures",
    }
    fig, panels = new(1, 3, size=(9, 7.5), sharex=True, sharey=True)
    orders = list(zip(*basis.orders(3), strict=True))
    for ax, (kind, (errors, b)) in zip(panels, found.items(), strict=True):
        rms = np.sqrt(np.mean(errors**2, axis=0))
        at = np.arange(len(orders))
        ax.bar(at - 0.2, rms[0], 0.4, color=GREEN, label="error along x")
        ax.bar(at + 0.2, rms[1], 0.4, color=ORANGE, label="error along y")
        ax.bar(len(orders) - 0.2, 1.0, 0.4, color=RED, hatch="//", label="mode put in, not fitted")
        energy = np.sum(rms**2)
        ax.set_title(
            f"{titles[kind]}: energy in the errors {100 * energy:.1f} %, b = {b:.3f} px", loc="left", fontsize="medium"
        )
        ax.set_ylabel("rms [px]")
        ax.grid(axis="y", linewidth=0.3)
        ax.set_axisbelow(True)
    panels[0].legend(fontsize="small", loc="upper center")
    panels[-1].set_xticks(range(len(orders) + 1), [f"({i}, {j})" for i, j in orders] + ["(4, 0)"])
    panels[-1].set_xlabel("orders of the mode in x, y")
    return fig


# -- section 5: the twin of the GeMS data


def static_map(magnified=50):
    """Figure "disto": second and higher orders of the published distortion of GSAOI detector 2."""
    instrument = GsaoiMap(2)
    t = np.linspace(0, 2047, 17)
    q = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    move = instrument.distort(q) - q
    design = np.column_stack([np.ones(len(q)), q])
    move -= design @ np.linalg.lstsq(design, move, rcond=None)[0]
    fig, ax = new(size=(6, 6))
    arrows = ax.quiver(*q.T, *move.T, angles="xy", scale_units="xy", scale=1 / magnified, color=BLUE, width=0.003)
    ax.quiverkey(arrows, 0.85, 1.04, 5, "5 px", labelpos="E", coordinates="axes")
    ax.set(aspect="equal", xlabel="x [px]", ylabel="y [px]", xlim=(-150, 2600), ylim=(-150, 2200))
    peak = np.abs(move).max(axis=0)
    title = f"orders 2 and more, × {magnified}; peak {peak[0]:.1f} px in x, {peak[1]:.1f} px in y"
    ax.set_title(title, loc="left", fontsize="medium")
    return fig


def measured_errors(twin):
    """Figure "star": stated error of measured positions against flux, and the best and the worst of them."""
    table = twin.matches.table
    flux, error = (
        np.asarray(table["flux"], dtype=float),
        np.hypot(table["x_err"].value, table["y_err"].value) / np.sqrt(2),
    )
    fig = plt.figure(figsize=(10, 4.4), layout="constrained")
    grid = fig.add_gridspec(2, 2, width_ratios=[2.2, 1])
    ax = fig.add_subplot(grid[:, 0])
    ax.loglog(flux, error, "o", color=BLUE, markersize=3, alpha=0.5, mew=0)
    ax.set(xlabel="flux [ADU]", ylabel="error of a position, per axis [px]")
    ax.grid(linewidth=0.3)
    for place, row, colour in ((grid[0, 1], int(np.argmin(error)), GREEN), (grid[1, 1], int(np.argmax(error)), RED)):
        ax.loglog(flux[row], error[row], "o", mfc="none", color=colour, markersize=13, mew=2)
        small = fig.add_subplot(place)
        exposure = next(e for e in twin.exposures if e.name == table["exposure"][row])
        x, y = round(table["x"][row].value), round(table["y"][row].value)
        low = np.maximum([x - 20, y - 20], 0)
        cut = exposure.data[low[1] : y + 21, low[0] : x + 21]
        _picture(small, cut, low, np.percentile(cut, [2, 99.7]))
        small.set(xlabel="x [px]", ylabel="y [px]")
        small.set_title(f"error {error[row]:.4f} px", color=colour, fontsize="medium", loc="left")
    return fig


def noise_flux(fluxes, curves, scale=20.0):
    """Figure "noiseflux": measured error against flux for several widths, ``{fwhm [px]: error}``."""
    fig, ax = new()
    for (fwhm, error), colour, marker in zip(curves.items(), (BLACK, ORANGE, BLUE, RED), "os^D", strict=False):
        ax.loglog(fluxes, error, f"{marker}-", color=colour, label=f"FWHM {scale * fwhm:.0f} mas", markersize=5)
    first = next(iter(curves.values()))
    good = np.isfinite(first)
    at = np.geomspace(fluxes[good].min(), fluxes.max(), 50)
    low, high = np.flatnonzero(good)[[0, -1]]
    ax.loglog(at, 0.6 * first[low] * fluxes[low] / at, "--", color=GREY, label="1 / flux")
    ax.loglog(at, 0.6 * first[high] * np.sqrt(fluxes[high] / at), ":", color=GREY, label="1 / √flux", linewidth=2)
    ax.set(xlabel="flux [ADU]", ylabel="error of a position, per axis [px]", ylim=(5e-4, 1))
    ax.legend(fontsize="small")
    ax.grid(linewidth=0.3)
    return fig


def used_stars(twin, name):
    """Figure "stars": the stars that are used, on one exposure."""
    exposure = next(e for e in twin.exposures if e.name == name)
    table = twin.matches.table[twin.matches.table["exposure"] == name]
    fig, ax = new(size=(5.4, 5.4))
    _show(ax, np.asarray(exposure.data, dtype=float))
    ax.plot(table["x"].value, table["y"].value, "o", mfc="none", color=RED, markersize=10, mew=1.3)
    ax.set_title(f"{name}: {len(table)} stars used (circles)", loc="left", fontsize="medium")
    return fig


def corrections(solutions, noise):
    """Figure "ercomp": the four corrections, and the error of one measured position."""
    fig, ax = new(size=(7.4, 5.4))
    plot_comparison(solutions, noise=noise, ax=ax)
    return fig


def coefficients(solution, name):
    """Figure "coeff": coefficients of one exposure beside the static ones."""
    view = solution[name]
    n = solution.gauge.n_constraints // 2
    orders = list(zip(*basis.orders(solution.degree), strict=True))
    fig, panels = new(1, 2, size=(8, 5), sharex=True)
    for axis, ax in enumerate(panels):
        at = np.arange(n)
        ax.bar(at - 0.2, view.prior_mean[axis, :n], 0.4, color=ORANGE, label="static, A⁰")
        ax.bar(at + 0.2, view.coefficients[axis, :n], 0.4, color=BLUE, label=f"estimated, {name}")
        ax.axhline(0, color="black", linewidth=0.6)
        ax.set_ylabel(f"along {'xy'[axis]} [px]")
        ax.grid(axis="y", linewidth=0.3)
        ax.set_axisbelow(True)
    panels[0].legend(fontsize="small")
    panels[1].set_xticks(range(n), [f"({i}, {j})" for i, j in orders])
    panels[1].set_xlabel("orders of the mode in x, y")
    return fig


def stacks(method, static, zooms, size=24):
    """Figures "im" and "stars2": the stack, and single stars of it for the method and for the static correction."""
    fig = plt.figure(figsize=(10, 5.6), layout="constrained")
    grid = fig.add_gridspec(2, 4)
    whole = fig.add_subplot(grid[:, :2])
    _show(whole, method.data)
    whole.set_title("stack, all distortions solved", loc="left", fontsize="medium")
    for row, place in enumerate(zooms):
        whole.plot(*(place - method.offset), "s", mfc="none", color=RED, markersize=11, mew=1.6)
        whole.annotate(f"{row + 1}", place - method.offset + [45, 45], color=RED)
        top = None
        for column, (mosaic, name) in enumerate(((method, "all solved"), (static, "static + shift"))):
            ax = fig.add_subplot(grid[row, 2 + column])
            x, y = np.round(place - mosaic.offset - size / 2).astype(int)
            cut = mosaic.data[y : y + size + 1, x : x + size + 1] - np.nanmedian(mosaic.data)
            top = top or np.nanmax(cut)
            _picture(ax, cut, (x, y), (0, top))
            ends = np.arange(x, x + size + 1), np.arange(y, y + size + 1)
            ax.contour(*ends, cut, levels=[0.25 * top, 0.5 * top, 0.75 * top], colors=[BLUE, ORANGE, RED])
            peak = 100 * np.nanmax(cut) / top
            ax.set_title(f"{row + 1}: {name}, peak {peak:.0f} %", loc="left", fontsize="medium")
            ax.set_xlabel("x [px]")
            ax.tick_params(labelsize="small")
    return fig


def _picture(ax, image, corner, limits, *, block=1):
    """Dark stars on light sky, axes in pixels of the whole image; `block` of them to one of these."""
    ends = [(low - 0.5, low - 0.5 + block * n) for low, n in zip(corner, image.shape[::-1], strict=True)]
    ax.imshow(image, origin="lower", cmap="gray_r", vmin=limits[0], vmax=limits[1], extent=(*ends[0], *ends[1]))


def _show(ax, image, most=450):
    block = max(1, -(-max(image.shape) // most))
    small = elements.block_mean(image, block)
    sky, high = np.nanpercentile(small, [50, 84])
    _picture(ax, np.arcsinh((small - sky) / (high - sky)), (0, 0), (-1, 5), block=block)
    ax.set(xlabel="x [px]", ylabel="y [px]")


# -- beyond the paper


def model_families(fits, noisy):
    """Residual and condition against the number of coefficients, ``{map: {family: Fits}}``, and fits to few stars."""
    styles = {
        "Legendre": (GREEN, "o"),
        "powers of pixels": (RED, "^"),
        "powers, scaled to [-1, 1]": (ORANGE, "v"),
        "cubic B-splines": (BLUE, "s"),
    }
    fig, panels = new(len(fits), 3, size=(5.2 * len(fits), 10.5), sharex=True, sharey="row", squeeze=False)
    for column, (name, families) in enumerate(fits.items()):
        for family, fit in families.items():
            colour, marker = styles[family]
            panels[0, column].semilogy(
                fit.number, np.maximum(fit.residual, 1e-6), f"{marker}-", color=colour, label=family, mfc="none"
            )
            panels[1, column].semilogy(fit.number, fit.condition, f"{marker}-", color=colour, mfc="none")
        for family, (number, error) in noisy[name].items():
            colour, marker = styles[family]
            panels[2, column].semilogy(number, error, f"{marker}-", color=colour, mfc="none")
        panels[2, column].set(xlabel="coefficients per axis", ylim=(4e-3, 10))
        panels[0, column].set_title(name, loc="left", fontsize="medium")
        panels[0, column].set_ylim(5e-7, 10)
        panels[1, column].set_ylim(0.5, 1e20)
        panels[1, column].axhline(1 / np.finfo(float).eps, color=GREY, linestyle=":")
        for ax in panels[:, column]:
            ax.grid(linewidth=0.3)
    panels[0, 0].set_ylabel("residual, rms per axis [px]")
    panels[1, 0].set_ylabel("condition number of the fit")
    panels[2, 0].set_ylabel("error of a fit to 80 stars, rms per axis [px]")
    panels[1, 0].text(60, 3e16, "limit of double precision", color="0.4", fontsize="small")
    panels[0, 0].legend(fontsize="small")
    return fig


def real_lists(found):
    """Error floors by degree and prior, and the corrections compared, of the real lists."""
    fig, panels = new(2, 2, size=(12, 8.6))
    for row, (label, figures) in enumerate(found.items()):
        ax = panels[row, 0]
        names = list(dict.fromkeys(name for _, name in figures["floor"]))
        for name, colour, marker in zip(names, (BLACK, BLUE, ORANGE, GREEN, RED), "osv^D", strict=False):
            degrees = sorted({d for d, n in figures["floor"] if n == name})
            ax.plot(
                degrees,
                [figures["floor"][d, name] for d in degrees],
                f"{marker}-",
                color=colour,
                label=f"prior: {name}",
            )
            ax.plot(degrees, [figures["held_out"][d, name] for d in degrees], f"{marker}:", color=colour, mfc="none")
        ax.plot([], [], "-", color=GREY, label="error floor that the fit needs")
        ax.plot([], [], ":", color=GREY, label="observations left out: predicted − measured")
        ax.set(xlabel=f"{label}: degree fitted", ylabel="px per axis", xticks=range(4))
        ax.set_ylim(0, None)
        ax.legend(fontsize="small", loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
        ax.grid(linewidth=0.3)
        plot_comparison(figures["corrections"], ax=panels[row, 1])
    return fig
