"""What is known of a map common to all exposures, and what only a convention holds.

A bend of the reference plane that every exposure compensates leaves all residuals as they are, so the positions alone
never determine it. What determines it is that single exposures depart from one static distortion by little::

    A_i = A_0 + B_n + N_i g + d_i,      d_i ~ N(0, Lambda_i + C_i)

A_i are the coefficients as they come out with the plane bent by g, N_i is how a bend changes those of exposure i,
Lambda is the scatter of single exposures and C_i the error of A_i. What the exposures of a night have in common beside
A_0 is ``B_n ~ N(0, Lambda_n)``; with one night there is none. A_0, one for each detector, has the caller's
prior: nothing (flat), a mean with its uncertainty, or a mean that is exact. With B and A_0 integrated out, g has a
Gaussian posterior whose mean is linear in the A_i: it is where ``R (A - A_0) = 0`` with the rows
``R = M' (D + E B E' + 1 S 1')^-1``, M the N_i one upon another, D the block diagonal of Lambda_i + C_i, E the nights of
the exposures and S the variance of A_0. These rows are the
constraints of the gauge, so that the positions and coefficients published are the posterior mean, and the variance of
g under them is the absolute error.

Without a prior the rows see only that in which the N_i differ, which dithers and rolls bring about. What they do not
determine to `LIMIT` pixels, rms over the stars, is *unknown*: there a convention holds the plane (the smallest dynamic
part, or dynamic parts that sum to zero, around the prior mean), and no error is quoted. Shears, for instance, are
unknown to any number of exposures of one orientation. Residuals of second order can determine such a direction after
all, where an unknown static distortion of many pixels meets very precise positions; then it is left to them
(`legdistort.solving.minimisers`), if they determine it to the same limit.

Shift, rotation and scale are always those of the nominal poses, or of a reference catalogue.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import eigh

from ...cameras.stated_errors import StaticSpread
from ...geometry import basis
from ...results.gauge import UnknownMap
from ..equations.criterion import complement

#: A direction whose posterior standard deviation exceeds so many pixels, rms over the stars and axes, is unknown.
LIMIT = 1.0
#: Residuals determine an unknown map if it gains so much chi2 (five standard errors) at the observed scale of errors.
GAIN = 25.0
#: Share of a pattern that must lie among the unknown maps for one of these to have its name.
_ALIKE = 0.9
_RIDGE = 1e-9  # of the metric: few stars leave maps without any displacement


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Departures of the exposures from a common static distortion, as a linear model of a common map.

    Attributes
    ----------
    motion : ndarray, shape (n_exposures, 2 n', 2 n)
        N_i, to the modes of exposures from those of the reference plane.
    others : ndarray, shape (n_exposures, K, 2 n')
        Orthonormal rows of all modes of an exposure but the similarities, which the poses carry.
    dynamic : ndarray, shape (n_exposures, 2 n', 2 n')
        Lambda_i.
    weight : ndarray, shape (n_exposures, K, K)
        Inverse of Lambda_i + C_i on these rows.
    night : ndarray of int, shape (n_exposures,), or None
        Night of every exposure, each detector with nights of its own.
    nightly : ndarray, shape (n_nights, K)
        Variance of B by night; none without nights.
    told : bool
        Whether anything tells that variance. Else the rows are those of independent exposures: it is no knowledge, but
        part of the error.
    group : ndarray of int, shape (n_exposures,)
        Detector of every exposure.
    static : StaticSpread
        Covariance of A_0 by detector: infinite where it is not known, zero where it is exact.
    maps : ndarray, shape (m, 2 n)
        Orthonormal rows: the maps that every exposure can compensate (null space), similarities aside.
    modes : `legdistort.geometry.plane_modes.PlaneModes`
        Of the reference plane.
    power : ndarray, shape (n, n)
        Mean products of the modes of the reference plane, over the stars.
    drifts : ndarray, shape (n_exposures, 2 n', m')
        How the m' common maps that change with time, motions and parallaxes of all stars, change the coefficients.
    """

    motion: np.ndarray
    others: np.ndarray
    dynamic: np.ndarray
    weight: np.ndarray
    night: np.ndarray
    nightly: np.ndarray
    told: bool
    group: np.ndarray
    static: StaticSpread
    maps: np.ndarray
    modes: object
    power: np.ndarray
    drifts: np.ndarray

    def rows(self, static):
        """Rows M' (D + E B E' + 1 S 1')^-1 of the constraints, (m + m', n_exposures, 2 n').

        For a `StaticSpread` of A_0. Those of the maps that change with time come last.
        """
        moved = self.others @ self.motion @ self.maps.T
        if self.drifts.shape[2]:
            moved = np.concatenate([moved, self.others @ self.drifts], axis=2)
        # D^-1 of what is moved, and of what all have in common, of which a share is left once B is integrated out
        weighted, common = self.weight @ moved, self.weight.copy()
        nights = StaticSpread.of_rows(self.nightly if self.told else self.nightly[:0])
        for owners, spread in ((self.night, nights), (self.group, static)):
            for owner, (directions, variance) in enumerate(zip(spread.directions, spread.variance, strict=True)):
                mine = owners == owner
                if variance.any() and mine.any():
                    share = common[mine]
                    taken = share @ _integrated(directions, variance, share.sum(axis=0))
                    weighted[mine] -= taken @ weighted[mine].sum(axis=0)
                    common[mine] -= taken @ share.sum(axis=0)
        return (weighted.mT @ self.others).transpose(1, 0, 2)

    def convention(self, kind):
        """Rows (m + m', n_exposures, 2 n') of a convention by itself: A_0 at the prior mean."""
        smallest = self.rows(self.static.exact())
        if kind == "mean":
            mean = np.einsum("bc,ikc,ika->bia", self.maps, self.others, self.others, optimize=True)
            return np.concatenate([mean, smallest[len(mean) :]])
        return smallest

    @cached_property
    def pointed(self):
        """Takes off modes of a map the similarity that they do to the stars, (2 n, 2 n)."""
        return _pointing_off(self.power, self.modes.similar.T)

    @cached_property
    def metric(self):
        """Mean square displacement of the stars, per axis, by modes (2 n,) squared, once a similarity is taken off."""
        return _metric(self.power, self.pointed)

    def solve(self, kind, released=None):
        """What is known of the common map, with constraints: `Constraints`.

        Parameters
        ----------
        kind : {"minimal", "mean"}
            Convention for what is not known.
        released : ndarray, shape (2 n, r), optional
            Unknown maps, for which no constraint is made.
        """
        held = self.convention(kind)
        if not (self.static.variance.any() and len(self.maps)):  # exact: the convention is the posterior mean
            return Constraints(held, self.maps.T, ())
        rows, n = self.rows(self.static), len(self.maps)
        flat = rows.reshape(len(rows), -1)
        information = flat[:n] @ (self.motion @ self.maps.T).reshape(flat.shape[1], -1)
        if self.drifts.shape[2]:  # with those that change with time fitted as well
            reached = np.concatenate([self.motion @ self.maps.T, self.drifts], axis=2)
            full = flat @ reached.reshape(flat.shape[1], -1)
            information = information - full[:n, n:] @ np.linalg.solve(full[n:, n:], full[n:, :n])
        metric = of_maps(self.metric, self.maps)
        curvature, vectors = eigh((information + information.T) / 2, metric)
        is_unknown = np.isinf(self.static.variance).any() & (curvature * LIMIT**2 < 1)
        known, unknown = vectors[:, ~is_unknown], vectors[:, is_unknown]
        if released is not None and unknown.shape[1]:
            inside = np.linalg.qr(unknown.T @ metric @ self.maps @ released)[0]
            unknown = unknown @ complement(inside.T).T
        rows = np.concatenate([np.tensordot(known.T, rows[:n], 1), np.tensordot(unknown.T, held[:n], 1), rows[n:]])
        return Constraints(
            rows, self.maps.T @ known, _named(self.maps.T @ unknown, self.pointed, self.metric, self.modes)
        )

    def covariance(self, known, poses, rates):
        """Covariance (2 n, 2 n) of what is known of the common map under its constraints, and that (m', m') of drifts.

        Parameters
        ----------
        known : Constraints
        poses : ndarray, shape (4 + c, n_exposures, 2 n)
            Constraints that hold the similarities and what changes them with time.
        rates : ndarray, shape (n_exposures, 2 n, c)
            How the latter changes the coefficients.
        """
        rows, similar = np.concatenate([known.rows, poses]), self.modes.similar.T
        maps = np.hstack([known.known, *(each.map[:, None] for each in known.unknown), similar])
        n, m = known.known.shape[1], self.drifts.shape[2]
        flat, by_exposure = rows.reshape(len(rows), -1), rows.transpose(1, 0, 2)
        inside = flat @ (self.dynamic @ by_exposure.mT).reshape(flat.shape[1], -1)
        on_modes = (by_exposure @ self.others.mT).transpose(1, 0, 2)
        for owners, spread in ((self.night, StaticSpread.of_rows(self.nightly)), (self.group, self.static)):
            for owner, covariance in enumerate(spread.finite):
                common = on_modes[:, owners == owner].sum(axis=1)
                inside += common @ covariance @ common.T
        reach = flat @ (self.motion @ maps).reshape(flat.shape[1], -1)
        if m or rates.shape[2]:
            also = np.concatenate([self.drifts, rates], axis=2).reshape(flat.shape[1], -1)
            reach = np.concatenate([reach, flat @ also], axis=1)
        inverse = np.linalg.inv(reach)
        back, drifting = self.pointed @ maps[:, :n] @ inverse[:n], inverse[maps.shape[1] :][:m]
        return back @ inside @ back.T, drifting @ inside @ drifting.T


