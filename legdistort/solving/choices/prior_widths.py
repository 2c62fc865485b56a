"""Widths of a prior found from the exposures themselves: empirical Bayes, or type-II maximum likelihood.

How far single exposures depart from the static distortion is mostly not known. It shows in the data: with stars and
poses integrated out, the data are Gaussian with a covariance that depends on the variance of the modes of each degree,
and the widths that make the data most likely are taken (MacKay 1992; in mixed models, restricted maximum likelihood).
Modes that the data do not determine, and maps common to all exposures, do not enter it, so it works where an exposure
has fewer stars than modes. Nor does a static distortion that is off by what is stated of its error.
"""

import logging
import warnings
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from ...cameras.stated_errors import FREE
from ...exceptions import ConvergenceWarning, warn
from ...geometry import basis, detector_modes
from ...priors.prior import Prior
from ..equations.problem import by_exposure
from ..gauge import most_probable
from ..knowledge.exposures import stated
from ..knowledge.reduced_data import drawn, part_of, reduced_data

log = logging.getLogger(__name__)

#: The widths have settled when none changes by more than this part of itself.
TOLERANCE = 0.01
#: Fits at most.
MAX_ROUNDS = 12
#: Widths are sought within these factors of the median position error; at the lower end a degree is as good as fixed.
RANGE = 1e-3, 1e6
#: So many coefficients, those of exposures drawn at random, are enough to determine the widths.
MOST = 800
#: A width is taken for nothing if that costs less than this in the logarithm of the likelihood: two standard errors.
PARSIMONY = 2.0


@dataclass(frozen=True, eq=False)
class Widths:
    """Widths of priors that left them to be found.

    Attributes
    ----------
    priors : tuple of Prior
        Each once: exposures and detectors that were given the same object share its widths.
    values : ndarray, shape (n_priors, degree)
        Of a coefficient of degree 1, 2 and more, pixels.
    have_settled : bool
    """

    priors: tuple
    values: np.ndarray
    have_settled: bool = True

    def number(self, prior):
        """Which of the priors this one is; -1 if it is none of them."""
        return next((k for k, each in enumerate(self.priors) if each is prior), -1)

    def resolve(self, prior):
        """The prior, or dict of priors, with these widths in the place of "evidence"."""
        if isinstance(prior, dict):
            return {key: self.resolve(each) for key, each in prior.items()}
        if (k := self.number(prior)) < 0:
            return prior
        found = self.values[k]
        if not len(found):  # at degree 0 there is nothing that scatters
            return prior.with_sigma(None)
        return prior.with_sigma(found[np.maximum(np.add(*basis.orders(len(found))), 1) - 1], degree=len(found))

    def describe(self, prior, scale=1.0):
        """By degree from 1 a tuple; by detector or exposure if the prior came so; None for one with its own widths.

        They are in units of errors that were stated `scale` times too small.
        """
        if isinstance(prior, dict):
            return {str(key): self.describe(prior[key], scale) for key in sorted(prior, key=str)}
        k = self.number(prior)
        return None if k < 0 else tuple((scale * self.values[k]).tolist())


def sought(prior):
    """Those of a prior, or of a dict of them, whose widths are to be found, each object once."""
    priors = list(prior.values()) if isinstance(prior, dict) else [prior]
    first = [p for k, p in enumerate(priors) if not any(p is earlier for earlier in priors[:k])]
    return tuple(p for p in first if isinstance(p, Prior) and isinstance(p.sigma, str))


