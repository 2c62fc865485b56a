"""Errors found by `solve` count for new positions: true where numpy makes the truth, and exact by hand."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from numpy.polynomial import legendre
from numpy.testing import assert_allclose, assert_array_equal

import legdistort as ld
from legdistort.assessment.baselines import solve_relative
from legdistort.assessment.pulls import pulls_of
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.results.diagnostics import CorrelatedErrors, Diagnostics, ErrorLaw

SIZE, N_STARS, N_EXPOSURES = 2048, 160, 12
PIXELS = np.array([[300.0, 400.0], [1024.0, 1000.0], [1700.0, 350.0], [900.0, 1800.0]])
LAW = ErrorLaw(3.0, 0.2, 0.005, {"e00": 0.5, "e01": 2.0})


# -- are they true?


def drawn(seed, errors):
    """A table of rolled exposures of stars, their true places, distortions and errors made by numpy alone."""
    rng = np.random.default_rng(seed)
    middle = (SIZE - 1) / 2
    radius, angle = 950 * np.sqrt(rng.uniform(size=N_STARS)), rng.uniform(0, 2 * np.pi, N_STARS)
    sky = middle + np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    flux = 10 ** rng.uniform(2, 5, N_STARS)
    stated, shared = np.geomspace(0.005, 0.03, N_STARS)[rng.permutation(N_STARS)], None
    if errors == "correlated":  # over four exposures, in x twice as large as in y
        lag = np.abs(np.subtract.outer(np.arange(N_EXPOSURES), np.arange(N_EXPOSURES)))
        shared = np.linalg.cholesky(np.exp(-lag / 4)) @ rng.normal(size=(N_STARS, N_EXPOSURES, 2))
        shared *= [0.05, 0.025]
    tables, poses = [], {}
    for i in range(N_EXPOSURES):
        name, roll = f"e{i:02d}", np.radians(50.0 * i)
        turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
        q = middle + (sky - middle + (0 if shared is None else shared[:, i])) @ turn.T + rng.normal(0, 3, 2)
        bend = rng.normal(0, 0.2, (3, 3, 2)) * (np.add.outer(np.arange(3), np.arange(3)) <= 2)[..., None]
        p = q + legendre.legval2d(*((2 * q + 1) / SIZE - 1).T, bend).T
        factor = np.exp(rng.normal(0, 0.3))
        true = {
            "stated": np.hypot(stated, 0.03), "floor": np.hypot(stated, 0.03), "scale": 2 * stated,
            "by-brightness": factor * np.sqrt((3 / flux) ** 2 + 0.2**2 / flux + 0.01**2), "correlated": stated,
        }[errors]  # fmt: skip
        p += true[:, None] * rng.normal(size=p.shape)
        table = QTable({"exposure": np.repeat(name, N_STARS), "star": np.arange(N_STARS), "flux": flux})
        table["x"], table["y"] = p.T * u.pix
        table["x_err"] = table["y_err"] = (np.full(N_STARS, 0.1) if errors == "by-brightness" else stated) * u.pix
        tables.append(table)
        poses[name] = np.column_stack([turn, middle - turn @ np.full(2, middle)])
    columns = {name: np.concatenate([each[name] for each in tables]) for name in tables[0].colnames}
    return QTable(columns), sky, poses


def pulls(solution, table, sky):
    """Rms of the errors of new positions over those reported, in x and in y, after a common map of degree 2."""
    new = solution.correct_table(table)
    true = sky[np.asarray(new["star"])]
    x, y = ((true - true.mean(axis=0)) / 1000).T
    modes = np.column_stack([x**i * y**j for i in range(3) for j in range(3 - i)])
    out = []
    for k, axis in enumerate("xy"):
        error = new[f"{axis}_err"].value
        wrong = (new[axis].value - true[:, k]) / error
        weighted = modes / error[:, None]
        left = wrong - weighted @ np.linalg.lstsq(weighted, wrong, rcond=None)[0]
        out.append(np.sqrt(np.sum(left**2) / (len(left) - modes.shape[1])))
    return np.array(out)


@pytest.mark.parametrize(
    ("errors", "without"),
    [
        ("floor", 2.3),
        ("stated", 2.3),
        ("scale", 1.8),
        ("by-brightness", 0.18),
        pytest.param("correlated", 2.4, marks=pytest.mark.slow),
    ],
)
def test_errors_of_new_positions_are_true(errors, without):
    """Of stars that are not in the fit, in either axis; with the stated errors alone they are wrong."""
    found, stated = [], []
    for seed in range(2):
        table, sky, poses = drawn(seed, errors)
        fitted = np.asarray(table["star"]) % 2 == 0
        matches = ld.Matches.from_table(table[fitted], shape=(SIZE, SIZE), poses=poses)
        floor = {"error_floor": 0.03} if errors == "stated" else {}
        solution = ld.solve(matches, degree=2, clip=None, errors=errors, **floor)
        found.append(pulls(solution, table[~fitted], sky))
        stated.append(pulls(replace(solution, diagnostics=Diagnostics()), table[~fitted], sky))
    found, stated = (np.sqrt(np.mean(np.square(each), axis=0)) for each in (found, stated))
    assert_allclose(found, 1, atol=0.12)
    assert np.mean(stated) == pytest.approx(without, rel=0.1)


def test_stars_kept_out_have_the_law():
    """`validate`, where the stated errors are ten times too large."""
    table, _, poses = drawn(0, "by-brightness")
    matches = ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses)
    solution = ld.solve(matches, degree=2, clip=None, errors="by-brightness", validate=0.3)
    assert solution.diagnostics.validation.ratio == pytest.approx(1, abs=0.1)


def law_of(table, poses):
    """Solution with a law of brightness, and its errors in an exposure, (n,)."""
    matches = ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses)
    solution = ld.solve(matches, degree=2, clip=None, errors="by-brightness")
    return solution, solution.residuals["x_err"].value[np.asarray(table["exposure"]) == "e04"]


@pytest.mark.parametrize("seed", [0, 1, 2, 5, 33])
def test_law_of_measured_variances(seed):
    """Fluxes over seven magnitudes, three faint positions that are wrong: the search went to and fro for ever.

    It ended at a law that is five times too small for most stars, or 200 times, with factors of exposures of 200.
    """
    rng = np.random.default_rng(seed)
    flux = 10 ** (0.4 * (11.5 - 7 * rng.power(2.2, 132)))
    flux, exposure, factor = np.tile(flux, 5), np.repeat(np.arange(5), 132), np.array([0.9, 1.0, 1.1, 1.0, 1.0])
    true = np.sqrt((4.75 / flux) ** 2 + 0.24**2 / flux + 0.008**2) * factor[exposure]
    variance = true**2 * rng.exponential(size=len(true))
    variance[np.argsort(flux)[:3]] *= 10
    law, found, _ = ErrorLaw.likelier(flux, variance, exposure, np.ones(5))
    assert_allclose(law.sigma(flux) * found[exposure], true, rtol=0.4)
    assert_allclose(found, factor, rtol=0.15)
    assert_allclose(np.mean(variance / (law.sigma(flux) * found[exposure]) ** 2), 1, rtol=0.02)


def test_zero_points_of_lists_are_not_their_errors(tmp_path):
    """One exposure whose fluxes have another unit has the errors that it has without, wherever the law is applied."""
    table, _, poses = drawn(3, "by-brightness")
    solution, expected = law_of(table, poses)
    odd = np.asarray(table["exposure"]) == "e04"
    table["flux"] = np.where(odd, table["flux"] / 12, table["flux"])
    shifted, found = law_of(table, poses)
    assert_allclose(found, expected, rtol=1e-4)
    levels = shifted.diagnostics.error_law.levels
    assert levels["e04"] / levels["e03"] == pytest.approx(12, rel=1e-3)
    assert "; fluxes times 0.813 to 9.76 by exposure, by common stars" in str(shifted.diagnostics.error_law)
    assert solution.diagnostics.error_law.levels == {}
    back = ld.Solution.read(shifted.write(tmp_path / "s.asdf"))
    rows, plain = table[odd][:20], drawn(3, "by-brightness")[0][odd][:20]
    assert_allclose(back.correct_table(rows)["x_err"].value, solution.correct_table(plain)["x_err"].value, rtol=1e-3)
    one = back["e04"].correct([[500.0, 600.0]], errors=0.1, flux=100.0).relative
    assert_allclose(one, solution["e04"].correct([[500.0, 600.0]], errors=0.1, flux=1200.0).relative, rtol=1e-3)


def test_counts_of_short_exposures_tell_their_errors():
    """A tenth of the time: faint stars have larger errors, bright ones have their floor; no factor makes that good."""
    table, _, poses = drawn(3, "by-brightness")
    rng, flux = np.random.default_rng(3), np.array(table["flux"])
    short = np.isin(table["exposure"], [f"e{i:02d}" for i in range(6)])
    counts = np.where(short, flux / 10, flux)
    long, true = (np.sqrt((3 / f) ** 2 + 0.2**2 / f + 0.01**2) for f in (flux, counts))
    for name in "xy":
        table[name] += rng.normal(0, np.sqrt(true**2 - long**2)) * u.pix
    table["flux"] = counts
    solution, found = law_of(table, poses)
    assert solution.diagnostics.error_law.levels == {}
    ratio = found / true[np.asarray(table["exposure"]) == "e04"]
    assert np.ptp(np.log(ratio)) < 0.3


# -- by hand


@pytest.fixture(scope="module")
def matches():
    return ld.simulate_matches(n_exposures=4, n_stars=40, degree=1, sigma=0.02, dither=30.0, seed=3).matches


@pytest.fixture(scope="module")
def plain(matches):
    return ld.solve(matches, degree=1, clip=None)


def finding(solution, **found):
    """The same solution with other errors found."""
    return replace(solution, diagnostics=Diagnostics(**found))


def test_floor_and_scale_go_with_the_measurement_alone():
    stated = np.array([[[0.04, 0.01], [0.01, 0.09]], [[1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]])
    expected = 4 * (stated + [[0.25, 0], [0, 0.25]])
    expected[2] = 0  # no measurement
    assert_allclose(Diagnostics(error_floor=0.5, error_scale=2.0).found_errors(stated), expected)
    assert_array_equal(Diagnostics().found_errors(stated), stated)
    assert_array_equal(stated[2], 0)


def test_a_law_takes_the_place_of_variances():
    """Whose correlation stays, as for the observations; without a flux nothing changes."""
    stated = np.array([[[0.04, 0.03], [0.03, 0.09]]] * 5)
    flux = [100.0, 1e4, np.nan, -5.0, 100.0]
    found = Diagnostics(error_law=LAW).found_errors(stated, flux=flux, exposure=["e00", "e01", "e00", "e00", "else"])
    for k, factor in ((0, 0.5), (1, 2.0), (4, 1.0)):
        variance = factor**2 * ((3.0 / flux[k]) ** 2 + 0.2**2 / flux[k] + 0.005**2)
        assert_allclose(found[k], variance * np.array([[1, 0.5], [0.5, 1]]))
    assert_array_equal(found[2:4], stated[2:4])
    assert_array_equal(Diagnostics(error_law=LAW).found_errors(stated), stated)
    average = Diagnostics(error_law=LAW).found_errors(stated, flux=flux)
    assert_allclose(average[0], average[4])


def test_shared_errors_go_along_the_axes_of_the_plane():
    shared = CorrelatedErrors(0.1, x=0.3, y=0.2, along="time", length=3.0, longest=8.0, unit="exposures")
    floor = float(np.sqrt(0.1**2 + (0.3**2 + 0.2**2) / 2))
    found, stated = Diagnostics(error_floor=floor, correlated=shared), np.array([0.04 * np.eye(2)])
    turned = np.array([[0.0, -2.0], [2.0, 0.0]])  # a plane whose pixels are twice as large
    assert_allclose(found.found_errors(stated, axes=turned)[0], np.diag([0.05 + 0.16, 0.05 + 0.36]))
    assert_allclose(found.found_errors(stated)[0], (0.04 + floor**2) * np.eye(2))
    none = Diagnostics(error_floor=0.1, correlated=CorrelatedErrors(0.1))
    assert_allclose(none.found_errors(stated, axes=turned)[0], 0.05 * np.eye(2))


def test_zeros_leave_the_correction_alone(plain):
    floored = finding(plain, error_floor=0.5, error_scale=3.0)
    name = plain.names[1]
    for a, b in zip(floored[name].correct(PIXELS, errors=0.0), plain[name].correct(PIXELS, errors=0.0), strict=True):
        assert_array_equal(a, b)
    assert_array_equal(floored[name].sigma_map(n=4)[2], plain[name].sigma_map(n=4)[2])


def test_scale_counts_once(matches, plain):
    """The coefficients have it already: the measurement gets it, and everything is scaled alike."""
    scaled = ld.solve(matches, degree=1, clip=None, errors="scale")
    scale, name = scaled.diagnostics.error_scale, plain.names[1]
    assert abs(scale - 1) > 0.01
    for errors in (0.0, 0.02):
        one, two = (s[name].correct(PIXELS, errors=errors).relative for s in (plain, scaled))
        assert_allclose(two, scale**2 * one, rtol=1e-6)


@pytest.mark.parametrize(
    "found",
    [
        {"error_floor": 0.05},
        {"error_law": ErrorLaw(3.0, 0.2, 0.005, {"exp00": 0.5, "exp01": 2.0})},
        {"correlated": CorrelatedErrors(0.1, 0.3, 0.2, "time", 3.0, 8.0, "exposures"), "error_floor": 0.27},
    ],
)
def test_tables_row_by_row(plain, found):
    solution, flux = finding(plain, **found), np.array([100.0, 1e3, 1e4, 1e5])
    table = QTable({"exposure": [plain.names[k] for k in (2, 0, 2, 1)], "mag": -2.5 * np.log10(flux)})
    table["x"], table["y"] = PIXELS.T * u.pix
    table["x_err"], table["y_err"] = np.array([[0.02, 0.03, 0.04, 0.05], [0.05, 0.04, 0.03, 0.02]]) * u.pix
    out = solution.correct_table(table)
    for k, row in enumerate(table):
        errors = [row["x_err"].value, row["y_err"].value]
        one = solution[str(row["exposure"])].correct(PIXELS[k], errors=errors, flux=flux[k])
        assert_allclose([out["x"][k].value, out["y"][k].value], one.xy[0])
        assert_allclose([out["x_err"][k].value, out["y_err"][k].value], np.sqrt(np.diag(one.relative[0])))
        stated = plain[str(row["exposure"])].correct(PIXELS[k], errors=errors)
        assert np.abs(one.relative / stated.relative - 1).max() > 0.2


def test_positions_without_a_flux_keep_their_errors_with_a_warning(plain):
    solution, name = finding(plain, error_law=LAW), plain.names[0]
    expected = plain[name].correct(PIXELS, errors=0.03)
    with pytest.warns(AssumptionWarning, match="4 of 4 positions have no positive flux and keep the errors that were"):
        assert_array_equal(solution[name].correct(PIXELS, errors=0.03).relative, expected.relative)
    table = QTable({"exposure": [name] * 3 + [plain.names[1]], "flux": [10.0, 0.0, np.nan, -1.0]})
    table["x"], table["y"], table["x_err"], table["y_err"] = *PIXELS.T * u.pix, *np.full((2, 4), 0.03) * u.pix
    with pytest.warns(AssumptionWarning, match=r"^3 of 4 positions .* column flux or mag\)") as caught:
        out = solution.correct_table(table)
    assert len(caught) == 1
    assert_allclose(out["x_err"][1].value ** 2, expected.relative[1, 0, 0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution[name].correct(PIXELS, errors=0.03, flux=1e3)
        solution[name].correct(PIXELS, errors=0.0)  # no measurement
        solution[name].correct(PIXELS)
        plain[name].correct(PIXELS, errors=0.03, flux=np.nan)


def test_lists_without_errors_have_those_of_the_law(plain):
    """Where they have a flux or magnitude; else another error is asked for, and nothing is said of solve."""
    solution = finding(plain, error_law=ErrorLaw(3.0, 0.2, 0.005, {plain.names[0]: 2.0}, {plain.names[0]: 10.0}))
    table = QTable({"exposure": [plain.names[0]] * 4, "mag": -2.5 * np.log10([100.0, 1e3, 1e4, 1e5])})
    table["x"], table["y"] = PIXELS.T * u.pix
    flux = 10 * np.array([100.0, 1e3, 1e4, 1e5])
    sigma = 2 * np.sqrt((3.0 / flux) ** 2 + 0.2**2 / flux + 0.005**2)
    found = solution.correct_table(table)
    stated = table.copy()
    stated["x_err"] = stated["y_err"] = sigma * u.pix
    expected = finding(plain).correct_table(stated)
    for name in ("x_err", "y_err", "x_err_abs"):
        assert_allclose(found[name].value, expected[name].value)
    some = stated.copy()
    some["x_err"][1] = np.nan * u.pix
    assert_allclose(solution.correct_table(some)["x_err"].value, expected["x_err"].value)
    table.remove_column("mag")
    with pytest.raises(
        InputError, match=r"lacks the columns x_err, y_err; .*--error PIXELS, or a column flux or mag: "
    ):
        solution.correct_table(table)
    with pytest.raises(InputError, match=r"lacks the columns x_err, y_err; .* or --error PIXELS\)$"):
        plain.correct_table(table)
    stated["mag"] = [10.0, 99.0, 99.0, 10.0]
    stated.remove_columns(["x_err", "y_err"])
    with pytest.raises(InputError, match="x_err is not a positive finite number in 2 of 4 rows"):
        solution.correct_table(stated)


def test_bad_fluxes_are_named(plain):
    name = plain.names[0]
    for flux in ([1.0, 2.0], "bright", np.ones((4, 2))):
        with pytest.raises(InputError, match="flux must be a number for each of the positions, of which there are 4"):
            plain[name].correct(PIXELS, errors=0.03, flux=flux)
    with pytest.raises(InputError, match=r"flux tells the errors .* give errors too"):
        plain[name].correct(PIXELS, flux=1e3)


def test_pulls_are_those_of_the_errors_in_force(matches):
    """Their squares sum to chi2 with a floor too, which leaves the covariance of x and y as it is."""
    table = matches.table.copy()
    table["xy_corr"] = 0.8
    correlated = ld.Matches.from_table(table, shape=matches.shapes, poses=matches.poses)
    solution = ld.solve(correlated, degree=1, clip=None, error_floor=0.03)
    assert pulls_of(solution).squares.sum() == pytest.approx(solution.chi2, rel=1e-6)


def test_a_relative_polynomial_has_its_floor(matches):
    solution = solve_relative(matches, degree=1, error_floor=0.5)
    found = solution[solution.names[1]].correct(PIXELS, errors=1e-6).relative
    assert solution.diagnostics.error_floor == 0.5
    assert np.all(found[:, 0, 0] > 0.9 * (solution.diagnostics.error_scale * 0.5) ** 2)
