"""PSFs from a pupil, and from arrays: against closed forms, photutils, and maoppy (PSFAO19 of Fetick et al. 2019)."""

import ao_images
import numpy as np
import pytest
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel, ImagePSF
from scipy.ndimage import gaussian_filter1d
from scipy.special import j0, j1

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.simulation import rendering
from legdistort.simulation.gridded_psf import GriddedPSF
from legdistort.simulation.pupil import PupilPSF

PIXELS = np.arange(-60, 61)


def annular(v, obstruction):
    """Diffraction pattern of an annulus at pi D r / wavelength, 1 in the middle (Born & Wolf, section 8.6)."""
    v = np.maximum(v, 1e-6)
    inner = obstruction * 2 * j1(obstruction * v) / v
    return ((2 * j1(v) / v - inner) / (1 - obstruction**2)) ** 2


@pytest.mark.parametrize("obstruction", [0.0, 0.3])
def test_diffraction_pattern_is_that_of_an_annulus(obstruction):
    """With pixels of a 24th of the resolution; the first dark ring of the clear pupil is at 1.22."""
    psf = PupilPSF(strehl=None, resolution=24.0, obstruction=obstruction, halo_fwhm=48.0)
    image = psf.light(PIXELS, PIXELS)
    expected = annular(np.pi * np.hypot(PIXELS[:, None], PIXELS) / 24, obstruction)
    np.testing.assert_allclose(image / image.max(), expected, rtol=0, atol=3e-3)
    if obstruction == 0:
        assert image.max() == pytest.approx(np.pi / 4 / 24**2, rel=4e-3)  # area / (wavelength^2) of a pupil of flux 1
        radius = np.linspace(25, 33, 161)
        dark = radius[psf.light(radius, [0.0])[0].argmin()] / 24
        assert dark == pytest.approx(1.2197, rel=5e-3)
        half = np.interp(-image.max() / 2, -psf.light(np.arange(30.0), [0.0])[0], np.arange(30.0))
        assert 2 * half / 24 == pytest.approx(1.029, rel=5e-3)


@pytest.mark.parametrize("strehl", [pytest.param(0.05, marks=pytest.mark.slow), 0.6])
def test_strehl_ratio_and_halo(strehl):
    """Peak over that without turbulence; what the core does not hold lies in a halo as wide as the seeing."""
    kinds = {"resolution": 10.0, "halo_fwhm": 200.0, "jitter": 1.0, "obstruction": 0.0}
    psf, perfect = PupilPSF(strehl=strehl, **kinds), PupilPSF(strehl=None, **(kinds | {"jitter": 0.0}))
    assert psf.light([0], [0]) / perfect.light([0], [0]) == pytest.approx(strehl, rel=0.005)
    radius = np.arange(0.0, 1000.0)
    halo = psf.light(radius, [0.0])[0] - psf.coherent * PupilPSF(strehl=None, **kinds).light(radius, [0.0])[0]
    assert 2 * np.interp(-halo[0] / 2, -halo, radius) == pytest.approx(200, rel=0.02)

    def transfer(f):
        telescope = (np.arccos(10 * f) - 10 * f * np.sqrt(1 - (10 * f) ** 2)) * 2 / np.pi
        seeing = np.exp(-3.44 * (f * 200 / 0.976) ** (5 / 3))
        return telescope * seeing * np.exp(-2 * np.pi**2 * f**2)

    for r in (0, 100, 350, 900):  # Hankel transform
        f = np.linspace(0, 0.1, 40001)
        expected = (1 - psf.coherent) * np.trapezoid(2 * np.pi * f * j0(2 * np.pi * f * r) * transfer(f), f)
        assert halo[r] == pytest.approx(expected, rel=0.01)


def test_light_is_all_there():
    """In an image much wider than the halo all but the part that Kolmogorov wings and diffraction take farther out."""
    psf = PupilPSF(strehl=0.2, halo_fwhm=12.0).over((100, 100))
    assert psf.reach(0) == 127
    image = rendering.render((301, 301), [[150.3, 149.6]], [1e6], psf=psf)
    assert 0.993e6 < image.sum() < 1e6
    nearly = rendering.render((301, 301), [[150.3, 149.6]], [1e6], psf=PupilPSF(strehl=None).over((100, 100)))
    # beyond r lies 2 / (pi^2 (1 - obstruction) r D / wavelength) of it, some of which a finite period folds back
    beyond = 2 / np.pi**2 / 0.87 / (127 / 2.8)
    assert 0.2 * beyond < 1 - nearly.sum() / 1e6 < beyond


