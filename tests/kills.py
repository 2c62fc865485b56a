"""SIGKILL, or an error, at every operation on files: afterwards results are the old ones or the new, never a mixture.

    python tests/kills.py --kills 200
    python tests/kills.py --kills 200 --two-renames
    python tests/kills.py --kills 400 --errors

runs `solve`, `run`, `coadd`, `attach`, `simulate` and `measure --write-psf`, each into a new folder and over the
results of an earlier call. Every rename, removal, making of a folder or file, every ``fsync`` and every write is one
place to be killed at, a write in its middle. The process that works forks one child for every kill, as late as it can,
so that the work itself is done once.

After each kill the next reader (``legdistort show DIR`` where there is a solution) must succeed and find a folder that
is, byte for byte, the old one or the new one, hidden folders of dead processes apart. Where the process was killed
between two renames of folders (``--two-renames``: as on systems that cannot exchange them), or between the frames of
``attach --in-place``, the message must have the line that brings the old ones back, which is carried out. With
``--errors`` the operation fails instead, with error numbers of all kinds; the command may tell of no hidden file.

`measure` has two results, a folder of PSFs and then a table: between
them the PSFs are new and the table is not, which the checksums in the table tell. Linux only.
"""

import argparse
import builtins
import contextlib
import hashlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from errno import EACCES, EBUSY, EDQUOT, EIO, ENOMEM, ENOSPC, EPERM, EROFS, EXDEV
from pathlib import Path

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import fcntl

from legdistort.cli.parser import main
from legdistort.runtime import locks, outputs, provenance

#: What changes from call to call, the time aside: the word of a run and the seconds it took.
VARYING = {"summary.json", "report.html"}
#: Of `measure`, beside the PSFs.
TABLE = "stars.ecsv"
_LAST = 25
_HIDDEN = ".partial-"
_NUMBERS = (EIO, ENOSPC, EDQUOT, EACCES, EROFS, EXDEV, EBUSY, ENOMEM, EPERM)
_CHANGING = ("replace", "rename", "mkdir", "unlink", "remove", "rmdir", "fsync", "link", "symlink")


class Operations:
    """Counts what is done to files below a folder from the moment on it is armed; kills the process at one of them."""

    def __init__(self, folder):
        self.folder, self.count, self.killed_at = str(folder), 0, None
        self.serve = self.tell = self.first_write = None
        self.armed, self.errors = False, False

    def install(self):
        outputs.exchange = self._exchanging(outputs.exchange)
        for name in _CHANGING:
            setattr(os, name, self._counted(getattr(os, name)))
        self.real_open = io.open
        io.open = builtins.open = self._open

    def _below(self, path, options):
        descriptor = path if isinstance(path, int) else options.get("dir_fd")
        path = os.path.abspath(os.fsdecode(path)) if descriptor is None else os.readlink(f"/proc/self/fd/{descriptor}")
        return path.startswith(self.folder)

    def _counted(self, function):
        def counted(path, *args, **options):
            if self.armed and self._below(path, options):
                self.step()
            return function(path, *args, **options)

        return counted

    def _exchanging(self, function):
        def exchanging(*folders):
            if self.armed:
                self.step()
            return function(*folders)

        return exchanging

    def step(self, half=None):
        """One operation; `half` does a part of it before the process dies, or it fails."""
        self.count += 1
        if self.count == self.first_write and self.serve:
            self.serve()
        if self.count == self.killed_at:
            if half is not None:
                half()
            if self.errors:
                raise OSError(_NUMBERS[self.count % len(_NUMBERS)], "an error of the disk")
            os.kill(os.getpid(), signal.SIGKILL)

    def _open(self, file, mode="r", *args, **options):
        inside = isinstance(file, (str, os.PathLike)) and os.path.abspath(os.fspath(file)).startswith(self.folder)
        if not (self.armed and inside and set(mode) & set("wxa")):
            return self.real_open(file, mode, *args, **options)
        self.first_write = self.first_write or self.count + 1
        self.step()
        raw = _Raw(file, mode.replace("b", "").replace("t", ""), self)
        buffered = io.BufferedWriter(raw)
        if "b" in mode:
            return buffered
        return io.TextIOWrapper(buffered, encoding=options.get("encoding"), newline=options.get("newline"))


