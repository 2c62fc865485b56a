"""Dataclasses to trees and back: exact, by the facts that stand beside the fields, and refused in words."""

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from legdistort.runtime.trees.codec import from_tree, to_tree
from legdistort.runtime.trees.facts import NOT_STORED, SIZE, array, keyed, number, text


@dataclass(frozen=True, eq=False)
class Part:
    size: tuple[int, int] = field(metadata=SIZE)
    matrix: np.ndarray = field(metadata=array("k", "k", unit="pix"))
    sigma: np.ndarray | str | None = field(
        default=None, metadata=array("k", minimum=0, infinite=True, choices=("best",))
    )


@dataclass(frozen=True, eq=False)
class Whole:
    kind: str = field(metadata=text("mean", "median"))
    mean: np.ndarray = field(metadata=array("n_stars", "2 n_modes + 1", unit="pix", nan=True))
    parts: dict[str, Part] = field(metadata=keyed("id"))
    several: tuple[Part, ...] = ()
    names: tuple[str, ...] = field(default=(), metadata=text(length="n_names"))
    covariance: np.ndarray | None = field(default=None, metadata=array("n_modes", "n_modes", covariance=True))
    packed: np.ndarray | None = field(default=None, metadata=array("n_pairs", "n_stars", packed=True, nan=True))
    pose: np.ndarray | None = field(default=None, metadata=array(2, 3, invertible=True))
    labels: np.ndarray | None = field(default=None, metadata=array("n_stars", holds="names"))
    error: float = field(default=0.0, metadata=number(entry="error_px", minimum=0, maximum=1, unit="pix"))
    count: int = 0
    good: bool = True
    words: dict[str, float] | None = None
    anything: Any = None
    scratch: object = field(default=None, metadata=NOT_STORED)


def whole(**changes):
    part = Part((3, 4), np.eye(2))
    given = Whole(
        kind="mean",
        mean=np.array([[1.0, 2, 3, 4, 5], [6, np.nan, 8, 9, 10], [0, 0, 0, 0, 0]]),
        parts={"a": part, "b": Part((5, 6), np.ones((3, 3)), np.array([0.1, 0.2, np.inf]))},
        several=(part, replace(part, sigma="best")),
        names=("x", "y"),
        covariance=np.array([[2.0, 1.0], [1.0, 3.0]]),
        packed=np.array([[1.0, np.nan, 4.0], [1.0, np.nan, 9.0], [-1.0, np.nan, 5.0]]),
        pose=np.array([[0.0, 1.0, 7.0], [1.0, 0.0, 8.0]]),
        labels=np.array(["s1", "s2", "é"]),
        words={"one": 1.0},
        anything={"list": [1, [2.0, None]], "array": np.arange(3)},
        scratch=object(),
    )
    return replace(given, **changes)


def assert_same(first, second):
    assert type(first) is type(second)
    if isinstance(first, (Part, Whole)):
        for each in fields(first):
            if each.name != "scratch":
                assert_same(getattr(first, each.name), getattr(second, each.name))
    elif isinstance(first, dict):
        assert first.keys() == second.keys()
        for key, value in first.items():
            assert_same(value, second[key])
    elif isinstance(first, (tuple, list)):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    elif isinstance(first, np.ndarray):
        assert_array_equal(first, second)
        assert first.dtype == second.dtype
    else:
        assert first == second


@pytest.mark.parametrize("plain", [False, True])
def test_there_and_back(plain):
    given = whole(count=np.int64(3), error=np.float64(0.5))
    tree = to_tree(given, plain=plain)
    assert [each["id"] for each in tree["parts"]] == ["a", "b"]
    assert tree["error_px"] == 0.5
    assert type(tree["count"]) is int
    assert "scratch" not in tree
    sizes = {}
    back = from_tree(Whole, tree, sizes=sizes)
    expected = replace(given, count=3, error=0.5)
    if plain:
        expected = replace(expected, anything={"list": [1, [2.0, None]], "array": [0, 1, 2]})
    assert_same(back, expected)
    assert sizes == {"n_stars": 3, "n_modes": 2, "n_names": 2, "n_pairs": 3}
    assert plain or not np.shares_memory(back.mean, given.mean)


def test_defaults_stand_in_for_what_is_missing():
    tree = to_tree(whole())
    short = {key: tree[key] for key in ("kind", "mean", "parts")}
    assert from_tree(Whole, short).covariance is None
    assert from_tree(Whole | None, None) is None
    del short["kind"]
    with pytest.raises(ValueError, match=r"^entry tree: 'kind' is missing; it should be made of kind, mean, parts"):
        from_tree(Whole, short)


