"""What a reference catalogue determines of a common map: an estimate of it, with its errors.

A common map g of the reference plane, X -> X + D g, is all that a reference determines. Its stars lie
``r_j = X_cat,j - X_j`` off the relative solution, ``r = D g`` but for the errors of both. What the exposures and a
prior determine of g (`legdistort.solving.gauge.hierarchy`) counts with its information, that is, of shift, rotation and
scale nothing. What neither determines to `LIMIT` stays where the convention has it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from ...exceptions import InputError
from ...results.errors.catalogue_tie import Tie, map_parts
from ..equations.criterion import complement
from .hierarchy import LIMIT

#: Offsets beyond so many standard errors, at the observed scale if that is larger, are mismatches.
CLIP = 5.0
#: Up to so many stars their relative errors are taken with all covariances, beyond star by star.
DENSE = 1000
_ROUNDS = 20
_EXACT = 1e-12  # px^2: what counts as known without error
_SQRT = np.sqrt(2 * np.log(2))  # median of the length of a normal vector in two dimensions


@dataclass(frozen=True, eq=False, repr=False)
class Offsets:
    """Where a reference puts the stars that it has, and how well that is known.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Stars of the solution.
    values : ndarray, shape (n, 2)
        Reference less solved position, pixels.
    covariance : ndarray, shape (n, 2, 2)
        Of the reference alone.
    """

    rows: np.ndarray
    values: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class MapPrior:
    """What is known of the common map before a reference is used.

    Attributes
    ----------
    information : ndarray, shape (2 k, 2 k)
        Inverse of its covariance, px^-2; nothing along similarities and what is unknown.
    centre : ndarray, shape (2 k,)
        Its most probable value, in modes.
    size : tuple
        ``(ny, nx)`` of the box of the modes, pixels.
    """

    information: np.ndarray
    centre: np.ndarray
    size: tuple

    @property
    def n_modes(self):
        """k."""
        return len(self.centre) // 2


def map_prior(covariance, unknown, directions, size):
    """The `MapPrior` of a covariance (2 k, 2 k) that leaves out similarities and `unknown` maps (2 k, m)."""
    metric = _metric(directions)
    similar = map_parts(size, len(covariance) // 2)[0]
    root = np.linalg.cholesky(metric).T
    free = np.linalg.qr(root @ np.hstack([similar, unknown]))[0]
    known = root.T @ complement(free.T).T  # what of a map is in its known part, in orthonormal coordinates
    inner = known.T @ covariance @ known
    inner += max(_EXACT, 1e-9 * np.trace(inner)) * np.eye(len(inner))
    return MapPrior(known @ np.linalg.solve(inner, known.T), np.zeros(len(covariance)), size)


def _metric(directions):
    """Mean square displacement of the stars, per axis, by maps (2 k,) squared; no map is without."""
    design = directions.reshape(-1, directions.shape[2])
    out = design.T @ design / len(design)
    return out + 1e-9 * np.trace(out) / len(out) * np.eye(len(out))


class MapEquations:
    """The equations that the offsets of a reference give for the common map.

    Parameters
    ----------
    offsets : Offsets
    directions : ndarray, shape (n_stars, 2, 2 k)
        How maps move all stars.
    relative : ndarray, shape (2 n_stars, 2 n_stars) or (3, n_stars)
        Covariance of the relative positions, all x first; or xx, yy, xy of each.
    prior : MapPrior
    """

    def __init__(self, offsets, directions, relative, prior):
        self.offsets, self.directions, self.relative, self.prior = offsets, directions, relative, prior
        rows, n = offsets.rows, len(directions)
        self.dense = len(relative) == 2 * n
        self.own = np.stack([_own(relative, star, n, self.dense) for star in rows])
        self.blocks = offsets.covariance + self.own
        self.design = directions[rows]
        self.metric = _metric(directions)

    def matrix(self, used):
        """Covariance (2 n, 2 n) of the used offsets, x and y of a star side by side."""
        n = len(self.directions)
        index = (self.offsets.rows[used, None] + [0, n]).ravel()
        out = self.relative[np.ix_(index, index)].copy()
        for k, block in enumerate(self.offsets.covariance[used]):
            out[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += block
        return out

    def gain(self, used, weights=None):
        """Information (2 k, 2 k) of the map and the matrix (2 k, 2 n) that takes the used offsets to its right side.

        With `weights` (n,) every star counts by itself, so much.
        """
        design = self.design[used].reshape(-1, self.design.shape[2])
        if self.dense and weights is None:
            weighted = np.linalg.solve(self.matrix(used), design).T
        else:
            precision = np.linalg.inv(self.blocks[used])
            precision = precision if weights is None else precision * weights[:, None, None]
            weighted = (precision @ self.design[used]).reshape(-1, design.shape[1]).T
        return weighted @ design, weighted

    def determined(self, used, weights=None):
        """Maps (2 k, m) that offsets and prior determine, with their information (m,), and the others (2 k, 2 k - m).

        Unit rms over the stars. Shift, rotation and scale count as determined wherever there is a star for them.
        """
        information = self.prior.information + self.gain(used, weights)[0]
        curvature, maps = eigh((information + information.T) / 2, self.metric)
        similar = map_parts(self.prior.size, self.prior.n_modes)[0]
        inside = similar @ np.linalg.solve(similar.T @ self.metric @ similar, similar.T @ self.metric @ maps)
        pointing = np.einsum("am,ab,bm->m", inside, self.metric, inside) > 0.5
        known = (curvature * LIMIT**2 > 1) | (pointing & (curvature > 1e-9 * curvature[-1]))
        return maps[:, known], curvature[known], maps[:, ~known]

    def solve(self, used, weights=None):
        """The map (2 k,), its covariance, and the matrix (2 k, 2 n) that takes used offsets to it."""
        maps, curvature, _ = self.determined(used, weights)
        covariance = maps / curvature @ maps.T
        gain = covariance @ self.gain(used, weights)[1]
        value = covariance @ self.prior.information @ self.prior.centre + gain @ self.offsets.values[used].ravel()
        return value, covariance, gain

    def pulls(self, used, weights=None):
        """Length of every offset less the map, in its standard errors.

        Without `weights` it is allowed for that the used ones have drawn the map towards them.
        """
        value, covariance, _ = self.solve(used, None if weights is None else weights[used])
        left = self.offsets.values - self.design @ value
        whole = self.blocks
        if weights is None:
            spread = self.design @ covariance @ self.design.transpose(0, 2, 1)
            whole = whole - 0.9 * _at_most(spread, whole)
        return np.sqrt(np.einsum("na,nab,nb->n", left, np.linalg.inv(whole), left))


def _at_most(spread, blocks):
    """The share of the map in the error of an offset, never more than the whole of it."""
    ratio = np.linalg.eigvals(np.linalg.solve(blocks, spread)).real.max(axis=1)
    return spread / np.maximum(ratio, 1)[:, None, None]


def _own(relative, star, n, dense):
    if dense:
        return relative[np.ix_([star, n + star], [star, n + star])]
    xx, yy, xy = relative[:, star]
    return np.array([[xx, xy], [xy, yy]])


def accepted(equations, label):
    """Which offsets are no mismatches: those that deviate are taken away, round by round, and never come back.

    Raises
    ------
    InputError
        If most of them deviate.
    """
    n = len(equations.offsets.rows)
    used, weights = np.ones(n, dtype=bool), np.ones(n)
    if n < 3:
        return used
    for _ in range(_ROUNDS):  # a robust start, which a few gross errors hardly move
        pull = equations.pulls(used, weights)
        scale = max(1.0, np.median(pull) / _SQRT)
        weights, before = 1 / (1 + (pull / (2.385 * scale)) ** 2), weights
        if np.abs(weights - before).max() < 0.01:
            break
    for count in range(_ROUNDS):
        if count:
            pull = equations.pulls(used)
        fresh = used & (pull > CLIP * max(1.0, np.median(pull[used]) / _SQRT))
        if count and not fresh.any():
            break
        used &= ~fresh
        if 2 * np.count_nonzero(used) < n:
            raise InputError(
                f"most of the {n} stars that {label} shares with the exposures lie elsewhere in it: other stars under "
                "the same names, or another field?"
            )
    return used


def estimate(equations, used, names):
    """The map that the used offsets determine, and the tie.

    Parameters
    ----------
    equations : MapEquations
    used : ndarray of bool, shape (n,)
    names : ndarray, shape (n_stars,)
        Of all stars.

    Returns
    -------
    value : ndarray, shape (2 k,)
    Tie
        With offsets as if that map were taken out already.
    """
    value, covariance, gain = equations.solve(used)
    left = equations.offsets.values - equations.design @ value
    offered_matrix = equations.matrix(used) if equations.dense else None
    information = equations.gain(used)[0]
    share = covariance @ information
    parts = map_parts(equations.prior.size, equations.prior.n_modes)[1:]
    pointing = 1.0 if np.count_nonzero(used) > 1 else 0.5  # a single star determines the shift alone
    measured = [pointing, *(np.trace(part.T @ share @ part) / part.shape[1] for part in parts)]
    whitened = left[used].ravel()
    if offered_matrix is None:
        chi2 = np.einsum("na,nab,nb->", left[used], np.linalg.inv(equations.blocks[used]), left[used])
    else:
        chi2 = whitened @ np.linalg.solve(offered_matrix, whitened)
    dof = len(whitened) - np.trace(share)
    return value, Tie(
        covariance=covariance,
        shared=_shared(equations, used, gain),
        measured=np.clip(measured, 0, 1),
        stars=np.asarray(names)[equations.offsets.rows],
        offsets=left,
        used=used,
        ratio=float(chi2 / dof) if dof > 2 else np.nan,
    )


def _shared(equations, used, gain):
    """See `Tie.shared`: minus the covariance of each star's relative error with the map at it, both ways."""
    n, rows = len(equations.directions), equations.offsets.rows[used]
    out = np.zeros((3, n))
    if equations.dense:
        index = (rows[:, None] + [0, n]).ravel()
        drawn = gain @ equations.relative[index]
        both = np.stack([np.einsum("nk,kn->n", equations.directions[:, a], drawn[:, b * n : (b + 1) * n])
                         for a, b in ((0, 0), (1, 1), (0, 1), (1, 0))])  # fmt: skip
        out[:] = -2 * both[0], -2 * both[1], -both[2] - both[3]
    else:
        at = np.einsum("jak,kjb,jbc->acj", equations.design[used], gain.reshape(len(gain), -1, 2), equations.own[used])
        out[:, rows] = -2 * at[0, 0], -2 * at[1, 1], -at[0, 1] - at[1, 0]
    return out
