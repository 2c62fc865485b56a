"""Rejection of mismatched or blended observations, in a way that cannot oscillate."""

import warnings

import numpy as np

from ..exceptions import ConvergenceWarning
from . import minimisers
from .equations import criterion, elimination

#: Rounds of rejection after the robust start; each only takes away.
MAX_ROUNDS = 8


def solve_clipped(problem, start, *, clip, gauge="minimal", loss="linear", max_iterations=None):
    """Joint solution without the observations that deviate by more than `clip` standard errors.

    A solution with the Cauchy loss, which gross errors hardly move, says which observations deviate. They
    are left out of a fit with the loss asked for, and further rounds only take away, so the set settles. The
    residuals are compared with their own errors (the pull of an observation on its own fit is allowed for), at
    the observed scale where that is larger than the stated errors.

    Parameters
    ----------
    problem : Problem
    start : State
    clip : float
    gauge, loss, max_iterations
        As for `legdistort.solving.minimisers.solve_joint`.

    Returns
    -------
    Result
    ndarray of bool, shape (n,)
        Observations that were used, in the order of the problem.
    dict
        ``{exposure: reason}`` of exposures most of whose observations deviate: they should be left out as a whole.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a start, good to a fraction of the errors, is enough
        result = minimisers.solve_joint(problem, start, gauge=gauge, loss="cauchy", max_iterations=20, tolerance=0.02)
    used, unfit = np.ones(problem.xy.shape[1], dtype=bool), {}
    for count in range(MAX_ROUNDS):
        weighted = problem.scaled(result.robust * used)
        pull = deviations(problem, weighted, criterion.linearise(weighted, result.state))
        typical = np.median(pull[used]) / np.sqrt(2 * np.log(2))
        fresh = used & (pull > clip * max(1.0, typical))
        if count and not fresh.any():
            break
        used &= ~fresh
        unfit = unfit_exposures(problem, used)
        if unfit:
            break
        kept = problem.scaled(used.astype(float))
        result = minimisers.solve_joint(kept, result.state, gauge=gauge, loss=loss, max_iterations=max_iterations)
    return result, used, unfit


def deviations(problem, weighted, blocks):
    """Normalised residual radius of every observation, its share in its own fit allowed for, shape (n,).

    ``t^2 = r' W r / (1 - h)``, with the leverage h of the star's and the exposure's part of the fit, mean of the
    axes; at most 0.9, so that an observation that alone determines something is not blown up.

    Parameters
    ----------
    problem : Problem
        With the stated errors.
    weighted : Problem
        With the weights of the fit.
    blocks : Blocks
        Of the weighted problem.
    """
    leverage = np.zeros(problem.xy.shape[1])
    star_inverse, n_modes = elimination.inverse_star_blocks(blocks.v), problem.n_modes
    for i in range(problem.n_exposures):
        part = problem.part(i)
        w, f, b = weighted.weight[:, part], blocks.coupling[:, :, part], blocks.values[:, part]
        s = star_inverse[:, problem.star[part]]
        exposure = np.linalg.inv(blocks.u[i]).reshape(2, n_modes, 2, n_modes)
        for k in (0, 1):
            star_share = f[0, k] ** 2 * s[0] + f[1, k] ** 2 * s[1] + 2 * f[0, k] * f[1, k] * s[2]
            with np.errstate(divide="ignore", invalid="ignore"):
                leverage[part] += np.nan_to_num(star_share / w[k]) / 2
            leverage[part] += np.einsum("mn,mk,kn->n", b, exposure[k, :, k], b, optimize=True) * w[k] / 2
    squares = criterion.squares(problem, blocks.residual)
    return np.sqrt(squares / (1 - np.minimum(leverage, 0.9)))


def unfit_exposures(problem, used):
    """Exposures left with fewer than half their observations, or fewer than modes: ``{name: reason}``."""
    out = {}
    for i, name in enumerate(problem.names):
        mine = used[problem.part(i)]
        left = np.count_nonzero(mine)
        if left < max(len(mine) / 2, problem.n_free(i), 1):
            out[name] = (
                f"{len(mine) - left} of its {len(mine)} stars deviate from the solution of the others "
                "(mismatched, or not this field?)"
            )
    return out
