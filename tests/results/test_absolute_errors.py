"""Absolute errors against simulated truth made of numpy's polynomials, where they once failed.

All settings are in ``benchmarks/calibration_table.py``.
"""

import calibration_table as table
import dense_model
import numpy as np
import pytest
import relative_errors_table

import legdistort as ld
from legdistort.exceptions import InputError, LegdistortWarning
from legdistort.results import accuracy
from legdistort.results.errors import absolute_errors

pytestmark = pytest.mark.filterwarnings(
    f"ignore::{LegdistortWarning.__module__}.{LegdistortWarning.__qualname__}"  # what is not known is known here
)


def offsets(name, seed=0, **changed):
    """Solution and true positions of a set of the table."""
    simulating, solving = table.settings()[name]
    matches, sky, common = table.simulated(seed, **simulating | changed)
    solution = ld.solve(matches, **solving(matches, sky, common, np.random.default_rng(seed)))
    return solution, sky[solution.estimate.star_names]


def ratio(solution, true):
    """Squared true over reported error after what is unknown."""
    reported = np.einsum("nkk->nk", solution.absolute_covariance(without_unknown=True))
    return np.mean(accuracy.known_offsets(solution, true) ** 2) / np.mean(reported)


def linear(solution, true):
    """Rms of the offsets once a similarity and the unknown directions at the solution are taken off."""
    columns = [table.similarity_fields(true), *(each.stars.T.reshape(-1, 1) for each in solution.gauge.unknown)]
    return np.sqrt(np.mean(table.without((true - solution.estimate.positions).T.ravel(), np.hstack(columns)) ** 2))


@pytest.mark.parametrize("name", ["no prior, no dithers", "static='fit', no rolls"])
def test_unknown_directions_are_taken_off_to_second_order(name):
    """A static distortion of 5 px, unknown: what its directions at the solution leave behind is of second order."""
    sets = [offsets(name, seed=seed, static=5.0, n_exposures=6) for seed in range(1, 7)]
    assert 0.5 < np.mean([ratio(*each) for each in sets]) < 1.5
    solution, true = sets[0]
    left = np.sqrt(np.mean(accuracy.known_offsets(solution, true) ** 2))
    if name == "no prior, no dithers":
        assert linear(solution, true) > 1.3 * left
    fewer = np.where(np.arange(len(true))[:, None] < 40, true, np.nan)
    some = accuracy.known_offsets(solution, fewer)
    assert np.isnan(some[40:]).all()
    assert np.isfinite(some[:40]).all()


@pytest.mark.parametrize("name", ["prior, exact", "no prior, rolls"])
def test_the_error_of_the_common_map_is_what_it_adds_to_stars(name):
    """Degrees of a map whose errors hang together may each be known worse than all of them at the stars."""
    solution, _ = offsets(name, n_exposures=4)
    absolute, relative = (
        np.stack([solution.stars[f"{axis}_err{kind}"].value ** 2 for axis in "xy"]) for kind in ("_abs", "")
    )
    assert solution.gauge.absolute_error == pytest.approx(np.sqrt(np.nanmean(absolute - relative)), rel=0.1)
    apart = np.sqrt(np.nansum([error**2 for *_, error in solution.gauge.absolute_errors()]))
    assert apart > 1.1 * solution.gauge.absolute_error


@pytest.mark.parametrize("departures", [0.0, 0.4])
def test_an_error_of_the_static_distortion_moves_stars_as_it_stands(departures):
    """However little exposures scatter about it: widths hold them together, and nothing holds the plane."""
    simulating, solving = table.settings()["prior with static_sigma, exposures alike"]
    matches, sky, common = table.simulated(1, **simulating | {"n_exposures": 4, "dynamic": departures})
    solution = ld.solve(matches, **solving(matches, sky, common, np.random.default_rng(1)))
    assert (np.max(solution.diagnostics.widths) < 1e-3) == (departures == 0)
    moved = np.sqrt(np.mean(solution.gauge.directions**2, axis=(0, 1)))
    plain = absolute_errors.plain_directions(solution.gauge, solution.estimate.positions, solution.gauge.n_modes)
    assert moved == pytest.approx(np.sqrt(np.mean(plain**2, axis=(0, 1))), rel=0.1)


def test_known_offsets_are_those_after_a_similarity_where_all_is_known():
    solution, true = offsets("prior, exact", n_exposures=4)
    assert solution.gauge.unknown == ()
    expected = accuracy.bias(solution.estimate.positions, true, removed="similarity")
    assert np.sqrt(np.mean(accuracy.known_offsets(solution, true) ** 2)) == pytest.approx(expected)


