"""Pixels that hold no measurement, and frames in which chance makes many pixels alike."""

import numpy as np
import pytest
from astropy.io import fits
from caller_warnings import warns_here
from scipy.ndimage import gaussian_filter

from legdistort.exceptions import AssumptionWarning
from legdistort.inputs.exposure_files import open_exposures, read_exposures
from legdistort.inputs.exposures import Exposure

SIZE = 400
Y, X = np.mgrid[:SIZE, :SIZE]


def sky(seed=1, level=200.0, noise=10.0):
    return np.random.default_rng(seed).normal(level, noise, (SIZE, SIZE)).astype(np.float32)


def rotated(angle):
    """Where a square rotated by so many degrees, with a gap of 12 pixels, sees nothing."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    u, v = (X - SIZE / 2) * c + (Y - SIZE / 2) * s, (Y - SIZE / 2) * c - (X - SIZE / 2) * s
    return (np.abs(u) > 0.45 * SIZE) | (np.abs(v) > 0.45 * SIZE) | (np.abs(u - 30) < 6)


AREAS = {
    "border": X < 40, "one column": X < 1, "corner": (X < 20) & (Y > 370), "gap": (Y > 190) & (Y < 194),
    "rotated by 1": rotated(1), "rotated by 30": rotated(30), "rotated by 45": rotated(45),
}  # fmt: skip


@pytest.mark.parametrize("value", [0.0, -32768.0, 200.0])
@pytest.mark.parametrize("name", AREAS)
def test_filled_areas_at_the_border_are_bad(name, value):
    data = np.where(AREAS[name], np.float32(value), sky())
    np.testing.assert_array_equal(Exposure("e", data).mask, AREAS[name])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("value", [1e30, -1.7e38])
def test_huge_numbers_are_bad_wherever_they_are(value, dtype):
    data = sky().astype(dtype)
    data[100:110, 200:230] = value
    data[300, 17] = value
    np.testing.assert_array_equal(Exposure("e", data).mask, np.abs(data) > 1e29)


def test_large_values_alone_are_data():
    assert not Exposure("e", sky().astype(float) * 1e30).mask.any()


@pytest.mark.parametrize("noise", [0.3, 0.5, 1.0])
def test_a_quiet_sky_of_whole_numbers_is_no_filled_area(noise):
    data = np.round(sky(noise=noise))
    assert not Exposure("e", data).mask.any()
    filled = AREAS["border"]
    if noise > 0.4:  # of less nobody could tell it: 90 % of all pixels have this value
        np.testing.assert_array_equal(Exposure("e", np.where(filled, np.float32(200), data)).mask, filled)


@pytest.mark.parametrize("level", [0.0, -10.0])
@pytest.mark.parametrize("smooth", [0.0, 1.0, 3.0])
def test_a_sky_cut_off_at_0_is_no_filled_area(level, smooth):
    """Half of the pixels or more are 0; in resampled frames neighbours are more often so together."""
    data = sky(level=0.0)
    data = gaussian_filter(data, smooth) / gaussian_filter(np.eye(1, 81, 40), (0, smooth)).max() if smooth else data
    assert not Exposure("e", np.clip(data + level * (smooth == 0), 0, None)).mask.any()


@pytest.mark.parametrize("rate", [0.002, 0.05, 0.5])
def test_counts_of_single_photons_are_no_filled_area(rate):
    data = np.random.default_rng(2).poisson(rate, (SIZE, SIZE)).astype(np.float32)
    assert not Exposure("e", data).mask.any()


def test_stars_without_noise_are_no_filled_area():
    """Neither one nor many whose wings reach 0 somewhere."""
    light = 1e4 * np.exp(-((X - 300) ** 2 + (Y - 100) ** 2) / 8)
    assert not Exposure("e", np.where(light < 1, 0.0, light)).mask.any()
    wings = sum(
        1e4 * np.maximum(1 - np.hypot(X - x, Y - y) / 60, 0) ** 4 for x in (80, 200, 320) for y in (90, 210, 330)
    )
    assert not Exposure("e", wings).mask.any()


def test_saturated_stars_at_the_border_are_light():
    """Two amplifiers that saturate at different levels, and a trail of charge."""
    stars = sum(1e6 * np.exp(-((X - x) ** 2 + (Y - 200) ** 2) / 32) for x in (3, SIZE - 4))
    data = np.minimum(sky() + stars, np.where(X < SIZE / 2, 6e4, 5e4)).astype(np.float32)
    data[:, 3:5] = 6e4
    assert not Exposure("e", data).mask.any()


def test_what_is_left_out_is_said_once(tmp_path):
    """Of all frames together; measuring and co-adding read the same pixels."""
    for k in range(3):
        fits.writeto(tmp_path / f"e{k}.fits", np.where(k + 40 > X, np.float32(0), sky(k)))
    files = sorted(tmp_path.glob("*.fits"))
    with warns_here(
        AssumptionWarning, match=r"e0, e1, e2: 16000 pixels hold no measurement .*the value 0 at the border"
    ):
        opened = open_exposures(files)
    for k, one in enumerate(opened):
        np.testing.assert_array_equal(one.read().mask, k + 40 > X)
        assert len(one.read().stated.doubts) == 1
    with pytest.warns(AssumptionWarning, match="16000 pixels"):
        assert read_exposures(files)[0].mask.sum() == 40 * SIZE


@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_blank_pixels_are_bad_in_real_numbers_too(tmp_path, dtype):
    """The standard has BLANK for integers; files made of those keep the card, and the number."""
    data = np.round(sky()).astype(dtype)
    data[50:60, 70:90] = -99
    hdu = fits.PrimaryHDU(data)
    hdu.header["BLANK"] = -99
    hdu.writeto(tmp_path / "e.fits", output_verify="ignore")
    (one,) = read_exposures(tmp_path / "e.fits")
    np.testing.assert_array_equal(one.mask, data == -99)


def test_a_filled_area_beside_a_sky_cut_off_at_0_is_bad():
    data = np.where(X < 150, np.float32(0), np.clip(sky(level=0.0), 0, None))
    mask = Exposure("e", data).mask
    assert mask[:, :150].all()  # and zeros that go on from it by chance
    assert mask[:, 150:].mean() < 0.01
