"""Light far from bright stars that is fixed to the pupil: rings, arms, spots of the mirror, quasi-static speckles.

It follows every star, at the same vector offset and with its brightness. So the *other* bright stars of the frame
show what there is around each: their weighted mean at the same offset, the cores of neighbours masked, out to 30 FWHM
or the mean distance of stars. It counts where two halves of the stars agree on it, and its error, and a tenth of it,
join the noise. Nothing need be known of the profile; in crowds, where others hide it, nothing is done.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree

from .sidelobes import summits

_REACH, _LEAST, _CORE = 30.0, 8.0, 2.0  # FWHM: how far from a star structure is looked for, at least; from where on
_MASKED, _WIDE, _WIDEST = 1.5, 4.0, 8.0  # FWHM around other stars, which hide it: least, as bright ones, most
_RING = 0.5  # FWHM, width of the rings on which it is seen whether there is anything
_MOST, _SHOWING, _FEWEST = 40, 16, 4  # stars that show it; at least, if there are; on a pixel
_VALUES = 3_000_000  # pixels of all of them
#: Brightest structure, relative to the star, at 1 FWHM, and the power with which it falls: generous bounds. First rings
#: of an obstructed pupil have 0.02 to 0.06 at 1.6 FWHM, and side lobes of 0.8 rad of coma 0.2. At least: spots.
_BRIGHTEST, _FALL, _FAINT = 10.0, 4.0, 0.02
_DIFFERS = 0.1  # of the structure, by which it differs from star to star
_OUTLIER = 5.0  # standard deviations from the median of the stars, beyond which they count nothing
_MEDIAN = 0.4549  # of the square of a unit normal
_CERTAIN, _PEAK = 3.0, 3.0  # standard deviations of the power on a ring, and of a spot in either half
_SMOOTHED = 2  # rings on either side that count too
_CORRELATED = 0.57  # FWHM^2 of the filtered image that count as one
_PASSES = 2
_WINGS = 3.0  # FWHM^2 that show how bright a star is whose top is not seen
_COVERED = 0.35  # of the stars, by others at a place near them: what is seen in such a crowd is light of others
_STANDS = 0.5  # of its light, structure of others under a star that may itself have structure
_TAPS = np.arange(-2, 4)  # of the interpolation: Lagrange polynomials of degree 5
_OTHERS = np.stack([np.delete(_TAPS, k) for k in range(len(_TAPS))])


def pupil_structure(image, variance, x, y, fwhm, threshold, *, hidden=None):
    """Light expected from what stars have around them, and its variance.

    Parameters
    ----------
    image, variance : ndarray, shape (ny, nx)
        Filtered with a kernel of zero sum; its variance, infinite where nothing is known.
    x, y : ndarray of int, shape (n,)
        Peaks of the image.
    fwhm : float
        Of the stars [pix].
    threshold : float
        Signal-to-noise ratio from which a peak may be a star.
    hidden : ndarray of bool, shape (ny, nx), optional
        Pixels that determine nothing: saturated ones.

    Returns
    -------
    light, error : ndarray, shape (ny, nx), or None
        In units of the image and its variance. None if there is no structure.
    """
    order = np.argsort(-image[y, x], kind="stable")
    x, y = x[order], y[order]
    half = int(min(np.ceil(_REACH * fwhm), np.sqrt(_VALUES / _SHOWING) / 2))
    xy = summits(image, x, y)
    stars = _are_clear(xy, image[y, x], fwhm, half)
    half = int(min(half, _apart(xy[stars], image.size)))
    if half < _LEAST * fwhm:
        return None
    sky = _Padded.of(image, variance, half)
    tops = sky.at(xy)
    known = np.isfinite(tops) & (tops > 0)
    if hidden is not None:
        known &= ~hidden[y, x]
    found = None
    for _ in range(_PASSES):
        if not (stars & known).any():
            break
        shown = _Shown(sky, xy, tops, (np.flatnonzero(stars), np.flatnonzero(stars & known)), fwhm, half)
        if shown.covered > _COVERED or not shown.power.any():
            return None
        scaled = tops.copy()
        for k in np.flatnonzero(~known):
            scaled[k] = np.fmax(tops[k], shown.scale(xy[k]))
        stars, *found = _cleaned(sky, (x, y, xy, scaled), shown, threshold)
    return found and [part[sky.margin : -sky.margin, sky.margin : -sky.margin] for part in found]


def _apart(xy, area):
    """Distance between stars [pix], where most of them are."""
    if len(xy) < 2:
        return np.sqrt(area)
    nearest = np.median(cKDTree(xy).query(xy, k=2)[0][:, 1])
    return min(np.sqrt(area / len(xy)), 2 * nearest)  # of stars strewn at random both are the same


def _are_clear(xy, value, fwhm, half):
    """Peaks, the brightest first, that cannot be structure of brighter ones."""
    clear = np.ones(len(xy), dtype=bool)
    i, j = cKDTree(xy).query_pairs(half, output_type="ndarray").T
    i, j = np.minimum(i, j), np.maximum(i, j)
    distance = np.hypot(*(xy[i] - xy[j]).T) / fwhm
    clear[j[value[j] < np.maximum(_BRIGHTEST * distance**-_FALL, _FAINT) * value[i]]] = False
    return clear


@dataclass(frozen=True, eq=False)
class _Padded:
    """An image and its variance with nothing all around, to be seen from stars near its edges."""

    image: np.ndarray
    variance: np.ndarray
    margin: int

    @classmethod
    def of(cls, image, variance, half):
        margin = half + len(_TAPS)
        image = np.where(np.isfinite(variance), image, np.nan)
        return cls(np.pad(image, margin, constant_values=np.nan), np.pad(variance, margin, mode="edge"), margin)

    def around(self, place, half):
        """The image as seen from a place between its pixels, and its variance; (2 half + 1, 2 half + 1)."""
        x, y = np.floor(place).astype(int) + self.margin
        part = self.image[y - half - 2 : y + half + 4, x - half - 2 : x + half + 4]
        there = np.round(place).astype(int) + self.margin
        return _shifted(part, place % 1), self.variance[_square(there, half)]

    def at(self, xy):
        """The image at places between its pixels, (n,)."""
        low = np.floor(xy).astype(int) + self.margin
        rows, columns = low[:, 1, None] + _TAPS, low[:, 0, None] + _TAPS
        x, y = (_lagrange(part) for part in (xy % 1).T)
        return np.einsum("ni,nij,nj->n", y, self.image[rows[:, :, None], columns[:, None]], x)


def _square(pixel, half):
    return tuple(slice(p - half, p + half + 1) for p in pixel[::-1])


def _lagrange(part):
    """Weights of the taps at parts of a pixel, (..., 6)."""
    return np.prod((np.asarray(part)[..., None, None] - _OTHERS) / (_TAPS[:, None] - _OTHERS), axis=-1)


def _shifted(image, part):
    """An image as seen from parts of a pixel (x, y) to the right and up; five rows and columns fewer."""
    x, y = (_lagrange(p).astype(image.dtype) for p in part)
    ny, nx = np.subtract(image.shape, len(_TAPS) - 1)
    image = sum(w * image[k : k + ny] for k, w in enumerate(y))
    return sum(w * image[:, k : k + nx] for k, w in enumerate(x))


class _Shown:
    """What bright stars show around them, relative to their tops, on a square of pixels.

    Parameters
    ----------
    sky : _Padded
    xy, tops : ndarray
        Peaks, the brightest first.
    stars : tuple of ndarray of int
        Those that are stars; of them, those whose tops are known.
    fwhm : float
    half : int
        Half the side of the square.
    """

    def __init__(self, sky, xy, tops, stars, fwhm, half):
        v, u = np.mgrid[-half : half + 1, -half : half + 1]
        self.r = np.hypot(u, v) / fwhm
        self.sky, self.xy, self.tops, self.half, self.fwhm = sky, xy, tops, half, fwhm
        self.ring, self.far = (self.r / _RING).astype(int), self.r > _CORE
        self.all, self.stars = stars[0], stars[1][: int(np.clip(_VALUES / self.r.size, _SHOWING, _MOST))]
        self.neighbours = cKDTree(xy[self.all]).query_ball_point(xy[self.stars], 1.5 * half)
        values, noise = (np.stack(part) for part in zip(*map(self._seen, range(len(self.stars))), strict=True))
        middle = np.nan_to_num(_median(values))
        expected = noise + (_DIFFERS * middle) ** 2
        square = (values - middle) ** 2 / expected
        self.scatter = np.maximum(uniform_filter(np.nan_to_num(_median(square)) / _MEDIAN, int(fwhm) + 1), 1)
        self.weights = np.nan_to_num(np.maximum(1 - square / (_OUTLIER**2 * self.scatter), 0) ** 2 / expected)
        self.values = np.nan_to_num(values) * self.weights
        self.total, self.sums = self.weights.sum(axis=0), self.values.sum(axis=0)
        halves = [self._mean(self.weights[k::2].sum(axis=0), self.values[k::2].sum(axis=0)) for k in (0, 1)]
        n = np.count_nonzero(self.weights, axis=0)
        self.covered = 1 - np.median(n[self.far & (self.r < _LEAST)]) / len(self.stars)
        few = n < _FEWEST
        self.power = self._power(*halves, few)
        light, error = self._mean(self.total, self.sums)
        error[few] = np.inf
        self.common = self._shrunk(light, error)
        reach = int(np.ceil(self.r[self.power > 0].max(initial=0) * fwhm)) + len(_TAPS)
        self.reach = min(reach, half)  # beyond it there is nothing

    def _seen(self, k):
        """The image around a star in units of its top, NaN where others hide it, and its variance."""
        star = self.stars[k]
        light, variance = self.sky.around(self.xy[star], self.half)
        for other in self.all[self.neighbours[k]]:
            ratio = self.tops[other] / self.tops[star]
            if other == star or not ratio >= _FAINT:
                continue
            reach = int(np.ceil(np.clip(_WIDE * np.sqrt(ratio), _MASKED, _WIDEST) * self.fwhm))
            low = np.round(self.xy[other] - self.xy[star]).astype(int) + self.half - reach
            cut = [slice(max(a, 0), max(a + 2 * reach + 1, 0)) for a in low[::-1]]
            part = light[tuple(cut)]
            v, u = (np.arange(part.shape[i]) + max(a, 0) - a - reach for i, a in enumerate(low[::-1]))
            part[(np.hypot(u, v[:, None]) <= reach) & (self.r[tuple(cut)] > _MASKED)] = np.nan
        return light / self.tops[star], variance / self.tops[star] ** 2

    def scale(self, place):
        """Top that a star at a place would have, by what it has around it; 0 where that shows none."""
        light, variance = self.sky.around(place, self.half)
        mean, error = self.common
        use = self.far & (mean**2 > _PEAK**2 * error) & np.isfinite(light)
        if np.count_nonzero(use) < _WINGS * self.fwhm**2:
            return 0.0
        ratio, weights = light[use] / mean[use], mean[use] ** 2 / variance[use]
        order = np.argsort(ratio)
        total = np.cumsum(weights[order])
        return max(float(ratio[order][np.searchsorted(total, total[-1] / 2)]), 0.0)

    def around(self, star):
        """Structure around a star as the others show it, and its variance; within `reach`."""
        k = np.flatnonzero(self.stars == star)
        light, error = self.common
        if len(k):
            light, error = self._shrunk(*self._mean(self.total - self.weights[k[0]], self.sums - self.values[k[0]]))
        near = slice(self.half - self.reach, self.half + self.reach + 1)
        return light[near, near], error[near, near]

    def _mean(self, total, sums):
        known = total > 1e-6 * self.total.max()
        safe = np.where(known, total, 1)
        return np.where(known, sums / safe, 0), np.where(known, self.scatter / safe, np.inf)

    def _power(self, first, second, few):
        """Mean square of the structure around every pixel, as two halves of the stars agree on it; else 0."""
        both, error = first[0] * second[0], first[1] * second[1]
        known = np.isfinite(error) & self.far & ~few
        rings, n = self.ring[known], self.ring.max() + 1
        weights = 1 / error[known]
        around = np.ones(2 * _SMOOTHED + 1)
        power, weights = (
            np.convolve(np.bincount(rings, values, n), around, "same") for values in (weights * both[known], weights)
        )
        certain = power > _CERTAIN * np.sqrt(_CORRELATED * weights) * self.fwhm
        power = np.where(certain, power / np.maximum(weights, 1e-300), 0)[self.ring]
        spots = np.minimum(first[0], second[0])
        is_spot = known & (spots > 0) & (spots**2 > _PEAK**2 * np.maximum(first[1], second[1]))
        return np.where(is_spot, np.maximum(power, spots**2), power)

    def _shrunk(self, light, error):
        """The mean of what is likely, given a mean and its variance; with a tenth of it in the variance."""
        known = np.isfinite(error)
        error = np.where(known, error, 0)
        part = np.where(known, self.power / np.maximum(self.power + error, 1e-300), 0)
        left = np.where(known, part * error, self.power) + self.scatter * (_DIFFERS * part * light) ** 2
        return part * light, left


def _median(values):
    """Along the first axis, of what is not NaN."""
    ordered = np.sort(values, axis=0)
    middle = np.maximum(np.isfinite(values).sum(axis=0) - 1, 0)
    low, high = (np.take_along_axis(ordered, k[None], axis=0)[0] for k in (middle // 2, (middle + 1) // 2))
    return (low + high) / 2


def _cleaned(sky, peaks, shown, threshold):
    """Which peaks stand above the structure of the brighter ones; all structure, and its variance."""
    x, y, xy, tops = peaks
    light, error = np.zeros_like(sky.image), np.zeros_like(sky.image)
    half = shown.reach - 3
    v, u = np.mgrid[-half : half + 1, -half : half + 1]
    stars = np.zeros(len(x), dtype=bool)
    strongest = max(np.abs(light[shown.far]).max() + np.sqrt(error[shown.far].max()) for light, error in [shown.common])
    for k in np.argsort(-tops, kind="stable"):
        a, b = x[k] + sky.margin, y[k] + sky.margin
        top, noise = tops[k] - max(light[b, a], 0), sky.variance[b, a]
        if not top > threshold * np.sqrt(noise + error[b, a]):
            continue
        if not top > _STANDS * light[b, a]:
            continue
        stars[k] = True
        if top * strongest < np.sqrt(noise):
            continue
        mean, variance = shown.around(k)
        base = np.ceil(xy[k]).astype(int)
        there = _square(base + sky.margin, half)
        part = top * _shifted(mean, base - xy[k])[1:, 1:]
        core = np.hypot(u + base[0] - xy[k, 0], v + base[1] - xy[k, 1]) <= _CORE * shown.fwhm
        light[there] += np.where(core, 0, part)
        error[there] += np.where(core, 0, top**2 * variance[3:-3, 3:-3])
    return stars, np.maximum(light, 0), error
