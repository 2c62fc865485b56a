"""Errors of positions that took no part in the solution: what moves them, limits, tables, and calibration by truth."""

import pickle
import warnings
from dataclasses import replace

import new_positions_table
import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from oracle import DenseOracle

import legdistort as ld
from legdistort import paper
from legdistort.assessment.baselines import solve_shifts
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry import similarity
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.results import new_positions
from legdistort.results.errors import absolute_errors

SKY = TangentPlane(10.0, 20.0, np.array([[-1e-5, 2e-6, 2e-4], [2e-6, 1e-5, -2e-4]]))
PIXELS = np.array([[300.0, 400.0], [1024.0, 1000.0], [1700.0, 350.0], [900.0, 1800.0]])


@pytest.fixture(scope="module")
def sim():
    return ld.simulate_matches(
        n_exposures=6, n_stars=40, degree=3, sigma=0.02, static=3.0, dynamic=0.3, dither=100.0,
        rotations=10.0 * np.arange(6), zero_mean=False, seed=3,
    )  # fmt: skip


@pytest.fixture(scope="module")
def solution(sim):
    return replace(ld.solve(sim.matches, prior=ld.Prior(sim.truth.static)), sky=SKY)


@pytest.fixture(scope="module")
def free(sim):
    """Without a prior: shears at least are unknown to exposures of one orientation."""
    plain = ld.simulate_matches(n_exposures=6, n_stars=40, degree=3, sigma=0.02, static=3.0, dither=100.0, seed=3)
    return ld.solve(plain.matches)


# -- which star it is


@pytest.mark.parametrize("named", [False, True])
def test_rows_that_are_observations_have_their_star(solution, named):
    if named:
        names = {k: f"s{k}" for k in solution.estimate.star_names.tolist()}
        residuals = solution.residuals.copy()
        residuals.replace_column("star", [names[k] for k in residuals["star"].tolist()])
        solution = replace(solution, residuals=residuals)
    seen = solution.residuals[np.random.default_rng(2).permutation(len(solution.residuals))[:50]]
    table = seen["exposure", "x", "y", "x_err", "y_err"]
    for name in "xy":
        table[name] = np.round(table[name], 4)
    table["x"][7] += 0.01 * u.pix
    swapped = "exp00" if table["exposure"][9] != "exp00" else "exp01"
    table["exposure"][9] = swapped
    expected = np.asarray(seen["star"]).copy()
    expected[[7, 9]] = "" if named else -1
    assert_array_equal(solution.correct_table(table)["star"], expected)
    table["star"] = "own"
    assert set(solution.correct_table(table)["star"]) == {"own"}


# -- what moves a corrected position


def test_without_errors_positions_alone(solution):
    name = solution.names[1]
    corrected = solution[name].correct(PIXELS, errors=np.zeros(PIXELS.shape))
    assert isinstance(corrected, new_positions.Corrected)
    xy, relative, absolute = corrected
    assert_array_equal(xy, solution[name].correct(PIXELS))
    assert relative.shape == absolute.shape == (4, 2, 2)
    with pytest.raises(AttributeError):
        corrected.xy = 0


def test_no_positions_have_no_errors(solution):
    corrected = solution[solution.names[1]].correct(np.zeros((0, 2)), errors=np.zeros((0, 2)))
    assert [part.shape for part in corrected] == [(0, 2), (0, 2, 2), (0, 2, 2)]


def test_measurement_goes_through_the_inverse_by_finite_differences(solution):
    name, step = solution.names[2], 1e-3
    columns = [(solution[name].correct(PIXELS + e) - solution[name].correct(PIXELS - e)) / (2 * step)
               for e in step * np.eye(2)]  # fmt: skip
    back = np.stack(columns, axis=2)
    measured = np.array([[0.04, 0.01], [0.01, 0.09]])
    none = solution[name].correct(PIXELS, errors=0.0)
    given = solution[name].correct(PIXELS, errors=np.broadcast_to(measured, (4, 2, 2)))
    for with_errors, without in zip(given[1:], none[1:], strict=True):
        assert_allclose(with_errors - without, back @ measured @ back.transpose(0, 2, 1), rtol=1e-5)


