"""The check of what was believed of the static distortion: do the exposures agree with it, and could they tell?"""

from dataclasses import replace

import numpy as np

from ...exceptions import some_of
from ...results.check import FALSE_ALARM, Check, FactorTest, state_of
from ..knowledge.exposures import ExposureModel, stated
from ..knowledge.reduced_data import drawn, part_of
from ..knowledge.static_test import static_tests

#: So many coefficients, those of exposures drawn at random, are enough for a test.
MOST = 500
#: A test that would not have found a wrong prior with this probability is none.
POWER = 0.95
_MOST_NAMED = 3
_CURE = "dithers by a good part of the field, or a turned camera, test it"
_DOUBT = (
    "look whether it is that of this detector, in its orientation, with its sign; or leave --prior out, or state how "
    "uncertain it is (--static-sigma)"
)


def prior_check(solution, problem, state, *, error):
    """Do exposures agree with the static distortion that was given?

    Parameters
    ----------
    solution : Solution
    problem : Problem
        With the weights that were in force.
    state : State
    error : float
        Typical error of a star, pixels: less matters little.

    Returns
    -------
    Check or None
        None where nothing was stated of a single detector, or where the exposures share its distortion.
    """
    if problem.unknowns.shared or solution.camera.has_focal_plane or problem.degree < 1:
        return None
    if solution.gauge.plane is not None:  # a simpler correction
        return None
    if problem.static_errors is not None and problem.static_errors.knows_nothing:  # nothing is believed
        return None
    if problem.n_exposures < 2:
        given = _given(_source(solution))
        return Check("prior", "unknown", None, None, f"{given} is believed, not tested: there is one exposure", _CURE)
    keep = drawn(problem.detectors, MOST // (2 * problem.n_modes))
    problem, state = part_of(problem, state, keep)
    given, spread, group, first = stated(problem)
    known = np.isfinite(spread.variance).any(axis=1)
    believed = known & (given.any(axis=1) | (spread.variance > 0).any(axis=1))
    if not believed.any():
        return None
    model = ExposureModel.of(problem, state, solution.gauge.all_motion[keep], group)
    tests = static_tests(model, given, spread, [problem.shapes[i] for i in first])
    tests = [(problem.names[i], test) for i, test, known in zip(first, tests, believed, strict=True) if known]
    source = _source(solution)
    return replace(_in_words(source, tests, error), tests=tuple(_factors(source, tests)))


def _source(solution):
    """Where the prior is from, in words; "" if that is not known."""
    prior = solution.settings.prior
    source = prior.get("source") if isinstance(prior, dict) else None
    return (source.get("name") if isinstance(source, dict) else source) or ""


def _given(source):
    return "the static distortion given" + f" ({source})" * bool(source)


def _factors(source, tests):
    """The `FactorTest` of every prior."""
    for name, test in tests:
        name = "static distortion" + f" for {name}" * (len(tests) > 1)
        yield FactorTest(name, source or "prior", len(test.given), test.statistic(), len(test.directions), test.p)


def _in_words(source, tests, error):
    """The check of some priors, each tested and with the name of an exposure that it was given for."""
    given = _given(source)
    p = np.array([test.p for _, test in tests])
    name, worst = tests[int(np.argmin(p))]
    alarm = FALSE_ALARM / len(tests)
    where = f" for {name}" * (len(tests) > 1)
    if p.min() > alarm:
        untested = [name for name, test in tests if test.power(alarm) < POWER]
        if untested:
            where = f" for {some_of(untested, _MOST_NAMED)}" * (len(tests) > 1)
            found = f"{given}{where} is believed, not tested: these exposures could not tell it from a wrong one"
            return Check("prior", "unknown", p.min(), alarm, found, _CURE)
        return Check("prior", "pass", p.min(), alarm, f"{given} agrees with what dithers and rolls show of it")
    found = f"{given}{where} is not what dithers and rolls show, by {worst.rms:.2g} px rms"
    others = worst.better()
    words = min(others, key=others.get)
    if worst.chance(others[words]) > FALSE_ALARM:
        found += f"; {words} it would agree"
    state = state_of(p.min() * len(tests), worst.rms > error)
    return Check("prior", state, p.min(), alarm, found, _DOUBT)
