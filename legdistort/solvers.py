"""Two ways to minimise the criterion: jointly (Gauss-Newton) and, as published, alternately.

The joint solver eliminates the stars (Schur complement), solves for the coefficients under the constraints of
the gauge and substitutes back: the structure of bundle adjustment (Triggs et al. 2000), with exposures for
cameras and stars for points.
"""

import logging
import warnings
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from . import criterion, elimination
from . import gauge as gauges
from .criterion import State
from .exceptions import ConvergenceWarning, SolveError, check_choice

log = logging.getLogger(__name__)

#: Up to this many unknown coefficients the reduced matrix is factorised; beyond, conjugate gradients.
DIRECT_LIMIT = 3000
#: ... and while building it costs no more than this many multiplications.
_DIRECT_COST = 4e10
LOSSES = ("linear", "huber", "cauchy")
_TUNING = {"huber": 2.0, "cauchy": 2.385}  # radii in standard errors


@dataclass(frozen=True, eq=False)
class Result:
    """Where a minimisation ended.

    Attributes
    ----------
    state : State
    blocks : Blocks
        J and its normal equations there.
    gauge : Gauge
    converged : bool
    status : str
        What happened, in a sentence.
    history : list of dict
        J, the largest changes of positions and coefficients [pix], one entry an iteration.
    robust : ndarray, shape (n,)
        Factors on the weights from the loss (ones for a linear one).
    """

    state: State
    blocks: criterion.Blocks
    gauge: gauges.Gauge
    converged: bool
    status: str
    history: list
    robust: np.ndarray


def loss_factors(squares, loss):
    """Weight factors of iteratively reweighted least squares for the squared normalised residuals (n,).

    The loss works at the observed scale if that is larger than the stated errors (median of the squares
    against its expectation for two axes, 2 ln 2).
    """
    seen = squares[squares > 0]
    scale2 = max(1.0, np.median(seen) / (2 * np.log(2))) if len(seen) else 1.0
    s = squares / (scale2 * _TUNING[loss] ** 2)
    return 1 / np.maximum(1, np.sqrt(s)) if loss == "huber" else 1 / (1 + s)


def solve_joint(problem, state, *, gauge="minimal", loss="linear", max_iterations=50, tolerance=5e-5):
    """Gauss-Newton on all unknowns under the constraints of the gauge.

    Parameters
    ----------
    problem : Problem
    state : State
        Start values, see `legdistort.starting.start`.
    gauge : {"minimal", "mean"}
    loss : {"linear", "huber", "cauchy"}
    max_iterations : int
    tolerance : float
        Converged when the next step would be below this many standard errors, rms over the unknowns; it is not taken.

    Returns
    -------
    Result

    Raises
    ------
    SolveError
        If the unknowns are not determined.
    """
    check_choice(loss, LOSSES, "loss")
    state, _ = gauges.absorb_similarities(problem, state)
    factors, weighted = np.ones(problem.xy.shape[1]), problem
    if loss != "linear":
        factors = loss_factors(criterion.squares(problem, criterion.residuals(problem, state)), loss)
        weighted = problem.scaled(factors)
    blocks = criterion.linearise(weighted, state)
    history, converged, accuracy, size = [], False, 1e-3, np.inf
    for iteration in range(1, max_iterations + 1):
        convention = gauges.make(gauge, weighted, state, blocks)
        d_star, d_exposure = newton_step(weighted, blocks, convention, _departure(problem, state), accuracy=accuracy)
        size, last = _step_size(blocks, d_star, d_exposure), size
        history.append(
            {
                "cost": blocks.cost,
                "d_positions": float(np.abs(d_star).max()),
                "d_coefficients": float(np.abs(d_exposure).max()),
                "step": size,
            }
        )
        log.debug("iteration %d: J = %.8g, step %.2g standard errors", iteration, blocks.cost, size)
        if size < tolerance:
            converged = True
            break
        if size > 0.1 * last:  # slow: exposures hang together weakly, and the inner iterations must be more exact
            accuracy = max(0.01 * accuracy, 1e-10)
        cost, blocks = blocks.cost, None  # makes room for the next
        state, blocks = _advance(weighted, state, cost, d_star, d_exposure)
        if loss != "linear":
            factors = loss_factors(criterion.squares(problem, blocks.residual), loss)
            weighted = problem.scaled(factors)
            blocks = criterion.linearise(weighted, state)
    if not converged:
        convention = gauges.make(gauge, weighted, state, blocks)
    status = f"converged after {iteration} iterations"
    if not converged:
        status = (
            f"not converged after {max_iterations} iterations: the last step was {size:.2g} standard errors; "
            "look for mismatched stars (loss='cauchy'), or lower the degree"
        )
        warnings.warn(status, ConvergenceWarning, stacklevel=2)
    return Result(state, blocks, convention, converged, status, history, factors)


def _departure(problem, state):
    return (state.coefficients - problem.prior_mean)[:, :, : problem.n_modes].reshape(problem.n_exposures, -1)


