"""A solution goes into frames: the same sky from each form, and not a byte more than that has changed."""

import bz2
import dataclasses
import datetime
import gzip
import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import time
import warnings
from pathlib import Path

import asdf
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from caller_warnings import warns_here
from numpy.testing import assert_allclose, assert_array_equal
from sky_chains import detector

import legdistort
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, DiskFullError, ExportError, InputError
from legdistort.geometry import similarity
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs import detector_files
from legdistort.results.solution import Solution
from legdistort.runtime.fits_bytes import locate
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs import attachment
from legdistort.wcs.attachment import attach

SHAPE = (60, 90)
OLD = {
    "WCSAXES": 2, "CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV", "CRVAL1": 1.0, "CRVAL2": 2.0, "CRPIX1": 3.0,
    "CRPIX2": 4.0, "CDELT1": 1.0, "PC1_1": 1.0, "PC001002": 0.0, "CROTA2": 5.0, "PV1_7": 0.1, "PV2_39": 0.3,
    "A_ORDER": 2, "A_0_2": 1e-5, "BP_1_0": 1e-5, "A_DMAX": 1.0, "CPDIS1": "LOOKUP", "EQUINOX": 1950.0,
    "RADECSYS": "FK4", "LATPOLE": 3.0, "WAT1_001": "wtype=tnx", "D2IMDIS1": "LOOKUP", "SIPMXERR": 3.0,
    "WCSNAME": "too long for a card " * 6,
}  # fmt: skip
KEPT = {"OBJECT": "M 31", "EXPTIME": 30.0, "CTYPE1A": "LINEAR", "CRPIX1A": 7.0, "CD1_1A": 2.0, "A_NAME": "x",
        "CRVALUE": 1, "PVX": 2, "LTV1": 4.0}  # fmt: skip


def header_of(cards, text=""):
    header = fits.Header()
    for key, value in cards.items():
        header[key] = value
    header["LONGTEXT"] = "a value that goes on and on " * 6
    header["HISTORY"] = "reduced " + text
    header["COMMENT"] = "kept"
    return header


def pixels(seed=0):
    return np.random.default_rng(seed).integers(0, 60000, SHAPE)


def write_frame(path, *, checksum=True):
    """Unsigned integers in the primary HDU (BZERO), a compressed image, a table."""
    header = header_of(KEPT | OLD)
    primary = fits.PrimaryHDU(pixels().astype("uint16"), header)
    table = fits.BinTableHDU.from_columns([fits.Column("a", "PE()", array=np.array([[1.0], [1.0, 2.0]], dtype=object))])
    packed = fits.CompImageHDU(pixels(1).astype("int16"), name="PACKED", compression_type="RICE_1")
    hdus = fits.HDUList([primary, packed, table, fits.ImageHDU(np.full((3, 3), np.nan), name="ERR")])
    hdus.writeto(path, checksum=checksum)
    return path


@pytest.fixture
def one(geometry):
    return geometry(1, 2.0, shape=SHAPE, names=("frame", "other"))


@pytest.fixture
def frame(tmp_path):
    return write_frame(tmp_path / "frame.fits")


def cards(raw, span):
    text = raw[span.start : span.data].decode("ascii")
    return [text[i : i + 80] for i in range(0, len(text), 80)]


def holds(header, part):
    return {str(card) for card in part.cards} <= {str(card) for card in header.cards}


def names_in(path):
    with fits.open(path) as hdus:
        return [hdu.name for hdu in hdus]


