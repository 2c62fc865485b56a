"""The static distortion of a camera from many nights, which scatter and perhaps drift."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from ..cameras.stated_errors import FREE
from ..solving.gauge.dynamic_scatter import CHANCE, TAILS
from ..solving.knowledge.exposures import RANGE
from ..solving.knowledge.factors import GIVEN, Factor
from ..solving.knowledge.posterior import most_likely
from ..solving.knowledge.reduced_data import ReducedData, drawn
from .known_maps import DETERMINED

#: A drift, of two sizes, is kept if it makes twice the logarithm of the likelihood larger by so much.
KEPT = 6.0
_EXACT = 1e-6  # scatter of one night, of which nothing tells [pix]
_MOST, _FEWEST = 600, 12  # unknowns from which sizes are found, and nights, if there are as many
_ROUNDS, _SETTLED = 20, 0.02
_TINY = 1e-3  # of the scatter of nights, which is as good as none


@dataclass(frozen=True, eq=False)
class Chain:
    """Nights n that see ``S(t_n) + B_n``: S a constant, a rate and a random walk in time, B_n what a night departs by.

    Attributes
    ----------
    information : ndarray, shape (N, K, K)
        Of every night on what it sees.
    pull : ndarray, shape (N, K)
        The same times what it sees at best.
    scatter2 : ndarray, shape (N, K)
        Variance of B_n.
    dates : ndarray, shape (N,)
        Years.
    rate, walk : float
        Sizes of the rate, pixels a year, and of the walk, pixels in the square root of a year; 0: none.
    """

    information: np.ndarray
    pull: np.ndarray
    scatter2: np.ndarray
    dates: np.ndarray
    rate: float = 0.0
    walk: float = 0.0

    @classmethod
    def of(cls, nights, scatter2, dates, rate=0.0, walk=0.0, *, origin=0.0):
        """Those of nights ``(around, information, pull)`` as for `fitted`, on S from a map (K,) on."""
        information, moved = np.stack([each[1] for each in nights]), np.stack([each[0] - origin for each in nights])
        pull = np.stack([each[2] for each in nights]) + np.einsum("nkl,nl->nk", information, moved)
        return cls(information, pull, scatter2, dates, rate, walk)

    @cached_property
    def _alone(self):
        """Information (N, K, K) and pull (N, K) of every night on S."""
        size = self.pull.shape[1]
        inner = self.information + np.eye(size) / self.scatter2[:, None]
        known = np.concatenate([self.information, self.pull[:, :, None]], axis=2)
        known = known - self.information @ np.linalg.solve(inner, known)
        return known[:, :, :-1], known[:, :, -1]

    @cached_property
    def _order(self):
        return np.argsort(self.dates, kind="stable")

    @cached_property
    def _swept(self):
        """What nights before each say at its date, information and pull, by time; and those after, backwards."""
        return self._sweep(self._order), self._sweep(self._order[::-1])

    def _sweep(self, order):
        size = self.pull.shape[1] * (2 if self.rate else 1)
        here, out = (np.zeros((size, size)), np.zeros(size)), []
        for n, following in zip(order, [*order[1:], order[-1]], strict=True):
            out.append(here)
            here = self._later(*self._with_own(here, n), abs(self.dates[following] - self.dates[n]))
        return out

    def at(self, date):
        """S at a date, (K,), and its covariance (K, K)."""
        dates, (early, late) = self.dates[self._order], self._swept
        after = int(np.searchsorted(dates, date, side="right"))
        (information, pull), (more, pulled) = early[0], late[0]
        if after:
            n = self._order[after - 1]
            information, pull = self._later(*self._with_own(early[after - 1], n), date - self.dates[n])
        if after < len(dates):
            n = self._order[after]
            more, pulled = self._later(*self._with_own(late[len(dates) - 1 - after], n), self.dates[n] - date)
        return self._found(date, information + more, pull + pulled)

    def _with_own(self, known, n):
        """What is known at the date of a night, with what the night itself says."""
        seen = self._seen(self.dates[n])
        return known[0] + seen.T @ self._alone[0][n] @ seen, known[1] + seen.T @ self._alone[1][n]

    @cached_property
    def others(self):
        """S at the date of every night, (K,), and its covariance (K, K), by all other nights: a list."""
        early, late = self._swept
        out, count = [None] * len(self.dates), len(self.dates)
        for k, n in enumerate(self._order):
            (one, pull), (two, pulled) = early[k], late[count - 1 - k]
            out[n] = self._found(self.dates[n], one + two, pull + pulled)
        return out

    def _found(self, date, information, pull):
        size = self.pull.shape[1]
        known = np.full(size, FREE**-2.0)
        if self.rate:
            known = np.append(known, np.full(size, self.rate**-2.0))
        covariance, seen = np.linalg.inv(information + np.diag(known)), self._seen(date)
        there = seen @ covariance @ seen.T
        return seen @ covariance @ pull, (there + there.T) / 2

    def _seen(self, date):
        """S at a date as part of what is sought, (K, K) or (K, 2 K) with a rate."""
        own = np.eye(self.pull.shape[1])
        return np.hstack([own, (date - self.dates.mean()) * own]) if self.rate else own

    def _later(self, information, pull, years):
        """What is known some years later."""
        if not self.walk * years > 0:
            return information, pull
        k = self.pull.shape[1]
        moving = information[:k, :k] + np.eye(k) / (self.walk**2 * years)
        lost = information[:, :k] @ np.linalg.solve(moving, np.column_stack([information[:k], pull[:k]]))
        return information - lost[:, :-1], pull - lost[:, -1]


def fitted(nights, dates, degrees, whole=None, scatter=None):
    """Nights as a `Chain` from the first's map on, with sizes that make the data most likely; and their oddness (N,).

    Parameters
    ----------
    nights : list of (around, information, pull), shapes (K,), (K, K), (K,)
        What every night sees: a map, and what the night says from there.
    dates : ndarray, shape (N,)
        Years; NaN where they are not known, and then there is no drift.
    degrees : ndarray of int, shape (K,)
        Of every coefficient.
    whole : ndarray of bool, shape (N,), optional
        Which say it of S itself, as several nights together do.
    scatter : ndarray, shape (degree,), optional
        Of nights, where fewer than two others tell it.

    Returns
    -------
    Chain
    ndarray, shape (N,)
        Factors >= 1 on the scatter of single nights, as for Student's t distribution.
    ndarray, shape (degree,)
        Scatter of nights, by degree, pixels; zero where nothing tells it.
    """
    whole = np.zeros(len(nights), dtype=bool) if whole is None else whole
    dated, n_scatters = np.all(np.isfinite(dates)), int(degrees.max(initial=0))
    dates = dates if dated else np.zeros(len(dates))
    drift, odd = [], np.ones(len(nights))
    if np.count_nonzero(~whole) > 1:
        keep = drawn(np.zeros(len(nights), int), max(_FEWEST, _MOST // (2 * len(degrees))))
        some = [nights[i] for i in keep], dates[keep], degrees, whole[keep]
        sizes, part, cost = _sizes(*some, drifts=False)
        if dated and len(np.unique(dates[keep])) > 2:
            drifting = _sizes(*some, drifts=True)
            if cost - drifting[2] > KEPT:
                sizes, part, cost = drifting
        drift, odd[keep] = [float(each) for each in sizes[n_scatters:]], part
        scatter = np.maximum(sizes[:n_scatters], _EXACT)
    scatter = np.zeros(n_scatters) if scatter is None else scatter
    chain = Chain.of(nights, own_scatter2(scatter, odd, whole, degrees), dates, *drift, origin=nights[0][0])
    for _ in range(_ROUNDS if np.count_nonzero(~whole) > 1 else 0):
        before, odd = odd, np.where(whole, 1.0, _oddness(chain, np.maximum(scatter, _EXACT)[degrees - 1]))
        chain = replace(chain, scatter2=own_scatter2(scatter, odd, whole, degrees))
        if np.all(np.abs(np.log(odd / before)) < _SETTLED):
            break
    return chain, odd, scatter


def own_scatter2(scatter, odd, whole, degrees):
    """Variance (N, K) of what nights depart by: as good as none of those that speak of S itself."""
    width = np.maximum(scatter, _EXACT)[degrees - 1] * odd[:, None]
    return np.where(whole[:, None], _EXACT, width) ** 2


def _oddness(chain, width):
    """Factors (N,) on the scatter of nights, see `legdistort.solving.gauge.most_probable`."""
    mean, covariance = (np.stack(each) for each in zip(*chain.others, strict=True))
    eye, own = np.eye(len(width)), chain.information
    # what a night says of B, with S as all others have it
    seen = own @ np.linalg.inv(eye + covariance @ own)
    pull = chain.pull - np.einsum("nkl,nl->nk", own, mean)
    pull = pull - np.einsum("nkl,nlm,nm->nk", seen, covariance, pull)
    inverse = np.linalg.inv(seen + eye / chain.scatter2[:, None])
    away = np.einsum("nkl,nl->nk", inverse, pull)
    square = np.sum((away**2 + np.einsum("nkk->nk", inverse)) / width**2, axis=1)
    return _stretch(square, len(width))


def _stretch(square, count):
    return np.sqrt(np.maximum(1.0, (TAILS + square) / (TAILS + count + CHANCE * np.sqrt(2 * count))))


def _sizes(nights, dates, degrees, whole, *, drifts):
    """Sizes by degree, then of rate and walk if S drifts; oddness; minus twice the logarithm of the likelihood."""
    data, factor, unit = _model(nights, dates, degrees, drifts)
    n, k, odd = len(nights), len(degrees), np.ones(len(nights))
    start = np.full((2, int(degrees.max()) + 2 * drifts), 10 * unit)
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


def _model(nights, dates, degrees, drifts):
    """Data on what all nights see, from their maps; the factor on nights and statics; a typical error."""
    n, k, eye = len(nights), len(degrees), np.eye(len(degrees))
    times, place = np.unique(dates, return_inverse=True) if drifts else (np.zeros(1), np.zeros(n, int))
    m, parts = len(times), []
    data = ReducedData(
        linalg.block_diag(*[each[1] for each in nights]), np.concatenate([each[2] for each in nights]), 0.0, n * k
    )

    def add(value, size, stretch, **rows):
        blocks = [sparse.kron(rows[name], eye) if name in rows else None for name in ("night", "static", "rate")]
        counts = n, m, *[1] * drifts
        blocks = [
            sparse.csr_array((len(value), k * count)) if block is None else block
            for block, count in zip(blocks, counts, strict=False)
        ]
        all_rows = sparse.hstack(blocks, format="csr")
        parts.append(Factor("nights", all_rows, value, np.full(len(value), FREE), size, stretch))

    own = sparse.csr_array((-np.ones(n), (range(n), place)), (n, m))
    away = np.concatenate([each[0] - nights[0][0] for each in nights])
    rate = {"rate": -(dates - dates.mean())[:, None]} if drifts else {}
    add(away, np.tile(degrees - 1, n), np.ones(n * k), night=np.eye(n), static=own, **rate)
    add(np.zeros(k), np.full(k, GIVEN), np.ones(k), static=np.eye(1, m))
    if drifts:
        first = int(degrees.max())
        add(np.zeros(k), np.full(k, first), np.ones(k), rate=np.eye(1))
        steps, since = np.eye(m - 1, m, k=1) - np.eye(m - 1, m), np.repeat(np.sqrt(np.diff(times)), k)
        add(np.zeros((m - 1) * k), np.full((m - 1) * k, first + 1), since, static=steps)
    known = np.linalg.eigvalsh(sum(each[1] for each in nights) / n)
    known = known[known > DETERMINED]
    return data, Factor.joined(parts), 1 / np.sqrt(np.median(known)) if len(known) else 0.1


def contradiction(chain, n, width):
    """Whether a night contradicts all others: chi2, in how many directions, and differences (K,) that are determined.

    `width` (K,) is the scatter of nights.
    """
    mean, covariance = chain.others[n]
    sizes, vectors = np.linalg.eigh(chain.information[n])
    seen = sizes > DETERMINED
    inside, power = vectors[:, seen].T, sizes[seen]
    away = inside @ chain.pull[n] / power - inside @ mean
    whole = inside @ (covariance + np.diag(width**2)) @ inside.T + np.diag(1 / power)
    spread, turned = np.linalg.eigh(whole)
    told = turned[:, spread < 1 / DETERMINED]  # by the others too
    return float(away @ np.linalg.solve(whole, away)), int(seen.sum()), inside.T @ (told @ (told.T @ away))
