"""All stars of a frame fitted: neighbours subtracted, noise from the model, hot pixels distinguished from stars."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..flags import LEAST, Flag
from . import moffat
from .blends import fit_groups, group_stars, partner_models
from .first_fit import fit_once, point_chi2, started, weighted
from .levenberg_marquardt import HELD, SHAPE_SIGMA, Fit, Limits, fit
from .local_sky import separate
from .pixel_noise import pixel_noise
from .shape_field import shape_field

_DEVIATES = 0.2  # fraction of a star by which pixels may deviate from a Moffat profile
#: Limits of the passes after the first: the second prepares the last.
_MIDDLE, _LAST = Limits(20, 1e-2), Limits(40, 1e-4)
_SHAPELY = 20  # signal-to-noise ratio of stars that determine the shape of all
_GAP = 1 / 3  # part of the pixels within one FWHM that may be missing
_WIDE = 3  # times the width of the stars of the frame, or less than its inverse: no star
_WANDERS = 0.75  # FWHM from the peak: a cosmic ray beside a star draws the peak away by half a FWHM and more


class FrameFit(NamedTuple):
    """All stars of a frame fitted, one row a star: what `fit_stars` returns.

    Attributes
    ----------
    found : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
    flags : ndarray of int, shape (n,)
    snr : ndarray, shape (n,)
        Signal-to-noise ratio of the flux at known shape.
    models : tuple of ndarray, shape (n, npix)
        Every star on its own stamp, and the sum of all others there.
    labels : ndarray of int, shape (n,)
        Numbers of the groups that were fitted together; negative ones were not fitted in the last pass.
    sky : ndarray, shape (n, npix)
        Variance of the sky.
    photon : float
        Variance per unit of star light.
    """

    found: Fit
    flags: np.ndarray
    snr: np.ndarray
    models: tuple
    labels: np.ndarray
    sky: np.ndarray
    photon: float


def fit_stars(stamps, shape, *, profile="own", blends="together"):
    """Fit all stars of a frame in three passes.

    The first has the noise of the sky alone; the others add the photon noise of the models of the pass
    before, fit stars that touch together, subtract the models of the other neighbours and leave out pixels that
    follow none.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
        Around the detections.
    shape : ndarray, shape (4,)
        Of the stars of the frame.
    profile : {"own", "shared", "linear"}
        In the last pass every star has a shape of its own, or that of the frame, or one that varies linearly over it.
    blends : {"together", "alone"}
        Whether stars within two FWHM of each other are fitted together, with one shape and one background.

    Returns
    -------
    FrameFit
    """
    width = float(moffat.fwhm(shape))
    nodes = moffat.quadrature(width)
    found, models, noise = first_pass(stamps, shape, nodes)
    radius = min(2 * width, stamps.half) if blends == "together" else 0.0
    hot, weights = is_hot(stamps, models, found.params[:, 7:], stamps.good), None
    done = hot & (moffat.fwhm(found.params) < 0.6 * width)
    centre, sigma = shape, SHAPE_SIGMA
    for last in (False, True):
        if last and profile != "own":
            use = ~hot & ~_is_wild(found, width) & (_ratio(models, weights) > _SHAPELY)
            xy = stamps.centres + found.params[:, :2]
            known = found.params[:, 3:7], found.covariance[:, 3:7, 3:7]
            centre = shape_field(*known, xy, use, degree=int(profile == "linear"), fallback=shape)[0]
            sigma = HELD
        labels = _touching(stamps, found, hot, done, radius)
        pixels = _, weights = _separate(stamps, found, models, labels, noise, nodes)
        start = np.where(_is_wild(found, width)[:, None], started(stamps, shape), found.params)
        fitting = partial(fit, nodes=nodes, sigma=sigma, limits=_LAST if last else _MIDDLE)
        found = fit_groups(found, labels, pixels, start, stamps=stamps, centre=centre, fitting=fitting)
        found = _without_wide(stamps, found, shape)
        models = stamps.models(found.params, nodes)
        done = is_hot(stamps, models, found.params[:, 7:], weights > 0)
        hot = done | (hot if sigma is HELD else moffat.fwhm(found.params) < 0.6 * width)
    wild = _is_wild(found, width) & ~done
    if wild.any():
        known = np.broadcast_to(centre, (len(hot), 4))[wild]
        found = _share_shape(stamps.data - models[1], weights, found, wild, shape=known, nodes=nodes)
        models[0][wild] = moffat.evaluate(found.params[wild], stamps.half, nodes)
        hot[wild] |= is_hot(stamps, models, found.params[:, 7:], weights > 0)[wild]
    snr = _ratio(models, weights)
    flags = _flags(stamps, found, weights > 0, (wild, hot, snr), width)
    return FrameFit(found, flags, snr, models, labels, *noise)


def photon_noise(stamps, shape):
    """Variance per unit of star light, as `fit_stars` takes it, by its first pass alone."""
    return first_pass(stamps, shape, moffat.quadrature(float(moffat.fwhm(shape))))[2][1]


def first_pass(stamps, shape, nodes):
    """Stars fitted one by one with the noise of the sky alone.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    shape : ndarray, shape (4,)
        Of the stars of the frame.
    nodes : tuple
        From `legdistort.measurement.profiles.moffat.quadrature`.

    Returns
    -------
    found : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
    models : tuple of ndarray, shape (n, npix)
        Every star on its own stamp, and the sum of all others there.
    noise : tuple
        From `legdistort.measurement.profiles.pixel_noise.pixel_noise`.
    """
    found = _without_wide(stamps, fit_once(stamps, shape, nodes)[0], shape)
    models = stamps.models(found.params, nodes)
    return found, models, pixel_noise(stamps, found, models, nodes)


def _without_wide(stamps, found, shape):
    """Fits wider than any star, which took up what neighbours leave of the sky, put back to their start."""
    wide = moffat.fwhm(found.params) > _WIDE * moffat.fwhm(shape)
    params = np.where(wide[:, None], started(stamps, shape), found.params)
    return replace(found, params=params, converged=found.converged & ~wide)


def _ratio(models, weights):
    """Signal-to-noise ratio of the flux at known shape."""
    return np.sqrt((weights * models[0] ** 2).sum(axis=1))


def _flags(stamps, found, good, troubles, width):
    wild, hot, snr = troubles
    raised = {
        Flag.SHARED_SHAPE: wild,
        Flag.HOT: hot,
        Flag.NOT_CONVERGED: _is_wild(found, width),
        Flag.INSIGNIFICANT: snr < LEAST,
    }
    return sum(np.where(stars, flag, 0) for flag, stars in raised.items()) + pixel_flags(
        stamps, found.params, good, width
    )


def pixel_flags(stamps, params, good, width):
    """Flags of stars for what is wrong with the pixels within one width; `good` (n, npix) are those that count."""
    near = stamps.near(params, width)
    seen = stamps.inside & stamps.cut(stamps.frame.good)
    raised = {
        Flag.MASKED: (near & stamps.inside & ~good & ~stamps.saturated).any(axis=1),
        Flag.DEFECT: (near & stamps.defects).any(axis=1),
        Flag.SATURATED: (near & stamps.saturated).any(axis=1),
        Flag.EDGE: (near & ~seen).sum(axis=1) > _GAP * near.sum(axis=1),
    }
    return sum(np.where(stars, flag, 0) for flag, stars in raised.items())


def _touching(stamps, found, hot, done, radius):
    """Numbers of the groups to be fitted together, -1 for no fit; what is no star or has lost its peak stays alone."""
    labels = np.arange(len(hot))
    stars = ~hot & ~(stamps.saturated & stamps.near(found.params, radius / 2)).any(axis=1)
    if radius > 0 and stars.any():
        labels[stars] = len(hot) + group_stars(stamps.centres[stars], radius)
    return np.where(done, -1, labels)


def _separate(stamps, found, models, labels, noise, nodes):
    """Stamps less other groups and the slope of the sky, and weights; 0 for pixels that follow no model."""
    partners = partner_models(stamps, labels, found.params, lambda p, _: moffat.evaluate(p, stamps.half, nodes))

    def derivatives(rows):
        return moffat.evaluate(found.params[rows].astype(stamps.data.dtype), stamps.half, nodes, jacobian=True)[1]

    prior = np.pad(SHAPE_SIGMA**-2, (3, 1))
    return separate(
        stamps, models, partners, found.params[:, 7:], noise,
        deviates=_DEVIATES, derivatives=derivatives, precision=prior,
    )[:2]  # fmt: skip


def is_hot(stamps, models, background, good):
    """Whether stars are explained better by one bright pixel than by their models, with a background (n, 1); (n,)."""
    data, weights = stamps.data - models[1], weighted(good, stamps.variance)
    residual = data - models[0] - background
    return point_chi2(data, weights)[:, 0] <= (weights * residual**2).sum(axis=1)


def _is_wild(fit, width):
    narrow = moffat.fwhm(fit.params) < width / _WIDE
    shift = np.hypot(fit.params[:, 0], fit.params[:, 1])
    return ~fit.converged | (fit.params[:, 2] <= 0) | narrow | (shift > 1 + _WANDERS * width)


def _share_shape(data, weights, found, rows, *, shape, nodes):
    """The fit with some stars fitted anew and alone, their shape held at that of the frame."""
    data = data[rows]
    start = moffat.parameters(np.maximum(found.params[rows, 2], 1e-3 * np.abs(data).max(axis=1)), shape)
    return found.updated(rows, fit(data, weights[rows], start, nodes=nodes, centre=shape, sigma=HELD))
