"""The check of a camera: do its detectors lie, and distort, as was stated of them, and would that have shown?"""

from dataclasses import replace
from itertools import combinations

import numpy as np

from ...cameras import ties
from ...cameras.header_layout import FAR, LEAST, compare_headers
from ...exceptions import some_of
from ...geometry import similarity
from ...matching.detectors.detector_places import REACH, TURNS
from ...results.check import WRONG, Check, FactorTest, state_of
from .known_effects import DEPARTURES, LAYOUT, STATICS, fitted_already
from .limits import MOST_NAMED, SEEN, addition_that_shows, as_one

#: Stars that cross, from which on it tells something that they are left out.
_FEWEST = 4
#: Layouts that agree so well [pix] are the same.
_SAME = 1e-6
#: Columns of the detectors, and their values for all stars, up to which they are looked at.
_MOST_COLUMNS, _MOST_VALUES = 1000, 30_000_000
_TIE = (
    "more stars that dithers larger than the gaps carry from one detector to the others, a reference with stars "
    "on them (--reference)"
)
_STATE = ", or what is known of the layout (--layout-sigma, a camera file){}; --layout hold takes it as exact"
#: The same where headers are known to be wrong, which would be stated or held.
_STATE_OTHER = ", or a camera file that was found otherwise (--camera): not what these headers state, which is wrong"
_ODD = (
    "this solution does not count on that header: nothing is to be done for it; other programs need a better one, "
    "which legdistort attach writes"
)
_UNDECIDED = (
    "the positions of the stars do not count on these headers, the sky does: tie it to a catalogue (--reference); "
    "legdistort attach then writes better headers"
)
#: The same where the sky is that of a reference.
_UNDECIDED_TIED = (
    "neither the positions of the stars nor the sky count on these headers: nothing is to be done for them; other "
    "programs need better ones, which legdistort attach writes"
)
_NEARER = (
    "a layout that is nearer, by better headers or a camera file (--camera), if these dithers are larger than the "
    f"gaps: stars are looked for to {REACH:.0f} px and {np.degrees(TURNS[-1]):.0f} degree from where it has them"
)
_SETTLING = (
    "the size of the static distortions of the detectors, --static-sigma PIXELS, in place of --prior; or more stars "
    "that dithers carry from one detector to the others"
)
_TELL = "dithers larger than the gaps, which carry stars from one detector to the others, test it"


def camera_check(solution, residuals, observed, *, camera, contradicted, error, judged):
    """Do exposures agree with what was stated of the detectors of a camera? None for a single one.

    Parameters
    ----------
    solution : Solution
    residuals : Residuals
    observed : Observed
    camera : `legdistort.results.errors.camera_errors.CameraErrors` or None
        Of what was fitted.
    contradicted : Check or None
        See `contradicted_layout`; the residuals are those of that then, and tell nothing else.
    error : float
        Typical error of a star, pixels.
    judged : callable
        ``judged(score)``: its state, and words on what is there but too small to matter.
    """
    if observed.detector is None or residuals.dof < 1:
        return None
    free = np.zeros(4, dtype=bool) if camera is None else camera.free.any(axis=(0, 1))
    held = {effect: not fitted for effect, fitted in fitted_already(camera).items()}
    held = [effect for effect, is_held in held.items() if is_held]
    stated, apart = _stated(solution, camera and camera.departure), undetermined(solution)
    headers = _headers_by_group(solution) if apart else _headers(solution, free[:3].any())
    if apart:
        apart = Check("camera", "unknown", None, None, *apart)
        if (missed := _missed(solution)) >= _FEWEST:
            words = f"{apart.sentence}, but by the layout {missed} stars are seen by several of them: it may be wrong"
            apart = replace(apart, state="warn", sentence=words, cure=_NEARER)
    else:
        apart = _few(solution, free[:3].any())
    given = _held(held, solution.camera.name, residuals, observed, error, judged)
    if contradicted is not None:
        given = contradicted if given is None else replace(contradicted, tests=given.tests)
    return as_one([_unsettled(solution, camera), apart, given, stated, headers])


def _unsettled(solution, camera):
    """The check of a fit of the camera that did not settle; None for one that did."""
    if camera is None or not camera.unsettled:
        return None
    words = (
        f"the detectors of camera {solution.camera.name} did not settle (the last step was {camera.unsettled:.2g} of "
        "their errors): places, static distortions and positions may be wrong by far more than their errors"
    )
    return Check("camera", "fail", camera.unsettled, None, words, _SETTLING)


