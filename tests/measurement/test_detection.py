"""Detection on halos, side lobes, slopes and edges: false stars, and stars that are missed."""

import time

import numpy as np
import pytest
from photutils.background import SExtractorBackground
from scipy.ndimage import correlate
from scipy.spatial import cKDTree
from star_images import GAIN, ladder, observe, positions, scattered, usable
from star_images import image as render

from legdistort.exceptions import InputError
from legdistort.inputs.exposures import Exposure
from legdistort.measurement import filters
from legdistort.measurement.crowding import is_isolated
from legdistort.measurement.detection import detect, prepare
from legdistort.measurement.filters import gaussian_sums
from legdistort.measurement.positions import measure
from legdistort.measurement.profiles import moffat
from legdistort.measurement.profiles.location import locate_stars
from legdistort.measurement.sky.background import _mode, sky_and_noise
from legdistort.measurement.sky.smooth_light import smooth_light
from legdistort.simulation.pupil import PupilPSF
from legdistort.simulation.rendering import add_noise, as_psf
from legdistort.simulation.rendering import render as render_psf


def found(centres, xy, fwhm):
    """Which stars were found, and the detections that are none."""
    apart, _ = cKDTree(centres).query(xy)
    off, _ = cKDTree(xy).query(centres)
    return apart < 0.6 * fwhm, centres[off > fwhm]


@pytest.fixture(
    scope="module",
    params=[
        {"strehl": 0.1},
        pytest.param({"strehl": 0.3, "halo_fwhm": 12.0}, marks=pytest.mark.slow),
        pytest.param({"strehl": 0.5, "coma": 0.4}, marks=pytest.mark.slow),
    ],
)
def psf(request):
    """Of a pupil, over 512 x 512 px."""
    return as_psf(PupilPSF(resolution=3.5, **request.param), (512, 512))


@pytest.mark.parametrize("crowded", [pytest.param(False, marks=pytest.mark.sets), True])
def test_halos_and_rings_are_no_stars(psf, crowded):
    rng, shape = np.random.default_rng(3), (512, 512)
    xy = rng.uniform(5, 506, (214, 2)) if crowded else scattered(rng, 49, 512)  # one star a (10 FWHM)^2
    flux = 10 ** rng.uniform(3.5, 6.5, len(xy))
    image = add_noise(render_psf(shape, xy, flux, psf=psf, sky=100.0), rng, gain=GAIN, read_noise=10.0)
    for gain in (GAIN, None):
        _, centres, _ = locate_stars(Exposure("halos", image, gain=gain), threshold=5.0)
        stars, false = found(centres, xy, 4.0)
        assert len(false) <= 1 + 0.01 * len(xy)
        assert stars[flux > 1e5].mean() > (0.9 if crowded else 0.99)


def ringed(dx, dy, fwhm):
    """A core with a ring at 1.7 FWHM that is brighter on one side, as obstruction and coma make it; not normalised."""
    r, angle = np.hypot(dx, dy) / fwhm, np.arctan2(dy, dx)
    return np.exp(-2.77 * r**2) + 0.08 * (1 + np.cos(angle)) * np.exp(-0.5 * ((r - 1.7) / 0.25) ** 2)


@pytest.mark.parametrize("companions", [pytest.param(0, marks=pytest.mark.slow), 10])
def test_side_lobes_of_bright_stars_are_no_stars(companions):
    """The companions put beside some of the stars, twice as bright as the ring, are found."""
    rng, fwhm, size = np.random.default_rng(5), 3.5, 480
    xy, peak = scattered(rng, 49, size), 10 ** rng.uniform(2.5, 4.5, 49)
    if companions:
        turn = rng.uniform(0, 2 * np.pi, companions)
        beside = xy[:companions] + 1.9 * fwhm * np.column_stack([np.cos(turn), np.sin(turn)])
        xy, peak = np.concatenate([xy, beside]), np.concatenate([peak, 0.35 * peak[:companions]])
    y, x = np.mgrid[:size, :size]
    light = 100.0 + sum(f * ringed(x - a, y - b, fwhm) for (a, b), f in zip(xy, peak, strict=True))
    centres, _ = detect(prepare(Exposure("rings", observe(light, rng), gain=GAIN)), fwhm, 5.0)
    stars, false = found(centres, xy, fwhm)
    assert len(false) == 0
    assert stars[:49].all()
    assert np.count_nonzero(stars[49:]) >= 0.8 * companions


