"""Lists of many programs with damage, and what stands in single cells; see `list_dialects.py`."""

import codecs

import list_dialects
import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table
from numpy.testing import assert_allclose, assert_array_equal

from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs import column_contract
from legdistort.inputs.references.catalogue import read_reference
from legdistort.inputs.table_files import read_table, write_by_ending
from legdistort.measurement.flags import Flag

#: Lists that were once misread, or refused without a reason or the row.
KNOWN = [8, 11, 14, 27, 30, 35, 42, 44, 107, 121, 128, 228, 354, 416, 651, 922, 1683, 5006]


def read(path, content, **options):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_table(path, **options)


def test_lists_that_were_once_misread():
    _, faults = list_dialects.fuzz(KNOWN)
    assert not faults


@pytest.mark.parametrize("kind", list_dialects.DIALECTS)
def test_every_dialect_is_read_and_its_damage_named(kind, tmp_path):
    outcomes = set()
    for seed in range(4):
        _, _, outcome, fault, _ = list_dialects.fault_of(seed, tmp_path, kind)
        assert fault is None
        outcomes.add(outcome)
    while "read" not in outcomes:
        seed += 1
        outcomes.add(list_dialects.fault_of(seed, tmp_path, kind)[2])


@pytest.mark.parametrize("n", [pytest.param(500, marks=pytest.mark.slow), pytest.param(2000, marks=pytest.mark.sets)])
def test_many_lists(n):
    counts, faults = list_dialects.fuzz(range(n))
    assert counts.total() == n
    assert not faults


# --- single cells ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "value"),
    [("1.5D+02", 150), ("-.25d1", -2.5), ("1.5-103", 1.5e-103), ("****", np.nan), ("INDEF", np.nan), ("2.", 2)],
)
def test_numbers_of_other_programs(tmp_path, word, value):
    """In a text, and as text in a FITS table."""
    want = [1.25, value, 3.0]
    out = read(tmp_path / "a.txt", f"# x y mag\n1 2 1.25\n3 4 {word}\n5 6 3\n")
    assert_array_equal(column_contract.values(out, "mag"), want)
    Table({"x": [1.0, 2, 3], "y": [1.0, 2, 3], "mag": ["1.25", word, "3"]}).write(tmp_path / "a.fits")
    assert_array_equal(column_contract.values(read_table(tmp_path / "a.fits"), "mag"), want)


@pytest.mark.parametrize("word", ["1_0", "1.2.3", "12:30", "abc", "1e", "--5"])
def test_what_is_no_number_is_named_with_its_row(tmp_path, word):
    for name, text in (("a.txt", "x y x_err y_err\n1 2 .1 .1\n3 {} .1 .1\n"), ("a.csv", "x;y\n1;2\n3;{}\n")):
        with pytest.raises(InputError, match=r"column 'y' cannot be read as numbers in pix: row 1 has .*; correct"):
            column_contract.values(read(tmp_path / name, text.format(word)), "y", "pix")


def test_full_columns_of_allstar(tmp_path):
    """Nine columns without a blank, in all rows or in one."""
    head = "\n".join(list_dialects.als([], [], [], full=False)[0]) + "\n"
    full = "100000012345.67823456.789  -12.345   0.015054321.123       4.    0.547   -0.020\n"
    apart = "      2  957.205   12.228   13.961   0.0151  141.334       4.    0.547   -0.020\n"
    wide = "      3*********   12.228   99.999   9.9999*********       4.    0.547   -0.020\n"
    for rows in (full + full, full + apart, apart + full + wide):
        out = read(tmp_path / "a.als", head + rows, error=0.1)
        row = rows.split("\n").index(full.strip("\n"))
        assert_array_equal([out[name][row] for name in ("ID", "SKY", "mag")], [1000000, 54321.123, -12.345])
        assert_allclose([out["x"][row], out["y"][row]], [12344.678, 23455.789])
    assert np.isnan([out["x"][2], out["SKY"][2]]).all()
    with pytest.raises(InputError, match=r"b\.als: a list of DAOPHOT whose .* but 7 words in row 1 \(line 5\), .*corr"):
        read(tmp_path / "b.als", head + apart + apart.replace("   12.228   13.961", " ") + apart)


