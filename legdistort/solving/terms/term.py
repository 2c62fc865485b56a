"""Terms: displacements of measured positions that are linear in numbers which are found with everything else."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from ...exceptions import InputError
from ...inputs.column_contract import colour_column
from ...results.motions import PATHS
from ...runtime.checks import check_choice, check_positive
from .displacements import PIXEL_WAVES, accelerations, differential_refraction, orbits, pixel_waves, refraction
from .random_field import Kernel
from .rough import RoughColumns, names

if TYPE_CHECKING:
    from astropy.table import Table
    from numpy.typing import ArrayLike

#: Whose numbers they are: one set of them for all observations, or one for each of these.
OWNERS = ("set", "exposure", "detector", "star")
_COLOUR, _ZENITH = "colour", ("tan_z", "parallactic_angle")
_ACCELERATION = "acceleration"


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
    def named(cls, name: str, **changed: Any) -> Term | RandomField:
        """A term that the package has, perhaps with attributes changed.

        "refraction" (by the colours of stars), "differential_refraction" (over the field), "pixel_phase",
        "acceleration" (of a star, constant), "orbits" (any smooth path, once round), "rough_static" (what the
        static distortion of a detector has beyond the degree), "turbulence" (a random field of every exposure, whose
        attributes are size, length, smoothness, ratio and angle).

        Raises
        ------
        InputError
            For another name, and attributes that it has not.
        """
        known = TERMS | FIELDS
        if name not in known:
            raise InputError(f"there is no term {name!r}: give {' or '.join(map(repr, known))}, or a legdistort.Term")
        has = [field.name for field in fields(known[name])]
        if strange := [each for each in changed if each not in has]:
            raise InputError(f"term {name} has no {strange[0]}: it has {', '.join(has)}")
        return replace(known[name], **changed)

    def lacking(self, table: Table) -> list[str]:
        """Columns that the term needs and a table of positions lacks."""
        return [n for n in self.needs if n not in table.colnames and (n != _COLOUR or colour_column(table) is None)]

    def check(self, table: Table) -> None:
        """Raise `InputError` for a table of positions that lacks a column which the term needs."""
        if not (lacking := self.lacking(table)):
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
        size = "" if self.sigma is None else f"{self.sigma:.3g} "
        return f"<Term {self.name}: {n} number{'s' * (n > 1)}{of}, {size}{self.unit}>"


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
    """A smooth random field of displacements of every exposure: turbulence.

    Attributes
    ----------
    name, unit, owner : str
    size : float, optional
        Standard deviation along an axis, pixels. None: size, length and shape are found from the positions, by
        `legdistort.solve`, which takes none that are stated; `legdistort.predict` needs them.
    length : float, optional
        Of correlation, pixels.
    smoothness : float
        Of the covariance, that of Matern: 5/6 is the gradient of a wavefront with von Karman's spectrum, averages over
        aperture and time are smoother.
    ratio : float
        Of the long axis to the short one, where wind draws the field out.
    angle : float
        Of the long axis from x towards y, degrees.

    Raises
    ------
    InputError
        For sizes that are no positive numbers, one of size and length alone, and a ratio below 1.
    """

    name: str = "turbulence"
    unit: str = "pix"
    owner: str = "exposure"
    size: float | None = None
    length: float | None = None
    smoothness: float = 3 / 2
    ratio: float = 1.0
    angle: float = 0.0

    def __post_init__(self) -> None:
        if (self.size is None) != (self.length is None):
            raise InputError(f"{self.name} is stated by its size and its length, both in pixels: give both, or neither")
        stated = {} if self.size is None else {"size": self.size, "length": self.length}
        for what, value in (stated | {"smoothness": self.smoothness}).items():
            check_positive(value, f"{what} of {self.name}", "number")
        if not (isinstance(self.ratio, Real) and 1 <= self.ratio < np.inf):
            raise InputError(
                f"ratio of {self.name} is that of its long axis to its short one, from 1, got {self.ratio!r}"
            )
        if not (isinstance(self.angle, Real) and np.isfinite(self.angle)):
            raise InputError(f"angle of {self.name} must be a number of degrees, got {self.angle!r}")

    @property
    def kernel(self) -> Kernel:
        """Its covariance, where that is stated."""
        turn = 2 * np.radians(self.angle)
        stretch = np.log(self.ratio) * np.array([np.cos(turn), np.sin(turn)])
        return Kernel(self.size, self.length, self.smoothness, tuple(stretch.tolist()))

    def check(self, table: Table) -> None:
        """Nothing is needed of the table."""

    def for_table(self, table: Table) -> RandomField:
        """The same for every table."""
        return self

    def __repr__(self) -> str:
        stated = "" if self.size is None else f", {self.size:.3g} over lengths of {self.length:.3g}"
        return f"<Term {self.name}: a random field of each exposure{stated}, {self.unit}>"


#: What is told of a random field: size and length [pix], smoothness, axis ratio, angle of its long axis from x [deg].
FIELD_NUMBERS = "size", "length", "smoothness", "axis ratio", "angle"
#: The terms that the package has, by name.
TERMS = {
    "refraction": Term("refraction", refraction, ("towards zenith",), unit="pix per unit of colour",
                       needs=(_COLOUR, *_ZENITH)),
    "differential_refraction": Term("differential_refraction", differential_refraction, ("constant",), unit="arcsec",
                                    needs=_ZENITH),
    "acceleration": Term("acceleration", accelerations, PATHS["acceleration"][0], unit="pix/yr2", owner="star",
                         each=True, needs=("epoch",)),
    "orbits": Term("orbits", orbits, PATHS["orbits"][0], owner="star", each=True, needs=("epoch",)),
    "pixel_phase": Term("pixel_phase", pixel_waves, PIXEL_WAVES, owner="detector"),
    "rough_static": Term("rough_static", RoughColumns(20), names(20), owner="detector"),
}  # fmt: skip

#: Random fields, by name.
FIELDS = {"turbulence": RandomField()}


def listed(given: Any) -> list[Term | RandomField]:
    """The terms that were asked for, by name or as objects.

    Raises
    ------
    InputError
        For what is none, and one that comes twice.
    """
    each = [given] if isinstance(given, (str, Term, RandomField)) else [] if given is None else given
    if not isinstance(each, (list, tuple)):
        raise InputError(f"terms must be names or Term objects in a list, got {type(given).__name__}")
    for term in each:
        if not isinstance(term, (str, Term, RandomField)):
            raise InputError(f"terms must be names or Term objects, got {type(term).__name__}")
    made = [Term.named(term) if isinstance(term, str) else term for term in each]
    names = [term.name for term in made]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"the term {twice[0]!r} is given twice")
    return made


def of_motion(
    motion: str | None, given: str | Term | RandomField | Iterable[str | Term | RandomField] | None
) -> tuple[str | None, Any]:
    """The motion and the terms that are asked for: "acceleration" is "proper" with the term of that name."""
    if not (isinstance(motion, str) and motion == _ACCELERATION):
        return motion, given
    made = listed(given)
    return "proper", made + [Term.named(_ACCELERATION)] * all(term.name != _ACCELERATION for term in made)


def terms_of(
    given: str | Term | RandomField | Iterable[str | Term | RandomField] | None, table: Table
) -> tuple[Term | RandomField, ...]:
    """The terms that `legdistort.solve` is asked for, checked against the table of positions.

    Raises
    ------
    InputError
        As `listed`; for a column that one lacks, and a random field whose sizes are stated.
    """
    made = listed(given)
    for term in made:
        if isinstance(term, RandomField) and term.size is not None:
            raise InputError(f"solve finds the sizes of {term.name}: give its name alone; predict takes stated ones")
        term.check(table)
    return tuple(term.for_table(table) for term in made)
