"""What somebody else has put into a folder, or beside it, is data: nothing outside the folder that was given changes.

Each attack is a folder as it may come by mail, with something in it that is to mislead who reads or writes there.
Around it lie the victim's files, whose whole tree is compared: names, contents, links and inodes.
"""

import hashlib
import json
import os
import shutil
import time
from contextlib import suppress

import pytest

import legdistort as ld
from legdistort import pipeline
from legdistort.cli import main
from legdistort.demo import run_demo
from legdistort.exceptions import InputError
from legdistort.inputs.table_files import read_table, write_table
from legdistort.measurement.earlier import EarlierRun
from legdistort.measurement.effective.sources import psf_from
from legdistort.pipeline import RESULTS
from legdistort.runtime import locks, outputs

WORD = "0123456789abcdef" * 2
NOBODY = 65534


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """A folder of results, made once."""
    folder = tmp_path_factory.mktemp("solved") / "results"
    folder.mkdir()
    matches = ld.simulate_matches(n_stars=12, n_exposures=4, degree=1, shape=(100, 100), dither=5.0, seed=1).matches
    solution = ld.solve(matches, degree=1)
    pipeline.write_results(solution, folder)
    write_table(matches.table, folder / "detections.ecsv")
    outputs.write_summary(folder / "summary.json", outputs.listed_files(folder))
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Frames and tables that commands take."""
    folder = tmp_path_factory.mktemp("made")
    main(["simulate", "--small", "--out", str(folder / "frames"), "--quiet"])
    frames = [str(path) for path in sorted((folder / "frames").glob("exp*.fits"))]
    main(["measure", *frames, "--psf", "moffat", "--out", str(folder / "stars.ecsv"), "--quiet"])
    main(["match", str(folder / "stars.ecsv"), "--out", str(folder / "matched.ecsv"), "--quiet"])
    main(["solve", str(folder / "matched.ecsv"), "--degree", "1", "--out", str(folder / "results"), "--quiet"])
    return folder


@pytest.fixture
def around(solved, tmp_path):
    """``got``, which was received, with a solution, and beside it what belongs to the victim."""
    shutil.copytree(solved, tmp_path / "got")
    for name in ("victim/thesis.txt", "victim/keys", "victim/wcs/keys", "other/file", "loose"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"ten years of {name}")
    (tmp_path / "victim" / "empty").touch()
    return tmp_path


def tree(folder):
    """All that there is below a folder but ``got``, and what it is."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if name.parts[0] != "got":
            stat = path.lstat()
            content = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
            found[str(name)] = stat.st_ino, stat.st_mode, stat.st_uid, stat.st_nlink, stat.st_mtime_ns, content
    return found


# --- attacks: each gets the folder around ``got``, and puts something into it or beside it ---------------------------


def plan(folder, remove=(), files=()):
    """A commit as versions before had it, with what it removes and writes."""
    commit = folder / f".commit-{WORD}"
    commit.mkdir()
    (commit / ".legdistort.json").write_text(json.dumps({"remove": [str(name) for name in remove]}))
    (commit / locks.LOCK).touch()
    for name in files:
        (commit / name).parent.mkdir(exist_ok=True, parents=True)
        (commit / name).write_text("attacker's")
    return commit


def link_in_place_of(path, target):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(target)


def hidden(folder, name, *, lock=None):
    """A hidden folder with the lock of a dead process in it, or a link to something in its place."""
    (folder / name).mkdir(parents=True)
    if lock is None:
        (folder / name / locks.LOCK).touch()
    else:
        (folder / name / locks.LOCK).symlink_to(lock)
    return folder / name


def listed(folder, *names):
    summary = json.loads((folder / "summary.json").read_text())
    summary["files"] |= dict.fromkeys(names, "0" * 64)
    (folder / "summary.json").write_text(json.dumps(summary))


def of_another(folder):
    """A folder that belongs to somebody else, who then is no other one where the tests do not run as root."""
    if os.geteuid() == 0:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, NOBODY, NOBODY)
    else:
        shutil.rmtree(folder)


def beside(around):
    """Where a writer works for the folder ``got``."""
    return around / f".partial-{hashlib.sha256(b'got').hexdigest()[:32]}"


def aside(around):
    """Where the folder ``got`` would lie, were it replaced just now; it is missing."""
    shutil.move(around / "got", around / "saved")
    return around / f"got.old-{WORD}"


def through_a_link(around):
    link_in_place_of(around / "got" / "wcs", around / "victim")
    plan(around / "got", files=["wcs/keys"])


def lock_is_a_hard_link(around):
    folder = around / "got" / f".partial-{WORD}"
    folder.mkdir()
    os.link(around / "victim" / "keys", folder / locks.LOCK)


