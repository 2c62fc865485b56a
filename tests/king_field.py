"""Frames of a globular cluster with the truth beside them, and the smallest possible errors of its stars."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

FWHM, BETA, SKY, READ_NOISE = 4.0, 3.0, 400.0, 5.0
_REACH = 40  # px
_BOUND = 14  # px: half a stamp of the bound, and how far neighbours count


def moffat(dx, dy, *, sub=3):
    """Light of a star of unit flux in pixels, its offsets given; averaged over sub x sub Gauss-Legendre points."""
    alpha2 = (FWHM / 2) ** 2 / (2 ** (1 / BETA) - 1)
    nodes, weights = np.polynomial.legendre.leggauss(sub)
    out = 0.0
    for v, wv in zip(nodes / 2, weights / 2, strict=True):
        for u, wu in zip(nodes / 2, weights / 2, strict=True):
            out = out + wu * wv * (1 + ((dx + u) ** 2 + (dy + v) ** 2) / alpha2) ** -BETA
    return (BETA - 1) / (np.pi * alpha2) * out


@dataclass
class KingField:
    """A frame of a cluster: stars, and the image in electrons.

    Attributes
    ----------
    xy, flux, snr : ndarray
        Of the stars; signal-to-noise ratio of their flux, were they alone and their place known.
    noiseless, data : ndarray, shape (n, n)
    """

    xy: np.ndarray
    flux: np.ndarray
    snr: np.ndarray
    noiseless: np.ndarray
    data: np.ndarray


def king_field(n_stars, seed, *, size=1024, core=90.0, faintest=3.0, brightest=2000.0, extra=None):
    """A King profile with N(> flux) as flux ** -0.5; `extra` (k, 3) are more stars: x, y, flux."""
    rng = np.random.default_rng([n_stars, seed])
    r = np.linspace(0, 10 * core, 4000)
    share = np.cumsum(((1 + (r / core) ** 2) ** -0.5 - 101**-0.5) ** 2 * r)
    xy = np.zeros((0, 2))
    while len(xy) < n_stars:
        radius, angle = np.interp(rng.random(n_stars), share / share[-1], r), rng.uniform(0, 2 * np.pi, n_stars)
        more = (size - 1) / 2 + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        xy = np.vstack([xy, more[((more > -4) & (more < size + 3)).all(axis=1)]])
    xy = xy[:n_stars]
    ladder = np.geomspace(30, 3e7, 200)
    of_ladder = signal_to_noise(ladder)
    low, high = np.exp(np.interp(np.log([faintest, brightest]), np.log(of_ladder), np.log(ladder)))
    flux = (low**-0.5 + rng.random(n_stars) * (high**-0.5 - low**-0.5)) ** -2.0
    if extra is not None:
        xy, flux = np.vstack([xy, extra[:, :2]]), np.append(flux, extra[:, 2])
    noiseless = rendered(xy, flux, size) + SKY
    data = rng.poisson(noiseless) + rng.normal(0, READ_NOISE, noiseless.shape)
    return KingField(xy, flux, np.interp(flux, ladder, of_ladder), noiseless, data.astype(np.float32))


def rendered(xy, flux, size):
    """Light of stars, (size, size)."""
    image, offset = np.zeros((size + 2 * _REACH,) * 2), np.arange(-_REACH, _REACH + 1)
    for (x, y), light in zip(xy, flux, strict=True):
        i, j = round(x), round(y)
        part = image[max(j, 0) : j + 2 * _REACH + 1, max(i, 0) : i + 2 * _REACH + 1]
        part += light * moffat(i - x + offset, (j - y + offset)[:, None])[-len(part) :, -part.shape[1] :]
    return image[_REACH:-_REACH, _REACH:-_REACH]


def signal_to_noise(flux):
    """Of stars alone at known places."""
    offset = np.arange(-20, 21)
    unit = moffat(offset, offset[:, None])
    return np.array([np.sqrt(np.sum((f * unit) ** 2 / (SKY + READ_NOISE**2 + f * unit))) for f in flux])


def joint_bounds(field):
    """Cramer-Rao bounds of x and y with all stars within 14 px and a constant sky unknown too; (n, 2)."""
    xy, flux, (ny, nx) = field.xy, field.flux, field.data.shape
    tree, out = cKDTree(xy), np.full((len(xy), 2), np.nan)
    for k, (x, y) in enumerate(np.round(xy).astype(int)):
        columns = np.arange(max(x - _BOUND, 0), min(x + _BOUND + 1, nx))
        rows = np.arange(max(y - _BOUND, 0), min(y + _BOUND + 1, ny))
        if not len(columns) or not len(rows):
            continue
        near = [k, *(j for j in tree.query_ball_point(xy[k], _BOUND) if j != k)]
        dx = columns - xy[near, 0][:, None, None]
        dy = rows[:, None] - xy[near, 1][:, None, None]
        light, f = moffat(dx, dy, sub=2), flux[near][:, None, None]
        step = 1e-3
        by_x = f * (moffat(dx - step, dy, sub=2) - light) / step
        by_y = f * (moffat(dx, dy - step, sub=2) - light) / step
        slopes = np.stack([by_x, by_y, light], axis=1).reshape(3 * len(near), -1)
        slopes = np.vstack([slopes, np.ones(slopes.shape[1])])
        slopes /= np.sqrt(field.noiseless[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] + READ_NOISE**2).ravel()
        scale = np.linalg.norm(slopes, axis=1)
        slopes /= scale[:, None]
        covariance = np.linalg.pinv(slopes @ slopes.T, rcond=1e-12)
        out[k] = np.sqrt(np.abs(np.diag(covariance)[:2])) / scale[:2]
    return out


def paired(field, xy, *, radius=2.0):
    """Of every true star the row found, the brightest star choosing first, -1 for none; and the rows left over."""
    tree, taken, out = cKDTree(xy), np.zeros(len(xy), dtype=bool), np.full(len(field.xy), -1)
    for k in np.argsort(-field.flux):
        rows = [j for j in tree.query_ball_point(field.xy[k], radius) if not taken[j]]
        if rows:
            out[k] = min(rows, key=lambda j: np.hypot(*(xy[j] - field.xy[k])))
            taken[out[k]] = True
    return out, ~taken
