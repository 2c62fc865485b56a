"""Co-addition: positions, fluxes, edges and header of mosaics of synthetic frames with a 20 px distortion."""

import gzip
import itertools
from dataclasses import fields, replace
from inspect import signature

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty, VarianceUncertainty
from astropy.time import Time
from astropy.utils.exceptions import AstropyUserWarning
from astropy.wcs import WCS
from caller_warnings import warns_here
from stacks import SHAPE, SIGMA, StandIn, check_stars, covered, expose, plain, scene, star_image

from legdistort.coaddition.grids import read_grid, reference_grid
from legdistort.coaddition.mosaic import Mosaic
from legdistort.coaddition.mosaic_header import mosaic_header
from legdistort.coaddition.mosaicking import coadd
from legdistort.coaddition.options import CoaddOptions
from legdistort.coaddition.resampling.pixel_maps import map_exposure, tabulate, trace
from legdistort.exceptions import AssumptionWarning, DiskFullError, InputError
from legdistort.geometry import similarity
from legdistort.geometry.basis import from_tensor
from legdistort.geometry.distortion import Distortion
from legdistort.geometry.models import outside
from legdistort.inputs.exposure_files import read_exposures
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.filters import fill_bad
from legdistort.runtime.checks import options_from
from legdistort.runtime.words import PLANES


class TestReferencePlane:
    def test_stars_have_true_positions_and_fluxes(self):
        _, stars, flux, _, mosaic = plain()
        check_stars(mosaic, stars - mosaic.offset, flux)

    def test_there_are_no_ghosts(self):
        _, stars, flux, _, mosaic = plain()
        y, x = np.mgrid[: mosaic.shape[0], : mosaic.shape[1]]
        near = np.zeros(mosaic.shape, dtype=bool)
        for sx, sy in stars - mosaic.offset:
            near |= np.hypot(x - sx, y - sy) < 9 * SIGMA
        away = np.abs(mosaic.data[~near & np.isfinite(mosaic.data)])
        assert away.max() < 1e-3 * flux.max() / (2 * np.pi * SIGMA**2)

    def test_a_distortion_that_folds_back_outside_makes_no_ghost(self):
        tensor = np.zeros((2, 4, 4))
        tensor[1, 0, [1, 3]] = np.array([0.06, -0.06]) * SHAPE[0] / 2  # 1.15 v - 0.15 v^3 folds at v = 1.6
        distortion = Distortion(from_tensor(tensor), SHAPE)
        m = np.array([[1, -1], [1, 1]]) / np.sqrt(2)
        solution = StandIn({"a": np.column_stack([m, [0, 0]])}, {"a": distortion})
        mosaic = coadd([Exposure("a", np.ones(SHAPE))], solution)
        y, x = np.nonzero(mosaic.footprint)
        q = similarity.apply(solution.poses["a"], np.stack([x, y], 1) + mosaic.offset)
        assert np.all((q > -5) & (q < np.array(SHAPE[::-1]) + 5))
        corner = similarity.apply(solution.poses["a"], np.array([mosaic.offset], dtype=float))
        assert np.all((distortion(corner) > 0) & (distortion(corner) < SHAPE[::-1]))  # here it would have been

    def test_footprint_counts_detectors(self):
        solution, _, _, exposures, mosaic = plain()
        ny, nx = mosaic.shape
        gx, gy = np.meshgrid(np.arange(nx), np.arange(ny))
        reference = np.stack([gx.ravel(), gy.ravel()], 1) + mosaic.offset
        expected = np.zeros(nx * ny, dtype=int)
        for e in exposures:
            p = solution[e.name].distort(reference)
            expected += np.all((p >= 0) & (p <= np.array(SHAPE[::-1]) - 1), axis=1)
        np.testing.assert_array_equal(mosaic.footprint.ravel(), expected)
        np.testing.assert_array_equal(np.isnan(mosaic.data), mosaic.footprint == 0)

    def test_grid_is_the_bounding_box(self):
        mosaic = plain()[-1]
        seen = mosaic.footprint > 0
        for edge in (seen[:2], seen[-2:], seen[:, :2], seen[:, -2:]):
            assert edge.any()
        identity = StandIn({"a": similarity.identity()}, {"a": Distortion(np.zeros((2, 1)), SHAPE)})
        grid = reference_grid([identity["a"]], None)
        assert grid.shape == SHAPE
        assert grid.offset == (0, 0)

    def test_identity_returns_the_image(self):
        image = np.random.default_rng(0).normal(size=SHAPE)
        identity = StandIn({"a": similarity.identity()}, {"a": Distortion(np.zeros((2, 3)), SHAPE)})
        for order in (0, 1, 3):
            mosaic = coadd([Exposure("a", image)], identity, order=order)
            np.testing.assert_allclose(mosaic.data, image, atol=1e-6)

    def test_order_1_is_worse_and_named_as_in_reproject(self):
        solution, stars, _, exposures, mosaic = plain()
        bilinear = coadd(exposures, solution, order="bilinear")
        np.testing.assert_array_equal(bilinear.data, coadd(exposures, solution, order=1).data)
        xy = stars - mosaic.offset
        peaks = [m.data[tuple(np.round(xy[covered(mosaic, xy)]).astype(int).T[::-1])] for m in (mosaic, bilinear)]
        assert np.mean(peaks[1] / peaks[0]) < 0.95

    @pytest.mark.slow
    def test_surface_brightness_is_left_alone_on_request(self):
        solution, *_ = plain()
        flat = [Exposure(name, np.full(SHAPE, 7.0)) for name in solution.poses]
        flux = coadd(flat, solution, match_background=False)
        brightness = coadd(flat, solution, match_background=False, conserve="surface_brightness")
        seen = brightness.footprint > 0
        np.testing.assert_allclose(brightness.data[seen], 7, rtol=1e-6)
        assert np.ptp(flux.data[seen]) > 0.5
        matched = coadd(flat, solution)
        np.testing.assert_allclose(matched.data[seen], 7, rtol=1e-6)  # the sky stays flat

    @pytest.mark.slow
    def test_total_flux_is_the_sum_over_the_detector(self):
        solution, *_ = plain()
        name = "frame0"
        image = star_image(np.array([[80.0, 60], [320, 240]]), np.array([1e4, 2e4]))
        for algorithm in ("interp", "adaptive", "exact"):
            mosaic = coadd([Exposure(name, image)], solution, algorithm=algorithm, match_background=False)
            assert np.nansum(mosaic.data) == pytest.approx(3e4, rel=2e-3), algorithm

    @pytest.mark.parametrize("algorithm", ["adaptive", pytest.param("exact", marks=pytest.mark.slow)])
    def test_other_algorithms(self, algorithm):
        solution, stars, flux, exposures, _ = plain()
        mosaic = coadd(exposures[:1], solution, algorithm=algorithm)
        check_stars(mosaic, stars - mosaic.offset, flux, position=0.04, relative=0.01)


