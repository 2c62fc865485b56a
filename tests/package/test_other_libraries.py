"""The WCS of an exposure in other people's hands: one test with each real library."""

import warnings
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import reproject
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, Cutout2D, NDData
from astropy.visualization.wcsaxes import WCSAxes
from astropy.wcs import WCS
from astropy.wcs.wcsapi import BaseHighLevelWCS, BaseLowLevelWCS
from numpy.testing import assert_allclose, assert_array_equal
from photutils.aperture import CircularAperture, EllipticalAperture, SkyCircularAperture, aperture_photometry
from reproject.mosaicking import find_optimal_celestial_wcs, reproject_and_coadd
from sky_chains import detector, geometries, pixels_of, sky_of

from legdistort.exceptions import ExportError, InputError
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve

NY, NX = 100, 140
SCALE = 2.0  # arcsec per pixel
STARS = np.array([[30.0, 25.0], [110.0, 30.0], [70.0, 80.0]])


@pytest.fixture(scope="module")
def solution():
    """Turned and flipped exposures of a small detector, a third of a pixel of distortion."""
    sim = simulate_matches(
        n_stars=60, n_exposures=4, shape=(NY, NX), dither=8, rotations=[0, 20, -60, 5], flips=[0, 0, 1, 0], sigma=0.01,
        static=0.15, dynamic=0.1, seed=2,
    )  # fmt: skip
    matrix = SCALE / 3600 * np.array([[-1.0, 0.1, 70.0], [0.1, 1.0, -50.0]])
    sky = TangentPlane(10.0, -70.0, matrix)
    matches = Matches(sim.matches.table, sim.matches.shapes, sim.matches.poses, sky)
    return solve(matches, prior=Prior(sim.truth.static))


@pytest.fixture(scope="module")
def image(solution):
    """Three Gaussian stars on exposure exp01, and their sky positions by the exact road."""
    y, x = np.mgrid[:NY, :NX]
    data = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * 2.0**2)) for a, b in STARS)
    return data, solution.sky.to_sky(solution["exp01"].correct(STARS))


@pytest.fixture(scope="module")
def target(solution, image):
    """A TAN WCS and a shape for it that hold the exposure."""
    return find_optimal_celestial_wcs([(image[0], solution["exp01"].wcs)])


def centroids(data, wcs, sky):
    """Distance [pix] between the centroids of the stars in an image and where its WCS puts them."""
    data = np.nan_to_num(data)
    expected = np.column_stack(wcs.world_to_pixel(sky))
    y, x = np.indices(data.shape)
    off = []
    for a, b in expected:
        w = data * (np.hypot(x - a, y - b) < 9)
        off.append(np.hypot(np.sum(w * x) / w.sum() - a, np.sum(w * y) / w.sum() - b))
    return np.array(off)


def test_it_is_a_wcs_of_the_shared_interface(solution):
    wcs = solution["exp01"].wcs
    assert isinstance(wcs, BaseLowLevelWCS)
    assert isinstance(wcs, BaseHighLevelWCS)
    assert (wcs.pixel_n_dim, wcs.world_n_dim) == (2, 2)
    assert wcs.array_shape == (NY, NX)
    assert wcs.pixel_shape == (NX, NY)
    assert wcs.pixel_bounds == ((-0.5, NX - 0.5), (-0.5, NY - 0.5))
    assert tuple(wcs.world_axis_physical_types) == ("pos.eq.ra", "pos.eq.dec")
    assert tuple(wcs.world_axis_units) == ("deg", "deg")
    assert_array_equal(wcs.axis_correlation_matrix, True)
    assert wcs.bounding_box.bounding_box() == wcs.pixel_bounds


def test_positions_in_all_ways(solution):
    wcs = solution["exp01"].wcs
    exact = solution.sky.to_sky(solution["exp01"].correct(STARS))
    for sky in (wcs.pixel_to_world(*STARS.T), wcs.pixel_to_world(*(STARS * u.pix).T)):
        assert sky.separation(exact).max() < 1e-9 * u.deg
    assert_allclose(np.array(wcs.pixel_to_world_values(*STARS.T)), [exact.ra.deg, exact.dec.deg], rtol=0, atol=1e-9)
    assert wcs.array_index_to_world(25, 30).separation(exact[0]) < 1e-9 * u.deg
    assert [int(i) for i in wcs.world_to_array_index(exact[0])] == [25, 30]
    for sky in (exact, exact.galactic):
        assert_allclose(np.column_stack(wcs.world_to_pixel(sky)), STARS, rtol=0, atol=2e-6)
    values = wcs.world_to_pixel_values(exact.ra.deg, exact.dec.deg)
    assert_allclose(np.column_stack(values), STARS, rtol=0, atol=2e-6)


