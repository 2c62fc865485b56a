"""Laws of the joint solution, and its agreement with the dense oracle and with the published scheme."""

import dataclasses
import inspect

import numpy as np
import pytest
from astropy import units as u
from caller_warnings import warns_here
from numpy.testing import assert_allclose
from oracle import DenseOracle, predict

from legdistort.exceptions import AssumptionWarning, InputError, SolveError
from legdistort.geometry import similarity
from legdistort.geometry.detector_modes import similarity_part
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.runtime.checks import options_from
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving import start_values
from legdistort.solving.equations import criterion, reduced_system
from legdistort.solving.equations.problem import State, build_problem
from legdistort.solving.estimation import solve
from legdistort.solving.options import SolveOptions

RNG = np.random.default_rng


def small(*, seed=1, **settings):
    """A set that the dense oracle can take: 14 stars, 4 exposures, degree 2, unequal axes, turned, oblong detector."""
    defaults = {
        "n_stars": 14,
        "n_exposures": 4,
        "degree": 2,
        "shape": (700, 1200),
        "sigma": RNG(seed).uniform(0.02, 0.2, (4, 14, 2)),
        "dither": 60.0,
        "rotations": [0.0, 3.0, -8.0, 1.0],
        "static": 1.0,
        "dynamic": 0.5,
        "seed": seed,
    }
    return simulate_matches(**(defaults | settings))


def table_of(sim):
    return sim.matches.table.copy()


@pytest.mark.parametrize(
    "settings",
    [
        {},
        pytest.param({"corr": 0.6}, marks=pytest.mark.slow),
        pytest.param({"rotations": [0, 90, 180, 270]}, marks=pytest.mark.slow),
        {"flips": [0, 1, 0, 1]},
    ],
)
def test_joint_is_the_dense_oracle(settings):
    sim = small(**settings)
    solution = solve(sim.matches, degree=2, prior=Prior(sim.truth.static))
    oracle = DenseOracle(sim.matches, solution, sim.truth.static)
    dense = oracle.solve()
    positions, coefficients = oracle.unpack(dense.x)
    assert_allclose(solution.chi2, np.sum(oracle.residuals(dense.x) ** 2), rtol=1e-7)
    assert_allclose(solution.estimate.positions, positions, atol=2e-5)
    assert_allclose(solution.coefficients, coefficients, atol=5e-5)
    covariance = oracle.covariance(dense.x)
    n = 2 * len(positions)
    assert_allclose(solution.estimate.uncertainty.coefficients, covariance[n:, n:], rtol=2e-4, atol=1e-7)
    xx, yy, xy = solution.estimate.uncertainty.stars
    assert_allclose(xx, np.diag(covariance)[0:n:2], rtol=2e-4)
    assert_allclose(yy, np.diag(covariance)[1:n:2], rtol=2e-4)
    assert_allclose(xy, np.diag(covariance, 1)[0:n:2], rtol=2e-4, atol=1e-9)


def test_model_is_the_published_formula():
    sim = small()
    solution = solve(sim.matches, degree=2, prior=Prior(sim.truth.static))
    for i, name in enumerate(solution.names):
        expected = predict(
            solution.estimate.positions, solution.coefficients[i], solution.poses[name], solution.estimate.shapes[name]
        )
        on = np.isfinite(solution[name].distort(solution.estimate.positions)).all(axis=1)
        assert_allclose(solution[name].distort(solution.estimate.positions)[on], expected[on], atol=1e-9)
    rows = solution.residuals
    for name in solution.names:
        mine = rows[rows["exposure"] == name]
        place = solution.estimate.positions[np.searchsorted(solution.estimate.star_names, mine["star"])]
        i = solution.names.index(name)
        left = np.column_stack([mine["x"].value, mine["y"].value]) - predict(
            place, solution.coefficients[i], solution.poses[name], solution.estimate.shapes[name]
        )
        assert_allclose(np.column_stack([mine["dx"].value, mine["dy"].value]), left, atol=1e-9)


def test_jacobian_is_the_finite_difference():
    sim = small(corr=0.3)
    problem = build_problem(sim.matches, 2, prior=Prior(sim.truth.static))
    state, _ = start_values.start(problem, np.stack([sim.matches.poses[n] for n in sim.matches.names]))
    blocks = criterion.linearise(problem, state)

    def cost(positions, coefficients):
        moved = State(positions, coefficients, state.poses)
        return criterion.linearise(problem, moved).chi2

    for axis, star in ((0, 3), (1, 7)):
        up, down = state.positions.copy(), state.positions.copy()
        up[axis, star] += 1e-4
        down[axis, star] -= 1e-4
        slope = (cost(up, state.coefficients) - cost(down, state.coefficients)) / 2e-4
        assert_allclose(slope, -2 * blocks.g_star[axis, star], rtol=1e-5)
    for exposure, axis, mode in ((0, 0, 4), (3, 1, 2)):
        up, down = state.coefficients.copy(), state.coefficients.copy()
        up[exposure, axis, mode] += 1e-4
        down[exposure, axis, mode] -= 1e-4
        slope = (cost(state.positions, up) - cost(state.positions, down)) / 2e-4
        assert_allclose(slope, -2 * blocks.g_exposure[exposure].reshape(2, -1)[axis, mode], rtol=1e-5)


