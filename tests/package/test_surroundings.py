"""Wherever it runs: any locale, no home, nothing that may be written but the output, another user, other processes."""

import json
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import legdistort as ld
from legdistort.cli import main
from legdistort.runtime.outputs import replacing_folder
from legdistort.runtime.provenance import checksum
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve

ROOT = Path(ld.__file__).parents[1]
NOBODY = 65534
PIXELS = np.array([[10.0, 20.0], [50.0, 60.0]])


@pytest.fixture(scope="module")
def matches():
    return simulate_matches(n_stars=12, n_exposures=4, degree=1, shape=(100, 100), dither=5.0, seed=1).matches


@pytest.fixture(scope="module")
def solution(matches):
    return solve(matches, degree=1)


@pytest.fixture
def table(matches, tmp_path):
    path = tmp_path / "matched.ecsv"
    matches.table.write(path)
    return path


def command(table, out, *more):
    return [sys.executable, "-m", "legdistort", "solve", str(table), "--shape", "100", "100", "--degree", "1",
            "--out", str(out), "--quiet", *more]  # fmt: skip


def whole(out):
    """Whether the files of a folder are those that its summary lists."""
    listed = json.loads((out / "summary.json").read_text())["files"]
    for name, digest in listed.items():
        with (out / name).open("rb") as file:
            assert checksum(file) == digest
    return {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()} == {*listed, "summary.json"}


