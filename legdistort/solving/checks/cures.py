"""Cures of checks that do not pass, tried on the residuals at hand before they are named.

What would be left of the residuals with an effect fitted, with other errors or with a higher degree is judged by the
same checks; the first cure that brings a check to pass is its cure, with the figure that it would reach.
"""

import re
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

from ...cameras.star_scales import flux_levels
from ...cameras.stated_errors import undetermined_degree
from ...geometry import basis
from ...results.check import FALSE_ALARM, STATES, WRONG
from ...results.diagnostics import ErrorLaw, filled
from ..terms.turbulence import can_be_found
from .known_effects import MOTIONS, SHARE, STATICS, effects_in
from .residual_tests import in_cells
from .smooth_fields import smooth_fields

#: Part of what chi2 is too large by that an effect must explain to be named as its reason.
REASON = 0.3
#: Degrees beyond that of the fit that are tried.
HIGHER = 4
#: Stars for every mode that make a degree worth a trial, and observations a law of errors takes.
_STARS, _FEWEST = 2, 20
#: Part of their variance that combinations of a higher degree must keep to be fitted: those that the stars nearly hide
#: take up much of turbulence.
_FITTED = 1e-6
#: Figure of chi2/dof beyond which it is not foretold to 5 %: the higher degree itself bends what the lower one fitted.
_EXACT = 1.25
#: Numbers of the modes of a degree up to which they are fitted on trial.
_VALUES = 30_000_000
#: chi2/dof below which a higher degree may cost more than it gains: errors of positions grow with its coefficients.
_MILD = 1.5
_COST = (
    "; a higher degree has more coefficients, with which errors of positions grow, which chi2 does not weigh: compare "
    "the errors of both"
)
_WOULD = {"pass": "this check would pass", "unknown": "this check would be unknown", "warn": "this check would warn"}
#: Checks whose value is an rms, and those that smooth fields of single exposures may be behind.
_RMS = "place", "time", "degree"
_OF_ERRORS = "chi2", "brightness"
_BY_FIELDS = "chi2", "brightness", "degree"
#: Those that a static distortion of too low a degree fails, and what they say of it.
_BY_DEGREE = "degree", "place"
_STATIC = "; what is missing is alike in all exposures of a detector (static)"
#: Those that too low a degree for the camera fails, the one that has the words first.
_OF_DEGREE = "degree", "chi2", "reference", "rejection", "exposures", "camera"
#: What a static distortion that is hardly determined, or none, may be behind.
_OF_DISTORTION = {"chi2", "brightness", "place", "degree", "reference", "overlaps", "extrapolation"}


def with_cures(checks, solution, residuals, observed, judged):
    """Checks of residuals with the names of what displaces stars, and with cures that cure.

    Parameters
    ----------
    checks : dict
        ``{name: Check}`` of the residuals.
    solution : Solution
    residuals : Residuals
    observed : `legdistort.solving.terms.observed.Observed`
    judged : callable
        ``judged(residuals)`` makes these checks of other residuals.

    Returns
    -------
    checks : dict
    explained : set of str
        Those that do not pass for a reason that they name.
    """
    static = _static_modes(observed) if solution.settings.static == "fit" else None
    if static is not None and any(checks[name].state in WRONG for name in _BY_DEGREE):
        higher, ends, after = _higher_degree(residuals, static)
        if ends and judged(after)["chi2"].state not in WRONG:  # then it is the degree and no more
            return _with_static_degree(checks, _or_layout(solution, higher))
    effects = effects_in(residuals, observed, solution.estimate.uncertainty.camera)
    checks, explained = _named(checks, effects, judged, static=solution.settings.static)
    wrong = [name for name, check in checks.items() if check.state in WRONG and name not in explained]
    if not wrong:
        return checks, explained
    cure, cured = _errors_cure(wrong, solution, residuals, observed, judged)
    left, higher, ends = effects[-1].left if effects else residuals, "", False
    if set(wrong) == cured:  # tests that compare places, times and degrees take errors to be right but for a factor
        checks |= {name: replace(checks[name], cure=cure) for name in wrong}
        explained |= cured
    elif "degree" in wrong and residuals.next_degree[0].p <= FALSE_ALARM:
        higher, ends, after = _higher_degree(left, static)
        checks["degree"] = replace(
            checks["degree"], sentence=checks["degree"].sentence + _STATIC * bool(static and ends)
        )
        rest = "" if ends else cure or "--errors floor counts the rest"
        found = solution.settings.errors != "stated"
        checks["degree"] = _with_degree(checks["degree"], higher, rest, counted=found)
        explained |= {*_OF_ERRORS, "degree"} & {*wrong} if higher else set()
    checks |= {
        name: replace(checks[name], cure=higher or cure) for name in _OF_ERRORS if name in wrong and higher + cure
    }
    if ends and judged(after)["chi2"].state not in WRONG:  # then it is the degree and no more
        return checks, explained
    # what a higher degree explains of a static distortion is no smooth field of single exposures
    fields = smooth_fields(after if static is not None and higher else left)
    own = without_static(solution) if solution.settings.static == "fit" and observed.detector is None else ""
    found = observed.detector is None and not solution.settings.terms and can_be_found(observed.problem)
    concerned = [name for name in wrong if name in _BY_FIELDS]
    return checks | {name: _with_fields(checks[name], fields, own, found) for name in concerned}, explained