def test_conjugate_gradients_give_the_direct_answer(monkeypatch):
    sim = small(n_exposures=7, n_stars=40, sigma=0.05, rotations=None, seen=0.8, min_exposures=3)
    direct = solve(sim.matches, degree=2, prior=Prior(sim.truth.static))
    monkeypatch.setattr(reduced_system, "uses_direct", lambda problem: False)
    iterative = solve(sim.matches, degree=2, prior=Prior(sim.truth.static))
    # the scatter of exposures, which weighs in the gauge, is found by iterations of its own
    assert_allclose(iterative.estimate.positions, direct.estimate.positions, atol=1e-5)
    assert_allclose(iterative.coefficients, direct.coefficients, atol=1e-5)


def test_poses_carry_the_similarities():
    sim = small(pose_error=15.0)
    solution = solve(sim.matches, degree=2, prior=Prior(sim.truth.static))
    for i, name in enumerate(solution.names):
        part = similarity_part(solution.coefficients[i] - sim.truth.static, solution.estimate.shapes[name])
        corner = np.array([[0.0, 0.0], [1199.0, 699.0]])
        assert np.abs(similarity.apply(part, corner) - corner).max() < 1e-3


def test_poses_are_a_convention():
    """Where headers are off, what is observable stays: chi2, and positions after a common similarity."""
    sim = simulate_matches(seed=5, dither=150.0)
    prior = Prior(sim.truth.static)
    right = solve(sim.matches, prior=prior)
    rng = RNG(0)
    nominal = {name: pose + [[0, 0, rng.normal() * 15], [0, 0, rng.normal() * 15]]
               for name, pose in sim.matches.poses.items()}  # fmt: skip
    off = solve(Matches.from_table(table_of(sim), shape=(2048, 2048), poses=nominal), prior=prior)
    blind = solve(Matches.from_table(table_of(sim), shape=(2048, 2048)), prior=prior)
    for other in (off, blind):
        assert_allclose(other.chi2, right.chi2, rtol=1e-6)
        assert accuracy.bias(other.estimate.positions, right.estimate.positions, removed="similarity") < 2e-3


def test_mean_of_corrected_positions_is_the_reference_position():
    """The paper's section 3.3: equal to a few 1e-3 px."""
    sim = simulate_matches(seed=4)
    solution = solve(sim.matches, prior=Prior(sim.truth.static))
    mean = np.nanmean(accuracy.corrected_positions(solution), axis=0)
    assert np.abs(mean - solution.estimate.positions).max() < 3e-3


def test_permutation_changes_nothing():
    sim = small()
    table = table_of(sim)
    shuffled = table[RNG(0).permutation(len(table))]
    shuffled["star"] = np.array([f"s{99 - star:02d}" for star in shuffled["star"]])
    prior = Prior(sim.truth.static)
    first = solve(sim.matches, degree=2, prior=prior)
    second = solve(Matches.from_table(shuffled, shape=(700, 1200), poses=sim.matches.poses), degree=2, prior=prior)
    assert_allclose(second.estimate.positions[::-1], first.estimate.positions, atol=1e-7)
    order = [second.names.index(name) for name in first.names]
    assert_allclose(second.coefficients[order], first.coefficients, atol=1e-7)


def test_halved_errors_quarter_the_covariance():
    sim = small()
    table = table_of(sim)
    for column in ("x_err", "y_err"):
        table[column] = table[column] / 2
    whole = solve(sim.matches, degree=2)
    half = solve(Matches.from_table(table, shape=(700, 1200), poses=sim.matches.poses), degree=2)
    # the gauge weighs the scatter against the errors, so only what is free of it scales to the letter
    full = accuracy.expected_bias(whole, removed=2)
    assert_allclose(accuracy.expected_bias(half, removed=2), full / 2, rtol=1e-3)
    assert_allclose(half.chi2, 4 * whole.chi2, rtol=1e-3)


