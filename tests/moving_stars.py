"""Fields of stars that move, and the dense oracle with their motions."""

import numpy as np
from astropy.table import Table
from oracle import DenseOracle, predict
from scipy.optimize import least_squares

from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.simulation.observations import simulate_matches

RNG = np.random.default_rng(1)
SCALE = 0.01 / 3600
SKY = TangentPlane(268.0, -30.0, np.array([[-SCALE, 0, 1000 * SCALE], [0, SCALE, -1000 * SCALE]]))
THREE = np.repeat([2015.3, 2016.5, 2019.2], 4)
FIVE = np.repeat([2015.30, 2015.75, 2016.5, 2017.2, 2019.4], 2)


def field(n_stars=300, epochs=THREE, **settings):
    """Three epochs of four exposures with rolls of 8 and 2 degrees, unless other epochs are asked for."""
    rolls = np.tile([8.0, 2.0], len(epochs) // 2)
    usual = {"sigma": 0.05, "dynamic": 0.3, "static": 1.0, "dither": 100, "zero_mean": False, "motion": 0.3, "sky": SKY}
    usual |= {"n_exposures": len(epochs), "n_stars": n_stars, "rotations": rolls, "epochs": epochs}
    return simulate_matches(**usual | settings)


class MovingOracle(DenseOracle):
    """The dense oracle with further unknowns of every star, ``X_j + sum_k c_jk phi_k(i)``; written here once more."""

    def __init__(self, matches, solution, phi):
        super().__init__(matches, solution, solution.estimate.prior_mean)
        self.phi, self.k = phi, phi.shape[2]
        self.n_modes = solution.coefficients.shape[2]
        self.n_star_unknowns = (2 + self.k) * self.n_stars

    def unpack(self, x):
        stars = x[: self.n_star_unknowns].reshape(self.n_stars, 2 + self.k)
        return stars, x[self.n_star_unknowns :].reshape(self.n_exposures, 2, self.n_modes)

    def residuals(self, x):
        stars, coefficients = self.unpack(x)
        r = np.empty_like(self.obs.xy)
        for i in range(self.n_exposures):
            on = self.obs.exposure == i
            mine = stars[self.obs.star[on]]
            place = mine[:, :2] + mine[:, 2:] @ self.phi[i].T
            r[on] = self.obs.xy[on] - predict(place, coefficients[i], self.poses[i], self.shapes[i])
        return np.einsum("nab,nb->na", self.whiten, r).ravel()

    def solve(self):
        stars = np.hstack([self._rough(), np.zeros((self.n_stars, self.k))])
        start = np.concatenate([stars.ravel(), np.zeros(self.n_exposures * 2 * self.n_modes)])
        return least_squares(self._with_gauge, start, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)

    def covariance_of_stars(self, x):
        """Blocks (n_stars, 2 + k, 2 + k) by the null-space method on a numerical Jacobian."""
        step = 1e-4
        units = step * np.eye(len(x))
        jacobian = np.array([(self.residuals(x + e) - self.residuals(x - e)) / (2 * step) for e in units]).T
        rows = np.hstack([np.zeros((len(self.rows), self.n_star_unknowns)), self.rows])
        free = np.linalg.svd(rows)[2][len(rows) :].T
        full = free @ np.linalg.inv(free.T @ jacobian.T @ jacobian @ free) @ free.T
        n = 2 + self.k
        return np.stack([full[j * n : (j + 1) * n, j * n : (j + 1) * n] for j in range(self.n_stars)])


def positions_at(solution, epoch):
    """Positions (n_stars, 2) of the stars at another time."""
    stars = solution.stars_at(epoch)
    return np.column_stack([stars["x"].to_value("pix"), stars["y"].to_value("pix")])


def without_a_map(values, xy, degree=3):
    """Values (n, k) of stars without a polynomial map, in plain powers."""
    x, y = ((xy - xy.mean(axis=0)) / np.ptp(xy, axis=0)).T
    powers = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
    return values - powers @ np.linalg.lstsq(powers, values, rcond=None)[0], powers.shape[1]


def without_a_similarity(values, xy):
    """Values (n, 2) of stars without a common shift, rotation and scale."""
    (x, y), one, zero = (xy - xy.mean(axis=0)).T, np.ones(len(xy)), np.zeros(len(xy))
    design = np.array([np.concatenate(each) for each in ((one, zero), (zero, one), (x, y), (-y, x))]).T
    flat = values.T.ravel()
    return (flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]).reshape(2, -1).T


#: Names of the Gaia catalogue, DR2 and DR3, and how its x, y, motions and parallax lie on `SKY`: 10 mas a pixel.
GAIA = ("ra", "dec", "pmra", "pmdec", "parallax")
CORRELATIONS = {
    (0, 1): "ra_dec_corr", (0, 2): "ra_pmra_corr", (0, 3): "ra_pmdec_corr", (0, 4): "ra_parallax_corr",
    (1, 2): "dec_pmra_corr", (1, 3): "dec_pmdec_corr", (1, 4): "dec_parallax_corr", (2, 3): "pmra_pmdec_corr",
    (2, 4): "parallax_pmra_corr", (3, 4): "parallax_pmdec_corr",
}  # fmt: skip
AXES = np.array([-10.0, 10.0, -10.0, 10.0, 10.0])


def gaia(sim, rng, *, n=30, errors=(0.2, 0.2, 0.1, 0.1, 0.2), ref_epoch=2016.0, parallax=True, rate=0.0):
    """The first stars of a set as Gaia has them, with correlated errors [mas, years]; and their pixels, years.

    Returns
    -------
    table : Table
    values, covariance : ndarray, shape (n, 5) and (n, 5, 5)
        x, y, vx, vy and parallax at ``ref_epoch``, pixels.
    """
    truth, k = sim.truth, 5 if parallax else 4
    true = np.zeros((n, 5))
    true[:, 2:4] = truth.motions[:n] + rate
    true[:, :2] = truth.positions[:n] + (ref_epoch - truth.epoch) * true[:, 2:4]
    true[:, 4] = 0 if truth.parallaxes is None else truth.parallaxes[:n]
    mixed = rng.normal(size=(n, 5, 12))
    full = mixed @ mixed.transpose(0, 2, 1)
    size = np.sqrt(np.einsum("jaa->ja", full))
    correlation = full / (size[:, :, None] * size[:, None, :])
    errors = np.array(errors) * rng.uniform(0.5, 2, (n, 1))
    covariance = correlation * errors[:, :, None] * errors[:, None, :]
    values = true * AXES + np.einsum("jab,jb->ja", np.linalg.cholesky(covariance), rng.normal(size=(n, 5)))
    sky = SKY.to_sky(values[:, :2] / AXES[:2])
    table = Table({"star": np.arange(n), "ra": sky.ra.deg, "dec": sky.dec.deg, "ref_epoch": np.full(n, ref_epoch)})
    for a in range(k):
        if a > 1:
            table[GAIA[a]] = values[:, a]
        table[f"{GAIA[a]}_error"] = errors[:, a]
    for (a, b), name in CORRELATIONS.items():
        if b < k:
            table[name] = correlation[:, a, b]
    return table, values / AXES, covariance / (AXES[:, None] * AXES)
