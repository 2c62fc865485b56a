"""Whatever happens to a process that writes: a folder of results is the old one or the new one, and has one writer."""

import itertools
import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext, suppress
from errno import EACCES, EDQUOT, EFBIG, EIO, ENOSPC
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import legdistort as ld
from legdistort.exceptions import DiskFullError, InputError, LegdistortError
from legdistort.inputs.table_files import write_stars
from legdistort.reporting.page import write_report
from legdistort.runtime import disk_errors, locks, outputs
from legdistort.runtime.checks import check_is_file
from legdistort.runtime.outputs import replacing, replacing_files, replacing_folder

HERE = Path(__file__).parents[1]
RESULTS = ("a", "b", "wcs/*.asdf", "summary.json")


def content(folder):
    """Names and texts, the hidden included."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def fill(folder, text, *names):
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)


def write(out, text, *names, **options):
    with replacing_folder(out, results=RESULTS, **options) as target:
        fill(target, text, *names)


def write_run(out, text, *names):
    """Results with a summary that lists them, as a run writes it."""
    with replacing_folder(out, results=RESULTS) as target:
        fill(target, text, *names)
        (target / "summary.json").write_text(json.dumps({"run": text, "files": outputs.contents(target)}))


def half_written(file):
    file.write(b"new")
    raise RuntimeError


class Stopped(BaseException):
    """What ends a process."""


@pytest.fixture
def stop_at(monkeypatch):
    """From a change of the disk on the process does nothing any more, as far as a test can have it."""

    def arm(n_changes, *functions):
        done = []

        def counted(usual):
            def change(*args, **options):
                if len(done) >= n_changes:
                    raise Stopped
                done.append(usual)
                return usual(*args, **options)

            return change

        with monkeypatch.context() as patch:
            for name in functions:
                patch.setattr(os, name, counted(getattr(os, name)))
            patch.setattr(locks, "remove", lambda folder: None)
            yield done

    return contextmanager(arm)


@pytest.fixture(params=["exchanged", "renamed twice"])
def swapped(request, monkeypatch):
    """How one folder takes the place of another."""
    if request.param == "renamed twice":
        monkeypatch.setattr(outputs, "exchange", lambda *_: False)
    return request.param


@pytest.fixture
def out(tmp_path):
    """A folder of an earlier call with something of somebody else's."""
    write(tmp_path / "out", "old", "a", "b", "wcs/1.asdf", "wcs/2.asdf")
    fill(tmp_path / "out", "mine", "notes", "wcs/mine.txt")
    return tmp_path / "out"


OLD = {"a": "old", "b": "old", "wcs/1.asdf": "old", "wcs/2.asdf": "old", "notes": "mine", "wcs/mine.txt": "mine"}
NEW = {"a": "new", "wcs/1.asdf": "new", "wcs/3.asdf": "new", "notes": "mine", "wcs/mine.txt": "mine"}
NEW_NAMES = ("a", "wcs/1.asdf", "wcs/3.asdf")


# --- a folder gives way to another --------------------------------------------------------------------------------


@pytest.mark.usefixtures("swapped")
def test_a_call_replaces_what_is_ours_and_nothing_else(out, tmp_path):
    (out / "link").symlink_to("nowhere")
    (out / "empty" / "deep").mkdir(parents=True)
    out.chmod(0o2750)
    inode, when = (out / "notes").stat().st_ino, (out / "notes").stat().st_mtime_ns
    write(out, "new", *NEW_NAMES)
    assert content(out) == NEW
    assert os.readlink(out / "link") == "nowhere"
    assert list((out / "empty").iterdir()) == [out / "empty" / "deep"]
    assert out.stat().st_mode & 0o7777 == 0o2750
    assert (out / "notes").stat().st_ino == inode
    assert (out / "notes").stat().st_mtime_ns == when
    assert list(tmp_path.iterdir()) == [out]


def test_a_reader_that_has_opened_the_old_folder_keeps_it_whole(out):
    """No file of it is changed: there is another folder."""
    with (out / "a").open() as file:
        write(out, "new", *NEW_NAMES)
        assert file.read() == "old"


