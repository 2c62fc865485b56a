"""Promises about errors: calibration, robustness, errors found on request, the gauge in words."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from caller_warnings import warns_here
from numpy.testing import assert_allclose

from legdistort import paper
from legdistort.exceptions import AssumptionWarning
from legdistort.geometry import similarity
from legdistort.geometry.distortion import Distortion
from legdistort.matching.matcher import match
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.results import accuracy, new_positions
from legdistort.simulation.observations import simulate_matches
from legdistort.solving import minimisers
from legdistort.solving.equations import criterion, reduced_system
from legdistort.solving.equations.problem import build_problem
from legdistort.solving.estimation import solve

RNG = np.random.default_rng


def carried(sim, solution, prior):
    """The truth in the gauge and at the poses of a solution: noise-free positions, minimised under its constraints.

    Returns positions (n_stars, 2) and fitted coefficients (n_exposures, 2 n_modes).
    """
    problem = build_problem(sim.matches, solution.degree, prior=prior)
    gauge = solution.gauge
    exact = np.empty_like(problem.xy)
    for i, name in enumerate(problem.names):
        part = problem.part(i)
        exact[:, part] = sim.truth.distort(name, sim.truth.positions[sim.matches.stars[problem.star[part]]]).T
    problem = type(problem)(**{**vars(problem), "xy": exact, "prior_sigma": None})
    fixed = np.stack([solution.poses[name] for name in solution.names])
    state = minimisers.State(solution.estimate.positions.T.copy(), solution.coefficients.copy(), fixed)
    for _ in range(6):
        blocks = criterion.linearise(problem, state)
        departure = (state.coefficients - problem.prior_mean)[:, :, : problem.n_modes].reshape(problem.n_exposures, -1)
        system = reduced_system.reduced_system(problem, blocks, gauge)
        d_star, d_exposure = system.step(-gauge.violation(departure), 1e-10)
        coefficients = state.coefficients.copy()
        coefficients[:, :, : problem.n_modes] += d_exposure.reshape(problem.n_exposures, 2, -1)
        state = minimisers.State(state.positions + d_star, coefficients, state.poses)
    departure = (state.coefficients - problem.prior_mean)[:, :, : problem.n_modes]
    assert np.abs(gauge.violation(departure)).max() < 1e-6
    return state.positions.T, departure.reshape(problem.n_exposures, -1)


def normalised(difference, covariance):
    """chi2 of a difference under a singular covariance, and its rank."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-9 * values[-1]
    return np.sum((vectors[:, keep].T @ difference) ** 2 / values[keep]), np.count_nonzero(keep)


SETTINGS = {
    "simulation 1": ({}, {}),
    "dithered, unequal errors": (
        {"dither": 150.0, "n_stars": 40, "sigma": RNG(0).uniform(0.03, 0.25, (10, 40, 2)), "corr": 0.3}, {}
    ),
    "with prior": ({"zero_mean": False, "n_stars": 14}, {"sigma": 0.9}),
}  # fmt: skip


