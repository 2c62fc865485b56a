"""What does not fit: exposures and stars that contradict the others, the same exposure twice, and clean data."""

import shutil
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable, vstack
from caller_warnings import warns_here

from legdistort import Matches, Prior, match, simulate_exposures, simulate_matches, solve
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, MatchError, SolveError
from legdistort.geometry import pair_agreement, similarity
from legdistort.inputs import repetitions
from legdistort.inputs.exposure_files import open_exposures
from legdistort.results import accuracy
from legdistort.simulation.observations import matches_from
from legdistort.solving import agreement, clipping, single_fit, start_values
from legdistort.solving.equations import criterion
from legdistort.solving.equations.leverage import leverages
from legdistort.solving.options import SolveOptions

SHAPE = (2048, 2048)
RNG = np.random.default_rng
no_position = pytest.mark.filterwarnings("ignore:.* no position, the observations contradict one another")


def precise(n_exposures, *, n_stars=40, sigma=0.03, seed=0, **settings):
    return simulate_matches(n_stars=n_stars, n_exposures=n_exposures, sigma=sigma, dither=100.0, seed=seed, **settings)


def with_junk(sim, names, *, poses=True, seed=0):
    """Random positions at the stated errors in some exposures."""
    table = sim.matches.table.copy()
    for k, name in enumerate(names):
        on = table["exposure"] == name
        for column in ("x", "y"):
            table[column][on] = RNG([seed, k, column == "x"]).uniform(0, 2047, on.sum()) * u.pix
    return Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses if poses else None)


def moved(sim, exposures, size, *, seed=0, share=1.0, common=False):
    """A share of the positions in some exposures off by about `size` pixels: all alike, or each by itself."""
    table = sim.matches.table.copy()
    shift = RNG([seed, 99]).normal(0, size, (table["star"].max() + 1, 2))
    for k, name in enumerate(exposures):
        on = np.flatnonzero((table["exposure"] == name) & (RNG([seed, k]).random(len(table)) < share))
        off = shift[table["star"][on]] if common else RNG([seed, k, 7]).normal(0, size, (len(on), 2))
        table["x"][on] += off[:, 0] * u.pix
        table["y"][on] += off[:, 1] * u.pix
    return Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)


def error(solution, sim):
    """Gauge-free error b."""
    return accuracy.bias(solution.estimate.positions, sim.truth.positions[solution.estimate.star_names], removed=3)


# --- exposures that contradict the others ------------------------------------------------------------------------


@pytest.mark.parametrize("known", [True, False], ids=["prior", "no prior"])
@pytest.mark.parametrize(("n_exposures", "junk"), [(4, ["exp01"]), (11, ["exp00"]), (6, ["exp02", "exp05"])])
def test_junk_is_named_and_left_out_and_costs_nothing(n_exposures, junk, known):
    sim = precise(n_exposures)
    prior = Prior(sim.truth.static) if known else None
    with warns_here(AssumptionWarning, match="is left out: most of its stars lie nowhere near") as caught:
        solution = solve(with_junk(sim, junk), prior=prior)
    assert list(solution.left_out) == junk
    assert [str(w.message).split()[1] for w in caught] == junk
    good = solve(sim.matches.without(dict.fromkeys(junk, "by hand")), prior=prior, clip=None)
    assert error(solution, sim) == pytest.approx(error(good, sim), rel=1e-6)
    assert error(solution, sim) < 1.5 * accuracy.expected_bias(good, removed=3) * (1 if known else 2)


@pytest.mark.parametrize("n_junk", [1, 3])
def test_poses_are_those_of_the_exposures_that_agree(n_junk):
    """The exposure with most stars, which makes the plane, is one of those that are wrong."""
    sim = precise(10)
    names, counts = np.unique(sim.matches.table["exposure"], return_counts=True)
    junk = sorted(names[np.argsort(-counts, kind="stable")][:n_junk].tolist())
    matches = with_junk(sim, junk, poses=False)
    for name in matches.poses.keys() - set(junk):
        scale = similarity.describe(matches.poses[name])["scale"]
        assert scale == pytest.approx(similarity.describe(sim.truth.poses[name])["scale"], abs=5e-3), name
    with warns_here(AssumptionWarning, match="is left out"):
        solution = solve(matches)
    assert list(solution.left_out) == junk


