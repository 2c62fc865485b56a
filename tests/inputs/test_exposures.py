"""Reading images: what is taken from a file, and what is refused in plain words."""

import gzip

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData, InverseVariance, StdDevUncertainty
from astropy.wcs import WCS

from legdistort.exceptions import InputError
from legdistort.inputs.exposure_files import read_exposures
from legdistort.inputs.exposures import Exposure
from legdistort.inputs.sky_wcs import believable_wcs

SHAPE = (30, 40)


@pytest.fixture
def data():
    return np.random.default_rng(0).normal(100, 5, SHAPE).astype(np.float32)


def tan_header(**changes):
    header = fits.Header()
    cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 30.0, "CRVAL2": 40.0, "CRPIX1": 20.0, "CRPIX2": 15.0}
    cards |= {"CD1_1": -1e-4, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1e-4}
    header.update(cards | changes)
    return header


def read_one(source, **options):
    (exposure,) = read_exposures(source, **options)
    return exposure


@pytest.mark.parametrize("suffix", [".fits", ".fit", ".fts", ".FITS", ".fits.gz", ".fit.gz"])
def test_paths_and_names(tmp_path, data, suffix):
    path = tmp_path / f"a.b_01{suffix}"
    fits.writeto(path, data)
    for source in (path, str(path), [path], (str(path),)):
        exposure = read_one(source)
        assert exposure.name == "a.b_01"
        assert exposure.path == path
        assert exposure.shape == SHAPE
        np.testing.assert_array_equal(exposure.data, data)
    assert not exposure.mask.any()
    assert exposure.data.dtype.isnative


def test_tile_compressed(tmp_path, data):
    path = tmp_path / "tiles.fits.fz"
    counts = np.round(data).astype(np.int16)
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(counts)]).writeto(path)
    exposure = read_one(path)
    assert exposure.name == "tiles"
    np.testing.assert_array_equal(exposure.data, counts)


def test_glob_and_order(tmp_path, data):
    for name in "bac":
        fits.writeto(tmp_path / f"{name}.fits", data)
    assert [e.name for e in read_exposures(str(tmp_path / "*.fits"))] == ["a", "b", "c"]
    assert [e.name for e in read_exposures([tmp_path / "c.fits", tmp_path / "a.fits"])] == ["c", "a"]
    with pytest.raises(InputError, match="no file matches"):
        read_exposures(str(tmp_path / "*.txt"))
    with pytest.raises(InputError, match="paths is empty"):
        read_exposures([])


def test_sources_in_memory_and_mixed(tmp_path, data):
    fits.writeto(tmp_path / "file.fits", data)
    ccd = CCDData(data, unit="adu", meta={"FILENAME": "from_ccd.fits", "GAIN": 1.5})
    hdus = fits.HDUList([fits.PrimaryHDU(data)])
    exposures = read_exposures([tmp_path / "file.fits", hdus, ccd])
    assert [e.name for e in exposures] == ["file", "exposure_1", "from_ccd"]
    assert exposures[2].gain == 1.5
    assert read_one(hdus).path is None
    with fits.open(tmp_path / "file.fits") as opened:
        assert read_one(opened).name == "file"


def test_duplicate_names(tmp_path, data):
    for path in (tmp_path / "a.fits", tmp_path / "a.fits.gz"):
        fits.writeto(path, data)
    with pytest.raises(InputError, match=r"two exposures are named 'a' .*a.fits and .*a.fits.gz"):
        read_exposures([tmp_path / "a.fits", tmp_path / "a.fits.gz"])


def multi_extension(data):
    hdus = [fits.PrimaryHDU(header=fits.Header({"EXPTIME": 30.0, "GAIN": 4.0}))]
    for version in (1, 2):
        dq = np.zeros(SHAPE, dtype=np.int16)
        dq[version, 3], dq[5, 6] = 1, 4
        hdus += [
            fits.ImageHDU(np.full(SHAPE, 3.0 * version, np.float32), name="ERR", ver=version),
            fits.ImageHDU(data + version, name="SCI", ver=version),
            fits.ImageHDU(dq, name="DQ", ver=version),
        ]
    return fits.HDUList(hdus)


