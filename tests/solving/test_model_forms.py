"""`solve(model=...)`: the form that a caller's astropy model gives to every exposure."""

import numpy as np
import pytest
from astropy.modeling.models import Gaussian2D, Identity, Legendre2D, Mapping, Polynomial2D, Rotation2D, Scale
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from oracle import predict
from scipy.optimize import least_squares

from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry import basis
from legdistort.geometry.models import FastLegendre2D, leaves
from legdistort.matching.matches import Matches
from legdistort.results.solution import Solution
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve
from legdistort.solving.model_forms import Form

NX, NY = 1200, 700
DETECTOR = {"x_domain": (-0.5, NX - 0.5), "y_domain": (-0.5, NY - 0.5)}
BOTH = Mapping((0, 1, 0, 1))
SIGMA = 0.05


def series(degree, *, fixed=(), domain=DETECTOR, triangular=True, **values):
    above = {f"c{i}_{j}": True for i in range(degree + 1) for j in range(degree + 1) if triangular and i + j > degree}
    return Legendre2D(degree, degree, **domain, fixed=above | dict.fromkeys(fixed, True), **values)


def form(degree=3, *, fixed=((), ()), domain=DETECTOR, values=({}, {}), **options):
    x, y = (series(degree, fixed=f, domain=domain, **v, **options) for f, v in zip(fixed, values, strict=True))
    return Identity(2) + (BOTH | x & y)


@pytest.fixture(scope="module")
def simulation():
    return simulate_matches(
        n_stars=60,
        n_exposures=5,
        shape=(NY, NX),
        dither=40,
        rotations=[0, 20, -60, 5, 90],
        dynamic=0.5,
        sigma=SIGMA,
        seed=2,
    )


@pytest.fixture(scope="module")
def plain(simulation):
    return solve(simulation.matches)


#: Fixed at other values than zero, in one axis and in both.
PARTLY = form(fixed=(("c3_0", "c1_1"), ("c2_1",)), values=({"c3_0": 0.3}, {}))
HELD = np.array([[0, 0, 0, 0, 1, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0, 1, 0, 0]], dtype=bool)


def obey(simulation, held, mean=0.0, *, keep=None):
    """The same stars and poses, with distortions whose modes `held` (2, n) are those of a mean; and these."""
    truth, matches = simulation.truth, simulation.matches
    rng, obs = np.random.default_rng(5), matches.observations
    table = QTable(matches.table, copy=True)
    n = held.shape[1]
    coefficients = np.zeros((len(matches.names), 2, n))
    coefficients[:, :, :10] = truth.coefficients[:, :, :n]
    coefficients[:, held] = np.broadcast_to(mean, held.shape)[held]
    for i, name in enumerate(matches.names):
        rows = obs.exposure == i
        stars = np.asarray(matches.stars)[obs.star[rows]].astype(int)
        xy = predict(truth.positions[stars], coefficients[i], truth.poses[name], (NY, NX))
        xy += rng.normal(0, SIGMA, xy.shape)
        table["x"][rows], table["y"][rows] = xy.T * table["x"].unit
    return Matches.from_table(table if keep is None else table[keep], shape=(NY, NX), poses=matches.poses), coefficients


@pytest.fixture(scope="module")
def obedient(simulation):
    """Distortions that are of the form `PARTLY`."""
    return obey(simulation, HELD, np.where(HELD & (np.arange(10) == 6), 0.3 / basis.norm(3) / basis.norm(0), 0))


def values(solution, name):
    """Both directions of the model of an exposure, where its detector is."""
    model = solution[name].model
    reference = model.inverse([100.0, 600.0, 1100.0], [50.0, 300.0, 650.0])
    return np.array([*model(*reference), *reference])