@pytest.mark.slow
def test_a_few_pixels_are_found_by_the_fit():
    """Errors far below those that pairs show, far above those stated."""
    sim = precise(5)
    with warns_here(AssumptionWarning, match="exp02 is left out: .* of its 39 stars deviate from the solution"):
        solution = solve(moved(sim, ["exp02"], 3.0))
    assert list(solution.left_out) == ["exp02"]
    good = solve(sim.matches.without({"exp02": ""}), clip=None)
    assert error(solution, sim) == pytest.approx(error(good, sim), rel=1e-3)


def permuted(sim, names):
    """Exposures that agree with one another in that all have the stars mixed up in the same way."""
    table = sim.matches.table.copy()
    order = RNG(5).permutation(table["star"].max() + 1)
    on = np.isin(table["exposure"], names)
    table["star"][on] = order[table["star"][on]]
    table.sort(["exposure", "star"])
    return Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)


def test_two_groups_are_both_named():
    sim = precise(6)
    groups = "stars of exp00, exp02, exp04 do not lie as those of exp01, exp03, exp05; match them anew"
    with pytest.raises(SolveError, match=groups):
        solve(permuted(sim, ["exp01", "exp03", "exp05"]))
    with pytest.raises(SolveError, match="stars of exp00 do not lie as those of exp01; match"):
        solve(with_junk(precise(2), ["exp01"]))


def test_the_larger_group_is_right():
    sim = precise(7)
    with warns_here(AssumptionWarning, match="is left out"):
        solution = solve(permuted(sim, ["exp00", "exp03", "exp05"]))
    assert list(solution.left_out) == ["exp00", "exp03", "exp05"]


@pytest.mark.parametrize("size", [1000.0, 3.0], ids=["by pairs", "by the fit"])
def test_two_do_not_outvote_one(size):
    sim = precise(3)
    wrong = with_junk(sim, ["exp01"]) if size > 100 else moved(sim, ["exp01"], size)
    with pytest.raises(SolveError, match="stars of exp00, exp02 do not lie as those of exp01; match them anew, or"):
        solve(wrong)


def test_three_outvote_three_that_do_not_agree():
    sim = precise(6, n_stars=60)
    junk = ["exp01", "exp02", "exp04"]
    with warns_here(AssumptionWarning, match="is left out"):
        assert list(solve(with_junk(sim, junk)).left_out) == junk


# --- stars -------------------------------------------------------------------------------------------------------


def thin(seed, poor):
    """Exposures of a cubic map by numpy alone; the stars of some of them are few, or on a line."""
    rng, tables = RNG(seed), []
    plane = rng.uniform(0, 2047, (60, 2))
    if "line" in poor.values():
        plane[:20, 0] = 200.0
    for i in range(6):
        z = plane / 1023.5 - 1
        terms = np.stack([z[:, 0] ** a * z[:, 1] ** b for a in range(4) for b in range(4 - a) if a + b > 1], axis=1)
        xy = plane + rng.uniform(-50, 50, 2) + terms @ rng.normal(0, 0.2, (7, 2)) + rng.normal(0, 0.02, (60, 2))
        keep = np.ones(60, dtype=bool)
        if (how := poor.get(f"e{i}")) == "few":
            keep = np.arange(60) < 8
        elif how == "line":
            keep = np.arange(60) < 20
        stars = np.flatnonzero(keep)
        columns = {"x": xy[keep, 0] * u.pix, "y": xy[keep, 1] * u.pix}
        columns |= dict.fromkeys(("x_err", "y_err"), np.full(len(stars), 0.02) * u.pix)
        tables.append(QTable({"exposure": np.full(len(stars), f"e{i}"), "star": stars, **columns}))
    return Matches.from_table(vstack(tables), shape=SHAPE)


