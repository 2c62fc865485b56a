"""Deep dithered frames, most of whose stars no frame shows by itself; with numpy and scipy alone."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import erf

SIGMA, SKY, LEVEL, MARGIN = 1.7, 10.0, 100.0, 30  # of the PSF [px]; noise of the sky and its level [e-]; px
EDGE = 40  # px of the field that are not compared
_HALF = 9


@dataclass(frozen=True, eq=False)
class DeepFrames:
    """Frames and their truth: where every star lies in every frame, and the joint bounds.

    `xy` (n, 2) are positions in the plane, `flux` (n,), `pixels` (m, n, 2), `transmission` (m,); `bound` (n, 3) the
    standard deviations of x, y and flux that all frames together allow, everything about all stars unknown; `snr` the
    ratio of the flux and its bound where the neighbours are known (their photons count).
    """

    frames: list
    xy: np.ndarray
    flux: np.ndarray
    pixels: np.ndarray
    slopes: np.ndarray
    transmission: np.ndarray
    bound: np.ndarray
    snr: np.ndarray


def light(p, x, y):
    """Light of a star of unit flux at p in pixels that rows y and columns x meet in, with its slopes by p."""
    values, slopes = [], []
    for c, grid in zip(p, (x, y), strict=True):
        a, b = (grid + 0.5 - c) / SIGMA, (grid - 0.5 - c) / SIGMA
        values.append((erf(a / 2**0.5) - erf(b / 2**0.5)) / 2)
        slopes.append(-(np.exp(-a * a / 2) - np.exp(-b * b / 2)) / (SIGMA * np.sqrt(2 * np.pi)))
    return np.outer(values[1], values[0]), np.outer(values[1], slopes[0]), np.outer(slopes[1], values[0])


def mapped(rng, xy, size, shift=15.0, bend=0.25):
    """A random dither and distortion: pixels of places, and the slopes of the map (n, 2, 2)."""
    d, c = rng.normal(0, shift, 2), rng.normal(0, bend, (2, 5))
    u, v = ((xy + d) / (size - 1) * 2 - 1).T
    terms = np.stack([u * u, u * v, v * v, u**3, v**3])
    by = 2 / (size - 1) * np.stack([[2 * u, v, 0 * u, 3 * u * u, 0 * u], [0 * u, u, 2 * v, 0 * u, 3 * v * v]])
    return xy + d + (c @ terms).T, np.eye(2) + np.einsum("ak,bkn->nab", c, by)


def deep_frames(seed, *, size=640, n_stars=900, n_frames=11, transmission=None, hit=0.0, faintest=0.8, bounds=True):
    """The trial: stars of S/N `faintest` to 200 a frame, most of them faint; a part `hit` of the pixels with hits.

    Without `bounds` there are none, which large sets have no memory for.
    """
    rng = np.random.default_rng(seed)
    a, b, g = faintest, 200.0, -0.7
    flux = (rng.uniform(size=n_stars) * (b**g - a**g) + a**g) ** (1 / g) * SKY * np.sqrt(4 * np.pi) * SIGMA
    xy = rng.uniform(-MARGIN, size + MARGIN, (n_stars, 2))
    t = np.ones(n_frames) if transmission is None else np.asarray(transmission)
    frames, maps = [], []
    information = np.zeros((n_stars * bounds, 3, n_stars * bounds, 3))
    for k in range(n_frames):
        p, slopes = mapped(rng, xy, size)
        maps.append((p, slopes))
        image, stamps = np.zeros((size, size)), []
        for j, (x, y) in enumerate(p):
            cols, rows = (np.arange(max(0, round(c) - _HALF), min(size, round(c) + _HALF + 1)) for c in (x, y))
            if len(cols) and len(rows):
                one, dx, dy = light((x, y), cols, rows)
                image[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] += t[k] * flux[j] * one
                by = t[k] * np.stack([flux[j] * dx, flux[j] * dy, one], axis=-1)
                by[..., :2] = by[..., :2] @ slopes[j]
                stamps.append((j, rows[0], cols[0], by))
        variance = SKY**2 + image
        if bounds:
            _inform(information, stamps, variance)
        data = image + LEVEL + rng.normal(0, 1, image.shape) * np.sqrt(variance)
        frames.append(with_hits(rng, data, hit).astype(np.float32))
    pixels, slopes = (np.array(each) for each in zip(*maps, strict=True))
    known = _bounds(information, flux) if bounds else (np.full((n_stars, 3), np.nan), np.full(n_stars, np.nan))
    return DeepFrames(frames, xy, flux, pixels, slopes, t, *known)


def _bounds(information, flux):
    """Standard deviations (n, 3), and ratios of fluxes and theirs where neighbours are known (n,)."""
    n = len(flux)
    matrix = information.reshape(3 * n, -1)
    seen = np.diag(matrix) > 0
    bound, scale = np.full(3 * n, np.inf), np.sqrt(np.diag(matrix)[seen])
    inverse = np.linalg.pinv(matrix[np.ix_(seen, seen)] / np.outer(scale, scale), rcond=1e-10, hermitian=True)
    bound[seen] = np.sqrt(np.diag(inverse)) / scale
    own = information[np.arange(n), :, np.arange(n)] + 1e-30 * np.eye(3)
    return bound.reshape(-1, 3), flux / np.sqrt(np.linalg.inv(own)[:, 2, 2])


def _inform(information, stamps, variance):
    """Add what a frame tells of the stars on it, pair by pair of those that touch."""
    for n, (i, y, x, by) in enumerate(stamps):
        (h, w), weight = by.shape[:2], 1 / variance[y : y + by.shape[0], x : x + by.shape[1], None]
        information[i, :, i, :] += np.einsum("yxa,yxb->ab", by * weight, by)
        for j, v, u, other in stamps[n + 1 :]:
            if abs(v - y) > 2 * _HALF or abs(u - x) > 2 * _HALF:
                continue
            top, left = max(y, v), max(x, u)
            low, right = min(y + h, v + other.shape[0]), min(x + w, u + other.shape[1])
            if low > top and right > left:
                mine = (by * weight)[top - y : low - y, left - x : right - x]
                both = np.einsum("yxa,yxb->ab", mine, other[top - v : low - v, left - u : right - u])
                information[i, :, j, :] += both
                information[j, :, i, :] += both.T


def with_hits(rng, data, part):
    """Cosmic rays: tracks of one to four pixels of 50 to 5000 e-."""
    n = rng.poisson(part * data.size / 2.5)
    y, x = rng.integers(0, data.shape[0], n), rng.integers(0, data.shape[1], n)
    for k in range(n):
        length, angle = rng.integers(1, 5), rng.uniform(0, np.pi)
        charge = 10 ** rng.uniform(1.7, 3.7)
        for s in range(length):
            i, j = round(y[k] + s * np.sin(angle)), round(x[k] + s * np.cos(angle))
            if 0 <= i < data.shape[0] and 0 <= j < data.shape[1]:
                data[i, j] += charge
    return data


@dataclass(frozen=True, eq=False)
class Compared:
    """Rows of a catalogue beside the truth, away from the edge of the field.

    Attributes
    ----------
    star, snr, row : ndarray, shape (n,)
        The true stars there, the brightest first, their ratios and the rows that are theirs, -1 where there is none.
    off, bound, error : ndarray, shape (n, 2)
        Of the positions; the error is that of pixels and maps together.
    n_rows, n_false : int
        Rows there, and those within a FWHM of no true star with a ratio above 3.
    shift : ndarray, shape (2,)
        Of the plane of the catalogue.
    """

    star: np.ndarray
    snr: np.ndarray
    row: np.ndarray
    off: np.ndarray
    bound: np.ndarray
    error: np.ndarray
    n_rows: int
    n_false: int
    shift: np.ndarray

    def found(self, low, high=np.inf):
        """Part of the stars of some ratio that have a row."""
        rows = self.row[(self.snr >= low) & (self.snr < high)]
        return np.mean(rows >= 0)

    def ratios(self, low, high=np.inf):
        """Rms of the deviations over the bounds, and over the errors."""
        use = (self.snr >= low) & (self.snr < high) & (self.row >= 0)
        return tuple(np.sqrt(np.mean((self.off / each)[use] ** 2)) for each in (self.bound, self.error))


def compared(truth, stars, start, *, edge=EDGE):
    """A catalogue beside the truth, a common cubic map of the plane taken off, which nothing determines.

    Parameters
    ----------
    truth : DeepFrames
    stars : `~astropy.table.QTable`
    start : ndarray, shape (n, 2)
        Roughly where the true stars lie in the plane of the catalogue; NaN where that is not known.
    edge : int
        Pixels at the edge that are left out.
    """
    size, fwhm = truth.frames[0].shape[0], 2.3548 * SIGMA
    xy = np.column_stack([stars["x"].value, stars["y"].value])
    error = np.hypot(*(np.stack([stars[f"x_{e}"].value, stars[f"y_{e}"].value], 1) for e in ("err", "map_err")))
    u, v = (truth.xy / (size - 1) * 2 - 1).T
    basis = np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=1)
    tree, place, reach = cKDTree(xy), np.nan_to_num(start, nan=-1e6), 2.0
    for _ in range(4):
        distance, row = tree.query(place)
        use = (truth.snr > 30) & (distance < reach)
        weight = 1 / error[row[use], :1]
        place = basis @ np.linalg.lstsq(basis[use] * weight, xy[row[use]] * weight, rcond=None)[0]
        reach = 0.5
    shift = (place - truth.xy)[use].mean(axis=0)
    inside, within = (((p > edge) & (p < size - 1 - edge)).all(axis=1) for p in (truth.xy, xy - shift))
    taken, match = np.zeros(len(xy), dtype=bool), np.full(len(truth.xy), -1)
    order = np.argsort(-truth.snr)
    for k in order[truth.snr[order] > 3]:
        near = [i for i in tree.query_ball_point(place[k], fwhm) if not taken[i]]
        if near:
            match[k] = near[int(np.argmin(np.hypot(*(xy[near] - place[k]).T)))]
            taken[match[k]] = True
    order = order[inside[order]]
    row = match[order]
    away = cKDTree(place[truth.snr > 3]).query(xy)[0] > fwhm
    off = xy[row] - place[order]
    counts = int(within.sum()), int((away & within).sum())
    return Compared(order, truth.snr[order], row, off, truth.bound[order, :2], error[row], *counts, shift)


def artificial_inside(truth, compared, made, *, edge=EDGE):
    """Which artificial stars of a table lie where `compared` looks; (n,)."""
    there = np.column_stack([made["x"].value, made["y"].value]) - compared.shift
    return ((there > edge) & (there < truth.frames[0].shape[0] - 1 - edge)).all(axis=1)


def flux_level(truth, compared, stars):
    """Fluxes of a catalogue over true ones, by bright stars."""
    use = (compared.snr > 40) & (compared.row >= 0)
    return np.median(np.asarray(stars["flux"])[compared.row[use]] / truth.flux[compared.star[use]])


def excess(truth, compared, stars):
    """Ratios of signal to noise of rows that are true stars, by what their fluxes are too large, over the errors, and
    what ``flux_bias`` states of that; (3, n).
    """
    use = compared.row >= 0
    rows = stars[compared.row[use]]
    off = np.asarray(rows["flux"]) - flux_level(truth, compared, stars) * truth.flux[compared.star[use]]
    stated = rows["flux_bias"] if "flux_bias" in stars.colnames else np.full(len(rows), np.nan)
    return np.array([rows["snr"], off / rows["flux_err"], stated / rows["flux_err"]])


def with_galaxies(truth, xy, snr, radius, *, ratio=0.7, seed=0):
    """The frames of `DeepFrames` with exponential discs at places (n, 2) of the plane, through the same maps.

    Parameters
    ----------
    snr : array_like, shape (n,)
        Ratio of signal to noise that a star of their light has in one frame.
    radius : array_like, shape (n,)
        Half-light radius [px] before the light is spread by the PSF.
    ratio : float
        Of the axes.
    """
    rng, size, frames = np.random.default_rng(seed), truth.frames[0].shape[0], []

    def terms(xy):
        u, v = (xy / (size - 1) * 2 - 1).T
        return np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=1)

    angles = rng.uniform(0, np.pi, len(xy))
    for data, pixels, t in zip(truth.frames, truth.pixels, truth.transmission, strict=True):
        data = data.astype(float)
        places = terms(np.asarray(xy)) @ np.linalg.lstsq(terms(truth.xy), pixels, rcond=None)[0]
        for place, s, r, angle in zip(places, snr, radius, angles, strict=True):
            image, window = _disc(place, r, ratio, angle, size)
            image *= t * s * SKY * np.sqrt(4 * np.pi) * SIGMA
            data[window] += image + rng.normal(0, 1, image.shape) * np.sqrt(image)
        frames.append(data.astype(np.float32))
    return frames


def _disc(place, radius, ratio, angle, size, n=(60, 36)):
    """An exponential disc of unit light, as many points, and the rows and columns of it."""
    share = (np.arange(n[0]) + 0.5) / n[0]  # of the light within
    r = np.interp(share, 1 - (1 + (x := np.linspace(0, 12, 2000))) * np.exp(-x), x) * radius / 1.678
    a = (np.arange(n[1]) + 0.5) / n[1] * 2 * np.pi
    u, v = (r[:, None] * np.cos(a)).ravel(), ratio * (r[:, None] * np.sin(a)).ravel()
    x, y = place[0] + u * np.cos(angle) - v * np.sin(angle), place[1] + u * np.sin(angle) + v * np.cos(angle)
    reach = int(5 * radius) + _HALF
    columns, rows = (np.arange(max(0, round(c) - reach), min(size, round(c) + reach + 1)) for c in place)
    a, b = (
        (erf((g + 0.5 - c[:, None]) / SIGMA / 2**0.5) - erf((g - 0.5 - c[:, None]) / SIGMA / 2**0.5)) / 2
        for c, g in ((x, columns), (y, rows))
    )
    return b.T @ a / len(x), np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
