"""One exposure's distortion: undistorted pixels q -> detector pixels, and its certified inverse.

``D(q) = q + sum_m a_m b_m(u(q))`` (Bernard et al. 2017, eq. for X_ij in section 2.1, with the basis in
detector coordinates). D is exact; the opposite direction has no closed form and is fitted once by a
Legendre tensor whose degree is raised until the round trip holds.

What no polynomial describes is in a table, ``D(q) = q + sum_m a_m b_m(u(q)) + t(q)``, linear between its nodes. The
inverse is then that of the series and a second table for what remains.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ..exceptions import FoldError, InputError
from ..runtime.notebook import ShownAsPrinted
from ..runtime.trees.facts import array, number
from . import basis, similarity
from .models import CHUNK, correction_model
from .tabulated.displacement_table import DisplacementTable

if TYPE_CHECKING:
    from astropy.modeling import Model
    from numpy.typing import ArrayLike

#: Largest round-trip error of a certified inverse, pixels.
TOLERANCE = 1e-6
#: The same of a distortion with a table.
TABLE_TOLERANCE = 1e-3
#: A Jacobian determinant below this counts as a fold.
FOLD = 0.1
#: Largest degrees of an inverse that are tried one after another: few maps need more than the first.
_INVERSE_DEGREES = 8, 16, 30
#: Steps of the table of an inverse, by that of the distortion, until it is good enough.
_FINER = 1, 1 / 2, 1 / 4, 1 / 8


@dataclass(frozen=True, eq=False)
class Inverse:
    """Fitted inverse of a `Distortion`.

    Attributes
    ----------
    tensors : ndarray, shape (2, n, n)
        Displacement q - p as un-normalised Legendre tensors of the detector pixel p.
    error : float
        Largest round-trip error found, detector pixels.
    valid : tuple
        ``(x_min, x_max, y_min, y_max)``: box of undistorted pixels around the image of the detector.
    table : DisplacementTable, optional
        What is added to the tensors, where the distortion has a table.
    """

    tensors: np.ndarray = field(metadata=array(2, "n", "n", unit="pix"))
    error: float = field(metadata=number(entry="error_px", minimum=0, maximum=TABLE_TOLERANCE, unit="pix"))
    valid: tuple[float, float, float, float] = field(metadata=number(entry="valid_undistorted_px", unit="pix"))
    table: DisplacementTable | None = None

    def __repr__(self) -> str:
        return f"<Inverse: degree {self.tensors.shape[1] - 1}, error {self.error:.1e} px>"


@dataclass(frozen=True, eq=False)
class Distortion(ShownAsPrinted):
    """Distortion of one exposure in its own pixels.

    Attributes
    ----------
    coefficients : ndarray, shape (2, n_modes)
        Of the normalised basis, x then y, pixels.
    shape : tuple
        ``(ny, nx)`` of the detector.
    name : str
        For messages.
    certified : Inverse, optional
        One that was certified earlier. It is checked against its certificate again, and then is `inverse`.
    table : DisplacementTable, optional
        Displacements beside the series, at undistorted pixels.

    Raises
    ------
    InputError
        For coefficients of another shape or not finite, or a table that is none; if the round-trip error of `certified`
        is not the one that it states, or its region of validity not the image of the detector.
    """

    coefficients: np.ndarray
    shape: tuple[int, int]
    name: str = ""
    certified: Inverse | None = None
    table: DisplacementTable | None = None

    def __post_init__(self) -> None:
        c = np.asarray(self.coefficients, dtype=float)
        if c.ndim != 2 or len(c) != 2 or not np.all(np.isfinite(c)):
            raise InputError(f"coefficients must be finite, of shape (2, n_modes), got shape {c.shape}")
        basis.degree_of(c.shape[1])
        object.__setattr__(self, "coefficients", c)
        if not isinstance(self.table, DisplacementTable | None):
            raise InputError(f"table must be a DisplacementTable or None, got {type(self.table).__name__}")
        if self.certified is not None:
            self._check_certificate(self.certified)

    @property
    def degree(self) -> int:
        """Total degree."""
        return basis.degree_of(self.coefficients.shape[1])

    def __repr__(self) -> str:
        ny, nx = self.shape
        return f"<Distortion{f' of {self.name}' if self.name else ''}: degree {self.degree}, {nx} x {ny} px>"

    def same_as(self, other: Distortion, *, rounding: float = 0.0) -> bool:
        """Whether it is the same map of the same detector: to the last bit, or coefficients to a rounding, pixels."""
        if self.shape != other.shape or self.coefficients.shape != other.coefficients.shape:
            return False
        return np.abs(self.coefficients - other.coefficients).max() <= rounding and self.table == other.table

    def __call__(self, q: ArrayLike) -> np.ndarray:
        """Undistorted pixels (n, 2) -> detector pixels (n, 2)."""
        q = np.asarray(q, dtype=float)
        p = q + (self.coefficients @ basis.values(self.degree, *basis.normalize(q, self.shape))).T
        return p if self.table is None else p + self.table(q)

    def jacobian(self, q: ArrayLike) -> np.ndarray:
        """Derivative dD/dq, shape (n, 2, 2), first index the detector axis."""
        return self._value_and_jacobian(np.asarray(q, dtype=float))[1]

    def _value_and_jacobian(self, q):
        b, bu, bv = basis.gradients(self.degree, *basis.normalize(q, self.shape))
        ny, nx = self.shape
        jacobian = np.empty((len(q), 2, 2))
        jacobian[:, :, 0] = (self.coefficients @ bu).T * (2 / nx)
        jacobian[:, :, 1] = (self.coefficients @ bv).T * (2 / ny)
        jacobian[:, 0, 0] += 1
        jacobian[:, 1, 1] += 1
        p = q + (self.coefficients @ b).T
        return (p, jacobian) if self.table is None else (p + self.table(q), jacobian + self.table.jacobian(q))

    def invert(self, p: ArrayLike, *, tolerance: float = 1e-10, max_iterations: int = 50) -> np.ndarray:
        """Detector pixels (n, 2) -> undistorted pixels by Newton's method.

        The scheme is that of the corrected positions, criterion J_3 of section 3.3.

        Raises
        ------
        FoldError
            Naming the worst place, if some points do not converge.
        """
        p = similarity.as_positions(p)
        size = CHUNK // 2
        blocks = [self._newton(p[k : k + size], tolerance, max_iterations) for k in range(0, len(p), size)]
        q = np.concatenate(blocks) if blocks else p.copy()
        wrong = ~(np.abs(self(q) - p).max(axis=1) < max(1e-8, tolerance))
        wrong &= np.isfinite(p).all(axis=1)
        if wrong.any():
            self._raise_fold(p[wrong][0], "cannot be inverted")
        return q

    def _newton(self, p, tolerance, max_iterations):
        """Newton's method; the Jacobian is kept while every step is ten times shorter than the one before."""
        q, jacobian, size = 2 * p - self(p), None, np.inf
        for _ in range(max_iterations):
            with np.errstate(invalid="ignore", over="ignore"):
                if jacobian is None:
                    value, jacobian = self._value_and_jacobian(q)
                else:
                    value = self(q)
                step = _solve2(jacobian, p - value)
                q = q + step
            last, size = size, np.nanmax(np.abs(step), initial=0)
            if not size > tolerance:
                break
            if size > 0.1 * last:
                jacobian = None
        return q

    def _raise_fold(self, place, what):
        raise FoldError(
            f"the distortion{f' of exposure {self.name}' if self.name else ''} {what} near pixel "
            f"({round(place[0])}, {round(place[1])}): two places fall on one; too few stars there for "
            f"degree {self.degree}?"
        )

    def check_fold(self) -> None:
        """Raise `FoldError` if the Jacobian determinant is below `FOLD` anywhere on the detector."""
        if self._largest_slope < 1 - FOLD**0.5:  # det(I + E) >= (1 - |E|)^2
            return
        t = np.linspace(-1, 1, 8 * self.degree + 9)
        q = basis.denormalize(*(a.ravel() for a in np.meshgrid(t, t)), self.shape)
        q = q if self.table is None else np.concatenate([q, self.table.cells])
        determinant = np.concatenate([np.linalg.det(self.jacobian(q[k : k + CHUNK])) for k in range(0, len(q), CHUNK)])
        worst = int(np.argmin(determinant))
        if determinant[worst] <= FOLD:
            self._raise_fold(q[worst], f"folds (Jacobian determinant {determinant[worst]:.2f})")

    @property
    def _largest_slope(self) -> float:
        """What no norm of the derivative of D - identity exceeds on the detector: every mode at its steepest."""
        i, j = basis.orders(self.degree)
        slopes = np.stack([i * (i + 1), j * (j + 1)], axis=1)  # 2 P_n'(1), by pixels of the detector
        steepest = (basis.norm(i) * basis.norm(j))[:, None] * slopes
        series = float(np.linalg.norm(np.abs(self.coefficients) @ (steepest / self.shape[::-1])))
        return series if self.table is None else series + self.table.steepest

    @cached_property
    def inverse(self) -> Inverse:
        """The fitted `Inverse`, certified to `tolerance` on a grid, random points, the edges and the corners.

        Raises
        ------
        FoldError
            If the map folds, or no inverse of degree up to 30, or no table, reaches the tolerance.
        """
        if self.certified is not None:
            return self.certified
        self.check_fold()
        if self.table is not None:
            return self._tabulated_inverse(self.table)
        errors = []
        for largest in _INVERSE_DEGREES:
            tensors, rest = self._projected_inverse(largest)
            for degree in range(max(self.degree, 1), largest + 1):
                if rest[degree] > TOLERANCE / 2:  # the largest error is no smaller than the rms of what is left out
                    continue
                part = tensors[:, : degree + 1, : degree + 1]
                q = self._corrected(part, self._check_points)
                errors.append(self._miss(q))
                if errors[-1] <= TOLERANCE / 2:  # half, so that unchecked points stay below the promise
                    return Inverse(part.copy(), errors[-1], _valid_box(q, self.shape))
        raise FoldError(
            f"no inverse of the distortion{f' of exposure {self.name}' if self.name else ''} up to degree "
            f"{_INVERSE_DEGREES[-1]} is better than {min(errors):.1e} px ({TOLERANCE:.0e} is wanted); "
            "the distortion is too strong or too ragged, lower the degree"
        )

    def _projected_inverse(self, degree):
        """Tensors of the inverse up to a degree by quadrature, and the rms [pix] of what lower ones leave out."""
        nodes, weights = np.polynomial.legendre.leggauss(degree + 12)
        u, v = np.meshgrid(nodes, nodes, indexing="ij")
        p = basis.denormalize(u.ravel(), v.ravel(), self.shape)
        shift = (self.invert(p) - p).T.reshape(2, *u.shape)
        vander = weights[:, None] * basis.legendre(degree, nodes).T
        normalised = vander.T @ shift @ vander
        n = np.arange(degree + 1)
        by_degree = [np.sum(normalised[:, np.maximum.outer(n, n) == each] ** 2) for each in n]
        left_out = np.append(np.cumsum(by_degree[:0:-1])[::-1], 0.0)
        norms = basis.norm(n)
        return normalised * np.outer(norms, norms), np.sqrt(left_out) / 2

    def _tabulated_inverse(self, table):
        """The inverse of the series alone, with a table for what remains."""
        smooth = Distortion(self.coefficients, self.shape, self.name).inverse
        check, error = self._check_points, np.inf
        box = _valid_box(self.invert(check), self.shape)

        def remaining(p):
            return self.invert(p) - self._corrected(smooth.tensors, p)

        good = []
        for part in _FINER:
            rest = DisplacementTable.of(remaining, self.shape, (part * table.step[0], part * table.step[1]), margin=0)
            error = self.round_trip_error(smooth.tensors, check, rest)
            good += [Inverse(smooth.tensors, error, box, rest)] * (error <= self.tolerance)
            if error <= self.tolerance / 2:
                break
        if good:
            return good[-1]
        raise FoldError(
            f"no inverse of the distortion{f' of exposure {self.name}' if self.name else ''} by a table is better than "
            f"{error:.1e} px ({self.tolerance:.0e} is wanted): its own table is too ragged, give one with finer steps"
        )

    @property
    def tolerance(self) -> float:
        """Largest round-trip error that its inverse may have, pixels."""
        return TOLERANCE if self.table is None else TABLE_TOLERANCE

    @property
    def _check_points(self):
        """Where inverses are tried, (n, 2) pixels; more places for what is ragged."""
        return _check_points(self.shape, 1000 if self.table is None else 20_000)

    def round_trip_error(
        self, tensors: Any, p: np.ndarray | None = None, table: DisplacementTable | None = None
    ) -> float:
        """Largest ``|D(E(p)) - p|`` [pix] of an inverse E by its displacement tensors, and table, over check points."""
        p = self._check_points if p is None else p
        return self._miss(self._corrected(tensors, p, table), p)

    def _miss(self, q, p=None):
        """Largest distance in x or y [pix] of D(q) from where q should fall, the check points if not given."""
        return float(np.abs(self(q) - (self._check_points if p is None else p)).max())

    def _corrected(self, tensors, p, table=None):
        """Detector pixels (n, 2) -> undistorted pixels by the displacement tensors of an inverse, and its table."""
        if len(p) > CHUNK:
            return np.concatenate([self._corrected(tensors, p[k : k + CHUNK], table) for k in range(0, len(p), CHUNK)])
        u, v = basis.normalize(p, self.shape)
        norms = basis.norm(np.arange(np.shape(tensors)[1]))
        along, across = (basis.legendre(len(norms) - 1, w) for w in (u, v))
        normalised = np.asarray(tensors) / np.outer(norms, norms)
        q = p + np.stack([np.einsum("jn,jn->n", t.T @ along, across) for t in normalised], axis=-1)
        return q if table is None else q + table(p)

    def _check_certificate(self, inverse):
        p = self._check_points
        q = self._corrected(inverse.tensors, p, inverse.table)
        error, box = self._miss(q), _valid_box(q, self.shape)
        whose = f"the inverse of the distortion{f' of exposure {self.name}' if self.name else ''}"
        if not (abs(error - inverse.error) <= 1e-9 and error <= self.tolerance):
            raise InputError(
                f"{whose} misses by {error:.3g} px where {inverse.error:.3g} px was certified: coefficients or inverse "
                "were changed since; solve again, or take the file as it was written"
            )
        if not np.allclose(box, inverse.valid, rtol=0, atol=1e-3):
            raise InputError(f"{whose} is stated to be valid in {inverse.valid}, the detector's image lies in {box}")

    @cached_property
    def shared_correction(self) -> Model:
        """`correction_model` as one object, for those who change nothing of it: models take long to make."""
        return self.correction_model()

    def correction_model(self) -> Model:
        """Detector -> undistorted pixels as an astropy compound model, D attached as its inverse."""
        return correction_model(basis.to_tensor(self.coefficients), self.inverse, self.shape, self.table)

    def model(self) -> Model:
        """D as an astropy compound model (undistorted -> detector pixels) with the certified inverse attached."""
        correction = self.correction_model()
        forward, correction.inverse = correction.inverse, None  # no circle of inverses: files would never end
        forward.inverse = correction
        return forward


