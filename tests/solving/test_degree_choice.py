"""Stars kept out of the fit: the choice of the degree, the aliasing alarm, and the test of the errors."""

import itertools
import json
import warnings
from dataclasses import replace

import numpy as np
import oracle
import pytest
from astropy import units as u
from astropy.table import Table, vstack
from caller_warnings import warns_here
from numpy.testing import assert_allclose

from legdistort import Matches, Solution, run, solve
from legdistort.cli import parser
from legdistort.exceptions import AssumptionWarning, FoldError, InputError, SolveError
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.simulation.observations import simulate_matches
from legdistort.solving import single_fit
from legdistort.solving.choices import degree_choice, held_out
from legdistort.solving.options import SolveOptions

SHAPE = (2048, 2048)


def spectrum(*by_degree):
    """Standard deviations per mode from those per degree."""
    return np.repeat(by_degree, np.arange(1, len(by_degree) + 1))


def simulate(n_stars, *by_degree, seed=0, **options):
    width = spectrum(*by_degree)
    return simulate_matches(n_stars=n_stars, degree=len(by_degree) - 1, dynamic=width, static=1.5, seed=seed, **options)


def solved(sim, **options):
    return solve(sim.matches, prior=Prior(sim.truth.static), **options)


def folding(sim, degree, higher, prior=None, top=None):
    """What `folding` says of a degree higher than that of a fit, from one of that degree or of a still higher one."""
    fit = single_fit.estimate(sim.matches, SolveOptions(prior=prior, degree=higher if top is None else top, clip=None))
    return degree_choice.folding(fit, degree, higher)


# --- stars kept out ----------------------------------------------------------------------------------------------


def test_what_is_kept_out_has_no_say():
    """The same as solving the table without these stars, whatever their positions are."""
    sim = simulate(40, 0.5, 0.5, 0.5, dither=200, seen=0.8)
    kept, table = held_out.hold_out(sim.matches, 0.2)
    assert len(np.unique(table["star"])) == 8
    assert len(kept.table) + len(table) == len(sim.matches.table)
    assert not set(kept.stars) & set(table["star"])
    solution = solved(sim, degree=2, validate=0.2)
    plain = solve(kept, degree=2, prior=Prior(sim.truth.static))
    moved = sim.matches.table.copy()
    moved["x"][np.isin(moved["star"], table["star"])] += 50 * u.pix
    moved = Matches.from_table(moved, shape=SHAPE, poses=sim.matches.poses)
    elsewhere = solve(moved, degree=2, prior=Prior(sim.truth.static), validate=0.2)
    for other in (plain, elsewhere):
        assert other.chi2 == solution.chi2
        assert np.array_equal(other.estimate.positions, solution.estimate.positions)
        assert np.array_equal(other.coefficients, solution.coefficients)
    assert not np.isin(solution.residuals["star"], table["star"]).any()
    assert plain.diagnostics.validation is None


def test_the_choice_is_seeded():
    sim = simulate(30, 0.5, 0.5)
    first, second, other = (held_out.hold_out(sim.matches, 0.3, seed=seed)[1]["star"] for seed in (0, 0, 1))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


@pytest.mark.slow
def test_scatter_is_what_the_errors_say():
    """Means over seeds; unequal errors, dithers, and a prior with widths."""
    rng = np.random.default_rng(0)
    ratios = []
    for seed in range(12):
        sigma = 0.1 * np.exp(0.5 * rng.normal(size=(10, 40)))
        sim = simulate(40, 0.5, 0.5, 0.5, seed=seed, dither=200, sigma=sigma)
        ratios.append(solved(sim, degree=2, validate=0.25).diagnostics.validation.ratio)
    assert np.mean(ratios) == pytest.approx(1, abs=0.06)


def test_scatter_tells_a_degree_that_is_too_low():
    sim = simulate(60, 0.5, 0.5, 0.5, 0.5)
    right, low = (solved(sim, degree=d, validate=0.2).diagnostics.validation for d in (3, 1))
    assert low.ratio > 3 > 1.3 > right.ratio
    assert low.scatter > 3 * right.scatter


