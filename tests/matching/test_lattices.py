"""Stars on a lattice, as the holes of a mask: all made by numpy, distorted by polynomials of its own."""

import csv
import os
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.table import QTable, Table
from astropy.wcs import WCS
from masks import SIZE, field, mask, mixed, night

import legdistort as ld
from legdistort.exceptions import AssumptionWarning, InputError, MatchError
from legdistort.inputs.exposures import Exposure
from legdistort.matching.lattices.periods import periods

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


@pytest.mark.parametrize("n", [pytest.param(500, marks=pytest.mark.slow), pytest.param(3000, marks=pytest.mark.sets)])
def test_one_field_in_a_thousand_at_most_has_one(n):
    assert not any(len(periods(field(seed))) for seed in range(n))  # of 3000: upper 95 % limit 0.1 %


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


def starts(stated, seed, *, off):
    """Shifts and turns that are wrong by up to `off` px and 0.2 degrees."""
    rng = np.random.default_rng(1000 + seed)
    return {name: tuple(each + rng.uniform(-1, 1, 3) * [off, off, 0.2]) for name, each in stated.items()}


MASKS = [
    # the mask, whether start positions are given, what becomes of it
    ({}, False, "right"),
    ({"turns": "both"}, False, "right"),
    ({"turns": "quarters", "pitch": 70.0, "missed": 0.05}, False, "right"),
    ({"wrong": 0.0, "turns": "both"}, True, "right"),
    ({"wrong": 0.0, "turns": "small", "pitch": 70.0, "stopped": 0.05}, False, "warned"),
    ({"shift": 30.0}, False, "warned"),  # by less than half a period, as it turns out
    ({"wrong": 0.0}, False, "refused"),
    ({"wrong": 0.0, "rough": 0.05}, False, "refused"),
    ({"wrong": 0.0, "rough": 0.05}, True, "right"),
]


def tried(seed, kind, given):
    """What becomes of a mask: right, right with a warning of the period, or refused; and mixed, which must not be."""
    table, stated = night(seed, n_exposures=5, **kind)
    start = starts(stated, seed, off=kind.get("pitch", 100.0) / 4) if given else None
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            matches = ld.match(table, shape=(SIZE, SIZE), start=start)
        except MatchError as error:
            named = re.search(r"of period \(.*\) and \(.*\) px in x, y of m\d.*--start", str(error))
            return "refused" if named else str(error)
    if mixed(matches):
        return "mixed"
    assert len(matches.names) == 5
    return "warned" if told else "right"


@pytest.mark.parametrize(("kind", "given", "outcome"), MASKS)
def test_holes_of_a_mask_are_never_mixed(kind, given, outcome):
    assert tried(3, kind, given) == outcome


@pytest.mark.slow
def test_headers_place_a_mask():
    table, stated = night(5, n_exposures=4, wrong=0.0, stopped=0.0)
    exposures = []
    for name, (x, y, _) in stated.items():
        wcs = WCS(naxis=2)
        wcs.wcs.ctype, wcs.wcs.cdelt, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [-1e-5, 1e-5], (1000 + x, 1000 + y)
        exposures.append(Exposure(name, np.zeros((SIZE, SIZE), dtype=np.float32), wcs=wcs))
    matches = ld.match(table, exposures=exposures)
    assert len(matches.names) == 4
    assert mixed(matches) == 0
    with pytest.raises(MatchError, match=r"on a lattice, as holes of a mask do: of period .* and nothing tells by how"):
        ld.match(table, exposures=[replace(each, wcs=None) for each in exposures])


def test_an_exposure_without_a_place_is_left_out_by_the_period():
    table, stated = night(6, n_exposures=6, wrong=0.0)
    del stated["m4"]
    matches = ld.match(table, shape=(SIZE, SIZE), start=stated)
    assert mixed(matches) == 0
    assert re.match(r"nothing tells by how many periods of \(.*100\.\d.*it is shifted", matches.left_out["m4"])


def test_start_positions_that_are_a_period_off_are_said_to_be():
    table, stated = night(7, n_exposures=5)
    stated["m2"] = (stated["m2"][0] + 100.0, *stated["m2"][1:])
    with pytest.warns(AssumptionWarning, match="start positions of m2 contradict the errors of the holes"):
        assert mixed(ld.match(table, shape=(SIZE, SIZE), start=stated)) == 0


def test_start_positions_come_as_a_dict_a_table_or_its_file(tmp_path):
    table, stated = night(8, n_exposures=4, wrong=0.0, holes=9)
    made = Table(
        rows=[(name, *each) for name, each in stated.items()], names=["exposure", "xshift", "yshift", "rotation"]
    )
    made.write(tmp_path / "starts.csv")
    found = [ld.match(table, shape=(SIZE, SIZE), start=start) for start in (stated, made, tmp_path / "starts.csv")]
    assert all(np.array_equal(each.table["star"], found[0].table["star"]) and not mixed(each) for each in found)


@pytest.mark.parametrize(
    ("start", "words"),
    [
        ({"m0": (1.0,)}, r"start position of m0 must be \(xshift, yshift\) \[px\]"),
        ({"m0": (1.0, np.nan)}, "start position of m0 must be"),
        ({"m9": (1.0, 2.0)}, "start has exposure m9, which is none of those of the table: m0, m1"),
        (3, "start must be a dict .* got int"),
        (Table({"exposure": ["m0"], "xshift": [1.0]}), "has no column yshift: .* it has exposure, xshift"),
        (Table({"exposure": ["m0"] * 2, "xshift": [1.0] * 2, "yshift": [1.0] * 2}), "has exposure m0 twice"),
    ],
)
def test_bad_start_positions_are_named(start, words):
    table = night(9, n_exposures=4, holes=5)[0]
    with pytest.raises(InputError, match=words):
        ld.match(table, shape=(SIZE, SIZE), start=start)


def test_rows_of_pinholes_are_warned_of():
    rng, rows = np.random.default_rng(10), []
    for i in range(4):
        x = 60.0 + 100 * np.arange(19) + rng.uniform(-10, 10)
        rows += [(f"m{i}", *xy, 0.01, 0.01) for xy in zip(x, 700 + rng.normal(0, 0.1, 19) + 30 * i, strict=True)]
        rows += [(f"m{i}", *xy, 0.01, 0.01) for xy in np.random.default_rng(2).uniform(0, 600, (8, 2)) + [0, 30 * i]]
    table = QTable(rows=rows, names=["exposure", "x", "y", "x_err", "y_err"])
    with pytest.warns(AssumptionWarning, match=r"on a lattice, as of a mask: of period \(9.*--start"):
        ld.match(table, shape=(SIZE, SIZE))
