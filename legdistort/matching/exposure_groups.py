"""Which exposures show the same stars: groups of exposures registered with one another.

They are linked as a graph, never as a chain: a spanning tree from the richest exposure gives every exposure a rough
pose, then every pair that overlaps is registered directly.

Two exposures of few stars, half of them false, may have too little in common to stand out from chance. The stars that
several exposures share are more complete and hardly ever false: groups are laid on one another by these (`unite`).
"""

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammainc

from ..geometry import similarity
from ..measurement.flags import PERSISTS
from ..runtime.progress import Bar
from .registration import Registration, continue_from_pairs, continue_from_pose, outwards, register
from .star_labels import label_stars
from .star_lists import StarList, Warp, allowed_degree, fit_warp

#: Exposures of a group with which a stray one is compared at any rotation.
BLIND_TRIES = 8
#: Pairs of an exposure registered at most: those of largest overlap, and as many of all others, evenly by overlap.
PARTNERS = 3
#: Stars that two exposures ought to share before a failure to register counts against them.
ENOUGH = 25
#: Chance of so many detections on a line; half the breadth of it, and of the strip about it that tells chance [pix].
CROWD, BREADTH, BESIDE = 1e-5, 2.0, 20.0
#: With more than this part of the detections on crowded columns, and on rows too, they are a lattice.
LATTICE = 0.25
#: A pair is registered anew when it holds less than this part of the stars that the exposures share by all other pairs.
COMPLETE = 0.97


@dataclass(frozen=True, eq=False)
class Group:
    """Exposures linked by registrations.

    Attributes
    ----------
    poses : dict of int to ndarray
        Rough poses by exposure, plane of the first one -> pixels.
    registrations : dict of (int, int) to Registration
    """

    poses: dict
    registrations: dict


def link(lists, guess, *, tolerance=None, progress=False):
    """Group exposures by registering them along a spanning tree.

    Parameters
    ----------
    lists : list of StarList
    guess : callable
        ``guess(i, j)`` = pose from exposure i to j by the headers, or None.
    tolerance : float, optional
        As in `legdistort.matching.registration.register`.
    progress : bool

    Returns
    -------
    list of Group
        The largest first; an exposure that fits nowhere is a group of its own.
    """
    left = set(range(len(lists)))
    groups = []
    with Bar(total=len(lists), desc="matching", disable=not progress) as bar:
        while left:
            hub = max(left, key=lambda i: (len(lists[i]), -i))
            left.remove(hub)
            groups.append(_gather(lists, hub, left, guess, tolerance))
            bar.update(len(groups[-1].poses))
    return sorted(groups, key=lambda g: -len(g.poses))


def _gather(lists, hub, left, guess, tolerance):
    """Take out of `left` all that can be linked to the hub, directly or through others."""
    found, registrations = {hub: similarity.identity()}, {}
    for blind in (False, True):
        queue = list(found)[:BLIND_TRIES] if blind else list(found)
        tries = 0
        while queue and left and not (blind and tries >= BLIND_TRIES):
            base = queue.pop(0)
            tries += 1
            for other in sorted(left):
                i, j = sorted((base, other))
                r = register(lists[i], lists[j], guess=guess(i, j), blind=blind, tolerance=tolerance)
                if r is not None:
                    step = similarity.robust_similarity(lists[i].xy[r.source], lists[j].xy[r.target])
                    found[other] = similarity.compose(step if base == i else similarity.invert(step), found[base])
                    registrations[i, j] = r
                    left.remove(other)
                    queue.append(other)
                    tries = 0
    return Group(found, registrations)


