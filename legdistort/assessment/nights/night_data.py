"""What a night says of the static distortion of a camera, as data that are kept."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field

import numpy as np
from astropy import units as u

from ...cameras.camera import Camera
from ...cameras.stated_errors import StaticErrors
from ...exceptions import AssumptionWarning, InputError, some_of, warn
from ...geometry import basis, detector_modes
from ...inputs import column_contract
from ...inputs.repetitions import fingerprints
from ...priors.prior import Prior
from ...results.solution import Solution
from ...runtime.trees.facts import array, number
from ..known_maps import shown_by, sound
from .camera_changes import shown_of_camera
from .solved_alone import nights_alone

#: Error of a coefficient [pix] of a map that states none: that of a header as `legdistort attach` writes it.
EXACT = 1e-3
_TURN, _HALF = 360, 180  # degrees
_SHOWN = "around", "information", "pull", "scatter", "nightly", "dof"  # of what a night shows


@dataclass(frozen=True, eq=False)
class Night:
    """What the exposures of a night, or a map, say of the static distortion of their detector, and nothing else.

    ``-2 ln L = z' information z - 2 pull' z`` for a step z from the map `around`, in the order of
    `legdistort.geometry.detector_modes.dynamic_basis`: stars, departures of exposures and a common map of the plane are
    eliminated, and what was known beforehand is left out. Of nights whose exposures have a number z goes on with the
    slopes by it, pixels a unit, and the map is that of the mean number.

    Attributes
    ----------
    name : str
    date : float or None
        Mean Julian year of its exposures.
    n_exposures, n_stars : int
    around : ndarray, shape (2, n_modes), or None
        Pixels; None of a camera with several detectors.
    information : ndarray, shape (k, k) or (2 k, 2 k)
        Pixels^-2, with slopes beyond the first k.
    pull : ndarray, shape (k,) or (2 k,)
        Pixels^-1.
    n_nights : int
        That it is made of: more than one if they were solved together.
    scatter : ndarray, shape (degree,)
        Of its exposures about it, or about their night, by degree, pixels.
    nightly : ndarray, shape (degree,), or None
        Of several nights, which is in the information then.
    dof : float
        Degrees of freedom of these.
    odd : tuple of str
        Of several nights that were solved together those that depart farther than the others, and were left out.
    exposures : tuple of str
        Fingerprints of what was measured in those that count, so that nothing counts twice.
    value : float or None
        Mean over its exposures of that on which the static distortion may depend.
    spread : float
        Their rms deviation from it.
    lowest, highest : float or None
        Of these.
    camera : Camera or None
        That of the night, where it has several detectors: z are changes of all their modes from it, of orders 0 and 1
        the layout (n_detectors, 2, n_modes), and maps of the focal plane that all of them share have no information.
    """

    name: str
    _: KW_ONLY
    date: float | None = field(metadata=number(unit="yr"))
    n_exposures: int
    n_stars: int
    around: np.ndarray | None = field(metadata=array(2, "n_modes", unit="pix"))
    information: np.ndarray = field(metadata=array("n_rows", "n_rows", unit="pix-2"))
    pull: np.ndarray = field(metadata=array("n_rows", unit="pix-1"))
    n_nights: int = field(metadata=number(minimum=1))
    scatter: np.ndarray = field(metadata=array("n_degrees", unit="pix", minimum=0))
    nightly: np.ndarray | None = field(metadata=array("n_degrees", unit="pix", minimum=0))
    dof: float = field(metadata=number(minimum=0, infinite=True))
    odd: tuple[str, ...] = ()
    exposures: tuple[str, ...] = ()
    value: float | None = None
    spread: float = field(default=0.0, metadata=number(minimum=0))
    lowest: float | None = None
    highest: float | None = None
    camera: Camera | None = None

    @property
    def degree(self) -> int:
        """Total degree of the distortion."""
        n = self.around.shape[1] if self.camera is None else len(self.pull) // (2 * len(self.camera.detectors))
        return basis.degree_of(n)

    @classmethod
    def of(cls, solution: Solution, name: str, covariate: str | None = None) -> Night:
        """That of a solution of one detector, with slopes by a column of the table of matches, if one is named."""
        numbers = None if covariate is None else numbers_in(solution, covariate, name)
        shown = shown_by(solution, name, numbers=numbers)
        given = {each: getattr(shown, each) for each in _SHOWN}
        nights = solution.nights
        given["n_nights"] = 1 if shown.nightly is None else int(np.count_nonzero(~nights["odd"]))
        given["odd"] = tuple(str(each) for each in nights["name"][nights["odd"]])
        if numbers is not None:
            values = np.array(list(numbers.values()))
            given |= {"value": float(values.mean()), "spread": float(values.std())}
            given |= {"lowest": float(values.min()), "highest": float(values.max())}
        return cls(name, **_counted(solution, sound(solution)), **given)

    @classmethod
    def of_camera(cls, solution: Solution, label: str) -> list[Night]:
        """Those of a solution of several detectors, each by itself."""
        out, table = [], solution.residuals
        for name, exposures, own in nights_alone(solution, label):
            information = shown_of_camera(own, name)
            given = {"around": None, "information": information, "pull": np.zeros(len(information)), "nightly": None}
            given |= {"scatter": np.zeros(own.degree + 1), "dof": np.inf, "n_nights": 1, "camera": own.camera}
            rows = np.asarray(table["used"]) & np.isin(np.asarray(table["exposure"]), exposures)
            out.append(cls(name, **_counted(solution, rows), **given))
        return out

    @classmethod
    def of_map(cls, prior: Prior, name: str) -> Night:
        """That of a map, known to its `static_sigma` or its covariance, or else to 0.001 px a coefficient.

        It counts as one exposure.
        """
        if not prior.states_mean or prior.degree == 0:
            raise InputError(f"{name} states no distortion: leave it out")
        if prior.shape is None:
            raise InputError(f"{name} does not state the shape of its detector: give it shape=")
        if prior.table is not None:
            raise InputError(f"{name} has a table beside its series, which cannot be combined: make it of headers")
        degree, rows = prior.degree, detector_modes.dynamic_basis(prior.shape, prior.mean.shape[1])
        spread = StaticErrors.of([prior], degree).spread(rows[None], [0])
        directions, variances = spread.directions[0], spread.variance[0]
        information = directions / (variances + EXACT**2) @ directions.T
        return cls(
            name, date=None, n_exposures=1, n_stars=0, n_nights=1,
            around=detector_modes.pointed(prior.mean, prior.shape), information=information,
            pull=np.zeros(len(rows)), scatter=np.zeros(degree), nightly=None, dof=np.inf,
        )  # fmt: skip


def _counted(solution, rows):
    """When some rows of the residuals were measured, how much they are, and what tells their exposures apart."""
    table = solution.residuals[rows]
    counts = {f"n_{each}s": len(np.unique(table[each])) for each in ("exposure", "star")}
    date = float(np.mean(column_contract.values(table, "epoch", u.yr))) if "epoch" in table.colnames else None
    measured, used = fingerprints(solution.residuals), set(table["exposure"])
    marks = tuple(mark for each in solution.names if each in used for mark in measured[each])
    return {"date": date, **counts, "exposures": marks}


def numbers_in(solution, covariate, name):
    """What a column states of every exposure of a solution that counts, ``{exposure: number}``."""
    table = solution.residuals[sound(solution)]
    if covariate not in table.colnames:
        own = {*column_contract.MATCHED, *column_contract.DETECTED, "used", "dx", "dy"}
        others = [each for each in table.colnames if each not in own]
        raise InputError(
            f"{name} has no number {covariate} of its exposures: take it from the headers of the frames, "
            f"match(keywords=['{covariate}']) (--keywords {covariate} of match or run), or give it as a column of the "
            f"star lists, and solve again, or leave that night out; further columns are {some_of(others, 6) or 'none'}"
        )
    try:
        values = column_contract.values(table, covariate)
    except InputError as error:
        raise InputError(f"{name}: {error}; a covariate is a number") from None
    names, first, owner = np.unique(np.asarray(table["exposure"]), return_index=True, return_inverse=True)
    for fault, words in (
        (~np.isfinite(values), "is not known of exposure {}: give it, or leave that exposure out (--without)"),
        (values != values[first][owner], "is not one number in exposure {}: a covariate is one of every exposure"),
    ):
        if fault.any():
            raise InputError(f"{name}: {covariate} {words.format(names[owner[np.argmax(fault)]])}")
    return {str(each): float(value) for each, value in zip(names, values[first], strict=True)}


def nights_of(item, covariate=None):
    """The nights of a labelled solution, map or path, and the shape of its detector, or of its focal plane."""
    label, thing = item
    if isinstance(thing, Prior):
        if covariate is not None:
            raise InputError(f"{label} is a map, which states no {covariate}: leave it out, or the covariate")
        return [Night.of_map(thing, label)], thing.shape
    solution = thing if isinstance(thing, Solution) else Solution.read(thing)
    shape = next(iter(solution.estimate.shapes.values()))
    if not solution.camera.has_focal_plane:
        return [Night.of(solution, label, covariate)], shape
    if covariate is not None:
        raise InputError(
            f"{label} is of camera {solution.camera.name} with several detectors, whose distortions are not sought as "
            "dependent on a number: leave the covariate out"
        )
    return Night.of_camera(solution, label), shape


def check_nights(nights, shapes):
    """Nights of the same detectors and of one degree, no exposure twice."""
    several = {_detectors(each.camera): each.name for each in reversed(nights) if each.camera is not None}
    if len(several) > 1 or (len(several) == 1 and any(each.camera is None for each in nights)):
        one = next((each.name for each in nights if each.camera is None), None)
        words = [f"{name} (detectors {each})" for each, name in several.items()] + [f"{one} (one detector)"] * bool(one)
        raise InputError(f"nights are of several cameras, {', '.join(words)}: combine those of one")
    if not several and len(shapes) > 1:
        raise InputError(f"nights are of detectors of several shapes, {sorted(shapes)} (ny, nx): combine those of one")
    degrees = {}
    for each in nights:
        degrees.setdefault(each.degree, each.name)
    if len(degrees) > 1:
        words = ", ".join(f"{degree} ({name})" for degree, name in sorted(degrees.items()))
        raise InputError(f"nights were solved with several degrees, {words}: solve all with one (--degree)")
    seen = {}
    for night in nights:
        for position in night.exposures:
            if position in seen:
                raise InputError(
                    f"{night.name} has an exposure that {seen[position]} has too: give every exposure once"
                )
        seen |= dict.fromkeys(night.exposures, night.name)


def _detectors(camera):
    """Detectors of a camera by their sizes, in words."""
    return ", ".join(f"{key} of {each.shape[1]} x {each.shape[0]}" for key, each in sorted(camera.detectors.items()))


def check_numbers(nights, covariate):
    """The numbers of nights differ, and do not look like an angle that wraps, which gives a warning."""
    low, high = min(each.lowest for each in nights), max(each.highest for each in nights)
    if low == high:
        raise InputError(
            f"{covariate} is {low:g} in all exposures, so that nothing can depend on it: leave the covariate out, or "
            "give nights with other values"
        )
    if _HALF < high - low <= _TURN and max(-low, high) <= _TURN:
        warn(
            f"{covariate} runs from {low:g} to {high:g}: if it is an angle that wraps at {_TURN} degrees, its ends "
            "are neighbours, and no linear dependence on it is right; give the angle as it is driven, without jumps, "
            "or its sine or cosine, as a column of the star lists",
            AssumptionWarning,
        )


def standard_numbers(nights):
    """Mean and rms over all exposures of the numbers of nights, and the nights' own in these units, (N,)."""
    number, spread = (np.array([getattr(each, name) for each in nights]) for name in ("value", "spread"))
    weight = [each.n_exposures for each in nights]
    mean = np.average(number, weights=weight)
    unit = np.sqrt(np.average(spread**2 + (number - mean) ** 2, weights=weight))
    return mean, unit, (number - mean) / unit


def given_by(nights, modes, unit):
    """What nights see, as `legdistort.assessment.nights.combined_nights.fitted` takes it, with slopes by a unit."""
    out = []
    for each in nights:
        around, information, pull = modes.seen(each)
        scale = np.repeat([1.0, 1 / unit], modes.size)[: len(pull)]
        out.append((around, scale[:, None] * information * scale, scale * pull))
    return out


def dates_of(nights):
    """Years of nights, (N,); zeros if one has none."""
    dates = np.array([np.nan if each.date is None else each.date for each in nights])
    return dates if np.all(np.isfinite(dates)) else np.zeros(len(dates))
