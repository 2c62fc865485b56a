"""The WCS of an exposure and its astropy model: stock parts, both directions, NaN where nothing is known."""

import copy
import pickle

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.modeling import CompoundModel, models
from numpy.testing import assert_allclose, assert_array_equal

from legdistort import poses
from legdistort.archive import write_wcs
from legdistort.distortion import FastLegendre2D
from legdistort.estimation import solve
from legdistort.matches import Matches
from legdistort.priors import Prior
from legdistort.simulation import simulate_gsaoi_matches, simulate_matches


@pytest.fixture(scope="module")
def solution():
    """Oblong detector, turned and flipped exposures, with a tie to the sky."""
    sim = simulate_matches(
        n_stars=60, n_exposures=4, shape=(700, 1200), dither=40, rotations=[0, 20, -60, 5], flips=[0, 0, 1, 0], seed=2
    )
    m = 2e-5 / 3.6 * np.array([[-1.0, 0.1, 500.0], [0.1, 1.0, -200.0]])
    matches = Matches(sim.matches.table, sim.matches.shapes, sim.matches.poses, poses.TangentPlane(10.0, -70.0, m))
    return solve(matches, prior=Prior(sim.truth.static))


@pytest.fixture(scope="module")
def blind():
    """No sky."""
    return solve(simulate_matches(n_stars=40, n_exposures=3, shape=(400, 300), static=1, seed=1).matches, degree=2)


def detector_points(solution, name, n=400):
    ny, nx = solution.shapes[name]
    p = np.random.default_rng(0).uniform([-0.5, -0.5], [nx - 0.5, ny - 0.5], (n, 2))
    corners = [[e, f] for e in (-0.5, nx - 0.5) for f in (-0.5, ny - 0.5)]
    return np.concatenate([p, corners])


def test_frames(solution, blind):
    for name in solution.names:
        assert solution.wcs(name).available_frames == ["detector", "undistorted", "reference", "icrs"]
        assert solution.wcs(name).name == name
        assert solution.wcs(name).pixel_shape == (1200, 700)
    wcs = blind.wcs(blind.names[0])
    assert wcs.available_frames == ["detector", "undistorted", "reference"]
    assert [str(unit) for unit in wcs.output_frame.unit] == ["pix", "pix"]


def test_forward_is_the_exact_correction(solution):
    for name in solution.names:
        wcs, p = solution.wcs(name), detector_points(solution, name)
        to_reference = wcs.get_transform("detector", "reference")
        assert_allclose(np.column_stack(to_reference(*p.T)), solution.correct(name, p), rtol=0, atol=1e-6)
        q = np.column_stack(wcs.get_transform("detector", "undistorted")(*p.T))
        assert_allclose(q, poses.apply(solution.poses[name], solution.correct(name, p)), rtol=0, atol=1e-6)


def test_backward_is_the_exact_distortion(solution):
    for name in solution.names:
        wcs = solution.wcs(name)
        x = solution.correct(name, detector_points(solution, name)[:-4])
        back = np.column_stack(wcs.get_transform("reference", "detector")(*x.T))
        assert_allclose(back, solution.distort(name, x), rtol=0, atol=1e-9)


def test_sky_is_that_of_the_tangent_plane(solution):
    for name in solution.names:
        wcs, p = solution.wcs(name), detector_points(solution, name)
        expected = solution.sky.to_sky(solution.correct(name, p))
        sky = wcs.pixel_to_world(*p.T)
        assert sky.separation(expected).max().to_value(u.deg) < 1.5e-6 * solution.sky.pixel_scale / 3600
        inside = p[:-4]
        back = np.column_stack(wcs.world_to_pixel(solution.sky.to_sky(solution.correct(name, inside))))
        good = np.isfinite(back).all(axis=1)  # gwcs takes a box on the sky for the footprint: some points are lost
        assert good.mean() > 0.9
        assert_allclose(back[good], inside[good], atol=1e-6)


def test_whole_chain_backward_without_the_box(solution):
    for name in solution.names:
        wcs, p = solution.wcs(name), detector_points(solution, name)
        sky = wcs(*p.T)
        wcs.bounding_box = None
        assert_allclose(np.column_stack(wcs.backward_transform(*sky)), p, rtol=0, atol=2e-6)


def test_outside_is_nan(solution):
    for name in solution.names:
        wcs = solution.wcs(name)
        ny, nx = solution.shapes[name]
        for p in ((-0.6, 10.0), (nx - 0.4, 10.0), (10.0, -0.6), (10.0, ny - 0.4)):
            assert np.isnan(wcs(*p)).all()
        assert np.isfinite(wcs(-0.5, -0.5)).all()
        assert np.isfinite(wcs(nx - 0.5, ny - 0.5)).all()
        far = poses.apply(
            poses.invert(solution.poses[name]), [[-0.2 * nx, 0], [1.2 * nx, 0], [0, 1.3 * ny], [9e3, 9e3]]
        )
        assert np.isnan(solution.distort(name, far)).all()
        assert np.isnan(wcs.get_transform("reference", "detector")(*far.T)).all()


