"""Stars that more than the distortion displaces: refraction, pixels, their own paths. Truth made by numpy alone."""

from dataclasses import dataclass

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.polynomial import legendre

import legdistort as ld
from legdistort.geometry import basis

SIZE, DEGREE, SIGMA = 2048, 3, 0.01
ORDERS = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]


def modes(xy):
    """Products of Legendre polynomials of mean square 1, (10, n)."""
    u_, v = (2 * np.asarray(xy).T + 1) / SIZE - 1
    one = np.eye(DEGREE + 1)
    return np.array([legendre.legval(u_, one[i]) * legendre.legval(v, one[j]) * np.sqrt((2 * i + 1) * (2 * j + 1))
                     for i, j in ORDERS])  # fmt: skip


@dataclass
class Sky:
    """A field seen by a camera with a static distortion that is known, in dithered exposures with some of their own."""

    table: QTable
    stars: np.ndarray
    static: np.ndarray
    amplitudes: np.ndarray
    odd: np.ndarray
    paths: object
    dithers: np.ndarray

    @property
    def matches(self):
        return ld.Matches.from_table(self.table, shape=(SIZE, SIZE))

    @property
    def prior(self):
        places = [ORDERS.index((int(i), int(j))) for i, j in zip(*basis.orders(DEGREE), strict=True)]
        return ld.Prior(2 * self.static[:, places])  # whose modes have a mean square of 1/4

    def solve(self, **options):
        return ld.solve(self.matches, prior=self.prior, **options)

    def off(self, solution, stars=None, table=None):
        """Errors of positions beyond a common cubic, and their standard errors, of all stars, (n, 2) each."""
        table = solution.stars if table is None else table
        row = np.asarray(table["star"])
        error = np.column_stack([table["x_err"].value, table["y_err"].value])
        off = np.column_stack([table["x"].value, table["y"].value]) - (self.stars if stars is None else stars)[row]
        known = np.isfinite(off[:, 0])
        weight, maps = 1 / error[known, :1], modes(self.stars[row]).T
        return off - maps @ np.linalg.lstsq(maps[known] * weight, off[known] * weight, rcond=None)[0], error


def squared_pull(off, error):
    return np.sum(off**2) / np.sum(error**2)


