"""Predictions against simulations, against a dense twin, and against the rules of thumb of the paper."""

import json
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table
from caller_warnings import warns_here
from numpy.testing import assert_allclose
from oracle import modes
from oracle import predict as model

from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError, MatchError, SolveError
from legdistort.geometry import similarity
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.simulation.observations import simulate_matches
from legdistort.simulation.prediction import predict
from legdistort.simulation.prediction_text import describe_plans
from legdistort.simulation.truth import displacement
from legdistort.solving.equations import covariances, reduced_system
from legdistort.solving.estimation import solve

SHAPE = (2048, 2048)


# --- Monte Carlo -------------------------------------------------------------------------------------------------


def outcomes(n_im, n_star, sigma, n, *, seed=0, n_grid=12):
    """The prediction for one simulated field, and b and sigma of n outcomes of its noise, each with its error."""
    sim = simulate_matches(n_exposures=n_im, n_stars=n_star, sigma=sigma, seed=seed, noise=0)
    prior, rng = Prior(sim.truth.static), np.random.default_rng(seed + 1)
    prediction = predict(n_exposures=n_im, n_stars=n_star, sigma=sigma, prior=prior, seed=seed, n_grid=n_grid)
    grid = np.stack(np.meshgrid(prediction.x, prediction.y), axis=-1).reshape(-1, 2)
    grid = grid[accuracy.in_contour(grid, prediction.contour)]
    squares = []
    for _ in range(n):
        table = sim.matches.table.copy()
        for axis in "xy":
            table[axis] += sigma * rng.normal(size=len(table)) * u.pix
        solution = solve(Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses), prior=prior)
        new = accuracy.new_scatter(solution, sim.truth.distort, grid, sigma, rng=rng)
        squares.append((accuracy.bias(solution.estimate.positions, sim.truth.positions) ** 2, np.mean(new**2)))
    mean, spread = np.mean(squares, axis=0), np.std(squares, axis=0)
    return prediction, np.sqrt(mean), spread / (2 * mean * np.sqrt(n))


def assert_agrees(n_im, n_star, sigma, n, *, tolerance, accuracy):
    prediction, measured, error = outcomes(n_im, n_star, sigma, n)
    assert np.all(error < accuracy), f"{error}: more outcomes are needed"
    assert_allclose([prediction.b, prediction.sigma] / measured, 1, atol=tolerance)


@pytest.mark.parametrize(("n_im", "n_star", "n"), [pytest.param(10, 30, 20, marks=pytest.mark.slow), (2, 40, 30)])
def test_agrees_with_monte_carlo(n_im, n_star, n):
    assert_agrees(n_im, n_star, 0.14, n, tolerance=0.06, accuracy=0.025)


@pytest.mark.parametrize(
    ("n_im", "n_star", "sigma", "n"),
    [
        pytest.param(10, 30, 0.14, 120, marks=pytest.mark.slow),  # Simulation 1
        pytest.param(10, 30, 0.03, 120, marks=pytest.mark.sets),  # Simulation 2, its smallest and largest noise
        pytest.param(10, 30, 0.28, 120, marks=pytest.mark.sets),
        pytest.param(2, 30, 0.14, 200, marks=pytest.mark.sets),  # Simulation 3
        pytest.param(50, 30, 0.14, 130, marks=pytest.mark.sets),
        pytest.param(100, 30, 0.14, 130, marks=pytest.mark.sets),
        pytest.param(10, 20, 0.14, 200, marks=pytest.mark.sets),  # Simulation 4
        pytest.param(10, 100, 0.14, 60, marks=pytest.mark.sets),
        pytest.param(10, 200, 0.14, 60, marks=pytest.mark.sets),
    ],
)
def test_simulations_of_the_paper(n_im, n_star, sigma, n):
    """Table 1 of the paper, within 3 %, the error of the Monte Carlo itself being below 1 %."""
    assert_agrees(n_im, n_star, sigma, n, tolerance=0.03, accuracy=0.01)


