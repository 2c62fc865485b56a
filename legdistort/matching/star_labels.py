"""From registered pairs of exposures to stars: which detections belong together, checked for mutual consistency."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def label_stars(sizes, registrations):
    """Detections of the same star get the same label.

    A star is a connected set of detections in which each is paired with at least half of those it was compared with. A
    set that holds two detections of one exposure is taken apart: its closest pairs join first, and a pair that would
    bring the two together is ignored. Then detections that are paired with fewer than half of their companions (among
    the exposures registered with their own) are dismissed: hot pixels under a slow drift hang together only from one
    exposure to the next.

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
    n = first[-1]
    labels = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(n, n)), directed=False)[1]
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
    for group in members.values():
        labels[list(group)] = len(labels) + min(group)
