"""How stars and exposures follow what all exposures have in common and the fit took as known, such as a camera."""

from dataclasses import dataclass

import numpy as np

from ...results.errors.common_maps import fitted, plain_maps
from ...results.new_positions import widened_all
from . import elimination
from .star_terms import symmetric_times


@dataclass(frozen=True, eq=False)
class Followed:
    """What a fit makes of changes of k numbers that it took as known.

    Attributes
    ----------
    stars : ndarray, shape (2 + m, n_stars, k)
        How positions, and what moves stars, follow a unit of each.
    coefficients : ndarray, shape (n_exposures, 2 n_modes, k)
        How the fitted coefficients follow.
    normal : ndarray, shape (k, k)
        Normal matrix of these numbers with stars and coefficients eliminated.
    alone : ndarray, shape (k, k)
        The same if stars and coefficients were known.
    pull : ndarray, shape (k,)
        Minus half the slope of chi2.
    """

    stars: np.ndarray
    coefficients: np.ndarray
    normal: np.ndarray
    alone: np.ndarray
    pull: np.ndarray


def followed(respond, problem, blocks, patterns):
    """The `Followed` of displacements (2, n, k) of what was measured by a unit of each number.

    Parameters
    ----------
    respond : callable
        ``respond(own, stars)``, the step of stars and coefficients by their gradients: ``settle`` of a reduced system.
    problem : Problem
    blocks : Blocks
        At the solution.
    patterns : ndarray, shape (2, n, k)
    """
    moved, k = _weighted(problem, patterns), patterns.shape[2]
    normal = np.tensordot(patterns, moved, ((0, 1), (0, 1)))
    alone = normal.copy()
    stars = np.empty((*blocks.g_star.shape, k))
    coefficients = np.empty((*blocks.g_exposure.shape, k))
    gradients = [_gradient(problem, blocks, patterns[:, :, j], moved[:, :, j]) for j in range(k)]
    whole, held = np.empty((2, k, blocks.g_exposure.size + blocks.g_star.size))
    for j, (own, star) in enumerate(gradients):
        stars[:, :, j], coefficients[:, :, j] = respond(own, star)
        at = coefficients[:, :, j], stars[:, :, j]
        whole[j] = np.concatenate([own.ravel(), star.ravel()])
        held[j] = np.concatenate([each.ravel() for each in _products(problem, blocks, *at)])
    steps = np.concatenate([coefficients.reshape(-1, k), stars.reshape(-1, k)])
    normal += (held - 2 * whole) @ steps  # at its least: what steps lack counts squared
    left = np.concatenate([blocks.g_exposure.ravel(), blocks.g_star.ravel()])
    pull = left @ steps - np.einsum("ank,an->k", moved, blocks.residual)
    return Followed(stars, coefficients, (normal + normal.T) / 2, alone, pull)


def response(system, gauge):
    """``settle`` of a reduced system, with the plane that follows too where J determines it."""
    if not gauge.poses_known:
        return system.settle
    moves = system.moves[: gauge.n_constraints]
    stars, coefficients = (np.stack([of(d) for d in moves]) for of in (system.follow, system.unknowns.spread))
    covariance = gauge.reach @ gauge.covariance @ gauge.reach.T

    def respond(own, pulls):
        held = system.settle(own, pulls)
        values = covariance @ (np.einsum("vkn,kn->v", stars, pulls) + np.einsum("via,ia->v", coefficients, own))
        return tuple(a + np.tensordot(values, b, 1) for a, b in zip(held, (stars, coefficients), strict=True))

    return respond


def relative_responses(follow, changes, result, weights, degree):
    """Stars (n_stars, 2 + m, r) and coefficients (n_exposures, 2 n_modes, r) by changes (k, r), as a `Followed` has it.

    Relative to a common map of the plane, with the `weights` (n_stars, 2 + m, 2 + m) of the stars; it is taken off
    these and given to the coefficients.
    """
    gauge, stars = result.gauge, (follow.stars @ changes).transpose(1, 0, 2)
    maps = plain_maps(gauge, result.state.positions.T, gauge.n_modes)
    common = fitted(maps, weights, stars)
    coefficients = follow.coefficients @ changes + widened_all(gauge.all_motion, degree) @ common
    return stars - maps @ common, coefficients


def _products(problem, blocks, coefficients, stars):
    """The normal equations times steps of coefficients (n_exposures, 2 n_modes) and stars (2 + m, n_stars)."""
    own = np.einsum("iab,ib->ia", blocks.u, coefficients) + elimination.to_exposures(problem, blocks, stars)
    return own, symmetric_times(blocks.v, stars) + elimination.to_stars(problem, blocks, coefficients)


def _weighted(problem, patterns):
    """W p."""
    w = problem.weight[:, :, None]
    return np.stack([w[0] * patterns[0] + w[2] * patterns[1], w[2] * patterns[0] + w[1] * patterns[1]])


def _gradient(problem, blocks, pattern, weighted):
    """Gradients of exposures and stars, were the displacements (2, n) the residuals."""
    own, stars = np.zeros_like(blocks.g_exposure), np.zeros_like(blocks.g_star)
    for i in range(problem.n_exposures):
        part = problem.part(i)
        f = blocks.coupling[:, :, part]
        pulled = problem.terms.pull(i, f[:, 0] * pattern[0, part] + f[:, 1] * pattern[1, part])
        stars[:, problem.star[part]] += pulled
        own[i] = (weighted[:, part] @ blocks.values[:, part].T).ravel()
    return own, stars
