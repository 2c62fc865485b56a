"""The WCS of an exposure and its astropy model: stock parts, both directions, NaN where nothing is known."""

import copy
import pickle
import subprocess
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.modeling import CompoundModel, fitting, models
from astropy.modeling.separable import separability_matrix
from numpy.testing import assert_allclose, assert_array_equal

from legdistort.exceptions import InputError
from legdistort.geometry import similarity
from legdistort.geometry.models import FastLegendre2D
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.results import in_tables
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.storage import write_wcs


@pytest.fixture(scope="module")
def solution():
    """Oblong detector, turned and flipped exposures, with a tie to the sky."""
    sim = simulate_matches(
        n_stars=60, n_exposures=4, shape=(700, 1200), dither=40, rotations=[0, 20, -60, 5], flips=[0, 0, 1, 0], seed=2
    )
    m = 2e-5 / 3.6 * np.array([[-1.0, 0.1, 500.0], [0.1, 1.0, -200.0]])
    matches = Matches(sim.matches.table, sim.matches.shapes, sim.matches.poses, TangentPlane(10.0, -70.0, m))
    return solve(matches, prior=Prior(sim.truth.static))


@pytest.fixture(scope="module")
def blind():
    """No sky."""
    matches = simulate_matches(n_stars=40, n_exposures=3, shape=(400, 300), static=1, seed=1).matches
    return solve(matches, degree=2, clip=None)  # of degree 3, in truth


def detector_points(solution, name, n=400):
    ny, nx = solution.estimate.shapes[name]
    p = np.random.default_rng(0).uniform([-0.5, -0.5], [nx - 0.5, ny - 0.5], (n, 2))
    corners = [[e, f] for e in (-0.5, nx - 0.5) for f in (-0.5, ny - 0.5)]
    return np.concatenate([p, corners])


def test_frames(solution, blind):
    for name in solution.names:
        assert solution[name].wcs.available_frames == ["detector", "undistorted", "reference", "icrs"]
        assert solution[name].wcs.name == name
        assert solution[name].wcs.pixel_shape == (1200, 700)
    wcs = blind[blind.names[0]].wcs
    assert wcs.available_frames == ["detector", "undistorted", "reference"]
    assert [str(unit) for unit in wcs.output_frame.unit] == ["pix", "pix"]


def test_forward_is_the_exact_correction(solution):
    for name in solution.names:
        wcs, p = solution[name].wcs, detector_points(solution, name)
        to_reference = wcs.get_transform("detector", "reference")
        assert_allclose(np.column_stack(to_reference(*p.T)), solution[name].correct(p), rtol=0, atol=1e-6)
        q = np.column_stack(wcs.get_transform("detector", "undistorted")(*p.T))
        assert_allclose(q, similarity.apply(solution.poses[name], solution[name].correct(p)), rtol=0, atol=1e-6)


def test_backward_is_the_exact_distortion(solution):
    for name in solution.names:
        wcs = solution[name].wcs
        x = solution[name].correct(detector_points(solution, name)[:-4])
        back = np.column_stack(wcs.get_transform("reference", "detector")(*x.T))
        assert_allclose(back, solution[name].distort(x), rtol=0, atol=1e-9)


def test_sky_is_that_of_the_tangent_plane(solution):
    for name in solution.names:
        wcs, p = solution[name].wcs, detector_points(solution, name)
        expected = solution.sky.to_sky(solution[name].correct(p))
        sky = wcs.pixel_to_world(*p.T)
        assert sky.separation(expected).max().to_value(u.deg) < 1.5e-6 * solution.sky.pixel_scale / 3600
        inside = p[:-4]
        back = np.column_stack(wcs.world_to_pixel(solution.sky.to_sky(solution[name].correct(inside))))
        assert_allclose(back, inside, atol=1e-6)


@pytest.mark.slow
def test_whole_chain_backward_without_the_box(solution):
    for name in solution.names:
        wcs, p = solution[name].wcs, detector_points(solution, name)
        sky = wcs(*p.T)
        wcs.bounding_box = None
        assert_allclose(np.column_stack(wcs.backward_transform(*sky)), p, rtol=0, atol=2e-6)


