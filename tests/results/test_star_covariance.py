"""Covariances between stars of a solution that was read: those of the fresh one, or a refusal in words."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table
from numpy.testing import assert_allclose

from legdistort.exceptions import InputError
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.results.errors.star_covariance import star_matrix
from legdistort.results.solution import Solution
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve

SIM = simulate_matches(
    n_stars=30, n_exposures=4, degree=2, shape=(900, 1400), dither=100, rotations=[0, 20, 40, 90], sigma=0.05, corr=0.4,
    zero_mean=False, seed=3,
)  # fmt: skip
WIDE = Prior(SIM.truth.static, sigma=0.5, static_sigma=0.1)
CATALOGUE = Table({"star": np.arange(12), "x": SIM.truth.positions[:12, 0], "y": SIM.truth.positions[:12, 1]})
CATALOGUE["x_err"] = CATALOGUE["y_err"] = 0.02


def wrong():
    """The same with one gross error and a star whose observations contradict one another."""
    table = SIM.matches.table.copy()
    table["x"][7] += 3 * u.pix
    rows = np.flatnonzero(table["star"] == table["star"][20])
    table["y"][rows] += np.array([0, 20, 50, 90])[: len(rows)] * u.pix
    return Matches.from_table(table, shape=(900, 1400), poses=SIM.matches.poses)


def read_back(solution, path):
    return Solution.read(solution.write(path / "solution.asdf"))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"prior": WIDE},
        {"prior": Prior(SIM.truth.static, sigma="evidence")},
        {"error_floor": 0.05},
        {"errors": "scale"},
        {"static": "fit"},
        {"degree": 0},
        {"reference": CATALOGUE},
        {"reference": CATALOGUE, "errors": "scale"},
    ],
    ids=str,
)
def test_read_is_as_fresh(tmp_path, options):
    fresh = solve(SIM.matches, **{"degree": 2} | options)
    back = read_back(fresh, tmp_path)
    for removed in (None, "similarity", 2):
        for absolute in (False, True):
            expected = accuracy.expected_bias(fresh, removed=removed, absolute=absolute)
            assert accuracy.expected_bias(back, removed=removed, absolute=absolute) == pytest.approx(expected, rel=1e-6)
    full = fresh.estimate.uncertainty.star_matrix
    assert_allclose(star_matrix(back), full, atol=1e-6 * np.max(np.abs(full)))


@pytest.mark.filterwarnings("ignore:1 star has no position")
def test_what_was_left_out_does_not_count(tmp_path):
    fresh = solve(wrong(), degree=2)
    assert np.isnan(fresh.estimate.positions).any()
    assert not fresh.residuals["used"][7]
    expected = accuracy.expected_bias(fresh, removed=2)
    assert accuracy.expected_bias(read_back(fresh, tmp_path), removed=2) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_what_is_not_in_the_table_is_refused(tmp_path):
    fresh = solve(SIM.matches, degree=2, loss="cauchy")
    back = read_back(fresh, tmp_path)
    with pytest.raises(InputError, match=r"do not follow from its residuals where a robust loss, .*; call solve again"):
        accuracy.expected_bias(back, removed=2)
    # that of every star by itself is in the file
    assert accuracy.expected_bias(back) == pytest.approx(accuracy.expected_bias(fresh), rel=1e-6)
