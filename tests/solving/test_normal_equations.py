"""Normal equations and reduced system against dense matrices from a numerical Jacobian: no step of theirs in common."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import oracle
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import null_space

from legdistort import Matches, solve
from legdistort.exceptions import AssumptionWarning, SolveError
from legdistort.geometry.detector_modes import similarity_basis
from legdistort.priors.prior import Prior
from legdistort.results.errors.coefficient_covariance import (
    Coupled,
    exposure_block,
    exposure_blocks,
    mean_covariance,
    times,
    with_shared,
)
from legdistort.simulation.observations import simulate_matches
from legdistort.solving import start_values
from legdistort.solving.equations import covariances, criterion, elimination, reduced_system
from legdistort.solving.equations.covariances import Uncertainty
from legdistort.solving.equations.problem import State, build_problem
from legdistort.solving.equations.reduced_system import Direct, Iterative
from legdistort.solving.equations.star_system import OnStars
from legdistort.solving.equations.star_terms import StarTerms, symmetric_times, unpacked
from legdistort.solving.gauge import constraints

N, M, DEGREE, K = 6, 16, 2, 6  # exposures, stars, degree, modes
RNG = np.random.default_rng(5)
YEARS = np.linspace(2010, 2015, N)


def make(*, widths=False, moving=False, shared=False):
    """A problem with unequal, correlated errors, away from its minimum."""
    rng = np.random.default_rng(5)
    sim = simulate_matches(
        n_stars=M, n_exposures=N, degree=DEGREE, sigma=rng.uniform(0.05, 0.2, (N, M, 2)), corr=0.4, shape=(300, 500),
        dither=120.0, rotations=rng.uniform(-40, 40, N), seen=1.0 if shared else 0.9, static=0.5, dynamic=0.2, seed=3,
    )  # fmt: skip
    prior = Prior(np.pad(sim.truth.static, ((0, 0), (0, 4))))  # its highest modes stay as they are
    if widths:
        sigma = rng.uniform(0.1, 0.4, (2, 10))
        sigma[:, 4] = 0.0
        prior = replace(prior, sigma=sigma)

    def motion(matches, weight):
        terms = StarTerms.of_motion("proper", YEARS, 2012.2, sigma=0.05)
        return replace(terms, mean=rng.normal(0, 0.03, (2, M)))

    own = {"own_degree": 1} if shared else {}
    problem = build_problem(sim.matches, DEGREE, prior=prior, motion=motion if moving else None, **own)
    state, _ = start_values.start(problem, np.stack([sim.matches.poses[name] for name in sim.matches.names]))
    stars = state.stars.copy()
    stars[2:] += rng.normal(0, 0.04, stars[2:].shape)
    coefficients = state.coefficients.copy()
    coefficients[:, :, :K] += rng.normal(0, 0.1, (2, K) if shared else (N, 2, K))
    return problem, State(stars, coefficients, state.poses)


def residuals(problem, state, x):
    """Residuals (n, 2) at changes (stars first, then coefficients of the exposures) from a state, by the formula."""
    n_star = problem.n_star
    stars = state.stars + x[: n_star * M].reshape(n_star, M)
    change = x[n_star * M :].reshape(N, 2, K)
    out = []
    for i in range(N):
        on = problem.part(i)
        at = stars[:2] + (np.zeros((2, M)) if n_star == 2 else (YEARS[i] - 2012.2) * stars[2:])
        coefficients = state.coefficients[i].copy()
        coefficients[:, :K] += change[i]
        found = oracle.predict(at[:, problem.star[on]].T, coefficients, state.poses[i], problem.shapes[i])
        out.append(problem.xy[:, on].T - found)
    return np.concatenate(out)


def dense(problem, state):
    """Residuals, weights (n, 2, 2) and the derivatives (n, 2, all unknowns) of what is predicted."""
    size = problem.n_star * M + N * 2 * K
    steps = 1e-3 * np.eye(size)
    jacobian = np.stack([residuals(problem, state, -e) - residuals(problem, state, e) for e in steps], axis=-1) / 2e-3
    w = problem.weight
    weight = np.moveaxis(np.array([[w[0], w[2]], [w[2], w[1]]]), -1, 0)
    return residuals(problem, state, np.zeros(size)), weight, jacobian


def split(matrix, n_star):
    """Star part (n_star M), ordered by unknown then star, and the rest."""
    return matrix[: n_star * M], matrix[n_star * M :]


SETTINGS = [{}, {"widths": True}, {"moving": True}]


@pytest.fixture(params=SETTINGS, ids=lambda settings: ", ".join(settings) or "plain")
def case(request):
    problem, state = make(**request.param)
    return problem, state, criterion.linearise(problem, state), dense(problem, state)


def test_sums_over_the_observations(case):
    problem, state, blocks, (r, weight, jacobian) = case
    normal = np.einsum("nap,nab,nbq->pq", jacobian, weight, jacobian)
    gradient = np.einsum("nap,nab,nb->p", jacobian, weight, r)
    assert blocks.chi2 == pytest.approx(np.einsum("na,nab,nb->", r, weight, r), rel=1e-9)
    assert_allclose(blocks.residual.T, r, atol=1e-9)
    n = problem.n_star
    stars, rest = normal[: n * M, : n * M].reshape(n, M, n, M), normal[n * M :, n * M :].reshape(N, 2 * K, N, 2 * K)
    held = np.zeros((M, n, n))
    if n > 2:
        held[:, [2, 3], [2, 3]] = 1 / 0.05**2
    assert_allclose(unpacked(blocks.v), np.einsum("ajbj->jab", stars) + held, rtol=1e-6, atol=1e-6 * normal.max())
    assert_allclose(blocks.u_data, np.einsum("iaib->iab", rest), rtol=1e-6, atol=1e-6 * rest.max())
    departure = state.stars[2:] - problem.terms.mean
    mine = gradient[: n * M].reshape(n, M)
    mine[2:] -= departure / 0.05**2
    assert_allclose(blocks.g_star, mine, rtol=1e-6, atol=1e-6 * np.abs(mine).max())
    assert blocks.held == pytest.approx((departure**2).sum() / 0.05**2, abs=1e-12)
    assert blocks.cost == pytest.approx(blocks.chi2 + blocks.penalty + blocks.held, rel=1e-14)
    if not problem.has_prior:
        assert blocks.penalty == 0
        assert_allclose(blocks.g_exposure.ravel(), gradient[n * M :], rtol=1e-6, atol=1e-6 * np.abs(gradient).max())


def test_what_a_prior_adds():
    """``d' C^-1 d`` on the directions that are neither similarities nor fixed; nothing moves those that are fixed."""
    problem, state = make(widths=True)
    r, weight, jacobian = dense(problem, state)
    gradient = np.einsum("nap,nab,nb->p", jacobian, weight, r)[2 * M :].reshape(N, 2 * K)
    blocks, penalty = criterion.linearise(problem, state), 0.0
    for i in range(N):
        sigma = problem.prior_sigma[i].ravel()
        similar = similarity_basis(problem.shapes[i], K)
        held = np.eye(2 * K)[sigma == 0]
        free = null_space(np.concatenate([similar, held])).T
        precision = free.T @ np.linalg.inv(free * sigma**2 @ free.T) @ free
        departure = (state.coefficients[i] - problem.prior_mean[i])[:, :K].ravel()
        penalty += departure @ precision @ departure
        assert_allclose(criterion.prior_precision(problem, i), precision, atol=1e-9 * precision.max())
        mine = gradient[i] - precision @ departure
        mine -= held.T @ held @ mine
        assert_allclose(blocks.g_exposure[i], mine, atol=2e-6 * np.abs(gradient).max())
        added = blocks.u[i] - blocks.u_data[i] - precision
        assert np.linalg.matrix_rank(added, tol=1e-6 * np.abs(added).max()) == len(held)
        assert_allclose(held.T @ held @ added, added, atol=1e-6 * np.abs(added).max())
        assert np.trace(added) > 1e3 * np.trace(blocks.u_data[i])
    assert blocks.penalty == pytest.approx(penalty, rel=1e-9)


