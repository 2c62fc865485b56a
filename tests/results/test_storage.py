"""Solutions in and out of files: exact, complete or not at all, and refused in words."""

import copy
import hashlib
import importlib
import io
import json
import struct
import tomllib
import warnings
import zlib
from dataclasses import replace
from pathlib import Path

import asdf
import numpy as np
import pytest
import written_files
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.modeling import models
from astropy.table import MaskedColumn, QTable
from astropy.time import Time
from astropy.utils.masked import Masked
from caller_warnings import warns_here
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import legdistort
from legdistort.coaddition.grids import read_grid
from legdistort.exceptions import AssumptionWarning, InputError, LegdistortError
from legdistort.geometry.tabulated.displacement_table import DisplacementTable
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.results import in_tables
from legdistort.results.errors.coefficient_covariance import Coupled
from legdistort.results.errors.star_covariance import star_matrix
from legdistort.results.solution import Solution
from legdistort.runtime import provenance
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.storage import write_wcs


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
    return solve(matches, degree=2, prior=Prior(sim.truth.static, static_sigma=0.02, source="the truth"), clip=5)


@pytest.fixture(scope="module")
def solution():
    return small()


@pytest.fixture(scope="module")
def with_sky():
    sim = simulate_gsaoi_matches(small=True, seed=1)
    return solve(sim.matches, degree=3, prior=Prior(sim.truth.static, sigma=0.5, static_sigma=0.05))


def assert_same_table(a, b):
    """But for the last digit of columns made of what a file holds: it depends on where arrays lie in memory."""
    assert a.colnames == b.colnames
    for name in a.colnames:
        if name != "sky":  # made of ra and dec
            one, two = (np.asarray(each[name]) for each in (a, b))
            assert_allclose(one, two, rtol=1e-14) if one.dtype.kind == "f" else assert_array_equal(one, two)
        assert getattr(a[name], "unit", None) == getattr(b[name], "unit", None)


@pytest.mark.parametrize("which", ["solution", "with_sky"])
def test_round_trip_is_exact(which, tmp_path, request):
    given = request.getfixturevalue(which)
    path = given.write(tmp_path / "s.asdf")
    back = Solution.read(path)
    assert path == tmp_path / "s.asdf"
    assert (back.names, back.degree, back.estimate.shapes) == (given.names, given.degree, given.estimate.shapes)
    assert (back.chi2, back.dof, back.status) == (given.chi2, given.dof, given.status)
    assert (back.settings, back.left_out, back.provenance) == (given.settings, given.left_out, given.provenance)
    assert back.diagnostics == given.diagnostics
    for name in given.names:
        assert back.poses[name].tobytes() == given.poses[name].tobytes()
        assert_array_equal(back[name].errors, given[name].errors)
        assert_array_equal(back[name].sigma_map(n=5)[2], given[name].sigma_map(n=5)[2])
    assert_array_equal(back.coefficients, given.coefficients)
    for key in ("prior_mean", "positions", "star_names"):
        assert_array_equal(getattr(back.estimate, key), getattr(given.estimate, key))
        assert getattr(back.estimate, key).dtype == getattr(given.estimate, key).dtype
    for key in ("kind", "constraint", "motion", "dynamic", "box", "covariance", "static", "directions"):
        assert_array_equal(getattr(back.gauge, key), getattr(given.gauge, key))
    assert str(back.gauge) == str(given.gauge)
    assert_array_equal(back.estimate.uncertainty.coefficients, given.estimate.uncertainty.coefficients)
    assert_array_equal(back.estimate.uncertainty.stars, given.estimate.uncertainty.stars)
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
    assert_array_equal(back[name].correct(p), with_sky[name].correct(p))
    assert_array_equal(back[name].wcs(*p.T), with_sky[name].wcs(*p.T))
    assert in_tables.largest_inverse_error(back) == in_tables.largest_inverse_error(with_sky)


def test_covariances_as_blocks_survive(tmp_path, monkeypatch):
    """One block an exposure, as for more than 8000 coefficients."""
    for place in ("covariances.DENSE_LIMIT", "reduced_system.DIRECT_LIMIT"):
        monkeypatch.setattr(f"legdistort.solving.equations.{place}", 100)
    sim = simulate_matches(n_exposures=8, n_stars=25, seed=3)
    solution = solve(sim.matches, prior=Prior(sim.truth.static))
    assert solution.estimate.uncertainty.coefficients.shape == (8, 20, 20)
    for name in ("solution.asdf", "solution.fits"):
        solution.write(tmp_path / name)
        again = Solution.read(tmp_path / name)
        assert_array_equal(again.estimate.uncertainty.coefficients, solution.estimate.uncertainty.coefficients)
        assert_array_equal(again.stars["x_err"], solution.stars["x_err"])


