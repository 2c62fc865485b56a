"""Turbulence: every exposure has a smooth random field of displacements beside its distortion.

Offsets y (measured minus model) of an exposure are ``J d + t + n``, with changes d of stars and coefficients, the field
``t ~ N(0, K)`` and noise ``n ~ N(0, W^-1)``. With ``C = K + W^-1`` for the noise the estimate of d has the covariance

    P = (J' C^-1 J + R)^-1 = (1 - P0 G)^-1 P0,   G = J' (W - C^-1) J,

where ``P0 = (J' W J + R)^-1`` is that of a fit without the field and R all else that it knows: nothing of the solver
changes. ``t = K C^-1 (y - J d)`` at the observations is taken off the positions; the fit to what is left, with its own
weights, is then the minimum over everything. At other places the field is ``K(., places) C^-1 (y - J d)``, and what is
measured there has, with the basis b of the exposure, the covariance ``K - K C^-1 K' + g P g'``, g = b - K C^-1 J.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from ...exceptions import ConvergenceWarning, SolveError, warn
from ...geometry import basis
from ...geometry.tabulated.covariance_table import CovarianceTable
from ...geometry.tabulated.displacement_table import DisplacementTable
from ...results.errors.camera_errors import CameraErrors, unit_errors
from ..equations.common_parts import Followed, relative_responses, response
from ..equations.star_terms import unpacked
from .displaced import SMALL, Tabled, displaced, taken_off, unclipped
from .observed import undistorted
from .random_field import Seen, most_likely

#: Twice the gain in the logarithm of the likelihood from which a field is there: some numbers of it are sought.
SHOWN = 12.0
#: Exposures, and stars, of which the likelihood is made at most: the sizes of the field are known well enough.
_EXPOSURES, _STARS = 8, 60
#: Fits at most, and the change in errors from which a warning says that they have not settled. Where the field is far
#: larger than the errors of measurement, what these alone tell of the plane in second order goes back and forth: then
#: steps are half as large.
_ROUNDS, _UNSETTLED = 6, 0.6
#: chi2 by its degrees of freedom from which errors count as too small to begin with.
_EXPLAINED = 1.0
#: Unknowns of stars and exposures together, and stars of an exposure, at most.
_MOST, _MOST_STARS = 5000, 2500
#: Cells of the tables of a field by its length, and along an axis at least and at most; into how many each is divided.
_NODES_A_LENGTH, _NODES, _FINER = 4, (32, 128), 2


@dataclass(frozen=True, eq=False)
class _Part:
    """An exposure: what it has seen, rows of the problem, their weights in the fit (n, 2, 2), and C^-1 of a kernel."""

    seen: Seen
    rows: np.ndarray
    weight: np.ndarray
    inverse: np.ndarray | None = None

    def at(self, kernel):
        """With C^-1 of a kernel."""
        factor = linalg.cho_factor(self.seen.covariance(kernel), lower=True, check_finite=False)
        inverse = linalg.cho_solve(factor, np.eye(2 * len(self.rows)), check_finite=False)
        return replace(self, inverse=(inverse + inverse.T) / 2)

    def weighted(self, y):
        """W y of offsets (2 n, ...)."""
        shape = y.shape
        return np.einsum("nab,nb...->na...", self.weight, y.reshape(-1, 2, *shape[1:])).reshape(shape)

    @property
    def difference(self):
        """W - C^-1, (2 n, 2 n)."""
        out, n = -self.inverse.copy(), len(self.rows)
        block = out.reshape(n, 2, n, 2)
        block[np.arange(n), :, np.arange(n)] += self.weight
        return out


@dataclass(frozen=True, eq=False)
class Field:
    """The field of all exposures at a fit.

    Attributes
    ----------
    found : legdistort.solving.terms.random_field.Found
    parts : list of _Part
    unknowns : _Unknowns
    before, covariance : ndarray, shape (k, k)
        Of stars and coefficients, P0 and P.
    change : ndarray, shape (k,)
        d.
    """

    found: object
    parts: list
    unknowns: object
    before: np.ndarray
    covariance: np.ndarray
    change: np.ndarray

    def strengths(self, part, i):
        """C^-1 (y - J d) of exposure i, (2 n,)."""
        return part.inverse @ (part.seen.y - self.unknowns.moved(part.seen, i, self.change[:, None])[:, 0])

    def displacements(self, n):
        """At the observations, (2, n) pixels, those that take part; 0 elsewhere."""
        out = np.zeros((2, n))
        for i, part in enumerate(self.parts):
            field = self.found.kernel(part.seen.places, part.seen.places) @ self.strengths(part, i)
            out[:, part.rows] = field.reshape(-1, 2).T
        return out

    def at(self, i, places, apart=1000):
        """Of exposure i at places (n, 2), (n, 2) pixels."""
        part, kernel = self.parts[i], self.found.kernel
        strengths = self.strengths(part, i)
        made = [kernel(places[k : k + apart], part.seen.places) @ strengths for k in range(0, len(places), apart)]
        return np.concatenate(made).reshape(-1, 2)

    def errors(self, i, places, values, root):
        """Of what is measured in exposure i at places (n, 2): covariance (n, 2, 2) of its field alone, and responses.

        Those are (n, 2, r), to the independent errors of unit size that all exposures share, of which `root` are the
        responses (stars, coefficients) of all unknowns. `values` (n_modes, n) are those of the basis.
        """
        part, kernel = self.parts[i], self.found.kernel
        cross = kernel(places, part.seen.places)
        taken = cross @ part.inverse
        n, m = len(places), len(values)
        design = np.zeros((n, 2, 2, m))
        design[:, 0, 0] = design[:, 1, 1] = values.T
        stars, coefficients = root
        by_stars = np.einsum("nap,npr->nar", part.seen.slopes, stars[part.seen.star]).reshape(2 * len(part.rows), -1)
        seen = by_stars + part.seen.design @ coefficients[i]
        moved = design.reshape(2 * n, 2 * m) @ coefficients[i] - taken @ seen
        moved, taken, cross = moved.reshape(n, 2, -1), taken.reshape(n, 2, -1), cross.reshape(n, 2, -1)
        return kernel(places[:1], places[:1]) - taken @ cross.mT, moved

    @property
    def length(self):
        """Of the change, in errors, rms over all that is determined."""
        variance = np.diag(self.covariance)
        known = variance > 0
        return float(np.sqrt(np.mean(self.change[known] ** 2 / variance[known])))

    @property
    def dof(self):
        """Degrees of freedom that are left to the noise: the trace of N Q, Q = C^-1 - C^-1 J P J' C^-1."""
        total = 0.0
        for i, part in enumerate(self.parts):
            shape = part.inverse.shape
            by_noise = np.einsum("inb,nbc->inc", part.inverse.reshape(shape[0], -1, 2), part.seen.noise).reshape(shape)
            total += np.trace(by_noise)
            total -= float(np.sum(self.unknowns.squares(part.seen, i, by_noise @ part.inverse, self.covariance)))
        return total

    def tables(self, shapes):
        """`DisplacementTable` of every exposure, in a list."""
        made = []
        for i, shape in enumerate(shapes):
            step = np.clip(self.found.kernel.length / _NODES_A_LENGTH, *(max(shape) / np.array(_NODES[::-1])))
            coarse = DisplacementTable.of(lambda q, i=i: self.at(i, q), shape, step)
            made.append(coarse.refined(_FINER))
        return made


