"""The check of a reference catalogue: do its stars agree with the exposures, is it bent, and would that have shown?"""

import re
from dataclasses import replace

import numpy as np
from scipy import special

from ...exceptions import some_of
from ...results.check import FALSE_ALARM, WRONG, Check, FactorTest, state_of
from ...results.errors.catalogue_tie import HARMLESS
from .known_effects import LAYOUT, STATICS
from .limits import GROSS_ERRORS, MOST_NAMED, NEGLIGIBLE, SEEN, as_one, of_chi2

#: Degrees of freedom that tell whether the errors of a reference are right.
_FEWEST = 10
#: Part of what is uncertain of a map that a reference must take away to tie it.
_TIED = 0.1
#: What to do about offsets that are larger than expected.
_OFFSETS = (
    "if it is of another year and without proper motions, --reference-error found, or errors that contain the years "
    "times a usual motion; else look at its errors and their unit, and its epoch (ref_epoch)"
)
#: Cures of the camera that residuals call for, and what is said of one before the others.
_OF_DETECTORS = LAYOUT.cure, STATICS.cure
_CALLED_FOR = "first, which the residuals call for"
_THEN = "if the reference does not agree then"
_STATICS = "; else --static fit, which finds the distortions of single detectors"
#: Checks whose cure may be a higher degree.
_OF_DEGREE = "degree", "chi2", "brightness", "place"
#: What to do about a plane that has not settled.
_NEARER = (
    "a prior of the static distortion (--prior), from which the plane has less far to go, or more of its stars; else "
    "leave it out"
)
_TESTED = "more of its stars, dithers by a good part of the field, {}or a prior test it"
#: Rolls [degrees] from which on to turn the camera is no news.
_TURNED = 10.0


def reference_check(solution, camera=None):
    """Does a reference agree with the exposures? None without one.

    Parameters
    ----------
    solution : Solution
    camera : Check, optional
        Of what was taken as exact of the detectors: residuals that say what is wrong with that say why the reference
        does not agree, and its cure comes first.
    """
    tie, label = solution.gauge.tie, solution.diagnostics.reference
    if tie is None or tie.agreement is None:
        return None
    made, source = tie.agreement, label.name if label and label.name else "reference"
    n = 2 * int(np.count_nonzero(tie.used))
    tests = (
        FactorTest.of_chi2("reference: positions", source, n, made.chi2, made.dof),
        FactorTest.of_chi2("reference: map", source, n, made.bend_chi2, made.bend_dof),
    )
    check = _in_words(solution, tie, label)
    if check.state in WRONG and camera is not None and camera.state in WRONG and camera.cure in _OF_DETECTORS:
        rest = check.cure.replace(_STATICS, "")
        check = replace(check, cure=f"{camera.cure} {_CALLED_FOR} (see camera); {_THEN}: {rest}")
    return replace(check, tests=tests)


def is_told(check):
    """Whether the cure of a check begins with one of the camera that residuals call for."""
    return _CALLED_FOR in check.cure


def degree_before_reference(checks):
    """Checks of which that of a reference names the higher degree first that the residuals call for, if they do.

    Exposures of too low a degree bend the stars against it as a bent reference does.
    """
    each = {check.name: check for check in checks}
    check = each.get("reference")
    if check is None or check.state not in WRONG or is_told(check):
        return checks
    wrong = [each[name] for name in _OF_DEGREE if name in each and each[name].state in WRONG]
    found = [(c.name, m.group()) for c in wrong if (m := re.search(r"--degree \d+(?= would bring)", c.cure))]
    if not found:
        return checks
    name, degree = found[0]
    rest = re.sub(r"^see [\w ]+ first, which may be the cause; else ", "", check.cure)
    sentence = f"{check.sentence}; too low a degree of the exposures may be the cause"
    told = replace(check, sentence=sentence, cure=f"{degree} {_CALLED_FOR} (see {name}); {_THEN}: {rest}")
    return tuple(told if c is check else c for c in checks)