def test_model_is_the_distortion_and_its_inverse(solution):
    for name in solution.names:
        model, p = solution.model(name), detector_points(solution, name)
        x = solution.correct(name, p)
        inside = x[:-4]
        assert_allclose(np.column_stack(model(*inside.T)), solution.distort(name, inside), rtol=0, atol=1e-9)
        assert_allclose(np.column_stack(model.inverse(*p.T)), x, rtol=0, atol=1e-6)
        assert_allclose(np.column_stack(model.inverse.inverse(*inside.T)), p[:-4], rtol=0, atol=1e-8)


def test_models_compose(solution):
    name = solution.names[2]
    model, p = solution.model(name), detector_points(solution, name)[:-4]
    x = solution.correct(name, p)
    before = models.Shift(-50) & models.Shift(30)
    after = models.Scale(2.0) & models.Scale(-3.0)
    chain = before | model | after
    assert_allclose(np.column_stack(chain(*(x + [50, -30]).T)), p * [2, -3], atol=1e-8)
    assert_allclose(np.column_stack(chain.inverse(*(p * [2, -3]).T)), x + [50, -30], atol=1e-6)


@pytest.mark.parametrize("remake", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_copies_are_whole(solution, remake):
    name = solution.names[1]
    p = detector_points(solution, name)
    wcs = remake(solution.wcs(name))
    assert_array_equal(wcs(*p.T), solution.wcs(name)(*p.T))
    assert wcs.available_frames == ["detector", "undistorted", "reference", "icrs"]
    model = remake(solution.model(name))
    assert_array_equal(model.inverse(*p.T), solution.model(name).inverse(*p.T))


def test_wcs_of_real_polynomials():
    sim = simulate_gsaoi_matches(small=True, seed=3)
    solution = solve(sim.matches, degree=3, prior=Prior(sim.truth.static))
    for name in solution.names[:2]:
        p = detector_points(solution, name)
        expected = sim.matches.sky.to_sky(solution.correct(name, p))
        assert solution.wcs(name).pixel_to_world(*p.T).separation(expected).max() < 1e-7 * u.arcsec
    assert solution.max_inverse_error <= 1e-6


# --- files -------------------------------------------------------------------------------------------------------


def legendres(model):
    """All Legendre2D of a compound model and of the inverses attached in it."""
    out, todo = [], [model]
    while todo:
        m = todo.pop()
        if isinstance(m, models.Legendre2D):
            out.append(m)
        if isinstance(m, CompoundModel):
            todo += [m.left, m.right]
        inverse = getattr(m, "_user_inverse", None)
        if inverse is not None:
            todo.append(inverse)
    return out


def test_file_holds_stock_models_only(solution, tmp_path):
    name = solution.names[2]
    path = write_wcs(solution, name, tmp_path / "w.asdf")
    head = path.read_bytes()[:60]
    assert head.startswith(b"#ASDF 1.0.0\n#ASDF_STANDARD 1.5.0\n")
    text = path.read_bytes().split(b"\n...")[0].decode()
    # the package is named as provenance, nothing of it is needed to read
    assert "legdistort/extensions" not in text
    assert "FastLegendre" not in text
    assert not any("legdistort" in line for line in text.splitlines() if "!" in line)
    with asdf.open(path, lazy_load=False, memmap=False) as file:
        used = str(file.tree["history"])
        meta = file.tree["meta"]
        assert "legdistort" not in used
        assert meta["exposure"] == name
        assert meta["inverse_error_px"] == solution.distortion(name).inverse.error
        assert_allclose(meta["valid_undistorted_px"], solution.distortion(name).inverse.valid)
        stored = meta["wcs"]
    given = solution.wcs(name)
    theirs, ours = (legendres(w.get_transform("detector", "undistorted")) for w in (stored, given))
    assert len(theirs) == len(ours) == 4
    for a, b in zip(theirs, ours, strict=True):
        assert type(a) is models.Legendre2D
        assert type(b) is FastLegendre2D
        assert a.parameters.tobytes() == b.parameters.tobytes()
        assert a.name == b.name
        assert tuple(a.x_domain) == tuple(b.x_domain)
    p = detector_points(solution, name)
    assert stored.available_frames == given.available_frames
    assert stored.pixel_shape == given.pixel_shape
    assert_allclose(stored(*p.T), given(*p.T), rtol=0, atol=1e-12)
    assert np.isnan(stored(-0.6, 3.0)).all()
    x = solution.correct(name, p[:-4])
    assert_allclose(
        np.column_stack(stored.get_transform("reference", "detector")(*x.T)), solution.distort(name, x), atol=1e-9
    )


def test_a_bare_model_goes_through_asdf(solution, tmp_path):
    model = solution.model(solution.names[0])
    asdf.AsdfFile({"model": model, "part": legendres(model)[0]}, version="1.5.0").write_to(tmp_path / "m.asdf")
    with asdf.open(tmp_path / "m.asdf", lazy_load=False, memmap=False) as file:
        again, part = file.tree["model"], file.tree["part"]
    assert type(part) is models.Legendre2D
    assert part.parameters.tobytes() == legendres(model)[0].parameters.tobytes()
    p = detector_points(solution, solution.names[0])
    assert_allclose(again.inverse(*p.T), model.inverse(*p.T), rtol=0, atol=1e-9)
    x = solution.correct(solution.names[0], p[:-4])
    assert_allclose(again(*x.T), model(*x.T), rtol=0, atol=1e-9)