def check_sums(path):
    """All checksums hold; astropy warns of those that do not."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with fits.open(path, checksum=True) as hdus:
            return [hdu.data is None for hdu in hdus]


def wcs_in(path, number=1):
    """As a program without legdistort reads it."""
    with fits.open(path) as hdus:
        return asdf.open(io.BytesIO(hdus["ASDF", number].data["ASDF_METADATA"].tobytes()), lazy_load=False)["meta"][
            "wcs"
        ]


# --- the same sky ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("degree", "peak", "place"),
    [
        pytest.param(3, 5, {}, marks=pytest.mark.sets),
        pytest.param(3, 20, {"lat": 89.9, "lon": 123.0}, marks=pytest.mark.slow),
        pytest.param(3, 100, {"lon": 0.0}, marks=pytest.mark.sets),
        pytest.param(5, 5, {"lat": -89.9, "parity": 1}, marks=pytest.mark.slow),
        pytest.param(5, 20, {"lon": 0.0, "turn": 170.0}, marks=pytest.mark.sets),
        pytest.param(5, 100, {"lat": -60.0, "parity": 1}, marks=pytest.mark.slow),
    ],
)
def test_every_form_gives_the_same_sky(geometry, tmp_path, degree, peak, place):
    shape = (1024, 1100)
    solution = geometry(degree, peak, shape=shape, names=("frame",), **place)
    path = tmp_path / "frame.fits"
    fits.writeto(path, np.zeros(shape, "uint8"))
    (done,) = attach(solution, path, in_place=True, max_error=1.0 if peak == 100 else 1e-3)
    p, ra, dec = detector(solution, "frame")
    for found in (wcs_in(path)(*p.T), solution["frame"].wcs(*p.T), read_by_stdatamodels(path, p)):
        turned = np.mod(found[0] - ra + 180, 360) - 180
        assert np.abs(turned * np.cos(np.radians(dec))).max() < 1e-9
        assert np.abs(found[1] - dec).max() < 1e-9
    sky = np.array(WCS(fits.getheader(path)).all_pix2world(p, 0)).T
    turned = (np.mod(sky[0] - ra + 180, 360) - 180) * np.cos(np.radians(dec))
    scale = solution.sky.pixel_scale / 3600
    assert np.hypot(turned, sky[1] - dec).max() < 1.6 * done.errors["SIPMXERR"] * scale  # 1.6: distortion of the scale


def read_by_stdatamodels(path, p):
    try:
        from stdatamodels import asdf_in_fits
    except ImportError:
        return wcs_in(path)(*p.T)
    with asdf_in_fits.open(path) as file:
        assert file["meta"]["exposure"] == "frame"
        return file["meta"]["wcs"](*p.T)


def test_read_by_stdatamodels(one, frame):
    pytest.importorskip("stdatamodels", reason="stdatamodels is not installed")
    attach(one, frame, in_place=True)
    p = detector(one, "frame")[0]
    assert_allclose(read_by_stdatamodels(frame, p), one["frame"].wcs(*p.T), rtol=0, atol=1e-12)


def test_no_ghosts_over_a_wide_mosaic(geometry):
    """Three detectors wide: what lies beyond one of them is never put on it."""
    for seed_name in ("a", "b"):
        solution = geometry(5, 20, names=("a", "b"), shape=(500, 500))
        wcs = solution[seed_name].wcs
        t = np.linspace(-750, 1250, 161)
        q = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
        q = q[(np.abs(q - 249.5) > 270).any(axis=1)]  # not on the detector: 20 px is the largest displacement
        sky = solution.sky.to_sky(similarity.apply(similarity.invert(solution.poses[seed_name]), q))
        assert np.isnan(wcs.world_to_pixel(sky)).any(axis=0).all()
        assert np.isnan(wcs(*q.T)).any(axis=0).all()


# --- nothing else ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["sip", "tpv", None])
def test_every_other_byte_stays(one, frame, tmp_path, kind):
    before = frame.read_bytes()
    (done,) = attach(one, frame, out=tmp_path / "out", kind=kind)
    assert frame.read_bytes() == before
    assert done.path == tmp_path / "out" / "frame.fits"
    after = done.path.read_bytes()
    old, new = locate(before, frame), locate(after, done.path)
    assert len(new) == len(old) + 1
    assert new[-1].header["EXTNAME"] == "ASDF"
    assert new[-1].stop == len(after)
    for i, (a, b) in enumerate(zip(old, new, strict=False)):
        assert before[a.data : a.stop] == after[b.data : b.stop]
        if i or kind is None:
            assert before[a.start : a.data] == after[b.start : b.data]
    mine = {card[:8] for card in cards(after, new[0])} if kind is None else {str(c)[:8] for c in done.header.cards}
    gone = {key.ljust(8) for key in OLD} | {"CHECKSUM", "CONTINUE"} | mine
    rest = [
        [c for c in cards(raw, s[0]) if c[:8] not in gone and c.strip()] for raw, s in ((before, old), (after, new))
    ]
    assert rest[0] == rest[1]
    if kind is not None:
        told, kept = (c.rstrip() for c in cards(after, new[0]) if c.startswith("HISTORY"))
        assert re.fullmatch(r"HISTORY legdistort \S+ wrote the WCS of this image, \d{4}-\d\d-\d\d", told)
        assert kept == "HISTORY reduced"
        assert sum(c.startswith("CONTINUE") for c in cards(after, new[0])) == 2  # of LONGTEXT, not of WCSNAME
        assert new[0].header["LONGTEXT"] == old[0].header["LONGTEXT"]
        header = new[0].header
        assert not [key for key in OLD if key in header and key not in done.header]
        assert all(header[key] == value for key, value in KEPT.items())
        assert holds(header, done.header)
    check_sums(done.path)
    with fits.open(done.path) as hdus:
        assert_array_equal(hdus[0].data, pixels().astype("uint16"))
        assert_array_equal(hdus["PACKED"].data, pixels(1).astype("int16"))
        assert hdus[0].header["DATASUM"] == fits.getheader(frame)["DATASUM"]


def test_odd_cards_survive(one, tmp_path):
    """Cards that astropy would mend or refuse are copied as they are; no checksum is invented."""
    path = tmp_path / "frame.fits"
    write_frame(path, checksum=False)
    raw = path.read_bytes()
    odd = b"".join(
        c.ljust(80)
        for c in (
            b"exptime2=    3.0E+0 / lower case",
            b"BAD     = 'no end",
            b"CONTINUE  'alone'",
            b"OBSERVER= 'Ren\xe9'",
            b"COMMENT \xc3\xa0 Paris",
        )
    )
    place, end = raw.index(b"OBJECT  "), raw.index(b"END     ")
    header = raw[:place] + odd + raw[place : end + 80]
    path.write_bytes(header + b" " * (-len(header) % 2880) + raw[locate(raw, path)[0].data :])
    attach(one, path, in_place=True)
    assert odd in path.read_bytes()
    assert b"CHECKSUM" not in path.read_bytes().split(b"XTENSION")[0]


#: Cards of which some reader would make another WCS than that which is written.
MISLEADING = {
    "plate": {"PLTRAH": 5, "PLTRAM": 35, "PLTRAS": 12.0, "PLTDECSN": "-", "PLTDECD": 5, "PLTDECM": 24, "PLTDECS": 0.0,
              "AMDX1": 67.2, "AMDY1": 67.2, "PPO3": 1.0, "PPO6": 1.0, "CNPIX1": 1, "CNPIX2": 1},
    "pixels of a plate": {"XPIXELSZ": 15.0, "YPIXELSZ": 15.0},
    "PC": {"PC1_1": 0.5, "PC2_2": 0.5, "CDELT1": 1e-3, "CDELT2": 1e-3},
    "old matrix": {"CD001001": 1e-3, "CD002002": 1e-3},
    "PV": {"PV1_0": 0.1, "PV1_1": 2.0, "PV1_3": 90.0, "PV2_1": 3.0},
    "SIP": {"A_ORDER": 3, "A_3_0": 1e-4, "B_ORDER": 3, "B_0_3": 1e-4},
    "IRAF": {"WAT1_001": "wtype=tnx axtype=ra", "WAT2_001": "wtype=tnx axtype=dec"},
    "axis": {"CTYPE3": "FREQ", "CRVAL3": 1.0},
    "text": {"CRVAL1": "05:35:12", "CRPIX1": "9"},
    "tables": {"CPDIS1": "LOOKUP", "DP1": "EXTVER: 1.0"},
    "polynomials": {"TR1_0": 5.0, "CO1_1": 0.3, "PROJP1": 45.0, "EPOCH": 1950.0},
}  # fmt: skip


@pytest.mark.parametrize("kind", ["sip", "tpv"])
@pytest.mark.parametrize("left", MISLEADING)
def test_what_is_promised_is_what_others_find(one, tmp_path, left, kind):
    """By astropy, and by Starlink's AST, which shares no code with it."""
    fits.writeto(tmp_path / "frame.fits", np.zeros(SHAPE, "f4"), header_of(MISLEADING[left]))
    (done,) = attach(one, tmp_path / "frame.fits", out=tmp_path / "out", kind=kind)
    header, (p, ra, dec) = fits.getheader(done.path), detector(one, "frame")
    found = {"astropy": WCS(header).all_pix2world(p, 0).T}
    try:
        from starlink import Ast
    except ImportError:
        pass
    else:
        found["AST"] = np.degrees(Ast.FitsChan(header.tostring(sep="\n").split("\n")).read().tran(p.T + 1))
    for program, sky in found.items():
        turned = (np.mod(sky[0] - ra + 180, 360) - 180) * np.cos(np.radians(dec))
        off = np.hypot(turned, sky[1] - dec).max() / (one.sky.pixel_scale / 3600)
        assert off < 2 * max(done.errors.values()) + 1e-6, program


