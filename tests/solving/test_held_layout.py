"""A layout that is held while static distortions are fitted: what messages name to do, and whether that does it."""

import header_layouts
import pytest

import legdistort
from legdistort.exceptions import AssumptionWarning

pytestmark = pytest.mark.filterwarnings("ignore::legdistort.LegdistortWarning")
HELD = {"degree": 3, "layout": "hold", "static": "fit"}


def camera_check(solution):
    (check,) = (check for check in solution.checks if check.name == "camera")
    return check


def matched(**known):
    night = header_layouts.Night(11, off=2.5, n=7, n_stars=300, **known)
    return legdistort.match(night.table, exposures=night.exposures)


@pytest.mark.slow
def test_static_distortions_that_bend_for_a_wrong_layout():
    """Headers are wrong by 3 px: a higher degree would bend more, and the layout is what to fit."""
    seen = matched(dither=80.0)
    made = legdistort.solve(seen, **HELD)
    (chi2,) = (check for check in made.checks if check.name == "chi2")
    assert chi2.state == "fail"
    words = "--layout fit in place of --layout hold, if the layout may be wrong (static distortions bend for it); else "
    assert chi2.cure.startswith(f"{words}--degree")
    assert "static distortions that are fitted hide a wrong one" in camera_check(made).sentence
    cured = legdistort.solve(seen, **HELD | {"layout": "fit"})
    assert cured.chi2 == pytest.approx(cured.dof, rel=0.1)
    assert camera_check(cured).state == "pass"


def test_detectors_apart_are_not_asked_for_what_is_given():
    """Nothing ties them, and the layout is held: it is their static distortions that stars do not tell."""
    seen = matched(dither=5.0)
    with pytest.warns(
        AssumptionWarning, match=r"determine how these distort; dither over the gaps, or say what is known"
    ):
        made = legdistort.solve(seen, **HELD)
    check = camera_check(made)
    assert check.state == "unknown"
    assert check.sentence.startswith("these exposures do not determine the static distortions of the detectors beside")
    assert check.sentence.endswith("the layout that was given of the detectors is believed, not tested")
    assert "--layout hold" not in check.cure
    assert "or leave --static fit out" in check.cure
    without = camera_check(legdistort.solve(seen, degree=3, layout="hold"))
    assert "do not determine" not in without.sentence
