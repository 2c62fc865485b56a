"""Whether the headers have the detectors of a camera where it has them, and which detector they have elsewhere.

Where all of them lie, and how large a pixel is, is no matter of a layout: both are compared after one similarity. That
is the one of the detectors that agree on it, so that a detector whose header is wrong has no part in it. A header is
wrong that has its detector elsewhere, turned, mirrored, or its pixels of another size than the others have theirs.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy import special

from ..geometry import basis, similarity

#: Less than this [pix] matters little: headers are rarely better than a pixel.
LEAST = 3.0
#: What headers disagree by [pix] that do not show which of them is wrong: those of two detectors, or of most.
FAR = 20.0
#: A detector contradicts the others if it is so far off by this chance, over the number of detectors. Where headers
#: have nothing but shifts wrong, by a normal error, 1 to 3 % of cameras have one
#: (`tests/cameras/test_odd_headers.py`).
CHANCE = 4e-3
#: Pixels of two detectors are of the same size by headers to this: distortions make up for so much.
_SAME_SCALE = 1.01
#: The size of one differs from those of the others if it does by so many times their rms.
_MANY = 5
#: By less than this [deg, part] no detector is otherwise turned, or larger, for dithers: `legdistort.solve` finds that.
ANGLE_SAME, SCALE_SAME = 3.0, 0.03
#: A mirrored detector is not turned if it is by less than this [deg].
_SAME_ANGLE = 0.1
#: Pairs of detectors at most that are tried as those that agree.
_MOST_PAIRS = 500


@dataclass(frozen=True, eq=False)
class HeaderLayout:
    """The layout of headers beside that of a camera, of several detectors at least two of which are known.

    Attributes
    ----------
    names : tuple of str
        Detectors that are compared.
    stated, found : ndarray, shape (n, 4, 2)
        Their corners where the headers and where the camera has them, each in its plane; found without what each has of
        a scale of its own.
    own : ndarray, shape (n, 2, 3)
        Similarity of each detector by itself from where the headers to where the camera has it.
    agree : ndarray of bool, shape (n,)
        Those by which the two planes are compared.
    """

    names: tuple
    stated: np.ndarray
    found: np.ndarray
    own: np.ndarray
    agree: np.ndarray

    @cached_property
    def similarity(self):
        """From the plane of the headers to the focal plane (2, 3), by the detectors that agree."""
        return _fitted(self.stated, self.found, np.flatnonzero(self.agree))

    @cached_property
    def shifts(self):
        """Where the headers have the middle of each detector less where it lies, pixels of the focal plane, (n, 2)."""
        stated = similarity.apply(self.similarity, self.stated).mean(axis=1) - self.found.mean(axis=1)
        if len(self.names) > 2:
            return stated
        # one similarity takes up what two detectors are apart: their distance is judged by their own scales
        own = np.mean([_fitted(self.stated, self.found, [k])[:, :2] for k in (0, 1)], axis=0)
        apart = own @ np.diff(self.stated.mean(axis=1), axis=0)[0] - np.diff(self.found.mean(axis=1), axis=0)[0]
        return np.outer([-0.5, 0.5], apart)

    @cached_property
    def rotations(self):
        """Rotation of each detector by the headers less that which it has, as `Place.rotation`, degrees, (n,).

        Of a mirrored one that which follows after its y is reversed.
        """
        steps = [similarity.compose(each, similarity.invert(self.similarity)) for each in self.own]
        return np.array([similarity.describe(step)["rotation"] for step in steps])

    @cached_property
    def mirrored(self):
        """Whether the header of each detector has it mirrored against those that agree, bool (n,)."""
        return np.linalg.det(self.own[:, :, :2]) * np.linalg.det(self.similarity[:, :2]) < 0

    @cached_property
    def scales(self):
        """Sizes of pixels by the headers over what they are, (n,); those that agree have 1 on average."""
        logs = _log_scales(self.own)
        return np.exp(logs - logs[self.agree].mean())

    @property
    def scale_error(self):
        """Least error of the scale of the headers' plane, relative, by how those that agree have sizes of pixels."""
        logs = _log_scales(self.own)[self.agree]
        return float(np.std(logs, ddof=1) / np.sqrt(len(logs))) if len(logs) > 1 else 0.0

    @cached_property
    def errors(self):
        """Standard deviations (n, 2) of the shifts [pix, per axis] and rotations [degrees], by those that agree.

        By how these scatter about the similarity, which is not known better; NaN where fewer than three agree.
        """
        n, middles = np.count_nonzero(self.agree), self.found.mean(axis=1)
        if n < 3:
            return np.full((len(self.names), 2), np.nan)
        arms = np.sum((middles - middles[self.agree].mean(axis=0)) ** 2, axis=1)
        leverage = 1 / n + arms / arms[self.agree].sum()
        shift = np.sum(self.shifts[self.agree] ** 2) / (2 * n - 4) * (1 + leverage)
        turn = np.mean(self.rotations[self.agree] ** 2)  # places too turn the similarity, and so all of these
        return np.sqrt(np.column_stack([shift, np.full(len(shift), turn)]))

    @property
    def odd(self):
        """Detectors whose header contradicts the others, tuple of str."""
        return tuple(name for name, agrees in zip(self.names, self.agree, strict=True) if not agrees)

    @property
    def scatter(self):
        """Largest distance [pix] by which those that agree depart from one similarity; of two their disagreement."""
        far = np.hypot(*self.shifts[self.agree].T)
        return float(2 * far[0] if len(self.names) == 2 else far.max())

    @property
    def far(self):
        """Largest distance [pix] by which an odd detector is off: its middle, or its corners by the scale alone."""
        by_scale = np.abs(self.scales - 1) * _arms(self.found)
        return float(np.max(np.maximum(np.hypot(*self.shifts.T), by_scale)[~self.agree], initial=0.0))

    @property
    def is_undecided(self):
        """Whether headers disagree, and nothing shows which are wrong."""
        return not self.odd and (self.scatter > FAR or (len(self.names) == 2 and bool(_unlike(self.own).any())))

    def sentence(self, there):
        """What is wrong of the headers, in words; `there` is what has the detectors where they lie. Empty for nothing.

        ``"the stars put it"``, for example.
        """
        if self.is_undecided:
            far = f"{self.scatter:.0f} px otherwise to each other than {there}"
            if len(self.names) == 2:
                ratio = float(self.scales.max() / self.scales.min())
                far += f", pixels of the one {ratio:.3f} times as large as those of the other" * (ratio > _SAME_SCALE)
                far += ", the one mirrored against the other" * bool(self.mirrored.any())
            known = f"{far}, and nothing shows which of them is wrong"
            if len(self.names) == 2:
                return f"the headers of detectors {' and '.join(self.names)} have these {known}"
            return f"the headers have the detectors up to {known}"
        told = [self._told(k) for k in np.flatnonzero(~self.agree)]
        others = f"the headers of the other {np.count_nonzero(self.agree)} agree to {self.scatter:.2g} px"
        return f"the headers have detector {', '.join(told)} from where {there}; {others}" if told else ""

    def _told(self, k):
        """How far off the header has one of the detectors, in words."""
        (x, y), (off, turn), angle = self.shifts[k], self.errors[k], self.rotations[k]
        larger = self.scales[k] if abs(self.scales[k] - 1) * _arms(self.found)[k] > LEAST else 1.0
        words = orientation_in_words(angle, larger, mirrored=self.mirrored[k], error=_told_error(turn))
        shift = f"({x:+.0f} in x, {y:+.0f} in y of the focal plane{_told_error(off)}, {words})"
        return f"{self.names[k]} {np.hypot(x, y):.0f} px {shift}"


