"""The most probable stars, distortions and static distortions together, however large these are.

``J = chi2 + sum_i (A_i - S - B_n)' Lambda_i^-1 (A_i - S - B_n) + sum_n B_n' Lambda_n^-1 B_n + (S - m)' V^-1 (S - m)``,
with B_n what the exposures of a night have in common, is minimised over everything at once by damped Gauss-Newton
steps (Marquardt 1963), the stars eliminated from each. Nothing but the mean similarity of the poses is held, so that
no convention stands between the data and their minimum. The scatters Lambda of single exposures and of nights, by
degree, and the size of a static distortion of which nothing is known are those that make the data most likely. A
single Gaussian scatter would let one odd exposure or night widen that of all: each has a factor of its own on it, as
for Student's t distribution (Lange, Little & Taylor 1989).
"""

import logging
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from ...exceptions import SolveError
from ...geometry import basis
from ...geometry.detector_modes import dynamic_basis, dynamic_degrees, row_variances, similarity_basis
from ..equations import criterion, elimination, reduced_system
from ..equations.losses import loss_factors
from ..equations.problem import State
from ..knowledge.exposures import stated
from ..knowledge.factors import GIVEN, Factor
from ..knowledge.posterior import Posterior, most_likely
from ..knowledge.reduced_data import drawn, part_of, without_stars
from . import constraints
from .dynamic_scatter import CHANCE, TAILS, conditional_errors

log = logging.getLogger(__name__)

#: Steps at most; converged below such parts of every size, and so many standard errors, rms over the unknowns.
MAX_STEPS, SETTLED = 60, 0.02
TOLERANCE = {"linear": 0.01, "huber": 0.1, "cauchy": 0.1}
#: What exposures have in common beyond their degree is kept if it makes twice the logarithm of the likelihood larger by
#: so much.
KEPT = 4.0
#: Degrees of freedom below which residuals tell nothing of the plane.
LEFT = 20
#: Fewer exposures tell nothing of how these scatter; sizes are found from no more coefficients than so many.
FEWEST, MOST = 3, 800
#: Sizes are sought within these factors of the typical error of a coefficient.
RANGE = 1e-2, 1e6
_DAMPING = 1e-10, 1e6  # of the diagonal: at first, and where a step is given up
_ROUNDING = 1e-9  # of J
_NOTHING = 1e3  # what is known, in sizes
_SEEN = 5.0  # standard deviations of the squares of departures by their errors
_HELD = 1e-2  # what counts as exact, in errors of a coefficient