def test_elimination_of_stars(case):
    problem, _, blocks, (_, weight, jacobian) = case
    n = problem.n_star
    normal = np.einsum("nap,nab,nbq->pq", jacobian, weight, jacobian)
    coupling = normal[: n * M, n * M :]
    a, y = RNG.normal(size=(N, 2 * K)), RNG.normal(size=(n, M))
    scale = np.abs(coupling).max()
    assert_allclose(elimination.to_stars(problem, blocks, a).ravel(), coupling @ a.ravel(), atol=1e-5 * scale)
    assert_allclose(elimination.to_exposures(problem, blocks, y).ravel(), y.ravel() @ coupling, atol=1e-5 * scale)
    inverse = unpacked(elimination.inverse_star_blocks(blocks.v))
    assert_allclose(inverse @ unpacked(blocks.v), np.broadcast_to(np.eye(n), (M, n, n)), atol=1e-9)
    roots = np.moveaxis(elimination.star_roots(blocks.v), -1, 0)
    assert_allclose(roots @ roots.mT, inverse, rtol=1e-9, atol=1e-12 * np.abs(inverse).max())
    between = np.zeros((n * M, n * M))
    for j, block in enumerate(inverse):
        between[np.ix_(np.arange(n) * M + j, np.arange(n) * M + j)] = block
    moved = coupling.T @ between @ coupling
    for size in (512, 5):  # stars at a time
        factors = list(elimination.star_factors(problem, blocks, n_block=size))
        assert sum(factor.shape[1] for factor in factors) == n * M
        found = sum(factor @ factor.T for factor in factors)
        assert_allclose(found, moved, rtol=1e-5, atol=1e-6 * np.abs(moved).max())
    reduced = elimination.reduced_matrix(problem, blocks)
    whole = np.zeros_like(reduced)
    for i, block in enumerate(blocks.u):
        whole[i * 2 * K : (i + 1) * 2 * K, i * 2 * K : (i + 1) * 2 * K] = block
    assert_allclose(reduced, whole - moved, rtol=1e-5, atol=1e-6 * np.abs(moved).max())
    freedom = elimination.star_freedom(problem, blocks)
    told = np.einsum("jaa->", inverse[:, 2:, 2:]) / 0.05**2 if n > 2 else 0.0
    assert freedom == pytest.approx(n * M - told)


