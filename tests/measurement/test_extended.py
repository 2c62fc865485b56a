"""The light of sources wider than stars, beside what a Gaussian spread by a Gaussian is."""

import numpy as np
import pytest

import legdistort as ld
from legdistort.measurement.scene.extended import PLACES, WEIGHTS, spread_light

SIGMA, HALF = 1.7, 12


def gaussian(covariance, dx, dy):
    inverse = np.linalg.inv(covariance)
    form = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
    return np.exp(-form / 2) / (2 * np.pi * np.sqrt(np.linalg.det(covariance)))


@pytest.fixture(scope="module")
def psf():
    axis = np.arange(-80, 81) / 4
    return ld.EffectivePSF.from_array(gaussian(SIGMA**2 * np.eye(2), axis, axis[:, None]), oversampling=4)


def test_places_have_the_moments_of_a_gaussian():
    assert WEIGHTS.sum() == pytest.approx(1)
    np.testing.assert_allclose(WEIGHTS @ PLACES, 0, atol=1e-12)
    np.testing.assert_allclose(PLACES.T @ (PLACES * WEIGHTS[:, None]), np.eye(2), atol=1e-12)
    assert WEIGHTS @ (PLACES**2).sum(axis=1) ** 2 == pytest.approx(8, rel=0.1)


@pytest.mark.parametrize("root", [[[0.6, 0], [0, 0.6]], [[2.0, 0], [0.8, 1.2]], [[2.6, 0], [0, 2.6]]])
def test_a_spread_gaussian_is_a_wider_one(psf, root):
    root, place = np.array(root), np.array([0.3, -0.2])
    dy, dx = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].reshape(2, -1)
    true = 5 * gaussian(SIGMA**2 * np.eye(2) + root @ root.T, dx - place[0], dy - place[1])
    found = spread_light(psf, np.array([[*place, 5.0]]), root[None], np.array([[40, 40]]), HALF)
    assert np.abs(found[0] - true).max() < 0.03 * true.max()


def test_derivatives_are_those_of_the_light(psf):
    params, root, centre = np.array([0.3, -0.2, 5.0]), np.array([[2.0, 0.1], [0.8, 1.2]]), np.array([[40, 40]])

    def light(step):
        return spread_light(psf, (params + step[:3])[None], (root + step[3:].reshape(2, 2))[None], centre, HALF)[0]

    _, by, by_root = spread_light(psf, params[None], root[None], centre, HALF, slopes=True)
    found = np.vstack([by[0], by_root[0].reshape(4, -1)])
    steps = 1e-4 * np.eye(7)
    np.testing.assert_allclose(found, [(light(s) - light(-s)) / 2e-4 for s in steps], atol=2e-4)
