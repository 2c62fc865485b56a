"""Where a result comes from: packages, time, and the files that went in."""

import datetime
import hashlib
import os
import shlex
import sys
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

from ..exceptions import InputError

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
    out = {}
    for path in paths:
        with open(path, "rb") as file:
            out[Path(path).name] = checksum(file)
    return out


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


def with_inputs(solution, files):
    """A solution that names the files it was made from, ``{base name: SHA-256}``, beside those it names already."""
    inputs = solution.provenance.get("inputs", {}) | files
    return replace(solution, provenance=solution.provenance | {"inputs": inputs})