@pytest.mark.parametrize("poor", [{"e4": "few"}, {"e1": "few", "e4": "few"}, {"e2": "line"}])
def test_exposures_of_few_stars_or_a_strip_do_not_cost_the_others(poor):
    matches = thin(3, poor)
    with warnings.catch_warnings(record=True, action="always") as caught:
        solution = solve(matches)
    told = [str(each.message) for each in caught if "is left out" in str(each.message)]
    assert set(solution.left_out) == set(poor)
    assert [name for name in poor if any(f"exposure {name} is left out: its" in words for words in told)] == [*poor]
    assert 0.8 < solution.chi2 / solution.dof < 1.2
    check = {each.name: each for each in solution.checks}["rejection"]
    assert (check.state, "--prior-sigma evidence" in check.cure) == ("warn", True)
    assert "do not determine its distortion" in check.sentence


def test_what_most_exposures_do_not_determine_is_no_fault_of_some():
    with pytest.raises(SolveError, match="exposure e0 has 8 stars, fewer than the 10 modes of degree 3"):
        solve(thin(3, dict.fromkeys(("e0", "e1", "e2"), "few")))


def test_a_star_seen_twice_that_contradicts_itself_has_no_position():
    sim = precise(6)
    table = sim.matches.table
    table = table[(table["star"] != 7) | np.isin(table["exposure"], ["exp01", "exp04"])]
    table["y"][(table["star"] == 7) & (table["exposure"] == "exp04")] += 2 * u.pix
    matches = Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)
    with warns_here(
        AssumptionWarning, match=r"1 star has no position, .* no majority: 7 \(exp01, exp04\); if a check .*; else look"
    ) as told:
        solution = solve(matches)
    assert len(told) == 1
    assert "floor" not in str(told[0].message)  # the others agree with their errors: none would be found
    assert not solution.residuals["used"][solution.residuals["star"] == 7].any()
    assert solution.residuals["used"][solution.residuals["star"] != 7].all()
    assert np.isnan(solution.estimate.positions[7]).all()
    assert np.isfinite(np.delete(solution.estimate.positions, 7, axis=0)).all()
    assert f"{len(matches.stars)} stars (1 without a position)" in repr(solution)


@pytest.mark.parametrize(("n_wrong", "has_position"), [(1, True), (2, False)])
def test_a_majority_of_the_observations_is_believed(n_wrong, has_position):
    """Of four; the wrong ones agree with one another."""
    sim = precise(8)
    table = sim.matches.table
    table = table[(table["star"] != 3) | (table["exposure"] < "exp04")]
    mine = np.flatnonzero(table["star"] == 3)
    table["x"][mine[:n_wrong]] += 3 * u.pix
    matches = Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        solution = solve(matches)
    assert len(told) == (not has_position)
    assert np.isfinite(solution.estimate.positions[3]).all() == has_position
    assert solution.residuals["used"][mine].tolist() == [has_position and k >= n_wrong for k in range(4)]


@no_position
@pytest.mark.parametrize("share", [0.05, 0.10])
def test_many_mismatches_cost_little_and_no_exposure(share):
    sim = precise(8, n_stars=120)
    matches = moved(sim, sim.matches.names, 20.0, share=share)
    wrong = (
        np.hypot(matches.table["x"] - sim.matches.table["x"], matches.table["y"] - sim.matches.table["y"]) > 1 * u.pix
    )
    solution = solve(matches)
    assert not solution.left_out
    assert not np.any(solution.residuals["used"] & wrong)
    assert np.count_nonzero(~solution.residuals["used"] & ~wrong) < 0.02 * len(wrong)  # of stars without majority
    clean = solve(Matches.from_table(sim.matches.table[~wrong], shape=SHAPE, poses=sim.matches.poses), clip=None)
    assert error(solution, sim) < 1.1 * error(clean, sim)


