"""Posing the problem: matches, a degree and what is known beforehand become arrays for the criterion."""

from numbers import Real

import numpy as np

from ...exceptions import InputError, SolveError
from ...geometry import basis
from ...priors.prior import Prior
from .criterion import Problem


def check_error_floor(error_floor):
    """Raise `InputError` if the floor is not a finite number of pixels, 0 or more."""
    if not (isinstance(error_floor, Real) and np.isfinite(error_floor) and error_floor >= 0):
        raise InputError(f"error_floor must be a finite number of pixels, 0 or more, got {error_floor!r}")


def build(matches, degree, *, prior=None, error_floor=0.0, own_degree=None):
    """The problem posed by `legdistort.inputs.matches.Matches`.

    Parameters
    ----------
    matches : Matches
    degree : int
    prior : Prior or dict, optional
        One for all exposures, or by ``detector`` or exposure name.
    error_floor : float
        Pixels, added in quadrature to every position error.
    own_degree : int, optional
        Exposures have modes of their own only up to this degree (0: a similarity alone); the rest is common to
        those of a detector.

    Raises
    ------
    InputError
        For a bad degree, floor or prior.
    SolveError
        Naming an exposure with fewer stars than modes and no prior to make up for it.
    """
    degree = basis.check_degree(degree)
    check_error_floor(error_floor)
    obs = matches.observations
    order = _order(obs)
    counts = np.bincount(obs.exposure, minlength=len(matches.names))
    var_x, var_y, cov = (column[order] for column in obs.covariance.T)
    var_x, var_y = var_x + error_floor**2, var_y + error_floor**2
    determinant = var_x * var_y - cov**2
    weight = np.stack([var_y / determinant, var_x / determinant, -cov / determinant])
    priors = by_exposure(matches, prior)
    for name, p in zip(matches.names, priors, strict=True):
        if p is not None and p.shape is not None and tuple(p.shape) != tuple(matches.shapes[name]):
            raise InputError(
                f"the prior belongs to a detector of shape {tuple(p.shape)} (ny, nx), exposure {name} has "
                f"{tuple(matches.shapes[name])}; give the prior of this detector"
            )
    n_fit = basis.n_modes(degree)
    top = max([degree, *(p.degree for p in priors if p is not None)])
    mean = np.zeros((len(priors), 2, basis.n_modes(top)))
    sigma = np.full((len(priors), 2, n_fit), np.inf)
    for i, p in enumerate(priors):
        if p is not None:
            mean[i, :, : p.mean.shape[1]] = p.mean
            if p.sigma is not None:
                given = p.in_numbers[:, :n_fit]
                sigma[i, :, : given.shape[1]] = given
    n_own = n_fit if own_degree is None else basis.n_modes(own_degree)
    sigma[:, :, n_own:] = np.inf  # what exposures share does not scatter
    free = np.isinf(sigma).all(axis=(1, 2))
    needed = np.isinf(sigma[:, :, :n_own]).sum(axis=2).max(axis=1)
    for name, count, n_free in zip(matches.names, counts, needed, strict=True):
        if count < n_free:
            raise SolveError(
                f"exposure {name} has {count} stars, fewer than the {n_free} {'' if n_free == n_fit else 'free '}modes "
                f"of degree {degree}: "
                f"lower the degree (at most {_highest_degree(count)} here), give a prior with sigma, "
                "or leave the exposure out"
            )
    return Problem(
        degree=degree,
        names=matches.names,
        shapes=[matches.shapes[name] for name in matches.names],
        n_stars=len(matches.stars),
        order=order,
        start=np.concatenate([[0], np.cumsum(counts)]),
        star=obs.star[order],
        xy=np.stack([column[order] for column in obs.xy.T]),
        weight=weight,
        prior_mean=mean,
        prior_sigma=None if free.all() else sigma,
        static_sigma=_static_sigma(priors, degree),
        own_degree=own_degree,
        group=_groups(matches),
    )


def _groups(matches):
    """Number of the detector of every exposure: by the column ``detector``, else by shape."""
    detector = _detectors(matches)
    keys = [(detector.get(name), tuple(matches.shapes[name])) for name in matches.names]
    return np.array([sorted(set(keys), key=keys.index).index(key) for key in keys])


def _detectors(matches):
    """``{exposure: detector}`` by the column of that name; empty without one."""
    if "detector" not in matches.table.colnames:
        return {}
    first = np.unique(matches.observations.exposure, return_index=True)[1]
    return {name: matches.table["detector"][k] for name, k in zip(matches.names, first, strict=True)}


def _order(obs):
    """Rows by exposure, then star; a slice of all of them where the table comes that way."""
    key = obs.exposure.astype(np.int64) * (obs.star.max() + 1) + obs.star
    return slice(None) if np.all(key[1:] > key[:-1]) else np.argsort(key, kind="stable")


def _static_sigma(priors, degree):
    given = [p.static_sigma for p in priors if p is not None and p.static_sigma is not None]
    return np.max([basis.change_degree(sigma, degree) for sigma in given], axis=0) if given else None


def _highest_degree(count):
    return max(d for d in range(basis.MAX_DEGREE + 1) if basis.n_modes(d) <= max(count, 1))


def by_exposure(matches, prior):
    """One prior (or None) per exposure."""
    if prior is None or isinstance(prior, Prior):
        return [prior] * len(matches.names)
    if not isinstance(prior, dict):
        raise InputError(f"prior must be a Prior or a dict of them, got {type(prior).__name__}")
    detectors = _detectors(matches)
    out = []
    for name in matches.names:
        key = name if name in prior else detectors.get(name)
        if not isinstance(prior.get(key), Prior | None) or key not in prior:
            raise InputError(
                f"prior must have a Prior for exposure {name} or its detector {key}, got {prior.get(key)!r}"
            )
        out.append(prior[key])
    return out
