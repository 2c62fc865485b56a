"""Outputs appear under their name only when they are complete, and replace nothing unless asked."""

import os
import shutil
import tempfile
from contextlib import contextmanager
from errno import EDQUOT, ENOSPC
from pathlib import Path

from .exceptions import DiskFullError, InputError


def is_full(error):
    """Whether an `OSError` is that of a full disk; writers do not always hand the number of it on."""
    return error.errno in (ENOSPC, EDQUOT) or "space" in str(error) or "requested and" in str(error)


@contextmanager
def _told_when_full(path):
    try:
        yield
    except OSError as error:
        if not is_full(error):
            raise
        raise DiskFullError(
            f"No space left on the disk for {path}: nothing was replaced or left half-written; make room, or write "
            "elsewhere"
        ) from None


@contextmanager
def replacing(path, *, overwrite=False):
    """A temporary name beside `path` that becomes `path` when the block ends well.

    Parameters
    ----------
    path : str or path
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        If `path` is a folder, or exists and `overwrite` is false, or its folder does not exist.
    DiskFullError
        If the disk is full.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the name of a file")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists already; give overwrite=True (--overwrite) to replace it, or another name")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist; make it first")
    # the whole suffix is kept, since writers choose compression by it
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".partial-", suffix=f"-{path.name}")
    os.close(handle)
    os.unlink(temporary)  # some writers refuse an existing file
    try:
        with _told_when_full(path):
            yield Path(temporary)
            os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)


@contextmanager
def replacing_folder(out):
    """A temporary folder whose content moves into the folder `out` when the block ends well.

    What stands in `out` under other names stays.

    Parameters
    ----------
    out : str or path
        Made, with its parents, if it does not exist.

    Raises
    ------
    InputError
        If `out` is a file.
    DiskFullError
        If the disk is full.
    """
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; give a folder for the results")
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".partial-{out.name}-"))
    try:
        with _told_when_full(out):
            yield temporary
            out.mkdir(exist_ok=True)
            for item in temporary.iterdir():
                target = out / item.name
                if target.is_dir() and not target.is_symlink():
                    shutil.rmtree(target)
                elif item.is_dir():
                    target.unlink(missing_ok=True)
                item.replace(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
