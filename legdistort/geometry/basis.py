"""Normalised two-dimensional Legendre basis of fixed total degree.

Mode ``m = l(l+1)/2 + k`` with ``0 <= k <= l <= degree`` is
``b_m(u, v) = L_{l-k}(u) L_k(v)``, where ``L_n = P_n sqrt((2n+1)/2)`` has unit
norm on [-1, 1] (Bernard et al. 2017, section 2.1). The coordinates ``(u, v)``
are those of the detector: a detector of n pixels spans -0.5 ... n-0.5, which
is mapped on [-1, 1].
"""

from functools import lru_cache
from numbers import Real

import numpy as np

from ..exceptions import InputError

MAX_DEGREE = 30


def n_modes(degree):
    """Number of modes up to a total degree, ``(d+1)(d+2)/2``."""
    return (degree + 1) * (degree + 2) // 2


def degree_of(n):
    """Total degree whose number of modes is `n`.

    Raises
    ------
    InputError
        If `n` is not a triangular number.
    """
    degree = (int(np.sqrt(8 * max(n, 0) + 1)) - 3) // 2
    if degree < 0 or n_modes(degree) != n:
        raise InputError(
            f"n = {n} is not a number of modes: a total degree d has (d+1)(d+2)/2 = 1, 3, 6, 10, 15, ... of them"
        )
    return degree


def check_degree(degree, name="degree"):
    """Return `degree` as int, or raise `InputError` naming the argument."""
    if isinstance(degree, bool) or not isinstance(degree, Real) or degree not in range(MAX_DEGREE + 1):
        raise InputError(f"{name} must be an integer from 0 to {MAX_DEGREE}, got {degree!r}")
    return int(degree)


@lru_cache
def orders(degree):
    """Orders ``(l-k, k)`` in x and y of every mode, as two read-only int arrays (n_modes,)."""
    out = np.array([(total - k, k) for total in range(degree + 1) for k in range(total + 1)], dtype=int).T
    out.setflags(write=False)
    return out[0], out[1]


def norm(n):
    """Factor ``sqrt((2n+1)/2)`` between the normalised L_n and the usual P_n."""
    return np.sqrt((2 * np.asarray(n) + 1) / 2)


@lru_cache
def _scales(degree, dimensions):
    """Of all polynomials up to a degree, `norm`, to multiply arrays of so many dimensions more; read-only."""
    out = norm(np.arange(degree + 1)).reshape(-1, *[1] * dimensions)
    out.setflags(write=False)
    return out


def legendre(degree, u, derivative=False):
    """Normalised Legendre polynomials of one variable.

    Parameters
    ----------
    degree : int
        Highest degree.
    u : array_like, shape (...)
        Coordinates; [-1, 1] is the detector, beyond it the polynomials are extrapolated.
    derivative : bool
        Also return the derivatives with respect to `u`.

    Returns
    -------
    values : ndarray, shape (degree + 1, ...)
    derivatives : ndarray, shape (degree + 1, ...)
        Only if `derivative` is true.
    """
    u = np.asarray(u, dtype=float)
    p = np.empty((degree + 1, *u.shape))
    p[0] = 1.0
    if degree:
        p[1] = u
    for n in range(1, degree):
        # (n+1) P_{n+1} = (2n+1) u P_n - n P_{n-1}
        following = np.multiply(u, p[n], out=p[n + 1, ...])
        following *= (2 * n + 1) / (n + 1)
        following -= n / (n + 1) * p[n - 1]
    scale = _scales(degree, u.ndim)
    if not derivative:
        p *= scale
        return p
    d = np.zeros_like(p)
    for n in range(degree):
        # P'_{n+1} = P'_{n-1} + (2n+1) P_n
        np.multiply(p[n], 2 * n + 1, out=d[n + 1, ...])
        if n:
            d[n + 1] += d[n - 1]
    p *= scale
    d *= scale
    return p, d


def values(degree, u, v):
    """Basis values ``b_m(u, v)``.

    Parameters
    ----------
    degree : int
        Total degree.
    u, v : array_like, shape (...)
        Normalised coordinates (see `normalize`).

    Returns
    -------
    ndarray, shape (n_modes, ...)
    """
    ix, iy = orders(degree)
    return legendre(degree, u)[ix] * legendre(degree, v)[iy]


