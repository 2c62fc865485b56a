"""The weighted least-squares criterion J: residuals, derivatives and normal blocks. It is independent of the solver.

``J = sum_ij r_ij' W_ij r_ij`` over residuals ``r = x_data - D_i(X_j)`` in detector pixels
(Bernard et al. 2017, eq. of section 3.1, per axis and with correlated errors), plus Gaussian priors on the
coefficients. With ``q = T_i(X)``, ``G = I + A grad b`` and ``J_ij = G R_i`` (2, 2), an observation
contributes to the normal equations::

    V_j  += J' W J           star block (2, 2)
    U_i  += W (x) b b'       exposure block (2 n_modes, 2 n_modes)
    E_ij  = (J' W) (x) b     coupling, kept as its factors F = J' W and b

Where stars move, by Phi (2, 2 + k) from their unknowns to their place in exposure i, they become Phi' V Phi and
Phi' E (`legdistort.solving.equations.star_terms`).

Arrays are ordered by exposure, coordinates first, so that every sweep reads memory once and in order.
"""

from dataclasses import dataclass

import numpy as np

from ...geometry import basis, detector_modes
from .star_terms import symmetric_times

#: Weight on steps along directions that are fixed, relative to that of the data.
_HOLD = 1e4
#: Smallest uncertainty of a static distortion that takes part in a fit, pixels.


@dataclass(frozen=True, eq=False)
class Blocks:
    """J and its normal equations at one state.

    Attributes
    ----------
    chi2 : float
        Data part of J.
    penalty : float
        Prior part of J.
    residual : ndarray, shape (2, n)
    v : ndarray, shape (m, n_stars)
        Star blocks, packed: xx, yy, xy, and what further terms add (`legdistort.solving.equations.star_terms.packed`).
    g_star : ndarray, shape (2 + k, n_stars)
    u : ndarray, shape (n_exposures, 2 n_modes, 2 n_modes)
        Exposure blocks with the prior, x modes first.
    u_data : ndarray
        The same without the prior.
    g_exposure : ndarray, shape (n_exposures, 2 n_modes)
    coupling : ndarray, shape (2, 2, n)
        F = J' W, coordinate of the star's place in that exposure first.
    values : ndarray, shape (n_modes, n)
        Basis at every observation.
    unknowns : Unknowns
        The tangents at this state.
    stars : ndarray, shape (2 + k, n_stars)
        Unknowns of the stars at this state.
    held : float
        Part of J by what is known beforehand of the stars and the poses.
    """

    chi2: float
    penalty: float
    residual: np.ndarray
    v: np.ndarray
    g_star: np.ndarray
    u: np.ndarray
    u_data: np.ndarray
    g_exposure: np.ndarray
    coupling: np.ndarray
    values: np.ndarray
    unknowns: object
    stars: np.ndarray
    held: float = 0.0

    @property
    def cost(self):
        """J: data and prior."""
        return self.chi2 + self.penalty + self.held


def prior_precision(problem, i):
    """Inverse prior covariance (2 n_modes, 2 n_modes) of exposure i; none along its similarities and what is fixed.

    A similarity of the coefficients is a change of the pose, which has no prior.
    """
    n = 2 * problem.n_modes
    out = np.zeros((n, n))
    if problem.unknowns.shared and problem.static_covariance is not None:
        out = problem.unknowns.common_precision(problem.static_covariance)[i]
    if not problem.has_widths(i):
        return out
    sigma = np.minimum(problem.prior_sigma[i].ravel(), 1e6)  # infinity stands for free
    others = detector_modes.dynamic_basis(problem.shapes[i], problem.n_modes)
    others = others[np.any((others != 0) & (sigma > 0), axis=1)]
    return out + others.T @ np.linalg.solve(others * sigma**2 @ others.T, others)


def pose_precision(problem):
    """Inverse covariance (n_exposures, 2 n_modes, 2 n_modes) by what is known of poses, distortions aside."""
    similar = np.stack([detector_modes.similarity_basis(shape, problem.n_modes) for shape in problem.shapes])
    return similar.mT / problem.pose_width[:, None] ** 2 @ similar


def complement(rows):
    """Orthonormal rows that span what the orthonormal `rows` (k, n) leave, shape (n - k, n)."""
    return np.linalg.qr(rows.T, mode="complete")[0][:, len(rows) :].T


