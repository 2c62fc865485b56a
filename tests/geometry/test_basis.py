"""The basis against numpy, astropy, quadrature and the paper."""

import numpy as np
import pytest
from astropy.modeling import models
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import legendre
from numpy.testing import assert_allclose, assert_array_equal

from legdistort.exceptions import InputError
from legdistort.geometry import basis

DEGREES = [0, 1, 2, 3, 5, 9]


def points(n=200, seed=0, reach=1.0):
    return np.random.default_rng(seed).uniform(-reach, reach, (2, n))


@pytest.mark.parametrize("degree", DEGREES)
def test_mode_index_is_that_of_the_paper(degree):
    """m = l(l+1)/2 + k is L_{l-k}(x) L_k(y)."""
    ix, iy = basis.orders(degree)
    assert len(ix) == len(iy) == basis.n_modes(degree) == (degree + 1) * (degree + 2) / 2
    for total in range(degree + 1):
        for k in range(total + 1):
            m = total * (total + 1) // 2 + k
            assert (ix[m], iy[m]) == (total - k, k)


def test_orders_cannot_be_changed_behind_the_cache():
    with pytest.raises(ValueError, match="read-only"):
        basis.orders(3)[0][0] = 7


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("reach", [1.0, 1.5])
def test_values_are_numpys(degree, reach):
    u, v = points(reach=reach)
    ix, iy = basis.orders(degree)
    for m, row in enumerate(basis.values(degree, u, v)):
        tensor = np.zeros((degree + 1, degree + 1))
        tensor[ix[m], iy[m]] = np.sqrt((2 * ix[m] + 1) / 2) * np.sqrt((2 * iy[m] + 1) / 2)
        expected = legendre.legval2d(u, v, tensor)
        assert_allclose(row, expected, rtol=0, atol=1e-13 * (1 + np.abs(expected).max()))


def test_printed_rows_of_the_paper():
    """Its basis for degree 2, the misprint sqrt5/4 (x^2 - 1) read as sqrt5/4 (3 x^2 - 1)."""
    u, v = points()
    rows = [
        0.5 + 0 * u,
        np.sqrt(3) / 2 * u,
        np.sqrt(3) / 2 * v,
        np.sqrt(5) / 4 * (3 * u**2 - 1),
        3 / 2 * u * v,
        np.sqrt(5) / 4 * (3 * v**2 - 1),
    ]
    assert_allclose(basis.values(2, u, v), rows, atol=1e-14)


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_is_orthonormal_on_the_square(degree):
    x, w = legendre.leggauss(degree + 1)
    u, v = np.meshgrid(x, x)
    b = basis.values(degree, u.ravel(), v.ravel())
    assert_allclose(b * np.outer(w, w).ravel() @ b.T, np.eye(len(b)), atol=1e-12)


def test_quadrature_is_exact_and_locked():
    u, v, w = basis.quadrature(4)
    assert_allclose(w.sum(), 4)
    assert_allclose((w * u**8 * v**6).sum(), 2 / 9 * 2 / 7)
    with pytest.raises(ValueError, match="read-only"):
        w[0] = 1


@pytest.mark.parametrize("degree", DEGREES)
def test_gradients_are_finite_differences(degree):
    u, v = points(reach=1.2)
    h = 1e-6
    b, du, dv = basis.gradients(degree, u, v)
    assert_array_equal(b, basis.values(degree, u, v))
    scale = 1e-8 * (1 + np.abs(b).max())
    assert_allclose(
        du, (basis.values(degree, u + h, v) - basis.values(degree, u - h, v)) / (2 * h), atol=scale / h**0.3
    )
    assert_allclose(
        dv, (basis.values(degree, u, v + h) - basis.values(degree, u, v - h)) / (2 * h), atol=scale / h**0.3
    )


def test_any_shape_of_points():
    u, v = points(24)
    flat = basis.values(3, u, v)
    assert basis.values(3, u.reshape(2, 3, 4), v.reshape(2, 3, 4)).shape == (10, 2, 3, 4)
    assert_array_equal(basis.values(3, u.reshape(2, 3, 4), v.reshape(2, 3, 4)).reshape(10, -1), flat)
    assert basis.values(3, 0.1, 0.2).shape == (10,)


