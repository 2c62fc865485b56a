"""What nights say of the layouts and static distortions of all detectors of a camera, as changes of one camera."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from astropy.table import vstack

from ...cameras import places
from ...cameras.camera import Camera
from ...cameras.detector import Detector
from ...cameras.stated_errors import UNKNOWN, with_errors
from ...exceptions import InputError
from ...geometry import basis, detector_modes, similarity
from ...priors.mode_tables import mode_table
from ...results.errors.common_distortion import NOTHING
from ...runtime.notebook import Fact
from ...solving.camera_fit import change_weights, changed, exchanged_maps, held_changes

#: Variance [pix^2] of a direction in which a solution was held rather than determined: no error is so small.
_HELD = 1e-10
_ROUNDS = 5
_SAME = 1e-9  # modes beyond a degree that are none [pix]


@dataclass(frozen=True, eq=False)
class DetectorModes:
    """Modes of one detector that are no similarity, in the order of `legdistort.geometry.detector_modes.dynamic_basis`.

    Attributes
    ----------
    shape : tuple
    n : int
        Number of modes, per axis, with the similarities.
    """

    shape: tuple
    n: int
    lowest = 1
    n_detectors = 1

    @cached_property
    def rows(self):
        """Orthonormal rows (K, 2 n) of the coefficients."""
        return detector_modes.dynamic_basis(self.shape, self.n)

    @property
    def size(self):
        """Number K of modes."""
        return len(self.rows)

    @property
    def labels(self):
        """Numbers (K,), from 1, of what scatters alike: degrees."""
        return detector_modes.dynamic_degrees(self.n)

    @property
    def told(self):
        """Rows (m, K) of what nights can determine: everything."""
        return np.eye(self.size)

    def seen(self, night):
        """Map (K,) from which a night counts, and what it says from there: information and pull."""
        return self.rows @ night.around.ravel(), night.information, night.pull

    def coefficients(self, mean, covariance):
        """Coefficients (2, n) and their covariance (2 n, 2 n)."""
        return (self.rows.T @ mean).reshape(2, -1), self.rows.T @ covariance @ self.rows


@dataclass(frozen=True, eq=False)
class CameraChanges:
    """Changes of the modes of all detectors of a camera, of orders 0 and 1 the layout, one detector after the other.

    Attributes
    ----------
    camera : Camera
        From which they count.
    n : int
        Number of modes, per axis.
    """

    camera: Camera
    n: int
    lowest = 0

    @property
    def n_detectors(self):
        """Number of detectors."""
        return len(self.camera.detectors)

    @cached_property
    def free(self):
        """All modes, bool (n_detectors, 2, n)."""
        return np.ones((self.n_detectors, 2, self.n), dtype=bool)

    @property
    def size(self):
        """Number K of all modes."""
        return self.free.size

    @cached_property
    def labels(self):
        """Numbers (K,), from 1, of what scatters alike: one more than degrees."""
        return np.broadcast_to(1 + np.add(*basis.orders(basis.degree_of(self.n))), self.free.shape).ravel()

    @cached_property
    def _exchanged(self):
        """Maps of the focal plane (2 n, K) that exposures can take over."""
        return exchanged_maps(self.camera, self.free)

    @cached_property
    def _weights(self):
        return change_weights(self.free, stated=False)

    @cached_property
    def _fixed(self):
        """What takes maps of the focal plane off changes, as a solution does, (K, K)."""
        return held_changes(self._exchanged, self._weights, np.zeros((0, self.free.size)))

    @cached_property
    def told(self):
        """Orthonormal rows (K - 2 n, K) of what nights can determine: no map of the focal plane."""
        return np.linalg.qr(self._exchanged.T, mode="complete")[0][:, 2 * self.n :].T

    def seen(self, night):
        """Changes (K,) that lead to the camera of a night, and what it says from there: information and pull."""
        across = self.told.T @ self.told
        return self._to(night.camera), across @ night.information @ across, across @ night.pull

    def _to(self, camera):
        """Changes (K,) that lead to another camera, but for a map of the focal plane."""
        reference = self.camera.detectors
        detectors = _aligned(camera.detectors, reference)
        weighted = self._weights[:, None] * self._exchanged.T
        for _ in range(_ROUNDS):
            change = _change(reference, detectors, self.n)
            bend = np.linalg.lstsq(weighted, self._weights * change, rcond=None)[0].reshape(2, self.n)
            detectors = _bent(detectors, -bend, self.camera.field)
        return self._fixed @ _change(reference, detectors, self.n)

    def coefficients(self, mean, covariance):
        """Changes (n_detectors, 2, n) and their covariance (K, K), without maps of the focal plane."""
        return (self._fixed @ mean).reshape(self.free.shape), self._fixed @ covariance @ self._fixed.T

    def changed(self, name, mean, covariance):
        """The camera after changes (n_detectors, 2, n) with their covariance (K, K), infinite where it is not known."""
        sizes, directions = np.linalg.eigh(covariance)
        unknown = sizes > UNKNOWN**2
        known = np.maximum(sizes[~unknown], 0)  # maps of the focal plane have none but for rounding
        covariance = (directions[:, ~unknown] * known) @ directions[:, ~unknown].T
        size = np.sqrt(np.mean(directions[:, unknown] ** 2, axis=0))
        camera = with_errors(changed(self.camera, mean), self.free, covariance, (directions[:, unknown] / size).T)
        detectors = {}
        for k, (key, each) in enumerate(camera.detectors.items()):
            own = slice(2 * self.n * k, 2 * self.n * (k + 1))
            known, lost = covariance[own, own].copy(), np.isinf(each.static_sigma).ravel()
            low = np.tile(np.arange(self.n) < 3, 2)
            known[low] = known[:, low] = known[lost] = known[:, lost] = 0.0
            known[lost, lost] = np.inf
            detectors[key] = replace(each, static_sigma=None, static_covariance=known)
        unknown = np.full((2, self.n), np.inf)  # what all detectors share
        header_map = None if camera.common_map is not None else camera.header_map
        return replace(
            camera, name=name, detectors=detectors, common_sigma=unknown, common_map=None, header_map=header_map,
            header_errors=None, place_errors=None,
        )  # fmt: skip

    def table(self, camera, scatter):
        """One row a detector, mode and axis of degree 2 and more, of a camera; `scatter` (K,) is that of nights."""
        parts = []
        for k, (key, each) in enumerate(camera.detectors.items()):
            error = np.where(np.isinf(each.static_sigma), np.nan, each.static_sigma)
            own = np.asarray(scatter).reshape(self.free.shape)[k]
            part = mode_table(coefficient=each.static, error=error, night_scatter=own)
            part.add_column(np.full(len(part), key), name="detector", index=0)
            parts.append(part[part["x_degree"] + part["y_degree"] > 1])
        return vstack(parts)


def modes_of(nights, shape):
    """The `DetectorModes` or `CameraChanges` of nights, of the camera of the first."""
    n = basis.n_modes(nights[0].degree)
    return DetectorModes(shape, n) if nights[0].camera is None else CameraChanges(nights[0].camera, n)


def common_maps_in_lines(camera, degree):
    """What the errors of a layout of several nights leave out, in lines below its table."""
    words = (
        f"{places.relative_in_words(degree)} (not determined); what a reference told of that map in a night is no part "
        "of this camera, but of that which the solution of the night has"
    )
    bend = places.bend_in_words(camera, degree)
    return Fact("", f"{words}; {bend}" if bend else words).lines()


def shown_of_camera(solution, label):
    """What the exposures of a solution show of the changes of its camera: information (K, K), pixels^-2.

    Maps of the focal plane that detectors and exposures share have no information, nor has what is held.
    """
    errors, camera = solution.estimate.uncertainty.camera, solution.camera
    n = basis.n_modes(solution.degree)
    if any(np.any(np.abs(each.static[:, n:]) > _SAME) for each in camera.detectors.values()):
        raise InputError(
            f"{label} has static distortions beyond degree {solution.degree}, which were given and not found: solve it "
            "to a higher degree (--degree), or with a camera that does not state them"
        )
    modes, free = CameraChanges(camera, n), errors.free[:, :, :n]
    changes = np.zeros((*free.shape, errors.changes.shape[1]))
    changes[free] = errors.changes
    changes = changes.reshape(free.size, -1)
    unknown = ~free
    for k, each in enumerate(camera.detectors.values()):
        for part, sigma in ((slice(0, 3), each.layout_sigma), (slice(3, n), each.static_sigma)):
            unknown[k, :, part] |= sigma is not None and np.isinf(sigma[:, part])
    covariance = modes.told @ (changes @ changes.T + NOTHING**2 * np.diag(unknown.ravel())) @ modes.told.T
    sizes, directions = np.linalg.eigh(covariance)
    known = directions[:, sizes > _HELD].T @ modes.told
    return known.T / sizes[sizes > _HELD] @ known


def _aligned(detectors, reference):
    """Detectors ``{id: Detector}`` in a focal plane that is moved by a similarity to that of the reference."""
    here, there = [], []
    for key, each in reference.items():
        corners = detector_modes.detector_corners([each.shape])[0]
        here.append(similarity.apply(similarity.invert(each.layout), corners))
        there.append(similarity.apply(similarity.invert(detectors[key].layout), corners))
    moved = similarity.fit_similarity(np.concatenate(here), np.concatenate(there))
    return {key: replace(detectors[key], layout=similarity.compose(detectors[key].layout, moved)) for key in reference}


def _bent(detectors, bend, field):
    """Detectors that see what lies at f + bend(f) in a focal plane, modes (2, n) of its size, at f."""
    out, degree = {}, basis.degree_of(bend.shape[1])
    for key, each in detectors.items():
        back = similarity.invert(each.layout)

        def moved(u, v, each=each, back=back):
            q = basis.denormalize(u, v, each.shape)
            f = similarity.apply(back, q)
            there = f + (bend @ basis.values(degree, *basis.normalize(f, field))).T
            return (each.to_pixels(there) - q).T

        out[key] = Detector(each.shape, layout=each.layout, static=basis.project(moved, degree)).placed()
    return out


def _change(reference, detectors, n):
    """Changes (K,) that lead from detectors to others, as `legdistort.solving.camera_fit.changed` makes them."""
    out, degree = np.zeros((len(reference), 2, n)), basis.degree_of(n)
    for k, (key, each) in enumerate(reference.items()):
        low = similarity.compose(detectors[key].layout, similarity.invert(each.layout))

        def moved(u, v, each=each, low=low):
            q = basis.denormalize(u, v, each.shape)
            return (similarity.apply(low, q) - q).T

        out[k] = basis.change_degree(detectors[key].static, degree) - basis.change_degree(each.static, degree)
        out[k, :, :3] = basis.project(moved, 1)
    return out.ravel()
