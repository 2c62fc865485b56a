"""Positions of stars, and how well every one is known."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable, vstack

from ..exceptions import AssumptionWarning, InputError, some_of, warn
from ..inputs.exposure_files import listed
from ..inputs.frames.working_units import in_working_unit, noise_unit
from ..runtime import outputs
from ..runtime.guards.units import plain_numbers
from ..runtime.parallel import map_items
from ..runtime.progress import EACH_IMAGE
from . import across_frames, camera_gain
from .crowding import SAME, SHAPELY, crowding, is_crowded, is_deformed
from .detections import FrameStars, MeasuredExposure, Stars, distinct, empty_table, table_of, with_defects
from .effective import frame_psf
from .effective.building import STARS_NEEDED
from .effective.model import EffectivePSF
from .effective.total_light import in_total_light
from .filters import use_compiled_loops
from .flags import LEAST, UNUSABLE, Flag
from .injection import calibrate_frame
from .options import MeasureOptions
from .profiles import frame_fit, moffat, pixel_noise
from .profiles.cutouts import Stamps, box_half
from .profiles.defects import defect_peaks
from .profiles.location import locate_stars

if TYPE_CHECKING:
    from ..inputs.exposures import Exposure
    from ..runtime.annotations import StrPath

log = logging.getLogger(__name__)


@plain_numbers
def measure(
    exposures: Exposure | Sequence[Exposure],
    *,
    fwhm: float | None = None,
    threshold: float = 5.0,
    max_stars: int | None = None,
    box: int | None = None,
    profile: str = "own",
    blends: str = "together",
    gain: float | None = None,
    read_noise: float | None = None,
    saturation: float | None = None,
    errors: str = "fit",
    psf: Any = "auto",
    write_psf: StrPath | None = None,
    workers: int | None = None,
    progress: bool = False,
) -> QTable:
    """Detect stars and measure their positions by fitting elliptical Moffat profiles, or the effective PSF.

    Stars are peaks of the image filtered with a Gaussian of the width of the stars, the local light (sky, halos) taken
    off, and no side lobes of brighter ones (`legdistort.measurement.detection.detect`). The profile has eight free
    parameters (`legdistort.measurement.profiles.moffat`); all stars of a frame are fitted at once, three times: with
    the noise of the sky alone, then twice with the photon noise of the model of the pass before and the models of the
    neighbours subtracted. (Photon noise taken from the data instead of a model would bias the fit.) In images
    with stars narrower than 3 pixels the profile is averaged over every pixel.

    In a crowd (more than 5 % of the detections, and ten, have another one within two FWHM) all stars share one PSF, are
    fitted together, subtracted, and the rest is searched for more (`legdistort.measurement.scene`).

    Pixel variances are ``uncertainty**2`` if the exposure has that plane, else the observed variance of the sky (at
    least that of the read noise) plus ``star light / gain``. Where the residuals exceed the noise (reduced chi2 above 1
    by more than chance), errors are scaled up accordingly. With an effective PSF made from the stars of the exposure
    they are scaled up where the residuals of a star exceed those of the other stars: the residuals that all stars have
    are the error of the PSF itself, which the errors of positions include.

    Parameters
    ----------
    exposures : Exposure or sequence of Exposure
        From `legdistort.read_exposures`, or from `legdistort.open_exposures`: then one at a time is in memory.
    fwhm : float, optional
        Full width at half maximum of the stars [pix]; found in every frame if not given.
    threshold : float
        Detection limit, signal-to-noise ratio of the filtered image; stars that do not reach it when fitted are
        flagged ``INSIGNIFICANT``.
    max_stars : int, optional
        Keep only this number of usable detections in every frame, the brightest.
    box : int, optional
        Side of the square fitted [pix], odd; by default about 4 FWHM.
    profile : {"own", "shared", "linear"}
        Whether every star has a shape of its own, or all have the mean shape of the bright stars of the frame, or one
        that varies linearly over the field. With the latter two a star has four free parameters; positions near the
        detection limit and fluxes are more precise, and ``DEFORMED`` is not flagged.
    blends : {"together", "alone"}
        Whether stars within two FWHM of each other are fitted together, with one shape and one background, or one by
        one with the models of the others subtracted, in a crowd too.
    gain, read_noise, saturation : float, optional
        In e-/ADU, e-, ADU; for all exposures instead of their own values.
    errors : {"fit", "injected", "scaled"}
        Errors of the positions: of the fit; by the noise curve of every exposure at the star's flux, from stars put
        into it and measured (`legdistort.calibrate_noise`), as in the paper; or those of the fit times the ratio of
        that curve to what fits of this flux state. The latter two take some seconds a frame.
    psf : {"auto", "moffat", "effective"}, EffectivePSF, path, photutils model or dict of those, optional
        What the stars are fitted with: a Moffat profile each, or the effective PSF of every exposure, made from its own
        stars (`legdistort.effective_psf`), or one from elsewhere: a file (FITS cube, PSFEx), an ``ImagePSF`` or
        ``GriddedPSFModel`` of photutils, `EffectivePSF.from_array`; a dict has one for every exposure by name.
        "auto": the effective PSF if it describes the bright stars better in most of the exposures, else Moffat
        profiles. Positions are those of the core-weighted centre with all PSFs but the Moffat profiles. Exposures with
        too few stars for a PSF of their own are measured with Moffat profiles, and named in a warning.
    write_psf : str or path, optional
        Folder for the PSF of every exposure that has one, ``NAME.fits``. PSFs of an earlier call are replaced, files of
        another kind are not. ``meta["psf_files"]`` of the table has their checksums (SHA-256).
    workers : int, optional
        Processes that share the frames. None = the current ``dask.distributed.Client`` if there is one, else this
        process. The table is the same.
    progress : bool
        Show a progress bar.

    Returns
    -------
    `~astropy.table.QTable`
        One row a detection, brightest first in every exposure: ``exposure``, ``x``, ``y``, ``x_err``, ``y_err`` [pix]
        (0-based, standard deviations), ``xy_corr``, ``flux``, ``flux_err`` (of the whole profile, in units of the data;
        with an effective PSF of the exposure's own stars all light within 30 FWHM, and errors relative to its other
        stars), ``fwhm`` [pix], ``chi2`` (reduced), ``flags`` (bits of `Flag`; see `UNUSABLE`),
        ``crowding`` (how far detected neighbours would pull the position, were their light left in, in standard errors:
        see `legdistort.measurement.crowding`), ``psf`` (what was fitted: "moffat", "effective" or where the PSF came
        from). An exposure in which nothing is found has no rows. ``meta["flux_factor_error"]``, if there are such PSFs:
        ``{exposure: relative error common to all its fluxes}``, infinite where the frame does not determine the light
        of the halos, and fluxes are those in the PSF.

    Raises
    ------
    InputError
        For arguments out of range, and PSFs that are none; if a file that is no such PSF, a frame for instance, stands
        where one would be written.

    Warns
    -----
    AssumptionWarning
        Once each: for trailed stars; for a mask that hides most bright stars; if exposures lack a gain, since the
        photon noise is then estimated from the residuals of the fits, one for all frames of a camera
        (`legdistort.measurement.camera_gain`); if exposures have too few stars for an effective PSF.

    See Also
    --------
    legdistort.match : Which detection is which star.
    legdistort.calibrate_noise : Errors of positions from stars put into the images.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=4, seed=1)
    >>> exposures = ld.read_exposures(list(night.hdus.values()))
    >>> detections = ld.measure(exposures, psf="moffat")
    >>> detections["exposure", "x", "x_err", "flux"].colnames
    ['exposure', 'x', 'x_err', 'flux']
    """
    exposures = listed(exposures, "measure")
    options = MeasureOptions(
        fwhm=fwhm, threshold=threshold, max_stars=max_stars, box=box, profile=profile, blends=blends, gain=gain,
        read_noise=read_noise, saturation=saturation, errors=errors, psf=psf,
    )  # fmt: skip
    if write_psf is not None:
        if options.only_moffat:
            raise InputError(
                "there is no effective PSF to write with Moffat profiles: leave write_psf out, or give psf='effective'"
            )
        _check_psf_folder(Path(write_psf), exposures)
    table, psfs = measure_with_psfs(exposures, options, workers=workers, progress=progress)
    if write_psf is not None:
        with outputs.replacing_folder(write_psf) as folder:
            write_psfs(psfs, folder)
            table.meta["psf_files"] = outputs.contents(folder)
    return table


def _check_psf_folder(folder, exposures):
    """Refuse a folder for PSFs in which something else would be replaced."""
    outputs.check_folder(folder)
    for path in (folder / f"{exposure.name}.fits" for exposure in exposures):
        if path.exists():
            try:
                EffectivePSF.read(path)
            except InputError:
                raise InputError(
                    f"{path} is no effective PSF, and would be replaced by one: give another folder as write_psf= "
                    "(--write-psf)"
                ) from None


@plain_numbers
def effective_psf(
    exposure: Exposure,
    *,
    fwhm: float | None = None,
    threshold: float = 5.0,
    box: int | None = None,
    gain: float | None = None,
    read_noise: float | None = None,
    saturation: float | None = None,
) -> EffectivePSF:
    """Make the effective PSF of an exposure from its bright, isolated, unsaturated stars.

    Positions of the stars and the oversampled grid are fitted together (Anderson & King 2000, PASP 112, 1360); how much
    it varies over the field, up to the second degree in x and y, the stars determine. Its core-weighted centre, the
    place where the first moments under a Gaussian of standard deviation FWHM / 4 vanish, is 0 everywhere in the field.

    Parameters
    ----------
    exposure : Exposure
    fwhm, threshold, box, gain, read_noise, saturation : optional
        As for `legdistort.measure`.

    Returns
    -------
    EffectivePSF

    Raises
    ------
    InputError
        If there are too few stars.

    See Also
    --------
    legdistort.measure : Measures stars with effective PSFs.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=1, seed=1)
    >>> (exposure,) = ld.read_exposures(list(night.hdus.values()))
    >>> psf = ld.effective_psf(exposure)
    >>> psf.exposure, psf.source
    ('exp00', 'effective')
    """
    options = MeasureOptions(
        fwhm=fwhm, threshold=threshold, box=box, gain=gain, read_noise=read_noise, saturation=saturation,
        psf="effective",
    )  # fmt: skip
    measured = measure_exposure(exposure, options)
    if measured.psf is None:
        raise InputError(
            f"{exposure.name}: {measured.verdict.n_usable} bright, isolated, unsaturated stars, and an effective PSF "
            f"needs {STARS_NEEDED}; take another exposure, or a PSF from elsewhere"
        )
    return measured.psf


def write_psfs(psfs, folder):
    """Write ``NAME.fits`` for the PSF of every exposure; a folder is made if there is any."""
    for name, psf in psfs.items():
        folder.mkdir(exist_ok=True)
        psf.write(folder / f"{name}.fits")


def measure_with_psfs(exposures, options, *, kept=None, workers=None, progress=False):
    """What `measure` returns, and the PSFs of the exposures that have one, by name.

    Parameters
    ----------
    exposures : sequence of Exposure
    options : `~legdistort.measurement.options.MeasureOptions`
    kept : `~legdistort.measurement.unfinished.Unfinished`, optional
        Has exposures that are measured already, and takes the others as soon as these are.
    workers : int, optional
    progress : bool
    """
    share = partial(map_items, workers=workers, progress=progress)
    found = [kept and kept.get(exposure) for exposure in exposures]
    left = [i for i, one in enumerate(found) if one is None]
    use_compiled_loops(sum(np.prod(exposures[i].shape) for i in left))
    gains = {} if options.gain or not left else _camera_gains(exposures, options, share)

    def measured(which, options):
        pairs = [(exposure, gains.get(exposure.name)) for exposure in which]
        return share(partial(_measure_with_gain, options=options), pairs, description="measuring")

    for i, one in zip(left, measured([exposures[i] for i in left], options), strict=True):
        found[i] = one
        if kept:
            kept.keep(exposures[i], one)
    votes = [one.verdict.psf == "effective" for one in found if one.verdict.decided]
    if options.psf == "auto" and any(votes) and not all(votes):  # one definition of the centre for all exposures
        chosen = "effective" if np.mean(votes) > 0.5 else "moffat"
        again = [i for i, one in enumerate(found) if one.verdict.decided and one.verdict.psf != chosen]
        anew = measured([exposures[i] for i in again], replace(options, psf=chosen))
        for i, one in zip(again, anew, strict=True):
            found[i] = one
    _tell_of_all(found)
    names = [exposure.name for exposure in exposures]
    if empty := [name for name, one in zip(names, found, strict=True) if one.shape is None]:
        log.warning("%s: no star above %g times the noise", some_of(empty, 6), options.threshold)
    _warn_of_gain({name: one.photon for name, one in zip(names, found, strict=True)})
    doubtful = {name: one.noise_ratio for name, one in zip(names, found, strict=True) if one.noise_ratio is not None}
    camera_gain.warn_of_contradictions(doubtful, {e.name: options.gain or e.gain for e in exposures})
    across_frames.warn_of_hidden([each for each, one in zip(exposures, found, strict=True) if one.hidden])
    across_frames.warn_of_trails({n: one.shape for n, one in zip(names, found, strict=True) if one.shape is not None})
    across_frames.flag_what_stays([one.table for one in found], exposures)
    verdicts = {name: one.verdict for name, one in zip(names, found, strict=True)}
    if options.psf == "effective" or any(v.psf == "effective" for v in verdicts.values()):
        warn_of_psf(verdicts)
    filled = [_of_frame(one.table, e) for e, one in zip(exposures, found, strict=True) if len(one.table)]
    psfs = {name: one.psf for name, one in zip(names, found, strict=True) if one.psf is not None}
    table = vstack(filled) if filled else empty_table()
    if errors := {name: float(one.factor_error) for name, one in zip(names, found, strict=True) if one.factor_error}:
        table.meta["flux_factor_error"] = errors
    return table, psfs


def _of_frame(table, exposure):
    """The table of a detector of a camera with the columns exposure and detector."""
    if exposure.detector is not None:
        table["exposure"] = np.full(len(table), exposure.exposure)
        table.add_column(np.full(len(table), exposure.detector), name="detector", index=1)
    return table


def warn_of_psf(verdicts):
    """Warn of exposures that have too few stars for an effective PSF: ``{name: Verdict}``."""
    lacking = {name: v.n_usable for name, v in verdicts.items() if v.psf == "moffat" and v.n_usable < STARS_NEEDED}
    if lacking:
        each = some_of([f"{name} has {n}" for name, n in lacking.items()], 3)
        warn(
            f"too few bright, isolated, unsaturated stars for an effective PSF, which needs {STARS_NEEDED}: {each}; "
            "measured with Moffat profiles",
            AssumptionWarning,
        )


def _camera_gains(exposures, options, share):
    """Gains of exposures that have none, found from several frames of their camera: ``{name: e-/ADU}``."""
    asked = camera_gain.pilots(exposures)
    work = partial(_photon_noise, options=options)
    estimates = iter(list(share(work, [frame for frames in asked.values() for frame in frames], description="gain")))
    gains = {camera: camera_gain.pooled([next(estimates) for _ in frames]) for camera, frames in asked.items()}
    found = {e.name: gains.get(camera_gain.camera(e)) for e in exposures if not e.gain}
    return {name: gain for name, gain in found.items() if gain is not None}


def _photon_noise(exposure, options):
    """Variance per unit of star light that an exposure determines, None if it is known or there are no stars."""
    exposure = options.with_detector(exposure.read())
    unit = noise_unit(exposure)
    _, stamps, shape, _ = _stamps(in_working_unit(exposure, unit), options)
    return None if stamps is None or stamps.frame.photon is not None else frame_fit.photon_noise(stamps, shape) / unit


def _measure_with_gain(pair, options):
    """What `measure_exposure` gives for an exposure and the gain found for its camera, or None."""
    exposure, gain = pair
    if gain is None:
        return measure_exposure(exposure, options)
    return measure_exposure(exposure, replace(options, gain=gain))._replace(photon=1 / gain, noise_ratio=None)


def _warn_of_gain(photons):
    """Warn of exposures whose photon noise was estimated: ``{name: variance per unit of light, None if known}``."""
    names = [name for name, photon in photons.items() if photon is not None]
    if names:
        gains = [1 / photon for photon in photons.values() if photon]
        seen = list(dict.fromkeys(f"{gain:.3g}" for gain in (min(gains), max(gains)))) if gains else []
        found = f"equivalent gain {' to '.join(seen)} e-/ADU" if seen else "none could be seen"
        warn(
            f"no gain known for {some_of(names, 3)}: photon noise estimated from the residuals of the star fits "
            f"({found}); give gain= or the keyword GAIN to have it exact",
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
    MeasuredExposure
    """
    exposure = options.with_detector(exposure.read())
    unit = noise_unit(exposure)
    exposure = in_working_unit(exposure, unit)
    options = replace(options, gain=None, saturation=None)  # the exposure has them
    measured = measure_scaled(exposure, options)
    found = measured.in_unit(unit)
    if options.errors == "fit" or not np.any((found.table["flags"] & UNUSABLE) == 0):
        return found
    held = replace(options, max_stars=None, psf=measured.psf or "moffat")

    def remeasure(image, *, fwhm=options.fwhm):
        return measure_scaled(image, replace(held, fwhm=fwhm)).table

    curves = calibrate_frame(exposure, remeasure, psf=measured.psf, threshold=options.threshold)
    return found._replace(table=curves.in_unit(unit).apply(found.table, options.errors))


