"""What notebooks show of our objects: the words that print shows, as tables, and nothing of them as markup."""

from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

import legdistort as ld
from legdistort.results.check import Check
from legdistort.runtime.notebook import MOST_ROWS

ODD = "<script>alert(1)<i>&amp;"
BAD = Check("place", "warn", 2.0, 1.0, f"a pattern <here> & {ODD}", "look at <b>")


class Cells(HTMLParser):
    """Rows of cells of all tables, other text, and tags, which must be closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.rows, self.text = [], set(), [], ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag != "br":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" in self.open:
            return
        self.text += data
        if "td" in self.open or "th" in self.open:
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def solution():
    table = ld.simulate_matches(n_exposures=4, n_stars=20, degree=1, seed=2).matches.table
    table["exposure"] = np.where(table["exposure"] == "exp01", ODD, table["exposure"])
    solved = ld.solve(ld.Matches.from_table(table, shape=(2048, 2048)), degree=1)
    estimate = replace(solved.estimate, checked=(Check("chi2", "pass", 1.0, None, "fine"), BAD))
    return replace(solved, estimate=estimate, left_out={"bad <one>": f"too few & {ODD}"})


@pytest.fixture(scope="module")
def matches():
    return ld.simulate_matches(n_exposures=3, n_stars=20, dither=40, seed=3).matches


def plan(**options):
    return ld.predict(n_exposures=5, n_stars=40, sigma=0.02, degree=2, dithers=200, n_grid=8, **options)


PLANS = {
    "plain": {},
    "of two errors": {"dynamic": 0.3, "spectrum": {3: 0.1}},
    "epochs": {"epochs": np.arange(2015.0, 2020)},
}


@pytest.mark.parametrize("what", ["solution", "camera", "one camera", "check", *PLANS])
def test_tables_have_every_word_that_print_shows(what, request):
    made = {
        "solution": lambda: request.getfixturevalue("solution"),
        "camera": ld.Camera.gsaoi,
        "one camera": lambda: ld.Camera.of_images([(20, 30)]),
        "check": lambda: BAD,
    }
    thing = made[what]() if what in made else plan(**PLANS[what])
    page = Cells(thing._repr_html_())
    squeezed = "".join(page.text.split())
    assert [word for word in str(thing).split() if word.removesuffix(":").rstrip(";") not in squeezed] == []
    assert page.tags <= {"div", "style", "p", "b", "table", "thead", "tbody", "tr", "th", "td", "span", "small", "br"}
    assert len({len(row) for row in page.rows if row[0] == "exposure"}) <= 1


def test_exposures_have_a_row_each_with_the_numbers_that_print_shows(solution):
    page = Cells(solution._repr_html_())
    printed = {line.split()[0]: line.split() for line in str(solution).splitlines() if line}
    for name in solution.names:
        (row,) = [row for row in page.rows if row[0] == name]
        assert row == printed[name]
    assert ["warn", f"place: {BAD.sentence}; {BAD.cure}"] in page.rows
    head = next(row for row in page.rows if row[0] == "exposure")
    assert head[2:5] == ["shift xpx", "shift ypx", "rotationdeg"]


def test_checks_are_a_table_the_worst_first_and_still_a_tuple(solution):
    page = Cells(solution.checks._repr_html_())
    assert page.rows[1:] == [["place", "warn", BAD.sentence, BAD.cure], ["chi2", "pass", "fine", ""]]
    assert isinstance(solution.checks, tuple)
    assert repr(solution.checks) == repr(tuple(solution.checks))


def test_matches_have_a_row_an_exposure(matches):
    some = replace(matches, left_out={ODD: "no <star>"})
    page = Cells(some._repr_html_())
    name, n, x, y, rotation, scale = page.rows[2]
    assert name == matches.names[1]
    assert int(n) == np.count_nonzero(matches.table["exposure"] == name)
    assert (float(x), float(y)) == pytest.approx(tuple(matches.poses[name][:, 2]), abs=0.006)
    assert (float(rotation), float(scale)) == (0, 1)
    assert page.rows[-1] == ["left out", f"{ODD}: no <star>"]
    assert str(some) == "<Matches: 60 observations of 20 stars in 3 exposures>"


def test_long_tables_end_with_how_much_is_missing():
    matches = ld.simulate_matches(n_exposures=MOST_ROWS + 17, n_stars=4).matches
    page = Cells(matches._repr_html_())
    assert [row[0] for row in page.rows[1:]] == list(matches.names[:MOST_ROWS])
    assert "and 17 more" in page.text
