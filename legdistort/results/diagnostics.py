"""What `solve` found out beside the solution itself, in numbers and in words."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import nnls

from ..exceptions import some_of
from ..geometry.tabulated.rough_basis import RoughBasis
from ..inputs import column_contract
from ..runtime.trees.facts import YEARS, number, text
from .errors.header_pointing import HeaderPointing

if TYPE_CHECKING:
    from astropy.table import QTable
    from numpy.typing import ArrayLike

#: Twice the gain in the logarithm of the likelihood from which stars count as moving. Without motions it has the
#: distribution of half a chi2 with one degree of freedom: 0.5 % of motionless sets exceed it
#: (measured: none of 100, tests/benchmarks/motions_table.py).
MOVING = 6.6

#: Fits of a law of errors one after the other, each with the weights of that before; halvings of a step that is too
#: long, and the gain in the logarithm of the likelihood below which there is nothing left to find.
_ROUNDS, _HALVINGS, _NO_GAIN = 20, 10, 1e-6
#: Law and factors of exposures are found in turn. An exposure counts as if so many of its stars scattered as those of
#: the others: its factor is known as well as 10 %.
_SWEEPS, _COMMON_STARS = 5, 20
#: Logarithm of the likelihood that fluxes at a common level must gain over those as they are.
_GAIN = 3.0

_MOST_NAMED = 6
_COUNT, _SCALE, _PIXELS = number(minimum=0), number(minimum=0), number(minimum=0, unit="pix")


@dataclass(frozen=True)
class AliasedDegree:
    """What the modes of a degree beyond the fit do to it (paper, section 4.3).

    Attributes
    ----------
    degree : int
    found, noise : float
        Rms of its modes over the field, per axis, and what their errors explain of it, pixels.
    excess : float
        Of the energy over that of noise, in standard deviations. Where it would raise the alarm and the static
        distortion is not given exactly, what unknown common maps do to second order counts as noise, here alone.
    energy : float
        Rms beyond the noise, pixels.
    folds_into : tuple of float
        The same as it appears at degree 0, 1 ... of the fit.
    mode, into : tuple of int
        The mode with most energy and the mode in which most of it appears, orders in x and y.
    """

    degree: int = field(metadata=_COUNT)
    found: float = field(metadata=_PIXELS)
    noise: float = field(metadata=_PIXELS)
    excess: float
    energy: float = field(metadata=_PIXELS)
    folds_into: tuple[float, ...] = field(metadata=_PIXELS)
    mode: tuple[int, int] = field(metadata=_COUNT)
    into: tuple[int, int] = field(metadata=_COUNT)


@dataclass(frozen=True)
class DegreeChoice:
    """How the degree was chosen.

    Attributes
    ----------
    degree : int
    degrees : tuple of int
        Those that were tried: as many as the stars allow, until three in a row are no better.
    scores : tuple of float
        Of these, the squared scatter of stars kept out over that of their errors.
    n_folds : int
        Parts of the stars that were kept out in turn.
    aliasing : tuple of AliasedDegree
    alarm : bool
        Whether one of these is there beyond doubt.
    sentence : str
    """

    degree: int = field(metadata=_COUNT)
    degrees: tuple[int, ...] = field(metadata=number(minimum=0, length="tried"))
    scores: tuple[float, ...] = field(metadata=number(minimum=0, length="tried"))
    n_folds: int = field(metadata=_COUNT)
    aliasing: tuple[AliasedDegree, ...]
    alarm: bool
    sentence: str


@dataclass(frozen=True)
class Validation:
    """How stars that a solution has not seen scatter.

    Attributes
    ----------
    fraction : float
        As it was asked for.
    n_stars, n_observations, n_clipped : int
    scatter, expected : float
        Rms over the stars, per axis, pixels (paper, section 3.4, second criterion).
    ratio : float
        Of the two.
    """

    fraction: float = field(metadata=number(minimum=0, maximum=1))
    n_stars: int = field(metadata=_COUNT)
    n_observations: int = field(metadata=_COUNT)
    n_clipped: int = field(metadata=_COUNT)
    scatter: float = field(metadata=_PIXELS)
    expected: float = field(metadata=_PIXELS)
    ratio: float = field(metadata=_SCALE)

    def __str__(self) -> str:
        return (
            f"{self.n_stars} stars, {self.n_observations} observations, out of the solution: they scatter by "
            f"{self.scatter:.4f} px per axis, {self.expected:.4f} expected from the errors (ratio {self.ratio:.2f})"
        )


@dataclass(frozen=True)
class UsedReference:
    """The reference catalogue to which a solution is tied.

    Attributes
    ----------
    name : str
    epoch : float or None
        Of the exposures, years.
    n_stars : int
        That were used.
    rms_px : float
        Of their offsets per axis, pixels.
    """

    name: str
    epoch: float | None = field(metadata=YEARS)
    n_stars: int = field(metadata=_COUNT)
    rms_px: float = field(metadata=_PIXELS)


@dataclass(frozen=True)
class ErrorLaw:
    """Errors by brightness: ``sigma^2 = factor^2 ((a / flux)^2 + b^2 / flux + floor^2)``, the same in x and y.

    Attributes
    ----------
    a, b, floor : float
        Pixels, in units of the flux of the observations, at the common level where there is one.
    factors : dict
        ``{exposure: factor}``.
    levels : dict
        ``{exposure: factor}`` that brings its fluxes to the level that all exposures have in common; empty where the
        law holds for the fluxes as they are.
    """

    a: float = field(metadata=_PIXELS)
    b: float = field(metadata=_PIXELS)
    floor: float = field(metadata=_PIXELS)
    factors: dict[str, float] = field(metadata=_SCALE)
    levels: dict[str, float] = field(default_factory=dict, metadata=_SCALE)

    @classmethod
    def of(cls, flux: ArrayLike, variance: ArrayLike, factors: dict[str, float] | None = None) -> ErrorLaw:
        """The law that variances [pix^2] follow, measured at some fluxes (n,): as the mean of a gamma distribution.

        The spread of a measured variance goes with the true one. The likeliest law is sought from each of its terms
        alone, as from a bad start the search may end at another than the best.
        """
        flux = np.asarray(flux, dtype=float)
        terms = np.column_stack([flux**-2.0, 1 / flux, np.ones(len(flux))])
        alone = np.diag(np.mean(np.asarray(variance)[:, None] / terms, axis=0))
        _, size = min((_likeliest(terms, variance, start) for start in alone), key=lambda found: found[0])
        return cls(*map(float, np.sqrt(size)), factors or {})

    @classmethod
    def likelier(
        cls, flux: np.ndarray, variance: np.ndarray, exposure: np.ndarray, levels: np.ndarray
    ) -> tuple[ErrorLaw, np.ndarray, np.ndarray]:
        """The law of measured variances (n,), of fluxes as they are or at their common level, whichever is likelier.

        Counts tell errors as they are, of short exposures too; magnitudes of lists with zero points of their own do
        once they are at one level.

        Parameters
        ----------
        flux, variance : ndarray, shape (n,)
            Rows without a flux get that of the faintest. Pixels^2.
        exposure : ndarray of int, shape (n,)
        levels : ndarray, shape (n_exposures,)
            Factors that bring the fluxes of exposures to a common level.

        Returns
        -------
        ErrorLaw
            Of the average exposure.
        factor, level : ndarray, shape (n_exposures,)
            On the errors of an exposure, and on its fluxes: 1 where these count as they are.
        """
        count, found = np.bincount(exposure, minlength=len(levels)), []
        for level in (np.ones(len(levels)), levels):
            at_level, factor = filled(flux, level[exposure]) * level[exposure], np.ones(len(levels))
            for _ in range(_SWEEPS):
                law = cls.of(at_level, variance / factor[exposure] ** 2)
                own = law.sigma(at_level) ** 2
                ratio = np.bincount(exposure, variance / own, len(levels))
                factor = np.sqrt((ratio + _COMMON_STARS) / (count + _COMMON_STARS))
            model = factor[exposure] ** 2 * own
            found.append((np.sum(np.log(model) + variance / model), law, factor, level))
        as_they_are, at_one_level = found
        return (at_one_level if at_one_level[0] < as_they_are[0] - _GAIN else as_they_are)[1:]

    def sigma(self, flux: ArrayLike, exposure: ArrayLike | None = None) -> np.ndarray:
        """Error [pix] of positions with a flux (n,), in the exposures named (n,).

        By default in the average exposure, of fluxes at the common level.
        """
        flux, factor = np.asarray(flux, dtype=float), 1.0
        if exposure is not None:
            factor = np.array([self.factors.get(name, 1.0) for name in np.asarray(exposure).tolist()])
            flux = self.at_level(flux, exposure)
        return factor * np.sqrt((self.a / flux) ** 2 + self.b**2 / flux + self.floor**2)

    def at_level(self, flux: ArrayLike, exposure: ArrayLike) -> np.ndarray:
        """Fluxes (n,) of the exposures named (n,), brought to the level of the law."""
        return np.asarray(flux, dtype=float) * [self.levels.get(name, 1.0) for name in np.asarray(exposure).tolist()]

    def knows(self, flux: ArrayLike) -> np.ndarray:
        """Of which positions the law gives errors: those with a positive flux, (n,) of bool."""
        flux = np.asarray(flux, dtype=float)
        return np.isfinite(flux) & (flux > 0)

    def scaled(self, factor: float) -> ErrorLaw:
        """The law with all errors multiplied."""
        return replace(self, a=self.a * factor, b=self.b * factor, floor=self.floor * factor)

    def __str__(self) -> str:
        factors, levels = list(self.factors.values()), list(self.levels.values())
        of = f"; fluxes times {min(levels):.3g} to {max(levels):.3g} by exposure, by common stars" if levels else ""
        return (
            f"by brightness, from the scatter of the stars: sqrt(({self.a:.4g} / flux)^2 + {self.b:.4g}^2 / flux + "
            f"{self.floor:.4g}^2) px, times {min(factors):.2f} to {max(factors):.2f} by exposure{of}"
        )


def _likeliest(terms, variance, size):
    """Minus the logarithm of the likelihood, and sizes >= 0 of terms (n, k) with which they follow measured variances.

    Reweighted least squares, which move down the likelihood at first; a whole step may lead past the minimum, where
    the next leads back, and the two go on for ever.
    """

    def badness(model):
        return np.sum(np.log(model) + variance / model)

    model = terms @ size
    least = badness(model)
    for _ in range(_ROUNDS):
        weighted = terms / model[:, None]
        norm = np.sqrt((weighted**2).sum(axis=0))
        step = nnls(weighted / norm, variance / model)[0] / norm - size
        for part in 0.5 ** np.arange(_HALVINGS):
            moved = size + part * step
            if not np.any(moved):
                continue
            moved *= np.mean(variance / (terms @ moved))  # the likeliest scale
            if badness(terms @ moved) < least - _NO_GAIN:
                break
        else:
            break
        size, model = moved, terms @ moved
        least = badness(model)
    return least, size


def filled(flux: np.ndarray, level: np.ndarray | float) -> np.ndarray:
    """Fluxes (n,) of which those that are missing are that of the faintest, once they are multiplied by a level."""
    known = np.isfinite(flux) & (flux > 0)
    return np.where(known, flux, (flux * level)[known].min() / level)


#: Polynomials that times ``exp(-u)`` are the correlation of processes with 0, 1 and 2 derivatives, and where it is 1/e.
MATERN = (1.0,), (1.0, 1.0), (1.0, 1.0, 1 / 3)
FOLDING = 1.0, 2.146193220620583, 2.904629975029914


@dataclass(frozen=True)
class MotionScatter:
    """Scatter of the proper motions of stars.

    Attributes
    ----------
    sigma : float
        Per axis, pixels a year.
    gain : float
        Twice the gain in the logarithm of the likelihood over stars that do not move.
    n_stars : int
        Whose motions are determined.
    """

    sigma: float = field(metadata=number(minimum=0, unit="pix/yr"))
    gain: float
    n_stars: int = field(metadata=_COUNT)

    @property
    def is_there(self) -> bool:
        """Whether stars move beyond doubt."""
        return self.gain > MOVING

    def __str__(self) -> str:
        seen = f"{self.n_stars} stars, twice the gain in log-likelihood {self.gain:.3g}, {MOVING} needed"
        if self.is_there:
            return f"stars move: proper motions scatter by {self.sigma:.2g} px/yr per axis ({seen})"
        return f"stars do not move beyond their errors ({seen})"


@dataclass(frozen=True)
class CorrelatedErrors:
    """Errors of a star that are alike in neighbouring exposures, found from the residuals of all stars.

    What is the same in all exposures is not among them: it is in the positions, and nothing determines it.

    Attributes
    ----------
    floor : float
        Of the independent errors, pixels, in quadrature to the stated ones.
    x, y : float
        Standard deviations of the others by axis of the reference plane, pixels.
    along : {"time", "x", "y"} or None
        They are alike in exposures that are near one another in time, or that have the star near the same x or y of the
        detector. None: there are none that could be seen, or too few exposures or stars to see them.
    length, longest : float
        Over which their correlation falls to 1/e, and the largest such length that could have been found.
    unit : str
        Of these: "exposures", "days", or "px".
    reason : str
        Why they could not be looked for.
    derivatives : {0, 1, 2}
        How smoothly they change: with a correlation of ``exp(-u)``, ``(1 + u) exp(-u)`` or ``(1 + u + u^2/3) exp(-u)``
        (Matern 1/2, 3/2, 5/2).
    """

    floor: float = field(metadata=_PIXELS)
    x: float = field(default=0.0, metadata=_PIXELS)
    y: float = field(default=0.0, metadata=_PIXELS)
    along: str | None = field(default=None, metadata=text("time", "x", "y"))
    length: float = field(default=0.0, metadata=_SCALE)
    longest: float = field(default=0.0, metadata=_SCALE)
    unit: str = ""
    reason: str = ""
    derivatives: int = field(default=0, metadata=number(minimum=0, maximum=len(FOLDING) - 1))

    @property
    def scale(self) -> float:
        """Distance at which u of the correlation is 1."""
        return self.length / FOLDING[self.derivatives]

    def correlation(self, distance: ArrayLike) -> np.ndarray:
        """Correlation of the errors of a star at some distances, in the unit of the length."""
        u = np.abs(distance) / self.scale
        return np.exp(-u) * np.polynomial.polynomial.polyval(u, MATERN[self.derivatives])

    def __str__(self) -> str:
        constant = "errors that are the same in all exposures cannot be measured"
        if self.reason:
            return f"errors that exposures share are not measurable: {self.reason}"
        if self.along is None:
            return f"no errors that neighbouring exposures share were found; {constant}"
        number, unit, most = _readable(self.length, self.longest, self.unit)
        where = "in time" if self.along == "time" else f"along {self.along} of the detector"
        length = f"{number:.2g} {unit}"
        if self.length > 0.95 * self.longest:
            length = f"{most:.2g} {unit} or more: their slower part is not measured well"
        return (
            f"{self.x:.2g} px in x and {self.y:.2g} px in y of every star are shared by exposures near one another "
            f"{where}, over {length}; the errors of the stars include them; {constant}"
        )


def _readable(length, longest, unit):
    """Lengths in a unit that suits them."""
    if unit == "days":
        for factor, name in ((1440, "min"), (24, "h"), (1, "days")):
            if length * factor < 100 or name == "days":
                return length * factor, name, longest * factor
    return length, unit, longest


@dataclass(frozen=True)
class FittedTerm:
    """What was found of a term (`legdistort.Term`): numbers beside those of stars, poses and distortions.

    Attributes
    ----------
    name, unit : str
        Of the term, and of its numbers.
    owner : {"set", "exposure", "detector", "star"}
    size : float
        Scatter of the numbers about zero, found or as it was given; 0: the positions do not show the term.
    gain : float
        By which twice the logarithm of the likelihood is larger with it.
    found : bool
        Whether the size was found.
    rms : float
        Of the displacements, pixels per axis.
    n_asked : int
        Owners that might have it.
    owners, numbers : tuple of str
        Exposure or detector, and name, of every number.
    values, errors : tuple of float
        In `unit`; no errors of what describes a random field.
    bases : tuple of RoughBasis
        Of every detector, in the order of the owners, where the term is a part of their distortions: its functions, at
        undistorted pixels, of which half of the numbers are displacements along x, then along y.
    """

    name: str
    unit: str
    owner: str = field(metadata=text("set", "exposure", "detector", "star"))
    size: float = field(metadata=_SCALE)
    gain: float
    found: bool
    rms: float = field(metadata=_PIXELS)
    n_asked: int = field(metadata=_COUNT)
    owners: tuple[str, ...]
    numbers: tuple[str, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...] = field(metadata=_SCALE)
    bases: tuple[RoughBasis, ...] = ()

    def __str__(self) -> str:
        seen = f"twice the gain in log-likelihood {self.gain:.3g}"
        if not self.size:
            return f"{self.name}: the positions do not show it, it is left away"
        if not self.errors:  # of a random field
            shown = dict(zip(self.numbers, self.values, strict=True))
            drawn = f", {shown['axis ratio']:.2g} times as long along {shown['angle']:.0f} deg from x"
            what = f"a field of every exposure, {self.size:.2g} px over lengths of {shown['length']:.3g} px"
            what += drawn * (shown["axis ratio"] > 1)
            if "factor on x errors" in shown:
                x, y = (shown[f"factor on {axis} errors"] for axis in "xy")
                what += f", beside {x:.2f} and {y:.2f} times the stated errors in x and y"
            return f"{self.name}: {what}; it displaces positions by {self.rms:.2g} px rms per axis ({seen})"
        n, owners = len(self.values), list(dict.fromkeys(self.owners))
        if n == 1:
            what = f"{self.values[0]:.4g} +- {self.errors[0]:.2g} {self.unit} {self.numbers[0]}"
        elif len(owners) < self.n_asked:
            named = some_of(owners, _MOST_NAMED)
            what = f"{len(owners)} of {self.n_asked} {self.owner}s ({named}), {self.size:.2g} {self.unit}"
        else:
            each = f", of every {self.owner} its own" if len(owners) > 1 else ""
            what = f"{n} numbers{each}, {self.size:.2g} {self.unit}"
        return f"{self.name}: {what}; it displaces positions by {self.rms:.2g} px rms per axis ({seen})"


@dataclass(frozen=True)
class Diagnostics:
    """What `solve` found out; None for what was not asked for.

    Attributes
    ----------
    error_floor : float
        Pixels, added in quadrature to every stated error.
    error_scale : float
        Factor on the stated errors.
    error_law : ErrorLaw or None
        Errors by brightness that took the place of those stated.
    correlated : CorrelatedErrors or None
        Errors that neighbouring exposures share.
    epoch : float or None
        Of the positions, a Julian year.
    sky : {"exposures", "reference", None}
        From which the place on the sky is known.
    reference : UsedReference or None
    widths : tuple of float, dict of them, or None
        Widths of the prior that were found, pixels, of a coefficient of degree 1, 2 and so on; by detector or exposure
        if the prior was given so. In units of the errors as they are scaled.
    prior_has_widths : bool
    effective_modes : dict or None
        ``{exposure: number}`` of its modes, both axes together, that the data determine.
    departure_ratio : float or None
        Rms departure of the exposures from the mean of the prior against what its widths lead to expect.
    selection : DegreeChoice or None
    validation : Validation or None
    motion_scatter : MotionScatter or None
        Whether stars move, where the set was asked.
    higher_static : float or None
        Rms per axis over the detector, pixels, of what exposures were found to have in common beyond the degree of the
        fit; it is part of every distortion. None: nothing was found.
    static_departure : dict or None
        How far static distortions that were fitted depart from those that were given, rms per axis over the detector,
        pixels: ``{detector: (rms, its error)}``, that of a map that all detectors share aside, or ``(rms,)`` where it
        is not at hand. None: none was fitted, or none given.
    pointing : HeaderPointing or None
        How well the headers tell where the plane lies on the sky, where they do.
    terms : tuple of FittedTerm
        Those that were asked for; what they displace positions by is taken off these.
    """

    error_floor: float = field(default=0.0, metadata=_PIXELS)
    error_scale: float = field(default=1.0, metadata=_SCALE)
    sky: str | None = field(default=None, metadata=text("exposures", "reference"))
    reference: UsedReference | None = None
    widths: tuple[float, ...] | dict[str, tuple[float, ...] | None] | None = field(default=None, metadata=_PIXELS)
    prior_has_widths: bool = False
    effective_modes: dict[str, float] | None = None
    departure_ratio: float | None = field(default=None, metadata=_SCALE)
    selection: DegreeChoice | None = None
    validation: Validation | None = None
    error_law: ErrorLaw | None = None
    epoch: float | None = field(default=None, metadata=YEARS)
    correlated: CorrelatedErrors | None = None
    motion_scatter: MotionScatter | None = None
    higher_static: float | None = field(default=None, metadata=_PIXELS)
    static_departure: dict[str, tuple[float, ...]] | None = field(default=None, metadata=_PIXELS)
    pointing: HeaderPointing | None = None
    terms: tuple[FittedTerm, ...] = ()

    def found_errors(
        self,
        covariance: np.ndarray,
        *,
        flux: ArrayLike | None = None,
        exposure: ArrayLike | None = None,
        axes: np.ndarray | None = None,
    ) -> np.ndarray:
        """Errors of measured positions as they count in this solution, from those that were stated.

        ``scale^2 (covariance + floor^2 I)``. A law of brightness takes the place of the stated errors, whose
        correlation of x and y stays; positions without a positive flux keep them. The floor of correlated errors holds
        what neighbouring exposures share, as it does for the weights of the observations. Where the covariance is zero
        it stays so: there is no measurement.

        Parameters
        ----------
        covariance : ndarray, shape (n, 2, 2)
            As stated, pixels^2.
        flux : array_like, shape (n,), optional
            In units of the flux of the observations.
        exposure : array_like of str, shape (n,), optional
            By default one of average errors by the law.
        axes : ndarray, shape (2, 2) or (n, 2, 2), optional
            Those of the reference plane on the detector. With them what exposures share differs from axis to axis.

        Returns
        -------
        ndarray, shape (n, 2, 2)
        """
        out, law, shared = np.array(covariance, dtype=float), self.error_law, self.correlated
        measured = out.any(axis=(1, 2))
        if law is not None and flux is not None:
            out = _by_law(out, law, flux, exposure)
        independent, common = self.error_floor, np.zeros((2, 2))
        if axes is not None and shared is not None and shared.along is not None:
            independent, common = shared.floor, axes @ np.diag([shared.x**2, shared.y**2]) @ np.swapaxes(axes, -1, -2)
        out = self.error_scale**2 * (out + independent**2 * np.eye(2) + common)
        return np.where(measured[:, None, None], out, 0.0)

    def errors_of(self, table: QTable, *, axes: np.ndarray | None = None) -> np.ndarray:
        """`found_errors` (n, 2, 2) [pix^2] of positions in a table with ``x_err``, ``y_err`` and ``exposure``."""
        flux = column_contract.values(table, "flux") if "flux" in table.colnames else None
        return self.found_errors(column_contract.covariance(table), flux=flux, exposure=table["exposure"], axes=axes)

    def in_words(self) -> dict[str, str]:
        """Sentences on errors found, widths of a prior, the degree chosen, terms, and the stars that were kept out.

        Returns
        -------
        dict
            Those that apply, ``{"errors" | "widths" | "modes" | "higher" | "static" | "degree" | "motion" | "terms" |
            "kept": sentence}``.
        """
        found = self.error_law or self.correlated
        words = {} if found is None else {"errors": str(found)}
        if widths := _in_words(self.widths):
            words["widths"] = f"scatter of a coefficient, found from the exposures: {widths}"
        if self.effective_modes and self.prior_has_widths:
            number = np.array(list(self.effective_modes.values()))
            words["modes"] = (
                f"{number.min():.1f} to {number.max():.1f} an exposure, both axes together, are determined by the "
                "data, the others by the prior or the gauge"
            )
            if self.departure_ratio is not None:
                words["modes"] += (
                    f"; departures from the prior mean are {self.departure_ratio:.2f} of those that its widths lead to "
                    "expect"
                )
        if self.higher_static is not None:
            words["higher"] = (
                f"terms beyond the degree that all exposures of a detector have in common, {self.higher_static:.2g} px "
                "rms per axis, are part of every distortion"
            )
        if self.static_departure:
            words["static"] = _departure_in_words(self.static_departure)
        if self.selection is not None:
            words["degree"] = self.selection.sentence
        if self.motion_scatter is not None:
            words["motion"] = str(self.motion_scatter)
        if self.terms:
            words["terms"] = "; ".join(map(str, self.terms))
        if self.validation is not None:
            words["kept"] = str(self.validation)
        return words

    def summary(self) -> dict[str, Any]:
        """What there is of it as plain numbers and strings by name, for summaries."""
        names = "widths", "effective_modes", "departure_ratio", "selection", "validation", "error_law", "correlated"
        names += ("motion_scatter", "higher_static", "static_departure", "terms")
        return {name: found for name, found in asdict(self).items() if name in names and found not in (None, ())}


def _by_law(covariance, law, flux, exposure):
    """Covariances (n, 2, 2) with the variances of an `ErrorLaw`, where there is a flux (n,)."""
    known = law.knows(flux)
    names = None if exposure is None else np.asarray(exposure)[known]
    variance = law.sigma(np.asarray(flux, dtype=float)[known], names) ** 2
    out, (a, b) = covariance.copy(), np.einsum("nkk->kn", covariance[known])
    correlation = np.divide(covariance[known, 0, 1], np.sqrt(a * b), out=np.zeros(len(a)), where=a * b > 0)
    out[known] = variance[:, None, None] * (np.eye(2) + correlation[:, None, None] * np.eye(2)[::-1])
    return out


def _departure_in_words(found):
    """How far static distortions depart from those given, by detector, the farthest first."""
    listed = sorted(found.items(), key=lambda each: -each[1][0])
    several = len(listed) > 1
    each = []
    for name, (rms, *error) in listed:
        known = f" (error {error[0]:.2g} px)" if error else ""
        each.append(f"{rms:.2g} px rms per axis{known}{f' on {name}' if several else ''}")
    which = "distortions depart from those" if several else "distortion departs from the one"
    aside = "; the errors leave out that of a map that all detectors share" * any(len(e) > 1 for _, e in listed)
    return f"the static {which} given by {some_of(each, _MOST_NAMED)}{aside}"


def _in_words(widths):
    """Widths by degree, or a dict of them; empty where nothing was found, or nothing scatters (degree 0)."""
    if isinstance(widths, dict):
        return "; ".join(f"{name} {_in_words(each)}" for name, each in widths.items() if each)
    if not widths:
        return ""
    degrees = ", ".join(["1", "2", "..."][: len(widths)])
    return f"{', '.join(f'{width:.3g}' for width in widths)} px at degree {degrees}"
