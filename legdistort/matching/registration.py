"""Two star lists of the same sky laid on one another: seeds, growth, and a test against chance.

A candidate similarity (from a header or `legdistort.matching.similarity_candidates`) grows to a
polynomial map while the tolerance shrinks: all neighbours within reach count
with a Gaussian weight, so that a few wrong ones do not lead astray. The growth
starts with bright stars, or without fluxes with one corner of the field, where
neighbours are unambiguous. What stands at the end must be far above chance.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..geometry import similarity
from .similarity_candidates import offset_candidates, triangle_candidates
from .star_lists import Warp, allowed_degree, fit_warp

#: How far above chance the number of pairs must be, ``k ln(k/expected) - k + expected`` (natural units,
#: k = pairs less those that fix the map). All seeds of 500 pairs of unrelated lists reached 13.
MIN_STRENGTH = 18.0
#: Part of the shorter list, within the overlap, that must be paired: a map that holds in a corner only is no match.
MIN_SHARE = 0.15
#: Where so large a part of it is paired nothing is left to be looked for.
COMPLETE_SHARE = 0.97
#: Stars in the first round of the growth, and most that take part in a round.
FIRST, MOST = 100, 2000
#: Largest degree of the map by the round of the growth (0: similarity); see also `star_lists.NEEDED`.
LADDER = (0, 0, 0, 0, 0, 0, 1, 1, 2, 2, 3, 3, 3, 5)
#: Part of the field over which distortion and rough seeds may displace stars in the first round (standard deviation).
REACH = 0.012


@dataclass(frozen=True, eq=False)
class Registration:
    """Pairs of two lists and the map that carries one to the other.

    Attributes
    ----------
    source, target : ndarray of int, shape (n,)
        Rows of the two lists that are the same star.
    distance : ndarray, shape (n,)
        What the map leaves, pixels.
    warp : Warp
    tolerance : float
        Pixels.
    strength : float
        How far above chance the number of pairs is (see `MIN_STRENGTH`).
    share : float
        Part of the shorter list, within the overlap, that is paired.
    """

    source: np.ndarray
    target: np.ndarray
    distance: np.ndarray
    warp: Warp
    tolerance: float
    strength: float
    share: float

    @property
    def is_complete(self):
        """Whether hardly a star that both lists can share is left over."""
        return self.share >= COMPLETE_SHARE

    def __repr__(self):
        return f"<Registration: {len(self.source)} pairs within {self.tolerance:.2f} pix, strength {self.strength:.0f}>"


def register(source, target, *, guess=None, blind=True, tolerance=None):
    """Find the stars that two lists have in common.

    Parameters
    ----------
    source, target : StarList
    guess : ndarray, shape (2, 3), optional
        Pose source -> target, from headers; it is tried first, then its orientation alone, then no pose.
    blind : bool
        Also try any rotation and a flip.
    tolerance : float, optional
        Largest distance of a pair after the growth, pixels; from the scatter if not given.

    Returns
    -------
    Registration or None
        None when nothing stands out from chance.
    """
    moving = _moving(source, target)
    for seeds in (_near_seeds, _blind_seeds)[: 1 + blind]:
        if moving is not None:
            part, still = source.subset(moving[0]), target.subset(moving[1])
            found = _first(part, still, seeds(part, still, guess), tolerance)
            # what stands at the same pixel in both is hot, not a star, when the rest of the field has moved
            if found and np.median(np.linalg.norm(found.warp(part.xy) - part.xy, axis=1)) > 2:
                rows, columns = (np.flatnonzero(mask) for mask in moving)
                return replace(found, source=rows[found.source], target=columns[found.target])
        found = _first(source, target, seeds(source, target, guess), tolerance)
        if found:
            return found
    return None


def _first(source, target, seeds, tolerance):
    """The first seed that grows to something significant."""
    if min(len(source), len(target)) < 5:
        return None
    grown = (continue_from_pose(source, target, pose, order, tolerance=tolerance) for pose, order in seeds)
    found = next((g for g in grown if g is not None), None)
    return None if found is None else _spread(source, target, found, tolerance)


def _spread(source, target, found, tolerance):
    """Grow again from the pairs while that brings more: a seed some degrees off holds in part of the field only."""
    while not found.is_complete:
        p = source.xy[found.source]
        if len(p) > MOST / 2 and np.all(
            p.std(axis=0) > 0.95 * source.xy[target.on_detector(found.warp(source.xy))].std(axis=0)
        ):
            return found
        order = None if source.ranking is not None else outwards(source, p.mean(axis=0))
        pose = similarity.robust_similarity(p, target.xy[found.target])
        again = continue_from_pose(source, target, pose, order, tolerance=tolerance)
        if again is None or len(again.source) <= len(found.source):
            return found
        enough = len(again.source) < 1.05 * len(found.source)
        found = again
        if enough:
            break
    return found


def continue_from_pose(source, target, pose, order=None, *, tolerance=None):
    """Registration of two lists of which a rough pose is known.

    Parameters
    ----------
    source, target : StarList
    pose : ndarray, shape (2, 3)
    order : ndarray of int, optional
        As in `grow`.
    tolerance : float, optional
        As in `register`.

    Returns
    -------
    Registration or None
    """
    at_once = settle(source, target, Warp.from_pose(pose, source.shape), np.inf, tolerance=tolerance)
    if at_once is not None and at_once.is_complete:
        return at_once
    grown = grow(source, target, pose, order)
    return None if grown is None else settle(source, target, *grown, tolerance=tolerance)


def continue_from_pairs(source, target, rows, columns, *, tolerance=None):
    """Registration of two lists of which some pairs are known.

    Parameters
    ----------
    source, target : StarList
    rows, columns : ndarray of int, shape (n,)
        Rows of source and target that are probably the same star; wrong ones do little harm.
    tolerance : float, optional
        As in `register`.

    Returns
    -------
    Registration or None
    """
    p, q = source.xy[rows], target.xy[columns]
    parity = np.sign(np.linalg.det(similarity.fit_similarity(p, q)[:, :2]))
    weights, degree, scatter = np.ones(len(p)), min(allowed_degree(len(p)), 3), np.inf
    for _ in range(4):
        warp = fit_warp(p, q, source.shape, degree, weights=weights, width=1.0, parity=parity)
        distance = np.linalg.norm(warp(p) - q, axis=1)
        before, scatter = scatter, similarity.median(distance) / 1.18 + 1e-6
        if abs(scatter - before) < 0.1 * scatter:
            break
        weights = 1 / (1 + (distance / (2 * scatter)) ** 2)
    reach = 5 * scatter
    at_once = _judged(source, target, warp, min(max(reach, 0.5), _farthest(target)), tolerance)
    if at_once is not None and at_once.is_complete:
        return at_once
    return settle(source, target, warp, max(reach, 1.0), tolerance=tolerance)


def _moving(source, target, radius=0.6):
    """Masks of what does not stand at the same pixel in both; None if nothing does (hot pixels do)."""
    distance, row = target.tree.query(source.xy, distance_upper_bound=radius)
    fixed = np.isfinite(distance)
    if np.count_nonzero(fixed) < 3:
        return None
    other = np.ones(len(target), bool)
    other[row[fixed]] = False
    return ~fixed, other


def _selections(source, target):
    """Rows (of source, of target) for seeds, with the order in which the growth takes the source's stars.

    Bright stars first; without fluxes, or when these fail, the stars around five places.
    """
    if max(len(source), len(target)) <= 1.5 * FIRST:
        yield np.arange(len(source)), np.arange(len(target)), None
        return
    if source.ranking is not None and target.ranking is not None:
        yield source.ranking[:FIRST], target.ranking[:FIRST], None
    middle, half = (np.array(source.shape[::-1]) - 1) / 2, np.array(source.shape[::-1]) / 2
    for place in ((0, 0), (-0.6, -0.6), (0.6, 0.6), (0.6, -0.6), (-0.6, 0.6)):
        order = outwards(source, middle + half * place)
        yield order[:FIRST], np.arange(len(target)), order


def _near_seeds(source, target, guess):
    """The guess, then shifts at its orientation, then shifts without any rotation."""
    if guess is not None:
        yield guess, None if source.ranking is not None else outwards(source)
    for selection in _selections(source, target):
        yield from _shifts(source, target, guess, selection)
        if selection[2] is None:
            break


def _blind_seeds(source, target, guess):
    for selection in _selections(source, target):
        rows, others, order = selection
        if order is not None:
            yield from _shifts(source, target, guess, selection)
        for pose in triangle_candidates(source.xy[rows], target.xy[others]):
            yield pose, order


def _shifts(source, target, guess, selection):
    rows, others, order = selection
    orientations = [np.eye(2)] if guess is None else [guess[:, :2], np.eye(2)]
    if guess is not None and np.abs(guess[:, :2] - np.eye(2)).max() < 0.03:
        orientations.pop()
    for m in orientations:
        turned = source.xy[rows] @ m.T
        for shift in offset_candidates(turned, target.xy[others], size=max(np.ptp(turned, axis=0))):
            yield np.column_stack([m, shift]), order


def outwards(stars, middle=None):
    """Rows of a list from `middle`, or from the mean of its positions, outwards."""
    middle = stars.xy.mean(axis=0) if middle is None else middle
    return np.argsort(((stars.xy - middle) ** 2).sum(axis=1), kind="stable")


def grow(source, target, pose, order=None):
    """From a rough pose to a polynomial map.

    Parameters
    ----------
    source, target : StarList
    pose : ndarray, shape (2, 3)
    order : ndarray of int, optional
        Order in which stars of the source join in, outwards from where the pose is good; brightest first if not given.

    Returns
    -------
    warp : Warp
    tolerance : float
        Where the pairs stand out best from chance; None instead of both when they never do.
    """
    ranked = order is None and source.ranking is not None and target.ranking is not None
    order = source.ranking if ranked else np.arange(len(source)) if order is None else order
    parity = np.sign(np.linalg.det(pose[:, :2]))
    warp = Warp.from_pose(pose, source.shape)
    total, n, width = len(source), min(FIRST, len(source)), REACH * max(source.shape)
    best, best_strength = None, 0.0
    for stage in range(100):
        chosen = order[:n][:: -(-n // MOST)]
        others = target.ranking[: 2 * n] if ranked else slice(None)
        tree = target.tree if len(target.xy[others]) == len(target) else cKDTree(target.xy[others])
        width = min(width, 0.35 * np.sqrt(target.area / tree.n))
        warp = _fit_near(source, chosen, tree, warp, width, LADDER[min(stage, len(LADDER) - 1)], parity)
        if warp is None:
            break
        if stage < 5:
            continue
        if stage == 5 or n == total:
            radius, strength = _best_radius(warp(source.xy[chosen]), tree, width, warp.n_fixing)
        if stage == 5 and strength < 3:
            return None
        if n < total:
            n = min(int(1.6 * n), total)
        else:
            if strength > best_strength:
                best, best_strength = (warp, radius), strength
            elif strength < 0.7 * best_strength or width < 0.1:
                break
            width *= 0.65
    return best


def _fit_near(source, chosen, tree, warp, width, degree, parity):
    """One weighted fit to all neighbours within reach of the present map."""
    xy = source.xy[chosen]
    distance, row = tree.query(warp(xy), k=min(4, tree.n), distance_upper_bound=2.5 * width)
    distance, row = distance.reshape(len(xy), -1), row.reshape(len(xy), -1)
    near = np.isfinite(distance)
    w = np.where(near, np.exp(-0.5 * (np.where(near, distance, 0) / width) ** 2), 0)
    w /= w.sum(axis=1, keepdims=True) + 0.3
    i, k = np.nonzero(near)
    if np.count_nonzero(near[:, 0]) < 3:
        return None
    p, q, w = xy[i], tree.data[row[i, k]], w[i, k]
    degree = min(degree, allowed_degree(w.sum()))
    return fit_warp(p, q, source.shape, degree, weights=w, width=width, parity=parity)


def _best_radius(predicted, tree, width, n_fixing):
    some = predicted[:: len(predicted) // 500 + 1]
    radii = [factor * width for factor in (0.5, 1, 2.5)]
    nearest = tree.query(some, distance_upper_bound=radii[-1])
    strengths = {radius: _strength(some, tree, nearest, radius, n_fixing) for radius in radii}
    return max(strengths.items(), key=lambda item: item[1])


def _strength(predicted, tree, nearest, radius, n_fixing):
    """How far the number of hits is above chance; local densities of the target allow for crowded places.

    `nearest` holds the distances and rows of the target's stars nearest to those predicted, within the radius at least.
    """
    distance, row = nearest
    hits = len(np.unique(row[distance < radius])) - n_fixing
    some = predicted[:: len(predicted) // 200 + 1]
    around = tree.query_ball_point(some, 8 * radius, return_length=True).sum() * len(predicted) / len(some)
    around = max(around - hits, 1) / 64
    return hits * np.log(hits / around) - hits + around if hits > around else 0.0


def settle(source, target, warp, reach, *, tolerance=None):
    """Mutual nearest neighbours under a map, the map refitted to them.

    Parameters
    ----------
    source, target : StarList
    warp : Warp
    reach : float
        Tolerance of the first round, pixels.
    tolerance : float, optional
        Of the last round; 5 times the scatter if not given, and not so large that neighbours get mixed up.

    Returns
    -------
    Registration or None
    """
    most = _farthest(target)
    some = _thinned(source)
    limit = min(reach, most)
    pairs = _mutual(warp.with_leverage(some.xy), some, target, limit, most)
    highest = allowed_degree(len(pairs[0]))
    found = []
    # with few pairs a lower degree can be the more significant one
    for degree in {0: (0,), 1: (1, 0), 2: (2, 1), 3: (3, 2)}.get(highest, (highest,)):
        settled = _settle(source, target, some, warp, pairs, limit, tolerance, degree)
        if settled is not None:
            found.append(settled)
            if settled.is_complete:
                break
    return max(found, key=lambda f: (len(f.source), f.strength), default=None)


def _thinned(stars):
    step = -(-len(stars) // MOST)
    return stars if step == 1 else stars.subset(np.arange(len(stars)) % step == 0)


def _settle(source, target, some, warp, pairs, limit, tolerance, degree):
    """Registration by a map of one degree, from the pairs of some stars under a first one; None if it is none."""
    most = _farthest(target)
    parity = np.sign(np.linalg.det(np.diff(warp(np.array([[0.0, 0], [1, 0], [0, 1]])), axis=0)))
    for sweep in range(4):
        i, j, distance = _mutual(warp.with_leverage(some.xy), some, target, limit, most) if sweep else pairs
        if len(i) < 3 or allowed_degree(len(i)) < degree:
            return None
        scatter = similarity.median(distance) / 1.18  # the median distance is 1.18 times the scatter per axis
        w = 1 / (1 + (distance / (2 * scatter + 1e-9)) ** 2)
        warp = fit_warp(some.xy[i], target.xy[j], source.shape, degree, weights=w, width=scatter, parity=parity)
        before, limit = limit, min(max(5 * scatter, 0.5), most, 1.5 * limit)
        if abs(limit - before) < 0.1 * limit:
            break
    return _judged(source, target, warp, limit, tolerance)


def _farthest(target):
    """Distance within which a position by chance finds a star of a list with a probability of 3 per cent."""
    return np.sqrt(0.03 * target.area / (np.pi * len(target)))


def _judged(source, target, warp, limit, tolerance):
    """Registration of all stars by a map, the limit replaced by a tolerance that is given; None if it is none."""
    limit = limit if tolerance is None else tolerance
    mapped = warp.with_leverage(source.xy)
    i, j, distance = _mutual(mapped, source, target, limit, max(_farthest(target), limit), lone=True)
    predicted, _ = mapped
    nearest = target.tree.query(predicted, distance_upper_bound=limit)
    strength = _strength(predicted, target.tree, nearest, limit, warp.n_fixing)
    possible = np.mean(target.on_detector(predicted)) * min(len(source), len(target))
    if strength < MIN_STRENGTH or not possible or len(i) < max(5, MIN_SHARE * possible):  # none may fall on the image
        return None
    return Registration(i, j, distance, warp, float(limit), float(strength), len(i) / possible)


def _mutual(mapped, source, target, limit, most, lone=False):
    """Rows of mutual nearest neighbours and their distances; `lone` leaves out those with a second neighbour.

    `mapped` is what `Warp.with_leverage` gives for the source. Where the map extrapolates and errors are large,
    neighbours may be farther apart than `limit`, never than `most`.
    """
    predicted, leverage = mapped
    forward, j = target.tree.query(predicted, k=2, distance_upper_bound=max(limit, most))
    rows = np.flatnonzero(np.isfinite(forward[:, 0]))
    backward, i = cKDTree(predicted, balanced_tree=False, compact_nodes=False).query(
        target.xy[j[rows, 0]], k=2, distance_upper_bound=max(limit, most)
    )
    mutual = i[:, 0] == rows
    rows, backward = rows[mutual], backward[mutual]
    cols, distance = j[rows, 0], forward[rows, 0]
    spread = limit**2 * (1 + leverage[rows])
    good = distance <= np.minimum(np.sqrt(spread + 16 * (source.error[rows] ** 2 + target.error[cols] ** 2)), most)
    if lone:
        good &= (forward[rows, 1] > limit) & (backward[:, 1] > limit)
    return rows[good], cols[good], distance[good]
