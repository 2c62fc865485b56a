"""Errors as expected from the covariances against errors made in simulation, over many seeds."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracle import DenseOracle

from legdistort.exceptions import InputError
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.results.solution import Solution
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving.estimation import solve

SEEDS = range(40)


def paper(seed, **settings):
    return simulate_matches(seed=seed, **settings)


def turned(seed):
    return simulate_matches(
        seed=seed, n_exposures=6, n_stars=40, degree=2, shape=(900, 1400), dither=150, rotations=10.0 * np.arange(6)
    )


def gsaoi(seed):
    return simulate_gsaoi_matches(seed=seed, small=True)


def solved(sim, **options):
    degree = int(np.sqrt(2 * sim.truth.static.shape[1])) - 1
    return solve(sim.matches, degree=degree, prior=Prior(sim.truth.static), **options)


def agreement(pairs):
    """Mean of measured over mean of expected variance, and its sampling error."""
    measured, expected = np.array(pairs).T
    ratio = measured / expected.mean()
    return ratio.mean(), ratio.std(ddof=1) / np.sqrt(len(ratio))


def assert_agrees(pairs, *, slack=0.0):
    """Equal within 3.5 sampling errors, which are to be small themselves."""
    mean, error = agreement(pairs)
    assert error < 0.15
    assert abs(mean - 1) < 3.5 * error + slack, f"measured / expected variance {mean:.3f} +- {error:.3f}"


@pytest.fixture(scope="module")
def runs():
    """Simulations with their solutions, 40 each; shared by the tests below."""
    made = {}

    def get(make):
        if make not in made:
            made[make] = [(sim, solved(sim)) for sim in map(make, SEEDS)]
        return made[make]

    return get


@pytest.mark.parametrize(
    ("make", "removed"),
    [
        (paper, None),
        (paper, "similarity"),
        (paper, 3),
        pytest.param(turned, 2, marks=pytest.mark.slow),
        pytest.param(gsaoi, 3, marks=pytest.mark.slow),
    ],
)
def test_relative_bias_is_the_one_expected(runs, make, removed):
    """Undithered exposures of zero mean are in the gauge as they come; elsewhere the common map is taken out."""
    pairs = []
    for sim, solution in runs(make):
        true = sim.truth.positions[solution.estimate.star_names]
        b = accuracy.bias(solution.estimate.positions, true, removed=removed)
        pairs.append((b**2, accuracy.expected_bias(solution, removed=removed) ** 2))
    assert_agrees(pairs, slack=0.03)


@pytest.mark.parametrize(
    "make", [paper, pytest.param(turned, marks=pytest.mark.slow), pytest.param(gsaoi, marks=pytest.mark.slow)]
)
def test_scatter_of_new_positions_is_the_one_expected(runs, make):
    sigma, pairs = 0.05, []
    for seed, (sim, solution) in zip(SEEDS, runs(make), strict=True):
        xy = sim.truth.grid(solution.names[1], 6)
        p = np.stack([sim.truth.distort(name, xy) for name in solution.names])
        p += sigma * np.random.default_rng(seed).normal(size=p.shape)
        ny, nx = sim.truth.shape
        seen = ((p >= -0.5) & (p <= np.array([nx, ny]) - 0.5)).all(axis=2)
        corrected = np.full(p.shape, np.nan)
        for i, name in enumerate(solution.names):
            corrected[i, seen[i]] = solution[name].correct(p[i, seen[i]])
        inside = solution[solution.names[1]].supported(p[1])  # beyond the stars it is extrapolation
        use = inside & (seen.sum(axis=0) > 1)
        measured = accuracy.scatter(corrected)
        expected = accuracy.expected_scatter(solution, xy, sigma, seen=seen)
        pairs.append((np.mean(measured[use] ** 2), np.mean(expected[use] ** 2)))
    assert_agrees(pairs, slack=0.05)


@pytest.mark.parametrize(
    ("make", "slack"),
    [
        pytest.param(lambda seed: paper(seed, zero_mean=False), 0.0, marks=pytest.mark.slow),
        pytest.param(lambda seed: paper(seed, zero_mean=False, dither=200.0), 0.1, marks=pytest.mark.sets),
        # the weights of the gauge come from the same few exposures as the scatter that the error is made of
        pytest.param(
            lambda seed: paper(seed, zero_mean=False, dither=200.0, rotations=7.0 * np.arange(10)),
            0.4,
            marks=pytest.mark.sets,
        ),
        pytest.param(lambda seed: simulate_gsaoi_matches(seed=seed), 0.2, marks=pytest.mark.slow),
    ],
)
def test_absolute_bias_is_the_one_expected(make, slack):
    """With the mean dynamic distortion of the set, which the sky does not tell; the pointing stays unknown."""
    pairs, relative = [], []
    for seed in SEEDS:
        sim = make(seed)
        solution = solved(sim)
        true = sim.truth.positions[solution.estimate.star_names]
        b = accuracy.bias(solution.estimate.positions, true, removed="similarity")
        pairs.append((b**2, accuracy.expected_bias(solution, removed="similarity", absolute=True) ** 2))
        relative.append(accuracy.expected_bias(solution, removed="similarity"))
    assert_agrees(pairs, slack=slack)
    assert np.mean(relative) < 0.5 * np.sqrt(np.mean(pairs))  # without it the error would be far too small


def test_absolute_bias_adds_the_static_uncertainty():
    """The set shares the static distortion: its error does not average down."""
    sim = paper(0, n_stars=200)
    sharp = solve(sim.matches, prior=Prior(sim.truth.static, sigma=0.1))
    vague = solve(sim.matches, prior=Prior(sim.truth.static, sigma=0.1, static_sigma=0.5))
    left, right = (accuracy.expected_bias(s, removed=1, absolute=True) for s in (sharp, vague))
    # 7 modes of degree 2 and 3 per axis, each 0.5 px: rms over the detector 0.5 sqrt(7) / 2 px
    assert np.sqrt(right**2 - left**2) == pytest.approx(0.5 * np.sqrt(7) / 2, rel=0.15)


def test_slopes_of_the_paper():
    """b falls as 1/sqrt(n_im); new positions scatter by sqrt((1 - 1/n_im)(1 + n_modes/n_star))."""
    for n in (5, 20):
        sim = paper(1, n_exposures=n, n_stars=200)
        solution = solved(sim)
        assert accuracy.expected_bias(solution) == pytest.approx(0.14 / np.sqrt(n), rel=0.04)
        xy = sim.truth.positions
        new = accuracy.expected_scatter(solution, xy, 0.14)
        rms = np.sqrt(np.nanmean(new**2))
        assert rms == pytest.approx(0.14 * np.sqrt((1 - 1 / n) * (1 + 10 / 200)), rel=0.03)


@pytest.mark.parametrize("corr", [0.0, 0.6])
def test_covariance_between_stars_is_the_oracles(corr):
    sim = simulate_matches(n_stars=12, n_exposures=3, degree=1, shape=(700, 1200), sigma=0.1, corr=corr, dither=40)
    solution = solved(sim)
    oracle = DenseOracle(sim.matches, solution, sim.truth.static)
    n = 2 * len(solution.estimate.positions)
    x = np.concatenate([solution.estimate.positions.ravel(), solution.coefficients.ravel()])
    expected = oracle.covariance(x)[:n, :n]
    by_axis = np.concatenate([np.arange(0, n, 2), np.arange(1, n, 2)])  # ours has all x first
    matrix = solution.estimate.uncertainty.star_matrix
    assert_allclose(matrix, expected[np.ix_(by_axis, by_axis)], rtol=1e-3, atol=1e-7)
    errors = np.concatenate([solution.stars[c].value for c in ("x_err", "y_err")])
    assert np.all(errors**2 < np.diag(matrix))  # an affine map taken off
    assert accuracy.expected_bias(solution) == pytest.approx(np.sqrt(np.mean(np.diag(matrix))), rel=1e-6)


# --- the plain figures -------------------------------------------------------------------------------------------


def test_bias_is_rms_per_axis():
    true = np.random.default_rng(0).uniform(0, 100, (50, 2))
    assert accuracy.bias(true + [3, 4], true) == pytest.approx(np.sqrt(12.5))
    assert accuracy.bias(true + [3, 4], true, removed="similarity") == pytest.approx(0, abs=1e-12)
    lost = true + [3, 4]
    lost[7] = np.nan
    assert accuracy.bias(lost, true) == pytest.approx(np.sqrt(12.5))


@pytest.mark.parametrize("removed", [0, 1, 3, "similarity"])
def test_what_is_removed(removed):
    """A map of the class leaves nothing; noise loses as much as it has parameters."""
    rng = np.random.default_rng(1)
    true = rng.uniform(0, 2000, (400, 2))
    if removed == "similarity":
        t = np.radians(0.3)
        moved = true @ (1.001 * np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])) + [5, -7]
        k = 4
    else:
        i, j = np.array([(a, b) for a in range(removed + 1) for b in range(removed + 1 - a)]).T
        powers = (true[:, :1] / 2000) ** i * (true[:, 1:] / 2000) ** j
        moved = true + powers @ rng.normal(size=(len(i), 2))
        k = 2 * len(i)
    assert accuracy.bias(moved, true, removed=removed) < 1e-9
    left = [accuracy.bias(true + rng.normal(size=true.shape), true, removed=removed) ** 2 for _ in range(60)]
    assert np.mean(left) == pytest.approx(1 - k / 800, abs=0.025)
    with pytest.raises(InputError, match="removed must be an integer from 0 to 30, got 'affine'"):
        accuracy.bias(moved, true, removed="affine")


def test_scatter_is_the_papers():
    rng = np.random.default_rng(2)
    c = rng.normal(size=(5, 30, 2))
    expected = np.sqrt(c.var(axis=0).sum(axis=1) / 2)
    assert_allclose(accuracy.scatter(c), expected)
    c[1:, 0] = np.nan
    c[:, 1] = np.nan
    c[3, 2, 0] = np.nan
    out = accuracy.scatter(c)
    assert np.isnan(out[:2]).all()
    assert_allclose(out[2], np.sqrt(np.delete(c[:, 2], 3, axis=0).var(axis=0).sum() / 2))


@pytest.mark.slow
def test_corrected_positions_stand_where_they_belong(runs):
    _, solution = runs(gsaoi)[0]
    corrected = accuracy.corrected_positions(solution)
    assert corrected.shape == (len(solution.names), len(solution.estimate.star_names), 2)
    rows = solution.residuals
    seen = np.zeros(corrected.shape[:2], dtype=bool)
    for row in rows:
        i, j = solution.names.index(row["exposure"]), np.searchsorted(solution.estimate.star_names, row["star"])
        seen[i, j] = row["used"]
    assert np.array_equal(np.isfinite(corrected).all(axis=2), seen)
    errors = corrected - solution.estimate.positions
    assert np.nanmax(np.abs(errors)) < 6 * rows["x_err"].max().value


def test_scatter_of_positions_seen_once_or_without_noise(runs):
    _, solution = runs(gsaoi)[0]
    far = np.array([[1e5, 1e5]])
    assert np.isnan(accuracy.expected_scatter(solution, far, 0.1)).all()
    middle = solution.estimate.positions[:5]
    once = np.zeros((len(solution.names), 5), dtype=bool)
    once[2] = True
    assert np.isnan(accuracy.expected_scatter(solution, middle, 0.1, seen=once)).all()
    # a perfect position still scatters by the errors of the corrections
    without = accuracy.expected_scatter(solution, middle, 0.0)
    assert np.all(without > 0)
    assert np.all(without < accuracy.expected_scatter(solution, middle, 0.1))


def test_scatter_is_that_of_a_solution_from_a_file(runs, tmp_path):
    _, solution = runs(gsaoi)[0]
    back = Solution.read(solution.write(tmp_path / "s.asdf"))
    xy = solution.estimate.positions[:4]
    assert_allclose(accuracy.expected_scatter(back, xy, 0.1), accuracy.expected_scatter(solution, xy, 0.1))