@pytest.mark.parametrize("settings", [{}, {"dither": 200.0}, {"dither": 200.0, "rotations": 40.0 * np.arange(8)}])
def test_errors_are_those_that_solve_reports(settings):
    """From the stars alone as from the data: with and without dithers and rolls, absolute ones too."""
    ratios = []
    for seed in range(4):
        sim = simulate_matches(n_exposures=8, n_stars=60, seed=seed, zero_mean=False, **settings)
        prior = Prior(sim.truth.static)
        solution = solve(sim.matches, prior=prior)
        prediction = predict(
            n_exposures=8, stars=sim.truth.positions, poses=sim.truth.poses, sigma=0.14, prior=prior, dynamic=0.9
        )
        ours, reported = prediction.solution.stars, solution.stars
        for name in ("x_err", "y_err"):  # the weights of the gauge follow the scatter that the data happen to show
            ratio = ours[name].value / reported[name].value
            assert np.median(ratio) == pytest.approx(1, abs=0.03)
            assert np.abs(ratio - 1).max() < 0.2
        ratios.append((prediction.b_abs / accuracy.expected_bias(solution, absolute=True)) ** 2)
        xy = sim.truth.positions
        xy = xy[(np.abs(xy - 1023.5) < 500).all(axis=1)]  # on every detector
        both = [accuracy.expected_scatter(s, xy, 0.14) for s in (prediction.solution, solution)]
        assert_allclose(*both, rtol=0.01)
    assert np.mean(ratios) == pytest.approx(1, abs=0.3)  # the solution has its scatter from eight exposures


@pytest.mark.parametrize(
    ("n", "tolerance"),
    [pytest.param(60, 0.09, marks=pytest.mark.slow), pytest.param(200, 0.05, marks=pytest.mark.sets)],
)
def test_aliasing_agrees_with_monte_carlo(n, tolerance):
    """Exact positions with modes of degree 4 and 5, far below the stated errors, fitted with degree 3."""
    spread = np.r_[np.zeros(10), np.full(5, 0.05), np.full(6, 0.03)]
    prediction = predict(n_exposures=6, n_stars=60, sigma=1.0, spectrum={4: 0.05, 5: 0.03}, n_grid=12)
    grid = np.stack(np.meshgrid(prediction.x, prediction.y), axis=-1).reshape(-1, 2)
    grid = grid[accuracy.in_contour(grid, prediction.contour)]
    squares = []
    for seed in range(n):
        sim = simulate_matches(n_exposures=6, n_stars=60, sigma=1.0, noise=0, degree=5, static=0, dynamic=0, seed=0)
        drawn = spread * np.random.default_rng(seed).normal(size=(6, 2, 21))
        table = sim.matches.table.copy()
        for i, name in enumerate(sim.truth.names):
            rows = table["exposure"] == name
            moved = displacement(drawn[i], sim.truth.positions[table["star"][rows]], SHAPE)
            for k, axis in enumerate("xy"):
                table[axis][rows] += moved[:, k] * u.pix
        solution = solve(
            Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses), prior=Prior(np.zeros((2, 10)))
        )

        def distort(name, xy, drawn=drawn):
            return xy + displacement(drawn[int(name[3:])], xy, SHAPE)

        new = accuracy.new_scatter(solution, distort, grid, 0.0)
        squares.append((accuracy.bias(solution.estimate.positions, sim.truth.positions) ** 2, np.mean(new**2)))
    measured = np.sqrt(np.mean(squares, axis=0))
    assert_allclose([prediction.b_alias, prediction.sigma_alias], measured, rtol=tolerance)


# --- aliasing: exact twins ---------------------------------------------------------------------------------------


def test_aliasing_of_undithered_exposures_in_closed_form():
    """The mean of the modes left out goes into the stars; what a fit at the stars leaves of the rest stays."""
    n, spectrum = 7, {4: 0.2, 6: 0.1}
    p = predict(n_exposures=n, n_stars=50, sigma=0.05, spectrum=spectrum, n_grid=9)
    widths = np.array([spectrum.get(i + j, 0.0) for i, j in modes(6)])

    def columns(xy):
        return np.stack([displacement(np.tile(row, (2, 1)), xy, SHAPE)[:, 0] for row in np.eye(28)], axis=1)

    at_stars = columns(p.solution.estimate.positions)
    assert p.b_alias**2 == pytest.approx(np.mean((at_stars * widths) ** 2 @ np.ones(28)) / n, rel=1e-4)
    grid = np.stack(np.meshgrid(p.x, p.y), axis=-1).reshape(-1, 2)
    fit = np.linalg.lstsq(at_stars[:, :10], at_stars[:, 10:], rcond=None)[0]
    left = columns(grid)[:, 10:] - columns(grid)[:, :10] @ fit
    expected = np.sqrt((1 - 1 / n) * ((left * widths[10:]) ** 2).sum(axis=1))
    assert_allclose(p.alias_map.ravel(), expected, rtol=1e-4)
    assert_allclose(
        p.folded, np.sqrt((1 - 1 / n) * ((fit * widths[10:]) ** 2).sum(axis=1))[None].repeat(2, 0), rtol=1e-3
    )


