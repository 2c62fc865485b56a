"""What the stars say of the WCSs of headers."""

import re

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
from legdistort.results.errors.header_pointing import HeaderPointing

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


def of_a_visit(rng, scatter, n=4, dithers=500.0):
    """Header WCSs of dithers by half a field, whose pointings scatter, and poses by their stars."""
    found = rng.uniform(-dithers, dithers, (n, 2))
    return found + rng.normal(0, scatter, (n, 2)), found


def test_one_of_four_dithers_whose_header_is_16_pixels_off_is_named_and_has_no_part_in_the_sky():
    rng, named = np.random.default_rng(2), 0
    for _ in range(40):
        stated, found = of_a_visit(rng, 0.7)
        stated[2] += [-4.0, 15.5]
        made = told(list(map(pose, stated)), found)
        named += made.off.keys() == {"e2"}
    assert named > 30
    stated, found = of_a_visit(rng, 0.5)
    stated[2] += [-4.0, 15.5]
    with warns_here(AssumptionWarning, match=r"header WCS of e2 contradicts the stars by up to 16 px; the sky is"):
        poses, _ = place(stated, found)
    off = [poses[f"e{k}"][:, 2] - stated[k] for k in (0, 1, 3)]
    assert_allclose(np.mean(off, axis=0), 0, atol=1e-9)


def test_headers_of_usual_scatter_are_seldom_accused():
    """Less than one set in a hundred, and none by a visit among others, or by dithers that a scale displaces."""
    rng, accused = np.random.default_rng(4), {4: 0, 11: 0}
    for n in accused:
        names = [f"e{k}" for k in range(n)]
        for _ in range(400):
            stated, found = of_a_visit(rng, 5.0, n)
            headers = HeaderPoses(
                dict(zip(names, map(pose, stated), strict=True)), dict.fromkeys(names, (2000, 2000)), SKY
            )
            accused[n] += bool(headers.pointing(dict(zip(names, map(pose, found), strict=True))).off)
    assert all(0 < number <= 5 for number in accused.values())
    visit, found = of_a_visit(rng, 0.1, 12)
    visit[-3:] += [9.0, 0.0]
    assert told(list(map(pose, visit)), found).off == {}
    mosaic = np.array([[0, 0], [3, 5], [-4, 2], [900, 200]])
    assert told(list(map(pose, 1.004 * mosaic)), mosaic).off == {}


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


def told(stated, found=SHIFTS):
    names = [f"e{k}" for k in range(len(stated))]
    headers = HeaderPoses(dict(zip(names, stated, strict=True)), dict.fromkeys(names, SHAPE), SKY)
    return headers.pointing(dict(zip(names, map(pose, found[: len(stated)]), strict=True)))


def test_pointing_is_as_uncertain_as_the_mean_of_headers():
    """Error of the mean pointing of headers that scatter by 2 px an axis and 0.01 degrees: rms over draws."""
    rng, off, said = np.random.default_rng(3), [], []
    for _ in range(150):
        shift, angle = rng.normal(0, 2.0, SHIFTS.shape), np.radians(rng.normal(0, 0.01, len(SHIFTS)))
        stated = [
            np.column_stack([np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]), s])
            for a, s in zip(angle, SHIFTS + shift, strict=True)
        ]
        made = told(stated)
        off.append([*shift.mean(axis=0), np.degrees(angle.mean())])
        said.append([made.shift, made.shift, made.turn])
        assert (made.n_used, made.off, made.sentence) == (len(SHIFTS), {}, "")
    assert_allclose(np.mean(np.square(off), axis=0), np.mean(np.square(said), axis=0), rtol=0.3)
    assert np.isnan(told([pose(SHIFTS[0])]).shift)
    assert "is 100 mas per axis at least" in ld.results.errors.header_pointing.HeaderPointing(2, 1.0, 0.1).error(0.1)


def test_headers_turned_by_180_degrees_are_named_so():
    stated = list(map(pose, SHIFTS))
    for k in (1, 4):  # about the middle of the detector
        stated[k] = np.column_stack([-np.eye(2), 299 - SHIFTS[k]])
    made = told(stated)
    assert set(made.off) == {"e1", "e4"}
    for pixels, turn in made.off.values():
        assert abs(turn) == pytest.approx(180, abs=0.5)
        assert pixels > 300
    assert re.match(
        r"the header WCS of e1, e4 contradicts the stars by up to \d+ px \(turned by 180 deg\)", made.sentence
    )
    assert made.sentence.endswith("the sky is that of the other headers, 4 of 6")
    assert made.shift == pytest.approx(0, abs=1e-9)


def test_where_no_majority_agrees_the_groups_are_named():
    stated = list(map(pose, SHIFTS[:4] + [[0, 0], [0, 0], [200, 0], [200, 0]]))
    made = told(stated)
    assert (made.n_used, made.groups) == (0, (("e0", "e1"), ("e2", "e3")))
    assert made.sentence.endswith("(headers that agree with one another: e0, e1 | e2, e3)")


def test_what_absolute_errors_leave_out_of_a_sky_by_headers():
    """Pointing and rotation, at least by their scatter, and the scale, which is known no better than the rotation."""
    words = HeaderPointing(5, 0.5, 0.01).error(0.02)
    assert words.startswith(
        "by their scatter the error of its pointing is 10 mas per axis at least, of its rotation 0."
    )
    assert "what they all have wrong alike (guide stars, roll) adds to that and is not known" in words
    assert words.endswith("leave this out, and the error of its scale, which is as they state it")
    assert HeaderPointing(5, 0.5, 0.01, scale=2e-4).error(0.02).endswith("scale, which is 0.0002 of it at least")
    by_camera = HeaderPointing(5, 0.5, 0.01).error(0.02, "NIRCAM")
    assert "scale, which is by a reference of camera NIRCAM, as is the rotation but for by how much" in by_camera
    known = HeaderPointing(5, 0.5, 0.01).error(0.02, "NIRCAM", (2e-5, 0.0012))
    assert "which is 2e-05 by a reference of camera NIRCAM, as is the rotation (0.001 deg) but for by how much" in known
