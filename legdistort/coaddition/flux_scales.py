"""Factors that bring exposures to one flux scale: by exposure times, or by the fluxes of common stars.

Of a camera a factor is that of the exposure times that of the detector, which is common to all exposures.
"""

import logging
from collections.abc import Mapping

import numpy as np

from ..cameras.star_scales import NO_FLUXES, star_scales
from ..exceptions import AssumptionWarning, InputError, warn
from ..inputs.exposure_names import whole_name
from ..inputs.frames.integrations import value_time
from ..inputs.frames.value_units import value_unit
from .options import by_name

log = logging.getLogger(__name__)

_SAME = 0.02  # by which fluxes of stars must differ from the exposure times to be preferred


def flux_scales(frames, scale, views, areas=None):
    """Factors that bring exposures, and the detectors of a camera, to one flux scale.

    Parameters
    ----------
    frames : sequence of Exposure
        Or handles; no pixels are read.
    scale : {'auto', 'exptime', 'stars', None} or dict
        See `legdistort.coadd`.
    views : dict
        ``{name: View}`` of the frames, in their order; residuals have the fluxes of stars, if `legdistort.measure` made
        them.
    areas : dict, optional
        Detector pixels in a pixel of the mosaic, by name, where it is to conserve surface brightness: stars then have
        their flux divided by these.

    Returns
    -------
    factors : dict
        By name.
    origin : str
        Where they come from: 'exptime', 'stars', 'none' or 'given'.

    Raises
    ------
    InputError
        If the fluxes of common stars do not join all exposures, or a number by exposure is missing.
    """
    names = [f.name for f in frames]
    if isinstance(scale, Mapping):
        return by_name("scale", scale, names), "given"
    factors, origin = _factors(frames, scale, views, areas or {})
    return dict(zip(names, factors.tolist(), strict=True)), origin


def _factors(frames, scale, views, areas):
    if scale is None:
        return np.ones(len(frames)), "none"
    if scale == "exptime":
        return _time_scales(frames, _times(frames)), "exptime"
    exposures = list(dict.fromkeys(whole_name(f) for f in frames))
    detectors = list(dict.fromkeys(f.detector for f in frames))
    place = np.array([(exposures.index(whole_name(f)), detectors.index(f.detector)) for f in frames])
    first = [frames[k] for k in np.unique(place[:, 0], return_index=True)[1]]
    stars = _star_scales(views, place, areas)
    unknown = NO_FLUXES if stars is None else stars.apart(exposures)
    if unknown and scale == "stars":
        raise InputError(f"scale='stars': {unknown}; give scale={{name: factor}} or scale='exptime' (--scale exptime)")
    times = _times(first)
    if unknown:
        if len(exposures) > 1:
            log.info("exposures are scaled by exposure times, whatever their transparency: %s", unknown)
        return _time_scales(first, times)[place[:, 0]], "exptime"
    sensitive = scale == "stars" or np.any(np.abs(stars.detectors) > 3 * stars.detector_errors)
    of_detectors = np.exp(stars.detectors) if sensitive else np.ones(len(detectors))
    if scale == "auto" and (None not in times or len(set(times)) == 1):
        factors = _time_scales(first, times)
        off = stars.exposures - np.log(factors)
        off -= np.median(off)
        if np.all(np.abs(off) <= np.maximum(_SAME, 3 * stars.errors)):
            of_all = factors[place[:, 0]] * of_detectors[place[:, 1]]
            return of_all, "exptime, stars" if sensitive and len(detectors) > 1 else "exptime"
        log.info(
            "transparency or gain changed: by exposure, stars have %.2f to %.2f of the light that exposure times tell; "
            "their fluxes, not times, bring exposures to one scale", np.exp(-off.max()), np.exp(-off.min()),
        )  # fmt: skip
    factors = np.exp(stars.exposures)
    if None not in times:  # the mean exposure time stays what it is
        factors *= np.sum(times) / np.sum(factors * times)
    return factors[place[:, 0]] * of_detectors[place[:, 1]], "stars"


def _times(frames):
    """Seconds of light that values stand for, None if not known; of rates among others that are none, one second."""
    times = [value_time(f) for f in frames]
    grows = [value_unit(f.header).has_time for f in frames]
    if None in times or not any(grows):
        return times
    return [time if own else 1.0 for time, own in zip(times, grows, strict=True)]


def _time_scales(frames, times):
    same = np.ones(len(frames))
    if len(set(times)) == 1 or not any(value_unit(f.header).has_time for f in frames):
        return same
    if None in times:
        missing = ", ".join(f.name for f in frames if not f.exposure_time)
        warn(
            f"no exposure time known for {missing}: the exposures are taken to be equally long; if they are "
            "not, state EXPTIME in the headers, or give scale={name: factor} or scale='stars' (--scale stars)",
            AssumptionWarning,
        )
        return same
    return np.mean(times) / np.array(times, dtype=float)


def _star_scales(views, place, areas):
    """The `StarScales` of images, of whose exposures and detectors `place` (n, 2) has the numbers; None without."""
    seen = [view.residuals for view in views.values()]
    if any("flux" not in rows.colnames for rows in seen):
        return None
    part = np.repeat(np.arange(len(seen)), [len(rows) for rows in seen])
    flux, used, star = (np.concatenate([np.asarray(rows[key]) for rows in seen]) for key in ("flux", "used", "star"))
    flux = flux / np.array([areas.get(name, 1.0) for name in views])[part]
    used = used.astype(bool)
    exposure, detector = place[part].T
    known = (each[used] for each in (exposure, detector, star, flux))
    return star_scales(*known, *(place.max(axis=0) + 1).tolist())
