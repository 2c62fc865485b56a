"""The list of one detector of one exposure is of another field, or two were exchanged: named, and the night goes on."""

import warnings

import header_layouts
import numpy as np
import pytest

import legdistort as ld
from legdistort.exceptions import AssumptionWarning

KEY = "3"


def rows_of(night, exposure, key=KEY):
    table = night.table
    return np.flatnonzero((table["exposure"] == exposure) & (table["detector"] == key))


def exchanged(night, first, second):
    """The night with the positions of a detector in two exposures exchanged."""
    a, b = rows_of(night, first), rows_of(night, second)
    n = min(len(a), len(b))
    for column in ("x", "y", "true"):
        values = night.table[column]
        values[a[:n]], values[b[:n]] = values[b[:n]].copy(), values[a[:n]].copy()
    return night


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.slow)])
def test_a_list_of_another_field(seed):
    night = header_layouts.Night(seed, off=1.0, n=4, n_stars=500)
    rows = rows_of(night, "e1")
    night.table["x"][rows], night.table["y"][rows] = np.random.default_rng(seed).uniform(0, 511, (2, len(rows)))
    with pytest.warns(AssumptionWarning, match=r"detector 3 of e1 \(\d of \d+\): nothing of it is used"):
        matches = ld.match(night.table, exposures=night.exposures, min_exposures=2)
    table = matches.table
    assert set(table["detector"][table["exposure"] == "e1"]) == {"1", "2", "4"}
    assert set(table["detector"]) == set(header_layouts.KEYS)
    solution = ld.solve(matches)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=0.1)


def test_two_lists_that_are_exchanged():
    night = exchanged(header_layouts.Night(3, off=1.0, n=5, n_stars=500), "e1", "e2")
    with pytest.warns(AssumptionWarning, match=r"detector 3 of e1 \(\d+ of \d+\), 3 of e2 \(\d+ of \d+\): nothing of"):
        ld.match(night.table, exposures=night.exposures, min_exposures=2)


@pytest.mark.parametrize("seed", [5, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 4, 6, 7))])
def test_images_that_hardly_overlap_others_are_not_blamed(seed):
    """They have hardly a star in common with the other exposures, which looked elsewhere."""
    night = header_layouts.Night(seed, off=0.3, n=5, n_stars=900, dither=600.0)
    night.table = night.table[night.table["exposure"] != "e0"]  # in the middle, it overlaps with all
    exposures = [each for each in night.exposures if each.exposure != "e0"]
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "hardly a detection", AssumptionWarning)
        matches = ld.match(night.table, exposures=exposures, min_exposures=2)
    images = [(e, d) for e in matches.names for d in header_layouts.KEYS if len(rows_of(night, e, d)) >= 20]
    found = [np.sum((matches.table["exposure"] == e) & (matches.table["detector"] == d)) for e, d in images]
    shares = np.array(found) / [len(rows_of(night, *image)) for image in images]
    assert shares.min() < 0.25 * np.median(shares)
