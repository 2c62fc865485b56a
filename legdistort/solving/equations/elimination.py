"""Stars eliminated from the normal equations: couplings, Schur complement and its factors."""

import numpy as np
from scipy.linalg.blas import dsyrk

from .star_terms import outer_packed, packed, size_of, symmetric_times

#: Curvature of an unknown, the others fitted, below this part of its own is rounding: it is not determined.
_ROUNDING = 1e-8
#: Times the typical error of a position: one beyond it tells nothing of the plane.
FAR = 10.0
_TILE = 256  # of a matrix that is mirrored


def inverse_star_blocks(v):
    """Inverse of symmetric packed blocks (m, n_stars); zero for what the observations of a star do not determine."""
    return _inverted(v)[0]


def typical_stars(v):
    """Which stars (n_stars,) have positions with errors below `FAR` typical ones, from packed blocks (m, n_stars).

    Others, seen once and moving, may lie anywhere; means over the stars are those of these.
    """
    variance = inverse_star_blocks(v)[:2].sum(axis=0)
    known = variance > 0
    return known & (variance < FAR**2 * np.median(variance[known])) if known.any() else known


def of_one_axis(u):
    """Blocks (n_exposures, n_modes, n_modes) of one axis of the given ones (n_exposures, 2 n_modes, 2 n_modes).

    Where both axes weigh the same and do not hang together; else the given ones.
    """
    n = u.shape[1] // 2
    xx, yy = u[:, :n, :n], u[:, n:, n:]
    return u if u[:, :n, n:].any() or not np.array_equal(xx, yy) else xx


def inverse_exposure_blocks(u):
    """Inverses of blocks (n_exposures, 2 n_modes, 2 n_modes); where both axes weigh the same, that of one is enough."""
    one, n = of_one_axis(u), u.shape[1] // 2
    if one is u:
        return np.linalg.inv(u)
    out = np.zeros_like(u)
    out[:, :n, :n] = out[:, n:, n:] = np.linalg.inv(one)
    return out


def star_roots(v):
    """L of ``L L' = V^-1``, (2 + k, 2 + k, n_stars), from the blocks V."""
    inverse, columns = _inverted(v)
    out = np.zeros((size_of(v), size_of(v), v.shape[1]))
    position = inverse if not columns else _inverse_of_positions(v)
    with np.errstate(divide="ignore", invalid="ignore"):
        out[0, 0] = np.sqrt(position[0])
        out[1, 0] = np.where(out[0, 0] > 0, position[2] / out[0, 0], 0)
        out[1, 1] = np.sqrt(np.maximum(position[1] - out[1, 0] ** 2, 0))
    for column in columns:
        out[: len(column), len(column) - 1] = column
    return out


def _inverse_of_positions(v):
    determinant = v[0] * v[1] - v[2] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.stack([v[1], v[0], -v[2]]) / determinant
    out[:, determinant <= 0] = 0
    return out


def _inverted(v):
    """Inverse of packed blocks, and what each unknown after the position adds to it: columns c of ``c c'``.

    A block A is bordered by one unknown after another, ``[A b; b' d]^-1 = [A^-1 0; 0 0] + c c'`` with
    ``c = (-A^-1 b, 1) / sqrt(d - b' A^-1 b)``. What is not determined given those before is held where it is.
    """
    out, columns = _inverse_of_positions(v), []
    for k in range(2, size_of(v)):
        first = k * (k + 1) // 2
        b, d = v[first : first + k], v[first + k]
        moved = symmetric_times(out, b)
        left = d - (b * moved).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.where(left > _ROUNDING * d, 1 / np.sqrt(left), 0.0)
        column = np.concatenate([-moved, np.ones((1, len(d)))]) * unit
        out = np.concatenate([out, np.zeros((k + 1, len(d)))]) + outer_packed(column)
        columns.append(column)
    return out, columns


