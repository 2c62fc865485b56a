"""Distortions with a table of displacements beside the series, against numpy and scipy; their WCS in stock models."""

import copy
import pickle
from dataclasses import replace

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.modeling import models
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import RegularGridInterpolator

from legdistort import read_wcs
from legdistort.cameras.camera import Camera
from legdistort.cameras.detector import Detector
from legdistort.exceptions import FoldError, InputError
from legdistort.geometry import basis, similarity
from legdistort.geometry.distortion import TABLE_TOLERANCE, TOLERANCE, Distortion
from legdistort.geometry.models import nodes
from legdistort.geometry.tabulated.displacement_table import DisplacementTable
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.matching.matches import Matches
from legdistort.results.solution import Solution
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.storage import write_wcs

SHAPE = (300, 500)
RNG = np.random.default_rng(7)


def waves(q):
    x, y = np.asarray(q).T
    return 0.2 * np.stack([np.sin(x / 40) * np.cos(y / 50), np.cos(y / 45 + x / 60)], axis=1)


@pytest.fixture(scope="module")
def table():
    return DisplacementTable.of(waves, SHAPE, 8.0)


@pytest.fixture(scope="module")
def distortion(table):
    a = np.random.default_rng(3).normal(size=(2, 10))
    return Distortion(a, SHAPE, "e1", table=table)


def places(n=500, beyond=0.0, seed=1):
    ny, nx = SHAPE
    return np.random.default_rng(seed).uniform(-0.5 - beyond, [nx - 0.5 + beyond, ny - 0.5 + beyond], (n, 2))


def outside(q, table):
    """Linear interpolation by scipy, which goes on beyond the nodes."""
    axes = [
        first + step * np.arange(n)
        for first, step, n in zip(table.first, table.step, table.values.shape[:0:-1], strict=True)
    ]
    known = {"bounds_error": False, "fill_value": None}
    return np.stack([RegularGridInterpolator(axes, v.T, **known)(q) for v in table.values], axis=1)


def test_a_table_is_linear_between_and_beyond_its_nodes(table):
    q = places(beyond=100.0)
    assert_allclose(table(q), outside(q, table), rtol=0, atol=1e-12)
    inside = places()
    assert_allclose(table(inside), waves(inside), rtol=0, atol=0.002)
    h = 1e-5
    for k, e in enumerate(h * np.eye(2)):
        step = np.abs((inside - table.first) / table.step % 1 - 0.5).max(axis=1) < 0.49  # not across a kink
        found = (table(inside + e) - table(inside - e)) / (2 * h)
        assert_allclose(table.jacobian(inside)[step][:, :, k], found[step], rtol=0, atol=1e-8)
    assert np.linalg.norm(table.jacobian(table.cells), axis=(1, 2)).max() <= table.steepest


def test_sums_and_copies(table):
    coarse = DisplacementTable.of(lambda q: 0.3 * waves(q), SHAPE, (40.0, 20.0))
    q = places()
    assert_allclose((table + coarse)(q), table(q) + coarse(q), rtol=0, atol=1e-12)
    assert (table + coarse).values.shape == table.values.shape
    assert pickle.loads(pickle.dumps(table)) == copy.deepcopy(table) == table
    assert table != coarse
    assert table != 3
    assert repr(coarse).startswith("<DisplacementTable: 17 x 17 nodes, 0.0518 px rms>")
    assert DisplacementTable.from_models(*table.models()) == table


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"values": np.zeros((2, 1, 5))}, "two nodes or more"),
        ({"values": np.full((2, 3, 3), np.nan)}, "must be finite"),
        ({"step": (1.0, 0.0)}, r"\(dx, dy\) > 0 apart"),
        ({"first": (0.0,)}, "begin at"),
    ],
)
def test_what_is_no_table(given, message):
    with pytest.raises(InputError, match=message):
        DisplacementTable(**{"values": np.zeros((2, 3, 3)), "first": (0, 0), "step": (1, 1)} | given)


def test_models_that_are_no_table(table):
    x, y = table.models()
    for bad, message in (
        (models.Tabular2D(x.points, x.lookup_table), "should be linear"),
        (
            models.Tabular2D((x.points[0] ** 3, x.points[1]), x.lookup_table, bounds_error=False, fill_value=None),
            "grid",
        ),
    ):
        with pytest.raises(InputError, match=message):
            DisplacementTable.from_models(bad, y)
    with pytest.raises(InputError, match="table must be a DisplacementTable or None, got int"):
        Distortion(np.zeros((2, 1)), SHAPE, table=3)


