"""Values of exposures from those of pairs: their differences wherever two of them see the same."""

import numpy as np
from scipy.sparse.csgraph import connected_components


def median_differences(samples):
    """Median differences of all pairs of rows, and how many values they are of.

    Parameters
    ----------
    samples : ndarray, shape (n, k)
        One row an exposure; NaN where it has no value.

    Returns
    -------
    difference, count : ndarray, shape (n, n)
        Zero where two rows share nothing.
    """
    n = len(samples)
    difference, count = np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            d = samples[i] - samples[j]
            d = d[np.isfinite(d)]
            if d.size:
                difference[i, j], count[i, j] = np.median(d), d.size
    return difference - difference.T, count + count.T


def values_from_differences(difference, weight, own):
    """Values whose differences are those of pairs, by weighted least squares.

    Parameters
    ----------
    difference, weight : ndarray, shape (n, n)
        Antisymmetric; symmetric, zero where nothing is known.
    own : ndarray, shape (n,)
        Values whose means those that pairs connect keep.

    Returns
    -------
    ndarray, shape (n,)
    """
    laplacian = np.diag(weight.sum(axis=1)) - weight
    values = np.linalg.lstsq(laplacian, (weight * difference).sum(axis=1), rcond=1e-12)[0]
    _, group = connected_components(weight > 0, directed=False)
    for g in np.unique(group):
        values[group == g] += (own - values)[group == g].mean()
    return values
