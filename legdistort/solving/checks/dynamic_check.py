"""What exposures and nights add to the static distortion: is it beyond noise, does one add more than the others do?"""

import shlex

import numpy as np
from scipy import special

from ...exceptions import some_of
from ...geometry import basis, similarity
from ...geometry.detector_modes import dynamic_basis, dynamic_degrees
from ...results.check import FALSE_ALARM, Check, FactorTest, state_of
from ...results.errors import absolute_errors
from ...results.nights import table as night_table
from .limits import MOST_NAMED
from .night_departures import FEWEST, ODD
from .odd_ones import beyond_chance, compared, with_others

#: Exposures of one detector from which the scatter of the others tells whether one is odd.
_FEWEST = 6
#: Times the scatter of the others that matter to their common map.
_ODD = 3.0
_OTHERS = "scatter of the others"
#: The cure where departures that are fitted are none, which makes errors larger than they need be.
EVIDENCE = "--prior-sigma evidence, which finds how far exposures depart, fits as well, with smaller relative errors"


def significance(solution, *, top_only=False):
    """Probability by chance of the largest distortion of an exposure, shift, rotation and scale taken off.

    Under its covariance, which has the errors of the stars: few exposures of a camera tie them to each other; where a
    catalogue tells the mean of all, with the errors of that.
    """
    n, best, scale = len(solution.names), 1.0, max(1.0, solution.chi2 / max(solution.dof, 1))
    for i, name in enumerate(solution.names):
        covariance = solution[name].covariance
        size = len(covariance) // 2
        if solution.gauge.tie is not None:
            moved = absolute_errors.known_changes(solution.gauge, size)[i]
            covariance = covariance + moved @ absolute_errors.known_covariance(solution.gauge) @ moved.T
        rows = dynamic_basis(solution.estimate.shapes[name], size)
        if top_only:
            rows = rows[dynamic_degrees(size) == solution.degree]
        if not len(rows):
            continue
        a = rows @ (solution.coefficients[i] - solution.estimate.prior_mean[i])[:, :size].ravel()
        t = a @ np.linalg.pinv(rows @ covariance @ rows.T, hermitian=True) @ a / scale
        best = min(best, n * special.chdtrc(len(rows), t))
    return best


def has_static_of_degree(solution):
    """Whether detectors in a focal plane have modes of the degree, which exposures of a lower one do not take over."""
    top = slice(basis.n_modes(solution.degree - 1), basis.n_modes(solution.degree))
    detectors = solution.camera.detectors.values() if solution.camera.has_focal_plane else ()
    return any(np.any(each.static[:, top]) for each in detectors)


def dynamic_check(solution, problem, blocks):
    """Is any exposure distorted beyond noise? With a `FactorTest` of each that departs more than the others do."""
    if solution.degree < 1 or solution.settings.static == "fit":
        return None
    p = significance(solution)
    static = "the static distortion" if np.any(solution.estimate.prior_mean) else "shift, rotation and scale"
    if p >= FALSE_ALARM:
        none = f"none of {len(solution.names)} exposures departs from {static} beyond noise"
        if solution.diagnostics.widths is not None:
            return Check(
                "dynamic part", "pass", p, FALSE_ALARM, f"{none}; errors count that, by their scatter as found"
            )
        return Check("dynamic part", "warn", p, FALSE_ALARM, none, f"{EVIDENCE}, or a lower --degree")
    nights = night_table(solution)
    odd = _odd(solution, problem, blocks, set(nights["block"][nights["odd"]]))
    found, tests = f"exposures depart from {static} beyond noise", tuple(test for *_, test in odd)
    if odd:
        named = [_far(name, ratio, rms) for name, ratio, rms, _ in odd]
        found += (
            f", {', '.join(named)}: look at what was different then; its distortions are its own and count less; "
            "to compare, leave it out (--without)"
        )
    return Check("dynamic part", "pass", p, FALSE_ALARM, found, tests=tests)


def mirrored_check(solution, detectors):
    """Are exposures of a detector mirrored against the others? None where none is.

    No turn makes a detector its mirror image: axes were exchanged, or one reversed, so that the static distortion of
    such an exposure is not that of the others. `detectors` are numbers (n_exposures,).
    """
    odd = _mirrored(solution, detectors)
    if not odd.any():
        return None
    names, share = [name for name, is_odd in zip(solution.names, odd, strict=True) if is_odd], float(odd.mean())
    one = len(names) == 1
    found = (
        f"{some_of(names, MOST_NAMED)} {'is' if one else 'are'} mirrored against the other exposures, as where x and y "
        f"are exchanged or one of them runs the other way: {'its' if one else 'their'} static distortion is not that "
        "of the others, and spoils absolute positions"
    )
    cure = f"exchange x and y there, or what else is reversed; else --without {shlex.join(names)}"
    return Check("mirrored", "fail" if share < 0.5 else "warn", share, 0.0, found, cure, exposures=tuple(names))


