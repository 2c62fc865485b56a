"""What the errors of the static distortion beyond the degree do to stars, coefficients and new positions.

Where exposures show terms beyond the degree that they have in common, these take part in the fit as known
(`legdistort.solving.gauge.most_probable`). The errors of the stars with them held, and those by which stars follow the
errors of these terms, add up.
"""

import numpy as np

from ...results.errors.camera_errors import CameraErrors, unit_errors
from ...results.errors.common_maps import fitted, plain_maps
from ...results.new_positions import widened_all
from ..equations import criterion
from ..equations.common_parts import followed


def higher_errors(problem, result, uncertainty, covariance):
    """The `CameraErrors` of the terms beyond the degree of a problem, and how many of these the data determine.

    Parameters
    ----------
    problem : Problem
        With these terms in its prior mean and the weights in force.
    result : Result
    uncertainty : Uncertainty
        Of the result with these terms held.
    covariance : ndarray, shape (n_detectors * k, n_detectors * k)
        Of the k terms of every detector, those along x first.
    """
    n, owner, blocks, gauge = problem.n_modes, problem.detectors, result.blocks, result.gauge
    values = criterion.predict(problem, result.state)[1][n:]
    n_all = n + len(values)
    detector, axis, mode = np.unravel_index(np.arange(len(covariance)), (owner.max() + 1, 2, len(values)))
    patterns = np.zeros((2, values.shape[1], len(covariance)))
    of = np.where(owner[problem.exposure][:, None] == detector, -values[mode].T, 0.0)
    patterns[axis, :, np.arange(len(covariance))] = of.T
    follow = followed(uncertainty.system.settle, problem, blocks, patterns)
    changes = unit_errors(covariance)
    free = np.zeros((owner.max() + 1, 2, n_all), dtype=bool)
    free[:, :, n:] = True
    stars = (follow.stars @ changes).transpose(1, 0, 2)
    positions = result.state.positions.T
    maps = plain_maps(gauge, positions, gauge.n_modes)[:, :2]
    common = fitted(maps, uncertainty.star_weights[:, :2, :2], stars)
    coefficients = follow.coefficients @ changes + widened_all(gauge.motion, problem.degree) @ common
    errors = CameraErrors(free, changes, stars - maps @ common, coefficients, owner=owner)
    return errors, float(np.sum(covariance * follow.normal))
