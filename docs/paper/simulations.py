"""Simulations 1 to 5 of Bernard et al. (2017, section 4, Table 1), a few lines each over the public functions.

All errors are per axis. Distortions are drawn as normal Legendre coefficients: static 1.5 px, dynamic 0.9 px with zero
mean, so that the starting point (the static part) is the true mean, as in the paper.
"""

from dataclasses import dataclass, replace

import numpy as np

import legdistort as ld
from legdistort import paper
from legdistort.geometry import basis, similarity
from legdistort.results import accuracy
from legdistort.simulation.observations import matches_from

#: Standard deviations of the measured positions, pixels; at 0 the errors are 0 but for rounding.
LEVELS = (0.03, 0.07, 0.14, 0.28)
N_OUTCOMES = 100
N_GRID = 150
FRACTION_INSIDE = 0.9


def simulation_1(seed=0, *, n_grid=N_GRID):
    """One data set and the map of its error: simulation, solution, grid (n, 2), sigma_j' (n,), contour."""
    sim = ld.simulate_matches(seed=seed)
    solution = paper.solve(sim.matches, prior=ld.Prior(sim.truth.static))
    grid = sim.truth.grid(sim.truth.names[0], n_grid)
    sigma = accuracy.new_scatter(solution, sim.truth.distort, grid, 0.14, rng=np.random.default_rng(seed))
    return sim, solution, grid, sigma, accuracy.contour(sim.truth.positions, fraction=FRACTION_INSIDE)


@dataclass(frozen=True)
class Outcome:
    """Settings of one outcome of simulations 2 to 4."""

    seed: int
    sigma: float
    n_exposures: int = 10
    n_stars: int = 30
    zero_mean: bool = True
    static_known: bool = True
    n_grid: int = N_GRID

    def run(self):
        """b, b after a common cubic map, sigma inside the contour, sigma on the whole grid: pixels per axis."""
        sim = ld.simulate_matches(
            n_exposures=self.n_exposures,
            n_stars=self.n_stars,
            sigma=self.sigma or 0.14,
            noise=1.0 if self.sigma else 0.0,
            zero_mean=self.zero_mean,
            seed=self.seed,
        )
        truth = sim.truth
        solution = paper.solve(sim.matches, prior=ld.Prior(truth.static) if self.static_known else None)
        b = [accuracy.bias(solution.estimate.positions, truth.positions, removed=removed) for removed in (None, 3)]
        if not self.n_grid:
            return (*b, np.nan, np.nan)
        grid = truth.grid(truth.names[0], self.n_grid)
        rng = np.random.default_rng((self.seed, 1))
        scatter = accuracy.new_scatter(solution, truth.distort, grid, self.sigma, rng=rng)
        inside = accuracy.in_contour(grid, accuracy.contour(truth.positions, fraction=FRACTION_INSIDE))
        return (*b, rms(scatter[inside]), rms(scatter))


@dataclass(frozen=True)
class Propagation:
    """Criteria of n outcomes at every level, averaged quadratically, and the slopes through the origin.

    Attributes
    ----------
    levels : ndarray, shape (n_levels,)
    values : ndarray, shape (n_levels, n_outcomes, 4)
        As `Outcome.run` gives them.
    """

    levels: np.ndarray
    values: np.ndarray

    @property
    def curves(self):
        """Quadratic means over the outcomes, shape (n_levels, 4)."""
        return np.sqrt(np.mean(self.values**2, axis=1))

    def slope(self, k):
        """Slope of criterion k over sigma_meas (least squares through the origin) and its standard error."""
        weight = self.levels / np.sum(self.levels**2)
        n = self.values.shape[1]
        mean_square = np.mean(self.values[:, :, k] ** 2, axis=1)
        error = np.std(self.values[:, :, k] ** 2, axis=1, ddof=1) / np.sqrt(n) / (2 * np.sqrt(mean_square))
        return float(weight @ np.sqrt(mean_square)), float(np.sqrt(np.sum((weight * error) ** 2)))


def propagate(*, n=N_OUTCOMES, levels=LEVELS, pool=None, **settings):
    """Simulations 2 to 4: n outcomes at every level of noise, every one with stars and distortions of its own.

    ``pool`` is an executor of `concurrent.futures` that shares the work; ``settings`` are those of `Outcome`.
    """
    jobs = [Outcome(seed=1000 * k + i, sigma=level, **settings) for k, level in enumerate(levels) for i in range(n)]
    values = list(map(Outcome.run, jobs) if pool is None else pool.map(Outcome.run, jobs, chunksize=max(1, n // 20)))
    return Propagation(np.array(levels), np.array(values).reshape(len(levels), n, 4))


def noiseless(seed=0):
    """The level sigma_meas = 0 of simulation 2."""
    return Outcome(seed=seed, sigma=0.0, n_grid=30).run()


def simulation_5(kind, *, amplitude=1.0, n_stars=1000, n_exposures=10, seed=0):
    """Aliasing: a distortion along x that goes as x^4, which a fit of degree 3 does not have.

    Parameters
    ----------
    kind : {"monomial", "legendre", "common"}
        The plain x^4, its amplitude another sign in every other exposure; the normalised mode L_4(x) L_0(y), the same
        way; the same mode, alike in all exposures.
    amplitude : float
        Norm of the mode: the coefficient that it would have if normalised, pixels.

    Returns
    -------
    errors : ndarray, shape (n_exposures, 2, 10)
        Estimated minus true coefficients up to degree 3 (those of the mode itself not counted as true), pixels.
    b : float
        Error of the reference positions, pixels per axis.
    """
    sim = ld.simulate_matches(n_stars=n_stars, n_exposures=n_exposures, degree=3, seed=seed, noise=0)
    extra = np.zeros((n_exposures, 2, 15))
    signs = np.ones(n_exposures) if kind == "common" else (-1.0) ** np.arange(n_exposures)
    shape = x4_coefficients() if kind == "monomial" else np.eye(15)[10]
    extra[:, 0] = amplitude * signs[:, None] * shape
    low = basis.change_degree(sim.truth.dynamic, 4)
    truth = replace(sim.truth, static=basis.change_degree(sim.truth.static, 4), dynamic=low + extra)
    observed = np.ones((n_exposures, n_stars), dtype=bool)
    errors = np.full((n_exposures, n_stars, 2), 0.14)
    matches = matches_from(truth, observed, errors, np.random.default_rng(0), noise=0)
    solution = paper.solve(matches, prior=ld.Prior(sim.truth.static))
    found = np.stack([whole_coefficients(solution, name) for name in solution.names])
    return found - sim.truth.coefficients, accuracy.bias(solution.estimate.positions, truth.positions)


def x4_coefficients():
    """Coefficients (15,) of x^4, scaled to norm 1, in the normalised basis of degree 4."""
    c = basis.project(lambda u, v: np.stack([u**4, 0 * u]), 4, 8)[0]
    return c / np.linalg.norm(c)


def whole_coefficients(solution, name):
    """Coefficients (2, n_modes) of D_i(T_i(X)) - X: the pose, too, as a distortion, where it is nearly none."""
    shape, distortion = solution[name].shape, solution[name].distortion

    def displacement(u, v):
        xy = basis.denormalize(u, v, shape)
        return (distortion(similarity.apply(solution.poses[name], xy)) - xy).T

    return basis.project(displacement, solution.degree, solution.degree + 6)


def rms(values):
    """Root mean square of the finite values."""
    return float(np.sqrt(np.nanmean(np.square(values))))
