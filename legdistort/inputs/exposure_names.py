"""Names of exposures: from those of their files, and fit to be those of other files."""

import os
import re
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

from ..exceptions import InputError, some_of

_SUFFIX = re.compile(r"\.(fits|fit|fts|ldac|asdf)(\.(gz|fz|bz2|zip))?$", re.IGNORECASE)
#: What no name has: slashes, control characters and line breaks, bytes of a file name that are no UTF-8.
_UNFIT = re.compile("[/\\\\\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_PRODUCT = re.compile(r"_[A-Za-z]{3,}$")
#: Why an exposure was left out that the user wanted to be.
ASKED = "as asked (--without)"
_LONGEST = 250  # bytes; with the ending .asdf the 255 that file systems allow


def exposure_name(path, ext=None):
    """Name of the exposure in a file, or in one of its extensions (see `legdistort.read_exposures`)."""
    name = _SUFFIX.sub("", Path(path).name)
    parts = ext if isinstance(ext, tuple) else (ext,)
    return name if ext is None else f"{name}_{''.join(map(str, parts))}"


def list_name(path):
    """What the exposure of a list is called, by the name of its file."""
    path = Path(path)
    return exposure_name(Path(path.stem).stem if path.suffix.lower() in (".gz", ".bz2") else path.stem)


def folder_marks(names, paths):
    """What comes before names of files in several folders so that those of one name differ: ``FOLDER_``.

    Of all files the folder on the same level, the lowest that serves: the numbers of frames begin anew in every night.

    Parameters
    ----------
    names : sequence of str
    paths : sequence of Path or None
        The file that each comes from; several of one file have different names.

    Returns
    -------
    list of str
        Empty texts where the names differ as they are, or no folder tells them apart.
    """
    folders = [(None if path is None else Path(os.path.abspath(path)).parents) for path in paths]
    plain = [""] * len(names)
    if len(set(names)) == len(names):
        return plain
    for level in range(max(0 if each is None else len(each) for each in folders)):
        marks = ["" if each is None or level >= len(each) else f"{each[level].name}_" for each in folders]
        if len(set(zip(marks, names, strict=True))) == len(names):
            return marks
    return plain


def file_names(paths):
    """Base names of files, with folders before them where they repeat (`folder_marks`)."""
    names = [path.name for path in paths]
    return [mark + name for mark, name in zip(folder_marks(names, paths), names, strict=True)]


def folders_in_words(name):
    """What is said where names have a folder before them (`folder_marks`), with the first of them."""
    return f"names of files repeat in several folders, whose names are put before them: {name} and so on"


def folder_mark(name, path, known):
    """``FOLDER_`` of a file, one of its folders, with which its name is the beginning of a known one; else empty.

    Parameters
    ----------
    name : str
        As the file is called by itself.
    path : Path
    known : iterable of str
        Names of exposures, see `folder_marks`.
    """
    marks = ["", *(f"{folder.name}_" for folder in Path(os.path.abspath(path)).parents)]
    begins = (mark for mark in marks for each in known if re.match(rf"{re.escape(mark + name)}(?![A-Za-z0-9])", each))
    return next(begins, "")


def marked(image, mark):
    """An exposure, or the part of one, with something before its name."""
    whole = {} if image.exposure is None else {"exposure": mark + image.exposure}
    return replace(image, name=mark + image.name, **whole) if mark else image


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


def left_out_by(patterns, names, nights=()):
    """``{name: why}`` of the exposures, or nights, of these patterns (`fnmatch`), as `Matches.without` takes them.

    Raises
    ------
    InputError
        For a pattern that fits none.
    """
    reasons = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns or ():
        found = [[each for each in some if fnmatchcase(str(each), pattern)] for some in (names, nights)]
        if not any(found):
            known = f", and none of the nights: {some_of(list(nights), 6)}" * (len(nights) > 1)
            raise InputError(f"--without {pattern} is none of the exposures: {some_of(list(names), 6)}{known}")
        reasons |= dict.fromkeys(found[0] or found[1], ASKED)
    return reasons
