"""The noise of the pixels under stars, from what a first fit leaves: sky, and photons where the gain is unknown."""

import numpy as np

from . import moffat

#: A subtracted neighbour leaves residuals of this fraction of itself.
NEIGHBOUR = 0.05


def pixel_noise(stamps, fit, models, nodes):
    """Variance of the sky on all stamps, and variance per unit of star light.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    fit : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        Of the stars one by one, with the variance of the stamps.
    models : tuple of ndarray
        From `legdistort.measurement.profiles.cutouts.Stamps.models`.
    nodes : tuple
        From `legdistort.measurement.profiles.moffat.quadrature`.

    Returns
    -------
    sky : ndarray, shape (n, npix)
    photon : float
    """
    sky, photon = stamps.variance, stamps.frame.photon
    if stamps.frame.noise_given:
        return sky, photon
    remains = _residuals(stamps, fit, models, nodes)
    sky = sky * sky.dtype.type(_sky_factor(stamps, fit, remains))
    return sky, _photon_noise(stamps, sky, fit, remains) if photon is None else photon


def _residuals(stamps, fit, models, nodes):
    """Models of (some) stars and of their neighbours, and squares of what they leave, raised for what a fit absorbs."""
    rows = np.unique(np.linspace(0, len(models[0]) - 1, 400).astype(int))
    own, others = (light[rows].astype(float) for light in models)
    _, jac = moffat.evaluate(fit.params[rows], stamps.half, nodes, jacobian=True)
    absorbed = (jac * (fit.covariance[rows] @ jac)).sum(axis=1) / stamps.variance[rows]
    square = (stamps.data[rows] - own - others - fit.params[rows, 7:]) ** 2 / np.maximum(1 - absorbed, 0.1)
    return rows, own, others, square


def _sky_factor(stamps, fit, remains):
    """Variance of the sky around the stars, relative to the map: the faint wings of stars raise the latter."""
    rows, own, others, square = remains
    variance = stamps.variance[rows]
    dark = stamps.good[rows] & (own + others < 0.5 * np.sqrt(variance))
    use = fit.converged[rows] & (dark.mean(axis=1) > 0.4)
    if np.count_nonzero(use) < 20:  # then the map is known better
        return 1.0
    # The median of a squared unit normal is 0.4549; unlike the mean it overlooks stars too faint to be detected.
    return float(np.clip(np.median((square / variance)[dark & use[:, None]]) / 0.4549, 0.5, 2.0))


def _photon_noise(stamps, sky, fit, remains):
    """Variance per unit of star light, from the residuals of the first pass.

    The squared residual of a pixel is expected at ``sky variance + photon * model``. Profiles that do not quite fit add
    a part that goes with the square of the model and differs from star to star: faint stars tell the photons, bright
    ones that part. A line through the stars is fitted by least absolute deviations: companions too faint to be detected
    raise single stars only.
    """
    rows, own, others, square = remains
    sky = sky[rows].astype(float)
    use = fit.converged & (fit.params[:, 2] > 0) & ~stamps.saturated.any(axis=1)
    own = np.where(stamps.good[rows] & use[rows, None], own, 0.0)
    photon = misfit = 0.0
    for _ in range(40):
        weights = (sky + photon * own + (NEIGHBOUR * others) ** 2) ** -2.0
        information = (weights * own**2).sum(axis=1)
        told = information > 0
        if not told.any():
            break
        norm = information[told]
        single = (weights * own * (square - sky)).sum(axis=1)[told] / norm
        bright = (weights * own**3).sum(axis=1)[told] / norm
        spread = np.sqrt(2 / norm) + misfit * bright
        importance = 1 / (spread * np.maximum(np.abs(single - photon - misfit * bright), 0.01 * spread))
        photon, misfit = _line(bright, single, importance)
    return photon


def _line(x, y, weights):
    """Intercept and slope, neither negative, of the weighted least-squares line."""
    n, sx, sy, sxx, sxy = (float((weights * t).sum()) for t in (1, x, y, x * x, x * y))
    determinant = n * sxx - sx**2
    if determinant > 1e-9 * n * sxx:
        slope = (n * sxy - sx * sy) / determinant
        intercept = (sy - slope * sx) / n
        if slope >= 0 and intercept >= 0:
            return intercept, slope
        if intercept < 0:
            return 0.0, max(sxy / sxx, 0.0)
    return max(sy / n, 0.0), 0.0
