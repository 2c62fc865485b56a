"""The checks of a solution: their statistics against refits, their words, what they see and what they leave alone."""

import json
import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import dense_model
import drawn_sets
import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import vstack
from scipy import ndimage

import legdistort as ld
from legdistort.assessment.run_checks import check_run, image_check
from legdistort.assessment.stack_quality import Quality
from legdistort.cli import main
from legdistort.exceptions import LegdistortWarning
from legdistort.reporting.page import render
from legdistort.results.check import Check, in_facts, worst
from legdistort.runtime.notebook import text_of
from legdistort.simulation.pupil import PupilPSF
from legdistort.solving.checks.cures import header_first
from legdistort.solving.checks.residual_tests import Residuals
from legdistort.solving.checks.solution_checks import _of_published, errors_check
from legdistort.solving.equations.reduced_system import Direct

SIGMA = 0.14


def simulated(seed=0, **options):
    return ld.simulate_matches(**{"n_exposures": 6, "n_stars": 60, "degree": 2, "sigma": SIGMA, "seed": seed} | options)


def solved(matches, **options):
    return ld.solve(matches, **{"degree": 2, "clip": None} | options)


def changed(matches, table):
    return ld.Matches.from_table(table, shape=(2048, 2048), poses={n: matches.poses[n] for n in matches.names})


def residuals(solution):
    parts = solution.estimate.checked.keywords
    return Residuals(parts["problem"], parts["state"], parts["blocks"], parts["uncertainty"].system, solution.dof)


def states(solution):
    return {check.name: check.state for check in solution.checks}


@pytest.mark.parametrize(("chi2", "state"), [(410.0, "pass"), (560.0, "warn"), (2400.0, "fail")])
def test_chi2_is_judged_of_what_is_published(chi2, state):
    """What holding the common map leaves in the residuals is no fault of errors, but it is in positions."""
    solution = replace(solved(simulated().matches), chi2=chi2, dof=400.0)
    check = _of_published(errors_check(solution, SimpleNamespace(chi2=400.0, dof=400.0)), solution)
    assert check.state == state
    assert ("the common map of positions and distortions is held" in check.cure) == (state != "pass")


def design(found):
    """All columns of the linear problem in units of the errors, (2 n, unknowns), with equal errors."""
    problem, blocks = found.problem, found.blocks
    n, n_stars, n_modes = problem.xy.shape[1], problem.n_stars, problem.n_modes
    columns = np.zeros((2, n, 2 * n_stars + problem.n_exposures * 2 * n_modes))
    for axis in (0, 1):
        for a in (0, 1):
            columns[axis, np.arange(n), a * n_stars + problem.star] = blocks.coupling[a, axis] / problem.weight[0]
        for i in range(problem.n_exposures):
            first = 2 * n_stars + (2 * i + axis) * n_modes
            columns[axis, problem.part(i), first : first + n_modes] = blocks.values[:, problem.part(i)].T
    return columns.reshape(2 * n, -1) / SIGMA


def fitted(columns):
    """Orthonormal columns that span what is fitted, without what only rounding makes independent."""
    u_, size, _ = np.linalg.svd(columns, full_matrices=False)
    return u_[:, size > 1e-4 * size[0]]


@pytest.mark.parametrize("n_exposures", [4, 8])
def test_score_of_the_next_degree_is_the_chi2_that_a_refit_gains(n_exposures):
    matches = simulated(n_exposures=n_exposures, n_stars=80, static=0.01, dynamic=0.01).matches
    low, high = solved(matches), solved(matches, degree=3)
    found = residuals(low)
    score, degree = found.next_degree
    assert degree == 3
    assert found.released.shape[2] == 0  # such small distortions have no second order
    assert score.t == pytest.approx(low.chi2 - high.chi2, rel=0.01)
    assert score.nu == pytest.approx(low.dof - high.dof, rel=0.01)


@pytest.mark.parametrize("n_stars", [30, 150])  # with an exact trace, and by random combinations
def test_score_of_motions_has_the_mean_that_dense_algebra_gives(n_stars):
    times, turns = np.array([0.0, 0.1, 1.0, 1.1, 2.5]), [0, 90, 180, 10, 20]
    found = residuals(solved(simulated(n_exposures=5, n_stars=n_stars, rotations=turns).matches))
    score = found.of_motion(times)
    columns = design(found)
    n, stars = len(columns) // 2, columns[:, : 2 * found.problem.n_stars]
    moved = stars * np.tile(times[found.exposure], 2)[:, None]
    p = fitted(moved - (q := fitted(stars)) @ (q.T @ moved))
    assert score.t == pytest.approx(np.sum((p.T @ found.whitened.ravel()) ** 2), rel=1e-6)
    known = np.concatenate([columns, found.released.reshape(2 * n, -1)], axis=1)
    free = p - (q := fitted(known)) @ (q.T @ p)
    assert score.nu == pytest.approx(np.sum(free**2), rel=1e-3 if n_stars == 30 else 0.02)


