"""Outputs appear under their name only when they are complete, and replace nothing unless asked.

A file is written in a hidden folder beside its place, ``.partial-...``, and renamed. A folder is completed beside its
place too, and exchanged for the one that is there, in one step where the system can. Files among those of others take
their places one by one (`replacing_files`); those that were there are kept in ``.replaced-...`` until the last has.

Nothing that lies in a folder says what is to be done: readers change nothing on the disk, and writers remove only
hidden folders of dead processes (`locks.remove_dead`). What a process leaves that is killed is told by the next.

Libraries that write are handed open files, never paths: some take parts of a path for those of a URL, or for a home
folder, and would write elsewhere.
"""

import ctypes
import hashlib
import json
import logging
import os
import shlex
import shutil
import stat
import uuid
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath

from ..exceptions import InputError, LegdistortError, some_of
from . import locks
from .disk_errors import errors_name
from .provenance import SUMMARY, checksum_of, files_of_run

log = logging.getLogger(__name__)

_PARTIAL, _KEPT = ".partial-", ".replaced-"
_NAMED = 3  # files in a message
_EXCHANGE, _CWD = 2, -100  # RENAME_EXCHANGE and AT_FDCWD of Linux


def check_file(path, *, overwrite=False):
    """Refuse a file that could not be written, before the work for it begins.

    Raises
    ------
    InputError
        If `path` is a folder, a device or a pipe, or exists and `overwrite` is false, or its folder cannot be made or
        written.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a folder; give the name of a file")
    if path.exists() and not path.is_file():  # it would be replaced, not written to
        raise InputError(f"{path} is a device or a pipe; give the name of a file")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists already; give overwrite=True (--overwrite) to replace it, or another name")
    _check_permission(path, _existing_folder(path.absolute().parent))


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
    path = Path(path)
    folder = next(place for place in (path, *path.absolute().parents) if place.is_dir())
    try:
        with locks.temporary_folder(folder, _PARTIAL) as trial:
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
    _check_permission(out, _existing_folder(out))


def _existing_folder(folder):
    """A folder, or the nearest above it that exists."""
    existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not existing.is_dir():
        raise InputError(f"{existing} is a file; give a folder for the results")
    return existing


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
        Its folder is made, with its parents, if it does not exist.
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
    with _made(place.parent), locks.temporary_folder(place.parent, _PARTIAL) as folder:
        temporary = folder / "file"  # since a long name would become too long
        with _written(temporary, path) as file:
            yield file
        with errors_name(path, temporary):
            os.replace(temporary, place)
        _sync(place.parent)


@contextmanager
def _written(temporary, path):
    """An open file that is on the disk when the block ends; errors name the path that it will have."""
    with errors_name(path, temporary), temporary.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


# -- folders


@contextmanager
def replacing_folder(out, *, results=(), overwrite=True, keep=True):
    """A temporary folder that takes the place of the folder `out`, all or nothing, when the block ends well.

    As long as the block runs, `out` is locked against other writers. What stands in it under other names is moved
    along.

    Parameters
    ----------
    out : str or path
        Made, with its parents, if it does not exist. A link is followed.
    results : sequence of str
        Patterns of names in `out`: files of earlier results, which go. Of those in a ``summary.json`` with a list of
        its files, only these.
    overwrite : bool
        Replace files of the same names.
    keep : bool
        Other files in `out` are moved along; False: they are refused, those apart whose names begin with a dot.

    Yields
    ------
    Path

    Raises
    ------
    InputError
        As `check_folder` does; if another process writes there; if there are other files; if results lie in a folder
        that cannot be exchanged for another; if a folder stands in the place of a file, or the reverse; if a file
        exists that is not to be replaced.
    DiskFullError
        If the disk is full.
    """
    out = Path(out)
    check_folder(out)
    place = Path(os.path.realpath(out))
    fixed = _why_not_exchanged(place)
    with errors_name(out, place), _made(place.parent), ExitStack() as stack:
        work = None if fixed else stack.enter_context(_work_folder(place.parent, place.name, out))
        _bring_back(place)
        held = stack.enter_context(ExitStack())
        if place.is_dir():
            inside = held.enter_context(_work_folder(place, "", out))
            _check_content(place, out, results, keep, fixed)
        new = (work or inside) / "new"
        new.mkdir()
        with errors_name(out, new):
            yield new
            _check_places(new, place, out, overwrite)
            for path in (*new.rglob("*"), new):  # on the disk, and not in the memory of the system only
                _sync(path)
            if fixed:
                names = sorted(_items(new), key=lambda name: (name == SUMMARY, name))
                _move_all({place / name: new / name for name in names})
            elif place.is_dir():
                if os.name == "nt":  # Windows renames no folder in which a file is open
                    held.close()
                _take_the_place(new, place, _results(place, results))
            else:
                os.rename(new, place)
            _sync(place.parent)


@contextmanager
def _work_folder(parent, name, out):
    """A locked folder for a place of some name in another folder: who wants the same place wants the same one.

    Without a name it is for the folder that it is in, which is locked so against other writers.
    """
    word = hashlib.sha256(os.fsencode(name)).hexdigest()[:32]
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(locks.temporary_folder(parent, _PARTIAL, word))
        except FileExistsError as error:
            raise InputError(
                f"another process is writing in {out}: wait until it has ended, or give another folder (if there is "
                f"none, remove {error.filename})"
            ) from None
        yield folder


@contextmanager
def _made(*folders):
    """Make folders, and those above them; those that are empty after an error go again."""
    new = {place for folder in folders for place in (folder, *folder.parents) if not place.exists()}
    try:
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for folder in sorted(new, reverse=True):  # what is in a folder before the folder
            with suppress(OSError):
                folder.rmdir()
        raise


def _why_not_exchanged(place):
    """Why a folder cannot give way to another one of its name; None if it can, or does not exist."""
    if not place.is_dir():
        return None
    with suppress(FileNotFoundError):  # the folder that is worked in may be gone
        here = Path(os.path.realpath("."))
        if place in (here, *here.parents):
            return "this command works in it (call it from elsewhere)"
    if os.path.ismount(place):
        return "it is the top of a disk"
    above, own = place.parent, place.stat().st_uid
    if not os.access(above, os.W_OK | os.X_OK):
        return f"{above} cannot be written"
    if above.stat().st_mode & stat.S_ISVTX and os.geteuid() not in (0, own, above.stat().st_uid):
        return "it belongs to another user"
    return None


def _bring_back(place):
    """Rename the results of a place back that were set aside when a process was killed; name what else is there."""
    aside = locks.set_aside(place)
    ours = [folder for folder in aside if locks.is_own_folder(folder) and files_of_run(folder) is not None]
    if not place.exists() and len(ours) == 1:
        os.rename(ours[0], place)
        log.warning("%s was brought back: its writer had been stopped as it replaced it", place)
    elif aside:
        log.warning("%s may be what %s was earlier; look into it, and remove it", aside[-1], place)


def _items(folder):
    """Names in a folder and those below it of all but folders with something in them; links are not followed."""
    found = []
    for root, folders, files in os.walk(folder, onerror=_refuse_unreadable):
        links = [name for name in folders if os.path.islink(os.path.join(root, name))]
        empty = [""] if root != str(folder) and not files and not folders else []
        found += [Path(root, name).relative_to(folder).as_posix() for name in files + links + empty]
    own = _PARTIAL + hashlib.sha256(b"").hexdigest()[:32]
    return {name for name in found if not name.startswith(own)}


def _refuse_unreadable(error):
    raise InputError(f"{error.filename} cannot be read ({error.strerror}): move it away, or write elsewhere") from None


def _results(place, patterns):
    """Names in a folder that are those of earlier results: of its summary, if there is one that lists them."""
    known = {path.relative_to(place).as_posix() for pattern in patterns for path in place.glob(pattern)}
    known, listed = known | {Path(pattern).parts[0] for pattern in patterns if "/" in pattern}, files_of_run(place)
    return known if listed is None else known & {SUMMARY, *listed, *(name.partition("/")[0] for name in listed)}


def _check_content(place, out, patterns, keep, fixed):
    """Refuse a folder whose content cannot give way, or is not to be moved along."""
    names, results = _items(place), _results(place, patterns)
    if fixed:
        _check_unfinished(place)
    if fixed and (there := sorted(names & results)):
        raise InputError(
            f"{out} already holds {some_of(there, _NAMED)}, and cannot be replaced as a whole, since {fixed}: give a "
            f"folder in it, such as {out / 'results'}, or remove these first"
        )
    others = sorted(names - results)
    visible = [name for name in others if not any(part.startswith(".") for part in PurePosixPath(name).parts)]
    if visible and not keep:
        raise InputError(
            f"{out} holds what is not of an earlier run, {some_of(visible, _NAMED)}: move it away, give another "
            "folder, or keep=True (--keep) to keep it there"
        )
    for folder in {above for name in others for above in (place / name).parents if place in above.parents}:
        if os.path.ismount(folder) and not fixed:
            raise InputError(f"{folder} is the top of a disk, which cannot be moved along: give another folder")


def _check_places(new, place, out, overwrite):
    """Refuse what cannot be put in its place."""
    for item in sorted(new.rglob("*")):
        name = item.relative_to(new)
        target = place / name
        if os.path.lexists(target):
            was_folder = target.is_dir() and not target.is_symlink()
            if item.is_dir() != was_folder:
                there, wanted = ("a folder", "a file") if was_folder else ("a file or a link", "a folder")
                raise InputError(f"{out / name} is {there}, in the place of {wanted}: move it away, or write elsewhere")
            if not item.is_dir() and not overwrite:
                raise InputError(f"{out / name} exists already; give --overwrite to replace it, or another folder")


def _take_the_place(new, place, results):
    """Put a folder in the place of another one, of which all but the earlier results stays; that is `new` then."""
    with suppress(OSError, AttributeError):  # Windows has no groups
        os.chown(new, -1, place.stat().st_gid)
    shutil.copymode(place, new)
    names = _items(place)
    for name in sorted(names - results):
        _keep(place, new, name)
    for folder, *_ in os.walk(new):
        _sync(Path(folder))
    aside = place.with_name(f"{place.name}{locks.OLD}{uuid.uuid4().hex}")
    if not exchange(new, place):
        os.rename(place, aside)  # from here to the next line it is there alone
        try:
            os.rename(new, place)
        except BaseException:
            os.rename(aside, place)
            raise
        os.rename(aside, new)
    if late := sorted(_items(new) - names):
        os.rename(new, aside)
        log.warning("%s was put into %s as it was replaced: it lies in %s", late[0], place, aside)


def _keep(place, new, name):
    """Have something of a folder in another one too, unless it has another of this name."""
    for folder in reversed(PurePosixPath(name).parents):
        if not (new / folder).is_dir():
            (new / folder).mkdir()
            shutil.copymode(place / folder, new / folder)
    if (place / name).is_dir() and not (place / name).is_symlink():
        (new / name).mkdir(exist_ok=True)
    elif not os.path.lexists(new / name):
        _link(place / name, new / name)


def _link(path, other):
    """Give a file another name; a copy where the disk has no such links."""
    try:
        os.link(path, other, follow_symlinks=False)
    except OSError:
        shutil.copy2(path, other, follow_symlinks=False)
        _sync(other)


def exchange(one, other):
    """Exchange two folders in one step; whether that was done, which not all systems can."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):  # not on Linux
        return False
    return rename(_CWD, os.fsencode(one), _CWD, os.fsencode(other), _EXCHANGE) == 0


