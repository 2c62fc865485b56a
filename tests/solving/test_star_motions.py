"""Stars that move: proper motions and parallaxes in the same solution, against oracles that share no code with it."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import Table
from erfa import ErfaWarning
from matplotlib.collections import PathCollection
from moving_stars import (
    FIVE,
    RNG,
    SKY,
    THREE,
    MovingOracle,
    field,
    gaia,
    positions_at,
    without_a_map,
    without_a_similarity,
)
from night_sets import SIZE, Nights
from numpy.testing import assert_allclose

from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry.parallax import on_plane, parallax_factors
from legdistort.matching.matches import Matches
from legdistort.plots import motion_plots
from legdistort.priors.prior import Prior
from legdistort.reporting.page import write_report
from legdistort.results import accuracy, in_tables
from legdistort.results.solution import Solution
from legdistort.simulation.prediction import predict as plan
from legdistort.solving import motion_choice, star_motions, start_values
from legdistort.solving.equations import criterion, elimination, reduced_system
from legdistort.solving.equations.problem import build_problem
from legdistort.solving.equations.star_terms import unpacked
from legdistort.solving.estimation import solve
from legdistort.solving.options import SolveOptions


@pytest.mark.parametrize(
    ("kind", "epochs"),
    [pytest.param("proper", np.repeat([2015.3, 2016.5, 2019.2], 2), marks=pytest.mark.slow), ("parallax", FIVE[::2])],
)
def test_the_dense_oracle_agrees(kind, epochs):
    """Positions, motions, parallaxes, coefficients and covariances, to the accuracy of both."""
    exposures = {"n_exposures": len(epochs), "rotations": np.linspace(0, 40, len(epochs)), "epochs": epochs}
    sim = field(14, degree=1, static=0.5, sigma=0.03, corr=0.3, parallax=0.1, **exposures)
    solution = solve(sim.matches, degree=1, motion=kind, clip=None)
    time = (epochs - in_tables.epoch(solution))[:, None, None] * np.eye(2)
    phi = time if kind == "proper" else np.concatenate([time, on_plane(SKY, epochs)[:, :, None]], axis=2)
    oracle = MovingOracle(sim.matches, solution, phi)
    found = oracle.solve()
    stars, coefficients = oracle.unpack(found.x)
    assert 2 * found.cost == pytest.approx(solution.chi2, rel=1e-6)
    assert_allclose(solution.estimate.positions, stars[:, :2], atol=1e-5)
    assert_allclose(solution.estimate.motions.values, stars[:, 2:], atol=1e-5)
    assert_allclose(solution.coefficients, coefficients, atol=2e-5)
    expected = oracle.covariance_of_stars(found.x)
    assert_allclose(unpacked(solution.estimate.uncertainty.star_unknowns), expected, atol=2e-5 * np.abs(expected).max())
    n_free = expected.shape[1] * 14 + coefficients.size - len(oracle.rows)
    assert solution.dof == 2 * len(sim.matches.table) - n_free


@pytest.mark.parametrize(("last", "asked"), [(2015.9, False), (2018.4, True)])
def test_years_between_exposures_are_asked_about(last, asked, caplog):
    caplog.set_level("INFO", logger="legdistort")
    sim = field(3, degree=1, n_exposures=4, epochs=np.linspace(2015.3, last, 4))
    solve(sim.matches, degree=1)
    assert ("the exposures span 3.1 years, in which stars may have moved: motion='auto'" in caplog.text) is asked


def test_rows_of_zero_motion_change_nothing():
    """Stars held at zero motion by what is known of them are stars without motions, in much the same plane."""
    sim = field(60, motion=0.0)
    plain = solve(sim.matches, clip=None)
    held = solve(sim.matches, clip=None, motion="proper", motion_sigma=1e-7)
    assert np.abs(held.estimate.motions.values).max() < 1e-7
    assert held.chi2 == pytest.approx(plain.chi2, rel=1e-3)


@pytest.mark.parametrize(
    ("single", "motion", "most", "least"),
    [(0.003, 0.3, 1.2, 0.8), pytest.param(1.0, 0.01, 0.5, 0.0, marks=pytest.mark.slow)],
)
def test_stars_and_exposures_hold_the_map_of_motions_by_their_weights(single, motion, most, least):
    """Stars that scatter far say little where exposures are alike, and much where these are not."""
    nights = Nights(1, nights=6, per=3, n_stars=120, nightly=0.0, single=single, motion=motion, roll=0.7)
    given, found = Matches.from_table(nights.table, shape=(SIZE, SIZE)), []
    for sigma in (None, motion):
        solution = solve(given, motion="proper", motion_sigma=sigma)
        stars = solution.stars[np.asarray(solution.stars["n_epochs"]) > 2]
        z, v = (stars[x].value + 1j * stars[y].value for x, y in ("xy", ("vx", "vy")))
        common = np.stack([np.ones(len(z)), z - z.mean()], axis=1)
        off = v - nights.motion[stars["star"]] @ [1, 1j]
        off -= common @ np.linalg.lstsq(common, off, rcond=None)[0]
        variance = stars["vx_err_abs"].value ** 2 + stars["vy_err_abs"].value ** 2
        found.append([np.mean(np.abs(off) ** 2), np.mean(variance)])
        assert found[-1][0] < 2 * found[-1][1]
    for free, held in np.sqrt(found).T:
        assert least * free < held < most * free


@pytest.mark.parametrize(("seed", "motion"), [(0, 0.02), (1, 0.0), pytest.param(2, 0.02, marks=pytest.mark.slow)])
def test_motions_show_between_two_nights_that_are_turned(seed, motion):
    """What both leave open is a map of all motions, 10 times as large as one: no scatter of motions hides in that."""
    nights = Nights(seed, nights=2, per=5, nightly=0.0, single=0.003, motion=motion, roll=60.0)
    solution = solve(Matches.from_table(nights.table, shape=(SIZE, SIZE)), motion="auto")
    found = solution.diagnostics.motion_scatter
    assert found.is_there == (motion > 0)
    assert found.sigma == pytest.approx(motion, rel=0.15, abs=0.003)
    assert solution.chi2 / solution.dof < 1.1


@pytest.mark.parametrize(("n_nights", "told"), [(2, False), (3, False), (4, True)])
@pytest.mark.filterwarnings("ignore:static='fit'. . of 14 unknowns")
def test_few_nights_with_one_static_distortion_say_that_errors_of_motions_are_unsure(n_nights, told, tmp_path):
    """Of two what nothing determines of the static distortion shows as motions, whose errors are not known then."""
    nights = Nights(1, nights=n_nights, per=4, nightly=0.0, single=0.0, motion=0.02, n_stars=100)
    solution = solve(Matches.from_table(nights.table, shape=(SIZE, SIZE)), motion="auto", static="fit")
    assert ("Too few nights tell such a map" in str(solution.gauge)) != told
    for each in (solution, Solution.read(solution.write(tmp_path / "solution.asdf"))):
        twice = each.stars[each.stars["n_epochs"] > 1]
        assert np.isfinite(twice["vx_err"].value).all()
        assert np.isfinite(twice["vx_err_abs"].value).mean() == pytest.approx(0 if n_nights == 2 else 1, abs=0.05)


def test_a_star_that_two_epochs_have_move_unlike_all_others_is_named():
    """One of its positions is that of another star, and no third one tells."""
    nights = Nights(2, nights=4, per=2, n_stars=60, motion=0.3, roll=0.7)
    table, states = nights.table, []
    for wrong in (0.0, 25.0):
        star = table[table["exposure"] == "n3e0"]["star"][5]
        rows = table[~((table["star"] == star) & np.isin(table["block"], [1, 2]))]
        rows["x"][(rows["star"] == star) & (rows["block"] == 3)] += wrong
        solution = solve(Matches.from_table(rows, shape=(SIZE, SIZE)), motion="proper", clip=None)
        assert solution.stars["n_epochs"][list(solution.stars["star"]).index(star)] == 2
        states.append(next(check for check in solution.checks if check.name == "stars"))
    assert [each.state for each in states] == ["pass", "warn"]
    assert f"one star moves unlike all others, and nothing checks that, it was seen at two epochs only: {star} (" in (
        states[1].sentence
    )


def test_rates_that_fixed_modes_cannot_take_back_are_found():
    """With all of degree 2 fixed at the truth, a drift of degree 2 of all stars shows in the residuals."""
    sim = field(60, np.repeat([2015.0, 2017.0, 2019.0], 4), degree=2, dynamic=0.0, zero_mean=False)
    sigma = np.where(np.arange(6) < 3, np.inf, 0.0)
    fixed, free = (solve(sim.matches, degree=2, motion="proper", clip=None, prior=Prior(sim.truth.static, sigma=width))
                   for width in (sigma, None))  # fmt: skip
    assert_allclose(fixed.coefficients[:, :, 3:], np.broadcast_to(sim.truth.static[:, 3:], (12, 2, 3)), atol=1e-9)
    assert fixed.gauge.drift.maps.shape[0] < free.gauge.drift.maps.shape[0]
    assert fixed.chi2 / fixed.dof == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("kind", ["proper", "parallax"])
def test_compiled_sums_are_the_plain_ones(monkeypatch, kind):
    sim = field(120, FIVE, parallax=0.1, seen=0.7, corr=0.4)
    motion = star_motions.terms_of(SolveOptions(motion=kind))
    problem = build_problem(sim.matches, 3, motion=motion)
    state, _ = start_values.start(problem, np.stack([sim.matches.poses[name] for name in sim.matches.names]))
    assert state.stars.shape == (4 if kind == "proper" else 5, 120)
    plain = criterion.linearise(problem, state)
    a, y = RNG.normal(size=plain.g_exposure.shape), RNG.normal(size=state.stars.shape)
    sums = elimination.to_stars(problem, plain, a), elimination.to_exposures(problem, plain, y)
    monkeypatch.setattr("legdistort.solving.equations.problem.COMPILED_FROM", 0)
    fast = criterion.linearise(problem, state)
    for name in ("chi2", "residual", "v", "g_star", "u", "g_exposure"):
        expected = getattr(plain, name)
        assert_allclose(getattr(fast, name), expected, atol=1e-10 * np.abs(expected).max(), err_msg=name)
    fast_sums = elimination.to_stars(problem, fast, a), elimination.to_exposures(problem, fast, y)
    for mine, expected in zip(fast_sums, sums, strict=True):
        assert_allclose(mine, expected, atol=1e-6 * np.abs(expected).max())


def test_conjugate_gradients_find_the_same(monkeypatch):
    sim = field(80, FIVE, parallax=0.1)
    direct = solve(sim.matches, motion="parallax", clip=None)
    monkeypatch.setattr(reduced_system, "uses_direct", lambda problem: False)
    iterative = solve(sim.matches, motion="parallax", clip=None)
    assert_allclose(iterative.estimate.positions, direct.estimate.positions, atol=1e-4)
    assert_allclose(iterative.estimate.motions.values, direct.estimate.motions.values, atol=1e-4)


def test_the_exposures_may_come_in_any_order():
    sim = field(40)
    solution = solve(sim.matches, motion="proper", clip=None)
    shuffled = RNG.permutation(len(sim.matches.table))
    again = type(sim.matches).from_table(sim.matches.table[shuffled], shape=sim.matches.shapes, poses=sim.matches.poses)
    assert_allclose(
        solve(again, motion="proper", clip=None).estimate.motions.values, solution.estimate.motions.values, atol=1e-5
    )


@pytest.mark.parametrize(("n", "accuracy"), [(8, 0.1), pytest.param(60, 0.05, marks=pytest.mark.sets)])
def test_relative_errors_are_calibrated(n, accuracy):
    """Squared pulls after a cubic map of all stars, over n realisations."""
    pulls = {name: [] for name in ("x", "vx")}
    for seed in range(n):
        sim = field(seed=seed)
        solution = solve(sim.matches, motion="proper", clip=None)
        stars, truth = solution.stars, sim.truth
        true = {"x": truth.positions + (in_tables.epoch(solution) - truth.epoch) * truth.motions, "vx": truth.motions}
        for name, found in (("x", solution.estimate.positions), ("vx", solution.estimate.motions.values)):
            left, _ = without_a_map(found - true[name], truth.positions)
            errors = np.column_stack([stars[f"{k}_err"].value for k in (name, name.replace("x", "y"))])
            pulls[name].append(np.sum(left**2) / np.sum(errors**2))
    assert np.mean(pulls["x"]) == pytest.approx(1, abs=accuracy)
    assert np.mean(pulls["vx"]) == pytest.approx(1, abs=accuracy)


@pytest.mark.parametrize(
    ("n", "kind", "accuracy"),
    [
        pytest.param(12, "proper", 0.25, marks=pytest.mark.slow),  # of 16 modes
        pytest.param(150, "proper", 0.1, marks=pytest.mark.sets),
        pytest.param(150, "parallax", 0.1, marks=pytest.mark.sets),
    ],
)
def test_absolute_errors_of_motions_are_calibrated(n, kind, accuracy):
    """After a common rate of shift, rotation and scale, and the mean parallax, by the scatter of single exposures."""
    true, stated = [], []
    for seed in range(n):
        epochs, more = (THREE, {}) if kind == "proper" else (FIVE, {"parallax": 0.1})
        sim = field(100, epochs, seed=seed, min_exposures=len(epochs), **more)
        solution = solve(sim.matches, motion=kind, clip=None)
        found = solution.estimate.motions.values
        left = without_a_similarity(found[:, :2] - sim.truth.motions, sim.truth.positions)
        true.append([np.mean(left**2)])
        stated.append([np.mean([np.mean(solution.stars[name].value ** 2) for name in ("vx_err_abs", "vy_err_abs")])])
        if kind == "parallax":
            true[-1].append(np.var(found[:, 2] - sim.truth.parallaxes))
            stated[-1].append(np.mean((solution.stars["parallax_error_abs"].value / 10) ** 2))
    ratio = np.mean(true, axis=0) / np.mean(stated, axis=0)
    assert_allclose(ratio, 1, atol=accuracy)


def test_the_common_rates_are_unknown_and_said():
    gauge = solve(field(60).matches, motion="proper").gauge
    assert "common rates of shift, rotation and scale, which are not known without a reference" in str(gauge)
    assert gauge.n_maps == 20
    assert gauge.n_constraints == 40


def test_what_of_motions_is_a_convention_stands_beside_them():
    """In the print and with the table, not in the gauge alone: a common expansion passes for one of the stars."""
    solution = solve(field(60).matches, motion="proper")
    words = "motions up to common rates of shift, rotation and scale, not known without a reference (their mean is zero"
    assert words in " ".join(str(solution).split())
    assert solution.stars.meta["motions"].startswith(words)
    assert solution.stars_at(2018.0).meta["motions"].startswith(words)
    still = solve(field(60).matches, motion=None, errors="floor")
    assert "motions" not in still.stars.meta
    assert "common rates" not in str(still)


def test_a_drift_of_the_nominal_poses_is_no_motion():
    """They come from where stars were matched; the motions of all stars are at rest in the mean, whatever they are."""
    sim = field(seed=3, sigma=0.02, motion=0.2)
    drift = {name: np.array([0.4, -0.3]) * (year - 2017) for name, year in zip(sim.matches.names, THREE, strict=True)}
    moved = {name: pose + np.column_stack([np.zeros((2, 2)), drift[name]]) for name, pose in sim.matches.poses.items()}
    plain, other = (solve(each, motion="proper") for each in (sim.matches, replace(sim.matches, poses=moved)))
    typical = plain.stars["vx_err"] < 5 * np.median(plain.stars["vx_err"])
    for axis in ("vx", "vy"):
        assert abs(np.mean(plain.stars[axis][typical].value)) < 1e-3
        error = plain.stars[f"{axis}_err_abs"]  # the smallest dynamic part is not quite the same after a shift
        assert np.all(np.abs(other.stars[axis] - plain.stars[axis]) < 0.1 * error)
    assert other.chi2 == pytest.approx(plain.chi2, rel=1e-6)
    for solution in (plain, other):  # stars are where the exposures have them
        table = solution.residuals[solution.residuals["exposure"] == solution.names[0]]
        there = solution.stars_at(THREE[0])
        row = {name: k for k, name in enumerate(there["star"])}
        at = [row[name] for name in table["star"]]
        xy = solution[solution.names[0]].distort(np.column_stack([there["x"].value, there["y"].value])[at])
        assert_allclose(xy, np.column_stack([table["x"].value, table["y"].value]), atol=0.15)


@pytest.mark.parametrize(("size", "chosen"), [pytest.param(0.0, None, marks=pytest.mark.slow), (1.1, "proper")])
def test_auto_decides_by_evidence(size, chosen):
    """Motionless sets stay so, sets whose motions scatter by one error of a star's motion do not.

    That is 1.1 relative errors of these 60 stars, of which a cubic map is taken off.
    """
    right = 0
    for seed in range(5):
        still = field(60, motion=0.0, seed=seed)
        error = np.median(solve(still.matches, motion="proper", clip=None).stars["vx_err"].value)
        moving = field(60, motion=size * error, seed=seed)
        right += solve(moving.matches, motion="auto", clip=None).settings.motion == chosen
    assert right == 5


@pytest.mark.parametrize(
    "n_sets", [pytest.param(10, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.sets)]
)
def test_auto_decides_by_evidence_in_many_sets(n_sets):
    wrong, missed = 0, 0
    for seed in range(n_sets):
        still = field(60, motion=0.0, seed=seed)
        error = np.median(solve(still.matches, motion="proper", clip=None).stars["vx_err"].value)
        wrong += solve(still.matches, motion="auto", clip=None).settings.motion is not None
        moving = field(60, motion=1.1 * error, seed=seed)
        missed += solve(moving.matches, motion="auto", clip=None).settings.motion is None
    few = 0.05 * n_sets + (1 if n_sets < 100 else 0)  # a standard deviation
    assert wrong <= few
    assert missed <= few


def test_the_scatter_of_motions_is_found():
    solution = solve(field().matches, motion="proper", motion_sigma="evidence")
    assert solution.settings.motion_sigma == pytest.approx(0.3, rel=0.08)
    assert solution.diagnostics.motion_scatter.is_there
    assert motion_choice.MotionScatter(0.0, 1.0, 30).is_there is False


def test_a_star_seen_at_one_epoch_has_no_motion():
    sim = field(60)
    table = sim.matches.table
    keep = ~((table["star"] == 7) & (table["epoch"].value > 2016))
    matches = type(sim.matches).from_table(table[keep], shape=sim.matches.shapes, poses=sim.matches.poses)
    solution = solve(matches, motion="proper", clip=None)
    row = solution.stars[7]
    assert row["n_epochs"] == 1
    assert row["span"].value == 0
    assert np.isnan([row["vx"].value, row["vx_err"].value, row["vx_err_abs"].value]).all()
    assert np.isfinite([row["x"].value, row["x_err"].value]).all()
    assert "1 seen at a single epoch stays where it was then" in " ".join(str(solution).split())
    assert np.isfinite(np.delete(solution.estimate.motions.values, 7, axis=0)).all()
    known = solve(matches, motion="proper", clip=None, motion_sigma=0.3)  # where the scatter is known, it has its error
    assert 0.3 < known.stars[7]["vx_err"].value < 0.34  # and that of the map common to the others


@pytest.mark.slow
def test_positions_at_another_time():
    solution = solve(field(60, FIVE, parallax=0.1).matches, motion="parallax")
    moved = positions_at(solution, in_tables.epoch(solution) + 2.0) - solution.estimate.positions
    expected = 2 * solution.estimate.motions.values[:, :2] + solution.estimate.motions.values[:, 2:] * on_plane(
        SKY, [in_tables.epoch(solution) + 2]
    )
    assert_allclose(moved, expected, atol=1e-9)
    with pytest.raises(InputError, match="motion='proper'"):
        positions_at(solve(field(60).matches), 2015.0)


def test_the_epoch_of_the_positions_may_be_given():
    sim = field(60)
    mean, early = (solve(sim.matches, motion="proper", clip=None, motion_epoch=t) for t in (None, 2012.0))
    assert mean.stars.meta["epoch"] == pytest.approx(np.average(THREE), abs=0.05)
    assert early.stars.meta["epoch"] == 2012.0
    assert early.chi2 == pytest.approx(mean.chi2, rel=1e-6)
    assert np.median(early.stars["x_err"]) > 3 * np.median(mean.stars["x_err"])
    left, _ = without_a_map(positions_at(mean, 2012.0) - early.estimate.positions, sim.truth.positions)
    assert np.abs(left).max() < 0.01


def test_motions_on_the_sky():
    sim = field(60, FIVE, parallax=0.1)
    solution = solve(sim.matches, motion="parallax")
    stars = solution.stars
    assert stars["pmra"].unit == "mas / yr"
    # 10 mas a pixel, x to the west
    assert_allclose(stars["pmra"].value, -10 * stars["vx"].value, rtol=1e-3, atol=1e-3)
    assert_allclose(stars["pmdec"].value, 10 * stars["vy"].value, rtol=1e-3, atol=1e-3)
    assert_allclose(stars["pmra_error"].value, 10 * stars["vx_err"].value, rtol=1e-3)
    assert_allclose(stars["parallax"].value, 10 * solution.estimate.motions.values[:, 2], rtol=1e-3)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=ErfaWarning)  # astropy moves stars without a distance so
        moved = stars["sky"].apply_space_motion(new_obstime=stars["sky"].obstime + 3 * u.yr)
    expected = SKY.to_sky(solution.estimate.positions + 3 * solution.estimate.motions.values[:, :2])
    assert moved.separation(expected).mas.max() < 0.01


def almanac(years):
    """Parallax factors at ``SKY`` from the low-precision Sun of the Astronomical Almanac, good to 0.01 degrees."""
    n = (np.asarray(years) - 2000.0) * 365.25
    g, mean = np.radians(357.528 + 0.9856003 * n), 280.460 + 0.9856474 * n
    lon = np.radians(mean + 1.915 * np.sin(g) + 0.020 * np.sin(2 * g) - 1.397 * (np.asarray(years) - 2000) / 100)
    r, tilt = 1.00014 - 0.01671 * np.cos(g) - 0.00014 * np.cos(2 * g), np.radians(23.439)
    x, y, z = r * np.cos(lon), r * np.cos(tilt) * np.sin(lon), r * np.sin(tilt) * np.sin(lon)  # Sun from the Earth
    ra, dec = np.radians([SKY.lon, SKY.lat])
    east = -x * np.sin(ra) + y * np.cos(ra)
    north = -x * np.cos(ra) * np.sin(dec) - y * np.sin(ra) * np.sin(dec) + z * np.cos(dec)
    return np.column_stack([east, north])


def test_parallax_factors_are_those_of_the_almanac():
    """Stars move towards the Sun; the Sun is up to 0.01 AU from the barycentre."""
    years = np.linspace(2015, 2019, 30)
    assert_allclose(parallax_factors(SKY.lon, SKY.lat, years), almanac(years), atol=0.012)


def test_parallaxes_are_found():
    sim = field(150, FIVE, parallax=0.2, sigma=0.02)
    solution = solve(sim.matches, motion="parallax", clip=None)
    left, _ = without_a_map(
        solution.estimate.motions.values[:, 2:] - sim.truth.parallaxes[:, None], sim.truth.positions
    )
    errors = solution.stars["parallax_error"].value / 10
    assert np.mean((left[:, 0] / errors) ** 2) == pytest.approx(1, abs=0.35)
    assert "the mean parallax" in str(solution.gauge)


@pytest.mark.parametrize(
    ("epochs", "settings", "message"),
    [
        (np.full(12, 2015.5), {"motion": "proper"}, "all exposures were taken at 2015.5"),
        (
            np.repeat([2015.5, 2016.5], 6),
            {"motion": "parallax"},
            r"not determined by exposures at 2 epochs \(condition number [\d.e+]+\)",
        ),
        (np.repeat([2015.5, 2016.5, 2018.5], 4), {"motion": "proper", "motion_sigma": -1}, "motion_sigma must be"),
        (THREE, {"motion": "proper", "validate": 0.1}, "does not go with validate, for which stars stay"),
        (THREE, {"motion": "proper", "errors": "correlated"}, "does not go with errors='correlated'"),
        (THREE, {"motion": "quick"}, "motion must be"),
        (THREE, {"motion_sigma": 0.1}, "belong to motion='proper'"),
    ],
)
def test_what_cannot_be_asked(epochs, settings, message):
    with pytest.raises(InputError, match=message):
        solve(field(40, epochs).matches, **settings)


def test_a_parallax_needs_the_sky():
    with pytest.raises(InputError, match="place of the field on the sky, which is not known"):
        solve(field(40, sky=None).matches, motion="parallax")


@pytest.mark.slow
def test_a_parallax_in_one_season_is_told():
    with pytest.warns(AssumptionWarning, match=r"hardly distinguish .* \(condition number \d+"):
        solve(field(40, np.repeat([2015.5, 2016.501, 2018.498], 4)).matches, motion="parallax")


def test_fast_stars_among_mismatches():
    """One in twenty observations is wrong; stars that move by twenty times their errors are kept."""
    sim = field(100, motion=1.0, dither=0)
    table = sim.matches.table.copy()
    wrong = RNG.random(len(table)) < 0.05
    for name in "xy":
        table[name][wrong] += RNG.uniform(5, 30, np.count_nonzero(wrong)) * table[name].unit
    matches = type(sim.matches).from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
    solution = solve(matches, motion="proper")
    used = solution.residuals["used"]
    assert np.count_nonzero(used & wrong) == 0
    assert np.count_nonzero(~used & ~wrong) < 0.01 * len(table)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("settings", "tied"),
    [
        ({"motion": "proper", "motion_sigma": "evidence"}, True),
        pytest.param({"motion": "parallax"}, False, marks=pytest.mark.slow),
    ],
)
def test_files_keep_motions(tmp_path, settings, tied):
    sim = field(60, FIVE, parallax=0.1)
    solution = solve(sim.matches, reference=catalogue(sim, np.random.default_rng(1)) if tied else None, **settings)
    again = Solution.read(solution.write(tmp_path / "s.asdf"))
    assert str(again) == str(solution)
    assert str(again.gauge) == str(solution.gauge)
    for name in ("vx", "vy_err", "vx_err_abs", "pmra", "pmdec_error_abs", "x_err", "x_err_abs", "chi2", "span"):
        assert_allclose(again.stars[name], solution.stars[name], rtol=1e-12, err_msg=name)
    assert again.stars["sky"].obstime == solution.stars["sky"].obstime
    assert again.settings == solution.settings
    assert again.diagnostics.motion_scatter == solution.diagnostics.motion_scatter
    assert_allclose(again.stars["vx_err_abs"], solution.stars["vx_err_abs"], rtol=1e-12)
    assert_allclose(positions_at(again, 2030.0), positions_at(solution, 2030.0))


@pytest.mark.parametrize("place", [None, SkyCoord(SKY.lon, SKY.lat, unit="deg")])
def test_a_plan_tells_the_errors_of_motions(place):
    """As solutions of such sets have them."""
    sim = field(80, FIVE, dither=0, zero_mean=True, rotations=np.zeros(10), motion=0.0)
    planned = plan(
        n_exposures=10, stars=sim.truth.positions, sigma=0.05, shape=(2048, 2048), dynamic=0.3, epochs=FIVE, field=place
    )
    solution = solve(sim.matches, motion="proper" if place is None else "parallax", clip=None)
    found = np.sqrt(np.mean([solution.stars[name].value ** 2 for name in ("vx_err", "vy_err")]))
    assert planned.motion_errors["motion"] == pytest.approx(found, rel=0.05)
    assert "proper motions, relative [px/yr]" in str(planned)
    if place is not None:
        found = np.sqrt(np.mean(solution.stars["parallax_error"].value ** 2)) / 10
        assert planned.motion_errors["parallax"] == pytest.approx(found, rel=0.05)
    twice = plan(
        n_exposures=10, stars=sim.truth.positions, sigma=0.05, dynamic=0.3, epochs=2015 + 2 * (FIVE - 2015), field=None
    )
    alone = plan(n_exposures=10, stars=sim.truth.positions, sigma=0.05, dynamic=0.3, epochs=FIVE)
    assert twice.motion_errors["motion"] == pytest.approx(alone.motion_errors["motion"] / 2, rel=0.02)


def test_plans_that_cannot_be():
    arguments = {"n_exposures": 6, "n_stars": 40, "sigma": 0.05}
    with pytest.raises(InputError, match="all exposures were taken at"):
        plan(**arguments, epochs=np.full(6, 2015.5))
    with pytest.raises(InputError, match="epochs must be the years of the 6 exposures"):
        plan(**arguments, epochs=[2015.5])
    with pytest.raises(InputError, match="give epochs too"):
        plan(**arguments, field=SkyCoord(0, 0, unit="deg"))


def test_corrected_positions_follow_the_stars():
    """Their scatter is that of the measurements, not that of the motions."""
    solution = solve(field(60).matches, motion="proper")
    assert np.nanmedian(accuracy.scatter(accuracy.corrected_positions(solution))) == pytest.approx(0.04, rel=0.2)


def catalogue(sim, rng, *, n=30, errors=(0.1, 0.05), rate=0.0):
    """Some stars of a set as Gaia has them: errors of positions [mas] and motions [mas/yr], a common motion besides."""
    truth, rows = sim.truth, np.arange(n)
    slope = SKY.jacobian(truth.positions[rows]) * 3.6e6
    pm = np.einsum("jab,jb->ja", slope, truth.motions[rows] + rate) + errors[1] * rng.normal(size=(n, 2))
    sky = SKY.to_sky(truth.positions[rows] + errors[0] / 10 * rng.normal(size=(n, 2)))
    columns = {"star": rows, "ra": sky.ra.deg, "dec": sky.dec.deg, "pmra": pm[:, 0], "pmdec": pm[:, 1]}
    columns |= {f"{name}_error": np.full(n, errors[0]) for name in ("ra", "dec")}
    columns |= {f"{name}_error": np.full(n, errors[1]) for name in ("pmra", "pmdec")}
    return Table(columns | {"ref_epoch": np.full(n, truth.epoch)})


def test_a_catalogue_ties_positions_at_the_epoch_of_the_motions():
    """Stars of a catalogue with proper motions are carried to the epoch of the solution."""
    sim = field(100, sigma=0.02)
    truth = sim.truth
    gaia = catalogue(sim, RNG, n=100)
    solution = solve(sim.matches, motion="proper", reference=gaia, motion_epoch=2012.0)
    true = truth.positions + (2012.0 - truth.epoch) * truth.motions
    errors = np.hypot(solution.stars["x_err_abs"].value, solution.stars["y_err_abs"].value)
    off = np.hypot(*(solution.estimate.positions - true).T)
    assert np.median(off / errors) == pytest.approx(1, abs=0.5)


@pytest.mark.parametrize(
    ("n", "accuracy", "sigma"),
    [
        pytest.param(4, 0.2, None, marks=pytest.mark.slow),
        pytest.param(2, 0.3, 0.3, marks=pytest.mark.slow),
        pytest.param(60, 0.1, None, marks=pytest.mark.sets),
    ],
)
def test_absolute_motions_tied_to_a_catalogue_are_calibrated(n, accuracy, sigma):
    """30 stars of a catalogue with proper motions; nothing is taken off. A common motion of all stars is found."""
    true, stated, size = [], [], []
    for seed in range(n):
        sim, rng = field(100, seed=seed), np.random.default_rng(seed + 1000)
        gaia = catalogue(sim, rng, rate=np.array([0.2, -0.1]))
        solution = solve(sim.matches, motion="proper", motion_sigma=sigma, reference=gaia, clip=None)
        off = solution.estimate.motions.values - sim.truth.motions - [0.2, -0.1]
        true.append(np.mean(off**2))
        size.append(np.mean((off - off.mean(axis=0)) ** 2))
        stated.append(np.mean([np.mean(solution.stars[name].value ** 2) for name in ("vx_err_abs", "vy_err_abs")]))
    assert np.sqrt(np.mean(true) / np.mean(stated)) == pytest.approx(1, abs=accuracy)
    assert "tied to the proper motions of 30 stars of the reference." in str(solution.gauge)
    assert np.sqrt(np.mean(true)) < 0.1  # the exposures by themselves: 0.08 after the common motion of 0.2


def test_motions_are_tied_to_a_catalogue_with_parallaxes_too():
    """The mean motion is that of the catalogue, whether or not parallaxes are fitted beside it."""
    sim = field(60, FIVE, parallax=0.02, sigma=0.02)
    gaia = catalogue(sim, np.random.default_rng(3), rate=np.array([0.2, -0.1]))
    solution = solve(sim.matches, motion="parallax", reference=gaia, clip=None)
    assert solution.gauge.drift.n_tied == 30
    off = (solution.estimate.motions.values[:, :2] - sim.truth.motions).mean(axis=0)
    assert_allclose(off, [0.2, -0.1], atol=0.05)


@pytest.mark.slow
def test_a_catalogue_without_motions_serves_stars_that_move_at_its_own_epoch_alone():
    """It was held at the epoch of the positions, years away, and chi2 rose from 1300 to 5 million."""
    sim = field(60)
    places = gaia(sim, np.random.default_rng(5), parallax=False)[0]
    places = places["star", "ra", "dec", "ra_error", "dec_error", "ref_epoch"]
    words = r"positions are those of 2016\.00, where .* sought at 20\d\d\.\d\d: .*--motion-epoch"
    with pytest.raises(InputError, match=words):
        solve(sim.matches, motion="proper", reference=places)
    near = solve(sim.matches, motion="proper", reference=places, motion_epoch=2016.0)
    assert near.chi2 == pytest.approx(near.dof, abs=5 * np.sqrt(2 * near.dof))
    off = near.estimate.positions - sim.truth.positions - (2016.0 - sim.truth.epoch) * sim.truth.motions
    stated = near.stars["x_err_abs"].value ** 2 + near.stars["y_err_abs"].value ** 2
    assert np.sqrt(np.mean((off**2).sum(axis=1)) / np.mean(stated)) == pytest.approx(1, abs=0.4)
    with pytest.raises(InputError, match=r"no proper motions, are off by \d+ times .* column ref_epoch"):
        solve(sim.matches, motion="proper", reference=places["star", "ra", "dec", "ra_error", "dec_error"])
    places["ref_epoch"][:5] = 2010.0
    some = solve(sim.matches, motion="proper", reference=places, motion_epoch=2016.0)
    assert some.diagnostics.reference.n_stars == 25


@pytest.mark.slow
def test_motions_of_a_catalogue_that_disagree():
    sim = field(60)
    gaia = catalogue(sim, RNG)
    gaia["pmra"] += 5 * RNG.normal(size=30)
    gaia["ref_epoch"] = in_tables.epoch(solve(sim.matches, motion="proper"))  # positions agree
    with pytest.warns(AssumptionWarning, match=r"the proper motions of the reference differ .* by \d+"):
        solve(sim.matches, motion="proper", reference=gaia)
    places = gaia["star", "ra", "dec", "ra_error", "dec_error"]
    assert solve(sim.matches, motion="proper", reference=places).gauge.drift.n_tied == 0


@pytest.mark.parametrize("sky", [pytest.param(None, marks=pytest.mark.slow), pytest.param(SKY, marks=pytest.mark.slow)])
def test_pictures_of_motions(sky):
    solution = solve(field(60, sky=sky).matches, motion="proper")
    ax = motion_plots.plot_motions(solution)
    name, sign = ("vx", 1) if sky is None else ("pmra", -1)
    (points,) = (each.get_offsets() for each in ax.collections if isinstance(each, PathCollection))
    assert_allclose(points[:, 0], solution.stars[name].value)
    assert name in ax.get_xlabel()
    assert np.sign(np.diff(ax.get_xlim())[0]) == sign
    assert len(motion_plots.plot_motion_errors(solution).collections[0].get_offsets()) == 60
    with pytest.raises(InputError, match="motion='proper'"):
        motion_plots.plot_motions(solve(field(60).matches))


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_report_shows_motions(tmp_path):
    solution = solve(field(60).matches, motion="auto")
    page = write_report(tmp_path / "report.html", solution).read_text()
    assert "proper motions of 60 stars over 3.90 yr" in page
    assert "Proper motion of every star with its relative errors" in page
    assert "stars move: proper motions scatter by" in page
    assert "relative to the mean of the stars" in page


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_report_shows_what_motions_are_tied_to(tmp_path):
    sim = field(60)
    page = write_report(tmp_path / "tied.html", solve(sim.matches, motion="proper", reference=catalogue(sim, RNG)))
    assert "tied to those of the reference" in page.read_text()


def bound(sim, solution):
    """Cramer-Rao bound of positions, motions and parallaxes after a cubic map, from a dense design of its own.

    Directions are those of the true maps; rms per axis over the stars.
    """
    truth, table = sim.truth, sim.matches.table
    n, names, m = len(truth.positions), list(truth.names), 4 if truth.parallaxes is None else 5
    size = 20 * len(names)
    factors = almanac(truth.years) * [-1, 1]  # x to the west
    design = np.zeros((2 * len(table), m * n + size))
    for row, (name, j, error) in enumerate(zip(table["exposure"], table["star"], table["x_err"].value, strict=True)):
        i, pose = names.index(str(name)), truth.poses[str(name)]
        place = truth.place(str(name))[j]
        near = place + np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
        moved = truth.distort(str(name), near)
        slope = np.stack([moved[1] - moved[2], moved[3] - moved[4]], axis=1)
        u_, v = (2 * (pose[:, :2] @ place + pose[:, 2]) + 1) / np.array(truth.shape[::-1]) - 1
        modes = np.array([u_**a * v**b for a in range(4) for b in range(4 - a)])
        time = truth.years[i] - in_tables.epoch(solution)
        for k in (0, 1):
            at = 2 * row + k
            mine = np.concatenate([slope[k], time * slope[k], [slope[k] @ factors[i]]])[:m]
            design[at, m * j : m * j + m] = mine / error
            design[at, m * n + 20 * i + 10 * k : m * n + 20 * i + 10 * k + 10] = modes / error
    curved = np.linalg.pinv(design.T @ design, rcond=1e-11, hermitian=True)[: m * n, : m * n].reshape(n, m, n, m)
    out = []
    x, y = ((truth.positions - truth.positions.mean(axis=0)) / np.ptp(truth.positions, axis=0)).T
    powers = np.linalg.qr(np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1))[0]
    for part in (slice(0, 2), slice(2, 4), slice(4, 5))[: m - 2]:
        full = curved[:, part, :, part].transpose(1, 0, 3, 2)
        full = full.reshape(full.shape[0] * n, -1)
        off = np.kron(np.eye(len(full) // n), np.eye(n) - powers @ powers.T)
        out.append(np.sqrt(np.trace(off @ full @ off) / len(full)))
    return out


@pytest.mark.parametrize(
    ("kind", "epochs", "realisations"),
    [
        pytest.param("proper", THREE, 12, marks=pytest.mark.sets),
        pytest.param("parallax", FIVE, 2, marks=pytest.mark.slow),
        pytest.param("parallax", FIVE, 12, marks=pytest.mark.sets),
    ],
)
def test_positions_motions_and_parallaxes_are_at_the_bound(kind, epochs, realisations):
    """1.05 times the bound at most, over 300 stars in each realisation."""
    squares, limit = [], []
    for seed in range(realisations):
        sim = field(300, epochs, seed=seed, min_exposures=6, **({"parallax": 0.1} if kind == "parallax" else {}))
        solution = solve(sim.matches, motion=kind, clip=None)
        truth = sim.truth
        true = truth.positions + (in_tables.epoch(solution) - truth.epoch) * truth.motions
        offsets = [solution.estimate.positions - true, solution.estimate.motions.values[:, :2] - truth.motions]
        if kind == "parallax":
            offsets.append(solution.estimate.motions.values[:, 2:] - truth.parallaxes[:, None])
        squares.append([np.mean(without_a_map(each, truth.positions)[0] ** 2) for each in offsets])
        limit.append(np.array(bound(sim, solution)) ** 2)
    ratio = np.sqrt(np.mean(squares, axis=0) / np.mean(limit, axis=0))
    assert np.all(ratio < 1.05)  # what only residuals of second order tell is unknown to the bound, and held here


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_motions_in_the_shell(tmp_path, capsys):
    field(60).matches.table.write(tmp_path / "matched.ecsv")
    arguments = ["solve", str(tmp_path / "matched.ecsv"), "--shape", "2048", "2048", "--out", str(tmp_path / "out")]
    assert main([*arguments, "--motion", "auto", "--motion-sigma", "evidence", "--motion-epoch", "2016"]) == 0
    assert "positions are those of 2016.0000" in " ".join(capsys.readouterr().out.split())
    solution = Solution.read(tmp_path / "out" / "solution.asdf")
    assert solution.settings.motion == "proper"
    assert solution.settings.motion_sigma == pytest.approx(0.3, rel=0.2)
    assert (
        main(
            [
                "predict",
                *[
                    "--n-exposures",
                    "4",
                    "--n-stars",
                    "80",
                    "--sigma",
                    "0.02",
                    "--epochs",
                    "2025",
                    "2026",
                    "2027",
                    "2028",
                ],
            ]
        )
        == 0
    )
    assert "proper motions, relative [px/yr]" in capsys.readouterr().out


@pytest.mark.slow
def test_the_degree_is_chosen_where_stars_move():
    """Stars that are kept out have motions of their own, which are no reason for a higher degree."""
    sim = field(80, degree=2, dynamic=0.5, sigma=0.05, motion=0.5)
    for motion in ("proper", "auto"):
        solution = solve(sim.matches, degree="auto", motion=motion)
        assert solution.degree == 2
        assert solution.settings.motion == "proper"
        scores = dict(zip(solution.diagnostics.selection.degrees, solution.diagnostics.selection.scores, strict=True))
        assert scores[2] == pytest.approx(1, abs=0.4)
    with pytest.raises(InputError, match="motions are not determined"):
        solve(field(80, np.full(12, 2015.0)).matches, degree="auto", motion="proper")


@pytest.mark.parametrize("errors", ["floor", "scale", "by-brightness"])
def test_errors_are_found_where_stars_move(errors):
    """Motions are no errors: what is missing to the stated ones is found, and nothing more."""
    sim = field(100, sigma=0.05)
    table = sim.matches.table.copy()
    for name in "xy":
        table[name] += 0.04 * RNG.normal(size=len(table)) * table[name].unit
    table["flux"] = 10 ** RNG.uniform(2, 4, 100)[table["star"]]
    matches = type(sim.matches).from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
    solution = solve(matches, motion="proper", errors=errors)
    assert solution.settings.motion == "proper"
    if errors == "floor":
        assert solution.diagnostics.error_floor == pytest.approx(0.04, rel=0.1)
    if errors == "scale":
        assert solution.diagnostics.error_scale == pytest.approx(np.hypot(0.05, 0.04) / 0.05, rel=0.05)
    if errors == "by-brightness":
        assert solution.chi2 / solution.dof == pytest.approx(1, abs=0.05)
