"""Positions of stars, and how well every one is known."""

import logging
from dataclasses import replace
from functools import partial

import numpy as np
from astropy import units as u
from astropy.table import QTable, vstack
from scipy.spatial import cKDTree

from ..exceptions import AssumptionWarning, warn
from ..inputs.exposure_files import listed
from ..runtime.parallel import map_items
from .crowding import crowding, is_deformed
from .flags import UNUSABLE, Flag
from .injection import calibrate_frame
from .options import MeasureOptions
from .profiles import moffat
from .profiles.cutouts import Stamps
from .profiles.frame_fit import box_half, fit_stars, locate_stars

log = logging.getLogger(__name__)

_COLUMNS = ("x", "y", "x_err", "y_err", "xy_corr", "flux", "flux_err", "fwhm", "chi2")
_PIXELS = ("x", "y", "x_err", "y_err", "fwhm")


def measure(
    exposures,
    *,
    fwhm=None,
    threshold=5.0,
    max_stars=None,
    box=None,
    profile="own",
    blends="together",
    gain=None,
    read_noise=None,
    saturation=None,
    errors="fit",
    workers=None,
    progress=False,
):
    """Detect stars and measure their positions by fitting elliptical Moffat profiles.

    Stars are peaks of the image filtered with a Gaussian of the width of the stars. The profile has eight free
    parameters (`legdistort.measurement.profiles.moffat`); all stars of a frame are fitted at once, three times: with
    the noise of the sky alone, then twice with the photon noise of the model of the pass before and the models of the
    neighbours subtracted. (Photon noise taken from the data instead of a model would bias the fit.) In images
    with stars narrower than 3 pixels the profile is averaged over every pixel.

    Pixel variances are ``uncertainty**2`` if the exposure has that plane, else the observed variance of the sky
    (at least that of the read noise) plus ``star light / gain``. Where the fit leaves more than noise (reduced
    chi2 above 1 by more than chance), errors are scaled up accordingly.

    Parameters
    ----------
    exposures : Exposure or sequence of Exposure
        From `legdistort.read_exposures`, or from `legdistort.open_exposures`: then one at a time is in memory.
    fwhm : float, optional
        Full width at half maximum of the stars [pix]; found in every frame if not given.
    threshold : float
        Detection limit, signal-to-noise ratio of the filtered image.
    max_stars : int, optional
        Keep the brightest so many usable detections of every frame, and no others.
    box : int, optional
        Side of the square fitted [pix], odd; by default about 4 FWHM.
    profile : {"own", "shared", "linear"}
        Whether every star has a shape of its own, or all have the one that the bright stars of the frame have in the
        mean, or one that varies linearly over the field: then a star has four free parameters, and stars near the
        detection limit and fluxes become more precise; ``DEFORMED`` is not flagged.
    blends : {"together", "alone"}
        Whether stars within two FWHM of each other are fitted together, with one shape and one background, or one by
        one with the models of the others subtracted.
    gain, read_noise, saturation : float, optional
        In e-/ADU, e-, ADU; for all exposures instead of what each of them says.
    errors : {"fit", "injected", "scaled"}
        Errors of the positions: of the fit; by the noise curve of every exposure at the star's flux, from stars put
        into it and measured (`legdistort.calibrate_noise`), as in the paper; or those of the fit times the ratio of
        that curve to what fits of this flux state. The latter two take some seconds a frame.
    workers : int, optional
        Processes that share the frames. None = the current ``dask.distributed.Client`` if there is one, else this
        process. The table is the same.
    progress : bool
        Show a progress bar.

    Returns
    -------
    `~astropy.table.QTable`
        One row a detection, brightest first in every exposure: ``exposure``, ``x``, ``y``, ``x_err``, ``y_err`` [pix]
        (0-based, standard deviations), ``xy_corr``, ``flux``, ``flux_err`` (of the whole profile, in units
        of the data), ``fwhm`` [pix], ``chi2`` (reduced), ``flags`` (bits of `Flag`; see `UNUSABLE`),
        ``crowding`` (how far detected neighbours would pull the position, were their light left in, in standard errors:
        see `legdistort.measurement.crowding`). An exposure in which nothing is found has no rows.

    Raises
    ------
    InputError
        For arguments out of range.

    Warns
    -----
    AssumptionWarning
        Once, if exposures lack a gain: the photon noise is then estimated from the residuals of the fits.
    """
    exposures = listed(exposures, "measure")
    options = MeasureOptions(
        fwhm=fwhm, threshold=threshold, max_stars=max_stars, box=box, profile=profile, blends=blends, gain=gain,
        read_noise=read_noise, saturation=saturation, errors=errors,
    )  # fmt: skip
    work = partial(measure_exposure, options=options)
    measured = list(map_items(work, exposures, workers=workers, progress=progress, description="measuring"))
    _warn_of_gain({exposure.name: photon for exposure, (_, photon) in zip(exposures, measured, strict=True)})
    filled = [table for table, _ in measured if len(table)]
    return vstack(filled) if filled else _empty()


def _warn_of_gain(photons):
    """Warn of exposures whose photon noise was estimated: ``{name: variance per unit of light, None if known}``."""
    names = [name for name, photon in photons.items() if photon is not None]
    if names:
        gains = [1 / photon for photon in photons.values() if photon]
        found = f"equivalent gain {min(gains):.3g} to {max(gains):.3g} e-/ADU" if gains else "none could be seen"
        some = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        warn(
            f"no gain known for {some}: photon noise estimated from the residuals of the star fits ({found}); "
            "give gain= or the keyword GAIN to have it exact",
            AssumptionWarning,
        )