def test_a_static_distortion_nobody_knows_goes_into_the_stars():
    p = predict(n_exposures=7, n_stars=50, sigma=0.05, static_spectrum={4: 0.2})
    xy = p.solution.estimate.positions
    square = sum(displacement(np.eye(15)[[m, m]], xy, SHAPE) ** 2 for m in range(10, 15))
    assert p.b_alias == pytest.approx(0.2 * np.sqrt(np.mean(square)), rel=1e-4)
    assert p.sigma_alias < 1e-6
    # shifts show it, but the difference of two shifted polynomials is of one degree less, which is fitted
    four, five = (
        predict(n_exposures=7, n_stars=50, sigma=0.05, static_spectrum={d: 0.2}, dithers=400.0) for d in (4, 5)
    )
    assert four.sigma_alias < 1e-6
    assert five.sigma_alias > 0.02


def test_aliasing_folds_on_modes_of_the_same_axis_and_parity():
    """Simulation 5 of the paper: x^4 along x, fitted with degree 3; stars on a lattice that leaves the edges out."""
    t = np.linspace(0.1, 0.9, 20) * 2048 - 0.5
    stars = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    spectrum = np.zeros((2, 15))
    spectrum[0, 10] = 1.0  # orders (4, 0)
    folded = predict(n_exposures=10, stars=stars, sigma=0.01, spectrum=spectrum, n_grid=5).folded
    hit = [(i, j) for (i, j), value in zip(modes(3), folded[0], strict=True) if value > 1e-6]
    assert hit == [(0, 0), (2, 0)]
    assert np.all(folded[1] < 1e-6)


def test_aliasing_is_that_of_a_dense_fit():
    """All unknowns in one matrix, under the constraints of the gauge; dithers, rolls and unequal errors."""
    rng = np.random.default_rng(3)
    n, sigma = 4, rng.uniform(0.02, 0.2, (4, 25))
    sim = simulate_matches(
        n_exposures=n, n_stars=25, degree=1, dither=200.0, rotations=30.0 * np.arange(4), shape=(900, 1300), seed=5
    )
    given = {"n_exposures": n, "stars": sim.truth.positions, "poses": sim.truth.poses, "shape": (900, 1300)}
    p = predict(**given, sigma=sigma, degree=1, spectrum={2: 0.3}, static_spectrum={2: 0.2}, n_grid=6)
    rows, obs = p.solution.gauge.orthonormal, p.solution.residuals
    stars = p.solution.estimate.positions

    def both(i, j):  # Jacobian of one observation by stars and all modes
        pose = p.solution.poses[p.solution.names[i]]
        unit = [model(stars[j : j + 1], np.eye(12)[k].reshape(2, 6), pose, (900, 1300))[0] for k in range(12)]
        return pose[:, :2], np.array(unit).T - similarity.apply(pose, stars[j])[:, None]

    fitted = np.tile(np.arange(6) < 3, 2)
    design, target = [], []
    for row in obs:
        i, j = (
            p.solution.names.index(row["exposure"]),
            int(np.searchsorted(p.solution.estimate.star_names, row["star"])),
        )
        by_star, by_mode = both(i, j)
        line, left_out = np.zeros((2, 50 + 6 * n)), np.zeros((2, 6 * n))
        line[:, 2 * j : 2 * j + 2] = by_star
        line[:, 50 + 6 * i : 56 + 6 * i], left_out[:, 6 * i : 6 * i + 6] = by_mode[:, fitted], by_mode[:, ~fitted]
        design.append(line / row["x_err"].value)
        target.append(left_out / row["x_err"].value)
    free = np.linalg.svd(np.hstack([np.zeros((len(rows), 50)), rows]))[2][len(rows) :].T
    design, target = np.concatenate(design), np.concatenate(target)
    answer = free @ np.linalg.lstsq(design @ free, target, rcond=None)[0]
    amplitudes = np.hstack([0.3 * np.eye(6 * n), 0.2 * np.tile(np.eye(6), (n, 1))])
    errors = answer @ amplitudes
    assert p.b_alias == pytest.approx(np.sqrt(np.mean((errors[:50] ** 2).sum(axis=1))), rel=1e-5)
    mean = (errors[50:] ** 2).sum(axis=1).reshape(n, 2, 3).mean(axis=0)
    assert_allclose(p.folded, np.sqrt(mean), rtol=1e-5)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_the_sky_takes_the_mean_distortion_whatever_is_fitted(degree):
    """What is not fitted is aliased instead of hidden: the absolute error of undithered exposures stays the same."""
    spectrum = {1: 0.0, 2: 0.4, 3: 0.3, 4: 0.2}
    exact = Prior(np.zeros((2, 1)))
    p = predict(n_exposures=8, n_stars=60, sigma=0.001, degree=degree, spectrum=spectrum, prior=exact)
    xy = p.solution.estimate.positions
    squares = [displacement(np.eye(15)[[m, m]], xy, SHAPE) ** 2 * spectrum.get(i + j, 0) ** 2
               for m, (i, j) in enumerate(modes(4))]  # fmt: skip
    expected = np.sqrt(np.mean(np.sum(squares, axis=0)) / 8)
    assert np.hypot(p.b_abs, p.b_alias) == pytest.approx(expected, rel=0.01)


