"""Published static distortions of real instruments, as they were published.

GSAOI at Gemini South (four detectors of 2048 x 2048 pixels, about 20 mas a pixel): third-degree
polynomials from the DRAGONS reduction package; source and licence stand in
``data/gsaoi_static_distortion.json``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
from astropy.modeling import models
from numpy.polynomial import polynomial

from ..exceptions import FoldError, InputError
from .similarity import apply, compose, describe, fit_similarity, invert

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

#: Pixels along a side of a GSAOI detector.
GSAOI_SIZE = 2048


def gsaoi_polynomials(detector=2):
    """Published coefficients of one GSAOI detector.

    Parameters
    ----------
    detector : int
        1 to 4; 2 is the lower left one, used by Bernard et al. (2017, section 5).

    Returns
    -------
    ndarray, shape (2, 4, 4)
        ``c[axis, i, j]`` multiplies ``x**i * y**j``, with (x, y) the *1-based* pixel; the sum is in arcsec.

    Raises
    ------
    InputError
        If there is no such detector.
    """
    if detector not in (1, 2, 3, 4):
        raise InputError(f"detector must be 1, 2, 3 or 4, got {detector!r}")
    published = resources.files("legdistort").joinpath("data/gsaoi_static_distortion.json")
    table = json.loads(published.read_text(encoding="utf-8"))
    out = np.zeros((2, 4, 4))
    for part in ("linear", "nonlinear"):
        for axis, letter in enumerate("xy"):
            for name, value in table[part][detector - 1][letter].items():
                i, j = map(int, name[1:].split("_"))
                out[axis, i, j] += value
    return out


def gsaoi_static(detector=2, *, size=GSAOI_SIZE):
    """Static distortion of one GSAOI detector as an astropy model.

    Parameters
    ----------
    detector : int
        1 to 4; 2 is the lower left one.
    size : int
        Pixels along a side. Other than 2048 it is the same field on a detector of coarser or finer pixels.

    Returns
    -------
    `~astropy.modeling.CompoundModel`
        (x, y) of the *0-based* pixel -> (x, y) [arcsec] of the focal plane. Stock models without units;
        it has no analytic inverse.

    Examples
    --------
    >>> from legdistort.geometry.gsaoi import gsaoi_static
    >>> x, y = gsaoi_static(detector=2)(1023.5, 1023.5)
    >>> print(f"{x:.3f} {y:.3f}")
    -26.990 -27.390
    """
    binning = _binning(size)
    names = {f"c{i}_{j}": (i, j) for i in range(4) for j in range(4 - i)}
    c_x, c_y = gsaoi_polynomials(detector)
    surface_x, surface_y = (
        models.Polynomial2D(3, **{name: c[order] for name, order in names.items()}) for c in (c_x, c_y)
    )
    # 0-based pixel of this detector -> 1-based pixel of the published one
    axis = models.Polynomial1D(1, c0=(binning + 1) / 2, c1=binning)
    return axis & axis | models.Mapping((0, 1, 0, 1)) | surface_x & surface_y


def _binning(size):
    if not (np.isscalar(size) and size >= 2):
        raise InputError(f"size must be a number of pixels of at least 2, got {size!r}")
    return GSAOI_SIZE / size


@dataclass(frozen=True)
class GsaoiMap:
    """The published map of a GSAOI detector, in pixels and in both directions.

    The published polynomial P carries a pixel to arcsec, from the distorted detector to the undistorted
    plane. Undistorted *pixels* are ``q = S^-1(P(x))``. S is the similarity that leaves no shift, rotation or
    scale in ``distort(q) - q`` over the detector (least squares). The way back, from q to the detector, is
    found by Newton's method on P itself.

    Attributes
    ----------
    detector : int
    size : int
        Pixels along a side (see `gsaoi_static`).
    """

    detector: int = 2
    size: int = GSAOI_SIZE

    @cached_property
    def _coefficients(self):
        return gsaoi_polynomials(self.detector)

    @cached_property
    def similarity(self) -> np.ndarray:
        """S as a pose (2, 3): undistorted pixels -> arcsec."""
        nodes, weights = np.polynomial.legendre.leggauss(12)
        grid = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
        grid = ((grid + 1) * self.size - 1) / 2
        weights = np.outer(weights, weights).ravel()
        pose = fit_similarity(grid, self.to_arcsec(grid), weights=weights, parity=1)
        for _ in range(6):  # each time 50 to 100 times nearer
            rest = fit_similarity(grid, self._invert(apply(pose, grid), grid), weights=weights)
            pose = compose(pose, invert(rest))
        return pose

    @property
    def pixel_scale(self) -> float:
        """Size of an undistorted pixel, arcsec."""
        return describe(self.similarity)["scale"]

    def to_arcsec(self, xy: ArrayLike) -> np.ndarray:
        """Detector pixels (..., 2), 0-based -> arcsec (..., 2): the published polynomials."""
        x, y = self._published_pixel(xy)
        return np.stack([polynomial.polyval2d(x, y, c) for c in self._coefficients], axis=-1)

    def undistort(self, xy: ArrayLike) -> np.ndarray:
        """Detector pixels (..., 2) -> undistorted pixels."""
        return apply(invert(self.similarity), self.to_arcsec(xy))

    def distort(self, q: ArrayLike) -> np.ndarray:
        """Undistorted pixels (..., 2) -> detector pixels, inverse of `undistort`.

        Raises
        ------
        FoldError
            If Newton's method does not get there, which happens only far off the detector.
        """
        return self._invert(apply(self.similarity, q), q)

    def _invert(self, arcsec, start):
        xy = np.array(start, dtype=float)
        for _ in range(20):
            step = np.linalg.solve(self._jacobian(xy), (arcsec - self.to_arcsec(xy))[..., None])[..., 0]
            xy += step
            if not np.abs(step).max(initial=0) > 1e-10:
                return xy
        worst = np.asarray(start).reshape(-1, 2)[np.abs(step).max(axis=-1).argmax()]
        raise FoldError(
            f"the GSAOI map folds near undistorted pixel {worst.round(1).tolist()}, far off the detector; "
            "make dithers smaller"
        )

    def _published_pixel(self, xy):
        return np.moveaxis((np.asarray(xy, dtype=float) + 0.5) * _binning(self.size) + 0.5, -1, 0)

    def _jacobian(self, xy):
        x, y = self._published_pixel(xy)
        rows = [
            np.stack([polynomial.polyval2d(x, y, polynomial.polyder(c, axis=axis)) for axis in (0, 1)], axis=-1)
            for c in self._coefficients
        ]
        return np.stack(rows, axis=-2) * _binning(self.size)
