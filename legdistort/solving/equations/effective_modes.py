"""How many modes the data determine, and how many a prior determines in their place."""

from dataclasses import replace

import numpy as np

from ...geometry.detector_modes import dynamic_basis
from . import criterion


def done_by_prior(problem, uncertainty):
    """Number of modes of every exposure that its prior determines in place of the data, shape (n_exposures,).

    The trace of the prior's precision times the covariance of the coefficients.

    Parameters
    ----------
    problem : Problem
    uncertainty : Uncertainty
    """
    if not problem.has_prior and problem.pose_width is None:
        return np.zeros(problem.n_exposures)
    blocks = [uncertainty.of_exposure(i, problem.n_exposures) for i in range(problem.n_exposures)]
    out = np.array([np.sum(criterion.prior_precision(problem, i) * block) for i, block in enumerate(blocks)])
    if problem.pose_width is not None:
        poses = zip(criterion.pose_precision(problem), blocks, strict=True)
        out += [np.sum(precision * block) for precision, block in poses]
    return out


def effective_modes(problem, gauge, uncertainty):
    """Number of modes of its own, both axes, that the data determine in every exposure, shape (n_exposures,).

    Of all it has, those that its prior determines, holds fixed, and those that the convention of the gauge fixes are
    counted out, each exposure's part of the latter.

    Parameters
    ----------
    problem : Problem
    gauge : Gauge
    uncertainty : Uncertainty
        In this gauge.
    """
    if problem.degree == 0:  # the poses still fit rotation and scale
        return np.full(problem.n_exposures, 4 * (1 - 1 / problem.n_exposures))
    rows = criterion.complement(gauge.measured.T) @ gauge.orthonormal
    shares = (rows.reshape(len(rows), problem.n_exposures, -1) ** 2).sum(axis=(0, 2))
    fixed = 0 if problem.fixed is None else np.array([len(each) for each in problem.fixed])
    of_exposures = replace(problem, static_covariance=None)
    return problem.unknowns.n_own - shares - fixed - done_by_prior(of_exposures, uncertainty)


def departure_ratio(problem, gauge, blocks, uncertainty):
    """Rms departure of the exposures from the prior mean, in its widths, against what the widths lead to expect.

    At the solution the departures of modes that the data determine should be as large as the widths, and those of the
    others nil: the squares sum to the number of modes that the data determine (MacKay 1992).

    Returns
    -------
    float or None
        1 if the widths are right, more if they are too narrow or the mean is wrong, less if they are too wide. None
        without widths, or where exposures share modes.
    """
    held = [i for i in range(problem.n_exposures) if problem.has_widths(i)]
    if not held or problem.unknowns.shared:
        return None
    rows = gauge.orthonormal.reshape(gauge.n_constraints, problem.n_exposures, -1)
    done, number = done_by_prior(replace(problem, pose_width=None), uncertainty), 0.0
    for i in held:
        own = dynamic_basis(problem.shapes[i], problem.n_modes)
        own = own[np.any((own != 0) & (problem.prior_sigma[i].ravel() > 0), axis=1)]
        number += len(own) - np.sum((rows[:, i] @ own.T) ** 2) - done[i]
    return float(np.sqrt(blocks.penalty / number)) if number > 0.5 else None
