"""The random field of a single exposure, whose stars a catalogue knows.

No star is seen twice: offsets ``y = x - D(X)`` at places of the catalogue are field and noise, ``N = W^-1 + J V J'``
with what the catalogue states. There may be thousands. Their likelihood is that of each given the nearest of those
before it in an order by chance (Vecchia 1988, J. R. Stat. Soc. B 50, 297), and the field is told by the nearest stars.
Errors of measurements and of the catalogue are stated ones; along each axis a factor on them is found with the field,
since nothing else tells them from it.
"""

import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from ...geometry.tabulated.covariance_table import CovarianceTable
from ...geometry.tabulated.displacement_table import MARGIN, DisplacementTable
from ...results.errors.absolute_errors import variances
from ...runtime.parallel import n_cores
from ..equations.star_terms import unpacked
from .displaced import Tabled, displaced, taken_off
from .observed import undistorted
from .random_field import DRAWN_OUT, Found, Kernel
from .turbulence import SHOWN, slopes_of

#: Stars of which the likelihood is made to choose a smoothness, and then for the rest; those that each is given.
_FEW, _MANY, _GIVEN = 400, 1200, 12
#: Stars that tell the field at a place; places at a time.
_TOLD, _AT_ONCE = 30, 1000
_SMOOTHNESS = 5 / 6, 3 / 2
#: Fewest stars of a catalogue that tell a field; fits at most, and the change of the field, in errors, that ends them.
_LEAST, _ROUNDS, _SMALL = 30, 4, 0.1
#: Cells of the table by length and by distance of stars, along an axis at most; into how many each is divided.
_CELLS, _CELLS_A_STAR, _MOST_CELLS, _FINER = 4, 1.2, 128, 2
#: Sizes by the scatter of the offsets, lengths by the extent of the stars, factors on variances.
_SIZES, _LENGTHS, _FACTORS = (1e-2, 10.0), (1e-3, 1.0), (0.05, 20.0)
_STEP = 1e-4  # of their logarithms, by which slopes are taken


@dataclass(frozen=True, eq=False)
class FieldOfOne:
    """Offsets of stars, and the most likely field in them.

    Attributes
    ----------
    places, offsets : ndarray, shape (n, 2)
        Undistorted pixels, and what is measured there minus model without the field, pixels.
    noise : ndarray, shape (n, 2, 2)
        Covariance of the offsets without the field, with the factors.
    found : Found
    factors : tuple
        On the standard errors along x and y.
    """

    places: np.ndarray
    offsets: np.ndarray
    noise: np.ndarray
    found: Found
    factors: tuple

    @property
    def gain(self):
        """By which twice the logarithm of the likelihood is larger with the field."""
        return self.found.gain

    @property
    def kernel(self):
        """Of the field."""
        return self.found.kernel

    def seen(self, offsets, noise):
        """The same field, with other offsets and covariances of their noise as stated."""
        return replace(self, offsets=offsets, noise=_times(noise, self.factors))

    def tables(self, shape):
        """`DisplacementTable` and `CovarianceTable` of the field over a detector."""
        apart = np.sqrt(shape[0] * shape[1] / len(self.places))
        least = (1 + 2 * MARGIN) * max(shape) / _MOST_CELLS
        step = max(min(self.kernel.length / _CELLS, apart / _CELLS_A_STAR), least)
        table = DisplacementTable.of(lambda q: self.at(q, _fours(q))[0], shape, step).refined(_FINER)
        return table, CovarianceTable.of(lambda q: self.at(q)[1], shape)

    def at(self, places, groups=None):
        """The field (n, 2) at places (n, 2), pixels, and its covariance (n, 2, 2).

        Groups (n_groups, m) of places are told by the same stars, by default each has its own.
        """
        groups = np.arange(len(places))[:, None] if groups is None else groups
        kernel, told = self.found.kernel, min(_TOLD + 2 * (groups.shape[1] - 1), len(self.places))
        metric = kernel.metric
        stars, where = self.places @ metric.T, np.asarray(places, dtype=float) @ metric.T
        near = cKDTree(stars).query(where[groups].mean(axis=1), k=told)[1].reshape(len(groups), told)
        field, covariance = np.empty((len(where), 2)), np.empty((len(where), 2, 2))
        alone = kernel.blocks(np.zeros(1), np.zeros(1))[0]

        def fill(first):
            rows, seen = (each[first : first + _AT_ONCE] for each in (groups, near))
            inner, cross = _covariances(kernel, stars[seen], where[rows], self.noise[seen])
            weights = np.linalg.solve(inner, cross.reshape(*inner.shape[:2], -1)).reshape(cross.shape)
            field[rows] = np.einsum("nkma,nk->nma", weights, self.offsets[seen].reshape(len(cross), -1))
            covariance[rows] = alone - np.einsum("nkma,nkmb->nmab", weights, cross)

        with ThreadPoolExecutor(n_cores()) as threads:
            list(threads.map(fill, range(0, len(groups), _AT_ONCE)))
        return field, covariance


