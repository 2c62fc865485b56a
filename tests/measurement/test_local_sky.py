"""The sky under single stars: slopes, and the noise of the light of halos."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from star_images import GAIN, READ_NOISE, SKY, errors, identify, image, ladder, observe, positions, scattered, usable

from legdistort.inputs.exposures import Exposure
from legdistort.measurement.crowding import is_isolated
from legdistort.measurement.positions import measure
from legdistort.simulation.pupil import PupilPSF
from legdistort.simulation.rendering import as_psf
from legdistort.simulation.rendering import render as render_psf

FWHM, SIZE, N = 3.5, 400, 100


@pytest.fixture(scope="module")
def halos():
    """Faint stars among bright ones with halos: positions, image, and the light of the halos at the faint ones."""
    psf, shape, made = as_psf(PupilPSF(strehl=0.3, resolution=3.9), (SIZE, SIZE)), (SIZE, SIZE), []
    centre = render_psf((41, 41), [[20, 20]], [1.0], psf=psf)[20, 20]
    for seed in range(6):
        rng = np.random.default_rng([24, seed])
        xy, flux = rng.uniform(8, SIZE - 9, (100, 2)), np.append(rng.uniform(3e3, 1.5e4, 70), rng.uniform(3e4, 1e6, 30))
        light = render_psf(shape, xy, flux, psf=psf, sky=SKY)
        x, y = np.round(xy).astype(int).T
        made.append((xy, observe(light, rng), light[y, x] - SKY - centre * flux))
    return made


@pytest.fixture(scope="module", params=["moffat", pytest.param("effective", marks=pytest.mark.slow)])
def crowd(request, halos):
    """The faint ones that are isolated: (x - truth) / error, and the light of the halos."""
    pulls, lights = [], []
    for xy, data, light in halos[:3] if request.param == "moffat" else halos:
        table = usable(measure(Exposure("halos", data, gain=GAIN), psf=request.param))
        star = identify(table, xy)
        rows = (star >= 0) & (star < 70) & is_isolated(table)
        rows &= cKDTree(xy).query(xy, k=2)[0][star, 1] > 10
        star = star[rows]
        pulls.append((positions(table)[rows] - xy[star]) / errors(table)[rows])
        lights.append(light[star])
    return np.concatenate(pulls), np.concatenate(lights)


def test_faint_stars_on_halos_have_true_errors(crowd):
    """Without slopes of the sky: 1.13 and 1.41 with Moffat profiles, 1.20 and more with the effective PSF."""
    pulls, light = crowd
    for rows in (light < np.median(light), light >= np.median(light)):
        assert np.count_nonzero(rows) > 40
        assert np.std(pulls[rows]) == pytest.approx(1, abs=0.14)
        assert 1.4826 * np.median(np.abs(pulls[rows])) == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_errors_grow_with_the_photons_of_the_halo():
    """Stars of one flux on and off a halo: the errors are in the ratio of the noise of the pixels."""
    rng = np.random.default_rng(22)
    xy = scattered(rng, N, SIZE)
    clean = image((SIZE, SIZE), xy, np.full(N, 3000.0), FWHM)
    y, x = np.mgrid[:SIZE, :SIZE]
    glow = 1500 * np.exp(-0.5 * ((x - SIZE / 2) ** 2 + (y - SIZE / 2) ** 2) / 40.0**2)
    table = usable(measure(Exposure("glow", observe(clean + glow, rng), gain=GAIN), psf="moffat"))
    star = identify(table, xy)
    table, at = table[star >= 0], np.round(xy[star[star >= 0]]).astype(int)
    light = glow[at[:, 1], at[:, 0]]
    dark, lit = light < 5, light > 700
    # three quarters of the star's own light count under its core
    own = 3000 / (1.13 * FWHM**2) * 0.75
    noise = np.sqrt((100 + own + np.array([light[lit].mean(), 0])) / GAIN + (READ_NOISE / GAIN) ** 2)
    ratio = errors(table)[lit].mean() / errors(table)[dark].mean()
    assert ratio == pytest.approx(noise[0] / noise[1], rel=0.15)
    assert ratio > 1.5


@pytest.mark.parametrize("factor", [pytest.param(0.5, marks=pytest.mark.slow), 2.0])
def test_a_wrong_gain_does_not_make_the_sky_noisy(factor):
    """Model wrong: the noise of the sky is seen in the image, whatever the gain says."""
    rng = np.random.default_rng(23)
    xy, (_, flux, _) = scattered(rng, N, SIZE), ladder(N, FWHM, 12, 25)
    data = observe(image((SIZE, SIZE), xy, rng.permutation(flux), FWHM), rng)
    right, wrong = (usable(measure(Exposure("gain", data, gain=g), psf="moffat")) for g in (GAIN, factor * GAIN))
    ratio = np.median(errors(wrong)) / np.median(errors(right))
    assert ratio == pytest.approx(1, abs=0.15)
