"""A reference catalogue is what is known of its stars, and of common maps: calibrated, and a poor one blurs nothing."""

import json
import logging
import re
import warnings
from dataclasses import replace

import dense_model
import drawn_sets
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time
from caller_warnings import warns_here
from numpy.testing import assert_allclose

from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry.epochs import mean_epoch, year
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.references.catalogue import read_reference
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.results import accuracy, in_tables
from legdistort.results.solution import Solution
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving import reference_tie
from legdistort.solving.estimation import solve

RNG = np.random.default_rng


def simulate(seed=1, **settings):
    """Dynamic parts whose mean does not vanish: 0.4 px of a common map that no exposure shows."""
    usual = {"zero_mean": False, "dither": 100.0, "sigma": 0.05, "n_stars": 60, "n_exposures": 6}
    return simulate_matches(seed=seed, **(usual | settings))


def planar(sim, n, error, *, seed=0, stated=None, named=True):
    """A reference in the reference plane: the truth of n stars with errors."""
    rng = RNG([seed, 7])
    rows = rng.permutation(len(sim.truth.positions))[:n]
    xy = sim.truth.positions[rows] + error * rng.normal(size=(n, 2))
    table = Table({"star": rows, "x": xy[:, 0], "y": xy[:, 1]})
    table["x_err"] = table["y_err"] = float(error if stated is None else stated)
    if not named:
        table.remove_column("star")
    return table


def gaia(sim, *, error=0.5, years=5.0, motion=5.0, seed=0):
    """A catalogue with the columns of Gaia, of an epoch `years` before the exposures of 2021."""
    rng, n = RNG([seed, 8]), len(sim.truth.positions)
    sky = sim.truth.sky.to_sky(sim.truth.positions)
    pm = motion * rng.normal(size=(n, 2))
    off = (error * rng.normal(size=(n, 2)) - years * pm) / 3.6e6
    table = Table({"source_id": 10**18 + np.arange(n), "ra": sky.ra.deg + off[:, 0] / np.cos(sky.dec.rad)})
    table["dec"] = sky.dec.deg + off[:, 1]
    table["ra_error"] = table["dec_error"] = float(error)
    table["pmra"], table["pmdec"] = pm.T
    table["pmra_error"] = table["pmdec_error"] = 0.01
    table["ref_epoch"] = 2021.0 - years
    return table


def truth(sim, solution):
    return sim.truth.positions[solution.estimate.star_names]


def pulls(sim, solution):
    """Absolute errors, nothing taken out, over those reported (n_stars, 2)."""
    stars = solution.stars
    reported = np.column_stack([stars[name].value for name in ("x_err_abs", "y_err_abs")])
    return (solution.estimate.positions - truth(sim, solution)) / reported


def separation(sim, solution):
    """Distances (n_stars,) on the sky from the truth, mas."""
    true = sim.truth.sky.to_sky(truth(sim, solution))
    return solution.sky.to_sky(solution.estimate.positions).separation(true).to_value("mas")


@pytest.fixture(scope="module")
def sim():
    return simulate()


@pytest.fixture(scope="module")
def night():
    return simulate_gsaoi_matches(small=True, seed=4)


@pytest.fixture(scope="module")
def tied(night):
    return solve(night.matches, prior=Prior(night.truth.static), reference=gaia(night), epoch=2021.0)


# --- errors ------------------------------------------------------------------------------------------------------


def test_absolute_positions_become_as_good_as_relative_ones(sim):
    prior = Prior(sim.truth.static)
    before = solve(sim.matches, prior=prior)
    after = solve(sim.matches, prior=prior, reference=planar(sim, 60, 0.02))
    assert accuracy.bias(before.estimate.positions, truth(sim, before)) > 0.2
    assert accuracy.bias(after.estimate.positions, truth(sim, after)) < 0.025
    assert np.mean(pulls(sim, after) ** 2) == pytest.approx(1, abs=0.35)
    both = 1 / (1 / before.estimate.uncertainty.stars[:2] + 0.02**-2)  # of the exposures and of the catalogue
    assert_allclose(after.estimate.uncertainty.stars[:2], both, rtol=0.04)
    assert np.all(after.stars["x_err"] < before.stars["x_err"])
    assert after.chi2 / after.dof == pytest.approx(before.chi2 / before.dof, abs=0.05)


@pytest.mark.parametrize(
    ("n", "error", "settings", "n_sets"),
    [
        pytest.param(60, 0.02, {}, 15, marks=pytest.mark.slow),
        pytest.param(60, 0.02, {}, 60, marks=pytest.mark.sets),
        pytest.param(30, 0.001, {}, 60, marks=pytest.mark.sets),
        pytest.param(15, 0.05, {}, 60, marks=pytest.mark.sets),
        pytest.param(4, 0.05, {}, 15, marks=pytest.mark.slow),
        pytest.param(4, 0.05, {}, 60, marks=pytest.mark.sets),
        pytest.param(40, 0.02, {"degree": 1}, 60, marks=pytest.mark.sets),
        pytest.param(40, 0.02, {"degree": 0, "dynamic": 0.0, "static": 0.0}, 60, marks=pytest.mark.sets),
    ],
)
def test_absolute_errors_are_calibrated(n, error, settings, n_sets):
    """chi2 of the absolute error under the reported one, over 60 realisations, is 1 within 15 %."""
    squares = []
    for seed in range(n_sets):
        sim = simulate(seed, n_exposures=10, **settings)
        reference = planar(sim, n, error, seed=seed)
        solution = solve(
            sim.matches, degree=settings.get("degree", 3), prior=Prior(sim.truth.static), reference=reference
        )
        squares.append(np.mean(pulls(sim, solution) ** 2))
    assert np.mean(squares) == pytest.approx(1, abs=0.15 * np.sqrt(60 / n_sets))


