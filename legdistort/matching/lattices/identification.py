"""Which hole of one exposure of a mask is which of another: positions alone tell that up to whole periods.

Three things decide. Holes are not made exactly: by how much each is off its place on the lattice is a pattern that no
other offset, turn or flip of the lattice has. Start positions right to half a period select one. Last, holes that are
stopped up, and edges of the mask, are seen in all exposures or in none.
"""

import logging
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from scipy import fft

from ...exceptions import AssumptionWarning, MatchError, some_of, warn
from ..similarity_candidates import SCALE_TOLERANCE
from .holes import Holes

log = logging.getLogger(__name__)

#: Logarithm of the odds against chance from which on the errors of holes decide: of 3000 offsets, 8 turns and flips,
#: and a hundred exposures one reaches 15 by chance; and how many times those of the next offset, which neighbours have
#: alike where it is a smooth distortion that is seen, not holes.
_ODDS, _TIMES = 20.0, 3.0
#: Part of the best odds that all exposures have where it is holes that are seen: how these agree is the same in all.
_ALIKE = 0.5
#: The same of what is seen and not seen, against the next offset.
_SEEN = 25.0
#: Part of the holes that is missed by accident.
_MISSED = 0.03
#: Holes that errors must be known of, beyond what a smooth map takes up.
_TAKEN_UP = 21
_LATTICE = "the stars lie on a lattice, as holes of a mask do: of period"
_GIVE = (
    "give start positions right to half a period: start= (--start), exposures= with WCSs or XSHIFT and YSHIFT in their "
    "headers (--wcs); or number the holes: Matches.from_table"
)


@dataclass(frozen=True, eq=False)
class _Placed:
    """Where an exposure lies on the lattice of the first: ``index_first = turn @ index - offset``, by these odds."""

    turn: np.ndarray
    offset: np.ndarray
    odds: float = 0.0

    def __call__(self, index):
        return index @ self.turn.T - self.offset

    def back(self, index):
        """The inverse."""
        return (index + self.offset) @ np.linalg.inv(self.turn).T


_AS_IT_IS = _Placed(np.eye(2, dtype=int), np.zeros(2, dtype=int))


@dataclass(frozen=True, eq=False)
class _Pattern:
    """Holes on a part of the lattice from `low` on.

    `off` (m, l) complex, their errors, 0 where unknown; `seen` and `places` (m, l): whether there is a hole, and
    whether it would be seen.
    """

    low: np.ndarray
    off: np.ndarray
    seen: np.ndarray
    places: np.ndarray


def identify_holes(lists, names, headers, left_out, *, gaps=False):
    """Star labels of exposures of a mask.

    Parameters
    ----------
    lists : list of StarList
    names : list of str
    headers : `~legdistort.matching.header_poses.HeaderPoses`
    left_out : dict
        Gets exposures without a place, with the reason.
    gaps : bool
        Holes may fall into gaps between detectors: it says nothing that one is not seen.

    Returns
    -------
    dict of str to ndarray of int, or None
        By exposure: the number of the hole, -1 for none. None where most exposures do not show a lattice.

    Raises
    ------
    MatchError
        Where nothing decides by how many periods most exposures are shifted.
    """
    if len(lists) < 2:
        return None
    known = [(len(each.keys() & set(names)), each) for each in (headers.starts, headers.poses)]
    starts = [max((n for n, each in known if name in each), default=0) for name in names]
    hub = min(range(len(names)), key=lambda i: (-starts[i], -len(lists[i])))
    if Holes.of(lists[hub]) is None:
        return None
    holes = dict(enumerate(map(Holes.of, lists)))
    found = {i: each for i, each in holes.items() if each is not None}
    if 2 * len(found) < max(len(lists), 3):
        return None
    x, y = found[hub].basis
    period = f"({x[0]:.1f}, {y[0]:.1f}) and ({x[1]:.1f}, {y[1]:.1f}) px in x, y of {names[hub]}"
    log.info("%s %s", _LATTICE, period)
    placed, unsure = _place(found, hub, {i: headers.step(names[hub], names[i]) for i in found}, names, period, gaps)
    if 2 * len(placed) <= len(found):
        raise MatchError(
            f"{_LATTICE} {period}; shifted by one they match as well, and nothing tells by how many "
            f"{some_of([names[i] for i in unsure], 3)} {'is' if len(unsure) == 1 else 'are'} shifted: {_GIVE}"
        )
    left_out |= {names[i]: "its stars do not lie on the lattice of the others" for i in holes if i not in found}
    left_out |= {names[i]: f"nothing tells by how many periods of {period} it is shifted: {_GIVE}" for i in unsure}
    index = {i: place(found[i].index) for i, place in placed.items()}
    number = np.unique(np.concatenate(list(index.values())), axis=0, return_inverse=True)[1].ravel()
    labels, end = {}, 0
    for i, each in index.items():
        labels[names[i]] = np.full(len(lists[i]), -1)
        labels[names[i]][found[i].rows] = number[end : (end := end + len(each))]
    return labels


