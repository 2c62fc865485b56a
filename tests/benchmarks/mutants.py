"""Mutation testing of the numerical core: would the tests see it if a sign, an operator or a number were another?

    python tests/benchmarks/mutants.py
    python tests/benchmarks/mutants.py --again      (those that were not killed)

makes small changes in the modules of `MODULES`, one at a time and in a copy of the tree, and runs those tests on each
that are quick and near it. A mutant is *killed* if a test fails, *equivalent* if ``equivalent_mutants.csv`` gives the
reason why nothing can see it, and *survived* otherwise; ``mutants.csv`` beside this file is the table.

Which changes are made is drawn by a number (``--seed``), by the name of the function, the statement and the change
alone, so that what is edited elsewhere draws no other mutants. The changes: ``+`` and ``-``, ``*`` and ``/`` and other
operators exchanged, operands of ``@`` exchanged, comparisons and conditions reversed, a sign or a ``not`` left out, an
integer one larger, another number ten times as large, the last two arguments of a call exchanged, a statement left out.
Messages, representations and annotations are left alone.

One process imports the libraries and forks a child for every mutant. Before the mutants the same tests must pass on
the unchanged modules, loaded in the same way. Each child says what module it has loaded, by a word that is
written into the changed source; the command ends with an error if that is another.
"""

import argparse
import ast
import compileall
import copy
import csv
import hashlib
import importlib
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
TABLE, EQUIVALENT = HERE / "mutants.csv", HERE / "equivalent_mutants.csv"
COLUMNS = ("module", "id", "line", "function", "change", "result", "by")
#: Module -> its tests, the ones that fail soonest first.
MODULES = {
    "solving/equations/criterion.py": [
        "solving/normal_equations",
        "solving/estimation",
        "solving/star_motions",
        "solving/selfcalibration",
        "results/stated_errors",
    ],
    "solving/equations/elimination.py": [
        "solving/normal_equations",
        "solving/estimation",
        "solving/star_motions",
        "solving/compiled",
    ],
    "solving/equations/reduced_system.py": [
        "solving/normal_equations",
        "solving/estimation",
        "solving/selfcalibration",
        "results/stated_errors",
        "solving/compiled",
        "solving/star_motions",
    ],
    "solving/gauge/constraints.py": [
        "solving/hierarchy",
        "solving/estimation",
        "solving/selfcalibration",
        "geometry/similarity",
        "solving/model_forms",
        "solving/star_motions",
    ],
    "solving/gauge/hierarchy.py": [
        "solving/hierarchy",
        "solving/estimation",
        "solving/reference_tie",
        "solving/star_motions",
    ],
    "solving/gauge/catalogue_map.py": ["solving/reference_tie", "solving/hierarchy"],
    "solving/reference_tie.py": ["solving/reference_tie", "solving/star_motions"],
    "geometry/distortion.py": ["geometry/distortion", "wcs/fits_headers"],
    "coaddition/resampling/pixel_maps.py": ["coaddition/mosaicking", "coaddition/compiled_splines"],
    "coaddition/combination.py": ["coaddition/combination", "coaddition/mosaicking"],
    "priors/prior.py": ["priors/prior", "priors/from_headers", "priors/declared_size", "priors/from_files"],
    "priors/from_headers.py": ["priors/from_headers", "inputs/foreign_images", "priors/from_files"],
    "wcs/fits_headers.py": ["wcs/fits_headers"],
}
#: Tests that are not tried: of commands, files and pictures, and of many realisations.
_LEFT_OUT = [
    "command",
    "shell",
    "report",
    "picture",
    "files_keep",
    "a_file",
    "TestFile",
    "calibrated",
    "decides_by_evidence",
    "another_field",
]
#: What the tests need of other packages.
LIBRARIES = (
    "asdf", "astropy.coordinates", "astropy.io.fits", "astropy.modeling", "astropy.table", "astropy.wcs", "gwcs",
    "matplotlib", "numba", "photutils.detection", "pytest", "reproject", "scipy.optimize",
)  # fmt: skip
LIMIT = 3  # times the processor time of the unchanged module, and five seconds