def test_coefficients_move_positions_as_finite_differences_say(solution):
    name, step = solution.names[4], 1e-4
    q = solution[name].distortion.invert(PIXELS)
    response = new_positions.response(solution[name], q)[0].reshape(4, 2, 2, -1)
    for axis, mode in ((0, 0), (1, 4), (0, 9)):
        moved = []
        for sign in (1, -1):
            coefficients = solution.coefficients.copy()
            coefficients[4, axis, mode] += sign * step
            moved.append(replace(solution, coefficients=coefficients)[name].correct(PIXELS))
        assert_allclose((moved[1] - moved[0]) / (2 * step), response[:, :, axis, mode], atol=1e-6)


def test_a_common_map_moves_new_positions_with_the_stars():
    """N_i at the pixels of stars against the directions of the stars themselves: second order in the static part."""
    still = ld.simulate_matches(n_exposures=6, n_stars=40, sigma=0.02, static=3.0, dynamic=0.01, dither=50.0, seed=3)
    solution = ld.solve(still.matches, prior=ld.Prior(still.truth.static))
    gauge, worst = solution.gauge, 0.0
    for i, name in enumerate(solution.names):
        q = similarity.apply(solution.poses[name], solution.estimate.positions)
        by_modes = new_positions.response(solution[name], q)[0]
        moved = by_modes @ new_positions.widened(gauge.motion[i], solution.degree)
        plain = absolute_errors.plain_directions(gauge, solution.estimate.positions, gauge.n_modes)
        inside = (np.abs(q - 1023.5) < 1000).all(axis=1)
        of_second_order = np.sqrt(np.mean((gauge.directions - plain)[inside] ** 2))
        worst = max(worst, np.sqrt(np.mean((moved - gauge.directions)[inside] ** 2)) / of_second_order)
    assert worst < 0.4


def test_relative_part_of_the_correction_is_that_of_the_map(solution):
    name = solution.names[0]
    x, y, sigma = solution[name].sigma_map(n=5, support=False)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    relative = np.sqrt(np.einsum("nkk->nk", solution[name].correct(grid, errors=0.0).relative)).reshape(sigma.shape)
    assert np.all(relative >= sigma * (1 - 1e-9))  # that of second order beside it
    assert_allclose(relative, sigma, rtol=0.2)


def test_sigma_map_is_relative_unless_asked(solution, free):
    for made in (solution, free):
        assert np.isfinite(made[made.names[0]].sigma_map(n=6, support=False)[2]).all()
    x, y, absolute = solution[solution.names[0]].sigma_map(n=6, support=False, absolute=True)
    relative = solution[solution.names[0]].sigma_map(n=6, support=False)[2]
    assert np.all(absolute > 1.5 * relative)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    expected = np.einsum("nkk->nk", solution[solution.names[0]].correct(grid, errors=0.0).absolute)
    assert_allclose(absolute.reshape(-1, 2) ** 2, expected)
    assert np.isnan(free[free.names[0]].sigma_map(n=6, support=False, absolute=True)[2]).any()


