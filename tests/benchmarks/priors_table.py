"""Figures of docs/few_stars.md: ``python tests/benchmarks/priors_table.py [--seeds 20] [few] [wrong]``.

``few``: errors with widths found from the exposures against fits of fixed degree, which know nothing of the scatter.
``wrong``: what wrong priors cost, and whether chi2 and the departures from the prior mean tell.
"""

import argparse
import warnings

import numpy as np
from scipy.spatial import Delaunay

from legdistort import solve
from legdistort.exceptions import LegdistortError
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.simulation.observations import simulate_matches

#: Standard deviation of the coefficients from exposure to exposure, pixels, ten modes of degree 0 to 3.
SPECTRA = {
    "flat": [0.9] * 10,
    "falling": [0.9] * 3 + [0.3] * 3 + [0.1] * 4,
    "degree 1 only": [0.9] * 3 + [0.0] * 7,
    "zero": [0.0] * 10,
}
#: How the prior is wrong, and the prior.
WRONG = {
    "right": lambda mean, width, sign: Prior(mean, sigma=width),
    "twice too wide": lambda mean, width, sign: Prior(mean, sigma=2 * width),
    "half as wide": lambda mean, width, sign: Prior(mean, sigma=width / 2),
    "mean off by 3 sigma": lambda mean, width, sign: Prior(mean + 3 * width * sign, sigma=width),
    'off by 3 sigma, "evidence"': lambda mean, width, sign: Prior(mean + 3 * width * sign, sigma="evidence"),
    '"evidence"': lambda mean, width, sign: Prior(mean, sigma="evidence"),
    "no widths": lambda mean, width, sign: Prior(mean),
}


def simulate(n_stars, spectrum, seed, **options):
    """Ten exposures whose dynamic distortions are drawn from a spectrum."""
    return simulate_matches(n_stars=n_stars, dynamic=SPECTRA[spectrum], zero_mean=False, seed=seed, **options)


def places(sim):
    """New positions: among the stars, and all over the field."""
    field = sim.truth.grid("exp00", 20)
    return field[Delaunay(sim.truth.positions).find_simplex(field) >= 0], field


def errors(solution, sim, *, noise=0.0):
    """b, similarity removed; scatter of new positions among the stars and over the field."""
    rng = np.random.default_rng(0)
    scatter = [accuracy.new_scatter(solution, sim.truth.distort, xy, noise, rng=rng) for xy in places(sim)]
    b = accuracy.bias(solution.estimate.positions, sim.truth.positions, removed="similarity")
    return np.array([b, *(np.sqrt(np.nanmean(s**2)) for s in scatter)])


def attempt(sim, prior, degree=3):
    """Errors of the solution; infinite where there is none, or it folds."""
    try:
        return errors(solve(sim.matches, degree=degree, prior=prior), sim)
    except LegdistortError:
        return np.full(3, np.inf)


def few_errors(spectrum, n_stars, n_seeds):
    """Mean errors (method, criterion): widths found at degree 3, then fixed degrees 0 to 3; inf where one fails."""
    rows = []
    for seed in range(n_seeds):
        sim = simulate(n_stars, spectrum, seed)
        static = sim.truth.static
        rows.append(
            [attempt(sim, Prior(static, sigma="evidence")), *(attempt(sim, Prior(static), d) for d in range(4))]
        )
    return np.mean(rows, axis=0)


def few(n_seeds):
    """Table: errors against the best fixed degree."""
    print(f"few stars: mean over {n_seeds} seeds, px per axis; new positions without noise of their own")
    print(f"{'spectrum':14s} {'stars':>5s}  {'b':>22s}  {'new, among the stars':>22s}  {'new, whole field':>22s}")
    for spectrum in SPECTRA:
        for n_stars in (6, 10, 15, 30, 80):
            ours, *fixed = few_errors(spectrum, n_stars, n_seeds)
            best = np.argmin(fixed, axis=0)
            cells = [
                f"{e:7.4f} / {fixed[d][k]:7.4f} ({d}) {e / fixed[d][k]:4.2f}"
                for k, (e, d) in enumerate(zip(ours, best, strict=True))
            ]
            print(f"{spectrum:14s} {n_stars:5d}  " + "  ".join(cells), flush=True)


def wrong_row(name, n_stars, n_seeds, **geometry):
    """Mean b and sigma of a prior, chi2 / dof and departure ratio, and the scatter of the latter two over the seeds."""
    rows = []
    for seed in range(n_seeds):
        sim = simulate(n_stars, "falling", seed, **geometry)
        width = np.array(SPECTRA["falling"])
        sign = np.random.default_rng(seed).choice([-1, 1], (2, 10))
        try:
            solution = solve(sim.matches, prior=WRONG[name](sim.truth.static, width, sign))
        except LegdistortError:
            return None
        b, sigma, _ = errors(solution, sim, noise=0.14)
        ratio = solution.diagnostics.departure_ratio
        rows.append([b, sigma, solution.chi2 / solution.dof, np.nan if ratio is None else ratio])
    return np.concatenate([np.mean(rows, axis=0), np.std(rows, axis=0)[2:]])


def wrong(n_seeds):
    """Table: what wrong priors cost."""
    print(f"wrong priors: falling spectrum, 0.14 px of noise, mean over {n_seeds} seeds, px per axis")
    print(
        f"{'stars':>5s} {'exposures':17s} {'prior':28s} {'b':>7s} {'sigma':>7s} {'chi2/dof':>16s} {'departures':>16s}"
    )
    dithers = {"dither": 250}
    rolls = dithers | {"rotations": 36 * np.arange(10)}
    for n_stars, where, geometry in (
        (8, "dithers", dithers),
        (30, "dithers", dithers),
        (30, "dithers and rolls", rolls),
    ):
        for name in WRONG:
            row = wrong_row(name, n_stars, n_seeds, **geometry)
            if row is None:
                print(f"{n_stars:5d} {where:17s} {name:28s} no solution", flush=True)
                continue
            b, sigma, chi2, ratio, s_chi2, s_ratio = row
            tells = f"{chi2:7.2f} +- {s_chi2:5.2f} {ratio:7.2f} +- {s_ratio:5.2f}"
            print(f"{n_stars:5d} {where:17s} {name:28s} {b:7.4f} {sigma:7.4f} {tells}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("tables", nargs="*", help="few, wrong; default both")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for table in (few, wrong):
        if table.__name__ in (arguments.tables or ("few", "wrong")):
            table(arguments.seeds)