def test_unknown_entries():
    tree = to_tree(whole()) | {"later": 1}
    with pytest.raises(ValueError, match=r"^entry file: unknown later; it should be made of kind, "):
        from_tree(Whole, tree, "file")
    assert_same(from_tree(Whole, tree, strict=False), whole())


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("kind", "mode", r"kind: 'mode'; it should be one of mean, median"),
        ("kind", 3, r"kind: 3; it should be text"),
        ("mean", 3.0, r"mean: 3.0; it should be an array"),
        ("mean", np.zeros(3), r"mean: shape \(3,\); it should be \(n_stars, 2 n_modes \+ 1\)$"),
        ("mean", np.zeros((3, 4)), r"mean: shape \(3, 4\); it should be \(n_stars, 2 n_modes \+ 1\)"),
        ("mean", np.zeros((3, 5), dtype=bool), r"mean: an array of bool; it should be an array of numbers"),
        ("mean", np.full((3, 5), INF), r"mean\[0, 0\]: inf; it should be numbers \[pix\], NaN where unknown"),
        ("mean", np.full((3, 5), -1e31), r"mean\[0, 0\]: -1e\+31; it"),
        ("mean", [[1.0], [1.0, 2.0]], r"mean: a list of lists of different lengths; it should be an array"),
        ("mean", np.zeros((4, 5)), r"packed: shape \(3, 3\); it should be \(n_pairs, n_stars\)"),
        ("mean", np.zeros((3, 7)), r"covariance: shape \(2, 2\); it should be \(n_modes, n_modes\) = \(3, 3\)"),
        ("parts", {}, r"parts: \{\}; it should be a list"),
        ("parts.0", 3, r"parts\[0\]: 3; it should be entries by name with a text 'id'"),
        ("parts.1.id", "a", r"two of tree.parts have the same id 'a'"),
        ("parts.1.size", [5], r"parts.b.size: a list of 1; it should be one of 2"),
        ("parts.1.size", [5, 0], r"parts.b.size\[1\]: 0; it should be finite, a number from 1 to 1e\+07 \[pix\]"),
        ("parts.1.size", [5, True], r"parts.b.size\[1\]: True; it should be an integer"),
        ("parts.1.matrix", np.zeros((3, 2)), r"parts.b.matrix: shape \(3, 2\); it should be \(k, k\)"),
        ("parts.1.sigma", np.zeros(2), r"parts.b.sigma: shape \(2,\); it should be \(k\) = \(3\)"),
        ("parts.1.sigma", np.full(3, -INF), r"parts.b.sigma\[0\]: -inf; it should be numbers from 0"),
        ("parts.1.sigma", "worst", r"parts.b.sigma: 'worst'; it should be one of best"),
        ("names", [1], r"names\[0\]: 1; it should be text"),
        (
            "covariance",
            np.array([[2.0, 1.0], [1.1, 3.0]]),
            r"covariance\[0, 1\]: 1.0; it should be a covariance: finite",
        ),
        ("covariance", np.diag([2.0, -1.0]), r"covariance: the variance -1.0; it should be a covariance"),
        ("covariance", np.array([[1.0, 4.0], [4.0, 1.0]]), r"covariance\[0, 1\]: 4.0; it should be a covariance"),
        ("packed", np.array([[1.0, 1, 1], [1, -1, 1], [0, 0, 0]]), r"packed\[1, 1\]: -1.0; it should be a covariance"),
        ("packed", np.array([[1.0, 1, 1], [1, 1, 1], [0, 0, 2]]), r"packed\[2, 2\]: 2.0; it should be a covariance"),
        ("pose", np.ones((2, 3)), r"pose: a map that has no inverse; it should be one that has"),
        ("labels", np.zeros(3), r"labels: an array of float64; it should be an array of names"),
        ("error_px", NAN, r"error_px: nan; it should be finite, a number from 0 to 1 \[pix\]"),
        ("error_px", "1", r"error_px: '1'; it should be a number"),
        ("error_px", None, r"error_px: None; it should be a number"),
        ("count", 1.5, r"count: 1.5; it should be an integer"),
        ("good", 1, r"good: 1; it should be true or false"),
        ("words", {1: 2.0}, r"words: the name 1; it should be entries whose names are text"),
        ("words", {"a": INF}, r"words.a: inf; it should be finite, a number"),
    ],
)
def test_refusals(path, value, message):
    tree = to_tree(whole())
    *outer, last = path.split(".")
    place = tree
    for key in outer:
        place = place[int(key) if key.isdigit() else key]
    place[int(last) if last.isdigit() else last] = value
    with pytest.raises(ValueError, match=message):
        from_tree(Whole, tree)


def test_large_covariances_are_looked_at_in_all_rows():
    """Blocks of rows by themselves, the last ones too; rounding errors are none."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(600, 3))
    tree = to_tree(whole(mean=np.zeros((1, 1201)), packed=None, labels=None))
    tree["covariance"] = root @ root.T + np.eye(600)
    tree["covariance"][3, 7] *= 1 + 1e-12
    from_tree(Whole, tree)
    tree["covariance"][599, 598] += 1e-3
    with pytest.raises(ValueError, match=r"covariance, from row 512 on \[86, 599\]: "):
        from_tree(Whole, tree)
