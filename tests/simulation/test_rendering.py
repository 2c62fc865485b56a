"""Rendered stars: flux, width, pixel integration and the bound on their positions."""

import numpy as np
import pytest

from legdistort.exceptions import InputError
from legdistort.simulation import rendering


def test_profile_holds_unit_flux_and_its_width():
    psf = rendering.Moffat(4.5, 2.8, ellipticity=0.3, angle=0.4)
    image = rendering.render((401, 401), [[200.3, 199.8]], [1e6], psf=psf)
    lost = (1 + (200 / psf.core) ** 2) ** (1 - 2.8)
    assert image.sum() == pytest.approx(1e6 * (1 - lost), rel=2e-4)
    a, b = psf.fwhm / np.sqrt(0.7), psf.fwhm * np.sqrt(0.7)
    for angle, width in ((0.4, a), (0.4 + np.pi / 2, b)):
        edge = psf(width / 2 * np.cos(angle), width / 2 * np.sin(angle))
        assert edge / psf(0, 0) == pytest.approx(0.5)


def test_pixels_are_integrated():
    psf = rendering.Moffat(4.5, 2.8, ellipticity=0.1, angle=1.0)
    image = rendering.render((41, 41), [[20.37, 19.81]], [1.0], psf=psf)
    t = (np.arange(41 * 40) + 0.5) / 40 - 0.5  # 40 x 40 midpoints a pixel
    fine = psf((t - 20.37)[None, :], (t - 19.81)[:, None]).reshape(41, 40, 41, 40).mean(axis=(1, 3))
    inner = np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(image[inner], fine[inner], rtol=1e-4)


def test_star_off_the_image_adds_its_wing_or_nothing():
    psf = rendering.Moffat()
    assert rendering.render((50, 50), [[500.0, 20.0]], [1e3], psf=psf).sum() == 0
    wing = rendering.render((50, 50), [[-3.0, 20.0]], [1e3], psf=psf)
    assert np.unravel_index(wing.argmax(), wing.shape) == (20, 0)


def test_position_error_has_the_two_regimes():
    """Slopes 1/flux and 1/sqrt(flux), and the value of a numerical Fisher matrix on pixels."""
    psf = rendering.Moffat()
    camera = {"psf": psf, "sky": 200.0, "gain": 2.0, "read_noise": 15.0}
    flux = np.array([10.0, 20.0, 1e4, 1e9, 2e9])
    error = rendering.position_error(flux, **camera)
    assert error[0] / error[1] == pytest.approx(2, rel=0.01)
    assert error[3] / error[4] == pytest.approx(np.sqrt(2), rel=0.01)
    step = 0.01
    left, middle, right = (rendering.render((61, 61), [[30 + d, 30]], [1e4], psf=psf) for d in (-step, 0, step))
    variance = (middle + 200) / 2 + 7.5**2
    fisher = np.sum(((right - left) / (2 * step)) ** 2 / variance)
    assert error[2] == pytest.approx(1 / np.sqrt(fisher), rel=0.02)


def test_profile_rejects():
    with pytest.raises(InputError, match="beta > 1"):
        rendering.Moffat(4.5, 0.9)