@pytest.mark.parametrize(("resolution", "xy"), [(2.8, (50.5, 49.87)), (1.2, (50.23, 49.5)), (6.0, (50.0, 50.4))])
def test_stars_stand_between_pixels(resolution, xy):
    """Interpolated as computed there: 1e-4 of the flux, 1e-5 px, also where the core has a FWHM of 1.4 px."""
    pupil = PupilPSF(strehl=0.4, resolution=resolution, halo_fwhm=15.0, aberrations=(0.3, 0, 0, 0.4))
    psf, pixels = pupil.over((101, 101)), np.arange(101)
    image, exact = psf.on_pixels(pixels, pixels, xy), pupil.light(pixels - xy[0], pixels - xy[1])
    assert np.abs(image - exact).sum() < 1e-4
    window = np.exp(-((pixels - xy[0]) ** 2) / 50) * np.exp(-((pixels[:, None] - xy[1]) ** 2) / 50)
    for axis in (0, 1):
        found, true = ((part * window).sum(axis=axis) @ pixels / (part * window).sum() for part in (image, exact))
        assert found == pytest.approx(true, abs=1e-5)


def test_position_is_where_a_flat_phase_would_send_the_light():
    """A coma without Zernike tilt: brightest there; its centroid lies where the mean slope of the phase sends it."""
    psf = PupilPSF(strehl=None, resolution=8.0, obstruction=0.0, halo_fwhm=16.0, aberrations=(0, 0, 0, 0, 0.3))
    pixels = np.arange(-720, 721)
    image = psf.light(pixels, pixels)
    fine = np.linspace(-4, 4, 161)
    y, x = np.unravel_index(psf.light(fine, fine).argmax(), (161, 161))
    assert abs(fine[y]) < 1e-9
    assert abs(fine[x]) < 0.04 * 8.0
    # the mean of d/dx sqrt(8) (3 r^3 - 2 r) cos(angle) over the pupil is sqrt(8), and 1 rad / radius moves by 1 / pi
    assert abs(image.sum(axis=0) @ pixels) == pytest.approx(0.3 * np.sqrt(8) / np.pi * 8.0, rel=0.05)
    assert np.sign(image.sum(axis=0) @ pixels) != 0
    assert abs(image.sum(axis=1) @ pixels) < 1e-6


def test_motion_grows_off_axis_along_the_line_to_the_axis():
    psf = PupilPSF(strehl=0.5, resolution=8.0, halo_fwhm=40.0, elongation=4.0, axis=(0.2, 0.0))
    sharp = psf.light(PIXELS, PIXELS, (0.2, 0.0))
    along = gaussian_filter1d(psf.light(np.arange(-90, 91), PIXELS, (0.2, 0.0)), 0.8 * 4.0, axis=1)[:, 30:-30]
    np.testing.assert_allclose(psf.light(PIXELS, PIXELS, (1.0, 0.0)), along, rtol=0, atol=2e-4 * sharp.max())
    turned = psf.light(PIXELS, PIXELS, (0.2, -0.8))
    np.testing.assert_allclose(turned, along.T, rtol=0, atol=2e-4 * sharp.max())


def test_coma_and_astigmatism_grow_off_axis():
    wide = {"strehl": None, "resolution": 8.0, "halo_fwhm": 16.0}
    field = PupilPSF(coma=0.4, astigmatism=0.3, **wide).light(PIXELS, PIXELS, (0.0, 0.5))
    fixed = PupilPSF(aberrations=(0, 0, -0.3 * 0.25, 0.2), **wide).light(PIXELS, PIXELS)
    np.testing.assert_allclose(field, fixed, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_exposures_differ_and_a_seed_repeats_them():
    psf = PupilPSF(strehl=0.14, jitter=1.2, elongation=0.5, coma=0.2)
    drawn = [psf.varied(np.random.default_rng(seed)) for seed in range(15)]
    assert drawn[3] == psf.varied(np.random.default_rng(3))
    strehl = np.array([one.strehl for one in drawn])
    assert np.mean(strehl) == pytest.approx(0.14, rel=0.15)
    assert 0.01 < np.std(strehl) < 0.04
    assert np.ptp([one.axis[0] for one in drawn]) > 0.2
    still = PupilPSF(strehl=None).varied(np.random.default_rng(1))
    assert still.strehl is None
    assert still.coherent == 1


def test_telescope_gives_the_resolution():
    psf = PupilPSF.of_telescope(wavelength=2.15e-6, diameter=7.9, pixel_scale=0.02, seeing=0.5, strehl=0.2)
    assert psf.resolution == pytest.approx(2.15e-6 / 7.9 * 206264.8 / 0.02, rel=1e-6)
    assert (psf.halo_fwhm, psf.strehl) == (25.0, 0.2)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"strehl": 1.5}, "strehl of a PupilPSF must lie between 0 and 1, got 1.5"),
        ({"strehl": 0.9, "jitter": 1.0}, "strehl=0.9 cannot be had: the halo alone gives 0.011, .* leave 0.591"),
        ({"strehl": 0.001}, "strehl=0.001 cannot be had"),
        ({"halo_fwhm": 3.0}, "halo_fwhm must be at least twice the resolution"),
        ({"coma": np.nan}, "coma of a PupilPSF"),
        ({"aberrations": (0.1,) * 9}, "up to 8 finite phases"),
    ],
)
def test_pupil_rejects(settings, words):
    with pytest.raises(InputError, match=words):
        PupilPSF(**settings)


