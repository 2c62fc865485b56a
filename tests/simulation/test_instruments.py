"""Errors from magnitudes: against Fisher matrices in numpy alone, published limits, files as simulators write them."""

import json
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table
from numpy.testing import assert_allclose
from scipy.special import erf

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.exceptions import InputError
from legdistort.simulation.instruments.presets import preset_names
from legdistort.simulation.instruments.star_counts import draw_magnitudes
from legdistort.simulation.pupil import PupilPSF

SKY_ELECTRONS = 30.0 * (10 ** (-0.4 * (14.0 - 26.0)) * 0.02**2 + 0.05)
CAMERA = ld.Camera("one", {"1": ld.Detector((512, 512))})


# --- truth, without the package ----------------------------------------------------------------------------------


def gaussian(dx, dy, width):
    """Light in pixels at offsets from a Gaussian star."""
    x, y = ((erf((d + 0.5) / (2**0.5 * width)) - erf((d - 0.5) / (2**0.5 * width))) / 2 for d in (dx, dy))
    return x * y


def bound(light, flux, sky, read_noise, half):
    """Errors of x and y, and the ratio of signal to noise, from information averaged over places on a pixel.

    The Fisher matrix of x, y, flux and sky, by differences of what `light` gives.
    """
    v, w = np.mgrid[-half : half + 1, -half : half + 1]
    total, of_flux = np.zeros((4, 4)), 0.0
    for x in (-0.375, -0.125, 0.125, 0.375):
        for y in (-0.375, -0.125, 0.125, 0.375):
            at = light(w - x, v - y)
            variance = sky + flux * at + read_noise**2
            step = 1e-4
            by_x = flux * (light(w - x - step, v - y) - light(w - x + step, v - y)) / (2 * step)
            by_y = flux * (light(w - x, v - y - step) - light(w - x, v - y + step)) / (2 * step)
            slopes = np.array([by_x, by_y, at, np.ones(at.shape)]).reshape(4, -1) / np.sqrt(variance).ravel()
            total += slopes @ slopes.T / 16
            of_flux += np.sum(at**2 / variance) / 16
    return np.sqrt(np.diag(np.linalg.inv(total))[:2]), flux * np.sqrt(of_flux)


def instrument(psf, **changes):
    words = {"camera": CAMERA, "pixel_scale": 0.02, "exposure_time": 30.0, "zero_point": 26.0, "read_noise": 10.0}
    return ld.Instrument(**words | {"sky_brightness": 14.0, "dark_current": 0.05, "psf": psf} | changes)


def gaussian_psf(width, steps=5, half=20):
    d = np.arange(-half * steps, half * steps + 1) / steps
    return ld.EffectivePSF.from_array(gaussian(d, d[:, None], width), oversampling=steps)


@pytest.mark.parametrize("width", [0.4, 1.5])
@pytest.mark.parametrize("n_coadds", [1, 4])
def test_errors_are_those_of_a_fisher_matrix(width, n_coadds):
    made = instrument(gaussian_psf(width), n_coadds=n_coadds)
    time = 30.0 * n_coadds
    sky = time * (10 ** (-0.4 * (14.0 - 26.0)) * 0.02**2 + 0.05)
    for mag in (10.0, 16.0, 19.0, 22.0):
        flux = time * 10 ** (-0.4 * (mag - 26.0))
        errors, snr = bound(lambda x, y: gaussian(x, y, width), flux, sky, 10 * n_coadds**0.5, int(np.ceil(12 * width)))
        assert_allclose(made.position_error([mag]), np.mean(errors), rtol=0.01)
        assert_allclose(made.snr([mag]), snr, rtol=0.01)


