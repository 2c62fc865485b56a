"""Residuals over the errors that they should have, the part that the fit itself takes up counted."""

from dataclasses import dataclass

import numpy as np
from astropy import units as u

from ..geometry import basis
from ..inputs import column_contract

_UNITS = ("minutes", 1440, 1 / 12), ("hours", 24, 2), ("days", 1, np.inf)  # in a day, and up to how many days
_LEAST = 0.02  # degrees of freedom of an observation, as in the checks


@dataclass(frozen=True, eq=False)
class Sums:
    """Pulls of groups of observations.

    Attributes
    ----------
    rms : ndarray, shape (n,)
        Root of chi2 over its degrees of freedom: about 1 where the stated errors are right.
    freedom : ndarray, shape (n,)
        Degrees of freedom, both axes; 0 for a group without observations.
    at : ndarray, shape (n,)
        Mean brightness of a star, or time of an exposure.
    label : str
        What that is, with its unit.
    """

    rms: np.ndarray
    freedom: np.ndarray
    at: np.ndarray
    label: str


@dataclass(frozen=True, eq=False)
class Pulls:
    """Squared residuals of the used observations in units of their errors, and how much of them the fit leaves.

    Attributes
    ----------
    squares, freedom : ndarray, shape (n,)
        Of both axes together: chi2 and its degrees of freedom, the sum of which is that of the solution.
    star, exposure : ndarray of int, shape (n,)
        Indices into the names of the solution.
    brightness, brightness_label : ndarray, shape (n_stars,), and str
    time, time_label : ndarray, shape (n_exposures,), and str
    """

    squares: np.ndarray
    freedom: np.ndarray
    star: np.ndarray
    exposure: np.ndarray
    brightness: np.ndarray
    brightness_label: str
    time: np.ndarray
    time_label: str

    def by_star(self):
        """`Sums` of every star."""
        return self._sums(self.star, self.brightness, self.brightness_label)

    def by_exposure(self):
        """`Sums` of every exposure."""
        return self._sums(self.exposure, self.time, self.time_label)

    def _sums(self, group, at, label):
        chi2, freedom = (np.bincount(group, each, len(at)) for each in (self.squares, self.freedom))
        rms = np.sqrt(np.divide(chi2, freedom, out=np.full(len(at), np.nan), where=freedom > 0))
        return Sums(rms, freedom, at, label)


def pulls_of(solution):
    """The `Pulls` of a solution.

    What is left to an observation is ``2 (1 - h_star) (1 - h_exposure)``, with the leverages of the position of its
    star and of the polynomials of its exposure, each alone; the second is scaled so that all together are the degrees
    of freedom of the solution, as in its checks.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`

    Returns
    -------
    Pulls
    """
    table = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    exposure = _exposures(solution, table)
    star = np.searchsorted(solution.estimate.star_names, table["star"])
    offset = np.stack([column_contract.values(table, c, "pix") for c in ("dx", "dy")], axis=1)
    covariance = solution.diagnostics.errors_of(table)
    squares = np.einsum("na,nab,nb->n", offset, np.linalg.inv(covariance), offset)
    variance = np.einsum("nkk->n", covariance) / 2
    freedom = _freedom(solution, table, exposure, star, 1 / variance)
    brightness, label = _brightness(solution, table, star, np.sqrt(variance))
    return Pulls(squares, freedom, star, exposure, brightness, label, *_times(solution, table, exposure))


def _freedom(solution, table, exposure, star, weight):
    """Degrees of freedom (n,) that are left to every observation."""
    whole = np.bincount(star, weight)
    if (tie := solution.gauge.tie) is not None and tie.known is not None:  # what a reference knows of its stars
        rows = np.searchsorted(solution.estimate.star_names, tie.stars[tie.used])
        whole[rows[rows < len(whole)]] += 2 / np.einsum("jaa->j", tie.known[tie.used])[rows < len(whole)]
    of_star = weight / whole[star]
    of_exposure = np.zeros(len(weight))
    x, y = (column_contract.values(table, axis, "pix") for axis in "xy")
    for i, name in enumerate(solution.names):
        mine = np.flatnonzero(exposure == i)
        values = basis.values(solution.degree, *basis.normalize(np.column_stack([x[mine], y[mine]]),
                                                                solution.estimate.shapes[name]))  # fmt: skip
        root = values * np.sqrt(weight[mine])
        vectors = np.linalg.svd(root, full_matrices=False)[2] if len(mine) else root
        of_exposure[mine] = np.sum(vectors**2, axis=0)
    free, share = 2 * (1 - of_star), 2 * of_exposure * (1 - of_star)
    wanted = free.sum() - solution.dof
    return np.maximum(free - share * (wanted / share.sum() if share.sum() > 0 else 0), _LEAST)


def _brightness(solution, table, star, error):
    n = np.maximum(np.bincount(star, minlength=len(solution.estimate.star_names)), 1)
    if "flux" in table.colnames:
        flux = np.bincount(star, np.nan_to_num(column_contract.values(table, "flux")), len(n)) / n
        if np.any(flux > 0):
            return np.where(flux > 0, flux, np.nan), f"flux [{table['flux'].unit or 'unit of the input'}]"
    seen = np.bincount(star, error, len(n)) / n
    return np.where(seen > 0, seen, np.nan), "reported error per axis [px]"


def _times(solution, table, exposure):
    """Minutes, hours or days since the first exposure, by the column ``epoch``; else the number of the exposure."""
    if "epoch" in table.colnames:
        years = np.full(len(solution.names), np.nan)
        years[exposure] = column_contract.values(table, "epoch", u.yr)
        days = (years - np.nanmin(years)) * u.yr.to(u.day)
        if np.isfinite(days).all() and len(np.unique(days)) > len(days) / 2:
            return next((days * n, f"{unit} since the first exposure") for unit, n, most in _UNITS if days.max() < most)
    return np.arange(len(solution.names), dtype=float), "number of the exposure"


def exposure_rms(solution):
    """Rms of the used residuals in x and y, pixels, and their number, by exposure; NaN where none was used."""
    table = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    exposure = _exposures(solution, table)
    n = np.bincount(exposure, minlength=len(solution.names))
    squares = (np.bincount(exposure, column_contract.values(table, d, "pix") ** 2, len(n)) for d in ("dx", "dy"))
    with np.errstate(invalid="ignore"):  # 0 / 0
        dx, dy = (np.sqrt(total / n) for total in squares)
    return dx, dy, n


def _exposures(solution, table):
    """Index of the exposure of every row."""
    names = np.asarray(solution.names)
    order = np.argsort(names)
    return order[np.searchsorted(names[order], column_contract.labels(table, "exposure"))]
