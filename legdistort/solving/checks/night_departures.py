"""How far a night departs from what the others have in common, by how far these scatter: each is left out in turn.

Of the exposures of night n, ``m_n = S + M_n g + B_n + d_n``: their mean coefficients, S the static distortion of the
detector, g a common map of the reference plane (with motions one that grows with time beside), ``B_n ~ N(0, Lambda)``
the departure of the night, d_n the mean of departures and errors of its exposures. Lambda, by degree, is that which
makes the other nights most likely (`most_likely`), and S and g are free, so that a night that is odd moves nothing of
what it is compared with. Nights that are odd are left out of what the rest is compared with.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse, special

from ...geometry.detector_modes import dynamic_basis, dynamic_degrees
from ...results.check import FALSE_ALARM
from ...results.nights import NightTest
from ..knowledge.factors import GIVEN, Factor
from ..knowledge.posterior import Posterior, most_likely
from ..knowledge.reduced_data import ReducedData

#: Times the scatter of the others and the errors, from which a departure is odd.
ODD = 3.0
#: Others from which a night can be told odd.
FEWEST = 2
#: Nights that are compared with one another, drawn at random where there are more.
_MOST = 24
#: Up to so many nights the scatter of the others is found anew for each; among more a single one does not count.
_EACH = 12
_FREE = 100.0  # size of what is free [pix]
#: Scatter is sought within these factors of the typical error of a mean; less is none, and smaller numbers lose digits.
_RANGE = 0.1, 1e6
_MAP = 2.0  # size of a common map, in that of the coefficients: the plane is none that would need larger ones
_SMALLEST = 1e-6  # pixels
_KNOWN = 0.3 * np.sqrt(8)  # error of a coefficient beyond which a direction is not determined [pix]


def night_tests(solution, problem, blocks):
    """The `NightTest` of every night, in the order of their numbers.

    Parameters
    ----------
    solution : Solution
    problem : Problem
        With the weights that were in force.
    blocks : Blocks
    """
    night = np.broadcast_to(problem.night, problem.n_exposures)
    number = np.unique(night)
    if solution.gauge.plane is not None or problem.degree < 1 or problem.unknowns.shared or len(number) < 2:
        return tuple(NightTest() for _ in number)
    found = {n: [] for n in number}
    rng = np.random.default_rng(0)
    for detector in np.unique(problem.detectors):
        each = np.flatnonzero(problem.detectors == detector)
        owners = rng.permutation(np.unique(night[each]))
        for part in np.array_split(owners, -(-len(owners) // _MOST)):
            some = each[np.isin(night[each], part)]
            means = _Means.of(solution, problem, blocks, some, np.unique(night[some], return_inverse=True)[1])
            for n, test in zip(np.sort(part), means.tests(FALSE_ALARM / len(number)), strict=True):
                found[n].append(test)
    return tuple(_together(tests) for tests in found.values())


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
    """

    values: np.ndarray
    covariance: np.ndarray
    maps: np.ndarray
    degrees: np.ndarray

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
        covariance = np.einsum("ni,ikl->nkl", mean**2, noise)
        covariance += _within(a, np.diagonal(noise, axis1=1, axis2=2), owner, degrees)[:, :, None] * np.eye(len(rows))
        return cls(mean @ a, covariance, np.einsum("ni,ikm->nkm", mean, maps), degrees)

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
        """What is known of the departures, those of some nights but that they are free."""
        n, k = self.values.shape
        m = self.maps.shape[2]
        static, maps = sparse.kron(np.ones((n, 1)), -np.eye(k)), sparse.csr_array(-self.maps.reshape(n * k, m))
        own = sparse.hstack([sparse.eye_array(n * k), static, maps], format="csr")
        free = sparse.eye_array(k + m, (n + 1) * k + m, k=n * k, format="csr")
        size = np.where(np.isin(np.arange(n), list(out))[:, None], GIVEN, self.degrees - 1).ravel()
        own = Factor("departures of nights", own, self.values.ravel(), np.full(n * k, _FREE), size)
        width = np.append(np.full(k, _FREE), np.full(m, _MAP * max(np.sqrt(np.mean(self.values**2)), _SMALLEST)))
        free = Factor("common", free, np.zeros(k + m), width, np.full(k + m, GIVEN))
        return Factor.joined([own, free])

    def _posterior(self, out, sizes=None):
        """Of the nights that are not left out; at given sizes, or those that make them most likely."""
        n, k = self.values.shape
        curvature = np.zeros((n, k, n, k))
        curvature[np.arange(n), :, np.arange(n)] = np.linalg.inv(self.covariance)
        data, factor = ReducedData(curvature.reshape(n * k, n * k), np.zeros(n * k), 0.0, n * k), self._factor(out)
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
        others = self._posterior(unseen) if others is None else others
        free = others if unseen == out | {k} else self._posterior(out | {k}, others.sizes)
        rows, scatter = slice(k * len(self.degrees), (k + 1) * len(self.degrees)), others.sizes[self.degrees - 1] ** 2
        away, errors = free.left[0][rows], free.of_rows[rows, rows]
        covariance = errors + np.diag(scatter)
        size, directions = np.linalg.eigh(errors)
        directions = directions[:, size < _KNOWN**2 + scatter.max()].T
        if not len(directions):
            return NightTest()
        pull = directions @ away
        chi2 = max(pull @ np.linalg.solve(directions @ covariance @ directions.T, pull), 0)
        freedom = self._freedom(others, unseen) if n > FEWEST else np.full(len(others.sizes), np.inf)
        p = [_chance(away, covariance, self.degrees == degree, freedom[degree - 1]) for degree in set(self.degrees)]
        p, ratio = min(1.0, len(p) * min(p)), np.sqrt(chi2 / len(directions))
        odd = n - len(out | {k}) >= FEWEST and p < alarm and ratio > ODD
        return NightTest(
            float(np.linalg.norm(pull) / 2), float(ratio), float(chi2), len(directions), float(p), bool(odd)
        )

    def _freedom(self, posterior, unseen):
        """Degrees of freedom, by degree, of the squares of those nights from which the scatter was found."""
        out, n_modes = np.zeros(len(posterior.sizes)), len(self.degrees)
        scatter = np.diag(posterior.sizes[self.degrees - 1] ** 2)
        for k in set(range(len(self.values))) - set(unseen):
            rows = slice(k * n_modes, (k + 1) * n_modes)
            inverse = 1 / posterior.widths[rows] ** 2
            left = np.diag(inverse) - inverse[:, None] * posterior.of_rows[rows, rows] * inverse
            out += np.bincount(self.degrees - 1, np.diag((self.covariance[k] + scatter) @ left), len(out))
        return out


