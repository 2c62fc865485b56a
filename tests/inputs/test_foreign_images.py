"""Images with what belongs to them in the forms of others: NDData, JWST, Roman, flags of pixels, any shared WCS."""

import io
import pickle
import warnings

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import InverseVariance, NDData, StdDevUncertainty, UnknownUncertainty, VarianceUncertainty
from astropy.table import QTable
from astropy.time import Time
from astropy.wcs import WCS
from astropy.wcs.wcsapi import SlicedLowLevelWCS
from numpy.testing import assert_allclose, assert_array_equal

import legdistort as ld
from legdistort.cli import parser
from legdistort.exceptions import AssumptionWarning, DamagedError, InputError
from legdistort.geometry.distortion import Distortion
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.frames.pixel_flags import bad_pixels, good_bits
from legdistort.inputs.references.catalogue import EXACT, read_reference
from legdistort.inputs.sky_wcs import believable_wcs, to_icrs
from legdistort.matching.header_poses import HeaderPoses
from legdistort.priors.from_headers import header_distortions
from legdistort.wcs.exposure_wcs import exposure_wcs

SHAPE = (96, 80)
PLANE = TangentPlane(150.0, 2.0, np.array([[-1e-5, 2e-6, 0.0], [2e-6, 1e-5, 0.0]]))


@pytest.fixture
def data():
    return np.random.default_rng(5).normal(100, 3, SHAPE).astype(np.float32)


def bent_wcs(shift=0.0):
    """A gwcs with a pixel of distortion, made of stock models."""
    coefficients = np.zeros((2, 10))
    coefficients[0, 3], coefficients[1, 4] = 0.8, -0.5
    pose = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]])
    return exposure_wcs("a", pose, Distortion(coefficients, SHAPE, "a"), PLANE)


def linear_wcs():
    header = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CRVAL1": 150.0,
        "CRVAL2": 2.0,
        "CRPIX1": 40.5,
        "CRPIX2": 48.5,
    }
    return WCS(fits.Header(header | {"CDELT1": -1e-5, "CDELT2": 1e-5}))


# --- NDData ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("uncertainty", [StdDevUncertainty, VarianceUncertainty, InverseVariance])
def test_nddata(data, uncertainty):
    values = {StdDevUncertainty: 3.0, VarianceUncertainty: 9.0, InverseVariance: 1 / 9}[uncertainty]
    mask = np.zeros(SHAPE, bool)
    mask[4, 5] = True
    image = NDData(data, uncertainty=uncertainty(np.full(SHAPE, values)), mask=mask, wcs=bent_wcs(), unit="electron",
                   meta={"FILENAME": "a1.fits", "EXPTIME": 30.0, "nested": {"not": "for a header"}})  # fmt: skip
    (exposure,) = ld.read_exposures(image)
    assert exposure.name == "a1"
    assert_array_equal(exposure.data, data)
    assert_allclose(exposure.uncertainty, 3.0)
    assert np.argwhere(exposure.mask).tolist() == [[4, 5]]
    assert (exposure.gain, exposure.exposure_time) == (1.0, 30.0)
    (opened,) = ld.open_exposures([image])
    assert opened.wcs is not None


def test_bad_nddata(data):
    odd = NDData(data, uncertainty=UnknownUncertainty(np.ones(SHAPE)), meta={"FILENAME": "odd.fits"})
    with pytest.raises(InputError, match="odd: the uncertainty, UnknownUncertainty, is none that standard deviations"):
        ld.read_exposures(odd)
    with pytest.raises(InputError, match=r"exposure_0: the data have shape \(4,\), an exposure is one 2-D image"):
        ld.read_exposures(NDData(np.ones(4)))
    with pytest.raises(InputError, match="an exposure must be a path, an HDUList or an NDData, got ndarray"):
        ld.read_exposures([data])


# --- any WCS of the shared interface ------------------------------------------------------------------------------


