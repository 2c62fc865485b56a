"""Whether the headers have the detectors of a camera where it has them, and which detector they have elsewhere.

Where all of them lie, and how large a pixel is, is no matter of a layout: both are compared after one similarity. That
is the one of the detectors that agree on it, so that a detector whose header is wrong has no part in it.
"""

from dataclasses import dataclass
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
        Their corners where the headers and where the camera has them, each in its plane.
    agree : ndarray of bool, shape (n,)
        Those by which the two planes are compared.
    """

    names: tuple
    stated: np.ndarray
    found: np.ndarray
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
        """Rotation of each detector by the headers less that which it has, as `Place.rotation`, degrees, (n,)."""
        out = []
        for stated, found in zip(similarity.apply(self.similarity, self.stated), self.found, strict=True):
            out.append(similarity.describe(similarity.fit_similarity(stated, found, parity=1))["rotation"])
        return np.array(out)

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
    def is_undecided(self):
        """Whether headers disagree, and nothing shows which are wrong."""
        return not self.odd and self.scatter > FAR

    def sentence(self, there):
        """What is wrong of the headers, in words; `there` is what has the detectors where they lie. Empty for nothing.

        ``"the stars put it"``, for example.
        """
        if self.is_undecided:
            far = (
                f"{self.scatter:.0f} px otherwise to each other than {there}, and nothing shows which of them is wrong"
            )
            if len(self.names) == 2:
                return f"the headers of detectors {' and '.join(self.names)} have these {far}"
            return f"the headers have the detectors up to {far}"
        told = [
            f"{name} {np.hypot(*shift):.0f} px ({shift[0]:+.0f} in x, {shift[1]:+.0f} in y of the focal plane"
            f"{_told_error(off)}, turned by {angle:.2f}{_told_error(turn)} deg)"
            for name, shift, angle, (off, turn), agrees in zip(
                self.names, self.shifts, self.rotations, self.errors, self.agree, strict=True
            )
            if not agrees
        ]
        others = f"the headers of the other {np.count_nonzero(self.agree)} agree to {self.scatter:.2g} px"
        return f"the headers have detector {', '.join(told)} from where {there}; {others}" if told else ""


def _told_error(error):
    return f" +- {error:.1g}" if np.isfinite(error) else ""


def compare_headers(detectors):
    """The `HeaderLayout` of a camera; None if headers state nothing of it, or it has no place for two detectors.

    Detectors whose places nothing determined are not compared; if there are no others, places are where the layout
    begins, and none contradicts another.

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

    stated = places("header_layout")
    found = _rigid(stated, places("layout"))
    agree = _agreeing(stated, found) if len(known) > 1 else np.ones(len(names), dtype=bool)
    return HeaderLayout(tuple(names), stated, found, agree)


def _rigid(stated, found):
    """Corners (n, 4, 2) where they were found, of detectors as headers have them but for place, rotation, common scale.

    What else there is of a layout, headers know nothing of, and exposures determine the least.
    """
    own = np.array([_fitted(stated, found, [k]) for k in range(len(stated))])
    scales = np.sqrt(np.abs(np.linalg.det(own[:, :, :2])))
    own[:, :, :2] *= (np.exp(np.log(scales).mean()) / scales)[:, None, None]
    offsets = stated - stated.mean(axis=1, keepdims=True)
    return found.mean(axis=1, keepdims=True) + offsets @ own[:, :, :2].mT


def _fitted(stated, found, rows):
    return similarity.fit_similarity(stated[rows].reshape(-1, 2), found[rows].reshape(-1, 2))


def _agreeing(stated, found):
    """Detectors (n,) that agree on a similarity: most of them, and all others that chance does not exclude."""
    n = len(stated)
    if n == 2:
        return np.ones(2, dtype=bool)

    def off(rows):
        left = similarity.apply(_fitted(stated, found, rows), stated) - found
        return np.sum(left**2, axis=2).mean(axis=1)

    most, pairs = n // 2 + 1, list(combinations(range(n), 2))
    tried = [off(list(pair)) for pair in pairs[:: len(pairs) // _MOST_PAIRS + 1]]
    order = np.argsort(min(tried, key=lambda left: np.sort(left)[:most].sum()))
    good = np.isin(np.arange(n), order[:most])
    while not good.all():
        left, dof = off(np.flatnonzero(good)), 2 * np.count_nonzero(good) - 2
        k = np.flatnonzero(~good)[np.argmin(left[~good])]
        ratio = left[k] / 2 / max(left[good].sum() / dof, 1e-12)
        if left[k] > LEAST**2 and special.fdtrc(2, dof, ratio) < CHANCE / n:
            break
        good[k] = True
    return good