@dataclass(frozen=True, eq=False)
class Constraints:
    """Constraints on all of a common map but its similarity, and what they hold that is not known.

    Attributes
    ----------
    rows : ndarray, shape (m, n_exposures, 2 n)
        Those that determine the known maps first.
    known : ndarray, shape (2 n, k)
        Known maps as columns.
    unknown : tuple of UnknownMap
        Of unit rms over stars and axes.
    """

    rows: np.ndarray
    known: np.ndarray
    unknown: tuple


def _integrated(directions, variance, total):
    """``(V^-1 + W)^-1`` for variances (K,), perhaps zero or infinite, along columns (K, K), and W (K, K)."""
    known = np.isfinite(variance)
    root = directions * np.sqrt(np.where(known, variance, 1.0))
    # without dividing by a variance of zero; one that is infinite has no V^-1
    inner = np.diag(np.where(known, 1.0, 0.0)) + root.T @ total @ root
    return root @ np.linalg.solve(inner, root.T)


def named(maps, gauge, positions):
    """Unknown maps (2 k, m) of a gauge, without those that are similarities, as a tuple of `UnknownMap`."""
    if not maps.shape[1] or len(maps) != 2 * gauge.n_modes:
        return ()
    pointed, metric = plane_metric(gauge, positions[np.isfinite(positions[:, 0])])
    moved, vectors = np.linalg.eigh(maps.T @ metric @ maps)
    kept = moved > 0.5
    return _named(maps @ vectors[:, kept] / np.sqrt(moved[kept]), pointed, metric, gauge.plane_modes())