def absolute_by_reference(check, tie, error, known):
    """The check of absolute positions that a reference determines, where its own says that they do not hold; else None.

    Parameters
    ----------
    check : Check or None
        Of the reference.
    tie : Tie or None
    error : float
        Of absolute positions, pixels.
    known : str
        The same in words.
    """
    if check is None or check.state not in WRONG:
        return None
    if (factor := _departure(check, tie)) is not None:
        found = f"{known}, by errors that stars of the reference contradict: they are off by {factor:.2g} times these"
        return Check("absolute", check.state, error * factor, error, found, "see reference, whose cure it is")
    if check.state != "fail":
        return None
    found = f"{known}, if the reference is right, which fails the check of that name"
    return Check("absolute", "fail", error, None, found, "see reference first, which is the cause")


def _departure(check, tie):
    """How many times their errors the offsets of stars of a reference are; None for no more than chance.

    Of a `Tie` that took errors of the reference larger than stated, absolute errors contain that factor, and what
    contradicts them is a bend.
    """
    if not check.tests:
        return None
    positions, bend = check.tests
    far = [bend] + [positions] * (tie.factor == 1)
    far = [each for each in far if each.dof >= 1 and each.p < FALSE_ALARM and each.chi2 > each.dof]
    return float(np.sqrt(max(each.chi2 / each.dof for each in check.tests if each.dof >= 1))) if far else None


def _in_words(solution, tie, label):
    """The check without its tests."""
    made, name = tie.agreement, f"the reference {label.name}" if label and label.name else "the reference"
    ratio = np.sqrt(made.chi2 / made.dof) if made.dof >= _FEWEST else np.nan
    judges = (_unsettled, _bend) if made.cure else (_unsettled, _scatter, _mismatches, _bend)
    wrong = as_one(judge(name, tie, ratio, solution) for judge in judges)
    if wrong is not None:
        return wrong
    told, error = np.isfinite(ratio), _error(solution)
    agrees = f"stars of {name} do not contradict the exposures"
    if told:
        agrees = f"stars of {name} agree with the exposures (offsets {ratio:.2g} times the errors of both)"
    ties = np.any(tie.measured[1:] > _TIED)
    untested = [] if told or tie.found else [f"its errors (of {np.count_nonzero(tie.used)} stars) are believed"]
    if ties and not made.unseen <= SEEN * error:
        least = f" by less than {made.unseen:.2g} px rms" if np.isfinite(made.unseen) else ""
        untested.append(f"that it is not bent{least} is believed")
    if untested:
        found = f"{agrees}; {' and '.join(untested)}, not tested"
        return Check("reference", "unknown", made.unseen, SEEN * error, found, _missing(solution.poses.values()))
    bent = f"; a bend of {made.unseen:.2g} px rms would show" if ties else "; they tie shift, rotation and scale alone"
    return Check("reference", "pass", ratio, None, agrees + bent)


def _missing(poses):
    """What would test the shape of a reference beside what exposures with these poses (2, 3) have: a turned camera."""
    angles = np.array([np.arctan2(pose[1, 0], pose[0, 0]) for pose in poses])
    rolls = np.degrees(np.abs(np.angle(np.exp(1j * (angles - angles[0])))))
    return _TESTED.format("" if rolls.max() > _TURNED else "a turned camera, ")


def _error(solution):
    """Typical absolute error of a star, pixels."""
    errors = np.stack([solution.stars[f"{axis}_err_abs"].value for axis in "xy"])
    return float(np.sqrt(np.nanmedian(errors**2))) if np.isfinite(errors).any() else np.inf


def _unsettled(name, tie, ratio, solution):
    """Does the plane lie where it puts it?"""
    if not tie.unsettled:
        return None
    state = "warn" if tie.unsettled < HARMLESS else "fail"
    found = f"the tie to {name} has not settled: its last round moved the plane by {tie.unsettled:.2g} of its errors"
    return Check("reference", state, tie.unsettled, HARMLESS, found, _NEARER)


