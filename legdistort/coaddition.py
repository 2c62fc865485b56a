"""Resample exposures with the solution's distortions and combine them."""

import logging
import os
import warnings
from collections.abc import Mapping
from importlib.metadata import version

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS
from scipy.sparse.csgraph import connected_components
from tqdm import tqdm

from .combination import METHODS, combiner
from .exceptions import AssumptionWarning, InputError
from .mosaics import Mosaic
from .resampling import ALGORITHMS, Grid, fill_bad, map_exposure, outline, resample_exposure, trace

logger = logging.getLogger(__name__)

CONSERVE = ("flux", "surface_brightness")
_ORDERS = {"nearest-neighbor": 0, "bilinear": 1, "biquadratic": 2, "bicubic": 3}
_BLOCK = 32  # side of the blocks whose medians stand for the background, px
_COPIED = ("OBJECT", "TELESCOP", "INSTRUME", "FILTER", "BUNIT")


def coadd(
    exposures,
    solution,
    *,
    method="mean",
    order=3,
    algorithm="interp",
    grid=None,
    conserve="flux",
    match_background=True,
    weights="noise",
    scale="exptime",
    progress=False,
):
    """Co-add exposures on the distortion-free reference plane, or on any celestial WCS.

    Parameters
    ----------
    exposures : sequence of Exposure
        The images.
    solution : Solution
        With the distortion of every exposure; an exposure without one is left out with a warning.
    method : {'mean', 'median', 'clipped'}
        Weighted mean; median; or weighted mean of what lies within 4 sigma (plus 30 % of the signal, because
        images differ in sharpness) of the median, where at least three exposures meet.
    order : int or str
        Order of the spline, 0 to 5, or the name that reproject gives it, such as 'bilinear'.
    algorithm : {'interp', 'adaptive', 'exact'}
        Which of reproject's algorithms; `order` counts for 'interp' only. 'exact' is fifty times slower.
    grid : `~astropy.wcs.WCS` or `~astropy.io.fits.Header`, optional
        Output grid, with its shape. The default is the reference plane, pixel for pixel, as large as all
        exposures need.
    conserve : {'flux', 'surface_brightness'}
        'flux' multiplies by the determinant of the distortion, so that a star has the flux of the exposures.
        'surface_brightness' leaves pixel values as they are interpolated.
    match_background : bool
        Bring the backgrounds to one level, by robust differences where exposures overlap. The level is then
        left out of the multiplication for 'flux', so that a flat sky stays flat.
    weights : {'noise', None} or dict
        Of the exposures in a mean: 1/sigma^2 of their background noise, equal, or by name.
    scale : {'exptime', None} or dict
        Factors by which data are multiplied: 'exptime' brings all to the mean exposure time if times differ (data
        in units per second are left alone); none; or by name.
    progress : bool
        Show a progress bar.

    Returns
    -------
    Mosaic

    Raises
    ------
    InputError
        Naming what is wrong: an option, an exposure whose shape is not that of the solution, a grid
        without sky or shape, or larger than the memory, no exposure left, none on the grid.
    """
    order = _check_options(method, order, algorithm, conserve)
    frames, left_out = _select(exposures, solution)
    factors = _scales(frames, scale)
    output = reference_grid([f.name for f in frames], solution) if grid is None else _given_grid(grid, solution)
    _check_memory(output, frames, method)
    noise = {f.name: factors[f.name] * _noise(f) for f in frames}
    weight = _weights(frames, weights, noise)
    sky = _backgrounds(frames, solution, output, factors)
    level = float(np.mean(list(sky.values())))
    combined = combiner(method, output.shape, level)
    used = []
    for frame in tqdm(frames, desc="co-adding", unit="frame", disable=not progress):
        name = frame.name
        pixel_map = map_exposure(name, solution, output, corners=algorithm == "exact")
        if pixel_map is None:
            left_out[name] = "it does not meet the output grid"
            continue
        bad, factor = _bad(frame), factors[name]
        variance = noise[name] ** 2 if frame.uncertainty is None else (factor * frame.uncertainty) ** 2
        data, variance = resample_exposure(
            factor * frame.data, bad, variance, pixel_map, algorithm=algorithm, order=order
        )
        area = pixel_map.area if conserve == "flux" else 1.0
        data = (data - sky[name]) * area + level if match_background else data * area
        combined.add(data, variance * area**2, pixel_map.window, weight[name])
        used.append(frame)
    if not used:
        raise InputError(f"no exposure meets the output grid: {_reasons(left_out)}")
    data, variance, footprint = combined.result()
    settings = {"COMBINE": method, "RESAMPLE": f"{algorithm} {order}" if algorithm == "interp" else algorithm}
    settings |= {"CONSERVE": conserve, "SKYLEVEL": level if match_background else None}
    header = _header(used, left_out, factors, settings)
    names = tuple(f.name for f in used)
    return Mosaic(data, variance, footprint, output.wcs, names, left_out, output.offset, header)


