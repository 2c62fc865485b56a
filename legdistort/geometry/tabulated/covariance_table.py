"""Covariances of displacements on a regular grid of nodes, linear in between."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ...runtime.trees.facts import array, number
from .linear import interpolated

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

#: Nodes along an axis.
_NODES = 33


@dataclass(frozen=True, eq=False)
class CovarianceTable:
    """Covariances of displacements of a detector.

    Attributes
    ----------
    values : ndarray, shape (3, ny, nx)
        xx, yy, xy at the nodes, px^2.
    first, step : tuple
        ``(x, y)`` of the first node and between the nodes, pixels.
    """

    values: np.ndarray = field(metadata=array(3, "rows", "columns", unit="pix2"))
    first: tuple[float, float] = field(metadata=number(unit="pix"))
    step: tuple[float, float] = field(metadata=number(minimum=0, unit="pix"))

    @classmethod
    def of(cls, covariances: Callable[[np.ndarray], np.ndarray], shape: tuple[int, int]) -> CovarianceTable:
        """Tabulate covariances, positions (n, 2) -> (n, 2, 2), over a detector of `shape` (ny, nx)."""
        x, y = (np.linspace(-0.5, n - 0.5, _NODES) for n in shape[::-1])
        nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        made = np.asarray(covariances(nodes))
        values = np.stack([made[:, 0, 0], made[:, 1, 1], made[:, 0, 1]]).reshape(3, len(y), len(x))
        return cls(values, (float(x[0]), float(y[0])), (float(x[1] - x[0]), float(y[1] - y[0])))

    def __call__(self, q: ArrayLike) -> np.ndarray:
        """Covariances (n, 2, 2) at positions (n, 2); beyond the nodes those at the nearest place within."""
        last = np.array(self.first) + np.array(self.step) * (np.array(self.values.shape[:0:-1]) - 1)
        xx, yy, xy = interpolated(self.values, self.first, self.step, np.clip(q, self.first, last)).T
        return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-1)

    def scaled(self, factor: float) -> CovarianceTable:
        """Those of errors times a factor."""
        return CovarianceTable(factor**2 * self.values, self.first, self.step)