@pytest.mark.slow
def test_a_whole_form_is_the_usual_solution(simulation, plain):
    solution = solve(simulation.matches, model=form())
    assert_allclose(solution.coefficients, plain.coefficients, rtol=0, atol=1e-12)
    assert (solution.degree, solution.dof) == (3, plain.dof)
    assert solution.chi2 == pytest.approx(plain.chi2)
    for name in solution.names:
        pose, start, mapping, x, y = leaves(solution[name].model)
        assert pose.name == "pose"
        assert (type(start), type(mapping)) == (Identity, Mapping)
        assert isinstance(x, FastLegendre2D)
        assert tuple(x.x_domain) == DETECTOR["x_domain"]
        assert x.fixed["c3_3"]
        assert not y.fixed["c2_1"]
        assert_allclose(values(solution, name), values(plain, name), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "domain",
    [
        pytest.param({"x_domain": (0, 1000), "y_domain": (-100, 3000)}, marks=pytest.mark.slow),
        pytest.param(
            {"x_domain": (0, 2000), "y_domain": (0, 2000), "x_window": (-1, 0), "y_window": (0, 1)},
            marks=pytest.mark.slow,
        ),
        pytest.param({}, marks=pytest.mark.slow),
    ],
)
def test_any_domain_is_converted_exactly(simulation, plain, domain):
    solution = solve(simulation.matches, model=form(domain=domain))
    assert_allclose(solution.chi2, plain.chi2, rtol=1e-9)
    *_, x, _ = leaves(solution["exp01"].model)
    assert tuple(x.x_domain) == domain.get("x_domain", DETECTOR["x_domain"])
    assert tuple(x.x_window) == domain.get("x_window", (-1, 1))
    for name in solution.names:
        assert_allclose(values(solution, name), values(plain, name), rtol=0, atol=1e-7)


def test_models_that_are_no_stranger_than_our_own(simulation, plain):
    """What `Solution.model` gives goes in again: its pose gives way to those of the exposures."""
    given = plain["exp02"].model
    before = given.parameters.copy()
    solution = solve(simulation.matches, model=given)
    assert_array_equal(given.parameters, before)
    assert given.has_user_inverse
    assert solution.degree == 3
    expected = plain.coefficients[2].copy()
    assert_allclose(
        solution.estimate.prior_mean, np.broadcast_to(expected, solution.estimate.prior_mean.shape), rtol=0, atol=1e-9
    )
    assert solution.chi2 == pytest.approx(plain.chi2, rel=0.02)  # another start, another convention


def test_a_static_part_of_its_own(simulation):
    """Added, of higher degree than what is fitted, by a series or a polynomial: it is the static distortion."""
    none = [f"c{i}_{j}" for i in range(5) for j in range(5)]
    static = BOTH | series(4, fixed=none, c4_0=0.4) & Polynomial2D(2, c1_1=1e-6)
    fourth = 0.4 / basis.norm(4) / basis.norm(0)
    held = np.broadcast_to(np.arange(15) >= 6, (2, 15))
    matches, _ = obey(simulation, held, np.where(np.arange(15) == 10, fourth * np.array([[1], [0]]), 0))
    solution = solve(matches, model=form(2) + static)
    assert solution.degree == 2
    assert np.abs(solution.chi2 - solution.dof) < 4 * np.sqrt(2 * solution.dof)
    assert solution.coefficients.shape == (5, 2, 15)
    assert_allclose(solution.coefficients[:, 0, 10], fourth, rtol=1e-9)
    t = np.linspace(0, 600, 5)
    mean = solution.estimate.prior_mean[0] @ basis.values(4, *basis.normalize(np.stack([t, t], axis=1), (NY, NX)))
    u = 2 * (t + 0.5) / NX - 1
    assert_allclose(mean[0], 0.4 * np.polynomial.legendre.legval(u, [0, 0, 0, 0, 1]), atol=1e-9)
    assert_allclose(mean[1], 1e-6 * t * t, atol=1e-9)
    model = solution["exp03"].model
    assert model.c4_0_6 == 0.4
    assert model.c1_1_7 == 1e-6
    x = values(solution, "exp03")[2:]
    assert_allclose(np.array(model(*x)).T, solution["exp03"].distort(x.T), rtol=0, atol=1e-9)


