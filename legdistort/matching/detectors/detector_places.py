"""Where the detectors of a camera lie to each other, nearer than its layout has it: so much as matching needs to know.

A first matching in the focal plane finds the stars that stay on a detector; those that move over a gap are missed where
the layout is wrong by more than the errors of the stars. Seen by each detector the stars are put on one plane, and what
two detectors have in common there shows how these lie: a vote finds by how much one is shifted against the other, then
all detectors are fitted together, each by an affine map. Where few stars cross from one detector to the next, the sets
of detectors that are tied so far vote on one another, turned a little too. A star that crosses is no brighter there,
and in no exposure on both. The camera is not changed: `legdistort.solve` finds that.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ...geometry import basis, similarity
from ...inputs.start_poses import estimate_poses
from ..star_lists import allowed_degree, fit_warp

#: How far detectors may be shifted against each other [pix], no more than this part of a detector, and how far the
#: layouts of headers typically are.
REACH, PART, WIDTH = 60.0, 1 / 8, 1.0
#: Radii of the votes [pix]: distortions and rotations smear the shifts.
RADII = (1.0, 3.0, 6.0)
#: Logarithm of the odds against chance from which on a vote counts.
ODDS = 6.0
#: Rotations that are tried of detectors which are tied against others [rad], in steps that move a field of two
#: detectors of 1000 pixels by the middle radius.
TURNS = 0.003 * np.arange(-6, 7)
#: Fluxes of a star on two detectors differ by no more than this, natural logarithm: their gains may.
LIKE = 0.5
#: Votes of so many pairs are counted; of more, every second, third, and so on is tried as the middle.
_MOST = 5000
#: Standard deviation of rotation, scale and shear of a detector beforehand.
_TURN = 0.003
#: That of a shift [pix]: it keeps all detectors together where they were.
_SHIFT = 100.0
_SWEEPS, _ROUNDS = 4, 6
#: Layouts whose modes are known so well [pix] are believed.
_KNOWN = 0.3


def is_free(camera):
    """Whether it is not known where the detectors of a camera lie to each other, to a part of a pixel."""
    sigmas = [detector.layout_sigma for detector in camera.detectors.values()]
    return len(sigmas) > 1 and any(sigma is not None and np.any(sigma > _KNOWN) for sigma in sigmas)


def n_tied(star):
    """Number of detections that are of a star which another one before has: the more, the better is a matching."""
    found = star[star >= 0]
    return len(found) - len(np.unique(found))


def is_tied(star, least):
    """Which detections (n,) are of a star that so many are of."""
    numbers, inverse, count = np.unique(star, return_inverse=True, return_counts=True)
    return (numbers[inverse] >= 0) & (count[inverse] >= least)


def farthest(moves, detector):
    """The detector that is moved most against the others, and by how much [pix], by moves (n, 2) of what was seen."""
    seen = np.unique(detector)
    middles = np.array([np.median(moves[detector == c], axis=0) for c in seen])
    others = [np.median(np.delete(middles, k, axis=0), axis=0) for k in range(len(seen))]
    far = np.hypot(*(middles - others).T)
    return seen[np.argmax(far)], far.max()


def nearer(camera, xy, exposure, detector, star, flux=None):
    """Positions in the focal plane with the detectors where their stars put them.

    Parameters
    ----------
    camera : Camera
    xy : ndarray, shape (n, 2)
        Of detections in its focal plane, pixels.
    exposure, detector, star : ndarray of int, shape (n,)
        Detectors by their place in the camera; stars as far as they are known, -1 for none.
    flux : ndarray, shape (n,), optional

    Returns
    -------
    ndarray, shape (n, 2), or None
        None where no two detectors see the same stars.
    """
    placed = _placed(camera, xy, exposure, detector, star, flux)
    if placed is None:
        return None
    maps = placed[1].reshape(-1, 2, 3)[detector]
    return xy + np.einsum("nak,nk->na", maps, _arms(camera, xy, detector))


def with_crossing(camera, xy, exposure, detector, star, flux=None):
    """Numbers of stars (n,) in which one that was two, each on detectors of its own, has the lower number.

    Arguments are those of `nearer`. Distortions that each detector has of its own are not smooth over a gap, and leave
    the exposures of a star that are on one side of it apart from those on the other. Two such parts are nearest to each
    other on the plane, and in no exposure at once, as two stars would be.
    """
    star, placed = star.copy(), _placed(camera, xy, exposure, detector, star, flux)
    if placed is None:
        return star
    seen, change, pairs = placed
    near = _neighbours(seen, seen.slopes(len(camera.detectors)) @ change, _joined(seen, pairs), RADII[1])
    pairs = near[seen.can_be_one(near)]
    for one, two in np.sort(seen.star[pairs], axis=1):
        if one >= 0 and one != two and not np.intersect1d(exposure[star == one], exposure[star == two]).size:
            star[star == two] = one
    return star


def _placed(camera, xy, exposure, detector, star, flux):
    """The `_Seen`, affine maps of detectors that bring its stars together, and pairs (n, 2) of its rows; or None."""
    arms, bright = _arms(camera, xy, detector), np.full(len(xy), np.nan) if flux is None else _logarithm(flux)
    rows = np.isin(exposure, exposure[star >= 0])  # others have no pose
    seen = _seen(camera, *(each[rows] for each in (xy, exposure, detector, star, arms, bright)))
    sides = [max(each.shape) for each in camera.detectors.values()]
    reach, slopes = min(REACH, PART * min(sides)), seen.slopes(len(sides))
    change, joined, pairs = np.zeros(slopes.shape[2]), np.arange(seen.group.max() + 1), np.zeros((0, 2), dtype=int)
    for turns in (np.zeros(1), *[TURNS] * len(sides)):  # detectors one by one, then those that are tied together
        found = _voted(seen, seen.xy + slopes @ change, joined[seen.group], reach, turns)
        if not len(found):
            break
        pairs, scale = np.concatenate([pairs, found]), RADII[-1] / 2
        joined = _joined(seen, pairs)
        for _ in range(_ROUNDS):
            change, scale = _fitted(seen, slopes, pairs, scale)
            pairs = _neighbours(seen, slopes @ change, joined, min(max(4 * scale, 0.5), RADII[-1]))
            if len(pairs) < 2:
                return None
    return (seen, change, pairs) if len(pairs) else None


def _logarithm(flux):
    """Natural logarithm of fluxes, NaN where there is none."""
    return np.log(np.where(flux > 0, flux, np.nan))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Stars as one detector sees them in exposures of one orientation.

    `xy` (n, 2) on a common plane, `detector`, `turned` and `group` (n,) of both: the orientation; `arms` (n, 3), and
    how the plane follows the focal plane, `turn` (n, 2, 2); `bright` (n,) the logarithm of the flux, NaN for none, and
    whether an exposure shows the star, `exposures` (n, n_exposures). `star` (n,) is its number, -1 for none.
    """

    xy: np.ndarray
    detector: np.ndarray
    turned: np.ndarray
    group: np.ndarray
    arms: np.ndarray
    turn: np.ndarray
    bright: np.ndarray
    exposures: np.ndarray
    star: np.ndarray

    def can_be_one(self, pairs):
        """Which pairs (n, 2) of rows may be one star: alike in flux, and in no exposure at once, bool (n,)."""
        a, b = pairs.T
        return ~(np.abs(self.bright[a] - self.bright[b]) > LIKE) & ~np.any(
            self.exposures[a] & self.exposures[b], axis=1
        )

    def slopes(self, n_detectors):
        """How stars move with affine maps of all detectors, and of the plane by orientation: (n, 2, n_maps, 2, 3)."""
        rows, maps = np.arange(len(self.xy)), n_detectors + self.turned.max() + 1
        out, middle = np.zeros((len(rows), 2, maps, 2, 3)), self.xy.mean(axis=0)
        out[rows, :, self.detector] = self.turn[:, :, :, None] * self.arms[:, None, None]
        plane = np.column_stack([np.ones(len(rows)), (self.xy - middle) / np.abs(self.xy - middle).max()])
        for axis in (0, 1):
            out[rows, axis, n_detectors + self.turned, axis] = plane
        return out.reshape(len(rows), 2, -1)


