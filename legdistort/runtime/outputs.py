"""Outputs appear under their name only when they are complete, and replace nothing unless asked.

Libraries that write are handed open files, never paths: some take parts of a path for those of a URL, or for a home
folder, and would write elsewhere.
"""

import os
import shutil
import tempfile
import uuid
from contextlib import contextmanager
from errno import EDQUOT, ENOSPC
from pathlib import Path

from ..exceptions import DiskFullError, InputError


def is_full(error):
    """Whether an `OSError` is that of a full disk; writers do not always hand the number of it on."""
    return error.errno in (ENOSPC, EDQUOT) or "space" in str(error) or "requested and" in str(error)


def check_file(path, *, overwrite=False):
    """Refuse a file that could not be written, before the work for it begins.

    Raises
    ------
    InputError
        If `path` is a folder, or exists and `overwrite` is false, or its folder does not exist or cannot be written.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the name of a file")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists already; give overwrite=True (--overwrite) to replace it, or another name")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist; make it first")
    _check_permission(path, path.parent)


def check_folder(out):
    """Refuse a folder that could not be made or filled, before the work for it begins.

    Raises
    ------
    InputError
        If `out` is a file, or cannot be written.
    """
    out = Path(out)
    existing = next(place for place in (out, *out.absolute().parents) if place.exists())
    if not existing.is_dir():
        raise InputError(f"{existing} is a file; give a folder for the results")
    _check_permission(out, existing)


def _check_permission(path, folder):
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path} cannot be written: no permission in {folder}; write elsewhere")


def check_not_read(path, inputs):
    """Refuse to replace what the output is made from.

    Parameters
    ----------
    path : str or path
        File or folder that will be replaced.
    inputs : sequence of str or path
        What is read. Words that name no file are left alone.

    Raises
    ------
    InputError
        If one of them is `path`, by whatever name or link, or lies in it.
    """
    path = Path(path)
    if not path.exists():
        return
    for each in filter(os.path.exists, inputs):
        if path.samefile(each) or path.resolve() in Path(each).resolve().parents:
            raise InputError(f"{each} is read, and would be replaced: give the output another name")


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
    """An open binary file, to be written, that becomes `path` when the block ends well.

    Parameters
    ----------
    path : str or path
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        As `check_file` does.
    DiskFullError
        If the disk is full.
    """
    path = Path(path)
    check_file(path, overwrite=overwrite)
    # a name of its own, since a long one would become too long; absolute, since asdf takes ~x for somebody's home
    temporary = path.absolute().with_name(f".partial-{uuid.uuid4().hex}")
    try:
        with _told_when_full(path):
            with temporary.open("wb") as file:
                yield file
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


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
        As `check_folder` does.
    DiskFullError
        If the disk is full.
    """
    out = Path(out)
    check_folder(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=out.parent, prefix=".partial-"))
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
