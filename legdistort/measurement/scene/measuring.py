"""The stars of a crowded frame measured: one PSF for all, fitted together, searched for until none is left."""

from dataclasses import replace
from functools import partial

import numpy as np

from ..detections import FrameStars, Stars
from ..effective.frame_psf import Verdict, judged
from ..filters import fill_bad
from ..flags import LEAST, Flag
from ..profiles import frame_fit, moffat
from ..profiles.cutouts import Stamps
from ..profiles.pixel_noise import photon_noise
from .confusion import confusion
from .joint_fit import Scene
from .moffat_field import MoffatField
from .search import search
from .shared_psf import moffat_field, profiles

_DIRTY = 0.1  # of the detections, hot pixels and hits of particles: in crowds of stars they are some per cent
_SHARP = 0.6  # of the width of stars: what is narrower is none
_DEFORMED = 4.0  # chi2 of a core that is no single star's
_DEGREE = {"own": 2, "linear": 1, "shared": 0}


def measure_crowd(stamps, shape, options, psf):
    """All stars of a crowded frame.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
        Around the detections.
    shape : ndarray, shape (4,)
        Of the stars of the frame.
    options : `~legdistort.measurement.options.MeasureOptions`
    psf : {"auto", "moffat", "effective"} or EffectivePSF

    Returns
    -------
    `~legdistort.measurement.detections.FrameStars` or None
        None if no star stays, hits of particles pass for a crowd, or the stars ask for an effective PSF of their own:
        it ends some 3 FWHM from a star, and what is left of their light beyond would pass for stars.
    """
    if psf == "effective":
        return None
    width = float(moffat.fwhm(shape))
    found, models, noise = frame_fit.first_pass(stamps, shape, moffat.quadrature(width))
    sharp = moffat.fwhm(found.params) < _SHARP * width
    hits = frame_fit.is_hot(stamps, models, found.params[:, 7:], stamps.good)
    if np.count_nonzero(hits) > _DIRTY * len(hits):  # others are pieces of them, side by side as stars of a crowd are
        return None
    hot = sharp & hits
    frame = _without(stamps.frame, stamps.centres[hot])
    known = not isinstance(psf, str)
    scene = Scene(frame, psf if known else MoffatField.constant(shape, frame.signal.shape), stamps.half, noise[1])
    xy = stamps.centres + np.clip(found.params[:, :2], -1, 1) - scene.psf.centre(stamps.centres)
    peak = scene.unit(scene.psf, 0)[0, 0]
    scene.add(xy[~hot], np.maximum(found.params[~hot, 2], LEAST * scene.noise) / peak)
    verdict = Verdict(psf.source) if known else _verdict(scene, shape, psf)
    if verdict.psf == "effective":
        return None

    def retune(scene):
        scene.use(moffat_field(scene, shape, _DEGREE[options.profile]))

    search(scene, max(LEAST, options.threshold), None if known else retune)
    if not len(scene.flux):
        return None
    there, stars = _measured(scene, options.threshold)
    shown = partial(photon_noise, stamps, found, models, moffat.quadrature(width))
    return FrameStars(there, stars, verdict, psf if known else None, noise[1], shown)


def _verdict(scene, shape, psf):
    """Whether the stars are Moffat profiles, once each has been fitted."""
    scene.fit(np.ones(len(scene.flux), dtype=bool), 4)
    scene.update_sky()
    return judged(*profiles(scene, shape), shape, psf)[-1]


def _without(frame, pixels):
    """The frame with some pixels, and those beside them, marked as defects."""
    if not len(pixels):
        return frame
    new = np.zeros(frame.signal.shape, dtype=bool)
    for x, y in pixels:
        new[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = True
    defects = new if frame.defects is None else new | frame.defects
    bad = ~frame.good | frame.saturated | defects
    return replace(frame, defects=defects, signal=fill_bad(frame.signal, bad, of=new & frame.good))


def _measured(scene, threshold):
    """Stamps around the stars, and `Stars`."""
    params, centres, _, _ = scene.on_stamps(np.arange(len(scene.flux)))
    snr, chi2, covariance, fwhm = scene.snr(), scene.core_chi2(), scene.covariance(), scene.psf.fwhm
    unseen = confusion(scene.xy, scene.flux, snr, sigma=fwhm / 2.3548, threshold=threshold, area=scene.light.size)
    flux_err = np.sqrt(np.maximum(covariance[:, 2, 2], 0))
    stamps = Stamps(scene.frame, centres, scene.half)
    flags = frame_fit.pixel_flags(stamps, params, stamps.good, fwhm)
    flags |= np.where(snr < LEAST, Flag.INSIGNIFICANT, 0) | np.where(chi2 > _DEFORMED, Flag.DEFORMED, 0)
    dof = np.maximum((scene.near(params) & stamps.good).sum(axis=1), 1)
    xy = params[:, :2] + scene.psf.centre(scene.xy)
    width = np.full(len(xy), fwhm)
    stars = Stars(
        xy, covariance[:, :2, :2], params[:, 2], flux_err, width, chi2 * dof, dof, snr, flags, confusion=unseen
    )
    return stamps, stars