def test_an_exposure_of_infinite_error_changes_nothing():
    sim = simulate_matches(n_exposures=6, seed=6)
    table = table_of(sim)
    last = table["exposure"] == sim.matches.names[-1]
    for column in ("x_err", "y_err"):
        table[column][last] *= 1e6
    prior = Prior(sim.truth.static)
    with_it = solve(Matches.from_table(table, shape=(2048, 2048), poses=sim.matches.poses), prior=prior)
    without = solve(Matches.from_table(table[~last], shape=(2048, 2048), poses=sim.matches.poses), prior=prior)
    assert_allclose(with_it.estimate.positions, without.estimate.positions, atol=1e-3)


def test_prior_of_higher_degree_keeps_its_upper_modes():
    sim = simulate_matches(degree=4, dynamic=[0.5] * 10 + [0.0] * 5, seed=8, n_stars=60)
    solution = solve(sim.matches, degree=3, prior=Prior(sim.truth.static))
    assert solution.coefficients.shape == (10, 2, 15)
    assert_allclose(solution.coefficients[:, :, 10:], np.broadcast_to(sim.truth.static[:, 10:], (10, 2, 5)))
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=5 * np.sqrt(2 / solution.dof))


@pytest.mark.parametrize(("degree", "said"), [({}, True), ({"degree": 3}, False)])
def test_what_the_default_degree_leaves_of_a_prior_is_said(caplog, degree, said):
    sim = simulate_matches(degree=4, seed=8, n_stars=60)
    with caplog.at_level("INFO"):
        solve(sim.matches, prior=Prior(sim.truth.static, static_sigma=0.01), **degree)
    words = (
        "fitted to degree 3, the default: what the prior has beyond, up to degree 4, is held as given; degree=4 (--deg"
    )
    assert (words in caplog.text) == said


def test_prior_width_makes_sparse_fields_solvable():
    sim = simulate_matches(n_stars=8, n_exposures=12, seed=9)
    with pytest.raises(SolveError, match=r"exp00 has 8 stars, fewer than the 10 modes .*: .*at most 2 here.*--prior F"):
        solve(sim.matches)
    # whoever has a prior is told what that one lacks, and with it there is a solution
    with pytest.raises(SolveError, match=r"exp00 has 8 stars, .*give the prior a finite sigma.*--prior-sigma evidence"):
        solve(sim.matches, prior=Prior(sim.truth.static))
    solution = solve(sim.matches, prior=Prior(sim.truth.static, sigma="evidence"))
    assert accuracy.bias(solution.estimate.positions, sim.truth.positions[solution.estimate.star_names]) < 0.3
    solution = solve(sim.matches, prior=Prior(sim.truth.static, sigma=0.9))
    assert accuracy.bias(solution.estimate.positions, sim.truth.positions[solution.estimate.star_names]) < 0.3


def test_clipping_finds_gross_outliers():
    sim = simulate_matches(n_stars=60, seed=10)
    table = table_of(sim)
    wrong = RNG(1).choice(len(table), len(table) // 20, replace=False)
    table["x"][wrong] += RNG(2).choice([-1, 1], len(wrong)) * RNG(3).uniform(5, 50, len(wrong)) * u.pix
    matches = Matches.from_table(table, shape=(2048, 2048), poses=sim.matches.poses)
    clipped = solve(matches, prior=Prior(sim.truth.static), clip=5)
    clean = solve(
        Matches.from_table(table[np.setdiff1d(np.arange(len(table)), wrong)], shape=(2048, 2048),
                           poses=sim.matches.poses), prior=Prior(sim.truth.static))  # fmt: skip
    assert set(wrong) <= set(np.flatnonzero(~clipped.residuals["used"]))
    assert np.count_nonzero(~clipped.residuals["used"]) <= len(wrong) + 3
    assert accuracy.bias(clipped.estimate.positions, clean.estimate.positions) < 0.02


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_robust_losses_resist_outliers(loss):
    sim = simulate_matches(n_stars=60, seed=11)
    table = table_of(sim)
    wrong = RNG(1).choice(len(table), len(table) // 30, replace=False)
    table["y"][wrong] += 20 * u.pix
    matches = Matches.from_table(table, shape=(2048, 2048), poses=sim.matches.poses)
    true = sim.truth.positions
    prior = Prior(sim.truth.static)
    assert accuracy.bias(solve(matches, prior=prior, loss=loss, clip=None).estimate.positions, true) < 0.12
    assert accuracy.bias(solve(matches, prior=prior, clip=None).estimate.positions, true) > 0.3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"degree": -1}, "degree must be an integer from 0 to 30, got -1"),
        ({"degree": 2.5}, r"degree must be an integer from 0 to 30, got 2\.5"),
        ({"gauge": "free"}, "gauge must be one of 'minimal', got 'free'"),
        ({"method": "magic"}, "method must be one of 'joint', got 'magic'"),
        ({"loss": "l1"}, "loss must be one of 'linear', 'huber', 'cauchy', got 'l1'"),
        ({"clip": 0}, "clip must be a number of standard errors above 1, got 0"),
        ({"error_floor": -0.1}, r"error_floor must be a finite number of pixels, 0 or more, got -0\.1"),
        (
            {"gauge": "mean"},
            r"gauge='mean' is that of the published method, which legdistort\.paper\.solve has",
        ),
        ({"method": "alternating"}, r"method='alternating' is that of the published method, which legdistort\.paper"),
        ({"prior": 3}, "prior must be a Prior or a dict of them, got int"),
        ({"prior": "gsaoi-2"}, r"got 'gsaoi-2': give Prior\.from_file\('gsaoi-2'\)"),
    ],
)
def test_bad_options_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        solve(simulate_matches().matches, **arguments)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"order": 9},
            r"^solving has no option 'order'; it takes degree, prior, model, .*validate, pixel_scale$",
        ),
        ({"errors": "floor", "error_floor": 0.1}, "^solving: errors='floor' finds the error floor itself"),
        ({"static": "fit", "exposure_degree": 3}, "^solving: static='fit' shares the modes above exposure_degree=3"),
        ({"degree": "high"}, "^solving: degree must be an integer or 'auto', got 'high'"),
        ({"prior": 3}, "^solving: prior must be a Prior or a dict of them, got int"),
        ({"model": 3}, "^solving: model must be one astropy model .*, got 3"),
        ({"validate": 0.7}, "^solving: validate must be a fraction"),
        ({"max_iterations": 0}, "^solving: max_iterations must be a positive integer, got 0"),
    ],
)
def test_options_are_judged_without_data(given, message):
    with pytest.raises(InputError, match=message):
        options_from(SolveOptions, given, "solving")


