"""Images of stars of known position, rendered by code of their own, and the smallest possible errors of positions."""

from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from legdistort.measurement.flags import UNUSABLE

SKY, GAIN, READ_NOISE = 100.0, 2.0, 10.0


def profile(dx, dy, fwhm, beta, squash=1.2, theta=0.5):
    """Moffat profile of unit flux; axes fwhm * squash and fwhm / squash."""
    k = 2 ** (1 / beta) - 1
    (c, s), wide, narrow = (np.cos(theta), np.sin(theta)), (2 / (fwhm * squash)) ** 2, (2 * squash / fwhm) ** 2
    xx, yy, xy = wide * c**2 + narrow * s**2, wide * s**2 + narrow * c**2, 2 * (wide - narrow) * s * c
    r2 = xx * dx**2 + yy * dy**2 + (xy * dx) * dy
    return (beta - 1) * 4 * k / (np.pi * fwhm**2) * (1 + k * r2) ** -beta


def on_pixels(x, y, columns, rows, *args, sub=5):
    """The profile averaged over sub x sub points of every pixel."""
    offsets = (np.arange(sub) + 0.5) / sub - 0.5
    fine_x, fine_y = (columns[:, None] + offsets).ravel() - x, (rows[:, None] + offsets).ravel() - y
    along = profile(fine_x, fine_y[:, None], *args).reshape(-1, sub) @ np.full(sub, 1 / sub)
    return along.reshape(len(rows), sub, len(columns)).mean(axis=1)


def image(shape, xy, flux, fwhm, beta=3.0, half=None, **shapes):
    """Sky and stars without noise; squash and theta may be given for every star."""
    out = np.full(shape, SKY)
    half = half or int(7 * fwhm)
    sub = 3 if fwhm > 3 else 5 if fwhm > 1.8 else 9
    for i, ((x, y), f) in enumerate(zip(xy, flux, strict=True)):
        columns = np.arange(max(0, int(x) - half), min(shape[1], int(x) + half + 1))
        rows = np.arange(max(0, int(y) - half), min(shape[0], int(y) + half + 1))
        more = [shapes[name][i] for name in ("squash", "theta") if name in shapes]
        out[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += f * on_pixels(
            x, y, columns, rows, fwhm, beta, *more, sub=sub
        )
    return out


def observe(noiseless, rng):
    """Photon and read noise added."""
    electrons = rng.poisson(noiseless * GAIN) + rng.normal(0, READ_NOISE, noiseless.shape)
    return (electrons / GAIN).astype(np.float32)


def scattered(rng, n, size):
    """Positions on a jittered grid: isolated stars at every pixel phase."""
    side = int(np.ceil(np.sqrt(n)))
    grid = (np.stack(np.meshgrid(*[np.arange(side) + 0.5] * 2), axis=-1).reshape(-1, 2) * size / side)[:n]
    return grid + rng.uniform(-3, 3, grid.shape)


def bound(flux, fwhm, beta=3.0, half=20):
    """Cramer-Rao bound of x and y with eight free parameters, and the signal-to-noise ratio."""
    pixels = np.arange(-half, half + 1)

    def model(p):
        return p[2] * on_pixels(p[0], p[1], pixels, pixels, p[3], np.exp(p[4]), p[5], p[6]) + p[7]

    p = np.array([0.2, 0.3, flux, fwhm, np.log(beta), 1.2, 0.5, SKY])
    variance = model(p) / GAIN + (READ_NOISE / GAIN) ** 2
    steps = np.diag(1e-4 * np.maximum(1, np.abs(p)))
    jac = np.array([((model(p + s) - model(p - s)) / (2 * s.sum()) / np.sqrt(variance)).ravel() for s in steps])
    ratio = np.sqrt(((model(p) - SKY) ** 2 / variance).sum())
    return np.sqrt(np.diag(np.linalg.inv(jac @ jac.T))[:2]), ratio


@cache
def _bounds(fwhm):
    fluxes = np.geomspace(30, 1e6, 24)
    bounds, ratios = zip(*(bound(f, fwhm) for f in fluxes), strict=True)
    return fluxes, np.array(bounds), np.array(ratios)


def ladder(n, fwhm, lowest=9, highest=1000):
    """Signal-to-noise ratios (n,) evenly spread in their logarithm, fluxes (n,), Cramer-Rao bounds (n, 2)."""
    fluxes, bounds, ratios = _bounds(fwhm)
    ratio = np.geomspace(lowest, highest, n)
    flux = np.exp(np.interp(np.log(ratio), np.log(ratios), np.log(fluxes)))
    limit = np.exp([np.interp(np.log(ratio), np.log(ratios), np.log(b)) for b in np.transpose(bounds)]).T
    return ratio, flux, limit


def positions(table):
    """Array (n, 2)."""
    return np.column_stack([table["x"].value, table["y"].value])


def errors(table):
    """Array (n, 2)."""
    return np.column_stack([table["x_err"].value, table["y_err"].value])


def identify(table, xy, radius=1.5):
    """Index of the true star of every row, -1 for none."""
    distance, index = cKDTree(xy).query(positions(table))
    return np.where(distance < radius, index, -1)


def usable(table):
    """Rows that are stars."""
    return table[(table["flags"] & UNUSABLE) == 0]
