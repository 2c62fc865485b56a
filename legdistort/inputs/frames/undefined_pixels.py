"""Pixels that hold no measurement: filled gaps between chips, borders of shifted and drizzled frames, huge numbers.

Programs fill with one number what no light fell on, often 0. Of a sky of whole numbers, or cut off at 0, many pixels
are alike too, side by side by chance: an area is taken for filled only where its rows or columns are longer than chance
makes them in the frame at hand.
"""

import numpy as np
from scipy.ndimage import binary_dilation, binary_propagation, label

#: Of a number larger than this no square can be told in single precision; programs that fill with 1e30 and more ...
HUGE = 1e29
_APART = 1e6  # ... leave at least this factor to the values
_LEAST = 8  # pixels alike in a row or column, below which nothing is asked
_VALUES = 3  # numbers that a frame is filled with, at most
_CHANCE = 1e-3  # runs so long that are expected in a frame by chance
_CORRELATED = 2.0  # times as long in frames that were resampled: neighbours are alike more often than others
_RARE = 0.2  # of all pixels: below, single ones beside an area that are alike belong to it
_SMALL = 0.5  # of the shorter side, in pixels: fewer in all are dead columns, and matter little
_MOST = 0.9  # of a frame: an image without noise, stars on an exact 0, is not filled
_OFTEN = 4  # rows of pixels that are alike in every row of the frame: so many areas there are not
_FADES = 0.25  # of how far pixels are from the number: those beside an area that is filled are as far as any
_BRIGHT = 0.99  # quantile of the other pixels: what is brighter is saturated


def undefined_pixels(data, known):
    """Pixels of a frame that hold no measurement, and what they are.

    Parameters
    ----------
    data : ndarray of float, shape (ny, nx)
    known : ndarray of bool, shape (ny, nx)
        Pixels known to be bad.

    Returns
    -------
    found : ndarray of bool, shape (ny, nx), or None
        None if there are none besides those known.
    words : str
        How many of what kind; empty if there are none.
    """
    found, words = None, []
    for new, what in (_huge(data, known), *_filled(data, known)):
        if new is not None:
            found = new if found is None else found | new
            words.append(what)
    if found is None:
        return None, ""
    return found, f"{np.count_nonzero(found)} pixels hold no measurement and are left out ({', '.join(words)})"


def _huge(data, known):
    """Pixels with numbers far beyond all others."""
    if data.dtype == np.float32 and np.isfinite(np.vdot(data, data)):  # no square is beyond single precision
        return None, ""
    if max(data.max(), -data.min()) <= HUGE and not known.any():  # NaN are known
        return None, ""
    with np.errstate(invalid="ignore"):
        size = np.abs(data)
        huge = ~known & (size > HUGE)
    rest = size[~known & ~huge]
    if not huge.any() or not rest.size or rest.max() * _APART > size[huge].min():
        return None, ""
    return huge, f"values beyond {HUGE:.0e}"


def _filled(data, known):
    """Connected areas of one number that touch the border, one number after the other."""
    if min(data.shape) <= _LEAST:
        return
    for value in _candidates(data, known):
        alike = (data == value) & ~known
        area = _area(alike)
        if area is not None and not _is_light(data, known, area, value):
            yield area, f"areas of the value {value:g} at the border"


def _candidates(data, known):
    """Numbers that are alike in a row or column of `_LEAST` pixels at the border, the most frequent ones."""
    found = []
    for plane, bad in ((data, known), (data.T, known.T)):
        for ends in (slice(0, _LEAST), slice(-_LEAST, None)):
            strip, hidden = plane[ends], bad[ends]
            inwards = (strip == strip[0]).all(axis=0) & ~hidden.any(axis=0)
            edge, hidden = (each[0 if ends.start == 0 else -1] for each in (strip, hidden))
            same = np.convolve((edge[1:] == edge[:-1]) & ~hidden[1:] & ~hidden[:-1], np.ones(_LEAST - 1, int))
            along = np.flatnonzero(same >= _LEAST - 1)
            found += [strip[0][inwards], edge[along]]
    values, numbers = np.unique(np.concatenate(found), return_counts=True)
    order = np.argsort(-numbers, kind="stable")[:_VALUES]
    return values[order][numbers[order] > 1]  # one alone is a dead column


def _area(alike):
    """Of pixels that are alike those in long rows or columns, connected with the border; None if there are none."""
    rows, columns = _Rows(alike), _Rows(alike.T)
    share = max(rows.by_chance, columns.by_chance)
    length = max(_LEAST, _length(share, alike.size), rows.usual_length, columns.usual_length)
    if rows.n_longer(length) + columns.n_longer(length) < _SMALL * min(alike.shape):
        return None
    areas, n = label(rows.longer_than(length) | columns.longer_than(length).T)
    edge = np.concatenate([areas[0], areas[-1], areas[:, 0], areas[:, -1]])
    if not n or not edge.any():
        return None
    found = np.isin(areas, np.unique(edge[edge > 0]))
    if share < _RARE:
        found = binary_propagation(found, mask=alike)
    enough = np.count_nonzero(found) >= _SMALL * min(alike.shape)
    return found if enough and found.mean() < _MOST else None


def _length(share, size):
    """Of rows of pixels that are alike, a length that chance does not make of so many if this share is alike."""
    if share >= 1:
        return size
    return _CORRELATED * np.log(2 * size / _CHANCE) / -np.log(max(share, 1e-6))


class _Rows:
    """Rows of pixels that are alike: their first pixels, and those behind the last."""

    def __init__(self, alike):
        padded = np.zeros((len(alike), alike.shape[1] + 1), dtype=np.int8)
        padded[:, :-1] = alike
        step = np.diff(padded.ravel(), prepend=np.int8(0))
        self.shape, self.size = padded.shape, alike.size
        self.first, self.behind = np.flatnonzero(step == 1), np.flatnonzero(step == -1)
        self.n_alike = int((self.behind - self.first).sum())

    @property
    def by_chance(self):
        """Part of the pixels behind one that differs: of areas that are alike it shows nothing."""
        inside = np.count_nonzero(self.first % self.shape[1])
        return min(1.0, inside / max(self.size - self.n_alike, 1))

    @property
    def usual_length(self):
        """What `_length` would be for rows as long as most, where rows are so many that chance has made them."""
        if len(self.first) < _OFTEN * self.shape[0]:
            return 0
        return _length(0.5 ** (1 / np.median(self.behind - self.first)), self.size)

    def n_longer(self, length):
        """Pixels in rows of at least this length."""
        lengths = self.behind - self.first
        return int(lengths[lengths >= length].sum())

    def longer_than(self, length):
        lengthy = self.behind - self.first >= length
        out = np.zeros(self.shape[0] * self.shape[1], dtype=np.int8)
        out[self.first[lengthy]] = 1
        out[self.behind[lengthy]] = -1
        return np.cumsum(out, dtype=np.int8).reshape(self.shape)[:, :-1].astype(bool)


def _is_light(data, known, area, value):
    """Whether an area is saturated, brighter than nearly all other pixels, or the end of wings without noise."""
    others = (data != value) & ~known
    beside, rest = data[others & binary_dilation(area)], data[others]
    if not beside.size:
        return True
    rest = rest[:: max(1, rest.size // 100_000)]
    fades = np.median(np.abs(beside - value)) < _FADES * np.median(np.abs(rest - value))
    return bool(fades or value > np.quantile(rest, _BRIGHT))
