"""What the check of a camera says of layouts and static distortions that are right, wrong, or that nothing tests."""

import warnings
from dataclasses import replace

import four_detectors
import numpy as np
import pytest

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.solving.checks.dynamic_check import significance


def check_of(matches, **options):
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solution = ld.solve(matches, **{"degree": 2} | options)
    return next((check for check in solution.checks if check.name == "camera"), None)


def stated(matches, sigma, seed, *, drawn=1.0):
    """The matches with layouts that are off by shifts of `drawn` times the sigma [px] that is stated of them."""
    rng, camera = np.random.default_rng(seed), matches.camera
    off = {}
    for key, detector in camera.detectors.items():
        layout = detector.layout.copy()
        layout[:, 2] += drawn * sigma * rng.normal(size=2)
        widths = np.zeros((2, 3))
        widths[:, 0] = 2 * sigma  # the mode is a half
        off[key] = ld.Detector(detector.shape, layout=layout, layout_sigma=widths)
    camera = replace(camera, detectors=off)
    return replace(matches, table=camera.in_focal_plane(matches.camera.on_detectors(matches.table)), camera=camera)


def test_a_right_camera_passes():
    check = check_of(four_detectors.matches(None, 0))
    assert check.state == "pass"
    assert check.sentence.startswith("exposures agree with the layout and the static distortions that were given")


@pytest.mark.parametrize("kind", four_detectors.CURES)
def test_what_is_wrong_of_a_camera_is_named_with_its_cure(kind):
    check = check_of(four_detectors.matches(kind, 0))
    assert check.state == "fail"
    assert check.cure == four_detectors.CURES[kind]


@pytest.mark.slow
def test_what_is_fitted_is_not_asked_about():
    matches = four_detectors.matches("layout", 0)
    assert check_of(matches, layout="fit").state == "pass"
    assert check_of(matches, layout="fit", static="fit") is None


def test_of_a_single_detector_there_is_no_such_check():
    assert check_of(ld.simulate_matches(seed=1, n_stars=40).matches) is None


def test_what_no_dither_tests_is_said_to_be_believed():
    matches = four_detectors.matches(None, 0, dither=2.0)
    check = check_of(matches)
    assert check.state == "unknown"
    assert check.sentence.endswith("are believed, not tested")
    assert check.cure.startswith("dithers larger than the gaps")


@pytest.mark.slow
def test_widths_that_are_stated_are_tested():
    matches = four_detectors.matches(None, 0)
    check = check_of(stated(matches, 1.0, 0))
    assert check.state == "pass"
    assert "depart from what was stated of the detectors of FOUR by" in check.sentence
    wrong = check_of(stated(matches, 0.2, 0, drawn=10))
    assert wrong.state == "fail"
    assert "--layout fit" in wrong.cure


def test_factors_are_those_of_the_camera():
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        held = ld.solve(four_detectors.matches("layout", 0), degree=2).factors
        found = ld.solve(stated(four_detectors.matches(None, 0), 1.0, 0), degree=2).factors
    assert list(held["name"]) == ["layout", "statics of the detectors"]
    assert list(held["source"]) == ["FOUR", "FOUR"]
    assert held["p"].max() < 1e-6
    assert list(found["name"]) == ["statics of the detectors", "detectors as stated"]
    assert found["rows"][1] == 8
    assert found["p"].min() > 1e-3


def test_departures_that_are_none_are_told_with_what_makes_errors_smaller():
    """Without the errors of the stars their noise was taken for departures, by a chance of 5e-7, and all passed."""
    matches = four_detectors.matches(None, 0)
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        free = ld.solve(matches, degree=3)
        found = ld.solve(matches, degree=3, prior=ld.Prior(None, sigma="evidence"))
    before, after = ({check.name: check for check in each.checks} for each in (free, found))
    for name in ("degree", "dynamic part"):
        assert before[name].state == "warn"
        assert "--prior-sigma evidence" in before[name].cure
        assert after[name].state == "pass"
    assert "errors count that, by their scatter as found" in after["dynamic part"].sentence
    assert np.median(found.stars["x_err"]) < 0.95 * np.median(free.stars["x_err"])


@pytest.mark.parametrize("n_sets", [pytest.param(15, marks=pytest.mark.slow), pytest.param(40, marks=pytest.mark.sets)])
def test_departures_of_a_camera_that_are_none_have_their_chance(n_sets):
    """The smallest of nine probabilities, times nine: below 0.05 in one of twenty sets at most."""
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solutions = (ld.solve(four_detectors.matches(None, seed), degree=3, clip=None) for seed in range(n_sets))
        found = [significance(solution) for solution in solutions]
    assert np.mean(np.array(found) < 0.05) < 0.05 + 0.1 * np.sqrt(40 / n_sets)
    assert min(found) > 1e-4


@pytest.mark.parametrize("n_sets", [pytest.param(6, marks=pytest.mark.slow), pytest.param(20, marks=pytest.mark.sets)])
def test_departures_of_right_widths_are_those_of_chance(n_sets):
    chi2 = dof = 0
    for seed in range(n_sets):
        with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
            solution = ld.solve(stated(four_detectors.matches(None, seed), 1.0, seed), degree=2)
        made = solution.estimate.uncertainty.camera.departure
        chi2, dof = chi2 + made.chi2, dof + made.dof
    assert chi2 / dof == pytest.approx(1, abs=4 * np.sqrt(2 / dof))


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=pytest.mark.slow if seed < 2 else pytest.mark.sets) for seed in range(1, 9)]
)
def test_states_hold_for_other_sets(seed):
    assert check_of(four_detectors.matches(None, seed)).state == "pass"
    for kind, cure in four_detectors.CURES.items():
        check = check_of(four_detectors.matches(kind, seed))
        assert check.state in ("warn", "fail")
        assert check.cure == cure