def test_covariances_coupled_through_stars_survive(tmp_path, monkeypatch):
    """Between exposures too, so that those of stars with one another are as in memory."""
    monkeypatch.setattr("legdistort.solving.equations.covariances.COUPLED_FROM", 100)
    sim = simulate_matches(n_exposures=40, n_stars=25, seed=3)
    solution = solve(sim.matches, prior=Prior(sim.truth.static))
    assert isinstance(solution.estimate.uncertainty.coefficients, Coupled)
    back = Solution.read(solution.write(tmp_path / "s.asdf"))
    for field in ("own", "factor", "core"):
        kept, given = (getattr(each.estimate.uncertainty.coefficients, field) for each in (back, solution))
        assert_array_equal(kept, given)
    assert_allclose(star_matrix(back), solution.estimate.uncertainty.star_matrix, rtol=1e-6, atol=1e-9)


def test_masked_extra_columns(tmp_path):
    """Columns beyond the contract may have holes, and stay what they are: numbers, integers, text, with units."""
    given = small(
        colour=lambda n: MaskedColumn(np.linspace(15, 16, n), mask=np.arange(n) < 3),
        width=lambda n: Masked(np.full(n, 2.0) * u.um, mask=np.arange(n) < 3),
        visit=lambda n: MaskedColumn(np.arange(n), mask=np.arange(n) < 3),
        bare=lambda n: Masked(np.linspace(0, 1, n), mask=np.arange(n) < 3),
        name=lambda n: MaskedColumn(["abc é"] * n, mask=np.arange(n) < 3),
        things=lambda n: MaskedColumn(np.array(["a", "bc"] * n, dtype=object)[:n], mask=np.arange(n) < 3),
        whole=lambda n: MaskedColumn(np.arange(n)),
        pair=lambda n: np.arange(2.0 * n).reshape(n, 2),
        good=lambda n: np.arange(n) % 2 == 0,
        code=lambda n: np.array([b"x1"] * n),
        odd=lambda n: MaskedColumn(np.arange(n), unit=u.Unit("furlongs", parse_strict="silent")),
    )
    before = given.residuals
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", u.UnitsWarning)
        back = Solution.read(given.write(tmp_path / "s.asdf")).residuals
    assert back.colnames == before.colnames
    for column in ("colour", "width", "visit", "bare", "name", "things"):
        assert_array_equal(back[column].mask, np.arange(len(back)) < 3)
        assert [str(v) for v in back[column][3:]] == [str(v) for v in before[column][3:]]
    assert back["width"].unit == u.um
    assert back["visit"].dtype.kind == "i"
    for column in ("whole", "pair", "good", "code"):
        assert_array_equal(back[column], before[column])
        assert back[column].dtype == before[column].dtype
    assert str(back["odd"].unit) == "furlongs"


def test_columns_of_objects_are_left_out_loudly(tmp_path):
    given = small(
        place=lambda n: SkyCoord(np.arange(n), np.zeros(n), unit="deg"),
        when=lambda n: Time(np.arange(n) + 51544, format="mjd"),
        what=lambda n: np.array([{}] * n, dtype=object),
    )
    with warns_here(AssumptionWarning, match=r"columns place, when, what of the observations: .* left out of the fi"):
        path = given.write(tmp_path / "s.asdf")
    kept = [c for c in given.residuals.colnames if c not in ("place", "when", "what")]
    assert Solution.read(path).residuals.colnames == kept


def test_a_star_whose_observations_are_all_clipped_survives(with_sky, tmp_path):
    table = with_sky.residuals.copy()
    star = table["star"][0]
    table["used"][table["star"] == star] = False
    positions = with_sky.estimate.positions.copy()
    positions[np.searchsorted(with_sky.estimate.star_names, star)] = np.nan
    holed = replace(with_sky, residuals=table, estimate=replace(with_sky.estimate, positions=positions))
    row = np.flatnonzero(holed.stars["star"] == star)[0]
    assert holed.stars["n"][row] == 0
    for column in ("x", "x_err_abs", "ra", "dec", "flux"):
        assert np.isnan(holed.stars[column][row])
    assert_same_table(Solution.read(holed.write(tmp_path / "s.asdf")).stars, holed.stars)


@pytest.mark.parametrize("kind", [pytest.param("reference", marks=pytest.mark.slow), "static"])
@pytest.mark.filterwarnings("ignore::legdistort.exceptions.LegdistortWarning")  # this set tells little of the static
def test_every_kind_of_gauge_survives(with_sky, tmp_path, kind):
    sim = simulate_gsaoi_matches(small=True, seed=1)
    catalogue = with_sky.stars["ra", "dec", "ra_error", "dec_error"][::3]
    given = solve(sim.matches, **({"reference": catalogue} if kind == "reference" else {"static": "fit"}))
    assert kind == "static" or given.gauge.tie is not None
    back = Solution.read(given.write(tmp_path / "s.asdf"))
    assert str(back) == str(given)
    assert str(back.gauge) == str(given.gauge)
    assert_same_table(back.stars, given.stars)