@given(
    st.integers(1, 9000), st.integers(1, 9000), st.lists(st.tuples(*[st.floats(-1e4, 1e4)] * 2), min_size=1, max_size=5)
)
def test_normalising_is_invertible(ny, nx, xy):
    u, v = basis.normalize(xy, (ny, nx))
    assert_allclose(basis.denormalize(u, v, (ny, nx)), xy, atol=1e-8)


def test_pixel_edges_are_the_square():
    """Centres at integers: n pixels span -0.5 ... n - 0.5, x is the column."""
    u, v = basis.normalize([[-0.5, -0.5], [199.5, 99.5], [99.5, 49.5]], (100, 200))
    assert_array_equal(u, [-1, 1, 0])
    assert_array_equal(v, [-1, 1, 0])


@pytest.mark.parametrize("degree", DEGREES)
def test_tensor_is_astropys_legendre2d_and_back(degree):
    c = np.random.default_rng(degree).normal(size=(2, basis.n_modes(degree)))
    tensors = basis.to_tensor(c)
    assert tensors.shape == (2, degree + 1, degree + 1)
    i, j = np.indices((degree + 1, degree + 1))
    assert np.all(tensors[:, i + j > degree] == 0)
    u, v = points()
    for row, tensor in zip(c, tensors, strict=True):
        coefficients = {f"c{a}_{b}": tensor[a, b] for a in range(degree + 1) for b in range(degree + 1)}
        window = dict.fromkeys(("x_domain", "y_domain", "x_window", "y_window"), (-1, 1))
        if degree:  # the stock model takes no degree 0
            model = models.Legendre2D(degree, degree, **window, **coefficients)
            assert_allclose(model(u, v), row @ basis.values(degree, u, v), atol=1e-12)
            back = np.array([[getattr(model, f"c{a}_{b}").value for b in range(degree + 1)] for a in range(degree + 1)])
            assert_allclose(basis.from_tensor(back), row, rtol=1e-14)
    assert_allclose(basis.from_tensor(tensors), c, rtol=1e-14)


def test_tensor_of_high_total_degree_is_not_cut_in_silence():
    tensor = np.ones((3, 3))
    with pytest.raises(InputError, match=r"total degree above 2 \(largest coefficient 1\); give degree=4"):
        basis.from_tensor(tensor)
    c = basis.from_tensor(tensor, degree=4)
    u, v = points()
    assert_allclose(c @ basis.values(4, u, v), legendre.legval2d(u, v, tensor), atol=1e-12)


def test_changing_degree_keeps_the_common_modes():
    c = np.random.default_rng(0).normal(size=(4, 2, 10))
    assert_array_equal(basis.change_degree(c, 1), c[..., :3])
    wide = basis.change_degree(c, 5)
    assert wide.shape == (4, 2, 21)
    assert_array_equal(wide[..., :10], c)
    assert np.all(wide[..., 10:] == 0)
    same = basis.change_degree(c, 3)
    same[:] = 0
    assert np.all(c != 0)


@pytest.mark.parametrize("degree", DEGREES)
def test_projection_recovers_coefficients(degree):
    c = np.random.default_rng(1).normal(size=(2, basis.n_modes(degree)))
    assert_allclose(basis.project(lambda u, v: c @ basis.values(degree, u, v), degree), c, atol=1e-12)


def test_projection_is_the_least_squares_fit():
    c = basis.project(lambda u, v: np.exp(u) * np.cos(v), 3, n_nodes=20)
    u, v, w = basis.quadrature(19)
    left = np.exp(u) * np.cos(v) - c @ basis.values(3, u, v)
    assert_allclose(w * left @ basis.values(3, u, v).T, 0, atol=1e-13)


@given(st.integers(0, 60))
def test_number_of_modes_tells_the_degree(degree):
    assert basis.degree_of(basis.n_modes(degree)) == degree


@pytest.mark.parametrize("n", [-1, 0, 2, 4, 5, 11])
def test_wrong_number_of_modes(n):
    with pytest.raises(InputError, match=f"n = {n} is not a number of modes"):
        basis.degree_of(n)


@pytest.mark.parametrize("degree", [-1, 31, 2.5, True, "three", None, np.nan])
def test_wrong_degree(degree):
    with pytest.raises(InputError, match="fit_degree must be an integer from 0 to 30, got"):
        basis.check_degree(degree, "fit_degree")


def test_right_degree():
    assert [basis.check_degree(d) for d in (0, 30, 3.0, np.int64(2))] == [0, 30, 3, 2]
