"""The checksum of an input is that of what was read: whatever changes or goes meanwhile is noticed and named."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.inputs import exposure_files, fits_images
from legdistort.inputs.star_lists import formats
from legdistort.inputs.table_files import read_table
from legdistort.priors import storage as prior_storage
from legdistort.results import storage as solution_storage
from legdistort.runtime import outputs, provenance
from legdistort.simulation.observations import simulate_exposures, simulate_matches
from legdistort.solving.estimation import solve


def frame(path, seed, shape=(40, 50)):
    fits.writeto(path, np.random.default_rng(seed).normal(size=shape).astype("f4"), overwrite=True)
    return path


def swap_by_rename(path, other):
    shutil.copy(other, path.with_name("new"))
    os.replace(path.with_name("new"), path)


def swap_in_place(path, other):
    path.write_bytes(other.read_bytes())


def swap_with_its_time(path, other):
    """As ``cp -p`` and some archives do: size and time of modification are the same."""
    before = path.stat()
    path.write_bytes(other.read_bytes())
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


SWAPS = [swap_by_rename, swap_in_place, swap_with_its_time]


@pytest.fixture
def pair(tmp_path):
    """Two frames of one shape and size."""
    return frame(tmp_path / "a.fits", 1), frame(tmp_path / "b.fits", 2)


@pytest.mark.parametrize("swap", SWAPS)
def test_a_frame_that_was_swapped_is_not_read(pair, swap):
    (handle,) = ld.open_exposures(pair[0])
    assert handle.checksum == hashlib.sha256(pair[0].read_bytes()).hexdigest()
    swap(*pair)
    with pytest.raises(InputError, match=r"a\.fits has changed since it was first read: its SHA-256 is another"):
        handle.read()


def test_a_frame_that_was_moved_or_touched_is_the_same(pair):
    (handle,) = ld.open_exposures(pair[0])
    pixels = handle.read().data
    pair[0].touch()
    swap_by_rename(pair[0], shutil.copy(pair[0], pair[0].with_name("copy")))
    np.testing.assert_array_equal(handle.read().data, pixels)


def test_a_frame_that_goes_is_named(pair):
    (handle,) = ld.open_exposures(pair[0])
    pair[0].unlink()
    with pytest.raises(InputError, match=r"a\.fits: no such file"):
        handle.read()


@pytest.mark.parametrize("swap", SWAPS)
@pytest.mark.parametrize("reading", ["first", "later"])
def test_a_frame_that_changes_while_it_is_read(pair, monkeypatch, swap, reading):
    (handle,) = ld.open_exposures(pair[0])
    usual = exposure_files.planes_of

    def planes(*args):
        found = usual(*args)
        swap(*pair)
        return found

    for module in (exposure_files, fits_images):
        monkeypatch.setattr(module, "planes_of", planes)
    with pytest.raises(InputError, match=r"a\.fits changed while it was read: wait until it is complete"):
        ld.open_exposures(pair[0]) if reading == "first" else handle.read()


@pytest.mark.slow
def test_a_run_whose_frame_is_swapped_leaves_nothing_of_it(tmp_path, monkeypatch):
    """The new frame has the shape of the old one, and would have passed for it; others that were measured are kept."""
    paths = simulate_exposures(small=True, seed=3).write(tmp_path / "frames")
    usual, done = exposure_files.ExposureFile.read, []

    def read(self):
        if not done:
            done.append(swap_by_rename(paths[2], paths[3]))
        return usual(self)

    monkeypatch.setattr(exposure_files.ExposureFile, "read", read)
    with pytest.raises(InputError, match=f"{paths[2].name} has changed since it was first read"):
        ld.run(paths, out=tmp_path / "out", psf="moffat", degree=1)
    assert {path.name for path in tmp_path.iterdir()} <= {"frames", "out.measured"}
    assert not list((tmp_path / "out.measured").rglob(f"{paths[2].stem}*"))


@pytest.mark.parametrize("kind", ["table", "solution", "prior"])
def test_other_inputs_that_change_while_they_are_read(tmp_path, monkeypatch, kind):
    simulated = simulate_matches(n_stars=12, n_exposures=5, degree=1, shape=(100, 100), dither=2.0, seed=1)
    read, module, function = {
        "table": (read_table, formats, "read"),
        "solution": (ld.Solution.read, solution_storage, "read_tree"),
        "prior": (ld.Prior.from_file, prior_storage, "read_source"),
    }[kind]
    path = tmp_path / "input"
    if kind == "table":
        path = tmp_path / "table.ecsv"
        simulated.matches.table.write(path)
    elif kind == "solution":
        solve(simulated.matches, degree=1).write(path)
    else:
        header = fits.Header({"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CRPIX1": 50, "CRPIX2": 50,
                              "CDELT1": -1e-5, "CDELT2": 1e-5, "A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-5})  # fmt: skip
        fits.writeto(path, np.zeros((100, 100), "f4"), header)
    read(path)
    usual = getattr(module, function)

    def changing(*args, **options):
        found = usual(*args, **options)
        swap_by_rename(path, shutil.copy(path, tmp_path / "copy"))
        return found

    monkeypatch.setattr(module, function, changing)
    with pytest.raises(InputError, match=f"{path.name} changed while it was read"):
        read(path)


def test_what_is_no_file_has_no_identity(tmp_path):
    for name in (tmp_path / "none", "no\0name", "gsaoi-1"):
        assert provenance.identity(name) is None
    with provenance.unchanged(Path(tmp_path / "none")):
        pass


# --- several files of one run -------------------------------------------------------------------------------------

NAMES = ("a", "b", "wcs/c")


def write_run(out, text):
    """A run that leaves some files, all of the same text, and a summary that lists them."""
    with outputs.replacing_folder(out) as target:
        (target / "wcs").mkdir()
        for name in NAMES:
            (target / name).write_text(text)
        summary = {"run": text, "files": outputs.contents(target)}
        (target / provenance.SUMMARY).write_text(json.dumps(summary))


def read_run(out):
    return provenance.of_one_run(out, lambda: ([(out / name).read_text() for name in NAMES], NAMES))


def test_files_of_one_run(tmp_path):
    write_run(tmp_path / "out", "1")
    assert read_run(tmp_path / "out") == ["1"] * 3
    (tmp_path / "out" / "summary.json").unlink()  # there is nothing to compare with
    (tmp_path / "out" / "b").write_text("2")
    assert read_run(tmp_path / "out") == ["1", "2", "1"]
    with pytest.raises(FileNotFoundError):
        read_run(tmp_path / "none")


@pytest.fixture
def quick(monkeypatch):
    waited = []
    monkeypatch.setattr(time, "sleep", waited.append)
    return waited


def test_a_mixture_is_read_again_and_then_refused(tmp_path, quick):
    out = tmp_path / "out"
    write_run(out, "1")
    (out / "b").write_text("2")
    with pytest.raises(InputError, match=r"out does not hold the files of one run, \S*out/b is not the file that summ"):
        read_run(out)
    assert len(quick) == 5
    assert 0.5 < sum(quick) < 2  # seconds
    assert provenance.of_one_run(out, lambda: ("those that fit", ["a", "wcs/c"])) == "those that fit"
    (out / "d").write_text("")
    with pytest.raises(InputError, match="out/d is not the file"):
        provenance.of_one_run(out, lambda: (None, ["d"]))


@pytest.mark.parametrize("failing", [False, True])
def test_what_is_replaced_while_it_is_read_is_read_again(tmp_path, quick, failing):
    """Be it that all that was read is of one run, or that a file was missing just then."""
    out, reads = tmp_path / "out", []
    write_run(out, "0")

    def read():
        reads.append([(out / name).read_text() for name in NAMES])
        if len(reads) < 3:
            write_run(out, str(len(reads)))
            if failing:
                raise InputError("no such file")
        return reads[-1], NAMES

    assert provenance.of_one_run(out, read) == ["2"] * 3
    assert len(reads) == len(quick) == 3


def test_what_is_replaced_again_and_again_is_refused(tmp_path, quick):
    out = tmp_path / "out"
    write_run(out, "0")

    def read():
        write_run(out, f"{len(quick)}")
        return None, NAMES

    with pytest.raises(InputError, match="out does not hold the files of one run, it is replaced again and again"):
        provenance.of_one_run(out, read)


WRITER = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_provenance import write_run
k, next_one = 0, time.monotonic()
while True:
    write_run(Path(sys.argv[1]), str(k))
    k, next_one = k + 1, next_one + 1 / 24
    print(k, flush=True)
    time.sleep(max(0, next_one - time.monotonic()))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="folders are exchanged in one step there alone")
@pytest.mark.parametrize("n_reads", [100, pytest.param(10_000, marks=pytest.mark.sets)])
def test_readers_beside_a_writer(tmp_path, n_reads):
    """At 24 commits a second: never files of two runs, and never a folder that is missing.

    More reads than asked for where the machine is so busy that the writer has hardly begun.
    """
    out, seen, mixed, refused, reads, end = tmp_path / "out", set(), 0, 0, 0, time.monotonic() + 60
    arguments = [sys.executable, "-c", WRITER, str(out), str(Path(__file__).parent)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout.readline() == b"1\n"
            while reads < n_reads or (len(seen) < 3 and time.monotonic() < end):
                reads += 1
                try:
                    found = set(read_run(out))
                except InputError as error:
                    refused += "again and again" in str(error)
                    continue
                mixed += len(found) > 1
                seen |= found
        finally:
            process.kill()
    assert mixed == 0
    assert refused < 0.01 * reads
    assert len(seen) > 2
