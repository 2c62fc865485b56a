"""Images of a camera that do not belong to their exposure: the list of another field, another exposure or detector.

The other detectors register such an exposure, and some of its detections lie near stars by chance.
"""

import numpy as np

from ...exceptions import AssumptionWarning, warn
from ...geometry import similarity

#: Of detections where others looked, less than this part of what is usual is of stars; from so many on; in words.
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
    ids, exposure = camera.ids(table), np.asarray(table["exposure"]).astype(str)
    numbers, inverse, count = np.unique(star, return_inverse=True, return_counts=True)
    tied = (numbers[inverse] >= 0) & (count[inverse] >= least)
    used = np.unique(ids[tied]).tolist()
    images = [each for each in dict.fromkeys(zip(exposure.tolist(), ids.tolist(), strict=True)) if each[1] in used]
    rows = {image: np.flatnonzero((exposure == image[0]) & (ids == image[1])) for image in images}
    shares = {image: tied[at].mean() for image, at in rows.items() if len(at) >= _ENOUGH}
    usual = np.median([*shares.values()]) if shares else 0.0
    xy, out, told = np.stack([table["x"].value, table["y"].value], axis=1), star.copy(), []
    for image in (image for image, share in shares.items() if share < _PART * usual):
        seen = rows[image][_seen_by_others(camera, xy, exposure, star, tied & (ids != image[1]), rows[image], image[0])]
        if len(seen) >= _ENOUGH and (n := np.count_nonzero(tied[seen])) < _PART * usual * len(seen):
            out[rows[image]] = -1
            told.append(f"{image[1]} of {image[0]} ({n} of {len(seen)})")
    if told:
        warn(
            f"hardly a detection where other exposures looked is a star of theirs, of detector {', '.join(told)}: "
            "nothing of it is used; is it the list of another field, exposure or detector?",
            AssumptionWarning,
        )
    return out


def _seen_by_others(camera, xy, exposure, star, tied, rows, name):
    """Which of an exposure's detections `rows` lie on a detector of another one, as stars on other detectors tell."""
    out, mine = np.zeros(len(rows), dtype=bool), np.flatnonzero((exposure == name) & tied)
    for other in dict.fromkeys(exposure.tolist()):
        if other == name:
            continue
        theirs = np.flatnonzero((exposure == other) & tied)
        _, i, j = np.intersect1d(star[mine], star[theirs], return_indices=True)
        if len(i) >= _FEWEST:
            pose = similarity.robust_similarity(xy[mine[i]], xy[theirs[j]])
            out |= camera.sees(similarity.apply(pose, xy[rows])).any(axis=0)
    return out
