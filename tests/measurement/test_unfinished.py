"""What is measured lands on the disk image by image, so that a run that is killed loses nothing of it."""

import os
import shlex
import shutil
import signal
import warnings
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import legdistort
from legdistort import Solution
from legdistort.cli.parser import main
from legdistort.exceptions import InputError, LegdistortError
from legdistort.measurement import positions
from legdistort.measurement.earlier import EarlierRun
from legdistort.measurement.unfinished import Unfinished

pytestmark = [pytest.mark.filterwarnings("ignore::legdistort.LegdistortWarning"), pytest.mark.usefixtures("undrawn")]
OPTIONS = ["--degree", "1", "--no-mosaic", "--workers", "1", "--min-exposures", "3"]
GO_ON = ["run", "--from", "results.measured", "--out", "results", "--workers", "1"]


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("night")
    return legdistort.simulate_exposures(small=True, size=256, n_stars=34, n_exposures=3).write(folder)[:3]


def _end_after_one_image(words):
    keep = Unfinished.keep

    def last(*arguments):
        keep(*arguments)
        os.kill(os.getpid(), signal.SIGKILL)

    Unfinished.keep = last
    main(words)


def kill_after_one_image(*words):
    process = get_context("fork").Process(target=_end_after_one_image, args=(list(words),))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of copies of a process with threads
        process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL


@pytest.fixture
def killed(frames, tmp_path, monkeypatch):
    """A folder to work in, where a run was killed after its first image; the words of its command."""
    monkeypatch.chdir(tmp_path)
    words = ["run", *map(str, frames), *OPTIONS, "--psf", "effective", "--out", "results"]
    kill_after_one_image(*words)
    return words


@pytest.fixture
def measured(monkeypatch):
    """Names of the images that are measured from now on."""
    names, measure_one = [], positions.measure_exposure
    monkeypatch.setattr(
        positions, "measure_exposure", lambda each, options: names.append(each.name) or measure_one(each, options)
    )
    return names


def test_a_killed_run_is_gone_on_from(killed, measured):
    """The others are measured, results are those of a run that is not killed, to the last bit, and the folder goes."""
    kept = Path("results.measured")
    assert sorted(path.name for path in (kept / "images").iterdir()) == ["exp00.fits", "exp00.npz"]
    assert main([*GO_ON, "--quiet"]) == 0
    assert (measured, kept.exists()) == (["exp01", "exp02"], False)
    whole = [*killed[:-1], "whole"]
    assert main([*whole, "--quiet"]) == 0
    ours, theirs = EarlierRun.read("results"), EarlierRun.read("whole")
    assert ours.table.colnames == theirs.table.colnames
    assert all(np.array_equal(ours.table[name], theirs.table[name]) for name in theirs.table.colnames)
    assert all(np.array_equal(ours.psfs[n].coefficients, psf.coefficients) for n, psf in theirs.psfs.items())
    ours, theirs = Solution.read("results"), Solution.read("whole")
    assert np.array_equal(ours.estimate.positions, theirs.estimate.positions, equal_nan=True)
    assert sorted(path.name for path in Path().iterdir()) == ["results", "whole"]


def test_the_next_run_says_what_is_there(killed, measured, capsys):
    """And leaves it alone, where it is not asked to go on from there."""
    assert main(killed) == 0
    said = capsys.readouterr().err
    assert "results.measured has 1 of 3 images that a run measured which was stopped: to go on from there, stop" in said
    assert "this one and call legdistort run --out results --from results.measured; else remove it" in said
    assert measured == ["exp00", "exp01", "exp02"]
    assert sorted(path.name for path in Path().iterdir()) == ["results", "results.measured"]


@pytest.mark.slow
def test_what_is_killed_again_is_gone_on_from_again(killed, measured, monkeypatch, capsys):
    """With an image that is damaged, which is measured again; one that fails says how many it has, and how to go on."""
    kill_after_one_image(*GO_ON)
    images = Path("results.measured/images")
    assert sorted(path.name for path in images.glob("*.npz")) == ["exp00.npz", "exp01.npz"]
    (images / "exp00.npz").write_bytes((images / "exp00.npz").read_bytes()[:-100])
    measure_one = positions.measure_exposure
    monkeypatch.setattr(positions, "measure_exposure", failing(measure_one, "exp02"))
    assert main(GO_ON) == 1
    assert measured == ["exp00"]
    line = capsys.readouterr().err.splitlines()[-1]
    told, words = line.split("to go on from there: legdistort ")
    assert told == "legdistort: exp02 is of no use; 2 of 3 images are measured and kept in results.measured, "
    monkeypatch.setattr(positions, "measure_exposure", measure_one)
    assert main([*shlex.split(words), "--quiet"]) == 0
    assert sorted(path.name for path in Path().iterdir()) == ["results"]


def failing(measure_one, name):
    def measure(exposure, options):
        if exposure.name == name:
            raise LegdistortError(f"{name} is of no use")
        return measure_one(exposure, options)

    return measure


def test_what_was_measured_when_matching_fails_takes_the_place_of_images(frames, tmp_path, monkeypatch):
    def fails(*_, **__):
        raise LegdistortError("no match")

    monkeypatch.setattr("legdistort.pipeline.match", fails)
    asked = {"psf": "moffat", "min_exposures": 3, "out": tmp_path / "out"}
    for _ in range(2):
        with pytest.raises(LegdistortError, match=r"no match; what was measured is kept in \S*/out.measured, to go"):
            legdistort.run(frames, **asked)
        assert [path.name for path in tmp_path.iterdir()] == ["out.measured"]
        assert sorted(path.name for path in (tmp_path / "out.measured").iterdir()) == [
            "detections.ecsv",
            "summary.json",
        ]


def test_images_that_are_being_measured_are_left_to_their_process(killed, frames, tmp_path):
    """Nor do those go that another run than this one needs."""
    before = EarlierRun.read("results.measured")
    shutil.copytree("results.measured", "others")
    with Unfinished(tmp_path / "results", {}, None) as first, Unfinished(tmp_path / "results", {}, None) as second:
        opened = legdistort.open_exposures(frames)
        first.begin(opened, before, {"measuring": before.measuring})
        with pytest.raises(InputError, match=r"another process measures what is kept in results\.measured: wait"):
            second.begin(opened, before, {"measuring": before.measuring})
    assert not Path("results.measured").exists()
    with Unfinished(tmp_path / "results", {}, None) as some:
        before = EarlierRun.read("others")
        some.begin(opened[1:], before, {"measuring": before.measuring})
    assert Path("others/images/exp00.npz").exists()