def test_extensions_and_their_companions(tmp_path, data):
    path = tmp_path / "mef.fits"
    multi_extension(data).writeto(path)
    exposure = read_one(path, ext=("SCI", 1))
    assert exposure.name == "mef_SCI1"
    assert (exposure.gain, exposure.exposure_time) == (4.0, 30.0)
    np.testing.assert_array_equal(exposure.data, data + 1)
    np.testing.assert_array_equal(exposure.uncertainty, 3.0)
    np.testing.assert_array_equal(np.argwhere(exposure.mask), [[1, 3], [5, 6]])
    second = read_one(path, ext=("SCI", 2))
    assert second.name == "mef_SCI2"
    np.testing.assert_array_equal(second.uncertainty, 6.0)
    np.testing.assert_array_equal(np.argwhere(second.mask), [[2, 3], [5, 6]])
    assert [each.name for each in read_exposures(path, ext="SCI")] == ["mef-1", "mef-2"]  # the detectors of a camera
    assert read_one(path, ext=5).name == "mef_5"
    np.testing.assert_array_equal(read_one(path, ext=5).data, data + 2)
    with pytest.raises(InputError, match=r"mef.fits: no extension 'B'; the file has 0 PRIMARY, 1 ERR"):
        read_exposures(path, ext="B")
    with pytest.raises(InputError, match=r"mef.fits: no extension 17"):
        read_exposures(path, ext=17)
    with pytest.raises(InputError, match=r"mef.fits: no image in extension 0"):
        read_exposures(path, ext=0)


def test_do_not_use_bit(data):
    hdus = multi_extension(data)
    hdus[0].header["TELESCOP"] = "JWST"
    np.testing.assert_array_equal(np.argwhere(read_one(hdus, ext=("SCI", 1)).mask), [[1, 3]])


def test_variance_extension(data):
    variance = np.full(SHAPE, 9.0)
    variance[2, 2] = 0  # a pixel without a usable variance is bad
    hdus = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(data, name="SCI"), fits.ImageHDU(variance, name="VARIANCE")])
    exposure = read_one(hdus)
    assert exposure.uncertainty[0, 0] == 3
    np.testing.assert_array_equal(np.argwhere(exposure.mask), [[2, 2]])


@pytest.mark.parametrize("uncertainty", [StdDevUncertainty(np.full(SHAPE, 2.0)), InverseVariance(np.full(SHAPE, 0.25))])
def test_ccddata_round_trip(tmp_path, data, uncertainty):
    mask = np.zeros(SHAPE, dtype=bool)
    mask[4, 5] = True
    ccd = CCDData(data, unit=u.electron, mask=mask, uncertainty=uncertainty, wcs=WCS(tan_header()))
    ccd.write(tmp_path / "ccd.fits")
    for exposure in (read_one(ccd), read_one(tmp_path / "ccd.fits")):
        np.testing.assert_array_equal(exposure.mask, mask)
        np.testing.assert_allclose(exposure.uncertainty, 2.0)
        assert exposure.gain == 1.0
        assert exposure.wcs.has_celestial


def test_integers_scaling_and_blanks(tmp_path):
    counts = np.arange(1200, dtype=np.uint16).reshape(SHAPE) + 40000
    fits.writeto(tmp_path / "unsigned.fits", counts)
    exposure = read_one(tmp_path / "unsigned.fits")
    assert exposure.data.dtype == np.float32
    np.testing.assert_array_equal(exposure.data, counts)
    hdu = fits.PrimaryHDU(np.arange(1200, dtype=np.int16).reshape(SHAPE))
    hdu.header["BLANK"] = 7
    hdu.writeto(tmp_path / "blank.fits")
    np.testing.assert_array_equal(np.argwhere(read_one(tmp_path / "blank.fits").mask), [[0, 7]])
    scaled = fits.PrimaryHDU(np.linspace(0, 50, 1200, dtype=np.float32).reshape(SHAPE))
    scaled.scale("int16", bscale=0.01, bzero=20)
    scaled.writeto(tmp_path / "scaled.fits")
    np.testing.assert_allclose(read_one(tmp_path / "scaled.fits").data.ravel(), np.linspace(0, 50, 1200), atol=0.006)
    assert read_one(fits.HDUList([fits.PrimaryHDU(np.ones(SHAPE, np.int32))])).data.dtype == np.float64


