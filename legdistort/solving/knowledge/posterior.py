"""The posterior of data and factors that are linear in the unknowns, and the sizes that make the data most likely."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from ...exceptions import SolveError
from ..equations.elimination import mirrored
from .factors import GIVEN, Factor
from .reduced_data import ReducedData

#: Newton steps at most, halvings of each, and the largest change of the logarithm of a size in one.
_ROUNDS, _HALVINGS, _LARGEST = 50, 8, 2.0
_FLAT = 0.02  # slope of the cost by the logarithm of a size that counts as none: twice a likelihood ratio of 1 is noise


@dataclass(frozen=True, eq=False)
class Posterior:
    """Data and a factor (several are `Factor.joined`) at some sizes.

    ``J = data(z) + |(value + rows z) / width|^2``; its minimum and the inverse of half its curvature are mean and
    covariance of z.

    Attributes
    ----------
    data : ReducedData
        Its unknowns come first among those of the factor.
    factor : Factor
    sizes : ndarray, shape (n_sizes,)
    """

    data: ReducedData
    factor: Factor
    sizes: np.ndarray

    @cached_property
    def widths(self):
        """Width of every row of the factor."""
        return self.factor.widths(self.sizes)

    @cached_property
    def precision(self):
        """Of the factor, (n, n)."""
        weighted = self.factor.rows.multiply(1 / self.widths[:, None] ** 2).tocsr()
        return (self.factor.rows.T @ weighted).toarray()

    @cached_property
    def slope(self):
        """Minus half the slope of J at z = 0, (n,)."""
        return self._padded(self.data.pull) - self.factor.rows.T @ (self.factor.value / self.widths**2)

    def _padded(self, values):
        return np.pad(values, (0, self.factor.rows.shape[1] - len(values)))

    @cached_property
    def information(self):
        """Half the curvature of J, (n, n)."""
        out, k = self.precision.copy(), len(self.data.pull)
        out[:k, :k] += self.data.curvature
        return out

    @cached_property
    def _root(self):
        """Cholesky factor of the information at unit diagonal, and the unit."""
        diagonal = np.diag(self.information)
        unit = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
        try:
            return cho_factor(unit[:, None] * self.information * unit, lower=True), unit
        except (LinAlgError, ValueError):
            raise SolveError(f"{self.factor.name}: data and what is known do not determine all unknowns") from None

    @cached_property
    def mean(self):
        """Of z, (n,)."""
        root, unit = self._root
        return unit * cho_solve(root, unit * self.slope)

    def damped(self, damping):
        """A step (n,) with the diagonal of the information larger by a part (Marquardt 1963)."""
        _, unit = self._root
        root = cho_factor(unit[:, None] * self.information * unit + damping * np.eye(len(unit)), lower=True)
        return unit * cho_solve(root, unit * self.slope)

    @cached_property
    def covariance(self):
        """Of z, (n, n)."""
        (root, _), unit = self._root
        inverse, _ = dpotri(root, lower=1)
        return unit[:, None] * mirrored(inverse) * unit

    @cached_property
    def of_rows(self):
        """Covariance of the rows of the factor, (k, k)."""
        rows = self.factor.rows
        return rows @ (rows @ self.covariance).T

    @cached_property
    def left(self):
        """Values of the rows of the factor at the mean, and their variances: (k,) each."""
        return self.factor.value + self.factor.rows @ self.mean, np.diag(self.of_rows)

    @cached_property
    def cost(self):
        """Minus twice the logarithm of the likelihood, up to a constant."""
        (root, _), unit = self._root
        least = self.data.chi2 + ((self.factor.value / self.widths) ** 2).sum() - self.slope @ self.mean
        return least + 2 * np.log(np.diag(root) / unit).sum() + 2 * np.log(self.widths).sum()

    @property
    def cost_slopes(self):
        """First and second derivatives of the cost by the logarithms of the sizes: (n_sizes,) and (n_sizes, n_sizes).

        The first vanishes where the square of a size is the sum of squares of its rows over the number of them that the
        data determine (MacKay 1992); in mixed models this is restricted maximum likelihood.
        """
        n, found = len(self.sizes), self.factor.size != GIVEN
        (value, variance), width = self.left, self.widths
        share = (value**2 + variance) / width**2
        label = self.factor.size[found]
        by_size = (label == np.arange(n)[:, None]).astype(float)
        scaled, within = value[found] / width[found] ** 2, self.of_rows[np.ix_(found, found)]
        first = 2 * by_size @ (1 - share[found])
        pairs = 2 * scaled[:, None] * within * scaled + (within / width[found] / width[found, None]) ** 2
        return first, np.diag(4 * by_size @ share[found]) - 4 * by_size @ pairs @ by_size.T

    @property
    def determined(self):
        """How many values the data determine of those that have each size, (n_sizes,): its degrees of freedom."""
        found = self.factor.size != GIVEN
        share = 1 - self.left[1] / self.widths**2
        return np.bincount(self.factor.size[found], share[found], len(self.sizes))

    def without(self, factor):
        """Information (m, m) and slope (m,) of the last m unknowns if nothing but they are in a factor, and not in J.

        That is what everything else says of them: their posterior without what that factor states. It may be singular.

        Parameters
        ----------
        factor : Factor
            One of those that were joined, with rows on the last unknowns alone.
        """
        m = len(np.unique(factor.rows.indices))
        first = self.factor.rows.shape[1] - m
        weight = factor.rows.multiply(1 / factor.widths(self.sizes)[:, None] ** 2)
        own, pulled = (factor.rows.T @ weight).toarray()[first:, first:], weight.T @ factor.value
        inner, across = self.information[:first, :first], self.information[:first, first:]
        solved = np.linalg.solve(inner, np.column_stack([across, self.slope[:first]]))
        information = self.information[first:, first:] - own - across.T @ solved[:, :-1]
        slope = self.slope[first:] + pulled[first:] - across.T @ solved[:, -1]
        return (information + information.T) / 2, slope


def most_likely(data, factor, start, bounds):
    """The posterior at the sizes of the largest likelihood, by Newton's method.

    Parameters
    ----------
    data : ReducedData
    factor : Factor
    start : array-like, shape (n_sizes,) or (k, n_sizes)
        Several where the likelihood may have several maxima: the best of those they lead to counts.
    bounds : (float, float)
        Within which all sizes are sought.

    Returns
    -------
    Posterior
    """
    parts = _of_sizes(data, factor)
    found = [_climbed(Posterior(*parts, np.clip(each, *bounds)), bounds) for each in np.atleast_2d(start)]
    return Posterior(data, factor, min(found, key=lambda each: each.cost).sizes)


def _of_sizes(data, factor):
    """Data and factor on those unknowns alone that rows of a size to be found are on, all others eliminated.

    The cost is smaller by the same at all sizes.
    """
    found = factor.size != GIVEN
    of_sizes = np.zeros(factor.rows.shape[1], dtype=bool)
    of_sizes[factor.rows[found].indices] = True
    if of_sizes.all() or not found.any():
        return data, factor
    given = factor.part(~found)
    whole = Posterior(data, given, np.zeros(0))
    kept, others = np.flatnonzero(of_sizes), np.flatnonzero(~of_sizes)
    diagonal = np.diag(whole.information)[others]
    unit = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
    try:
        root = cho_factor(unit[:, None] * whole.information[np.ix_(others, others)] * unit, lower=True)
    except (LinAlgError, ValueError):
        return data, factor  # which says what is not determined
    across = unit[:, None] * whole.information[np.ix_(others, kept)]
    solved = cho_solve(root, np.column_stack([across, unit * whole.slope[others]]))
    left = ReducedData(
        curvature=whole.information[np.ix_(kept, kept)] - across.T @ solved[:, :-1],
        pull=whole.slope[kept] - across.T @ solved[:, -1],
        chi2=float(
            data.chi2 + ((given.value / whole.widths) ** 2).sum() - (unit * whole.slope[others]) @ solved[:, -1]
        ),
        n_data=data.n_data,
    )
    part = factor.part(found)
    return left, replace(part, rows=part.rows[:, kept])


def _climbed(here, bounds):
    """The posterior at the sizes of the next maximum of the likelihood."""
    low, high = np.log(bounds)
    data, factor = here.data, here.factor
    for _ in range(_ROUNDS):
        first, second = here.cost_slopes
        logs = np.log(here.sizes)
        free = ~((logs <= low) & (first > 0) | (logs >= high) & (first < 0))
        if not np.any(np.abs(first[free]) > _FLAT):
            break
        curvature, vectors = np.linalg.eigh(second[np.ix_(free, free)])
        step = np.zeros(len(first))
        # where the likelihood is not concave yet, at least as far as one fixed-point step
        step[free] = -vectors @ (vectors.T @ first[free] / np.maximum(np.abs(curvature), _FLAT))
        step *= min(1.0, _LARGEST / np.abs(step).max())
        for _ in range(_HALVINGS):
            there = Posterior(data, factor, np.exp(np.clip(logs + step, low, high)))
            if there.cost <= here.cost + 1e-9 * abs(here.cost):
                break
            step /= 4
        else:
            break
        here = there
    return here