def test_columns_run_together_where_others_stand_apart(tmp_path):
    rows = ["  100.123  200.456  -9.123", "-1000.123-2000.456 -10.123", "  300.123  400.456  -8.123"]
    out = read(tmp_path / "a.txt", "\n".join(["# x y mag", *rows]))
    assert_array_equal(out["x"], [100.123, -1000.123, 300.123])
    assert_array_equal(out["y"], [200.456, -2000.456, 400.456])
    for k, word in enumerate(("-1000.1-2000.456", "1000.12345678.4560")):  # it ends elsewhere, or has other decimals
        rows[1] = f"{word} -10.123"
        with pytest.raises(InputError, match=r"\.txt: .*row 1 \(line 3\) has 2 cells where the comment above names 3"):
            read(tmp_path / f"b{k}.txt", "\n".join(["# x y mag", *rows]))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be", "utf-32", "latin-1"])
@pytest.mark.parametrize("separator", [",", ";", "\t", "|", " ; "])
def test_encodings_and_separators(tmp_path, encoding, separator):
    cells = (("exposure", "name", "x", "y"), ("e1", "\u00e9 1", "1.5", "2.5"), ("e1", "#2", "3.5", "4.5"))
    content = "\r\n".join(map(separator.join, cells)).encode(encoding)
    out = read(tmp_path / "a.csv", (codecs.BOM_UTF16_BE if encoding == "utf-16-be" else b"") + content)
    assert out["exposure"].tolist() == ["e1", "e1"]
    assert out["name"].tolist() == ["\u00e9 1", "#2"]
    assert_array_equal(out["y"], [2.5, 4.5])
    with pytest.raises(InputError, match=r"b\.csv: .* by its byte order mark it is utf-16.*save it as UTF-8"):
        read(tmp_path / "b.csv", codecs.BOM_UTF16_LE + b"\x00\xd8,")


def test_decimal_commas_beside_semicolons(tmp_path):
    out = read(tmp_path / "a.csv", "name;x;y\na,b;1,5;2\nc;-3,25;4\n")
    assert_array_equal(out["x"], [1.5, -3.25])
    assert out["name"].tolist() == ["a,b", "c"]


@pytest.mark.parametrize(
    ("text", "y"),
    [
        ("x,y,\n1,2,\n3,4,\n", [2, 4]),  # a separator behind the last cell, of all
        ("x;y\n1;2;\n3;4;\n", [2, 4]),  # ... of all but the names
        ("x,y,mag\n1,2,\n3,4,\n", [2, 4]),  # an empty column
        ("# x, y\n1 , 2\n3 , 4\n", [2, 4]),
        ('"x" , "y"\n"1","2"\n"3","4"\n', [2, 4]),
        ("x y\n\n1\t2\n3   4\n\n", [2, 4]),
        ("x\ty\tname\n1\t2\ta b\n3\t4\t\n", [2, 4]),
    ],
)
def test_forms_of_separated_texts(tmp_path, text, y):
    assert_array_equal(read(tmp_path / "a.txt", text)["y"], y)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "x,y\n1,2\n3\n", r"row 1 \(line 3\) has 1 cells where the first line names 2, '3'; correct it"),
        ("a.csv", "x,x\n1,2\n", r"the first line must give each column a name of its own, got 'x', 'x'; correct"),
        ("a.txt", "# x y\n1 2\n3 4 5\n6 7\n", r"row 1 \(line 3\) has 3 cells where the comment above names 2"),
        ("a.txt", "1 2\n3 4 5\n6 7\n", r"row 1 \(line 2\) has 3 cells where the others have 2"),
        ("a.txt", "# x y\n1 2\n3 \0 4\n", r"row 1 \(line 3\) has bytes of zero: the file is damaged"),
        ("a.als", " NL NX NY\n 1 x 2\n\n 1 2 3\n", r"without the values of NL, NX, NY in its second line; restore"),
        ("a.tbl", "|  x |  y |\n  1.0  2.0 \n 13.0.2.0 \n", r"row 1 \(line 3\) does not keep to the columns"),
        ("a.ecsv", "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: x, datatype: float64}\nx\n1\nab\n",
         r"column 'x' has 'ab' in row 1 \(line 7\), which is no number; correct"),
        ("a.vot", "<VOTABLE>\n<TABLE>\n<TR></TR>\n<TR></TT>\n", r"row 1 \(line 4\) is damaged .*; write it again"),
    ],
)  # fmt: skip
def test_the_row_at_fault_is_named(tmp_path, name, text, words):
    with pytest.raises(InputError, match=rf"{name}: (cannot be read as a table: )?.*{words}"):
        read(tmp_path / name, text)


