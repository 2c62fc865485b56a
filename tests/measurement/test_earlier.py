"""A run that goes on from what an earlier one has measured."""

import dataclasses
import json
import shlex
import shutil
from pathlib import Path

import header_layouts
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import legdistort
from legdistort import Solution
from legdistort.cli.parser import main
from legdistort.exceptions import InputError, SolveError
from legdistort.inputs.exposure_files import open_exposures
from legdistort.measurement import positions
from legdistort.measurement.earlier import EarlierRun, write_detections
from legdistort.measurement.effective.sources import psf_from
from legdistort.measurement.options import MeasureOptions

pytestmark = [pytest.mark.filterwarnings("ignore::legdistort.LegdistortWarning"), pytest.mark.usefixtures("undrawn")]


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """A folder with frames, and the results of a run at degree 2 in ``first``, with effective PSFs."""
    folder = tmp_path_factory.mktemp("night")
    paths = legdistort.simulate_exposures(small=True, size=320, n_stars=45).write(folder / "frames")[:4]
    with pytest.MonkeyPatch.context() as undrawn:
        undrawn.setattr("legdistort.reporting.pictures.svg_of", lambda *_, **__: "")
        legdistort.run(paths, out=folder / "first", degree=2, psf="effective")
    return folder


@pytest.fixture
def unmeasured(monkeypatch):
    """Nothing is measured."""
    monkeypatch.setattr("legdistort.pipeline.measure_with_psfs", lambda *_, **__: pytest.fail("measured again"))


@pytest.mark.usefixtures("unmeasured")
def test_the_same_is_the_same(night, tmp_path):
    again = legdistort.run(out=tmp_path / "again", earlier=night / "first", degree=2)
    first = Solution.read(night / "first")
    assert np.array_equal(again.solution.estimate.positions, first.estimate.positions, equal_nan=True)
    for name in ("mosaic.fits", "psf/exp00.fits"):
        ours, theirs = (fits.getdata(folder / name) for folder in (again.out, night / "first"))
        assert np.array_equal(ours, theirs, equal_nan=True)
    assert (again.out / "matched.ecsv").read_text() == (night / "first" / "matched.ecsv").read_text()
    assert again.solution.provenance["inputs"] == first.provenance["inputs"]