def with_cost(checks, residuals):
    """Checks of errors that name a higher degree with what it costs, where chi2 is little too large; `Residuals`."""
    if residuals.chi2 > _MILD * residuals.dof:
        return checks
    named = [name for name in _OF_ERRORS if name in checks and checks[name].cure.startswith("--degree ")]
    return checks | {name: replace(checks[name], sentence=checks[name].sentence + _COST) for name in named}


def _with_static_degree(checks, higher):
    """Checks that a higher degree of the static distortion brings to pass, with it as their cure, and their names."""
    names = {name for name in (*_OF_ERRORS, *_BY_DEGREE) if name in checks and checks[name].state in WRONG}
    sentences = {name: checks[name].sentence + _STATIC * (name in _BY_DEGREE) for name in names}
    return checks | {name: replace(checks[name], sentence=sentences[name], cure=higher) for name in names}, names


def _or_layout(solution, higher):
    """The cure by a higher degree of static distortions, and by the layout, if that is held: a wrong one bends them."""
    errors = solution.estimate.uncertainty.camera
    if len(solution.camera.detectors) < 2 or errors is None or errors.free[:, :, :3].any():
        return higher
    if solution.settings.layout == "hold":
        words = "--layout fit in place of --layout hold, if the layout may be wrong (static distortions bend for it)"
        return f"{words}; else {higher}"
    return f"{higher}; first --layout fit, if the layout may be wrong (static distortions bend for it)"


def without_static(solution):
    """The cure where exposures have distortions of their own, and one was fitted to all."""
    degree = solution.settings.exposure_degree + 1
    higher = f", or let exposures have more of their own: --exposure-degree {degree}" * (degree < solution.degree)
    return f"leave --static fit out, which fits one distortion to all exposures{higher}"


def _named(checks, effects, judged, *, static):
    """Checks that name the effects which explain why they do not pass, and the names of these checks."""
    reasons, before = {}, checks
    for effect in effects:
        after = judged(effect.left)
        for name in before.keys() & after.keys():
            if _is_better(after[name], before[name]):
                reasons.setdefault(name, []).append((effect, after[name]))
        before = before | after
    checks = dict(checks)
    moving = checks["time"].cure if "time" in checks else ""
    for name, found in reasons.items():
        words = "; ".join(f"{each.words}, by {each.rms:.2g} px rms" for each, _ in found)
        last = found[-1][1]
        reached = f"chi2/dof would be {last.value:.2f}" if name == "chi2" else _WOULD[last.state]
        cures = {MOTIONS: moving} | ({STATICS: "raise --degree"} if static == "fit" else {})
        cure = "; ".join(cures.get(each.effect, each.effect.cure) for each, _ in found)
        check = checks[name]
        checks[name] = replace(check, sentence=f"{check.sentence}; {words}: without that {reached}", cure=cure)
    return checks, set(reasons)