def _tell_of_all(found):
    """Say what was measured in all images together."""
    with_stars = [one for one in found if one.shape is not None]
    if with_stars:
        counts, widths = ([f(one) for one in with_stars] for f in (lambda one: len(one.table), _fwhm))
        used = ", ".join(sorted({one.verdict.psf for one in with_stars}))
        log.info(
            "%d images measured: %d to %d detections, FWHM %.2f to %.2f px, %s",
            len(found), min(counts), max(counts), min(widths), max(widths), used,
        )  # fmt: skip


def _fwhm(one):
    return float(moffat.fwhm(one.shape))


def measure_scaled(exposure, options):
    """What `measure_exposure` gives, errors as the fits state them, of an exposure in the unit of its noise."""
    name, max_stars = exposure.name, options.max_stars
    frame, stamps, shape, crowd = _stamps(exposure, options)
    hidden = across_frames.hides_most(exposure, frame, np.zeros((0, 2), int) if stamps is None else stamps.centres)
    if stamps is None:
        return MeasuredExposure(empty_table(), None, None, frame_psf.Verdict("moffat", 0), hidden=hidden)
    fwhm = float(moffat.fwhm(shape))
    found = None
    if crowd:
        from .scene.measuring import measure_crowd  # it loads numba

        found = measure_crowd(stamps, shape, options, options.psf_of(name))
    joint = found is not None
    if not joint:
        found = _measure_groups(stamps, shape, options, options.psf_of(name))
    stamps, stars = found.stamps, found.stars
    faint = stars.snr < max(LEAST, options.threshold)  # what passed the limit with noise that the whole star lacks
    stars = stars._replace(flags=stars.flags | np.where(faint, Flag.INSIGNIFICANT, 0))
    table = table_of(name, stamps, stars)
    table = table[distinct(table, fwhm, SAME if joint else 0.5)]
    table["crowding"] = crowding(table, fwhm)
    table["psf"] = np.full(len(table), found.verdict.psf)
    if stamps.frame.defects is not None:
        table = with_defects(table, defect_peaks(exposure.data, stamps.frame))
    if max_stars is not None:
        table = table[(table["flags"] & UNUSABLE) == 0][:max_stars]
    logging.getLogger(EACH_IMAGE).info("%s: %d detections, FWHM %.2f px, %s", name, len(table), fwhm, found.verdict.psf)
    known = exposure.gain or exposure.uncertainty is not None or not len(table)
    psf = None if found.psf is None else found.psf.named(exposure=name)
    clean = (stars.flags & UNUSABLE) == 0
    ratio = camera_gain.contradiction(
        exposure, stamps.frame, stars.flux[clean], stars.chi2[clean] / np.maximum(stars.dof[clean], 1), found.shown
    )
    return MeasuredExposure(
        table, None if known else found.photon, psf, found.verdict, ratio, shape, hidden, found.factor_error
    )