@pytest.mark.slow
@pytest.mark.usefixtures("unmeasured")
def test_other_options_and_fewer_frames(night, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(night, "night")  # results may be moved with their frames, and replaced by what goes on from them
    shutil.rmtree("night/first/psf")
    frames = [f"night/frames/exp0{i}.fits" for i in (0, 2, 3)]
    words = ["run", *frames, "--from", "night/first", "--min-exposures", "3", "--degree", "1", "--out", "night/first"]
    assert main([*words, "--quiet"]) == 1  # they are not replaced without being asked for
    assert main([*words, "--quiet", "--overwrite"]) == 0
    three = Solution.read("night/first")
    assert (three.names, three.degree) == (("exp00", "exp02", "exp03"), 1)
    assert set(Table.read("night/first/detections.ecsv")["exposure"]) == {"exp00", "exp02", "exp03"}
    assert not Path("night/first/psf").exists()
    assert main(["solve", "night/first/matched.ecsv", "--degree", "1", "--out", "solved", "--quiet"]) == 0
    solved = Solution.read("solved")
    np.testing.assert_allclose(three.estimate.positions, solved.estimate.positions, atol=1e-9)
    assert None not in (three.sky, solved.sky)


@pytest.fixture
def failed(night, tmp_path, monkeypatch, capsys):
    """The last line of a command that measures the night and fails, in a folder of its own."""
    done = EarlierRun.read(night / "first")
    monkeypatch.setattr("legdistort.pipeline.measure_with_psfs", lambda *_, **__: (done.table.copy(), done.psfs))
    shutil.copytree(night / "frames", tmp_path / "my night")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results.measured").mkdir()
    (tmp_path / "results.measured" / "detections.ecsv").write_text("of somebody else")
    frames = [f"my night/exp0{i}.fits" for i in range(4)]
    for _ in range(2):  # the second takes the place of the first
        assert main(["run", *frames, "--out", "results", "--no-mosaic", "--degree", "12", "--clip", "0"]) == 1
    return capsys.readouterr().err.splitlines()[-1]


def test_a_run_that_fails_keeps_what_it_measured(night, failed, monkeypatch):
    """And its error ends with the command that goes on from there, with the other options as they were."""
    assert sorted(each.name for each in Path().iterdir()) == ["my night", "results.measured", "results.measured-2"]
    assert Path("results.measured/detections.ecsv").read_text() == "of somebody else"
    kept = Path("results.measured-2")
    assert sorted(each.name for each in kept.iterdir()) == ["detections.ecsv", "psf", "summary.json"]
    with pytest.raises(InputError, match=r"results.measured-2/solution\.asdf"):  # it is no result
        Solution.read(kept)
    words = shlex.split(failed[failed.index("legdistort run") :])
    assert words == ["legdistort", "run", "--out", "results", "--from", "results.measured-2"]
    before = EarlierRun.read(kept)
    first = EarlierRun.read(night / "first")
    assert all(np.array_equal(before.table[name], first.table[name]) for name in ("exposure", "x", "y", "x_err"))
    assert list(before.psfs) == list(first.psfs)
    monkeypatch.setattr("legdistort.pipeline.measure_with_psfs", lambda *_, **__: pytest.fail("measured again"))
    assert main([*words[1:], "--degree", "2", "--quiet"]) == 0
    options = json.loads(Path("results/summary.json").read_text())["options"]
    assert options == {"--no-mosaic": None, "--degree": "2", "--clip": "0.0"}


def test_what_was_measured_is_kept_of_files_alone_and_once(night, tmp_path, monkeypatch, caplog):
    """Not of exposures in memory, and not where an earlier run has it; one that is interrupted says so in the log."""
    done = EarlierRun.read(night / "first")
    monkeypatch.setattr("legdistort.pipeline.measure_with_psfs", lambda *_, **__: (done.table.copy(), {}))
    paths, asked = sorted((night / "frames").glob("exp0[0-3].fits")), {"out": tmp_path / "out", "degree": 12}
    with pytest.raises(SolveError) as caught:
        legdistort.run([fits.HDUList([fits.PrimaryHDU(*fits.getdata(each, header=True))]) for each in paths], **asked)
    assert "kept" not in str(caught.value)
    with pytest.raises(SolveError) as caught:
        legdistort.run(earlier=night / "first", **asked)
    assert ("kept" not in str(caught.value), list(tmp_path.iterdir())) == (True, [])
    with pytest.raises(SolveError, match=rf"run\(earlier='{tmp_path}/out.measured', out='{tmp_path}/out', \.\.\.\)$"):
        legdistort.run(paths, **asked)
    assert [path.name for path in tmp_path.iterdir()] == ["out.measured"]
    shutil.rmtree(tmp_path / "out.measured")

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    def full(*_, **__):
        raise OSError(28, "full")

    monkeypatch.setattr("legdistort.pipeline.match", interrupted)
    with pytest.raises(KeyboardInterrupt):
        legdistort.run(paths, **asked)
    assert f"what was measured is kept in {tmp_path}/out.measured" in caplog.text
    monkeypatch.setattr("legdistort.measurement.unfinished.write_detections", full)
    shutil.rmtree(tmp_path / "out.measured")
    with pytest.raises(KeyboardInterrupt):
        legdistort.run(paths, **asked)
    assert ("could not be kept: No space left" in caplog.text, list(tmp_path.iterdir())) == (True, [])


@pytest.mark.parametrize("name", ["detections.ecsv", "psf/exp01.fits"])
def test_files_of_two_runs_are_refused(night, tmp_path, name):
    """Those of one are known by its summary; without one they are taken as they are."""
    results = tmp_path / "results"
    shutil.copytree(night / "first", results)
    read = EarlierRun.read(results)
    assert list(read.psfs) == ["exp00", "exp01", "exp02", "exp03"]
    assert list(psf_from(results / "psf")) == list(read.psfs)
    if name == "detections.ecsv":
        (results / name).write_text((results / name).read_text() + "\n")
    else:
        shutil.copy(results / "psf" / "exp00.fits", results / name)
        with pytest.raises(InputError, match=r"results does not hold the files of one run, \S*psf/exp01.fits is not"):
            psf_from(results / "psf")
    with pytest.raises(InputError, match=rf"results does not hold the files of one run, \S*{name} is not"):
        EarlierRun.read(results)
    (results / "summary.json").unlink()
    assert len(EarlierRun.read(results).table) == len(read.table)
    assert len(psf_from(results / "psf")) == 4


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"psf": "moffat"}, "psf is not to be given with an earlier run"),
        ({"measuring": {"threshold": 4}}, "threshold is not to be given with an earlier run"),
        ({"ext": 1}, "ext is not to be given with an earlier run"),
        ({"camera": legdistort.Camera.gsaoi()}, "the header of exp00 names none of the detectors 1, 2, 3, 4"),
        ({"earlier": "frames"}, "frames has no detections.ecsv: give the folder of the results of a run"),
        ({"earlier": None}, "give frames, or the folder of an earlier run"),
        ({"paths": ["frames/exp00.fits", "frames/other.fits"]}, "other.fits was not measured in .*first, whose frames"),
    ],
)
def test_what_is_refused(night, given, words, tmp_path, monkeypatch):
    monkeypatch.chdir(night)
    if not (night / "frames" / "other.fits").exists():
        with fits.open(night / "frames" / "exp00.fits") as hdulist:
            hdulist[0].data[:5] += 1
            hdulist.writeto(night / "frames" / "other.fits")
    with pytest.raises(InputError, match=words):
        legdistort.run(**{"out": tmp_path / "out", "earlier": night / "first", "min_exposures": 2} | given)
    assert not (tmp_path / "out").exists()


