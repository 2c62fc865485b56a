"""An effective PSF fitted to all stars of a frame: position, flux and local sky of each."""

import numpy as np

from ..profiles.blends import counted_once, members, partner_models
from ..profiles.levenberg_marquardt import Fit, Limits, minimise
from . import splines

_FREE = (np.array([-np.inf]), np.array([np.inf]))  # bounds of the local sky
_CHUNK = 120_000  # pixels: their slopes stay in the processor's cache
_LIMITS = Limits(40, 1e-4)


class _Pixels:
    """What is fitted: pixels of groups, in units of their noise; see `minimise`."""

    def __init__(self, data, weights, offsets, grids, spacing):
        g = offsets.shape[1]
        self.kind = np.float32 if g == 1 else np.float64
        self.root = np.sqrt(weights).astype(self.kind)
        self.target = np.where(weights > 0, data, 0).astype(self.kind) * self.root
        self.half = (round(np.sqrt(data.shape[1] // g)) - 1) // 2
        self.shift = offsets[:, :, None] - offsets[:, None]  # star i seen from the stamp of star j
        self.dof = np.maximum(np.count_nonzero(weights, axis=1) - 3 * g - 1, 1)
        self.grids, self.spacing = grids.astype(self.kind), spacing  # (n or 1, g or 1, ny, nx)

    def linearise(self, params, rows):
        """Chi2, negative half gradient and half Hessian of some groups."""
        n, g = self.shift[rows].shape[:2]
        stars = params[:, :-1].reshape(n, g, 3)
        xy = stars[:, :, None, :2] + self.shift[rows]  # group, star, stamp
        grids = self.grids if len(self.grids) == 1 else self.grids[rows]
        if g > 1:
            grids = np.broadcast_to(grids[:, :, None], (n, g, g, *grids.shape[-2:]))
        seen = splines.on_stamps(
            grids.reshape(-1, *grids.shape[-2:]), xy.reshape(-1, 2).astype(self.kind), self.half, self.spacing,
            slopes=True,
        )  # fmt: skip
        value, by_x, by_y = (s.reshape(n, g, -1) for s in seen)
        flux = stars[:, :, 2:].astype(self.kind)
        slopes = np.empty((n, 3 * g + 1, value.shape[-1]), dtype=self.kind)
        slopes[:, 0:-1:3], slopes[:, 1:-1:3], slopes[:, 2:-1:3], slopes[:, -1] = flux * by_x, flux * by_y, value, 1
        model = (flux * value).sum(axis=1) + params[:, -1:].astype(self.kind)
        root = self.root[rows]
        r = self.target[rows] - model * root
        slopes *= root[:, None]
        gradient = (slopes @ r[:, :, None])[:, :, 0].astype(float)
        return np.square(r, dtype=float).sum(axis=1), gradient, (slopes @ slopes.swapaxes(1, 2)).astype(float)


def fit_stars(found, labels, pixels, *, stamps, psf, limits=_LIMITS):
    """All groups fitted: x, y, flux of every star, and one local sky a group.

    Parameters
    ----------
    found : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        Start, one row a star, parameters x, y, flux, background.
    labels : ndarray of int, shape (n,)
        Numbers of the groups; stars with a negative one stay as they are.
    pixels : tuple of ndarray, shape (n, npix)
        Stamps with the light of the own group only, and inverse variances.
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    psf : `~legdistort.measurement.effective.model.EffectivePSF`
    limits : Limits

    Returns
    -------
    `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        One row a star: x, y (of the middle of the PSF's grid, from the central pixel), flux, background.
    """
    data, weights = pixels
    for stars in members(labels):
        size = max(1, _CHUNK // (data.shape[1] * stars.shape[1] ** 2))
        for k in range(0, len(stars), size):
            part = stars[k : k + size]
            fitted = _fit_groups(found.params, part, data, weights, stamps=stamps, psf=psf, limits=limits)
            found = found.updated(part.ravel(), fitted.by_star(common=1))
    return found


def _fit_groups(params, stars, data, weights, *, stamps, psf, limits):
    m, g = stars.shape
    data = data[stars].reshape(m, -1)
    weights = counted_once(weights[stars].reshape(m, -1), stamps.index[stars].reshape(m, -1))
    own = params[stars]
    start = np.hstack([own[:, :, :3].reshape(m, -1), own[:, :1, 3]])
    grids = psf.grids((stamps.centres[stars] + own[:, :, :2]).reshape(-1, 2))
    grids = grids[:, None] if len(grids) == 1 else grids.reshape(m, g, *grids.shape[1:])
    problem = _Pixels(data, weights, stamps.centres[stars], grids, psf.spacing)
    # the sky alone has a prior, far too wide to matter: it stands in for stamps without good pixels
    prior = np.zeros_like(start), np.zeros(start.shape[1])
    result = minimise(problem, start, prior=prior, bounds=_FREE, limits=limits)
    dof = np.count_nonzero(weights, axis=1) - start.shape[1]
    return Fit(*result[:3], dof, result[3])


def derivatives(psf, stamps, params, rows):
    """Derivatives of the light of some stars by x, y, flux and background, (m, 4, npix)."""
    kind = stamps.data.dtype
    grids = psf.grids(stamps.centres[rows] + params[rows, :2])
    value, by_x, by_y = splines.on_stamps(grids, params[rows, :2].astype(kind), stamps.half, psf.spacing, slopes=True)
    flux = params[rows, 2:3].astype(kind)
    return np.stack([flux * by_x, flux * by_y, value, np.ones_like(value)], axis=1)


def light_of(psf, stamps, params):
    """Light of every star on its own stamp, and the sum of that of all others there; (n, npix) each."""
    kind, wide = stamps.data.dtype, 2 * stamps.half
    own, total = np.empty_like(stamps.data), np.zeros_like(stamps.frame.signal)
    for k in range(0, len(params), 200):
        rows = slice(k, k + 200)
        grids = psf.grids(stamps.centres[rows] + params[rows, :2])
        values = splines.on_stamps(grids, params[rows, :2].astype(kind), wide, psf.spacing)
        values = values * params[rows, 2:3].astype(kind)
        own[rows] = values[:, stamps.core]
        values[params[rows, 2] <= 0] = 0
        stamps.add_to(total, values, rows)
    others = stamps.cut(total) - np.where(params[:, 2:3] > 0, own, 0)
    return own, np.where(stamps.inside, others, 0)


def light_of_partners(psf, stamps, labels, params):
    """Light that the other stars of its group leave on every stamp, (n, npix)."""

    def evaluate(seen, stars):
        grids = psf.grids(stamps.centres[stars] + params[stars, :2])
        light = splines.on_stamps(grids, seen[:, :2].astype(float), stamps.half, psf.spacing)
        return seen[:, 2:3] * light

    return partner_models(stamps, labels, params, evaluate)
