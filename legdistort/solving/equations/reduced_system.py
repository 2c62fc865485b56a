"""The reduced system: stars eliminated, coefficients solved for under the constraints of the gauge.

The reduced matrix ``S = U - E' V^-1 E`` is singular along maps common to all exposures, or nearly so; the
constraints of the gauge, ``rows d = target``, fill in. Small systems are factorised (`Direct`), or the coefficients
eliminated instead where the stars are few (`legdistort.solving.equations.star_system`), large ones solved by conjugate
gradients that never form S (`Iterative`): the same answer.
"""

import contextlib
import logging
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, eigh_tridiagonal, eigvalsh_tridiagonal
from scipy.linalg.blas import dgemm, dtrsm
from scipy.linalg.lapack import dpotri

from ...exceptions import SolveError, some_of
from . import elimination
from .reduced_base import Reduced
from .star_system import LEAST_PIVOT, OnStars

log = logging.getLogger(__name__)

#: Up to this many unknown coefficients the reduced matrix is factorised; beyond, conjugate gradients.
DIRECT_LIMIT = 3000
#: From so many on the coefficients are eliminated instead where the stars have no more than half as many unknowns.
STARS_FROM = 600
#: Up to this many unknowns of stars their own matrix is factorised.
STAR_LIMIT = 8000
#: ... and while building it costs no more than this many multiplications.
_DIRECT_COST = 4e9
#: ... or this many, where compiled loops make the steps of conjugate gradients cheap; there are so many of these before
#: the matrix is factorised after all.
_FAST_DIRECT_COST, _FAST_STEPS = 1e8, 60
_CLEAR_PIVOT = 0.03  # of an exposure whose stars determine its coefficients well
_LEAST_PIVOT = 1e-7  # of the normalised equations, below which they count as singular
_ALONE = 1e-6  # of what the stars would determine if they were known: where nothing else does, as in one exposure
_ROUNDING = 1e-12  # of a variance, what is left where the constraints hold all of it
_SHOWN = 9.0  # squares that a common distortion which is held costs, in errors, from which the residuals show it
_WEAK, _SURE = 0.3, 0.3  # eigenvalues below which directions are learnt, where they lack no more than this part of it
_REMEMBERED = 100  # iterations, and directions
#: Part of a direction that nothing determines from which it is of the exposures that are named; and least eigenvalue of
#: an exposure with its stars known, beside that of the others, below which it is its own.
_THEIRS, _MUCH_LESS = 0.6, 1e-3
_NOTHING = 1e-9  # eigenvalue of the normalised equations that is rounding


def reduced_system(problem, blocks, gauge, weak=None):
    """`Direct`, `OnStars` or `Iterative`, by the size of the problem."""
    small, direct = problem.unknowns.size <= DIRECT_LIMIT, uses_direct(problem)
    on_stars = has_fewer_stars(problem) and (direct or not small)
    if on_stars and (made := solved_on_stars(problem, blocks, gauge, _DIRECT_COST)) is not None:
        return made
    if direct or (small and is_singular(blocks.u)):  # which names the exposure with too few stars
        return Direct(problem, blocks, gauge, weak)
    return Iterative(problem, blocks, gauge)


def is_singular(blocks):
    """Whether some block of an exposure (n, 2 n_modes, 2 n_modes) is singular, as where its stars lie on a line."""
    try:
        lower = np.linalg.cholesky(_normalised(blocks))
    except LinAlgError:
        return True
    return bool(np.einsum("iaa->ia", lower).min() < _LEAST_PIVOT)


def _normalised(blocks):
    """Blocks of exposures, of one axis where both are alike, with a unit diagonal, but for what nothing determines."""
    blocks = elimination.of_one_axis(blocks)
    diagonal = np.einsum("iaa->ia", blocks)
    unit = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    return blocks / unit[:, :, None] / unit[:, None, :]


def uses_direct(problem):
    """Whether the reduced system is small enough to be factorised; it always is where exposures share modes."""
    cost = _FAST_DIRECT_COST if problem.uses_compiled_loops else _DIRECT_COST
    return problem.unknowns.shared or is_small(problem, cost)


def is_small(problem, cost=_DIRECT_COST):
    """Whether the matrix of the coefficients serves a problem, at no more than some multiplications."""
    n = problem.unknowns.size
    return n <= DIRECT_LIMIT and n * n * 2.0 * problem.n_stars <= cost


