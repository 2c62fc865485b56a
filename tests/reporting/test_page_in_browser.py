"""The report in a real browser: no errors, marks, sorting, filtering, blinking, paper, dark, narrow."""

import shutil

import pytest
from drawn_solutions import make_solution

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


def test_labels_of_pictures_are_large_enough_on_a_narrow_screen(show, path):
    tab = show(path, 400)
    sizes = tab.evaluate(
        "[...document.querySelectorAll('figure svg text')].map(e => e.getBoundingClientRect().height).filter(h => h)"
    )
    assert min(sizes) > 8


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
