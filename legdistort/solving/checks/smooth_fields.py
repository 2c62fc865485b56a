"""Smooth displacements that differ from exposure to exposure, as of turbulence: neighbours that are displaced alike."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

#: Standard errors beyond which neighbours are alike: those of a thousand tests of their pairs.
BEYOND_DOUBT = 5.0
#: Neighbours of a star that are looked at; observations, drawn evenly, that are enough.
_NEIGHBOURS, _MOST = 4, 20_000


@dataclass(frozen=True)
class SmoothFields:
    """How much neighbours have in common.

    Attributes
    ----------
    share : float
        Of the variance of the residuals, in single exposures beyond what all exposures have in common.
    errors : float
        The standard errors that this is.
    rms : float
        Of the displacements, pixels per axis.
    """

    share: float
    errors: float
    rms: float

    @property
    def are_there(self):
        """Whether neighbours have anything in common that differs from exposure to exposure."""
        return self.errors > BEYOND_DOUBT


def smooth_fields(residuals):
    """The `SmoothFields` in residuals: correlation of the nearest stars of an exposure, less that across exposures.

    A pattern of the detector makes neighbours alike in all exposures, in one exposure as across them. What the fit of
    an exposure takes up makes its stars less alike; it is taken off.
    """
    problem = residuals.problem
    e = residuals.whitened / np.sqrt(np.maximum(residuals.freedom / 2, 0.1))
    place = (problem.xy / problem.size[residuals.exposure].T).T
    rows = np.flatnonzero(residuals.used)
    if len(rows) < 10 * _NEIGHBOURS:
        return SmoothFields(0.0, 0.0, 0.0)
    looked = rows[:: max(1, len(rows) // _MOST)]
    apart = 4.0 * residuals.exposure[:, None]  # farther than all places of one detector
    alone = _pairs(np.hstack([place, apart]), rows, looked, _NEIGHBOURS)
    across = _pairs(place, rows, looked, 4 * _NEIGHBOURS)
    i, k = across
    across = across[:, (residuals.exposure[i] != residuals.exposure[k]) & (problem.star[i] != problem.star[k])]
    variance = float(np.mean(e[:, rows] ** 2))
    share = _product(e, *alone) / variance + _taken_up(residuals, *alone) - max(_product(e, *across) / variance, 0.0)
    error = np.sqrt(1 / max(2 * alone.shape[1], 1) + 1 / max(2 * across.shape[1], 1))
    square = float(np.mean(np.sum(residuals.blocks.residual[:, rows] ** 2, axis=0)) / 2)
    return SmoothFields(share, share / error, float(np.sqrt(max(share, 0) * square)))


def _pairs(place, rows, looked, number):
    """Pairs (2, n) of places looked at and their nearest among some rows, each once."""
    near = cKDTree(place[rows]).query(place[looked], k=min(number + 1, len(rows)))[1]
    i, k = np.repeat(looked, near.shape[1]), rows[near.ravel()]
    return np.unique(np.sort(np.stack([i, k])[:, i != k], axis=0), axis=1)


def _product(e, i, k):
    """Mean product of the residuals (2, n) of pairs."""
    return float(np.mean(e[:, i] * e[:, k])) if len(i) else 0.0


def _taken_up(residuals, i, k):
    """By how much the fit of exposures lowers the mean correlation of pairs that are in one."""
    problem, values = residuals.problem, residuals.blocks.values
    covariance = problem.unknowns.conditional_covariances(residuals.blocks.u)
    own = covariance.reshape(-1, 2, problem.n_modes, 2, problem.n_modes)
    w, free = problem.weight, 1 - residuals.star_share
    total = 0.0
    for axis in (0, 1):
        scale = np.sqrt(w[axis]) * free / np.sqrt(np.maximum(residuals.freedom / 2, 0.1))
        for exposure, block in enumerate(own[:, axis, :, axis]):
            pairs = residuals.exposure[i] == exposure
            a, b = i[pairs], k[pairs]
            total += np.sum(scale[a] * scale[b] * np.einsum("mn,mn->n", block @ values[:, a], values[:, b]))
    return float(total) / max(2 * len(i), 1)