def test_nan_pixels_are_masked(data):
    data[3, 4], data[5, 6] = np.nan, np.inf
    exposure = read_one(fits.HDUList([fits.PrimaryHDU(data)]))
    np.testing.assert_array_equal(np.argwhere(exposure.mask), [[3, 4], [5, 6]])
    assert repr(exposure) == "<Exposure 'exposure_0': 40 x 30 px, 2 masked, no WCS>"


def test_saturation():
    rng = np.random.default_rng(0)
    counts = rng.poisson(50, SHAPE).astype(np.int16)
    assert read_one(fits.HDUList([fits.PrimaryHDU(counts)])).saturation is None
    counts[10:13, 10:13] = 4095
    assert read_one(fits.HDUList([fits.PrimaryHDU(counts)])).saturation == 4095
    assert read_one(fits.HDUList([fits.PrimaryHDU(counts.astype(np.float32))])).saturation is None
    header = fits.Header({"SATURATE": 3000})
    assert read_one(fits.HDUList([fits.PrimaryHDU(counts, header)])).saturation == 3000


@pytest.mark.parametrize(
    ("cards", "gain"),
    [
        ({"GAIN": 2.5}, 2.5),
        ({"GAIN": 139, "EGAIN": 0.8}, 0.8),  # GAIN as a setting of the camera
        ({"GAIN": "high"}, None),
        ({"GAIN": -1}, None),
        ({"BUNIT": "electrons/s", "EXPTIME": 20.0}, 20.0),
        ({"BUNIT": "electron"}, 1.0),
        ({"HIERARCH ESO DET OUT1 CONAD": 1.9}, 1.9),
        ({}, None),
    ],
)
def test_gain(data, cards, gain):
    header = fits.Header()
    header.update(cards)
    assert read_one(fits.HDUList([fits.PrimaryHDU(data, header)])).gain == gain


def test_believable_wcs(data):
    exposure = read_one(fits.HDUList([fits.PrimaryHDU(data, tan_header())]))
    np.testing.assert_allclose(exposure.wcs.pixel_to_world_values(19, 14), [30, 40])
    assert repr(exposure).endswith("0 masked, WCS>")


@pytest.mark.parametrize(
    "changes",
    [
        {"CTYPE1": "", "CTYPE2": ""},
        {"CTYPE1": "LINEAR", "CTYPE2": "LINEAR"},
        {"CD1_1": -1.0, "CD2_2": 1.0},  # the default of a header without scale: a degree a pixel
        {"CD1_1": 0.0, "CD2_2": 0.0},
        {"CD1_1": 1e-4, "CD1_2": 1e-4, "CD2_1": 1e-4, "CD2_2": 1e-4},  # singular
        {"CD1_1": -1e-4, "CD2_2": 1e-3},
        {"CRPIX1": 1e5},
        {"CRVAL2": 400.0},
    ],
)
def test_unbelievable_wcs(data, changes):
    assert read_one(fits.HDUList([fits.PrimaryHDU(data, tan_header(**changes))])).wcs is None


def test_wcs_of_sky_is_kept_celestial():
    wcs = WCS(tan_header())
    assert believable_wcs(wcs, SHAPE).naxis == 2
    assert believable_wcs(WCS(naxis=2), SHAPE) is None


def write_truncated(path, data, keep):
    fits.writeto(path.with_name("whole.fits"), np.tile(data, (20, 20)))
    content = path.with_name("whole.fits").read_bytes()
    if path.name.endswith(".gz"):
        content = gzip.compress(content)
    path.write_bytes(content[: int(keep * len(content))])


