"""Drizzle as the engine of co-adding: the same as reproject's exact algorithm, and the usual promises."""

import builtins

import numpy as np
import pytest
from stacks import SHAPE, StandIn, check_stars, covered, expose, fit_star, plain, scene

from legdistort.coaddition import block_stack
from legdistort.coaddition.mosaicking import coadd
from legdistort.coaddition.options import CoaddOptions
from legdistort.exceptions import InputError
from legdistort.geometry import similarity
from legdistort.geometry.distortion import Distortion
from legdistort.inputs.exposures import Exposure
from legdistort.runtime.words import KERNELS

drizzle = pytest.importorskip("drizzle")


def test_it_is_the_exact_algorithm():
    solution, stars, flux, exposures, _ = plain()
    one, two = (coadd(exposures[:1], solution, algorithm=a) for a in ("exact", "drizzle"))
    both = (one.footprint > 0) & (two.footprint > 0)
    assert both.sum() > 0.99 * (one.footprint > 0).sum()
    peak = np.nanmax(one.data)
    inner = both.copy()
    inner[:2] = inner[-2:] = False
    difference = np.abs(one.data - two.data)[inner]
    assert np.quantile(difference, 0.999) < 1e-3 * peak
    check_stars(two, stars - two.offset, flux, position=0.04, relative=0.01)
    assert two.header["RESAMPLE"] == "drizzle square 1"


@pytest.mark.parametrize("roll", [0, 2, 45, 137])
@pytest.mark.parametrize("side", [pytest.param(256, marks=pytest.mark.slow), 64])
def test_bent_blocks_fit_together(monkeypatch, roll, side):
    solution, *_ = scene(1, rolls=(roll,), seed=3)
    y, x = np.indices(SHAPE)
    image = 1000 + 200 * np.sin(x / 9) * np.cos(y / 11) + np.random.default_rng(0).normal(size=SHAPE)

    def drizzled(side):
        monkeypatch.setattr(block_stack, "_SIDES", (side, side))
        return coadd([Exposure("frame0", image)], solution, algorithm="drizzle", conserve="surface_brightness")

    whole, pieces = drizzled(1024), drizzled(side)
    np.testing.assert_array_equal(pieces.footprint, whole.footprint)
    np.testing.assert_allclose(pieces.data, whole.data, rtol=1e-4)
    np.testing.assert_allclose(pieces.weight, whole.weight, rtol=1e-3, atol=1e-4 * whole.weight.max())
    assert np.nanmax(np.abs(whole.data - 1000)) < 206  # no drop is lost, in the whole neither


def test_exposures_together():
    solution, stars, flux, exposures, _ = plain()
    mosaic = coadd(exposures, solution, algorithm="drizzle")
    check_stars(mosaic, stars - mosaic.offset, flux, position=0.03, relative=0.005)


@pytest.mark.slow
def test_small_drops_are_sharper():
    solution, stars, flux = scene(8, rolls=range(8), spread=4, peak=5.0)
    exposures = expose(solution, stars, flux)
    whole = coadd(exposures, solution, algorithm="drizzle")
    small = coadd(exposures, solution, algorithm="drizzle", pixfrac=0.5)
    xy = stars - whole.offset
    chosen = covered(whole, xy)
    peaks = [m.data[tuple(np.round(xy[chosen]).astype(int).T[::-1])] for m in (small, whole)]
    assert np.nanmedian(peaks[0] / peaks[1]) > 1.02
    fluxes = [fit_star(np.nan_to_num(small.data), xy[i], flux[i])[1] / flux[i] for i in chosen]
    assert np.median(fluxes) == pytest.approx(1, abs=0.003)


@pytest.mark.parametrize("pixfrac", [0.6, 1.0])
def test_variance_is_that_of_the_pixels(pixfrac):
    solution, *_ = scene(4, rolls=(0, 1, -1, 2))
    rng = np.random.default_rng(8)
    exposures = [
        Exposure(name, rng.normal(0, s, SHAPE), uncertainty=np.full(SHAPE, s))
        for name, s in zip(solution.poses, (1.0, 2.0, 1.5, 3.0), strict=True)
    ]
    mosaic = coadd(exposures, solution, algorithm="drizzle", pixfrac=pixfrac)
    ok = mosaic.footprint == 4
    assert (mosaic.data[ok] / np.sqrt(mosaic.variance[ok])).std() == pytest.approx(1, abs=0.05)


def test_bad_pixels_do_not_fall():
    identity = StandIn({"a": similarity.identity()}, {"a": Distortion(np.zeros((2, 3)), SHAPE)})
    data, mask = np.full(SHAPE, 5.0), np.zeros(SHAPE, dtype=bool)
    mask[100, 100] = True
    data[mask] = 1e6
    mosaic = coadd([Exposure("a", data, mask=mask)], identity, algorithm="drizzle", match_background=False)
    assert np.isnan(mosaic.data[100, 100])
    assert np.nanmax(mosaic.data) == pytest.approx(5)


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernels(kernel):
    solution, stars, flux, exposures, square = plain()
    mosaic = coadd(exposures, solution, algorithm="drizzle", kernel=kernel)
    fluxes = [
        fit_star(np.nan_to_num(mosaic.data), stars[i] - mosaic.offset, flux[i])[1] / flux[i]
        for i in covered(square, stars - mosaic.offset)
    ]
    assert np.median(fluxes) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kernel": "round"}, "kernel must be one of 'square', .*, got 'round'"),
        ({"pixfrac": 0}, "pixfrac must be a number above 0 and up to 1, got 0"),
        ({"pixfrac": 1.5}, "got 1.5"),
        ({"pixfrac": "half"}, "got 'half'"),
        ({"pixfrac": float("nan")}, "got nan"),
    ],
)
def test_bad_options(settings, message):
    solution, *_, exposures, _ = plain()
    with pytest.raises(InputError, match=message):
        coadd(exposures, solution, algorithm="drizzle", **settings)


def test_without_the_package(monkeypatch):
    real = builtins.__import__

    def absent(name, *rest, **more):
        if name.startswith("drizzle"):
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(InputError, match=r"needs the package drizzle: pip install legdistort\[drizzle\]"):
        CoaddOptions(algorithm="drizzle")


def test_a_scratch_folder_is_tried_before_there_are_frames(tmp_path):
    with pytest.raises(InputError, match=r"no scratch folder can be made in .*absent .*give another .*\(--scratch\)"):
        CoaddOptions(scratch=tmp_path / "absent")
    CoaddOptions(scratch=tmp_path)
    assert not list(tmp_path.iterdir())
