"""The common map where poses are known with their errors.

Poses that are known are a factor of J, and so the plane is no longer free: a common map that all exposures compensate
would change their poses, by a shift, a rotation and a scale that depend on where an exposure lies. J then determines
the values v of the constraints (`Reduced.resistance`), shift, rotation and scale of the plane among them. What the
scatter of single exposures says of the common map (`legdistort.solving.gauge.hierarchy`), ``v = 0`` with the covariance
W that follows from that of the map, is independent of it: the constraints are held at the minimum of both, and the
error of the map is that of both. The same holds where J knows stars, not poses.
"""

from dataclasses import replace

import numpy as np

from ..equations import criterion, effective_modes
from ..equations.criterion import complement

#: Departures of poses from those known are said from so many standard deviations of their squares on.
_ODD = 5.0
_SMALLEST = 1e-6  # scatter, pixels: at a start there may be none


def balanced(system, gauge, violation):
    """By how much to change the values (n_constraints,) of the constraints, which are now off by a violation."""
    prior, (information, pull) = _of_scatter(gauge), system.resistance()
    return np.linalg.solve(information + prior, pull - prior @ violation)


def determined(system, gauge, violation):
    """The `Gauge` with constraints held where they are, and the common map with its shift, rotation and scale.

    Parameters
    ----------
    system : Reduced
        Where `balanced` finds nothing to change.
    gauge : Gauge
        As the scatter of exposures has it.
    violation : ndarray, shape (n_constraints,)
    """
    back = np.linalg.pinv(gauge.reach)
    covariance = back @ np.linalg.inv(system.resistance()[0] + _of_scatter(gauge)) @ back.T
    covariance = (covariance + covariance.T) / 2
    return replace(gauge, values=violation, covariance=covariance, unknown_maps=(), poses_known=True)


def _of_scatter(gauge):
    """What the scatter of single exposures says of the values of the constraints, W^-1 (n_constraints,) squared.

    Nothing of shift, rotation and scale, and of maps that are unknown without J.
    """
    similar = gauge.plane_modes().similar.T
    free = gauge.reach @ np.column_stack([similar, *(each.map for each in gauge.unknown_maps)])
    known = complement(np.linalg.qr(free)[0].T)
    spread = known @ gauge.reach
    return known.T @ np.linalg.solve(spread @ gauge.covariance @ spread.T + _SMALLEST**2 * np.eye(len(known)), known)


def contradiction(problem, state, uncertainty, fields=None):
    """In a sentence, that poses depart by much more from those given than their errors lead to expect; empty if not.

    What terms displace is taken off the positions as it was found, and poses follow its errors: those of numbers by
    `uncertainty`, those of random fields by ``{exposure: CovarianceTable}``, as large as they can be, which is if the
    error of a field is of the kind of a pose alone.
    """
    if problem.pose_width is None:
        return ""
    squares = ((problem.pose_departure(state)[0] / problem.pose_width) ** 2).sum(axis=1)
    plain = replace(problem, prior_sigma=None, static_covariance=None)
    expected = squares.size * 4 - effective_modes.done_by_prior(plain, uncertainty).sum()
    if uncertainty.camera is not None:
        precision = criterion.pose_precision(problem)
        by_terms = [np.sum(each * uncertainty.camera.of_coefficients(i)) for i, each in enumerate(precision)]
        expected += np.sum(by_terms)
    for i, name in enumerate(problem.names):
        if name in (fields or {}):
            x, y = fields[name].values[:2].mean(axis=(1, 2))
            most = 4 * np.array([x, y, (x + y) / 2, (x + y) / 2])  # a mode has mean square 1/4
            expected += np.sum(most / problem.pose_width[i] ** 2)
    if squares.sum() < expected * (1 + _ODD * np.sqrt(2 / (4 * squares.size))):
        return ""
    return (
        f"poses depart from those given by {np.sqrt(squares.sum() / expected):.2g} times as much as pose_sigma leads "
        f"to expect, most in exposure {problem.names[np.argmax(squares)]}: state larger errors (pose_sigma, "
        "--pose-sigma), correct the poses, or take them as start values"
    )