def test_published_limits():
    """FWHM / (2.35 S/N) by the photons of the star, sqrt(2) times as much by the sky (King 1983, PASP 95, 163)."""
    width = 2.0
    fwhm = np.hypot(width, 12**-0.5) * 2.355  # with the pixel
    made = instrument(gaussian_psf(width), read_noise=1.0, dark_current=0.0, sky_brightness=np.inf)
    mag = np.array([12.0, 14.0])
    assert_allclose(made.position_error(mag) * made.snr(mag), fwhm / 2.355, rtol=0.02)
    faint = instrument(gaussian_psf(width), sky_brightness=10.0)
    assert_allclose(faint.position_error([24.0]) * faint.snr([24.0]), 2**0.5 * fwhm / 2.355, rtol=0.02)
    assert made.fwhm == pytest.approx(fwhm, rel=0.02)


def test_stars_too_bright_and_too_faint():
    width = 1.5
    made = instrument(gaussian_psf(width), full_well=5e4, min_snr=7.0)
    bright, faint = made.limits
    peak = 30.0 * 10 ** (-0.4 * (bright - 26.0)) * gaussian(0.0, 0.0, width) + SKY_ELECTRONS
    assert peak == pytest.approx(5e4, rel=1e-3)
    flux = 30.0 * 10 ** (-0.4 * (faint - 26.0))
    assert bound(lambda x, y: gaussian(x, y, width), flux, SKY_ELECTRONS, 10.0, 18)[1] == pytest.approx(7.0, rel=0.01)
    stars = [bright - 0.01, bright + 0.01, faint - 0.01, faint + 0.01]
    assert made.measures(stars).tolist() == [False, True, True, False]
    # integrations that are added up are filled one by one
    assert instrument(gaussian_psf(width), full_well=5e4, n_coadds=9).limits[0] == pytest.approx(bright, abs=1e-6)
    assert instrument(gaussian_psf(width), error_floor=0.03).position_error([8.0]) == pytest.approx(0.03, rel=1e-3)


# --- files as simulators write them ------------------------------------------------------------------------------


def airy(per_pixel, resolution, n_pixels, coma=0.0):
    """Intensities of a round pupil on so many samples a pixel, for wavelength / diameter in pixels; they sum to 1."""
    n, over = n_pixels * per_pixel, resolution * per_pixel  # samples, and those in wavelength / diameter
    radius = n / over / 2
    y, x = (np.mgrid[:n, :n] - n // 2) / radius
    r = np.hypot(x, y)
    pupil = (r <= 1) * np.exp(1j * coma * 8**0.5 * (3 * r**3 - 2 * r) * np.sin(np.arctan2(y, x)))
    light = np.abs(np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(pupil)))) ** 2
    return light / light.sum()


@cache
def truth_of_airy(resolution, flux, sky, read_noise, half, coma=0.0):
    """The bound for such a star, its light summed over pixels of 16 x 16 samples."""
    per_pixel = 16
    fine = airy(per_pixel, resolution, 64, coma)
    summed = np.cumsum(np.cumsum(np.pad(fine, ((1, 0), (1, 0))), axis=0), axis=1)

    def light(dx, dy):
        """Pixels from -8 to 8 samples of the place: offsets are whole samples here, but for the small steps."""
        out = np.zeros(dx.shape)
        column, row = -dx[0, :] * per_pixel, -dy[:, 0] * per_pixel
        middle = len(fine) // 2

        def at(a, b):
            ia, ib = np.floor(a).astype(int), np.floor(b).astype(int)
            fa, fb = (a - ia)[:, None], (b - ib)[None, :]
            s = lambda i, j: summed[np.ix_(i, j)]  # noqa: E731
            return (
                (1 - fa) * (1 - fb) * s(ia, ib)
                + fa * (1 - fb) * s(ia + 1, ib)
                + (1 - fa) * fb * s(ia, ib + 1)
                + fa * fb * s(ia + 1, ib + 1)
            )

        low_y, low_x = (middle - each - per_pixel / 2 + 0.5 for each in (row, column))
        out += at(low_y + per_pixel, low_x + per_pixel) + at(low_y, low_x)
        return out - at(low_y + per_pixel, low_x) - at(low_y, low_x + per_pixel)

    return bound(light, flux, sky, read_noise, half)


