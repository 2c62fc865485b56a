"""The fitter for astropy's modeling: against a dense solution, against astropy's fitters, and what it refuses."""

import subprocess
import sys
from importlib.metadata import entry_points

import numpy as np
import pytest
from astropy import units as u
from astropy.modeling import fitting
from astropy.modeling.models import (
    AffineTransformation2D,
    Identity,
    Legendre2D,
    Mapping,
    Pix2Sky_TAN,
    Polynomial2D,
    Shift,
)
from numpy.polynomial.legendre import legval2d
from numpy.testing import assert_allclose, assert_array_equal

from legdistort.exceptions import InputError, SolveError
from legdistort.geometry.fitter import LegendreDistortionFitter
from legdistort.geometry.models import leaves

NX, NY = 1200, 700
DOMAIN = {"x_domain": (-0.5, NX - 0.5), "y_domain": (-0.5, NY - 0.5)}
BOTH = Mapping((0, 1, 0, 1))


def series(degree, *, fixed=(), **values):
    above = {f"c{i}_{j}": True for i in range(degree + 1) for j in range(degree + 1) if i + j > degree}
    return Legendre2D(degree, degree, **DOMAIN, fixed=above | dict.fromkeys(fixed, True), **values)


def displacement(degree=3, *, fixed=((), ()), values=({}, {})):
    x, y = (series(degree, fixed=f, **v) for f, v in zip(fixed, values, strict=True))
    return Identity(2) + (BOTH | x & y)


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(3)
    x, y = rng.uniform([[0], [0]], [[NX - 1], [NY - 1]], (2, 90))
    sigma = rng.uniform(0.02, 0.2, (2, 90))
    shift = 3e-6 * (x - 500) ** 2 - 2e-9 * (y - 300) ** 3, 1e-3 * x + 4e-6 * x * y
    return x, y, x + shift[0] + sigma[0] * rng.normal(size=90), y + shift[1] + sigma[1] * rng.normal(size=90), sigma


def modes(degree):
    """Orders in the order of the parameters: the index in x runs fastest."""
    return [(i, j) for j in range(degree + 1) for i in range(degree + 1) if i + j <= degree]


def vandermonde(x, y, degree):
    columns = []
    for i, j in modes(degree):
        tensor = np.zeros((degree + 1, degree + 1))
        tensor[i, j] = 1
        columns.append(legval2d(2 * (x + 0.5) / NX - 1, 2 * (y + 0.5) / NY - 1, tensor))
    return np.array(columns).T


def test_is_found_by_astropy():
    (point,) = [p for p in entry_points(group="astropy.modeling") if p.name == "LegendreDistortionFitter"]
    assert point.load() is LegendreDistortionFitter is fitting.LegendreDistortionFitter
    assert issubclass(LegendreDistortionFitter, fitting.Fitter)


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("legdistort", "legdistort.solving.estimation", "gwcs")]


@pytest.mark.parametrize(
    "first", [pytest.param("astropy.modeling", marks=pytest.mark.slow), "legdistort.geometry.fitter", *SLOW]
)
def test_is_found_whatever_is_imported_first(first):
    code = f"import {first}; from astropy.modeling.fitting import LegendreDistortionFitter"
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