@pytest.mark.parametrize(
    ("n_sets", "tolerance"),
    [pytest.param(50, 0.1, marks=pytest.mark.slow), pytest.param(200, 0.05, marks=pytest.mark.sets)],
)
@pytest.mark.parametrize("setting", SETTINGS)
def test_covariances_are_calibrated(setting, n_sets, tolerance):
    """Over 200 realisations the mean chi2 of (estimate - truth) is its degrees of freedom within 5 %, of 50 10 %."""
    settings, widths = SETTINGS[setting]
    stars, coefficients, maps = [], [], []
    for seed in range(n_sets):
        sim = simulate_matches(seed=seed, **settings)
        prior = Prior(sim.truth.static, **widths)
        solution = solve(sim.matches, prior=prior)
        positions, a = carried(sim, solution, prior)
        a += solution.estimate.prior_mean[:, :, : a.shape[1] // 2].reshape(len(a), -1)
        n = len(positions)
        covariance = solution.estimate.uncertainty.star_matrix
        chi2, rank = normalised((solution.estimate.positions - positions).T.ravel(), covariance)
        stars.append(chi2 / rank)
        assert rank <= 2 * n
        departure = solution.coefficients.reshape(len(a), -1) - a
        chi2, rank = normalised(departure.ravel(), solution.estimate.uncertainty.coefficients)
        coefficients.append(chi2 / rank)
        for name, mine in zip(solution.names, a, strict=True):
            ny, nx = solution.estimate.shapes[name]
            grid = np.stack(np.meshgrid(*[np.linspace(-0.5, n - 0.5, 6) for n in (nx, ny)]), axis=-1).reshape(-1, 2)
            grid = grid[solution[name].supported(grid)]
            true = similarity.apply(
                similarity.invert(solution.poses[name]),
                Distortion(mine.reshape(2, -1), solution.estimate.shapes[name]).invert(grid),
            )
            by_modes = new_positions.response(solution[name], solution[name].distortion.invert(grid))[0]
            # under the constraints of the gauge, like the truth
            covariance = new_positions.carried(by_modes, solution[name].covariance)
            maps.append((solution[name].correct(grid) - true) ** 2 / np.einsum("naa->na", covariance))
    means = {"stars": np.mean(stars), "coefficients": np.mean(coefficients), "map": np.mean(np.concatenate(maps))}
    assert means == pytest.approx(dict.fromkeys(means, 1), abs=tolerance)


def precise(seed, **settings):
    """Positions good to 0.01 px under a static distortion of 5 px that nobody told."""
    return simulate_matches(seed=seed, sigma=0.01, static=5.0, dither=250.0, n_stars=60, **settings)


@pytest.mark.parametrize("method", ["direct", "iterative"])
def test_what_residuals_determine_is_left_to_them(monkeypatch, method):
    """No convention costs chi2 where positions are precise enough to contradict it: J ends at its minimum."""
    if method == "iterative":
        monkeypatch.setattr(reduced_system, "uses_direct", lambda problem: False)
    sim = precise(1)
    solution = solve(sim.matches)
    assert [each.name for each in solution.gauge.unknown] == ["shear", "shear"]
    assert abs(solution.chi2 - solution.dof) < 5 * np.sqrt(2 * solution.dof)
    true = sim.truth.positions[solution.estimate.star_names]
    # maps of the gauge are cubics of cubics here, so a common map of higher degree is taken out
    b, bound = accuracy.bias(solution.estimate.positions, true, removed=6), accuracy.expected_bias(solution, removed=6)
    assert b == pytest.approx(bound, rel=0.25)


@pytest.mark.slow
def test_understated_errors_do_not_contradict_the_convention():
    """At the observed scale the convention stands, whatever the stated errors claim."""
    sim = simulate_matches(seed=2, sigma=0.1, dither=250.0, n_stars=60)
    table = sim.matches.table.copy()
    table["x_err"] /= 20
    table["y_err"] /= 20
    matches = Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
    solution = solve(matches, prior=Prior(sim.truth.static))
    assert solution.chi2 > 300 * solution.dof
    assert solution.gauge.released is None


@pytest.mark.parametrize(
    "seeing", [pytest.param({"dither": 50.0, "dynamic": 0.01}, marks=pytest.mark.slow), {"dither": 0.0, "dynamic": 0.1}]
)
def test_a_large_static_distortion_is_no_misfit(seeing):
    """10 px in all exposures, 0.1 to 1.5 px in which they differ, positions good to 0.01 px."""
    solution = solve(simulate_matches(seed=1, sigma=0.01, static=10.0, n_stars=300, **seeing).matches)
    assert abs(solution.chi2 - solution.dof) < 5 * np.sqrt(2 * solution.dof)


def imperfect(seed):
    """Small distortions, a trace of them above the degree that is fitted, and errors understated by a quarter."""
    spread = np.where(np.arange(15) < 10, 0.1, 0.03)
    sim = simulate_matches(seed=seed, n_stars=400, n_exposures=6, degree=4, static=0.0, dynamic=spread, sigma=0.1,
                           zero_mean=False, dither=250.0, shape=(1000, 1000))  # fmt: skip
    table = sim.matches.table.copy()
    table["x_err"] *= 0.75
    table["y_err"] *= 0.75
    return Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)


