"""Test statistics of residuals and their null distributions, the leverage of the fit allowed for.

Every statistic is the part ``T = e' P e`` of chi2 that falls into some subspace P of the whitened residuals e. With all
unknowns fitted, ``e = M e_0`` with M the projector off the fit, so that T has the mean ``nu = tr(P M)`` and at most the
variance of chi2 with nu degrees of freedom. It is compared with what is left of chi2, which makes the tests independent
of a common factor on the errors: chi2 alone judges that one.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special

from ...geometry import basis
from ..equations import criterion, elimination
from ..equations.leverage import leverages

_DETERMINED = 1e-4  # information [1/px^2]: what is held wrong by some pixels shows where 100 px would be beyond doubt
_PROBES = 64  # patterns up to which a trace is exact, and random combinations beyond: right to 2 %
_RANK = 1e-3  # part of its variance without a fit that a combination must keep to count


@dataclass(frozen=True)
class Score:
    """A part of chi2.

    Attributes
    ----------
    t : float
        What falls into a subspace of the residuals.
    nu : float
        What falls into it by chance: its degrees of freedom.
    p : float
        Probability of so much or more by chance.
    rms : float
        Of what is there beyond chance, per axis over the observations, pixels.
    """

    t: float
    nu: float
    p: float
    rms: float


class Residuals:
    """Residuals of a fit with what their distribution needs.

    Parameters
    ----------
    problem : `legdistort.solving.equations.problem.Problem`
        With the weights that were in force.
    state : State
    blocks : Blocks
        At the solution.
    system : `legdistort.solving.equations.reduced_system.Direct` or Iterative
        In the gauge.
    dof : float
    """

    def __init__(self, problem, state, blocks, system, dof):
        self.problem, self.state, self.blocks, self.system, self.dof = problem, state, blocks, system, dof
        self.exposure = problem.exposure
        self.used = problem.weight[0] > 0
        patterns = self._patterns()
        self.residual = blocks.residual
        self.released = np.zeros((2, len(self.used), 0))
        if patterns.shape[2]:
            whitened = self._whiten(patterns)
            flat = whitened.reshape(-1, patterns.shape[2])
            orthonormal, triangle = np.linalg.qr(flat)
            self.released = orthonormal.reshape(whitened.shape)
            size = orthonormal.T @ self._whiten(self.residual).ravel()
            self.residual = self.residual - patterns @ np.linalg.solve(triangle, size)
            self.dof = dof - patterns.shape[2]
        self.squares = criterion.squares(problem, self.residual)
        self.chi2 = float(self.squares.sum())

    def _patterns(self):
        """Residuals (2, n, k) by unit changes of the values at which the gauge holds the common map, all else refitted.

        Holding it at values that are not the true ones leaves residuals of second order, which precise data show. They
        are no fault of the form of the distortion, so that they are taken off.
        """
        problem, blocks, system = self.problem, self.blocks, self.system
        values, vectors = np.linalg.eigh(system.information)
        along = vectors[:, values > _DETERMINED]
        out = np.zeros((2, len(self.used), along.shape[1]))
        w, f = problem.weight, blocks.coupling
        for k, d in enumerate(along.T @ system.moves[: len(values)]):
            moved = np.einsum("akn,an->kn", f, problem.placed(system.follow(d)))  # W J dX
            with np.errstate(divide="ignore", invalid="ignore"):
                moved = np.stack([w[1] * moved[0] - w[2] * moved[1], w[0] * moved[1] - w[2] * moved[0]])
                moved = moved / (w[0] * w[1] - w[2] ** 2)
            own = problem.unknowns.spread(d)
            for i in range(problem.n_exposures):
                part = problem.part(i)
                moved[:, part] += own[i].reshape(2, -1) @ blocks.values[:, part]
            out[:, :, k] = np.where(self.used, moved, 0.0)
        return out

    @cached_property
    def _roots(self):
        """L of ``L' L = W``: l00, l01, l11, each (n,)."""
        w = self.problem.weight
        l00 = np.sqrt(w[0])
        with np.errstate(divide="ignore", invalid="ignore"):
            l01 = np.where(l00 > 0, w[2] / l00, 0)
        return l00, l01, np.sqrt(np.maximum(w[1] - l01**2, 0))

    def _whiten(self, displacement):
        """Displacements (2, n, ...) in units of their errors."""
        l00, l01, l11 = (each.reshape(-1, *[1] * (displacement.ndim - 2)) for each in self._roots)
        x, y = displacement
        return np.stack([l00 * x + l01 * y, l11 * y])

    def _gradient(self, whitened):
        """L'p for what is p in units of errors, (2, n): how it pulls at the model positions."""
        l00, l01, l11 = self._roots
        x, y = whitened
        return np.stack([l00 * x, l01 * x + l11 * y])

    def _whitened_gradient(self, pulled):
        """The inverse of `_gradient`; 0 where there is no weight."""
        l00, l01, l11 = self._roots
        with np.errstate(divide="ignore", invalid="ignore"):
            x = pulled[0] / l00
            return np.where(self.used, np.stack([x, (pulled[1] - l01 * x) / l11]), 0.0)

    @cached_property
    def whitened(self):
        """Residuals (2, n) with unit covariance, were nothing fitted."""
        return self._whiten(self.residual)

    @cached_property
    def _leverages(self):
        return leverages(self.problem, self.blocks)

    @property
    def star_share(self):
        """Part of every observation's variance that the position of its star takes up, mean of the axes, (n,)."""
        return self._leverages[0]

    @cached_property
    def freedom(self):
        """Degrees of freedom, both axes, that are left to every observation, shape (n,); their sum is that of chi2."""
        free = 2 * (1 - self.star_share) * self.used
        share = 2 * self._leverages[1] * (1 - self.star_share)
        wanted, total = free.sum() - self.dof, share.sum()
        return np.maximum(free - share * (wanted / total if total > 0 else 0), 0.02 * self.used)

    def score(self, t, nu, *, tests=1, weight=None):
        """The `Score` of a part t of chi2 that should be about nu; `tests` were made of which this is the largest."""
        rest, left = self.chi2 - t, self.dof - nu
        if nu < 0.5:
            return Score(t, nu, 1.0, 0.0)
        if left > 4:
            scale = max(rest, 1e-300) / left
            p = float(special.fdtrc(nu, left, t / nu / scale))
        else:
            scale, p = 1.0, float(special.chdtrc(nu, t))
        weight = np.sum(self.problem.weight[:2]) if weight is None else weight
        return Score(t, nu, min(1.0, tests * p), float(np.sqrt(max(t - nu * scale, 0) / max(weight, 1e-300))))

    def of_rows(self, rows, *, tests=1):
        """`Score` of all the residuals of some observations."""
        weight = np.sum(self.problem.weight[:2, rows])
        return self.score(self.squares[rows].sum(), self.freedom[rows].sum(), tests=tests, weight=weight)

    def of_groups(self, labels):
        """The `Score` by group of observations, for labels (n,) from 0; negative ones belong to none."""
        n = labels.max(initial=-1) + 1
        return [self.of_rows(labels == k, tests=n) for k in range(n)]

    @cached_property
    def next_degree(self):
        """`Score` of the modes of one degree more in every exposure, and that degree."""
        problem, blocks, e = self.problem, self.blocks, self.whitened
        degree = problem.degree + 1
        t = nu = 0.0
        for i in range(problem.n_exposures):
            part = problem.part(i)
            part = np.arange(part.start, part.stop)[self.used[part]]
            if len(part) <= problem.n_modes + 1:
                continue
            values = self._values(i, part, degree)
            for k in (0, 1):
                root = np.sqrt(problem.weight[k, part])
                own, more = root * blocks.values[:, part], root * values[problem.n_modes :]
                more = more - more @ own.T @ np.linalg.pinv(own @ own.T, hermitian=True) @ own
                size, vectors = np.linalg.eigh(more @ more.T)
                kept = size > _RANK**2 * max(size[-1], 1e-300)
                kept[: max(len(size) - len(part) + problem.n_modes, 0)] = False
                u = (vectors[:, kept] / np.sqrt(size[kept])).T @ more
                t += np.sum((u @ e[k, part]) ** 2)
                nu += np.sum(u**2 * (1 - self.star_share[part])) - np.sum((u @ self.released[k, part]) ** 2)
        return self.score(t, nu), degree

    def _values(self, i, part, degree):
        problem, pose = self.problem, self.state.poses[i]
        ny, nx = problem.shapes[i]
        q = pose[:, :2] @ problem.terms.place(i, self.state.stars[:, problem.star[part]]) + pose[:, 2:]
        return basis.values(degree, (2 * q[0] + 1) / nx - 1, (2 * q[1] + 1) / ny - 1)

    def of_motion(self, times):
        """`Score` of a motion of every star in the reference plane, linear in the times (n_exposures,)."""
        patterns, moving = self._motions(np.asarray(times, dtype=float)[self.exposure])
        star, n_stars = self.problem.star, self.problem.n_stars

        def squares(whitened):
            pulls = np.stack([np.bincount(star, np.sum(p * whitened, axis=0), n_stars) for p in patterns])
            return float(np.sum(pulls**2))

        nu = 2.0 * np.count_nonzero(moving) - sum(squares(p) for p in np.moveaxis(self.released, 2, 0))
        return self.score(squares(self.whitened), max(nu - self._taken_by_exposures(patterns, moving), 0.0))

    def _motions(self, t):
        """Orthonormal patterns of motion of the stars, and which stars (n_stars,) move enough to have any.

        Two for every star, what its position takes up removed: shape (2, 2, n), the first axis counts them, the second
        is that of the whitened residuals.
        """
        problem, star, t = self.problem, self.problem.star, t - t.mean()
        columns = np.stack([self._whitened_gradient(f) for f in self.blocks.coupling])

        def products(factor):
            return np.stack(
                [[np.bincount(star, factor * np.sum(a * b, axis=0), problem.n_stars) for b in columns] for a in columns]
            ).transpose(2, 0, 1)

        still, cross, square = products(np.ones(len(t))), products(t), products(t**2)
        shift = np.linalg.pinv(still, hermitian=True) @ cross
        left = square - cross @ shift
        moving = np.linalg.eigvalsh(left)[:, 0] > 1e-9 * max(left.max(initial=0), 1e-300)
        left[~moving] = np.eye(2)
        turn = np.linalg.inv(np.linalg.cholesky(left)) * moving[:, None, None]
        off = columns * t - np.einsum("nab,acn->bcn", shift[star], columns)
        return np.einsum("nab,bcn->acn", turn[star], off), moving

    def _taken_by_exposures(self, patterns, moving):
        """Degrees of freedom that the distortions take up of patterns as those of `_motions`.

        The trace is exact for few stars, else it is that of random combinations (Hutchinson 1990).
        """
        n = 2 * np.count_nonzero(moving)
        if not n:
            return 0.0
        few = n <= _PROBES
        probes = np.sqrt(n) * np.eye(n) if few else np.random.default_rng(0).choice([-1.0, 1.0], (n, _PROBES))
        each = np.zeros((2, self.problem.n_stars, probes.shape[1]))
        each[:, moving] = probes.reshape(2, -1, probes.shape[1])
        pulled = np.stack([self._gradient(p) for p in patterns])
        rest = np.empty((self.problem.n_exposures, 2 * self.problem.n_modes, probes.shape[1]))
        for i in range(self.problem.n_exposures):
            part = self.problem.part(i)
            on_rows = np.einsum("akn,anm->knm", pulled[:, :, part], each[:, self.problem.star[part]], optimize=True)
            rest[i] = (self.blocks.values[:, part] @ on_rows).reshape(-1, probes.shape[1])
        return float(np.sum(rest * self.system.respond(rest))) / probes.shape[1]

    def of_cells(self, cells):
        """`Score` of a displacement common to all observations of a cell, for cells (n,) from 0."""
        w, n = self.problem.weight, cells.max() + 1
        g = self._by_cell(cells, self.whitened, n)
        xx, yy, xy = (np.diag(np.bincount(cells, x, n)) for x in w)
        plain = np.block([[xx, xy], [xy, yy]])
        stars, moved, rest = self._followed(cells, n)
        covariance = plain - np.einsum("ajc,ajd->cd", stars, moved)
        covariance -= np.einsum("iac,iad->cd", rest, self.system.respond(rest))
        taken = np.reshape([self._by_cell(cells, p, n) for p in np.moveaxis(self.released, 2, 0)], (-1, 2 * n)).T
        covariance -= taken @ taken.T
        unit = 1 / np.sqrt(np.maximum(np.diag(plain), 1e-300))
        values, vectors = np.linalg.eigh((covariance + covariance.T) / 2 * unit[:, None] * unit)
        kept = values > _RANK
        t = np.sum((vectors[:, kept].T @ (unit * g)) ** 2 / values[kept])
        return self.score(t, float(np.count_nonzero(kept)))

    def _by_cell(self, cells, whitened, n):
        """What pulls at the displacements (2 n,) of cells, x first, in whitened residuals (2, n)."""
        return np.concatenate([np.bincount(cells, p, n) for p in self._gradient(whitened)])

    def _followed(self, cells, n):
        """Gradients of the unknowns by displacements (2 n) of cells, the stars eliminated.

        Returns
        -------
        stars, moved : ndarray, shape (2 + k, n_stars, 2 n)
            Gradient of the stars, and how they follow with the coefficients held.
        rest : ndarray, shape (n_exposures, 2 n_modes, 2 n)
            What is left for the coefficients.
        """
        problem, blocks, w = self.problem, self.blocks, self.problem.weight
        index = problem.star * n + cells
        pulled = problem.pulled(blocks.coupling)
        stars = np.stack([[np.bincount(index, f, problem.n_stars * n) for f in row] for row in pulled])
        stars = stars.reshape(-1, 2, problem.n_stars, n).transpose(0, 2, 1, 3).reshape(-1, problem.n_stars, 2 * n)
        inverse = elimination.inverse_star_blocks(blocks.v)[:, :, None]
        moved = elimination.symmetric_times(inverse, stars)
        rest = np.empty((problem.n_exposures, 2 * problem.n_modes, 2 * n))
        for i in range(problem.n_exposures):
            part = problem.part(i)
            f, b = blocks.coupling[:, :, part, None], blocks.values[:, part]
            y = problem.terms.place(i, moved[:, problem.star[part]])
            cell = np.zeros((b.shape[1], n))
            cell[np.arange(b.shape[1]), cells[part]] = 1
            for k, row in enumerate(((w[0], w[2]), (w[2], w[1]))):
                own = np.concatenate([each[part, None] * cell for each in row], axis=1)
                rest[i, k * len(b) : (k + 1) * len(b)] = b @ (own - f[0, k] * y[0] - f[1, k] * y[1])
        return stars, moved, rest

    def correlations(self):
        """Correlation of the residuals of every two exposures over their common stars, and how many they are.

        Returns
        -------
        correlation, number : ndarray, shape (n_exposures, n_exposures)
        """
        problem, n = self.problem, self.problem.n_exposures
        product, mine, number = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
        for first in range(0, problem.n_stars, 4096):
            rows = self.used & (problem.star >= first) & (problem.star < first + 4096)
            where = self.exposure[rows], problem.star[rows] - first
            seen = np.zeros((n, min(4096, problem.n_stars - first)))
            seen[where] = 1
            number += seen @ seen.T
            for e in self.whitened:
                values = np.zeros_like(seen)
                values[where] = e[rows]
                product += values @ values.T
                mine += values**2 @ seen.T
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.nan_to_num(product / np.sqrt(mine * mine.T)), number
