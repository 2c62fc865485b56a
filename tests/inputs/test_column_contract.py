"""The column contract: what is read, renamed, converted, and refused in which words."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import MaskedColumn, QTable, Table
from astropy.utils.masked import Masked
from numpy.testing import assert_array_equal

from legdistort.exceptions import InputError
from legdistort.inputs import column_contract
from legdistort.inputs.table_files import read_table


def table(**changes):
    """Three good rows; a column given as None is taken out."""
    columns = {
        "exposure": ["a", "a", "b"],
        "star": [1, 2, 1],
        "x": [1.0, 2.0, 3.0],
        "y": [4.0, 5.0, 6.0],
        "x_err": [0.1, 0.2, 0.3],
        "y_err": [0.3, 0.2, 0.1],
    }
    return Table({name: column for name, column in (columns | changes).items() if column is not None})


def check(rows):
    return column_contract.check(rows, column_contract.MATCHED, "the table")


def test_a_good_table_becomes_a_qtable():
    given = table(note=["p", "q", "r"], m=[9.0, 8.0, 7.0])
    out = check(given)
    assert isinstance(out, QTable)
    assert all(out[name].unit == u.pix for name in ("x", "y", "x_err", "y_err"))
    assert_array_equal(out["x"].value, given["x"])
    assert out["note"].tolist() == ["p", "q", "r"]  # what is beyond the contract stays
    assert given["x"].unit is None  # the input is left alone
    out["x"][0] = 99 * u.pix
    assert given["x"][0] == 1


def test_units_are_converted_or_refused():
    assert_array_equal(check(table(x=[1, 2, 3] * u.Unit("1000 pix")))["x"].value, [1000, 2000, 3000])
    with pytest.raises(InputError, match=r"column 'x' cannot be read as numbers in pix: .*arcsec.* not convertible"):
        check(table(x=[1, 2, 3] * u.arcsec))


def test_text_in_a_column_of_numbers():
    with pytest.raises(InputError, match="column 'y_err' cannot be read as numbers in pix"):
        check(table(y_err=["0.1", "?", "0.1"]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_err": None}, r"the table lacks the column x_err; it has exposure, star, .*--columns x_err=\.\.\."),
        ({"x_err": None, "star": None}, "the table lacks the columns star, x_err"),
        ({"star": None}, r"the column star; find out first which .*: match\(table\) \(legdistort match\); it has"),
        ({"x": [1.0, np.nan, 3.0]}, r"x is not finite in 1 of 3 rows; the first is row 1 \(exposure a, star 2\)"),
        ({"y": [1.0, np.inf, np.nan]}, "y is not finite in 2 of 3 rows; the first is row 1"),
        (
            {"x_err": [0.1, 0.2, 0.0]},
            r"x_err is not a positive finite number in 1 of 3 rows.*row 2 \(exposure b, star 1",
        ),
        (
            {"y_err": [-0.1, 0.2, 0.1]},
            "y_err is not a positive finite number.*errors are standard deviations in pixels",
        ),
        ({"y_err": [0.1, np.nan, 0.1]}, "y_err is not a positive finite number in 1 of 3 rows"),
        ({"xy_corr": [0.0, 1.0, 0.0]}, r"xy_corr is not inside \(-1, 1\) in 1 of 3 rows"),
        ({"xy_corr": [0.0, np.nan, 0.0]}, r"xy_corr is not inside"),
        ({"star": [1.0, 2.0, 1.0]}, "column 'star' must hold names or integers, got float64"),
        ({"x": MaskedColumn([1.0, 2.0, 3.0], mask=[0, 0, 1])}, "x is not finite in 1 of 3 rows; the first is row 2"),
        ({"x": MaskedColumn([1, 2, 3], mask=[0, 0, 1])}, "x is not finite in 1 of 3 rows; the first is row 2"),
        ({"x": Masked([1.0, 2, 3] * u.pix, mask=[0, 1, 0])}, "x is not finite in 1 of 3 rows; the first is row 1"),
        (
            {"star": MaskedColumn([1, 2, 3], mask=[0, 1, 0])},
            "column 'star' has no value in 1 of 3 rows, the first is row 1",
        ),
        ({"exposure": MaskedColumn(["a", "b", "c"], mask=[0, 1, 1])}, "column 'exposure' has no value in 2 of 3 rows"),
    ],
)
def test_bad_rows_are_named(changes, message):
    with pytest.raises(InputError, match=message):
        check(table(**changes))


def test_empty_table():
    with pytest.raises(InputError, match="the table is empty"):
        check(table()[:0])


def test_names_may_be_bytes_or_objects():
    out = check(table(exposure=np.array(["a", "a", "b"], dtype="S5"), star=np.array(["s1", "s2", "s1"], dtype=object)))
    assert out["exposure"].tolist() == ["a", "a", "b"]
    assert out["star"].tolist() == ["s1", "s2", "s1"]


def test_renaming():
    given = Table({"XWIN": [1.0], "x": [7.0], "err": [0.1], "other": [2]}, meta={"key": 1})
    out = column_contract.rename(given, {"x": "XWIN", "x_err": "err", "y_err": "err"})
    assert out.colnames == ["x", "x_err", "y_err", "other"]
    assert (out["x"][0], out["x_err"][0], out["y_err"][0], out["other"][0]) == (1, 0.1, 0.1, 2)
    assert out.meta == {"key": 1}
    assert given.colnames == ["XWIN", "x", "err", "other"]


def test_renaming_can_swap():
    out = column_contract.rename(Table({"x": [1], "y": [2]}), {"x": "y", "y": "x"})
    assert (out["x"][0], out["y"][0]) == (2, 1)


def test_renaming_names_the_missing_column():
    with pytest.raises(InputError, match="no column 'xe' to use as 'x_err'; the table has x, y"):
        column_contract.rename(Table({"x": [1], "y": [2]}), {"x_err": "xe"})


@pytest.mark.parametrize("ending", ["ecsv", "csv", "fits", "txt", "ECSV"])
def test_files_give_the_table_back(tmp_path, ending):
    given = check(table(star=["s1", "s2", "s1"]))
    path = tmp_path / f"list.{ending}"
    if ending in ("ecsv", "fits", "ECSV"):
        given.write(path, format="fits" if ending == "fits" else "ascii.ecsv")
    else:
        given.write(path, format="ascii.csv" if ending == "csv" else "ascii.commented_header")
    out = check(read_table(path))
    assert out.colnames == given.colnames
    for name in given.colnames:
        assert_array_equal(out[name], given[name])


def test_a_list_without_exposures_is_one_exposure(tmp_path):
    table(exposure=None).write(tmp_path / "night1.lis.txt", format="ascii.basic")
    assert set(read_table(tmp_path / "night1.lis.txt")["exposure"]) == {"night1.lis"}


@pytest.mark.parametrize(("name", "n"), [("A", 135), ("B", None), ("C", None), ("D", None)])
def test_real_lists_of_keck(shared_data, name, n):
    path = shared_data / "keck_nirc2_onc_bn" / f"{name}.lis"
    out = check(read_table(path, columns={"star": "name", "x_err": "xe", "y_err": "ye"}))
    lines = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    assert len(out) == len(lines)
    assert n is None or len(out) == len(lines) >= 100
    assert out["star"].tolist() == [line[0] for line in lines]
    assert_array_equal(out["x"].value, [float(line[3]) for line in lines])
    assert_array_equal(out["y_err"].value, [float(line[6]) for line in lines])
    assert set(out["exposure"]) == {name}


def test_real_lists_of_many_epochs(shared_data):
    for path in sorted((shared_data / "keck_nirc2_ob150029").glob("*.lis")):
        out = read_table(path, columns={"star": "name", "x_err": "xe", "y_err": "ye"})
        assert 200 < len(check(out)) < 520


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("broken.ecsv", "not a table", r"broken\.ecsv: cannot be read as a table"),
        ("broken.fits", "not a table", r"broken\.fits: cannot be read as a table"),
        ("wrong.csv", "a,b\n1,2\n", r"wrong\.csv: no column 'name' to use as 'star'; the table has a, b"),
    ],
)
def test_bad_files_are_named(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        read_table(tmp_path / name, columns={"star": "name"})


def test_absent_file_is_named(tmp_path):
    with pytest.raises(InputError, match="is not a file but a folder"):
        read_table(tmp_path)
    with pytest.raises(InputError, match=r"none\.csv: no such file"):
        read_table(tmp_path / "none.csv")