def test_fixed_coefficients_keep_their_values(obedient):
    matches, _ = obedient
    solution = solve(matches, model=PARTLY)
    assert "converged after" in solution.status
    for name in solution.names:
        model = solution[name].model
        for parameter, value in (("c3_0_3", 0.3), ("c1_1_3", 0.0), ("c2_1_4", 0.0), ("c3_3_3", 0.0)):
            assert getattr(model, parameter) == value
            assert getattr(model, parameter).fixed
        assert model.c1_1_4 != 0
        x = values(solution, name)[2:]
        assert_allclose(np.array(model(*x)).T, solution[name].distort(x.T), rtol=0, atol=1e-9)
    assert_allclose(solution.coefficients[:, 0, 6], 0.3 / basis.norm(3) / basis.norm(0), rtol=1e-15)
    assert_array_equal(solution.coefficients[:, 0, 4], 0)
    assert np.abs(solution.chi2 - solution.dof) < 4 * np.sqrt(2 * solution.dof)
    assert np.nanstd(solution.residuals["dx"].value) == pytest.approx(SIGMA, rel=0.25)


@pytest.mark.slow
def test_fixed_coefficients_against_a_dense_solution(obedient):
    """All unknowns in one vector, without what is fixed; the gauge held for maps that all exposures take back."""
    matches, _ = obedient
    solution = solve(matches, model=PARTLY)
    obs, n_stars, names = matches.observations, len(matches.stars), matches.names
    mean, gauge = solution.estimate.prior_mean, solution.gauge

    def unpack(v):
        coefficients = mean.copy()
        coefficients[:, ~HELD] = v[2 * n_stars :].reshape(len(names), -1)
        return v[: 2 * n_stars].reshape(-1, 2), coefficients

    def residuals(v):
        positions, coefficients = unpack(v)
        r = np.empty_like(obs.xy)
        for i, name in enumerate(names):
            on = obs.exposure == i
            r[on] = obs.xy[on] - predict(positions[obs.star[on]], coefficients[i], solution.poses[name], (NY, NX))
        constraint = 1e3 * gauge.orthonormal @ (coefficients - mean).reshape(len(names), -1).ravel()
        return np.concatenate([(r / SIGMA).ravel(), constraint])

    start = np.concatenate([solution.estimate.positions.ravel(), mean[:, ~HELD].ravel()])
    dense = least_squares(residuals, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=20)
    assert solution.chi2 == pytest.approx(2 * dense.cost, rel=1e-5)
    positions, coefficients = unpack(dense.x)
    assert_allclose(solution.estimate.positions, positions, rtol=0, atol=0.02 * SIGMA)
    assert_allclose(solution.coefficients, coefficients, rtol=0, atol=0.1 * SIGMA)


def test_truth_is_found_better_with_what_is_known_fixed(obedient, simulation):
    """The predicted detector positions, which no gauge touches, against those of the truth."""
    (matches, coefficients), truth, off = obedient, simulation.truth, []
    stars = np.asarray(matches.stars).astype(int)
    for options in ({"model": PARTLY}, {"degree": 3}):
        solution = solve(matches, **options)
        for i, name in enumerate(matches.names):
            exact = predict(truth.positions[stars], coefficients[i], truth.poses[name], (NY, NX))
            off.append(np.nanmean((solution[name].distort(solution.estimate.positions) - exact) ** 2))
    fixed, free = np.sqrt(np.reshape(off, (2, -1)).mean(axis=1))
    assert fixed < free < SIGMA


def test_fewer_free_coefficients_need_fewer_stars(simulation):
    held = np.broadcast_to((np.arange(10) != 0) & (np.arange(10) != 6), (2, 10))
    table = simulation.matches.table
    keep = (table["exposure"] != "exp01") | (np.arange(len(table)) % 10 == 0)
    n = np.count_nonzero(table[keep]["exposure"] == "exp01")
    matches, _ = obey(simulation, held, keep=keep)
    assert 4 <= n < 10
    with pytest.warns(AssumptionWarning, match=f"exp01 is left out: its {n} stars .* do not determine its distortion"):
        assert "exp01" in solve(matches, model=form()).left_out
    others = [f"c{i}_{j}" for i in range(4) for j in range(4) if i + j > 0 and (i, j) != (3, 0)]
    solution = solve(matches, model=form(fixed=(others, others)))
    assert solution.degree == 3
    assert np.abs(solution.chi2 - solution.dof) < 4 * np.sqrt(2 * solution.dof)
    assert_array_equal(solution.coefficients[:, held], 0)
    assert np.all(solution.coefficients[:, :, 6] != 0)


