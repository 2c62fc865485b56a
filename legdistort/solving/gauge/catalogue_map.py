"""What a reference catalogue determines of a common map: an estimate of it, with its errors.

A common map g of the reference plane, X -> X + D g, is all that a reference determines. Its stars lie
``r_j = X_cat,j - X_j`` off the relative solution, ``r = D g`` but for the errors of both. What the exposures and a
prior determine of g (`legdistort.solving.gauge.hierarchy`) counts with its information, that is, of shift, rotation and
scale nothing. What neither determines to `LIMIT` stays where the convention has it.

A reference may have a map of its own, ``r = D g + F p``, of which nothing is known. What of the offsets it can explain
tells nothing of g: with ``Q = 1 - F (F' W F)^-1 F' W``, W the inverse of their covariance, ``Q r = Q D g`` is left.
"""

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, eigh, lu_factor, lu_solve
from scipy.optimize import brentq

from ...exceptions import InputError
from ...results.errors.catalogue_tie import Tie, map_parts
from ..equations.criterion import complement
from .hierarchy import LIMIT

#: Offsets beyond so many standard errors, at the observed scale if that is larger, are mismatches.
CLIP = 5.0
#: Up to so many stars their relative errors are taken with all covariances, beyond star by star.
DENSE = 1000
_ROUNDS = 20
#: Degrees of freedom below which offsets tell nothing of errors.
FEWEST = 10
#: Factor on errors that are to be found, before they are; part of one by which it has settled.
_TINY, _SETTLED = 1e-6, 0.01
_CHANCE = 5.0  # standard deviations of chi2 by which chance explains offsets
_EXACT = 1e-12  # px^2: what counts as known without error
#: Beginnings of a search for the majority; a median pull, in those expected, up to which chance explains it.
_STARTS, _BEST, _USUAL = 100, 10, 1.3
#: Stars among which that search begins; the best beginnings go on with all.
_FIRST = 300
#: Mismatches from which their share tells from which pull an offset is one, and the least of these.
_SEVERAL, _LEAST = 3, 3.0
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
    modes : `legdistort.geometry.plane_modes.PlaneModes`
    """

    information: np.ndarray
    centre: np.ndarray
    modes: object

    @property
    def n_modes(self):
        """k."""
        return len(self.centre) // 2


def map_prior(covariance, unknown, directions, modes):
    """The `MapPrior` of a covariance (2 k, 2 k) that leaves out similarities and `unknown` maps (2 k, m)."""
    metric = _metric(directions)
    similar = modes.similar.T
    root = np.linalg.cholesky(metric).T
    free = np.linalg.qr(root @ np.hstack([similar, unknown]))[0]
    known = root.T @ complement(free.T).T  # what of a map is in its known part, in orthonormal coordinates
    inner = known.T @ covariance @ known
    inner += max(_EXACT, 1e-9 * np.trace(inner)) * np.eye(len(inner))
    return MapPrior(known @ np.linalg.solve(inner, known.T), np.zeros(len(covariance)), modes)


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
    bends : ndarray, shape (n, 2, q), optional
        F, maps of which the reference may have any, at its stars.
    fitted : ndarray, shape (n, 2, r), optional
        P, the part P P' of that covariance, at the stars of the reference, of what was fitted to these offsets too.
    """

    def __init__(self, offsets, directions, relative, prior, bends=None, fitted=None):
        self.offsets, self.directions, self.relative, self.prior = offsets, directions, relative, prior
        self.bends = np.zeros((len(offsets.rows), 2, 0)) if bends is None else bends
        self.fitted = np.zeros((len(offsets.rows), 2, 0)) if fitted is None else fitted
        self._factors = {}
        rows, n = offsets.rows, len(directions)
        self.dense = len(relative) == 2 * n
        self.own = np.stack([_own(relative, star, n, self.dense) for star in rows])
        self.blocks = offsets.covariance + self.own
        self.design = directions[rows]
        self.metric = _metric(directions)

    def times(self, factor):
        """The same with other errors of the reference, by a factor."""
        offsets = replace(self.offsets, covariance=factor**2 * self.offsets.covariance)
        return MapEquations(offsets, self.directions, self.relative, self.prior, self.bends, self.fitted)

    def of_some(self, which):
        """The same for some of the offsets."""
        names = ("rows", "values", "covariance")
        offsets = replace(self.offsets, **{name: getattr(self.offsets, name)[which] for name in names})
        more = self.bends[which], self.fitted[which]
        return MapEquations(offsets, self.directions, self.relative, self.prior, *more)

    def without_prior(self):
        """The same with nothing known of the map beforehand."""
        out = copy(self)
        out.prior = replace(self.prior, information=0 * self.prior.information, centre=0 * self.prior.centre)
        return out

    def with_bends(self, bends):
        """The same for a reference that may have any of these maps (n, 2, q)."""
        out = copy(self)
        out.bends = bends
        return out

    def of_values(self, values):
        """The same for other offsets (n, 2)."""
        out = copy(self)
        out.offsets = replace(self.offsets, values=values)
        return out

    def matrix(self, used):
        """Covariance (2 n, 2 n) of the used offsets, x and y of a star side by side."""
        out = self.of_exposures(used)
        for k, block in enumerate(self.offsets.covariance[used]):
            out[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += block
        return out

    def of_exposures(self, used):
        """What of that covariance is the exposures'."""
        if not self.dense:
            return block_diag(*self.own[used])
        index = (self.offsets.rows[used, None] + [0, len(self.directions)]).ravel()
        return self.relative[np.ix_(index, index)]

    def by_exposures(self, used, values):
        """Values (m, 2 n) times what of that covariance is the exposures'."""
        if self.dense:
            return values @ self.of_exposures(used)
        return np.einsum("mja,jab->mjb", values.reshape(len(values), -1, 2), self.own[used]).reshape(values.shape)

    @cached_property
    def precision(self):
        """Inverse of the covariance (n, 2, 2) of every offset by itself."""
        return np.linalg.inv(self.blocks)

    def _weighted(self, used, values, weights=None):
        """The inverse of that covariance times values (2 n, ...), factorised once for the same stars.

        With `weights` (n,) every star counts by itself, so much.
        """
        if weights is not None or not self.dense:
            precision = self.precision[used] if weights is None else self.precision[used] * weights[:, None, None]
            return (precision @ values.reshape(len(precision), 2, -1)).reshape(values.shape)
        key = used.tobytes()
        if key not in self._factors:
            self._factors.clear()
            self._factors[key] = lu_factor(self.matrix(used), check_finite=False)
        return lu_solve(self._factors[key], values, check_finite=False)

    def gain(self, used, weights=None):
        """Information (2 k, 2 k) of the map and the matrix (2 k, 2 n) that takes the used offsets to its right side.

        With `weights` (n,) every star counts by itself, so much.
        """
        design = self.straightened(self.design, used, weights)[used].reshape(-1, self.design.shape[2])
        weighted = self._weighted(used, design, weights).T
        return weighted @ design, weighted

    def bend(self, values, used, weights=None):
        """The map (q, ...) of the reference alone that fits the used ones of values (n, 2, ...) best."""
        bends = self.bends[used].reshape(2 * np.count_nonzero(used), self.bends.shape[2])
        weighted = self._weighted(used, bends, weights)
        right = weighted.T @ values[used].reshape(len(bends), *values.shape[2:])
        return np.linalg.pinv(bends.T @ weighted, hermitian=True) @ right

    def bend_covariance(self, used):
        """Covariance (q, q) of that map, the common one held."""
        bends = self.bends[used].reshape(2 * np.count_nonzero(used), self.bends.shape[2])
        return np.linalg.pinv(bends.T @ self._weighted(used, bends), hermitian=True)

    def straightened(self, values, used, weights=None):
        """Values (n, 2, ...) less that map."""
        if not self.bends.shape[2]:
            return values
        return values - self.bends @ self.bend(values, used, weights)

    def determined(self, used, weights=None):
        """Maps (2 k, m) that offsets and prior determine, with their information (m,), and the others (2 k, 2 k - m).

        Unit rms over the stars. Shift, rotation and scale count as determined wherever there is a star for them.
        """
        return self._determined(self.gain(used, weights)[0])

    def _determined(self, information):
        """The same, of the information in the offsets."""
        information = self.prior.information + information
        curvature, maps = eigh((information + information.T) / 2, self.metric)
        similar = self.prior.modes.similar.T
        inside = similar @ np.linalg.solve(similar.T @ self.metric @ similar, similar.T @ self.metric @ maps)
        pointing = np.einsum("am,ab,bm->m", inside, self.metric, inside) > 0.5
        known = (curvature * LIMIT**2 > 1) | (pointing & (curvature > 1e-9 * curvature[-1]))
        return maps[:, known], curvature[known], maps[:, ~known]

    def solve(self, used, weights=None):
        """The map (2 k,), its covariance, and the matrix (2 k, 2 n) that takes used offsets to it."""
        information, weighted = self.gain(used, weights)
        maps, curvature, _ = self._determined(information)
        covariance = maps / curvature @ maps.T
        gain = covariance @ weighted
        value = covariance @ self.prior.information @ self.prior.centre + gain @ self.offsets.values[used].ravel()
        return value, covariance, gain

    def left(self, value, used, weights=None):
        """What a map (2 k,), and that of the reference alone, leave of all offsets, (n, 2)."""
        return self.straightened(self.offsets.values - self.design @ value, used, weights)

    def freedom(self, used, share):
        """Degrees of freedom of the used offsets that these maps leave to chance alone.

        `share` (2 k, 2 k): what of the common map the offsets determine, its covariance times their information.
        """
        return 2 * np.count_nonzero(used) - self.bends.shape[2] - np.trace(share) - self.of_fitted(used)

    def of_fitted(self, used):
        """Degrees of freedom of the used offsets that went into what was fitted to them too.

        Its errors P are in their covariance C, and make these offsets less by what they make others more:
        ``tr C^-1 (C - 2 P P')`` are left.
        """
        fitted = self.fitted[used].reshape(2 * np.count_nonzero(used), self.fitted.shape[2])
        return 2 * np.sum(fitted * self._weighted(used, fitted)) if fitted.size else 0.0

    def agreement(self, used):
        """chi2 of the used offsets less the map, and its degrees of freedom."""
        value, covariance, _ = self.solve(used)
        share = covariance @ self.gain(used)[0]
        return self.chi2(self.left(value, used), used), self.freedom(used, share)

    def chi2(self, left, used, other=None):
        """That of what is left (n, 2) of the used offsets; or its product with something else of that kind."""
        left, other = left[used], (left if other is None else other)[used]
        return left.ravel() @ self._weighted(used, other.ravel())

    def pulls(self, used):
        """Length of every offset less the map, in its standard errors; those of the used ones without their own say."""
        return self.lengths(used)(1.0)

    def lengths(self, used):
        """These lengths as a function of a factor on the errors of the reference, at which the map stays as it is."""
        value, covariance, _ = self.solve(used)
        left, design = self.left(value, used), self.straightened(self.design, used)
        spread = design @ covariance @ design.transpose(0, 2, 1)
        spread = spread + self.bends @ self.bend_covariance(used) @ self.bends.transpose(0, 2, 1)

        def of(factor):
            blocks = factor**2 * self.offsets.covariance + self.own
            whole = np.where(used[:, None, None], blocks - 0.9 * _at_most(spread, blocks), blocks + spread)
            return np.sqrt(np.einsum("na,nab,nb->n", left, np.linalg.inv(whole), left))

        return of

    def squares(self, used):
        """Squares of all offsets less the map of the used ones, in their standard errors, and that of the map.

        Every star counts by itself, whatever errors they have in common.
        """
        equal = np.ones(np.count_nonzero(used))
        value = self.solve(used, equal)[0]
        left, off = self.left(value, used, equal), value - self.prior.centre
        return np.einsum("na,nab,nb->n", left, self.precision, left), off @ self.prior.information @ off


def _at_most(spread, blocks):
    """The share of the map in the error of an offset, never more than the whole of it."""
    ratio = np.linalg.eigvals(np.linalg.solve(blocks, spread)).real.max(axis=1)
    return spread / np.maximum(ratio, 1)[:, None, None]


def _own(relative, star, n, dense):
    if dense:
        return relative[np.ix_([star, n + star], [star, n + star])]
    xx, yy, xy = relative[:, star]
    return np.array([[xx, xy], [xy, yy]])


def accepted(equations, label, near=None, *, found=False):
    """Which offsets are no mismatches.

    Where not all are as expected, those of the majority that agrees best (least trimmed squares: Rousseeuw & Van
    Driessen 2006), and then all others that agree with these, at errors of the reference with which their median is as
    expected. A factor on both errors would take the best measured stars for mismatches, whose own are the least.

    Parameters
    ----------
    equations : MapEquations
    label : str
        How messages call the reference.
    near : ndarray of bool, shape (n,), optional
        Those of equations that hardly differ.
    found : bool
        Whether errors of the reference are sought: else they are as stated at least.

    Raises
    ------
    InputError
        If most of them deviate.
    """
    n = len(equations.offsets.rows)
    used = np.ones(n, dtype=bool)
    if n < 3:
        return used
    factor = least = _TINY if found else 1.0
    there = offered = equations.times(least)
    pull = there.pulls(used)
    if pull.max() <= CLIP and np.median(pull) < _USUAL * _SQRT:
        return used
    used = _majority(there) if near is None else near
    for count in range(_ROUNDS):
        lengths, before = there.lengths(used), factor
        of_scale = used if count or near is not None else slice(None)  # those that agree best are no fair sample
        factor = before * _factor_of(lengths, of_scale, least / before)
        pull = lengths(factor / before)
        agrees = pull <= _limit(pull, used)
        if np.array_equal(agrees, used) and abs(factor / before - 1) < _SETTLED:
            break
        used, there = agrees, _as_far_from_prior(offered, factor / least)
        if 2 * np.count_nonzero(used) < n:
            raise InputError(
                f"most of the {n} stars that {label} shares with the exposures lie elsewhere in it: other stars under "
                "the same names, or another field?"
            )
    return used


def _as_far_from_prior(equations, factor):
    """Equations with errors of the reference larger by a factor, whose map is no nearer to what the prior says of it.

    Else a reference that contradicts the prior, which is bent, would have ever larger errors.
    """
    out = equations.times(factor)
    share = np.einsum("naa->", out.precision) / np.einsum("naa->", equations.precision)
    out.prior = replace(out.prior, information=share * out.prior.information)
    return out


def factor_of(lengths, which, found):
    """That factor: where chance explains the lengths, or errors are sought, as `accepted` takes it."""
    if not found and np.median(lengths(1.0)[which]) < _USUAL * _SQRT:
        return 1.0
    return _factor_of(lengths, which, _TINY if found else 1.0)


def _factor_of(lengths, which, least):
    """The factor on the errors of a reference, no smaller than the `least`, by which the median length is as expected.

    `lengths` are those of `MapEquations`, and `which` of them make the median.
    """

    def excess(log_factor):
        return np.median(lengths(np.exp(log_factor))[which]) - _SQRT

    low = high = np.log(least)
    if not excess(low) > 0:
        return least
    while excess(high) > 0:
        low, high = high, high + 1
    return float(np.exp(brentq(excess, low, high, xtol=1e-3)))


def _limit(pull, used):
    """From which pull an offset is rather one of the mismatches: the nearer, the more of these there are.

    They are taken to be normally distributed like those that are known, of which one at least is one by itself.
    """
    n_lost = np.count_nonzero(~used)
    if n_lost < _SEVERAL or pull[~used].max() <= CLIP:
        return CLIP
    share, size = n_lost / len(used), np.median(pull[~used]) / _SQRT
    return min(np.sqrt(max(2 * np.log((1 - share) / share * max(size, 1) ** 2), _LEAST**2)), CLIP)


def _majority(equations):
    """As many of the offsets as are a majority whatever the others are: those that agree best among themselves."""
    n, rng = len(equations.offsets.rows), np.random.default_rng(0)
    order = np.argsort(equations.offsets.rows)  # whatever the order of the reference
    modes = (equations.design.shape[2] + equations.bends.shape[2]) // 2
    few = min(n, modes + 1)

    def nearest(equations, used):
        n = len(used)
        squares, of_map = equations.squares(used)
        part = np.argsort(squares)[: min(n, (n + modes + 1) // 2)]
        return squares[part].sum() + of_map, np.isin(np.arange(n), part)

    first, some = np.arange(n), equations
    if n > _FIRST:
        first = order[rng.permutation(n)[:_FIRST]]
        some, order = equations.of_some(first), np.arange(_FIRST)
    starts = [np.ones(len(first), dtype=bool)]
    starts += [np.isin(np.arange(len(first)), order[rng.permutation(len(first))[:few]]) for _ in range(_STARTS)]
    found = []
    for used in starts:
        for _ in range(2):
            size, used = nearest(some, used)
        found.append((size, np.isin(np.arange(n), first[used])))
    best = []
    for size, used in sorted(found, key=lambda each: each[0])[:_BEST]:
        for _ in range(_ROUNDS):
            before = used
            size, used = nearest(equations, before)
            if np.array_equal(used, before):
                break
        best.append((size, used))
    return min(best, key=lambda each: each[0])[1]


def error_factor(equations, used, ratio, dof, *, found):
    """By what factor the errors of a reference should be larger, or smaller, for the offsets to be as expected.

    Parameters
    ----------
    equations : MapEquations
    used : ndarray of bool, shape (n,)
    ratio, dof : float
        chi2 over its degrees of freedom as the errors are, and these.
    found : bool
        Whether errors are sought, not only tested: else they are larger than stated, and where chance explains the
        offsets as stated. Errors that do not show beside those of the exposures are found as large as they could be
        without showing.

    Returns
    -------
    float
    """
    if dof < FEWEST or not (found or ratio > 1 + _CHANCE * np.sqrt(2 / dof)):
        return 1.0

    def excess(log_factor):
        chi2, dof = equations.times(np.exp(log_factor)).agreement(used)
        return np.log(chi2 / dof)

    offered, own, both = (
        np.sqrt(np.mean(np.einsum("naa->na", each[used])))
        for each in (equations.offsets.covariance, equations.own, equations.blocks)
    )
    low = np.log(own * (2 / dof) ** 0.25 / offered) if found else 0.0
    high = max(low, np.log(3 * np.sqrt(ratio) * both / offered))
    if not excess(low) > 0:
        return float(np.exp(low))
    return float(np.exp(brentq(excess, low, high, xtol=1e-3) if excess(high) < 0 else high))


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
    dof : float
        Degrees of freedom of these offsets.
    """
    value, covariance, gain = equations.solve(used)
    left = equations.left(value, used)
    information, weighted = equations.gain(used)
    share = covariance @ information
    parts = map_parts(equations.prior.modes)[1:]
    pointing = 1.0 if np.count_nonzero(used) > 1 else 0.5  # a single star determines the shift alone
    measured = [pointing, *(np.trace(part.T @ share @ part) / part.shape[1] for part in parts)]
    dof = equations.freedom(used, share)
    tie = Tie(
        covariance=covariance,
        shared=_shared(equations, used, gain),
        measured=np.clip(measured, 0, 1),
        stars=np.asarray(names)[equations.offsets.rows],
        offsets=left,
        used=used,
        ratio=float(equations.chi2(left, used) / dof) if dof > 2 else np.nan,
        freedom=float(np.einsum("km,ma,ka->", covariance, weighted, equations.by_exposures(used, weighted))),
    )
    return value, tie, dof


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