@pytest.mark.slow
def test_the_choice_of_the_degree_decides_mismatches_once_a_degree(monkeypatch):
    """Not anew in each of the fits that leave some stars out; and they do not sway it."""
    sim = precise(4, n_stars=34, degree=1)
    bad = sim.matches.table.copy()
    bad["x"][[7, 50, 91]] += [300, -40, 25] * u.pix
    matches = Matches.from_table(bad, shape=SHAPE, poses=sim.matches.poses)
    calls, clipped = [], clipping.solve_clipped
    monkeypatch.setattr(clipping, "solve_clipped", lambda *a, **k: calls.append(1) or clipped(*a, **k))
    prior = Prior(sim.truth.static)
    chosen = solve(matches, prior=prior, degree="auto").diagnostics.selection
    clean = solve(sim.matches, prior=prior, degree="auto", clip=None).diagnostics.selection
    assert chosen.degree == clean.degree == 1
    assert chosen.scores == pytest.approx(clean.scores, rel=0.2)
    assert 3 <= len(calls) <= len(chosen.degrees) + 2  # with the alarm and the solution itself


# --- clean data --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1.0, 1.5])
@pytest.mark.parametrize(
    "n_exposures", [2, pytest.param(3, marks=pytest.mark.slow), 4, pytest.param(11, marks=pytest.mark.slow)]
)
def test_clean_data_are_solved_as_without_clipping(n_exposures, noise):
    sim = precise(n_exposures, noise=noise, seed=1)
    solution, plain = solve(sim.matches), solve(sim.matches, clip=None)
    assert solution.settings.clip == 5
    assert plain.settings.clip is None
    assert solution.residuals["used"].all()
    np.testing.assert_array_equal(solution.estimate.positions, plain.estimate.positions)


def test_no_more_is_left_out_than_leaves_something_to_judge_by():
    """Two wrong positions, four degrees of freedom: without the two anything fits, and nothing tells what is wrong."""
    sim = simulate_matches(n_exposures=6, n_stars=7, degree=2, sigma=0.01, seen=0.93, seed=34)
    table = sim.matches.table.copy()
    table["x"][[3, 20]] += 1 * u.pix
    matches = Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)
    solution = solve(matches, degree=2, prior=Prior(sim.truth.static))
    assert solution.residuals["used"].all()
    assert solution.dof == 4
    assert {check.name: check.state for check in solution.checks}["chi2"] == "fail"


@pytest.mark.parametrize(
    "n_sets", [pytest.param(24, marks=pytest.mark.slow), pytest.param(200, marks=pytest.mark.sets)]
)
def test_clean_sets_lose_nothing(n_sets):
    """Half of them of three exposures; and errors stated 1.5 times too small."""
    n_rejected = 0
    for seed in range(n_sets):
        sim = precise(3 if seed % 2 else 6, n_stars=25, seed=seed, noise=1.5 if seed % 4 > 1 else 1.0)
        solution = solve(sim.matches, prior=Prior(sim.truth.static) if seed % 3 else None)
        assert not solution.left_out
        n_rejected += np.count_nonzero(~solution.residuals["used"])
    assert n_rejected <= 2


# --- the same exposure twice -------------------------------------------------------------------------------------


def copied(sim, name, new, rows=slice(None)):
    copy = sim.matches.table[sim.matches.table["exposure"] == name][rows]
    copy.replace_column("exposure", [new] * len(copy))
    return vstack([sim.matches.table, copy])


def test_a_copy_in_a_table_counts_once():
    sim = precise(5)
    with warns_here(AssumptionWarning, match="counts as one: again: its positions are those of exp03 to the last bit"):
        matches = Matches.from_table(copied(sim, "exp03", "again"), shape=SHAPE)
    assert matches.names == sim.matches.names
    assert "those of exp03 to the last bit" in matches.left_out["again"]
    poses = sim.matches.poses | {"again": sim.matches.poses["exp03"]}
    both = Matches.from_table(copied(sim, "exp03", "again"), shape=SHAPE, poses=poses, allow_copies=True)
    assert both.names[-1] == "again"


