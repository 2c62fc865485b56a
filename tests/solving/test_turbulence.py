"""Random fields of displacements: von Karman screens made by numpy alone, found and taken off with the right errors."""

import gwcs
import numpy as np
import pytest
from astropy import units as u
from astropy.modeling.models import Tabular2D
from astropy.table import QTable
from displaced_fields import displaced_by, optimum, sky, squared_pull
from numpy.testing import assert_allclose
from scipy.special import gamma, kv
from screens import covariance, screens

import legdistort as ld
from legdistort.exceptions import SolveError
from legdistort.solving.terms.random_field import SMOOTHNESS, Kernel


@pytest.fixture(scope="module")
def turbulent():
    """A field with screens of 0.1 px, stars that took no part, and the solution with the term."""
    field, others = displaced_by(31, screens(5, 31, rms=0.1), 40, n_exposures=5)
    return field, others, field.solve(terms="turbulence")


@pytest.mark.slow
def test_stars_are_as_good_as_who_knows_the_covariance_has_them(turbulent):
    field, others, solution = turbulent
    off, error = field.off(solution)
    least = optimum(field, lambda a, b: covariance(a, b, rms=0.1))
    assert np.sqrt(np.mean(off**2)) < 1.3 * np.sqrt(least)
    assert 0.6 < squared_pull(off, error) < 1.6
    assert 0.6 < others.pull(solution) < 1.6
    plain = field.solve(clip=None)
    assert plain.chi2 > 10 * plain.dof
    assert squared_pull(*field.off(plain)) > 5


def test_it_says_what_it_found(turbulent):
    field, _, solution = turbulent
    said = str(solution)
    assert "turbulence: a field of every exposure, 0.0" in said
    found = dict(zip(solution.terms["number"], solution.terms["value"], strict=True))
    assert 0.06 < found["size"] < 0.12
    assert found["axis ratio"] >= 1
    assert_allclose(solution.diagnostics.terms[0].rms, 0.09, rtol=0.35)
    assert not solution.residuals["x_terms"].value.any()  # it is in the distortions
    assert 0 < solution.dof < 0.3 * len(solution.residuals)
    assert_allclose(solution.residuals["x"], field.table["x"])


@pytest.mark.slow
def test_what_it_found_is_in_distortion_wcs_and_file(turbulent, tmp_path):
    """The WCS is made of stock models; errors of new positions are read again as they were."""
    _, _, solution = turbulent
    view = solution["e03"]
    assert view.distortion.inverse.error < 1e-3
    xy = np.random.default_rng(3).uniform(100, 1900, (50, 2))
    assert_allclose(np.column_stack(view.wcs(*xy.T)), view.correct(xy), atol=1e-3)
    assert_allclose(view.distort(view.correct(xy)), xy, atol=1e-6)
    assert any(isinstance(each, Tabular2D) for each in view.wcs.forward_transform.traverse_postorder())
    assert isinstance(view.wcs, gwcs.WCS)
    residual = [view.residuals[name].value for name in ("x", "y", "dx", "dy")]
    places = {str(name): k for k, name in enumerate(solution.stars["star"])}
    rows = [places[str(name)] for name in view.residuals["star"]]
    stars = np.column_stack([solution.stars[name].value[rows] for name in "xy"])
    seen = view.distort(stars)
    assert_allclose(seen, np.column_stack(residual[:2]) - np.column_stack(residual[2:]), atol=0.01)
    solution.write(tmp_path / "solution.asdf")
    again = ld.Solution.read(tmp_path / "solution.asdf")["e03"]
    known, read = (each.correct(xy, errors=np.full((50, 2), 0.01)) for each in (view, again))
    assert_allclose(read.relative, known.relative)
    assert_allclose(read.xy, known.xy)
    assert np.all(known.relative[:, 0, 0] > 0.01**2)


