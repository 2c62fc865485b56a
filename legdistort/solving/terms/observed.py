"""Observations as terms of the model and patterns of residuals need them: places, exposures, colours, directions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy import units as u

from ...geometry.distortion import Distortion
from ...geometry.epochs import ONE_EPOCH
from ...inputs import column_contract

_TURNED = 0.1  # rad: less is no turned camera


@dataclass(frozen=True, eq=False)
class Observed:
    """Observations, n of them, as displacements are made of them.

    Attributes
    ----------
    problem : Problem
        In whose order they come.
    state : State
    table : `~astropy.table.QTable`
        The rows behind the observations, with all columns that were given.
    times : ndarray, shape (n_exposures,)
        Of the exposures, days from the first one on, or their order.
    sky : `~legdistort.geometry.tangent_plane.TangentPlane` or None
        Where the reference plane lies.
    camera : `legdistort.Camera` or None
    stars : ndarray, shape (n_stars,)
        Their names.
    epoch : float or None
        Year of the positions of stars, where motions are fitted.
    beside : ndarray, shape (2, n)
        Of measured positions, what is an error or by the term that is asked, as far as it is known, pixels.
    """

    problem: object
    state: object
    table: object
    times: np.ndarray
    sky: object = None
    camera: object = None
    stars: object = ()
    epoch: float | None = None
    beside: np.ndarray | float = 0.0

    @cached_property
    def exposure(self):
        """Exposure of every observation, (n,) of int."""
        return self.problem.exposure

    @cached_property
    def years(self):
        """When the observations were made, a Julian year, (n,)."""
        return self.values("epoch", u.yr)

    @property
    def since_epoch(self):
        """Years since the epoch (n,), or since the mean of the observations, and the most of them, from a day on."""
        epoch = self.years.mean() if self.epoch is None else self.epoch
        return self.years - epoch, max(float(np.abs(self.years - epoch).max()), ONE_EPOCH)

    @cached_property
    def pixels(self):
        """Measured positions on the detectors, pixels, (2, n)."""
        names = ("x_detector", "y_detector") if "x_detector" in self.table.colnames else ("x", "y")
        return np.stack([np.asarray(self.table[name].value, dtype=float) for name in names])

    @cached_property
    def undistorted(self):
        """Undistorted pixels of the observations by the model, (n, 2): where distortions act."""
        return undistorted(self.problem, self.state)

    @cached_property
    def places_alone(self):
        """Positions on the detectors as they would be measured without errors and without the term, pixels, (2, n)."""
        return self.pixels - self._turned(np.broadcast_to(self.beside, self.pixels.shape), inverse=False)

    @cached_property
    def size(self):
        """Width and height of the detectors, pixels, (2, n)."""
        if "x_detector" in self.table.colnames:
            return np.ceil(self.pixels.max(axis=1, keepdims=True) + 1) * np.ones_like(self.pixels)
        return self.problem.size[self.exposure].T

    @cached_property
    def place(self):
        """Positions on the detectors from -1 to 1, (2, n)."""
        return np.clip((2 * self.pixels + 1) / self.size - 1, -1, 1)

    @cached_property
    def linear(self):
        """Linear parts of the poses without their scale, (n_exposures, 2, 2)."""
        linear = self.state.poses[:, :, :2]
        return linear / np.sqrt(np.abs(np.linalg.det(linear)))[:, None, None]

    @property
    def is_turned(self):
        """Whether the camera is turned between exposures."""
        return bool(np.any(np.abs(self.linear - self.linear[0]) > _TURNED))

    @cached_property
    def detector(self):
        """Number of the detector of every observation, from 0, where a camera has several; else None."""
        if "x_detector" not in self.table.colnames:
            return None
        found, number = np.unique(np.asarray(self.table["detector"]), return_inverse=True)
        return number if len(found) > 1 else None

    @cached_property
    def faintness(self):
        """Magnitudes about their mean over their scatter, (n,), of fluxes or else of the errors; None if all alike."""
        if "flux" in self.table.colnames:
            flux = np.asarray(self.table["flux"], dtype=float)
            return _standard(-np.log(np.where(flux > 0, flux, np.nan)))
        return _standard(np.log(np.hypot(self.table["x_err"].value, self.table["y_err"].value)))

    @cached_property
    def colour(self):
        """Colours of the stars about their mean over their scatter, (n,); None if the table has none."""
        name = column_contract.colour_column(self.table)
        return None if name is None else _standard(self.values(name))

    @cached_property
    def colour_departure(self):
        """Colours of the stars about their mean, (n,), in the unit of the column; 0 where it has none."""
        values = self.values(column_contract.colour_column(self.table))
        return np.nan_to_num(values - np.nanmean(values))

    def values(self, name, unit=None):
        """A column of numbers, in a unit, (n,)."""
        return column_contract.values(self.table, name, unit)

    def on_detector(self, plane):
        """Displacements (2, n) of the reference plane as they are measured: on the detector, or in the focal plane."""
        return np.einsum("nab,bn->an", self._slope, plane)

    @cached_property
    def _slope(self):
        """Derivatives (n, 2, 2) of what is measured by the place in the reference plane."""
        problem, state = self.problem, self.state
        bent = [
            Distortion(own, shape).jacobian(problem.xy[:, problem.part(i)].T)
            for i, (own, shape) in enumerate(zip(state.coefficients, problem.shapes, strict=True))
        ]
        return np.concatenate(bent) @ state.poses[self.exposure][:, :, :2]

    def from_detector(self, displacements):
        """Displacements (..., 2, n) along the axes of the detectors as positions have them: in the focal plane."""
        return self._turned(displacements, inverse=True)

    def _turned(self, displacements, *, inverse):
        """Displacements (..., 2, n) in the focal plane along the axes of the detectors, or the `inverse`."""
        if "x_detector" not in self.table.colnames:
            return displacements
        ids, turned = self.camera.ids(self.table), np.array(displacements)
        for key, chip in self.camera.detectors.items():
            here, linear = ids == key, chip.layout[:, :2]
            turn = np.linalg.inv(linear) if inverse else linear
            turned[..., here] = np.einsum("ab,...bn->...an", turn, turned[..., here])
        return turned


def undistorted(problem, state):
    """Undistorted pixels (n, 2) of the observations of a problem, by its model at a state."""
    x, y = problem.placed(state.stars)[:2]
    return np.einsum("nab,bn->na", state.poses[problem.exposure], np.stack([x, y, np.ones_like(x)]))


def _standard(values):
    """Values about their mean in units of their scatter, 0 where there is none; None if they do not differ."""
    known = np.isfinite(values)
    if np.count_nonzero(known) < 2 or np.ptp(values[known]) < 1e-6:
        return None
    return np.where(known, (values - values[known].mean()) / values[known].std(), 0.0)
