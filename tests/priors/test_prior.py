"""Static distortions from published models, and the similarities that are no part of them."""

import numpy as np
import pytest
from astropy.modeling import models
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from legdistort.exceptions import InputError
from legdistort.geometry import basis, similarity
from legdistort.geometry.detector_modes import similarity_basis, similarity_part
from legdistort.geometry.distortion import Distortion
from legdistort.geometry.gsaoi import gsaoi_polynomials, gsaoi_static
from legdistort.priors.prior import Prior

SHAPE = (2048, 2048)


def pixels(shape=SHAPE, n=500, seed=0):
    ny, nx = shape
    p = np.random.default_rng(seed).uniform([-0.5, -0.5], [nx - 0.5, ny - 0.5], (n, 2))
    corners = [[e, f] for e in (-0.5, nx - 0.5) for f in (-0.5, ny - 0.5)]
    return np.concatenate([p, corners])


def published(detector):
    """GSAOI as published, 1-based pixel -> arcsec, without the package's own evaluation."""
    cx, cy = gsaoi_polynomials(detector)
    return lambda x, y: (np.polynomial.polynomial.polyval2d(x, y, cx), np.polynomial.polynomial.polyval2d(x, y, cy))


def on_detector(prior, shape, q_of_p):
    """Largest distance of D(q) and p, where the map, brought to pixels by ``prior.plane``, says that q belongs to p."""
    p = pixels(shape)
    q = similarity.apply(prior.plane, q_of_p(p))
    return np.hypot(*(Distortion(prior.mean, shape)(q) - p).T).max()


@pytest.mark.parametrize("degree", [3, 5, 9])
@pytest.mark.parametrize("detector", [1, 2, 3, 4])
def test_gsaoi_forward_and_its_truncation(detector, degree):
    prior = Prior.from_model(
        published(detector), shape=SHAPE, direction="detector_to_reference", origin=1, degree=degree
    )
    assert prior.degree == degree
    worst = on_detector(prior, SHAPE, lambda p: np.column_stack(published(detector)(*(p + 1).T)))
    assert worst == pytest.approx(prior.truncation, rel=0.02, abs=1e-8)  # the corners are among the points
    assert prior.truncation <= {3: 0.02, 5: 3e-5, 9: 1e-8}[degree]
    assert_allclose(similarity_part(prior.mean, SHAPE), similarity.identity(), atol=1e-10)
    assert similarity.describe(prior.plane)["scale"] == pytest.approx(1 / 0.0197, rel=0.01)
    similarity.check(prior.plane)


@pytest.mark.parametrize("detector", [1, 2, 3, 4])
def test_origin_and_model_forms_agree(detector):
    """The astropy model is 0-based, the published polynomial 1-based."""
    one = Prior.from_model(published(detector), shape=SHAPE, direction="detector_to_reference", origin=1)
    zero = Prior.from_model(gsaoi_static(detector), shape=SHAPE, direction="detector_to_reference", origin=0)
    assert_allclose(one.mean, zero.mean, atol=1e-8)
    assert_allclose(one.plane, zero.plane, rtol=1e-8, atol=1e-6)
    slipped = Prior.from_model(published(detector), shape=SHAPE, direction="detector_to_reference", origin=0)
    assert np.abs(slipped.mean - one.mean).max() > 1e-4


@pytest.mark.parametrize(("detector", "origin"), [pytest.param(2, 0, marks=pytest.mark.slow), (4, 1)])
def test_both_directions_give_the_same_prior(detector, origin):
    """The other direction is served by Newton's method on the published polynomials."""
    forward = published(detector)

    def backward(xi, eta):
        target = np.column_stack([xi, eta])
        p = np.full_like(target, 1024.0)
        for _ in range(7):
            step = np.array([[0.5, 0], [0, 0.5]])
            columns = [np.column_stack(forward(*(p + e).T)) - np.column_stack(forward(*(p - e).T)) for e in step]
            left = target - np.column_stack(forward(*p.T))
            p = p + np.linalg.solve(np.stack(columns, axis=2), left[..., None])[..., 0]
        return (p - 1 + origin).T

    there = Prior.from_model(forward, shape=SHAPE, direction="detector_to_reference", origin=1)
    back = Prior.from_model(backward, shape=SHAPE, direction="reference_to_detector", origin=origin)
    assert_allclose(back.mean, there.mean, atol=1e-6)
    assert_allclose(back.plane, there.plane, rtol=1e-7, atol=1e-5)
    assert back.truncation == pytest.approx(there.truncation, abs=1e-6)


