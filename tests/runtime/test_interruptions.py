"""Whatever happens to a process that writes: a folder of results is the old one or the new one, and has one writer."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from errno import EACCES, EDQUOT, EFBIG, EIO, ENOSPC
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import legdistort as ld
from legdistort.exceptions import DiskFullError, InputError
from legdistort.inputs.table_files import write_stars
from legdistort.reporting.page import write_report
from legdistort.runtime import disk_errors, locks, outputs
from legdistort.runtime.outputs import replacing, replacing_folder, settle

HERE = Path(__file__).parents[1]
FORMER = ("a", "b", "wcs/*.asdf", "summary.json")


def content(folder):
    """Names and texts, the hidden included."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def fill(folder, text, *names):
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)


def write(out, text, *names):
    with replacing_folder(out, former=FORMER) as target:
        fill(target, text, *names)


class Stopped(BaseException):
    """What ends a process."""


@pytest.fixture
def stop_after(monkeypatch):
    """After so many renames the process ends, as far as a test can have it: it does nothing any more."""

    def arm(n_renames):
        usual, done = os.replace, []

        def replace(*paths):
            if len(done) == n_renames:
                raise Stopped
            done.append(paths)
            return usual(*paths)

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", replace)
            patch.setattr(locks, "remove", lambda folder: None)
            yield

    return contextmanager(arm)


@pytest.fixture
def out(tmp_path):
    """A folder of an earlier call with something of somebody else's."""
    write(tmp_path / "out", "old", "a", "b", "wcs/1.asdf", "wcs/2.asdf")
    fill(tmp_path / "out", "mine", "notes", "wcs/mine.txt")
    return tmp_path / "out"


OLD = {"a": "old", "b": "old", "wcs/1.asdf": "old", "wcs/2.asdf": "old", "notes": "mine", "wcs/mine.txt": "mine"}
NEW = {"a": "new", "wcs/1.asdf": "new", "wcs/3.asdf": "new", "notes": "mine", "wcs/mine.txt": "mine"}
NEW_NAMES = ("a", "wcs/1.asdf", "wcs/3.asdf")


def test_a_call_replaces_what_is_ours_and_nothing_else(out, tmp_path):
    assert content(out) == OLD
    write(out, "new", *NEW_NAMES)
    assert content(out) == NEW
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("n_renames", [0, 1, 2])
def test_a_commit_is_finished_by_whoever_comes_next(out, stop_after, n_renames):
    with stop_after(n_renames), pytest.raises(Stopped):
        write(out, "new", *NEW_NAMES)
    assert any(path.name.startswith(".commit-") for path in out.iterdir())
    settle(out)
    assert content(out) == NEW
    settle(out)
    assert content(out) == NEW


def test_a_writer_finishes_the_commit_of_another_before_its_own(out, stop_after):
    with stop_after(1), pytest.raises(Stopped):
        write(out, "new", *NEW_NAMES)
    with replacing(out / "b", overwrite=True) as file:
        file.write(b"newest")
    assert content(out) == NEW | {"b": "newest"}


def test_what_is_incomplete_is_dropped_and_what_is_not_ours_stays(out, tmp_path):
    dead, foreign = out / f".partial-{'0' * 32}", out / ".partial-of-somebody"
    for folder in (dead, foreign):
        folder.mkdir()
        fill(folder, "half", *(("a", locks.LOCK) if folder == dead else ("a",)))
    settle(out)
    assert content(out) == OLD | {".partial-of-somebody/a": "half"}


def test_what_is_left_of_a_finished_commit_goes(out):
    """Its files and its plan are gone: it is empty but for the file of its lock, or wholly."""
    for k, name in enumerate(["of-somebody", "0" * 32, "1" * 32]):
        (out / f".commit-{name}").mkdir()
        if k == 1:
            (out / f".commit-{name}" / locks.LOCK).touch()
    settle(out)
    assert content(out) == OLD
    assert [path.name for path in out.glob(".commit-*")] == [".commit-of-somebody"]


def test_what_is_being_written_is_left_alone(out):
    with replacing_folder(out) as target:
        fill(target, "new", "a")
        settle(out)
        assert (target / "a").read_text() == "new"
        assert content(out) | OLD == content(out)
    with replacing(out / "c") as file:
        settle(out)
        file.write(b"new")
    assert content(out) == OLD | {"a": "new", "c": "new"}


def test_a_summary_says_which_files_are_ours(out):
    (out / "summary.json").write_text(json.dumps({"files": {"b": "", "../precious": "", "notes": ""}}))
    fill(out.parent, "mine", "precious")
    write(out, "new", "a")
    assert {"wcs/1.asdf", "wcs/2.asdf", "notes"} <= content(out).keys()
    assert not {"b", "summary.json"} & content(out).keys()
    assert (out.parent / "precious").exists()