def test_the_map_and_its_inverse(distortion, table):
    q = places(beyond=3.0)
    series = Distortion(distortion.coefficients, SHAPE)
    assert_allclose(distortion(q), series(q) + outside(q, table), rtol=0, atol=1e-10)
    assert_allclose(distortion.jacobian(q), series.jacobian(q) + table.jacobian(q), rtol=0, atol=1e-12)
    p = places(20_000, seed=2)
    assert_allclose(distortion(distortion.invert(p)), p, rtol=0, atol=1e-9)
    inverse = distortion.inverse
    assert_array_equal(inverse.tensors, series.inverse.tensors)
    assert series.inverse.table is None
    assert series.inverse.error <= TOLERANCE < inverse.error <= TABLE_TOLERANCE == distortion.tolerance
    back = np.column_stack(distortion.correction_model()(*p.T))
    assert np.abs(distortion(back) - p).max() <= TABLE_TOLERANCE
    again = Distortion(distortion.coefficients, SHAPE, "e1", inverse, table)
    assert again.same_as(distortion)
    assert not series.same_as(distortion)
    with pytest.raises(InputError, match="misses by"):
        replace(again, table=replace(table, values=1.02 * table.values))


def test_folds_and_ragged_tables():
    steep = DisplacementTable.of(lambda q: 400 * waves(q), SHAPE, 4.0)
    with pytest.raises(FoldError, match="folds"):
        Distortion(np.zeros((2, 3)), SHAPE, table=steep).check_fold()
    ragged = DisplacementTable(RNG.normal(0, 0.2, (2, 30, 40)), (-10.0, -10.0), (13.5, 11.5))
    with pytest.raises(FoldError, match="too ragged"):
        Distortion(np.zeros((2, 3)), SHAPE, table=ragged).inverse.error  # noqa: B018


def test_the_model_of_it(distortion):
    model, p = distortion.model(), places()
    inverse = np.column_stack(model.inverse(*p.T))
    assert_allclose(np.column_stack(model(*inverse.T)), p, rtol=0, atol=TABLE_TOLERANCE)
    assert_allclose(np.column_stack(model(*inverse.T)), distortion(inverse), rtol=0, atol=1e-11)
    x, y = model(*(inverse.T * u.pix))
    assert_allclose(np.column_stack([x.to_value(u.pix), y.to_value(u.pix)]), distortion(inverse), rtol=0, atol=1e-11)
    assert np.isnan(model(-500.0, 10.0)).all()
    assert type(copy.deepcopy(model).right.right).__name__ == "CompoundModel"
    plain = Distortion(distortion.coefficients, SHAPE).model()
    assert {type(node).__name__ for node in nodes(plain)} == {"CompoundModel", "Identity", "Mapping", "FastLegendre2D"}


# -- in solutions


@pytest.fixture(scope="module")
def solution(table):
    sky = TangentPlane(85.0, -70.0, np.array([[-2e-5, 0, 0.005], [0, 2e-5, -0.003]]))
    sim = simulate_matches(n_stars=40, n_exposures=3, degree=2, shape=SHAPE, dither=20, sky=sky, seed=1)
    made = solve(sim.matches, degree=2)
    static = DisplacementTable.of(lambda q: 0.1 * waves(q), SHAPE, 16.0)
    known = {"displacement_tables": {"exp00": table}, "static_tables": {"1": static}, "certified": {}}
    return replace(made, estimate=replace(made.estimate, **known))


def test_views_have_both_tables(solution, table):
    q = places()
    assert_allclose(solution["exp00"].distortion.table(q), 1.1 * waves(q), rtol=0, atol=0.003)
    assert_allclose(solution["exp01"].distortion.table(q), 0.1 * waves(q), rtol=0, atol=0.001)
    view = solution["exp00"]
    assert view.distortion is view.distortion
    assert_allclose(view.distort(view.correct(q)), q, rtol=0, atol=1e-8)
    assert_allclose(
        view.distort(view.correct(q)[:5]) - view.distortion(view.distortion.invert(q[:5])), 0, rtol=0, atol=1e-8
    )
    assert view.sigma_map(n=8)[2].shape == (5, 8, 2)
    header = view.header(kind="sip", max_error=1.0)
    assert 0.01 < header["SIPMXERR"] < 1.0


def test_solutions_with_tables_in_files(solution, tmp_path):
    back = Solution.read(solution.write(tmp_path / "s.asdf"))
    for view in solution:
        assert back[view.name].distortion.same_as(view.distortion)
        assert back[view.name].distortion.inverse.error == view.distortion.inverse.error
    assert back.estimate.static_tables == solution.estimate.static_tables
    again = pickle.loads(pickle.dumps(solution))
    assert again.estimate.displacement_tables == solution.estimate.displacement_tables
    with asdf.open(tmp_path / "s.asdf", memmap=False, lazy_load=False) as file:
        tree = copy.deepcopy(file.tree)
    tree["legdistort"]["displacement_tables"]["other"] = tree["legdistort"]["displacement_tables"].pop("exp00")
    asdf.AsdfFile(tree, version="1.5.0").write_to(tmp_path / "s.asdf")
    with pytest.raises(InputError, match=r"s\.asdf.*a table of displacements of 'other', which is no exposure"):
        Solution.read(tmp_path / "s.asdf")