def test_the_file_is_plain(solution, tmp_path):
    """Standard 1.5.0, no tag of ours: any asdf reads it as dicts and arrays."""
    path = solution.write(tmp_path / "s.asdf")
    assert path.read_bytes().startswith(b"#ASDF 1.0.0\n#ASDF_STANDARD 1.5.0\n")
    with asdf.open(path, lazy_load=False, memmap=False) as file:
        assert file.version == asdf.versioning.AsdfVersion("1.5.0")
        assert "legdistort" not in str(file.tree["history"])
        tree = file.tree["legdistort"]
        assert set(tree["provenance"]["versions"]) >= {"legdistort", "astropy", "gwcs"}
        assert_array_equal(tree["exposures"]["coefficients"], solution.coefficients)
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
        write_wcs(solution[solution.names[0]], path)
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
        target.write(b"#ASDF half of it")
        raise OSError("No space left on device")

    monkeypatch.setattr(asdf.AsdfFile, "write_to", half)
    with pytest.raises(OSError, match="No space left"):
        solution.write(path, overwrite=True)
    with pytest.raises(OSError, match="No space left"):
        write_wcs(solution[solution.names[0]], tmp_path / "w.asdf")
    assert [p.name for p in tmp_path.iterdir()] == (["s.asdf"] if existing else [])
    assert not existing or path.read_text() == "precious"


def test_a_missing_folder_is_made(solution, tmp_path):
    path = tmp_path / "new" / "below" / "s.asdf"
    assert solution.write(path) == path
    assert [each.name for each in path.parent.iterdir()] == ["s.asdf"]
    with pytest.raises(InputError, match=r"s\.asdf is a file; give a folder"):
        solution.write(path / "s.asdf")


def test_absent_and_foreign_files(solution, tmp_path):
    with pytest.raises(InputError, match=r"none\.asdf: no such file"):
        Solution.read(tmp_path / "none.asdf")
    (tmp_path / "text.asdf").write_text("hello")
    with pytest.raises(InputError, match=r"text\.asdf is not a readable ASDF file"):
        Solution.read(tmp_path / "text.asdf")
    (tmp_path / "empty.asdf").write_text("")
    with pytest.raises(InputError, match=r"empty\.asdf is not a readable ASDF file"):
        Solution.read(tmp_path / "empty.asdf")
    with pytest.raises(InputError, match=r"solution\.asdf: no such file"):  # of a folder, that of its results
        Solution.read(tmp_path)
    write_wcs(solution[solution.names[0]], tmp_path / "w.asdf")
    with pytest.raises(
        InputError, match=r"w\.asdf is not .*: tag '.*gwcs/wcs.*' has no business in such a file; is it"
    ):
        Solution.read(tmp_path / "w.asdf")
    asdf.AsdfFile({"other": 1}).write_to(tmp_path / "o.asdf")
    with pytest.raises(InputError, match=r"o\.asdf holds no legdistort solution .*; give a solution\.asdf"):
        Solution.read(tmp_path / "o.asdf")


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
        (lambda t: t.update(layout=99), "has layout 99, this version reads 2; update legdistort"),
        (lambda t: t.update(layout=np.zeros(3)), "is damaged: its layout is an array, not a number"),
        (lambda t: t.pop("gauge"), "is damaged: entry legdistort: 'gauge' is a required property$"),
        (
            lambda t: t["exposures"].update(name=[]),
            r"entry legdistort\.exposures\.name: \[\] .*; it should be a list of exposures, at least one",
        ),
        (
            lambda t: t.update(exposures=[1]),
            r"entry legdistort\.exposures: \[1\] is not of type 'object'; it should be what there is of the exposures",
        ),
        (
            lambda t: t.update(degree="three"),
            "entry legdistort.degree: 'three' is not of type 'integer'; it should be th",
        ),
        (
            lambda t: t["observations"]["x"].update(unit="nonsense"),
            "column 'x' cannot be read as numbers in pix: The unit 'nonsense'",
        ),
        (lambda t: t["observations"]["x"].update(unit="s"), "column 'x' cannot be read as numbers in pix"),
        (lambda t: t["observations"]["x"].update(values=np.zeros(3)), "is damaged"),
        (lambda t: t["observations"]["x"]["values"].__setitem__(3, np.nan), "x is not finite in 1 of"),
        (
            lambda t: t["observations"].update(x=3),
            r"entry legdistort\.observations\.x: 3 is not .*; it should be a column",
        ),
        (lambda t: t["columns"].remove("y_err"), "lacks the column y_err"),
        (lambda t: t["observations"]["star"]["values"].__setitem__(0, "?"), "names stars that are not in the list"),
        (
            lambda t: t["stars"].update(position=np.zeros((3, 2))),
            r"shape \(3, 2\); it should be .n_stars, 2. = .15, 2.",
        ),
        (
            lambda t: t["covariance"].update(coefficients=np.zeros((3, 3))),
            r"covariance\.coefficients: shape \(3, 3\); it should be .* = \(48, 48\) or .* = \(4, 12, 12\)",
        ),
        (lambda t: t["covariance"].update(stars=[1, 2]), r"entry legdistort\.covariance\.stars: shape .2,.; it should"),
        (lambda t: t["gauge"].update(box=np.zeros(4)), r"gauge.box: shape \(4,\); it should be \(2, 2\)$"),
        (lambda t: t["gauge"].update(kind="none"), "gauge.kind: 'none'; it should be one of minimal, mean, sh"),
        (lambda t: t["exposures"].update(coefficients=np.zeros((4, 2, 4))), "is damaged"),
        (
            lambda t: t["covariance"]["common"].update(stars=np.ones((15, 2, 6))),
            r"covariance\.common\.stars: covariances larger than the variances allow",
        ),
        (lambda t: t["stars"].update(position=np.full((15, 2), np.nan)), "a star without a position has observations"),
        (lambda t: t["observations"]["dx"]["values"].__setitem__(3, 1e300), "'dx' should hold finite numbers of pix"),
        (
            lambda t: t["exposures"]["shape"].__setitem__((0, 1), -5),
            r"shape\[0, 1\]: -5; it should be finite, numbers from 1 to 1e\+07",
        ),
        (
            lambda t: t["exposures"]["name"].__setitem__(0, "../../x"),
            "does not match .*should be the name of an exposure, which",
        ),
        (
            lambda t: t["exposures"]["name"].__setitem__(0, t["exposures"]["name"][1]),
            "two exposures have the same name",
        ),
        (
            lambda t: t["exposures"]["pose"].__setitem__(2, np.ones((2, 3))),
            r"exposures\.pose\[2\]: a map that has no inverse; it should be one that has",
        ),
        (lambda t: t.update(sky={"lon": 0, "lat": 99, "matrix": np.eye(2, 3)}), r"entry legdistort\.sky"),
        (lambda t: t.update(left_out=3), "entry legdistort.left_out: 3 is not of type 'object'; it should be reasons"),
    ],
)
def test_damaged_trees_are_refused(solution, tmp_path, change, message):
    path = solution.write(tmp_path / "s.asdf")
    with asdf.open(path, lazy_load=False, memmap=False) as file:
        tree = file.tree["legdistort"]
    change(tree)
    asdf.AsdfFile({"legdistort": tree}, version="1.5.0").write_to(path)
    with pytest.raises(InputError, match=r"s\.asdf.*" + message):
        Solution.read(path)


