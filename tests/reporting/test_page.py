"""The page: complete in itself, everything named, nothing taken for markup."""

import base64
import json
import re
from dataclasses import asdict
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from time import process_time
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from drawn_solutions import make_mosaic, make_solution
from matplotlib import pyplot, style
from PIL import Image

from legdistort.assessment.pulls import pulls_of
from legdistort.assessment.stack_quality import Quality
from legdistort.cameras.detector import Place
from legdistort.exceptions import InputError
from legdistort.geometry import basis
from legdistort.inputs.exposures import Exposure, observed
from legdistort.matching.matches import Matches
from legdistort.plots import elements
from legdistort.reporting import facts
from legdistort.reporting import page as report
from legdistort.reporting.pictures import Picture
from legdistort.reporting.svg import STYLE, detached_figure, svg_of
from legdistort.reporting.tables import detectors_table
from legdistort.results import in_tables
from legdistort.simulation import observations
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve

ODD = ["a<b>&\"c'", "$x$_\\frac{", "<script>alert(1)</script>", "星 plain"]
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Tags that match, references, texts of table cells."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.references, self.cells, self.pictures = [], [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        attrs = dict(attrs)
        self.references += [attrs[key] for key in ("src", "href", "data", "action") if key in attrs]
        if tag == "svg":
            self.pictures.append(attrs)
        if tag in ("td", "th"):
            self.cells.append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "td" in self.open or "th" in self.open:
            self.cells[-1] += data

    def row(self, first):
        """The ten cells of an exposure, or the fact that follows its name."""
        at = self.cells.index(first)
        return self.cells[at : at + 10]


@pytest.fixture(scope="module")
def solution():
    return make_solution(names=ODD, n_stars=40)


@pytest.fixture(scope="module")
def text(solution):
    return report.render(solution, mosaic=make_mosaic(600), summary={"timings": {"solve": 0.0812, "co<add": 3.0}})


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


@pytest.fixture
def tables_only(monkeypatch):
    """Without pictures, for tests that do not look at them."""
    monkeypatch.setattr(report.Gallery, "add", lambda *args, **kwargs: Picture("", "", 1))


def test_page_is_well_formed_and_needs_nothing_else(page, text):
    assert all(each.startswith("#part-") for each in page.references)  # no files were named
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    assert {"link", "iframe", "object"}.isdisjoint(page.tags)
    assert re.findall(r"<script[^>]*>", text) == ['<script type="application/json" id="names">', "<script>"]
    assert "title" in page.tags
    assert len(text) < 2e6
    ids = re.findall(r'\sid="([^"]*)"', text)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:href="|url\()#([^")]*)', text)) <= set(ids)


def test_script_is_short():
    path = Path(report.__file__).parent / "templates" / "report.js"
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 200


def test_files_beside_it_are_linked(solution, tables_only):
    references = Page(report.render(solution, files=["a b.fits", "wcs/"])).references
    assert [each for each in references if each[0] != "#"] == ["a%20b.fits", "wcs/"]


def test_the_contents_lead_to_every_part(text):
    listed = re.findall(r'<li><a href="#(part-\d+)">([^<]*)</a></li>', text)
    assert listed == re.findall(r'<h2 id="(part-\d+)">([^<]*)</h2>', text)
    assert {"Solution", "Residuals", "Exposures", "Stars"} <= {words for _, words in listed}


def test_the_title_says_what_was_observed(solution, tables_only):
    seen = {"target": "NGC <1>", "instrument": "GSAOI", "dates": "2014-05-12"}
    page = report.render(solution, summary={"observed": seen})
    assert "<title>NGC &lt;1&gt;, GSAOI</title>" in page
    assert "<h1>NGC &lt;1&gt;, GSAOI</h1>" in page
    assert "<h1>Distortion of 4 exposures</h1>" in report.render(solution)


def test_points_tell_when_their_exposure_was_taken():
    table = simulate_matches(n_exposures=3, n_stars=30, seed=2).matches.table.copy()
    years = {"exp00": 2014.5, "exp01": np.nan, "exp02": 2016.0}
    table["epoch"] = [years[name] for name in table["exposure"]] * u.yr
    solution = solve(Matches.from_table(table, shape=(2048, 2048)), degree=1)
    assert facts.dated_names(solution) == ["exp00, 2014-07-02 15:00", "exp01", "exp02, 2016-01-01 12:00"]


def test_all_checks_have_a_row(page, solution):
    assert {check.name for check in solution.checks} <= set(page.cells)


def test_every_name_is_there_literally(page):
    assert set(ODD) <= set(page.cells)
    assert page.row("Left out")[1] == "bad <one>: only 2 stars matched, <i>10</i> & more are needed"
    assert page.row("Time")[1] == "solve 0.08 s, co<add 3.00 s"


