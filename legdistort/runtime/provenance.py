"""Where a result comes from: packages, time, and the files that went in."""

import datetime
import hashlib
import json
import os
import shlex
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

from ..exceptions import InputError

#: File of a run that lists the others.
SUMMARY = "summary.json"
_WAITS = 0.0, 0.01, 0.05, 0.2, 0.5  # s, before what is read is that of several runs for sure
PACKAGES = ("legdistort", "astropy", "gwcs", "asdf", "numpy", "scipy")


def stamp():
    """Versions and time, as plain strings: ``created``, ``versions``."""
    return {"created": f"{now()}+00:00", "versions": dict(_versions())}


def now():
    """The time, UTC, to the second, as FITS headers have it: ``2026-01-31T23:59:59``."""
    return datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%S")


@cache
def _versions():
    return {name: version(name) for name in PACKAGES}


def command_line():
    """The command that runs now, as it would be typed; None where it is another program that calls."""
    program = Path(sys.argv[0]) if sys.argv else Path()
    if program.stem != "legdistort" and program.parts[-2:] != ("legdistort", "__main__.py"):
        return None
    return shlex.join(["legdistort", *sys.argv[1:]])


def checksums(*paths):
    """``{base name: SHA-256}`` of files."""
    return {Path(path).name: checksum_of(path) for path in paths}


def checksum_of(path):
    """SHA-256 of a file, in hexadecimal digits."""
    with open(path, "rb") as file:
        return checksum(file)


def checksum(file):
    """SHA-256 of an open file from where it stands, in hexadecimal digits."""
    return hashlib.file_digest(file, "sha256").hexdigest()


def identity(path):
    """What distinguishes one state of a file from another without reading it; None if there is no file."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


@contextmanager
def unchanged(*paths):
    """A block that reads files, and what it learns is of one state of them.

    Yields
    ------
    list
        The `identity` of each.

    Raises
    ------
    InputError
        If a file is another one in the end, by whatever of its identity.
    """
    before = [identity(path) for path in paths]
    yield before
    for path, known in zip(paths, before, strict=True):
        if identity(path) != known:
            raise InputError(f"{path} changed while it was read: wait until it is complete, and read it again")


def files_of_run(folder):
    """``{name: SHA-256}`` of the files of the run that left a folder, by its summary; None if none lists them."""
    path = Path(folder) / SUMMARY
    try:
        files = json.loads(path.read_text(encoding="utf-8"))["files"] if path.is_file() else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return files if isinstance(files, dict) else None


def of_one_run(folder, read):
    """What is read of several files in a folder of results, which another process may replace just now.

    Parameters
    ----------
    folder : path
        Where there is no summary of a run that lists its files, they are not compared with it.
    read : callable
        Returns what it has read, and the names of the files, as the summary has them.

    Raises
    ------
    InputError
        If files are not those of the run, after several attempts; else what `read` raises.
    """
    folder, fault = Path(folder), ""
    for wait in _WAITS:
        time.sleep(wait)
        before, listed = _state(folder), files_of_run(folder)
        try:
            found, names = read()
            own = {name: checksum_of(folder / name) for name in names}
        except (InputError, OSError):
            if _state(folder) == before:
                raise
            own = {}
        if _state(folder) != before or not own:
            fault = "it is replaced again and again"
        elif other := [name for name in own if listed is not None and listed.get(name) != own[name]]:
            fault = f"{folder / other[0]} is not the file that {SUMMARY} lists"
        else:
            return found
    raise InputError(
        f"{folder} does not hold the files of one run, {fault}: take it as a run has left it, or run again"
    )


def _state(folder):
    """What changes when a folder of results is replaced."""
    return identity(folder / SUMMARY) or identity(folder)


def with_inputs(solution, files):
    """A solution that names the files it was made from, ``{base name: SHA-256}``, beside those it names already."""
    inputs = solution.provenance.get("inputs", {}) | files
    return replace(solution, provenance=solution.provenance | {"inputs": inputs})