@pytest.fixture(scope="module")
def arrays():
    """Effective PSFs on 2 x 3 places, oversampling 4, in an order of their own."""
    rng = np.random.default_rng(1)
    offsets = np.arange(-40, 41) / 4
    places = np.array([[x, y] for x in (0.0, 50.0, 100.0) for y in (80.0, 0.0)])
    psfs = [PupilPSF(strehl=s, halo_fwhm=8.0).light(offsets, offsets) for s in rng.uniform(0.2, 0.8, 6)]
    return np.array(psfs), places


def test_arrays_are_what_photutils_takes_them_for(arrays):
    data, places = arrays
    y, x = np.mgrid[:81, :101]
    gridded = GriddedPSFModel(NDData(data, meta={"grid_xypos": places, "oversampling": 4}))
    single = ImagePSF(data[0], oversampling=4, origin=(40.5, 39.0))
    for model in (gridded, single):
        for xy in ((30.3, 22.8), (50.0, 40.0), (97.9, 3.2)):
            expected = model.evaluate(x.ravel(), y.ravel(), 1.0, *xy).reshape(x.shape)
            image = rendering.render((81, 101), [xy], [1e6], psf=model)
            # two samples from the edge of an array the end conditions of the splines show
            inner = np.maximum(abs(x - xy[0]), abs(y - xy[1])) < 9
            np.testing.assert_allclose(image[inner], 1e6 * expected[inner], rtol=0, atol=3e-5 * image.max())
            np.testing.assert_allclose(image, 1e6 * expected, rtol=0, atol=1e-2 * image.max())
    own = GriddedPSF(data, 4, positions=places)
    np.testing.assert_array_equal(
        rendering.render((81, 101), [(30.3, 22.8)], [1e6], psf=own),
        rendering.render((81, 101), [(30.3, 22.8)], [1e6], psf=gridded),
    )
    assert repr(own).startswith("<GriddedPSF: 6 of 81 x 81 samples, oversampling (4, 4), FWHM 3.1")


def test_what_is_no_psf_is_refused(arrays):
    data, places = arrays
    with pytest.raises(InputError, match="got ndarray; an array goes into GriddedPSF"):
        rendering.render((20, 20), [[5, 5]], [1.0], psf=data[0])
    with pytest.raises(InputError, match=r"with oversampling \(4, 4\) a PSF sums to 16, less .* but this one to 0.8"):
        rendering.render((20, 20), [[5, 5]], [1.0], psf=GriddedPSF(data[0] / 16, 4))
    with pytest.raises(InputError, match="all corners of a rectangular grid"):
        GriddedPSF(data, 4, positions=places + np.eye(6, 2))
    with pytest.raises(InputError, match=r"6 PSFs need positions \(6, 2\), got \(5, 2\)"):
        GriddedPSF(data, 4, positions=places[:5])
    with pytest.raises(InputError, match="finite numbers"):
        GriddedPSF(np.full((9, 9), np.nan))
    with pytest.raises(InputError, match="1 or more samples a pixel"):
        GriddedPSF(data, 0)


@pytest.mark.parametrize(("sky", "read_noise"), [(0.0, 1e-3), (1e4, 0.0)])
def test_bound_of_a_gaussian_is_the_textbook_one(sky, read_noise):
    """By the star's photons: sigma / sqrt(N). By the sky: sigma^2 sqrt(8 pi B) / N, B photons a pixel."""
    sigma, offsets = 2.5, np.arange(-100, 101) / 4
    light = np.exp(-(offsets**2) / (2 * sigma**2)) / np.sqrt(2 * np.pi * sigma**2)
    psf, xy, flux, gain = GriddedPSF(light[:, None] * light, 4), np.array([[30.2, 29.7]]), np.array([1e4]), 2.0
    expected = rendering.render((61, 61), xy, flux, psf=psf, sky=sky)
    covariance, error = rendering.position_covariance(
        xy, flux, expected, psf=psf, gain=gain, read_noise=read_noise, half=24
    )
    photons, dark = flux[0] * gain, sky * gain
    by_sky = sigma**2 * np.sqrt(8 * np.pi * dark) / photons
    bound = np.sqrt(by_sky**2) if sky else sigma / np.sqrt(photons)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance[0])), bound, rtol=0.02)
    assert error[0] == pytest.approx(np.sqrt(4 * np.pi * sigma**2 * dark) / gain if sky else 100 / np.sqrt(2), rel=0.08)
    # the closed sum over pixels that a simulated night takes, of a known flux and sky
    known = rendering.position_error(flux, psf=psf, sky=sky, gain=gain, read_noise=read_noise)
    np.testing.assert_allclose(known, bound, rtol=0.03)


