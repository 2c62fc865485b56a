"""The README and the documentation say what is so: their Python runs, their commands are the ones checked."""

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from filelock import FileLock

import legdistort
from legdistort.cli import parser

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.md"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs").glob("paper/*.md"))]
PAGES += NOTEBOOKS


#: Those that install and run everything.
COMMANDS = ["pip install . && legdistort demo --out demo", "pip install '.[test]' && pytest -n 2 --dist loadscope"]


def blocks(page, language):
    """Fenced code blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


#: A fenced block of code: why it cannot run here, if it cannot, its language and its text. Cells of notebooks are such
#: blocks, but for those that only choose the picture of the gallery.
BLOCK = re.compile(
    r"^(?:<!-- not run: ([^\n]*) -->\n)?```(sh|python|\{code-cell\} ipython3)\n(?!:tags: \[remove-cell\])(.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


def reading_order():
    """The README, and the pages in the order of its links; a page whose code needs that of another comes after it.
    Notebooks come last.
    """
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    linked = dict.fromkeys(re.findall(r"\]\((docs/[\w/]+\.md)\)", readme))
    tutorial = "docs/first_mosaic.md"
    return [ROOT / "README.md", ROOT / tutorial, *(ROOT / page for page in linked if page != tutorial), *NOTEBOOKS]


def test_the_readme_leads_to_every_page_with_code():
    runs = {page for page in PAGES if not all(why for why, _, _ in BLOCK.findall(page.read_text(encoding="utf-8")))}
    assert runs <= set(reading_order())


def test_few_blocks_cannot_run_here():
    reasons = [why for page in PAGES for why, _, _ in BLOCK.findall(page.read_text(encoding="utf-8")) if why]
    assert len(reasons) <= 16
    assert all(len(reason.split()) >= 3 for reason in reasons)


#: The page that makes a folder for others, which state how; all else that a page uses it makes itself.
LEAVING = {ROOT / "docs" / "first_mosaic.md": "tutorial"}


def running(page):
    """Language and text of the blocks of a page that run."""
    found = [(language, code) for why, language, code in BLOCK.findall(page.read_text(encoding="utf-8")) if not why]
    return [("python", in_python(code)) if "code-cell" in language else (language, code) for language, code in found]


def in_python(cell):
    """A cell without its options, in which ``!legdistort ...`` calls what `SESSION` has."""
    return re.sub(r"^!(legdistort .*)$", lambda line: f"_run({line[1]!r})", re.sub(r"\A(:.*\n)+", "", cell), flags=re.M)


def test_the_gallery_shows_every_notebook():
    gallery = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) >= 6
    for page in NOTEBOOKS:
        text = page.read_text(encoding="utf-8")
        (title,) = re.findall("^# (.*)$", text, re.MULTILINE)
        assert f"{{glue}}`notebooks/{page.name}::picture`" in gallery
        assert f"[{title}](notebooks/{page.name})" in gallery
        assert f"\nnotebooks/{page.stem}\n" in gallery
        assert '"name": "picture"' in text
        assert f"<{page.stem}.ipynb>" in text


def test_cells_run_as_in_a_notebook():
    assert (
        in_python(":tags: [hide-output]\n\n!legdistort demo --out a\nx = 1\n")
        == "\n_run('legdistort demo --out a')\nx = 1\n"
    )
    assert any("_run('legdistort demo" in code for page in NOTEBOOKS for _, code in running(page))
    assert not any("scrapbook" in code for page in NOTEBOOKS for _, code in running(page))


def needed(page):
    """Those of `LEAVING` whose results a page uses."""
    text = "".join(code for _, code in running(page))
    return [other for other, name in LEAVING.items() if other != page and re.search(rf"\b{name}\b", text)]


def test_a_page_comes_after_those_that_it_needs():
    order = reading_order()
    assert all(order.index(other) < order.index(page) for page in order for other in needed(page))
    assert sum(bool(needed(page)) for page in order) > 8


def test_a_page_states_how_the_folders_that_it_needs_are_made():
    for page in reading_order():
        prose = " ".join(BLOCK.sub("", page.read_text(encoding="utf-8")).split())
        for other in needed(page):
            shell = "".join(blocks(other, "sh"))
            (make,) = re.findall(rf"^legdistort demo .*--out {LEAVING[other]}$", shell, re.MULTILINE)
            assert f"`{make}`" in prose, f"{page.name}: {make}"


#: A line of a shell block that is one command of the package: it needs no process of its own, which imports anew.
PLAIN = re.compile(r"legdistort [^|&;<>$`\\\n]*")

#: Before the blocks of a page: what runs a line like that, its words as bash reads them.
SESSION = """
import subprocess
from legdistort.cli import main

def run(line):
    words = subprocess.check_output(["bash", "-euc", "printf '%s\\\\0' " + line], text=True).split("\\0")
    assert main(words[1:-1]) == 0, line