def _step_size(blocks, d_star, d_exposure):
    """Rms step in standard errors, from the diagonal blocks (stars and exposures conditionally on each other)."""
    stars = (elimination.symmetric_times(blocks.v, d_star) * d_star).sum()
    exposures = np.einsum("ia,iab,ib->", d_exposure, blocks.u, d_exposure)
    return float(np.sqrt((stars + exposures) / (d_star.size + d_exposure.size)))


def _advance(problem, state, cost, d_star, d_exposure):
    """Take the step, halved while it makes J much larger, and hand the similarities to the poses."""
    n_modes = problem.n_modes
    for halving in range(10):
        factor = 0.5**halving
        coefficients = state.coefficients.copy()
        coefficients[:, :, :n_modes] += factor * d_exposure.reshape(-1, 2, n_modes)
        tried = State(state.positions + factor * d_star, coefficients, state.poses)
        tried, _ = gauges.absorb_similarities(problem, tried)
        new = criterion.linearise(problem, tried)
        # the constraints may cost a little J along directions that are only nearly free
        if new.cost <= 1.5 * cost + 10 * problem.xy.size:
            return tried, new
    raise SolveError(
        "the minimisation diverges: no step, however short, keeps the residuals in bounds; the start is too far off "
        "(wrong poses or many mismatched stars?)"
    )


def newton_step(problem, blocks, gauge, departure, *, accuracy=1e-10):
    """Gauss-Newton step under the constraints of the gauge.

    Parameters
    ----------
    problem : Problem
    blocks : Blocks
    gauge : Gauge
    departure : ndarray, shape (n_exposures, 2 n_modes)
        A_i - A_0 at the current state.
    accuracy : float
        Where conjugate gradients may stop, relative to the size of the step.

    Returns
    -------
    d_star : ndarray, shape (2, n_stars)
    d_exposure : ndarray, shape (n_exposures, 2 n_modes)
    """
    inverse = elimination.inverse_star_blocks(blocks.v)
    target = -gauge.violation(departure)
    if not uses_direct(problem):
        return _conjugate_gradients(problem, blocks, gauge.orthonormal, target, tolerance=accuracy)
    alone = elimination.symmetric_times(inverse, blocks.g_star)
    rhs = (blocks.g_exposure - elimination.to_exposures(problem, blocks, alone)).ravel()
    d = ReducedSystem(problem, blocks, gauge).solve(rhs, target).reshape(problem.n_exposures, -1)
    return alone - elimination.symmetric_times(inverse, elimination.to_stars(problem, blocks, d)), d


def uses_direct(problem):
    """Whether the reduced system is small enough to be factorised."""
    n = problem.n_exposures * 2 * problem.n_modes
    return n <= DIRECT_LIMIT and n * n * 2.0 * problem.n_stars <= _DIRECT_COST


class ReducedSystem:
    """The reduced matrix S, factorised together with the constraints of the gauge.

    Raises
    ------
    SolveError
        If S is singular beyond the gauge, naming the exposures concerned.
    """

    def __init__(self, problem, blocks, gauge):
        s = elimination.reduced_matrix(problem, blocks)
        self.rows = gauge.orthonormal
        s += np.mean(np.diag(s)) * self.rows.T @ self.rows  # lifts the gauge directions; undone by the multipliers
        # unit diagonal: coefficients of bright and faint exposures then compare
        diagonal = np.diag(s).copy()
        self.scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
        s *= self.scale[:, None]
        s *= self.scale
        try:
            self.factor = cho_factor(s, lower=True, overwrite_a=False, check_finite=True)
            if np.diag(self.factor[0]).min() < 1e-7:
                raise LinAlgError
        except (LinAlgError, ValueError):
            raise SolveError(_singular_message(problem, s)) from None
        self.lifted = self._apply_inverse(self.rows.T)
        self.border = np.linalg.inv(self.rows @ self.lifted)

    def _apply_inverse(self, b):
        scale = self.scale if b.ndim == 1 else self.scale[:, None]
        return scale * cho_solve(self.factor, scale * b)

    def solve(self, rhs, target):
        """d (n,) that minimises d'Sd/2 - rhs'd with rows d = target."""
        free = self._apply_inverse(rhs)
        return free - self.lifted @ (self.border @ (self.rows @ free - target))

    def covariance(self):
        """Covariance of the coefficients in the gauge, shape (n, n)."""
        full = self._apply_inverse(np.eye(len(self.scale)))
        out = full - self.lifted @ self.border @ self.lifted.T
        return (out + out.T) / 2


def _singular_message(problem, s):
    values, vectors = np.linalg.eigh(np.nan_to_num(s))
    energy = (vectors[:, 0].reshape(problem.n_exposures, -1) ** 2).sum(axis=1)
    worst = [problem.names[i] for i in np.argsort(energy)[::-1][:3] if energy[i] > 0.1]
    return (
        f"the observations do not determine the distortion of degree {problem.degree} "
        f"(smallest eigenvalue {values[0]:.1e} of the normalised equations), above all in exposure {', '.join(worst)}: "
        "lower the degree, add stars, or give a prior with sigma"
    )


