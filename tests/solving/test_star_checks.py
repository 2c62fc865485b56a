"""Checks of stars: those that contradict themselves, by name and kind; exposures that hang together by too little."""

import warnings

import dense_model
import drawn_sets
import numpy as np
import pytest

import legdistort as ld
from legdistort.exceptions import LegdistortWarning

ODD = (5, 17)


def checks_of(data, **options):
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        return {check.name: check for check in ld.solve(drawn_sets.as_matches(data), **{"degree": 3} | options).checks}


def with_odd_stars(kind, seed):
    """A set in which stars `ODD` are displaced by some tens of their errors."""
    data, truth = dense_model.drawn_set(seed)
    rng, n = np.random.default_rng(seed), len(data["err"])
    data["flux"] = np.exp(0.05 * rng.normal(size=n)) / data["err"][:, 0]
    data["epoch"] = 2020 + data["exposure"] / 2
    for star in ODD:
        rows = np.flatnonzero(data["star"] == star)
        t, size, off = np.linspace(-1, 1, len(rows)), 40 * data["err"][rows[0], 0], 0
        if kind == "two places":
            off = rng.permutation(np.arange(len(rows)) < 4)
        elif kind == "on a curve":
            off = t**2
        elif kind == "with its flux":
            off = 0.5 * rng.normal(size=len(rows))
            data["flux"][rows] *= np.exp(off)
        data["xy"][rows] += size * np.outer(off, [1, 0.3]) if kind else 0
    return data, ld.Prior(truth["static"])


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("two places", marks=pytest.mark.slow),
        pytest.param("on a curve", marks=pytest.mark.slow),
        "with its flux",
    ],
)
def test_stars_that_contradict_themselves_are_named_by_what_they_look_like(kind):
    data, prior = with_odd_stars(kind, 1)
    check = checks_of(data, prior=prior)["stars"]
    assert check.state == "warn"
    assert check.value == len(ODD)
    for star in ODD:
        assert f"{star} (" in check.sentence
    assert check.sentence.count(kind) == len(ODD)
    assert "take the rows of what is no single star out of matched.ecsv" in check.cure
    matches = drawn_sets.as_matches(data)
    without = matches.keep(~np.isin(np.asarray(matches.table["star"]).astype(int), ODD))
    assert {each.name: each for each in ld.solve(without, degree=3, prior=prior).checks}["stars"].state == "pass"


def test_none_is_named_where_nothing_is_wrong():
    data, prior = with_odd_stars(None, 1)
    assert checks_of(data, prior=prior)["stars"].state == "pass"


def test_mismatches_of_all_stars_are_not_those_of_single_ones():
    data, truth = dense_model.drawn_set(0)
    rng = np.random.default_rng(0)
    wrong = rng.random(len(data["xy"])) < 0.1
    data["xy"][wrong] += rng.uniform(-20, 20, (wrong.sum(), 2))
    checks = checks_of(data, prior=ld.Prior(truth["static"]))
    assert checks["stars"].state == "pass"
    assert checks["rejection"].state != "pass"


def mosaic(overlap, *, n=3, seed=0, size=2048, error=0.02):
    """n x n exposures of a field, each with a cubic departure of its own."""
    rng, step = np.random.default_rng(seed), size * (1 - overlap)
    stars = rng.uniform(0, step * (n - 1) + size, (100 * n * n, 2))
    parts, poses = [], []
    for k in range(n * n):
        shift = rng.normal(0, 5, 2) - step * np.array([k % n, k // n])
        xy = stars + shift
        seen = np.flatnonzero(((xy > 0) & (xy < size - 1)).all(axis=1))
        own = 0.4 * rng.normal(size=(2, 10)) * (np.arange(10) > 2)
        moved = xy[seen] + dense_model.basis(xy[seen], 3, size)[0] @ own.T + error * rng.normal(size=(len(seen), 2))
        parts.append((moved, seen, np.full(len(seen), k)))
        poses.append(np.column_stack([np.eye(2), shift]))
    xy, star, exposure = (np.concatenate(each) for each in zip(*parts, strict=True))
    return {"xy": xy, "star": star, "exposure": exposure, "err": np.full_like(xy, error), "poses": poses, "n": size}


def test_exposures_that_hang_together_by_too_little_are_said_to():
    weak, strong = (checks_of(mosaic(overlap))["overlaps"] for overlap in (0.15, 0.5))
    assert strong.state == "pass"
    assert weak.state == "warn"
    assert weak.value > 4 * strong.value
    assert "too few of them join the exposures" in weak.sentence