def test_reading_does_not_hold_the_file(solution, tmp_path):
    path = solution.write(tmp_path / "s.asdf")
    back = Solution.read(path)
    path.unlink()
    assert_allclose(back.estimate.positions, solution.estimate.positions)
    assert isinstance(back.residuals, QTable)


# --- where it comes from --------------------------------------------------------------------------


def test_settings_name_the_prior_and_provenance_the_packages(solution):
    told = solution.settings.prior
    assert told["source"] == "the truth"
    assert told["degree"] == 2
    assert told["sigma"] is None
    assert_array_equal(told["static_sigma"], np.full((2, 6), 0.02))
    assert set(solution.provenance["versions"]) == set(provenance.PACKAGES)
    sim = simulate_matches(n_stars=15, n_exposures=4, degree=1, seed=2)
    both = {name: Prior(np.zeros((2, 3)), sigma=1, source=name) for name in sim.matches.names}
    assert (
        solve(sim.matches, degree=1, prior=both).settings.prior[sim.matches.names[2]]["source"]
        == (sim.matches.names[2])
    )
    assert solve(sim.matches, degree=1).settings.prior is None


def test_checksums_are_those_of_sha256(tmp_path):
    (tmp_path / "a.fits").write_bytes(b"abc")
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, appendix B.1
    assert provenance.checksums(tmp_path / "a.fits") == {"a.fits": known}
    assert provenance.checksums(str(tmp_path / "a.fits")) == {"a.fits": known}


def add_to(array, place, value):
    """Of any kind of array: those of older asdf are no ndarray."""
    array[place] = array[place] + value


def saved_tree(solution, path):
    with asdf.open(solution.write(path, overwrite=True), lazy_load=False, memmap=False) as file:
        return file.tree["legdistort"]


def test_a_folded_solution_can_be_written(solution, tmp_path):
    coefficients = solution.coefficients.copy()
    coefficients[0, 0, 3] = 500
    table = solution.residuals.copy()
    table["used"][table["exposure"] == solution.names[0]] = False
    folded = replace(solution, coefficients=coefficients, residuals=table)
    back = Solution.read(folded.write(tmp_path / "s.asdf"))
    with pytest.raises(LegdistortError, match="folds"):
        _ = back[back.names[0]].wcs
    assert back[back.names[1]].wcs is not None