@pytest.mark.parametrize("weighted", [True, False])
def test_is_the_dense_weighted_solution(data, weighted):
    x, y, x_data, y_data, sigma = data
    fit = LegendreDistortionFitter(calc_uncertainties=True)
    fitted = fit(displacement(), x, y, x_data, y_data, weights=tuple(1 / sigma) if weighted else None)
    design, residuals, covariances = vandermonde(x, y, 3), [], []
    for axis, (measured, start, err) in enumerate(zip((x_data, y_data), (x, y), sigma, strict=True)):
        w = 1 / err if weighted else np.ones(90)
        expected = np.linalg.lstsq(design * w[:, None], (measured - start) * w, rcond=None)[0]
        got = [getattr(fitted, f"c{i}_{j}_{axis + 2}").value for i, j in modes(3)]
        assert_allclose(got, expected, rtol=0, atol=1e-9)
        residuals.append((measured - start - design @ expected) * w)
        covariances.append(np.linalg.inv((design * w[:, None]).T @ (design * w[:, None])))
    chi2 = np.sum(np.square(residuals))
    info = fit.fit_info
    assert info["chi2"] == pytest.approx(chi2, rel=1e-10)
    assert (info["dof"], info["rank"]) == (2 * 90 - 20, 20)
    assert 1 < info["condition"] < 10
    assert info["param_names"] == [f"c{i}_{j}_{k}" for k in (2, 3) for i, j in modes(3)]
    assert_allclose(info["cov_x"][:10, :10], covariances[0], rtol=1e-9, atol=1e-12 * covariances[0].max())
    assert_allclose(info["cov_x"][10:, 10:], covariances[1], rtol=1e-9, atol=1e-12 * covariances[1].max())
    assert_array_equal(np.abs(info["cov_x"][:10, 10:]) < 1e-12 * np.abs(info["cov_x"]).max(), True)
    # astropy: weights are taken at their word, without weights the scatter sets the scale
    scale = 1 if weighted else chi2 / (2 * 90 - 20)
    assert_allclose(info["param_cov"], info["cov_x"] * scale)
    assert fitted.cov_matrix["c2_0_2", "c2_0_2"] == pytest.approx(scale * info["cov_x"][2, 2])
    assert fitted.stds["c2_0_2"] == fitted.c2_0_2.std == pytest.approx(np.sqrt(scale * info["cov_x"][2, 2]))
    assert "c2_0_2" in repr(fitted.stds)
    assert_allclose(info["residuals"][0], x_data - fitted(x, y)[0], atol=1e-9)


def test_agrees_with_trf(data):
    """astropy's non-linear fitters take one output only, so an axis at a time."""
    x, y, x_data, y_data, sigma = data
    model = displacement(fixed=(("c1_1",), ("c0_3",)), values=({"c1_1": 0.3}, {"c0_3": -0.2}))
    fitted = LegendreDistortionFitter(calc_uncertainties=True)(model, x, y, x_data, y_data, weights=tuple(1 / sigma))
    for axis, measured in enumerate((x_data, y_data)):
        start = displacement(fixed=(("c1_1",), ("c0_3",)), values=({"c1_1": 0.3}, {"c0_3": -0.2}))
        for name in start.param_names:
            if name.endswith(f"_{3 - axis}"):  # of the other axis
                getattr(start, name).fixed = True
        one = fitting.TRFLSQFitter()(start | Mapping((axis,), n_inputs=2), x, y, measured, weights=1 / sigma[axis])
        for i, j in modes(3):
            name = f"c{i}_{j}_{axis + 2}"
            # compound models have no exact derivatives: TRF takes differences, and stops early
            assert getattr(fitted, name).value == pytest.approx(getattr(one, name).value, abs=1e-4)
    # a single series has exact derivatives in our subclass: to the last digits
    ours = leaves(displacement_of_ours())[2]
    trf = fitting.TRFLSQFitter(calc_uncertainties=True)
    with pytest.warns(Warning, match="linear"):
        one = trf(ours, x, y, x_data - x, weights=1 / sigma[0])
    free = LegendreDistortionFitter(calc_uncertainties=True)(displacement(), x, y, x_data, y_data, weights=1 / sigma[0])
    for i, j in modes(3):
        assert getattr(one, f"c{i}_{j}").value == pytest.approx(getattr(free, f"c{i}_{j}_2").value, abs=1e-9)
        assert one.stds[f"c{i}_{j}"] == pytest.approx(free.stds[f"c{i}_{j}_2"], rel=1e-9)


def displacement_of_ours():
    from legdistort.geometry.models import displacement_model

    tensors = np.zeros((2, 4, 4))
    return displacement_model(tensors, (NY, NX))