def dead_folder_with_links(around):
    folder = hidden(around / "got", f".partial-{WORD}")
    (folder / "new").symlink_to(around / "victim")
    (folder / "file").symlink_to(around / "victim" / "thesis.txt")
    (folder / "deep").mkdir()
    (folder / "deep" / "link").symlink_to(around / "victim")


def all_names_are_links(around):
    for name in ("solution.asdf", "stars.ecsv", "report.html", "summary.json", "exp00.fits", "truth.ecsv"):
        if name != "solution.asdf":
            link_in_place_of(around / "got" / name, around / "victim" / "thesis.txt")


ATTACKS = {
    "a plan that removes a file beside": lambda around: plan(around / "got", ["../victim/thesis.txt"]),
    "a plan that removes an absolute name": lambda around: plan(around / "got", [around / "victim" / "keys"]),
    "a plan that removes much": lambda around: plan(around / "got", ["..", "/", "../victim", "../loose"]),
    "a plan of another user": lambda around: of_another(plan(around / "got", ["../victim/thesis.txt"])),
    "a plan that writes through a link": through_a_link,
    "a plan that writes by its own names": lambda around: plan(around / "got", files=["solution.asdf", "new/file"]),
    "a plan in a folder below": lambda around: plan(around / "got" / "wcs", ["../../victim/keys"]),
    "a link in place of the folder of WCSs": lambda around: link_in_place_of(
        around / "got" / "wcs", around / "victim" / "wcs"
    ),
    "a link in place of the folder of PSFs": lambda around: link_in_place_of(around / "got" / "psf", around / "victim"),
    "all names are links": all_names_are_links,
    "a lock that is a link to a file": lambda around: (around / "got" / locks.LOCK).symlink_to(
        around / "victim" / "keys"
    ),
    "a lock that is a link to nothing": lambda around: (around / "got" / locks.LOCK).symlink_to(around / "made"),
    "a dead folder whose lock is a link": lambda around: hidden(
        around / "got", f".partial-{WORD}", lock=around / "victim" / "keys"
    ),
    "a dead folder whose lock leads to an empty file": lambda around: hidden(
        around / "got", f".partial-{WORD}", lock=around / "victim" / "empty"
    ),
    "a dead folder whose lock is a hard link": lock_is_a_hard_link,
    "a dead folder with links in it": dead_folder_with_links,
    "a dead folder that is a link": lambda around: (around / "got" / f".partial-{WORD}").symlink_to(around / "victim"),
    "a summary that lists files elsewhere": lambda around: listed(
        around / "got", "../victim/thesis.txt", str(around / "victim" / "keys"), "wcs/../../victim/keys"
    ),
    "files kept of a folder elsewhere": lambda around: (around / "got" / f".replaced-{WORD}").symlink_to(
        around / "victim"
    ),
    "files kept that are links": lambda around: (hidden(around / "got", f".replaced-{WORD}") / "thesis.txt").symlink_to(
        around / "victim" / "thesis.txt"
    ),
    "a plan in the folder above": lambda around: plan(around, ["victim/thesis.txt"], ["victim/keys", "got/stars.ecsv"]),
    "a dead folder above that is a link": lambda around: beside(around).symlink_to(around / "victim"),
    "a dead folder above whose lock is a link": lambda around: hidden(
        around, beside(around).name, lock=around / "victim" / "keys"
    ),
    "a dead folder above of another user": lambda around: of_another(hidden(around, beside(around).name)),
    "a folder set aside that is a link": lambda around: aside(around).symlink_to(around / "victim"),
    "a folder set aside that has no results": lambda around: shutil.copytree(around / "victim", aside(around)),
    "a folder set aside of another user": lambda around: of_another(
        shutil.copytree(around / "saved", aside(around))
    ),
    "a solution that is a link": lambda around: link_in_place_of(
        around / "got" / "solution.asdf", around / "victim" / "keys"
    ),
}  # fmt: skip


def coadd(around, made):
    frames = [str(path) for path in sorted((made / "frames").glob("exp*.fits"))]
    return ["coadd", *frames, "--solution", str(around / "got"), "--out", str(around / "got" / "m.fits"), "--overwrite"]


def attach(around, made):
    return ["attach", str(around / "got"), str(made / "frames" / "exp00.fits"), "--out", str(around / "got")]


def in_place(around, made):
    frame = around / "got" / "exp01.fits"
    if frame.parent.exists():
        frame.unlink(missing_ok=True)
        shutil.copy(made / "frames" / "exp00.fits", frame)
    return ["attach", str(made / "results"), str(frame), "--in-place"]


