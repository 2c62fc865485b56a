"""Large, unequal, precise distortions: a fit ends where all is most probable, which a dense model finds by itself."""

import warnings

import dense_model
import drawn_sets
import numpy as np
import pytest
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort.exceptions import LegdistortWarning, SolveError
from legdistort.geometry import basis
from legdistort.results import accuracy
from legdistort.runtime import parallel
from legdistort.solving import start_values
from legdistort.solving.equations.problem import build_problem
from legdistort.solving.gauge import most_probable


def solved(data, prior=None, **options):
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        return ld.solve(drawn_sets.as_matches(data), degree=data["degree"], prior=prior, **options)


def searched(data, prior=None, **options):
    matches = drawn_sets.as_matches(data)
    problem = build_problem(matches, data["degree"], prior=prior)
    start, _ = start_values.start(problem, np.stack([matches.poses[name] for name in matches.names]))
    with parallel.one_blas_thread():
        return most_probable.most_probable(problem, start, **options)


def off(xy, true, degree):
    """Rms of positions (n, 2) off the true ones once a common map of a degree is taken off, pixels."""
    values, offset = dense_model.basis(true, degree, 2048)[0], xy - true
    return np.sqrt(np.mean((offset - values @ np.linalg.lstsq(values, offset, rcond=None)[0]) ** 2))


def positions(solution):
    """Positions in the order of the stars of a set."""
    stars = solution.stars
    out = np.empty((len(stars), 2))
    out[np.asarray(stars["star"])] = np.column_stack([stars["x"].value, stars["y"].value])
    return out


