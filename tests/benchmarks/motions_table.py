"""Motions of stars in one solution, and by transforming each exposure and then fitting lines.

``python tests/benchmarks/motions_table.py rivals --sets 10`` compares, on three epochs of four exposures of 300 stars,
rolls of 8 and 2 degrees, proper motions of 0.3 px a year, errors that differ by a factor of ten between stars, one
static distortion of 1 px and 0.3 px a coefficient from exposure to exposure:

- ``solve(motion="proper")``;
- the way of FlyStar and gbdes: a polynomial of the same degree takes every exposure to the list of reference, first
  one exposure, then the positions that the lines through all transformed ones have at its time; then a weighted line
  through the transformed positions of every star. So often as stated. Its errors are those of the lines alone.

Errors of positions and motions are taken after a cubic map of all stars, over those that the solution states. ``auto
--sets 100`` counts how often ``motion="auto"`` is wrong; ``time`` times solutions with and without motions. ``large
--sets 20`` has the sets of `moving_sets`, with large, unequal and precise distortions: chi2 over its degrees of
freedom, relative errors, a cubic map taken off with the weights of the observations, and absolute ones, a similarity
taken off: rms, and their squares over those stated.
"""

import argparse
import logging
import sys
import time
import warnings
from pathlib import Path

import numpy as np

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.results import in_tables

sys.path.insert(0, str(Path(__file__).parents[1]))
import drawn_sets
import moving_sets

EPOCHS = np.repeat([2015.3, 2016.5, 2019.2], 4)
DEGREE = 3
PAIRS = ("x", "y"), ("vx", "vy")