def _is_better(after, before):
    """Whether what was taken off is a reason for a check that does not pass."""
    if before.state not in WRONG:
        return False
    if before.name == "chi2":
        return before.value - after.value > REASON * (before.value - 1)
    if before.name in _RMS and after.value**2 > (1 - REASON) * before.value**2:
        return False
    return STATES.index(after.state) < STATES.index(before.state)


def _with_fields(check, fields, cure, can_be_term):
    """A check that names smooth fields, if they are a reason for what it found, with a cure if there is one."""
    if not fields.are_there or (check.name == "chi2" and fields.share * check.value < SHARE * (check.value - 1)):
        return check
    words = "neighbouring stars of an exposure are displaced alike, in every exposure in another way (turbulence"
    words += ", which --term turbulence finds), by " if can_be_term else "), by "
    return replace(check, sentence=f"{check.sentence}; {words}{fields.rms:.2g} px rms", cure=cure or check.cure)


def _static_modes(observed):
    """Modes of the static distortion of detectors: a function of a first and a last degree that gives their columns.

    The columns are those of `Residuals.of_columns`; residuals of one place on a detector are alike in all exposures
    but for what the stars, which are elsewhere on it in every exposure, take up of them.
    """
    problem = observed.problem
    detector = problem.detectors[problem.exposure] if observed.detector is None else observed.detector

    def columns(first, last):
        modes = basis.values(last, *observed.place)[basis.n_modes(first - 1) :]
        return in_cells(detector, (modes[:, None, None] * np.eye(2)[:, :, None]).reshape(-1, 2, modes.shape[1]))

    return columns


def _higher_degree(residuals, static=None):
    """The lowest degree after which one more explains nothing.

    Parameters
    ----------
    residuals : Residuals
    static : callable, optional
        `_static_modes`, where a static distortion is fitted: the higher degree is one of that then, and not of every
        exposure by itself.

    Returns
    -------
    str
        In words; "" where the stars allow none.
    bool
        Whether they allow that one.
    Residuals
        What it leaves.
    """
    problem = residuals.problem
    stars = np.bincount(residuals.exposure[residuals.used], minlength=problem.n_exposures).min()
    # what a solve would reach is told, what surely shows decides
    best, left, told = "", residuals, residuals
    if static is not None and not problem.unknowns.shared:
        # the lower degrees of a camera are no unknowns of the problem, and are counted already
        lower = static(1, max(problem.degree, 1))
        if _fits(residuals, lower):
            told = residuals.without(lower, rank=_FITTED)._with(dof=residuals.dof)
    for degree in range(problem.degree + 1, problem.degree + 1 + HIGHER):
        if stars < _STARS * basis.n_modes(degree):
            break
        best = best or f"--degree {degree}"
        columns = left.modes_of(degree) if static is None else static(degree, degree)
        if not _fits(residuals, columns):
            break
        told = told.without(columns, rank=_FITTED)
        after = left.without(columns) if static is None else told
        if after.dof < 1 or told.dof < 1:
            break
        reached, left = told.chi2 / told.dof, after
        best = f"--degree {degree} would bring chi2/dof to "
        best += f"{reached:.2f}" if reached < _EXACT else f"about {reached:.2g}"
        more = left.of_degree(degree + 1) if static is None else left.of_columns(static(degree + 1, degree + 1))[0]
        if more.p > FALSE_ALARM:
            return best, True, left
    return best, False, left


def _fits(residuals, columns):
    """Whether columns are few enough to be fitted on trial."""
    return 2 * len(residuals.used) * columns[0].shape[1] <= _VALUES


def _with_degree(check, higher, rest, *, counted):
    """The check of the degree with a higher one as its cure, and one of the rest that this leaves.

    Where the stars allow none, errors that are the scatter of the residuals have `counted` it.
    """
    if counted and not higher:
        return replace(check, state="pass", sentence=f"{check.sentence}; the errors found here count that", cure="")
    rest = rest and f"no degree that the stars allow ends it: {rest}"
    return replace(check, cure="; ".join(filter(None, (higher, rest))))