def rms_distortion(solution):
    """Per axis, over detectors and exposures, shifts aside; modes have mean square 1/4."""
    return np.sqrt(np.mean(np.sum(solution.coefficients[:, :, 1:] ** 2, axis=2)) / 4)


@pytest.mark.parametrize("seed", [5, 14])
@pytest.mark.parametrize("direct", [True, False])
def test_what_residuals_hardly_determine_stays_with_the_convention(monkeypatch, seed, direct):
    """What is not in the model looks like a map of 15 px, by more than five standard errors."""
    monkeypatch.setattr(reduced_system, "uses_direct", lambda problem: direct)
    solution = solve(imperfect(seed), degree=3)
    assert 1.6 < solution.chi2 / solution.dof < 2
    assert solution.gauge.released is None
    assert rms_distortion(solution) < 0.2  # 0.15 of the truth, plus noise


@pytest.mark.sets
def test_real_frames_of_one_telescope_have_one_scale(microobservatory):
    """Similarities between these frames leave 0.1 to 0.2 px, and their scales agree to 0.0005."""
    exposures, detections = microobservatory
    matches = match(detections, exposures=exposures, min_exposures=4)
    for degree in (2, 3, 4, 5):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AssumptionWarning)  # a star that contradicts itself
            solution = solve(matches, degree=degree)
        scales = [np.sqrt(np.linalg.det(pose[:, :2])) for pose in solution.poses.values()]
        # at degree 2 the small turns between the frames determine z^2, to less than the 1 px that counts as unknown;
        # what there is of degree 3 (chi2 falls with it) goes into the scales
        assert_allclose(scales, 1, rtol=0, atol=0.002 if degree == 2 else 0.0007)
        assert rms_distortion(solution) < 1.0


@pytest.mark.parametrize(
    ("n_sets", "tolerance"),
    [pytest.param(50, 0.2, marks=pytest.mark.slow), pytest.param(200, 0.1, marks=pytest.mark.sets)],
)
def test_absolute_errors_are_right(n_sets, tolerance):
    """Absolute errors, apart from the pointing, against independent dynamic parts whose mean does not vanish."""
    measured, reported = [], []
    for seed in range(n_sets):
        sim = simulate_matches(seed=seed, zero_mean=False, dither=100.0, sigma=0.05, n_stars=60)
        solution = solve(sim.matches, prior=Prior(sim.truth.static))
        true = sim.truth.positions[solution.estimate.star_names]
        measured.append(accuracy.bias(solution.estimate.positions, true, removed="similarity"))
        reported.append(accuracy.expected_bias(solution, removed="similarity", absolute=True))
    ratio = np.sqrt(np.mean(np.square(measured)) / np.mean(np.square(reported)))
    assert ratio == pytest.approx(1, abs=tolerance)


def test_simulation_1_is_at_the_bound():
    """b of 20 seeds at sigma / sqrt(n_im), scatter of new points at the expected figure (paper, Simulation 1)."""
    b, sigma = [], []
    grid = np.stack(np.meshgrid(*[np.linspace(0.1 * 2048, 0.9 * 2048, 50) - 0.5] * 2), axis=-1).reshape(-1, 2)
    for seed in range(20):
        sim = simulate_matches(seed=seed)
        solution = solve(sim.matches, prior=Prior(sim.truth.static))
        b.append(accuracy.bias(solution.estimate.positions, sim.truth.positions[solution.estimate.star_names]))
        rng = RNG(1000 + seed)
        corrected = np.stack([
            solution[name].correct(sim.truth.distort(name, grid) + 0.14 * rng.normal(size=grid.shape))
            for name in solution.names
        ])  # fmt: skip
        sigma.append(np.sqrt(np.mean(accuracy.scatter(corrected) ** 2)))
    assert np.sqrt(np.mean(np.square(b))) == pytest.approx(0.044, abs=0.004)
    assert np.sqrt(np.mean(np.square(sigma))) == pytest.approx(0.157, abs=0.010)