def test_every_picture_has_its_sentence_and_follows_the_colours_of_the_page(page, text):
    # steps, error, mean residuals, pulls twice, coefficients, mosaic; distortion, dynamic part, trends
    assert len(page.pictures) == 10 == text.count("<figcaption>")
    assert all(re.search(r"\.</figcaption>", caption) for caption in re.findall(r"<figcaption>.*", text))
    assert text.count("currentColor") > 10
    drawings = "".join(re.findall(r"<svg.*?</svg>", text, re.DOTALL))
    assert "#000000" not in drawings
    assert "#ffffff" not in drawings
    for data in re.findall(r'base64,([^"]*)"', text):
        with Image.open(BytesIO(base64.b64decode(data))) as image:
            assert len(np.unique(np.asarray(image.convert("RGBA").convert("L")))) > 4  # not blank


def test_marks_belong_to_their_stars_and_exposures(text, solution):
    names = json.loads(re.search(r'id="names">(.*?)</script>', text)[1])
    assert names == {"s": [str(name) for name in solution.estimate.star_names], "e": list(solution.names)}
    pulls = pulls_of(solution)
    (dots,) = [each for each in re.findall(r"<svg.*?</svg>", text, re.DOTALL) if "stars by brightness" in each]
    found = {int(s): (float(x), float(y)) for s, x, y in re.findall(r'data-s="(\d+)"[^>]* x="(\S+)" y="(\S+)"', dots)}
    assert sorted(found) == list(range(len(solution.estimate.star_names)))
    place, rms = np.array([found[i] for i in sorted(found)]), pulls.by_star().rms
    assert np.corrcoef(place[:, 0], np.log(pulls.brightness))[0, 1] == pytest.approx(1, abs=1e-6)
    assert np.corrcoef(place[:, 1], rms)[0, 1] == pytest.approx(-1, abs=1e-6)
    assert text.count('class="panel" data-e=') == 2 * len(solution.names)


@pytest.mark.parametrize("colours", ["red", ["red", "blue", "red"]])
def test_every_line_is_a_mark_of_its_own(colours):
    """Also one of no length, and whether or not the lines look alike and are drawn at once."""
    ends = [[[0.1, 0.1], [0.5, 0.2]], [[0.5, 0.5], [0.5, 0.5]], [[0.9, 0.9], [0.2, 0.8]]]
    with style.context(["default", STYLE]):
        figure = detached_figure(2, 2, layout=None)
        ax = figure.subplots()
        lines = elements.draw_lines(ax, ends, color=colours)
        elements.mark(lines, stars=[7, 8, 9], exposures=[0, 0, 1])
        made = svg_of(figure, "a")
    drawn = re.findall(r'<path data-s="(\d)" data-e="(\d)" d="M ?([\d.]+) ([\d.]+)\s+L ?([\d.]+) ([\d.]+)', made)
    assert [each[:2] for each in drawn] == [("7", "0"), ("8", "0"), ("9", "1")]
    at = [tuple(map(float, each[2:])) for each in drawn]
    assert at[0][0] < at[0][2]
    assert at[1][:2] == at[1][2:]
    assert at[2][0] > at[2][2]


def test_text_in_pictures_is_text():
    """Names of exposures in a picture are neither markup nor mathematics."""
    with style.context(["default", STYLE]):
        figure = detached_figure(2, 2, layout=None)
        ax = figure.subplots()
        ax.set_title(ODD[2], parse_math=False)
        made = svg_of(figure, "a")
    assert "<script>" not in made
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in made


def test_what_is_named_is_text_not_markup(solution, tables_only):
    summary = {"observed": {"target": ODD[2]}, "command": f"legdistort run {ODD[0]}"}
    page = Page(report.render(solution, summary=summary, comparison=dict.fromkeys(ODD[:3], solution), files=[ODD[2]]))
    assert page.row("Target")[1] == ODD[2]
    assert page.row("Command")[1] == f"legdistort run {ODD[0]}"
    assert page.cells.index(ODD[2]) >= 0
    assert page.tags.count("script") == 2


def test_methods_have_the_figures_of_the_run(solution, tables_only):
    summary = {"observed": {"target": "NGC 1851", "instrument": "GSAOI", "filter": "Ks"}, "rms_px": 0.0123}
    text = report.render(solution, summary=summary)
    words = re.search(r'<p class="methods">(.*?)</p>', text, re.DOTALL)[1]
    for part in (
        "4 exposures of NGC 1851 with GSAOI (filter Ks)",
        "total degree 3",
        "0.0123 px per axis",
        "1432.1 for 1380",
    ):
        assert part in words
    assert "@article{Bernard2018" in text
    assert "None" not in re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)