def _arms(camera, xy, detector):
    """Constant, x and y over its detector (n, 3) of positions in the focal plane: changes of layouts move these."""
    out = np.ones((len(xy), 3))
    for c, each in enumerate(camera.detectors.values()):
        middle = similarity.apply(similarity.invert(each.layout), basis.denormalize(*np.zeros((2, 1)), each.shape))
        out[detector == c, 1:] = (xy[detector == c] - middle) / (max(each.shape) / 2)
    return out


def _seen(camera, xy, exposure, detector, star, arms, bright):
    """The `_Seen`: means over exposures, the distortions of these relative to the mean fitted."""
    exposure, known = np.unique(exposure, return_inverse=True)[1], star >= 0
    tied = np.unique(star[known], return_inverse=True)[1]
    poses = np.array(estimate_poses(exposure[known], tied, xy[known]))
    star = star.copy()
    star[~known] = star.max() + 1 + np.arange(np.count_nonzero(~known))  # each for itself: once on this detector
    turned = np.round([similarity.describe(pose)["rotation"] / 10 for pose in poses]).astype(int) % 36
    group = np.unique(36 * detector + turned[exposure], return_inverse=True)[1]
    node = np.unique(group * (star.max() + 1) + star, return_inverse=True)[1]
    count = np.bincount(node)

    def mean(values):
        return np.stack([np.bincount(node, column) / count for column in values.T], axis=1)

    on_plane, rows = np.empty_like(xy), [exposure == i for i in range(len(poses))]
    for pose, mine in zip(poses, rows, strict=True):
        on_plane[mine] = similarity.apply(similarity.invert(pose), xy[mine])
    for _ in range(_SWEEPS):
        places = mean(on_plane)[node]
        for pose, mine in zip(poses, rows, strict=True):
            few, n = mine & known, np.count_nonzero(mine & known)
            how = {"weights": np.ones(n), "width": 1.0, "parity": np.sign(np.linalg.det(pose[:, :2]))}
            warp = fit_warp(xy[few], places[few], camera.field, min(allowed_degree(n), 3), **how)
            on_plane[mine] = warp(xy[mine])
    back = np.linalg.inv(poses[:, :, :2])[exposure].reshape(-1, 4)
    first = np.unique(node, return_index=True)[1]
    orientation = np.unique(turned[exposure[first]], return_inverse=True)[1]
    turn = mean(back).reshape(-1, 2, 2)
    shows = np.zeros((len(count), len(poses)), dtype=bool)
    shows[node, exposure] = True
    bright = mean(_at_one_level(bright, exposure, star)[:, None])[:, 0]
    return _Seen(mean(on_plane), detector[first], orientation, group[first], mean(arms), turn, bright, shows,
                 np.where(known, star, -1)[first])  # fmt: skip


