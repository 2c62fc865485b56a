"""Several images in one file: which are of the sky, and how one of them is chosen."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData
from numpy.testing import assert_allclose, assert_array_equal

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.coaddition.grids import read_grid
from legdistort.exceptions import InputError
from legdistort.inputs.file_images import detector_names, find_image

SHAPE = (256, 256)


def pixels(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).normal(100, 5, shape).astype("float32")


def mosaic_file(path, *names, shape=SHAPE):
    planes = [np.zeros(shape, "int16") if name == "DQ" else pixels(i, shape) for i, (name, _) in enumerate(names)]
    hdus = [fits.ImageHDU(plane, name=name, ver=v) for plane, (name, v) in zip(planes, names, strict=True)]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    return path


@pytest.mark.parametrize("read", [ld.read_exposures, ld.open_exposures])
@pytest.mark.parametrize(
    ("names", "told", "ext"),
    [
        ([("SCI", 1), ("ERR", 1), ("SCI", 2), ("DQ", 2)], "2 images, SCI,1 (256, 256), SCI,2 (256, 256)", ("SCI", 2)),
        ([("CHIP1", 1), ("CHIP2", 1)], "2 images, CHIP1,1 (256, 256), CHIP2,1 (256, 256)", "CHIP2"),
        ([("", 1), ("", 1)], "2 images, 1 (256, 256), 2 (256, 256)", 2),
        ([("S", 1), ("S", 1)], "2 images, 1 (256, 256), 2 (256, 256)", 2),
    ],
)
def test_several_images_are_refused_with_their_list(tmp_path, read, names, told, ext):
    path = mosaic_file(tmp_path / "mef.fits", *names)
    with pytest.raises(InputError) as error:
        read(path)
    message = str(error.value)
    assert message.startswith(f"{path} holds {told} (ny, nx): choose one, such as ext=")
    assert "(--ext " in message
    assert ("as the detectors of one camera, ext='SCI' (--ext SCI)" in message) == (names[0][0] == "SCI")
    (chosen,) = read(path, ext=ext)
    assert np.array_equal(chosen.read().data, pixels(2 if len(names) == 4 else 1))


def gemini_file(path, *, names=("", "", "", ""), section="DETSEC", chips="1234", ids="EXTVER"):
    """A raw frame of GSAOI: four images without a name, with EXTVER and their sections of the array."""
    hdus = [fits.PrimaryHDU(header=fits.Header({"INSTRUME": "GSAOI", "EXPTIME": 30.0}))]
    for k, (name, corner) in enumerate(zip(names, ("257:512,1:256", "1:256,1:256", "1:256,257:512", "257:512,257:512"),
                                           strict=True)):  # fmt: skip
        cards = {ids: k + 1, "CCDSEC": "[1:256,1:256]", "CCDNAME": f"H2RG-{chips[k]}", section: f"[{corner}]"}
        hdus.append(fits.ImageHDU(pixels(k), fits.Header(cards), name or None))
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize("read", [ld.read_exposures, ld.open_exposures])
def test_images_without_a_name_are_detectors_by_their_sections(tmp_path, caplog, read):
    """As raw frames of Gemini have them: read as if they were called SCI, and found again by `attach`."""
    raw = gemini_file(tmp_path / "S20260412S0101.fits")
    with caplog.at_level("INFO"):
        found = read(raw)
    assert "4 images without a name in a file are taken for the detectors of one camera, by DETSEC" in caplog.text
    named = read(gemini_file(tmp_path / "named.fits", names=["SCI"] * 4), ext="SCI")
    assert [each.detector for each in found] == [each.detector for each in named] == ["1", "2", "3", "4"]
    assert [each.name for each in found] == [f"S20260412S0101-{k}" for k in range(1, 5)]
    assert {each.exposure for each in found} == {"S20260412S0101"}
    for k, each in enumerate(found):
        assert_array_equal(each.read().data, pixels(k))
    with fits.open(raw) as hdulist:
        images = {name: find_image(hdulist, form, "raw") for name, form in detector_names(hdulist, raw).items()}
        for k in range(4):
            assert images[f"S20260412S0101-{k + 1}"] is hdulist[k + 1]
    plain = tmp_path / "one.fits"
    fits.writeto(plain, pixels(9))
    assert [each.name for each in read([raw, plain])] == [each.name for each in found] + ["one"]
    with pytest.raises(InputError, match=r"'SCI'; the file has .*: leave ext \(--ext\) out to read all detectors"):
        read(raw, ext="SCI")


@pytest.mark.parametrize("ext", [None, ""])
@pytest.mark.parametrize(("ids", "named"), [("FRAMEID", "1234"), ("NOTHING", ["H2RG-2", "H2RG-1", "H2RG-4", "H2RG-3"])])
def test_detectors_without_versions_are_read_by_their_number(tmp_path, ids, named, ext):
    """Neither names nor EXTVER: by what else tells them apart, all four, and found again by `attach`."""
    path = gemini_file(tmp_path / "S1.fits", ids=ids, chips="2143")
    found = ld.open_exposures(path, ext=ext)
    assert [each.name for each in found] == [f"S1-{key}" for key in named]
    assert [each.detector for each in found] == list(named)
    for k, each in enumerate(found):
        assert_array_equal(each.read().data, pixels(k))
    with fits.open(path) as hdulist:
        forms = detector_names(hdulist, path)
        assert all(find_image(hdulist, forms[each.name], "raw") is hdulist[k + 1] for k, each in enumerate(found))


@pytest.mark.parametrize("versions", [(1, 2, 3, 4), (1, 1, 1, 1)])
@pytest.mark.parametrize("ext", [None, "IM*"])
def test_numbered_images_are_detectors_by_their_sections(tmp_path, caplog, versions, ext):
    """IM1 to IM4, as pipelines name them: by themselves, or by a pattern, with planes beside them."""
    path = gemini_file(tmp_path / "S1.fits", names=["IM1", "IM2", "IM3", "IM4"])
    with fits.open(path, mode="update") as hdulist:
        for hdu, version in zip(hdulist[1:], versions, strict=True):
            hdu.ver = version
        hdulist.append(fits.ImageHDU(np.zeros(SHAPE, "int16"), name="DQ1"))
    with caplog.at_level("INFO"):
        found = ld.open_exposures(path, ext=ext)
    told = "4 images IM1 to IM4 in a file are taken for the detectors of one camera, by DETSEC" in caplog.text
    assert told == (ext is None)
    ids = [str(k) if len(set(versions)) > 1 else f"IM{k}" for k in (1, 2, 3, 4)]
    assert [each.name for each in found] == [f"S1-{key}" for key in ids]
    assert {each.exposure for each in found} == {"S1"}
    for k, each in enumerate(found):
        assert_array_equal(each.read().data, pixels(k))
    with fits.open(path) as hdulist:
        forms = detector_names(hdulist, path, ext)
        assert all(find_image(hdulist, forms[each.name], "raw") is hdulist[k + 1] for k, each in enumerate(found))


def test_numbered_images_that_nothing_places_are_asked_for(tmp_path):
    """Amplifiers of two detectors, and images without sections: the pattern that takes them all is advised."""
    names = ["IM1", "IM2", "IM3", "IM4"]
    amplifiers = gemini_file(tmp_path / "amps.fits", names=names, chips="1122")
    plain = mosaic_file(tmp_path / "plain.fits", *((name, 1) for name in names))
    for path in (amplifiers, plain):
        with pytest.raises(InputError, match=r"take all as the detectors .*, ext='(IM.*)' \(--ext 'IM.*'\)"):
            ld.read_exposures(path)
        assert len(ld.read_exposures(path, ext="IM*")) == 4
    (one,) = ld.read_exposures(plain, ext="*M3")
    assert_array_equal(one.data, pixels(2))
    with pytest.raises(InputError, match=r"no extension 'CCD\*'"):
        ld.read_exposures(plain, ext="CCD*")


def test_images_of_one_name_and_version_are_all_read(tmp_path):
    """Never one of them in silence: as the detectors 1, 2, ..., since nothing else tells them apart."""
    path = mosaic_file(tmp_path / "mef.fits", ("S", 1), ("S", 1))
    found = ld.read_exposures(path, ext="S")
    assert [each.name for each in found] == ["mef-1", "mef-2"]
    assert all(np.array_equal(each.data, pixels(k)) for k, each in enumerate(found))


@pytest.mark.parametrize(
    "settings", [{"section": "BIASSEC"}, {"chips": "1122"}, {"names": ["A", "B", "C", "D"]}], ids=["none", "amps", "AB"]
)
def test_what_may_not_be_detectors_is_asked_for(tmp_path, settings):
    """No sections, amplifiers of two detectors, names: one image is chosen, or all by their name, if it is one."""
    path = gemini_file(tmp_path / "raw.fits", **settings)
    with pytest.raises(InputError, match="holds 4 images") as error:
        ld.read_exposures(path)
    every = "take all as the detectors of one camera, ext='' (--ext '')" in str(error.value)
    assert every == ("names" not in settings)
    if every:
        assert len(ld.read_exposures(path, ext="")) == 4


def test_a_long_list_is_cut(tmp_path):
    path = mosaic_file(tmp_path / "mef.fits", *((f"N{i}", 1) for i in range(12)), shape=(8, 8))
    with pytest.raises(InputError, match=r"holds 12 images, N0,1 .*, N7,1 \(8, 8\) and 4 more \(ny"):
        ld.read_exposures(path)


def test_a_cube_beside_an_image(tmp_path):
    cube = fits.ImageHDU(np.ones((3, 8, 8), "float32"))
    for hdus, words in (
        ([cube, fits.ImageHDU(pixels(shape=(8, 8)))], r"holds 2 images, 1 \(3, 8, 8\), 2 \(8, 8\)"),
        ([fits.ImageHDU(cube.data, name="SCI"), fits.ImageHDU(pixels(shape=(8, 8)), name="AREA")], "no 2-D image"),
    ):
        fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(tmp_path / "cube.fits", overwrite=True)
        with pytest.raises(InputError, match=words):
            ld.read_exposures(tmp_path / "cube.fits")


@pytest.mark.parametrize("further", [(1,), (1, 1)])
@pytest.mark.parametrize("read", [ld.read_exposures, ld.open_exposures])
def test_axes_of_one_pixel_are_none(tmp_path, read, further):
    """The same frame, with its planes and the WCS of its header, as with two axes."""
    header = fits.Header({"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CRVAL1": 83.8, "CRVAL2": -5.4,
                          "CRPIX1": 100.0, "CRPIX2": 120.0, "CD1_1": -1e-5, "CD2_2": 1e-5, "A_ORDER": 2, "B_ORDER": 2,
                          "A_2_0": 1e-5, "B_0_2": -1e-5})  # fmt: skip
    data, error, flags = pixels(), np.full(SHAPE, 5, "float32"), np.zeros(SHAPE, "int16")
    flags[3, 4] = 1
    for name, axes in (("flat", ()), ("deep", further)):
        planes = {"SCI": data, "ERR": error, "DQ": flags}
        hdus = [fits.ImageHDU(a.reshape(axes + SHAPE), header if n == "SCI" else None, n) for n, a in planes.items()]
        hdus[2] = fits.ImageHDU(flags, name="DQ")  # of two axes beside an image of more
        fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(tmp_path / f"{name}.fits")
    (flat,), (deep,) = (read(tmp_path / f"{name}.fits") for name in ("flat", "deep"))
    assert deep.shape == SHAPE
    assert_array_equal(deep.read().data, flat.read().data)
    assert_array_equal(deep.read().mask, flags > 0)
    assert_array_equal(deep.read().uncertainty, 5)
    places = [e.wcs.all_pix2world([[10.0, 20.0], [200.0, 50.0]], 0) for e in (flat, deep)]
    assert_allclose(*places, rtol=0, atol=1e-12)
    array = CCDData(data.reshape(further + SHAPE), unit="adu", mask=(flags > 0).reshape(further + SHAPE))
    assert_array_equal(ld.read_exposures(array)[0].mask, flags > 0)
    priors = [ld.Prior.from_file(tmp_path / f"{name}.fits") for name in ("flat", "deep")]
    assert_allclose(*(prior.mean for prior in priors), rtol=0, atol=1e-9)
    assert read_grid(tmp_path / "deep.fits").array_shape == SHAPE


@pytest.mark.parametrize(
    "beside", ["WHT", "CTX", "VAR_POISSON", "WHT2", "WCSDVARR", "D2IMARR", "CHIP1.DQ", "bad_pixel_mask", "PSFIMAGE"]
)
def test_planes_beside_an_image_do_not_count(tmp_path, beside):
    for name in ("SCI", "DATA", ""):
        path = mosaic_file(tmp_path / f"a{name}.fits", (name, 1), (beside, 1))
        assert np.array_equal(ld.read_exposures(path)[0].data[0], pixels(0)[0])
    alone = mosaic_file(tmp_path / "alone.fits", (beside, 1))
    assert ld.read_exposures(alone)[0].name == "alone"


def test_ccddata_has_one_image(tmp_path):
    CCDData(pixels(), unit="adu", mask=np.zeros(SHAPE, bool)).write(tmp_path / "ccd.fits")
    assert ld.read_exposures(tmp_path / "ccd.fits")[0].shape == SHAPE


def test_the_command_names_the_way_out(tmp_path, capsys):
    path = mosaic_file(tmp_path / "mef.fits", ("SCI", 1), ("SCI", 2))
    assert main(["measure", str(path), "--out", str(tmp_path / "a.ecsv"), "--quiet"]) == 1
    told = capsys.readouterr().err
    assert "mef.fits holds 2 images, SCI,1" in told
    one, every = (part.split()[0].strip(",") for part in told.split("--ext ")[1:])
    assert (one, every) == ("SCI,1", "SCI")
    assert "ext=" not in told
    for option in (one, every):
        given = ["--out", str(tmp_path / "a.ecsv"), "--quiet", "--overwrite", "--ext", option]
        assert main(["measure", str(path), *given]) == 0
