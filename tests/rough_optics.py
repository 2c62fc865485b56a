"""A rough optical map, and a mask of pinholes seen through it. Truth made by numpy alone."""

from dataclasses import dataclass

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.polynomial import legendre

import legdistort as ld


def modes(xy, size, degree):
    """Legendre modes of mean square 1, (n, n_modes), of total degree up to `degree`."""
    w = (2 * np.asarray(xy) + 1) / size - 1
    x, y = (legendre.legvander(each, degree) * np.sqrt(2 * np.arange(degree + 1) + 1) for each in w.T)
    return np.stack([x[:, n - k] * y[:, k] for n in range(degree + 1) for k in range(n + 1)], axis=1)


def beyond(values, xy, size, degree):
    """Values (n, k) without the Legendre series up to a degree that fits them best."""
    m = modes(xy, size, degree)
    return values - m @ np.linalg.lstsq(m, values, rcond=None)[0]


@dataclass
class Mask:
    """Holes (n, 2) seen through a map in shifted exposures.

    The map is a Legendre series up to degree 5, of some pixels, and what that has not of waves of a box 1.5 times the
    detector, whose amplitudes fall with a power of the wave number, up to `highest` half waves over the detector.
    """

    size: int = 4076
    holes_along: int = 27
    n_exposures: int = 9
    shift: float = 60.0
    noise: float = 0.0014
    power: float = 8.5
    highest: float = 30.0
    rough: float = 1.0
    seed: int = 0

    def __post_init__(self):
        r, box = np.random.default_rng(self.seed), 1.5 * self.size
        top = self.highest / 2 * box / self.size
        i, j = np.meshgrid(np.arange(top + 1), np.arange(-np.floor(top), top + 1), indexing="ij")
        kept = ((i > 0) | (j > 0)) & (np.hypot(i, j) <= top)
        self.waves, k = 2 * np.pi / box * np.stack([i[kept], j[kept]]), np.tile(np.hypot(i, j)[kept], 2)
        self.widths = k ** (-self.power / 2)
        self.amplitudes = r.normal(size=(len(k), 2)) * self.widths[:, None]
        grid = np.stack(np.meshgrid(*2 * [np.linspace(0, self.size - 1, 90)]), axis=-1).reshape(-1, 2)
        low, wavy = modes(grid, self.size, 5), self.columns(grid) @ self.amplitudes
        self.series = -np.linalg.lstsq(low, wavy, rcond=None)[0]
        scale = self.rough / np.std(wavy + low @ self.series)
        self.amplitudes, self.widths, self.series = scale * self.amplitudes, scale * self.widths, scale * self.series
        self.series[3:] += r.normal(0, 1, self.series[3:].shape)
        step = self.size / self.holes_along
        line = (np.arange(self.holes_along) - (self.holes_along - 1) / 2) * step + (self.size - 1) / 2
        self.holes = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        self.holes += r.normal(0, 0.3, self.holes.shape)
        shifts = r.uniform(-self.shift, self.shift, (self.n_exposures, 2))
        self.poses = {f"m{n}": np.column_stack([np.eye(2), shift]) for n, shift in enumerate(shifts)}
        seen = (self.holes + shifts[:, None]).reshape(-1, 2)
        exposure = np.repeat(np.arange(self.n_exposures), len(self.holes))
        hole = np.tile(np.arange(len(self.holes)), self.n_exposures)
        measured = seen + self.map(seen) + r.normal(0, self.noise, seen.shape)
        on = np.all((measured > 0) & (measured < self.size - 1), axis=1)
        self.places, self.exposure, self.hole, self.measured = seen[on], exposure[on], hole[on], measured[on]

    def columns(self, q):
        """Waves (n, m) at undistorted pixels."""
        phase = np.asarray(q) @ self.waves
        return np.hstack([np.cos(phase), np.sin(phase)])

    def map(self, q):
        """Displacements (n, 2)."""
        return self.columns(q) @ self.amplitudes + modes(q, self.size, 5) @ self.series

    @property
    def matches(self):
        x, y = self.measured.T * u.pix
        error = np.full(len(x), self.noise) * u.pix
        names = [f"m{n}" for n in self.exposure]
        table = QTable({"exposure": names, "star": self.hole, "x": x, "y": y, "x_err": error, "y_err": error})
        return ld.Matches.from_table(table, shape=(self.size, self.size), poses=self.poses)

    @property
    def known(self):
        """How well shifts are known, and that there are no turns and scales."""
        return {"shift": 1e-4, "rotation": 1e-6, "scale": 2e-8}

    def solve(self, **options):
        """The solution with the shifts known, and what is static alone."""
        how = {"degree": 5, "static": "fit", "exposure_degree": 0, "clip": None, "pose_sigma": self.known}
        return ld.solve(self.matches, **how | options)

    def at(self, n=2500):
        """Places (n, 2) all over the detector but its edge."""
        return np.random.default_rng(self.seed + 1).uniform(0.02 * self.size, 0.98 * self.size, (n, 2))

    def optimum(self, q):
        """The map (n, 2) at places by least squares with the true covariance of the map, and chi2 by its freedom.

        Nothing is known of holes and of the series, shifts are known.
        """

        def every(places):
            return np.hstack([self.columns(places), modes(places, self.size, 5)])

        n = np.bincount(self.hole, minlength=len(self.holes))

        def about_holes(values):
            means = np.stack([np.bincount(self.hole, column, len(self.holes)) for column in values.T], axis=1)
            return values - (means / np.maximum(n, 1)[:, None])[self.hole]

        columns, given = about_holes(every(self.places)), about_holes(self.measured - self.places)
        normal = columns.T @ columns / self.noise**2
        both = normal + np.diag(np.append(self.widths**-2.0, np.full(21, 1e-6)))
        found = np.linalg.solve(both, columns.T @ given) / self.noise**2
        freedom = len(self.hole) - np.count_nonzero(n) - np.trace(np.linalg.solve(both, normal))
        chi2 = np.sum((given - columns @ found) ** 2) / self.noise**2
        return every(q) @ found, chi2 / (2 * freedom)
