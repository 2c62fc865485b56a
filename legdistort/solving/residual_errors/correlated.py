"""Errors that stay alike from one exposure to the next: found from the residuals, and counted in the errors of stars.

Errors by trails of charge, by the place of a star on its pixel or by refraction according to its colour are about the
same in an exposure as in the one before, or in another one in which the star fell on the same place. They do not
average down with the number of exposures, and no error floor describes them. Here every star has a random error of its
own in each axis (random effects), of one variance for all stars, whose correlation falls along the time or along an
axis of the detector: exponentially, or as that of a process that has one or two derivatives
(`CorrelatedErrors.derivatives`). Beside it stand independent errors, the stated ones with a floor. The variances, the
length and the form of the correlation are those of the largest restricted likelihood (REML; Patterson & Thompson 1971):
that of the residuals, in which nothing is left of what is the same in all exposures. That part is in the positions, and
no data determine it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, special
from scipy.optimize import minimize, minimize_scalar

from ...results.diagnostics import FOLDING, MATERN, CorrelatedErrors
from .. import single_fit
from ..equations.leverage import leverages

#: Blocks of two exposures that are needed, and stars.
BLOCKS, STARS = 4, 50
#: The correlation length is at most this part of what the exposures span.
LONGEST = 0.5
#: Gain in twice the logarithm of the likelihood from which correlated errors are found: in none of 200 sets
#: that have none (`tests/benchmarks/correlated_errors_table.py`).
FOUND = 12.0
#: Stars that are looked at, the most precise ones: more would determine the variances to better than 2 %.
MOST_STARS = 2000
_ALONG = "time", "x", "y"
_STARTS = 0.05, 0.3  # of the longest correlation length


def estimate_with_correlations(matches, options):
    """The fit with an error floor, and with the errors that are alike between exposures in the errors of its stars.

    Parameters
    ----------
    matches : Matches
    options : SolveOptions
        With ``errors="correlated"``.

    Returns
    -------
    Fit
        Its floor holds all errors of a single exposure, so that weights are right.
    CorrelatedErrors
    """
    options = replace(options, errors="stated")
    fit = single_fit.estimate_with_floor(matches, single_fit.estimate(matches, options), options)
    found = measure(fit)
    if found.along is None:
        return fit, found
    floor = float(np.sqrt(found.floor**2 + (found.x**2 + found.y**2) / 2))
    fit = single_fit.estimate(matches, replace(options, error_floor=floor))
    return replace(fit, shared_errors=_of_stars(fit, found)), found


def measure(fit):
    """`CorrelatedErrors` in the residuals of a fit.

    Parameters
    ----------
    fit : Fit

    Returns
    -------
    CorrelatedErrors
    """
    n_stars = np.count_nonzero(np.bincount(fit.problem.star, fit.used) > 1)
    n = fit.problem.n_exposures
    if n < 2 * BLOCKS or n_stars < STARS:
        reason = f"{n} exposures, {n_stars} stars seen twice; it takes {2 * BLOCKS} and {STARS}"
        return CorrelatedErrors(float(fit.options.error_floor), reason=reason)
    rows = _Rows.of(fit)
    every = [rows.along(name) for name in _ALONG]
    alone = minimize_scalar(lambda p: every[0].deviance(p, 0.0, 0.0, 1.0), bounds=rows.bounds[0])
    best, along, found = alone.fun - FOUND, None, None
    for series in every:
        if not series.longest > series.shortest > 0:
            continue
        for part in _STARTS:
            tried = _largest(series, rows.bounds, [*[alone.x - 0.5] * 3, np.log(part * series.longest)])
            if tried.fun < best:
                best, along, found = tried.fun, series, tried
    if along is None:
        return CorrelatedErrors(float(np.exp(alone.x)))
    for smoother in (replace(along, derivatives=n) for n in range(1, len(MATERN))):
        tried = _largest(smoother, rows.bounds, found.x)
        if tried.fun < best:
            best, along, found = tried.fun, smoother, tried
    floor, x, y, length = map(float, np.exp(found.x))
    unit = rows.unit if along.name == "time" else "px"
    return CorrelatedErrors(floor, x, y, along.name, length, along.longest, unit, derivatives=along.derivatives)


def _largest(series, bounds, start):
    """The largest likelihood of a series, from logarithms of floor, x, y and correlation length on."""
    bounds = [*bounds, tuple(np.log([series.shortest, series.longest]))]
    return minimize(
        lambda p: series.deviance(p[0], np.exp(p[1]), np.exp(p[2]), np.exp(p[3])),
        np.clip(start, *np.transpose(bounds)),
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 40, "ftol": 1e-7},
    )


@dataclass(frozen=True, eq=False)
class _Rows:
    """Observations of the stars that are looked at.

    Attributes
    ----------
    star, exposure : ndarray of int, shape (n,)
    residual, variance : ndarray, shape (2, n)
        In the reference plane, pixels; the variances as stated.
    place : dict
        ``{"time" | "x" | "y": (n,)}``.
    free : ndarray, shape (n_stars,)
        Part of the variance of a star's residuals that the exposures leave.
    unit : str
        Of the time.
    """

    star: np.ndarray
    exposure: np.ndarray
    residual: np.ndarray
    variance: np.ndarray
    place: dict
    free: np.ndarray
    unit: str

    @classmethod
    def of(cls, fit):
        """Those of a `Fit`."""
        problem, obs = fit.problem, fit.matches.observations
        taken = leverages(fit.weighted, fit.blocks)[1]
        number = np.bincount(problem.star, fit.used, problem.n_stars)
        with np.errstate(invalid="ignore", divide="ignore"):
            free = 1 - np.bincount(problem.star, taken * fit.used, problem.n_stars) / number
            precision = np.where(number > 1, fit.blocks.v[0] + fit.blocks.v[1], 0)
        chosen = np.zeros(problem.n_stars, dtype=bool)
        chosen[np.argsort(-precision, kind="stable")[:MOST_STARS]] = True
        rows = np.flatnonzero(fit.used & (chosen & (number > 1))[problem.star])
        to_plane = np.linalg.inv(fit.result.state.poses[:, :, :2])[problem.exposure[rows]]
        stated = obs.covariance[problem.order][rows]
        covariance = stated[:, [[0, 2], [2, 1]]]
        moved = np.einsum("nab,nbc,ndc->nad", to_plane, covariance, to_plane)
        times, unit = fit.matches.times
        return cls(
            star=np.unique(problem.star[rows], return_inverse=True)[1],
            exposure=problem.exposure[rows],
            residual=np.einsum("nab,bn->an", to_plane, fit.blocks.residual[:, rows]),
            variance=np.stack([moved[:, 0, 0], moved[:, 1, 1]]),
            place={"time": times[problem.exposure[rows]], "x": problem.xy[0, rows], "y": problem.xy[1, rows]},
            free=np.clip(free[np.unique(problem.star[rows])], 0.1, 1),
            unit=unit,
        )

    @property
    def bounds(self):
        """Of the logarithms of three standard deviations: from nearly nothing to all of the residuals."""
        high = np.log(4 * np.sqrt(np.mean(self.residual**2)))
        return [(high - 8, high)] * 3

    def along(self, name):
        """The `_Series` of every star along the time or an axis of the detector."""
        place, n_stars = self.place[name], self.star.max() + 1
        order, first, rank = _ranks(self.star, place, n_stars)
        where = rank, self.star[order]
        shape = rank.max() + 1, n_stars

        def padded(values, filling):
            out = np.full(shape, filling)
            out[where] = values[order]
            return out

        steps = np.diff(padded(place, np.nan), axis=0)
        span = np.nanmax(padded(place, np.nan), axis=0) - place[order][first]
        steps = steps[np.isfinite(steps) & (steps > 0)]
        return _Series(
            name,
            place=np.nan_to_num(np.diff(padded(place, np.nan), axis=0, prepend=np.nan), nan=np.inf),
            there=padded(np.ones(len(order)), 0.0),
            residual=np.stack([padded(each, 0.0) for each in self.residual], axis=1),
            variance=np.stack([padded(each, 1.0) for each in self.variance], axis=1),
            free=self.free,
            shortest=float(np.median(steps)) if len(steps) else 0.0,
            longest=LONGEST * float(np.median(span)),
        )


def _ranks(star, place, n_stars):
    """Observations by star, and by place within a star: their order, the first of every star, ranks within a star."""
    order = np.lexsort([place, star])
    first = np.searchsorted(star[order], np.arange(n_stars))
    return order, first, np.arange(len(order)) - first[star[order]]


@dataclass(frozen=True, eq=False)
class _Series:
    """Residuals of every star in the order of time or place, rank by star, padded.

    Attributes
    ----------
    name : str
    place : ndarray, shape (n_ranks, n_stars)
        Distance from the one before.
    there : ndarray, shape (n_ranks, n_stars)
        1, or 0 for what is padded.
    residual, variance : ndarray, shape (n_ranks, 2, n_stars)
    free : ndarray, shape (n_stars,)
    shortest, longest : float
        Correlation lengths.
    derivatives : int
        As in `CorrelatedErrors`.
    """

    name: str
    place: np.ndarray
    there: np.ndarray
    residual: np.ndarray
    variance: np.ndarray
    free: np.ndarray
    shortest: float
    longest: float
    derivatives: int = 0

    def deviance(self, log_floor, x, y, length):
        """Minus twice the logarithm of the restricted likelihood, up to a constant.

        The innovations of a Kalman filter (Jones 1981, for series with gaps) stand for the inverse of the covariance of
        a star; its mean is free. What the exposures take up counts as so many fewer stars.
        """
        there, spread = self.there[:, None], np.array([[x], [y]]) ** 2
        noise = self.variance + np.exp(2 * log_floor)
        new, variance = np.stack([np.ones_like(noise), self.residual], axis=1), np.empty_like(noise)
        nilpotent, usual = _states(self.derivatives)
        usual = usual[:, :, None, None]
        mean, known = np.zeros((len(usual), *new[0].shape)), usual * np.broadcast_to(spread, noise[0].shape)
        steps = _steps(nilpotent, FOLDING[self.derivatives] * self.place / length)
        for k, (step, here) in enumerate(zip(steps, there, strict=True)):
            mean = np.einsum("abn,bykn->aykn", step, mean)
            known = usual * spread + _both_sides(step, known - usual * spread)
            new[k] -= mean[0]
            variance[k] = known[0, 0] + noise[k]
            gain = here * known[0] / variance[k]
            mean = mean + gain[:, None] * new[k]
            known = known - gain[:, None] * known[0]
        weight, (one, r) = there / variance, new.swapaxes(0, 1)
        logs, ones = np.sum(there * np.log(variance), axis=0), np.sum(weight * one**2, axis=0)
        cross, own = np.sum(weight * one * r, axis=0), np.sum(weight * r**2, axis=0)
        return float(np.sum(self.free * (logs + np.log(ones)) + own - cross**2 / ones))


def _states(derivatives):
    """A process and its derivatives: matrix N and covariance P, (n, n) each, for distances in units of the scale.

    The process obeys ``(1 + d/du)^n f = white noise``, whose states decay as ``exp(-u) exp(N u)`` with ``N^n = 0``.
    """
    n = derivatives + 1
    change = np.eye(n, k=1)
    change[-1] -= special.binom(n, np.arange(n))
    usual = linalg.solve_continuous_lyapunov(change, -np.outer(np.eye(n)[-1], np.eye(n)[-1]))
    return change + np.eye(n), usual / usual[0, 0]


def _steps(nilpotent, u):
    """How states decay over distances (n_ranks, n_stars): shape (n_ranks, n, n, n_stars)."""
    n = len(nilpotent)
    powers = [np.linalg.matrix_power(nilpotent, k)[:, :, None] / special.factorial(k) for k in range(n)]
    decay, u = np.exp(-u)[:, None, None], np.where(np.isfinite(u), u, 0)[:, None, None]
    return decay * sum(power * u**k for k, power in enumerate(powers))


def _both_sides(step, matrix):
    """``F M F'`` for F (n, n, n_stars) and M (n, n, 2, n_stars)."""
    half = np.einsum("abn,bcxn->acxn", step, matrix)
    return np.einsum("acxn,dcn->adxn", half, step)


