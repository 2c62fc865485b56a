"""Whether a disk is full: by the number of an error, or by the disk itself where a library dropped the number."""

import os
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
        Where was written. Writers do not always hand the number of an error on (``ndarray.tofile``, astropy): then the
        disk is asked. The text of the error is not used, since it may contain anything, such as a path.
    """
    numbers = {each.errno for each in _with_causes(error) if isinstance(each, OSError)}
    if numbers & {ENOSPC, EDQUOT, EFBIG}:
        return True
    return isinstance(error, OSError) and error.errno is None and free_bytes(folder) < _SOME


def _with_causes(error):
    errors = []
    while error is not None and error not in errors:
        errors.append(error)
        error = error.__cause__ or error.__context__
    return errors


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
def told_when_full(path, folder):
    """Errors of a full disk as `DiskFullError`, which names `path`; it is written in `folder`."""
    try:
        yield
    except LegdistortError:  # it has a message of its own
        raise
    except Exception as error:
        if not is_full(error, folder):
            raise
        raise DiskFullError(
            f"No space left on the disk for {path}, which was left as it was: free some space (or allow larger files: "
            "ulimit -f), or write elsewhere"
        ) from None


@contextmanager
def named_as_given(hidden, path):
    """Errors that name a hidden file or folder, or what is in it, name `path` instead, which it is to become."""
    try:
        yield
    except Exception as error:
        error.args = tuple(_named(each, hidden, path) for each in error.args)
        for name in ("filename", "filename2"):
            if getattr(error, name, None) is not None:
                setattr(error, name, _named(getattr(error, name), hidden, path))
        raise


def _named(text, hidden, path):
    """A text with another name; whatever else an error has stays."""
    text = os.fspath(text) if isinstance(text, os.PathLike) else text
    return text.replace(str(hidden), str(path)) if isinstance(text, str) else text