def test_a_tensor_means_what_it_says(simulation):
    """Legendre2D(2, 2) with nothing fixed has terms up to total degree 4, and those between are fixed at zero."""
    held = np.zeros((2, 15), dtype=bool)
    held[:, [6, 9, 10, 11, 13, 14]] = True
    matches, _ = obey(simulation, held)
    solution = solve(matches, model=form(2, triangular=False))
    assert solution.degree == 4
    assert np.abs(solution.chi2 - solution.dof) < 4 * np.sqrt(2 * solution.dof)
    assert_array_equal(solution.coefficients[:, held], 0)
    assert np.all(solution.coefficients[:, :, [3, 4, 5, 7, 8, 12]] != 0)


def test_nothing_free_leaves_poses(simulation):
    everything = [f"c{i}_{j}" for i in range(4) for j in range(4)]
    second = 0.5 / basis.norm(2) / basis.norm(0)
    matches, _ = obey(
        simulation, np.ones((2, 10), bool), np.where(np.arange(10) == 3, second * np.array([[1], [0]]), 0)
    )
    solution = solve(matches, model=form(fixed=(everything, everything), values=({"c2_0": 0.5}, {})))
    assert np.abs(solution.chi2 - solution.dof) < 4 * np.sqrt(2 * solution.dof)
    assert solution.degree == 0
    assert_allclose(solution.coefficients[:, 0, 3], 0.5 / basis.norm(2) / basis.norm(0))
    assert solution["exp00"].model.c2_0_3 == 0.5


def test_a_file_keeps_the_solution_and_says_what_the_form_was(obedient, tmp_path):
    solution = solve(obedient[0], model=PARTLY)
    again = Solution.read(solution.write(tmp_path / "s.asdf"))
    assert again.estimate.form is None
    assert again.settings.model["fixed"]["c3_0_2"] == 0.3
    assert again.settings.model["n_free"] == 17
    assert_array_equal(again.coefficients, solution.coefficients)
    assert_allclose(values(again, "exp02"), values(solution, "exp02"), rtol=0, atol=1e-9)


def test_the_form_itself_explains_itself():
    assert repr(Form(PARTLY, {"a": (NY, NX)})) == "<Form: degree 3, 17 free coefficients>"


@pytest.mark.parametrize(
    ("model", "options", "match"),
    [
        (Identity(2), {}, "no Legendre2D part"),
        (form(fixed=(("c1_0",), ())), {}, "of the four linear coefficients .* fix all or none"),
        (
            form(fixed=(("c1_0",), ()), domain={"x_domain": (0, 99), "y_domain": (0, 99)}),
            {},
            "free coefficients of the model move",
        ),
        (form() + (BOTH | series(2) & series(2)), {}, "free coefficients of the model move 20 modes"),
        (
            BOTH | series(3) & series(3),
            {},
            "cannot be where the solution starts: the distortion of exposure the model folds",
        ),
        (form() + (BOTH | Gaussian2D(5, 300, 300, 20, 20) & Polynomial2D(1)), {}, "no polynomial of degree 30 or less"),
        ((Scale(1.0) & Scale(1.1)) | form(), {}, "must be a similarity"),
        (form() | form(), {}, "not linear"),
        (
            form(domain={}, values=({"c2_0": 1.0}, {})),
            {},
            r"has coefficients but no x_domain: .* x_domain=\(-0.5, 1199.5\)",
        ),
        (form(), {"degree": 5}, "free coefficients up to total degree 3: leave degree=5 out"),
        (form(2), {"degree": 3}, "free coefficients up to total degree 2: leave degree=3 out"),
        (form(), {"prior": {}}, "leave prior out"),
        (np.sin, {}, "must be one astropy model"),
    ],
)
def test_refused(simulation, model, options, match):
    with pytest.raises(InputError, match=match):
        solve(simulation.matches, model=model, **options)


def test_a_similarity_in_front_is_no_part_of_the_form(simulation, plain):
    turned = Rotation2D(30.0) | form()
    assert_allclose(solve(simulation.matches, model=turned).chi2, plain.chi2)