@dataclass(frozen=True, eq=False)
class _Unknowns:
    """Stars, p numbers each, and then the coefficients of exposures, in one vector."""

    n_stars: int
    p: int
    n_exposures: int
    n_coefficients: int

    @property
    def size(self):
        """How many there are."""
        return self.n_stars * self.p + self.n_exposures * self.n_coefficients

    def of_star(self, star):
        """Places (n, p) of the numbers of stars."""
        return star[:, None] * self.p + np.arange(self.p)

    def of_exposure(self, i):
        """Places (2 n_modes,) of the coefficients of an exposure."""
        return self.n_stars * self.p + i * self.n_coefficients + np.arange(self.n_coefficients)

    def places(self, seen, i):
        """Places of all that exposure i depends on: of its stars, and of its coefficients."""
        return np.concatenate([self.of_star(seen.star).ravel(), self.of_exposure(i)])

    def design(self, seen):
        """J of those, (2 n, n p + 2 n_modes)."""
        n = len(seen.star)
        stars = np.zeros((n, 2, n, self.p))
        stars[np.arange(n), :, np.arange(n)] = seen.slopes
        return np.hstack([stars.reshape(2 * n, -1), seen.design])

    def moved(self, seen, i, changes):
        """J d of exposure i for changes (k, r), (2 n, r)."""
        stars = np.einsum("nap,npr->nar", seen.slopes, changes[self.of_star(seen.star)])
        return stars.reshape(2 * len(seen.star), -1) + seen.design @ changes[self.of_exposure(i)]

    def gathered(self, seen, i, left):
        """J' of values (2 n, r) of exposure i, in all unknowns, (k, r)."""
        out = np.zeros((self.size, left.shape[1]))
        pulls = np.einsum("nap,nar->npr", seen.slopes, left.reshape(len(seen.star), 2, -1))
        out[self.of_star(seen.star)] += pulls
        out[self.of_exposure(i)] += seen.design.T @ left
        return out

    def squares(self, seen, i, inner, covariance):
        """``(J' inner J) * covariance`` of exposure i, whose sum is the trace of their product."""
        design, at = self.design(seen), self.places(seen, i)
        return (design.T @ inner @ design) * covariance[np.ix_(at, at)]

    def add(self, total, seen, i, inner):
        """Add J' inner J of exposure i to a matrix (k, k)."""
        design, at = self.design(seen), self.places(seen, i)
        total[np.ix_(at, at)] += design.T @ inner @ design

    def split(self, changes):
        """Changes (k, r) as those of stars (n_stars, p, r) and coefficients (n_exposures, 2 n_modes, r)."""
        first = self.n_stars * self.p
        shapes = (self.n_stars, self.p, -1), (self.n_exposures, self.n_coefficients, -1)
        return changes[:first].reshape(shapes[0]), changes[first:].reshape(shapes[1])


