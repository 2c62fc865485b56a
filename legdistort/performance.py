"""The two error criteria of the paper (section 3.4), as measured and as expected from the covariances.

*b* is the error of the reference positions, *sigma* the scatter of corrected positions over the exposures.
All figures are rms per axis; the paper's, which sum both axes, are sqrt(2) times larger.
"""

import numpy as np

from . import basis, poses
from .exceptions import InputError


def bias(estimated, true, *, removed=None):
    """Error b of reference positions, rms per axis (paper, section 3.4, first criterion, over sqrt(2)).

    Parameters
    ----------
    estimated, true : array_like, shape (n_stars, 2)
    removed : None, "similarity" or int
        What is fitted to the differences and taken out first: nothing; shift, rotation and scale; or a
        polynomial map of this total degree (what is left is free of the gauge).

    Returns
    -------
    float
        Pixels.
    """
    estimated, true = np.asarray(estimated, float), np.asarray(true, float)
    good = np.isfinite(estimated).all(axis=1)
    difference = (estimated - true)[good].T.ravel()
    columns = _columns(true[good], removed)
    left = difference - columns @ (columns.T @ difference)
    return float(np.sqrt(np.mean(left**2)))


def expected_bias(solution, *, removed=None, absolute=False):
    """What `bias` should be, from the covariance of the solution.

    Parameters
    ----------
    solution : Solution
        As returned by `legdistort.solve`.
    removed : None, "similarity" or int
        As for `bias`. With the fitted degree this is the Cramer-Rao bound of the gauge-free error.
    absolute : bool
        Add what the gauge hides (mean dynamic distortion, static uncertainty).
    """
    good = np.isfinite(solution.positions).all(axis=1)
    xy = solution.positions[good]
    if not hasattr(solution.uncertainty, "star_matrix"):
        raise InputError("a solution read from a file keeps no covariances between stars; call solve again")
    covariance = solution.uncertainty.star_matrix[np.ix_(np.tile(good, 2), np.tile(good, 2))]
    if absolute:
        modes = np.kron(np.eye(2), solution.gauge.modes_at(xy)).T
        covariance = covariance + modes @ solution.gauge.absolute_covariance @ modes.T
    columns = _columns(xy, removed)
    left = np.trace(covariance) - np.trace(columns.T @ covariance @ columns)
    return float(np.sqrt(left / len(covariance)))


def _columns(xy, removed):
    """Orthonormal displacement fields (2 n, k) at positions (n, 2), x first, of what is to be removed."""
    n = len(xy)
    if removed is None:
        return np.zeros((2 * n, 0))
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = (2 * (xy - low) / (high - low) - 1).T
    if removed == "similarity":
        x, y = (xy - xy.mean(axis=0)).T
        one, zero = np.ones(n), np.zeros(n)
        fields = [[one, zero], [zero, one], [x, y], [-y, x]]
        columns = np.array([np.concatenate(f) for f in fields]).T
    else:
        degree = basis.check_degree(removed, "removed")
        columns = np.kron(np.eye(2), basis.values(degree, x, y)).T
    return np.linalg.qr(columns)[0]


def scatter(corrected):
    """Scatter sigma_j of corrected positions, rms per axis (paper, section 3.4, second criterion, over sqrt(2)).

    Parameters
    ----------
    corrected : array_like, shape (n_exposures, n_stars, 2)
        NaN where a star is not seen.

    Returns
    -------
    ndarray, shape (n_stars,)
        With 1/n_im as in the paper; NaN for a star seen less than twice.
    """
    corrected = np.asarray(corrected, float)
    seen = np.isfinite(corrected).all(axis=2)
    n = seen.sum(axis=0)
    filled = np.where(seen[..., None], corrected, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = filled.sum(axis=0) / n[:, None]
        variance = (np.where(seen[..., None], corrected - mean, 0) ** 2).sum(axis=(0, 2)) / (2 * n)
    return np.sqrt(np.where(n > 1, variance, np.nan))


def corrected_positions(solution):
    """Corrected positions (n_exposures, n_stars, 2) of the fitted stars (section 3.3), NaN where not used."""
    table = solution.observations
    out = np.full((len(solution.names), len(solution.star_names), 2), np.nan)
    for i, name in enumerate(solution.names):
        rows = table[(table["exposure"] == name) & table["used"]]
        xy = np.column_stack([rows["x"].value, rows["y"].value])
        out[i, np.searchsorted(solution.star_names, rows["star"])] = solution.correct(name, xy)
    return out


def expected_scatter(solution, xy, sigma, *, seen=None):
    """What `scatter` should be for new positions that the solution has not seen, from its Fisher matrix.

    Parameters
    ----------
    solution : Solution
    xy : array_like, shape (n, 2)
        Reference positions.
    sigma : float
        Error of one detector position, pixels per axis.
    seen : array_like of bool, shape (n_exposures, n), optional
        In which exposures a position is measured; by default those on whose detector it falls.

    Returns
    -------
    ndarray, shape (n,)
        Rms per axis; NaN where fewer than two exposures see the position.
    """
    xy = np.asarray(xy, dtype=float)
    size = solution.gauge.n_constraints
    rows = np.zeros((len(xy), 2, len(solution.names), size))
    noise, n = np.zeros(len(xy)), np.zeros(len(xy), dtype=int)
    for i, name in enumerate(solution.names):
        distortion, pose = solution.distortion(name), solution.poses[name]
        ny, nx = solution.shapes[name]
        q = poses.apply(pose, xy)
        if seen is None:
            on = (np.abs(distortion(q) - [(nx - 1) / 2, (ny - 1) / 2]) <= [nx / 2, ny / 2]).all(axis=1)
        else:
            on = np.asarray(seen)[i]
        back = np.linalg.inv(distortion.jacobian(q[on]) @ pose[:, :2])
        b = basis.values(solution.degree, *basis.normalize(q[on], solution.shapes[name]))
        rows[on, :, i] = np.einsum("kac,mk->kacm", back, b).reshape(len(b.T), 2, size)
        noise[on] += sigma**2 * (back**2).sum(axis=(1, 2))
        n[on] += 1
    covariance = solution.uncertainty.coefficients
    blocks = covariance.reshape(len(solution.names), size, len(solution.names), size)
    own = np.einsum("kaip,ipiq,kaiq->k", rows, blocks, rows, optimize=True)
    flat = rows.reshape(len(xy), 2, -1)
    together = np.einsum("kap,kap->k", flat @ covariance, flat)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = (own + noise - (together + noise) / n) / (2 * n)
    return np.sqrt(np.where(n > 1, variance, np.nan))
