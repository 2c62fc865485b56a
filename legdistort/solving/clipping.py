"""Rejection of mismatched or blended observations, in a way that cannot oscillate."""

import contextlib
import itertools
import warnings
from dataclasses import replace

import numpy as np

from ..exceptions import ConvergenceWarning, SolveError
from ..geometry import basis
from . import agreement, minimisers, start_values
from .equations import criterion, losses
from .equations.leverage import leverages
from .equations.problem import State

#: Deviations that chance brings about in this share of the sets with true errors give no cause to look for gross ones.
BY_CHANCE = 0.01
#: Share of gross errors up to which they are usual: 1 to 10 % in routine data (Hampel et al. 1986, section 1.2c).
USUAL = 0.1
#: A usual deviation of this many stated errors may be the work of gross errors, whatever the largest one is.
SUSPECT = 2.0
#: So many may be the work of distortions that the fit does not follow.
MISFIT = 1.3
#: ... those of a single exposure, with that many observations or more.
MISFIT_OF_ONE, ENOUGH_SEEN = 1.6, 20
#: Share of the observations that are taken to be without gross errors where the errors are far above the stated ones.
MOST = 0.8
#: Least part of an observation that counts as not taken up by its own fit.
LEAST_FREE = 0.1
#: Accuracy in standard errors, rms over its unknowns, of the robust fit that identifies gross errors.
ENOUGH = 0.1
_SWEEPS = 5  # to robust means of stars: a wrong observation loses its weight quadratically


def is_explained(problem, result, *, clip):
    """Whether chance explains all deviations from a plain fit, at the observed scale if it is little above the stated.

    Parameters
    ----------
    problem : Problem
    result : Result
        Of all its observations.
    clip : float
    """
    if not result.converged:
        return False
    squares, n = criterion.squares(problem, result.blocks.residual), problem.xy.shape[1]
    scale2 = np.median(squares) / _usual(problem)
    if scale2 > SUSPECT**2:
        return False
    limit2 = max(clip**2, 2 * np.log(n / BY_CHANCE)) * max(1.0, scale2)
    rows = np.flatnonzero(squares > LEAST_FREE * limit2)
    known = {"fitted": result.blocks, "blocks": result.blocks if np.all(result.robust == 1) else None}
    return bool(np.all(deviations(problem, result.state, result.robust, rows=rows, **known) ** 2 <= limit2))


def _usual(problem):
    """Median of the squared residuals of a plain fit to observations with true errors."""
    hidden = 2 * basis.n_modes(problem.unknowns.gauge_degree)  # maps that the gauge holds are no unknowns
    n_free = problem.n_star * problem.n_stars + problem.unknowns.size - hidden
    return 2 * np.log(2) * max(1 - n_free / (2 * problem.xy.shape[1]), LEAST_FREE)


def is_misfit(problem, result):
    """Whether usual residuals, of all or of an exposure, are too large for gross errors to be the only cause."""
    squares = criterion.squares(problem, result.blocks.residual) / _usual(problem)
    parts = [squares[problem.part(i)] for i in range(problem.n_exposures)]
    worst = max((np.median(part) for part in parts if len(part) >= ENOUGH_SEEN), default=0.0)
    return np.median(squares) > MISFIT**2 or worst > MISFIT_OF_ONE**2


def start_from(problem, result):
    """Start values from a plain fit that follows most observations of every exposure, its stars moved to robust means.

    A star of which some observations are far off lies between these and the others in a plain fit.

    Parameters
    ----------
    problem : Problem
    result : Result or None
        Of all its observations.

    Returns
    -------
    State or None
        None where gross errors moved the fit as a whole, or stars move.
    """
    if result is None or not result.converged or problem.terms.n:
        return None
    state, residual = result.state, result.blocks.residual
    squares = criterion.squares(problem, residual)
    followed, scale2 = squares <= SUSPECT**2 * _usual(problem), losses.observed_variance(squares)
    if np.any(2 * np.add.reduceat(followed.astype(int), problem.start[:-1]) <= np.diff(problem.start)):
        return None
    weight, positions = problem.weight[:2].mean(axis=0), state.positions
    q = start_values.posed(problem, state.poses, positions[:, problem.star]) + residual
    for _ in range(_SWEEPS):
        squares = weight * start_values.distances(problem, state.poses, q, positions)
        factors = losses.loss_factors(squares, "cauchy", scale2)
        positions = start_values.mean_positions(problem, state.poses, q, weight * factors)
    return State(np.where(result.blocks.v[0] > 0, positions, state.positions), state.coefficients, state.poses)


