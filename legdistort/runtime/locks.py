"""Locks of folders, and folders for unfinished work; the operating system lets go when a process ends, however it ends.

Whatever is unfinished lies in a folder that holds a lock. One whose lock is free belongs to nobody any more: the next
that works beside it removes it. What has no lock file is not ours and stays.
"""

import os
import re
import shutil
import uuid
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

#: Name of the file that is locked, there as long as somebody works in its folder.
LOCK = ".legdistort.lock"
_TRIES = 10
_HEX = re.compile("[0-9a-f]{32}")


def lock(folder):
    """The lock of a folder; None if another has it, be it another thread of this process."""
    held = FileLock(Path(folder) / LOCK, thread_local=False)
    try:
        held.acquire(timeout=0)
    except (Timeout, FileNotFoundError):
        return None
    return held


def release(held, folder):
    """Let go of a lock, and remove its file from the folder, which may have another name by now.

    Who opened the file meanwhile finds it removed once he has the lock, and asks again: `filelock` sees to that.
    """
    with suppress(OSError):  # Windows removes no open file
        (Path(folder) / LOCK).unlink(missing_ok=True)
    held.release()


def before_renaming(held):
    """To be called before a folder is renamed in which a file is locked: Windows would refuse it."""
    if os.name == "nt":
        held.release()


def make_locked(folder, mode=0o777):
    """Make a folder and lock it; None if it is there already, or was taken for a dead one as it was made."""
    try:
        folder.mkdir(mode)
    except FileExistsError:
        return None
    return lock(folder)


@contextmanager
def temporary_folder(parent, prefix, mode=0o777):
    """A folder of its own, locked, that is gone when the block ends, however it ends.

    Parameters
    ----------
    parent : path
    prefix : str
        How its name begins. Folders of that prefix whose processes died are removed first.
    mode : int
        Permissions, less the umask.

    Yields
    ------
    Path
    FileLock
        See `before_renaming`.
    """
    remove_dead(parent, prefix)
    for _ in range(_TRIES):
        folder = Path(parent) / f"{prefix}{uuid.uuid4().hex}"
        held = make_locked(folder, mode)
        if held is not None:
            break
    else:
        raise OSError(f"{folder} cannot be locked")
    try:
        yield folder, held
    finally:
        remove(folder)
        held.release()


def remove_dead(parent, prefix):
    """Remove folders of a prefix that processes of this user left when they were killed."""
    with os.scandir(parent) as items:
        candidates = [Path(item.path) for item in items if item.name.startswith(prefix)]
    for folder in candidates:
        with suppress(OSError):
            theirs = hasattr(os, "getuid") and folder.lstat().st_uid != os.getuid()
            if theirs or folder.is_symlink():
                continue
            if not (folder / LOCK).is_file():
                if _HEX.fullmatch(folder.name, len(prefix)):
                    folder.rmdir()  # if it is empty, ours is the name: its process died between two steps
                continue
            held = lock(folder)
            if held is not None:
                remove(folder)
                held.release()


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