def has_fewer_stars(problem):
    """Whether there are many coefficients, and the stars have no more than half as many unknowns."""
    n = problem.unknowns.size
    return n >= STARS_FROM and 2 * problem.n_star * problem.n_stars <= n


def solved_on_stars(problem, blocks, gauge, cost=np.inf):
    """`OnStars`, if it serves a problem, at no more than some multiplications; else None.

    Where `Direct` serves as well, not for exposures of hardly more stars than modes, of which it loses digits.
    """
    n, n_coefficients = problem.n_star * problem.n_stars, problem.unknowns.size
    if problem.unknowns.shared or n > STAR_LIMIT or n * n * float(n_coefficients) > cost:
        return None
    with contextlib.suppress(LinAlgError):
        return OnStars(problem, blocks, gauge, _CLEAR_PIVOT if n_coefficients <= DIRECT_LIMIT else LEAST_PIVOT)
    return None


class Direct(Reduced):
    """The reduced matrix S, factorised together with the constraints of the gauge.

    Parameters
    ----------
    problem, blocks, gauge
    weak : ndarray, shape (n_weak, n), optional
        Rows that hold what the exposures do not determine of a distortion that they share; sought if not given.

    Raises
    ------
    SolveError
        If S is singular beyond the gauge, naming the exposures concerned.
    """

    _weak = np.zeros(0), np.zeros((0, 0))

    def __init__(self, problem, blocks, gauge, weak=None):
        super().__init__(problem, blocks, gauge)
        s = elimination.reduced_triangle(problem, blocks)
        self.scale = max(np.mean(np.diag(s)), _ALONE * np.mean(np.einsum("iaa->ia", blocks.u)))
        s += (self.scale * self.rows.T @ self.rows).T  # lifts the gauge directions; undone by the multipliers
        # unit diagonal: coefficients of bright and faint exposures then compare
        diagonal = np.diag(s).copy()
        if self.unknowns.shared:  # what is left of a common distortion without the stars may be rounding
            diagonal = np.diag(self.unknowns.matrix(blocks.u) + self.scale * self.rows.T @ self.rows)
        self._unit = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
        s *= self._unit[:, None]
        s *= self._unit
        if self.unknowns.shared:
            self._hold_weak(s, weak)
        try:
            self._factor = cho_factor(s, lower=True, overwrite_a=False, check_finite=True)
            if np.diag(self._factor[0]).min() < _LEAST_PIVOT:
                raise LinAlgError
        except (LinAlgError, ValueError):
            raise _not_determined(problem, s, blocks.u) from None
        self._hold_rows()

    def _hold_rows(self):
        self._lifted = self._apply_inverse(self.rows.T)
        self._border = np.linalg.inv(self.rows @ self._lifted)

    def moved(self, problem, blocks, gauge):
        """As for `Reduced`."""
        out = super().moved(problem, blocks, gauge)
        if out is not None and gauge is not self.gauge:
            out._hold_rows()
        return out

    def _hold_weak(self, s, rows):
        """Hold what neither dithers nor rolls determine of a common distortion: more rows, that keep to the start.

        Raises
        ------
        SolveError
            If that is all of it.
        """
        if rows is None:
            values, vectors = np.linalg.eigh(s)
            weak = vectors[:, values < self.problem.weak]
            self._weak = values[: weak.shape[1]], weak
        else:
            weak = (rows * self._unit).T
        self.n_weak = weak.shape[1]
        if self.n_weak >= self.unknowns.n_common:
            raise SolveError(
                "static='fit': these exposures cannot distinguish a distortion that they share from one of the sky; "
                "dither by a good part of the field and turn the camera, or give a prior with static_sigma"
            )
        s += weak @ weak.T
        self.rows = np.concatenate([self.rows, weak.T / self._unit])

    @property
    def shown(self):
        """Least eigenvalue of what is held of a common distortion and the residuals show nevertheless; None if none."""
        values, vectors = self._weak
        told = np.maximum(values, _NOTHING)
        gain = (vectors.T @ (self._unit * self.rhs)) ** 2 / told
        left = max(self.blocks.chi2 - gain.sum(), 0.0) / self.problem.xy.size
        shown = values[(values > _NOTHING) & (gain > _SHOWN * max(left, 1.0))]
        return shown.min() if len(shown) else None

    def _apply_inverse(self, b):
        unit = self._unit if b.ndim == 1 else self._unit[:, None]
        return unit * cho_solve(self._factor, unit * b)

    @cached_property
    def information(self):
        """What the data determine of the values of the constraints, shape (n_constraints,) squared.

        Half the curvature of J along them, all else refitted; nothing but rounding along the exact directions.
        """
        n = self.gauge.n_constraints
        out = np.linalg.inv(np.linalg.inv(self._border)[:n, :n]) if self.n_weak else self._border
        out = out - self.scale * np.eye(n)
        return (out + out.T) / 2

    @cached_property
    def pull(self):
        """How the data pull at the values of the constraints (n_constraints,): minus half the slope of J along them."""
        return (self._border @ (self._lifted.T @ self.rhs))[: self.gauge.n_constraints]

    def solve(self, rhs, target):
        """d (n,) that minimises d'Sd/2 - rhs'd with rows d = target."""
        free = self._apply_inverse(rhs)
        target = np.pad(target, (0, self.n_weak))
        return free - self._lifted @ (self._border @ (self.rows @ free - target))

    def step(self, target, accuracy, enough=0.0):
        """Gauss-Newton step under the constraints of the gauge; exact whatever the accuracy asked for.

        That of the coefficients has the similarities for the poses in it, which take along what they carry.

        Parameters
        ----------
        target : ndarray, shape (n_constraints,)
            What is still lacking to the values of the orthonormal constraints.
        accuracy : float
            Where conjugate gradients may stop, relative to the size of the step.
        enough : float
            ... or so many standard errors before its end, rms over the unknowns, by the blocks of the exposures.

        Returns
        -------
        d_star : ndarray, shape (2 + k, n_stars)
        d_exposure : ndarray, shape (n_exposures, 2 n_modes)
        """
        d = self.solve(self.rhs, target)
        return self._stars(self.blocks.g_star - self._couple(d)), self.problem.unknowns.spread(d)

    def settle(self, own, stars, accuracy=1e-8):
        """What stars (2 + k, n_stars) and coefficients (n_exposures, 2 n_modes) do about gradients, in the gauge.

        Parameters
        ----------
        own : ndarray, shape (n_exposures, 2 n_modes)
        stars : ndarray, shape (2 + k, n_stars)
        accuracy : float
            As for `step`.
        """
        d = self.solve(self._gradient(own, stars), np.zeros(self.gauge.n_constraints))
        return self._stars(stars - self._couple(d)), self.problem.unknowns.spread(d)

    def respond(self, gradients):
        """C g, with the covariance C of the coefficients in the gauge, for gradients g (n_exposures, 2 n_modes, k)."""
        free = self._apply_inverse(self.unknowns.gather(gradients))
        solved = free - self._lifted @ (self._border @ (self.rows @ free))
        return np.stack([self.unknowns.spread(d) for d in solved.T], axis=2)

    @property
    def moves(self):
        """Changes of the unknowns (n_constraints + n_weak, n), each moving one constraint by one, all else fitted."""
        return (self._lifted @ self._border).T

    def within(self, columns, n):
        """Blocks (n, n, m) of ``f' C f``, C the covariance of the coefficients, for columns f (n_coefficients, n m).

        Without C itself: ``S^-1 = (L L')^-1``, and half the multiplications of a product with it.
        """
        columns = self.unknowns.gather(columns.reshape(*self.blocks.g_exposure.shape, -1))
        # not numpy's product, whose threads would wait beside those of dtrsm and slow them down
        held = dgemm(1.0, self._lifted, columns, trans_a=1).reshape(len(self.rows), n, -1)
        free = columns * self._unit[:, None]
        free = dtrsm(1.0, self._factor[0], free, lower=1, overwrite_b=1)
        free = free.reshape(len(free), n, -1)
        out = np.empty((n, n, free.shape[2]))
        for a, b in np.ndindex(n, n):
            if b <= a:
                out[a, b] = np.einsum("nj,nj->j", free[:, a], free[:, b])
                out[a, b] -= np.einsum("nj,nj->j", held[:, a], self._border @ held[:, b])
                out[b, a] = out[a, b]
        return out

    def covariance(self):
        """Covariance of the coefficients of all exposures in the gauge, shape (n_exposures * 2 n_modes,) squared."""
        out = elimination.mirrored(dpotri(self._factor[0], lower=1)[0])  # a third of solving for every unit vector
        out *= self._unit[:, None]
        out *= self._unit
        free = np.diag(out).copy()
        out -= self._lifted @ self._border @ self._lifted.T
        held = np.diag(out) < _ROUNDING * free  # as all of one exposure
        out[held] = 0
        out[:, held] = 0
        return self.unknowns.covariance((out + out.T) / 2)


