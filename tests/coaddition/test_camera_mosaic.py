"""Mosaics over the gaps between detectors: as sharp, and of one flux scale, wherever a star fell."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import camera_gaps


@pytest.mark.parametrize(
    ("sensitivity", "how"),
    [
        pytest.param((1.0, 1.015, 0.99, 1.01), {}, marks=pytest.mark.sets),
        pytest.param(camera_gaps.SENSITIVITY, {}, marks=pytest.mark.sets),
        pytest.param(camera_gaps.SENSITIVITY, {"psf": "moffat"}, marks=pytest.mark.slow),
    ],
)
def test_stars_over_the_gaps(tmp_path, sensitivity, how):
    """On one detector here and on another there: FWHM within 1 % of others', flux steps of 0.5 % at most."""
    found = camera_gaps.groups(*camera_gaps.mosaic_of(tmp_path, sensitivity=sensitivity, **how))
    assert min(number for number, _, _ in found.values()) > 20
    assert found["several"][1] == pytest.approx(found["one"][1], rel=0.01)
    parts = np.array([part for _, _, part in found.values()])
    assert np.ptp(parts) < 0.005 * parts.mean()
