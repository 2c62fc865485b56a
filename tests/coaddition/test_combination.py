"""Combination of stacks: cosmic rays go, stars stay, blocks and order do not matter."""

from functools import cache

import numpy as np
import pytest

from legdistort.coaddition.combination import PixelFlag, combine, confirmed, margin
from legdistort.coaddition.resampling.engines import Resampling, resample_exposure
from legdistort.coaddition.resampling.pixel_maps import PixelMap

SHAPE = (300, 300)
NOISE = 20.0


def gaussian(r2, fwhm):
    s2 = (fwhm / 2.3548) ** 2
    return np.exp(-r2 / (2 * s2)) / (2 * np.pi * s2)


def moffat(r2, fwhm, beta=3.0):
    a2 = (fwhm / 2) ** 2 / (2 ** (1 / beta) - 1)
    return (beta - 1) / (np.pi * a2) * (1 + r2 / a2) ** -beta


def stars(seed=0):
    rng = np.random.default_rng(seed)
    g = np.arange(30, 280, 40.0)
    xy = np.stack(np.meshgrid(g, g), -1).reshape(-1, 2) + rng.uniform(-0.5, 0.5, (len(g) ** 2, 2))
    return xy, 10 ** rng.uniform(4, 6, len(xy))


def scene(fwhm, *, hits=None):
    """Resampled exposures of one field, of widths `fwhm`; ``hits(i, image, place)`` spoils them."""
    return clean_scene(tuple(fwhm)) if hits is None else made_scene(fwhm, hits)


@cache
def clean_scene(fwhm):
    data, variance, xy, flux = made_scene(fwhm)
    for array in (data, variance):
        array.setflags(write=False)
    return data, variance, xy, flux


def made_scene(fwhm, hits=None, *, profile=gaussian, order=3, seed=0):
    rng = np.random.default_rng(seed)
    xy, flux = stars()
    gy, gx = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    data = []
    for i, width in enumerate(fwhm):
        shift = rng.uniform(-3, 3, 2)
        image = np.zeros(SHAPE)
        for (x, y), f in zip(xy + shift, flux, strict=True):
            x0, y0 = round(x), round(y)
            yy, xx = np.mgrid[y0 - 20 : y0 + 21, x0 - 20 : x0 + 21]
            image[y0 - 20 : y0 + 21, x0 - 20 : x0 + 21] += f * profile((xx - x) ** 2 + (yy - y) ** 2, width)
        image = rng.poisson(image + NOISE**2) - NOISE**2
        if hits is not None:
            hits(i, image, xy + shift)
        where = np.array([gx + shift[0], gy + shift[1]])
        inside = np.all((where >= 0) & (where <= SHAPE[0] - 1), axis=0)
        window = (slice(0, SHAPE[0]), slice(0, SHAPE[1]))
        pixel_map = PixelMap(window, where, inside, np.ones(SHAPE))
        found = resample_exposure(image, {}, NOISE**2, pixel_map, Resampling(order=order))
        data.append((found.data, np.broadcast_to(found.variance, SHAPE)))
    data, variance = np.array(data, dtype=np.float32).swapaxes(0, 1)
    return data, variance, xy, flux


def aperture(image, xy, r):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.array([image[(x - a) ** 2 + (y - b) ** 2 <= r * r].sum() for a, b in xy])


def ramp(k, fwhm=2.5, ratio=1.3):
    return fwhm * np.linspace(1, ratio, k)


def test_flags_of_pixels_are_what_mosaics_say():
    assert {flag.name: flag.value for flag in PixelFlag} == {"EXTRAPOLATED": 1, "SATURATED": 2, "REJECTED": 4}


