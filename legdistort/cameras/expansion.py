"""Any map of a detector as a similarity and a Legendre series, with the measured error of leaving off the rest."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates

from ..exceptions import InputError
from ..geometry import basis, detector_modes, similarity
from ..geometry.distortion import Distortion
from ..geometry.tabulated.displacement_table import DisplacementTable
from .source import check_folds

#: Points along a side of the grid that folds and truncation are looked for on, and of the coarser one for the pose.
CHECK_GRID, POSE_GRID = 129, 33
#: Least number of quadrature nodes along a side: for maps that are no polynomials.
NODES = 24
#: Rounds in which a table is looked up where it leads to, at most, and the change [pix] at which they end.
_ROUNDS, _SAME = 50, 1e-7


def expand(source, degree, parity=None):
    """Legendre coefficients of a source.

    The pose is the similarity that leaves none in the series (least squares over the detector).

    Parameters
    ----------
    source : Source
        Complete (see `Source.stated`).
    degree : int
        Total degree.
    parity : {1, -1, None}
        Orientation of the plane relative to the detector; None takes what fits.

    Returns
    -------
    coefficients : ndarray, shape (2, n_modes)
        Pixels, undistorted to detector.
    pose : ndarray, shape (2, 3)
        From the plane of the source to undistorted pixels.
    truncation : float
        Largest distance [pix] of source and series over a dense grid of the detector, edges and corners included.

    Raises
    ------
    InputError
        If the source cannot be followed over the detector.
    """
    to_plane, shape = _Plane(source), source.shape
    check_folds(to_plane.dense, to_plane.pixels, source.name)
    every = (CHECK_GRID - 1) // (POSE_GRID - 1)
    pixels, plane = (grid[::every, ::every].reshape(-1, 2) for grid in (to_plane.pixels, to_plane.dense))
    pose = similarity.fit_similarity(plane, pixels, parity=parity)
    for _ in range(10):
        mean = basis.project(
            lambda u, v, pose=pose: to_plane.displacement(basis.denormalize(u, v, shape), pose),
            degree,
            max(NODES, degree + 6),
        )
        shift = detector_modes.similarity_part(mean, shape)
        pose = similarity.compose(shift, pose)
        if np.abs(similarity.apply(shift, pixels) - pixels).max() < 1e-10:
            break
    return mean, pose, _truncation(to_plane, pose, Distortion(mean, shape))


def expand_placed(source, degree, parity, *, shape, offset):
    """The same for a source that is a part of the detector, or more than it: `expand` there, and carried over.

    A polynomial on one box is one of the same degree on another. Where the source does not reach, it is continued.

    Parameters
    ----------
    source, degree, parity
        As for `expand`.
    shape : tuple
        ``(ny, nx)`` of the detector.
    offset : tuple of float
        Pixel (x, y) of the detector on which the first pixel of the source lies, 0-based.

    Returns
    -------
    coefficients, pose, truncation
        As of `expand`; the truncation over the source.
    covered : float
        Part of the detector that the source covers.

    Raises
    ------
    InputError
        If the source lies beside the detector, or folds where it is continued.
    """
    offset = np.asarray(offset, dtype=float)
    ends = np.minimum(offset + source.shape[::-1], shape[::-1]) - np.maximum(offset, 0)
    if not np.all(ends > 0):
        raise InputError(
            f"{source.name} of shape {source.shape} (ny, nx) at x, y = {offset[0]:g}, {offset[1]:g} lies beside the "
            f"detector of shape {tuple(shape)}: offset (--offset X Y) is where its first pixel lies"
        )
    mean, pose, truncation = expand(source, degree, parity)
    series = Distortion(mean, source.shape)

    def function(x, y):
        return (series(np.stack([x, y], axis=-1) - offset) + offset).T

    kind = {"direction": "reference_to_detector", "origin": 0, "shape": tuple(shape)}
    whole = replace(source, function=function, sphere=None, from_middle=False, **kind)
    covered = float(np.prod(ends) / np.prod(shape))
    try:
        mean, shift, _ = expand(whole, degree)
    except InputError as error:
        raise InputError(
            f"continued over the {100 * (1 - covered):.0f} % of the detector that it does not cover, at degree "
            f"{degree}: {error}; lower the degree (--degree)"
        ) from None
    pose = similarity.compose(shift, similarity.compose(np.column_stack([np.eye(2), offset]), pose))
    return mean, pose, truncation, covered


def rough_part(source, coefficients, pose):
    """What a source has beside its series, as a table at undistorted pixels, and the distance of both together.

    Beyond the edges of the detector it goes on as it went: turned about the nearest point of the edge.

    Parameters
    ----------
    source : Source
        Complete (see `Source.stated`).
    coefficients, pose
        Of `expand`.

    Returns
    -------
    table : DisplacementTable
    truncation : float
        Largest distance [pix] of source and series with table, as of `expand`.

    Raises
    ------
    InputError
        If it changes from pixel to pixel by more than that it can be followed.
    """
    to_plane, series = _Plane(source), Distortion(coefficients, source.shape)
    ends = basis.denormalize(np.array([-1.0, 1.0]), np.array([-1.0, 1.0]), source.shape)

    def inside(pixels):
        return pixels - series(similarity.apply(pose, to_plane.of_pixels(pixels)))

    def beside(pixels):
        nearest = np.clip(pixels, *ends)
        out, beyond = inside(nearest), np.any(nearest != pixels, axis=1)
        out[beyond] = 2 * out[beyond] - inside(2 * nearest[beyond] - pixels[beyond])
        return out

    def displacements(q):
        smooth, found = series(q), np.zeros_like(q)
        for _ in range(_ROUNDS):
            found, last = beside(smooth + found), found
            if np.abs(found - last).max() < _SAME:
                return found
        raise InputError(
            f"{source.name} is too ragged: what no series of degree {series.degree} follows changes from pixel to "
            f"pixel by {np.abs(found - last).max():.2g} px; smooth it, or raise the degree (--degree)"
        )

    seen = basis.denormalize(*np.random.default_rng(1).uniform(-1, 1, (2, 10_000)), source.shape)
    tried = similarity.apply(pose, to_plane.of_pixels(seen))
    table = DisplacementTable.fine_enough(displacements, source.shape, tried=tried)
    return table, _truncation(to_plane, pose, Distortion(coefficients, source.shape, table=table))


def coefficient_widths(source, coefficients, shape, offset=(0.0, 0.0)):
    """Standard errors of the coefficients of a series that was made of a source with errors.

    Errors of neighbouring pixels are not independent: maps are made of far fewer stars than they have pixels, by a
    series or something as smooth. The errors are taken as those of a series, the coefficients of which are independent,
    and all of which contribute alike to the error at a place: with the variance ``sigma(q)^2 / sum_k b_k(q)^2`` that
    makes the error there. Of a coefficient it is the mean of this over the detector, weighted by the square of its
    mode, ``integral of b_m^2 sigma^2 / sum_k b_k^2``. So the mean square of the error over the detector is kept, and
    errors that are alike for all coefficients are found exactly.

    Parameters
    ----------
    source : Source
        With `Source.errors`, and a direction.
    coefficients : ndarray, shape (2, n_modes)
        Of the detector.
    shape : tuple
        ``(ny, nx)`` of the detector.
    offset : tuple of float
        Pixel (x, y) of the detector on which the first pixel of the source lies; what lies off it does not count.

    Returns
    -------
    ndarray, shape (2, n_modes)
    """
    degree = basis.degree_of(coefficients.shape[1])
    u, v, weights = basis.quadrature(max(NODES, 2 * degree + 8))
    q = basis.denormalize(u, v, shape)
    at = Distortion(coefficients, shape)(q) - offset
    at = q - offset if source.direction == "reference_to_detector" else at
    ends = np.array(source.shape[::-1])
    weights = weights * np.all((at >= -0.5) & (at <= ends - 0.5), axis=1)
    square = basis.values(degree, u, v) ** 2
    sigma = np.stack([map_coordinates(each, at.T[::-1], order=1, mode="nearest") for each in source.errors])
    needed = sigma**2 / square.sum(axis=0)
    return np.sqrt((needed * weights) @ square.T / (square @ weights))


def _truncation(to_plane, pose, series):
    """Largest distance of source and series: on the grid, then on a finer one around its worst points."""
    pixels = to_plane.pixels.reshape(-1, 2)
    left = _distance(series, pose, to_plane.dense.reshape(-1, 2), pixels)
    worst = pixels[np.argsort(left)[-8:]]
    cell = to_plane.pixels[1, 1] - to_plane.pixels[0, 0]
    t = np.linspace(-1, 1, 17)
    finer = (worst[:, None] + cell * np.stack(np.meshgrid(t, t), axis=-1).reshape(1, -1, 2)).reshape(-1, 2)
    finer = np.clip(finer, pixels[0], pixels[-1])
    return float(max(left.max(), _distance(series, pose, to_plane.of_pixels(finer), finer).max()))


def _distance(series, pose, plane, pixels):
    return np.hypot(*(series(similarity.apply(pose, plane)) - pixels).T)


class _Plane:
    """A source as the function plane -> detector pixels (0-based)."""

    def __init__(self, source):
        self._function, self._origin, self._name = source.on_plane(), source.origin, source.name
        self._inverse, self._reached = source.direction == "reference_to_detector", None
        t = np.linspace(-1, 1, CHECK_GRID)
        self.pixels = basis.denormalize(*np.meshgrid(t, t), source.shape)
        flat = self.pixels.reshape(-1, 2)
        self._affine = self._approach(flat.mean(axis=0), np.ptp(flat, axis=0)) if self._inverse else None
        self.dense = self.of_pixels(flat).reshape(self.pixels.shape)
        if not np.all(np.isfinite(self.dense)):
            row, column = np.argwhere(~np.isfinite(self.dense))[0, :2]
            raise InputError(
                f"{self._name} gives values that are not finite on the detector, the first at pixel "
                f"{self.pixels[row, column].round(1).tolist()}; check shape and origin"
            )

    def of_pixels(self, pixels):
        """Plane coordinates of detector pixels (n, 2)."""
        if not self._inverse:
            return self._call(pixels + self._origin)
        matrix, shift, size = self._affine
        return self._newton(lambda w: self._call(w) - self._origin, pixels, (pixels - shift) @ matrix, size)[0]

    def _approach(self, centre, extent):
        """Affine approximation pixels -> plane: from the origin of the plane outward; and the size of a pixel there."""
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        size = 1.0
        for _ in range(30):  # a step in the plane that moves the image by about a pixel
            moved = np.ptp(self._call(size * corners), axis=0).max()
            if not 0 < moved < np.inf:
                raise InputError(f"{self._name} is not finite, or constant, around the origin of its plane")
            if 0.1 < moved < 10:
                break
            size /= moved
        plane = size * corners
        for spread in np.linspace(0.05, 1, 20):  # widen slowly: far from the detector the model means nothing
            design = np.column_stack([plane, np.ones(len(plane))])
            affine = np.linalg.lstsq(design, self._call(plane) - self._origin, rcond=None)[0]
            if not abs(np.linalg.det(affine[:2])) > 0:
                raise InputError(f"{self._name} cannot be inverted near the origin of its plane; check direction")
            matrix, shift = np.linalg.inv(affine[:2]), affine[2]
            plane = (centre + spread * extent * (corners - 1 / 3) - shift) @ matrix
            if not np.isfinite(plane).all():
                raise InputError(f"{self._name} is not finite near the detector; check direction")
        return matrix, shift, np.sqrt(abs(np.linalg.det(matrix)))

    def _call(self, xy):
        with np.errstate(all="ignore"):
            return np.stack([np.asarray(a, dtype=float) for a in self._function(xy[:, 0], xy[:, 1])], axis=1)

    def displacement(self, q, pose):
        """p - q (2, n) of the detector pixels p that see the undistorted pixels q."""
        w = similarity.apply(similarity.invert(pose), q)
        if self._inverse:
            return (self._call(w) - self._origin - q).T
        # called for nearly the same again while the pose settles: it goes on from where it was
        start, slope = self._reached or (q, None)
        self._reached = self._newton(lambda p: self._call(p + self._origin), w, start, 1.0, slope)
        return (self._reached[0] - q).T

    def _newton(self, function, target, start, size, slope=None):
        """Solve function(p) = target from start; the result, and the inverse Jacobian near it.

        The Jacobian, central differences over a pixel (of that size in p), is kept while it serves.
        """
        p, moved, step = start, np.inf, size / 2
        for _ in range(60):
            if slope is None:
                dx = (function(p + [step, 0]) - function(p - [step, 0])) / size
                dy = (function(p + [0, step]) - function(p - [0, step])) / size
                try:
                    slope = np.linalg.inv(np.stack([dx, dy], axis=2))
                except np.linalg.LinAlgError:
                    break
            change = np.einsum("nij,nj->ni", slope, target - function(p))
            p = p + change
            before, moved = moved, np.abs(change).max() / size
            # angles in degrees are known to some 1e-8 px: good enough when it comes no nearer
            if moved < 1e-11 or 0.25 * before < moved < 1e-6:
                return p, slope
            if moved > 0.1 * before:
                slope = None
        raise InputError(
            f"{self._name} cannot be inverted over the detector (last step {moved:.1e} px); "
            "check direction, shape and origin"
        )
