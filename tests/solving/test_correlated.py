"""`errors="correlated"` and `"floor"`: likelihood and covariances against dense matrices, drifts that numpy makes."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from scipy import optimize, special

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.solving import single_fit
from legdistort.solving.options import SolveOptions
from legdistort.solving.residual_errors import correlated as correlated_errors

SIZE, NOISE = 0.01, 0.01


def drifting(correlation, seed=0, *, n_exposures=32, n_stars=70, epochs=False):
    """Matches whose stars wander with a correlation time of so many exposures (0: not at all), and true positions."""
    sim = ld.simulate_matches(
        n_exposures=n_exposures, n_stars=n_stars, degree=1, sigma=NOISE, static=0.02, dynamic=0.02, dither=20.0,
        seed=seed,
    )  # fmt: skip
    table, rng = sim.matches.table.copy(), np.random.default_rng(100 + seed)
    exposure = np.unique(table["exposure"], return_inverse=True)[1]
    if correlation:
        lag = np.abs(np.subtract.outer(np.arange(n_exposures), np.arange(n_exposures)))
        drawn = rng.normal(size=(2, n_stars, n_exposures)) @ np.linalg.cholesky(np.exp(-lag / correlation)).T
        for k, axis in enumerate("xy"):
            table[axis] += SIZE * drawn[k, table["star"], exposure] * u.pix
    if epochs:  # one every 3 minutes
        table["epoch"] = (2020.5 + exposure * 3 / 1440 / 365.25) * u.yr
        table = table[np.argsort(rng.permutation(n_exposures)[exposure], kind="stable")]
    return ld.Matches.from_table(table, shape=(2048, 2048), poses=sim.matches.poses), sim.truth


def solved(matches, errors="correlated", **options):
    return ld.solve(matches, degree=1, errors=errors, **options)


def true_over_reported(solution, truth):
    """Rms of true errors after a common linear map, over those reported."""
    positions = truth.positions[solution.estimate.star_names]
    offset = solution.estimate.positions - positions
    maps = np.column_stack([np.ones(len(offset)), positions / 1000])
    left = offset - maps @ np.linalg.lstsq(maps, offset, rcond=None)[0]
    reported = np.stack([solution.stars[f"{axis}_err"].value for axis in "xy"])
    return np.sqrt(np.sum(left**2) / (1 - 3 / len(left)) / np.sum(reported**2))


@pytest.fixture(scope="module")
def wandering():
    matches, truth = drifting(4)
    return {errors: solved(matches, errors) for errors in ("floor", "correlated")}, truth


@pytest.mark.slow
def test_errors_of_stars_that_wander_are_true(wandering):
    solutions, truth = wandering
    assert true_over_reported(solutions["floor"], truth) > 1.5
    assert true_over_reported(solutions["correlated"], truth) == pytest.approx(1, abs=0.2)
    found = solutions["correlated"].diagnostics.correlated
    assert found.along == "time"
    assert found.unit == "exposures"
    assert found.length == pytest.approx(4, rel=0.35)
    assert (found.x, found.y) == pytest.approx((SIZE, SIZE), rel=0.2)
    assert found.floor < 0.5 * SIZE


@pytest.mark.slow
def test_words_say_what_was_found_and_what_cannot_be(wandering):
    text = str(wandering[0]["correlated"])
    assert "shared by exposures near one another in" in text
    assert "errors that are the same in all exposures cannot be measured" in " ".join(text.split())


def test_the_floor_holds_all_errors_of_one_exposure(wandering):
    assert wandering[0]["correlated"].diagnostics.error_floor == pytest.approx(SIZE, rel=0.15)


def test_files_keep_what_was_found(wandering, tmp_path):
    solution = wandering[0]["correlated"]
    solution.write(tmp_path / "s.asdf")
    again = ld.Solution.read(tmp_path / "s.asdf")
    assert again.diagnostics == solution.diagnostics
    assert np.array_equal(again.stars["x_err"], solution.stars["x_err"])


def test_covariance_of_all_stars_has_that_of_each_on_its_diagonal(wandering):
    uncertainty = wandering[0]["correlated"].estimate.uncertainty
    n = uncertainty.stars.shape[1]
    assert np.diag(uncertainty.star_matrix) == pytest.approx(uncertainty.stars[:2].ravel())
    assert np.diag(uncertainty.star_matrix[:n, n:]) == pytest.approx(uncertainty.stars[2], abs=1e-12)


@pytest.mark.slow
def test_times_tell_what_the_order_of_the_exposures_does_not():
    matches, truth = drifting(4, epochs=True)
    assert matches.times[1] == "days"
    solution = solved(matches)
    found = solution.diagnostics.correlated
    assert found.unit == "days"
    assert found.length * 1440 == pytest.approx(12, rel=0.35)
    assert " min" in str(found)
    assert true_over_reported(solution, truth) == pytest.approx(1, abs=0.2)
    shuffled = ld.Matches.from_table(matches.table["exposure", "star", "x", "y", "x_err", "y_err"],
                                     shape=(2048, 2048), poses=matches.poses)  # fmt: skip
    assert shuffled.times[1] == "exposures"
    lost = solved(shuffled).diagnostics.correlated
    assert lost.along != "time" or lost.length < found.length * 480 / 2


@pytest.mark.slow
def test_errors_along_the_detector_are_found():
    matches, _ = drifting(0, seed=3)
    table = matches.table.copy()
    rng = np.random.default_rng(0)
    share, wave = rng.normal(size=70)[table["star"]], rng.uniform(0, 6, 70)[table["star"]]
    table["y"] += 2 * SIZE * share * np.sin(table["y"].value / 5 + wave) * u.pix
    changed = ld.Matches.from_table(table, shape=(2048, 2048), poses=matches.poses)
    found = solved(changed).diagnostics.correlated
    assert found.along == "y"
    assert found.y > 3 * found.x
    assert 1 < found.length < 15


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_where_there_is_nothing_the_errors_are_those_of_a_floor(seed):
    matches, _ = drifting(0, seed, n_exposures=12)
    floored, solution = solved(matches, "floor"), solved(matches)
    assert solution.diagnostics.correlated.along is None
    assert "no errors that neighbouring exposures share" in str(solution.diagnostics.correlated)
    assert np.array_equal(solution.stars["x_err"], floored.stars["x_err"])


@pytest.mark.parametrize(("n_exposures", "n_stars"), [(7, 70), (12, 40)])
def test_few_exposures_or_stars_are_said_not_to_tell(n_exposures, n_stars):
    solution = solved(drifting(3, n_exposures=n_exposures, n_stars=n_stars)[0])
    words = str(solution.diagnostics.correlated)
    assert f"not measurable: {n_exposures} exposures, {n_stars} stars seen twice; it takes 8 and 50" in words


def test_a_floor_of_its_own_is_refused():
    with pytest.raises(InputError, match="errors='correlated' finds the error floor itself"):
        solved(drifting(0, n_exposures=8)[0], error_floor=0.1)


@pytest.fixture(scope="module")
def fit():
    matches, _ = drifting(3, n_exposures=9, n_stars=60)
    table = matches.table[np.random.default_rng(5).random(len(matches.table)) < 0.8]
    table["x_err"] *= np.random.default_rng(6).uniform(0.5, 2, len(table))
    options = SolveOptions(degree=1, clip=None)
    return single_fit.estimate(ld.Matches.from_table(table, shape=(2048, 2048), poses=matches.poses), options)


def correlation(place, length, derivatives):
    """Of Matern processes, the Bessel functions written out, by the distance at which it is 1/e."""
    nu, lag = derivatives + 0.5, np.abs(np.subtract.outer(place, place)) / length

    def matern(u):
        return 2 ** (1 - nu) / special.gamma(nu) * u**nu * special.kv(nu, u)

    u = np.maximum(lag * optimize.brentq(lambda u: matern(u) - np.exp(-1), 0.1, 10), 1e-9)
    return matern(u)


@pytest.mark.parametrize("derivatives", [0, 1, 2])
@pytest.mark.parametrize("name", ["time", "x"])
def test_likelihood_is_that_of_dense_matrices(fit, name, derivatives):
    rows = correlated_errors._Rows.of(fit)
    floor, x, y, length = 0.004, 0.02, 0.007, {"time": 2.0, "x": 15.0}[name]
    expected = 0.0
    for star in np.unique(rows.star):
        mine = rows.star == star
        place = rows.place[name][mine]
        for k, size in enumerate((x, y)):
            matrix = np.diag(rows.variance[k, mine] + floor**2)
            matrix += size**2 * correlation(place, length, derivatives)
            inverse, r, one = np.linalg.inv(matrix), rows.residual[k, mine], np.ones(mine.sum())
            logs = np.linalg.slogdet(matrix)[1] + np.log(one @ inverse @ one)
            mean = one @ inverse @ r / (one @ inverse @ one)
            expected += rows.free[star] * logs + (r - mean) @ inverse @ (r - mean)
    found = replace(rows.along(name), derivatives=derivatives).deviance(np.log(floor), x, y, length)
    assert found == pytest.approx(expected, rel=1e-9)
    assert rows.free.mean() == pytest.approx(1 - 3 * 9 / (len(rows.star)), rel=0.02)  # 3 modes of 9 exposures


@pytest.mark.parametrize("derivatives", [0, 1, 2])
@pytest.mark.parametrize("along", ["time", "y"])
def test_covariance_of_stars_is_that_of_dense_matrices(fit, along, derivatives):
    found = ld.results.diagnostics.CorrelatedErrors(0.0, 0.02, 0.007, along, 3.0, derivatives=derivatives)
    shared = correlated_errors._of_stars(fit, found)
    problem = fit.problem
    exposure = np.repeat(np.arange(9), np.diff(problem.start))
    place = exposure if along == "time" else problem.xy[1]
    for star in range(0, problem.n_stars, 7):
        mine = problem.star == star
        part = fit.weighted.weight[:2, mine].sum(axis=0)
        part /= part.sum()
        alike = correlation(place[mine], 3.0, derivatives)
        assert found.correlation(np.subtract.outer(place[mine], place[mine])) == pytest.approx(alike)
        independent = (found.x**2 + found.y**2) / 2 * part @ part
        for k, size in enumerate((found.x, found.y)):
            assert shared[k, star] == pytest.approx(size**2 * part @ alike @ part - independent, rel=1e-9)


def test_a_floor_takes_three_fits(monkeypatch):
    made, minimise = [], single_fit.minimise
    monkeypatch.setattr(single_fit, "minimise", lambda *a, **k: made.append(1) or minimise(*a, **k))
    table = drifting(0, n_exposures=8)[0].table.copy()
    table["x"] += np.random.default_rng(0).normal(0, 0.05, len(table)) * u.pix
    table["y"] += np.random.default_rng(1).normal(0, 0.05, len(table)) * u.pix
    table["x_err"] *= np.random.default_rng(2).uniform(0.1, 3, len(table))
    solution = solved(ld.Matches.from_table(table, shape=(2048, 2048)), "floor")
    assert len(made) <= 3
    assert solution.diagnostics.error_floor == pytest.approx(0.05, rel=0.1)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=0.005)