def test_empty_cells_of_names_are_refused_by_row(tmp_path, capsys):
    rows = [f"e{k % 3},{k},{k + 1},.1,.1" for k in range(30)]
    rows[7] = rows[7].replace("e1", "")
    for name in ("one.csv", "two.csv"):
        (tmp_path / name).write_text("\n".join(["exposure,x,y,x_err,y_err", *rows]) + "\n")
    table = Table.read(tmp_path / "one.csv", format="ascii.csv")
    table["exposure"] = table["exposure"].filled("")
    table.write(tmp_path / "one.fits")
    out = ["--shape", "100", "100", "--out", str(tmp_path / "m.ecsv")]
    for path in ("one.csv", "one.fits"):
        assert main(["match", str(tmp_path / path), str(tmp_path / "two.csv"), *out]) == 1
        assert (
            f"{path}: column exposure has no value in 1 of 30 rows, the first is row 7; fill" in capsys.readouterr().err
        )


def test_the_file_of_several_is_named(tmp_path, capsys):
    for name, word in (("a", "5"), ("b", "nan"), ("c", "7")):
        (tmp_path / f"{name}.lis").write_text(f"# x y xe ye m\n1 2 .1 .1 3\n{word} 6 .1 .1 4\n")
    paths = [str(tmp_path / f"{name}.lis") for name in "abc"]
    assert main(["match", *paths, "--shape", "9", "9", "--out", str(tmp_path / "m.ecsv")]) == 1
    assert "b.lis: x is not finite in 1 of 2 rows; the first is row 1 (exposure b)" in capsys.readouterr().err


def test_lists_without_rows(tmp_path, capsys):
    """Beside others they do no harm; alone they are named. So is an epoch that is none."""
    names, out = [f"{name}.csv" for name in "abc"], ["--shape", "99", "99", "--out", str(tmp_path / "m.ecsv")]
    for name in names:
        (tmp_path / name).write_text("x,y,x_err,y_err,epoch\n")
    paths = [str(tmp_path / name) for name in names]
    assert main(["match", *paths, *out]) == 1
    assert "a.csv is empty: give one with a row for each position" in capsys.readouterr().err
    xy = np.random.default_rng(1).uniform(5, 90, (30, 2))
    for k in range(2):
        rows = [f"{x + k:.3f},{y:.3f},.1,.1,2013.5" for x, y in xy]
        (tmp_path / names[k]).write_text("\n".join(["x,y,x_err,y_err,epoch", *rows]) + "\n")
    assert main(["match", *paths, *out, "--min-exposures", "2"]) == 0
    (tmp_path / "b.csv").write_text((tmp_path / "b.csv").read_text().replace("2013.5", "May", 2))
    assert main(["match", *paths, *out, "--min-exposures", "2", "--overwrite"]) == 1
    assert "b.csv: column epoch cannot be read as numbers" in (told := capsys.readouterr().err)
    assert "row 0 has May, the first of 2 of 30" in told


# --- sexagesimal -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ra", "dec"),
    [("05:35:11.99", "-00:24:00.1"), ("05 35 11.99", "-0 24 00.1"), ("5h35m11.99s", "-0d24m0.1s"),
     ("83d47m59.85s", "\u221200:24:00.1")],
)  # fmt: skip
def test_sexagesimal_positions(tmp_path, ra, dec):
    text = f"ra,dec,ra_error,dec_error\n{ra},{dec},.1,.1\n00:00:01,+10:00:00,.1,.1\n,,,\n"
    (tmp_path / "c.csv").write_text(text)
    sky = [[83 + 47 / 60 + 59.85 / 3600, -(24 / 60 + 0.1 / 3600)], [15 / 3600, 10]]
    assert_allclose(read_reference(tmp_path / "c.csv").sky, sky, rtol=0, atol=1e-12)


