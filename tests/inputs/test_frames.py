"""What frames state: headers in many spellings, with a truth that is written beside them."""

import json

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

import legdistort as ld
from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, DamagedError, InputError
from legdistort.geometry.epochs import header_epoch
from legdistort.inputs.frames.pixel_flags import descriptive_flags
from legdistort.inputs.frames.statement import read_statement
from legdistort.inputs.frames.value_units import parse_unit, pixel_area
from legdistort.inputs.frames.wcs_cards import header_of_image

#: Spellings of units, and the electrons in one: by the electrons in a count, the time of all integrations, and the
#: number of those that a value is the mean of (1 for a sum).
UNITS = {
    **dict.fromkeys((None, "ADU", "adu", "DN", "COUNTS", "count", " ADU ", "[ADU]"), lambda e, t, n: e * n),
    **dict.fromkeys(("DN/s", "ADU/SEC", "counts s-1", "cps", "adu sec^-1", "DN / (s pix)"), lambda e, t, n: e * t),
    **dict.fromkeys(("ADU/min", "counts per minute"), lambda e, t, n: e * t / 60),
    "ADU/(30 s)": lambda e, t, n: e * t / 30,
    "1000 ADU": lambda e, t, n: 1000 * e * n,
    **dict.fromkeys(("e-", "E", "ELECTRONS", "electron", "photons"), lambda e, t, n: n),
    **dict.fromkeys(("e-/s", "ELECTRONS/S", "electron s**-1", "photon / s", "e-.s-1", "el/sec."), lambda e, t, n: t),
    **dict.fromkeys(("MJy/sr", "JY/PIXEL", "erg/s/cm2/A", "10**-20 erg/s/cm**2/Angstrom", "Jy/beam", "nmgy"), None),
}
#: Cards of times: seconds of all integrations, and the number of those that a value is the mean of.
TIMES = {
    "EXPTIME": ({"EXPTIME": 10.0}, 10, 1),
    "text": ({"EXPTIME": "10.0"}, 10, 1),
    "Fortran": ({"EXPTIME": "1.0D1"}, 10, 1),
    "milliseconds": ({"ITIME": (10000, "[ms] integration time")}, 10, 1),
    "one": ({"EXPTIME": 10.0, "COADDS": 1}, 10, 1),
    "sum": ({"ITIME": 10.0, "COADDS": 5}, 50, 1),
    "each": ({"EXPTIME": (10.0, "of each coadd"), "NCOADDS": 5}, 50, 1),
    "total": ({"EXPTIME": (50.0, "total exposure time"), "COADDS": 5}, 50, 1),
    "prepared": ({"EXPTIME": 60.0, "COADDEXP": 10.0, "COADDS": 6}, 60, 1),
    "mean": ({"HIERARCH ESO DET DIT": 2.0, "HIERARCH ESO DET NDIT": 6, "EXPTIME": 2.0}, 12, 6),
    "said": ({"ITIME": 10.0, "COADDS": (5, "number averaged")}, 50, 5),
}
#: Cards of the gain: electrons per count.
GAINS = {
    "GAIN": ({"GAIN": 2.5}, 2.5),
    "text": ({"GAIN": " 2.5"}, 2.5),
    "text with its unit": ({"GAIN": "2.5 e-/ADU"}, 2.5),
    "inverse": ({"GAIN": (0.4, "[ADU/e-] conversion")}, 2.5),
    "inverse in words": ({"GAIN": (0.4, "counts per electron")}, 2.5),
    "setting": ({"GAIN": 300, "EGAIN": 2.5}, 2.5),
    "setting said": ({"GAIN": (300, "gain setting of the camera"), "CCDGAIN": 2.5}, 2.5),
    "ESO": ({"HIERARCH ESO DET OUT1 CONAD": 2.5}, 2.5),
    "none": ({}, None),
}
#: Headers as observatories write them: seconds, electrons per value, saturation.
OBSERVATORIES = {
    "NACO": ({"HIERARCH ESO DET DIT": 2.0, "HIERARCH ESO DET NDIT": 15, "EXPTIME": 2.0}, 30, None, None),
    "VIRCAM": ({"EXPTIME": 10.0, "HIERARCH ESO DET NDIT": 6, "GAIN": 4.19, "MAGZPT": 23.1}, 60, 6 * 4.19, None),
    "WFC3 IR": ({"BUNIT": "ELECTRONS/S", "EXPTIME": 349.23, "CCDGAIN": 2.5}, 349.23, 349.23, None),
    "JWST": ({"BUNIT": "MJy/sr", "EFFEXPTM": 857.5, "XPOSURE": 857.5, "PHOTMJSR": 2.3}, 857.5, None, None),
    "Euclid": ({"BUNIT": "electron", "EXPTIME": 566.0, "GAIN": 3.48}, 566, 1, None),
    "DECam": ({"BUNIT": "electrons", "ARAWGAIN": 4.1, "EXPTIME": 90.0, "SATURATE": 160000.0}, 90, 1, 160000),
    "IRCS": ({"EXPTIME": 60.0, "EXP1TIME": 6.0, "COADDS": 10, "GAIN": (5.6, "(electron/ADU)")}, 60, 5.6, None),
    "Pan-STARRS": (
        {"EXPTIME": 40.0, "HIERARCH CELL.GAIN": 1.04, "HIERARCH CELL.SATURATION": 52000.0}, 40, 1.04, 52000,
    ),
    "LRIS": ({"ELAPTIME": 300, "GAIN": 1.2}, 300, 1.2, None),
    "GSAOI": ({"EXPTIME": 15.01, "COADDS": 3, "GAIN": 2.434, "LNRS": 8}, 45.03, 2.434, None),
    "LCO": ({"EXPTIME": 30.0, "GAIN": (1.0, "[electrons/count]"), "SATURATE": (128e3, "[ADU]")}, 30, 1, 128000),
}  # fmt: skip
SHAPE = (40, 50)


