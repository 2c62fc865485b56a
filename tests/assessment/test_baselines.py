"""The corrections that the method is compared with, against plain least squares written out here, and their laws."""

import json
import logging

import numpy as np
import pytest
from astropy import units as u
from numpy.testing import assert_allclose

from legdistort.assessment import baselines
from legdistort.cli import parser
from legdistort.exceptions import InputError, SolveError
from legdistort.geometry import similarity
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.reporting import page as report
from legdistort.reporting.comparison import plot_comparison
from legdistort.results import accuracy, in_tables
from legdistort.results.solution import Solution
from legdistort.simulation.observations import simulate_exposures, simulate_gsaoi_matches, simulate_matches
from legdistort.solving.estimation import solve


@pytest.fixture(scope="module")
def night():
    return simulate_gsaoi_matches(small=True, seed=4)


@pytest.fixture(scope="module")
def compared(night):
    prior = Prior(night.truth.static)
    return baselines.compare(night.matches, solve(night.matches, prior=prior), prior=prior)


def by_exposure(matches):
    """Positions (n_exposures, n_stars, 2), NaN where not seen."""
    obs = matches.observations
    out = np.full((len(matches.names), len(matches.stars), 2), np.nan)
    out[obs.exposure, obs.star] = obs.xy
    return out


def test_shifts_are_those_of_two_way_means():
    """All stars seen everywhere: the shift of an exposure is the mean over its stars."""
    sim = simulate_matches(seed=2, n_stars=12, n_exposures=5, dither=0, sigma=np.geomspace(0.01, 1, 12))
    solution = baselines.solve_shifts(sim.matches)
    xy = by_exposure(sim.matches)
    shift = xy.mean(axis=1) - xy.mean(axis=(0, 1))
    corrected = np.stack([solution[name].correct(p) for name, p in zip(solution.names, xy, strict=True)])
    expected = xy - shift[:, None]
    assert_allclose(corrected - corrected.mean(axis=(0, 1)), expected - expected.mean(axis=(0, 1)), atol=1e-8)
    assert_allclose(solution.estimate.positions, corrected.mean(axis=0), atol=1e-8)
    residual = np.column_stack([solution.residuals["dx"].value, solution.residuals["dy"].value])
    assert_allclose(residual, (expected - expected.mean(axis=0)).reshape(-1, 2), atol=1e-8)
    error = sim.matches.table["x_err"].value
    assert solution.chi2 == pytest.approx(((residual / error[:, None]) ** 2).sum())  # by the stated errors
    assert solution.degree == 0


def test_static_map_and_shifts_leave_only_noise_where_nothing_is_dynamic():
    sim = simulate_matches(seed=3, dynamic=0, dither=200, n_stars=60, sigma=0.1)
    prior = Prior(sim.truth.static, sigma=0.3, static_sigma=0.2)  # widths play no part
    solution = baselines.solve_shifts(sim.matches, prior=prior)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=4 * np.sqrt(2 / solution.dof))
    assert_allclose(solution.coefficients[:, :, 1:], np.broadcast_to(sim.truth.static, (10, 2, 10))[:, :, 1:])
    assert accuracy.bias(solution.estimate.positions, sim.truth.positions, removed="similarity") < 0.1
    assert in_tables.rms(baselines.solve_shifts(sim.matches)).max() > 3 * in_tables.rms(solution).max()


def test_errors_of_shifts_are_right_where_the_model_is():
    ratios = []
    for seed in range(30):
        sim = simulate_matches(seed=seed, static=0, dynamic=0, dither=100, n_stars=20, n_exposures=6, sigma=0.2)
        solution = baselines.solve_shifts(sim.matches)
        left = solution.estimate.positions - sim.truth.positions
        left -= left.mean(axis=0)
        stated = np.stack([solution.stars["x_err"].value, solution.stars["y_err"].value])
        ratios.append((left**2).mean() / (stated**2).mean() * 20 / 19)
    assert np.mean(ratios) == pytest.approx(1, abs=4 * np.std(ratios) / np.sqrt(30))
    assert np.std(ratios) / np.sqrt(30) < 0.06


