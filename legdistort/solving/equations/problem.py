"""The problem: matches, a degree and what is known beforehand as arrays, and the unknowns that are sought."""

import itertools
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real
from pathlib import Path

import numpy as np

from ...cameras.stated_errors import FREE, StaticErrors
from ...exceptions import InputError, SolveError
from ...geometry import basis
from ...geometry.detector_modes import dynamic_basis, pose_departures, pose_widths, similarity_basis
from ...inputs.start_poses import POSE_ERRORS
from ...priors.prior import Prior
from ...runtime.checks import LARGEST
from .star_terms import StarTerms
from .unknowns import Unknowns, carried

#: Width of what is known exactly of a pose, in errors of what the stars of the exposure say of it; and the largest,
#: pixels: of rotations and scales of which nothing is known.
_EXACT, _FREE = 1e-2, 1e3
#: Number of observations from which compiled loops are used; below, loading numba takes longer than it saves.
COMPILED_FROM = 20_000


def uses_compiled_loops(n):
    """Whether the compiled loops of `legdistort.solving.equations.compiled` serve a problem of n observations."""
    return n >= COMPILED_FROM


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything in J that does not change while it is minimised.

    Attributes
    ----------
    degree : int
        Total degree that is fitted; modes of the prior beyond it stay at the prior.
    names : tuple of str
    shapes : list of (ny, nx), one an exposure
    n_stars : int
    order : ndarray of int, shape (n,), or slice
        Row of the table behind every observation.
    start : ndarray of int, shape (n_exposures + 1,)
        Observations ``start[i]:start[i + 1]`` belong to exposure i.
    star : ndarray of int, shape (n,)
        Ascending within an exposure.
    xy : ndarray, shape (2, n)
    weight : ndarray, shape (3, n)
        Inverse covariance: xx, yy, xy [1/pix^2]; zero for an observation that is left out.
    prior_mean : ndarray, shape (n_exposures, 2, n_all)
    prior_sigma : ndarray, shape (n_exposures, 2, n_modes), or None
    static_covariance : ndarray, shape (2 n_modes, 2 n_modes), or None
        Of the prior mean where exposures share it; of several priors that differ the largest widths.
    static_errors : StaticErrors or None
        Uncertainty of the prior mean by exposure: infinite where there is no prior, zero where it states none and
        counts as exact. None is zero everywhere.
    own_degree : int or None
        Up to this degree exposures have modes of their own; None: nothing is shared. See `Unknowns`.
    group : ndarray of int, shape (n_exposures,)
        Detector of every exposure; exposures of one share what is not their own.
    night : ndarray of int, shape (n_exposures,)
        Night of every exposure.
    night_sigma : float or None
        Standard deviation of every coefficient of what the exposures of a night have in common, pixels; None: found.
    centre : ndarray, shape (n_exposures, 2, n_all), or None
        What was found of the static distortion beside the prior: about it the widths of coefficients are centred, and
        beyond the degree it is in the mean already. None: nothing.
    given_poses : ndarray, shape (n_exposures, 2, 3), or None
        Poses about which those of the exposures scatter.
    pose_width : ndarray, shape (n_exposures, 4), or None
        By how much, as coefficients of the similarities of the detector, pixels; None: nothing is known of poses.
    field : ndarray of int, shape (n_exposures,)
        Group of exposures with common stars that every exposure is in, directly or through others.
    moving : StarTerms or None
        How stars move from exposure to exposure; None: they do not.
    begun : ndarray, shape (n_exposures, 2, n_all), or None
        Coefficients with which a minimisation begins; None: those of the prior mean.
    floats : bool
        Widths are about a mean of which nothing is known: what all exposures have in common is to cost nothing.
    weak : float
        Eigenvalue of the normalised equations below which a distortion that exposures share is held.
    """

    degree: int
    names: tuple
    shapes: list
    n_stars: int
    order: np.ndarray | slice
    start: np.ndarray
    star: np.ndarray
    xy: np.ndarray
    weight: np.ndarray
    prior_mean: np.ndarray
    prior_sigma: np.ndarray | None = None
    static_covariance: np.ndarray | None = None
    static_errors: StaticErrors | None = None
    own_degree: int | None = None
    group: np.ndarray | int = 0
    night: np.ndarray | int = 0
    night_sigma: float | None = None
    centre: np.ndarray | None = None
    given_poses: np.ndarray | None = None
    pose_width: np.ndarray | None = None
    field: np.ndarray | int = 0
    moving: StarTerms | None = None
    begun: np.ndarray | None = None
    floats: bool = False
    weak: float = 1e-3

    @cached_property
    def unequal(self):
        """Whether some observation has different or correlated axis weights."""
        return bool(np.any(self.weight[0] != self.weight[1]) or np.any(self.weight[2]))

    @property
    def uses_compiled_loops(self):
        """Whether the compiled loops of `legdistort.solving.equations.compiled` serve this problem."""
        return uses_compiled_loops(self.xy.shape[1])

    @property
    def n_exposures(self):
        """Number of exposures."""
        return len(self.shapes)

    @cached_property
    def terms(self):
        """The terms of the stars beside their position, perhaps none."""
        return StarTerms.none(self.n_exposures) if self.moving is None else self.moving

    @property
    def n_star(self):
        """Unknowns of a star."""
        return 2 + self.terms.n

    def placed(self, stars):
        """Values (2, n) at every observation of fields of the reference plane with star unknowns (2 + k, n_stars)."""
        return self.placed_at(self.exposure, stars[:, self.star])

    def placed_at(self, exposure, stars):
        """Positions (2, ..., n) of observations of some exposures (n,), of stars with unknowns (2 + k, ..., n)."""
        if not self.terms.n:
            return stars
        columns = np.moveaxis(self.terms.columns[exposure], 0, -1)
        return stars[:2] + np.einsum("akn,k...n->a...n", columns, stars[2:])

    def pulled(self, values):
        """Gradients (2, ..., n) by the place of a star at every observation -> by its unknowns, (2 + k, ..., n)."""
        if not self.terms.n:
            return values
        columns = np.moveaxis(self.terms.columns[self.exposure], 0, -1)
        return np.concatenate([values, np.einsum("akn,a...n->k...n", columns, values)])

    @cached_property
    def exposure(self):
        """Exposure of every observation, ndarray of int, shape (n,)."""
        return np.repeat(np.arange(self.n_exposures), np.diff(self.start))

    @property
    def detectors(self):
        """Number of the detector of every exposure, (n_exposures,)."""
        return np.broadcast_to(self.group, self.n_exposures)

    @property
    def fields(self):
        """Number of the field of every exposure, (n_exposures,)."""
        return np.broadcast_to(self.field, self.n_exposures)

    @property
    def n_fields(self):
        """Number of groups of exposures without a common star, each with a null space of its own."""
        return int(np.max(self.field)) + 1

    @cached_property
    def field_of_stars(self):
        """Number of the field of every star, (n_stars,)."""
        out = np.zeros(self.n_stars, dtype=int)
        if self.n_fields > 1:
            out[self.star] = self.fields[self.exposure]
        return out

    @cached_property
    def nights(self):
        """Number of the night of every exposure, each detector with nights of its own, (n_exposures,); or None.

        None where those of a night have nothing in common beside the others: every detector has one night, every night
        one exposure, or it is stated.
        """
        pairs = np.column_stack([self.detectors, np.broadcast_to(self.night, self.n_exposures)])
        number = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
        several = self.detectors.max() < number.max() < self.n_exposures - 1
        return number if several and self.night_sigma != 0 else None

    @property
    def n_nights(self):
        """Number of nights whose exposures may have something in common."""
        return 0 if self.nights is None else int(self.nights.max()) + 1

    @cached_property
    def size(self):
        """Width and height of the detectors, pixels, of every exposure (n_exposures, 2)."""
        return np.array(self.shapes, dtype=float)[:, ::-1]

    def by_star(self, values):
        """Sums over the observations of a star of values (k, n): (k, n_stars)."""
        return np.stack([np.bincount(self.star, each, self.n_stars) for each in values])

    def by_exposure(self, left, right):
        """``left @ right.T`` by exposure, of values (k, n) and (m, n): (n_exposures, k, m)."""
        parts = [slice(*ends) for ends in itertools.pairwise(self.start.tolist())]
        return np.stack([left[:, part] @ right[:, part].T for part in parts])

    @cached_property
    def unknowns(self):
        """The unknown coefficients as one vector."""
        return Unknowns(self.degree, self.own_degree, self.group, self.shapes)

    @property
    def has_prior(self):
        """Whether widths of a prior take part in J."""
        return self.prior_sigma is not None or (self.unknowns.shared and self.static_covariance is not None)

    @property
    def errors_of_statics(self):
        """`static_errors`, of no size without any."""
        if self.static_errors is None:
            return StaticErrors(np.zeros((self.n_exposures, 2, self.n_modes)))
        return self.static_errors

    def departure(self, coefficients):
        """How far fitted coefficients are from where their widths are centred, of those (n_exposures, 2, n_all) given.

        Shape (n_exposures, 2 n_modes).
        """
        out = (coefficients - self.prior_mean)[:, :, : self.n_modes]
        return (out if self.centre is None else out - self.centre[:, :, : self.n_modes]).reshape(len(out), -1)

    def pose_departure(self, state):
        """How far exposures are from the given poses, in similarities of their detectors: (n_exposures, 4).

        And how a change of their coefficients changes it, (n_exposures, 4, 2 n_modes): by the similarity s that becomes
        part of the pose, with what this does to the distortion, ``(grad A b) s``.
        """
        similar = np.stack([similarity_basis(shape, self.n_modes) for shape in self.shapes])
        beside = [carried(a, shape, self.degree) for a, shape in zip(state.coefficients, self.shapes, strict=True)]
        rows = np.linalg.solve(np.eye(4) + similar @ np.stack(beside).mT, similar)
        own = (state.coefficients - self.prior_mean)[:, :, : self.n_modes].reshape(self.n_exposures, -1, 1)
        return pose_departures(state.poses, self.given_poses, self.shapes) + (rows @ own)[..., 0], rows

    @property
    def n_modes(self):
        """Number of fitted modes per axis."""
        return basis.n_modes(self.degree)

    def has_widths(self, i):
        """Whether the prior has widths for exposure i: neither infinite, which is free, nor zero, which is `fixed`."""
        if self.prior_sigma is None:
            return False
        return bool(np.any((self.prior_sigma[i] > 0) & np.isfinite(self.prior_sigma[i])))

    def n_free(self, i):
        """Number of modes (of the axis that has more) without a prior width: stars that exposure i needs at least."""
        return self.n_modes if self.prior_sigma is None else int(np.isinf(self.prior_sigma[i]).sum(axis=1).max())

    @cached_property
    def fixed(self):
        """Directions of every exposure's coefficients that stay at the prior mean, for its width is zero there.

        List of orthonormal rows (n_fixed, 2 n_modes); None if nothing is fixed.
        """
        if self.prior_sigma is None or np.all(self.prior_sigma > 0):
            return None
        rows = [dynamic_basis(shape, self.n_modes) for shape in self.shapes]
        return [r[~np.any((r != 0) & (s.ravel() > 0), axis=1)] for r, s in zip(rows, self.prior_sigma, strict=True)]

    def part(self, i):
        """Observations of exposure i, as a slice."""
        return slice(self.start[i], self.start[i + 1])

    def in_table_order(self, values):
        """Values of the observations (..., n), in the order of the rows of the table: those given if it is the same."""
        if isinstance(self.order, slice):
            return values
        out = np.empty_like(values)
        out[..., self.order] = values
        return out

    def scaled(self, factor):
        """The same problem with all weights multiplied by `factor` (n,); zero leaves an observation out."""
        return replace(self, weight=self.weight * factor)


@dataclass(frozen=True, eq=False)
class State:
    """The unknowns: stars (2 + k, n_stars), coefficients (n_exposures, 2, n_all), poses (n_exposures, 2, 3).

    Stars have their positions first, then what `StarTerms` adds.
    """

    stars: np.ndarray
    coefficients: np.ndarray
    poses: np.ndarray

    @property
    def positions(self):
        """Positions (2, n_stars) at the reference epoch."""
        return self.stars[:2]


def check_error_floor(error_floor):
    """Raise `InputError` if the floor is not a finite number of pixels, 0 or more."""
    if not (isinstance(error_floor, Real) and 0 <= error_floor < LARGEST):
        raise InputError(f"error_floor must be a finite number of pixels, 0 or more, got {error_floor!r}")


def check_prior(prior):
    """Raise `InputError` for what is neither a `Prior`, a dict, nor None."""
    if not isinstance(prior, Prior | dict | None):
        raise InputError(f"prior must be a Prior or a dict of them, got {as_given(prior)}")


def as_given(prior):
    """What was given in the place of a `Prior`, in words; names and files are read by `Prior.from_file`."""
    if isinstance(prior, (str, Path)):
        return f"{str(prior)!r}: give Prior.from_file({str(prior)!r})"
    return type(prior).__name__


def _check_shapes(matches, priors):
    """Raise `InputError` for a prior of a detector of another shape, or of one where exposures have several."""
    cure = "; give the prior of this detector"
    if matches.camera.has_focal_plane:
        cure = (
            ", the focal plane of several: give their static distortions in a camera (camera=, --camera; legdistort "
            "camera FRAME makes one of headers), or let them be found: static='fit' (--static fit)"
        )
    for name, prior in zip(matches.names, priors, strict=True):
        shape = matches.shapes[name]
        if prior is not None and prior.shape is not None and tuple(prior.shape) != tuple(shape):
            raise InputError(
                f"the prior belongs to a detector of shape {tuple(prior.shape)} (ny, nx), exposure {name} has "
                f"{tuple(shape)}{cure}"
            )


def build_problem(matches, degree, *, prior=None, error_floor=0.0, own_degree=None, motion=None, night_sigma=None):
    """The problem posed by `legdistort.matching.matches.Matches`.

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
    night_sigma : float, optional
        See `Problem`; 0: exposures of a night have nothing in common.
    motion : callable, optional
        ``motion(matches, weight)`` gives the `StarTerms` for weights (n,) in the order of the table; None: stars do not
        move.

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
    weight = _weights(obs.covariance.T[:, order], error_floor)
    priors = by_exposure(matches, prior)
    _check_shapes(matches, priors)
    n_fit = basis.n_modes(degree)
    top = max([degree, *(p.degree for p in priors if p is not None)])
    mean = np.zeros((len(priors), 2, basis.n_modes(top)))
    sigma = np.full((len(priors), 2, n_fit), np.inf)
    for i, p in enumerate(priors):
        if p is not None:
            if p.mean is not None:
                mean[i, :, : p.mean.shape[1]] = p.mean
            if p.sigma is not None:
                given = p.in_numbers[:, :n_fit]
                sigma[i, :, : given.shape[1]] = given
    n_own = n_fit if own_degree is None else basis.n_modes(own_degree)
    sigma[:, :, n_own:] = np.inf  # what exposures share does not scatter
    free = np.isinf(sigma).all(axis=(1, 2))
    needed = np.isinf(sigma[:, :, :n_own]).sum(axis=2).max(axis=1)
    if few := [i for i, count in enumerate(counts) if count < needed[i]]:
        name, count, n_free = matches.names[few[0]], counts[few[0]], needed[few[0]]
        raise SolveError(
            f"exposure {name} has {count} stars, fewer than the {n_free} {'' if n_free == n_fit else 'free '}modes "
            f"of degree {degree}: "
            f"lower the degree (at most {_highest_degree(count)} here), {_asked_of(priors[few[0]])}, "
            "or leave the exposure out (--without)",
            exposures=tuple(matches.names[i] for i in few),
        )
    has_widths, errors = not free.all(), StaticErrors.of(priors, degree)
    problem = Problem(
        degree=degree,
        names=matches.names,
        shapes=[matches.shapes[name] for name in matches.names],
        n_stars=len(matches.stars),
        order=order,
        start=np.concatenate([[0], np.cumsum(counts)]),
        star=obs.star[order],
        xy=np.array(obs.xy.T[:, order], order="C"),
        weight=weight,
        prior_mean=mean,
        prior_sigma=sigma if has_widths else None,
        static_covariance=_static_covariance(priors, degree),
        static_errors=errors,
        floats=has_widths and errors.covariances is None and bool(np.isinf(errors.sigma[np.isfinite(sigma)]).all()),
        own_degree=own_degree,
        group=_groups(matches),
        night=matches.blocks,
        field=matches.fields,
        night_sigma=night_sigma,
        begun=_begun(matches, mean, n_fit),
        **_known_poses(matches, degree, np.bincount(obs.exposure[order], weight[:2].mean(axis=0))),
    )
    if motion is None:
        return problem
    return replace(problem, moving=motion(matches, problem.in_table_order(weight[:2].mean(axis=0))))


