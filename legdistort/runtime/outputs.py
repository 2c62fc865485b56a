"""Outputs appear under their name only when they are complete, and replace nothing unless asked.

A file is written in a hidden folder beside its place, and renamed. So is a folder that is new. The files of a folder
that is there already are completed in a hidden folder inside it, ``.partial-RUN``, which becomes ``.commit-RUN``; from
then on they are its content, and are moved to their places one by one. If that is interrupted, whatever of this package
opens the folder next goes on with it (`settle`).

An empty folder is not replaced by a new one: it may be the top of a disk, where somebody works just now, or have
permissions of its own.

Libraries that write are handed open files, never paths: some take parts of a path for those of a URL, or for a home
folder, and would write elsewhere.
"""

import hashlib
import json
import os
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ..exceptions import InputError, LegdistortError
from . import locks
from .disk_errors import told_when_full
from .provenance import checksum

_PARTIAL, _COMMIT = ".partial-", ".commit-"
#: What a commit removes, beside its files.
_PLAN = ".legdistort.json"
_OURS = (locks.LOCK, _PLAN)


def check_file(path, *, overwrite=False):
    """Refuse a file that could not be written, before the work for it begins.

    Raises
    ------
    InputError
        If `path` is a folder, a device or a pipe, or exists and `overwrite` is false, or its folder does not exist or
        cannot be written.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the name of a file")
    if path.exists() and not path.is_file():  # it would be replaced, not written to
        raise InputError(f"{path} is a device or a pipe; give the name of a file")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists already; give overwrite=True (--overwrite) to replace it, or another name")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist; make it first")
    _check_permission(path, path.parent)


def check_ending(path, endings):
    """Raise `InputError` if the ending of a name, in whatever case, selects none of the formats."""
    if Path(path).suffix.lower() not in endings:
        raise InputError(f"{path}: the ending selects the format, give {' or '.join(endings)}")


def try_to_write(path):
    """Make, write and rename a file where an output will be made; permissions alone do not prove that it can be.

    Raises
    ------
    InputError
        If that fails.
    """
    folder = next(place for place in Path(path).absolute().parents if place.is_dir())
    folder = Path(path) if Path(path).is_dir() else folder
    try:
        with locks.temporary_folder(folder, _PARTIAL) as (trial, _):
            (trial / "file").write_bytes(b"0")
            os.replace(trial / "file", trial / "renamed")
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}; write elsewhere") from None


def check_folder(out):
    """Refuse a folder that could not be made or filled, before the work for it begins.

    Raises
    ------
    InputError
        If `out` is no path or a file, or cannot be written.
    """
    if not isinstance(out, (str, os.PathLike)):
        raise InputError(f"out must be a path, that of the folder for the results, got {out!r}")
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
    place = path.absolute()  # since asdf takes ~x for somebody's home
    settle(place.parent)
    with told_when_full(path, place.parent), locks.temporary_folder(place.parent, _PARTIAL) as (folder, _):
        temporary = folder / "file"  # since a long name would become too long
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, place)
        _sync(place.parent)


@contextmanager
def replacing_folder(out, *, former=(), overwrite=True):
    """A temporary folder whose content moves into the folder `out`, all or nothing, when the block ends well.

    What stands in `out` under other names stays. As long as the block runs, `out` is locked against other writers.

    Parameters
    ----------
    out : str or path
        Made, with its parents, if it does not exist.
    former : sequence of str
        Patterns of names in `out`; files of earlier results that have no successor are removed. Of those in a
        ``summary.json`` with a list of its files, only these.
    overwrite : bool
        Replace files that exist.

    Yields
    ------
    Path
        The name of the folder ends in a word of its own.

    Raises
    ------
    InputError
        As `check_folder` does; if another process writes there; if a folder stands in the place of a file, or the
        reverse; if a file exists that is not to be replaced.
    DiskFullError
        If the disk is full.
    """
    out = Path(out)
    check_folder(out)
    place = out.absolute()
    with told_when_full(out, place):
        if place.exists():
            with _locked(place, out):
                _settle(place)
                with locks.temporary_folder(place, _PARTIAL) as (folder, held):
                    yield folder
                    locks.before_renaming(held)
                    _commit(folder, place, former, overwrite)
        else:
            with _new_parents(place), _new_folder(place, out) as folder:
                yield folder


@contextmanager
def replacing_folders(outs):
    """`replacing_folder` of several folders at once; none changes unless the block ends well.

    Parameters
    ----------
    outs : sequence of path

    Yields
    ------
    dict
        The temporary folder of each.

    Raises
    ------
    LegdistortError
        As `replacing_folder` does. If a disk fails between one and the next, the error names those that have changed.
    """
    done = []
    try:
        with ExitStack() as stack:
            folders = {}
            for out in outs:
                stack.push(lambda kind, *_, out=out: done.append(str(out)) if kind is None else None)
                folders[out] = stack.enter_context(replacing_folder(out))
            yield folders
    except (LegdistortError, OSError) as error:
        if not done:
            raise
        raise LegdistortError(
            f"all of the files in {', '.join(done)} were replaced, and none of the others: {error}"
        ) from error


@contextmanager
def _locked(place, out):
    held = locks.lock(place)
    if held is None:
        raise InputError(f"another process is writing in {out}: wait until it has ended, or give another folder")
    try:
        yield
    finally:
        locks.release(held, place)


@contextmanager
def _new_parents(place):
    """Make the folders above a place; those that are empty after an error go again."""
    made = [folder for folder in place.parents if not folder.exists()]
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()
        raise


@contextmanager
def _new_folder(place, out):
    """A folder beside a place that is renamed to it; two processes that want the same place want the same one."""
    locks.remove_dead(place.parent, _PARTIAL)
    folder = place.with_name(_PARTIAL + hashlib.sha256(os.fsencode(place.name)).hexdigest()[:32])
    held = locks.make_locked(folder)
    if held is None:
        raise InputError(
            f"another process is writing {out}: wait until it has ended, or give another folder (if there is none, "
            f"remove {folder})"
        )
    where = folder
    try:
        yield folder
        _sync_tree(folder)
        locks.before_renaming(held)
        try:
            os.rename(folder, place)
        except OSError as error:
            if not os.path.lexists(place):
                raise
            raise InputError(f"{out} was made by another process meanwhile ({error.strerror}): give another") from None
        where = place
        _sync(place.parent)
    finally:
        if where is folder:
            locks.remove(folder)
        locks.release(held, where)


def contents(folder):
    """``{name: SHA-256}`` of the files in a folder and those below it."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        if path.is_file() and path.name not in _OURS:
            with path.open("rb") as file:
                found[path.relative_to(folder).as_posix()] = checksum(file)
    return found