# -- files among those of others


@contextmanager
def replacing_files(targets):
    """Files to be written that replace others, all or none, when the block ends well.

    If an error comes between one and the next, the former files come back. If the process is killed there, they lie in
    ``.replaced-...`` in their folder, which the next call says and leaves alone.

    Parameters
    ----------
    targets : sequence of path
        In whatever folders.

    Yields
    ------
    callable
        Of one of the targets, gives an open binary file as a context.

    Raises
    ------
    InputError
        If a folder cannot be written, another process writes there, or one was killed on the way.
    DiskFullError
        If the disk is full.
    LegdistortError
        If a disk fails, and then fails again as former files are put back; names where they are.
    """
    with ExitStack() as stack:
        temporary = {}
        for folder in dict.fromkeys(target.parent for target in targets):
            check_folder(folder)
            stack.enter_context(errors_name(folder, folder))
            work = stack.enter_context(_work_folder(folder, "", folder))
            _check_unfinished(folder)
            own = [target for target in targets if target.parent == folder]
            temporary |= {target: work / str(number) for number, target in enumerate(own)}
        yield lambda target: _written(temporary[target], target)
        _move_all(temporary)


def _check_unfinished(folder):
    """Refuse a folder in which files were replaced one by one until a process was killed."""
    if kept := [each for each in sorted(folder.glob(f"{_KEPT}*")) if _holds_others(each)]:
        names = [shlex.quote(str(each)) for each in kept]
        line = " && ".join(f"mv -f {name}/* {shlex.quote(str(folder))}/ && rmdir {name}" for name in names)
        raise InputError(
            f"{kept[0]} holds files as they were before a command replaced them that was stopped on the way; this "
            f"brings them back: {line}; or remove it, if the new ones are all there, or no command of yours was stopped"
        )


