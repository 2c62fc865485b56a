"""What proper motions and parallaxes of a reference catalogue determine of the maps common to all stars.

Its stars lie ``r_j = c_cat,j - c_j`` off the relative solution, in position, motion and parallax together, ``r = D g``
but for the errors of both, with D how the common map and the maps that change with time
(`legdistort.results.gauge.Drift`) move the unknowns of the stars. What the exposures determine of g counts with its
information, that is, of shift, rotation and scale and their rates nothing.
"""

import numpy as np
from scipy.linalg import block_diag

from ...exceptions import InputError
from ..equations.star_terms import known_precision
from .catalogue_map import CLIP

_ROUNDS = 20
_EXACT = 1e-12  # (px/yr)^2: what counts as known without error
#: Rates of shift, rotation and scale: two for each star with a motion.
_RATES = 4


def drift_information(drift):
    """What is known beforehand of the maps of a `Drift`, inverse of their covariance (q, q); of rates nothing."""
    inner = drift.maps @ drift.covariance @ drift.maps.T
    inner += max(_EXACT, 1e-9 * np.trace(inner)) * np.eye(len(inner))
    return drift.maps.T @ np.linalg.solve(inner, drift.maps)


def accepted(offsets, covariance, modes, drift, *, label):
    """A common map of motions alone, robustly, and which stars agree with it.

    Parameters
    ----------
    offsets : ndarray, shape (n, 2)
        Pixels a year.
    covariance : ndarray, shape (n, 2, 2)
        Of the reference and of the relative motions together.
    modes : ndarray, shape (n_modes, n)
        At these stars.
    drift : `legdistort.results.gauge.Drift`
        Its maps of proper motions come first among its modes.
    label : str
        How messages call the reference.

    Returns
    -------
    value : ndarray, shape (2 n_modes,)
    used : ndarray of bool, shape (n,)
    scale : float
        Size of the offsets over that to be expected, at least 1.

    Raises
    ------
    InputError
        If there are too few motions for the rates, or most of them deviate.
    """
    size = 2 * len(modes)
    design = np.kron(np.eye(2), modes.T).reshape(2, -1, size).transpose(1, 0, 2)
    prior = drift_information(drift)[:size, :size]
    possible = _held(drift)[:size]
    left, weight, _ = np.linalg.svd(possible, full_matrices=False)
    possible = left[:, weight > 1e-6]
    precision = np.linalg.inv(covariance)
    used = np.ones(len(offsets), dtype=bool)
    for _ in range(_ROUNDS):
        if 2 * np.count_nonzero(used) < max(_RATES, len(offsets)):
            raise InputError(
                f"the proper motions of {label} do not agree with those of the {len(offsets)} stars in common, or are "
                "too few: leave its motions out, or correct the epochs"
            )
        weighted = np.einsum("jab,jam->jbm", precision[used], design[used])
        information = prior + np.einsum("jbm,jbn->mn", weighted, design[used])
        cov = possible @ np.linalg.inv(possible.T @ information @ possible) @ possible.T
        value = cov @ np.einsum("jbm,jb->m", weighted, offsets[used])
        off = offsets - design @ value
        whole = covariance + design @ cov @ design.transpose(0, 2, 1)
        pull = np.sqrt(np.einsum("ja,jab,jb->j", off, np.linalg.inv(whole), off))
        scale = max(1.0, np.median(pull[used]) / np.sqrt(2 * np.log(2)))
        good = used & (pull <= CLIP * scale)
        if np.array_equal(good, used):
            break
        used = good
    return value, used, scale


def _held(drift):
    """Orthonormal columns (q, m + c): the maps and rates of a `Drift`."""
    return np.linalg.qr(np.concatenate([drift.maps, drift.rates]).T)[0]


def estimate(offsets, own, covariance, design, *, maps, drift, information, centre):
    """The common map with those that change with time, and their covariance.

    Parameters
    ----------
    offsets : ndarray, shape (n, s)
        Positions, motions and perhaps parallaxes of the reference less those of the solution; NaN for what is unknown.
    own : ndarray, shape (s n,) squared, all x first, or (n, s, s)
        Relative covariance of the solution; star by star where there are many.
    covariance : ndarray, shape (n, s, s)
        Of the reference.
    design : ndarray, shape (n, s, c)
        How the maps move these stars, c = 2 n_modes + q.
    maps : ndarray, shape (2 n_modes, m)
        Common maps that are determined.
    drift : Drift
    information : ndarray, shape (c, c)
        Of what is known beforehand of the maps.
    centre : ndarray, shape (c,)
        Their most probable value beforehand.

    Returns
    -------
    value : ndarray, shape (c,)
    covariance : ndarray, shape (c, c)
    """
    if own.ndim == 3:
        weighted = known_precision(offsets, own + covariance) @ design
        total = np.einsum("jam,jan->mn", weighted, design)
        pull = np.einsum("jam,ja->m", weighted, np.nan_to_num(offsets))
    else:
        known = np.isfinite(offsets).T.ravel()
        n, s = offsets.shape
        index = np.arange(s * n).reshape(s, n).T
        matrix = own.copy()
        matrix[index[:, :, None], index[:, None, :]] += np.nan_to_num(covariance)
        rows = design.transpose(1, 0, 2).reshape(s * n, -1)[known]
        weighted = np.linalg.solve(matrix[np.ix_(known, known)], rows)
        total, pull = weighted.T @ rows, weighted.T @ offsets.T.ravel()[known]
    possible = block_diag(maps, _held(drift))
    total = total + information
    if offsets.shape[1] > 4 and not np.isfinite(offsets[:, 4]).any():  # the mean parallax stays where it is
        mean = design.shape[2] - drift.motion.shape[1] // 2
        total[mean, mean] += 1 / _EXACT
    out = possible @ np.linalg.inv(possible.T @ total @ possible) @ possible.T
    return out @ (pull + information @ centre), out
