"""Where detectors lie as the sky shows it: layouts found beside static distortions, with a bend that a reference tells.

The truth is numpy alone: the affine part, over a detector, of the map from the sky to its pixels.
"""

from dataclasses import replace

import header_layouts
import numpy as np
import pytest
from astropy.table import Table

import legdistort as ld
from legdistort.cameras.places import relative_errors
from legdistort.exceptions import ConvergenceWarning, InputError
from legdistort.solving import camera_fit
from legdistort.solving.camera_fit import with_declared_size

EVIDENCE = ld.Prior(None, sigma="evidence")
#: Size of the bend that all exposures share, as `header_layouts.Night` has it; error of a star of the catalogue [pix].
BEND, ERROR = 0.3, 0.05


def drawn(seed, size):
    return header_layouts.Night(
        seed, off=2.0, turn=0.05, n=8, size=size, static=BEND, n_stars=350, sigma=0.02, rolls=(0.0, 0.0, 0.0, 20.0)
    )


def catalogue_of(night, seed):
    """150 of its stars in the plane, with errors."""
    rng = np.random.default_rng(seed + 100)
    stars = rng.permutation(len(night.sky))[:150]
    x, y = (night.sky[stars] + rng.normal(0, ERROR, (150, 2))).T
    return Table({"x": x, "y": y, "x_err": np.full(150, ERROR), "y_err": np.full(150, ERROR)})


def true_places(night, seed):
    """x, y [pix] and rotation [deg] of the affine part of the whole map of every detector, (4, 3)."""
    t, weights = np.polynomial.legendre.leggauss(8)
    q = np.stack([each.ravel() for each in np.meshgrid(t, t)], axis=1) * header_layouts.SIZE / 2
    middle, weights = (header_layouts.SIZE - 1) / 2, np.sqrt(np.outer(weights, weights).ravel())[:, None]
    common, found = np.random.default_rng((seed, 1)).normal(0, BEND / 2, (10, 2)), []
    for place in night.places:
        p = (q + middle - place[:, 2]) @ np.linalg.inv(place[:, :2]).T
        u, v = (p / header_layouts.MIDDLE - 1).T
        bent = p + np.stack([u**a * v**b for a in range(4) for b in range(4 - a)], axis=1) @ common
        pixels = bent @ place[:, :2].T + place[:, 2]
        shift, *linear = np.linalg.lstsq(weights * np.column_stack([np.ones(len(p)), p]), weights * pixels, rcond=None)[
            0
        ]
        linear = np.transpose(linear)
        turn = np.degrees(np.arctan2(linear[1, 0] - linear[0, 1], linear[0, 0] + linear[1, 1]))
        found.append([*np.linalg.solve(linear, middle - shift), turn])
    return np.array(found)


def after_an_affine_map(true, off):
    """What one affine map of all detectors leaves of differences (4, 3) of places, as it fits best over their areas."""
    columns = []
    for x, y, _ in true:
        u, v = np.array([x, y]) / header_layouts.MIDDLE - 1
        turn = np.degrees(1 / header_layouts.MIDDLE)
        columns.append([[1, 0, u, v, 0, 0], [0, 1, 0, 0, u, v], [0, 0, 0, turn / 2, -turn / 2, 0]])
    # the rotation is a twist of so many pixels, rms over a detector beside a shift
    columns, arm = np.concatenate(columns), np.tile([1, 1, np.radians(header_layouts.SIZE / np.sqrt(6))], 4)
    fitted = np.linalg.lstsq(arm[:, None] * columns, arm * off.ravel(), rcond=None)[0]
    return off - (columns @ fitted).reshape(4, 3)


def squared_pulls(night, seed, places):
    """Of x and y together, and of rotations."""
    true = true_places(night, seed)
    found = np.array([[each.x, each.y, each.rotation] for each in places.values()])
    pull = after_an_affine_map(true, found - true) / np.array([each.errors for each in places.values()])
    return np.mean(pull[:, :2] ** 2), np.mean(pull[:, 2] ** 2)


def solved(night, seed, **options):
    matches = ld.match(night.table, exposures=night.exposures)
    catalogue = catalogue_of(night, seed)
    return ld.solve(matches, degree=3, **{"static": "fit", "prior": EVIDENCE, "reference": catalogue} | options)


@pytest.fixture(scope="module")
def one():
    night = drawn(3, 0.1)
    return night, solved(night, 3)


def test_a_bend_that_the_reference_tells_is_in_the_places(one):
    night, solution = one
    camera = solution.camera
    there = squared_pulls(night, 3, camera.places)
    assert max(there) < 2
    words = " ".join(str(solution).split())
    assert "after one affine map of all together" in words
    assert "a bend of all together, as the reference tells it, is in places and errors" in words
    place = camera.places["2"]
    row = next(line for line in camera.table_lines() if line.startswith("2 "))
    assert f"{place.x:.2f}" in row
    assert f"{place.rotation:.4f}" in row
    assert camera.to_dict()["detectors"][1]["rotation_error_deg"] == place.errors[2]


def test_files_keep_them(one, tmp_path):
    _, solution = one
    camera = ld.Camera.read(solution.camera.write(tmp_path / "camera.asdf"))
    for key, each in camera.places.items():
        there = solution.camera.places[key]
        assert (each.x, each.y, *each.errors) == pytest.approx((there.x, there.y, *there.errors), rel=1e-9)


