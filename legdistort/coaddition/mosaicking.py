"""Resample exposures with the solution's distortions and combine them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..exceptions import AssumptionWarning, InputError, reasons_of, warn
from ..geometry.star_hull import support
from ..inputs.frames.value_units import value_unit
from ..inputs.frames.working_units import header_in_working_unit, working_unit
from ..inputs.sky_wcs import leads_elsewhere, warn_of_another_field
from ..results.solution import Solution
from ..runtime.guards.units import plain_numbers
from ..runtime.parallel import map_items
from ..runtime.scratch import scratch_folder
from .background import match_backgrounds
from .block_stack import Layer, Recipe, assemble, n_bytes
from .flux_scales import flux_scales
from .grids import given_grid, reference_grid
from .mosaic import Mosaic
from .mosaic_header import mosaic_header
from .options import CoaddOptions
from .preparation import prepare
from .resampling import engines, noise_gain, pixel_maps
from .selection import check_order, select_images, warn_of_left_out
from .weights import make_weights, stellar_widths

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.wcs import WCS

    from ..inputs.exposures import Exposure
    from ..results.solution import Solution
    from ..runtime.annotations import StrPath

_STORED = 5  # bytes a pixel in the scratch folder, about
_COARSE = 1.5  # pixels of the grid in those of an exposure from which interpolation leaves out too much


@plain_numbers
def coadd(
    exposures: Sequence[Exposure],
    solution: Solution,
    *,
    method: str = "mean",
    order: int | str = 3,
    algorithm: str = "interp",
    grid: WCS | Header | None = None,
    conserve: str = "flux",
    match_background: bool = True,
    weights: str | Mapping[str, Any] | None = "noise",
    scale: str | Mapping[str, float] | None = "auto",
    extrapolated: str = "flag",
    pixfrac: float = 1.0,
    kernel: str = "square",
    workers: int | None = None,
    scratch: StrPath | None = None,
    planes: str | Sequence[str] | None = None,
    progress: bool = False,
) -> Mosaic:
    """Co-add exposures on the distortion-free reference plane, or on any celestial WCS.

    Parameters
    ----------
    exposures : sequence of Exposure
        The images; or those of `legdistort.open_exposures`, of which only some are in memory at a time.
    solution : Solution
        With the distortion of every exposure; an exposure without one is left out with a warning.
    method : {'mean', 'median', 'clipped'}
        Weighted mean; median; or weighted mean of what the others confirm, without cosmic rays, hot pixels and trails,
        where at least three exposures meet (`legdistort.coaddition.combination.confirmed`).
    order : int or str
        Order of the spline, 0 to 5, or the name that reproject gives it, such as 'bilinear'.
    algorithm : {'interp', 'adaptive', 'exact', 'drizzle'}
        One of reproject's algorithms, or that of STScI; `order` applies to 'interp' only. 'exact' is fifty times
        slower. 'drizzle' with `pixfrac` 1 is the same, fast; it needs the extra ``legdistort[drizzle]``.
    grid : `~astropy.wcs.WCS` or `~astropy.io.fits.Header`, optional
        Output grid, with its shape. The default is the reference plane, pixel for pixel, as large as all
        exposures need.
    conserve : {'flux', 'surface_brightness'}
        'flux' multiplies by the determinant of the distortion, so that a star has the flux of the exposures.
        'surface_brightness' leaves pixel values as they are interpolated; so does 'flux' where their unit (``BUNIT``)
        is that of an area, as MJy/sr: light is then values times the area of pixels.
    match_background : bool
        Bring the backgrounds to one level, by robust differences where exposures overlap. The level is then
        left out of the multiplication for 'flux', so that a flat sky stays flat.
    weights : {'noise', 'variance', 'exptime', 'seeing', 'sigma_map', None} or dict
        Of the exposures in a mean: 1/sigma^2 of their background noise; the same by pixel, from the uncertainty planes
        without the photons of stars; exposure time; 'noise' / FWHM^2; 'noise' times s^2 / (s^2 + e^2), e being
        the error of the distortion correction (`View.sigma_map`) and s = 0.02 FWHM that of a star of
        signal-to-noise ratio 20; equal; or by name.
    scale : {'auto', 'exptime', 'stars', None} or dict
        Factors by which data are multiplied: 'exptime' brings all to the mean exposure time if times differ (rates
        and calibrated units are left alone); 'stars' makes the measured fluxes of common stars agree; 'auto' goes by
        time unless stars differ from that by more than 2 % and 3 sigma, as through clouds, or times are not known;
        none; or by name.
    extrapolated : {'flag', 'mask', 'keep'}
        Pixels outside the stars used of an exposure, where its distortion is extrapolated (`View.supported`): used
        and flagged in the mosaic; left out; or used.
    pixfrac, kernel
        For 'drizzle': side of the drops as a fraction of a pixel, and their shape, 'square', 'turbo' or 'point'.
    workers : int, optional
        Threads that share the work; processes for 'drizzle', whose package keeps Python's lock. None = the current
        ``dask.distributed.Client`` if there is one, else this one. The mosaic is the same, bit for bit.
    scratch : str or path, optional
        Folder for the pixels of the exposures while work goes on, 4 to 11 bytes for each (17 in double precision), and
        for those of the mosaic, 21 or more, as long as it is in use; the workers of a cluster must see it. The default
        is that of the system (``TMPDIR``), which some systems keep in memory.
    planes : str or sequence of str, optional
        What `Mosaic.write` puts beside the image: of ``"UNCERT"``, ``"MASK"``, ``"WEIGHT"``, ``"FOOTPRINT"``,
        ``"FLAGS"``, ``"EXTRAPOLATED"``, ``"REJECTED"``, ``"CONTEXT"``, or ``"all"`` of them; an empty sequence for
        nothing. None = errors, mask and number of exposures (``UNCERT``, ``MASK``, ``FOOTPRINT``).
    progress : bool
        Show progress bars.

    Returns
    -------
    Mosaic

    Raises
    ------
    InputError
        For a wrong option, an exposure whose shape is not that of the solution, a grid without sky or shape, no
        exposure left, or none on the grid.
    DiskFullError
        If the disk of `scratch` is full, or has less space than will be needed. Nothing is left behind.

    See Also
    --------
    legdistort.solve : The WCSs that it resamples with.
    legdistort.Mosaic : What comes out.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=4, seed=1)
    >>> exposures = ld.read_exposures(list(night.hdus.values()))
    >>> solution = ld.solve(ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures))
    >>> ld.coadd(exposures, solution, method="median").exposures
    ('exp00', 'exp01', 'exp02', 'exp03')
    """
    check_order(exposures, solution, "coadd")
    options = CoaddOptions(
        method=method,
        order=order,
        algorithm=algorithm,
        grid=grid,
        conserve=conserve,
        match_background=match_background,
        weights=weights,
        scale=scale,
        extrapolated=extrapolated,
        pixfrac=pixfrac,
        kernel=kernel,
        scratch=scratch,
        planes=planes,
    )
    share = partial(map_items, workers=workers, threads=True, progress=progress)
    return _coadd(exposures, solution, options, share)


def _coadd(exposures, solution, options, share):
    """The mosaic; `share` is `map_items`, which shares the work among threads or processes."""
    frames, views, left_out = select_images(exposures, solution, "co-add", "the mosaic")
    if all(value_unit(f.header).per_area for f in frames):  # light is values times the area of pixels
        options = replace(options, conserve="surface_brightness")
    options.check_names([*(f.name for f in frames), *left_out])
    if options.grid is None:
        output = reference_grid(list(views.values()), solution.sky)
    else:
        output = given_grid(options.grid, solution.sky)
    corners = options.algorithm in ("exact", "drizzle")
    maps = {name: pixel_maps.map_exposure(view, output, corners=corners) for name, view in views.items()}
    left_out |= {name: "it does not meet the output grid" for name, found in maps.items() if found is None}
    frames = [f for f in frames if maps[f.name] is not None]
    need = n_bytes(output.shape, len(frames)) + _STORED * sum(int(np.prod(f.shape)) for f in frames)
    ny, nx = output.shape
    what = f"a mosaic of {nx} x {ny} px and the pixels of {len(frames)} exposures"
    with scratch_folder(options.scratch, need, what) as folder:
        unit = _working_unit(solution)
        found = list(share(partial(prepare, folder=folder, unit=unit), frames, description="reading"))
        unfit = {f.name: reason for f, reason in zip(frames, found, strict=True) if isinstance(reason, str)}
        warn_of_left_out(unfit, "the mosaic")
        left_out |= unfit
        prepared = {f.name: one for f, one in zip(frames, found, strict=True) if f.name not in unfit}
        frames = [_in_unit(f, unit) for f in frames if f.name in prepared]
        if not frames:
            raise InputError(f"no exposure meets the output grid: {reasons_of(left_out)}")
        areas = None if options.conserve == "flux" else {f.name: _area(maps[f.name]) for f in frames}
        views = {f.name: views[f.name] for f in frames}
        factors, origin = flux_scales(frames, options.scale, views, areas)
        layers, recipe = _layers(frames, prepared, maps, factors, views, output, options)
        held = options.algorithm == "drizzle"  # its package keeps Python's lock, so that threads would wait for it
        planes = assemble(layers, recipe, folder.parent, partial(share, threads=not held))
    _warn_of_misuse(frames, maps, options.algorithm, views)
    correlation = noise_gain.noise_correlation(layers[0].map, layers[0].gain, recipe.resampling)
    header = mosaic_header(frames, left_out, factors, _settings(options, recipe, origin, correlation))
    names = tuple(f.name for f in frames)
    *planes, extrapolated, rejected = planes
    made = {"exposures": names, "left_out": left_out, "offset": output.offset, "header": header}
    shares = {"extrapolated": extrapolated, "rejected": rejected}
    return Mosaic(*planes, wcs=output.wcs, **made, **shares, planes=options.planes)


def _working_unit(solution):
    """The factor on data whose squares single precision would not hold, by the fluxes of the stars."""
    rows = solution.residuals
    return working_unit(np.asarray(rows["flux"], dtype=float)) if "flux" in rows.colnames else 1.0


def _in_unit(frame, unit):
    """What is known of a frame, for data that were multiplied by a factor."""
    if unit == 1.0:
        return frame
    header = header_in_working_unit(frame.header, unit)
    return replace(frame, header=header, gain=frame.gain and frame.gain / unit)


def _layers(frames, prepared, maps, factors, views, output, options):
    """The layers, and how they become a mosaic."""
    backgrounds = [prepared[f.name].background for f in frames]
    sky = match_backgrounds(backgrounds, views, output, factors)
    noise = {b.name: factors[b.name] * b.noise for b in backgrounds}
    weights = make_weights(options.weights, noise, views, times={f.name: f.exposure_time for f in frames})
    fwhm = stellar_widths(views)
    flux = options.conserve == "flux"
    area = {f.name: _area(maps[f.name]) if flux else 1.0 for f in frames}
    n_pixels = sum(np.prod(f.shape) for f in frames)
    resampling = options.resampling(n_pixels)
    layers = [
        Layer(
            index=i,
            stored=prepared[f.name].stored,
            map=maps[f.name],
            background=prepared[f.name].background,
            factor=factors[f.name],
            variance=noise[f.name] ** 2,
            sky=sky[f.name] if options.match_background else None,
            weight=weights[f.name],
            fwhm=fwhm and fwhm[f.name],
            gain=engines.white_gain(maps[f.name], resampling),
            photons=_photons(f, prepared[f.name], factors[f.name], noise[f.name] ** 2 * area[f.name]),
            support=support(views[f.name].residuals) if options.extrapolated != "keep" else None,
        )
        for i, f in enumerate(frames)
    ]
    level = float(np.mean(list(sky.values())))
    if not options.match_background:  # the sky counts as flux as well
        level *= float(np.mean(list(area.values())))
    widths = (min(fwhm.values()), max(fwhm.values())) if fwhm else None
    mask = options.extrapolated == "mask"
    how = {"level": level, "mask": mask, "widths": widths, "compiled": n_pixels >= engines.COMPILED_FROM}
    return layers, Recipe(output.shape, resampling, options.method, options.conserve, **how)


def _photons(frame, prepared, factor, variance):
    """Growth of the variance with the signal, by the gain where there is no uncertainty plane (see `Layer.photons`)."""
    if not frame.gain or "variance" in prepared.stored.planes or variance == 0:
        return 0.0
    return float(factor / (variance * frame.gain))


def _area(exposure_map):
    """Detector pixels per output pixel in the middle of an exposure."""
    area = exposure_map.middle()[4].mean()
    return area if np.isfinite(area) else 1.0


def _warn_of_misuse(frames, maps, algorithm, views):
    """Of another field, of light that is lost between pixels, and of units that do not go together."""
    warn_of_another_field([f.name for f in frames if leads_elsewhere(f.wcs, views[f.name])])
    scale = max(maps[f.name].scale for f in frames)
    if algorithm == "interp" and scale > _COARSE:
        warn(
            f"pixels of the grid are {scale:.1f} times as large as those of the exposures: interpolation leaves light "
            "out; take algorithm='adaptive' or 'drizzle'",
            AssumptionWarning,
        )
    units = [unit for unit in (value_unit(f.header) for f in frames) if unit.text]
    if not all(unit.same_as(units[0]) for unit in units):
        listed = ", ".join(sorted({unit.text for unit in units}))
        warn(f"the units (BUNIT) of the exposures differ: {listed}; values are combined as they are", AssumptionWarning)


def _settings(options, recipe, origin, correlation):
    """Cards that state how the mosaic was made."""
    weights = options.weights
    return [
        ("COMBINE", options.method, "how exposures are combined"),
        ("RESAMPLE", str(recipe.resampling), "how they are resampled, order or kernel"),
        ("CONSERVE", options.conserve, "of stars, or of the sky"),
        ("SKYLEVEL", recipe.level if options.match_background else None, "common level of the backgrounds"),
        ("SCALEBY", origin, "where the flux scales come from"),
        ("EXTRAPOL", options.extrapolated, "pixels outside the stars used"),
        ("WEIGHTS", weights if isinstance(weights, str) else "given" if weights else "equal", "of the exposures"),
        ("NOISECOR", correlation, "noise of sums of pixels over that by UNCERT"),
    ]
