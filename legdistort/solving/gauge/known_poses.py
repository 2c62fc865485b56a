"""The common map where poses are known with their errors.

Poses that are known are a factor of J, and so the plane is no longer free: a common map that all exposures compensate
would change their poses, by a shift, a rotation and a scale that depend on where an exposure lies. J then determines
the values v of the constraints (`Reduced.resistance`), shift, rotation and scale of the plane among them. What the
scatter of single exposures says of the common map (`legdistort.solving.gauge.hierarchy`), ``v = 0`` with the covariance
W that follows from that of the map, is independent of it: the constraints are held at the minimum of both, and the
error of the map is that of both. The same holds where J knows stars, not poses; and for the maps that change with time
where it knows how the motions of stars scatter.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ..equations import criterion, effective_modes
from ..equations.criterion import complement

#: Departures of poses from those known are said from so many standard deviations of their squares on.
_ODD = 5.0
_SMALLEST = 1e-5  # scatter, pixels: at a start there may be none


def balanced(system, gauge, violation, *, plane):
    """By how much to change the values (n_constraints,) of the constraints, which are now off by a violation.

    The `plane` is where J knows it, or else where the convention has it; maps that change with time are between both.
    """
    prior, (information, pull) = _of_scatter(gauge, plane), system.resistance()
    return np.linalg.solve(information + prior + _of_pointing(gauge, plane), pull - prior @ violation)


def determined(system, gauge, violation, *, plane):
    """The `Gauge` with constraints held where they are, and the maps that J knows, of the `plane` too or drifts alone.

    Parameters
    ----------
    system : Reduced
        Where `balanced` finds nothing to change.
    gauge : Gauge
        As the scatter of exposures has it.
    violation : ndarray, shape (n_constraints,)
    plane : bool
        Whether J knows where the plane is.
    """
    n, back = 2 * gauge.n_modes, np.linalg.pinv(_reach(gauge))
    information = system.resistance()[0] + _of_scatter(gauge, plane) + _of_pointing(gauge, plane)
    covariance = back @ np.linalg.inv(information) @ back.T
    covariance = (covariance + covariance.T) / 2
    if plane:
        gauge = replace(gauge, covariance=covariance[:n, :n], unknown_maps=(), poses_known=True)
    if len(covariance) > n:
        maps = gauge.drift.maps.T @ gauge.drift.maps
        known = {"covariance": maps @ covariance[n:, n:] @ maps, "held": system.problem.terms.is_held}
        gauge = replace(gauge, drift=replace(gauge.drift, **known))
    return replace(gauge, values=violation)


def _reach(gauge):
    """How maps, those that change with time too, change the constraints, (n_constraints, 2 n_modes + q)."""
    return gauge.orthonormal @ gauge.all_motion.reshape(gauge.orthonormal.shape[1], -1)


def _of_scatter(gauge, plane):
    """What the scatter of single exposures says of the values of the constraints, W^-1 (n_constraints,) squared.

    Nothing of shift, rotation and scale, and their rates, and, where J knows the plane, of maps that are unknown
    without it. Where J does not know the plane, this is exactly where the convention has it.
    """
    reach, drift, n = _reach(gauge), gauge.drift, 2 * gauge.n_modes
    maps, covariance = [gauge.plane_modes().similar.T], np.zeros((n, n))
    if plane:
        maps, covariance = maps + [each.map[:, None] for each in gauge.unknown_maps], gauge.covariance
    free = np.pad(np.hstack(maps), ((0, reach.shape[1] - n), (0, 0)))
    if drift is not None:
        covariance = block_diag(covariance, drift.covariance)
        free = np.hstack([free, np.pad(drift.rates.T, ((n, 0), (0, 0)))])
    known = complement(np.linalg.qr(reach @ free)[0].T)
    spread = known @ reach
    return known.T @ np.linalg.solve(spread @ covariance @ spread.T + _SMALLEST**2 * np.eye(len(known)), known)


def _of_pointing(gauge, plane):
    """What keeps steps from a shift, rotation and scale of the plane, as `_of_scatter`; nothing where J knows these."""
    if plane:
        return 0.0
    back = np.linalg.pinv(_reach(gauge))
    rows = gauge.plane_modes().similar @ back[: 2 * gauge.n_modes]
    return rows.T @ rows / _SMALLEST**2


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
