"""Blends: stars that touch, found and fitted together."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

_LARGEST = 6  # stars fitted together; the work grows with the square


def group_stars(xy, radius, *, largest=_LARGEST):
    """Numbers of the groups in which every star has another one within a radius.

    The groups of ``photutils.psf.SourceGrouper``, in memory that does not grow with the square of the number of
    stars. A group too large is divided by a smaller radius: what is farthest apart disturbs itself least.

    Parameters
    ----------
    xy : ndarray, shape (n, 2)
    radius : float
        [pix]
    largest : int
        Stars of a group.

    Returns
    -------
    ndarray of int, shape (n,)
    """
    n = len(xy)
    if radius < 0.5:  # of pixels none are closer; places that coincide cannot be distinguished
        return np.arange(n)
    i, j = cKDTree(xy).query_pairs(radius, output_type="ndarray").T
    labels = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)[1]
    large = np.bincount(labels, minlength=1)[labels] > largest
    if large.any():
        labels[large] = n + group_stars(xy[large], 0.8 * radius, largest=largest)
    return np.unique(labels, return_inverse=True)[1]


def members(labels):
    """Stars of the groups of one size after the other, (n groups, size); negative numbers are no groups."""
    order, sizes = np.argsort(labels, kind="stable"), np.bincount(labels[labels >= 0])
    first = np.cumsum(sizes) - sizes + np.count_nonzero(labels < 0)
    for size in np.unique(sizes[sizes > 0]):
        yield order[first[sizes == size][:, None] + np.arange(size)]


def partner_models(stamps, labels, params, evaluate):
    """Light that the other stars of its group leave on every stamp, (n, npix).

    Parameters
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    labels : ndarray of int, shape (n,)
    params : ndarray, shape (n, k)
        Of the stars, the first three: x, y from the central pixel of the stamp, peak or flux.
    evaluate : callable
        ``evaluate(params, stars)``: light (m, npix) of stars on stamps, positions counted from their middles.
    """
    out = np.zeros_like(stamps.data)
    for stars in members(labels):
        if (g := stars.shape[1]) > 1:
            i, j = (k.ravel() for k in np.nonzero(~np.eye(g, dtype=bool)))
            seen = params[stars[:, i]]
            seen[..., :2] += stamps.centres[stars[:, i]] - stamps.centres[stars[:, j]]
            light = evaluate(seen.reshape(-1, seen.shape[-1]), stars[:, i].ravel()).reshape(*seen.shape[:2], -1)
            light[params[stars[:, i], 2] <= 0] = 0  # as the models of all stars
            np.add.at(out, stars[:, j], light)
    return np.where(stamps.inside, out, 0)


def fit_groups(found, labels, pixels, start, *, stamps, centre, fitting):
    """The fit with all groups fitted anew, the stars of one together: with one shape and one background.

    Parameters
    ----------
    found : `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        Before, one row a star.
    labels : ndarray of int, shape (n,)
        From `group_stars`; stars with a negative one stay as they are.
    pixels : tuple of ndarray, shape (n, npix)
        Stamps with the light of the own group only, and inverse variances.
    start : ndarray, shape (n, 8)
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
    centre : ndarray, shape (4,) or (n, 4)
        Of the prior of the shapes.
    fitting : callable
        `legdistort.measurement.profiles.levenberg_marquardt.fit`, how to fit being settled.

    Returns
    -------
    `~legdistort.measurement.profiles.levenberg_marquardt.Fit`
        One row a star.
    """
    data, weights = pixels
    centre = np.broadcast_to(centre, (len(start), 4))
    for stars in members(labels):
        m, g = stars.shape
        if g == 1:
            rows = stars[:, 0]
            part = fitting(data[rows], weights[rows], start[rows], centre=centre[rows])
        else:
            once = counted_once(weights[stars].reshape(m, -1), stamps.index[stars].reshape(m, -1))
            leader = stars[np.arange(m), np.argmax(start[stars, 2], axis=1)]
            first = np.hstack([start[stars, :3].reshape(m, -1), centre[leader], start[leader, 7:]])
            offsets = stamps.centres[stars]
            part = fitting(data[stars].reshape(m, -1), once, first, centre=centre[leader], offsets=offsets)
        found = found.updated(stars.ravel(), part.by_star())
    return found


def counted_once(weights, index):
    """Weights (n, k), every pixel counted once, in the first stamp that has it; `index` (n, k) names pixels."""
    index = np.where(weights > 0, index, -1 - np.arange(index.shape[1]))
    order = np.argsort(index, axis=1, kind="stable")
    ordered = np.take_along_axis(index, order, axis=1)
    again = np.zeros(index.shape, dtype=bool)
    np.put_along_axis(again, order[:, 1:], ordered[:, 1:] == ordered[:, :-1], axis=1)
    return np.where(again, 0, weights)