def _solve2(a, b):
    """Solve n systems of two equations, a (n, 2, 2), b (n, 2), without LAPACK's cost per call."""
    determinant = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    x = (a[:, 1, 1] * b[:, 0] - a[:, 0, 1] * b[:, 1]) / determinant
    y = (a[:, 0, 0] * b[:, 1] - a[:, 1, 0] * b[:, 0]) / determinant
    return np.stack([x, y], axis=1)


@lru_cache(maxsize=8)
def _check_points(shape, n):
    """Random points, a regular grid with the edges and the corners of a detector, (n, 2) pixels, read-only."""
    t = np.linspace(-1, 1, 33)
    grid = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    scattered = np.random.default_rng(20170101).uniform(-1, 1, (n, 2))
    edge = np.linspace(-1, 1, 129)
    ends = np.ones_like(edge)
    sides = np.concatenate([np.stack(s, axis=1) for s in ((edge, ends), (edge, -ends), (ends, edge), (-ends, edge))])
    out = basis.denormalize(*np.concatenate([grid, scattered, sides]).T, shape)
    out.setflags(write=False)
    return out


def _valid_box(q, shape, margin=0.01):
    """Box around the image of the detector, with a margin of 1 % of its size."""
    extra = margin * max(shape)
    (x_min, y_min), (x_max, y_max) = q.min(axis=0) - extra, q.max(axis=0) + extra
    return (float(x_min), float(x_max), float(y_min), float(y_max))