@pytest.mark.parametrize(
    ("static", "n_sets"),
    [
        pytest.param(0.5, 10, marks=pytest.mark.slow),
        pytest.param(0.5, 40, marks=pytest.mark.sets),
        pytest.param(1.5, 40, marks=pytest.mark.sets),
    ],
)
def test_errors_are_calibrated_under_a_static_distortion_that_nobody_told(static, n_sets):
    squares = []
    for seed in range(n_sets):
        sim = simulate(seed, n_exposures=10, static=static)
        solution = solve(sim.matches, reference=planar(sim, 50, 0.02, seed=seed))
        squares.append(np.mean(pulls(sim, solution) ** 2))
    assert np.mean(squares) == pytest.approx(1, abs=0.15 * np.sqrt(40 / n_sets))


def test_a_poor_catalogue_blurs_nothing():
    sim = simulate(dynamic=0.05, static=0.5)
    prior = Prior(sim.truth.static)
    before = solve(sim.matches, prior=prior)
    after = solve(sim.matches, prior=prior, reference=planar(sim, 60, 1.0))
    changed = accuracy.bias(after.estimate.positions, before.estimate.positions, removed=3)
    assert changed < 0.03 * accuracy.expected_bias(before, removed=3)
    assert accuracy.bias(after.estimate.positions, before.estimate.positions) > 10 * changed
    assert np.all(after.stars["x_err"] < 1.01 * before.stars["x_err"])


def squared_pulls(solution, xy, which):
    """Sum of squared absolute errors over that of the stated variances, of some stars."""
    errors = np.stack([solution.stars[name].value for name in ("x_err_abs", "y_err_abs")], axis=1)[which]
    return np.sum((solution.estimate.positions - xy)[which] ** 2) / np.sum(errors**2)


def test_stars_are_as_good_as_a_good_catalogue():
    """0.001 px on half of the stars of four exposures of 0.02 px, which by themselves know them to 0.01 px."""
    errors, pulls_of = [], {True: [], False: []}
    for seed in range(4):
        sim = simulate(seed, sigma=0.02, n_exposures=4)
        solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=planar(sim, 30, 0.001, seed=seed))
        has = np.asarray(solution.stars["reference_used"])
        assert np.count_nonzero(has) == 30
        errors.append(np.mean((solution.estimate.positions - truth(sim, solution))[has] ** 2))
        for kind, each in pulls_of.items():
            each.append(squared_pulls(solution, truth(sim, solution), has == kind))
    assert np.sqrt(np.mean(errors)) < 0.0015
    assert np.mean(pulls_of[True]) == pytest.approx(1, abs=0.3)
    assert np.mean(pulls_of[False]) == pytest.approx(1, abs=0.4)


@pytest.mark.parametrize(
    ("n", "error", "blunders", "n_sets"),
    [
        pytest.param(30, 0.001, 0.0, 6, marks=pytest.mark.slow),
        pytest.param(30, 0.001, 0.0, 20, marks=pytest.mark.sets),
        pytest.param(60, 1.0, 0.0, 20, marks=pytest.mark.sets),
        pytest.param(60, 0.05, 0.2, 20, marks=pytest.mark.sets),
        pytest.param(30, 0.01, 0.2, 6, marks=pytest.mark.slow),
        pytest.param(30, 0.01, 0.2, 20, marks=pytest.mark.sets),
    ],
)
def test_stars_of_a_catalogue_are_calibrated(n, error, blunders, n_sets):
    """Blunders of 1 px are left out, and a poor catalogue makes no relative error larger."""
    squares, ratios = [], []
    for seed in range(n_sets):
        sim = simulate(seed, sigma=0.02, n_exposures=11 if blunders else 4)
        reference, rng = planar(sim, n, error, seed=seed), RNG([seed, 11])
        bad = rng.random(n) < blunders
        for axis in ("x", "y"):
            reference[axis][bad] += rng.normal(size=np.count_nonzero(bad))
        prior = Prior(sim.truth.static)
        before, solution = solve(sim.matches, prior=prior), solve(sim.matches, prior=prior, reference=reference)
        squares.append(squared_pulls(solution, truth(sim, solution), slice(None)))
        ratios.append(np.max(solution.stars["x_err"] / before.stars["x_err"]))
    assert np.mean(squares) == pytest.approx(1, abs=0.2 * np.sqrt(20 / n_sets))
    if error > 0.02:
        assert max(ratios) < 1.01


def test_large_maps_change_relative_positions_to_second_order_and_for_the_better():
    """The product of the map and the gradient of the distortion; where the truth is imposed chi2 falls."""
    sim = simulate(noise=0.0)
    prior = Prior(sim.truth.static)
    before = solve(sim.matches, prior=prior)
    after = solve(sim.matches, prior=prior, reference=planar(sim, 60, 1e-6))
    assert accuracy.bias(after.estimate.positions, truth(sim, after)) < 5e-4
    assert before.chi2 > 5 * after.chi2


def test_wrong_reference_is_told():
    sim = simulate(dynamic=0.05, static=0.5)
    prior = Prior(sim.truth.static)
    before = solve(sim.matches, prior=prior)
    with warns_here(
        AssumptionWarning, match=r"are \d+\.\d times larger than the errors of both imply.*are taken 3\d time"
    ):
        after = solve(sim.matches, prior=prior, reference=planar(sim, 60, 0.3, stated=0.01))
    changed = accuracy.bias(after.estimate.positions, before.estimate.positions, removed=3)
    assert changed < 0.1 * accuracy.expected_bias(before, removed=3)
    assert "its errors are taken 3" in str(after.gauge)