def _scatter(name, tie, ratio, solution):
    """Are the errors that it states right?"""
    made = tie.agreement
    if tie.found or not np.isfinite(ratio):
        return None
    low, high = of_chi2(made.dof)
    if low <= ratio**2 <= high:
        return None
    found = f"offsets of stars from {name} are {ratio:.2g} times what the errors of both lead to expect"
    if ratio**2 < low:
        return Check("reference", "warn", ratio, np.sqrt(low), f"{found}: its errors are smaller than it states",
                     "--reference-error found")  # fmt: skip
    state = state_of(special.chdtrc(made.dof, made.chi2), ratio**2 > 2)
    state = "warn" if state == "pass" else state
    if tie.factor != 1:
        found += f"; its errors were taken {tie.factor:.2g} times as large"
    if np.isfinite(made.years):
        when = "later" if made.years > 0 else "earlier"
        return Check("reference", state, ratio, np.sqrt(high),
                     f"{found}; they agree with epochs that are {abs(made.years):.2g} years {when}",
                     "look at its epoch (ref_epoch) and that of the exposures (--epoch)")  # fmt: skip
    counted = "" if tie.factor == 1 else "absolute errors contain this factor; "
    return Check("reference", state, ratio, np.sqrt(high), found, counted + _OFFSETS)


def _mismatches(name, tie, ratio, solution):
    """Are many of its stars elsewhere?"""
    n, out = len(tie.used), np.count_nonzero(~tie.used)
    lost = some_of(tie.rejected, MOST_NAMED)
    if not out or special.bdtrc(out - 1, n, GROSS_ERRORS) > FALSE_ALARM:
        return None
    return Check("reference", "warn", out / n, GROSS_ERRORS,
                 f"{out} of {n} stars of {name} lie elsewhere in it: {lost}",
                 "mismatches, binaries, or fast stars without a proper motion: look at these")  # fmt: skip


def _bend(name, tie, ratio, solution):
    """Is it bent against what exposures and the prior know?"""
    made = tie.agreement
    if not made.cure and (not made.is_bent or made.bend < NEGLIGIBLE * _error(solution)):
        return None
    by = f" by {made.bend:.2g} px rms" if np.isfinite(made.bend) else ""
    if len(solution.names) == 1 and not solution.diagnostics.prior_has_widths:
        return Check("reference", "unknown", made.bend, None,
                     f"the distortion that {name} gives {solution.names[0]} differs{by} from the static one given: one "
                     "exposure does not tell whether it departs from that, as exposures do, or the reference is bent",
                     "state how far single exposures scatter (--prior-sigma); legdistort nights finds it")  # fmt: skip
    found = f"{name} is bent against what the exposures show{by}"
    if made.cure:
        return Check(
            "reference",
            "fail",
            made.bend,
            None,
            f"{found}; with a map of its own, of degree {made.cure}, it agrees with them",
            f"--reference-degree {made.cure}, if it is the reference that is bent{_otherwise(solution)}",
        )
    more = np.sqrt(made.bend_chi2 / made.bend_dof)
    return Check("reference", state_of(made.p), made.bend, None, f"{found} ({more:.2g} times the errors of both)",
                 f"its positions have a distortion of their own: leave it out{_otherwise(solution)}")  # fmt: skip


def _otherwise(solution):
    """What else to do where a reference and the exposures contradict each other, in words; empty for nothing."""
    camera, errors = solution.camera, solution.estimate.uncertainty.camera
    if camera.has_focal_plane and (errors is None or not errors.free[:, :, 3:].any()):
        return _STATICS
    if camera.has_focal_plane or solution.gauge.static not in ("exact", "uncertain"):
        return ""
    return "; else leave out the static distortion given, which is not that of these exposures"
