"""Where the pixels of a mosaic lie on each detector: exact maps, tabulated on Chebyshev nodes.

reproject computes coordinates through the sky for every pixel, four fifths of its time. Here the map of an
exposure is evaluated on a few Chebyshev nodes once, and wherever it is wanted by small products of matrices: where the
output lies on the reference plane the map is a polynomial, so this is exact; elsewhere it is checked on random pixels.
"""

import logging
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.polynomial.chebyshev import chebvander

from ...geometry import models, similarity
from ..grids import outline

log = logging.getLogger(__name__)

_NODES = 24
_TOLERANCE = 1e-6  # largest error of a tabulated map, px (and relative, for the determinant)
_NEGLIGIBLE = 1e-10  # coefficients that are left out, px
_CHUNK = 1 << 16


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
    wider : ndarray or None, shape (2, ny + 2, nx + 2)
        `xy` with one more pixel on every side, which the adaptive algorithm asks for.
    corners : ndarray or None, shape (2, my + 1, mx + 1)
        Corners of the detector pixels on the piece, which the exact algorithm asks for.
    """

    window: tuple
    xy: np.ndarray
    inside: np.ndarray
    area: np.ndarray
    wider: np.ndarray | None = None
    corners: np.ndarray | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Table:
    """A smooth function of the pixels of a rectangle.

    Attributes
    ----------
    corner : tuple
        ``(x, y)`` of the first pixel.
    shape : tuple
        ``(ny, nx)``.
    coefficients : ndarray or None, shape (k, my, mx)
        Of Chebyshev polynomials on the rectangle; None = the function is evaluated at every pixel.
    function : callable
        ``function(xy (n, 2)) -> (n, k)``, only where there are no coefficients.
    """

    corner: tuple
    shape: tuple
    coefficients: np.ndarray | None
    function: object = None

    def __call__(self, rows, columns, planes=slice(None)):
        """Values (k, ny, nx) at the pixels of two slices, or some of these planes."""
        if planes != slice(None) and self.coefficients is not None:
            return replace(self, coefficients=self.coefficients[planes])(rows, columns)
        return self.at(*(np.arange(s.start, s.stop, dtype=float) for s in (rows, columns)))[planes]

    def along_edge(self, rows, columns):
        """Values (k, n) at the outermost pixels of two slices; None where there are no coefficients."""
        if self.coefficients is None:
            return None
        y, x = (np.arange(s.start, s.stop, dtype=float) for s in (rows, columns))
        return np.concatenate(
            [self.at(*yx).reshape(len(self.coefficients), -1) for yx in ((y[[0, -1]], x), (y, x[[0, -1]]))], axis=1
        )

    def at(self, y, x):
        """Values (k, ny, nx) where rows y (ny,) meet columns x (nx,)."""
        if self.coefficients is None:
            gx, gy = (g.ravel() for g in np.meshgrid(x, y))
            parts = [slice(start, start + _CHUNK) for start in range(0, gx.size, _CHUNK)]
            values = [self.function(np.stack([gx[part], gy[part]], axis=1)) for part in parts]
            return np.concatenate(values).T.reshape(-1, len(y), len(x))
        _, my, mx = self.coefficients.shape
        wx = chebvander((x - self.corner[0] + 0.5) * 2 / self.shape[1] - 1, mx - 1)
        wy = chebvander((y - self.corner[1] + 0.5) * 2 / self.shape[0] - 1, my - 1)
        # Not by BLAS, whose rounding may depend on the number of threads; in the order of memory, ten times faster.
        along = np.ascontiguousarray(np.einsum("kab,xb->kax", self.coefficients, wx))
        return np.einsum("ya,kax->kyx", np.ascontiguousarray(wy), along)


def tabulate(function, corner, shape):
    """The `Table` of a smooth function of pixels.

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
    Table
        Compared with `function` on 200 random pixels; if they differ by more than 1e-6, every pixel is
        evaluated instead, which takes a hundred times longer.
    """
    corner, (ny, nx) = np.asarray(corner, dtype=float), shape
    t = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    gx, gy = np.meshgrid((t + 1) * nx / 2 - 0.5, (t + 1) * ny / 2 - 0.5)
    values = function(np.stack([gx.ravel(), gy.ravel()], axis=1) + corner).T.reshape(-1, _NODES, _NODES)
    weights = np.linalg.inv(chebvander(t, _NODES - 1))
    coefficients = weights @ values @ weights.T
    large = np.abs(coefficients).max(axis=0) > _NEGLIGIBLE
    my, mx = (int(np.flatnonzero(large.any(axis=axis)).max(initial=0)) + 1 for axis in (1, 0))
    table = Table(tuple(corner), tuple(shape), coefficients[:, :my, :mx])
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, nx, 200), rng.integers(0, ny, 200)
    exact = function(np.stack([x, y], axis=1) + corner).T
    wx, wy = (chebvander((i + 0.5) * 2 / n - 1, m - 1) for i, n, m in ((x, nx, mx), (y, ny, my)))
    if np.all(np.abs(np.einsum("na,kab,nb->kn", wy, table.coefficients, wx) - exact) <= _TOLERANCE):
        return table
    log.info("the pixel map is not smooth enough for %d nodes, every pixel is evaluated", _NODES)
    return Table(tuple(corner), tuple(shape), None, function)


@dataclass(frozen=True, eq=False, repr=False)
class ExposureMap:
    """Where the output grid lies on the detector of one exposure.

    Attributes
    ----------
    shape : tuple
        ``(ny, nx)`` of the detector.
    window : tuple of slice
        ``(rows, columns)`` of the output grid that the exposure may touch.
    table : Table
        What `trace` gives.
    valid : tuple
        Box of undistorted pixels in which the distortion is valid.
    scale : float
        Detector pixels per output pixel, the largest linear one (at least 1).
    corners : Table or None
        Output pixels of the corners of detector pixels, only for the exact algorithm.
    """

    shape: tuple
    window: tuple
    table: Table
    valid: tuple
    scale: float
    corners: Table | None = None

    def middle(self):
        """What `trace` gives at four neighbours in the middle of the window, shape (5, 2, 2)."""
        return self.table.at(*(np.array([-0.5, 0.5]) + (s.start + s.stop - 1) // 2 for s in self.window))

    def piece(self, window, *, margin, border=False):
        """The map of a piece of the output grid, and the piece of the detector that it needs.

        Parameters
        ----------
        window : tuple of slice
            ``(rows, columns)`` on the output grid.
        margin : int
            Pixels of the detector around those that the piece falls on.
        border : bool
            Give `PixelMap.wider`.

        Returns
        -------
        PixelMap, tuple of slice
            The map counts from the first pixel of the piece of the detector; it has the part of the window on which the
            exposure may lie. None if there is no such part.
        """
        rows, columns = (
            slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(window, self.window, strict=True)
        )
        if rows.stop <= rows.start or columns.stop <= columns.start:
            return None
        ny, nx = self.shape
        # Interpolation needs data on both sides: beyond the outermost centres it would be extrapolation.
        centres = (-_TOLERANCE, nx - 1 + _TOLERANCE, -_TOLERANCE, ny - 1 + _TOLERANCE)
        # The map has an inverse where it is valid: what holds along the edge of a piece then holds within.
        edge = self.table.along_edge(rows, columns)
        valid = edge is not None and not models.outside(self.valid, edge[2], edge[3]).any()
        widened = (slice(s.start - border, s.stop + border) for s in (rows, columns))
        everything = self.table(*widened, [0, 1, 4] if valid else [0, 1, 4, 2, 3])
        wider, planes = (everything[:2], everything[:, 1:-1, 1:-1]) if border else (None, everything)
        if valid and not models.outside(centres, edge[0], edge[1]).any():
            inside = np.ones(planes[0].shape, dtype=bool)
        else:
            inside = ~models.outside(centres, planes[0], planes[1])
            if not valid:
                inside &= ~models.outside(self.valid, planes[3], planes[4])
            if not inside.any():
                return None
        seen = edge[:2] if valid else planes[:2, inside]
        part = tuple(
            slice(max(0, int(p.min()) - margin), min(n, int(p.max()) + 2 + margin))
            for p, n in zip(seen[::-1], self.shape, strict=True)
        )
        origin = np.array([part[1].start, part[0].start]).reshape(2, 1, 1)
        edges = None
        if self.corners is not None:
            low = np.array([columns.start, rows.start]).reshape(2, 1, 1)
            edges = self.corners(*(slice(p.start, p.stop + 1) for p in part)) - low
        everything[:2] -= origin
        return PixelMap((rows, columns), planes[:2], inside, planes[2], wider, edges), part


def map_exposure(view, grid, *, corners=False):
    """The `ExposureMap` of an exposure, or None where it does not meet the grid.

    Parameters
    ----------
    view : View
        With its pose, shape and distortion.
    grid : Grid
        The output grid.
    corners : bool
        Also map the corners of the detector pixels.
    """
    xy = grid.from_reference(view.correct(outline(view.shape)))
    low = np.maximum(np.floor(np.nanmin(xy, axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(np.nanmax(xy, axis=0)) + 1, grid.shape[::-1]).astype(int)
    if np.any(high <= low):
        return None
    shape = tuple(view.shape)
    chain = partial(trace, view=view, grid=grid)
    table = tabulate(chain, low, tuple(int(n) for n in (high - low)[::-1]))
    edges = None
    if corners:
        back = partial(_trace_back, view=view, grid=grid)
        edges = tabulate(back, (0, 0), tuple(n + 1 for n in shape))
    window = (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
    ends = chain(np.stack(np.meshgrid(*np.array([low, high]).T), axis=-1).reshape(-1, 2).astype(float))
    scale = float(np.sqrt(max(1, np.nanmax(ends[:, 4], initial=1))))
    return ExposureMap(shape, window, table, tuple(view.distortion.inverse.valid), scale, edges)


def trace(xy, view, grid):
    """Exact chain of one exposure at output pixels.

    Parameters
    ----------
    xy : ndarray, shape (n, 2)
        Output pixels.
    view, grid
        As for `map_exposure`.

    Returns
    -------
    ndarray, shape (n, 5)
        Detector x, y; undistorted x, y; detector pixels per output pixel. The distortion is not cut at the
        edge of its validity, so that it stays smooth.
    """
    pose, distortion = view.pose, view.distortion
    q = similarity.apply(pose, grid.to_reference(xy))
    j = distortion.jacobian(q)
    determinant = (j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]) * np.linalg.det(pose[:, :2])
    return np.column_stack([distortion(q), q, np.abs(determinant) * grid.pixel_area(xy)])


def _trace_back(xy, view, grid):
    """Output pixels of the corners of detector pixels, counted from 0 at the first pixel's lower left."""
    q = view.distortion.invert(xy - 0.5)
    return grid.from_reference(similarity.apply(similarity.invert(view.pose), q))