@pytest.mark.parametrize(
    ("words", "prior", "closure"),
    [
        pytest.param({"static": 1.0, "dynamic": 10.0}, True, False, marks=pytest.mark.slow),
        pytest.param({"static": 12.0, "dynamic": 3.0, "rolls": 30.0}, False, False, marks=pytest.mark.slow),
        ({"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "higher": 0.02}, False, True),
    ],
)
def test_minimum_sizes_and_errors_are_those_of_the_dense_model(words, prior, closure):
    data, truth = dense_model.drawn_set(2, n_stars=60, n=6, **words)
    known = {"mean": truth["static"], "v": 0} if prior else {}
    dense = dense_model.Model(**data, closure=closure, **known).fit()
    found = searched(data, ld.Prior(truth["static"]) if prior else None)
    assert found.converged
    sizes = np.delete(dense.sizes, [*([3] if prior else []), *([] if closure else [4])])
    assert_allclose(found.posterior.sizes, sizes, rtol=0.03)
    assert found.blocks.chi2 == pytest.approx(dense.chi2, rel=1e-3)
    assert found.dof == pytest.approx(dense.dof, abs=0.5)
    error = np.sqrt(np.diag(dense.covariance)[: 2 * dense.M].reshape(-1, 2))
    # a similarity of the plane is a convention, and shears of it are hardly known
    assert off(found.state.positions.T, dense.X, 1) < 0.02 * np.median(error)


ROWS = {
    "departures of 10 px, exact prior": ({"static": 1.0, "dynamic": 10.0}, True),
    "static of 12 px": ({"static": 12.0, "dynamic": 3.0}, False),
    "precise, rolls": ({"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "errors": (0.001, 0.005)}, False),
    "terms beyond the degree": ({"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "higher": 0.02}, False),
    "one exposure of 10 px": ({"static": 1.0, "odd": 10.0}, True),
}


@pytest.mark.parametrize(
    "row", [pytest.param(row, marks=[pytest.mark.slow] * (k > 1)) for k, row in enumerate(reversed(ROWS))]
)
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.sets) for seed in range(2, 8))])
def test_large_distortions_cost_no_chi2(row, seed):
    """Where a convention holds the plane it is 80 and 270 times its degrees of freedom in the first two rows."""
    words, prior = ROWS[row]
    data, truth = dense_model.drawn_set(seed, **words)
    solution = solved(data, ld.Prior(truth["static"]) if prior else None)
    assert abs(solution.chi2 / solution.dof - 1) < 5 * np.sqrt(2 / solution.dof)
    assert np.mean(solution.residuals["used"]) > 0.99
    stated = np.sqrt(np.mean([solution.stars[name].value ** 2 for name in ("x_err", "y_err")]))
    assert off(positions(solution), truth["stars"], 3) < 1.5 * stated


def test_few_precise_exposures_count_among_many_noisy_ones():
    """By the typical error a bend of the plane would not show in this set: 1.36 times the degrees of freedom."""
    data, truth = dense_model.drawn_set(7, static=1.0, dynamic=3.0)
    noisy = data["exposure"] >= 3
    noise = np.random.default_rng(7).normal(size=data["err"].shape)
    data["xy"] = data["xy"] + noisy[:, None] * np.sqrt(99) * data["err"] * noise
    data["err"] = data["err"] * np.where(noisy, 10, 1)[:, None]
    solution = solved(data, ld.Prior(truth["static"]), clip=None)
    assert solution.chi2 / solution.dof < 1 + 4 * np.sqrt(2 / solution.dof)


@pytest.mark.parametrize(
    "row", [pytest.param(row, marks=pytest.mark.sets if k % 2 else pytest.mark.slow) for k, row in enumerate(ROWS)]
)
def test_relative_errors_are_those_stated(row):
    """A common cubic map taken off with the weights of the observations; 0.86 to 1.36 over 20 sets."""
    words, prior = ROWS[row]
    true = stated = 0.0
    for seed in range(6):
        data, truth = dense_model.drawn_set(seed, **words)
        solution = solved(data, ld.Prior(truth["static"]) if prior else None, clip=None)
        values, offset = dense_model.basis(truth["stars"], 3, 2048)[0], positions(solution) - truth["stars"]
        root = np.sqrt(np.bincount(data["star"], data["err"][:, 0] ** -2.0))[:, None]
        offset -= values @ np.linalg.lstsq(root * values, root * offset, rcond=None)[0]
        true += np.sum(offset**2)
        stated += sum(np.sum(solution.stars[name].value ** 2) for name in ("x_err", "y_err"))
    assert 0.65 < true / stated < 1.6


@pytest.mark.parametrize(
    ("n_sets", "pull"), [pytest.param(4, 0.55, marks=pytest.mark.slow), pytest.param(10, 0.35, marks=pytest.mark.sets)]
)
@pytest.mark.parametrize("row", ["one exposure of 10 px", "terms beyond the degree"])
def test_absolute_errors_are_those_stated(row, n_sets, pull):
    """One odd exposure widens nobody's errors; what is common beyond the degree does not make them too small."""
    words, prior = ROWS[row]
    true = stated = 0.0
    for seed in range(n_sets):
        data, truth = dense_model.drawn_set(seed, **words)
        solution = solved(data, ld.Prior(truth["static"]) if prior else None)
        assert np.isfinite(solution.stars["x_err_abs"]).all()
        order = np.asarray(solution.stars["star"])
        true += np.sum(accuracy.known_offsets(solution, truth["stars"][order]) ** 2)
        stated += sum(np.sum(solution.stars[name].value ** 2) for name in ("x_err_known", "y_err_known"))
    assert true / stated == pytest.approx(1, abs=pull)


def test_what_exposures_have_in_common_beyond_the_degree_is_part_of_the_distortion():
    words = ROWS["terms beyond the degree"][0]
    data, _ = dense_model.drawn_set(3, **words)
    solution = solved(data)
    assert solution.degree == 3
    assert solution.coefficients.shape[2] == basis.n_modes(5)
    common = solution.coefficients[:, :, basis.n_modes(3) :]
    assert np.ptp(common, axis=0).max() < 1e-9
    assert np.sqrt(np.mean(common**2)) == pytest.approx(0.02, rel=0.4)
    assert solution.diagnostics.higher_static == pytest.approx(np.sqrt(np.mean(np.sum(common**2, axis=(1, 2))) / 8))
    assert "higher  terms beyond the degree" in str(solution)
    without = solved(dense_model.drawn_set(3, **words | {"higher": 0.0})[0])
    assert without.coefficients.shape[2] == basis.n_modes(3)
    assert without.diagnostics.higher_static is None
    assert without.higher_static is None


@pytest.mark.slow
def test_what_is_common_beyond_the_degree_is_a_table(tmp_path):
    """Of every mode, in pixels, with errors; a file has it too."""
    words = ROWS["terms beyond the degree"][0]
    data, truth = dense_model.drawn_set(3, **words)
    solution = solved(data)
    for table in (solution.higher_static, ld.Solution.read(solution.write(tmp_path / "s.asdf")).higher_static):
        assert list(zip(table["m"], table["n"], strict=True)) == dense_model.orders(5)[10:]
        assert set(table["detector"]) == {"1"}
        for axis, name in enumerate("xy"):
            np.testing.assert_allclose(table[name].value, solution.coefficients[4, axis, 10:], rtol=1e-12)
            off = table[name].value - truth["beyond"][axis, 10:]
            assert np.abs(off / table[f"{name}_err"].value).max() < 5


def _without_map(offset, at, data, truth, seen):
    """Offsets (n, 2) at places without the cubic map that fits those `seen` of the stars, with their weights."""
    root = np.sqrt(np.bincount(data["star"], data["err"][:, 0] ** -2.0))[:, None]
    values = dense_model.basis(truth["stars"], 3, 2048)[0]
    return offset - dense_model.basis(at, 3, 2048)[0] @ np.linalg.lstsq(root * values, root * seen, rcond=None)[0]


@pytest.mark.parametrize("sets", [pytest.param(5, marks=pytest.mark.slow), pytest.param(20, marks=pytest.mark.sets)])
def test_errors_have_those_of_what_is_common_beyond_the_degree(sets):
    """As known they leave a squared pull of 1.55 of stars and of 1.33 of new positions."""
    pulls = {"stars": [], "new": [], "terms": []}
    for seed in range(sets):
        words = {"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "higher": 0.03, "errors": (0.01, 0.01)}
        data, truth = dense_model.drawn_set(seed, n=5, n_stars=60, **words)
        solution = solved(data)
        assert solution.diagnostics.higher_static is not None
        seen = positions(solution) - truth["stars"]
        offset = _without_map(seen, truth["stars"], data, truth, seen)
        stated = np.stack([solution.stars[name].value for name in ("x_err", "y_err")], axis=1)
        pulls["stars"].append([np.sum(offset**2), np.sum(stated**2)])
        at = np.random.default_rng(seed).uniform(500, 1500, (40, 2))
        q = at @ data["poses"][1, :, :2].T + data["poses"][1, :, 2]
        b = dense_model.basis(q, 5, 2048)[0]
        pixels = q + b[:, :10] @ (truth["static"] + truth["dynamic"][1]).T + b @ truth["beyond"].T
        found = solution[solution.names[1]].correct(pixels, errors=np.zeros((40, 2)))
        offset = _without_map(found.xy - at, at, data, truth, seen)
        pulls["new"].append([np.sum(offset**2), np.einsum("naa->", found.relative)])
        terms = solution.higher_static
        offset = np.stack([terms["x"].value, terms["y"].value]) - truth["beyond"][:, 10:]
        pulls["terms"].append([np.sum(offset**2), np.sum(terms["x_err"] ** 2 + terms["y_err"] ** 2).value])
    for name, each in pulls.items():
        true, stated = np.sum(each, axis=0)
        assert true / stated == pytest.approx(1, abs=0.25 if sets > 5 else 0.35), name


@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.slow), pytest.param(10, marks=pytest.mark.slow)])
def test_a_misfit_is_enough_to_look_beyond_the_degree(seed):
    """Departures are too small to count in second order; chi2 is 20 times its degrees of freedom without."""
    data, _ = dense_model.drawn_set(seed, **ROWS["terms beyond the degree"][0] | {"higher": 0.05})
    solution = solved(data, clip=None)
    assert solution.diagnostics.higher_static == pytest.approx(0.08, rel=0.4)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=5 * np.sqrt(2 / solution.dof))


