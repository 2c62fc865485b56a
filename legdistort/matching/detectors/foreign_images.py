"""Images of a camera that do not belong to their exposure: the list of another field, another exposure or detector.

The other detectors register such an exposure, and some of its detections lie near stars by chance.
"""

import numpy as np

from ...exceptions import AssumptionWarning, warn
from ...geometry import similarity
from .detector_places import is_tied

#: Of detections where others looked, less than this part of what is usual is of stars; from so many on.
_PART, _ENOUGH = 0.25, 20
#: Fewest stars that tell how two exposures lie.
_FEWEST = 5


def without_foreign_images(camera, table, star, least):
    """Numbers of the stars (n,), with a warning -1 for images of which hardly a detection is a star of the others.

    Of those that lie where another exposure looked; of a detector of which nothing is used nothing is said.

    Parameters
    ----------
    camera : Camera
    table : QTable
        Detections (n,) in its focal plane, with their ``detector``.
    star : ndarray of int, shape (n,)
        Number of the star; negative for none.
    least : int
        Exposures that a star is in, to count.
    """
    if len(camera.detectors) < 2:
        return star
    ids, detector = np.unique(camera.ids(table), return_inverse=True)
    names, exposure = np.unique(np.asarray(table["exposure"]).astype(str), return_inverse=True)
    tied, image, n_images = is_tied(star, least), exposure * len(ids) + detector, len(names) * len(ids)
    size, n_tied = np.bincount(image, minlength=n_images), np.bincount(image, tied, minlength=n_images)
    used = np.bincount(detector, tied, minlength=len(ids)) > 0
    counted = (size >= _ENOUGH) & np.tile(used, len(names))
    shares = n_tied / np.maximum(size, 1)
    usual = np.median(shares[counted]) if counted.any() else 0.0
    xy, out, told = np.stack([table["x"].value, table["y"].value], axis=1), star.copy(), []
    for number in np.flatnonzero(counted & (shares < _PART * usual)):
        (i, c), rows = divmod(number, len(ids)), np.flatnonzero(image == number)
        seen = rows[_seen_by_others(camera, xy, exposure, star, tied & (detector != c), rows)]
        if len(seen) >= _ENOUGH and (n := np.count_nonzero(tied[seen])) < _PART * usual * len(seen):
            out[rows] = -1
            told.append(f"{ids[c]} of {names[i]} ({n} of {len(seen)})")
    if told:
        warn(
            f"hardly a detection where other exposures looked is a star of theirs, of detector {', '.join(told)}: "
            "nothing of it is used; is it the list of another field, exposure or detector?",
            AssumptionWarning,
        )
    return out


def _seen_by_others(camera, xy, exposure, star, tied, rows):
    """Which of an exposure's detections `rows` lie on a detector of another one, as stars on other detectors tell."""
    own = exposure[rows[0]]
    out, mine = np.zeros(len(rows), dtype=bool), np.flatnonzero((exposure == own) & tied)
    for other in np.setdiff1d(exposure, own):
        theirs = np.flatnonzero((exposure == other) & tied)
        _, i, j = np.intersect1d(star[mine], star[theirs], return_indices=True)
        if len(i) >= _FEWEST:
            pose = similarity.robust_similarity(xy[mine[i]], xy[theirs[j]])
            out |= camera.sees(similarity.apply(pose, xy[rows])).any(axis=0)
    return out