def _measure_groups(stamps, shape, options, psf):
    """All stars of a frame that is no crowd, in groups of those that touch."""
    fitted = frame_fit.fit_stars(stamps, shape, profile=options.profile, blends=options.blends)
    measured, verdict = frame_psf.measure_frame(stamps, fitted, shape, psf)
    error = 0.0
    if measured is not None and isinstance(psf, str):
        measured, error = in_total_light(measured, stamps, measured.fit.converged & ~measured.astray)
    own_shapes = options.profile == "own"  # other profiles have nothing to compare
    deformed = _is_deformed(stamps, fitted) if own_shapes else np.zeros(len(fitted.flags), dtype=bool)
    stars = _moffat_stars(fitted) if measured is None else _psf_stars(fitted, measured)
    stars = stars._replace(flags=stars.flags | np.where(deformed, Flag.DEFORMED, 0))
    nodes = moffat.quadrature(float(moffat.fwhm(shape)))
    shown = partial(pixel_noise.photon_noise, stamps, fitted.found, fitted.models, nodes)
    return FrameStars(stamps, stars, verdict, None if measured is None else measured.psf, fitted.photon, shown, error)


def _stamps(exposure, options):
    """An exposure as a frame, stamps around its detections, the usual shape of its stars, whether it is crowded.

    The stamps are None without any detection.
    """
    frame, centres, shape = locate_stars(exposure, threshold=options.threshold, fwhm=options.fwhm)
    width = float(moffat.fwhm(shape))
    crowd = options.blends == "together" and is_crowded(frame, centres, width)
    if options.max_stars is not None and not crowd:
        centres = centres[: 3 * options.max_stars]  # some will turn out to be hot pixels or saturated
    half = options.box // 2 if options.box else box_half(width)
    return frame, (Stamps(frame, centres, half) if len(centres) else None), shape, crowd


