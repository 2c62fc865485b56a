"""The distortion against the published formula, its inverse, its folds and its astropy model."""

import copy
import pickle
import threading
import tracemalloc
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from astropy.modeling import models
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from oracle import predict

from legdistort.exceptions import FoldError, InputError
from legdistort.geometry import basis
from legdistort.geometry.distortion import TOLERANCE, Distortion
from legdistort.geometry.models import FastLegendre2D, displacement_model, outside

SHAPES = [(2048, 2048), (512, 2048), (1500, 300)]


def make(degree, peak, shape, seed=0):
    """Random coefficients that fall off with the degree, scaled to a peak displacement in pixels."""
    ix, iy = basis.orders(degree)
    a = np.random.default_rng(seed).normal(size=(2, len(ix))) / 3.0 ** (ix + iy)
    t = np.linspace(-1, 1, 41)
    u, v = (g.ravel() for g in np.meshgrid(t, t))
    a *= peak / np.hypot(*(a @ basis.values(degree, u, v))).max()
    return Distortion(a, shape, "exp7")


def detector_points(shape, n=3000, seed=1):
    """Random points, every edge and every corner."""
    ny, nx = shape
    rng = np.random.default_rng(seed)
    inside = rng.uniform([-0.5, -0.5], [nx - 0.5, ny - 0.5], (n, 2))
    x, y = rng.uniform(-0.5, nx - 0.5, n // 4), rng.uniform(-0.5, ny - 0.5, n // 4)
    edges = [np.column_stack([x, np.full_like(x, e)]) for e in (-0.5, ny - 0.5)]
    edges += [np.column_stack([np.full_like(y, e), y]) for e in (-0.5, nx - 0.5)]
    corners = [[e, f] for e in (-0.5, nx - 0.5) for f in (-0.5, ny - 0.5)]
    return np.concatenate([inside, *edges, corners])


def undistorted_points(distortion, n=400, seed=2):
    """Undistorted pixels that fall on the detector."""
    return distortion.invert(detector_points(distortion.shape, n, seed))


@pytest.mark.parametrize("shape", SHAPES)
def test_formula_of_the_paper(shape):
    d = make(3, 8.0, shape)
    q = detector_points(shape, 200)
    expected = predict(q, d.coefficients, np.eye(2, 3), shape)
    assert_allclose(d(q), expected, atol=1e-10)


@pytest.mark.parametrize("shape", SHAPES)
def test_jacobian_is_the_finite_difference(shape):
    d = make(5, 15.0, shape)
    q = detector_points(shape, 100)
    h = 1e-3
    for k in (0, 1):
        e = np.eye(2)[k] * h
        assert_allclose(d.jacobian(q)[:, :, k], (d(q + e) - d(q - e)) / (2 * h), atol=2e-7)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("peak", [5.0, 20.0])
@pytest.mark.parametrize("degree", [3, 5])
def test_inverse_undoes_within_the_promise(degree, peak, shape):
    d = make(degree, peak, shape, seed=degree)
    p = detector_points(shape)
    assert_allclose(d(d.invert(p)), p, atol=1e-9)
    assert d.inverse.error <= TOLERANCE
    model = d.model()
    assert_allclose(np.column_stack(model(*model.inverse(*p.T))), p, rtol=0, atol=TOLERANCE)
    q = undistorted_points(d)
    assert_allclose(np.column_stack(model(*q.T)), d(q), atol=1e-9)
    assert_allclose(np.column_stack(model.inverse(*model(*q.T))), q, atol=2 * TOLERANCE)


def test_stated_error_is_what_a_denser_grid_shows():
    d = make(5, 20.0, (600, 900))
    x, y = np.meshgrid(np.linspace(-0.5, 899.5, 301), np.linspace(-0.5, 599.5, 201))
    dense = d.round_trip_error(d.inverse.tensors, np.column_stack([x.ravel(), y.ravel()]))
    assert dense <= 2 * d.inverse.error
    assert d.round_trip_error(d.inverse.tensors) == d.inverse.error


def test_a_certified_inverse_is_checked_and_taken():
    d = make(3, 10.0, (300, 500))
    again = Distortion(d.coefficients, d.shape, "exp7", d.inverse)
    assert again.inverse is d.inverse
    with pytest.raises(FrozenInstanceError):
        again.certified = None
    wrong = replace(d.inverse, error=d.inverse.error + 1e-8)
    with pytest.raises(InputError, match=r"the inverse of the distortion of exposure exp7 misses by .* was certified"):
        Distortion(d.coefficients, d.shape, "exp7", wrong)
    with pytest.raises(InputError, match=r"misses by .* coefficients or inverse were changed since"):
        replace(again, coefficients=1.01 * d.coefficients)
    with pytest.raises(InputError, match="is stated to be valid in"):
        Distortion(d.coefficients, d.shape, certified=replace(d.inverse, valid=(0.0, 1.0, 0.0, 1.0)))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 5), st.floats(0, 10))
