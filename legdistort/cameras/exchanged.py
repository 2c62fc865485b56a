"""Detectors whose places were taken for one another, found by the stars that cross from one to the other.

An exposure of detectors in the wrong places still fits the others, as each detector moves with the dithers. But where a
star goes over to another detector, it does not arrive.
"""

from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from ..exceptions import InputError, MatchError
from ..geometry import similarity
from ..inputs.start_poses import estimate_poses

#: Positions of a star on two detectors agree within so many pixels, or this part of the distance between stars.
_NEAR, _PART = 20.0, 0.25
#: Fewest stars on two detectors by their numbers that prove the places of both, if half of them agree.
_FEWEST = 10
#: Standard errors of the difference of two counts beyond which places are taken as exchanged.
_SURE = 4.0


def check_places(matches):
    """Raise `InputError` if more stars cross from detector to detector with two of these exchanged.

    By more than chance, 4 standard errors of the difference; with the right places it is always fewer. Of several
    fields without a common star each is looked at by itself. Nothing shows where exposures have too few stars on the
    same detectors as others, as those of another roll may.

    Parameters
    ----------
    matches : Matches
        Of a camera.
    """
    if len(matches.camera.detectors) < 2:
        return
    fields = matches.fields[matches.observations.exposure]
    for field in np.unique(fields):
        _check_field(matches.keep(fields == field) if fields.any() else matches)


def _check_field(matches):
    """What `check_places` does, of exposures that have stars in common."""
    camera = matches.camera
    keys, detector = np.unique(camera.ids(matches.table), return_inverse=True)
    xy = np.stack([matches.table[f"{axis}_detector"].value for axis in "xy"], axis=1)
    proved = _proved(matches, detector)
    if np.all(proved[~np.eye(len(keys), dtype=bool)]):
        return
    focal = {(a, b): camera[b].to_focal_plane(xy[detector == k]) for k, a in enumerate(keys) for b in keys}
    given = _crossing(matches, detector, [focal[key, key] for key in keys])
    for (i, a), (j, b) in combinations(enumerate(keys), 2):
        if given is None or camera[a].shape != camera[b].shape or proved[i, j]:
            continue
        other = _crossing(matches, detector, [focal[key, {a: b, b: a}.get(key, key)] for key in keys])
        if other is None:
            continue
        exchanged, kept = (sum(n for pair, n in each.items() if {i, j} & {*pair}) for each in (other, given))
        if exchanged - kept > _SURE * np.sqrt(exchanged + kept):
            raise InputError(
                f"detectors {a} and {b} of camera {camera.name} seem to be exchanged: with the places of these two "
                f"exchanged {exchanged} stars are on one of them and another detector, {kept} as they are; exchange "
                "them in the camera, or in what names the detectors in the headers"
            )


def _proved(matches, detector):
    """Of which pairs of detectors most stars that are on others too are so by numbers and positions: bool (n, n)."""
    observations, poses = matches.observations, [matches.poses[name] for name in matches.names]
    n_detectors, star = detector.max() + 1, observations.star
    seen = np.zeros((n_detectors, star.max() + 1), dtype=int)
    seen[detector, star] = 1
    by_number, by_place = seen @ seen.T, np.zeros((n_detectors, n_detectors), dtype=int)
    np.fill_diagonal(by_number, 0)
    for (i, j), number in _agreeing(observations, detector, observations.xy, poses).items():
        by_place[i, j] = by_place[j, i] = number
    number, agreeing = (each.sum(axis=0) + each.sum(axis=0)[:, None] - each for each in (by_number, by_place))
    return (number >= _FEWEST) & (agreeing > number / 2)


def _crossing(matches, detector, focal):
    """Numbers of stars on each pair of detectors, by positions in the focal plane, one array for each detector.

    What a detector sees of a star counts as a star of its own, so that poses rest on each detector by itself. None
    where these do not determine the poses.
    """
    f, observations = np.empty((len(detector), 2)), matches.observations
    for k, each in enumerate(focal):
        f[detector == k] = each
    star = np.unique(np.stack([observations.star, detector]), axis=1, return_inverse=True)[1].ravel()
    try:
        poses = estimate_poses(observations.exposure, star, f)
    except MatchError:
        return None
    return _agreeing(observations, detector, f, poses)


def _agreeing(observations, detector, f, poses):
    """Of each pair of detectors the number of pairs of stars that agree, by positions f (n, 2) in the focal plane."""
    f = similarity.apply_inverses(np.asarray(poses)[observations.exposure], f[:, None])[:, 0]
    first = np.unique(np.stack([observations.star, detector]), axis=1, return_index=True)[1]
    at = [f[first[detector[first] == k]] for k in range(detector.max() + 1)]
    trees, near = [cKDTree(each) for each in at], _nearness(at)
    pairs = combinations(range(len(trees)), 2)
    return {(i, j): trees[i].count_neighbors(trees[j], near) for i, j in pairs}


def _nearness(at):
    """Within how many pixels positions (n, 2) of stars on each detector agree."""
    apart = [np.median(cKDTree(each).query(each, k=2)[0][:, 1]) for each in at if len(each) > 1]
    return min([_NEAR, *(_PART * distance for distance in apart)])