def test_footprint_is_the_outline_of_the_detector(solution):
    corners = np.array([[-0.5, -0.5], [-0.5, NY - 0.5], [NX - 0.5, NY - 0.5], [NX - 0.5, -0.5]])
    exact = solution.sky.to_sky(solution["exp01"].correct(corners))
    assert_allclose(solution["exp01"].wcs.footprint(), np.column_stack([exact.ra.deg, exact.dec.deg]), atol=1e-9)


@pytest.mark.parametrize("method", ["interp", "adaptive", "exact"])
def test_reproject(solution, image, target, method):
    (data, sky), (wcs, shape) = image, target
    function = getattr(reproject, f"reproject_{method}")
    out, footprint = function((data, solution["exp01"].wcs), wcs, shape_out=shape)
    assert centroids(out, wcs, sky).max() < 0.05
    assert 0.5 < np.mean(footprint > 0) < 1
    back, _ = function((np.nan_to_num(out), wcs), solution["exp01"].wcs, shape_out=data.shape)
    assert centroids(back, solution["exp01"].wcs, sky).max() < 0.1


def test_reproject_finds_the_frame(solution, image, target):
    """The whole exposure is on the grid that reproject proposes, and the grid is not larger than it needs to be."""
    wcs, shape = target
    edge = np.concatenate([[[x, y] for x in np.linspace(-0.5, NX - 0.5, 50) for y in (-0.5, NY - 0.5)]])
    x, y = wcs.world_to_pixel(solution["exp01"].wcs.pixel_to_world(*edge.T))
    assert -1.5 < x.min() < 1.5
    assert -1.5 < y.min() < 1.5
    both = [(image[0], solution[name].wcs) for name in ("exp00", "exp01")]
    mosaic, footprint = reproject_and_coadd(both, wcs, shape_out=shape, reproject_function=reproject.reproject_interp)
    assert mosaic.shape == shape
    assert footprint.max() == 2


#: Right ascension and declination of the middle of a detector: on a pole, across RA = 0, and elsewhere.
PLACES = {"pole": (0.0, 90.0), "RA 0": (0.0, -30.0), "plain": (140.0, 60.0)}


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=[pytest.mark.slow] * (name != "RA 0")) for name in PLACES]
)
def bent(request):
    """A detector with 25 px of distortion, its middle at one of the `PLACES`."""
    lon, lat = PLACES[request.param]
    made = geometries()(5, 25.0, lon=lon, lat=lat, turn=0.0, shape=(400, 560))
    sky = TangentPlane(lon, lat, 50 * made.sky.matrix)  # 1 arcsec a pixel: reproject_exact was once too coarse for less
    return replace(made, coefficients=-made.coefficients, sky=sky)  # with edges that bend outwards


def test_no_position_on_the_detector_is_lost(bent):
    wcs = bent["a"].wcs
    p, ra, dec = (a[404:] for a in detector(bent, "a"))  # the first ones are on the edge, to all digits
    for sky in ((ra, dec), (ra - 360, dec), (ra * u.deg, dec * u.deg)):
        back = np.column_stack([u.Quantity(a, u.pix).value for a in wcs.invert(*sky)])
        assert np.hypot(*(back - p).T).max() < 2e-6
    assert np.hypot(*(np.column_stack(wcs.world_to_pixel(SkyCoord(ra, dec, unit="deg"))) - p).T).max() < 2e-6
    corners, places = wcs.footprint(), np.column_stack([ra, dec])
    for sky in (corners, places):
        sky[:, 0] = (sky[:, 0] - bent.sky.lon + 180) % 360
    # a box around the corners would lose some
    assert np.any((places < corners.min(axis=0)) | (places > corners.max(axis=0)))