def orientation_in_words(angle, scale, *, mirrored, error=""):
    """How a header has a detector otherwise turned, or mirrored, or larger, than it is.

    Parameters
    ----------
    angle : float
        Degrees; of a mirrored one the rotation that follows after its y is reversed.
    scale : float
        Size of its pixels by the header over what it is.
    mirrored : bool
    error : str
        That of the angle, in words.
    """
    larger = f"its pixels {scale:.3f} times as large as they are" if scale != 1 else ""
    angle = abs(angle) if abs(angle) > 180 - _SAME_ANGLE / 10 else angle
    words = f"turned by {angle:.2f}{error} deg"
    if mirrored:
        nearest = round(angle / 90) % 4
        axes = "y reversed", "x and y exchanged", "x reversed", "x and y exchanged and both reversed"
        rest = (angle - 90 * nearest + 180) % 360 - 180
        words = f"mirrored, {axes[nearest]}" + (f", turned by {rest:.2f} deg" if abs(rest) > _SAME_ANGLE else "")
    elif larger and abs(angle) < _SAME_ANGLE and not error:
        return larger
    return f"{words}, {larger}" if larger else words


def _told_error(error):
    return f" +- {error:.1g}" if np.isfinite(error) else ""


def with_usual_scales(detectors):
    """Detectors as headers have them, ``{id: Detector}``, with pixels of the usual size where one has another.

    If the others agree, and it differs by 1 to 3 per cent: dithers tell more, and less a distortion makes up for. A
    common map of the focal plane makes up for any, so that exposures alone do not tell it from a header that is wrong.

    Returns
    -------
    detectors : dict
    odd : dict
        ``{id: ratio}`` of the size of its pixels to that of the others, by headers.
    """
    logs = _log_scales(np.array([each.layout for each in detectors.values()]))
    away, out, odd = logs - np.median(logs), dict(detectors), {}
    wrong = _stands_out(logs) & (np.abs(away) < np.log(1 + SCALE_SAME))
    for key, off in ((key, off) for key, off, is_odd in zip(detectors, away, wrong, strict=True) if is_odd):
        middle, step = basis.denormalize(*np.zeros((2, 1)), detectors[key].shape)[0], np.exp(off) * np.eye(2)
        scaled = similarity.compose(np.column_stack([step, middle - step @ middle]), detectors[key].layout)
        out[key], odd[key] = replace(detectors[key], layout=scaled), float(np.exp(off))
    return out, odd