def gradients(degree, u, v):
    """Basis values and their derivatives with respect to `u` and `v`.

    Returns
    -------
    b, db_du, db_dv : ndarray, each of shape (n_modes, ...)
    """
    ix, iy = orders(degree)
    pu, du = legendre(degree, u, derivative=True)
    pv, dv = legendre(degree, v, derivative=True)
    pu_, pv_ = pu[ix], pv[iy]
    return pu_ * pv_, du[ix] * pv_, pu_ * dv[iy]


def normalize(xy, shape):
    """Pixels of a detector -> normalised coordinates.

    Parameters
    ----------
    xy : array_like, shape (..., 2)
        0-based pixel coordinates, x (column) first.
    shape : tuple of int
        ``(ny, nx)`` of the detector.

    Returns
    -------
    u, v : ndarray, shape (...)
    """
    xy = np.asarray(xy, dtype=float)
    ny, nx = shape
    return (2 * xy[..., 0] + 1) / nx - 1, (2 * xy[..., 1] + 1) / ny - 1


def denormalize(u, v, shape):
    """Normalised coordinates -> pixels (..., 2); the inverse of `normalize`."""
    ny, nx = shape
    return np.stack([((np.asarray(u) + 1) * nx - 1) / 2, ((np.asarray(v) + 1) * ny - 1) / 2], axis=-1)


def to_tensor(coefficients):
    """Normalised total-degree coefficients -> square array of un-normalised P_i P_j.

    Parameters
    ----------
    coefficients : array_like, shape (..., n_modes)

    Returns
    -------
    ndarray, shape (..., degree + 1, degree + 1)
        ``c[i, j]`` multiplies ``P_i(u) P_j(v)`` as in `astropy.modeling.models.Legendre2D`
        and `numpy.polynomial.legendre.legval2d`; zero where ``i + j > degree``.
    """
    coefficients = np.asarray(coefficients, dtype=float)
    degree = degree_of(coefficients.shape[-1])
    ix, iy = orders(degree)
    out = np.zeros((*coefficients.shape[:-1], degree + 1, degree + 1))
    out[..., ix, iy] = coefficients * norm(ix) * norm(iy)
    return out


def from_tensor(tensor, degree=None):
    """Inverse of `to_tensor`: square array of P_i P_j -> normalised coefficients.

    Parameters
    ----------
    tensor : array_like, shape (..., n, n)
    degree : int, optional
        Total degree kept; the default is ``n - 1``.

    Raises
    ------
    InputError
        If a coefficient of higher total degree is not zero and would be lost.
    """
    tensor = np.asarray(tensor, dtype=float)
    n = tensor.shape[-1]
    degree = n - 1 if degree is None else degree
    i, j = np.indices((n, n))
    lost = tensor[..., i + j > degree]
    if np.any(lost != 0):
        raise InputError(
            f"the tensor has terms of total degree above {degree} (largest coefficient {np.abs(lost).max():.3g}); "
            f"give degree={2 * (n - 1)} to keep them all"
        )
    padded = np.zeros((*tensor.shape[:-2], max(n, degree + 1), max(n, degree + 1)))
    padded[..., :n, :n] = tensor
    ix, iy = orders(degree)
    return padded[..., ix, iy] / (norm(ix) * norm(iy))


def change_degree(coefficients, degree):
    """Coefficients (..., n_modes) padded with zeros or cut to another total degree.

    The order of modes is by total degree, so this is a cut of the last axis.
    """
    kept = np.asarray(coefficients, dtype=float)[..., : n_modes(degree)]
    return np.pad(kept, [(0, 0)] * (kept.ndim - 1) + [(0, n_modes(degree) - kept.shape[-1])])


@lru_cache
def quadrature(degree):
    """Gauss-Legendre nodes exact for products of two polynomials of this degree.

    Returns
    -------
    u, v, weights : ndarray, each of shape ((degree + 1)**2,)
    """
    x, w = np.polynomial.legendre.leggauss(degree + 1)
    u, v = np.meshgrid(x, x)
    out = u.ravel(), v.ravel(), np.outer(w, w).ravel()
    for a in out:
        a.setflags(write=False)
    return out


def project(function, degree, n_nodes=None):
    """Coefficients of the best approximation of a function on the detector (least squares).

    Parameters
    ----------
    function : callable
        ``function(u, v)`` on flat arrays (n,), returning (..., n).
    degree : int
        Total degree of the approximation.
    n_nodes : int, optional
        Nodes per axis of the quadrature; default exact for polynomials of this degree.

    Returns
    -------
    ndarray, shape (..., n_modes)
    """
    u, v, w = quadrature(degree if n_nodes is None else n_nodes - 1)
    return np.asarray(function(u, v)) * w @ values(degree, u, v).T
