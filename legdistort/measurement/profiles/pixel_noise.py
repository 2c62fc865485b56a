"""The noise of the pixels under stars, from what a first fit leaves: sky, and photons where the gain is unknown."""

import numpy as np

from . import moffat

#: A subtracted neighbour leaves residuals of this fraction of itself.
NEIGHBOUR = 0.05
#: Of the variance of the sky, what is left of it in the darkest places.
LEAST_SKY = 0.25


def pixel_variance(noise, light):
    """Variance of pixels.

    Parameters
    ----------
    noise : tuple
        From `pixel_noise`.
    light : ndarray, shape (n, npix)
        Above the sky that was taken off: stars, and halos in the fitted background.

    Returns
    -------
    ndarray, shape (n, npix)
    """
    sky, photon = noise
    return np.maximum(sky + photon * light, LEAST_SKY * sky)  # between halos the sky taken off was too high


def pixel_noise(stamps, fit, models, nodes):
    """Variance of the sky on all stamps, and variance per unit of light.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
        Their variance is that of the sky where no star is seen (`legdistort.measurement.detection.detect`).
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
    return sky, photon_noise(stamps, fit, models, nodes) if photon is None else photon


def photon_noise(stamps, fit, models, nodes):
    """Variance per unit of light that the stars themselves show; arguments as of `pixel_noise`."""
    return _photon_noise(stamps, fit, _residuals(stamps, fit, models, nodes))


def _residuals(stamps, fit, models, nodes):
    """Models of (some) stars and of their neighbours, and squares of what they leave, raised for what a fit absorbs."""
    rows = np.unique(np.linspace(0, len(models[0]) - 1, 400).astype(int))
    own, others = (light[rows].astype(float) for light in models)
    _, jac = moffat.evaluate(fit.params[rows], stamps.half, nodes, jacobian=True)
    absorbed = (jac * (fit.covariance[rows] @ jac)).sum(axis=1) / stamps.variance[rows]
    square = (stamps.data[rows] - own - others - fit.params[rows, 7:]) ** 2 / np.maximum(1 - absorbed, 0.1)
    return rows, own, others, square


def _photon_noise(stamps, fit, remains):
    """Variance per unit of star light, from the residuals of the first pass.

    The squared residual of a pixel is expected at ``sky variance + photon * model``. Profiles that do not quite fit add
    a part that goes with the square of the model and differs from star to star: faint stars determine the photons,
    bright ones that part. A line through the stars is fitted by least absolute deviations: companions too faint to be
    detected raise single stars only.
    """
    rows, own, others, square = remains
    sky = stamps.variance[rows].astype(float)
    use = fit.converged & (fit.params[:, 2] > 0) & ~stamps.saturated.any(axis=1)
    own = np.where(stamps.good[rows] & use[rows, None], own, 0.0)
    photon = misfit = 0.0
    for _ in range(40):
        weights = (sky + photon * own + (NEIGHBOUR * others) ** 2) ** -2.0
        information = (weights * own**2).sum(axis=1)
        seen = information > 0
        if not seen.any():
            break
        norm = information[seen]
        single = (weights * own * (square - sky)).sum(axis=1)[seen] / norm
        bright = (weights * own**3).sum(axis=1)[seen] / norm
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