def test_other_files_are_refused_by_name_unless_they_are_to_stay(out, tmp_path):
    told = r"holds what is not of an earlier run, notes, wcs/mine.txt: move it away, give another folder, or keep=True"
    with pytest.raises(InputError, match=told), replacing_folder(out, results=RESULTS, keep=False):
        pytest.fail("the block must not run")
    assert content(out) == OLD
    (out / "notes").unlink()
    (out / "wcs" / "mine.txt").rename(out / ".hidden")  # as those that desktops make
    write(out, "new", *NEW_NAMES, keep=False)
    assert content(out) == {"a": "new", "wcs/1.asdf": "new", "wcs/3.asdf": "new", ".hidden": "mine"}
    assert list(tmp_path.iterdir()) == [out]


def test_what_comes_while_the_work_goes_on_stays(out):
    shutil.rmtree(out / "wcs")
    (out / "notes").unlink()
    with replacing_folder(out, results=RESULTS, keep=False) as target:
        fill(target, "new", "a")
        fill(out, "mine", "notes")
    assert content(out) == {"a": "new", "notes": "mine"}


def test_links_of_files_are_copies_where_a_disk_has_none(out, monkeypatch):
    monkeypatch.setattr(os, "link", lambda *_, **__: failing(OSError(1, "Operation not permitted")))
    write(out, "new", *NEW_NAMES)
    assert content(out) == NEW


def test_a_summary_says_which_files_are_ours(out):
    (out / "summary.json").write_text(json.dumps({"files": {"b": "", "../precious": "", "notes": ""}}))
    fill(out.parent, "mine", "precious")
    write(out, "new", "a")
    assert {"wcs/1.asdf", "wcs/2.asdf", "notes"} <= content(out).keys()
    assert not {"b", "summary.json"} & content(out).keys()
    assert (out.parent / "precious").exists()


@pytest.mark.parametrize("text", ["[" * 100_000, "{", '{"files": [1]}', '{"files": null}', "\xff"])
def test_a_summary_that_is_none_lists_nothing(out, text):
    (out / "summary.json").write_bytes(text.encode("latin-1"))
    write(out, "new", *NEW_NAMES)
    assert content(out) == NEW


def test_a_link_to_a_folder_stays_one(out, tmp_path):
    (tmp_path / "link").symlink_to("out")
    write(tmp_path / "link", "new", *NEW_NAMES)
    assert (tmp_path / "link").is_symlink()
    assert content(out) == NEW


def test_a_file_on_another_disk_is_refused_before_the_work(out, monkeypatch):
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path).name == "wcs")
    with (
        pytest.raises(InputError, match=r"wcs is the top of a disk, which cannot be moved along"),
        replacing_folder(out, results=RESULTS),
    ):
        pytest.fail("the block must not run")


@pytest.mark.usefixtures("swapped")
def test_what_is_put_in_at_the_last_moment_is_not_lost(out, tmp_path, monkeypatch, caplog):
    usual = outputs.exchange

    def exchange(one, other):
        fill(other, "late", "late")
        return usual(one, other)

    monkeypatch.setattr(outputs, "exchange", exchange)
    write(out, "new", *NEW_NAMES)
    assert content(out) == NEW
    (aside,) = (path for path in tmp_path.iterdir() if path != out)
    assert content(aside).items() >= (OLD | {"late": "late"}).items()
    assert f"late was put into {out} as it was replaced: it lies in {aside}" in caplog.text


# --- where a folder cannot give way -------------------------------------------------------------------------------


def test_what_cannot_be_read_is_not_lost(out, monkeypatch):
    usual = os.scandir

    def scandir(path):
        return (
            usual(path) if not str(path).endswith("wcs") else failing(OSError(EACCES, "Permission denied", str(path)))
        )

    monkeypatch.setattr(os, "scandir", scandir)
    with pytest.raises(InputError, match=r"out/wcs cannot be read \(Permission denied\): move it away"):
        write(out, "new", *NEW_NAMES)
    monkeypatch.undo()
    assert content(out) == OLD