def _at_one_level(bright, exposure, star):
    """Logarithms of fluxes (n,) with those of all exposures brought to one another by the stars in common."""
    for _ in range(2):
        level = np.bincount(star, bright)[star] / np.bincount(star)[star]
        several = (np.bincount(star)[star] > 1) & np.isfinite(level)
        apart = [np.median((bright - level)[several & (exposure == i)]) if np.any(several & (exposure == i)) else 0.0
                 for i in range(exposure.max() + 1)]  # fmt: skip
        bright = bright - np.array(apart)[exposure]
    return bright


def _voted(seen, xy, of_set, reach, turns):
    """Pairs (n, 2) of rows that are the same star by the votes of all sets that lie on each other within reach.

    Parameters
    ----------
    seen : _Seen
    xy : ndarray, shape (n, 2)
        Where its rows lie by now.
    of_set : ndarray of int, shape (n,)
        Number of the set of each: what lies in one is placed already.
    reach : float
        Pixels.
    turns : ndarray, shape (k,)
        Angles that are tried [rad].
    """
    out = [np.zeros((0, 2), dtype=int)]
    sets = [np.flatnonzero(of_set == g) for g in np.unique(of_set)]
    trees = [cKDTree(xy[rows]) for rows in sets]
    for g, h in combinations(range(len(sets)), 2):
        near = trees[g].query_ball_tree(trees[h], reach)
        first = np.repeat(np.arange(len(near)), [len(each) for each in near])
        if len(first) < 2:
            continue
        second = np.concatenate([each for each in near if each]).astype(int)
        pairs = np.stack([sets[g][first], sets[h][second]], axis=1)
        pairs = pairs[seen.can_be_one(pairs)]
        agree = _vote(xy[pairs[:, 0]], xy[pairs[:, 1]], reach, turns) if len(pairs) > 1 else None
        if agree is not None:
            out.append(pairs[agree])
    return np.concatenate(out)