def _check_options(method, order, algorithm, conserve):
    """The order as an integer, all options being sound."""
    for name, value, allowed in (
        ("method", method, METHODS),
        ("algorithm", algorithm, ALGORITHMS),
        ("conserve", conserve, CONSERVE),
    ):
        if value not in allowed:
            raise InputError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}")
    order = _ORDERS.get(order, order) if isinstance(order, str) else order
    if isinstance(order, bool) or order not in range(6):
        raise InputError(f"order must be an integer from 0 to 5 or one of {', '.join(_ORDERS)}, got {order!r}")
    return int(order)


def _bad(frame):
    """Pixels of an exposure that must not be used."""
    bad = ~np.isfinite(frame.data)
    return bad if frame.mask is None else bad | frame.mask


def _select(exposures, solution):
    """Exposures that can be used, and the reasons why others cannot."""
    exposures = list(exposures)
    names = [f.name for f in exposures]
    twice = {n for n in names if names.count(n) > 1}
    if twice:
        raise InputError(f"exposures come twice: {', '.join(sorted(twice))}; names must differ")
    frames, left_out = [], {}
    for frame in exposures:
        if frame.name not in solution.poses:
            left_out[frame.name] = solution.left_out.get(frame.name, "it is not in the solution")
        elif frame.shape != tuple(solution.shapes[frame.name]):
            raise InputError(
                f"exposure {frame.name}: its shape {frame.shape} is not that of the solution, "
                f"{tuple(solution.shapes[frame.name])}; a trimmed or binned image needs a solution of its own"
            )
        elif _bad(frame).all():
            left_out[frame.name] = "every pixel is masked"
        else:
            frames.append(frame)
    if not frames:
        raise InputError(f"no exposure to co-add: {_reasons(left_out) or 'the list is empty'}")
    if left_out:
        warnings.warn(f"left out of the mosaic: {_reasons(left_out)}", AssumptionWarning, stacklevel=3)
    return frames, left_out


def _reasons(left_out):
    return "; ".join(f"{name}: {reason}" for name, reason in left_out.items())


def _by_name(argument, given, frames):
    """A dict of positive numbers by exposure, checked."""
    for frame in frames:
        value = given.get(frame.name)
        if not (isinstance(value, (int, float, np.number)) and np.isfinite(value) and value > 0):
            raise InputError(f"{argument} of exposure {frame.name} must be a positive number, got {value!r}")
    return {f.name: float(given[f.name]) for f in frames}


