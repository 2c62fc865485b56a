"""Widths of a prior found from the exposures, and how many modes the data determine."""

import itertools
import re

import dense_model
import drawn_sets
import four_detectors
import numpy as np
import oracle
import pytest
from caller_warnings import warns_here
from numpy.testing import assert_allclose
from scipy.spatial import Delaunay

from legdistort import Matches, Solution, solve
from legdistort.assessment import baselines
from legdistort.cli import parser
from legdistort.exceptions import ConvergenceWarning, InputError, LegdistortError, SolveError
from legdistort.geometry.detector_modes import dynamic_basis, dynamic_degrees
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.simulation.observations import simulate_matches
from legdistort.simulation.prediction import predict
from legdistort.solving import single_fit
from legdistort.solving.choices import prior_widths
from legdistort.solving.equations.problem import State
from legdistort.solving.options import SolveOptions

SHAPE = (2048, 2048)
SPECTRA = {
    "flat": [0.9] * 10,
    "falling": [0.9] * 3 + [0.3] * 3 + [0.1] * 4,
    "degree 1 only": [0.9] * 3 + [0.0] * 7,
    "zero": [0.0] * 10,
}


def simulate(n_stars, spectrum="falling", *, seed=0, **options):
    return simulate_matches(n_stars=n_stars, dynamic=SPECTRA[spectrum], zero_mean=False, seed=seed, **options)


def found(sim, **options):
    return solve(sim.matches, prior=Prior(sim.truth.static, sigma="evidence"), **options)


def with_table(sim, change):
    """The same matches with columns changed in place by ``change(table)``."""
    table = sim.matches.table.copy()
    change(table)
    return Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)


# --- the likelihood ----------------------------------------------------------------------------------------------


def design(sim, columns):
    """Derivatives of all measured coordinates, in their errors, by finite differences of the plain model."""
    table = sim.matches.table
    exposure = np.searchsorted(sim.matches.names, table["exposure"])
    sigma = np.concatenate([table["x_err"].value, table["y_err"].value])

    def model(positions, coefficients):
        out = np.empty((len(table), 2))
        for i, name in enumerate(sim.matches.names):
            rows = exposure == i
            out[rows] = oracle.predict(positions[table["star"][rows]], coefficients[i], sim.matches.poses[name], SHAPE)
        return out.T.ravel() / sigma

    base = np.zeros((len(sim.matches.names), 2, 10)) + sim.truth.static
    start = model(sim.truth.positions, base)
    out = []
    for kind, where in columns:
        positions, coefficients = sim.truth.positions.copy(), base.copy()
        if kind == "star":
            positions[where] += 1e-3
        else:
            i, direction = where
            coefficients[i] += 1e-3 * direction.reshape(2, 10)
        out.append((model(positions, coefficients) - start) / 1e-3)
    measured = np.concatenate([table["x"].value, table["y"].value]) / sigma
    return np.array(out).T, measured - start


@pytest.fixture(scope="module")
def likelihoods():
    """The evidence of a fit, and the restricted likelihood of its data, written out densely."""
    sim = simulate(8, n_exposures=5, seed=3)
    dynamic = dynamic_basis(SHAPE, 10)
    similar = np.linalg.qr(dynamic.T, mode="complete")[0][:, len(dynamic) :].T
    flat, departure = design(
        sim,
        [("star", (j, k)) for j in range(8) for k in (0, 1)]
        + [("mode", (i, row)) for i in range(5) for row in similar],
    )
    random, _ = design(sim, [("mode", (i, row)) for i in range(5) for row in dynamic])
    vectors, size, _ = np.linalg.svd(flat)
    null = vectors[:, np.count_nonzero(size > 1e-6 * size[0]) :]
    projected, random = null.T @ departure, null.T @ random
    degree = np.tile(dynamic_degrees(10), 5)

    def dense(widths, scale=1.0):
        covariance = scale**2 * (np.eye(len(null.T)) + random * np.asarray(widths)[degree - 1] ** 2 @ random.T)
        return (np.linalg.slogdet(covariance)[1] + projected @ np.linalg.solve(covariance, projected)) / 2

    solution = []

    def fit(problem_prior):
        return single_fit.minimise(sim.matches, SolveOptions(prior=problem_prior))

    done = fit(Prior(sim.truth.static, sigma=0.5))
    solution.append(done)
    labels = np.tile(np.arange(3), (5, 1))
    evidence = prior_widths.evidence(done.weighted, done.result.state, labels, done.result.gauge.motion)
    return evidence, dense