def as_tiptop(path, images, places, mas):
    cube = fits.ImageHDU(images)
    cube.header["CONTENT"], cube.header["WL_NM"], cube.header["PIX_MAS"] = "PSF CUBE", "2145", str(mas)
    for k, (x, y) in enumerate(places):
        cube.header[f"CCX{k:04d}"], cube.header[f"CCY{k:04d}"] = x, y
    alone = [fits.ImageHDU(images[0]), fits.ImageHDU(images[0])]  # without correction, and without turbulence
    fits.HDUList([fits.PrimaryHDU(), cube, *alone]).writeto(path)
    return path


def test_tiptop_averages_what_is_undersampled(tmp_path):
    """Into samples of 20 mas here, as large as pixels, of 1.6 in wavelength / diameter."""
    fine = airy(2, 1.6, 128)
    image = fine.reshape(128, 2, 128, 2).sum(axis=(1, 3))
    path = as_tiptop(tmp_path / "psf.fits", image[None], [(0, 0)], 20.0)
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["HIERARCH telescope TelescopeDiameter"] = np.degrees(2.145e-6 / 0.032) * 3600
    errors, _ = truth_of_airy(1.6, 30.0 * 10 ** (-0.4 * (20.0 - 26.0)), SKY_ELECTRONS, 10.0, 8)
    assert_allclose(instrument(path).position_error([20.0]), np.mean(errors), rtol=0.03)


def as_mavisim(path, images, places):
    hdus = [fits.ImageHDU(image) for image in images]
    for hdu, (x, y) in zip(hdus, places, strict=True):
        hdu.header["XPOS"], hdu.header["YPOS"], hdu.header["LAMBDA"] = x, y, 5.5e-7
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    return path


def as_stpsf(path, image, arcsec, steps):
    hdus = [fits.PrimaryHDU(image), fits.ImageHDU(image[::steps, ::steps])]
    for hdu, name, scale in zip(hdus, ("OVERSAMP", "DET_SAMP"), (arcsec, arcsec * steps), strict=True):
        hdu.header["EXTNAME"], hdu.header["PIXELSCL"] = name, scale
        hdu.header["OVERSAMP"] = hdu.header["DET_SAMP"] = steps
    fits.HDUList(hdus).writeto(path)
    return path


RESOLUTION, STEPS = 2.6, 4


@pytest.fixture(scope="module")
def star():
    return airy(STEPS, RESOLUTION, 64)


@pytest.mark.parametrize("kind", ["tiptop", "mavisim", "stpsf", "bare"])
def test_files_of_simulators(star, kind, tmp_path):
    path, more = tmp_path / "psf.fits", {}
    if kind == "tiptop":
        as_tiptop(path, star[None], [(0, 0)], 20 / STEPS)
    elif kind == "mavisim":
        as_mavisim(path, [7.0 * star], [(0, 0)])  # which it normalises itself
        more = {"psf_scale": 5 * u.mas}
    elif kind == "stpsf":
        as_stpsf(path, star, 0.02 / STEPS, STEPS)
    else:
        fits.writeto(path, star)
        more = {"psf_scale": 0.005}
    made = instrument(path, **more)
    half = int(np.ceil(4 * made.fwhm))
    for mag in (14.0, 21.0):
        errors, snr = truth_of_airy(RESOLUTION, 30.0 * 10 ** (-0.4 * (mag - 26.0)), SKY_ELECTRONS, 10.0, half)
        assert_allclose(made.position_error([mag]), np.mean(errors), rtol=0.02)
        assert_allclose(made.snr([mag]), snr, rtol=0.02)


