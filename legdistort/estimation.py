"""`solve`: from matched positions to a `Solution`."""

import logging
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np
from astropy import units as u
from astropy.table import QTable
from scipy.optimize import brentq

from . import basis, criterion, outliers, solvers, starting
from .exceptions import InputError, check_choice
from .gauge import KINDS
from .matches import Matches
from .solution import Solution
from .uncertainty import Uncertainty

log = logging.getLogger(__name__)

METHODS = ("joint", "alternating")
ERRORS = ("stated", "scale", "floor")


def solve(
    matches,
    *,
    degree=3,
    prior=None,
    gauge="minimal",
    method="joint",
    loss="linear",
    clip=None,
    error_floor=0.0,
    errors="stated",
    max_iterations=None,
):
    """Estimate all star positions and all distortions at once.

    Minimises ``J = sum_ij |x_ij - D_i(X_j)|^2 / sigma_ij^2`` (Bernard et al. 2017, section 3.1) over the reference
    positions X_j and the Legendre coefficients A_i of every exposure, around the prior static distortion.

    Parameters
    ----------
    matches : Matches
    degree : int
        Total degree of the Legendre series, 0 to 30.
    prior : Prior or dict, optional
        Static distortion; one, or by ``detector`` or exposure name. None starts from no distortion.
    gauge : {"minimal", "mean"}
        Convention for what the data cannot tell, see `legdistort.gauge`.
    method : {"joint", "alternating"}
        Gauss-Newton on all unknowns, or the scheme of the paper.
    loss : {"linear", "huber", "cauchy"}
        Robust losses give deviant observations less weight. Against many gross mismatches "huber" is too mild: use
        `clip`, or "cauchy".
    clip : float, optional
        Leave out observations whose residual exceeds this many standard errors (at the observed scale, if
        that is larger than the stated errors); they are listed in ``residuals["used"]``.
    error_floor : float
        Pixels, added in quadrature to every stated error.
    errors : {"stated", "scale", "floor"}
        Take the stated errors as they are; or scale the reported errors by sqrt(chi2/dof); or find the error floor
        that makes chi2 its degrees of freedom (zero if it is smaller already). What was found is in ``settings``.
    max_iterations : int, optional

    Returns
    -------
    Solution

    Raises
    ------
    InputError
        For bad options.
    SolveError
        If an exposure has fewer stars than modes, or the unknowns are not determined.
    """
    check_options(
        degree=degree, gauge=gauge, method=method, loss=loss, clip=clip, error_floor=error_floor, errors=errors,
        max_iterations=max_iterations,
    )  # fmt: skip
    if not isinstance(matches, Matches):
        raise InputError(
            f"matches must be Matches (from match(...) or Matches.from_table(...)), got {type(matches).__name__}"
        )
    options = {
        "degree": degree,
        "prior": prior,
        "gauge": gauge,
        "method": method,
        "loss": loss,
        "clip": clip,
        "limit": {} if max_iterations is None else {"max_iterations": max_iterations},
    }
    with _threads(matches):
        fit = _fit(matches, error_floor, options)
        if errors == "floor":
            fit = _fit_with_floor(matches, fit, options)
    log.info("%s; chi2 %.1f for %d degrees of freedom", fit.result.status, fit.chi2, fit.dof)
    scale = np.sqrt(fit.chi2 / fit.dof) if errors == "scale" and fit.dof > 0 else 1.0
    settings = {
        "degree": int(degree),
        "gauge": gauge,
        "method": method,
        "loss": loss,
        "clip": None if clip is None else float(clip),
        "errors": errors,
        "error_floor": float(fit.error_floor),
        "error_scale": float(scale),
        "prior": prior is not None,
    }
    return _solution(fit, scale, settings)


def check_options(*, degree=3, gauge="minimal", method="joint", loss="linear", clip=None, error_floor=0.0,
                  errors="stated", max_iterations=None):  # fmt: skip
    """Raise `InputError` for options of `solve` that are out of range or contradict one another."""
    basis.check_degree(degree)
    check_choice(gauge, KINDS, "gauge")
    criterion.check_error_floor(error_floor)
    check_choice(method, METHODS, "method")
    if method == "alternating" and (loss != "linear" or clip is not None):
        raise InputError("method='alternating' is the published scheme: it takes neither loss nor clip")
    check_choice(loss, solvers.LOSSES, "loss")
    check_choice(errors, ERRORS, "errors")
    if errors != "stated" and loss != "linear":
        raise InputError(f"errors={errors!r} compares chi2 with its expectation, which loss={loss!r} changes; use clip")
    if errors == "floor" and error_floor:
        raise InputError("errors='floor' finds the error floor itself: leave error_floor out")
    if max_iterations is not None and not (isinstance(max_iterations, int) and max_iterations > 0):
        raise InputError(f"max_iterations must be a positive integer, got {max_iterations!r}")
    if clip is not None and not (isinstance(clip, Real) and clip > 1):
        raise InputError(f"clip must be a number of standard errors above 1, got {clip!r}")


