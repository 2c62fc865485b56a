"""Many exposures of few stars: the coefficients eliminated from the normal equations in place of the stars.

With ``[U E' R'; E V 0; R 0 0]`` for coefficients, stars and the constraints of the gauge, what is left without the
coefficients has the stars and the constraints for its unknowns::

    K = [[V - E U^-1 E', -E U^-1 R'], [-R U^-1 E', -R U^-1 R']]

U is block diagonal, one block an exposure, so that K costs little however many exposures there are. Its inverse is the
covariance of all stars, and ``cov(A) = U^-1 + U^-1 [E; R]' K^-1 [E; R] U^-1``: exact, like the reduced system of the
coefficients.
"""

from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, lu_factor, lu_solve
from scipy.linalg.lapack import dgecon, dgetri

from ...results.errors.coefficient_covariance import Coupled
from . import elimination
from .reduced_base import Reduced
from .star_terms import packed, unpacked

#: Reciprocal condition below which K, and least pivot below which a block of U, counts as singular.
_SINGULAR, LEAST_PIVOT = 1e-14, 1e-4
_BLOCKED = 64  # columns at once of an inverse, which LAPACK makes one by one without room for them
#: Part of the information on a star, left when exposures with hardly more stars than modes are free, that is rounding.
_LOST = 1e-8