def _size(problem):
    """Unknowns of a `Problem`, and most stars of an exposure."""
    n = problem.n_stars * problem.n_star + problem.n_exposures * 2 * problem.n_modes
    return n, int(np.diff(problem.start).max())


def can_be_found(problem):
    """Whether a `Problem` is small enough."""
    n, largest = _size(problem)
    return n <= _MOST and largest <= _MOST_STARS


def check_size(problem):
    """Raise `SolveError` for a `Problem` that is not small enough."""
    if not can_be_found(problem):
        n, largest = _size(problem)
        raise SolveError(
            f"turbulence of {problem.n_stars} stars in {problem.n_exposures} exposures has {n} unknowns, "
            f"{2 * largest} values an exposure: at most {_MOST} and {2 * _MOST_STARS} can be done at once, give fewer "
            "stars or exposures"
        )


def field_of(fit, displaced, near=None, *, scale=False, weight=None):
    """The `Field` at a fit to positions with displacements (2, n) taken off; None where none is seen.

    Parameters
    ----------
    fit : legdistort.solving.single_fit.Fit
    displaced : ndarray, shape (2, n)
        In the order of its problem.
    near : Found, optional
        Near which it is sought; held if it was found twice.
    scale : bool
        Whether errors have a common factor.
    weight : ndarray, shape (3, n), optional
        Of the observations, if not that of the fit.

    Raises
    ------
    SolveError
        For more stars than can be done at once.
    """
    problem, blocks = fit.weighted, fit.blocks
    check_size(problem)
    unknowns = _Unknowns(problem.n_stars, problem.n_star, problem.n_exposures, blocks.g_exposure.shape[1])
    parts = _parts(problem, blocks, fit.result.state, displaced, problem.weight if weight is None else weight)
    found = near
    if near is None or not near[1]:
        held = unpacked(blocks.v).copy()
        for part in parts:
            at = part.seen.slopes
            held[part.seen.star] -= np.einsum("nap,nab,nbq->npq", at, part.weight, at)
        start = None if near is None else near[0].kernel
        found = most_likely(*_some(parts, held), scale=scale, start=start), near is not None
    if found[0].gain < SHOWN:
        return None, found
    parts = [part.at(found[0].kernel) for part in parts]
    before = _covariance(fit, unknowns)
    less, pull = np.zeros((unknowns.size, unknowns.size)), np.zeros((unknowns.size, 1))
    for i, part in enumerate(parts):
        unknowns.add(less, part.seen, i, part.difference)
        y, residual = part.seen.y, part.seen.y - displaced[:, part.rows].T.ravel()
        pull += unknowns.gathered(part.seen, i, (part.inverse @ y - part.weighted(residual))[:, None])
    covariance = np.linalg.solve(np.eye(unknowns.size) - before @ less, before)
    covariance = (covariance + covariance.T) / 2
    return Field(found[0], parts, unknowns, before, covariance, (covariance @ pull)[:, 0]), found