@pytest.mark.parametrize("factor", [1.0, 50.0])
def test_relative_errors_are_those_of_a_dense_twin_without_common_maps(factor):
    """(1 - B P) C (1 - B P)', with the weights of the observations; one exposure of five may be worth nothing."""
    sim = ld.simulate_matches(
        n_exposures=5, n_stars=25, degree=2, sigma=0.02, corr=0.3, static=1.0, dynamic=0.3, dither=150.0, seed=3
    )
    table = sim.matches.table.copy()
    poor = table["exposure"] == "exp02"
    for name in ("x_err", "y_err"):
        table[name][poor] *= factor
    matches = ld.Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
    solution = ld.solve(matches, degree=2, prior=ld.Prior(sim.truth.static))
    n = 2 * len(solution.estimate.positions)
    twin = DenseOracle(matches, solution, sim.truth.static)
    x = np.concatenate([solution.estimate.positions.ravel(), solution.coefficients.ravel()])
    covariance, jacobian = twin.covariance(x), twin.jacobian(x)[:, :n]
    weight = jacobian.T @ jacobian  # of the stars, the exposures taken as known: nothing between one and another
    u, v = ((solution.estimate.positions - solution.gauge.box[0]) / solution.gauge.box[1]).T
    maps = np.stack([u**i * v**j for i in range(3) for j in range(3 - i)], axis=1)
    maps = np.kron(maps, np.eye(2))  # x and y of a star side by side
    fit = np.linalg.solve(maps.T @ weight @ maps, maps.T @ weight)
    left = np.eye(n) - maps @ fit
    expected = np.einsum("ab,bc,ac->a", left, covariance[:n, :n], left)
    known = replace(solution.gauge, covariance=np.zeros_like(solution.gauge.covariance))  # nothing of second order
    variance = absolute_errors.relative_variance(known, solution.estimate.uncertainty, solution.estimate.positions)
    assert_allclose(variance[:2].T.ravel(), expected, rtol=1e-3)
    assert np.all(variance[:2] <= solution.estimate.uncertainty.stars[:2])
    # an exposure follows a plane that is bent back by the map
    maps = np.einsum("mj,ab->jabm", solution.gauge.modes_at(solution.estimate.positions), np.eye(2)).reshape(n, -1)
    fit = np.linalg.solve(maps.T @ weight @ maps, maps.T @ weight)
    follow = np.zeros((12, len(x)))
    follow[:, :n] = solution.gauge.motion[2] @ fit
    follow[:, n + 24 : n + 36] = np.eye(12)
    expected = follow @ covariance @ follow.T
    assert_allclose(solution["exp02"].relative_covariance, expected, atol=1e-3 * np.abs(expected).max())
    back = pickle.loads(pickle.dumps(solution))
    assert_array_equal(back["exp02"].relative_covariance, solution["exp02"].relative_covariance)


def test_a_worthless_exposure_changes_no_error():
    sim = ld.simulate_matches(n_exposures=6, n_stars=60, sigma=0.02, static=1.0, dynamic=0.3, dither=150.0, seed=5)
    prior, errors = ld.Prior(sim.truth.static), []
    without = ld.solve(sim.matches.without({"exp03": "poor"}), prior=prior)
    for factor in (50.0, 500.0):
        table = sim.matches.table.copy()
        for name in ("x_err", "y_err"):
            table[name][table["exposure"] == "exp03"] *= factor
        matches = ld.Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
        errors.append(ld.solve(matches, prior=prior).stars["x_err"])
        assert_allclose(errors[-1], without.stars["x_err"], rtol=0.01)


@pytest.mark.parametrize("n", [4, pytest.param(6, marks=pytest.mark.slow)])
def test_relative_errors_without_a_prior_hold_for_few_exposures(n):
    """Truth of Chebyshev polynomials; 0.72 and 0.86 in the gauge of what dithers determine."""
    relative, _ = new_positions_table.row("no prior, 0.02 px", 8, n_exposures=n)
    assert relative == pytest.approx(1, abs=0.25)


# -- limits


def test_huge_errors_are_the_measurement_and_many_zero_ones_the_correction(solution):
    name = solution.names[0]
    huge = solution[name].correct(PIXELS, errors=np.full((4, 2), 1e6))
    assert_allclose(huge.absolute, huge.relative, rtol=1e-9)
    none = solution[name].correct(PIXELS, errors=0.0)
    assert np.all(np.linalg.eigvalsh(none.absolute - none.relative)[:, 1] > 0)


def test_halving_all_errors_of_the_stars_quarters_the_relative_part(sim, solution):
    table = sim.matches.table.copy()
    for column in ("x_err", "y_err"):
        table[column] = table[column] / 2
    matches = ld.Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
    finer = paper.solve(matches, prior=ld.Prior(sim.truth.static))
    same = paper.solve(sim.matches, prior=ld.Prior(sim.truth.static))
    for name in sim.matches.names:
        ratio = finer[name].sigma_map(n=4, support=False)[2] / same[name].sigma_map(n=4, support=False)[2]
        assert_allclose(ratio, 0.5, rtol=1e-3)


