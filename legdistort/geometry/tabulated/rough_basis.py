"""Functions on a detector that are rough, with curvature as the measure of it, beside a Legendre series.

Cubic B-splines on a regular grid of knots. Their coefficients have the covariance of a field whose curvature (squared
second derivatives, integrated over the detector) has one size everywhere, as of smoothing splines (Wahba 1990); what
the Legendre modes up to a degree can do is taken off every function, so that nothing is there twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import linalg, sparse
from scipy.interpolate import BSpline

from ...runtime.trees.facts import SIZE, number
from .. import basis
from .displacement_table import MARGIN, DisplacementTable

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_CUBIC = 3
#: Curvature, in units of the field over half the longer side squared, of what else would have none: it is taken off.
_LOW = 0.1
#: Nodes of a table by knots, at least; positions that are looked at together.
_FINE, _PIECE = 8, 1 << 15


@dataclass(frozen=True)
class RoughBasis:
    """Independent functions of unit size: fields that are sums of them with independent numbers of one size are rough.

    They are made on the detector and as far beyond its edges as a `DisplacementTable` reaches, where stars that fall on
    the edges have their undistorted places.

    Attributes
    ----------
    splines : tuple of int
        B-splines along x and along y, 4 or more; there are as many functions as their products.
    degree : int
        Total degree of the Legendre series that none of them has a part of.
    shape : tuple of int
        ``(ny, nx)`` of the detector.
    """

    splines: tuple[int, int] = field(metadata=number(minimum=4, maximum=100))
    degree: int = field(metadata=number(minimum=0, maximum=basis.MAX_DEGREE))
    shape: tuple[int, int] = field(metadata=SIZE)

    @property
    def n(self) -> int:
        """Number of functions."""
        return self.splines[0] * self.splines[1]

    def __call__(self, q: ArrayLike) -> np.ndarray:
        """Values (n, n_functions) at undistorted pixels (n, 2); farther beyond the detector those at the end."""
        splines, modes = self._parts(q)
        return splines @ self._root - modes.T @ (self._taken_off @ self._root)

    def fields(self, q: ArrayLike, numbers: np.ndarray) -> np.ndarray:
        """Sums (n, k) of the functions with numbers (n_functions, k), which takes less than their values."""
        q, weights = np.asarray(q, dtype=float), self._root @ numbers
        low = self._taken_off @ weights
        pieces = [self._parts(q[first : first + _PIECE]) for first in range(0, len(q), _PIECE)]
        return np.concatenate([splines @ weights - modes.T @ low for splines, modes in pieces])

    def table(self, numbers: np.ndarray) -> DisplacementTable:
        """The displacements of numbers (2, n_functions), x and y, as a table whose nodes are near enough."""

        def displacements(q):
            return self.fields(q, np.transpose(numbers))

        knots = np.array(self.shape[::-1]) / (np.array(self.splines) - _CUBIC)
        return DisplacementTable.fine_enough(displacements, self.shape, knots / _FINE)

    def _parts(self, q):
        """B-splines, sparse (n, n_functions), and Legendre modes (n_modes, n) at undistorted pixels (n, 2)."""
        reach = 1 + 2 * MARGIN * max(self.shape) / np.array(self.shape[::-1])
        u, v = (np.clip(w / r, -1, 1) for w, r in zip(basis.normalize(q, self.shape), reach, strict=True))
        along, across = (BSpline.design_matrix(w, _knots(n), _CUBIC) for w, n in zip((u, v), self.splines, strict=True))
        k = _CUBIC + 1
        column = along.indices.reshape(-1, k, 1) * self.splines[1] + across.indices.reshape(-1, 1, k)
        value = along.data.reshape(-1, k, 1) * across.data.reshape(-1, 1, k)
        rows = np.arange(len(u) + 1) * k * k
        splines = sparse.csr_array((value.ravel(), column.ravel(), rows), shape=(len(u), self.n))
        return splines, basis.values(self.degree, u, v)

    @property
    def _root(self):
        """Coefficients of splines (n, n), of every function."""
        return _made(self.splines, self.degree, self.shape)[0]

    @property
    def _taken_off(self):
        """Legendre modes (n_modes, n) of every spline."""
        return _made(self.splines, self.degree, self.shape)[1]


@lru_cache(maxsize=8)
def _made(splines, degree, shape):
    """Coefficients of splines (n, n) of every function, and Legendre modes (n_modes, n) of every spline."""
    longer = max(shape)
    grams, modes = [], []
    for n, side in zip(splines, shape[::-1], strict=True):
        x, weight, values = _quadrature(n)
        grams.append([(each.T * weight) @ each * (longer / side) ** (2 * k) for k, each in enumerate(values)])
        modes.append((basis.legendre(degree, x) * weight) @ values[0])
    (x0, x1, x2), (y0, y1, y2) = grams
    mean = np.kron(x0, y0) / 4
    curvature = (np.kron(x2, y0) + 2 * np.kron(x1, y1) + np.kron(x0, y2)) / 4
    factor = linalg.cholesky(curvature + _LOW * mean, lower=True)
    root = linalg.solve_triangular(factor, np.eye(len(factor)), lower=True).T
    i, j = basis.orders(degree)
    taken = np.einsum("mx,my->mxy", modes[0][i], modes[1][j]).reshape(len(i), -1)
    low = taken @ root
    square = np.sum(root * (mean @ root)) - np.sum(low**2) / 4  # mean square over the detector of what is left
    return root / np.sqrt(square), taken


def _knots(n):
    """Of n B-splines on [-1, 1]."""
    return np.concatenate([-np.ones(_CUBIC), np.linspace(-1, 1, n - _CUBIC + 1), np.ones(_CUBIC)])


def _quadrature(n):
    """Places (m,) and weights that are exact enough for n B-splines, and their values and two derivatives (m, n)."""
    inner = np.linspace(-1, 1, n - _CUBIC + 1)
    half, (node, weight) = 1 / (n - _CUBIC), np.polynomial.legendre.leggauss(8)
    x = (inner[:-1, None] + half * (1 + node)).ravel()
    splines = BSpline(_knots(n), np.eye(n), _CUBIC)
    return x, np.tile(half * weight, n - _CUBIC), [splines(x, nu=k) for k in range(3)]