@pytest.mark.slow
def test_it_takes_itself_away():
    """White noise alone has no field, and nothing changes."""
    free = sky(32, n_stars=40, n_exposures=6)
    plain, solution = free.solve(), free.solve(terms=["turbulence"])
    assert "turbulence: the positions do not show it" in str(solution)
    for name in ("x", "y", "x_err", "x_err_abs"):
        assert_allclose(solution.stars[name], plain.stars[name], rtol=1e-9)
    assert not solution.estimate.displacement_tables


@pytest.mark.parametrize("nu", SMOOTHNESS)
def test_the_covariance_is_that_of_a_gradient(nu):
    """Minus the second derivatives of a Matern covariance of the potential, by finite differences."""
    kernel = Kernel(0.2, 100.0, nu, (0.4, -0.3))
    at, h = np.array([30.0, 55.0]), 0.05
    metric = kernel.metric

    def potential(d):
        w = np.hypot(*(metric @ d))
        order = nu + 1  # with minus the second derivative 1 at the origin
        return 2 ** (1 - nu) / gamma(nu + 1) * nu * w**order * kv(order, w) if w else 2 ** (order - 1) * gamma(order)

    unit = np.eye(2) * h
    second = [
        [-(potential(at + a + b) - potential(at + a - b) - potential(at - a + b) + potential(at - a - b)) for b in unit]
        for a in unit
    ]
    expected = 0.2**2 * np.array(second) / (4 * h**2 * abs(np.linalg.det(metric)))
    assert_allclose(kernel(np.zeros((1, 2)), at[None]), expected, rtol=2e-3, atol=1e-6)
    places = np.random.default_rng(1).uniform(0, 500, (30, 2))
    assert np.linalg.eigvalsh(kernel(places, places)).min() > 0


@pytest.mark.slow
def test_a_field_that_is_drawn_out_is_seen_so():
    """Its axis and ratio, of one that is made by its own covariance in numpy."""
    stretch = np.log(3.0) * np.array([np.cos(np.radians(60)), np.sin(np.radians(60))])
    kernel, rng = Kernel(0.2, 300.0, 1.5, tuple(stretch)), np.random.default_rng(4)

    def field(i, at):
        return (np.linalg.cholesky(kernel(at, at) + 1e-8 * np.eye(2 * len(at))) @ rng.normal(size=2 * len(at))).reshape(
            -1, 2
        )

    solution = sky(33, n_stars=60, n_exposures=5, extra=field).solve(terms="turbulence")
    found = dict(zip(solution.terms["number"], solution.terms["value"], strict=True))
    assert_allclose(found["angle"], 30, atol=12)
    assert 2 < found["axis ratio"] < 4.5
    assert "times as long along" in str(solution)


def test_what_cannot_be_done_is_said():
    free = sky(34, n_stars=20, n_exposures=4)
    with pytest.raises(SolveError, match="leave out pixel_phase, or turbulence"):
        free.solve(terms=["turbulence", "pixel_phase"])
    many = ld.simulate_matches(n_stars=4000, n_exposures=3, degree=1, seed=1).matches
    with pytest.raises(SolveError, match="give fewer stars or exposures"):
        ld.solve(many, degree=1, terms="turbulence")


@pytest.mark.parametrize(
    ("rms", "n_sets", "right_to"),
    [
        pytest.param(0.1, 3, 0.2, marks=pytest.mark.slow),
        pytest.param(0.1, 6, 0.2, marks=pytest.mark.sets),
        pytest.param(2.0, 6, 0.1, marks=pytest.mark.sets),
    ],
)
@pytest.mark.filterwarnings("ignore:turbulence has not settled")  # of fields 200 times as large as errors
def test_errors_are_calibrated(rms, n_sets, right_to):
    """Of stars, and of others that took no part."""
    wide = np.sqrt(6 / n_sets)
    squares, pulls, least = [], [], []
    for seed in range(n_sets):
        field, others = displaced_by(600 + seed, screens(11, 600 + seed, rms=rms), 65)
        solution = field.solve(terms="turbulence")
        off, error = field.off(solution)
        squares.append((np.sum(off**2), np.sum(error**2), len(off)))
        pulls.append(others.pull(solution))
        least.append(optimum(field, lambda a, b: covariance(a, b, rms=rms)))
    off, stated, _ = np.sum(squares, axis=0)
    assert_allclose(off / stated, 1, atol=0.2 * wide)
    assert_allclose(np.mean(pulls), 1, atol=right_to * wide)
    assert np.sqrt(np.mean([s[0] / s[2] / 2 for s in squares])) < 1.2 * np.sqrt(np.mean(least))