def test_what_would_be_read_otherwise_is_refused(one, tmp_path, monkeypatch):
    path = tmp_path / "frame.fits"
    fits.writeto(path, np.zeros((1, *SHAPE), "f4"))
    with pytest.raises(ExportError, match=r"NAXIS = 3, and headers with SIP or TPV are read with two axes"):
        attach(one, path, in_place=True)
    attach(one, path, in_place=True, kind=None)
    fits.writeto(path, np.zeros(SHAPE, "f4"), header_of({"BEGAST_A": "FrameSet"}), overwrite=True)
    with pytest.raises(ExportError, match=r"has a WCS of Starlink's AST as well"):
        attach(one, path, in_place=True)
    fits.writeto(path, np.zeros(SHAPE, "f4"), header_of({"AMDX1": 67.2, "OBJECT": "field"}), overwrite=True)
    monkeypatch.setattr(attachment, "WCS_KEYWORDS", re.compile("SOLSHA"))  # as for a card that nobody thought of
    with pytest.raises(ExportError, match=r"frame.fits: with AMDX1 in the header the WCS written is read as another"):
        attach(one, path, in_place=True)


@pytest.mark.parametrize("seed", range(4))
def test_checksum_of_any_content(one, tmp_path, seed):
    path = tmp_path / "frame.fits"
    data = np.random.default_rng(seed).normal(size=SHAPE)
    fits.PrimaryHDU(data, header_of({f"KEY{k}": k * seed for k in range(9)})).writeto(path, checksum=True)
    attach(one, path, in_place=True)
    check_sums(path)


def test_compressed_images_are_not_packed_again(geometry, tmp_path):
    solution = geometry(3, 2.0, shape=SHAPE, names=("frame_PACKED",))
    frame = write_frame(tmp_path / "frame.fits")
    before = frame.read_bytes()
    (done,) = attach(solution, str(tmp_path / "fr*.fits"), in_place=True, ext="PACKED")
    after = frame.read_bytes()
    old, new = locate(before, frame), locate(after, frame)
    assert before[: old[1].start] == after[: new[1].start]
    assert before[old[1].data : old[1].stop] == after[new[1].data : new[1].stop]
    check_sums(frame)
    with fits.open(frame) as hdus:
        assert_array_equal(hdus["PACKED"].data, pixels(1).astype("int16"))
        assert hdus["PACKED"].header["A_ORDER"] == done.header["A_ORDER"]
        assert hdus["ASDF"].header["EXPNAME"] == "frame_PACKED"


@pytest.mark.parametrize(("suffix", "module"), [(".gz", gzip), (".bz2", bz2)])
def test_packed_files_stay_packed(one, frame, tmp_path, suffix, module):
    packed = tmp_path / f"frame.fits{suffix}"
    packed.write_bytes(module.compress(frame.read_bytes()))
    attach(one, packed, out=tmp_path / "out")
    attach(one, frame, out=tmp_path / "plain")
    # only the time of the ASDF extension differs
    loose, plain = (tmp_path / "out" / packed.name).read_bytes(), (tmp_path / "plain" / "frame.fits").read_bytes()
    loose = module.decompress(loose)
    spans = locate(loose, packed)
    assert loose[: spans[-1].start] == plain[: locate(plain, frame)[-1].start]


def test_attaching_again_replaces(one, frame):
    for kind in ("sip", "tpv"):
        attach(one, frame, in_place=True, kind=kind)
    turned = dataclasses.replace(one, sky=TangentPlane(one.sky.lon + 1e-4, one.sky.lat, one.sky.matrix))
    attach(turned, frame, in_place=True)
    assert names_in(frame) == ["PRIMARY", "PACKED", "", "ERR", "ASDF"]
    header = fits.getheader(frame)
    assert header["CRVAL1"] == turned.sky.lon
    assert sum(key.startswith("PV") for key in header) == 1  # PVX
    assert len(header["HISTORY"]) == 2  # the frame's own, and ours once
    assert_allclose(wcs_in(frame)(3.0, 4.0), turned["frame"].wcs(3.0, 4.0), rtol=0, atol=1e-12)
    check_sums(frame)


def moved(path, layout):
    """The file with its image elsewhere, as fpack and funpack, and others that leave the primary HDU empty, make it."""
    with fits.open(path) as hdus:
        image = next(hdu for hdu in hdus if hdu.is_image and hdu.shape == SHAPE)
        rest = [hdu.copy() for hdu in hdus if not hdu.is_image]
        if layout == "packed":
            image = fits.CompImageHDU(image.data, image.header, name="COMPRESSED_IMAGE")
        elif layout == "extension":
            image = fits.ImageHDU(image.data, image.header)
        else:
            image = fits.PrimaryHDU(image.data, image.header)
        first = [] if layout == "primary" else [fits.PrimaryHDU()]
        fits.HDUList([*first, image, *rest]).writeto(path, overwrite=True)


@pytest.mark.parametrize(("start", "then"), [("primary", "packed"), ("packed", "primary"), ("extension", "packed")])
def test_its_own_extension_is_known_wherever_it_stands(one, tmp_path, start, then):
    frame = tmp_path / "frame.fits"
    table = fits.BinTableHDU.from_columns([fits.Column("a", "D", array=[1.0])], name="LOG")
    fits.HDUList([fits.PrimaryHDU(pixels().astype("int16")), table]).writeto(frame)
    moved(frame, start)
    attach(one, frame, in_place=True)
    moved(frame, then)
    turned = dataclasses.replace(one, sky=TangentPlane(one.sky.lon + 1e-4, one.sky.lat, one.sky.matrix))
    attach(turned, frame, in_place=True)
    assert [name for name in names_in(frame) if name in ("ASDF", "LOG")] == ["LOG", "ASDF"]
    assert_allclose(wcs_in(frame)(3.0, 4.0), turned["frame"].wcs(3.0, 4.0), rtol=0, atol=1e-12)
    (exposure,) = legdistort.read_exposures(frame)
    assert exposure.has_gwcs


