"""Errors of rotation, scale and shift of exposures, against sets that numpy draws."""

import drawn_sets
import numpy as np
import pytest
from dense_model import drawn_set, orders

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.results.errors.pose_errors import in_words, pose_numbers

pytestmark = pytest.mark.filterwarnings(
    f"ignore::{LegdistortWarning.__module__}.{LegdistortWarning.__qualname__}"  # what is not known is known here
)
NAMES = "rotation", "scale", "dx"


def apart(values):
    """By how much numbers (n,) differ from their mean."""
    return np.asarray(values) - np.mean(values)


def true_numbers(pose):
    """Rotation [deg], scale and x shift of a pose, in numpy alone."""
    return np.degrees(np.arctan2(pose[1, 0], pose[0, 0])), np.sqrt(np.linalg.det(pose[:, :2])), pose[0, 2]


def test_errors_of_poses_are_those_of_drawn_sets():
    """Squared pulls of rotation and scale are one where the static distortion is known, and nothing is unknown."""
    pulls = []
    for seed in range(5):
        data, truth = drawn_set(seed, n_stars=60, n=7, dynamic=0.1)
        solution = ld.solve(drawn_sets.as_matches(data), prior=ld.Prior(truth["static"]), degree=3)
        assert solution.gauge.unknown == ()
        found, true = pose_numbers(solution), np.array([true_numbers(pose) for pose in data["poses"]])
        assert all(each.unknown[name] == 0 for each in found for name in NAMES)
        for k, name in enumerate(NAMES[:2]):
            off = apart([each.values[name] for each in found] - true[:, k])
            pulls.append(off**2 / np.square([each.errors[name] for each in found]))
        words = in_words(found)
        assert words.startswith("known, relative to the mean of the exposures: shift to 0.")
        assert "~" not in words
    assert np.mean(pulls) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("power", [1, 1j])
def test_a_number_that_an_unknown_map_changes_is_not_determined(power):
    """A static distortion z^2 of 1 px that nobody gave changes rotations or scales, by what is said."""
    static, order = np.zeros((2, 10)), orders(3)
    square = {(2, 0): 1, (1, 1): 2j, (0, 2): -1}  # z^2 in powers of u and v; of Legendre modes as far as it matters
    for mode, factor in square.items():
        value = power * factor / np.sqrt(np.sum(np.abs([*square.values()]) ** 2) / 8)
        static[:, order.index(mode)] = np.real(value), np.imag(value)
    matches = [
        drawn_sets.as_matches(drawn_set(3, n_stars=80, n=7, dynamic=0.003, given=given)[0])
        for given in (np.zeros((2, 10)), static)
    ]
    plain, bent = (pose_numbers(ld.solve(each, degree=3)) for each in matches)
    name, other = ("scale", "rotation") if power == 1 else ("rotation", "scale")
    changed = {key: apart([b.values[key] - a.values[key] for a, b in zip(plain, bent, strict=True)]) for key in NAMES}
    said = np.array([each.unknown[name] for each in plain])
    assert 0.2 * said.max() < np.abs(changed[name]).max() < 3 * said.max()
    for each in (*plain, *bent):
        assert np.isnan(each.errors[name])
        assert np.isnan(each.errors[other])
        assert each.text(name).startswith("~")
    assert "not determined (~): what is unknown, if it is 1 px rms, changes shift by up to" in in_words(plain)
    assert f"{name} by up to {said.max():.2g}" in in_words(plain)
    known = pose_numbers(ld.solve(matches[0], prior=ld.Prior(np.zeros((2, 10))), degree=3))
    assert np.abs(changed[name]).max() > 5 * max(each.errors[name] for each in known)  # which would be a lie