_EXCHANGED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And, ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_SPOKEN = {"__repr__", "describe"}
_MESSAGES = {"log", "warn", "logging", "warnings"}


# --- the changes --------------------------------------------------------------------------------------------------


class Sites(ast.NodeVisitor):
    """All changes that can be made in a module: ``(statement, function, node, what, change)``."""

    def __init__(self):
        self.found, self.function, self.statement = [], "", None

    def add(self, node, what, change):
        self.found.append((self.statement, self.function, node, what, change))

    def visit(self, node):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            return self._scope(node)
        if isinstance(node, (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)) or _tells(node):
            return None
        if isinstance(node, ast.stmt):
            outer, self.statement = self.statement, node
            self._statement(node)
            self._fields(node)
            self.statement = outer
            return None
        self._expression(node)
        return self._fields(node)

    def _scope(self, node):
        if node.name in _SPOKEN:
            return
        outer, self.function = self.function, f"{self.function}.{node.name}".strip(".")
        if isinstance(node, ast.FunctionDef):
            self.statement = node
            for default in [*node.args.defaults, *filter(None, node.args.kw_defaults)]:
                self.visit(default)
        for each in node.body:
            self.visit(each)
        self.function = outer

    def _fields(self, node):
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "ctx", "decorator_list", "returns"):
                continue
            for each in value if isinstance(value, list) else [value]:
                if isinstance(each, ast.AST):
                    self.visit(each)

    def _statement(self, node):
        if isinstance(node, ast.AugAssign) and type(node.op) in _EXCHANGED:
            self.add(node, "operator", lambda n: _set(n, op=_EXCHANGED[type(n.op)]()))
        again = False
        if isinstance(node, ast.Assign):  # of a part, or of what has a value already
            used = {part.id for part in ast.walk(node.value) if isinstance(part, ast.Name)}
            parts = [part for target in node.targets for part in getattr(target, "elts", [target])]
            again = any(isinstance(part, ast.Subscript) or getattr(part, "id", None) in used for part in parts)
        call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        if self.function and (again or call or isinstance(node, (ast.AugAssign, ast.Break, ast.Continue))):
            self.add(node, "left out", lambda n: ast.Pass())

    def _expression(self, node):
        match node:
            case ast.BinOp(op=ast.MatMult()):
                self.add(node, "operands exchanged", lambda n: _set(n, left=n.right, right=n.left))
            case ast.BinOp() | ast.BoolOp() if type(node.op) in _EXCHANGED and not _is_text(node):
                self.add(node, "operator", lambda n: _set(n, op=_EXCHANGED[type(n.op)]()))
            case ast.Compare(ops=[op, *_]) if type(op) in _EXCHANGED:
                self.add(node, "reversed", lambda n: _set(n, ops=[_EXCHANGED[type(n.ops[0])](), *n.ops[1:]]))
            case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert()):
                self.add(node, "sign left out", lambda n: n.operand)
            case ast.Constant(value=bool(value)):
                self.add(node, "number", lambda n: ast.Constant(not value))
            case ast.Constant(value=int(value)):
                self.add(node, "number", lambda n: ast.Constant(value + 1))
            case ast.Constant(value=float(value)):
                self.add(node, "number", lambda n: ast.Constant(10 * value or 1.0))
            case ast.Call(args=[*_, ast.expr() as a, ast.expr() as b]) if ast.dump(a) != ast.dump(b):
                self.add(node, "arguments exchanged", lambda n: _set(n, args=[*n.args[:-2], n.args[-1], n.args[-2]]))
            case ast.IfExp():
                self.add(node, "reversed", lambda n: _set(n, body=n.orelse, orelse=n.body))


def _set(node, **fields):
    for name, value in fields.items():
        setattr(node, name, value)
    return node


