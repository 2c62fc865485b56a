"""The way from the reference plane to the sky: the fast model against the stock one, and both against more digits."""

import io

import asdf
import numpy as np
import pytest
from astropy.modeling import models
from numpy.testing import assert_allclose, assert_array_equal

from legdistort.geometry.tangent_plane import PlaneToSky, TangentPlane

SCALE = 0.02 / 3600  # degrees a pixel
MATRIX = SCALE * np.array([[-0.8, 0.6, 30.0], [0.6, 0.8, -500.0]])
PLACES = [(84.9, -69.8), (0.0, 0.0), (359.9999, 12.0), (10.0, 90.0), (200.0, -90.0), (120.0, 89.9999)]


def exact(sky, x, y):
    """Right ascension and declination with the digits of an extended type; skipped where there is none."""
    if np.finfo(np.longdouble).eps > 1e-18:
        pytest.skip("no extended precision on this machine")
    degree = np.longdouble(np.pi) / 180  # the rounding of pi moves all directions alike, by 2e-17 of the angle
    matrix = sky.matrix.astype(np.longdouble) * degree
    xi, eta = (row[0] * x + row[1] * y + row[2] for row in matrix)
    lat0 = sky.lat * degree
    ahead = np.cos(lat0) - eta * np.sin(lat0)
    lon = np.arctan2(xi, ahead) / degree + np.longdouble(sky.lon)
    lat = np.arctan2(np.sin(lat0) + eta * np.cos(lat0), np.hypot(xi, ahead)) / degree
    return lon % 360, lat


def apart(a, b):
    """Largest distance of places on the sky, in pixels."""
    dlon = (np.asarray(a[0], dtype=np.longdouble) - b[0] + 180) % 360 - 180
    dlat = np.asarray(a[1], dtype=np.longdouble) - b[1]
    return float(np.max(np.hypot(dlon * np.cos(np.radians(np.asarray(b[1], dtype=float))), dlat)) / SCALE)


@pytest.mark.parametrize(("lon", "lat"), PLACES)
def test_the_fast_model_is_the_stock_one(lon, lat):
    """As far as the stock one goes, whose sine of the declination loses digits towards the poles; it loses none."""
    sky = TangentPlane(lon, lat, MATRIX)
    x, y = np.random.default_rng(1).uniform(-3000, 3000, (2, 20_000))
    fast, stock, true = PlaneToSky.of(sky)(x, y), sky.model()(x, y), exact(sky, x, y)
    assert apart(fast, true) < 6e-9  # half of the last digit of 360 degrees is 5e-9 px
    assert apart(fast, stock) < (1e-7 if abs(lat) < 89 else 2e-3)
    assert np.all((fast[0] >= 0) & (fast[0] <= 360))
    assert_allclose(np.array(PlaneToSky.of(sky).inverse(*fast)), [x, y], rtol=0, atol=1e-7 if abs(lat) < 89 else 2e-3)


def test_shapes_are_kept():
    model = PlaneToSky.of(TangentPlane(*PLACES[0], MATRIX))
    x, y = np.indices((30, 400)) * 3.0
    ra, dec = model(x, y)
    assert ra.shape == dec.shape == x.shape
    assert_array_equal(model(x[3, 7], y[3, 7]), (ra[3, 7], dec[3, 7]))
    assert np.isnan(model(np.nan, 1.0)).all()


def test_files_hold_stock_models():
    sky = TangentPlane(*PLACES[0], MATRIX)
    content = io.BytesIO()
    asdf.AsdfFile({"model": PlaneToSky.of(sky)}).write_to(content)
    assert b"legdistort" not in content.getvalue()
    content.seek(0)
    with asdf.open(content) as file:
        back = file["model"]
    assert isinstance(back[-1], models.RotateNative2Celestial)
    assert_array_equal(back(10.0, 20.0), sky.model()(10.0, 20.0))
    assert_allclose(PlaneToSky.like(back).parameters, PlaneToSky.of(sky).parameters, rtol=1e-15)
    other = models.Pix2Sky_TAN() | models.RotateNative2Celestial(10, 20, 180)
    for wrong in (other, models.Identity(2), models.AffineTransformation2D() | other.left | models.Rotation2D(3)):
        with pytest.raises(ValueError, match="the way to the sky should be an affine map"):
            PlaneToSky.like(wrong)


def test_a_model_given_away_is_not_that_of_the_plane():
    """Whoever changes it changes no positions."""
    sky, xy = TangentPlane(*PLACES[0], MATRIX), np.array([[10.0, 20.0]])
    before = sky.to_sky(xy)
    model = sky.model()
    model.lon_2, model.inverse.lon_0 = 1.0, 1.0
    assert sky.to_sky(xy) == before
    assert_allclose(sky.from_sky(before), xy, rtol=0, atol=1e-7)
