"""Flux scales, weights, support and saturation in co-adding, against what was put in."""

import logging
import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pupil_images
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS
from caller_warnings import warns_here
from reproject import reproject_interp
from scipy.spatial import Delaunay
from stacks import SHAPE, SIGMA, StandIn, check_stars, covered, expose, fit_star, plain, scene, star_image

from legdistort.cli.running import in_shell_words
from legdistort.coaddition.background import measure_background
from legdistort.coaddition.combination import PixelFlag
from legdistort.coaddition.flux_scales import flux_scales
from legdistort.coaddition.mosaicking import coadd
from legdistort.coaddition.options import CoaddOptions
from legdistort.coaddition.weights import make_weights, stellar_widths
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry.distortion import Distortion
from legdistort.geometry.star_hull import support, supported
from legdistort.inputs.exposures import Exposure
from legdistort.matching.matcher import match
from legdistort.measurement.positions import measure
from legdistort.solving.estimation import solve

FLAT = {"conserve": "surface_brightness", "match_background": False}


def measured(solution, table, maps=None):
    """With a table of observations of one's own."""
    return StandIn(solution.poses, solution.distortions, solution.sky, table=table, maps=maps)


def views(table):
    """What was seen on each exposure or detector that a table names."""
    return {n: SimpleNamespace(residuals=table[table["exposure"] == n]) for n in sorted(set(table["exposure"]))}


def observed(depth, *, n=60, noise=0.03, seed=0, outliers=0.1, fwhm=None, seen=0.8):
    """Observations of `n` stars in exposures of given depth; some fluxes are wild."""
    rng = np.random.default_rng(seed)
    flux = 10 ** rng.uniform(3, 5, n)
    rows = []
    for i, d in enumerate(depth):
        for star in np.flatnonzero(rng.random(n) < seen):
            wild = 10 ** rng.uniform(-1, 1) if rng.random() < outliers else 1.0
            f = d * flux[star] * np.exp(rng.normal(0, noise)) * wild
            x, y = rng.uniform(20, 280, 2)
            rows.append((f"frame{i}", star, x, y, f, 2.0 if fwhm is None else fwhm[i] * rng.uniform(0.9, 1.1), True))
    names = ["exposure", "star", "x", "y", "flux", "fwhm", "used"]
    return QTable(rows=rows, names=names, units={"x": u.pix, "y": u.pix, "fwhm": u.pix})


def blank(n, **changes):
    return [Exposure(f"frame{i}", np.ones(SHAPE), **{k: v[i] for k, v in changes.items()}) for i in range(n)]


