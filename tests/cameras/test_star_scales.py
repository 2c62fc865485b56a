"""Zero points of exposures and detectors from fluxes of stars, against those that numpy put into the fluxes."""

import logging

import numpy as np
import pytest
from astropy.table import Table

from legdistort.cameras.star_scales import star_scales
from legdistort.coaddition.flux_scales import flux_scales
from legdistort.inputs.exposures import Exposure

ROLLS = np.repeat([0, 90], 4)
CLOUD = np.log([1.0, 1.0, 0.5, 1.0, 1.0, 1.1, 1.0, 0.9])  # half of the light at one exposure
CHIPS = np.array([0.0, 0.1, -0.05, 0.06])  # of two by two detectors


def rolled(seed, rolls=ROLLS, *, n_stars=300, seen=lambda x, y, roll: np.full(x.shape, True), dither=15.0):
    """Exposure, detector, star and flux of a camera of 2 x 2 chips of 1000 px, that turns about its middle."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1000, 1000, (2, n_stars))
    true, rows = rng.normal(8, 1, n_stars), []
    for i, roll in enumerate(np.radians(rolls)):
        u, v = np.cos(roll) * x - np.sin(roll) * y, np.sin(roll) * x + np.cos(roll) * y
        u, v = u + rng.normal(0, dither), v + rng.normal(0, dither)
        here = (np.minimum(np.abs(u), np.abs(v)) > 20) & (rng.random(n_stars) < 0.9) & seen(x, y, roll)
        star = np.flatnonzero(here)
        chip = (u > 0).astype(int)[star] + 2 * (v > 0)[star]
        logs = true[star] + CLOUD[i] + CHIPS[chip] + rng.normal(0, 0.03, len(star))
        logs[rng.random(len(star)) < 0.03] += 1.5  # blended ones
        rows.append(np.column_stack([np.full(len(star), i), chip, star, np.exp(logs)]))
    exposure, chip, star, flux = np.concatenate(rows).T
    return exposure.astype(int), chip.astype(int), star.astype(int), flux


def centred(values):
    return values - np.mean(values)


def test_a_camera_that_rolls_by_90_degrees_has_a_scale():
    """Hardly a star stays on its chip."""
    off, errors = [], []
    for seed in range(100, 140):
        found = star_scales(*rolled(seed, n_stars=200), 8, 4)
        assert found.joined
        off.append(np.append(centred(found.exposures + CLOUD), centred(found.detectors + CHIPS)))
        errors.append(np.append(found.errors, found.detector_errors))
    off, errors = np.array(off), np.array(errors)
    assert np.abs(off).max() < 0.02
    for part in (slice(8), slice(8, None)):  # exposures, detectors
        assert 0.8 < np.sqrt(np.mean(off[:, part] ** 2) / np.mean(errors[:, part] ** 2)) < 1.25


def test_what_rolls_and_chips_leave_open_is_said():
    """Stars of one chip alone in common, which falls on another: what differs, the roll or the chip, is not known."""
    exposure, chip, star, flux = rolled(1, seen=lambda x, y, roll: (roll == 0) | ((x > 0) & (y > 0)), dither=0.0)
    found = star_scales(exposure, chip, star, flux, 8, 4)
    assert np.unique(found.group[:4]).size == np.unique(found.group[4:]).size == 1
    assert not found.joined
    assert np.isinf(found.errors).all()
    assert not found.exposures.any()
    said = found.apart([f"a{i}" for i in range(8)])
    assert "apart are a0, a1, a2 and 1 more; a4, a5, a6 and 1 more" in said
    alike = star_scales(exposure, 0 * chip, star, flux, 8, 1)  # of one chip it is known
    assert alike.joined
    assert alike.errors.max() < 0.05


def test_mosaics_of_rolled_cameras_follow_the_clouds(caplog):
    """And where nothing tells them, the print says why."""
    caplog.set_level(logging.INFO)
    exposure, chip, star, flux = rolled(2)
    views, frames = {}, []
    for i, k in np.ndindex(8, 4):
        name, on = f"a{i}-CCD{k}", (exposure == i) & (chip == k)
        frames.append(Exposure(name, np.ones((2, 2)), exposure=f"a{i}", detector=f"CCD{k}", exposure_time=120.0))
        views[name] = Seen(Table({"star": star[on], "flux": flux[on], "used": np.full(on.sum(), True)}))
    factors, origin = flux_scales(frames, "auto", views)
    level = np.log(list(factors.values())).reshape(8, 4) + CLOUD[:, None] + CHIPS
    assert origin == "stars"
    assert np.abs(centred(level)).max() < 0.012
    for name, view in views.items():
        if int(name[1]) > 3:
            view.residuals["star"] += 1000  # stars of their own
    factors, origin = flux_scales(frames, "auto", views)
    assert origin == "exptime"
    assert set(factors.values()) == {1.0}
    assert "scaled by exposure times, whatever their transparency: no 5 common stars or more" in caplog.text
    assert "apart are a0, a1, a2 and 1 more; a4, a5, a6 and 1 more" in caplog.text


class Seen:
    def __init__(self, residuals):
        self.residuals = residuals


@pytest.mark.parametrize("n", [0, 4])
def test_few_stars_join_nothing(n):
    exposure, star = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    found = star_scales(exposure, 0 * exposure, star, np.ones(2 * n), 2)
    assert not found.joined
    assert found.n_stars == n
