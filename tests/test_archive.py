"""Solutions in and out of files: exact, complete or not at all, and refused in words."""

from dataclasses import replace

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import MaskedColumn, QTable
from astropy.utils.masked import Masked
from numpy.testing import assert_allclose, assert_array_equal

from legdistort import archive
from legdistort.estimation import solve
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.matches import Matches
from legdistort.priors import Prior
from legdistort.simulation import simulate_gsaoi_matches, simulate_matches
from legdistort.solution import Solution


def small(**changes):
    """Names for stars, extra columns, a clipped observation, a left-out exposure, correlated errors."""
    sim = simulate_matches(n_stars=15, n_exposures=4, degree=2, shape=(300, 500), dither=20, corr=0.4, seed=1)
    table = sim.matches.table.copy()
    table["star"] = np.array([f"Stern-{k:02d} é" for k in table["star"]])
    table["x"][5] += 30 * u.pix
    table["flux"] = np.linspace(10, 20, len(table))
    table["note"] = ["n"] * len(table)
    table["wave"] = np.arange(len(table)) * u.um
    for name, column in changes.items():
        table[name] = column(len(table))
    matches = Matches.from_table(
        table, shape=(300, 500), poses=sim.matches.poses, sky=None, left_out={"bad": "no stars: [found] 0"}
    )
    return solve(matches, degree=2, prior=Prior(sim.truth.static, static_sigma=0.02), clip=5)


@pytest.fixture(scope="module")
def solution():
    return small()


@pytest.fixture(scope="module")
def with_sky():
    sim = simulate_gsaoi_matches(small=True, seed=1)
    return solve(sim.matches, degree=3, prior=Prior(sim.truth.static, sigma=0.5, static_sigma=0.05))


def assert_same_table(a, b):
    assert a.colnames == b.colnames
    for name in a.colnames:
        assert_array_equal(a[name], b[name])
        assert getattr(a[name], "unit", None) == getattr(b[name], "unit", None)


@pytest.mark.parametrize("which", ["solution", "with_sky"])
def test_round_trip_is_exact(which, tmp_path, request):
    given = request.getfixturevalue(which)
    path = given.write(tmp_path / "s.asdf")
    back = Solution.read(path)
    assert path == tmp_path / "s.asdf"
    assert (back.names, back.degree, back.shapes) == (given.names, given.degree, given.shapes)
    assert (back.chi2, back.dof, back.status) == (given.chi2, given.dof, given.status)
    assert (back.settings, back.left_out) == (given.settings, given.left_out)
    for name in given.names:
        assert back.poses[name].tobytes() == given.poses[name].tobytes()
        assert_array_equal(back.coefficient_errors(name), given.coefficient_errors(name))
        assert_array_equal(back.sigma_map(name, n=5)[2], given.sigma_map(name, n=5)[2])
    for key in ("coefficients", "prior_mean", "positions", "static_sigma", "star_names"):
        assert_array_equal(getattr(back, key), getattr(given, key))
        assert getattr(back, key).dtype == getattr(given, key).dtype
    for key in ("kind", "constraint", "motion", "dynamic", "box"):
        assert_array_equal(getattr(back.gauge, key), getattr(given.gauge, key))
    assert str(back.gauge) == str(given.gauge)
    assert_array_equal(back.uncertainty.coefficients, given.uncertainty.coefficients)
    assert_array_equal(back.uncertainty.stars, given.uncertainty.stars)
    assert_same_table(back.stars, given.stars)
    assert_array_equal(back.stars["x_err_abs"], given.stars["x_err_abs"])
    assert_same_table(back.residuals, given.residuals)
    assert repr(back) == repr(given)
    assert str(back) == str(given)
    if given.sky is None:
        assert back.sky is None
    else:
        assert (back.sky.lon, back.sky.lat) == (given.sky.lon, given.sky.lat)
        assert_array_equal(back.sky.matrix, given.sky.matrix)
        assert_array_equal(back.stars["ra"], given.stars["ra"])
    # and once more: nothing is lost when what was read is written
    assert_same_table(Solution.read(back.write(tmp_path / "again.asdf")).stars, given.stars)