def standing(lists, group, *, radius=0.6, moved=1.5):
    """Detections that stay at the same pixel, or crowd on the same column or row, while the sky moves: hot pixels.

    A star of which an image persists at its place in the next exposures is ten times as bright as that, or more: what
    is so much fainter says nothing of a detection.

    Parameters
    ----------
    lists : list of StarList
    group : Group
    radius : float
        What counts as the same place, pixels.
    moved : float
        Exposures count whose poses shift the place by at least that much, pixels; a standing detection is
        found in half of these and in three at least.

    Returns
    -------
    list of ndarray of bool
    """
    out = [np.zeros(len(stars), bool) for stars in lists]
    members = sorted(group.poses)
    if len(members) < 3:
        return out
    poses = np.array([group.poses[i] for i in members])
    whose = np.repeat(np.arange(len(members)), [len(lists[i]) for i in members])
    tree = cKDTree(np.concatenate([lists[i].xy for i in members]))
    known = all(lists[i].flux is not None for i in members)
    flux = np.concatenate([lists[i].flux for i in members]) if known else np.zeros(len(whose))
    for i in members:
        xy = lists[i].xy
        near = tree.query_ball_point(xy, radius)
        star = np.repeat(np.arange(len(xy)), [len(rows) for rows in near])
        here = np.zeros((len(members), len(xy)), bool)
        rows = np.concatenate(near).astype(int)
        like = flux[rows] >= PERSISTS * lists[i].flux[star] if known else np.ones(len(rows), bool)
        here[whose[rows[like]], star[like]] = True
        several = np.flatnonzero(np.count_nonzero(here, axis=0) > 3)  # three and itself
        away = np.hypot(*(_carried(poses, group.poses[i], xy[several]) - xy[several].T[:, None])) > moved
        same = np.count_nonzero(here[:, several] & away, axis=0)
        out[i][several] = (same >= 3) & (same >= 0.5 * np.count_nonzero(away, axis=0))
        out[i] |= _on_lines(lists, members, i, poses, radius, moved)
    return out


def _on_lines(lists, members, own, poses, radius, moved):
    """Detections (n,) of one exposure of a group on columns, or rows, that are crowded in it and in those moved away.

    Those of a lattice crowd on both, and are no defects.

    Parameters
    ----------
    lists : list of StarList
    members : list of int
        Exposures of the group.
    own : int
        Which exposure it is.
    poses : ndarray, shape (n_members, 2, 3)
    radius, moved
        As in `standing`.
    """
    xy, out = lists[own].xy, np.zeros(len(lists[own]), dtype=bool)
    crowded = [_is_crowded(xy[:, axis], xy[:, axis], radius, 1) for axis in (0, 1)]
    if min(map(np.count_nonzero, crowded)) > LATTICE * len(xy):
        return out
    for axis, rows in enumerate(map(np.flatnonzero, crowded)):
        away = np.abs(_carried(poses, poses[members.index(own)], xy[rows])[axis] - xy[rows, axis]) > moved
        too = [_is_crowded(lists[i].xy[:, axis], xy[rows, axis], radius, 0) for i in members]
        same = np.count_nonzero(away & too, axis=0)
        out[rows[(same >= 3) & (same >= 0.5 * np.count_nonzero(away, axis=0))]] = True
    return out


def _is_crowded(places, at, radius, itself):
    """Whether more places lie within a radius of others than chance makes of those in the strip about these."""
    ordered = np.sort(places)

    def within(r):
        return np.searchsorted(ordered, at + r, "right") - np.searchsorted(ordered, at - r)

    expected = np.maximum(within(BESIDE) - within(BREADTH), 1) * radius / (BESIDE - BREADTH)
    return gammainc(within(radius) - itself, expected) < CROWD  # of Poisson's law: so many or more


def without(group, dropped):
    """The group where some detections of its lists are no more (list of ndarray of bool, by exposure)."""
    serial = [np.cumsum(~mask) - 1 for mask in dropped]
    registrations = {}
    for (i, j), r in group.registrations.items():
        keep = ~dropped[i][r.source] & ~dropped[j][r.target]
        registrations[i, j] = replace(
            r, source=serial[i][r.source[keep]], target=serial[j][r.target[keep]], distance=r.distance[keep]
        )
    return replace(group, registrations=registrations)


def _carried(poses, own, xy):
    """Positions (n, 2) of an exposure of pose `own` in exposures of several `poses`, (2, n_poses, n)."""
    plane = similarity.apply(similarity.invert(own), xy)
    return np.tensordot(poses[:, :, :2].swapaxes(0, 1), plane, axes=(2, 1)) + poses.T[2][:, :, None]


