"""Noise, background level and flux scale of exposures, brought to one."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from ..exceptions import AssumptionWarning, InputError, warn
from .options import by_name
from .resampling.pixel_maps import trace

logger = logging.getLogger(__name__)

_SAME_SCALE = 0.02  # by which fluxes of stars must differ from the exposure times to be preferred
_FEW = 5  # common stars that two exposures must have for a flux scale
_BLOCK = 32  # side of the blocks whose medians stand for the background, px


@dataclass(frozen=True, eq=False, repr=False)
class Survey:
    """What co-adding must know of an exposure before it touches its pixels again.

    Attributes
    ----------
    name : str
    shape : tuple
        ``(ny, nx)`` of the exposure.
    noise : float
        Of the background, in the unit of the data.
    medians : ndarray
        Background: medians of blocks of about 32 x 32 px.
    photons : float
        Variance of a pixel per unit of its signal above the background, by its uncertainty plane; zero without one.
    """

    name: str
    shape: tuple
    noise: float
    medians: np.ndarray
    photons: float = 0.0

    @property
    def background(self):
        """Median of the background."""
        return float(np.median(self.medians))

    def __repr__(self):
        return f"<Survey of {self.name!r}: noise {self.noise:.4g}, background {self.background:.4g}>"


def survey(exposure, *, bad, filled):
    """The `Survey` of an `~legdistort.inputs.exposures.Exposure`, its bad pixels, and its data with these replaced."""
    noise, medians = _noise(exposure, bad), _block_medians(filled)
    return Survey(exposure.name, exposure.shape, noise, medians, _photons(exposure, bad, noise, np.median(medians)))


def sky_variance(each, data, variance):
    """Variance of pixels without the photons of stars, which would give stars less weight the brighter they are.

    Parameters
    ----------
    each : Survey
        Of the exposure.
    data, variance : ndarray
        A piece of it.

    Returns
    -------
    ndarray
        At least a quarter of the variance of the background.
    """
    return np.maximum(variance - each.photons * np.maximum(data - each.background, 0), each.noise**2 / 4)


def _photons(frame, bad, noise, level):
    if frame.uncertainty is None:
        return 0.0
    signal, bright = frame.data - level, ~bad
    bright &= signal > 10 * noise
    if np.count_nonzero(bright) < 20:
        return 0.0
    return max(0.0, float(np.median((frame.uncertainty[bright] ** 2 - noise**2) / signal[bright])))


def bad_pixels(exposure):
    """Pixels of an exposure that must not be used, a boolean plane."""
    bad = ~np.isfinite(exposure.data)
    return bad if exposure.mask is None else bad | exposure.mask


def saturated_pixels(exposure):
    """Pixels of an exposure at or above its saturation level, a boolean plane."""
    if exposure.saturation is None:
        return np.zeros(exposure.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        return exposure.data >= exposure.saturation


def _noise(frame, bad):
    """Background noise: median of the uncertainties, or from the differences of neighbours.

    Stars and gradients hardly touch these differences. Zero if there is none that float32 could hold.
    """
    step = max(1, frame.shape[0] // 512)
    data = np.where(bad[::step], np.nan, (frame.data if frame.uncertainty is None else frame.uncertainty)[::step])
    if frame.uncertainty is not None:
        return float(np.nanmedian(data))
    difference = np.abs(np.diff(data, axis=1))
    difference = difference[np.isfinite(difference)]
    if not difference.any():
        return 0.0
    # The median of whole numbers is coarse: the rms within 3 sigma of it, 0.987 of that of a Gaussian, is finer.
    quantum = difference[difference > 0].min()
    core = difference[difference <= 3 * max(1.4826 * np.median(difference), quantum)]
    sigma = float(np.sqrt(np.mean(core**2)) / 0.987 / np.sqrt(2))
    return sigma if sigma > np.finfo(np.float32).eps * np.max(np.abs(frame.data), where=~bad, initial=0) else 0.0


def _block_medians(data):
    ny, nx = (max(1, n // _BLOCK) for n in data.shape)
    by, bx = data.shape[0] // ny, data.shape[1] // nx  # what is over at the end, less than one block, is left out
    blocks = data[: ny * by, : nx * bx].reshape(ny, by, nx, bx).swapaxes(1, 2)[:, :, ::2]  # half of them say enough
    return np.median(blocks.reshape(ny, nx, -1), axis=2)


def match_backgrounds(surveys, solution, output, factors):
    """Background level of every exposure, by differences of block medians where exposures overlap.

    Parameters
    ----------
    surveys : sequence of Survey
    solution : Solution
    output : `legdistort.coaddition.grids.Grid`
    factors : dict
        Flux scale of each exposure; the levels are at this scale.

    Returns
    -------
    dict
        Levels of exposures that do not overlap, even through others, are their own medians.
    """
    ny, nx = output.shape
    n_points = min(4096, max(400, 400_000 // len(surveys)))
    step = np.sqrt(ny * nx / n_points)
    gx, gy = np.meshgrid(np.arange(step / 2, nx, step), np.arange(step / 2, ny, step))
    points = np.stack([gx.ravel(), gy.ravel()], axis=1)
    samples = np.full((len(surveys), len(points)), np.nan)
    own = np.empty(len(surveys))
    for i, each in enumerate(surveys):
        blocks = factors[each.name] * each.medians
        own[i] = np.median(blocks)
        xy = trace(points, each.name, solution, output)[:, :2]
        inside = np.all((xy >= -0.5) & (xy < np.array(each.shape[::-1]) - 0.5), axis=1)
        column, row = ((xy[inside] + 0.5) * np.array(blocks.shape[::-1]) / each.shape[::-1]).astype(int).T
        samples[i, inside] = blocks[row, column]
    return dict(zip([s.name for s in surveys], _match_levels(samples, own), strict=True))


def _match_levels(samples, own):
    """Levels whose differences are the median differences of all pairs, by least squares; means as in `own`."""
    return _join(*_differences(samples), own)


def _differences(samples):
    """Median differences of all pairs of rows where both are finite, and how many values they are of."""
    n = len(samples)
    difference, count = np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            d = samples[i] - samples[j]
            d = d[np.isfinite(d)]
            if d.size:
                difference[i, j], count[i, j] = np.median(d), d.size
    return difference - difference.T, count + count.T


def _join(difference, weight, own):
    """Values whose differences are those of pairs, by weighted least squares; means of connected ones as in `own`."""
    laplacian = np.diag(weight.sum(axis=1)) - weight
    values = np.linalg.lstsq(laplacian, (weight * difference).sum(axis=1), rcond=1e-12)[0]
    _, group = connected_components(weight > 0, directed=False)
    for g in np.unique(group):
        values[group == g] += (own - values)[group == g].mean()
    return values


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
    if scale is None:
        return dict.fromkeys(names, 1.0), "none"
    times = [f.exposure_time or None for f in frames]
    stars = None if scale == "exptime" else _star_scales(names, solution)
    if scale == "stars" and stars is None:
        raise InputError(
            f"scale='stars': the solution has no fluxes of {_FEW} common stars or more that join all exposures; "
            "give scale='exptime' or a dict by exposure"
        )
    if stars is None:
        return dict(zip(names, _time_scales(frames, times).tolist(), strict=True)), "exptime"
    logs, errors = stars
    if scale == "auto" and (None not in times or len(set(times)) == 1):
        factors = _time_scales(frames, times)
        off = logs - np.log(factors)
        off -= np.median(off)
        if np.all(np.abs(off) <= np.maximum(_SAME_SCALE, 3 * errors)):
            return dict(zip(names, factors.tolist(), strict=True)), "exptime"
        logger.info("by their stars exposures differ in depth by up to %.1f %% more than by time", 100 * max(abs(off)))
    factors = np.exp(logs - np.mean(logs))
    if None not in times:  # the mean exposure time stays what it is
        factors *= np.sum(times) / np.sum(factors * times)
    return dict(zip(names, factors.tolist(), strict=True)), "stars"


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
    difference, count = _differences(logs)
    count[count < _FEW] = 0
    if connected_components(count, directed=False)[0] > 1:
        return None
    values = _join(difference, count, np.zeros(len(names)))
    rest = logs - values[:, None]
    rest -= np.nanmedian(rest, axis=0)
    n = np.isfinite(rest).sum(axis=1)
    return -values, 1.4826 * 1.2533 * np.nanmedian(np.abs(rest), axis=1) / np.sqrt(n)