@pytest.mark.parametrize("widths", [[0.9, 0.3, 0.1], [0.1, 1.0, 0.5], [2.0, 2.0, 2.0], [1e-3, 0.2, 1e-3]])
def test_evidence_is_the_restricted_likelihood(likelihoods, widths):
    evidence, dense = likelihoods
    reference = [0.5, 0.5, 0.5]
    ours = evidence.cost(np.log(widths))[0] - evidence.cost(np.log(reference))[0]
    assert ours == pytest.approx(dense(widths) - dense(reference), rel=0.01, abs=0.05)


@pytest.mark.parametrize("widths", [[0.9, 0.3, 0.1], [0.1, 1.0, 0.5]])
def test_the_scale_of_the_errors_is_profiled_out(likelihoods, widths):
    evidence, dense = likelihoods

    def best(w):
        return min(dense(w * s, s) for s in np.exp(np.linspace(-1.5, 1.5, 601)))

    reference = np.full(3, 0.5)
    ours = evidence.cost(np.log(widths), scale=True)[0] - evidence.cost(np.log(reference), scale=True)[0]
    assert ours == pytest.approx(best(np.array(widths)) - best(reference), rel=0.07, abs=0.3)


@pytest.mark.parametrize("scale", [False, True])
def test_slope_of_the_evidence(likelihoods, scale):
    evidence, _ = likelihoods
    at = np.log([0.7, 0.4, 0.05])
    slope = [
        (evidence.cost(at + e, scale=scale)[0] - evidence.cost(at - e, scale=scale)[0]) / 2e-5 for e in 1e-5 * np.eye(3)
    ]
    assert_allclose(evidence.cost(at, scale=scale)[1], slope, rtol=1e-5, atol=1e-6)


def test_where_the_fit_stood_does_not_matter(likelihoods):
    """Seen from another state, the same evidence: the gauge and the poses have no say."""
    evidence, _ = likelihoods
    sim = simulate(8, n_exposures=5, seed=3)
    for sigma in (0.05, 5.0):
        solution = solve(sim.matches, prior=Prior(sim.truth.static, sigma=sigma))
        problem, gauge = solution.estimate.uncertainty._problem, solution.gauge
        poses = np.stack([solution.poses[name] for name in solution.names])
        state = State(solution.estimate.positions.T, solution.coefficients, poses)
        labels = np.tile(np.arange(3), (5, 1))
        other = prior_widths.evidence(problem, state, labels, gauge.motion)
        for widths in ([0.9, 0.3, 0.1], [0.1, 1.0, 0.5]):
            ours, theirs = (e.cost(np.log(widths))[0] - e.cost(np.log([0.5] * 3))[0] for e in (evidence, other))
            assert ours == pytest.approx(theirs, rel=0.01, abs=0.05)


# --- the widths --------------------------------------------------------------------------------------------------


def test_widths_are_those_put_in():
    widths = found(simulate(40, n_exposures=40)).diagnostics.widths
    assert_allclose(widths, [0.9, 0.3, 0.1], rtol=0.15)


def test_six_stars_at_degree_3():
    """Ten modes, six stars: without widths there is no answer; with them it is better than any degree fitted freely."""
    sim = simulate(6, seed=1)
    with pytest.raises(SolveError, match="6 stars, fewer than the 10 modes of degree 3"):
        solve(sim.matches, prior=Prior(sim.truth.static))
    grid = sim.truth.grid("exp00", 20)
    inside = grid[Delaunay(sim.truth.positions).find_simplex(grid) >= 0]

    def error(solution):
        return np.sqrt(np.mean(accuracy.new_scatter(solution, sim.truth.distort, inside, 0) ** 2))

    free = [error(solve(sim.matches, degree=d, prior=Prior(sim.truth.static))) for d in (0, 1, 2)]
    assert error(found(sim)) < 0.9 * min(free)


def test_modes_that_the_mean_lacks_have_widths_too():
    sim = simulate(8, n_exposures=12)
    flat = with_table(sim, lambda table: None)
    solution = solve(flat, prior=Prior(np.zeros((2, 1)), sigma="evidence"))
    assert len(solution.diagnostics.widths) == 3
    assert solution.degree == 3


def test_what_is_not_there_gets_no_width():
    sim = simulate(15, "zero")
    solution = found(sim)
    assert solution.diagnostics.widths == (0, 0, 0)
    lowest = solve(sim.matches, degree=0, prior=Prior(sim.truth.static))
    assert_allclose(solution.estimate.positions, lowest.estimate.positions, atol=1e-3)
    assert solution.dof == pytest.approx(lowest.dof, abs=0.01)