def header_of(*groups):
    header = fits.Header()
    for cards in groups:
        for key, value in cards.items():
            header[key] = value
    return header


@pytest.mark.parametrize("observatory", OBSERVATORIES)
def test_headers_of_observatories(observatory):
    cards, time, electrons, saturation = OBSERVATORIES[observatory]
    stated = read_statement(header_of(cards), np.zeros(SHAPE), integer=False)
    assert stated.exposure_time.value == pytest.approx(time)
    assert stated.gain.value == (electrons and pytest.approx(electrons))
    if electrons != 1 or saturation is None:  # in electrons nothing reaches it here
        assert stated.saturation.value == (saturation and pytest.approx(saturation))


@pytest.mark.parametrize("unit", UNITS, ids=str)
def test_electrons_and_time_of_a_value(unit):
    """Every spelling of it with all of the time and all of the gain: some 500 headers."""
    truth = UNITS[unit]
    pairs = {(time, gain) for k, time in enumerate(TIMES) for gain in [list(GAINS)[k % len(GAINS)], "GAIN"]}
    pairs |= {(time, gain) for k, gain in enumerate(GAINS) for time in [list(TIMES)[(5 * k) % len(TIMES)]]}
    for time, gain in sorted(pairs):
        (cards, time, averaged), (gains, electrons) = TIMES[time], GAINS[gain]
        header = header_of({} if unit is None else {"BUNIT": unit}, cards, gains)
        stated = read_statement(header, np.zeros(SHAPE), integer=False)
        assert stated.exposure_time.value == pytest.approx(time), header
        per_count = truth is not None and truth(2.0, time, averaged) != truth(1.0, time, averaged)
        if truth is None or (per_count and electrons is None):
            assert stated.gain.value is None, header
        else:
            assert stated.gain.value == pytest.approx(truth(electrons, time, averaged)), header
        assert stated.doubts == (), header
        light = parse_unit(unit or "").has_time
        assert stated.value_time.value == (pytest.approx(time / averaged) if light else None), header


