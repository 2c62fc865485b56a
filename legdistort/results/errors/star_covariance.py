"""Covariance between the stars of a solution without its equations, one from a file or a pickle.

With the observations used and their errors, and those of a reference, the normal equations of stars with known
coefficients are there again,
``V_j = sum_i J' W J + P_j`` and ``E_ij = J' W B``, and with the covariance C of the coefficients in the gauge
``cov = V^-1 + V^-1 E C E' V^-1``.
"""

import numpy as np

from ...exceptions import InputError
from ...geometry import basis, similarity
from .coefficient_covariance import times

#: Part of the variance of a star by which that from the observations may differ from the one stored.
_ROUNDING = 1e-6


def star_matrix(solution):
    """Covariance between all star positions in the gauge, shape (2 n_stars,) squared, px^2; all x first.

    As `legdistort.solving.equations.covariances.Uncertainty.star_matrix`, from the table of residuals; NaN for stars
    without a position.

    Parameters
    ----------
    solution : Solution

    Raises
    ------
    InputError
        If it is not what the errors of the stars call for: the weights of observations by a robust loss and motions are
        not in the table.
    """
    uncertainty, n = solution.estimate.uncertainty, len(solution.estimate.star_names)
    own, coupling = _normal_equations(solution)
    seen = own[:, 0, 0] > 0
    inverse = np.full(own.shape, np.nan)
    inverse[seen] = np.linalg.inv(own[seen])
    spread = np.einsum("jab,jbk->ajk", inverse, coupling).reshape(2 * n, -1)
    out = spread @ times(uncertainty.coefficients, spread.T)
    index = np.arange(2 * n).reshape(2, n).T
    out[index[:, :, None], index[:, None, :]] += inverse
    if camera := uncertainty.camera:
        common = camera.of_stars(2).reshape(2 * n, -1)
        out += common @ common.T
    variance, stored = np.diag(out).reshape(2, n), uncertainty.stars[:2]
    if not np.allclose(variance, stored, rtol=_ROUNDING, atol=0, equal_nan=True):
        raise InputError(
            "covariances between the stars of a solution that was read do not follow from its residuals where a robust "
            "loss, motions, fitted errors or correlated errors took part; call solve again"
        )
    return out


def _normal_equations(solution):
    """V (n_stars, 2, 2) of every star, and E (n_stars, 2, n_exposures * 2 n_modes), from the observations used."""
    table, names = solution.residuals, np.asarray(solution.names)
    table = table[np.asarray(table["used"], dtype=bool)]
    star = np.searchsorted(solution.estimate.star_names, np.asarray(table["star"]))
    weight = np.linalg.inv(solution.diagnostics.errors_of(table))
    n, n_modes = len(solution.estimate.star_names), basis.n_modes(solution.degree)
    own, coupling = np.zeros((n, 2, 2)), np.zeros((n, len(names), 2, 2, n_modes))
    for i, view in enumerate(solution):
        rows = np.asarray(table["exposure"]) == view.name
        q = similarity.apply(view.pose, solution.estimate.positions[star[rows]])
        slope = view.distortion.jacobian(q) @ view.pose[:, :2]
        pull = np.swapaxes(slope, 1, 2) @ weight[rows]
        np.add.at(own, star[rows], pull @ slope)
        values = basis.values(solution.degree, *basis.normalize(q, view.shape))
        np.add.at(coupling, (star[rows], i), np.einsum("nac,mn->nacm", pull, values))
    if (tie := solution.gauge.tie) is not None and tie.known is not None:
        own[np.searchsorted(solution.estimate.star_names, tie.stars[tie.used])] += np.linalg.inv(tie.known[tie.used])
    return own, coupling.transpose(0, 2, 1, 3, 4).reshape(n, 2, -1)
