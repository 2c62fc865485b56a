"""What a reference catalogue tells of the maps that exposures cannot: an estimate of them, with its errors.

A common map g of the reference plane, X -> X + phi(X) g, is all that a reference is asked for. Its stars lie
``r_j = X_cat,j - X_j`` off the relative solution, ``r = phi g`` but for the errors of both; what is known of g
beforehand is the size of the mean distortion of the set, and of its similarity nothing.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ...exceptions import InputError
from ...results.catalogue_tie import Tie

#: Offsets beyond so many standard errors, at the observed scale if that is larger, are mismatches.
CLIP = 5.0
#: Up to so many stars their relative errors are taken with all covariances, beyond star by star.
DENSE = 1000
_ROUNDS = 20
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


class MapEquations:
    """The equations that the offsets of a reference give for the common map.

    Parameters
    ----------
    offsets : Offsets
    modes : ndarray, shape (k, n_stars)
        Modes of the reference plane at all stars.
    relative : ndarray, shape (2 n_stars, 2 n_stars) or (3, n_stars)
        Covariance of the relative positions, all x first; or xx, yy, xy of each.
    map_prior : MapPrior
    """

    def __init__(self, offsets, modes, relative, map_prior):
        self.offsets, self.modes, self.relative, self.map_prior = offsets, modes, relative, map_prior
        rows, n = offsets.rows, modes.shape[1]
        self.dense = len(relative) == 2 * n
        self.own = np.stack([_own(relative, star, n, self.dense) for star in rows])
        self.blocks = offsets.covariance + self.own
        design = modes[:, rows].T
        self.design = np.zeros((len(rows), 2, 2 * len(modes)))
        self.design[:, 0, : len(modes)] = self.design[:, 1, len(modes) :] = design

    def matrix(self, used):
        """Covariance (2 n, 2 n) of the used offsets, x and y of a star side by side."""
        n = self.modes.shape[1]
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

    def solve(self, used, scales, weights=None):
        """The map (2 k,), its covariance, and the matrix (2 k, 2 n) that takes used offsets to it."""
        information, right = self.gain(used, weights)
        known = self.map_prior
        columns = np.hstack([self.similar(used), _root(known.covariance)])
        columns = np.hstack([columns, *(s * c for s, c in zip(scales, known.by_degree(), strict=True))])
        inner = columns.T @ information @ columns
        n = self.similar(used).shape[1]
        inner[range(n, len(inner)), range(n, len(inner))] += 1
        covariance = columns @ np.linalg.solve(inner, columns.T)
        offsets = self.offsets.values[used].ravel() - self.design[used].reshape(-1, len(information)) @ known.centre
        gain = covariance @ right
        return known.centre + gain @ offsets, covariance, gain

    def similar(self, used):
        """Similarities that the used stars tell: all, or of a single one the shift."""
        columns = self.map_prior.similarities
        return columns if np.count_nonzero(used) > 1 else columns[:, :2]

    def scales(self, used):
        """Size of the unknown static distortion, a coefficient's, by degree, by evidence (an EM iteration)."""
        parts = self.map_prior.by_degree()
        if not self.map_prior.free:
            return [0.0] * len(parts)
        information, right = self.gain(used)
        pull = right @ self.offsets.values[used].ravel()
        fixed = np.hstack([self.similar(used), _root(self.map_prior.covariance)])
        n, ends = self.similar(used).shape[1], np.cumsum([fixed.shape[1], *(p.shape[1] for p in parts)])
        out = np.full(len(parts), 2 * np.sqrt(np.mean(self.offsets.values[used] ** 2)) + 1e-6)
        for _ in range(200):
            columns = np.hstack([fixed, *(s * p for s, p in zip(out, parts, strict=True))])
            inner = columns.T @ information @ columns
            inner[range(n, len(inner)), range(n, len(inner))] += 1
            covariance = np.linalg.inv(inner)
            power = (covariance @ (columns.T @ pull)) ** 2 + np.diag(covariance)
            before = out
            out = out * np.sqrt([power[a:b].mean() for a, b in pairwise(ends)])
            if np.allclose(out, before, rtol=1e-3, atol=0):
                break
        return out

    def pulls(self, used, scales, weights=None):
        """Length of every offset less the map, in its standard errors.

        Without `weights` it is allowed for that the used ones have drawn the map towards them.
        """
        value, covariance, _ = self.solve(used, scales, None if weights is None else weights[used])
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


def _root(covariance):
    """Columns C with ``C C'`` = covariance."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-12 * max(values[-1], 1e-300)
    return vectors[:, keep] * np.sqrt(values[keep])


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
    scales = equations.scales(used)
    for _ in range(_ROUNDS):  # a robust start, which a few gross errors hardly move
        pull = equations.pulls(used, scales, weights)
        scale = max(1.0, np.median(pull) / _SQRT)
        weights, before = 1 / (1 + (pull / (2.385 * scale)) ** 2), weights
        if np.abs(weights - before).max() < 0.01:
            break
    for count in range(_ROUNDS):
        if count:
            pull = equations.pulls(used, equations.scales(used))
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
    """The map that the used offsets tell, and the tie.

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
    scales = equations.scales(used)
    value, covariance, gain = equations.solve(used, scales)
    left = equations.offsets.values - equations.design @ value
    known = equations.map_prior
    kinds = [known.similarities, *known.by_degree()]
    prior = known.covariance + sum(s**2 * c @ c.T for s, c in zip(scales, known.by_degree(), strict=True))
    measured = [equations.similar(used).shape[1] / known.similarities.shape[1]]
    for columns in kinds[1:]:
        before, after = (np.trace(columns.T @ c @ columns) for c in (prior, covariance))
        measured.append(1 - after / before if before > 0 else 0.0)
    flat = left[used].ravel()
    if equations.dense:
        chi2 = flat @ np.linalg.solve(equations.matrix(used), flat)
    else:
        chi2 = np.einsum("na,nab,nb->", left[used], np.linalg.inv(equations.blocks[used]), left[used])
    information = equations.gain(used)[0]
    dof = len(flat) - np.trace(covariance @ information)
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
    n, rows = equations.modes.shape[1], equations.offsets.rows[used]
    out, k = np.zeros((3, n)), len(equations.modes)
    gain = gain.reshape(2, k, len(rows), 2)
    if equations.dense:
        relative = equations.relative.reshape(2, n, 2, n)[:, rows]
        drawn = np.einsum("akjb,bjcn->akcn", gain, relative, optimize=True)
        at = np.einsum("kn,akcn->acn", equations.modes, drawn)
        out[:] = -2 * at[0, 0], -2 * at[1, 1], -at[0, 1] - at[1, 0]
    else:
        at = np.einsum("kj,akjb,jbc->acj", equations.modes[:, rows], gain, equations.own[used])
        out[:, rows] = -2 * at[0, 0], -2 * at[1, 1], -at[0, 1] - at[1, 0]
    return out