def test_sources_are_named():
    primary = fits.PrimaryHDU(header=header_of({"BUNIT": "DN/s", "EXPTIME": 10.0, "RDNOISE": 4.0}))
    image = fits.ImageHDU(np.random.default_rng(0).normal(size=SHAPE), header_of({"GAIN": 2.0}), name="SCI")
    (exposure,) = ld.read_exposures(fits.HDUList([primary, image]))
    assert (exposure.gain, exposure.exposure_time, exposure.read_noise) == (20.0, 10.0, 4.0)
    assert exposure.stated.gain.source == "GAIN of the image x exposure time"
    assert exposure.stated.exposure_time.source == "EXPTIME of the primary header"
    text = str(exposure.stated)
    assert "electrons per unit  20 " in text
    assert "a rate" in text
    assert exposure.stated.to_dict()["stated"][0] == {
        "quantity": "unit of a value", "value": "DN/s", "source": "BUNIT of the primary header",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"BUNIT": "furlongs"}, "BUNIT = 'furlongs' is no unit that is known"),
        ({"BUNIT": "mag"}, "the values are magnitudes, not light"),
        ({"BUNIT": "DN/s", "GAIN": 2.0}, "is a rate, but no exposure time is stated"),
        ({"EXPTIME": 0.0}, "EXPTIME = 0 is no exposure time"),
        ({"EXPTIME": 10.0, "COADDS": 4}, "EXPTIME = 10 s is taken for the time of one of COADDS = 4 integrations"),
        ({"EXPTIME": 23.0, "ITIME": 10.0, "COADDS": 4}, "neither of one integration, 10 s, nor of all COADDS = 4"),
        ({"DATE-OBS": "yesterday"}, "DATE-OBS = 'yesterday' is no date"),
    ],
)
def test_what_contradicts_is_said(cards, words):
    data = np.random.default_rng(0).normal(size=SHAPE)
    with pytest.warns(AssumptionWarning, match=words.replace("(", r"\(")):
        ld.read_exposures(fits.HDUList([fits.PrimaryHDU(data, header_of(cards))]))


def test_amplifiers_of_one_image_have_one_gain():
    """Those of DECam, and of a camera of HST: the mean, unless one keyword is of all."""
    data = np.zeros(SHAPE)
    decam = {"GAINA": 4.1, "GAINB": 4.0, "RDNOISEA": 6.0, "RDNOISEB": 8.0, "SATURATA": 150000.0, "SATURATB": 140000.0}
    found = read_statement(header_of(decam), data, integer=False)
    assert found.gain == (pytest.approx(4.05), "mean of GAINA and GAINB")
    assert found.read_noise == (pytest.approx(np.sqrt(50)), "rms of RDNOISEA and RDNOISEB")
    assert found.saturation == (140000.0, "lowest of SATURATA and SATURATB")
    assert not found.doubts
    assert read_statement(header_of(decam, {"GAIN": 1.5}), data, integer=False).gain == (1.5, "GAIN")
    assert read_statement(header_of({"GAINB": 4.0}), data, integer=False).gain == (4.0, "GAINB")
    rate = header_of(decam, {"BUNIT": "DN/s", "EXPTIME": 10.0, "GAINB": 3.0})
    found = read_statement(rate, data, integer=False)
    assert found.gain == (pytest.approx(35.5), "mean of GAINA and GAINB x exposure time")
    assert found.doubts == ("GAINA = 4.1 and GAINB = 3 differ by 31%; their mean is taken for all pixels",)
    hst = {f"ATODGN{k}": value for k, value in zip("ABCD", (1.52, 1.56, 1.51, 1.57), strict=True)}
    assert read_statement(header_of(hst), data, integer=False).gain.value == pytest.approx(1.54)


def test_labels_are_no_numbers():
    """As JWST has it."""
    label = {"EXPOSURE": ("1", "Exposure request number")}
    for cards, time in (
        (label, None),
        (label | {"XPOSURE": 42.9}, 42.9),
        ({"EXPOSURE": "1"} | {"XPOSURE": 42.9}, 42.9),
    ):
        assert read_statement(header_of(cards), np.zeros(SHAPE), integer=False).exposure_time.value == time