# --- laws --------------------------------------------------------------------------------------------------------


def test_rules_of_thumb():
    for n, n_stars in ((4, 100), (25, 100), (25, 400)):
        p = predict(n_exposures=n, n_stars=n_stars, sigma=0.05)
        assert p.thumb == pytest.approx((n**-0.5, np.sqrt((1 - 1 / n) * (1 + 10 / n_stars))))
        assert (p.s_b, p.s_sigma) == pytest.approx(p.thumb, rel=0.03)


@pytest.mark.slow
def test_the_figures_of_simulation_1():
    """Paper, section 4.1: b = 0.05 px, sigma = 0.16 px; rms over ten fields."""
    b, sigma = np.transpose([(p.b, p.sigma) for p in (predict(n_exposures=10, n_stars=30, sigma=0.14, seed=seed)
                                                     for seed in range(10))])  # fmt: skip
    assert np.sqrt(np.mean(b**2)) == pytest.approx(0.044, abs=0.002)
    assert np.median(sigma) == pytest.approx(0.16, abs=0.01)


def test_scatter_is_that_of_a_new_position_and_of_the_correction():
    p = predict(n_exposures=5, n_stars=60, sigma=0.1, degree=2)
    assert p.sigma**2 == pytest.approx(0.1**2 * (1 - 1 / 5) + p.sigma_correction**2, rel=1e-9)
    assert_allclose(p.correction_map**2, p.error_map**2 - 0.1**2 * (1 - 1 / 5), rtol=1e-6)
    # n modes of n stars, evenly over the field, are known that well
    assert p.sigma_correction == pytest.approx(0.1 * np.sqrt((1 - 1 / 5) * 6 / 60), rel=0.1)


def test_errors_are_proportional_to_the_noise():
    quiet, loud = (predict(n_exposures=5, n_stars=30, sigma=sigma, dithers=100.0) for sigma in (0.03, 0.28))
    for name in ("s_b", "s_sigma"):
        assert getattr(loud, name) == pytest.approx(getattr(quiet, name), rel=1e-6)
    assert_allclose(loud.error_map / 0.28, quiet.error_map / 0.03, rtol=1e-6)


def test_stars_are_those_of_the_simulation():
    sim = simulate_matches(n_exposures=6, n_stars=40, dither=300.0, seed=9)
    p = predict(n_exposures=6, n_stars=40, sigma=0.1, dithers=300.0, seed=9)
    assert_allclose(p.solution.estimate.positions, sim.truth.positions)
    assert list(p.stars_per_exposure) == [
        np.count_nonzero(sim.matches.table["exposure"] == n) for n in p.solution.names
    ]
    for name, pose in sim.truth.poses.items():
        assert_allclose(p.solution.poses[name], pose)


def test_ways_to_say_where_exposures_lie():
    offsets = np.array([[0, 0], [80, -30], [-50, 60.0]])
    stars = np.random.default_rng(0).uniform(100, 1900, (40, 2))
    by_shift = predict(n_exposures=3, stars=stars, sigma=0.1, dithers=offsets)
    named = {f"night{k}": np.column_stack([np.eye(2), shift]) for k, shift in enumerate(offsets)}
    by_pose = predict(n_exposures=3, stars=stars, sigma=0.1, poses=named)
    assert by_shift.b == by_pose.b
    assert by_pose.solution.names == ("night0", "night1", "night2")
    drawn = predict(n_exposures=200, n_stars=30, sigma=0.1, degree=0, dithers=120.0, n_grid=2)
    shifts = np.array([pose[:, 2] for pose in drawn.solution.poses.values()])
    assert np.sqrt(np.mean((shifts**2).sum(axis=1))) == pytest.approx(120, rel=0.1)


def test_ways_to_give_errors():
    rng = np.random.default_rng(0)
    stars, flux = rng.uniform(0, 2047, (40, 2)), rng.uniform(1e3, 1e5, 40)
    per_star = 30 / flux
    table = Table({"x": stars[:, 0], "y": stars[:, 1], "flux": flux, "x_err": per_star, "y_err": per_star})
    given = {"n_exposures": 4, "degree": 2}
    expected = predict(stars=stars, sigma=per_star, **given).solution.stars["x_err"].value
    for other in (predict(stars=table, **given), predict(stars=table, sigma=lambda f: 30 / f, **given)):
        assert_allclose(other.solution.stars["x_err"].value, expected)
    assert predict(stars=table, sigma=0.1, **given).sigma_meas == pytest.approx(0.1)
    per_exposure = predict(stars=stars, sigma=[[0.1], [0.1], [0.1], [10.0]], **given)
    three = predict(stars=stars, sigma=0.1, n_exposures=3, degree=2)
    assert per_exposure.b == pytest.approx(three.b, rel=0.02)  # an exposure that tells nothing
    worse = predict(stars=stars, sigma=np.stack([per_star, 3 * per_star], axis=-1)[None].repeat(4, 0), **given)
    assert np.median((worse.solution.stars["y_err"] / worse.solution.stars["x_err"]).value) == pytest.approx(3, rel=0.1)


