"""Pieces of detector images -> pieces of the output grid, with reproject as the engine.

It is handed tiny WCS objects whose world *is* the output grid, and a pixel map
(`legdistort.coaddition.resampling.pixel_maps`), since coordinates through the sky would take most of its time. For many
pixels, compiled twins of its splines take over (`legdistort.coaddition.resampling.compiled_splines`).
"""

from dataclasses import dataclass

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.wcs.wcsapi import BaseLowLevelWCS

from ...runtime.optional import has_fast

_FORGETS = 2, 2, 12, 16, 20, 24  # pixels by which a spline of that order has forgotten, to 1e-8
#: Pixels of all exposures from which compiled splines are used, if numba is installed.
COMPILED_FROM = 1 << 22


@dataclass(frozen=True)
class Resampling:
    """How exposures are resampled.

    Attributes
    ----------
    algorithm : {'interp', 'adaptive', 'exact', 'drizzle'}
        Which of reproject's, or that of STScI.
    order : int
        Of the spline, for 'interp'.
    kernel : {'square', 'turbo', 'point'}
        Of drizzle's drops: a square that turns and shears with the distortion, one along the axes of the output, or a
        point.
    pixfrac : float
        Side of a drop, as a fraction of the pixel's, above 0 up to 1.
    compiled : bool
        Splines by compiled loops, see `uses_compiled_splines`.
    """

    algorithm: str = "interp"
    order: int = 3
    kernel: str = "square"
    pixfrac: float = 1.0
    compiled: bool = False

    def __str__(self):
        kind = {"interp": f" {self.order}", "drizzle": f" {self.kernel} {self.pixfrac:g}"}
        return self.algorithm + kind.get(self.algorithm, "")

    @property
    def margin(self):
        """Pixels of an exposure, around those that are wanted, on which their values depend."""
        return _FORGETS[self.order] if self.algorithm == "interp" else 10


def uses_compiled_splines(algorithm, order, n_pixels):
    """Whether the splines of `legdistort.coaddition.resampling.compiled_splines` serve so many pixels."""
    return algorithm == "interp" and order in (1, 3) and n_pixels >= COMPILED_FROM and has_fast()


class _TableWCS(BaseLowLevelWCS):
    """A WCS whose world is the output grid; a table of coordinates stands for the transformation.

    reproject asks at whole pixels of the grid (and at pixel corners, half a pixel off, for the exact
    algorithm), so that a look-up is exact, in whatever order or thread it asks.

    Parameters
    ----------
    to_pixel, to_world : ndarray, shape (2, ny, nx), optional
        Tables of the two directions; None = identity.
    margin : int, optional
        Pixels by which `to_pixel` extends beyond the grid on every side.
    scale : float, optional
        The world is ``scale`` times the grid, as degrees on the sky: the exact algorithm wants a sphere, of
        which so small a piece at the equator is flat. None = plain pixels.
    """

    def __init__(self, to_pixel=None, to_world=None, *, margin=0, scale=None):
        self._to_pixel, self._to_world, self._margin, self._scale = to_pixel, to_world, margin, scale

    pixel_n_dim = world_n_dim = 2
    world_axis_physical_types = (None, None)

    @property
    def world_axis_units(self):
        return ("deg", "deg") if self._scale else ("pix", "pix")

    @property
    def world_axis_object_classes(self):
        if self._scale:
            return {"sky": (SkyCoord, (), {"frame": "icrs", "unit": "deg"})}
        return {axis: (u.Quantity, (), {"unit": "pix", "copy": False}) for axis in "xy"}

    @property
    def world_axis_object_components(self):
        if self._scale:
            return [("sky", 0, "spherical.lon.degree"), ("sky", 1, "spherical.lat.degree")]
        return [("x", 0, "value"), ("y", 0, "value")]

    def pixel_to_world_values(self, x, y):
        if self._to_world is not None:
            x, y = _look_up(self._to_world, np.add(x, 0.5), np.add(y, 0.5))
        return (np.multiply(x, self._scale), np.multiply(y, self._scale)) if self._scale else (x, y)

    def world_to_pixel_values(self, x, y):
        if self._scale:
            x = (np.asarray(x) + 180) % 360 - 180
            return x / self._scale, np.divide(y, self._scale)
        return (x, y) if self._to_pixel is None else _look_up(self._to_pixel, x, y, self._margin)


def _look_up(table, x, y, margin=0):
    """Rows of a table (2, ny, nx) at whole pixels (x, y)."""
    planes = table.reshape(2, -1)
    x, y, nx = np.asarray(x), np.asarray(y), table.shape[2]
    some = np.arange(0, planes.shape[1], 997)
    if x.shape == planes[0].shape and np.array_equal(y[some] * nx + x[some], some):
        return tuple(planes)  # the whole grid in its order, as reproject_interp asks
    index = ((y + margin) * nx + (x + margin)).astype(np.intp)
    return tuple(plane[index] for plane in planes)


def resample(planes, pixel_map, resampling):
    """Images of one detector on the output grid, surface brightness conserved.

    Parameters
    ----------
    planes : sequence of ndarray, shape (ny, nx)
        The images.
    pixel_map : `~legdistort.coaddition.resampling.pixel_maps.PixelMap`
        With what the algorithm asks for.
    resampling : Resampling
        By any algorithm but drizzle.

    Returns
    -------
    ndarray, shape (k, my, mx)
        NaN outside the detector.
    """
    if resampling.compiled:
        from . import compiled_splines

        out = np.empty((len(planes), *pixel_map.area.shape))
        for plane, values in zip(planes, out, strict=True):
            compiled_splines.interpolate(plane, pixel_map.xy, resampling.order, values)
    else:
        out = _reproject(planes, pixel_map, resampling)
    if not pixel_map.inside.all():
        out[:, ~pixel_map.inside] = np.nan
    return out


def _reproject(planes, pixel_map, resampling):
    import reproject  # brings dask along, which takes a third of a second

    planes = np.asarray(planes)
    options = {"shape_out": (len(planes), *pixel_map.area.shape), "return_footprint": False}
    if resampling.algorithm == "exact":
        scale = 1 / max(pixel_map.area.shape)
        wcs_in, wcs_out = _TableWCS(to_world=pixel_map.corners, scale=scale), _TableWCS(scale=scale)
        return reproject.reproject_exact((planes, wcs_in), wcs_out, **options)
    options["roundtrip_coords"] = False
    if resampling.algorithm == "interp":
        options["order"] = resampling.order
        return reproject.reproject_interp((planes, _TableWCS(pixel_map.xy)), _TableWCS(), **options)
    # asks one pixel beyond the grid
    return reproject.reproject_adaptive((planes, _TableWCS(pixel_map.wider, margin=1)), _TableWCS(), **options)