def _threads(matches):
    """One thread for linear algebra while the compiled loops use them all; nothing special otherwise."""
    if not criterion.is_compiled(len(matches.table)):
        return nullcontext()
    from . import kernels

    return kernels.one_blas_thread()


@dataclass(frozen=True, eq=False)
class _Fit:
    """One minimisation: what went in (after whole exposures were dropped), and what came out."""

    matches: object
    problem: criterion.Problem
    result: solvers.Result
    used: np.ndarray
    error_floor: float

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
    def dof(self):
        """Degrees of freedom: the directions fixed by the gauge are no unknowns, and a prior does part of the work."""
        problem = self.problem
        n_stars = np.count_nonzero(self.blocks.v[0] > 0)
        n_modes = max(problem.n_modes, 2)  # at degree 0 the poses still fit rotation and scale: 4 in all
        n_free = 2 * n_stars + (problem.n_exposures - 1) * 2 * n_modes
        if problem.prior_sigma is not None:
            size = 2 * problem.n_modes
            blocks = self.uncertainty.coefficients.reshape(problem.n_exposures, size, problem.n_exposures, size)
            n_free -= sum(
                np.sum(criterion.prior_precision(problem, i) * blocks[i, :, i]) for i in range(problem.n_exposures)
            )
        return round(2 * np.count_nonzero(self.used) - n_free)


def _fit(matches, error_floor, options):
    """Minimise; exposures whose stars mostly deviate are dropped by name and the rest is solved again."""
    gauge, loss, clip, limit = (options[key] for key in ("gauge", "loss", "clip", "limit"))
    problem = criterion.build(matches, options["degree"], prior=options["prior"], error_floor=error_floor)
    nominal = np.stack([matches.poses[name] for name in matches.names])
    robust = clip is not None or loss != "linear"
    start, misplaced = starting.start(problem, nominal, robust=robust)
    if robust and misplaced.any():
        reason = "its stars lie nowhere near where the other exposures put them (mismatched, or not this field?)"
        return _fit_without(
            matches, error_floor, {problem.names[i]: reason for i in np.flatnonzero(misplaced)}, options
        )
    used = np.ones(problem.xy.shape[1], dtype=bool)
    if options["method"] == "alternating":
        result = solvers.solve_alternating(problem, start, gauge=gauge, **limit)
    elif clip is None:
        result = solvers.solve_joint(problem, start, gauge=gauge, loss=loss, **limit)
    else:
        result, used, unfit = outliers.solve_clipped(problem, start, clip=clip, gauge=gauge, loss=loss, **limit)
        if unfit:
            return _fit_without(matches, error_floor, unfit, options)
    return _Fit(matches, problem, result, used, error_floor)


def _fit_without(matches, error_floor, unfit, options):
    """The fit without some exposures, ``{name: reason}``."""
    for name, reason in unfit.items():
        log.warning("exposure %s is left out: %s", name, reason)
    return _fit(matches.without(unfit), error_floor, options)


def _fit_with_floor(matches, fit, options):
    """The fit whose error floor makes chi2 its degrees of freedom."""
    if fit.dof <= 0 or fit.chi2 <= fit.dof:
        return fit
    residual = np.sqrt(np.mean(fit.result.blocks.residual[:, fit.used] ** 2))
    tried = {}

    def excess(log_floor):
        tried[log_floor] = _fit(matches, np.exp(log_floor), options)
        return np.log(tried[log_floor].chi2 / tried[log_floor].dof)

    high = np.log(4 * residual)
    low = high - 12  # a floor of 1e-5 of the residuals is none
    best = brentq(excess, low, high, xtol=1e-3, maxiter=40) if excess(low) > 0 > excess(high) else high
    return tried[best] if best in tried else _fit(matches, np.exp(best), options)


def _solution(fit, scale, settings):
    """Bring the solver's arrays back into the order and the words of the user."""
    matches, problem, result = fit.matches, fit.problem, fit.result
    table = QTable(matches.table, copy=False)
    back = np.empty_like(fit.blocks.residual)
    back[:, problem.order] = fit.blocks.residual
    table["dx"], table["dy"] = back * u.pix
    table["used"] = np.zeros(len(table), dtype=bool)
    table["used"][problem.order] = fit.used
    positions = result.state.positions.T.copy()
    positions[fit.blocks.v[0] <= 0] = np.nan
    return Solution(
        names=problem.names,
        degree=problem.degree,
        shapes=dict(matches.shapes),
        poses=dict(zip(problem.names, result.state.poses, strict=True)),
        coefficients=result.state.coefficients,
        prior_mean=problem.prior_mean,
        star_names=np.asarray(matches.stars),
        positions=positions,
        observations=table,
        chi2=fit.chi2,
        dof=fit.dof,
        status=result.status,
        gauge=result.gauge,
        uncertainty=fit.uncertainty if scale == 1 else Uncertainty(fit.weighted, fit.blocks, result.gauge, scale=scale),
        sky=matches.sky,
        left_out=dict(matches.left_out),
        settings=settings,
    )