def sky(seed, *, refraction=0.0, phase=0.0, orbits=0.0, acceleration=0.0, n_stars=60, n_exposures=11, years=0.0,
        extra=None):  # fmt: skip
    """A `Sky`: refraction by colour, an error by pixel phase, or 5 % of the stars on paths that are not straight."""
    r = np.random.default_rng(seed)
    stars, colour = r.uniform(150, SIZE - 150, (n_stars, 2)), r.normal(size=n_stars)
    static = r.normal(0, 1, (2, len(ORDERS)))
    static[:, :3] = 0  # shift, and a part of what poses carry
    amplitudes = r.normal(size=(2, 2))
    amplitudes *= phase / np.sqrt(np.mean(np.sum(amplitudes**2, axis=1) / 2))
    odd = r.choice(n_stars, max(n_stars // 20, 1), replace=False)
    angle, flat = r.uniform(0, 2 * np.pi, (n_stars, 1)), r.uniform(0.3, 1, (n_stars, 1))
    motion = r.normal(0, 0.02, (n_stars, 2))
    hour = np.linspace(-0.6, 1.05, n_exposures)  # of a field near the pole, from Chile
    lat, dec = np.radians([-30.24, -69.0])
    z = np.arccos(np.sin(lat) * np.sin(dec) + np.cos(lat) * np.cos(dec) * np.cos(hour))
    q = np.arctan2(np.sin(hour), np.tan(lat) * np.cos(dec) - np.sin(dec) * np.cos(hour))

    def paths(time):
        """Positions at a time, years from the epoch."""
        out = stars + motion * time * bool(years)
        phi = 2 * np.pi * time / 16 + angle[odd]
        out[odd] += orbits * np.hstack([np.cos(phi), flat[odd] * np.sin(phi)])
        out[odd] += 0.5 * acceleration * time**2 * np.hstack([np.cos(angle[odd]), np.sin(angle[odd])])
        return out

    parts, dithers = [], np.zeros((n_exposures, 2))
    for i in range(n_exposures):
        time = years * (i // 2 * 2 / (n_exposures - 2) - 0.5) if years else 0.0
        dithers[i] = r.normal(0, 100, 2)
        at = paths(time) + dithers[i]
        seen = at + ((static + r.normal(0, 0.3, static.shape)) @ modes(at)).T
        seen = seen + refraction * np.tan(z[i]) * colour[:, None] * [np.sin(q[i]), np.cos(q[i])]
        if extra is not None:
            seen = seen + extra(i, at)
        wave = 2 * np.pi * (seen + 0.5)
        seen = seen + amplitudes[:, 0] * np.sin(wave) + amplitudes[:, 1] * np.cos(wave)
        seen = seen + r.normal(0, SIGMA, seen.shape)
        inside = np.flatnonzero(((seen > 0) & (seen < SIZE - 1)).all(axis=1))
        part = QTable({"exposure": np.full(len(inside), f"e{i:02d}"), "star": inside})
        part["x"], part["y"] = seen[inside].T * u.pix
        part["x_err"] = part["y_err"] = np.full(len(inside), SIGMA) * u.pix
        part["colour"] = colour[inside]
        part["tan_z"], part["parallactic_angle"] = np.tan(z[i]), np.degrees(q[i]) * u.deg
        part["epoch"] = np.full(len(inside), 2008.0 + time) * u.yr
        parts.append(part)
    table = QTable({name: np.concatenate([part[name] for part in parts]) for name in parts[0].colnames})
    return Sky(table, stars, static, amplitudes, odd, paths, dithers)


@dataclass
class Others:
    """Stars of a `Sky` that took no part, in all exposures."""

    table: QTable
    stars: np.ndarray

    def pull(self, solution):
        """Mean square of what is wrong with them beyond the common cubic of the solution, in stated errors."""
        row, error = np.asarray(solution.stars["star"]), solution.stars["x_err"].value[:, None]
        xy = np.column_stack([solution.stars["x"].value, solution.stars["y"].value])
        maps = modes(self.stars[row]).T
        common = np.linalg.lstsq(maps / error, (xy - self.stars[row]) / error, rcond=None)[0]
        squares = []
        for name in solution.names:
            rows = self.table[self.table["exposure"] == name]
            measured = np.column_stack([rows["x"].value, rows["y"].value])
            found = solution[name].correct(measured, errors=np.full(measured.shape, SIGMA))
            true = self.stars[np.asarray(rows["star"])]
            off = found.xy - true - modes(true).T @ common
            squares.append(np.einsum("na,nab,nb->n", off, np.linalg.inv(found.relative), off) / 2)
        return np.mean(np.concatenate(squares))


def displaced_by(seed, displacements, n_stars, **how):
    """A `Sky` with displacements by exposure, functions of the place, or None, and a third as many `Others`."""
    extra = None if displacements is None else lambda i, at: displacements[i](at)
    field = sky(seed, n_stars=n_stars + n_stars // 3, extra=extra, **how)
    new = np.asarray(field.table["star"]) >= n_stars
    others, field.table = Others(field.table[new], field.stars), field.table[~new]
    return field, others


def optimum(field, covariance):
    """Least mean square error of the stars beyond a common cubic, of who knows the covariance of the displacements.

    By generalised least squares of positions, poses and departures of 0.3 px; the slopes of distortions are left out.
    """
    star, names = np.asarray(field.table["star"]), np.unique(field.table["exposure"])
    n, m, e = star.max() + 1, len(ORDERS), len(names)
    normal = np.zeros((2 * (n + m * e),) * 2)
    for i, name in enumerate(names):
        at = star[field.table["exposure"] == name]
        places = field.stars[at] + field.dithers[i]
        inverse = np.linalg.inv(covariance(places, places) + SIGMA**2 * np.eye(2 * len(at)))
        own = np.kron(modes(places).T, np.eye(2))
        rows = (2 * at[:, None] + [0, 1]).ravel()
        rows = np.concatenate([rows, 2 * (n + m * i) + np.arange(2 * m)])
        design = np.hstack([np.eye(2 * len(at)), own])
        known = np.repeat(np.where(np.arange(m) == 0, 0.0, 1 / 0.3**2), 2)
        normal[np.ix_(rows, rows)] += design.T @ inverse @ design
        normal[rows[-2 * m :], rows[-2 * m :]] += known
    used = np.unique(star)
    keep = np.concatenate([(2 * used[:, None] + [0, 1]).ravel(), np.arange(2 * n, len(normal))])
    normal = normal[np.ix_(keep, keep)] + 1e-9 * np.eye(len(keep))
    error = np.linalg.inv(normal)[: 2 * len(used), : 2 * len(used)]
    maps = np.kron(modes(field.stars[used]).T, np.eye(2))
    left = np.eye(len(maps)) - maps @ np.linalg.pinv(maps)
    return np.trace(left @ error @ left.T) / len(maps)
