"""The term "rough_static": a static distortion that is rough, beside the Legendre series. Truth made by numpy alone."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rough_optics import Mask, beyond

import legdistort as ld
from legdistort.cameras.camera import Camera
from legdistort.cameras.detector import Detector
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry import basis
from legdistort.geometry.tabulated.covariance_table import CovarianceTable
from legdistort.geometry.tabulated.rough_basis import RoughBasis
from legdistort.results import new_positions
from legdistort.solving.gauge import known_poses
from legdistort.wcs.storage import write_wcs

SMALL = {"size": 1500, "holes_along": 12, "n_exposures": 7, "noise": 0.0015, "highest": 9.0, "rough": 0.1}


@pytest.fixture(scope="module")
def mask():
    return Mask(**SMALL)


@pytest.fixture(scope="module")
def solution(mask):
    return mask.solve(terms="rough_static")


def off(mask, solution, q, degree=2):
    """Errors of the map beyond a series that all exposures share, rms per axis."""
    found = solution["m0"].distortion(q) - q
    return np.std(beyond(found - mask.map(q), q, mask.size, degree))


@pytest.mark.slow
def test_the_map_is_as_good_as_it_can_be(mask, solution):
    q = mask.at()
    optimum, chi2 = mask.optimum(q)
    best = np.std(beyond(optimum - mask.map(q), q, mask.size, 2))
    assert off(mask, solution, q) < 1.5 * best
    with pytest.warns(AssumptionWarning, match="poses depart"):
        assert off(mask, mask.solve(), q) > 30 * best
    assert_allclose(solution.chi2 / solution.dof, 1, atol=0.08)
    assert_allclose(chi2, 1, atol=0.08)
    assert "rough_static: 512 numbers" in str(solution)


def test_a_static_distortion_that_is_told_badly_is_found():
    """Small shifts tell of quadratics but a part in a million, which is enough where positions are precise."""
    smooth = Mask(**SMALL | {"rough": 1e-9, "holes_along": 9})
    q = smooth.at(400)
    for known in ({"shift": 1e-3, "rotation": 1e-5, "scale": 1e-6}, {"shift": 1.0, "rotation": 0.01, "scale": 0.01}):
        with pytest.warns(AssumptionWarning, match="2 of 38 unknowns of the shared distortion are not"):
            found = smooth.solve(pose_sigma=known)
        assert_allclose(found.chi2 / found.dof, 1, atol=0.12)
        assert off(smooth, found, q) < 1.5 * smooth.noise  # 20 where what is told badly is held at the prior
        assert [each.name for each in found.gauge.unknown] == 2 * ["static"]  # shears: nothing tells of these


@pytest.mark.slow
def test_numbers_are_found_where_poses_are_hardly_known(mask, solution):
    """What follows the numbers may be known to a few digits; the normal equations of these are positive still."""
    with pytest.warns(AssumptionWarning, match="2 of 38 unknowns of the shared distortion are not"):
        free = mask.solve(terms="rough_static", pose_sigma={"shift": 1e-3, "rotation": 1e-5, "scale": 1e-6})
    assert_allclose(free.chi2 / free.dof, solution.chi2 / solution.dof, atol=0.02)
    assert off(mask, free, mask.at(400)) < 1.3 * off(mask, solution, mask.at(400))


def test_errors_of_new_positions_hold_it(mask, solution):
    view, q = solution["m2"], mask.at(400)
    p = q + mask.map(q)
    xy, relative, _ = view.correct(p, errors=np.zeros_like(p))
    error = beyond(xy + mask.poses["m2"][:, 2] - q, q, mask.size, 5)
    stated = np.sqrt(np.mean(np.trace(relative, axis1=1, axis2=2)) / 2)
    assert 0.6 < np.std(error) / stated < 1.3
    assert_allclose(new_positions.relative_errors(view, view.distortion.invert(p)), relative, rtol=0.1, atol=1e-9)
    camera, (functions,) = solution.estimate.uncertainty.camera, solution.diagnostics.terms[0].bases
    moved = camera.of_measured(view, q[:5])  # what larger numbers displace is less where the star is
    assert_allclose(moved[:, 0], -functions(q[:5]) @ camera.numbers[: functions.n], atol=1e-12)
    assert_allclose(moved[:, 1], -functions(q[:5]) @ camera.numbers[functions.n :], atol=1e-12)
    sigma = view.sigma_map(n=12, support=False)[2]
    assert 0.5 < np.median(sigma) / stated < 1.5


@pytest.mark.slow
def test_it_is_a_part_of_the_distortion(mask, solution, tmp_path):
    """Not of what terms displace positions by; in WCS, files and their views, of all exposures alike."""
    assert_allclose(solution.residuals["x_terms"].value, 0, atol=1e-12)
    views = [solution["m0"], solution["m1"]]
    assert views[0].distortion.table == views[1].distortion.table
    rows = solution.residuals[solution.residuals["exposure"] == "m1"]
    stars = dict(zip(solution.stars["star"], np.column_stack([solution.stars["x"], solution.stars["y"]]), strict=True))
    model = views[1].distort(np.array([stars[name] for name in rows["star"]]))
    left = np.column_stack([rows["x"].value - model[:, 0], rows["y"].value - model[:, 1]])
    assert_allclose(left, np.column_stack([rows["dx"].value, rows["dy"].value]), atol=0.1 * mask.noise)
    assert views[0].distortion.inverse.error < 1e-3
    back = ld.Solution.read(solution.write(tmp_path / "s.asdf"))
    assert back["m0"].distortion.same_as(views[0].distortion)
    p = mask.at(100)
    assert_array_equal(back["m0"].correct(p), views[0].correct(p))
    known = {"errors": np.zeros_like(p)}
    assert_allclose(back["m0"].correct(p, **known).relative, views[0].correct(p, **known).relative, rtol=1e-6)
    prior = ld.Prior.from_solution(solution)
    assert (prior.table, prior.truncation) == (views[0].distortion.table, 0)
    x, y = ld.read_wcs(write_wcs(views[0], tmp_path / "w.asdf"))(*p.T)
    assert_allclose(np.column_stack([x, y]), views[0].correct(p), atol=1e-3)


def test_noise_alone_takes_it_away():
    mask = Mask(**SMALL | {"rough": 1e-9})
    solution, plain = mask.solve(terms=["rough_static"]), mask.solve()
    assert not solution.terms["size"].any()
    assert solution["m0"].distortion.table is None
    assert_allclose(solution.stars["x"], plain.stars["x"], rtol=1e-9)
    assert "rough_static: the positions do not show it" in str(solution)


def test_functions_are_independent_of_the_series_and_of_unit_size():
    functions = RoughBasis((9, 14), 3, (1000, 1600))
    u_, v, weights = basis.quadrature(60)
    reach = np.array([1 + 2 / 64, 1 + 2 / 64 * 1.6])  # as far as tables go
    q = basis.denormalize(u_ * reach[0], v * reach[1], functions.shape)
    values = functions(q)
    assert_allclose(np.sum(weights @ values**2) / 4, 1, rtol=1e-3)
    assert_allclose((weights * basis.values(3, u_, v)) @ values, 0, atol=2e-5)
    numbers = np.random.default_rng(0).normal(size=(2, functions.n))
    table = functions.table(numbers)
    inside = np.abs(basis.normalize(q, functions.shape)).max(axis=0) < 1
    assert_allclose(table(q[inside]), (values @ numbers.T)[inside], atol=5e-4)
    assert_allclose(functions.fields(q, numbers.T), values @ numbers.T, atol=1e-10)


@pytest.mark.slow
def test_several_detectors_have_names(mask):
    table = mask.matches.table.copy()
    second = np.isin(table["exposure"], ["m1", "m3", "m5"])
    table["detector"] = np.where(second, "b", "a")
    how = {"degree": 5, "static": "fit", "exposure_degree": 0, "clip": None, "pose_sigma": mask.known}
    matches = ld.Matches.from_table(table, shape=(mask.size, mask.size), poses=mask.poses)
    solution = ld.solve(matches, terms=ld.Term.named("rough_static"), **how)
    assert set(solution.estimate.static_tables) == {"a", "b"}
    assert solution["m1"].distortion.table == solution.estimate.static_tables["b"]
    assert list(dict.fromkeys(solution.terms["owner"])) == ["a", "b"]


def test_where_it_cannot_be(mask):
    layout = np.array([[1.0, 0, -10], [0, 1.0, -10]])
    camera = Camera("one", {"1": Detector((mask.size, mask.size), layout=layout)}, (mask.size + 20, mask.size + 20))
    table = mask.matches.table.copy()
    table["detector"] = "1"
    matches = ld.Matches.from_table(table, camera=camera, poses=mask.poses)
    if matches.camera.has_focal_plane:
        with pytest.raises(InputError, match=r"rough_static is of detectors by .*dynamic='detector'"):
            ld.solve(matches, degree=2, terms="rough_static")


@pytest.mark.slow
def test_poses_follow_the_errors_of_the_term(mask, monkeypatch):
    """Poses depart from given ones by the errors of the splines, which is no contradiction."""
    calls, asked = [], known_poses.contradiction
    monkeypatch.setattr(known_poses, "contradiction", lambda *given: calls.append(given) or asked(*given))
    mask.solve(terms="rough_static", pose_sigma={"shift": 3e-4, "rotation": 1e-6, "scale": 2e-8})
    ((problem, state, uncertainty, _),) = calls
    alone = copy(uncertainty)
    alone.camera = None

    def given(off):
        """The problem with one pose given that far off."""
        poses = problem.given_poses.copy()
        poses[3, 0, 2] += off
        return replace(problem, given_poses=poses)

    assert not asked(given(0.0), state, uncertainty)
    assert not asked(given(0.005), state, uncertainty)
    assert "poses depart" in asked(given(0.005), state, alone)
    said = asked(given(0.5), state, uncertainty)
    assert "poses depart" in said
    assert "most in exposure m3" in said
    for size, departs in ((1e-6, True), (1.0, False)):  # of a random field in every exposure, that may move poses
        field = CovarianceTable(np.full((3, 2, 2), size**2), (-0.5, -0.5), (mask.size, mask.size))
        assert bool(asked(given(0.005), state, alone, dict.fromkeys(problem.names, field))) == departs