class TestFluxScale:
    @pytest.mark.parametrize("areas", [None, {"a": 1.0, "b": 0.9}])
    def test_detectors_of_a_camera(self, areas):
        """Clouds by stars that stay on a detector, sensitivities by those that change it; both at once."""
        depth, sensitivity, rng, rows = [1.0, 0.7, 0.9], {"a": 1.0, "b": 1.06}, np.random.default_rng(4), []
        for i, d in enumerate(depth):
            for star in range(60):
                key = "ab"[(star + 17 * i) % 60 >= 30]
                flux = (1000 + 50 * star) * d * sensitivity[key] * (areas or {}).get(key, 1)
                rows.append((f"frame{i}-{key}", star, flux * np.exp(rng.normal(0, 0.01)), True))
        seen = views(QTable(rows=rows, names=["exposure", "star", "flux", "used"]))
        frames = [
            Exposure(f"frame{i}-{key}", np.ones(SHAPE), exposure_time=60.0, exposure=f"frame{i}", detector=key)
            for i in range(3)
            for key in "ab"
        ]
        by_part = areas and {f.name: areas[f.detector] for f in frames}
        factors, origin = flux_scales(frames, "auto", seen, by_part)
        product = np.array([factors[f"frame{i}-{key}"] * depth[i] * sensitivity[key] for i in range(3) for key in "ab"])
        assert origin == "stars"
        np.testing.assert_allclose(product / product.mean(), 1, atol=0.005)
        assert factors["frame0-a"] / factors["frame0-b"] == pytest.approx(factors["frame2-a"] / factors["frame2-b"])

    def test_detectors_that_share_no_star(self):
        """Each keeps its sensitivity; the clouds are known all the same."""
        parts = [(i, key) for i in (0, 1) for key in "ab"]
        rows = [
            (f"frame{i}-{k}", f"{k}{star}", 100.0 * star * (1 + i), True) for i, k in parts for star in range(1, 20)
        ]
        seen = views(QTable(rows=rows, names=["exposure", "star", "flux", "used"]))
        frames = [Exposure(f"frame{i}-{k}", np.ones(SHAPE), exposure=f"frame{i}", detector=k) for i, k in parts]
        factors, _ = flux_scales(frames, "auto", seen)
        assert [factors[f.name] / factors["frame0-a"] for f in frames] == pytest.approx([1, 1, 0.5, 0.5])

    @pytest.mark.parametrize("scale", ["auto", "stars"])
    def test_stars_through_clouds(self, scale, caplog):
        depth = np.array([1.0, 0.7, 0.9, 0.4, 1.1])
        caplog.set_level(logging.INFO)
        factors, origin = flux_scales(blank(5, exposure_time=[60.0] * 5), scale, views(observed(depth)))
        assert origin == "stars"
        product = np.array([factors[f"frame{i}"] for i in range(5)]) * depth
        np.testing.assert_allclose(product / product.mean(), 1, atol=0.02)
        assert np.mean(list(factors.values())) == pytest.approx(1)  # the mean exposure time is kept
        if scale == "auto":
            low, high = re.search(r"stars have (\S+) to (\S+) of the light", caplog.text).groups()
            np.testing.assert_allclose([float(low), float(high)], [0.4 / 0.9, 1.1 / 0.9], rtol=0.03)

    def test_time_is_preferred_where_stars_agree(self):
        times = [10.0, 20.0, 30.0]
        factors, origin = flux_scales(blank(3, exposure_time=times), "auto", views(observed(np.array(times))))
        assert origin == "exptime"
        assert factors == {"frame0": 2.0, "frame1": 1.0, "frame2": 2 / 3}

    def test_stars_take_the_place_of_unknown_times(self):
        seen = views(observed([1.0, 3.0]))
        frames = blank(2, exposure_time=[10.0, None])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            factors, origin = flux_scales(frames, "auto", seen)
        assert origin == "stars"
        assert factors["frame0"] / factors["frame1"] == pytest.approx(3, rel=0.03)
        with warns_here(AssumptionWarning, match="no exposure time known for frame1") as caught:
            assert flux_scales(frames, "exptime", seen)[0]["frame0"] == 1
        assert in_shell_words(str(caught[-1].message)).endswith("in the headers, or give --scale stars")

    def test_exposures_are_joined_through_others(self):
        table = observed([1.0, 2.0, 4.0], seen=1.0, outliers=0)
        first, last = (table["exposure"] == f"frame{i}" for i in (0, 2))
        table = table[~(first & (table["star"] > 40)) & ~(last & (table["star"] < 20))]
        factors, _ = flux_scales(blank(3), "stars", views(table))
        assert factors["frame0"] / factors["frame2"] == pytest.approx(4, rel=0.03)

    def test_bad_input(self):
        known = {name: plain()[0][name] for name in ("frame0", "frame1")}
        with pytest.raises(InputError, match="scale='stars': the solution has no fluxes of stars; give") as error:
            flux_scales(blank(2), "stars", known)
        assert in_shell_words(str(error.value)).endswith("no fluxes of stars; give --scale exptime")  # no dicts there
        apart = observed([1.0, 1.0], seen=1.0)
        apart = apart[(apart["exposure"] == "frame0") == (apart["star"] < 30)]
        with pytest.raises(InputError, match=r"no 5 common stars .* apart are frame0; frame1"):
            flux_scales(blank(2), "stars", views(apart))
        with pytest.raises(
            InputError, match=r"scale must be one of 'auto', 'exptime', 'stars', None or a dict .* 'sky'"
        ):
            CoaddOptions(scale="sky")

    @pytest.mark.slow
    def test_mosaic_through_clouds(self):
        solution, stars, flux, exposures, _ = plain()
        depth = [1.0, 0.6, 0.8, 1.2]
        rng = np.random.default_rng(0)
        dimmed = [
            Exposure(e.name, d * e.data + rng.normal(0, 1, SHAPE) + 50, exposure_time=30.0)
            for d, e in zip(depth, exposures, strict=True)
        ]
        cloudy = measured(solution, observed(depth, noise=0.002, outliers=0.05))
        mosaic = coadd(dimmed, cloudy, method="clipped")
        assert mosaic.header["SCALEBY"] == "stars"
        assert mosaic.header["EXPTIME"] == 30
        bright = flux > 2e4
        xy = (stars - mosaic.offset)[bright]
        plainly = coadd(dimmed, cloudy, scale=None)
        chosen = covered(plainly, xy)
        assert len(chosen) > 15
        for m, low, high in ((mosaic, 0, 0.01), (plainly, 0.03, 1)):  # whichever exposures saw the star
            image = m.data - m.header["SKYLEVEL"]
            ratio = np.array([fit_star(image, xy[i], flux[bright][i])[1] / flux[bright][i] for i in chosen])
            assert low <= np.std(ratio) / np.mean(ratio) < high