def test_newton_inverts_any_modest_distortion(seed, degree, peak):
    d = make(degree, peak, (700, 1000), seed)
    p = detector_points((700, 1000), 40)
    assert_allclose(d(d.invert(p)), p, atol=1e-8)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_low_degrees_have_models_too(degree):
    d = make(degree, 4.0, (100, 200))
    p = detector_points((100, 200), 50)
    assert_allclose(np.column_stack(d.model().inverse(*p.T)), d.invert(p), atol=1e-6)


def test_inverting_keeps_what_is_missing():
    d = make(3, 5.0, (100, 200))
    out = d.invert([[np.nan, 3.0], [4.0, 5.0]])
    assert np.isnan(out[0]).all()
    assert_allclose(d(out[1:]), [[4.0, 5.0]])
    assert np.isnan(d.invert([[np.nan, np.nan]])).all()
    assert d.invert(np.empty((0, 2))).shape == (0, 2)


# --- folds -------------------------------------------------------------------------------------------------------


def folded(strength=130.0):
    """x is squeezed towards the right edge: dx/dq = 1 - 4 strength (u + 1) / 1000, and no x beyond 480 is reached."""
    a = basis.project(lambda u, v: np.stack([-strength * (u + 1) ** 2, 0 * v]), 2)
    return Distortion(a, (400, 1000), "exp7")


def test_a_fold_is_found_and_its_place_named():
    d = folded()
    edge = basis.denormalize([1.0], [0.3], (400, 1000))
    assert_allclose(np.linalg.det(d.jacobian(edge)), -0.04, atol=1e-9)
    place = r"exposure exp7 folds \(Jacobian determinant -0\.04\) near pixel \(1000, \d+\)"
    with pytest.raises(FoldError, match=place + ".*too few stars there for degree 2?"):
        d.check_fold()
    with pytest.raises(FoldError, match="exp7 folds"):
        d.model()
    folded(112.0).check_fold()  # determinant 0.104
    with pytest.raises(FoldError, match="exp7 folds"):
        folded(113.0).check_fold()


def test_a_hidden_fold_in_the_middle_is_found():
    """A small steep feature of degree 9 between the corners."""
    a = np.zeros((2, basis.n_modes(9)))
    ix, iy = basis.orders(9)
    a[0, (ix == 9) & (iy == 0)] = 40.0
    a[1, (ix == 0) & (iy == 1)] = 0.1
    with pytest.raises(FoldError, match="folds"):
        Distortion(a, (300, 300)).check_fold()


def test_an_inverse_beyond_degree_30_is_refused():
    """1.275 v - 0.275 v^3 along one axis: its inverse is steep at the edge."""
    tensor = np.zeros((2, 4, 4))
    tensor[1, 0, [1, 3]] = [16.5, -16.5]
    with pytest.raises(FoldError, match=r"no inverse .*exp7 up to degree 30 is better than"):
        _ = Distortion(basis.from_tensor(tensor), (300, 400), "exp7").inverse


def test_a_point_that_nothing_is_mapped_on():
    d = folded()
    with pytest.raises(FoldError, match=r"exp7 cannot be inverted near pixel \(700, 200\)"):
        d.invert([[100.0, 200.0], [700.0, 200.0]])


def test_bad_coefficients():
    for bad, message in [
        (np.zeros((3, 10)), r"must be finite, of shape \(2, n_modes\), got shape \(3, 10\)"),
        (np.full((2, 3), np.nan), "must be finite"),
        (np.zeros((2, 4)), "n = 4 is not a number of modes"),
    ]:
        with pytest.raises(InputError, match=message):
            Distortion(bad, (10, 10))


# --- the astropy model -------------------------------------------------------------------------------------------


def fast(nx=4, ny=2, seed=0):
    c = np.random.default_rng(seed).normal(size=(nx + 1, ny + 1))
    values = {f"c{i}_{j}": c[i, j] for i in range(nx + 1) for j in range(ny + 1)}
    limits = {"x_domain": (-0.5, 299.5), "y_domain": (-0.5, 99.5), "x_window": (-1, 1), "y_window": (-0.5, 2)}
    return FastLegendre2D(nx, ny, **limits, **values), models.Legendre2D(nx, ny, **limits, **values)


@pytest.mark.parametrize("degrees", [(1, 1), (3, 3), (4, 2), (2, 5), (13, 13)])
def test_fast_is_the_stock_model(degrees):
    quick, stock = fast(*degrees)
    x, y = np.random.default_rng(1).uniform(-20, 320, (2, 20_000))  # more than one block
    for points in ((x, y), (x.reshape(40, 500), y.reshape(40, 500)), (3.0, 4.0), (x[:1], y[:1]), (x[:0], y[:0])):
        got = quick(*points)
        assert np.shape(got) == np.shape(points[0])
        assert_allclose(got, stock(*points), rtol=0, atol=1e-11 * np.abs(stock(x, y)).max())
    again = quick.stock()
    assert type(again) is models.Legendre2D
    assert_array_equal(again.parameters, stock.parameters)
    assert again.param_names == stock.param_names
    assert (again.x_domain, again.y_domain, again.x_window, again.y_window) == (
        stock.x_domain,
        stock.y_domain,
        stock.x_window,
        stock.y_window,
    )


