"""Make the pictures of the README and the documentation: ``python docs/make_figures.py`` (about a minute).

Everything is seeded and goes through the public functions, so the pictures show what a user gets.
"""

import shutil
import tempfile
import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import legdistort as ld
from legdistort import paper
from legdistort.assessment import baselines, stack_quality
from legdistort.demo import run_demo
from legdistort.plots import solution_plots, stack_plots
from legdistort.plots.residual_plots import plot_steps
from legdistort.results import accuracy
from legdistort.solving import minimisers, start_values
from legdistort.solving.equations.problem import build_problem

IMAGES = Path(__file__).parent / "images"
BLUE, ORANGE = "#0072B2", "#D55E00"


def main():
    """Run both demonstrations and draw."""
    IMAGES.mkdir(exist_ok=True)
    save(sweeps(), "sweeps.png")
    save(planned(), "planning.png", colours=256)
    save(ld.Camera.gsaoi().plot().figure, "gsaoi_camera.png")
    with tempfile.TemporaryDirectory() as folder:
        night = run_demo(out=Path(folder) / "night")
        save(plot_steps(night.solution, registered=False)[0].figure, "before_after.png", colours=256)
        save_report(night.out / "report.html")
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
            ("alternating", paper.alternate, n_sweeps),
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


def stacked(run):
    """The same stars in stacks made with other corrections."""
    solution = run.solution
    shapes = {view.name: view.shape for view in solution}
    matches = ld.Matches.from_table(solution.residuals, shape=shapes, poses=solution.poses, sky=solution.sky)
    comparison = baselines.compare(matches, solution, prior=ld.Prior(solution[solution.names[0]].prior_mean))
    frames = ld.open_exposures(str(run.out / "frames" / "*.fits"))
    stacks = stack_quality.compare_stacks(frames, comparison, mosaic=run.mosaic, method="clipped")
    return stack_plots.plot_zooms(stacks.zooms)[0, 0].figure


def draw_first_mosaic(run):
    """Pictures of the page "First mosaic"."""
    solution, first = run.solution, run.solution.names[0]
    fig, panels = plt.subplots(1, 2, figsize=(10, 5), layout="constrained")
    solution[first].plot_residuals(ax=panels[0])
    solution_plots.plot_scatter(solution, ax=panels[1])
    save(fig, "residuals.png")

    fig, panels = plt.subplots(1, 2, figsize=(10, 5), layout="constrained")
    solution_plots.plot_distortion(solution, first, scale=None, ax=panels[0])
    solution_plots.plot_distortion(solution, first, part="dynamic", scale=None, ax=panels[1])
    save(fig, "distortion.png")

    fig, panels = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
    solution_plots.plot_sigma_map(*solution[first].sigma_map(), ax=panels[0])
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


def save_report(path, *, width=1100, height=1500):
    """The top of a report as a browser shows it: report.png, where Playwright and Chromium are installed."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": width, "height": height})
        tab.goto(Path(path).absolute().as_uri())
        tab.screenshot(path=IMAGES / "report.png")
        browser.close()
    shrink("report.png", 256, Image.Quantize.MAXCOVERAGE)


def save(fig, name, *, colours=64):
    """Write a figure as a small PNG with a palette."""
    fig.savefig(IMAGES / name, dpi=100, bbox_inches="tight", pad_inches=0.08)
    plt.close(fig)
    shrink(name, colours)


def shrink(name, colours, method=Image.Quantize.MEDIANCUT):
    """Give a PNG a palette."""
    image = Image.open(IMAGES / name).convert("RGB")
    image.quantize(colours, method=method, dither=Image.Dither.NONE).save(IMAGES / name, optimize=True)
    print(f"{name}: {(IMAGES / name).stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
