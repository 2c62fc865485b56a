"""From registered pairs of exposures to stars: who belongs to whom, checked for mutual consistency.

Exposures are tied as a graph, never as a chain: a spanning tree from the
richest exposure gives every exposure a rough pose, then every pair that
overlaps is registered directly. A star is a connected set of detections in
which each is paired with at least half of those it was compared with.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from tqdm import tqdm

from ..geometry import similarity as poses
from ..geometry.similarity import robust_similarity
from .registration import continue_from, grow, outwards, register, settle

#: Exposures of a group with which a stray one is compared at any rotation.
BLIND_TRIES = 8
#: Pairs of an exposure registered at most, those of largest overlap first.
PARTNERS = 10
#: Stars that two exposures ought to share before a failure to register counts against them.
TELLING = 25
#: A pair is registered anew when it holds less than this part of the stars that the exposures share by all other pairs.
COMPLETE = 0.97


@dataclass(frozen=True, eq=False)
class Group:
    """Exposures tied together.

    Attributes
    ----------
    poses : dict of int to ndarray
        Rough poses by exposure, plane of the first one -> pixels.
    registrations : dict of (int, int) to Registration
    """

    poses: dict
    registrations: dict


def tie(lists, guess, *, tolerance=None, progress=False):
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
    with tqdm(total=len(lists), desc="matching", disable=not progress) as bar:
        while left:
            hub = max(left, key=lambda i: (len(lists[i]), -i))
            left.remove(hub)
            groups.append(_gather(lists, hub, left, guess, tolerance))
            bar.update(len(groups[-1].poses))
    return sorted(groups, key=lambda g: -len(g.poses))


def _gather(lists, hub, left, guess, tolerance):
    """Take out of `left` all that can be tied to the hub, directly or through others."""
    found, registrations = {hub: poses.identity()}, {}
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
                    step = robust_similarity(lists[i].xy[r.source], lists[j].xy[r.target])
                    found[other] = poses.compose(step if base == i else poses.invert(step), found[base])
                    registrations[i, j] = r
                    left.remove(other)
                    queue.append(other)
                    tries = 0
    return Group(found, registrations)


def standing(lists, group, *, radius=0.6, moved=1.5):
    """Detections that stay at the same pixel while the sky moves: hot pixels.

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
    for i in group.poses:
        xy = lists[i].xy
        shifted, same = np.zeros(len(xy)), np.zeros(len(xy))
        for j in group.poses:
            step = poses.compose(group.poses[j], poses.invert(group.poses[i]))
            away = np.linalg.norm(poses.apply(step, xy) - xy, axis=1) > moved
            shifted += away
            same += away & (lists[j].tree.query(xy, distance_upper_bound=radius)[0] < radius)
        out[i] = (same >= 3) & (same >= 0.5 * shifted)
    return out


