"""Static distortions from published models, and the similarities that are no part of them."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.modeling import models
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import eval_legendre

import legdistort as ld
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


# --- a covariance in the place of widths --------------------------------------------------------------------------


def some_covariance(seed=0, n=10, size=0.02):
    factor = np.random.default_rng(seed).normal(size=(2 * n, 2 * n))
    return size**2 * factor @ factor.T / (2 * n)


def test_a_covariance_has_widths_and_is_kept(tmp_path):
    covariance = some_covariance()
    prior = Prior(np.zeros((2, 10)), static_covariance=covariance, shape=(50, 60))
    assert_allclose(prior.static_sigma.ravel(), np.sqrt(np.diag(covariance)))
    assert "with correlations" in repr(prior)
    read = Prior.read(prior.write(tmp_path / "prior.asdf"))
    assert_allclose(read.static_covariance, covariance, atol=1e-15)
    assert read.with_sigma(0.1).static_covariance is not None
    wider = read.with_static_sigma(0.3)
    assert wider.static_covariance is None
    assert_array_equal(wider.static_sigma, np.full((2, 10), 0.3))
    assert Prior.from_file(tmp_path / "prior.asdf", static_sigma=0.3).static_covariance is None
    camera = ld.Camera("C", {"1": ld.Detector((50, 60), static=prior)})
    again = ld.Camera.read(camera.write(tmp_path / "camera.asdf"))["1"]
    assert_allclose(again.static_covariance, covariance, atol=1e-15)
    assert_allclose(again.static_sigma, prior.static_sigma)


def test_to_another_degree_it_is_cut_or_exact():
    covariance = some_covariance()
    prior = Prior(np.zeros((2, 10)), static_covariance=covariance)
    low, high = prior.static_covariance_to(1), prior.static_covariance_to(4)
    kept = [0, 1, 2, 10, 11, 12]
    assert_allclose(low, covariance[np.ix_(kept, kept)], atol=1e-15)
    assert_allclose(np.sqrt(np.diag(high)).reshape(2, -1), prior.static_widths(4))
    assert Prior(np.zeros((2, 10)), static_sigma=1.0).static_covariance_to(2) is None


def test_what_is_unknown_is_infinite():
    covariance = some_covariance()
    covariance[3] = covariance[:, 3] = np.nan
    covariance[3, 3] = np.inf
    prior = Prior(np.zeros((2, 10)), static_covariance=covariance)
    assert np.isinf(prior.static_sigma[0, 3])
    assert np.isfinite(prior.static_sigma).sum() == 19


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"static_covariance": np.eye(3)}, r"static_covariance must be a covariance of shape \(20, 20\)"),
        ({"static_covariance": "large"}, "static_covariance must be numbers, a covariance in px"),
        ({"static_covariance": -np.eye(20)}, "gives a combination a negative variance"),
        ({"static_covariance": np.eye(20) + 2 * np.eye(20, k=1) + 2 * np.eye(20, k=-1)}, "negative variance"),
        ({"static_covariance": np.eye(20) + np.eye(20, k=1)}, "is not symmetric"),
        ({"static_covariance": np.full((20, 20), np.nan)}, "must be numbers, but for infinite variances"),
        ({"static_covariance": np.eye(20), "static_sigma": 0.5}, "static_sigma and static_covariance differ"),
    ],
)
def test_what_is_no_covariance_is_refused(words, message):
    with pytest.raises(InputError, match=message):
        Prior(np.zeros((2, 10)), **words)
    if "static_sigma" not in words:
        with pytest.raises(InputError, match=message):
            ld.Detector((50, 60), static=np.zeros((2, 10)), **words)


def test_without_a_mean_it_has_no_sense():
    with pytest.raises(InputError, match="static_covariance is that of a mean: give the mean as well"):
        Prior(None, static_covariance=np.eye(20))


def test_its_errors_are_on_the_maps(tmp_path):
    """Those of the series at a pixel, drawn by the covariance with numpy."""
    covariance = some_covariance(3)
    prior = Prior(np.zeros((2, 10)), static_covariance=covariance, shape=(40, 60))
    prior.write(tmp_path / "map.fits")
    found = [fits.getdata(tmp_path / f"map_{axis}_err.fits")[31, 7] for axis in "xy"]
    u, v = (2 * 7 + 1) / 60 - 1, (2 * 31 + 1) / 40 - 1
    legendre = [[eval_legendre(k, t) * np.sqrt(k + 0.5) for k in range(4)] for t in (u, v)]
    values = np.array([legendre[0][d - k] * legendre[1][k] for d in range(4) for k in range(d + 1)])
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(20), covariance, 40_000).reshape(-1, 2, 10)
    assert_allclose(found, (drawn @ values).std(axis=0), rtol=0.02)


def test_a_diagonal_one_is_the_widths():
    """In a solution: the same positions and errors, absolute ones too."""
    simulated = ld.simulate_matches(degree=2, n_exposures=5, n_stars=40, rotations=[0, 40, 0, 40, 0], seed=1)
    mean, widths = simulated.truth.static, np.full((2, 6), 0.05)
    widths[:, 4] = np.inf
    by_widths = Prior(mean, static_sigma=widths)
    by_covariance = Prior(mean, static_covariance=np.diag(widths.ravel() ** 2))
    for words in ({}, {"static": "fit"}):
        if words:
            by_widths = replace(by_widths, static_sigma=np.full((2, 6), 0.05))
            by_covariance = replace(by_widths, static_sigma=None, static_covariance=0.05**2 * np.eye(12))
        one, two = (
            ld.solve(simulated.matches, degree=2, prior=each, **words).stars for each in (by_widths, by_covariance)
        )
        for name in ("x", "y", "x_err", "x_err_abs"):
            assert_allclose(one[name].value, two[name].value, rtol=1e-6, atol=1e-9)


def test_it_has_the_unit_of_a_square():
    covariance = some_covariance()
    assert_allclose(
        Prior(np.zeros((2, 10)), static_covariance=covariance * u.pix**2).static_covariance, covariance, atol=1e-15
    )
    with pytest.raises(InputError, match="static_covariance"):
        Prior(np.zeros((2, 10)), static_covariance=covariance * u.kg)
