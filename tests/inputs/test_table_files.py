"""Tables in and out of files: what other software writes is understood, what is written others understand."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.io.votable import parse_single_table
from astropy.io.votable.ucd import check_ucd
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from ldac_files import write_ldac
from numpy.testing import assert_allclose, assert_array_equal

import legdistort
from legdistort.cli import parser
from legdistort.exceptions import AssumptionWarning, InputError, LegdistortError
from legdistort.inputs import column_contract
from legdistort.inputs.exposures import Exposure
from legdistort.inputs.star_lists import sextractor
from legdistort.inputs.star_lists.formats import stack
from legdistort.inputs.table_files import named_after, read_table, write_stars
from legdistort.matching.matches import Matches
from legdistort.measurement.positions import Flag
from legdistort.priors.prior import Prior
from legdistort.results.solution import Solution
from legdistort.runtime import provenance
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving.estimation import solve

# Lines that SExtractor 2.25.0 wrote: CATALOG_TYPE ASCII_HEAD, errors both as variances and as an ellipse.
SEXTRACTOR = """\
#   1 NUMBER                 Running object number                                     
#   2 XWIN_IMAGE             Windowed position estimate along x                         [pixel]
#   3 YWIN_IMAGE             Windowed position estimate along y                         [pixel]
#   4 ERRX2WIN_IMAGE         Variance of windowed pos along x                           [pixel**2]
#   5 ERRY2WIN_IMAGE         Variance of windowed pos along y                           [pixel**2]
#   6 ERRXYWIN_IMAGE         Covariance of windowed pos between x and y                 [pixel**2]
#   7 ERRAWIN_IMAGE          RMS windowed pos error along major axis                    [pixel]
#   8 ERRBWIN_IMAGE          RMS windowed pos error along minor axis                    [pixel]
#   9 ERRTHETAWIN_IMAGE      Windowed error ellipse pos angle (CCW/x)                   [deg]
#  10 FLUX_AUTO              Flux within a Kron-like elliptical aperture                [count]
#  11 FLUX_APER              Flux vector within fixed circular aperture(s)              [count]
#  13 FWHM_IMAGE             FWHM assuming a gaussian core                              [pixel]
#  14 FLAGS                  Extraction flags                                          
 1 247.3459  37.4745 1.6337801021e-05 1.7425466808e-05 1.4460045348e-07 0.00418 0.00404 82.56 306897.6 136702.5 242042. 4.64 0
 2 430.1783  28.9282 3.1468126874e-04 3.2659534829e-04 1.9729993574e-06 0.01808 0.01773 80.84 27379.29 12601.86 21993.5 4.64 4
 3 297.8534  15.6776 1.0401713094e-03 1.0548004115e-03 2.0053183078e-06 0.03248 0.03225 82.33 12784.01 5831.919 10367.8 4.58 3