def test_positions_beyond_the_detector_are_nan(bent):
    """The opposite half of the sky as well, which a gnomonic projection could send to the same pixels."""
    wcs = bent["a"].wcs
    ny, nx = bent.estimate.shapes["a"]
    middle = np.array([nx - 1, ny - 1]) / 2
    ring = [[np.cos(t), np.sin(t)] for t in np.linspace(0, 2 * np.pi, 40)]
    far = np.concatenate([middle + np.hypot(nx, ny) * s * np.array(ring) for s in (0.6, 1, 3, 30)])
    ra, dec = sky_of(bent, "a", far)
    assert np.isnan(wcs.world_to_pixel_values(ra, dec)).all()
    assert_array_equal(wcs.in_image(ra, dec), False)
    ra, dec = sky_of(bent, "a", middle + np.zeros((1, 2)))
    assert np.isfinite(wcs.world_to_pixel_values(ra, dec)).all()
    assert np.isnan(wcs.world_to_pixel_values((ra + 180) % 360, -dec)).all()
    assert wcs.footprint().shape == (4, 2)
    assert wcs.pixel_bounds == ((-0.5, nx - 0.5), (-0.5, ny - 0.5))


@pytest.mark.parametrize("method", ["interp", "adaptive", "exact"])
def test_reproject_fills_the_whole_image(bent, method):
    """An image that rises by one a column and three a row, on a plain grid: every pixel holds where it comes from."""
    ny, nx = bent.estimate.shapes["a"]
    y, x = np.mgrid[:ny, :nx].astype(float)
    shape = ny // 2 + 60, nx // 2 + 60
    grid = WCS(naxis=2)
    grid.wcs.ctype, grid.wcs.crval = ["RA---TAN", "DEC--TAN"], [bent.sky.lon, bent.sky.lat]
    grid.wcs.crpix = (shape[1] + 1) / 2, (shape[0] + 1) / 2
    grid.wcs.cdelt = np.array([-2.0, 2.0]) * bent.sky.pixel_scale / 3600
    out, _ = getattr(reproject, f"reproject_{method}")((x + 3 * y, bent["a"].wcs), grid, shape_out=shape)
    to = np.indices(shape)[::-1].reshape(2, -1).T
    p = pixels_of(bent, "a", *grid.all_pix2world(to, 0).T).reshape(*shape, 2)
    inside = np.minimum(np.minimum(p[..., 0], nx - 1 - p[..., 0]), np.minimum(p[..., 1], ny - 1 - p[..., 1]))
    well = inside > 6
    assert 0.4 < well.mean() < 0.9
    assert np.isfinite(out[well]).all()
    assert np.abs(out - p @ [1, 3])[well].max() < (1e-4 if method == "interp" else 0.25)
    assert np.isnan(out[inside < -6]).all()


def test_photutils(solution, image):
    data, sky = image
    wcs = solution["exp01"].wcs
    circle = CircularAperture(STARS, r=5.0)
    on_sky = circle.to_sky(wcs)
    assert on_sky.positions.separation(sky).max() < 1e-9 * u.deg
    again = on_sky.to_pixel(wcs)
    assert_allclose(again.positions, STARS, atol=2e-6)
    assert again.r == pytest.approx(5.0, rel=0.05)  # photutils has one scale for all positions
    ellipse = EllipticalAperture(STARS[0], a=6.0, b=3.0, theta=30 * u.deg).to_sky(wcs).to_pixel(wcs)
    assert (ellipse.a, ellipse.b, ellipse.theta.to_value(u.deg)) == pytest.approx((6.0, 3.0, 30.0), rel=1e-6)
    table = aperture_photometry(data, SkyCircularAperture(sky, r=10 * u.arcsec), wcs=wcs)
    inside = 2 * np.pi * 2.0**2 * (1 - np.exp(-(again.r**2) / (2 * 2.0**2)))
    assert_allclose(table["aperture_sum"], inside, rtol=0.05)


def test_regions(solution):
    regions = pytest.importorskip("regions", reason="regions is an extra of the tests (dev)")
    wcs = solution["exp01"].wcs
    circle = regions.CirclePixelRegion(regions.PixCoord(70.0, 40.0), 5.0)
    again = circle.to_sky(wcs).to_pixel(wcs)
    assert_allclose(again.center.xy, (70.0, 40.0), atol=2e-6)
    assert again.radius == pytest.approx(5.0, rel=0.05)