def _not_determined(problem, s, blocks):
    """The `SolveError` of a singular system, which names the exposures to blame, the worst first.

    As `exposures` it has those whose own stars, even if these were known, determine far less than those of the others,
    or those that have most of what is not determined.
    """
    values, vectors = np.linalg.eigh(np.nan_to_num(s))
    own = np.linalg.eigvalsh(np.nan_to_num(_normalised(blocks)))[:, 0]
    blamed = theirs = [i for i in np.argsort(own) if own[i] < _MUCH_LESS * np.median(own)]
    if not theirs:
        energy = (problem.unknowns.spread(vectors[:, 0]) ** 2).sum(axis=1)
        blamed = [i for i in np.argsort(energy)[::-1][:3] if energy[i] > 0.1]
        theirs = blamed if energy[blamed].sum() > _THEIRS else []
    worst = some_of([problem.names[i] for i in blamed], 3)
    return SolveError(
        f"the observations do not determine the distortion of degree {problem.degree} "
        f"(smallest eigenvalue {values[0]:.1e} of the normalised equations), above all in exposure {worst}: "
        "leave out an exposure that hardly overlaps the others (--without), lower the degree, add stars, or give "
        "a prior with sigma (--prior-sigma evidence)",
        exposures=tuple(problem.names[i] for i in theirs),
    )


