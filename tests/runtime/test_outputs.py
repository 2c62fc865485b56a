"""Outputs appear whole or not at all, under names that say what they are, and never in the place of an input."""

import bz2
import gzip
from io import BytesIO

import asdf
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from legdistort.coaddition.mosaic import Mosaic
from legdistort.exceptions import InputError
from legdistort.runtime.outputs import check_file, check_folder, check_not_read, replacing, replacing_folder


def names(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))


def half(path):
    """A writer that fails on the way."""
    path.write_text("half")
    raise RuntimeError


def half_written(file):
    """The same into an open file."""
    file.write(b"half")
    raise RuntimeError


def test_a_file_appears_when_it_is_whole(tmp_path):
    with replacing(tmp_path / "A.FITS.gz") as file:
        file.write(b"new")
        assert not (tmp_path / "A.FITS.gz").exists()
    assert (tmp_path / "A.FITS.gz").read_text() == "new"
    assert names(tmp_path) == ["A.FITS.gz"]


def test_a_failure_leaves_the_old_file(tmp_path):
    (tmp_path / "a").write_text("old")
    with pytest.raises(RuntimeError), replacing(tmp_path / "a", overwrite=True) as file:
        half_written(file)
    assert (tmp_path / "a").read_text() == "old"
    assert names(tmp_path) == ["a"]


def test_refusals(tmp_path):
    (tmp_path / "a").write_text("old")
    with pytest.raises(InputError, match="a exists already"), replacing(tmp_path / "a"):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match="is a folder"), replacing(tmp_path, overwrite=True):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match="a is a file; give a folder"), replacing(tmp_path / "a" / "c"):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match="a is a file; give a folder"), replacing_folder(tmp_path / "a"):
        pytest.fail("the block must not run")


def test_the_folder_of_a_file_is_made_and_goes_again_after_a_failure(tmp_path):
    place = tmp_path / "b" / "below" / "c"
    with pytest.raises(RuntimeError), replacing(place) as file:
        half_written(file)
    assert not names(tmp_path)
    with replacing(place) as file:
        file.write(b"new")
    assert place.read_text() == "new"


def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_text("")
    with replacing(tmp_path / "ours") as file:
        file.write(b"")
    with replacing_folder(tmp_path / "folder") as temporary:
        (temporary / "inner").write_text("")
    (tmp_path / "other").mkdir()
    mode = {p.name: p.stat().st_mode for p in tmp_path.iterdir()}
    assert mode["ours"] == mode["plain"]
    assert mode["folder"] == mode["other"]


def test_a_folder_is_filled_and_keeps_the_rest(tmp_path):
    out = tmp_path / "deep" / "out"
    (out / "wcs").mkdir(parents=True)
    for name in ("mine.txt", "report.html", "wcs/stale.asdf"):
        (out / name).write_text("old")
    with replacing_folder(out, results=("report.html", "wcs/*.asdf")) as temporary:
        (temporary / "report.html").write_text("new")
        (temporary / "wcs").mkdir()
        (temporary / "wcs" / "a.asdf").write_text("new")
        assert (out / "report.html").read_text() == "old"
    assert names(out) == ["mine.txt", "report.html", "wcs", "wcs/a.asdf"]
    assert (out / "report.html").read_text() == "new"
    assert names(tmp_path / "deep") == ["out", *(f"out/{n}" for n in names(out))]


@pytest.mark.parametrize("existing", [True, False])
def test_a_failure_leaves_the_folder_as_it_was(tmp_path, existing):
    out = tmp_path / "out"
    if existing:
        out.mkdir()
        (out / "a").write_text("old")
    with pytest.raises(RuntimeError), replacing_folder(out) as temporary:
        half(temporary / "a")
    assert names(tmp_path) == (["out", "out/a"] if existing else [])
    assert not existing or (out / "a").read_text() == "old"


def test_a_new_folder_with_its_parents(tmp_path):
    with replacing_folder(tmp_path / "x" / "y") as temporary:
        (temporary / "a").write_text("1")
    assert names(tmp_path) == ["x", "x/y", "x/y/a"]


def test_a_file_in_the_place_of_a_folder_and_the_reverse_are_refused(tmp_path):
    (tmp_path / "out" / "was_folder").mkdir(parents=True)
    (tmp_path / "out" / "was_file").write_text("old")
    before = names(tmp_path)
    with (
        pytest.raises(InputError, match=r"was_folder is a folder, in the place of a file: move it away"),
        replacing_folder(tmp_path / "out") as temporary,
    ):
        (temporary / "was_folder").write_text("new")
    with (
        pytest.raises(InputError, match=r"was_file is a file or a link, in the place of a folder: move it"),
        replacing_folder(tmp_path / "out") as temporary,
    ):
        (temporary / "was_file").mkdir()
    assert names(tmp_path) == before


# --- checks before any work ---------------------------------------------------------------------------------------