def _tells(node):
    """Whether a statement or call only says something."""
    call = node.value if isinstance(node, ast.Expr) else node
    if isinstance(node, ast.Expr) and isinstance(call, ast.Constant):
        return True
    name = getattr(call, "func", None)
    while isinstance(name, ast.Attribute):
        name = name.value
    return isinstance(call, ast.Call) and isinstance(name, ast.Name) and name.id in _MESSAGES


def _is_text(node):
    parts = [getattr(node, "left", None), getattr(node, "right", None)]
    return any(isinstance(part, ast.JoinedStr) or isinstance(getattr(part, "value", None), str) for part in parts)


class _Replace(ast.NodeTransformer):
    def __init__(self, old, new):
        self.old, self.new = old, new

    def visit(self, node):
        return self.new if node is self.old else self.generic_visit(node)


def _shown(statement):
    """A statement in one line, without its block."""
    if hasattr(statement, "body"):
        statement = copy.copy(statement)
        statement.body, statement.orelse = [ast.Pass()], []
    return " ".join(ast.unparse(statement).removesuffix("pass").split())


def mutants(path, seed):
    """All mutants of a module in the order in which they are drawn, a statement not twice before all others once."""
    tree, sites = ast.parse(path.read_text()), Sites()
    sites.visit(tree)
    made, seen = [], Counter()
    for place, (statement, function, node, what, change) in enumerate(sites.found):
        before, new = _shown(statement), change(copy.copy(node))
        whole = isinstance(node, ast.stmt)
        shown = f"{what}: " + ("" if whole else f"{ast.unparse(node)} -> {ast.unparse(new)} in: ") + before
        key = f"{path.name} {function} {shown}"
        seen[key] += 1
        names = [hashlib.sha256(f"{text} {key} {seen[key]}".encode()).hexdigest() for text in ("", seed)]
        made.append({
            "module": path.name, "id": f"{path.stem}-{names[0][:8]}", "line": node.lineno, "function": function,
            "change": shown, "place": place, "order": names[1], "statement": id(statement),
        })  # fmt: skip
    made.sort(key=lambda mutant: mutant["order"])
    before = Counter()
    for mutant in made:
        mutant["round"] = before[mutant["statement"]]
        before[mutant["statement"]] += 1
    return sorted(made, key=lambda mutant: mutant["round"])


def mutated(path, place=None):
    """The source of a module with the change at this place among its `Sites`, or none."""
    tree, sites = ast.parse(path.read_text()), Sites()
    if place is None:
        return ast.unparse(tree)
    sites.visit(tree)
    node, change = sites.found[place][2], sites.found[place][4]
    return ast.unparse(ast.fix_missing_locations(_Replace(node, change(copy.copy(node))).visit(tree)))


def drawn(package, number, seed):
    """So many mutants, as evenly over the modules as they allow: ``{module: list}``."""
    everything = {name: mutants(package / name, seed) for name in MODULES}
    share, names = Counter(), list(MODULES)
    for k in range(number):
        name = names[k % len(names)]
        share[name] += share[name] < len(everything[name])
    return {name: some[: share[name]] for name, some in everything.items()}


# --- running ------------------------------------------------------------------------------------------------------


class Witness:
    """Plugin of pytest: what was loaded, and which test failed."""

    def __init__(self, module, file):
        self.module, self.file, self.told = module, file, {"loaded": None, "failed": None, "passed": 0}

    def _tell(self):
        loaded = sys.modules.get(self.module)
        self.told["loaded"] = getattr(loaded, "__mutant__", None)
        self.told["where"] = getattr(loaded, "__file__", None)
        self.file.write_text(json.dumps(self.told))

    def pytest_runtest_setup(self, item):
        self._tell()

    def pytest_collection_finish(self, session):
        self._tell()

    def pytest_collectreport(self, report):
        if report.failed:
            self.told["failed"] = f"collecting {report.nodeid}"

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.told["failed"] = report.nodeid
        self.told["passed"] += report.passed and report.when == "call"

    def pytest_sessionfinish(self):
        self._tell()


