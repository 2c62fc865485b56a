"""Noise curves of exposures, by measuring stars put into them as `legdistort.measure` measures all others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import vstack

from ..exceptions import AssumptionWarning, InputError, some_of, warn
from ..inputs.exposure_files import listed
from ..inputs.frames.working_units import in_working_unit, noise_unit
from ..runtime import checks, parallel
from ..runtime.guards.units import plain_numbers
from .injection import calibrate_frame
from .noise_curves import NoiseCurves
from .options import MeasureOptions
from .positions import measure_scaled, warn_of_psf

if TYPE_CHECKING:
    from ..inputs.exposures import Exposure


@plain_numbers
def calibrate_noise(
    exposures: Exposure | Sequence[Exposure],
    *,
    fluxes: Sequence[float] | None = None,
    fwhm: float | Sequence[float] | None = None,
    n_positions: int = 100,
    seed: int = 0,
    measuring: Mapping[str, Any] | None = None,
    workers: int | None = None,
    progress: bool = False,
) -> NoiseCurves:
    """Find the error of a position as a function of flux, by putting stars into the real background.

    As in section 5.2.2 of Bernard et al. 2017: stars of given flux are added at known random positions, with photon
    noise, and measured by `legdistort.measure`. They stand three FWHM or more from every detection and eight from one
    another, as many in one copy of the frame as it has space for. They have the effective PSF of the frame, where
    `measure` would take that, and are measured with it; else, and where `fwhm` is given, the median Moffat profile.

    Parameters
    ----------
    exposures : Exposure or sequence of Exposure
        From `legdistort.read_exposures` or `legdistort.open_exposures`.
    fluxes : sequence of float, optional
        In units of the data; by default twelve from the detection limit to the brightest star, or a thousand times
        the limit, but below saturation.
    fwhm : float or sequence of float, optional
        Widths of Moffat profiles [pix]; by default stars are as wide as the frame's own.
    n_positions : int
        Stars for every flux and width, at least 10.
    seed : int
        Of the random numbers; the same seed gives the same table.
    measuring : dict, optional
        Arguments of `legdistort.measure`, such as ``{"gain": 2.0, "threshold": 4}``.
    workers : int, optional
        Processes that share the frames, as for `legdistort.measure`.
    progress : bool
        Show a progress bar.

    Returns
    -------
    `~legdistort.measurement.noise_curves.NoiseCurves`

    Raises
    ------
    InputError
        For arguments out of range, a frame without stars if `fwhm` or the gain are missing, and one without space
        for stars.

    Warns
    -----
    AssumptionWarning
        If exposures lack a gain: the photon noise put in is estimated from their stars.

    See Also
    --------
    legdistort.measure : Takes such errors with ``errors="injected"``.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=1, seed=1)
    >>> exposures = ld.read_exposures(list(night.hdus.values()))
    >>> curves = ld.calibrate_noise(exposures, fluxes=[1e4, 1e5], n_positions=20, measuring={"psf": "moffat"})
    >>> len(curves.table) > 0
    True
    """
    exposures = listed(exposures, "calibrate_noise")
    fluxes, widths = check_injection(fluxes, fwhm, n_positions, seed)
    options = checks.options_from(MeasureOptions, measuring, "measuring")
    if widths is not None and options.psf not in ("auto", "moffat"):
        raise InputError("fwhm is that of Moffat profiles: leave it out, or give measuring={'psf': 'moffat'}")
    work = partial(_calibrate, options=options, fluxes=fluxes, widths=widths, n_positions=n_positions, seed=seed)
    curves = list(parallel.map_items(work, exposures, workers=workers, progress=progress, description="noise"))
    photons = {exposure.name: photon for exposure, (_, photon) in zip(exposures, curves, strict=True)}
    gains = [f"{name} {1 / p:.3g}" if p else f"{name} none seen" for name, p in photons.items() if p is not None]
    if gains:
        warn(
            "no gain known: the photon noise of injected stars is estimated from the stars of the frames (equivalent "
            f"gain, e-/ADU: {some_of(gains, 3)}); give gain or the keyword GAIN to have it exact",
            AssumptionWarning,
        )
    tables = [of_frame.table for of_frame, _ in curves]
    table = vstack(tables, metadata_conflicts="silent")
    table.meta = {key: {k: v for each_ in tables for k, v in each_.meta[key].items()} for key in ("fwhm", "photon")}
    table.meta["seed"] = seed
    return NoiseCurves(table)


def _calibrate(exposure, *, options, widths, fluxes, **stars):
    """Curves of one exposure, and its photon noise if that is an estimate; `stars` put in."""
    exposure = options.with_detector(exposure.read())
    unit, has_gain = noise_unit(exposure), bool(exposure.gain)
    exposure = in_working_unit(exposure, unit)  # with the gain and saturation that options have
    options = replace(options, errors="fit", max_stars=None, gain=None, saturation=None)
    psf = None
    if widths is None and options.psf != "moffat":
        measured = measure_scaled(exposure, options)
        psf = measured.psf
        if options.psf == "effective":
            warn_of_psf({exposure.name: measured.verdict})
    options = replace(options, psf=psf or "moffat")

    def remeasure(image, *, fwhm=options.fwhm):
        return measure_scaled(image, replace(options, fwhm=fwhm)).table

    fluxes = None if fluxes is None else fluxes * unit
    known = {"psf": psf, "threshold": options.threshold, "widths": widths, "fluxes": fluxes}
    curves = calibrate_frame(exposure, remeasure, **known, **stars).in_unit(unit)
    return curves, None if has_gain else curves.table.meta["photon"][exposure.name]


def check_injection(fluxes=None, fwhm=None, n_positions=100, seed=0):
    """The stars asked for, checked: fluxes and widths as lists, or None."""
    if fluxes is not None:
        fluxes = np.unique(np.asarray(fluxes, dtype=float))
        if not fluxes.size or not (np.isfinite(fluxes) & (fluxes > 0)).all():
            raise InputError(f"fluxes must be positive numbers, in units of the data, got {fluxes.tolist()}")
    widths = None
    if fwhm is not None:
        widths = np.unique(np.asarray(fwhm, dtype=float)).tolist()
        if not widths or not all(0.5 <= width <= 200 for width in widths):
            raise InputError(f"fwhm must be a number between 0.5 and 200 pixels, got {fwhm!r}")
    if int(n_positions) != n_positions or n_positions < 10:
        raise InputError(f"n_positions must be an integer of at least 10, got {n_positions!r}")
    if isinstance(seed, bool) or int(seed) != seed or seed < 0:
        raise InputError(f"seed must be an integer, 0 or above, got {seed!r}")
    return fluxes, widths
