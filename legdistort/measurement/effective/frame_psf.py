"""All stars of a frame measured with an effective PSF: made from its own stars, or given.

The brightest usable stars decide whether that is worth while. If Moffat profiles leave no more than noise of them,
there is nothing to be gained. Otherwise an effective PSF is made from one half of the stars, and has to describe the
other half better than Moffat profiles do that were fitted to these very stars.
"""

import logging
from typing import NamedTuple

import numpy as np

from ..flags import UNUSABLE, Flag
from ..profiles import moffat
from ..profiles.levenberg_marquardt import Fit
from ..profiles.local_sky import separate
from ..profiles.pixel_noise import NEIGHBOUR, pixel_variance
from . import building, fitting, splines
from .own_error import own_covariance

_BRIGHT = 10.0  # signal-to-noise ratio of a star that helps to make the PSF
_DISTURBED = 0.05  # light of others within one FWHM, relative to that of the star
_MOST = 100  # stars that make the PSF, the brightest
_SLOPED = 1 / 4  # of the stars, on a sky that is not flat: the PSF is made anew, without the slopes
_DEVIATES = 0.1  # fraction of a star by which pixels may deviate from the PSF

_DECIDE = 60  # brightest usable stars that decide whether the PSF is worth while
_NOTHING_LEFT = 1.25  # median chi2 / dof that Moffat profiles leave of them, by noise and its estimate alone
_GAIN = 0.9  # of the excess of chi2 / dof over 1 with Moffat profiles: held out, the PSF must leave less

log = logging.getLogger(__name__)


class Verdict(NamedTuple):
    """With what a frame was measured, and why.

    Attributes
    ----------
    psf : str
        "moffat", "effective", or the source of a PSF from elsewhere.
    n_usable : float
        Stars from which an effective PSF can be made; infinite if it was not computed.
    decided : bool
        Whether the stars of the frame decided it.
    """

    psf: str
    n_usable: float = np.inf
    decided: bool = False


class Measured(NamedTuple):
    """Stars of a frame measured with a PSF, one row a star.

    Attributes
    ----------
    fit : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        x, y of the core-weighted centre (from the central pixel), flux, background; errors with those of the PSF.
    snr : ndarray, shape (n,)
    astray : ndarray of bool, shape (n,)
        Positions far from the detection.
    psf : `~legdistort.measurement.effective.model.EffectivePSF`
    misfit : float
        Part of their light by which bright stars deviate from a PSF of their own: its error, which is in their errors.
    """

    fit: Fit
    snr: np.ndarray
    astray: np.ndarray
    psf: object
    misfit: float


def measure_frame(stamps, fitted, shape, psf):
    """Measure a frame with the PSF that is asked for, or is best.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    fitted : `~legdistort.measurement.profiles.frame_fit.FrameFit`
        All stars, fitted with Moffat profiles.
    shape : ndarray, shape (4,)
        Moffat profile of the frame.
    psf : {"auto", "moffat", "effective"} or `~legdistort.measurement.effective.model.EffectivePSF`

    Returns
    -------
    measured : Measured or None
        None if the Moffat profiles stand.
    verdict : Verdict
    """
    if not isinstance(psf, str):
        fit = fit_all(stamps, fitted, started(fitted, psf), psf, models=fitted.models)
        return measure_with(stamps, fitted, fit, psf), Verdict(psf.source)
    first, rows, verdict = judged(stamps, fitted, shape, psf)
    if first is None:
        return None, verdict
    built, start = make_psf(stamps, fitted, first, rows)
    return measure_with(stamps, fitted, start, built.psf, built), verdict


