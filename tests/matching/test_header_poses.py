"""What the stars say of the WCSs of headers."""

import numpy as np
import pytest
from caller_warnings import warns_here

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