def test_stars_that_move_are_seen_where_the_camera_is_turned():
    simulation = simulated(1, n_exposures=8, n_stars=80, rotations=[0, 180] * 4)
    table = simulation.matches.table.copy()
    exposure, star = (np.unique(table[name], return_inverse=True)[1] for name in ("exposure", "star"))
    v = 0.4 * SIGMA * np.random.default_rng(1).normal(size=(80, 2))[star] * np.where(exposure % 2, -1, 1)[:, None]
    for axis, each in zip("xy", v.T, strict=True):
        table[axis] += each * exposure * u.pix
    moving, still = (solved(changed(simulation.matches, t)) for t in (table, simulation.matches.table))
    assert states(moving)["time"] == "fail"
    assert states(still)["time"] == "pass"


def test_score_of_cells_is_the_chi2_that_a_dense_fit_gains():
    found = residuals(solved(simulated(n_exposures=6, n_stars=50, dither=500.0).matches))
    n = found.problem.xy.shape[1]
    cells = (found.problem.xy[0] > 1024).astype(int) + 2 * (found.problem.xy[1] > 700)
    score, shown = found.of_cells(cells)
    moved = np.zeros((2, n, 2, 4))
    for axis in (0, 1):
        moved[axis, np.arange(n), axis, cells] = 1
    known = np.concatenate([design(found), found.released.reshape(2 * n, -1)], axis=1)
    e = found.whitened.ravel()

    def left(columns):
        return np.sum((e - (q := fitted(columns)) @ (q.T @ e)) ** 2)

    assert score.nu == 6  # of 8 displacements one in each axis is a shift of all exposures
    gained = left(known) - left(np.concatenate([known, moved.reshape(2 * n, -1) / SIGMA], axis=1))
    assert score.t == pytest.approx(gained, rel=0.05)
    columns, q = moved.reshape(2 * n, -1) / SIGMA, fitted(known)
    assert shown == pytest.approx(np.sum((columns - q @ (q.T @ columns)) ** 2), rel=0.01)


@pytest.mark.parametrize(
    ("taken", "state"),
    [
        ({"dither": 0.5}, "unknown"),
        pytest.param({}, "pass", marks=pytest.mark.slow),
        pytest.param({"rolls": 30.0, "dither": 0.0}, "pass", marks=pytest.mark.slow),
    ],
)
def test_what_stars_would_hide_is_not_said_to_be_absent(taken, state):
    """A pattern of the detector of 0.1 px goes into the stars where nothing moves them over it; numpy alone."""
    data, truth = dense_model.drawn_set(20, **taken)
    pattern = 0.1 * np.sin(data["xy"] * 6 * np.pi / 2048)
    for xy, wanted in (
        (data["xy"], (state,)),
        (data["xy"] + pattern, ("unknown",) if state == "unknown" else ("fail",)),
    ):
        solution = ld.solve(drawn_sets.as_matches(data | {"xy": xy}), prior=ld.Prior(truth["static"]), clip=None)
        found = {check.name: check for check in solution.checks}
        assert found["place"].state in wanted
        assert (found["degree"].state == "unknown") is (state == "unknown")
    if state == "unknown":
        assert "would go into the stars" in found["place"].sentence
        assert "of what changes between exposures; what they have in common" in found["degree"].sentence
        assert "turned camera" in found["place"].cure


@pytest.mark.slow
def test_statistics_have_the_mean_they_state():
    found = [residuals(solved(simulated(seed, n_exposures=4, n_stars=30).matches)) for seed in range(25)]
    for get in (
        lambda r: r.next_degree[0],
        lambda r: r.of_motion(np.arange(4)),
        lambda r: r.of_groups(r.exposure)[1],
        lambda r: r.of_groups((r.problem.xy[0] > 1500).astype(int))[1],
    ):
        scores = [get(r) for r in found]
        pull = np.array([(s.t - s.nu) / np.sqrt(2 * s.nu) for s in scores])
        assert abs(pull.mean()) < 0.6
        assert pull.std() < 1.5


