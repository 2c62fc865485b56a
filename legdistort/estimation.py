"""`solve`: from matched positions to a `Solution`."""

import logging

import numpy as np
from astropy import units as u

from . import basis, criterion, outliers, solvers
from .exceptions import InputError
from .solution import Solution
from .uncertainty import Uncertainty

log = logging.getLogger(__name__)

METHODS = ("joint", "alternating")


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
        Robust losses give deviant observations less weight.
    clip : float, optional
        Leave out observations whose residual exceeds this many standard errors (at the observed scale, if
        that is larger than the stated errors); they are listed in ``residuals["used"]``.
    error_floor : float
        Pixels, added in quadrature to every stated error.
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
    if method not in METHODS:
        raise InputError(f"method must be one of {', '.join(map(repr, METHODS))}, got {method!r}")
    if method == "alternating" and (loss != "linear" or clip is not None):
        raise InputError("method='alternating' is the published scheme: it takes neither loss nor clip")
    if loss not in solvers.LOSSES:
        raise InputError(f"loss must be one of {', '.join(map(repr, solvers.LOSSES))}, got {loss!r}")
    if clip is not None and not clip > 1:
        raise InputError(f"clip must be a number of standard errors above 1, got {clip!r}")
    problem = criterion.build(matches, degree, prior=prior, error_floor=error_floor)
    start = solvers.start(problem, np.stack([matches.poses[name] for name in matches.names]))
    limit = {} if max_iterations is None else {"max_iterations": max_iterations}
    if method == "alternating":
        result, used = solvers.solve_alternating(problem, start, gauge=gauge, **limit), None
    elif clip is None:
        result, used = solvers.solve_joint(problem, start, gauge=gauge, loss=loss, **limit), None
    else:
        result, used = outliers.solve_clipped(problem, start, clip=clip, gauge=gauge, loss=loss, **limit)
    log.info("%s; chi2 %.1f", result.status, result.blocks.chi2)
    settings = {
        "degree": int(degree),
        "gauge": gauge,
        "method": method,
        "loss": loss,
        "clip": None if clip is None else float(clip),
        "error_floor": float(error_floor),
        "prior": prior is not None,
    }
    return _solution(matches, problem, result, used, prior=prior, settings=settings)


def _solution(matches, problem, result, used, *, prior, settings):
    """Bring the solver's arrays back into the order and the words of the user."""
    used = np.ones(problem.xy.shape[1], dtype=bool) if used is None else used
    weighted = problem.scaled(used * result.robust)
    blocks = criterion.linearise(weighted, result.state)
    table = matches.table.copy()
    back = np.empty_like(blocks.residual)
    back[:, problem.order] = blocks.residual
    table["dx"], table["dy"] = back * u.pix
    table["used"] = np.zeros(len(table), dtype=bool)
    table["used"][problem.order] = used
    positions = result.state.positions.T.copy()
    positions[blocks.v[0] <= 0] = np.nan
    n_stars = np.count_nonzero(blocks.v[0] > 0)
    n_free = 2 * n_stars + (problem.n_exposures - 1) * 2 * problem.n_modes
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
        chi2=blocks.chi2,
        dof=int(2 * np.count_nonzero(used) - n_free),
        status=result.status,
        gauge=result.gauge,
        uncertainty=Uncertainty(weighted, blocks, result.gauge),
        static_sigma=_static_sigma(prior, problem.n_modes),
        sky=matches.sky,
        left_out=dict(matches.left_out),
        settings=settings,
    )


def _static_sigma(prior, n_modes):
    """Uncertainty of the static distortion (2, n_modes); of several priors the largest."""
    given = [p.static_sigma for p in (prior.values() if isinstance(prior, dict) else [prior]) if p is not None]
    given = [basis.change_degree(s, basis.degree_of(n_modes)) for s in given if s is not None]
    return np.max(given, axis=0) if given else None
