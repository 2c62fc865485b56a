"""Make the pictures of the README and the documentation: ``python docs/make_figures.py`` (about a minute).

Everything is seeded and goes through the public functions, so the pictures show what a user gets.
"""

import tempfile
import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from astropy import units as u
from PIL import Image

import legdistort as ld
from legdistort.assessment import baselines, stack_quality
from legdistort.demo import run_demo
from legdistort.geometry import similarity
from legdistort.geometry.distortion import Distortion
from legdistort.plots import solution_plots, stack_plots
from legdistort.results import accuracy
from legdistort.solving import minimisers, start_values
from legdistort.solving.equations.problem import build_problem

IMAGES = Path(__file__).parent / "images"
BLUE, GREEN, ORANGE = "#0072B2", "#009E73", "#D55E00"
MAGNIFIED = 80


def main():
    """Run both demonstrations and draw."""
    IMAGES.mkdir(exist_ok=True)
    save(sweeps(), "sweeps.png")
    save(planned(), "planning.png", colours=256)
    save(ld.Camera.gsaoi().plot().figure, "gsaoi_camera.png")
    with tempfile.TemporaryDirectory() as folder:
        night = run_demo(out=Path(folder) / "night")
        save(before_after(night.solution), "before_after.png", colours=256)
        save(stacked(night), "stacks.png", colours=256)
        save(noise(night.out / "frames" / "exp00.fits"), "noise.png")
        small = run_demo(out=Path(folder) / "small", small=True)
        draw_first_mosaic(small)


def sweeps(n_sweeps=300, n_seeds=10):
    """Error of the star positions against iterations of the two solvers, rms of ten seeds of Simulation 1."""
    curves = {"alternating": [], "joint": []}
    for seed in range(n_seeds):
        sim = ld.simulate_matches(seed=seed)
        true = sim.truth.positions
        problem = build_problem(sim.matches, 3, prior=ld.Prior(sim.truth.static))
        start, _ = start_values.start(problem, np.stack([sim.matches.poses[name] for name in sim.matches.names]))
        for name, solver, n in (
            ("alternating", minimisers.solve_alternating, n_sweeps),
            ("joint", minimisers.solve_joint, 4),
        ):
            state, curve = start, []
            for _ in range(n):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # one step at a time never converges
                    state = solver(problem, state, max_iterations=1).state
                positions = state.positions.T
                curve.append([accuracy.bias(positions, true), accuracy.bias(positions, true, removed=3)])
            curves[name].append(curve)
    fig, ax = plt.subplots(figsize=(6.4, 4), layout="constrained")
    for name, colour in (("alternating", ORANGE), ("joint", BLUE)):
        rms = np.sqrt(np.mean(np.square(curves[name]), axis=0))
        n = np.arange(1, len(rms) + 1)
        ax.plot(n, rms[:, 0], "-", color=colour, marker="o" if len(n) < 10 else None, label=f"{name}, as it stands")
        ax.plot(n, rms[:, 1], "--", color=colour, marker="s" if len(n) < 10 else None,
                label=f"{name}, common cubic map removed")  # fmt: skip
    ax.axhline(0.14 / np.sqrt(10), color="0.6", linewidth=1)
    ax.text(1.05, 0.14 / np.sqrt(10) * 0.985, "0.14 px / √10", color="0.4", va="top", fontsize="small")
    ax.set(xscale="log", xlabel="sweeps, or iterations", ylabel="error b of the star positions, per axis [px]")
    ax.set_ylim(0.03, None)
    ax.legend(fontsize="small", frameon=False)
    return fig


def before_after(solution):
    """Arrows from the mean of each star to its single positions: similarities alone, static part removed, solved."""
    fig, panels = plt.subplots(1, 3, figsize=(11, 4.3), sharex=True, sharey=True, layout="constrained")
    steps = {
        "Shift, rotation and scale only": (aligned(solution), ORANGE),
        "Known static distortion removed": (aligned(solution, static=True), GREEN),
        "Every distortion solved": (by_star(solution, solution.correct), BLUE),
    }
    for ax, (title, (positions, colour)) in zip(panels, steps.items(), strict=True):
        mean = np.nanmean(positions, axis=0)
        away = positions - mean
        start = np.broadcast_to(mean, positions.shape)
        arrows = ax.quiver(
            *start.reshape(-1, 2).T,
            *away.reshape(-1, 2).T,
            angles="xy",
            scale_units="xy",
            scale=1 / MAGNIFIED,
            width=0.0028,
            color=colour,
        )
        ax.quiverkey(arrows, 0.84, 1.03, 1, "1 px", labelpos="E", coordinates="axes")
        ax.set(xlabel="x [px]", aspect="equal")
        rms = np.sqrt(np.nanmean(away**2))
        ax.set_title(f"{title}\n{rms:.3f} px rms per axis", loc="left", fontsize="medium")
    panels[0].set_ylabel("y [px]")
    return fig