def test_freedom_of_observations_sums_to_that_of_chi2():
    solution = solved(simulated(dither=300.0).matches)
    found = residuals(solution)
    assert found.freedom.sum() == pytest.approx(solution.dof - found.released.shape[2])


@pytest.mark.slow
def test_chi2_of_few_observations_is_about_one_where_the_gauge_has_a_second_order():
    found, values = [], []
    for seed in range(20):
        matches = ld.simulate_matches(
            n_exposures=4, n_stars=30, sigma=0.02, degree=3, static=4.0, dynamic=1.0, seed=seed
        ).matches
        solution = ld.solve(matches, degree=3, clip=None)
        of = residuals(solution)
        found.append(of.released.shape[2] / solution.dof)
        values.append(of.chi2 / of.dof)
    assert np.mean(found) > 0.08  # of the degrees of freedom, taken off the residuals
    assert np.mean(values) == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize("clip", [None, 5])
def test_the_last_system_of_the_minimisation_serves_checks_and_errors(clip):
    table = (matches := simulated(1).matches).table.copy()
    table["x"][[3, 77]] += (0 if clip is None else 40) * SIGMA * u.pix
    solution = solved(changed(matches, table), clip=clip)
    parts = solution.estimate.checked.keywords
    made = parts["uncertainty"].system
    again = Direct(parts["problem"], parts["blocks"], solution.gauge)
    assert parts["problem"].weight[0].all() == (clip is None)
    assert made.covariance() == pytest.approx(again.covariance(), rel=1e-9, abs=1e-15)
    assert made.information == pytest.approx(again.information, rel=1e-6, abs=1e-6)


@pytest.mark.slow
def test_second_order_of_the_gauge_costs_no_chi2_and_is_no_fault_of_the_degree():
    """Many precise positions show where a common map is held at a value that is not the true one: it is not held."""
    matches = ld.simulate_matches(n_exposures=20, n_stars=400, sigma=0.02, degree=3, static=1.5, seed=5).matches
    solution = ld.solve(matches, degree=3, clip=None)
    found = residuals(solution)
    assert solution.chi2 - found.chi2 < 1
    assert states(solution)["degree"] == "unknown"  # not "fail"; there are no dithers


@pytest.mark.parametrize("seed", range(12))
def test_clean_sets_pass(seed):
    n_exposures, n_stars = (4, 30) if seed % 2 else (12, 80)
    solution = solved(simulated(seed, n_exposures=n_exposures, n_stars=n_stars, dither=200.0).matches)
    assert worst(solution.checks) in ("pass", "unknown")
    assert [c.name for c in solution.checks if c.state == "unknown"] == ["absolute"]


def spoiled(kind):
    matches = simulated(3, n_exposures=9).matches
    table, rng = matches.table.copy(), np.random.default_rng(1)
    exposure = np.unique(table["exposure"], return_inverse=True)[1]
    if kind == "chi2":
        table["x_err"] /= 1.3
        table["y_err"] /= 1.3
    elif kind == "chi2, too large":
        table["x_err"] *= 1.3
        table["y_err"] *= 1.3
    elif kind == "time":
        v = rng.normal(0, 0.3 * SIGMA, (60, 2))[table["star"]] * exposure[:, None]
        table["x"] += v[:, 0] * u.pix
        table["y"] += v[:, 1] * u.pix
    elif kind == "degree":
        x = 2 * table["x"].value / 2048 - 1
        table["y"] += SIGMA * rng.choice([-1, 1], 9)[exposure] * (5 * x**3 - 3 * x) * u.pix
    elif kind == "place":
        table["x"] += 3 * SIGMA * np.sign(table["x"].value - 1024) * np.sign(table["y"].value - 1024) * u.pix
    elif kind == "duplicates":
        again = table[exposure == 3].copy()
        again["exposure"] = "exp99"
        again["x"] += rng.normal(0, 0.3 * SIGMA, len(again)) * u.pix
        table = vstack([table, again])
        poses = matches.poses | {"exp99": matches.poses["exp03"]}
        return ld.Matches.from_table(table, shape=(2048, 2048), poses=poses)
    elif kind == "rejection":
        wrong = rng.random(len(table)) < 0.2
        table["x"][wrong] += rng.uniform(10, 20, wrong.sum()) * u.pix
    elif kind == "exposures":
        table["x"][exposure == 5] += rng.normal(0, 2.5 * SIGMA, np.sum(exposure == 5)) * u.pix
    elif kind == "completeness":
        table.remove_rows(np.flatnonzero(exposure == 5)[20:])
    elif kind in ("brightness", "brightness, faint"):
        table["flux"] = np.geomspace(1, 1000, 60)[table["star"]]
        wrong = table["flux"] < 10 if "faint" in kind else table["flux"] > 100
        table["x"][wrong] += rng.normal(0, 1.5 * SIGMA, wrong.sum()) * u.pix
    return changed(matches, table)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("chi2", r"; --errors scale would bring chi2/dof to 1\.00"),
        ("chi2, too large", r"; --errors scale would bring chi2/dof to 1\.00"),
        ("time", "stars move in the order of the exposures"),
        ("degree", "--degree 3"),
        ("duplicates", "residuals of exp03 and exp99 are the same"),
        ("rejection", "observations .* were left out"),
        ("exposures", r"larger than those of the others in exp05 \(\d\.\d+ times\); look at the frame"),
        ("completeness", "exp05 has 20 of the"),
        ("brightness", "the brightest third"),
        ("brightness, faint", "the faintest third"),
    ],
)
def test_what_is_wrong_is_seen_and_said(kind, words):
    solution = solved(spoiled(kind), clip=5 if kind == "rejection" else None)
    name = kind.partition(",")[0]
    check = next(c for c in solution.checks if c.name == name)
    assert check.state in ("warn", "fail")
    assert check.cure
    assert re.search(words, str(check))
    assert any(name in line for line in str(solution).splitlines()[1:8])


