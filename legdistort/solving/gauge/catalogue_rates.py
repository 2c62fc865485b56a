"""What the proper motions of a reference catalogue determine of a map common to the motions of all stars.

Motions of the reference lie ``r_j = v_cat,j - v_j`` off those of the relative solution, ``r = D g`` but for the errors
of both, with D the modes of the reference plane. What the exposures determine of g counts with its information
(`legdistort.results.gauge.Drift`), that is, of common rates of shift, rotation and scale nothing.
"""

import numpy as np

from ...exceptions import InputError

#: Offsets beyond so many standard errors, at the observed scale if that is larger, are left out.
CLIP = 5.0
_ROUNDS = 20
_EXACT = 1e-12  # (px/yr)^2: what counts as known without error


def estimate(offsets, covariance, modes, drift, *, centre, label):
    """The common map of motions, its covariance, which offsets were used, and how it follows them.

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
    centre : ndarray, shape (2 n_modes,)
        Most probable value of the map before the reference is asked.
    label : str
        How messages call the reference.

    Returns
    -------
    value : ndarray, shape (2 n_modes,)
    covariance : ndarray, shape (2 n_modes, 2 n_modes)
    used : ndarray of bool, shape (n,)
    gain : ndarray, shape (n, 2 n_modes, 2)
        By how much the map follows every offset; zero for those not used.
    scale : float
        Size of the offsets over that to be expected, at least 1.

    Raises
    ------
    InputError
        If there are too few motions for the rates, or most of them deviate.
    """
    size = 2 * len(modes)
    design = np.kron(np.eye(2), modes.T).reshape(2, -1, size).transpose(1, 0, 2)
    maps, rates = drift.maps[:, :size], drift.rates[:, :size]
    known = maps @ drift.covariance[:size, :size] @ maps.T
    prior = maps.T @ np.linalg.solve(known + max(_EXACT, 1e-9 * np.trace(known)) * np.eye(len(known)), maps)
    possible = np.linalg.qr(np.concatenate([maps, rates]).T)[0]
    precision = np.linalg.inv(covariance)
    used = np.ones(len(offsets), dtype=bool)
    for _ in range(_ROUNDS):
        if 2 * np.count_nonzero(used) < max(len(rates), len(offsets)):
            raise InputError(
                f"the proper motions of {label} do not agree with those of the {len(offsets)} stars in common, or are "
                "too few: leave its motions out, or correct the epochs"
            )
        weighted = np.einsum("jab,jam->jbm", precision[used], design[used])
        information = prior + np.einsum("jbm,jbn->mn", weighted, design[used])
        inner = possible.T @ information @ possible
        cov = possible @ np.linalg.inv(inner) @ possible.T
        value = cov @ (prior @ centre + np.einsum("jbm,jb->m", weighted, offsets[used]))
        left = offsets - design @ value
        whole = covariance + design @ cov @ design.transpose(0, 2, 1)
        pull = np.sqrt(np.einsum("ja,jab,jb->j", left, np.linalg.inv(whole), left))
        scale = max(1.0, np.median(pull[used]) / np.sqrt(2 * np.log(2)))
        good = used & (pull <= CLIP * scale)
        if np.array_equal(good, used):
            break
        used = good
    gain = np.zeros((len(offsets), size, 2))
    gain[used] = cov @ (precision[used] @ design[used]).transpose(0, 2, 1)
    return value, cov, used, gain, scale