def test_fixed_coefficients_and_what_is_no_series_stay(data):
    x, y, x_data, y_data, _ = data
    static = Mapping((0, 1, 0, 1)) | Polynomial2D(2, c2_0=1e-6) & Polynomial2D(2)
    form = displacement(2, fixed=(("c1_1",), ()), values=({"c1_1": 0.25}, {"c0_0": 7.0}))
    model = (Shift(3.0) & Shift(-2.0)) | (form + static)
    before = model.parameters.copy()
    fit = LegendreDistortionFitter(calc_uncertainties=True)
    fitted = fit(model, x, y, x_data, y_data)
    assert_array_equal(model.parameters, before)
    assert fitted is not model
    assert fitted.offset_0 == 3
    assert fitted.c1_1_4 == 0.25
    assert fitted.c2_0_7 == 1e-6
    assert fit.fit_info["rank"] == 11
    assert fitted.stds["c0_0_4"] > 0
    rest = fit(fitted, *(a for a in (x, y, x_data, y_data)))
    assert_allclose(rest.parameters, fitted.parameters, atol=1e-9)
    assert LegendreDistortionFitter()(model, x, y, x_data, y_data, inplace=True) is model
    assert_array_equal(model.parameters, fitted.parameters)


def test_pose_in_front_and_plain_pair(data):
    x, y, x_data, y_data, _ = data
    turn = AffineTransformation2D(matrix=[[0.0, -1.0], [1.0, 0.0]], translation=[NX - 1.0, 0.0])
    plain = displacement()
    a = LegendreDistortionFitter()(plain, *turn(x, y), x_data, y_data)
    b = LegendreDistortionFitter()(turn | plain, x, y, x_data, y_data)
    assert_allclose(np.array(b(x, y)), np.array(a(*turn(x, y))), atol=1e-9)
    pair = LegendreDistortionFitter()(BOTH | series(3) & series(3), x, y, x_data, y_data)
    full = LegendreDistortionFitter()(plain, x, y, x_data, y_data)
    assert_allclose(np.array(pair(x, y)), np.array(full(x, y)), atol=1e-9)


def test_quantities_masks_and_weights(data):
    x, y, x_data, y_data, sigma = data
    fit = LegendreDistortionFitter()
    plain = fit(displacement(), x, y, x_data, y_data, weights=tuple(1 / sigma))
    units = fit(
        displacement(), x * u.pix, y * u.pix, x_data * u.pix, y_data * u.pix, weights=tuple((1 / sigma) / u.pix)
    )
    assert_array_equal(units.parameters, plain.parameters)
    grid = fit(
        displacement(), *(a.reshape(9, 10) for a in (x, y, x_data, y_data)), weights=(1 / sigma).reshape(2, 9, 10)[0]
    )
    assert_allclose(
        grid.parameters, fit(displacement(), x, y, x_data, y_data, weights=1 / sigma[0]).parameters, atol=1e-12
    )
    few = fit(displacement(), x[1:], y[1:], x_data[1:], y_data[1:], weights=5.0)
    assert fit.fit_info["dof"] == 2 * 89 - 20
    masked = np.ma.array(x_data, mask=np.arange(90) == 0), np.ma.array(y_data, mask=np.arange(90) == 0)
    assert_allclose(fit(displacement(), x, y, *masked, weights=5.0).parameters, few.parameters, atol=1e-12)
    nan = np.where(np.arange(90) == 0, np.nan, x_data), y_data
    none = fit(displacement(), x, y, *nan, weights=np.where(np.arange(90) == 0, 0, 5.0))
    assert_allclose(none.parameters, few.parameters, atol=1e-12)
    assert fit.fit_info["dof"] == 2 * 89 - 20


def test_an_old_inverse_does_not_survive(data):
    x, y, x_data, y_data, _ = data
    inner = displacement()
    inner.inverse = Identity(2)
    model = (Shift(0) & Shift(0)) | inner
    model.inverse = Identity(2)
    fitted = LegendreDistortionFitter()(model, x, y, x_data, y_data)
    assert model.has_user_inverse
    with pytest.raises(NotImplementedError):
        fitted.inverse  # noqa: B018


def tied():
    part = series(2)
    part.c1_0.tied = lambda m: 0.0
    return Identity(2) + (BOTH | part & series(2))


def bounded():
    part = series(2)
    part.c1_0.bounds = (0, 1)
    return Identity(2) + (BOTH | part & series(2))