def _errors_cure(wrong, solution, residuals, observed, judged):
    """The simplest errors with which residuals scatter as they lead to expect.

    Returns
    -------
    str
        In words, with the figure that they would reach; "" if nothing is wrong with the errors, or none are better.
    set of str
        Checks of those that are wrong that would pass.
    """
    if residuals.dof < 1 or not any(name in _OF_ERRORS for name in wrong):
        return "", set()
    tried = []
    for name, factor in _other_errors(solution, residuals, observed):
        after = judged(residuals.at_errors(factor))
        left = [after[each] for each in _OF_ERRORS if each in after and after[each].state in WRONG]
        cured = {each for each in wrong if each in after and after[each].state not in WRONG}
        off = max((abs(np.log(check.value)) for check in left), default=0.0)
        tried.append((len(left), off, f"--errors {name} would bring chi2/dof to {after['chi2'].value:.2f}", cured))
        if not left:
            break
    return min(tried, key=lambda each: each[:2])[2:] if tried else ("", set())


def _other_errors(solution, residuals, observed):
    """Names of errors that `legdistort.solve` finds, and what they multiply those in force by, (n,); simplest first."""
    squares, free, dof = residuals.squares, residuals.freedom, residuals.dof
    errors, in_force = solution.settings.errors, solution.diagnostics.error_scale
    w = residuals.problem.weight[:2].mean(axis=0)
    variance = 1 / np.where(residuals.used, w, 1)
    square = residuals.chi2 / dof
    alike = {}
    if errors == "stated" and square > 0:
        alike["scale"] = np.full(len(w), np.sqrt(square))
    if errors in ("stated", "scale") and square > 1:

        def left(log):  # of chi2, with a floor, over its degrees of freedom
            return np.sum(squares * variance / (variance + np.exp(2 * log))) / dof - 1

        top = np.log(residuals.chi2 * variance.max() + variance.max()) / 2
        alike["floor"] = np.sqrt(1 + np.exp(2 * brentq(left, top - 30, top)) / variance) / in_force
    yield from sorted(alike.items(), key=lambda each: round(np.mean(free * np.log(each[1])), 3))  # the likelier first
    if errors == "by-brightness" or "flux" not in observed.table.colnames:
        return
    flux = np.asarray(observed.table["flux"], dtype=float)
    known = residuals.used & (flux > 0) & np.isfinite(flux) & (free > 0.1)
    if np.count_nonzero(known) < _FEWEST:
        return
    problem = residuals.problem
    levels = flux_levels(problem.exposure, problem.star, flux, len(problem.names))
    measured = (squares / np.maximum(free, 0.1) * variance)[known]
    law, of_exposure, level = ErrorLaw.likelier(flux[known], measured, problem.exposure[known], levels)
    level = level[problem.exposure]
    sigma = law.sigma(filled(flux, level) * level) * of_exposure[problem.exposure]
    factor = sigma / np.sqrt(variance)
    yield "by-brightness", factor * np.sqrt(np.sum(squares / factor**2) / dof) / in_force


def header_first(checks):
    """Checks whose cures begin with the distortion of headers, where these exposures hardly determine theirs."""
    wrong = {check.name for check in checks if check.state in WRONG}
    loose = [name for name in ("overlaps", "extrapolation") if name in wrong]
    if "header distortion" not in wrong or not loose:
        return checks

    def with_header(check):
        if check.name not in wrong & _OF_DISTORTION:
            return check
        return replace(check, cure=f"--prior header (see header distortion and {loose[0]}); else {check.cure}")

    return tuple(map(with_header, checks))


def camera_first(checks, solution):
    """Checks that do not pass, the degree at which the camera was found first, if that of the exposures is lower."""
    degree, each = undetermined_degree(solution.camera), {check.name: check for check in checks}
    first = next((name for name in _OF_DEGREE if name in each and each[name].state in WRONG), None)
    if degree <= solution.degree or first is None:
        return checks
    why = f"; exposures of degree {solution.degree} cannot take over what the camera, found with degree {degree}, has "
    why += "of a map that all exposures share, which was not determined"
    each[first] = replace(each[first], sentence=each[first].sentence + why, cure=f"--degree {degree}")
    for name, check in each.items():
        if name != first and check.state in WRONG:
            rest = re.sub(r"^see [\w ]+ first, which may be the cause(; else )?", "", check.cure)
            cure = f"see {first} first, which may be the cause" + (rest and f"; else {rest}")
            each[name] = replace(check, cure=cure)
    return tuple(each.values())