@pytest.mark.parametrize(("stated", "asked"), [(None, "found"), (3.0, "found"), (None, 0.05)])
def test_errors_that_a_catalogue_does_not_state(sim, stated, asked):
    error = 0.05
    reference = planar(sim, 60, error, stated=stated)
    if stated is None:
        reference.remove_columns(["x_err", "y_err"])
    reference["x"][:3] += [1.0, -5.0, 40.0]
    solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=reference, reference_error=asked)
    tie = solution.gauge.tie
    assert np.sqrt(tie.known[0, 0, 0]) == pytest.approx(error, rel=0.0 if asked == error else 0.2)
    assert ("its errors were found: 0.0" in str(solution.gauge)) == (asked == "found")
    assert sorted(tie.stars[~tie.used]) == sorted(reference["star"][:3])
    assert np.mean(pulls(sim, solution) ** 2) == pytest.approx(1, abs=0.4)


#: Nine exposures that no prior knows, three of them turned: each with a distortion of its own, or all with one.
OPEN = {"each": ({"dynamic": 0.025}, {}), "one for all": ({"dynamic": 0.0}, {"static": "fit"})}


def open_night(seed, kind, *, error=0.2, stated=None, outliers=0.05, asked=None):
    """Solved with a catalogue whose errors are much larger than those of stars, some of it 3 px off; and the truth.

    The solution, positions of the catalogue's plane (n_stars, 2) of its stars, and the names of the outliers. Stars are
    known to 0.003 to 0.08 px.
    """
    drawn, how = OPEN[kind]
    data, true = dense_model.drawn_set(
        seed, n_stars=160, n=9, size=1024, dither=60.0, angles=np.repeat([0.0, 20.0], [6, 3]), static=0.3,
        errors=(0.008, 0.08), **drawn,
    )  # fmt: skip
    rng = RNG([seed, 9])
    rows = rng.permutation(len(true["stars"]))[:100]
    xy, angle = true["stars"][rows] + error * rng.normal(size=(100, 2)), rng.uniform(0, 2 * np.pi, 100)
    wrong = np.arange(100) < 100 * outliers
    xy[wrong] += 3 * np.column_stack([np.cos(angle), np.sin(angle)])[wrong]
    table = Table({"star": rows, "x": xy[:, 0], "y": xy[:, 1]})
    if stated is not None:
        table["x_err"] = table["y_err"] = stated
    with warnings.catch_warnings(action="ignore", category=AssumptionWarning):
        solution = solve(drawn_sets.as_matches(data), **how, reference=table, reference_error=asked)
    return solution, true["stars"][solution.estimate.star_names], set(rows[wrong])


@pytest.mark.parametrize("kind", OPEN)
@pytest.mark.parametrize(("stated", "asked"), [(0.05, "found"), (None, "found"), (0.05, None), (0.0002, None)])
def test_errors_are_found_from_good_stars_alone_and_from_all_of_them(kind, stated, asked):
    """A factor on the errors of both would reject bright stars, whose own are small, and keep faint ones as far off."""
    solution, _, wrong = open_night(1, kind, stated=stated, asked=asked)
    tie = solution.gauge.tie
    assert set(tie.stars[~tie.used]) == wrong & set(tie.stars)
    n = np.count_nonzero(tie.used)
    assert np.sqrt(np.mean(tie.known[:, 0, 0])) == pytest.approx(0.2, rel=3 / np.sqrt(4 * n))


@pytest.mark.slow
@pytest.mark.parametrize("kind", OPEN)
@pytest.mark.parametrize(("stated", "outliers"), [(0.05, 0.0), (None, 0.05)])
def test_absolute_errors_are_calibrated_where_those_of_the_catalogue_are_found(kind, stated, outliers):
    """Over 12 sets, with at most one good star of a set left out, and no wrong one used."""
    squares, sizes = [], []
    for seed in range(12):
        solution, true, wrong = open_night(seed, kind, stated=stated, outliers=outliers, asked="found")
        tie, errors = solution.gauge.tie, [solution.stars[f"{axis}_err_abs"].value for axis in "xy"]
        out = set(tie.stars[~tie.used])
        assert wrong & set(tie.stars) <= out
        assert len(out - wrong) <= 1
        squares.append(np.nanmean(((solution.estimate.positions - true) / np.column_stack(errors)) ** 2))
        sizes.append(np.mean(tie.known[:, 0, 0]))
    assert np.mean(squares) == pytest.approx(1, abs=0.3)
    assert np.sqrt(np.mean(sizes)) == pytest.approx(0.2, rel=0.06)


def test_an_exact_catalogue_is_found_to_be_better_than_the_exposures(sim):
    reference = planar(sim, 60, 1e-5)
    solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=reference, reference_error="found")
    assert solution.gauge.tie.known[0, 0, 0] ** 0.5 < 0.01
    assert accuracy.bias(solution.estimate.positions, truth(sim, solution)) < 0.005


def test_reference_error_in_another_unit(night):
    catalogue, prior = gaia(night), Prior(night.truth.static)
    catalogue.remove_columns(["ra_error", "dec_error"])
    first, second = (
        solve(night.matches, prior=prior, reference=catalogue, epoch=2021.0, reference_error=error)
        for error in (0.5, 5e-4 * u.arcsec)
    )
    assert_allclose(second.estimate.positions, first.estimate.positions, atol=1e-9)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (-1.0, "must be a positive number, a Quantity, or 'found', got -1.0"),
        ("guess", "or 'found', got 'guess'"),
        (1 * u.kg, "must be in pix for its positions, got 1.0 kg"),
    ],
)
def test_errors_that_are_none(sim, error, words):
    with pytest.raises(InputError, match=re.escape(words)):
        solve(sim.matches, reference=planar(sim, 60, 0.05), reference_error=error)


