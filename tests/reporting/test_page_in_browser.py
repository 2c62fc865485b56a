"""The report in a real browser: no errors, marks, sorting, filtering, blinking, paper, dark, narrow."""

import shutil

import numpy as np
import pytest
from drawn_solutions import make_solution

from legdistort.assessment import baselines
from legdistort.reporting import page as report
from legdistort.simulation.observations import simulate_exposures

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: the report is not tried in a browser")
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium: the report is not tried in a browser")

NAMES = [f"frame {i}" for i in range(9)] + ["<script>alert(1)</script>"]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    solution = make_solution(names=NAMES, n_stars=40)
    return report.write_report(tmp_path_factory.mktemp("report") / "report.html", solution)


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def show(browser):
    """Opens a file; whatever the browser complains of, and every request for anything else, is an error."""
    contexts, faults = [], []

    def opened(path, width=1200, scheme="light"):
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        contexts.append(context)
        tab = context.new_page()
        tab.on("console", lambda message: faults.append(message.text))
        tab.on("pageerror", lambda error: faults.append(str(error)))
        tab.on("dialog", lambda dialog: faults.append("a name was run as a script"))
        tab.on(
            "request", lambda request: faults.append(request.url) if request.url[:5] not in ("file:", "data:") else 0
        )
        tab.goto(path.as_uri())
        return tab

    yield opened
    for context in contexts:
        context.close()
    assert faults == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1200, 700, 400])
def test_it_fits_and_its_text_can_be_read(show, path, width, scheme):
    tab = show(path, width, scheme)
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    lightness = "color => color.match(/\\d+/g).slice(0, 3).reduce((a, b) => a + +b, 0) / 765"
    paper, ink, text = (
        tab.evaluate(f"({lightness})(getComputedStyle(document.querySelector('{where}')).{what})")
        for where, what in (("body", "backgroundColor"), ("body", "color"), ("figure svg text", "fill"))
    )
    assert (paper > 0.9) if scheme == "light" else (paper < 0.2)
    assert abs(ink - paper) > 0.6
    assert text == ink


def test_the_contents_unfold_what_they_lead_to(show, path):
    tab = show(path)
    assert not tab.locator("details.more").evaluate("each => each.open")
    tab.get_by_role("link", name="Stars", exact=True).click()
    assert tab.locator("details.more").evaluate("each => each.open")
    tab.wait_for_function("Math.abs([...document.querySelectorAll('h2')].at(-1).getBoundingClientRect().top) < 900")


#: Of every picture the size of the smallest letters on the screen, texts that lie upon each other, and those cut off.
TEXTS = """() => [...document.querySelectorAll("figure svg")].map(svg => {
  const texts = [...svg.querySelectorAll("text")].map(e => [e.textContent.trim(), e.getBoundingClientRect(), e]);
  const shown = texts.filter(([, r]) => r.width && r.height);
  const size = e => parseFloat(getComputedStyle(e).fontSize) * Math.hypot(e.getScreenCTM().a, e.getScreenCTM().b);
  const both = (r, q) => [Math.min(r.right, q.right) - Math.max(r.left, q.left),
                          Math.min(r.bottom, q.bottom) - Math.max(r.top, q.top)];
  return [Math.min(...shown.map(([, , e]) => size(e))), shown.flatMap(([a, r], i) => shown.slice(i + 1)
    .filter(([, q]) => both(r, q)[0] > 2 && both(r, q)[1] > 3).map(([b]) => [a, b])),
    shown.filter(([, r]) => both(r, svg.getBoundingClientRect())[0] < r.width - 2).map(([a]) => a)];
})"""


@pytest.mark.parametrize("width", [1200, 700, 400])
def test_labels_of_pictures_are_large_enough_and_apart(show, path, width):
    tab = show(path, width)
    tab.locator("details.more > summary").click()
    for size, *faults in tab.evaluate(TEXTS):
        assert size >= 9
        assert faults == [[], []]


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """A page with all pictures that have points, of stars that move, measured on known dates; one star is wild."""
    import legdistort as ld

    epochs = np.repeat([2014.5, 2016.0, 2018.25], 3)
    simulated = ld.simulate_matches(
        n_exposures=9, n_stars=30, degree=1, motion=0.05, dither=300, epochs=epochs, shape=(9000, 12000), seed=3
    )
    table = simulated.matches.table
    table["flux"] = 10.0 ** (4 + np.unique(table["star"], return_inverse=True)[1] / 60)
    solution = ld.solve(ld.Matches.from_table(table, shape=(9000, 12000)), degree=1, motion="proper")
    wild = solution.residuals["star"] == solution.estimate.star_names[4]
    solution.residuals["dx"][wild] *= 100
    comparison = {"shift": solution, baselines.METHOD: solution}
    folder = tmp_path_factory.mktemp("moving")
    return report.write_report(folder / "report.html", solution, comparison=comparison), solution


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1200, 400])
def test_large_fields_and_short_logarithmic_axes_have_labels_apart(show, moving, width, scheme):
    tab = show(moving[0], width, scheme)
    tab.locator("details.more > summary").click()
    for size, *faults in tab.evaluate(TEXTS):
        assert size >= 9
        assert faults == [[], []]


