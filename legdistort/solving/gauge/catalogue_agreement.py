"""What a reference catalogue says of the exposures, against what everything else says: is it right, is it bent?"""

import numpy as np
from scipy import special
from scipy.linalg import cholesky, solve_triangular

from ...results.check import CERTAIN
from ...results.errors.catalogue_tie import Agreement
from ..checks.limits import addition_that_shows
from ..equations.criterion import complement
from .hierarchy import LIMIT

#: Years by which an epoch must be another to be named.
_OTHER_TIME = 0.1
#: Stars whose median motion counts as the common one.
_FEWEST = 3


def agreement(equations, stated, used, motions=None):
    """The `Agreement` of a reference with everything else.

    Parameters
    ----------
    equations : `legdistort.solving.gauge.catalogue_map.MapEquations`
        At the errors that the reference was found to have.
    stated : MapEquations
        At those that it states.
    used : ndarray of bool, shape (n,)
    motions : ndarray, shape (n, 2), optional
        Proper motions in the reference, pixels a year; NaN for stars without one.
    """
    alone, at_stated = equations.without_prior(), stated.without_prior()
    value, covariance, _ = alone.solve(used)
    whole, both, _ = equations.solve(used)
    off, prior = whole - equations.prior.centre, equations.prior.information
    total = equations.chi2(equations.left(whole, used), used) + off @ prior @ off
    n_maps, bends = len(alone.determined(used)[1]), _bends(equations)
    known = np.count_nonzero(np.linalg.eigvalsh(bends.T @ prior @ bends) * LIMIT**2 > 1)
    dof = known + n_maps - len(equations.determined(used)[1])
    gain = equations.gain(used)[0]
    shown = np.linalg.eigvalsh(bends.T @ (gain - gain @ both @ gain) @ bends).min(initial=np.inf)
    moved = bends.T @ equations.metric @ (value - equations.prior.centre)
    left = at_stated.left(at_stated.solve(used)[0], used)
    chi2 = at_stated.chi2(left, used)
    rate, rate_error = (np.nan, np.nan) if motions is None else _in_common(motions[used])
    return Agreement(
        chi2=float(chi2),
        dof=float(2 * np.count_nonzero(used) - n_maps - equations.bends.shape[2] - stated.of_fitted(used)),
        bend_chi2=float(max(total - alone.chi2(alone.left(value, used), used), 0)),
        bend_dof=float(dof),
        bend=float(np.sqrt(np.sum(moved**2))) if n_maps == len(covariance) else np.nan,
        unseen=float(np.sqrt(addition_that_shows(dof) / shown)) if shown * LIMIT**2 > 1 else np.inf,
        years=_years(at_stated, used, left, chi2, motions),
        rate=rate,
        rate_error=rate_error,
    )


def _bends(equations):
    """Maps (2 k, m) without shift, rotation and scale over the stars, orthonormal over these."""
    root = cholesky(equations.metric)
    similar = np.linalg.qr(root @ equations.prior.modes.similar.T)[0]
    return solve_triangular(root, complement(similar.T).T)


def _in_common(motions):
    """Length of the median of proper motions (n, 2), and its error per axis by their scatter; NaN of too few."""
    known = motions[np.isfinite(motions).all(axis=1)]
    if len(known) < _FEWEST:
        return np.nan, np.nan
    middle = np.median(known, axis=0)
    scatter = np.median(np.abs(known - middle)) / special.ndtri(0.75)
    return float(np.hypot(*middle)), float(scatter * np.sqrt(np.pi / 2 / len(known)))


def _years(alone, used, left, chi2, motions):
    """By how many years epochs would have to be later for the stars to agree; NaN if none is better beyond doubt."""
    if motions is None or not np.isfinite(motions).any():
        return np.nan
    motions = np.nan_to_num(motions)
    moving = alone.of_values(motions)
    moved = moving.left(moving.solve(used)[0], used)
    square, pull = alone.chi2(moved, used), alone.chi2(moved, used, left)
    if not square > 0 or special.chdtrc(1, pull**2 / square) > CERTAIN or pull**2 / square < 0.5 * chi2:
        return np.nan
    years = float(pull / square)
    return years if abs(years) > _OTHER_TIME else np.nan