class TestWeights:
    def test_by_seeing(self):
        seen = views(observed([1.0] * 3, fwhm=[2.0, 3.0, 4.0]))
        noise = {f"frame{i}": 1.0 for i in range(3)}
        values = [w.value for w in make_weights("seeing", noise, seen).values()]
        np.testing.assert_allclose(values, [1, 4 / 9, 1 / 4], rtol=0.05)
        assert stellar_widths({"frame0": seen["frame0"]})["frame0"] == pytest.approx(2, rel=0.03)

    def test_by_exposure_time(self):
        noise = {"a": 1.0, "b": 5.0}
        values = make_weights("exptime", noise, None, times={"a": 10.0, "b": 40.0})
        assert (values["a"].value, values["b"].value) == (0.25, 1)

    def test_by_error_of_the_correction(self):
        solution = scene(2, rolls=(0, 0), spread=0, peak=1e-3)[0]
        poor = {"frame0": lambda x, y: 0 * x * y + 1e-4, "frame1": lambda x, y: np.where(x < 200, 1e-4, 0.4) + 0 * y}
        two = [Exposure(f"frame{i}", np.full(SHAPE, v)) for i, v in enumerate((1.0, 3.0))]
        both = measured(solution, observed([1.0, 1.0]), poor)
        mosaic = coadd(two, both, weights="sigma_map", **FLAT)
        assert mosaic.data[150, 100] == pytest.approx(2, abs=0.01)  # equal where equally good
        own = (0.02 * 2) ** 2
        assert mosaic.data[150, 350] == pytest.approx(1 + 2 / (2 + 0.16 / own) * 1, abs=0.02)
        assert mosaic.weight[150, 350] < 1.02

    def test_by_pixel(self):
        """A vignetted half of one exposure counts less there, and stars are not biased towards their low draws."""
        solution = scene(2, rolls=(0, 0), spread=0, peak=1e-3)[0]
        sigma = np.ones(SHAPE)
        sigma[:, 200:] = 3
        two = [Exposure("frame0", np.full(SHAPE, 1.0), uncertainty=np.ones(SHAPE))]
        two += [Exposure("frame1", np.full(SHAPE, 3.0), uncertainty=sigma)]
        mosaic = coadd(two, solution, weights="variance", **FLAT)
        assert mosaic.data[150, 100] == pytest.approx(2, abs=1e-3)
        assert mosaic.data[150, 300] == pytest.approx(1.2, abs=1e-3)
        assert mosaic.variance[150, 300] == pytest.approx(0.9, rel=0.02)

    def test_photons_of_stars_do_not_count(self):
        solution, stars, flux = scene(3, rolls=(0, 1, -1))
        rng = np.random.default_rng(3)
        exposures, truth = [], expose(solution, stars, flux)
        for e in truth:
            counts = rng.poisson(e.data + 100)
            exposures.append(Exposure(e.name, counts.astype(float), uncertainty=np.sqrt(np.maximum(counts, 1))))
        seen = measure_background(exposures[0], bad=np.zeros(SHAPE, dtype=bool), filled=exposures[0].data)
        assert seen.photons == pytest.approx(1, rel=0.1)
        variance = seen.sky_variance(exposures[0].data, exposures[0].uncertainty ** 2)
        assert np.median(variance[truth[0].data > 500]) == pytest.approx(100, rel=0.2)
        mosaic, plainly = (coadd(exposures, solution, weights=w) for w in ("variance", "noise"))
        xy = stars - mosaic.offset
        spots = tuple(np.round(xy[covered(mosaic, xy)]).astype(int).T[::-1])
        ratio = (mosaic.data[spots] - 100).sum() / (plainly.data[spots] - 100).sum()
        assert ratio == pytest.approx(1, abs=0.005)

    def test_bad_input(self):
        noise = {"frame0": 1.0, "frame1": 1.0}
        with pytest.raises(InputError, match="no exposure time known for frame1; give a dict"):
            make_weights("exptime", noise, None, times={"frame0": 3.0, "frame1": None})
        table = observed([1.0, 1.0])
        table.remove_column("fwhm")
        with pytest.raises(InputError, match="weights='seeing': the solution has no FWHM"):
            make_weights("seeing", noise, views(table))
        with pytest.raises(InputError, match=r"weights must be one of 'noise', 'variance', .*, got 'ivar'"):
            CoaddOptions(weights="ivar")


