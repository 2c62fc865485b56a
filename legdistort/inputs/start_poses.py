"""Poses of exposures from matched positions alone."""

import numpy as np

from ..exceptions import MatchError
from ..geometry import similarity
from ..geometry.similarity import robust_similarity


def star_means(xy, star, n_stars):
    """Mean position (n_stars, 2) of every star; NaN where a star has none."""
    total = np.bincount(star, minlength=n_stars)
    sums = np.column_stack([np.bincount(star, xy[:, k], n_stars) for k in (0, 1)])
    with np.errstate(invalid="ignore"):
        return sums / total[:, None]


def estimate_poses(exposure, star, xy, *, names=None):
    """Poses of all exposures from matched positions alone.

    The exposure with the most stars becomes the reference plane; the others are tied one after the
    other, each to all that already stand, the best connected first, then all are refined together.

    Parameters
    ----------
    exposure, star : ndarray of int, shape (n,)
    xy : ndarray, shape (n, 2)
    names : sequence of str, optional
        For messages.

    Returns
    -------
    list of ndarray, each (2, 3)

    Raises
    ------
    MatchError
        Naming an exposure that shares fewer than two stars with all the others.
    """
    n_exposures, n_stars = exposure.max() + 1, star.max() + 1
    names = range(n_exposures) if names is None else names
    rows = [np.flatnonzero(exposure == i) for i in range(n_exposures)]
    first = int(np.argmax([len(r) for r in rows]))
    found = {first: similarity.identity()}
    back = np.full_like(xy, np.nan)
    back[rows[first]] = xy[rows[first]]
    sums, counts = np.zeros((n_stars, 2)), np.zeros(n_stars)
    np.add.at(sums, star[rows[first]], xy[rows[first]])
    np.add.at(counts, star[rows[first]], 1)
    while len(found) < n_exposures:
        shared = {i: rows[i][counts[star[rows[i]]] > 0] for i in range(n_exposures) if i not in found}
        best = max(shared, key=lambda i: len(shared[i]))
        r = shared[best]
        if len(r) < 2 or np.all(np.ptp(xy[r], axis=0) == 0):
            raise MatchError(
                f"exposure {names[best]} shares {len(r)} star{'s' * (len(r) != 1)} with the other exposures; its shift "
                "and rotation need at least 2: give poses, or leave it out"
            )
        mean = sums[star[r]] / counts[star[r], None]
        found[best] = robust_similarity(mean, xy[r])
        off = np.hypot(*(similarity.apply(found[best], mean) - xy[r]).T)
        if np.median(off) > 0.05 * np.ptp(xy[r], axis=0).max():
            continue  # mismatched: it gets a pose, but has no say in those of the others
        back = similarity.apply(similarity.invert(found[best]), xy[rows[best]])
        np.add.at(sums, star[rows[best]], back)
        np.add.at(counts, star[rows[best]], 1)
    return _refine_poses([found[i] for i in range(n_exposures)], rows, star, xy)


def _scales(pose_list):
    return np.sqrt(np.abs(np.linalg.det(np.stack(pose_list)[:, :, :2])))


def _refine_poses(pose_list, rows, star, xy, n_sweeps=3):
    """Refit every pose to the mean of all, the first one's plane held by the mean of the poses."""
    ends = np.array([xy.min(axis=0), xy.max(axis=0)])
    for _ in range(n_sweeps):
        back = np.empty_like(xy)
        for pose, r in zip(pose_list, rows, strict=True):
            back[r] = similarity.apply(similarity.invert(pose), xy[r])
        mean = star_means(back, star, star.max() + 1)
        refined = [robust_similarity(mean[star[r]], xy[r]) for r in rows]
        old, new = ([similarity.apply(similarity.invert(p), ends) for p in pair] for pair in (pose_list, refined))
        usual = np.abs(np.log(_scales(refined) / np.median(_scales(refined)))) < np.log(1.5)
        old, new = (np.concatenate([pair for pair, keep in zip(ends_of, usual, strict=True) if keep])
                    for ends_of in (old, new))  # fmt: skip
        common = robust_similarity(old, new)
        pose_list = [similarity.compose(pose, common) for pose in refined]
    return pose_list