@pytest.mark.parametrize(
    ("model", "match"),
    [
        (Identity(2), "no Legendre2D part"),
        (series(2), "two inputs and two outputs"),
        ("a model", "must be one astropy model"),
        (displacement() | Pix2Sky_TAN(), r"not linear in its free Legendre coefficients"),
        (tied(), "coefficient c1_0_2 is tied or bounded"),
        (bounded(), "coefficient c1_0_2 is tied or bounded"),
    ],
)
def test_refused_models(data, model, match):
    with pytest.raises(InputError, match=match):
        LegendreDistortionFitter()(model, *data[:4])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"x": np.zeros(3)}, r"must have the same shape and not be empty, got \[\(3,\), \(90,\)"),
        ({"weights": np.ones(5)}, r"weights must be a number, of shape \(90,\)"),
        ({"weights": -1.0}, "weights must be finite and not negative"),
        ({"weights": np.full(90, np.nan)}, "weights must be finite and not negative"),
        ({"x_data": np.full(90, np.nan)}, "90 of 90 positions are not finite, the first is number 0"),
        ({"x": np.zeros(90) * u.deg}, "positions must be in pixels, got deg"),
    ],
)
def test_refused_arrays(data, change, match):
    arguments = dict(zip(("x", "y", "x_data", "y_data"), data[:4], strict=True)) | change
    with pytest.raises(InputError, match=match):
        LegendreDistortionFitter()(displacement(), **arguments)


def test_what_is_not_determined_is_named(data):
    x, y, x_data, y_data, _ = data
    with pytest.raises(SolveError, match="7 positions do not determine 20 coefficients"):
        LegendreDistortionFitter()(displacement(), x[:7], y[:7], x_data[:7], y_data[:7])
    on_a_line = np.full(90, 0.5 * NY - 0.5)
    with pytest.raises(SolveError, match=r"rank 8, free are above all .*c0_1_2") as caught:
        LegendreDistortionFitter()(displacement(), x, on_a_line, x_data, y_data)
    assert "c3_0_2" not in str(caught.value)
    assert LegendreDistortionFitter()(
        displacement(0, fixed=(("c0_0",), ("c0_0",))), x, y, x_data, y_data
    ).parameters.tolist() == [0, 0]


# --- outliers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weighted", [True, False])
def test_clip_leaves_out_what_deviates(weighted):
    """The fit is the one without the gross errors, which an oracle leaves out by hand."""
    rng = np.random.default_rng(8)
    x, y = rng.uniform(0, 2000, (2, 200))
    found = np.stack([x + 0.5 + 1e-3 * y, y - 2e-7 * x * y]) + rng.normal(0, 0.02, (2, 200))
    found[:, :9] += rng.uniform(0.5, 30, (2, 9)) * rng.choice([-1, 1], (2, 9))
    fit, weights = LegendreDistortionFitter(), np.full(200, 1 / 0.02) if weighted else None
    clipped = fit(displacement(), x, y, *found, weights=weights, clip=5)
    assert np.flatnonzero(~fit.fit_info["used"]).tolist() == list(range(9))
    dof = fit.fit_info["dof"]
    by_hand = fit(displacement(), x[9:], y[9:], *found[:, 9:], weights=weights if weights is None else weights[9:])
    assert dof == fit.fit_info["dof"]
    assert_allclose(clipped.parameters, by_hand.parameters, rtol=0, atol=1e-10)
    assert fit.fit_info["used"].all()


def test_exact_positions_are_not_clipped():
    x, y = np.random.default_rng(9).uniform(0, 2000, (2, 50))
    fit = LegendreDistortionFitter()
    fit(displacement(), x, y, x + 0.1, y, clip=3)
    assert fit.fit_info["used"].all()
    with pytest.raises(InputError, match="clip must be a number of standard errors above 1, got 0"):
        fit(displacement(), x, y, x, y, clip=0)


def test_astropys_outlier_removal_fits_one_output_alone():
    """Which is why there is `clip`: when this changes, it can go."""
    x, y = np.random.default_rng(9).uniform(0, 2000, (2, 50))
    removal = fitting.FittingWithOutlierRemoval(LegendreDistortionFitter(), lambda values: np.ma.masked_array(values))
    with pytest.raises(TypeError):
        removal(displacement(), x, y, x, y)