def kinds():
    header = linear_wcs()
    return {
        "FITS": header,
        "FITS, as a low-level WCS": SlicedLowLevelWCS(header, 0 * [slice(None)] or [slice(None), slice(None)]),
        "gwcs": bent_wcs(),
    }


@pytest.mark.parametrize("kind", kinds())
def test_any_shared_wcs_leads_to_the_sky(kind):
    """Against astropy's own way from pixels to the sky."""
    wcs = kinds()[kind]
    found = believable_wcs(wcs, SHAPE, "a")
    xy = np.array([[0.0, 0.0], [40.0, 10.0], [79.0, 95.0]])
    high = wcs if hasattr(wcs, "pixel_to_world") else linear_wcs()
    expected = high.pixel_to_world(*xy.T).icrs
    assert_allclose(to_icrs(found, xy), [expected.ra.deg, expected.dec.deg], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_gwcs_gives_pose_sky_and_distortion():
    """Poses are those that went in; what the header has of distortion is measured."""
    exposures = [
        ld.read_exposures(NDData(np.eye(*SHAPE) + 1, wcs=bent_wcs(s), meta={"FILENAME": n}))[0]
        for n, s in (("a.fits", 0.0), ("b.fits", 11.0))
    ]
    poses = HeaderPoses.from_wcs({e.name: e.wcs for e in exposures}, {e.name: e.shape for e in exposures})
    # the inverse of a distortion without a similarity has one to second order, here a scale of 5e-4
    assert_allclose(poses.step("a", "b"), [[1, 0, 11], [0, 1, 0]], atol=6e-3)
    distortions = header_distortions(exposures)
    assert {name: each.source.kind for name, each in distortions.items()} == {"a": "gwcs", "b": "gwcs"}
    prior = ld.Prior.from_headers(exposures, degree=3)
    expected = np.zeros((2, 10))
    expected[0, 3], expected[1, 4] = 0.8, -0.5
    assert_allclose(prior.mean, expected, atol=2e-3)


@pytest.mark.parametrize("wrong", ["not a WCS", 3.0])
def test_what_is_no_wcs(wrong):
    with pytest.raises(
        InputError, match=r"a: the WCS must be an astropy\.wcs\.WCS, a gwcs or another one of the shared"
    ):
        believable_wcs(wrong, SHAPE, "a")


def test_unbelievable_shared_wcs(caplog):
    caplog.set_level("INFO")
    assert believable_wcs(bent_wcs(), (4000, 3000), "far") is None  # beyond its detector it gives no place
    assert "far: WCS of the header not used: it gives no place on the sky for a part of the detector" in caplog.text
    assert believable_wcs(None, SHAPE) is None


# --- flags -------------------------------------------------------------------------------------------------------


def test_good_bits():
    assert [good_bits(b) for b in (None, 0, 96, "96", "64,32", "64+32", [64, 32])] == [None, 0, 96, 96, 96, 96, 96]
    for wrong in ("a", -1, 1.5, "~64", [3]):
        with pytest.raises(
            InputError, match=r"dq_good \(--dq-good\) must be a sum of flags, 96, or the flags themselves"
        ):
            good_bits(wrong)


def test_which_flags_make_a_pixel_bad():
    flags = np.array([0, 1, 64, 65, 96, 4096], dtype=np.uint16)
    assert bad_pixels(flags).tolist() == [False, True, True, True, True, True]
    assert bad_pixels(flags, do_not_use=True).tolist() == [False, True, False, True, False, False]
    assert bad_pixels(flags, 96).tolist() == [False, True, False, True, False, True]
    assert bad_pixels(flags, 96, do_not_use=True).tolist() == bad_pixels(flags, 96).tolist()
    assert bad_pixels(np.array([0.0, 2.0]), 2).tolist() == [False, True]  # no flags, but a mask


def test_hubble_users_keep_some_flags(data, tmp_path, capsys):
    """As drizzlepac's final_bits: 64 (warm pixel, kept after CTE correction) and 32."""
    flags = np.zeros(SHAPE, np.int16)
    flags[1, 1], flags[2, 2], flags[3, 3], flags[4, 4] = 64, 32, 96, 4 + 64
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(data, name="SCI"), fits.ImageHDU(flags, name="DQ")]
    fits.HDUList(hdus).writeto(tmp_path / "h_flc.fits")
    assert ld.read_exposures(tmp_path / "h_flc.fits")[0].mask.sum() == 4
    (kept,) = ld.read_exposures(tmp_path / "h_flc.fits", dq_good="64,32")
    assert np.argwhere(kept.mask).tolist() == [[4, 4]]
    (later,) = ld.open_exposures(tmp_path / "h_flc.fits", dq_good=96)
    assert_array_equal(later.read().mask, kept.mask)
    out = ["--out", str(tmp_path / "t.ecsv")]
    assert parser.main(["measure", str(tmp_path / "h_flc.fits"), "--dq-good", "3x", *out]) == 1
    assert "dq_good (--dq-good) must be a sum of flags" in capsys.readouterr().err