def _begun(matches, mean, n_modes):
    """The coefficients that matches state for a start, the modes that are not fitted as in the prior mean; or None."""
    if matches.start is None:
        return None
    begun, degree = mean.copy(), basis.degree_of(n_modes)
    begun[:, :, :n_modes] = [basis.change_degree(matches.start[name], degree) for name in matches.names]
    return begun


def _known_poses(matches, degree, weight):
    """Poses that are known and their widths, as fields of a `Problem`; none where nothing is known of them.

    `weight` (n_exposures,) is the sum of those of an exposure's stars.

    Raises
    ------
    InputError
        At degree 0, at which exposures keep their rotation and scale.
    """
    errors = matches.pose_sigma
    if errors is None:
        return {}
    if degree < 1:
        raise InputError("pose_sigma needs degree 1 at least: raise degree, or leave pose_sigma out")
    shapes = [matches.shapes[name] for name in matches.names]
    width = pose_widths([errors.get(name, np.inf) for name in POSE_ERRORS], shapes)
    poses = np.stack([matches.poses[name] for name in matches.names])
    exact = _EXACT * 2 / np.sqrt(weight)  # a mode has mean square 1/4
    return {"given_poses": poses, "pose_width": np.clip(width, exact[:, None], _FREE)}


def _weights(covariance, error_floor):
    """Inverse covariance: xx, yy, xy (3, n) of variances and covariances xx, yy, xy (3, n)."""
    variance, weight = covariance[:2], np.zeros(covariance.shape)
    if error_floor:
        variance = variance + error_floor**2
    if np.any(covariance[2]):
        determinant = variance[0] * variance[1] - covariance[2] ** 2
        weight[0], weight[1] = variance[1] / determinant, variance[0] / determinant
        weight[2] = -covariance[2] / determinant
    else:
        np.divide(1, variance, out=weight[:2])
    return weight