def _few(solution, found):
    """The check of ties of detectors, where the layout was `found`, that rest on a star or two; None for none."""
    used = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    few = ties.few(solution.camera, used) if found else []
    if not few:
        return None
    words = f"how groups of detectors lie to each other rests on {ties.in_words(few)}: a wrong one would not show"
    headers = solution.camera.headers
    cure = _tying(solution, headers is not None and (bool(headers.odd) or headers.is_undecided))
    return Check("camera", "warn", float(min(number for *_, number in few)), float(ties.FEWEST), words, cure)


def _tying(solution, wrong):
    """The cure of detectors that stars do not tie, or few, by headers that are known to be `wrong` or not."""
    instead = " in place of --layout fit" * (solution.settings.layout == "fit")
    return _TIE + (_STATE_OTHER if wrong else _STATE.format(instead))


def _undecided(solution):
    """The cure of headers that contradict one another where nothing shows which of them are wrong."""
    return _UNDECIDED if solution.gauge.tie is None else _UNDECIDED_TIED


def _headers_by_group(solution):
    """The check of headers against each group of detectors that stars tie to each other, where groups are apart."""
    camera, words = solution.camera, []
    for group in camera.groups(solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]):
        exact = {key: replace(camera[key], layout_sigma=None, layout_covariance=None) for key in group}
        headers = compare_headers(exact) if len(group) > 1 else None
        words += [headers.sentence("the stars have them")] if headers is not None and headers.scatter > LEAST else []
    words = [each for each in words if each]
    return Check("camera", "warn", None, None, "; ".join(words), _undecided(solution)) if words else None


def _headers(solution, found):
    """The check of the layout of headers, against the one that was `found`, or else given; None where there is none."""
    headers, camera = solution.camera.headers, solution.camera
    if headers is None or (not found and headers.scatter < _SAME and not headers.odd):  # by headers, and held
        return None
    there = "the stars put it" if found else f"camera {camera.name} has it, which was given"
    if headers.is_undecided:
        there = "the stars have them" if found else f"camera {camera.name} has them, which was given"
        return Check("camera", "warn", headers.scatter, FAR, headers.sentence(there), _undecided(solution))
    if words := headers.sentence(there):
        cure = _ODD if found else f"--layout fit tells which of the two is right; {_ODD}"
        return Check("camera", "warn", headers.far, LEAST, words, cure)
    where = "the stars put them" if found else f"camera {camera.name} has them, which was given"
    return Check("camera", "pass", headers.scatter, FAR, _alike(solution, headers, where))


def _alike(solution, headers, where):
    """By how much headers that do not contradict one another have detectors elsewhere, in words, and what hides it."""
    if headers.scatter < LEAST:
        return f"the headers have the detectors where {where}, to {headers.scatter:.2g} px"
    far = zip(headers.names, np.hypot(*headers.shifts.T), strict=True)
    each = some_of([f"{key} {off:.2g}" for key, off in far], MOST_NAMED)
    words = (
        f"the headers have the detectors up to {headers.scatter:.2g} px from where {where} ({each} px), and none "
        "contradicts the others"
    )
    if solution.degree > 1 and solution.camera.common_sigma is not None:
        words += (
            f"; a map of degree {solution.degree} of all detectors together, which exposures took over, shifts and "
            "turns single ones too, and is in none of these"
        )
    return words


def beside_camera_check(solution, camera):
    """What this check of the camera and that of the pointing compare with headers, and what tells which is right.

    In words behind others; empty where headers have the detectors as they lie.
    """
    headers = solution.camera.headers
    if camera is None or camera.state not in WRONG or headers is None or not (headers.odd or headers.is_undecided):
        return ""
    errors, there = solution.estimate.uncertainty.camera, "the given layouts"
    found = errors is not None and bool(errors.free[:, :, :3].any())
    if found:
        there = "the stars, by dithers from one detector to another,"
    told = "of the sky nothing but a reference tells (--reference)"
    told = f"the stars tell the first, {told}" if found else f"of the first --layout fit tells, {told}"
    if solution.gauge.tie is not None:
        told = "the reference tells both, and the headers count for neither"
    return (
        f"; check camera compares how headers have the detectors to each other with how {there} have them, this one "
        f"where headers put detectors and exposures on the sky: {told}"
    )


