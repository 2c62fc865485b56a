"""Views of exposures and of detectors: every method beside something independent, and what they refuse."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from astropy.wcs import WCS
from numpy.polynomial.legendre import leggauss, legval2d
from numpy.testing import assert_allclose, assert_array_equal
from oracle import modes, predict
from scipy.spatial import Delaunay
from sky_chains import sky_of
from two_chips import two_chips_small

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.geometry import similarity
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.exposures import Exposure
from legdistort.results.view import View, error_map, image_view

SKY = TangentPlane(10.0, 20.0, np.array([[-1e-5, 2e-6, 2e-4], [2e-6, 1e-5, -2e-4]]))
PIXELS = np.array([[300.0, 400.0], [1024.0, 1000.0], [1700.0, 350.0], [900.0, 1800.0]])
SIGMA = 0.05


@pytest.fixture(scope="module")
def solution():
    sim = ld.simulate_matches(
        n_exposures=5, n_stars=60, degree=3, sigma=0.02, static=3.0, dynamic=0.3, dither=100.0,
        rotations=10.0 * np.arange(5), zero_mean=False, seed=3,
    )  # fmt: skip
    return replace(ld.solve(sim.matches, prior=ld.Prior(sim.truth.static)), sky=SKY, left_out={"dark": "no stars"})


@pytest.fixture(scope="module")
def view(solution):
    return solution["exp02"]


@pytest.fixture(scope="module")
def several():
    """A solution of two detectors; frame3 has seen a third of the stars that the others have."""
    camera, rng, rows = two_chips_small(), np.random.default_rng(1), []
    ny, nx = camera.field
    stars = rng.uniform(-90, [nx + 90, ny + 90], (260, 2))
    for i in range(6):
        angle = np.radians(15.0 * i)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        f = (stars - [nx / 2, ny / 2]) @ turn.T + [nx / 2, ny / 2] + rng.uniform(-30, 30, 2)
        a, b = (f / [nx, ny] * 2 - 1).T
        f = f + 0.3 * (np.outer(a**2, rng.normal(0, 1, 2)) + np.outer(a * b, rng.normal(0, 1, 2)))
        for key, chip in camera.detectors.items():
            xy = chip.to_pixels(f) + rng.normal(0, SIGMA, f.shape)
            on = np.all((xy > 0) & (xy < np.array(chip.shape[::-1]) - 1), axis=1)
            for star in np.flatnonzero(on):
                if i != 3 or star % 3 == 0:
                    rows.append((f"frame{i}", key, star, *xy[star], SIGMA, 1.3 * SIGMA, 2.0))
    names = ["exposure", "detector", "star", "x", "y", "x_err", "y_err", "fwhm"]
    table = QTable(rows=rows, names=names)
    table = table[np.bincount(table["star"])[table["star"]] >= 3]
    solution = ld.solve(ld.Matches.from_table(table, camera=camera), degree=2, clip=None)
    return replace(solution, sky=SKY), table


# -- which there are


def test_a_solution_holds_its_exposures(solution):
    assert len(solution) == 5
    assert [view.name for view in solution] == list(solution.names) == [f"exp{i:02d}" for i in range(5)]
    assert all(isinstance(view, View) and view.solution is solution for view in solution)
    assert solution["exp03"] == solution["exp03"]
    for key, there in (("exp01", True), (("exp01", "1"), True), ("exp09", False), (("exp01", "2"), False),
                       (("exp09", "1"), False), (3, False), (None, False)):  # fmt: skip
        assert (key in solution) is there, key


def test_unknown_names(solution, several):
    with pytest.raises(InputError, match=r"no exposure 'exp0' in the solution \(do you mean exp0\d or .*\?\); it has"):
        solution["exp0"]
    with pytest.raises(InputError, match=r"no exposure 'nobody' in the solution; it has exp00, exp01, exp02, exp03, e"):
        solution["nobody"]
    with pytest.raises(InputError, match=r"no exposure 'dark' in the solution: it was left out \(no stars\); it has"):
        solution["dark"]
    for key in (2, None, slice(1), ["exp00"], ("exp00", "1", "2")):
        with pytest.raises(InputError, match=r"no exposure .* in the solution"):
            solution[key]
    with pytest.raises(InputError, match=r"exposure exp01 has no detector '2'; it has 1$"):
        solution["exp01", "2"]
    with pytest.raises(InputError, match=r"exposure frame1 has no detector '7'; it has 1, 2$"):
        several[0]["frame1", 7]


def test_ids_may_be_numbers(several):
    solution, _ = several
    assert solution["frame1", 2] == solution["frame1", "2"]
    assert ("frame1", 2) in solution


def test_what_it_is_of(solution, several):
    view = solution["exp03"]
    assert (view.name, view.detector, view.index, view.label, view.detectors) == ("exp03", None, 3, "exp03", ("1",))
    assert view.parts == (view,)
    assert view.chip is None
    assert view.shape == (2048, 2048)
    assert_array_equal(view.pose, solution.poses["exp03"])
    assert_array_equal(view.coefficients, solution.coefficients[3])
    assert_array_equal(view.distortion.coefficients, solution.coefficients[3])
    assert_array_equal(view.prior_mean, solution.estimate.prior_mean[3])
    assert solution["exp03", "1"].label == "exp03"
    camera = several[0].camera
    both, one = several[0]["frame3"], several[0]["frame3", "2"]
    assert (both.name, both.detector, both.label, both.detectors) == ("frame3", None, "frame3", ("1", "2"))
    assert (one.name, one.detector, one.label, one.detectors) == ("frame3", "2", "frame3-2", ("2",))
    assert both.shape == camera.field
    assert both.chip is None
    assert one.shape == (300, 200)
    assert one.chip is camera["2"]
    assert one.index == both.index == 3
    assert both.parts == (several[0]["frame3", "1"], one)
    assert one.parts == (one,)


def test_the_view_of_an_image(solution, several):
    data = np.zeros((30, 20))
    assert image_view(solution, Exposure("exp02", data)) == solution["exp02"]
    assert image_view(solution, Exposure("other", data)) is None
    part = Exposure("frame2-1", data, exposure="frame2", detector="1")
    assert image_view(several[0], part) == several[0]["frame2", "1"]
    assert image_view(several[0], replace(part, detector="3")) is None


# -- an exposure of one detector


def test_there_and_back(view):
    """`distort` is the formula of the paper, `correct` its inverse, the model both."""
    xy = view.correct(PIXELS)
    expected = predict(xy, view.coefficients, view.pose, (2048, 2048))
    assert_allclose(expected, PIXELS, rtol=0, atol=1e-7)
    assert_allclose(view.distort(xy), expected, rtol=0, atol=1e-9)
    assert_array_equal(view.to_reference(PIXELS), xy)
    assert_allclose(np.stack(view.model(*xy.T), axis=1), expected, rtol=0, atol=1e-9)
    assert_allclose(np.stack(view.model.inverse(*PIXELS.T), axis=1), xy, rtol=0, atol=1e-6)
    assert np.isnan(view.distort([[1e5, 0.0]])).all()


def test_forms_of_positions(view):
    """x and y apart, of any shape, numbers and quantities, are what points are."""
    for function, points in ((view.correct, PIXELS), (view.distort, view.correct(PIXELS))):
        expected, (x, y) = function(points), points.T
        assert isinstance(expected, np.ndarray)
        found = function(x, y)
        assert isinstance(found, tuple)
        assert_array_equal(np.stack(found, axis=1), expected)
        square = function(x.reshape(2, 2), y.reshape(2, 2))
        assert [each.shape for each in square] == [(2, 2)] * 2
        assert_array_equal(np.stack(square, axis=-1).reshape(-1, 2), expected)
        number = function(float(x[1]), float(y[1]))
        assert [np.ndim(each) for each in number] == [0, 0]
        assert_allclose(number, expected[1], rtol=0, atol=1e-9)
        along = function(x[0], y)  # of common shape
        assert_array_equal(np.stack(along, axis=1), function(np.column_stack([np.full(4, x[0]), y])))
        assert_array_equal(function(list(map(tuple, points))), expected)
        assert_allclose(function(points[2]), expected[2:3], rtol=0, atol=1e-9)
        assert [each.shape for each in function(np.zeros((0, 3)), np.zeros((0, 3)))] == [(0, 3)] * 2
        unit = function(points * u.pix)
        assert unit.unit == u.pix
        assert_array_equal(unit.value, expected)
        units = function(x * u.pix, y * u.pix)
        assert [each.unit for each in units] == [u.pix] * 2
        assert_array_equal(np.stack([each.value for each in units], axis=1), expected)
        with pytest.raises(InputError, match="positions must be in pixels, got arcsec"):
            function(points * u.arcsec)
        with pytest.raises(InputError, match="positions must be in pixels, got arcsec"):
            function(x * u.arcsec, y * u.arcsec)


def test_errors_and_epochs_with_points(view):
    xy, relative, absolute = view.correct(PIXELS, errors=0.02)
    assert_array_equal(xy, view.correct(PIXELS))
    none = view.correct(PIXELS, errors=0.0)
    back = np.stack([(view.correct(PIXELS + e) - view.correct(PIXELS - e)) / 0.02 for e in 0.01 * np.eye(2)], axis=2)
    for both, alone in ((relative, none.relative), (absolute, none.absolute)):
        assert_allclose(both - alone, 0.02**2 * back @ back.transpose(0, 2, 1), rtol=1e-5)
    with pytest.raises(InputError, match=r"errors go with points: give positions \(n, 2\) in the place of x and y"):
        view.correct(*PIXELS.T, errors=0.02)
    with pytest.raises(InputError, match="give both epoch and stars, or neither"):
        view.correct(PIXELS, epoch=2020.0)


def test_sky(view):
    """The gwcs is pose, distortion and gnomonic projection by the textbook; headers are as close as they say."""
    expected = np.stack(sky_of(view.solution, view.name, similarity.apply(view.pose, view.correct(PIXELS))))
    assert view.wcs.name == "exp02"
    assert_allclose(view.wcs(*PIXELS.T), expected, rtol=0, atol=1e-10)
    for kind in ("sip", "tpv"):
        header = view.header(kind=kind, max_error=0.01)
        found = WCS(header).wcs_world2pix(*expected, 0) if kind == "tpv" else WCS(header).all_world2pix(*expected, 0)
        if kind == "sip":
            assert_allclose(np.stack(found, axis=1), PIXELS, rtol=0, atol=0.011)
        assert header[f"{kind.upper()}MXERR"] <= 0.01
    near = view.fits_wcs(max_error=0.01)
    assert near.array_shape == (2048, 2048)
    assert_allclose(np.stack(near.all_world2pix(*expected, 0), axis=1), PIXELS, rtol=0, atol=0.011)


def test_orientation(view):
    """Of the pose alone, by finite differences at the centre."""
    middle = np.array([[1023.5, 1023.5]])
    (ra, dec), (ra1, dec1) = (np.ravel(sky_of(view.solution, view.name, middle + [0, step])) for step in (-0.5, 0.5))
    east, north = (ra1 - ra) * np.cos(np.radians(dec)), dec1 - dec
    angle, scale = view.orientation
    assert (angle - np.degrees(np.arctan2(east, north)) + 180) % 360 - 180 == pytest.approx(0, abs=0.01)
    assert scale == pytest.approx(np.hypot(east, north) * 3600, rel=1e-3)
    with pytest.raises(InputError, match="no position angle"):
        _ = replace(view.solution, sky=None)[view.name].orientation


def test_orientation_is_that_of_the_pose_and_not_of_the_centre():
    """A cubic along x and y, which has no part of a scale, changes that of the WCS at the centre by 0.6 %."""
    sim = ld.simulate_matches(seed=1, sky=SKY, sigma=0.02, dynamic=0.0)
    cubic = np.zeros((2, 10))
    cubic[0, 6] = cubic[1, 9] = -3.0
    assert np.sqrt(np.sum(cubic**2, axis=1)) / 2 == pytest.approx(1.5)

    def bent(q):
        u, v = ((2 * q + 1) / 2048 - 1).T
        third = np.sqrt(7) / 2 * (5 * np.stack([u, v], axis=1) ** 3 - 3 * np.stack([u, v], axis=1)) / 2
        return q - 3.0 * third

    table = sim.matches.table.copy()
    plain = np.column_stack([table["x"].value, table["y"].value])
    table["x"], table["y"] = bent(plain).T * u.pix
    solution = ld.solve(replace(sim.matches, table=table), prior=ld.Prior(cubic))
    name = solution.names[0]
    straight = ld.solve(sim.matches)[name].orientation
    assert solution[name].orientation == pytest.approx(straight, rel=1e-4)
    ends = np.array([[1023.0, 1023.5], [1024.0, 1023.5], [1023.5, 1023.0], [1023.5, 1024.0]])
    undistorted = ends
    for _ in range(30):
        undistorted = undistorted + ends - bent(undistorted)
    ra, dec = sky_of(solution, name, undistorted)
    east, north = 3600 * np.diff(ra)[::2] * np.cos(np.radians(dec[0])), 3600 * np.diff(dec)[::2]
    there = np.sqrt(abs(east[0] * north[1] - east[1] * north[0]))
    assert abs(there / straight[1] - 1) == pytest.approx(0.006, abs=5e-4)
    of_wcs = solution[name].wcs(*ends.T)
    assert_allclose(of_wcs, (ra, dec), rtol=0, atol=0.05 * there / 3600 / np.cos(np.radians(dec[0])))


def test_residuals(view):
    """Measured less predicted, by numpy, of the exposure alone."""
    rows, solution = view.residuals, view.solution
    assert set(rows["exposure"]) == {"exp02"}
    assert len(rows) == np.count_nonzero(solution.residuals["exposure"] == "exp02")
    stars = solution.estimate.positions[np.searchsorted(solution.estimate.star_names, rows["star"])]
    off = np.column_stack([rows["x"].value, rows["y"].value]) - predict(stars, view.coefficients, view.pose, view.shape)
    assert_allclose(np.column_stack([rows["dx"].value, rows["dy"].value]), off, rtol=0, atol=1e-9)
    assert view.n_stars == np.count_nonzero(rows["used"])


def test_supported(view):
    rows = view.residuals[view.residuals["used"]]
    hull = Delaunay(np.column_stack([rows["x"].value, rows["y"].value]))
    xy = np.random.default_rng(0).uniform(-200, 2250, (500, 2))
    found = view.supported(xy)
    assert_array_equal(found, hull.find_simplex(xy) >= 0)
    assert 0.3 < found.mean() < 0.95


def changed(solution, i, change):
    """The solution with another set of coefficients of exposure i."""
    coefficients = solution.coefficients.copy()
    coefficients[i] += change.reshape(2, -1)
    return replace(solution, coefficients=coefficients)


def slopes(solution, i, function, step=1e-4):
    """How what a function makes of a solution, flat, follows the coefficients of exposure i, by finite differences."""
    columns = [
        (np.ravel(function(changed(solution, i, e))) - np.ravel(function(changed(solution, i, -e)))) / (2 * step)
        for e in step * np.eye(solution.coefficients[i].size)
    ]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("key", ["exp02", ("frame3", "1"), ("frame1", "2")])
def test_error_map(solution, several, key):
    """What corrected positions do if coefficients move within their errors, by finite differences."""
    solution = solution if key == "exp02" else several[0]
    view = solution[key]
    x, y, sigma = view.sigma_map(n=5, support=False)
    assert sigma.shape == (len(y), len(x), 2)
    assert (x[0], x[-1], y[0], y[-1]) == (-0.5, view.shape[1] - 0.5, -0.5, view.shape[0] - 0.5)
    assert max(len(x), len(y)) == 5
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    through = slopes(solution, view.index, lambda s: s[key].correct(grid))
    expected = np.sqrt(np.diag(through @ solution[view.name].relative_covariance @ through.T)).reshape(sigma.shape)
    assert_allclose(sigma, expected, rtol=1e-4)
    inside = view.supported(grid).reshape(len(y), len(x))
    _, _, held = view.sigma_map(n=5)
    assert_array_equal(np.isfinite(held), np.broadcast_to(inside[..., None], held.shape))
    assert 0 < inside.sum() < inside.size
    absolute = view.sigma_map(n=5, support=False, absolute=True)[2]
    covariance = view.correct(grid, errors=0.0).absolute
    assert_allclose(absolute, np.sqrt(np.einsum("naa->na", covariance)).reshape(sigma.shape), rtol=1e-9)
    assert np.nanmedian(absolute / sigma) > 1


def test_errors_of_coefficients(view):
    """Diagonals of covariances; with the common map what that does to the coefficients."""
    gauge = view.solution.gauge
    assert_allclose(view.relative_errors.ravel() ** 2, np.diag(view.relative_covariance))
    common = gauge.motion[view.index].reshape(view.coefficients.size, -1)
    expected = np.diag(view.covariance) + np.einsum("ab,bc,ac->a", common, gauge.covariance, common)
    assert_allclose(view.errors.ravel() ** 2, expected)
    for covariance in (view.covariance, view.relative_covariance):
        assert_allclose(covariance, covariance.T, atol=1e-12 * covariance.max())
        assert np.linalg.eigvalsh(covariance).min() > -1e-9 * covariance.max()


def test_pictures(view, several):
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure
    from matplotlib.quiver import Quiver

    for drawn in (view, several[0]["frame1"], several[0]["frame1", "2"]):
        ax = Figure().subplots()
        assert drawn.plot_residuals(scale=300, ax=ax) is ax
        arrows = next(c for c in ax.collections if isinstance(c, Quiver))
        rows = drawn.residuals[drawn.residuals["used"]]
        assert_allclose(arrows.XY, np.column_stack([rows["x"].value, rows["y"].value]))
        assert_allclose(np.stack([arrows.U, arrows.V]), np.stack([rows["dx"].value, rows["dy"].value]))
        assert arrows.scale == 1 / 300
        assert drawn.label in ax.get_title(loc="left")
        assert ax.get_xlim() == (-0.5, drawn.shape[1] - 0.5)
    for drawn in (view, several[0]["frame1", "2"]):
        for absolute in (False, True):
            ax = Figure().subplots()
            assert drawn.plot_error_map(absolute=absolute, ax=ax) is ax
            shown = next(c for c in ax.collections if isinstance(c, QuadMesh)).get_array()
            expected = np.sqrt(np.mean(drawn.sigma_map(absolute=absolute)[2] ** 2, axis=2))
            assert_allclose(np.ma.filled(shown, np.nan).ravel(), expected.ravel())


def test_words(view, several):
    assert repr(view) == f"<View of exp02: {view.n_stars} stars, degree 3, 2048 x 2048 px>"
    lines = dict(line.split(None, 1) for line in str(view).splitlines()[1:])
    used = view.residuals[view.residuals["used"]]
    rms = [np.sqrt(np.mean(used[column].value ** 2)) for column in ("dx", "dy")]
    assert lines["residuals"] == f"{rms[0]:.4f}, {rms[1]:.4f} px rms in x, y"
    assert lines["pose"].startswith(f"shift {view.pose[0, 2]:.2f}, {view.pose[1, 2]:.2f} px, rotation ")
    assert lines["sky"].startswith(f"position angle {view.orientation[0]:.4f} deg")
    assert view._repr_html_().startswith("<pre")
    both, one = several[0]["frame1"], several[0]["frame1", "2"]
    ny, nx = several[0].camera.field
    words = f"{both.n_stars} stars, degree 2, focal plane of {nx} x {ny} px, detectors 1, 2"
    assert repr(both) == f"<View of frame1: {words}>"
    assert repr(one).startswith(f"<View of frame1-2: {one.n_stars} stars, degree ")
    assert repr(one).endswith(", 200 x 300 px>")
    assert str(one).splitlines()[0] == repr(one)[1:-1]


def test_a_view_goes_into_a_pickle(view, several):
    for each in (view, several[0]["frame1", "2"]):
        _ = each.wcs, each.model
        again = pickle.loads(pickle.dumps(each))
        assert (again.name, again.detector) == (each.name, each.detector)
        assert_array_equal(again.correct(PIXELS / 10), each.correct(PIXELS / 10))
        assert_array_equal(again.wcs(*PIXELS.T / 10), each.wcs(*PIXELS.T / 10))


# -- several detectors


def test_an_exposure_of_several_detectors_asks_for_one(several):
    view = several[0]["frame1"]
    words = r"exposure frame1 has detectors, 1, 2, .* solution\['frame1', '1'\]"
    for call in (
        lambda: view.correct([[1.0, 2.0]]),
        lambda: view.correct(1.0, 2.0),
        lambda: view.correct([[1.0, 2.0]], errors=0.1),
        lambda: view.distort([[1.0, 2.0]]),
        lambda: view.distort(1.0, 2.0),
        lambda: view.wcs,
        lambda: view.fits_wcs(),
        lambda: view.header(),
        lambda: view.sigma_map(),
        lambda: view.plot_error_map(),
    ):
        with pytest.raises(InputError, match=words):
            call()
    with pytest.raises(InputError, match=words):
        view.check_pixels()
    assert view.common is view
    detector = several[0]["frame1", "2"]
    detector.check_pixels()
    assert detector.common == view


def test_the_focal_plane(several):
    """Pose, common distortion, residuals and error map of the exposure are those of the focal plane."""
    solution, table = several
    view = solution["frame2"]
    rows = view.residuals
    mine = table[table["exposure"] == "frame2"]
    f = np.concatenate([
        solution.camera[key].to_focal_plane(np.column_stack([[r["x"]], [r["y"]]]))
        for key, r in zip(mine["detector"].astype(str), mine, strict=True)
    ])  # fmt: skip
    assert_allclose(np.column_stack([rows["x"].value, rows["y"].value]), f, atol=1e-9)
    xy = view.to_reference(f)
    assert_allclose(predict(xy, view.coefficients, view.pose, view.shape), f, rtol=0, atol=1e-7)
    stars = solution.estimate.positions[np.searchsorted(solution.estimate.star_names, rows["star"])]
    off = f - predict(stars, view.coefficients, view.pose, view.shape)
    assert_allclose(np.column_stack([rows["dx"].value, rows["dy"].value]), off, rtol=0, atol=1e-9)
    assert_allclose(np.stack(view.model(*xy.T), axis=1), f, rtol=0, atol=1e-7)
    x, y, sigma = error_map(view, n=4, support=False)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    through = slopes(solution, 2, lambda s: s["frame2"].to_reference(grid))
    expected = np.sqrt(np.diag(through @ view.relative_covariance @ through.T)).reshape(sigma.shape)
    assert_allclose(sigma, expected, rtol=1e-4)


def on_detector(solution, name, key, xy, coefficients=None):
    """Pixels of a detector of reference positions: pose, common distortion, layout and static distortion, by numpy."""
    view, chip = solution[name], solution.camera[key]
    f = predict(xy, view.coefficients if coefficients is None else coefficients, view.pose, solution.camera.field)
    return predict(f, chip.static, chip.layout, chip.shape)


@pytest.mark.parametrize("key", ["1", "2"])
def test_pixels_of_a_detector(several, key):
    """gwcs, model, `correct` and `distort` are pose, distortion of the focal plane, layout and static distortion."""
    solution, table = several
    view = solution["frame4", key]
    rng = np.random.default_rng(2)
    pixels = rng.uniform(-0.5, np.array(view.shape[::-1]) - 0.5, (200, 2))
    xy = view.correct(pixels)
    assert_allclose(on_detector(solution, "frame4", key, xy), pixels, rtol=0, atol=1e-6)
    assert_allclose(view.distort(xy), pixels, rtol=0, atol=1e-6)
    assert_allclose(np.stack(view.model(*xy.T), axis=1), pixels, rtol=0, atol=1e-6)
    assert_allclose(np.stack(view.model.inverse(*pixels.T), axis=1), xy, rtol=0, atol=1e-6)
    assert_allclose(view.to_reference(pixels), xy, rtol=0, atol=1e-6)
    series = predict(xy, view.coefficients, view.pose, view.shape)
    assert_allclose(series, pixels, rtol=0, atol=1e-6)
    to_reference = view.wcs.get_transform("detector", "reference")
    assert_allclose(np.stack(to_reference(*pixels.T), axis=1), xy, rtol=0, atol=1e-6)
    sky = solution.sky.to_sky(xy)
    assert_allclose(view.wcs(*pixels.T), [sky.ra.deg, sky.dec.deg], rtol=0, atol=1e-10)
    assert_allclose(np.stack(view.wcs.invert(sky.ra.deg, sky.dec.deg), axis=1), pixels, rtol=0, atol=1e-6)
    header = view.header(max_error=1e-3)
    assert_allclose(WCS(header).all_pix2world(pixels, 0), np.column_stack([sky.ra.deg, sky.dec.deg]), atol=3e-8)
    assert view.fits_wcs().array_shape == view.shape
    hull = table[(table["exposure"] == "frame4") & (table["detector"] == key)]
    inside = Delaunay(np.column_stack([hull["x"], hull["y"]])).find_simplex(pixels) >= 0
    assert_array_equal(view.supported(pixels), inside)
    middle = np.array([[99.5, 149.5]]) + [[0, -0.5], [0, 0.5]]
    places = solution.sky.to_sky(similarity.apply(similarity.invert(view.pose), middle))
    angle, scale = view.orientation
    assert abs((places[0].position_angle(places[1]).deg - angle + 180) % 360 - 180) < 0.01
    assert scale == pytest.approx(places[0].separation(places[1]).arcsec, rel=1e-3)


@pytest.mark.parametrize("key", ["1", "2"])
def test_residuals_of_a_detector(several, key):
    """In its own pixels: as measured, errors too, and residuals by a slope of finite differences."""
    solution, table = several
    rows, mine = solution["frame1", key].residuals, table[(table["exposure"] == "frame1") & (table["detector"] == key)]
    assert_array_equal(rows["star"], mine["star"])
    for column in ("x", "y", "x_err", "y_err"):
        assert_allclose(rows[column].value, mine[column], rtol=0, atol=1e-8)
    stars = solution.estimate.positions[np.searchsorted(solution.estimate.star_names, rows["star"])]
    off = np.column_stack([mine["x"], mine["y"]]) - on_detector(solution, "frame1", key, stars)
    found = np.column_stack([rows["dx"].value, rows["dy"].value])
    assert_allclose(found, off, rtol=0, atol=1e-4)  # where the slope is constant over a residual
    whole = solution["frame1"].residuals
    whole = whole[np.asarray(whole["detector"]).astype(str) == key]
    chip = solution.camera[key]
    f = np.column_stack([whole["x"].value, whole["y"].value])
    slope = np.stack([
        (predict(f + e, chip.static, chip.layout, chip.shape) - predict(f - e, chip.static, chip.layout, chip.shape))
        / 0.02 for e in 0.01 * np.eye(2)
    ], axis=2)  # fmt: skip
    shift = np.column_stack([whole["dx"].value, whole["dy"].value])
    assert_allclose(found, np.einsum("nab,nb->na", slope, shift), rtol=0, atol=1e-7)


def series(view, coefficients):
    """Coefficients of a detector as quadrature has them, of a set of coefficients of the exposure; no basis of ours."""
    (ny, nx), degree = view.shape, view.distortion.degree
    t, w = leggauss(14)
    (a, b), weights = (each.ravel() for each in np.meshgrid(t, t)), np.outer(w, w).ravel()
    q = np.stack([(a + 1) * nx / 2 - 0.5, (b + 1) * ny / 2 - 0.5], axis=1)
    xy = (q - view.pose[:, 2]) @ np.linalg.inv(view.pose[:, :2]).T
    shift = on_detector(view.solution, view.name, view.detector, xy, coefficients) - q
    out = []
    for i, j in modes(degree):
        unit = np.zeros((i + 1, j + 1))
        unit[i, j] = np.sqrt((2 * i + 1) * (2 * j + 1)) / 2
        out.append((weights * legval2d(a, b, unit)) @ shift)
    return np.transpose(out)


@pytest.mark.parametrize(("name", "key"), [("frame0", "1"), ("frame0", "2"), ("frame3", "2")])
def test_errors_of_the_coefficients_of_a_detector(several, name, key):
    """Those of its own exposure, by finite differences, and by coefficients that are drawn."""
    solution, _ = several
    view, common, other = solution[name, key], solution[name], solution["frame3" if name == "frame0" else "frame0"]
    assert_allclose(view.coefficients, series(view, common.coefficients), rtol=0, atol=1e-6)
    assert view.errors.shape == view.relative_errors.shape == view.coefficients.shape
    step, size = 1e-3, common.coefficients.size
    columns = [
        series(view, common.coefficients + e.reshape(2, -1)) - series(view, common.coefficients - e.reshape(2, -1))
        for e in step * np.eye(size)
    ]
    through = np.stack([column.ravel() for column in columns], axis=1) / (2 * step)
    largest = np.abs(view.covariance).max()
    for ours, of_exposure in (("covariance",) * 2, ("relative_covariance",) * 2):
        expected = through @ getattr(common, of_exposure) @ through.T
        assert_allclose(getattr(view, ours), expected, rtol=0, atol=1e-5 * largest)
        wrong = through @ getattr(other, of_exposure) @ through.T
        assert np.abs(getattr(view, ours) - wrong).max() > 0.2 * largest
    assert_allclose(view.relative_errors.ravel() ** 2, np.diag(view.relative_covariance), rtol=1e-9)
    moved = through @ solution.gauge.motion[view.index].reshape(size, -1)
    expected = np.diag(view.covariance) + np.einsum("ab,bc,ac->a", moved, solution.gauge.covariance, moved)
    known = np.isfinite(view.errors)
    assert known.mean() > 0.5
    assert_allclose(view.errors[known] ** 2, expected.reshape(2, -1)[known], rtol=1e-4, atol=1e-6 * largest)
    rng = np.random.default_rng(4)
    drawn = rng.multivariate_normal(np.zeros(size), common.covariance, 300).reshape(300, 2, -1)
    scatter = np.var([series(view, common.coefficients + each) for each in drawn], axis=0)
    own = np.diag(view.covariance).reshape(2, -1)
    good = own > 1e-3 * own.max()
    assert good.sum() > 6
    assert_allclose(scatter[good] / own[good], 1, atol=0.4)  # standard error 0.08
    assert np.sum(scatter) / np.sum(own) == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_a_mosaic_weighted_by_the_error_maps_of_detectors(several):
    """Values of flat images come out as the errors of the correction at their pixels have them."""
    solution, _ = several
    images = [
        Exposure(part.label, np.full(part.shape, 10.0 * part.index + k + 1), exposure=part.name, detector=part.detector)
        for view in solution
        for k, part in enumerate(view.parts)
    ]
    settings = {"conserve": "surface_brightness", "match_background": False, "scale": None, "extrapolated": "keep"}
    mosaic = ld.coadd(images, solution, weights="sigma_map", **settings)
    plain = ld.coadd(images, solution, weights=None, **settings)
    assert set(mosaic.exposures) == {image.name for image in images}
    rng, ratios = np.random.default_rng(6), []
    own = (0.02 * 2.0) ** 2  # signal to noise 20 at a FWHM of 2 px
    deep = np.argwhere(mosaic.footprint >= 4)
    for row, column in deep[rng.choice(len(deep), 40, replace=False)]:
        xy, weights, values = np.array([[column, row]]) + np.array(mosaic.offset, dtype=float), [], []
        for image in images:
            view = image_view(solution, image)
            p, (ny, nx) = view.distort(xy), view.shape
            if np.all(p >= 0) and np.all(p <= [nx - 1, ny - 1]):
                weights.append(own / (own + np.trace(view.correct(p, errors=0.0).relative[0]) / 2))
                values.append(image.data[0, 0])
        assert mosaic.data[row, column] == pytest.approx(np.average(values, weights=weights), abs=0.1)
        assert plain.data[row, column] == pytest.approx(np.mean(values), abs=0.01)
        ratios.append(np.ptp(weights) / max(weights))
    assert np.median(ratios) > 0.1


def test_a_fold_is_said_for_the_exposure_and_the_detector(several):
    """Of the distortion of an exposure, which all its detectors share, and of that of one detector alone."""
    plain = ld.solve(ld.simulate_matches(n_stars=30, n_exposures=3, degree=2, seed=1).matches, degree=2)
    assert [view.fold for view in plain] == ["", "", ""]
    coefficients = plain.coefficients.copy()
    coefficients[1, 0, 3] += 1000
    bent = replace(plain, coefficients=coefficients)
    assert [bool(view.fold) for view in bent] == [False, True, False]
    assert bent["exp01"].fold.startswith("the distortion of exposure exp01 folds")
    several, _ = several
    first, *others = several.camera.detectors
    static = np.zeros((2, 6))
    static[0, 3] = 1000
    detectors = dict(several.camera.detectors)
    detectors[first] = replace(detectors[first], static=static, static_sigma=None)
    bent = replace(several, camera=replace(several.camera, detectors=detectors))
    name = bent.names[0]
    assert bent[name, first].fold.startswith(f"{bent[name, first].label}: ")
    assert not any(bent[name, other].fold for other in others)


def test_all_of_a_view_is_tested_here():
    source = Path(__file__).read_text(encoding="utf-8")
    public = [name for name in vars(View) if not name.startswith("_")]
    assert len(public) > 20
    assert [name for name in public if f".{name}" not in source and f'"{name}"' not in source] == []