def settle(*folders):
    """Put in order what was interrupted in folders: finish a commit, remove what is incomplete.

    Raises
    ------
    InputError
        If a commit cannot be finished.
    """
    for folder in map(Path, folders):
        if folder.is_dir() and os.access(folder, os.R_OK):
            names = {name[: len(start)] for name in os.listdir(folder) for start in (_PARTIAL, _COMMIT)}
            if _PARTIAL in names and os.access(folder, os.W_OK):
                locks.remove_dead(folder, _PARTIAL)
            if _COMMIT in names:
                _settle_locked(folder)


def settle_for(*paths):
    """The same for the folders in which files lie that are about to be read, and those above them."""
    parents = [Path(path).absolute().parent for path in paths]
    settle(*dict.fromkeys(folder for parent in parents for folder in (parent, parent.parent)))


def _settle_locked(folder):
    """Finish commits, unless the one who made them is about to do it."""
    try:
        held = locks.lock(folder)
        if held is not None:
            try:
                _settle(folder)
            finally:
                locks.release(held, folder)
    except OSError as error:
        raise InputError(
            f"{folder} holds a complete result whose files are not all in their places, since its writer was stopped; "
            f"they cannot be moved now ({error.strerror or error}): read it as a user who may write there"
        ) from None


def _settle(folder):
    locks.remove_dead(folder, _PARTIAL)
    for commit in sorted(folder.glob(f"{_COMMIT}*")):
        if (commit / _PLAN).is_file():
            _finish(commit, folder)
    locks.remove_dead(folder, _COMMIT)  # those that are finished but for their removal