def test_motions_go_with_the_times_where_they_are_known():
    # three exposures of one night and three years later: little moves from one to the next, much between the years
    matches = simulated(6, n_exposures=6).matches
    table, rng = matches.table.copy(), np.random.default_rng(1)
    years = np.array([0, 0.001, 0.002, 3, 3.001, 3.002])[np.unique(table["exposure"], return_inverse=True)[1]]
    v = rng.normal(0, 0.4 * SIGMA, (60, 2))[table["star"]]
    for k, axis in enumerate("xy"):
        table[axis] += v[:, k] * years * u.pix
    table["epoch"] = (2018.0 + years) * u.yr
    dated = next(c for c in solved(changed(matches, table)).checks if c.name == "time")
    assert dated.state != "pass"
    assert "stars move with time" in dated.sentence
    assert dated.cure == "fit the motions of the stars: --motion proper"
    table["epoch"] = 2018.0 + years / 3000
    assert (
        "within one night measured places drift, not stars"
        in next(c for c in solved(changed(matches, table)).checks if c.name == "time").cure
    )
    late = np.argsort(
        np.argsort([3, 0, 4, 1, 5, 2])[np.unique(table["exposure"], return_inverse=True)[1]], kind="stable"
    )
    table["epoch"] = (2018.0 + years) * u.yr
    shuffled = next(c for c in solved(changed(matches, table[late])).checks if c.name == "time")
    assert shuffled.value == pytest.approx(dated.value, rel=1e-3)


def test_what_may_be_the_cause_is_named_first():
    table = spoiled("degree").table.copy()
    noisy = table["exposure"] == "exp05"
    table["y"][noisy] += np.random.default_rng(2).normal(0, 4 * SIGMA, noisy.sum()) * u.pix
    checks = {check.name: check for check in solved(changed(simulated(3, n_exposures=9).matches, table)).checks}
    assert checks["degree"].cure.startswith("--degree 3 would bring chi2/dof to ")
    assert checks["exposures"].cure.startswith("see degree first, which may be the cause; else look at the frame")


def test_a_pattern_on_the_detector_is_seen_where_exposures_are_dithered():
    matches = simulated(2, n_exposures=10, n_stars=120, dither=600.0).matches
    table = matches.table.copy()
    table["x"] += 2 * SIGMA * np.sign(table["x"].value - 1024) * np.sign(table["y"].value - 1024) * u.pix
    assert states(solved(changed(matches, table)))["place"] != "pass"
    assert states(solved(matches))["place"] == "pass"


@pytest.mark.slow
def test_a_pattern_too_small_to_matter_passes_and_is_said():
    matches = simulated(2, n_exposures=12, n_stars=500, dither=300.0).matches
    table = matches.table.copy()
    pattern = np.sign(table["x"].value - 1024) * np.sign(table["y"].value - 1024)

    def place(size):
        moved = table.copy()
        moved["x"] += size * SIGMA * pattern * u.pix
        return next(c for c in solved(changed(matches, moved)).checks if c.name == "place")

    slight, large = place(0.19), place(0.45)
    assert slight.state == "pass"
    assert "too little to matter" in slight.sentence
    assert large.state == "warn"


