"""The sky that headers give is the one on which they agree: headers that are wrong have no part in it, and are named.

Truth from numpy, and headers written by astropy.
"""

import warnings
from dataclasses import replace

import header_layouts
import numpy as np
import pytest
from astropy.table import Table
from astropy.wcs import WCS
from caller_warnings import warns_here

import legdistort as ld
from legdistort.cameras.focal_planes import agreed_similarity
from legdistort.exceptions import AssumptionWarning, LegdistortWarning

SIZE, KEYS = header_layouts.SIZE, header_layouts.KEYS
EDGES = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (SIZE - 1.0)


@pytest.fixture(scope="module")
def night():
    return header_layouts.Night(3, off=1.0, n=5, n_stars=260, rolls=(0.0, 0.0, 0.0, 90.0), size=0.05)


def camera(night, keys=KEYS):
    places = dict(zip(KEYS, night.places, strict=True))
    return ld.Camera("cam", {key: ld.Detector((SIZE, SIZE), layout=places[key]) for key in keys})


def with_headers(night, of, keys=KEYS):
    """Exposures where detector k has the WCS of detector ``of[k]``, or what a function makes of it."""
    out = []
    for each in night.exposures:
        if each.detector not in keys:
            continue
        change = of.get(each.detector, each.detector)
        if callable(change):
            wcs = change(each)
        else:
            (other,) = [e for e in night.exposures if (e.exposure, e.detector) == (each.exposure, change)]
            wcs = other.wcs
        out.append(replace(each, wcs=wcs))
    return out


def turned(angle):
    """Makes WCSs of a detector that are turned about its middle."""

    def made(exposure):
        middle = np.full(2, (SIZE - 1) / 2)
        there = exposure.wcs.wcs_pix2world([middle], 0)[0]
        a = np.radians(angle)
        cd = exposure.wcs.pixel_scale_matrix @ [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
        wcs = WCS(naxis=2)
        wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cd = (
            ["RA---TAN", "DEC--TAN"],
            there,
            middle + 1,
            cd,
        )
        return wcs

    return made


def matched(night, exposures, keys=KEYS):
    rows = np.isin(np.asarray(night.table["detector"]), keys)
    return ld.match(night.table[rows], exposures=exposures, camera=camera(night, keys), min_exposures=3)


def off(night, matches):
    """Largest distance [arcsec] of corners of detectors on the sky from where the mean header has them, by exposure.

    Without what the pointing of headers scatters by: the mean over the corners is taken off.
    """
    far = []
    for each in night.exposures[: 4 * len(matches.names)]:
        if each.detector not in matches.camera.detectors:
            continue
        place, pose = night.places[KEYS.index(each.detector)], matches.poses[each.exposure]
        focal = (EDGES - place[:, 2]) @ np.linalg.inv(place[:, :2]).T
        plane = (focal - pose[:, 2]) @ np.linalg.inv(pose[:, :2]).T
        found = matches.sky.to_sky(plane)
        lon, lat = each.wcs.all_pix2world(EDGES, 0).T
        far.append([(found.ra.deg - lon) * np.cos(np.radians(lat)) * 3600, (found.dec.deg - lat) * 3600])
    return np.hypot(*np.moveaxis(far, 1, 0)).max()


#: What is right to a pixel or so in every header, with a pointing that scatters by 3 px [arcsec].
RIGHT = 12 * header_layouts.ARCSEC


def test_headers_that_are_right_are_silent(night):
    with warnings.catch_warnings(action="error", category=LegdistortWarning):
        matches = matched(night, night.exposures)
    assert matches.pointing.sentence == ""
    assert (matches.pointing.detectors, matches.pointing.is_undecided) == ({}, False)
    assert matches.sky.pixel_scale == pytest.approx(header_layouts.ARCSEC, rel=3e-3)
    assert off(night, matches) < RIGHT


@pytest.mark.parametrize(
    ("of", "named"),
    [({"1": "3", "3": "1"}, "1, 3"), ({"2": turned(90.0)}, "2"), ({"4": "1"}, "4")],
    ids=["exchanged", "turned", "that of another"],
)
def test_detectors_whose_headers_contradict_the_others_have_no_part_in_the_sky(night, of, named):
    """Two in each other's places made the scale of the sky two thirds of that which every header states."""
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        matches = matched(night, with_headers(night, of))
        solution = ld.solve(matches, degree=1)
    assert ", ".join(matches.camera.headers.odd or matches.pointing.detectors) == named
    assert off(night, matches) < RIGHT
    for each in (matches, solution):
        assert each.sky.pixel_scale == pytest.approx(header_layouts.ARCSEC, rel=3e-3)
    told = [check.sentence for check in solution.checks if check.name in ("header pointing", "camera")]
    assert any(f"detector {named} " in words for words in told), told
    assert f"from the headers of all detectors but {named};" in " ".join(str(solution).split())


def test_detectors_that_have_no_part_in_the_sky_are_named_once_they_are_matched(night):
    with warns_here(
        AssumptionWarning, match="the header WCS of detector 1, 3 contradicts those of the other detectors"
    ):
        matches = matched(night, with_headers(night, {"1": "3", "3": "1"}))
    assert list(matches.pointing.detectors) == ["1", "3"]


def test_two_detectors_in_each_other_s_places(night):
    """Nothing shows which header is right: the place of the sky is between, with an error that says so; no scale is."""
    keys = KEYS[:2]
    with warns_here(AssumptionWarning, match="contradict one another by more than their scale and rotation explain"):
        matches = matched(night, with_headers(night, {"1": "2", "2": "1"}, keys), keys)
    assert matches.sky.pixel_scale == pytest.approx(header_layouts.ARCSEC, rel=3e-3)
    assert matches.pointing.shift == pytest.approx(header_layouts.STEP / 2, rel=0.5)
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solution = ld.solve(matches, degree=1)
    (check,) = [each for each in solution.checks if each.name == "header pointing"]
    assert check.state == "fail"


def test_two_detectors_turned_against_each_other_give_no_sky(night):
    keys = KEYS[:2]
    with warns_here(AssumptionWarning, match="nothing shows which of them are right: they are ignored"):
        matches = matched(night, with_headers(night, {"2": turned(90.0)}, keys), keys)
    assert matches.sky is None
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solution = ld.solve(matches, degree=1)
    assert solution.sky is None
    (check,) = [each for each in solution.checks if each.name == "header pointing"]
    assert (check.state, "the sky stays unknown" in check.sentence) == ("warn", True)


def test_scale_and_rotation_are_those_of_headers_where_places_scatter():
    """Places of four detectors that are off by 25 px: scale and rotation of single headers, exact here, are better."""
    rng, middles = np.random.default_rng(4), np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * 700.0
    square = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) * 300.0
    right = middles[:, None] + square
    for _ in range(20):
        wrong = right + rng.normal(0, 12, (4, 1, 2))
        agreed = agreed_similarity(right, wrong)
        if agreed.agree.all():
            np.testing.assert_allclose(agreed.pose[:, :2], np.eye(2), atol=1e-9)
            np.testing.assert_allclose(agreed.pose[:, 2], (wrong - right).mean(axis=(0, 1)), atol=1e-9)
            assert 1 < agreed.apart < 20