@pytest.mark.skipif(shutil.which("fpack") is None, reason="fpack is not installed")
def test_fpack_and_back(one, tmp_path):
    frame = tmp_path / "frame.fits"
    fits.PrimaryHDU(pixels().astype("int16")).writeto(frame)
    attach(one, frame, in_place=True)
    subprocess.run(["fpack", "-D", "-Y", frame], check=True)
    turned = dataclasses.replace(one, sky=TangentPlane(one.sky.lon + 1e-4, one.sky.lat, one.sky.matrix))
    (done,) = attach(turned, f"{frame}.fz", in_place=True)
    assert names_in(done.path).count("ASDF") == 1
    assert_allclose(wcs_in(done.path)(3.0, 4.0), turned["frame"].wcs(3.0, 4.0), rtol=0, atol=1e-12)
    subprocess.run(["funpack", "-D", f"{frame}.fz"], check=True)
    attach(one, frame, in_place=True)
    assert names_in(frame) == ["PRIMARY", "ASDF"]
    assert_allclose(wcs_in(frame)(3.0, 4.0), one["frame"].wcs(3.0, 4.0), rtol=0, atol=1e-12)
    check_sums(frame)


def test_a_frame_under_another_name(one, frame, tmp_path):
    """What was attached under the old name would be stale beside what the new one gets."""
    attach(one, frame, in_place=True)
    os.rename(frame, tmp_path / "other.fits")
    attach(one, tmp_path / "other.fits", in_place=True)
    assert names_in(tmp_path / "other.fits").count("ASDF") == 1
    assert_allclose(wcs_in(tmp_path / "other.fits")(3.0, 4.0), one["other"].wcs(3.0, 4.0), rtol=0, atol=1e-12)


def test_another_product_of_a_pipeline_is_the_same_exposure(geometry, tmp_path, caplog):
    """By the names but for the last word, if only one exposure is so called; and it is said."""
    solution = geometry(1, 2.0, shape=SHAPE, names=("frame_00001_wcs", "frame_00002_wcs"))
    second = write_frame(tmp_path / "frame_00002_cal.fits")
    attach(solution, second, in_place=True)
    assert_allclose(wcs_in(second)(3.0, 4.0), solution["frame_00002_wcs"].wcs(3.0, 4.0), rtol=0, atol=1e-12)
    assert "whose names differ by the last word (1): frame_00002_cal.fits as frame_00002_wcs" in caplog.text
    both = geometry(1, 2.0, shape=SHAPE, names=("frame_00002_wcs", "frame_00002_cat"))
    (tmp_path / "again").mkdir()
    for known, name in ((both, "frame_00002_cal"), (solution, "frame_00003_cal"), (solution, "frame_00001_J")):
        with pytest.raises(InputError, match="in the solution"):
            attach(known, write_frame(tmp_path / "again" / f"{name}.fits"), out=tmp_path / "out", overwrite=True)


def test_so_is_that_of_a_detector_of_a_camera():
    labels = [f"x_{k}_wcs-{d}" for k in ("00001", "00002") for d in ("NRCA1", "NRCA2")]
    header = fits.Header({"DETECTOR": "NRCA2"})
    assert detector_files.label_of("x_00002_nrca2_cal", header, labels, exact=False) == "x_00002_wcs-NRCA2"
    assert detector_files.label_of("x_00003_nrca2_cal", header, labels, exact=False) is None
    assert detector_files.label_of("x_00002_nrca2_cal", header, ["x_00002_cal-NRCA2", *labels], exact=False) == (
        "x_00002_cal-NRCA2"
    )


def test_names_beyond_ascii(geometry, tmp_path):
    name = "nuit_é_星" + 70 * "x"
    solution, path = geometry(1, 2.0, shape=SHAPE, names=(name,)), tmp_path / f"{name}.fits"
    fits.writeto(path, pixels().astype("int16"))
    for _ in range(2):
        attach(solution, path, in_place=True)
    assert names_in(path) == ["PRIMARY", "ASDF"]
    check_sums(path)


# --- where it comes from -----------------------------------------------------------------------------------------


def test_provenance(one, frame, stored):
    attach(Solution.read(stored), frame.with_name("exp00.fits"), in_place=True)
    image, table = (fits.getheader(frame.with_name("exp00.fits"), ext) for ext in (0, "ASDF"))
    digest = hashlib.sha256(Path(stored).read_bytes()).hexdigest()
    assert image["SOLSHA"] == table["SOLSHA"] == digest
    assert table["EXPNAME"] == "exp00"
    assert table["CREATOR"] == f"legdistort {legdistort.__version__}"
    assert abs(datetime.datetime.fromisoformat(table["DATE"] + "+00:00").timestamp() - time.time()) < 60
    assert f"legdistort {legdistort.__version__}, numpy" in " ".join(table["HISTORY"])
    attach(one, frame, in_place=True)  # in memory, or changed since it was read
    assert "SOLSHA" not in fits.getheader(frame)
    assert dataclasses.replace(Solution.read(stored), degree=1).checksum is None


# --- several detectors -------------------------------------------------------------------------------------------


@pytest.fixture
def mosaic(tmp_path):
    images = [fits.ImageHDU(pixels(k).astype("int32"), header_of(OLD), name="SCI", ver=k) for k in (1, 2)]
    path = tmp_path / "night.fits"
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(path)
    return path


def test_all_detectors_of_a_file_at_once(geometry, mosaic):
    solution = geometry(1, 2.0, shape=SHAPE, names=("night_SCI1", "night_SCI2"))
    done = attach(solution, mosaic, in_place=True)
    assert [item.exposure for item in done] == ["night_SCI1", "night_SCI2"]
    for number, item in enumerate(done, start=1):
        header = fits.getheader(mosaic, ("SCI", number))
        assert holds(header, item.header)
        assert_allclose(wcs_in(mosaic, number)(3.0, 4.0), solution[item.exposure].wcs(3.0, 4.0), rtol=0, atol=1e-12)
        assert fits.getheader(mosaic, ("ASDF", number))["EXPNAME"] == f"night_SCI{number}"


def test_detectors_one_by_one(geometry, mosaic):
    solution = geometry(3, 2.0, shape=SHAPE, names=("night_SCI1", "night_2"))
    attach(solution, mosaic, in_place=True, kind=None, ext=2)
    attach(solution, mosaic, in_place=True, kind=None, ext=("SCI", 1))
    assert fits.getheader(mosaic, ("ASDF", 1))["EXPNAME"] == "night_2"
    assert fits.getheader(mosaic, ("ASDF", 2))["EXPNAME"] == "night_SCI1"
    assert_allclose(wcs_in(mosaic, 1)(3.0, 4.0), solution["night_2"].wcs(3.0, 4.0), rtol=0, atol=1e-12)
    attach(solution, mosaic, in_place=True, kind=None)
    assert names_in(mosaic) == ["PRIMARY", "SCI", "SCI", "ASDF", "ASDF"]