def test_degree_0_has_nothing_that_scatters():
    solution = found(simulate(6), degree=0)
    assert solution.diagnostics.widths == ()


def test_order_of_exposures_does_not_matter():
    sim = simulate(10)
    order = np.random.default_rng(0).permutation(len(sim.matches.table))
    turned = Matches.from_table(sim.matches.table[order], shape=SHAPE, poses=sim.matches.poses)
    prior = Prior(sim.truth.static, sigma="evidence")
    assert_allclose(solve(turned, prior=prior).diagnostics.widths, found(sim).diagnostics.widths, rtol=0.02)


@pytest.mark.slow
def test_errors_known_up_to_a_factor():
    """Errors stated twice too small: with errors="scale" the widths are what they were."""
    sim = simulate(15)
    right = found(sim)

    def halve(table):
        table["x_err"] /= 2
        table["y_err"] /= 2

    prior = Prior(sim.truth.static, sigma="evidence")
    wrong = solve(with_table(sim, halve), prior=prior, errors="scale")
    again = found(sim, errors="scale")
    assert_allclose(wrong.diagnostics.widths, again.diagnostics.widths, rtol=0.02)
    assert_allclose(wrong.diagnostics.widths, right.diagnostics.widths, rtol=0.1)
    assert wrong.diagnostics.error_scale == pytest.approx(2 * again.diagnostics.error_scale, rel=0.01)


@pytest.mark.slow
def test_mismatches_do_not_widen_them():
    sim = simulate(8, "flat", seed=3)
    bad = np.random.default_rng(0).choice(len(sim.matches.table), 3, replace=False)

    def spoil(table):
        table["x"][bad] += 30 * table["x"].unit

    matches, prior = with_table(sim, spoil), Prior(sim.truth.static, sigma="evidence")
    solution = solve(matches, prior=prior, clip=5)
    assert not solution.residuals["used"][bad].any()
    assert_allclose(solution.diagnostics.widths, found(sim).diagnostics.widths, rtol=0.1)
    assert_allclose(
        solve(matches, prior=prior, loss="cauchy").diagnostics.widths, found(sim).diagnostics.widths, rtol=0.1
    )


@pytest.mark.slow
def test_one_prior_one_set_of_widths():
    """A Prior shared by detectors pools them; one each keeps them apart; numbers stay what they are."""
    sim = simulate(14)

    def detector(table):
        table["detector"] = ["even" if int(name[3:]) % 2 == 0 else "odd" for name in table["exposure"]]

    matches, one = with_table(sim, detector), Prior(sim.truth.static, sigma="evidence")
    pooled = solve(matches, prior={"even": one, "odd": one}).diagnostics.widths
    assert pooled["even"] == pooled["odd"]
    assert_allclose(pooled["even"], found(sim).diagnostics.widths, rtol=0.02)
    apart = solve(matches, prior={"even": one, "odd": Prior(sim.truth.static, sigma="evidence")}).diagnostics.widths
    assert apart["even"] != apart["odd"]
    mixed = solve(matches, prior={"even": one, "odd": Prior(sim.truth.static, sigma=0.5)}).diagnostics.widths
    assert mixed["odd"] is None
    assert len(mixed["even"]) == 3


@pytest.mark.slow
def test_some_of_many_exposures_are_enough(monkeypatch):
    sim = simulate(12, n_exposures=30)
    whole = found(sim).diagnostics.widths
    monkeypatch.setattr(prior_widths, "MOST", 15 * 20)
    part = found(sim).diagnostics.widths
    assert part != whole
    assert_allclose(part, whole, rtol=0.5)


def test_with_a_static_distortion_that_is_fitted():
    spectrum = [0.5] * 3 + [0.0] * 7
    sim = simulate_matches(
        n_stars=40, n_exposures=12, dynamic=spectrum, dither=200, rotations=30 * np.arange(12), seed=2
    )
    solution = solve(sim.matches, prior=Prior(sim.truth.static, sigma="evidence"), static="fit")
    assert_allclose(solution.diagnostics.widths, [0.5], rtol=0.3)