class Bordered:
    """The reduced system with its constraints as one dense matrix."""

    def __init__(self, problem, blocks, rows):
        self.problem, self.blocks, self.rows = problem, blocks, rows
        s = elimination.reduced_matrix(problem, blocks)
        n = len(s)
        zero = np.zeros((len(rows), len(rows)))
        self.inverse, self.n = np.linalg.inv(np.block([[s, rows.T], [rows, zero]])), n
        self.s = s

    def solve(self, rhs, target):
        return (self.inverse @ np.concatenate([rhs, target]))[: self.n]

    def rhs(self, own, stars):
        inverse = elimination.inverse_star_blocks(self.blocks.v)
        moved = elimination.to_exposures(self.problem, self.blocks, symmetric_times(inverse, stars))
        return self.problem.unknowns.gather(own - moved)

    def stars(self, stars, d):
        inverse = elimination.inverse_star_blocks(self.blocks.v)
        spread = self.blocks.unknowns.spread(d)
        return symmetric_times(inverse, stars - elimination.to_stars(self.problem, self.blocks, spread))


def close(found, expected, tolerance=1e-6):
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("way", [Direct, Iterative, OnStars])
def test_reduced_system_under_constraints(case, way):
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    system, bordered = way(problem, blocks, gauge), Bordered(problem, blocks, gauge.orthonormal)
    target = RNG.normal(0, 0.01, len(gauge.orthonormal))
    rhs = bordered.rhs(blocks.g_exposure, blocks.g_star)
    close(system.rhs, rhs)
    d = bordered.solve(rhs, target)
    stars, coefficients = system.step(target, 1e-9)
    close(coefficients.ravel(), d)
    close(stars, bordered.stars(blocks.g_star, d))
    d = RNG.normal(size=bordered.n)
    close(system.follow(d), bordered.stars(np.zeros_like(blocks.g_star), d))
    own, pulls = RNG.normal(size=blocks.g_exposure.shape), RNG.normal(size=blocks.g_star.shape)
    d = bordered.solve(bordered.rhs(own, pulls), np.zeros(len(target)))
    stars, coefficients = system.settle(own, pulls)
    close(coefficients.ravel(), d, 1e-4)
    close(stars, bordered.stars(pulls, d), 1e-4)
    n_free = elimination.star_freedom(problem, blocks) + N * 2 * K - len(gauge.orthonormal)
    assert system.dof == pytest.approx(2 * problem.xy.shape[1] - n_free)
    nothing = np.zeros(bordered.n)
    moves = np.stack([bordered.solve(nothing, unit) for unit in np.eye(len(target))])
    close(system.moves, moves, 1e-3)
    curvature = moves @ bordered.s @ moves.T
    close(system.information, curvature, 1e-3)
    close(system.pull, moves @ rhs, 0.05 if way is Iterative else 1e-6)
    if way is Iterative:
        return
    gradients = RNG.normal(size=(N, 2 * K, 3))
    covariance = bordered.inverse[: bordered.n, : bordered.n]
    close(system.respond(gradients), (covariance @ gradients.reshape(-1, 3)).reshape(gradients.shape))
    if way is Direct:
        close(system.covariance(), covariance)
    else:
        close(system.covariance_blocks(), exposure_blocks(covariance, N))


