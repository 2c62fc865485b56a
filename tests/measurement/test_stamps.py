"""Compiled loops over the stamps of stars, against the same sums over whole images."""

import numpy as np
import pytest
from scipy.ndimage import correlate

from legdistort.measurement.profiles import moffat
from legdistort.measurement.scene import stamps

HALF, SHAPE = 3, (40, 30)


@pytest.fixture
def stars():
    """Centres, some beyond the edges, and slopes of stars; images."""
    rng = np.random.default_rng(1)
    centres = np.array([[15, 20], [18, 21], [0, 0], [29, 39], [-2, 12], [31, 3], [15, 20]])
    slopes = rng.normal(size=(len(centres), 3, 49)).astype(np.float32)
    return centres, slopes, rng.uniform(0.5, 2, (4, *SHAPE)).astype(np.float32)


def whole(stamp, centre):
    """A stamp on an image, its pixels beyond it cut."""
    wide = np.zeros(np.add(SHAPE, 40))
    x, y = np.add(centre, 20)
    wide[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1] = stamp.reshape(2 * HALF + 1, -1)
    return wide[20:-20, 20:-20]


def test_light_is_laid(stars):
    centres, slopes, (image, *_) = stars
    expected = image + 2 * sum(whole(one[0], centre) for one, centre in zip(slopes, centres, strict=True))
    stamps.lay(image, slopes[:, 0], centres, HALF, 2)
    np.testing.assert_allclose(image, expected, rtol=1e-5, atol=1e-5)


def test_equations_are_those_of_whole_images(stars):
    centres, slopes, (weights, *left) = stars
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    circles = [np.hypot(x - cx, y - cy) <= HALF + 0.5 for cx, cy in centres]
    images = [
        [whole(by, centre) * circle * np.sqrt(weights) for by in one]
        for one, centre, circle in zip(slopes, centres, circles, strict=True)
    ]
    rest = np.sqrt(weights) * (left[0] - left[1] - left[2])
    right = stamps.weigh(slopes, centres, HALF, weights, tuple(left))
    np.testing.assert_allclose(right, [[(by * rest).sum() for by in one] for one in images], rtol=1e-4, atol=1e-4)
    i, j = np.array([(0, 1), (0, 6), (2, 4)]).T
    expected = np.einsum("npyx,nqyx->npq", np.array(images)[i], np.array(images)[j])
    np.testing.assert_allclose(stamps.products(slopes, centres, HALF, i, j), expected, rtol=1e-4, atol=1e-4)


def test_ratios_and_cores_are_those_of_whole_images(stars):
    centres, slopes, (weights, *left) = stars
    own, good = np.abs(slopes[:, 0]), weights > 0.8
    params = np.tile([0.3, -0.2, 1.0], (len(centres), 1))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    square, cores = [], []
    for light, (cx, cy) in zip(own, centres, strict=True):
        light = whole(light, (cx, cy))
        square.append((weights * light**2).sum())
        core = light * good * (np.hypot(x - cx - 0.3, y - cy + 0.2) <= 2.1)
        means = [(core * v).sum() for v in (weights * (left[0] - left[1] - left[2]) ** 2, weights * light**2)]
        cores.append(np.array(means) / max(core.sum(), 1e-30))
    np.testing.assert_allclose(stamps.squared_ratios(own, centres, HALF, weights), square, rtol=1e-5)
    np.testing.assert_allclose(
        stamps.cores(own, params, centres, HALF, 2.1, (weights, good, *left)), cores, rtol=1e-4, atol=1e-6
    )


def test_weights_are_inverse_variances(stars):
    variance, light, sky, out = stars[2]
    good, sky = variance > 0.8, sky - 3
    expected = good / (np.maximum(variance + 0.5 * (light + sky), 0.25 * variance) + (0.1 * light) ** 2)
    assert np.any(variance + 0.5 * (light + sky) < 0.25 * variance)
    (ny, nx), before = out.shape, out.copy()
    stamps.inverse_variances(good, variance, light, sky, 0.5, 0.25, 0.1, out, np.array([[2, 3, 7, 9]]))
    before[2:7, 3:9] = expected[2:7, 3:9]
    np.testing.assert_allclose(out, before, rtol=1e-5)
    stamps.inverse_variances(good, variance, light, sky, 0.5, 0.25, 0.1, out, np.array([[0, 0, ny, nx]]))
    np.testing.assert_allclose(out, expected, rtol=1e-5)


@pytest.mark.parametrize("side", [3, 5, 7])
def test_sums_over_surroundings(stars, side):
    image = stars[2][0]
    kernel = np.random.default_rng(2).normal(size=(side, side)).astype(np.float32)
    expected = correlate(image.astype(float), kernel.astype(float), mode="constant")
    np.testing.assert_allclose(stamps.correlate(image, kernel), expected, atol=1e-4)


@pytest.mark.parametrize("fwhm", [1.7, 4.0])
def test_slopes_of_place_and_peak_are_those_of_all(fwhm):
    """Those of a fit of all parameters, and the same profile."""
    params = moffat.parameters(np.array([3.0, 5.0]), moffat.shape(fwhm) + [0.2, 0, 0.3, 0.1], np.full((2, 2), 0.3))
    nodes = moffat.quadrature(fwhm)
    model, jacobian = moffat.evaluate(params, 6, nodes, jacobian=True)
    placed = moffat.evaluate_placed(params, 6, nodes)
    np.testing.assert_allclose(placed[0], model, rtol=1e-12)
    np.testing.assert_allclose(placed[1], jacobian[:, :3], rtol=1e-9, atol=1e-12)
