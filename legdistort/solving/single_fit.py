"""One fit from beginning to end: problem, start values, minimisation, and whole exposures that do not fit left out."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from scipy.optimize import brentq

from ..inputs.matches import Matches
from . import clipping, minimisers, start_values
from .choices import prior_widths
from .equations import criterion, effective_modes
from .equations.covariances import Uncertainty
from .equations.problem import Problem, build_problem, uses_compiled_loops


def threads(matches):
    """One thread for linear algebra while the compiled loops use them all; nothing special otherwise."""
    if not uses_compiled_loops(len(matches.table)):
        return nullcontext()
    from .equations import compiled

    return compiled.one_blas_thread()


@dataclass(frozen=True, eq=False)
class Fit:
    """One minimisation: what went in (after whole exposures were dropped), and what came out.

    Attributes
    ----------
    matches : Matches
    problem : Problem
    result : Result
    used : ndarray of bool, shape (n,)
        Observations that were used, in the order of the problem.
    options : SolveOptions
        With the prior and the error floor that were in force.
    widths : `legdistort.solving.choices.prior_widths.Widths` or None
        Those of the prior that were found.
    """

    matches: Matches
    problem: Problem
    result: minimisers.Result
    used: np.ndarray
    options: object
    widths: prior_widths.Widths | None = None

    @cached_property
    def weighted(self):
        """The problem with the weights that were in force."""
        if self.used.all() and np.all(self.result.robust == 1):
            return self.problem
        return self.problem.scaled(self.used * self.result.robust)

    @cached_property
    def blocks(self):
        """The normal equations with these weights."""
        if self.weighted is self.problem:
            return self.result.blocks
        return criterion.linearise(self.weighted, self.result.state)

    @cached_property
    def uncertainty(self):
        """Covariances at the stated errors."""
        return Uncertainty(self.weighted, self.blocks, self.result.gauge)

    @property
    def chi2(self):
        """Weighted squares of the used residuals."""
        return self.blocks.chi2

    @cached_property
    def effective_modes(self):
        """Number of modes of its own, both axes, that the data determine in every exposure, shape (n_exposures,)."""
        return effective_modes.effective_modes(self.problem, self.result.gauge, self.uncertainty)

    @cached_property
    def dof(self):
        """Degrees of freedom: the directions fixed by the gauge are no unknowns, and a prior does part of the work."""
        problem = self.problem
        n_free = 2 * np.count_nonzero(self.blocks.v[0] > 0) + self.effective_modes.sum()
        if problem.unknowns.shared:
            priors = problem, replace(problem, static_sigma=None)
            by_prior, by_widths = (effective_modes.done_by_prior(p, self.uncertainty).sum() for p in priors)
            n_free += problem.unknowns.n_common - self.result.n_weak - (by_prior - by_widths)
        return round(2 * np.count_nonzero(self.used) - n_free)


def estimate(matches, options):
    """The fit (`Fit`) with some `SolveOptions`; where the prior asks for it, with the widths that the exposures say."""
    prior = options.prior
    if not prior_widths.sought(prior):
        return minimise(matches, options)
    unit = np.hypot(np.sqrt(np.median(matches.observations.covariance[:, :2])), options.error_floor)
    fit, widths = prior_widths.find_widths(
        lambda resolved: minimise(matches, replace(options, prior=resolved)),
        prior,
        options.degree if options.own_degree is None else options.own_degree,
        unit,
        scale=options.errors == "scale",
    )
    return replace(fit, widths=widths)


def minimise(matches, options):
    """Minimise; exposures whose stars mostly deviate are left out, with the reason, and the rest is solved again."""
    problem = build_problem(
        matches,
        options.degree,
        prior=options.prior,
        error_floor=options.error_floor,
        own_degree=options.own_degree,
    )
    nominal = np.stack([matches.poses[name] for name in matches.names])
    robust = options.clip is not None or options.loss != "linear"
    start, misplaced = start_values.start(problem, nominal, robust=robust)
    if robust and misplaced.any():
        reason = "its stars lie nowhere near where the other exposures put them (mismatched, or not this field?)"
        return minimise(matches.without({problem.names[i]: reason for i in np.flatnonzero(misplaced)}), options)
    used = np.ones(problem.xy.shape[1], dtype=bool)
    common = {"gauge": options.gauge, "max_iterations": options.max_iterations}
    if options.method == "alternating":
        result = minimisers.solve_alternating(problem, start, **common)
    elif options.clip is None:
        result = minimisers.solve_joint(problem, start, loss=options.loss, **common)
    else:
        result, used, unfit = clipping.solve_clipped(problem, start, clip=options.clip, loss=options.loss, **common)
        if unfit:
            return minimise(matches.without(unfit), options)
    return Fit(matches, problem, result, used, options)


def estimate_with_floor(matches, fit, options):
    """The fit whose error floor makes chi2 its degrees of freedom."""
    if fit.dof <= 0 or fit.chi2 <= fit.dof:
        return fit
    residual = np.sqrt(np.mean(fit.result.blocks.residual[:, fit.used] ** 2))

    @cache
    def with_floor(log_floor):
        return estimate(matches, replace(options, errors="stated", error_floor=np.exp(log_floor)))

    def excess(log_floor):
        fitted = with_floor(log_floor)
        return np.log(fitted.chi2 / fitted.dof)

    high = np.log(4 * residual)
    low = high - 12  # a floor of 1e-5 of the residuals is none
    best = brentq(excess, low, high, xtol=1e-3, maxiter=40) if excess(low) > 0 > excess(high) else high
    return with_floor(best)