def test_stars_on_few_exposures_are_left_out():
    offsets = np.array([[0, 0], [0, 0], [0, 0], [0, 0], [600.0, 0]])
    p = predict(n_exposures=5, density=50, sigma=0.1, dithers=offsets)
    assert p.solution.stars["n"].min() == 4
    more = predict(n_exposures=5, density=50, sigma=0.1, dithers=offsets, min_exposures=1)
    assert more.n_stars > p.n_stars
    assert p.stars_per_exposure[:4].mean() == pytest.approx(50, abs=20)


def test_maps_know_where_exposures_lie():
    p = predict(n_exposures=2, n_stars=60, sigma=0.1, dithers=[[500.0, 0], [-500.0, 0]], degree=1, n_grid=30)
    assert (len(p.x), len(p.y)) == (30, round(30 * 2048 / 3048))
    seen = np.isfinite(p.error_map[10])
    assert_allclose(p.x[seen][[0, -1]], [500, 1547], atol=110)
    assert p.sigma_field >= p.sigma


def test_prior_widths_serve_sparse_fields():
    prior = Prior(np.zeros((2, 10)), sigma=0.3)
    p = predict(n_exposures=5, n_stars=6, sigma=0.02, prior=prior)
    assert 0.02 < p.sigma < 0.5
    assert np.isfinite(p.b_abs)
    assert p.b_abs > p.b
    tight = predict(n_exposures=5, n_stars=6, sigma=0.02, prior=Prior(np.zeros((2, 10)), sigma=0.01))
    assert tight.sigma < p.sigma
    with pytest.raises(InputError, match="the widths of the prior state the scatter of the modes that are fitted"):
        predict(n_exposures=5, n_stars=6, sigma=0.02, prior=prior, dynamic=0.9)


def test_a_distorting_prior():
    static = Prior(np.random.default_rng(0).normal(0, 3, (2, 21)))
    plain, curved = (predict(n_exposures=5, n_stars=60, sigma=0.1, prior=prior) for prior in (None, static))
    assert curved.b == pytest.approx(plain.b, rel=0.05)
    assert curved.b != plain.b


def test_many_coefficients_are_approximated_and_it_is_said(monkeypatch):
    monkeypatch.setattr(covariances, "DENSE_LIMIT", 50)
    monkeypatch.setattr(reduced_system, "STAR_LIMIT", 50)
    with warns_here(AssumptionWarning, match=r"80 coefficients, 200 stars: .* errors of 50 stars solved exactly are"):
        p = predict(n_exposures=4, n_stars=200, sigma=0.1)
    assert p.sigma == pytest.approx(0.1 * p.thumb[1], rel=0.05)


# --- bad input ---------------------------------------------------------------------------------------------------

