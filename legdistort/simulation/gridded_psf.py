"""Point-spread functions given as oversampled arrays, one or a grid of them over the field."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.ndimage import spline_filter

from ..exceptions import InputError


@dataclass(frozen=True, eq=False, repr=False)
class GriddedPSF:
    """Effective PSFs on a grid of field positions, as photutils' ``ImagePSF`` and ``GriddedPSFModel`` hold them.

    A value is the part of a star's light that falls into a detector pixel whose centre is that far from the star; a
    whole PSF sums to the product of the oversampling factors. Between the samples they are interpolated by cubic
    splines, between the field positions linearly; beyond the grid the nearest position holds, beyond the array nothing.

    Parameters
    ----------
    data : array_like, shape (ny, nx) or (n, ny, nx)
        One PSF, or one for every position.
    oversampling : int or (int, int)
        Samples a pixel, of y and x.
    origin : (float, float), optional
        x and y of the star's position in the arrays [samples]; the middle if not given.
    positions : array_like, shape (n, 2), optional
        Where on the detector the PSFs hold [pix]: all corners of a rectangular grid, in any order.
    wings : GriddedPSF, optional
        More light of the same star, on coarser samples that reach farther out.

    Raises
    ------
    InputError
        For arrays that are no such PSFs.
    """

    data: np.ndarray
    oversampling: tuple = 1
    origin: tuple | None = None
    positions: np.ndarray | None = None
    wings: "GriddedPSF | None" = None
    _nodes: tuple = field(init=False)
    _splines: np.ndarray = field(init=False)

    def __post_init__(self):
        data = np.asarray(self.data, dtype=float)
        data = data[None] if data.ndim == 2 else data
        if data.ndim != 3 or min(data.shape[1:], default=0) < 4 or not np.isfinite(data).all():
            raise InputError(
                f"a PSF is an array (ny, nx) or (n, ny, nx) of finite numbers, 4 x 4 or more, got {data.shape}"
            )
        steps = tuple(int(step) for step in np.broadcast_to(self.oversampling, 2))
        if min(steps) < 1:
            raise InputError(f"oversampling must be 1 or more samples a pixel, got {self.oversampling!r}")
        positions = np.zeros((len(data), 2)) if self.positions is None else np.asarray(self.positions, dtype=float)
        if positions.shape != (len(data), 2):
            raise InputError(f"{len(data)} PSFs need positions ({len(data)}, 2), got {positions.shape}")
        axes, order = (np.unique(positions[:, 0]), np.unique(positions[:, 1])), np.lexsort(positions.T)
        full = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        if full.shape != positions.shape or not np.array_equal(full, positions[order]):
            raise InputError("the positions of the PSFs must be all corners of a rectangular grid, each once")
        middle = tuple((n - 1) / 2 for n in data.shape[:0:-1])
        origin = middle if self.origin is None else tuple(float(c) for c in self.origin)
        grid = data[order].reshape(len(axes[1]), len(axes[0]), *data.shape[1:])
        splines = np.stack([[spline_filter(one, order=3) for one in row] for row in grid])
        values = {"data": data, "oversampling": steps, "origin": origin, "positions": positions}
        for name, value in (values | {"_nodes": axes, "_splines": splines}).items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_model(cls, model):
        """What a photutils ``ImagePSF`` or ``GriddedPSFModel`` holds; of its parameters flux, x_0, y_0 nothing."""
        # the origin of a GriddedPSFModel has a third value, the middle of the list of PSFs
        origin, positions = tuple(model.origin[:2]), getattr(model, "grid_xypos", None)
        return cls(model.data, tuple(model.oversampling), origin, positions)

    @cached_property
    def fwhm(self):
        """Diameter of a circle as large as the area above half maximum in the middle of the field, with pixels."""
        half = int(np.count_nonzero(self._outside > self.data.max() / 8)) + 1
        pixels, shifts = np.arange(-half, half + 1), (np.arange(8) + 0.5) / 8 - 0.5
        corners = self._corners(np.mean(self.positions, axis=0))
        fine = np.array([[self._light(corners, pixels, pixels, (x, y)) for x in shifts] for y in shifts])
        return float(2 * np.sqrt(np.count_nonzero(fine > fine.max() / 2) / 64 / np.pi))

    @property
    def total(self):
        """Part of the light inside the arrays, the smallest and the largest over the field."""
        parts = self.data.sum(axis=(1, 2)) / np.prod(self.oversampling)
        more = 0.0 if self.wings is None else self.wings.total[0]
        return float(parts.min() + more), float(parts.max() + more)

    def reach(self, level):
        """How far along x or y a pixel may hold more than `level` of the light [pix]."""
        half = max(1, int(np.count_nonzero(self._outside > level)))
        return half if self.wings is None else max(half, self.wings.reach(level))

    @cached_property
    def _outside(self):
        """Largest value beyond 0, 1, 2 ... pixels."""
        y, x = (
            np.abs(np.arange(n) - c) / step
            for n, c, step in zip(self.data.shape[1:], self.origin[::-1], self.oversampling, strict=True)
        )
        ring = np.maximum(y[:, None], x).astype(int)
        largest = np.zeros(ring.max() + 1)
        np.maximum.at(largest, ring, np.abs(self.data).max(axis=0))
        return np.maximum.accumulate(largest[::-1])[::-1]

    def _corners(self, xy):
        """The given positions about a place of the detector: index of y, of x, and weight."""
        weights = []
        for nodes, c in zip(self._nodes, xy, strict=True):
            low = int(np.clip(np.searchsorted(nodes, c) - 1, 0, max(len(nodes) - 2, 0)))
            high = min(low + 1, len(nodes) - 1)
            share = np.clip((c - nodes[low]) / (nodes[high] - nodes[low]), 0, 1) if high > low else 0.0
            weights.append([(low, 1 - share), (high, share)])
        return [(j, i, v * w) for j, v in weights[1] for i, w in weights[0] if v * w > 0]

    def on_pixels(self, columns, rows, xy):
        """Part of a star's light in every pixel.

        Parameters
        ----------
        columns, rows : ndarray of int, shapes (n,) and (m,)
            Of the pixels.
        xy : array_like, shape (2,)
            Position of the star [pix].

        Returns
        -------
        ndarray, shape (m, n)
        """
        out = self._light(self._corners(xy), columns, rows, xy)
        return out if self.wings is None else out + self.wings.on_pixels(columns, rows, xy)

    def _light(self, corners, columns, rows, xy):
        taps = [
            _taps(self.origin[k] + self.oversampling[1 - k] * (np.asarray(pixels) - xy[k]), self.data.shape[2 - k])
            for k, pixels in enumerate((columns, rows))
        ]
        (first_x, x, in_x), (first_y, y, in_y) = taps
        part = np.s_[first_y : first_y + y.max() + 1, first_x : first_x + x.max() + 1]
        coefficients = sum(weight * self._splines[j, i][part] for j, i, weight in corners)
        # every pixel lies equally far behind a sample: four rows and four columns are enough
        along = sum(weight[:, None] * coefficients[index] for index, weight in zip(y, in_y, strict=True))
        return sum(weight * along[:, index] for index, weight in zip(x, in_x, strict=True))

    def information(self, flux, *, sky, gain, read_noise, phases=1):
        """Fisher information on a coordinate, the mean of x and y, of stars of these fluxes (n,) [1 / pixel^2].

        Of stars in the middle of a pixel, or the mean over `phases` by `phases` places on it.
        """
        half, step, flux = int(np.ceil(4 * self.fwhm)), 1e-3, flux[..., None, None]
        middle = np.round(np.mean(self.positions, axis=0))
        pixels, total = np.arange(-half, half + 1) + middle.astype(int)[:, None], 0.0
        for xy in middle + places_on_pixel(phases):
            light = self.on_pixels(*pixels, xy)
            moved = (self.on_pixels(*pixels, xy + step * e) - self.on_pixels(*pixels, xy - step * e) for e in np.eye(2))
            slope2 = sum(np.square(difference / (2 * step)) for difference in moved) / 2
            variance = (sky + flux * np.maximum(light, 0)) / gain + (read_noise / gain) ** 2
            total = total + np.sum(flux**2 * slope2 / variance, axis=(-2, -1))
        return total / phases**2

    def __repr__(self):
        n, ny, nx = self.data.shape
        return f"<GriddedPSF: {n} of {ny} x {nx} samples, oversampling {self.oversampling}, FWHM {self.fwhm:.2f} px>"


def places_on_pixel(n):
    """n by n places that lie evenly on a pixel, from its middle, (n^2, 2) [pix]."""
    along = (np.arange(n) - (n - 1) / 2) / n
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def _taps(at, n):
    """The first of n coefficients that a cubic spline needs at these samples; which from it, and weights, (4, len(at)).

    Outside the samples 0; edges are mirrored as `spline_filter` takes them.
    """
    base = np.floor(at).astype(int)
    t = at - base
    weights = np.array([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6
    index = np.abs(base + np.arange(-1, 3)[:, None])
    index = np.clip(n - 1 - np.abs(n - 1 - index), 0, n - 1)
    return index.min(), index - index.min(), np.where((at >= 0) & (at <= n - 1), weights, 0.0)