def test_an_error_without_a_catalogue(sim):
    with pytest.raises(InputError, match="is for the catalogue of reference"):
        solve(sim.matches, reference_error=0.1)


def test_mismatched_stars_are_rejected_by_name(sim):
    reference = planar(sim, 40, 0.02)
    reference["x"][:4] += [3.0, -50.0, 1.0, 200.0]
    solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=reference)
    tie = solution.gauge.tie
    assert sorted(tie.stars[~tie.used]) == sorted(reference["star"][:4])
    assert_allclose(tie.offsets[~tie.used, 0], [3.0, -50.0, 1.0, 200.0], atol=0.2)
    assert "4 rejected as mismatched" in str(solution.gauge)
    assert np.mean(pulls(sim, solution) ** 2) == pytest.approx(1, abs=0.4)


@pytest.mark.parametrize(
    ("rounds", "words"),
    [
        pytest.param(3, "may be off by as much", marks=pytest.mark.slow),
        (4, "too little to matter"),
        pytest.param(10, None, marks=pytest.mark.slow),
    ],
)
def test_a_tie_that_does_not_settle_says_how_far_it_is(monkeypatch, caplog, rounds, words):
    """A static distortion of 12 px, unknown: the plane moves by 9, 0.8, 0.08 and 0.004 px; its error is 0.03 px."""
    sim = simulate(static=12.0)
    monkeypatch.setattr(reference_tie, "_ROUNDS", rounds)
    with caplog.at_level(logging.WARNING, logger="legdistort"):
        solution = solve(sim.matches, reference=planar(sim, 40, 0.02))
    assert solution.status.endswith("not settled") == (words is not None)
    if words is None:
        assert not caplog.messages
    else:
        assert f"not settled after {rounds} rounds: the last of them moved the plane by" in caplog.text
        assert words in caplog.text
    check = next(check for check in solution.checks if check.name == "reference")
    assert ("the tie to the reference has not settled" in check.sentence) == (words is not None)
    if words is not None:
        assert check.state == {3: "fail", 4: "warn"}[rounds]
        assert check.cure.startswith("a prior of the static distortion (--prior)")
        near = solve(sim.matches, reference=planar(sim, 40, 0.02), prior=Prior(sim.truth.static))
        assert near.gauge.tie.unsettled < 0.5 * solution.gauge.tie.unsettled


def test_permuted_reference_is_the_same(sim):
    reference = planar(sim, 20, 0.02)
    prior = Prior(sim.truth.static)
    first, second = (
        solve(sim.matches, prior=prior, reference=table)
        for table in (reference, reference[RNG(0).permutation(len(reference))])
    )
    assert_allclose(second.estimate.positions, first.estimate.positions, atol=1e-9)
    assert_allclose(second.stars["x_err_abs"], first.stars["x_err_abs"], rtol=1e-9)


def test_many_stars_are_treated_one_by_one(sim, monkeypatch):
    """Beyond `DENSE` stars the covariances between their relative errors are left out: nearly the same."""
    reference, prior = planar(sim, 40, 0.02), Prior(sim.truth.static)
    dense = solve(sim.matches, prior=prior, reference=reference)
    monkeypatch.setattr("legdistort.solving.gauge.catalogue_map.DENSE", 10)
    by_star = solve(sim.matches, prior=prior, reference=reference)
    assert accuracy.bias(by_star.estimate.positions, dense.estimate.positions) < 0.3 * accuracy.expected_bias(
        dense, absolute=True
    )
    assert_allclose(by_star.stars["x_err_abs"], dense.stars["x_err_abs"], rtol=0.15)


@pytest.mark.parametrize("options", [{"loss": "cauchy"}, {"clip": 5.0}, {"errors": "scale"}])
def test_with_other_options(sim, options):
    solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=planar(sim, 50, 0.02), **options)
    assert np.mean(pulls(sim, solution) ** 2) == pytest.approx(1, abs=0.35)


@pytest.mark.parametrize("degree", [0, 1])
def test_shared_static_distortion(degree):
    dynamic = 0.0 if degree == 0 else [0.3] * 3 + [0.0] * 7
    sim = simulate(dynamic=dynamic, dither=250.0, rotations=np.arange(6) * 60.0)
    free = solve(sim.matches, static="fit", exposure_degree=degree)
    solution = solve(sim.matches, static="fit", exposure_degree=degree, reference=planar(sim, 40, 0.02))
    assert np.mean(pulls(sim, solution) ** 2) == pytest.approx(1, abs=0.4)
    assert solution.chi2 / solution.dof == pytest.approx(free.chi2 / free.dof, abs=0.05)


# --- few stars ---------------------------------------------------------------------------------------------------


def test_three_stars_fix_shift_rotation_and_scale(sim):
    solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=planar(sim, 3, 0.02))
    text = str(solution.gauge)
    rows = {line[:24].strip(): line for line in text.splitlines()}
    assert rows["shift, rotation, scale"].endswith("the reference")
    assert "the constraint" in rows["degree 3"]
    assert "No external reference" not in text
    assert np.mean(pulls(sim, solution) ** 2) < 3


def test_one_star_fixes_the_shift(sim):
    prior = Prior(sim.truth.static)
    before = solve(sim.matches, prior=prior)
    solution = solve(sim.matches, prior=prior, reference=planar(sim, 1, 0.001))
    moved = solution.estimate.positions - before.estimate.positions
    assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=2e-5)  # of the last step, 1e-4 standard errors
    rows = {line[:24].strip(): line for line in str(solution.gauge).splitlines()}
    assert rows["shift"].endswith("the reference")
    assert "not known" in rows["rotation, scale"]


