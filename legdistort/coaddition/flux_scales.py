"""Factors that bring exposures to one flux scale: by exposure times, or by the fluxes of common stars."""

import logging
from collections.abc import Mapping

import numpy as np
from scipy.sparse.csgraph import connected_components

from ..exceptions import AssumptionWarning, InputError, warn
from .options import by_name
from .pairs import median_differences, values_from_differences

log = logging.getLogger(__name__)

_SAME = 0.02  # by which fluxes of stars must differ from the exposure times to be preferred
_FEW = 5  # common stars that two exposures must have


def flux_scales(frames, scale, solution):
    """Factors that bring exposures to one flux scale.

    Parameters
    ----------
    frames : sequence of Exposure
        Or handles; no pixels are read.
    scale : {'auto', 'exptime', 'stars', None} or dict
        See `legdistort.coadd`.
    solution : Solution
        Its observations have the fluxes of stars, if `legdistort.measure` made them.

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
    factors, origin = _factors(frames, names, scale, solution)
    return dict(zip(names, factors.tolist(), strict=True)), origin


def _factors(frames, names, scale, solution):
    if scale is None:
        return np.ones(len(names)), "none"
    times = [f.exposure_time or None for f in frames]
    stars = None if scale == "exptime" else _star_scales(names, solution)
    if scale == "stars" and stars is None:
        raise InputError(
            f"scale='stars': the solution has no fluxes of {_FEW} common stars or more that join all exposures; "
            "give scale='exptime' or a dict by exposure"
        )
    if stars is None:
        return _time_scales(frames, times), "exptime"
    logs, errors = stars
    if scale == "auto" and (None not in times or len(set(times)) == 1):
        factors = _time_scales(frames, times)
        off = logs - np.log(factors)
        off -= np.median(off)
        if np.all(np.abs(off) <= np.maximum(_SAME, 3 * errors)):
            return factors, "exptime"
        log.info("by their stars exposures differ in depth by up to %.1f %% more than by time", 100 * max(abs(off)))
    factors = np.exp(logs - np.mean(logs))
    if None not in times:  # the mean exposure time stays what it is
        factors *= np.sum(times) / np.sum(factors * times)
    return factors, "stars"


def _time_scales(frames, times):
    same = np.ones(len(frames))
    unit = str(frames[0].header.get("BUNIT", "")).replace(" ", "").lower()
    if len(set(times)) == 1 or unit.endswith(("/s", "/sec", "s-1", "s**-1", "s^-1")):
        return same
    if None in times:
        missing = ", ".join(f.name for f in frames if not f.exposure_time)
        warn(
            f"no exposure time known for {missing}: the exposures are taken to be equally long; "
            "give scale={name: factor} if they are not",
            AssumptionWarning,
        )
        return same
    return np.mean(times) / np.array(times, dtype=float)


def _star_scales(names, solution):
    """Logarithms of factors by the fluxes of common stars, and their errors; None if they do not join all exposures.

    Differences between exposures are medians over their common stars, the brighter half of all; the factors follow
    from all pairs by least squares.
    """
    rows = solution.observations
    if "flux" not in rows.colnames:
        return None
    flux, exposure = np.asarray(rows["flux"], dtype=float), np.asarray(rows["exposure"])
    good = np.asarray(rows["used"]) & np.isfinite(flux) & (flux > 0) & np.isin(exposure, names)
    stars, column = np.unique(np.asarray(rows["star"])[good], return_inverse=True)
    if len(stars) < _FEW:
        return None
    place = {name: i for i, name in enumerate(names)}
    logs = np.full((len(names), len(stars)), np.nan)
    logs[[place[name] for name in exposure[good]], column] = np.log(flux[good])
    middle = np.nanmedian(logs, axis=0)
    logs = logs[:, middle >= np.median(middle)]
    difference, count = median_differences(logs)
    count[count < _FEW] = 0
    if connected_components(count, directed=False)[0] > 1:
        return None
    values = values_from_differences(difference, count, np.zeros(len(names)))
    rest = logs - values[:, None]
    rest -= np.nanmedian(rest, axis=0)
    n = np.isfinite(rest).sum(axis=1)
    return -values, 1.4826 * 1.2533 * np.nanmedian(np.abs(rest), axis=1) / np.sqrt(n)
