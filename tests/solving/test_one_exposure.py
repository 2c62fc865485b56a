"""One exposure and a catalogue of some of its stars: a distortion, and positions of the others; truth from numpy."""

import json

import dense_model
import header_layouts
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table

import legdistort as ld
from legdistort.assessment.pulls import pulls_of
from legdistort.cli.parser import main
from legdistort.exceptions import InputError, MatchError
from legdistort.reporting.page import render
from legdistort.reporting.summary import summarise
from legdistort.results.errors.catalogue_tie import Tie

SIZE, DEGREE = 2048, 3


def one_exposure(seed, *, n_known=60, n_others=20, static=1.0, error=0.02, known=0.01):
    """Table of an exposure, a catalogue of its first stars in the reference plane, and the truth."""
    rng, n, m = np.random.default_rng(seed), n_known + n_others, len(dense_model.orders(DEGREE))
    q, free = rng.uniform(100, SIZE - 100, (n, 2)), dense_model.rows(DEGREE)[1]
    distortion = (static * rng.normal(size=len(free)) @ free).reshape(2, m)
    z = (1 + 1e-3 * rng.normal()) * np.exp(1j * np.deg2rad(rng.normal(0, 0.5)))
    turned = (q - SIZE / 2) @ [1, 1j] * z
    true = np.column_stack([turned.real, turned.imag]) + SIZE / 2 + rng.normal(0, 30, 2)
    xy = q + dense_model.basis(q, DEGREE, SIZE)[0] @ distortion.T + error * rng.normal(size=(n, 2))
    place = true[:n_known] + known * rng.normal(size=(n_known, 2))
    table = Table({"exposure": ["e00"] * n, "star": np.arange(n), "x": xy[:, 0], "y": xy[:, 1]})
    catalogue = Table({"star": np.arange(n_known), "x": place[:, 0], "y": place[:, 1]})
    table["x_err"] = table["y_err"] = error
    catalogue["x_err"] = catalogue["y_err"] = known
    return table, catalogue, true


def solved(seed, *, prior=None, **setting):
    """The solution, true positions of its stars, and which the catalogue has."""
    table, catalogue, true = one_exposure(seed, **setting)
    matches = ld.Matches.from_table(table, shape=(SIZE, SIZE))
    solution = ld.solve(matches, degree=DEGREE, reference=catalogue, prior=prior)
    names = solution.estimate.star_names
    return solution, true[names], names < len(catalogue)


def stated(solution):
    """Absolute errors (n, 2) of the stars."""
    return np.stack([solution.stars[name].value for name in ("x_err_abs", "y_err_abs")], axis=1)


@pytest.mark.parametrize(
    ("n_sets", "setting", "width"),
    [
        (8, {}, None),
        pytest.param(60, {}, None, marks=pytest.mark.sets),
        pytest.param(60, {"n_known": 15}, None, marks=pytest.mark.sets),
        pytest.param(15, {"n_known": 5}, 1.0, marks=pytest.mark.slow),
        pytest.param(60, {"n_known": 5}, 1.0, marks=pytest.mark.sets),
        pytest.param(15, {"error": 0.005, "known": 0.03}, None, marks=pytest.mark.slow),
        pytest.param(60, {"error": 0.005, "known": 0.03}, None, marks=pytest.mark.sets),
    ],
)
def test_errors_are_calibrated_and_checks_are_silent(n_sets, setting, width):
    prior = None if width is None else ld.Prior(np.zeros((2, 10)), static_sigma=width)
    squares, excess = np.zeros((2, 2)), []
    for seed in range(n_sets):
        solution, true, known = solved(seed, prior=prior, **setting)
        off, error = solution.estimate.positions - true, stated(solution)
        squares += [[np.sum(each[rows] ** 2) for each in (off, error)] for rows in (known, ~known)]
        excess.append(solution.chi2 - solution.dof)
        assert not [check.name for check in solution.checks if check.state in ("warn", "fail")]
    assert squares[:, 0] / squares[:, 1] == pytest.approx(1, abs=0.4 if n_sets == 15 else 0.2)
    assert np.mean(excess) == pytest.approx(0, abs=max(4 * np.std(excess) / np.sqrt(n_sets), 1.0))


