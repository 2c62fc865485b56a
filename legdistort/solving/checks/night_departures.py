"""How far a night departs from what the others have in common, by how far these scatter: each is left out in turn.

The exposures of night n scatter about ``m_n = S + B_n``: S is the static distortion of the detector, ``B_n ~ N(0,
Lambda)`` the departure of the night. Lambda, by degree, is that which makes the other nights most likely
(`most_likely`). S is free, so that a night that is odd moves nothing of what it is compared with; the rest is compared
without it. What the data say of m_n holds whatever widths the fit had: these are taken out, and stars are eliminated.
Data say nothing of a common map of a field (with motions one that grows with time beside), so that nights which only
such a map parts are alike.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import sparse, special

from ...cameras.stated_errors import FREE, as_errors, resized
from ...geometry import basis
from ...geometry.detector_modes import dynamic_basis, dynamic_degrees
from ...results.check import FALSE_ALARM
from ...results.nights import NightsFound, NightStatic, NightTest
from ..knowledge.exposures import RANGE, ExposureModel
from ..knowledge.factors import GIVEN, Factor
from ..knowledge.posterior import Posterior, most_likely
from ..knowledge.reduced_data import ReducedData, drawn, part_of
from .odd_ones import beyond_chance, compared, with_others

#: Times the scatter of the others and the errors, from which a departure is odd.
ODD = 3.0
#: Others from which a night can be told odd.
FEWEST = 2
#: Nights and exposures that are compared with one another, drawn at random where there are more: so many at most.
_MOST, _MOST_EXPOSURES = 24, 60
#: Nights that are compared with one another however many exposures they have: exposures are drawn then.
_LEAST = 6
#: Up to so many nights the scatter of the others is found anew for each; among more a single one does not count.
_EACH = 12
_COEFFICIENTS = 500  # from which the static distortion of nights is found
_FREE = 100.0  # size of what is free [pix]
_WIDER = 0.99  # probability below which exposures of one night scatter no more than those of others
_ALIKE = 0.01  # part of the largest expected square of a degree, below which the data say nothing of a mode
#: Scatter is sought within these factors of the typical error of a mean; less is none, and smaller numbers lose digits.
_RANGE = 0.1, 1e6
_SMALLEST = 1e-5  # pixels: as good as exact
_KNOWN = 0.3 * np.sqrt(8)  # error of a combination beyond which a direction is not determined [pix]


def found_nights(solution, problem, state, blocks):
    """What nights show, a `NightsFound`.

    Parameters
    ----------
    solution : Solution
    problem : Problem
        With the weights that were in force.
    state : State
    blocks : Blocks
    """
    night = np.broadcast_to(problem.night, problem.n_exposures)
    number = np.unique(night)
    if solution.gauge.plane is not None or problem.degree < 1 or len(number) < 2:
        return NightsFound(tuple(NightTest() for _ in number))
    found = {n: [] for n in number}
    if problem.unknowns.shared:
        for detector in np.unique(problem.detectors):
            each = np.flatnonzero(problem.detectors == detector)
            for n, test in _of_residuals(solution, problem, blocks, each, night, FALSE_ALARM / len(number)).items():
                found[n].append(test)
        return NightsFound(tuple(map(_together, found.values())))
    rng = np.random.default_rng(0)
    for detector in np.unique(problem.detectors):
        each = np.flatnonzero(problem.detectors == detector)
        owners = rng.permutation(np.unique(night[each]))
        most = np.clip(_MOST_EXPOSURES * len(owners) // len(each), _LEAST, _MOST)
        for part in np.array_split(owners, -(-len(owners) // most)):
            some = each[np.isin(night[each], part)]
            some = some[drawn(night[some], _MOST_EXPOSURES)]
            owner = np.unique(night[some], return_inverse=True)[1]
            means = _Means.of(*part_of(problem, state, some), solution.gauge.all_motion[some], owner)
            for n, test in zip(np.sort(part), means.tests(FALSE_ALARM / len(number)), strict=True):
                found[n].append(test)
    tests = {n: _together(each) for n, each in found.items()}
    sound = np.isin(night, [n for n, test in tests.items() if not test.odd])
    parts = [np.flatnonzero((problem.detectors == detector) & sound) for detector in np.unique(problem.detectors)]

    @cache
    def statics():
        each = [_static(solution, problem, state, part) for part in parts]
        return tuple(static for static in each if static is not None)

    return NightsFound(tuple(tests.values()), statics)


def _of_residuals(solution, problem, blocks, each, night, alarm):
    """The `NightTest` of nights where exposures of a detector (k,) have one distortion in common, ``{number: test}``.

    A departure is in the residuals then: of every night these have a map of the shared modes in common. Errors in force
    that were found from the residuals count as noise of this map, which the mean over a night makes small.
    """
    size, own = problem.n_modes, solution.gauge.n_own
    rows, degrees = dynamic_basis(problem.shapes[each[0]], size), dynamic_degrees(size)
    kept = degrees > basis.degree_of(own)
    owners, a, noise = np.unique(night[each]), [], []
    for n in owners:
        of = np.isin(problem.exposure, each[night[each] == n])
        modes, weight = blocks.values[:, of], problem.weight[:2, of]
        design = np.concatenate([rows[kept].reshape(-1, 2, size)[:, axis] @ modes * np.sqrt(weight[axis])
                                 for axis in range(2)], axis=1)  # fmt: skip
        covariance = np.linalg.pinv(design @ design.T)
        a.append(covariance @ design @ (np.sqrt(weight) * blocks.residual[:, of]).ravel())
        noise.append(np.diag(covariance))
    a, noise, degrees = np.array(a), np.array(noise), degrees[kept]
    if len(owners) <= FEWEST or not len(degrees):
        return {n: NightTest() for n in owners}
    out, tests = beyond_chance(a, noise, degrees, alarm, fewest=FEWEST), {}
    for k, n in enumerate(owners):
        others = with_others(a, out, k)
        away, *found = (value[others == k][0] for value in compared(a[others], noise[others], degrees))
        ratio, chi2, dof, p = map(float, found)
        tests[n] = NightTest(float(np.linalg.norm(away) / 2), ratio, chi2, dof, p, bool(p < alarm and ratio > ODD))
    return tests


def _static(solution, problem, state, each):
    """The `NightStatic` of a detector from some of its exposures (k,), by the model of all exposures.

    What is stated of it counts. A common map of the plane is free as it is.
    """
    keep = each[drawn(np.zeros(len(each)), _COEFFICIENTS // (2 * problem.n_modes))]
    problem, state = part_of(problem, state, keep)
    if len(np.unique(problem.night)) < FEWEST:
        return None
    n, rows = problem.n_modes, dynamic_basis(problem.shapes[0], problem.n_modes)
    stated = problem.errors_of_statics.to_modes(n).spread(rows[None], [0])
    width = np.clip(np.sqrt(stated.variance), _SMALLEST, _FREE)
    model = ExposureModel.of(problem, state, solution.gauge.all_motion[keep], np.zeros(len(keep), dtype=int))
    unit = 1 / np.sqrt(np.median(np.diag(model.data.curvature)))
    factor = Factor.joined([model.departures, model.statics(width=width, directions=stated.directions)])
    found = most_likely(model.data, factor, np.full(model.n_scatters, 10 * unit), unit * np.array(RANGE))
    mine, covariance = slice(-len(rows), None), found.covariance[-len(rows) :, -len(rows) :]
    scatter = problem.night_sigma
    if scatter is None:  # where every night has one exposure, that of exposures
        scatter = found.sizes[model.degrees - 1 + (model.degrees.max() if model.n_nights else 0)]
    power, directions = np.linalg.eigh(covariance)
    told = power < _KNOWN**2
    covariance = directions * np.where(told, power, FREE**2) @ directions.T + scatter**2 * np.eye(len(rows))
    covariance = rows.T @ covariance @ rows
    out = problem.prior_mean[0].copy()
    step = directions[:, told] @ (directions[:, told].T @ found.mean[mine])
    out[:, :n] += (rows.T @ step).reshape(2, n)
    sigma, covariance = as_errors(None, resized(covariance, out.shape[1]), out.shape[1], ("sigma", "covariance"))
    return NightStatic(out, sigma, len(np.unique(problem.night)), covariance)


def _together(tests):
    """The test of the detectors of a night."""
    if len(tests) == 1:
        return tests[0]
    known = [test for test in tests if test.departure is not None]
    dof = sum(test.dof for test in known)
    return NightTest(
        departure=float(np.sqrt(np.mean([test.departure**2 for test in known]))) if known else None,
        ratio=max((test.ratio for test in known), default=0.0),
        chi2=sum(test.chi2 for test in known),
        dof=dof,
        p=min(1.0, len(tests) * min(test.p for test in tests)),
        odd=any(test.odd for test in tests),
    )


@dataclass(frozen=True, eq=False)
class _Means:
    """What the data say of what the exposures of nights have in common.

    Attributes
    ----------
    values : ndarray, shape (n, K)
        m_n where the data are linear.
    data : ReducedData
        Of steps of these, (n K).
    degrees : ndarray of int, shape (K,)
    """

    values: np.ndarray
    data: ReducedData
    degrees: np.ndarray

    @classmethod
    def of(cls, problem, state, motion, owner):
        """That of a fit (see `ExposureModel.of`) whose exposures are of the nights `owner` (n_exposures,)."""
        model = ExposureModel.of(problem, state, motion, np.zeros(len(owner), dtype=int))
        count = np.bincount(owner)
        values = (np.eye(len(count))[:, owner] / count[:, None]) @ model.departure
        apart, degrees = model.departure - values[owner], model.degrees
        scatter = _within(model.data, apart, owner, degrees)
        return cls(values, _shared(model.data, apart, owner, scatter), degrees)

    def tests(self, alarm):
        """The `NightTest` of every night, whose p is odd below an alarm.

        The least probable is left out, again and again, while it is beyond chance: several odd ones would hide behind
        one another.
        """
        n, odd = len(self.values), frozenset()
        while True:
            whole = None if n <= _EACH else self._posterior(odd)
            tests = {k: self._test(k, odd, alarm, whole) for k in range(n) if k not in odd}
            worst = min(tests, key=lambda k: (tests[k].p, -tests[k].ratio))
            if whole is not None:
                tests[worst] = self._test(worst, odd, alarm)
            if tests[worst].p >= alarm or n - len(odd) - 1 < max(FEWEST, n / 2):
                break
            odd |= {worst}
        return [tests[k] if k in tests else self._test(k, odd - {k}, alarm) for k in range(n)]

    def _posterior(self, out, sizes=None):
        """Of the nights that are not left out; at given sizes, or those that make them most likely."""
        data, factor = self.data, _about_one("nights", self.values, self.degrees, free=out)
        if sizes is not None:
            return Posterior(data, factor, sizes)
        unit = _unit(data)
        if len(self.values) - len(out) < FEWEST:  # nothing tells how far nights scatter
            return Posterior(data, factor, np.full(self.degrees.max(), unit * _RANGE[0]))
        return most_likely(data, factor, np.full(self.degrees.max(), 3 * unit), unit * np.array(_RANGE))

    def _test(self, k, out, alarm, others=None):
        """The test of night k by those that are not left out; by the scatter of these, or that of a posterior."""
        n = len(self.values)
        unseen = out if others is not None or n - len(out | {k}) < FEWEST < n else out | {k}
        rows, screened = slice(k * len(self.degrees), (k + 1) * len(self.degrees)), others is not None
        others = self._posterior(unseen) if others is None else others
        scatter = others.sizes[self.degrees - 1] ** 2
        if screened:  # what it departs by from the prediction of all others follows from the posterior of all
            precision = self._precision(others, k)
            covariance = np.linalg.inv(precision + np.eye(len(precision)) / _FREE**2)
            away = covariance @ (others.left[0][rows] / scatter)
        else:
            free = others if unseen == out | {k} else self._posterior(out | {k}, others.sizes)
            away, covariance = free.left[0][rows], free.of_rows[rows, rows] + np.diag(scatter)
        whole = away, covariance
        pull, covariance = _told(*whole, scatter, np.full(len(away), True))
        if not len(pull):
            return NightTest()
        chi2 = max(pull @ np.linalg.solve(covariance, pull), 0)
        freedom, even = np.full(len(others.sizes), np.inf), np.ones(len(others.sizes))
        if n > FEWEST:
            freedom, even = self._freedom(others, unseen), self._evenness(others, unseen)
        p = [
            _chance(*_told(*whole, scatter, self.degrees == degree), freedom[degree - 1], even[degree - 1])
            for degree in set(self.degrees)
        ]
        p, ratio = min(1.0, len(p) * min(p)), np.sqrt(chi2 / len(pull))
        odd = n - len(out | {k}) >= FEWEST and p < alarm and ratio > ODD
        return NightTest(float(np.linalg.norm(pull) / 2), float(ratio), float(chi2), len(pull), float(p), bool(odd))

    def _freedom(self, posterior, unseen):
        """Degrees of freedom, by degree, of the squares of those nights from which the scatter was found."""
        out, size = np.zeros(len(posterior.sizes)), len(self.degrees)
        scatter = np.diag(posterior.sizes[self.degrees - 1] ** 2)
        for k in set(range(len(self.values))) - set(unseen):
            own = self.data.curvature[k * size :, k * size :][:size, :size] + np.eye(size) / _FREE**2
            share = np.diag((np.linalg.inv(own) + scatter) @ self._precision(posterior, k))
            out += np.bincount(self.degrees - 1, np.clip(share, 0, 1), len(out))
        return out

    def _evenness(self, posterior, unseen):
        """Part of the modes of every degree that scatter, (n_degrees,): 1 where all do alike, as one size has it.

        Where few do, so many fewer squares tell that size, and a departure in these alone is no rarer than in one of
        them (Satterthwaite 1946): by the fourth moments of the nights, as those of a normal distribution.
        """
        n, k = self.values.shape
        seen = np.isin(np.arange(n), list(unseen), invert=True)
        expected = np.tile(posterior.sizes[self.degrees - 1] ** 2, n) - np.diag(posterior.of_rows)[: n * k]
        square = posterior.left[0][: n * k] ** 2
        square, expected = (each.reshape(n, k)[seen].sum(axis=0) for each in (square, expected))
        ratio, out = square / np.maximum(expected, 1e-300), np.ones(len(posterior.sizes))
        for degree in set(self.degrees):
            mine = self.degrees == degree
            mine = ratio[mine & (expected > _ALIKE * expected[mine].max())]
            fourth = np.mean(mine**2) / (1 + 2 / max(np.count_nonzero(seen) - 1, 1))
            out[degree - 1] = np.clip(np.mean(mine) ** 2 / max(fourth, 1e-300), 1 / len(mine), 1)
        return out

    def _precision(self, posterior, k):
        """Inverse covariance (K, K) of what a night departs by from the prediction of all others in a posterior."""
        rows = slice(k * len(self.degrees), (k + 1) * len(self.degrees))
        inverse = 1 / posterior.widths[rows] ** 2
        out = np.diag(inverse) - inverse[:, None] * posterior.of_rows[rows, rows] * inverse
        return (out + out.T) / 2


def _told(away, covariance, scatter, of):
    """Departure and covariance of some coefficients (K,), in the orthonormal directions that the data determine."""
    size, directions = np.linalg.eigh(covariance[np.ix_(of, of)] - np.diag(scatter[of]))
    directions = directions[:, size < _KNOWN**2 + scatter[of].max()].T
    return directions @ away[of], directions @ covariance[np.ix_(of, of)] @ directions.T


def _chance(away, covariance, dof, even):
    """Probability of a departure (m,), whose squares are compared with others of so many degrees.

    `even` is the part of them that scatter.
    """
    m = len(away)
    if not m:
        return 1.0
    square = away @ np.linalg.solve(covariance, away)
    if np.isinf(dof):
        return special.chdtrc(even * m, even * square)
    return special.fdtrc(even * m, even * dof, square / m) if even * dof >= 1 else 1.0


def _about_one(of, values, degrees, free=()):
    """The factor on departures of values (n, K) from what they have in common, by degree, and on that, which is free.

    So are those of some of them, by number.
    """
    n, k = values.shape
    size = np.where(np.isin(np.arange(n), list(free))[:, None], GIVEN, degrees - 1).ravel()
    rows = sparse.hstack([sparse.eye_array(n * k), sparse.kron(np.ones((n, 1)), -np.eye(k))], format="csr")
    own = Factor(f"departures of {of}", rows, values.ravel(), np.full(n * k, _FREE), size)
    rows = sparse.eye_array(k, (n + 1) * k, k=n * k, format="csr")
    return Factor.joined([own, Factor(f"what {of} share", rows, np.zeros(k), np.full(k, _FREE), np.full(k, GIVEN))])


def _unit(data):
    """Typical error of a coefficient of data [pix]."""
    return 1 / np.sqrt(np.median(np.diag(data.curvature)))


def _within(data, apart, owner, degrees):
    """Variance (n_nights, K) of exposures about what those of their night have in common, by degree.

    From data on the steps of all coefficients, where these are apart (n_exposures, K) from one another. That of a night
    whose exposures scatter more than those of the others, beyond chance, is its own.
    """
    k, count, most = apart.shape[1], np.bincount(owner), degrees.max()
    own = np.zeros((len(count), most))
    for night in np.flatnonzero(count > 1):
        mine = np.flatnonzero(owner == night)
        rows = (mine[:, None] * k + np.arange(k)).ravel()
        part = ReducedData(data.curvature[np.ix_(rows, rows)], data.pull[rows], 0.0, len(rows))
        factor, unit = _about_one("exposures", apart[mine], degrees), _unit(part)
        own[night] = most_likely(part, factor, np.full(most, 3 * unit), unit * np.array(RANGE)).sizes ** 2
    free, others = (count - 1)[:, None], ~np.eye(len(count), dtype=bool)
    theirs = others @ (free * own) / np.maximum(others @ free, 1)
    modes = np.bincount(degrees - 1)
    limit = special.fdtri(np.maximum(free, 1) * modes, np.maximum(others @ free, 1) * modes, _WIDER)
    return np.where(own > limit * theirs, own, theirs)[:, degrees - 1]


def _shared(data, apart, owner, scatter):
    """Data on steps of what exposures of a night have in common, their scatter by so much (n_nights, K) eliminated.

    ``z = e + P v + d`` with ``d ~ N(0, W)``: curvature ``P' R (1 + W R)^-1 P`` and slope ``P' (1 + R W)^-1 (g - R e)``
    for v, of data with curvature R and slope g.
    """
    k = apart.shape[1]
    common = np.kron(np.eye(len(scatter))[owner], np.eye(k))
    width = scatter[owner].ravel()
    solved = np.linalg.solve(np.eye(len(width)) + width[:, None] * data.curvature, common)
    curvature = common.T @ data.curvature @ solved
    pull = solved.T @ (data.pull + data.curvature @ apart.ravel())
    return ReducedData((curvature + curvature.T) / 2, pull, 0.0, len(pull))
