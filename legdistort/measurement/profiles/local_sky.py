"""The sky under single stars: slopes of the light of halos, which a constant background would turn into shifts."""

import numpy as np

_CHANCE = 6.0  # chi2 of a slope, which noise exceeds in 5 % of the stars
_CHUNK = 300  # stars: their derivatives stay in the processor's cache


def slopes(left, weights, covariance, derivatives):
    """Planes that are 0 in the middle of every stamp (the level is a parameter of the fit).

    Fitted together with the parameters of the stars, linearised where these have settled: what the stars have taken
    up of a slope counts for it. Shrunk towards a flat sky, on which free slopes would cost 2 % of the precision of a
    position.

    Parameters
    ----------
    left : ndarray, shape (n, npix)
        What fits leave of square stamps.
    weights : ndarray, shape (n, npix)
        Inverse variances; 0 for pixels that do not count.
    covariance : ndarray, shape (n, k, k)
        Of the parameters.
    derivatives : callable
        ``derivatives(rows)``: of the models of some stars by their parameters, (m, k, npix).

    Returns
    -------
    ndarray, shape (n, npix)
    """
    half = round(np.sqrt(left.shape[1])) // 2
    grid = np.mgrid[-half : half + 1, -half : half + 1][::-1].reshape(2, -1).astype(left.dtype)
    squares = (grid[:, None] * grid).reshape(4, -1)
    out = np.zeros_like(left)
    for i in range(0, len(left), _CHUNK):
        rows = slice(i, i + _CHUNK)
        by = derivatives(rows) * weights[rows, None]
        shared = (by @ grid.T).astype(float)  # (m, k, 2)
        taken = covariance[rows] @ shared
        normal = (weights[rows] @ squares.T).reshape(-1, 2, 2) - shared.swapaxes(1, 2) @ taken
        right = (weights[rows] * left[rows]) @ grid.T - (left[rows, None] @ by.swapaxes(1, 2) @ taken)[:, 0]
        told = np.linalg.det(normal) > 1e-6 * np.einsum("nii->n", normal) ** 2
        slope = np.zeros_like(right)
        slope[told] = np.linalg.solve(normal[told], right[told, :, None])[..., 0]
        significance = np.maximum((slope * right).sum(axis=1), 1e-9)
        out[rows] = (np.maximum(1 - _CHANCE / significance, 0)[:, None] * slope) @ grid
    return out
