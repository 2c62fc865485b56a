"""The static distortion of a camera from many nights, which scatter, and perhaps drift or depend on a number."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from ...cameras.stated_errors import FREE
from ...solving.gauge.dynamic_scatter import CHANCE, TAILS
from ...solving.knowledge.exposures import RANGE
from ...solving.knowledge.factors import GIVEN, Factor
from ...solving.knowledge.posterior import most_likely
from ...solving.knowledge.reduced_data import ReducedData, drawn
from ..known_maps import DETERMINED, KEPT

_EXACT = 1e-6  # scatter of one night, of which nothing tells [pix]
_MOST, _FEWEST = 600, 12  # unknowns from which sizes are found, and nights, if there are as many
_ROUNDS, _SETTLED = 20, 0.02
_TINY = 1e-3  # of the scatter of nights, which is as good as none
_ROUNDING = 1e-13  # of the largest information
_WIDE = 10  # sizes of slopes that these may have: one that stands out is not drawn to the others, which are none


@dataclass(frozen=True, eq=False)
class Chain:
    """Nights n that see ``S(t_n) + x_n T + B_n``, B_n what a night departs by.

    S is a constant, a rate and a random walk in time, T slopes by a number x. A night may also see T itself, by
    exposures whose numbers differ.

    Attributes
    ----------
    information : ndarray, shape (N, K, K) or (N, 2 K, 2 K)
        Of every night on what it sees, and on T if there is one.
    pull : ndarray, shape (N, K) or (N, 2 K)
        The same times what it sees at best.
    scatter2 : ndarray, shape (N, K)
        Variance of B_n.
    dates : ndarray, shape (N,)
        Years.
    rate, walk : float
        Sizes of the rate, pixels a year, and of the walk, pixels in the square root of a year; 0: none.
    slope : float
        Size of T, pixels, which may be 10 times as large; 0: none.
    numbers : ndarray, shape (N,), or None
        x of the nights, if there is a T.
    """

    information: np.ndarray
    pull: np.ndarray
    scatter2: np.ndarray
    dates: np.ndarray
    rate: float = 0.0
    walk: float = 0.0
    slope: float = 0.0
    numbers: np.ndarray | None = None

    @classmethod
    def of(cls, nights, scatter2, dates, sizes=None, numbers=None, *, origin=0.0):
        """Those of nights ``(around, information, pull)`` as for `fitted`, on S from a map (K,) on.

        `sizes` are rate, walk and slope, as far as there are any.
        """
        sizes = sizes or {}
        nights = nights if sizes.get("slope") else [_without_slopes(each) for each in nights]
        information, moved = np.stack([each[1] for each in nights]), np.stack([each[0] - origin for each in nights])
        k = moved.shape[1]
        pull = np.stack([each[2] for each in nights]) + np.einsum("nkl,nl->nk", information[:, :, :k], moved)
        return cls(information, pull, scatter2, dates, **sizes, numbers=numbers if sizes.get("slope") else None)

    @property
    def size(self):
        """Number K of coefficients of S."""
        return self.scatter2.shape[1]

    @cached_property
    def _alone(self):
        """Information and pull of every night, without what it departs by, on ``S + x_n T``, and on T."""
        k = self.size
        inner = self.information[:, :k, :k] + np.eye(k) / self.scatter2[:, None]
        known = np.concatenate([self.information, self.pull[:, :, None]], axis=2)
        known = known - self.information[:, :, :k] @ np.linalg.solve(inner, known[:, :k])
        return known[:, :, :-1], known[:, :, -1]

    @cached_property
    def _order(self):
        return np.argsort(self.dates, kind="stable")

    @cached_property
    def _swept(self):
        """What nights before each say at its date, information and pull, by time; and those after, backwards."""
        return self._sweep(self._order), self._sweep(self._order[::-1])

    def _sweep(self, order):
        size = len(self._precision)
        here, out = (np.zeros((size, size)), np.zeros(size)), []
        for n, following in zip(order, [*order[1:], order[-1]], strict=True):
            out.append(here)
            here = self._later(*self._with_own(here, n), abs(self.dates[following] - self.dates[n]))
        return out

    def at(self, date, number=0.0):
        """``S + x T`` at a date and a number x, (K,), and T if there is one, (2 K,); and their covariance."""
        dates, (early, late) = self.dates[self._order], self._swept
        after = int(np.searchsorted(dates, date, side="right"))
        (information, pull), (more, pulled) = early[0], late[0]
        if after:
            n = self._order[after - 1]
            information, pull = self._later(*self._with_own(early[after - 1], n), date - self.dates[n])
        if after < len(dates):
            n = self._order[after]
            more, pulled = self._later(*self._with_own(late[len(dates) - 1 - after], n), self.dates[n] - date)
        return self._found(self._seen(date, number), information + more, pull + pulled)

    def _with_own(self, known, n):
        """What is known at the date of a night, with what the night itself says."""
        seen = self._seen_by(n)
        return known[0] + seen.T @ self._alone[0][n] @ seen, known[1] + seen.T @ self._alone[1][n]

    @cached_property
    def others(self):
        """What every night sees beside B_n, as `at`, and its covariance, by all other nights: a list."""
        early, late = self._swept
        out, count = [None] * len(self.dates), len(self.dates)
        for k, n in enumerate(self._order):
            (one, pull), (two, pulled) = early[k], late[count - 1 - k]
            out[n] = self._found(self._seen_by(n), one + two, pull + pulled)
        return out

    @property
    def _precision(self):
        """Of what is sought, S, its rate and T, without any night."""
        return np.repeat([size**-2.0 for size in (FREE, self.rate, _WIDE * self.slope) if size], self.size)

    def _found(self, seen, information, pull):
        covariance = np.linalg.inv(information + np.diag(self._precision))
        there = seen @ covariance @ seen.T
        return seen @ covariance @ pull, (there + there.T) / 2

    def _seen(self, date, number):
        """``S + x T`` at a date and a number x, and T if there is one, as part of what is sought."""
        seen = [[1.0, *[date - self.dates.mean()] * bool(self.rate), *[number] * bool(self.slope)]]
        seen += [[*[0.0] * (len(seen[0]) - 1), 1.0]] * bool(self.slope)
        return np.kron(seen, np.eye(self.size))

    def _seen_by(self, n):
        return self._seen(self.dates[n], 0.0 if self.numbers is None else self.numbers[n])

    def _later(self, information, pull, years):
        """What is known some years later."""
        if not self.walk * years > 0:
            return information, pull
        k = self.size
        moving = information[:k, :k] + np.eye(k) / (self.walk**2 * years)
        lost = information[:, :k] @ np.linalg.solve(moving, np.column_stack([information[:k], pull[:k]]))
        return information - lost[:, :-1], pull - lost[:, -1]


def _without_slopes(night):
    """The same night ``(around, information, pull)`` if there is no T."""
    around, information, pull = night
    return around, information[: len(around), : len(around)], pull[: len(around)]


def fitted(nights, dates, degrees, whole=None, scatter=None, numbers=None):
    """Nights as a `Chain` from the first's map on, with sizes that make the data most likely; and their oddness (N,).

    Parameters
    ----------
    nights : list of (around, information, pull), shapes (K,), (K, K), (K,)
        What every night sees: a map, and what the night says from there; with numbers (2 K, 2 K) and (2 K,), on slopes
        by them too.
    dates : ndarray, shape (N,)
        Years; NaN where they are not known, and then there is no drift.
    degrees : ndarray of int, shape (K,)
        Of every coefficient.
    whole : ndarray of bool, shape (N,), optional
        Which say it of S itself, as several nights together do.
    scatter : ndarray, shape (degree,), optional
        Of nights, where fewer than two others tell it.
    numbers : ndarray, shape (N,), optional
        On which S may depend linearly; about zero, and of the order of one.

    Returns
    -------
    Chain
    ndarray, shape (N,)
        Factors >= 1 on the scatter of single nights, as for Student's t distribution.
    ndarray, shape (degree,)
        Scatter of nights, by degree, pixels; zero where nothing tells it.
    float
        Evidence of a dependence on the numbers: by how much it makes twice the logarithm of the likelihood larger.
    """
    whole = np.zeros(len(nights), dtype=bool) if whole is None else whole
    dated, n_scatters = np.all(np.isfinite(dates)), int(degrees.max(initial=0))
    dates = dates if dated else np.zeros(len(dates))
    several, sizes, odd, evidence = np.count_nonzero(~whole) > 1, {}, np.ones(len(nights)), 0.0
    if several or numbers is not None:
        keep = drawn(np.zeros(len(nights), int), max(_FEWEST, _MOST // (2 * len(degrees))))
        some = [nights[i] for i in keep], dates[keep], degrees, whole[keep]
        drifts = (False, True)[: 1 + (several and dated and len(np.unique(dates[keep])) > 2)]
        tried = {(drift, x is not None): _sizes(*some, x, drifts=drift)
                 for x in ([None] if numbers is None else [None, numbers[keep]]) for drift in drifts}  # fmt: skip
        least = {with_slope: min(cost + KEPT * drift for (drift, sloped), (_, _, cost) in tried.items()
                                 if sloped == with_slope) for _, with_slope in tried}  # fmt: skip
        evidence = least[False] - least[True] if numbers is not None else 0.0
        _, kept = min((cost + KEPT * sum(each), each) for each, (_, _, cost) in tried.items())
        found, odd[keep], _ = tried[kept]
        sizes = dict(zip(["rate", "walk"] * kept[0] + ["slope"] * kept[1], map(float, found[n_scatters:]), strict=True))
        scatter = np.maximum(found[:n_scatters], _EXACT) if several else scatter
    scatter = np.zeros(n_scatters) if scatter is None else scatter
    scatter2 = own_scatter2(scatter, odd, whole, degrees)
    chain = Chain.of(nights, scatter2, dates, sizes, numbers, origin=nights[0][0])
    for _ in range(_ROUNDS if several else 0):
        before, odd = odd, np.where(whole, 1.0, _oddness(chain, np.maximum(scatter, _EXACT)[degrees - 1]))
        chain = replace(chain, scatter2=own_scatter2(scatter, odd, whole, degrees))
        if np.all(np.abs(np.log(odd / before)) < _SETTLED):
            break
    return chain, odd, scatter, float(evidence)


def own_scatter2(scatter, odd, whole, degrees):
    """Variance (N, K) of what nights depart by: as good as none of those that speak of S itself."""
    width = np.maximum(scatter, _EXACT)[degrees - 1] * odd[:, None]
    return np.where(whole[:, None], _EXACT, width) ** 2


def _oddness(chain, width):
    """Factors (N,) on the scatter of nights, see `legdistort.solving.gauge.most_probable`."""
    mean, covariance = (np.stack(each) for each in zip(*chain.others, strict=True))
    k, eye, own = len(width), np.eye(len(width)), chain.information
    # what a night says of B, with S and T as all others have them
    seen = own @ np.linalg.inv(np.eye(own.shape[1]) + covariance @ own)
    pull = chain.pull - np.einsum("nkl,nl->nk", own, mean)
    pull = (pull - np.einsum("nkl,nlm,nm->nk", seen, covariance, pull))[:, :k]
    seen = seen[:, :k, :k]
    inverse = np.linalg.inv(seen + eye / chain.scatter2[:, None])
    away = np.einsum("nkl,nl->nk", inverse, pull)
    square = np.sum((away**2 + np.einsum("nkk->nk", inverse)) / width**2, axis=1)
    return _stretch(square, len(width))


def _stretch(square, count):
    return np.sqrt(np.maximum(1.0, (TAILS + square) / (TAILS + count + CHANCE * np.sqrt(2 * count))))


def _sizes(nights, dates, degrees, whole, numbers, *, drifts):
    """Sizes by degree, then of rate and walk if S drifts, then of T if there are numbers; oddness; the cost.

    That is minus twice the logarithm of the likelihood.
    """
    data, factor, unit = _model(nights, dates, degrees, numbers, drifts)
    n, k, odd = len(nights), len(degrees), np.ones(len(nights))
    start = np.full((2, int(degrees.max()) + 2 * drifts + (numbers is not None)), 10 * unit)
    start[1] = unit
    for _ in range(_ROUNDS):
        stretch = factor.stretch.copy()
        stretch[: n * k] = np.repeat(np.where(whole, _TINY, odd), k)
        found = most_likely(data, replace(factor, stretch=stretch), start, unit * np.array(RANGE))
        value, variance = (each[: n * k].reshape(n, k) for each in found.left)
        width = found.widths[: n * k].reshape(n, k) / np.where(whole, _TINY, odd)[:, None]
        square = ((value**2 + variance) / width**2).sum(axis=1)
        before, odd = odd, np.where(whole, 1.0, _stretch(square, k))
        start = found.sizes
        if np.all(np.abs(np.log(odd / before)) < _SETTLED):
            break
    return found.sizes, odd, found.cost


def _model(nights, dates, degrees, numbers, drifts):
    """Data on what all nights see, from their maps, and on T; the factor on nights and statics; a typical error."""
    n, k, eye, slopes = len(nights), len(degrees), np.eye(len(degrees)), numbers is not None
    times, place = np.unique(dates, return_inverse=True) if drifts else (np.zeros(1), np.zeros(n, int))
    m, parts = len(times), []
    apart = [_without_slopes(each) for each in nights]
    information, pull = linalg.block_diag(*[each[1] for each in apart]), np.concatenate([each[2] for each in apart])
    if slopes:
        across = np.concatenate([each[1][:k, k:] for each in nights])
        own = sum(each[1][k:, k:] for each in nights)
        information = np.block([[information, across], [across.T, own]])
        pull = np.append(pull, sum(each[2][k:] for each in nights))
    data = ReducedData(information, pull, 0.0, n * k)
    known, vectors = np.linalg.eigh(sum(each[1] for each in apart) / n)
    untold = vectors[:, known < _ROUNDING * known.max(initial=0)].T
    known = known[known > DETERMINED]
    unit = 1 / np.sqrt(np.median(known)) if len(known) else 0.1
    counts = {"night": n, "slope": slopes, "static": m, "rate": drifts}

    def add(value, size, stretch, each=eye, width=FREE, **rows):
        of = [name for name, count in counts.items() if count]
        blocks = [sparse.kron(rows[name], each) if name in rows else None for name in of]
        blocks = [
            sparse.csr_array((len(value), k * count)) if block is None else block
            for block, count in zip(blocks, map(counts.get, of), strict=True)
        ]
        all_rows = sparse.hstack(blocks, format="csr")
        parts.append(Factor("nights", all_rows, value, np.full(len(value), width), size, stretch))

    own = sparse.csr_array((-np.ones(n), (range(n), place)), (n, m))
    away = np.concatenate([each[0] - nights[0][0] for each in nights])
    more = {"rate": -(dates - dates.mean())[:, None]} if drifts else {}
    more |= {"slope": -numbers[:, None]} if slopes else {}
    add(away, np.tile(degrees - 1, n), np.ones(n * k), night=np.eye(n), static=own, **more)
    add(np.zeros(k), np.full(k, GIVEN), np.ones(k), static=np.eye(1, m))
    # what no night tells is nowhere in the likelihood: held, so that the rest is not lost beside it
    add(np.zeros(len(untold)), np.full(len(untold), GIVEN), np.ones(len(untold)), untold, unit, static=np.eye(1, m))
    first = int(degrees.max())
    if slopes:
        add(np.zeros(k), np.full(k, first + 2 * drifts), np.ones(k), slope=np.eye(1))
    if drifts:
        add(np.zeros(k), np.full(k, first), np.ones(k), rate=np.eye(1))
        steps, since = np.eye(m - 1, m, k=1) - np.eye(m - 1, m), np.repeat(np.sqrt(np.diff(times)), k)
        add(np.zeros((m - 1) * k), np.full((m - 1) * k, first + 1), since, static=steps)
    return data, Factor.joined(parts), unit


def contradiction(chain, n, width):
    """Whether a night contradicts all others: chi2, in how many directions, and differences (K,) that are determined.

    `width` (K,) is the scatter of nights. Slopes that the night sees count too.
    """
    mean, covariance = chain.others[n]
    width = np.pad(width, (0, len(mean) - len(width)))
    sizes, vectors = np.linalg.eigh(chain.information[n])
    seen = sizes > DETERMINED
    inside, power = vectors[:, seen].T, sizes[seen]
    away = inside @ chain.pull[n] / power - inside @ mean
    whole = inside @ (covariance + np.diag(width**2)) @ inside.T + np.diag(1 / power)
    spread, turned = np.linalg.eigh(whole)
    told = turned[:, spread < 1 / DETERMINED]  # by the others too
    differences = inside.T @ (told @ (told.T @ away))
    return float(away @ np.linalg.solve(whole, away)), int(seen.sum()), differences[: chain.size]