def test_errors_are_the_same_whichever_side_is_eliminated(case, monkeypatch):
    """Exact without the covariance between exposures; as blocks with the stars taken as known, and it is measured."""
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    dense = Uncertainty(problem, blocks, gauge, scale=1.5)
    monkeypatch.setattr(covariances, "DENSE_LIMIT", 10)
    monkeypatch.setattr(reduced_system, "DIRECT_LIMIT", 10)  # which would serve as well
    small = Uncertainty(problem, blocks, gauge, scale=1.5)
    assert small.coefficients.shape == (N, 2 * K, 2 * K)
    close(small.coefficients, exposure_blocks(dense.coefficients, N))
    close(small.star_unknowns, dense.star_unknowns)
    close(small.star_matrix, dense.star_matrix)
    for made in (Uncertainty(problem, blocks, gauge, scale=1.5), dense):  # coefficients made, and not yet
        close(np.stack([made.of_exposure(i, N) for i in range(N)]), small.coefficients)
    monkeypatch.setattr(reduced_system, "STAR_LIMIT", 10)
    rough = Uncertainty(problem, blocks, gauge, scale=1.5)
    with pytest.warns(AssumptionWarning, match=r"errors of 16 stars solved exactly are ([0-9.]+) times") as caught:
        variance = rough.star_unknowns
    told = float(re.search(r"are ([0-9.]+) times", str(caught[0].message))[1])
    ratio = np.sqrt(dense.star_unknowns[:2] / variance[:2])[np.arange(M) % 2, np.arange(M)]
    assert told == pytest.approx(np.median(ratio), rel=1e-3)
    assert told > 1.02


@pytest.mark.parametrize("in_blocks", [False, True])
def test_errors_of_one_star_that_some_exposures_have_not_seen(case, in_blocks):
    """They are those of all stars together."""
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    seen = np.zeros((N, M), bool)
    seen[problem.exposure, problem.star] = True
    [star] = np.flatnonzero(~seen.all(axis=0))[:1]
    coefficients = Uncertainty(problem, blocks, gauge).coefficients
    coefficients = exposure_blocks(coefficients, N) if in_blocks else coefficients
    found = Uncertainty(problem, blocks, gauge, coefficients=coefficients)
    both = [star, star + M]
    close(found.covariance_between(np.array([star]), 2), found.star_matrix[np.ix_(both, both)])