@pytest.mark.slow
def test_wcs_files_with_tables_are_of_stock_models(solution, tmp_path):
    view, p = solution["exp00"], places(beyond=-1.0)
    path = write_wcs(view, tmp_path / "w.asdf")
    assert b"FastTabular" not in path.read_bytes()
    sky = view.wcs(*p.T)
    with asdf.open(path, memmap=False, lazy_load=False) as file:
        stock, error = file["meta"]["wcs"], file["meta"]["inverse_error_px"]
    parts = {type(node) for node in nodes(stock.get_transform("detector", "undistorted"))}
    assert {models.Tabular2D, models.Legendre2D} < parts
    assert_allclose(stock(*p.T), sky, rtol=0, atol=1e-12)
    stock.bounding_box = None
    assert np.abs(np.column_stack(stock.invert(*sky)) - p).max() <= error < TABLE_TOLERANCE
    ours = read_wcs(path)
    assert_allclose(ours(*p.T), sky, rtol=0, atol=1e-12)
    assert_allclose(ours.invert(*sky), view.wcs.invert(*sky), rtol=0, atol=1e-9)
    assert np.isnan(ours(-30.0, 5.0)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param(lambda m: m.lookup_table.__imul__(1.05), "misses by", marks=pytest.mark.slow),
        (lambda m: setattr(m, "method", "nearest"), "should be linear"),
    ],
)
def test_changed_tables_are_noticed(solution, tmp_path, change, message):
    path = write_wcs(solution["exp00"], tmp_path / "w.asdf")
    with asdf.open(path, memmap=False, lazy_load=False) as file:
        meta = copy.deepcopy(file["meta"])
    transform = meta["wcs"].get_transform("detector", "undistorted")
    change(next(node for node in nodes(transform.inverse) if isinstance(node, models.Tabular2D)))
    meta["wcs"].set_transform("detector", "undistorted", transform)
    asdf.AsdfFile({"meta": meta}, version="1.5.0").write_to(path)
    with pytest.raises(InputError, match=r"w\.asdf.*" + message):
        read_wcs(path)


def test_a_detector_of_a_focal_plane(camera_solution_with_a_table):
    solution, field = camera_solution_with_a_table
    view, p = solution["exp00", "b"], places(300, seed=5)
    chip, common = view.chip, view.common
    series = Distortion(common.coefficients, common.shape)
    q = common.distortion.invert(chip.to_focal_plane(p))
    assert_allclose(series(q) + outside(q, field), chip.to_focal_plane(p), rtol=0, atol=1e-8)
    whole = view.distortion
    assert whole.table is not None
    assert_allclose(whole(np.asarray(whole.invert(p))), p, rtol=0, atol=1e-8)
    assert np.abs(view.correct(p) - _by_whole(view, p)).max() < 1e-3


def _by_whole(view, p):
    return similarity.apply(similarity.invert(view.pose), view.distortion.invert(p))


@pytest.fixture(scope="module")
def camera_solution_with_a_table():
    layouts = {"a": np.array([[1.0, 0, -10], [0, 1.0, -8]]), "b": np.array([[1.0, 0.002, -525], [-0.002, 1.0, -7]])}
    camera = Camera("pair", {key: Detector(SHAPE, layout=each) for key, each in layouts.items()}, (320, 1050))
    sim = simulate_matches(n_stars=150, n_exposures=3, degree=2, shape=(320, 1050), dither=20, seed=2)
    table = sim.matches.table.copy()
    f = np.column_stack([table["x"].value, table["y"].value])
    on = camera.sees(f)
    table, f, on = table[on.any(axis=0)], f[on.any(axis=0)], on[:, on.any(axis=0)]
    table["detector"] = np.where(on[0], "a", "b")
    table["x"], table["y"] = np.where(on[0][:, None], camera["a"].to_pixels(f), camera["b"].to_pixels(f)).T * u.pix
    made = solve(Matches.from_table(table, camera=camera, poses=sim.matches.poses), degree=2)
    field = DisplacementTable.of(waves, (320, 1050), 8.0)
    return replace(made, estimate=replace(made.estimate, displacement_tables={"exp00": field}, certified={})), field


def test_modes_of_no_table_are_as_they_were():
    a = np.random.default_rng(3).normal(size=(2, 10))
    plain = Distortion(a, SHAPE)
    q = places()
    expected = q + (a @ basis.values(3, *basis.normalize(q, SHAPE))).T
    assert_array_equal(plain(q), expected)
