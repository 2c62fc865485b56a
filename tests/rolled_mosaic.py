"""A camera of 2 x 2 detectors at two rolls with a reference catalogue, and the minimum of J over all there is to it.

numpy alone: what was measured on detector c of exposure i is ``x = C_c(E_i(X))``, both polynomials of total degree d,
and J has the squares of the residuals and those of the stars from the catalogue.
"""

from dataclasses import dataclass

import numpy as np
from astropy.table import Table

SIZE, GAP = 512, 22
CENTRES = {str(2 * b + a): (SIZE + GAP) * np.array([a - 0.5, b - 0.5]) for a in (0, 1) for b in (0, 1)}
FIELD = SIZE + GAP / 2


def powers(xy, degree):
    """Monomials (n, modes) of positions (n, 2) over the field, orders 0 and 1 first."""
    x, y = np.asarray(xy).T / FIELD
    return np.stack([x**p * y ** (k - p) for k in range(degree + 1) for p in range(k + 1)], axis=1)


def slopes(xy, degree):
    """Their derivatives by x and y, (n, modes, 2)."""
    x, y = np.asarray(xy).T / FIELD
    each = [(p, k - p) for k in range(degree + 1) for p in range(k + 1)]
    by_x = [p * x ** max(p - 1, 0) * y**q for p, q in each]
    by_y = [q * x**p * y ** max(q - 1, 0) for p, q in each]
    return np.stack([by_x, by_y], axis=0).transpose(2, 1, 0) / FIELD


