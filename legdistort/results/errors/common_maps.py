"""What is left of the errors of stars and distortions once common maps are taken off: the relative errors.

Of errors e of all stars ``(1 - B P) e`` is left, with B the plain maps of the degree of the gauge at the stars and P
their fit, in which every star has the weight of its observations, ``W_j = sum_i J' W_ij J``. So a star or an exposure
that is worth little hardly moves the map that is taken off from the others. Few stars would have no errors left beside
so free a map: then it is of the highest degree that has a mode for every `PER_MODE` stars, but for maps that nothing
determines, which are always taken off.
"""

from dataclasses import dataclass, field

import numpy as np

from ...geometry import basis
from ...runtime.trees.facts import array

#: Stars for each mode of the map that is taken off, at least.
PER_MODE = 3


@dataclass(frozen=True, eq=False)
class CommonFit:
    """The common maps ``P e`` that are fitted to the errors of the stars.

    c maps: those of positions, of n modes each along x and y, and those that change with time, as
    `legdistort.results.gauge.Drift` has them.

    Attributes
    ----------
    weights : ndarray, shape (n_stars, 2 + k, 2 + k)
        W_j, all else of a star eliminated; zero for what its observations do not determine.
    stars : ndarray, shape (n_stars, 2 + k, c)
        Covariance of the unknowns of the stars, in the gauge, with these maps.
    coefficients : ndarray, shape (n_exposures, 2 n_modes, c)
        Covariance of the fitted coefficients with them.
    covariance : ndarray, shape (c, c)
        Theirs.
    """

    weights: np.ndarray = field(metadata=array("n_stars", "2 + n_terms", "2 + n_terms"))
    stars: np.ndarray = field(metadata=array("n_stars", "2 + n_terms", "n_common", nan=True))
    coefficients: np.ndarray = field(metadata=array("n_exposures", "2 n_modes", "n_common"))
    covariance: np.ndarray = field(metadata=array("n_common", "n_common", covariance=True))

    def without_maps(self, gauge, xy, blocks):
        """Covariances (n_stars, 2 + k, 2 + k) of the stars, given those in the gauge, once the maps are taken off."""
        maps = plain_maps(gauge, xy, self.n_modes(gauge))
        shared = self.stars @ maps.mT
        return blocks - shared - shared.mT + maps @ self.covariance @ maps.mT

    def left(self, gauge, xy, directions):
        """Displacements (n_stars, 2 + k, m) of the stars without the maps of the degree of the gauge that fit them."""
        maps = plain_maps(gauge, xy, gauge.n_modes)
        return directions - maps @ fitted(maps, self.weights, directions)

    def of_coefficients(self, gauge, block, i):
        """Covariance of the coefficients of exposure i, given that in the gauge, once stars have the maps taken off.

        The plane is bent back by the maps then, which the exposures follow by `Gauge.all_motion`.
        """
        moved = gauge.all_motion[i].reshape(2, gauge.n_own, -1, gauge.n_modes)[..., : self.n_modes(gauge)]
        moved = basis.change_degree(moved.transpose(0, 2, 3, 1), basis.degree_of(len(block) // 2))
        moved = moved.transpose(0, 3, 1, 2).reshape(len(block), -1)
        shared = self.coefficients[i] @ moved.T
        return block + shared + shared.T + moved @ self.covariance @ moved.T

    def n_modes(self, gauge):
        """Modes per axis of the maps that are taken off."""
        return len(self.covariance) // (gauge.all_motion.shape[2] // gauge.n_modes)


def modes_for(modes, positions, unknown=0):
    """How many modes of a plane, unknown up to a degree, the map has that is taken off stars at positions (n, 2).

    Of several fields, that of the fewest stars decides.
    """
    fewest = np.bincount(modes.fields_of(positions), minlength=modes.n_fields).min()
    degrees = [d for d in range(modes.degrees.max() + 1) if PER_MODE * basis.n_modes(d) <= fewest]
    return basis.n_modes(max(*degrees, 0, unknown)) * modes.n_fields


def plain_maps(gauge, xy, n):
    """Common maps B (n_stars, 2 + k, c) at positions (n_stars, 2): n modes of the reference plane themselves."""
    values, drift = gauge.modes_at(np.nan_to_num(xy), n).T, gauge.drift
    terms, rows = (0, 2) if drift is None else (drift.motion.shape[2] // gauge.n_modes, 2 + len(drift.names))
    out = np.zeros((len(xy), rows, 2 + terms, n))
    index = np.r_[0, 1, np.arange(rows - terms, rows)]
    out[:, index, np.arange(2 + terms)] = values[:, None]
    return out.reshape(len(xy), rows, (2 + terms) * n)


def without_positions(gauge, estimate, values):
    """What is left of values (n_stars, 2, ...) at the stars once a map of the plane is fitted with their weights."""
    common = estimate.uncertainty.common
    if common is None:
        return values
    n = common.n_modes(gauge)
    maps = plain_maps(gauge, estimate.positions, n)[:, :2, : 2 * n]
    return values - maps @ fitted(maps, common.weights[:, :2, :2], values)


def fitted(maps, weights, values):
    """P (c, ...) of values (n_stars, 2 + k, ...): the maps that fit them with the weights of the stars."""
    return of_normal(maps, weights) @ np.einsum("jam,ja...->m...", weights @ maps, values)


def of_normal(maps, weights):
    """Inverse (c, c) of the normal matrix of a fit of maps (n_stars, 2 + k, c)."""
    normal = np.einsum("jam,jan->mn", weights @ maps, maps)
    return np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
