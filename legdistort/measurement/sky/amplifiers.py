"""Levels of the amplifiers of a detector: sharp steps of the sky between columns, between rows, of quadrants."""

import numpy as np
from scipy.ndimage import maximum_filter1d

_BESIDE = 16  # columns or rows on either side that determine a step between amplifiers
_BLOCKS, _AGREE = 8, 6  # of rows, of a half; those that have about the same step
_AWAY = 0.5  # of a step, by which it may differ in a block
_SINGLE = 5  # columns of which the median is taken
_JUMP = 3  # of them next to it, which have the whole step
_SHOWN = 100_000  # pixels of either half of a frame that serve for that
_EXCHANGED = 12  # values up to which exchanges are faster than a sort
_SURE = 10.5  # standard deviations: columns of dense fields, where a star is in every block, have up to 10


def amplifier_levels(data, mask):
    """Levels of the amplifiers of a detector, sharp steps of the sky: between columns, between rows, of quadrants.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
    mask : ndarray of bool, shape (ny, nx)
        Pixels that do not count.

    Returns
    -------
    ndarray, shape (ny, nx), or None
        None if there are no steps. The first amplifier is at 0.
    """
    by_columns = _half_levels(data, mask)
    rest = data if by_columns is None else data - by_columns
    by_rows = _half_levels(rest.T, mask.T)
    if by_columns is None or by_rows is None:
        return by_columns if by_rows is None else np.ascontiguousarray(by_rows.T)
    return by_columns + by_rows.T


def _half_levels(data, mask):
    """Levels of columns, of the upper and the lower half by themselves where they differ; None without any."""
    ny, nx = data.shape
    if nx <= 4 * _BESIDE or ny < _BESIDE:
        return None
    halves = slice(0, ny // 2), slice(ny // 2, ny)
    steps = []
    for rows in halves:
        n = rows.stop - rows.start
        some = slice(rows.start, rows.stop, max(1, min(n * nx // _SHOWN, n // _BLOCKS)))
        steps.append(_Steps(data[some], mask[some]))
    # where all blocks of rows agree, which is asked of the few columns where steps are seen at all
    sure = np.sqrt(sum(each.significance**2 for each in steps))
    seen = np.flatnonzero(sure > _SURE)
    if not len(seen):
        return None
    agree = [each.agree(seen) for each in steps]
    sure = np.sqrt(sum(a * each.significance[seen] ** 2 for a, each in zip(agree, steps, strict=True)))
    size = np.zeros(nx)
    size[seen] = np.where(sure > _SURE, sum(np.abs(each.step[seen]) + each.edge(seen) for each in steps), 0)
    # beside a step there is half of it, the other way
    found = np.flatnonzero((size > 0) & (size == maximum_filter1d(size, 3 * _BESIDE + 1)))
    if not len(found):
        return None
    agree = [a[np.searchsorted(seen, found)] for a in agree]
    out = np.zeros_like(data)
    for i, rows in enumerate(halves):
        own, other = steps[i], steps[1 - i]
        step, beside = own.step[found], other.step[found]
        # stars on a step may hide it in one half
        near = np.where(agree[i], 3.0 * np.hypot(own.noise, other.noise), _AWAY * np.abs(beside))
        both = np.where(agree[i], (step + beside) / 2, beside)
        across = np.zeros(nx)
        across[found] = np.where(np.abs(step - beside) < near, both, np.where(agree[i], step, 0))
        out[rows] = np.cumsum(across)
    return out


class _Steps:
    """Steps before every column, from some rows: medians over blocks of them. Stars are in one or two, steps in all.

    Attributes
    ----------
    step, significance : ndarray, shape (nx,)
        The latter in standard deviations.
    noise : float
        Standard deviation of a step.
    """

    def __init__(self, data, mask):
        nx, rows = data.shape[1], len(data) // _BLOCKS * _BLOCKS
        self.step, self.significance, self.noise = np.zeros(nx), np.zeros(nx), 0.0
        hidden = np.count_nonzero(mask, axis=0)
        few = hidden > len(data) / 2
        if np.count_nonzero(~few) <= 4 * _BESIDE:
            return
        shown = np.array(data[:rows], dtype=np.float32)
        if hidden.any():
            shown[mask[:rows]] = np.median(shown[~mask[:rows]])
        level = _medians(shown.reshape(_BLOCKS, -1, nx).swapaxes(0, 1))
        if few.any():
            level[:, few] = np.median(level[:, ~few])
        padded = np.pad(level, ((0, 0), (_SINGLE // 2, _SINGLE // 2)), mode="edge")
        level = _medians([padded[:, i : i + nx] for i in range(_SINGLE)])  # bad columns
        self._total = np.pad(np.cumsum(level, axis=1, dtype=float), ((0, 0), (1, 0)))
        inner = np.arange(2 * _BESIDE, nx - 2 * _BESIDE)
        self._each = self._difference(inner, _BESIDE) - self._slope(inner)
        self.step[inner] = _medians(self._each)
        off = np.abs(self._each - self.step[inner])
        self.noise = max(1.25 / np.sqrt(_BLOCKS) * 1.4826 * np.median(off), np.finfo(float).tiny)
        self.significance = np.abs(self.step) / self.noise

    def _difference(self, at, width):
        """Of the means on either side of columns, in every block."""
        return (self._total[:, at + width] - 2 * self._total[:, at] + self._total[:, at - width]) / width

    def _slope(self, at):
        return (self._difference(at - _BESIDE, _BESIDE) + self._difference(at + _BESIDE, _BESIDE)) / 2

    def edge(self, at):
        """The difference of the columns on either side alone: largest at the step itself."""
        return np.abs(_medians(self._difference(at, 1)))

    def agree(self, at):
        """Whether steps are sharp, and about the same in all blocks."""
        step, slope = self.step[at], self._slope(at)
        off = np.abs(self._each[:, at - 2 * _BESIDE] - step)
        out = np.count_nonzero(off < _AWAY * np.abs(step), axis=0) >= _AGREE
        # a step is the same next to it and farther away, which the light of a star is not
        near = self._difference(at, _JUMP) - slope * _JUMP / _BESIDE
        far = 2 * self._difference(at, _BESIDE) - self._difference(at, _BESIDE // 2) - 1.5 * slope
        for other in (near, far):
            out &= np.abs(_medians(other) - step) < 0.3 * np.abs(step) + 2.0 * self.noise
        return out


def _medians(arrays):
    """Medians of some arrays, element by element; of few by exchanges, in a fifth of the time of a sort."""
    ordered, n = list(arrays), len(arrays)
    if n > _EXCHANGED:
        return np.median(arrays, axis=0)
    for i in range(n):
        for j in range(i % 2, n - 1, 2):
            pair = ordered[j : j + 2]
            ordered[j : j + 2] = np.minimum(*pair), np.maximum(*pair)
    return (ordered[(n - 1) // 2] + ordered[n // 2]) / 2