def test_the_unit_of_a_column_goes_before(tmp_path):
    table = Table({"ra": ["83:30:00", "84:00:00"], "dec": ["10:30:00", "11:00:00"], "ra_error": [0.1] * 2})
    table["dec_error"] = 0.1
    for unit in ("deg", '"d:m:s"'):
        table["ra"].unit = unit
        assert_allclose(read_reference(table).sky[:, 0], [83.5, 84])
    table["ra"] = ["05:30:00", "05:00:00"]
    table["ra"].unit = "hourangle"
    assert_allclose(read_reference(table).sky[:, 0], [82.5, 75])


def test_hours_under_the_unit_of_degrees_are_refused():
    table = Table({"ra": ["05:35:12", "05:36:00"], "dec": ["10:30:00", "11:00:00"], "ra_error": [0.1] * 2})
    table["dec_error"] = 0.1
    table["ra"].unit = "deg"
    with pytest.raises(
        InputError, match="'ra' has the unit deg, but sexagesimal values below 24, '05:35:12' the first"
    ):
        read_reference(table)
    table["ra"] = ["5d35m12s", "5d36m0s"]
    table["ra"].unit = "deg"
    assert_allclose(read_reference(table).sky[:, 0], [5 + 35.2 / 60, 5.6])
    table["ra"] = [5.5, 5.6]
    table["ra"].unit = "h"  # of right ascensions as numbers
    assert_allclose(read_reference(table).sky[:, 0], [82.5, 84])


def test_motions_in_radians(tmp_path):
    table = Table({name: [1.0, 2.0] for name in ("ra", "dec", "ra_error", "dec_error", "pmra", "pmdec")})
    table["pmra_error"] = table["pmdec_error"] = 0.1
    table["ref_epoch"] = 2016.0
    right = read_reference(table).motion
    for name in ("pmra", "pmdec", "pmra_error", "pmdec_error"):
        table[name] = table[name] * np.radians(1 / 3.6e6)
    with pytest.warns(AssumptionWarning, match="no motion is larger than 9.7e-09 mas/yr, the unit of motions without"):
        read_reference(table)
    for name in ("pmra", "pmdec", "pmra_error", "pmdec_error"):
        table[name].unit = "rad/yr"
    table.write(tmp_path / "c.fits")
    assert_allclose(read_reference(tmp_path / "c.fits").motion, right)


IRAF_PHOT = """\
#K IRAF       = NOAO/IRAFV2.16          version    %-23s
#N IMAGE               XINIT     YINIT     ID    COORDS                 LID    \\
#U imagename           pixels    pixels    ##    filename               ##     \\
#F %-23s               %-10.3f   %-10.3f   %-6d  %-23s                  %-6d
#
#N XCENTER    YCENTER    XSHIFT  YSHIFT  XERR    YERR            CIER CERROR   \\
#U pixels     pixels     pixels  pixels  pixels  pixels          ##   cerrors  \\
#F %-14.3f    %-11.3f    %-8.3f  %-8.3f  %-8.3f  %-15.3f         %-5d %-9s
#
test.fits           46.0      47.0      1     coords.txt             1      \\
   46.123     47.345      0.123   0.345   0.012   0.015           0    NoError
test.fits           246.0     247.0     3     coords.txt             3      \\
   246.123    247.345     0.123   0.345   0.013   0.016           103  NoConverge
test.fits           2.0       3.0       4     coords.txt             4      \\
   INDEF      INDEF       INDEF   INDEF   INDEF   INDEF           105  EdgeImage
"""


def test_centres_of_iraf_come_with_errors(tmp_path):
    """What it found no centre of is left out."""
    (tmp_path / "a.mag.1").write_text(IRAF_PHOT)
    table = read_table(tmp_path / "a.mag.1")
    assert_allclose(table["x"], [45.123, 245.123])
    assert_allclose(table["y_err"], [0.015, 0.016])
    assert list(table["flags"]) == [0, Flag.NOT_CONVERGED]