@pytest.mark.parametrize("keep", [0.01, 0.5])
@pytest.mark.parametrize("name", ["cut.fits", "cut.fits.gz"])
def test_truncated(tmp_path, data, name, keep):
    path = tmp_path / name
    write_truncated(path, data, keep)
    with pytest.raises(InputError, match=rf"{name}: (truncated|cannot be read)"):
        read_exposures(path)


def test_not_fits(tmp_path):
    (tmp_path / "text.fits").write_text("SIMPLE as that\n" * 400)
    (tmp_path / "empty.fits").write_bytes(b"")
    (tmp_path / "noise.fits.gz").write_bytes(b"\x1f\x8b" + bytes(range(256)))
    for name in ("text.fits", "empty.fits", "noise.fits.gz"):
        with pytest.raises(InputError, match=f"{name}: cannot be read as FITS"):
            read_exposures(tmp_path / name)
    with pytest.raises(InputError, match=r"text.fits: .* \(it has no card SIMPLE\); tables of positions go to match\("):
        read_exposures(tmp_path / "text.fits")
    with pytest.raises(InputError, match=r"nowhere.fits: no such file"):
        read_exposures(tmp_path / "nowhere.fits")
    with pytest.raises(InputError, match=r"is not a file but a folder; name the files in it \(.*/\*\)"):
        read_exposures(tmp_path)
    with pytest.raises(InputError, match="must be a path, an HDUList or an NDData, got int"):
        read_exposures([3])


def test_no_image(tmp_path):
    table = fits.BinTableHDU.from_columns([fits.Column("a", "E", array=np.ones(3))])
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "table.fits")
    with pytest.raises(InputError, match=r"table.fits: no image"):
        read_exposures(tmp_path / "table.fits")
    for shape in ((7,), (3, 20, 20)):
        with pytest.raises(InputError, match=rf"no 2-D image, the data have shape \({shape[0]},"):
            read_exposures(fits.HDUList([fits.PrimaryHDU(np.ones(shape))]))


def test_nothing_good(tmp_path, data):
    fits.writeto(tmp_path / "nan.fits", np.full(SHAPE, np.nan))
    with pytest.raises(InputError, match="nan: every pixel is NaN or blank"):
        read_exposures(tmp_path / "nan.fits")
    with pytest.raises(InputError, match="m: every pixel is hidden by the mask"):
        Exposure("m", data, mask=np.ones(SHAPE))
    with pytest.raises(InputError, match="m: every pixel is hidden by the mask or the uncertainty"):
        Exposure("m", data, uncertainty=np.zeros(SHAPE))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": np.ones(4)}, r"the data have shape \(4,\)"),
        ({"data": np.ones(SHAPE, dtype=complex)}, "must be real numbers, got complex128"),
        ({"mask": np.zeros((2, 2))}, r"the mask has shape \(2, 2\), the image \(30, 40\)"),
        ({"uncertainty": np.ones((2, 2))}, "the uncertainty has shape"),
    ],
)
def test_exposure_checks_its_planes(data, change, message):
    with pytest.raises(InputError, match=f"e: .*{message}|e: {message}"):
        Exposure("e", **({"data": data} | change))


def test_exposure_is_frozen_and_leaves_its_input_alone(data):
    mask = np.zeros(SHAPE, dtype=bool)
    data[0, 0] = np.nan
    exposure = Exposure("e", data, mask=mask)
    assert not mask.any()
    assert exposure.mask[0, 0]
    with pytest.raises(AttributeError):
        exposure.name = "other"


def test_real_frames(shared_data):
    exposures = read_exposures(str(shared_data / "microobs_hatp32" / "frames" / "*.fits.gz"))
    assert len(exposures) == 12
    assert exposures[0].name == "HATP-32171220013343"
    assert {e.shape for e in exposures} == {(500, 650)}
    assert {e.saturation for e in exposures} == {4095.0}
    assert {e.exposure_time for e in exposures} == {60.0}
    assert all(e.wcs is None and e.gain is None for e in exposures)