GOOD = {"n_exposures": 4, "n_stars": 40, "sigma": 0.1}


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"n_stars": 9}, SolveError, "exp00 has 9 stars, fewer than the 10 modes of degree 3: lower the degree"),
        ({"n_exposures": 1}, MatchError, "only one exposure"),
        ({"n_exposures": 2.5}, InputError, "n_exposures must be a positive integer, got 2.5"),
        ({"n_stars": 0}, InputError, "n_stars must be a positive integer, got 0"),
        ({"n_grid": 0}, InputError, "n_grid must be a positive integer, got 0"),
        ({"n_stars": None}, InputError, r"one of stars \(positions\), n_stars \(how many\) and density"),
        ({"density": 30}, InputError, r"one of stars \(positions\), n_stars \(how many\) and density"),
        ({"density": -1, "n_stars": None}, InputError, "density must be a positive number of stars a detector, got -1"),
        ({"sigma": None}, InputError, "sigma is needed: the error of one measured position"),
        ({"sigma": 0}, InputError, "sigma must be positive and finite everywhere, got 0"),
        ({"sigma": np.full(40, np.nan)}, InputError, "sigma must be positive and finite everywhere"),
        ({"sigma": np.ones(7)}, InputError, r"sigma must broadcast to \(4, 40\)"),
        ({"sigma": lambda flux: flux}, InputError, "stars is not a table with a column flux"),
        ({"degree": -1}, InputError, "degree must be an integer from 0 to 30, got -1"),
        ({"shape": 2048}, InputError, r"shape must be \(ny, nx\) of the detector, got 2048"),
        ({"shape": (0, 5)}, InputError, "ny in shape must be a positive integer, got 0"),
        ({"dithers": -5}, InputError, "dithers must be an rms length in pixels, or one shift .* got -5"),
        ({"dithers": np.zeros((3, 2))}, InputError, r"one shift for each exposure, shape \(4, 2\), got shape \(3, 2\)"),
        ({"poses": {"a": np.eye(2, 3)}}, InputError, "poses has 1 exposures, n_exposures is 4"),
        ({"poses": {}, "dithers": 5.0}, InputError, "poses and dithers both state where the exposures lie"),
        ({"poses": dict.fromkeys("abcd", np.ones((2, 3)))}, InputError, "pose of exposure 'a' is not a similarity"),
        ({"min_exposures": 5}, InputError, "min_exposures must be from 1 to the 4 exposures, got 5"),
        ({"prior": 3}, InputError, "prior must be a Prior, got int"),
        ({"dynamic": -1}, InputError, "dynamic holds standard deviations in pixels, finite and not negative, got -1"),
        ({"dynamic": np.ones(15)}, InputError, "dynamic states the scatter of the 10 modes that are fitted"),
        ({"dynamic": 1, "spectrum": {3: 1.0}}, InputError, "spectrum, beside it, that of degree 4 and more: leave one"),
        ({"spectrum": {99: 1.0}}, InputError, "a degree in spectrum must be an integer from 0 to 30, got 99"),
        ({"spectrum": {4: -1.0}}, InputError, "spectrum holds standard deviations"),
        ({"spectrum": np.ones(14)}, InputError, "n = 14 is not a number of modes"),
        ({"spectrum": np.ones((3, 15))}, InputError, r"spectrum must be a dict .* or \(2, n_modes\)"),
        ({"static_spectrum": {4: np.inf}}, InputError, "static_spectrum holds standard deviations"),
        ({"n_stars": None, "stars": np.zeros((0, 2))}, InputError, r"stars must be positions of shape \(n, 2\)"),
        ({"n_stars": None, "stars": [[1, np.nan]]}, InputError, "not finite in row 0"),
        ({"n_stars": None, "stars": Table({"x": [1]})}, InputError, "the table of stars has no column y; it has x"),
        ({"n_stars": None, "stars": np.full((20, 2), 9e4)}, InputError, "none of 20 stars lies on 4 or more"),
    ],
)  # fmt: skip
def test_bad_input_is_named(change, error, words):
    with pytest.raises(error, match=words):
        predict(**GOOD | change)


def test_a_plan_advises_what_a_plan_can_state():
    """No option of the command turns a camera or ties to a reference."""
    words = " ".join(str(predict(**GOOD | {"dynamic": 0.1})).split())
    assert "prior (--prior) or its size (--static-sigma), or, in Python, poses of a camera that is turned" in words
    assert "between exposures" not in words


def test_errors_of_a_solution_are_not_those_of_a_measurement():
    stars = predict(**GOOD).solution.stars
    with pytest.raises(InputError, match="errors of reference positions, not of single measurements: give sigma"):
        predict(n_exposures=4, stars=stars)
    assert predict(n_exposures=4, stars=stars, sigma=0.1).b == pytest.approx(predict(**GOOD).b)


# --- words and pictures ------------------------------------------------------------------------------------------


def test_prints_a_table():
    p = predict(**GOOD)
    assert repr(p) == f"<Prediction: 4 exposures, 40 stars, degree 3, b {p.b:.4f} px, sigma {p.sigma:.4f} px>"
    text = str(p)
    assert text.startswith(
        "Prediction: 4 exposures of 2048 x 2048 px, 40 stars (40 on each), degree 3, errors of 0.1 px"
    )
    assert "not known" in text
    assert "aliasing" not in text
    assert all(len(line) <= 110 for line in text.splitlines())
    more = str(predict(**GOOD, dynamic=0.5, spectrum={4: 0.1}, prior=Prior(np.zeros((2, 1)))))
    assert "not known" not in more
    assert "aliasing   together" in more
    with pytest.raises(AttributeError):
        p.b = 0


def test_what_was_asked_for_stays_as_it_was():
    settings = predict(**GOOD).settings
    assert (settings.n_exposures, settings.n_stars, settings.sigma) == (GOOD["n_exposures"], None, GOOD["sigma"])
    assert np.shape(settings.stars) == (GOOD["n_stars"], 2)  # those that were drawn
    assert repr(settings) == f"<Plan: {GOOD['n_exposures']} exposures, degree 3>"
    with pytest.raises(FrozenInstanceError):
        settings.degree = 2