def test_wcsaxes(solution, image, tmp_path):
    """The grid of the axes follows the distortion: labels stand where the exact chain puts them."""
    wcs = solution["exp01"].wcs
    figure = plt.figure(figsize=(6, 5))
    axes = figure.add_subplot(projection=wcs)
    assert isinstance(axes, WCSAxes)
    axes.imshow(image[0], origin="lower")
    axes.coords.grid(color="white", linestyle=":")
    axes.scatter(image[1].ra, image[1].dec, transform=axes.get_transform("icrs"), marker="+", color="red")
    figure.savefig(tmp_path / "axes.png")
    to_pixels = axes.get_transform("icrs") - axes.transData
    assert_allclose(to_pixels.transform(np.column_stack([image[1].ra.deg, image[1].dec.deg])), STARS, atol=2e-6)
    assert [axes.coords[k].coord_type for k in (0, 1)] == ["longitude", "latitude"]
    plt.close(figure)


def test_nddata_takes_the_exact_wcs(solution, image):
    ndd = NDData(image[0], wcs=solution["exp01"].wcs)
    assert_allclose(np.column_stack(ndd.wcs.world_to_pixel(image[1])), STARS, atol=2e-6)


def test_ccddata_takes_the_fits_wcs(solution, image):
    """`CCDData` accepts `astropy.wcs.WCS` and nothing else (astropy#11727), however well another WCS behaves."""
    ccd = CCDData(image[0], unit="adu")
    with pytest.raises(TypeError, match="must be a WCS instance"):
        ccd.wcs = solution["exp01"].wcs
    ccd.wcs = solution["exp01"].fits_wcs()
    assert ccd.wcs.array_shape == (NY, NX)
    assert np.hypot(*(np.column_stack(ccd.wcs.world_to_pixel(image[1])) - STARS).T).max() < 1e-3
    part = ccd[10:90, 20:]
    assert np.hypot(*(np.column_stack(part.wcs.world_to_pixel(image[1])) - STARS + [20, 10]).T).max() < 1e-3
    hdus = ccd.to_hdu()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # astropy on the dates that the header does not have
        assert np.hypot(*(np.column_stack(WCS(hdus[0].header).world_to_pixel(image[1])) - STARS).T).max() < 1e-3


def test_fits_wcs_is_as_good_as_asked(solution):
    p = np.random.default_rng(0).uniform([-0.5, -0.5], [NX - 0.5, NY - 0.5], (200, 2))
    for name in solution.names:
        exact = solution.sky.to_sky(solution[name].correct(p))
        for max_error in (0.1, 1e-3):
            wcs = solution[name].fits_wcs(max_error=max_error)
            assert np.hypot(*(np.column_stack(wcs.world_to_pixel(exact)) - p).T).max() <= max_error
            assert wcs.pixel_to_world(*p.T).separation(exact).max() <= max_error * 1.1 * SCALE * u.arcsec
    with pytest.raises(ExportError, match="exp01: no SIP header meets max_error"):
        solution["exp01"].fits_wcs(max_error=1e-14)
    blind = solve(simulate_matches(n_stars=40, n_exposures=3, degree=1, static=1, seed=1).matches, degree=1)
    with pytest.raises(InputError, match="sky"):
        blind["exp00"].fits_wcs()


def test_ccdproc(solution, image, target):
    """`wcs_project` of a `CCDData` is what reproject makes of the exact WCS, to the error of the header."""
    ccdproc = pytest.importorskip("ccdproc", reason="ccdproc is an extra of the tests (dev): it needs scikit-image")
    (data, sky), (wcs, shape) = image, target
    projected = ccdproc.wcs_project(
        CCDData(data, unit="adu", wcs=solution["exp01"].fits_wcs()), wcs, target_shape=shape
    )
    assert centroids(projected.data, wcs, sky).max() < 0.05
    exact, _ = reproject.reproject_interp((data, solution["exp01"].wcs), wcs, shape_out=shape)
    seen = np.isfinite(exact) & np.isfinite(projected.data)
    area = np.median(projected.data[seen & (exact > 0.1)] / exact[seen & (exact > 0.1)])  # counts scale with the area
    assert np.abs(projected.data / area - exact)[seen].max() < 1e-3
    assert projected.wcs is wcs


def test_cutout(solution, image):
    """`Cutout2D` looks for the distortion of a FITS WCS, so it takes that one only."""
    wcs = solution["exp01"].fits_wcs()
    cutout = Cutout2D(image[0], image[1][0], (20, 30), wcs=wcs)
    assert cutout.shape == (20, 30)
    assert_allclose(cutout.wcs.world_to_pixel(image[1][0]), cutout.input_position_cutout, atol=2e-3)
    assert isinstance(wcs.pixel_to_world(0, 0), SkyCoord)
