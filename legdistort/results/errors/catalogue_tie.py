"""How a reference catalogue tied a solution."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from ...runtime.trees.facts import array, number
from ..check import CERTAIN, FALSE_ALARM

if TYPE_CHECKING:
    from ...geometry.plane_modes import PlaneModes

#: A plane that has not settled, but within this part of its error: absolute errors would change by 5 % at most.
HARMLESS = 0.3


@dataclass(frozen=True)
class Agreement:
    """What the offsets of a reference say of it, tested against what everything else says.

    Attributes
    ----------
    chi2, dof : float
        Of the offsets of the used stars, at the errors that the reference states, about the common map that fits them
        best.
    bend_chi2, bend_dof : float
        Of that map against what exposures and the prior know of it, shift, rotation and scale aside.
    bend : float
        By how much it departs from that, pixels, rms over the stars and axes; NaN where it was not determined.
    unseen : float
        Rms [px] up to which a bend of the reference would not be found, 19 times of 20; infinite if nothing tests it,
        that is, if the exposures and the prior leave a bend open by a pixel.
    cure : int
        Lowest degree of a map of its own with which it would agree, where it is bent; 0 for none.
    years : float
        By which its epochs would have to be later for its stars to agree; NaN where no other epoch is better.
    rate, rate_error : float
        How fast its stars move in common, pixels a year, the median of their proper motions, and the error per axis;
        NaN where it has none.
    """

    chi2: float = field(metadata=number(minimum=0))
    dof: float = field(metadata=number(minimum=0))
    bend_chi2: float = field(metadata=number(minimum=0))
    bend_dof: float = field(metadata=number(minimum=0))
    bend: float = field(metadata=number(minimum=0, nan=True))
    unseen: float = field(metadata=number(minimum=0, infinite=True))
    years: float = field(default=float("nan"), metadata=number(nan=True))
    cure: int = field(default=0, metadata=number(minimum=0))
    rate: float = field(default=float("nan"), metadata=number(minimum=0, nan=True, unit="pix/yr"))
    rate_error: float = field(default=float("nan"), metadata=number(minimum=0, nan=True, unit="pix/yr"))

    @property
    def p(self) -> float:
        """Chance of a map that departs so much."""
        return float(special.chdtrc(self.bend_dof, self.bend_chi2)) if self.bend_dof > 0 else 1.0

    @property
    def is_bent(self) -> bool:
        """Whether it is bent beyond chance."""
        return self.bend_dof >= 1 and self.p < FALSE_ALARM


@dataclass(frozen=True, eq=False)
class OwnMap:
    """A map that belongs to a reference alone, of which nothing was known.

    Attributes
    ----------
    degree : int
    rms : float
        Of what it moves the stars of the reference by, per axis, pixels.
    follow : ndarray, shape (2 l, 2 k)
        Modes of it, along x and then y, that take up those of a common map.
    """

    degree: int = field(metadata=number(minimum=1))
    rms: float = field(metadata=number(minimum=0))
    follow: np.ndarray = field(metadata=array("2 l", "2 k"))


@dataclass(frozen=True, eq=False)
class Tie:
    """How a reference tied the star positions.

    Attributes
    ----------
    covariance : ndarray, shape (2 k, 2 k)
        Of the common map, px^2, in the k modes of the gauge (3 if it has one); without what is unknown.
    shared : ndarray, shape (3, n_stars)
        xx, yy, xy [px^2]: what to add to relative variance and that of the map at each star, for their errors have
        the noise of the star in common.
    measured : ndarray, shape (n,)
        By how much the reference has brought down the variance of shift, rotation and scale, of shear, of degree 2 and
        so on: 0, not at all, to 1. The first is 0.5 for a single star, which determines the shift alone.
    stars : ndarray, shape (n_reference,)
        Names of the stars that the reference has.
    offsets : ndarray, shape (n_reference, 2)
        Reference less tied position, pixels.
    used : ndarray of bool, shape (n_reference,)
        False for what was rejected as a mismatch.
    ratio : float
        chi2 of the offsets over its degrees of freedom, at the errors that the reference states, or that were found;
        NaN if there are hardly any.
    factor : float
        By which the errors of the reference were taken larger (or smaller) than stated, for the offsets to be expected.
    found : bool
        Whether the size of its errors was found, whatever was stated.
    known : ndarray, shape (n_reference, 2, 2), or None
        Covariance of positions in the reference, px^2, with which the used ones held their stars; None if they tied the
        common map alone.
    agreement : Agreement or None
        None where a file does not have it.
    moves : bool
        Whether its stars move with the plane where common maps do, as those of a solution, whose errors these are.
    own : OwnMap or None
        What was taken off its positions.
    freedom : float
        Of the residuals of the exposures, taken by the map: what of it they determine, not the reference.
    labels : ndarray, shape (n_reference,), or None
        What the reference calls these stars, in its column of names, else "row 0" and so on.
    unsettled : float
        By how much the last of all rounds moved the plane, in its errors; 0 where it settled before.
    """

    covariance: np.ndarray = field(metadata=array("2 k", "2 k", unit="pix2", covariance=True))
    shared: np.ndarray = field(metadata=array(3, "n_stars", unit="pix2"))
    measured: np.ndarray = field(metadata=array("n", minimum=0, maximum=1))
    stars: np.ndarray = field(metadata=array("n_reference", holds="names"))
    offsets: np.ndarray = field(metadata=array("n_reference", 2, unit="pix"))
    used: np.ndarray = field(metadata=array("n_reference", holds="booleans"))
    ratio: float = field(metadata=number(minimum=0, nan=True))
    factor: float = field(default=1.0, metadata=number(minimum=0))
    found: bool = False
    known: np.ndarray | None = field(
        default=None, metadata=array("n_reference", 2, 2, unit="pix2", nan=True, covariance=True)
    )
    agreement: Agreement | None = None
    moves: bool = False
    own: OwnMap | None = None
    freedom: float = field(default=0.0, metadata=number(minimum=0))
    labels: np.ndarray | None = field(default=None, metadata=array("n_reference", holds="names"))
    unsettled: float = field(default=0.0, metadata=number(minimum=0))

    @property
    def rms(self) -> float:
        """Rms of the used offsets per axis, pixels; rounding is none."""
        return round(float(np.sqrt(np.mean(self.offsets[self.used] ** 2))), 9)

    @property
    def rejected(self) -> list[str]:
        """Names of the stars that were rejected as mismatched, and in brackets what the reference calls them."""
        stars, labels = self.stars.astype(str), self.stars if self.labels is None else self.labels
        return [
            f"{star} ({label})" if star != label else star
            for star, label in zip(stars[~self.used], labels.astype(str)[~self.used], strict=True)
        ]

    @property
    def sentence(self) -> str:
        """What was used, in a sentence."""
        out = self.rejected
        words = f"tied to {np.count_nonzero(self.used)} stars of a reference, {self.rms:.2g} px rms per axis from it"
        if len(out):
            named = ", ".join(out[:6]) + (" ..." if len(out) > 6 else "")
            words += f"; {len(out)} rejected as mismatched: {named}"
        return words

    @property
    def is_contradicted(self) -> bool:
        """Whether the exposures contradict it beyond doubt, or its plane has not settled."""
        bent = self.agreement is not None and (self.agreement.cure > 0 or self.agreement.p < CERTAIN)
        return bent or self.unsettled >= HARMLESS

    @property
    def alone(self) -> bool:
        """Whether a single star determines the shift, and nothing else."""
        return self.measured[0] < 1

    def errors(self, modes: PlaneModes) -> list[tuple[str, int, float]]:
        """Name, number of modes and error [px, rms over the field and axis] by degree, as a list.

        NaN for rotation and scale if not determined by the reference. `modes` are those of the covariance.
        """
        whole, *others = errors_by_degree(self.covariance, modes)
        if not self.alone:
            return [whole, *others]
        shift = np.trace(self.covariance[:: len(self.covariance) // 2, :: len(self.covariance) // 2])
        return [("shift", 2, float(np.sqrt(shift / 8))), ("rotation, scale", 2, np.nan), *others]

    def words(self, convention: str) -> str:
        """What pins the modes of every degree, ``{name as in errors: words}``."""
        out = {"shift" if self.alone else "shift, rotation, scale": "the reference"}
        for degree, share in enumerate(self.measured[1:], start=1):
            words = ["the reference"] * bool(share > 0.1) + [convention] * bool(share <= 0.9)
            out[f"degree {degree}" if degree > 1 else "shear"] = " and ".join(words)
        return out

    @property
    def statement(self) -> str:
        """What was used and how well it agrees, in sentences."""
        ratio = "" if np.isnan(self.ratio) else f" (chi2 {self.ratio:.2g} per degree of freedom)"
        taken = "" if self.factor == 1 else f"; its errors are taken {self.factor:.2g} times as large as stated"
        if self.found and self.known is not None:
            variance = np.einsum("jaa->ja", self.known[self.used])
            taken = f"; its errors were found: {np.sqrt(np.mean(variance)):.2g} px rms per axis"
        if self.own is not None:
            taken += f"; a map of degree {self.own.degree} that is its own, {self.own.rms:.2g} px rms, is taken off"
        return f"The plane is {self.sentence}{ratio}{taken}."

    def __repr__(self) -> str:
        return f"<Tie: {np.count_nonzero(self.used)} of {len(self.used)} reference stars, {self.rms:.2g} px rms>"


def errors_by_degree(covariance, modes):
    """Name, number of modes and error [px, rms over the field and axis] by degree of a map, similarities first, a list.

    `covariance` is that of the modes of a plane, `PlaneModes`.
    """
    similar, *parts = map_parts(modes)
    groups = {"shift, rotation, scale": similar}
    groups |= {f"degree {d}" if d > 1 else "shear": part for d, part in enumerate(parts, start=1)}
    return [
        (name, part.shape[1], float(np.sqrt(np.trace(part.T @ covariance @ part) / 8 / modes.n_fields)))
        for name, part in groups.items()
    ]


def map_parts(modes):
    """Orthonormal columns (2 n, ...) of a map: similarities, the two shears, then those of each further degree.

    Of the `modes` of the plane, `PlaneModes`.
    """
    columns, orders = modes.others.T, modes.degrees_of_others
    degrees = range(1, modes.degrees.max() + 1)
    return [modes.similar.T, *(columns[:, orders == d] for d in degrees)]