def _is_deformed(stamps, fitted):
    """`is_deformed` of the stars of a frame; so are bright ones that could only be fitted with the shape of all."""
    found, shared = fitted.found, (fitted.flags & Flag.SHARED_SHAPE) != 0
    usable = ((fitted.flags & UNUSABLE) == 0) & ~shared
    shapes, covariance = found.params[:, 3:7], found.covariance[:, 3:7, 3:7]
    xy, chi2 = stamps.centres + found.params[:, :2], found.chi2 / np.maximum(found.dof, 1)
    peak = found.params[:, 2]
    deformed = is_deformed(shapes, covariance, xy=xy, peak=peak, snr=fitted.snr, chi2=chi2, usable=usable)
    return np.where(shared, fitted.snr > SHAPELY, deformed)


def _moffat_stars(fitted):
    found = fitted.found
    flux = moffat.flux(found.params, found.covariance)
    width = moffat.fwhm(found.params)
    return Stars(
        found.params[:, :2], found.covariance[:, :2, :2], *flux, width, found.chi2, found.dof, fitted.snr, fitted.flags
    )


def _psf_stars(fitted, measured):
    fit = measured.fit
    known = fitted.flags & ~(Flag.NOT_CONVERGED | Flag.INSIGNIFICANT | Flag.SHARED_SHAPE)
    lost = ~fit.converged | ~(fit.params[:, 2] > 0) | measured.astray
    flags = known | np.where(lost, Flag.NOT_CONVERGED, 0)
    flux_err = np.sqrt(np.maximum(fit.covariance[:, 2, 2], 0))
    width = moffat.fwhm(fitted.found.params)
    return Stars(
        fit.params[:, :2], fit.covariance[:, :2, :2], fit.params[:, 2], flux_err, width, fit.chi2, fit.dof,
        measured.snr, flags, measured.misfit,
    )  # fmt: skip
