"""Covariances of a solution in its gauge, computed when first asked for."""

from functools import cached_property

import numpy as np

from ...exceptions import AssumptionWarning, warn
from ...results.gauge import UnknownDirection
from . import criterion, elimination, reduced_system
from .problem import State

#: Beyond this many coefficients the dense covariance is replaced by its diagonal blocks.
DENSE_LIMIT = 8000


class Uncertainty:
    """Errors of coefficients and star positions (relative: in the gauge).

    ``cov(A) = S^-1`` on the constraints of the gauge and
    ``cov(X_j) = V_j^-1 + V_j^-1 E cov(A) E' V_j^-1``.

    Parameters
    ----------
    problem : Problem
    blocks : Blocks
        At the solution.
    gauge : Gauge
    scale : float
        Factor on all standard deviations (1: the stated errors are taken as they are).
    coefficients : ndarray, optional
        Covariance of the coefficients, if they were found in another way than with the stars, `scale` in it.
    shared_errors : ndarray, shape (3, n_stars), optional
        Covariance xx, yy, xy of star positions by errors that exposures share, beside that of independent ones, px^2.
    """

    def __init__(self, problem, blocks, gauge, *, scale=1.0, coefficients=None, shared_errors=None):
        self._problem, self._blocks, self._gauge, self._scale = problem, blocks, gauge, scale
        self._given, self._shared = coefficients, 0.0 if shared_errors is None else shared_errors

    @cached_property
    def coefficients(self):
        """Covariance of the fitted coefficients, shape (n_exposures * 2 n_modes,) squared, px^2; x modes first."""
        if self._given is not None:
            return self._given
        problem, blocks = self._problem, self._blocks
        n = problem.n_exposures * 2 * problem.n_modes
        if n <= DENSE_LIMIT:
            return self._scale**2 * reduced_system.Direct(problem, blocks, self._gauge).covariance()
        warn(
            f"{n} coefficients: their covariance is approximated by one block an exposure (stars taken as known)",
            AssumptionWarning,
        )
        size = 2 * problem.n_modes
        out = np.zeros((problem.n_exposures, size, problem.n_exposures, size), dtype=np.float32)
        index = np.arange(problem.n_exposures)
        out[index, :, index, :] = self._scale**2 * np.linalg.inv(blocks.u)
        return out.reshape(n, n)

    @cached_property
    def stars(self):
        """Covariance xx, yy, xy of every star's position in the gauge, shape (3, n_stars), px^2."""
        problem, blocks = self._problem, self._blocks
        inverse = elimination.inverse_star_blocks(blocks.v)
        l00, l10, l11 = elimination.star_roots(inverse)
        inner = np.concatenate(
            [_block_diagonal(factor, self.coefficients) for factor in elimination.star_factors(problem, blocks)], axis=1
        )
        c00, c11, c01 = inner / self._scale**2
        extra_xx = l00**2 * c00
        extra_xy = l00 * (l10 * c00 + l11 * c01)
        extra_yy = l10**2 * c00 + 2 * l10 * l11 * c01 + l11**2 * c11
        out = self._scale**2 * (inverse + np.stack([extra_xx, extra_yy, extra_xy])) + self._shared
        out[:, blocks.v[0] <= 0] = np.nan
        return out

    @cached_property
    def system(self):
        """The reduced system at the solution."""
        return reduced_system.reduced_system(self._problem, self._blocks, self._gauge)

    @cached_property
    def directions(self):
        """See `legdistort.results.gauge.Gauge.directions`."""
        return self._directions(self.system)

    def _directions(self, system):
        gauge = self._gauge
        moved = np.stack([system.follow(d) for d in system.moves[: gauge.n_constraints]], axis=2)
        return -(moved @ gauge.reach).transpose(1, 0, 2)

    def unknown_at(self, positions, coefficients, poses):
        """How the directions of `Gauge.unknown` move the stars where the solution has moved to: (2 n_stars, m).

        All x first; each for the same change of what holds the solution as here. They turn as the solution moves along
        them, which is of second order.
        """
        n, system = self._gauge.n_constraints, self._system_at(positions, coefficients, poses)
        maps = self._directions(system)
        columns = [(maps @ each.map).T.ravel() for each in self._gauge.unknown_maps]
        here, there = self.system.moves[n:], system.moves[n:]
        if self.weak:
            columns += [
                system.follow(d).ravel() / self._unit(self.system.follow(h)) for h, d in zip(here, there, strict=True)
            ]
        return np.stack(columns, axis=1)

    def directions_at(self, positions, coefficients, poses):
        """`directions` where the solution has moved to, (2 n_stars, 2 n_modes), all x first."""
        maps = self._directions(self._system_at(positions, coefficients, poses))
        return maps.transpose(1, 0, 2).reshape(2 * len(maps), -1)

    def _system_at(self, positions, coefficients, poses):
        """The reduced system there, with the same constraints."""
        blocks = criterion.linearise(self._problem, State(positions.T, coefficients, poses))
        rows = self.system.rows[self._gauge.n_constraints :]
        return reduced_system.reduced_system(self._problem, blocks, self._gauge, rows)

    def _unit(self, stars):
        """Rms per axis of what moves the stars (2, n_stars)."""
        return np.sqrt(np.mean(stars[:, self._blocks.v[0] > 0] ** 2))

    @cached_property
    def bends(self):
        """Covariance of star positions with the bend that leads to the convention, (n_stars, 2, 2 n_modes), px^2.

        See `legdistort.results.gauge.Gauge.to_convention`; None where the convention holds, or the covariance of the
        coefficients is approximated.
        """
        problem, blocks = self._problem, self._blocks
        if self._gauge.to_convention is None or len(self.coefficients) > DENSE_LIMIT:
            return None
        inverse, moved = elimination.inverse_star_blocks(blocks.v), []
        for errors in self._gauge.bend_errors(self.coefficients)[0].T:
            on_stars = elimination.to_stars(problem, blocks, errors.reshape(problem.n_exposures, -1))
            moved.append(-elimination.symmetric_times(inverse, on_stars))
        return np.stack(moved, axis=2).transpose(1, 0, 2)

    @cached_property
    def weak(self):
        """Directions of a distortion that exposures share and do not determine, as a tuple of `UnknownDirection`."""
        problem = self._problem
        if not problem.unknowns.shared or problem.static_sigma is not None or not self.system.n_weak:
            return ()
        system = self.system
        made = []
        for d in system.moves[self._gauge.n_constraints :]:
            stars, coefficients = system.follow(d), problem.unknowns.spread(d)
            unit = self._unit(stars)
            made.append(
                UnknownDirection("static", stars.T / unit, (coefficients / unit).reshape(len(coefficients), 2, -1))
            )
        return tuple(made)

    @cached_property
    def star_matrix(self):
        """Covariance between all star positions in the gauge, shape (2 n_stars,) squared, px^2; all x first."""
        problem, blocks = self._problem, self._blocks
        inverse = elimination.inverse_star_blocks(blocks.v)
        n = problem.n_stars
        alone = _star_blocks(inverse)
        coupling = np.zeros((2, n, problem.n_exposures, 2 * problem.n_modes))
        for i in range(problem.n_exposures):
            part = problem.part(i)
            f, b = blocks.coupling[:, :, part], blocks.values[:, part]
            coupling[:, problem.star[part], i] = np.einsum("can,mn->cnam", f, b).reshape(2, b.shape[1], -1)
        spread = alone @ coupling.reshape(2 * n, -1)
        shared = _star_blocks(np.broadcast_to(self._shared, inverse.shape))
        return self._scale**2 * alone + shared + spread @ self.coefficients @ spread.T


def _star_blocks(block):
    """Symmetric 2 x 2 blocks (3, n) of the stars as one matrix (2 n, 2 n), all x first."""
    return np.block([[np.diag(block[0]), np.diag(block[2])], [np.diag(block[2]), np.diag(block[1])]])


def _block_diagonal(factor, covariance):
    """2 x 2 diagonal blocks xx, yy, xy of ``factor' C factor`` for factors (n, 2 n_stars), shape (3, n_stars)."""
    half = factor.shape[1] // 2
    product = covariance @ factor
    x, y = factor[:, :half], factor[:, half:]
    cx, cy = product[:, :half], product[:, half:]
    return np.stack([np.einsum("nj,nj->j", a, b) for a, b in ((x, cx), (y, cy), (x, cy))])