def _mirrored(solution, detectors):
    """Which exposures, (n_exposures,), are mirrored against most of their detector."""
    parities = [similarity.describe(solution.poses[name])["parity"] for name in solution.names]
    reversed_ = np.array(parities) < 0
    odd = np.zeros(len(detectors), dtype=bool)
    for detector in np.unique(detectors):
        of = detectors == detector
        odd |= of & (reversed_ if 2 * np.count_nonzero(reversed_ & of) <= np.count_nonzero(of) else ~reversed_)
    return odd


def nights_check(solution, *, error):
    """Does a night depart farther than the others do, and than the error of a star? None where nothing tells."""
    nights = night_table(solution)
    told = nights[nights["dof"] > 0]
    if len(told) <= FEWEST:
        return None
    odd = told[told["odd"]]
    if not len(odd):
        found = f"none of {len(nights)} nights departs farther than the others do"
        return Check("nights", "pass", max(told["ratio"]), ODD, found)
    found, leave_out = [], []
    for row in odd:
        exposures = row["exposures"].split(", ")
        named = f"night {row['name']} ({some_of(exposures, MOST_NAMED)}) departs"
        found.append(_far(named, row["ratio"], row["departure"].value))
        leave_out += [row["name"]] if row["name"] not in solution.names else exposures
    worst, those = odd[0], "them" if len(odd) > 1 else "it"
    state = state_of(min(1, worst["p"] * len(nights)), max(odd["departure"].value) > error)
    return Check("nights", state, worst["ratio"], ODD,
                 f"{'; '.join(found)}; what it departs by counts as its own, and the rest is compared without it",
                 f"look at what was different then; solve --without {shlex.join(leave_out)} leaves {those} out",
                 tests=tuple(map(_of_night, odd)))  # fmt: skip


def _far(name, ratio, rms):
    return f"{name} {ratio:.2g} times as far as the others, by {rms:.2g} px, rms length of both axes together"


def _of_night(row):
    """The `FactorTest` of a night of `Solution.nights`."""
    known = float(row["chi2"]), float(row["dof"]), float(row["p"])
    return FactorTest(f"departure of night {row['name']}", _OTHERS, int(row["dof"]), *known)


def _odd(solution, problem, blocks, nights):
    """Exposures that depart from the others of their detector more than these among themselves, but for some nights.

    The farthest first: name, how many times as far as these, by how many pixels rms, and the `FactorTest`: squares by
    degree over those of the others, beyond the errors of the coefficients. If all scatter alike, by degree, they are
    distributed as F. The exposures of nights that are odd as a whole, by their numbers, are not among them, nor are
    mirrored ones among the others: two would explain each other by a map of the plane. What such a map explains is not
    odd: one bad exposure draws it to itself, and those that are turned would show that.
    """
    found, names = [], np.array(solution.names)
    size, degrees = problem.n_modes, dynamic_degrees(problem.n_modes)
    mirrored = _mirrored(solution, problem.detectors)
    asked = ~np.isin(np.broadcast_to(problem.night, len(names)), list(nights))
    for detector in np.unique(problem.detectors):
        each = np.flatnonzero((problem.detectors == detector) & asked)
        if len(each) < _FEWEST or np.count_nonzero(~mirrored[each]) < _FEWEST - 1:
            continue
        rows = dynamic_basis(problem.shapes[each[0]], size)
        a = (solution.coefficients - solution.estimate.prior_mean)[each, :, :size].reshape(len(each), -1) @ rows.T
        noise = np.einsum("ka,iab,kb->ik", rows, np.linalg.inv(blocks.u[each]), rows)
        moved = rows @ solution.gauge.all_motion[each]
        out = np.flatnonzero(mirrored[each])
        out = beyond_chance(a, noise, degrees, FALSE_ALARM / len(names), fewest=_FEWEST - 1, moved=moved, out=out)
        for k in out:
            others = with_others(a, out, k)
            away, ratio, chi2, dof, p = (
                value[others == k][0] for value in compared(a[others], noise[others], degrees, moved[others])
            )
            if p < FALSE_ALARM / len(names) and ratio > _ODD:
                name = names[each[k]]
                test = FactorTest(f"departure of {name}", _OTHERS, int(dof), float(chi2), float(dof), float(p))
                found.append((name, ratio, np.linalg.norm(away) / 2, test))  # as `rms_length`
    return sorted(found, key=lambda each: -each[1])