def test_the_folder_that_is_worked_in_may_be_gone(out, tmp_path, monkeypatch):
    """As a shell in a folder of results is left in the old one."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    write(out, "new", *NEW_NAMES)
    assert content(out) == NEW


@pytest.fixture(params=["this command works in it", "it is the top of a disk", "cannot be written", "another user"])
def fixed(request, tmp_path, monkeypatch):
    """An empty folder that cannot be exchanged, and why."""
    out = tmp_path / "out"
    out.mkdir()
    if "works" in request.param:
        monkeypatch.chdir(out)
    elif "disk" in request.param:
        monkeypatch.setattr(os.path, "ismount", lambda path: path == out)
    elif "user" in request.param:
        tmp_path.chmod(0o1777)
        monkeypatch.setattr(os, "geteuid", lambda: out.stat().st_uid + 1)
    else:
        usual = os.access
        monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path and usual(path, mode))  # root may
    return out, request.param


def test_a_folder_that_stays_is_filled(fixed):
    out, _ = fixed
    inode = out.stat().st_ino
    write_run(out, "new", *NEW_NAMES)
    assert content(out).keys() == {*NEW_NAMES, "summary.json"}
    assert out.stat().st_ino == inode
    assert list(out.parent.iterdir()) == [out]


def test_results_in_a_folder_that_stays_are_not_replaced(fixed):
    out, why = fixed
    fill(out, "old", "a", "notes")
    with (
        pytest.raises(InputError, match=rf"holds a, and cannot be replaced as a whole, since .*{why}.*: give a"),
        replacing_folder(out, results=RESULTS),
    ):
        pytest.fail("the block must not run")
    with (
        pytest.raises(InputError, match="holds what is not of an earlier run, a, notes"),
        replacing_folder(out, results=("b",), keep=False),
    ):
        pytest.fail("the block must not run")
    assert content(out) == {"a": "old", "notes": "old"}


@pytest.mark.parametrize("n_renames", range(5))
def test_a_failure_in_a_folder_that_stays_takes_all_back(fixed, monkeypatch, n_renames):
    """Where a command replaces files without a list of earlier ones."""
    out, _ = fixed
    fill(out, "old", "a", "notes")
    usual, done = os.replace, []

    def replace(*paths):
        done.append(paths)
        return usual(*paths) if len(done) != n_renames + 1 else failing(OSError(EIO, "Input/output error"))

    monkeypatch.setattr(os, "replace", replace)
    with (
        nullcontext() if n_renames == 4 else pytest.raises(OSError, match="Input/output"),
        replacing_folder(out) as target,
    ):
        fill(target, "new", "a", "b", "wcs/1.asdf", "wcs/2.asdf")
    new = dict.fromkeys(["a", "b", "wcs/1.asdf", "wcs/2.asdf"], "new")
    assert content(out) == {"a": "old", "notes": "old"} | (new if n_renames == 4 else {})
    assert {path.name for path in out.iterdir()} == {name.partition("/")[0] for name in content(out)}


# --- processes that are killed ------------------------------------------------------------------------------------


def test_a_process_killed_before_the_exchange_leaves_the_old_folder(out, tmp_path, monkeypatch):
    monkeypatch.setattr(outputs, "exchange", lambda *_: failing(Stopped()))
    with monkeypatch.context() as patch:
        patch.setattr(locks, "remove", lambda folder: None)
        with pytest.raises(Stopped):
            write(out, "new", *NEW_NAMES)
    assert {name: text for name, text in content(out).items() if not name.startswith(".")} == OLD
    monkeypatch.undo()
    write(out, "newer", "a")
    assert content(out) == {"a": "newer", "notes": "mine", "wcs/mine.txt": "mine"}
    assert list(tmp_path.iterdir()) == [out]


def test_a_process_killed_after_the_exchange_leaves_the_new_folder(out, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(locks, "remove", lambda folder: None)
        write(out, "new", *NEW_NAMES)
    assert content(out) == NEW
    write(out, "newer", "a")
    assert content(out) == {"a": "newer", "notes": "mine", "wcs/mine.txt": "mine"}
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("n_renames", [0, 1, 2])
def test_a_process_killed_between_two_renames(tmp_path, monkeypatch, stop_at, caplog, n_renames):
    """The old results are beside; who misses them is told the line that brings them back, and the next run does it."""
    monkeypatch.setattr(outputs, "exchange", lambda *_: False)
    out = tmp_path / "out"
    write_run(out, "old", "a", "b")
    before = content(out)
    with stop_at(n_renames, "rename"), pytest.raises(Stopped):
        write_run(out, "new", "a")
    if n_renames == 1:  # the process could not even undo the first
        (aside,) = locks.set_aside(out)
        assert content(aside).items() >= before.items()
        with pytest.raises(InputError, match=r"out/solution.asdf: no such file; .*this brings it back: mv ") as told:
            check_is_file(out / "solution.asdf")
        copy = tmp_path / "copy"
        shutil.copytree(tmp_path, copy)
        line = str(told.value).partition("brings it back: ")[2]
        subprocess.run(line.replace(f"{tmp_path}/", f"{copy}/"), shell=True, check=True)
        assert content(copy / "out").items() >= before.items()
        shutil.rmtree(copy)
    else:
        assert not locks.set_aside(out) or n_renames == 2
    with pytest.raises(InputError, match="a exists already"), replacing_folder(out, overwrite=False) as target:
        fill(target, "newest", "a")
    assert content(out)["a"] == ("new" if n_renames == 2 else "old")
    assert ("out was brought back: its writer had been stopped" in caplog.text) is (n_renames == 1)
    write_run(out, "newest", "a")
    assert content(out).keys() == {"a", "summary.json"}
    left = [path for path in tmp_path.iterdir() if path != out]
    assert left == locks.set_aside(out)  # beside results that are whole it is for the user to look at
    assert len(left) == (n_renames == 2)
    assert not left or f"{left[0]} may be what {out} was earlier; look into it, and remove it" in caplog.text


def test_what_only_looks_like_earlier_results_stays(tmp_path, caplog):
    out, word = tmp_path / "out", "0" * 32
    fill(tmp_path, "mine", f"out.old-{word}/notes", f"out.old-{word}/a", "out.old-1/summary.json")
    (tmp_path / f"out.old-{'1' * 32}").symlink_to(f"out.old-{word}")
    before = content(tmp_path)
    write(out, "new", "a")
    assert {name: text for name, text in content(tmp_path).items() if name != "out/a"} == before
    assert f"out.old-{word} may be what" in caplog.text


def test_what_is_incomplete_is_dropped_and_what_is_not_ours_stays(out, tmp_path):
    word = "0" * 32
    dead, foreign, near = out / f".partial-{word}", out / ".partial-of-somebody", out / f".partial-{'1' * 32}"
    for folder in (dead, foreign, near):
        fill(folder.parent, "half", f"{folder.name}/a")
    (dead / locks.LOCK).touch()
    (near / locks.LOCK).write_text("with something in it")
    (out / f".commit-{word}").mkdir()
    fill(out, '{"remove": ["b"]}', f".commit-{word}/.legdistort.json")  # as versions before had it
    with replacing(out / "c") as file:
        file.write(b"new")
    left = {f"{folder.name}/a": "half" for folder in (foreign, near)}
    left |= {f"{near.name}/{locks.LOCK}": "with something in it"}
    left |= {f".commit-{word}/.legdistort.json": '{"remove": ["b"]}', "c": "new"}
    assert content(out) == OLD | left


def test_what_is_being_written_is_left_alone(out):
    """A file that another command writes into the folder just then, too."""
    with replacing(out / "c") as file:
        write(out, "new", *NEW_NAMES)
        file.write(b"new")
    assert content(out) == NEW | {"c": "new"}
    with replacing_folder(out) as target, replacing(out / "d") as file:
        fill(target, "newer", "a")
        file.write(b"new")
    assert content(out) == NEW | {"a": "newer", "c": "new", "d": "new"}


# --- files among those of others ----------------------------------------------------------------------------------


@pytest.fixture
def frames(tmp_path):
    """Files in two folders, with others."""
    fill(tmp_path, "old", "one/a", "one/b", "two/a", "one/other")
    return [tmp_path / name for name in ("one/a", "one/b", "two/a")]


def replace_files(paths, text):
    with replacing_files(paths) as writing:
        for path in paths:
            with writing(path) as file:
                file.write(text.encode())


ALL_OLD = dict.fromkeys(["one/a", "one/b", "two/a", "one/other"], "old")
ALL_NEW = ALL_OLD | dict.fromkeys(["one/a", "one/b", "two/a"], "new")


def test_files_are_replaced_together(frames, tmp_path):
    with pytest.raises(RuntimeError), replacing_files(frames) as writing, writing(frames[0]) as file:
        half_written(file)
    assert content(tmp_path) == ALL_OLD
    replace_files(frames, "new")
    assert content(tmp_path) == ALL_NEW
    assert {path.name for path in (tmp_path / "one").iterdir()} == {"a", "b", "other"}


CHANGES = ("replace", "rename", "link", "mkdir", "fsync", "unlink", "rmdir")


@pytest.fixture
def without_waiting(monkeypatch):
    """Nothing waits for the disk."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@pytest.mark.usefixtures("without_waiting")
