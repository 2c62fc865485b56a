"""The shape of the stars of a frame: common to all, or varying linearly over the field."""

import numpy as np

_SCATTER = 0.02  # of log widths, rho and log beta from star to star: no real profile is steadier
_DEVIANT = 18.5  # of chi2 with 4 degrees of freedom: 1 in 1000
_ENOUGH = 4  # stars for every unknown of a component


def shape_field(fit, xy, use, *, linear, fallback):
    """Shapes expected at the stars, from those fitted to some of them.

    The shapes are averaged with the inverse of their covariance as weights, deviant ones left out.

    Parameters
    ----------
    fit : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        Every star with a shape of its own.
    xy : ndarray, shape (n, 2)
        Positions [pix].
    use : ndarray of bool, shape (n,)
        Stars with a shape worth the name.
    linear : bool
        Whether shapes vary linearly over the field.
    fallback : ndarray, shape (4,)
        Shape where there are not enough stars for an average.

    Returns
    -------
    ndarray, shape (n, 4)
    """
    middle, half = (xy.max(axis=0) + xy.min(axis=0)) / 2, np.maximum(np.ptp(xy, axis=0) / 2, 1)
    terms = np.column_stack([np.ones(len(xy)), (xy - middle) / half])
    shapes = fit.params[:, 3:7]
    information = np.linalg.inv(fit.covariance[:, 3:7, 3:7] + _SCATTER**2 * np.eye(4))
    if np.count_nonzero(use) < _ENOUGH * terms.shape[1] or not linear:
        terms = terms[:, :1]
    candidates = use
    for _ in range(10):
        if np.count_nonzero(use) < _ENOUGH:
            return np.tile(fallback, (len(xy), 1))
        field = terms @ _adjusted(terms[use], shapes[use], information[use])
        off = shapes - field
        keep = candidates & (np.einsum("ni,nij,nj->n", off, information, off) < _DEVIANT)
        if (keep == use).all():
            break
        use = keep
    return field


def _adjusted(terms, shapes, information):
    """Coefficients (n terms, 4) by weighted least squares."""
    k = terms.shape[1]
    normal = np.einsum("na,nij,nb->aibj", terms, information, terms).reshape(4 * k, 4 * k)
    right = np.einsum("na,nij,nj->ai", terms, information, shapes).ravel()
    return np.linalg.solve(normal, right).reshape(k, 4)