def test_unknown_directions_leave_positions_without_absolute_error(free, sim):
    name = free.names[0]
    corrected = free[name].correct(PIXELS, errors=np.full((4, 2), 0.02))
    assert np.isfinite(corrected.relative).all()
    assert np.isnan(corrected.absolute).any()
    # unless their own error is larger than a unit of each of these
    assert np.isfinite(free[name].correct(PIXELS, errors=np.full((4, 2), 5.0)).absolute).all()


def test_limit_of_what_is_unknown_is_the_rest_of_the_error(free):
    """One direction of unit rms: it is compared, position by position, with the remaining error."""
    name = free.names[0]
    one = free.gauge.unknown[0]
    alone = replace(free, gauge=replace(free.gauge, unknown_maps=free.gauge.unknown_maps[:1]))
    q = free[name].distortion.invert(PIXELS)
    by_modes = new_positions.response(free[name], q)[0]
    moved = np.linalg.norm(by_modes @ one.coefficients[0].ravel(), axis=1)
    known = replace(free, gauge=replace(free.gauge, unknown_maps=()))
    for factor, hidden in ((0.99, True), (1.01, False)):
        rest = np.trace(known[name].correct(PIXELS, errors=0.0).absolute, axis1=1, axis2=2)
        scale = np.abs(np.linalg.det(new_positions.response(free[name], q)[1]))
        error = np.sqrt(np.maximum((factor * moved) ** 2 - rest, 0) / (2 * scale))
        absolute = alone[name].correct(PIXELS, errors=np.column_stack([error, error])).absolute
        clear = (factor * moved) ** 2 > 1.05 * rest
        assert clear.any()
        assert_array_equal(np.isnan(absolute[clear, 0, 0]), hidden)


def test_simpler_corrections_have_no_absolute_errors(sim):
    shifts = solve_shifts(sim.matches, prior=ld.Prior(sim.truth.static))
    corrected = shifts[shifts.names[0]].correct(PIXELS, errors=0.02)
    assert np.isfinite(corrected.relative).all()
    assert np.isnan(corrected.absolute).all()


def test_shared_distortion_and_reference(sim):
    """Gauges of fewer modes than are fitted, and a tie that has modes of its own."""
    rng = np.random.default_rng(0)
    reference = QTable({"star": np.arange(20), "x": sim.truth.positions[:20, 0], "y": sim.truth.positions[:20, 1]})
    reference["x"] += 0.005 * rng.normal(size=20)
    reference["y"] += 0.005 * rng.normal(size=20)
    reference["x_err"] = reference["y_err"] = 0.005
    static = ld.simulate_matches(
        n_exposures=6, n_stars=60, sigma=0.02, static=2.0, dynamic=0.0, dither=300.0, rotations=30.0 * np.arange(6)
    )
    shared = ld.solve(static.matches, static="fit", exposure_degree=0)
    tied = ld.solve(sim.matches, prior=ld.Prior(sim.truth.static), reference=reference)
    for made in (shared, tied):
        corrected = made[made.names[0]].correct(PIXELS, errors=0.02)
        assert np.isfinite(corrected.relative).all()
        finite = np.isfinite(corrected.absolute[:, 0, 0])
        assert np.all(np.trace(corrected.absolute[finite], axis1=1, axis2=2) > 2 * 0.019**2)
    loose = ld.solve(sim.matches, prior=ld.Prior(sim.truth.static))[tied.names[0]].correct(PIXELS, errors=0.02)
    assert np.all(tied[tied.names[0]].correct(PIXELS, errors=0.02).absolute[:, 0, 0] < loose.absolute[:, 0, 0])


# -- what may be given