def judged(stamps, fitted, shape, psf):
    """Whether an effective PSF is asked for and can be made, or describes the stars better than Moffat profiles.

    Parameters
    ----------
    stamps, fitted, shape
        As of `measure_frame`; the stars from which a PSF can be made suffice.
    psf : {"auto", "moffat", "effective"}

    Returns
    -------
    first : `~legdistort.measurement.effective.building.Built` or None
        A PSF from some of the stars; None if the Moffat profiles stand.
    rows : ndarray of int
        Stars from which a PSF can be made.
    verdict : Verdict
    """
    none = np.zeros(0, dtype=int)
    if psf == "moffat":
        return None, none, Verdict("moffat")
    rows = usable_stars(stamps, fitted, float(moffat.fwhm(shape)))
    if len(rows) < building.STARS_NEEDED:
        return None, none, Verdict("moffat", len(rows))
    if psf == "auto" and _leaves_nothing(fitted, rows):
        return None, none, Verdict("moffat", len(rows), decided=True)
    # too few to be divided: then the stars that make the PSF judge it, too
    brightest = rows[:_DECIDE]
    making, judging = (brightest[1::2], brightest[::2]) if len(rows) >= 2 * building.STARS_NEEDED else (rows, rows)
    first = _first_psf(stamps, fitted, making)
    if psf == "auto" and not _is_better(stamps, fitted, first.psf, judging):
        return None, none, Verdict("moffat", len(rows), decided=True)
    return first, rows, Verdict("effective", len(rows), decided=True)


