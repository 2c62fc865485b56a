"""Groups of exposures laid on one another by the stars that each group shares.

Two exposures of few stars, half of them false, may have too little in common to stand out from chance. The stars that
several exposures share are more complete and hardly ever false: what fits no single exposure may fit these.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..geometry import similarity
from ..geometry.similarity import robust_similarity
from .linking import Group, interlink, label_stars
from .registration import Registration, register
from .star_lists import StarList, Warp, allowed_degree, fit_warp


@dataclass(frozen=True, eq=False)
class _Sky:
    """What a group sees: stars, ``{exposure: (rows, stars)}`` of its detections, pose from its plane to the list's."""

    stars: StarList
    seen: dict
    pose: np.ndarray


def unite(lists, groups, guess, *, tolerance=None):
    """Tie to the largest group whatever fits the stars that its exposures share.

    Parameters
    ----------
    lists : list of StarList
    groups : list of Group
        The largest first.
    guess, tolerance
        As in `legdistort.matching.linking.tie`.

    Returns
    -------
    list of Group
        The largest first.
    """
    main, *others = groups
    if not others or len(main.poses) == 1:
        return groups
    main, k = _linked(lists, main, tolerance), 0
    sky = _sky(lists, main)
    while k < len(others):
        other = _linked(lists, others[k], tolerance)
        whole = _united(main, sky, other, _sky(lists, other), guess, tolerance)
        if whole is None:
            k += 1
            continue
        main, k = _linked(lists, whole, tolerance), 0
        sky = _sky(lists, main)
        others = [o for o in others if not o.poses.keys() & main.poses.keys()]
    return [main, *others]


def _linked(lists, group, tolerance):
    return replace(group, registrations=interlink(lists, group, tolerance=tolerance)[0])


def _sky(lists, group, n_sweeps=3):
    """Mean positions of the stars of a group, distortions of the exposures relative to the mean fitted."""
    if len(group.poses) == 1:
        (only,) = group.poses
        every = np.arange(len(lists[only]))
        return _Sky(lists[only], {only: (every, every)}, group.poses[only])
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
    return _Sky(stars, seen, np.column_stack([np.eye(2), -low]))


def _mapped(stars, rows, places, pose):
    """Detections laid on their places by a polynomial, or left where the pose puts them if they are too few for one."""
    if len(rows) < 3:
        return similarity.apply(similarity.invert(pose), stars.xy[rows])
    p, parity = stars.xy[rows], np.sign(np.linalg.det(pose[:, :2]))
    degree = min(allowed_degree(len(rows)), 3)
    return fit_warp(p, places, stars.shape, degree, weights=np.ones(len(p)), width=1.0, parity=parity)(p)


def _united(main, sky, other, other_sky, guess, tolerance):
    """The group of both, or None if the other's stars are not those of the main one."""
    start = _guessed(main, sky, other, other_sky, guess)
    found = register(other_sky.stars, sky.stars, guess=start, tolerance=tolerance)
    if found is None:
        return None
    step = robust_similarity(other_sky.stars.xy[found.source], sky.stars.xy[found.target])
    to_other = similarity.compose(
        similarity.invert(other_sky.pose), similarity.compose(similarity.invert(step), sky.pose)
    )
    placed = {i: similarity.compose(pose, to_other) for i, pose in other.poses.items()}
    partner = np.full(len(other_sky.stars), -1)
    partner[found.source] = found.target
    distance = np.zeros(len(sky.stars))
    distance[found.target] = found.distance
    ties = dict(main.registrations) | other.registrations
    for i, (mine, stars) in sky.seen.items():
        for j, (theirs, other_stars) in other_sky.seen.items():
            shared, a, b = np.intersect1d(stars, partner[other_stars], return_indices=True)
            if len(shared):
                warp = Warp.from_pose(similarity.compose(placed[j], similarity.invert(main.poses[i])), sky.stars.shape)
                pairs = (mine[a], theirs[b]) if i < j else (theirs[b], mine[a])
                ties[min(i, j), max(i, j)] = Registration(
                    *pairs, distance[shared], warp, found.tolerance, found.strength
                )
    return Group(main.poses | placed, ties)


def _guessed(main, sky, other, other_sky, guess):
    """Pose from the other group's star list to the main one's by the headers, or None."""
    for j, there in other.poses.items():
        for i, here in main.poses.items():
            step = guess(j, i)
            if step is not None:
                plane = similarity.compose(similarity.invert(here), similarity.compose(step, there))
                return similarity.compose(sky.pose, similarity.compose(plane, similarity.invert(other_sky.pose)))
    return None
