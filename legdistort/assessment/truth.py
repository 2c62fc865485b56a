"""A solution of a simulated set compared with what was put in."""

import numpy as np
from scipy.spatial import cKDTree

from ..results import accuracy

_HELD_OUT_PER_SIDE = 20


def compare_with_truth(solution, truth, *, seed=0):
    """How far a solution is from the truth, and how far its own errors lead to expect.

    Returns
    -------
    dict
        ``b_px``: error of the star positions after the common map of the fitted degree (free of the gauge);
        ``b_bound_px``: its Cramer-Rao bound. ``b_abs_px``: error after a common shift, rotation and scale (pointing);
        ``b_abs_err_px``: reported for it. ``sigma_new_px``, ``sigma_new_expected_px``: scatter of corrected
        positions that the solution has not seen, measured and from the Fisher matrix.
    """
    true = nearest(solution.estimate.positions, truth.positions)
    names = list(solution.names)
    error = float(np.median(solution.residuals["x_err"].value))
    new = np.concatenate([truth.grid(name, _HELD_OUT_PER_SIDE) for name in names[:: max(1, len(names) // 3)]])
    rng = np.random.default_rng(seed + 1)
    corrected = np.full((len(names), len(new), 2), np.nan)
    for i, name in enumerate(names):
        seen = np.flatnonzero(solution[name].supported(truth.distort(name, new)))
        noisy = truth.distort(name, new[seen]) + error * rng.normal(size=(len(seen), 2))
        corrected[i, seen] = solution[name].to_reference(noisy)
    measured = accuracy.scatter(corrected)
    expected = accuracy.expected_scatter(solution, new, error, seen=np.isfinite(corrected[..., 0]))
    good = np.isfinite(measured) & np.isfinite(expected)
    return {
        "b_px": accuracy.bias(solution.estimate.positions, true, removed=solution.degree),
        "b_bound_px": accuracy.expected_bias(solution, removed=solution.degree),
        "b_abs_px": accuracy.bias(solution.estimate.positions, true, removed="similarity"),
        "b_abs_err_px": accuracy.expected_bias(solution, removed="similarity", absolute=True),
        "sigma_new_px": float(np.sqrt(np.mean(measured[good] ** 2))),
        "sigma_new_expected_px": float(np.sqrt(np.mean(expected[good] ** 2))),
    }


def nearest(positions, candidates):
    """The candidate (n, 2) that belongs to every position, a common shift of some pixels allowed for."""
    tree, shift = cKDTree(candidates), np.zeros(2)
    good = np.isfinite(positions).all(axis=1)
    index = np.zeros(len(positions), dtype=int)
    for _ in range(20):
        index[good] = tree.query(positions[good] - shift)[1]
        shift = np.median(positions[good] - candidates[index[good]], axis=0)
    return candidates[index]