def test_the_highest_likelihood_is_found(monkeypatch):
    """From one start as high as the best of many; two of the widths here once stuck at the lower end."""
    seen = []
    plain = prior_widths.Evidence.best

    def spy(self, n, bounds, *, scale=False):
        seen.append((self, plain(self, n, bounds, scale=scale)))
        return seen[-1][1]

    monkeypatch.setattr(prior_widths.Evidence, "best", spy)
    monkeypatch.setattr(prior_widths, "PARSIMONY", 0.01)
    for seed in (3, 7):
        found(simulate(8, seed=seed, dither=250))
    for evidence, widths in seen[1::2]:
        costs = [evidence.cost(np.log(w))[0] for w in itertools.product([1e-3, 0.1, 0.2, 0.4, 0.7, 1.0], repeat=3)]
        assert evidence.cost(np.log(widths))[0] < min(costs) + 0.02


def test_widths_up_to_a_degree_below_that_of_the_fit():
    """Modes beyond are free; where they do not scatter at all, nothing is singular."""
    sim = simulate_matches(n_stars=14, n_exposures=6, degree=2, seed=3)
    prior = Prior(sim.truth.static, sigma=0.5)
    solution, lower = (solve(sim.matches, degree=degree, prior=prior) for degree in (3, 2))
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=4 * np.sqrt(2 / solution.dof))
    assert_allclose(solution.estimate.positions, lower.estimate.positions, atol=0.02)
    assert_allclose(solution.stars["x_err"].value, lower.stars["x_err"].value, rtol=0.2)


# --- the number of modes that the data determine -----------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_all_of_them_without_widths(degree):
    sim = simulate(30)
    solution = solve(sim.matches, degree=degree, prior=Prior(sim.truth.static))
    n = max(4, (degree + 1) * (degree + 2))
    assert_allclose(list(solution.diagnostics.effective_modes.values()), n * 0.9, rtol=1e-2)


@pytest.mark.parametrize("sigma", [10.0, 0.5, 0.1, 1e-3, 0.0, "evidence"])
def test_they_and_the_stars_are_the_free_parameters(sigma):
    sim = simulate(20, "zero")
    solution = solve(sim.matches, prior=Prior(sim.truth.static, sigma=sigma))
    number = np.array(list(solution.diagnostics.effective_modes.values()))
    assert 2 * len(solution.residuals) - 2 * 20 - number.sum() == pytest.approx(solution.dof, abs=0.6)
    assert np.all((number > 3.5) & (number < 18.1))
    if sigma == 10.0:
        assert_allclose(number, 18, atol=0.05)
    if sigma in (1e-3, 0.0):
        assert_allclose(number, 3.6, atol=0.05)  # shift, rotation and scale have no prior


def test_they_grow_with_the_width_and_the_stars():
    number = {}
    for n_stars in (8, 30):
        sim = simulate(n_stars, "zero")
        for sigma in (0.05, 0.2, 1.0):
            solution = solve(sim.matches, prior=Prior(sim.truth.static, sigma=sigma))
            number[n_stars, sigma] = np.mean(list(solution.diagnostics.effective_modes.values()))
    for n_stars in (8, 30):
        assert number[n_stars, 0.05] < number[n_stars, 0.2] < number[n_stars, 1.0]
    assert number[8, 0.2] < number[30, 0.2]


# --- words, files, commands --------------------------------------------------------------------------------------


def test_solution_says_what_was_found(tmp_path):
    solution = found(simulate(10))
    widths = ", ".join(f"{width:.3g}" for width in solution.diagnostics.widths)
    text = " ".join(str(solution).split())
    assert f"widths scatter of a coefficient, found from the exposures: {widths} px" in text
    assert re.search(r"modes \d+\.\d to \d+\.\d an exposure, both axes together, are determined by the data", text)
    solution.write(tmp_path / "solution.asdf")
    again = Solution.read(tmp_path / "solution.asdf")
    assert again.settings == solution.settings
    assert again.diagnostics == solution.diagnostics
    assert again.diagnostics.effective_modes == solution.diagnostics.effective_modes


def test_plain_solution_says_nothing_of_widths():
    text = str(solve(simulate(20).matches))
    assert not re.search(r"^(widths|modes|kept|degree) ", text, re.MULTILINE)


def test_prior_with_evidence_has_a_file(tmp_path):
    prior = Prior(np.zeros((2, 6)), sigma="evidence", static_sigma=0.1)
    prior.write(tmp_path / "prior.asdf")
    assert Prior.read(tmp_path / "prior.asdf").sigma == "evidence"
    assert "sigma given" in repr(prior)


