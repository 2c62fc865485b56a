"""Stars on a lattice, as the holes of a mask: all made by numpy, distorted by polynomials of its own."""

import csv
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.table import QTable
from astropy.wcs import WCS
from masks import SIZE, field, mask

import legdistort as ld
from legdistort.exceptions import AssumptionWarning
from legdistort.inputs.exposures import Exposure
from legdistort.matching.lattices import periods

DATA = os.environ.get("LEGDISTORT_DATA")


@pytest.mark.parametrize(
    "kind", [{}, {"turned": 10}, {"pitch": 20.0}, {"pitch": 400.0}, {"lost": 0.35}, {"distortion": 30.0}]
)
def test_periods_of_a_mask(kind):
    found = periods(mask(np.random.default_rng(1), **kind))
    pitch, angle = kind.get("pitch", 100.0), np.deg2rad(kind.get("turned", 0.0))
    across = np.array([[np.cos(angle), np.sin(angle)], [np.sin(angle), -np.cos(angle)]])
    shown = np.abs(found @ across.T) / pitch  # of either, along one axis and not along the other
    np.testing.assert_allclose(np.sort(shown, axis=None), [0, 0, 1, 1], atol=0.03)


def test_periods_of_a_hexagonal_mask():
    found = periods(mask(np.random.default_rng(2), hexagonal=True, turned=33))
    np.testing.assert_allclose(np.hypot(*found.T), 100, atol=1)
    sixths = np.degrees(np.arctan2(*found.T[::-1])) - 33
    np.testing.assert_allclose((sixths + 30) % 60, 30, atol=1)


def test_stars_lie_on_no_lattice():
    assert not any(len(periods(field(seed))) for seed in range(100))


@pytest.mark.slow
def test_one_field_in_a_thousand_at_most_has_one():
    assert not any(len(periods(field(seed))) for seed in range(3000))  # upper 95 % limit 0.1 %


@pytest.mark.skipif(not DATA, reason="LEGDISTORT_DATA is not set")
def test_real_stars_lie_on_no_lattice():
    with (Path(DATA) / "star_fields/JWST_CALFIELD2020.csv").open() as file:
        rows = np.array([[float(row["RA"]), float(row["DEC"])] for row in csv.DictReader(file)])
    xy = (rows - rows.mean(axis=0)) * [np.cos(np.deg2rad(rows[:, 1].mean())), 1] * 3600 / 0.0312
    assert len(periods(xy)) == 0
    rng = np.random.default_rng(3)
    for middle in xy[rng.integers(0, len(xy), 30)]:
        near = xy[(np.abs(xy - middle) < SIZE / 2).all(axis=1)]
        assert len(periods(near[: rng.integers(20, len(near) + 20)])) == 0


def exposures_of(rng, shifts):
    """Detections of a mask that is shifted, and exposures whose WCSs know by how much."""
    holes, rows, exposures = mask(rng, wrong=0.1), [], []
    for i, shift in enumerate(shifts):
        xy = holes + shift + rng.normal(0, 0.01, holes.shape)
        xy = xy[((xy > 0) & (xy < SIZE - 1)).all(axis=1)]
        rows += [(f"m{i}", x, y, 0.01, 0.01) for x, y in xy]
        wcs = WCS(naxis=2)
        wcs.wcs.ctype, wcs.wcs.cdelt, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [-1e-5, 1e-5], shift + SIZE / 2
        exposures.append(Exposure(f"m{i}", np.zeros((SIZE, SIZE), dtype=np.float32), wcs=wcs))
    return QTable(rows=rows, names=["exposure", "x", "y", "x_err", "y_err"]), exposures


def test_matching_says_that_a_period_cannot_be_told_unless_headers_tell_it():
    rng = np.random.default_rng(4)
    table, exposures = exposures_of(rng, rng.uniform(-30, 30, (4, 2)))
    with pytest.warns(AssumptionWarning, match=r"on a lattice, as of a mask: of period \(.*100.* px in x, y of m"):
        ld.match(table, shape=(SIZE, SIZE))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ld.match(table, exposures=exposures)
    exposures[2] = replace(exposures[2], wcs=None)
    with pytest.warns(AssumptionWarning, match="nor do the headers of m2; give exposures="):
        ld.match(table, exposures=exposures)