def test_reported_scatter_is_that_of_the_corrected_positions():
    sim = simulate(30, 0.5, 0.5, seen=0.9)
    _, table = held_out.hold_out(sim.matches, 0.2)
    solution = solved(sim, degree=1, validate=0.2)
    by_star = []
    for star in np.unique(table["star"]):
        rows = table[table["star"] == star]
        xy = [solution[r["exposure"]].correct([[r["x"].value, r["y"].value]])[0] for r in rows]
        by_star.append(np.var(xy, axis=0).sum() / 2)
    got = solution.diagnostics.validation
    assert got.scatter == pytest.approx(np.sqrt(np.mean(by_star)), rel=1e-9)
    assert (got.n_stars, got.n_observations) == (6, len(table))
    assert got.ratio == got.scatter / got.expected
    assert got.fraction == 0.2


def test_scaled_and_floored_errors_count():
    """Errors stated twice too small are no surprise once they are scaled, or have their floor."""
    sim = simulate(60, 0.5, 0.5, sigma=0.2)
    table = sim.matches.table.copy()
    table["x_err"] /= 2
    table["y_err"] /= 2
    matches = Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)
    ratio = {
        errors: solve(matches, degree=1, errors=errors, validate=0.2).diagnostics.validation.ratio
        for errors in ("stated", "scale", "floor")
    }
    assert ratio["stated"] == pytest.approx(2, rel=0.15)
    assert ratio["scale"] == pytest.approx(1, rel=0.15)
    assert ratio["floor"] == pytest.approx(1, rel=0.15)


def test_a_mismatch_among_them_is_clipped():
    sim = simulate(40, 0.5, 0.5)
    _, kept = held_out.hold_out(sim.matches, 0.2)
    table = sim.matches.table.copy()
    bad = np.flatnonzero((table["star"] == kept["star"][0]) & (table["exposure"] == kept["exposure"][0]))
    table["x"][bad] += 20 * u.pix
    matches = Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)
    clean = solve(sim.matches, degree=1, clip=5, validate=0.2).diagnostics.validation
    plain, clipped = (solve(matches, degree=1, clip=c, validate=0.2).diagnostics.validation for c in (None, 5))
    assert plain.ratio > 5
    assert clipped.n_clipped == 1
    assert clipped.ratio == pytest.approx(clean.ratio, rel=0.05)


def test_solution_says_it(tmp_path):
    solution = solved(simulate(30, 0.5, 0.5), degree=1, validate=0.1)
    got = solution.diagnostics.validation
    text = " ".join(str(solution).split())
    assert (
        f"kept 3 stars, 30 observations, out of the solution: they scatter by {got.scatter:.4f} px per axis, " in text
    )
    solution.write(tmp_path / "solution.asdf")
    assert Solution.read(tmp_path / "solution.asdf").diagnostics.validation == got


@pytest.mark.parametrize("fraction", [0, 0.5, 1, -0.1, np.nan, True, "0.1"])
def test_fractions_out_of_range(fraction):
    with pytest.raises(InputError, match=r"validate must be a fraction of the stars between 0 and 0.5, got "):
        solve(simulate(10, 0.5).matches, degree=0, validate=fraction)


def test_too_few_stars_to_keep_any_out():
    table = simulate_matches(n_stars=2, n_exposures=2, degree=0).matches.table
    table = table[[0, 2, 3]]
    matches = Matches.from_table(table, shape=SHAPE, poses={name: np.eye(2, 3) for name in set(table["exposure"])})
    with pytest.raises(InputError, match="stars that two exposures or more see; there are 1 of them"):
        held_out.hold_out(matches, 0.4)
    with pytest.raises(InputError, match="degree='auto' needs stars that two exposures or more see; there are 1"):
        solve(matches, degree="auto")