@pytest.mark.parametrize(
    ("locale", "name"),
    [
        pytest.param("C", "with spaces, ünï ☆ 解", marks=pytest.mark.slow),
        pytest.param("POSIX", "with spaces", marks=pytest.mark.sets),
        pytest.param("C.UTF-8", "plain", marks=pytest.mark.sets),
    ],
)
def test_locale_c_without_a_home(table, tmp_path, locale, name):
    """Neither a home nor a place for compiled code or byte code is known."""
    bare = {"LC_ALL": locale, "PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "1", "NUMBA_CACHE_DIR": "/dev/null/none"}  # fmt: skip
    run = subprocess.run(command(table, tmp_path / name), env=bare, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert whole(tmp_path / name)


@pytest.fixture
def read_only(tmp_path):
    """A copy of the package that nobody may write, without byte code and compiled loops."""
    folder = tmp_path / "site-packages"
    shutil.copytree(ROOT / "legdistort", folder / "legdistort", ignore=shutil.ignore_patterns("__pycache__"))
    items = [folder, *folder.rglob("*")]
    for item in items:
        item.chmod(item.stat().st_mode & 0o555)
    yield folder
    for item in items:
        item.chmod(item.stat().st_mode | 0o200)


def unprivileged():
    """Begin of a command that may write only what its user may: root gives up all that makes it more than a user."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("root may write anywhere, and there is no setpriv")
    return ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]


WITHOUT_WRITING = """
import sys
from pathlib import Path
import legdistort
from legdistort.cli import main
from legdistort.solving.equations import problem

package = Path(legdistort.__file__).parent
try:
    (package / "new").touch()
except OSError:
    problem.COMPILED_FROM = int(sys.argv[1])
    status = main(sys.argv[2:])
    compiled = "legdistort.solving.equations.compiled" in sys.modules
    sys.exit(status or compiled is not (problem.COMPILED_FROM == 1))
sys.exit(f"{package} can be written")
"""


@pytest.mark.parametrize(
    "compiled_from", [pytest.param(10**9, marks=pytest.mark.sets), pytest.param(1, marks=pytest.mark.slow)]
)
def test_a_package_that_cannot_be_written(table, tmp_path, read_only, compiled_from):
    """Nor is there a home: compiled loops are made without a place to keep them."""
    bare = {
        "PATH": os.environ["PATH"],
        "PYTHONPATH": str(read_only),
        "OPENBLAS_NUM_THREADS": "1",
        "HOME": "/dev/null/none",
    }
    arguments = [str(compiled_from), *command(table, tmp_path / "out")[3:]]
    run = subprocess.run(
        [*unprivileged(), sys.executable, "-c", WITHOUT_WRITING, *arguments],
        cwd=tmp_path, env=bare, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    assert whole(tmp_path / "out")
    assert not list(read_only.rglob("__pycache__"))


@pytest.fixture
def place():
    """A folder that another user can see, to be written by root alone."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


def as_nobody(function):
    """What a function returns, or the error it raises, as a sentence, when a user without rights calls it.

    Root may write anywhere, so that tests as root would prove nothing.
    """
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("only root can become somebody else")
    reading, writing = os.pipe()
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):  # threads of other tests sleep
        child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
            told = str(function())
        except BaseException as error:
            told = f"{type(error).__name__}: {error}"
        os.write(writing, told.encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(writing)
    with os.fdopen(reading) as file:
        return file.read()


def write(out):
    with replacing_folder(out) as target:
        (target / "a").write_text("new")
    return "written"


@pytest.mark.parametrize("existing", [True, False])
def test_a_folder_that_another_user_cannot_write(place, existing):
    out = place / "out"
    if existing:
        out.mkdir()
    told = as_nobody(lambda: write(out))
    assert told.startswith("InputError"), told
    assert "out cannot be written: no permission in" in told
    assert list(place.rglob("*")) == ([out] if existing else [])
    if existing:
        out.chmod(0o777)
        assert as_nobody(lambda: write(out)) == "written"


def test_readers_need_no_permission_to_write(place, solution):
    if as_nobody(lambda: os.access(Path(ld.__file__).parent / "data" / "schemas", os.R_OK)) != "True":
        pytest.skip("the package lies where other users may not read it")
    solution.write(place / "solution.asdf")
    (place / "solution.asdf").chmod(0o644)
    ld.Solution.read(place)  # which loads what it needs
    assert as_nobody(lambda: ld.Solution.read(place).chi2) == str(solution.chi2)
    assert [path.name for path in place.iterdir()] == ["solution.asdf"]


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_results_that_were_set_aside_are_brought_back_by_the_next_run(table, tmp_path, capsys):
    """Where a process was killed between two renames; they are replaced only if that is asked for."""
    out, words = tmp_path / "out", command(table, tmp_path / "out")[3:]
    assert main(words) == 0
    before = (out / "summary.json").read_text()
    out.rename(tmp_path / f"out.old-{'0' * 32}")
    capsys.readouterr()
    assert main(["show", str(out)]) == 1
    assert f"this brings it back: mv {tmp_path}/out.old-{'0' * 32} {out}" in capsys.readouterr().err
    assert main(words) == 1
    assert "out already holds solution.asdf" in capsys.readouterr().err
    assert (out / "summary.json").read_text() == before
    assert whole(out)
    assert main([*words, "--overwrite"]) == 0
    assert (out / "summary.json").read_text() != before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["matched.ecsv", "out"]


@pytest.mark.usefixtures("undrawn")
def test_files_of_the_user_in_a_folder_of_results(table, tmp_path, capsys):
    out, words = tmp_path / "out", [*command(table, tmp_path / "out")[3:], "--overwrite"]
    assert main(words) == 0
    (out / "notes.txt").write_text("mine")
    (out / "wcs" / "mine.txt").write_text("mine")
    capsys.readouterr()
    assert main(words) == 1
    assert capsys.readouterr().err.strip() == (
        f"legdistort: {out} holds what is not of an earlier run, notes.txt, wcs/mine.txt: move it away, give another "
        "folder, or --keep to keep it there"
    )
    assert main([*words, "--keep"]) == 0
    assert (out / "notes.txt").read_text() == (out / "wcs" / "mine.txt").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["matched.ecsv", "out"]


@pytest.mark.slow
def test_two_commands_at_once(table, tmp_path):
    """One works; the other is told, or finds the results of the first. Neither has a part of the other's."""
    out, environment = tmp_path / "out", os.environ | {"PYTHONPATH": str(ROOT)}
    processes = [
        subprocess.Popen(command(table, out), stderr=subprocess.PIPE, text=True, env=environment) for _ in range(2)
    ]
    errors = [process.communicate()[1] for process in processes]
    statuses = sorted(process.returncode for process in processes)
    assert statuses == [0, 1], errors
    assert sum("another process is writing" in e or "already holds" in e for e in errors) == 1
    assert whole(out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["matched.ecsv", "out"]


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")  # of threads of other tests, which sleep
def test_a_solution_in_another_process(solution, method):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {method} here")
    name = solution.names[1]
    with ProcessPoolExecutor(1, multiprocessing.get_context(method)) as pool:
        corrected = pool.submit(solution[name].correct, PIXELS).result()
        again = pool.submit(pickle.loads, pickle.dumps(solution)).result()
    np.testing.assert_array_equal(corrected, solution[name].correct(PIXELS))
    np.testing.assert_array_equal(again[name].wcs(*PIXELS.T), solution[name].wcs(*PIXELS.T))
    assert str(again) == str(solution)


@pytest.mark.slow
def test_a_solution_on_a_cluster(solution):
    distributed = pytest.importorskip("distributed")
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0", protocol="tcp"
    )
    with cluster, distributed.Client(cluster) as client:
        corrected = client.submit(solution[solution.names[0]].correct, PIXELS).result(timeout=60)
    np.testing.assert_array_equal(corrected, solution[solution.names[0]].correct(PIXELS))