@pytest.mark.slow
def test_relative_errors_do_not_depend_on_what_is_known_of_the_common_map():
    """Without a prior the assumed scatter makes the constraints; positions relative to one another do not change."""
    given = {"n_exposures": 11, "n_stars": 80, "sigma": 0.02, "degree": 3, "dithers": 200.0, "seed": 1}
    spectrum = {1: 0.5, 2: 0.4, 3: 0.2, 4: 0.05, 5: 0.02}
    nothing, scatter, all_of_it = predict(**given), predict(**given, dynamic=0.3), predict(**given, spectrum=spectrum)
    exact = predict(**given, spectrum=spectrum, prior=Prior(np.zeros((2, 1))))
    for plan in (scatter, all_of_it, exact):
        assert plan.b == pytest.approx(nothing.b, rel=0.02)
        stars, before = plan.solution.stars, nothing.solution.stars
        assert_allclose(stars["x_err"], before["x_err"], rtol=0.02)
        assert np.sqrt(np.mean(stars["x_err"].value ** 2)) < plan.b
    assert all_of_it.b_alias == pytest.approx(exact.b_alias, rel=0.02)
    assert all_of_it.b_abs > 1.5 * exact.b_abs


@pytest.mark.slow
def test_a_degree_higher_than_that_of_the_widths_of_a_prior():
    prior = Prior(np.zeros((2, 21)), sigma=0.3, static_sigma=0.01)
    table = predict(n_exposures=11, n_stars=80, sigma=0.02, prior=prior).alternatives()
    assert table.meta["failed"] == {}
    assert 4 in table["degree"]


@pytest.mark.slow
def test_alternatives():
    p = predict(n_exposures=8, n_stars=14, sigma=0.02, dynamic=0.4, dithers=40.0)
    table = p.alternatives()
    assert [tuple(row) for row in table["n_exposures", "degree"]] == [(8, 3), (8, 2), (4, 3), (16, 3)]
    assert table["b"][0] == p.b
    assert "14 stars, fewer than the 15 modes" in table.meta["failed"]["degree 4"]
    assert table["b_alias"][1] > 0.05  # degree 2 leaves the 0.4 px of degree 3 to be aliased
    assert table["b_alias"][0] == table["b_alias"][2] == 0
    assert np.all(table["n_stars"] == 14)
    unknown = predict(**GOOD).alternatives()
    assert np.isnan(unknown["b_alias"][1])  # nothing was said of degree 3
    fixed = predict(n_exposures=4, n_stars=40, sigma=np.full((4, 1), 0.1)).alternatives()
    assert set(fixed["n_exposures"]) == {4}


def test_plot():
    from matplotlib import pyplot

    p = predict(**GOOD, dithers=100.0, shape=(1024, 2048))
    ax = p.plot()
    assert ax.get_title(loc="left") == "Expected scatter: 4 exposures, 40 stars, degree 3"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [px]", "y [px]")
    square = ax.lines[-1].get_xydata()
    assert_allclose([square.min(axis=0), square.max(axis=0)], p.contour)
    assert p.plot(ax=ax) is ax
    pyplot.close("all")


def test_command(tmp_path, capsys):
    asked = ["predict", "--n-exposures", "6", "--sigma", "0.02", "--degree", "2", "--spectrum", "2=0.3,3=0.1"]
    assert main([*asked, "--n-stars", "30", "--plot", str(tmp_path / "map.png")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Prediction: 6 exposures of 2048 x 2048 px, 30 stars")
    assert sum(line.split()[:1] in (["3"], ["6"], ["12"]) for line in lines) == 5
    assert (tmp_path / "map.png").read_bytes()[1:4] == b"PNG"
    assert main([*asked, "--n-stars", "30", "--plot", str(tmp_path / "map.png")]) == 1
    assert "--overwrite" in capsys.readouterr().err
    table = Table({"name": np.arange(30), "x": np.linspace(10, 990, 30), "y": np.linspace(5, 700, 30) ** 2 % 800})
    table.write(tmp_path / "stars.ecsv")
    given = ["--stars", str(tmp_path / "stars.ecsv"), "--shape", "800", "1000", "--dither", "20", "--json"]
    assert main([*asked, *given]) == 0
    figures = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)  # no NaN
    p = predict(
        n_exposures=6, stars=table, sigma=0.02, degree=2, spectrum={2: 0.3, 3: 0.1}, shape=(800, 1000), dithers=20
    )
    assert figures["b"] == pytest.approx(p.b)
    assert figures["sigma_alias"] == pytest.approx(p.sigma_alias)
    assert [(row["n_exposures"], row["degree"]) for row in figures["alternatives"]] == [(6, 1), (6, 3), (3, 2), (12, 2)]
    assert main(["predict", "--n-exposures", "3", "--n-stars", "5", "--sigma", "0.02"]) == 1
    assert "5 stars, fewer than the 10 modes" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*asked, "--n-stars", "30", "--spectrum", "much"])
    assert "much is not of the form 3=0.9,4=0.1" in capsys.readouterr().err


