"""Dates of star lists by a table of them: as a user has it."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Column, Table
from numpy.testing import assert_allclose, assert_array_equal

from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs import column_contract
from legdistort.inputs.star_lists.given_dates import read_dates, with_dates

# decimal Julian years, 2000.0 = JD 2451545.0 = 2000-01-01T12:00
YEARS = {"a": 2014.5, "b": 2016.25}
JDS = [2451545.0 + (year - 2000) * 365.25 for year in YEARS.values()]
ISO = "a.lis 2014-07-02T15:00:00", "b.lis 2016-04-01T19:30:00"


@pytest.mark.parametrize(
    "text",
    [
        "# list  date\na.lis  2014.5\nb.lis  2016.25\n",
        "a 2014.5\nb 2016.25\n",
        "date,name,seeing\n2014.5,a.lis,0.5\n2016.25,b.lis,0.6\n",
        "file mjd\n" + "".join(f"{n}.lis {jd - 2400000.5}\n" for n, jd in zip("ab", JDS, strict=True)),
        "exposure epoch\n" + "".join(f"{n} {jd}\n" for n, jd in zip("ab", JDS, strict=True)),
        "name date\n" + "\n".join(ISO) + "\n",
        "\n".join(ISO) + "\n",
    ],
    ids=["comment", "no names", "csv", "MJD", "JD", "ISO", "ISO without names"],
)
def test_tables_as_users_have_them(tmp_path, text):
    (tmp_path / "dates.txt").write_text(text)
    found = read_dates(tmp_path / "dates.txt")
    assert [name.removesuffix(".lis") for name in found] == ["a", "b"]
    assert_allclose(list(found.values()), list(YEARS.values()), atol=1e-4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a.lis 2014.5\na.lis 2015.5\n", "a.lis stand in it more than once"),
        ("name date\na.lis 2014.5\nb.lis soon\n", "column 'date' has no date that can be read: row 0 has '2014.5'"),
        ("name date\na.lis 2014-05-01\nb.lis soon\n", "column 'date' has no date that can be read: row 1 has 'soon'"),
        ("a b c\n1 2 3\n", "a table of dates has two columns, .*; it has a, b, c"),
        ("a.lis 14.5\nb.lis 15.5\n", "decimal years from 1800 to 2200, MJD or Time, got a.lis: 14.5"),
    ],
)
def test_bad_tables_are_named(tmp_path, text, words):
    (tmp_path / "dates.txt").write_text(text)
    with pytest.raises(InputError, match=rf"^{re.escape(str(tmp_path / 'dates.txt'))}: .*{words}"):
        read_dates(tmp_path / "dates.txt")


def _list(name):
    return Table({"x": [1.0, 2.0], "exposure": Column([name] * 2, description=column_contract.OF_FILE)})


def test_names_are_those_of_lists_files_or_exposures():
    both = {Path("n1/1.lis"): _list("n1_1"), Path("n2/1.lis"): _list("n2_1")}
    out = with_dates(both, {"n1/1.lis": 2014.5, "n2/1.lis": 2015.5}, "d.txt")
    assert [table["epoch"][0] for table in out.values()] == [2014.5, 2015.5]
    assert "epoch" not in both[Path("n1/1.lis")].colnames
    for dates in ({"n1_1": 2014.5, "n2_1": 2015.5}, {"n1_1": 2014.5, "n2_1.lis": 2015.5, "other": 2000.0}):
        assert [table["epoch"][1] for table in with_dates(both, dates, "d.txt").values()] == [2014.5, 2015.5]
    with pytest.raises(InputError, match=r"d\.txt has no date for 1 exposures \(n2_1\); it has n1_1: names must be"):
        with_dates(both, {"n1_1": 2014.5}, "d.txt")
    one = {Path("1.lis"): _list("1")}  # two lists of the table are called so: which of them it is, is not known
    with pytest.raises(InputError, match="has no date for 1 exposures"):
        with_dates(one, {"n1/1.lis": 2014.5, "n2/1.lis": 2015.5}, "d.txt")


def test_match_takes_dates(tmp_path, capsys):
    """Dates of a table take the place of those in the lists; `solve --motion` without any names the option."""
    rng = np.random.default_rng(5)
    stars = rng.uniform(50, 950, (40, 2))
    for k in range(5):
        table = Table({"x": stars[:, 0] + 3 * k, "y": stars[:, 1] - 2 * k, "x_err": np.full(40, 0.01)})
        table["y_err"] = 0.01
        table["x"] += rng.normal(0, 0.01, 40)
        table.write(tmp_path / f"l{k}.csv")
    lists = sorted(map(str, tmp_path.glob("l*.csv")))
    how = ["--shape", "1000", "1000", "--quiet", "--dates", str(tmp_path / "dates.txt")]
    (tmp_path / "dates.txt").write_text("".join(f"l{k}.csv {2010 + k}.5\n" for k in range(5)))
    assert main(["match", *lists, "--out", str(tmp_path / "m.ecsv"), *how]) == 0
    matched = Table.read(tmp_path / "m.ecsv")
    assert_array_equal(matched["epoch"], [2010.5 + int(name[1:]) for name in matched["exposure"]])
    matched.remove_column("epoch")
    matched.write(tmp_path / "plain.ecsv")
    capsys.readouterr()
    assert main(["solve", str(tmp_path / "plain.ecsv"), "--motion", "proper", "--out", str(tmp_path / "o")]) == 1
    assert "legdistort match --dates TABLE, which has names of lists and their dates" in capsys.readouterr().err


def test_the_number_of_lists_without_errors_is_told(tmp_path, caplog):
    """Not that all positions come without one, which is true of some lists."""
    from legdistort.cli import given_files, parser

    caplog.set_level("INFO", logger="legdistort")
    for name, more in (("a", ""), ("b", ",x_err,y_err"), ("c", ""), ("d", ",x_err,y_err")):
        (tmp_path / f"{name}.csv").write_text(f"x,y{more}\n1.0,2.0{',0.1,0.1' if more else ''}\n")
    lists = sorted(map(str, tmp_path.glob("*.csv")))
    given_files.read_lists(parser._parsed(["match", *lists, "--error", "0.02", "--out", "m.ecsv"]), None)
    assert "where all positions of a list come without an error, it is taken as 0.02 pixels" in caplog.text
    assert "all positions come without an error in 2 of 4 lists (a.csv, c.csv)" in caplog.text
    caplog.clear()
    given_files.read_lists(parser._parsed(["match", *lists[::2], "--error", "0.02", "--out", "m.ecsv"]), None)
    assert "of 2 lists" not in caplog.text


def test_lists_without_a_date_are_named(tmp_path, caplog):
    from legdistort.cli import given_files, parser

    caplog.set_level("INFO", logger="legdistort")
    for name, more in (("a", ",epoch"), ("b", ""), ("c", ",epoch")):
        (tmp_path / f"{name}.csv").write_text(f"x,y,x_err,y_err{more}\n1.0,2.0,0.1,0.1{',2010.5' if more else ''}\n")
    lists = sorted(map(str, tmp_path.glob("*.csv")))
    given_files.read_lists(parser._parsed(["match", *lists, "--out", "m.ecsv"]), None)
    assert "no date is known of 1 of 3 lists (b.csv): --dates TABLE, with those of all, states them" in caplog.text
    caplog.clear()
    given_files.read_lists(parser._parsed(["match", *lists[::2], "--out", "m.ecsv"]), None)
    assert "no date" not in caplog.text


def test_columns_that_are_no_errors_are_named(tmp_path):
    """Of lists of two widths, column 6 has errors in one kind and the ratio of signal to noise in the other."""
    from legdistort.cli import given_files, parser

    for name, error in (("a", 0.02), ("b", 36.0), ("c", 0.01)):
        rows = "".join(f"{k} 1.0 2.0 {k + 5} {k + 7} {error}\n" for k in range(9))
        (tmp_path / f"{name}.lis").write_text(rows)
    lists = sorted(map(str, tmp_path.glob("*.lis")))
    columns = ["--columns", "x=col4,y=col5,x_err=col6,y_err=col6"]
    words = r"larger than 5 pixels in the median in 1 of 3 lists \(.*b\.lis: 36\): if another column"
    with pytest.warns(AssumptionWarning, match=words):
        given_files.read_lists(parser._parsed(["match", *lists, *columns, "--out", "m.ecsv"]), None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        given_files.read_lists(parser._parsed(["match", *lists[::2], *columns, "--out", "m.ecsv"]), None)