def test_headers_say_what_was_observed():
    def frame(name, **keywords):
        return Exposure(name, np.zeros((5, 5)), header=fits.Header(keywords), exposure_time=30.0)

    frames = [frame("a", OBJECT="M 5", INSTRUME="GSAOI", FILTER1="Ks", FILTER2="open",
                    **{"DATE-OBS": "2013-02-02T01:00"}),
              frame("b", OBJECT="M 5", FILTER1="Ks", **{"DATE-OBS": "2013-02-01"})]  # fmt: skip
    assert observed(frames) == {
        "target": "M 5", "instrument": "GSAOI", "filter": "Ks", "dates": "2013-02-01 to 2013-02-02T01:00",
        "exposure time": "2 x 30 s",
    }  # fmt: skip
    assert observed([Exposure("c", np.zeros((5, 5)))]) == {}


def test_numbers_are_those_of_the_solution(page, solution):
    name = ODD[1]
    rows = solution.residuals[(solution.residuals["exposure"] == name) & solution.residuals["used"]]
    rms = [np.sqrt(np.mean(rows[d].to_value(u.pix) ** 2)) for d in ("dx", "dy")]
    shift = solution.poses[name][:, 2]
    # rms over the detector by brute force
    t = np.linspace(-0.5, 2047.5, 801)
    t = (t[1:] + t[:-1]) / 2
    q = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    sizes = []
    for c in (solution.coefficients[1], solution.coefficients[1] - solution.estimate.prior_mean[1]):
        displacement = c @ basis.values(3, *basis.normalize(q, (2048, 2048)))
        sizes.append(np.sqrt(np.sum(np.var(displacement, axis=1))))
    expected = [f"{shift[0]:.2f}", f"{shift[1]:.2f}", "0.0000", "1.000000", str(len(rows))]
    expected += [f"{r:.4f}" for r in rms]
    assert page.row(name)[1:8] == expected
    np.testing.assert_allclose([float(c) for c in page.row(name)[8:]], sizes, atol=2e-3)
    assert (
        page.row("Residuals, rms")[1]
        == f"{in_tables.rms(solution)[0]:.4f} px in x, {in_tables.rms(solution)[1]:.4f} px in y"
    )
    assert page.row("Stars")[1] == "40"
    assert page.row("χ² / degrees of freedom")[1].startswith("1432.1 / 1380 = 1.038")
    assert float(page.row("Largest error of an inverse")[1].split()[0]) == pytest.approx(
        in_tables.largest_inverse_error(solution), rel=0.1
    )


def test_summary_replaces_what_follows_from_the_solution(solution, tables_only):
    summary = {"n_stars": 77, "rms_px": 0.0123, "sigma_px": [0.004, 0.005], "max_inverse_error_px": 2.5e-7}
    page = Page(report.render(solution, summary=summary | {"left_out": {}, "n_observations": 500}))
    assert page.row("Stars")[1] == "77"
    assert page.row("Residuals, rms")[1] == "0.0123 px per axis"
    assert page.row("Scatter of corrected positions")[1] == "0.0040 px in x, 0.0050 px in y"
    assert page.row("Largest error of an inverse")[1] == "2.5e-07 px"
    assert page.row("Left out")[1] == "none"
    assert page.row("Positions used")[1].startswith("500 ")


def test_stars_without_a_position_do_not_count(tables_only):
    solution = make_solution(5, 40)
    solution.estimate.positions[7] = np.nan
    assert Page(report.render(solution)).row("Stars")[1] == "39 (1 more without a position)"


def test_outlying_exposures_are_marked(tables_only):
    solution = make_solution(5, 40)
    solution.residuals["dy"][solution.residuals["exposure"] == solution.names[3]] *= 4
    text = report.render(solution)
    marked = re.findall(r'<td class="high">([\d.]+)</td>', text)
    assert marked == [Page(text).row(solution.names[3])[7]]


@pytest.mark.slow
def test_trailed_exposures_have_a_row_and_are_marked(solution, tables_only):
    """Three times as long as wide is an ellipticity of 2/3; where no star was measured nothing is stated."""
    names = solution.names
    shapes = {names[0]: (3.1, 0.1, 12.0), names[1]: (5.4, 2 / 3, -40.0)}
    text = report.render(solution, summary={"quality": asdict(Quality(9, 4.0, 0.1, 0.05, 0.01, 1.0, 1.0, shapes))})
    page = Page(text)
    assert page.cells[page.cells.index(names[0]) + 10 :][:3] == ["3.10", "1.11", "12"]
    assert page.cells[page.cells.index(names[1]) + 10 :][:3] == ["5.40", "3.00", "-40"]
    assert page.cells[page.cells.index(names[2]) + 10 :][:3] == ["–", "–", "–"]
    assert re.findall(r'<td class="high">([\d.]+)</td>', text) == ["3.00"]
    assert "trailed" in text
    assert "trailed" not in report.render(solution)