def test_fast_knows_where_it_is_valid():
    quick, stock = fast()
    quick.valid = (0.0, 10.0, 5.0, 20.0)
    x, y = np.array([0.0, 10, 5, -0.1, 10.1, 5, 5, np.nan]), np.array([5.0, 20, 10, 10, 10, 4.9, 20.1, 10])
    got = quick(x, y)
    assert_array_equal(np.isnan(got), [0, 0, 0, 1, 1, 1, 1, 1])
    assert_allclose(got[:3], stock(x[:3], y[:3]))
    assert np.isnan(quick(-1.0, 10.0))
    assert_array_equal(outside(quick.valid, x, y), np.isnan(got))


@pytest.mark.parametrize("remake", [copy.deepcopy, lambda m: m.copy(), lambda m: pickle.loads(pickle.dumps(m))])
def test_copies_are_whole(remake):
    d = make(3, 10.0, (300, 500))
    model = d.model()
    again = remake(model)
    q = undistorted_points(d)
    assert_array_equal(again(*q.T), model(*q.T))
    assert_array_equal(again.inverse(*q.T), model.inverse(*q.T))
    assert np.isnan(again(-400.0, -400.0)).all()  # the region of validity travels along
    assert again.name == "distortion"


def test_outside_the_image_of_the_detector_is_nan():
    d = make(3, 10.0, (300, 500))
    model = d.model()
    for q in ((-400.0, 100.0), (900.0, 100.0), (100.0, -300.0), (100.0, 700.0)):
        assert np.isnan(model(*q)).all()


def test_threads_do_not_disturb_each_other():
    """Eight threads on one model; the stock one mixes up the work of its callers."""
    model = make(5, 20.0, (2048, 2048)).model()
    rng = np.random.default_rng(0)
    jobs = [rng.uniform(0, 2047, (2, 30_000 + 1000 * k)) for k in range(8)]
    alone = [(model(*job), model.inverse(*job)) for job in jobs]
    got = [[] for _ in jobs]
    barrier = threading.Barrier(8)

    def work(k):
        barrier.wait()
        for _ in range(4):
            got[k].append((model(*jobs[k]), model.inverse(*jobs[k])))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    for k, expected in enumerate(alone):
        assert len(got[k]) == 4
        for result in got[k]:
            assert_array_equal(np.stack(result), np.stack(expected))


def test_nothing_large_stays_behind():
    model = make(5, 20.0, (1024, 1024)).model()
    y, x = np.mgrid[:1024, :1024].astype(float)
    model(x[:2], y[:2]), model.inverse(x[:2], y[:2])
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        model(x, y), model.inverse(x, y)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 0.2e6  # one image of doubles is 8.4 MB
    assert peak - before < 12 * x.nbytes
    assert len(pickle.dumps(model)) < 1e6


def test_models_do_not_depend_on_those_made_before():
    """astropy gathers the parameters of all series in their class."""
    tensors = np.random.default_rng(0).normal(size=(2, 2, 2))
    displacement_model(np.zeros((2, 12, 12)), (300, 200))
    for _ in range(2):
        series = displacement_model(tensors, (300, 200), name="d")["dy"]
        assert not hasattr(series, "c2_0")
        alike = FastLegendre2D(1, 1, (-0.5, 199.5), (-1, 1), (-0.5, 299.5), (-1, 1), **dict(zip(
            ("c0_0", "c1_0", "c0_1", "c1_1"), tensors[1].T.ravel(), strict=True)))  # fmt: skip
        assert series(20.0, 30.0) == alike(20.0, 30.0)
        series.parameters = 0.0  # which reaches no other


@pytest.mark.parametrize("degree", [1, 2, 3, 5, 8])
def test_no_slope_exceeds_its_bound(degree):
    """Beyond it the Jacobian need not be looked at for folds; one mode alone reaches it in a corner."""
    rng = np.random.default_rng(degree)
    t = np.linspace(-0.5, 299.5, 61)
    q = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    for scale in (0.1, 3.0):
        d = Distortion(rng.normal(0, scale, (2, basis.n_modes(degree))), (300, 300))
        assert np.linalg.norm(d.jacobian(q) - np.eye(2), axis=(1, 2)).max() <= d._largest_slope * (1 + 1e-12)
    alone = np.zeros((2, basis.n_modes(degree)))
    alone[0, -1] = 2.0
    d = Distortion(alone, (300, 300))
    steepest = np.linalg.norm(d.jacobian(q) - np.eye(2), axis=(1, 2)).max()
    assert steepest == pytest.approx(d._largest_slope)
