"""The compiled loops against their plain twins."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from legdistort.geometry.distortion import Distortion
from legdistort.priors.prior import Prior
from legdistort.simulation.observations import simulate_matches
from legdistort.solving import start_values
from legdistort.solving.equations import criterion, elimination, reduced_system
from legdistort.solving.equations.problem import build_problem
from legdistort.solving.estimation import solve

RNG = np.random.default_rng(0)


def _set(**settings):
    sim = simulate_matches(
        n_exposures=9, n_stars=300, seen=0.7, dither=100.0, rotations=RNG.uniform(-50, 50, 9), **settings
    )
    # a prior of higher degree than the fit, so that modes that stay fixed are in play
    return sim, Prior(np.pad(sim.truth.static, ((0, 0), (0, 5))) + 0.01)


@pytest.mark.parametrize("threads_from", [0, 30_000])
@pytest.mark.parametrize("settings", [{"sigma": 0.05}, {"sigma": RNG.uniform(0.02, 0.2, (9, 300, 2)), "corr": 0.4}])
def test_compiled_sums_are_the_plain_ones(monkeypatch, settings, threads_from):
    monkeypatch.setattr("legdistort.solving.equations.compiled.THREADS_FROM", threads_from)
    sim, prior = _set(**settings)
    problem = build_problem(sim.matches, 3, prior=prior)
    state, _ = start_values.start(problem, np.stack([sim.matches.poses[name] for name in sim.matches.names]))
    plain = criterion.linearise(problem, state)
    a, y = RNG.normal(size=plain.g_exposure.shape), RNG.normal(size=(2, problem.n_stars))
    sums = elimination.to_stars(problem, plain, a), elimination.to_exposures(problem, plain, y)
    monkeypatch.setattr("legdistort.solving.equations.problem.COMPILED_FROM", 0)
    assert problem.uses_compiled_loops
    fast = criterion.linearise(problem, state)
    for name in ("chi2", "residual", "v", "g_star", "u", "g_exposure", "coupling", "values"):
        expected = getattr(plain, name)
        single = threads_from == 0 and name in ("coupling", "values")  # of many observations
        tolerance = 1e-6 if single else 1e-10
        assert_allclose(getattr(fast, name), expected, atol=tolerance * np.abs(expected).max(), err_msg=name)
    fast_sums = elimination.to_stars(problem, fast, a), elimination.to_exposures(problem, fast, y)
    for mine, expected in zip(fast_sums, sums, strict=True):
        assert_allclose(mine, expected, atol=(1e-10 if threads_from else 1e-6) * np.abs(expected).max())


@pytest.mark.parametrize("direct", [True, False])
def test_compiled_solution_is_the_plain_one(monkeypatch, direct):
    sim, prior = _set(sigma=0.05)
    plain = solve(sim.matches, prior=prior)
    monkeypatch.setattr("legdistort.solving.equations.problem.COMPILED_FROM", 0)
    monkeypatch.setattr(reduced_system, "uses_direct", lambda problem: direct)
    fast = solve(sim.matches, prior=prior)
    assert_allclose(
        fast.estimate.positions, plain.estimate.positions, atol=1e-5
    )  # both stop within 5e-5 standard errors
    assert_allclose(fast.coefficients, plain.coefficients, atol=1e-5)
    assert_allclose(fast.estimate.uncertainty.stars, plain.estimate.uncertainty.stars, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("robust", [True, False])
def test_compiled_start_is_the_plain_one(monkeypatch, robust):
    sim, prior = _set(sigma=0.05, flips=[i in (1, 4) for i in range(9)])
    problem = build_problem(sim.matches, 3, prior=prior)
    nominal = np.stack([sim.matches.poses[name] for name in sim.matches.names])
    nominal[:, :, 2] += RNG.normal(scale=3, size=(9, 2))
    plain, astray = start_values.start(problem, nominal, robust=robust)
    monkeypatch.setattr("legdistort.solving.equations.problem.COMPILED_FROM", 0)
    fast, also_astray = start_values.start(problem, nominal, robust=robust)
    assert_allclose(fast.positions, plain.positions, atol=1e-8)
    assert_allclose(fast.poses, plain.poses, atol=1e-8)
    assert_allclose(also_astray, astray, atol=1e-8)
    assert astray.max() < 5


def test_compiled_inverse_is_the_plain_one(monkeypatch):
    """To a high order it is exact."""
    sim, prior = _set(sigma=0.05)
    problem = build_problem(sim.matches, 3, prior=prior)
    plain = start_values.undistorted(problem, 8)
    monkeypatch.setattr("legdistort.solving.equations.problem.COMPILED_FROM", 0)
    assert_allclose(start_values.undistorted(problem, 8), plain, atol=1e-8)
    first = problem.part(0)
    there = Distortion(problem.prior_mean[0], problem.shapes[0])(plain[:, first].T)
    assert_allclose(there.T, problem.xy[:, first], atol=1e-6)


def test_typical_distances_are_those_of_all_stars(monkeypatch):
    sim, prior = _set(sigma=0.05)
    problem = build_problem(sim.matches, 3, prior=prior)
    nominal = np.stack([sim.matches.poses[name] for name in sim.matches.names])
    of_all = start_values.start(problem, nominal)[1]
    monkeypatch.setattr(start_values, "_ENOUGH", 50)  # of 210
    of_some = start_values.start(problem, nominal)[1]
    assert np.any(of_some != of_all)
    assert_allclose(of_some, of_all, rtol=0.3)
