"""How much of an observation its own fit takes up."""

import numpy as np

from . import elimination


def leverages(problem, blocks, *, at=None, rows=slice(None)):
    """Parts of the variance of observations that the position of their star and their exposure take up, each alone.

    Mean of the axes. In a two-way table of means ``(1 - star) (1 - exposure)`` of the variance is left.

    Parameters
    ----------
    problem : Problem
        With the weights of the observations themselves.
    blocks : Blocks
        Of the fit.
    at : Blocks, optional
        With the weights of the problem, if those of the fit are others.
    rows : ndarray of int or slice
        Which observations, ascending; all if not given.

    Returns
    -------
    star, exposure : ndarray, shape (n,)
        0 for an observation without weight.
    """
    full = blocks if at is None else at
    every, n_modes = np.arange(problem.xy.shape[1])[rows], problem.n_modes
    all_rows = len(every) == problem.xy.shape[1]
    of_star, of_exposure = np.zeros((2, len(every)))
    stars = elimination.inverse_star_blocks(blocks.v)
    exposures = problem.unknowns.conditional_covariances(blocks.u).reshape(-1, 2, n_modes, 2, n_modes)
    for i, (low, high) in enumerate(np.searchsorted(every, np.stack([problem.start[:-1], problem.start[1:]], axis=1))):
        mine = slice(low, high) if all_rows else every[low:high]  # a slice copies nothing
        w, f, b = problem.weight[:, mine], full.coupling[:, :, mine], full.values[:, mine]
        s = problem.terms.place_covariance(i, stars[:, problem.star[mine]])
        covariances = exposures[i, 0, :, 0], exposures[i, 1, :, 1]
        alike = np.array_equal(*covariances)
        for k, covariance in enumerate(covariances):
            share = f[0, k] ** 2 * s[0] + f[1, k] ** 2 * s[1] + 2 * f[0, k] * f[1, k] * s[2]
            of_star[low:high] += np.divide(share, w[k], out=np.zeros(high - low), where=w[k] > 0) / 2
            if k == 0 or not alike:
                variance = np.einsum("mn,mn->n", covariance.astype(b.dtype) @ b, b)
            of_exposure[low:high] += variance * w[k] / 2
    return of_star, of_exposure
