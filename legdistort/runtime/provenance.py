"""Where a result comes from: packages, time, and the files that went in."""

import datetime
import hashlib
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path

PACKAGES = ("legdistort", "astropy", "gwcs", "asdf", "numpy", "scipy")


def stamp():
    """Versions and time, as plain strings: ``created``, ``versions``."""
    return {
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": dict(_versions()),
    }


@cache
def _versions():
    return {name: version(name) for name in PACKAGES}


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


def with_inputs(solution, files):
    """A solution that names the files it was made from, ``{base name: SHA-256}``, beside those it names already."""
    inputs = solution.provenance.get("inputs", {}) | files
    return replace(solution, provenance=solution.provenance | {"inputs": inputs})