def predict(problem, state, first=0, last=None):
    """Model positions of the observations of exposures `first` to `last`, with what the normal equations need.

    Returns
    -------
    position : ndarray, shape (2, n)
    values : ndarray, shape (n_all, n)
        Basis values.
    jacobian : ndarray, shape (2, 2, n)
        dD/dX, detector axis first.
    """
    last = problem.n_exposures if last is None else last
    part = slice(problem.start[first], problem.start[last])
    exposure, degree = problem.exposure[part], basis.degree_of(state.coefficients.shape[2])
    xx, xy, x0, yx, yy, y0 = state.poses.reshape(-1, 6).T[:, exposure]
    nx, ny = problem.size.T[:, exposure]
    x, y = problem.placed_at(exposure, state.stars[:, problem.star[part]])
    q = np.stack([xx * x + xy * y + x0, yx * x + yy * y + y0])
    u, v = (2 * q[0] + 1) / nx - 1, (2 * q[1] + 1) / ny - 1
    modes = np.stack(basis.gradients(degree, u, v))
    fields, start = np.empty((3, 2, q.shape[1])), (problem.start[first : last + 1] - part.start).tolist()
    for a, low, high in zip(state.coefficients[first:last], start, start[1:], strict=False):
        np.matmul(a, modes[:, :, low:high], out=fields[:, :, low:high])
    position, values = q + fields[0], modes[0]
    gx, gy = fields[1] * (2 / nx), fields[2] * (2 / ny)  # columns of G - I
    gx[0] += 1
    gy[1] += 1
    return position, values, np.stack([gx * xx + gy * yx, gx * xy + gy * yy], axis=1)


def squares(problem, residual):
    """``r' W r`` of every observation, shape (n,)."""
    w, (x, y) = problem.weight, residual
    return w[0] * x * x + w[1] * y * y + 2 * w[2] * x * y


def linearise(problem, state):
    """J and its normal equations at a state: one pass over the observations."""
    if problem.uses_compiled_loops:
        from . import compiled

        values, coupling, residual, v, g_star, u, g_exposure, chi2 = compiled.linearise(problem, state)
    else:
        values, coupling, residual, v, g_star, u, g_exposure = _sums(problem, state)
        chi2 = float(squares(problem, residual).sum())
    u_data, penalty = u, 0.0
    if problem.has_prior:
        u = u.copy()
        for i, departure in enumerate(problem.departure(state.coefficients)):
            precision = prior_precision(problem, i)
            u[i] += precision
            g_exposure[i] -= precision @ departure
            penalty += float(departure @ precision @ departure)
            if problem.fixed is not None:
                rows = problem.fixed[i]
                u[i] += _HOLD * np.trace(u_data[i]) / len(departure) * rows.T @ rows
                g_exposure[i] -= rows.T @ (rows @ g_exposure[i])
    held = problem.terms.hold(state.stars, v, g_star)
    if problem.pose_width is not None:
        departure, rows = problem.pose_departure(state)
        pulled = departure / problem.pose_width**2
        u, held = u + rows.mT / problem.pose_width[:, None] ** 2 @ rows, held + float((pulled * departure).sum())
        g_exposure = g_exposure - np.einsum("isa,is->ia", rows, pulled)
    tangents = problem.unknowns.at(state.coefficients)
    return Blocks(
        chi2, penalty, residual, v, g_star, u, u_data, g_exposure, coupling, values, tangents, state.stars, held
    )


def _sums(problem, state):
    """The plain twin of `legdistort.solving.equations.compiled.linearise`."""
    n, w, terms = problem.n_modes, problem.weight, problem.terms
    position, values, jac = predict(problem, state)
    b, r = values[:n], problem.xy - position
    f = np.stack([jac[0] * w[0] + jac[1] * w[2], jac[0] * w[2] + jac[1] * w[1]], axis=1)
    m = np.stack([
        f[0, 0] * jac[0, 0] + f[0, 1] * jac[1, 0],
        f[1, 0] * jac[0, 1] + f[1, 1] * jac[1, 1],
        f[0, 0] * jac[0, 1] + f[0, 1] * jac[1, 1],
    ])  # fmt: skip
    v = [m]
    for k, column in enumerate(terms.columns.transpose(2, 1, 0)):
        v.append(problem.pulled(symmetric_times(m, column[:, problem.exposure]))[: 3 + k])
    v = problem.by_star(np.concatenate(v))
    g_star = problem.by_star(problem.pulled(f[:, 0] * r[0] + f[:, 1] * r[1]))
    wr = np.stack([w[0] * r[0] + w[2] * r[1], w[2] * r[0] + w[1] * r[1]])
    g_exposure = problem.by_exposure(wr, b).reshape(problem.n_exposures, -1)
    xx, yy, xy = (problem.by_exposure(b * each, b) if problem.unequal or k == 0 else None for k, each in enumerate(w))
    u = np.zeros((problem.n_exposures, 2 * n, 2 * n))
    u[:, :n, :n] = xx
    u[:, n:, n:] = yy if problem.unequal else xx
    if problem.unequal:
        u[:, :n, n:] = u[:, n:, :n] = xy
    return b, f, r, v, g_star, u, g_exposure
