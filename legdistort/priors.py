"""What is known of the distortion beforehand."""

from dataclasses import dataclass

import numpy as np

from . import basis, poses
from .exceptions import InputError


def _per_mode(value, n, name):
    """A width given as a number, per mode or per axis and mode -> (2, n_modes), non-negative."""
    out = np.asarray(value, dtype=float)
    try:
        out = np.broadcast_to(out, (2, n)).copy()
    except ValueError:
        raise InputError(
            f"{name} must be a number, one per mode ({n},) or per axis and mode (2, {n}), got shape {out.shape}"
        ) from None
    if not np.all(out >= 0) or not np.all(np.isfinite(out)):
        raise InputError(f"{name} must be finite and not negative (a standard deviation in pixels), got {value!r}")
    return out


@dataclass(frozen=True, eq=False, init=False)
class Prior:
    """Static distortion known beforehand, and how far to trust it.

    Parameters
    ----------
    mean : array_like, shape (2, n_modes)
        Static distortion A_0 in the normalised Legendre basis, pixels, x then y (reference -> detector).
    sigma : array_like, optional
        Scatter of single exposures around the mean, pixels: a number, (n_modes,) or (2, n_modes). It shrinks
        what the data cannot tell. None leaves the exposures free. Zero keeps a mode at the mean.
    static_sigma : array_like, optional
        Uncertainty of the mean itself, same forms. It is common to all exposures and does not average down.
    shape : tuple, optional
        ``(ny, nx)`` of the detector it belongs to; solving exposures of another shape with it is then an error.

    Attributes
    ----------
    truncation : float
        Largest distance [pix] on the detector between the mean and the model it was made from (0 if given directly).
    plane : ndarray or None
        Pose (2, 3) from the plane of that model to undistorted pixels: the similarity taken out of the mean.

    Raises
    ------
    InputError
        For arrays of the wrong length or values that are not finite.
    """

    mean: np.ndarray
    sigma: np.ndarray | None
    static_sigma: np.ndarray | None
    shape: tuple | None
    truncation: float
    plane: np.ndarray | None

    def __init__(self, mean, *, sigma=None, static_sigma=None, shape=None, truncation=0.0, plane=None):
        mean = np.array(mean, dtype=float)
        if mean.ndim != 2 or mean.shape[0] != 2:
            raise InputError(f"mean must have shape (2, n_modes), x then y, got {mean.shape}")
        if not np.all(np.isfinite(mean)):
            raise InputError("mean has values that are not finite")
        basis.degree_of(mean.shape[1])
        widths = [
            None if value is None else _per_mode(value, mean.shape[1], name)
            for value, name in ((sigma, "sigma"), (static_sigma, "static_sigma"))
        ]
        for name, value in zip(
            ("mean", "sigma", "static_sigma", "shape", "truncation", "plane"),
            (mean, *widths, shape, truncation, plane),
            strict=True,
        ):
            object.__setattr__(self, name, value)

    @property
    def degree(self):
        """Total degree of the mean."""
        return basis.degree_of(self.mean.shape[1])

    def __repr__(self):
        words = [f"degree {self.degree}", f"{self.mean.shape[1]} modes an axis"]
        words += [f"{name} given" for name in ("sigma", "static_sigma") if getattr(self, name) is not None]
        return f"<Prior: {', '.join(words)}>"

    @classmethod
    def from_model(cls, model, *, shape, direction, origin=0, degree=5, parity=None, sigma=None, static_sigma=None):
        """Prior from any astropy model or function of a detector's static distortion.

        The map may end in any plane (arcsec, degrees, pixels): the similarity between that plane and the detector
        is taken out, since it belongs to the pose of an exposure; shear stays.

        Parameters
        ----------
        model : callable
            ``model(x, y) -> (x, y)`` on arrays, between detector pixels and an undistorted plane.
        shape : tuple
            ``(ny, nx)`` of the detector.
        direction : {"detector_to_reference", "reference_to_detector"}
            What the model does.
        origin : {0, 1}
            Coordinate of the centre of the model's first pixel.
        degree : int
            Total degree of the Legendre series; `truncation` tells what it leaves out.
        parity : {1, -1, None}
            Orientation of the plane relative to the detector; None takes what fits.
        sigma, static_sigma
            As for `Prior`.

        Raises
        ------
        InputError
            For a wrong direction or origin, or a model that cannot be followed over the detector.
        """
        if direction not in ("detector_to_reference", "reference_to_detector"):
            raise InputError(f"direction must be 'detector_to_reference' or 'reference_to_detector', got {direction!r}")
        if origin not in (0, 1):
            raise InputError(f"origin must be 0 or 1 (coordinate of the first pixel's centre), got {origin!r}")
        degree = basis.check_degree(degree)
        to_plane = _Plane(model, shape, direction, origin)
        pose = poses.fit_similarity(to_plane.plane, to_plane.pixels, parity=parity)
        for _ in range(10):
            mean = basis.project(
                lambda u, v, pose=pose: to_plane.displacement(basis.denormalize(u, v, shape), pose), degree, degree + 6
            )
            shift = similarity_part(mean, shape)
            pose = poses.compose(shift, pose)
            if np.abs(poses.apply(shift, to_plane.pixels) - to_plane.pixels).max() < 1e-10:
                break
        q = poses.apply(pose, to_plane.plane)
        left = to_plane.pixels - q - (mean @ basis.values(degree, *basis.normalize(q, shape))).T
        truncation = float(np.hypot(*left.T).max())
        return cls(mean, sigma=sigma, static_sigma=static_sigma, shape=tuple(shape), truncation=truncation, plane=pose)


