"""What a night says of the static distortion of a camera, as data that are kept."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field

import numpy as np
from astropy import units as u

from ..cameras.stated_errors import StaticErrors
from ..exceptions import InputError
from ..geometry import basis, detector_modes
from ..inputs import column_contract
from ..inputs.repetitions import fingerprints
from ..priors.prior import Prior
from ..results.solution import Solution
from ..runtime.trees.facts import array, number
from .known_maps import pointed, shown_by, sound

#: Error of a coefficient [pix] of a map that states none: that of a header as `legdistort attach` writes it.
EXACT = 1e-3


@dataclass(frozen=True, eq=False)
class Night:
    """What the exposures of a night, or a map, say of the static distortion of their detector, and nothing else.

    ``-2 ln L = z' information z - 2 pull' z`` for a step z from the map `around`, in the order of
    `legdistort.geometry.detector_modes.dynamic_basis`: stars, departures of exposures and a common map of the plane are
    eliminated, and what was known beforehand is left out.

    Attributes
    ----------
    name : str
    date : float or None
        Mean Julian year of its exposures.
    n_exposures, n_stars : int
    around : ndarray, shape (2, n_modes)
        Pixels.
    information : ndarray, shape (k, k)
        Pixels^-2.
    pull : ndarray, shape (k,)
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
    """

    name: str
    _: KW_ONLY
    date: float | None = field(metadata=number(unit="yr"))
    n_exposures: int
    n_stars: int
    around: np.ndarray = field(metadata=array(2, "n_modes", unit="pix"))
    information: np.ndarray = field(metadata=array("n_rows", "n_rows", unit="pix-2"))
    pull: np.ndarray = field(metadata=array("n_rows", unit="pix-1"))
    n_nights: int = field(metadata=number(minimum=1))
    scatter: np.ndarray = field(metadata=array("n_degrees", unit="pix", minimum=0))
    nightly: np.ndarray | None = field(metadata=array("n_degrees", unit="pix", minimum=0))
    dof: float = field(metadata=number(minimum=0, infinite=True))
    odd: tuple[str, ...] = ()
    exposures: tuple[str, ...] = ()

    @classmethod
    def of(cls, solution: Solution, name: str, around: np.ndarray | None = None) -> Night:
        """That of a solution, linearised round a map (2, n_modes) where the night itself shows none."""
        shown = shown_by(solution, name, around)
        given = {each: getattr(shown, each) for each in ("around", "information", "pull", "scatter", "nightly", "dof")}
        table, nights = solution.residuals[sound(solution)], solution.nights
        counts = {f"n_{each}s": len(np.unique(table[each])) for each in ("exposure", "star")}
        counts["n_nights"] = 1 if shown.nightly is None else int(np.count_nonzero(~nights["odd"]))
        date = float(np.mean(column_contract.values(table, "epoch", u.yr))) if "epoch" in table.colnames else None
        odd = tuple(str(each) for each in nights["name"][nights["odd"]])
        measured, used = fingerprints(solution.residuals), set(table["exposure"])
        marks = tuple(mark for each in solution.names if each in used for mark in measured[each])
        return cls(name, date=date, odd=odd, exposures=marks, **counts, **given)

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
            name, date=None, n_exposures=1, n_stars=0, around=pointed(prior.mean, prior.shape), n_nights=1,
            information=information, pull=np.zeros(len(rows)), scatter=np.zeros(degree), nightly=None, dof=np.inf,
        )  # fmt: skip


def night_of(item):
    """The night of a labelled solution, map or path, and the shape of its detector."""
    label, thing = item
    if isinstance(thing, Prior):
        return Night.of_map(thing, label), thing.shape
    solution = thing if isinstance(thing, Solution) else Solution.read(thing)
    if solution.camera.has_focal_plane:
        raise InputError(f"{label} is of camera {solution.camera.name} with several detectors: solve them one by one")
    shapes = set(solution.estimate.shapes.values())
    return Night.of(solution, label), next(iter(shapes))


def check_nights(nights, shapes):
    """Nights of one detector and degree, no exposure twice."""
    if len(shapes) > 1:
        raise InputError(f"nights are of detectors of several shapes, {sorted(shapes)} (ny, nx): combine those of one")
    degrees = {}
    for each in nights:
        degrees.setdefault(basis.degree_of(each.around.shape[1]), each.name)
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


def dates_of(nights):
    """Years of nights, (N,); zeros if one has none."""
    dates = np.array([np.nan if each.date is None else each.date for each in nights])
    return dates if np.all(np.isfinite(dates)) else np.zeros(len(dates))