def test_coarser_detector_sees_the_same_distortion():
    """In half as many pixels the coefficients are halved."""
    full = Prior.from_model(gsaoi_static(2), shape=SHAPE, direction="detector_to_reference")
    half = Prior.from_model(gsaoi_static(2, size=1024), shape=(1024, 1024), direction="detector_to_reference")
    assert_allclose(half.mean, full.mean / 2, atol=1e-7)


@settings(max_examples=6, deadline=None)
@given(st.floats(-180, 180), st.floats(1e-2, 10), st.sampled_from([1, -1]), st.floats(-1e3, 1e3), st.integers(0, 99))
def test_the_plane_does_not_matter(angle, scale, parity, shift, seed):
    """Whatever similarity follows the model, the mean is the same; the plane tells the similarity."""
    shape = (300, 500)
    a = np.random.default_rng(seed).normal(size=(2, 6))
    d = Distortion(a, shape)
    c, n = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turned = np.column_stack([scale * np.array([[c, -n], [n, c]]) @ np.diag([1, parity]), [shift, -shift]])
    first = Prior.from_model(
        lambda x, y: d.invert(np.column_stack([x, y])).T, shape=shape, direction="detector_to_reference", degree=2
    )
    second = Prior.from_model(
        lambda x, y: similarity.apply(turned, d.invert(np.column_stack([x, y]))).T,
        shape=shape,
        direction="detector_to_reference",
        degree=2,
    )
    assert_allclose(second.mean, first.mean, atol=1e-6)
    assert_allclose(similarity_part(second.mean, shape), similarity.identity(), atol=1e-8)
    assert_allclose(similarity.compose(second.plane, turned)[:, :2], first.plane[:, :2], atol=1e-8)
    assert similarity.describe(second.plane)["parity"] == parity


def test_a_similarity_alone_is_no_distortion():
    model = models.AffineTransformation2D(matrix=[[0, 0.02], [0.02, 0]], translation=[5, 7])
    for direction in ("detector_to_reference", "reference_to_detector"):
        prior = Prior.from_model(model, shape=(200, 300), direction=direction)
        assert_allclose(prior.mean, 0, atol=1e-8)
        assert prior.truncation < 1e-8


def test_shear_stays():
    model = models.AffineTransformation2D(matrix=[[1, 0.004], [0, 1]], translation=[0, 0])
    prior = Prior.from_model(model, shape=(200, 200), direction="reference_to_detector", degree=1)
    # p_x = q_x + 0.004 q_y; half of it is rotation, the other half a symmetric shear that stays
    expected = 0.002 * 100 * 2 / np.sqrt(3)
    assert_allclose(prior.mean[0, 2], expected, rtol=5e-3)
    assert_allclose(prior.mean[1, 1], expected, rtol=5e-3)


# --- words and refusals ------------------------------------------------------------------------------------------


def test_widths_are_broadcast():
    mean = np.zeros((2, 6))
    prior = Prior(mean, sigma=0.3, static_sigma=np.arange(6.0))
    assert_allclose(prior.sigma, np.full((2, 6), 0.3))
    assert_allclose(prior.static_sigma, [np.arange(6.0)] * 2)
    mean[0, 0] = 9
    assert prior.mean[0, 0] == 0