def interlink(lists, group, *, tolerance=None, progress=False):
    """Register all pairs that overlap, and find the exposures that contradict the others.

    Parameters
    ----------
    lists : list of StarList
    group : Group
    tolerance, progress
        As in `link`.

    Returns
    -------
    registrations : dict of (int, int) to Registration
    misfits : dict of int to str
        Exposures to leave out, with the reason.
    """
    sizes = [len(stars) for stars in lists]
    known = dict(group.registrations)
    overlaps = _overlaps(lists, group.poses)
    partners = _partners(overlaps)
    for sweep in ("linking", "completing"):
        labels = label_stars(sizes, known)
        for i, j in Bar(partners, desc=sweep, disable=not progress):
            shared, rows, columns = np.intersect1d(labels[i], labels[j], return_indices=True)
            rows, columns = rows[shared >= 0], columns[shared >= 0]
            before = known.get((i, j))
            if before is None or len(before.source) < COMPLETE * len(rows):
                step = similarity.compose(group.poses[j], similarity.invert(group.poses[i]))
                found = _register_again(lists[i], lists[j], rows, columns, step, tolerance)
                if found is not None and (before is None or len(found.source) > len(before.source)):
                    known[i, j] = found
    return known, _misfits(known, [pair for pair in partners if overlaps[pair] >= ENOUGH])


def _register_again(source, target, rows, columns, step, tolerance):
    """Register two exposures of a group from the stars they share through third ones, or else from their poses."""
    if len(rows) >= 8:
        found = continue_from_pairs(source, target, rows, columns, tolerance=tolerance)
        if found is not None:
            return found
    order = outwards(source) if source.ranking is None or target.ranking is None else None
    return continue_from_pose(source, target, step, order, tolerance=tolerance)


def _overlaps(lists, rough):
    """Number of stars that the poses let two exposures share at most, for every pair of them."""
    out, members = {}, sorted(rough)
    poses = np.array([rough[i] for i in members])
    sizes = np.array([lists[i].shape[::-1] for i in members]).T[:, :, None]
    stars = np.array([len(lists[i]) for i in members])
    for k, i in enumerate(members[:-1]):
        there = _carried(poses[k + 1 :], rough[i], lists[i].xy)
        part = np.mean(np.all((there > -0.5) & (there < sizes[:, k + 1 :] - 0.5), axis=0), axis=1)
        shared = part * np.minimum(stars[k], stars[k + 1 :])
        out.update(zip(((i, j) for j in members[k + 1 :]), shared.tolist(), strict=True))
    return out


def _partners(overlaps):
    """The pairs worth registering: for every exposure those of largest overlap, and some of any other overlap.

    Where pointings are repeated the first are all of one pointing, and others would join stars that few pointings see.
    """
    of_exposure = defaultdict(list)
    for pair, stars in overlaps.items():
        for exposure in pair if stars >= 3 else ():
            of_exposure[exposure].append(pair)
    chosen = set()
    for pairs in of_exposure.values():
        ordered = sorted(pairs, key=lambda pair: -overlaps[pair])
        chosen.update(ordered[:PARTNERS])
        rest = ordered[PARTNERS:]
        chosen.update(rest[k] for k in np.linspace(0, len(rest) - 1, min(PARTNERS, len(rest))).astype(int))
    return sorted(chosen)


def _misfits(known, expected):
    """Exposures that register with fewer than half of those with which they should, the worst first."""
    made = {frozenset(pair) for pair in known}
    pairs = [frozenset(pair) for pair in expected]
    out = {}
    while True:
        votes = defaultdict(list)
        for pair in pairs:
            for i in pair:
                votes[i].append(pair in made)
        shares = {i: np.mean(v) for i, v in votes.items() if len(v) >= 2}
        worst = min(shares, key=shares.get, default=None)
        if worst is None or shares[worst] >= 0.5:
            return out
        out[worst] = f"it agrees with only {sum(votes[worst])} of {len(votes[worst])} exposures that it should overlap"
        pairs = [pair for pair in pairs if worst not in pair]


@dataclass(frozen=True, eq=False)
class _View:
    """What a group sees: stars, ``{exposure: (rows, stars)}`` of its detections, pose from its plane to the list's."""

    stars: StarList
    seen: dict
    pose: np.ndarray


def unite(lists, groups, guess, *, tolerance=None):
    """Link to the largest group whatever fits the stars that its exposures share.

    Parameters
    ----------
    lists : list of StarList
    groups : list of Group
        The largest first.
    guess, tolerance
        As in `link`.

    Returns
    -------
    list of Group
        The largest first.
    """
    main, *others = groups
    if not others or len(main.poses) == 1:
        return groups
    whole = main
    while whole is not None:
        main = _linked(lists, whole, tolerance)
        others = [o for o in others if not o.poses.keys() & main.poses.keys()]
        view, linked = _view(lists, main), (_linked(lists, o, tolerance) for o in others)
        united = (_united(main, view, o, _view(lists, o), guess, tolerance) for o in linked)
        whole = next((both for both in united if both is not None), None)
    return [main, *others]


