"""A static distortion of which nothing is known but its size: `Prior(None, static_sigma=...)`."""

import json
import logging

import gsaoi_images
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

import legdistort as ld
from legdistort.assessment import baselines
from legdistort.cli.parser import main
from legdistort.exceptions import InputError
from legdistort.geometry import basis
from legdistort.geometry.detector_modes import dynamic_basis
from legdistort.reporting.page import render
from legdistort.results import accuracy
from legdistort.solving import camera_fit
from legdistort.solving.equations.problem import build_problem

SETTING = {"n_exposures": 8, "n_stars": 50, "degree": 3, "sigma": 0.02, "dither": 150.0, "zero_mean": False}


@pytest.fixture(scope="module")
def sim():
    return ld.simulate_matches(seed=4, static=2.0, dynamic=0.3, **SETTING)


@pytest.fixture(scope="module")
def declared(sim):
    return ld.solve(sim.matches, prior=ld.Prior(None, static_sigma=2.0))


def test_size_is_that_of_every_coefficient_at_any_degree(sim):
    for degree in (0, 2, 5):
        problem = build_problem(sim.matches, degree, prior=ld.Prior(None, static_sigma=2.0))
        assert_array_equal(problem.static_covariance, 4.0 * np.eye(2 * basis.n_modes(degree)))
        assert_array_equal(problem.static_errors.sigma, np.full((8, 2, basis.n_modes(degree)), 2.0))
        assert not problem.prior_mean.any()
        assert problem.prior_mean.shape[2] == basis.n_modes(degree)


@pytest.mark.parametrize("degree", [2, 3, 4, 5])
def test_rms_over_the_field_is_that_of_the_docstring(degree):
    """Modes less similarities, each with mean square 1/4 on its axis."""
    n = len(dynamic_basis((2048, 2048), basis.n_modes(degree)))
    assert np.sqrt(n / 8) == pytest.approx(np.sqrt(((degree + 1) * (degree + 2) - 4) / 8))
    assert np.sqrt(n / 8) == pytest.approx({2: 1.0, 3: 1.4, 4: 1.8, 5: 2.2}[degree], abs=0.05)


def test_absolute_errors_are_finite_and_nothing_is_unknown(sim, declared):
    free = ld.solve(sim.matches)
    assert free.gauge.unknown
    assert np.isnan(free.stars["x_err_abs"]).any()
    assert declared.gauge.unknown == ()
    assert declared.gauge.warning == ""
    assert np.isfinite(declared.stars["x_err_abs"]).all()
    # where nothing but the size tells, the shears, the error is that size: less what it moves with the other modes
    shear = {name: error for name, _, error in declared.gauge.absolute_errors()}["shear"]
    assert 0.5 < shear / (2.0 * np.sqrt(2 / 8)) < 2.0


def test_what_exposures_determine_they_determine_as_well_with_a_size(declared, sim):
    """The scatter of single exposures is not taken larger for a static distortion that is not at its mean."""
    free = ld.solve(sim.matches)
    assert_allclose(declared.gauge.scatter[:, 3:], free.gauge.scatter[:, 3:], rtol=0.2)
    cubic = [{name: error for name, _, error in s.gauge.absolute_errors()}["degree 3"] for s in (declared, free)]
    assert cubic[0] == pytest.approx(cubic[1], rel=0.25)


def test_larger_size_larger_error_same_relative_positions(declared, sim):
    larger = ld.solve(sim.matches, prior=ld.Prior(None, static_sigma=6.0))
    assert np.median(larger.stars["x_err_abs"] / declared.stars["x_err_abs"]) > 1.5
    assert accuracy.bias(larger.estimate.positions, declared.estimate.positions, removed=5) < 1e-3


@pytest.mark.parametrize(
    ("n_sets", "tolerance"),
    [pytest.param(15, 0.45, marks=pytest.mark.slow), pytest.param(50, 0.25, marks=pytest.mark.sets)],
)
def test_errors_are_calibrated_for_distortions_of_that_size(n_sets, tolerance):
    """Truth drawn as declared: every coefficient of the static distortion 2 px."""
    true, reported = [], []
    for seed in range(n_sets):
        sim = ld.simulate_matches(seed=seed, static=2.0, dynamic=0.3, **SETTING)
        solution = ld.solve(sim.matches, prior=ld.Prior(None, static_sigma=_size(sim.truth.static)))
        good = np.isfinite(solution.estimate.positions[:, 0])
        true.append(
            accuracy.bias(solution.estimate.positions[good], sim.truth.positions[good], removed="similarity") ** 2
        )
        reported.append(accuracy.expected_bias(solution, removed="similarity", absolute=True) ** 2)
    assert np.mean(true) / np.mean(reported) == pytest.approx(1, abs=tolerance)  # standard error of 50: 0.085


