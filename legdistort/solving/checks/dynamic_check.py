"""What exposures add to the static distortion: is it beyond noise, and does one add more than the others do?"""

import numpy as np
from scipy import special

from ...exceptions import some_of
from ...geometry.detector_modes import dynamic_basis, dynamic_degrees
from ...results.check import FALSE_ALARM, Check, FactorTest
from .limits import MOST_NAMED

#: Exposures, or nights, of one detector from which the scatter of the others tells whether one is odd.
_FEWEST = 6
#: Times the scatter of the others that matter to their common map.
_ODD = 3.0
_OTHERS = "scatter of the others"


def significance(solution, blocks, *, top_only=False):
    """Probability by chance of the largest distortion of an exposure, shift, rotation and scale taken off."""
    n, size = len(solution.names), blocks.u.shape[1] // 2
    best, scale = 1.0, max(1.0, solution.chi2 / max(solution.dof, 1)) * n / max(n - 1, 1)
    for i, name in enumerate(solution.names):
        rows = dynamic_basis(solution.estimate.shapes[name], size)
        if top_only:
            rows = rows[dynamic_degrees(size) == solution.degree]
        if not len(rows):
            continue
        a = rows @ (solution.coefficients[i] - solution.estimate.prior_mean[i])[:, :size].ravel()
        t = a @ np.linalg.solve(rows @ np.linalg.inv(blocks.u[i]) @ rows.T, a) / scale
        best = min(best, n * special.chdtrc(len(rows), t))
    return best


def dynamic_check(solution, problem, blocks):
    """Is any exposure distorted beyond noise? With a `FactorTest` of each that departs more than the others do."""
    if solution.degree < 1 or solution.settings.static == "fit":
        return None
    p = significance(solution, blocks)
    static = "the static distortion" if np.any(solution.estimate.prior_mean) else "shift, rotation and scale"
    if p >= FALSE_ALARM:
        return Check("dynamic part", "warn", p, FALSE_ALARM,
                     f"none of {len(solution.names)} exposures departs from {static} beyond noise",
                     "a lower --degree fits as well, with smaller errors")  # fmt: skip
    odd = _odd(solution, problem, blocks)
    found = f"exposures depart from {static} beyond noise"
    if odd:
        named = [f"{name} {ratio:.2g} times as far as the others, by {rms:.2g} px rms" for name, ratio, rms, _ in odd]
        found += (
            f", {some_of(named, MOST_NAMED)}: look at what was different then; its distortions are its own, and do "
        )
        found += "no harm, but absolute positions are surer without"
    return Check("dynamic part", "pass", p, FALSE_ALARM, found, tests=tuple(test for *_, test in odd))


def _odd(solution, problem, blocks):
    """Exposures and nights that depart from the others of their detector more than these among themselves.

    The farthest first: name, how many times as far as these, by how many pixels rms, and the `FactorTest`: squares by
    degree over those of the others, beyond the errors of the coefficients. If all scatter alike, by degree, they are
    distributed as F.
    """
    found, names = [], np.array(solution.names)
    size, degrees = problem.n_modes, dynamic_degrees(problem.n_modes)
    for detector in np.unique(problem.detectors):
        each = np.flatnonzero(problem.detectors == detector)
        rows = dynamic_basis(problem.shapes[each[0]], size)
        a = (solution.coefficients - solution.estimate.prior_mean)[each, :, :size].reshape(len(each), -1) @ rows.T
        noise = np.einsum("ka,iab,kb->ik", rows, np.linalg.inv(blocks.u[each]), rows)
        owners = [(np.arange(len(each)), "")]
        if problem.nights is not None:
            owners.append((np.unique(problem.nights[each], return_inverse=True)[1], "the night of "))
        for owner, whose in owners:
            mean = np.eye(owner.max() + 1)[:, owner] / np.bincount(owner)[:, None]
            if len(mean) < _FEWEST:
                continue
            departing = mean @ a
            for k, ratio, chi2, p in _beyond(departing, mean**2 @ noise, degrees, len(names)):
                name = whose + names[each][owner == k][0]
                test = FactorTest(f"departure of {name}", _OTHERS, len(rows), chi2, len(rows), p)
                rms = np.linalg.norm(departing[k] - np.delete(departing, k, axis=0).mean(axis=0)) / 2  # as `rms_length`
                found.append((name, ratio, rms, test))
    return sorted(found, key=lambda each: -each[1])


def _beyond(a, noise, degrees, n_tests):
    """Which of departures (n, k), with variances of their errors and degrees (k,), are odd: row, ratio, chi2 and p."""
    n = len(a)
    squares = (a - a.mean(axis=0)) ** 2
    square, p = squares * (n / (n - 1)) ** 2, []  # from the mean of the others
    for degree in (each := np.unique(degrees)):
        of = degrees == degree
        m = np.count_nonzero(of)
        whole = (squares[:, of].sum() - squares[:, of].sum(axis=1) * n / (n - 1)) / (m * (n - 2))
        errors = (noise[:, of].sum() - noise[:, of].sum(axis=1)) / (m * (n - 1))
        scatter = np.maximum(whole - errors, 0)
        square[:, of] /= (scatter + whole / (n - 1))[:, None] + noise[:, of]
        p.append(special.fdtrc(m, m * (n - 2), square[:, of].mean(axis=1)))
    p = np.minimum(1, len(each) * np.min(p, axis=0))
    for i in np.flatnonzero((p < FALSE_ALARM / n_tests) & (square.mean(axis=1) > _ODD**2)):
        yield i, np.sqrt(square[i].mean()), square[i].sum(), float(p[i])