def test_a_star_that_is_not_round(tmp_path):
    """Flux and sky are free in the truth; the error is that of the mean information on x and y."""
    fits.writeto(tmp_path / "psf.fits", airy(STEPS, RESOLUTION, 64, coma=0.7))
    made = instrument(tmp_path / "psf.fits", psf_scale=0.005)
    flux, half = 30.0 * 10 ** (-0.4 * (21.0 - 26.0)), int(np.ceil(4 * made.fwhm))
    errors, _ = truth_of_airy(RESOLUTION, flux, SKY_ELECTRONS, 10.0, half, coma=0.7)
    assert errors[1] > 1.1 * errors[0]
    assert_allclose(made.position_error([21.0]), np.mean(errors**-2.0) ** -0.5, rtol=0.01)


def test_measuring_takes_what_calc_psf_writes_as_light_on_samples(star, tmp_path):
    """Not as that of whole pixels, which is wider."""
    from legdistort.measurement.effective.sources import read_psf

    psf = read_psf(as_stpsf(tmp_path / "psf.fits", star, 0.005, STEPS))
    fine = airy(16, RESOLUTION, 64)
    corner = len(fine) // 2 - 8
    # the star stands on the sample after the middle of its even array; the pixel reaches from -7.5 to 7.5 samples
    pixel = fine[corner : corner + 17, corner : corner + 17] * np.outer(*[np.r_[0.5, np.ones(15), 0.5]] * 2)
    assert psf(0.5 / STEPS, 0.5 / STEPS, at=(0, 0)) == pytest.approx(pixel.sum(), rel=2e-3)


def test_the_nearest_psf_of_the_field(star, tmp_path):
    wide = airy(STEPS, 2 * RESOLUTION, 64)
    path = as_tiptop(tmp_path / "psf.fits", np.array([star, wide]), [(0, 0), (4, 0)], 5.0)
    made, middle = instrument(path), instrument(as_tiptop(tmp_path / "one.fits", star[None], [(0, 0)], 5.0))
    mag = np.full(3, 20.0)
    errors = made.position_error(mag, at=[(0.0, 0.0), (1.9, 5.0), (2.1, -5.0)])
    assert_allclose(errors[:2], middle.position_error(mag[:2]), rtol=1e-9)
    assert errors[2] > 1.7 * errors[0]
    assert_allclose(made.position_error(mag), errors[0], rtol=1e-9)
    # in a plan stars are where their exposure shows them: 0.02 arcsec a pixel, the middle at 255.5
    table = Table(
        {"x": [255.5, 405.0, 105.0, 200.0, 300.0], "y": [255.5, 250.0, 250.0, 300.0, 200.0], "mag": [20.0] * 5}
    )
    plan = ld.predict(n_exposures=4, instrument=made, stars=table, degree=0)
    found = np.array([each["error"].value for each in plan_errors(plan)])
    assert_allclose(found, 20 * np.where(table["x"] > 355.5, errors[2], errors[0]), rtol=1e-9)


def plan_errors(plan):
    from legdistort.simulation.magnitudes import star_errors

    return star_errors(plan)


# --- luminosity functions ----------------------------------------------------------------------------------------


def test_stars_follow_their_luminosity_function():
    mag = np.array([14.0, 16.0, 20.0])
    table = QTable({"mag": mag * u.mag, "density": np.array([10.0, 50.0, 400.0]) / u.mag / u.arcmin**2})
    drawn = draw_magnitudes(table, 3600 * 20.0, (15.0, 19.0), np.random.default_rng(1))
    # trapezia of the density, 30 at 15, 50 at 16, 312.5 at 19, of 20 square arcmin
    expected = 20 * np.array([(30 + 50) / 2, (50 + 312.5) / 2 * 3])
    assert len(drawn) == round(expected.sum())
    counts = np.histogram(drawn, [15, 16, 19])[0]
    assert_allclose(counts, expected, atol=4 * np.sqrt(expected.min()))
    bright = QTable({"mag": mag, "density": np.array([10.0, 50.0, 400.0]) / 3600 / u.arcsec**2})
    plain = Table({"mag": mag, "density": [10.0, 50.0, 400.0]})
    for same in (bright, plain):
        assert_allclose(draw_magnitudes(same, 3600 * 20.0, (15.0, 19.0), np.random.default_rng(1)), drawn, rtol=1e-12)