class TestSky:
    def test_header_gives_the_sky_of_the_solution(self):
        solution, stars, *_, mosaic = plain()
        sky = mosaic.wcs.pixel_to_world(*(stars - mosaic.offset).T)
        assert solution.sky.to_sky(stars).separation(sky).max() < 1e-9 * u.deg

    @pytest.mark.slow
    def test_other_grid_through_the_gwcs(self):
        solution, stars, flux, exposures, _ = plain()
        grid = WCS(naxis=2)
        grid.wcs.ctype = ["GLON-CAR", "GLAT-CAR"]
        centre = solution.sky.to_sky(np.array([[200.0, 150]]))[0].galactic
        grid.wcs.crval = [centre.l.deg, 0]
        grid.wcs.crpix = [330, 330 - centre.b.deg / 6e-5]
        grid.wcs.cdelt = [-6e-5, 6e-5]
        grid.array_shape = (660, 660)
        mosaic = coadd(exposures, solution, grid=grid)
        assert mosaic.offset is None
        xy = np.stack(grid.world_to_pixel(solution.sky.to_sky(stars)), 1)
        check_stars(mosaic, xy, flux)
        # The footprint by the exact chain, gwcs and all.
        gx, gy = (a.ravel() for a in np.meshgrid(np.arange(0, 660, 9), np.arange(0, 660, 9)))
        expected = np.zeros(len(gx), dtype=int)
        for e in exposures:
            p = np.stack(solution[e.name].wcs.world_to_pixel(grid.pixel_to_world(gx, gy).icrs), 1)
            expected += np.all((p >= 0) & (p <= np.array(SHAPE[::-1]) - 1), axis=1)
        np.testing.assert_array_equal(mosaic.footprint[gy, gx], expected)

    def test_own_grid_given_back_is_the_same_mosaic(self):
        solution, _, _, exposures, mosaic = plain()
        header = mosaic.to_hdulist()["SCI"].header
        again = coadd(exposures, solution, grid=header)
        np.testing.assert_allclose(again.data, mosaic.data, rtol=1e-4, atol=0.01)

    def test_dates_are_those_of_the_exposures_not_of_the_grid(self):
        solution, _, _, exposures, mosaic = plain()
        header = mosaic.to_hdulist()["SCI"].header
        header["DATE-OBS"], header["MJD-OBS"] = "2001-01-01T00:00:00", 51910.0
        again = coadd(exposures, solution, grid=header).to_hdulist()["SCI"].header
        assert again.get("DATE-OBS") == mosaic.header.get("DATE-OBS")
        assert "MJD-OBS" not in again

    def test_without_sky_the_world_is_the_reference_plane(self):
        solution, stars, *_ = plain()
        blind = StandIn(solution.poses, solution.distortions)
        mosaic = coadd(plain()[3], blind)
        world = np.stack(mosaic.wcs.pixel_to_world_values(*(stars - mosaic.offset).T), 1)
        np.testing.assert_allclose(world, stars, atol=1e-9)

    def test_pixel_maps_agree_with_the_exact_chain(self):
        solution = plain()[0]
        grid = reference_grid(list(solution), solution.sky)
        rng = np.random.default_rng(3)
        for name in solution.poses:
            table = tabulate(lambda p, name=name: trace(p, solution[name], grid), (0, 0), grid.shape)
            planes = table(slice(0, grid.shape[0]), slice(0, grid.shape[1]))
            y, x = rng.integers(0, 280, (2, 500))
            exact = trace(np.stack([x, y], 1).astype(float), solution[name], grid)
            np.testing.assert_allclose(planes[:, y, x].T, exact, atol=1e-9)
            # The area is the derivative of the chain.
            h, hx, xy = 1e-4, np.array([1e-4, 0]), np.stack([x, y], 1) + np.array(grid.offset, dtype=float)
            dx = (solution[name].distort(xy + hx) - solution[name].distort(xy - hx)) / (2 * h)
            dy = (solution[name].distort(xy + hx[::-1]) - solution[name].distort(xy - hx[::-1])) / (2 * h)
            ok = np.isfinite(dx + dy).all(axis=1)
            area = np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])
            np.testing.assert_allclose(exact[ok, 4], area[ok], rtol=1e-6)

    def test_tables_are_as_large_as_the_function_needs(self):
        def function(p):
            x, y = (p[:, 0] - 100) / 200, (p[:, 1] - 40) / 50
            return np.stack([x**5 + y, 3 + 0 * x], 1)

        table = tabulate(function, (3, 5), (80, 300))
        assert table.coefficients.shape == (2, 2, 6)  # degrees 1 in y, 5 in x
        y, x = np.mgrid[5:85, 3:303]
        exact = function(np.stack([x.ravel(), y.ravel()], 1)).T.reshape(2, 80, 300)
        np.testing.assert_allclose(table(slice(5, 85), slice(3, 303)), exact, atol=1e-11)
        along = table.along_edge(slice(10, 14), slice(20, 25))
        inner = exact[:, 5:9, 17:22]
        edge = [inner[:, [0, -1]].reshape(2, -1), inner[:, :, [0, -1]].reshape(2, -1)]
        np.testing.assert_allclose(along, np.concatenate(edge, axis=1), atol=1e-11)

    @pytest.mark.parametrize("axis", [pytest.param(0, marks=pytest.mark.slow), 1])
    def test_pieces_know_which_pixels_lie_on_the_detector(self, axis):
        """Also where the distortion, beyond where it is valid, folds back onto the detector, a long and narrow one."""
        shape, far = ((120, 400), 200) if axis else ((400, 120), -200)
        tensor = np.zeros((2, 4, 4))
        orders = (0, [1, 3]) if axis else ([1, 3], 0)
        tensor[axis][orders] = np.array([0.06, -0.06]) * shape[1 - axis] / 2
        distortion = Distortion(from_tensor(tensor), shape)
        turn = np.array([[1, -1], [1, 1]]) / np.sqrt(2)
        poses = {name: np.column_stack([turn, [shift, -shift]]) for name, shift in (("a", 0), ("b", far))}
        solution = StandIn(poses, dict.fromkeys(poses, distortion))
        grid = reference_grid(list(solution), None)
        whole = map_exposure(solution["a"], grid)
        assert whole.corners is None
        y, x = np.mgrid[: grid.shape[0], : grid.shape[1]]
        planes = trace(np.stack([x.ravel(), y.ravel()], 1).astype(float), solution["a"], grid).T.reshape(5, *grid.shape)
        on_it = ~outside((-1e-6, shape[1] - 1 + 1e-6, -1e-6, shape[0] - 1 + 1e-6), *planes[:2])
        assert np.count_nonzero(on_it & outside(whole.valid, *planes[2:4])) > 100  # ghosts
        seen = np.zeros(grid.shape, dtype=bool)
        for row, column in itertools.product(range(0, grid.shape[0], 16), range(0, grid.shape[1], 16)):
            found = whole.piece((slice(row, row + 16), slice(column, column + 16)), margin=2)
            if found is not None:
                piece, (rows, columns) = found
                seen[piece.window] = piece.inside
                xy = piece.xy + np.array([columns.start, rows.start]).reshape(2, 1, 1)
                np.testing.assert_allclose(xy, planes[:2][:, *piece.window], atol=1e-6)
        np.testing.assert_array_equal(seen, on_it & ~outside(whole.valid, *planes[2:4]))

    def test_a_rough_function_is_evaluated_everywhere(self):
        def rough(p):
            return np.stack([np.sin(3 * p[:, 0]), np.floor(p[:, 1] / 3)], 1)

        y, x = np.mgrid[:50, :70]
        out = tabulate(rough, (5, 6), (50, 70))(slice(6, 56), slice(5, 75))
        np.testing.assert_allclose(out, np.stack([np.sin(3.0 * (x + 5)), (y + 6) // 3]), atol=1e-12)


class TestCombination:
    @pytest.mark.parametrize("method", [pytest.param("median", marks=pytest.mark.slow), "clipped"])
    def test_hot_pixel_and_trail_are_rejected(self, method):
        solution, stars, flux = scene(4, rolls=(0, 1, -1, 2), spread=5)
        rng = np.random.default_rng(5)
        exposures = [Exposure(e.name, e.data + rng.normal(0, 1, SHAPE)) for e in expose(solution, stars, flux)]
        clean = coadd(exposures, solution, method=method)
        spoilt = exposures[1].data.copy()
        spoilt[100, 130] += 1e5
        spoilt[60, :] += 3e3
        exposures[1] = Exposure("frame1", spoilt)
        mosaic, mean = coadd(exposures, solution, method=method), coadd(exposures, solution)
        ok = clean.footprint == 4
        assert np.abs(mosaic.data - clean.data)[ok].max() < 200  # images differ in sharpness a little
        assert np.nanmax(np.abs(mean.data - clean.data)) > 1e4
        xy = stars - clean.offset
        chosen = covered(mean, xy)
        check_stars(clean, xy, flux, position=0.05, relative=0.03, chosen=chosen)

    @pytest.mark.slow
    def test_clipping_spares_stars_of_different_sharpness(self):
        solution, stars, flux = scene(peak=5.0)
        exposures = expose(solution, stars, flux)
        noisy = [
            Exposure(e.name, e.data + np.random.default_rng(i).normal(0, 1, SHAPE)) for i, e in enumerate(exposures)
        ]
        clipped, mean = coadd(noisy, solution, method="clipped"), coadd(noisy, solution)
        lost = (mean.footprint - clipped.footprint)[mean.footprint >= 3]
        assert lost.mean() < 1e-3
        check_stars(
            clipped,
            stars - clipped.offset,
            flux,
            position=0.05,
            relative=0.03,
            chosen=covered(mean, stars - mean.offset),
        )

    def test_backgrounds_are_matched_through_overlaps(self):
        solution, _, _, exposures, clean = plain()
        levels = [100.0, 130.0, 90.0, 115.0]
        raised = [Exposure(e.name, e.data + level) for e, level in zip(exposures, levels, strict=True)]
        mosaic = coadd(raised, solution)
        assert mosaic.header["SKYLEVEL"] == pytest.approx(np.mean(levels), abs=1)
        ok = mosaic.footprint > 0
        np.testing.assert_allclose(mosaic.data[ok] - np.mean(levels), clean.data[ok], atol=1.0)
        steps = coadd(raised, solution, match_background=False)
        assert np.abs(steps.data[ok] - mosaic.data[ok]).max() > 10

    @pytest.mark.slow
    def test_variance_is_that_of_the_pixels(self):
        solution, *_ = scene(4, rolls=(0, 1, -1, 2))
        rng = np.random.default_rng(8)
        sigmas = dict(zip(solution.poses, (1.0, 2.0, 1.5, 3.0), strict=True))
        for settings in ({}, {"order": 1}, {"method": "median"}, {"method": "clipped"}, {"algorithm": "adaptive"}):
            for given in (True, False) if not settings else (False,):
                exposures = [
                    Exposure(n, rng.normal(0, s, SHAPE), uncertainty=np.full(SHAPE, s) if given else None)
                    for n, s in sigmas.items()
                ]
                mosaic = coadd(exposures, solution, **settings)
                ok = mosaic.footprint == 4
                pull = mosaic.data[ok] / np.sqrt(mosaic.variance[ok])
                # A median of unequal errors does better than the formula for equal ones.
                low = 0.75 if settings.get("method") == "median" else 0.95
                assert low < pull.std() < 1.05, (settings, given)

    @pytest.mark.parametrize("sigma", [0.3, 1.0, 12.5])
    def test_noise_of_whole_numbers(self, sigma):
        solution, stars, flux = scene(1)
        (frame,) = expose(solution, stars, flux)
        whole = np.rint(frame.data + np.random.default_rng(4).normal(100, sigma, SHAPE))
        mosaic = coadd([Exposure("frame0", whole)], solution, order=0, conserve="surface_brightness")
        true = np.hypot(sigma, 1 / np.sqrt(12))
        assert np.sqrt(np.nanmedian(mosaic.variance)) == pytest.approx(true, rel=0.2)

    def test_weights(self):
        solution, *_ = scene(2)
        two = [Exposure("frame0", np.full(SHAPE, 1.0)), Exposure("frame1", np.full(SHAPE, 4.0))]
        settings = {"conserve": "surface_brightness", "match_background": False}
        mosaic = coadd(two, solution, weights={"frame0": 2, "frame1": 1}, **settings)
        np.testing.assert_allclose(mosaic.data[mosaic.footprint == 2], 2, rtol=1e-5)
        rng = np.random.default_rng(1)
        noisy = [Exposure(f"frame{i}", rng.normal(v, s, SHAPE)) for i, (v, s) in enumerate([(0, 1), (30, 3)])]
        mosaic = coadd(noisy, solution, **settings)
        assert np.median(mosaic.data[mosaic.footprint == 2]) == pytest.approx(3, abs=0.2)

    def test_exposure_times(self):
        solution, stars, flux = scene(2)
        short, long = expose(solution, stars, flux)
        two = [
            Exposure("frame0", short.data * 10, exposure_time=10.0),
            Exposure("frame1", long.data * 30, exposure_time=30.0),
        ]
        mosaic = coadd(two, solution)
        assert mosaic.header["EXPTIME"] == 20
        assert mosaic.header["TEXPTIME"] == 40
        check_stars(mosaic, stars - mosaic.offset, 20 * flux)
        with warns_here(AssumptionWarning, match="no exposure time known for frame1"):
            coadd([two[0], long], solution)

    def test_bad_pixels_leave_no_trace(self):
        solution, stars, flux, exposures, clean = plain()
        data, mask = exposures[0].data.copy(), np.zeros(SHAPE, dtype=bool)
        rng = np.random.default_rng(2)
        bad = rng.random(SHAPE) < 0.01
        bad[:, 100] = True
        data[bad] = 1e6
        data[50, 50:53] = np.nan
        mask |= bad
        one = coadd([Exposure("frame0", data, mask=mask)], solution, match_background=False)
        good = coadd([exposures[0]], solution, match_background=False)
        kept = one.footprint == 1
        assert 0.8 < kept.sum() / good.footprint.sum() < 0.98
        assert np.abs(one.data - good.data)[kept].max() < 0.05 * np.nanmax(good.data)
        many = coadd([Exposure("frame0", data, mask=mask), *exposures[1:]], solution)
        xy = stars - clean.offset
        check_stars(many, xy, flux, position=0.05, relative=0.03, chosen=covered(clean, xy))

    def test_fill_bad(self):
        plane = np.add.outer(2.0 * np.arange(30), np.arange(40))
        bad = np.zeros(plane.shape, dtype=bool)
        bad[10, 10] = bad[0, 0] = bad[20:28, 20:30] = True
        spoilt = np.where(bad, np.nan, plane)
        filled = fill_bad(spoilt, bad)
        assert filled[10, 10] == pytest.approx(plane[10, 10])
        assert np.isfinite(filled).all()
        np.testing.assert_array_equal(filled[~bad], plane[~bad])
        assert np.isnan(spoilt[10, 10])  # the input is left alone


class TestFile:
    def test_write_and_read(self, tmp_path):
        solution, stars, _, exposures, _ = plain()
        noisy = [Exposure(e.name, e.data, uncertainty=np.full(SHAPE, 2.0), header=e.header) for e in exposures]
        mosaic = coadd(noisy, solution)
        mosaic.write(tmp_path / "m.fits")
        assert [p.name for p in tmp_path.iterdir()] == ["m.fits"]
        with fits.open(tmp_path / "m.fits") as hdulist:
            assert [h.name for h in hdulist] == ["SCI", "UNCERT", "MASK", "FOOTPRINT"]
            header = hdulist[0].header
            assert [h.header["BUNIT"] for h in hdulist] == ["adu", "adu", "", ""]
            # Source Extractor 2.25 and its kin, without CFITSIO, open no file that has a table of compressed tiles.
            assert not any(isinstance(h, fits.CompImageHDU) for h in hdulist)
            assert header["BUNIT"] == "adu"
            assert header["NCOMBINE"] == 4
            assert (-header["LTV1"], -header["LTV2"]) == mosaic.offset
            for hdu in hdulist:
                sky = WCS(hdu.header).pixel_to_world(*(stars - mosaic.offset).T)
                assert solution.sky.to_sky(stars).separation(sky).max() < 1e-9 * u.deg
            np.testing.assert_array_equal(hdulist["UNCERT"].data, np.sqrt(mosaic.variance))
            np.testing.assert_array_equal(hdulist["MASK"].data, np.isnan(mosaic.data))
            np.testing.assert_array_equal(hdulist["FOOTPRINT"].data, mosaic.footprint)
        (back,) = read_exposures(tmp_path / "m.fits")
        np.testing.assert_array_equal(back.data, mosaic.data)
        assert np.median(mosaic.variance[mosaic.footprint == 4]) == pytest.approx(0.7, abs=0.3)
        np.testing.assert_allclose(back.uncertainty**2, mosaic.variance, rtol=1e-5)

    @pytest.mark.parametrize(
        "planes",
        [
            pytest.param((), marks=pytest.mark.slow),
            "all",
            pytest.param(("UNCERT", "MASK"), marks=pytest.mark.slow),
            pytest.param(["CONTEXT"], marks=pytest.mark.sets),
            pytest.param("WEIGHT", marks=pytest.mark.sets),
        ],
    )
    def test_planes_that_are_asked_for(self, planes, tmp_path):
        solution, _, _, exposures, _ = plain()
        mosaic = coadd(exposures, solution, planes=planes)
        whole = replace(mosaic, planes=tuple(PLANES))
        wanted = set(PLANES) if planes == "all" else {planes} if isinstance(planes, str) else set(planes)
        mosaic.write(tmp_path / "m.fits")
        with fits.open(tmp_path / "m.fits", checksum=True) as hdulist:
            assert {hdu.name for hdu in hdulist} == {"SCI"} | wanted
            expected = whole.to_hdulist()
            for hdu in hdulist:
                np.testing.assert_array_equal(hdu.data, expected[hdu.name].data)
                assert hdu.data.dtype.newbyteorder("=") == expected[hdu.name].data.dtype
        mosaic.write(tmp_path / "m.asdf")
        with asdf.open(tmp_path / "m.asdf") as file:
            others = {"data", "wcs", "exposures", "left_out", "offset", "header"}
            assert set(file["mosaic"]) - others == {PLANES[name] for name in wanted} - {"mask"}

    @pytest.mark.parametrize("planes", ["VARIANCE", ("UNCERT", "uncert"), [1]])
    def test_planes_that_there_are_not(self, planes):
        solution, _, _, exposures, _ = plain()
        with pytest.raises(InputError, match="planes must be one of 'UNCERT', 'MASK'"):
            coadd(exposures, solution, planes=planes)

    def test_the_file_is_that_of_the_hdulist(self, tmp_path, monkeypatch):
        *_, mosaic = plain()
        monkeypatch.setattr("legdistort.coaddition.mosaic._ROWS", 100)
        mosaic = replace(mosaic, planes=tuple(PLANES))
        mosaic.to_hdulist().writeto(tmp_path / "whole.fits", checksum=True)
        for name in ("rows.fits", "packed.fits.gz"):
            mosaic.write(tmp_path / name)
        rows = (tmp_path / "rows.fits").read_bytes()
        assert gzip.decompress((tmp_path / "packed.fits.gz").read_bytes()) == rows
        with fits.open(tmp_path / "whole.fits") as whole, fits.open(tmp_path / "rows.fits", checksum=True) as mine:
            assert len(whole) == len(mine)  # a checksum that is not true would be warned of
            assert not fits.FITSDiff(whole, mine, ignore_keywords=["CHECKSUM"], ignore_comments=["DATASUM"]).diff_hdus

    @pytest.mark.parametrize("name", ["UNCERT", "MASK"])
    def test_wrong_checksums_are_noticed(self, tmp_path, name):
        plain()[-1].write(tmp_path / "m.fits")
        with fits.open(tmp_path / "m.fits") as hdulist:
            place = hdulist[name].fileinfo()["datLoc"]
        raw = bytearray((tmp_path / "m.fits").read_bytes())
        raw[place + 3] ^= 1
        (tmp_path / "m.fits").write_bytes(raw)
        with pytest.warns(AstropyUserWarning, match=r"(Data|Check)sum verification failed for HDU"):
            fits.open(tmp_path / "m.fits", checksum=True).close()

    def test_ccddata_finds_unit_errors_mask_and_wcs(self, tmp_path):
        solution, stars, _, exposures, _ = plain()
        mosaic = coadd([replace(e, uncertainty=np.full(SHAPE, 2.0)) for e in exposures], solution)
        mosaic.write(tmp_path / "m.fits")
        direct = mosaic.to_ccddata()
        assert np.shares_memory(direct.data, mosaic.data)
        file = CCDData.read(tmp_path / "m.fits", hdu_mask="MASK", hdu_uncertainty="UNCERT")
        assert (type(file.uncertainty), type(direct.uncertainty)) == (StdDevUncertainty, VarianceUncertainty)
        assert file.uncertainty.unit == u.adu
        np.testing.assert_array_equal(file.uncertainty.array, np.sqrt(mosaic.variance))
        np.testing.assert_array_equal(direct.uncertainty.array, mosaic.variance)
        for ccd in (CCDData.read(tmp_path / "m.fits"), file, direct):
            assert ccd.unit == u.adu
            np.testing.assert_array_equal(ccd.data, mosaic.data)
            np.testing.assert_array_equal(ccd.mask, np.isnan(mosaic.data))
            assert ccd.mask.dtype == bool
            sky = ccd.wcs.pixel_to_world(*(stars - mosaic.offset).T)
            assert solution.sky.to_sky(stars).separation(sky).max() < 1e-9 * u.deg
            assert ccd.header["NCOMBINE"] == 4

    @pytest.mark.parametrize("name", ["VAR", "UNCERT"])
    def test_files_of_earlier_versions_are_read(self, tmp_path, name):
        """They had variances, and the first ones no mask."""
        solution, *_, exposures, _ = plain()
        noisy = [Exposure(e.name, e.data, uncertainty=np.full(SHAPE, 2.0), header=e.header) for e in exposures]
        mosaic = coadd(noisy, solution)
        header = mosaic.to_hdulist()[0].header
        planes = {name: mosaic.variance, "MASK": np.isnan(mosaic.data).astype("u1"), "WEIGHT": mosaic.weight,
                  "FOOTPRINT": mosaic.footprint, "FLAGS": mosaic.flags,
                  "CONTEXT": mosaic.context[0].view("i4")}  # fmt: skip
        if name == "VAR":
            del planes["MASK"]
        hdus = [fits.PrimaryHDU(mosaic.data, header), *(fits.ImageHDU(p, header, name=n) for n, p in planes.items())]
        if name == "UNCERT":
            hdus[1].header["UTYPE"] = "VarianceUncertainty"
        fits.HDUList(hdus).writeto(tmp_path / "old.fits")
        (old,) = read_exposures(tmp_path / "old.fits")
        np.testing.assert_allclose(old.uncertainty**2, mosaic.variance, rtol=1e-5)
        np.testing.assert_array_equal(old.mask, np.isnan(mosaic.data))
        assert read_grid(tmp_path / "old.fits").array_shape == mosaic.shape

    @pytest.mark.parametrize("unit", ["no unit", ""])
    def test_a_mosaic_without_a_unit_is_dimensionless(self, unit):
        *_, mosaic = plain()
        header = mosaic.header.copy()
        header["BUNIT"] = unit
        assert replace(mosaic, header=header).to_ccddata().unit == u.dimensionless_unscaled

    @pytest.mark.slow
    def test_times_of_the_exposures(self, tmp_path):
        solution, *_, exposures, _ = plain()
        clocks = [("DATE-OBS", "2024-03-01"), ("TIME-OBS", "22:00:00.5")], [("MJD-OBS", 60371.0)]
        clocks += [("DATE-BEG", "2024-03-02T00:10:00")], [("DATE-OBS", "2024-03-02T00:20:00"), ("TIME-OBS", "9")]
        timed = []
        for exposure, cards in zip(exposures, clocks, strict=True):
            header = fits.Header(cards)
            timed.append(Exposure(exposure.name, exposure.data, header=header, exposure_time=60.0))
        header = coadd(timed, solution).header
        assert header["DATE-BEG"] == header["DATE-OBS"] == "2024-03-01T22:00:00.500"
        assert header["DATE-END"] == "2024-03-02T00:21:00.000"
        starts = Time(["2024-03-01T22:00:00.5", "2024-03-02T00:00:00", "2024-03-02T00:10:00", "2024-03-02T00:20:00"])
        assert header["MJD-AVG"] == pytest.approx(np.mean(starts.mjd) + 30 / 86400, abs=1e-9)
        timed[0] = Exposure(timed[0].name, timed[0].data, header=fits.Header([("DATE-OBS", "?")]), exposure_time=60.0)
        assert "DATE-BEG" not in coadd(timed, solution).header  # of all or not at all

    def test_shares(self):
        """Of four exposures one is rejected at a hot pixel, where the flag says only that there is one."""
        solution, *_, exposures, _ = plain()
        spoilt = exposures[0].data.copy()
        spoilt[100:103, 100:103] += 1e5
        mosaic = coadd([Exposure(exposures[0].name, spoilt, header=exposures[0].header), *exposures[1:]], solution,
                       method="clipped")  # fmt: skip
        hit = (mosaic.flags & 4 > 0) & (mosaic.footprint == 3)
        assert hit.any()
        assert set(mosaic.rejected[hit].tolist()) == {25}
        assert not mosaic.rejected[mosaic.flags & 4 == 0].any()
        assert not mosaic.extrapolated[mosaic.flags & 1 == 0].any()
        assert mosaic.extrapolated[mosaic.flags & 1 > 0].all()
        assert mosaic.extrapolated.max() <= 100

    def test_asdf(self, tmp_path):
        solution, stars, _, exposures, _ = plain()
        mosaic = coadd(exposures, solution, planes="all")
        mosaic.write(tmp_path / "m.asdf")
        with asdf.open(tmp_path / "m.asdf", memmap=False) as file:
            tree = file["mosaic"]
            for plane in ("data", "variance", "weight", "footprint", "flags", "context"):
                np.testing.assert_array_equal(tree[plane], getattr(mosaic, plane))
            sky = tree["wcs"].pixel_to_world(*(stars - tree["offset"]).T)
            assert (tree["exposures"], tree["header"]["NCOMBINE"]) == (list(mosaic.exposures), 4)
        assert solution.sky.to_sky(stars).separation(sky).max() < 1e-9 * u.deg

    def test_a_file_is_not_overwritten_unasked(self, tmp_path):
        mosaic = plain()[-1]
        path = tmp_path / "m.fits"
        path.write_text("precious")
        with pytest.raises(InputError, match=r"m\.fits exists already; give overwrite=True"):
            mosaic.write(path)
        assert path.read_text() == "precious"
        mosaic.write(path, overwrite=True)
        assert fits.getdata(path).shape == mosaic.shape
        assert mosaic.write(tmp_path / "new" / "m.fits").is_file()

    def test_repr_shows_counts(self):
        mosaic = plain()[-1]
        ny, nx = mosaic.shape
        assert repr(mosaic) == f"<Mosaic: {nx} x {ny} px, 4 exposures>"


class TestBadInput:
    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"method": "sum"}, "method must be one of 'mean', 'median', 'clipped', got 'sum'"),
            ({"order": 7}, "order must be an integer from 0 to 5"),
            ({"order": "cubic"}, "got 'cubic'"),
            ({"algorithm": "lanczos"}, "algorithm must be one of"),
            ({"conserve": "mass"}, "conserve must be one of"),
            ({"weights": "best"}, "weights must be one of 'noise', .*, None or a dict by exposure, got 'best'"),
            ({"weights": {"frame0": 1}}, "weights of exposure frame1 must be a positive number, got None"),
            ({"scale": {"frame0": -1}}, "scale of exposure frame0"),
            ({"grid": 3}, "grid must be None, an astropy WCS or a FITS header, got int"),
            ({"grid": WCS(naxis=2)}, "both celestial"),
        ],
    )
    def test_options(self, settings, message):
        solution, *_, exposures, _ = plain()
        with pytest.raises(InputError, match=message):
            coadd(exposures, solution, **settings)

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"order": 9}, "coadding: order must be an integer from 0 to 5"),
            ({"weights": {"a": -1}}, "coadding: weights of exposure a must be a positive number, got -1"),
            ({"scale": "sky"}, "coadding: scale must be one of 'auto', 'exptime', 'stars', None or a dict"),
            ({"grid": WCS(naxis=2)}, "coadding: grid must have two axes, both celestial"),
            ({"workers": 2}, "coadding has no option 'workers'; it takes method, order"),
        ],
    )
    def test_options_need_no_exposures_to_be_refused(self, settings, message):
        with pytest.raises(InputError, match=message):
            options_from(CoaddOptions, settings, "coadding")

    def test_options_are_the_arguments(self):
        arguments = signature(coadd).parameters
        for option in fields(CoaddOptions):
            assert arguments[option.name].default == option.default
        shared = {"exposures", "solution", "workers", "progress"}
        assert set(arguments) - shared == {option.name for option in fields(CoaddOptions)}

    def test_options_are_kept_as_they_were(self):
        given = {"a": 2}
        options = CoaddOptions(order="bicubic", weights=given)
        given["a"] = -1
        assert (options.order, options.weights) == (3, {"a": 2.0})

    def test_grids(self):
        solution, *_, exposures, mosaic = plain()
        grid = mosaic.wcs.deepcopy()
        grid.array_shape = None
        with pytest.raises(InputError, match="grid has no shape"):
            coadd(exposures, solution, grid=grid)
        with pytest.raises(InputError, match="not tied to the sky"):
            coadd(exposures, StandIn(solution.poses, solution.distortions), grid=mosaic.wcs)
        away = mosaic.wcs.deepcopy()
        away.wcs.crpix = away.wcs.crpix + 5000
        with pytest.raises(
            InputError, match="no exposure meets the output grid: frame0, frame1, frame2, frame3: it does not meet"
        ):
            coadd(exposures, solution, grid=away)

    def test_exposures(self):
        solution, _, _, exposures, mosaic = plain()
        stranger = Exposure("stranger", np.ones(SHAPE))
        with warns_here(AssumptionWarning, match="left out of the mosaic: stranger: it is not in the solution"):
            with_stranger = coadd([*exposures, stranger], solution)
        np.testing.assert_array_equal(with_stranger.data, mosaic.data)
        assert list(with_stranger.left_out) == ["stranger"]
        with pytest.raises(InputError, match="no exposure to co-add: stranger: it is not in"):
            coadd([stranger], solution)
        with pytest.raises(InputError, match="the list is empty"):
            coadd([], solution)
        with pytest.raises(InputError, match=r"frame0: its shape \(9, 9\) is not that of the solution, \(300, 400\)"):
            coadd([Exposure("frame0", np.ones((9, 9)))], solution)
        with pytest.raises(InputError, match="exposures come twice: frame0"):
            coadd([exposures[0], exposures[0]], solution)

    def test_absurd_size(self):
        solution, *_, exposures, _ = plain()
        lost = StandIn(dict(solution.poses), solution.distortions)
        lost.poses["frame1"] = lost.poses["frame1"] + np.array([[0, 0, 1e6], [0, 0, -1e6]])
        message = r"a mosaic of \d+ x \d+ px and the pixels of \d exposures take [\d,]+\.\d\d GB .* look at the poses"
        with pytest.raises(DiskFullError, match=message):
            coadd(exposures, lost)

    def test_what_is_no_exposure(self):
        solution, *_ = plain()
        for given in ("demo/frames/*.fits", None, [np.zeros(SHAPE)]):
            with pytest.raises(InputError, match=r"must be images as open_exposures .*; give open_exposures"):
                coadd(given, solution)

    @pytest.mark.slow
    def test_dubious_frames_are_told(self):
        solution, stars, flux = scene(7, rolls=[0] * 7)
        frames = expose(solution, stars, flux, header=fits.Header({"BUNIT": "adu"}))
        frames[1] = replace(frames[1], header=fits.Header({"BUNIT": "adu/s"}))
        with warns_here(AssumptionWarning, match=r"the units \(BUNIT\) of the exposures differ: adu, adu/s"):
            coadd(frames, solution)
        dead = [frames[0]] + [replace(f, data=np.zeros(SHAPE), header=fits.Header()) for f in frames[1:]]
        names = "frame1, frame2, frame3, frame4, frame5 and 1 more"
        with warns_here(AssumptionWarning, match=f"left out of the mosaic: {names}: every pixel is 0"):
            assert coadd(dead, solution, weights={f.name: 1 for f in dead}).exposures == ("frame0",)
        with pytest.raises(InputError, match="scale: no exposure of that name is co-added: frame9"):
            coadd(frames[:1], solution, scale={"frame0": 1, "frame9": 2})

    def test_names_with_other_letters_go_into_the_file(self, tmp_path):
        solution, *_, exposures, _ = plain()
        strange = Exposure("né", np.ones(SHAPE))
        with warns_here(AssumptionWarning, match="left out of the mosaic: né"):
            mosaic = coadd([*exposures, strange], solution)
        mosaic.write(tmp_path / "m.fits")
        history = str(fits.getheader(tmp_path / "m.fits")["HISTORY"])
        assert "left out n\\xe9: it is not in the solution" in history

    @pytest.mark.slow
    def test_a_coarse_grid_is_for_other_algorithms(self):
        solution, *_, exposures, mosaic = plain()
        grid = mosaic.wcs.deepcopy()
        grid.wcs.cd, grid.wcs.crpix = 3 * grid.wcs.cd, grid.wcs.crpix / 3
        grid.array_shape = tuple(n // 3 for n in mosaic.shape)
        with warns_here(AssumptionWarning, match=r"pixels of the grid are 3\.\d times .* take algorithm='adaptive'"):
            coadd(exposures, solution, grid=grid)
        coadd(exposures, solution, grid=grid, algorithm="adaptive")

    def test_inputs_are_not_changed(self):
        solution, *_, exposures, _ = plain()
        before = [e.data.copy() for e in exposures]
        coadd(exposures, solution, method="clipped")
        for e, data in zip(exposures, before, strict=True):
            np.testing.assert_array_equal(e.data, data)


def test_sky_of_the_stand_in_is_consistent():
    """The oracle itself: gwcs and tangent plane agree."""
    solution, stars, *_ = plain()
    seen = solution["frame0"].distort(stars)
    ok = np.isfinite(seen).all(axis=1)
    sky = SkyCoord(*solution["frame0"].wcs(*seen[ok].T) * u.deg)
    assert solution.sky.to_sky(stars[ok]).separation(sky).max() < 1e-9 * u.deg


def test_detectors_do_not_count_as_exposures():
    """Six exposures of four detectors are six, with the time of six."""
    parts = [(f"e{i}", key) for i in range(6) for key in "1234"]
    frames = [Exposure(f"{e}-{k}", np.eye(8), exposure=e, detector=k, exposure_time=10.0) for e, k in parts]
    header = mosaic_header(frames, {}, dict.fromkeys([f.name for f in frames], 1.0), [])
    assert (header["NCOMBINE"], header["NEXPOSUR"], header["TEXPTIME"]) == (24, 6, 60.0)
    names = tuple(f.name for f in frames)
    mosaic = Mosaic(*(np.zeros((4, 4)) for _ in range(6)), wcs=None, exposures=names, header=header)
    assert repr(mosaic) == "<Mosaic: 4 x 4 px, 6 exposures, 24 images of their detectors>"
    assert "exposures, " not in repr(replace(mosaic, exposures=names[:6]))
