"""Two visits of stars that all move, with a reference: shared static distortions, widths that are zero, motions."""

import numpy as np
import pytest
from two_visits import truth_at, visits

import legdistort as ld
from legdistort.results import in_tables

HOW = {"degree": 3, "static": "fit", "prior": ld.Prior(None, sigma="evidence"), "motion": "proper"}


def squared_pulls(made, solution):
    """Mean squares of x, y, vx, vy less the truth in absolute errors, of the stars of both visits."""
    xy, v = truth_at(made, solution.stars["star"], in_tables.epoch(solution))
    both, names = np.asarray(solution.stars["n_epochs"]) == 2, ("x", "y", "vx", "vy")
    off = np.stack([solution.stars[name].value for name in names]) - np.concatenate([xy.T, v.T])
    errors = np.stack([solution.stars[f"{name}_err_abs"].value for name in names])
    return np.mean((off / errors)[:, both] ** 2, axis=1)


def test_the_tie_leaves_the_minimum():
    """The widths of exposures are about a static distortion that moves along with the map that the reference gives."""
    made = visits(1)
    free, tied = (ld.solve(made.matches, **HOW, **known) for known in ({}, {"reference": made.reference}))
    assert "not settled" not in tied.status
    more = tied.dof - free.dof  # of the stars that the reference holds
    assert tied.chi2 - free.chi2 < more + 5 * np.sqrt(2 * more)
    assert tied.chi2 / tied.dof == pytest.approx(1, abs=0.15)
    assert np.all(squared_pulls(made, tied) < 1.6)
    assert np.nanmedian(tied.stars["x_err"].value) == pytest.approx(0.0046, rel=0.1)


@pytest.mark.slow
def test_stars_of_one_visit_leave_the_errors_of_others_alone():
    """Where these are at the epoch of the positions is not known to thousands of pixels, of whatever all share."""
    made = visits(1)
    alone = ld.solve(made.matches, **HOW)
    both = alone.stars["n_epochs"] == 2
    kept = np.isin(made.matches.table["star"], alone.stars["star"][both])
    assert not kept.all()
    matches = ld.Matches.from_table(made.matches.table[kept], camera=made.matches.camera, poses=made.matches.poses)
    without = ld.solve(matches, **HOW)
    ratio = alone.stars["x_err"].value[both] / without.stars["x_err"].value
    assert np.median(ratio) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("n_stars", "sigma"), [(150, 0.01), (60, 0.001)])
def test_absolute_errors_hold(n_stars, sigma):
    """Positions share the error of a few modes, so that a single set tells little: ten."""
    sets = [visits(seed, n_stars=n_stars, sigma=sigma) for seed in range(10)]
    found = [squared_pulls(made, ld.solve(made.matches, **HOW, reference=made.reference)) for made in sets]
    place, rate = np.sqrt(np.mean(found, axis=0).reshape(2, 2).mean(axis=1))
    assert 0.8 < place < 1.15
    assert 0.9 < rate < 1.1


def check_of(solution, name):
    return next(check for check in solution.checks if check.name == name)


@pytest.mark.slow
def test_a_motion_of_all_stars_is_told_by_the_reference():
    """Poses take it up, and residuals do not show it; the motions of the reference do, and fitting them is the cure."""
    still = {**HOW, "motion": None}
    made = visits(1, common=(0.06, -0.08), scatter=0.0, sigma=0.01)
    check = check_of(ld.solve(made.matches, **still, reference=made.reference), "time")
    assert check.state == "fail"
    assert check.value == pytest.approx(0.1 * 0.54, rel=0.05)
    assert "move in common by 0.054 px from the first exposure to the last" in check.sentence
    assert check.cure == "fit the motions of the stars: --motion proper"
    assert "time" not in {each.name for each in ld.solve(made.matches, **HOW, reference=made.reference).checks}
    rest = visits(1, common=(0.0, 0.0), scatter=0.0)
    assert check_of(ld.solve(rest.matches, **still, reference=rest.reference), "time").state == "pass"
