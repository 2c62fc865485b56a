"""The check of a camera: do its detectors lie, and distort, as was stated of them, and would that have shown?"""

import numpy as np

from ...results.check import WRONG, Check, FactorTest, state_of
from .known_effects import DEPARTURES, LAYOUT, STATICS
from .limits import SEEN, addition_that_shows, as_one

#: Stars that cross, from which on it tells something that they are left out.
_FEWEST = 4
#: Columns of the detectors, and their values for all stars, up to which they are looked at.
_MOST_COLUMNS, _MOST_VALUES = 1000, 30_000_000
_TIE = (
    "dithers larger than the gaps, which carry stars from one detector to the others, a reference with stars on them "
    "(--reference), or what is known of the layout (--layout-sigma, a camera file); --layout hold takes it as exact"
)
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
    stated, apart = _stated(solution, camera and camera.departure), undetermined(solution)
    apart = Check("camera", "unknown", None, None, *apart) if apart else None
    lost = _lost(solution) if LAYOUT in held else None
    return as_one([_held(held, solution.camera.name, residuals, observed, error, judged), stated, apart, lost])


def _lost(solution):
    """The check of a layout that is held by the stars that cross from detector to detector and are left out for it."""
    residuals, used = solution.residuals, solution.residuals["used"]
    crossing, agree = (_crossing(rows["star"], rows["detector"]) for rows in (residuals, residuals[used]))
    if len(crossing) < _FEWEST or len(agree) > len(crossing) / 2:
        return None
    found = (
        f"{len(crossing) - len(agree)} of {len(crossing)} stars that cross to another detector are left out on one "
        "of them: they do not agree with the layout that was given"
    )
    return Check("camera", "fail", len(agree), len(crossing) / 2, found, LAYOUT.cure)


def _crossing(star, detector):
    """Stars that several detectors see."""
    pairs = set(zip(np.asarray(star).tolist(), np.asarray(detector).tolist(), strict=True))
    stars, count = np.unique([star for star, _ in pairs], return_counts=True)
    return stars[count > 1]


def undetermined(solution):
    """That nothing determines how detectors lie to each other, and the cure; None where something does."""
    errors = solution.estimate.uncertainty.camera
    if errors is None or not errors.unknown.shape[2]:
        return None
    groups = solution.camera.groups(solution.residuals[solution.residuals["used"]])
    apart = f" (no star in common: {' | '.join(', '.join(group) for group in groups)})" * (len(groups) > 1)
    return f"these exposures do not determine how the detectors lie to each other{apart}", _TIE


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
                     "look at what states it, the headers or the camera file, or --layout fit, --static fit",
                     factors)  # fmt: skip
    return Check("camera", "pass", ratio, None, found, tests=factors)