def _with_mismatches(seed, fraction):
    sim = simulate_matches(n_stars=80, seed=seed, dither=100.0)
    table = sim.matches.table.copy()
    rng = RNG(seed)
    wrong = rng.random(len(table)) < fraction
    angle, size = rng.uniform(0, 2 * np.pi, wrong.sum()), rng.uniform(1, 50, wrong.sum())
    table["x"][wrong] += size * np.cos(angle) * u.pix
    table["y"][wrong] += size * np.sin(angle) * u.pix
    return sim, table, wrong


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* no position, the observations contradict one another")
def test_gross_mismatches_cost_nothing():
    """10 % of the positions off by up to 50 px: within 5 % of the data with these taken out by hand."""
    with_them, without = [], []
    for seed in range(6):
        sim, table, wrong = _with_mismatches(seed, 0.1)
        prior, nominal = Prior(sim.truth.static), sim.matches.poses
        clipped = solve(Matches.from_table(table, shape=(2048, 2048), poses=nominal), prior=prior, clip=5)
        clean = solve(Matches.from_table(table[~wrong], shape=(2048, 2048), poses=nominal), prior=prior)
        assert not np.any(clipped.residuals["used"] & wrong)
        for solution, out in ((clipped, with_them), (clean, without)):
            out.append(accuracy.bias(solution.estimate.positions, sim.truth.positions[solution.estimate.star_names]))
    ratio = np.sqrt(np.mean(np.square(with_them)) / np.mean(np.square(without)))
    assert ratio == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("known_poses", [True, False])
def test_mismatched_exposure_is_named_and_moves_nobody(known_poses):
    sim = simulate_matches(seed=1, n_stars=40, dither=100.0)
    table = sim.matches.table.copy()
    mine = np.flatnonzero(table["exposure"] == "exp03")
    order = RNG(1).permutation(len(mine))
    for column in ("x", "y"):
        table[column][mine] = table[column][mine][order]
    nominal = sim.matches.poses if known_poses else None
    prior = Prior(sim.truth.static)
    with warns_here(AssumptionWarning, match="exposure exp03 is left out: .*mismatched"):
        solution = solve(Matches.from_table(table, shape=(2048, 2048), poses=nominal), prior=prior, clip=5)
    assert list(solution.left_out) == ["exp03"]
    assert "mismatched" in solution.left_out["exp03"]
    clean = solve(
        Matches.from_table(table[table["exposure"] != "exp03"], shape=(2048, 2048), poses=sim.matches.poses),
        prior=prior,
    )
    error = np.sqrt(np.diag(clean.estimate.uncertainty.coefficients)).reshape(len(clean.names), 2, -1)
    assert np.all(np.abs(solution.coefficients - clean.coefficients) < error)


@pytest.mark.slow
def test_one_noisy_exposure_does_not_blur_the_others():
    """One of ten exposures with 100 x the errors costs what its data are worth, not more than 10 % beyond."""
    b, b_without = [], []
    for seed in range(20):
        sigma = np.full((10, 30), 0.14)
        sigma[4] *= 100
        dynamic = RNG(seed).normal(0, 0.9, (10, 2, 10))
        sim = _quiet_exposure(seed, sigma, dynamic, 4)
        table = sim[0].table
        solution = solve(sim[0], prior=Prior(np.zeros((2, 10))))
        b.append(accuracy.bias(solution.estimate.positions, sim[1][solution.estimate.star_names]))
        others = table[table["exposure"] != "e4"]
        without = solve(
            Matches.from_table(others, shape=(2048, 2048), poses=sim[0].poses), prior=Prior(np.zeros((2, 10)))
        )
        b_without.append(accuracy.bias(without.estimate.positions, sim[1][without.estimate.star_names]))
    assert np.sqrt(np.mean(np.square(b)) / np.mean(np.square(b_without))) < 1.1