def test_files_and_folders_are_checked_beforehand(tmp_path):
    (tmp_path / "a").write_text("old")
    check_file(tmp_path / "new")
    check_file(tmp_path / "a", overwrite=True)
    check_folder(tmp_path / "x" / "y")
    check_folder(tmp_path)
    assert names(tmp_path) == ["a"]
    for bad, words in ((tmp_path / "a", "exists already"), (tmp_path, "is a folder"), (tmp_path / "a/c", "is a file")):
        with pytest.raises(InputError, match=words):
            check_file(bad)
    for bad in (tmp_path / "a", tmp_path / "a" / "b"):
        with pytest.raises(InputError, match="a is a file; give a folder"):
            check_folder(bad)


def test_folders_without_permission(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda place, mode: place != tmp_path)  # root may write anywhere
    with pytest.raises(InputError, match=r"a cannot be written: no permission in .*; write elsewhere"):
        check_file(tmp_path / "a")
    with pytest.raises(InputError, match=r"out cannot be written: no permission in"):
        check_folder(tmp_path / "out")


def test_inputs_are_not_replaced(tmp_path):
    (tmp_path / "wcs").mkdir()
    for name in ("a.fits", "b.fits", "wcs/a.asdf"):
        (tmp_path / name).write_text(name)
    (tmp_path / "link.fits").symlink_to("a.fits")
    (tmp_path / "hard.fits").hardlink_to(tmp_path / "a.fits")
    inputs = [str(tmp_path / "wcs" / ".." / "a.fits"), tmp_path / "wcs" / "a.asdf", "gsaoi-1", "no\0name"]
    for other in ("a.fits", "link.fits", "hard.fits", "wcs"):
        with pytest.raises(InputError, match=r"a\.(fits|asdf) is read, and would be replaced: give the output another"):
            check_not_read(tmp_path / other, inputs)
    for other in ("b.fits", "new.fits"):
        check_not_read(tmp_path / other, inputs)


# --- the file of a mosaic -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mosaic():
    plane = np.arange(12.0, dtype="f4").reshape(3, 4)
    context = np.ones((1, 3, 4), "u4")
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["LINEAR", "LINEAR"]
    return Mosaic(plane, plane, plane, plane.astype("i4"), plane.astype("u1"), context, wcs, exposures=("e1",))


@pytest.mark.parametrize("name", ["m.fits", "M.FITS", "m.fit", "m.FTS", "m.v2.Fits"])
def test_fits_files(mosaic, tmp_path, name):
    mosaic.write(tmp_path / name)
    assert names(tmp_path) == [name]
    assert (tmp_path / name).read_bytes()[:9] == b"SIMPLE  ="
    np.testing.assert_array_equal(fits.getdata(tmp_path / name), mosaic.data)


@pytest.mark.parametrize(
    ("name", "unpack"),
    [("m.fits.gz", gzip), ("M.FITS.GZ", gzip), ("m.fts.Gz", gzip), ("m.fits.bz2", bz2), ("m.fit.BZ2", bz2)],
)
def test_packed_fits_files(mosaic, tmp_path, name, unpack):
    mosaic.write(tmp_path / name)
    assert names(tmp_path) == [name]
    with fits.open(BytesIO(unpack.decompress((tmp_path / name).read_bytes()))) as hdulist:
        np.testing.assert_array_equal(hdulist["SCI"].data, mosaic.data)
        assert len(hdulist) == 4


@pytest.mark.parametrize("name", ["m.asdf", "M.ASDF"])
def test_asdf_files(mosaic, tmp_path, name):
    mosaic.write(tmp_path / name)
    with asdf.open(tmp_path / name) as file:
        np.testing.assert_array_equal(file["mosaic"]["footprint"], mosaic.footprint)


@pytest.mark.parametrize(
    "name", ["m", "m.png", "a.hdf5", "a.fits.fz", "a.fits.zip", "a.fits.xz", "a.asdf.gz", "a.gz", "a.fitsx", "fits"]
)
def test_other_endings_are_refused(mosaic, tmp_path, name):
    (tmp_path / name).write_text("precious")
    with pytest.raises(InputError, match=rf"{name}: the ending selects the format of a mosaic; give \.fits"):
        mosaic.write(tmp_path / name, overwrite=True)
    assert (tmp_path / name).read_text() == "precious"
    assert names(tmp_path) == [name]


def test_pixels_of_a_mosaic_are_whole_numbers(mosaic):
    assert mosaic.contributors(3, 2.0) == mosaic.contributors(np.int64(3), 2) == ("e1",)
    for x, y in ((0.4, 1), (1, 1.6), (np.nan, 1)):
        with pytest.raises(InputError, match=rf"whole numbers, got \({x}, {y}\)"):
            mosaic.contributors(x, y)
    for x, y in ((-1, 0), (4, 0), (0, 3)):
        with pytest.raises(InputError, match="is not one of the 4 x 3 of the mosaic"):
            mosaic.contributors(x, y)