class TestSupport:
    def one_corner(self, solution):
        """Stars of frame0 in the left half only."""
        table = solution.residuals
        xy = [(10, 10), (200, 10), (200, 290), (10, 290)]
        table["x"][:4], table["y"][:4] = np.transpose(xy) * u.pix
        return measured(solution, table)

    def test_supported_is_that_of_the_solution(self):
        table = observed([1.0])
        planes, view = support(table), measured(plain()[0], table)["frame0"]

        rng = np.random.default_rng(0)
        xy = rng.uniform(0, 300, (2000, 2))
        np.testing.assert_array_equal(supported(planes, xy.T), view.supported(xy))
        hull = Delaunay(np.column_stack([table["x"].to_value("pix"), table["y"].to_value("pix")]))
        np.testing.assert_array_equal(supported(planes, xy.T), hull.find_simplex(xy) >= 0)
        inside = xy[supported(planes, xy.T)]
        assert not view.supported(np.append(inside[:5], [[np.nan, 1.0]], axis=0))[-1]
        assert supported(planes, inside[:5].T).all()  # a box that lies inside altogether

    def test_options(self):
        solution = scene(2, rolls=(0, 0), spread=0, peak=1e-3)[0]
        half = self.one_corner(solution)
        two = [Exposure(f"frame{i}", np.full(SHAPE, v)) for i, v in enumerate((1.0, 3.0))]
        flag, mask, keep = (coadd(two, half, extrapolated=e, **FLAT) for e in ("flag", "mask", "keep"))
        assert flag.data[150, 300] == keep.data[150, 300] == pytest.approx(2)
        assert mask.data[150, 300] == pytest.approx(3)
        assert mask.data[150, 100] == pytest.approx(2)
        assert (flag.flags[150, 300], flag.flags[150, 100]) == (PixelFlag.EXTRAPOLATED, 0)
        assert not mask.flags.any()
        assert not keep.flags.any()
        assert mask.footprint[150, 300] == 1
        alone = coadd(two[:1], half, extrapolated="mask", **FLAT)
        assert np.isnan(alone.data[150, 300])
        with pytest.raises(InputError, match="extrapolated must be one of 'flag', 'mask', 'keep', got 'no'"):
            coadd(two, half, extrapolated="no")

    def test_an_exposure_without_support(self):
        solution = scene(2, rolls=(0, 0), spread=0)[0]
        table = solution.residuals
        table["used"][:4] = False
        assert not supported(support(table[table["exposure"] == "frame0"]), np.full((2, 3), 100.0)).any()