def test_two_stars_fix_the_similarity(sim):
    reference = planar(sim, 2, 0.001)
    solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=reference)
    rows = np.searchsorted(solution.estimate.star_names, reference["star"])
    assert_allclose(solution.estimate.positions[rows], np.column_stack([reference["x"], reference["y"]]), atol=1e-6)
    assert "not known" not in str(solution.gauge)


def test_too_few_stars_for_an_unknown_static_distortion(sim):
    """What neither they nor the exposures determine is unknown, and said to be."""
    solution = solve(sim.matches, reference=planar(sim, 3, 0.02))
    assert len(solution.gauge.unknown) >= 2
    assert np.isnan(solution.stars["x_err_abs"]).any()
    assert np.isfinite(solution.stars["x_err_known"]).all()
    assert "Absolute positions are not known: no static distortion was given" in str(solution.gauge)


# --- identification ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [0.0, 40.0])
def test_positions_are_matched_in_the_plane(sim, shift):
    prior, reference = Prior(sim.truth.static), planar(sim, 40, 0.02)
    for name in ("x", "y"):
        reference[name] += shift
    named = solve(sim.matches, prior=prior, reference=reference)
    reference.remove_column("star")
    found = solve(sim.matches, prior=prior, reference=reference)
    assert len(found.gauge.tie.stars) == 40
    assert_allclose(found.estimate.positions, named.estimate.positions, atol=1e-6)


@pytest.mark.parametrize("called", ["source", None])
def test_stars_of_a_reference_that_are_elsewhere_are_named_by_it(sim, caplog, tmp_path, called):
    """Those far off are not found, those near are found and rejected; what lies outside the field is not counted."""
    reference = planar(sim, 40, 0.02, named=False)
    middle = np.argsort(np.hypot(*(np.column_stack([reference["x"], reference["y"]]) - 1024).T))
    near, far = middle[[0, 1]], middle[[2, 3, 4]]
    reference["x"][near] += 1.0
    reference["y"][far] += 60.0
    reference.add_row([5000.0, 1000.0, 0.02, 0.02])
    names = np.array([f"row {row}" for row in range(41)])
    if called:
        names = np.array([f"S{7 * row}" for row in range(41)])
        reference[called] = names
    with caplog.at_level(logging.INFO, logger="legdistort"):
        solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=reference)
    told = next(line for line in caplog.messages if "are in the exposures" in line)
    assert told.startswith("37 of the 41 stars of the reference are in the exposures; 3 more lie among them and are")
    assert sorted(told.split(": ")[1].split(", ")) == sorted(names[far])
    tie = Solution.read(solution.write(tmp_path / "solution.asdf")).gauge.tie
    assert sorted(tie.labels[~tie.used]) == sorted(names[near])
    assert all(f"({name})" in tie.sentence for name in names[near])
    assert tie.rejected == [
        f"{star} ({name})" for star, name in zip(tie.stars[~tie.used], tie.labels[~tie.used], strict=True)
    ]


@pytest.mark.parametrize("n", [1, 4])
def test_few_stars_are_matched_to_their_neighbours(sim, n):
    reference = planar(sim, n, 0.02)
    expected = sorted(reference["star"])
    reference.remove_column("star")
    solution = solve(sim.matches, prior=Prior(sim.truth.static), reference=reference)
    assert sorted(solution.gauge.tie.stars) == expected


def test_names_may_be_words(sim):
    table = sim.matches.table.copy()
    table["star"] = np.array([f"s{star:02d}" for star in table["star"]])
    matches = Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
    reference = planar(sim, 30, 0.02)
    reference["star"] = [f"s{star:02d}" for star in reference["star"]]
    solution = solve(matches, prior=Prior(sim.truth.static), reference=reference)
    assert solution.gauge.tie.used.sum() == 30


def test_a_reference_in_another_plane_takes_the_solution_along(sim):
    """Turned by 30 degrees and 1.5 times as large: positions, errors and poses follow, chi2 does not care."""
    c, s = 1.5 * np.cos(np.pi / 6), 1.5 * np.sin(np.pi / 6)
    reference, turn = planar(sim, 40, 0.02), np.array([[c, -s], [s, c]])
    xy = np.column_stack([reference["x"], reference["y"]]) @ turn.T
    turned = reference.copy()
    turned["x"], turned["y"] = xy.T
    turned["x_err"] = turned["y_err"] = 0.03
    prior = Prior(sim.truth.static)
    first, second = (solve(sim.matches, prior=prior, reference=table) for table in (reference, turned))
    assert_allclose(second.estimate.positions, first.estimate.positions @ turn.T, atol=1e-3)
    assert_allclose(
        second.estimate.uncertainty.stars[:2].sum(axis=0),
        2.25 * first.estimate.uncertainty.stars[:2].sum(axis=0),
        rtol=1e-3,
    )
    assert second.chi2 == pytest.approx(first.chi2, rel=1e-5)


# --- the sky -----------------------------------------------------------------------------------------------------


def test_headers_are_corrected_by_gaia(night, tied):
    free = solve(night.matches, prior=Prior(night.truth.static))
    assert np.median(separation(night, free)) > 20  # headers are 0.3 arcsec off
    assert np.median(separation(night, tied)) < 1.0
    stars = tied.stars
    assert {"ra", "dec", "ra_error_abs"} <= set(stars.colnames)
    assert (
        np.mean((separation(night, tied) / np.hypot(*(stars[f"{k}_error_abs"].value for k in ("ra", "dec")))) ** 2) < 2
    )
    assert tied.sky.pixel_scale == free.sky.pixel_scale
    assert "from the headers, tied to the reference" in str(tied)
    name = tied.names[0]
    xy = np.array([[100.0, 200.0], [400.0, 50.0]])
    sky, true = tied[name].wcs.pixel_to_world(*xy.T), night.truth.sky.to_sky(_corrected(night, name, xy))
    assert sky.separation(true).max() < 3 * u.mas