@dataclass(frozen=True, eq=False)
class MostProbable:
    """The minimum of J.

    Attributes
    ----------
    state : State
    statics : ndarray, shape (n_statics,)
        S - m in the directions that are not exact, of one detector after the other; then B of one night after the
        other.
    posterior : Posterior
        Of the coefficients and statics there.
    oddness : ndarray, shape (n_exposures + n_nights,)
        Factors s_i >= 1 on the scatter of single exposures, and of nights.
    blocks : Blocks
        Of the data alone.
    known : _Known
    converged : bool
    """

    state: State
    statics: np.ndarray
    posterior: Posterior
    oddness: np.ndarray
    blocks: object
    known: "_Known"
    converged: bool

    def posed(self, problem):
        """A problem with what was found of its coefficients: the scatter of exposures, and about what they scatter."""
        known, n, sizes = self.known, problem.n_modes, self.posterior.sizes
        given, higher = _padded(known.problem.prior_mean, self.state), known.higher[0]
        mean, centre = given.copy(), np.zeros_like(given)
        mean[:, :, higher] = self.state.coefficients[:, :, higher]
        centre[:, :, higher] = (mean - given)[:, :, higher]
        centre[:, :, :n] = np.einsum("ik,ika->ia", known.common(self.statics), known.others).reshape(-1, 2, n)
        by_degree = sizes[np.maximum(np.add(*basis.orders(problem.degree)), 1) - 1]
        widths = np.broadcast_to(self.oddness[: len(mean), None, None] * by_degree, (len(mean), 2, n))
        if problem.prior_sigma is not None:
            given = np.array([problem.has_widths(i) for i in range(problem.n_exposures)])
            widths = np.where(given[:, None, None], problem.prior_sigma, widths)
        return replace(problem, prior_mean=mean, prior_sigma=widths, centre=centre, floats=False)

    def covariances(self):
        """Of the unknowns of all exposures, (n, n); and as if nothing told the size of a static distortion.

        The latter is None where something is stated of all of them.
        """
        n, whole, k = len(self.posterior.data.pull), self.posterior, self.known.static_size
        if k is None:
            return whole.covariance[:n, :n], None
        sizes = np.where(np.arange(len(whole.sizes)) == k, _NOTHING * whole.sizes.max(), whole.sizes)
        return whole.covariance[:n, :n], replace(whole, sizes=sizes).covariance[:n, :n]

    @property
    def higher_covariance(self):
        """Of what exposures have in common beyond the degree, by detector, along x first (k, k); None without."""
        unknowns, covariance = self.blocks.unknowns, self.posterior.covariance
        higher = slice(unknowns.size - unknowns.n_common, unknowns.size)
        return covariance[higher, higher] if unknowns.n_common else None

    @property
    def dof(self):
        """Degrees of freedom: of the data, less the unknowns that these determine beyond what is known of them."""
        data, n = self.posterior.data, len(self.posterior.data.pull)
        return data.n_data - float((self.posterior.covariance[:n, :n] * data.curvature).sum())


def is_possible(problem):
    """Whether the most probable stars, distortions and static distortions can be sought at all."""
    if problem.unknowns.shared or problem.fixed is not None or problem.pose_width is not None:
        return False
    return problem.degree >= 2 and problem.n_exposures >= FEWEST and reduced_system.is_small(problem)


def counts(problem, state, shown=1.0):
    """Whether a bend of the plane by as much as exposures depart from their prior would show in their residuals.

    To first order it does not. In second order it does, by its product with the gradients of the distortions: then a
    plane that a convention holds elsewhere keeps the data from their minimum. It would move stars by more than `shown`
    errors of an exposure of the mean weight: few precise exposures show what many noisy ones do not.
    """
    if not is_possible(problem):
        return False
    if problem.prior_sigma is not None and problem.errors_of_statics.sigma.any():
        return True  # widths draw exposures to the mean of the prior, and not to the static distortion that they show
    n_free = problem.n_star * problem.n_stars + problem.unknowns.size
    n_free -= problem.n_star * problem.n_modes * problem.n_fields  # maps that nothing but what is known determines
    if 2 * np.count_nonzero(problem.weight[0]) - n_free < LEFT:
        return False
    known = _Known.of(problem, problem.degree)
    departures = known.values(state, np.zeros(known.n_statics))[: known.width.size].reshape(problem.n_exposures, -1)
    gradient = 2 * problem.degree / problem.size.mean()
    typical = np.array([_median(problem.weight[0][problem.part(i)]) for i in range(problem.n_exposures)])
    error = np.sqrt(typical.sum() / (typical**2).sum())  # what is worthless counts for nothing
    limit = 4 * shown * error / gradient  # b_m has mean square 1/4
    squares = np.sum(departures**2, axis=1)
    if np.mean(squares) <= limit:
        return False
    # with what they have in common beyond the degree
    whole = replace(problem, prior_mean=_padded(problem.prior_mean, state))
    own = known.others @ conditional_errors(criterion.linearise(whole, state).u_data) @ known.others.mT
    noise, chance = np.einsum("ikk->i", own), np.sqrt(2 * np.einsum("ikl,ikl->i", own, own))
    seen = squares > noise + _SEEN * chance  # an exposure that is worth little departs far for nothing
    return bool(np.sum((squares - noise)[seen]) > limit * np.count_nonzero(seen | (noise < limit)))