def interlink(lists, group, *, tolerance=None, progress=False):
    """Register all pairs that overlap, and find the exposures that contradict the others.

    Parameters
    ----------
    lists : list of StarList
    group : Group
    tolerance, progress
        As in `tie`.

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
        for i, j in tqdm(partners, desc=sweep, disable=not progress):
            shared, rows, columns = np.intersect1d(labels[i], labels[j], return_indices=True)
            rows, columns = rows[shared >= 0], columns[shared >= 0]
            before = known.get((i, j))
            if before is None or len(before.source) < COMPLETE * len(rows):
                step = poses.compose(group.poses[j], poses.invert(group.poses[i]))
                found = _link(lists[i], lists[j], rows, columns, step, tolerance)
                if found is not None and (before is None or len(found.source) > len(before.source)):
                    known[i, j] = found
    telling = [pair for pair in partners if overlaps[pair] >= TELLING]
    return known, _misfits(known, telling)


def _link(source, target, rows, columns, step, tolerance):
    """Register two exposures of a group from the stars they share through third ones, or else from their poses."""
    if len(rows) >= 8:
        found = continue_from(source, target, rows, columns, tolerance=tolerance)
        if found is not None:
            return found
    order = outwards(source) if source.ranking is None or target.ranking is None else None
    grown = grow(source, target, step, order)
    return None if grown is None else settle(source, target, *grown, tolerance=tolerance)


def _overlaps(lists, rough):
    """Number of stars that the poses let two exposures share at most, for every pair of them."""
    out = {}
    for i in sorted(rough):
        for j in sorted(rough):
            if i < j:
                there = poses.apply(poses.compose(rough[j], poses.invert(rough[i])), lists[i].xy)
                inside = np.all((there > -0.5) & (there < np.array(lists[j].shape[::-1]) - 0.5), axis=1)
                part = np.count_nonzero(inside) / len(lists[i])
                out[i, j] = part * min(len(lists[i]), len(lists[j]))
    return out


def _partners(overlaps):
    """The pairs worth registering: for every exposure those of largest overlap."""
    chosen = set()
    for exposure in {i for pair in overlaps for i in pair}:
        mine = sorted((p for p, stars in overlaps.items() if exposure in p and stars >= 3), key=lambda p: -overlaps[p])
        chosen.update(mine[:PARTNERS])
    return sorted(chosen)


def _misfits(known, telling):
    """Exposures that register with fewer than half of those with which they should, the worst first."""
    made = {frozenset(pair) for pair in known}
    pairs = [frozenset(pair) for pair in telling]
    out = {}
    while True:
        votes = {i: [pair in made for pair in pairs if i in pair] for pair in pairs for i in pair}
        shares = {i: np.mean(v) for i, v in votes.items() if len(v) >= 2}
        worst = min(shares, key=shares.get, default=None)
        if worst is None or shares[worst] >= 0.5:
            return out
        out[worst] = f"it agrees with only {sum(votes[worst])} of {len(votes[worst])} exposures that it should overlap"
        pairs = [pair for pair in pairs if worst not in pair]


def components(sizes, registrations):
    """Connected detections, regardless of contradictions.

    Parameters
    ----------
    sizes : list of int
        Detections of every exposure.
    registrations : dict of (int, int) to Registration

    Returns
    -------
    list of ndarray of int
        A label for every detection; alone means unpaired.
    """
    first, a, b, _ = _edges(sizes, registrations)
    n = first[-1]
    labels = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)[1]
    return np.split(labels, first[1:-1])


def label_stars(sizes, registrations):
    """Detections of the same star get the same label.

    A connected set that holds two detections of one exposure is taken apart: its closest pairs join first,
    and a pair that would bring the two together is ignored. Then whoever is paired with fewer than half of
    its companions (among the exposures registered with its own) is dismissed: hot pixels under a slow drift hang
    together only from one exposure to the next.

    Parameters
    ----------
    sizes : list of int
    registrations : dict of (int, int) to Registration

    Returns
    -------
    list of ndarray of int
        By exposure and detection; -1 for no star.
    """
    first, a, b, distance = _edges(sizes, registrations)
    exposure = np.repeat(np.arange(len(sizes)), sizes)
    labels = np.concatenate(components(sizes, registrations))
    _, inverse, count = np.unique(labels * len(sizes) + exposure, return_inverse=True, return_counts=True)
    torn = np.unique(labels[count[inverse] > 1])
    edges = np.flatnonzero(np.isin(labels[a], torn))
    _take_apart(labels, exposure, a[edges], b[edges], distance[edges])

    together = labels[a] == labels[b]
    degree = np.bincount(np.concatenate([a[together], b[together]]), minlength=len(labels))
    compared = np.zeros((len(sizes), len(sizes)))
    for i, j in registrations:
        compared[i, j] = compared[j, i] = 1
    present = coo_array((np.ones(len(labels)), (labels, exposure)), shape=(labels.max() + 1, len(sizes)))
    companions = (present @ compared)[labels, exposure]
    return np.split(np.where((degree > 0) & (degree >= 0.5 * companions), labels, -1), first[1:-1])


def _edges(sizes, registrations):
    """All pairs as serial numbers of detections; where each exposure's serials start; relative distances."""
    first = np.concatenate([[0], np.cumsum(sizes)])
    empty = [np.zeros(0, int)]
    a = np.concatenate([first[i] + r.source for (i, _), r in registrations.items()] or empty)
    b = np.concatenate([first[j] + r.target for (_, j), r in registrations.items()] or empty)
    return first, a, b, np.concatenate([r.distance / r.tolerance for r in registrations.values()] or empty)


def _take_apart(labels, exposure, a, b, distance):
    """Join pairs in order of distance unless an exposure would come twice; new labels in place."""
    members = {node: {node} for node in np.union1d(a, b).tolist()}
    for k in np.argsort(distance, kind="stable"):
        one, two = members[int(a[k])], members[int(b[k])]
        if one is not two and not {exposure[i] for i in one} & {exposure[i] for i in two}:
            one |= two
            for i in two:
                members[i] = one
    fresh = labels.max() + 1
    for group in {id(m): m for m in members.values()}.values():
        labels[list(group)] = fresh
        fresh += 1