def test_a_copy_in_detections_counts_once():
    sim = precise(5)
    table = copied(sim, "exp03", "zagain")
    del table["star"]
    with warns_here(AssumptionWarning, match="counts as one: zagain: its positions are those of exp03 to the last bit"):
        matches = match(table, shape=SHAPE)
    assert "zagain" not in matches.names
    assert list(matches.left_out) == ["zagain"]


@pytest.mark.parametrize(("n_same", "n_own", "is_copy"), [(5, 4, True), (4, 0, False), (5, 5, False), (30, 0, True)])
def test_what_is_a_copy(n_same, n_own, is_copy):
    xy = RNG(0).uniform(0, 2047, (40, 2))
    other = np.concatenate([xy[:n_same], RNG(1).uniform(0, 2047, (n_own, 2))])
    exposure = np.repeat([0, 1], [len(xy), len(other)])
    assert repetitions.copies(exposure, np.concatenate([xy, other])) == ({1: 0} if is_copy else {})
    nearly = np.concatenate([xy, np.nextafter(other, 3000)])
    assert repetitions.copies(exposure, nearly) == {}


def test_a_copy_of_a_copy_is_one_of_the_first():
    xy = RNG(0).uniform(0, 2047, (20, 2))
    assert repetitions.copies(np.repeat([0, 1, 2], 20), np.tile(xy, (3, 1))) == {1: 0, 2: 0}


@pytest.mark.parametrize(("n_common", "is_copy"), [(1000, True), (501, True), (500, False)])
@pytest.mark.parametrize("digits", [None, 2])
def test_copies_of_long_lists(n_common, is_copy, digits):
    """Of which only a part is looked at first; positions rounded in the file are nothing but a few bits."""
    xy = RNG(2).uniform(0, 2048, (5, 1000, 2))
    xy = xy if digits is None else np.round(xy, digits)
    xy[3, :n_common] = xy[1, RNG(3).permutation(1000)[:n_common]]
    found = repetitions.copies(np.repeat(np.arange(5), 1000), xy.reshape(-1, 2))
    assert found == ({3: 1} if is_copy else {})


