"""Whether stars lie on a lattice, as the holes of a mask do: shifted by one of its periods they match as well."""

import numpy as np
from scipy.spatial import cKDTree

from ...exceptions import AssumptionWarning, some_of, warn
from ...geometry import similarity

_NEIGHBOURS = 6  # of every star among which the periods are
_LOOKED_AT, _TRIED = 4000, 300  # stars, and distances between neighbours of which the commonest is sought
_ALIKE = 0.1  # parts of a period by which it may differ between stars: distortion
_ON_IT = 0.05  # parts of the distance to the nearest star within which one is where the lattice has it
_FEWEST, _SHARE = 8, 0.5  # stars that a period must show, and part of those that have room for it
_ALONG = 0.5  # sine of the angle between two periods


def warn_of_lattice(lists, names, poses, headers):
    """Warn of stars on a lattice where headers do not tell matches from those that are off by a period.

    Parameters
    ----------
    lists : list of `~legdistort.matching.star_lists.StarList`
    names : list of str
    poses : dict of int to ndarray, each (2, 3)
        By the place of an exposure in these lists: how it was matched.
    headers : `~legdistort.matching.header_poses.HeaderPoses`
    """
    richest = max(poses, key=lambda i: (len(lists[i]), -i))
    xy, first = lists[richest].xy, names[richest]
    found = periods(xy)
    if not len(found):
        return
    reach, middle = np.hypot(*found[0]) / 2, xy.mean(axis=0)
    to_plane = similarity.invert(poses[richest])
    open_ones = []
    for i in sorted(poses):
        step, pose = headers.step(first, names[i]), similarity.compose(poses[i], to_plane)
        if step is None or np.hypot(*((pose - step) @ [*middle, 1])) > reach:
            open_ones.append(names[i])
    if not open_ones:
        return
    shown = " and ".join(f"({x:.1f}, {y:.1f})" for x, y in found)
    warn(
        f"the stars lie on a lattice, as of a mask: of period {shown} px in x, y of {first}; positions alone do not "
        f"tell right matches from those that are off by a period, nor do the headers of {some_of(open_ones, 3)}; give "
        "start positions right to half a period: start= (--start), exposures= with WCSs (--wcs); or number the stars: "
        "Matches.from_table",
        AssumptionWarning,
    )


def periods(xy):
    """Periods of the lattice on which stars lie.

    A star counts if another one is a period from it, nearer to that place than a twentieth of the distances which both
    have from their own neighbours; however dense or clustered stars are, that is so of one in 400 by chance.

    Parameters
    ----------
    xy : ndarray, shape (n, 2)
        Positions, distorted by less than makes periods differ by a tenth.

    Returns
    -------
    ndarray, shape (k, 2)
        The shortest period, and the next in another direction; none where stars do not lie on a lattice.
    """
    xy = np.unique(np.asarray(xy, dtype=float), axis=0)
    found = np.zeros((0, 2))
    if len(xy) < _FEWEST + _NEIGHBOURS:
        return found
    tree = cKDTree(xy)
    looked = np.arange(len(xy))[:: -(-len(xy) // _LOOKED_AT)]
    distance, near = tree.query(xy[looked], k=_NEIGHBOURS + 1)
    start = np.repeat(looked, _NEIGHBOURS)
    steps = xy[near[:, 1:].ravel()] - xy[start]
    for _ in range(2):
        period = _commonest(steps, xy[start], tree, looked, distance[:, 1])
        if period is None:
            break
        found = np.vstack([found, period])
        across = np.abs(steps @ [-period[1], period[0]])
        kept = across > _ALONG * np.hypot(*steps.T) * np.hypot(*period)
        steps, start = steps[kept], start[kept]
    return found[np.argsort(np.hypot(*found.T), kind="stable")]


def _commonest(steps, places, tree, looked, nearest):
    """The commonest step (2,) between neighbours if a lattice has it, else None."""
    if len(steps) < _FEWEST:
        return None
    length = np.hypot(*steps.T)
    tried = np.arange(len(steps))[:: -(-len(steps) // _TRIED)]
    number = cKDTree(steps).query_ball_point(steps[tried], _ALIKE * length[tried], return_length=True)
    best = steps[tried[np.argmax(number - 1e-6 * length[tried] / length.max())]]
    best = best * np.sign(best[np.argmax(np.abs(best))])
    members = np.hypot(*(steps - best).T) < _ALIKE * np.hypot(*best)
    if np.count_nonzero(members) < _FEWEST:
        return None
    middle, scale = places.mean(axis=0), np.ptp(places, axis=0).max()
    design = np.column_stack([np.ones(len(places)), (places - middle) / scale])
    period = np.linalg.lstsq(design[members], steps[members], rcond=None)[0]  # of distorted positions it changes slowly
    xy = tree.data[looked]
    to = xy + np.column_stack([np.ones(len(xy)), (xy - middle) / scale]) @ period
    inside = ((to >= tree.mins) & (to <= tree.maxes)).all(axis=1)
    off, other = tree.query(to[inside])
    own = tree.query(tree.data[other], k=2)[0][:, 1] if len(other) else off
    there = np.count_nonzero(off < _ON_IT * np.minimum(nearest[inside], own))
    return period[0] if there >= max(_FEWEST, _SHARE * len(other)) else None