@pytest.mark.parametrize("lasting", [False, True])
def test_files_come_back_after_an_error(frames, tmp_path, monkeypatch, caplog, lasting):
    """At every change of the disk, once, and from then on: either all are old or new, or the line brings them back."""
    outcomes = set()
    for k in itertools.count():
        count = itertools.count()

        def failing_at(usual, k=k, count=count):
            def change(*args, **options):
                now = next(count)
                return (
                    failing(OSError(EIO, "Input/output error"))
                    if now == k or (lasting and now > k)
                    else usual(*args, **options)
                )

            return change

        told = ""
        with monkeypatch.context() as patch:
            for name in CHANGES:
                patch.setattr(os, name, failing_at(getattr(os, name)))
            try:
                replace_files(frames, "new")
            except (LegdistortError, OSError) as error:
                told = str(error)
        back, left = "could not be put back" in told, _settled(tmp_path, "")
        while back and (line := _refused(frames)):
            left = _settled(tmp_path, line)
        assert left in (ALL_OLD, ALL_NEW), (k, told)
        outcomes.add((left == ALL_NEW, back))
        for kept in tmp_path.glob("*/.replaced-*"):  # nor could these be removed
            assert f"could not be removed: remove {kept}" in caplog.text
            if left == ALL_NEW:  # else the next call sees that they are the files themselves
                shutil.rmtree(kept)
        replace_files(frames, "old")
        assert content(tmp_path) == ALL_OLD
        if next(count) <= k:
            break
    assert {(False, False), (True, False)} <= outcomes
    assert ((False, True) in outcomes) is lasting