class TestClipping:
    @pytest.mark.parametrize(
        "k", [pytest.param(4, marks=pytest.mark.sets), 6, pytest.param(11, marks=pytest.mark.slow)]
    )
    @pytest.mark.parametrize("known", [True, False])
    @pytest.mark.parametrize(
        "fwhm",
        [
            lambda k: np.full(k, 2.2),
            ramp,
            lambda k: np.r_[2.5, np.full(k - 1, 3.25)],  # one is sharper
            lambda k: np.r_[3.25, np.full(k - 1, 2.5)],  # one is wider
        ],
    )
    def test_star_cores_are_intact(self, k, known, fwhm):
        widths = fwhm(k)
        data, variance, xy, _ = scene(widths)
        weight = np.ones((k, 1, 1))
        mean = combine(data, variance, weight)
        clipped = combine(data, variance, weight, method="clipped", fwhm=widths if known else None)
        core = aperture(clipped.data, xy, 2.5) / aperture(mean.data, xy, 2.5) - 1
        assert np.abs(core).max() < 1e-3
        whole = aperture(clipped.data, xy, 8) / aperture(mean.data, xy, 8) - 1
        assert np.abs(np.median(whole)) < 1e-4
        assert np.abs(whole).max() < 3e-3
        assert (mean.count - clipped.count).sum() / mean.count.sum() < 3e-4

    def test_wide_stars_of_unequal_seeing_keep_their_wings(self):
        widths = np.r_[6.5, np.full(5, 5.0)]
        data, variance, xy, _ = scene(widths)
        mean, clipped = (combine(data, variance, 1.0, method=m, fwhm=widths) for m in ("mean", "clipped"))
        assert np.abs(aperture(clipped.data, xy, 12) / aperture(mean.data, xy, 12) - 1).max() < 3e-3

    @pytest.mark.parametrize(("energy", "least"), [(10, 0.9), (20, 0.95), (100, 0.97), (1000, 0.97)])
    @pytest.mark.parametrize(
        "k", [pytest.param(4, marks=pytest.mark.slow), pytest.param(6, marks=pytest.mark.slow), 11]
    )
    def test_cosmic_rays_on_the_sky_are_found(self, k, energy, least):
        widths = ramp(k, ratio=1.1)
        clean = scene(widths)
        rng = np.random.default_rng(7)
        places = []

        def hit(i, image, place):
            x, y = rng.integers(15, SHAPE[0] - 15, (2, 60))
            image[y, x] += energy * NOISE
            places.append((x, y, place[0] - clean[2][0]))

        data, variance, *_ = scene(widths, hits=hit)
        got = combine(data, variance, 1.0, method="clipped", fwhm=widths)
        mean, without = combine(data, variance, 1.0).data, combine(clean[0], clean[1], 1.0).data
        found, left, put = [], 0.0, 0.0
        for i, (x, y, shift) in enumerate(places):
            for column, row in np.rint(np.column_stack([x, y]) - shift).astype(int):
                box = slice(row - 2, row + 3), slice(column - 2, column + 3)
                found.append(not got.keep[i, row, column])
                left += (got.data[box] - without[box]).sum()
                put += (mean[box] - without[box]).sum()
        assert np.mean(found) > least
        assert abs(left) < 0.25 * put

    @pytest.mark.parametrize("k", [4, pytest.param(11, marks=pytest.mark.slow)])
    def test_cosmic_rays_on_stars_are_found(self, k):
        widths = np.full(k, 2.5)

        def hit(i, image, place):
            if i == 0:
                x, y = np.rint(place).astype(int).T
                image[y, x] *= 2
                image[y, x] += 20 * NOISE

        clean, spoilt = scene(widths), scene(widths, hits=hit)
        xy = clean[2]
        means = [combine(*s[:2], 1.0).data for s in (clean, spoilt)]
        got = combine(*spoilt[:2], 1.0, method="clipped", fwhm=widths)
        before = aperture(means[1], xy, 2.5) / aperture(means[0], xy, 2.5) - 1
        after = aperture(got.data, xy, 2.5) / aperture(means[0], xy, 2.5) - 1
        assert np.abs(np.median(after)) < 0.25 * np.median(before)

    def test_hot_pixels_and_a_trail_go(self):
        k, hot = 6, np.random.default_rng(3).integers(20, 280, (2, 50))

        def hit(i, image, place):
            image[hot[0], hot[1]] += 50 * NOISE  # the same on every detector
            if i == 2:
                image[:, 140:142] += 100 * NOISE

        clean, spoilt = scene(np.full(k, 2.5)), scene(np.full(k, 2.5), hits=hit)
        got = combine(*spoilt[:2], 1.0, method="clipped", fwhm=np.full(k, 2.5))
        true = combine(*clean[:2], 1.0)
        sky = np.all(clean[0] < 3 * NOISE, axis=0)
        assert np.std((got.data - true.data)[sky]) < 0.35 * np.sqrt(np.median(true.variance))
        assert np.std((combine(*spoilt[:2], 1.0).data - true.data)[sky]) > 3 * np.sqrt(np.median(true.variance))

    def test_pixels_do_not_depend_on_blocks(self):
        widths = ramp(5, 4.0)
        rng = np.random.default_rng(1)

        def hit(i, image, place):
            image[tuple(rng.integers(0, 300, (2, 300)))] += 1000

        data, variance, *_ = scene(widths, hits=hit)
        whole = combine(data, variance, 1.0, method="clipped", fwhm=widths)
        edge = margin("clipped", (widths.min(), widths.max()))
        assert edge == 3
        for y, x in ((0, 0), (100, 130), (200, 250)):
            rows, columns = slice(y, y + 50), slice(x, x + 50)
            outer = tuple(slice(max(0, s.start - edge), s.stop + edge) for s in (rows, columns))
            part = combine(data[:, *outer], variance[:, *outer], 1.0, method="clipped", fwhm=widths)
            inner = tuple(
                slice(s.start - o.start, s.start - o.start + 50) for s, o in zip((rows, columns), outer, strict=True)
            )
            np.testing.assert_array_equal(part.data[inner], whole.data[rows, columns])
            np.testing.assert_array_equal(part.keep[:, *inner], whole.keep[:, rows, columns])

    def test_two_exposures_cannot_tell(self):
        data = np.zeros((2, 5, 5))
        data[0, 2, 2] = 1e6
        assert confirmed(data, np.ones_like(data), np.isfinite(data)).all()

    def test_a_deep_exposure_survives_shallow_ones(self):
        rng = np.random.default_rng(2)
        sigma = np.array([0.1, 10, 10, 10, 10]).reshape(-1, 1, 1)
        data = rng.normal(0, 1, (5, 200, 200)) * sigma
        keep = confirmed(data, np.broadcast_to(sigma**2, data.shape), np.isfinite(data))
        assert keep[0].mean() > 0.999