class TestSaturation:
    def frames(self):
        """Stars of which the brightest saturate, at different places of two exposures, one of them less deep."""
        solution, stars, flux = scene(4, rolls=(0, 1, -1, 2), spread=5)
        depth = [0.3, 1.0, 1.0, 1.0]
        rng = np.random.default_rng(1)
        out = []
        for d, e in zip(depth, expose(solution, stars, flux * 3), strict=True):
            data = d * e.data + rng.normal(0, 1, SHAPE)
            out.append(Exposure(e.name, np.minimum(data, 2500), saturation=2500.0))
        scale = {f"frame{i}": 1 / d for i, d in enumerate(depth)}
        return solution, stars, flux * 3, out, scale

    @pytest.mark.parametrize("method", [pytest.param("mean", marks=pytest.mark.slow), "clipped"])
    def test_the_short_exposure_fills_the_cores(self, method):
        solution, stars, flux, frames, scale = self.frames()
        mosaic = coadd(frames, solution, scale=scale, method=method, match_background=False)
        xy = stars - mosaic.offset
        unknown = [replace(f, saturation=None) for f in frames]
        cut = coadd(unknown, solution, scale=scale, match_background=False)
        bright = [i for i in covered(cut, xy) if flux[i] > 6e4]
        assert len(bright) > 10
        spots = tuple(np.round(xy[bright]).astype(int).T[::-1])
        assert np.all(mosaic.footprint[spots] == 1)
        assert np.all(mosaic.data[spots] > 1.3 * cut.data[spots])
        assert not np.any(mosaic.flags[spots] & PixelFlag.SATURATED)

    def test_saturated_everywhere_is_kept_and_flagged(self):
        solution, stars, flux, frames, _ = self.frames()
        mosaic = coadd(frames[1:], solution, match_background=False)
        xy = stars - mosaic.offset
        unknown = coadd([replace(f, saturation=None) for f in frames[1:]], solution)
        bright = [i for i in covered(unknown, xy) if flux[i] > 8e4]
        assert len(bright) > 5
        spots = tuple(np.round(xy[bright]).astype(int).T[::-1])
        assert np.all(mosaic.flags[spots] & PixelFlag.SATURATED)
        assert np.all(mosaic.data[spots] > 1500)

    def test_nothing_rings_beside_flat_tops(self):
        identity = StandIn({"a": np.array([[1.0, 0, 0.4], [0, 1, 0.3]])}, {"a": Distortion(np.zeros((2, 3)), SHAPE)})
        image = np.minimum(star_image(np.array([[200.0, 150]]), np.array([3e6])), 1e4)
        image[150:200, 200] = 1e4  # with a trail of charge
        for saturation, dark in ((1e4, -10), (None, -300)):
            mosaic = coadd([Exposure("a", image, saturation=saturation)], identity, **FLAT)
            assert (np.nanmin(mosaic.data) < dark) == (saturation is None)

    def test_cores_of_single_exposures_survive(self):
        solution, stars, flux = scene(1)
        (frame,) = expose(solution, stars, flux)
        mosaic = coadd([replace(frame, saturation=1e9)], solution)
        check_stars(mosaic, stars - mosaic.offset, flux)