def test_an_exposure_that_would_have_no_stars():
    sim = simulate(10, 0.5)
    table = sim.matches.table
    _, kept = held_out.hold_out(sim.matches, 0.4)
    table = table[(table["exposure"] != "exp00") | np.isin(table["star"], kept["star"])]
    matches = Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)
    with pytest.raises(InputError, match="no star is left in exposure exp00, others are kept out"):
        solve(matches, degree=0, validate=0.4)


# --- the degree --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_degree_put_in_is_chosen(degree):
    sim = simulate(60, *[0.5] * (degree + 1), n_exposures=6)
    solution = solved(sim, degree="auto")
    chosen = solution.diagnostics.selection
    assert solution.degree == chosen.degree == solution.settings.degree == degree
    assert chosen.degrees == tuple(range(max(degree + degree_choice.N_WORSE, degree_choice.CUBIC) + 1))
    assert chosen.scores[degree] == min(chosen.scores)
    assert chosen.scores[degree] == pytest.approx(1 + (degree + 1) * (degree + 2) / 2 / 54, rel=0.2)
    assert not chosen.alarm
    assert f"degree {degree}, of 0 to {chosen.degrees[-1]}: stars kept out scatter least with it" in " ".join(
        str(solution).split()
    )


@pytest.mark.parametrize("by_degree", [[0.5, 0, 0, 0, 0.5], [0.5, 0, 0, 0, 0, 0.5], [0.5, 0.5, 0, 0.5]])
def test_a_large_distortion_is_found_beyond_degrees_that_do_not_help(by_degree):
    chosen = solved(simulate(60, *by_degree, n_exposures=6), degree="auto").diagnostics.selection
    assert chosen.degree == len(by_degree) - 1


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.AssumptionWarning")  # the alarm is not what is tested
def test_no_more_than_the_stars_allow():
    """Nine stars, eight or nine at a time: enough for six modes, not for ten."""
    chosen = solved(simulate(9, 0.5, 0.5, 0.02, sigma=0.02), degree="auto").diagnostics.selection
    assert chosen.degrees == (0, 1, 2)


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.LegdistortWarning")
def test_degree_zero_alone_has_an_alarm_too():
    """Where no more than degree 1 is possible beyond it, which maps that are not known cannot bend."""
    sim = simulate_matches(n_stars=90, n_exposures=8, degree=3, dither=1100.0, seen=0.5, min_exposures=2, seed=12)
    chosen = solve(sim.matches, degree="auto").diagnostics.selection
    assert (chosen.degree, chosen.degrees) == (0, (0, 1))
    assert [each.degree for each in chosen.aliasing] == [1]
    assert chosen.alarm


@pytest.mark.parametrize("degree", [1, 3])
def test_stars_subtracted_from_one_fit_are_as_if_it_had_not_had_them(degree):
    """The squares of stars left out, by one step from the fit of all, against fits without them."""
    sim = simulate(40, 0.5, 0.5, 0.5, 0.5, dither=200, seen=0.8, n_exposures=6)
    options = SolveOptions(prior=Prior(sim.truth.static, sigma=0.5))
    folds = degree_choice._folds(sim.matches)
    fit = single_fit.estimate(sim.matches, replace(options, degree=degree, clip=None))
    quick = held_out.squares(fit, sim.matches, folds)
    slow = held_out.refitted_squares(
        lambda left: solve(left, prior=options.prior, degree=degree, clip=None), sim.matches, folds
    )
    assert np.array_equal(quick[:, 1], slow[:, 1])
    assert quick[:, 0].sum() == pytest.approx(slow[:, 0].sum(), rel=0.02)
    # the start of those fits is their own
    assert_allclose(quick[:, 0], slow[:, 0], rtol=0.1, atol=0.1 * np.median(slow[:, 0]))