def _corrected(night, name, xy):
    """Reference positions of true pixels, by iterating the direct model."""
    place = xy.copy()
    for _ in range(60):
        place = place + (xy - night.truth.distort(name, place))
    return place


@pytest.mark.parametrize("how", ["names", "pattern", "pattern, scale unknown"])
def test_without_headers_the_reference_gives_the_sky(night, tied, how):
    """Tangent point, rotation, scale and parity are found: the same positions on the sky as with headers."""
    matches = Matches.from_table(night.matches.table, shape=night.truth.shape)
    reference = gaia(night)
    if how == "names":
        reference["star"] = np.arange(len(reference))
    scale = 0.0825 if how == "pattern" else None
    prior = Prior(night.truth.static)
    assert "sky     not known" in str(solve(matches, prior=prior))
    solution = solve(matches, prior=prior, reference=reference, epoch=2021.0, pixel_scale=scale)
    apart = solution.sky.to_sky(solution.estimate.positions).separation(tied.sky.to_sky(tied.estimate.positions))
    assert apart.max() < 0.05 * u.mas
    assert np.linalg.det(solution.sky.matrix[:, :2]) < 0
    assert "arcsec/px, from the reference" in in_tables.sky_sentence(solution)


@pytest.mark.slow
def test_proper_motions_matter(night, tied):
    reference = gaia(night, motion=20.0)
    moved = solve(
        night.matches, prior=Prior(night.truth.static), reference=reference, epoch=Time(2021.0, format="jyear")
    )
    assert_allclose(separation(night, moved), separation(night, tied), atol=0.2)
    with warns_here(AssumptionWarning, match="motions left out"):
        still = solve(night.matches, prior=Prior(night.truth.static), reference=reference, epoch=2016.0)
    assert np.median(separation(night, still)) > 3


def test_motion_is_that_of_astropy():
    """Straight on the sphere, near the pole too, with the covariance of `Gaia` correlations."""
    table = Table({"ra": [10.0, 359.9999, 45.0], "dec": [5.0, -60.0, 89.9999], "ref_epoch": [2016.0] * 3})
    table["pmra"], table["pmdec"] = [100.0, -3000.0, 4000.0], [-50.0, 1500.0, 800.0]
    for name in ("ra_error", "dec_error", "pmra_error", "pmdec_error"):
        table[name] = 0.1
    table["ra_pmra_corr"] = 0.5
    moved = read_reference(table).at(2026.0)
    expected = SkyCoord(  # at a large distance, so that nothing moves along the line of sight
        table["ra"] * u.deg, table["dec"] * u.deg, pm_ra_cosdec=table["pmra"] * u.mas / u.yr,
        pm_dec=table["pmdec"] * u.mas / u.yr, distance=0.1 * u.kpc, obstime=Time(2016.0, format="jyear", scale="tdb"),
    ).apply_space_motion(Time(2026.0, format="jyear", scale="tdb"))  # fmt: skip
    assert SkyCoord(*moved.sky.T * u.deg).separation(SkyCoord(expected.ra, expected.dec)).max() < 2e-3 * u.mas
    assert_allclose(moved.covariance[:, 0, 0], 0.01 + 2 * 10 * 0.5 * 0.01 + 100 * 0.01)
    assert_allclose(moved.covariance[:, 1, 1], 0.01 + 100 * 0.01)


def test_errors_on_the_plane_follow_east_and_north():
    """ra_error belongs to ra cos(dec); near the pole the ellipse turns with the right ascension."""
    table = Table({"ra": [0.0, 90.0], "dec": [89.9, 89.9], "ra_error": [3.0] * 2, "dec_error": [1.0] * 2})
    plane = TangentPlane(0.0, 90.0, np.eye(2, 3) / 3600)  # 1 arcsec a pixel; at the pole xi, eta turn with ra
    found = read_reference(table).on_plane(plane)
    errors = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)) * 1000
    assert_allclose(errors, [[3, 1], [1, 3]], rtol=1e-4)


def test_epoch_of_the_headers():
    headers = [fits.Header({"MJD-OBS": 59215.0}), fits.Header({"DATE-OBS": "2021-07-02T12:00:00"}), fits.Header()]
    assert mean_epoch(headers) == pytest.approx((2021.0 + 2021.5) / 2, abs=0.01)
    assert mean_epoch([fits.Header({"DATE-OBS": "unknown", "MJD-OBS": 0.0})]) is None
    assert year(Time("2013-01-01")) == pytest.approx(2013.0, abs=0.01)


def test_matches_know_the_epoch(night):
    matches = replace(night.matches, epoch=2021.0)
    assert Matches.read_meta(matches.to_meta())["epoch"] == 2021.0
    assert matches.without({matches.names[0]: "not wanted"}).epoch == 2021.0
    solution = solve(matches, prior=Prior(night.truth.static), reference=gaia(night))
    assert solution.diagnostics.reference.epoch == 2021.0
    assert np.median(separation(night, solution)) < 1.0


# --- tables ------------------------------------------------------------------------------------------------------