def single(scales, seed=0):
    """Star lists of one detector, dithered, and exposures whose headers state pixels of 0.1 arcsec times `scales`."""
    rng, rows, exposures = np.random.default_rng(seed), [], []
    stars = rng.uniform(-80, 580, (120, 2))
    for i, scale in enumerate(scales):
        shift = rng.uniform(-60, 60, 2) * (i > 0)
        xy = stars + shift + rng.normal(0, 0.02, stars.shape)
        rows += [(f"e{i}", *each, 0.02, 0.02) for each in xy[np.all((xy > 0) & (xy < 500), axis=1)]]
        wcs = WCS(naxis=2)
        wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], [10.0, 20.0]
        wcs.wcs.crpix, wcs.wcs.cd = 251 + shift, scale * np.array([[-0.1, 0], [0, 0.1]]) / 3600
        exposures.append(ld.Exposure(f"e{i}", np.ones((501, 501), np.float32), wcs=wcs))
    return Table(rows=rows, names=["exposure", "x", "y", "x_err", "y_err"]), exposures


def test_an_exposure_whose_header_has_another_scale_has_no_part_in_the_sky():
    """By 2 per cent, which puts corners 7 px off and the mean of six exposures 1 px."""
    table, exposures = single([1, 1, 1, 1.02, 1, 1])
    with warns_here(AssumptionWarning, match="the header WCS of e3 contradicts the stars"):
        matches = ld.match(table, exposures=exposures)
    assert set(matches.pointing.off) == {"e3"}
    assert matches.sky.pixel_scale == pytest.approx(0.1, rel=2e-4)
    with warnings.catch_warnings(action="error", category=LegdistortWarning):
        right = ld.match(*single([1] * 6)[:1], exposures=single([1] * 6)[1])
    assert (right.pointing.sentence, right.pointing.off) == ("", {})


def test_where_nothing_shows_which_scale_is_right_the_sky_has_an_error_of_it():
    table, exposures = single([1, 1.02])
    with warns_here(AssumptionWarning, match="in their scale: that of the sky has an error of 0.99 per cent"):
        matches = ld.match(table, exposures=exposures, min_exposures=2)
    assert matches.pointing.scale == pytest.approx(0.01, rel=0.05)
    assert "the error of its scale, which is 0.01 of it at least" in matches.pointing.error(0.1)
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solution = ld.solve(matches, degree=1)
    (check,) = [each for each in solution.checks if each.name == "header pointing"]
    assert check.state == "fail"
