"""The place of every hole of an exposure on the lattice of its mask, and how far it lies from where that has it."""

from dataclasses import dataclass

import numpy as np

from ...geometry import similarity
from ..star_lists import Warp, allowed_degree, fit_warp
from .periods import periods

_NEAR = 0.2  # parts of the shortest period within which a star is the hole that is expected there
_SEEDS = 5  # stars near the middle of a field from which holes are counted, until most stars are holes
_SHARE, _FEWEST = 0.5, 20  # stars of an exposure that must be holes: part, and number
_RINGS = 3  # places beyond the holes that are seen, in periods: an edge of the mask shows there
_GROSS = 5  # standard deviations within which a hole tells by where it lies
_EDGE = 0.15  # parts of a period by which a place must be inside the detector for its hole to be missed


@dataclass(frozen=True, eq=False)
class Holes:
    """Holes of one exposure.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Of the list of stars.
    index : ndarray of int, shape (n, 2)
        Places on the lattice, counted along its periods.
    basis : ndarray, shape (2, 2)
        Periods in the middle of the field, as columns, pixels.
    warp : Warp
        A smooth map from `index` less `low` to pixels, of low degree.
    residual : ndarray of complex, shape (n,)
        x + iy by which holes lie from a smooth map, pixels; 0 where that is not known.
    low : ndarray of int, shape (2,)
        Lowest index of `places`.
    places : ndarray of bool, shape (m, l)
        Places from `low` on that surely lie on the detector, up to a few periods beyond the holes.
    """

    rows: np.ndarray
    index: np.ndarray
    basis: np.ndarray
    warp: Warp
    residual: np.ndarray
    low: np.ndarray
    places: np.ndarray

    @classmethod
    def of(cls, stars, steps=None):
        """Holes among the stars of an exposure, or None where these do not lie on a lattice of two periods.

        Parameters
        ----------
        stars : StarList
        steps : ndarray, shape (2, 2), optional
            The two periods [pix], if they are known.
        """
        steps = periods(stars.xy) if steps is None else steps
        if len(steps) < 2:
            return None
        basis, xy = steps[:2].T, stars.xy
        most = None
        for seed in np.argsort(np.hypot(*(xy - np.median(xy, axis=0)).T))[:_SEEDS]:
            found = _counted(stars, basis, seed)
            if most is None or len(found[0]) > len(most[0]):
                most = found
            if 2 * len(most[0]) > len(xy):
                break
        rows, index = most
        if len(rows) < max(_FEWEST, _SHARE * len(xy)):
            return None
        low = index.min(axis=0) - _RINGS
        span = index.max(axis=0) + _RINGS + 1 - low
        smooth = _fitted(index - low, xy[rows], span, 5)
        off = (xy[rows] - smooth(index - low)) @ [1, 1j]
        size = np.abs(off)
        off[size > _GROSS * similarity.median(size)] = 0
        warp = _fitted(index - low, xy[rows], span, 2)
        at = np.stack(np.meshgrid(*map(np.arange, span), indexing="ij"), axis=-1).reshape(-1, 2)
        there, edge = warp(at), _EDGE * np.hypot(*basis).min()
        inside = np.all((there > edge) & (there < np.array(stars.shape[::-1]) - 1 - edge), axis=1)
        return cls(rows, index, basis, warp, off, low, inside.reshape(span))

    def pixels(self, index):
        """Where places (n, 2) of the lattice lie, by the periods in the middle of the field, pixels."""
        middle = np.round(np.median(self.index, axis=0))
        return self.warp((middle - self.low)[None]) + (index - middle) @ self.basis.T

    def indices(self, xy):
        """The inverse of `pixels`, not rounded."""
        middle = np.round(np.median(self.index, axis=0))
        return (xy - self.warp((middle - self.low)[None])) @ np.linalg.inv(self.basis).T + middle


def _fitted(index, xy, span, degree):
    """A polynomial from places (n, 2) to pixels, that few stars do not spoil."""
    weights, degree = np.ones(len(index)), min(degree, max(allowed_degree(len(index)), 1))
    for _ in range(3):
        warp = fit_warp(index.astype(float), xy, tuple(span[::-1]), degree, weights=weights, width=0.0, parity=1)
        distance = np.hypot(*(xy - warp(index.astype(float))).T)
        weights = 1 / (1 + (distance / (3 * similarity.median(distance) + 1e-9)) ** 2)
    return warp


def _counted(stars, basis, seed):
    """Rows of holes and their places (n, 2), counted from one of them ring by ring, as far as a smooth map leads."""
    xy, reach = stars.xy, _NEAR * np.hypot(*basis).min()
    rows, index = np.array([seed]), np.zeros((1, 2), dtype=int)
    ring = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 2), axis=-1).reshape(-1, 2)
    place = lambda index: xy[seed] + index @ basis.T  # noqa: E731 - replaced once there are holes to fit a map to
    while True:
        around = np.unique((index[:, None] + ring).reshape(-1, 2), axis=0)
        there = place(around)
        distance, row = stars.tree.query(there, distance_upper_bound=reach)
        near = np.isfinite(distance)
        order = np.argsort(distance[near], kind="stable")  # a star is the hole to which it is nearest
        row, first = np.unique(row[near][order], return_index=True)
        around = around[near][order][first]
        if len(row) <= len(rows):
            return rows, index
        rows, index = row, around
        place = _smooth(index, xy[rows])


def _smooth(index, xy):
    """A map from places to pixels that holds two periods beyond those it is fitted to."""
    low = index.min(axis=0) - 2
    warp = _fitted(index - low, xy, index.max(axis=0) + 3 - low, 5 if len(index) > 200 else 3)
    return lambda index: warp((index - low).astype(float))
