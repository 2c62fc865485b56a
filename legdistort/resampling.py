"""One detector image -> the output grid: exact pixel maps on Chebyshev nodes, with reproject as the engine.

reproject computes coordinates through the sky for every pixel, four fifths of its time. Here it is handed
tiny WCS objects whose world *is* the output grid, and a pixel map that was evaluated on a few Chebyshev nodes
and interpolated by small matrix products: where the output lies on the reference plane the map is a
polynomial, so this is exact; elsewhere it is checked on random pixels.
"""

import logging
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from astropy.wcs.wcsapi import BaseLowLevelWCS
from numpy.polynomial.chebyshev import chebvander
from scipy.ndimage import map_coordinates

from . import poses
from .distortion import outside

logger = logging.getLogger(__name__)

ALGORITHMS = ("interp", "adaptive", "exact")
_NODES = 24
_TOLERANCE = 1e-6  # largest error of an interpolated map, px (and relative, for the determinant)
_BAD_WEIGHT = 0.05  # an output pixel with a larger share of bad pixels is left empty
_CHUNK = 1 << 16


@dataclass(frozen=True, eq=False)
class Grid:
    """Pixel grid of a mosaic.

    Attributes
    ----------
    shape : tuple
        ``(ny, nx)``.
    wcs : `~astropy.wcs.WCS`
        Celestial, or linear (world = reference plane) if the sky is not known.
    offset : tuple of int or None
        ``(ox, oy)``: a pixel (x, y) lies at (x + ox, y + oy) on the reference plane. None = elsewhere on the sky.
    sky : `~legdistort.poses.TangentPlane` or None
    """

    shape: tuple
    wcs: WCS
    offset: tuple | None = None
    sky: poses.TangentPlane | None = None

    def to_reference(self, xy):
        """Output pixels (n, 2) -> reference plane."""
        if self.offset is not None:
            return xy + np.array(self.offset)
        return self.sky.from_sky(self.wcs.pixel_to_world(xy[:, 0], xy[:, 1]))

    def from_reference(self, xy):
        """Reference plane (n, 2) -> output pixels."""
        if self.offset is not None:
            return xy - np.array(self.offset)
        return np.stack(self.wcs.world_to_pixel(self.sky.to_sky(xy)), axis=-1)

    def pixel_area(self, xy):
        """Area of output pixels (n, 2), in pixels of the reference plane."""
        if self.offset is not None:
            return np.ones(len(xy))
        step = np.array([0.5, 0.0])
        dx = self.to_reference(xy + step) - self.to_reference(xy - step)
        dy = self.to_reference(xy + step[::-1]) - self.to_reference(xy - step[::-1])
        return np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Where the pixels of a piece of the output grid lie on one detector.

    Attributes
    ----------
    window : tuple of slice
        ``(rows, columns)`` of the piece on the output grid.
    xy : ndarray, shape (2, ny, nx)
        Detector pixels.
    inside : ndarray of bool, shape (ny, nx)
        Whether they lie within the centres of the outermost ones, and where the distortion is valid.
    area : ndarray, shape (ny, nx)
        ``|det dD/dX|`` times the area of an output pixel: detector pixels per output pixel.
    corners : ndarray or None, shape (2, my + 1, mx + 1)
        Corners of the detector pixels on the piece, only for the exact algorithm.
    """

    window: tuple
    xy: np.ndarray
    inside: np.ndarray
    area: np.ndarray
    corners: np.ndarray | None = None


def map_exposure(name, solution, grid, *, corners=False):
    """The `PixelMap` of an exposure, or None where it does not meet the grid.

    Parameters
    ----------
    name : str
        Of the exposure.
    solution : Solution
        With its pose, shape and distortion.
    grid : Grid
        The output grid.
    corners : bool
        Also map the corners of the detector pixels.
    """
    xy = grid.from_reference(solution.correct(name, outline(solution.shapes[name])))
    low = np.maximum(np.floor(np.nanmin(xy, axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(np.nanmax(xy, axis=0)) + 1, grid.shape[::-1]).astype(int)
    if np.any(high <= low):
        return None
    shape = tuple((high - low)[::-1])
    *planes, area = tabulate(lambda p: trace(p, name, solution, grid), low, shape)
    planes = np.array(planes)
    valid = solution.distortion(name).inverse.valid
    ny, nx = solution.shapes[name]
    # Interpolation needs data on both sides: beyond the outermost centres it would be extrapolation.
    centres = (-_TOLERANCE, nx - 1 + _TOLERANCE, -_TOLERANCE, ny - 1 + _TOLERANCE)
    inside = ~(outside(valid, planes[2], planes[3]) | outside(centres, planes[0], planes[1]))
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    edges = None
    if corners:
        edges = tabulate(lambda p: _forward(p - 0.5, name, solution, grid) - low, (0, 0), (ny + 1, nx + 1))
    return PixelMap(window, planes[:2], inside, area, edges)


def outline(shape, n=65):
    """Points along the outermost pixel centres of a detector ``(ny, nx)``, shape (4 n, 2)."""
    ny, nx = shape
    t, one = np.linspace(0, 1, n), np.ones(n)
    sides = [(t, 0 * one), (t, one), (0 * one, t), (one, t)]
    return np.concatenate([np.stack(s, axis=1) for s in sides]) * [nx - 1, ny - 1]


def trace(xy, name, solution, grid):
    """Exact chain of one exposure at output pixels.

    Parameters
    ----------
    xy : ndarray, shape (n, 2)
        Output pixels.
    name, solution, grid
        As for `map_exposure`.

    Returns
    -------
    ndarray, shape (n, 5)
        Detector x, y; undistorted x, y; detector pixels per output pixel. The distortion is not cut at the
        edge of its validity, so that it stays smooth.
    """
    pose, distortion = solution.poses[name], solution.distortion(name)
    q = poses.apply(pose, grid.to_reference(xy))
    j = distortion.jacobian(q)
    determinant = (j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]) * np.linalg.det(pose[:, :2])
    return np.column_stack([distortion(q), q, np.abs(determinant) * grid.pixel_area(xy)])


def _forward(xy, name, solution, grid):
    q = solution.distortion(name).invert(xy)
    return grid.from_reference(poses.apply(poses.invert(solution.poses[name]), q))


def tabulate(function, corner, shape):
    """A smooth function on a grid of pixels, from its values on Chebyshev nodes.

    Parameters
    ----------
    function : callable
        ``function(xy (n, 2)) -> (n, k)``.
    corner : array_like
        ``(x, y)`` of the first pixel.
    shape : tuple
        ``(ny, nx)``.

    Returns
    -------
    ndarray, shape (k, ny, nx)
        Compared with `function` on 200 random pixels; if they differ by more than 1e-6, every pixel is
        evaluated instead, which takes a hundred times longer.
    """
    ny, nx = shape
    corner = np.asarray(corner, dtype=float)
    t = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    gx, gy = np.meshgrid((t + 1) * nx / 2 - 0.5, (t + 1) * ny / 2 - 0.5)
    values = function(np.stack([gx.ravel(), gy.ravel()], axis=1) + corner).T.reshape(-1, _NODES, _NODES)
    weights = np.linalg.inv(chebvander(t, _NODES - 1))
    wy, wx = (chebvander((np.arange(n) + 0.5) * 2 / n - 1, _NODES - 1) @ weights for n in shape)
    out = np.empty((len(values), ny, nx))
    for plane, v in zip(out, values, strict=True):
        np.matmul(wy, v @ wx.T, out=plane)
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, nx, 200), rng.integers(0, ny, 200)
    exact = function(np.stack([x, y], axis=1) + corner).T
    if np.all(np.abs(out[:, y, x] - exact) <= _TOLERANCE):
        return out
    logger.info("the pixel map is not smooth enough for %d nodes, every pixel is evaluated", _NODES)
    flat = out.reshape(len(out), -1)
    for start in range(0, nx * ny, _CHUNK):
        y, x = np.divmod(np.arange(start, min(start + _CHUNK, nx * ny)), nx)
        flat[:, start : start + _CHUNK] = function(np.stack([x, y], axis=1) + corner).T
    return out


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


def resample(planes, pixel_map, *, algorithm="interp", order=1):
    """Images of one detector on the output grid, surface brightness conserved.

    Parameters
    ----------
    planes : ndarray, shape (k, ny, nx)
        The images.
    pixel_map : PixelMap
        With the corners for 'exact'.
    algorithm : {'interp', 'adaptive', 'exact'}
        One of reproject's.
    order : int
        Of the spline, for 'interp'.

    Returns
    -------
    ndarray, shape (k, my, mx)
        NaN outside the detector.
    """
    import reproject  # brings dask along, which takes a third of a second

    options = {"shape_out": (len(planes), *pixel_map.area.shape), "return_footprint": False}
    if algorithm == "exact":
        scale = 1 / max(pixel_map.area.shape)
        wcs_in, wcs_out = _TableWCS(to_world=pixel_map.corners, scale=scale), _TableWCS(scale=scale)
        out = reproject.reproject_exact((planes, wcs_in), wcs_out, **options)
    else:
        options["roundtrip_coords"] = False
        if algorithm == "interp":
            out = reproject.reproject_interp((planes, _TableWCS(pixel_map.xy)), _TableWCS(), order=order, **options)
        else:  # asks one pixel beyond the grid, which is extrapolated linearly
            wider = np.pad(pixel_map.xy, ((0, 0), (1, 1), (1, 1)), mode="reflect", reflect_type="odd")
            out = reproject.reproject_adaptive((planes, _TableWCS(wider, margin=1)), _TableWCS(), **options)
    out[:, ~pixel_map.inside] = np.nan
    return out


def resample_exposure(data, bad, variance, pixel_map, *, algorithm="interp", order=3):
    """An image, its bad pixels and its variance on the output grid, surface brightness conserved.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
        The image.
    bad : ndarray of bool, shape (ny, nx)
        Replaced by an estimate from their neighbours, so that they do not ring through the spline; output
        pixels where their share is above 5 % are NaN.
    variance : ndarray, shape (ny, nx), or float
        Of independent pixels.
    pixel_map : PixelMap
        Of its exposure.
    algorithm, order
        See `resample`.

    Returns
    -------
    data, variance : ndarray, shape (my, mx)
        The variance is that of each output pixel by itself; interpolation lowers it and correlates neighbours.
    """
    mean = np.mean(variance, where=~bad) if np.ndim(variance) else float(variance)
    extra = [bad.astype(np.float32)] if bad.any() else []
    if np.ndim(variance):
        extra.append(np.where(bad, mean, variance))
    if algorithm != "interp":  # their smoothing is measured with white noise of unit variance
        extra.append(np.random.default_rng(1).standard_normal(data.shape))
    image = [fill_bad(data, bad)]
    if algorithm == "interp" and order > 1:
        out = [*resample(np.array(image), pixel_map, order=order)]
        out += [*resample(np.array(extra), pixel_map, order=1)] if extra else []
    else:
        out = [*resample(np.array(image + extra), pixel_map, algorithm=algorithm, order=order)]
    value = out.pop(0)
    gain = _spline_gain(order, pixel_map.xy) if algorithm == "interp" else np.nanvar(out.pop())
    if bad.any():
        value[~(out.pop(0) <= _BAD_WEIGHT)] = np.nan
    return value, gain * (out.pop() if out else mean)


def fill_bad(data, bad, radius=2):
    """Replace bad pixels by a weighted mean of the good ones near by, or the median of all good ones."""
    if not bad.any():
        return data
    y, x = np.nonzero(bad)
    good = np.pad(~bad, radius)
    padded = np.pad(np.where(bad, 0, data), radius)
    total, norm = np.zeros(len(x)), np.zeros(len(x))
    for dy, dx in np.ndindex(2 * radius + 1, 2 * radius + 1):
        weight = np.exp(-((dy - radius) ** 2 + (dx - radius) ** 2) / 2) * good[y + dy, x + dx]
        total += weight * padded[y + dy, x + dx]
        norm += weight
    out = data.copy()
    out[y, x] = np.where(norm > 0, total / np.where(norm > 0, norm, 1), np.median(data[~bad]))
    return out


def _spline_gain(order, xy):
    """Variance of an interpolated pixel for unit white noise, from the fractions of its coordinates."""
    table = _gain_table(order)
    index = ((xy - np.floor(xy)) * (len(table) - 1)).astype(np.intp)
    return table[index[0]] * table[index[1]]


@lru_cache
def _gain_table(order, n=256, reach=20):
    """Sum of the squared weights of a spline at n + 1 fractions of a pixel."""
    impulse = np.zeros(2 * reach + 1)
    impulse[reach] = 1
    fraction = np.linspace(0, 1, n + 1)
    coordinates = reach + np.arange(-reach + 1, reach)[:, None] - fraction
    return (map_coordinates(impulse, [coordinates], order=order) ** 2).sum(axis=0)