def find_widths(fit, prior, degree, unit, *, scale=False):
    """The fit in which the widths are those that the data determine.

    Fits and widths follow one another until the widths settle: outliers, weights and the point where the model is
    linearised depend on the fit. The first has small widths, so that outliers stand out.

    Parameters
    ----------
    fit : callable
        ``fit(prior)``, returning an object with ``matches``, ``weighted`` and ``result.state``.
    prior : Prior or dict
    degree : int
        Up to which exposures have modes of their own.
    unit : float
        Typical error of a position, pixels.
    scale : bool
        The stated errors are known up to a common factor only.

    Returns
    -------
    fit
    Widths
        0 where one was held at the smallest.
    """
    wanted, bounds = sought(prior), unit * np.array(RANGE)
    widths, have_settled = Widths(wanted, np.full((len(wanted), degree), unit)), True

    def fitted():
        with warnings.catch_warnings(record=True, action="always") as caught:  # those of the last fit are shown
            return fit(widths.resolve(prior)), caught

    for _ in range(MAX_ROUNDS if degree else 0):
        done, caught = fitted()
        labels = _labels(widths, by_exposure(done.matches, prior))
        sample = _sample(done.weighted, done.result.state, labels, done.result.gauge.all_motion)
        seen = evidence(*sample, free_mean=not done.matches.camera.has_focal_plane)
        before, found = widths.values, seen.best(widths.values.size, bounds, scale=scale).reshape(-1, degree)
        log.debug("widths by degree: %s px", found)
        if np.all(np.abs(found - before) <= TOLERANCE * np.maximum(found, unit)):
            break
        widths = Widths(wanted, found)
    else:
        done, caught = fitted()
        if degree:
            have_settled = False
            warn(
                f"the widths of the prior have not settled after {MAX_ROUNDS} fits, the last are "
                f"{np.array2string(widths.values, precision=2)} px: do not rely on the result; leave them out (no "
                "--prior-sigma; --forget prior-sigma where a run is repeated), or give them, sigma=0.05 (--prior-sigma "
                "0.05)",
                ConvergenceWarning,
            )
    for warning in caught:
        warn(warning.message, warning.category)
    return done, Widths(wanted, np.where(widths.values > 1.01 * bounds[0], widths.values, 0), have_settled)


def _labels(widths, priors):
    """Number of the width of every exposure and degree (n_exposures, degree), -1 where none is sought."""
    degree = widths.values.shape[1]
    prior = np.array([widths.number(p) for p in priors])
    return np.where(prior[:, None] >= 0, prior[:, None] * degree + np.arange(degree), -1)