def _place(holes, hub, steps, names, period, gaps):
    """Places of exposures, ``{exposure: _Placed}``, and the exposures of which nothing decides it.

    A rough distortion of the detector agrees as well where holes have moved least, whichever they are: what agrees
    there decides once others agree elsewhere and the distortion is averaged out; or, with a warning, if all agree there
    about as well, however far they have moved.
    """
    by_start = _starts(holes, hub, steps)
    placed, left, doubts = {hub: _AS_IT_IS}, [i for i in holes if i != hub], _Doubts()
    while left:
        whole = _joined([_pattern(holes[i], holes[hub].basis, place) for i, place in placed.items()])
        sure, still, by_sight = {}, {}, {}
        for i in left:
            errors, sight = _decided(whole, holes[i], holes[hub].basis, gaps)
            start = by_start.get(i)
            unmoved = errors is not None and any(
                _is_still(holes[j], place, holes[i], errors) for j, place in placed.items()
            )
            if start is not None:
                if errors is not None and not _same(errors, start):
                    doubts.contradicted.append(names[i])
                sure[i] = start if errors is None or unmoved else errors
            elif errors is not None:
                (still if unmoved else sure)[i] = errors
            elif sight is not None:
                by_sight[i] = sight
        if len(placed) == 1 and not sure:
            odds = [place.odds for place in still.values()]
            if len(still) == len(left) and min(odds) > _ALIKE * max(odds):
                doubts.unmoved.extend(names[i] for i in still)
            else:
                still = {}
        new = sure or still or by_sight
        if new is by_sight:
            doubts.by_sight.extend(names[i] for i in new)
        if not new:
            break
        placed, left = placed | new, [i for i in left if i not in new]
    doubts.tell(period)
    return placed, left


@dataclass(frozen=True, eq=False)
class _Doubts:
    """Names of exposures that were placed by what may be wrong."""

    contradicted: list = field(default_factory=list)
    unmoved: list = field(default_factory=list)
    by_sight: list = field(default_factory=list)

    def tell(self, period):
        """Warn of them."""
        if self.contradicted:
            warn(
                f"the start positions of {some_of(self.contradicted, 3)} contradict the errors of the holes of the "
                f"mask by whole periods of {period}: they must be right to half a period",
                AssumptionWarning,
            )
        if self.unmoved:
            warn(
                f"{_LATTICE} {period}; {some_of(self.unmoved, 3)} are taken to be shifted by less than half of one, "
                f"since the errors of holes agree there; those of a rough distortion would as well: {_GIVE}",
                AssumptionWarning,
            )
        if self.by_sight:
            warn(
                f"{_LATTICE} {period}; by how many {some_of(self.by_sight, 3)} are shifted is told by the largest "
                "overlap alone, edges of the mask and holes that are not seen, which vignetting would feign: "
                f"{_GIVE}",
                AssumptionWarning,
            )