@pytest.mark.slow
def test_errors_and_flags_get_the_wcs_of_their_image(geometry, tmp_path):
    """Of two detectors, each to its own by EXTVER; not what has another shape or is another image."""
    solution = geometry(1, 2.0, shape=SHAPE, names=("night_SCI1", "night_SCI2"))
    path, zeros = tmp_path / "night.fits", np.zeros(SHAPE, "uint8")
    beside = [fits.ImageHDU(zeros, header_of(OLD), name=name, ver=k) for k in (1, 2) for name in ("SCI", "ERR", "DQ")]
    others = [fits.ImageHDU(zeros[:9], name="ERR", ver=3), fits.ImageHDU(zeros, name="SCI", ver=4)]
    fits.HDUList([fits.PrimaryHDU(), *beside, *others]).writeto(path)
    before = path.read_bytes()
    attach(solution, path, in_place=True, ext=("SCI", 2))
    first, *_ = locate(before, path)[4:5]
    assert path.read_bytes()[: first.start] == before[: first.start]  # nothing of the other detector
    done = {item.exposure[-1]: item.header for item in attach(solution, path, in_place=True, kind="tpv")}
    for k, header in done.items():
        for name in ("SCI", "ERR", "DQ"):
            assert holds(fits.getheader(path, (name, int(k))), header)
    assert done["1"]["CRVAL1"] == fits.getheader(path, ("DQ", 1))["CRVAL1"]
    assert "CTYPE1" not in fits.getheader(path, ("ERR", 3))
    assert "CTYPE1" not in fits.getheader(path, ("SCI", 4))
    before = path.read_bytes()
    attach(solution, path, out=tmp_path / "out", kind=None)
    last = locate(before, path)[8]
    assert (tmp_path / "out" / "night.fits").read_bytes()[: last.stop] == before[: last.stop]


def _blocks(path):
    """Headers of a text in which each ends with END, as SWarp reads it."""
    blocks = path.read_text().split("END\n")
    assert blocks.pop() == ""
    return [fits.Header.fromstring(block, sep="\n") for block in blocks]


@pytest.mark.parametrize("corner", [-0.5, 0.0], ids=["edges", "middles"])
def test_a_footprint_keeps_its_pixels(one, tmp_path, corner):
    """Of the former WCS, a plain one that is off by pixels; corners are rounded to halves of them."""
    (ny, nx), made = SHAPE, one["frame"].header(kind="sip")
    former = fits.Header({key: made[key] for key in ("CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2")})
    former.update({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": made["CRPIX1"] + 4.0})
    former.update({key: made[key] for key in made if key.startswith(("CD", "PC"))})
    pixels_of = np.array([[corner, corner], [nx - 1 - corner, corner], [nx - 1 - corner, ny - 1 - corner]])
    sky = WCS(former).all_pix2world(pixels_of + [[0.1, -0.1]], 0)
    former["S_REGION"] = "POLYGON ICRS  " + " ".join(f"{each:.9f}" for each in sky.ravel())
    path = tmp_path / "frame.fits"
    images = [fits.PrimaryHDU(pixels(), former), fits.ImageHDU(np.zeros(3), fits.Header({"S_REGION": "CIRCLE 1 2 3"}))]
    fits.HDUList(images).writeto(path, checksum=True)
    attach(one, path, in_place=True)
    check_sums(path)
    with fits.open(path) as hdus:
        text, wcs = hdus[0].header["S_REGION"], WCS(hdus[0].header)
        assert hdus[1].header["S_REGION"] == "CIRCLE 1 2 3"
    assert text.startswith("POLYGON ICRS  ")
    renewed = np.array(text.split()[2:], dtype=float).reshape(-1, 2)
    assert np.abs(renewed - sky).max() > 1e-6
    assert_allclose(wcs.all_world2pix(renewed, 0), pixels_of, atol=0.01)


@pytest.mark.parametrize("text", ["CIRCLE ICRS 1 2 3", "POLYGON ICRS 1 2 3", "POLYGON 10 20 30 40 50 60", ""])
def test_a_footprint_of_another_kind_or_place_stays(one, frame, text):
    with fits.open(frame, mode="update", do_not_scale_image_data=True) as hdus:
        for key in OLD:
            hdus[0].header.remove(key, ignore_missing=True)
        hdus[0].header["S_REGION"] = text
    attach(one, frame, in_place=True)
    assert fits.getheader(frame)["S_REGION"] == text


def test_head_files_have_a_block_for_every_image(geometry, tmp_path):
    """In the order of the file, for errors and flags that of their image, and the frames as they were."""
    solution = geometry(3, 2.0, shape=SHAPE, names=("night_SCI1", "night_SCI2"))
    path, zeros = tmp_path / "night.fits", np.zeros(SHAPE, "uint8")
    beside = [fits.ImageHDU(zeros, header_of(OLD), name=name, ver=k) for k in (1, 2) for name in ("SCI", "DQ")]
    fits.HDUList([fits.PrimaryHDU(), *beside, fits.ImageHDU(zeros[:9], name="ERR", ver=3)]).writeto(path)
    before = path.read_bytes()
    done = attach(solution, path, in_place=True, kind="head")
    assert path.read_bytes() == before
    assert {item.path for item in done} == {tmp_path.resolve() / "night.head"}
    blocks = _blocks(tmp_path / "night.head")
    assert len(blocks) == 5
    assert not blocks[4]
    x, y = np.meshgrid([0.0, 40.0, 89.0], [0.0, 30.0, 59.0])
    for k, name in enumerate(["night_SCI1", "night_SCI1", "night_SCI2", "night_SCI2"]):
        sky = WCS(blocks[k]).pixel_to_world(x, y)
        assert blocks[k]["CTYPE1"] == "RA---TPV"
        found = np.stack(solution[name].wcs.world_to_pixel(sky))
        assert_allclose(found, [x, y], rtol=0, atol=1e-3)
    with pytest.raises(InputError, match=r"night\.head exists already"):
        attach(solution, path, in_place=True, kind="head")
    attach(solution, path, out=tmp_path / "heads", kind="head")
    assert (tmp_path / "heads" / "night.head").read_bytes() == (tmp_path / "night.head").read_bytes()
    assert [each.name for each in (tmp_path / "heads").iterdir()] == ["night.head"]


@pytest.mark.parametrize(
    ("cards", "wanted"),
    [
        ({"EGAIN": (2.1, "[e-/ADU]"), "SATLEVEL": 50000.0}, {"GAIN": 2.1, "SATURATE": 50000.0}),
        ({"EGAIN": 2.1, "GAIN": (100, "setting of the camera")}, {"GAIN": 2.1}),
        ({"EGAIN": 2.0, "BUNIT": "adu/s", "EXPTIME": 30.0}, {"GAIN": 60.0}),
        ({"GAIN": 2.1, "SATURATE": 50000.0}, {}),
        ({"GAIN": (100, "setting of the camera")}, {}),
        ({}, {}),
    ],
)
@pytest.mark.parametrize("in_extension", [False, True])
def test_head_files_have_the_gain_that_swarp_looks_for(one, tmp_path, cards, wanted, in_extension):
    """SWarp knows the keywords GAIN and SATURATE alone, and without a gain COMBINE_TYPE CLIPPED does not clip."""
    data, header = np.zeros(SHAPE, "f4"), header_of(OLD)
    if in_extension:
        flags = fits.ImageHDU(np.zeros(SHAPE, "uint8"), name="DQ")
        hdus = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(data, header, name="SCI"), flags])
    else:
        hdus = fits.HDUList([fits.PrimaryHDU(data, header)])
    for key, value in cards.items():
        hdus[0].header[key] = value
    hdus.writeto(tmp_path / "frame.fits")
    attach(one, tmp_path / "frame.fits", in_place=True, kind="head")
    blocks = _blocks(tmp_path / "frame.head")
    assert {key: blocks[0][key] for key in ("GAIN", "SATURATE") if key in blocks[0]} == wanted
    assert not {"GAIN", "SATURATE"} & {key for block in blocks[1:] for key in block}