def _chance(away, covariance, of, dof):
    """Probability of a departure in some coefficients, whose squares are compared with others of so many degrees."""
    m, square = np.count_nonzero(of), away[of] @ np.linalg.solve(covariance[np.ix_(of, of)], away[of])
    if np.isinf(dof):
        return special.chdtrc(m, square)
    return special.fdtrc(m, dof, square / m) if dof >= 1 else 1.0


def _within(a, noise, owner, degrees):
    """Variance (n_nights, K) of the means of nights by the scatter of their exposures (n, K), by degree.

    That of a night whose exposures scatter more than those of the others is its own.
    """
    count = np.bincount(owner)
    mean = np.eye(len(count))[:, owner] / count[:, None]
    by_degree = (degrees == np.unique(degrees)[:, None]).astype(float)
    squares = (count[:, None] * mean) @ ((a - (mean @ a)[owner]) ** 2) @ by_degree.T
    expected = (count[:, None] * mean) @ noise @ by_degree.T * (1 - 1 / count)[:, None]
    free = (count - 1)[:, None] * by_degree.sum(axis=1)
    excess, others = squares - expected, ~np.eye(len(count), dtype=bool)
    theirs = np.maximum(others @ excess, 0) / np.maximum(others @ free, 1)
    own = np.where(free > 0, excess / np.maximum(free, 1), 0)
    return np.maximum(theirs, own) @ by_degree / count[:, None]