COUNTS = QTable({"mag": np.arange(14.0, 24.0), "density": 4e3 * 10 ** (0.25 * (np.arange(14.0, 24.0) - 18))})


def test_a_plan_from_a_luminosity_function():
    made = instrument(gaussian_psf(1.5), full_well=5e4, min_snr=20.0)
    plan = ld.predict(n_exposures=6, instrument=made, stars=COUNTS, dithers=0.6 * u.arcsec, degree=2, seed=3)
    bright, faint = made.limits
    stars, table = plan.settings.stars, plan.solution.residuals
    mag = np.asarray(stars["mag"])[np.asarray(table["star"]).astype(int)]
    assert bright <= mag.min() < bright + 1
    assert faint - 0.2 < mag.max() <= faint
    assert_allclose(table["x_err"].value, made.position_error(mag), rtol=1e-9)
    # the same with errors that are stated
    xy = np.column_stack([stars["x"], stars["y"]])
    sigma = made.position_error(np.asarray(stars["mag"]))
    stated = ld.predict(n_exposures=6, stars=xy, sigma=sigma, shape=(512, 512), dithers=30.0, degree=2, seed=3)
    assert plan.b == pytest.approx(stated.b, rel=1e-9)
    assert "[mas]" in str(plan)
    # their number is that of the density on the sky that the exposures cover
    (x0, y0), (x1, y1) = np.min(xy, axis=0), np.max(xy, axis=0)
    area = (x1 - x0) * (y1 - y0) * 0.02**2 / 3600
    fine = np.linspace(*made.limits, 2000)
    per_area = np.trapezoid(np.interp(fine, COUNTS["mag"], COUNTS["density"]), fine)
    assert len(stars) == pytest.approx(area * per_area, rel=0.05)
    rows = plan.by_magnitude(2.0)
    assert rows["n"].sum() == plan.n_stars
    assert np.all(rows["joint_error"] < rows["error"])
    assert np.all(np.diff(rows["error"].value) > 0)
    assert len(plan.alternatives()) == 5


def test_stars_that_are_listed_are_measured_or_not():
    made = instrument(gaussian_psf(1.5), full_well=5e4)
    bright, faint = made.limits
    place = np.random.default_rng(2).uniform(20, 490, (2, 30))
    table = Table([*place, np.linspace(bright + 0.1, faint - 0.1, 30)], names=("x", "y", "mag"))
    all_of_them = ld.predict(n_exposures=4, instrument=made, stars=table, degree=1)
    table["mag"][[3, 7]] = bright - 0.1, faint + 0.1
    some = ld.predict(n_exposures=4, instrument=made, stars=table, degree=1)
    assert (all_of_them.n_stars, some.n_stars) == (30, 28)
    assert not {3, 7} & set(np.asarray(some.solution.residuals["star"]).astype(int))


def test_pictures_of_errors(undrawn):
    made = instrument(gaussian_psf(1.5), full_well=5e4)
    plan = ld.predict(n_exposures=4, instrument=made, stars=COUNTS, degree=1)
    ax = plan.plot_errors()
    assert ax.get_ylabel() == "error of a position, per axis [mas]"
    assert ax.get_title(loc="left").startswith("instrument: 4 exposures,")
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["one exposure", "joint"]
    assert_allclose([line.get_xdata()[0] for line in ax.lines[-2:]], made.limits)
    ax = plan.plot()
    assert ax.get_title(loc="left").startswith("Error of the correction: 4 exposures,")
    assert_allclose(ax.collections[0].get_array().compressed(), 20 * plan.correction_map.ravel(), rtol=1e-12)
    assert [each.get_ylabel() for each in ax.figure.axes] == ["y [px]", "error per axis [mas]"]
    known = Table({"x": [10.0, 1900.0, 900.0, 600.0], "y": [20.0, 800.0, 1700.0, 30.0], "mag": [1.0, 2.0, 3.0, 4.0]})
    pixels = ld.predict(n_exposures=3, stars=known, sigma=0.02, degree=0).by_magnitude()
    assert_allclose(pixels["error"].to_value(u.pix), 0.02)
    with pytest.raises(InputError, match="the stars of this plan have no magnitudes"):
        ld.predict(n_exposures=3, n_stars=20, sigma=0.02, degree=1).by_magnitude()