def _median(weight):
    """Of the weights of observations that count, 0 without any."""
    return np.median(weight[weight > 0]) if weight.any() else 0.0


def most_probable(problem, state, *, loss="linear", sizes=None, max_steps=MAX_STEPS):
    """The minimum of J from a start.

    Parameters
    ----------
    problem : Problem
        With exposures that share nothing.
    state : State
    loss : {"linear", "huber", "cauchy"}
        Of single observations, as for `legdistort.solving.minimisers.solve_joint`.
    sizes : ndarray, shape (n_sizes,), optional
        Held; found if not given, from exposures drawn at random where these are many.
    max_steps : int

    Returns
    -------
    MostProbable

    Raises
    ------
    SolveError
        If data and what is known do not determine the unknowns.
    """
    if problem.night_sigma is None and 2 * problem.n_nights > problem.n_exposures:
        problem = replace(problem, night_sigma=0.0)  # a night of one exposure is that exposure
    keep = drawn(problem.detectors, MOST // (2 * problem.n_modes))
    if sizes is None and len(keep) < problem.n_exposures:
        sizes = most_probable(*part_of(problem, state, keep), loss=loss, max_steps=max_steps).posterior.sizes
    has_closure = sizes is not None and len(sizes) > _Known.of(problem, problem.degree).n_sizes
    search = _Search(problem, state, loss, sizes, 2 * problem.degree - 1 if has_closure else problem.degree)
    search.descend(max_steps)
    if sizes is None:
        closed = _Search(problem, search.state, loss, None, 2 * problem.degree - 1, near=search)
        if closed.gain > KEPT:
            closed.descend(max_steps)
            search = closed
    return search.found()


class _Search:
    """Where a search is, and what it knows there.

    Parameters
    ----------
    problem : Problem
    state : State
    loss : str
    sizes : ndarray, optional
        Held.
    top : int
        Degree up to which the static distortion is unknown, beyond that of the problem in all exposures alike.
    near : _Search, optional
        Where one of the degree of the problem has ended: where this one begins.
    """

    def __init__(self, problem, state, loss, sizes, top, near=None):
        self.known = _Known.of(problem, top)
        highest = max(top, basis.degree_of(problem.prior_mean.shape[2]))
        mean = basis.change_degree(problem.prior_mean, highest)
        plain = replace(problem, prior_sigma=None, static_covariance=None)
        self.stated = self.problem = replace(plain, degree=top, own_degree=problem.degree, prior_mean=mean)
        self.loss = loss
        self.sizes, self.holds_sizes, self.settled = sizes, sizes is not None, False
        self.size, self.damping = np.inf, _DAMPING[0]
        if near is None:
            state = constraints.absorb_similarities(plain, state)
            blocks = criterion.linearise(plain, state)
            unit = 1 / np.sqrt(np.median(np.einsum("iaa->ia", blocks.u)))
            self.pointing = constraints.pose_rows(plain, state, blocks), _HELD * unit
            self.statics = np.zeros(self.known.n_statics)
            self.oddness = np.ones(problem.n_exposures + self.known.n_nights)
        else:
            self.pointing, self.statics, self.oddness = near.pointing, near.statics, near.oddness
            self.sizes = np.append(near.sizes, near.unit)
        coefficients = basis.change_degree(state.coefficients, highest)
        self._arrive(replace(state, coefficients=coefficients), self.statics)
        self.factor = self.known.factor(*self.pointing)
        self.weigh()
        if near is not None:
            without = Posterior(self.posterior.data, self.posterior.factor, np.append(near.sizes, self.unit * RANGE[0]))
            self.gain = without.cost - self.posterior.cost

    def _arrive(self, state, statics, blocks=None):
        self.state, self.statics = state, statics
        self.blocks = criterion.linearise(self.problem, state) if blocks is None else blocks
        if self.loss != "linear":
            squares = criterion.squares(self.stated, self.blocks.residual)
            self.problem = self.stated.scaled(loss_factors(squares, self.loss))
            self.blocks = criterion.linearise(self.problem, state)

    def descend(self, max_steps):
        """Step until nothing changes any more."""
        for _ in range(max_steps):
            if self.size < TOLERANCE[self.loss] and self.settled:
                break
            self.step()
            log.debug("chi2 %.8g, step %.2g standard errors, sizes %s", self.blocks.chi2, self.size, self.sizes)

    def found(self):
        """Where it has ended."""
        return MostProbable(
            state=self.state,
            statics=self.statics,
            posterior=self.posterior,
            oddness=self.oddness,
            blocks=self.blocks,
            known=self.known,
            converged=self.size < TOLERANCE[self.loss],
        )

    def weigh(self):
        """The posterior where the search is, and the sizes and oddness that follow from it."""
        before, data = self.sizes, without_stars(self.problem, self.blocks)
        factor = self.known.at(self.factor, self.state, self.statics, self.oddness)
        self.unit = 1 / np.sqrt(np.median(np.diag(data.curvature)))
        if self.holds_sizes:
            self.posterior = Posterior(data, factor, self.sizes)
        else:
            start = before
            if before is None:  # few nights that hardly differ may seem to differ by as much as the static distortion
                start = np.full((2, self.known.n_sizes), 100 * self.unit)
                start[1, : self.known.n_scatters] = self.unit
            self.posterior = most_likely(data, factor, start, self.unit * np.array(RANGE))
            self.sizes = self.posterior.sizes
        odd = self.known.oddness(self.posterior)
        if before is not None:
            changes = np.abs(np.log(np.concatenate([self.sizes / before, odd / self.oddness])))
            self.settled = bool(np.all(changes < SETTLED))
        self.oddness = odd

    @property
    def cost(self):
        """J here."""
        return self.blocks.cost + self.known.penalty(self.posterior, self.state, self.statics)

    def step(self):
        """Take a step that makes J smaller, and weigh anew; its size in standard errors, rms over the coefficients."""
        before = self.cost
        while True:
            z = self.posterior.damped(self.damping)
            self.size = np.sqrt(max(float(z @ self.posterior.slope), 0) / len(z))
            arrived = self._after(z)
            after = arrived[2].cost + self.known.penalty(self.posterior, *arrived[:2])
            if after <= before + _ROUNDING * abs(before) or self.size < TOLERANCE[self.loss]:
                break
            self.damping *= 100
            if self.damping > _DAMPING[1]:
                raise SolveError("no step, however short, makes the criterion smaller")
        self.damping = max(self.damping / 30, _DAMPING[0])
        self._arrive(*arrived)
        self.weigh()

    def _after(self, z):
        """State, statics and blocks after a step."""
        n, n_modes = self.problem.unknowns.size, self.problem.n_modes
        pulled = elimination.to_stars(self.problem, self.blocks, self.blocks.unknowns.spread(z[:n]))
        inverse = elimination.inverse_star_blocks(self.blocks.v)
        moved = elimination.symmetric_times(inverse, self.blocks.g_star - pulled)
        coefficients = self.state.coefficients.copy()  # poses, which follow, carry the rest along
        coefficients[:, :, :n_modes] += self.problem.unknowns.spread(z[:n]).reshape(len(coefficients), 2, -1)
        state = State(self.state.stars + moved, coefficients, self.state.poses)
        with np.errstate(all="ignore"):  # a step may be far too long
            state = constraints.absorb_similarities(self.problem, state)
            return state, self.statics + z[n:], criterion.linearise(self.problem, state)


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of the coefficients of exposures: how far they scatter, and about what.

    Attributes
    ----------
    problem : Problem
    top : int
        Degree of the static distortion.
    others : ndarray, shape (n_exposures, K, 2 n_modes)
    group : ndarray of int, shape (n_exposures,)
    width : ndarray, shape (n_exposures, K)
        Given scatter; NaN where it is found.
    of_statics : sparse array, shape (n_groups * K, n_statics - n_nights * K)
        S - m of every detector from what is not exact of it.
    static_width : ndarray, shape (n_statics,)
        Given; infinite where its size is found, NaN that of a night if it is.
    degrees : ndarray of int, shape (K,)
    """

    problem: object
    top: int
    others: np.ndarray
    group: np.ndarray
    width: np.ndarray
    of_statics: sparse.csr_array
    static_width: np.ndarray
    degrees: np.ndarray

    @classmethod
    def of(cls, problem, top):
        """That of a problem."""
        others = np.stack([dynamic_basis(shape, problem.n_modes) for shape in problem.shapes])
        _, spread, group, _ = stated(problem)
        width = np.full(others.shape[:2], np.nan)
        for i in range(problem.n_exposures):
            if problem.has_widths(i):
                width[i] = np.sqrt(row_variances(others[i], problem.prior_sigma[i].ravel()))
        free = spread.variance > 0
        parts = [columns[:, of] for columns, of in zip(spread.directions, free, strict=True)]
        sigma = np.nan if problem.night_sigma is None else problem.night_sigma
        static = np.append(np.sqrt(spread.variance[free]), np.full(problem.n_nights * others.shape[1], sigma))
        of_statics = sparse.block_diag(parts, format="csr")
        return cls(problem, top, others, group, width, of_statics, static, dynamic_degrees(problem.n_modes))

    @property
    def n_statics(self):
        """Number of directions of statics that are not exact, and of what nights have in common."""
        return len(self.static_width)

    @property
    def n_nights(self):
        """Number of nights that have something in common."""
        return self.problem.n_nights

    def common(self, statics):
        """S - m + B of every exposure, (n_exposures, K)."""
        own = self.of_statics @ statics[: self.of_statics.shape[1]]
        out = own.reshape(-1, len(self.degrees))[self.group]
        if self.n_nights:
            out = out + statics[-self.n_nights * len(self.degrees) :].reshape(self.n_nights, -1)[self.problem.nights]
        return out

    @cached_property
    def higher(self):
        """Modes beyond the degree of the problem, and an exposure of every detector."""
        detector = np.broadcast_to(self.problem.group, self.problem.n_exposures)
        return slice(self.problem.n_modes, basis.n_modes(self.top)), np.unique(detector, return_index=True)[1]

    @property
    def n_higher(self):
        """Number of unknowns beyond that degree."""
        modes, detectors = self.higher
        return 2 * (modes.stop - modes.start) * len(detectors)

    @property
    def static_size(self):
        """Number of the size of statics of which nothing is known; None without them."""
        return self.n_scatters if np.isinf(self.static_width).any() else None

    @property
    def n_scatters(self):
        """Number of sizes that are scatters, by degree, of exposures and then of nights."""
        return int(self.degrees.max()) * (1 + bool(self.n_nights and self._first_of_nights))

    @cached_property
    def _first_of_nights(self):
        """Number of the first size of nights: none of theirs where maps that change with time can take their place.

        Then they scatter as exposures do; nothing tells.
        """
        rates = (np.count_nonzero(~np.any(self.problem.terms.precision, axis=1)) + 1) // 2 * self.problem.n_fields
        told = self.n_nights > self.group.max() + 1 + rates
        return int(self.degrees.max()) if told and self.problem.night_sigma is None else 0

    @property
    def n_sizes(self):
        """Number of sizes that are found: scatters, that of a static distortion, and of what is beyond the degree."""
        return self.n_scatters + (self.static_size is not None) + (self.n_higher > 0)

    def values(self, state, statics):
        """Departures A_i - S - B at a state, what is beyond their degree, S, and B: one vector."""
        departure = (state.coefficients - _padded(self.problem.prior_mean, state))[:, :, : basis.n_modes(self.top)]
        modes, detectors = self.higher
        own = departure[:, :, : modes.start].reshape(len(departure), -1)
        own = np.einsum("ika,ia->ik", self.others, own) - self.common(statics)
        return np.concatenate([own.ravel(), departure[detectors, :, modes].ravel(), statics])

    def factor(self, pointing, width):
        """All that is known, as one factor on the unknowns and then the statics; its values are those of `at`.

        `pointing` (4 n_fields, n_exposures, 2 n_modes) are rows on the coefficients that are held, as good as exactly,
        by a width: the data say nothing of them.
        """
        n, k, m = self.others.shape
        similar = np.stack([similarity_basis(shape, m // 2) for shape in self.problem.shapes])
        own = sparse.kron(sparse.eye_array(n), sparse.eye_array(k, m, k=m - k))
        static = -self.of_statics[(self.group[:, None] * k + np.arange(k)).ravel()]
        static.resize(n * k, self.n_statics)
        if self.n_nights:
            first = self.n_statics - self.n_nights * k
            theirs = (first + k * self.problem.nights[:, None] + np.arange(k)).ravel()
            static = static + sparse.csr_array((-np.ones(n * k), (range(n * k), theirs)), static.shape)
        held = np.zeros((len(pointing), n, m))
        held[:, :, : m - k] = np.einsum("cia,isa->cis", pointing, similar)
        parts = [
            [own, None, static],
            [None, sparse.eye_array(self.n_higher), None],
            [None, None, sparse.eye_array(self.n_statics)],
            [held.reshape(len(held), -1), None, None],
        ]
        counts = [n * k, self.n_higher, self.n_statics, len(held)]
        found = np.concatenate(
            [np.isnan(self.width).ravel(), np.ones(self.n_higher, bool), ~np.isfinite(self.static_width)]
        )
        found = np.append(found, np.zeros(len(held), bool))
        size = [np.tile(self.degrees - 1, n)]
        size += [np.full(c, k) for c, k in zip(counts[1:], (self.n_sizes - 1, self.n_scatters, 0), strict=True)]
        if self.n_nights:
            size[2][-self.n_nights * k :] = np.tile(self.degrees - 1 + self._first_of_nights, self.n_nights)
        width = [self.width.ravel(), np.ones(self.n_higher), self.static_width, np.full(len(held), width)]
        size = np.where(found, np.concatenate(size), GIVEN)
        rows = sparse.block_array(parts, format="csr")
        return Factor("departures, statics and pointing", rows, np.zeros(len(size)), np.concatenate(width), size)

    def at(self, factor, state, statics, oddness):
        """The factor where the coefficients and statics are."""
        value, stretch = self.values(state, statics), np.ones(len(factor.value))
        (n, k), end = self.width.shape, len(value)
        stretch[: n * k] = np.repeat(oddness[:n], k)
        stretch[end - self.n_nights * k : end] = np.repeat(oddness[n:], k)
        return replace(factor, value=np.pad(value, (0, len(factor.value) - end)), stretch=stretch)

    def penalty(self, posterior, state, statics):
        """What is known as part of J, at the sizes of a posterior."""
        value = self.values(state, statics)
        return float(((value / posterior.widths[: len(value)]) ** 2).sum())

    def oddness(self, posterior):
        """Factors (n_exposures + n_nights,) on the scatter of exposures and nights, as for Student's t distribution."""
        n, k, _ = self.others.shape
        end = n * k + self.n_higher + self.n_statics
        rows = np.concatenate([np.arange(n * k), np.arange(end - self.n_nights * k, end)])
        width = posterior.widths / posterior.factor.stretch
        value, variance, width = (each[rows].reshape(-1, k) for each in (*posterior.left, width))
        finite = np.isfinite(width)
        square = np.where(finite, (value**2 + variance) / width**2, 0).sum(axis=1)
        count = finite.sum(axis=1)
        return np.sqrt(np.maximum(1, (TAILS + square) / (TAILS + count + CHANCE * np.sqrt(2 * count))))


def _padded(mean, state):
    """A mean of a prior with as many modes as a state has."""
    return basis.change_degree(mean, basis.degree_of(state.coefficients.shape[2]))