def _settled(folder, told):
    """What there is once the line of a message has been carried out, the hidden apart."""
    if "this brings them back: " in told:
        subprocess.run(told.partition("this brings them back: ")[2].partition("; or")[0], shell=True, check=True)
    return {name: text for name, text in content(folder).items() if not any(p[0] == "." for p in name.split("/"))}


@pytest.mark.usefixtures("without_waiting")
def test_files_of_a_process_that_is_killed(frames, tmp_path, stop_at):
    """At every change: they are all old or new, or the next call names the line that brings the old ones back."""
    refused = 0
    for k in itertools.count():
        with stop_at(k, *CHANGES) as done, suppress(Stopped):
            replace_files(frames, "new")
        whole = _settled(tmp_path, "") == ALL_NEW
        while told := _refused(frames):  # of one folder after the other
            refused += 1
            assert re.match(r"\S+/\.replaced-\w+ holds files as they were before a command replaced them", told)
            if whole:
                shutil.rmtree(told.partition(" ")[0])
            else:
                _settled(tmp_path, told)
                assert _settled(tmp_path, "") != ALL_NEW
        assert content(tmp_path) == ALL_OLD | dict.fromkeys(["one/a", "one/b", "two/a"], "newest"), k
        replace_files(frames, "old")
        if len(done) < k:
            break
    assert refused >= 2


def _refused(paths):
    """What the next call says; nothing if it replaces the files."""
    try:
        replace_files(paths, "newest")
    except InputError as error:
        return str(error)
    return ""


def test_files_kept_by_a_killed_process_are_not_lost(frames, tmp_path, stop_at):
    with stop_at(1, "replace"), pytest.raises(Stopped):
        replace_files(frames, "new")
    assert (tmp_path / "one" / "a").read_text() == "new"
    with pytest.raises(InputError, match="this brings them back: mv -f") as told:
        replace_files(frames, "newest")
    assert _settled(tmp_path, str(told.value)) == ALL_OLD


def test_two_calls_for_the_same_files(frames):
    with (
        replacing_files([]),
        replacing_folder(frames[0].parent),
        pytest.raises(InputError, match=r"another process is writing in .*one"),
        replacing_files(frames[:1]),
    ):
        pytest.fail("the block must not run")


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
        with replacing_folder(out, results=RESULTS) as target:
            fill(target, text, *(f"wcs/{k}.asdf" for k in range(5)), "a")
    except InputError:
        return 1
    return 0