# --- presets -----------------------------------------------------------------------------------------------------


def test_presets():
    psf = gaussian_psf(1.5)
    filters = {"GSAOI": "Ks", "MAVIS": None, "MICADO": "J", "NIRC2": "Kp", "NIRCam-LW": "F444W", "NIRCam-SW": "F200W"}
    assert sorted(filters) == preset_names()
    made = {
        name: ld.Instrument.named(
            name.lower(), filter=each, psf=psf, exposure_time=10, **({} if name[:2] == "MA" else SKY)
        )
        for name, each in filters.items()
    }
    assert {name: len(each.camera.detectors) for name, each in made.items()} == {
        "GSAOI": 4, "MAVIS": 1, "MICADO": 9, "NIRC2": 1, "NIRCam-LW": 2, "NIRCam-SW": 8,
    }  # fmt: skip
    # MICADO: gaps of 2.5 mm, but 6.5 mm between detectors 5 and 4, pixels of 0.015 mm
    places = made["MICADO"].camera.places
    gap = {key: places[key].x - places["5"].x - 4096 for key in "34"}
    assert_allclose([gap["3"], gap["4"]], [2.5 / 0.015, 6.5 / 0.015], atol=0.1)
    # what the published estimator makes of 28 mag in J without extinction: 7.72 e-/s
    assert 10 ** (-0.4 * (28.0 - 0.1 - made["MICADO"].zero_point)) == pytest.approx(7.72, rel=2e-3)
    # and of sky and dark current [electrons a pixel and second]
    for name, expected in (("J", 5.019), ("H", 28.407), ("Ks", 78.703)):
        one = ld.Instrument.named("MICADO", filter=name, psf=psf, exposure_time=1)
        sky = 10 ** (-0.4 * (one.sky_brightness - one.zero_point)) * one.pixel_scale**2 + one.dark_current
        assert sky == pytest.approx(expected, rel=3e-3)
    # 64" and a gap of 4"
    places = made["NIRCam-SW"].camera.places
    assert np.hypot(places["A1"].x - places["A2"].x, places["A1"].y - places["A2"].y) * 0.0311 == pytest.approx(
        67.7, abs=0.3
    )


SKY = {"sky_brightness": 14.0 * u.mag / u.arcsec**2}
FILE = """
name = "mine"
pixel_scale = 0.02
read_noise = 10.0
[filters]
B = { zero_point = 26.0, sky_brightness = 14.0 }
[detectors]
shape = [512, 512]
1 = { x = 0.0, y = 0.0 }
"""


