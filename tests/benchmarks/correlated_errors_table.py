"""Systematic errors in the positions: true against reported errors of stars, and what is found where there are none.

``python tests/benchmarks/correlated_errors_table.py systematics --sets 10``, ``... clean --sets 200``, and
``... frames`` for the real frames (``LEGDISTORT_DATA``). Positions and systematic errors are made by numpy alone. True
errors are those left by a common map of the fitted degree, of the brightest third of the stars: least noise.
"""

import argparse
import logging
import os
import warnings
from pathlib import Path

import numpy as np
from astropy import units as u
from calibration_table import SIZE, simulated, without
from checks_table import limits

import legdistort as ld
from legdistort.exceptions import LegdistortWarning

SIZE_OF_ERRORS = 0.01  # px rms per axis, of the systematic ones
NOISE = 0.003, 0.03  # px, of the brightest and the faintest star
ERRORS = "stated", "floor", "correlated"


def by_time(correlation, *, smooth=False):
    """Errors of every star that wander with a correlation time of so many exposures, exponential or Gaussian."""

    def displaced(rng, star, exposure, x, y):
        n = exposure.max() + 1
        lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / correlation
        matrix = np.exp(-(lag**2) / 2) if smooth else np.exp(-lag)
        values, vectors = np.linalg.eigh(matrix)
        drawn = rng.normal(size=(2, star.max() + 1, n)) @ (vectors * np.sqrt(np.maximum(values, 0))).T
        return drawn[:, star, exposure]

    return displaced


def trails(rng, star, exposure, x, y):
    """Charge left behind on the way to the register at x = 0: along x, more of it for some stars than for others."""
    share = rng.uniform(0, 1, star.max() + 1)
    return np.stack([share[star] * x, np.zeros(len(x))])


def phase(rng, star, exposure, x, y):
    """An error that goes with the place of the star on its pixel."""
    return np.stack([np.sin(2 * np.pi * x), np.sin(2 * np.pi * y)])


def constant(rng, star, exposure, x, y):
    """The same in all exposures."""
    return rng.normal(size=(2, star.max() + 1))[:, star]


#: Systematic errors and the dithers [px] with which they are looked at; "drift" is a slow one, as of bad tracking.
KINDS = {
    "none": (None, 50.0),
    "correlated over 2 exposures": (by_time(2), 50.0),
    "correlated over 6 exposures": (by_time(6), 50.0),
    "correlated over 24 exposures": (by_time(24), 50.0),
    "smooth over 6 exposures": (by_time(6, smooth=True), 50.0),
    "trails along x": (trails, 300.0),
    "pixel phase, random dithers": (phase, 50.0),
    "pixel phase, slow drift": (phase, "drift"),
    "the same in all exposures": (constant, 50.0),
}


def made(kind, seed, *, n_exposures=48, n_stars=100):
    """Matches with the systematic errors of a kind, and the true positions by star."""
    systematic, dither = KINDS[kind]
    matches, sky, _ = simulated(
        seed, n_exposures=n_exposures, n_stars=n_stars, dither=0.0 if dither == "drift" else dither, sigma=1e-6,
        static=0.02, dynamic=0.02,
    )  # fmt: skip
    rng = np.random.default_rng(1_000_000 + seed)
    table, poses = matches.table.copy(), dict(matches.poses)
    names, exposure = np.unique(table["exposure"], return_inverse=True)
    star = np.asarray(table["star"])
    if dither == "drift":  # 0.04 px from exposure to exposure, and a slow change of direction
        for k, axis in enumerate("xy"):
            moved = 0.04 * np.arange(len(names)) * (1.0, 0.5)[k]
            table[axis] += moved[exposure] * u.pix
            poses = {n: p + np.eye(3)[2] * np.eye(2)[k][:, None] * moved[i] for i, (n, p) in enumerate(poses.items())}
    if systematic is not None:
        error = systematic(rng, star, exposure, table["x"].value, table["y"].value)
        error -= error.mean(axis=1, keepdims=True)
        error *= SIZE_OF_ERRORS / np.sqrt(np.mean(error[0] ** 2))
        table["x"] += error[0] * u.pix
        table["y"] += error[1] * u.pix
    sigma = np.exp(rng.uniform(*np.log(NOISE), star.max() + 1))[star]
    for axis in "xy":
        table[axis] += rng.normal(0, sigma) * u.pix
        table[f"{axis}_err"] = sigma * u.pix
    return ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses), sky