@pytest.mark.parametrize(("prior", "least"), [pytest.param("none", 1.05, marks=pytest.mark.slow), ("exact", 0.8)])
def test_relative_errors_are_calibrated_after_any_common_map(prior, least):
    """Positions good to 0.003 px; without a prior the solution is pixels off, and a linear map is not enough."""
    after, linear = [], []
    for seed in range(4):
        after.append(relative_errors_table.one(seed, 3, prior, n_exposures=6)[0])
        matches, sky, common = table.simulated(seed, n_stars=150, sigma=0.003, n_exposures=6)
        given = table.as_prior(common, None) if prior == "exact" else None
        solution = ld.solve(matches, prior=given)
        wrong = (solution.estimate.positions - sky[solution.estimate.star_names]).T.ravel()
        directions = solution.gauge.directions.transpose(1, 0, 2).reshape(len(wrong), -1)
        linear.append(relative_errors_table.squared_pull(wrong, solution.estimate.uncertainty.star_matrix, directions))
    assert np.mean(after) == pytest.approx(1, abs=0.15)
    assert least < np.mean(linear) < least + 2


def few_undithered(n_stars, seed, **setting):
    """Solution of few stars that no dithers or rolls move over the detector, without a prior, and their truth."""
    matches, sky, _ = table.simulated(seed, n_exposures=30, n_stars=n_stars, dither=0.0, **setting)
    solution = ld.solve(matches, degree=3)
    return solution, sky[solution.estimate.star_names]


@pytest.mark.slow
def test_relative_errors_of_few_stars_are_those_after_what_nothing_determines():
    squares = np.zeros(2)
    for seed in range(8):
        solution, true = few_undithered(23, seed, static=0.3, dynamic=0.3)
        if "degree 3" not in solution.gauge.unknown_names:  # a map of degree 2 is taken off then
            continue
        design, off = dense_model.basis(true, 3, table.SIZE)[0], solution.estimate.positions - true
        squares += np.sum((off - design @ np.linalg.lstsq(design, off)[0]) ** 2), 0
        squares[1] += sum(np.sum(solution.stars[name].value ** 2) for name in ("x_err", "y_err"))
    assert squares[0] / squares[1] == pytest.approx(1, abs=0.3)


def test_as_many_stars_as_unknown_modes_have_no_relative_errors():
    solution, *_ = few_undithered(10, 4)
    assert not np.isfinite(solution.stars["x_err"]).any()


def test_known_offsets_refuse_what_they_cannot_do(tmp_path):
    solution, true = offsets("no prior, no dithers", n_exposures=4)
    with pytest.raises(InputError, match=r"one row for each of the 70 stars, got shape \(3, 2\)"):
        accuracy.known_offsets(solution, true[:3])
    with pytest.raises(InputError, match="20 directions cannot be taken off the offsets of 10 stars"):
        accuracy.known_offsets(solution, np.where(np.arange(len(true))[:, None] < 10, true, np.nan))
    solution.write(tmp_path / "solution.asdf")
    for compare in (accuracy.known_offsets, accuracy.relative_offsets):
        with pytest.raises(InputError, match="read from a file keeps no equations; call solve again"):
            compare(ld.Solution.read(tmp_path / "solution.asdf"), true)


@pytest.mark.parametrize("seed", [0, 1])
def test_constraints_follow_the_state_to_the_solution(seed):
    """Held after two iterations, they cost 16 and 21."""
    solution, _ = offsets("no prior, no dithers", seed, n_exposures=4)
    assert int(solution.status.split()[2]) <= 10


def test_constraints_do_not_follow_the_state_away():
    """Twelve stars for twenty modes of the plane: constraints that never stop would take this set pixels off."""
    simulating, solving = table.settings()["12 reference stars"]
    true, reported, *_, status = table.one(46, simulating | {"n_exposures": 4}, solving)
    assert "not converged" not in status
    assert true < 9 * reported


@pytest.mark.parametrize(
    ("name", "n_exposures", "n_sets", "tolerance"),
    [
        pytest.param("no prior, no dithers", 11, 8, 0.25, marks=pytest.mark.slow),
        pytest.param("no prior, no dithers", 11, 30, 0.15, marks=pytest.mark.sets),
        pytest.param("static='fit', no rolls", 11, 30, 0.15, marks=pytest.mark.slow),
        pytest.param("no prior, rolls", 4, 20, 0.45, marks=pytest.mark.slow),
        pytest.param("no prior, rolls", 4, 60, 0.25, marks=pytest.mark.sets),
        pytest.param("prior with static_sigma, exposures alike", 4, 80, 0.4, marks=pytest.mark.sets),
    ],
)
def test_absolute_errors_are_calibrated(name, n_exposures, n_sets, tolerance):
    """Standard errors of the ratios: 0.06, 0.03, 0.14, 0.19, 0.1 and 0.13."""
    assert table.row(name, n_sets, n_exposures=n_exposures).ratio == pytest.approx(1, abs=tolerance)


def test_wrong_models_are_outside_of_the_errors():
    """Exposures that do not share their distortion, and errors stated at a third of what they are."""
    solution, true = offsets("static='fit', no rolls", dynamic=0.4)
    assert ratio(solution, true) > 25
    assert solution.chi2 > 25 * solution.dof
    matches, sky, _ = table.simulated(0, dither=0.0)
    wrong = matches.table.copy()
    wrong["x_err"], wrong["y_err"] = wrong["x_err"] / 3, wrong["y_err"] / 3
    solution = ld.solve(ld.Matches.from_table(wrong, shape=(table.SIZE, table.SIZE), poses=matches.poses))
    assert 5 < ratio(solution, sky[solution.estimate.star_names]) < 13
