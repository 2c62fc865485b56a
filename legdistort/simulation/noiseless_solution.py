"""The solution that positions without noise would have: all its errors are there before any data are."""

from dataclasses import replace

import numpy as np

from ..geometry.detector_modes import dynamic_basis
from ..results.settings import Settings
from ..solving.assembly import assemble
from ..solving.equations import criterion
from ..solving.equations.covariances import Uncertainty
from ..solving.equations.problem import State
from ..solving.gauge import constraints
from ..solving.gauge.hierarchy import named
from ..solving.minimisers import Result
from ..solving.single_fit import Fit
from ..solving.terms.fitting import forecast
from ..solving.terms.term import RandomField
from ..solving.terms.turbulence import coefficient_scatter

#: Without an assumption the scatter of single exposures is taken to be this many times the errors.
_LARGE = 100.0


def noiseless_solution(matches, problem, layout, scatter):
    """What `legdistort.solve` would give for exact positions, their errors being as stated.

    Parameters
    ----------
    matches : Matches
        Without noise.
    problem : Problem
        Made of them.
    layout : Layout
        They come from.
    scatter : ndarray, shape (2, n_modes), or None
        Of the coefficients from exposure to exposure, pixels, if anything is assumed of it.

    Returns
    -------
    Solution
    State
    Uncertainty
        With the plane held by the convention of the gauge, whatever else determines it.
    errors : ndarray, callable or None
        Of new positions, see `legdistort.solving.terms.fitting.forecast`; None without terms.
    """
    positions = layout.positions[np.asarray(matches.stars)]
    stars = np.concatenate([positions.T, np.zeros((problem.terms.n, len(positions)))])
    state = State(stars, problem.prior_mean.copy(), np.stack(list(layout.poses.values())))
    blocks = criterion.linearise(problem, state)
    for term in layout.terms:
        if isinstance(term, RandomField):
            own = coefficient_scatter(term.kernel, problem, blocks, state)
            scatter = np.hypot(own, 0.0 if scatter is None else scatter)
    gauge = _gauge(problem, state, blocks, scatter, layout.sigma)
    exact, fit, errors = replace(blocks, residual=np.zeros_like(blocks.residual), chi2=0.0), None, None
    uncertainty = held = Uncertainty(problem, blocks, gauge)
    if layout.terms:
        n = len(matches.table)
        result = Result(state, exact, gauge, True, "", 0, np.ones(n))
        fit, errors = forecast(layout.terms, Fit(matches, problem, result, np.ones(n, dtype=bool), None))
        uncertainty = held = fit.uncertainty
    if gauge.static in ("none", "fitted", "uncertain"):
        plain = _gauge(replace(problem, static_errors=None), state, blocks, scatter, layout.sigma)
        held = Uncertainty(problem, blocks, plain, camera=uncertainty.camera)
    solution = assemble(
        matches,
        problem,
        state,
        exact,
        gauge,
        uncertainty,
        settings=Settings(problem.degree, method="predicted"),
        status="predicted: nothing was measured",
        dof=0,
    )
    if fit is not None and fit.tabled is not None:
        solution = fit.tabled.into(solution, 1.0)
    return solution, state, held, errors


def _gauge(problem, state, blocks, scatter, sigma):
    """The gauge, its weights from the scatter assumed, since there are no data to show it.

    Where nothing was assumed it counts as large beside the errors, and all of a common map is unknown.
    """
    if any(problem.has_widths(i) for i in range(problem.n_exposures)):
        return constraints.make("minimal", problem, state, blocks)
    others = dynamic_basis(problem.shapes[0], problem.n_modes)
    assumed = np.full(2 * problem.n_modes, _LARGE * sigma) if scatter is None else scatter.ravel()
    dynamic = np.stack([others.T @ (others * assumed**2 @ others.T) @ others] * problem.n_exposures)
    if scatter is not None:
        return constraints.make("minimal", problem, state, blocks, dynamic=dynamic)
    gauge = constraints.make("minimal", replace(problem, static_errors=None), state, blocks, dynamic=dynamic)
    unknown = named(10 * gauge.plane_modes().others.T, gauge, state.positions.T)  # any size
    nothing = {"dynamic": np.zeros_like(dynamic), "covariance": np.zeros_like(gauge.covariance)}
    return replace(gauge, **nothing, unknown_maps=unknown, static="open")