def strip(n_exposures, n_seen, share, seed):
    """Matches of exposures along a strip, each of which has `share` of its stars in common with the next."""
    rng, step = np.random.default_rng(seed), SHAPE[1] * (1 - share)
    n_stars = round(n_seen * (1 + (n_exposures - 1) * (1 - share)))
    stars = rng.uniform(0, (SHAPE[1] + (n_exposures - 1) * step, SHAPE[0]), (n_stars, 2))
    parts, poses = [], {}
    for i in range(n_exposures):
        q = stars - [i * step, 0]
        seen = np.flatnonzero((q[:, 0] > 0) & (q[:, 0] < SHAPE[1]))
        xy = oracle.predict(q[seen], rng.normal(0, 0.3, (2, 6)), np.eye(2, 3), SHAPE)
        part = Table({"exposure": np.repeat(f"e{i}", len(seen)), "star": seen})
        part["x"], part["y"] = (xy + rng.normal(0, 0.05, xy.shape)).T
        part["x_err"] = part["y_err"] = 0.05
        parts.append(part)
        poses[f"e{i}"] = np.array([[1.0, 0, -i * step], [0, 1, 0]])
    return Matches.from_table(vstack(parts), shape=SHAPE, poses=poses)


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.LegdistortWarning")
@pytest.mark.parametrize(
    ("n_exposures", "n_seen", "share"), [(8, 45, 0.4), pytest.param(10, 45, 0.35, marks=pytest.mark.slow)]
)
def test_stars_left_out_of_exposures_that_hang_together_weakly(n_exposures, n_seen, share, monkeypatch):
    """Steps along directions that hardly anything determines count, which no few conjugate gradients find."""
    matches = strip(n_exposures, n_seen, share, 1)
    fit = single_fit.estimate(matches, SolveOptions(degree=3, clip=None))
    folds = degree_choice._folds(matches)
    found = held_out.squares(fit, matches, folds)
    monkeypatch.setattr(held_out.reduced_system, "Iterative", held_out.reduced_system.Direct)
    exact = held_out.squares(fit, matches, folds)
    assert_allclose(found, exact, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("by_degree", "best"), [((0.0,), 0), ((0.5, 0.5, 0.5), 2)])
def test_the_registration_of_degree_zero_is_made_without_the_stars_left_out_where_it_matters(
    by_degree, best, monkeypatch
):
    sim = simulate(40, *by_degree, n_exposures=6)
    options, calls = SolveOptions(prior=Prior(sim.truth.static)), []
    refitted = held_out.refitted_squares
    monkeypatch.setattr(held_out, "refitted_squares", lambda *given: calls.append(1) or refitted(*given))
    chosen = solve(sim.matches, prior=options.prior, degree="auto", clip=None).diagnostics.selection
    assert chosen.degree == best
    assert len(calls) == (best == 0)
    folds = degree_choice._folds(sim.matches)
    slow = refitted(lambda left: solve(left, prior=options.prior, degree=0, clip=None), sim.matches, folds)
    assert chosen.scores[0] == pytest.approx(slow[:, 0].sum() / slow[:, 1].sum(), rel=1e-3 if best == 0 else 0.3)


@pytest.mark.slow
def test_of_equal_degrees_the_lowest():
    """With widths that are found, degrees that are not there change nothing."""
    sim = simulate(12, 0.5, 0.5, n_exposures=5)
    chosen = solve(sim.matches, prior=Prior(sim.truth.static, sigma="evidence"), degree="auto").diagnostics.selection
    assert chosen.degree == 1
    assert max(chosen.degrees) > 2


@pytest.mark.slow
def test_widths_allow_more():
    sim = simulate(8, 0.5, 0.5, 0.3, n_exposures=5)
    chosen = solve(sim.matches, prior=Prior(sim.truth.static, sigma="evidence"), degree="auto").diagnostics.selection
    assert max(chosen.degrees) > 2  # without widths eight stars, less one or two, end at degree 1
    assert chosen.degree >= 2