names = {"_run": run}
"""


def run_page(page, place):
    """Run what is on a page, in a folder; the Python of a page is one session, which runs plain commands too."""
    lines = [SESSION]
    for language, code in running(page):
        if language == "python":
            lines.append(f"exec(compile({code!r}, {page.name!r}, 'exec'), names)")
        elif all(PLAIN.fullmatch(line) for line in code.splitlines()):
            lines += [f"run({line!r})" for line in code.splitlines()]
        else:
            lines.append(f"subprocess.run(['bash', '-euc', {code!r}], check=True)")
    script = place.with_name(f"{place.name}.script") / "page.py"  # beside nothing that could be imported
    script.parent.mkdir(exist_ok=True)
    script.write_text("\n".join(lines), encoding="utf-8")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "MPLBACKEND": "Agg"}
    run = subprocess.run(
        [sys.executable, script], cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr[-1500:]


def results(page, done):
    """Folder in which a page has been run, with the folders of `LEAVING` that it needs: once for all tests."""
    place = done / page.stem
    with FileLock(done / f"{page.stem}.lock"):
        if not (done / f"{page.stem}.json").exists():
            shutil.rmtree(place, ignore_errors=True)  # of a run that failed
            place.mkdir()
            for other in needed(page):
                shutil.copytree(results(other, done) / LEAVING[other], place / LEAVING[other])
            before = set(os.listdir(place))
            run_page(page, place)
            new = sorted(set(os.listdir(place)) - before)
            (done / f"{page.stem}.json").write_text(json.dumps(new), encoding="utf-8")
    return place


#: Pages whose commands other pages or tests have, with other options; and the longest, whose nights tests have.
LIKE_OTHERS = {"catalogue", "command_line", "imager_frames", "many_nights", "swarp_headers"}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.sets if page.stem in LIKE_OTHERS else pytest.mark.slow, id=page.stem)
        for page in reading_order()
        if running(page)
    ],
)
def test_every_block_of_every_page_runs_as_printed(page, common_folder):
    """In a folder with nothing but what the page names, as someone would who opens this page first."""
    done = common_folder / "pages"
    done.mkdir(exist_ok=True)
    results(page, done)
    made = [name for file in done.glob("*.json") for name in json.loads(file.read_text(encoding="utf-8"))]
    assert len(made) == len(set(made)), f"made by two pages: {sorted(n for n in set(made) if made.count(n) > 1)}"


def test_readme_example_is_six_lines():
    (example,) = blocks(ROOT / "README.md", "python")
    assert len([line for line in example.splitlines() if line]) == 6


def commands():
    """Every ``legdistort`` command of the README and the documentation, as (page, arguments)."""
    for page in PAGES:
        for block in blocks(page, "sh"):
            for line in block.splitlines():
                for part in line.split("#")[0].split("&&"):
                    words = shlex.split(part)
                    if words and words[0] == "legdistort":
                        yield pytest.param(words[1:], id=f"{page.stem}:{words[1]}")


@pytest.mark.parametrize("arguments", list(commands()))
def test_commands_are_understood(arguments):
    assert parser._parser().parse_args(arguments).command == arguments[0]


def test_every_command_is_documented():
    headings = re.findall(r"^## (\S+)$", (ROOT / "docs" / "command_line.md").read_text(encoding="utf-8"), re.MULTILINE)
    (commands_,) = (a.choices for a in parser._parser()._actions if a.choices and "run" in a.choices)
    assert sorted(headings) == sorted(commands_)


@pytest.mark.parametrize("command", COMMANDS)
def test_readme_has_each_of_the_two_commands_once(command):
    assert sum(line == command for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()) == 1


def test_the_check_script_takes_its_commands_from_the_readme():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    endings = re.findall(r"\$\(readme_command '(.*?)'\)", script)
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert sorted(endings) == sorted(command[command.index("&&") :] for command in COMMANDS)
    for ending in endings:
        assert sum(line.startswith("pip install ") and line.endswith(ending) for line in lines) == 1
    assert script.count('bash -c "$') == 2


def test_the_workflow_only_calls_the_check_script():
    (job,) = yaml.safe_load((ROOT / ".github" / "workflows" / "check.yml").read_text(encoding="utf-8"))["jobs"].values()
    (command,) = (step["run"] for step in job["steps"] if "run" in step)
    assert command == ".ci/run ${{ matrix.what }}"
    known = (
        re.search(r"case \$what in (.*?)\)", (ROOT / ".ci" / "run").read_text(encoding="utf-8")).group(1).split(" | ")
    )
    assert {each["what"] for each in job["strategy"]["matrix"]["include"]} == set(known) - {"all"}


def test_every_minimum_can_be_pinned():
    """``.ci/run oldest`` takes the minima from here; what it does not understand it would leave at the newest."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for requirement in sum(project["optional-dependencies"].values(), project["dependencies"]):
        assert re.fullmatch(r"[\w-]+>=[\d.]+|legdistort\[[\w,]+\]", requirement)


def test_versions_agree():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGES.md").read_text(encoding="utf-8"), re.MULTILINE).group(1)
    assert newest == version == legdistort.__version__


def test_every_public_name_is_in_the_reference():
    reference = (ROOT / "docs" / "api.rst").read_text(encoding="utf-8")
    listed = set(re.findall(r"^   ~legdistort\.(\w+)$", reference, re.MULTILINE))  # each on a page of its own
    assert set(legdistort.__all__) == listed


def test_links_and_pictures_exist():
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_pictures_are_small():
    for picture in (ROOT / "docs" / "images").rglob("*.*"):
        assert picture.suffix == ".png"
        assert picture.stat().st_size < 200_000


@pytest.mark.slow
def test_messages_on_the_page_of_messages_are_printed():
    """Each heading is part of a text in the code, between what is put into it."""
    texts = []
    for path in (ROOT / "legdistort").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    headings = re.findall(
        r"^## (.*)$", (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    quoted = [part for heading in headings for part in re.findall("`(.*?)`", heading)]
    assert len(quoted) >= len(headings) > 10
    assert [part for part in quoted if not any(part in text for text in texts)] == []