# --- the certificate -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: add_to(t["exposures"]["coefficients"], (1, 0, 4), 1e-5), "of exposure exp01 do not follow"),
        (lambda t: t["exposures"]["pose"].__setitem__((1, 0, 2), 3.0), "of exposure exp01 do not follow"),
        (lambda t: t["exposures"]["shape"].__setitem__((1, 1), 501), "of exposure exp01 do not follow"),
        (lambda t: t["stars"]["position"].__setitem__((0, 0), 7.0), "of exposure exp00 do not follow"),
        (lambda t: t["observations"]["x"]["values"].__setitem__(0, 7.0), "of exposure exp00 do not follow"),
    ],
)
def test_changed_coefficients_are_noticed(solution, tmp_path, change, message):
    tree = saved_tree(solution, tmp_path / "s.asdf")
    change(tree)
    asdf.AsdfFile({"legdistort": tree}, version="1.5.0").write_to(tmp_path / "s.asdf")
    with pytest.raises(InputError, match=r"s\.asdf.*" + message):
        Solution.read(tmp_path / "s.asdf")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e["tensors"].__setitem__((1, 0, 0), 0.3), "misses by .* px where .* coefficients or inver"),
        (lambda e: e.update(error_px=1e-7), "misses by .* where 1e-07 px was certified"),
        (
            lambda e: e.update(error_px=0.5),
            r"inverses\.exp01\.error_px: 0.5; it should be finite, a number from 0 to 0.001 .pix.$",
        ),
        (lambda e: e.update(valid_undistorted_px=[-1e6, 1e6, -1e6, 1e6]), "is stated to be valid in"),
    ],
)
def test_changed_inverses_are_noticed(solution, tmp_path, change, message):
    """Those of distortions with a table, which files keep."""
    table = DisplacementTable(np.zeros((2, 3, 3)), (0.0, 0.0), (256.0, 256.0))
    tree = saved_tree(_with_table(solution, table), tmp_path / "s.asdf")
    assert list(tree["inverses"]) == ["exp01"]
    change(tree["inverses"]["exp01"])
    asdf.AsdfFile({"legdistort": tree}, version="1.5.0").write_to(tmp_path / "s.asdf")
    with pytest.raises(InputError, match=r"s\.asdf.*" + message):
        Solution.read(tmp_path / "s.asdf")


def _with_table(solution, table):
    return replace(solution, estimate=replace(solution.estimate, displacement_tables={"exp01": table}, certified={}))


def test_the_inverse_that_was_certified_is_the_one_used(solution, tmp_path):
    back = Solution.read(solution.write(tmp_path / "s.asdf"))
    for name in solution.names:
        kept, made = back[name].distortion.inverse, solution[name].distortion.inverse
        assert_array_equal(kept.tensors, made.tensors)
        assert (kept.error, kept.valid) == (made.error, made.valid)


def test_other_coefficients_have_another_inverse(solution, tmp_path):
    back = Solution.read(solution.write(tmp_path / "s.asdf"))
    name = solution.names[0]
    half = replace(back, coefficients=0.5 * back.coefficients)
    p = np.array([[100.0, 200.0]])
    correction = half[name].distortion.model().inverse
    assert_allclose(np.column_stack(correction(*p.T)), half[name].distortion.invert(p), rtol=0, atol=1e-6)


# --- single WCS files ----------------------------------------------------------------------------------------------


def test_a_wcs_comes_back_as_it_was(with_sky, tmp_path):
    name = with_sky.names[2]
    back = legdistort.read_wcs(write_wcs(with_sky[name], tmp_path / "w.asdf"))
    made = with_sky[name].wcs
    p = np.random.default_rng(0).uniform(-100, 611, (500, 2))
    ra, dec = made(*p.T)
    assert np.isnan(ra).sum() > 50
    assert_array_equal(back(*p.T), (ra, dec))
    around = with_sky.sky.to_sky(np.random.default_rng(1).uniform(-200, 700, (500, 2)))
    there = np.array(made.invert(around.ra.deg, around.dec.deg, with_bounding_box=False))
    assert 10 < np.isfinite(there[0]).sum() < 490  # the region of validity, which the stock models do not hold
    assert_allclose(back.invert(around.ra.deg, around.dec.deg, with_bounding_box=False), there, rtol=0, atol=1e-9)
    for which in ("inverse", "distortion"):
        assert_array_equal(series(back, which).parameters, series(made, which).parameters)
    assert (back.name, back.pixel_shape, back.available_frames) == (made.name, made.pixel_shape, made.available_frames)
    assert back.bounding_box == made.bounding_box


def test_a_wcs_without_sky_and_with_another_shape(solution, tmp_path):
    name = solution.names[0]
    back = legdistort.read_wcs(write_wcs(solution[name], tmp_path / "w.asdf"))
    # not to the last digit: the sums of one point may be taken in another order
    assert_allclose(back(100.0, 200.0), solution[name].wcs(100.0, 200.0), rtol=1e-13)
    assert back.available_frames == ["detector", "undistorted", "reference"]


def series(wcs, which):
    correction = wcs.get_transform("detector", "undistorted")
    model = correction if which == "inverse" else correction.inverse
    return next(part for part in model.traverse_postorder() if isinstance(part, models.Legendre2D))


def with_plane(meta, **parameters):
    """The map to the reference plane with other parameters."""
    wcs = meta["wcs"]
    pose = wcs.get_transform("undistorted", "reference")
    changed = pose.copy()
    changed.inverse = pose.inverse
    for name, value in parameters.items():
        setattr(changed, name, value)
    wcs.set_transform("undistorted", "reference", changed)