def test_frames_with_stars_in_one_corner_are_called_extrapolated():
    matches = simulated(3, n_exposures=6, n_stars=300).matches
    table = matches.table[(matches.table["x"].value < 900) & (matches.table["y"].value < 900)]
    solution = solved(ld.Matches.from_table(table, shape=(2048, 2048), poses=matches.poses), degree=1)
    check = next(c for c in solution.checks if c.name == "extrapolation")
    assert check.state == "warn"
    assert check.value > 0.8


def test_dithers_that_leave_a_small_overlap_are_no_lack_of_stars():
    simulation = simulated(3, n_exposures=4, n_stars=300, dither=600.0, min_exposures=4)
    seen = np.unique(simulation.matches.table["star"], return_counts=True)[1]
    assert (seen == 4).all()

    def found(matches):
        return next(c for c in solved(matches, degree=1).checks if c.name == "extrapolation")

    everywhere = found(simulation.matches)
    assert everywhere.state == "pass"
    assert everywhere.value > 0.5
    x = simulation.truth.positions[:, 0][simulation.matches.table["star"]]
    half = simulation.matches.table[x < np.median(x)]
    assert found(changed(simulation.matches, half)).state == "warn"


def test_a_degree_too_high_is_said():
    matches = simulated(4, n_exposures=8, n_stars=80, degree=1).matches
    check = next(c for c in solved(matches, degree=3).checks if c.name == "degree")
    assert check.state == "warn"
    assert check.cure.startswith("--degree 2, or --prior-sigma evidence")


def test_exposures_that_are_not_distorted_are_said_to_be_so():
    matches = simulated(4, n_exposures=8, n_stars=80, static=0.0, dynamic=0.0).matches
    assert states(solved(matches))["dynamic part"] == "warn"
    assert states(solved(matches, prior=ld.Prior(None, sigma="evidence")))["dynamic part"] == "pass"


def test_errors_that_were_found_are_said_to_be_and_judged_as_they_are():
    table = simulated(5).matches.table.copy()
    table["x_err"] /= 2
    table["y_err"] /= 2
    matches = changed(simulated(5).matches, table)
    assert solved(matches).checks[0].state == "fail"
    for errors, words in (
        ("floor", "errors from a floor of .* px found here"),
        ("scale", r"errors scaled by \S+, found here"),
    ):
        check = solved(matches, errors=errors).checks[0]
        assert check.state == "pass"
        assert check.value == pytest.approx(1, abs=0.05)
        stated = re.search(rf"{words}.*\((\S+) at the stated errors\)", check.sentence)
        assert float(stated[1]) == pytest.approx(4, rel=0.3)
    assert not check.cure


def test_a_distortion_of_the_headers_that_is_not_used_is_a_warning():
    matches = replace(simulated(1).matches, header_distortion="SIP of up to 1.2 px")
    with pytest.warns(ld.exceptions.AssumptionWarning):
        solution = solved(matches)
    check = next(c for c in solution.checks if c.name == "header distortion")
    assert check.state == "warn"
    assert "1.2 px" in check.sentence
    known = solved(matches, prior=ld.Prior(np.full((2, 6), 0.1), static_sigma=1.0))
    assert states(known)["header distortion"] == "pass"


def test_checks_are_kept_in_files_and_summaries(tmp_path):
    solution = solved(spoiled("chi2"))
    solution.write(tmp_path / "s.asdf")
    again = ld.Solution.read(tmp_path / "s.asdf")
    assert again.checks == solution.checks
    assert str(again) == str(solution)


def test_strict_ends_with_status_3(tmp_path, capsys):
    solution = solved(changed(simulated(5).matches, _too_precise(simulated(5).matches.table)))
    solution.write(tmp_path / "s.asdf")
    assert main(["show", str(tmp_path / "s.asdf")]) == 0
    assert main(["show", str(tmp_path / "s.asdf"), "--strict"]) == 3
    assert main(["show", str(tmp_path / "s.asdf"), "--strict", "--json"]) == 3
    captured = capsys.readouterr()
    assert "fail" in captured.err
    shown = json.loads(captured.out[captured.out.rindex("\n{\n") :])
    assert shown["checks"][0]["state"] == "fail"


def _too_precise(table):
    table = table.copy()
    table["x_err"] /= 3
    table["y_err"] /= 3
    return table


@pytest.mark.usefixtures("undrawn")
def test_report_leads_with_the_verdict():
    page = render(solved(spoiled("chi2")))
    assert page.index("Something should be looked at") < page.index("Degrees of freedom".lower())
    assert "What to do:" in page