# --- motions -----------------------------------------------------------------------------------------------------


def dense_motions(xy, years, sigma, dynamic, dithers, *, degree=2):
    """Errors of motions by a dense Fisher matrix, numpy alone: without a common map, and without a similarity.

    Unknowns are positions, motions, and coefficients of every exposure, which but for its similarity scatter about
    zero by `dynamic`.
    """
    n, orders = len(xy), [(k - j, j) for k in range(degree + 1) for j in range(k + 1)]
    m = len(orders)
    information = np.zeros((4 * n + len(years) * 2 * m,) * 2)
    similar = np.zeros((4, 2, m))
    similar[0, 0, 0] = similar[1, 1, 0] = similar[2, 0, 1] = similar[2, 1, 2] = similar[3, 1, 1] = 1
    similar[3, 0, 2] = -1
    similar = similar.reshape(4, -1) / np.linalg.norm(similar.reshape(4, -1), axis=1)[:, None]

    def series(q):
        along = [
            np.polynomial.legendre.legvander(w, degree) * np.sqrt((2 * np.arange(degree + 1) + 1) / 2)
            for w in ((2 * q + 1) / 2048 - 1).T
        ]
        return np.stack([along[0][:, a] * along[1][:, b] for a, b in orders], axis=1)

    for i, (year, dither) in enumerate(zip(years, dithers, strict=True)):
        own = 4 * n + 2 * m * i + np.arange(2 * m)
        for axis in range(2):
            rows = np.zeros((n, len(information)))
            rows[np.arange(n), axis * n + np.arange(n)] = 1
            rows[np.arange(n), (2 + axis) * n + np.arange(n)] = year - years.mean()
            rows[:, own.reshape(2, m)[axis]] = series(xy + dither)
            information += rows.T @ rows / sigma**2
        information[np.ix_(own, own)] += (np.eye(2 * m) - similar.T @ similar) / dynamic**2
    covariance = np.linalg.pinv(information, rcond=1e-13, hermitian=True)[2 * n : 4 * n, 2 * n : 4 * n]
    z, one = xy - xy.mean(axis=0), np.ones(n)
    turned = np.stack([np.r_[one, 0 * one], np.r_[0 * one, one], z.T.ravel(), np.r_[-z[:, 1], z[:, 0]]], axis=1)
    out = []
    for columns in (np.kron(np.eye(2), series(xy)), turned):
        basis_ = np.linalg.qr(columns)[0]
        left = np.eye(2 * n) - basis_ @ basis_.T
        out.append(np.sqrt(np.trace(left @ covariance @ left) / (2 * n)))
    return out


@pytest.mark.parametrize("dynamic", [0.1, 0.02])
def test_the_fisher_matrix_of_motions(dynamic):
    rng = np.random.default_rng(0)
    xy, dithers = rng.uniform(100, 1948, (40, 2)), rng.uniform(-90, 90, (9, 2))
    years = np.add.outer([2020.0, 2022.0, 2024.0], [0.0, 0.1, 0.2]).ravel()
    words = {"n_exposures": 9, "stars": xy, "sigma": 0.02, "degree": 2, "dithers": dithers, "epochs": years}
    plan = predict(**words, dynamic=dynamic, prior=Prior(np.zeros((2, 6)), shape=SHAPE))
    found = [plan.motion_errors[name] for name in ("motion", "motion_abs")]
    assert_allclose(found, dense_motions(xy, years, 0.02, dynamic, dithers), rtol=0.03)
    assert f"proper motions, absolute [px/yr]{found[1]:23.5f}" in str(plan)
    table = plan.alternatives()
    assert_allclose([table["motion_error"][0], table["motion_abs_error"][0]], found)
    assert "motion_abs_error" in describe_plans(table)


def test_absolute_motions_are_not_known_where_nothing_is_assumed_of_departures():
    words = {"n_stars": 40, "sigma": 0.02, "degree": 2, "epochs": [2020.0, 2020.1, 2022.0, 2022.1, 2024.0, 2024.1]}
    plan = predict(n_exposures=6, **words, dithers=100.0)
    assert np.isnan(plan.motion_errors["motion_abs"])
    assert np.isfinite(plan.motion_errors["motion"])
    assert any(line.split()[:3] + line.split()[-2:] == ["proper", "motions,", "absolute", "not", "known"]
               for line in str(plan).splitlines())  # fmt: skip
    assert "motion_abs_error" not in describe_plans(plan.alternatives())
