"""Numbers of frames that begin anew in every night: the folders of their files tell them apart, in every step."""

import shutil

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table, vstack

from legdistort.cli.parser import main
from legdistort.exceptions import InputError
from legdistort.inputs.exposure_files import file_checksums, open_exposures, read_exposures
from legdistort.measurement.earlier import EarlierRun, measured_frames, write_detections
from legdistort.measurement.options import MeasureOptions
from legdistort.results.solution import Solution
from legdistort.results.view import image_view
from legdistort.wcs.attachment import attach

SHAPE = (60, 90)
NIGHTS, FRAMES = ("20220424", "20220715"), ("c0010", "c0011")
NAMES = ("20220424_c0010", "20220424_c0011", "20220715_c0010", "20220715_c0011")


@pytest.fixture
def frames(tmp_path):
    """Two frames of each of two nights, all different, with the same names in both."""
    rng, paths = np.random.default_rng(3), []
    for night in NIGHTS:
        (tmp_path / night / "reduced").mkdir(parents=True)
        for name in FRAMES:
            paths.append(tmp_path / night / "reduced" / f"{name}.fits")
            fits.writeto(paths[-1], rng.normal(100, 5, SHAPE).astype(np.float32))
    return paths


def lists(folder, suffix=".csv"):
    """Stars at the same places in every list, which their errors scatter."""
    rng, paths = np.random.default_rng(4), []
    places = rng.uniform(20, 480, (40, 2))
    for night in NIGHTS:
        (folder / night).mkdir()
        for name in FRAMES:
            x, y = (places + rng.normal(0, 0.02, places.shape)).T
            paths.append(folder / night / f"{name}{suffix}")
            Table({"x": x, "y": y, "x_err": x * 0 + 0.02, "y_err": x * 0 + 0.02}).write(paths[-1], format="ascii.csv")
    return list(map(str, paths))


def test_frames_have_the_lowest_folder_that_tells_them_apart(frames):
    opened = open_exposures(frames)
    assert tuple(each.name for each in opened) == tuple(each.name for each in read_exposures(frames)) == NAMES
    assert set(file_checksums(opened)) == {f"{name}.fits" for name in NAMES}
    assert [each.name for each in open_exposures(frames[:2])] == list(FRAMES)


def test_copies_do_not_change_the_names(frames, tmp_path):
    (tmp_path / "copies").mkdir()
    moved = shutil.copy(frames[0], tmp_path / "copies")
    with pytest.warns(UserWarning, match=r"c0010: its pixels are those of c0010"):
        opened = open_exposures([*frames[:2], moved], left_out={})
    assert [each.name for each in opened] == list(FRAMES)


def test_two_frames_of_one_name_and_folder_are_refused(frames):
    with pytest.raises(InputError, match=r"two exposures are named 'c0010' \(.*20220424.*; rename a file, or give one"):
        read_exposures([frames[0], *frames, frames[0]])


def test_a_solution_goes_into_its_frames(frames, geometry, tmp_path):
    """Into those of all nights, of one night alone, in place and as copies; and a frame finds its exposure."""
    solution = geometry(2, 1.0, shape=SHAPE, names=NAMES)
    done = attach(solution, frames, out=tmp_path / "all")
    assert [(each.exposure, each.path.name) for each in done] == [(name, f"{name}.fits") for name in NAMES]
    done = attach(solution, frames[2:], out=tmp_path / "one")
    assert [(each.exposure, each.path.name) for each in done] == [(NAMES[2], "c0010.fits"), (NAMES[3], "c0011.fits")]
    for _ in range(2):  # the second time for the first
        attach(solution, frames, in_place=True)
        with fits.open(frames[2]) as hdus:
            assert [hdu.name for hdu in hdus] == ["PRIMARY", "ASDF"]
    assert fits.getheader(frames[2], "ASDF")["EXPNAME"] == NAMES[2]
    assert [image_view(solution, each).name for each in open_exposures(frames[2:])] == list(NAMES[2:])
    with pytest.raises(InputError, match="no exposure 'c0010' in the solution"):
        attach(geometry(2, 1.0, shape=SHAPE, names=("20220424_c00101", "x")), frames[0], in_place=True)


def test_an_earlier_run_knows_its_frames(frames, tmp_path, monkeypatch):
    """One night of it alone, and what comes from that; another frame of the same number is none of them."""
    one = np.ones(1) * u.pix
    table = vstack([QTable({"exposure": [name], "x": one, "y": one, "x_err": one, "y_err": one}) for name in NAMES])
    opened, results = open_exposures(frames), [tmp_path / "first", tmp_path / "second"]
    for folder in results:
        folder.mkdir()
    write_detections(results[0] / "detections.ecsv", table, opened, results[0], measuring=MeasureOptions())
    monkeypatch.chdir(frames[2].parent)
    earlier = EarlierRun.read(results[0])
    night = earlier.named(open_exposures(["c0010.fits", "c0011.fits"]))
    assert [each.name for each in night] == list(NAMES[2:])
    detections, _ = earlier.of(night)
    assert detections["exposure"].tolist() == list(NAMES[2:])
    assert [each.name for each in earlier.named(opened)] == list(NAMES)
    assert len(earlier.of(earlier.named(opened))[0]) == 4
    write_detections(results[1] / "detections.ecsv", detections, night, results[1], measuring=MeasureOptions())
    later = EarlierRun.read(results[1])
    again = measured_frames({results[1] / "detections.ecsv": later.table})
    assert [each.name for each in again] == list(NAMES[2:])
    with pytest.raises(InputError, match=r"c0010\.fits is not as it was measured"):
        later.of(later.named(open_exposures(frames[:1])))


def test_lists_of_nights(tmp_path, capsys):
    """Through match, solve and correct, of which the last is given one list alone."""
    files, out = lists(tmp_path), tmp_path / "m.ecsv"
    assert main(["match", *files, "--shape", "500", "500", "--min-exposures", "2", "--out", str(out)]) == 0
    assert "names of files repeat in several folders" in capsys.readouterr().err
    table = Table.read(out)
    assert set(table["exposure"]) == set(NAMES)
    assert set(table.meta["inputs"]) == {f"{name}.csv" for name in NAMES}
    assert main(["solve", str(out), "--degree", "1", "--out", str(tmp_path / "s"), "--quiet"]) == 0
    assert Solution.read(tmp_path / "s").names == NAMES
    corrected = tmp_path / "c.ecsv"
    assert main(["correct", str(tmp_path / "s"), files[2], "--out", str(corrected), "--quiet"]) == 0
    assert set(Table.read(corrected)["exposure"]) == {NAMES[2]}


def test_tables_that_cannot_be_told_apart_are_named(tmp_path, capsys):
    files = lists(tmp_path)
    rest = ["--shape", "500", "500", "--out", str(tmp_path / "m.ecsv")]
    again = f"{tmp_path}/20220715/../20220424/c0010.csv"
    assert main(["match", *files, again, *rest]) == 1
    assert f"{files[0]} and {again} are one file: give it once" in capsys.readouterr().err
    for path in files[:2]:  # with names of their own, which no folder changes
        table = Table.read(path)
        table["exposure"] = "night"
        table.write(path, overwrite=True)
    assert main(["match", *files, *rest]) == 1
    words = f"exposure night is in two tables, {files[0]} and {files[1]}: leave one out"
    assert words in capsys.readouterr().err