def shifted(tree):
    wcs = tree["wcs"]
    correction = wcs.get_transform("detector", "undistorted")
    changed = correction | models.Identity(1) & models.Shift(1)
    changed.inverse = correction.inverse
    wcs.set_transform("detector", "undistorted", changed)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: setattr(series(m["wcs"], "distortion"), "c1_1", 0.01), "misses by"),
        (lambda m: setattr(series(m["wcs"], "inverse"), "c1_0", 0.01), "misses by"),
        (lambda m: setattr(series(m["wcs"], "distortion"), "c3_3", 0.01), "terms of total degree above"),
        (lambda m: m.update(inverse_error_px=2e-7), "misses by .* where 2e-07 px was certified"),
        (
            lambda m: m.update(inverse_error_px=2.0),
            "entry meta.inverse_error_px: 2.0; it should be finite, a number from 0 to 0.001",
        ),
        (lambda m: m.update(valid_undistorted_px=[0, 1, 2]), r"entry meta\.valid_undistorted_px: a list of 3; .* of 4"),
        (lambda m: m.update(valid_undistorted_px=[0.0, 1, 2, 3]), "is stated to be valid in"),
        (lambda m: m.update(wcs=3), "entry meta.wcs: .*; it should be a gwcs"),
        (lambda m: m.pop("exposure"), "'exposure' is a required property"),
        (
            lambda m: with_plane(m, translation=[np.nan, 0.0]),
            "meta.wcs, undistorted -> reference: AffineTransformation2D has parameters that are not finite",
        ),
        (
            lambda m: with_plane(m, matrix=np.ones((2, 2))),
            "meta.wcs, undistorted -> reference: a map that has no inverse; it should be one that has",
        ),
        (shifted, "should be x, y plus two Legendre series"),
        (lambda m: m["wcs"].set_transform("detector", "undistorted", models.Identity(2)), "two Legendre2D, got 0"),
    ],
)
def test_changed_wcs_files_are_noticed(with_sky, tmp_path, change, message):
    path = write_wcs(with_sky[with_sky.names[0]], tmp_path / "w.asdf")
    with asdf.open(path, lazy_load=False, memmap=False) as file:
        meta = dict(file.tree["meta"])
    change(meta)
    asdf.AsdfFile({"meta": meta}, version="1.5.0").write_to(path)
    with pytest.raises(InputError, match=r"w\.asdf.*" + message):
        legdistort.read_wcs(path)


def test_foreign_wcs_files_are_sent_elsewhere(solution, tmp_path, shared_data):
    with pytest.raises(InputError, match=r"miriwcs\.asdf .*open it with asdf\.open"):
        legdistort.read_wcs(shared_data / "gwcs_interop" / "miriwcs.asdf")
    with pytest.raises(InputError, match="holds no WCS written by legdistort"):
        legdistort.read_wcs(solution.write(tmp_path / "s.asdf"))


# --- files of strangers --------------------------------------------------------------------------------------------


def file_of(tree, *blocks):
    """An ASDF file from the text of its tree and (header fields, data) of its blocks."""
    head = b"#ASDF 1.0.0\n#ASDF_STANDARD 1.5.0\n%YAML 1.1\n%TAG ! tag:stsci.edu:asdf/\n--- !core/asdf-1.1.0\n"
    out = head + tree.encode() + b"\n...\n"
    for packing, unpacked, data in blocks:
        out += b"\xd3BLK" + struct.pack(">HI4sQQQ16s", 48, 0, packing, len(data), len(data), unpacked, bytes(16)) + data
    return out


ARRAY = "a: !core/ndarray-1.0.0 {source: 0, datatype: uint8, byteorder: little, shape: [SHAPE]}"
BOMB = zlib.compress(bytes(50_000_000), 9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            file_of(ARRAY.replace("SHAPE", "50000000"), (b"zlib", 50_000_000, BOMB)),
            "arrays take 50000000 bytes .*allow m",
        ),
        (file_of(ARRAY.replace("SHAPE", "9"), (b"zlib", 9, BOMB)), "not a readable"),  # says less than it holds
        (
            file_of(ARRAY.replace("SHAPE", "9"), (b"bzp2", 9, b"x" * 9)),
            r"block 0 is packed with b'bzp2'; write it anew",
        ),
        (
            file_of(ARRAY.replace("SHAPE", "5000, 5000"), (bytes(4), 9999, bytes(9999))),
            "array a has shape .5000, 5000.: ",
        ),
        (
            file_of(
                ARRAY.replace("SHAPE", "5000, 5000").replace("}", ", strides: [1, 1]}"), (bytes(4), 9999, bytes(9999))
            ),
            "array a has shape",
        ),
        (file_of(ARRAY.replace("SHAPE", "9"))[:-20] + b"\n...\n", "not a readable"),
        (file_of(ARRAY.replace("SHAPE", "9"), (bytes(4), 9, bytes(9)))[:-3], "block 0 reaches beyond the end"),
        (
            file_of(ARRAY.replace("source: 0", "source: 'file:///etc/passwd'").replace("SHAPE", "9")),
            "lies in another file",
        ),
        (file_of("a: {$ref: 'http://127.0.0.1/x.asdf'}"), "entry a refers to another file, which is not followed"),
        (file_of("a: !!python/object/apply:os.system ['touch hacked']"), "tag .*python.*os.system' has no bus"),
        (file_of("a: !<tag:yaml.org,2002:python/name:os.system> x"), "tag .*python.*os.system' has no business"),
        (file_of("a: !<tag:astropy.org:astropy/fits/fits-1.1.0> []"), "tag .*fits.* has no business in such a file"),
        (file_of("a: !<tag:example.org:a/b-1.0.0> x"), "tag 'tag:example.org:a/b-1.0.0' has no business"),
        (file_of("a: " + "[" * 200 + "]" * 200), "nested more than 100 levels deep"),
        # newer libyaml refuses it by itself
        (file_of("a: " + "[" * 5000 + "]" * 5000), "nested more than 100 levels deep|maximum nesting depth .line "),
        (file_of("a: &a [1, *a]"), "alias .a of nothing, or within itself"),
        (
            file_of("a0: &a0 [1, 1]\n" + "\n".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 40))),
            "more than .* nodes",
        ),
        (file_of("a: [" + "1," * 200_000 + "]"), "more than .* nodes|bytes of text"),
        (file_of("a: [" + "'" + "x" * 900_000 + "']"), "its tree is .* bytes of text"),
        (b"#ASDF 1.0.0\n%YAML 1.1\n--- {a: 1}\n", "its tree has no end"),
    ],
)
def test_traps_are_refused_in_words(tmp_path, monkeypatch, content, message):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "trap.asdf"
    path.write_bytes(content)
    for reader in (Solution.read, legdistort.read_wcs):
        with pytest.raises(InputError, match=r"trap\.asdf.*(" + message + ")"):
            reader(path, max_bytes=20_000_000)
    assert [p.name for p in tmp_path.iterdir()] == ["trap.asdf"]