class TestBackground:
    @pytest.mark.slow
    def test_gradients_leave_no_steps(self):
        """Skies with one gradient and different levels: flat residuals to less than the noise, whatever overlaps."""
        solution, stars, flux = scene(6, rolls=(0, 1, -1, 2, -2, 1), spread=40)
        rng = np.random.default_rng(2)
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
        exposures = []
        for i, e in enumerate(expose(solution, stars, flux)):
            reference = solution[e.name].correct(np.column_stack([x.ravel(), y.ravel()]).astype(float))
            glow = (0.02 * reference[:, 0] + 0.01 * reference[:, 1]).reshape(SHAPE)
            exposures.append(Exposure(e.name, e.data + rng.normal(0, 2, SHAPE) + 100 + 30 * i + glow))
        mosaic = coadd(exposures, solution, **{**FLAT, "match_background": True})
        gy, gx = np.mgrid[: mosaic.shape[0], : mosaic.shape[1]]
        rest = mosaic.data - 0.02 * (gx + mosaic.offset[0]) - 0.01 * (gy + mosaic.offset[1])
        for sx, sy in stars - mosaic.offset:
            rest[np.hypot(gx - sx, gy - sy) < 6 * SIGMA] = np.nan
        blocks = [
            np.nanmedian(rest[r : r + 32, c : c + 32])
            for r in range(0, rest.shape[0] - 32, 32)
            for c in range(0, rest.shape[1] - 32, 32)
            if (mosaic.footprint[r : r + 32, c : c + 32] > 0).all()
        ]
        assert np.std(blocks) < np.sqrt(np.nanmedian(mosaic.variance)) < 2


class TestFlux:
    @pytest.mark.slow
    def test_flux_across_a_field_with_20_px_of_distortion(self):
        """Ours within 0.3 %, beside reproject's own function on the same gwcs, which conserves surface brightness."""
        solution, stars, flux, exposures, together = plain()
        assert together.header["CONSERVE"] == "flux"
        ratios = {"ours": [], "plain": []}
        for frame in exposures:
            mosaic = coadd([frame], solution)
            xy = stars - mosaic.offset
            chosen = covered(mosaic, xy)
            wcs = mosaic.wcs
            wcs.array_shape = mosaic.shape
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # numpy's, from the corners outside the distortion
                other, _ = reproject_interp((frame.data, solution[frame.name].wcs), wcs, order="bicubic")
            for key, image in (("ours", mosaic.data.astype(float)), ("plain", np.nan_to_num(other))):
                fits = [fit_star(image, xy[i], flux[i]) for i in chosen]
                ratios[key] += [f / flux[i] for i, (_, f) in zip(chosen, fits, strict=True)]
                if key == "ours":
                    assert max(np.abs(place - xy[i]).max() for i, (place, _) in zip(chosen, fits, strict=True)) < 0.01
        assert len(ratios["ours"]) > 150
        assert np.abs(np.array(ratios["ours"]) - 1).max() < 0.003
        assert np.std(ratios["plain"]) > 0.02


def test_header_says_how(tmp_path):
    solution, *_, exposures, _ = plain()
    mosaic = coadd(exposures, solution, weights=None, order=1, planes="all")
    header = mosaic.to_hdulist()[0].header
    assert (header["WEIGHTS"], header["SCALEBY"], header["EXTRAPOL"]) == ("equal", "exptime", "flag")
    assert header["NOISECOR"] == pytest.approx(1.5, rel=0.02)  # pixels are not of one size
    mosaic.write(tmp_path / "m.fits")
    np.testing.assert_array_equal(fits.getdata(tmp_path / "m.fits", "FLAGS"), mosaic.flags)