"""  # noqa: E501, W291


def sextractor_table(tmp_path):
    (tmp_path / "list.cat").write_text(SEXTRACTOR)
    return Table.read(tmp_path / "list.cat", format="ascii.sextractor")


def assert_detections(table, exposure):
    out = column_contract.check(table, column_contract.DETECTED, "the table")
    assert_allclose(out["x"].value, [246.3459, 429.1783, 296.8534], rtol=0, atol=1e-9)  # counted from 0
    assert_allclose(out["y"].value, [36.4745, 27.9282, 14.6776], rtol=0, atol=1e-9)
    assert_allclose(out["x_err"].value, np.sqrt([1.6337801021e-05, 3.1468126874e-04, 1.0401713094e-03]))
    assert_allclose(out["y_err"].value, np.sqrt([1.7425466808e-05, 3.2659534829e-04, 1.0548004115e-03]))
    assert_allclose(out["xy_corr"], [0.0085701, 0.0061544, 0.0019145], rtol=1e-4)
    assert_allclose(out["flux"], [306897.6, 27379.29, 12784.01])
    assert out["flags"].tolist() == [0, Flag.SATURATED, Flag.BLENDED]
    assert set(out["exposure"]) == {exposure}


# --- SExtractor --------------------------------------------------------------------------------------------------


def test_sextractor_text(tmp_path):
    sextractor_table(tmp_path)
    table = read_table(tmp_path / "list.cat")
    assert_detections(table, "list")
    assert table.meta["inputs"] == provenance.checksums(tmp_path / "list.cat")


def test_sextractor_ldac_tells_the_shape(tmp_path):
    path = write_ldac(tmp_path / "night.fits.ldac", sextractor_table(tmp_path))
    table = read_table(path)
    assert_detections(table, "night")
    assert table.meta["shapes"] == {"night": [600, 700]}


def test_ldac_of_several_extensions_is_several_exposures(tmp_path):
    table = sextractor_table(tmp_path)
    out = read_table(write_ldac(tmp_path / "m.ldac", table, table[:2]))
    assert_detections(out[:3], "m_1")
    assert set(out["exposure"][3:]) == {"m_2"}
    assert out.meta["shapes"] == {"m_1": [600, 700], "m_2": [600, 700]}


#: What SExtractor 2.25.0 copies of the headers of a mosaic whose extensions are CCD1 and CCD2.
MOSAIC = [{"EXTNAME": f"CCD{k}", "CCDNAME": f"ccd-{k}", "CCDNUM": k} for k in (1, 2)]


def test_ldac_of_a_mosaic_is_one_exposure_of_several_detectors(tmp_path, caplog):
    """As the extensions of its frame: their names differ by a number, and a keyword tells them to be detectors."""
    table = sextractor_table(tmp_path)
    with caplog.at_level("INFO", logger="legdistort"):
        out = read_table(write_ldac(tmp_path / "m.ldac", table, table[:2], images=MOSAIC))
    assert set(out["exposure"]) == {"m"}
    assert out["detector"].tolist() == ["CCD1"] * 3 + ["CCD2"] * 2
    assert out.meta["shapes"] == {"m-CCD1": [600, 700], "m-CCD2": [600, 700]}
    assert "2 tables CCD1 to CCD2 of a list are taken for the detectors of one camera, by CCDNAME" in caplog.text
    chips = [{"EXTNAME": "SCI", "EXTVER": k, "CCDCHIP": 3 - k} for k in (1, 2)]
    out = read_table(write_ldac(tmp_path / "h.ldac", table, table[:2], images=chips))
    assert out["detector"].tolist() == ["2"] * 3 + ["1"] * 2
    out.write(tmp_path / "h.ecsv")  # what stays of the headers can be written
    images = [{"EXTNAME": name, "CCDNAME": name} for name in ("SCI", "ERR")]
    out = read_table(write_ldac(tmp_path / "e.ldac", table, table[:2], images=images))
    assert set(out["exposure"]) == {"e_1", "e_2"}
    assert "detector" not in out.colnames


def mosaic_frames(ids, name="m"):
    return [Exposure(f"{name}-{key}", np.ones((600, 700)), exposure=name, detector=key) for key in ids]


def test_tables_of_a_mosaic_have_the_detectors_of_its_frames(tmp_path, caplog):
    table = sextractor_table(tmp_path)
    path = write_ldac(tmp_path / "m.ldac", table, table[:2], images=MOSAIC)
    for ids in (["ccd-2", "ccd-1"], ["CCD2", "CCD1"]):  # by whichever keyword, in whichever order
        out = named_after(read_table(path), mosaic_frames(ids), path)
        assert out["detector"].tolist() == [ids[1]] * 3 + [ids[0]] * 2
        assert set(out["exposure"]) == {"m"}
    with caplog.at_level("INFO", logger="legdistort"):
        out = named_after(read_table(path), mosaic_frames(["north", "south"]), path)
    assert out["detector"].tolist() == ["north"] * 3 + ["south"] * 2
    assert "tables of a list are taken for the detectors north, south in this order" in caplog.text
    bare = write_ldac(tmp_path / "bare.ldac", table, table[:2])  # of headers that name nothing
    out = named_after(read_table(bare), mosaic_frames(["a", "b"], "bare"), bare)
    assert out["detector"].tolist() == ["a"] * 3 + ["b"] * 2
    assert out.meta["shapes"] == {"bare-a": [600, 700], "bare-b": [600, 700]}
    with pytest.raises(InputError, match=r"m\.ldac: which detectors of m \(a, b, c\) its 2 tables are"):
        named_after(read_table(path), mosaic_frames("abc"), path)


def test_lists_of_a_mosaic_are_matched_without_frames(tmp_path, capsys):
    """Two detectors side by side in dithered exposures: 5 exposures, of the dates of the headers, not 10."""
    rng, paths = np.random.default_rng(3), []
    stars = rng.uniform((-200, -150), (1600, 750), (400, 2))
    for n, shift in enumerate(rng.uniform(-140, 140, (5, 2))):
        tables = []
        for k in (0, 1):
            xy = stars + shift - [[k * 720, 0]] + rng.normal(0, 0.02, stars.shape)
            xy = xy[np.all((xy > 0) & (xy < (699, 599)), axis=1)] + 1
            tables.append(Table({"XWIN_IMAGE": xy[:, 0], "YWIN_IMAGE": xy[:, 1]}))
            tables[-1]["ERRX2WIN_IMAGE"], tables[-1]["ERRY2WIN_IMAGE"], tables[-1]["ERRXYWIN_IMAGE"] = 4e-4, 4e-4, 0.0
        images = [image | {"DATE-OBS": f"2026-11-2{n}T03:00:00"} for image in MOSAIC]
        paths.append(str(write_ldac(tmp_path / f"d{n}.ldac", *tables, images=images)))
    assert parser.main(["match", *paths, "--out", str(tmp_path / "m.ecsv")]) == 0
    said = capsys.readouterr()
    assert "stars in 5 exposures" in said.out
    assert "dates of the lists are those of the headers of their images (LDAC_IMHEAD)" in said.err
    assert "10 exposures" not in said.err
    found = Table.read(tmp_path / "m.ecsv")
    assert set(found["detector"]) == {"CCD1", "CCD2"}
    assert_allclose(np.ptp(found["epoch"]), 4 / 365.25, rtol=1e-4)


def test_sextractor_in_a_plain_fits_table(tmp_path):
    sextractor_table(tmp_path).write(tmp_path / "list.fits")
    assert_detections(read_table(tmp_path / "list.fits"), "list")
    with fits.open(tmp_path / "list.fits") as hdus:
        hdus.writeto(tmp_path / "list.fits.gz")
    assert_detections(read_table(tmp_path / "list.fits.gz"), "list")


def test_an_ellipse_is_as_good_as_variances(tmp_path):
    """The same errors in both forms, printed by SExtractor itself with three digits."""
    table = sextractor_table(tmp_path)
    by_variance = sextractor.understand(table, {})[0]
    table.remove_columns(["ERRX2WIN_IMAGE", "ERRY2WIN_IMAGE", "ERRXYWIN_IMAGE"])
    by_ellipse = sextractor.understand(table, {})[0]
    for name in ("x_err", "y_err"):
        assert_allclose(by_ellipse[name], by_variance[name], rtol=2e-3)
    assert_allclose(by_ellipse["xy_corr"], by_variance["xy_corr"], rtol=0, atol=1e-3)


def test_an_ellipse_turned_by_45_degrees():
    table = Table({"XWIN_IMAGE": [5.0], "YWIN_IMAGE": [5.0], "ERRAWIN_IMAGE": [0.5], "ERRBWIN_IMAGE": [0.1]})
    table["ERRTHETAWIN_IMAGE"] = [30.0]
    made = sextractor.understand(table, {})[0]
    turn = np.array([[np.cos(np.pi / 6), -0.5], [0.5, np.cos(np.pi / 6)]])
    expected = turn @ np.diag([0.25, 0.01]) @ turn.T
    assert_allclose(made["x_err"][0] ** 2, expected[0, 0])
    assert_allclose(made["y_err"][0] ** 2, expected[1, 1])
    assert_allclose(made["xy_corr"][0] * made["x_err"][0] * made["y_err"][0], expected[0, 1])


def test_the_best_positions_with_errors_are_taken(tmp_path):
    table = sextractor_table(tmp_path)
    table["XPSF_IMAGE"], table["YPSF_IMAGE"] = table["XWIN_IMAGE"] + 0.01, table["YWIN_IMAGE"] + 0.01
    table["X_IMAGE"], table["Y_IMAGE"] = table["XWIN_IMAGE"] + 0.1, table["YWIN_IMAGE"] + 0.1
    assert sextractor.understand(table, {})[1] == "XWIN_IMAGE"  # the others have no errors
    for name in ("X2", "Y2", "XY"):
        table[f"ERR{name}PSF_IMAGE"] = table[f"ERR{name}WIN_IMAGE"]
    made, source = sextractor.understand(table, {})
    assert source == "XPSF_IMAGE"
    assert_array_equal(made["x"], table["XPSF_IMAGE"])


def test_rows_without_errors_are_left_out_and_told(tmp_path, caplog):
    table = sextractor_table(tmp_path)
    table["ERRX2WIN_IMAGE"][1] = 0
    table.write(tmp_path / "l.fits")
    out = read_table(tmp_path / "l.fits")
    assert len(out) == 2
    assert "1 of 3 detections have no usable error of position and are left out" in caplog.text


def test_flags_have_our_meaning():
    assert sextractor.FLAGS == {
        1: Flag.BLENDED, 2: Flag.BLENDED, 4: Flag.SATURATED, 8: Flag.EDGE, 16: Flag.EDGE, 32: Flag.EDGE,
        64: Flag.NOT_CONVERGED, 128: Flag.NOT_CONVERGED,
    }  # fmt: skip


def test_mapping_comes_first(tmp_path):
    table = sextractor_table(tmp_path)
    table["myerr"], table["X_IMAGE"], table["Y_IMAGE"] = 0.3, 10.0, 20.0
    table.write(tmp_path / "t.ecsv")
    mapped = {"x": "X_IMAGE", "y": "Y_IMAGE", "x_err": "myerr", "y_err": "myerr", "flux": "FLUX_APER"}
    out = read_table(tmp_path / "t.ecsv", columns=mapped)
    assert_array_equal(out["x"], 9.0)  # 1-based by its name
    assert_array_equal(out["y"], 19.0)
    assert_array_equal(out["x_err"], 0.3)
    assert "xy_corr" not in out.colnames
    assert_array_equal(read_table(tmp_path / "t.ecsv", columns=mapped, origin=0)["x"], 10.0)


def test_positions_without_errors_say_what_to_do(tmp_path):
    table = sextractor_table(tmp_path)["NUMBER", "XWIN_IMAGE", "YWIN_IMAGE"]
    table.write(tmp_path / "t.fits")
    with pytest.raises(InputError, match=r"t\.fits: XWIN_IMAGE comes without errors: let SExtractor write ERRX2WIN_IM"):
        read_table(tmp_path / "t.fits")


# --- origin, names, other formats -----------------------------------------------------------------------------------


def simple():
    return Table({"x": [1.0, 2.0], "y": [3.0, 4.0], "x_err": [0.1, 0.1], "y_err": [0.2, 0.2]})


@pytest.mark.parametrize("origin", [None, 0, 1])
def test_origin_is_taken_off(tmp_path, origin):
    simple().write(tmp_path / "a.csv")
    out = read_table(tmp_path / "a.csv", origin=origin)
    assert_array_equal(out["x"], np.array([1.0, 2.0]) - (origin or 0))
    assert_array_equal(out["y"], np.array([3.0, 4.0]) - (origin or 0))
    assert_array_equal(out["x_err"], 0.1)


def test_a_wrong_origin():
    with pytest.raises(InputError, match=r"origin must be 0 or 1 .*, got 2"):
        read_table("a.csv", origin=2)


def test_errors_of_flystar_are_understood(shared_data):
    table = read_table(shared_data / "keck_nirc2_onc_bn" / "A.lis")
    lines = [line.split() for line in (shared_data / "keck_nirc2_onc_bn" / "A.lis").read_text().splitlines()[1:]]
    assert_array_equal(table["x_err"], [float(line[5]) for line in lines])
    assert_array_equal(table["x"], [float(line[3]) for line in lines])  # taken as they are, from 0


def test_votable_in(tmp_path):
    simple().write(tmp_path / "a.vot", format="votable")
    assert_array_equal(read_table(tmp_path / "a.vot")["y"], [3, 4])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("image.fits", None, r"image\.fits: it has no table \(1 HDUs, all images\)"),
        ("broken.ldac", b"no", r"broken\.ldac: cannot be read as a table"),
        ("broken.vot", b"<VOTABLE><", r"broken\.vot: cannot be read as a table"),
        ("empty.cat", b"", r"empty\.cat: the file is empty"),
        ("binary.txt", bytes(range(256)), r"binary\.txt: "),
    ],
)
@pytest.mark.filterwarnings("ignore")  # readers warn of what they cannot read
def test_bad_files_are_named(tmp_path, name, content, message):
    if content is None:
        fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / name)
    else:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        column_contract.check(read_table(tmp_path / name), column_contract.DETECTED, name)


def test_tables_that_do_not_go_together():
    with pytest.raises(InputError, match="the tables do not go together: "):
        stack([Table({"x": [1.0], "a": [[1, 2]]}), Table({"x": [2.0], "a": ["text"]})])


def test_columns_of_several_values_are_refused():
    table = Table({"exposure": ["a"], "x": [[1.0, 2.0]], "y": [1.0], "x_err": [0.1], "y_err": [0.1]})
    with pytest.raises(InputError, match=r"column 'x' must hold one number a row, it has shape \(1, 2\)"):
        column_contract.check(table, column_contract.DETECTED, "t")
    table["exposure"], table["x"] = [["a", "b"]], [1.0]
    with pytest.raises(InputError, match=r"column 'exposure' must hold one name a row, it has shape \(1, 2\)"):
        column_contract.check(table, column_contract.DETECTED, "t")


# --- stars out -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def solution():
    sim = simulate_gsaoi_matches(small=True, seed=1)
    return solve(sim.matches, degree=3, prior=Prior(sim.truth.static))


SKY = ["ra", "dec", "ra_error", "dec_error", "ra_dec_corr", "ra_error_abs", "dec_error_abs"]


def test_stars_follow_the_virtual_observatory(solution):
    stars = solution.stars
    names = column_contract.STARS.keys() - {
        "reference_used",
        "group",
        "field",
    }  # no reference was given, one detector, one field
    assert set(stars.colnames) == {*names, "sky"}
    for name in names:
        assert check_ucd(stars[name].info.meta["ucd"], check_controlled_vocabulary=True), name
        assert len(stars[name].info.description) > 10
    assert stars["ra"].unit == stars["dec"].unit == u.deg
    assert all(stars[name].unit == u.mas for name in SKY if "error" in name)


def test_errors_on_the_sky_are_those_in_pixels_times_the_scale(solution):
    """Rotation and flip leave the sum of squares alone; gnomonic stretch over half an arcminute is nothing."""
    stars, scale = solution.stars, solution.sky.pixel_scale * 1000
    for suffix in ("", "_abs"):
        sky = np.hypot(stars[f"ra_error{suffix}"].value, stars[f"dec_error{suffix}"].value)
        pixels = np.hypot(*(stars[f"{axis}_err{suffix}"].value for axis in "xy"))
        assert_allclose(sky, pixels * scale, rtol=1e-6)


@pytest.mark.parametrize("ending", [".ecsv", ".fits", ".vot", ".xml", ".csv"])
def test_stars_come_back_from_every_format(solution, tmp_path, ending):
    path = write_stars(solution, tmp_path / f"stars{ending}")
    stars = solution.stars[[name for name in solution.stars.colnames if name != "sky"]]
    if ending in (".vot", ".xml"):
        resource = parse_single_table(path)
        assert {f.name: f.ucd for f in resource.fields} == {
            name: column_contract.STARS[name][0] for name in stars.colnames
        }
        said = {info.name: info.value for info in resource.infos}
        assert said == {key: str(value) for key, value in stars.meta.items() if value is not None}
        assert said["frame"] == "ICRS"
        back = QTable(resource.to_table(use_names_over_ids=True))
    else:
        back = QTable.read(path, format="ascii.csv" if ending == ".csv" else None)
    assert back.colnames == stars.colnames
    for name in stars.colnames:
        assert_array_equal(np.asarray(back[name]), np.asarray(stars[name]))
        assert ending == ".csv" or back[name].unit == stars[name].unit
    if ending == ".fits":
        with fits.open(path) as hdus:
            assert hdus[1].columns["ra_error"].unit == "mas"


def test_stars_without_a_sky(tmp_path):
    plain = solve(simulate_matches(n_stars=12, n_exposures=4, degree=1, seed=3).matches, degree=1)
    back = QTable.read(write_stars(plain, tmp_path / "s.fits"))
    assert not set(SKY) & set(back.colnames)
    with pytest.raises(
        InputError, match=r"s\.doc: the ending selects the format, give one of \.ecsv, \.fits, \.csv, \.txt, \.da"
    ):
        write_stars(plain, tmp_path / "s.doc")
    with pytest.raises(InputError, match="exists already"):
        write_stars(plain, tmp_path / "s.fits")


# --- anything at all -----------------------------------------------------------------------------------------------

NAMES = st.sampled_from(
    ["exposure", "star", "x", "y", "x_err", "y_err", "xy_corr", "flux", "flags", "xe", "XWIN_IMAGE", "YWIN_IMAGE",
     "ERRX2WIN_IMAGE", "ERRY2WIN_IMAGE", "ERRXYWIN_IMAGE", "ERRAWIN_IMAGE", "FLAGS", "FLUX_AUTO", "detector", "é"]
)  # fmt: skip
KINDS = st.one_of(
    hnp.integer_dtypes(endianness="="), hnp.floating_dtypes(endianness="=", sizes=(32, 64)), hnp.boolean_dtypes(),
    hnp.unicode_string_dtypes(min_len=1, max_len=4), hnp.byte_string_dtypes(min_len=1, max_len=4),
)  # fmt: skip
FUZZ = settings(
    max_examples=20, deadline=None, derandomize=True, database=None, phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)  # fmt: skip


@FUZZ
@given(data=st.data())
def test_no_table_breaks_the_reader(tmp_path, data):
    n = data.draw(st.integers(0, 4))
    table = Table()
    for name in data.draw(st.lists(NAMES, max_size=12, unique=True)):
        shape = (n, 2) if data.draw(st.integers(0, 9)) == 0 else (n,)
        table[name] = data.draw(hnp.arrays(data.draw(KINDS), shape))
        if n and data.draw(st.integers(0, 4)) == 0:
            table[name] = np.ma.array(table[name], mask=data.draw(hnp.arrays(bool, shape)))
    ending = data.draw(st.sampled_from(["ecsv", "fits", "csv"]))
    path = tmp_path / f"fuzz.{ending}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            table.write(path, overwrite=True, format={"ecsv": "ascii.ecsv", "csv": "ascii.csv"}.get(ending, ending))
        except Exception:  # what astropy cannot write is not ours to read
            return
        reads_or_refuses(path)


@FUZZ
@given(data=st.data())
def test_no_damage_breaks_the_reader(tmp_path, data):
    base = tmp_path / "list.cat"
    if not base.exists():
        table = sextractor_table(tmp_path)
        write_ldac(tmp_path / "list.ldac", table)
        table.write(tmp_path / "list.ecsv")
        table.write(tmp_path / "list.vot", format="votable")
    ending = data.draw(st.sampled_from(["cat", "ldac", "ecsv", "vot"]))
    content = bytearray((tmp_path / f"list.{ending}").read_bytes())
    for _ in range(data.draw(st.integers(1, 10))):
        where = data.draw(st.integers(0, len(content) - 1))
        content[where] = data.draw(st.integers(0, 255))
    path = tmp_path / f"fuzz.{ending}"
    path.write_bytes(content[: data.draw(st.integers(1, len(content)))] if data.draw(st.booleans()) else content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reads_or_refuses(path)


def reads_or_refuses(path):
    try:
        table = read_table(path)
    except LegdistortError as error:
        assert path.name in str(error)  # noqa: PT017
        return
    for contract in (column_contract.MATCHED, column_contract.DETECTED):
        try:
            column_contract.check(table, contract, "the table")
        except LegdistortError as error:
            assert "the table" in str(error) or "column" in str(error)  # noqa: PT017


# --- in the shell --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_from_lists_to_stars_in_the_shell(tmp_path, capsys):
    """LDAC lists without any option, solved, their checksums in the solution, its stars as FITS."""
    sim = simulate_matches(n_stars=30, n_exposures=4, degree=1, shape=(600, 700), dither=20, sigma=0.02, seed=5)
    paths = []
    for name in sim.matches.names:
        rows = sim.matches.table[sim.matches.table["exposure"] == name]
        table = Table({"XWIN_IMAGE": rows["x"].value + 1, "YWIN_IMAGE": rows["y"].value + 1})
        table["ERRX2WIN_IMAGE"], table["ERRY2WIN_IMAGE"], table["ERRXYWIN_IMAGE"] = 4e-4, 4e-4, 0.0
        paths.append(str(write_ldac(tmp_path / f"{name}.ldac", table)))
    assert parser.main(["match", *paths, "--out", str(tmp_path / "m.ecsv"), "--quiet"]) == 0
    solving = ["solve", str(tmp_path / "m.ecsv"), "--degree", "1", "--out", str(tmp_path / "r"), "--quiet"]
    assert parser.main(solving) == 0
    solution = Solution.read(tmp_path / "r" / "solution.asdf")
    assert solution.provenance["inputs"] == provenance.checksums(*paths, tmp_path / "m.ecsv")
    first = solution.residuals[solution.residuals["exposure"] == sim.matches.names[0]]
    assert set(np.round(first["x"].value, 6)) <= set(
        np.round(sim.matches.table["x"][sim.matches.table["exposure"] == sim.matches.names[0]].value, 6)
    )
    stars = ["stars", str(tmp_path / "r" / "solution.asdf"), "--out", str(tmp_path / "s.fits")]
    assert parser.main(stars) == 0
    assert len(QTable.read(tmp_path / "s.fits")) == len(solution.estimate.star_names)
    capsys.readouterr()
    assert parser.main(stars) == 1
    assert "s.fits exists already" in capsys.readouterr().err
    assert parser.main([*stars, "--overwrite", "--max-bytes", "1000"]) == 1
    assert "is refused" in capsys.readouterr().err


# --- what a table of stars says of itself --------------------------------------------------------------------------


@pytest.mark.slow
def test_stars_say_what_they_are(tmp_path):
    sim = simulate_gsaoi_matches(small=True, seed=3)
    table = sim.matches.table.copy()
    table["epoch"] = 2015.25
    matches = Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses, sky=sim.matches.sky)
    solution = solve(matches, prior=Prior(sim.truth.static, source="a mask"), degree=3)
    stars = solution.stars
    meta = {"frame": "ICRS", "epoch": 2015.25, "gauge": "minimal", "degree": 3, "prior": "a mask"}
    meta |= {"version": f"legdistort {legdistort.__version__}", "pixel_scale": solution.sky.pixel_scale}
    assert stars.meta == meta
    assert stars["sky"].obstime.jyear == 2015.25
    assert_array_equal(stars["sky"].ra, stars["ra"])
    again = Solution.read(solution.write(tmp_path / "s.asdf"))
    assert again.stars.meta == stars.meta
    for ending in ("ecsv", "fits", "vot", "csv"):
        write_stars(solution, tmp_path / f"t.{ending}")
        assert "sky" not in read_table(tmp_path / f"t.{ending}").colnames
    assert QTable.read(tmp_path / "t.ecsv", format="ascii.ecsv").meta["gauge"] == "minimal"
    assert fits.getheader(tmp_path / "t.fits", 1)["EPOCH"] == 2015.25
    planar = solve(Matches.from_table(table, shape=sim.matches.shapes), degree=1, clip=None).stars
    assert planar.meta["frame"] == "reference plane"
    assert {"sky", "prior"}.isdisjoint([*planar.colnames, *planar.meta])


def test_warnings_are_those_of_astropy():
    assert issubclass(AssumptionWarning, AstropyUserWarning)


def test_celestial_axes_have_names():
    sim = simulate_gsaoi_matches(small=True, seed=3)
    wcs = solve(sim.matches, degree=1, clip=None)[sim.matches.names[0]].wcs
    assert tuple(wcs.world_axis_names) == ("ra", "dec")


@pytest.mark.parametrize(("missing", "words"), [(0, None), (1, "some positions"), (3, "all positions")])
def test_the_error_that_is_filled_in_is_told_where_it_is(tmp_path, caplog, missing, words):
    table = Table({"x": [1.0, 2, 3], "y": [1.0, 2, 3], "x_err": [0.1] * 3, "y_err": [0.1] * 3})
    table["x_err"][:missing] = 0
    table.write(tmp_path / "list.csv")
    with caplog.at_level("INFO"):
        found = read_table(tmp_path / "list.csv", error=0.02)
    assert found["x_err"].value.tolist() == [0.02] * missing + [0.1] * (3 - missing)
    said = [record.getMessage() for record in caplog.records if "without an error" in record.getMessage()]
    assert said == (
        [] if words is None else [f"where {words} of a list come without an error, it is taken as 0.02 pixels"]
    )