@pytest.mark.parametrize(
    "degree", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(6, marks=pytest.mark.slow)]
)
def test_two_exposures_without_flux_prior_or_mosaic(degree):
    solution = make_solution(2, 30, degree, flux=False, prior=False)
    page = Page(report.render(solution))
    assert set(solution.names) <= set(page.cells)
    assert len(page.pictures) == 7 - (degree == 1)


@pytest.mark.usefixtures("undrawn")
def test_strong_distortion_is_magnified_less():
    solution = make_solution(2, 30, 2)
    solution.coefficients[:, 0, 3] = 40
    text = report.render(solution)
    assert "magnified 2 times" in text


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_many_exposures_are_listed_and_the_dozen_that_departs_most_is_drawn():
    solution = make_solution(14, 10)
    solution.coefficients[5] = solution.estimate.prior_mean[5]
    page = Page(text := report.render(solution))
    assert set(solution.names) <= set(page.cells)
    assert "the 12 exposures that depart most" in text
    assert page.row(solution.names[5])[9] == "0.000"


@pytest.mark.slow
def test_a_page_of_400_exposures_can_be_sent():
    start = process_time()
    text = report.render(make_solution(400, 80))
    assert process_time() - start < 20  # 5 s where it was measured
    assert len(text.encode()) < 8e6


def test_exposure_without_used_positions_has_no_rms(tables_only):
    solution = make_solution(3, 20)
    solution.residuals["used"][solution.residuals["exposure"] == solution.names[0]] = False
    assert Page(report.render(solution)).row(solution.names[0])[5:8] == ["0", "–", "–"]


def test_fold_is_reported_in_words(tables_only):
    solution = make_solution(2, 20, 2)
    solution.coefficients[0, 0, 3] = 400
    assert "folds" in Page(report.render(solution)).row("Largest error of an inverse")[1]


def test_file_is_written_once(tmp_path, solution, monkeypatch):
    monkeypatch.setattr(report, "render", lambda *args, **kwargs: "first ✓")
    path = report.write_report(tmp_path / "report.html", solution)
    assert path == tmp_path / "report.html"
    assert path.read_text(encoding="utf-8") == "first ✓"
    monkeypatch.setattr(report, "render", lambda *args, **kwargs: "second")
    with pytest.raises(InputError, match=r"report\.html exists"):
        report.write_report(path, solution)
    assert path.read_text(encoding="utf-8") == "first ✓"
    report.write_report(str(path), solution, overwrite=True)
    assert path.read_text(encoding="utf-8") == "second"
    made = report.write_report(tmp_path / "folder" / "report.html", solution)
    assert made.read_text(encoding="utf-8") == "second"
    for files in ([("a", "b")], "stars.ecsv", [1]):
        with pytest.raises(InputError, match="files must be names of results"):
            report.write_report(path, solution, files=files, overwrite=True)


def test_nothing_is_left_behind_when_it_fails(tmp_path, solution, monkeypatch):
    def fail(*args, **kwargs):
        raise InputError("no")

    monkeypatch.setattr(report, "render", fail)
    with pytest.raises(InputError, match="no"):
        report.write_report(tmp_path / "report.html", solution)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_solved_set_gives_a_page(tmp_path):
    matches = observations.simulate_matches(n_stars=25, n_exposures=3, degree=2, seed=3).matches
    solution = solve(matches, degree=2)
    before = pyplot.get_fignums()
    with pyplot.style.context("dark_background"):  # a user's style does not reach the page
        path = report.write_report(tmp_path / "report.html", solution)
    page = Page(path.read_text(encoding="utf-8"))
    assert set(solution.names) <= set(page.cells)
    assert page.row("Gauge")[1] == solution.gauge.sentence
    assert "#000000" not in path.read_text(encoding="utf-8")
    assert pyplot.get_fignums() == before


@pytest.mark.parametrize(
    ("errors", "cells"),
    [
        (None, ["136.158", "-0.752", "0.01492"]),
        ((0.0095, 0.013, 0.00012), ["136.1582 ± 0.0095", "-0.752 ± 0.013", "0.01492 ± 0.00012"]),
        ((0.00996, 1.25, 0.01), ["136.158 ± 0.010", "-0.8 ± 1.2", "0.015 ± 0.010"]),
        ((37.0, np.inf, 0.0), ["136 ± 37", "-0.752 ± unknown", "0.01492 ± 0.00000"]),
    ],
)
def test_values_of_detectors_have_the_digits_of_their_errors(errors, cells):
    place, detector = Place(136.15819, -0.7524, 0.014917, 1.0, errors), SimpleNamespace(rms=0.1)
    (row,) = detectors_table(SimpleNamespace(detectors={"1": detector}, places={"1": place})).rows
    assert row.cells[1:4] == cells
