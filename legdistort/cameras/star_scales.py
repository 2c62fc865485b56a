"""Factors that bring the fluxes of exposures, and of the detectors of a camera, to one scale, by their common stars."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import lsmr

from ..exceptions import some_of
from ..inputs import column_contract

#: Common stars that two exposures must have.
FEW = 5
#: Why there are no factors.
NO_FLUXES = "the solution has no fluxes of stars"
_HUBER = 1.345  # standard deviations up to which least squares hold
_ROUNDS, _SETTLED = 50, 1e-3  # of reweighting; standard deviations by which factors still change
_PRECISE, _ITERATIONS = 1e-6, 1000  # of the equations of a round
_LEAST = 1e-12  # of a scatter by which fluxes are divided
_MAD = 1.4826  # standard deviations of a normal distribution in its median absolute deviation
_RANK = 1e-9  # of the largest eigenvalue: of counts of exposures and detectors, so rounding alone is below


@dataclass(frozen=True, eq=False)
class StarScales:
    """Factors by the fluxes of common stars; their logarithms and errors of these are arrays in the order of numbers.

    Attributes
    ----------
    exposures, errors : ndarray, shape (n_exposures,)
        Logarithms of factors; their mean is zero. All zero, with infinite errors, if stars do not join all exposures.
    detectors, detector_errors : ndarray, shape (n_detectors,)
        Of detectors, which are common to all exposures; one that no star joins to others has zero, and an infinite
        error.
    group : ndarray of int, shape (n_exposures,)
        The same number for exposures that stars join.
    n_stars : int
        Stars with a flux, of which the brighter half were compared.
    """

    exposures: np.ndarray
    errors: np.ndarray
    detectors: np.ndarray
    detector_errors: np.ndarray
    group: np.ndarray
    n_stars: int

    @property
    def joined(self):
        """Whether stars join all exposures."""
        return bool(np.all(self.group == self.group[0]))

    def apart(self, names):
        """Words for what stars do not join, by the names of the exposures; empty if they join all of them."""
        if self.joined:
            return ""
        groups = [some_of([names[i] for i in np.flatnonzero(self.group == k)], 3) for k in np.unique(self.group)]
        more = f"; and {len(groups) - 4} more" if len(groups) > 4 else ""
        return (
            f"no {FEW} common stars or more, of the brighter half of {self.n_stars} with a flux, join all exposures; "
            f"apart are {'; '.join(groups[:4])}{more}"
        )


def star_scales(exposure, detector, star, flux, n_exposures, n_detectors=1):
    """Scales by the fluxes of common stars, exposures and detectors in one fit.

    The logarithm of a flux is that of its star, and the zero points of its exposure and of its detector; these are
    common to all exposures. Exposures are joined where a detector sees the same stars in both, and through stars that
    fall on one detector in one and on another in the other: rolls of a camera by 90 degrees that lead each star to
    another detector determine both. Detectors that no stars join to others keep the scale that they have.

    Parameters
    ----------
    exposure, detector : ndarray of int, shape (n,)
        Numbers, of every observation.
    star : ndarray, shape (n,)
        Names or numbers.
    flux : ndarray, shape (n,)
        In any unit; what is not positive, or not finite, is left out.
    n_exposures, n_detectors : int

    Returns
    -------
    StarScales
    """
    good = np.isfinite(flux) & (flux > 0)
    stars, number = np.unique(star[good], return_inverse=True)
    exposure, detector, logs = exposure[good], detector[good], np.log(flux[good])
    if len(stars):
        middle = _medians(number, logs)
        bright = (middle >= np.median(middle))[number]
        exposure, detector, number, logs = (each[bright] for each in (exposure, detector, number, logs))
    joins = _joins(exposure, detector, number, n_exposures, n_detectors)
    fit = np.zeros((2, n_exposures + n_detectors))
    if np.any(joins.group != joins.group[0]):
        fit[1] = np.inf
    elif n_exposures + n_detectors > 2:
        fit = _zero_points(exposure, detector, joins.part * len(stars) + number, logs, joins)
    exposures, detectors = fit[:, :n_exposures], fit[:, n_exposures:]
    return StarScales(-exposures[0], exposures[1], -detectors[0], detectors[1], joins.group, len(stars))


def flux_levels(exposure, star, flux, n_exposures, detector=None):
    """Factors (n_exposures,) that bring the fluxes of exposures to a common level, by their common stars.

    They are 1 where these do not join all exposures.
    """
    detector = np.zeros(len(exposure), dtype=int) if detector is None else detector
    return np.exp(star_scales(exposure, detector, star, flux, n_exposures, detector.max(initial=0) + 1).exposures)


@dataclass(frozen=True, eq=False)
class FluxFactors:
    """Factors by name: of exposures, and of the detectors of a camera.

    Attributes
    ----------
    exposures, detectors : dict
        Their product brings the fluxes of an exposure on a detector to those of one of mean depth (geometric mean).
    n_stars : int
        Stars with a flux, of which the brighter half were compared.
    unknown : str
        Why there are no factors; empty where there are.
    """

    exposures: Mapping[str, float] = field(default_factory=dict)
    detectors: Mapping[str, float] = field(default_factory=dict)
    n_stars: int = 0
    unknown: str = ""

    def of(self, exposure, detector=None):
        """Factor of an exposure, on one of its detectors; 1 where it is not known."""
        return self.exposures.get(exposure, 1.0) * self.detectors.get(detector, 1.0)

    def of_rows(self, table, camera):
        """Factors of the rows of a table of observations, (n,)."""
        ids = camera.ids(table) if self.detectors else np.full(len(table), "")
        names, exposure = np.unique(column_contract.labels(table, "exposure"), return_inverse=True)
        keys, detector = np.unique(ids, return_inverse=True)
        factors = np.array([[self.of(str(name), str(key)) for key in keys] for name in names])
        return factors[exposure, detector]


def flux_factors(solution):
    """The `FluxFactors` of a solution; without fluxes, or if stars do not join all exposures, why there are none."""
    table, names = solution.residuals, list(solution.names)
    if len(names) < 2:
        return FluxFactors(unknown="nothing tells the depth of one exposure alone")
    rows = table[table["used"]]
    if "flux" not in table.colnames or not len(rows):
        return FluxFactors(unknown=NO_FLUXES)
    ids, detector = [], np.zeros(len(rows), dtype=int)
    if solution.camera.has_focal_plane:
        ids, detector = np.unique(solution.camera.ids(rows), return_inverse=True)
    number = {name: i for i, name in enumerate(names)}
    exposure = np.array([number[name] for name in column_contract.labels(rows, "exposure").tolist()], dtype=int)
    flux = np.asarray(column_contract.values(rows, "flux"), dtype=float)
    found = star_scales(exposure, detector, np.asarray(rows["star"]), flux, len(names), max(len(ids), 1))
    if not found.joined:
        return FluxFactors(unknown=found.apart(names))
    factors = (np.exp(each).tolist() for each in (found.exposures, found.detectors[: len(ids)]))
    of_exposures, of_detectors = (
        dict(zip(map(str, keys), each, strict=True)) for keys, each in zip((names, ids), factors, strict=True)
    )
    return FluxFactors(of_exposures, of_detectors, found.n_stars)


@dataclass(frozen=True, eq=False)
class _Joins:
    """What common stars join.

    Attributes
    ----------
    group : ndarray of int, shape (n_exposures,)
        The same number for exposures whose zero points are known relative to each other.
    detectors : ndarray of int, shape (n_detectors,)
        The same for detectors, where all exposures are joined.
    part : ndarray of int, shape (n,)
        By observation: exposures on a detector, all of whose zero points are known relative to each other.
    """

    group: np.ndarray
    detectors: np.ndarray
    part: np.ndarray


def _joins(exposure, detector, star, n_exposures, n_detectors):
    """The `_Joins` of observations, by their numbers (n,)."""
    n_stars = star.max(initial=-1) + 1
    n_close, close = _with_common(exposure, detector * n_stars + star, n_exposures)  # by the same detectors
    node, at = np.unique(close[exposure] * n_detectors + detector, return_inverse=True)
    n_parts, part = _with_common(at, star, len(node))
    group, on = np.divmod(node, n_detectors)
    links = csr_array((np.ones(len(node)), (on, n_detectors + part)), shape=(n_detectors + n_parts,) * 2)
    of_detectors = connected_components(links, directed=False)[1][:n_detectors]
    if n_close > 1:
        close = _determined(group, on, part, n_close, n_detectors)[close]
    return _Joins(close, of_detectors, part[at])


def _with_common(row, column, n):
    """How many groups there are of rows that at least `FEW` common columns join, and their numbers (n,)."""
    column = np.unique(column, return_inverse=True)[1]
    seen = csr_array((np.ones(len(row)), (row, column)), shape=(n, column.max(initial=-1) + 1))
    seen.sum_duplicates()
    seen.data[:] = 1
    common = seen @ seen.T
    common.data[common.data < FEW] = 0
    common.eliminate_zeros()
    return connected_components(common, directed=False)


def _determined(group, detector, part, n_groups, n_detectors):
    """Numbers (n_groups,), the same for groups of exposures whose zero points are determined relative to each other.

    Stars tell the sum of the zero points of a group and of a detector, apart from a constant by part. What can change
    and leaves all these sums as they are is not determined: the null space, after elimination of the groups.
    """
    several = np.bincount(part)[part] > 1
    group, detector, part = group[several], detector[several], np.unique(part[several], return_inverse=True)[1]
    n = len(group)
    if not n:
        return np.arange(n_groups)
    columns = np.concatenate([detector, n_detectors + part])
    sums = csr_array((np.ones(2 * n), (np.tile(np.arange(n), 2), columns)))
    mean = csr_array((1 / np.bincount(group)[group], (group, np.arange(n))), shape=(n_groups, n)) @ sums
    rest = sums - mean[group]
    values, vectors = np.linalg.eigh((rest.T @ rest).toarray())
    free = mean @ vectors[:, values < _RANK * max(values[-1], 1.0)]
    alone = np.flatnonzero(np.bincount(group, minlength=n_groups) == 0)
    along = free @ np.random.default_rng(0).normal(size=free.shape[1])  # differs wherever any of them does
    order = np.argsort(along)
    numbers = np.empty(n_groups, dtype=int)
    numbers[order] = np.cumsum(np.diff(along[order], prepend=along[order[0]]) > np.sqrt(_RANK))
    numbers[alone] = n_groups + alone
    return np.unique(numbers, return_inverse=True)[1]


def _zero_points(exposure, detector, star, logs, joins):
    """Zero points of exposures and detectors, and their errors; (2, n_exposures + n_detectors).

    By least squares without outliers (Huber), together with the logarithms of stars, which are those of a part. The
    mean of exposures is zero, and of the detectors that stars join; of one that none joins, with an infinite error.
    """
    n, n_detectors = len(joins.group), len(joins.detectors)
    cell, at = np.unique((star * n + exposure) * n_detectors + detector, return_inverse=True)
    values = np.bincount(at, logs) / np.bincount(at)
    star, row = np.divmod(cell, n * n_detectors)
    star = np.unique(star, return_inverse=True)[1]
    tells = np.bincount(star)[star] > 1
    values, row, star = values[tells], row[tells], np.unique(star[tells], return_inverse=True)[1]
    rows, n_zero = np.divmod(row, n_detectors), n + n_detectors
    columns = np.concatenate([rows[0], n + rows[1], n_zero + star])
    design = csr_array((np.ones(len(columns)), (np.tile(np.arange(len(star)), 3), columns)))
    level, rest, weight = _without_outliers(design, values, np.append(np.zeros(n_zero), _medians(star, values)), n_zero)
    level, groups = level[:n_zero], np.append(np.zeros(n, dtype=int), 1 + joins.detectors)
    level -= (np.bincount(groups, level) / np.bincount(groups))[groups]
    variance = _variances(design, weight, groups)
    dof = max(design.shape[0] - design.shape[1] + groups.max() + 1, 1)
    scatter = np.zeros(n_zero)
    for first, each in ((0, rows[0]), (n, rows[1])):
        present = np.flatnonzero(np.bincount(each))
        scatter[first + present] = _MAD * _medians(each, rest)[present]
    errors = scatter * np.sqrt(variance * len(star) / dof)
    lonely = np.bincount(groups)[groups] == 1
    lonely[:n] = False
    errors[lonely] = np.inf if n_detectors > 1 else 0.0
    return np.array([level, errors])


def _without_outliers(design, values, level, n):
    """Levels, absolute residuals and weights of a fit, from a start, until the first `n` levels settle (Huber)."""
    weight = np.ones(len(values))
    for _ in range(_ROUNDS):
        root, rest = np.sqrt(weight), values - design @ level
        weighted = design.multiply(root[:, None]).tocsr()
        step = lsmr(weighted, root * rest, atol=_PRECISE, btol=_PRECISE, maxiter=_ITERATIONS)[0]
        level, rest = level + step, np.abs(rest - design @ step)
        scale = _MAD * np.median(rest)
        weight = 1 / np.maximum(rest / max(_HUBER * scale, _LEAST), 1)
        if np.abs(step[:n]).max() <= _SETTLED * scale:
            break
    return level, rest, weight


def _variances(design, weight, groups):
    """Variances of the first unknowns, of unit errors, their mean in each group fixed; those after them eliminated."""
    n = len(groups)
    kept, others = design[:, :n], design[:, n:]
    across = others.T @ kept.multiply(weight[:, None])
    inner = others.multiply(weight[:, None]).sum(axis=0)
    normal = (kept.T @ kept.multiply(weight[:, None]) - across.T @ across.multiply(1 / inner[:, None])).toarray()
    means = (groups[:, None] == groups) / np.bincount(groups)[groups]
    typical = max(np.trace(normal) / n, _LEAST)
    return np.clip(np.diag(np.linalg.inv(normal + typical * means) - means / typical), 0, None)


def _medians(group, values):
    """Medians of values by group, (n_groups,); NaN for one without any."""
    order = np.lexsort((values, group))
    count = np.bincount(group)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    found = values[order]
    low, high = (np.clip(first + k, 0, len(found) - 1) for k in ((count - 1) // 2, count // 2))
    return np.where(count > 0, (found[low] + found[high]) / 2, np.nan)