def identity(degree):
    """The coefficients (2, modes) of a map that does nothing."""
    out = np.zeros((2, (degree + 1) * (degree + 2) // 2))
    out[1, 1] = out[0, 2] = FIELD
    return out


@dataclass
class Mosaic:
    """What was measured, and the truth.

    Attributes
    ----------
    degree : int
    stars : ndarray, shape (n_stars, 2)
    exposures, detectors : ndarray, shape (n, 2, modes)
        True maps.
    of : ndarray of int, shape (n, 3)
        Exposure, detector and star of every row.
    measured : ndarray, shape (n, 2)
        About the centre of the detector.
    sigma : float
    catalogue : ndarray, shape (n_known, 2)
        Of the first stars.
    error : float
    """

    degree: int
    stars: np.ndarray
    exposures: np.ndarray
    detectors: np.ndarray
    of: np.ndarray
    measured: np.ndarray
    sigma: float
    catalogue: np.ndarray
    error: float

    @property
    def table(self):
        """The rows as they come from detection."""
        keys, half = list(CENTRES), (SIZE - 1) / 2
        exposure, detector, star = self.of.T
        columns = {"exposure": [f"e{i}" for i in exposure], "detector": [keys[c] for c in detector]}
        columns |= {"star": star.astype(str), "x": self.measured[:, 0] + half, "y": self.measured[:, 1] + half}
        return Table(columns | {"x_err": np.full(len(star), self.sigma), "y_err": np.full(len(star), self.sigma)})

    @property
    def poses(self):
        """Roughly where exposures pointed, as headers have it."""
        low = {f"e{i}": m[:, [1, 0, 0]] for i, m in enumerate(self.exposures)}
        for i, m in enumerate(self.exposures):
            u, _, v = np.linalg.svd(m[:, [2, 1]] / FIELD)
            low[f"e{i}"] = np.column_stack([u @ v, m[:, 0]])
        return low

    @property
    def layouts(self):
        """Nominal: where headers have the detectors."""
        return {key: np.column_stack([np.eye(2), (SIZE - 1) / 2 - c]) for key, c in CENTRES.items()}

    @property
    def reference(self):
        """The catalogue."""
        n = len(self.catalogue)
        columns = {"star": np.arange(n).astype(str), "x": self.catalogue[:, 0], "y": self.catalogue[:, 1]}
        return Table(columns | {"x_err": np.full(n, self.error), "y_err": np.full(n, self.error)})


def mosaic(seed, *, degree=3, n_stars=90, n_known=90, n_each=4, sigma=0.01, error=0.003, optics=1.5, dynamic=0.1,
           static=0.15, dither=40.0):  # fmt: skip
    """A set of `n_each` exposures at either roll."""
    rng, modes = np.random.default_rng(seed), (degree + 1) * (degree + 2) // 2
    stars = rng.uniform(-1.15 * FIELD, 1.15 * FIELD, (n_stars, 2))
    high = np.arange(modes) > 2
    common = optics * rng.normal(size=(2, modes)) * high
    exposures, detectors = [], []
    for i in range(2 * n_each):
        t = np.radians(90.0 * (i >= n_each) + rng.normal(0, 0.03))
        turn = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
        wanted = common + dynamic * rng.normal(size=(2, modes)) * high + identity(degree)
        at = rng.uniform(-1.3 * FIELD, 1.3 * FIELD, (4 * modes, 2))
        there = powers(at @ turn.T + rng.uniform(-dither, dither, 2), degree) @ wanted.T
        exposures.append(np.linalg.lstsq(powers(at, degree), there, rcond=None)[0].T)
    for centre in CENTRES.values():
        own = identity(degree) + static * rng.normal(size=(2, modes)) * high
        own[:, 0] += -centre + rng.normal(0, 0.5, 2)
        own[:, 1:3] += 0.3 * rng.normal(size=(2, 2))
        detectors.append(own)
    exposures, detectors, of, measured = np.array(exposures), np.array(detectors), [], []
    for i, map_ in enumerate(exposures):
        f = powers(stars, degree) @ map_.T
        for c, own in enumerate(detectors):
            x = powers(f, degree) @ own.T
            for j in np.flatnonzero((np.abs(x) < SIZE / 2 - 1).all(axis=1)):
                of.append((i, c, j))
                measured.append(x[j] + sigma * rng.normal(size=2))
    of, measured = np.array(of), np.array(measured)
    often = [len(set(of[of[:, 2] == j, 0])) > 1 for j in range(n_stars)]
    stars, kept = stars[often], np.array(often)[of[:, 2]]
    of, measured = of[kept], measured[kept]
    of[:, 2] = (np.cumsum(often) - 1)[of[:, 2]]
    n_known = min(n_known, len(stars))
    catalogue = stars[:n_known] + error * rng.normal(size=(n_known, 2))
    return Mosaic(degree, stars, exposures, detectors, of, measured, sigma, catalogue, error)


def minimum(mosaic, *, detectors=True):
    """J, that of the measured positions alone, the stars and their covariance (2 n_stars,) squared, all x first.

    By Levenberg and Marquardt, from the truth. Without `detectors` these are known.
    """
    here = mosaic.stars, mosaic.exposures, mosaic.detectors
    cost, damping, last = np.inf, 1e-6, None
    for _ in range(100):
        design, left = _linear(mosaic, *here, detectors=detectors)
        now = left @ left
        if not now <= cost:
            damping *= 100
        else:
            if cost - now < 1e-3:
                break
            cost, damping, last = now, max(damping / 10, 1e-10), here
            unit = 1 / np.linalg.norm(design, axis=0).clip(1e-12)
            normal, pull = (design * unit).T @ (design * unit), unit * (design.T @ left)
        here = _moved(last, unit * np.linalg.solve(normal + damping * np.eye(len(normal)), pull), detectors)
    size = 2 * len(mosaic.stars)
    inverse = np.linalg.pinv((design * unit).T @ (design * unit), rcond=1e-12, hermitian=True)
    covariance = inverse[:size, :size] * np.outer(unit[:size], unit[:size])
    of_data = left[: 2 * len(mosaic.of)]
    return float(now), float(of_data @ of_data), here[0], covariance


def _linear(mosaic, stars, maps, own, *, detectors):
    """The design matrix and what is left, both in standard errors."""
    d, (exposure, detector, star) = mosaic.degree, mosaic.of.T
    n, m, rows, n_known = len(stars), maps.shape[2], np.arange(len(star)), len(mosaic.catalogue)
    values = powers(stars[star], d)
    f = np.einsum("nm,nam->na", values, maps[exposure])
    inner = powers(f, d)
    left = mosaic.measured - np.einsum("nm,nam->na", inner, own[detector])
    by_f = np.einsum("nam,nmb->nab", own[detector], slopes(f, d))
    by_star = by_f @ np.einsum("nam,nmb->nab", maps[exposure], slopes(stars[star], d))
    a = np.zeros((2, len(star), 2 * n + maps.size + own.size * detectors))
    for k in (0, 1):
        for b in (0, 1):
            a[k, rows, b * n + star] = by_star[:, k, b]
            at = 2 * n + (2 * exposure[:, None] + b) * m + np.arange(m)
            np.put_along_axis(a[k], at, by_f[:, k, b, None] * values, axis=1)
        if detectors:
            np.put_along_axis(a[k], 2 * n + maps.size + (2 * detector[:, None] + k) * m + np.arange(m), inner, axis=1)
    tie = np.zeros((2, n_known, a.shape[2]))
    for k in (0, 1):
        tie[k, np.arange(n_known), k * n + np.arange(n_known)] = 1 / mosaic.error
    design = np.concatenate([a.reshape(-1, a.shape[2]) / mosaic.sigma, tie.reshape(-1, a.shape[2])])
    off = (mosaic.catalogue - stars[:n_known]) / mosaic.error
    return design, np.concatenate([left.T.ravel() / mosaic.sigma, off.T.ravel()])


def _moved(here, step, detectors):
    """Stars, maps of exposures and of detectors after a step."""
    stars, maps, own = here
    of_stars, of_maps, of_own = np.split(step, [stars.size, stars.size + maps.size])
    own = own + of_own.reshape(own.shape) if detectors else own
    return stars + of_stars.reshape(2, -1).T, maps + of_maps.reshape(maps.shape), own