class Iterative(Reduced):
    """Matrix-free solution of the reduced system on the constraints, preconditioned by the exposure blocks.

    For problems in which exposures share nothing.

    Projected conjugate gradients with the constraint preconditioner of Gould, Hribar & Nocedal (2001), its iterative
    refinement with it: every iterate satisfies the constraints. The coupling E d of the iterate is carried along, so
    that neither the right-hand side nor the stars need a pass of their own. Directions that are common to all
    exposures, and that the constraints hardly hold, take most of the iterations; what these tell of them is kept for
    the system at the next state, as a limited-memory preconditioner (Tshimanga, Gratton, Weaver & Sartenaer 2008).
    """

    moves_exactly = True  # but for the preconditioner all is that of the new state
    _met = 0.0  # see `_weakest`
    _learnt, _softest = None, 1.0  # see `_learn`

    def __init__(self, problem, blocks, gauge):
        super().__init__(problem, blocks, gauge)
        self._block_inverses = elimination.inverse_exposure_blocks(blocks.u)
        self.scale = np.einsum("iaa->", blocks.u) / self.unknowns.size

    def moved(self, problem, blocks, gauge):
        """As for `Reduced`."""
        out = super().moved(problem, blocks, gauge)
        out._block_inverses = elimination.inverse_exposure_blocks(blocks.u)
        return out

    def _block_solve(self, r):
        """The preconditioner: blocks of the exposures, and directions that are learnt, of r (n,) or (n, k)."""
        by_exposure = r.reshape(*self._block_inverses.shape[:2], -1)
        out = (self._block_inverses @ by_exposure).reshape(r.shape)
        return out if self._learnt is None else out + self._learnt @ (self._learnt.T @ r)

    def settle(self, own, stars, accuracy=1e-8):
        """As for `Direct`."""
        stars, d = self._solve(own, stars, self.rows, np.zeros(len(self.rows)), accuracy)
        return stars, self.unknowns.spread(d)

    def respond(self, gradients):
        """As for `Direct`, the positions of the stars taken as known."""
        return self._block_inverses @ gradients

    @cached_property
    def moves(self):
        """Changes of the coefficients (n_constraints, n), each moving one constraint by one, all else fitted."""
        nothing = np.zeros_like(self.blocks.g_exposure), np.zeros_like(self.blocks.g_star)
        return np.stack([self._solve(*nothing, self.rows, unit, 1e-5)[1] for unit in np.eye(len(self.rows))])

    @cached_property
    def information(self):
        """As for `Direct`."""
        products = np.stack([self._gradient(self._own(d), self._couple(d)) for d in self.moves])
        out = self.moves @ products.T
        return (out + out.T) / 2

    @cached_property
    def pull(self):
        """As for `Direct`."""
        return self.moves @ self.rhs

    def step(self, target, accuracy, enough=0.0):
        """As for `Direct`."""
        gradients = self.blocks.g_exposure, self.blocks.g_star
        limit = _FAST_STEPS if is_small(self.problem) else None
        found = self._solve(*gradients, self.rows, target, accuracy, enough, limit=limit)
        if found is None:  # exposures hang together weakly
            return Direct(self.problem, self.blocks, self.gauge).step(target, accuracy)
        return found[0], self.unknowns.spread(found[1])

    def _solve(self, g_exposure, g_star, rows, target, tolerance, enough=0.0, *, max_iterations=1000, limit=None):
        """Star step (2 + k, n_stars) and step of the unknown coefficients for gradients, with rows d = target.

        None if it takes more than `limit` iterations.
        """
        lifted = self._block_solve(rows.T)
        border = np.linalg.inv(rows @ lifted)

        def precondition(r):
            z = self._block_solve(r)
            for _ in range(2):  # the second takes off what rounding leaves, which conjugate gradients would follow
                z = z - lifted @ (border @ (rows @ z))
            return z

        d = lifted @ (border @ target)
        if target.any():
            g_exposure, g_star = g_exposure - self._own(d), g_star - self._couple(d)
        stars, r = g_star, self._gradient(g_exposure, g_star)
        z = precondition(r)
        p, rz = z, r @ z
        goal = max(tolerance**2 * rz, 1e-16 * len(r))  # r'z is in units of chi2: below, only rounding is left
        enough2, lengths, ratios, met = enough**2 * (len(r) + g_star.size) * self._softest, [], [], []
        for count in range(max_iterations):
            if rz <= goal or (rz <= enough2 and rz <= enough2 * self._weakest(lengths, ratios) ** 2):
                log.debug("conjugate gradients: %d steps", count)
                break
            if count == limit:
                return None
            if count < _REMEMBERED:
                met.append(z / np.sqrt(rz))
            ep = self._couple(p)
            sp = self._gradient(self._own(p), ep)
            length = rz / (p @ sp)
            d = d + length * p
            r = r - length * sp
            stars = stars - length * ep
            z = precondition(r)
            rz, old = r @ z, rz
            p = z + rz / old * p
            lengths.append(length)
            ratios.append(rz / old)
        else:
            log.info("conjugate gradients stopped after %d steps at %.1e of the start", max_iterations, np.sqrt(rz))
        if enough:  # for the next step
            self._weakest(lengths, ratios)
            self._learn(met, lengths, ratios)
        return self._stars(stars), d

    def _weakest(self, lengths, ratios):
        """The smallest eigenvalue of the preconditioned matrix that conjugate gradients have met: 0 before the first.

        Of Lanczos' matrix, which follows from the lengths of their steps and the ratios of squares (Golub & Van Loan
        2013, section 11.3): by its inverse a step is larger than the gradient tells.
        """
        if lengths:
            least = eigvalsh_tridiagonal(*_lanczos(lengths, ratios), select="i", select_range=(0, 0))[0]
            self._met = min(max(least, 0.0), self._met or np.inf)
        return self._met

    def _learn(self, met, lengths, ratios):
        """Keep the weak directions that conjugate gradients have met, so that they are no weaker than others next time.

        Parameters
        ----------
        met : list of ndarray, shape (n,)
            Preconditioned residuals of the first iterations, of unit length in the preconditioner: Lanczos' vectors.
        lengths, ratios : list of float
            Of their steps, and of the squares of the residuals.
        """
        n = min(len(met), len(lengths) - 1)  # the last may be rounding
        if n < 2 or (self._learnt is not None and self._learnt.shape[1] > _REMEMBERED):
            return
        values, vectors = eigh_tridiagonal(*_lanczos(lengths[:n], ratios[:n]))
        lacking = np.sqrt(ratios[n - 1]) / lengths[n - 1] * np.abs(vectors[-1])  # residuals of the eigenvectors
        sure = (values > _NOTHING) & (values < _WEAK) & (lacking < _SURE * values)
        if sure.any():
            values, vectors, self._met = values[sure], vectors[:, sure], values[~sure].min(initial=_WEAK)
            made = np.array(met[:n]).T @ (vectors * np.sqrt(1 / values - 1))
            self._learnt = made if self._learnt is None else np.hstack([self._learnt, made])
            size = self._learnt.T @ np.stack([self._own(each).ravel() for each in self._learnt.T], axis=1)
            self._softest = 1 / (1 + np.linalg.eigvalsh(size)[-1])


def _lanczos(lengths, ratios):
    """Diagonal and off-diagonal of Lanczos' matrix, see `Iterative._weakest`."""
    inverse, ratios = 1 / np.array(lengths), np.array(ratios[:-1])
    return inverse + np.append(0.0, ratios * inverse[:-1]), -np.sqrt(ratios) * inverse[:-1]
