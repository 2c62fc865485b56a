"""The joint solver over the range of what people observe: degrees, detectors, rolls, mosaics with little overlap."""

import numpy as np
import pytest
from astropy.table import Table, vstack
from oracle import DenseOracle, predict

from legdistort.exceptions import SolveError
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.equations import reduced_system
from legdistort.solving.estimation import solve

RNG = np.random.default_rng


def grid_of_pointings(shifts, *, degree=2, density=40, size=1000, sigma=0.02, seed=0):
    """Exposures shifted over a wide field: matches and true positions."""
    rng = RNG(seed)
    shifts = np.asarray(shifts, dtype=float)
    low, high = shifts.min(axis=0), shifts.max(axis=0) + size
    n = int(density * np.prod((high - low) / size))
    true = rng.uniform(low, high, (n, 2))
    n_modes = (degree + 1) * (degree + 2) // 2
    tables, nominal = [], {}
    for i, shift in enumerate(shifts):
        pose = np.column_stack([np.eye(2), -shift])
        xy = predict(true, rng.normal(0, 0.3, (2, n_modes)), pose, (size, size))
        on = np.flatnonzero(((xy > 0) & (xy < size - 1)).all(axis=1))
        xy = xy[on] + sigma * rng.normal(size=(len(on), 2))
        name = f"p{i:02d}"
        tables.append(Table({"exposure": [name] * len(on), "star": on, "x": xy[:, 0], "y": xy[:, 1],
                             "x_err": np.full(len(on), sigma), "y_err": np.full(len(on), sigma)}))  # fmt: skip
        nominal[name] = pose
    return Matches.from_table(vstack(tables), shape=(size, size), poses=nominal), true


MOSAICS = {
    "4 x 4, half overlap": [(500 * i, 500 * j) for i in range(4) for j in range(4)],
    "chain of 20": [(500 * i, 30 * (i % 3)) for i in range(20)],
}


@pytest.mark.parametrize("mosaic", MOSAICS)
@pytest.mark.parametrize("direct", [True, False])
def test_little_overlap_converges_to_the_minimum(monkeypatch, mosaic, direct):
    """At the solution the criterion, written out independently, is flat along every direction the gauge allows."""
    matches, _ = grid_of_pointings(MOSAICS[mosaic])
    monkeypatch.setattr(reduced_system, "uses_direct", lambda problem: direct)
    solution = solve(matches, degree=2, prior=Prior(np.zeros((2, 6))))
    assert int(solution.status.split()[2]) <= 10
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=5 * np.sqrt(2 / solution.dof))
    oracle = DenseOracle(matches, solution, np.zeros((2, 6)))
    x = np.concatenate([solution.estimate.positions.ravel(), solution.coefficients.ravel()])
    base = np.sum(oracle.residuals(x) ** 2)
    assert base == pytest.approx(solution.chi2, rel=1e-9)
    rows = solution.gauge.orthonormal
    rng = RNG(1)
    for _ in range(10):
        step = rng.normal(size=len(x))
        part = step[2 * oracle.n_stars :]
        part -= rows.T @ (rows @ part)  # stay on the constraints
        step *= 1e-3 / np.abs(step).max()
        up, down = (np.sum(oracle.residuals(x + sign * step) ** 2) for sign in (1, -1))
        curvature = (up + down - 2 * base) / 2
        assert curvature > 0
        # the minimum along this line lies within a thousandth of the standard error along it
        assert abs(up - down) / 4 < 1e-3 * np.sqrt(curvature)


@pytest.mark.parametrize(
    "degree", [*range(5), *(pytest.param(degree, marks=pytest.mark.slow) for degree in range(5, 9))]
)
def test_every_degree_reaches_its_bound(degree):
    """Positions at the Cramer-Rao bound, chi2 at its degrees of freedom, for degrees 0 to 8."""
    spread = 0.5 / np.sqrt(1 + np.arange((degree + 1) * (degree + 2) // 2))
    b, bound, pulls = [], [], []
    for seed in range(4):
        sim = simulate_matches(n_stars=160, n_exposures=6, degree=degree, static=0.5, dynamic=spread, sigma=0.05,
                               dither=80.0, seed=seed)  # fmt: skip
        solution = solve(sim.matches, degree=degree, prior=Prior(sim.truth.static))
        true = sim.truth.positions[solution.estimate.star_names]
        b.append(accuracy.bias(solution.estimate.positions, true, removed=degree))
        bound.append(accuracy.expected_bias(solution, removed=degree))
        pulls.append((solution.chi2 - solution.dof) / np.sqrt(2 * solution.dof))
    assert np.mean(b) / np.mean(bound) == pytest.approx(1, abs=0.06)
    assert abs(np.mean(pulls)) < 2.5


def test_rolled_and_flipped_exposures_of_two_detectors():
    """Two shapes of detector, any roll, flips, stars missing, a static distortion for each detector."""
    rng = RNG(3)
    true = rng.uniform(0, 1000, (90, 2))
    static = {"blue": rng.normal(0, 0.5, (2, 6)), "red": rng.normal(0, 0.5, (2, 6))}
    rows, nominal, shapes = [], {}, {}
    for i in range(8):
        detector, shape = ("blue", (900, 1300)) if i % 2 else ("red", (1200, 800))
        angle, flip = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1])
        linear = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([flip, 1])
        middle = np.array([shape[1] / 2, shape[0] / 2])
        pose = np.column_stack([linear, middle - linear @ [500, 500] + rng.normal(0, 40, 2)])
        xy = predict(true, static[detector] + rng.normal(0, 0.1, (2, 6)), pose, shape)
        on = ((xy > 0) & (xy < np.array(shape[::-1]) - 1)).all(axis=1) & (rng.random(90) < 0.9)
        for j in np.flatnonzero(on):
            rows.append((f"e{i}", detector, j, *(xy[j] + 0.03 * rng.normal(size=2)), 0.03, 0.03))
        nominal[f"e{i}"], shapes[f"e{i}"] = pose, shape
    table = Table(rows=rows, names=["exposure", "detector", "star", "x", "y", "x_err", "y_err"])
    matches = Matches.from_table(table, shape=shapes, poses=nominal)
    prior = {name: Prior(mean) for name, mean in static.items()}
    solution = solve(matches, degree=2, prior=prior)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=4 * np.sqrt(2 / solution.dof))
    b = accuracy.bias(solution.estimate.positions, true[solution.estimate.star_names], removed=2)
    assert b == pytest.approx(accuracy.expected_bias(solution, removed=2), rel=0.25)
    # each detector's own static distortion served its exposures
    departure = np.abs(solution.coefficients - solution.estimate.prior_mean)[:, :, 3:]
    assert departure.mean() < 0.3
    with pytest.raises(SolveError, match="fewer than the 120 modes of degree 14"):
        solve(matches, degree=14, prior=prior)
