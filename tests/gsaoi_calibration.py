"""A camera found from its own dithers, with layouts and static distortions wrong to begin with, draw by draw."""

from dataclasses import dataclass

import gsaoi_bounds
import gsaoi_images
import numpy as np

import legdistort
from legdistort.cameras.camera import GSAOI_SCALE

SIGMA, DEGREE, DYNAMIC = 0.01, 3, 0.4


def wrong(camera, *, shift=3.0, turn=0.02, bend=0.1, seed=0):
    """The camera with detectors that lie wrong by up to so many pixels and degrees, `bend` px in every static mode."""
    rng, detectors = np.random.default_rng(seed), {}
    for key, each in camera.detectors.items():
        static = each.static.copy()
        static[:, 3:10] += rng.normal(0, bend, (2, 7))
        angle, middle = np.radians(turn) * rng.uniform(-1, 1), (np.array(each.shape[::-1]) - 1) / 2
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        moved = rotation @ (each.layout[:, 2] - middle) + middle + rng.uniform(-shift, shift, 2)
        layout = np.column_stack([rotation @ each.layout[:, :2], moved])
        detectors[key] = legdistort.Detector(each.shape, layout=layout, static=static)
    return legdistort.Camera(camera.name, detectors)


def night(turn):
    """Twelve exposures dithered by up to 12 arcsec, a seventh of the field, turned by `turn` radians rms."""
    return gsaoi_images.Night(n_exposures=12, n_stars=300, dither=12.0, turn=turn, dynamic=DYNAMIC)


@dataclass
class Calibration:
    """Errors of stars, layouts and statics, rms per axis in pixels, beside their bounds, and squared pulls.

    Attributes
    ----------
    errors, bounds, pulls : ndarray, shape (3,)
    solution : Solution
        The last one.
    everything : gsaoi_bounds.Everything
    """

    errors: np.ndarray
    bounds: np.ndarray
    pulls: np.ndarray
    solution: object
    everything: object


def calibrate(turn, draws):
    """The `Calibration` of so many draws of noise.

    The pulls of layouts and statics are those of their scatter from draw to draw: what detectors and exposures can
    exchange stays the same.
    """
    field, camera = night(turn), wrong(legdistort.Camera.gsaoi())
    everything = gsaoi_bounds.Everything(field, field.table(sigma=SIGMA), degree=DEGREE, sigma=SIGMA)
    covariance = everything.solved()[0]
    bounds = np.array([everything.star_bound(covariance), *everything.detector_bounds(covariance)]) / GSAOI_SCALE
    errors, pulls, found = [], [], []
    for seed in range(draws):
        matches = legdistort.Matches.from_table(field.table(sigma=SIGMA, seed=1000 + seed), camera=camera)
        solution = legdistort.solve(matches, degree=DEGREE, layout="fit", static="fit")
        left = gsaoi_images.without_common_map(
            solution.estimate.positions, field.sky[solution.estimate.star_names], DEGREE
        )
        parts = [p / GSAOI_SCALE for p in gsaoi_bounds.camera_error(solution.camera, DEGREE, GSAOI_SCALE)]
        errors.append([np.mean(left**2), *(np.mean(part**2) for part in parts)])
        reported = np.stack([solution.stars[name].value for name in ("x_err", "y_err")], axis=1)
        free = len(left) / (len(left) - 10)  # of the map that was fitted just now
        pulls.append(free * np.mean((left / reported) ** 2))
        each = list(solution.camera.detectors.values())
        places = [(d.place.x, d.place.y, d.place.rotation) for d in each]
        found.append((places, [d.place.errors for d in each],
                      [d.static[:, 3:10] for d in each], [d.static_sigma[:, 3:10] for d in each]))  # fmt: skip
    places, place_errors, statics, static_errors = (np.array(each) for each in zip(*found, strict=True))
    scatter = [
        np.mean(np.var(value, axis=0, ddof=1) / np.mean(error**2, axis=0))
        for value, error in ((places, place_errors), (statics, static_errors))
    ]
    return Calibration(
        np.sqrt(np.mean(errors, axis=0)), bounds, np.array([np.mean(pulls), *scatter]), solution, everything
    )