def _sample(problem, state, labels, motion):
    """The same with a random choice of the exposures, should they be more than are needed."""
    keep = drawn(labels[:, 0], MOST // problem.unknowns.n_own)
    return *part_of(problem, state, keep), labels[keep], motion[keep]


@dataclass(frozen=True, eq=False)
class Evidence:
    """The data as the widths see them: stars, poses and all that has widths of its own eliminated.

    The coefficients are departures of exposures from their static distortion, then what that departs by from the mean
    of its prior, in its stated errors: these have the width 1.

    Up to a constant, twice the logarithm of the likelihood of widths ``w`` is
    ``p' W (1 + W S W)^-1 W p - log det(1 + W S W)``, with ``W = diag(w)``.

    Attributes
    ----------
    curvature : ndarray, shape (n, n)
        S of the dynamic coefficients.
    pull : ndarray, shape (n,)
        p, the gradient at the prior mean.
    label : ndarray of int, shape (n,)
        Number of the width of every coefficient; that after the last one for those of static distortions.
    chi2 : float
        J at the prior mean.
    n_data : int
        Measured coordinates beyond those needed for what was eliminated.
    """

    curvature: np.ndarray
    pull: np.ndarray
    label: np.ndarray
    chi2: float
    n_data: int

    def cost(self, log_widths, *, scale=False):
        """Minus the logarithm of the likelihood, and its gradient; with `scale`, at the best scale of all errors.

        The gradient vanishes where the square of a width is the sum of the squares of its coefficients over the number
        of them that the data determine: the fixed point of MacKay (1992).
        """
        n, w = len(log_widths), np.exp(np.append(log_widths, 0.0))[self.label]
        root, lower = cho_factor(np.eye(len(w)) + w[:, None] * self.curvature * w, lower=True)
        inverse = cho_solve((root, lower), np.eye(len(w)))
        mean = inverse @ (w * self.pull)  # of the coefficients given the data, in their widths
        explained = w * self.pull @ mean
        gain, per_square = -explained / 2, 1.0
        if scale:
            left = max(self.chi2 - explained, 1e-12 * self.chi2)
            gain, per_square = self.n_data / 2 * np.log(left), self.n_data / left
        slope = (1 - np.diag(inverse)) - per_square * mean**2
        return gain + np.log(np.diag(root)).sum(), np.bincount(self.label, slope, n)[:n]

    def best(self, n, bounds, *, scale=False):
        """The n widths of the highest likelihood between two bounds; at the lower one where another gains little.

        Parameters
        ----------
        n : int
        bounds : (float, float)
        scale : bool
            As for `cost`.

        Returns
        -------
        ndarray, shape (n,)
        """
        low, high = np.log(bounds)
        own = self.label < n
        square = np.bincount(self.label[own], (self.pull[own] / np.diag(self.curvature)[own]) ** 2, n)
        count = np.bincount(self.label[own], minlength=n)
        unit = square / count  # variances of that order: where 0 is left if it has to be
        dropped = np.zeros(n, dtype=bool)

        def cost(variance):
            value, slope = self.cost(np.log(variance * unit) / 2, scale=scale)
            return value, slope / (2 * variance)

        def highest(start):
            limits = np.exp(2 * np.array([low * np.ones(n), np.where(dropped, low, high)])) / unit
            start = np.clip(start, *limits)
            return minimize(cost, start, jac=True, bounds=list(zip(*limits, strict=True)), method="L-BFGS-B")

        found = highest(np.ones(n))
        while not dropped.all():
            without = [np.where(np.arange(n) == k, 0, found.x) for k in np.flatnonzero(~dropped)]
            loss = np.array([cost(np.maximum(v, np.exp(2 * low) / unit))[0] for v in without]) - found.fun
            if loss.min() > PARSIMONY:
                break
            dropped[np.flatnonzero(~dropped)[loss.argmin()]] = True
            found = highest(without[loss.argmin()])
        return np.sqrt(found.x * unit)


def evidence(problem, state, labels, motion, *, free_mean=True):
    """The data of a fit as the widths see them.

    Parameters
    ----------
    problem : Problem
        With the weights that were in force.
    state : State
        Where J and its derivatives are taken.
    labels : ndarray of int, shape (n_exposures, degree)
        Number of the width of every exposure and degree from 1; -1 where none is sought.
    motion : ndarray, shape (n_exposures, 2 n, 2 n)
        How maps of the reference plane change the coefficients (`legdistort.results.gauge.Gauge`); they are the
        null space of the data, along which the linear model follows the noise.
    free_mean : bool
        Whether the mean of a prior that is not exact follows what exposures show.
    """
    wanted = labels[:, 0] >= 0
    sigma = np.where(wanted[:, None, None], np.inf, problem.prior_sigma)
    problem = replace(problem, prior_sigma=None if np.isinf(sigma).all() else sigma)
    n = problem.n_modes
    degree, departure = detector_modes.dynamic_degrees(n), state.coefficients - problem.prior_mean
    sought = degree <= labels.shape[1]
    rows, label, origin = [], [], []
    for i in np.flatnonzero(wanted):
        mine = detector_modes.dynamic_basis(problem.shapes[i], n)[sought]
        place = np.zeros((problem.n_exposures, 2 * n, len(mine)))
        place[i] = mine.T
        rows.append(problem.unknowns.gather(place).T)
        label.append(labels[i, degree[sought] - 1])
        origin.append(mine @ departure[i, :, :n].ravel())
    data = reduced_data(problem, state, np.concatenate(rows), motion).at(-np.concatenate(origin))
    free_mean = free_mean and not problem.errors_of_statics.knows_nothing and most_probable.is_possible(problem)
    statics = np.concatenate(_statics(problem, wanted, free_mean)[:, sought])
    both = np.hstack([np.eye(len(data.pull)), statics])
    label.append(np.full(statics.shape[1], labels.max() + 1))
    return Evidence(both.T @ data.curvature @ both, both.T @ data.pull, np.concatenate(label), data.chi2, data.n_data)


def _statics(problem, wanted, free_mean):
    """Static distortions of the exposures (k,) that are wanted, in units of their stated errors, (k, K, n).

    None where a fit holds exposures to the mean of the prior, or there is none: widths that have in them the error of
    that mean, or the size of the distortion, are what lets exposures be where they are then.
    """
    _, spread, group, _ = stated(problem)
    out = [np.zeros((np.count_nonzero(wanted), spread.variance.shape[1], 0))]
    for g in np.unique(group[wanted]) if free_mean else ():
        free = spread.variance[g] > 0
        columns = spread.directions[g][:, free] * np.sqrt(np.minimum(spread.variance[g][free], FREE**2))
        out.append((group[wanted] == g)[:, None, None] * columns)
    return np.concatenate(out, axis=2)
