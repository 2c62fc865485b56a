"""Peaks without stars and stars without light of their own, in images and lists made by numpy alone."""

from types import SimpleNamespace

import numpy as np
import pytest

from legdistort.assessment.run_checks import image_check
from legdistort.assessment.stack_quality import Quality
from legdistort.assessment.unexplained_light import unexplained_light

SIZE, FWHM = 1000, 4.0


def field(seed, *, n=250, clustered=False):
    """Positions (n, 2) and fluxes of stars, and an image of them with noise of 1."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-20, SIZE + 20, (n, 2))
    if clustered:
        xy[: n // 2] = SIZE / 2 + 60 * rng.standard_t(2, (n // 2, 2))
    flux = 20 * rng.pareto(1.2, n) + 30
    return xy, flux, image_of(xy, flux) + rng.normal(size=(SIZE, SIZE))


def image_of(xy, flux):
    image, reach = np.zeros((SIZE + 80, SIZE + 80)), 12
    for (x, y), height in zip(xy + 40, flux, strict=True):
        if not (reach + 1 < min(x, y) and max(x, y) < SIZE + 78 - reach):
            continue
        i, j = round(y), round(x)
        dy, dx = np.mgrid[i - reach : i + reach + 1, j - reach : j + reach + 1] - np.array([y, x])[:, None, None]
        patch = height * np.exp(-4 * np.log(2) * (dx**2 + dy**2) / FWHM**2)
        image[i - reach : i + reach + 1, j - reach : j + reach + 1] += patch
    return image[40:-40, 40:-40]


def looked_at(image, xy, flux, *, flags=None, footprint=None):
    nothing = np.zeros(image.shape, dtype=np.uint8)
    mosaic = SimpleNamespace(
        data=image, shape=image.shape, offset=(0, 0), flags=nothing if flags is None else flags,
        footprint=nothing + 5 if footprint is None else footprint,
    )  # fmt: skip
    table = type("Table", (), {"colnames": ["flux"], "__getitem__": lambda self, name: flux})()
    solution = SimpleNamespace(estimate=SimpleNamespace(positions=xy), stars=table)
    return unexplained_light(mosaic, solution, fwhm=FWHM)


def state(light):
    """That of the check, with shapes of which nothing is wrong."""
    alike = {f"e{i}": (4.0 + 0.01 * i, 0.05, 20.0) for i in range(6)}
    return image_check(Quality(9, FWHM, 0.05, 0.1, 0.01, 1.0, 1.0, alike, light))


@pytest.mark.parametrize("clustered", [False, True])
def test_a_complete_list_passes(clustered):
    """Blends of a cluster are neither peaks that were lost nor false stars."""
    lights = []
    for seed in range(2):
        xy, flux, image = field(seed, clustered=clustered)
        lights.append(looked_at(image, xy, flux))
    assert {state(light).state for light in lights} == {"pass"}
    assert min(light.n_peaks for light in lights) > 50


def test_bright_stars_that_were_cut_are_missed():
    xy, flux, image = field(1)
    keep = np.ones(len(xy), dtype=bool)
    keep[np.random.default_rng(1).permutation(np.argsort(-flux)[:100])[:26]] = False
    light = looked_at(image, xy[keep], flux[keep])
    inside = ((xy > 15) & (xy < SIZE - 15)).all(axis=1)
    assert light.n_without == pytest.approx(np.count_nonzero(~keep & inside), abs=3)
    check = state(light)
    assert check.state in ("warn", "fail")
    assert "bright peaks of the stack have no star in the solution" in check.sentence


def test_cosmic_rays_where_two_exposures_meet_are_no_stars_that_were_lost():
    """Nothing tells them from stars there, and half of the stars lie there."""
    xy, flux, image = field(3)
    rng, footprint = np.random.default_rng(8), np.full(image.shape, 5, dtype=np.uint8)
    footprint[:, : SIZE // 2] = 2
    y, x = rng.integers(20, SIZE - 20, 80), rng.integers(20, SIZE // 2 - 20, 80)
    image[y, x] += 5000.0
    light = looked_at(image, xy, flux, footprint=footprint)
    assert light.share_without < 0.1
    assert state(light).state == "pass"
    assert looked_at(image, xy, flux).share_without > 0.3


def test_saturated_stars_and_single_frames_are_not_missed():
    xy, flux, image = field(1)
    cut = np.argsort(-flux)[:26]
    flags, footprint = np.zeros(image.shape, dtype=np.uint8), np.full(image.shape, 5)
    for k, (x, y) in enumerate(np.clip(np.round(xy[cut]), 3, SIZE - 4).astype(int)):
        (flags if k % 2 else footprint)[y - 3 : y + 4, x - 3 : x + 4] = 2 if k % 2 else 1
    keep = np.delete(np.arange(len(xy)), cut)
    image[400:500, 400:500] = np.nan
    assert state(looked_at(image, xy[keep], flux[keep], flags=flags, footprint=footprint)).state == "pass"


def test_stars_that_are_speckles_of_others_are_seen():
    xy, flux, image = field(2)
    rng, bright = np.random.default_rng(2), np.argsort(-flux)[:65]
    angle = rng.uniform(0, 2 * np.pi, 260)
    speckles = np.repeat(xy[bright], 4, axis=0) + 3 * FWHM * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    faint = 0.03 * np.repeat(flux[bright], 4)
    every = np.concatenate([xy, speckles]), np.concatenate([flux, faint])
    light = looked_at(image + image_of(speckles, faint), *every)
    check = state(light)
    assert check.state == "fail"
    assert "stars stand around much brighter ones" in check.sentence
    assert check.value > 0.2  # of 0.51: speckles of neighbours count as those by chance
