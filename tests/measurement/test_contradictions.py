"""A gain that the noise contradicts, and data of any size."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from caller_warnings import warns_here
from numpy.testing import assert_allclose
from star_images import image, scattered

from legdistort.exceptions import AssumptionWarning
from legdistort.inputs.exposures import Exposure
from legdistort.inputs.frames.working_units import in_working_unit, noise_unit, working_unit
from legdistort.measurement.noise_calibration import calibrate_noise
from legdistort.measurement.positions import measure

SHAPE, GAIN, READ_NOISE = (160, 160), 2.0, 5.0


def exposure(gain=GAIN, size=1.0, sky=0.0, **known):
    """Twenty stars on a sky of 100 with true noise; the sky is taken off to leave `sky`, if that is given."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(20, 150, 32), np.arange(20, 150, 32))
    xy = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.5, 0.5, (25, 2))
    light = image(SHAPE, xy, np.geomspace(3e3, 1e5, 25), 3.0)
    data = (rng.poisson(light * GAIN) + rng.normal(0, READ_NOISE, SHAPE)) / GAIN - sky
    return Exposure("e", data * size, gain=gain / size if gain else None, read_noise=READ_NOISE, **known)


def measured(one):
    return measure(one, psf="moffat")


@pytest.mark.parametrize(
    ("gain", "words"),
    [(300.0, r"e: the noise is \d+ times too large for a gain of 300 elec"), (0.02, "times too small")],
)
def test_a_gain_that_the_sky_contradicts_is_said(gain, words):
    with warns_here(AssumptionWarning, match=words):
        measured(exposure(gain))


def test_a_gain_that_the_stars_contradict_is_said():
    """The sky is gone, so that its noise shows nothing."""
    with warns_here(AssumptionWarning, match="times too small for a gain of 0.02"):
        measured(exposure(0.02, sky=100.0))


def test_a_gain_that_the_stars_contradict_is_said_without_a_sky():
    """Their own photons are more noise than so large a gain has."""
    with warns_here(AssumptionWarning, match="times too large for a gain of 300"):
        measured(exposure(300.0, sky=100.0))


@pytest.mark.parametrize(
    "factor", [0.5, pytest.param(1.0, marks=pytest.mark.slow), pytest.param(2.0, marks=pytest.mark.slow), 5.0]
)
def test_a_gain_that_may_be_is_not_doubted(factor):
    measured(exposure(factor * GAIN))
    measured(exposure(factor * GAIN, sky=100.0))


def test_a_known_noise_needs_no_gain():
    one = exposure()
    measured(Exposure("e", one.data, gain=300.0, uncertainty=np.full(SHAPE, 8.0)))


@pytest.mark.parametrize("known", ["gain", "nothing", "uncertainty"])
@pytest.mark.parametrize(
    "size",
    [
        1e-30,
        pytest.param(1e-21, marks=pytest.mark.slow),
        pytest.param(0.1, marks=pytest.mark.sets),
        pytest.param(1e16, marks=pytest.mark.sets),
        1e22,
    ],
)
def test_a_frame_is_the_same_in_any_unit(size, known):
    """Positions, errors, flags; fluxes are in the unit."""

    def in_unit(size):
        one = exposure(GAIN if known == "gain" else None, size)
        one = replace(one, uncertainty=np.full(SHAPE, 8.0) * size) if known == "uncertainty" else one
        with warnings.catch_warnings():
            if known == "nothing":
                warnings.filterwarnings("ignore", "no gain known", AssumptionWarning)
            return measured(one)

    right, found = in_unit(1.0), in_unit(size)
    assert len(found) == len(right) > 20
    for name in ("flux", "flux_err"):
        assert_allclose(found[name], right[name] * size, rtol=1e-9)
    for name in ("x", "y", "x_err", "y_err", "fwhm"):
        assert_allclose(found[name].value, right[name].value, rtol=0, atol=1e-9)
    assert_allclose(found["chi2"], right["chi2"], rtol=1e-9)
    assert_allclose(found["flags"], right["flags"])


