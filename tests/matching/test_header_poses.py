"""What the stars say of the WCSs of headers."""

import numpy as np
import pytest
from astropy.table import Table
from caller_warnings import warns_here
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort.exceptions import AssumptionWarning
from legdistort.geometry import similarity
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.matching.header_poses import HeaderPoses

SHAPE = (300, 300)
SHIFTS = np.array([[0, 0], [14, 5], [-9, 13], [6, -15], [-13, -8], [11, 12]], float)
SKY = TangentPlane(83.8, -5.4, similarity.identity())


def pose(shift):
    return np.column_stack([np.eye(2), shift])


def place(stated, found=SHIFTS):
    names = [f"e{k}" for k in range(len(stated))]
    headers = HeaderPoses(dict(zip(names, map(pose, stated), strict=True)), dict.fromkeys(names, SHAPE), SKY)
    return headers.place(dict(zip(names, map(pose, found), strict=True)))


def test_headers_as_the_stars_have_it_are_silent():
    rng = np.random.default_rng(0)
    for scatter in (0.0, 0.5, 3.0):
        for _ in range(50):
            assert place(SHIFTS + rng.normal(0, scatter, SHIFTS.shape))[1] is SKY


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ([[0, -1], [1, 0]], r"turned by 90.0 deg, and its pixels 1.000 times"),
        ([[0.8, 0], [0, 0.8]], r"turned by -?0.0 deg, and its pixels 0.800 times"),
        ([[-1, 0], [0, 1]], "mirrored, and its pixels 1.000 times"),
    ],
)
def test_dithers_that_no_such_wcs_makes(change, words):
    scatter = np.random.default_rng(0).normal(0, 1e-4, SHIFTS.shape)
    with warns_here(AssumptionWarning, match=words):
        place(0.7 * SHIFTS @ np.transpose(change) + scatter, 0.7 * SHIFTS)


def test_one_header_that_is_off_is_named():
    stated = SHIFTS.copy()
    stated[2] += 80
    with warns_here(AssumptionWarning, match=r"the header WCS of e2 contradicts the stars by up to 113 px"):
        assert place(stated)[1] is SKY


def shifted(*, sign=1.0, stated=True):
    """Positions in two frames whose headers have no WCS but may state a shift; most are in one of them alone."""
    rng, shift = np.random.default_rng(5), np.array([150.0, -140.0])
    stars = rng.uniform(0, 300, (40, 2))
    exposures, rows = [], []
    for k, move in enumerate((np.zeros(2), shift)):
        exposure = ld.Exposure(f"e{k}", np.ones(SHAPE))
        if stated:
            exposure.header.update(XSHIFT=sign * move[0], YSHIFT=sign * move[1])
        exposures.append(exposure)
        more = rng.uniform(0, 300, (150, 2))  # faint stars of this exposure alone
        for x, y in np.concatenate([stars + move, more]):
            if 0 < x < 299 and 0 < y < 299:
                rows.append((f"e{k}", x + 0.05 * rng.normal(), y + 0.05 * rng.normal(), 0.05, 0.05))
    return Table(rows=rows, names=["exposure", "x", "y", "x_err", "y_err"]), exposures


def test_shifts_of_headers_are_tried_and_verified():
    table, exposures = shifted()
    headers = HeaderPoses.of(exposures, dict.fromkeys(["e0", "e1"], SHAPE))
    assert_allclose(headers.step("e0", "e1"), pose([150.0, -140.0]))
    assert_allclose(headers.step("e1", "e0"), pose([-150.0, 140.0]))
    assert headers.place({"e0": pose([0, 0])})[1] is None
    exposures[0].header["XSHIFT"] = "none"
    assert HeaderPoses.of(exposures, {}).step("e0", "e1") is None
    for words in ({}, {"sign": -1.0}, {"stated": False}):
        table, exposures = shifted(**words)
        matches = ld.match(table, exposures=exposures, min_exposures=2)
        step = similarity.compose(matches.poses["e1"], similarity.invert(matches.poses["e0"]))
        assert_allclose(step[:, 2], [150.0, -140.0], atol=1.0)
