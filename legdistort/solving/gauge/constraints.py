"""Making the gauge of a problem: constraints, their weights, and the poses that carry the similarities."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...cameras.stated_errors import StaticSpread
from ...exceptions import SolveError
from ...geometry import basis, similarity
from ...geometry.detector_modes import dynamic_basis, similarity_basis, similarity_poses
from ...geometry.plane_modes import PlaneModes
from ...results.gauge import Drift, Gauge
from ...runtime.checks import check_choice
from ...runtime.words import GAUGES
from ..equations import elimination
from ..equations.criterion import complement, pose_precision
from ..equations.problem import State
from .dynamic_scatter import conditional_errors, dynamic_covariance, influence
from .hierarchy import Hierarchy

#: Below this the constraints of the "mean" gauge leave a direction free.
_MEAN_LIMIT = 1e-3
_SETTLED = 0.01  # of a map that an exposure cannot compensate: less, and the data hardly depend on it
_NOTHING = 1e-9  # pixels
_CORNERS = np.array([[-1, 1, 1, -1.0], [-1, -1, 1, 1.0]])


def make(kind, problem, state, blocks, *, released=None, common=None, dynamic=None, all_drifts=False, settled=False):
    """The gauge at a state, its weights from the blocks of the criterion and the scatter seen there.

    Parameters
    ----------
    kind : {"minimal", "mean"}
    problem : Problem
    state : State
    blocks : Blocks
    released : ndarray, shape (2 n_modes, r), optional
        Maps of the reference plane that are not held, but left to the data.
    common : ndarray, shape (2 n_modes,), optional
        Map at which the plane is held, from where the constraints by themselves would have it.
    dynamic : ndarray, shape (n_exposures, 2 n_modes, 2 n_modes), optional
        Covariance of single exposures; estimated if not given.
    all_drifts : bool
        Hold those maps that change with time, too, that what is known of the motions of stars determines.
    settled : bool
        The convention as if the static distortion were exact and all modes scattered alike: nothing is estimated.

    Raises
    ------
    InputError
        For an unknown kind.
    SolveError
        If the "mean" gauge leaves a direction free, as for rolls that cancel.
    """
    check_choice(kind, GAUGES, "gauge")
    used = elimination.typical_stars(blocks.v)
    shared, shared_shears = problem.unknowns.shared, problem.own_degree == 0
    group, night = problem.detectors, problem.nights
    problem, state, blocks = own_part(problem, state, blocks)
    modes = reference_modes(problem, state)
    motion = _motion(problem, state.poses, modes)
    if kind == "mean":
        _check_mean(motion)
    similar, others = _by_shape(similarity_basis, problem), _by_shape(dynamic_basis, problem)
    held = np.array([problem.has_widths(i) for i in range(problem.n_exposures)])
    error = conditional_errors(blocks.u_data + (0 if problem.pose_width is None else pose_precision(problem)))
    maps = _taken_back(problem, motion, modes, shared_shears)
    static = _static_spread(problem, others, group, shared)
    if settled:
        static, dynamic = static.exact(), np.broadcast_to(np.eye(motion.shape[1]), error.shape)
    nightly, told = np.zeros((0, others.shape[1])), False
    drifting, drifts, rates = _drifts(problem, motion, others, shared_shears, all_drifts)
    if dynamic is None:
        moved = np.concatenate([others @ motion @ maps.T, others @ drifting @ drifts.T], axis=2)
        dynamic, nightly, told = dynamic_covariance(problem, state, error, moved, others, night, group, static)
    # about a static distortion that was found widths tell nothing of the plane, which exposures that show it hold
    told_by_widths = held & (problem.centre is None or (problem.floats and not all_drifts))
    spread = others @ (dynamic + np.where(told_by_widths, 0, 1)[:, None, None] * error) @ others.transpose(0, 2, 1)
    weight = np.where(told_by_widths, 1, influence(error, others))[:, None, None] * np.linalg.inv(spread)
    positions = state.positions.T[used]
    values = modes.at(positions)
    power = values @ values.T / values.shape[1]
    hierarchy = Hierarchy(
        motion, others, dynamic, weight, night, nightly, told, group, static, maps, modes, power, drifting @ drifts.T
    )
    poses = _pose_rows(kind, motion, drifting @ rates.T, error, similar, modes)
    known = hierarchy.solve(kind, released)
    rows = np.concatenate([known.rows, poses])
    covariance, drift_covariance = hierarchy.covariance(known, poses, drifting @ rates.T)
    pointed = without_rates(hierarchy.pointed, values, drifting.shape[2], modes.n_fields) @ drifts.T
    drift = (problem.terms.names, drifting, pointed @ drift_covariance @ pointed.T, drifts, rates)
    drift = Drift(*drift, n_fields=modes.n_fields) if problem.terms.n else None
    made = Gauge(
        kind,
        constraint=rows,
        motion=motion,
        dynamic=dynamic,
        box=modes.boxes[0],
        more_boxes=modes.boxes[1:] if modes.n_fields > 1 else None,
        covariance=covariance,
        unknown_maps=known.unknown,
        static=_in_a_word(static.variance, shared),
        prior=bool(held.any()),
        drift=drift,
        nights=float(np.sqrt(nightly.mean(axis=0).sum() / 8)) if len(nightly) else None,  # a mode has mean square 1/4
        nights_told=told or not len(nightly),
    )
    if common is None:
        return made
    moved = np.einsum("ika,ikb,ibc,c->ia", others, others, motion, common, optimize=True)  # poses take the rest
    return replace(made, values=-made.orthonormal @ moved.ravel())


def _drifts(problem, motion, others, shared_shears, all_drifts):
    """Common maps that change from exposure to exposure as the terms of the stars do, and that all can compensate.

    Where something is known of the motions of stars beforehand, that determines the maps, and none is left here unless
    all are wanted.

    Returns
    -------
    drifting : ndarray, shape (n_exposures, 2 n, q)
        How the modes of fields of these terms change the coefficients.
    drifts : ndarray, shape (m, q)
        Orthonormal rows: the maps.
    rates : ndarray, shape (c, q)
        Those that the poses carry: a common shift, rotation and expansion with time, the mean parallax.
    """
    terms, n, m = problem.terms, problem.n_modes, motion.shape[2] // 2
    free = np.flatnonzero(all_drifts | ~np.any(terms.precision, axis=1))
    if not len(free):
        return np.zeros((problem.n_exposures, 2 * n, 0)), np.zeros((0, 0)), np.zeros((0, 0))
    lift = terms.lift(m)[:, :, 2 * m :].reshape(problem.n_exposures, 2 * m, terms.n, m)
    drifting = motion @ lift[:, :, free].reshape(problem.n_exposures, 2 * m, -1)
    possible = np.eye(drifting.shape[2])[_changing(problem, free, m)]
    if problem.fixed is not None:
        moved = np.concatenate([rows @ each for rows, each in zip(problem.fixed, drifting, strict=True)])
        possible = _null_space(moved @ possible.T, _SETTLED) @ possible
    carried = _null_space((others @ drifting @ possible.T).reshape(-1, len(possible)), 1e-6) @ possible
    if shared_shears:
        return drifting, np.zeros((0, drifting.shape[2])), carried
    inside = complement(carried @ possible.T) @ possible
    return drifting, inside, carried


def _changing(problem, free, m):
    """Which maps (k m,) of k terms change from exposure to exposure: not those of a field of one date."""
    field, columns = problem.fields, problem.terms.columns[:, :, free]
    spread = [np.ptp(columns[field == number], axis=0).max(axis=0) for number in range(problem.n_fields)]
    changes = np.stack(spread, axis=1) > _NOTHING
    return np.repeat(changes[:, None], m // problem.n_fields, axis=1).ravel()


def without_rates(pointed, values, q, n_fields):
    """Takes off modes (q,) of maps that change with time the rates and mean parallax that they do to the stars, (q, q).

    `pointed` (2 n, 2 n) does so for a common map; `values` (n, n_stars) are the modes at the stars.
    """
    n = len(values)
    out, first = np.eye(q), 2 * n if q >= 2 * n else 0
    out[:first, :first] = pointed[:first, :first]
    for k in range(n_fields if q > first else 0):
        out[first + k, first + k :: n_fields] -= values[k::n_fields].mean(axis=1) / values[k].mean()
    return out


def _null_space(matrix, tolerance):
    """Orthonormal rows (k, n) that a matrix (m, n) sends to nothing, to a part of its largest singular value."""
    matrix = np.concatenate([matrix, np.zeros((matrix.shape[1], matrix.shape[1]))])
    _, size, rows = np.linalg.svd(matrix, full_matrices=False)
    return rows[size <= tolerance * size.max(initial=1e-300)]


def _taken_back(problem, motion, modes, shared_shears):
    """Orthonormal rows (m, 2 n): maps of the reference plane, similarities aside, in the null space."""
    similar = modes.similar
    if shared_shears:
        return np.zeros((0, len(similar.T)))
    if problem.fixed is None:
        return complement(similar)
    moved = np.concatenate([rows @ n for rows, n in zip(problem.fixed, motion, strict=True)])
    _, size, maps = np.linalg.svd(moved)
    n = np.count_nonzero(size > _SETTLED * np.sqrt(problem.n_exposures))
    if not n:
        return complement(similar)
    rows = maps[n:] - maps[n:] @ similar.T @ similar
    _, size, rows = np.linalg.svd(rows)
    return rows[: np.count_nonzero(size > 1e-6)]


def _static_spread(problem, others, group, shared):
    """`StaticSpread` of the static distortion of every detector: infinite where it is not known beforehand.

    Where exposures share it and its uncertainty is not stated, it is sought and not known; neither is that of a single
    exposure, from which it may depart by any amount, unless widths say by how much.
    """
    each = problem.errors_of_statics.spread(others, np.arange(problem.n_exposures))
    first = np.unique(group, return_index=True)[1]
    variance = np.zeros((len(first), others.shape[1]))
    np.maximum.at(variance, group, each.variance)
    if shared or (problem.n_exposures == 1 and not problem.has_widths(0)):
        variance[variance == 0] = np.inf
    return StaticSpread(each.directions[first], variance)


def _in_a_word(static, shared):
    """What was known of the static distortion beforehand, see `Gauge`."""
    if np.isinf(static).any():
        return "fitted" if shared else "none"
    return "uncertain" if static.any() else "exact"


def pose_rows(problem, state, blocks):
    """Orthonormal rows (4 n_fields + c, n_exposures, 2 n_modes) on coefficients that hold the plane by the poses.

    And c rates at which poses would carry it with time, where nothing is known of the motions of stars.
    """
    modes = reference_modes(problem, state)
    motion, error = _motion(problem, state.poses, modes), conditional_errors(blocks.u_data)
    drifting, _, rates = _drifts(problem, motion, _by_shape(dynamic_basis, problem), problem.own_degree == 0, False)
    rows = _pose_rows("minimal", motion, drifting @ rates.T, error, _by_shape(similarity_basis, problem), modes)
    return np.linalg.qr(rows.reshape(len(rows), -1).T)[0].T.reshape(rows.shape)


def _pose_rows(kind, motion, rates, error, similar, modes):
    """Rows (4 n_fields + c, n_exposures, 2 n) that hold the plane by the poses, mean over the exposures.

    `rates` (n_exposures, 2 n, c) are how what changes it with time, and poses carry, changes coefficients.
    """
    weight = influence(error, similar)[:, None, None] * (similar.mT @ similar)
    moved = rates.mT if kind == "mean" else np.concatenate([modes.similar @ motion.mT, rates.mT], axis=1)
    rows = moved @ weight
    return np.concatenate([similar, rows] if kind == "mean" else [rows], axis=1).transpose(1, 0, 2)


def own_part(problem, state, blocks):
    """The same with those modes alone that can compensate a common map, where exposures share the others."""
    unknowns = problem.unknowns
    if not unknowns.shared:
        return problem, state, blocks
    n = basis.n_modes(unknowns.gauge_degree)
    rows = np.concatenate([np.arange(n), problem.n_modes + np.arange(n)])
    sigma, static, mean = problem.prior_sigma, problem.static_covariance, problem.static_errors
    own = replace(
        problem,
        degree=unknowns.gauge_degree,
        prior_mean=problem.prior_mean[:, :, :n],
        prior_sigma=None if sigma is None else sigma[:, :, :n],
        static_covariance=None if static is None else static[np.ix_(rows, rows)],
        static_errors=None if mean is None else mean.to_modes(n),
        own_degree=None,
        group=None,
    )
    inner = replace(blocks, u=blocks.u[:, rows[:, None], rows], u_data=blocks.u_data[:, rows[:, None], rows])
    return own, State(state.stars, state.coefficients[:, :, :n], state.poses), inner


def reference_modes(problem, state):
    """`PlaneModes` of the boxes of the reference plane that the detectors of every field cover."""
    scale = np.sqrt(np.abs(np.linalg.det(state.poses[:, :, :2])))
    usual = np.abs(np.log(scale / np.median(scale))) < np.log(2)  # a mismatched exposure may have any scale
    corners, boxes = similarity.apply_inverses(state.poses, _by_shape(_corners, problem)), []
    for field in range(problem.n_fields):
        mine = problem.fields == field
        seen = corners[mine & usual if np.any(mine & usual) else mine].reshape(-1, 2)
        low, high = seen.min(axis=0), seen.max(axis=0)
        boxes.append(np.stack([(low + high) / 2, (high - low) / 2]))
    return PlaneModes(np.stack(boxes), problem.n_modes)


def _by_shape(function, problem, n=None):
    """``function(shape, n)`` of every exposure, by default of the number of modes, stacked; read-only."""
    n, shapes = problem.n_modes if n is None else n, list(dict.fromkeys(problem.shapes))
    made = [function(shape, n) for shape in shapes]
    if len(made) == 1:
        return np.broadcast_to(made[0], (len(problem.shapes), *made[0].shape))
    return np.stack(made)[[shapes.index(shape) for shape in problem.shapes]]


def _motion(problem, pose_list, modes):
    """N_i, to first order in the distortion: a displacement g of the reference plane moves q by R g(T^-1 q)."""
    degree, size, box = problem.degree, problem.n_modes, modes.boxes[problem.fields]
    linear = pose_list[:, :, :2]
    back = similarity.apply_inverses(pose_list, _by_shape(_nodes, problem, degree))
    reference = basis.values(degree, *np.moveaxis((back - box[:, None, 0]) / box[:, None, 1], -1, 0))
    mixing = _projection(degree).T @ reference.transpose(1, 2, 0)
    return _of_fields(problem, np.einsum("iab,imn->iambn", linear, mixing)).reshape(-1, 2 * size, 2 * modes.size)


def _of_fields(problem, motion):
    """Maps (n_exposures, 2, m, 2, n) from the modes of the field of every exposure, on those of all fields."""
    if problem.n_fields == 1:
        return motion
    out = np.zeros((*motion.shape, problem.n_fields))
    for field in range(problem.n_fields):
        mine = problem.fields == field
        out[mine, ..., field] = motion[mine]
    return out


def motion_with_distortion(problem, pose_list, coefficients, modes):
    """N_i where a distortion d, A_i (n_exposures, 2, n_all), carries q to a place that moves by (I + grad d) R g."""
    degree, n, top = problem.degree, problem.n_modes, basis.degree_of(coefficients.shape[2])
    box = modes.boxes[problem.fields]
    exact = degree + top // 2  # for products of a mode, a map and a slope
    u, v, w = basis.quadrature(exact)
    by_u, by_v = basis.gradients(top, u, v)[1:]
    slope = np.stack([coefficients @ by_u, coefficients @ by_v], axis=2)  # (exposure, axis, along, node)
    moved = np.eye(2)[:, :, None] + slope * (2 / problem.size)[:, None, :, None]
    moved = np.einsum("iack,icb->iabk", moved, pose_list[:, :, :2])
    back = similarity.apply_inverses(pose_list, _by_shape(_nodes, problem, exact))
    reference = basis.values(degree, *np.moveaxis((back - box[:, None, 0]) / box[:, None, 1], -1, 0)).transpose(1, 2, 0)
    out = (basis.values(degree, u, v) * w * moved[:, :, :, None]) @ reference[:, None, None]
    return _of_fields(problem, out.swapaxes(2, 3)).reshape(-1, 2 * n, 2 * modes.size)


def _check_mean(motion):
    """Refuse the "mean" gauge where the mean of N_i loses a direction that single exposures have."""
    mean = motion.mean(axis=0)
    power = np.einsum("iba,ibc->ac", motion, motion) / len(motion)
    ratio = np.linalg.eigvals(np.linalg.solve(power, mean.T @ mean)).real.min()
    if ratio < _MEAN_LIMIT:
        raise SolveError(
            "the published convention leaves a common map of the reference plane free: the orientations of these "
            f"exposures cancel in the mean (ratio {max(ratio, 0):.1e}), as for rolls of 0, 90, 180 and 270 degrees; "
            "use legdistort.solve"
        )


def absorb_similarities(problem, state):
    """Move the similarity part of every dynamic distortion into its pose; D_i stays what it is.

    ``q' = S q`` and ``A' b(q') = q - q' + A b(S^-1 q')``, a polynomial of the same degree, so the change is exact
    (prior modes beyond the fitted degree excepted: they stay with the detector). A distortion that exposures share
    stays with the detector as a whole, so that D_i becomes what `Unknowns.at` states for a pose.

    Returns
    -------
    State
    """
    n_modes = problem.n_modes
    degree = basis.degree_of(state.coefficients.shape[2])
    nodes, project = _by_shape(_nodes, problem, degree), _projection(degree)
    similar = _by_shape(similarity_poses, problem)
    pixels = problem.size[:, None]
    coefficients, pose_list = state.coefficients.copy(), state.poses
    for _ in range(4):
        departure = (coefficients - problem.prior_mean)[:, :, :n_modes]
        shift = (similar @ departure.reshape(len(departure), -1, 1)).reshape(-1, 2, 3)
        # what shifts by so many pixels, and turns and stretches so little over the detector, stays
        if max(np.abs(shift[:, :, 2]).max(), np.abs(shift[:, :, :2]).max() * pixels.max()) < _NOTHING:
            break
        shift = np.eye(2, 3) + shift
        pose_list = similarity.compose(shift, pose_list)
        if problem.unknowns.shared:  # what is common stays with the detector
            left = without_similarities(problem, departure.reshape(len(departure), -1)).reshape(departure.shape)
            coefficients[:, :, :n_modes] += left - departure
            continue
        linear = np.linalg.inv(shift[:, :, :2])
        old = (nodes - shift[:, None, :, 2]) @ linear.transpose(0, 2, 1)
        values = basis.values(degree, *np.moveaxis((2 * old + 1) / pixels - 1, -1, 0))
        changed = ((old - nodes).transpose(0, 2, 1) + coefficients @ values.transpose(1, 0, 2)) @ project
        coefficients[:, :, :n_modes] = changed[:, :, :n_modes]
    if problem.fixed is not None:
        for a, mean, rows in zip(coefficients, problem.prior_mean, problem.fixed, strict=True):
            departure = (a - mean)[:, :n_modes].ravel()
            a[:, :n_modes] -= (rows.T @ (rows @ departure)).reshape(2, -1)
    return State(state.stars, coefficients, pose_list)


def without_similarities(problem, coefficients):
    """Coefficients (n_exposures, 2 n_modes) without what poses carry."""
    similar = _by_shape(similarity_basis, problem)
    return coefficients - (similar.mT @ (similar @ coefficients[..., None]))[..., 0]


@lru_cache
def _nodes(shape, degree):
    """Nodes of the quadrature of polynomials on a detector, pixels (k, 2)."""
    u, v, _ = basis.quadrature(degree)
    return basis.denormalize(u, v, shape)


def _corners(shape, _):
    """Corners of a detector, pixels (4, 2)."""
    return basis.denormalize(*_CORNERS, shape)


@lru_cache
def _projection(degree):
    """Values at the nodes of the quadrature -> coefficients, shape (k, n_modes)."""
    u, v, w = basis.quadrature(degree)
    return (basis.values(degree, u, v) * w).T