def _vote(here, there, reach, turns):
    """Which of pairs of positions (n, 2) agree on a shift and a turn, beyond chance and near to none; None if none do.

    That is near: the odds are those of so much being wrong, by `WIDTH`, where a turn counts by the shift of its steps.
    """
    best, found = ODDS, None
    for angle in turns:
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        shifts = (there - there.mean(axis=0)) @ turn + there.mean(axis=0) - here
        tree, tried = cKDTree(shifts), shifts[:: len(shifts) // _MOST + 1]
        far = np.log1p(np.sum(tried**2, axis=1) / WIDTH**2) + np.log1p(np.abs(angle) / _TURN)
        for radius in RADII:
            votes, near = (tree.query_ball_point(tried, r, return_length=True) for r in (radius, 3 * radius))
            expected = np.maximum(len(shifts) * (radius / reach) ** 2, (near - votes) / 8)
            odds = np.where(votes > expected, votes * np.log(votes / expected) - votes + expected, 0) - far
            k = int(np.argmax(odds))
            if odds[k] > best and votes[k] > 1 + (len(turns) > 1):  # a turn brings any two together
                best, found = odds[k], tree.query_ball_point(tried[k], radius)
    return found


def _joined(seen, pairs):
    """Number of the set of detectors (n_groups,) that votes tie together, for every group."""
    n = seen.group.max() + 1
    ties = np.zeros((n, n), dtype=bool)
    ties[seen.group[pairs[:, 0]], seen.group[pairs[:, 1]]] = True
    detector = np.zeros(n, dtype=int)
    detector[seen.group] = seen.detector
    return connected_components(ties | (detector[:, None] == detector), directed=False)[1]


def _fitted(seen, slopes, pairs, scale):
    """Affine maps (6 n_maps,) of detectors and orientations that bring pairs together, robustly, and what is left."""
    off = seen.xy[pairs[:, 1]] - seen.xy[pairs[:, 0]]
    design = slopes[pairs[:, 0]] - slopes[pairs[:, 1]]
    sides = np.array([_SHIFT, *[_TURN * np.ptp(seen.xy, axis=0).max()] * 2])
    ridge = np.diag(np.tile(1 / sides**2, slopes.shape[2] // 3))
    left = np.full(len(pairs), scale)
    for _ in range(5):
        weight = 1 / (1 + (left / (2 * scale)) ** 2) / scale**2
        normal = np.einsum("nak,n,nal->kl", design, weight, design) + ridge
        change = np.linalg.solve(normal, np.einsum("nak,n,na->k", design, weight, off))
        left = np.hypot(*(off - design @ change).T)
        scale = max(similarity.median(left) / 1.18, 0.02)
    return change, scale


def _neighbours(seen, moved, joined, radius):
    """Pairs (n, 2) of rows of different groups that lie nearest to each other once they are moved (n, 2)."""
    xy, out = seen.xy + moved, [np.zeros((0, 2), dtype=int)]
    groups = [np.flatnonzero(seen.group == g) for g in range(seen.group.max() + 1)]
    trees = [cKDTree(xy[rows]) for rows in groups]
    for g, h in combinations(range(len(groups)), 2):
        if joined[g] == joined[h]:
            distance, there = trees[h].query(xy[groups[g]], distance_upper_bound=radius)
            mine = np.flatnonzero(np.isfinite(distance))
            back = trees[g].query(xy[groups[h][there[mine]]])[1]
            mine = mine[back == mine]
            out.append(np.stack([groups[g][mine], groups[h][there[mine]]], axis=1))
    return np.concatenate(out)