def of_maps(metric, maps):
    """The metric (m, m) of maps, rows (m, 2 n), from that of their modes (2 n,) squared."""
    out = maps @ metric @ maps.T
    return out + _RIDGE * np.trace(out) / len(out) * np.eye(len(out))


def plane_metric(gauge, positions):
    """`Hierarchy.pointed` and `Hierarchy.metric` of a gauge and positions (n, 2)."""
    values = gauge.modes_at(positions)
    power = values @ values.T / values.shape[1]
    pointed = _pointing_off(power, gauge.plane_modes().similar.T)
    return pointed, _metric(power, pointed)


def _pointing_off(power, similar):
    """Takes off modes (2 n,) of a map the similarity that they do to the stars, (2 n, 2 n).

    `power` (n, n) are the mean products of the modes, over the stars, `similar` (2 n, 4) the similarities.
    """
    pulled = _times_power(similar.T, power)
    return np.eye(len(similar)) - similar @ np.linalg.pinv(pulled @ similar, rcond=1e-12, hermitian=True) @ pulled


def _metric(power, pointed):
    """Mean square displacement of the stars, per axis, by modes (2 n,) squared, once a similarity is taken off."""
    return _times_power(pointed.T, power) @ pointed / 2


def _times_power(rows, power):
    """Rows (k, 2 n), modes of x first, times the mean products of the modes (n, n) along either axis."""
    return (rows.reshape(-1, 2, len(power)) @ power).reshape(rows.shape)