def solved(matches, errors):
    """The solution; what is said of it is not what is looked at."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)
        return ld.solve(matches, degree=3, errors=errors)


def bright(table, faintest=1 / 3):
    """Whether stars are among the brightest part, by their stated errors."""
    return table <= np.nanquantile(table, faintest)


def cubic(xy):
    """The maps (n, 10) of a common cubic."""
    x, y = (xy / SIZE).T
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def pulls(solution, sky):
    """Squares of true errors (n, 2) once a common cubic is taken off, those reported, and which stars are bright.

    The cubic is weighted by the errors of the measurement, and taken off the covariance of all stars too: what is left
    of that are errors without those of any convention.
    """
    stars, true, n = solution.stars, sky[solution.estimate.star_names], len(solution.estimate.star_names)
    offset = np.stack([stars["x"].value, stars["y"].value], axis=1) - true
    index = np.searchsorted(solution.estimate.star_names, solution.residuals["star"])
    sigma = np.bincount(index, solution.residuals["x_err"].value) / np.bincount(index)
    maps = np.linalg.qr(cubic(true) / sigma[:, None])[0]
    project = (np.eye(n) - maps @ maps.T) * sigma[:, None] / sigma
    blocks = [solution.estimate.uncertainty.star_matrix[first : first + n, first : first + n] for first in (0, n)]
    reported = np.stack([np.einsum("jk,kl,jl->j", project, block, project, optimize=True) for block in blocks], axis=1)
    return (project @ offset) ** 2, reported, bright(sigma)


def systematics(n_sets):
    """Print true over reported errors by kind and treatment of errors."""
    print(
        f"{'systematic errors':30s} {'found':>6s} " + " ".join(f"{name:>11s}" for name in ERRORS) + "  (words of one)"
    )
    for kind in KINDS:
        ratio, found, words = {name: [] for name in ERRORS}, 0, ""
        for seed in range(n_sets):
            matches, sky = made(kind, seed)
            for errors in ERRORS:
                solution = solved(matches, errors)
                true, reported, which = pulls(solution, sky)
                ratio[errors].append((true[which].mean(), reported[which].mean()))
            correlated = solution.diagnostics.correlated
            found += correlated.along is not None
            words = str(correlated).partition(";")[0]
        values = [np.sqrt(np.divide(*np.mean(ratio[name], axis=0))) for name in ERRORS]
        print(f"{kind:30s} {found:3d}/{n_sets:<3d}" + " ".join(f"{v:11.2f}" for v in values) + f"  {words}", flush=True)


def clean(n_sets):
    """Print in how many sets without systematic errors some are found, and by how much errors grow."""
    found, growth, beyond_floor, rng = 0, [], [], np.random.default_rng(0)
    for seed in range(n_sets):
        n = int(np.exp(rng.uniform(np.log(8), np.log(48.99))))
        matches, _ = made("none", seed, n_exposures=n, n_stars=int(np.exp(rng.uniform(np.log(55), np.log(300)))))
        errors = {name: solved(matches, name) for name in ERRORS}
        found += errors["correlated"].diagnostics.correlated.along is not None
        size = {name: np.mean(solution.stars["x_err"].value ** 2) ** 0.5 for name, solution in errors.items()}
        growth.append(size["correlated"] / size["stated"])
        beyond_floor.append(size["correlated"] / size["floor"])
    print(f"{n_sets} clean sets: found in {found} (upper 95 % limit {100 * limits(found, n_sets):.1f} %)")
    print(f"x_err grows by {np.mean(growth) - 1:.2%} over stated errors, {np.mean(beyond_floor) - 1:.2%} over a floor")


def frames():
    """The real frames, and their halves in time and interleaved solved apart."""
    folder = Path(os.environ.get("LEGDISTORT_DATA", "../shared/data")) / "microobs_hatp32" / "frames"
    exposures = ld.read_exposures(sorted(folder.glob("*.fits.gz")))
    matches = ld.match(ld.measure(exposures), exposures=exposures)
    for errors in ERRORS:
        solution = solved(matches, errors)
        print(f"{errors}: x_err of the brightest sixth {np.nanmedian(_brightest(solution)):.4f} px", flush=True)
        if (correlated := solution.diagnostics.correlated) is not None:
            print(f"  {correlated}")
            halves(matches, solution, correlated)


def _brightest(solution):
    stars = solution.stars
    return stars["x_err"].value[bright(-stars["flux"].value, 1 / 6)]


def halves(matches, whole, correlated):
    """Differences between halves of the set, in units of their errors by each account."""
    names = list(matches.names)
    n = len(names)
    for label, first in (("first and second half", names[: n // 2]), ("interleaved", names[::2])):
        parts = []
        for chosen in (first, [name for name in names if name not in first]):
            rest = dict.fromkeys([name for name in names if name not in chosen], "other half")
            parts.append(solved(matches.without(rest), "floor"))
        common = np.intersect1d(
            *[part.estimate.star_names[np.isfinite(part.estimate.positions[:, 0])] for part in parts]
        )
        index = [np.searchsorted(part.estimate.star_names, common) for part in parts]
        flux = parts[0].stars["flux"].value[index[0]]
        a, b = (part.estimate.positions[i] for part, i in zip(parts, index, strict=True))
        for name, extra in (("floor", 0.0), ("correlated", 1.0)):
            squares = []
            for k, axis in enumerate("xy"):
                variance = sum(part.stars[f"{axis}_err"].value[i] ** 2 for part, i in zip(parts, index, strict=True))
                if extra:
                    variance = variance + _between(matches, parts, common, correlated, axis)
                weight = 1 / np.sqrt(variance)
                maps = cubic(a) * weight[:, None]
                hat = np.sum(np.linalg.qr(maps)[0] ** 2, axis=1)
                left = without((a - b)[:, k] * weight, maps)
                squares.append(left**2 / np.maximum(1 - hat, 0.05))
            square = np.mean(squares, axis=0)
            print(
                f"  {label}, {name}: chi2/2n {np.mean(square):.2f}, of the brightest sixth "
                f"{np.mean(square[bright(-flux, 1 / 6)]):.2f}, {len(common)} stars",
                flush=True,
            )


def _between(matches, parts, common, correlated, axis):
    """Variance that correlated errors add to the difference of halves, by dense matrices star by star."""
    if correlated.along is None:
        return 0.0
    size, along = getattr(correlated, axis), correlated.along
    times = dict(zip(matches.names, matches.times[0], strict=True))
    out = np.empty(len(common))
    for j, star in enumerate(common):
        place, part, floors = [], [], []
        for sign, solution in zip((1, -1), parts, strict=True):
            rows = solution.residuals[(solution.residuals["star"] == star) & solution.residuals["used"]]
            floor = solution.diagnostics.error_floor
            weight = 1 / (rows["x_err"].value ** 2 + floor**2)
            part.append(sign * weight / weight.sum())
            floors.append(np.full(len(rows), floor**2))
            place.append([times[name] for name in rows["exposure"]] if along == "time" else rows[along].value)
        place, part, floors = map(np.concatenate, (place, part, floors))
        matrix = size**2 * correlated.correlation(np.subtract.outer(place, place))
        out[j] = part @ (matrix - np.diag(floors - correlated.floor**2)) @ part
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("systematics", "clean", "frames"))
    parser.add_argument("--sets", type=int, default=10)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    if arguments.what == "frames":
        frames()
    else:
        {"systematics": systematics, "clean": clean}[arguments.what](arguments.sets)
