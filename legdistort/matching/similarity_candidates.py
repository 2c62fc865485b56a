"""Rough similarities between two star lists, found without knowing where they point.

Two generators of candidates, from cheap to general: a vote on the offset, for
lists of nearly the same orientation, and triangles, which do not change under
rotation and a flip (the scale must agree to several per cent). Candidates are
guesses; `legdistort.matching.registration` judges them.
"""

from itertools import combinations

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter
from scipy.spatial import cKDTree

#: Largest difference in scale that a pair of triangles may have.
SCALE_TOLERANCE = 0.08
#: Radius of the search in triangle shapes (ratios of the sides).
SHAPE_TOLERANCE = 0.04
#: Lists longer than this take fewer neighbours, for speed.
CROWDED = 3000

_MOST_CELLS = 1e8  # of a vote, 800 MB


def offset_candidates(source, target, *, size, n_best=3):
    """Shifts that carry many of the source points near a target point.

    All differences target - source are counted in cells; the cells that stand out
    most above the expected background are returned, for a fine and a coarse cell
    (1.5 and 4.5 per cent of `size`), since rotation and distortion smear the peak.

    Parameters
    ----------
    source, target : ndarray, shapes (n, 2) and (m, 2)
    size : float
        Extent of the source points, pixels.
    n_best : int
        Number of shifts for each cell size.

    Returns
    -------
    iterator of ndarray, each (2,)
    """
    differences = (target.T[:, None] - source.T[:, :, None]).reshape(2, -1)
    low, high = differences.min(axis=1), differences.max(axis=1)
    spans = [(np.maximum(np.ptp(target[:, k]), 1), np.maximum(np.ptp(source[:, k]), 1)) for k in (0, 1)]
    for cell in (0.005 * size, 0.015 * size):
        if np.prod((high - low) / cell + 3) > _MOST_CELLS:
            continue  # of lists so unlike in extent no shift stands out
        bins = [np.arange(lo - cell, hi + 2 * cell, cell) for lo, hi in zip(low, high, strict=True)]
        cells = ((differences - [[b[0]] for b in bins]) / cell).astype(int)
        wide = len(bins[1])
        held = np.bincount(cells[0] * wide + cells[1], minlength=len(bins[0]) * wide)
        taken = np.flatnonzero(held > 0)
        votes = sum(held[taken + a * wide + b] for a in (-1, 0, 1) for b in (-1, 0, 1))
        taken, votes = taken[votes > 2], votes[votes > 2]
        i, j = np.divmod(taken, wide)
        # the difference of two uniform variables has a trapezium as its density
        profiles = [_trapezium(b + cell / 2, b_lo, *s) for b, b_lo, s in zip(bins, low, spans, strict=True)]
        expected = 9 * cell**2 * differences.shape[1] * profiles[0][i] * profiles[1][j]
        contrast = (votes - expected) / np.sqrt(expected + 1)
        order = np.argsort(-contrast, kind="stable")
        for k, m in _peaks(np.column_stack([i, j])[order], n_best):
            middle = [[bins[0][k] + cell / 2], [bins[1][m] + cell / 2]]
            near = np.all(np.abs(differences - middle) <= 1.5 * cell, axis=0)
            if near.sum() >= 3:
                yield np.median(differences[:, near], axis=1)


def _peaks(cells, n_best):
    """The first of some cells (n, 2), in order of preference, that have no preferred one beside them."""
    found = []
    for k, cell in enumerate(cells):
        if len(found) == n_best:
            break
        if np.all(np.abs(cells[:k] - cell).max(axis=1) > 1):
            found.append(cell)
    return found


def _trapezium(x, low, wide, narrow):
    x = x - low
    total = wide + narrow
    narrow, wide = min(wide, narrow), max(wide, narrow)
    return np.clip(np.minimum(x, total - x), 0, narrow) / (narrow * wide)