def _covariances(kernel, stars, places, noise):
    """Covariance (n, 2 k, 2 k) of offsets of stars (n, k, 2), and with the field at places (n, m, 2), (n, 2 k, m, 2).

    All in lengths.
    """
    n, k = stars.shape[:2]
    first, second = np.triu_indices(k)
    between = kernel.blocks(*np.moveaxis(stars[:, first] - stars[:, second], 2, 0))
    between[:, first == second] += noise
    pair, inner = np.empty((k, k), dtype=int), np.empty((n, k, 2, k, 2))
    pair[first, second] = pair[second, first] = np.arange(len(first))  # covariances of two stars are symmetric
    for a, b in np.ndindex(2, 2):
        inner[:, :, a, :, b] = np.take(between[..., a, b], pair, axis=1)
    cross = kernel.blocks(*np.moveaxis(stars[:, :, None] - places[:, None], 3, 0))
    return inner.reshape(n, 2 * k, 2 * k), cross.swapaxes(2, 3).reshape(n, 2 * k, -1, 2)


def _fours(nodes):
    """Nodes (n, 2) of a table, row by row, in groups (n_groups, 4) of neighbours."""
    n_x = int(np.argmax(np.diff(nodes[:, 1]) > 0)) + 1
    number = np.arange(len(nodes)).reshape(-1, n_x)
    number = np.pad(number, [(0, n % 2) for n in number.shape], mode="edge")
    return number.reshape(len(number) // 2, 2, -1, 2).swapaxes(1, 2).reshape(-1, 4)


def field_in(places, offsets, noise):
    """The `FieldOfOne` of offsets (n, 2) at places (n, 2) with covariances (n, 2, 2) of their noise."""
    n, scatter = len(places), np.std(offsets)
    order = np.random.default_rng(0).permutation(n)
    given = _before(places[order], min(_GIVEN, n - 1))
    extent = np.ptp(places, axis=0).max()

    def deviance(kernel, factors, targets):
        scaled = _times(noise, np.sqrt(factors))
        at, near = order[targets], order[given[targets]]
        metric = kernel.metric
        stars, where = places[near] @ metric.T, places[at] @ metric.T
        inner, cross = _covariances(kernel, stars, where[:, None], scaled[near])
        cross = cross[:, :, 0]
        both = np.linalg.solve(inner, np.concatenate([cross, offsets[near].reshape(len(near), -1, 1)], axis=2))
        left = offsets[at] - np.einsum("nka,nk->na", cross, both[..., 2])
        rest = kernel.blocks(np.zeros(1), np.zeros(1))[0] + scaled[at] - cross.mT @ both[..., :2]
        return float(np.sum(np.linalg.slogdet(rest)[1]) + np.einsum("na,nab,nb->", left, np.linalg.inv(rest), left))

    def nothing(targets):
        """Without a field: factors alone."""
        at = order[targets]
        squares = offsets[at] ** 2 / noise[at][:, [0, 1], [0, 1]]
        scaled = _times(noise[at], np.sqrt(squares.mean(axis=0)))
        left = np.einsum("na,nab,nb->", offsets[at], np.linalg.inv(scaled), offsets[at])
        return float(np.sum(np.linalg.slogdet(scaled)[1]) + left)

    def sought(nu, x0, targets):
        def read(x):
            return Kernel(*np.exp(x[:2]), nu, tuple(x[4:]) if len(x) > 4 else (0.0, 0.0)), np.exp(x[2:4])

        def with_slope(x):
            values = np.array(
                list(threads.map(lambda y: deviance(*read(y), targets), [x, *(x + _STEP * np.eye(len(x)))]))
            )
            return values[0], (values[1:] - values[0]) / _STEP

        ranges = scatter * np.array(_SIZES), extent * np.array(_LENGTHS), np.array(_FACTORS), np.array(_FACTORS)
        bounds = [np.log(each) for each in ranges] + [(-4, 4)] * (len(x0) - 4)
        made = minimize(with_slope, x0, jac=True, method="L-BFGS-B", bounds=bounds,
                        options={"ftol": 1e-6, "maxiter": 20})  # fmt: skip
        return made.fun, made.x, *read(made.x)

    first = min(_GIVEN, n - 1)
    few, many = (np.linspace(first, n - 1, min(count, n - first)).astype(int) for count in (_FEW, _MANY))
    x0 = np.array([np.log(scatter / 1.5), np.log(extent / 10), -0.7, -0.7])
    with ThreadPoolExecutor(n_cores()) as threads:
        nu, best = min(((nu, sought(nu, x0, few)) for nu in _SMOOTHNESS), key=lambda each: each[1][0])
        plain = sought(nu, best[1], many)
        drawn = sought(nu, np.append(plain[1], [0.1, 0.1]), many)
    cost, _, kernel, factors = drawn if plain[0] - drawn[0] > DRAWN_OUT else plain
    factors = tuple(np.sqrt(factors).tolist())
    return FieldOfOne(places, offsets, _times(noise, factors), Found(kernel, nothing(many) - cost), factors)


def _times(noise, factors):
    """Covariances (n, 2, 2) of errors times factors along x and y."""
    return noise * np.multiply.outer(factors, factors)


def _before(places, k):
    """Of every place the nearest k of those before it, (n, k) of int; of the first ones the first others."""
    n = len(places)
    near = np.tile(np.arange(k), (n, 1))
    low = max(k, 2)
    while low < n:
        high = min(n, low + max(low // 2, 16))
        near[low:high] = cKDTree(places[:low]).query(places[low:high], k=k)[1].reshape(high - low, k)
        low = high
    return near


def fit_with_field_of_one(estimate, tie, matches, options, *how):
    """What `estimate` gives of one exposure, with its field found by a catalogue; see `fit_with`.

    Returns
    -------
    Fit
    FieldOfOne or None
        None for too few stars of the catalogue.
    rest : tuple
    """
    one = None
    for _ in range(_ROUNDS):
        fit, *rest = estimate(matches, options, *how)
        with warnings.catch_warnings(action="ignore"):  # of offsets that are larger than errors
            tied, held = tie(fit), taken_off(fit)
        slopes = slopes_of(tied.weighted, tied.blocks)
        rows, places, offsets, noise = offsets_from(tied, slopes)
        if len(rows) < _LEAST:
            return fit, None, rest
        offsets = offsets + held[:, rows].T
        one = field_in(places, offsets, noise) if one is None else replace(one, places=places).seen(offsets, noise)
        if one.gain < SHOWN:
            return fit, one, rest
        problem = fit.problem
        field, covariance = one.at(undistorted(problem, tied.result.state))
        change = (field.T - held)[:, rows]
        if np.sqrt(np.mean(change**2 / noise[:, [0, 1], [0, 1]].T)) < _SMALL:
            break
        matches = displaced(fit, field.T)
    back = np.linalg.inv(slopes)
    shared = np.zeros((3, problem.n_stars))
    shared[:, problem.star] = variances(back @ covariance @ back.mT)
    table, errors = one.tables(problem.shapes[0])
    name = problem.names[0]
    tabled = Tabled(np.zeros_like(problem.xy), own={name: table}, errors={name: errors})
    freedom = float(np.einsum("nab,nba->", covariance[rows], np.linalg.inv(one.noise)))
    unknowns = fit.shared_unknowns + freedom
    return replace(fit, shared_errors=shared, shared_unknowns=unknowns, tabled=tabled), one, rest


def offsets_from(fit, slopes):
    """What stars of a fit tied to a catalogue are off it: rows (n,), places, offsets and noise, as `field_in` has them.

    Parameters
    ----------
    fit : legdistort.solving.single_fit.Fit
        Whose stars have what the catalogue states beforehand.
    slopes : ndarray, shape (n, 2, 2)
        Derivatives of what is measured by the place of its star.
    """
    problem, blocks = fit.weighted, fit.blocks
    known = unpacked(problem.terms.catalogue.precision)[problem.star]
    w = problem.weight
    rows = np.flatnonzero((w[0] * w[1] - w[2] ** 2 > 0) & (np.linalg.det(known) > 0))
    weight, slopes = unpacked(w[:, rows]), slopes[rows]
    believed = slopes @ np.linalg.inv(known[rows]) @ slopes.mT  # with a factor for offsets that are larger
    stated = believed / fit.result.gauge.tie.factor**2
    residual = blocks.residual[:, rows].T
    offsets = residual + np.einsum("nab,nbc,nc->na", believed, weight, residual)
    return rows, undistorted(problem, fit.result.state)[rows], offsets, np.linalg.inv(weight) + stated