def _size(static):
    """What one would declare who knows how large a distortion is, and not which."""
    modes = static.reshape(-1) @ dynamic_basis((2048, 2048), static.shape[1]).T
    return float(np.sqrt(np.mean(modes**2)))


@pytest.mark.parametrize("static_sigma", [None, 0, -1.0, np.nan, np.inf, [1.0, 2.0], "2", True])
def test_size_must_be_a_positive_number(static_sigma):
    with pytest.raises(InputError, match="without a mean, static_sigma must be a positive number"):
        ld.Prior(None, static_sigma=static_sigma)


def test_scatter_alone_is_found_about_what_exposures_show(tmp_path):
    prior = ld.Prior(None, sigma="evidence")
    for each in (prior, ld.Prior.read(prior.write(tmp_path / "p.asdf"))):
        assert repr(each) == "<Prior: not known, sigma by evidence>"
        assert not each.states_mean


def test_scatter_alone_of_so_many_pixels_needs_a_mean():
    with pytest.raises(InputError, match="without a mean, static_sigma must be a positive number"):
        ld.Prior(None, sigma=0.3)
    declared = ld.Prior(None, static_sigma=2.0)
    assert repr(declared.with_sigma("evidence")) == repr(declared)
    assert declared.with_sigma("evidence").sigma is None
    assert repr(declared.with_sigma(0.3)) == "<Prior: not known, sigma given, static_sigma given>"


@pytest.mark.parametrize("sigma", [0.3, np.full(10, 0.3)])
def test_scatter_about_a_static_distortion_of_a_size(sigma, sim):
    """The exposures depart by sigma from what is about zero by the size, as the plain mean of zeros has it."""
    both = ld.Prior(None, sigma=sigma, static_sigma=2.0)
    assert not both.states_mean
    plain = ld.Prior(np.zeros((2, 10)), sigma=0.3, static_sigma=2.0)
    one, two = (ld.solve(sim.matches, prior=prior) for prior in (both, plain))
    for name in ("x", "y", "x_err", "x_err_abs", "y_err_abs"):
        assert_allclose(one.stars[name].value, two.stars[name].value, rtol=0, atol=1e-6)


def test_scatter_beside_a_size_of_several_detectors_is_of_exposures():
    table = gsaoi_images.Night(n_exposures=4, n_stars=60, dither=9.0).table(sigma=0.01, least=2)
    matches = ld.Matches.from_table(table, camera=ld.Camera.gsaoi())
    declared = ld.Prior(None, sigma=0.1, static_sigma=0.5)
    made, scatter, static = camera_fit.with_declared_size(matches, declared, "fit", dynamic=None, degree=3)
    assert static == "prior"
    assert scatter.static_sigma is None
    assert_array_equal(scatter.sigma, 0.1)
    assert_array_equal(made.camera["2"].static_sigma[:, 3:], 0.5)


def test_prior_says_what_it_is():
    prior = ld.Prior(None, static_sigma=2.0)
    assert repr(prior) == "<Prior: not known, 2 px a mode>"
    assert prior.degree == 0
    assert_array_equal(prior.rms, 0)
    assert prior.describe()["degree"] is None
    assert prior.describe()["static_sigma"] == 2.0


def test_files_keep_it(tmp_path, declared):
    ld.Prior(None, static_sigma=2.5).write(tmp_path / "prior.asdf")
    for back in (ld.Prior.read(tmp_path / "prior.asdf"), ld.Prior.from_file(tmp_path / "prior.asdf")):
        assert back.mean is None
        assert back.static_sigma == 2.5
    assert ld.Prior.from_file(tmp_path / "prior.asdf", static_sigma=1.0).static_sigma == 1.0
    declared.write(tmp_path / "solution.asdf")
    again = ld.Solution.read(tmp_path / "solution.asdf")
    assert again.settings == declared.settings
    assert again.settings.prior["static_sigma"] == 2.0
    for column in ("x_err", "x_err_abs"):
        assert_array_equal(again.stars[column], declared.stars[column])
    name = declared.names[0]
    assert_array_equal(again[name].sigma_map(n=4)[2], declared[name].sigma_map(n=4)[2])


def test_it_is_no_static_map_to_correct_with(sim, declared):
    made = baselines.compare(sim.matches, declared, prior=ld.Prior(None, static_sigma=2.0))
    assert "shift" in made
    assert "static + shift" not in made


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.LegdistortWarning")  # these fit this set badly
@pytest.mark.parametrize(
    "options", [{"static": "fit"}, pytest.param({"degree": "auto"}, marks=pytest.mark.slow)], ids=str
)
def test_with_other_options(sim, options):
    solution = ld.solve(sim.matches, prior=ld.Prior(None, static_sigma=2.0), **options)
    assert solution.gauge.unknown == ()
    assert np.isfinite(solution.stars["x_err_abs"]).all()
    assert np.isfinite(solution[solution.names[0]].errors).all()


