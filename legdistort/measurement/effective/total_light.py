"""All light of the stars of a frame, over that which their PSF holds: what lies in the halos, out to 30 FWHM.

A PSF made from stars ends some FWHM from them, and the local sky of every star takes its halo. What all stars leave is
the sky of the frame, a plane, and one halo, in rings around each, in proportion to its flux: a linear fit.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..sky.smooth_light import binned

#: FWHM. What is on the last one is no part of the flux, and none of the sky.
_RINGS = np.array([0, 3, 4.5, 6.5, 9, 12.5, 17, 22, 30, 45])
_CORE = 1.5  # FWHM: nearer to a star, what its PSF leaves is an error of that
_BIN = 1.5  # pixels that make a FWHM once they are binned
_PIXELS = 600_000  # binned, at most
_CLIP, _PASSES = 30.0, 3  # standard deviations of what is left, beyond which it is no halo
_BLOCKS = 4  # along x and y: their scatter is the error
_AT_ONCE = 200  # stars whose light is made at once
_MOST = 300  # stars, the brightest: fainter ones hold little of the light
#: Relative error from which the halos are not determined.
UNKNOWN = 0.2


def in_total_light(measured, stamps, use):
    """Stars and PSF of a frame with fluxes that hold all light within 30 FWHM.

    Parameters
    ----------
    measured : `~legdistort.measurement.effective.frame_psf.Measured`
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    use : ndarray of bool, shape (n,)
        Which of the rows are stars.

    Returns
    -------
    measured : `~legdistort.measurement.effective.frame_psf.Measured`
    error : float
        Of the factor common to all fluxes, relative; infinite where the frame does not determine it, and the fluxes
        are those in the PSF.
    """
    frame, psf, fit = stamps.frame, measured.psf, measured.fit
    xy = stamps.centres + fit.params[:, :2]
    use = use & (fit.params[:, 2] > 0)
    if not use.any():
        return measured, np.inf
    params = fit.params[:, :3].copy()
    params[:, :2] -= psf.centre(xy)
    image = frame.signal + frame.sky - (0 if frame.levels is None else frame.levels)
    for k in np.array_split(np.flatnonzero(use), -(-np.count_nonzero(use) // _AT_ONCE)):
        stamps.add_to(image, -psf.light(params[k], stamps.centres[k], 2 * stamps.half), k)
    good = frame.good & ~frame.saturated & (True if frame.defects is None else ~frame.defects)
    held = psf.light(np.array([[0.0, 0.0, 1.0]]), np.round(psf.middle).astype(int), 2 * stamps.half).sum()
    more, error = halo_light(image, good, xy[use], params[use, 2], psf.fwhm)
    factor = held + more
    if not error < UNKNOWN * factor:
        return measured, np.inf
    scale = np.array([1.0, 1.0, factor, 1.0])
    fit = replace(fit, params=fit.params * scale, covariance=fit.covariance * scale[:, None] * scale)
    return measured._replace(fit=fit, psf=psf.of_flux(factor)), error / factor


def halo_light(image, good, xy, flux, fwhm):
    """Light within 30 FWHM of stars that is left of them once their PSF has been subtracted, over their fluxes.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        With its sky, without the stars.
    good : ndarray of bool, shape (ny, nx)
    xy : ndarray, shape (n, 2)
        Stars [pix].
    flux : ndarray, shape (n,)
        Positive.
    fwhm : float
        [pix]

    Returns
    -------
    light, error : float
    """
    bright = np.argsort(-flux)[:_MOST]
    xy, flux, highest = xy[bright], flux[bright] / flux.max(), flux.max()
    step = max(2, int(fwhm / _BIN), int(np.ceil(np.sqrt(image.size / _PIXELS))))
    ny, nx = (n // step * step for n in image.shape)
    count, total = (binned(part[:ny, :nx], step) for part in (good.astype(float), np.where(good, image, 0)))
    rings, near = _rings(count.shape, (xy + 0.5) / step - 0.5, flux, fwhm / step)
    y, x = np.indices(count.shape) / np.reshape(count.shape, (2, 1, 1)) - 0.5
    use = (count > step**2 / 2) & ~near
    design = np.stack([np.ones_like(x), x, y, *rings], axis=-1)[use]
    block = (np.floor((y + 0.5) * _BLOCKS) * _BLOCKS + np.floor((x + 0.5) * _BLOCKS)).astype(int)[use]
    light = total[use] / count[use] / highest
    weights, area = np.ones(len(light)), np.pi * np.diff((_RINGS[:-1] * fwhm) ** 2)
    for _ in range(_PASSES):
        normal, right = _by_block(design, light, weights, block)
        left = light - design @ _solved(normal.sum(axis=0), right.sum(axis=0))
        weights = (np.abs(left) < _CLIP * 1.4826 * np.median(np.abs(left))).astype(float)
    normal, right = _by_block(design, light, weights, block)
    whole = area @ _solved(normal.sum(axis=0), right.sum(axis=0))[3:-1]
    parts = np.array(
        [
            area @ _solved(normal.sum(axis=0) - n, right.sum(axis=0) - r)[3:-1]
            for n, r in zip(normal, right, strict=True)
        ]
    )
    return whole, np.sqrt((len(parts) - 1) * np.mean((parts - parts.mean()) ** 2))


def _rings(shape, xy, flux, fwhm):
    """Fluxes of the stars on whose ring a pixel is, (n_rings, ny, nx); whether it is in the core of one."""
    out, near = np.zeros((len(_RINGS) - 1, *shape), dtype=np.float32), np.zeros(shape, dtype=bool)
    half = int(np.ceil(_RINGS[-1] * fwhm))
    for (a, b), light in zip(xy, flux, strict=True):
        left, low = max(round(a) - half, 0), max(round(b) - half, 0)
        there = slice(low, round(b) + half + 1), slice(left, round(a) + half + 1)
        ny, nx = near[there].shape
        r = np.hypot(np.arange(nx) + left - a, (np.arange(ny) + low - b)[:, None]) / fwhm
        near[there] |= r < _CORE
        for ring, (inner, outer) in enumerate(pairwise(_RINGS)):
            out[(ring, *there)] += light * ((r >= inner) & (r < outer))
    return out, near


def _by_block(design, light, weights, block):
    """Normal matrices and right sides of a linear fit, of every block of the image."""
    parts = [np.flatnonzero(block == k) for k in np.unique(block)]
    weighted = design * weights[:, None]
    return tuple(np.array([weighted[k].T @ of[k] for k in parts]) for of in (design, light))


def _solved(normal, right):
    """The solution; 0 for rings that no pixel is on."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.linalg.lstsq(normal / scale / scale[:, None], right / scale, rcond=1e-10)[0] / scale