COMMANDS = {
    "show": lambda around, _: ["show", str(around / "got")],
    "show, the file": lambda around, _: ["show", str(around / "got" / "solution.asdf")],
    "stars": lambda around, _: ["stars", str(around / "got"), "--out", str(around / "got" / "s.fits"), "--overwrite"],
    "report": lambda around, _: [
        "report", str(around / "got"), "--out", str(around / "got" / "report.html"), "--overwrite"
    ],
    "run --from": lambda around, _: ["run", "--from", str(around / "got"), "--out", str(around / "got" / "more")],
    "solve": lambda around, made: [
        "solve", str(made / "matched.ecsv"), "--degree", "1", "--out", str(around / "got"), "--overwrite"
    ],
    "solve --keep": lambda around, made: [
        "solve", str(made / "matched.ecsv"), "--degree", "1", "--out", str(around / "got"), "--overwrite", "--keep"
    ],
    "solve, into a folder in it": lambda around, made: [
        "solve", str(made / "matched.ecsv"), "--degree", "1", "--out", str(around / "got" / "inner"), "--overwrite"
    ],
    "demo --as": lambda around, _: ["demo", "--as", "keck-lists", "--out", str(around / "got"), "--overwrite"],
    "coadd": coadd,
    "attach": attach,
    "attach --in-place": in_place,
}  # fmt: skip


FIRST = "attack", ATTACKS


@pytest.fixture(autouse=True)
def without_waiting(monkeypatch):
    """Nothing waits for the disk, or for another process."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)


def check(around, calls):
    """Do something in the folder; whatever comes of it, what lies around it is as it was."""
    before = tree(around)
    for call in calls:
        with suppress(ld.LegdistortError):
            call()
        assert tree(around) == before, call


@pytest.mark.parametrize(*FIRST)
def test_readers_change_nothing_at_all(around, attack):
    ATTACKS[attack](around)
    got = around / "got"
    inside = everything(got)
    check(
        around,
        [
            lambda: ld.Solution.read(got / "solution.asdf"),
            lambda: read_table(got / "stars.ecsv"),
            lambda: ld.read_exposures(f"{got}/*.fits"),
            lambda: EarlierRun.read(got),
            lambda: psf_from(got / "psf"),
        ],
    )
    assert everything(got) == inside


def everything(folder):
    paths = (folder, *folder.rglob("*")) if folder.exists() else ()
    return {path.relative_to(folder).as_posix(): path.lstat().st_mtime_ns for path in paths}


@pytest.mark.parametrize(
    ("attack", "keep"),
    [
        *((attack, True) for attack in ATTACKS),
        *(pytest.param(a, False, marks=pytest.mark.sets if k % 3 else pytest.mark.slow) for k, a in enumerate(ATTACKS)),
    ],
)
def test_writers_change_the_folder_alone(around, attack, keep):
    ATTACKS[attack](around)
    got = around / "got"
    check(around, [lambda: write_run(got, keep), lambda: write_files(got), lambda: write_run(got / "inner", keep)])
    check(around, [lambda: write_run(got, keep)])


@pytest.mark.parametrize(*FIRST)
def test_writers_that_fill_the_folder_they_are_called_in(around, attack, monkeypatch):
    """It cannot be exchanged: files take their places one by one."""
    ATTACKS[attack](around)
    if (around / "got").exists():
        monkeypatch.chdir(around / "got")
        check(around, [lambda: write_run(around / "got", keep=True, results=())] * 2)


def write_run(out, keep, results=RESULTS):
    with outputs.replacing_folder(out, results=results, keep=keep) as target:
        (target / "wcs").mkdir()
        for name in ("solution.asdf", "wcs/keys", "wcs/exp00.asdf", "thesis.txt", "summary.json"):
            (target / name).write_text("new")


def write_files(out):
    names = ("solution.asdf", "summary.json", "exp00.fits", "truth.ecsv")
    for name in names:
        with outputs.replacing(out / name, overwrite=True) as file:
            file.write(b"new")
    with outputs.replacing_files([(out / name) for name in names]) as writing:
        for name in names:
            with writing(out / name) as file:
                file.write(b"newer")


def test_frames_of_the_demonstration(around, monkeypatch):
    """They go into a folder in the one that is given, and not through a link."""
    (around / "got" / "frames").symlink_to(around / "victim")
    monkeypatch.setattr("legdistort.demo.simulate_exposures", lambda **_: pytest.fail("the work began"))
    with pytest.raises(InputError, match="got/frames is a link, which would lead elsewhere: remove it"):
        run_demo(out=around / "got", small=True, overwrite=True)


def pairs():
    """Every attack with a third of the commands in turn, so that every command meets many; one in ten is no set."""
    met = [(attack, command) for i, attack in enumerate(ATTACKS) for command in list(COMMANDS)[i % 3 :: 3]]
    return [pytest.param(*each, marks=pytest.mark.sets if k % 10 else pytest.mark.slow) for k, each in enumerate(met)]


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(("attack", "command"), pairs())
def test_all_commands(around, made, attack, command):
    ATTACKS[attack](around)
    before = tree(around)
    assert main([*COMMANDS[command](around, made), "--quiet"]) in (0, 1)
    assert tree(around) == before
