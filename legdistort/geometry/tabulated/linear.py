"""Linear interpolation between the nodes of a regular grid, and its slopes."""

import numpy as np


def interpolated(values, first, step, q):
    """Values (n, k) at positions q (n, 2) of tables (k, ny, nx) whose nodes begin at `first` and are `step` apart."""
    (y, x), (fx, fy) = _cells(values.shape[1:], first, step, q)
    below = values[:, y, x] * (1 - fx) + values[:, y, x + 1] * fx
    above = values[:, y + 1, x] * (1 - fx) + values[:, y + 1, x + 1] * fx
    return (below * (1 - fy) + above * fy).T


def slopes(values, first, step, q):
    """Derivatives (n, k, 2) of `interpolated` by x and y."""
    (y, x), (fx, fy) = _cells(values.shape[1:], first, step, q)
    along = [values[:, row, x + 1] - values[:, row, x] for row in (y, y + 1)]
    across = [values[:, y + 1, column] - values[:, y, column] for column in (x, x + 1)]
    by_x, by_y = (
        (low * (1 - f) + high * f) / h for (low, high), f, h in zip((along, across), (fy, fx), step, strict=True)
    )
    return np.stack([by_x.T, by_y.T], axis=-1)


def _cells(shape, first, step, q):
    """Of positions: row and column of the first node of the cell, and where they lie in it, x first.

    Outside they are in the outermost cells, less than 0 or beyond 1.
    """
    place = (np.asarray(q, dtype=float) - first) / step
    cell = np.clip(np.nan_to_num(np.floor(place)), 0, np.array(shape[::-1]) - 2).astype(int)
    return cell.T[::-1], (place - cell).T
