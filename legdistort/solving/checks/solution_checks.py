"""The checks of a solution: `Solution.checks`.

Their questions: Are the errors right? Do residuals depend on the exposure, the brightness, the place on the detector,
the time? Is the degree too low or too high? Are absolute positions known, and how much of a frame is extrapolated? Was
anything left out? Limits follow from the null distribution of each statistic
(`legdistort.solving.checks.residual_tests`), never from a value that looks large.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from astropy import units as u
from scipy import special

from ...exceptions import some_of
from ...results.check import CERTAIN, FALSE_ALARM, WRONG, Check, state_of
from ...results.errors.header_pointing import CURE as POINTING_CURE
from ...results.gauge import warning_of
from ..terms.observed import Observed
from .camera_check import beside_camera_check, camera_check, contradicted_layout, undetermined
from .cures import camera_first, header_first, with_cost, with_cures
from .dynamic_check import EVIDENCE, dynamic_check, has_static_of_degree, mirrored_check, nights_check, significance
from .extrapolated_maps import extrapolation_check
from .limits import MOST_NAMED, NEGLIGIBLE, SEEN, addition_that_shows, of_chi2
from .prior_check import prior_check
from .reference_check import absolute_by_reference, degree_before_reference, is_told, reference_check
from .residual_tests import Residuals
from .star_checks import overlaps_check, rejection_check, stars_check, unfollowed

#: What else may be behind a check that does not pass.
_CAUSES = dict.fromkeys(("time", "prior"), ("degree",)) | {"chi2": ("exposures", "nights", "place", "time", "degree")}
_CAUSES |= dict.fromkeys(("brightness", "place"), ("degree", "time")) | {"exposures": ("nights", "degree", "time")}
_CAUSES["rejection"] = ("degree",)
_CAUSES["reference"] = "chi2", "degree", "time"
_CAUSES["duplicates"] = "nights", "degree", "time", "place"
#: In this order checks are told.
_ORDER = (
    "chi2", "exposures", "mirrored", "brightness", "place", "time", "degree", "dynamic part", "nights", "prior",
    "reference", "camera", "absolute", "overlaps", "extrapolation", "rejection", "stars", "completeness", "duplicates",
    "header distortion", "header pointing",
)  # fmt: skip
#: What only residuals tell, and what to do where they tell nothing.
_BY_RESIDUALS, _MORE = ("exposures", "place", "time", "degree"), "lower the degree, or add stars or exposures"
_NO_DOF = "no degrees of freedom are left to judge it by"
_PASSES = f"passes (chance, or errors right to {100 * NEGLIGIBLE:.0f} %)"
_TELL_STATIC = "dithers by a good part of the field, or a turned camera, show it"
_HELD_ELSEWHERE = (
    "the common map of positions and distortions is held where the residuals contradict it: a prior of the static "
    "distortion (--prior, with --static-sigma), from which it has less far to go, or a lower --degree"
)
_SAME = 0.5  # correlation of residuals beyond which two exposures are one: no systematic error is so large


def check_solution(solution, *, problem, state, blocks, uncertainty, times, header_distortion=None):
    """All checks of a solution.

    Parameters
    ----------
    solution : Solution
    problem : `legdistort.solving.equations.problem.Problem`
        With the weights that were in force.
    state : State
    blocks : Blocks
    uncertainty : Uncertainty
    times : (ndarray, str)
        Of the exposures, and their unit: see `Matches.times`.
    header_distortion : str, optional
        Distortion of the headers that was not used, in words.

    Returns
    -------
    tuple of Check
    """
    of_map = 0.0 if solution.gauge.tie is None else solution.gauge.tie.freedom  # which `Residuals` takes off itself
    residuals = Residuals(problem, state, blocks, uncertainty.system, solution.dof + of_map)
    judged = partial(_by_residuals, solution, times=times)
    made, explained = judged(residuals), ()
    observed = Observed(problem, state, solution.residuals[problem.order], times[0], solution.sky, solution.camera)
    several = problem.n_exposures > 1  # errors are not found from one
    contradicted = None if observed.detector is None else contradicted_layout(solution, uncertainty.camera)
    has_fields = bool(solution.estimate.table_errors)  # beside which residuals are smaller than errors, and correlated
    may_be = contradicted is None and several and residuals.dof >= 1 and not has_fields
    if may_be and any(check.state in WRONG for check in made.values()):
        made, explained = with_cures(made, solution, residuals, observed, judged)
        made = with_cost(made, residuals)
    made["chi2"] = _of_published(made["chi2"], solution)
    camera = camera_check(
        solution,
        residuals,
        observed,
        camera=uncertainty.camera,
        contradicted=contradicted,
        error=_star_error(residuals),
        judged=partial(_pattern_state, residuals=residuals),
    )
    others = (
        dynamic_check(solution, problem, blocks),
        mirrored_check(solution, problem.detectors),
        nights_check(solution, error=_star_error(residuals)),
        prior_check(solution, problem, state, error=_star_error(residuals)),
        reference_check(solution, camera),
        camera,
        overlaps_check(solution, residuals),
        extrapolation_check(solution, residuals),
        rejection_check(solution),
        stars_check(solution, observed),
        completeness_check(solution, residuals),
        header_check(header_distortion),
        pointing_check(solution, camera),
    )
    made |= {check.name: check for check in others if check is not None}
    made["absolute"] = absolute_check(solution, made)
    made = [made[name] for name in _ORDER if made.get(name) is not None]
    if residuals.dof < 1 or has_fields:
        why, cure = ("random fields of exposures take up such patterns", "") if has_fields else (_NO_DOF, _MORE)
        made = [Check(c.name, "unknown", None, None, why, cure) if c.name in _BY_RESIDUALS else c for c in made]
    if contradicted is not None:  # of residuals that it makes nothing else is told
        wrong = {check.name for check in made if check.state in WRONG} - {"camera"}
        return tuple(replace(c, cure="see camera first, which is the cause") if c.name in wrong else c for c in made)
    made = degree_before_reference(_causes_first(made, explained))
    return header_first(camera_first(made, solution))


def _by_residuals(solution, residuals, *, times):
    """The checks that residuals tell alone, by name."""
    place = place_check(residuals)
    made = (
        errors_check(solution, residuals),
        exposures_check(solution, residuals),
        brightness_check(solution, residuals),
        place,
        time_check(solution, residuals, times),
        degree_check(solution, residuals, shows_static=place.state != "unknown"),
        duplicates_check(solution, residuals),
    )
    return {check.name: check for check in made if check is not None}


def _causes_first(checks, explained):
    """Checks whose cures name those that do not pass either and may be the cause of theirs, but for those explained."""
    wrong = [check.name for check in checks if check.state in WRONG]

    def with_cause(check):
        causes = [name for name in _CAUSES.get(check.name, ()) if name in wrong]
        if not causes or check.name not in wrong or check.name in explained or is_told(check):
            return check
        return replace(check, cure=f"see {' and '.join(causes)} first, which may be the cause; else {check.cure}")

    return tuple(map(with_cause, checks))


def _star_error(residuals, part=0.5):
    """Error that a part of the star positions has at most, pixels; the typical one."""
    v = residuals.blocks.v[:2]
    return float(np.quantile(1 / np.sqrt(v[v > 0]), part)) if np.any(v > 0) else np.nan


def _pattern_state(score, residuals):
    """State of a pattern in the residuals, and words on one that is there but too small to matter.

    It does not matter if the errors of the best sixth of the positions are right to `NEGLIGIBLE` in spite of it.
    """
    least = np.sqrt((1 + NEGLIGIBLE) ** 2 - 1) * _star_error(residuals, 1 / 6)
    state = state_of(score.p, score.rms > _star_error(residuals))
    if state != "pass" and score.rms < least:
        return "pass", f" beyond {score.rms:.2g} px rms, too little to matter"
    return state, ""


def _chi2_at_stated_errors(solution):
    """Weighted squares of the residuals at the errors of the table, without floor or scale."""
    table = solution.residuals
    rows = np.asarray(table["used"])
    x, y, a, b = (table[name][rows].value for name in ("dx", "dy", "x_err", "y_err"))
    c = np.asarray(table["xy_corr"])[rows] if "xy_corr" in table.colnames else np.zeros(len(x))
    square = ((x / a) ** 2 + (y / b) ** 2 - 2 * c * x * y / (a * b)) / (1 - c**2)
    return float(square.sum())


def _errors_in_force(solution):
    """Where errors come from that are not those of the table, in words; "" for these."""
    found, how = solution.diagnostics, solution.settings.errors
    if found.error_law is not None:
        return "errors by brightness found here"
    if found.error_floor:
        here = " found here" if how != "stated" else ""
        return f"errors from a floor of {found.error_floor:.3g} px{here}"
    return f"errors scaled by {found.error_scale:.3g}, found here" if found.error_scale != 1 else ""


def errors_check(solution, residuals):
    """Do residuals scatter as the errors in force lead to expect?"""
    chi2, dof = residuals.chi2 / solution.diagnostics.error_scale**2, residuals.dof
    if solution.estimate.table_errors:  # whose share is in the degrees of freedom of all alone
        chi2, dof = solution.chi2 / solution.diagnostics.error_scale**2, solution.dof
    if dof < 1:
        held = solution.dof - dof
        beside = f" beside {'that' if held == 1 else f'the {held:.0f}'} of the common map that is held" * (held >= 1)
        found = f"no degrees of freedom are left to judge the errors by{beside}"
        return Check("chi2", "unknown", None, None, found, _MORE)
    ratio, whole = chi2 / dof, solution.chi2 / solution.diagnostics.error_scale**2 / solution.dof
    low, high = of_chi2(dof)
    if found := _errors_in_force(solution):
        found += f": chi2/dof {ratio:.3g} with them, {low:.2f} to {high:.2f} {_PASSES}"
        if solution.diagnostics.error_law is None:
            found += f" ({_chi2_at_stated_errors(solution) / solution.dof:.3g} at the stated errors)"
    else:
        found = f"chi2/dof {ratio:.3g} at the stated errors, {low:.2f} to {high:.2f} {_PASSES}"
        if abs(ratio - whole) > 5e-3 * ratio:
            found += f" ({whole:.3g} with what holding the common map leaves in the residuals)"
    if ratio > high:
        state = "fail" if special.chdtrc(dof, ratio * dof) < CERTAIN and ratio > 2 else "warn"
        cure = "errors are too small, or stars move, or the distortion is more complex: see the other checks"
        return Check("chi2", state, ratio, high, found, cure)
    if ratio < low and not solution.diagnostics.correlated:  # weights hold all errors, residuals not what is shared
        return Check("chi2", "warn", ratio, low, found, "errors are too large")
    return Check("chi2", "pass", ratio, high, found)


def _of_published(check, solution):
    """The check chi2 of residuals of the positions and coefficients that are published, the plane where it is."""
    chi2, dof = solution.chi2 / solution.diagnostics.error_scale**2, solution.dof
    if check.state != "pass" or dof < 1 or not chi2 / dof > (most := of_chi2(dof)[1]):
        return check
    state = "fail" if special.chdtrc(dof, chi2) < CERTAIN and chi2 / dof > 2 else "warn"
    return replace(check, state=state, value=chi2 / dof, limit=most, cure=_HELD_ELSEWHERE)


def exposures_check(solution, residuals):
    """Does an exposure scatter more than the others? None where there are no others."""
    names = residuals.problem.names
    if len(names) < 2:
        return None
    scores = residuals.of_groups(residuals.exposure)
    p = np.array([s.p for s in scores])
    squares = np.array([s.t / max(s.nu, 1e-9) for s in scores])
    typical = np.median(squares)
    ratios = np.sqrt(squares / typical) if typical > 0 else np.ones(len(p))
    worst = int(np.argmin(p))
    state = state_of(p[worst], ratios[worst] > 2)
    if state == "pass":
        return Check("exposures", "pass", ratios[worst], None, f"residuals of all {len(names)} exposures are alike")
    order = np.argsort(p, kind="stable")
    found = [f"{names[i]} ({ratios[i]:.3g} times)" for i in order if p[i] <= FALSE_ALARM]
    which, them = ("frames", "them") if len(found) > 1 else ("frame", "it")
    return Check("exposures", state, ratios[worst], None,
                 f"residuals are larger than those of the others in {some_of(found, MOST_NAMED)}",
                 f"look at the {which} (seeing, guiding, clouds), or leave {them} out")  # fmt: skip


def brightness_check(solution, residuals):
    """Are the errors of bright and of faint stars right alike?"""
    table = solution.residuals
    if "flux" in table.colnames:
        key, ends = -np.asarray(table["flux"], dtype=float), ("brightest", "faintest")
    else:
        key, ends = np.hypot(table["x_err"].value, table["y_err"].value), ("most precise", "least precise")
    key = key[residuals.problem.order]
    good = residuals.used & np.isfinite(key)
    if np.ptp(key[good]) == 0 or residuals.dof < 30:
        return None
    edges = np.quantile(key[good], [1 / 3, 2 / 3])
    labels = np.where(good, np.searchsorted(edges, key), -1)
    scores = residuals.of_groups(labels)
    worst = int(np.argmin([s.p for s in scores]))
    s = scores[worst]
    ratios = [np.sqrt(s.t / max(s.nu, 1e-9)) for s in scores]
    usual = np.sqrt(residuals.chi2 / residuals.dof)
    # residuals do not show what neighbouring exposures share, least of all those of bright stars
    limit = (1 + NEGLIGIBLE) * (max(usual, 1.0) if solution.diagnostics.correlated else usual)
    state = state_of(s.p, s.rms > _star_error(residuals)) if ratios[worst] > limit else "pass"
    which = f"the {(ends[0], 'middle', ends[1])[worst]} third of the observations"
    if state == "pass":
        return Check("brightness", "pass", ratios[worst], None, "errors of bright and faint stars are right alike")
    return Check("brightness", state, ratios[worst], None,
                 f"{which} scatters by {ratios[worst]:.3g} times its errors, all of them by "
                 f"{usual:.3g}",
                 "bright stars: --errors floor; faint ones: errors of the measurement are too small")  # fmt: skip


def place_check(residuals):
    """Is there a pattern on the detector that all exposures have in common?"""
    problem = residuals.problem
    n = problem.degree + 2
    groups = problem.detectors[residuals.exposure]
    size = np.array(problem.shapes)[residuals.exposure][:, ::-1].T
    x, y = np.clip(((problem.xy + 0.5) / size * n).astype(int), 0, n - 1)
    score, shown = residuals.of_cells((groups * n + y) * n + x)
    error = _star_error(residuals)
    state, little = _pattern_state(score, residuals)
    if state == "pass" and not shown * (SEEN * error) ** 2 >= addition_that_shows(score.nu):
        found = "a pattern on the detector would go into the stars, these exposures would not show it"
        return Check("place", "unknown", score.rms, error, found, _TELL_STATIC)
    if state == "pass":
        return Check("place", "pass", score.rms, None, f"no pattern in {n} x {n} cells of the detector{little}")
    return Check("place", state, score.rms, error,
                 f"residuals have a pattern of {score.rms:.2g} px rms in {n} x {n} cells of the detector "
                 f"(typical error of a star {error:.2g} px)",
                 "raise --degree, or give a prior of the static distortion")  # fmt: skip


def time_check(solution, residuals, times):
    """Do stars move through the set? Not checked where their motions are fitted, or there is one exposure."""
    if residuals.problem.terms.n or residuals.problem.n_exposures < 2:
        return None
    times, unit = times
    how = "with time" if unit == "days" else "in the order of the exposures"
    cure = "fit the motions of the stars: --motion proper"
    if unit != "days" or np.ptp(times) < 1:
        within = "within one night measured places drift, not stars: --errors correlated counts that"
        cure = within if unit == "days" else f"if years lie between exposures, {cure}; {within}"
    score = residuals.of_motion(times)
    error = _star_error(residuals)
    state, little = _pattern_state(score, residuals)
    if unit == "days" and (common := _in_common(solution, np.ptp(times), error)):
        move = "" if state == "pass" else f", and among themselves by {score.rms:.2g} px rms"
        return replace(common, sentence=common.sentence + move)
    if state == "pass":
        return Check("time", "pass", score.rms, None, f"stars do not move {how}{little}")
    found = f"stars move {how}, by {score.rms:.2g} px rms (typical error of a star {error:.2g} px)"
    if (shared := solution.diagnostics.correlated) and shared.along == "time":
        return Check("time", "pass", score.rms, error, f"{found}; the errors found here count that")
    return Check("time", state, score.rms, error, found, cure)


def _in_common(solution, days, error):
    """The check of a motion that all stars have in common by the reference, which poses take up; None for none.

    `days` from the first exposure to the last, `error` the typical one of a star, pixels.
    """
    tie, reference = solution.gauge.tie, solution.diagnostics.reference
    if tie is None or tie.agreement is None or not tie.agreement.rate > 0 or not tie.agreement.rate_error > 0:
        return None
    move = tie.agreement.rate * days / u.yr.to(u.day)
    state = state_of(special.chdtrc(2, (tie.agreement.rate / tie.agreement.rate_error) ** 2), move > error)
    if state == "pass" or move < np.sqrt((1 + NEGLIGIBLE) ** 2 - 1) * error:
        return None
    name = f"the reference {reference.name}" if reference and reference.name else "the reference"
    found = (
        f"stars of {name} move in common by {move:.2g} px from the first exposure to the last (typical error of a star "
        f"{error:.2g} px), which no residual shows: WCSs of single exposures are off by as much as half of that"
    )
    return Check("time", state, move, error, found, "fit the motions of the stars: --motion proper")


def degree_check(solution, residuals, *, shows_static):
    """Is the degree too low or too high? Of what all exposures have in common that may not show."""
    score, more = residuals.next_degree
    error = _star_error(residuals)
    state, little = _pattern_state(score, residuals)
    if state != "pass":
        return Check("degree", state, score.rms, error,
                     f"degree {more} would explain {score.rms:.2g} px rms more (typical error of a star "
                     f"{error:.2g} px)",
                     f"--degree {more}, or --degree auto")  # fmt: skip
    p = significance(solution, top_only=True)
    if solution.degree > 1 and p > 0.05 and not solution.diagnostics.prior_has_widths:
        lower = "" if has_static_of_degree(solution) else f"--degree {solution.degree - 1}, or "
        return Check("degree", "warn", score.rms, error,
                     f"no exposure has modes of degree {solution.degree} beyond noise", lower + EVIDENCE)  # fmt: skip
    found = f"degree {more} would explain nothing more{little}"
    if not shows_static:
        found += " of what changes between exposures; what they have in common would go into the stars"
        return Check("degree", "unknown", score.rms, error, found, _TELL_STATIC)
    return Check("degree", "pass", score.rms, error, found)


def absolute_check(solution, others):
    """Are absolute positions known, and on what do they rest? With the other checks by name."""
    if solution.gauge.plane is not None:
        return None
    if apart := undetermined(solution):
        return Check("absolute", "unknown", len(solution.stars), 0, f"absolute positions are not known: {apart[0]}",
                     apart[1])  # fmt: skip
    unknown, warning = solution.gauge.unknown_names, warning_of(solution)
    if unknown:
        sentence, _, cure = warning.partition("; ")
        return Check("absolute", "unknown", len(unknown), 0, sentence, cure + _by_headers(solution, unknown))
    error, reference = solution.gauge.absolute_error, others.get("reference")
    known = f"absolute positions are known to {error:.2g} px rms per axis over the stars, their noise aside"
    if "mirrored" in others:
        found = f"{known}, if all exposures had one static distortion, and mirrored ones have another"
        return Check("absolute", others["mirrored"].state, error, None, found, "see mirrored first, which is the cause")
    degree = others.get("degree")
    if degree is not None and degree.state in WRONG and (lost := unfollowed(solution)):
        found = f"{known}, unless those left out ({some_of(lost, MOST_NAMED)}) are right and the degree is too low"
        return Check("absolute", degree.state, error, None, found, "see degree first, which may be the cause")
    if (doubt := absolute_by_reference(reference, solution.gauge.tie, error, known)) is not None:
        return doubt
    return Check("absolute", "pass", error, None, f"{known}; they rest on {_grounds(solution.gauge, others)}")


def _by_headers(solution, unknown):
    """What headers may tell of `unknown` maps if it is said how well, in words: pointings; of a camera a shear too."""
    settings, camera = solution.settings, solution.camera
    if solution.sky is None or settings.pose_sigma is not None or settings.dynamic == "detector":
        return ""
    words = "; or say how well headers know the poses (--pose-sigma shift=PIXELS,rotation=DEGREES)"
    free = camera is not None and camera.headers is not None and settings.layout_sigma is None
    if free and settings.layout in (None, "prior") and unknown == ("shear",):
        words += " or the layout (--layout-sigma shift=PIXELS,rotation=DEGREES)"
    return words


def _grounds(gauge, others):
    """What absolute positions rest on, in words; that which no check has tested is said to be so."""
    grounds = {}
    if gauge.tie is not None:
        grounds["reference"] = "the reference"
    if gauge.static in ("exact", "uncertain"):
        grounds["prior"] = "the static distortion given"
    for name in grounds.keys() & others.keys():
        if others[name].state == "unknown":
            grounds[name] += " (not tested)"
    if gauge.poses_known:
        grounds["poses"] = "the errors stated of the poses"
    return " and ".join(grounds.values()) or "dithers and rolls alone"


def completeness_check(solution, residuals):
    """Does every exposure have the stars that lie on it?"""
    names, found = solution.names, np.diff(residuals.problem.start)
    expected = np.zeros(len(names), dtype=int)
    common = solution.estimate.positions[np.isfinite(solution.estimate.positions[:, 0])]
    for i, name in enumerate(names):
        ny, nx = solution.estimate.shapes[name]
        pose = solution.poses[name]
        q = common @ pose[:, :2].T + pose[:, 2]
        margin = 0.02 * max(nx, ny)
        inside = (q > margin).all(axis=1) & (q < np.array([nx, ny]) - margin).all(axis=1)
        expected[i] = np.count_nonzero(inside)
    share = np.minimum(found / np.maximum(expected, 1), 1)
    usual = np.median(share)
    p = special.bdtr(np.minimum(found, expected), expected, usual) * len(names)
    i = int(np.argmin(np.where(share < usual / 2, p, 1)))
    low, high = (f"{each:.0%}" for each in (share.min(), share.max()))
    words = f"exposures have {low if low == high else f'{low} to {high}'} of the stars that lie on them"
    if share[i] < usual / 2 and p[i] < FALSE_ALARM:
        words = f"{names[i]} has {found[i]:.0f} of the {expected[i]:.0f} stars that lie on it, others {usual:.0%}"
        return Check("completeness", "warn", share[i], usual / 2, words, "look at the frame (trailed, clouds, focus)")
    return Check("completeness", "pass", share.min(), usual / 2, words)


def duplicates_check(solution, residuals):
    """Do two exposures have the same noise?"""
    if len(solution.names) < 2 or len(solution.names) > 2000:
        return None
    names, (correlation, number) = solution.names, residuals.correlations()
    i, j = np.triu_indices(len(names), 1)
    value, free = correlation[i, j], np.maximum(number[i, j] - 3, 0)
    if not np.any(free):
        return Check(
            "duplicates", "unknown", None, None, "no star is in enough exposures to tell their noise", "add exposures"
        )
    z = (np.arctanh(np.clip(value, -0.999999, 0.999999)) - np.arctanh(_SAME)) * np.sqrt(free)
    same = np.flatnonzero(len(z) * special.ndtr(-z) < FALSE_ALARM)
    if not len(same):
        return Check("duplicates", "pass", np.max(value[free > 0]), _SAME, "no two exposures have the same noise")
    same = same[np.argsort(-z[same], kind="stable")]
    noise = min(1.0, residuals.chi2 / residuals.dof) if residuals.dof > 0 else 1.0
    for worst in same[:MOST_NAMED]:
        square, n = residuals.difference(i[worst], j[worst])
        if square < _SAME * noise * n and special.chdtr(n, square / noise) < FALSE_ALARM:
            return Check("duplicates", "fail", value[worst], _SAME,
                         f"residuals of {names[i[worst]]} and {names[j[worst]]} are the same "
                         f"(correlation {value[worst]:.2f})", "leave one of them out")  # fmt: skip
    shared = some_of([names[k] for k in np.unique([i[same], j[same]])], MOST_NAMED)
    found = f"residuals of {shared} have a pattern in common, beyond their noise (correlation {value[same[0]]:.2f})"
    if (counted := solution.diagnostics.correlated) and counted.along:
        return Check("duplicates", "pass", value[same[0]], _SAME, f"{found}; the errors found here count that")
    cure = "exposures that are close in time or place share a distortion or errors of the measurement: "
    return Check("duplicates", "warn", value[same[0]], _SAME, found, f"{cure}--errors correlated counts that")


def pointing_check(solution, camera=None):
    """Do headers say that exposures lie otherwise to each other than the stars have them? None where none does.

    Beside the check of the `camera`, if there is one, by which headers have detectors elsewhere, what each of the two
    compares is said, and what tells which is right.
    """
    pointing = solution.diagnostics.pointing
    if pointing is None or not (words := pointing.sentence):
        return None
    n = len(pointing.off) + sum(map(len, pointing.groups)) + len(pointing.detectors)
    by_headers = solution.sky is not None and solution.diagnostics.sky == "exposures" and solution.gauge.tie is None
    state = "fail" if pointing.is_undecided and by_headers else "warn"
    words += beside_camera_check(solution, camera)
    return Check("header pointing", state, float(n), 0.0, words, POINTING_CURE)


def header_check(header_distortion):
    """Do headers know a distortion that was not used?"""
    if not header_distortion:
        return Check("header distortion", "pass", None, None, "no distortion of the headers was left unused")
    return Check("header distortion", "warn", None, None, f"the headers have a distortion that was not used: "
                 f"{header_distortion}", "--prior header takes it as the static distortion")  # fmt: skip
