"""Outputs appear whole or not at all."""

import pytest

from legdistort.exceptions import InputError
from legdistort.files import replacing, replacing_folder


def names(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))


def half(path):
    """A writer that fails on the way."""
    path.write_text("half")
    raise RuntimeError


def test_a_file_appears_when_it_is_whole(tmp_path):
    with replacing(tmp_path / "a.fits.gz") as temporary:
        assert temporary.name.endswith("a.fits.gz")  # writers choose compression by the ending
        assert not temporary.exists()
        temporary.write_text("new")
        assert not (tmp_path / "a.fits.gz").exists()
    assert (tmp_path / "a.fits.gz").read_text() == "new"
    assert names(tmp_path) == ["a.fits.gz"]


def test_a_failure_leaves_the_old_file(tmp_path):
    (tmp_path / "a").write_text("old")
    with pytest.raises(RuntimeError), replacing(tmp_path / "a", overwrite=True) as temporary:
        half(temporary)
    assert (tmp_path / "a").read_text() == "old"
    assert names(tmp_path) == ["a"]


def test_a_writer_that_writes_nothing_is_noticed(tmp_path):
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "a"):
        pass
    assert names(tmp_path) == []


def test_refusals(tmp_path):
    (tmp_path / "a").write_text("old")
    with pytest.raises(InputError, match="a exists already"), replacing(tmp_path / "a"):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match="is a folder"), replacing(tmp_path, overwrite=True):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match=r"the folder .*b does not exist"), replacing(tmp_path / "b" / "c"):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match="a is a file; give a folder"), replacing_folder(tmp_path / "a"):
        pytest.fail("the block must not run")


def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_text("")
    with replacing(tmp_path / "ours") as temporary:
        temporary.write_text("")
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
    with replacing_folder(out) as temporary:
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


def test_a_file_in_the_place_of_a_folder_and_the_reverse(tmp_path):
    (tmp_path / "out" / "was_folder").mkdir(parents=True)
    (tmp_path / "out" / "was_file").write_text("old")
    with replacing_folder(tmp_path / "out") as temporary:
        (temporary / "was_folder").write_text("new")
        (temporary / "was_file").mkdir()
    assert (tmp_path / "out" / "was_folder").is_file()
    assert (tmp_path / "out" / "was_file").is_dir()
