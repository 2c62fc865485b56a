"""A detector with every kind of defect, and no mask."""

import dirty_detector as detector
import pytest

from legdistort.matching.matcher import match
from legdistort.measurement.flags import UNUSABLE, Flag
from legdistort.measurement.positions import measure


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=pytest.mark.sets if seed else pytest.mark.slow) for seed in range(6)]
)
def test_bright_stars_are_kept(seed):
    """Of 22, of which two are saturated, a clean detector keeps 20, as this one; 16 to 19 when no step was known."""
    night = detector.night(seed)
    table = measure(detector.exposures(night.frames))
    matched = detector.seen(match(table, shape=night.frames[0].shape).table, night.xy)
    assert detector.kept(matched, detector.inside(night.xy))[: detector.N_BRIGHT].sum() >= 19
    usable = table[(table["flags"] & (UNUSABLE | Flag.DEFORMED)) == 0]
    assert detector.seen(usable, night.xy)[detector.untouched(night)].mean() > 0.94  # 0.985 without defects