def test_saturation_is_in_units_of_the_data():
    data = np.linspace(0, 200, np.prod(SHAPE)).reshape(SHAPE)

    def level(**cards):
        return read_statement(header_of(cards), data, integer=False).saturation.value

    assert level(SATURATE=6e4) == 6e4
    assert level(SATURATE=(6e4, "[electrons]"), GAIN=2.0) == 3e4
    assert level(SATURATE=100.0, BUNIT="DN/s", EXPTIME=9.0) == 100.0
    assert level(SATURATE=6e4, BUNIT="DN/s", EXPTIME=9.0) is None  # of the detector; no value is near it


@pytest.mark.parametrize(
    ("value", "year"),
    [
        ({"DATE-OBS": "09/12/95"}, 1995.93566),
        ({"DATE-OBS": "2014/12/09"}, 2014.93634),
        ({"DATE-OBS": "2014-12-09T12:00:00Z"}, 2014.93771),
        ({"DATE-OBS": "2014-12-09T05:00:00-0700"}, 2014.93771),
        ({"DATE-OBS": "2457001.0"}, 2014.93771),
        ({"MJD-OBS": "57000.5"}, 2014.93771),
        ({"JD": 2457001.0}, 2014.93771),
        ({"DATE-OBS": "N/A"}, None),
        ({"DATE-OBS": "09/13/95"}, None),
    ],
)
def test_dates(value, year):
    assert header_epoch(header_of(value)) == (None if year is None else pytest.approx(year, abs=1e-5))


def test_descriptive_flags_hide_nothing():
    mask = np.zeros(SHAPE, np.int32)
    mask[5:20, 5:20], mask[1, 1], mask[2, 2] = 32, 2, 34
    planes = [fits.PrimaryHDU(), fits.ImageHDU(np.random.default_rng(0).normal(size=SHAPE), name="IMAGE")]
    hdus = fits.HDUList(
        [*planes, fits.ImageHDU(mask, header_of({"MP_SAT": 1, "HIERARCH MP_DETECTED": 5}), name="MASK")]
    )
    (exposure,) = ld.read_exposures(hdus)
    assert np.argwhere(exposure.mask).tolist() == [[1, 1], [2, 2]]
    assert "DETECTED (32)" in exposure.stated.mask.value
    (exposure,) = ld.read_exposures(hdus, dq_good=2)
    assert not exposure.mask.any()
    assert descriptive_flags(header_of({"MSKNAM00": "GHOST", "MSKVAL00": 2, "MSKNAM01": "STAR", "MSKVAL01": 8})) == {
        "STAR": 8
    }
    named = header_of({"BIT01": (1, "OBJECT (detected by SExtractor)"), "BIT09": (9, "DEAD/BAD"), "BIT5": "DETECTED"})
    named["BITPIX"] = 16
    assert descriptive_flags(named) == {"OBJECT": 2, "DETECTED": 32}


@pytest.mark.parametrize("name", ["DQ", "ERR"])
@pytest.mark.parametrize("shape", [(20, 50), (40, 49), (3, 40, 50)])
def test_planes_of_another_shape_are_refused(tmp_path, name, shape):
    data = np.random.default_rng(0).normal(size=SHAPE)
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(data, name="SCI"), fits.ImageHDU(np.ones(shape, np.int16), name=name)]
    fits.HDUList(hdus).writeto(tmp_path / "f.fits")
    with pytest.raises(
        InputError, match=rf"f.fits: the plane {name} has the shape .*, the image \(40, 50\) \(ny, nx\)"
    ):
        ld.read_exposures([tmp_path / "f.fits"])


def test_a_plane_of_another_image_is_not_refused(tmp_path):
    data, other = np.random.default_rng(0).normal(size=SHAPE), np.ones((20, 50), np.int16)
    hdus = [fits.ImageHDU(data, name="SCI"), fits.ImageHDU(other, name="DQ"), fits.ImageHDU(other, name="GUIDE")]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(tmp_path / "f.fits")
    (exposure,) = ld.read_exposures([tmp_path / "f.fits"], ext="SCI")
    assert not exposure.mask.any()


def wcs_header(**more):
    known = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 83.8, "CRVAL2": -5.4, "CRPIX1": 20.0, "CRPIX2": 25.0}
    matrix = {"CD1_1": -5e-6, "CD1_2": 1e-7, "CD2_1": 1e-7, "CD2_2": 5e-6}
    return header_of(known, matrix, more)


