"""Detectors whose places were taken for one another, found by the stars that cross from one to the other.

An exposure of detectors in the wrong places still fits the others, as each detector moves with the dithers. But where a
star goes over to another detector, it does not arrive.
"""

from collections import Counter
from contextlib import suppress
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..exceptions import InputError, MatchError
from ..geometry import similarity
from ..inputs.start_poses import estimate_poses

#: Positions of a star on two detectors agree within so many pixels, or this part of the distance between stars.
_NEAR, _PART = 20.0, 0.25
#: Fewest stars on two detectors by their numbers that prove the places of both, if this part of them agrees: of stars
#: that were matched by chance in wrong places half may.
_FEWEST, _MOST = 10, 0.8
#: Standard errors of the difference of two counts beyond which places are taken as exchanged.
_SURE = 4.0
#: Fewest stars that two exposures have in common, each on one detector, whose poses are compared.
_COMMON = 3


class Exchanged(NamedTuple):
    """Two detectors of a camera in each other's places, and how many stars cross from them to others then and now."""

    pair: tuple
    crossing: int
    kept: int

    @property
    def words(self):
        """What the stars say, as the end of a sentence."""
        return (
            f"with the places of these two exchanged {self.crossing} stars are on one of them and another detector, "
            f"{self.kept} as they are"
        )


def check_places(matches):
    """Raise `InputError` if two detectors are `exchanged`."""
    if found := exchanged(matches):
        raise InputError(
            f"detectors {found.pair[0]} and {found.pair[1]} of camera {matches.camera.name} seem to be exchanged: "
            f"{found.words}; exchange them in the camera, or in what names the detectors in the headers; or give a "
            "camera in which they are where they belong (--camera)"
        )


def exchanged(matches):
    """The two detectors with which exchanged more stars cross from detector to detector: `Exchanged`, or None.

    By more than chance, 4 standard errors of the difference; with the right places it is always fewer. Of several
    fields without a common star each is looked at by itself.

    Parameters
    ----------
    matches : Matches
        Of a camera.
    """
    if len(matches.camera.detectors) < 2:
        return None
    fields = matches.fields[matches.observations.exposure]
    each = (_exchanged_in(matches.keep(fields == field) if fields.any() else matches) for field in np.unique(fields))
    return next((found for found in each if found), None)


def _exchanged_in(matches):
    """The same of exposures that have stars in common."""
    camera = matches.camera
    keys, detector = np.unique(camera.ids(matches.table), return_inverse=True)
    xy = np.stack([matches.table[f"{axis}_detector"].value for axis in "xy"], axis=1)
    proved = _proved(matches, detector)
    if np.all(proved[~np.eye(len(keys), dtype=bool)]):
        return None
    focal = {(a, b): camera[b].to_focal_plane(xy[detector == k]) for k, a in enumerate(keys) for b in keys}
    given = _crossing(matches, detector, [focal[key, key] for key in keys])
    for (i, a), (j, b) in combinations(enumerate(keys), 2):
        if camera[a].shape != camera[b].shape or proved[i, j]:
            continue
        other = _crossing(matches, detector, [focal[key, {a: b, b: a}.get(key, key)] for key in keys])
        crossing, kept = (sum(n for pair, n in each.items() if {i, j} & {*pair}) for each in (other, given))
        if crossing - kept > _SURE * np.sqrt(crossing + kept):
            return Exchanged((a, b), crossing, kept)
    return None


def _proved(matches, detector):
    """Of which pairs of detectors nearly all stars on others too are there by numbers and positions: bool (n, n)."""
    observations, poses = matches.observations, [matches.poses[name] for name in matches.names]
    n_detectors, star = detector.max() + 1, observations.star
    seen = np.zeros((n_detectors, star.max() + 1), dtype=int)
    seen[detector, star] = 1
    by_number, by_place = seen @ seen.T, np.zeros((n_detectors, n_detectors), dtype=int)
    np.fill_diagonal(by_number, 0)
    seen_at = observations.exposure, observations.star, detector, observations.xy
    for (i, j), number in _agreeing(*seen_at, poses).items():
        by_place[i, j] = by_place[j, i] = number
    number, agreeing = (each.sum(axis=0) + each.sum(axis=0)[:, None] - each for each in (by_number, by_place))
    return (number >= _FEWEST) & (agreeing > _MOST * number)


def _crossing(matches, detector, focal):
    """Numbers of stars on each pair of detectors, by positions in the focal plane, one array for each detector.

    What a detector sees of a star counts as a star of its own, so that poses rest on each detector by itself. Exposures
    that no detector ties to each other, as where the camera is turned by 90 deg, are counted apart.
    """
    f, observations = np.empty((len(detector), 2)), matches.observations
    for k, each in enumerate(focal):
        f[detector == k] = each
    star = np.unique(np.stack([observations.star, detector]), axis=1, return_inverse=True)[1].ravel()
    counts = Counter()
    for group in _tied(observations.exposure, star):
        rows = np.isin(observations.exposure, group)
        exposure, own = (np.unique(each[rows], return_inverse=True)[1] for each in (observations.exposure, star))
        with suppress(MatchError):  # in places that exposures contradict
            poses = estimate_poses(exposure, own, f[rows])
            counts.update(_agreeing(exposure, observations.star[rows], detector[rows], f[rows], poses))
    return counts


def _tied(exposure, star):
    """Exposures that have stars in common, directly or through others: an array of numbers for each group."""
    sees = coo_array((np.ones(len(star), dtype=int), (exposure, star))).tocsr()
    group = connected_components((sees @ sees.T) >= _COMMON, directed=False)[1]
    return [np.flatnonzero(group == g) for g in range(group.max() + 1)]


def _agreeing(exposure, star, detector, f, poses):
    """Of each pair of detectors the number of pairs of stars that agree, by positions f (n, 2) in the focal plane."""
    f = similarity.apply_inverses(np.asarray(poses)[exposure], f[:, None])[:, 0]
    first = np.unique(np.stack([star, detector]), axis=1, return_index=True)[1]
    at = [f[first[detector[first] == k]] for k in range(detector.max() + 1)]
    trees, near = [cKDTree(each) for each in at], _nearness(at)
    pairs = combinations(range(len(trees)), 2)
    return {(i, j): trees[i].count_neighbors(trees[j], near) for i, j in pairs}


def _nearness(at):
    """Within how many pixels positions (n, 2) of stars on each detector agree."""
    apart = [np.median(cKDTree(each).query(each, k=2)[0][:, 1]) for each in at if len(each) > 1]
    return min([_NEAR, *(_PART * distance for distance in apart)])