# --- JWST --------------------------------------------------------------------------------------------------------


@pytest.fixture
def jwst(data, tmp_path):
    """A file as stdatamodels writes it."""
    datamodels = pytest.importorskip("stdatamodels.jwst.datamodels")
    model = datamodels.ImageModel(SHAPE)
    model.data, model.err, model.dq = data, np.full(SHAPE, 3, np.float32), np.zeros(SHAPE, np.uint32)
    model.dq[1, 2], model.dq[3, 4] = 1, 2  # DO_NOT_USE, SATURATED
    model.meta.telescope, model.meta.wcs = "JWST", bent_wcs().stock()
    model.meta.exposure.effective_exposure_time = 21.5
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it says of its own keywords
        model.save(str(tmp_path / "jw_cal.fits"))
    return tmp_path / "jw_cal.fits"


def test_jwst_cal(jwst, data):
    (exposure,) = ld.read_exposures(jwst)
    assert_array_equal(exposure.data, data)
    assert np.argwhere(exposure.mask).tolist() == [[1, 2]]
    assert exposure.stated.mask.value == "of the flag DO_NOT_USE"
    assert_allclose(exposure.uncertainty, 3)
    assert exposure.exposure_time == 21.5
    xy = np.array([[3.0, 4.0], [70.0, 90.0]])
    expected = bent_wcs().pixel_to_world(*xy.T)
    assert_allclose(to_icrs(exposure.wcs, xy), [expected.ra.deg, expected.dec.deg], rtol=0, atol=1e-12)
    (opened,) = ld.open_exposures(jwst)
    assert_array_equal(pickle.loads(pickle.dumps(opened)).read().data, data)  # so workers get it


@pytest.mark.slow
def test_jwst_cal_as_a_prior(jwst):
    """Its ASDF extension refers to the arrays of the other HDUs, which are not opened."""
    prior = ld.Prior.from_file(jwst, degree=3)
    assert prior.shape == SHAPE
    assert_allclose(prior.mean[0, 3], 0.8, atol=2e-3)


def test_jwst_rate_has_no_gwcs(data, tmp_path):
    """Before assign_wcs there is only the WCS in the header, and no entry meta.wcs."""
    header = linear_wcs().to_header()
    content = np.frombuffer(
        b"#ASDF 1.0.0\n#ASDF_STANDARD 1.5.0\n%YAML 1.1\n--- {meta: {telescope: JWST}}\n...\n", np.uint8
    )
    table = fits.BinTableHDU.from_columns(
        [fits.Column("ASDF_METADATA", f"{len(content)}B", array=content[None])], name="ASDF"
    )
    path = tmp_path / "jw_rate.fits"
    fits.HDUList([fits.PrimaryHDU(header=fits.Header([("TELESCOP", "JWST")])),
                  fits.ImageHDU(data, header, name="SCI"), table]).writeto(path)  # fmt: skip
    assert isinstance(ld.read_exposures(path)[0].wcs, WCS)
    with fits.open(path) as hdus:  # and one that cannot be read is told
        hdus["ASDF"].data["ASDF_METADATA"][0, :5] = 0
        hdus.writeto(tmp_path / "bad_rate.fits")
    assert isinstance(ld.read_exposures(tmp_path / "bad_rate.fits")[0].wcs, WCS)


