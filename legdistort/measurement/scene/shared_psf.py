"""The PSF that the stars of a crowded frame share, from the bright ones of them, the light of the others taken off."""

from dataclasses import replace

import numpy as np

from ..flags import Flag
from ..profiles import moffat
from ..profiles.cutouts import Stamps
from ..profiles.frame_fit import FrameFit, is_hot, pixel_flags
from ..profiles.levenberg_marquardt import fit
from ..profiles.pixel_noise import NEIGHBOUR, pixel_variance
from .moffat_field import MoffatField

_BRIGHT = 20.0  # signal-to-noise ratio of stars that determine the PSF
_MOST = 300
_DISTURBED = 0.3  # light of others in the core, relative to that of the star
_LEFT = 0.2  # of the error that a neighbour subtracted at first leaves: here all have been fitted


def profiles(scene, shape):
    """Moffat profiles of their own of the bright stars that others disturb little, all others taken off.

    Parameters
    ----------
    scene : `~legdistort.measurement.scene.joint_fit.Scene`
        With the stars that are known.
    shape : ndarray, shape (4,)
        Of the stars of the frame.

    Returns
    -------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
        Around them.
    fitted : `~legdistort.measurement.profiles.frame_fit.FrameFit`
    """
    return _fitted(scene, _bright(scene), shape)


def moffat_field(scene, shape, degree):
    """Moffat profiles of the shapes that bright stars show, a polynomial of this degree over the field."""
    stamps, fitted = profiles(scene, shape)
    found = fitted.found
    shapes, covariance = found.params[:, 3:7], found.covariance[:, 3:7, 3:7]
    xy, use = stamps.centres + found.params[:, :2], found.converged & (fitted.flags == 0)
    size = scene.light.shape
    return MoffatField.of_stars(shapes, covariance, xy, use, size=size, degree=degree, fallback=shape)


def _bright(scene):
    """Bright stars that others disturb little; the brightest first."""
    snr, light = scene.snr(), scene.light.ravel()
    order = np.argsort(-snr, kind="stable")
    order = order[~scene.spread[order].any(axis=(1, 2))]
    rows = order[snr[order] > _BRIGHT][: 4 * _MOST]
    params, centres, pixels, inside = scene.on_stamps(rows)
    near = scene.near(params) & inside
    own, both = ((near * each).sum(axis=1) for each in (scene.psf.light(params, centres, scene.half), light[pixels]))
    return rows[both < (1 + _DISTURBED) * own][:_MOST]


def _fitted(scene, rows, shape):
    """Cut-outs of some stars alone, and Moffat profiles of their own fitted to them."""
    params, centres, _, _ = scene.on_stamps(rows)
    theirs = scene.light_of(rows)
    stamps = Stamps(replace(scene.frame, signal=(scene.residual + theirs).astype(np.float32)), centres, scene.half)
    own = scene.psf.light(params, centres, scene.half).astype(stamps.data.dtype)
    others = np.where(stamps.inside, stamps.cut(theirs.astype(own.dtype)) - own, 0)
    there = stamps.cut(scene.light.astype(own.dtype))  # all light has its photon noise
    sky = stamps.variance + scene.photon * np.maximum(there - own - others, 0)
    variance = pixel_variance((sky, scene.photon), own + others) + (_LEFT * NEIGHBOUR * others) ** 2
    nodes = moffat.quadrature(float(moffat.fwhm(shape)))
    start = moffat.parameters(np.maximum(own.max(axis=1), 1e-30), shape, params[:, :2])
    weights = np.where(stamps.good, 1 / variance, 0.0)
    found = fit(stamps.data - others, weights, start, nodes=nodes, centre=shape)
    own = moffat.evaluate(found.params.astype(own.dtype), scene.half, nodes)
    models, width = (own, others), float(moffat.fwhm(shape))
    hot = is_hot(stamps, models, found.params[:, 7:], stamps.good)
    bad = Flag.SATURATED | Flag.EDGE | Flag.MASKED
    flags = np.where(hot, Flag.HOT, 0) | (pixel_flags(stamps, found.params, stamps.good, width) & bad)
    snr = np.sqrt((weights * own**2).sum(axis=1))
    return stamps, FrameFit(found, flags, snr, models, np.arange(len(rows)), sky, scene.photon)