def image_with(primary, own, data=None):
    data = np.random.default_rng(0).normal(size=SHAPE) if data is None else data
    return fits.HDUList([fits.PrimaryHDU(header=primary), fits.ImageHDU(data, own, name="SCI")])


def separation(wcs, right):
    """Largest distance [pix of 18 mas] of two WCSs on the detector."""
    x, y = np.meshgrid([0.0, 25, 49], [0.0, 20, 39])
    return right.pixel_to_world(x, y).separation(wcs.pixel_to_world(x, y)).deg.max() / 5e-6


#: What a primary header may have of the telescope's WCS, or of one that was there before.
LEFT_OVER = {
    "CD": {"CD1_1": 1e-3, "CD2_2": 1e-3},
    "PC": {"PC1_1": 0.0, "PC1_2": 1.0, "PC2_1": -1.0, "PC2_2": 0.0, "CDELT1": 5e-6, "CDELT2": 5e-6},
    "CROTA2": {"CROTA2": 30.0, "CDELT1": 5e-6, "CDELT2": 5e-6},
    "LONPOLE": {"LONPOLE": 90.0},
    "PV": {"PV1_1": 0.5, "PV2_1": 2.0, "PV1_3": 80.0},
    "SIP": {"A_ORDER": 2, "A_2_0": 1e-2, "B_ORDER": 2, "B_0_2": 1e-2},
    "EQUINOX": {"EQUINOX": 1950.0, "RADESYS": "FK4"},
    "plate": {"PLTRAH": 5, "AMDX1": 67.2, "PPO3": 1.0, "XPIXELSZ": 15.0},
    "tables": {"CPDIS1": "LOOKUP", "DP1": "EXTVER: 1.0"},
}


@pytest.mark.parametrize("left", LEFT_OVER)
@pytest.mark.parametrize("inherit", [None, True, False])
def test_an_image_has_its_own_wcs(left, inherit):
    """Nothing of the primary header gets into it."""
    own = wcs_header(RADESYS="ICRS")
    right = WCS(own)
    if inherit is not None:
        own["INHERIT"] = inherit
    primary = header_of({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 1.0, "CRVAL2": 2.0}, LEFT_OVER[left])
    (exposure,) = ld.read_exposures(image_with(primary, own))
    assert separation(exposure.wcs, right) < 1e-6
    assert exposure.stated.wcs.source == "CTYPE1"
    assert not set(LEFT_OVER[left]) - set(own) & set(exposure.header)


def test_the_primary_wcs_is_inherited_if_that_is_said():
    primary = wcs_header(RADESYS="ICRS")
    (exposure,) = ld.read_exposures(image_with(primary, header_of({"INHERIT": True})))
    assert separation(exposure.wcs, WCS(primary)) < 1e-6
    assert "INHERIT" in exposure.stated.wcs.source
    moved = header_of({"INHERIT": True, "CRPIX1": 30.0, "CDELT1": -5e-6, "CDELT2": 5e-6})
    right = header_of(primary, moved)
    for key in ("CD1_1", "CD1_2", "CD2_1", "CD2_2"):
        del right[key]
    assert separation(WCS(header_of_image(primary, moved)), WCS(right)) < 1e-6
    (exposure,) = ld.read_exposures(image_with(primary, header_of({"INHERIT": "T"})))  # as text
    assert separation(exposure.wcs, WCS(primary)) < 1e-6
    with pytest.warns(AssumptionWarning, match="the primary header has a WCS, the image none, and not INHERIT = T"):
        (exposure,) = ld.read_exposures(image_with(primary, fits.Header()))
    assert exposure.wcs is None


def test_two_matrices_that_differ_are_said():
    both = {"PC1_1": 1.0, "PC2_2": 1.0, "PC1_2": -0.02, "PC2_1": 0.02, "CDELT1": -5e-6, "CDELT2": 5e-6}
    (exposure,) = ld.read_exposures(image_with(fits.Header(), wcs_header(**both)))  # one matrix, twice
    assert separation(exposure.wcs, WCS(wcs_header())) < 1e-6
    with pytest.warns(AssumptionWarning, match="two matrices of its WCS that differ, CDi_j and PCi_j with CDELTi"):
        ld.read_exposures(image_with(fits.Header(), wcs_header(**both | {"CDELT1": -1e-5, "CDELT2": 1e-5})))


