"""Start values of a minimisation, and exposures that are too far off to take part in one."""

import itertools
from dataclasses import replace

import numpy as np

from ..exceptions import FoldError, SolveError
from ..geometry import similarity
from ..geometry.detector_modes import detector_corners
from ..geometry.distortion import Distortion
from .equations.elimination import inverse_star_blocks
from .equations.problem import State
from .equations.star_terms import outer_packed, packed, symmetric_times

#: Distances that the typical one of an exposure is found from.
_ENOUGH = 300
#: Order in its slopes to which a distortion is taken out for a start; of one that was solved for, with stars that are
#: to be where they were then.
_ROUGHLY, _CLOSELY = 2, 8


def start(problem, nominal, *, robust=False):
    """Start values: coefficients where the problem begins, poses refined to one another, positions their weighted mean.

    Parameters
    ----------
    problem : Problem
    nominal : ndarray, shape (n_exposures, 2, 3)
    robust : bool
        Give deviant observations less weight, so that mismatched exposures do not drag the others along.

    Returns
    -------
    State
    ndarray, shape (n_exposures,)
        Median distance of the stars of an exposure, or of some hundreds of them, from their mean positions,
        detector pixels.

    Raises
    ------
    SolveError
        If the prior cannot be inverted at the observed positions.
    """
    _check_prior(problem)
    begun = problem.prior_mean if problem.begun is None or problem.fixed is not None else problem.begun
    q = undistorted(replace(problem, prior_mean=begun), _ROUGHLY if begun is problem.prior_mean else _CLOSELY)
    full = problem.weight[:2].sum(axis=0) / 2
    current, weight = np.array(nominal, dtype=float), full
    n_sweeps = 12 if robust else 1
    for sweep in range(n_sweeps + 1):
        positions = mean_positions(problem, current, q, weight)
        if sweep == n_sweeps:
            break
        if robust:
            distance2 = distances(problem, current, q, positions)
            weight = full / (1 + distance2 / (2 * np.median(distance2) + 1e-12))
        current = refine(problem, current, q, positions, weight)
    distance2 = distances(problem, current, q, positions)
    typical = np.sqrt([similarity.median(_some(distance2[problem.part(i)])) for i in range(problem.n_exposures)])
    back = [
        _common_similarity(problem, nominal, current, full, misplaced(problem, typical), field)
        for field in range(problem.n_fields)
    ]
    common = np.stack(back)
    current = similarity.compose(current, common[problem.fields])
    if problem.terms.n:
        stars = moving_stars(problem, current, q, weight)
    else:
        stars = similarity.apply_each(similarity.invert(common)[problem.field_of_stars], positions.T).T
    return State(stars, begun.copy(), current), typical


