"""Pictures: what is drawn is what the solution holds, and every axis says what it is and in which unit."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from drawn_solutions import make_mosaic, make_solution
from matplotlib import pyplot
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection, QuadMesh
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver, QuiverKey
from night_sets import SIZE, Nights
from scipy import stats

from legdistort.assessment.pulls import pulls_of
from legdistort.exceptions import InputError
from legdistort.geometry import basis
from legdistort.matching.matches import Matches
from legdistort.plots import elements, motion_plots, residual_plots, solution_plots, stack_plots
from legdistort.priors.prior import Prior
from legdistort.results import accuracy
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve


@pytest.fixture(autouse=True)
def _close():
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def solution():
    return make_solution()


def texts(ax):
    ax.figure.canvas.draw()
    return ax.get_title(loc="left"), ax.get_xlabel(), ax.get_ylabel()


def grids(ax):
    return {tuple(np.round(c.get_color()[0][:3], 2)): np.array(c.get_segments()) for c in ax.collections}


def color(name):
    from matplotlib.colors import to_rgb

    return tuple(np.round(to_rgb(name), 2))


# -- residuals


def test_residual_arrows_are_the_used_residuals_in_stated_proportion(solution):
    name = solution.names[2]
    ax = solution_plots.plot_residuals(solution[name], scale=500)
    title, xlabel, ylabel = texts(ax)
    assert name in title
    assert "× 500" in title
    assert (xlabel, ylabel) == ("x [px]", "y [px]")
    quiver = next(c for c in ax.collections if isinstance(c, Quiver))
    rows = solution.residuals[(solution.residuals["exposure"] == name) & solution.residuals["used"]]
    np.testing.assert_allclose(quiver.U, rows["dx"].value)
    np.testing.assert_allclose(quiver.V, rows["dy"].value)
    np.testing.assert_allclose(quiver.XY, np.column_stack([rows["x"].value, rows["y"].value]))
    assert quiver.scale == 1 / 500
    assert quiver.angles == quiver.scale_units == "xy"


def test_residuals_have_a_key_and_mark_what_was_not_used(solution):
    view = min(solution, key=lambda each: each.n_stars)
    ax = solution_plots.plot_residuals(view)
    quiver = next(c for c in ax.collections if isinstance(c, Quiver))
    key = next(c for c in ax.get_children() if isinstance(c, QuiverKey))
    assert key.label == f"{key.U:g} px"
    assert 0.03 * 2048 < key.U / quiver.scale <= 0.1 * 2048  # length in pixels of the picture
    assert np.count_nonzero(view.residuals["used"]) == quiver.N
    (crosses,) = ax.lines
    assert len(crosses.get_xdata()) == np.count_nonzero(~view.residuals["used"]) > 0


def test_many_residuals_are_thinned():
    ax = solution_plots.plot_residuals(make_solution(1, 4400, names=["one"])["one"])
    assert next(c for c in ax.collections if isinstance(c, Quiver)).N == 3000


def test_residuals_refuse_what_they_cannot_draw():
    empty = make_solution(2)
    empty.residuals["used"][empty.residuals["exposure"] == empty.names[1]] = False
    with pytest.raises(InputError, match=f"no position of {empty.names[1]} was used"):
        solution_plots.plot_residuals(empty[empty.names[1]])


# -- distortions


def test_grid_is_the_distortion_magnified(solution):
    name = solution.names[3]
    ax = solution_plots.plot_distortion(solution, name)
    assert "× 50" in texts(ax)[0]
    lines = grids(ax)
    straight, bent = lines[color(elements.GREY)], lines[color(elements.BLUE)]
    q = straight.reshape(-1, 2)
    expected = q + 50 * (solution[name].distortion(q) - q)
    np.testing.assert_allclose(bent.reshape(-1, 2), expected, atol=1e-8)
    assert np.ptp(q[:, 0]) == 2048  # edge to edge
    prior = lines[color(elements.ORANGE)].reshape(-1, 2)
    shift = solution.estimate.prior_mean[3] @ basis.values(3, *basis.normalize(q, (2048, 2048)))
    np.testing.assert_allclose(prior, q + 50 * shift.T, atol=1e-8)


def test_dynamic_grid_leaves_the_prior_out(solution):
    ax = solution_plots.plot_distortion(solution, solution.names[0], part="dynamic", scale=10)
    lines = grids(ax)
    assert color(elements.ORANGE) not in lines
    q = lines[color(elements.GREY)].reshape(-1, 2)
    shift = (solution.coefficients[0] - solution.estimate.prior_mean[0]) @ basis.values(
        3, *basis.normalize(q, (2048, 2048))
    )
    np.testing.assert_allclose(lines[color(elements.BLUE)].reshape(-1, 2), q + 10 * shift.T, atol=1e-8)


def test_automatic_magnification_makes_a_tenth_of_the_detector(solution):
    scale = solution_plots.distortion_scale(solution, solution.names)
    t = np.linspace(-0.5, 2047.5, 40)
    q = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    peak = max(np.abs(solution[name].distortion(q) - q).max() for name in solution.names)
    assert 0.03 * 2048 < scale * peak <= 0.1 * 2048 * 1.02


def test_small_multiples_come_in_pages_of_twelve():
    solution = make_solution(15, 10)
    first, second = solution_plots.plot_distortions(solution), solution_plots.plot_distortions(solution, page=1)
    shown = [ax.get_title(loc="left") for ax in (*first, *second)]
    assert shown == list(solution.names)
    assert len(first) == 12
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in first}) == 1  # one scale for the eye
    assert "× 50" in first[0].figure.get_suptitle()
    assert first[0].figure.get_supxlabel() == "x [px]"
    with pytest.raises(InputError, match="page 2 is empty: 15 exposures fill 2 pages"):
        solution_plots.plot_distortions(solution, page=2)


def test_unknown_part_is_refused(solution):
    with pytest.raises(InputError, match="'total', 'nonlinear' or 'dynamic', got 'static'"):
        solution_plots.plot_distortion(solution, solution.names[0], part="static")


# -- coefficients


@pytest.mark.parametrize("degree", [1, 2, 3, 6])
def test_bars_are_the_coefficients_beside_the_prior(degree):
    solution = make_solution(3, 20, degree)
    panels = solution_plots.plot_coefficients(solution, solution.names[1])
    n = basis.n_modes(degree)
    for axis, ax in enumerate(panels):
        heights = {c.get_label(): [bar.get_height() for bar in c] for c in ax.containers if isinstance(c, BarContainer)}
        np.testing.assert_allclose(heights[solution.names[1]], solution.coefficients[1, axis])
        if degree >= 2:
            np.testing.assert_allclose(heights["prior"], solution.estimate.prior_mean[1, axis])
        assert ax.get_ylabel() == f"along {'xy'[axis]} [px]"
    labels = [t.get_text() for t in panels[1].get_xticklabels()]
    assert len(labels) == n
    assert labels[:3] == ["(0, 0)", "(1, 0)", "(0, 1)"]
    assert "orders" in panels[1].get_xlabel()


def test_bars_of_all_exposures_show_mean_and_scatter(solution):
    panels = solution_plots.plot_coefficients(solution)
    bars = {c.get_label(): c for c in panels[0].containers}
    np.testing.assert_allclose([b.get_height() for b in bars["mean"]], solution.coefficients[:, 0].mean(axis=0))
    for name, size in {"scatter": solution.coefficients[:, 0].std(axis=0), "1σ error": 0.01}.items():
        error = bars[name].lines[2][0].get_segments()
        np.testing.assert_allclose([np.ptp(s[:, 1]) / 2 for s in error], size)


def test_odd_nights_are_not_in_the_mean():
    nights = Nights(5, nights=6, per=2, odd=0.5, roll=0.7, n_stars=100)
    solution = solve(Matches.from_table(nights.table, shape=(SIZE, SIZE)))
    like = [not name.startswith(f"n{nights.odd}") for name in solution.names]
    bars = {c.get_label(): c for c in solution_plots.plot_coefficients(solution)[0].containers}
    expected = solution.coefficients[like, 0].mean(axis=0)
    np.testing.assert_allclose([b.get_height() for b in bars["mean but for odd nights"]], expected)


def test_lowest_degree_leaves_out_what_is_like_a_pose(solution):
    panels = solution_plots.plot_coefficients(solution, solution.names[1], lowest=2)
    bars = next(c for c in panels[1].containers if c.get_label() == solution.names[1])
    np.testing.assert_allclose([b.get_height() for b in bars], solution.coefficients[1, 1, 3:])
    assert panels[1].get_xticklabels()[0].get_text() == "(2, 0)"
    with pytest.raises(InputError, match="lowest is 4, but the distortion has modes up to degree 3 only"):
        solution_plots.plot_coefficients(solution, lowest=4)


# -- what the correction does, and residuals


@pytest.fixture(scope="module")
def solved():
    simulated = simulate_matches(n_stars=60, n_exposures=6, degree=3, seed=5)
    return solve(simulated.matches, prior=Prior(simulated.truth.static)), simulated.truth


def ends(ax):
    """Where the lines of a panel begin and end, (n, 2, 2)."""
    return np.array(next(c for c in ax.collections if isinstance(c, LineCollection)).get_segments())


def test_each_step_of_the_correction_leaves_less(solved):
    solution, _ = solved
    panels = residual_plots.plot_steps(solution, scale=100)
    rms = [np.sqrt(np.mean(np.diff(ends(ax), axis=1) ** 2)) / 100 for ax in panels]
    assert [float(ax.get_title(loc="left").splitlines()[1].split()[0]) for ax in panels] == pytest.approx(rms, abs=6e-4)
    corrected = accuracy.corrected_positions(solution)
    expected = np.sqrt(np.nanmean((corrected - np.nanmean(corrected, axis=0)) ** 2))
    assert rms[2] == pytest.approx(expected, rel=1e-6)
    assert rms[2] < min(rms[:2]) / 4
    without = residual_plots.plot_steps(make_solution(4, 30, prior=False))
    assert len(without) == 2


def stated_scales(panels):
    """Magnifications that titles state."""
    return [float(ax.get_title(loc="left").partition(" × ")[2]) for ax in panels]


def test_the_last_step_is_magnified_like_the_one_before_it_and_both_are_seen():
    """Without that, 0.2 and 0.05 px beside 2 px are dots; the scale is the stated one, and that of the bar."""
    simulated = simulate_matches(n_stars=60, n_exposures=6, sigma=0.03, dither=300, dynamic=0.1, pose_error=0, seed=5)
    solution = solve(simulated.matches, prior=Prior(simulated.truth.static))
    panels = residual_plots.plot_steps(solution)
    first, static, last = stated_scales(panels)
    assert 3 * first < static == last
    for ax, scale in zip(panels, (first, static, last), strict=True):
        lengths = np.hypot(*np.diff(ends(ax), axis=1)[:, 0].T)
        if ax is not panels[-1]:
            assert 0.02 * 2048 < np.percentile(lengths, 90) < 0.05 * 2800
        rms = float(ax.get_title(loc="left").splitlines()[1].split()[0])
        assert np.sqrt(np.mean(lengths**2) / 2) == pytest.approx(rms * scale, abs=6e-4 * scale)
        (bar,), (words,) = ax.lines, ax.texts
        drawn = np.ptp(bar.get_xdata()) * np.ptp(ax.get_xlim())  # pixels of the picture
        assert drawn == pytest.approx(float(words.get_text().removesuffix(" px")) * scale)
    two = residual_plots.plot_steps(solution, registered=False)
    assert [ax.get_title(loc="left") for ax in two] == [ax.get_title(loc="left") for ax in panels[1:]]
    assert set(stated_scales(residual_plots.plot_steps(solution, scale=70))) == {70}


def test_mean_residuals_are_as_large_as_their_errors_say(solved):
    solution, _ = solved
    ax = residual_plots.plot_mean_residuals(solution, scale=1000)
    off = np.diff(ends(ax), axis=1)[:, 0] / 1000
    rows = solution.residuals[solution.residuals["used"]]
    side = 2048 / int(np.sqrt(len(rows) / 12))
    start = ends(ax)[3, 0]
    near = np.flatnonzero(
        np.all(np.abs(np.stack([rows["x"].value, rows["y"].value], axis=1) - start) < side / 2, axis=1)
    )
    weight = 2 / (rows["x_err"].value ** 2 + rows["y_err"].value ** 2)[near]
    np.testing.assert_allclose(off[3, 0], np.average(rows["dx"].value[near], weights=weight))
    circles = next(c for c in ax.collections if isinstance(c, EllipseCollection))
    radius = circles._widths[3] / 1000
    assert radius == pytest.approx(1 / np.sqrt(weight.sum()))


def test_pulls_are_one_with_right_errors_and_their_sum_is_chi2():
    sums, factor = [], 2.0
    for seed in range(4):
        solution = solve(simulate_matches(n_stars=60, n_exposures=5, degree=3, seed=seed).matches)
        pulls = pulls_of(solution)
        assert pulls.squares.sum() == pytest.approx(solution.chi2, rel=1e-6)
        assert pulls.freedom.sum() == pytest.approx(solution.dof, rel=1e-6)
        sums.append(pulls.by_star())
    inside = [stats.chi2.cdf(s.rms**2 * s.freedom, s.freedom) for s in sums]
    assert 0.9 < np.mean(np.abs(np.concatenate(inside) - 0.5) < 0.475) < 0.985  # 95 % are expected
    solution.residuals["x_err"] *= factor
    solution.residuals["y_err"] *= factor
    np.testing.assert_allclose(pulls_of(solution).by_exposure().rms, pulls.by_exposure().rms / factor)


@pytest.mark.parametrize("against", ["brightness", "time"])
def test_pulls_are_drawn_by_star_and_by_exposure(solved, against):
    pulls = pulls_of(solved[0])
    ax = residual_plots.plot_pulls(pulls, against=against)
    dots = next(c for c in ax.collections if isinstance(c, PathCollection))
    sums = pulls.by_star() if against == "brightness" else pulls.by_exposure()
    np.testing.assert_allclose(dots.get_offsets()[:, 1], sums.rms)
    assert dots.get_gid().startswith("marks:s=" if against == "brightness" else "marks:e=")
    with pytest.raises(InputError, match="against must be 'brightness' or 'time', got 'x'"):
        residual_plots.plot_pulls(pulls, against="x")


def test_marks_of_what_is_far_off_do_not_shift_those_of_others():
    """A mark off the picture is none in SVG, or several, and every later one would be named after another star."""
    rms = np.array([1.0, 40.0, 1.1, 0.9])
    sums = SimpleNamespace(rms=rms, freedom=np.full(4, 20.0), at=np.array([1.0, 2.0, 4.0, 8.0]), label="flux")
    ax = residual_plots.plot_pulls(SimpleNamespace(by_star=lambda: sums))
    (dots,) = [c for c in ax.collections if isinstance(c, PathCollection)]
    np.testing.assert_array_equal(dots.get_offsets()[:, 1], [1.0, ax.get_ylim()[1], 1.1, 0.9])
    assert dots.get_gid() == "marks:s=0,1,2,3"
    ax = stack_plots.plot_mosaic(make_mosaic(300), stars=[[100, 100], [-900, 50], [200, 250], [50, 9e9], [np.nan, 5]])
    assert ax.collections[0].get_gid() == "marks:s=0,2"
    np.testing.assert_array_equal(ax.collections[0].get_offsets(), [[100, 100], [200, 250]])


def test_points_of_motions_are_marked_with_their_stars():
    simulated = simulate_matches(n_stars=20, n_exposures=6, degree=1, motion=0.05, dither=100,
                                 epochs=[2014, 2014.1, 2016, 2016.1, 2018, 2018.1], seed=2)  # fmt: skip
    solution = solve(simulated.matches, degree=1, motion="proper")
    for ax in (motion_plots.plot_motions(solution), motion_plots.plot_motion_errors(solution)):
        (dots,) = [c for c in ax.collections if isinstance(c, PathCollection)]
        assert dots.get_gid() == "marks:s=" + ",".join(map(str, range(20)))
        assert len(dots.get_offsets()) == 20


def test_mosaic_on_a_slope_shows_its_stars_and_no_empty_bands():
    mosaic = make_mosaic(300)
    y, x = np.indices((300, 300))
    slope = 3.0 * x + 2.0 * y  # of noise 2
    off = stack_plots.smooth_sky(mosaic.data + slope) - stack_plots.smooth_sky(mosaic.data) - slope
    assert np.ptp(off) < 8  # 1500 before
    assert np.std(off) < 1
    ax = stack_plots.plot_mosaic(SimpleNamespace(data=mosaic.data + slope))
    assert ax.get_xlim() == (9.5, 299.5)


def test_no_orange_bars_without_prior():
    solution = make_solution(2, 20, prior=False)
    for ax in solution_plots.plot_coefficients(solution):
        assert [c.get_label() for c in ax.containers if c.get_label() == "prior"] == []


# -- scatter against flux


def test_scatter_is_the_rms_of_the_used_residuals_of_each_star(solution):
    ax = solution_plots.plot_scatter(solution)
    points, curve = ax.lines
    rows = solution.residuals[solution.residuals["used"]]
    star = rows[rows["star"] == 7]
    expected = np.sqrt(np.mean((star["dx"].value ** 2 + star["dy"].value ** 2) / 2))
    at = np.argmin(np.abs(points.get_xdata() - star["flux"][0]))
    assert points.get_ydata()[at] == pytest.approx(expected)
    middle = np.hypot(0.8 / np.sqrt(curve.get_xdata()), 0.003)  # the law from which the errors were made
    np.testing.assert_allclose(curve.get_ydata(), middle, rtol=0.05)
    assert ax.get_xscale() == ax.get_yscale() == "log"
    assert texts(ax)[1:] == ("flux [unit of the input]", "rms residual per axis [px]")


def test_without_flux_the_reported_error_takes_its_place():
    ax = solution_plots.plot_scatter(make_solution(2, 30, flux=False))
    assert texts(ax)[1] == "reported error per axis [px]"
    curve = ax.lines[1]
    np.testing.assert_array_equal(curve.get_xdata(), curve.get_ydata())


def test_flux_unit_is_shown_and_unknown_fluxes_are_left_out():
    solution = make_solution(3, 30)
    solution.residuals["flux"] = solution.residuals["flux"] * u.adu
    solution.residuals["flux"][solution.residuals["star"] == 4] = np.nan
    ax = solution_plots.plot_scatter(solution)
    assert ax.get_xlabel() == "flux [adu]"
    assert len(ax.lines[0].get_xdata()) == 29


# -- images


def test_mosaic_is_averaged_in_blocks_and_keeps_its_pixels():
    mosaic = make_mosaic(300)
    ax = stack_plots.plot_mosaic(mosaic, max_size=100, stars=[[10, 20], [200, 250]])
    (image,) = ax.images
    assert image.get_array().shape == (100, 100)
    assert np.ma.getmaskarray(image.get_array())[:, :3].all()  # the strip of 10 pixels without data
    assert image.get_extent() == [-0.5, 299.5, -0.5, 299.5]
    assert texts(ax)[1:] == ("x [px]", "y [px]")
    np.testing.assert_array_equal(ax.collections[0].get_offsets()[:, 0], [10, 200])


def test_block_mean_ignores_what_is_not_finite():
    image = np.arange(35.0).reshape(5, 7)
    image[0, 0] = np.nan
    out = elements.block_mean(image, 2)
    assert out.shape == (3, 4)
    assert out[0, 0] == pytest.approx(np.mean([1, 7, 8]))
    assert out[2, 3] == 34
    image[:2, :2] = np.nan
    assert np.isnan(elements.block_mean(image, 2)[0, 0])


def test_mosaic_without_data_is_refused():
    with pytest.raises(InputError, match="no finite pixel"):
        stack_plots.plot_mosaic(SimpleNamespace(data=np.full((5, 5), np.nan)))


def test_sigma_map_shows_the_rms_of_both_axes():
    x, y = np.linspace(-0.5, 99.5, 6), np.linspace(-0.5, 49.5, 4)
    sigma = np.random.default_rng(0).uniform(0.1, 0.3, (4, 6, 2))
    sigma[0, 0] = np.nan
    ax = solution_plots.plot_sigma_map(x, y, sigma, stars=[[3, 4]])
    mesh = next(c for c in ax.collections if isinstance(c, QuadMesh))
    shown = np.ma.filled(mesh.get_array().reshape(4, 6), np.nan)
    np.testing.assert_allclose(shown, np.sqrt((sigma**2).mean(axis=2)))
    assert ax.get_xlim() == (-0.5, 99.5)
    assert texts(ax)[1:] == ("x [px]", "y [px]")
    assert "[px]" in ax.figure.axes[1].get_ylabel()
    with pytest.raises(InputError, match=r"sigma must have shape \(6, 4\)"):
        solution_plots.plot_sigma_map(y, x, sigma)


# -- all of them


def test_axes_given_are_used_and_nothing_else_is_opened(solution):
    before = pyplot.get_fignums()
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    assert solution_plots.plot_residuals(solution[solution.names[0]], ax=ax) is ax
    assert stack_plots.plot_mosaic(make_mosaic(50), ax=Figure().subplots()).images
    fig = Figure()
    assert solution_plots.plot_coefficients(solution, fig=fig)[0].figure is fig
    assert pyplot.get_fignums() == before


def test_names_are_taken_literally_and_cut():
    name = r"$\frac{a$_b<c>" + "x" * 80
    solution = make_solution(names=[name, "other"], n_stars=20)
    for ax in (
        solution_plots.plot_residuals(solution[name]),
        solution_plots.plot_distortion(solution, name),
        solution_plots.plot_coefficients(solution, name)[0],
    ):
        ax.figure.canvas.draw()  # mathtext would fail here
    assert len(elements.shorten(name)) == 44


@pytest.mark.parametrize(
    ("value", "expected"),
    [(1, 1), (0.99, 0.5), (0.05, 0.05), (4.9, 2), (1000, 1000), (7e-5, 5e-5), (0, 1), (np.inf, 1)],
)
def test_round_down(value, expected):
    assert elements.round_down(value) == pytest.approx(expected)


def test_grid_collections_carry_lines_only(solution):
    ax = solution_plots.plot_distortion(solution, solution.names[0])
    assert all(isinstance(c, LineCollection) for c in ax.collections)


@pytest.mark.parametrize(("largest", "scale"), [(4.0, "linear"), (100.0, "symlog")])
def test_small_coefficients_are_seen_beside_large_ones(largest, scale):
    solution = make_solution(6, 20)
    solution.coefficients[:, 0, 3] += largest
    panels = solution_plots.plot_coefficients(solution, lowest=2, fig=Figure())
    assert [ax.get_yscale() for ax in panels] == [scale, scale]
