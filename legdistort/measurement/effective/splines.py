"""Cubic B-splines on a square grid of knots: values and slopes of images on the pixels of stamps."""

import numpy as np


def knots(n, spacing):
    """Places of n knots [pix], the middle one at 0."""
    return (np.arange(n) - (n - 1) / 2) * spacing


def basis(offsets, n, spacing, *, slopes=False):
    """What every knot contributes at some places.

    Parameters
    ----------
    offsets : ndarray, shape (..., k)
        Places [pix], from the middle of the grid.
    n : int
        Knots of the grid.
    spacing : float
        Of the knots [pix].
    slopes : bool
        Whether to give derivatives [1 / pix] too.

    Returns
    -------
    values, slopes : ndarray, shape (..., k, n)
        Of the kind of the offsets; zero beyond the grid.
    """
    t = offsets / spacing + ((n - 1) / 2 + 3)  # three knots more at each end take what lies beyond
    first = np.clip(np.floor(t), 1, n + 3)
    f = t - first
    inside = (f >= 0) & (f <= 1)
    f = np.where(inside, f, 0)
    places = first.astype(int) - 1 + (n + 6) * np.arange(f.size).reshape(f.shape)
    values = (1 - f) ** 3, 4 + f * f * (3 * f - 6), 1 + 3 * f * (1 + f - f * f), f**3
    values = _scatter(places, values, inside, 6, n)
    if not slopes:
        return values
    by = -((1 - f) ** 2), f * (3 * f - 4), 1 + f * (2 - 3 * f), f * f
    return values, _scatter(places, by, inside, 2 * spacing, n)


def _scatter(places, values, inside, divisor, n):
    """Values of four knots in a row, the first ones at some places of the flattened array, (..., n)."""
    out = np.zeros((*places.shape, n + 6), dtype=values[0].dtype)
    for k, value in enumerate(values):
        out.ravel()[places + k] = value / divisor * inside
    return out[..., 3 : n + 3]


def on_stamps(grids, xy, half, spacing, *, slopes=False):
    """Images on square stamps.

    Parameters
    ----------
    grids : ndarray, shape (n or 1, ny, nx)
        Spline coefficients.
    xy : ndarray, shape (n, 2)
        Where the middles of the grids lie [pix], from the central pixels of the stamps. Its kind (float32 or float64)
        is that of the results.
    half : int
        Stamps reach from -half to half.
    spacing : float
        Of the knots [pix].
    slopes : bool
        Whether to give derivatives by x and y of the places too.

    Returns
    -------
    values, by_x, by_y : ndarray, shape (n, npix)
        Stamps flattened, rows (y) first; derivatives only if asked for.
    """
    grids = grids.astype(xy.dtype, copy=False)
    pixels = np.arange(-half, half + 1, dtype=xy.dtype)
    found = (basis(pixels - xy[:, i, None], grids.shape[2 - i], spacing, slopes=slopes) for i in (0, 1))
    if not slopes:
        x, y = found
        return (y @ (grids @ x.swapaxes(1, 2))).reshape(len(xy), -1)
    (x, slope_x), (y, slope_y) = found
    along = grids @ x.swapaxes(1, 2)
    values = y @ along, -(y @ (grids @ slope_x.swapaxes(1, 2))), -(slope_y @ along)
    return tuple(v.reshape(len(xy), -1) for v in values)


def coefficients(images):
    """Spline coefficients (..., ny, nx) of images known on the knots, zero beyond."""
    n_y, n_x = images.shape[-2:]
    across = [np.linalg.inv(basis(np.arange(n) - (n - 1) / 2, n, 1.0)) for n in (n_y, n_x)]
    return across[0] @ images @ across[1].T
