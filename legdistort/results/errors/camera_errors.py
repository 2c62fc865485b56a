"""What the errors of what exposures have in common do to stars, coefficients and new positions.

That is a camera that was fitted, the static distortion beyond the degree, or the numbers of terms.

Layouts and statics have a covariance of their own, and stars and coefficients follow them. All of it is written as the
responses to independent errors of unit size: covariances are sums over these, and what two things have in common is in
them. A common map of the plane is taken off, as relative errors have it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ...cameras.detector import moved_by
from ...geometry import basis, similarity
from ...runtime.trees.facts import array, number

if TYPE_CHECKING:
    from ...cameras.camera import Camera
    from ..view import View

#: Variances below this part of the largest are rounding.
_ROUNDING = 1e-13


@dataclass(frozen=True)
class Departure:
    """By how much a camera that was fitted departs from what was stated of it with its widths.

    Attributes
    ----------
    rows : int
        Numbers that were stated.
    chi2, dof : float
        Of what the exposures determine of layouts and statics.
    detector : str
        That which departs most.
    """

    rows: int = field(metadata=number(minimum=0))
    chi2: float = field(metadata=number(minimum=0))
    dof: float = field(metadata=number(minimum=0))
    detector: str = ""


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Responses to r independent errors of a camera, of unit size.

    Attributes
    ----------
    free : ndarray of bool, shape (n_detectors, 2, n_modes)
        Modes that were fitted.
    changes : ndarray, shape (k, r)
        Of these modes, pixels.
    stars : ndarray, shape (n_stars, 2, r) or (n_stars, 2 + k, r)
        Of the positions, pixels of the reference plane, and perhaps of what moves stars.
    coefficients : ndarray, shape (n_exposures, 2 n_modes, r)
        Of the fitted coefficients, pixels.
    unknown : ndarray, shape (n_stars, 2, m)
        How stars move with directions of the camera that nothing determines, of unit rms.
    departure : Departure or None
        None where nothing was stated.
    owner : ndarray of int, shape (n_exposures,), or None
        Detector of every exposure, where each is of one alone and the modes are those of the exposure; None for those
        of the detectors of a camera.
    numbers : ndarray, shape (m, r), or None
        Of the numbers of terms, in the order of `Diagnostics.terms`.
    unsettled : float
        Largest change of the camera by the last step, in its errors, where it did not settle; 0 where it did.
    """

    free: np.ndarray = field(metadata=array("n_parts", 2, "modes", holds="booleans"))
    changes: np.ndarray = field(metadata=array("k", "r", unit="pix"))
    stars: np.ndarray = field(metadata=array("n_stars", "n_star_rows", "r", unit="pix"))
    coefficients: np.ndarray = field(metadata=array("n_exposures", "2 n_modes", "r", unit="pix"))
    unknown: np.ndarray = field(
        default_factory=lambda: np.zeros((0, 2, 0)), metadata=array("n_stars", 2, "m", blocks=(0, 2, 0))
    )
    departure: Departure | None = None
    owner: np.ndarray | None = field(default=None, metadata=array("n_exposures", holds="integers"))
    numbers: np.ndarray | None = field(default=None, metadata=array("n_numbers", "r"))
    unsettled: float = field(default=0.0, metadata=number(minimum=0))

    @classmethod
    def nothing(cls, n_parts: int, n_exposures: int, n_stars: int, size: int) -> CameraErrors:
        """Those of what has no errors: of some parts, exposures with `size` coefficients, and stars."""
        free = np.zeros((n_parts, 2, 1), dtype=bool)
        return cls(free, np.zeros((0, 0)), np.zeros((n_stars, 2, 0)), np.zeros((n_exposures, size, 0)))

    def beside(self, stars: np.ndarray, coefficients: np.ndarray, numbers: np.ndarray) -> CameraErrors:
        """With other independent errors of unit size, to which stars, coefficients and numbers of terms respond."""
        changes = np.pad(self.changes, ((0, 0), (0, stars.shape[2])))
        known = np.pad(self.stars, ((0, 0), (0, stars.shape[1] - self.stars.shape[1]), (0, 0)))
        coefficients = np.concatenate([self.coefficients, coefficients], axis=2)
        stars, numbers = np.concatenate([known, stars], axis=2), np.pad(numbers, ((0, 0), (self.changes.shape[1], 0)))
        return replace(self, changes=changes, stars=stars, coefficients=coefficients, numbers=numbers)

    def scaled(self, factor: float) -> CameraErrors:
        """The same with all errors times a factor."""
        names = ["changes", "stars", "coefficients"] + ["numbers"] * (self.numbers is not None)
        return replace(self, **{name: factor * getattr(self, name) for name in names})

    def of_stars(self, size: int) -> np.ndarray:
        """Responses (size, n_stars, r) of the first unknowns of the stars; zero where there are none."""
        rows = self.stars[:, :size].transpose(1, 0, 2)
        return np.pad(rows, ((0, size - len(rows)), (0, 0), (0, 0)))

    def of_coefficients(self, i: int) -> np.ndarray:
        """Covariance (2 n_modes, 2 n_modes) of the coefficients of exposure i, px^2."""
        return self.coefficients[i] @ self.coefficients[i].T

    def lost(self, camera: Camera, f: np.ndarray, detector: str | None = None) -> np.ndarray:
        """Which positions f (n, 2) of the focal plane are on a detector whose place nothing determines, bool (n,)."""
        out = np.zeros(len(f), dtype=bool)
        for key, chip in camera.detectors.items():
            if chip.layout_sigma is not None and np.isinf(chip.layout_sigma).any():
                out |= chip.sees(f) if detector is None else key == detector
        return out

    def of_measured(self, view: View, q: np.ndarray) -> np.ndarray:
        """Responses (n, 2, r) of what was measured in an exposure at undistorted pixels q (n, 2), pixels.

        In the focal plane, where there is one, on the detector of the view or else on that on which each falls; zero
        off all detectors.
        """
        return self._of_modes(view, q) - self._of_terms(view, q)

    def _of_terms(self, view, q):
        """How terms that are a part of the distortion displace what is at undistorted pixels q (n, 2), (n, 2, r)."""
        first, out = 0, np.zeros((len(q), 2, self.changes.shape[1]))
        for term in view.solution.diagnostics.terms:
            owners = dict.fromkeys(term.owners)
            for functions, owner in zip(term.bases, owners, strict=False):
                rows = slice(first, first + 2 * functions.n)
                if term.size and owner == view.detectors[0]:
                    numbers = self.numbers[rows].reshape(2, functions.n, -1)
                    out += np.einsum("anr->nar", functions(q) @ numbers)
                first = rows.stop
            first += 0 if term.bases else len(term.values)
        return out

    def _of_modes(self, view, q):
        """What `of_measured` gives, of the modes that were fitted."""
        if not len(self.changes):
            return np.zeros((len(q), 2, self.changes.shape[1]))
        changes = np.zeros((*self.free.shape, self.changes.shape[1]))
        changes[self.free] = self.changes
        if self.owner is not None:
            values = basis.values(basis.degree_of(changes.shape[2]), *basis.normalize(q, view.common.shape))
            return -np.einsum("amk,mn->nak", changes[self.owner[view.index]], values)
        f, out = view.common.distortion(q), np.zeros((len(q), 2, self.changes.shape[1]))
        for c, (key, chip) in enumerate(view.solution.camera.detectors.items()):
            here = chip.sees(f) if view.detector is None else np.full(len(f), key == view.detector)
            out[here] = moved_by(chip, similarity.apply(chip.layout, f[here]), changes[c])
        return out


def unit_errors(covariance):
    """Independent errors of unit size, (k, r), whose sum has a covariance (k, k)."""
    sizes, vectors = np.linalg.eigh(covariance)
    kept = sizes > _ROUNDING * sizes.max(initial=0)
    return vectors[:, kept] * np.sqrt(sizes[kept])