def _same(one, other):
    return np.array_equal(one.turn, other.turn) and np.array_equal(one.offset, other.offset)


def _is_still(first, place, other, there):
    """Whether the same holes are those that lie nearest to the same pixels in two exposures."""
    at = place(np.median(first.index, axis=0)[None])
    moved = other.pixels(there.back(at)) - first.pixels(place.back(at))
    turned = other.basis @ np.linalg.inv(there.turn) @ np.linalg.inv(first.basis @ np.linalg.inv(place.turn))
    return np.abs(turned - np.eye(2)).max() < 0.5 and np.abs(np.linalg.solve(first.basis, moved[0])).max() < 0.5


def _turns(basis, other):
    """Integer matrices (2, 2) from places of one lattice to those of another, as similarities of pixels have them."""
    for entries in product((-1, 0, 1), repeat=4):
        turn = np.array(entries).reshape(2, 2)
        if abs(round(np.linalg.det(turn))) != 1:
            continue
        sizes = np.linalg.svd(basis @ turn @ np.linalg.inv(other), compute_uv=False)
        if np.abs(np.log(sizes)).max() < SCALE_TOLERANCE:
            yield turn


def _starts(holes, hub, steps):
    """Places by start positions, ``{exposure: _Placed}``: none where these do not agree to half a period.

    Of all, the hub included, start positions are off by parts of a period that a whole shift makes the nearest to each
    other; which one does is clear if all of them lie in one half of a period.
    """
    first, turns, wanted = holes[hub], {}, {}
    at = np.median(first.index, axis=0)[None]
    for i, step in steps.items():
        if step is None:
            continue
        there = first.pixels(at) @ step[:, :2].T + step[:, 2]
        turn = min(
            _turns(first.basis, holes[i].basis),
            key=lambda t: np.abs(holes[i].basis @ np.linalg.inv(t) @ np.linalg.inv(first.basis) - step[:, :2]).max(),
            default=None,
        )
        if turn is not None:
            turns[i], wanted[i] = turn, (holes[i].indices(there) @ turn.T - at)[0]
    wanted[hub], turns[hub] = np.zeros(2), _AS_IT_IS.turn
    names, off = list(wanted), np.array(list(wanted.values()))
    whole = np.empty(off.shape)
    for axis in (0, 1):
        part = np.sort(off[:, axis] % 1)
        gap = np.diff([*part, part[0] + 1])
        begin = part[(np.argmax(gap) + 1) % len(part)]
        if gap.max() < 0.5:
            return {}
        whole[:, axis] = off[:, axis] - begin - (off[:, axis] - begin) % 1
    whole = np.round(whole - whole[names.index(hub)]).astype(int)
    return {i: _Placed(turns[i], each) for i, each in zip(names, whole, strict=True) if i != hub}


def _pattern(holes, basis, place):
    """Holes of an exposure on the lattice of the first, their errors in its pixels."""
    back = basis @ place.turn @ np.linalg.inv(holes.basis)
    off = np.stack([holes.residual.real, holes.residual.imag]).T @ back.T @ [1, 1j]
    index = place(holes.index)
    at = place(np.stack(np.nonzero(holes.places), axis=-1) + holes.low)
    low = np.minimum(index.min(axis=0), at.min(axis=0))
    span = np.maximum(index.max(axis=0), at.max(axis=0)) + 1 - low
    out = _Pattern(low, np.zeros(span, complex), np.zeros(span), np.zeros(span))
    out.off[tuple((index - low).T)] = off
    out.seen[tuple((index - low).T)] = 1
    out.places[tuple((at - low).T)] = 1
    return out


