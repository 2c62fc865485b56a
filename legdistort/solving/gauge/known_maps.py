"""What a posterior of the coefficients knows of the common map, in the words of the gauge.

And of those that change with time, where the motions of stars are fitted.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import eigh

from ..equations.criterion import complement
from .constraints import without_rates
from .hierarchy import LIMIT, named, of_maps, plane_metric


def as_in_posterior(gauge, unknowns, positions, covariance, wide, *, held):
    """The gauge with the covariance of the common map, and what is unknown of it, as a posterior has them.

    Parameters
    ----------
    gauge : Gauge
        With a constraint for every mode of the plane.
    unknowns : Unknowns
    positions : ndarray, shape (n, 2)
        Of stars with observations.
    covariance : ndarray, shape (size, size)
        Of the unknowns.
    wide : ndarray, shape (size, size), or None
        The same as if nothing told the size of a static distortion of which nothing is stated. A direction is unknown
        if it has an error beyond `LIMIT` pixels there. None: all statics are stated.
    held : bool
        Whether something is known of the motions of stars beforehand.
    """
    n = gauge.n_own
    pointed, metric = plane_metric(gauge, positions)
    similar = gauge.plane_modes().similar.T
    maps = complement(similar.T).T
    rows = gauge.orthonormal.T.reshape(len(gauge.motion), 2, n, -1)
    rows = np.pad(rows, ((0, 0), (0, 0), (0, unknowns.n_modes - n), (0, 0)))
    rows = unknowns.gather(rows.reshape(len(rows), 2 * unknowns.n_modes, -1)).T
    of_rows, widest = (rows @ each @ rows.T for each in (covariance, covariance if wide is None else wide))
    back = _from_constraints(gauge, np.hstack([maps, similar]))[: maps.shape[1]]
    curvature, vectors = eigh(np.linalg.inv(back @ widest @ back.T), of_maps(metric, maps.T))
    is_unknown = (wide is not None) & (curvature * LIMIT**2 < 1)
    known, unknown = maps @ vectors[:, ~is_unknown], maps @ vectors[:, is_unknown]
    back = _from_constraints(gauge, np.hstack([known, unknown, similar]))
    found = _moved(pointed @ known @ back[: known.shape[1]], of_rows)
    made = replace(gauge, covariance=found, unknown_maps=named(unknown, gauge, positions))
    if gauge.drift is None:
        return made
    drift, n = gauge.drift, 2 * gauge.n_modes
    relative = without_rates(pointed, gauge.modes_at(positions), drift.motion.shape[2], gauge.n_fields)
    free = relative @ drift.maps.T @ back[n : n + len(drift.maps)]
    return replace(made, drift=replace(drift, covariance=_moved(free, of_rows), held=held))


def _from_constraints(gauge, maps):
    """Common maps, columns (2 n_modes,) that span all, and then those that change with time, from the constraints."""
    reach = gauge.reach @ maps
    if gauge.drift is not None:
        reach = np.hstack([reach, gauge.drift_reach @ np.concatenate([gauge.drift.maps, gauge.drift.rates]).T])
    return np.linalg.inv(reach)


def _moved(rows, covariance):
    """Covariance (k, k) of combinations of what has a covariance (n, n)."""
    out = rows @ covariance @ rows.T
    return (out + out.T) / 2
