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


def checksums(inputs):
    """``{base name: SHA-256}`` of the files among `inputs`; what is no path (an HDUList, a CCDData) has none.

    Parameters
    ----------
    inputs : str, path, or a list of anything
    """
    out = {}
    for path in inputs if isinstance(inputs, (list, tuple)) else [inputs]:
        if isinstance(path, (str, Path)):
            with open(path, "rb") as file:
                out[Path(path).name] = hashlib.file_digest(file, "sha256").hexdigest()
    return out


def with_inputs(solution, files):
    """A solution that names the files it was made from, ``{base name: SHA-256}``, beside those it names already."""
    inputs = solution.provenance.get("inputs", {}) | files
    return replace(solution, provenance=solution.provenance | {"inputs": inputs})