def test_head_files_of_packed_frames(one, tmp_path):
    write_frame(tmp_path / "frame.fits")
    (tmp_path / "frame.fits.gz").write_bytes(gzip.compress((tmp_path / "frame.fits").read_bytes()))
    (item,) = attach(one, tmp_path / "frame.fits.gz", in_place=True, kind="head")
    assert item.path.name == "frame.head"
    assert repr(item).endswith("px>")


@pytest.mark.parametrize("in_place", [pytest.param(True, marks=pytest.mark.slow), False])
def test_old_texts_beside_new_headers_are_named(geometry, tmp_path, in_place):
    """SWarp would read the old header; nobody is warned of the texts of others, or of those that are written now."""
    names = [f"f{k}" for k in range(5)]
    solution = geometry(1, 2.0, shape=SHAPE, names=names)
    frames = [write_frame(tmp_path / f"{name}.fits") for name in names]
    where = {"in_place": True} if in_place else {"out": tmp_path / "out", "overwrite": True}
    folder = tmp_path if in_place else tmp_path / "out"
    folder.mkdir(exist_ok=True)
    (folder / "another.head").write_text("END\n")
    attach(solution, frames, **where)  # any warning is an error
    for name in names[1:]:
        (folder / f"{name}.head").write_text("END\n")
    found = r"beside 4 of the files written stands a text .head \(.*f1.head, .*f3.head and 1 more\), which .*--head"
    for kind in ("sip", "tpv"):
        with warns_here(AssumptionWarning, found):
            attach(solution, frames, kind=kind, **where)
    attach(solution, frames, kind="head", **where | {"overwrite": True})
    attach(solution, frames, kind=None, **where)


def test_flags_of_two_images_are_left_alone(geometry, tmp_path):
    solution = geometry(1, 2.0, shape=SHAPE, names=("night_A", "night_B"))
    hdus = [fits.ImageHDU(np.zeros(SHAPE, "uint8"), name=name) for name in ("A", "B", "DQ")]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(tmp_path / "night.fits")
    attach(solution, tmp_path / "night.fits", in_place=True)
    assert "CTYPE1" in fits.getheader(tmp_path / "night.fits", "B")
    assert "CTYPE1" not in fits.getheader(tmp_path / "night.fits", "DQ")


def test_one_image_under_two_names(geometry, mosaic):
    solution = geometry(3, 2.0, shape=SHAPE, names=("night_1", "night_SCI1"))
    with pytest.raises(InputError, match=r"night.fits: exposures night_1, night_SCI1 are the same image; .*ext="):
        attach(solution, mosaic, in_place=True)


# --- refusals, with nothing written ------------------------------------------------------------------------------


