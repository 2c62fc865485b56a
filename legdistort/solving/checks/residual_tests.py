"""Test statistics of residuals and their null distributions, the leverage of the fit allowed for.

Every statistic is the part ``T = e' P e`` of chi2 that falls into some subspace P of the whitened residuals e. With all
unknowns fitted, ``e = M e_0`` with M the projector off the fit, so that T has the mean ``nu = tr(P M)`` and at most the
variance of chi2 with nu degrees of freedom. It is compared with what is left of chi2, which makes the tests independent
of a common factor on the errors: chi2 alone judges that one.
"""

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import special
from scipy.sparse import csr_array

from ...geometry import basis
from ..equations import elimination
from ..equations.leverage import leverages

_DETERMINED = 1e-4  # information [1/px^2]: what is held wrong by some pixels shows where 100 px would be beyond doubt
_PROBES = 64  # patterns up to which a trace is exact, and random combinations beyond: right to 2 %
_TELLING = 4  # degrees of freedom, both axes, of a star whose residuals tell noise that two exposures share
_ROUNDS = 4
# Parts of its variance without a fit that a combination must keep to count: of a pattern and of modes. Of a pattern
# that keeps less, what is undetermined shows as much by its second order (2 of 50 clean sets had a warning at 0.005).
_SHOWN, _RANK = 1e-2, 1e-3


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


def in_cells(cells, displacements):
    """Columns as of `Residuals.of_columns`: some displacements in every cell alone, negative cells having none.

    Parameters
    ----------
    cells : ndarray of int, shape (n,)
        From 0.
    displacements : ndarray, shape (m, 2) or (m, 2, n)
        Pixels.
    """
    n, rows = cells.max(initial=0) + 1, np.flatnonzero(cells >= 0)
    m = len(displacements)
    each = np.broadcast_to(np.reshape(displacements, (m, 2, -1)), (m, 2, len(cells)))[:, :, rows]
    where = np.tile(rows, m), (cells[rows] + n * np.arange(m)[:, None]).ravel()
    return [csr_array((each[:, axis].ravel(), where), shape=(len(cells), m * n)) for axis in (0, 1)]


def part_of_chi2(gradient, information):
    """What falls into a subspace, with its gradient (k,) and their covariance (k, k); what stars hide does not count.

    Returns
    -------
    float
    vectors, values : ndarray, shape (k, n) and (n,)
        Directions that show, and how much.
    """
    values, vectors = np.linalg.eigh(information)
    kept = values > _SHOWN
    values, vectors = values[kept], vectors[:, kept]
    return float(np.sum((vectors.T @ gradient) ** 2 / values)), vectors, values