def test_repr_has_no_arrays():
    assert repr(Prior(np.zeros((2, 10)))) == "<Prior: degree 3, 10 modes an axis>"
    assert repr(Prior(np.zeros((2, 3)), sigma=1, static_sigma=0)) == (
        "<Prior: degree 1, 3 modes an axis, sigma given, static_sigma given>"
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mean": np.zeros(10)}, r"mean must have shape \(2, n_modes\), x then y, got \(10,\)"),
        ({"mean": np.zeros((2, 7))}, "n = 7 is not a number of modes"),
        ({"mean": np.full((2, 3), np.nan)}, "mean has values that are not finite"),
        ({"mean": np.zeros((2, 3)), "sigma": -1}, "sigma must be 0 or more"),
        ({"mean": np.zeros((2, 3)), "static_sigma": np.nan}, "static_sigma must be 0 or more"),
        ({"mean": np.zeros((2, 3)), "sigma": [1, 2]}, r"sigma must be a number, one per mode \(3,\).*got shape \(2,\)"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        Prior(**arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"direction": "forward"}, "direction must be 'detector_to_reference' or .*, got 'forward'"),
        ({"origin": 2}, r"origin must be 0 or 1 \(coordinate of the first pixel's centre\), got 2"),
        ({"degree": 31}, "degree must be an integer from 0 to 30"),
        (
            {"model": lambda x, y: (x, y * np.nan)},
            r"not finite on the detector, the first at pixel \[-0.5, -0.5\]; check shape and origin",
        ),
        (
            {"model": lambda x, y: (0 * x, 0 * y), "direction": "reference_to_detector"},
            "not finite, or constant, around the origin",
        ),
        ({"model": lambda x, y: (x - 0.02 * x**2, y)}, "cannot be inverted over the detector"),
    ],
)
def test_bad_models(changes, message):
    arguments = {"model": lambda x, y: (x, y), "shape": (100, 100), "direction": "detector_to_reference"} | changes
    with pytest.raises(InputError, match=message):
        Prior.from_model(arguments.pop("model"), **arguments)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("shape", [(100, 100), (300, 1200)])
def test_similarity_part_is_the_best_similarity(shape, degree):
    """Against a fit over the quadrature nodes of the detector."""
    a = np.random.default_rng(degree).normal(size=(2, basis.n_modes(degree)))
    u, v, w = basis.quadrature(6)
    q = basis.denormalize(u, v, shape)
    # the linear fit keeps shift, rotation, scale: displacement = t + (s - 1) q + r (-y, x), least squares
    target = Distortion(a, shape)(q)
    rows = similarity_basis(shape, basis.n_modes(degree))
    assert_allclose(rows @ rows.T, np.eye(len(rows)), atol=1e-12)
    if degree:
        assert_allclose(similarity_part(a, shape), similarity.fit_similarity(q, target, weights=w, parity=1), atol=1e-9)
    else:
        assert_allclose(similarity_part(a, shape), [[1, 0, a[0, 0] / 2], [0, 1, a[1, 0] / 2]])


def test_a_scatter_given_anew_keeps_the_rest():
    """Of modes that are not given nothing is known; the mean is zero where it has none."""
    prior = Prior(np.arange(6.0).reshape(2, 3) + 1, static_sigma=[0.1, 0.2, 0.3])
    for sigma in ([1.0, 2.0, 3.0], [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]):
        made = prior.with_sigma(sigma, degree=2)
        assert made.degree == 2
        assert_allclose(made.mean, np.pad(prior.mean, ((0, 0), (0, 3))))
        assert_allclose(made.sigma[:, :3], np.broadcast_to(sigma, (2, 3)))
        assert np.isinf(made.sigma[:, 3:]).all()
        assert_allclose(made.static_sigma, np.pad(prior.static_sigma, ((0, 0), (0, 3))))
        assert prior.with_sigma(sigma).degree == 1
    longer = prior.with_sigma(np.arange(6.0) + 1)  # only those of its own degree count
    assert_allclose(longer.sigma, [[1, 2, 3]] * 2)
    assert prior.with_sigma(0.5, degree=0).degree == 1
    assert Prior(None, static_sigma=2.0).with_sigma(None, degree=2).static_sigma == 2.0


def test_words_for_widths():
    assert Prior(np.zeros((2, 3)), sigma="evidence").sigma == "evidence"
    for words in ({"sigma": "some"}, {"static_sigma": "evidence"}):
        with pytest.raises(InputError, match=r"must be widths in pixels.*, got '"):
            Prior(np.zeros((2, 3)), **words)
    assert Prior(None, static_sigma=0.01).static_sigma == 0.01
    for size in (0.0, -1.0, np.inf, np.nan, None, True, "x"):
        with pytest.raises(InputError, match="without a mean, static_sigma must be a positive number"):
            Prior(None, static_sigma=size)
