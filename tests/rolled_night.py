"""A night of dithered and rolled exposures of one detector whose static distortion is known; numpy alone."""

import numpy as np
from astropy.table import QTable
from night_sets import SIZE, field
from numpy.polynomial.legendre import legval2d

_NORM = np.sqrt((2 * np.arange(4) + 1) / 2)


def bend(x, y, tensor):
    """Displacement (n, 2) by coefficients (2, k, k) of plain Legendre polynomials."""
    return legval2d((2 * x + 1) / SIZE - 1, (2 * y + 1) / SIZE - 1, tensor.transpose(1, 2, 0)).T


def modes(tensor):
    """The normalised coefficients (2, 10) of a cubic, mode m = l (l + 1) / 2 + k for x^(l-k) y^k."""
    plain = tensor / (_NORM[:, None] * _NORM)
    return np.stack([plain[:, d - k, k] for d in range(4) for k in range(d + 1)], axis=1)


def night(
    seed,
    static,
    *,
    turns=(0, 90, 200),
    exposures=9,
    single=0.01,
    sigma=0.02,
    n_stars=120,
    year=None,
    slope=0.0,
    numbers=(),
):
    """Matched positions of exposures, turned by these angles in turn, each with a distortion of its own.

    With numbers, one an exposure and from their zero, the static distortion has a slope by them; they are a column.
    """
    rng, rows = np.random.default_rng(seed), []
    sky = rng.uniform(-150, SIZE + 150, (n_stars, 2))
    for i in range(len(numbers) or exposures):
        angle = np.radians(turns[i % len(turns)])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        q = (sky - SIZE / 2) @ turn.T + SIZE / 2 + rng.uniform(-90, 90, 2)
        shared = static + (slope * numbers[i] if len(numbers) else 0)
        q = q + bend(*q.T, shared) + bend(*q.T, field(rng, single))
        q = q + rng.normal(0, sigma, q.shape)
        for j in np.flatnonzero(np.all((q > 0) & (q < SIZE - 1), axis=1)):
            rows.append((f"e{i}", j, *q[j], sigma, sigma))
    table = QTable(rows=rows, names=["exposure", "star", "x", "y", "x_err", "y_err"])
    if len(numbers):
        table["ROTPPOSN"] = [numbers[int(name[1:])] for name in table["exposure"]]
    if year is not None:
        table["epoch"] = float(year)
    return table