def _of_stars(fit, found):
    """Covariance xx, yy, xy (3, n_stars), px^2, by which correlated errors add to the errors of stars in a fit."""
    problem = fit.problem
    weight = fit.weighted.weight[0] + fit.weighted.weight[1]
    sums = np.bincount(problem.star, weight, problem.n_stars)
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.nan_to_num(weight / sums[problem.star])
    values = fit.matches.times[0][problem.exposure] if found.along == "time" else problem.xy["xy".index(found.along)]
    order, _, rank = _ranks(problem.star, values, problem.n_stars)
    star, part, values = problem.star[order], part[order], values[order]
    behind = np.zeros((len(MATERN), problem.n_stars))  # sums of the parts before times u^m exp(-u)
    double, square, last = np.zeros((3, problem.n_stars))
    for k in range(rank.max() + 1):
        mine = np.flatnonzero(rank == k)
        j = star[mine]
        u = (values[mine] - last[j]) / found.scale
        behind[:, j] = [
            np.exp(-u) * sum(special.binom(m, i) * u ** (m - i) * behind[i, j] for i in range(m + 1))
            for m in range(len(behind))
        ]
        double[j] += 2 * part[mine] * sum(c * b for c, b in zip(MATERN[found.derivatives], behind[:, j], strict=False))
        square[j] += part[mine] ** 2
        behind[0, j] += part[mine]
        last[j] = values[mine]
    both = double + square
    mean = (found.x**2 + found.y**2) / 2
    return np.stack([found.x**2 * both - mean * square, found.y**2 * both - mean * square, np.zeros(len(both))])