def test_a_place_on_another_disk_is_refused_before_the_commit(out, tmp_path, monkeypatch):
    """Once it is decided there is no way back: a rename to another disk would fail (EXDEV)."""
    elsewhere = Path("/dev/shm")
    if not elsewhere.is_dir() or elsewhere.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("there is one disk only")
    other = Path(tempfile.mkdtemp(dir=elsewhere))
    try:
        shutil.rmtree(out / "wcs")
        (out / "wcs").symlink_to(other)
        with pytest.raises(InputError, match=r"wcs is on another disk or cannot be written: move it away"):
            write(out, "new", *NEW_NAMES)
        assert list(other.iterdir()) == []
        assert (out / "a").read_text() == "old"
        write(other / "out", "new", "a")  # a disk of its own is no matter
        write(other / "out", "newer", "a")
        assert content(other / "out") == {"a": "newer"}
    finally:
        shutil.rmtree(other)


def test_devices_and_pipes_are_not_replaced(tmp_path):
    """A rename would put a file in the place of ``/dev/null``."""
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/null")):
        kind = path.stat().st_mode
        with (
            pytest.raises(InputError, match=f"{path} is a device or a pipe; give the name of a file"),
            replacing(path, overwrite=True),
        ):
            pytest.fail("the block must not run")
        assert path.stat().st_mode == kind
    assert list(tmp_path.iterdir()) == [tmp_path / "pipe"]


def test_a_folder_may_replace_nothing(out):
    with (
        pytest.raises(InputError, match=r"out/a exists already; give --overwrite to replace it, or another folder"),
        replacing_folder(out, overwrite=False) as target,
    ):
        fill(target, "new", "a", "c")
    assert content(out) == OLD
    with replacing_folder(out, overwrite=False) as target:
        fill(target, "new", "c")
    assert content(out) == OLD | {"c": "new"}


# --- one writer ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("existing", [True, False])
def test_a_second_writer_is_told(tmp_path, existing):
    if existing:
        (tmp_path / "out").mkdir()
    with replacing_folder(tmp_path / "out") as target:
        with (
            pytest.raises(InputError, match=r"another process is writing .*out: wait until it has ended, or give"),
            replacing_folder(tmp_path / "out"),
        ):
            pytest.fail("the block must not run")
        fill(target, "new", "a")
    assert content(tmp_path) == {"out/a": "new"}


WRITER = """
import sys
from pathlib import Path
from legdistort.runtime.outputs import replacing_folder
with replacing_folder(sys.argv[1]) as target:
    (target / "a").write_text("half")
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("existing", [True, False])
def test_a_killed_writer_holds_nothing(tmp_path, existing):
    out = tmp_path / "out"
    if existing:
        out.mkdir()
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, out], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"ready\n"
        with pytest.raises(InputError, match="another process is writing"), replacing_folder(out):
            pytest.fail("the block must not run")
        process.send_signal(signal.SIGKILL)
    write(out, "new", "a")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert {name: text for name, text in content(out).items() if name != locks.LOCK} == {"a": "new"}


def race(out, text, begin):
    """One of two writers at once; what it found."""
    while time.time() < begin:
        pass
    try:
        with replacing_folder(out, former=FORMER) as target:
            fill(target, text, *(f"wcs/{k}.asdf" for k in range(5)), "a")
    except InputError:
        return 1
    return 0


def races(folder):
    """Thirty races of three writers, into a new folder and over results: no mixture, somebody wins."""
    for k in range(30):
        out = folder / str(k) / "out"
        out.parent.mkdir()
        if k % 2:
            write(out, "old", "a", "b")
        begin, children = time.time() + 0.02, []
        for text in "xyz":
            children.append(os.fork())
            if children[-1] == 0:
                status = 9
                try:
                    status = race(out, text, begin)
                finally:
                    os._exit(status)
        statuses = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
        assert set(statuses) <= {0, 1}
        assert 0 in statuses
        found = content(out)
        found.pop(locks.LOCK, None)
        assert found.keys() == {"a", *(f"wcs/{i}.asdf" for i in range(5))}
        assert len(set(found.values())) == 1
        assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
def test_two_writers_at_once_are_one_after_the_other(tmp_path):
    # forked from a small process without threads
    small = multiprocessing.get_context("spawn").Process(target=races, args=(tmp_path,))
    small.start()
    small.join()
    assert small.exitcode == 0


# --- errors of the disk, by their numbers -------------------------------------------------------------------------


def failing(error):
    raise error


def caused(error, cause):
    try:
        try:
            raise cause
        except OSError:
            raise error  # noqa: B904  (as libraries do)
    except Exception as made:
        return made


FULL, OTHER = OSError(ENOSPC, "No space left on device"), OSError(EIO, "Input/output error", "/data/no space left/x")


@pytest.mark.parametrize(
    ("error", "free", "full"),
    [
        (FULL, 1 << 40, True),
        (OSError(EDQUOT, "Disk quota exceeded"), 1 << 40, True),
        (OSError(EFBIG, "File too large"), 1 << 40, True),
        (caused(RuntimeError("cannot write"), FULL), 1 << 40, True),
        (caused(OSError("cannot write"), FULL), 1 << 40, True),
        (OSError("171 requested and 0 written"), 100, True),  # ndarray.tofile
        (OSError("171 requested and 0 written"), 1 << 40, False),
        (OTHER, 100, False),
        (OSError(EACCES, "Permission denied", "/no space/requested and"), 100, False),
        (ValueError("no space"), 100, False),
    ],
)
def test_a_full_disk_is_known_by_the_number(tmp_path, monkeypatch, error, free, full):
    monkeypatch.setattr(disk_errors, "free_bytes", lambda folder: free)
    for context in (replacing(tmp_path / "a"), replacing_folder(tmp_path / "b")):
        kind = DiskFullError if full else type(error)
        with pytest.raises(kind) as caught, context:
            failing(error)
        assert ("No space left on the disk for" in str(caught.value)) is full
    assert list(tmp_path.iterdir()) == []


LIMITED = """
import resource, sys
import numpy as np
from legdistort.exceptions import DiskFullError
from legdistort.runtime.outputs import replacing
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    with replacing(sys.argv[1], overwrite=True) as file:
        file.write(bytes(200_000))
