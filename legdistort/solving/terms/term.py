"""Terms: displacements of measured positions that are linear in numbers which are found with everything else."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from ...exceptions import InputError
from ...inputs.column_contract import colour_column
from ...results.motions import PATHS
from ...runtime.checks import check_choice
from .displacements import PIXEL_WAVES, accelerations, orbits, pixel_waves, refraction
from .rough import RoughColumns, names

if TYPE_CHECKING:
    from astropy.table import Table
    from numpy.typing import ArrayLike

#: Whose numbers they are: one set of them for all observations, or one for each of these.
OWNERS = ("set", "exposure", "detector", "star")
_COLOUR, _ZENITH = "colour", ("tan_z", "parallactic_angle")


@dataclass(frozen=True, eq=False)
class Term:
    """Something that displaces stars in a way of its own, by numbers that are not known.

    ``measured = D(X) + sum_k columns_k number_k``: `legdistort.solve` finds the numbers together with stars and
    distortions, tells their errors, and takes the term away where the positions do not show it.

    Attributes
    ----------
    name : str
    columns : callable
        ``columns(observed)`` gives displacements (k, 2, n) of the n positions by a unit of each of the k numbers,
        pixels. `observed` (`legdistort.solving.terms.observed.Observed`) has ``pixels`` (2, n), ``place`` (the same
        from -1 to 1), ``exposure`` (n,), the ``table`` with all columns that were given, and more. With a method
        ``basis`` it is a part of the distortion of its detector, in a table (`RoughColumns`).
    numbers : tuple of str
        Names of the k numbers.
    unit : str
        Of the numbers.
    owner : {"set", "exposure", "detector", "star"}
        Whether one set of them holds for all positions, or each exposure, detector or star has its own.
    each : bool
        Whether every owner has a size of its own, so that only those have the term which show it: few of many stars.
    sigma : float, optional
        Scatter of the numbers about 0; infinite: nothing is known of them. None: found, and the term is left away
        where twice the logarithm of the likelihood grows by less than 4.
    covariance : ndarray, shape (k, k), optional
        Of the numbers of one owner, in units of sigma^2; by default they are independent, of one size.
    needs : tuple of str
        Columns of the table without which it cannot be.

    Raises
    ------
    InputError
        For what is none of these.

    See Also
    --------
    legdistort.solve : Takes terms, by name or as these objects.

    Examples
    --------
    >>> import legdistort as ld
    >>> ld.Term.named("refraction", owner="exposure")
    <Term refraction: 1 number of each exposure, pix per unit of colour>
    >>> row_noise = ld.Term("rows", lambda observed: 0 * observed.pixels[None] + [[0.0], [1.0]], ("shift",))
    >>> row_noise.owner
    'set'
    """

    name: str
    columns: Callable[[Any], ArrayLike]
    numbers: tuple[str, ...]
    unit: str = "pix"
    owner: str = "set"
    each: bool = False
    sigma: float | None = None
    covariance: np.ndarray | None = None
    needs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "numbers", tuple(map(str, self.numbers)))
        if not self.name or not callable(self.columns) or not self.numbers:
            raise InputError("a Term needs a name, columns(observed) that can be called, and names of its numbers")
        check_choice(self.owner, OWNERS, f"owner of term {self.name}")
        sigma = self.sigma
        if sigma is not None and not (isinstance(sigma, Real) and not isinstance(sigma, bool) and sigma > 0):
            raise InputError(f"sigma of term {self.name} must be a positive number, inf, or None, got {sigma!r}")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", _checked(self.name, self.covariance, len(self.numbers)))

    @classmethod
    def named(cls, name: str, **changed: Any) -> Term:
        """A term that the package has, perhaps with attributes changed.

        "refraction", "pixel_phase", "acceleration" (of a star, constant), "orbits" (any smooth path, once round),
        "rough_static" (what the static distortion of a detector has beyond the degree).

        Raises
        ------
        InputError
            For another name.
        """
        if name not in TERMS:
            raise InputError(f"there is no term {name!r}: give {' or '.join(map(repr, TERMS))}, or a legdistort.Term")
        return replace(TERMS[name], **changed)

    def check(self, table: Table) -> None:
        """Raise `InputError` for a table of positions that lacks a column which the term needs."""
        lacking = [n for n in self.needs if n not in table.colnames and (n != _COLOUR or colour_column(table) is None)]
        if not lacking:
            return
        what = f"the table of positions lacks the column{'s' * (len(lacking) > 1)} {', '.join(lacking)}"
        cure = "give them (columns=, --columns)"
        if set(lacking) & set(_ZENITH):
            cure += (
                ", or frames whose headers state zenith distance (ZD, AIRMASS) and parallactic angle (PARANGLE), or "
                "place, time and site"
            )
        raise InputError(f"term {self.name}: {what}; {cure}")

    def for_table(self, table: Table) -> Term:
        """The term with as many numbers as a table of positions asks for, where that is not said."""
        sized = getattr(self.columns, "for_table", None)
        return self if sized is None else replace(self, **sized(table))

    def displacements(self, observed: Any) -> np.ndarray:
        """Displacements (k, 2, n), checked.

        Raises
        ------
        InputError
            If they are no finite numbers of that shape.
        """
        made, shape = np.asarray(self.columns(observed), dtype=float), (len(self.numbers), *observed.pixels.shape)
        if made.shape != shape:
            raise InputError(f"columns of term {self.name} should give an array of shape {shape}, got {made.shape}")
        if not np.isfinite(made).all():
            row = int(np.flatnonzero(~np.isfinite(made).all(axis=(0, 1)))[0])
            where = f"exposure {observed.table['exposure'][row]}, star {observed.table['star'][row]}"
            raise InputError(f"term {self.name} has displacements that are not finite, the first for {where}")
        return made

    def __repr__(self) -> str:
        n = len(self.numbers)
        of = "" if self.owner == "set" else f" of each {self.owner}"
        return f"<Term {self.name}: {n} number{'s' * (n > 1)}{of}, {self.unit}>"


def _checked(name, covariance, k):
    """A covariance (k, k) that is one."""
    covariance = np.asarray(covariance, dtype=float)
    if covariance.shape != (k, k) or not np.allclose(covariance, covariance.T):
        raise InputError(f"covariance of term {name} must be a symmetric ({k}, {k}) matrix, got {covariance.shape}")
    if not np.linalg.eigvalsh(covariance).min() > 0:
        raise InputError(f"covariance of term {name} must be positive definite")
    return covariance


@dataclass(frozen=True)
class RandomField:
    """A smooth random field of displacements of every exposure, whose size, length and shape are found: turbulence."""

    name: str = "turbulence"
    unit: str = "pix"
    owner: str = "exposure"

    def check(self, table: Table) -> None:
        """Nothing is needed of the table."""

    def for_table(self, table: Table) -> RandomField:
        """The same for every table."""
        return self

    def __repr__(self) -> str:
        return f"<Term {self.name}: a random field of each exposure, {self.unit}>"


#: What is told of a random field: its size and length [pix], axis ratio, and angle of its long axis from x [deg].
FIELD_NUMBERS = "size", "length", "axis ratio", "angle"
#: The terms that the package has, by name.
TERMS = {
    "refraction": Term("refraction", refraction, ("towards zenith",), unit="pix per unit of colour",
                       needs=(_COLOUR, *_ZENITH)),
    "acceleration": Term("acceleration", accelerations, PATHS["acceleration"][0], unit="pix/yr2", owner="star",
                         each=True, needs=("epoch",)),
    "orbits": Term("orbits", orbits, PATHS["orbits"][0], owner="star", each=True, needs=("epoch",)),
    "pixel_phase": Term("pixel_phase", pixel_waves, PIXEL_WAVES, owner="detector"),
    "rough_static": Term("rough_static", RoughColumns(20), names(20), owner="detector"),
}  # fmt: skip

#: Random fields, by name.
FIELDS = {"turbulence": RandomField()}


def terms_of(given: str | Term | Iterable[str | Term] | None, table: Table) -> tuple[Term, ...]:
    """The terms that were asked for, by name or as objects, checked against the table of positions.

    Raises
    ------
    InputError
        For what is none, one that comes twice, and a column that one lacks.
    """
    each = [given] if isinstance(given, (str, Term)) else [] if given is None else given
    if not isinstance(each, (list, tuple)):
        raise InputError(f"terms must be names or Term objects in a list, got {type(given).__name__}")
    made = []
    for term in each:
        if not isinstance(term, (str, Term)):
            raise InputError(f"terms must be names or Term objects, got {type(term).__name__}")
        made.append(FIELDS.get(term) or Term.named(term) if isinstance(term, str) else term)
    names = [term.name for term in made]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"the term {twice[0]!r} is given twice")
    for term in made:
        term.check(table)
    return tuple(term.for_table(table) for term in made)