class TestStatistics:
    def test_order_of_exposures_does_not_matter(self):
        widths = ramp(5)
        data, variance, *_ = scene(widths)
        order = [3, 1, 4, 0, 2]
        for method in ("mean", "median", "clipped"):
            a = combine(data, variance, 1.0, method=method, fwhm=widths)
            b = combine(data[order], variance[order], 1.0, method=method, fwhm=widths[order])
            np.testing.assert_array_equal(a.keep[order], b.keep)
            np.testing.assert_allclose(a.data, b.data, rtol=1e-5, atol=1e-3)

    @pytest.mark.parametrize("method", ["mean", "median", "clipped"])
    @pytest.mark.parametrize("sigma", [(1, 1, 1), (1, 1, 1, 1), (1, 2, 1.5, 3), (1, 1.5, 2, 2.5, 3, 1, 1.2)])
    def test_variance_is_that_of_repeated_draws(self, method, sigma):
        sigma = np.array(sigma).reshape(-1, 1, 1)
        data = np.random.default_rng(5).normal(0, 1, (len(sigma), 300, 300)) * sigma
        got = combine(data, np.broadcast_to(sigma**2, data.shape), 1 / sigma**2, method=method)
        assert np.std(got.data) == pytest.approx(np.sqrt(got.variance.mean()), rel=0.06)

    def test_pixel_weights(self):
        data = np.stack([np.full((4, 5), 1.0), np.full((4, 5), 4.0)])
        weight = np.ones((2, 4, 5))
        weight[0, :, 2:] = 3
        got = combine(data, np.ones_like(data), weight)
        np.testing.assert_allclose(got.data[:, :2], 2.5)
        np.testing.assert_allclose(got.data[:, 2:], 1.75)
        np.testing.assert_allclose(got.weight[0], [2, 2, 4, 4, 4])
        np.testing.assert_allclose(got.variance[0, [0, 3]], [0.5, 10 / 16])

    @pytest.mark.parametrize("method", ["mean", "median", "clipped"])
    def test_spare_pixels_are_used_only_where_there_is_no_other(self, method):
        data = np.arange(4.0).reshape(4, 1, 1) * np.ones((4, 3, 3))
        spare = np.zeros(data.shape, dtype=bool)
        spare[3] = spare[:, 1, 1] = True
        got = combine(data, np.full_like(data, 100.0), 1.0, method=method, spare=spare)
        assert got.data[0, 0] == pytest.approx(1)
        assert got.data[1, 1] == pytest.approx(1.5)
        assert got.count[0, 0] == 3
        assert got.count[1, 1] == 4

    @pytest.mark.parametrize("method", ["mean", "median", "clipped"])
    def test_nothing_there_is_nan(self, method):
        data = np.full((3, 4, 4), np.nan)
        data[:, 0, 0] = 7
        got = combine(data, np.ones_like(data), 1.0, method=method)
        assert got.data[0, 0] == 7
        assert np.isnan(got.data).sum() == np.isnan(got.variance).sum() == 15
        assert got.count.sum() == 3
        assert repr(got) == "<Combined: 4 x 4 px, 3 exposures>"


@pytest.mark.parametrize("method", ["mean", "clipped"])
@pytest.mark.parametrize("k", [1, 2, 3, 8, 11, 40])
def test_compiled_loops_agree_with_plain_ones(k, method):
    """Holes, saturated pixels, cosmic rays, unequal weights, photons, and pixels that no exposure has."""
    rng = np.random.default_rng(k)
    signal = 500 * moffat(((np.indices((40, 50)) - 20.3) ** 2).sum(axis=0), 4) + 10
    variance = rng.uniform(0.5, 2, (k, *signal.shape)).astype(np.float32)
    data = (signal + rng.normal(size=variance.shape) * np.sqrt(variance)).astype(np.float32)
    data[rng.random(data.shape) < 0.01] += 50
    data[rng.random(data.shape) < 0.1] = np.nan
    data[:, :3, :4] = np.nan
    weight = rng.uniform(0.5, 2, (k, 1, 1))
    known = {"photons": rng.uniform(0, 0.1, k), "spare": rng.random(data.shape) < 0.05, "fwhm": rng.uniform(3, 4, k)}
    for given in ({}, known):
        plain, found = (
            combine(data, variance, weight, method=method, level=10, compiled=compiled, **given)
            for compiled in (False, True)
        )
        assert np.array_equal(plain.keep, found.keep)
        assert method == "mean" or k < 3 or np.count_nonzero(np.isfinite(data) & ~found.keep) > k
        for plane in ("data", "variance", "weight"):
            np.testing.assert_allclose(getattr(found, plane), getattr(plain, plane), rtol=1e-6, equal_nan=True)