except DiskFullError as error:
    print(error)
"""


def test_a_limit_of_the_size_of_files(tmp_path):
    (tmp_path / "a").write_text("old")
    run = subprocess.run([sys.executable, "-c", LIMITED, tmp_path / "a"], capture_output=True, text=True, check=True)
    assert run.stdout.startswith(f"No space left on the disk for {tmp_path / 'a'}: nothing was replaced")
    assert content(tmp_path) == {"a": "old"}


def written_by(kind):
    """A function of a path that writes what people write."""
    sim = ld.simulate_matches(n_stars=12, n_exposures=4, degree=1, shape=(100, 100), dither=5.0, seed=1)
    solution = ld.solve(sim.matches, degree=1)
    grid = np.exp(-(np.add.outer(np.arange(-12, 13) ** 2, np.arange(-12, 13) ** 2)) / 200)
    return {
        "solution": solution.write,
        "stars": partial(write_stars, solution),
        "report": partial(write_report, solution=solution),
        "prior": ld.Prior(np.zeros((2, 3))).write,
        "camera": ld.Camera.gsaoi().write,
        "psf": ld.EffectivePSF.from_array(grid, oversampling=4).write,
    }[kind]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("kind", ["solution", "stars", "report", "prior", "camera", "psf"])
@pytest.mark.usefixtures("undrawn")
def test_a_disk_that_takes_nothing(tmp_path, monkeypatch, kind):
    """What is written goes to ``/dev/full``, which says ENOSPC itself."""
    write_to, usual = written_by(kind), locks.temporary_folder

    @contextmanager
    def on_a_full_disk(parent, prefix, mode=0o777):
        with usual(parent, prefix, mode) as (folder, held):
            (folder / "file").symlink_to("/dev/full")
            yield folder, held

    monkeypatch.setattr(locks, "temporary_folder", on_a_full_disk)
    monkeypatch.setattr(disk_errors, "free_bytes", lambda folder: 0)
    path = tmp_path / {"stars": "a.ecsv", "report": "a.html", "psf": "a.fits"}.get(kind, "a.asdf")
    for before in ({}, {path.name: "old"}):
        with pytest.raises(DiskFullError, match=f"No space left on the disk for {path}: nothing was replaced"):
            write_to(path, overwrite=True)
        assert content(tmp_path) == before
        path.write_text("old")


def test_the_disk_is_asked(tmp_path):
    found = os.statvfs(tmp_path)
    assert abs(disk_errors.free_bytes(tmp_path / "not" / "yet") - found.f_bavail * found.f_frsize) < 1 << 32
    assert outputs.contents(tmp_path) == {}


# --- killed at every step -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="kills.py is for Linux")
def test_forty_kills():
    """See `kills.py`: thirteen calls, forty kills."""
    run = subprocess.run(
        [sys.executable, HERE / "kills.py", "--kills", "40"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    all_of_them = run.stdout.splitlines()[-1].split()
    assert all_of_them[0] == "all"
    assert all_of_them[2] == "40"