def test_comparison_takes_such_a_prior():
    sim = simulate(12)
    prior = Prior(sim.truth.static, sigma="evidence")
    assert baselines.compare(sim.matches, solve(sim.matches, prior=prior), prior=prior)


def test_with_sigma():
    prior = Prior(np.ones((2, 3)), static_sigma=0.2, source="here")
    wide = prior.with_sigma(0.5, degree=2)
    assert_allclose(wide.mean, [[1, 1, 1, 0, 0, 0]] * 2)
    assert_allclose(wide.sigma, 0.5)
    assert_allclose(wide.static_sigma, [[0.2] * 3 + [0] * 3] * 2)
    assert wide.source == "here"
    given = prior.with_sigma([1.0, 2.0, 3.0], degree=2)
    assert_allclose(given.sigma, [[1, 2, 3, np.inf, np.inf, np.inf]] * 2)
    assert prior.with_sigma(None).sigma is None
    assert prior.sigma is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"sigma": "evidenz"},
            "sigma must be widths in pixels, or 'evidence': found from the exposures, got 'evidenz'",
        ),
        ({"static_sigma": "evidence"}, "static_sigma must be widths in pixels, got 'evidence'"),
    ],
)
def test_other_words(arguments, message):
    with pytest.raises(InputError, match=message):
        Prior(np.zeros((2, 3)), **arguments)


def test_a_plan_needs_numbers():
    with pytest.raises(InputError, match="sigma='evidence': solve finds it from exposures; give widths in pixels"):
        predict(n_exposures=5, n_stars=20, sigma=0.1, prior=Prior(np.zeros((2, 10)), sigma="evidence"))


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(["--prior-sigma", "evidence"], marks=pytest.mark.slow),
        pytest.param(["--prior-sigma", "0.9"], marks=pytest.mark.slow),
    ],
)
def test_command_line(arguments, tmp_path, capsys):
    sim = simulate(7)
    table = sim.matches.table.copy()
    table.meta = sim.matches.to_meta()
    table.write(tmp_path / "matched.ecsv")
    command = ["solve", str(tmp_path / "matched.ecsv"), *arguments, "--out", str(tmp_path / "out"), "--json", "--quiet"]
    assert parser.main(command) == 0
    figures = capsys.readouterr().out
    assert '"effective_modes"' in figures
    assert ('"widths"' in figures) == ("evidence" in arguments)


def test_command_line_refuses_other_words(capsys):
    with pytest.raises(SystemExit) as stop:
        parser.main(["solve", "matched.ecsv", "--prior-sigma", "wide", "--out", "out"])
    assert stop.value.code == 2
    assert "wide is neither a number nor evidence" in capsys.readouterr().err


# --- against fixed degrees ---------------------------------------------------------------------------------------


def errors(solution, truth, places):
    """Errors of one solution: stars (similarity removed), and new positions among the stars and all over the field."""
    scatter = [np.sqrt(np.nanmean(accuracy.new_scatter(solution, truth.distort, xy, 0) ** 2)) for xy in places]
    return [accuracy.bias(solution.estimate.positions, truth.positions, removed="similarity"), *scatter]


@pytest.mark.parametrize(
    ("spectrum", "n_stars"),
    [
        pytest.param(name, n, marks=pytest.mark.slow if (name, n) == ("falling", 10) else pytest.mark.sets)
        for name in SPECTRA
        for n in (6, 10, 15, 30, 80)
    ],
)
def test_never_much_worse_than_the_best_fixed_degree(spectrum, n_stars):
    """Mean errors over seeds; of new positions the errors of the correction alone, which is the hardest test."""
    rows = []
    for seed in range(20):
        sim = simulate(n_stars, spectrum, seed=seed)
        field = sim.truth.grid("exp00", 20)
        places = field[Delaunay(sim.truth.positions).find_simplex(field) >= 0], field
        mine = [errors(found(sim), sim.truth, places)]
        for degree in range(4):
            try:
                fixed = solve(sim.matches, degree=degree, prior=Prior(sim.truth.static), clip=None)
                mine.append(errors(fixed, sim.truth, places))
            except LegdistortError:
                mine.append([np.inf] * 3)
        rows.append(mine)
    ours, *fixed = np.mean(rows, axis=0)
    assert np.all(ours <= 1.05 * np.min(fixed, axis=0))