def _conjugate_gradients(problem, blocks, rows, target, *, tolerance, max_iterations=1000):
    """Matrix-free solution of the reduced system on the constraints, preconditioned by the exposure blocks.

    Projected conjugate gradients with the constraint preconditioner of Gould, Hribar & Nocedal (2001): every
    iterate satisfies ``rows d = target``. The coupling E d of the iterate is carried along, so that neither the
    right-hand side nor the stars need a pass of their own.

    Returns
    -------
    d_star : ndarray, shape (2, n_stars)
    d_exposure : ndarray, shape (n_exposures, 2 n_modes)
    """
    inverse = elimination.inverse_star_blocks(blocks.v)
    block_inverse = np.linalg.inv(blocks.u)
    shape = blocks.g_exposure.shape

    def couple(d):
        return elimination.to_stars(problem, blocks, d.reshape(shape))

    def gradient(own, stars):
        """``own - E' V^-1 stars``."""
        back = elimination.to_exposures(problem, blocks, elimination.symmetric_times(inverse, stars))
        return (own - back).ravel()

    def own(d):
        return np.einsum("iab,ib->ia", blocks.u, d.reshape(shape))

    def block_solve(r):
        return np.einsum("iab,ib->ia", block_inverse, r.reshape(shape)).ravel()

    lifted = np.stack([block_solve(row) for row in rows], axis=1)
    border = np.linalg.inv(rows @ lifted)

    def precondition(r):
        z = block_solve(r)
        return z - lifted @ (border @ (rows @ z))

    d = lifted @ (border @ target)
    stars = blocks.g_star - couple(d)
    r = gradient(blocks.g_exposure - own(d), stars)
    z = precondition(r)
    p, rz = z, r @ z
    goal = max(tolerance**2 * rz, 1e-16 * len(r))  # r'z is in units of chi2: below, only rounding is left
    for count in range(max_iterations):
        if rz <= goal:
            log.debug("conjugate gradients: %d steps", count)
            break
        ep = couple(p)
        sp = gradient(own(p), ep)
        step = rz / (p @ sp)
        d = d + step * p
        r = r - step * sp
        stars = stars - step * ep
        z = precondition(r)
        rz, old = r @ z, rz
        p = z + rz / old * p
    else:
        log.info("conjugate gradients stopped after %d steps at %.1e of the start", max_iterations, np.sqrt(rz))
    return elimination.symmetric_times(inverse, stars), d.reshape(shape)


def solve_alternating(problem, state, *, gauge="minimal", max_iterations=1000, tolerance=1e-5):
    """The paper's scheme (section 3.2): stars given A, coefficients given X, until both change by less than 1e-5.

    The norms in its two stopping rules are taken as Euclidean over all unknowns. Where it ends along the directions
    that the data do not tell depends on the start and the number of sweeps, so compare with `solve_joint` only
    what is left after a common map of the fitted degree.

    Parameters
    ----------
    problem : Problem
    state : State
        The static distortion as starting point, see `legdistort.starting.start`.
    gauge : {"minimal", "mean"}
        Convention in which errors are reported.
    max_iterations : int
        Cap on the sweeps.
    tolerance : float

    Returns
    -------
    Result
    """
    n_modes, history, converged = problem.n_modes, [], False
    blocks = criterion.linearise(problem, state)
    for _sweep in range(1, max_iterations + 1):
        before = state
        for _ in range(3):  # stars given A: a few Newton steps, each star by itself
            step = elimination.symmetric_times(elimination.inverse_star_blocks(blocks.v), blocks.g_star)
            state = State(state.positions + step, state.coefficients, state.poses)
            blocks = criterion.linearise(problem, state)
            if np.abs(step).max() < 1e-9:
                break
        coefficients = state.coefficients.copy()  # coefficients given X: linear, each exposure by itself
        change = np.linalg.solve(blocks.u, blocks.g_exposure[..., None])[..., 0]
        coefficients[:, :, :n_modes] += change.reshape(-1, 2, n_modes)
        state = State(state.positions, coefficients, state.poses)
        blocks = criterion.linearise(problem, state)
        c_a = _relative_change(before.coefficients, state.coefficients)
        c_x = _relative_change(before.positions, state.positions)
        history.append({"cost": blocks.cost, "c_a": c_a, "c_x": c_x})
        if c_a <= tolerance and c_x <= tolerance:
            converged = True
            break
    status = f"converged after {len(history)} sweeps (|dA|/|A| = {c_a:.1e}, |dX|/|X| = {c_x:.1e})"
    if not converged:
        status = (
            f"stopped after {max_iterations} sweeps with |dA|/|A| = {c_a:.1e}, |dX|/|X| = {c_x:.1e}: the coefficients "
            "drift along directions that the data do not tell; method='joint' fixes these"
        )
        warnings.warn(status, ConvergenceWarning, stacklevel=2)
    state, _ = gauges.absorb_similarities(problem, state)
    blocks = criterion.linearise(problem, state)
    convention = gauges.make(gauge, problem, state, blocks)
    return Result(state, blocks, convention, converged, status, history, np.ones(problem.xy.shape[1]))


def _relative_change(old, new):
    return float(np.linalg.norm(new - old) / max(np.linalg.norm(new), np.finfo(float).tiny))
