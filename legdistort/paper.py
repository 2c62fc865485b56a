"""The method as it was published: Bernard, Neichel, Mugnier & Fusco 2018, sections 2 and 3, to the letter.

Plain weighted least squares of stars and coefficients from the static distortion, without a scatter of the exposures
and nothing left out. What the positions do not determine is fixed by ``sum_i (A_i - A_0) = 0``: dynamic parts that sum
to zero, as the starting point of the paper implies for undithered exposures. `legdistort.solve` does better wherever
dynamic parts do not sum to zero (docs/model.md); this is what the paper's figures are made with (docs/paper).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from .exceptions import ConvergenceWarning, InputError, warn
from .matching.matches import Matches
from .runtime.checks import check_choice
from .runtime.words import METHODS
from .solving import estimation, minimisers, single_fit, start_values
from .solving.choices import prior_widths
from .solving.equations import criterion, elimination
from .solving.equations.problem import State, build_problem
from .solving.gauge import constraints
from .solving.options import SolveOptions

if TYPE_CHECKING:
    from .priors.prior import Prior
    from .results.solution import Solution

#: Sweeps at most, unless another number is given; changes below which they end (section 3.2).
MAX_SWEEPS, TOLERANCE = 1000, 1e-5
_GAUGE = "mean"


def solve(
    matches: Matches,
    *,
    degree: int = 3,
    prior: Prior | Mapping[str, Prior] | None = None,
    method: str = "joint",
    max_iterations: int | None = None,
) -> Solution:
    """Star positions and distortions as the paper has them.

    Parameters
    ----------
    matches : Matches
        Of exposures of one detector each. Poses of the exposures are start values.
    degree : int
        Total degree of the Legendre series, 0 to 30.
    prior : Prior or dict, optional
        Static distortion A_0; one, or by ``detector`` or exposure name. None: zero.
    method : {"joint", "alternating"}
        Gauss-Newton on all unknowns; or the published scheme, stars given coefficients and coefficients given stars in
        turn, which creeps along what the positions do not determine for as long as it runs.
    max_iterations : int, optional
        Iterations, or sweeps, at most.

    Returns
    -------
    Solution
        Like that of `legdistort.solve`, with ``gauge.kind`` "mean".

    Raises
    ------
    InputError
        For bad options, a camera of several detectors, and several fields.
    SolveError
        If an exposure has fewer stars than modes, the orientations of the exposures cancel in the mean (rolls of 0,
        90, 180 and 270 degrees), or the minimisation diverges.

    See Also
    --------
    legdistort.solve : The method of this package.

    Examples
    --------
    >>> import legdistort as ld
    >>> from legdistort import paper
    >>> sim = ld.simulate_matches(seed=1)
    >>> solution = paper.solve(sim.matches, prior=ld.Prior(sim.truth.static))
    >>> dynamic = solution.coefficients - sim.truth.static
    >>> bool(abs(dynamic.sum(axis=0)).max() < 1e-6)
    True
    """
    if not isinstance(matches, Matches):
        raise InputError(f"matches must be Matches, got {type(matches).__name__}")
    check_choice(method, METHODS, "method")
    if isinstance(degree, str):
        raise InputError(f"the published method has a degree in numbers, got {degree!r}")
    if prior_widths.sought(prior):
        raise InputError("the published method finds no scatter of exposures: give a prior without sigma='evidence'")
    if matches.fields.any():
        raise InputError("the published method is for exposures of one field: use legdistort.solve")
    if matches.camera.has_focal_plane:
        raise InputError(
            f"the published method is for exposures of one detector, and camera {matches.camera.name} has several: use "
            "legdistort.solve"
        )
    asked = SolveOptions(degree=degree, prior=prior, clip=None, max_iterations=max_iterations)
    with single_fit.threads(matches):
        problem = build_problem(matches, degree, prior=prior)
        start, _ = start_values.start(problem, np.stack([matches.poses[name] for name in matches.names]))
        if method == "joint":
            result = minimisers.solve_joint(problem, start, gauge=_GAUGE, max_iterations=max_iterations)
        else:
            result = alternate(problem, start, max_iterations=max_iterations)
        fit = single_fit.Fit(matches, problem, result, np.ones(problem.xy.shape[1], dtype=bool), asked)
        return estimation.solution_of(fit, asked, gauge=_GAUGE, method=method)


def alternate(problem, state, *, max_iterations=None, tolerance=TOLERANCE):
    """The scheme of section 3.2: stars given A, coefficients given X, until both change by less than the tolerance.

    The norms in its two stopping rules are taken as Euclidean over all unknowns. Where it ends along the directions
    that the data do not determine depends on the start and the number of sweeps, so compare with others only what is
    left after a common map of the fitted degree.

    Parameters
    ----------
    problem : Problem
    state : State
        The static distortion as starting point, see `legdistort.solving.start_values.start`.
    max_iterations : int, optional
        Sweeps at most, `MAX_SWEEPS` if not given.
    tolerance : float

    Returns
    -------
    `legdistort.solving.minimisers.Result`
    """
    max_iterations = MAX_SWEEPS if max_iterations is None else max_iterations
    n_modes = problem.n_modes
    blocks = criterion.linearise(problem, state)
    for sweep in range(1, max_iterations + 1):
        before = state
        for _ in range(3):  # stars given A: a few Newton steps, each star by itself
            step = elimination.symmetric_times(elimination.inverse_star_blocks(blocks.v), blocks.g_star)
            state = State(state.stars + step, state.coefficients, state.poses)
            blocks = criterion.linearise(problem, state)
            if np.abs(step).max() < 1e-9:
                break
        coefficients = state.coefficients.copy()  # coefficients given X: linear, each exposure by itself
        change = np.linalg.solve(blocks.u, blocks.g_exposure[..., None])[..., 0]
        coefficients[:, :, :n_modes] += change.reshape(-1, 2, n_modes)
        state = State(state.stars, coefficients, state.poses)
        blocks = criterion.linearise(problem, state)
        c_a = _relative_change(before.coefficients, state.coefficients)
        c_x = _relative_change(before.positions, state.positions)
        status = f"converged after {sweep} sweeps (|dA|/|A| = {c_a:.1e}, |dX|/|X| = {c_x:.1e})"
        if converged := c_a <= tolerance and c_x <= tolerance:
            break
    if not converged:
        status = (
            f"stopped after {max_iterations} sweeps with |dA|/|A| = {c_a:.1e}, |dX|/|X| = {c_x:.1e}: the coefficients "
            "drift along directions that the data do not determine; method='joint' fixes these"
        )
        warn(status, ConvergenceWarning)
    state = constraints.absorb_similarities(problem, state)
    blocks = criterion.linearise(problem, state)
    convention = constraints.make(_GAUGE, problem, state, blocks)
    return minimisers.Result(state, blocks, convention, converged, status, sweep, np.ones(problem.xy.shape[1]))


def _relative_change(old, new):
    return float(np.linalg.norm(new - old) / max(np.linalg.norm(new), np.finfo(float).tiny))