@pytest.mark.slow
def test_errors_beyond_the_degree_are_written_and_scale_with_the_others(tmp_path):
    data, _ = dense_model.drawn_set(3, **ROWS["terms beyond the degree"][0])
    solution = solved(data, errors="scale")
    scale = solution.diagnostics.error_scale
    plain = solved(data).estimate.uncertainty.camera
    assert_allclose(solution.estimate.uncertainty.camera.stars, scale * plain.stars, rtol=1e-6)
    solution.write(tmp_path / "solution.asdf")
    again = ld.Solution.read(tmp_path / "solution.asdf")
    for name in ("x_err", "x_err_abs"):
        assert_allclose(again.stars[name].value, solution.stars[name].value)
    xy = np.array([[100.0, 200.0], [1500.0, 900.0]])
    name = solution.names[0]
    relative = [each[name].correct(xy, errors=0.01).relative for each in (again, solution)]
    assert_allclose(*relative)


@pytest.mark.slow
def test_gross_errors_are_found_beside_large_distortions():
    data, truth = dense_model.drawn_set(0, static=1.0, dynamic=10.0)
    rng = np.random.default_rng(0)
    bad = rng.random(len(data["star"])) < 0.02
    data["xy"] = data["xy"] + bad[:, None] * rng.choice([-3.0, 3.0], size=(len(bad), 2))
    solution = solved(data, ld.Prior(truth["static"]))
    used = np.asarray(solution.residuals["used"])
    assert not used[bad].any()
    assert np.count_nonzero(~used) <= np.count_nonzero(bad) + 3
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=0.15)


def test_a_static_distortion_that_is_not_known_leaves_the_plane_where_it_is():
    """Without dithers 10 px of it move along a curved valley, which no short step follows."""
    sim = ld.simulate_matches(seed=1, sigma=0.01, static=10.0, n_stars=300, dither=0.0, dynamic=0.1)
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solution = ld.solve(sim.matches)
    assert abs(solution.chi2 - solution.dof) < 5 * np.sqrt(2 * solution.dof)


def test_sizes_that_are_held_are_not_sought():
    data, truth = dense_model.drawn_set(1, n_stars=60, n=6, dynamic=3.0)
    found = searched(data, ld.Prior(truth["static"]), sizes=np.array([3.0, 2.5, 2.0]))
    assert_allclose(found.posterior.sizes, [3.0, 2.5, 2.0])


def test_what_nothing_determines_is_refused():
    data, truth = dense_model.drawn_set(1, n_stars=60, n=6)
    data["err"] = np.full(data["err"].shape, np.inf)
    with pytest.raises((SolveError, ld.exceptions.InputError)):
        searched(data, ld.Prior(truth["static"]))
