"""The shape of the stars of a frame: common to all, or varying smoothly over the field."""

import numpy as np

from .moffat import LOG_BETA

_SCATTER = 0.02  # of log widths, rho and log beta from star to star: no real profile is steadier
_DEVIANT = 18.5  # of chi2 with 4 degrees of freedom: 1 in 1000
_ENOUGH = 4  # stars for every unknown of a component
_QUARTILE_OF_CHI2 = 1.923  # with 4 degrees of freedom


def shape_field(shapes, covariance, xy, use, *, degree, fallback, peak=None):
    """Shapes expected at the stars, from those fitted to some of them.

    A polynomial in x and y of squared widths, fitted with the inverse of the covariances as weights; deviant shapes are
    left out. First the half counts that agrees best: a third of them may be blends.

    Parameters
    ----------
    shapes : ndarray, shape (n, 4)
        Fitted to every star by itself.
    covariance : ndarray, shape (n, 4, 4)
    xy : ndarray, shape (n, 2)
        Positions [pix].
    use : ndarray of bool, shape (n,)
        Stars with a shape worth the name.
    degree : int
        Of the polynomial; lower where stars are few.
    fallback : ndarray, shape (4,)
        Shape where there are not enough stars for an average.
    peak : ndarray, shape (n,), optional
        Heights of the stars: a term more, of the polynomial. Detectors whose response falls towards their full well,
        or whose charge spreads the more the more there is, widen stars in proportion to their height.

    Returns
    -------
    field : ndarray, shape (n, 4)
    covariance : ndarray, shape (n, 4, 4)
        Of the field; 0 of the fallback.
    """
    n_used, extra = np.count_nonzero(use), [] if peak is None else [peak / np.abs(peak[use]).max(initial=1e-30)]
    while degree and n_used < _ENOUGH * ((degree + 1) * (degree + 2) // 2 + len(extra)):
        degree -= 1
    if n_used < _ENOUGH:
        return np.tile(fallback, (len(xy), 1)), np.zeros((len(xy), 4, 4))
    terms = _polynomials(xy, degree)
    if n_used >= _ENOUGH * (terms.shape[1] + len(extra)):
        terms = np.column_stack([terms, *extra])
    information = np.linalg.inv(covariance + _SCATTER**2 * np.eye(4))
    moments, slope = _moments(shapes)
    weight = np.linalg.inv(slope)
    weight = weight.swapaxes(1, 2) @ information @ weight
    kept = use
    for halved in (*[True] * 6, *[False] * 10):
        coefficients, variances = _adjusted(terms[kept], moments[kept], weight[kept])
        field = _shapes(terms @ coefficients, fallback)
        chi2 = deviation(shapes - field, information)
        if halved:
            kept = use & (chi2 <= np.median(chi2[use]))
            continue
        before, kept = kept, use & (chi2 < _DEVIANT * usual(chi2[use]))
        if (kept == before).all():
            break
    back = np.linalg.inv(_moments(field)[1])
    known = np.einsum("na,aibj,nb->nij", terms, variances, terms, optimize=True)
    return field, back @ known @ back.swapaxes(1, 2)


def deviation(off, information):
    """Chi2 (n,) of deviations (n, 4) with inverse covariances (n, 4, 4)."""
    return np.einsum("ni,nij,nj->n", off, information, off)


def usual(chi2):
    """Factor by which the chi2 of shapes exceed that of noise, 1 at least; by the quartile, where half are blends."""
    return max(1.0, np.quantile(chi2, 0.25) / _QUARTILE_OF_CHI2)


def _moments(shapes):
    """Squares of half widths (n, 4): xx, yy, xy; log beta; and their derivatives by the shapes, (n, 4, 4).

    What moves or blurs images adds to them: they vary over the field as smoothly as its cause.
    """
    log_a, log_b, rho, log_beta = shapes.T
    size = 1 / (1 - rho**2)
    xx, yy, both = np.exp(-log_a) * size, np.exp(-log_b) * size, np.exp(-(log_a + log_b) / 2) * size
    out, by = np.column_stack([xx, yy, -rho * both, log_beta]), np.zeros((len(shapes), 4, 4))
    by[:, 0, 0], by[:, 1, 1], by[:, 3, 3] = -xx, -yy, 1
    by[:, 0, 2], by[:, 1, 2] = 2 * rho * size * xx, 2 * rho * size * yy
    by[:, 2, 0] = by[:, 2, 1] = rho * both / 2
    by[:, 2, 2] = -both * (1 + 2 * rho**2 * size)
    return out, by


def _shapes(moments, fallback):
    """The shapes (n, 4) of `_moments`; where a polynomial gives none, as far outside, the fallback."""
    xx, yy, xy, log_beta = moments.T
    proper = (xx > 0) & (yy > 0) & (xy**2 < 0.9 * xx * yy)
    xx, yy, xy = np.where(proper, (xx, yy, xy), np.array([[1.0], [1.0], [0.0]]))
    rho = -xy / np.sqrt(xx * yy)
    size = np.log(1 - rho**2)
    found = np.column_stack([-np.log(xx) - size, -np.log(yy) - size, rho, np.clip(log_beta, *LOG_BETA)])
    return np.where(proper[:, None], found, fallback)


def _polynomials(xy, degree):
    """Monomials in x and y by their total degree, (n, n_terms)."""
    middle, half = (xy.max(axis=0) + xy.min(axis=0)) / 2, np.maximum(np.ptp(xy, axis=0) / 2, 1)
    x, y = ((xy - middle) / half).T
    return np.column_stack([x ** (total - k) * y**k for total in range(degree + 1) for k in range(total + 1)])


def _adjusted(terms, shapes, information):
    """Coefficients (n terms, 4) by weighted least squares, and their covariance (n terms, 4, n terms, 4)."""
    k = terms.shape[1]
    normal = np.einsum("na,nij,nb->aibj", terms, information, terms, optimize=True).reshape(4 * k, 4 * k)
    right = np.einsum("na,nij,nj->ai", terms, information, shapes).ravel()
    return np.linalg.solve(normal, right).reshape(k, 4), np.linalg.inv(normal).reshape(k, 4, k, 4)
