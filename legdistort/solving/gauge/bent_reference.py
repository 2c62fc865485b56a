"""A map that belongs to a reference alone: which it may have, what of its positions it explains, whether it would help.

``X_cat = X + F p``, of which nothing is known but that it has no shift, rotation and scale over the field
(`legdistort.solving.gauge.catalogue_map.MapEquations`).
"""

import contextlib
from dataclasses import replace

import numpy as np

from ...exceptions import InputError
from ...geometry import basis
from ...results.errors.absolute_errors import plain_directions
from ...results.errors.catalogue_tie import OwnMap
from ..checks.limits import GROSS_ERRORS
from .catalogue_agreement import agreement

#: Part of the information of the exposures that a position of a straightened reference has at least.
_LEAST = 1e-6
#: chi2 over its degrees of freedom from which positions have more in them than exposures and layouts explain.
_MISFIT = 2.0


def check_degree(reference, n, degree):
    """Raise `InputError` where n stars in exposures of a degree allow a reference no such map."""
    own = reference.degree or 0
    if own > degree:
        raise InputError(
            f"reference_degree={own} is beyond the degree of the fit ({degree}): raise that, or lower the other"
        )
    if own and n < _least_number(own):
        raise InputError(
            f"reference_degree={own} needs {_least_number(own)} stars of {reference.label} in the exposures, and there "
            f"are {n}: lower the degree, or leave it out"
        )


def bends(gauge, xy, degree):
    """F, (n, 2, q), the maps up to a degree at positions (n, 2) of its stars; None for degree 0."""
    if not degree:
        return None
    modes = _modes(gauge, degree)
    return plain_directions(gauge, xy, modes.size) @ modes.others.T


def straightened(identified, equations, made, result, degree):
    """The stars of a reference with its own map taken off, whose errors become such of its positions.

    Of these, what a common map of the gauge can do is common to all stars, and the rest counts star by star.

    Parameters
    ----------
    identified : `legdistort.matching.cross_identification.Identified`
    equations : `legdistort.solving.gauge.catalogue_map.MapEquations`
        With these maps.
    made : `legdistort.results.errors.catalogue_tie.Tie`
    result : Result
    degree : int

    Returns
    -------
    Identified, Tie
    """
    if not degree:
        return identified, made
    gauge, maps = result.gauge, equations.bends
    off = maps @ equations.bend(equations.offsets.values, made.used)
    follow = _modes(gauge, degree).others.T @ equations.bend(equations.design, made.used)
    sizes, vectors = np.linalg.eigh(equations.bend_covariance(made.used))
    errors = maps @ (vectors * np.sqrt(np.maximum(sizes, 0)))
    design = plain_directions(gauge, result.state.positions.T[identified.rows], equations.design.shape[2] // 2)
    design = design.reshape(2 * len(off), -1)
    common = (design @ (np.linalg.pinv(design) @ errors.reshape(len(design), -1))).reshape(errors.shape)
    covariance, rest = identified.covariance.copy(), (errors - common) @ (errors - common).transpose(0, 2, 1)
    covariance[:, :2, :2] = _beside(covariance[:, :2, :2], equations.own, rest)
    own = OwnMap(degree, float(np.sqrt(np.mean(off**2))), follow)
    known = {"covariance": covariance, "maps": common, "unknown": errors[:, :, :0]}
    return replace(identified, xy=identified.xy - off, **known), replace(made, own=own)


def without_own_map(identified, result, degree):
    """The stars of a reference less the map up to a degree by which they lie off those of a result."""
    xy = result.state.positions.T[identified.rows]
    maps, off = bends(result.gauge, xy, degree).reshape(2 * len(xy), -1), (identified.xy - xy).ravel()
    modes = _modes(result.gauge, degree)
    similar = plain_directions(result.gauge, xy, modes.size) @ modes.similar.T
    both = np.hstack([maps, similar.reshape(len(off), -1)])
    own = maps @ np.linalg.lstsq(both, off)[0][: maps.shape[1]]
    return replace(identified, xy=identified.xy - own.reshape(xy.shape))


def is_as_stated(made, agrees):
    """Whether a reference is what it states: its errors, nearly all of its stars, and its shape."""
    return made.factor == 1 and not agrees.is_bent and np.mean(~made.used) <= GROSS_ERRORS


def cure(stated, estimate, result, identified, degree, highest):
    """The lowest degree of a map of its own, beyond `degree`, with which a reference is what it states.

    Parameters
    ----------
    stated : `legdistort.solving.gauge.catalogue_map.MapEquations`
        At the errors that it states.
    estimate : callable
        ``estimate(equations, near=None)``: equations, common map and `Tie` of these.
    result : Result
    identified : `legdistort.matching.cross_identification.Identified`
    degree : int
    highest : int
        Degree of the fit, beyond which it may have none (`check_degree`); static distortions that are given may have
        more modes.

    Returns
    -------
    dict
        ``cure`` and ``bend`` of an `Agreement`: the degree, and the size of that map [px], similarities taken off.
        Empty if there is none.
    """
    xy = result.state.positions.T[identified.rows]
    for higher in range(degree + 1, highest + 1):
        if len(xy) < _least_number(higher):
            break
        with contextlib.suppress(InputError):
            bent, step, made = estimate(stated.with_bends(bends(result.gauge, xy, higher)), near=None)
            if is_as_stated(made, agreement(bent, bent, made.used)):
                off = (bent.bends @ bent.bend(bent.offsets.values - bent.design @ step, made.used)).ravel()
                similar = (bent.design @ bent.prior.modes.similar.T).reshape(len(off), -1)
                off = off - similar @ (np.linalg.pinv(similar) @ off)
                return {"cure": higher, "bend": float(np.sqrt(np.mean(off**2)))}
    return {}


def _modes(gauge, degree):
    """`PlaneModes` of a map of a reference alone."""
    return gauge.plane_modes(gauge.n_fields * basis.n_modes(degree))


def _least_number(degree):
    """Of stars, for such a map."""
    return basis.n_modes(degree) + 1


def _beside(covariance, own, rest):
    """Covariance (n, 2, 2) with which positions leave their stars the error `rest` beside what they would leave.

    `rest` came from the positions that the exposures have for these stars, whose covariance is `own`: as errors of its
    own it would count twice.
    """
    left = rest + np.linalg.inv(np.linalg.inv(covariance) + np.linalg.inv(own))
    size, vectors = np.linalg.eigh(np.linalg.inv(left) - np.linalg.inv(own))
    least = _LEAST / np.einsum("naa->n", own)
    return (vectors / np.maximum(size, least[:, None])[:, None]) @ vectors.transpose(0, 2, 1)


def or_detectors(fit):
    """What else may keep stars of a reference from their places: distortions of detectors that are not fitted."""
    errors = fit.camera_errors
    is_fitted = errors is not None and errors.free[:, :, 3:].any()
    if is_fitted or not fit.matches.camera.has_focal_plane or fit.chi2 < _MISFIT * fit.dof:
        return ""
    return (
        f" Or detectors have distortions of their own: chi2 is {fit.chi2:.0f} for {fit.dof:.0f} degrees of freedom; "
        "fit them, static='fit' (--static fit)"
    )