class _Plane:
    """A caller's model as the function plane -> detector pixels (0-based)."""

    def __init__(self, model, shape, direction, origin):
        self._model, self._origin, self._inverse = model, origin, direction == "reference_to_detector"
        t = np.linspace(-1, 1, 41)
        self.pixels = basis.denormalize(*(a.ravel() for a in np.meshgrid(t, t)), shape)
        if self._inverse:
            self.plane = self._locate_plane()
        else:
            self.plane = self._call(self.pixels + origin)
        if not np.all(np.isfinite(self.plane)):
            raise InputError("the model gives values that are not finite on the detector; check shape and origin")

    def _locate_plane(self):
        """Plane coordinates that fall on the detector: affine steps outward from the origin, then Newton."""
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        size = 1.0
        for _ in range(30):  # a step in the plane that moves the image by about a pixel
            moved = np.ptp(self._call(size * corners), axis=0).max()
            if not 0 < moved < np.inf:
                raise InputError("the model is not finite, or constant, around the origin of its plane")
            if 0.1 < moved < 10:
                break
            size /= moved
        plane = size * corners
        for spread in np.linspace(0.05, 1, 20):  # widen slowly: far from the detector the model means nothing
            design = np.column_stack([plane, np.ones(len(plane))])
            affine = np.linalg.lstsq(design, self._call(plane) - self._origin, rcond=None)[0]
            centre = self.pixels.mean(axis=0)
            plane = (centre + spread * (self.pixels - centre) - affine[2]) @ np.linalg.inv(affine[:2])
        step = 0.5 / np.sqrt(abs(np.linalg.det(affine[:2])))
        return self._newton(lambda w: self._call(w) - self._origin, self.pixels, plane, step)

    def _call(self, xy):
        return np.stack([np.asarray(a, dtype=float) for a in self._model(xy[:, 0], xy[:, 1])], axis=1)

    def displacement(self, q, pose):
        """p - q (2, n) of the detector pixels p that see the undistorted pixels q."""
        w = poses.apply(poses.invert(pose), q)
        if self._inverse:
            p = self._call(w) - self._origin
        else:
            p = self._newton(lambda p: self._call(p + self._origin), w, q)
        return (p - q).T

    @staticmethod
    def _newton(function, target, start, step=0.5):
        """Solve function(p) = target from start, Jacobian by central differences over `step` (half a pixel)."""
        p = start
        for _ in range(40):
            dx = (function(p + [step, 0]) - function(p - [step, 0])) / (2 * step)
            dy = (function(p + [0, step]) - function(p - [0, step])) / (2 * step)
            change = np.linalg.solve(np.stack([dx, dy], axis=2), (target - function(p))[..., None])[..., 0]
            p = p + change
            if not np.abs(change).max() > 1e-11 * (1 + np.abs(p).max()):
                return p
        raise InputError(
            f"the model cannot be inverted over the detector (last step {np.abs(change).max():.1e}); "
            "check direction, shape and origin"
        )


