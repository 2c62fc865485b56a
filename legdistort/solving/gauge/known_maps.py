"""What a posterior of the coefficients knows of the common map, in the words of the gauge."""

from dataclasses import replace

import numpy as np
from scipy.linalg import eigh

from ..equations.criterion import complement
from .hierarchy import LIMIT, named, of_maps, plane_metric


def as_in_posterior(gauge, unknowns, positions, covariance, wide):
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
    """
    n = gauge.n_own
    pointed, metric = plane_metric(gauge, positions)
    similar = gauge.plane_modes().similar.T
    maps = complement(similar.T).T
    rows = gauge.orthonormal.T.reshape(len(gauge.motion), 2, n, -1)
    rows = np.pad(rows, ((0, 0), (0, 0), (0, unknowns.n_modes - n), (0, 0)))
    rows = unknowns.gather(rows.reshape(len(rows), 2 * unknowns.n_modes, -1)).T
    of_rows, widest = (rows @ each @ rows.T for each in (covariance, covariance if wide is None else wide))
    back = np.linalg.inv(gauge.reach @ np.hstack([maps, similar]))[: maps.shape[1]]
    curvature, vectors = eigh(np.linalg.inv(back @ widest @ back.T), of_maps(metric, maps.T))
    is_unknown = (wide is not None) & (curvature * LIMIT**2 < 1)
    known, unknown = maps @ vectors[:, ~is_unknown], maps @ vectors[:, is_unknown]
    back = np.linalg.inv(gauge.reach @ np.hstack([known, unknown, similar]))[: known.shape[1]]
    back = pointed @ known @ back
    found = back @ of_rows @ back.T
    return replace(gauge, covariance=(found + found.T) / 2, unknown_maps=named(unknown, gauge, positions))