def races(folder):
    """Twelve races of three writers, into a new folder and over results: no mixture, somebody wins."""
    for k in range(12):
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


@pytest.mark.slow
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


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("error", [FULL, OTHER, InputError("no"), OSError(EIO, "failed")])
def test_errors_name_the_file_of_the_user(tmp_path, monkeypatch, existing, error):
    """And not the hidden one that was to become it."""
    monkeypatch.chdir(tmp_path)
    out = Path("out")
    if existing:
        write(out, "old", "a")

    def fill_in(target, function):
        with replacing(target / "stars.ecsv") as file:
            file.write(b"new")
            function(target)

    def hidden(target):
        raise (
            type(error)(error.errno, error.strerror, str(target / "x"))
            if isinstance(error, OSError)
            else InputError(f"{target / 'x'} is damaged")
        )

    told = []
    for function in (hidden, lambda target: failing(error)):
        with pytest.raises((OSError, InputError)) as caught, replacing_folder(out, results=RESULTS) as target:
            fill_in(target, function)
        told.append(str(caught.value))
    assert not any(".partial-" in text for text in told)
    if error is FULL:
        assert all(text.startswith("No space left on the disk for out/stars.ecsv, which was left as") for text in told)
    else:
        assert "out/x" in told[0]
    assert content(tmp_path) == ({"out/a": "old"} if existing else {})


def test_names_that_begin_as_a_hidden_one_stay():
    """Only what is hidden, and what is in it, has the name of the user."""
    hidden, out = Path("/data/.partial-0/new"), Path("out")
    text = "/data/.partial-0/new/a, /data/.partial-0/new2/a, /data/.partial-0/new.old-1 and /data/.partial-0/new."
    with (
        pytest.raises(ValueError, match=r"^out/a, /data/.partial-0/new2/a, /data/.partial-0/new.old-1 and out\.$"),
        disk_errors.errors_name(out, hidden),
    ):
        raise ValueError(text)


def test_what_could_not_be_removed_is_no_result(tmp_path, monkeypatch):
    """A hidden folder of a file that was written among the results is not listed with them."""
    with replacing_folder(tmp_path / "out") as target:
        (target / "wcs").mkdir()
        with monkeypatch.context() as patch:
            patch.setattr(locks, "remove", lambda folder: None)
            for name in ("a", "wcs/1.asdf"):
                with replacing(target / name) as file:
                    file.write(b"new")
        assert len(list(target.rglob(".partial-*"))) == 2
        listed = outputs.contents(target)
    assert listed.keys() == {"a", "wcs/1.asdf"}


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
    assert run.stdout.startswith(f"No space left on the disk for {tmp_path / 'a'}, which was left as it was")
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
    def on_a_full_disk(*args):
        with usual(*args) as folder:
            (folder / "file").symlink_to("/dev/full")
            yield folder

    monkeypatch.setattr(locks, "temporary_folder", on_a_full_disk)
    monkeypatch.setattr(disk_errors, "free_bytes", lambda folder: 0)
    path = tmp_path / {"stars": "a.ecsv", "report": "a.html", "psf": "a.fits"}.get(kind, "a.asdf")
    for before in ({}, {path.name: "old"}):
        with pytest.raises(DiskFullError, match=f"No space left on the disk for {path}, which was left as it was"):
            write_to(path, overwrite=True)
        assert content(tmp_path) == before
        path.write_text("old")


def test_the_disk_is_asked(tmp_path):
    found = os.statvfs(tmp_path)
    assert abs(disk_errors.free_bytes(tmp_path / "not" / "yet") - found.f_bavail * found.f_frsize) < 1 << 32
    assert outputs.contents(tmp_path) == {}


# --- killed at every step -----------------------------------------------------------------------------------------


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="kills.py is for Linux")
@pytest.mark.parametrize("n", [pytest.param(1, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.sets)])
def test_kills(n):
    """See `kills.py`: thirteen calls, each killed n times."""
    run = subprocess.run(
        [sys.executable, HERE / "kills.py", "--kills", str(n)], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    all_of_them = run.stdout.splitlines()[-1].split()
    assert all_of_them[0] == "all"
    assert all_of_them[2] == str(n)