@pytest.mark.parametrize("key", ["CRVAL1", "CRPIX2", "CD1_1", "EQUINOX"])
def test_numbers_of_a_wcs_as_text(key):
    header = wcs_header(RADESYS="FK5", EQUINOX=2000.0)
    right = WCS(header)
    header[key] = "J2000.0" if key == "EQUINOX" else f" {header[key]!r} "
    (exposure,) = ld.read_exposures(image_with(fits.Header(), header))
    assert separation(exposure.wcs, right) < 1e-6


def test_what_is_no_number_is_named():
    with pytest.raises(DamagedError, match=r"CRVAL1 = '05:35:12' is no number"):
        ld.read_exposures(image_with(fits.Header(), wcs_header(CRVAL1="05:35:12")))
    header = wcs_header()
    del header["CRVAL2"]
    with pytest.warns(AssumptionWarning, match="has no card CRVAL2 and is not used"):
        (exposure,) = ld.read_exposures(image_with(fits.Header(), header))
    assert exposure.wcs is None


def test_one_plane_is_an_image():
    header = wcs_header(A_ORDER=2, A_2_0=1e-3, B_ORDER=2, B_0_2=1e-3, CTYPE3="FREQ", CRVAL3=1e9, CDELT3=1e6)
    header["CTYPE1"], header["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
    data = np.random.default_rng(0).normal(size=SHAPE)
    planes = image_with(fits.Header(), header, data[None])
    planes.append(fits.ImageHDU(np.eye(*SHAPE, dtype=np.int16)[None], name="DQ"))
    (exposure,) = ld.read_exposures(planes)
    np.testing.assert_array_equal(exposure.data, data)
    np.testing.assert_array_equal(exposure.mask, np.eye(*SHAPE, dtype=bool))
    for key in ("CTYPE3", "CRVAL3", "CDELT3"):
        del header[key]
    assert separation(exposure.wcs, WCS(header)) < 1e-6


def test_light_of_an_area():
    wcs = WCS(wcs_header())
    corners = wcs.pixel_to_world([24, 25, 24], [19, 19, 20])
    sides = [SkyCoord(corners[0]).separation(corners[k]).rad for k in (1, 2)]
    assert pixel_area(wcs, SHAPE) == pytest.approx(sides[0] * sides[1], rel=1e-3)
    stated = read_statement(
        header_of({"BUNIT": "counts/arcsec2", "GAIN": 2.0}), np.zeros(SHAPE), integer=False, wcs=wcs
    )
    assert stated.gain.value == pytest.approx(2.0 * (5e-6 * 3600) ** 2, rel=1e-3)
    for unit, of_area in {"MJy/sr": True, "Jy/beam": True, "mJy/pixel": False, "nJy": False, "DN/s": False}.items():
        assert parse_unit(unit).per_area is of_area, unit
    assert parse_unit("MJy sr-1").same_as(parse_unit("MJy/sr"))
    assert not parse_unit("MJy/sr").same_as(parse_unit("mJy/sr"))


def test_the_command_prints_it(tmp_path, capsys):
    path = tmp_path / "frame.fits"
    data = np.random.default_rng(0).normal(size=SHAPE)
    fits.PrimaryHDU(data, wcs_header(BUNIT="DN/s", GAIN=2.5, EXPTIME=10.0)).writeto(path)
    assert main(["show", str(path)]) == 0
    assert ["electrons", "per", "unit", "25", "GAIN", "x", "exposure", "time"] in [
        line.split() for line in capsys.readouterr().out.splitlines()
    ]
    assert main(["show", str(path), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["frame"]["stated"]
    assert {"quantity": "WCS", "value": "RA---TAN, DEC--TAN", "source": "CTYPE1"} in rows
    assert main(["show", str(path), "--strict"]) == 1
    assert "--strict is for a solution: leave it out" in capsys.readouterr().err
