"""The method as published: its convention to the letter, its scheme, and what it refuses."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort import paper
from legdistort.exceptions import ConvergenceWarning, InputError, SolveError
from legdistort.results import accuracy

SIM = ld.simulate_matches(seed=3)
PRIOR = ld.Prior(SIM.truth.static)


def test_dynamic_parts_sum_to_zero():
    """To the letter, wherever the stars are: not so of `legdistort.solve` with exposures of unequal errors."""
    table = SIM.matches.table.copy()
    for name in ("x_err", "y_err"):
        table[name][table["exposure"] == "exp00"] *= 30
    matches = ld.Matches.from_table(table, shape=SIM.matches.shapes, poses=SIM.matches.poses)
    published, own = paper.solve(matches, prior=PRIOR), ld.solve(matches, prior=PRIOR)
    sums = [np.abs((each.coefficients - SIM.truth.static).sum(axis=0)[:, 1:]).max() for each in (published, own)]
    assert sums[0] < 1e-3 < 0.1 < sums[1]
    assert (published.gauge.kind, published.settings.gauge, published.settings.clip) == ("mean", "mean", None)
    assert published.residuals["used"].all()


def test_both_ways_reach_the_same_minimum():
    """Positions agree with one another and with `legdistort.solve` once the map that the data do not tell is off."""
    joint, own = paper.solve(SIM.matches, prior=PRIOR), ld.solve(SIM.matches, prior=PRIOR)
    with pytest.warns(ConvergenceWarning, match="drift along directions that the data do not determine"):
        published = paper.solve(SIM.matches, prior=PRIOR, method="alternating", max_iterations=60)
    assert published.settings.method == "alternating"
    for other in (published, own):
        assert_allclose(other.chi2, joint.chi2, rtol=2e-4)
        assert accuracy.bias(other.estimate.positions, joint.estimate.positions, removed=3) < 5e-4


def test_of_equal_undithered_exposures_it_is_the_smallest_dynamic_part():
    """Section 5 of the conventions page."""
    for solver in (paper.solve, ld.solve):
        solution = solver(SIM.matches, prior=PRIOR)
        assert np.abs((solution.coefficients - SIM.truth.static).mean(axis=0)).max() < 5e-3


@pytest.mark.slow
def test_nothing_stands_between_the_convention_and_the_data():
    """Of a static distortion of many errors, unknown, the convention costs chi2, which is the paper's price."""
    sim = ld.simulate_matches(seed=1, sigma=0.001, n_stars=100, static=10.0, dither=250.0)
    with warnings.catch_warnings(action="ignore"):
        assert paper.solve(sim.matches).chi2 > 3 * ld.solve(sim.matches).chi2


def test_rolls_that_cancel_are_refused():
    sim = ld.simulate_matches(n_exposures=4, rotations=[0, 90, 180, 270], seed=1)
    ld.solve(sim.matches, prior=ld.Prior(sim.truth.static))
    with pytest.raises(SolveError, match=r"rolls of 0, 90, 180 and 270 degrees; use legdistort\.solve"):
        paper.solve(sim.matches, prior=ld.Prior(sim.truth.static))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "magic"}, "method must be one of 'joint', 'alternating', got 'magic'"),
        ({"degree": "auto"}, "has a degree in numbers, got 'auto'"),
        ({"degree": -1}, "degree must be"),
        ({"prior": ld.Prior(SIM.truth.static, sigma="evidence")}, "finds no scatter of exposures"),
        ({"max_iterations": 0}, "max_iterations must be a positive integer"),
    ],
)
def test_bad_options_are_named(options, words):
    with pytest.raises(InputError, match=words):
        paper.solve(SIM.matches, **options)


def test_what_it_is_not_for_is_refused():
    with pytest.raises(InputError, match="matches must be Matches"):
        paper.solve(SIM.matches.table)
    table = SIM.matches.table.copy()
    table["detector"] = np.where(np.asarray(table["star"]) % 2, "1", "2")
    several = ld.Matches.from_table(table, camera=ld.Camera.gsaoi())
    with pytest.raises(InputError, match=r"is for exposures of one detector, and camera .* has several"):
        paper.solve(several)