def test_many_exposures_are_coupled_through_the_stars(case, monkeypatch):
    """The covariance of all coefficients without an array as large: as exact as that array."""
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    dense = Uncertainty(problem, blocks, gauge, scale=1.5)
    whole, of_stars, unknowns = dense.coefficients, dense.star_matrix, dense.star_unknowns
    for name, value in (("DENSE_LIMIT", 10), ("COUPLED_FROM", 10)):
        monkeypatch.setattr(covariances, name, value)
    monkeypatch.setattr(reduced_system, "DIRECT_LIMIT", 10)  # which would serve as well
    found = Uncertainty(problem, blocks, gauge, scale=1.5)
    assert isinstance(found.coefficients, Coupled)
    responses = np.random.default_rng(3).normal(size=(N, 2 * K, 4))
    coupled = found.coefficients
    for _ in range(2):
        close(exposure_blocks(coupled, N), exposure_blocks(whole, N))
        close(np.stack([exposure_block(coupled, N, i) for i in range(N)]), exposure_blocks(whole, N))
        close(times(coupled, np.eye(2 * N * K)), whole)
        close(mean_covariance(coupled, N), mean_covariance(whole, N))
        whole, coupled = (with_shared(each, responses) for each in (whole, coupled))
    again = Uncertainty(problem, blocks, gauge, scale=1.5, coefficients=found.coefficients)
    close(again.star_unknowns, unknowns)
    close(again.star_matrix, of_stars)


def test_star_errors_need_no_covariance_of_the_coefficients(case):
    """What they take up of the factorised matrix is what they take up of its inverse."""
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    quick = Uncertainty(problem, blocks, gauge, scale=1.5)
    whole = Uncertainty(problem, blocks, gauge, scale=1.5, coefficients=quick.coefficients)
    assert_allclose(quick.star_unknowns, whole.star_unknowns, rtol=1e-9)


def test_many_exposures_of_few_stars_are_solved_on_the_stars(monkeypatch):
    """The same solution and errors; not where an exposure has hardly more stars than modes: digits would be lost."""
    sim = simulate_matches(n_exposures=40, n_stars=25, seen=0.9, sigma=0.05, dither=100.0, seed=4)
    stars_of_first = sim.matches.table["exposure"] == sim.matches.names[0]
    few = sim.matches.table[~stars_of_first | (np.cumsum(stars_of_first) <= 11)]
    few = Matches.from_table(few, shape=sim.matches.shapes, poses=sim.matches.poses)
    for matches, made in ((sim.matches, OnStars), (few, Direct)):
        found = solve(matches, prior=Prior(sim.truth.static), clip=None)
        assert isinstance(found.estimate.uncertainty.system, made)
        with monkeypatch.context() as patch:
            patch.setattr(reduced_system, "STARS_FROM", np.inf)
            other = solve(matches, prior=Prior(sim.truth.static), clip=None)
            assert isinstance(other.estimate.uncertainty.system, Direct)
            errors = np.sqrt(other.estimate.uncertainty.stars[:2].T)
        assert np.abs((found.estimate.positions - other.estimate.positions) / errors).max() < 1e-3
        assert_allclose(np.sqrt(found.estimate.uncertainty.stars[:2].T), errors, rtol=1e-5)


def test_exposures_to_blame_are_named_where_steps_are_iterated(case, monkeypatch):
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    monkeypatch.setattr(reduced_system, "uses_direct", lambda problem: False)
    assert isinstance(reduced_system.reduced_system(problem, blocks, gauge), Iterative)
    flat = replace(blocks, u=np.where(np.arange(N)[:, None, None] == 2, 1.0, blocks.u))
    with pytest.raises(SolveError, match="do not determine the distortion"):
        reduced_system.reduced_system(problem, flat, gauge)


def test_steps_that_take_too_many_iterations_are_factorised(case, monkeypatch):
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    target = np.zeros(gauge.n_constraints)
    exact = Direct(problem, blocks, gauge).step(target, 0.0)
    monkeypatch.setattr(reduced_system, "_FAST_STEPS", 2)
    for mine, expected in zip(Iterative(problem, blocks, gauge).step(target, 1e-3), exact, strict=True):
        assert_allclose(mine, expected, rtol=1e-9, atol=1e-12)