def _scales(frames, scale):
    if isinstance(scale, Mapping):
        return _by_name("scale", scale, frames)
    if scale not in ("exptime", None):
        raise InputError(f"scale must be 'exptime', None or a dict by exposure, got {scale!r}")
    times = [f.exposure_time for f in frames]
    same = dict.fromkeys((f.name for f in frames), 1.0)
    unit = str(frames[0].header.get("BUNIT", "")).replace(" ", "").lower()
    if scale is None or len(set(times)) == 1 or unit.endswith(("/s", "/sec", "s-1", "s**-1", "s^-1")):
        return same
    if None in times:
        missing = ", ".join(f.name for f in frames if f.exposure_time is None)
        warnings.warn(
            f"no exposure time known for {missing}: the exposures are taken to be equally long; "
            "give scale={name: factor} if they are not",
            AssumptionWarning,
            stacklevel=3,
        )
        return same
    return {f.name: np.mean(times) / f.exposure_time for f in frames}


def _weights(frames, weights, noise):
    if isinstance(weights, Mapping):
        return _by_name("weights", weights, frames)
    if weights not in ("noise", None):
        raise InputError(f"weights must be 'noise', None or a dict by exposure, got {weights!r}")
    if weights is None or min(noise.values()) == 0:
        return dict.fromkeys(noise, 1.0)
    best = min(noise.values())
    return {name: (best / sigma) ** 2 for name, sigma in noise.items()}