def _joined(patterns):
    """The mean of some patterns: a hole is seen where half of those that would see it do."""
    low = np.min([each.low for each in patterns], axis=0)
    span = np.max([each.low + each.seen.shape for each in patterns], axis=0) - low
    off, known, seen, places = np.zeros(span, complex), np.zeros(span), np.zeros(span), np.zeros(span)
    for each in patterns:
        part = tuple(slice(a, a + n) for a, n in zip(each.low - low, each.seen.shape, strict=True))
        off[part] += each.off
        known[part] += each.off != 0
        seen[part] += each.seen
        places[part] += each.places
    return _Pattern(low, off / np.maximum(known, 1), (seen > 0) & (2 * seen >= places), places > 0)


def _decided(whole, holes, basis, gaps):
    """Places of an exposure by the errors of its holes and by what is seen of them; None where that is not clear."""
    by_errors, by_sight = [], []
    for turn in _turns(basis, holes.basis):
        each = _pattern(holes, basis, _Placed(turn, np.zeros(2, dtype=int)))
        errors, sight, low = _odds(whole, each)
        for odds, out in ((errors, by_errors), (sight, by_sight)):
            for k in np.argpartition(-odds.ravel(), 1)[:2]:
                offset = np.array(np.unravel_index(k, odds.shape)) + low
                out.append(_Placed(turn, offset, odds.ravel()[k]))
    if not by_errors:
        return None, None
    best, second, *_ = sorted(by_errors, key=lambda place: -place.odds)
    errors = best if best.odds > max(_ODDS, _TIMES * second.odds) else None
    best, second, *_ = sorted(by_sight, key=lambda place: -place.odds)
    return errors, best if best.odds - second.odds > _SEEN and not gaps else None


def _odds(whole, other):
    """Logarithms of the odds that two patterns are the same, by offset, and the lowest offset: by errors, by sight."""
    mine, most = np.array(whole.seen.shape), np.add(whole.seen.shape, other.seen.shape) - 1
    size = [fft.next_fast_len(int(n)) for n in most]

    def summed(one, two):
        """Sums of ``conj(one[u]) two[u + offset]`` by offset."""
        spectrum = np.conj(fft.fft2(one, size)) * fft.fft2(two, size)
        return np.roll(fft.ifft2(spectrum).real, mine - 1, axis=(0, 1))[: most[0], : most[1]]

    known = [(each.off != 0).astype(float) for each in (whole, other)]
    n = np.round(summed(*known)) - _TAKEN_UP
    power = summed(np.abs(whole.off) ** 2, known[1]) * summed(known[0], np.abs(other.off) ** 2)
    alike = summed(whole.off, other.off) / np.sqrt(np.maximum(power, 1e-300))
    errors = np.where((n > 10) & (alike > 0), -n * np.log1p(-(np.clip(alike, 0, 1 - 1e-9) ** 2)), 0.0)
    seen = [(each.seen * each.places).astype(float) for each in (whole, other)]
    unseen = [each.places - one for each, one in zip((whole, other), seen, strict=True)]
    rate = sum(map(np.sum, seen)) / sum(np.sum(each.places) for each in (whole, other))
    there = min(rate / (1 - _MISSED), 1 - 1e-3)
    one = there * (1 - _MISSED)
    sight = summed(seen[0], seen[1]) * np.log(there * (1 - _MISSED) ** 2 / one**2)
    sight += (summed(seen[0], unseen[1]) + summed(unseen[0], seen[1])) * np.log(one * _MISSED / (one * (1 - one)))
    # that neither has a hole tells something only between holes: beside a mask there is none however far one looks
    between = [each * _surrounded(each_seen) for each, each_seen in zip(unseen, seen, strict=True)]
    sight += summed(*between) * np.log((1 - there + there * _MISSED**2) / (1 - one) ** 2)
    return errors, sight, other.low - whole.low - mine + 1


def _surrounded(seen):
    """Which places have a hole on all four sides."""
    out = np.ones(seen.shape, dtype=bool)
    for axis in (0, 1):
        for step in (1, -1):
            view = np.flip(seen, axis) if step < 0 else seen
            over = np.maximum.accumulate(view, axis=axis) > 0
            out &= np.flip(over, axis) if step < 0 else over
    return out