def _stands_out(logs):
    """Logarithms of sizes of pixels (n,) that differ from those of the others, which are most and agree, bool (n,)."""
    away = np.abs(logs - np.median(logs))
    wrong = away > np.log(_SAME_SCALE)
    if len(logs) < 3 or 2 * np.count_nonzero(wrong) >= len(logs):
        return np.zeros(len(logs), dtype=bool)
    return wrong & (away > _MANY * np.sqrt(np.mean(away[~wrong] ** 2)))


def compare_headers(detectors):
    """The `HeaderLayout` of a camera; None if headers state nothing of it, or it has no place for two detectors.

    Detectors whose places nothing determined are not compared; if there are no others, places are where the layout
    begins, and none contradicts another but one that is mirrored or turned, since dithers contradict its header.

    Parameters
    ----------
    detectors : dict
        ``{id: Detector}``.
    """
    stated = [key for key, each in detectors.items() if each.header_layout is not None]
    known = [key for key in stated if np.all(np.isfinite(detectors[key].place.errors or 0.0))]
    names = known if len(known) > 1 else stated
    if len(names) < 2:
        return None
    corners = [basis.denormalize(*np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]]), detectors[key].shape) for key in names]

    def places(kind):
        layouts = [getattr(detectors[key], kind) for key in names]
        return np.array([similarity.apply(similarity.invert(a), xy) for a, xy in zip(layouts, corners, strict=True)])

    stated, lie = places("header_layout"), places("layout")
    own = np.array([_fitted(stated, lie, [k]) for k in range(len(stated))])
    found = _rigid(stated, lie, own)
    agree = _agreeing(stated, found, own) if len(known) > 1 else ~_otherwise_turned(own)
    return HeaderLayout(tuple(names), stated, found, own, agree)