def similarity_basis(shape, n):
    """Orthonormal coefficient vectors of the similarities of a detector, shape (4 or 2, 2 * n_modes).

    Shift in x and y, scale, rotation, as displacement fields; only the shifts if there are no linear modes.
    """
    ny, nx = shape
    rows = np.zeros((2 if n < 3 else 4, 2, n))
    rows[0, 0, 0] = rows[1, 1, 0] = 1
    if n >= 3:  # x = nx/2 u, and u = L_1(u) L_0 2/sqrt(3): modes 1 (along x) and 2 (along y)
        rows[2, 0, 1], rows[2, 1, 2] = nx, ny
        rows[3, 0, 2], rows[3, 1, 1] = -ny, nx
    rows = rows.reshape(len(rows), -1)
    return rows / np.linalg.norm(rows, axis=1)[:, None]


def dynamic_basis(shape, n):
    """Orthonormal coefficient vectors of all but the similarities, shape (2 * n_modes - 4 or - 2, 2 * n_modes).

    Two shears first, then the modes of degree 2 and more as they are, x before y.
    """
    if n < 3:
        return np.zeros((0, 2 * n))
    ny, nx = shape
    shears = np.zeros((2, 2, n))
    shears[0, 0, 1], shears[0, 1, 2] = ny, -nx
    shears[1, 0, 2], shears[1, 1, 1] = nx, ny
    shears = shears.reshape(2, -1) / np.hypot(nx, ny)
    unit = np.eye(2 * n).reshape(2 * n, 2, n)
    return np.concatenate([shears, unit[np.r_[3:n, n + 3 : 2 * n]].reshape(-1, 2 * n)])


def similarity_part(coefficients, shapes):
    """The similarity closest to ``q + A b(q)``, as a pose (..., 2, 3) in the detector's pixels.

    Parameters
    ----------
    coefficients : ndarray, shape (..., 2, n_modes)
    shapes : tuple, or list of tuples
        ``(ny, nx)``; one for all, or one for each.
    """
    size = np.broadcast_to(np.array(shapes)[..., ::-1], (*coefficients.shape[:-2], 2)).astype(float)  # nx, ny
    pose = np.zeros((*coefficients.shape[:-1], 3))
    pose[..., 0, 0] = pose[..., 1, 1] = 1
    pose[..., 2] = coefficients[..., 0] / 2  # b_0 = 1/2
    if coefficients.shape[-1] >= 3:
        # scale and rotation per pixel: coefficients s nx/sqrt(3), s ny/sqrt(3) in modes 1 (x) and 2 (y), by projection
        (xx, xy), (yx, yy) = np.moveaxis(coefficients[..., 1:3], (-2, -1), (0, 1))
        nx, ny = np.moveaxis(size, -1, 0)
        norm = np.sqrt(3) / (nx**2 + ny**2)
        scale, turn = (nx * xx + ny * yy) * norm, (nx * yx - ny * xy) * norm
        pose[..., 0, 0] += scale
        pose[..., 1, 1] += scale
        pose[..., 0, 1], pose[..., 1, 0] = -turn, turn
        middle = (size - 1) / 2
        pose[..., 0, 2] -= scale * middle[..., 0] - turn * middle[..., 1]
        pose[..., 1, 2] -= turn * middle[..., 0] + scale * middle[..., 1]
    return pose
