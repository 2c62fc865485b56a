"""The check of a camera: do its detectors lie, and distort, as was stated of them, and would that have shown?"""

import numpy as np

from ...results.check import WRONG, Check, FactorTest, state_of
from .known_effects import DEPARTURES, LAYOUT, STATICS
from .limits import SEEN, addition_that_shows, as_one

#: Columns of the detectors, and their values for all stars, up to which they are looked at.
_MOST_COLUMNS, _MOST_VALUES = 1000, 30_000_000
_TELL = "dithers larger than the gaps, which carry stars from one detector to the others, test it"


def camera_check(solution, residuals, observed, *, camera, error, judged):
    """Do exposures agree with what was stated of the detectors of a camera? None for a single one.

    Parameters
    ----------
    solution : Solution
    residuals : Residuals
    observed : Observed
    camera : `legdistort.results.errors.camera_errors.CameraErrors` or None
        Of what was fitted.
    error : float
        Typical error of a star, pixels.
    judged : callable
        ``judged(score)``: its state, and words on what is there but too small to matter.
    """
    if observed.detector is None or residuals.dof < 1:
        return None
    free = np.zeros(1, dtype=bool) if camera is None else camera.free.any(axis=(0, 1))
    held = {LAYOUT: not free[:3].any(), STATICS: not free[3:].any()}
    held = [effect for effect, is_held in held.items() if is_held]
    stated = _stated(solution, camera and camera.departure)
    return as_one([_held(held, solution.camera.name, residuals, observed, error, judged), stated])


def _held(effects, name, residuals, observed, error, judged):
    """The check of what was taken as exact of the detectors; None for nothing, or too many of these."""

    def tried(effect):
        columns = effect.columns(observed)
        n = columns[0].shape[1]
        too_many = n > _MOST_COLUMNS or 2 * n * residuals.problem.n_stars > _MOST_VALUES
        return None if too_many else residuals.of_columns(columns)

    tests = {effect: test for effect in effects if (test := tried(effect)) is not None}
    if not tests:
        return None
    words = {LAYOUT: "the layout", STATICS: "the static distortions"}
    given = f"{' and '.join(words[effect] for effect in tests)} that were given of the detectors"
    factors = tuple(FactorTest(effect.name, name, round(score.nu), score.t, score.nu, score.p)
                    for effect, (score, _) in tests.items())  # fmt: skip
    states = [(score.p, *judged(score)) for score, _ in tests.values()]
    _, state, little = min(states)
    if state in WRONG:  # or it moves from exposure to exposure, which looks like it
        moving = tried(DEPARTURES)
        costs = {effect: residuals.cost(test[0]) for effect, test in {**tests, DEPARTURES: moving}.items() if test}
        cause = min(costs, key=costs.get)
        rms = (tests | {DEPARTURES: moving})[cause][0].rms
        found = f"exposures do not agree with {given}, by {rms:.2g} px rms: {cause.found}"
        return Check("camera", state, rms, error, found, cause.cure, factors)
    if not all(shown * (SEEN * error) ** 2 >= addition_that_shows(score.nu) for score, shown in tests.values()):
        return Check("camera", "unknown", None, None, f"{given} are believed, not tested", _TELL, factors)
    return Check("camera", "pass", None, None, f"exposures agree with {given}{little}", tests=factors)


def _stated(solution, departure):
    """The check of what was stated of the detectors with its widths; None for nothing."""
    if departure is None:
        return None
    name = solution.camera.name
    given = f"what was stated of the detectors of {name}"
    factors = (FactorTest.of_chi2("detectors as stated", name, departure.rows, departure.chi2, departure.dof),)
    if departure.dof < 1:
        return Check("camera", "unknown", None, None, f"{given} is believed, not tested", _TELL, factors)
    ratio = np.sqrt(departure.chi2 / departure.dof)
    state = state_of(factors[0].p)
    found = f"detectors depart from {given} by {ratio:.2g} times its uncertainty"
    if state in WRONG:
        return Check("camera", state, ratio, None, f"{found}, above all {departure.detector}",
                     "look at the camera file (layout_sigma, static_sigma), or --layout fit, --static fit",
                     factors)  # fmt: skip
    return Check("camera", "pass", ratio, None, found, tests=factors)