def _chi2_of_moffat(fitted, rows):
    """Median of chi2 / dof of the brighter half of some stars, the brightest first."""
    return np.median((fitted.found.chi2[rows] / np.maximum(fitted.found.dof[rows], 1))[: len(rows) // 2])


def _leaves_nothing(fitted, rows):
    """Whether Moffat profiles leave no more than noise of the brightest stars."""
    left = _chi2_of_moffat(fitted, rows[:_DECIDE])
    log.debug("Moffat profiles leave chi2 / dof %.2f of the brighter stars", left)
    return left < _NOTHING_LEFT


def _is_better(stamps, fitted, psf, judging):
    """Whether a PSF describes stars that it was not made from better than Moffat profiles of their own."""
    left, start = _chi2_of_moffat(fitted, judging), started(fitted, psf).params[judging]
    _, chi2, dof = building.settled(ensemble(stamps, fitted, judging, fitted.models[1]), start, psf)
    held_out = np.median((chi2 / dof)[: len(judging) // 2])
    log.debug("chi2 / dof of the brighter stars: Moffat %.2f, effective PSF of other stars %.2f", left, held_out)
    return bool(held_out - 1 < _GAIN * (left - 1))


def usable_stars(stamps, fitted, width):
    """Bright, isolated, unsaturated stars from which a PSF can be made, the brightest first; ndarray of int."""
    spoilt = UNUSABLE | Flag.HOT | Flag.SHARED_SHAPE | Flag.MASKED
    near = stamps.near(fitted.found.params, width)
    own, others = (np.where(near, light, 0).sum(axis=1) for light in fitted.models)
    good = ((fitted.flags & spoilt) == 0) & (fitted.snr > _BRIGHT) & (others < _DISTURBED * own)
    good &= ~(stamps.saturated.any(axis=1)) & (fitted.labels >= 0)
    rows = np.flatnonzero(good)
    return rows[np.argsort(-fitted.snr[rows], kind="stable")]


def make_psf(stamps, fitted, first, rows):
    """An effective PSF made anew from more stars, neighbours and slopes of the sky taken off by means of a first one.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    fitted : `~legdistort.measurement.profiles.frame_fit.FrameFit`
    first : `~legdistort.measurement.effective.building.Built`
    rows : ndarray of int
        From `usable_stars`; enough of them (`building.STARS_NEEDED`).

    Returns
    -------
    built : `~legdistort.measurement.effective.building.Built`
    fit : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        All stars, fitted with the first PSF.
    """
    rows = rows[:_MOST]
    fit = fit_all(stamps, fitted, started(fitted, first.psf), first.psf, models=fitted.models)
    models = fitting.light_of(first.psf, stamps, fit.params)
    slope = _separate(stamps, fitted, fit, first.psf, models)[2]
    if slope[rows].any(axis=1).mean() < _SLOPED:
        slope = None
    stars = ensemble(stamps, fitted, rows, models[1], slope)
    return building.improved(first.for_stars(fit.params[rows]), stars), fit


def _first_psf(stamps, fitted, rows):
    """An effective PSF from some stars, the brightest first, their neighbours subtracted as Moffat profiles.

    It starts from the shape of the brightest ones: only these determine the wings, which reach beyond the corrections.
    """
    brightest = rows[: max(len(rows) // 3, building.STARS_NEEDED // 2)]
    shape = np.median(fitted.found.params[brightest, 3:7], axis=0)
    base = building.profile_psf(shape, stamps.half, stamps.frame.signal.shape)
    start = started(fitted, base).params[rows]
    return building.build(ensemble(stamps, fitted, rows, fitted.models[1]), start, base)


def started(fitted, psf):
    """Moffat fits as start values for a PSF: x, y of the middle of its grid, flux, background."""
    found = fitted.found
    unit = splines.on_stamps(psf.grids(psf.middle), psf.centre(psf.middle), 0, psf.spacing)[0, 0]
    params = np.column_stack([found.params[:, :3], found.params[:, 7]])
    params[:, :2] -= psf.centre(psf.middle)
    params[:, 2] /= unit
    keep = [0, 1, 2, 7]
    covariance = found.covariance[:, keep][:, :, keep]
    return Fit(params, covariance, found.chi2, found.dof, found.converged)


def ensemble(stamps, fitted, rows, others, slope=None):
    """Some stars of a frame, with the light of the others, and the slope of the sky, taken off."""
    others = others[rows].astype(float)
    data = stamps.data[rows] - others - (0 if slope is None else slope[rows])
    sky = pixel_variance((fitted.sky[rows], fitted.photon), others) + (NEIGHBOUR * others) ** 2
    return building.Ensemble(stamps.centres[rows], data, np.where(stamps.good[rows], sky, np.inf), float(fitted.photon))


def fit_all(stamps, fitted, fit, psf, *, models):
    """All stars fitted with a PSF, those that touch together, the light of the others taken off.

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    fitted : `~legdistort.measurement.profiles.frame_fit.FrameFit`
    fit : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        Start: x, y, flux, background.
    psf : `~legdistort.measurement.effective.model.EffectivePSF`
    models : tuple of ndarray
        Light of the stars and of all others, on the stamps.

    Returns
    -------
    `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
    """
    pixels = _separate(stamps, fitted, fit, psf, models)[:2]
    return fitting.fit_stars(fit, fitted.labels, pixels, stamps=stamps, psf=psf)


def _separate(stamps, fitted, fit, psf, models):
    """See `separate`; where the models are still Moffat profiles, what they leave determines no slope of the sky."""
    partners = fitting.light_of_partners(psf, stamps, fitted.labels, fit.params)

    def derivatives(rows):
        return fitting.derivatives(psf, stamps, fit.params, rows)

    return separate(
        stamps, models, partners, fit.params[:, 3:], (fitted.sky, fitted.photon),
        deviates=_DEVIATES, derivatives=None if models is fitted.models else derivatives,
        core=stamps.near(fit.params, psf.fwhm / 2),
    )  # fmt: skip


def measure_with(stamps, fitted, fit, psf, built=None):
    """Final fit of all stars with a PSF, errors with its own.

    Parameters
    ----------
    stamps, fitted, fit, psf
        As for `fit_all`.
    built : `~legdistort.measurement.effective.building.Built`, optional
        What the PSF leaves open; None = it is exact.

    Returns
    -------
    Measured
    """
    models = fitting.light_of(psf, stamps, fit.params)
    data, weights, _ = _separate(stamps, fitted, fit, psf, models)
    fit = fitting.fit_stars(fit, fitted.labels, (data, weights), stamps=stamps, psf=psf)
    own, others = fitting.light_of(psf, stamps, fit.params)
    snr = np.sqrt((weights * own**2).sum(axis=1))
    params, covariance = fit.params.copy(), fit.covariance.copy()
    if built is not None:
        rows = np.flatnonzero(fit.converged & (fitted.labels >= 0) & (params[:, 2] > 0))
        stars = ensemble(stamps, fitted, rows, others)
        covariance[rows, :2, :2] += own_covariance(built, stars, params[rows], covariance[rows])
    params[:, :2] += psf.centre(stamps.centres + params[:, :2])
    astray = np.hypot(*params[:, :2].T) > 1 + psf.fwhm / 2
    misfit = 0.0 if built is None else built.misfit
    return Measured(Fit(params, covariance, fit.chi2, fit.dof, fit.converged), snr, astray, psf, misfit)
