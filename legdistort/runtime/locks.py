"""Folders for unfinished work; the operating system frees the lock in each when a process ends, however it ends.

A hidden folder whose lock is free belongs to nobody any more: the next that works beside it removes it. Only a real
folder of this user, with the empty file of a lock in it, is taken for one; what else has such a name stays. No link is
followed.
"""

import os
import re
import shlex
import shutil
import stat
import time
import uuid
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

#: Name of the file that is locked, there as long as somebody works in its folder.
LOCK = ".legdistort.lock"
#: Between the name of a folder and 32 digits, the name of what it was before.
OLD = ".old-"
_TRIES = 10
_MOMENT = 0.2  # s, longer than one rename waits for the next
_HEX = re.compile("[0-9a-f]{32}")


def lock(folder):
    """The lock of a folder for unfinished work; None if another has it, be it another thread of this process."""
    held = FileLock(Path(folder) / LOCK, thread_local=False)
    try:
        held.acquire(timeout=0)
    except (Timeout, FileNotFoundError):
        return None
    return held


@contextmanager
def temporary_folder(parent, prefix, word=None):
    """A locked folder for this user alone that is gone when the block ends, however it ends.

    Parameters
    ----------
    parent : path
    prefix : str
        How its name begins. Folders of that prefix whose processes died are removed first.
    word : str, optional
        How its name ends, 32 hexadecimal digits; by default others each time.

    Yields
    ------
    Path

    Raises
    ------
    FileExistsError
        If another process works in the folder of this name.
    """
    remove_dead(parent, prefix)
    for _ in range(_TRIES):
        folder = Path(parent) / f"{prefix}{word or uuid.uuid4().hex}"
        folder.mkdir(0o700)
        held = lock(folder)
        if held is not None:  # else it was taken for a dead one as it was made
            break
    else:
        raise OSError(f"{folder} cannot be locked")
    try:
        yield folder
    finally:
        remove(folder)
        held.release()


def is_own_folder(folder):
    """Whether a path is that of a real folder of this user, not of a link to one."""
    try:
        found = os.lstat(folder)
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and (not hasattr(os, "getuid") or found.st_uid == os.getuid())


def remove_dead(parent, prefix):
    """Remove folders of a prefix that processes of this user left when they were killed."""
    for folder in _named(parent, prefix):
        with suppress(OSError):
            if not is_own_folder(folder):
                continue
            if not os.path.lexists(folder / LOCK):
                folder.rmdir()  # if it is empty its process died between two steps
                continue
            file = os.lstat(folder / LOCK)
            if stat.S_ISREG(file.st_mode) and file.st_size == 0 and (held := lock(folder)) is not None:
                remove(folder)
                held.release()


def _named(parent, prefix):
    """Paths in a folder whose names are a prefix and 32 hexadecimal digits."""
    names = os.listdir(parent) if os.path.isdir(parent) else []
    return [Path(parent) / n for n in sorted(names) if n.startswith(prefix) and _HEX.fullmatch(n, len(prefix))]


def remove(folder):
    """Remove a folder that is locked, the file of the lock last: it shows that the folder is ours."""
    with suppress(FileNotFoundError):
        for item in folder.iterdir():
            if item.is_dir() and not item.is_symlink():
                shutil.rmtree(item, ignore_errors=True)
            elif item.name != LOCK:
                with suppress(OSError):
                    item.unlink()
    shutil.rmtree(folder, ignore_errors=True)


def set_aside(place):
    """The folders ``NAME.old-...`` beside a place: what stood there, on its way out.

    Where a system cannot exchange two folders, a process that is killed between two renames leaves one, and no NAME.
    """
    place = Path(os.path.abspath(place))
    found = _named(place.parent, f"{place.name}{OLD}")
    return [folder for folder in found if folder.is_dir() and not folder.is_symlink()]


def way_back(path):
    """How a message goes on about a file or folder that is missing since its folder was set aside; else nothing."""
    path = Path(os.path.abspath(path))
    lost = next((each for each in (*reversed(path.parents), path) if not os.path.lexists(each)), path)
    if os.path.lexists(lost) or not (found := set_aside(lost)):
        return ""
    time.sleep(_MOMENT)
    if os.path.lexists(lost):  # the next rename came
        return ""
    line = shlex.join(["mv", str(found[-1]), str(lost)])
    return f"; {lost} was being replaced when its writer was stopped, and this brings it back: {line}"
