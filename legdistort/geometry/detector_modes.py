"""Similarities of a detector, and all other modes, as Legendre coefficients."""

from functools import lru_cache

import numpy as np

from . import basis


def similarity_basis(shape, n):
    """Orthonormal coefficient vectors of the similarities of a detector, shape (4 or 2, 2 * n_modes).

    Shift in x and y, scale, rotation, as displacement fields; only the shifts if there are no linear modes. Read-only.
    """
    return _similarities(*map(float, shape), n)


@lru_cache
def _similarities(ny, nx, n):
    rows = np.zeros((2 if n < 3 else 4, 2, n))
    rows[0, 0, 0] = rows[1, 1, 0] = 1
    if n >= 3:  # x = nx/2 u, and u = L_1(u) L_0 2/sqrt(3): modes 1 (along x) and 2 (along y)
        rows[2, 0, 1], rows[2, 1, 2] = nx, ny
        rows[3, 0, 2], rows[3, 1, 1] = -ny, nx
    rows = rows.reshape(len(rows), -1)
    return _kept(rows / np.linalg.norm(rows, axis=1)[:, None])


def dynamic_basis(shape, n):
    """Orthonormal coefficient vectors of all but the similarities, shape (2 * n_modes - 4 or - 2, 2 * n_modes).

    Two shears first, then the modes of degree 2 and more as they are, x before y. Read-only.
    """
    return _others(*map(float, shape), n)


@lru_cache
def _others(ny, nx, n):
    if n < 3:
        return _kept(np.zeros((0, 2 * n)))
    shears = np.zeros((2, 2, n))
    shears[0, 0, 1], shears[0, 1, 2] = ny, -nx
    shears[1, 0, 2], shears[1, 1, 1] = nx, ny
    shears = shears.reshape(2, -1) / np.hypot(nx, ny)
    unit = np.eye(2 * n).reshape(2 * n, 2, n)
    return _kept(np.concatenate([shears, unit[np.r_[3:n, n + 3 : 2 * n]].reshape(-1, 2 * n)]))


def _kept(rows):
    rows.setflags(write=False)
    return rows


def dynamic_degrees(n):
    """Degree of every row of `dynamic_basis`, shape (2 * n_modes - 4,)."""
    degrees = np.add(*basis.orders(basis.degree_of(n)))[3:]
    return np.concatenate([[1, 1], degrees, degrees]) if n >= 3 else np.zeros(0, dtype=int)


def similarity_part(coefficients, shapes):
    """The similarity closest to ``q + A b(q)``, as a pose (..., 2, 3) in the detector's pixels.

    Parameters
    ----------
    coefficients : ndarray, shape (..., 2, n_modes)
    shapes : tuple, or list of tuples
        ``(ny, nx)``; one for all, or one for each.
    """
    size = np.broadcast_to(np.array(shapes)[..., ::-1], (*coefficients.shape[:-2], 2)).astype(float)  # nx, ny
    pose = np.zeros((*coefficients.shape[:-1], 3))
    pose[..., 0, 0] = pose[..., 1, 1] = 1
    pose[..., 2] = coefficients[..., 0] / 2  # b_0 = 1/2
    if coefficients.shape[-1] >= 3:
        # scale and rotation per pixel: coefficients s nx/sqrt(3), s ny/sqrt(3) in modes 1 (x) and 2 (y), by projection
        (xx, xy), (yx, yy) = np.moveaxis(coefficients[..., 1:3], (-2, -1), (0, 1))
        nx, ny = np.moveaxis(size, -1, 0)
        norm = np.sqrt(3) / (nx**2 + ny**2)
        scale, turn = (nx * xx + ny * yy) * norm, (nx * yx - ny * xy) * norm
        pose[..., 0, 0] += scale
        pose[..., 1, 1] += scale
        pose[..., 0, 1], pose[..., 1, 0] = -turn, turn
        middle = (size - 1) / 2
        pose[..., 0, 2] -= scale * middle[..., 0] - turn * middle[..., 1]
        pose[..., 1, 2] -= turn * middle[..., 0] + scale * middle[..., 1]
    return pose