def star_freedom(problem, blocks):
    """Number of star unknowns that the observations determine, what is known of them beforehand counted out."""
    inverse, places = inverse_star_blocks(blocks.v), np.diag(packed(problem.n_star))
    number = 2 * int(np.count_nonzero(blocks.v[0] > 0))
    return number + np.count_nonzero(inverse[places[2:]] > 0) - problem.terms.done_by_prior(inverse)


def to_stars(problem, blocks, a):
    """E a: coefficients (n_exposures, 2 n_modes) -> stars (2 + k, n_stars)."""
    if problem.uses_compiled_loops:
        from . import compiled

        return compiled.to_stars(problem, blocks, a)
    t, f = np.empty_like(problem.xy), blocks.coupling
    for i, each in enumerate(a.reshape(problem.n_exposures, 2, -1)):
        part = problem.part(i)
        np.matmul(each, blocks.values[:, part], out=t[:, part])
    return problem.by_star(problem.pulled(f[:, 0] * t[0] + f[:, 1] * t[1]))


def to_exposures(problem, blocks, y):
    """E' y: stars (2 + k, n_stars) -> coefficients (n_exposures, 2 n_modes)."""
    if problem.uses_compiled_loops:
        from . import compiled

        return compiled.to_exposures(problem, blocks, y)
    z, f = problem.placed(y), blocks.coupling
    return problem.by_exposure(f[0] * z[0] + f[1] * z[1], blocks.values).reshape(problem.n_exposures, -1)


def reduced_matrix(problem, blocks):
    """Schur complement ``S = U - E' V^-1 E`` with the stars eliminated, shape (n_unknowns, n_unknowns)."""
    return mirrored(reduced_triangle(problem, blocks))


def reduced_triangle(problem, blocks):
    """The lower triangle of the Schur complement; what is above it means nothing.

    The product is taken over blocks of stars, each a dense matrix product.
    """
    unknowns = blocks.unknowns
    out = unknowns.matrix(blocks.u).T
    for factor in star_factors(problem, blocks):
        factor = unknowns.gather(factor.reshape(*blocks.g_exposure.shape, -1))
        out = dsyrk(-1.0, factor, beta=1.0, c=out, lower=1, overwrite_c=1)
    return out


def mirrored(matrix):
    """The symmetric matrix (n, n) that the lower triangle of a matrix stands for; takes its place."""
    for i in range(0, len(matrix), _TILE):
        part = slice(i, i + _TILE)
        matrix[part, i + _TILE :] = matrix[i + _TILE :, part].T
        matrix[part, part] = np.tril(matrix[part, part]) + np.tril(matrix[part, part], -1).T
    return matrix


def star_factors(problem, blocks, *, n_block=512):
    """Yield ``E' L`` for blocks of stars, with ``L L' = V^-1``: arrays (n_unknowns, (2 + k) n_block), by columns."""
    n_exposures, size, roots = problem.n_exposures, 2 * problem.n_modes, star_roots(blocks.v)
    for first, rows in _blocks_of_stars(problem, n_block):
        star, f, b = problem.star[rows], blocks.coupling[:, :, rows], blocks.values[:, rows]
        z = problem.placed_at(problem.exposure[rows], roots[:, :, star])
        place = (star - first) * n_exposures + problem.exposure[rows]
        factor = np.zeros((problem.n_star, min(n_block, problem.n_stars - first) * n_exposures, size))
        for k, each in enumerate(factor):
            column = f[0] * z[0, k] + f[1] * z[1, k]  # (axis, n)
            each[place] = (column[:, None] * b).reshape(size, -1).T
        yield factor.reshape(-1, n_exposures * size).T


def _blocks_of_stars(problem, n_block):
    """Yield the first of so many stars, and the observations of these."""
    if problem.n_stars <= n_block:
        yield 0, slice(None)
        return
    order = np.argsort(problem.star, kind="stable")
    first = np.arange(0, problem.n_stars, n_block)
    yield from zip(first, np.split(order, np.searchsorted(problem.star[order], first[1:])), strict=True)