def _parts(problem, blocks, state, displaced, weight):
    """The `_Part` of every exposure, with weights (3, n) of the observations."""
    parts = []
    jacobian, places = slopes_of(problem, blocks), undistorted(problem, state)
    held, stated = unpacked(problem.weight), unpacked(weight)
    for i in range(problem.n_exposures):
        part = problem.part(i)
        rows = np.arange(part.start, part.stop)[(weight[0] * weight[1] - weight[2] ** 2)[part] > 0]
        offsets, noise = (blocks.residual + displaced)[:, rows].T, np.linalg.inv(stated[rows])
        m = blocks.g_exposure.shape[1] // 2
        seen = Seen(places[rows], offsets, noise, problem.star[rows], jacobian[rows], blocks.values[:m, rows])
        parts.append(_Part(seen, rows, held[rows]))
    return parts


def slopes_of(problem, blocks):
    """Derivatives (n, 2, p) of what is measured by the numbers of its star."""
    w, out = problem.weight, np.zeros((problem.xy.shape[1], 2, problem.n_star))
    det = w[0] * w[1] - w[2] ** 2
    inverse = np.array([[w[1], -w[2]], [-w[2], w[0]]]) / np.where(det > 0, det, np.inf)
    plain = np.einsum("pbn,ban->pan", blocks.coupling, inverse)  # coupling has the weights
    for axis in (0, 1):
        out[:, axis] = problem.pulled(plain)[:, axis].T
    return out


def _covariance(fit, unknowns):
    """Of all stars and coefficients as the fit has them, (k, k)."""
    solve, out = response(fit.uncertainty.system, fit.result.gauge), np.empty((unknowns.size, unknowns.size))
    shape = unknowns.n_exposures, unknowns.n_coefficients
    for k, unit in enumerate(np.eye(unknowns.size)):
        stars, own = unknowns.split(unit[:, None])
        stars, own = solve(own.reshape(shape), np.ascontiguousarray(stars[:, :, 0].T))
        out[:, k] = np.concatenate([stars.T.ravel(), own.ravel()])
    return (out + out.T) / 2


def _some(parts, held):
    """Exposures and stars of which the likelihood is made: `Seen` and what holds the stars."""
    order = np.argsort([-len(part.rows) for part in parts], kind="stable")[:_EXPOSURES]
    count = np.bincount(np.concatenate([parts[i].seen.star for i in order]), minlength=len(held))
    shuffled = np.random.default_rng(0).permutation(len(held))
    stars = shuffled[np.argsort(-count[shuffled], kind="stable")][:_STARS]
    stars = np.sort(stars[count[stars] > 0])
    place = np.full(len(held), -1)
    place[stars] = np.arange(len(stars))
    seen = []
    for i in np.sort(order):
        each = parts[i].seen.subset(np.flatnonzero(place[parts[i].seen.star] >= 0))
        if len(each.star):
            seen.append(replace(each, star=place[each.star]))
    rest = held[stars]
    scale = np.einsum("spp->s", rest)[:, None, None] + np.einsum("nap,nap->", seen[0].slopes, seen[0].slopes)
    return seen, np.where(np.abs(rest) < 1e-9 * scale, 0.0, rest)


def responses(field, fit, root):
    """`relative_responses` of stars and coefficients to independent errors `root` (k, r)."""
    stars, coefficients = field.unknowns.split(root)
    weights = fit.uncertainty.weights_beside(stars.transpose(1, 0, 2))
    follow = Followed(stars.transpose(1, 0, 2), coefficients, None, None, None)
    return relative_responses(follow, np.eye(root.shape[1]), fit.result, weights, fit.problem.degree)