def test_a_file_without_the_gwcs_of_the_others_is_named(data, tmp_path, caplog, recwarn):
    """Its header serves, and is said to; what its header says twice is said of no file whose gwcs is used."""
    cards = linear_wcs().to_header()
    twice = {f"CD{i}_{j}": 2 * cards[f"CDELT{i}"] * (i == j) for i in (1, 2) for j in (1, 2)} | {"PC1_1": 1.0}
    tree = io.BytesIO()
    asdf.AsdfFile({"meta": {"wcs": bent_wcs()}}).write_to(tree)
    content = np.frombuffer(tree.getvalue(), np.uint8)
    column = fits.Column("ASDF_METADATA", f"{len(content)}B", array=content[None])
    for k in range(3):
        header = fits.Header(cards)
        header.update(twice if k < 2 else {})
        hdus = [
            fits.PrimaryHDU(header=fits.Header([("TELESCOP", "JWST")])),
            fits.ImageHDU(data + k, header, name="SCI"),
        ]
        hdus += [fits.BinTableHDU.from_columns([column], name="ASDF")] * (k < 2)
        fits.HDUList(hdus).writeto(tmp_path / f"jw{k}_cal.fits")
    found = ld.open_exposures([tmp_path / f"jw{k}_cal.fits" for k in range(3)])
    assert [isinstance(each.wcs, WCS) for each in found] == [False, False, True]
    words = "jw2_cal: no gwcs, unlike the other 2: the WCS of the header is taken in its place"
    assert caplog.messages.count(words) == 1
    assert not [each for each in recwarn if "two matrices" in str(each.message)]
    caplog.clear()
    ld.open_exposures(tmp_path / "jw2_cal.fits")
    assert "no gwcs" not in caplog.text


# --- Roman -------------------------------------------------------------------------------------------------------


def write_roman(path, data, **changes):
    """The public tree of a Roman image, with tags of a version that roman_datamodels does not check."""
    flags = np.zeros(SHAPE, np.uint32)
    flags[7, 8], flags[9, 10] = 1, 4
    exposure = asdf.tagged.TaggedDict(
        {"exposure_time": 139.8, "start_time": Time("2027-03-01T00:00:00")},
        "asdf://stsci.edu/datamodels/roman/tags/exposure-0.0.0",
    )
    meta = {"wcs": bent_wcs(), "exposure": exposure, "instrument": {"name": "WFI", "detector": "WFI07"}}
    image = {"data": data, "err": np.full(SHAPE, 2, np.float16), "dq": flags, "meta": meta} | changes
    roman = asdf.tagged.TaggedDict(image, "asdf://stsci.edu/datamodels/roman/tags/wfi_image-0.0.0")
    asdf.AsdfFile({"roman": roman}).write_to(path)
    return path


@pytest.mark.slow
def test_roman(data, tmp_path):
    path = write_roman(tmp_path / "r001_wfi07_cal.asdf", data)
    (exposure,) = ld.read_exposures(path)
    assert exposure.name == "r001_wfi07_cal"
    assert_array_equal(exposure.data, data)
    assert np.argwhere(exposure.mask).tolist() == [[7, 8]]
    assert_allclose(exposure.uncertainty, 2)
    assert exposure.exposure_time == 139.8
    assert exposure.header["DATE-OBS"] == "2027-03-01T00:00:00.000"
    expected = bent_wcs().pixel_to_world(3.0, 4.0)
    assert_allclose(to_icrs(exposure.wcs, [[3.0, 4.0]])[:, 0], [expected.ra.deg, expected.dec.deg], rtol=0, atol=1e-12)
    (opened,) = ld.open_exposures(path, dq_good=1)
    assert np.argwhere(opened.read().mask).tolist() == [[9, 10]]
    with pytest.raises(InputError, match="an ASDF file has no extensions; leave ext"):
        ld.read_exposures(path, ext=1)


