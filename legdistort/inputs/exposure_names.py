"""Names of exposures: from those of their files, and fit to be those of other files."""

import re
from pathlib import Path

from ..exceptions import InputError

_SUFFIX = re.compile(r"\.(fits|fit|fts|ldac|asdf)(\.(gz|fz|bz2|zip))?$", re.IGNORECASE)
#: What no name has: slashes, control characters and line breaks, bytes of a file name that are no UTF-8.
_UNFIT = re.compile("[/\\\\\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_PRODUCT = re.compile(r"_[A-Za-z]{3,}$")
_LONGEST = 250  # bytes; with the ending .asdf the 255 that file systems allow


def exposure_name(path, ext=None):
    """Name of the exposure in a file, or in one of its extensions (see `legdistort.read_exposures`)."""
    name = _SUFFIX.sub("", Path(path).name)
    parts = ext if isinstance(ext, tuple) else (ext,)
    return name if ext is None else f"{name}_{''.join(map(str, parts))}"


def alike(name, names):
    """The only one of names that differs from a name by its last word; None if there is none, or several are so.

    Pipelines call their products so, ``x_cal``, ``x_cat``, ``x_wcs``; the word is of letters, three at least, since
    numbers and filters are those of other exposures.
    """
    stem = _PRODUCT.sub("", name)
    found = [each for each in names if each != stem == _PRODUCT.sub("", each)] if stem != name else []
    return found[0] if len(found) == 1 else None


def detector_name(exposure, detector):
    """Name of the part of an exposure that one detector of a camera took; no name of an extension looks like it."""
    return f"{exposure}-{detector}"


def whole_name(image):
    """Name of the exposure that an image is of: the one that several detectors share, or its own."""
    return image.exposure or image.name


def in_header(name):
    """Name of an exposure as the value of a FITS card, which is ASCII: the rest as escapes."""
    return name.encode("ascii", "backslashreplace").decode().rstrip()


def check_exposure_name(name, origin=None):
    """Raise `InputError` if a name of an exposure cannot be that of a file; `origin` is the file it comes from."""
    if not name.strip(". ") or _UNFIT.search(name) or len(name.encode()) > _LONGEST:
        where = "" if origin is None else f"{str(origin)!r}: "
        raise InputError(
            f"{where}exposure {name!r} cannot be the name of a file; rename it (no slashes, line breaks or control "
            f"characters, at most {_LONGEST} bytes, not empty)"
        )
