"""The light of sources wider than stars: the PSF spread by a Gaussian, as a sum of stars on rings around the middle."""

import numpy as np

_RINGS = (6, 12, 16)  # places on each: neighbouring ones are 1.3 standard deviations apart at most


def _quadrature():
    """Places (m, 2) and weights (m,) of means over a Gaussian of unit standard deviation along x and y."""
    square, weights = np.polynomial.laguerre.laggauss(5)  # of half the squared radius
    square, weights = square[: len(_RINGS)], weights[: len(_RINGS)] / weights[: len(_RINGS)].sum()
    square /= (weights * square).sum()
    angles = [2 * np.pi * (np.arange(n) + 0.5 * (k % 2)) / n for k, n in enumerate(_RINGS)]
    rings = zip(np.sqrt(2 * square), angles, strict=True)
    places = np.concatenate([r * np.column_stack([np.cos(a), np.sin(a)]) for r, a in rings])
    return places, np.repeat(weights / _RINGS, _RINGS)


PLACES, WEIGHTS = _quadrature()


def spread_light(psf, params, spread, centres, half, *, slopes=False):
    """Light of sources on square stamps.

    Parameters
    ----------
    psf : `~legdistort.measurement.scene.moffat_field.MoffatField` or `EffectivePSF`
    params : ndarray, shape (n, 3)
        x, y from the central pixels, flux. Their precision (float32 or float64) is that of the results.
    spread : ndarray, shape (n, 2, 2)
        A root of the covariance of the Gaussian [pix], that times its transpose.
    centres : ndarray of int, shape (n, 2)
        Central pixels (x, y).
    half : int
        Stamps reach from -half to half.
    slopes : bool
        Whether to give derivatives too.

    Returns
    -------
    light : ndarray, shape (n, npix)
    slopes : ndarray, shape (n, 3, npix)
        By x, y and flux. Only if asked for, as the next.
    by_spread : ndarray, shape (n, 2, 2, npix)
    """
    n, k, kind = len(params), len(WEIGHTS), params.dtype
    parts = np.repeat(params[:, None], k, axis=1)
    parts[..., :2] += PLACES @ spread.mT
    parts[..., 2] *= WEIGHTS
    found = psf.light(parts.reshape(n * k, 3), np.repeat(centres, k, axis=0), half, slopes=slopes)
    if not slopes:
        return found.reshape(n, k, -1).sum(axis=1)
    light, by = found[0].reshape(n, k, -1), found[1].reshape(n, k, 3, -1)
    by_spread = np.einsum("nkcp,kb->ncbp", by[:, :, :2], PLACES.astype(kind))
    by[:, :, 2] *= WEIGHTS.astype(kind)[:, None]
    return light.sum(axis=1), by.sum(axis=1), by_spread
