"""Files as people have them: read once however many images they hold, blank and truncated ones among good."""

import json
import re

import numpy as np
import pytest
from astropy.io import fits
from caller_warnings import warns_here

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs import exposure_files
from legdistort.runtime import fits_bytes
from legdistort.runtime.provenance import checksums

SHAPE = (256, 256)


def pixels(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).normal(100, 5, shape).astype("float32")


def mosaic_file(path, *names, shape=SHAPE):
    planes = [np.zeros(shape, "int16") if name == "DQ" else pixels(i, shape) for i, (name, _) in enumerate(names)]
    hdus = [fits.ImageHDU(plane, name=name, ver=v) for plane, (name, v) in zip(planes, names, strict=True)]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    return path


@pytest.mark.parametrize("packed", ["", ".gz"])
def test_a_file_is_opened_once_for_all_its_detectors(tmp_path, monkeypatch, packed):
    path = mosaic_file(tmp_path / f"a.fits{packed}", *((name, v) for v in (1, 2, 3, 4) for name in ("SCI", "DQ")))
    opened = []

    def counted(file, name, instead):
        opened.append(name)
        return fits_bytes.open_fits(file, name, instead)

    monkeypatch.setattr(exposure_files, "open_fits", counted)
    exposures = ld.open_exposures(path, ext="SCI")
    assert len(opened) <= 2  # which detectors there are, and what they hold
    assert {exposure.checksum for exposure in exposures} == set(checksums(path).values())
    for k, each in enumerate(exposures):
        assert np.array_equal(each.read().data, pixels(2 * k))
    alone = [ld.read_exposures(path, ext=("SCI", v))[0] for v in (1, 2, 3, 4)]
    assert all(np.array_equal(a.data, b.data) for a, b in zip(alone, ld.read_exposures(path, ext="SCI"), strict=True))