def measure_exposure(exposure, options):
    """Detections of one exposure.

    Parameters
    ----------
    exposure : `~legdistort.inputs.exposures.Exposure`
        Or what its ``read()`` gives one for.
    options : `~legdistort.measurement.options.MeasureOptions`

    Returns
    -------
    table : `~astropy.table.QTable`
        As from `measure`.
    photon : float or None
        Variance per unit of star light if it had to be estimated, for want of a gain.
    """
    exposure = options.with_detector(exposure.read())
    table, photon = _measure_frame(exposure, options)
    if options.errors != "fit" and np.any((table["flags"] & UNUSABLE) == 0):

        def remeasure(image, *, fwhm=options.fwhm):
            return _measure_frame(image, replace(options, max_stars=None, fwhm=fwhm))[0]

        table = calibrate_frame(exposure, remeasure, threshold=options.threshold).apply(table, options.errors)
    return table, photon


def _measure_frame(exposure, options):
    """What `measure_exposure` gives, errors as the fits state them."""
    name, max_stars = exposure.name, options.max_stars
    frame, centres, shape = locate_stars(exposure, threshold=options.threshold, fwhm=options.fwhm)
    if len(centres) == 0:
        log.warning("%s: no star above %g times the noise", name, options.threshold)
        return _empty(), None
    if max_stars is not None:
        centres = centres[: 3 * max_stars]  # some will turn out to be hot pixels or saturated
    fwhm = float(moffat.fwhm(shape))
    stamps = Stamps(frame, centres, options.box // 2 if options.box else box_half(fwhm))
    fit, flags, snr, photon = fit_stars(stamps, shape, profile=options.profile, blends=options.blends)
    shapes, covariance = fit.params[:, 3:7], fit.covariance[:, 3:7, 3:7]
    usable = ((flags & UNUSABLE) == 0) & (options.profile == "own")  # other profiles have nothing to compare
    deformed = is_deformed(shapes, covariance, snr=snr, usable=usable)
    table = _table(name, stamps, fit, flags=flags | np.where(deformed, Flag.DEFORMED, 0), snr=snr)
    table = table[_distinct(table, fwhm)]
    table["crowding"] = crowding(table, fwhm)
    if max_stars is not None:
        table = table[(table["flags"] & UNUSABLE) == 0][:max_stars]
    log.info("%s: %d detections, FWHM %.2f px", name, len(table), fwhm)
    known = exposure.gain or exposure.uncertainty is not None or not len(table)
    return table, None if known else photon


def _empty():
    columns = {name: np.zeros(0) * (u.pix if name in _PIXELS else 1) for name in _COLUMNS}
    kinds = {"flags": np.zeros(0, dtype=int), "crowding": np.zeros(0)}
    return QTable({"exposure": np.zeros(0, dtype="U1"), **columns, **kinds})


def _table(name, stamps, fit, *, flags, snr):
    """Table of one frame, brightest first; errors scaled where the fit leaves more than noise."""
    ny, nx = stamps.frame.signal.shape
    dof = np.maximum(fit.dof, 1)
    chi2 = fit.chi2 / dof
    # Three standard deviations of chi2 are allowed for, else chance alone would raise the errors of good fits.
    scale = np.sqrt(np.maximum(1, chi2 - 3 * np.sqrt(2 / dof)))
    flux, flux_err = moffat.flux(fit.params, fit.covariance)
    error = np.sqrt(np.einsum("nii->ni", fit.covariance)[:, :2])
    lost = ~(error < stamps.half).all(axis=1)
    corr = np.where(lost, 0.0, fit.covariance[:, 0, 1] / error.prod(axis=1))
    # Near the detection limit the fit is no longer linear (measured at a ratio of 7: errors 8 to 15 % too small).
    scale *= 1 + 5 / np.maximum(snr, 1) ** 2
    error = np.where(lost[:, None], stamps.half, scale[:, None] * error)
    hot = (flags & Flag.HOT) != 0  # they stay on their pixel: a profile fitted to one pixel wanders off
    xy = stamps.centres + np.where(hot[:, None], 0.0, fit.params[:, :2])
    width = moffat.fwhm(fit.params)
    to_edge = np.minimum(xy + 0.5, np.array([nx, ny]) - 0.5 - xy).min(axis=1)
    flags = flags | np.where(lost, Flag.NOT_CONVERGED, 0) | np.where(to_edge < width, Flag.EDGE, 0)
    columns = (xy[:, 0], xy[:, 1], error[:, 0], error[:, 1], corr, flux, scale * flux_err, width, chi2)
    named = {key: v * u.pix if key in _PIXELS else v for key, v in zip(_COLUMNS, columns, strict=True)}
    table = QTable({"exposure": np.full(len(xy), name), **named, "flags": flags})
    return table[np.argsort(-flux, kind="stable")]


def _distinct(table, fwhm):
    """Rows to keep: of detections that ended on the same star the better one; flags the close pairs that stay."""
    tree = cKDTree(np.column_stack([table["x"].value, table["y"].value]))
    keep = np.ones(len(table), dtype=bool)
    unusable = (table["flags"] & UNUSABLE) != 0
    for i, j in sorted(tree.query_pairs(0.5 * fwhm)):  # i < j: i is the brighter
        if keep[i] and keep[j]:
            keep[i if unusable[i] and not unusable[j] else j] = False
    close = tree.query_pairs(2 * fwhm, output_type="ndarray")
    close = close[keep[close].all(axis=1)]
    table["flags"][close.ravel()] |= Flag.BLENDED
    return keep
