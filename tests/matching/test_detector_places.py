"""Stars that cross from detector to detector, where headers have the detectors elsewhere."""

from dataclasses import replace

import header_layouts
import numpy as np
import pytest
from astropy.table import vstack

import legdistort
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.matching.detectors import detector_places
from legdistort.measurement.flags import Flag


def matched(night, **known):
    return legdistort.match(night.table, exposures=night.exposures, min_exposures=3, **known)


@pytest.mark.parametrize(
    ("seed", "off", "turn", "rolls"), [pytest.param(2, 10.0, 0.1, (0,), marks=pytest.mark.slow), (3, 5.0, 0.1, (0, 90))]
)
def test_stars_cross(seed, off, turn, rolls):
    """Nearly all of those that several detectors see, and no two that are not one."""
    night = header_layouts.Night(seed, off=off, turn=turn, rolls=rolls, n=6, n_stars=250)
    true, found = night.crossing(3), night.found(matched(night))
    assert len(true) > 20
    assert len(true & found) >= 0.98 * len(true)


@pytest.mark.parametrize(("seed", "few"), [(45, 5), pytest.param(53, 6, marks=pytest.mark.slow)])
def test_few_stars_that_cross_tie_detectors(seed, few):
    """In fewer exposures than are asked for, some flagged at an edge, and with a header that is far off."""
    night = header_layouts.Night(seed, off=1.0, turn=0.05, dither=36.0, n=6, n_stars=260, odd=(22.0, -24.0, 0.6))
    table, last = night.table, header_layouts.SIZE - 1
    x, y = table["x"], table["y"]
    table["flags"] = np.where((np.minimum(x, y) < 3) | (np.maximum(x, y) > last - 3), int(Flag.EDGE), 0)
    matches = legdistort.match(table, exposures=night.exposures, min_exposures=4)
    assert len(matches.camera.groups(matches.table)) == 1
    found, true = night.found(matches), np.asarray(matches.table["true"])
    assert len(found) >= few
    assert min(np.count_nonzero(true == star) for star in found) < 4
    assert not np.any(matches.table["flags"])
    rest = np.isin(true, list(found), invert=True)
    assert np.unique(true[rest], return_counts=True)[1].min() == 4


@pytest.mark.parametrize(
    "fluxes", [pytest.param(True, marks=pytest.mark.slow), pytest.param(False, marks=pytest.mark.slow)]
)
def test_chance_ties_no_detectors(fluxes):
    night = header_layouts.Night(7, off=3.0, dither=9.0, n=5, n_stars=800, odd=(22.0, -24.0, 0.6))
    assert not night.crossing(1)
    if not fluxes:
        night.table.remove_column("flux")
    matches = legdistort.match(night.table, exposures=night.exposures)
    assert not night.found(matches)
    assert len(matches.camera.groups(matches.table)) == 4


@pytest.mark.slow
def test_an_exact_layout_that_is_wrong_is_named():
    """Stars that move over the gaps are found nevertheless; where it is right there is nothing to say."""
    night = header_layouts.Night(4, off=5.0, n=5, n_stars=200)
    camera = legdistort.Camera.of_frames(night.exposures)
    exact, near, wide = (
        replace(camera, detectors={key: replace(each, layout_sigma=w) for key, each in camera.detectors.items()})
        for w in (None, 0.1, 3.0)
    )
    words = r"do not fit the layout of camera \S+: detector \d seems to lie \d+ px from where .* layout='fit'"
    with pytest.warns(AssumptionWarning, match=words):
        found = night.found(matched(night, camera=exact))
    assert len(found) > 0.9 * len(night.found(matched(night, camera=wide)))
    right = header_layouts.Night(4, off=0.0, n=5, n_stars=200)
    camera = legdistort.Camera.of_frames(right.exposures)
    detectors = {key: replace(each, layout_sigma=None) for key, each in camera.detectors.items()}
    assert len(right.found(matched(right, camera=replace(camera, detectors=detectors)))) > 0.9 * len(found)
    assert not detector_places.is_free(exact)
    assert not detector_places.is_free(near)
    assert detector_places.is_free(wide)


def test_what_headers_state_is_a_start_value():
    night = header_layouts.Night(5, n=2, n_stars=50)
    camera = legdistort.Camera.of_frames(night.exposures)
    assert detector_places.is_free(camera)
    assert all(np.isinf(each.layout_sigma).all() for each in camera.detectors.values())
    alone = legdistort.Camera.from_exposures([night.exposures[0]])
    assert alone["1"].layout_sigma is None


def test_detectors_without_a_common_star_stay():
    night = header_layouts.Night(6, dither=10.0, n=4, n_stars=120)
    assert not night.crossing(2)
    matches = matched(night)
    assert not night.found(matches)
    camera = matches.camera
    xy = np.stack([matches.table[name].value for name in ("x", "y")], axis=1)
    exposure = np.unique(matches.table["exposure"], return_inverse=True)[1]
    detector = np.unique(matches.table["detector"], return_inverse=True)[1]
    assert detector_places.nearer(camera, xy, exposure, detector, np.asarray(matches.table["star"])) is None


@pytest.mark.parametrize("solved", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_detectors_with_distortions_of_their_own_share_their_stars(solved):
    """Which are not smooth over the gap: no star twice, also where two exposures are enough for one, and solved so."""
    night = header_layouts.Night(5, off=0.0, n=6, n_stars=300, own=2.0)
    matches = legdistort.match(night.table, exposures=night.exposures, min_exposures=2)
    night.found(matches)  # no two in one
    star, true = np.asarray(matches.table["star"]), np.asarray(matches.table["true"])
    assert len(np.unique(star)) == len(np.unique(true))
    if solved:
        solution = legdistort.solve(matches, degree=3, static="fit", layout="fit")
        assert len(solution.stars) == len(np.unique(true))
        left = np.hypot(*(solution.residuals[name].value for name in ("dx", "dy")))
        assert np.median(left) < 0.02


def test_what_is_of_another_instrument_is_named_and_to_be_left_out():
    night = header_layouts.Night(3, n=3, n_stars=60)
    for each in night.exposures:
        each.header["INSTRUME"] = "NIRCAM"
    part = night.exposures[0]
    other = replace(part, name="b_mirimage", exposure="b", detector="MIRIMAGE", header={"INSTRUME": "MIRI"})
    rows = night.table[(night.table["exposure"] == part.exposure) & (night.table["detector"] == part.detector)]
    rows.replace_column("exposure", ["b"] * len(rows))
    rows.replace_column("detector", ["MIRIMAGE"] * len(rows))
    words = (
        r"^b_mirimage is of MIRI, another instrument than NIRCAM \(1, 2, 3, 4\): leave out what is of MIRI, and match"
    )
    with pytest.raises(InputError, match=words):
        legdistort.match(vstack([night.table, rows]), exposures=[*night.exposures, other], min_exposures=2)
