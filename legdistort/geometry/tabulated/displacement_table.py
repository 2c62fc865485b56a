"""What a distortion displaces beside its series: a table of a regular grid of nodes, linear in between."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import RectBivariateSpline

from ...exceptions import InputError
from ...runtime.trees.facts import array, number
from ..basis import denormalize
from .fast_tabular import FastTabular2D
from .linear import interpolated, slopes

if TYPE_CHECKING:
    from collections.abc import Callable

    from astropy.modeling import Model
    from numpy.typing import ArrayLike

#: Cells along an axis, at most.
MOST_CELLS = 1024
#: Nodes beyond the detector on every side, by its longer side: undistorted pixels reach there.
MARGIN = 1 / 64
#: What tables that are `fine_enough` lose between their nodes, pixels; cells along the longer side to begin with.
LOST, _FEWEST = 2e-4, 32
#: Irregularity of the nodes of a model, by their distance.
_IRREGULAR = 1e-9


@dataclass(frozen=True, eq=False)
class DisplacementTable:
    """Displacements on a regular grid of nodes, linear in x and in y in between.

    Beyond the nodes the outermost cells go on, as of a `~astropy.modeling.models.Tabular2D` with ``fill_value=None``.

    Attributes
    ----------
    values : ndarray, shape (2, ny, nx)
        Displacements along x and along y at the nodes, pixels.
    first : tuple
        ``(x, y)`` of the first node, pixels of the detector from 0.
    step : tuple
        ``(dx, dy)`` between the nodes, pixels.

    Raises
    ------
    InputError
        For values of another shape or not finite, fewer than two nodes along an axis, and a step that is not positive.
    """

    values: np.ndarray = field(metadata=array(2, "rows", "columns", unit="pix"))
    first: tuple[float, float] = field(metadata=number(unit="pix"))
    step: tuple[float, float] = field(metadata=number(minimum=0, unit="pix"))

    def __post_init__(self) -> None:
        values = np.asarray(self.values, dtype=float)
        if values.ndim != 3 or len(values) != 2 or min(values.shape) < 2 or not np.isfinite(values).all():
            raise InputError(
                "a table of displacements must be finite, of shape (2, ny, nx) with two nodes or more along x and y, "
                f"got shape {values.shape}"
            )
        first, step = (tuple(map(float, each)) for each in (self.first, self.step))
        if not (len(first) == len(step) == 2 and np.isfinite([*first, *step]).all() and min(step) > 0):
            raise InputError(
                f"the nodes of a table begin at (x, y) and are (dx, dy) > 0 apart, got first={first}, step={step}"
            )
        for name, value in (("values", values), ("first", first), ("step", step)):
            object.__setattr__(self, name, value)

    @classmethod
    def of(
        cls,
        displacements: Callable[[np.ndarray], np.ndarray],
        shape: tuple[int, int],
        step: float | tuple[float, float],
        *,
        margin: float = MARGIN,
    ) -> DisplacementTable:
        """Tabulate displacements over a detector.

        The number of cells along an axis is a power of two, so that the nodes of the coarser of two tables of a
        detector are nodes of the finer: their sum is exact.

        Parameters
        ----------
        displacements : callable
            Positions (n, 2) -> displacements (n, 2), pixels.
        shape : tuple
            ``(ny, nx)`` of the detector.
        step : float or tuple
            Distance of nodes along x and y, at most; there are no more than 1024 cells along an axis.
        margin : float
            Beyond every edge, by the longer side of the detector.
        """
        low = -0.5 - margin * max(shape)
        extent = np.array(shape[::-1]) + 2 * margin * max(shape)
        cells = np.clip(2 ** np.ceil(np.log2(extent / step)).astype(int), 1, MOST_CELLS)
        apart = extent / cells
        x, y = (low + apart[k] * np.arange(cells[k] + 1) for k in (0, 1))
        nodes = np.stack(np.meshgrid(x, y), axis=-1)
        values = np.asarray(displacements(nodes.reshape(-1, 2))).T.reshape(2, len(y), len(x))
        return cls(values, (low, low), (float(apart[0]), float(apart[1])))

    @classmethod
    def fine_enough(
        cls,
        displacements: Callable[[np.ndarray], np.ndarray],
        shape: tuple[int, int],
        step: ArrayLike | None = None,
        *,
        tried: np.ndarray | None = None,
    ) -> DisplacementTable:
        """Tabulate displacements with nodes so near that 0.0002 pixels are lost between them, or as near as can be.

        Parameters
        ----------
        displacements, shape
            As of `of`.
        step : (2,) array_like, optional
            To begin with, along x and y.
        tried : ndarray, shape (n, 2), optional
            Where it is looked what is lost; by default places all over the detector.
        """
        if tried is None:
            tried = denormalize(*np.random.default_rng(1).uniform(-1, 1, (2, 10_000)), shape)
        exact, apart = displacements(tried), np.full(2, max(shape) / _FEWEST) if step is None else np.asarray(step)
        while True:
            table = cls.of(displacements, shape, tuple(apart))
            if np.abs(table(tried) - exact).max() <= LOST or max(table.values.shape) > MOST_CELLS:
                return table
            apart = apart / 2

    @classmethod
    def from_models(cls, along_x: Model, along_y: Model) -> DisplacementTable:
        """The table of two models, displacements along x and along y.

        Raises
        ------
        InputError
            If their nodes are not those of one regular grid, or what is between and beyond them is not linear.
        """
        grids = []
        for model in (along_x, along_y):
            if model.method != "linear" or model.bounds_error or model.fill_value is not None:
                raise InputError("a table of displacements should be linear between its nodes and beyond them")
            grids.append([np.asarray(points, dtype=float) for points in model.points])
        first, last = (np.array([points[k] for points in grids[0]]) for k in (0, -1))
        step = (last - first) / [len(points) - 1 for points in grids[0]]
        for grid in grids:
            for points, begin, apart, other in zip(grid, first, step, grids[0], strict=True):
                regular = begin + apart * np.arange(len(points))
                if len(points) != len(other) or np.abs(points - regular).max() > _IRREGULAR * abs(last - first).max():
                    raise InputError("the nodes of a table of displacements should be those of one regular grid")
        values = np.stack([np.asarray(model.lookup_table, dtype=float).T for model in (along_x, along_y)])
        return cls(values, tuple(first), tuple(step))

    def refined(self, times: int) -> DisplacementTable:
        """With `times` as many cells along an axis, whose nodes lie on cubic splines through those of this one."""
        ny, nx = self.values.shape[1:]
        x, y = (np.linspace(0, n - 1, times * (n - 1) + 1) for n in (nx, ny))
        order = min(nx - 1, 3), min(ny - 1, 3)
        values = [
            RectBivariateSpline(np.arange(ny), np.arange(nx), v, kx=order[1], ky=order[0])(y, x) for v in self.values
        ]
        return DisplacementTable(np.stack(values), self.first, (self.step[0] / times, self.step[1] / times))

    def __call__(self, q: ArrayLike) -> np.ndarray:
        """Displacements (n, 2) at positions (n, 2)."""
        return interpolated(self.values, self.first, self.step, q)

    def jacobian(self, q: ArrayLike) -> np.ndarray:
        """Derivatives (n, 2, 2) of the displacements, first index their axis."""
        return slopes(self.values, self.first, self.step, q)

    @property
    def steepest(self) -> float:
        """What no norm of the derivative exceeds."""
        along = [np.abs(np.diff(self.values, axis=2 - k)).max(axis=(1, 2)) / self.step[k] for k in (0, 1)]
        return float(np.linalg.norm(along))

    @property
    def cells(self) -> np.ndarray:
        """Four places (n, 2) in every cell, next to its nodes, where its slopes are largest."""
        ends = [
            x + h * np.add.outer(np.arange(n - 1), [1e-6, 1 - 1e-6]).ravel()
            for x, h, n in zip(self.first, self.step, self.values.shape[:0:-1], strict=True)
        ]
        return np.stack(np.meshgrid(*ends), axis=-1).reshape(-1, 2)

    def __add__(self, other: DisplacementTable) -> DisplacementTable:
        """Both together, on the nodes of the finer; exact where those of the other are among them (see `of`)."""
        fine = min(self, other, key=lambda table: np.prod(table.step))
        ny, nx = fine.values.shape[1:]
        x, y = (fine.first[k] + fine.step[k] * np.arange(n) for k, n in enumerate((nx, ny)))
        nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        coarse = other if fine is self else self
        return DisplacementTable(fine.values + coarse(nodes).T.reshape(2, ny, nx), fine.first, fine.step)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, DisplacementTable):
            return NotImplemented
        alike = (self.first, self.step) == (other.first, other.step)
        return alike and np.array_equal(self.values, other.values)

    def models(self) -> tuple[Model, Model]:
        """Displacements along x and along y as astropy models of (x, y)."""
        points = tuple(
            first + step * np.arange(n)
            for first, step, n in zip(self.first, self.step, self.values.shape[:0:-1], strict=True)
        )
        known = {"method": "linear", "bounds_error": False, "fill_value": None}
        x, y = (FastTabular2D(points, v.T, name=f"t{a}", **known) for a, v in zip("xy", self.values, strict=True))
        return x, y

    def __repr__(self) -> str:
        ny, nx = self.values.shape[1:]
        rms = float(np.sqrt(np.mean(np.sum(self.values**2, axis=0))))
        return f"<DisplacementTable: {nx} x {ny} nodes, {rms:.3g} px rms>"