@pytest.mark.slow
def test_nothing_is_written_unless_all_can_be(geometry, tmp_path):
    good = geometry(3, 2.0, shape=SHAPE, names=("frame", "other"))
    coefficients = good.coefficients.copy()
    coefficients[1, :, -2:] = 1.5
    solution = dataclasses.replace(good, coefficients=coefficients)
    paths = [write_frame(tmp_path / f"{name}.fits") for name in solution.names]
    before = [path.read_bytes() for path in paths]
    for where in ({"in_place": True}, {"out": tmp_path / "out"}):
        with pytest.raises(
            ExportError, match=r"other: no SIP header .* of degree 9, has .* px.*kind=None \(--asdf-only\)"
        ):
            attach(solution, paths, **where)
    assert [path.read_bytes() for path in paths] == before
    assert sorted(item.name for item in tmp_path.iterdir()) == ["frame.fits", "other.fits"]
    attach(solution, paths, kind=None, in_place=True)
    assert_allclose(wcs_in(paths[1])(9.0, 8.0), solution["other"].wcs(9.0, 8.0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("where", ["in place", "out"])
def test_a_full_disk_leaves_the_frame(one, frame, tmp_path, monkeypatch, where):
    before = frame.read_bytes()

    class Full(io.FileIO):
        def write(self, data):
            super().write(data[:1000])
            raise OSError(28, "No space left on device")

    usual = Path.open

    def opened(self, mode="r", **options):
        return Full(self, mode) if mode == "wb" else usual(self, mode, **options)

    monkeypatch.setattr("pathlib.Path.open", opened)
    with pytest.raises(OSError, match="No space left"):
        attach(one, frame, kind=None, **({"in_place": True} if where == "in place" else {"out": tmp_path / "out"}))
    assert frame.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["frame.fits"]


def test_mode_and_links_survive(one, frame, tmp_path):
    frame.chmod(0o640)
    (tmp_path / "store").mkdir()
    stored = frame.rename(tmp_path / "store" / "raw.fits")
    frame.symlink_to(stored)
    attach(one, frame, in_place=True)  # the name given tells the exposure
    assert frame.is_symlink()
    assert os.stat(stored).st_mode & 0o777 == 0o640
    assert "A_ORDER" in fits.getheader(stored)


def test_a_frame_that_changes_meanwhile(one, frame, monkeypatch):
    from legdistort.wcs import attachment

    plan = attachment._plan

    def meddle(*args, **options):
        done = plan(*args, **options)
        with fits.open(frame, mode="update") as hdus:
            hdus[0].header["NEW"] = 1
        return done

    monkeypatch.setattr(attachment, "_plan", meddle)
    with pytest.raises(InputError, match="changed while it was worked on"):
        attach(one, frame, in_place=True, kind=None)
    assert fits.getheader(frame)["NEW"] == 1


def _text(path):
    path.write_text("not an image at all")


def _cut(size):
    return lambda path: path.write_bytes(path.read_bytes()[:size])


def _broken_gzip(path):
    path.write_bytes(gzip.compress(path.read_bytes())[:3000])


def _table(path):
    table = fits.BinTableHDU.from_columns([fits.Column("a", "E", array=[1.0])])
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path, overwrite=True)


def _other_shape(path):
    fits.writeto(path, np.zeros((20, 30)), overwrite=True)


def _foreign(path):
    with fits.open(path) as hdus:
        column = fits.Column("ASDF_METADATA", "9B", array=np.zeros((1, 9), "uint8"))
        fits.HDUList([*hdus, fits.BinTableHDU.from_columns([column], name="ASDF")]).writeto(path, overwrite=True)


@pytest.mark.parametrize(
    ("spoil", "options", "words"),
    [
        (_text, {}, r"frame.fits: not a FITS file"),
        (_cut(20000), {}, r"frame.fits: (truncated, the data of|damaged or truncated, the \d+ bytes after) HDU \d"),
        (_cut(7000), {}, r"frame.fits: truncated, the data of HDU 0 PRIMARY are incomplete"),
        (_broken_gzip, {}, "frame.fits: cannot be unpacked, damaged"),
        (_table, {}, "frame.fits: no image"),
        (_other_shape, {}, r"frame.fits: the image has shape \(20, 30\), exposure frame of the solution \(60, 90\)"),
        (_foreign, {}, r"extension ASDF of another program, unnamed, .*overwrite=True \(--overwrite\)"),
        (
            None,
            {"ext": "SCI"},
            r"frame.fits: no exposure 'frame_SCI' in the solution; it has frame, other; frames are identified by",
        ),
        (os.unlink, {}, "frame.fits: no such file"),
        (None, {"kind": "tan"}, "kind must be one of"),
        (None, {"max_error": -1}, "max_error must be a positive number"),
        (None, {"out": "copies"}, r"give either out= \(--out\), a folder for copies, or in_place=True"),
        (None, {"in_place": False}, r"give either out= \(--out\), a folder for copies, or in_place=True"),
    ],
)
def test_bad_input_is_named(one, frame, tmp_path, spoil, options, words):
    if spoil is not None:
        spoil(frame)
    before = frame.read_bytes() if frame.exists() else None
    with pytest.raises(InputError, match=words):
        attach(one, frame, **({"in_place": True} | options))
    assert before is None or frame.read_bytes() == before
    assert not (tmp_path / "copies").exists()


def test_extension_that_is_missing(geometry, frame):
    solution = geometry(3, 2.0, shape=SHAPE, names=("frame_SCI",))
    with pytest.raises(InputError, match=r"frame.fits: no extension 'SCI'; the file has 0 PRIMARY, 1 PACKED"):
        attach(solution, frame, in_place=True, ext="SCI")


def test_places_that_are_taken(one, frame, tmp_path):
    with pytest.raises(InputError, match=r"is in the folder for the copies; choose another, or in_place=True"):
        attach(one, frame, out=tmp_path, overwrite=True)
    attach(one, frame, out=tmp_path / "out", kind=None)
    with pytest.raises(InputError, match=r"out.frame.fits exists already; give overwrite=True"):
        attach(one, frame, out=tmp_path / "out")
    attach(one, frame, out=tmp_path / "out", overwrite=True, kind=None)
    with pytest.raises(InputError, match=r"frame.fits is given twice"):
        attach(one, [frame, str(frame)], in_place=True)
    several = [
        tmp_path / each / "frame.fits" for each in ("a/x", "a/y", "b/x")
    ]  # which no level of folders tells apart
    for path in several:
        path.parent.mkdir(parents=True)
        shutil.copy(frame, path)
    with pytest.raises(InputError, match=r"two frames are named frame.fits"):
        attach(one, several, out=tmp_path / "both")
    with pytest.raises(InputError, match="frames must be paths of FITS files, got HDUList"):
        attach(one, fits.HDUList(), in_place=True)


def test_foreign_asdf_is_replaced_when_asked(one, frame):
    _foreign(frame)
    attach(one, frame, in_place=True, overwrite=True, kind=None)
    assert names_in(frame).count("ASDF") == 1
    assert_allclose(wcs_in(frame)(3.0, 4.0), one["frame"].wcs(3.0, 4.0), rtol=0, atol=1e-12)


def test_no_sky(one, frame):
    blind = dataclasses.replace(one, sky=None)
    with pytest.raises(
        InputError, match=r"does not know the sky.*\(reference=, --reference\); kind=None \(--asdf-only\)"
    ):
        attach(blind, frame, in_place=True)
    (done,) = attach(blind, frame, in_place=True, kind=None)
    assert repr(done) == f"<Attachment: frame in {frame}: ASDF>"
    assert wcs_in(frame).available_frames == ["detector", "undistorted", "reference"]


def test_a_frame_of_another_field_is_named(one, tmp_path, recwarn):
    """Names of exposures are those of files, and exp00 there is every night."""
    nx = SHAPE[1]
    for off, told in ((0.0, 0), (0.4, 0), (3.0, 1)):  # frames in which the headers lead elsewhere
        header = one["frame"].header()
        header["CRPIX1"] += off * nx
        path = tmp_path / "frame.fits"
        fits.PrimaryHDU(pixels().astype("int16"), header).writeto(path, overwrite=True)
        recwarn.clear()
        attach(one, path, in_place=True, kind=None)
        assert sum("another field with the same names of frames" in str(each.message) for each in recwarn) == told
        assert all(str(each.message).startswith("frame: by the header more than a frame away") for each in recwarn)


def test_frames_left_out_are_skipped_by_name(one, frame, tmp_path, caplog):
    solution = dataclasses.replace(one, left_out={"dark": "no star was detected in it"})
    dark = write_frame(tmp_path / "dark.fits")
    before = dark.read_bytes()
    (done,) = attach(solution, [dark, frame], in_place=True, kind=None)
    assert done.exposure == "frame"
    assert dark.read_bytes() == before
    assert "dark.fits: skipped, it was left out of the solution (no star was detected in it)" in caplog.text
    with pytest.raises(InputError, match="none of the frames is part of the solution"):
        attach(solution, dark, in_place=True)


# --- the command -------------------------------------------------------------------------------------------------


@pytest.fixture
def stored(one, tmp_path):
    solution = solve(simulate_matches(n_stars=20, n_exposures=2, degree=1, shape=SHAPE, seed=1).matches, degree=1)
    write_frame(tmp_path / "exp00.fits")
    return str(dataclasses.replace(solution, sky=one.sky).write(tmp_path / "solution.asdf"))


def test_command(stored, tmp_path, capsys):
    frame = tmp_path / "exp00.fits"
    out = tmp_path / "out"
    assert main(["attach", stored, str(frame), "--out", str(out), "--tpv", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["exp00"]
    header = fits.getheader(out / "exp00.fits")
    assert figures == {"path": str(out / "exp00.fits"), **{k: header[k] for k in ("TPVMXERR", "TPVIVERR")}}
    assert main(["attach", stored, str(frame), "--in-place"]) == 0
    assert "exp00 in " in (said := capsys.readouterr().out)
    assert said.strip().endswith("px, ASDF")
    assert main(["attach", stored, str(frame), "--out", str(out)]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert main(["attach", stored, str(frame), "--out", str(out), "--asdf-only", "--overwrite"]) == 0
    capsys.readouterr()
    assert main(["attach", stored, str(frame), "--in-place", "--head"]) == 0
    assert re.fullmatch(r"exp00 in .*exp00\.head: TPV within \S+ px", capsys.readouterr().out.strip())


def test_command_names_the_best_error(stored, tmp_path, capsys):
    frame = tmp_path / "exp00.fits"
    assert main(["attach", stored, str(frame), "--out", str(tmp_path / "out"), "--max-error", "1e-12"]) == 1
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    assert "the best, of degree 9, has" in error
    assert "--asdf-only" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options",
    [[], ["--out", "x", "--in-place"], ["--in-place", "--tpv", "--asdf-only"], ["--in-place", "--max-error", "a"]],
)
def test_wrong_usage(options):
    with pytest.raises(SystemExit) as status:
        main(["attach", "solution.asdf", "frame.fits", *options])
    assert status.value.code == 2


# --- all or nothing over a set ------------------------------------------------------------------------------------


@pytest.fixture
def three(geometry, tmp_path):
    """A solution of three frames, two of them in one folder and one in another; and these frames."""
    solution = geometry(3, 2.0, shape=SHAPE, names=("a", "b", "c"))
    folders = [tmp_path / "first", tmp_path / "first", tmp_path / "second"]
    for folder in folders:
        folder.mkdir(exist_ok=True)
    return solution, [
        write_frame(folder / f"{name}.fits") for folder, name in zip(folders, solution.names, strict=True)
    ]


def has_wcs(path):
    with fits.open(path) as hdus:
        return "ASDF" in hdus


def everything(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def check_nothing_happened(solution, paths, folder, before):
    """Files are as they were before a failure, and the next call works, and leaves nothing else."""
    assert everything(folder) == before
    attach(solution, paths, in_place=True)
    assert all(map(has_wcs, paths))
    assert everything(folder).keys() == before.keys()


@pytest.mark.parametrize("good", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_frames_are_changed_all_or_none(three, tmp_path, monkeypatch, good):
    solution, paths = three
    before, usual, written = everything(tmp_path), attachment._Plan.write, []

    def write(plan, file):
        if len(written) == good:
            raise OSError(28, "No space left on device")
        written.append(plan)
        usual(plan, file)

    with monkeypatch.context() as patch:
        patch.setattr(attachment._Plan, "write", write)
        with pytest.raises(DiskFullError, match=r"No space left on the disk for .*fits, which was left as it was"):
            attach(solution, paths, in_place=True)
    check_nothing_happened(solution, paths, tmp_path, before)


@pytest.mark.slow
def test_a_disk_that_fails_between_two_files(three, tmp_path, monkeypatch):
    """Those that were replaced come back, in whatever folder."""
    solution, paths = three
    before, usual = everything(tmp_path), os.replace

    def replace(path, target):
        if Path(target) == paths[2] and ".replaced-" not in str(path):
            raise OSError(5, "Input/output error", str(path), None, str(target))
        usual(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", replace)
        with pytest.raises(OSError, match="Input/output error"):
            attach(solution, paths, in_place=True)
    check_nothing_happened(solution, paths, tmp_path, before)


@pytest.mark.slow
def test_copies_come_together_beside_other_files(three, tmp_path, monkeypatch):
    """Of a folder of the user's own everything else stays, and a failure changes nothing."""
    solution, paths = three
    out = tmp_path / "out"
    attach(solution, paths, out=out)
    (out / "notes.txt").write_text("mine")
    before, usual, written = everything(tmp_path), attachment._Plan.write, []

    def write(plan, file):
        written.append(plan)
        usual(plan, file)
        if len(written) == 2:
            raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(attachment._Plan, "write", write)
        with pytest.raises(OSError, match="Input/output error"):
            attach(solution, paths, out=out, overwrite=True)
    assert everything(tmp_path) == before
    attach(solution, paths, out=out, overwrite=True, kind=None)
    assert everything(tmp_path).keys() == before.keys()
    assert everything(tmp_path)[out / "notes.txt"] == b"mine"
    assert all(map(has_wcs, out.glob("*.fits")))


@pytest.mark.slow
def test_what_is_unknown_of_the_sky_and_maps_left_behind_are_said(tmp_path, caplog):
    """One line with the largest move of a star by 1 px of what is unknown; none where a prior determines all."""
    night = legdistort.simulate_exposures(small=True, n_exposures=4, seed=4)
    for name, hdu in night.hdus.items():
        hdu.writeto(tmp_path / f"{name}.fits")
        fits.writeto(tmp_path / f"{name}.weight.fits", np.ones(hdu[0].data.shape, "f4"))
    frames = [tmp_path / f"{name}.fits" for name in night.hdus]
    exposures = legdistort.read_exposures(list(night.hdus.values()))
    matches = legdistort.match(legdistort.measure(exposures, psf="moffat"), exposures=exposures)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", legdistort.exceptions.LegdistortWarning)
        free = legdistort.solve(matches, degree=2)
    moved = sum(np.nansum(each.stars**2, axis=1) for each in free.gauge.unknown)
    far = np.sqrt(moved.max()) * free.sky.pixel_scale
    attach(free, frames, out=tmp_path / "free")
    assert f"if it is 1 px rms, it moves places on the sky by up to {far:.2g} arcsec" in caplog.text
    assert "weight maps stay where they are (exp00.weight.fits, " in caplog.text
    caplog.clear()
    known = legdistort.solve(matches, degree=2, prior=legdistort.Prior(np.zeros((2, 6)), static_sigma=1.0))
    attach(known, frames, out=tmp_path / "known", kind="head")
    assert "not determined of absolute positions" not in caplog.text
    assert "weight maps" not in caplog.text