@pytest.mark.parametrize(
    "size",
    [
        1e-30,
        pytest.param(1e-21, marks=pytest.mark.slow),
        pytest.param(3e-7, marks=pytest.mark.sets),
        0.7,
        pytest.param(1e5, marks=pytest.mark.sets),
        pytest.param(1e22, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("psf", ["moffat", "effective"])
def test_single_precision_is_the_same_in_any_unit(size, psf, field):
    """Factors that are no power of two round the pixels, by 6e-8."""
    right, found = field(psf, 1.0), field(psf, size)
    assert len(found) == len(right) > 75
    assert_allclose(found["flags"], right["flags"])
    off = np.hypot(found["x"] - right["x"], found["y"] - right["y"])
    assert off.value.max() < 1e-6
    for name in ("x_err", "y_err"):
        assert_allclose(found[name].value, right[name].value, rtol=2e-6)
    assert_allclose(found["flux"], right["flux"] * size, rtol=5e-6)


@pytest.fixture(scope="module")
def field():
    """A frame of 81 stars, faint and bright, measured with a PSF, in a unit."""
    rng = np.random.default_rng(4)
    light = image((240, 240), scattered(rng, 81, 240), np.geomspace(500, 1e5, 81), 2.5)
    data = (rng.poisson(light * GAIN) + rng.normal(0, READ_NOISE, light.shape)) / GAIN

    @cache
    def measured(psf, size):
        values = (data.astype(np.float32).astype(float) * size).astype(np.float32)
        return measure(Exposure("e", values, gain=GAIN / size, read_noise=READ_NOISE), psf=psf)

    return measured


@pytest.mark.parametrize(
    "power", [-70, pytest.param(-3, marks=pytest.mark.slow), pytest.param(60, marks=pytest.mark.slow)]
)
def test_powers_of_two_are_exact_in_single_precision(power):
    one = exposure()
    one = replace(one, data=one.data.astype(np.float32))
    right, found = measured(one), measured(replace(one, data=one.data * 2.0**power, gain=GAIN / 2.0**power))
    for name in ("x", "y", "x_err", "y_err"):
        assert_allclose(found[name], right[name], rtol=0)


@pytest.mark.slow
def test_errors_put_in_are_the_same_in_any_unit():
    """Noise curves, their fluxes in the unit, and photon noise too."""
    measuring = {"psf": "moffat"}
    right, found = (calibrate_noise(exposure(size=size), n_positions=10, measuring=measuring) for size in (1, 1e-21))
    assert_allclose(found.table["flux"], right.table["flux"] * 1e-21, rtol=1e-9)
    assert_allclose(found.table["x_rms"].value, right.table["x_rms"].value, rtol=1e-9)
    assert found.table.meta["photon"]["e"] == pytest.approx(1e-21 / GAIN)
    fluxes = right.table["flux"][[5, 8]]
    asked = calibrate_noise(exposure(size=1e-21), fluxes=fluxes * 1e-21, n_positions=10, measuring={"psf": "moffat"})
    assert (asked.table["found"] > 0.8).all()


def test_the_unit_is_that_of_the_noise():
    one = exposure(saturation=4e4)
    assert noise_unit(one) == pytest.approx(1 / 7.5, rel=0.3)
    assert noise_unit(replace(one, data=one.data * 1e-21)) == pytest.approx(1e21 * noise_unit(one))
    assert noise_unit(Exposure("e", np.full(SHAPE, 7.0))) == 1.0
    scaled = in_working_unit(one, 100.0)
    assert (scaled.gain, scaled.saturation) == (GAIN / 100, 4e6)


def test_mosaics_of_usual_data_keep_their_unit():
    one = exposure()
    assert working_unit(one.data) == 1.0
    assert in_working_unit(one, 1.0) is one


def test_what_a_frame_is_filled_with_overflows_unseen():
    """1e30 beside values of 1e-21 has no place in single precision, in the unit of the noise."""
    one = exposure(size=1e-21)
    data = one.data.astype(np.float32)
    data[:, :30] = 1e30
    assert len(measured(replace(one, data=data))) > 10


def test_frames_without_stars_have_no_defects_in_common():
    empty = [Exposure(f"e{k}", np.random.default_rng(k).normal(0, 1, SHAPE), gain=1.0) for k in range(3)]
    assert len(measured(empty)) == 0