class OnStars(Reduced):
    """The normal equations of stars and constraints, the coefficients eliminated.

    For problems in which exposures share nothing. Methods are those of
    `legdistort.solving.equations.reduced_system.Direct`.

    Parameters
    ----------
    problem, blocks, gauge
    least_pivot : float
        Of the normalised block of an exposure, below which it counts as singular.

    Raises
    ------
    LinAlgError
        If the stars of an exposure do not determine its coefficients, nothing is left of the information on a star, or
        the gauge and the data do not determine all.
    """

    takes_any_gauge = False

    def __init__(self, problem, blocks, gauge, least_pivot=LEAST_PIVOT):
        super().__init__(problem, blocks, gauge)
        self.scale = np.einsum("iaa->", blocks.u) / self.unknowns.size
        unit = np.einsum("iaa->ia", blocks.u)
        if unit.min() <= 0:
            raise LinAlgError
        unit = 1 / np.sqrt(unit)
        lower = np.linalg.cholesky(unit[:, :, None] * blocks.u * unit[:, None, :])
        if np.einsum("iaa->ia", lower).min() < least_pivot:
            raise LinAlgError
        self._roots = unit[:, :, None] * np.linalg.inv(lower).mT  # U^-1 = root root'
        self._determined = self.inverse[np.diag(packed(problem.n_star))] > 0
        matrix = self._of_stars()
        before = np.diag(matrix).copy()
        for on, factor in self._factors():
            matrix[on[:, None], on] -= factor @ factor.T
        left = np.abs(np.diag(matrix))
        if not (left > _LOST * before).all():
            raise LinAlgError
        self._unit = 1 / np.sqrt(left)
        matrix *= self._unit[:, None]
        matrix *= self._unit
        size = np.abs(matrix).sum(axis=0).max()
        self._factor = lu_factor(matrix, overwrite_a=True)
        if not dgecon(self._factor[0], size)[0] > _SINGULAR:
            raise LinAlgError

    def _of_stars(self):
        """V on stars and nothing on the constraints; one where the observations of a star determine nothing."""
        n_star, n = self._determined.shape
        out = np.zeros((n_star * n + len(self.rows),) * 2)
        blocks, index = unpacked(self.blocks.v), np.arange(n_star * n).reshape(n_star, n)
        for a, b in np.ndindex(n_star, n_star):
            both = self._determined[a] & self._determined[b]
            out[index[a], index[b]] = np.where(both, blocks[:, a, b], float(a == b))
        return out

    def _factors(self):
        """Yield of every exposure the rows of the matrix that it has a part in, and ``[E; R] root`` there."""
        problem, blocks, n_star = self.problem, self.blocks, len(self._determined)
        k, of_stars = 2 * problem.n_modes, np.arange(self._determined.size).reshape(self._determined.shape)
        constraints = self._determined.size + np.arange(len(self.rows))
        own = self.rows.reshape(len(self.rows), problem.n_exposures, k)
        for i, root in enumerate(self._roots):
            part = problem.part(i)
            seen, f, b = problem.star[part], blocks.coupling[:, :, part], blocks.values[:, part]
            pulled = problem.terms.pull(i, f[:, :, None] * b).reshape(n_star, k, -1)
            stars = (pulled.swapaxes(1, 2) * self._determined[:, seen, None]).reshape(-1, k)
            yield np.append(of_stars[:, seen], constraints), np.concatenate([stars, own[:, i]]) @ root

    def _inverse_times(self, right):
        unit = self._unit if right.ndim == 1 else self._unit[:, None]
        return unit * lu_solve(self._factor, unit * right)

    def _solve(self, own, stars, target):
        """Steps of stars (2 + k, n_stars) and coefficients (n_exposures, 2 n_modes), and multipliers of the rows."""
        free = self._own_inverse(own)
        left = np.where(self._determined, stars - self._couple(free.ravel()), 0.0)
        solved = self._inverse_times(np.concatenate([left.ravel(), target - self.rows @ free.ravel()]))
        moved, pull = solved[: left.size].reshape(left.shape), solved[left.size :]
        back = elimination.to_exposures(self.problem, self.blocks, moved) + (self.rows.T @ pull).reshape(free.shape)
        return moved, free - self._own_inverse(back), pull

    def _own_inverse(self, own):
        """U^-1 of gradients (n_exposures, 2 n_modes)."""
        return np.einsum("iab,icb,ic->ia", self._roots, self._roots, own, optimize=True)

    def step(self, target, accuracy, enough=0.0):
        """As for `Direct`; exact whatever the accuracy asked for."""
        return self._solve(self.blocks.g_exposure, self.blocks.g_star, target)[:2]

    def settle(self, own, stars, accuracy=1e-8):
        """As for `Direct`."""
        return self._solve(own, stars, np.zeros(len(self.rows)))[:2]

    def respond(self, gradients):
        """As for `Direct`."""
        nothing = np.zeros(self._determined.shape)
        return np.stack([self.settle(each, nothing)[1] for each in np.moveaxis(gradients, 2, 0)], axis=2)

    @cached_property
    def moves(self):
        """As for `Direct`."""
        own, stars = np.zeros_like(self.blocks.g_exposure), np.zeros(self._determined.shape)
        return np.stack([self._solve(own, stars, unit)[1].ravel() for unit in np.eye(len(self.rows))])

    @cached_property
    def information(self):
        """As for `Direct`."""
        m = len(self.rows)
        unit = np.eye(len(self._unit))[:, -m:]
        out = -self._inverse_times(unit)[-m:]
        return (out + out.T) / 2

    @cached_property
    def pull(self):
        """As for `Direct`."""
        return self._solve(self.blocks.g_exposure, self.blocks.g_star, np.zeros(len(self.rows)))[2]

    @cached_property
    def _inverse_matrix(self):
        inverse, failed = dgetri(*self._factor, lwork=_BLOCKED * len(self._unit))
        if failed:
            raise LinAlgError
        inverse *= self._unit[:, None]
        inverse *= self._unit
        return (inverse + inverse.T) / 2

    @property
    def star_covariance(self):
        """Covariance (2 + k, n_stars) squared between all unknowns of the stars in the gauge; 0 if not determined."""
        n = self._determined.size
        known = self._determined.ravel()
        return (self._inverse_matrix[:n, :n] * known * known[:, None]).reshape(2 * self._determined.shape)

    @property
    def coupling_size(self):
        """Numbers of the factor of `coupled`."""
        return self.unknowns.size * len(self._unit)

    def coupled(self):
        """`Coupled` covariance of the coefficients in the gauge, through the stars and the constraints."""
        n_exposures, k = self._roots.shape[:2]
        out = np.zeros((n_exposures, k, len(self._unit)))
        for i, (on, factor) in enumerate(self._factors()):
            out[i][:, on] = self._roots[i] @ factor.T
        return Coupled(self._roots @ self._roots.mT, out.reshape(n_exposures * k, -1), self._inverse_matrix)

    def covariance_blocks(self):
        """Covariance of the coefficients of every exposure in the gauge, shape (n_exposures, 2 n_modes, 2 n_modes)."""
        out = np.empty_like(self._roots)
        for i, (on, factor) in enumerate(self._factors()):
            inner = np.eye(factor.shape[1]) + factor.T @ self._inverse_matrix[on[:, None], on] @ factor
            out[i] = self._roots[i] @ inner @ self._roots[i].T
        return out
