"""Dataclasses to trees of plain arrays, numbers and text, and back, by their fields, type hints and facts."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from .facts import KEY, Facts

_NO_FACTS = Facts()
#: Kinds of numpy's dtypes by what an array holds.
_KINDS = {"numbers": "fiu", "integers": "iu", "booleans": "b", "names": "USiu"}
_WORDS = {float: "a number", int: "an integer", bool: "true or false", str: "text", np.ndarray: "an array"}
#: Rounding errors of covariances against their largest variance.
_ROUNDING = 1e-9
#: Determinant of a map over the squares of its entries, below which it has no inverse to speak of.
_FLAT = 1e-15
_ROWS = 256


def to_tree(given: Any, kind: type | None = None, *, plain: bool = False) -> dict[str, Any]:
    """A dataclass as a dict of dicts, lists, arrays, numbers and text.

    Parameters
    ----------
    given : object
    kind : type, optional
        The dataclass whose fields are taken of it, if it is another class.
    plain : bool
        Whether arrays become lists.
    """
    return {
        entry: _plain(getattr(given, name), facts, plain)
        for entry, (name, facts, *_) in _stored(kind or type(given)).items()
    }


def from_tree(
    kind: Any, tree: Any, where: str = "tree", *, sizes: dict[str, int] | None = None, strict: bool = True
) -> Any:
    """What `to_tree` took apart, checked.

    Entries for fields with a default may be missing.

    Parameters
    ----------
    kind : type or type hint
        A dataclass, or what is made of them: ``tuple[Kind, ...]``, ``Kind | None``.
    tree : dict, list or None
    where : str
        How messages call it.
    sizes : dict, optional
        Dimensions that are known, ``{name: size}``; those that are found are added.
    strict : bool
        Whether entries that no field has are refused; else they are ignored.

    Raises
    ------
    ValueError
        Naming the entry, what stands there and what should.
    """
    return _Reader({} if sizes is None else sizes, strict).value(kind, _NO_FACTS, tree, where)


@cache
def _stored(kind):
    """``{entry: (name, facts, hint, required)}`` of the fields of a dataclass that files have."""
    hints, out = get_type_hints(kind), {}
    for field in fields(kind):
        facts = field.metadata.get(KEY, _NO_FACTS)
        if facts.stored:
            required = field.default is MISSING and field.default_factory is MISSING
            out[facts.entry or field.name] = field.name, facts, hints[field.name], required
    return out


def _plain(value, facts, plain):
    if is_dataclass(value):
        return to_tree(value, plain=plain)
    if facts.key:
        return [{facts.key: key} | to_tree(each, plain=plain) for key, each in value.items()]
    if isinstance(value, dict):
        return {key: _plain(each, _NO_FACTS, plain) for key, each in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(each, _NO_FACTS, plain) for each in value]
    if isinstance(value, np.generic):
        return value.item()
    return value.tolist() if plain and isinstance(value, np.ndarray) else value


def _refuse(where, what, meaning):
    raise ValueError(f"entry {where}: {what}; it should be {meaning}")


def _short(value):
    """A value in messages."""
    return f"an array of shape {tuple(value.shape)}" if hasattr(value, "shape") else repr(value)[:80]


class _Reader:
    """Makes objects of entries; knows the sizes that were found, those of one object apart."""

    def __init__(self, sizes, strict):
        self.sizes, self.own, self.strict = sizes, {}, strict

    def value(self, hint, facts, value, where):
        """What stands at an entry, as its type hint and facts have it."""
        hints = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        hint = next((each for each in hints if _suits(each, facts, value)), None)
        if hint is None:
            _refuse(where, _short(value), " or ".join(_called(each, facts) for each in hints))
        origin, inside = get_origin(hint) or hint, get_args(hint)
        if is_dataclass(hint):
            return self._made(hint, value, where)
        if origin is tuple:
            return self._tuple(inside, facts, value, where)
        if origin is dict:
            return self._dict(inside[1] if inside else Any, facts, value, where)
        if hint is np.ndarray:
            return self._array(facts, value, where)
        if hint in (int, float):
            _check_numbers(np.asarray(value), facts, where)
        elif hint is str and facts.choices and value not in facts.choices:
            _refuse(where, repr(value)[:80], f"one of {', '.join(facts.choices)}")
        return _own(value) if hint is Any else value

    def _made(self, kind, tree, where):
        stored, given, outside = _stored(kind), {}, self.own
        unknown = [str(entry)[:40] for entry in tree if entry not in stored]
        if self.strict and unknown:
            _refuse(where, f"unknown {', '.join(unknown[:5])}", f"made of {', '.join(stored)}")
        self.own = {}
        for entry, (name, facts, hint, required) in stored.items():
            if entry in tree:
                given[name] = self.value(hint, facts, tree[entry], f"{where}.{entry}")
            elif required:
                _refuse(where, f"{entry!r} is missing", f"made of {', '.join(stored)}")
        self.own = outside
        return kind(**given)

    def _tuple(self, inside, facts, value, where):
        several = inside[-1] is ...
        if not several and len(value) != len(inside):
            _refuse(where, f"a list of {len(value)}", f"one of {len(inside)}")
        if facts.length and not self._has_shape((facts.length,), (len(value),)):
            _refuse(where, f"a list of {len(value)}", f"one of {self._shape((facts.length,))}")
        hints = [inside[0]] * len(value) if several else inside
        return tuple(
            self.value(hint, facts, each, f"{where}[{k}]")
            for k, (hint, each) in enumerate(zip(hints, value, strict=True))
        )

    def _dict(self, hint, facts, value, where):
        if facts.key:
            value = self._by_key(facts.key, value, where)
        for key in value:
            if not isinstance(key, str):
                _refuse(where, f"the name {key!r}", "entries whose names are text")
        facts = _NO_FACTS if facts.key else facts
        return {key: self.value(hint, facts, each, f"{where}.{key}") for key, each in value.items()}

    def _by_key(self, entry, value, where):
        out = {}
        for k, each in enumerate(value):
            if not isinstance(each, dict) or not isinstance(each.get(entry), str):
                _refuse(f"{where}[{k}]", _short(each), f"entries by name with a text {entry!r}")
            if each[entry] in out:
                raise ValueError(f"two of {where} have the same {entry} {each[entry]!r}")
            out[each[entry]] = {name: inner for name, inner in each.items() if name != entry}
        return out

    def _array(self, facts, value, where):
        try:
            array = np.array(value)  # of our own
        except ValueError:
            _refuse(where, "a list of lists of different lengths", "an array")
        if array.dtype.kind not in _KINDS[facts.holds]:
            _refuse(where, f"an array of {array.dtype}", f"an array of {facts.holds}")
        array = array.astype(float, copy=False) if facts.holds == "numbers" else array
        shapes = [shape for shape in (facts.shape, facts.blocks) if shape is not None]
        if shapes and not any(self._has_shape(shape, array.shape) for shape in shapes):
            _refuse(where, f"shape {array.shape}", " or ".join(self._shape(shape) for shape in shapes))
        _check_numbers(array, facts, where)
        if facts.covariance or facts.packed:
            _check_covariance(array, facts, where)
        if facts.invertible:
            linear = array[..., :2]
            flat = ~(np.abs(np.linalg.det(linear)) > _FLAT * np.sum(linear**2, axis=(-2, -1)))
            if flat.any():
                at = f"[{int(np.argmax(flat))}]" if flat.ndim else ""
                _refuse(where + at, "a map that has no inverse", "one that has")
        return array

    def _has_shape(self, expected, found):
        """Whether a shape is as expected; names of which nothing was known take their sizes from it."""
        if len(expected) != len(found):
            return False
        new = {}
        for each, n in zip(expected, found, strict=True):
            known, factor, name = _terms(each, self.sizes | self.own | new)
            if name is None and known != n:
                return False
            if name is not None:
                size, rest = divmod(n - known, factor)
                if rest or size < 0:
                    return False
                new[name] = size
        for name, size in new.items():
            (self.sizes if name.startswith("n_") else self.own)[name] = size
        return True

    def _shape(self, expected):
        """A shape in words, with what is known of it."""
        terms = [(str(each), *_terms(each, self.sizes | self.own)) for each in expected]
        numbers = [str(known) if name is None else "any" for _, known, _, name in terms]
        names = [each for each, *_ in terms]
        said = "(" + ", ".join(names) + ")"
        return said if names == numbers or set(numbers) == {"any"} else f"{said} = ({', '.join(numbers)})"


def _terms(dimension, sizes):
    """A sum of products: what is known of it, and the factor and name of the size that is not; None if all are."""
    known, factor, unknown = 0, 0, None
    for product in str(dimension).split("+"):
        size, name = 1, None
        for word in product.split():
            if word.isdigit() or word in sizes:
                size *= int(word) if word.isdigit() else sizes[word]
            else:
                name = word
        if name is None:
            known += size
        else:
            factor, unknown = size, name
    return known, factor, unknown


def _suits(hint, facts, value):
    """Whether a value has the type of a hint."""
    if hint is Any or hint is NoneType:
        return hint is Any or value is None
    origin = get_origin(hint) or hint
    if origin is np.ndarray:
        return hasattr(value, "shape") or isinstance(value, list)
    if origin is tuple or facts.key:
        return isinstance(value, (list, tuple))
    if origin is dict or is_dataclass(origin):
        return isinstance(value, dict)
    if isinstance(value, bool) or origin is bool:
        return isinstance(value, bool) and origin is bool
    return isinstance(value, (int, float) if origin is float else origin)


def _called(hint, facts):
    """What a hint allows, in words."""
    if hint is NoneType:
        return "null"
    if (get_origin(hint) or hint) is tuple or facts.key:
        return "a list"
    return _WORDS.get(hint, "entries by name")


def _own(value):
    """Whatever stands there, arrays of our own for those of a file."""
    if isinstance(value, dict):
        return {key: _own(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_own(each) for each in value]
    return np.array(value) if hasattr(value, "shape") else value


def _check_numbers(array, facts, where):
    if array.dtype.kind not in "fiu" or facts.holds == "names" or not array.size:
        return
    if facts.minimum <= array.min() and array.max() <= facts.maximum:  # false for NaN
        return
    bad = ~((array >= facts.minimum) & (array <= facts.maximum))
    bad &= ~(np.isnan(array) & facts.nan) & ~(np.isposinf(array) & facts.infinite)
    if bad.any():
        _refuse_at(bad, array, facts, where)


def _refuse_at(bad, array, facts, where):
    """Refuse the first value that is bad."""
    place = np.unravel_index(np.argmax(bad), bad.shape)
    at = f"[{', '.join(map(str, place))}]" if place else ""
    _refuse(where + at, f"{array[place]}", facts.words())


def _check_covariance(array, facts, where):
    """Refuse what is certainly no covariance: not symmetric, negative variances, larger covariances than variances."""
    if facts.packed:
        variances = array[_variances(len(array))]
        bad = np.zeros(array.shape, dtype=bool)
        bad[_variances(len(array))] = variances < -_ROUNDING * np.fmax.reduce(np.abs(variances), axis=None, initial=0)
        bad[2] = array[2] ** 2 > (1 + 1e-6) * array[0] * array[1] + _ROUNDING * np.maximum(array[0], array[1]) ** 2
        if bad.any():
            _refuse_at(bad, array, facts, where)
        return
    variances = np.einsum("...aa->...a", array)
    largest = np.max(variances, axis=-1, initial=0, where=np.isfinite(variances))[..., None, None]
    turned = np.swapaxes(array, -1, -2)
    for first in range(0, array.shape[-2], _ROWS):  # what is in work at a time stays small
        rows = (..., slice(first, first + _ROWS), slice(None))
        part, other = array[rows], turned[rows]
        bad = (part != other) & ~(np.abs(part - other) <= _ROUNDING * largest)
        bad |= np.isfinite(part) & (np.abs(part) > (1 + 1e-6) * largest)
        if bad.any():
            _refuse_at(bad, part, facts, f"{where}, from row {first} on " if first else where)
    bad = variances < -_ROUNDING * largest[..., 0]
    if bad.any():
        _refuse(where, f"the variance {variances[bad][0]}", facts.words())


def _variances(n):
    """Rows of variances among n packed ones: xx, yy, xy, then row by row."""
    size = int((np.sqrt(8 * n + 1) - 1) / 2)
    return [0, 1, *(k * (k + 3) // 2 for k in range(2, size))]