def test_options_are_the_arguments_and_frozen():
    """Those of `solve`, at the same defaults, but for what concerns the reference and the progress bar."""
    arguments = inspect.signature(solve).parameters
    for field in dataclasses.fields(SolveOptions):
        assert arguments[field.name].default == field.default
    assert set(arguments) - {f.name for f in dataclasses.fields(SolveOptions)} == {
        "matches", "base", "reference", "reference_error", "reference_degree", "epoch", "progress",
    }  # fmt: skip
    with pytest.raises(dataclasses.FrozenInstanceError):
        SolveOptions().degree = 4


def test_an_exposure_left_out_is_told_once():
    """However many fits it takes: the widths are found in several."""
    sim = simulate_matches(n_stars=40, n_exposures=6, degree=2, dynamic=0.5, seed=3)
    table = table_of(sim)
    astray = table["exposure"] == "exp02"
    table["x"][astray] = np.random.default_rng(0).permutation(table["x"][astray].value) * u.pix
    matches = Matches.from_table(table, shape=(2048, 2048), poses=sim.matches.poses)
    with warns_here(AssumptionWarning, match="exposure exp02 is left out: ") as caught:
        solution = solve(matches, degree=2, prior=Prior(sim.truth.static, sigma="evidence"), clip=5)
    assert list(solution.left_out) == ["exp02"]
    assert len(caught) == 1


def test_undetermined_problem_names_the_exposure():
    sim = simulate_matches(n_stars=12, degree=1, seed=1)
    table = table_of(sim)
    first = table["exposure"] == "exp00"
    # all stars on a circle: a quadratic mode is constant there
    angle = 2 * np.pi * np.asarray(table["star"][first]) / 12
    table["x"][first], table["y"][first] = (1000 + 800 * np.array([np.cos(angle), np.sin(angle)])) * u.pix
    for i in range(1, 10):
        on = table["exposure"] == f"exp{i:02d}"
        table["x"][on], table["y"][on] = table["x"][first], table["y"][first]
    matches = Matches.from_table(table, shape=(2048, 2048), poses=sim.matches.poses, allow_copies=True)
    with pytest.raises(SolveError, match="do not determine the distortion of degree 2"):
        solve(matches, degree=2)


@pytest.mark.parametrize(("seed", "n_exposures"), [(10, 5), (46, 5), (57, 4)])
def test_few_stars_and_a_large_distortion_that_nobody_knew(seed, n_exposures):
    sim = simulate_gsaoi_matches(small=True, seed=seed, n_exposures=n_exposures, n_stars=45)
    solution = solve(sim.matches, degree=3, clip=None)
    assert solution.chi2 < 1.5 * solution.dof  # it is 9000 times as large where the constraints never settle