def test_units_masks_and_names_of_vizier(night, tied):
    plain = gaia(night)
    table = QTable()
    table["RA_ICRS"], table["DE_ICRS"] = plain["ra"] * u.deg, (plain["dec"] * u.deg).to(u.rad)
    table["e_RA_ICRS"], table["e_DE_ICRS"] = plain["ra_error"] / 1000 * u.arcsec, plain["dec_error"] * u.mas
    table["pmRA"], table["pmDE"] = plain["pmra"] * u.mas / u.yr, plain["pmdec"] * u.mas / u.yr
    table["e_pmRA"], table["e_pmDE"] = plain["pmra_error"] * u.mas / u.yr, plain["pmdec_error"] * u.mas / u.yr
    table["ref_epoch"] = plain["ref_epoch"] * u.yr
    solution = solve(night.matches, prior=Prior(night.truth.static), reference=table, epoch=2021.0)
    assert_allclose(solution.estimate.positions, tied.estimate.positions, atol=1e-6)


@pytest.mark.parametrize("called", ["{}_err", "e_{}", "{}_unc", "E_{}"])
def test_errors_that_are_called_otherwise(night, called):
    plain = gaia(night)
    names = ("ra", "dec", "pmra", "pmdec")
    other = plain.copy()
    for name in names:
        other.rename_column(f"{name}_error", called.format(name))
    assert_allclose(read_reference(other).covariance, read_reference(plain).covariance)


def test_a_file_is_said_to_have_the_columns_that_it_has(night, tmp_path):
    table = gaia(night)["ra", "dec"]
    table.write(tmp_path / "stars.fits")
    with pytest.raises(InputError, match="it has ra, dec: rename the columns that are these"):
        read_reference(tmp_path / "stars.fits")


def test_stars_without_motion_serve_at_their_own_epoch_only(night):
    table = gaia(night)
    mask = np.zeros(len(table), bool)
    mask[::3] = True
    for name in ("pmra", "pmdec", "pmra_error", "pmdec_error"):
        table[name] = MaskedColumn(table[name], mask=mask)
    table["ra"][1] = np.nan
    reference = read_reference(table)
    assert len(reference) == len(table) - 1
    assert len(reference.at(2021.0)) == np.count_nonzero(~mask) - 1
    assert len(reference.at(2016.0)) == len(table) - 1
    assert repr(reference) == f"<Reference: {len(table) - 1} stars, sky positions, with proper motions>"
    with pytest.raises(InputError, match="no star of the reference has a proper motion with errors"):
        reference.subset(mask[np.arange(len(table)) != 1]).at(2021.0)


@pytest.mark.parametrize(("epoch", "n"), [(2021.0, 7), (2016.0, 0)])
def test_stars_left_out_for_the_want_of_a_motion_are_counted(night, caplog, epoch, n):
    """With the cause; none are at the epoch of the catalogue."""
    table = gaia(night, motion=0.0)
    for name in ("pmra", "pmdec", "pmra_error", "pmdec_error"):
        table[name] = MaskedColumn(table[name], mask=np.arange(len(table)) < 7)
    with caplog.at_level(logging.INFO, logger="legdistort"):
        solve(night.matches, prior=Prior(night.truth.static), reference=table, epoch=epoch)
    told = next(line for line in caplog.messages if "of the reference are in the exposures" in line)
    words = f"; {n} are left out: they have no proper motion with errors to take them to {epoch:.2f}"
    missing = r"(; \d+ more lie among them and are not found, too faint or in .*\(min_\w+\): [\d, ]+( and \d+ more)?)?"
    counted = rf"\d+ of the {len(table)} stars of the reference are in the exposures"
    assert re.fullmatch(rf"{counted}{missing}{words * (n > 0)}", told)


@pytest.mark.usefixtures("undrawn")
def test_a_file_and_its_command(night, tied, tmp_path, capsys):
    gaia(night).write(tmp_path / "gaia.ecsv")
    matched = night.matches.table.copy()
    matched.meta = night.matches.to_meta()
    matched.write(tmp_path / "matched.ecsv")
    command = ["solve", str(tmp_path / "matched.ecsv"), "--reference", str(tmp_path / "gaia.ecsv"), "--epoch", "2021",
               "--pixel-scale", "0.08", "--out", str(tmp_path / "out"), "--json", "--quiet"]  # fmt: skip
    assert main(command) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["reference"]["n_stars"] == tied.gauge.tie.used.sum()
    assert "tied to" in summary["gauge"]
    assert "tied to the reference" in summary["sky"]
    assert {"ra", "dec"} <= set(Table.read(tmp_path / "out" / "stars.ecsv").colnames)
    assert "tangent point" in (tmp_path / "out" / "report.html").read_text()
    assert main([*command[:-4], "--out", str(tmp_path / "b"), "--reference", str(tmp_path / "none.ecsv")]) == 1
    assert "none.ecsv: no such file" in capsys.readouterr().err


def test_solution_keeps_its_tie(night, tied, tmp_path):
    read = Solution.read(tied.write(tmp_path / "solution.asdf"))
    assert str(read) == str(tied)
    assert str(read.gauge) == str(tied.gauge)
    assert repr(read.gauge.tie) == repr(tied.gauge.tie)
    for name in ("x_err_abs", "ra_error_abs"):
        assert_allclose(read.stars[name], tied.stars[name])


def test_stars_of_another_solution_are_a_reference(night, tied):
    """Their absolute errors count, not the relative ones."""
    table = tied.stars
    table.remove_column("star")
    assert_allclose(
        np.sqrt(read_reference(table).covariance[:, 0, 0]), table["ra_error_abs"].to_value("mas"), rtol=1e-12
    )
    again = solve(night.matches, prior=Prior(night.truth.static), reference=table)
    assert_allclose(again.estimate.positions, tied.estimate.positions, atol=5e-3)


# --- bad input ---------------------------------------------------------------------------------------------------