def _commit(folder, place, former, overwrite):
    """Make the content of a folder that of the place around it."""
    items = [item.relative_to(folder) for item in sorted(folder.rglob("*")) if item.name not in _OURS]
    _check_places(folder, place, items, overwrite)
    files = {item.as_posix() for item in items}
    plan = {"remove": [name for name in former_files(place, former) if name not in files]}
    (folder / _PLAN).write_text(json.dumps(plan), encoding="utf-8")
    _sync_tree(folder)
    commit = folder.with_name(_COMMIT + folder.name.removeprefix(_PARTIAL))
    os.rename(folder, commit)
    _sync(place)
    try:
        _finish(commit, place)
    except OSError as error:
        raise LegdistortError(
            f"the results for {place} are complete, but lie in {commit} in part, since moving them to their places "
            f"failed ({error.strerror or error}): the next command that reads or writes there goes on with it"
        ) from error


def _check_places(folder, place, items, overwrite):
    """Refuse what could not be moved once it is decided: then there is no way back."""
    for item in items:
        target = place / item
        if not overwrite and target.is_file():
            raise InputError(f"{target} exists already; give --overwrite to replace it, or another folder")
        if target.is_dir() and not (folder / item).is_dir():
            raise InputError(f"{target} is a folder, in the place of a file: move it away, or write elsewhere")
        if (folder / item).is_dir() and os.path.lexists(target):
            if not target.is_dir():
                raise InputError(f"{target} is a file, in the place of a folder: move it away, or write elsewhere")
            if target.stat().st_dev != place.stat().st_dev or not os.access(target, os.W_OK):
                raise InputError(f"{target} is on another disk or cannot be written: move it away, or write elsewhere")


def former_files(place, patterns):
    """Names of the files of earlier results in a folder: of those with their names the ones that its summary lists.

    Parameters
    ----------
    place : path
    patterns : sequence of str

    Returns
    -------
    list of str
        All that have such names where there is no summary, or one of a version that does not list its files.
    """
    found = [path for pattern in patterns for path in place.glob(pattern) if not path.is_dir()]
    names = [path.relative_to(place).as_posix() for path in found]
    try:
        listed = {"summary.json", *json.loads((place / "summary.json").read_text(encoding="utf-8"))["files"]}
    except (OSError, ValueError, KeyError, TypeError):
        return names
    return [name for name in names if name in listed]


def _finish(commit, place):
    """Move the files of a commit to their places; what was moved before, by whomever, is not there any more."""
    remove = json.loads((commit / _PLAN).read_text(encoding="utf-8"))["remove"]
    folders = {place}
    for item in sorted(commit.rglob("*")):
        target = place / item.relative_to(commit)
        if item.is_dir():
            target.mkdir(exist_ok=True)
        elif item.name not in _OURS:
            os.replace(item, target)
        folders.add(target.parent)
    for name in remove:
        (place / name).unlink(missing_ok=True)
        if "/" in name:
            with suppress(OSError):  # others stand in it
                (place / name).parent.rmdir()
    for folder in folders:
        _sync(folder)
    (commit / _PLAN).unlink()
    locks.remove(commit)


def _sync_tree(folder):
    """Have a folder with all that is in it on the disk, and not in the memory of the system only."""
    for path in folder.rglob("*"):
        _sync(path)
    _sync(folder)


def _sync(path):
    if os.name != "nt" or path.is_file():  # folders cannot be opened on Windows
        with suppress(FileNotFoundError, PermissionError):
            descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
