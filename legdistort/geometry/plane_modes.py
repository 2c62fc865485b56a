"""Modes of the reference plane: a Legendre series on the part of it that exposures with common stars cover.

Exposures in several groups without a common star, such as those of several fields of the sky, have a part each. A map
of one of them leaves the others as they are, so that every part has modes of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from . import basis
from .detector_modes import dynamic_basis, dynamic_degrees, similarity_basis

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class PlaneModes:
    """The modes, by degree; each for one field after the other.

    Attributes
    ----------
    boxes : ndarray, shape (n_fields, 2, 2)
        Centre and half size of the box of every field, pixels of the reference plane. A position belongs to the one
        that it lies in, or nearest to.
    n : int
        Modes per axis of a field.
    """

    boxes: np.ndarray
    n: int

    @property
    def n_fields(self) -> int:
        """Number of fields."""
        return len(self.boxes)

    @property
    def size(self) -> int:
        """Modes per axis of all fields."""
        return self.n * self.n_fields

    @property
    def shapes(self) -> list[tuple[float, float]]:
        """``(ny, nx)`` of every box, pixels."""
        return [(float(2 * half[1]), float(2 * half[0])) for half in self.boxes[:, 1]]

    @property
    def degrees(self) -> np.ndarray:
        """Degree of every mode, (size,)."""
        return np.repeat(np.add(*basis.orders(basis.degree_of(self.n))), self.n_fields)

    def fields_of(self, xy: ArrayLike) -> np.ndarray:
        """Number of the field of positions (n, 2)."""
        xy = np.asarray(xy)
        if self.n_fields == 1:
            return np.zeros(len(xy), dtype=int)
        off = np.abs(xy[:, None] - self.boxes[:, 0]) / self.boxes[:, 1]
        return off.max(axis=2).argmin(axis=1)

    def at(self, xy: ArrayLike) -> np.ndarray:
        """Values (size, n) at positions (n, 2) of the reference plane."""
        xy = np.asarray(xy)
        field = self.fields_of(xy)
        u, v = ((xy - self.boxes[field, 0]) / self.boxes[field, 1]).T
        values = basis.values(basis.degree_of(self.n), u, v)
        if self.n_fields == 1:
            return values
        out = np.zeros((self.n, self.n_fields, len(xy)))
        out[:, field, np.arange(len(xy))] = values
        return out.reshape(self.size, len(xy))

    def of_field(self, rows: np.ndarray, field: int) -> np.ndarray:
        """Rows (k, 2 n) of modes of one field on those of all, (k, 2 size)."""
        out = np.zeros((len(rows), 2, self.n, self.n_fields))
        out[..., field] = rows.reshape(len(rows), 2, self.n)
        return out.reshape(len(rows), 2 * self.size)

    def _by_field(self, function: Callable[..., Any]) -> np.ndarray:
        made = [self.of_field(function(shape, self.n), field) for field, shape in enumerate(self.shapes)]
        return np.concatenate(made)

    @cached_property
    def similar(self) -> np.ndarray:
        """Orthonormal rows (4 n_fields, 2 size) of the similarities of every field; shifts alone at degree 0."""
        return self._by_field(similarity_basis)

    @property
    def others(self) -> np.ndarray:
        """Orthonormal rows of all others, (2 size - 4 n_fields, 2 size)."""
        return self._by_field(dynamic_basis)

    @property
    def degrees_of_others(self) -> np.ndarray:
        """Degree of each of these rows."""
        return np.tile(dynamic_degrees(self.n), self.n_fields)