def test_the_map_takes_its_share_of_the_degrees_of_freedom():
    """Of 20 modes four fifths come from the exposure: so much of the error of an offset is its own."""
    solution, *_ = solved(0)
    assert solution.gauge.tie.freedom == pytest.approx(0.8 * 20, abs=0.1)
    assert solution.dof == pytest.approx(2 * 80 - 2 * 20 - (2 * 60 * 0.2 + 0.8 * 20), abs=0.01)


def test_what_compares_exposures_says_nothing():
    names = {check.name: check.state for check in solved(0)[0].checks}
    assert not {"exposures", "time", "duplicates"} & set(names)
    assert names["reference"] == "unknown"


def test_too_few_stars_of_the_catalogue_leave_maps_unknown():
    solution, _, known = solved(3, n_known=5)
    assert {"degree 2", "degree 3"} <= set(solution.gauge.unknown_names)
    assert not np.isfinite(stated(solution)[~known]).any()
    assert next(check.state for check in solution.checks if check.name == "absolute") == "unknown"


def test_with_a_prior_that_is_said_to_be_believed():
    solution, *_ = solved(3, n_known=5, prior=ld.Prior(np.zeros((2, 10)), static_sigma=1.0))
    checks = {check.name: check for check in solution.checks}
    assert checks["prior"].state == "unknown"
    assert "there is one exposure" in checks["prior"].sentence
    assert "not tested" in checks["absolute"].sentence


def test_the_stars_are_found_by_position_and_the_file_is_read_again(tmp_path):
    table, catalogue, true = one_exposure(1, static=0.3)
    table.remove_column("star")
    catalogue.remove_column("star")
    solution = ld.solve(ld.match(table, shape=(SIZE, SIZE)), reference=catalogue)
    assert np.count_nonzero(solution.stars["reference_used"]) == 60
    again = ld.Solution.read(solution.write(tmp_path / "one.asdf"))
    assert (again.gauge.tie.freedom, again.dof) == (solution.gauge.tie.freedom, solution.dof)
    assert isinstance(again.gauge.tie, Tie)
    x, y = again["e00"].correct(np.column_stack([table["x"], table["y"]])).T
    assert np.sqrt(np.mean((np.column_stack([x, y]) - true) ** 2)) < 0.03


@pytest.mark.slow
def test_one_frame_runs_with_a_catalogue(tmp_path, capsys):
    sim = ld.simulate_exposures(small=True, seed=3, n_exposures=2)
    (frame, _), sky = sim.write(tmp_path / "frames"), sim.truth.sky
    place = sim.truth.positions + 0.01 * np.random.default_rng(0).normal(size=sim.truth.positions.shape)
    stars = sky.to_sky(place)
    catalogue = Table({"ra": stars.ra, "dec": stars.dec})
    catalogue["ra_error"] = catalogue["dec_error"] = 10 * sky.pixel_scale  # mas: 0.01 pixels
    catalogue.write(tmp_path / "stars.ecsv")
    given = ["run", str(frame), "--out", str(tmp_path / "out"), "--reference", str(tmp_path / "stars.ecsv")]
    assert main(given) == 0
    assert "Solution: 1 exposure, " in capsys.readouterr().out
    solution = ld.Solution.read(tmp_path / "out")
    found = sky.from_sky(SkyCoord(solution.stars["ra"], solution.stars["dec"]))
    nearest = np.argmin(np.hypot(*(found[:, None] - place[None]).transpose(2, 0, 1)), axis=1)
    off = (found - sim.truth.positions[nearest]) / stated(solution)
    assert np.sqrt(np.mean(off**2)) < 1.5