def test_a_stream_of_unknown_length_is_refused(tmp_path):
    content = bytearray(file_of(ARRAY.replace("SHAPE", "9"), (bytes(4), 9, bytes(9))))
    content[content.index(b"\xd3BLK") + 9] = 1
    (tmp_path / "s.asdf").write_bytes(content)
    with pytest.raises(InputError, match="block 0 is a stream of unknown length"):
        Solution.read(tmp_path / "s.asdf")


def test_the_limit_can_be_raised(solution, tmp_path):
    path = solution.write(tmp_path / "s.asdf")
    with pytest.raises(InputError, match=r"s\.asdf is refused: .*; if you trust the file, allow more with max_bytes="):
        Solution.read(path, max_bytes=10_000)
    assert Solution.read(path, max_bytes=10_000_000).names == solution.names
    with pytest.raises(InputError, match="max_bytes must be a positive number of bytes, got -1"):
        Solution.read(path, max_bytes=-1)


def test_damaged_arrays_do_not_pass_for_numbers(solution, tmp_path):
    """Blocks carry a checksum, and it is looked at."""
    path = solution.write(tmp_path / "s.asdf")
    content = bytearray(path.read_bytes())
    place = content.index(b"\xd3BLK") + 6 + 32  # of the checksum of the first block
    content[place] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"not a readable ASDF file: block 0 is damaged: its checksum"):
        Solution.read(path)


def test_checksums_of_either_kind_are_known(solution, tmp_path):
    """The standard wants that of the data as they stand in the file; asdf of early 2025 took that of what they hold."""
    path = solution.write(tmp_path / "s.asdf")
    content, place, packed = path.read_bytes(), 0, 0
    while (place := content.find(b"\xd3BLK", place + 1)) > 0:
        _, packing, _, used, _, checksum = struct.unpack(">I4sQQQ16s", content[place + 6 : place + 54])
        if packing == b"zlib":
            data = content[place + 54 : place + 54 + used]
            sums = [hashlib.md5(each).digest() for each in (data, zlib.decompress(data))]
            assert checksum in sums
            content = content.replace(checksum, sums[1 - sums.index(checksum)])
            packed += 1
    assert packed > 5
    path.write_bytes(content)
    assert_same_table(Solution.read(path).stars, solution.stars)


def leaves(tree, path=()):
    """Paths to every entry of a tree."""
    yield path
    if isinstance(tree, (dict, list)):
        for key in tree if isinstance(tree, dict) else range(len(tree)):
            yield from leaves(tree[key], (*path, key))


NONSENSE = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**40), 2**40), st.floats(), st.text(max_size=5),
    st.lists(st.floats(), max_size=3), st.dictionaries(st.text(max_size=3), st.integers(0, 9), max_size=2),
    st.tuples(st.integers(0, 3), st.integers(0, 7)).map(np.zeros),
    st.integers(0, 5).map(lambda n: np.full((2, n), np.nan)),
)  # fmt: skip
FUZZ = settings(
    max_examples=10, deadline=None, derandomize=True, database=None, phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)  # fmt: skip


@pytest.fixture(scope="module")
def whole_tree(solution, tmp_path_factory):
    """The tree of a solution with arrays of numpy."""
    tree = saved_tree(solution, tmp_path_factory.mktemp("tree") / "s.asdf")
    return asdf.treeutil.walk_and_modify(
        tree, lambda node: np.array(node) if isinstance(node, asdf.tags.core.NDArrayType) else node
    )


