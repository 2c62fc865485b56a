"""The error of an effective PSF itself, inside the errors of the stars measured with it.

Star i with the slopes J (by x, y, flux, sky), the weights W and the modes E of the PSF on its stamp is wrong by
``-(J' W J)^-1 J' W E da`` where the amplitudes are wrong by da: their covariance adds to that of the star, whether it
took part in making the PSF or not (both follow from the joint fit of all). What moves all stars by a common map of the
field order of the PSF is taken off: it belongs to the distortion of the exposure, not to the stars.
"""

import numpy as np
from scipy.linalg import solve_triangular

from . import splines

_PART = 100  # stars worked on at a time, the brightest first
_NEGLIGIBLE = 0.01  # of the variance of the fit


def own_covariance(built, stars, params, covariance):
    """Covariances of positions that the PSF's own error adds.

    Parameters
    ----------
    built : `~legdistort.measurement.effective.building.Built`
    stars : `~legdistort.measurement.effective.building.Ensemble`
        All stars of the frame that count.
    params : ndarray, shape (n, 4)
        As fitted.
    covariance : ndarray, shape (n, 4, 4)
        Of the fits, the PSF taken as exact.

    Returns
    -------
    ndarray, shape (n, 2, 2)
        Worked out from the brightest star down, until it no longer matters; below, that of the last ones is taken.
    """
    out = np.zeros((len(params), 2, 2))
    if not len(params):
        return out
    order = np.argsort(-params[:, 2], kind="stable")
    terms = built.psf.variation(stars.centres + params[:, :2])
    made = order[: max(_PART, np.count_nonzero(built.used))]
    common = _common(built, stars, made, params, covariance, terms)
    for k in range(0, len(order), _PART):
        rows = order[k : k + _PART]
        lever = _lever(built, stars, rows, params, covariance)
        whole = terms[rows, None, :, None] * lever[:, :, None, :] - np.einsum("nt,atum->naum", terms[rows], common)
        whole = built.corrections.reduced(whole).reshape(2 * len(rows), -1)
        half = solve_triangular(built.factor[0], whole.T, lower=True, check_finite=False)
        half = half.T.reshape(len(rows), 2, -1)
        out[rows] = half @ half.swapaxes(1, 2)
        share = np.median(np.einsum("naa->n", out[rows]) / np.einsum("naa->n", covariance[rows, :2, :2]))
        if share < _NEGLIGIBLE:
            out[order[k + _PART :]] = np.median(out[rows], axis=0)
            break
    return out


def _lever(built, stars, rows, params, covariance):
    """What raw corrections at the star's place do to its position, (n, 2, n_modes)."""
    half, spacing = stars.half, built.psf.spacing
    grids = built.psf.grids(stars.centres[rows] + params[rows, :2])
    value, by_x, by_y = splines.on_stamps(grids, params[rows, :2], half, spacing, slopes=True)
    flux = params[rows, 2:3]
    weights = 1 / stars.part(rows).variance(flux * value + params[rows, 3:])
    slopes = np.stack([flux * by_x, flux * by_y, value, np.ones_like(value)], axis=1)
    seen = flux[:, None] * (covariance[rows, :2] @ slopes) * weights[:, None]
    return built.corrections.against(seen, params[rows, :2], half, spacing)


def _common(built, stars, rows, params, covariance, terms):
    """The map of the field order that the amplitudes cause, (2, n_terms, n_terms, n_modes): weighted least squares."""
    lever = _lever(built, stars, rows, params, covariance)
    t = terms[rows]
    maps = []
    for a in (0, 1):
        weights = 1 / covariance[rows, a, a]
        normal = (t * weights[:, None]).T @ t
        mixed = np.einsum("nt,n,nu,nm->tum", t, weights, t, lever[:, a], optimize=True)
        maps.append(np.linalg.solve(normal, mixed.reshape(len(normal), -1)).reshape(mixed.shape))
    return np.stack(maps)