def aligned(solution, *, static=False):
    """Positions (n_exposures, n_stars, 2) carried to the reference plane by similarities fitted to them."""
    table = solution.observations.copy()
    if static:
        for name, coefficients in zip(solution.names, solution.prior_mean, strict=True):
            rows = table["exposure"] == name
            xy = np.column_stack([table["x"][rows].value, table["y"][rows].value])
            undistorted = Distortion(coefficients, solution.shapes[name]).invert(xy)
            table["x"][rows], table["y"][rows] = undistorted.T * u.pix
    matches = ld.Matches.from_table(table, shape=solution.shapes)  # estimates the similarities from the positions
    back = {name: similarity.invert(matches.poses[name]) for name in solution.names}
    return by_star(solution, lambda name, xy: similarity.apply(back[name], xy), table=table)


def by_star(solution, to_reference, *, table=None):
    """Used positions (n_exposures, n_stars, 2) in the reference plane, NaN where a star was not used."""
    table = solution.observations if table is None else table
    out = np.full((len(solution.names), len(solution.star_names), 2), np.nan)
    for i, name in enumerate(solution.names):
        rows = table[(table["exposure"] == name) & table["used"]]
        xy = np.column_stack([rows["x"].value, rows["y"].value])
        out[i, np.searchsorted(solution.star_names, rows["star"])] = to_reference(name, xy)
    return out


def stacked(run):
    """The same stars in stacks made with other corrections."""
    solution = run.solution
    matches = ld.Matches.from_table(
        solution.observations, shape=solution.shapes, poses=solution.poses, sky=solution.sky
    )
    comparison = baselines.compare(matches, solution, prior=ld.Prior(solution.prior_mean[0]))
    frames = ld.open_exposures(str(run.out / "frames" / "*.fits"))
    stacks = stack_quality.compare_stacks(frames, comparison, mosaic=run.mosaic, method="clipped")
    return stack_plots.plot_zooms(stacks.zooms)[0, 0].figure


def draw_first_mosaic(run):
    """Pictures of the page "First mosaic"."""
    solution, first = run.solution, run.solution.names[0]
    fig, panels = plt.subplots(1, 2, figsize=(10, 5), layout="constrained")
    solution_plots.plot_residuals(solution, ax=panels[0])
    solution_plots.plot_scatter(solution, ax=panels[1])
    save(fig, "residuals.png")

    fig, panels = plt.subplots(1, 2, figsize=(10, 5), layout="constrained")
    solution_plots.plot_distortion(solution, first, scale=None, ax=panels[0])
    solution_plots.plot_distortion(solution, first, part="dynamic", scale=None, ax=panels[1])
    save(fig, "distortion.png")

    fig, panels = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
    solution_plots.plot_sigma_map(*solution.sigma_map(first), ax=panels[0])
    offset = run.mosaic.offset
    xy = np.column_stack([solution.stars["x"].value, solution.stars["y"].value]) - offset
    stack_plots.plot_mosaic(run.mosaic, stars=xy, ax=panels[1])
    save(fig, "mosaic.png", colours=256)


def noise(frame):
    """Errors of positions against flux for four widths, by stars put into a frame of the night."""
    return ld.calibrate_noise(ld.read_exposures(frame), fwhm=[3.5, 4.5, 5.5, 6.5]).plot().figure


def planned():
    """The map of a planned set of exposures, as on the page that explains it."""
    fig, ax = plt.subplots(figsize=(6.4, 5.2), layout="constrained")
    ld.predict(n_exposures=11, n_stars=80, sigma=0.02, degree=3, dithers=200).plot(ax=ax)
    return fig


def save(fig, name, *, colours=64):
    """Write a figure as a small PNG with a palette."""
    fig.savefig(IMAGES / name, dpi=100, bbox_inches="tight", pad_inches=0.08)
    plt.close(fig)
    image = Image.open(IMAGES / name).convert("RGB")
    image.quantize(colours, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(
        IMAGES / name, optimize=True
    )
    print(f"{name}: {(IMAGES / name).stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