def test_a_file_of_your_own(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(FILE)
    made = ld.Instrument.named(path, psf=gaussian_psf(1.5), exposure_time=0.5 * u.min, dark_current=0.05)
    same = instrument(gaussian_psf(1.5))
    assert_allclose(made.position_error([15.0, 20.0]), same.position_error([15.0, 20.0]), rtol=1e-12)
    assert repr(made) == "<Instrument mine B: 1 detectors, 20 mas/px, FWHM 71.8 mas, 30 s>"
    assert "stars to" in str(made)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (FILE.replace("read_noise", "noise"), "noise is nothing that is known of an instrument"),
        (FILE.replace("pixel_scale = 0.02", ""), r"pixel_scale \[arcsec\] is missing"),
        (FILE.replace("26.0", "'a'"), "zero_point must be a number, got 'a'"),
        (FILE.replace("x = 0.0, ", ""), r"detectors must have shape = \[ny, nx\]"),
        (FILE.replace("[detectors]", "[detectors"), "no TOML file that could be read"),
        (FILE.replace("1 = { x = 0.0, y = 0.0 }", ""), "there is no detector"),
        (FILE[: FILE.index("[detectors]")], "there must be a table detectors"),
        (FILE.replace("zero_point = 26.0, ", ""), "mine B: zero_point is not stated in its file: give zero_point"),
    ],
)
def test_files_of_another_form(text, words, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        ld.Instrument.named(path, psf=gaussian_psf(1.5), exposure_time=30)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"name": "HST"}, "'HST': there are GSAOI, MAVIS, MICADO, NIRC2, NIRCam-LW, NIRCam-SW, or a file NAME.toml"),
        ({"name": "a.toml"}, "a.toml: no such file of an instrument"),
        ({"filter": None}, "MICADO has several filters: give filter, one of J, H, Ks"),
        ({"filter": "B"}, "MICADO has no filter 'B': there are J, H, Ks"),
        ({"name": "NIRC2", "filter": "H"}, "NIRC2 H: sky_brightness is not stated in its file: give sky_brightness"),
        ({"seeing": 1}, "an instrument has no seeing"),
        ({"exposure_time": 0}, "exposure_time must be a positive number of seconds, got 0"),
        ({"read_noise": -1}, "read_noise must be a positive number of electrons, got -1"),
        ({"dark_current": -1}, "dark_current must be a number, zero or positive, got -1"),
        ({"full_well": 10.0}, "MICADO J: sky and dark current alone fill the full_well"),
        ({"psf": "moffat"}, "psf must be one PSF, a file of one, or a photutils model, got 'moffat'"),
        ({"camera": 1}, "camera"),
        ({"zero_point": 1 * u.m}, "zero_point must be in mag"),
    ],
)  # fmt: skip
def test_bad_instruments_are_named(words, message):
    good = {"name": "MICADO", "filter": "J", "psf": gaussian_psf(1.5), "exposure_time": 10.0}
    with pytest.raises(InputError, match=message):
        _ = ld.Instrument.named(**good | words).limits


def test_bad_files_are_named(star, tmp_path):
    as_mavisim(tmp_path / "m.fits", [star], [(0, 0)])
    with pytest.raises(InputError, match=r"m.fits: the file does not state the size of its samples: give psf_scale"):
        instrument(tmp_path / "m.fits")
    with pytest.raises(InputError, match="a sample of the PSF, 40 mas, is larger than a pixel of 20 mas"):
        instrument(tmp_path / "m.fits", psf_scale=0.04)
    as_tiptop(tmp_path / "t.fits", np.array([star, star]), [(0, 0)], 5.0)
    with pytest.raises(InputError, match="there are 2 PSFs, but not as many places CCX0000"):
        instrument(tmp_path / "t.fits")
    as_tiptop(tmp_path / "w.fits", np.array([[star], [star]]), [(0, 0)], 5.0)
    with pytest.raises(InputError, match="PSFs of several wavelengths"):
        instrument(tmp_path / "w.fits")
    as_tiptop(tmp_path / "d.fits", 0 * star[None], [(0, 0)], 5.0)
    with pytest.raises(InputError, match=r"d\.fits: the PSF holds no light"):
        instrument(tmp_path / "d.fits")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"instrument": None}, "stars is a luminosity function, which needs an instrument"),
        ({"instrument": "MICADO"}, "instrument must be a legdistort.Instrument, got 'MICADO'"),
        ({"sigma": 0.1}, "sigma and instrument both state the errors"),
        ({"pixel_scale": 0.1}, "pixel_scale is stated by the instrument"),
        ({"camera": ld.Camera.gsaoi()}, "camera is stated by the instrument"),
        ({"stars": [[1.0, 2.0]]}, "an instrument measures stars of magnitudes"),
        ({"stars": None, "n_stars": 20}, "an instrument measures stars of magnitudes"),
        ({"stars": Table({"density": [1, 2]})}, "a luminosity function has the columns mag and density"),
        ({"stars": Table({"mag": [3, 2], "density": [1, 2]})}, "mag of a luminosity function must increase"),
        ({"stars": Table({"mag": [3, 4], "density": [1, -2]})}, "density of a luminosity function must not be"),
        ({"stars": Table({"mag": [60, 70], "density": [1, 2]})}, "has no star that is measured"),
        ({"stars": Table({"mag": [10, 20], "density": [1e9, 1e9]})}, "give a higher min_snr"),
        ({"stars": QTable({"mag": [10, 20], "density": [1, 1] * u.m})}, "density must be stars a magnitude and square"),
        ({"stars": Table({"x": [9.0], "y": [9.0], "mag": [50.0]})}, "none of 1 stars is measured, from"),
    ],
)  # fmt: skip
def test_bad_plans_are_named(words, message):
    good = {"n_exposures": 4, "instrument": instrument(gaussian_psf(1.5)), "stars": COUNTS}
    with pytest.raises(InputError, match=message):
        ld.predict(**good | words)