@pytest.mark.slow
def test_a_mismatched_star_has_no_say():
    sim = simulate(40, 0.5, 0.5, 0.5, n_exposures=6)
    table = sim.matches.table.copy()
    bad = np.flatnonzero(table["star"] == 7)
    table["x"][bad] += 40 * np.random.default_rng(0).normal(size=len(bad)) * u.pix
    matches = Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)
    with warns_here(AssumptionWarning, match=r"1 star has no position.*: 7 \("):
        assert solve(matches, degree="auto").degree == 2


def large_static(seed, n_stars=100, half=512.0, error=0.02):
    """Five lists, two of them turned, of a large cubic static distortion, one observation each 0.3 to 0.9 px off.

    Returns the matches and of which rows the position is wrong; of numpy alone.
    """
    rng, rows = np.random.default_rng(seed), []
    stars, static = rng.uniform(-1.1 * half, 1.1 * half, (n_stars, 2)), rng.normal(0, 8, (7, 2))
    for i, roll in enumerate((0, 90, 0, 90, 0)):
        (c, s), shift = (np.cos(np.radians(roll)), np.sin(np.radians(roll))), rng.uniform(-140, 140, 2)
        q = stars @ np.array([[c, s], [-s, c]]) + shift
        x, y = q.T / half
        modes = np.stack([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1)
        p = q + modes @ (static + rng.normal(0, 0.02, (7, 2))) + half - 0.5
        seen = np.flatnonzero((np.abs(p - half) < half).all(axis=1))
        xy = p[seen] + rng.normal(0, error, (len(seen), 2))
        wrong = rng.integers(len(seen))
        xy[wrong] += (2 * rng.integers(2, size=2) - 1) * rng.uniform(0.2, 0.6, 2)
        rows += [(f"e{i}", j, *each, k == wrong) for k, (j, each) in enumerate(zip(seen, xy, strict=True))]
    exposure, star, x, y, wrong = zip(*rows, strict=True)
    errors = np.full(len(x), error)
    table = Table({"exposure": exposure, "star": star, "x": x, "y": y, "x_err": errors, "y_err": errors})
    return Matches.from_table(table, shape=(1024, 1024)), np.array(wrong)


@pytest.mark.parametrize("seed", [0, 2])
def test_what_contradicts_is_found_beside_a_fit_with_its_plane_held_elsewhere(seed):
    """Such a fit of the same degree has modes beyond it, and is no plain one: it ended in a traceback."""
    matches, wrong = large_static(seed)
    options = SolveOptions(degree=3, clip=None)
    near = single_fit.estimate(matches, options, trial=True)
    assert near.problem.prior_mean.shape[2] > near.problem.n_modes
    clipped = replace(options, clip=5.0)
    found = single_fit.estimate(matches, clipped, near=near, trial=True)
    used = found.problem.in_table_order(found.used)
    assert not used[wrong].any()
    assert np.mean(used) > 0.95
    scratch = single_fit.estimate(matches, clipped)
    assert_allclose(found.chi2, scratch.chi2, rtol=0.1)


def test_kept_out_stars_do_not_choose():
    """What validate keeps out is not in the folds either."""
    sim = simulate(40, 0.5, 0.5, n_exposures=5)
    kept, _ = held_out.hold_out(sim.matches, 0.2)
    both = solved(sim, degree="auto", validate=0.2).diagnostics.selection
    assert both == solve(kept, degree="auto", prior=Prior(sim.truth.static)).diagnostics.selection


# --- the alarm ---------------------------------------------------------------------------------------------------


def fourth(**options):
    """Simulation 5 of the paper: degree 3 and x^4 in x, 0.5 px, 1000 stars, no noise."""
    width = np.zeros((2, 15))
    width[0, 10] = 0.5
    static = np.r_[np.full(10, 1.5), np.zeros(5)]
    options = {"n_stars": 1000, "sigma": 0.01, "noise": 0, "degree": 4} | options
    return simulate_matches(dynamic=width, static=static, **options)


@pytest.mark.parametrize("margin", [0, 300])
def test_x4_folds_as_foretold(margin):
    """What `folding` says from a fit of degree 4, and what a fit of degree 3 gets wrong (paper, section 4.3).

    Stars all over the detector see modes that are nearly orthogonal. Those that leave a margin see x^4 as x^2 and a
    shift, modes of the same parity.
    """
    sim = fourth(margin=margin)
    told = folding(sim, 3, 4, Prior(sim.truth.static))
    assert told.mode == (4, 0)
    put_in = np.sqrt(np.mean(sim.truth.dynamic[:, 0, 10] ** 2) / 2) / 2  # rms over both axes and the field
    assert told.energy == pytest.approx(put_in, rel=0.05)
    assert told.noise < 0.1 * told.energy
    low = solved(sim, degree=3, clip=None)
    wrong = (low.coefficients - low.estimate.prior_mean)[:, :, :10]
    for degree in (2, 3):  # those below are, in part, in the poses
        part = slice(degree * (degree + 1) // 2, (degree + 1) * (degree + 2) // 2)
        done = np.sqrt((wrong[:, :, part] ** 2).mean(axis=(0, 1)).sum()) / 2
        assert told.folds_into[degree] == pytest.approx(done, rel=0.1, abs=0.003)
    if margin:
        assert told.into == (2, 0)
        assert min(told.folds_into[0], told.folds_into[2]) > 3 * max(told.folds_into[1], told.folds_into[3])
    else:
        assert max(told.folds_into) < 0.1 * told.energy


def test_few_stars_fold_more():
    """The sum of squares over seeds agrees with what fits of degree 2 get wrong."""
    told, done = [], []
    for seed in range(6):
        width = np.zeros(10)
        width[6:] = 0.4
        sim = simulate_matches(n_stars=25, dynamic=width, sigma=0.01, noise=0, seed=seed)
        told.append(folding(sim, 2, 3, Prior(sim.truth.static)).folds_into[2])
        low = solved(sim, degree=2, clip=None)
        wrong = (low.coefficients - low.estimate.prior_mean)[:, :, 3:6]
        done.append(np.sqrt((wrong**2).mean(axis=(0, 1)).sum()) / 2)
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(np.sqrt(np.mean(np.square(done))), rel=0.15)


def test_noise_is_no_energy():
    sets = [simulate(40, 0.5, 0.5, seed=seed) for seed in range(12)]
    excess = [folding(sim, 1, 3, Prior(sim.truth.static)).excess for sim in sets]
    assert abs(np.mean(excess)) < 0.7
    assert max(np.abs(excess)) < degree_choice.ALARM


@pytest.mark.slow
def test_a_convention_is_no_energy():
    """Without a prior all exposures depart alike, by what the convention makes of their common map; degree 3 is all."""
    excess = []
    for seed, settings in itertools.product(range(4), ({}, {"dither": 200}, {"rotations": 60.0 * np.arange(6)})):
        sim = simulate_matches(n_exposures=6, n_stars=60, degree=3, seed=seed, **settings)
        chosen = solve(sim.matches, degree="auto").diagnostics.selection
        assert chosen.degree == 3
        excess += [each.excess for each in chosen.aliasing]
    assert len(excess) == 24
    assert abs(np.mean(excess)) < 1
    assert max(np.abs(excess)) < 3


@pytest.mark.parametrize("quartic", [pytest.param(0.0, marks=pytest.mark.slow), 0.03])
def test_a_common_map_that_nobody_knew_is_no_energy_where_stars_are_many(quartic):
    """It carries the distortion of every exposure to other places by 1.5 px, which makes modes of higher degrees.

    They showed at 8, 16 and 21 standard deviations of the noise. Quartic modes of some 0.02 px are found as before.
    """
    excess, static, width = [], np.repeat([1.5, 0], [10, 5]), np.repeat([0.9, quartic], [10, 5])
    for seed in (1, 2, 4):
        sim = simulate_matches(n_exposures=11, n_stars=3000, degree=4, static=static, dynamic=width, seed=seed)
        with warnings.catch_warnings(action="ignore"):
            excess += [[folding(sim, 3, higher, top=5).excess for higher in (4, 5)]]
    fourth, fifth = np.transpose(excess)
    assert np.all(fourth > 10 * degree_choice.ALARM if quartic else np.abs(fourth) < degree_choice.ALARM)
    assert np.all(np.abs(fifth) < degree_choice.ALARM)


@pytest.mark.parametrize("n_exposures", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_energy_beyond_what_an_unknown_map_can_do_is_seen_in_few_exposures(n_exposures):
    """A map that would explain 0.1 px in the end would have to be a hundred pixels large."""
    static, width = np.repeat([1.5, 0], [10, 5]), np.repeat([0.9, 0.1], [10, 5])
    for seed in (1, 2):
        sim = simulate_matches(n_exposures=n_exposures, n_stars=300, degree=4, static=static, dynamic=width,
                               sigma=0.02, zero_mean=False, dither=100.0, seed=seed)  # fmt: skip
        with warnings.catch_warnings(action="ignore"):
            assert folding(sim, 3, 4, top=n_exposures + 2).excess > 1.8 * degree_choice.ALARM


@pytest.mark.parametrize("direct", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_energy_of_its_own_is_seen_beside_a_common_map(monkeypatch, direct):
    """Quartic modes of every exposure count, however errors differ, whether the equations are factorised or not."""
    monkeypatch.setattr("legdistort.solving.equations.reduced_system.uses_direct", lambda problem: direct)
    excess = {}
    for quartic in (0.0, 0.1):
        width = np.zeros(15)
        width[3:10], width[10:] = 0.3, quartic
        sigma = np.where(np.arange(8) == 3, 0.4, 0.02)[:, None]
        sim = simulate_matches(n_exposures=8, n_stars=80, dynamic=width, sigma=sigma, dither=200, degree=4, seed=3)
        with warnings.catch_warnings(action="ignore"):
            excess[quartic] = folding(sim, 3, 4).excess
    assert abs(excess[0.0]) < degree_choice.ALARM
    assert excess[0.1] > 10 * degree_choice.ALARM


def test_two_exposures_say_nothing_of_a_common_map():
    sim = simulate_matches(n_exposures=2, n_stars=60, degree=3, seed=1)
    assert folding(sim, 3, 4).excess == pytest.approx(0, abs=3)
    assert folding(sim, 3, 4, top=5).excess == pytest.approx(0, abs=3)
    turned = simulate_matches(n_exposures=2, n_stars=80, degree=3, rotations=[0, 60.0], seed=1)
    assert folding(turned, 3, 4, top=5).excess == 0  # common maps of degrees 4 and 5 explain any departure of the two


def test_where_similarities_are_in_the_poses_no_energy_is_missed():
    """Above degree 0 come shears alone: rotation and scale are no coefficients."""
    excess = []
    for seed in range(8):
        sim = simulate_matches(n_exposures=8, n_stars=60, degree=1, dynamic=0, seed=seed)
        excess += [folding(sim, 0, higher, Prior(sim.truth.static), top=2).excess for higher in (1, 2)]
    assert abs(np.mean(excess)) < 1
    assert max(np.abs(excess)) < degree_choice.ALARM


@pytest.mark.slow
def test_alarm_is_raised():
    """Sixteen stars, precise, with more distortion than they can be fitted with at degree 3."""
    sim = simulate(16, 0.5, 0.5, 0.5, 0.3, 0.3, sigma=0.01, seed=2)
    with warns_here(AssumptionWarning, match=r"degree \d, of 0 to .*Degree \d is there as well, .* px rms beyond"):
        solution = solved(sim, degree="auto", clip=None)
    chosen = solution.diagnostics.selection
    assert chosen.alarm
    assert [a.degree for a in chosen.aliasing] == [solution.degree + 1, solution.degree + 2][: len(chosen.aliasing)]
    assert any(a.excess > degree_choice.ALARM for a in chosen.aliasing)
    assert "is there as well" in " ".join(str(solution).split())


# --- bad input, command line -------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", ["high", "3", -1, 2.5, None, True])
def test_degrees_that_are_none(degree):
    with pytest.raises(InputError, match="degree must be an integer"):
        solve(simulate(10, 0.5).matches, degree=degree)


def test_what_auto_does_not_go_with():
    sim = simulate(30, 0.5, 0.5)
    with pytest.raises(InputError, match="static='fit' needs a degree in numbers, not 'auto'"):
        solve(sim.matches, degree="auto", static="fit")
    with pytest.raises(InputError, match="leave degree='auto' and static out"):
        solve(sim.matches, degree="auto", model=solved(sim, degree=1)["exp00"].distortion.model())


def test_run_refuses_before_it_reads(tmp_path):
    with pytest.raises(InputError, match="validate must be a fraction"):
        run(tmp_path / "no.fits", out=tmp_path / "out", solving={"validate": 2})


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_command_line(tmp_path, capsys):
    sim = simulate(30, 0.5, 0.5, n_exposures=5)
    table = sim.matches.table.copy()
    table.meta = sim.matches.to_meta()
    table.write(tmp_path / "matched.ecsv")
    command = ["solve", str(tmp_path / "matched.ecsv"), "--degree", "auto", "--validate", "0.1", "--json", "--quiet"]
    assert parser.main([*command, "--out", str(tmp_path / "out")]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["selection"]["degree"] == 1
    assert figures["validation"]["n_stars"] == 3
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == figures
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "stars kept out scatter least with it" in page
    assert "expected from the errors" in page
    assert parser.main([*command[:2], "--validate", "0.9", "--out", str(tmp_path / "no")]) == 1
    assert "validate must be a fraction of the stars between 0 and 0.5, got 0.9" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        parser.main([*command[:2], "--degree", "many", "--out", "no"])
    assert "many is neither a number nor auto" in capsys.readouterr().err


def test_expected_scatter_takes_an_error_for_each_position():
    solution = solved(simulate(30, 0.5, 0.5), degree=1)
    xy = np.array([[500.0, 500.0], [1500.0, 900.0]])
    same = accuracy.expected_scatter(solution, xy, 0.2)
    assert_allclose(accuracy.expected_scatter(solution, xy, np.full((10, 2), 0.2)), same)
    mixed = accuracy.expected_scatter(solution, xy, np.full((10, 2), [0.2, 0.4]))
    assert mixed[0] == same[0]
    assert mixed[1] > 1.7 * same[1]


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.AssumptionWarning")  # the alarm is not what is tested
@pytest.mark.parametrize(
    "by_degree",
    [
        pytest.param((0.5,) * 4, marks=pytest.mark.sets),
        pytest.param((0.5, 0.3, 0.1, 0.05), marks=pytest.mark.slow),
        pytest.param((0.5, 0.2), marks=pytest.mark.sets),
        pytest.param((0.0,), marks=pytest.mark.sets),
    ],
)
def test_the_choice_costs_little(by_degree):
    """Mean error of new positions with the degree chosen, against the best of 0 to 4, which is not known."""
    for n_stars in (15, 30, 80):
        rows = []
        for seed in range(5):
            sim = simulate(n_stars, *by_degree, seed=seed)
            grid = sim.truth.grid("exp00", 20)

            def error(degree, sim=sim, grid=grid):
                try:
                    made = solved(sim, degree=degree)
                    scatter = accuracy.new_scatter(made, sim.truth.distort, grid, 0.14)
                except (FoldError, SolveError):  # no answer for so few stars
                    return np.inf
                return np.sqrt(np.nanmean(scatter**2))

            rows.append([error(degree) for degree in ("auto", 0, 1, 2, 3, 4)])
        chosen, *fixed = np.mean(rows, axis=0)
        # fifteen stars and ten modes: leaving one star out is leaving much out, and one choice of five weighs much
        assert chosen < (1.4 if n_stars == 15 else 1.05) * min(fixed), n_stars