@pytest.mark.slow
def test_wrong_priors_are_told():
    """What docs/few_stars.md says of wrong priors, in short; its figures are of tests/benchmarks/priors_table.py."""
    widths, rows = np.array(SPECTRA["falling"]), []
    for seed in range(12):
        sim = simulate(30, seed=seed, dither=250, rotations=36 * np.arange(10))
        off = 3 * widths * np.random.default_rng(seed).choice([-1, 1], (2, 10))
        row = []
        for mean, factor in ((0, 1), (0, 2), (0, 0.5), (off, 1)):
            solution = solve(sim.matches, prior=Prior(sim.truth.static + mean, sigma=factor * widths))
            b = accuracy.bias(solution.estimate.positions, sim.truth.positions, removed="similarity")
            row.append([b, solution.chi2 / solution.dof, solution.diagnostics.departure_ratio])
        rows.append(row)
    (b, chi2, ratio) = np.mean(rows, axis=0).T
    assert_allclose([chi2[0], ratio[0]], 1, atol=0.1)
    assert_allclose(b[1:3], b[0], rtol=0.05)
    assert ratio[1] < 0.7
    assert ratio[2] > 1.5
    assert chi2[2] > chi2[0] + 0.1
    assert ratio[3] > 2.5
    assert chi2[3] > chi2[0] + 0.4
    assert b[3] > 1.1 * b[0]


def test_widths_that_do_not_settle_are_warned_of(monkeypatch):
    monkeypatch.setattr(prior_widths, "MAX_ROUNDS", 1)
    with warns_here(
        ConvergenceWarning, match="have not settled after 1 fits.*; leave them out .*forget prior-sigma"
    ) as told:
        solution = found(simulate(40))
    assert solution.status.endswith("; widths of the prior not")
    assert len(told) == 1


def test_of_a_camera_that_is_found_they_are_warned_of_once(monkeypatch):
    """It is fitted many times, each time with widths; what counts is the last."""
    monkeypatch.setattr(prior_widths, "MAX_ROUNDS", 1)
    matches = four_detectors.matches("layout", 1)
    with warns_here(ConvergenceWarning, match="the widths of the prior have not settled after 1 fits") as told:
        solution = solve(matches, degree=2, layout="fit", prior=Prior(None, sigma="evidence"))
    assert len([each for each in told if "have not settled" in str(each.message)]) == 1
    assert "; widths of the prior not" in solution.status


# --- without a mean ----------------------------------------------------------------------------------------------


def _drawn_to_what_they_show(seed, **words):
    """Sums of squared absolute errors, similarities aside, and of the stated variances; of widths without a mean."""
    data, truth = dense_model.drawn_set(seed, rolls=30.0, **words)
    solution = solve(drawn_sets.as_matches(data), prior=Prior(None, sigma="evidence"))
    stars = truth["stars"]
    offset, root = solution.estimate.positions - stars, 1 / solution.stars["x_err"].value[:, None]
    similar = np.stack([np.ones(len(stars)), stars @ [1, 1j] / 1024], axis=1)
    offset = offset @ [1, 1j]
    offset = offset - similar @ np.linalg.lstsq(root * similar, root[:, 0] * offset, rcond=None)[0]
    variance = sum(solution.stars[f"{axis}_err_abs"].value ** 2 for axis in "xy")
    return np.sum(np.abs(offset) ** 2), np.sum(variance), solution


@pytest.mark.parametrize(("words", "limit"), [({}, 0.06), pytest.param({"n_stars": 16}, 0.12, marks=pytest.mark.slow)])
def test_without_a_mean_exposures_are_drawn_to_the_static_distortion_that_they_show(words, limit):
    """A static distortion of 1 px a mode, departures of 0.05: about nothing, widths would be of a pixel."""
    square, variance, solution = _drawn_to_what_they_show(1, dynamic=0.05, **words)
    assert np.sqrt(square / 2 / len(solution.stars)) < limit
    assert square < 2 * variance
    for width in solution.diagnostics.widths[1:]:
        assert 0.02 < width < 0.1
    assert "scatter of a coefficient, found from the exposures" in str(solution)


@pytest.mark.parametrize(
    ("dynamic", "n_sets"),
    [
        pytest.param(0.05, 6, marks=pytest.mark.slow),
        pytest.param(0.05, 20, marks=pytest.mark.sets),
        pytest.param(0.4, 20, marks=pytest.mark.sets),
    ],
)
def test_errors_without_a_mean_are_calibrated(dynamic, n_sets):
    square, variance = np.sum([_drawn_to_what_they_show(seed, dynamic=dynamic)[:2] for seed in range(n_sets)], axis=0)
    assert square / variance == pytest.approx(1, abs=0.25 * np.sqrt(20 / n_sets))