def test_command(star, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    as_tiptop("psf.fits", star[None], [(0, 0)], 5.0)
    (tmp_path / "mine.toml").write_text(FILE)
    COUNTS.write("stars.csv")
    asked = ["predict", "--n-exposures", "5", "--stars", "stars.csv", "--instrument", "mine.toml", "--degree", "2"]
    asked += ["--dither", "0.6arcsec"]
    words = [*asked, "--psf", "psf.fits", "--exposure-time", "30", "--coadds", "2", "--min-snr", "20"]
    words += ["--error-floor", "0.002"]
    assert main([*words, "--plot-errors", "errors.png"]) == 0
    text = capsys.readouterr().out
    made = ld.Instrument.named("mine.toml", psf="psf.fits", exposure_time=30, n_coadds=2, min_snr=20, error_floor=0.002)
    plan = ld.predict(n_exposures=5, stars=COUNTS, instrument=made, degree=2, dithers=0.6 * u.arcsec)
    assert text.startswith(str(plan))
    assert "one exposure [mas]" in text
    assert (tmp_path / "errors.png").read_bytes()[1:4] == b"PNG"
    assert main([*words, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert figures["b"] == pytest.approx(plan.b)
    assert [row["n"] for row in figures["by_magnitude"]] == plan.by_magnitude()["n"].tolist()
    for more, message in (
        (asked, "--instrument needs --psf too"),
        ([*asked[:5], "--coadds", "2"], "--coadds is for --instrument: leave it out"),
        ([*words[:5], "--instrument", "GSAOI", *words[7:]], "GSAOI has several filters: give filter, one of J, H, Ks"),
    ):
        assert main(more) == 1
        assert message in capsys.readouterr().err


def test_a_pupil_in_the_place_of_a_file():
    pupil = PupilPSF(strehl=None, resolution=RESOLUTION, obstruction=0.0)
    made = instrument(pupil)
    half = int(np.ceil(4 * made.fwhm))
    for mag in (14.0, 21.0):
        errors, _ = truth_of_airy(RESOLUTION, 30.0 * 10 ** (-0.4 * (mag - 26.0)), SKY_ELECTRONS, 10.0, half)
        assert_allclose(made.position_error([mag]), np.mean(errors), rtol=0.02)
    gridded = instrument(pupil.over((100, 100)))
    assert_allclose(gridded.position_error([14.0, 21.0]), made.position_error([14.0, 21.0]), rtol=1e-3)
