"""Saturated cores behind adaptive optics: flagged, and fitted from what is left of them with true errors."""

import numpy as np
import pytest
from ao_images import apart, identify
from star_images import errors, observe, positions

from legdistort.inputs.exposures import Exposure
from legdistort.measurement.flags import UNUSABLE, Flag
from legdistort.measurement.positions import measure
from legdistort.simulation.pupil import PupilPSF
from legdistort.simulation.rendering import as_psf, render

LEVEL, SIZE, N = 20000.0, 800, 110


@pytest.fixture(scope="module")
def field():
    """The image with tops cut off, true positions, fluxes, and how many pixels of every core are cut."""
    rng = np.random.default_rng(16)
    psf = as_psf(PupilPSF(strehl=0.3, jitter=0.4), (SIZE, SIZE))
    xy, flux = apart(rng, N, SIZE, 40, 20), 10 ** rng.uniform(4, 6.6, N)
    image = np.minimum(observe(render((SIZE, SIZE), xy, flux, psf=psf, sky=200.0), rng), np.float32(LEVEL))
    cut = [(image[y - 2 : y + 3, x - 2 : x + 3] >= LEVEL).sum() for x, y in np.round(xy).astype(int)]
    return image, xy, flux, np.array(cut)


@pytest.mark.parametrize("known", [pytest.param(True, marks=pytest.mark.slow), False])
def test_saturated_cores(field, known):
    """With the level of saturation, and without: then the flat tops tell it."""
    image, xy, flux, cut = field
    exposure = Exposure("cut", image, gain=2.0, saturation=LEVEL if known else None)
    table = measure(exposure, psf="effective")
    rows = identify(positions(table), xy, 2.5)
    assert (rows >= 0).all()
    table = table[rows]
    off = positions(table) - xy
    pulls = (off - np.median(off[cut == 0], axis=0)) / errors(table)
    assert np.count_nonzero(cut) > 25
    assert np.std(pulls[cut > 0]) == pytest.approx(1, abs=0.25)  # of 60 numbers: 9 %
    assert np.std(pulls[(cut == 0) & (flux > 3e4)]) == pytest.approx(1, abs=0.25)
    saturated = (table["flags"] & Flag.SATURATED) != 0
    np.testing.assert_array_equal(saturated, cut > 0)
    assert not saturated[(table["flags"] & UNUSABLE) == 0].any()