class _Raw(io.FileIO):
    def __init__(self, file, mode, operations):
        super().__init__(file, mode)
        self.operations = operations

    def write(self, content):
        content = memoryview(content).cast("B")
        self.operations.step(lambda: super(_Raw, self).write(content[: len(content) // 2]))
        return super().write(content)


def state(folder):
    """``{name: SHA-256}`` of all in a folder but hidden folders of dead processes; None without it."""
    if not folder.exists():
        return None
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if any(part.startswith(_HIDDEN) for part in name.split("/")):
            continue
        found[name] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
    return found


def in_child(function):
    """Exit status of a function in a forked process; negative for the signal that killed it."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = 99
        try:
            status = function() or 0
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr)
        finally:
            sys.stderr.flush()
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def open_locks():
    """Descriptors of files of locks in this process: ``{descriptor: path}``."""
    found = {}
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            path = os.readlink(f"/proc/self/fd/{name}")
            if path.endswith(locks.LOCK):
                found[int(name)] = path
    return found


class Case:
    """A command whose output is a folder or a file, killed at some of its operations.

    Parameters
    ----------
    name : str
    arguments : list of str
        Of the command line, without the output.
    out : Path
        Folder of results; the only thing in its own folder.
    read : callable
        What the next reader does with `out`; returns its exit status.
    old : bool
        Whether `out` holds the results of an earlier call.
    between : callable
        Whether what is found, as `state` gives it, is between two results of a command, and tells so.
    errors : bool
        Operations fail, and nothing is killed.
    """

    errors = False

    def __init__(self, name, arguments, out, read, old, between=None):
        self.name, self.arguments, self.out, self.read, self.old = name, arguments, out, read, old
        self.between = between
        self.root = out.parent
        self.faults, self.kills, self.results = [], 0, {"old": 0, "new": 0, "between": 0, "brought back": 0}

    def call(self, *, failing=False):
        """Exit status of the command, 97 if it tells of what is hidden."""
        status, told = quietly([*self.arguments, *(["--overwrite"] if self.old else [])], failing=failing)
        return 97 if status and _HIDDEN in told else status

    def run(self, n_kills):
        """Kill it `n_kills` times; returns the number of operations."""
        self.before = state(self.out)
        self.saved = Path(tempfile.mkdtemp(dir=self.root.parent)) / "saved"
        shutil.copytree(self.root, self.saved, symlinks=True)
        self.after = None
        operations = Operations(self.root)
        operations.serve = lambda: self._serving(operations, n_kills)
        reading, self._pipe = os.pipe()
        status = in_child(lambda: self._working(operations))
        os.close(self._pipe)
        with os.fdopen(reading) as file:
            total, early = json.loads(file.readline())
            for line in file:
                self._note(*json.loads(line))
        assert status == 0, f"{self.name}: the server ended with {status}"
        for k in early:
            self._restore(self.saved)
            fresh = Operations(self.root)
            fresh.killed_at, fresh.errors = k, self.errors
            self._judge(k, in_child(lambda fresh=fresh: self._working(fresh)))
        return total

    def _working(self, operations):
        operations.install()
        operations.armed = True
        status = self.call(failing=self.errors)
        operations.armed = False
        if operations.tell:
            operations.tell()
        return status

    def _places(self, total, n_kills):
        """At which operations of a whole call it is killed."""
        spread = n_kills // 2  # over all operations; the others over the last, among which the commit is
        places = {round(1 + i * (total - 1) / max(spread - 1, 1)) for i in range(spread)}
        last = sorted(set(range(max(1, total - _LAST), total + 1)) - places)
        n_last = min(n_kills - len(places), len(last))
        return sorted(places | {last[(2 * i + 1) * len(last) // (2 * n_last)] for i in range(n_last)})

    def _restore(self, saved):
        shutil.rmtree(self.root)
        shutil.copytree(saved, self.root, symlinks=True)

    def _serving(self, operations, n_kills):
        """Faults of `_serve` are not those of the command in which it is called."""
        try:
            self._serve(operations, n_kills)
        except BaseException:
            traceback.print_exc(file=sys.__stderr__)
            os._exit(98)

    def _serve(self, operations, n_kills):
        """At the first write: one child for every kill, all from the same state of the disk. Only children return.

        The first is not killed: its result is the new one, and it counts the operations. Kills before the first write
        are left to the master.
        """
        operations.armed = False
        here = self.saved.with_name("here")
        shutil.copytree(self.root, here, symlinks=True)
        reading, counted = os.pipe()
        held = open_locks()
        for descriptor in held:
            os.close(descriptor)  # shared with all children, or nobody would be dead
        first, places = operations.count, [None]
        while places:
            k = places.pop(0)
            self._restore(here)
            child = os.fork()
            if child == 0:
                for descriptor, path in held.items():
                    again = os.open(path, os.O_RDWR)
                    fcntl.flock(again, fcntl.LOCK_EX)
                    os.dup2(again, descriptor)
                    if again != descriptor:
                        os.close(again)
                operations.armed, operations.killed_at, operations.errors = True, k, self.errors
                operations.serve = None
                if k is None:
                    operations.tell = lambda: os.write(counted, json.dumps(operations.count).encode())
                return  # and the command goes on to its death
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            if k is not None:
                os.write(self._pipe, (json.dumps([k, *self._verdict(status)]) + "\n").encode())
                continue
            assert status == 0 == in_child(lambda: self.read(self.out))
            self.after = state(self.out)
            total = json.loads(os.read(reading, 100))
            places = self._places(total, n_kills)
            early, places = [k for k in places if k < first], [k for k in places if k >= first]
            os.write(self._pipe, (json.dumps([total, early]) + "\n").encode())
        os._exit(0)

    def _judge(self, k, status):
        self._note(k, *self._verdict(status))

    def _note(self, k, verdict, fault):
        self.kills += 1
        if fault:
            self.faults.append(f"{self.name}, operation {k}: {fault}")
        else:
            self.results[verdict] += 1

    def _verdict(self, status):
        ended = status
        if status not in ((0, 1) if self.errors else (-signal.SIGKILL,)):
            return None, f"it ended with {status}"
        back = self._bring_back()
        status = in_child(lambda: self.read(self.out))
        found = state(self.out)
        if back:
            verdict = "brought back"
            if found != self.before or status:
                return None, f"brought back, but not as it was (status of the reader {status})"
        elif self._like(found, self.after) and status == 0:
            verdict = "new"
        elif found == self.before and (status == 0 or not self.old):
            verdict = "old"
        elif self.between and status == 0 and self.between(self, found):
            verdict = "between"
        else:
            old, new = (each or {} for each in (self.before, self.after))
            odd = {
                k: ("old" if old.get(k) == v else "new" if new.get(k) == v else v[:8]) for k, v in (found or {}).items()
            }
            return None, f"neither old nor new (status of the reader {status}): {odd}"
        if ended == 0 and verdict != "new":
            return None, f"it ended well, and left the results that are {verdict}"
        locks.remove_dead(self.root, _HIDDEN)  # as the next writer beside it does
        strays = [path.name for path in self.root.iterdir() if path != self.out]
        return verdict, f"left behind: {strays}" if strays else None

    def _bring_back(self):
        """Carry out the line of a message, where former files were set aside; whether that was done."""
        aside, kept = locks.set_aside(self.out), sorted(self.out.glob(".replaced-*"))
        if not self.out.exists() and len(aside) == 1:
            told = locks.way_back(self.out / "some file").partition("this brings it back: ")[2]
        elif any(not copy.samefile(self.out / copy.name) for folder in kept for copy in folder.iterdir()):
            told = quietly(self.arguments, failing=True)[1].partition("this brings them back: ")[2].partition("; or")[0]
        else:  # names of the same files, which the next call takes away
            for folder in kept:
                shutil.rmtree(folder)
            for folder in aside:
                shutil.rmtree(folder)
            return False
        return subprocess.run(told, shell=True, check=False).returncode == 0 if told else False

    def _like(self, found, wanted):
        """Whether a folder is the new one; what changes from call to call must fit the list of the files."""
        if found is None or wanted is None or found.keys() != wanted.keys():
            return False
        if any(found[name] != wanted[name] for name in wanted.keys() - VARYING):
            return False
        if "summary.json" not in found:
            return True
        listed = json.loads((self.out / "summary.json").read_text())["files"]
        return all(found[name] == digest for name, digest in listed.items())


def quietly(arguments, *, failing=False):
    """Exit status of a command and what it says, without a word of it unless it fails."""
    told = io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        status = main([*arguments, "--quiet"])
    if status and not failing:
        print(told.getvalue(), file=sys.stderr)
    return status, told.getvalue()


def show(out):
    """The next reader of a folder with a solution."""
    return quietly(["show", str(out)], failing=True)[0]


def open_mosaic(out):
    """The next reader of a folder with a mosaic."""
    from astropy.io import fits

    for path in out.glob("*.fits"):
        with fits.open(path, checksum=True) as hdus:
            assert [hdu.data for hdu in hdus]
    return 0


def open_frames(out):
    """The next reader of a folder of frames."""
    from legdistort import read_exposures

    if out.exists():
        read_exposures([str(path) for path in sorted(out.glob("*.fits"))])
    return 0


def open_measured(out):
    """The next reader of a folder with a table of detections and their PSFs."""
    from legdistort.inputs.table_files import read_table
    from legdistort.measurement.effective.model import EffectivePSF

    for path in sorted((out / "psf").glob("*.fits")):
        EffectivePSF.read(path)
    if (out / TABLE).exists():
        read_table(out / TABLE)
    return 0


def psfs_before_the_table(case, found):
    """Whether the PSFs are the new ones, and the table is the old one, which has the checksums of others, or none."""
    from astropy.table import Table

    if any(found.get(name) != digest for name, digest in case.after.items() if name != TABLE):
        return False
    if found.keys() - {TABLE} != case.after.keys() - {TABLE} or found.get(TABLE) != case.before.get(TABLE):
        return False
    return TABLE not in found or any(
        found[f"psf/{name}"] != digest for name, digest in Table.read(case.out / TABLE).meta["psf_files"].items()
    )


def cases(folder, only=None):
    """The cases, prepared in a folder: every command into a new folder, and over the results of an earlier call."""
    night = folder / "night"
    quietly(["simulate", "--out", str(night), "--small"])
    frames = [str(path) for path in sorted(night.glob("*.fits"))]
    quietly(["measure", *frames, "--out", str(folder / "stars.ecsv")])
    quietly(["match", str(folder / "stars.ecsv"), "--out", str(folder / "matched.ecsv")])
    moffat = [*frames, "--psf", "moffat", "--degree", "1"]
    quietly(["run", *moffat, "--out", str(folder / "run")])
    solution = str(folder / "run" / "solution.asdf")
    calls = {
        "solve": (["solve", str(folder / "matched.ecsv"), "--degree", "2"], show, "."),
        "run": (["run", *moffat], show, "."),
        "coadd": (["coadd", *frames, "--solution", solution], open_mosaic, "mosaic.fits"),
        "attach": (["attach", solution, *frames], open_frames, "."),
        "simulate": (["simulate", "--small", "--seed", "1"], open_frames, "."),
        "measure": (["measure", *frames, "--psf", "effective", "--write-psf", "{out}/psf"], open_measured, TABLE),
    }
    for name, (arguments, read, file) in calls.items():
        if only not in (None, name):
            continue
        for old in (False, True):
            out = folder / f"{name}-{'old' if old else 'new'}" / "room" / "out"
            out.parent.mkdir(parents=True)
            arguments_of = [each.replace("{out}", str(out)) for each in [*arguments, "--out", str(out / file)]]
            if name in ("coadd", "measure"):  # a file needs a folder
                out.mkdir()
                (out / "notes.txt").write_text("not ours")
            if old:
                earlier = arguments_of
                if name == "solve":
                    earlier = ["solve", str(folder / "matched.ecsv"), "--degree", "1", "--out", str(out)]
                elif name == "run":  # with results that the next call has not
                    earlier = ["run", *frames, "--psf", "effective", "--degree", "1", "--out", str(out)]
                elif name == "coadd":
                    earlier = [*arguments_of, "--combine", "median"]
                elif name == "attach":
                    earlier = [*arguments_of, "--asdf-only"]
                elif name == "simulate":
                    earlier = [*arguments_of[:-3], "2", *arguments_of[-2:]]
                elif name == "measure":
                    earlier = [*arguments_of, "--gain", "3"]
                assert quietly([*earlier])[0] == 0
                (out / "notes.txt").write_text("not ours")
                arguments_of += ["--keep"] if name in ("solve", "run") else []
            what = f"{name} {'over an earlier one' if old else 'into a new folder'}"
            yield Case(what, arguments_of, out, read, old, psfs_before_the_table if name == "measure" else None)
    if only in (None, "attach"):
        out = folder / "attach-in-place" / "room" / "out"
        shutil.copytree(night, out)
        copies = [str(out / Path(frame).name) for frame in frames]
        yield Case("attach in place", ["attach", solution, *copies, "--in-place"], out, open_frames, True)


def kill(n_kills, folder, only=None, *, errors=False, two_renames=False):
    """Rows of the table, and the faults."""
    Case.errors = errors
    if two_renames:
        outputs.exchange = lambda *_: False
    provenance.now = lambda: "2026-01-01T00:00:00"
    rows, faults = [], []
    everything = list(cases(Path(folder), only))
    for i, case in enumerate(everything):
        share = n_kills * (i + 1) // len(everything) - n_kills * i // len(everything)
        begin = time.perf_counter()
        total = case.run(share)
        rows.append((case.name, total, case.kills, *case.results.values(), len(case.faults),
                     time.perf_counter() - begin))  # fmt: skip
        faults += case.faults
    return rows, faults


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--only", help="solve, run, coadd, attach, simulate or measure")
    parser.add_argument("--errors", action="store_true", help="operations fail, and nothing is killed")
    parser.add_argument("--two-renames", action="store_true", help="as where folders cannot be exchanged")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        table, wrong = kill(given.kills, place, given.only, errors=given.errors, two_renames=given.two_renames)
    print(f"{'command':28s} operations  kills   old   new  between  brought back  faults  seconds")
    for name, total, kills, old, new, between, back, bad, seconds in table:
        print(f"{name:28s} {total:10d} {kills:6d} {old:5d} {new:5d} {between:8d} {back:13d} {bad:7d} {seconds:8.1f}")
    total, kills, old, new, between, back = (sum(row[k] for row in table) for k in range(1, 7))
    print(f"{'all':28s} {total:10d} {kills:6d} {old:5d} {new:5d} {between:8d} {back:13d} {len(wrong):7d}")
    if wrong:
        print("\n".join(wrong))
    sys.exit(bool(wrong))
