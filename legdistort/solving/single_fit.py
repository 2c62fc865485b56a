"""One fit from beginning to end: problem, start values, minimisation, and whole exposures that do not fit left out."""

import logging
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import brentq

from . import clipping, minimisers, start_values
from .choices import prior_widths
from .equations import criterion, problem_builder
from .equations import effective_modes as influence
from .equations.covariances import Uncertainty

log = logging.getLogger(__name__)


def threads(matches):
    """One thread for linear algebra while the compiled loops use them all; nothing special otherwise."""
    if not criterion.is_compiled(len(matches.table)):
        return nullcontext()
    from .equations import compiled

    return compiled.one_blas_thread()


@dataclass(frozen=True, eq=False)
class Fit:
    """One minimisation: what went in (after whole exposures were dropped), and what came out."""

    matches: object
    problem: criterion.Problem
    result: minimisers.Result
    used: np.ndarray
    error_floor: float
    widths: dict = field(default_factory=dict)

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
        return influence.effective_modes(self.problem, self.result.gauge, self.uncertainty)

    @cached_property
    def dof(self):
        """Degrees of freedom: the directions fixed by the gauge are no unknowns, and a prior does part of the work."""
        problem = self.problem
        n_free = 2 * np.count_nonzero(self.blocks.v[0] > 0) + self.effective_modes.sum()
        if problem.unknowns.shared:
            priors = problem, replace(problem, static_sigma=None)
            by_prior, by_widths = (influence.done_by_prior(p, self.uncertainty).sum() for p in priors)
            n_free += problem.unknowns.n_common - self.result.n_weak - (by_prior - by_widths)
        return round(2 * np.count_nonzero(self.used) - n_free)


def estimate(matches, error_floor, options):
    """The fit; where the prior asks for it, with the widths that the exposures themselves say."""
    prior, own = options["prior"], options["own_degree"]
    if not prior_widths.is_wanted(prior):
        return minimise(matches, error_floor, options)
    unit = np.hypot(np.sqrt(np.median(matches.observations.covariance[:, :2])), error_floor)
    fit, widths = prior_widths.find_widths(
        lambda resolved: minimise(matches, error_floor, options | {"prior": resolved}),
        prior,
        options["degree"] if own is None else own,
        unit,
        scale=options["scale"],
    )
    return replace(fit, widths=widths)


def minimise(matches, error_floor, options):
    """Minimise; exposures whose stars mostly deviate are dropped by name and the rest is solved again."""
    gauge, loss, clip, limit = (options[key] for key in ("gauge", "loss", "clip", "limit"))
    settings = {key: options[key] for key in ("prior", "own_degree")}
    problem = problem_builder.build(matches, options["degree"], error_floor=error_floor, **settings)
    nominal = np.stack([matches.poses[name] for name in matches.names])
    robust = clip is not None or loss != "linear"
    start, misplaced = start_values.start(problem, nominal, robust=robust)
    if robust and misplaced.any():
        reason = "its stars lie nowhere near where the other exposures put them (mismatched, or not this field?)"
        return _minimise_without(
            matches, error_floor, {problem.names[i]: reason for i in np.flatnonzero(misplaced)}, options
        )
    used = np.ones(problem.xy.shape[1], dtype=bool)
    if options["method"] == "alternating":
        result = minimisers.solve_alternating(problem, start, gauge=gauge, **limit)
    elif clip is None:
        result = minimisers.solve_joint(problem, start, gauge=gauge, loss=loss, **limit)
    else:
        result, used, unfit = clipping.solve_clipped(problem, start, clip=clip, gauge=gauge, loss=loss, **limit)
        if unfit:
            return _minimise_without(matches, error_floor, unfit, options)
    return Fit(matches, problem, result, used, error_floor)


def _minimise_without(matches, error_floor, unfit, options):
    """The fit without some exposures, ``{name: reason}``."""
    for name, reason in unfit.items():
        log.log(logging.DEBUG if options.get("trial") else logging.WARNING, "exposure %s is left out: %s", name, reason)
    return minimise(matches.without(unfit), error_floor, options)


def estimate_with_floor(matches, fit, options):
    """The fit whose error floor makes chi2 its degrees of freedom."""
    if fit.dof <= 0 or fit.chi2 <= fit.dof:
        return fit
    residual = np.sqrt(np.mean(fit.result.blocks.residual[:, fit.used] ** 2))
    tried = {}

    def excess(log_floor):
        tried[log_floor] = estimate(matches, np.exp(log_floor), options)
        return np.log(tried[log_floor].chi2 / tried[log_floor].dof)

    high = np.log(4 * residual)
    low = high - 12  # a floor of 1e-5 of the residuals is none
    best = brentq(excess, low, high, xtol=1e-3, maxiter=40) if excess(low) > 0 > excess(high) else high
    return tried[best] if best in tried else estimate(matches, np.exp(best), options)
