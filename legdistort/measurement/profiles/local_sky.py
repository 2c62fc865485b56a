"""The sky under single stars: slopes of the light of halos, which a constant background would turn into shifts."""

import numpy as np

from .pixel_noise import NEIGHBOUR, pixel_variance

_OUTLIER = 6.0  # standard deviations, beyond which a pixel follows no model
_TOO_MANY = 1 / 4  # of the pixels of a core
_INNER = 0.5  # of the highest pixel of a star
_PLAIN = 0.4  # of it, beyond noise: such a deviation of a star can be seen
_MANY = 1 / 4  # of the bright stars, and more than cosmic rays would hit by chance
_CHANCE_HITS = 3
_CHANCE = 6.0  # chi2 of a slope, which noise exceeds in 5 % of the stars
_CHUNK = 300  # stars: their derivatives stay in the processor's cache


def separate(stamps, models, partners, background, noise, *, deviates, derivatives=None, precision=0.0, core=None):
    """Stamps less the light of other groups and the slope of the sky, and the weights of their pixels.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    models : tuple of ndarray, shape (n, npix)
        Light of the stars on their own stamps, and of all others there.
    partners : ndarray, shape (n, npix)
        Of the others, those that are fitted together with the star.
    background : ndarray, shape (n, 1)
    noise : tuple
        From `legdistort.measurement.profiles.pixel_noise.pixel_noise`.
    deviates : float
        Part of the star by which a pixel may deviate beyond its noise: nothing follows a model exactly.
    derivatives, precision
        See `slopes`; without derivatives the sky is taken as flat.
    core : ndarray of bool, shape (n, npix), optional
        Cores of the stars: where much of one deviates it is the model that is wrong, and all its pixels count.

    Returns
    -------
    data, weights, slope : ndarray, shape (n, npix)
        The weights are inverse variances, 0 for pixels that follow no model. The slope has been taken off the data.
    """
    own, others = models
    light = own + others + background.astype(own.dtype)
    variance = pixel_variance(noise, light) + (NEIGHBOUR * (others - partners)) ** 2
    left, allowed = stamps.data - light, _OUTLIER * np.sqrt(variance) + deviates * np.abs(own + partners)
    wrong = _wrong_peaks(stamps, own, left, allowed)

    def weights(left, allowed):
        good = stamps.good & (wrong | (np.abs(left) < allowed))
        if core is not None:
            good |= ((core & stamps.good & ~good).sum(axis=1) > _TOO_MANY * core.sum(axis=1))[:, None] & stamps.good
        return np.where(good, 1 / variance, 0.0)

    slope = np.zeros_like(left)
    if derivatives is not None:
        usual = _OUTLIER * 1.5 * np.median(np.abs(left), axis=1)[:, None]  # a slope leaves more than noise everywhere
        slope = slopes(left, weights(left, np.maximum(allowed, usual)), derivatives, precision)
    return stamps.data - slope - (others - partners), weights(left - slope, allowed), slope


def _wrong_peaks(stamps, own, left, allowed):
    """Inner pixels of all stars, where those of many bright ones exceed the model: it lacks their core."""
    peak = own.max(axis=1)
    inner = own > _INNER * peak[:, None]
    middle = own.shape[1] // 2
    bright = (peak > 0) & (allowed[:, middle] < _PLAIN * peak) & ~stamps.saturated.any(axis=1)
    higher = (inner & stamps.good & (left > allowed)).any(axis=1) & bright
    many = higher.sum() > max(_MANY * bright.sum(), _CHANCE_HITS)
    return inner if many else np.zeros_like(inner)


def slopes(left, weights, derivatives, precision=0.0):
    """Planes that are 0 in the middle of every stamp (the level is a parameter of the fit).

    Fitted together with the parameters of the stars, linearised where these have settled: what the stars have taken
    up of a slope counts for it. Shrunk towards a flat sky, on which free slopes would cost 2 % of the precision of a
    position.

    Parameters
    ----------
    left : ndarray, shape (n, npix)
        What fits leave of square stamps.
    weights : ndarray, shape (n, npix)
        Inverse variances; 0 for pixels that do not count.
    derivatives : callable
        ``derivatives(rows)``: of the models of some stars by their parameters, (m, k, npix).
    precision : ndarray, shape (k,), optional
        Inverse variances of the prior of the parameters.

    Returns
    -------
    ndarray, shape (n, npix)
    """
    half = round(np.sqrt(left.shape[1])) // 2
    grid = np.mgrid[-half : half + 1, -half : half + 1][::-1].reshape(2, -1).astype(left.dtype)
    squares = (grid[:, None] * grid).reshape(4, -1)
    out = np.zeros_like(left)
    for i in range(0, len(left), _CHUNK):
        rows = slice(i, i + _CHUNK)
        slope_of = derivatives(rows)
        by = slope_of * weights[rows, None]
        shared = (by @ grid.T).astype(float)  # (m, k, 2)
        taken = _solved(by @ slope_of.swapaxes(1, 2), precision, shared)
        normal = (weights[rows] @ squares.T).reshape(-1, 2, 2) - shared.swapaxes(1, 2) @ taken
        right = (weights[rows] * left[rows]) @ grid.T - (left[rows, None] @ by.swapaxes(1, 2) @ taken)[:, 0]
        determined = np.linalg.det(normal) > 1e-6 * np.einsum("nii->n", normal) ** 2
        slope = np.zeros_like(right)
        slope[determined] = np.linalg.solve(normal[determined], right[determined, :, None])[..., 0]
        significance = np.maximum((slope * right).sum(axis=1), 1e-9)
        out[rows] = (np.maximum(1 - _CHANCE / significance, 0)[:, None] * slope) @ grid
    return out


def _solved(normal, precision, right):
    """Normal equations (n, k, k) of parameters solved, in units of their diagonal."""
    normal = normal.astype(float) + np.diag(np.broadcast_to(precision, normal.shape[1]))
    diagonal = np.einsum("nii->ni", normal)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    normal = normal / (scale[:, :, None] * scale[:, None, :]) + 1e-6 * np.eye(normal.shape[1])
    return np.linalg.solve(normal, right / scale[:, :, None]) / scale[:, :, None]