def contradicted_layout(solution, camera):
    """The check of a layout that is held by the stars that cross from detector to detector and are left out for it.

    Parameters
    ----------
    solution : Solution
    camera : `legdistort.results.errors.camera_errors.CameraErrors` or None
        Of what was fitted.

    Returns
    -------
    Check or None
        None where the layout was fitted, there is no other detector, or most of these stars agree with it.
    """
    if len(solution.camera.detectors) < 2 or (camera is not None and camera.free[:, :, :3].any()):
        return None
    residuals, used = solution.residuals, np.asarray(solution.residuals["used"])
    names, detector = np.unique(np.asarray(residuals["detector"]).astype(str), return_inverse=True)
    stars, star = np.unique(np.asarray(residuals["star"]), return_inverse=True)
    seen, agree = np.zeros((2, len(stars), len(names)), dtype=bool)
    seen[star, detector] = True
    agree[star[used], detector[used]] = True
    tried = [np.arange(len(names)), *map(list, combinations(range(len(names)), 2))]  # all together, then two by two
    for some in tried:
        crossing = seen[:, some].sum(axis=1) > 1
        number, n_stars = np.count_nonzero(crossing & (agree[:, some].sum(axis=1) < 2)), np.count_nonzero(crossing)
        if number < (n_stars / 2 if n_stars >= _FEWEST else max(n_stars, 1)):
            continue
        rows = np.isin(star, np.flatnonzero(crossing)) & np.isin(detector, some)
        far, worst = _farthest(residuals[rows], star[rows], detector[rows])
        # of few stars, or of two detectors, static distortions leave as many, and mismatches, but not so far off
        if (len(some) == len(names) and n_stars >= _FEWEST) or far > FAR:
            break
    else:
        return None
    names = names[worst] if len(some) > 2 else " against ".join(names[some])
    found = (
        f"the layout was taken as exact, and the stars contradict it: detector {names} lies {far:.0f} px from where it "
        f"has it ({number} of {n_stars} stars that cross to another detector are left out on one of them)"
    )
    instead = " instead of --layout hold" * (solution.settings.layout == "hold")
    return Check("camera", "fail", far, None, found, f"{LAYOUT.cure}{instead}")


def _farthest(residuals, star, detector):
    """By how many pixels a detector lies elsewhere than the others, by the stars (n,) that both see, and its number."""
    node, index = np.unique(star * (detector.max() + 1) + detector, return_inverse=True)
    off = np.stack([residuals[name].value for name in ("dx", "dy")], axis=1)
    off = np.array([np.median(off[index == k], axis=0) for k in range(len(node))])
    star, detector, apart = *np.divmod(node, detector.max() + 1), {}
    for a, b in combinations(np.unique(detector), 2):
        common, mine, other = np.intersect1d(star[detector == a], star[detector == b], return_indices=True)
        if len(common):
            difference = np.median(off[detector == a][mine] - off[detector == b][other], axis=0)
            apart.setdefault(a, []).append(difference)
            apart.setdefault(b, []).append(-difference)
    far = {key: np.hypot(*np.median(each, axis=0)) for key, each in apart.items()}
    worst = max(far, key=far.get)
    return far[worst], worst


def undetermined(solution):
    """That nothing determines how detectors lie to each other, and the cure; None where something does."""
    errors = solution.estimate.uncertainty.camera
    if errors is None or not errors.unknown.shape[2]:
        return None
    apart = ties.apart(solution.camera, solution.residuals)
    apart = f" ({apart})" * bool(apart)
    if not errors.free[:, :, :3].any():  # the layout is held
        words = f"these exposures do not determine the static distortions of the detectors beside each other{apart}"
        return words, f"{_TIE}, or what is known of them (a camera file, --camera), or leave --static fit out"
    words = f"these exposures do not determine how the detectors lie to each other{apart}"
    return words, f"{_tying(solution, _headers_by_group(solution) is not None)}; {_NEARER}"


def _missed(solution):
    """Number of stars that by the layout exposures show on detectors of another group than that which has them."""
    camera, used = solution.camera, solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    group, ids = camera.group_of(used), camera.ids(used)
    of_detector = np.array([group[ids == key].max(initial=-1) for key in camera.detectors])
    stars, first = np.unique(np.asarray(used["star"]), return_index=True)
    xy = solution.estimate.positions[np.searchsorted(solution.estimate.star_names, stars)]
    elsewhere = (of_detector[:, None] >= 0) & (of_detector[:, None] != group[first])
    on = [camera.sees(similarity.apply(pose, xy)) & elsewhere for pose in solution.poses.values()]
    return int(np.count_nonzero(np.any(on, axis=(0, 1))))


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
    were = "was" if [*tests] == [LAYOUT] else "were"
    given = f"{' and '.join(words[effect] for effect in tests)} that {were} given of the detectors"
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
        are = "is" if were == "was" else "are"
        return Check("camera", "unknown", None, None, f"{given} {are} believed, not tested", _TELL, factors)
    bent = "" if STATICS in effects else "; static distortions that are fitted hide a wrong one where they bend for it"
    return Check("camera", "pass", None, None, f"exposures agree with {given}{little}{bent}", tests=factors)


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