def test_singular_stars_are_left_to_the_other_ways(case):
    """An exposure that its stars do not determine cannot be eliminated."""
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    flat = replace(blocks, u=np.where(np.arange(N)[:, None, None] == 2, 1.0, blocks.u))
    with pytest.raises(np.linalg.LinAlgError):
        OnStars(problem, flat, gauge)


def test_conjugate_gradients_stop_where_they_are_told():
    """An accuracy that is not asked for costs steps."""
    problem, state = make()
    blocks = criterion.linearise(problem, state)
    gauge = constraints.make("minimal", problem, state, blocks)
    system, counts = Iterative(problem, blocks, gauge), []
    target = np.zeros(len(gauge.orthonormal))
    exact = Direct(problem, blocks, gauge).step(target, 0.0)[1]
    for accuracy in (0.1, 1e-3, 1e-6):
        system._couple = count = Counted(Iterative(problem, blocks, gauge)._couple)
        found = system.step(target, accuracy)[1]
        counts.append(count.n)
        assert np.abs(found - exact).max() < 30 * accuracy * np.abs(exact).max()
    assert counts[0] < counts[1] < counts[2] <= 2 * problem.unknowns.size


@pytest.mark.parametrize("off", [0.0, 0.01])
def test_conjugate_gradients_work_out_no_more_than_is_enough(case, off):
    """The exact step but for so many standard errors, under the constraints; nothing where all of it is less.

    How much larger steps are than their gradients tell is known from the iterations before: there is one at least.
    """
    problem, state, blocks, _ = case
    gauge = constraints.make("minimal", problem, state, blocks)
    target = np.full(gauge.n_constraints, off)
    exact = Direct(problem, blocks, gauge).step(target, 0.0)[1]
    n, counts = blocks.g_star.size + blocks.g_exposure.size, []
    for enough in (0.0, 1e-3, 0.02, 1e4):
        system = Iterative(problem, blocks, gauge)
        system._couple = count = Counted(system._couple)
        d = (found := system.step(target, 1e-9, enough)[1]) - exact
        counts.append(count.n - (off != 0))  # one for what the constraints lack
        assert np.sqrt(np.einsum("ia,iab,ib->", d, blocks.u, d) / n) < max(enough, 1e-6)
        assert_allclose(gauge.orthonormal @ found.ravel(), target, atol=1e-9)
    assert counts[0] > counts[1] > counts[2] > counts[3] == 1
    count.n = 0
    system.step(target, 1e-9, enough)
    assert count.n == (off != 0)


def test_weak_directions_that_were_met_take_no_iterations_again():
    """At a state nearby, with other weights: the same step as from nothing."""
    problem, state = make()
    blocks = criterion.linearise(problem, state)
    gauge = constraints.make("minimal", problem, state, blocks)
    target = np.zeros(gauge.n_constraints)
    system = Iterative(problem, blocks, gauge)
    system.step(target, 1e-9, 1e-6)
    other = problem.scaled(1 + 0.05 * np.sin(np.arange(problem.xy.shape[1])))
    blocks = criterion.linearise(other, replace(state, stars=state.stars + 0.01))
    exact, counts = Direct(other, blocks, gauge).step(target, 0.0)[1], []
    for way in (Iterative(other, blocks, gauge), system.moved(other, blocks, gauge)):
        way._couple = count = Counted(way._couple)
        assert_allclose(way.step(target, 1e-9, 1e-6)[1], exact, atol=1e-5 * np.abs(exact).max())
        counts.append(count.n)
    assert counts[1] < 0.7 * counts[0]


class Counted:
    """A function that counts its calls."""

    def __init__(self, function):
        self.function, self.n = function, 0

    def __call__(self, *arguments):
        self.n += 1
        return self.function(*arguments)


