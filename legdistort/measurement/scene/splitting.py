"""Stars that may be two: both fitted, and kept where that explains more than noise."""

import numpy as np
from scipy.spatial import cKDTree

from ..profiles.levenberg_marquardt import Limits, minimise
from .stamps import stamp_pixels

#: Chi2 that a second star must take away.
GAIN = 30.0
_CORE_CHI2 = 1.3
_RATIOS = (0.5, 0.8, 0.2)  # of the light, on one side of the middle
_APART = 0.7  # FWHM, at the start
_CLOSEST, _FARTHEST = 0.25, 1.5  # FWHM
_LIMITS = Limits(20, 1e-2)
_FREE = (np.array([-np.inf]), np.array([np.inf]))
_FLAT = 1e6  # inverse variance of the sky in units of that of the pixels: it stays


class _Stamps:
    """Pixels of single stamps and the stars on them, in units of their noise; see `minimise`."""

    kind = np.dtype(np.float64)

    def __init__(self, psf, centres, data, weights, half):
        self.psf, self.centres, self.half = psf, centres, half
        self.root = np.sqrt(weights, dtype=float)
        self.target = data * self.root
        self.dof = np.maximum(np.count_nonzero(weights, axis=1) - 6, 1)

    def linearise(self, params, rows):
        """Chi2, negative half gradient and half Hessian of some groups."""
        n, g = len(params), params.shape[1] // 3
        stars = params[:, :-1].reshape(-1, 3)
        light, by = self.psf.light(stars, np.repeat(self.centres[rows], g, axis=0), self.half, slopes=True)
        root = self.root[rows]
        left = self.target[rows] - light.reshape(n, g, -1).sum(axis=1) * root
        slopes = np.zeros((n, 3 * g + 1, root.shape[1]))
        slopes[:, :-1] = by.reshape(n, 3 * g, -1) * root[:, None]
        return (left**2).sum(axis=1), (slopes @ left[:, :, None])[:, :, 0], slopes @ slopes.swapaxes(1, 2)


def doubtful(scene, peaks, rows):
    """Stars among some that may be two: what is left of their core exceeds the noise, or has a peak; a mask (n,).

    Parameters
    ----------
    scene : `~legdistort.measurement.scene.joint_fit.Scene`
    peaks : ndarray, shape (m, 2)
        Of what is left.
    rows : ndarray of int, shape (n,)
    """
    out = (scene.core_chi2(rows) > _CORE_CHI2) & (scene.snr(rows) > 10)
    if len(peaks):
        out |= np.isin(rows, cKDTree(scene.xy).query(peaks, distance_upper_bound=scene.fwhm)[1])
    return out


def pairs(scene, rows):
    """Some stars fitted as two each, the others as they are.

    Parameters
    ----------
    scene : `~legdistort.measurement.scene.joint_fit.Scene`
    rows : ndarray of int, shape (n,)

    Returns
    -------
    params : ndarray, shape (n, 2, 3)
        x, y [pix, in the frame], flux.
    gain : ndarray, shape (n,)
        By how much chi2 falls; 0 where the two are no pair.
    """
    half, fwhm = scene.half, scene.psf.fwhm
    out, gains = np.zeros((len(rows), 2, 3)), np.zeros(len(rows))
    for i in range(0, len(rows), 100):
        part = slice(i, i + 100)
        own, centres = scene.stars(rows[part])
        pixels, inside = stamp_pixels(centres, half, scene.light.shape)
        left = scene.residual_at(pixels)
        data = left + scene.psf.light(own, centres, half)
        weights = np.where(inside, scene.weights.ravel()[pixels], 0)
        problem = _Stamps(scene.psf, centres, data, weights, half)
        single = _minimised(problem, own)
        axis = _axis(left * scene.near(own), own, half)
        best = single[1].copy()
        for ratio in _RATIOS:
            shares = np.array([ratio, 1 - ratio])
            start = np.repeat(own[:, None], 2, axis=1)
            start[..., 2] *= shares
            start[:, 0, :2] += (1 - ratio) * _APART * fwhm * axis
            start[:, 1, :2] -= ratio * _APART * fwhm * axis
            params, chi2 = _minimised(problem, start.reshape(len(own), 6))
            params = params.reshape(-1, 2, 3)
            apart = np.hypot(*(params[:, 0, :2] - params[:, 1, :2]).T)
            proper = (params[..., 2] > 0).all(axis=1) & (apart > _CLOSEST * fwhm) & (apart < _FARTHEST * fwhm)
            better = proper & (chi2 < best)
            best[better], out[part][better] = chi2[better], params[better]
        out[part][..., :2] += centres[:, None]
        gains[part] = single[1] - best
    return out, gains


def _minimised(problem, start):
    start = np.pad(start, ((0, 0), (0, 1)))
    prior = np.zeros_like(start), np.append(np.zeros(start.shape[1] - 1), _FLAT)
    params, _, chi2, _ = minimise(problem, start, prior=prior, bounds=_FREE, limits=_LIMITS)
    return params[:, :-1], chi2


def _axis(left, own, half):
    """Principal axes of what is left around stars, unit vectors (n, 2)."""
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    u, v = dx - own[:, :1], dy - own[:, 1:2]
    xx, yy, xy = ((left * product).sum(axis=1) for product in (u * u, v * v, u * v))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return np.column_stack([np.cos(angle), np.sin(angle)])
