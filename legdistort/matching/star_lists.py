"""Star lists and the polynomial maps that carry one to another."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import basis, similarity

#: Degree of a map and the number of pairs that it asks for; with fewer it is a similarity (degree 0).
NEEDED = ((5, 84), (3, 15), (2, 10), (1, 6))


@dataclass(frozen=True, eq=False)
class StarList:
    """Detections of one exposure.

    Attributes
    ----------
    xy : ndarray, shape (n, 2)
    error : ndarray, shape (n,)
        Total position error, pixels.
    shape : tuple
        ``(ny, nx)``.
    flux : ndarray, shape (n,), or None
    """

    xy: np.ndarray
    error: np.ndarray
    shape: tuple
    flux: np.ndarray | None = None

    def __len__(self):
        return len(self.xy)

    @cached_property
    def tree(self):
        """KD-tree of the positions."""
        return cKDTree(self.xy)

    @cached_property
    def ranking(self):
        """Indices, brightest first; None without fluxes."""
        return None if self.flux is None else np.argsort(-self.flux, kind="stable")

    @property
    def area(self):
        """Area of the detector, pixels squared."""
        return float(self.shape[0] * self.shape[1])

    def on_detector(self, xy):
        """Which positions (n, 2) lie on the detector."""
        return np.all((xy > -0.5) & (xy < np.array(self.shape[::-1]) - 0.5), axis=1)

    def subset(self, keep):
        """The list with some of its rows (boolean mask)."""
        return StarList(self.xy[keep], self.error[keep], self.shape, None if self.flux is None else self.flux[keep])


@dataclass(frozen=True, eq=False)
class Warp:
    """Polynomial map from one list to another: coefficients (n_modes, 2) in the basis of the source's detector.

    `covariance` is that of the coefficients for positions of unit variance, (n_modes, n_modes); None for a similarity.
    """

    coefficients: np.ndarray
    shape: tuple
    covariance: np.ndarray | None = None

    @property
    def n_fixing(self):
        """Number of pairs of positions that fix it: 2 for a similarity, else that of its modes."""
        return 2 if self.covariance is None else len(self.coefficients)

    def __call__(self, xy):
        """Map positions (n, 2)."""
        return self._design(xy) @ self.coefficients

    def with_leverage(self, xy):
        """Mapped positions (n, 2) and their variance (n,) over that of the positions fitted.

        The variance is large where the map extrapolates, and 0 where it is not known.
        """
        design = self._design(xy)
        if self.covariance is None:
            return design @ self.coefficients, np.zeros(len(xy))
        return design @ self.coefficients, np.einsum("ij,ij->i", design @ self.covariance, design)

    def _design(self, xy):
        return basis.values(basis.degree_of(len(self.coefficients)), *basis.normalize(xy, self.shape)).T

    @classmethod
    def from_pose(cls, pose, shape):
        """The same map as a pose."""
        corners = np.array([[0.0, 0], [shape[1], 0], [0, shape[0]]])
        design = basis.values(1, *basis.normalize(corners, shape)).T
        return cls(np.linalg.solve(design, similarity.apply(pose, corners)), shape)


def allowed_degree(n):
    """Degree of the map that a number of pairs supports; 0 for a similarity."""
    return next((degree for degree, needed in NEEDED if n >= needed), 0)


def fit_warp(p, q, shape, degree, *, weights, width, parity):
    """Weighted polynomial from `p` to `q` (n, 2), for degree 0 a similarity of that parity.

    Modes beyond the affine ones are held to one per cent of the field.
    """
    if degree == 0:
        return Warp.from_pose(similarity.fit_similarity(p, q, weights=weights, parity=parity), shape)
    design = basis.values(degree, *basis.normalize(p, shape))
    i, j = basis.orders(degree)
    ridge = np.where(i + j > 1, (width / (0.01 * max(shape))) ** 2, 1e-9)
    covariance = np.linalg.inv((design * weights) @ design.T + np.diag(ridge))
    return Warp(covariance @ ((design * weights) @ q), shape, covariance)