def test_errors_that_are_not_known_together_count_as_independent(one):
    """An older file has none: those of layouts and of the bend, which partly cancel, are then somewhat large."""
    _, solution = one
    older = replace(solution.camera, place_errors=None).places
    for key, each in solution.camera.places.items():
        assert (older[key].x, older[key].rotation) == (each.x, each.rotation)
        ratio = np.array(older[key].errors) / each.errors
        assert np.all((ratio > 0.8) & (ratio < 2))


@pytest.mark.slow
def test_without_a_reference_the_line_names_the_map_and_what_a_bend_does(one):
    night, _ = one
    solution = solved(night, 3, reference=None)
    words = " ".join(str(solution).split())
    assert "after one map of degree 3 of all together" in words
    assert "a bend of all together by 1 px rms, which a reference would tell (--reference), shifts single ones" in words
    assert solution.camera.places == {key: each.place for key, each in solution.camera.detectors.items()}


def test_places_of_which_nothing_is_known_have_infinite_errors():
    corners, known = np.array([[0, 0], [540, 0], [540, 540], [0, 540]]), np.full((2, 3), 0.1)
    for n in (0, 2):
        detectors = {
            str(k): ld.Detector((512, 512), layout=np.column_stack([np.eye(2), -corner]),
                                layout_sigma=known if k < n else np.full((2, 3), np.inf))
            for k, corner in enumerate(corners)
        }  # fmt: skip
        errors = relative_errors(ld.Camera("four", detectors), 0.01 * np.eye(24))
        assert np.all(np.isinf(errors[n:]))
        assert np.all(np.isfinite(errors[:n]))
        assert np.all(errors[:n] <= 0.1)


def test_place_errors_are_refused_that_are_none():
    chips = {"1": ld.Detector((64, 64)), "2": ld.Detector((64, 64), layout=[[1.0, 0.0, -70.0], [0.0, 1.0, 0.0]])}
    for wrong in (np.zeros((3, 3)), [[0.1, 0.1, -1.0]] * 2, [[0.1, 0.1, np.nan]] * 2):
        with pytest.raises(InputError, match=r"place_errors must be standard deviations \(2, 3\)"):
            ld.Camera("c", chips, place_errors=wrong)


@pytest.mark.slow
def test_errors_of_places_are_right():
    """Of rotations somewhat too small: over 32 sets their mean square is 1.4 times as large as stated."""
    found = []
    for seed in range(8):
        for size in (0.02, 0.1):
            night = drawn(seed, size)
            found.append(squared_pulls(night, seed, solved(night, seed).camera.places))
    shifts, rotations = np.mean(found, axis=0)
    assert shifts == pytest.approx(1, abs=0.3)
    assert 0.7 < rotations < 1.6


def test_a_declared_size_is_that_of_the_detectors(one):
    """In every mode that they do not have as layout; of a map that a detector states it is the uncertainty."""
    night, _ = one
    matches = ld.match(night.table, exposures=night.exposures)
    stated = np.zeros((2, 15))
    stated[:, 4] = 0.2
    chips = matches.camera.detectors | {"2": replace(matches.camera["2"], static=stated)}
    matches = replace(matches, camera=replace(matches.camera, detectors=chips))
    size = ld.Prior(None, static_sigma=0.5)
    for static, becomes in ((None, None), ("fit", "prior"), ("prior", "prior")):
        found, left, asked = with_declared_size(matches, size, static, dynamic=None, degree=3)
        assert asked == becomes
        assert left.sigma == "evidence"
        assert not left.states_mean
        for key, each in found.camera.detectors.items():
            assert np.all(each.static_sigma[:, 3:] == 0.5)
            assert each.static_sigma.shape == (2, 15 if key == "2" else 10)
        assert np.array_equal(found.camera["2"].static, stated)
    with pytest.raises(
        InputError, match=r"static='hold' \(--static hold\) takes static distortions of detectors as exact"
    ):
        ld.solve(matches, prior=size, static="hold")
    with pytest.raises(InputError, match=r"static='prior' needs .* \(--static-sigma, Detector"):
        ld.solve(ld.match(night.table, exposures=night.exposures), static="prior")


@pytest.mark.slow
def test_with_a_declared_size_places_are_as_without_where_it_is_large(one):
    night, solution = one
    for static in ("fit", "prior", None):
        sized = solved(night, 3, prior=ld.Prior(None, static_sigma=0.5), static=static)
        assert "not" not in sized.status
        for key, each in sized.camera.places.items():
            other = solution.camera.places[key]
            assert (each.x, each.y) == pytest.approx((other.x, other.y), abs=0.002)
            assert each.rotation == pytest.approx(other.rotation, abs=0.001)


def test_a_camera_that_did_not_settle_fails_its_check(one, monkeypatch):
    night, _ = one
    monkeypatch.setattr(camera_fit, "_STEPS", 1)
    with pytest.warns(ConvergenceWarning, match="errors do not hold: see the check camera"):
        solution = solved(night, 3, reference=None)
    check = next(check for check in solution.checks if check.name == "camera")
    assert check.state == "fail"
    assert "did not settle" in check.sentence
    assert "--static-sigma PIXELS" in check.cure
    assert "after one map of degree 3 of all together" in " ".join(str(solution).split())
    assert "the fit did not settle, and these errors do not hold" in " ".join(str(solution).split())