def _noise(frame):
    """Background noise: median of the uncertainties, or from the differences of neighbours.

    Stars and gradients hardly touch these differences. Zero if there is none that float32 could hold.
    """
    bad = _bad(frame)
    step = max(1, frame.shape[0] // 512)
    data = np.where(bad, np.nan, frame.data if frame.uncertainty is None else frame.uncertainty)[::step]
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
    return sigma if sigma > np.finfo(np.float32).eps * np.abs(frame.data[~bad]).max() else 0.0


def _backgrounds(frames, solution, output, factors):
    """Background level of every exposure, by differences of block medians where exposures overlap.

    Levels of exposures that do not overlap, even through others, are their own medians.
    """
    ny, nx = output.shape
    n_points = min(4096, max(400, 400_000 // len(frames)))
    step = np.sqrt(ny * nx / n_points)
    gx, gy = np.meshgrid(np.arange(step / 2, nx, step), np.arange(step / 2, ny, step))
    points = np.stack([gx.ravel(), gy.ravel()], axis=1)
    samples = np.full((len(frames), len(points)), np.nan)
    own = np.empty(len(frames))
    for i, frame in enumerate(frames):
        blocks = factors[frame.name] * _block_medians(fill_bad(frame.data, _bad(frame)))
        own[i] = np.median(blocks)
        xy = trace(points, frame.name, solution, output)[:, :2]
        inside = np.all((xy >= -0.5) & (xy < np.array(frame.shape[::-1]) - 0.5), axis=1)
        column, row = ((xy[inside] + 0.5) * np.array(blocks.shape[::-1]) / frame.shape[::-1]).astype(int).T
        samples[i, inside] = blocks[row, column]
    return dict(zip([f.name for f in frames], _match_levels(samples, own), strict=True))


def _block_medians(data):
    ny, nx = (max(1, n // _BLOCK) for n in data.shape)
    rows = np.array_split(np.arange(data.shape[0]), ny)
    columns = np.array_split(np.arange(data.shape[1]), nx)
    return np.array([[np.median(data[r[0] : r[-1] + 1, c[0] : c[-1] + 1]) for c in columns] for r in rows])


def _match_levels(samples, own):
    """Levels whose differences are the median differences of all pairs, by least squares; means as in `own`."""
    n = len(samples)
    difference, count = np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(i):
            d = samples[i] - samples[j]
            d = d[np.isfinite(d)]
            if d.size:
                difference[i, j], count[i, j] = np.median(d), d.size
    difference, count = difference - difference.T, count + count.T
    laplacian = np.diag(count.sum(axis=1)) - count
    levels = np.linalg.lstsq(laplacian, (count * difference).sum(axis=1), rcond=1e-12)[0]
    _, group = connected_components(count > 0, directed=False)
    for g in np.unique(group):
        levels[group == g] += (own - levels)[group == g].mean()
    return levels


def reference_grid(names, solution):
    """The smallest grid of reference-plane pixels that holds all exposures named.

    Returns
    -------
    Grid
        Its pixels are pixels of the reference plane, shifted by whole pixels.
    """
    edges = np.concatenate([solution.correct(name, outline(solution.shapes[name])) for name in names])
    low = np.ceil(edges.min(axis=0) - 1e-6).astype(int)
    nx, ny = np.floor(edges.max(axis=0) + 1e-6).astype(int) - low + 1
    wcs = WCS(naxis=2)
    wcs.array_shape = (ny, nx)
    if solution.sky is None:
        wcs.wcs.ctype = ["LINEAR", "LINEAR"]
        wcs.wcs.crpix = 1 - low
        wcs.wcs.crval = [0, 0]
    else:
        matrix = np.asarray(solution.sky.matrix, dtype=float)
        wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
        wcs.wcs.cunit = ["deg", "deg"]
        wcs.wcs.cd = matrix[:, :2]
        wcs.wcs.crval = [solution.sky.lon, solution.sky.lat]
        wcs.wcs.crpix = np.linalg.solve(matrix[:, :2], -matrix[:, 2]) - low + 1
        wcs.wcs.radesys = "ICRS"
    wcs.wcs.set()
    logger.info("mosaic of %d x %d px on the reference plane", nx, ny)
    return Grid((int(ny), int(nx)), wcs, (int(low[0]), int(low[1])), solution.sky)


def _given_grid(grid, solution):
    if isinstance(grid, fits.Header):
        shape = (grid.get("NAXIS2"), grid.get("NAXIS1"))
        wcs = WCS(grid)
        wcs.array_shape = None if None in shape else shape
    elif isinstance(grid, WCS):
        wcs = grid.deepcopy()
    else:
        raise InputError(f"grid must be None, an astropy WCS or a FITS header, got {type(grid).__name__}")
    if not wcs.has_celestial or wcs.naxis != 2:
        raise InputError("grid must have two axes, both celestial; grid=None takes the reference plane")
    if wcs.array_shape is None:
        raise InputError("grid has no shape: give NAXIS1 and NAXIS2 in the header, or set wcs.array_shape = (ny, nx)")
    if solution.sky is None:
        raise InputError(
            "the solution is not tied to the sky, so it cannot be put on a celestial grid; "
            "measure frames with a header WCS, or give grid=None"
        )
    return Grid(tuple(int(n) for n in wcs.array_shape), wcs, None, solution.sky)


def _check_memory(output, frames, method):
    """Refuse what the machine cannot hold."""
    ny, nx = output.shape
    per_frame = 100 if method == "mean" else 8 * len(frames) + 100  # bytes a pixel of the largest exposure
    need = 36 * ny * nx + per_frame * max(np.prod(f.shape) for f in frames)
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not a POSIX system
        memory = 16 << 30
    if need > memory:
        raise InputError(
            f"a mosaic of {nx} x {ny} px from {len(frames)} exposures needs {need / 2**30:.0f} GB, this machine has "
            f"{memory / 2**30:.0f}; are the poses right? Else use a coarser grid or method='mean'"
        )


def _header(frames, left_out, factors, settings):
    header = fits.Header()
    for key in _COPIED:
        values = {str(f.header.get(key, "")) for f in frames}
        if len(values) == 1 and values != {""}:
            header[key] = values.pop()
    times = [f.exposure_time for f in frames]
    if None not in times:
        header["EXPTIME"] = (times[0] * factors[frames[0].name], "[s] exposure time that the values stand for")
        header["TEXPTIME"] = (sum(times), "[s] sum of the exposure times")
    header["NCOMBINE"] = (len(frames), "number of exposures combined")
    for key, value in settings.items():
        if value is not None:
            header[key] = value
    header["CREATOR"] = f"legdistort {version('legdistort')}"
    for i, frame in enumerate(frames[:999], start=1):
        header[f"IMCMB{i:03d}"] = frame.name
    for name, reason in left_out.items():
        header.add_history(f"left out {name}: {reason}")
    return header
