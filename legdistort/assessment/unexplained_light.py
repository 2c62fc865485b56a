"""Whether the stars of a solution are the stars of its frames: bright peaks that none explains, stars of halos.

The co-added image decides, where cosmic rays and what single frames have are gone from it.
"""

from dataclasses import dataclass

import numpy as np
from scipy import special
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree

from ..coaddition.combination import PixelFlag

#: Widths of a star: within the first a peak belongs to a star, at the second is the background of its height.
_OWN, _RING = 1.0, 3.0
#: Widths from a star between which false stars stand, of speckles, spikes and rings, and between which others do.
_NEAR, _FAR = (1.0, 6.0), (12.0, 18.0)
#: A star that much fainter may be part of the other.
_FAINTER = 0.1
#: Exposures among which what a single one has is told.
_CLIPPED = 3
_ROWS = 1024  # of the image that are looked at at a time


@dataclass(frozen=True)
class UnexplainedLight:
    """What the list of stars lacks, and what it has too much of.

    Attributes
    ----------
    n_peaks, n_without : int
        Unsaturated peaks of the co-added image as high as the brighter half of the stars, and those without a star.
    n_stars, n_around : int
        Stars, and those that stand around much brighter ones.
    by_chance : float
        How many would stand there by chance, as many as stand farther away from these.
    """

    n_peaks: int
    n_without: int
    n_stars: int
    n_around: int
    by_chance: float

    @property
    def share_without(self):
        """Part of the bright peaks that no star explains."""
        return self.n_without / max(self.n_peaks, 1)

    @property
    def share_around(self):
        """Part of the stars that stand around brighter ones beyond chance."""
        return max(self.n_around - self.by_chance, 0.0) / max(self.n_stars, 1)

    def p_without(self, usual):
        """Probability of so many peaks without a star where a part `usual` of them has none."""
        return float(special.bdtrc(self.n_without - 1, self.n_peaks, usual)) if self.n_without else 1.0

    @property
    def p_around(self):
        """Probability of so many stars around brighter ones by chance."""
        return float(special.pdtrc(self.n_around - 1, max(self.by_chance, 1.0))) if self.n_around else 1.0


def unexplained_light(mosaic, solution, *, fwhm):
    """The `UnexplainedLight` of a co-added image.

    Parameters
    ----------
    mosaic : Mosaic
        On the reference plane.
    solution : Solution
    fwhm : float
        Of the stars, pixels.

    Returns
    -------
    UnexplainedLight
    """
    stars = solution.estimate.positions
    known = np.isfinite(stars).all(axis=1)
    flux = np.asarray(solution.stars["flux"], dtype=float)[known] if "flux" in solution.stars.colnames else None
    stars = stars[known]
    n_around, by_chance = (0, 0.0) if flux is None else _around_brighter_ones(stars, flux, fwhm)
    xy = stars - mosaic.offset
    heights, covered = _heights(mosaic, xy, fwhm)
    if not np.isfinite(heights).any():
        return UnexplainedLight(0, 0, len(stars), n_around, by_chance)
    fewest = max(np.quantile(covered[np.isfinite(heights)], 0.1), min(_CLIPPED, mosaic.footprint.max()))
    peaks = _peaks(mosaic, fwhm, np.nanmedian(heights), fewest)
    without = KDTree(xy).query(peaks)[0] > max(_OWN * fwhm, 2.0) if len(peaks) else np.zeros(0, dtype=bool)
    return UnexplainedLight(len(peaks), int(np.count_nonzero(without)), len(stars), n_around, by_chance)


def _heights(mosaic, xy, fwhm):
    """Heights of places (n, 2) above the ring around them, NaN where that is not all there, and their exposures."""
    ny, nx = mosaic.shape
    reach = int(np.ceil(_RING * fwhm)) + 1
    x, y = np.round(xy).astype(int).T
    inside = (x >= reach) & (y >= reach) & (x < nx - reach) & (y < ny - reach)
    heights, covered = np.full(len(xy), np.nan), np.zeros(len(xy))
    x, y = x[inside], y[inside]
    angle = np.arange(16) * np.pi / 8
    dx, dy = (np.round(_RING * fwhm * f(angle)).astype(int) for f in (np.cos, np.sin))
    near_y, near_x = np.mgrid[-1:2, -1:2].reshape(2, -1)
    top = np.max(mosaic.data[y[:, None] + near_y, x[:, None] + near_x], axis=1, initial=-np.inf)
    full = (mosaic.flags[y[:, None] + near_y, x[:, None] + near_x] & PixelFlag.SATURATED).any(axis=1)
    heights[inside] = np.where(full, np.nan, top - np.median(mosaic.data[y[:, None] + dy, x[:, None] + dx], axis=1))
    covered[inside] = mosaic.footprint[y, x]
    return heights, covered


def _peaks(mosaic, fwhm, least, fewest):
    """Places (n, 2) of the peaks that are at least so high and on as many exposures."""
    width, found = 2 * int(np.ceil(fwhm)) + 1, []
    for first in range(0, mosaic.shape[0], _ROWS):
        low = max(first - width, 0)
        part = np.nan_to_num(mosaic.data[low : first + _ROWS + width], nan=-np.inf)
        y, x = np.nonzero((part == maximum_filter(part, width)) & np.isfinite(part))
        mine = (y + low >= first) & (y + low < first + _ROWS)
        xy = np.stack([x[mine], y[mine] + low], axis=1)
        heights, covered = _heights(mosaic, xy, fwhm)
        found.append(xy[(heights >= least) & (covered >= fewest)])  # NaN is not
    return np.concatenate(found)


def _around_brighter_ones(stars, flux, fwhm):
    """How many stars stand around much brighter ones, and how many would by what stands farther away from these."""
    low, high = stars.min(axis=0) + _FAR[1] * fwhm, stars.max(axis=0) - _FAR[1] * fwhm
    middle = ((stars >= low) & (stars <= high)).all(axis=1)
    tree, around, beyond = KDTree(stars), set(), 0
    for i in np.flatnonzero(middle):
        others = np.array(tree.query_ball_point(stars[i], _FAR[1] * fwhm))
        others = others[flux[others] < _FAINTER * flux[i]]
        distance = np.hypot(*(stars[others] - stars[i]).T) / fwhm
        around.update(others[(distance > _NEAR[0]) & (distance < _NEAR[1])].tolist())
        beyond += np.count_nonzero(distance > _FAR[0])
    area = (_NEAR[1] ** 2 - _NEAR[0] ** 2) / (_FAR[1] ** 2 - _FAR[0] ** 2)
    return len(around), float(beyond * area)
