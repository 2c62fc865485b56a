"""Plain, exact twins: the criterion written out with numpy.polynomial, minimised densely."""

import numpy as np
from numpy.polynomial.legendre import legval2d
from scipy.optimize import least_squares


def modes(degree):
    """Orders (i, j) in x and y, by total degree."""
    return [(total - k, k) for total in range(degree + 1) for k in range(total + 1)]


def predict(positions, coefficients, pose, shape):
    """Detector positions (n, 2) of reference positions (n, 2), by the formula of the paper's section 2.1."""
    ny, nx = shape
    q = positions @ pose[:, :2].T + pose[:, 2]
    u, v = 2 * (q[:, 0] + 0.5) / nx - 1, 2 * (q[:, 1] + 0.5) / ny - 1
    out = q.copy()
    n_modes = coefficients.shape[1]
    degree = int((np.sqrt(8 * n_modes + 1) - 3) / 2)
    for axis in (0, 1):
        tensor = np.zeros((degree + 1, degree + 1))
        for m, (i, j) in enumerate(modes(degree)):
            tensor[i, j] = coefficients[axis, m] * np.sqrt((2 * i + 1) / 2) * np.sqrt((2 * j + 1) / 2)
        out[:, axis] += legval2d(u, v, tensor)
    return out


class DenseOracle:
    """All unknowns in one vector, numerical Jacobian, the constraints of the gauge as heavy extra rows.

    Poses and constraints are taken from the solution under test: they are conventions, not estimates.
    """

    def __init__(self, matches, solution, prior_mean, *, weight_of_gauge=1e4):
        self.obs = matches.observations
        self.solution, self.prior_mean = solution, prior_mean
        self.poses = [solution.poses[name] for name in matches.names]
        self.shapes = [matches.shapes[name] for name in matches.names]
        cov = self.obs.covariance
        full = np.stack([cov[:, [0, 2]], cov[:, [2, 1]]], axis=1)
        self.whiten = np.linalg.inv(np.linalg.cholesky(full))
        self.rows = solution.gauge.orthonormal * weight_of_gauge
        self.n_stars, self.n_exposures = len(matches.stars), len(matches.names)
        self.n_modes = solution.gauge.n_constraints // 2

    def unpack(self, x):
        positions = x[: 2 * self.n_stars].reshape(-1, 2)
        return positions, x[2 * self.n_stars :].reshape(self.n_exposures, 2, self.n_modes)

    def residuals(self, x):
        positions, coefficients = self.unpack(x)
        r = np.empty_like(self.obs.xy)
        for i in range(self.n_exposures):
            on = self.obs.exposure == i
            r[on] = self.obs.xy[on] - predict(
                positions[self.obs.star[on]], coefficients[i], self.poses[i], self.shapes[i]
            )
        return np.einsum("nab,nb->na", self.whiten, r).ravel()

    def _with_gauge(self, x):
        departure = self.unpack(x)[1] - self.prior_mean
        return np.concatenate([self.residuals(x), self.rows @ departure.ravel()])

    def solve(self):
        """Minimise from the rough positions of the matches; returns the scipy result."""
        start = np.concatenate([self._rough().ravel(), np.repeat(self.prior_mean[None], self.n_exposures, 0).ravel()])
        return least_squares(self._with_gauge, start, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)

    def _rough(self):
        out = np.zeros((self.n_stars, 2))
        count = np.zeros(self.n_stars)
        for i, pose in enumerate(self.poses):
            on = self.obs.exposure == i
            back = (self.obs.xy[on] - pose[:, 2]) @ np.linalg.inv(pose[:, :2]).T
            np.add.at(out, self.obs.star[on], back)
            np.add.at(count, self.obs.star[on], 1)
        return out / count[:, None]

    def jacobian(self, x):
        """Numerical derivatives of the whitened residuals by all unknowns."""
        step = 1e-4
        columns = []
        for k in range(len(x)):
            e = np.zeros(len(x))
            e[k] = step
            columns.append((self.residuals(x + e) - self.residuals(x - e)) / (2 * step))
        return np.array(columns).T

    def covariance(self, x):
        """Covariance of all unknowns under hard constraints: null-space method on the numerical Jacobian."""
        jacobian = self.jacobian(x)
        rows = np.hstack([np.zeros((len(self.rows), 2 * self.n_stars)), self.rows])
        free = np.linalg.svd(rows)[2][len(rows) :].T
        return free @ np.linalg.inv(free.T @ jacobian.T @ jacobian @ free) @ free.T