def test_parts_in_columns_of_their_own(tmp_path):
    text = "RAh RAm RAs DE- DEd DEm DEs e_RA_ICRS e_DE_ICRS\n05 35 11.99 - 00 24 00.1 .1 .1\n0 0 1 + 10 30 0 .1 .1\n"
    (tmp_path / "c.txt").write_text(text)
    sky = [[83 + 47 / 60 + 59.85 / 3600, -(24 / 60 + 0.1 / 3600)], [15 / 3600, 10.5]]
    assert_allclose(read_reference(tmp_path / "c.txt").sky, sky, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "ra", "dec"),
    [
        (("RAJ2000", "DEJ2000"), ["17 45 40.04"], ["-29 00 28.1"]),
        (("_RAJ2000", "_DEJ2000"), [266.41683333], [-29.00780556]),
        (("RAdeg", "DEdeg"), [266.41683333], [-29.00780556]),
    ],
)
def test_places_as_vizier_names_them(names, ra, dec):
    table = Table({names[0]: ra, names[1]: dec, "e_RAJ2000": [0.05] * u.arcsec, "e_DEJ2000": [0.06] * u.arcsec})
    found = read_reference(table)
    assert_allclose(found.sky, [[266.41683333, -29.00780556]], atol=1e-8)
    assert_allclose(np.sqrt(np.einsum("jaa->ja", found.covariance)), [[50, 60]])


@pytest.mark.parametrize(
    ("ra", "words"),
    [
        (
            ["05:35:12", "83:48:00"],
            r"column 'ra' has '83:48:00' in row 1, which is not sexagesimal in hours .*, deg",
        ),
        (
            ["05:35:12", "05:35:13", "83.8"],
            r"column 'ra' has '83.8' in row 2, .* \(a number among sexagesimal",
        ),
        (["05:35:12", "05:61:00"], r"column 'ra' has '05:61:00' in row 1"),
        (["83.8", "83.9", "05:35:12"], r"column 'ra' cannot be read as numbers in deg: row 2 has '05:35:12'"),
    ],
)
def test_sexagesimal_positions_whose_unit_is_not_certain(ra, words):
    n = len(ra)
    table = Table({"ra": ra, "dec": ["1:00:00"] * n, "ra_error": [0.1] * n, "dec_error": [0.1] * n})
    with pytest.raises(InputError, match=words):
        read_reference(table)


# --- text in FITS tables -----------------------------------------------------------------------------------------

TEXTS = {
    "Greek": ["\u03b1 1", "b", "\u65e5\u672c"],
    "objects": np.array(["\u03b1", "", "c"], dtype=object),
    "plain": ["a", "bb", "c\\u03b1"],
    "bytes": np.char.encode(["\u03b1", "b", "c"], "utf-8"),
    "masked": np.ma.MaskedArray(["\u03b1", "b", "c"], mask=[False, False, True]),
    "pairs": [["\u03b1", "b"], ["c", "d"], ["e", "\u00e9"]],
}


@pytest.mark.parametrize("ending", [".fits", ".ecsv", ".vot", ".csv", ".txt", ".dat"])
@pytest.mark.parametrize("kind", TEXTS)
def test_any_text_is_written_and_read(tmp_path, ending, kind):
    if kind == "pairs" and ending in (".csv", ".txt", ".dat", ".vot"):
        pytest.skip("no columns of two words each in CSV, nor in astropy's VOTable")
    table = Table({"star": TEXTS[kind], "x": [1.0, 2, 3]})
    write_by_ending(table, tmp_path / f"t{ending}")
    back = read_table(tmp_path / f"t{ending}")
    want = np.ma.filled(np.ma.asarray(TEXTS[kind]), "")
    want = np.char.decode(want, "utf-8") if want.dtype.kind == "S" else want.astype(str)
    assert_array_equal(np.ma.filled(np.ma.asarray(back["star"]), "").astype(str), want)
    if ending == ".fits":  # by astropy alone
        theirs = Table.read(tmp_path / "t.fits")["star"]
        assert_array_equal(np.char.decode(np.ma.filled(np.ma.asarray(theirs), b""), "utf-8"), want)


def test_names_of_columns_and_foreign_bytes(tmp_path):
    table = Table({"\u03b1": [1.0], "x": [2.0]})
    write_by_ending(table, tmp_path / "t.fits")
    assert read_table(tmp_path / "t.fits").colnames[:2] == ["\u03b1", "x"]
    Table({"star": ["\u00e9".encode("latin-1"), b"\xe8"], "x": [1.0, 2]}).write(tmp_path / "l.fits")
    assert read_table(tmp_path / "l.fits")["star"].tolist() == ["\u00e9", "\u00e8"]  # different names stay different