def reads_or_refuses(content, path):
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", u.UnitsWarning)
        for reader in (Solution.read, legdistort.read_wcs):
            try:
                str(reader(path))
            except LegdistortError as error:
                assert "fuzz.asdf" in str(error)  # noqa: PT017


@FUZZ
@given(data=st.data())
def test_no_tree_breaks_the_reader(whole_tree, tmp_path, data):
    tree = copy.deepcopy(whole_tree)
    for _ in range(data.draw(st.integers(1, 3))):
        *path, last = data.draw(st.sampled_from([p for p in leaves(tree) if p]))
        place = tree
        for key in path:
            place = place[key]
        if data.draw(st.booleans()):
            place[last] = data.draw(NONSENSE)
        else:
            del place[last]
    content = io.BytesIO()
    asdf.AsdfFile({"legdistort": tree}, version="1.5.0").write_to(content)
    reads_or_refuses(content.getvalue(), tmp_path / "fuzz.asdf")


@pytest.mark.parametrize("which", ["solution", "wcs"])
@FUZZ
@given(data=st.data())
def test_no_damage_breaks_the_reader(solution, with_sky, tmp_path, which, data):
    path = tmp_path / f"{which}.asdf"
    if not path.exists():
        solution.write(path) if which == "solution" else write_wcs(with_sky[with_sky.names[0]], path)
    content = bytearray(path.read_bytes())
    text = content.index(b"\n...\n")
    for _ in range(data.draw(st.integers(1, 8))):
        where = data.draw(st.one_of(st.integers(0, text), st.integers(0, len(content) - 1)))
        action = data.draw(st.sampled_from(["change", "cut", "repeat", "drop"]))
        if action == "change":
            content[where] = data.draw(st.integers(0, 255))
        elif action == "cut":
            content = content[: max(where, 40)]
        elif action == "repeat":
            content[where:where] = content[where : where + 50]
        else:
            del content[where : where + data.draw(st.integers(1, 20))]
        if not content:
            break
        text = min(text, len(content) - 1)
    reads_or_refuses(bytes(content), tmp_path / "fuzz.asdf")


# --- versions ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("folder", sorted(written_files.FOLDER.iterdir()), ids=lambda folder: folder.name)
def test_files_of_every_version_open(folder):
    """If this fails after a change of a layout: give what files of that version lack a default when they are read."""
    expected = json.loads((folder / "expected.json").read_text())
    found = written_files.seen(
        Solution.read(folder / "solution.asdf"),
        Prior.read(folder / "prior.asdf"),
        legdistort.read_wcs(folder / "wcs.asdf"),
    )
    found |= written_files.seen_camera(legdistort.Camera.read(folder / "camera.asdf"))
    found |= written_files.seen_matches(folder / "matched.ecsv")
    found |= written_files.seen_mosaic(folder / "mosaic.fits")
    assert_alike(json.loads(json.dumps(found)), expected)


def assert_alike(found, expected, where=""):
    """Lists and dicts of numbers and text are equal but for rounding."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), where
        for key, value in expected.items():
            assert_alike(found[key], value, f"{where}.{key}")
    elif isinstance(expected, list) and any(isinstance(each, (str, list, dict)) for each in expected):
        assert len(found) == len(expected), where
        for k, value in enumerate(expected):
            assert_alike(found[k], value, f"{where}[{k}]")
    elif isinstance(expected, str):
        assert found == expected, where
    else:
        assert_allclose(found, expected, rtol=1e-12, atol=1e-7, err_msg=where)


@pytest.mark.parametrize("folder", sorted(written_files.FOLDER.iterdir()), ids=lambda folder: folder.name)
def test_mosaics_of_every_version_are_grids_and_images(folder):
    assert read_grid(folder / "mosaic.fits").array_shape == (30, 40)
    (image,) = legdistort.read_exposures(folder / "mosaic.fits")
    with fits.open(folder / "mosaic.fits") as hdulist:
        stated = hdulist["UNCERT"]
        power = {"StdDevUncertainty": 1, "VarianceUncertainty": 2}[stated.header["UTYPE"]]
        assert_allclose(image.uncertainty**power, stated.data, rtol=1e-6)


def test_this_version_has_its_files():
    assert (written_files.FOLDER / legdistort.__version__).is_dir()


PYPROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))


def test_schemas_are_valid_and_registered():
    """By the checker of asdf, which also holds the names of properties to their types."""
    module, _, name = PYPROJECT["project"]["entry-points"]["asdf.resource_mappings"]["legdistort"].partition(":")
    (mapping,) = getattr(importlib.import_module(module), name)()
    assert sorted(mapping) == [
        f"asdf://legdistort/schemas/{kind}-1.0.0" for kind in ("camera", "prior", "solution", "wcs")
    ]
    with asdf.config_context() as config:
        config.add_resource_mapping(mapping)
        for uri in mapping:
            schema = asdf.schema.load_schema(uri, resolve_references=True)
            asdf.schema.check_schema(schema)
            assert schema["id"] == uri
            assert schema["title"]
