"""Model families that the paper weighs (section 2.1): Legendre polynomials, plain powers, bivariate B-splines.

Fitted to published maps of real instruments: residual against number of coefficients, condition of the fit.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline

from legdistort.geometry import basis
from legdistort.geometry.gsaoi import gsaoi_polynomials
from legdistort.priors.from_files import read_source

DEGREES = range(1, 13)
SPLINE_CELLS = range(1, 11)
_N_GRID = 64


def data_folder():
    """Folder of real data: ``LEGDISTORT_DATA``, or ``../shared/data`` beside the repository; None if absent."""
    candidates = [os.environ.get("LEGDISTORT_DATA"), Path(__file__).parents[3] / "shared" / "data"]
    return next((Path(c) for c in candidates if c and Path(c).is_dir()), None)


def nirc2_files(folder):
    """The two look-up maps (x, y) of the NIRC2 narrow camera, central 512 x 512 pixels."""
    return [folder / "static_distortion" / "nirc2_kai" / f"nirc2_narrow_{axis}geoim_512.fits" for axis in "xy"]


def maps(folder):
    """``{name: (u, v, displacement (2, n), size)}``: maps from detector to undistorted pixels on a grid."""
    t = (np.arange(_N_GRID) + 0.5) / _N_GRID * 2 - 1
    u, v = (a.ravel() for a in np.meshgrid(t, t))
    out = {"GSAOI detector 2": (u, v, _gsaoi(u, v), 2048)}
    if folder is not None:
        source = read_source(nirc2_files(folder)).stated()
        x, y = basis.denormalize(u, v, source.shape).T
        out["NIRC2 narrow camera"] = (u, v, np.stack(source.on_plane()(x, y)) - [x, y], source.shape[0])
    return out


def _gsaoi(u, v):
    c = gsaoi_polynomials(2)
    x, y = basis.denormalize(u, v, (2048, 2048)).T
    plane = np.stack([np.polynomial.polynomial.polyval2d(x + 1, y + 1, each) for each in c])
    return plane / np.sqrt(abs(c[0, 1, 0] * c[1, 0, 1])) - [x, y]


def legendre_columns(u, v, degree, size):
    """Normalised Legendre polynomials up to a total degree, (n, n_modes)."""
    return basis.values(degree, u, v).T


def power_columns(u, v, degree, size):
    """Powers x^i y^j of pixels, i + j <= degree, as in a header or a textbook: (n, n_modes)."""
    x, y = basis.denormalize(u, v, (size, size)).T
    return np.stack([x**i * y**j for i, j in zip(*basis.orders(degree), strict=True)], axis=1)


def scaled_power_columns(u, v, degree, size):
    """Powers of coordinates scaled to [-1, 1]: (n, n_modes)."""
    return np.stack([u**i * v**j for i, j in zip(*basis.orders(degree), strict=True)], axis=1)


def spline_columns(u, v, cells, size):
    """Bivariate cubic B-splines on cells x cells equal cells: (n, (cells + 3)^2)."""
    knots = np.concatenate([[-1] * 3, np.linspace(-1, 1, cells + 1), [1] * 3])
    a, b = (BSpline.design_matrix(t, knots, 3).toarray() for t in (u, v))
    return (a[:, :, None] * b[:, None, :]).reshape(len(u), -1)


FAMILIES = {
    "Legendre": (legendre_columns, DEGREES),
    "powers of pixels": (power_columns, DEGREES),
    "powers, scaled to [-1, 1]": (scaled_power_columns, DEGREES),
    "cubic B-splines": (spline_columns, SPLINE_CELLS),
}


@dataclass(frozen=True, eq=False)
class Fits:
    """Fits of one family to one map, by rising number of coefficients an axis."""

    number: np.ndarray
    residual: np.ndarray
    condition: np.ndarray

    def needed(self, limit):
        """Fewest coefficients an axis whose residual is below a limit [px], or None."""
        good = self.residual < limit
        return int(self.number[good].min()) if good.any() else None


def fit(u, v, displacement, size, family):
    """Least-squares fits of a family: residual rms per axis [px], condition number of the equations.

    Raw columns, as they are: a program that scales them first does better than this.
    """
    columns, orders = FAMILIES[family]
    number, residual, condition = [], [], []
    for order in orders:
        design = columns(u, v, order, size)
        found = np.linalg.lstsq(design, displacement.T, rcond=np.finfo(float).eps)[0]
        number.append(design.shape[1])
        residual.append(np.sqrt(np.mean((displacement.T - design @ found) ** 2)))
        condition.append(np.linalg.cond(design))
    return Fits(np.array(number), np.array(residual), np.array(condition))


def stars_only(u, v, displacement, size, family, *, n_stars=80, noise=0.02, n=20, seed=0):
    """The same from noisy positions of a few stars: rms error per axis over the whole map [px], mean of n draws."""
    columns, orders = FAMILIES[family]
    number, errors = [], []
    for order in orders:
        design = columns(u, v, order, size)
        if design.shape[1] > n_stars:
            break
        squares = []
        for draw in range(n):
            rng = np.random.default_rng((seed, draw))
            chosen = rng.choice(len(u), n_stars, replace=False)
            measured = displacement[:, chosen] + noise * rng.normal(size=(2, n_stars))
            found = np.linalg.lstsq(design[chosen], measured.T, rcond=np.finfo(float).eps)[0]
            squares.append(np.mean((displacement.T - design @ found) ** 2))
        number.append(design.shape[1])
        errors.append(np.sqrt(np.median(squares)))
    return np.array(number), np.array(errors)