def test_what_exposures_share_is_held_where_they_do_not_tell_it():
    """The rows found, given again, hold the same directions: the answer stays, and none of them moves."""
    problem, state = make(shared=True)
    problem = replace(problem, weak=0.002)
    blocks = criterion.linearise(problem, state)
    gauge = constraints.make("minimal", problem, state, blocks)
    found = Direct(problem, blocks, gauge)
    assert 0 < found.n_weak < problem.unknowns.n_common
    weak = found.rows[-found.n_weak :]
    again = Direct(problem, blocks, gauge, weak)
    target = RNG.normal(0, 0.01, gauge.n_constraints)
    rhs = RNG.normal(size=found.unknowns.size)
    d = found.solve(rhs, target)
    close(again.solve(rhs, target), d)
    close(weak @ d + 1.0, np.ones(len(weak)), 1e-8)
    own = found._on_unknowns(gauge)
    bordered = Bordered(problem, blocks, np.concatenate([own, weak]))
    close(d, bordered.solve(rhs, np.concatenate([target, np.zeros(len(weak))])))
    moves = np.stack([bordered.solve(0 * rhs, unit) for unit in np.eye(len(bordered.rows))])[: len(own)]
    close(found.information, moves @ bordered.s @ moves.T, 2e-3)


def test_the_exposures_to_blame_are_named_the_worst_first():
    """Four of six exposures have a part in what is not determined, one of them less than a tenth."""
    parts = np.sqrt([0.0, 0.15, 0.5, 0.05, 0.0, 0.3])
    direction = np.outer(parts, np.ones(4) / 2).ravel()
    problem = SimpleNamespace(
        names=tuple("abcdef"), degree=2, unknowns=SimpleNamespace(spread=lambda vector: vector.reshape(6, 4))
    )
    s, alike = np.eye(24) - np.outer(direction, direction), np.broadcast_to(np.eye(4), (6, 4, 4))
    error = reduced_system._not_determined(problem, s, alike)
    assert "above all in exposure c, f, b: leave out an exposure that hardly overlaps" in str(error)
    assert error.exposures == ("c", "f", "b")
    poor = np.where((np.arange(6) == 0)[:, None, None], np.ones((4, 4)) + 1e-5 * np.eye(4), alike)
    error = reduced_system._not_determined(problem, s, poor)
    assert "above all in exposure a: " in str(error)
    assert error.exposures == ("a",)
    shared = np.outer(np.full(6, 6**-0.5), np.ones(4) / 2).ravel()
    assert reduced_system._not_determined(problem, np.eye(24) - np.outer(shared, shared), alike).exposures == ()


@pytest.mark.parametrize("case", ["alike", "other weight in y", "correlated"])
def test_inverses_of_exposure_blocks(case):
    root = RNG.normal(size=(3, 5, 9))
    u = np.zeros((3, 10, 10))
    u[:, :5, :5] = u[:, 5:, 5:] = root @ root.mT
    u[:, 5:, 5:] *= 2.0 if case == "other weight in y" else 1.0
    if case == "correlated":
        u[:, :5, 5:] = u[:, 5:, :5] = 0.3 * u[:, :5, :5]
    found = elimination.inverse_exposure_blocks(u)
    assert_allclose(found @ u, np.broadcast_to(np.eye(10), u.shape), atol=1e-9)


@pytest.mark.parametrize("corr", [0.0, 0.4])
@pytest.mark.parametrize("floor", [0.0, 0.03])
@pytest.mark.parametrize("shuffled", [True, False])
def test_weights_are_the_inverse_covariances_of_the_rows(corr, floor, shuffled):
    rng = np.random.default_rng(5)
    sim = simulate_matches(n_stars=M, n_exposures=N, sigma=rng.uniform(0.05, 0.2, (N, M, 2)), corr=corr, seed=3)
    table = sim.matches.table
    table = table[rng.permutation(len(table))] if shuffled else table
    matches = Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
    problem = build_problem(matches, 1, error_floor=floor)
    sx, sy = matches.table["x_err"].value, matches.table["y_err"].value
    off = corr * sx * sy
    covariance = np.stack([np.stack([sx**2 + floor**2, off]), np.stack([off, sy**2 + floor**2])]).transpose(2, 0, 1)
    xx, yy, xy = problem.weight
    found = problem.in_table_order(np.stack([[xx, xy], [xy, yy]])).transpose(2, 0, 1)
    assert_allclose(found @ covariance, np.broadcast_to(np.eye(2), found.shape), atol=1e-12)
    assert_allclose(problem.in_table_order(problem.xy).T, matches.observations.xy)
