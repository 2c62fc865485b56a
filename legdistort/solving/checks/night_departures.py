"""How far a night departs from what the others have in common, by how far these scatter: each is left out in turn.

Of the exposures of night n, ``m_n = S + M_n g + B_n + d_n``: their mean coefficients, S the static distortion of the
detector, g a common map of the reference plane (with motions one that grows with time beside), ``B_n ~ N(0, Lambda)``
the departure of the night, d_n the mean of departures and errors of its exposures. Lambda, by degree, is that which
makes the other nights most likely (`most_likely`). S is free, and g but for what differences within nights show of it,
so that a night that is odd moves nothing of what it is compared with; the rest is compared without it.
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
#: Nights that are compared with one another, drawn at random where there are more.
_MOST = 24
#: Up to so many nights the scatter of the others is found anew for each; among more a single one does not count.
_EACH = 12
_COEFFICIENTS = 500  # from which the static distortion of nights is found
_FREE = 100.0  # size of what is free [pix]
#: Scatter is sought within these factors of the typical error of a mean; less is none, and smaller numbers lose digits.
_RANGE = 0.1, 1e6
_MAP = 2.0  # size of a common map, in that of the coefficients: the plane is none that would need larger ones
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
        for part in np.array_split(owners, -(-len(owners) // _MOST)):
            some = each[np.isin(night[each], part)]
            means = _Means.of(solution, problem, blocks, some, np.unique(night[some], return_inverse=True)[1])
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
        ratio, chi2, p = (float(value[others == k][0]) for value in compared(a[others], noise[others], degrees))
        departure = float(np.linalg.norm(a[k] - a[others[others != k]].mean(axis=0)) / 2)
        tests[n] = NightTest(departure, ratio, chi2, len(degrees), p, bool(p < alarm and ratio > ODD))
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
    """Mean coefficients of nights.

    Attributes
    ----------
    values : ndarray, shape (n, K)
    covariance : ndarray, shape (n, K, K)
        Of d_n.
    maps : ndarray, shape (n, K, m)
        M_n.
    degrees : ndarray of int, shape (K,)
    root, seen : ndarray, shapes (m, m) and (m,)
        ``root g - seen ~ N(0, 1)``: what differences of exposures within nights show of g.
    """

    values: np.ndarray
    covariance: np.ndarray
    maps: np.ndarray
    degrees: np.ndarray
    root: np.ndarray
    seen: np.ndarray

    @classmethod
    def of(cls, solution, problem, blocks, each, owner):
        """Those of some exposures of a detector (k,), whose nights are `owner` (k,)."""
        size, gauge = problem.n_modes, solution.gauge
        rows, degrees = dynamic_basis(problem.shapes[each[0]], size), dynamic_degrees(size)
        a = (solution.coefficients - solution.estimate.prior_mean)[each, :, :size].reshape(len(each), -1) @ rows.T
        noise = np.einsum("ka,iab,lb->ikl", rows, np.linalg.inv(blocks.u[each]), rows)
        motion = gauge.all_motion[each].reshape(len(each), 2, gauge.n_own, -1)
        motion = np.pad(motion, ((0, 0), (0, 0), (0, size - gauge.n_own), (0, 0)))
        maps = np.einsum("ka,iam->ikm", rows, motion.reshape(len(each), 2 * size, -1))
        mean = np.eye(owner.max() + 1)[:, owner] / np.bincount(owner)[:, None]
        values, variance = mean @ a, np.diagonal(noise, axis1=1, axis2=2)
        map_means = np.einsum("ni,ikm->nkm", mean, maps)
        apart, moved = a - values[owner], maps - map_means[owner]
        information = np.eye(maps.shape[2]) / (_MAP * max(np.sqrt(np.mean(values**2)), _SMALLEST)) ** 2
        weight = 1 / (variance + (_within(apart, variance, owner, degrees) * np.bincount(owner)[:, None])[owner])
        root = np.linalg.cholesky(information + np.einsum("ikm,ik,ikl->ml", moved, weight, moved)).T
        seen = np.linalg.solve(root.T, np.einsum("ikm,ik,ik->m", moved, weight, apart))
        scatter = _within(apart - moved @ np.linalg.solve(root, seen), variance, owner, degrees)
        covariance = np.einsum("ni,ikl->nkl", mean**2, noise) + scatter[:, :, None] * np.eye(len(rows))
        return cls(values, covariance, map_means, degrees, root, seen)

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

    def _factor(self, out):
        """What is known of the departures, those of some nights but that they are free, and of S and g."""
        n, k = self.values.shape
        m = self.maps.shape[2]
        static, maps = sparse.kron(np.ones((n, 1)), -np.eye(k)), sparse.csr_array(-self.maps.reshape(n * k, m))
        own = sparse.hstack([sparse.eye_array(n * k), static, maps], format="csr")
        free = sparse.block_array(
            [[sparse.csr_array((k + m, n * k)), sparse.block_diag([np.eye(k), self.root])]]
        ).tocsr()
        size = np.where(np.isin(np.arange(n), list(out))[:, None], GIVEN, self.degrees - 1).ravel()
        own = Factor("departures of nights", own, self.values.ravel(), np.full(n * k, _FREE), size)
        width, value = np.append(np.full(k, _FREE), np.ones(m)), np.append(np.zeros(k), -self.seen)
        free = Factor("common", free, value, width, np.full(k + m, GIVEN))
        return Factor.joined([own, free])

    def _posterior(self, out, sizes=None):
        """Of the nights that are not left out; at given sizes, or those that make them most likely."""
        n, k = self.values.shape
        curvature = np.zeros((n, k, n, k))
        curvature[np.arange(n), :, np.arange(n)] = np.linalg.inv(self.covariance)
        data, factor = (
            ReducedData(curvature.reshape(n * k, n * k), np.zeros(n * k), 0.0, n * k),
            self._factor(out),
        )
        if sizes is not None:
            return Posterior(data, factor, sizes)
        unit = 1 / np.sqrt(np.median(np.diag(data.curvature)))
        if n - len(out) < FEWEST:  # nothing tells how far nights scatter
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
            covariance = np.linalg.inv(self._precision(others, k))
            away = covariance @ (others.left[0][rows] / scatter)
        else:
            free = others if unseen == out | {k} else self._posterior(out | {k}, others.sizes)
            away, covariance = free.left[0][rows], free.of_rows[rows, rows] + np.diag(scatter)
        size, directions = np.linalg.eigh(covariance - np.diag(scatter))
        directions = directions[:, size < _KNOWN**2 + scatter.max()].T
        if not len(directions):
            return NightTest()
        pull = directions @ away
        chi2 = max(pull @ np.linalg.solve(directions @ covariance @ directions.T, pull), 0)
        freedom, even = np.full(len(others.sizes), np.inf), np.ones(len(others.sizes))
        if n > FEWEST:
            freedom, even = self._freedom(others, unseen), self._evenness(others, unseen)
        p = [
            _chance(away, covariance, self.degrees == degree, freedom[degree - 1], even[degree - 1])
            for degree in set(self.degrees)
        ]
        p, ratio = min(1.0, len(p) * min(p)), np.sqrt(chi2 / len(directions))
        odd = n - len(out | {k}) >= FEWEST and p < alarm and ratio > ODD
        return NightTest(
            float(np.linalg.norm(pull) / 2), float(ratio), float(chi2), len(directions), float(p), bool(odd)
        )

    def _freedom(self, posterior, unseen):
        """Degrees of freedom, by degree, of the squares of those nights from which the scatter was found."""
        out = np.zeros(len(posterior.sizes))
        scatter = np.diag(posterior.sizes[self.degrees - 1] ** 2)
        for k in set(range(len(self.values))) - set(unseen):
            share = np.diag((self.covariance[k] + scatter) @ self._precision(posterior, k))
            out += np.bincount(self.degrees - 1, share, len(out))
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
            mine = ratio[self.degrees == degree]
            fourth = np.mean(mine**2) / (1 + 2 / max(np.count_nonzero(seen) - 1, 1))
            out[degree - 1] = np.clip(np.mean(mine) ** 2 / max(fourth, 1e-300), 1 / len(mine), 1)
        return out

    def _precision(self, posterior, k):
        """Inverse covariance (K, K) of what a night departs by from the prediction of all others in a posterior."""
        rows = slice(k * len(self.degrees), (k + 1) * len(self.degrees))
        inverse = 1 / posterior.widths[rows] ** 2
        out = np.diag(inverse) - inverse[:, None] * posterior.of_rows[rows, rows] * inverse
        return (out + out.T) / 2


def _chance(away, covariance, of, dof, even):
    """Probability of a departure in some coefficients, whose squares are compared with others of so many degrees.

    `even` is the part of them that scatter.
    """
    m, square = np.count_nonzero(of), away[of] @ np.linalg.solve(covariance[np.ix_(of, of)], away[of])
    if np.isinf(dof):
        return special.chdtrc(even * m, even * square)
    return special.fdtrc(even * m, even * dof, square / m) if even * dof >= 1 else 1.0


def _within(apart, noise, owner, degrees):
    """Variance (n_nights, K) of the means of nights by how far their exposures are apart from these (n, K), by degree.

    That of a night whose exposures scatter more than those of the others is its own.
    """
    count = np.bincount(owner)
    mean = np.eye(len(count))[:, owner] / count[:, None]
    by_degree = (degrees == np.unique(degrees)[:, None]).astype(float)
    squares = (count[:, None] * mean) @ apart**2 @ by_degree.T
    expected = (count[:, None] * mean) @ noise @ by_degree.T * (1 - 1 / count)[:, None]
    free = (count - 1)[:, None] * by_degree.sum(axis=1)
    excess, others = squares - expected, ~np.eye(len(count), dtype=bool)
    theirs = np.maximum(others @ excess, 0) / np.maximum(others @ free, 1)
    own = np.where(free > 0, excess / np.maximum(free, 1), 0)
    return np.maximum(theirs, own) @ by_degree / count[:, None]
