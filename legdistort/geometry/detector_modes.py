"""Similarities of a detector, and all other modes, as Legendre coefficients."""

from functools import lru_cache

import numpy as np

from . import basis, similarity


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


def row_variances(rows, sigma):
    """Variances (..., k) of rows (..., k, n) of coefficients with widths (..., n); infinite where one of these is."""
    sigma = sigma[..., None]
    infinite, known = (rows != 0) @ np.isinf(sigma), rows**2 @ np.where(np.isinf(sigma), 0, sigma) ** 2
    return np.where(infinite, np.inf, known)[..., 0]


def similarity_part(coefficients, shape):
    """The similarity closest to ``q + A b(q)``, as a pose (..., 2, 3) in the detector's pixels.

    Parameters
    ----------
    coefficients : ndarray, shape (..., 2, n_modes)
    shape : tuple
        ``(ny, nx)`` of the detector.
    """
    *several, _, n = coefficients.shape
    flat = coefficients.reshape(*several, 2 * n)
    return np.eye(2, 3) + (flat @ similarity_poses(shape, n).T).reshape(*several, 2, 3)


def pointed(static, shape):
    """Coefficients of the same map after a similarity, as a pose has it, so that they have no part of one."""
    degree = basis.degree_of(static.shape[1])
    for _ in range(3):
        back = similarity.invert(similarity_part(static, shape))

        def displacement(u, v, static=static, back=back):
            there = basis.denormalize(u, v, shape)
            q = similarity.apply(back, there)
            return (q - there).T + static @ basis.values(degree, *basis.normalize(q, shape))

        static = basis.project(displacement, degree)
    return static


def similarity_poses(shape, n):
    """What the similarity part of coefficients adds to the pose that changes nothing, as a matrix (6, 2 * n_modes).

    Read-only.
    """
    return _poses(*map(float, shape), n)


@lru_cache
def _poses(ny, nx, n):
    rows = _similarities(ny, nx, n)
    poses = np.zeros((len(rows), 2, 3))
    poses[0, 0, 2] = poses[1, 1, 2] = 1 / 2  # b_0 = 1/2
    if n >= 3:  # scale and rotation about the middle: L_1(u) L_0 = sqrt(3)/2 u, and u = (2 x + 1) / nx - 1
        poses[2, 0, 0] = poses[2, 1, 1] = poses[3, 1, 0] = np.sqrt(3) / np.hypot(nx, ny)
        poses[3, 0, 1] = -poses[3, 1, 0]
        poses[2:, :, 2] = -poses[2:, :, :2] @ [(nx - 1) / 2, (ny - 1) / 2]
    return _kept(poses.reshape(len(rows), 6).T @ rows)


def detector_corners(shapes):
    """Corners (n, 4, 2) of detectors (ny, nx), a list of n, pixels."""
    return np.array(shapes)[:, None, ::-1] * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - 0.5


def pose_departures(poses, given, shapes):
    """Coefficients (n, 4) of `similarity_basis` that amount to poses (n, 2, 3) beside given ones of the same parity.

    Shifts are those of the middle of every detector, `shapes` a list of (ny, nx); of scale and rotation the logarithm
    is taken, so that what is turned by much has not shrunk.
    """
    apart = similarity.compose(poses, similarity.invert(given))
    size = np.array(shapes, dtype=float)[:, ::-1]
    middle = (size - 1) / 2
    shift = np.einsum("iab,ib->ia", apart[:, :, :2], middle) + apart[:, :, 2] - middle
    turn = np.log(apart[:, 0, 0] + 1j * apart[:, 1, 0])
    return np.column_stack([2 * shift, *(np.stack([turn.real, turn.imag]) * _of_turns(size))])


def pose_widths(errors, shapes):
    """Standard deviations (n, 4) of `pose_departures` for errors of shift [px], rotation [deg] and scale."""
    shift, rotation, scale = errors
    turns = _of_turns(np.array(shapes, dtype=float))
    return np.column_stack([np.full((len(turns), 2), 2.0 * shift), scale * turns, np.radians(rotation) * turns])


def affine_widths(errors, shape):
    """Standard deviations (2, 3) of the modes of orders 0 and 1 of a detector (ny, nx) for errors of an affine map.

    Of its shift [px], its rotation [deg], and its scale, one along each axis; rotation and scale count as independent
    along the axes, so that shears are as large.
    """
    shift, rotation, scale = errors
    across, along = (np.array(shape, dtype=float) / np.sqrt(3)).tolist()
    turn = np.radians(rotation)
    return np.array([[2 * shift, scale * along, turn * across], [2 * shift, turn * along, scale * across]])


def _of_turns(size):
    """Coefficients (n,) of a rotation by 1 rad, or of twice the scale, over detectors of some sizes (n, 2)."""
    return np.hypot(*size.T) / np.sqrt(3)