def fit_with_field(estimate, matches, options, *how):
    """What `estimate` gives, with the field of every exposure found beside; see `fit_with`.

    Returns
    -------
    Fit
        Its errors have those of the field, and it has the tables of these; its table the displacements.
    Found
        Of the field; its gain is below `SHOWN` where none is seen.
    rest : tuple
    """
    near, before, (begun, weight) = None, np.inf, _beginning(estimate, matches, options, *how)
    for _ in range(_ROUNDS):
        fit, *rest = begun or estimate(matches, options, *how)
        held = taken_off(fit)
        field, near = field_of(fit, held, near, scale=options.errors == "scale", weight=weight if begun else None)
        length = 0.0 if field is None else field.length
        if not begun and length < SMALL:
            break
        new = np.zeros_like(held) if field is None else field.displacements(held.shape[1])
        if length > before / 2:
            new = (held + new) / 2
        before = length if not begun else np.inf
        matches = displaced(fit, new)
        begun = None
    if length > _UNSETTLED:
        warn(f"turbulence has not settled: the last change was {length:.2g} of an error", ConvergenceWarning)
    return (fit if field is None else _with_field(fit, field)), near[0], rest


def _beginning(estimate, matches, options, *how):
    """What `estimate` gives with all observations and errors as large as its residuals, and the weights as stated.

    With errors that are far too small the residuals would tell of the plane, in second order, what is not so. None
    where there is none.
    """
    begun = unclipped(estimate, matches, options, *how)
    if begun is None:
        return None, None
    fit = begun[0]
    excess = fit.chi2 / max(fit.dof, 1) - 1
    if excess > _EXPLAINED:
        typical = np.sqrt(np.median(matches.observations.covariance[:, :2]) + options.error_floor**2)
        floor = np.hypot(options.error_floor, typical * np.sqrt(excess))
        begun = unclipped(estimate, matches, replace(options, error_floor=floor), *how) or begun
        if begun[0].problem.xy.shape != fit.problem.xy.shape:
            return None, None
    return begun, fit.problem.weight


def coefficient_scatter(kernel, problem, blocks, state):
    """What fields alone make the fitted coefficients of exposures scatter by, (2, n_modes), pixels, rms over these.

    Beyond the noise, and as if the stars were known: polynomials at these stars take part of a field.
    """
    check_size(problem)
    total = 0.0
    for part in _parts(problem, blocks, state, np.zeros_like(problem.xy), problem.weight):
        design = part.seen.design
        known = (design.T @ part.at(each).inverse @ design for each in (kernel, None))
        total = total + np.subtract(*(np.diag(np.linalg.inv(normal)) for normal in known))
    return np.sqrt(np.maximum(total / problem.n_exposures, 0)).reshape(2, -1)


def errors_of(fit, field):
    """``errors(i, places)`` of a fit with a field: `Field.errors` with those of all unknowns."""
    problem, whole = fit.problem, responses(field, fit, unit_errors(field.covariance))

    def errors(i, places):
        values = basis.values(problem.degree, *basis.normalize(places, problem.shapes[i]))
        return field.errors(i, places, values, whole)

    return errors


def with_errors(fit, field, errors):
    """The fit with the field in its errors, and in those of new positions, `errors_of`."""
    problem, parts = fit.problem, len(fit.matches.camera.detectors)
    added = responses(field, fit, unit_errors(field.covariance - field.before))
    known = fit.camera_errors or CameraErrors.nothing(parts, problem.n_exposures, problem.n_stars, added[1].shape[1])
    made = {}
    for i, (name, shape) in enumerate(zip(problem.names, problem.shapes, strict=True)):

        def covariances(q, i=i):
            alone, moved = errors(i, q)
            return alone + moved @ moved.mT

        made[name] = CovarianceTable.of(covariances, shape)
    return replace(
        fit,
        camera_errors=known.beside(*added, np.zeros((0, added[0].shape[2]))),
        shared_unknowns=fit.shared_unknowns + fit.dof - field.dof,
        tabled=Tabled(np.zeros_like(problem.xy), errors=made),
    )


def _with_field(fit, field):
    """The fit with the field in its errors, and with the tables of it."""
    problem, fit = fit.problem, with_errors(fit, field, errors_of(fit, field))
    tables = dict(zip(problem.names, field.tables(problem.shapes), strict=True))
    return replace(fit, tabled=replace(fit.tabled, own=tables))