def _some(values):
    """Some hundreds of many values, evenly taken: enough for a typical one."""
    return values[:: max(1, len(values) // _ENOUGH)]


def _check_prior(problem):
    """Raise `SolveError` if the map of a prior folds."""
    distinct = {}
    for shape, mean, name in zip(problem.shapes, problem.prior_mean, problem.names, strict=True):
        distinct.setdefault((shape, mean.tobytes()), Distortion(mean, shape, name))
    for distortion in distinct.values():
        try:
            distortion.check_fold()
        except FoldError as error:
            raise SolveError(f"the prior is not usable: {error}") from None


def undistorted(problem, order=_ROUGHLY):
    """Positions (2, n) with the prior distortion taken out to some order in its slopes."""
    if not np.any(problem.prior_mean):
        return problem.xy
    if problem.uses_compiled_loops:
        from .equations import compiled

        return compiled.undistorted(problem, order)
    q, n = np.empty_like(problem.xy), problem.n_exposures
    alike = [(shape, mean.tobytes()) for shape, mean in zip(problem.shapes, problem.prior_mean, strict=True)]
    ends = [i for i in range(1, n) if alike[i] != alike[i - 1]]
    for first, last in itertools.pairwise([0, *ends, n]):  # exposures of one prior are done together
        distortion = Distortion(problem.prior_mean[first], problem.shapes[first])
        part = slice(problem.start[first], problem.start[last])
        found = x = problem.xy[:, part].T
        for _ in range(order):
            found = x - distortion(found) + found
        q[:, part] = found.T
    return q


def refine(problem, pose_list, q, positions, weight):
    """Poses (n_exposures, 2, 3) that carry star positions (2, n_stars) to undistorted ones q (2, n), parity kept."""
    parity = np.where(np.linalg.det(pose_list[:, :, :2]) > 0, 1, -1)
    fitted = similarity.similarity_of(*moments(problem, q, weight, positions), parity)
    return np.where(np.isfinite(fitted).all(axis=(1, 2), keepdims=True), fitted, pose_list)


def moments(problem, q, weight, positions):
    """Moments of the similarities of all exposures that carry star positions (2, n_stars) to undistorted ones q (2, n).

    Returns
    -------
    mean_s, mean_t : ndarray, shape (n_exposures, 2)
    cross : ndarray, shape (n_exposures, 2, 2)
        See `legdistort.geometry.similarity.similarity_of`; NaN where the stars lie at one place.
    """
    if problem.uses_compiled_loops:
        from .equations import compiled

        return compiled.moments(problem, q, weight, positions)
    first, source = problem.start[:-1], positions[:, problem.star]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = weight / np.add.reduceat(weight, first)[problem.exposure]
        means = [np.add.reduceat(share * each, first, axis=1) for each in (source, q)]
        s, t = (each - mean[:, problem.exposure] for each, mean in zip((source, q), means, strict=True))
        cross = np.add.reduceat(weight * t[:, None] * s, first, axis=2) / np.add.reduceat(
            weight * s**2, first, axis=1
        ).sum(axis=0)
    return means[0].T, means[1].T, np.moveaxis(cross, 2, 0)


def _common_similarity(problem, nominal, refined, weights, astray, field):
    """The similarity of a field of the plane that brings refined poses back, in the mean, to the nominal ones.

    Exposures of like quality, by the weights (n,) of their observations, count equally, bad ones less, misplaced ones
    not at all.
    """
    variance = 1 / np.add.reduceat(weights, problem.start[:-1])
    weight = 1 / (variance + 10 * np.median(variance))
    weight[astray | (problem.fields != field)] = 0
    corners = detector_corners(problem.shapes)
    old, new = (similarity.apply_inverses(poses, corners).reshape(-1, 2) for poses in (nominal, refined))
    return similarity.fit_similarity(old, new, weights=np.repeat(weight, 4), parity=1)


def far_off(problem, typical):
    """Exposures whose stars lie farther from their means than 1 % of the detector, which few distortions explain.

    Parameters
    ----------
    problem : Problem
    typical : ndarray, shape (n_exposures,)
        As `start` gives it.

    Returns
    -------
    ndarray of bool, shape (n_exposures,)
    """
    return typical > 0.01 * np.max(problem.shapes, axis=1)


def misplaced(problem, typical):
    """Exposures that are `far_off`, and ten times farther than usual: shape (n_exposures,)."""
    return (typical > 10 * np.median(typical)) & far_off(problem, typical)


def distances(problem, pose_list, q, positions):
    """Squared distance (n,) of undistorted positions from their star's mean position, detector pixels."""
    if problem.uses_compiled_loops:
        from .equations import compiled

        return compiled.distances(problem, pose_list, q, positions)
    return ((q - posed(problem, pose_list, positions[:, problem.star])) ** 2).sum(axis=0)


def posed(problem, pose_list, xy):
    """Positions (2, n) through the pose of their exposure."""
    out = np.empty_like(xy)
    for i, pose in enumerate(pose_list):
        part = problem.part(i)
        np.matmul(pose[:, :2], xy[:, part], out=out[:, part])
        out[:, part] += pose[:, 2:]
    return out


def moving_stars(problem, pose_list, q, weight):
    """Unknowns (2 + k, n_stars) of stars that move, each fitted to its undistorted positions carried back."""
    n = problem.n_star
    v, g = np.zeros((n * (n + 1) // 2, problem.n_stars)), np.zeros((n, problem.n_stars))
    for i, pose in enumerate(pose_list):
        part, inverse = problem.part(i), similarity.invert(pose)
        back = inverse[:, :2] @ q[:, part] + inverse[:, 2:]
        place = np.concatenate([np.eye(2), problem.terms.columns[i]], axis=1)
        star, w = problem.star[part], weight[part]
        v[:, star] += sum(outer_packed(row)[:, None] for row in place) * w
        g[:, star] += problem.terms.pull(i, w * back)
    diagonal = np.diag(packed(n))[2:]
    v[diagonal] += problem.terms.precision
    return symmetric_times(inverse_star_blocks(v), g)


def mean_positions(problem, pose_list, q, weight):
    """Weighted mean (2, n_stars) of undistorted positions carried back to the reference plane."""
    total, *sums = carried_back(problem, similarity.invert(pose_list), q, weight)
    return np.divide(sums, total, out=np.zeros_like(sums), where=total > 0)


def carried_back(problem, inverses, q, weight):
    """Sums (3, n_stars) over observations: of weights (n,), and of weighted positions q (2, n), poses taken back."""
    if problem.uses_compiled_loops:
        from .equations import compiled

        return compiled.carried_back(problem, inverses, q, weight)
    return problem.by_star([weight, *(weight * posed(problem, inverses, q))])
