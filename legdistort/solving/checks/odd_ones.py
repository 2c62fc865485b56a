"""Which of several departures is odd: each compared with all others, by how far these scatter."""

from typing import NamedTuple

import numpy as np
from scipy import special

#: Times the variance of the scatter and errors, beyond which the others tell nothing of a direction of a departure.
_TOLD = 100.0
_DETERMINED = 1e-10  # part of the largest curvature, of what the others have in common


class Compared(NamedTuple):
    """Departures, each by all others.

    Attributes
    ----------
    away : ndarray, shape (n, k)
        From what the others have in common, in the directions that these tell.
    ratio, chi2, dof, p : ndarray, shape (n,)
        Of these, by the scatter of the others and all errors.
    """

    away: np.ndarray
    ratio: np.ndarray
    chi2: np.ndarray
    dof: np.ndarray
    p: np.ndarray


def beyond_chance(a, noise, degrees, alarm, *, fewest, moved=None, out=()):
    """Which of departures (n, k) are left out, the least probable first, until all others are alike, or half are left.

    Several odd ones would hide behind one another. At least `fewest` are left. Those that are `out` are so from the
    start. For the others see `compared`.
    """
    out, left = list(out), np.delete(np.arange(len(a)), out)
    while len(left) > max(fewest, len(a) / 2):
        found = compared(a[left], noise[left], degrees, None if moved is None else moved[left])
        worst = np.lexsort([-found.ratio, found.p])[0]
        if found.p[worst] >= alarm:
            break
        out.append(int(left[worst]))
        left = np.delete(left, worst)
    return out


def with_others(a, out, k):
    """Indices of a departure and of all that are not left out; of these departures (n, k) the k-th is compared."""
    return np.delete(np.arange(len(a)), [i for i in out if i != k])


def compared(a, noise, degrees, moved=None):
    """Each departure by all others, which scatter, by degree, about what they have in common.

    That is a mean and, if `moved` is given, a map that moves each in its own way. Both are fitted without the one that
    is compared: a map that an odd one draws to itself would make others odd. Its directions in which it alone would
    tell the map do not count.

    Parameters
    ----------
    a : ndarray, shape (n, k)
    noise : ndarray, shape (n, k)
        Variances of errors.
    degrees : ndarray of int, shape (k,)
    moved : ndarray, shape (n, k, q), optional
        What the coefficients of a common map add to the departures.

    Returns
    -------
    Compared
    """
    (n, k), each, common = a.shape, np.unique(degrees), np.tile(np.eye(a.shape[1]), (len(a), 1, 1))
    design = common if moved is None else np.concatenate([common, moved], axis=2)
    variance = noise.copy()  # about, for weights
    for degree in each:
        of = degrees == degree
        precise = 1 / np.maximum(noise[:, of], np.median(noise[:, of]))
        off = a[:, of] - (precise * a[:, of]).sum(axis=0) / precise.sum(axis=0)
        variance[:, of] += max(np.median(np.mean(off**2 - noise[:, of], axis=1)), 0)
    unit = np.sqrt(variance)
    rows = _orthonormal(design / unit[:, :, None])
    left = a / unit - rows @ np.einsum("ikp,ik->p", rows, a / unit)
    size, directions = np.linalg.eigh(np.eye(k) - rows @ rows.transpose(0, 2, 1))
    size = np.maximum(size, 1 / _TOLD**2)
    wide = directions / size[:, None, :] @ directions.transpose(0, 2, 1)  # covariance from the fit without it
    away = np.einsum("ikl,il->ik", wide, left)
    scatter, freedom = _of_others(left, rows, away, wide, noise, variance, degrees)
    times = np.sqrt((scatter + noise) / variance)
    pull, p = away / times, np.ones(n)
    for degree in each:
        of = degrees == degree
        _, square, told = _in_told(pull[:, of], wide[:, of][:, :, of])
        found = special.fdtrc(np.maximum(told, 1), np.maximum(freedom[:, of][:, 0], 1e-3), square / np.maximum(told, 1))
        p = np.minimum(p, np.where((told > 0) & (freedom[:, of][:, 0] >= 1), found, 1))
    pull, square, told = _in_told(pull, wide)
    ratio = np.sqrt(square / np.maximum(told, 1))
    return Compared(pull * times * unit, ratio, square, told, np.minimum(1, len(each) * p))


def _of_others(left, rows, away, wide, noise, variance, degrees):
    """Variance (n, k) by which all but one scatter beyond their errors, by degree, for each, and degrees of freedom.

    Squares count by the inverse of their variances: those of one that is worth little would hide what others show.
    Their residuals are ``left + rows b``, ``b = rows_k' away``, where the k-th is not in the fit.
    """
    n, step = len(left), np.einsum("ikp,ik->ip", rows, away)
    drawn = rows.transpose(0, 2, 1) @ wide @ rows
    own = np.einsum("ikk->ik", wide) - 1
    scatter, freedom = np.empty_like(left), np.empty_like(left)
    for degree in np.unique(degrees):
        of = degrees == degree
        mine, weight, there = rows[:, of].reshape(-1, rows.shape[2]), 1 / variance[:, of].ravel(), left[:, of].ravel()
        squares = weight @ there**2 + 2 * step @ (mine.T @ (weight * there))
        squares += np.einsum("ip,pq,iq->i", step, (weight[:, None] * mine).T @ mine, step)
        squares -= (away**2 / variance)[:, of].sum(axis=1)
        power = mine.T @ mine
        free = np.count_nonzero(of) * (n - 1) - np.trace(power) - np.einsum("ipq,qp->i", drawn, power)
        free = np.maximum(free + own[:, of].sum(axis=1), 0) / (np.count_nonzero(of) * (n - 1))  # part of all others
        by = _sum_of_others(variance[:, of] ** -1.0), _sum_of_others(variance[:, of] ** -2.0)
        errors = free * _sum_of_others(noise[:, of] / variance[:, of] ** 2)
        scatter[:, of] = (np.maximum(squares - errors, 0) / np.maximum(free * by[1], 1e-3 * by[1] / n))[:, None]
        freedom[:, of] = (free * by[0] ** 2 / by[1])[:, None]
    return scatter, freedom


def _sum_of_others(values):
    """Of values (n, m) the sum of all but those of each, (n,)."""
    own = values.sum(axis=1)
    return own.sum() - own


def _orthonormal(design):
    """Columns (n, k, p) that span those of a design (n, k, m), orthonormal over all rows."""
    columns = design.reshape(-1, design.shape[2])
    curvature, directions = np.linalg.eigh(columns.T @ columns)
    kept = curvature > _DETERMINED * curvature.max()
    return design @ (directions[:, kept] / np.sqrt(curvature[kept]))


def _in_told(pull, covariance):
    """Pulls (n, k) in directions where the covariance is no larger than `_TOLD`, their squares (n,) and number (n,)."""
    size, directions = np.linalg.eigh(covariance)
    told = size < _TOLD
    along = np.where(told, np.einsum("ikd,ik->id", directions, pull), 0)
    return np.einsum("ikd,id->ik", directions, along), np.sum(along**2 / size, axis=1), told.sum(axis=1)
