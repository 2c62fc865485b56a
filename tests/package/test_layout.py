"""The layout: who may import whom, how large things may become, and what no module does."""

import ast
import io
import subprocess
import sys
import tokenize
from functools import cache
from pathlib import Path

import pytest

import legdistort

ROOT = Path(__file__).parents[2]
PACKAGE = Path(legdistort.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))
#: Limits: places at the top, modules in a folder, lines of code in a module, lines in a body, parameters.
PLACES, FOLDER, MODULE, BODY, PARAMETERS = 24, 14, 400, 60, 12
#: What reads as a list of steps stays one that can be seen at once.
VERBS = {"solve": 40, "run": 40, "coadd": 40, "predict": 40}

each_module = pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))


@cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes(path):
    """All nodes of a module: walked through once."""
    return list(ast.walk(parsed(path)))


def docstring(node):
    """The statement that is the docstring of a module, class or function, or None."""
    return node.body[0] if ast.get_docstring(node, clean=False) is not None else None


def code_lines(path):
    """Number of lines with code on them: neither docstrings nor comments nor blanks."""
    lines = set()
    blank = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type not in blank:
            lines |= set(range(token.start[0], token.end[0] + 1))
    for node in nodes(path):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and (text := docstring(node)):
            lines -= set(range(text.lineno, text.end_lineno + 1))
    return len(lines)


def functions(path):
    return [node for node in nodes(path) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]


def body_lines(function):
    """From the first statement after the docstring to the end."""
    first = function.body[1 if docstring(function) and len(function.body) > 1 else 0]
    return function.end_lineno - first.lineno + 1


def test_imports_keep_the_contracts():
    """Strictly downward through the layers, lazy imports included, no circle; see ``tool.importlinter``."""
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


def test_the_top_shows_the_plan():
    places = [p for p in PACKAGE.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()]
    assert len(places) <= PLACES, sorted(p.name for p in places)


@pytest.mark.parametrize("folder", sorted({p.parent for p in MODULES} - {PACKAGE}), ids=lambda p: p.name)
def test_a_folder_can_be_taken_in(folder):
    assert (folder / "__init__.py").exists()
    assert len([p for p in folder.glob("*.py") if p.name != "__init__.py"]) <= FOLDER


@each_module
def test_sizes(path):
    n_lines = len(path.read_text(encoding="utf-8").splitlines())
    assert n_lines <= MODULE or code_lines(path) <= MODULE  # no more lines with code than lines
    for function in functions(path):
        limit = VERBS.get(function.name, BODY)
        assert body_lines(function) <= limit, f"{function.name}: {body_lines(function)} lines, at most {limit}"
        if function.name not in legdistort.__all__:
            arguments = function.args
            n = len(arguments.posonlyargs) + len(arguments.args) + len(arguments.kwonlyargs)
            assert n <= PARAMETERS, f"{function.name}: {n} parameters, at most {PARAMETERS}"


@each_module
def test_a_module_keeps_to_itself(path):
    """No private name of another module, no name of the package spelled in full."""
    modules = set()
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom) and node.level:
            private = [a.name for a in node.names if a.name.startswith("_") and not a.name.startswith("__")]
            assert not private, f"line {node.lineno} imports {private}"
            modules |= {a.asname or a.name for a in node.names if a.name.islower()}
        elif isinstance(node, ast.ImportFrom):
            assert (node.module or "").split(".")[0] != "legdistort", f"line {node.lineno}: use a relative import"
    for node in nodes(path):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            assert not node.attr.startswith("_"), f"line {node.lineno} uses {node.value.id}.{node.attr}"


@each_module
def test_nothing_is_done_behind_the_back(path):
    """No look at a caller's frame, no writing past a frozen object, no identity of an object as a key."""
    for node in nodes(path):
        if isinstance(node, ast.Attribute):
            assert node.attr not in ("_getframe", "__dict__"), f"line {node.lineno}: {node.attr}"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in ("id", "locals"), f"line {node.lineno}: {node.func.id}()"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "__setattr__":
            assert in_construction(path, node), f"line {node.lineno}: a frozen object is changed after its construction"


def in_construction(path, node):
    return any(
        f.name in ("__init__", "__post_init__") and f.lineno <= node.lineno <= f.end_lineno for f in functions(path)
    )


@each_module
def test_one_name_for_the_log_and_for_warnings(path):
    logs = "getLogger" in path.read_text(encoding="utf-8") and path.name != "parallel.py"
    for node in nodes(path):
        if logs and isinstance(node, ast.Assign) and "getLogger" in ast.unparse(node.value):
            assert ast.unparse(node.targets[0]) == "log", f"line {node.lineno}"
        if isinstance(node, ast.Attribute) and node.attr == "warn" and ast.unparse(node) == "warnings.warn":
            assert path.name == "exceptions.py", f"line {node.lineno}: use legdistort.exceptions.warn"


@each_module
def test_modules_have_a_purpose_and_never_print(path):
    assert ast.get_docstring(parsed(path))
    if path.parent.name != "cli" and path.stem != "demo":
        calls = [n for n in nodes(path) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
        assert not [n.lineno for n in calls if n.func.id == "print"]