def test_an_exact_prior_does_not_hold_the_distortion_of_a_single_exposure():
    """Nothing tells how far it departs from that, so that the catalogue decides."""
    solution, true, _ = solved(0, prior=ld.Prior(np.zeros((2, 10))))
    assert np.sqrt(np.mean(((solution.estimate.positions - true) / stated(solution)) ** 2)) < 1.4


@pytest.mark.parametrize(("sigma", "state"), [(None, "unknown"), (0.03, "unknown"), (1e-3, "fail")])
def test_an_exposure_that_departs_from_its_static_distortion_is_no_bent_reference(sigma, state):
    """Unless it is said how far exposures depart, and it departs farther."""
    prior = ld.Prior(np.zeros((2, 10)), static_sigma=0.01, sigma=sigma)
    solution, *_ = solved(5, static=0.03, prior=prior)
    check = next(check for check in solution.checks if check.name == "reference")
    assert check.state == state
    assert ("one exposure does not tell whether it departs" in check.sentence) == (sigma is None)
    assert ("--prior-sigma" in check.cure) == (sigma is None)


def test_one_exposure_of_a_camera_keeps_the_layout_of_its_headers():
    night = header_layouts.Night(1, off=0.0, n=1)
    table = Table(night.table)
    if "star" in table.colnames:
        table.remove_column("star")
    rng = np.random.default_rng(0)
    place = night.sky + 0.01 * rng.normal(size=night.sky.shape)
    catalogue = Table({"x": place[:, 0], "y": place[:, 1], "x_err": np.full(len(place), 0.01)})
    catalogue["y_err"] = 0.01
    matches = ld.match(table, exposures=night.exposures)
    solution = ld.solve(matches, reference=catalogue)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=0.35)
    assert np.isfinite(solution.stars["x_err_abs"]).all()
    with pytest.raises(InputError, match="layout='fit' compares exposures"):
        ld.solve(matches, reference=catalogue, layout="fit")


def test_no_cure_is_named_that_is_refused():
    table, catalogue, _ = one_exposure(0)
    table["x_err"] = table["y_err"] = 0.08
    solution = ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)), reference=catalogue)
    chi2 = next(check for check in solution.checks if check.name == "chi2")
    assert chi2.state in ("warn", "fail")
    assert "--errors" not in chi2.cure


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"errors": "scale"}, "errors='scale' compares exposures"),
        ({"degree": "auto"}, "degree='auto' compares exposures"),
        ({"static": "fit"}, "static='fit' compares exposures"),
        ({"validate": 0.1}, "validate=0.1 compares exposures"),
        ({"motion": "proper"}, "motion='proper' compares exposures"),
        ({"prior": ld.Prior(np.zeros((2, 10)), sigma="evidence", static_sigma=0.1)}, "only one.*--prior-sigma 0.05"),
        ({"prior": ld.Prior(None, sigma="evidence")}, "sigma='evidence' of the prior"),
    ],
)
def test_options_that_compare_exposures_are_refused(options, words):
    table, catalogue, _ = one_exposure(0)
    matches = ld.Matches.from_table(table, shape=(SIZE, SIZE))
    with pytest.raises(InputError, match=words):
        ld.solve(matches, reference=catalogue, **options)
    with pytest.raises(MatchError, match=r"only one exposure \(e00\)"):
        ld.solve(matches)


@pytest.mark.slow
def test_the_report_has_no_empty_pictures():
    """Expected residuals count what the catalogue knows of its stars, as those that are there do."""
    table, catalogue, _ = one_exposure(2)
    table["flux"] = np.geomspace(1, 100, len(table))
    solution = ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)), reference=catalogue)
    shown = pulls_of(solution)
    assert shown.freedom.sum() == pytest.approx(solution.dof, abs=2)
    assert np.sum(shown.squares) / shown.freedom.sum() == pytest.approx(1, abs=0.4)
    summary = json.loads(json.dumps(summarise(solution), allow_nan=False, default=str))
    assert summary["sigma_px"] is None
    page = render(solution)
    assert "registration alone" not in page
    assert "nan px" not in page