def test_orientations_are_kept_and_noise_in_them_is_not():
    rolls = [0, 90, 180, 270, 0.01, 90]
    sim = simulate_matches(seed=5, static=0, dynamic=0, rotations=rolls, n_exposures=6, n_stars=25, sigma=0.05)
    solution = baselines.solve_shifts(sim.matches)
    angles = np.array([similarity.describe(solution.poses[name])["rotation"] for name in solution.names])
    assert_allclose((angles - [0.005, 90, 180, 270, 0.005, 90] + 180) % 360 - 180, 0, atol=1e-9)
    turned = sim.matches.poses | {"exp01": sim.matches.poses["exp05"]}
    assert_allclose(solution.poses["exp01"][:, :2], turned["exp05"][:, :2], atol=1e-9)


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("reference", [None, "exp03", "mean"])
def test_relative_polynomial_is_that_of_plain_least_squares(reference, weighted):
    """Powers of x and y from the reference positions to an exposure, fitted with numpy."""
    sim = simulate_matches(seed=6, n_stars=40, n_exposures=5, degree=3, dither=120, sigma=np.geomspace(0.02, 0.2, 40))
    solution = baselines.solve_relative(sim.matches, degree=2, reference=reference, weighted=weighted)
    obs, xy = sim.matches.observations, by_exposure(sim.matches)
    stated = np.sqrt(obs.covariance[:, 0])
    sigma = np.full(xy.shape[:2], np.nan)
    sigma[obs.exposure, obs.star] = stated
    if reference == "mean":
        target, error = sim.matches.positions, 1 / np.sqrt(np.nansum(1 / sigma**2, axis=0))
    else:
        i = np.argmax(np.bincount(obs.exposure)) if reference is None else 3
        pose = sim.matches.poses[sim.matches.names[i]]
        target, error = similarity.apply(similarity.invert(pose), xy[i]), sigma[i]
    new = np.random.default_rng(0).uniform(300, 1700, (50, 2))

    def powers(p):
        a, b = ((p - 1000) / 1000).T
        return np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=1)

    for k, name in enumerate(solution.names):
        good = np.isfinite(xy[k, :, 0]) & np.isfinite(target[:, 0]) & np.isfinite(error)
        w = 1 / np.hypot(sigma[k], error)[good, None] if weighted else np.ones((good.sum(), 1))
        c = np.linalg.lstsq(w * powers(target[good]), w * xy[k, good], rcond=None)[0]
        inside = np.isfinite(got := solution[name].distort(new)).all(axis=1)
        assert inside.any()
        assert_allclose(got[inside], (powers(new) @ c)[inside], atol=1e-6)


def test_stars_of_a_relative_solution_are_means_of_corrected_positions():
    sim = simulate_matches(seed=7, n_stars=60, n_exposures=6, dither=150, sigma=0.1)
    solution = baselines.solve_relative(sim.matches, reference="exp02")
    corrected = accuracy.corrected_positions(solution)
    assert_allclose(solution.estimate.positions, np.nanmean(corrected, axis=0), atol=1e-6)
    assert in_tables.rms(solution).max() < 0.13
    assert np.all(solution["exp00"].errors > 0)
    assert_allclose(
        solution["exp02"].distort(solution.estimate.positions[:5]),
        similarity.apply(solution.poses["exp02"], solution.estimate.positions[:5]),
    )


@pytest.mark.slow
def test_relative_errors_hold_in_simulation():
    """Of a coefficient: its departures from the mean of many noise draws on one field."""
    departures, stated = [], None
    for seed in range(40):
        sim = simulate_matches(seed=1, n_stars=40, n_exposures=3, degree=2, dither=0, sigma=0.1, noise=0)
        rng = np.random.default_rng(seed)
        table = sim.matches.table.copy()
        for axis in "xy":
            table[axis] = table[axis] + 0.1 * rng.normal(size=len(table)) * u.pix
            table[f"{axis}_err"] = np.full(len(table), 0.1) * u.pix
        matches = Matches.from_table(table, shape=(2048, 2048), poses=sim.matches.poses)
        solution = baselines.solve_relative(matches, degree=2, reference="exp00", weighted=seed % 2 == 0)
        departures.append(solution.coefficients[1, :, 3:])
        stated = solution["exp01"].errors[:, 3:] if stated is None else stated
    ratio = (np.std(departures, axis=0, ddof=1) ** 2 / stated**2).mean()
    assert ratio == pytest.approx(1, abs=4 * np.sqrt(2 / 39 / 6) + 0.15)  # stated: scaled to one draw's residuals