def test_quantities(solution):
    name, plain = solution.names[0], solution[solution.names[0]].correct(PIXELS, errors=np.full((4, 2), 0.03))
    for errors in (np.full((4, 2), 0.03) * u.pix, np.tile(9e-4 * np.eye(2), (4, 1, 1)) * u.pix**2):
        given = solution[name].correct(PIXELS * u.pix, errors=errors)
        assert given.xy.unit == u.pix
        assert given.relative.unit == given.absolute.unit == u.pix**2
        assert_allclose(given.absolute.value, plain.absolute)
    assert_allclose(solution[name].correct(PIXELS, errors=0.03).absolute, plain.absolute)
    assert_allclose(solution[name].correct(PIXELS[0], errors=[0.03, 0.03]).relative, plain.relative[:1])
    with pytest.raises(InputError, match="errors must be in pix, got arcsec"):
        solution[name].correct(PIXELS, errors=np.full((4, 2), 0.03) * u.arcsec)


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        (np.zeros((3, 2)), r"shape \(4, 2\) or covariances of shape \(4, 2, 2\).*got shape \(3, 2\)"),
        (np.zeros((4, 3, 3)), r"got shape \(4, 3, 3\)"),
        (np.full((4, 2), -0.1), "not negative.*row 0 has"),
        (np.array([[0.1, 0.1], [0.1, np.nan], [0.1, 0.1], [0.1, 0.1]]), "finite.*row 1 has"),
        (np.full((4, 2), np.inf), "finite"),
        (np.tile([[1.0, 2.0], [2.0, 1.0]], (4, 1, 1)), "positive; row 0"),
        (np.tile([[-1.0, 0.0], [0.0, -1.0]], (4, 1, 1)), "positive; row 0"),
        (np.tile([[1.0, 0.2], [0.1, 1.0]], (4, 1, 1)), "symmetric"),
    ],
)
def test_bad_errors_are_named(solution, errors, words):
    with pytest.raises(InputError, match=words):
        solution[solution.names[0]].correct(PIXELS, errors=errors)


# -- tables


def measured(solution):
    """A table of positions in two exposures, out of order, with correlated errors and a column of its own."""
    table = QTable({"exposure": [solution.names[k] for k in (3, 1, 3, 1)], "id": list("abcd")})
    table["x"], table["y"] = PIXELS.T * u.pix
    table["x_err"], table["y_err"] = np.array([[0.02, 0.03, 0.04, 0.05], [0.05, 0.04, 0.03, 0.02]]) * u.pix
    table["xy_corr"] = [0.0, 0.5, -0.5, 0.9]
    return table


def test_table_is_correct_row_by_row(solution):
    table = measured(solution)
    out = solution.correct_table(table)
    assert list(out["id"]) == list("abcd")
    assert list(out["exposure"]) == list(table["exposure"])
    assert_allclose(table["x"].value, PIXELS[:, 0])  # what was given is as it was
    for k, row in enumerate(table):
        xx, yy = row["x_err"].value, row["y_err"].value
        covariance = np.array([[xx**2, row["xy_corr"] * xx * yy], [row["xy_corr"] * xx * yy, yy**2]])
        xy, relative, absolute = solution[row["exposure"]].correct(PIXELS[k], errors=covariance[None])
        assert_allclose([out["x"][k].value, out["y"][k].value], xy[0])
        assert_allclose([out["x_err"][k].value, out["y_err"][k].value], np.sqrt(np.diag(relative[0])))
        assert_allclose([out["x_err_abs"][k].value, out["y_err_abs"][k].value], np.sqrt(np.diag(absolute[0])))
        assert out["xy_corr"][k] == pytest.approx(relative[0, 0, 1] / np.sqrt(relative[0, 0, 0] * relative[0, 1, 1]))
        jacobian = SKY.jacobian(xy)[0] * 3.6e6
        for suffix, each in (("", relative), ("_abs", absolute)):
            sky = jacobian @ each[0] @ jacobian.T
            errors = [out[f"{name}_error{suffix}"][k].to_value(u.mas) for name in ("ra", "dec")]
            assert_allclose(errors, np.sqrt(np.diag(sky)))
        place = SKY.to_sky(xy)[0]
        assert (out["ra"][k].to_value(u.deg), out["dec"][k].to_value(u.deg)) == pytest.approx(
            (place.ra.deg, place.dec.deg)
        )
    shared = [name for name in solution.stars.colnames if name in out.colnames]
    assert {"x_err_abs", "ra_error", "ra_dec_corr", "dec_error_abs"} <= set(shared)
    assert all(out[name].unit == solution.stars[name].unit for name in shared)
    assert out["ra_error"].info.meta["ucd"] == "stat.error;pos.eq.ra"