@pytest.mark.slow
def test_a_fit_with_the_true_psf_reaches_the_bound():
    """Of 40 stars of all brightnesses; what deviates is 1 to 3 standard deviations of so few."""
    frame = ao_images.frame("symmetric", 0.3, 1, n=40, size=512)
    psf = ao_images.start("symmetric", 0.3, 1, 512)[1]
    left, bound = ao_images.mapped(
        ao_images.fit_true(frame, psf) - frame.xy, frame.xy, frame.order, 512, frame.covariance
    )
    z = left / np.sqrt(np.einsum("naa->na", bound))
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=3 / np.sqrt(2 * 80))


@pytest.mark.slow
def test_nights_take_a_psf_for_all_exposures_or_one_for_each(arrays):
    kinds = {"n_exposures": 2, "size": 128, "n_stars": 4, "dither": 5.0, "noise": False}
    pupil = PupilPSF(strehl=0.3, halo_fwhm=6.0)
    scattered = ld.simulate_exposures(psf=pupil, **kinds)
    first, second = scattered.psfs.values()
    assert first != second != pupil
    for given in ([first, second], lambda i: [first, second][i]):
        exact = ld.simulate_exposures(psf=given, **kinds)
        assert exact.psfs == scattered.psfs
    model = ImagePSF(arrays[0][0], oversampling=4)
    night = ld.simulate_exposures(psf=model, **kinds)
    name, truth = "exp01", night.truth
    xy = truth.distort(name, truth.positions)
    light = rendering.render((128, 128), xy, truth.flux, psf=model, sky=200.0)
    np.testing.assert_allclose(night.hdus[name][0].data, light, rtol=1e-6)
    with pytest.raises(InputError, match="psf lists 1 for 2 exposures"):
        ld.simulate_exposures(psf=[pupil], **kinds)
    with pytest.raises(InputError, match="got str"):
        ld.simulate_exposures(psf="airy", **kinds)


def psfao(samp, npix=512, **system):
    """maoppy's model with pixels of wavelength / diameter / samp."""
    maoppy = pytest.importorskip("maoppy")
    step = 0.02 / 206264.8
    telescope = maoppy.instrument.Instrument(D=7.9, occ=0.2, res=step, Nact=17, **system)
    return maoppy.psfmodel.Psfao((npix, npix), system=telescope, samp=samp)


def test_diffraction_is_that_of_maoppy():
    model = psfao(4.0)
    image = PupilPSF(strehl=None, resolution=4.0, obstruction=0.2, halo_fwhm=25.0).light(PIXELS, PIXELS)
    theirs = model.psfDiffraction[256 - 60 : 256 + 61, 256 - 60 : 256 + 61]
    assert np.abs(image - theirs).sum() < 0.02 * image.sum()
    assert image.max() == pytest.approx(theirs.max(), rel=0.01)


@pytest.mark.slow
def test_part_of_the_light_in_the_core_is_that_of_maoppy():
    """A Strehl ratio says the same of the halo as the phase variance that PSFAO19 has for it."""
    model = psfao(4.0, npix=1024)
    for r0, variance in ((0.9, 0.3), (0.6, 0.8), (0.45, 1.4)):
        parameters = [r0, 1e-3, variance, 0.9, 1.0, 0.0, 1.6]
        strehl, total = model.strehlOTF(parameters), model.var_total(parameters)
        ours = PupilPSF(strehl=strehl, resolution=4.0, obstruction=0.2, halo_fwhm=0.976 * 4.0 * 7.9 / r0)
        assert ours.coherent == pytest.approx(np.exp(-total), rel=0.15)


def test_images_of_maoppy_are_normalised_and_centred():
    pytest.importorskip("maoppy")
    psf = rendering.as_psf(ao_images.psfao(shape=300), (300, 300))
    image = rendering.render((301, 301), [[150.0, 150.0]], [1e6], psf=psf)
    assert 0.95e6 < image.sum() <= 1e6
    inner = image[80:221, 80:221]
    np.testing.assert_allclose(inner, inner[::-1, ::-1], rtol=0, atol=1e-5 * image.max())
