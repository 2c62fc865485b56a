"""Stars eliminated from the normal equations: couplings, Schur complement and its factors."""

import numpy as np


def inverse_star_blocks(v):
    """Inverse (3, n_stars) of symmetric 2 x 2 blocks; zero for a star without observations."""
    determinant = v[0] * v[1] - v[2] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.stack([v[1], v[0], -v[2]]) / determinant
    out[:, determinant <= 0] = 0
    return out


def symmetric_times(block, x):
    """Symmetric 2 x 2 blocks (3, n) times vectors (2, n)."""
    return np.stack([block[0] * x[0] + block[2] * x[1], block[2] * x[0] + block[1] * x[1]])


def to_stars(problem, blocks, a):
    """E a: coefficients (n_exposures, 2 n_modes) -> stars (2, n_stars)."""
    if problem.uses_compiled_loops:
        from . import compiled

        return compiled.to_stars(problem, blocks, a)
    out = np.zeros((2, problem.n_stars))
    n_modes = problem.n_modes
    for i in range(problem.n_exposures):
        part = problem.part(i)
        t = a[i].reshape(2, n_modes) @ blocks.values[:, part]
        f = blocks.coupling[:, :, part]
        out[:, problem.star[part]] += f[:, 0] * t[0] + f[:, 1] * t[1]
    return out


def to_exposures(problem, blocks, y):
    """E' y: stars (2, n_stars) -> coefficients (n_exposures, 2 n_modes)."""
    if problem.uses_compiled_loops:
        from . import compiled

        return compiled.to_exposures(problem, blocks, y)
    out = np.empty((problem.n_exposures, 2 * problem.n_modes))
    for i in range(problem.n_exposures):
        part = problem.part(i)
        z, f = y[:, problem.star[part]], blocks.coupling[:, :, part]
        out[i] = ((f[0] * z[0] + f[1] * z[1]) @ blocks.values[:, part].T).ravel()
    return out


def reduced_matrix(problem, blocks):
    """Schur complement ``S = U - E' V^-1 E`` with the stars eliminated, shape (n_unknowns, n_unknowns).

    The product is taken over blocks of stars, each a dense matrix product.
    """
    unknowns = blocks.unknowns
    out = unknowns.matrix(blocks.u)
    for factor in star_factors(problem, blocks):
        factor = unknowns.gather(factor.reshape(*blocks.g_exposure.shape, -1))
        out -= factor @ factor.T
    return out


def star_roots(inverse):
    """L of ``L L' = V^-1``, lower triangles: l00, l10, l11, each (n_stars,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        l00 = np.sqrt(inverse[0])
        l10 = np.where(l00 > 0, inverse[2] / l00, 0)
        return l00, l10, np.sqrt(np.maximum(inverse[1] - l10**2, 0))


def star_factors(problem, blocks, *, n_block=512):
    """Yield ``E' L`` for blocks of stars, with ``L L' = V^-1``: arrays (n_unknowns, 2 n_block)."""
    size = 2 * problem.n_modes
    l00, l10, l11 = star_roots(inverse_star_blocks(blocks.v))
    for first in range(0, problem.n_stars, n_block):
        last = min(first + n_block, problem.n_stars)
        factor = np.zeros((problem.n_exposures * size, 2, last - first))
        for i in range(problem.n_exposures):
            lo, hi = problem.start[i] + np.searchsorted(problem.star[problem.part(i)], [first, last])
            star, f, b = problem.star[lo:hi], blocks.coupling[:, :, lo:hi], blocks.values[:, lo:hi]
            column = [f[0] * l00[star] + f[1] * l10[star], f[1] * l11[star]]  # each (axis, n)
            for k in (0, 1):
                factor[i * size : (i + 1) * size, k, star - first] = (column[k][:, None, :] * b).reshape(size, -1)
        yield factor.reshape(len(factor), -1)
