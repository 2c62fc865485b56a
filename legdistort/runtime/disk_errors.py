"""Whether a disk is full: by the number of an error, or by the disk itself where a library dropped the number."""

import os
import re
from contextlib import contextmanager
from errno import EDQUOT, EFBIG, ENOSPC

from ..exceptions import DiskFullError, LegdistortError

_SOME = 1 << 20  # bytes; a disk with less than these is full


def is_full(error, folder):
    """Whether an error, or one that led to it, is that of a disk without space for more.

    Parameters
    ----------
    error : BaseException
    folder : path
        What was written, or where. Writers do not always hand the number of an error on (``ndarray.tofile``, astropy):
        then the disk is asked. The text of the error is not used, since it may contain anything, such as a path.
    """
    unknown, seen = isinstance(error, OSError) and error.errno is None, []
    while error is not None and error not in seen:
        if isinstance(error, OSError) and error.errno in (ENOSPC, EDQUOT, EFBIG):
            return True
        seen.append(error)
        error = error.__cause__ or error.__context__
    return unknown and free_bytes(folder) < _SOME


def free_bytes(folder):
    """Room on the disk of a folder, or of the nearest one above it that exists."""
    for place in (folder, *folder.absolute().parents):
        try:
            found = os.statvfs(place)
        except FileNotFoundError:
            continue
        except (OSError, AttributeError):  # Windows
            break
        return found.f_bavail * found.f_frsize
    return float("inf")


@contextmanager
def errors_name(path, hidden):
    """Errors name `path` where they would name `hidden`, which is to become it; those of a full disk are told as such.

    Raises
    ------
    DiskFullError
        If the disk of `hidden` is full, in the place of an error that has no message of its own.
    """
    whole = re.compile(rf"{re.escape(str(hidden))}(?![\w-]|\.\w)")

    def named(text):
        text = os.fspath(text) if isinstance(text, os.PathLike) else text
        # not where it is the beginning of another name beside it
        return re.sub(whole, lambda _: str(path), text) if isinstance(text, str) else text

    try:
        yield
    except Exception as error:
        error.args = tuple(map(named, error.args))
        for name in ("filename", "filename2"):
            if getattr(error, name, None) is not None:
                setattr(error, name, named(getattr(error, name)))
        if isinstance(error, LegdistortError) or not is_full(error, hidden):
            raise
        raise DiskFullError(
            f"No space left on the disk for {path}, which was left as it was: free some space (or allow larger files: "
            "ulimit -f), or write elsewhere"
        ) from None
