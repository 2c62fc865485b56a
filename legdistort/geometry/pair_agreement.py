"""Which exposures agree with one another, pair by pair, before anything is fitted to all of them.

The positions of the stars that two exposures share are laid on one another by an affine map, robustly. What then lies
farther off than any distortion could bring it is a gross error. A few of them are usual: 1 to 10 % of routine data
(Hampel, Ronchetti, Rousseeuw & Stahel 1986, Robust Statistics, section 1.2c). Two exposures contradict each other when
most of their stars are off and chance does not explain that by `GROSS` errors in each.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.special import bdtrc

#: Usual share of gross errors in an exposure.
GROSS = 0.05
#: Probability below which chance is no explanation.
SIGNIFICANT = 1e-6
#: A position is off beyond this part of the median distance of the stars from their middle: 4 % of a detector that they
#: fill. Affine part aside, the distortions of cameras are smaller, even between exposures turned by 180 degrees.
REACH = 0.1
#: Share of random positions that lie so near to where they ought to be: 0.5 % in even fields, more if clumpy.
NEAR_BY_CHANCE = 0.02
#: Exposures with which one is compared, those with most stars in common, and stars that are looked at, at most.
PARTNERS, MOST_STARS = 16, 100
#: Points that determine an affine map.
_OF_MAP = 3


@dataclass(frozen=True)
class Verdict:
    """The largest group of exposures that agree, and those that contradict it (numbers of exposures, ascending).

    Attributes
    ----------
    group : tuple of int
    against : tuple of int
        Exposures that contradict one of the group and agree with none.
    rivals : tuple of int
        Those of them that agree with another one of them.
    """

    group: tuple
    against: tuple
    rivals: tuple


def beyond_chance(n_off, n, share=GROSS):
    """Whether n_off of n positions or more are off though a `share` of them is usual, and so are most."""
    return n_off > n / 2 and bdtrc(n_off - 1, n, share) < SIGNIFICANT


def compare(exposure, star, xy):
    """Compare exposures in pairs.

    Parameters
    ----------
    exposure, star : ndarray of int, shape (n,)
        A star stands at most once in an exposure.
    xy : ndarray, shape (n, 2)
        Pixels, without the distortion as far as it is known.

    Returns
    -------
    Verdict
    """
    n_exposures = int(exposure.max()) + 1
    order = np.lexsort([star, exposure])
    star, xy = star[order], xy[order]
    start = np.searchsorted(exposure[order], np.arange(n_exposures + 1))
    rows = [slice(*ends) for ends in pairwise(start)]
    agree, contradict = np.zeros((2, n_exposures, n_exposures), dtype=bool)
    for i, k in _pairs(exposure, star, order):
        _, a, b = np.intersect1d(star[rows[i]], star[rows[k]], assume_unique=True, return_indices=True)
        few = np.unique(np.linspace(0, len(a) - 1, min(len(a), MOST_STARS)).astype(int))
        n_off, n = len(few) - _n_near(xy[rows[i]][a[few]], xy[rows[k]][b[few]]), len(few)
        contradict[i, k] = contradict[k, i] = beyond_chance(n_off, n, 1 - (1 - GROSS) ** 2)
        free = n - _OF_MAP  # so many stars the map may have followed
        agree[i, k] = free > 0 and bdtrc(free - n_off - 1, free, NEAR_BY_CHANCE) < SIGNIFICANT
    return _verdict(agree, contradict)


def _pairs(exposure, star, order):
    """Pairs (i, k), i < k, that share more stars than a map takes up, of every exposure those with most."""
    shape = int(exposure.max()) + 1, int(star.max()) + 1
    seen = csr_array((np.ones(len(star), dtype=np.int32), (exposure[order], star)), shape=shape)
    shared = (seen @ seen.T).toarray()
    np.fill_diagonal(shared, 0)
    rank = np.argsort(np.argsort(-shared, axis=1, kind="stable"), axis=1)
    chosen = (rank < PARTNERS) & (shared > _OF_MAP)
    return np.argwhere(np.triu(chosen | chosen.T))


def _n_near(source, target):
    """Number of `target` positions (n, 2) near where a robust affine map carries the `source`."""
    reach = REACH * np.median(np.hypot(*(target - np.median(target, axis=0)).T))
    return int(np.count_nonzero(affine_distances(source, target, least=1e-3 * reach) <= reach))


def affine_distances(source, target, least=0.0):
    """Distances (n,) of `target` positions (n, 2) from where a robust affine map carries the `source`.

    Parameters
    ----------
    source, target : ndarray, shape (n, 2)
        Pixels.
    least : float
        Median distance that is small enough.
    """
    middle = np.median(target, axis=0)
    size = np.ptp(source, axis=0).max() or 1.0
    columns = np.column_stack([np.ones(len(source)), (source - source.mean(axis=0)) / size])
    weight = np.ones(len(source))
    for _ in range(20):
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(root * columns, root * (target - middle), rcond=None)[0]
        off2 = ((columns @ found - (target - middle)) ** 2).sum(axis=1)
        scale2 = np.median(off2)
        if scale2 <= least**2:
            break
        weight = 1 / (1 + off2 / scale2)
    return np.sqrt(off2)


def _verdict(agree, contradict):
    label = connected_components(agree, directed=False)[1]
    first = np.argmax(np.bincount(label)[label])  # of the largest group
    group = label == label[first]
    against = contradict[group].any(axis=0) & ~group
    alone = np.bincount(label[against], minlength=label.max() + 1) < 2
    rivals = against & ~alone[label]
    return Verdict(*(tuple(np.flatnonzero(which).tolist()) for which in (group, against, rivals)))