def test_four_corrections_improve_in_turn(compared):
    assert list(compared) == ["shift", "static + shift", "relative polynomial", "all distortions solved"]
    means = [accuracy.scatter_summary(s)["mean"] for s in compared.values()]
    assert means[0] > 1.2 * means[1] > 3 * means[2] > 3 * 0.95 * means[3]
    counts = {accuracy.scatter_summary(s)["n_stars"] for s in compared.values()}
    assert len(counts) == 1  # on the same stars


def test_baselines_are_whole_solutions(compared, tmp_path):
    for name, solution in list(compared.items())[:3]:
        assert isinstance(solution, Solution)
        assert "absolute errors are not available" in solution.gauge.sentence
        assert np.all(np.isnan(solution.stars["x_err_abs"]))
        assert np.all(np.isfinite(solution.stars["x_err"]))
        assert np.all(solution.residuals["used"])
        assert solution.gauge.sentence in " ".join(str(solution).split())
        assert str(solution.gauge).startswith(name)
        again = Solution.read(solution.write(tmp_path / f"{name}.asdf"))
        assert_allclose(again.estimate.positions, solution.estimate.positions)
        assert np.all(np.isnan(again.stars["y_err_abs"]))
        assert again.settings.method == name
        xy = np.array([[100.0, 200.0]])
        assert_allclose(solution[solution.names[0]].distort(solution[solution.names[0]].correct(xy)), xy, atol=1e-8)


def test_only_used_observations_are_compared(night):
    table = night.matches.table.copy()
    table["x"][3] += 30 * u.pix
    matches = Matches.from_table(table, shape=night.truth.shape, poses=night.matches.poses)
    solution = solve(matches, prior=Prior(night.truth.static), clip=5)
    assert not solution.residuals["used"][3]
    for other in baselines.compare(matches, solution).values():
        assert np.abs(other.residuals["dx"][np.asarray(other.residuals["used"])]).max() < 5 * u.pix


def test_a_correction_that_fails_is_left_out_and_told(caplog):
    sim = simulate_matches(seed=8, n_stars=24, n_exposures=4, dither=0, seen=0.55, degree=2, min_exposures=1)
    solution = solve(sim.matches, degree=2, prior=Prior(np.zeros((2, 6)), sigma=1))
    with caplog.at_level(logging.WARNING, logger="legdistort"):
        made = baselines.compare(sim.matches, solution)
    assert list(made) == ["shift", "all distortions solved"]
    assert "relative polynomial is left out of the comparison: exposure exp03 shares 5 stars" in caplog.text
    with pytest.raises(SolveError, match="shares 5 stars with the reference, fewer than the 6 modes of degree 2: low"):
        baselines.solve_relative(sim.matches, degree=2)


def test_bad_input_is_refused(night):
    with pytest.raises(InputError, match=r"reference must be 'mean' or one of exp00, .*, got 'nobody'"):
        baselines.solve_relative(night.matches, reference="nobody")
    for call in (baselines.solve_shifts, baselines.solve_relative):
        with pytest.raises(InputError, match="matches must be Matches, got QTable"):
            call(night.matches.table)


@pytest.mark.parametrize("with_flux", [True, False])
def test_comparison_is_drawn_with_its_figures(compared, with_flux, night):
    if not with_flux:
        table = night.matches.table.copy()
        table.remove_column("flux")
        matches = Matches.from_table(table, shape=night.truth.shape, poses=night.matches.poses)
        compared = baselines.compare(matches, solve(matches, prior=Prior(night.truth.static)))
    ax = plot_comparison(compared, noise=None if with_flux else lambda e: 2 * e)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert len(texts) == len(compared) + 1
    figures = accuracy.scatter_summary(compared["shift"])
    assert texts[0] == f"shift: {figures['mean']:.3f} ± {figures['std']:.3f} px"
    assert ("flux" in ax.get_xlabel()) == with_flux
    ax.figure.clear()