def _holds_others(kept):
    """Whether former files are kept that are not in their places; if none is, an own folder for them goes."""
    if locks.is_own_folder(kept):
        for copy in kept.iterdir():
            with suppress(OSError):
                if copy.samefile(kept.parent / copy.name):
                    copy.unlink()  # another name of the same file
        with suppress(OSError):
            kept.rmdir()
    return kept.is_dir() and not kept.is_symlink()


def _move_all(sources):
    """Rename files, ``{target: file}``, all or none; former ones are kept beside until the last is in its place."""
    word = f"{_KEPT}{uuid.uuid4().hex}"
    former = [target for target in sources if os.path.lexists(target)]
    places = {target.parent / word: sources[target].parent / word for target in former}
    folders = {target.parent for target in sources}
    with _made(*folders):
        try:
            for hidden in places.values():
                hidden.mkdir(0o700)
            for target in former:
                _link(target, sources[target].parent / word / target.name)
            for kept, hidden in places.items():
                _sync(hidden)
                os.rename(hidden, kept)
                _sync(kept.parent)
            for target, source in sources.items():
                os.replace(source, target)
            for folder in folders:
                _sync(folder)
        except BaseException as error:
            _put_back(sources, former, word, error)  # if that fails, the former files are kept
            _finish(places)
            raise
        _finish(places)