def test_crowded_stars_of_a_grid_are_not_taken_for_rings():
    """Neighbours at the same distance from every star."""
    rng, fwhm = np.random.default_rng(6), 3.5
    _, flux, _ = ladder(400, fwhm, 9, 500)
    xy = scattered(rng, 400, 500)
    frame = prepare(Exposure("grid", observe(render((500, 500), xy, rng.permutation(flux), fwhm), rng), gain=GAIN))
    stars, false = found(detect(frame, fwhm, 5.0)[0], xy, fwhm)
    assert len(false) <= 1
    assert stars.mean() > 0.97


def test_smooth_light_is_exact_on_a_slope_beside_edges_and_gaps():
    y, x = np.mgrid[:90, :70]
    slope, good = (3.0 * x - 2.0 * y + 7).astype(np.float64), np.ones((90, 70), dtype=bool)
    good[30:34], good[:, 50:] = False, False
    for seen in (np.ones_like(good), good):
        light, extrapolated, step = smooth_light(np.where(seen, slope, 1e6), seen, 4.0)
        near = np.s_[4:-4, 4:48]  # binned pixels of gaps and ends count half
        np.testing.assert_allclose(light[near], slope[near], atol=0.8)
    assert extrapolated[30 // step, 10] > 1
    assert extrapolated[60 // step, 10] < 1e-3


@pytest.mark.slow
def test_variance_is_that_of_the_sky_in_a_crowded_field_with_halos():
    """The map of `prepare` holds the structure of the halos."""
    rng, size = np.random.default_rng(7), 512
    xy, flux = rng.uniform(0, size, (160, 2)), 10 ** rng.uniform(3, 5.5, 160)
    light = render((size, size), xy, 0.3 * flux, 3.5) + render((size, size), xy, 0.7 * flux, 25.0, half=60) - 100.0
    exposure = Exposure("crowd", observe(light, rng), gain=GAIN)
    frame, _, _ = locate_stars(exposure, threshold=5.0)
    expected = frame.sky / GAIN + 25.0  # photons of what was taken off, read noise
    assert np.median(prepare(exposure).variance / expected) > 2
    assert np.median(frame.variance / expected) == pytest.approx(1, abs=0.12)
    unknown, _, _ = locate_stars(Exposure("crowd", observe(light, rng)), threshold=5.0)
    assert np.median(unknown.variance / expected) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize(
    "fwhm", [1.4, pytest.param(8.0, marks=pytest.mark.slow), pytest.param(14.0, marks=pytest.mark.slow)]
)
def test_narrow_and_wide_stars_are_found_once(fwhm):
    rng = np.random.default_rng(8)
    size = 700 if fwhm > 5 else 300
    xy, (_, flux, _) = scattered(rng, 36, size), ladder(36, fwhm, 20, 500)
    exposure = Exposure("wide", observe(render((size, size), xy, rng.permutation(flux), fwhm), rng), gain=GAIN)
    _, centres, _ = locate_stars(exposure, threshold=5.0)
    stars, false = found(centres, xy, fwhm)
    assert stars.all()
    assert len(false) <= 1


@pytest.mark.parametrize(
    "saturated", [pytest.param(False, marks=pytest.mark.sets), pytest.param(True, marks=pytest.mark.slow)]
)
def test_one_width_and_one_position_in_all_cut_outs_of_a_crowded_field(saturated):
    """The same pixels in four frames, undersampled; the brightest stars have flat tops, and no header says so."""
    rng, fwhm, size, part = np.random.default_rng(9), 1.4, 360, 250
    n = int((size / (8 * fwhm)) ** 2)
    xy, flux = rng.uniform(0, size, (n, 2)), (800**-0.5 + rng.uniform(size=n) * (1e6**-0.5 - 800**-0.5)) ** -2.0
    image = observe(render((size, size), xy, flux, fwhm), rng)
    if saturated:
        image = np.minimum(image, np.sort(image, axis=None)[-90])
    widths, found = [], []
    for x, y in ((0, 0), (0, size - part), (size - part, 0), (size - part, size - part)):
        exposure = Exposure("part", image[y : y + part, x : x + part], gain=GAIN)
        widths.append(moffat.fwhm(locate_stars(exposure, threshold=5.0)[2]))
        table = usable(measure(exposure, psf="moffat"))
        found.append(positions(table[is_isolated(table)]) + [x, y])
    assert np.ptp(widths) < 0.02 * fwhm
    assert np.mean(widths) == pytest.approx(fwhm, rel=0.02)
    for other in found[1:]:
        distance, same = cKDTree(found[0]).query(other)
        off = (other - found[0][same])[distance < 0.5]
        assert len(off) > 50
        assert np.sqrt(np.mean(off**2)) < 0.02


@pytest.mark.slow
def test_a_width_that_no_star_has_is_an_error_within_seconds():
    """Structure of a raw frame, far above the noise and without a star."""
    rng, size = np.random.default_rng(1), 768
    y, x = np.mgrid[:size, :size]
    data = rng.normal(1000, 10, (size, size))
    for a, b in rng.uniform(0, size, (12, 2)):
        data += 2000.0 * (np.abs(np.hypot(x - a, y - b) - 40) < 15)
    start = time.process_time()
    with pytest.raises(InputError, match=r"raw: no stars are visible: .* has a FWHM of \d+ pixels. .*fwhm="):
        measure(Exposure("raw", data, gain=1.0))
    assert time.process_time() - start < 5


@pytest.fixture
def plain_filters(monkeypatch):
    """Filters as they are before there were many pixels."""
    monkeypatch.setattr(filters, "_loops", None)


@pytest.mark.parametrize("shape", [(150, 70), (3, 200), (64, 1)])
@pytest.mark.parametrize("sigma", [0.1, 0.9, 2.5])
@pytest.mark.parametrize("dtype", ["f", "d"])
def test_compiled_sums_are_the_plain_ones(shape, sigma, dtype, plain_filters):
    """To the last bit: results do not depend on how many frames there are."""
    image = np.random.default_rng(1).normal(size=shape).astype(dtype)
    powers = (0, 0), (1, 0), (0, 1), (1, 1), (0, 2)
    plain = gaussian_sums(image, sigma, powers)
    filters.use_compiled_loops(filters.COMPILED_FROM - 1)
    assert filters._loops is None
    filters.use_compiled_loops(filters.COMPILED_FROM)
    assert filters._loops is not None
    for sums, expected in zip(gaussian_sums(image, sigma, powers), plain, strict=True):
        np.testing.assert_array_equal(sums, expected)


@pytest.mark.filterwarnings("ignore:(Mean|Degrees|All-NaN|invalid)")
@pytest.mark.parametrize(
    ("shape", "axis"), [((8, 9, 64), -1), ((8, 9, 33), -1), ((5, 7, 6, 4), (1, 3)), ((40, 30), None), ((0,), None)]
)
@pytest.mark.parametrize("dtype", ["f", "d"])
def test_the_sky_of_a_mesh_is_that_of_photutils(shape, axis, dtype):
    """To the last bit, with holes; of nothing it is NaN, of constants the constant, of a skew mesh the median."""
    rng = np.random.default_rng(2)
    values = rng.normal(size=shape).astype(dtype)
    values[rng.random(shape) < 0.1] = np.nan
    if axis == -1:
        values[0, 0], values[1, 1], values[2, 2, 1:] = np.nan, 3, np.nan
        values[3] = np.exp(2 * values[3])
    np.testing.assert_array_equal(_mode(values, axis=axis), SExtractorBackground(sigma_clip=None)(values, axis=axis))


def test_a_corner_without_pixels_has_the_sky_of_its_neighbours():
    data, mask = np.random.default_rng(0).normal(10, 1, (200, 210)).astype("f"), np.zeros((200, 210), dtype=bool)
    mask[192:, 192:] = True
    sky, rms = sky_and_noise(data, mask, 64)
    np.testing.assert_allclose(sky[192:, 192:], 10, atol=0.2)
    np.testing.assert_allclose(rms[192:, 192:], 1, atol=0.1)


@pytest.mark.parametrize("shape", [(150, 70), (3, 200), (64, 1)])
@pytest.mark.parametrize("sigma", [0.1, 0.9, 2.5])
@pytest.mark.usefixtures("plain_filters")
def test_gaussian_sums_are_those_of_scipy(shape, sigma):
    """Over more rows than are in the cache at a time, fewer than the weights reach, and a single column."""
    image = np.random.default_rng(1).normal(size=shape)
    x = np.arange(-int(3 * sigma + 0.5), int(3 * sigma + 0.5) + 1)
    weight = np.exp(-0.5 * (x[:, None] ** 2 + x**2) / sigma**2)
    powers = (0, 0), (1, 0), (0, 1), (1, 1), (0, 2)
    for sums, (i, j) in zip(gaussian_sums(image, sigma, powers), powers, strict=True):
        expected = correlate(image, weight / weight.sum() * x[:, None] ** i * x**j, mode="constant")
        np.testing.assert_allclose(sums, expected, atol=1e-13)