class Residuals:
    """Residuals of a fit with what their distribution needs.

    Parameters
    ----------
    problem : `legdistort.solving.equations.problem.Problem`
        With the weights that were in force.
    state : State
    blocks : Blocks
        At the solution.
    system : `legdistort.solving.equations.reduced_system.Direct`, OnStars or Iterative
        In the gauge.
    dof : float
    """

    def __init__(self, problem, state, blocks, system, dof):
        self.problem, self.state, self.blocks, self.system, self.dof = problem, state, blocks, system, dof
        self.exposure = problem.exposure
        self.used = problem.weight[0] > 0
        self.released, held = self._released()
        e = self._whiten(blocks.residual)
        self.whitened = e - self.released @ (np.einsum("anm,an->m", self.released, e) - held)
        self.dof = dof - round(float(np.sum(self.released**2)), 6)  # a whole number where no reference holds stars
        self.squares = np.sum(self.whitened**2, axis=0)
        self.chi2 = float(self.squares.sum())

    def _released(self):
        """What the values at which the gauge holds the common map may do to the whitened residuals, all else refitted.

        Holding it at values that are not the true ones leaves residuals of second order, which precise data show. They
        are no fault of the form of the distortion, so that they are taken off. Shape (2, n, k), in units in which the
        information of these values is one; and how stars that a reference holds resist them, (k,).
        """
        problem, system, n_modes = self.problem, self.system, self.problem.n_modes
        coupling = problem.pulled(self.blocks.coupling)
        values, vectors = np.linalg.eigh(system.information)
        along = vectors[:, values > _DETERMINED]
        steps = [problem.unknowns.spread(d) for d in along.T @ system.moves[: len(values)]]
        own = np.reshape(steps, (-1, problem.n_exposures, 2, n_modes)).transpose(1, 2, 3, 0)
        fields = np.empty((2, len(self.used), own.shape[-1]))
        for i in range(problem.n_exposures):
            part = problem.part(i)
            fields[:, part] = self.blocks.values[:, part].T @ own[i]
        stars = -elimination.symmetric_times(self._inverse, self._at_stars(coupling, fields))
        out = self._whiten(fields)
        for column, star in zip(self._columns, stars, strict=True):
            out += column[:, :, None] * star[problem.star]
        information, held = np.einsum("anm,ank->mk", out, out), np.zeros(out.shape[2])
        if (catalogue := problem.terms.catalogue) is not None:
            moved = elimination.symmetric_times(catalogue.precision[:, :, None], stars)
            information += np.einsum("ajm,ajk->mk", stars, moved)
            held = np.einsum("ajm,aj->m", moved, self.state.stars - catalogue.mean)
        unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        values, vectors = np.linalg.eigh(unit[:, None] * information * unit)
        kept = values > 1e-12
        turn = unit[:, None] * vectors[:, kept] / np.sqrt(values[kept])
        return out @ turn, held @ turn

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
        """L'p for what is p in units of errors, (2, n, ...): how it pulls at the model positions."""
        l00, l01, l11 = (each.reshape(-1, *[1] * (whitened.ndim - 2)) for each in self._roots)
        x, y = whitened
        return np.stack([l00 * x, l01 * x + l11 * y])

    def _whitened_gradient(self, pulled):
        """The inverse of `_gradient`; 0 where there is no weight."""
        l00, l01, l11 = self._roots
        with np.errstate(divide="ignore", invalid="ignore"):
            x = pulled[0] / l00
            return np.where(self.used, np.stack([x, (pulled[1] - l01 * x) / l11]), 0.0)

    @cached_property
    def _columns(self):
        """What a unit of every unknown of a star does to its whitened observations, (2 + k, 2, n)."""
        return np.stack([self._whitened_gradient(f) for f in self.problem.pulled(self.blocks.coupling)])

    @cached_property
    def _inverse(self):
        """Inverse star blocks, packed (m, n_stars, 1)."""
        return elimination.inverse_star_blocks(self.blocks.v)[:, :, None]

    @cached_property
    def _rows_of_stars(self):
        """Observations by star: their indices, and where those of every star begin."""
        star = self.problem.star
        first = np.cumsum(np.bincount(star, minlength=self.problem.n_stars))
        return np.argsort(star, kind="stable"), np.concatenate([[0], first])

    def _at_stars(self, factors, values):
        """Sums over the observations of stars of factors (a, 2, n) times values (2, n, m): shape (a, n_stars, m)."""
        rows, first = self._rows_of_stars
        shape = len(first) - 1, len(rows)
        return np.stack(
            [sum(csr_array((f[rows], rows, first), shape) @ v for f, v in zip(each, values, strict=True))
             for each in factors]
        )  # fmt: skip

    def _at_exposures(self, factors, stars):
        """Sums over exposures of factors (a, 2, n) times stars (a, n_stars, m), modes: (n_exposures, 2 n_modes, m)."""
        problem, m = self.problem, stars.shape[2]
        out = np.empty((problem.n_exposures, 2 * problem.n_modes, m))
        for i in range(problem.n_exposures):
            part = problem.part(i)
            columns = factors[:, :, None, part] * self.blocks.values[:, part]
            seen = stars[:, problem.star[part]].reshape(-1, m)
            out[i] = columns.transpose(1, 2, 0, 3).reshape(len(out[i]), -1) @ seen
        return out

    @cached_property
    def _leverages(self):
        return leverages(self.problem, self.blocks)

    @property
    def star_share(self):
        """Part of every observation's variance that the position of its star takes up, mean of the axes, (n,)."""
        return self._leverages[0]

    @property
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

    def cost(self, score):
        """How badly residuals are explained with a part of chi2 taken out (Schwarz 1978), a `Score`."""
        return self.dof * np.log(max(self.chi2 - score.t, 1e-300)) + score.nu * np.log(max(self.dof, 2))

    def of_groups(self, labels):
        """The `Score` by group of observations, for labels (n,) from 0; negative ones belong to none."""
        rows = labels >= 0
        sums = [self.squares, self.freedom, self.problem.weight[:2].sum(axis=0)]
        sums = np.transpose([np.bincount(labels[rows], each[rows]) for each in sums])
        return [self.score(t, nu, tests=len(sums), weight=weight) for t, nu, weight in sums]

    @property
    def next_degree(self):
        """`Score` of the modes of one degree more in every exposure, and that degree."""
        return self.of_degree(self.problem.degree + 1), self.problem.degree + 1

    def of_degree(self, degree):
        """`Score` of the modes of a degree beyond that of the fit in every exposure, all lower ones fitted too."""
        problem, weight, n = self.problem, self.problem.weight, basis.n_modes(degree - 1)
        n_used = np.bincount(self.exposure[self.used], minlength=problem.n_exposures)
        enough = np.flatnonzero(n_used > n + 1)
        seen, free = np.concatenate([self.whitened[:, :, None], self.released], axis=2), 1 - self.star_share
        products, apart, g = [], [], []
        for i in enough:
            part = problem.part(i)
            values = self._values(i, part, degree)
            rows = [np.sqrt(weight[0, part]) * values]
            rows.append(np.sqrt(weight[1, part]) * values if problem.unequal else rows[0])
            for k, p in enumerate(rows):
                equal = k and p is rows[0]
                products.append(products[-1] if equal else p @ p.T)
                apart.append(apart[-1] if equal else (p * free[part]) @ p.T)
                g.append(p @ seen[k, part])
        if not products:
            return self.score(0.0, 0.0)
        products, apart, g = np.stack(products), np.stack(apart), np.stack(g)
        # modes of the next degree with what the others can do taken off, then orthonormal combinations of them
        own = -products[:, n:, :n] @ np.linalg.pinv(products[:, :n, :n], hermitian=True)
        rows = np.concatenate([own, np.broadcast_to(np.eye(degree + 1), (len(own), degree + 1, degree + 1))], axis=2)
        size, vectors = np.linalg.eigh(rows @ products @ rows.transpose(0, 2, 1))
        kept = size > _RANK**2 * np.maximum(size[:, -1:], 1e-300)
        kept &= np.arange(degree + 1) >= degree + 1 + n - np.repeat(n_used[enough], 2)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.where(kept, 1 / np.sqrt(size), 0.0)
        rows = (vectors * unit[:, None, :]).transpose(0, 2, 1) @ rows
        size = rows @ g
        nu = np.sum((rows @ apart) * rows) - np.sum(size[:, :, 1:] ** 2)
        return self.score(float(np.sum(size[:, :, 0] ** 2)), float(nu))

    def modes_of(self, degree):
        """Columns, as of `of_columns`, of the modes of a degree in every exposure."""
        parts = [self.problem.part(i) for i in range(self.problem.n_exposures)]
        modes = np.concatenate([self._values(i, part, degree)[-degree - 1 :] for i, part in enumerate(parts)], axis=1)
        return in_cells(self.exposure, (modes[:, None, None] * np.eye(2)[:, :, None]).reshape(-1, 2, modes.shape[1]))

    def _values(self, i, part, degree):
        problem, pose = self.problem, self.state.poses[i]
        ny, nx = problem.shapes[i]
        q = pose[:, :2] @ problem.terms.place(i, self.state.stars[:, problem.star[part]]) + pose[:, 2:]
        return basis.values(degree, (2 * q[0] + 1) / nx - 1, (2 * q[1] + 1) / ny - 1)

    def of_motion(self, times):
        """`Score` of a motion of every star in the reference plane, linear in the times (n_exposures,)."""
        patterns, moving = self._motions(np.asarray(times, dtype=float)[self.exposure])
        seen = np.concatenate([self.whitened[:, :, None], self.released], axis=2)
        t, *taken = np.sum(self._at_stars(patterns, seen) ** 2, axis=(0, 1))
        nu = 2.0 * np.count_nonzero(moving) - sum(taken) - self._taken_by_exposures(patterns, moving)
        return self.score(float(t), max(float(nu), 0.0))

    def _motions(self, t):
        """Orthonormal patterns of motion of the stars, and which stars (n_stars,) move enough to have any.

        Two for every star, what its position takes up removed: shape (2, 2, n), the first axis counts them, the second
        is that of the whitened residuals.
        """
        t, star, columns = t - t.mean(), self.problem.star, self._columns[:2]
        products = self._at_stars(columns, (columns[..., None] * np.stack([np.ones(len(t)), t, t**2], axis=1)
                                            ).transpose(1, 2, 0, 3).reshape(2, len(t), 6))  # fmt: skip
        still, cross, square = products.reshape(2, -1, 2, 3).transpose(3, 1, 0, 2)
        shift = np.linalg.pinv(still, hermitian=True) @ cross
        left = square - cross @ shift
        moving = np.linalg.eigvalsh(left)[:, 0] > 1e-9 * max(left.max(initial=0), 1e-300)
        left[~moving] = np.eye(2)
        turn = np.linalg.inv(np.linalg.cholesky(left)) * moving[:, None, None]
        a, b = turn[star].transpose(1, 2, 0), (turn @ shift.transpose(0, 2, 1))[star].transpose(1, 2, 0)
        factors = a * t - b
        return factors[:, 0, None] * columns[0] + factors[:, 1, None] * columns[1], moving

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
        rest = self._at_exposures(np.stack([self._gradient(p) for p in patterns]), each)
        return float(np.vdot(rest, self.system.respond(rest))) / probes.shape[1]

    def of_cells(self, cells):
        """As `of_columns`, of a displacement common to all observations of a cell, for cells (n,) from 0."""
        return self.of_columns(in_cells(cells, np.eye(2)))

    def of_columns(self, columns):
        """`Score` of displacements that are a combination of columns, and what shows of these.

        Parameters
        ----------
        columns : sequence of two sparse arrays, shape (n, k)
            Displacement of the observations in x and in y, pixels, by a unit of each.

        Returns
        -------
        Score
        float
            By how much T would grow for displacements of one pixel rms, 1/pix^2; the rest of them is in the stars.
        """
        g, information, plain = self.information(columns)
        unit = 1 / np.sqrt(np.maximum(np.diag(plain), 1e-300))
        t, vectors, values = part_of_chi2(unit * g, information * unit[:, None] * unit)
        shown = float(np.sum((vectors / unit[:, None]) ** 2 * values))
        return self.score(t, float(len(values))), shown

    def information(self, columns):
        """Gradient (k,) of the units of columns and its covariance (k, k), and what this would be were nothing fitted.

        The columns are those of `of_columns`.
        """
        pulling = [self._gradient_of(columns, axis) for axis in (0, 1)]
        plain = sum((c.T @ p).toarray() for c, p in zip(columns, pulling, strict=True))
        seen = self._gradient(np.concatenate([self.whitened[:, :, None], self.released], axis=2))
        pull = sum(c.T @ each for c, each in zip(columns, seen, strict=True))
        stars, moved, rest = self._followed(columns, pulling)
        covariance = plain - np.tensordot(stars, moved, ([0, 1], [0, 1])) - pull[:, 1:] @ pull[:, 1:].T
        covariance -= np.tensordot(rest, self.system.respond(rest), ([0, 1], [0, 1]))
        return pull[:, 0], (covariance + covariance.T) / 2, plain

    def _gradient_of(self, columns, axis):
        """How displacements along columns pull at the model positions along an axis, sparse (n, k)."""
        w, (x, y) = self.problem.weight, columns
        return x.multiply(w[2 * axis][:, None]).tocsr() + y.multiply(w[2 - axis][:, None]).tocsr()

    def _followed(self, columns, pulling):
        """Gradients of the unknowns by the units of columns, the stars eliminated.

        Returns
        -------
        stars, moved : ndarray, shape (2 + k, n_stars, k)
            Gradient of the stars, and how they follow with the coefficients held.
        rest : ndarray, shape (n_exposures, 2 n_modes, k)
            What is left for the coefficients.
        """
        problem, pulled, k = self.problem, self.problem.pulled(self.blocks.coupling), columns[0].shape[1]
        rows, first = self._rows_of_stars
        shape = len(first) - 1, len(rows)
        stars = np.stack(
            [sum((csr_array((f[rows], rows, first), shape) @ c).toarray() for f, c in zip(each, columns, strict=True))
             for each in pulled]
        )  # fmt: skip
        moved = elimination.symmetric_times(self._inverse, stars)
        rest = -self._at_exposures(pulled, moved)
        own = rest.reshape(problem.n_exposures, 2, problem.n_modes, k)
        for i in range(problem.n_exposures):
            part = problem.part(i)
            own[i] += np.stack([self.blocks.values[:, part] @ p[part] for p in pulling])
        return stars, moved, rest

    def without(self, columns, *, rank=_RANK):
        """What is left of these `Residuals` when a combination of columns, as of `of_columns`, is fitted too.

        Those combinations that keep more than a part `rank` of their variance.
        """
        problem, k = self.problem, columns[0].shape[1]
        _, _, rest = self._followed(columns, [self._gradient_of(columns, axis) for axis in (0, 1)])
        step = self.system.respond(rest).reshape(problem.n_exposures, 2, problem.n_modes, k)
        fields = np.stack([c.toarray() for c in columns])
        for i in range(problem.n_exposures):
            part = problem.part(i)
            fields[:, part] -= self.blocks.values[:, part].T @ step[i]
        stars = elimination.symmetric_times(self._inverse, self._at_stars(problem.pulled(self.blocks.coupling), fields))
        out = self._whiten(fields)
        size = np.sqrt(np.sum(out**2, axis=(0, 1)))
        for column, star in zip(self._columns, stars, strict=True):
            out -= column[:, :, None] * star[problem.star]
        flat = out.reshape(2 * len(self.used), k) / np.where(size > 0, size, 1)
        known = self.released.reshape(len(flat), -1)
        flat -= known @ (known.T @ flat)
        values, vectors = np.linalg.eigh(flat.T @ flat)
        kept = values > rank
        taken = (flat @ (vectors[:, kept] / np.sqrt(values[kept]))).reshape(2, len(self.used), -1)
        return self._with(released=np.concatenate([self.released, taken], axis=2),
                          whitened=self.whitened - taken @ np.einsum("anm,an->m", taken, self.whitened),
                          dof=self.dof - taken.shape[2])  # fmt: skip

    def at_errors(self, factor):
        """These `Residuals` with the errors of the observations multiplied by factors (n,), nothing fitted again."""
        return self._with(whitened=self.whitened / factor)

    def _with(self, **changed):
        """A copy with some attributes changed, and what follows from the residuals."""
        out = copy(self)
        for name, value in changed.items():
            setattr(out, name, value)
        out.squares = np.sum(out.whitened**2, axis=0)
        out.chi2 = float(out.squares.sum())
        return out

    def correlations(self):
        """Correlation of the noise of every two exposures, and of how many values it is.

        Of residuals e = (1 - H) n a correlation c of the noise n of two exposures makes
        ``sum e_i e_k = sum (c ((1 - h_ii) (1 - h_kk) + h_ik^2) - h_ik)`` over their common stars, h the leverage of the
        star alone: without any, residuals of stars that few exposures determine are not independent either.

        Returns
        -------
        correlation, number : ndarray, shape (n_exposures, n_exposures)
        """
        problem, n = self.problem, self.problem.n_exposures
        counts = 2 * np.bincount(problem.star[self.used], minlength=problem.n_stars) - problem.n_star
        tells = self.used & (counts >= _TELLING)[problem.star]
        held = np.einsum("kl...n,kan->lan", elimination.star_roots(self.blocks.v)[..., problem.star], self._columns)
        product, common, gain = np.zeros((3, n, n))
        mine, free, less = np.zeros((3, n, n))
        for first in range(0, problem.n_stars, 4096):
            rows = tells & (problem.star >= first) & (problem.star < first + 4096)
            where, size = (self.exposure[rows], problem.star[rows] - first), min(4096, problem.n_stars - first)

            def placed(values, where=where, rows=rows, size=size):
                out = np.zeros((n, size))
                out[where] = values if np.ndim(values) == 0 else values[rows]
                return out

            seen = placed(1.0)
            for e, columns in zip(self.whitened, held.swapaxes(0, 1), strict=True):
                values, left = placed(e), placed(1 - np.sum(columns**2, axis=0))
                product += values @ values.T
                mine += values**2 @ seen.T
                free += left @ seen.T
                gain += left @ left.T
                for column in columns:
                    common += placed(column) @ placed(column).T
                    less += (left * placed(column)) @ placed(column).T
                    for other in columns:
                        both = placed(column * other)
                        gain += both @ both.T
        value = np.zeros((n, n))
        with np.errstate(invalid="ignore", divide="ignore"):
            for _ in range(_ROUNDS):  # shared noise pulls at the star twice, which leaves less of it in both residuals
                own = free - 2 * value * less
                scale = np.sqrt(mine * mine.T / (own * own.T))
                value = np.clip(np.nan_to_num((product / scale + common) / gain), -1, 1)
        share = self.freedom.sum() / max(float(np.sum(2 * (1 - self.star_share) * self.used)), 1e-300)
        return value, gain * min(share, 1.0)

    def difference(self, i, k):
        """Squares of the differences of two exposures' residuals over those to be expected, and of how many values."""
        problem, (a, b) = self.problem, (self.problem.part(i), self.problem.part(k))
        at_i, at_k = (np.arange(part.start, part.stop)[self.used[part]] for part in (a, b))
        _, first, second = np.intersect1d(problem.star[at_i], problem.star[at_k], return_indices=True)
        at_i, at_k = at_i[first], at_k[second]
        roots = elimination.star_roots(self.blocks.v)[..., problem.star[at_i]]
        total = 0.0
        for axis in (0, 1):
            g, h = (np.einsum("kln,kn->ln", roots, self._columns[:, axis, rows]) for rows in (at_i, at_k))
            s, t = (1 / np.sqrt(problem.weight[axis, rows]) for rows in (at_i, at_k))
            expected = s**2 * (1 - np.sum(g**2, axis=0)) + t**2 * (1 - np.sum(h**2, axis=0))
            expected += 2 * s * t * np.sum(g * h, axis=0)
            off = self.blocks.residual[axis, at_i] - self.blocks.residual[axis, at_k]
            total += float(np.sum(off**2 / np.maximum(expected, 1e-3 * (s**2 + t**2))))
        return total, 2 * len(at_i)
