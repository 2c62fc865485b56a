"""A gain that the noise contradicts, and data of any size."""

import numpy as np
import pytest
from astropy.io import fits
from caller_warnings import warns_here
from numpy.testing import assert_allclose
from star_images import image

from legdistort.exceptions import AssumptionWarning
from legdistort.inputs.exposures import Exposure
from legdistort.inputs.frames.working_units import in_working_unit, working_unit
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


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0, 5.0])
def test_a_gain_that_may_be_is_not_doubted(factor):
    measured(exposure(factor * GAIN))
    measured(exposure(factor * GAIN, sky=100.0))


def test_a_known_noise_needs_no_gain():
    one = exposure()
    measured(Exposure("e", one.data, gain=300.0, uncertainty=np.full(SHAPE, 8.0)))


@pytest.mark.parametrize("size", [1e-30, 1e-21, 1e16, 1e22])
def test_positions_do_not_depend_on_the_size_of_the_unit(size):
    right, found = measured(exposure()), measured(exposure(size=size))
    assert len(found) == len(right) > 20
    assert_allclose(found["flux"], right["flux"] * size, rtol=1e-4)
    assert_allclose(found["flux_err"], right["flux_err"] * size, rtol=1e-4)
    for name in ("x", "y"):
        assert_allclose(found[name].value, right[name].value, atol=1e-4)
        assert_allclose(found[f"{name}_err"].value, right[f"{name}_err"].value, rtol=1e-3)
    assert_allclose(found["flags"], right["flags"])


def test_usual_data_are_left_alone():
    one = exposure(saturation=4e4, header=fits.Header())
    assert working_unit(one.data) == 1.0
    assert in_working_unit(one, 1.0) is one
    scaled = in_working_unit(one, 100.0)
    assert (scaled.gain, scaled.saturation) == (GAIN / 100, 4e6)