def _turned(solution, scale, angle=0.3):
    """A grid over the middle of the field, with pixels `scale` times those of the reference plane."""
    grid, step = WCS(naxis=2), scale * np.sqrt(np.abs(np.linalg.det(solution.sky.matrix[:, :2])))
    centre = solution.sky.to_sky(np.array([[200.0, 150]]))[0]
    grid.wcs.ctype, grid.wcs.crval = ["RA---TAN", "DEC--TAN"], [centre.ra.deg, centre.dec.deg]
    grid.wcs.cd = step * np.array([[-np.cos(angle), np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    grid.array_shape = int(300 / scale), int(300 / scale)
    grid.wcs.crpix = np.array(grid.array_shape) / 2
    return grid


@pytest.mark.parametrize(
    "scale", [None, pytest.param(0.5, marks=pytest.mark.sets), pytest.param(2, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    "settings",
    [
        {"order": 1},
        {"order": 3},
        pytest.param({"algorithm": "drizzle"}, marks=pytest.mark.slow),
        pytest.param({"algorithm": "adaptive"}, marks=pytest.mark.slow),
    ],
)
def test_noise_of_sums(settings, scale):
    """NOISECOR is the noise of the sum over a box over what VAR says, whatever the size of the pixels."""
    if settings.get("algorithm") == "drizzle":
        pytest.importorskip("drizzle")
    solution, *_ = scene(1, rolls=(3,), peak=5.0)
    grid = None if scale is None else _turned(solution, scale)
    box, ratios = {None: 24, 0.5: 40, 2: 12}[scale], []
    for seed in range(4 if scale is None else 2 if scale == 0.5 else 8):
        frame = Exposure("frame0", np.random.default_rng(seed).normal(0, 1, SHAPE), uncertainty=np.ones(SHAPE))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "pixels of the grid are", AssumptionWarning)
            mosaic = coadd([frame], solution, grid=grid, **{**FLAT, **settings})
        ny, nx = (n // box * box for n in mosaic.shape)
        data, variance = (p[:ny, :nx].reshape(ny // box, box, nx // box, box) for p in (mosaic.data, mosaic.variance))
        ratios.append((data.sum(axis=(1, 3)) / np.sqrt(variance.sum(axis=(1, 3)))).ravel())
    ratio = np.nanstd(np.concatenate(ratios))
    # 3 % by chance, 4 % by the edges of the box, which count for more where pixels share much
    assert ratio == pytest.approx(mosaic.header["NOISECOR"], rel=0.15 if scale == 0.5 else 0.08)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"order": 1, "method": "clipped"}, marks=pytest.mark.sets),
        pytest.param({"method": "median", "grid": 0.6}, marks=pytest.mark.sets),
    ],
)
def test_photons_of_stars_are_in_the_variance_if_the_gain_is_known(settings):
    solution, stars, flux = scene(4, rolls=(0, 2, -3, 5), peak=5.0)
    rng, gain = np.random.default_rng(3), 0.5
    clean = [e.data for e in expose(solution, stars, flux)]
    grid = {"grid": _turned(solution, settings["grid"])} if "grid" in settings else {}
    draws = []
    for _ in range(10):
        frames = [
            Exposure(f"frame{i}", rng.poisson((image + 50) * gain) / gain, gain=gain) for i, image in enumerate(clean)
        ]
        draws.append(coadd(frames, solution, match_background=False, **settings | grid))
    data = np.array([m.data for m in draws])
    measured, stated = data.var(axis=0, ddof=1), np.mean([m.variance for m in draws], axis=0)
    whole, mean = draws[0].footprint == 4, data.mean(axis=0)
    for low, high in ((0, 60), (300, 1000), (1000, 4000)):
        some = whole & (mean > low * np.nanmedian(mean) / 50) & (mean < high * np.nanmedian(mean) / 50)
        assert np.count_nonzero(some) > 40
        assert measured[some].mean() == pytest.approx(stated[some].mean(), rel=0.15), (low, high)


@pytest.mark.slow
def test_strehl_ratios_are_no_scales():
    """Equal exposures of Strehl ratios of 0.14 to 0.46: of six those of 0.78 to 1.40 were believed."""
    rng, base, exposures = np.random.default_rng(0), None, []
    for k, r0 in enumerate([0.32, 0.5, 0.6, 0.4]):
        telescope = pupil_images.Telescope(rng, r0=r0, screens=30)
        base = base or pupil_images.frame(telescope, rng, n=60, apart=40.0, snr=(30, 1500))
        xy = base.xy + rng.uniform(-30, 30, 2)
        there = np.all((xy > 5) & (xy < 635), axis=1)
        frame = pupil_images.frame(telescope, rng, xy=xy[there], flux=base.flux[there])
        exposures.append(Exposure(f"e{k}", frame.data.astype(np.float32), gain=1.0))
    solution = solve(match(measure(exposures), exposures=exposures), degree=2)
    factors, _ = flux_scales(exposures, "stars", {each.name: solution[each.name] for each in exposures})
    assert np.abs(np.array(list(factors.values())) - 1).max() < 0.02
