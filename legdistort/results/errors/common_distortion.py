"""The distortion of the focal plane that all exposures of a camera have in common, as a reference determines it."""

from dataclasses import replace

import numpy as np

from ...cameras.places import relative_errors, shifts_and_turns
from ...cameras.stated_errors import UNKNOWN
from ...geometry import basis, detector_modes
from ..nights import blocks
from . import absolute_errors
from .coefficient_covariance import exposure_blocks, mean_covariance

#: Error [pix] of a coefficient of which nothing is known.
NOTHING = 1e4


def common_distortion(solution, n):
    """What exposures and a reference tell of a common map of the focal plane, in n modes per axis.

    Nothing without a reference: where detectors share a map, exposures can take it over; and nothing of one exposure,
    whose own departure it would be. What exposures scatter about it is in the errors (`scatter_of_mean`).

    Returns
    -------
    mean : ndarray, shape (2 n,)
    covariance : ndarray, shape (2 n, 2 n)
    shared : ndarray, shape (2 n, r)
        Responses to the errors of the camera.
    """
    gauge, uncertainty = solution.gauge, solution.estimate.uncertainty
    size = basis.n_modes(solution.degree)
    camera = uncertainty.camera
    shared = np.zeros((2 * size, 0)) if camera is None else camera.coefficients.mean(axis=0)
    scattered = scatter_of_mean(solution)
    if gauge.tie is None or scattered is None:
        return np.zeros(2 * n), NOTHING**2 * np.eye(2 * n), np.zeros((2 * n, shared.shape[1]))
    moved = absolute_errors.known_changes(gauge, size).mean(axis=0)
    unknown = NOTHING * absolute_errors.unknown_changes(gauge, size).mean(axis=1)
    covariance = mean_covariance(uncertainty.coefficients, len(solution.names)) + unknown.T @ unknown
    covariance += moved @ absolute_errors.known_covariance(gauge) @ moved.T + sum(part for part, _ in scattered)
    rows = np.kron(np.eye(2), np.eye(n, size))
    mean = np.zeros((2, n))  # beyond that degree what was given
    mean[:, : solution.coefficients.shape[2]] = solution.coefficients[:, :, :n].mean(axis=0)
    return mean.ravel(), rows @ covariance @ rows.T, rows @ shared


def scatter_of_mean(solution):
    """What the mean coefficients of exposures are off by their scatter, by degree: covariances and degrees of freedom.

    From the scatter of exposures, or of nights if there are several, beyond their errors, that of all modes of a degree
    alike; a similarity, which poses take up, is none.

    Returns
    -------
    list of (ndarray, shape (2 n_modes, 2 n_modes), float), or None
        None of one exposure.
    """
    n_exposures, n = len(solution.names), basis.n_modes(solution.degree)
    night = blocks(solution)[0]
    owner = night if night.max() else np.arange(n_exposures)
    counts = np.bincount(owner)
    if len(counts) < 2:
        return None
    rows, coefficients = detector_modes.dynamic_basis(solution.camera.field, n), solution.coefficients[:, :, :n]
    means = np.stack([coefficients[owner == k].mean(axis=0).ravel() for k in range(len(counts))]) @ rows.T
    away = means - counts @ means / n_exposures
    whole = len(counts) / (len(counts) - 1) * (counts**2 @ away**2) / n_exposures**2
    noise = np.zeros(len(rows))
    if len(counts) == n_exposures:
        errors = solution.estimate.uncertainty.coefficients
        alone = exposure_blocks(errors, n_exposures).mean(axis=0) / n_exposures
        apart = (alone - mean_covariance(errors, n_exposures) / n_exposures) * n_exposures / (n_exposures - 1)
        noise = np.einsum("ka,ab,kb->k", rows, apart, rows)
    degrees, out = detector_modes.dynamic_degrees(n), []
    for degree in range(1, degrees.max(initial=0) + 1):
        mine = degrees == degree
        size = max(np.mean(whole[mine]) - np.mean(noise[mine]), 0.0)
        share = size / max(np.mean(whole[mine]), 1e-300)
        out.append((size * rows[mine].T @ rows[mine], np.count_nonzero(mine) * (len(counts) - 1) * share**2))
    return out


def with_common_map(camera, solution):
    """The camera of a solution that a reference ties, with its `common_map` and the errors of that.

    What exposures scatter about it is in the errors, so that one exposure tells nothing of it; a similarity, which
    poses take up, is not. Other solutions have none: the camera is as it was.
    """
    n = solution.coefficients.shape[2]
    if solution.gauge.tie is None or solution.gauge.n_fields > 1 or not camera.has_focal_plane:
        return camera
    mean, covariance, shared = common_distortion(solution, n)
    rows = detector_modes.dynamic_basis(camera.field, n)
    covariance = rows @ covariance @ rows.T
    sigma = np.sqrt(np.diag(covariance))
    sigma = np.where(sigma < UNKNOWN, sigma, np.inf)
    widths = np.max(np.where(rows != 0, sigma[:, None], 0), axis=0, initial=0).reshape(2, n)
    fitted = basis.n_modes(solution.degree)
    if camera.common_sigma is not None:
        widths[:, fitted:] = basis.change_degree(camera.common_sigma, basis.degree_of(n))[:, fitted:]
    known = {"common_map": np.where(np.isinf(widths), 0, mean.reshape(2, n)), "common_sigma": widths}
    there = np.isfinite(sigma)
    errors = _errors_of_places(solution, rows[there], covariance[np.ix_(there, there)], shared)
    return replace(camera, **known, place_errors=errors)


def _errors_of_places(solution, rows, covariance, shared):
    """Errors (n_detectors, 3) of places with a common map; None where layouts were not found.

    Parameters
    ----------
    solution : Solution
    rows : ndarray, shape (k, 2 n)
        What is known of the map.
    covariance : ndarray, shape (k, k)
        Of that, a camera taken as known.
    shared : ndarray, shape (2 n, r)
        Responses of the map to the errors of the camera, which layouts have too.
    """
    errors, camera = solution.estimate.uncertainty.camera, solution.camera
    if errors is None or not errors.free[:, :, :3].any():
        return None
    bent = shifts_and_turns(camera, rows.shape[1] // 2) @ rows.T
    own = np.zeros((*errors.free.shape, errors.changes.shape[1]))
    own[errors.free] = errors.changes
    moved = own[:, :, :3].reshape(len(bent), -1) + bent @ rows @ shared
    return relative_errors(camera, moved @ moved.T + bent @ covariance @ bent.T)