def test_what_is_no_roman_image(data, tmp_path):
    asdf.AsdfFile({"other": 1}).write_to(tmp_path / "o.asdf")
    with pytest.raises(DamagedError, match=r"o\.asdf: no image of Roman \(no entry roman\.data\)"):
        ld.read_exposures(tmp_path / "o.asdf")
    (tmp_path / "b.asdf").write_text("no")
    with pytest.raises(DamagedError, match=r"b\.asdf: cannot be read as ASDF, damaged or something else"):
        ld.read_exposures(tmp_path / "b.asdf")
    with pytest.raises(InputError, match=r"c\.asdf: no such file"):
        ld.read_exposures(tmp_path / "c.asdf")


# --- references --------------------------------------------------------------------------------------------------


def coordinates(**more):
    motion = {"pm_ra_cosdec": [3.0, -2.0] * u.mas / u.yr, "pm_dec": [1.0, 5.0] * u.mas / u.yr}
    return SkyCoord([10.0, 10.1] * u.deg, [-5.0, -5.1] * u.deg, **(motion | more))


def test_coordinates_alone_are_exact():
    with pytest.warns(
        AssumptionWarning, match="a SkyCoord has no errors: its positions are taken as exact; give a table"
    ):
        found = read_reference(coordinates(obstime=Time(2016.0, format="jyear")))
    assert_allclose(found.sky, [[10, -5], [10.1, -5.1]])
    assert_allclose(found.motion, [[3, 1], [-2, 5]])
    assert_allclose(found.epoch, 2016)
    assert_allclose(found.covariance, np.broadcast_to(np.eye(4) * EXACT**2, (2, 4, 4)))
    moved = found.at(2026.0)  # against astropy's own propagation
    expected = coordinates(obstime=Time(2016.0, format="jyear"), distance=[1, 1] * u.kpc).apply_space_motion(
        Time(2026.0, format="jyear")
    )
    assert_allclose(moved.sky, np.stack([expected.ra.deg, expected.dec.deg], axis=1), rtol=0, atol=1e-11)


def test_a_table_with_a_column_of_coordinates():
    table = QTable({"sky": coordinates(obstime=Time(2016.0, format="jyear")).galactic})
    for name in ("ra_error", "dec_error"):
        table[name] = [200, 300] * u.uas
    for name in ("pmra_error", "pmdec_error"):
        table[name] = [0.1, 0.1] * u.mas / u.yr
    found = read_reference(table)
    assert_allclose(found.sky, [[10, -5], [10.1, -5.1]])
    assert_allclose(found.motion, [[3, 1], [-2, 5]], atol=1e-9)
    assert_allclose(np.sqrt(found.covariance[:, 0, 0]), [0.2, 0.3])
    table["other"] = table["sky"]
    assert_allclose(read_reference(table).sky, found.sky)  # sky is the one that is meant
    table.rename_column("sky", "mine")
    with pytest.raises(
        InputError, match=r"the reference has several columns of coordinates, .*: name one sky, or leave"
    ):
        read_reference(table)


def test_bad_coordinates():
    table = QTable({"sky": coordinates(), "ra_error": [1, 1] * u.mas, "dec_error": [1, 1] * u.mas})
    with pytest.raises(InputError, match="has proper motions but its SkyCoord has no obstime"):
        read_reference(table)
    with pytest.raises(InputError, match=r"must be a list of places, got shape \(\)"):
        read_reference(SkyCoord(1 * u.deg, 2 * u.deg))
    with pytest.raises(InputError, match="reference must be a table, the path of one, or a SkyCoord, got list"):
        read_reference([1, 2])
    with pytest.raises(InputError, match="lacks ra_error and dec_error"):
        read_reference(QTable({"c": SkyCoord([1] * u.deg, [2] * u.deg)}))