def test_geometry_survives(with_sky, tmp_path):
    back = Solution.read(with_sky.write(tmp_path / "s.asdf"))
    p = np.random.default_rng(0).uniform(0, 511, (50, 2))
    name = with_sky.names[3]
    assert_array_equal(back.correct(name, p), with_sky.correct(name, p))
    assert_array_equal(back.wcs(name)(*p.T), with_sky.wcs(name)(*p.T))
    assert back.max_inverse_error == with_sky.max_inverse_error


def test_masked_extra_columns(tmp_path):
    """Columns beyond the contract may have holes: NaN or empty after reading, never a made-up value."""
    given = small(
        mag=lambda n: MaskedColumn(np.full(n, 15.0), mask=np.arange(n) < 3),
        width=lambda n: Masked(np.full(n, 2.0) * u.um, mask=np.arange(n) < 3),
        visit=lambda n: MaskedColumn(np.full(n, 7), mask=np.arange(n) < 3),
        name=lambda n: MaskedColumn(["abc"] * n, mask=np.arange(n) < 3),
    )
    back = Solution.read(given.write(tmp_path / "s.asdf")).residuals
    for column in ("mag", "width", "visit"):
        assert np.isnan(back[column][:3]).all()
        assert_array_equal(back[column][3:], given.residuals[column][3:].filled(0))
    assert back["name"].tolist() == [""] * 3 + ["abc"] * (len(back) - 3)


def test_columns_of_objects_are_left_out_loudly(tmp_path):
    given = small(place=lambda n: SkyCoord(np.arange(n), np.zeros(n), unit="deg"))
    with pytest.warns(AssumptionWarning, match=r"column place of the observations: .* left out of the file"):
        path = given.write(tmp_path / "s.asdf")
    assert Solution.read(path).residuals.colnames == [c for c in given.residuals.colnames if c != "place"]


def test_a_star_whose_observations_are_all_clipped_survives(with_sky, tmp_path):
    table = with_sky.observations.copy()
    star = table["star"][0]
    table["used"][table["star"] == star] = False
    positions = with_sky.positions.copy()
    positions[np.searchsorted(with_sky.star_names, star)] = np.nan
    holed = replace(with_sky, observations=table, positions=positions)
    row = np.flatnonzero(holed.stars["star"] == star)[0]
    assert holed.stars["n"][row] == 0
    for column in ("x", "x_err_abs", "ra", "dec", "flux"):
        assert np.isnan(holed.stars[column][row])
    assert_same_table(Solution.read(holed.write(tmp_path / "s.asdf")).stars, holed.stars)


def test_the_file_is_plain(solution, tmp_path):
    """Standard 1.5.0, no tag of ours: any asdf reads it as dicts and arrays."""
    path = solution.write(tmp_path / "s.asdf")
    assert path.read_bytes().startswith(b"#ASDF 1.0.0\n#ASDF_STANDARD 1.5.0\n")
    with asdf.open(path, lazy_load=False, memmap=False) as file:
        assert file.version == asdf.versioning.AsdfVersion("1.5.0")
        assert "legdistort" not in str(file.tree["history"])
        tree = file.tree["legdistort"]
        assert set(tree["provenance"]["versions"]) >= {"legdistort", "astropy", "gwcs"}
        assert_array_equal(tree["exposures"][1]["coefficients"], solution.coefficients[1])
    header = path.read_bytes().split(b"\n...")[0].decode()
    tags = {word for word in header.split() if word.startswith("!")}
    assert all(tag.startswith("!core/") for tag in tags - {"!"}), tags


# --- refusals and failures ---------------------------------------------------------------------------------------


def test_nothing_is_overwritten_unasked(solution, tmp_path):
    path = tmp_path / "s.asdf"
    path.write_text("precious")
    with pytest.raises(InputError, match=r"s\.asdf exists already; give overwrite=True \(--overwrite\)"):
        solution.write(path)
    with pytest.raises(InputError, match="exists already"):
        archive.write_wcs(solution, solution.names[0], path)
    assert path.read_text() == "precious"
    solution.write(path, overwrite=True)
    assert len(Solution.read(path).names) == 4
    assert [p.name for p in tmp_path.iterdir()] == ["s.asdf"]


