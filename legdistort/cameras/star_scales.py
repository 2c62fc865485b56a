"""Factors that bring the fluxes of exposures, and of the detectors of a camera, to one scale, by their common stars."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import lsmr

from ..inputs import column_contract

#: Common stars that two exposures must have.
FEW = 5
_HUBER = 1.345  # standard deviations up to which least squares hold
_ROUNDS, _SETTLED = 50, 1e-3  # of reweighting; standard deviations by which factors still change
_PRECISE, _ITERATIONS = 1e-6, 1000  # of the equations of a round
_LEAST = 1e-12  # of a scatter by which fluxes are divided
_MAD = 1.4826  # standard deviations of a normal distribution in its median absolute deviation
_OF_MEDIAN = 1.2533  # standard error of a median in that of a mean


@dataclass(frozen=True, eq=False)
class StarScales:
    """Factors by the fluxes of common stars; their logarithms and errors of these are arrays in the order of numbers.

    Attributes
    ----------
    exposures, errors : ndarray, shape (n_exposures,)
        Logarithms of factors; their mean is zero.
    detectors, detector_errors : ndarray, shape (n_detectors,)
        Of detectors, which are common to all exposures; one that no star joins to others has zero, and an infinite
        error.
    n_stars : int
        Stars with a flux, of which the brighter half were compared.
    """

    exposures: np.ndarray
    errors: np.ndarray
    detectors: np.ndarray
    detector_errors: np.ndarray
    n_stars: int


def star_scales(exposure, detector, star, flux, n_exposures, n_detectors=1):
    """Scales by the fluxes of common stars.

    Exposures are compared where a detector sees the same stars in both; detectors by the stars that fall on one in an
    exposure and on the other in the next. Detectors without such stars keep the scale that they have.

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
    StarScales or None
        None if stars do not join all exposures.
    """
    good = np.isfinite(flux) & (flux > 0)
    stars, number = np.unique(star[good], return_inverse=True)
    if len(stars) < FEW:
        return None
    exposure, detector, logs = exposure[good], detector[good], np.log(flux[good])
    found = _compared(exposure, detector * len(stars) + number, logs, n_exposures)
    if found is None:
        return None
    values, errors = found
    of_detectors = np.zeros((2, n_detectors))
    if n_detectors > 1:
        of_detectors = _compared(detector, number, logs + values[exposure], n_detectors, joined=False)
    return StarScales(values, errors, *of_detectors, n_stars=len(stars))


def flux_levels(exposure, star, flux, n_exposures, detector=None):
    """Factors (n_exposures,) that bring the fluxes of exposures to a common level, by their common stars.

    They are 1 where these do not join all exposures.
    """
    detector = np.zeros(len(exposure), dtype=int) if detector is None else detector
    found = star_scales(exposure, detector, star, flux, n_exposures, detector.max(initial=0) + 1)
    return np.ones(n_exposures) if found is None else np.exp(found.exposures)


@dataclass(frozen=True, eq=False)
class FluxFactors:
    """Factors by name: of exposures, and of the detectors of a camera.

    Attributes
    ----------
    exposures, detectors : dict
        Their product brings the fluxes of an exposure on a detector to those of one of mean depth (geometric mean).
    n_stars : int
        Stars with a flux, of which the brighter half were compared.
    """

    exposures: Mapping[str, float]
    detectors: Mapping[str, float]
    n_stars: int

    def of(self, exposure, detector=None):
        """Factor of an exposure, on one of its detectors."""
        return self.exposures[exposure] * self.detectors.get(detector, 1.0)

    def of_rows(self, table, camera):
        """Factors of the rows of a table of observations, (n,)."""
        ids = camera.ids(table) if self.detectors else np.full(len(table), "")
        names, exposure = np.unique(column_contract.labels(table, "exposure"), return_inverse=True)
        keys, detector = np.unique(ids, return_inverse=True)
        factors = np.array([[self.of(str(name), str(key)) for key in keys] for name in names])
        return factors[exposure, detector]


def flux_factors(solution):
    """The `FluxFactors` of a solution; None for one exposure, without fluxes, or if stars do not join all exposures."""
    table, names = solution.residuals, list(solution.names)
    if "flux" not in table.colnames or len(names) < 2:
        return None
    rows = table[table["used"]]
    ids, detector = [], np.zeros(len(rows), dtype=int)
    if solution.camera.has_focal_plane:
        ids, detector = np.unique(solution.camera.ids(rows), return_inverse=True)
    number = {name: i for i, name in enumerate(names)}
    exposure = np.array([number[name] for name in column_contract.labels(rows, "exposure").tolist()], dtype=int)
    flux = np.asarray(column_contract.values(rows, "flux"), dtype=float)
    if not len(rows):
        return None
    found = star_scales(exposure, detector, np.asarray(rows["star"]), flux, len(names), max(len(ids), 1))
    if found is None:
        return None
    factors = (np.exp(each).tolist() for each in (found.exposures, found.detectors[: len(ids)]))
    of_exposures, of_detectors = (
        dict(zip(map(str, keys), each, strict=True)) for keys, each in zip((names, ids), factors, strict=True)
    )
    return FluxFactors(of_exposures, of_detectors, found.n_stars)


def _compared(row, column, logs, n, joined=True):
    """Logarithms (n,) of factors that make the fluxes in each column agree, and their errors.

    The brighter half of all columns is compared, with the mean where one has several values in a row. None if rows do
    not have enough columns in common to join all of them; where they need not, those that nothing joins to others have
    zero, with an infinite error.
    """
    cell, at = np.unique(column * n + row, return_inverse=True)
    column, row = np.divmod(cell, n)
    values = np.bincount(at, logs) / np.bincount(at)
    column = np.unique(column, return_inverse=True)[1]
    middle = _medians(column, values)
    bright = middle[column] >= np.median(middle)
    row, column, values = row[bright], column[bright], values[bright]
    seen = csr_array((np.ones(len(row)), (row, column)), shape=(n, len(middle)))
    common = seen @ seen.T
    common.data[common.data < FEW] = 0
    common.eliminate_zeros()
    n_groups, group = connected_components(common, directed=False)
    if joined and n_groups > 1:
        return None
    column = group[row] * len(middle) + column  # of each group its own
    column = np.unique(column, return_inverse=True)[1]
    tells = np.bincount(column)[column] > 1
    level, errors = _two_way(row[tells], column[tells], values[tells], n)
    level -= (np.bincount(group, level) / np.bincount(group))[group]
    errors[np.bincount(group)[group] == 1] = np.inf if n > 1 else 0.0
    return -level, errors


def _two_way(row, column, values, n):
    """Levels (n,) of rows, beside those of columns, by least squares without outliers (Huber), and their errors."""
    level, errors = np.zeros((2, n))
    if not len(values):
        return level, errors
    column = np.unique(column, return_inverse=True)[1]
    each = np.tile(np.arange(len(values)), 2)
    design = csr_array((np.ones(len(each)), (each, np.concatenate([row, n + column]))))
    level, weight = np.concatenate([level, _medians(column, values)]), np.ones(len(values))
    for _ in range(_ROUNDS):
        root, rest = np.sqrt(weight), values - design @ level
        weighted = design.multiply(root[:, None]).tocsr()
        step = lsmr(weighted, root * rest, atol=_PRECISE, btol=_PRECISE, maxiter=_ITERATIONS)[0]
        level, rest = level + step, np.abs(rest - design @ step)
        scale = _MAD * np.median(rest)
        weight = 1 / np.maximum(rest / max(_HUBER * scale, _LEAST), 1)
        if np.abs(step[:n]).max() <= _SETTLED * scale:
            break
    count = np.bincount(row)
    present = np.flatnonzero(count)
    errors[present] = _MAD * _OF_MEDIAN * (_medians(row, rest)[present] / np.sqrt(count[present]))
    return level[:n], errors


def _medians(group, values):
    """Medians of values by group, (n_groups,); NaN for one without any."""
    order = np.lexsort((values, group))
    count = np.bincount(group)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    found = values[order]
    low, high = (np.clip(first + k, 0, len(found) - 1) for k in ((count - 1) // 2, count // 2))
    return np.where(count > 0, (found[low] + found[high]) / 2, np.nan)
