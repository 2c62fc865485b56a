"""Differences of nights of one camera of several detectors, each with headers and a reference of its own.

Nights and their truth are made by numpy alone.
"""

import numpy as np
import pytest
import visits_of_four_chips as visits
from scipy import stats

import legdistort as ld

#: What `solve` assumes of the errors of headers, and that a start by them is far off, is not asked for here.
pytestmark = pytest.mark.filterwarnings("ignore::legdistort.exceptions.AssumptionWarning")


def solved(chips, seed, *, tied=True, **how):
    table, poses, known = visits.night(chips, seed, **how)
    shape = (visits.SIZE, visits.SIZE)
    detectors = {key: ld.Detector(shape, layout=each) for key, each in visits.layouts(seed).items()}
    matches = ld.Matches.from_table(table, camera=ld.Camera("FOUR", detectors), poses=poses)
    return ld.solve(matches, degree=3, layout="fit", static="fit", reference=known if tied else None)


@pytest.mark.slow
def test_nights_of_one_camera_agree_however_each_is_tied():
    """Exposures bend the focal plane each by themselves: their mean is no change, nor is what headers had otherwise."""
    chips = visits.Chips(1)
    tied, free = ([solved(chips, 10 + i, tied=each) for i in range(2)] for each in (True, False))
    found = ld.difference(*tied)
    assert found.agrees
    assert found.n_undetermined == 0
    assert found.rms > 0.05  # by what exposures bend the plane, which the errors of one night's stars are far below
    camera = free[0].camera
    nights = ld.combine_nights([free[0]])
    for pair in ((tied[0], free[1]), (free[0], tied[1]), free, (camera, tied[1]), (nights, tied[1])):
        found = ld.difference(*pair)
        assert found.agrees
        assert 0 < found.rms < 0.05
        assert found.n_undetermined
    chips.statics[1, 0, 2, 0] += 0.3
    for each in (True, False):
        found = ld.difference(tied[0], solved(chips, 11, tied=each))
        assert found.agrees is False
        # of both tied, modes have errors in common; else the change is shared out among the detectors
        assert ("of detector 2" if each else "L2(x) L0(y) along x") in found.sentence


@pytest.mark.sets
def test_chances_of_differences_of_nights_of_one_camera():
    chances = {"tied": [], "one tied": [], "free": []}
    for seed in range(20):
        chips = visits.Chips(seed)
        tied, free = ([solved(chips, 100 + 2 * seed + i, tied=each) for i in range(2)] for each in (True, False))
        for name, pair in zip(chances, (tied, (tied[0], free[1]), free), strict=True):
            chances[name].append(ld.difference(*pair).p)
    for each in chances.values():
        assert stats.kstest(each, "uniform").pvalue > 0.01
        assert np.min(each) > 0.003