def solve_clipped(problem, start, *, clip, plain=None, loss="linear", max_iterations=None, hold=False):
    """Joint solution without the observations that deviate by more than `clip` standard errors.

    A solution with the Cauchy loss, which gross errors hardly move, identifies observations that deviate. They
    are left out of a fit with the loss asked for, and further rounds only take away, so the set settles. The
    residuals are compared with their own errors (the pull of an observation on its own fit is allowed for), at
    the observed scale where that is larger than the stated errors. A star of whose observations no majority is left
    goes with all of them.

    Parameters
    ----------
    problem : Problem
    start : State
    clip : float
    plain : Result, optional
        Of all observations, with the loss asked for: the result if none deviates.
    loss, max_iterations, hold
        As for `legdistort.solving.minimisers.solve_joint`.

    Returns
    -------
    Result
    ndarray of bool, shape (n,)
        Observations that were used, in the order of the problem.
    dict
        ``{exposure: reason}`` of exposures that the fit cannot follow.
    """
    result = _robust(problem, start, plain, hold)
    full = plain.blocks if plain is not None and plain.converged and np.all(plain.robust == 1) else None
    good = used = np.ones(problem.xy.shape[1], dtype=bool)
    for count in itertools.count():
        pull = deviations(problem, result.state, result.robust * used, full, fitted=result.blocks)
        changed = good
        if count == 1:  # the scale of few observations is not well known before most are fitted at full weight
            fair = pull <= clip * max(1.0, np.sqrt(np.mean(pull[used] ** 2) / 2))
            changed = good | (fair & (np.bincount(problem.star, used) > 0)[problem.star])
        if np.array_equal(changed, good):
            changed = good & (pull <= clip * observed_scale(pull))
            if count and np.array_equal(changed, good):
                break
        if plain is not None and changed.all():
            return plain, changed, {}
        good = changed
        if unfollowed := agreement.unfollowed(problem, good):
            return result, used, unfollowed
        used = agreement.without_contradictions(problem, good)
        if agreement.starved(problem, used):
            break
        kept = problem.scaled(used.astype(float))
        result = minimisers.solve_joint(kept, result.state, loss=loss, max_iterations=max_iterations, hold=hold)
    return result, used, {}


def _robust(problem, start, plain, hold):
    """The fit with the Cauchy loss; the plain one, if there is one, where it has no answer."""
    with warnings.catch_warnings(), contextlib.suppress(*[SolveError] * (plain is not None)):
        warnings.simplefilter("ignore", ConvergenceWarning)  # a start, good to a fraction of the errors, is enough
        return minimisers.solve_joint(problem, start, loss="cauchy", max_iterations=20, tolerance=ENOUGH, hold=hold)
    return plain


def observed_scale(pull):
    """Observed over stated errors from deviations in standard errors, shape (n,): at least 1.

    From the median; far above the stated errors it is the model that does not fit, in parts of the field more than in
    others, and the larger scale of four fifths of the observations keeps these parts from being taken for gross errors.
    """
    shares = np.array([0.5, MOST])
    median, most = (np.quantile(pull, shares) / np.sqrt(-2 * np.log(1 - shares))).tolist()
    return max(1.0, median if median <= SUSPECT else max(median, most))


def deviations(problem, state, factor, blocks=None, rows=slice(None), *, fitted=None):
    """Deviation of observations from a fit, in standard errors of the residuals, shape (n,).

    ``t^2 = r' W r / ((1 - h_star) (1 - h_exposure))``, with the leverages of the star's and the exposure's part of the
    fit, mean of the axes: exact in a two-way table of means, where what both could do is counted once. Where an
    observation took no part, its residual is larger by what the fit errs there: 1 + h. The product is at least 0.1, so
    that an observation that alone determines something is not blown up. A star whose observations have next to no
    weight left counts with all of it.

    Parameters
    ----------
    problem : Problem
        With the stated errors.
    state : State
        The fit.
    factor : ndarray, shape (n,)
        On the weights in the fit, 0 to 1.
    blocks : Blocks, optional
        Of the problem, with factors 1, at this state or one nearby, if they are known.
    rows : ndarray of int or slice
        Which observations, ascending; all if not given.
    fitted : Blocks, optional
        Of the problem with the factors at this state, if they are known.
    """
    full = criterion.linearise(problem, state) if blocks is None else blocks
    if fitted is None:
        fitted = criterion.linearise(problem.scaled(factor), state) if np.any(factor != 1) else full
    if np.any((factor > 0) & (factor < 1)):
        # a star whose observations all have little weight since they contradict one another may not be anywhere
        left = fitted.v[:2].sum(axis=0)
        lost = (left > 0) & (left < LEAST_FREE * full.v[:2].sum(axis=0))
        fitted = replace(fitted, v=np.where(lost, full.v, fitted.v))
    of_star, of_exposure = leverages(problem, fitted, at=full, rows=rows)
    sign = 1 - 2 * factor[rows]
    variance = np.maximum(1 + sign * of_star, 0) * np.maximum(1 + sign * of_exposure, 0)
    return np.sqrt(criterion.squares(problem, fitted.residual)[rows] / np.maximum(variance, LEAST_FREE))