def test_many_positions_are_as_few(solution, blind):
    """They are evaluated in pieces; numbers, shapes and NaN outside the detector are those of the stock class."""
    ny, nx = np.indices((1300, 290)) - 5.0
    for wcs in (solution[solution.names[1]].wcs, blind[blind.names[0]].wcs):
        there = wcs.pixel_to_world_values(nx, ny)
        expected = wcs.stock().pixel_to_world_values(nx, ny)
        assert_array_equal(there, expected)
        assert there[0].shape == nx.shape
        back = wcs.world_to_pixel_values(*there)
        inside = np.isfinite(there[0])
        assert_allclose(np.array(back)[:, inside], np.array([nx, ny])[:, inside], rtol=0, atol=1e-6)
        row = wcs.pixel_to_world_values(np.arange(100_000) % 290, 17.0)  # shapes that go together
        assert_array_equal(row[0][:290], wcs.pixel_to_world_values(np.arange(290), 17.0)[0])


def test_outside_is_nan(solution):
    for name in solution.names:
        wcs = solution[name].wcs
        ny, nx = solution.estimate.shapes[name]
        for p in ((-0.6, 10.0), (nx - 0.4, 10.0), (10.0, -0.6), (10.0, ny - 0.4)):
            assert np.isnan(wcs(*p)).all()
        assert np.isfinite(wcs(-0.5, -0.5)).all()
        assert np.isfinite(wcs(nx - 0.5, ny - 0.5)).all()
        far = similarity.apply(
            similarity.invert(solution.poses[name]), [[-0.2 * nx, 0], [1.2 * nx, 0], [0, 1.3 * ny], [9e3, 9e3]]
        )
        assert np.isnan(solution[name].distort(far)).all()
        assert np.isnan(wcs.get_transform("reference", "detector")(*far.T)).all()


def test_model_is_the_distortion_and_its_inverse(solution):
    for name in solution.names:
        model, p = solution[name].model, detector_points(solution, name)
        x = solution[name].correct(p)
        inside = x[:-4]
        assert_allclose(np.column_stack(model(*inside.T)), solution[name].distort(inside), rtol=0, atol=1e-9)
        assert_allclose(np.column_stack(model.inverse(*p.T)), x, rtol=0, atol=1e-6)
        assert_allclose(np.column_stack(model.inverse.inverse(*inside.T)), p[:-4], rtol=0, atol=1e-8)


def test_models_compose(solution):
    name = solution.names[2]
    model, p = solution[name].model, detector_points(solution, name)[:-4]
    x = solution[name].correct(p)
    before = models.Shift(-50) & models.Shift(30)
    after = models.Scale(2.0) & models.Scale(-3.0)
    chain = before | model | after
    assert_allclose(np.column_stack(chain(*(x + [50, -30]).T)), p * [2, -3], atol=1e-8)
    assert_allclose(np.column_stack(chain.inverse(*(p * [2, -3]).T)), x + [50, -30], atol=1e-6)