def _groups(matches):
    """Number of the detector of every exposure: by the column ``detector``, else by shape."""
    detector = _detectors(matches)
    keys = [(detector.get(name), tuple(matches.shapes[name])) for name in matches.names]
    number = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    return np.array([number[key] for key in keys])


def _detectors(matches):
    """``{exposure: detector}`` by the column of that name; empty without one, and with a camera.

    Raises
    ------
    InputError
        For an exposure with positions on several detectors.
    """
    if "detector" not in matches.table.colnames or matches.camera.has_focal_plane:
        return {}
    detector, exposure = np.asarray(matches.table["detector"]), matches.observations.exposure
    first = matches.observations.first
    if np.any(several := detector != detector[first][exposure]):
        row = int(np.argmax(several))
        raise InputError(
            f"exposure {matches.names[exposure[row]]} has positions on several detectors, "
            f"{detector[first][exposure[row]]} and {detector[row]}: give the camera that they belong to "
            "(Matches.from_table(..., camera=)), or name every detector's part an exposure of its own"
        )
    return {name: matches.table["detector"][k] for name, k in zip(matches.names, first, strict=True)}


def _order(obs):
    """Rows by exposure, then star; a slice of all of them where the table comes that way."""
    return slice(None) if obs.is_sorted else np.argsort(obs.key, kind="stable")


def _static_covariance(priors, degree):
    given = [p for p in dict.fromkeys(priors) if p is not None and p.static_sigma is not None]
    if len(given) == 1 and given[0].static_covariance is not None:
        covariance = given[0].static_covariance_to(degree)
        return np.where(np.isinf(covariance), FREE**2, covariance)
    return np.diag(np.max([p.static_widths(degree) for p in given], axis=0).ravel() ** 2) if given else None


def _asked_of(prior):
    """What a prior of an exposure of few stars has to state, in words."""
    if prior is None or prior.mean is None:
        return "give a prior with sigma (--prior FILE --prior-sigma evidence)"
    return "give the prior a finite sigma too, by which exposures scatter about it (--prior-sigma evidence)"


def _highest_degree(count):
    return max(d for d in range(basis.MAX_DEGREE + 1) if basis.n_modes(d) <= max(count, 1))


def by_exposure(matches, prior):
    """One prior (or None) per exposure."""
    if prior is None or isinstance(prior, Prior):
        return [prior] * len(matches.names)
    check_prior(prior)
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