def _finish(places):
    """Take away what was kept, for every folder in one step."""
    for kept, hidden in places.items():
        try:
            os.rename(kept, hidden)
        except OSError:
            shutil.rmtree(kept, ignore_errors=True)
            if kept.exists():
                log.warning("the files before those written could not be removed: remove %s", kept)


def _put_back(sources, former, word, error):
    """Have former files in their places again, where others were moved to."""
    moved = [target for target, source in sources.items() if not os.path.lexists(source)]
    try:
        for target in moved:
            if target in former:
                os.replace(target.parent / word / target.name, target)
            else:
                target.unlink(missing_ok=True)
    except OSError as fault:
        raise LegdistortError(
            f"files in {target.parent} were replaced in part ({error}), and the former ones could not be put back "
            f"({fault}): once the disk works the same command names the line that brings them back"
        ) from error


# -- what is there


def contents(folder):
    """``{name: SHA-256}`` of the files in a folder and those below it, without what could not be removed."""
    files = {path.relative_to(folder).as_posix(): path for path in sorted(Path(folder).rglob("*")) if path.is_file()}
    return {name: checksum_of(path) for name, path in files.items() if f"/{_PARTIAL}" not in f"/{name}"}


def listed_files(folder):
    """The entries of a summary on the files beside it: an identifier of the run, and ``{name: SHA-256}``.

    A file with another checksum shows a program that results of two runs are mixed there.
    """
    return {"run": uuid.uuid4().hex, "files": contents(folder)}


def write_summary(path, summary):
    """Write figures as JSON, in the place of those that are there."""
    with replacing(path, overwrite=True) as file:
        file.write(f"{json.dumps(summary, indent=1)}\n".encode())


def _sync(path):
    """Have a file, or the names in a folder, on the disk."""
    if os.name != "nt" or path.is_file():  # folders cannot be opened on Windows
        with suppress(FileNotFoundError, PermissionError):
            descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
