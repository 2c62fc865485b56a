"""What the errors of the static distortion beyond the degree do to stars, coefficients and new positions.

Where exposures show terms beyond the degree that they have in common, these take part in the fit as known
(`legdistort.solving.gauge.most_probable`). The errors of the stars with them held, and those by which stars follow the
errors of these terms, add up.
"""

import numpy as np

from ...results.errors.camera_errors import CameraErrors, unit_errors
from ..equations import criterion
from ..equations.common_parts import followed, relative_responses


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
    n, owner = problem.n_modes, problem.detectors
    values = criterion.predict(problem, result.state)[1][n:]
    n_all = n + len(values)
    detector, axis, mode = np.unravel_index(np.arange(len(covariance)), (owner.max() + 1, 2, len(values)))
    patterns = np.zeros((2, values.shape[1], len(covariance)))
    of = np.where(owner[problem.exposure][:, None] == detector, -values[mode].T, 0.0)
    patterns[axis, :, np.arange(len(covariance))] = of.T
    follow = followed(uncertainty.system.settle, problem, result.blocks, patterns)
    changes = unit_errors(covariance)
    free = np.zeros((owner.max() + 1, 2, n_all), dtype=bool)
    free[:, :, n:] = True
    moved = relative_responses(follow, changes, result, uncertainty.star_weights, problem.degree)
    errors = CameraErrors(free, changes, *moved, owner=owner)
    return errors, float(np.sum(covariance * follow.normal))