@pytest.mark.parametrize("existing", [True, False])
def test_a_failed_write_leaves_nothing(solution, tmp_path, monkeypatch, existing):
    path = tmp_path / "s.asdf"
    if existing:
        path.write_text("precious")

    def half(self, target, **_):
        target.write_bytes(b"#ASDF half of it")
        raise OSError("No space left on device")

    monkeypatch.setattr(asdf.AsdfFile, "write_to", half)
    with pytest.raises(OSError, match="No space left"):
        solution.write(path, overwrite=True)
    with pytest.raises(OSError, match="No space left"):
        archive.write_wcs(solution, solution.names[0], tmp_path / "w.asdf")
    assert [p.name for p in tmp_path.iterdir()] == (["s.asdf"] if existing else [])
    assert not existing or path.read_text() == "precious"


def test_missing_folder_is_named(solution, tmp_path):
    with pytest.raises(InputError, match=r"the folder .*nowhere does not exist; make it first"):
        solution.write(tmp_path / "nowhere" / "s.asdf")


def test_absent_and_foreign_files(solution, tmp_path):
    with pytest.raises(InputError, match=r"none\.asdf: no such file"):
        Solution.read(tmp_path / "none.asdf")
    (tmp_path / "text.asdf").write_text("hello")
    with pytest.raises(InputError, match=r"text\.asdf is not a readable ASDF file"):
        Solution.read(tmp_path / "text.asdf")
    (tmp_path / "empty.asdf").write_text("")
    with pytest.raises(InputError, match=r"empty\.asdf is not a readable ASDF file"):
        Solution.read(tmp_path / "empty.asdf")
    with pytest.raises(InputError, match="is not a readable ASDF file"):
        Solution.read(tmp_path)
    archive.write_wcs(solution, solution.names[0], tmp_path / "w.asdf")
    with pytest.raises(InputError, match=r"w\.asdf holds no legdistort solution .*; give a solution\.asdf"):
        Solution.read(tmp_path / "w.asdf")


@pytest.mark.filterwarnings("ignore")  # a broken file may also warn
@pytest.mark.parametrize("share", [0.02, 0.2, 0.5, 0.9, 0.97])
def test_cut_files_are_refused(solution, tmp_path, share):
    path = solution.write(tmp_path / "s.asdf")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"s\.asdf is (damaged|not a readable ASDF file)|holds no legdistort"):
        Solution.read(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.update(layout=99), "has layout 99, this version reads 1; update legdistort"),
        (lambda t: t.pop("gauge"), "is damaged: KeyError 'gauge'"),
        (lambda t: t.update(exposures=[]), "is damaged"),
        (lambda t: t.update(exposures=[1]), "is damaged"),
        (lambda t: t.update(degree="three"), "is damaged"),
        (lambda t: t["observations"]["x"].update(unit="nonsense"), "is damaged"),
        (lambda t: t["observations"]["x"].update(values=np.zeros(3)), "is damaged"),
        (lambda t: t["stars"].update(position=np.zeros((3, 2))), "is damaged"),
        (lambda t: t["covariance"].update(coefficients=np.zeros((3, 3))), "is damaged"),
        (lambda t: t["exposures"][0].update(coefficients=np.zeros((2, 4))), "is damaged"),
        (lambda t: t.update(left_out=3), "is damaged"),
    ],
)
def test_damaged_trees_are_refused(solution, tmp_path, change, message):
    path = solution.write(tmp_path / "s.asdf")
    with asdf.open(path, lazy_load=False, memmap=False) as file:
        tree = file.tree["legdistort"]
    change(tree)
    asdf.AsdfFile({"legdistort": tree}, version="1.5.0").write_to(path)
    with pytest.raises(InputError, match=r"s\.asdf " + message):
        Solution.read(path)


def test_reading_does_not_hold_the_file(solution, tmp_path):
    path = solution.write(tmp_path / "s.asdf")
    back = Solution.read(path)
    path.unlink()
    assert_allclose(back.positions, solution.positions)
    assert isinstance(back.residuals, QTable)
