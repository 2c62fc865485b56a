"""How many stars tie the detectors of a camera to one another, and what rests on a few of them."""

from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import connected_components

#: Stars from which on a tie of two groups of detectors is believed: one more than determine shift, rotation and
#: scale, so that a wrong one shows.
FEWEST = 3


def seen_by(camera, table):
    """Which detectors, in the order of the camera, see which stars of a table, bool (n_detectors, n_stars)."""
    _, star = np.unique(np.asarray(table["star"]), return_inverse=True)
    seen = np.zeros((len(camera.detectors), star.max(initial=-1) + 1), dtype=bool)
    ids = camera.ids(table)
    for k, key in enumerate(camera.detectors):
        seen[k, star[ids == key]] = True
    return seen


def pairs(camera, table):
    """One dict a pair of detectors with stars in common: ``detectors``, ``n_stars``, and ``n_used`` of them.

    `table` has the columns ``detector``, ``star`` and ``used``.
    """
    seen, used = (seen_by(camera, each).astype(int) for each in (table, table[np.asarray(table["used"], dtype=bool)]))
    common, kept = seen @ seen.T, used @ used.T
    return [
        {"detectors": [a, b], "n_stars": int(common[i, j]), "n_used": int(kept[i, j])}
        for (i, a), (j, b) in combinations(enumerate(camera.detectors), 2)
        if common[i, j]
    ]


def believed(seen):
    """Number of the group of every detector, (n_detectors,), where ties by fewer than `FEWEST` stars do not count.

    `seen` (n_detectors, n_stars) is that of `seen_by`.
    """
    group = np.arange(len(seen))
    while True:
        of_group = np.array([seen[group == g].any(axis=0) for g in range(group.max(initial=-1) + 1)]).astype(int)
        joined = connected_components(of_group @ of_group.T >= FEWEST, directed=False)[1]
        if len(np.unique(joined)) == len(of_group):
            return group
        group = joined[group]


def few(camera, table):
    """Ties of fewer than `FEWEST` stars, a list of ``(detectors of one group, of the other, number of stars)``."""
    seen = seen_by(camera, table)
    group, keys = believed(seen), np.array(list(camera.detectors))
    out = []
    for a, b in combinations(range(group.max(initial=-1) + 1), 2):
        number = np.count_nonzero(seen[group == a].any(axis=0) & seen[group == b].any(axis=0))
        if number:
            out.append((keys[group == a].tolist(), keys[group == b].tolist(), int(number)))
    return out


def alone(camera, table):
    """Rows (n,) of a table without which no tie rests on fewer than `FEWEST` stars: where these are seen less."""
    group, ids = believed(seen_by(camera, table)), camera.ids(table)
    of_row = np.select([ids == key for key in camera.detectors], group, 0)
    _, star = np.unique(np.asarray(table["star"]), return_inverse=True)
    number = np.zeros((star.max(initial=-1) + 1, group.max(initial=-1) + 1), dtype=int)
    np.add.at(number, (star, of_row), 1)
    return of_row != number.argmax(axis=1)[star]


def in_words(found):
    """What `few` gives, for a reader."""
    return " and ".join(
        f"{number} star{'s' * (number > 1)} seen on both {' or '.join(one)} and {' or '.join(other)}"
        for one, other, number in found
    )


def apart(camera, table):
    """Groups that no used star ties to each other, in words with what there was; empty where there is one group.

    `table` has the columns ``detector``, ``star`` and ``used``.
    """
    groups = camera.groups(table[np.asarray(table["used"], dtype=bool)])
    if len(groups) < 2:
        return ""
    group = {key: g for g, keys in enumerate(groups) for key in keys}
    of_group = np.array([group.get(key, -1) for key in camera.detectors])
    seen = seen_by(camera, table)
    by_group = np.array([seen[of_group == g].any(axis=0) for g in range(len(groups))])
    lost = int(np.count_nonzero(by_group.sum(axis=0) > 1))
    why = f"the {lost} star{'s' * (lost > 1)} in common {'were' if lost > 1 else 'was'} left out of the fit"
    return f"{why if lost else 'no star in common'}: {' | '.join(', '.join(group) for group in groups)}"