def test_by_detector(sim):
    priors = {name: ld.Prior(None, static_sigma=2.0) for name in sim.matches.names}
    assert ld.solve(sim.matches, prior=priors).gauge.unknown == ()


# -- what is said


@pytest.mark.usefixtures("undrawn")
def test_it_is_said_once_that_absolute_positions_are_not_known(sim, declared, caplog):
    with caplog.at_level(logging.WARNING, logger="legdistort"):
        free = ld.solve(sim.matches)
        said = [record.getMessage() for record in caplog.records]
        assert said == [free.gauge.warning]
        assert said[0].startswith("absolute positions are not known: no static distortion was given, or none that")
        assert "--prior" in said[0]
        assert "--static-sigma" in said[0]
        caplog.clear()
        ld.solve(sim.matches, prior=ld.Prior(None, static_sigma=2.0))
        assert not caplog.records
    page = render(free)
    assert page.index("Absolute positions are not known") < page.index('<table class="facts">')
    assert "Absolute positions are not known" not in render(declared)
    assert "Relative error of the correction" in render(free)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_solve_command(sim, tmp_path, capsys):
    table = QTable(sim.matches.table)
    table.meta |= sim.matches.to_meta()
    table.write(tmp_path / "matched.ecsv")
    command = ["solve", str(tmp_path / "matched.ecsv"), "--json", "--quiet", "--out"]
    assert main([*command, str(tmp_path / "free")]) == 0
    out, error = capsys.readouterr()
    assert error.count("absolute positions are not known: no static distortion was given") == 1
    assert main([*command, str(tmp_path / "declared"), "--static-sigma", "2"]) == 0
    out, error = capsys.readouterr()
    assert "not known" not in error
    assert "absolute to" in json.loads(out)["gauge"]
    assert json.loads(out)["unknown"] == []
    assert {"shear"} <= set(json.loads((tmp_path / "free" / "summary.json").read_text())["unknown"])
    assert ld.Solution.read(tmp_path / "declared" / "solution.asdf").settings.prior["static_sigma"] == 2.0
    assert main([*command, str(tmp_path / "bad"), "--static-sigma", "0"]) == 1
    assert "static_sigma must be a positive number" in capsys.readouterr().err


def test_static_sigma_beside_a_prior_is_its_uncertainty(sim, tmp_path):
    ld.Prior(sim.truth.static).write(tmp_path / "prior.asdf")
    assert ld.Prior.from_file(tmp_path / "prior.asdf", static_sigma=0.1).static_widths(3) == pytest.approx(0.1)


@pytest.mark.parametrize("more", [{}, {"dynamic": 0.3}])
def test_prediction_without_a_prior_is_relative_and_says_so(more):
    plan = {"n_exposures": 8, "n_stars": 50, "sigma": 0.02, "dithers": 150.0}
    free, exact = ld.predict(**plan, **more), ld.predict(**plan, **more, prior=ld.Prior(np.zeros((2, 1))))
    assert np.isfinite(free.error_map).mean() > 0.9
    assert np.isfinite(free.sigma)
    assert np.isfinite(free.b)
    text = " ".join(str(free).split())
    assert "is relative" in text
    assert free.solution.gauge.unknown
    assert free.solution.gauge.warning.split(";")[0] in text  # what to do is that of plans
    assert all(len(line) <= 110 for line in str(free).splitlines())
    assert np.isfinite(free.b_abs) == bool(more)
    if more:
        assert "b, absolute, without what is not determined" in text
        assert "shear and change of scale over the field (z^2, i z^2 with z = x + iy) not determined" in text
        assert "no static distortion was given" in text
        assert exact.solution.gauge.unknown == ()
        sized = ld.predict(**plan, **more, prior=ld.Prior(None, static_sigma=2.0))
        assert sized.solution.gauge.unknown == ()
        assert exact.b_abs < sized.b_abs
    else:
        assert "b, absolute (mean dynamic distortion too) not known" in text
        assert "no scatter of single exposures was assumed" in text
        assert np.isnan(exact.solution.stars["x_err_abs"]).all()
        assert "no scatter of single exposures was assumed" in str(exact.solution.gauge)


@pytest.mark.slow
def test_predict_command(capsys):
    command = ["predict", "--n-exposures", "8", "--n-stars", "50", "--sigma", "0.02", "--dynamic", "0.3", "--json"]
    assert main([*command, "--quiet"]) == 0
    free = json.loads(capsys.readouterr().out)
    assert "shear" in free["unknown"]
    assert main([*command, "--quiet", "--static-sigma", "2"]) == 0
    assert json.loads(capsys.readouterr().out)["b_abs"] > 10 * free["b_abs"]