def test_frames_without_a_sky_and_their_exposures_are_told_once(tmp_path, capsys):
    """One line for all of a reason; detectors of an exposure are no exposures."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:64, :64]
    for name in ("a", "b"):
        images = [fits.PrimaryHDU()]
        for k in (1, 2):
            stars = sum(3000 * np.exp(-((x - c) ** 2 + (y - d) ** 2) / 4) for c, d in ((20, 20), (40, 45)))
            image = fits.ImageHDU((stars + rng.normal(100, 5, (64, 64))).astype("f4"), name="SCI", ver=k)
            image.header["DETECTOR"] = str(k)
            images.append(image)
        fits.HDUList(images).writeto(tmp_path / f"{name}.fits")
    words = ["--ext", "SCI", "--psf", "moffat", "--workers", "1", "--out", str(tmp_path / "stars.ecsv")]
    assert main(["measure", str(tmp_path / "a.fits"), str(tmp_path / "b.fits"), *words]) == 0
    out, err = capsys.readouterr()
    told = [line for line in err.splitlines() if "not used" in line]
    assert told == ["a_SCI1, a_SCI2, b_SCI1, b_SCI2: WCS of the header not used: it has no celestial axes"]
    assert out == "8 detections in 2 exposures, 4 images\n"
    assert main(["measure", str(tmp_path / "a.fits"), *words, "--overwrite"]) == 0
    assert capsys.readouterr().out == "4 detections in 1 exposure, 2 images\n"


def test_a_file_exchanged_between_two_detectors_is_noticed(tmp_path, monkeypatch):
    path = mosaic_file(tmp_path / "a.fits", ("SCI", 1), ("SCI", 2))
    read = exposure_files.from_hdulist

    def exchanged(hdulist, ext, *others):
        if ext == ("SCI", 2):
            path.write_bytes(path.read_bytes())
        return read(hdulist, ext, *others)

    monkeypatch.setattr(exposure_files, "from_hdulist", exchanged)
    with pytest.raises(InputError, match=r"a\.fits changed while it was read"):
        ld.open_exposures(path, ext="SCI")


def bad_files(folder):
    """Four bad files, and what is said of them."""
    fits.writeto(folder / "nan.fits", np.full(SHAPE, np.nan))
    fits.writeto(folder / "blank.fits", np.zeros(SHAPE, "int16"))
    fits.writeto(folder / "whole.fits", pixels())
    content = (folder / "whole.fits").read_bytes()
    (folder / "whole.fits").unlink()
    (folder / "cut.fits").write_bytes(content[: len(content) // 2])
    (folder / "empty.fits").write_bytes(b"")
    names = ["nan", "blank", "cut", "empty"]
    reasons = [
        "every pixel is NaN or blank",
        "every pixel has the same value",
        "truncated or damaged",
        "cannot be read",
    ]
    return [folder / f"{name}.fits" for name in names], dict(zip(names, reasons, strict=True))


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    return ld.simulate_exposures(small=True, size=320, n_stars=60, seed=3).write(tmp_path_factory.mktemp("night"))


def test_bad_files_are_left_out_together(tmp_path, night):
    bad, reasons = bad_files(tmp_path)
    left_out = {}
    with pytest.warns(AssumptionWarning) as told:
        good = ld.open_exposures([bad[0], *night[:2], *bad[1:]], left_out=left_out)
    (warning,) = [str(w.message) for w in told]
    assert [e.name for e in good] == [path.stem for path in night[:2]]
    assert left_out.keys() == reasons.keys()
    for name, reason in reasons.items():
        assert left_out[name].startswith(reason)
        assert f"{name}.fits: {left_out[name]}" in warning
    assert warning.startswith("4 of 6 frames cannot be used")


def test_a_message_of_many_files_is_short(tmp_path, night):
    """The reason, some names and how many more: for what is bad, and for what is there twice."""
    many = [tmp_path / f"bad{k:03d}.fits" for k in range(20)]
    copies = [tmp_path / f"copy{k:03d}.fits" for k in range(20)]
    for path in many:
        path.write_text("no FITS")
    for path in copies:
        path.write_bytes(night[0].read_bytes())
    left_out = {}
    with pytest.warns(AssumptionWarning) as told:
        ld.open_exposures([*many, *copies, *night[1:]], left_out=left_out)
    twice, bad = (str(w.message) for w in told)
    assert len(left_out) == 39
    assert re.match(r"the same exposure .*: copy001, .*, copy005 and 14 more: its pixels are those of copy000$", twice)
    assert re.match(r"20 of \d+ frames .*: bad000.fits, .*, bad004.fits and 15 more: cannot be read as FITS", bad)
    assert max(len(twice), len(bad)) < 500


def test_bad_files_are_refused_together(tmp_path, night):
    bad, reasons = bad_files(tmp_path)
    with pytest.raises(InputError) as error:
        ld.open_exposures([*bad, *night], left_out={}, stop_at_bad=True)
    with pytest.raises(InputError, match="one good frame is left") as lonely:
        ld.open_exposures([*bad, night[0]], left_out={})
    for name, reason in reasons.items():
        for message in (str(error.value), str(lonely.value)):
            assert f"{name}.fits: {reason}" in message
    with pytest.raises(InputError, match="no good frame is left"):
        ld.open_exposures(bad, left_out={})
    for path, reason in zip(bad, reasons.values(), strict=True):
        if path.stem != "blank":
            with pytest.raises(InputError, match=f"{path.stem}.*{reason}"):
                ld.read_exposures([*night, path])
        with pytest.raises(InputError, match=f"^[^;]*{path.stem}.*{reason}"):
            ld.open_exposures(path, left_out={})


def test_other_mistakes_are_errors_at_once(tmp_path, night):
    mef = mosaic_file(tmp_path / "mef.fits", ("SCI", 1), ("SCI", 2))
    for wrong, words in (
        (tmp_path / "none.fits", "no such file"),
        (mef, "holds 2 images"),
    ):
        with pytest.raises(InputError, match=words):
            ld.open_exposures([*night, wrong], left_out={})
    with warns_here(AssumptionWarning, match="the same exposure more than once"):
        assert len(ld.open_exposures([*night, night[0]], left_out={})) == len(night)
    with pytest.raises(InputError, match="two exposures"):
        ld.open_exposures([*night, night[0]])


def test_measure_and_match_leave_bad_files_out(tmp_path, night, capsys):
    bad, reasons = bad_files(tmp_path)
    out, matched = tmp_path / "a.ecsv", tmp_path / "m.ecsv"
    line = ["measure", *map(str, [*night[:4], *bad]), "--out", str(out), "--quiet"]
    assert main([*line, "--stop-at-bad"]) == 1
    error = capsys.readouterr().err
    assert all(f"{name}.fits: {reason}" in error for name, reason in reasons.items())
    assert not out.exists()
    assert main([*line, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["left_out"].keys() == reasons.keys()
    assert main(["match", str(out), "--out", str(matched), "--quiet", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["left_out"].keys() >= reasons.keys()


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_run_leaves_bad_files_out(tmp_path, night):
    bad, reasons = bad_files(tmp_path)
    with warns_here(AssumptionWarning, match="4 of 10 frames cannot be used"):
        made = ld.run([*night, *bad], out=tmp_path / "out", degree=1, clip=None)
    assert made.solution.left_out.keys() == reasons.keys() == made.summary["left_out"].keys()
    with pytest.raises(InputError, match="4 of 10 frames cannot be used"):
        ld.run([*night, *bad], out=tmp_path / "none", stop_at_bad=True)
    with pytest.warns(AssumptionWarning), pytest.raises(InputError, match="but there are only 3 usable exposures"):
        ld.run([*night[:3], *bad], out=tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_frames_without_a_star_are_named(tmp_path):
    for k in range(4):
        fits.PrimaryHDU(pixels(k)).writeto(tmp_path / f"f{k}.fits")
    with pytest.raises(InputError, match=r"no star was detected in any of the 4 frames: .*\(--threshold 3\)"):
        ld.run(str(tmp_path / "*.fits"), out=tmp_path / "out")


def test_a_mosaic_among_the_frames_is_told(tmp_path, night):
    """Results may stand beside the frames, and ``*.fits`` names them all."""
    header = fits.Header([("NCOMBINE", 4), ("CREATOR", "legdistort 0.1.0")])
    path = tmp_path / "mosaic.fits"
    fits.PrimaryHDU(pixels(9, (600, 700)), header).writeto(path)
    for frames in ([*night, path], [path, *night]):
        with pytest.raises(InputError, match=r"mosaic\.fits is no frame but a mosaic that legdistort made; leave it"):
            ld.run(frames, out=tmp_path / "out")
    fits.PrimaryHDU(pixels(9, (600, 700))).writeto(path, overwrite=True)
    with pytest.raises(InputError, match="give frames of one detector"):
        ld.run([*night, path], out=tmp_path / "out")