class Bench:
    """A copy of the tree, in which one module at a time is another.

    Parameters
    ----------
    folder : Path
        For the copy.
    words : str, optional
        Of the names of the tests that are tried.
    """

    def __init__(self, folder, words=None):
        self.words = f"({words}) and " * bool(words) + "not (" + " or ".join(_LEFT_OUT) + ")"
        self.tree = folder / "tree"
        left_out = shutil.ignore_patterns(".hypothesis", ".pytest_cache", ".benchmarks")
        for name in ("legdistort", "tests"):
            shutil.copytree(ROOT / name, self.tree / name, ignore=left_out)
        shutil.copy2(ROOT / "pyproject.toml", self.tree)
        compileall.compile_dir(self.tree, quiet=2)
        self.package = self.tree / "legdistort"
        self.told, self.output = folder / "told.json", folder / "output.txt"

    def run(self, name, source, mark, limit):
        """``(result, by, seconds)`` of the tests of a module with another source; `limit` s of the processor."""
        path = self.package / name
        original = path.read_text()
        self.told.unlink(missing_ok=True)
        shutil.rmtree(self.tree / ".hypothesis", ignore_errors=True)
        path.write_text(f"{source}\n__mutant__ = {mark!r}\n")
        for old in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            old.unlink()
        try:
            status, seconds = self._forked(name, limit)
        finally:
            path.write_text(original)
        told = json.loads(self.told.read_text()) if self.told.exists() else {}
        by = told.get("failed") or ""
        if status < 0 or status == 98:
            return "killed", f"time or signal {-status}", seconds
        if told.get("loaded") != mark and not by.startswith("collecting"):
            raise SystemExit(f"{name}: {mark} was not loaded: {told}\n{self.output.read_text()[-3000:]}")
        if told.get("where") not in (None, str(path)):
            raise SystemExit(f"{name}: loaded from {told['where']}")
        if status == 0 and not told["passed"]:
            raise SystemExit(f"{name}: no test ran")
        return ("survived", "", seconds) if status == 0 else ("killed", by or f"exit status {status}", seconds)

    def _forked(self, name, limit):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        child = os.fork()
        if child == 0:
            status = 97
            try:
                status = self._test(name, limit)
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(status)
        end = time.monotonic() + 20 * limit + 60
        while True:  # what waits for ever takes no time of the processor
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                break
            if time.monotonic() > end:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.02)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return os.waitstatus_to_exitcode(status), used

    def _test(self, name, limit):
        import pytest

        resource.setrlimit(resource.RLIMIT_CPU, (int(limit) + 1, int(limit) + 2))
        out = os.open(self.output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(out, 1)
        os.dup2(out, 2)
        os.chdir(self.tree)
        sys.path[:0] = [str(self.tree), str(self.tree / "tests")]
        sys.dont_write_bytecode = True
        witness = Witness("legdistort." + name.removesuffix(".py").replace("/", "."), self.told)
        tests = ["tests/{}/test_{}.py".format(*each.split("/")) for each in MODULES[name]]
        options = ["-x", "-q", "-k", self.words, "-p", "no:cacheprovider", "-p", "no:xdist", "--hypothesis-seed=0"]
        return int(pytest.main([*options, *tests], plugins=[witness]))


def warm():
    """Import what all tests need of other packages, once, and nothing of ours."""
    sys.modules["legdistort"] = None  # astropy would load what we offer it
    with warnings.catch_warnings(action="ignore"):
        for name in LIBRARIES:
            importlib.import_module(name)
    del sys.modules["legdistort"]
    assert not [name for name in sys.modules if name.partition(".")[0] == "legdistort"]


def main(given):
    """Run the mutants; the rows of the table."""
    os.environ.update(PYTHONPATH="", OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
    os.environ.update(MPLBACKEND="Agg")
    os.environ.pop("LEGDISTORT_DATA", None)
    sys.path[:] = [each for each in sys.path if Path(each or ".").resolve() not in (ROOT, HERE, HERE.parent)]
    warm()
    with tempfile.TemporaryDirectory() as folder:
        bench, rows = Bench(Path(folder).resolve(), given.words), []
        for name, some in chosen(given, bench.package).items():
            result, by, seconds = bench.run(name, mutated(bench.package / name), f"control {name}", 600)
            if result != "survived":
                raise SystemExit(f"{name}: unchanged, {by} fails\n{bench.output.read_text()[-3000:]}")
            print(f"control {name}: {seconds:.1f} s", flush=True)
            for mutant in some:
                source = mutated(bench.package / name, mutant["place"])
                result, by, took = bench.run(name, source, mutant["id"], LIMIT * seconds + 5)
                rows += judged([{**mutant, "result": result, "by": by}])
                result, by = rows[-1]["result"], rows[-1]["by"]
                where = f"{mutant['id']} line {mutant['line']}, {mutant['function']}"
                print(f"{result:10s} {where}: {mutant['change']} [{by}] {took:.1f} s", flush=True)
    return rows


def chosen(given, package):
    """The mutants that are asked for, by module; with ``--again`` those that the table lacks, or has as survived."""
    drawn_ones = drawn(package, given.mutants, given.seed)
    if given.again:
        done = {row["id"] for row in judged(read_table()) if row["result"] != "survived"}
        drawn_ones = {name: [m for m in some if m["id"] not in done] for name, some in drawn_ones.items()}
    wanted = given.only or [Path(name).stem for name in MODULES]
    return {name: some for name, some in drawn_ones.items() if some and Path(name).stem in wanted}


def judged(rows):
    """The same rows, those that survived and have a reason as equivalent."""
    with EQUIVALENT.open(newline="") as file:
        reasons = {row["id"]: row["reason"] for row in csv.DictReader(file)}
    return [
        row | {"result": "equivalent", "by": reasons[row["id"]]}
        if row["result"] == "survived" and row["id"] in reasons
        else row
        for row in rows
    ]


def read_table():
    """The rows of the table."""
    with TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


def write_table(rows):
    """Write the table."""
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutants", type=int, default=208)
    parser.add_argument("--seed", type=int, default=2017)
    parser.add_argument("--only", nargs="+", help="modules, such as criterion")
    parser.add_argument("--again", action="store_true", help="those that the table has not, or as survived")
    parser.add_argument("--words", help="of the names of the tests that are tried, as of pytest -k")
    parser.add_argument("--list", action="store_true", help="show the mutants, run nothing")
    given = parser.parse_args()
    if given.list:
        for name, some in chosen(given, ROOT / "legdistort").items():
            for mutant in some:
                print(f"{name}: {mutant['id']} line {mutant['line']}, {mutant['function']}: {mutant['change']}")
        sys.exit()
    begin = time.perf_counter()
    table = main(given)
    if given.again:
        known = {row["id"]: row for row in judged([*read_table(), *table])}
        everything = drawn(ROOT / "legdistort", given.mutants, given.seed).values()
        drawn_ones = [mutant for some in everything for mutant in some if mutant["id"] in known]
        table = [known[mutant["id"]] | {"line": mutant["line"]} for mutant in drawn_ones]
    print(f"{'module':24s} mutants  killed  survived  equivalent   in {time.perf_counter() - begin:.0f} s")
    for module in [*dict.fromkeys(row["module"] for row in table), "all"]:
        found = Counter(row["result"] for row in table if module in (row["module"], "all"))
        print(f"{module:24s} {found.total():7d} {found['killed']:7d} {found['survived']:9d} {found['equivalent']:11d}")
    if given.again or not given.only:
        write_table(table)
    sys.exit(any(row["result"] == "survived" for row in table))