def test_lines_have_the_worst_first():
    checks = [
        Check("a", "pass", 1, None, "fine"),
        Check("b", "warn", 1.5, 1, "odd", "look"),
        Check("c", "fail", float("nan"), 1, "wrong", "stop"),
    ]
    assert worst(checks) == "fail"
    assert checks[2].value is None
    assert text_of(in_facts(checks)).splitlines() == [
        "checks  1 of 3 pass: a",
        "fail    c: wrong; stop",
        "warn    b: odd; look",
    ]
    assert worst([]) == "pass"


def quality(exposures, *, ratio=1.0):
    return Quality(20, 4.5, 0.05, 0.03, 0.01, ratio, 1.0, exposures=exposures)


def test_a_run_is_asked_for_odd_frames_and_a_blurred_stack():
    solution = solved(simulated().matches)
    rng = np.random.default_rng(2)
    draws = rng.normal(size=(8, 3)) * [0.1, 0.01, 5] + [4.5, 0.05, 20]
    alike = {f"exp{i:02d}": tuple(each) for i, each in enumerate(draws)}
    good = {c.name: c.state for c in check_run(solution, quality(alike))}
    assert good == {"images": "pass", "sharpness": "pass", "inverse": "pass"}
    trailed, blurred = alike | {"exp03": (4.5, 0.09, -70)}, alike | {"exp05": (7.0, 0.05, 20)}
    images = check_run(solution, quality(trailed, ratio=1.2))
    assert [c.state for c in images] == ["warn", "warn", "pass"]
    assert "exp03 are unlike" in images[0].sentence
    assert "ellipticity 0.09 at -70 degrees from x, in the mean of the others 0.05 at 2" in images[0].sentence
    assert "1.2" in images[1].sentence
    assert "exp05 are unlike those of the others: FWHM 7.00 px, usually 4.49" in image_check(quality(blurred)).sentence
    assert image_check(None).state == "unknown"


def test_frames_that_differ_by_chance_are_alike():
    rng = np.random.default_rng(3)
    for n, turning in ((4, 5), (11, 5), (40, 5), (4, 180), (11, 180), (40, 180)):
        draws = rng.normal(size=(60, n, 3)) * [0.1, 0.02, turning] + [np.log(4.5), 0.1, 20]
        draws[:, :, 0] = np.exp(draws[:, :, 0])
        states_ = [image_check(quality({str(i): tuple(each) for i, each in enumerate(night)})) for night in draws]
        assert sum(c.state != "pass" for c in states_) <= 1


@pytest.mark.slow
def test_a_trailed_frame_is_seen_in_a_run(tmp_path):
    night = ld.simulate_exposures(small=True, seed=2, n_exposures=9, psf=PupilPSF(strehl=0.3, elongation=0.5))
    paths = night.write(tmp_path / "night")
    with fits.open(paths[2]) as hdulist:
        pixels, header = hdulist[0].data.astype(float), hdulist[0].header
        steps = np.linspace(-1.4, 1.4, 9)  # one FWHM along x
        trailed = np.mean([ndimage.shift(pixels, (0, step), order=1, mode="nearest") for step in steps], axis=0)
        trailed = np.rint(trailed + np.random.default_rng(0).normal(0, 4, trailed.shape))
        fits.writeto(paths[2], np.clip(trailed, 0, 65535).astype(np.uint16), header, overwrite=True)
    result = ld.run(paths, out=tmp_path / "out", degree=3, psf="moffat")
    found = {check.name: check for check in result.checks}
    assert found["images"].state == "warn"
    assert "exp02" in found["images"].sentence
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert {check["name"] for check in summary["checks"]} >= {"chi2", "images", "sharpness", "inverse"}
    assert "exp02 are unlike" in (tmp_path / "out" / "report.html").read_text()


def test_all_exposures_that_are_worse_are_named():
    matches = simulated(3, n_exposures=12).matches
    table, rng = matches.table.copy(), np.random.default_rng(1)
    for name, factor in (("exp02", 5), ("exp07", 6)):
        rows = np.flatnonzero(table["exposure"] == name)
        table["x"][rows] += factor * rng.normal(0, SIGMA, len(rows)) * u.pix
    check = next(c for c in solved(changed(matches, table), clip=None).checks if c.name == "exposures")
    assert re.search(r"in exp07 \(\S+ times\), exp02 \(\S+ times\); look at the frames .* leave them out", str(check))