def _rigid(stated, found, own):
    """Corners (n, 4, 2) where they were found, of detectors as headers have them but for place, rotation, common scale.

    What else there is of a layout, headers know nothing of, and exposures determine the least.
    """
    logs = _log_scales(own)
    turns = own[:, :, :2] * np.exp(logs - np.median(logs))[:, None, None]  # one that is wrong has no part in it
    offsets = stated - stated.mean(axis=1, keepdims=True)
    return found.mean(axis=1, keepdims=True) + offsets @ turns.mT


def _fitted(stated, found, rows):
    return similarity.fit_similarity(stated[rows].reshape(-1, 2), found[rows].reshape(-1, 2))


def _log_scales(own):
    """Logarithms (n,) of the sizes of pixels by headers over those that they have, by similarities (n, 2, 3)."""
    return -similarity.log_scales(own)


def _arms(corners):
    """Distance (n,) of the corners (n, 4, 2) of each detector from its middle, rms."""
    return np.sqrt(np.mean(np.sum((corners - corners.mean(axis=1, keepdims=True)) ** 2, axis=2), axis=1))


def _unlike(own):
    """Detectors (n,) that are mirrored against most, or against the first, or have pixels of another size than most."""
    parity, logs = np.sign(np.linalg.det(own[:, :, :2])), _log_scales(own)
    scale = np.abs(logs - np.median(logs)) > np.log(_SAME_SCALE)
    return (parity != np.sign(parity.sum() or parity[0])) | scale


def _otherwise_turned(own):
    """Detectors (n,) of layouts to begin with that are not as headers have them since dithers contradict these.

    Where they are is no matter of it: these shifts are not known.
    """
    like = similarity.alike(own, np.log(_SAME_SCALE), ANGLE_SAME)
    return ~like[np.argmax(like.sum(axis=1))]


def _agreeing(stated, found, own):
    """Detectors (n,) that agree on a similarity: most of them, and all others that chance does not exclude.

    A mirrored one does not, nor one whose pixels are not of the size that those of the others have.
    """
    n = len(stated)
    if n == 2:
        return np.ones(2, dtype=bool)
    parity, logs = np.linalg.det(own[:, :, :2]) > 0, _log_scales(own)
    alike = (parity == (2 * np.count_nonzero(parity) >= n)) & ~_stands_out(logs)
    rows, arm = np.flatnonzero(alike), _arms(found)
    if len(rows) > 2:
        scale = _like_most(len(rows), lambda some: (arm * (logs - logs[rows[some]].mean()))[rows] ** 2, n_values=1)
        rows = rows[scale]

    def off(some):
        left = similarity.apply(_fitted(stated, found, rows[some]), stated[rows]) - found[rows]
        return np.sum(left**2, axis=2).mean(axis=1)

    if len(rows) > 2:
        rows = rows[_like_most(len(rows), off, n_values=2)]
    return np.isin(np.arange(n), rows)


def _like_most(n, off, n_values):
    """Which of n detectors agree: most of them, and all others that chance does not exclude, bool (n,).

    Parameters
    ----------
    n : int
    off : callable
        ``off(rows)``: squares (n,) [pix^2] of what all are off if those of the rows are right.
    n_values : int
        Numbers of each detector that are compared.
    """
    most, pairs = n // 2 + 1, list(combinations(range(n), 2))
    tried = [off(list(pair)) for pair in pairs[:: len(pairs) // _MOST_PAIRS + 1]]
    order = np.argsort(min(tried, key=lambda left: np.sort(left)[:most].sum()))
    good = np.isin(np.arange(n), order[:most])
    while not good.all():
        left, dof = off(np.flatnonzero(good)), n_values * (np.count_nonzero(good) - 1)
        k = np.flatnonzero(~good)[np.argmin(left[~good])]
        ratio = left[k] / n_values / max(left[good].sum() / dof, 1e-12)
        if left[k] > LEAST**2 and special.fdtrc(n_values, dof, ratio) < CHANCE / n:
            break
        good[k] = True
    return good