def test_table_without_a_sky_ends_in_the_plane(solution):
    out = replace(solution, sky=None).correct_table(measured(solution))
    assert "ra" not in out.colnames
    assert "x_err_abs" in out.colnames


def test_bad_tables_are_named(solution):
    table = measured(solution)
    with pytest.raises(InputError, match="the table of positions lacks the column x_err"):
        solution.correct_table(table["exposure", "x", "y", "y_err"])
    table["exposure"] = np.repeat("nobody", 4)
    with pytest.raises(InputError, match="no exposure 'nobody'"):
        solution.correct_table(table)
    table = measured(solution)
    table["y_err"][2] = 0 * u.pix
    with pytest.raises(InputError, match="y_err is not a positive finite number in 1 of 4 rows; the first is row 2"):
        solution.correct_table(table)


def test_positions_off_the_detector_are_warned_of(solution):
    table = measured(solution)
    nx = solution.estimate.shapes[solution.names[3]][1]
    table["x"][2], table["y"][3] = (nx - 0.4) * u.pix, -0.6 * u.pix
    words = rf"2 of 4 positions lie off their detector, .* row 2, \({nx}, .*\) in {solution.names[3]}, row 3, \("
    with pytest.warns(AssumptionWarning, match=words):
        out = solution.correct_table(table)
    assert np.isfinite(out["x"].value).all()
    table["x"][2], table["y"][3] = (nx - 0.6) * u.pix, -0.4 * u.pix
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution.correct_table(table)


@pytest.mark.parametrize("xy", [[[1, 2, 3]], [1, 2, 3], [[1]], "here"])
def test_what_are_no_positions_is_refused(solution, xy):
    for given in ({}, {"errors": np.zeros((1, 2))}):
        with pytest.raises(InputError, match=r"positions must be (x and y in pixels, an array .*, got shape|numbers)"):
            solution[solution.names[0]].correct(xy, **given)


def test_command(solution, tmp_path, capsys):
    solution.write(tmp_path / "solution.asdf")
    measured(solution).write(tmp_path / "new.ecsv")
    command = ["correct", str(tmp_path / "solution.asdf"), str(tmp_path / "new.ecsv"), "--out"]
    assert main([*command, str(tmp_path / "out.ecsv")]) == 0
    assert "4 positions in" in capsys.readouterr().out
    back, expected = QTable.read(tmp_path / "out.ecsv"), solution.correct_table(measured(solution))
    assert back.colnames == expected.colnames
    assert_allclose(back["ra_error_abs"].to_value(u.mas), expected["ra_error_abs"].to_value(u.mas))
    assert main([*command, str(tmp_path / "out.ecsv")]) == 1
    assert "exists" in capsys.readouterr().err
    assert main([*command, str(tmp_path / "out.doc")]) == 1
    assert "the ending selects the format" in capsys.readouterr().err


def test_files_keep_what_is_needed(solution, tmp_path):
    solution.write(tmp_path / "solution.asdf")
    again = ld.Solution.read(tmp_path / "solution.asdf")
    for a, b in zip(*(s[s.names[0]].correct(PIXELS, errors=0.02) for s in (again, solution)), strict=True):
        assert_allclose(a, b, rtol=1e-9)


# -- are they true?


@pytest.mark.parametrize(
    ("name", "n_sets", "tolerance"),
    [
        pytest.param("prior, exact, 0.02 px", 100, 0.15, marks=pytest.mark.sets),
        pytest.param("prior, exact, 0.003 px", 100, 0.15, marks=pytest.mark.sets),
        pytest.param("prior, exact, 0.003 px", 25, 0.3, marks=pytest.mark.slow),
        pytest.param("prior with static_sigma, 0.02 px", 100, 0.15, marks=pytest.mark.sets),
    ],
)
def test_errors_are_calibrated(name, n_sets, tolerance):
    """Truth of Chebyshev polynomials; relative after a cubic map, absolute after the similarity of the stars."""
    relative, absolute = new_positions_table.row(name, n_sets)
    assert relative == pytest.approx(1, abs=0.1)
    assert absolute == pytest.approx(1, abs=tolerance)  # 16 amplitudes of the common map a set