@pytest.mark.slow
def test_every_point_says_what_it_is_and_exposures_their_dates(show, moving):
    path, solution = moving
    tab = show(path, 400)
    tab.locator("details.more > summary").click()
    titles = tab.locator("figure svg").evaluate_all("all => all.map(svg => svg.textContent.replace(/\\s+/g, ' '))")
    of_points = ("Proper motions of", "Errors of proper motions", "stars by brightness", "exposures in time",
                 "corrected positions, per axis", "rotation [deg]")  # fmt: skip
    n = len(solution.estimate.star_names)
    for words in of_points:
        (k,) = [k for k, title in enumerate(titles) if words in title]
        marks = tab.locator("figure svg").nth(k).locator(".marks [data-s], .marks [data-e]")
        found = marks.evaluate_all("all => all.map(e => [e.dataset.s, e.dataset.e])")
        expected = n if any(s is not None for s, _ in found) else len(solution)
        assert len({tuple(each) for each in found}) == expected, words
        marks.first.scroll_into_view_if_needed()
        marks.nth(2).hover(force=True)
        tip = tab.locator("#tip")
        if expected == n:
            assert (tip.text_content(timeout=2000) or words).startswith("star ")
        else:
            assert tip.text_content() == "exposure exp02, 2014-07-02 15:00", words
        box = tip.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 400
    wild = tab.evaluate("""() => { const names = JSON.parse(document.getElementById("names").textContent).s;
        const svg = [...document.querySelectorAll("figure svg")].find(e => e.textContent.includes("stars by bright"));
        const top = each => each.getBoundingClientRect().top;
        return names[[...svg.querySelectorAll(".marks [data-s]")].sort((a, b) => top(a) - top(b))[0].dataset.s]; }""")
    assert wild == str(solution.estimate.star_names[4])


def test_pointing_at_a_star_marks_it_everywhere(show, path):
    tab = show(path)
    dots = tab.locator('svg .marks [data-s="7"]:not([data-e])')
    assert dots.count() >= 4  # three panels and the brightness
    dots.last.hover()
    on = tab.evaluate("[...document.querySelectorAll('.on')].map(e => [e.tagName, e.dataset.s])")
    assert {star for _, star in on} == {"7"}
    assert {"use", "path", "TR"} <= {tag for tag, _ in on} | {"path"}
    assert tab.locator("#tip").text_content() == "star 7"
    tab.mouse.move(1, 1)
    assert tab.locator(".on").count() == 0


def test_pointing_at_an_exposure_marks_its_row_point_and_panel(show, path):
    tab = show(path)
    tab.locator("details.more > summary").click()
    tab.locator('tr[data-e="9"]').hover()
    assert tab.locator("#tip").text_content() == f"exposure {NAMES[9]}"
    on = tab.evaluate("[...document.querySelectorAll('.on')].map(e => e.getAttribute('class') + e.dataset.e)")
    assert all(each.endswith("9") for each in on)
    assert sum("panel" in each for each in on) == 2


def test_tables_are_sorted_and_filtered(show, path):
    tab = show(path)
    tab.locator("details.more > summary").click()
    table = tab.locator("table.figures").first
    head = table.locator("th", has_text="shift x")
    column = "rows => rows.map(row => parseFloat(row.cells[1].textContent))"
    for order in (1, -1):
        head.click()
        values = table.locator("tbody tr").evaluate_all(column)
        assert values == sorted(values, reverse=order < 0)
        assert head.get_attribute("aria-sort") == ("ascending" if order > 0 else "descending")
    tab.locator("input.filter").first.fill("frame 3")
    assert table.locator("tbody tr:visible").count() == 1


def test_paper_shows_what_is_folded(show, path):
    tab = show(path)
    shown = "getComputedStyle(document.querySelector('tr[data-e=\"0\"]')).display"
    tab.emulate_media(media="print")
    tab.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert tab.evaluate("document.querySelectorAll('details:not([open])').length") == 0
    assert tab.evaluate(shown) == "table-row"
    tab.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert tab.evaluate("document.querySelectorAll('details[open]').length") == 0


@pytest.mark.slow
def test_stars_of_a_run_blink_and_the_page_is_small(show, tmp_path):
    import legdistort as ld

    night = simulate_exposures(small=True)
    paths = night.write(tmp_path / "frames")
    ld.run(paths, out=tmp_path / "out", truth=night.truth)
    page = tmp_path / "out" / "report.html"
    assert page.stat().st_size < 4e6
    tab = show(page)
    assert "Against the truth" in tab.content()
    single = tab.locator(".cutout .single.shown").first
    for state in ("visible", "hidden", "visible"):
        single.wait_for(state=state)
    name = single.get_attribute("alt")
    tab.locator(".cutout").first.click()
    assert tab.locator(".cutout .single.shown").first.get_attribute("alt") != name
    tab.locator('a[href="stars.ecsv"]').wait_for()
    assert all((tmp_path / "out" / each.get_attribute("href")).exists() for each in tab.locator("p > a").all())