def _linked(lists, group, tolerance):
    return replace(group, registrations=interlink(lists, group, tolerance=tolerance)[0])


def _view(lists, group, n_sweeps=3):
    """Mean positions of the stars of a group, distortions of the exposures relative to the mean fitted."""
    if len(group.poses) == 1:
        (only,) = group.poses
        every = np.arange(len(lists[only]))
        return _View(lists[only], {only: (every, every)}, group.poses[only])
    labels = label_stars([len(stars) for stars in lists], group.registrations)
    rows = {i: np.flatnonzero(labels[i] >= 0) for i in group.poses}
    _, star = np.unique(np.concatenate([labels[i][r] for i, r in rows.items()]), return_inverse=True)
    ends = np.cumsum([len(r) for r in rows.values()])[:-1]
    seen = {i: (r, s) for (i, r), s in zip(rows.items(), np.split(star, ends), strict=True)}

    def mean(values):
        return np.bincount(star, np.concatenate(list(values))) / np.bincount(star)

    back = {i: similarity.apply(similarity.invert(group.poses[i]), lists[i].xy[r]) for i, r in rows.items()}
    for sweep in range(n_sweeps):
        xy = np.column_stack([mean(b[:, axis] for b in back.values()) for axis in (0, 1)])
        if sweep < n_sweeps - 1:
            back = {i: _mapped(lists[i], r, xy[s], group.poses[i]) for i, (r, s) in seen.items()}
    fluxes = [lists[i].flux for i in rows]
    flux = None if any(f is None for f in fluxes) else mean(lists[i].flux[r] for i, r in rows.items())
    low, high = xy.min(axis=0), xy.max(axis=0)
    shape = tuple(np.ceil(high - low + 1).astype(int)[::-1])
    stars = StarList(xy - low, mean(lists[i].error[r] for i, r in rows.items()), shape, flux)
    return _View(stars, seen, np.column_stack([np.eye(2), -low]))


def _mapped(stars, rows, places, pose):
    """Detections laid on their places by a polynomial, or left where the pose puts them if they are too few for one."""
    if len(rows) < 3:
        return similarity.apply(similarity.invert(pose), stars.xy[rows])
    p, parity = stars.xy[rows], np.sign(np.linalg.det(pose[:, :2]))
    degree = min(allowed_degree(len(rows)), 3)
    return fit_warp(p, places, stars.shape, degree, weights=np.ones(len(p)), width=1.0, parity=parity)(p)


def _united(main, view, other, other_view, guess, tolerance):
    """The group of both, or None if the other's stars are not those of the main one."""
    start = _guessed(main, view, other, other_view, guess)
    found = register(other_view.stars, view.stars, guess=start, tolerance=tolerance)
    if found is None:
        return None
    step = similarity.robust_similarity(other_view.stars.xy[found.source], view.stars.xy[found.target])
    to_other = similarity.compose(
        similarity.invert(other_view.pose), similarity.compose(similarity.invert(step), view.pose)
    )
    placed = {i: similarity.compose(pose, to_other) for i, pose in other.poses.items()}
    partner = np.full(len(other_view.stars), -1)
    partner[found.source] = found.target
    distance = np.zeros(len(view.stars))
    distance[found.target] = found.distance
    registrations = dict(main.registrations) | other.registrations
    for i, (mine, stars) in view.seen.items():
        for j, (theirs, other_stars) in other_view.seen.items():
            shared, a, b = np.intersect1d(stars, partner[other_stars], return_indices=True)
            if len(shared):
                warp = Warp.from_pose(similarity.compose(placed[j], similarity.invert(main.poses[i])), view.stars.shape)
                pairs = (mine[a], theirs[b]) if i < j else (theirs[b], mine[a])
                registrations[min(i, j), max(i, j)] = Registration(
                    *pairs, distance[shared], warp, found.tolerance, found.strength, found.share
                )
    return Group(main.poses | placed, registrations)


def _guessed(main, view, other, other_view, guess):
    """Pose from the other group's star list to the main one's by the headers, or None."""
    for j, there in other.poses.items():
        for i, here in main.poses.items():
            step = guess(j, i)
            if step is not None:
                plane = similarity.compose(similarity.invert(here), similarity.compose(step, there))
                return similarity.compose(view.pose, similarity.compose(plane, similarity.invert(other_view.pose)))
    return None