def _quiet_exposure(seed, sigma, dynamic, quiet):
    """Ten exposures around no static distortion, one without dynamic part, those of the others summing to zero."""
    from astropy.table import Table
    from oracle import predict

    dynamic[quiet] = 0
    others = np.arange(10) != quiet
    dynamic[others] -= dynamic[others].mean(axis=0)
    rng = RNG(seed + 500)
    true = rng.uniform(0, 2047, (30, 2))
    rows = []
    for i in range(10):
        xy = predict(true, dynamic[i], np.eye(2, 3), (2048, 2048)) + sigma[i][:, None] * rng.normal(size=(30, 2))
        rows += [(f"e{i}", j, *xy[j], sigma[i, j], sigma[i, j]) for j in range(30)]
    table = Table(rows=rows, names=["exposure", "star", "x", "y", "x_err", "y_err"])
    nominal = {f"e{i}": np.eye(2, 3) for i in range(10)}
    return Matches.from_table(table, shape=(2048, 2048), poses=nominal), true


def test_errors_found_on_request():
    sim = simulate_matches(sigma=0.1, seed=1, n_stars=60)
    table = sim.matches.table.copy()
    rng = RNG(0)
    for axis in "xy":  # a systematic that the stated errors do not know
        table[axis] += 0.1 * rng.normal(size=len(table)) * u.pix
    matches = Matches.from_table(table, shape=(2048, 2048), poses=sim.matches.poses)
    prior = Prior(sim.truth.static)
    stated, scaled, floored = (solve(matches, prior=prior, errors=kind) for kind in ("stated", "scale", "floor"))
    assert stated.diagnostics.error_scale == 1
    assert scaled.diagnostics.error_scale == pytest.approx(np.sqrt(stated.chi2 / stated.dof))
    assert_allclose(
        scaled.estimate.uncertainty.stars, stated.estimate.uncertainty.stars * scaled.diagnostics.error_scale**2
    )
    assert floored.diagnostics.error_floor == pytest.approx(0.1, abs=0.01)
    assert floored.chi2 / floored.dof == pytest.approx(1, abs=0.01)
    quiet = solve(sim.matches, prior=prior, errors="floor")
    assert quiet.diagnostics.error_floor == 0 or quiet.diagnostics.error_floor < 0.03


def test_gauge_states_what_determines_what():
    sim = simulate_matches(seed=1)
    prior = Prior(sim.truth.static, static_sigma=0.05)
    text = str(solve(sim.matches, prior=prior).gauge)
    for words in ("20 modes, 6 of them exactly", "shift, rotation, scale", "nominal poses", "shear", "degree 3",
                  "smallest dynamic part", "uncertainty of the static distortion"):  # fmt: skip
        assert words in text
    assert "prior widths" in str(solve(sim.matches, prior=Prior(sim.truth.static, sigma=0.9)).gauge)
    assert "sum to zero" in str(paper.solve(sim.matches, prior=prior).gauge)


def test_static_uncertainty_does_not_average_down():
    sim = simulate_matches(seed=1)
    tight = solve(sim.matches, prior=Prior(sim.truth.static))
    loose = solve(sim.matches, prior=Prior(sim.truth.static, static_sigma=[0, 0, 0] + [0.3] * 7))
    assert_allclose(
        loose.estimate.uncertainty.stars, tight.estimate.uncertainty.stars, rtol=1e-3, atol=1e-7
    )  # in nearly the same gauge
    added = np.einsum("nkk->nk", loose.absolute_covariance() - tight.absolute_covariance())
    # 7 modes of 0.3 px, each of mean square 1/4 over the field
    assert np.mean(added) == pytest.approx(7 * 0.3**2 / 4, rel=0.35)