def one_exposure(seed, *, rms, n_known=400, n_others=60):
    """A `Matches`, a catalogue of most stars, the true positions, and rows of the others."""
    rng, n = np.random.default_rng(seed), n_known + n_others
    stars = rng.uniform(50, 1998, (n, 2))
    seen = stars + rng.normal(0, 0.01, (n, 2)) + (screens(1, seed, rms=rms)[0](stars) if rms else 0)
    table = QTable({"exposure": ["e00"] * n, "star": np.arange(n)})
    table["x"], table["y"] = seen.T * u.pix
    table["x_err"] = table["y_err"] = np.full(n, 0.02) * u.pix  # twice what they are
    catalogue = QTable({"star": np.arange(n_known)})
    catalogue["x"], catalogue["y"] = stars[:n_known].T * u.pix
    catalogue["x_err"] = catalogue["y_err"] = np.full(n_known, 1e-4) * u.pix
    return ld.Matches.from_table(table, shape=(2048, 2048)), catalogue, stars


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the offsets of the stars from the reference")
def test_one_exposure_has_its_field_from_a_catalogue():
    """Stars that the catalogue has not are right within their errors, and so is the factor on stated errors."""
    matches, catalogue, stars = one_exposure(41, rms=0.1)
    solution = ld.solve(matches, reference=catalogue, terms="turbulence")
    found = dict(zip(solution.terms["number"], solution.terms["value"], strict=True))
    for axis in "xy":
        assert_allclose(found[f"factor on {axis} errors"], 0.5, rtol=0.3)
    assert "times the stated errors in x and y" in solution.diagnostics.in_words()["terms"]
    others = np.asarray(solution.stars["star"]) >= len(catalogue)
    off = np.column_stack([solution.stars[name].value for name in "xy"]) - stars[np.asarray(solution.stars["star"])]
    error = np.column_stack([solution.stars[f"{name}_err_abs"].value for name in "xy"])
    plain = ld.solve(matches, reference=catalogue)
    assert np.sqrt(np.mean(off[others] ** 2)) < 0.045
    assert 0.4 < squared_pull(off[others], error[others]) < 1.4
    new = np.random.default_rng(42).uniform(100, 1900, (300, 2))
    seen = new + screens(1, 41, rms=0.1)[0](new)
    corrected = solution["e00"].correct(seen, errors=np.zeros((300, 2)))
    pulls = np.einsum("na,nab,nb->n", corrected.xy - new, np.linalg.inv(corrected.absolute), corrected.xy - new) / 2
    assert 0.6 < np.mean(pulls) < 1.5
    assert np.std(corrected.xy - new) < 0.6 * np.std(plain["e00"].correct(seen) - new)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the offsets of the stars from the reference")
def test_one_exposure_without_turbulence_has_none():
    matches, catalogue, _ = one_exposure(43, rms=0, n_known=200)
    plain, solution = (ld.solve(matches, reference=catalogue, terms=terms) for terms in ((), "turbulence"))
    assert "turbulence: the positions do not show it" in str(solution)
    assert_allclose(solution.stars["x"], plain.stars["x"], rtol=1e-9)
    matches, catalogue, _ = one_exposure(44, rms=0.1, n_known=25)  # too few to tell
    assert "do not show it" in str(ld.solve(matches, reference=catalogue, terms="turbulence"))
