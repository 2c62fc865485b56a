"""Minimising the criterion on all unknowns at once (Gauss-Newton).

The solver eliminates the stars (Schur complement), solves for the coefficients under the constraints of
the gauge and substitutes back: the structure of bundle adjustment (Triggs et al. 2000), with exposures for
cameras and stars for points.
"""

import contextlib
import logging
from contextvars import ContextVar
from dataclasses import dataclass, replace

import numpy as np

from ..exceptions import ConvergenceWarning, SolveError, warn
from ..geometry import basis
from ..results.gauge import Gauge
from ..runtime.checks import check_choice
from ..runtime.progress import Bar
from ..runtime.words import LOSSES
from .equations import criterion, elimination, reduced_system
from .equations.losses import loss_factors
from .equations.problem import State
from .equations.reduced_base import Reduced
from .gauge import constraints, known_poses
from .gauge.hierarchy import determined_by_residuals, is_explained, is_noise

log = logging.getLogger(__name__)

#: Iterations at most, unless another number is given.
MAX_ITERATIONS = 50
#: A minimisation has converged when the next step would be below so many standard errors, rms over the unknowns.
TOLERANCE = 5e-5
#: The constraints follow the state for so many iterations; then they are held. Those of a state that is not yet the
#: solution may hold what the data determine and leave free what they do not: of 300 sets of 4 to 6 exposures and some
#: 20 stars, with 15 px of unknown static distortion, 21 never settled with 6, one with 12, none with 20. Not
#: for ever: where few stars of a reference bend the plane by much, state and constraints may chase each other.
_MADE = 20
#: ... nor once a step is below so many tolerances: what they are made from hardly changes then.
_STEADY = 200.0
#: ... or below so many standard errors, rms, and a small part of the step before, where little but the curvature of the
#: model is left: if the static distortion is taken as exact, so that they are a convention and no estimate.
_NEAR, _MUCH_SMALLER = 5.0, 0.1
#: After a first step, or one below this part of the one before, what has been factorised serves the next one too if
#: that turns out to be much smaller.
_SMALLER = 0.5
#: Inner iterations stop at this part of the tolerance.
_ENOUGH = 0.2
#: Up to so many observations one more pass over them at the start costs less than it saves.
_BEGIN_UP_TO = 100_000
#: Counts the iterations of all fits that a solution takes.
_count = ContextVar("count", default=lambda: None)


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
    n_iterations : int
        Steps, or sweeps of the published scheme (`legdistort.paper`).
    robust : ndarray, shape (n,)
        Factors on the weights from the loss (ones for a linear one).
    n_weak : int
        Unknowns of a distortion common to all exposures that these do not determine.
    system : Direct, OnStars, Iterative or None
        The reduced system there, if it was made with that gauge.
    higher : ndarray, shape (k, k), or None
        Covariance of what exposures have in common beyond the degree, as `MostProbable.higher_covariance` has it.
    """

    state: State
    blocks: criterion.Blocks
    gauge: Gauge
    converged: bool
    status: str
    n_iterations: int
    robust: np.ndarray
    n_weak: int = 0
    system: reduced_system.Reduced | None = None
    higher: np.ndarray | None = None


@contextlib.contextmanager
def iterations_shown(progress):
    """Show a progress bar of the iterations in the block, of all fits that it makes, if it takes more than a second."""
    with Bar(desc="solving", unit=" iterations", delay=1, disable=not progress) as bar:
        before = _count.set(bar.update)
        try:
            yield
        finally:
            _count.reset(before)


def solve_joint(
    problem,
    state,
    *,
    gauge="minimal",
    common=None,
    hold=False,
    loss="linear",
    max_iterations=None,
    tolerance=TOLERANCE,
    settled=False,
):
    """Gauss-Newton on all unknowns under the constraints of the gauge.

    Parameters
    ----------
    problem : Problem
    state : State
        Start values, see `legdistort.solving.start_values.start`.
    gauge : {"minimal", "mean"}
    common : ndarray, shape (2 n_modes,), optional
        Map of the reference plane at which to hold what the data do not determine, see
        `legdistort.solving.gauge.constraints.make`.
    hold : bool
        Hold the plane, and what changes it with time, where the start values have it.
    loss : {"linear", "huber", "cauchy"}
    max_iterations : int, optional
        50 if not given.
    tolerance : float
        Converged when the next step would be below this many standard errors, rms over the unknowns; it is not taken,
        nor made where the last two show that it would be far below.
    settled : bool
        Hold the plane, as `hold` does, by the convention alone: nothing is estimated of it, as for a fit of which only
        the residuals matter.

    Returns
    -------
    Result

    Raises
    ------
    SolveError
        If the unknowns are not determined.
    """
    check_choice(loss, LOSSES, "loss")
    max_iterations = MAX_ITERATIONS if max_iterations is None else max_iterations
    state = constraints.absorb_similarities(problem, state)
    run = _Descent(problem, state, _Rules(gauge, common, loss, hold or settled, tolerance, settled))
    run.descend(max_iterations)
    while run.converged and (freer := run.freer()) is not None:
        with contextlib.suppress(SolveError):
            freer.descend(max_iterations)
        if not (freer.converged and is_explained(freer.blocks.chi2, run.system)):
            break
        run = freer
    declared = run.rules.hold or run.released is None
    convention = run.convention if declared else run.declared()
    if run.finds_plane or (run.finds_drift and declared):
        convention = known_poses.determined(run.system, convention, run.violation, plane=run.finds_plane)
    status = f"converged after {len(run.steps)} iterations"
    if not run.converged:
        status = (
            f"not converged after {max_iterations} iterations: the last step was {run.steps[-1]:.2g} "
            "standard errors; look for mismatched stars (loss='cauchy'), or lower the degree"
        )
        warn(status, ConvergenceWarning)
    return Result(
        run.state,
        run.blocks,
        convention,
        run.converged,
        status,
        len(run.steps),
        run.factors,
        run.system.n_weak if problem.unknowns.shared else 0,
        run.made if declared else None,
    )


@dataclass(frozen=True, eq=False)
class _Rules:
    """What a descent follows; see `solve_joint`."""

    gauge: str
    common: np.ndarray | None
    loss: str
    hold: bool
    tolerance: float
    settled: bool


class _Descent:
    """Gauss-Newton iterations under one set of constraints."""

    def __init__(self, problem, state, rules, *, released=None, steps=()):
        self.problem, self.state, self.rules = problem, state, rules
        self.released, self.steps, self.converged = released, list(steps), False
        self.n_made = 0
        self.factors, self.weighted = np.ones(problem.xy.shape[1]), problem
        self.blocks = criterion.linearise(problem, state)
        self._reweight()
        self.stepping, self.size = None, self._begin()
        self._prepare()

    def _begin(self):
        """Fit the coefficients to the stars where they are, if the highest are those of the prior; how far they move.

        The scatter of exposures that the first gauge is made from is that of a solution then, and the reduced matrix,
        where there is one, serves two steps.
        """
        problem, blocks = self.problem, self.blocks
        plain = self.rules.loss == "linear" and not (problem.unknowns.shared or problem.terms.n)
        if not plain or not problem.degree or problem.xy.shape[1] > _BEGIN_UP_TO:
            return np.inf
        highest = slice(basis.n_modes(problem.degree - 1), problem.n_modes)
        departure = (self.state.coefficients - problem.prior_mean)[:, :, highest]
        if np.any(departure) or reduced_system.is_singular(blocks.u):
            return np.inf
        d_exposure = np.linalg.solve(blocks.u, blocks.g_exposure[..., None])[..., 0]
        size = _step_size(blocks, np.zeros_like(blocks.g_star), d_exposure)
        log.debug("J = %.8g, coefficients move by %.2g standard errors", blocks.cost, size)
        self.state = _moved(problem, self.state, 0.0, constraints.without_similarities(problem, d_exposure))
        self.blocks = criterion.linearise(self.weighted, self.state)
        return size

    def _reweight(self):
        """Weights, and normal equations with them, by the residuals of the state, unless the loss is linear."""
        if self.rules.loss != "linear":
            self.factors = loss_factors(criterion.squares(self.problem, self.blocks.residual), self.rules.loss)
            self.weighted = self.problem.scaled(self.factors)
            self.blocks = criterion.linearise(self.weighted, self.state)

    def _prepare(self, step=np.inf, last=np.inf):
        """The gauge at the current state, and what steps from it, `step` after the `last` from where they were made."""
        near = step < _NEAR and step < _MUCH_SMALLER * last < np.inf and self.convention.static == "exact"
        self.on_trial = not near and step < _SMALLER * last and self.rules.loss == "linear"
        if self.n_made < _MADE and step > _STEADY * self.rules.tolerance and not near:
            drifts = self.rules.hold or self.problem.terms.is_held
            how = {"released": self.released, "common": self.rules.common, "all_drifts": drifts}
            how |= {"settled": self.rules.settled}
            self.convention = constraints.make(self.rules.gauge, self.weighted, self.state, self.blocks, **how)
            self.n_made += 1
            if self.rules.hold:
                here = self.convention.violation(_departure(self.problem, self.state))
                self.convention = replace(self.convention, values=here)
        self.made = None
        if self.stepping is not None:
            serves = near or self.on_trial or self.stepping.moves_exactly
            self.stepping = self.stepping.moved(self.weighted, self.blocks, self.convention) if serves else None

    @property
    def system(self):
        """The reduced system at the current state; made when it is first asked for."""
        if self.made is None:
            self.made = reduced_system.reduced_system(self.weighted, self.blocks, self.convention)
        return self.made

    def _step(self, target, accuracy, enough):
        """The next step of stars and coefficients, and its size."""
        self.stepping = self.stepping or self.system
        d_star, d_exposure = self.stepping.step(target, accuracy, enough)
        return d_star, d_exposure, _step_size(self.blocks, d_star, d_exposure)

    @property
    def finds_plane(self):
        """Whether J has something that determines the plane: known poses, or stars, unless these are held in theirs."""
        stars = self.problem.terms.catalogue is not None and not self.rules.hold
        return stars or self.problem.pose_width is not None

    @property
    def finds_drift(self):
        """Whether J has something that determines maps which change with time, unless these are held in theirs."""
        return self.problem.terms.is_held and not self.rules.hold

    @property
    def violation(self):
        """How far the state is from the values of the constraints."""
        return self.convention.violation(_departure(self.problem, self.state))

    def _target(self):
        """What is lacking to the values of the constraints, or to those that J and these determine together."""
        if not (self.finds_plane or self.finds_drift):
            return -self.violation
        self.stepping = self.stepping or self.system
        return known_poses.balanced(self.stepping, self.convention, self.violation, plane=self.finds_plane)

    def descend(self, max_iterations):
        """Iterate until the next step would be below the tolerance."""
        loose = self.blocks.coupling.dtype == np.float32 and self.problem.begun is None
        accuracy, size = 1e-3 if loose else 1e-5, self.size
        tolerance, enough = self.rules.tolerance, _ENOUGH * self.rules.tolerance
        for count in range(max_iterations):
            _count.get()()
            target, last = self._target(), size
            d_star, d_exposure, size = self._step(target, accuracy, enough)
            failed = size >= _MUCH_SMALLER * last and not self.stepping.moves_exactly
            if failed and self.on_trial and self.stepping is not self.made:
                self.stepping = None
                d_star, d_exposure, size = self._step(target, accuracy, enough)
            self.steps.append(size)
            log.debug("J = %.8g, step %.2g standard errors", self.blocks.cost, size)
            if size < tolerance:
                self.converged = True
                return
            if count and size > 0.1 * last:  # slow: exposures hang together weakly; inner iterations must be more exact
                accuracy, enough = max(0.01 * accuracy, 1e-10), 0.01 * enough
            cost, self.blocks, self.made, self.stepping.blocks = self.blocks.cost, None, None, None  # makes room
            self.state, self.blocks = _advance(self.weighted, self.state, cost, d_star, d_exposure)
            self._reweight()
            self._prepare(size, last)
            if size < _STEADY * tolerance and size * size < 0.1 * tolerance * last < np.inf:
                self.converged = True
                return

    def freer(self):
        """The same with further unknown maps left to the residuals; None if these determine none."""
        unknown = any(each.degree > 1 for each in self.convention.unknown_maps)
        if self.rules.common is not None or self.rules.hold or not unknown or self.finds_plane:
            return None
        if not self.problem.unknowns.shared and is_noise(Reduced(self.weighted, self.blocks, self.convention)):
            return None
        more = determined_by_residuals(self.system, self.convention)
        if not more.shape[1]:
            return None
        log.debug("residuals determine %d maps that nothing else does", more.shape[1])
        released = more if self.released is None else np.hstack([self.released, more])
        return _Descent(self.problem, self.state, self.rules, released=released, steps=self.steps)

    def declared(self):
        """The gauge with all maps held where they are, so that errors relative to it stay relative.

        What the residuals determine of the released ones, and what is known of the motions of stars of common maps that
        change with time, becomes the absolute error.
        """
        whole = constraints.make(self.rules.gauge, self.weighted, self.state, self.blocks, all_drifts=True)
        information = reduced_system.reduced_system(self.weighted, self.blocks, whole).information
        covariance, drift = self.convention.covariance, whole.drift
        if self.released is not None:
            moved = whole.reach @ self.released
            error = self.released @ np.linalg.inv(moved.T @ information @ moved) @ self.released.T
            covariance = covariance + error
        if self.problem.terms.is_held:
            drift = drift.determined(whole.drift_reach, information)
        return replace(
            whole,
            values=whole.violation(_departure(self.problem, self.state)),
            released=self.released,
            covariance=covariance,
            unknown_maps=self.convention.unknown_maps,
            drift=drift,
        )


def _departure(problem, state):
    """A_i - A_0 in the modes of the gauge, (n_exposures, 2 n_modes)."""
    n_modes = basis.n_modes(problem.unknowns.gauge_degree)
    return (state.coefficients - problem.prior_mean)[:, :, :n_modes].reshape(problem.n_exposures, -1)


def _step_size(blocks, d_star, d_exposure):
    """Rms step in standard errors, from the diagonal blocks (stars and exposures conditionally on each other)."""
    stars = (elimination.symmetric_times(blocks.v, d_star) * d_star).sum()
    exposures = np.einsum("ia,iab,ib->", d_exposure, blocks.u, d_exposure)
    return float(np.sqrt((stars + exposures) / (d_star.size + d_exposure.size)))


def _moved(problem, state, d_star, d_exposure):
    """The state after a step of stars (2 + k, n_stars) and coefficients (n_exposures, 2 n_modes)."""
    coefficients, n_modes = state.coefficients.copy(), problem.n_modes
    coefficients[:, :, :n_modes] += d_exposure.reshape(-1, 2, n_modes)
    return State(state.stars + d_star, coefficients, state.poses)


def _advance(problem, state, cost, d_star, d_exposure):
    """Take the step, halved while it makes J much larger, and hand the similarities to the poses."""
    for halving in range(10):
        factor = 0.5**halving
        tried = constraints.absorb_similarities(problem, _moved(problem, state, factor * d_star, factor * d_exposure))
        new = criterion.linearise(problem, tried)
        # the constraints may cost a little J along directions that are only nearly free
        if new.cost <= 1.5 * cost + 10 * problem.xy.size:
            return tried, new
    raise SolveError(
        "the minimisation diverges: no step, however short, keeps the residuals in bounds; the start is too far off "
        "(wrong poses or many mismatched stars?)"
    )
