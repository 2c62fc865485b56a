"""The compiled splines against those that reproject calls."""

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval
from numpy.testing import assert_allclose, assert_array_equal
from stacks import SHAPE, expose, scene

from legdistort.coaddition.mosaicking import coadd
from legdistort.coaddition.resampling import compiled_splines, engines
from legdistort.coaddition.resampling.pixel_maps import PixelMap
from legdistort.inputs.exposures import Exposure

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("dtype", [pytest.param(np.float32, marks=pytest.mark.slow), np.float64])
@pytest.mark.parametrize("shape", [(2, 3), (9, 7), (80, 120)])
def test_values_are_those_of_reproject(order, dtype, shape):
    image = RNG.normal(1000, 300, shape).astype(dtype)
    ny, nx = shape
    xy = RNG.uniform(-1, 1, (2, 90, 70)) + RNG.integers(-1, [[[nx + 1]], [[ny + 1]]], (2, 90, 70))
    xy[:, 0, :4] = [[0, nx - 1, nx - 0.5, -0.5], [0, ny - 1, ny - 0.5, -0.5]]
    xy[0, 5, 5] = np.nan
    pixel_map = PixelMap((slice(90), slice(70)), xy, np.ones((90, 70), dtype=bool), np.ones((90, 70)))
    expected = engines.resample([image], pixel_map, engines.Resampling(order=order))
    found = engines.resample([image], pixel_map, engines.Resampling(order=order, compiled=True))
    assert np.isnan(expected).any()
    assert_allclose(found, expected, rtol=1e-12 if dtype is np.float64 else 1e-7)  # NaN where reproject has it


def test_gain_is_a_product_of_polynomials():
    series, xy = np.array([1.0, -2.5, 0.7, 0.3]), RNG.uniform(-3, 40, (2, 20, 30))
    fraction = xy - np.floor(xy)
    gain = polyval(fraction * (1 - fraction), series)
    assert_allclose(compiled_splines.product(series, xy), gain[0] * gain[1], rtol=1e-6)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"order": 1}, marks=pytest.mark.slow),
        {"order": 3},
        pytest.param({"order": 3, "weights": "variance"}, marks=pytest.mark.slow),
        pytest.param({"order": 2}, marks=pytest.mark.slow),
    ],
)
def test_the_mosaic_is_the_same(monkeypatch, settings):
    solution, stars, flux = scene(3)
    exposures = [
        Exposure(
            e.name,
            e.data,
            mask=RNG.random(SHAPE) < 0.002,
            uncertainty=1 + RNG.random(SHAPE),
            saturation=0.7 * e.data.max(),
        )
        for e in expose(solution, stars, flux)
    ]
    plain = coadd(exposures, solution, **settings)
    calls = []
    monkeypatch.setattr(engines, "COMPILED_FROM", 0)
    interpolate = compiled_splines.interpolate
    monkeypatch.setattr(compiled_splines, "interpolate", lambda *args: calls.append(interpolate(*args)))
    fast = coadd(exposures, solution, **settings)
    assert bool(calls) == (settings["order"] != 2)  # which reproject does at any size
    for name in ("footprint", "flags", "context"):
        assert_array_equal(getattr(fast, name), getattr(plain, name), err_msg=name)
    # fractions of a pixel, for variances, are found in single precision without compiled loops
    for name, close in (("data", 1e-5), ("variance", 1e-4), ("weight", 1e-4)):
        scale = np.nanmax(np.abs(getattr(plain, name)))
        assert_allclose(getattr(fast, name), getattr(plain, name), rtol=close, atol=1e-6 * scale, err_msg=name)
