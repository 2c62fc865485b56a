"""What the joint solver is measured against: a general least-squares code on the same criterion."""

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from legdistort.geometry import basis
from legdistort.solving.equations import criterion
from legdistort.solving.equations.problem import State


def solve_scipy(problem, state):
    """`scipy.optimize.least_squares` with an exact sparse Jacobian, from the same start values, poses held.

    Nothing fixes the directions that the data do not tell, so compare positions after a common map.
    """
    n_stars, n_modes, n_exposures = problem.n_stars, problem.n_modes, problem.n_exposures
    n = problem.xy.shape[1]
    exposure = np.repeat(np.arange(n_exposures), np.diff(problem.start))
    root = np.sqrt(problem.weight[:2])
    indptr = np.arange(2 * n + 1) * (2 + n_modes)
    columns = np.empty((2, n, 2 + n_modes), dtype=np.int64)
    for axis in (0, 1):
        columns[axis, :, 0], columns[axis, :, 1] = problem.star, n_stars + problem.star
        columns[axis, :, 2:] = (2 * n_stars + (exposure * 2 + axis) * n_modes)[:, None] + np.arange(n_modes)
    columns = columns.reshape(-1)

    def unpack(x):
        coefficients = state.coefficients.copy()
        coefficients[:, :, :n_modes] = x[2 * n_stars :].reshape(n_exposures, 2, n_modes)
        return State(x[: 2 * n_stars].reshape(2, -1), coefficients, state.poses)

    def residuals(x):
        return (root * _residuals(problem, unpack(x))).ravel()

    def jacobian(x):
        current = unpack(x)
        data = np.empty((2, n, 2 + n_modes))
        for i in range(n_exposures):
            part = problem.part(i)
            _, values, slope = criterion.predict(problem, current, i, i + 1)
            for axis in (0, 1):
                data[axis, part, :2] = -(root[axis, part] * slope[axis]).T
                data[axis, part, 2:] = -(root[axis, part] * values[:n_modes]).T
        return csr_array((data.reshape(-1), columns, indptr), shape=(2 * n, 2 * n_stars + 2 * n_modes * n_exposures))

    start = np.concatenate([state.positions.ravel(), state.coefficients[:, :, :n_modes].ravel()])
    result = least_squares(residuals, start, jac=jacobian, method="trf", x_scale="jac", tr_solver="lsmr")
    return unpack(result.x), 2 * result.cost


def _residuals(problem, state):
    """Measured less model positions (2, n), an exposure at a time: what is computed of one stays in the cache."""
    out, degree = problem.xy.copy(), basis.degree_of(state.coefficients.shape[2])
    for i, (pose, coefficients) in enumerate(zip(state.poses, state.coefficients, strict=True)):
        part = problem.part(i)
        q = pose[:, :2] @ state.positions[:, problem.star[part]] + pose[:, 2:]
        out[:, part] -= q + coefficients @ basis.values(degree, *basis.normalize(q.T, problem.shapes[i]))
    return out