# --- the criteria on new stars ------------------------------------------------------------------------------------


def test_scatter_of_new_stars_is_that_of_the_noise_and_of_the_correction():
    sim = simulate_matches(seed=9, sigma=0.1, n_stars=60)
    solution = solve(sim.matches, prior=Prior(sim.truth.static))
    xy = sim.truth.grid("exp00", 40)
    measured = accuracy.new_scatter(solution, sim.truth.distort, xy, 0.1, rng=np.random.default_rng(1))
    quiet = accuracy.new_scatter(solution, sim.truth.distort, xy, 0.0)
    noise = np.sqrt(np.mean(measured**2) - np.mean(quiet**2))
    assert noise == pytest.approx(0.1 * np.sqrt(0.9), rel=0.02)  # 10 exposures, 1600 stars
    by_hand = np.stack([solution[name].correct(sim.truth.distort(name, xy)) for name in solution.names])
    assert_allclose(quiet, np.sqrt(by_hand.var(axis=0).mean(axis=1)), rtol=1e-9)
    seen = np.zeros((10, len(xy)), dtype=bool)
    seen[:3] = True
    seen[0, 7] = seen[1, 7] = False
    few = accuracy.new_scatter(solution, sim.truth.distort, xy, 0.0, seen=seen)
    assert np.isnan(few[7])
    assert_allclose(few[8], np.sqrt(by_hand[:3, 8].var(axis=0).mean()), rtol=1e-9)


def test_contour_is_a_square_that_holds_most_stars():
    stars = np.random.default_rng(2).uniform(0, 2047, (200, 2))
    square = accuracy.contour(stars, fraction=0.9)
    assert np.ptp(square, axis=0)[0] == pytest.approx(np.ptp(square, axis=0)[1])
    assert np.count_nonzero(accuracy.in_contour(stars, square)) in (180, 181)
    assert accuracy.in_contour(stars, accuracy.contour(stars, fraction=1)).all()


def test_errors_by_star_make_up_b():
    rng = np.random.default_rng(3)
    true = rng.uniform(0, 1000, (20, 2))
    estimated = true + rng.normal(size=true.shape)
    estimated[4] = np.nan
    b = accuracy.bias_by_star(estimated, true)
    assert np.isnan(b[4]).all()
    assert_allclose(np.delete(b, 4, axis=0), np.delete(estimated - true, 4, axis=0))
    paper = np.sqrt(np.mean(np.sum(np.delete(b, 4, axis=0) ** 2, axis=1)))
    assert accuracy.total(accuracy.bias(estimated, true)) == pytest.approx(paper)
    left = np.delete(accuracy.bias_by_star(estimated, true, removed=1), 4, axis=0)
    design = np.column_stack([np.ones(19), np.delete(true, 4, axis=0)])
    assert_allclose(design.T @ left, 0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_report_has_the_comparison(compared):
    page = report.render(compared["all distortions solved"], comparison=compared)
    assert page.count(">Corrections compared</h2>") == 1
    for name, solution in compared.items():
        s = accuracy.scatter_summary(solution)
        assert f"<tr><td>{name}</td><td>{s['n_stars']}</td><td>{s['mean']:.4f}</td><td>{s['std']:.4f}</td>" in page
    assert "Corrections compared" not in report.render(compared["shift"])


@pytest.mark.slow
def test_run_compares_when_asked(tmp_path, capsys):
    frames = simulate_exposures(small=True, seed=2).write(tmp_path / "frames")
    arguments = ["run", *map(str, frames), "--out", str(tmp_path / "out"), "--compare", "--quiet"]
    assert parser.main(arguments) == 0
    assert "relative polynomial" in capsys.readouterr().out
    figures = json.loads((tmp_path / "out" / "summary.json").read_text())["comparison"]
    assert list(figures) == ["shift", "relative polynomial", "all distortions solved"]  # no prior, no static map
    assert set(figures["shift"]) == {"n_stars", "mean", "std", "mean_total", "std_total"}
    assert figures["shift"]["mean"] > 3 * figures["all distortions solved"]["mean"]
    assert "Corrections compared" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