def test_frames_that_have_changed(night, tmp_path):
    shutil.copytree(night, tmp_path / "night")
    with fits.open(tmp_path / "night" / "frames" / "exp01.fits", mode="update") as hdulist:
        hdulist[0].data[7, 7] += 1
    with pytest.raises(InputError, match=r"exp01\.fits is not as it was measured in .*first: measure the frames again"):
        legdistort.run(out=tmp_path / "out", earlier=tmp_path / "night" / "first")
    paths = sorted((night / "frames").glob("exp*.fits"))
    exposures = [fits.HDUList([fits.PrimaryHDU(fits.getdata(path))]) for path in paths]
    with pytest.raises(InputError, match="is not in a file"):
        legdistort.run(exposures, out=tmp_path / "out", earlier=night / "first")
    (tmp_path / "night" / "frames" / "exp02.fits").unlink()
    with pytest.raises(InputError, match=r"exp02\.fits"):
        legdistort.run(out=tmp_path / "out", earlier=tmp_path / "night" / "first")


def test_a_table_of_somebody_else(night, tmp_path):
    (tmp_path / "results").mkdir()
    table = positions.measure(legdistort.read_exposures(night / "frames" / "exp00.fits"))
    table.write(tmp_path / "results" / "detections.ecsv")
    with pytest.raises(InputError, match=r"detections.ecsv is not what a run has left"):
        legdistort.run(out=tmp_path / "out", earlier=tmp_path / "results")


def test_detectors_that_were_not_measured_are_named(night):
    (exposure,) = open_exposures([night / "frames" / "exp00.fits"])
    with pytest.raises(InputError, match="first has no positions of exp00-1: the camera does not name the detectors"):
        EarlierRun.read(night / "first").of([dataclasses.replace(exposure, name="exp00-1")])


@pytest.mark.slow
def test_the_camera_of_another_night_goes_on_from_an_earlier_run(tmp_path):
    """Frames of four detectors with positions as they were drawn, by a run whose camera is that of the headers."""
    night, frames, first = header_layouts.Night(1, off=0.0, n=4, n_stars=150), tmp_path / "frames", tmp_path / "first"
    frames.mkdir()
    first.mkdir()
    night.write(frames)
    known = {"ext": "SCI", "measuring": MeasureOptions()}
    exposures = open_exposures(sorted(frames.glob("*.fits")), ext="SCI")
    write_detections(first / "detections.ecsv", night.table, exposures, first, **known)
    camera = legdistort.Camera.of_frames(night.exposures)
    asked = {"mosaic": False, "min_exposures": 2, "degree": 1, "earlier": first}
    given = dataclasses.replace(camera, name="of last year")
    out = tmp_path / "second"
    assert legdistort.run(out=out, camera=given, **asked).solution.camera.name == "of last year" != camera.name
    assert EarlierRun.read(out).camera.name == "of last year"
    again = legdistort.run(out=tmp_path / "third", **asked | {"earlier": out}).solution  # without a word it stays
    assert again.camera.name == "of last year"
    other = dataclasses.replace(camera, detectors=dict(zip("ABCD", camera.detectors.values(), strict=True)))
    with pytest.raises(InputError, match=r"e0-1 is of detector 1, and camera .* has A, B, C, D"):
        legdistort.run(out=tmp_path / "fourth", camera=other, **asked)