def _named(maps, pointed, metric, modes):
    """Unknown maps (2 n, m) with names: turned, as far as they allow, into those that have one."""
    found, left = [], np.eye(maps.shape[1])
    for name, degree, pattern in _patterns(modes):
        inside = left @ (left.T @ (maps.T @ metric @ pattern))
        if inside @ inside > _ALIKE * (pattern @ metric @ pattern):
            inside /= np.linalg.norm(inside)
            found.append(UnknownMap(name, degree, pointed @ maps @ inside))
            left = left @ complement((left.T @ inside)[None]).T
    degrees = np.tile(modes.degrees, 2)
    for rest in (pointed @ maps @ left).T:
        power = np.bincount(degrees, rest**2)
        degree = int(power[1:].argmax()) + 1
        found.append(UnknownMap(f"degree {degree}" if degree > 1 else "shear", degree, rest))
    return tuple(sorted(found, key=lambda each: each.degree))


def determined_by_residuals(system, gauge):
    """Unknown maps that residuals of second order determine, as columns (2 n, r).

    To five standard errors, and to an error below `LIMIT`, both at the observed scale of errors if that is larger than
    the stated one.

    Parameters
    ----------
    system : Direct or Iterative
        At convergence.
    gauge : Gauge
        The convention in force, with some unknown map beyond the shears.
    """
    maps = np.stack([each.map for each in gauge.unknown_maps if each.degree > 1], axis=1, dtype=float)
    if is_noise(system):
        return maps[:, :0]
    moved = gauge.reach @ maps
    curvature, vectors = np.linalg.eigh(moved.T @ system.information @ moved)
    curvature = np.maximum(curvature, 1e-300)
    gain = (vectors.T @ (moved.T @ system.pull)) ** 2 / curvature
    left = (system.blocks.chi2 - gain.sum()) / system.dof
    scale = max(1.0, left)
    if not is_explained(system.blocks.chi2 - gain.sum(), system):
        return maps[:, :0]
    return maps @ vectors[:, (gain > GAIN * scale) & (curvature * LIMIT**2 > scale)]


def is_noise(system):
    """Whether the errors explain the residuals of a reduced system, or of `MostProbable`."""
    return system.dof <= 0 or system.blocks.chi2 < system.dof + 5 * np.sqrt(2 * system.dof)


def is_explained(chi2, system):
    """Whether a chi2 counts as explained: two per degree of freedom, or a tenth of that of a system.

    Else the residuals have another cause, such as modes that are not fitted, and bending the reference plane by
    hundreds of pixels can reduce them as well.
    """
    return chi2 <= max(2.0 * system.dof, 0.1 * system.blocks.chi2)


def _patterns(modes):
    """Maps with a name: the shears, and by degree those that keep angles, z^d of the complex plane z = x + iy.

    Those of several fields first in all of them alike, then in each.
    """
    top = basis.degree_of(modes.n)
    u, v, w = basis.quadrature(top)
    project = (basis.values(top, u, v) * w).T
    names = [("shear", 1, 1.0), ("shear", 1, 1j)] if top else []
    for d in range(2, top + 1):
        names += [(f"z^{d}", d, 1.0), (f"i z^{d}", d, 1j)]
    made = []
    for number, size in enumerate(modes.shapes):
        z = (u * size[1] + 1j * v * size[0]) / np.max(modes.shapes)
        fields = [turn * (z**d if d > 1 else np.conj(z)) for _, d, turn in names]
        rows = np.stack([np.concatenate([f.real @ project, f.imag @ project]) for f in fields]) if fields else []
        made.append(modes.of_field(rows, number) if fields else [])
    for (name, degree, _), *each in zip(names, *made, strict=True):
        yield name, degree, sum(each)
    if modes.n_fields > 1:
        for number, rows in enumerate(made, start=1):
            for (name, degree, _), row in zip(names, rows, strict=True):
                yield f"{name} of field {number}", degree, row
