"""Mosaics of sums, means and rates, of light of an area, and of values of any size."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from numpy.testing import assert_allclose
from stacks import SHAPE, expose, scene
from test_flux_scales import blank, measured, observed

from legdistort.coaddition.flux_scales import flux_scales
from legdistort.coaddition.mosaic_header import exposure_start, mosaic_header
from legdistort.coaddition.mosaicking import coadd


def headers(*cards):
    return [fits.Header(each) for each in cards]


@pytest.mark.parametrize(
    ("times", "cards", "factors", "exptime", "total"),
    [
        ([10.0, 100.0], [{"COADDS": 1}, {"COADDS": 10}], [5.5, 0.55], 55.0, 110.0),
        ([10.0, 100.0], [{"NDIT": 1}, {"NDIT": 10}], [1.0, 1.0], 10.0, 110.0),
        ([10.0, 100.0], [{"BUNIT": "DN s-1"}, {"BUNIT": "DN/s"}], [1.0, 1.0], 55.0, 110.0),
        ([10.0, 100.0], [{"BUNIT": "MJy/sr"}] * 2, [1.0, 1.0], 55.0, 110.0),
    ],
    ids=["sums", "means", "rates", "calibrated"],
)
def test_one_scale(times, cards, factors, exptime, total):
    frames = blank(2, exposure_time=times, header=headers(*cards))
    found, origin = flux_scales(frames, "exptime", None)
    assert origin == "exptime"
    assert_allclose(list(found.values()), factors)
    header = mosaic_header(frames, {}, found, [])
    assert (header["EXPTIME"], header["TEXPTIME"]) == (pytest.approx(exptime), total)
    assert header.get("BUNIT") == cards[0].get("BUNIT")


def test_start_of_an_exposure_as_headers_have_it():
    for cards in ({"DATE-OBS": "09/12/95", "TIME-OBS": "12:00:00"}, {"MJD-OBS": "50060.5"}):
        assert exposure_start(fits.Header(cards)).isot == "1995-12-09T12:00:00.000"


def test_light_of_an_area_is_conserved_with_the_area():
    """Pixels of twice the size: a star has a quarter of the sum, where values are of an area."""
    solution, stars, flux = scene(2, rolls=(0, 3))
    of_pixels, of_area = (
        coadd(expose(solution, stars, flux, header=fits.Header({"BUNIT": unit})), solution) for unit in ("Jy", "MJy/sr")
    )
    plain = coadd(expose(solution, stars, flux), solution, conserve="surface_brightness")
    np.testing.assert_array_equal(of_area.data, plain.data)
    assert (of_area.header["CONSERVE"], of_area.header["BUNIT"]) == ("surface_brightness", "MJy/sr")
    assert of_pixels.header["CONSERVE"] == "flux"
    assert of_area.to_ccddata().unit == u.MJy / u.sr


@pytest.mark.parametrize("power", [-21, 16])
def test_values_that_single_precision_would_not_hold(power):
    """They come in a unit that is a power of ten, which BUNIT states."""
    size = 10.0**power
    solution, stars, flux = scene(2, rolls=(0, 3))
    table = observed([1.0, 1.0], outliers=0)
    frames, rng = expose(solution, stars, flux, header=fits.Header({"BUNIT": "W/m2"})), np.random.default_rng(0)
    frames = [replace(frame, data=frame.data + rng.normal(0, 3, SHAPE)) for frame in frames]
    right = coadd(frames, measured(solution, table), scale=None)
    table["flux"] = np.asarray(table["flux"]) * size
    found = coadd([replace(f, data=f.data * size) for f in frames], measured(solution, table), scale=None)
    values = (found.data * found.to_ccddata().unit).to_value("W / m2")
    seen = np.isfinite(right.data)
    assert seen.sum() > 0.5 * np.prod(SHAPE)
    assert_allclose(values[seen], right.data[seen] * size, rtol=1e-3, atol=1e-3 * size)
    unit = found.to_ccddata().unit.to("W / m2") / size
    assert_allclose(found.variance[seen] * unit**2, right.variance[seen], rtol=1e-3)
