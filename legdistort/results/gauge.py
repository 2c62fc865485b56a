"""The null space of the positions, what else determines it, and the convention (the datum) that fixes the rest.

Any map G of the reference plane leaves J (nearly) as it is when every D_i compensates it, a degeneracy: the six affine
directions exactly, all 2 n_modes polynomial directions to a part in a million. Left free they are noise. They are fixed
by as many linear constraints on the coefficients, ``sum_i R_i (A_i - A_0) = 0``. Where exposures differ in place or
orientation, or a prior is given, the constraints are those under which star positions and coefficients are the
posterior mean of a model in which exposures scatter around a static distortion (`legdistort.solving.gauge.hierarchy`).
Directions that this does not determine either are *unknown*, and are fixed by the convention: the smallest dynamic
part, ``R_i = N_i' W_i`` (gauge ``"minimal"``), or ``sum_i (A_i - A_0) = 0`` (gauge ``"mean"``), which the paper's
starting point implies for undithered exposures.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import block_diag

from ..geometry import basis
from ..geometry.plane_modes import PlaneModes
from ..runtime.notebook import ShownAsPrinted
from ..runtime.trees.facts import NOT_STORED, array, number, text
from .errors.catalogue_tie import Tie, errors_by_degree

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_CONVENTIONS = {
    "minimal": "smallest dynamic part, weighted by its scatter and errors",
    "mean": "dynamic parts that sum to zero",
}
#: What was known of the static distortion: how the errors come about, and why something is unknown.
_STATIC = {
    "open": ("no scatter of single exposures was assumed", ""),
    "none": (
        "no static distortion was given, or none that is known in all its parts",
        "the scatter of single exposures",
    ),
    "fitted": ("no uncertainty of the static distortion was given", "the scatter of single exposures"),
    "exact": ("", "the scatter of single exposures; the static distortion given is taken as exact"),
    "uncertain": ("", "the scatter of single exposures and the uncertainty of the static distortion"),
}
_ROWS = array("n_constraints", "n_exposures", "2 n_map_modes")
CURE = "give a prior (--prior) or its size (--static-sigma), turn the camera between exposures, or tie to a reference"
#: The same of several detectors, whose static distortions are those of their camera: a prior is refused.
CURE_OF_CAMERA = (
    "match with the camera of a solution that a reference tied (match --camera RESULTS), turn the camera between "
    "exposures, or tie to a reference (--reference)"
)
#: ... and what of it helps where there is one already.
_TIE, _MORE = "or tie to a reference", "or give more stars of the reference"


@dataclass(frozen=True, eq=False)
class UnknownMap:
    """A map of the reference plane that nothing determines: a degeneracy.

    Attributes
    ----------
    name : str
        "shear"; "z^2", "i z^2" and so on for maps that keep angles, z = x + iy; else "degree 2" and so on.
    degree : int
    map : ndarray, shape (2 n_modes,)
        In modes of the reference plane; moves the stars by 1 px, rms per axis, once a similarity is taken off.
    """

    name: str
    degree: int = field(metadata=number(minimum=0, maximum=30))
    map: np.ndarray = field(metadata=array("2 n_plane_modes", unit="pix"))

    def __repr__(self) -> str:
        return f"<UnknownMap: {self.name}>"


@dataclass(frozen=True, eq=False)
class UnknownDirection:
    """A direction in which positions and distortions may be wrong together by any amount.

    Attributes
    ----------
    name : str
    stars : ndarray, shape (n_stars, 2)
        How it moves the stars: 1 px, rms per axis, pixels.
    coefficients : ndarray, shape (n_exposures, 2, n_modes)
        How the coefficients change with it, pixels.
    motions : ndarray, shape (n_stars, k), or None
        How it changes the motions and parallaxes of stars, pixels a year and pixels; None where these stay.
    """

    name: str
    stars: np.ndarray = field(metadata=array("n_stars", 2, unit="pix", nan=True))
    coefficients: np.ndarray = field(metadata=array("n_exposures", 2, "modes", unit="pix"))
    motions: np.ndarray | None = field(default=None, metadata=array("n_stars", "n_terms", unit="pix/yr, pix", nan=True))

    def __repr__(self) -> str:
        return f"<UnknownDirection: {self.name}>"


@dataclass(frozen=True, eq=False)
class Drift:
    """Common maps that change with time as the stars do by their motions and parallaxes, and so show in no residual.

    Attributes
    ----------
    names : tuple of str
        Terms of the stars: "vx", "vy" [pix/yr], "parallax" [pix].
    motion : ndarray, shape (n_exposures, 2 n_modes, q)
        How modes of fields of those terms of which nothing is known beforehand change the coefficients of exposures,
        n_modes for each of the q / n_modes terms.
    covariance : ndarray, shape (q, q)
        Of these maps, without the rates that the poses carry.
    maps : ndarray, shape (m, q)
        Orthonormal rows: those that constraints of the gauge hold.
    rates : ndarray, shape (c, q)
        The same that poses carry: common rates of shift, rotation and scale, and the mean parallax.
    held : bool
        Whether what is known of the motions of stars beforehand determined them, not the convention of the gauge.
    n_tied : int
        Stars of a reference whose proper motions tie them, the rates too; their covariance has these then.
    parallax_tied : bool
        Whether the parallaxes of these stars tie the mean parallax.
    joint : ndarray, shape (2 n_modes + q, 2 n_modes + q), or None
        Covariance of the common map and these, where a reference determined them together.
    n_fields : int
        Fields that have such maps each.
    """

    names: tuple[str, ...] = field(metadata=text("vx", "vy", "parallax", length="n_terms"))
    motion: np.ndarray = field(metadata=array("n_exposures", "2 n_map_modes", "n_drift"))
    covariance: np.ndarray = field(metadata=array("n_drift", "n_drift", unit="(pix/yr)2", covariance=True))
    maps: np.ndarray = field(metadata=array("maps", "n_drift"))
    rates: np.ndarray = field(metadata=array("rates", "n_drift"))
    held: bool = False
    n_tied: int = field(default=0, metadata=number(minimum=0))
    parallax_tied: bool = False
    joint: np.ndarray | None = field(
        default=None, metadata=array("2 n_plane_modes + n_drift", "2 n_plane_modes + n_drift", covariance=True)
    )
    n_fields: int = field(default=1, metadata=number(minimum=1))

    @property
    def n_constraints(self) -> int:
        """Constraints of the gauge on maps and rates."""
        return len(self.maps) + len(self.rates)

    def determined(self, reach: np.ndarray, information: np.ndarray) -> Drift:
        """The same where what is known of the motions of stars determines the maps, the rates with them.

        Parameters
        ----------
        reach : ndarray, shape (n_constraints of the gauge, q)
            The modes as values of the constraints.
        information : ndarray, shape (n_constraints of the gauge,) squared
            Of these values.
        """
        rows = np.concatenate([self.maps, self.rates])
        moved = reach @ rows.T
        covariance = np.linalg.inv(moved.T @ information @ moved)[: len(self.maps), : len(self.maps)]
        return replace(self, covariance=self.maps.T @ covariance @ self.maps, held=True)

    def variance(self, values: np.ndarray) -> np.ndarray:
        """Variance and covariance (k, k, n_stars) that the maps add to the terms of stars, for modes (n_modes, n)."""
        n, k = len(values), len(self.names)
        free = self.covariance.shape[0] // n
        blocks = self.covariance.reshape(free, n, free, n)
        out = np.zeros((k, k, values.shape[1]))
        out[k - free :, k - free :] = np.einsum("mj,ambn,nj->abj", values, blocks, values, optimize=True)
        return out

    def __str__(self) -> str:
        errors = self.errors()
        rate = np.sqrt(np.mean([error**2 for name, error in errors.items() if name != "parallax"])) if errors else 0.0
        by = "the scatter of the motions of stars, and that of exposures" if self.held else "the smallest dynamic part"
        words = (
            f"Motions. Maps that change with time as motions of all stars would are in the null space too: "
            f"{self.n_constraints} modes, fixed by {by}. Absolute error of a motion {rate:.2g} px/yr rms over the "
            "field, per axis"
        )
        if "parallax" in errors:
            words += f", of a parallax {errors['parallax']:.2g} px"
        if self.n_tied:
            what = "proper motions and parallaxes" if self.parallax_tied else "proper motions"
            words += f"; they are tied to the {what} of {self.n_tied} stars of the reference"
        unknown = [] if self.n_tied else ["common rates of shift, rotation and scale"]
        unknown += ["the mean parallax"] if "parallax" in self.names and not self.parallax_tied else []
        if not unknown:
            return f"{words}."
        are = "is" if unknown == ["the mean parallax"] else "are"
        return f"{words}, after {' and '.join(unknown)}, which {are} not known without a reference."

    @property
    def convention(self) -> str:
        """What of the motions no reference tells, and what stands for it, in words; empty with a reference."""
        if self.n_tied:
            return ""
        by = "rotation and scale are those of the nominal poses"
        by = by if self.held else f"their mean is zero, {by}"
        return f"motions up to common rates of shift, rotation and scale, not known without a reference ({by})"

    def tied(self, joint: np.ndarray, n_tied: int, parallax_tied: bool) -> Drift:
        """The same where a reference determined the maps, with the `joint` covariance."""
        size = len(joint) - len(self.covariance)
        return replace(self, covariance=joint[size:, size:], joint=joint, n_tied=n_tied, parallax_tied=parallax_tied)

    def errors(self) -> dict[str, float]:
        """Rms over the field [pix/yr per axis, pix] of what the maps add to motions and parallaxes, by name."""
        n = self.motion.shape[1] // 2 * self.n_fields
        free = self.names[len(self.names) - self.motion.shape[2] // n :]
        power = (
            np.diag(self.covariance).reshape(len(free), n).sum(axis=1) / 4 / self.n_fields
        )  # b_m has mean square 1/4
        return {name: float(np.sqrt(each)) for name, each in zip(free, power, strict=True)}


@dataclass(frozen=True, eq=False)
class Gauge(ShownAsPrinted):
    """What is known of a map common to all exposures, and the convention for the rest.

    Attributes
    ----------
    kind : {"minimal", "mean"} or str
        Convention. Or the name of a simpler correction, which comes with a `plane`.
    constraint : ndarray, shape (n_constraints, n_exposures, 2 n)
        Rows of the constraints; they act on A_i - A_0, x modes first.
    motion : ndarray, shape (n_exposures, 2 n, 2 n_modes)
        N_i: displacement modes of the reference plane -> coefficients of exposure i, n of them per axis.
    dynamic : ndarray, shape (n_exposures, 2 n, 2 n)
        Lambda, covariance of a single exposure's departure from the static distortion, px^2; nothing along its
        similarities.
    box : ndarray, shape (2, 2)
        Centre and half size of the reference-plane box on which the modes are defined, pixels.
    covariance : ndarray, shape (2 n_modes, 2 n_modes)
        Of the common map, px^2; without what is unknown and without shift, rotation and scale.
    unknown_maps : tuple of UnknownMap
    static : {"none", "fitted", "exact", "uncertain", "open"}
        What was known beforehand of the static distortion; "open" where nothing was assumed of the dynamic part either,
        in a prediction.
    prior : bool
        Whether the prior has widths, which then pin the modes together with the constraints.
    values : ndarray, shape (n_constraints,), or None
        What the orthonormal constraints are held at: zero, but for what residuals or a reference determine.
    released : ndarray, shape (2 n_modes, r), or None
        Maps of the reference plane, as columns, that the residuals determine.
    tie : `legdistort.results.errors.catalogue_tie.Tie` or None
        How a reference catalogue measured the common map.
    responses : object
        With ``directions``: see there.
    plane : str or None
        What the plane of a simpler correction is, in words. How far it is from the sky is not known then.
    drift : Drift or None
        Common maps that change with time, where the motions of stars are fitted.
    nights : float or None
        What exposures of a night have in common beside the static distortion, pixels, rms over the nights, the detector
        and axis; None where there is one night.
    nights_told : bool
        Whether the exposures tell that, or the caller; else it is as large as the departures themselves.
    poses_known : bool
        Whether poses are known with their errors, and so shift, rotation and scale of the common map, which is then
        complete in `covariance`.
    more_boxes : ndarray, shape (n_fields - 1, 2, 2), or None
        `box` of every further field, where exposures are in groups without a common star.
    """

    kind: str = field(metadata=text(*_CONVENTIONS, "shift", "static + shift", "relative polynomial"))
    constraint: np.ndarray = field(metadata=_ROWS)
    motion: np.ndarray = field(metadata=array("n_exposures", "2 n_map_modes", "2 n_plane_modes"))
    dynamic: np.ndarray = field(
        metadata=array("n_exposures", "2 n_map_modes", "2 n_map_modes", unit="pix2", covariance=True)
    )
    box: np.ndarray = field(metadata=array(2, 2, unit="pix"))
    covariance: np.ndarray = field(metadata=array("2 n_plane_modes", "2 n_plane_modes", unit="pix2", covariance=True))
    unknown_maps: tuple[UnknownMap, ...] = ()
    static: str = field(default="exact", metadata=text(*_STATIC))
    prior: bool = False
    values: np.ndarray | None = field(default=None, metadata=array("n_constraints", unit="pix"))
    released: np.ndarray | None = field(default=None, metadata=array("2 n_plane_modes", "released"))
    tie: Tie | None = None
    responses: Any = field(default=None, repr=False, compare=False, metadata=NOT_STORED)
    plane: str | None = None
    drift: Drift | None = None
    nights: float | None = field(default=None, metadata=number(minimum=0, unit="pix"))
    nights_told: bool = True
    poses_known: bool = False
    more_boxes: np.ndarray | None = field(default=None, metadata=array("further_fields", 2, 2, unit="pix"))

    @property
    def boxes(self) -> np.ndarray:
        """Centre and half size of the box of every field, (n_fields, 2, 2), pixels."""
        return self.box[None] if self.more_boxes is None else np.concatenate([self.box[None], self.more_boxes])

    @property
    def n_fields(self) -> int:
        """Number of fields: groups of exposures without a common star."""
        return 1 if self.more_boxes is None else 1 + len(self.more_boxes)

    def plane_modes(self, n_modes: int | None = None) -> PlaneModes:
        """The modes of the reference plane, by default those of the gauge, as `PlaneModes`."""
        return PlaneModes(self.boxes, (self.n_modes if n_modes is None else n_modes) // self.n_fields)

    @property
    def n_constraints(self) -> int:
        """Number of directions that are fixed; 2 n_modes unless exposures have modes that are fixed or shared.

        With those that change with time, where the motions of stars are fitted.
        """
        return len(self.constraint)

    @property
    def n_maps(self) -> int:
        """Number of directions among them that are the same at all times."""
        return self.n_constraints - (0 if self.drift is None else self.drift.n_constraints)

    @property
    def drift_reach(self) -> np.ndarray:
        """Modes of maps that change with time -> values of the orthonormal constraints, (n_constraints, q)."""
        return self.orthonormal @ self.drift.motion.reshape(self.orthonormal.shape[1], -1)

    @property
    def all_motion(self) -> np.ndarray:
        """`motion` with that of the maps that change with time, (n_exposures, 2 n_modes, 2 n_modes + q)."""
        return self.motion if self.drift is None else np.concatenate([self.motion, self.drift.motion], axis=2)

    @property
    def n_modes(self) -> int:
        """Modes of the reference plane per axis, those of all fields."""
        return self.motion.shape[2] // 2

    @property
    def n_own(self) -> int:
        """Modes per axis of an exposure that can compensate such maps."""
        return self.motion.shape[1] // 2

    @property
    def scatter(self) -> np.ndarray:
        """Dynamic scatter of single exposures per axis and mode (2, n), pixels, mean over the exposures."""
        return np.sqrt(np.einsum("iaa->a", self.dynamic) / len(self.dynamic)).reshape(2, -1)

    @cached_property
    def orthonormal(self) -> np.ndarray:
        """Orthonormal rows that span `constraint`, shape (n_constraints, n_exposures * 2 n_modes)."""
        return np.linalg.qr(self.constraint.reshape(self.n_constraints, -1).T)[0].T

    def violation(self, departure: np.ndarray) -> np.ndarray:
        """How far departures A_i - A_0 (n_exposures, 2 n_modes) are from the values of the orthonormal constraints."""
        return self.orthonormal @ departure.ravel() - (0 if self.values is None else self.values)

    @cached_property
    def reach(self) -> np.ndarray:
        """Reference-plane modes -> values of the orthonormal constraints, shape (n_constraints, 2 n_modes)."""
        return self.orthonormal @ self.motion.reshape(-1, 2 * self.n_modes)

    @property
    def measured(self) -> np.ndarray:
        """Combinations of the orthonormal constraints, as columns, at which residuals determine the values."""
        return np.linalg.qr(self.reach @ (np.zeros((2 * self.n_modes, 0)) if self.released is None else self.released))[
            0
        ]

    def modes_at(self, xy: ArrayLike, n_modes: int | None = None) -> np.ndarray:
        """Values (n_modes, n) of the reference-plane modes, by default of the gauge, at reference positions (n, 2)."""
        return self.plane_modes(n_modes).at(xy)

    def common_map(self, departure: np.ndarray) -> np.ndarray:
        """The map (2 n_modes,) of the reference plane, similarities aside, to which departures A_i - A_0 amount."""
        similar = self.plane_modes().similar
        reach = self.reach if self.drift is None else self.orthonormal @ self.all_motion.reshape(departure.size, -1)
        out = -np.linalg.pinv(reach)[: 2 * self.n_modes] @ self.orthonormal @ departure.ravel()
        return out - similar.T @ (similar @ out)

    @property
    def directions(self) -> np.ndarray:
        """How a unit of every mode of the common map moves the stars, (n_stars, 2, 2 n_modes).

        Each is what the stars do when the plane is held elsewhere by this mode and all else is fitted again: the mode
        itself and, in second order, its product with the gradient of the distortions.
        """
        return self.responses.directions

    @property
    def unknown(self) -> tuple[UnknownDirection, ...]:
        """Directions that nothing determines, as a tuple of `UnknownDirection`.

        Posterior standard deviation above 1 px, rms over the stars, where no size of the static distortion is stated.
        """
        mapped = tuple(
            UnknownDirection(each.name, self.directions @ each.map, changes)
            for each, changes in zip(self.unknown_maps, self.unknown_coefficients, strict=False)
        )
        return mapped + self.responses.weak

    @property
    def unknown_coefficients(self) -> list[np.ndarray]:
        """How the coefficients change with each direction of `unknown`, (n_exposures, 2, n) each, pixels."""
        shape = (len(self.motion), 2, self.n_own)
        mapped = [-(self.motion @ each.map).reshape(shape) for each in self.unknown_maps]
        return mapped + [each.coefficients for each in (() if self.responses is None else self.responses.weak)]

    @property
    def absolute_covariance(self) -> np.ndarray:
        """Covariance of the modes of the common map, px^2, without what is unknown.

        (2 n_modes,) squared, similarities left out as a matter of pointing; with a reference it is what that leaves
        open, similarities included, in three modes at least.
        """
        return self.covariance if self.tie is None else self.tie.covariance

    @property
    def joint_covariance(self) -> np.ndarray:
        """Covariance of the modes of the common map and of `Drift`, (2 n_modes + q) squared."""
        if self.drift.joint is not None:
            return self.drift.joint
        tied = self.absolute_covariance  # in more modes than the drift has where the fitted degree is 0
        return block_diag(tied if len(tied) == 2 * self.n_modes else self.covariance, self.drift.covariance)

    def absolute_errors(self) -> list[tuple[str, int, float]]:
        """Absolute error by degree of the common map: rms over the field and axis, pixels, without what is unknown.

        Returns
        -------
        list of (str, int, float)
            Name, number of modes, error; the similarities first, NaN unless a reference or poses determine them.
        """
        if self.tie is not None:
            return self.tie.errors(self.plane_modes(len(self.tie.covariance) // 2))
        if self.poses_known:
            return errors_by_degree(self.covariance, self.plane_modes())
        of_degree = self.plane_modes().degrees
        variance = np.diag(self.covariance).reshape(2, -1).sum(axis=0) / 8  # b_m has mean square 1/4
        variance, degree = np.bincount(of_degree, variance) / self.n_fields, of_degree.max()
        rows = [("shift, rotation, scale" if degree else "shift", (4 if degree else 2) * self.n_fields, np.nan)]
        for d in range(1, degree + 1):
            n = (2 * (d + 1) if d > 1 else 2) * self.n_fields
            rows.append((f"degree {d}" if d > 1 else "shear", n, variance[d] ** 0.5))
        return rows

    @property
    def absolute_error(self) -> float:
        """Error of the common map, rms over the stars and axis, pixels; what is unknown and noise of stars aside.

        Errors of its degrees (`absolute_errors`) may be larger, each by itself over the whole field.
        """
        covariance = self.absolute_covariance
        if self.responses is None or len(covariance) != 2 * self.n_modes:
            return float(np.sqrt(np.nansum([error**2 for *_, error in self.absolute_errors()])))
        moved = self.directions.reshape(-1, len(covariance))
        return float(np.sqrt(np.einsum("nm,mk,nk->", moved, covariance, moved, optimize=True) / len(moved)))

    @property
    def unknown_names(self) -> list[str]:
        """Names of what is unknown, each once."""
        weak = () if self.responses is None else self.responses.weak
        return tuple(dict.fromkeys(each.name for each in (*self.unknown_maps, *weak)))

    @property
    def unknown_in_words(self) -> str:
        """The same for a reader; empty for nothing."""
        return in_words(self.unknown_names) if self.unknown_names else ""

    @property
    def rates_in_words(self) -> str:
        """What of the motions of stars is a convention, and which; empty without motions, or if all is known."""
        return "" if self.drift is None or self.poses_known else self.drift.convention

    @property
    def warning(self) -> str:
        """In a sentence, that absolute positions are not known, why, and what to do; empty if they are."""
        if not self.unknown_names:
            return ""
        why = _STATIC[self.static][0]
        cure = "give dynamic (--dynamic)" if self.static == "open" else CURE
        if self.tie is not None:
            cure = cure.replace(_TIE, _MORE)
        return f"absolute positions are not known: {why} ({self.unknown_in_words} not determined); {cure}"

    @property
    def sentence(self) -> str:
        """The convention in a sentence."""
        if self.plane is not None:
            return f"{self.kind}: the plane is {self.plane}; absolute errors are not available"
        error = self.absolute_error
        tied = f"{self.tie.sentence}; " if self.tie is not None else ""
        after = f" after {self.unknown_in_words}" if self.unknown_names else ""
        aside = ", apart from the pointing" if self.tie is None and not self.poses_known else ""
        doubt = " if the reference is right, which the exposures contradict"
        doubt = doubt if self.tie is not None and self.tie.is_contradicted else ""
        known = f"{tied}absolute to {error:.2g} px rms per axis{after}{aside}{doubt}"
        if after and error == 0:  # nothing of the common map is known
            known = "absolute positions are not known"
        known += f"; {self.rates_in_words}" if self.rates_in_words else ""
        return f"{self.kind} ({_CONVENTIONS[self.kind]}), {self.n_maps} modes of a common map; {known}"

    def __repr__(self) -> str:
        return f"<Gauge {self.kind!r}: {self.n_constraints} constraints, {len(self.motion)} exposures>"

    def __str__(self) -> str:
        if self.plane is not None:
            return self.sentence
        convention = f"the constraint ({_CONVENTIONS[self.kind]})" + (" and the prior widths" if self.prior else "")
        degree = basis.degree_of(self.n_own)
        lines = [
            f"Gauge {self.kind!r}. A map of the reference plane of degree {degree} that every exposure compensates "
            f"changes no residual (null space): {self.n_maps} modes, {min(6, self.n_maps)} of them exactly.",
            f"{'modes':24s} {'number':>6s} {'absolute error':>15s}  determined by",
        ]
        measured = {} if self.tie is None else self.tie.words(convention)
        if self.poses_known:
            measured = dict.fromkeys((name for name, *_ in self.absolute_errors()), f"{convention} and the known poses")
            measured["shift, rotation, scale"] = "the poses, which are known"
        for name, n, error in self.absolute_errors():
            size = "not known" if np.isnan(error) else f"{error:.2g} px"
            cause = measured.get(name) or ("the nominal poses, mean over exposures" if np.isnan(error) else convention)
            here = [w for w in self.unknown_maps if (f"degree {w.degree}" if w.degree > 1 else "shear") == name]
            if here:
                cause += f"; {len(here)} of them ({in_words(w.name for w in here)}) not known"
                size = "not known" if len(here) == n else size
            lines.append(f"{name:24s} {n:6d} {size:>15s}  {cause}")
        if self.released is not None:
            lines.append(
                f"{self.released.shape[1]} combinations that are not known otherwise are determined by residuals of "
                "second order, from which their absolute error follows."
            )
        lines += [self.warning[0].upper() + self.warning[1:] + "."] if self.warning else []
        lines += [] if self.drift is None else [str(self.drift)]
        if self.drift is not None and not (self.drift.n_tied or self.nights_told) and self.static == "fitted":
            weak = self.responses is not None and self.responses.weak
            lines.append(
                "Too few nights tell such a map of motions from the static distortion that all exposures share: "
                + ("absolute errors of motions are not known." if weak else "these errors may be far too large.")
            )
        if self.static == "open":
            return "\n".join(lines)
        dynamic = np.sqrt(np.sum(self.scatter**2) / 8)
        nights = "" if self.nights is None else f", and those of a night together by {self.nights:.2g} px"
        if not self.nights_told:
            nights += " at most, since too few nights tell (night_sigma, --night-sigma, states it)"
        lines.append(
            f"Absolute errors (rms over the field, per axis) come from {_STATIC[self.static][1]}; single exposures "
            f"depart from their mean by {dynamic:.2g} px rms per axis{nights}. "
            + ("No external reference was used." if self.tie is None else self.tie.statement)
        )
        return "\n".join(lines)


def warning_of(solution):
    """The `Gauge.warning` of a solution, with what to do about one of a camera with several detectors."""
    of_camera = solution.camera.has_focal_plane or solution.settings.dynamic == "detector"
    warning = solution.gauge.warning
    if not of_camera:
        return warning
    tied = CURE_OF_CAMERA.replace(f"{_TIE} (--reference)", _MORE)
    return warning.replace(CURE, CURE_OF_CAMERA).replace(CURE.replace(_TIE, _MORE), tied)


def in_words(names):
    """Names of unknown maps for a reader, each once: those of powers of z are changes of scale, with their formulas."""
    names = list(dict.fromkeys(names))
    powers = [name for name in names if "z^" in name]
    degrees = [name.removeprefix("degree ") for name in names if name.startswith("degree ")]
    words = [name for name in names if name not in powers and not name.startswith("degree ")]
    words = ["part of the static distortion" if name == "static" else name for name in words]
    words += [f"change of scale over the field ({', '.join(powers)} with z = x + iy)"] * bool(powers)
    words += [f"maps of degree {', '.join(degrees)}"] * bool(degrees)
    return f"{', '.join(words[:-1])} and {words[-1]}" if len(words) > 1 else words[0]