class TestDuplicates:
    """Noise that two exposures share, told from what they share beside it; sets of `dense_model`, numpy alone."""

    def of(self, data, **options):
        with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
            solution = ld.solve(drawn_sets.as_matches(data), **options)
        return next(c for c in solution.checks if c.name == "duplicates")

    def refracted(self, seed, size=0.3):
        """Stars are displaced by their colours, along a direction that turns through the night."""
        data, rng = dense_model.drawn_set(seed)[0], np.random.default_rng(seed)
        colour = rng.normal(size=data["star"].max() + 1)[data["star"]]
        angle = np.deg2rad(np.linspace(-60, 60, 11))[data["exposure"]]
        return data | {"xy": data["xy"] + size * (colour * np.stack([np.sin(angle), np.cos(angle)])).T}

    def again(self, data, noise=0.3):
        """With exposure 3 measured once more."""
        rows = data["exposure"] == 3
        xy = data["xy"][rows] + noise * np.random.default_rng(1).normal(size=(rows.sum(), 2)) * data["err"][rows]
        new = {"xy": xy, "err": data["err"][rows], "star": data["star"][rows], "exposure": np.full(rows.sum(), 11)}
        new["poses"] = data["poses"][3:4]
        return data | {key: np.concatenate([data[key], value]) for key, value in new.items()}

    @pytest.mark.parametrize("per_epoch", [2, 4])
    def test_three_epochs_of_motions_are_no_alarm(self, per_epoch):
        """Residuals of one epoch follow from those of the others; they are not the noise of copies."""
        epochs = np.repeat([2010.0, 2013.0, 2016.0], per_epoch)
        sim = simulated(4, n_exposures=len(epochs), epochs=epochs, motion=0.3)
        check = next(c for c in solved(sim.matches, motion="proper").checks if c.name == "duplicates")
        assert check.state == "pass"
        assert abs(check.value) < 0.6

    def test_stars_with_too_few_exposures_tell_nothing(self):
        sim = simulated(4, n_exposures=3, epochs=[2010.0, 2013.0, 2016.0], motion=0.3)
        check = next(c for c in solved(sim.matches, motion="proper").checks if c.name == "duplicates")
        assert check.state == "unknown"

    def test_correlations_are_those_of_the_noise(self):
        """Of drawn noise that exposures 3 and 11 share by 0.8, with an exposure that is three times as noisy."""
        data = self.again(dense_model.drawn_set(5, n_stars=400, errors=(0.02, 0.02))[0], noise=0.75)
        with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
            solution = ld.solve(drawn_sets.as_matches(data), clip=None)
        value = residuals(solution).correlations()[0]
        assert value[3, 11] == pytest.approx(1 / np.hypot(1, 0.75), abs=0.08)
        others = value[np.triu_indices(12, 1)]
        assert abs(np.mean(others[others < 0.5])) < 0.02
        assert np.abs(others[others < 0.5]).max() < 0.3

    @pytest.mark.slow
    def test_what_exposures_share_beside_their_noise_makes_no_copies_of_them(self):
        check = self.of(self.refracted(6))
        assert check.state == "warn"
        assert "have a pattern in common, beyond their noise" in check.sentence
        assert "leave one of them out" not in check.cure
        assert check.cure.startswith("see ")

    @pytest.mark.slow
    def test_a_copy_is_found_among_exposures_that_share_a_pattern(self):
        check = self.of(self.again(self.refracted(6)))
        assert check.state == "fail"
        assert "residuals of e03 and e11 are the same" in check.sentence

    def test_errors_that_are_too_large_hide_no_copy_and_make_none(self):
        data = dense_model.drawn_set(7)[0]
        assert self.of(data | {"err": 3 * data["err"]}).state == "pass"
        copied = self.again(data)
        assert self.of(copied | {"err": 3 * copied["err"]}).state == "fail"


def test_without_degrees_of_freedom_residuals_tell_nothing():
    """As many observations as unknowns: every solution fits them."""
    sim = ld.simulate_matches(n_exposures=6, n_stars=7, degree=2, sigma=0.003, static=3.0, seen=0.93, seed=52)
    solution = ld.solve(sim.matches, degree=2)
    assert solution.dof == 0
    states = {check.name: check.state for check in solution.checks}
    assert {name for name, state in states.items() if state == "unknown"} == {
        "chi2", "exposures", "place", "time", "degree", "absolute", "duplicates"
    }  # fmt: skip
    assert "no degrees of freedom are left to judge it by" in str(solution.checks[1])


