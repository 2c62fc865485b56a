"""One detector of a camera: its size, where it lies in the focal plane, and its static distortion."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..exceptions import InputError
from ..geometry import basis, similarity
from ..geometry.distortion import Distortion
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted
from ..runtime.trees.facts import SIZE, array
from .source import check_shape
from .stated_errors import as_errors, as_widths

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

#: Points along an edge of its outline.
_EDGE = 32


@dataclass(frozen=True)
class Place:
    """Where a detector lies in the focal plane.

    Attributes
    ----------
    x, y : float
        Its undistorted centre, pixels of the focal plane: by the layout alone, as the others.
    rotation : float
        From the focal plane to the detector, degrees: its axes are turned by as much from y to x in the focal plane.
    scale : float
        Detector pixels in one of the focal plane.
    errors : tuple of float or None
        Standard deviations of x, y and rotation; None where the layout is exact.
    """

    x: float
    y: float
    rotation: float
    scale: float
    errors: tuple[float, ...] | None


@plain_numbers
@dataclass(frozen=True, eq=False, repr=False)
class Detector(ShownAsPrinted):
    """One detector: its size, where it lies in the focal plane, and its static distortion.

    Parameters
    ----------
    shape : tuple
        ``(ny, nx)``.
    layout : array_like, shape (2, 3), optional
        Affine map ``[M | t]``: focal-plane pixels -> undistorted pixels of the detector; the identity if not given.
    static : Prior or array_like, shape (2, n_modes), optional
        Static distortion, normalised Legendre modes, x then y, pixels (undistorted -> detector). Of a detector in a
        focal plane orders 0 and 1 belong to the layout: what is given there is moved into it.
    layout_sigma : array_like, optional
        Standard deviation of the layout, as that of modes of orders 0 and 1 over the detector (constant, x, y), pixels:
        a number, (3,) or (2, 3); infinite where nothing is known. None takes it as exact.
    static_sigma : array_like, optional
        That of `static`, the same forms; that of the Prior if one is given. None takes it as exact; of plain images
        (`Camera.has_focal_plane`) it is not known at all without `static`.
    static_covariance : array_like, shape (2 n_modes, 2 n_modes), optional
        Covariance of `static`, modes of x first, px^2, in the place of `static_sigma`, which its diagonal becomes; that
        of the Prior if one is given. What solves detectors of a focal plane takes their modes as independent, but for
        those of a camera with a `Camera.covariance`.
    layout_covariance : array_like, shape (6, 6), optional
        Covariance of the modes of `layout_sigma`, those of x first, instead of it, px^2. It is for the errors of
        `place`: as a prior they count as independent, but for a `Camera.covariance`.
    header_layout : array_like, shape (2, 3), optional
        The layout as headers have it, in a plane of theirs that is the same for all detectors: it is compared with the
        layout, and what solves leaves it alone.

    Raises
    ------
    InputError
        For arrays of another shape, not finite, a layout without area, or a Prior of a detector of another shape.

    See Also
    --------
    legdistort.Camera : All detectors of a focal plane.

    Examples
    --------
    >>> import numpy as np
    >>> import legdistort as ld
    >>> chip = ld.Detector((2048, 2048), layout=np.array([[1.0, 0.0, 150.0], [0.0, 1.0, 0.0]]))
    >>> chip.to_focal_plane([[10.0, 20.0]])
    array([[-140.,   20.]])
    """

    shape: tuple[int, int] = field(metadata=SIZE)
    _: KW_ONLY
    layout: np.ndarray = field(default_factory=lambda: np.eye(2, 3), metadata=array(2, 3, unit="pix", invertible=True))
    static: np.ndarray | None = field(default=None, metadata=array(2, "modes", unit="pix"))
    layout_sigma: np.ndarray | None = field(default=None, metadata=array(2, 3, unit="pix", minimum=0, infinite=True))
    static_sigma: np.ndarray | None = field(
        default=None, metadata=array(2, "modes", unit="pix", minimum=0, infinite=True)
    )
    static_covariance: np.ndarray | None = field(
        default=None, metadata=array("2 modes", "2 modes", unit="pix2", covariance=True, infinite=True)
    )
    layout_covariance: np.ndarray | None = field(
        default=None, metadata=array(6, 6, unit="pix2", covariance=True, infinite=True)
    )
    header_layout: np.ndarray | None = field(default=None, metadata=array(2, 3, unit="pix", invertible=True))

    def __post_init__(self) -> None:
        shape = check_shape(self.shape)
        layout = _affine(self.layout, "layout")
        static, sigma, correlated = self.static, self.static_sigma, self.static_covariance
        if hasattr(static, "static_sigma"):
            if static.shape not in (None, shape):
                raise InputError(f"the prior is for a detector of shape {static.shape}, this one has {shape} (ny, nx)")
            if sigma is None and correlated is None:
                sigma, correlated = static.static_sigma, static.static_covariance
            static = static.mean
        static = np.zeros((2, 1)) if static is None else Distortion(static, shape).coefficients
        if not np.array_equal(layout, np.eye(2, 3)):
            static, layout = _split(static, shape, layout)
        given = {"shape": shape, "layout": layout, "static": static}
        given["header_layout"] = None if self.header_layout is None else _affine(self.header_layout, "header_layout")
        covariance = _covariance(self.layout_covariance)
        widths = self.layout_sigma if covariance is None else np.sqrt(np.diag(covariance)).reshape(2, 3)
        given["layout_sigma"], given["layout_covariance"] = as_widths(widths, 3, "layout_sigma"), covariance
        names = "static_sigma", "static_covariance"
        given |= dict(zip(names, as_errors(sigma, correlated, static.shape[1], names), strict=True))
        for key, value in given.items():
            object.__setattr__(self, key, value)

    def placed(self) -> Detector:
        """The same map with all of orders 0 and 1 in the layout, as detectors of a focal plane have it."""
        static, layout = _split(self.static, self.shape, self.layout)
        return replace(self, static=static, layout=layout) if np.any(self.static[:, :3]) else self

    @property
    def is_plain(self) -> bool:
        """Whether its layout is the identity, exactly: its undistorted pixels are those of the focal plane."""
        return self.layout_sigma is None and np.array_equal(self.layout, np.eye(2, 3))

    @cached_property
    def distortion(self) -> Distortion:
        """The static `Distortion`: undistorted -> detector pixels."""
        return Distortion(self.static, self.shape)

    @plain_numbers
    def to_pixels(self, f: ArrayLike) -> np.ndarray:
        """Focal-plane pixels (n, 2) -> detector pixels (n, 2)."""
        return self.distortion(similarity.apply(self.layout, f))

    @plain_numbers
    def to_focal_plane(
        self, xy: ArrayLike, covariance: ArrayLike | None = None
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """Detector pixels (n, 2) -> focal-plane pixels (n, 2), exact; with covariances (n, 2, 2) a tuple of both.

        Raises
        ------
        FoldError
            If the static distortion folds.
        """
        f = similarity.apply(similarity.invert(self.layout), self.distortion.invert(xy))
        if covariance is None:
            return f
        back = np.linalg.inv(self.slope(f))
        return f, back @ covariance @ back.mT

    @plain_numbers
    def sees(self, f: ArrayLike) -> np.ndarray:
        """Which positions f (n, 2) of the focal plane fall on it."""
        q, size = similarity.apply(self.layout, f), np.array(self.shape[::-1])
        near = np.all((q > -0.1 * size) & (q < 1.1 * size), axis=1)  # beyond that the series means nothing
        xy = self.distortion(q[near])
        near[near] = np.all((xy >= -0.5) & (xy <= size - 0.5), axis=1)
        return near

    @plain_numbers
    def slope(self, f: ArrayLike) -> np.ndarray:
        """Derivative (n, 2, 2) of the detector pixels by the focal-plane pixels f (n, 2)."""
        return self.distortion.jacobian(similarity.apply(self.layout, f)) @ self.layout[:, :2]

    @cached_property
    def outline(self) -> np.ndarray:
        """Its edge in the focal plane, from corner to corner, shape (n, 2)."""
        t = np.linspace(-1, 1, _EDGE)
        one = np.ones(_EDGE)
        sides = np.concatenate([np.stack(s, axis=1) for s in ((t, -one), (one, t), (-t, one), (-one, -t))])
        return self.to_focal_plane(basis.denormalize(*sides.T, self.shape))

    @property
    def place(self) -> Place:
        """The `Place` of the detector, by its layout alone; see `Camera.places`."""
        middle = basis.denormalize(np.zeros(1), np.zeros(1), self.shape)
        x, y = similarity.apply(similarity.invert(self.layout), middle)[0]
        m, errors = self.layout[:, :2], None
        parity = np.sign(np.linalg.det(m))
        rotation = np.degrees(np.arctan2(m[1, 0] - parity * m[0, 1], m[0, 0] + parity * m[1, 1]))  # without the shear
        if self.layout_sigma is not None:
            covariance = self.layout_covariance
            covariance = np.diag(self.layout_sigma.ravel() ** 2) if covariance is None else covariance
            errors = tuple(_error(row, covariance) for row in self.place_weights)
        return Place(float(x), float(y), float(rotation), float(np.sqrt(abs(np.linalg.det(m)))), errors)

    @property
    def place_weights(self) -> np.ndarray:
        """How x, y [pix] and rotation [deg] of its place follow the modes of `layout_sigma`, (3, 6); signs aside."""
        (ny, nx), weights = self.shape, np.zeros((3, 6))
        weights[:2, [0, 3]] = np.linalg.inv(self.layout[:, :2]) / 2  # L_0 is 1/2
        weights[2, [2, 4]] = np.degrees(np.sqrt(0.75)) * np.array([-1 / ny, 1 / nx])  # half the curl, sqrt(3)/2 u
        return weights

    @property
    def rms(self) -> float:
        """Root mean square of the static distortion over the detector, both axes, pixels."""
        return float(np.sqrt((self.static**2).sum()) / 2)

    def __repr__(self) -> str:
        return f"<Detector: {self.shape[1]} x {self.shape[0]} px, static distortion {self.rms:.3g} px rms>"


def map_alone(detector, plane=None):
    """Similarity (2, 3) from the focal plane to a detector, and coefficients (2, n_modes) of the rest of its map.

    With a `Distortion` of the focal plane, `plane`, also what that makes of the rest.
    """
    t = np.linspace(-1, 1, 9)
    q = basis.denormalize(*(a.ravel() for a in np.meshgrid(t, t)), detector.shape)
    pose = similarity.fit_similarity(similarity.apply(similarity.invert(detector.layout), q), q)
    return pose, map_beside(detector, pose, plane)


def map_beside(detector, pose, plane=None):
    """Coefficients (2, n_modes) of what is left of the map of a detector beside a pose (2, 3), as `map_alone`."""
    back = similarity.invert(pose)

    def shift(u, v):
        place = basis.denormalize(u, v, detector.shape)
        f = similarity.apply(back, place)
        return (detector.to_pixels(f if plane is None else plane(f)) - place).T

    degree = max(basis.degree_of(detector.static.shape[1]), 1 if plane is None else plane.degree)
    return basis.project(shift, degree)


def maps_of_plane(detector, field, n):
    """Coefficients (2 n, 2 n) on a detector of the modes of its focal plane, whose size is `field` (ny, nx)."""
    degree, back = basis.degree_of(n), similarity.invert(detector.layout)

    def modes(u, v):
        there = similarity.apply(back, basis.denormalize(u, v, detector.shape))
        return basis.values(degree, *basis.normalize(there, field))

    alone = basis.project(modes, degree)
    return np.einsum("ab,mk->akbm", detector.layout[:, :2], alone).reshape(2 * n, 2 * n)


def widths_alone(detector, n):
    """Standard deviations (2, n) of the coefficients of `map_alone`; 0 of what the detector takes as exact."""
    given = [detector.layout_sigma, detector.static_sigma]
    layout, static = (np.zeros((2, n)) if w is None else basis.change_degree(w, basis.degree_of(n)) for w in given)
    return np.where(np.arange(n) < 3, np.maximum(layout, static), static)


def moved_by(detector, q, changes):
    """How changes (2, n_modes, k) of the modes of a detector move what it measured, in the focal plane, (n, 2, k).

    Modes of orders 0 and 1 are its layout, which moves the static distortion along. `q` (n, 2) are undistorted pixels.
    """
    values = basis.values(basis.degree_of(changes.shape[1]), *basis.normalize(q, detector.shape))
    low, high = (np.einsum("amk,mn->nak", changes[:, part], values[part]) for part in (slice(0, 3), slice(3, None)))
    return -np.linalg.inv(detector.layout[:, :2]) @ (low + np.linalg.inv(detector.distortion.jacobian(q)) @ high)


def _affine(value, name):
    """An affine map (2, 3)."""
    out = np.array(value, dtype=float)
    if out.shape != (2, 3) or not np.isfinite(out).all() or np.linalg.det(out[:, :2]) == 0:
        raise InputError(f"{name} must be a finite (2, 3) array [M | t] with an area, got {value!r}")
    return out


def _covariance(value):
    """A covariance (6, 6) of the modes of a layout; None as None."""
    if value is None:
        return None
    out = np.array(value, dtype=float)
    if out.shape != (6, 6) or np.isnan(out).any() or not np.all(np.diag(out) >= 0):
        raise InputError(f"layout_covariance must be a (6, 6) covariance in px^2, got an array of shape {out.shape}")
    return out


def _error(weights, covariance):
    """Standard deviation of a weighted sum of modes, infinite where one of them is that counts."""
    counts = weights != 0
    if np.isinf(np.diag(covariance)[counts]).any():
        return float("inf")
    return float(np.sqrt(weights[counts] @ covariance[np.ix_(counts, counts)] @ weights[counts]))


def affine_of(modes, shape):
    """Affine map (2, 3) of undistorted pixels of which modes (2, 3) of orders 0 and 1 are the change."""
    low = Distortion(modes, shape)
    origin, *ends = low(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return np.column_stack([*(end - origin for end in ends), origin])


def _split(static, shape, layout):
    """Static distortion and layout with all of orders 0 and 1 in the layout; the map of both is the same.

    With ``B(q) = q + (orders 0 and 1)`` and ``p = B(q)`` the rest is a polynomial of p of the same degree.
    """
    degree = basis.degree_of(static.shape[1])
    for _ in range(20):
        low = basis.change_degree(static, 1)
        if np.abs(low).max() < 1e-13:
            break
        affine = affine_of(low, shape)
        rest = Distortion(static - basis.change_degree(low, max(degree, 1))[:, : static.shape[1]], shape)
        back = similarity.invert(affine)

        def shift(u, v, rest=rest, back=back):
            q = similarity.apply(back, basis.denormalize(u, v, rest.shape))
            return (rest(q) - q).T

        static, layout = basis.project(shift, degree), similarity.compose(affine, layout)
    static[:, :3] = 0
    return static, layout
