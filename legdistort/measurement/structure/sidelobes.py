"""Peaks that belong to the profiles of brighter stars: diffraction rings, spikes, side lobes of coma.

What is found at some distance from a bright star, and is no brighter than what other bright stars have at that distance
is no star. Nothing need be known of the profile, which may vary over the field: each star is compared with those
that are nearest, and with its own ring.
"""

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

_REACH = 8.0  # FWHM: beyond, rings are lost in the noise
#: Brightest side lobe, relative to the star, at 1 FWHM, and the power with which it falls: generous bounds. First rings
#: of an obstructed pupil have 0.02 to 0.06 at 1.6 FWHM, and side lobes of 0.8 rad of coma 0.2.
_BRIGHTEST, _FALL = 10.0, 4.0
_ALONE = 4.0  # FWHM without a brighter star, of stars that are compared with
_STARS, _FEWEST = 8, 4  # compared with
_FAINTEST = 1 / 4  # of the brightness of the star itself: noise must not pass for rings
_ANGLES = 16  # on a ring
_APART = 1.3  # FWHM along the ring: nearer by, the peak itself would count as ring
_STAR = 1.0  # FWHM: radius within which a star hides the rings of others
#: Quantile on a ring, which a side lobe exceeds and a companion, on few points, does not; less where the field is so
#: crowded that more than that of a ring, with so many independent points, may be covered by stars.
_USUAL, _POINTS = 0.78, 6
_MOST = 0.9  # quantile of the other stars: aberrations may grow over the field
_MORE = 1.7  # side lobes differ from star to star by so much, aberrations growing over the field


def side_light(image, x, y, fwhm, *, hidden=None):
    """Light expected at every peak from the profiles of the brighter stars around it.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Filtered with a kernel of zero sum.
    x, y : ndarray of int, shape (n,)
        Peaks of the image.
    fwhm : float
        Of the stars [pix].
    hidden : ndarray of bool, shape (ny, nx), optional
        Pixels of the image that determine nothing: saturated ones.

    Returns
    -------
    ndarray, shape (n,)
        In units of the image.
    """
    value = np.maximum(image[y, x].astype(float), np.finfo(np.float32).tiny)  # beside bad pixels it may be negative
    xy, out = summits(image, x, y), np.zeros(len(x))
    pairs = cKDTree(xy).query_pairs(_REACH * fwhm, output_type="ndarray")
    if not len(pairs):
        return out
    star, peak = np.where(value[pairs[:, :1]] >= value[pairs[:, 1:]], pairs, pairs[:, ::-1]).T
    distance = np.hypot(*(xy[star] - xy[peak]).T) / fwhm
    alone, certain = np.ones((2, len(x)), dtype=bool)
    alone[peak[distance < _ALONE]] = False
    if hidden is not None:
        alone &= ~hidden[y, x]
    doubtful = value[peak] < _BRIGHTEST * distance**-_FALL * value[star]
    star, peak = star[doubtful], peak[doubtful]
    if not len(star) or not alone.any():
        return out
    certain[peak] = False
    rings = _without_stars(image if hidden is None else np.where(hidden, np.nan, image), xy[certain], _STAR * fwhm)
    stars, which = np.unique(star, return_inverse=True)
    others = _comparable(xy, value, stars, alone)[which]
    crowded = np.pi * (_STAR * fwhm) ** 2 * np.count_nonzero(certain) / image.size
    share = min(_USUAL, 1 - 2 * crowded - 2 * np.sqrt(crowded / _POINTS))
    expected = _expected(rings, xy, value, star, peak, others, fwhm, share)
    np.maximum.at(out, peak, _MORE * value[star] * expected)
    return out


def _without_stars(image, xy, radius):
    """The image with NaN around stars."""
    out, half = image.copy(), int(radius)
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    round_ = np.hypot(dx, dy) <= radius
    x, y = np.round(xy).astype(int).T
    rows, columns = y[:, None] + dy[round_], x[:, None] + dx[round_]
    inside = (rows >= 0) & (rows < image.shape[0]) & (columns >= 0) & (columns < image.shape[1])
    out[rows[inside], columns[inside]] = np.nan
    return out


def summits(image, x, y):
    """Places of peaks to a fraction of a pixel, by parabolas; (n, 2)."""
    inside = np.clip(x, 1, image.shape[1] - 2), np.clip(y, 1, image.shape[0] - 2)
    if min(image.shape) < 3:
        return np.column_stack([x, y]).astype(float)
    x0, y0 = inside
    here = image[y0, x0]
    places = []
    for low, high, c in ((image[y0, x0 - 1], image[y0, x0 + 1], x), (image[y0 - 1, x0], image[y0 + 1, x0], y)):
        bend = np.minimum(low - 2 * here + high, -1e-3 * np.abs(here) - np.finfo(image.dtype).tiny)
        places.append(c + np.clip(0.5 * (low - high) / bend, -0.5, 0.5))
    return np.column_stack(places).astype(float)


def _comparable(xy, value, stars, alone):
    """Of every star the nearest others that are alone and not much fainter; (n, `_STARS`), -1 where there are none."""
    out = np.full((len(stars), _STARS), -1)
    brightest = np.flatnonzero(alone)[np.argsort(-value[alone], kind="stable")]
    octave = np.floor(np.log2(value[stars])).astype(int)
    for level in np.unique(octave):
        rows = octave == level
        pool = brightest[value[brightest] > _FAINTEST * 2.0**level]
        if len(pool) < _FEWEST:
            continue
        k = min(_STARS + 1, len(pool))
        found = pool[cKDTree(xy[pool]).query(xy[stars[rows]], k=np.arange(1, k + 1))[1]]
        found = np.where(found == stars[rows, None], -1, found)
        order = np.argsort(found < 0, axis=1, kind="stable")[:, :_STARS]
        out[rows, : order.shape[1]] = np.take_along_axis(found, order, axis=1)
    return out


def _expected(image, xy, value, star, peak, others, fwhm, share):
    """Light at the distance of a peak from a star, relative to the star; (n,)."""
    off = xy[peak] - xy[star]
    angle = np.arctan2(off[:, 1], off[:, 0])[:, None] + 2 * np.pi / _ANGLES * np.arange(_ANGLES)
    ring = np.hypot(*off.T)[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    elsewhere = _at(image, xy[others][:, :, None] + ring[:, None]) / value[others][:, :, None]
    elsewhere[others < 0] = np.nan
    own = _at(image, xy[star][:, None] + ring) / value[star, None]
    own[np.hypot(*np.moveaxis(ring - off[:, None], -1, 0)) < _APART * fwhm] = np.nan
    usual = np.fmax(_quantile(_quantile(elsewhere, share), _MOST), _quantile(own, share))
    return np.fmax(usual, 0.0)


def _quantile(values, share):
    """Along the last axis, of the numbers that are not NaN; NaN where all are."""
    ordered = np.sort(values, axis=-1)
    last = np.count_nonzero(np.isfinite(values), axis=-1) - 1
    return np.take_along_axis(ordered, np.maximum(np.round(share * last).astype(int), 0)[..., None], axis=-1)[..., 0]


def _at(image, places):
    return map_coordinates(image, [places[..., 1], places[..., 0]], order=1, mode="constant", cval=np.nan)