def replaced(table, name, value):
    """The table with a column of another type."""
    table.replace_column(name, [value] * len(table))
    return table


def change(**columns):
    """A change of a table: columns set, or removed with None."""

    def changed(table):
        for name, value in columns.items():
            if value is None:
                table.remove_column(name)
            else:
                table[name] = value
        return table

    return changed


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (change(x=None), "has neither ra, dec nor x, y; it has star, y, x_err, y_err: rename"),
        (change(x_err=None), r"lacks x_err, errors of its positions \(pix, standard deviations\); it has star"),
        (change(x_err=-1.0), "x_err must be positive, got -1 in row 0"),
        (change(x=np.nan), r"has no row with finite positions and errors \(40 rows\)"),
        (lambda t: replaced(t, "x", "left"), "the reference: column 'x' cannot be read as numbers"),
        (change(star=1), "names star 1 more than once"),
        (change(star=np.arange(40) + 500), "names none of the stars of the exposures: it has 500, 501, 502"),
        (change(star=RNG(3).permutation(40)), "by name do not lie as they do there"),
        (lambda t: change(star=None)(change(x=t["x"] + 1e5)(t)), "none of the 40 stars of the reference lies where"),
        (lambda t: t[:0], "has no row"),
        (lambda t: "nowhere.ecsv", "nowhere.ecsv: no such file"),
        (lambda t: 3, "reference must be a table, the path of one, or a SkyCoord, got int"),
        (lambda t: change(ra=1.0, dec=95.0, ra_error=1.0, dec_error=1.0)(t), "dec must lie in -90 ... 90 degrees"),
        (lambda t: change(ra=1.0, dec=5.0)(t), "lacks ra_error and dec_error, errors of its positions"),
        (lambda t: change(ra=1.0, dec=5.0, ra_sd=1.0)(t), "dec, ra_sd: rename the columns .* or state one for all"),
        (change(ra=1.0, dec=5.0, ra_error=1.0, dec_error=1.0, pmra=1.0), "one of pmra, pmdec is missing"),
        (
            change(ra=1.0, dec=5.0, ra_error=1.0, dec_error=1.0, pmra=1.0, pmdec=1.0),
            r"has proper motions but no column ref_epoch, the year of its positions",
        ),
        (
            change(ra=1.0, dec=5.0, ra_error=1.0, dec_error=1.0, pmra=1.0, pmdec=1.0, ref_epoch=2016.0),
            "lacks pmra_error and pmdec_error, errors of its motions",
        ),
        (change(xy_corr=3.0), "xy_corr must lie in -1 ... 1, got 3"),
    ],
)  # fmt: skip
def test_bad_tables(sim, made, message):
    with pytest.raises(InputError, match=message):
        solve(sim.matches, prior=Prior(sim.truth.static), reference=made(planar(sim, 40, 0.02)))


def test_another_field_with_stars_in_it(sim):
    reference = planar(sim, 40, 0.02, named=False)
    reference["x"], reference["y"] = RNG(0).uniform(0, 2048, (2, 40))
    with pytest.raises(InputError, match=r"the nearest two are .* px apart: another field, or the wrong columns\?"):
        solve(sim.matches, prior=Prior(sim.truth.static), reference=reference)


def test_most_stars_elsewhere():
    sim = simulate(dynamic=0.02, static=0.5)
    reference = planar(sim, 40, 0.02)
    reference["x"][:10] += RNG(1).choice([-1.0, 1.0], 10)
    reference["x"][10:21] += RNG(2).choice([-50.0, 50.0], 11)
    with pytest.raises(InputError, match="most of the 40 stars that the reference shares with the exposures lie elsew"):
        solve(sim.matches, prior=Prior(sim.truth.static), reference=reference)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"the epoch of the exposures is not known .* give epoch= \(--epoch\), a decimal year or an astropy Time"),
        ({"epoch": 20}, "epoch must be a decimal year, such as 2013.25, or one astropy Time, got 20"),
        ({"epoch": "2020"}, "epoch must be a decimal year"),
        ({"epoch": 2021, "pixel_scale": -1}, "pixel_scale must be a positive number of arcsec, got -1"),
    ],
)
def test_bad_options(night, options, message):
    with pytest.raises(InputError, match=message):
        solve(night.matches, prior=Prior(night.truth.static), reference=gaia(night), **options)


def test_no_sky_and_no_way_to_it(night):
    matches = Matches.from_table(night.matches.table, shape=night.truth.shape)
    reference, prior = gaia(night), Prior(night.truth.static)
    with pytest.raises(
        InputError, match=r"no WCS, and 4 stars of the reference and .* too few to find one by their pattern"
    ):
        solve(matches, prior=prior, reference=reference[:4], epoch=2021)
    other = reference.copy()
    other["ra"], other["dec"] = RNG(0).uniform([[84.9], [-69.77]], [[84.93], [-69.76]], (2, len(other)))
    with pytest.raises(
        InputError,
        match=r"the pattern of their .* stars is not that of .*\(pixel_scale=, --pixel-scale\).* The brightest stars",
    ):
        solve(matches, prior=prior, reference=other, epoch=2021)
    with pytest.raises(InputError, match=r"at 0\.5 arcsec a pixel: another field"):
        solve(matches, prior=prior, reference=reference, epoch=2021, pixel_scale=0.5)
    reference["star"] = np.arange(len(reference))
    with pytest.raises(InputError, match="2 stars of the reference are too few to determine rotation"):
        solve(matches, prior=prior, reference=reference[np.isin(reference["star"], matches.stars[:2])], epoch=2021)


def test_nothing_is_warned_of_a_good_reference(sim):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solve(sim.matches, reference=planar(sim, 40, 0.02))