@pytest.mark.parametrize("columns", [1, 21])
def test_copies_of_long_lists_whose_stars_stand_in_columns(columns):
    """Some of which are looked at first are perhaps none."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x = rng.choice(rng.uniform(0, 2048, columns), (3, 1000))
        xy = np.stack([x, rng.uniform(0, 2048, x.shape)], axis=2)
        xy[2] = xy[0]
        assert repetitions.copies(np.repeat(np.arange(3), 1000), xy.reshape(-1, 2)) == {2: 0}


def test_an_only_exposure_and_its_copy_are_one():
    sim = precise(2)
    table = copied(sim, "exp00", "again")
    with warns_here(AssumptionWarning, match="counts as one"):
        matches = Matches.from_table(table[table["exposure"] != "exp01"], shape=SHAPE)
    assert len(matches.names) == 1
    with pytest.raises(MatchError, match="only one exposure"):
        solve(matches)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    return simulate_exposures(small=True, n_exposures=5, seed=1).write(folder)


def test_a_file_given_twice_is_one_exposure(frames, tmp_path):
    renamed, moved_to = tmp_path / "renamed.fits", tmp_path / frames[2].name
    shutil.copy(frames[0], renamed)
    shutil.copy(frames[2], moved_to)
    left_out, paths = {}, [*frames, renamed, moved_to, frames[1]]
    words = (
        rf"counts as one: renamed: its pixels are those of exp00; exp02: .* exp02 \({frames[2]} and {moved_to}\); exp01"
    )
    with warns_here(AssumptionWarning, match=words):
        exposures = open_exposures(paths, left_out=left_out)
    assert [exposure.name for exposure in exposures] == [path.stem for path in frames]
    assert left_out == {"renamed": "its pixels are those of exp00"}


@pytest.mark.slow
def test_the_command_measures_it_once(frames, tmp_path, capsys):
    shutil.copy(frames[0], tmp_path / "renamed.fits")
    out = str(tmp_path / "stars.ecsv")
    assert main(["measure", *map(str, frames[:2]), str(tmp_path / "renamed.fits"), "--out", out, "--quiet"]) == 0
    assert "renamed: its pixels are those of exp00" in capsys.readouterr().err


# --- thresholds: each matters, and lies where it is said to ------------------------------------------------------


@pytest.mark.parametrize(
    ("n_off", "n", "share", "verdict"),
    [
        (5, 5, 0.05, True),  # 0.05^5 = 3e-7
        (4, 4, 0.05, False),  # 6e-6
        (6, 6, 0.0975, True),  # 9e-7
        (5, 5, 0.0975, False),  # 9e-6
        (500, 1000, 0.05, False),  # no more than half
        (501, 1000, 0.05, True),
    ],
)
def test_what_is_beyond_chance(n_off, n, share, verdict):
    """Against the binomial distribution, summed."""
    assert pair_agreement.GROSS == 0.05
    assert pair_agreement.beyond_chance(n_off, n, share) == verdict


def pair(off, n=40, seed=0):
    """Two exposures of a square field, the second sheared, its stars off by this part of the side, in any direction."""
    xy, angle = RNG(seed).uniform(0, 1000, (n, 2)), RNG(seed + 1).uniform(0, 2 * np.pi, n)
    sheared = xy @ np.array([[1.02, 0.03], [-0.01, 0.98]]) + 50
    return xy, sheared + off * 1000 * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize(("off", "agree"), [(0.005, True), (0.4, False)])
def test_pairs_agree_or_contradict(off, agree):
    xy = np.concatenate(pair(off))
    found = pair_agreement.compare(np.repeat([0, 1], 40), np.tile(np.arange(40), 2), xy)
    assert found == pair_agreement.Verdict(*(((0, 1), (), ()) if agree else ((0,), (1,), ())))


@pytest.mark.parametrize("seed", range(3))
def test_a_star_is_off_from_four_percent_of_the_field(seed):
    near = [pair_agreement._n_near(*pair(off, n=100, seed=2 * seed)) for off in (0.03, 0.035, 0.045, 0.05)]
    assert near[0] > 90
    assert near[1] > 60
    assert near[2] < 45
    assert near[3] < 30


def test_few_stars_tell_nothing():
    """Of five even all may be gross errors: 0.0975^5 = 9e-6."""
    for n in (3, 4, 5):
        xy = np.concatenate([pair(0, n)[0], pair(0, n, seed=9)[0]])
        found = pair_agreement.compare(np.repeat([0, 1], n), np.tile(np.arange(n), 2), xy)
        assert found == pair_agreement.Verdict((0,), (), ())


def test_seven_stars_may_agree():
    for n, group in ((6, (0,)), (7, (0, 1))):
        found = pair_agreement.compare(np.repeat([0, 1], n), np.tile(np.arange(n), 2), np.concatenate(pair(0, n)))
        assert found.group == group


def test_what_many_pairs_cost_is_bounded(monkeypatch):
    """16 partners of each, 100 stars of a pair."""
    seen, near = [], pair_agreement._n_near
    monkeypatch.setattr(pair_agreement, "_n_near", lambda a, b: seen.append(len(a)) or near(a, b))
    xy = RNG(0).uniform(0, 1000, (150, 2))
    found = pair_agreement.compare(np.repeat(np.arange(40), 150), np.tile(np.arange(150), 40), np.tile(xy, (40, 1)))
    assert found.group == tuple(range(40))
    assert set(seen) == {100}
    assert 40 * 16 / 2 <= len(seen) <= 40 * 16


def exposures_of(*n_off_of_n):
    """A problem as `agreement` looks at it, and which of its observations are good."""
    counts = [n for _, n in n_off_of_n]
    start = np.concatenate([[0], np.cumsum(counts)])
    names = [f"{n_off} of {n}" for n_off, n in n_off_of_n]
    problem = SimpleNamespace(names=names, start=start, part=lambda i: slice(start[i], start[i + 1]))
    problem.n_exposures, problem.night = len(names), 0
    problem.star, problem.xy = np.arange(start[-1]), np.zeros((2, start[-1]))  # no star is in two of them
    return problem, np.concatenate([np.arange(n) >= n_off for n_off, n in n_off_of_n])


def test_exposures_that_a_fit_cannot_follow():
    """Five of six are 1.8e-6 by chance, six of seven 1e-7; of one that has nothing left nothing is known."""
    problem, good = exposures_of((5, 6), (6, 7), (30, 60), (31, 60), (2, 2))
    assert list(agreement.unfollowed(problem, good)) == ["6 of 7", "31 of 60", "2 of 2"]


def test_start_values_are_doubted_from_one_percent_of_the_detector():
    problem = SimpleNamespace(shapes=[(1000, 2000), (1000, 2000)])
    assert start_values.far_off(problem, np.array([19.0, 21.0])).tolist() == [False, True]


def test_an_exposure_is_misplaced_from_ten_times_the_usual_distance():
    problem = SimpleNamespace(shapes=[(2000, 2000)] * 6)
    found = start_values.misplaced(problem, np.array([5.0, 5.0, 5.0, 5.0, 47.0, 53.0]))
    assert np.flatnonzero(found).tolist() == [5]


def fitted(sim, **options):
    """Problem and plain fit."""
    fit = single_fit.minimise(sim.matches, SolveOptions(clip=None, prior=Prior(sim.truth.static), **options))
    return fit.problem, fit.result


@pytest.mark.parametrize(("noise", "explained"), [(1.0, True), (1.8, True), (2.2, False)])
def test_stated_errors_may_be_half_of_what_is_seen(noise, explained):
    assert clipping.is_explained(*fitted(precise(10, n_stars=100, noise=noise)), clip=5.0) == explained


def test_the_largest_deviation_of_chance_is_no_cause():
    """In one of a hundred sets of 600 to 700 observations one deviates by sqrt(2 ln 65000) = 4.7 standard errors."""
    sim = precise(10, n_stars=70, noise=0.0)
    table = sim.matches.table.copy()
    table["x"][333] += 0.1 * u.pix

    def with_pull(pull, clip):
        trial = table.copy()
        trial["x"][333] = sim.matches.table["x"][333] + 0.1 * u.pix * pull / unit
        matches = Matches.from_table(trial, shape=SHAPE, poses=sim.matches.poses, allow_copies=True)
        return clipping.is_explained(*fitted(replace(sim, matches=matches)), clip=clip)

    matches = Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses, allow_copies=True)
    problem, result = fitted(replace(sim, matches=matches))
    assert 600 < problem.xy.shape[1] < 720
    unit = clipping.deviations(problem, result.state, result.robust).max()
    assert [with_pull(pull, 3.0) for pull in (4.6, 4.85)] == [True, False]
    assert [with_pull(pull, 5.0) for pull in (4.9, 5.1)] == [True, False]


def test_deviations_are_in_standard_errors():
    """Rms of both axes together, over sets with true errors: few stars, many modes."""
    squares, largest = [], 0.0
    for seed in range(6):
        problem, result = fitted(precise(4, n_stars=20, seed=seed))
        pull = clipping.deviations(problem, result.state, result.robust)
        squares.append(np.mean(pull**2) / 2)
        largest = max(largest, pull.max())
        raw = np.sqrt(criterion.squares(problem, result.blocks.residual))
        assert np.all(pull <= raw / np.sqrt(clipping.LEAST_FREE) * (1 + 1e-9))
    assert np.mean(squares) == pytest.approx(1, abs=0.2)
    assert largest < 5


def test_what_hardly_anything_else_tells_is_not_blown_up():
    """Of two positions of a star one is ten times as precise: it makes the fit, and little of it is left to deviate."""
    sim = precise(6)
    table = sim.matches.table
    table = table[(table["star"] != 7) | np.isin(table["exposure"], ["exp01", "exp04"])]
    row = np.flatnonzero((table["star"] == 7) & (table["exposure"] == "exp04"))[0]
    table["x_err"][row] = table["y_err"][row] = 0.003 * u.pix
    problem, result = fitted(replace(sim, matches=Matches.from_table(table, shape=SHAPE, poses=sim.matches.poses)))
    here = np.arange(len(table))[problem.order] == row
    raw = np.sqrt(criterion.squares(problem, result.blocks.residual))[here]
    pull = clipping.deviations(problem, result.state, result.robust)[here]
    np.testing.assert_allclose(pull, raw / np.sqrt(0.1))


def test_an_exposure_that_bends_more_than_others_does_not_contradict_them():
    """Widths of a prior are found in steps; at the first ones the fit cannot follow it."""
    sim = precise(3, dynamic=0.2)
    dynamic = sim.truth.dynamic.copy()
    dynamic[1] *= 5
    truth = replace(sim.truth, dynamic=dynamic)
    seen = np.ones((3, len(truth.positions)), dtype=bool)
    matches = matches_from(truth, seen, np.full((*seen.shape, 2), 0.03), RNG(0))
    solution = solve(matches, prior=Prior(truth.static, sigma="evidence"))
    assert solution.residuals["used"].all()
    assert not solution.left_out


# --- where the search for gross errors begins --------------------------------------------------------------------


@no_position
@pytest.mark.parametrize(
    ("share", "size", "serves"),
    [
        (0.01, 0.3, True),
        pytest.param(0.02, 0.3, True, marks=pytest.mark.sets),
        pytest.param(0.04, 0.2, True, marks=pytest.mark.slow),
        pytest.param(0.3, 20.0, False, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("compiled_from", [pytest.param(0, marks=pytest.mark.slow), 20_000])
def test_a_plain_fit_leads_to_the_same_observations_as_robust_start_values(
    share, size, serves, compiled_from, monkeypatch
):
    monkeypatch.setattr("legdistort.solving.equations.problem.COMPILED_FROM", compiled_from)
    sim = precise(10, n_stars=60)
    matches = moved(sim, sim.matches.names, size, share=share, seed=3)
    begun, start_from = [], clipping.start_from
    monkeypatch.setattr(clipping, "start_from", lambda *a: begun.append(start_from(*a)) or begun[-1])
    new = solve(matches, prior=Prior(sim.truth.static))
    assert (begun[0] is not None) == serves  # many gross errors spoil the plain fit
    monkeypatch.setattr(clipping, "start_from", lambda *a: None)
    old, used = solve(matches, prior=Prior(sim.truth.static)), np.asarray(new.residuals["used"])
    assert np.array_equal(used, old.residuals["used"])
    assert not used.all()
    clean = Matches.from_table(matches.table[used], shape=SHAPE, poses=sim.matches.poses)
    clean = solve(clean, prior=Prior(sim.truth.static), clip=None)
    seen = np.isin(new.estimate.star_names, clean.estimate.star_names)
    if serves:  # the plane of the nominal poses; errors are 0.02 px
        assert np.abs(new.estimate.positions[seen] - clean.estimate.positions).max() < 0.004
    for each in (new, old):
        pose = similarity.fit_similarity(each.estimate.positions[seen], clean.estimate.positions)
        assert np.abs(similarity.apply(pose, each.estimate.positions[seen]) - clean.estimate.positions).max() < 1e-4


@pytest.mark.parametrize("unequal", [False, True])
def test_leverages_of_some_observations_are_those_among_all(unequal):
    sim = precise(6, sigma=RNG(0).uniform(0.02, 0.2, (6, 40, 2)) if unequal else 0.03)
    problem, result = fitted(sim)
    every = leverages(problem, result.blocks)
    rows = np.sort(RNG(1).choice(problem.xy.shape[1], 50, replace=False))
    for some, each in zip(leverages(problem, result.blocks, rows=rows), every, strict=True):
        np.testing.assert_allclose(some, each[rows], rtol=1e-12)
    # taken up by the stars and by the exposures: the traces of the projections on either, mean of the axes
    np.testing.assert_allclose([each.sum() for each in every], [40, 6 * 10], rtol=1e-6)