def departures(seed, *, prior=True, **setting):
    """Exposures that `factors` names as odd, and what the check says, of a set made of numpy alone."""
    data, truth = dense_model.drawn_set(seed, **setting)
    prior = ld.Prior(truth["static"]) if prior else None
    solution = ld.solve(drawn_sets.as_matches(data), degree=3, prior=prior, clip=None)
    sentence = next(check.sentence for check in solution.checks if check.name == "dynamic part")
    found = [t["name"] for t in solution.factors if t["name"].startswith("departure")]
    assert ("\nodd     exposures depart" in str(solution)) is bool(found)
    return found, sentence


@pytest.mark.parametrize("prior", [True, False])
def test_an_exposure_that_departs_more_than_the_others_is_named(prior):
    found, sentence = departures(0, prior=prior, odd=10.0)
    assert found == ["departure of e10"]
    assert re.search(r"e10 2\d times as far as the others", sentence)


@pytest.mark.slow
def test_exposures_that_depart_alike_or_are_poor_are_not_named():
    for seed in range(6):
        assert departures(seed)[0] == []
        data, truth = dense_model.drawn_set(seed, dynamic=0.02)  # departures smaller than errors of a poor exposure
        rows = data["exposure"] == 5
        data["xy"][rows] += 50 * data["err"][rows] * np.random.default_rng(seed).normal(size=(rows.sum(), 2))
        data["err"][rows] *= 50
        solution = ld.solve(drawn_sets.as_matches(data), degree=3, prior=ld.Prior(truth["static"]))
        assert not [t["name"] for t in solution.factors if t["name"].startswith("departure")]


def test_the_distortion_of_headers_comes_first_where_exposures_hardly_determine_one():
    unused = Check("header distortion", "warn", None, None, "", "--prior header takes it")
    wrong = [Check(name, "fail", 2.0, 1.0, "", "another") for name in ("reference", "degree", "time")]
    loose = Check("extrapolation", "warn", 2.0, 1.0, "", "another")
    told = {check.name: check.cure for check in header_first((*wrong, loose, unused))}
    first = {
        name
        for name, cure in told.items()
        if cure == "--prior header (see header distortion and extrapolation); else another"
    }
    assert first == {"reference", "degree", "extrapolation"}
    assert header_first((*wrong, unused)) == (*wrong, unused)
    assert header_first((*wrong, loose)) == (*wrong, loose)


def test_a_mirrored_exposure_is_named():
    """Of one list x and y are exchanged, of another set x runs the other way: the static distortion is not theirs."""
    table = ld.simulate_matches(n_exposures=6, n_stars=60, dynamic=0.1, seed=5).matches.table
    plain = ld.solve(ld.Matches.from_table(table, shape=(2048, 2048)), degree=2)
    assert "mirrored" not in [check.name for check in plain.checks]
    for exchanged in (lambda x, y: (y, x), lambda x, y: (2047 * u.pix - x, y)):
        other = table.copy()
        of = np.isin(other["exposure"], ["exp01", "exp04"])
        other["x"][of], other["y"][of] = exchanged(table["x"][of].copy(), table["y"][of].copy())
        solution = ld.solve(ld.Matches.from_table(other, shape=(2048, 2048)), degree=2)
        checks = {check.name: check for check in solution.checks}
        assert checks["mirrored"].state == "fail"
        assert checks["mirrored"].exposures == ("exp01", "exp04")
        assert checks["mirrored"].cure.endswith("--without exp01 exp04")
        assert checks["absolute"].state != "pass"


@pytest.mark.filterwarnings("ignore:exposure exp04 is left out")
@pytest.mark.parametrize("scrambled", [0.0, 6.0])
def test_what_is_left_out_beside_a_degree_too_low_may_be_right(scrambled):
    """Exposures that tell of higher terms, such as turned ones, deviate from a fit that has none."""
    table = ld.simulate_matches(n_exposures=8, n_stars=80, dynamic=0.3, degree=3, seed=5).matches.table.copy()
    rows, rng = np.flatnonzero(table["exposure"] == "exp04")[:56], np.random.default_rng(1)
    for axis in "xy":
        table[axis][rows] += rng.normal(0, scrambled, len(rows)) * u.pix
    matches = ld.Matches.from_table(table, shape=(2048, 2048))
    solution = ld.solve(matches, degree=1, prior=ld.Prior(np.zeros((2, 3))))
    checks = {check.name: check for check in solution.checks}
    assert checks["degree"].state == "fail"
    assert checks["absolute"].state == ("fail" if scrambled else "pass")
    assert ("(exp04) are right and the degree is too low" in checks["absolute"].sentence) == bool(scrambled)
    assert checks["rejection"].cure.startswith("see degree first" if scrambled else "")