def field(seed, *, n_stars=300, epochs=EPOCHS, sigma=None, motion=0.3, **settings):
    """A simulated set."""
    n = len(epochs)
    if sigma is None:
        sigma = 0.01 * 10 ** np.random.default_rng(seed).uniform(0, 1, n_stars)
    usual = {"static": 1.0, "dynamic": 0.3, "zero_mean": False, "dither": 100, "rotations": np.tile([8.0, 2.0], n // 2)}
    arguments = {"n_stars": n_stars, "n_exposures": n, "sigma": sigma, "motion": motion, "epochs": epochs, "seed": seed}
    return ld.simulate_matches(**arguments | usual | settings)


def powers(xy, degree=DEGREE):
    """Values (n, m) of all powers of positions, about pixel 1024."""
    x, y = (xy / 1024 - 1).T
    return np.stack([x**a * y**b for a in range(degree + 1) for b in range(degree + 1 - a)], axis=1)


def weighted(design, values, errors):
    """Least squares, the rows over their errors."""
    return np.linalg.lstsq(design / errors[:, None], values / errors[:, None], rcond=None)[0]


def lines_through_transformed(matches, epoch, *, rounds):
    """Positions at an epoch, motions and their stated errors by the way of FlyStar, (n_stars, 2) each."""
    obs, years = matches.observations, matches.epochs
    errors, n = np.sqrt(obs.covariance[:, 0]), len(matches.stars)
    first = obs.exposure == 0
    place = np.full((n, 2), np.nan)
    pose = matches.poses[matches.names[0]]
    place[obs.star[first]] = (obs.xy[first] - pose[:, 2]) @ np.linalg.inv(pose[:, :2]).T
    motion = np.zeros((n, 2))
    for _ in range(rounds):
        moved = np.empty_like(obs.xy)
        for i in range(len(years)):
            mine = obs.exposure == i
            target = (place + (years[i] - epoch) * motion)[obs.star[mine]]
            known = np.isfinite(target[:, 0])
            design = powers(obs.xy[mine])
            fit = weighted(design[known], target[known], errors[mine][known])
            moved[mine] = design @ fit
        w, t = errors**-2.0, years[obs.exposure] - epoch
        s0, s1, s2 = (np.bincount(obs.star, w * t**k, n) for k in range(3))
        sums = [np.stack([np.bincount(obs.star, w * t**k * axis, n) for axis in moved.T], axis=1) for k in (0, 1)]
        determinant = (s0 * s2 - s1**2)[:, None]
        place = (s2[:, None] * sums[0] - s1[:, None] * sums[1]) / determinant
        motion = (s0[:, None] * sums[1] - s1[:, None] * sums[0]) / determinant
    stated = np.sqrt(np.stack([s2, s0]) / determinant[:, 0])
    return place, motion, stated


def off(found, true, xy, errors):
    """Rms of errors over those stated, once a cubic map of all stars is taken off."""
    design = powers(xy)
    left = (found - true) - design @ weighted(design, found - true, errors)
    n, m = design.shape
    return np.sqrt(np.mean((left / errors[:, None]) ** 2) * n / (n - m))


def rivals(n_sets):
    """The table of the ways."""
    rows = {}
    for seed in range(n_sets):
        sim = field(seed)
        truth = sim.truth
        solution = ld.solve(sim.matches, motion="proper", clip=None)
        stars, epoch = solution.stars, in_tables.epoch(solution)
        true = truth.positions + (epoch - truth.epoch) * truth.motions
        least = [np.hypot(stars[f"{a}_err"].value, stars[f"{b}_err"].value) / np.sqrt(2) for a, b in PAIRS]
        made = {"one solution": (solution.estimate.positions, solution.estimate.motions.values, least)}
        for rounds in (1, 3, 10):
            name = f"transformed, then lines, {rounds} round{'s' * (rounds > 1)}"
            made[name] = lines_through_transformed(sim.matches, epoch, rounds=rounds)
        for name, (place, motion, stated) in made.items():
            found = (place, true), (motion, truth.motions)
            size, pulls = (
                [off(*pair, truth.positions, errors) for pair, errors in zip(found, each, strict=True)]
                for each in (least, stated)
            )
            rows.setdefault(name, []).append([*size, *pulls])
    print("errors over those of one solution (positions, motions); over the stated ones (positions, motions)")
    for name, values in rows.items():
        print(f"{name:40s}", *(f"{value:6.2f}" for value in np.sqrt(np.mean(np.square(values), axis=0))))


def auto(n_sets):
    """How often the evidence decides wrongly."""
    chosen = {0.0: 0, 1.0: 0}
    for seed in range(n_sets):
        still = field(seed, n_stars=60, sigma=0.05, motion=0.0)
        error = np.median(ld.solve(still.matches, motion="proper", clip=None).stars["vx_err"].value)
        for size in chosen:
            sim = field(seed, n_stars=60, sigma=0.05, motion=size * error)
            chosen[size] += ld.solve(sim.matches, motion="auto", clip=None).settings.motion is not None
    for size, n in chosen.items():
        print(f"motions of {size:g} errors of one: taken as moving in {n} of {n_sets} sets")


def timing(n_sets):
    """Seconds of solutions of 700,000 observations with two and with four unknowns a star, the best of some."""
    sim = field(
        3, n_stars=10000, epochs=np.repeat([2015.3, 2016.5, 2019.2, 2020.1], 25), sigma=0.05, motion=0.0, seen=0.88
    )
    best = {None: np.inf, "proper": np.inf}
    for _ in range(max(n_sets, 2)):
        for motion in best:
            start = time.perf_counter()
            ld.solve(sim.matches, motion=motion)
            best[motion] = min(best[motion], time.perf_counter() - start)
    print(f"{len(sim.matches.table)} observations:", *(f"{k or 'no motion'} {t:.2f} s" for k, t in best.items()))


def large(n_sets):
    """Sets with distortions of any size."""
    heads = "chi2/dof", "x, px", "pull2", "v, px/yr", "pull2", "x abs", "pull2", "v abs", "pull2"
    print(f"{'setting':50s}" + "".join(f"{head:>10s}" for head in heads))
    for row in moving_sets.ROWS:
        chi2, total, count = [], 0.0, 0
        for seed in range(n_sets):
            data, truth, given = moving_sets.drawn(row, seed)
            prior = ld.Prior(truth["static"]) if given else None
            matches = drawn_sets.as_matches(data)
            solution = ld.solve(matches, degree=3, prior=prior, motion="proper", motion_epoch=truth["epoch"], clip=None)
            chi2.append(solution.chi2 / solution.dof)
            parts = moving_sets.relative_squares(solution.stars, data, truth)
            total = total + np.concatenate([parts, moving_sets.absolute_squares(solution.stars, truth)])
            count += 2 * np.count_nonzero(moving_sets.information(data, truth)[:, 0])
        figures = np.stack([np.sqrt(total[:, 0] / count), total[:, 0] / total[:, 1]], axis=1).ravel()
        print(f"{row:50s}" + "".join(f"{each:10.3f}" for each in [np.median(chi2), *figures]), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("rivals", "auto", "time", "large"))
    parser.add_argument("--sets", type=int, default=10)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore", LegdistortWarning)
    {"rivals": rivals, "auto": auto, "time": timing, "large": large}[arguments.what](arguments.sets)