def triangle_candidates(source, target, *, n_neighbours=7, n_best=6):
    """Similarities, with or without a flip, on which many pairs of like triangles agree.

    Every star forms triangles with its nearest neighbours. Triangles with like ratios of
    sides and like size are paired; each pair implies a similarity, and the similarities
    that most others support are returned.

    Parameters
    ----------
    source, target : ndarray, shapes (n, 2) and (m, 2)
    n_neighbours : int
        Neighbours of each star that take part.
    n_best : int
        Number of similarities returned at most.

    Returns
    -------
    list of ndarray, each (2, 3)
        Poses that carry source to target, the best supported first.
    """
    if min(len(source), len(target)) < 4:
        return []
    shape_s, corners_s = _triangles(source, n_neighbours)
    shape_t, corners_t = _triangles(target, n_neighbours)
    pairs = cKDTree(shape_s).query_ball_tree(cKDTree(shape_t), SHAPE_TOLERANCE)
    first = np.repeat(np.arange(len(pairs)), [len(p) for p in pairs])
    if len(first) == 0:
        return []
    second = np.concatenate([np.array(p, dtype=int) for p in pairs if p])
    a = source[corners_s[first]] @ [1, 1j]
    b = target[corners_t[second]] @ [1, 1j]
    flipped = _orientation(a) != _orientation(b)
    a = np.where(flipped[:, None], a.conj(), a)
    centre = source.mean(axis=0) @ [1, 1j]
    da, db = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    factor = (da.conj() * db).sum(axis=1) / (np.abs(da) ** 2).sum(axis=1)
    place = b.mean(axis=1) + factor * (np.where(flipped, centre.conj(), centre) - a.mean(axis=1))
    # distances between two such points are rms distances in pixels over the field of the source
    size = np.sqrt(source.var(axis=0).sum())
    points = np.column_stack([factor.real * size, factor.imag * size, place.real, place.imag, 1e9 * flipped])
    members = cKDTree(points)
    support = members.query_ball_point(points, 0.08 * size, return_length=True)
    out = []
    free = np.ones(len(points), bool)
    for i in np.argsort(-support, kind="stable"):
        if len(out) == n_best or support[i] < 3:
            break
        if free[i]:
            near = members.query_ball_point(points[i], 0.08 * size)
            free[members.query_ball_point(points[i], 0.16 * size)] = False
            out.append(_pose(factor[near].mean(), place[near].mean(), centre, flipped[i]))
    return out


def scale_candidates(source, target, *, n_best=3):
    """Scales, target over source, on which many pairs of triangles of like shape agree, best first.

    Parameters
    ----------
    source, target : ndarray, shapes (n, 2) and (m, 2)
    n_best : int

    Returns
    -------
    list of float
    """
    shape_s, shape_t = (_triangles(xy, 7)[0] for xy in (source, target))
    pairs = cKDTree(shape_s[:, :2]).query_ball_tree(cKDTree(shape_t[:, :2]), SHAPE_TOLERANCE / 4)
    steps = [shape_t[others, 2] - own for own, others in zip(shape_s[:, 2], pairs, strict=True) if others]
    if not steps:
        return []
    ratios = np.concatenate(steps) * SCALE_TOLERANCE / SHAPE_TOLERANCE  # logarithms
    bins = np.arange(ratios.min() - 0.2, ratios.max() + 0.2, SCALE_TOLERANCE / 4)
    votes = 3 * uniform_filter(np.histogram(ratios, bins)[0].astype(float), 3)
    expected = uniform_filter(votes, 31)
    contrast = (votes - expected) / np.sqrt(expected + 1)
    peaks = np.where(maximum_filter(contrast, 7) == contrast, contrast, -np.inf)
    return [float(np.exp((bins[k] + bins[k + 1]) / 2)) for k in np.argsort(-peaks)[:n_best]]


def _triangles(xy, n_neighbours):
    """Shapes (n, 3) (two ratios of sides, scaled log size) and corners (n, 3), each opposite the shorter side first."""
    k = min(n_neighbours if len(xy) < CROWDED else n_neighbours - 2, len(xy) - 1)
    neighbours = cKDTree(xy).query(xy, k + 1)[1]
    columns = [neighbours[:, [0, i, j]] for i, j in combinations(range(1, k + 1), 2)]
    corners = np.unique(np.sort(np.concatenate(columns), axis=1), axis=0)
    p = xy[corners]
    sides = np.linalg.norm(p[:, [1, 2, 0]] - p[:, [2, 0, 1]], axis=2)
    order = np.argsort(sides, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    corners = np.take_along_axis(corners, order, axis=1)
    # slim triangles have no orientation, and their shape distinguishes little
    keep = sides[:, 0] + sides[:, 1] > 1.03 * sides[:, 2]
    sides, corners = sides[keep], corners[keep]
    size = np.log(sides[:, 2]) * SHAPE_TOLERANCE / SCALE_TOLERANCE
    return np.column_stack([sides[:, 0] / sides[:, 2], sides[:, 1] / sides[:, 2], size]), corners


def _orientation(z):
    return ((z[:, 1] - z[:, 0]) * (z[:, 2] - z[:, 0]).conj()).imag > 0


def _pose(factor, place, centre, flipped):
    sign = -1 if flipped else 1
    m = np.array([[factor.real, -sign * factor.imag], [factor.imag, sign * factor.real]])
    return np.column_stack([m, [place.real, place.imag] - m @ [centre.real, centre.imag]])