@pytest.mark.parametrize("remake", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_copies_are_whole(solution, remake):
    name = solution.names[1]
    p = detector_points(solution, name)
    wcs = remake(solution[name].wcs)
    assert_array_equal(wcs(*p.T), solution[name].wcs(*p.T))
    assert wcs.available_frames == ["detector", "undistorted", "reference", "icrs"]
    model = remake(solution[name].model)
    assert_array_equal(model.inverse(*p.T), solution[name].model.inverse(*p.T))


def test_wcs_of_real_polynomials():
    sim = simulate_gsaoi_matches(small=True, seed=3)
    solution = solve(sim.matches, degree=3, prior=Prior(sim.truth.static))
    for name in solution.names[:2]:
        p = detector_points(solution, name)
        expected = sim.matches.sky.to_sky(solution[name].correct(p))
        assert solution[name].wcs.pixel_to_world(*p.T).separation(expected).max() < 1e-7 * u.arcsec
    assert in_tables.largest_inverse_error(solution) <= 1e-6


# --- an ordinary astropy model --------------------------------------------------------------------------------------


def valid_boxes(model):
    return [part.valid for part in legendres(model)]


@pytest.mark.parametrize(
    "remake", [copy.copy, copy.deepcopy, lambda m: m.copy(), lambda m: pickle.loads(pickle.dumps(m))]
)
def test_copies_know_where_they_are_valid(solution, remake):
    name = solution.names[3]
    model = solution[name].model
    again = remake(model)
    p = detector_points(solution, name)
    x = solution[name].correct(p)
    assert_array_equal(again(*x.T), model(*x.T))
    assert_array_equal(again.inverse(*p.T), model.inverse(*p.T))
    assert valid_boxes(again) == valid_boxes(model)
    assert np.isnan(again(1e5, 1e5)).all()
    assert again.name == model.name
    assert again.fixed == model.fixed


def test_sums_and_pairs(solution):
    model, x = solution[solution.names[1]].model, solution[solution.names[1]].correct([[300.0, 200.0], [900.0, 600.0]])
    value = np.array(model(*x.T))
    assert_allclose(np.array((model + models.Identity(2))(*x.T)), value + x.T)
    assert_allclose(np.array((model & models.Scale(3.0))(*x.T, [1, 2])), [*value, [3, 6]])
    assert_allclose(np.array((model & models.Scale(3.0)).inverse(*value, [3, 6])), [*x.T, [1, 2]], atol=1e-6)
    assert_allclose(np.array((model.inverse | model)(*value)), value, atol=1e-6)
    assert_allclose(np.array((model.inverse | model).inverse(*value)), value, atol=1e-6)


def test_both_outputs_depend_on_both_inputs(solution):
    model = solution[solution.names[0]].model
    for each in (model, model.inverse, solution[solution.names[0]].distortion.model()):
        assert_array_equal(separability_matrix(each), np.ones((2, 2), dtype=bool))
    assert_array_equal(
        separability_matrix(model & models.Scale(2)), [[True, True, False], [True, True, False], [False, False, True]]
    )


def test_quantities_in_quantities_out(solution):
    name = solution.names[2]
    model, distortion = solution[name].model, solution[name].distortion
    p = detector_points(solution, name)[:-4]
    x = solution[name].correct(p)
    for function, at in (
        (model, x),
        (model.inverse, p),
        (distortion.model(), similarity.apply(solution.poses[name], x)),
    ):
        plain, unit = function(*at.T), function(*(at * u.pix).T)
        assert_array_equal(u.Quantity(unit).to_value(u.pix), plain)
        with pytest.raises(InputError, match="positions must be in pixels, got deg"):
            function(*(at * u.deg).T)
    for function, at in ((solution[name].correct, p), (solution[name].distort, x)):
        unit = function(at * u.pix)
        assert unit.unit == u.pix
        assert_array_equal(unit.value, function(at))
        assert not isinstance(function(at), u.Quantity)
        with pytest.raises(InputError, match="positions must be in pixels, got arcsec"):
            function(at * u.arcsec)


def test_matches_take_any_unit_that_is_pixels(solution):
    sim = simulate_matches(n_stars=40, n_exposures=3, shape=(400, 300), degree=1, static=1, seed=1).matches
    thousandth = u.def_unit("mpx", 1e-3 * u.pix)
    table = sim.table.copy()
    for name in ("x", "y", "x_err", "y_err"):
        table[name] = table[name].to(thousandth)
    matches = Matches.from_table(table, shape=(400, 300), poses=sim.poses)
    assert_allclose(matches.observations.xy, sim.observations.xy, rtol=1e-12)
    table["x"] = table["x"].value * u.arcsec
    with pytest.raises(InputError, match="column 'x' cannot be read as numbers in pix"):
        Matches.from_table(table, shape=(400, 300))


@pytest.mark.parametrize("fitter", [fitting.LinearLSQFitter, fitting.TRFLSQFitter, fitting.LevMarLSQFitter])
def test_a_series_is_fitted_by_astropy(fitter):
    """The derivatives of the stock model forget its domain in non-linear fits, and the coefficients go astray."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform([[0], [0]], [[1199], [699]], (2, 200))
    box = {"x_domain": (-0.5, 1199.5), "y_domain": (-0.5, 699.5)}
    truth = models.Legendre2D(3, 2, **box, **{f"c{i}_{j}": rng.normal() for i in range(4) for j in range(3)})
    start = FastLegendre2D(3, 2, **box, fixed={"c1_1": True}, c1_1=truth.c1_1.value)
    start.valid = (-10.0, 1210.0, -10.0, 710.0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Model is linear")  # advice, when a non-linear fitter is used
        fitted = fitter()(start, x, y, truth(x, y), weights=rng.uniform(1, 2, 200))
        both = start + FastLegendre2D(0, 0, **box, fixed={"c0_0": True})
        total = fitted if fitter is fitting.LinearLSQFitter else fitter()(both, x, y, truth(x, y))
    assert_allclose(fitted.parameters, truth.parameters, rtol=0, atol=1e-9)
    assert_allclose(total.parameters[:12], truth.parameters, rtol=0, atol=1e-9)
    assert type(fitted) is FastLegendre2D
    assert fitted.valid == start.valid


def test_derivatives_are_those_of_the_stock_model():
    box = {"x_domain": (-0.5, 99.5), "y_domain": (-0.5, 49.5)}
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 20))
    ours, stock = (cls(2, 3, **box) for cls in (FastLegendre2D, models.Legendre2D))
    assert_array_equal(ours.fit_deriv(x, y, *ours.parameters), stock.fit_deriv(x, y, *stock.parameters))


@pytest.mark.parametrize("fitter", [fitting.LinearLSQFitter, fitting.TRFLSQFitter])
@pytest.mark.parametrize("size", [8, 2048])
@pytest.mark.parametrize("window", [(-1, 1), (0, 1)])
def test_series_of_small_and_large_detectors_are_fitted(fitter, size, window):
    """Stars may lie beyond the detector, and the series may have another window."""
    x, y = np.random.default_rng(4).uniform(-0.3 * size, 1.3 * size, (2, 300))
    box = {"x_domain": (-0.5, size - 0.5), "y_domain": (-0.5, size - 0.5), "x_window": window, "y_window": (-1, 1)}
    truth = models.Legendre2D(2, 1, **box, c0_0=0.3, c1_0=-1.0, c2_1=0.7)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Model is linear")
        fitted = fitter()(FastLegendre2D(2, 1, **box), x, y, truth(x, y))
    assert_allclose(fitted.parameters, truth.parameters, rtol=0, atol=1e-9)


@pytest.mark.parametrize("fitter", [fitting.TRFLSQFitter, fitting.LevMarLSQFitter])
def test_the_model_of_an_exposure_is_fitted_by_astropy(solution, fitter):
    """One axis at a time, since astropy's fitters know one output only. The pose stays; stars may be at the edge."""
    name = solution.names[2]
    model, x = solution[name].model, solution[name].correct(detector_points(solution, name))
    moved = np.array(model(*x.T)) + np.array([[0.3], [0.2]]) + 1e-4 * x.T
    for axis in (0, 1):
        start = model.copy()
        for parameter in start.param_names:
            if parameter.endswith("_34"[2 - axis]):  # of the other axis
                getattr(start, parameter).fixed = True
        fitted = fitter()(start | models.Mapping((axis,), n_inputs=2), *x.T, moved[axis])
        assert_allclose(fitted(*x.T), moved[axis], rtol=0, atol=1e-5)
        assert_array_equal(fitted.parameters[:6], model.parameters[:6])
        assert getattr(fitted, f"c3_3_{3 + axis}") == 0


def test_our_fitter_takes_it_whole(solution):
    name = solution.names[2]
    model, x = solution[name].model, solution[name].correct(detector_points(solution, name))
    moved = np.array(model(*x.T)) + np.array([[0.3], [0.2]]) + 1e-4 * x.T
    fitted = fitting.LegendreDistortionFitter()(model, *x.T, *moved)
    assert_allclose(np.array(fitted(*x.T)), moved, rtol=0, atol=1e-9)
    assert valid_boxes(fitted) == valid_boxes(model)[:2]


# --- many at once ----------------------------------------------------------------------------------------------------


def evaluate(wcs, seed):
    """Both directions on points of the detector."""
    p = np.random.default_rng(seed).uniform([[0], [0]], [[1199], [699]], (2, 50_000))
    reference = wcs.get_transform("detector", "reference")(*p)
    return np.array([*reference, *wcs.get_transform("reference", "detector")(*reference), *wcs(*p)])


@pytest.mark.slow
def test_eight_threads_agree(solution):
    wcs = solution[solution.names[1]].wcs
    expected = [evaluate(wcs, seed) for seed in range(4)]
    with ThreadPoolExecutor(8) as pool:
        for seed, value in zip(list(range(4)) * 4, pool.map(evaluate, [wcs] * 16, list(range(4)) * 4), strict=True):
            assert_array_equal(value, expected[seed])


@pytest.mark.slow
def test_eight_processes_agree(solution):
    wcs = solution[solution.names[1]].wcs
    with ProcessPoolExecutor(8, mp_context=get_context("spawn")) as pool:
        for seed, value in enumerate(pool.map(evaluate, [wcs] * 8, range(8))):
            assert_array_equal(value, evaluate(wcs, seed))


MEMORY = """
import ctypes, gc, os, pickle, sys
import numpy as np

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

with open(sys.argv[1], "rb") as file:
    wcs = pickle.load(file)
size = os.path.getsize(sys.argv[1])
back = wcs.get_transform("reference", "detector")
back(*wcs.get_transform("detector", "reference")(np.arange(9.0), np.arange(9.0)))
wcs(np.arange(9.0), np.arange(9.0))
gc.collect()
before = resident()
grid = np.meshgrid(np.arange(2048.0), np.arange(2048.0))
assert np.isfinite(back(*wcs.get_transform("detector", "reference")(*grid))).all()
assert np.isfinite(wcs(*grid)).all()
gc.collect()
once = resident() - before - 2 * grid[0].nbytes / 1e6
wcs.invert(*wcs(*grid))
wcs(*grid)
del grid
gc.collect()
assert len(pickle.dumps(wcs)) < 1.1 * size, "the model has grown"
try:
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # what the allocator keeps for the next call is not ours
except OSError:
    pass
print(once, resident() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_nothing_stays_in_memory(tmp_path):
    """After an evaluation of 2048 x 2048 pixels both ways, by the figure of the operating system."""
    sim = simulate_matches(n_stars=40, n_exposures=3, seed=3)
    sky = TangentPlane(10.0, 20.0, np.array([[-1.0, 0, 1024.0], [0, 1.0, -1024.0]]) / 36000)
    solution = solve(
        Matches(sim.matches.table, sim.matches.shapes, sim.matches.poses, sky), prior=Prior(sim.truth.static)
    )
    (tmp_path / "wcs.pickle").write_bytes(pickle.dumps(solution[solution.names[0]].wcs))
    command = [sys.executable, "-c", MEMORY, str(tmp_path / "wcs.pickle")]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    once, at_last = map(float, run.stdout.split())
    assert once < 10
    assert at_last < 3


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
    path = write_wcs(solution[name], tmp_path / "w.asdf")
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
        assert meta["inverse_error_px"] == solution[name].distortion.inverse.error
        assert_allclose(meta["valid_undistorted_px"], solution[name].distortion.inverse.valid)
        stored = meta["wcs"]
    given = solution[name].wcs
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
    x = solution[name].correct(p[:-4])
    assert_allclose(
        np.column_stack(stored.get_transform("reference", "detector")(*x.T)), solution[name].distort(x), atol=1e-9
    )


def test_a_bare_model_goes_through_asdf(solution, tmp_path):
    model = solution[solution.names[0]].model
    asdf.AsdfFile({"model": model, "part": legendres(model)[0]}, version="1.5.0").write_to(tmp_path / "m.asdf")
    with asdf.open(tmp_path / "m.asdf", lazy_load=False, memmap=False) as file:
        again, part = file.tree["model"], file.tree["part"]
    assert type(part) is models.Legendre2D
    assert part.parameters.tobytes() == legendres(model)[0].parameters.tobytes()
    p = detector_points(solution, solution.names[0])
    assert_allclose(again.inverse(*p.T), model.inverse(*p.T), rtol=0, atol=1e-9)
    x = solution[solution.names[0]].correct(p[:-4])
    assert_allclose(again(*x.T), model(*x.T), rtol=0, atol=1e-9)
