"""What happens around a command: stopped writers, clocks that jump, little memory, large and many files.

    python tests/circumstances.py [NAME ...]

Each ends with results or with one line of ours, without a traceback, and changes nothing but what it is to write.
"""

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import asdf
import numpy as np
from astropy.io import fits

HERE = Path(__file__).parent
MINUTES = 8 * 60


def legdistort(folder, *words, before="", seconds=MINUTES):
    """``(status, standard error, seconds, MB)`` of a command in a folder; `before` is Python that comes first."""
    code = f"import sys\n{before}\nfrom legdistort.cli import command\nsys.exit(command())"
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=folder,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    try:
        said = process.communicate(timeout=seconds)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    assert "Traceback" not in said, said
    assert process.returncode in (0, 1, 3), (process.returncode, said)
    if process.returncode == 1:
        assert said.splitlines()[-1].startswith("legdistort: "), said
    return process.returncode, said, time.perf_counter() - begin, most


def stopped_writer(folder):
    """One that is stopped while it has the lock: others end at once and say so, and it goes on when it may."""
    legdistort(folder, "demo", "--small", "--out", "demo")
    shutil.copytree(folder / "demo", folder / "out", ignore=shutil.ignore_patterns("frames"))
    words = [sys.executable, "-m", "legdistort", "solve", "demo/matched.ecsv", "--out", "out", "--overwrite", "--quiet"]
    first = subprocess.Popen(words, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    held = None
    while first.poll() is None and held is None:
        for lock in folder.rglob("*.lock"):
            held = lock if _is_held(lock) else None
        time.sleep(0.001)
    assert held is not None, "no lock was seen"
    os.kill(first.pid, signal.SIGSTOP)
    try:
        status, said, seconds, _ = legdistort(
            folder, "solve", "demo/matched.ecsv", "--out", "out", "--overwrite", seconds=60
        )
        assert (status, "another process is writing" in said) == (1, True), said
        assert seconds < 30
        assert legdistort(folder, "show", "out", seconds=60)[0] == 0  # readers take no lock
    finally:
        os.kill(first.pid, signal.SIGCONT)
    said = first.communicate(timeout=60)[1]
    assert first.returncode == 0, said
    return f"told in {seconds:.1f} s"


def _is_held(lock):
    import fcntl

    try:
        with lock.open("rb+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


JUMPS = """
import itertools, time
real, steps = time.time, itertools.cycle([0, 3e8, -4e8, 1e3, -1e9])
time.time = lambda: real() + next(steps)
"""


def jumping_clock(folder):
    """The clock is set back and forth by years between any two looks at it, and files are of the year 2100."""
    assert legdistort(folder, "demo", "--small", "--out", "demo", before=JUMPS)[0] == 0
    for path in folder.rglob("*"):
        os.utime(path, (4.1e9, 4.1e9))
    solving = ["solve", "demo/matched.ecsv", "--out", "other", "--overwrite"]
    for words in (["show", "demo"], ["run", "--from", "demo", "--degree", "1", "--out", "again"], solving, solving):
        assert legdistort(folder, *words, before=JUMPS)[0] == 0, words
    return "all commands end well"


def large_image(folder):
    """A frame of 10,000 x 10,000 pixels is measured; with a gigabyte for all data it is refused in one line."""
    rng = np.random.default_rng(1)
    data = rng.normal(100, 5, (10_000, 10_000)).astype("f4")
    y, x = np.mgrid[-8:9, -8:9]
    for a, b in rng.integers(20, 9_980, (3000, 2)):
        data[b - 8 : b + 9, a - 8 : a + 9] += 3e4 * rng.pareto(1.5) * np.exp(-(x**2 + y**2) / 4)
    fits.PrimaryHDU(data).writeto(folder / "big.fits")
    del data
    status, said, seconds, most = legdistort(folder, "measure", "big.fits", "--out", "d.ecsv", "--quiet")
    assert status == 0, said
    little = "import resource\nresource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30))"
    refused, said, _, _ = legdistort(folder, "measure", "big.fits", "--out", "e.ecsv", "--quiet", before=little)
    assert refused == 1, said
    assert "memory" in said, said
    assert not (folder / "e.ecsv").exists()
    return f"measured in {seconds:.0f} s with {most:.0f} MB; with 1 GB: {said.strip()[:90]}"


FEW = "import resource\nresource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))"


def many_frames(folder):
    """5,000 frames in one command line, with 256 files open at most."""
    rng, pixels = np.random.default_rng(1), np.arange(32)
    for k in range(5000):
        x, y = (rng.uniform(8, 24, 2) + np.array([[-4, -4], [4, 4]])).T
        along_x, along_y = (np.exp(-((pixels - a[:, None]) ** 2) / 4) for a in (x, y))
        image = rng.normal(100 + 3e3 * along_y.T @ along_x, 5).astype("f4")
        fits.PrimaryHDU(image).writeto(folder / f"f{k:04d}.fits")
    return _many(folder, "measure", "fits")


def many_lists(folder):
    """5,000 star lists in one command line, with 256 files open at most."""
    rng = np.random.default_rng(1)
    stars = rng.uniform(1, 900, (8, 2))
    for k in range(5000):
        x, y = (stars + rng.uniform(-5, 5, 2)).T
        lines = (f"{a:.3f} {b:.3f} 0.05 0.05 {1000 * i + 1000}" for i, (a, b) in enumerate(zip(x, y, strict=True)))
        (folder / f"l{k:04d}.txt").write_text("# x y x_err y_err flux\n" + "\n".join(lines) + "\n")
    return _many(folder, "match", "txt", "--shape", 1000, 1000)


def _many(folder, command, ending, *more):
    words = [command, *sorted(path.name for path in folder.glob(f"*.{ending}")), *more, "--out", "o.ecsv", "--quiet"]
    status, told, seconds, most = legdistort(folder, *words, before=FEW, seconds=60 * 60)
    assert status == 0, told[-1000:]
    assert len(told) < 10_000, f"it tells {len(told)} letters: {told[:1000]}"
    return f"{command} in {seconds:.0f} s with {most:.0f} MB, {len(told)} letters told"


def large_solution(folder):
    """A solution of 500 MB is read or refused, in little more memory than it takes."""
    (written,) = sorted((HERE / "written").iterdir())[-1:]
    with asdf.open(written / "solution.asdf", memmap=False, lazy_load=False) as opened:
        tree = {key: value for key, value in opened.tree.items() if key.startswith("legdistort")}
        tree["more"] = np.random.default_rng(1).normal(size=65_000_000)
        asdf.AsdfFile(tree, version="1.5.0").write_to(folder / "solution.asdf")
    status, said, seconds, most = legdistort(folder, "show", "solution.asdf")
    little = "import resource\nresource.setrlimit(resource.RLIMIT_DATA, (1 << 29, 1 << 29))"
    refused, told, _, _ = legdistort(folder, "show", "solution.asdf", before=little)
    assert refused == 1, told
    assert "memory" in told, told
    return f"status {status} in {seconds:.0f} s, {most:.0f} MB {said.strip()[:80]}; with 512 MB: {told.strip()[:110]}"


def one_gigabyte(folder):
    """A small night from end to end with a gigabyte for all data."""
    little = "import resource\nresource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30))"
    status, said, seconds, most = legdistort(folder, "demo", "--small", "--out", "demo", before=little)
    assert status == 0, said
    return f"in {seconds:.0f} s with {most:.0f} MB"


CIRCUMSTANCES = {
    each.__name__: each
    for each in (stopped_writer, jumping_clock, large_image, many_frames, many_lists, large_solution, one_gigabyte)
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(CIRCUMSTANCES), choices=list(CIRCUMSTANCES))
    faults = 0
    for name in parser.parse_args().names:
        with tempfile.TemporaryDirectory() as place:
            try:
                print(f"{name:15s} {CIRCUMSTANCES[name](Path(place))}", flush=True)
            except (AssertionError, subprocess.TimeoutExpired) as fault:
                faults += 1
                print(f"{name:15s} FAULT {str(fault)[-1500:]}", flush=True)
    sys.exit(bool(faults))
