"""A static distortion that was fitted in too low a degree: its cure is a higher one, and no turbulence is named.

Sets are of numpy alone: dithered exposures of one detector, or of two, with static distortions.
"""

import re
import warnings

import numpy as np
import pytest
from astropy.table import Table
from numpy.polynomial import legendre

import legdistort as ld
from legdistort.exceptions import LegdistortWarning

SIZE, GAP, SIGMA = 1024, 60, 0.02


def field(rng, rms, degree):
    """A distortion of a degree, x and y, pixels rms over the detector, shift, rotation, scale and shear aside."""
    i, j = np.indices((degree + 1, degree + 1))
    coefficients = rng.normal(size=(2, degree + 1, degree + 1)) * ((i + j <= degree) & (i + j >= 2))
    power = np.sum(coefficients**2 / (2 * i + 1) / (2 * j + 1), axis=(1, 2))
    return coefficients * rms / np.sqrt(power)[:, None, None]


def static_set(seed, detectors, *, degree=5, single=0.0, n=6, n_stars=260):
    """Exposures, stars and errors; `single` [pix] is what every exposure has of its own, as turbulence."""
    rng, rows, poses = np.random.default_rng(seed), [], {}
    bent = [field(rng, 0.12, degree) for _ in range(detectors)]
    corners = [np.array([k * (SIZE + GAP), 0]) for k in range(detectors)]
    stars = rng.uniform([-250, -250], [detectors * (SIZE + GAP) + 250, SIZE + 250], (n_stars * detectors, 2))
    for e in range(n):
        shift = rng.uniform(-230, 230, 2) * (e > 0)
        poses[f"e{e}"] = np.column_stack([np.eye(2), shift])
        own = field(rng, single, degree) if single else None
        for k, corner in enumerate(corners):
            q = stars + shift - corner
            inside = np.flatnonzero(((q > 0) & (q < SIZE - 1)).all(axis=1))
            x, y = 2 * (q[inside].T + 0.5) / SIZE - 1
            moved = sum(np.array([legendre.legval2d(x, y, c) for c in f]) for f in (bent[k], own) if f is not None)
            xy = q[inside] + moved.T + SIGMA * rng.normal(size=(len(inside), 2))
            rows += [(f"e{e}", str(k), j, *place, SIGMA, SIGMA) for j, place in zip(inside, xy, strict=True)]
    table = Table(rows=rows, names=["exposure", "detector", "star", "x", "y", "x_err", "y_err"])
    if detectors == 1:
        table.remove_column("detector")
        return ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses)
    layouts = {str(k): np.column_stack([np.eye(2), -corner]) for k, corner in enumerate(corners)}
    camera = ld.Camera("PAIR", {k: ld.Detector((SIZE, SIZE), layout=v) for k, v in layouts.items()})
    return ld.Matches.from_table(table, camera=camera, poses=poses)


def solved(matches, degree):
    known = {"prior": ld.Prior(None, sigma="evidence")} if matches.camera.has_focal_plane else {}
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        return ld.solve(matches, degree=degree, static="fit", **known)


def wrong(solution):
    return {each.name: each for each in solution.checks if each.state in ("warn", "fail")}


def assert_named(matches, degree, right):
    """Solved at a degree, with the right one as the cure, or by chance the next."""
    found = wrong(solved(matches, degree))
    told = found.get("degree", found["place"])
    assert "turbulence" not in found["chi2"].sentence + told.sentence
    assert "alike in all exposures of a detector (static)" in told.sentence
    cure = found["chi2"].cure.partition("; first --layout fit, if")[0]
    named, figure = re.fullmatch(r"--degree (\d) would bring chi2/dof to (?:about )?(\S+)", cure).groups()
    assert right <= int(named) <= right + 1
    assert told.cure == found["chi2"].cure
    cured = solved(matches, int(named))
    assert not wrong(cured).keys() & {"chi2", "place", "degree"}
    assert float(figure) == pytest.approx(cured.chi2 / cured.dof, abs=0.15)


def test_the_degree_that_is_missing_is_named_and_what_it_reaches():
    assert_named(static_set(3, 1), 3, 5)


@pytest.mark.slow
def test_the_same_of_a_camera():
    assert_named(static_set(4, 2, degree=3, n=5, n_stars=120), 2, 3)


@pytest.mark.sets
@pytest.mark.parametrize("seed", [3, 4, 5])
def test_the_same_of_a_camera_of_degree_5(seed):
    assert_named(static_set(seed, 2), 3, 5)


@pytest.mark.sets
@pytest.mark.parametrize("seed", range(5, 12))
def test_the_same_of_other_sets(seed):
    assert_named(static_set(seed, 1), 3, 5)


def test_what_differs_from_exposure_to_exposure_is_not_called_static():
    found = wrong(solved(static_set(3, 1, single=0.05), 5))
    assert "(static)" not in found["degree"].sentence if "degree" in found else True
    assert "in every exposure in another way" in found["chi2"].sentence
