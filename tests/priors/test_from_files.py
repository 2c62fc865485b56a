"""Static distortions from files of other software, each against its own reader or against plain numpy."""

import io
import json
import re
import sys
import warnings

import asdf
import gwcs
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import ICRS
from astropy.io import fits
from astropy.modeling import models
from astropy.wcs import WCS
from caller_warnings import warns_here
from gwcs import coordinate_frames as cf
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial
from numpy.testing import assert_allclose, assert_array_equal
from scamp_heads import barrel, matrix, to_plane, to_sky, write_head

from legdistort.assessment.nights.camera_memory import combine_nights
from legdistort.cameras.source import Source
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError, LegdistortError
from legdistort.geometry import basis, similarity
from legdistort.geometry.distortion import Distortion
from legdistort.geometry.gsaoi import GsaoiMap, gsaoi_polynomials, gsaoi_static
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.priors.from_files import read_source
from legdistort.priors.prior import Prior
from legdistort.results.solution import Solution
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.exposure_wcs import exposure_wcs

FORWARD, BACKWARD = "detector_to_reference", "reference_to_detector"


def grid(shape, n=40):
    """Pixels over the whole detector, edges and corners included, as x and y."""
    ny, nx = shape
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, n), np.linspace(-0.5, ny - 0.5, n))
    return x.ravel(), y.ravel()


def touching(sky, centre):
    """Gnomonic projection [deg] of (lon, lat) [deg] about a centre, by the textbook in extended precision."""
    lon, lat, lon0, lat0 = (np.radians(np.asarray(a, dtype=np.longdouble)) for a in (*sky, *centre))
    ahead = np.sin(lat0) * np.sin(lat) + np.cos(lat0) * np.cos(lat) * np.cos(lon - lon0)
    up = np.cos(lat0) * np.sin(lat) - np.sin(lat0) * np.cos(lat) * np.cos(lon - lon0)
    return np.degrees([np.cos(lat) * np.sin(lon - lon0) / ahead, up / ahead]).astype(float)


def distance(prior, plane):
    """Largest distance [pix] of a prior and the map it stands for, by one dense evaluation of that map."""
    x, y = grid(prior.shape, 500)
    q = similarity.apply(prior.plane, np.column_stack(plane(x, y)))
    beside = 0 if prior.table is None else prior.table(q)
    series = (prior.mean @ basis.values(prior.degree, *basis.normalize(q, prior.shape))).T
    return np.hypot(*(q + series + beside).T - [x, y]).max()


def sip_header(ra=10.0, dec=0.0, ctype="TAN-SIP", n=256):
    """A header with a distortion of a few pixels; the tangent point lies at the centre of the detector."""
    header = fits.Header({"NAXIS": 2, "NAXIS1": n, "NAXIS2": n, "CTYPE1": f"RA---{ctype}", "CTYPE2": f"DEC--{ctype}"})
    header.update({"CRPIX1": (n + 1) / 2, "CRPIX2": (n + 1) / 2, "CRVAL1": ra, "CRVAL2": dec})
    header.update({"CD1_1": -1e-5, "CD1_2": 2e-6, "CD2_1": 2e-6, "CD2_2": 1e-5})
    if ctype == "TAN-SIP":
        header.update({"A_ORDER": 3, "B_ORDER": 3, "A_2_0": 1e-4, "A_1_2": 2e-7, "B_1_1": -6e-5, "B_0_3": 3e-7})
    if ctype == "TPV":
        header.update({"PV1_1": 1.0, "PV1_4": 10.0, "PV1_7": 3e3, "PV2_1": 1.0, "PV2_4": -8.0, "PV2_10": 2e3})
    return header


def tpv_by_hand(header, x, y):
    cd = np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)])
    xi, eta = cd @ [x + 1 - header["CRPIX1"], y + 1 - header["CRPIX2"]]
    # axis 2 exchanges the roles of xi and eta; terms 4, 7, 10: square, cube, cube of the other
    return xi + 10 * xi**2 + 3e3 * xi**3, eta - 8 * eta**2 + 2e3 * xi**3


def sip_by_hand(header, x, y):
    u_, v = x + 1 - header["CRPIX1"], y + 1 - header["CRPIX2"]
    f, g = 1e-4 * u_**2 + 2e-7 * u_ * v**2, -6e-5 * u_ * v + 3e-7 * v**3
    cd = np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)])
    return cd @ [u_ + f, v + g]


@pytest.fixture
def nirc2(shared_data):
    return [shared_data / "static_distortion" / "nirc2_kai" / f"nirc2_narrow_{k}geoim_512.fits" for k in "xy"]


# --- each source against its own reader ----------------------------------------------------------------------------


@pytest.mark.parametrize("detector", [1, 2, 3, 4])
def test_gsaoi_table(shared_data, detector):
    """To 1e-10 arcsec, and our way back where the published one misses by 0.02 px."""
    path = shared_data / "static_distortion" / "gsaoi_dragons" / "gsaoi_static_distortion.json"
    table = json.loads(path.read_text())

    def powers(parts, x, y):
        return [sum(c * x ** int(k[1]) * y ** int(k[3]) for p in parts for k, c in p[axis].items()) for axis in "xy"]

    forward = [part["parameters"][detector - 1] for part in table["forward"]]
    backward = [part["parameters"][detector - 1] for part in table["backward"]]
    x, y = grid((2048, 2048), 60)
    arcsec = powers(forward, x + 1, y + 1)
    source = read_source(f"gsaoi-{detector}").stated()
    assert (source.shape, source.direction, source.origin) == ((2048, 2048), FORWARD, 0)
    assert_allclose(source.on_plane()(x, y), arcsec, rtol=0, atol=1e-10)
    theirs = np.hypot(*(powers(backward, *arcsec) - np.array([x + 1, y + 1])))
    assert 0.011 < theirs.max() < 0.021
    # Newton's method on the table itself, and the inverse that goes into files
    own = GsaoiMap(detector)
    p = np.column_stack([x, y])
    assert (
        np.abs(own.distort(similarity.apply(similarity.invert(own.similarity), np.transpose(arcsec))) - p).max() < 1e-8
    )
    prior = Prior.from_file(f"gsaoi-{detector}", degree=9)
    d = Distortion(prior.mean, prior.shape)
    undistorted = similarity.apply(prior.plane, np.transpose(arcsec))
    correction = d.model().inverse
    assert np.hypot(*(d(undistorted) - p).T).max() < 1e-6
    assert np.hypot(*(np.column_stack(correction(x, y)) - undistorted).T).max() < 1e-6


@pytest.mark.parametrize("name", ["nircamwcs", "miriwcs", "roman_wcs"])
def test_gwcs_files(shared_data, name):
    path = shared_data / "gwcs_interop" / f"{name}.asdf"
    shape = {"nircamwcs": (2048, 2048), "miriwcs": (1024, 1032), "roman_wcs": (5000, 5000)}[name]
    with asdf.open(path, memmap=False, lazy_load=False) as file:
        wcs = file["roman"]["wcs"] if "roman" in file.tree else file["wcs"]
    wcs.bounding_box = None
    x, y = grid(shape)
    frames = wcs.available_frames
    source = read_source(path).stated(shape=shape)
    assert source.details["frame"] == ("v2v3" if "v2v3" in frames else frames[-1])
    assert_allclose(
        source.function(x, y), wcs.get_transform(frames[0], source.details["frame"])(x, y), rtol=0, atol=1e-9
    )
    onto_sky = read_source(path, frame=frames[-1]).stated(shape=shape)
    assert_allclose(onto_sky.function(x, y), wcs(x, y), rtol=0, atol=1e-9)
    centre = wcs((shape[1] - 1) / 2, (shape[0] - 1) / 2)
    expected = touching(wcs(x, y), centre)
    scale = np.sqrt(abs(np.linalg.det(np.array(similarity.fit_similarity(np.column_stack([x, y]), expected.T))[:, :2])))
    assert np.abs(np.array(onto_sky.on_plane()(x, y)) - expected).max() / scale < 1e-9  # pixels


def test_v2v3_and_sky_are_the_same_distortion(shared_data):
    path = shared_data / "gwcs_interop" / "nircamwcs.asdf"
    first, second = (Prior.from_file(path, frame=frame) for frame in ("v2v3", "world"))
    assert first.shape == (2048, 2048)
    assert 2 < first.rms.min() < first.rms.max() < 6
    assert_allclose(second.mean, first.mean, rtol=0, atol=1e-7)
    assert set(first.source) == {"kind", "name", "direction", "origin", "frame", "files"}


def test_miri_reference_file(shared_data):
    """The ASDF model against the matrices in FITS from which it was made."""
    folder = shared_data / "static_distortion" / "miri_miricoord"
    source = read_source(folder / "jwst_miri_imager_distortion_flt9.asdf").stated(shape=(1024, 1032))
    with fits.open(folder / "MIRI_FM_MIRIMAGE_DISTORTION_SS.09.00.fits") as hdulist:
        m = {key: hdulist[f"{key} matrix"].data for key in ("MI", "AI", "BI", "TI")}
    x, y = grid((1024, 1032))
    one, two, _ = m["MI"] @ [y, x - 4, np.ones_like(x)]  # columns are counted from the first one in light
    inner = [polynomial.polyval2d(one, two, m[key]) for key in ("AI", "BI")]
    v2, v3, _ = m["TI"] @ [*inner, np.ones_like(x)]
    got = source.function(x, y)
    assert_allclose(got, [v2, v3], rtol=0, atol=1e-10)


@pytest.mark.parametrize(("ctype", "by_hand"), [("TAN-SIP", sip_by_hand), ("TPV", tpv_by_hand)])
@pytest.mark.parametrize("place", [(10.0, 0.0), (359.9999, 60.0), (0.0, 89.999)])
def test_fits_headers(tmp_path, ctype, by_hand, place):
    header = sip_header(*place, ctype)
    fits.PrimaryHDU(np.zeros((256, 256), np.float32), header).writeto(tmp_path / "a.fits")
    source = read_source(tmp_path / "a.fits").stated()
    x, y = grid(source.shape)
    assert_allclose(source.function(x, y), WCS(header).all_pix2world(x, y, 0), rtol=0, atol=1e-12)
    plane = by_hand(header, x, y)
    assert_allclose(source.on_plane()(x, y), plane, rtol=0, atol=5e-14 if place == (10.0, 0.0) else 2e-13)
    prior = Prior.from_file(tmp_path / "a.fits", degree=7)
    assert prior.rms.min() > 0.1
    assert distance(prior, lambda x, y: by_hand(header, x, y)) == pytest.approx(prior.truncation, rel=0.02, abs=1e-7)


def test_hst_header(shared_data):
    path = shared_data / "gwcs_interop" / "acs_wfc.hdr"
    header = fits.Header.fromtextfile(path)
    with warns_here(AssumptionWarning, match=r"look-up tables .*CPDIS1.*CPERR1 = 0\.083.* give the FITS file"):
        source = read_source(path).stated(shape=(2048, 4096))
    tables = [card for card in header.cards if card.keyword.startswith(("CPDIS", "D2IMDIS", "DP", "D2IM1"))]
    for keyword in {card.keyword for card in tables}:
        header.remove(keyword, ignore_missing=True, remove_all=True)
    x, y = grid((2048, 4096))
    with pytest.warns(Warning):  # noqa: PT030  (astropy finds many small faults in it)
        expected = WCS(header).all_pix2world(x, y, 0)
    assert_allclose(source.function(x, y), expected, rtol=0, atol=1e-12)


def test_maps(nirc2):
    source = read_source(nirc2).stated()
    maps = np.array([fits.getdata(path) for path in nirc2])
    y, x = np.indices((512, 512)).astype(float)
    shifts = np.array(source.on_plane()(x.ravel(), y.ravel())).reshape(maps.shape) - [x, y]
    assert_allclose(shifts, maps, rtol=0, atol=1e-9)
    assert (source.direction, source.shape) == (FORWARD, (512, 512))
    # over the outer half pixel it goes on as it went
    edge = source.on_plane()(np.array([-0.5]), np.array([200.0]))[0] + 0.5
    assert_allclose(edge, 1.5 * maps[0, 200, 0] - 0.5 * maps[0, 200, 1], atol=1e-3)


@pytest.mark.parametrize("name", ["cubic", "cubic_wide", "narrow_2007", "narrow_ACS", "wide_2007"])
def test_drizzle_coefficients(shared_data, name):
    path = shared_data / "static_distortion" / "nirc2_kai" / f"nirc2_{name}.coeffs.txt"
    source = read_source(path).stated(shape=(1024, 1024))
    words = [word for line in path.read_text().splitlines() if not line.startswith("#") for word in line.split()]
    words = words[2:] if words[0] == "poly" else words[1:]
    cx, cy = np.array(words, dtype=float).reshape(2, -1)
    x, y = grid((1024, 1024))
    dx, dy = x - 512, y - 512  # FITS pixel nx/2 + 1
    order = [(n - k, k) for n in range(6) for k in range(n + 1)]
    expected = [sum(a * dx**i * dy**j for a, (i, j) in zip(c, order, strict=False)) for c in (cx, cy)]
    assert_allclose(source.on_plane()(x, y), expected, rtol=0, atol=1e-9)


def test_drizzle_coefficients_agree_with_the_maps(shared_data, nirc2):
    """Two calibrations of one camera, the maps of its inner quarter: centre, direction and sign are right."""
    polynomial_ = read_source(shared_data / "static_distortion" / "nirc2_kai" / "nirc2_narrow_ACS.coeffs.txt")
    whole = polynomial_.stated(shape=(1024, 1024)).on_plane()
    inner = Prior.from_model(lambda x, y: whole(x + 256, y + 256), shape=(512, 512), direction=FORWARD)
    maps = Prior.from_file(nirc2)
    assert_allclose(maps.rms, [0.26, 0.34], atol=0.01)
    left = np.sqrt(((inner.mean - maps.mean) ** 2).sum(axis=1)) / 2
    assert_allclose(left, [0.056, 0.046], atol=0.005)


def _cubic(x, y):
    """Undistorted to detector pixels of a detector of 1024 pixels: a polynomial of degree 3."""
    u, v = (x - 500.0) / 500, (y - 520.0) / 500
    return x + 0.8 * u**2 - 0.3 * u * v**2 + 0.2 * v**3, y + 0.5 * u * v - 0.4 * v**2 + 0.1 * u**3


@pytest.mark.parametrize(
    ("offset", "part", "shape"), [((256, 128), (512, 640), (1024, 1024)), ((-256, -100), (1024, 1024), (600, 512))]
)
def test_a_part_is_placed_in_the_detector(offset, part, shape):
    """A polynomial known on a part of the detector, or on more than it, is the same polynomial on all of it."""
    known = {"direction": "reference_to_detector", "origin": 0, "degree": 3}
    x0, y0 = offset

    def of_part(x, y):
        return tuple(
            value - o for value, o in zip(_cubic(x + max(x0, 0), y + max(y0, 0)), np.maximum(offset, 0), strict=True)
        )

    def of_whole(x, y):  # the detector's own pixels are those of the cubic, or lie inside them
        return tuple(
            value + o for value, o in zip(_cubic(x - min(x0, 0), y - min(y0, 0)), np.minimum(offset, 0), strict=True)
        )

    source = Source("part", "function", of_part, shape=part)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        placed = Prior.from_model(source, shape=shape, offset=offset, **known)
    whole = Prior.from_model(of_whole, shape=shape, **known)
    assert_allclose(placed.mean, whole.mean, rtol=0, atol=1e-7)
    assert_allclose(placed.plane[:, :2], whole.plane[:, :2], rtol=0, atol=1e-9)
    assert placed.truncation < 1e-7
    assert placed.shape == shape
    told = [str(w.message) for w in caught]
    assert [("31 % of the detector; elsewhere its polynomial of degree 3" in t) for t in told] == [True] * (x0 > 0)


def test_the_maps_of_nirc2_in_the_whole_detector(shared_data, nirc2, tmp_path, capsys):
    """Against the polynomial of the same observatory for the whole detector, on the inner quarter."""
    polynomial_ = read_source(shared_data / "static_distortion" / "nirc2_kai" / "nirc2_narrow_ACS.coeffs.txt")
    whole = Prior.from_model(polynomial_, shape=(1024, 1024))
    out = tmp_path / "prior.asdf"
    command = ["prior", *map(str, nirc2), "--offset", "256", "256", "--shape", "1024", "1024", "--degree", "5"]
    assert main([*command, "--out", str(out)]) == 0
    assert "covers 25 % of the detector" in capsys.readouterr().err
    placed, alone = Prior.read(out), Prior.from_file(nirc2, degree=5)
    assert placed.source["offset"] == [256, 256]
    assert placed.table is None  # of a part nothing but the series goes on
    assert 50 * alone.truncation < placed.truncation
    x, y = np.stack(grid((512, 512), 40))
    q = np.column_stack([x, y]) + 256
    mine, theirs = (Distortion(p.mean, (1024, 1024))(q) - q for p in (placed, whole))
    design = np.column_stack([np.ones(len(q)), q])
    left = [d - design @ np.linalg.lstsq(design, d, rcond=None)[0] for d in (mine, theirs)]
    assert np.std(left[0]) > 0.2
    assert np.std(left[0] - left[1]) < 0.06  # as on the quarter alone


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"offset": (2000, 0)}, r"lies beside the detector of shape \(1024, 1024\): offset \(--offset X Y\) is where"),
        ({"offset": (1, 2, 3)}, r"offset must be x, y in pixels of the detector, got \(1, 2, 3\)"),
        (
            {"offset": (256, 256), "degree": 9},
            r"75 % of the detector that it does not cover, at degree 9: .*lower the deg",
        ),
    ],
)
def test_bad_offsets(nirc2, options, message):
    with pytest.raises(InputError, match=message):
        Prior.from_file(nirc2, shape=(1024, 1024), **options)


def test_an_offset_needs_a_size():
    with pytest.raises(InputError, match=r"has no size of its own: leave offset \(--offset\) out"):
        Prior.from_model(_cubic, shape=(1024, 1024), direction="reference_to_detector", offset=(1, 1))


def test_an_offset_needs_the_size_of_the_detector():
    with pytest.raises(InputError, match=r"places gsaoi-2 in a detector of another size: .* \(--shape\), or leave"):
        Prior.from_file("gsaoi-2", offset=(3, 3))


def test_refpix(tmp_path):
    (tmp_path / "c.txt").write_text("# comment\nrefpix 11 21\n\npoly 1\n0 1.5 0.25\n0 -0.25 1.5D0\n")
    source = read_source(tmp_path / "c.txt").stated(shape=(50, 50))
    assert_allclose(source.on_plane()(np.array([10.0, 11]), np.array([20.0, 20])), [[0, 1.5], [0, -0.25]])


@pytest.mark.parametrize(("frame", "aperture"), [(None, "NRCA1_FULL"), ("idl", "NRCB5_FULL"), ("tel", "NRCA1_FULL")])
def test_siaf(frame, aperture):
    pysiaf = pytest.importorskip("pysiaf")
    reader = pysiaf.Siaf("NIRCam")[aperture]
    source = read_source(f"siaf:NIRCam/{aperture}", frame=frame).stated()
    assert (source.shape, source.origin) == ((2048, 2048), 1)
    x, y = grid(source.shape)
    expected = reader.sci_to_idl(x + 1, y + 1) if frame != "tel" else reader.sci_to_tel(x + 1, y + 1)
    assert_allclose(source.function(x + 1, y + 1), expected, rtol=0, atol=1e-9)
    prior = Prior.from_model(reader, frame=frame)
    assert 1 < prior.rms.min() < prior.rms.max() < 10
    assert prior.truncation < 0.01
    with pytest.raises(InputError, match="frame of a SIAF aperture must be 'idl' or 'tel', got 'sky'"):
        read_source(f"siaf:NIRCam/{aperture}", frame="sky")
    with pytest.raises(InputError, match="NIRCam has no aperture 'NRCA1_FUL'; it has NRCA1_FULL, "):
        read_source("siaf:NIRCam/NRCA1_FUL")
    with pytest.raises(InputError, match="pysiaf has no instrument 'Camera'"):
        read_source("siaf:Camera/A")


def test_siaf_without_pysiaf(monkeypatch):
    monkeypatch.setitem(sys.modules, "pysiaf", None)
    with pytest.raises(InputError, match="need pysiaf; pip install pysiaf"):
        read_source("siaf:NIRCam/NRCA1_FULL")


# --- truncation, directions, units ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_truncation_is_true(shared_data, nirc2):
    """Not smaller than by another evaluation on 500 x 500 points, corners included."""
    bump = {"shape": (300, 400), "direction": FORWARD}  # 25 px wide, so that a coarse grid steps over its top
    cases = [(nirc2, {"degree": degree}) for degree in (3, 9)]
    cases += [(shared_data / "gwcs_interop" / "nircamwcs.asdf", {"degree": 4})]
    for where, options in cases:
        prior = Prior.from_file(where, **options)
        found = distance(prior, read_source(where).stated().on_plane())
        if prior.table is None:
            assert found * (1 - 1e-4) <= prior.truncation <= 1.01 * found
        else:  # with kinks at every node
            assert found / 1.5 <= prior.truncation <= 1.5 * found
            assert found < 3e-4
    function = lambda x, y: (x + 0.5 * np.exp(-((x - 101.3) ** 2 + (y - 77.7) ** 2) / 200), y)  # noqa: E731
    prior = Prior.from_model(function, degree=6, **bump)
    found = distance(prior, function)
    assert found * (1 - 1e-3) <= prior.truncation <= 1.01 * found


@pytest.mark.parametrize("direction", [FORWARD, BACKWARD])
def test_maps_in_both_directions(tmp_path, direction):
    rng = np.random.default_rng(3)
    shape, mean = (60, 80), np.zeros((2, 10))
    mean[:, 3:] = rng.normal(0, 0.3, (2, 7))
    d = Distortion(mean, shape)
    y, x = np.indices(shape).astype(float)
    p = np.column_stack([x.ravel(), y.ravel()])
    shift = (d.invert(p) if direction == FORWARD else d(p)) - p
    for axis, values in zip("xy", shift.T, strict=True):
        fits.PrimaryHDU(values.reshape(shape)).writeto(tmp_path / f"d{axis}.fits")
    told = {} if direction == FORWARD else {"direction": direction}
    prior = Prior.from_file([tmp_path / "dx.fits", tmp_path / "dy.fits"], degree=3, **told)
    assert_allclose(prior.mean, mean, rtol=0, atol=2e-5)
    assert prior.truncation < 2e-4


def test_units_change_nothing():
    plain = gsaoi_static(3)
    axis = models.Polynomial1D(1, c0=1 * u.pix, c1=1 * u.dimensionless_unscaled)
    surfaces = [
        models.Polynomial2D(
            3, **{f"c{i}_{j}": c[i, j] * u.arcsec / u.pix ** (i + j) for i in range(4) for j in range(4 - i)}
        )
        for c in gsaoi_polynomials(3)
    ]
    with_units = axis & axis | models.Mapping((0, 1, 0, 1)) | surfaces[0] & surfaces[1]
    options = {"shape": (2048, 2048), "direction": FORWARD}
    first, second = (Prior.from_model(model, **options) for model in (plain, with_units))
    assert_allclose(second.mean, first.mean, rtol=0, atol=1e-8)
    in_arcsec = lambda x, y: tuple(a * u.arcsec for a in plain(x, y))  # noqa: E731
    assert_allclose(Prior.from_model(in_arcsec, **options).mean, first.mean, rtol=0, atol=1e-8)


def test_models_that_end_on_the_sky():
    """A celestial rotation at the end of a model is undone by the tangent plane; bare angles would be sheared."""
    to_sky = models.Scale(1e-5) & models.Scale(1e-5) | models.Pix2Sky_TAN() | models.RotateNative2Celestial(5, 70, 180)
    pixels = models.Shift(-50) & models.Shift(-50)
    prior = Prior.from_model(pixels | to_sky, shape=(101, 101))
    assert np.abs(prior.mean).max() < 1e-8
    wcs = gwcs.WCS(
        [(cf.Frame2D(name="detector"), pixels | to_sky), (cf.CelestialFrame(reference_frame=ICRS(), name="sky"), None)]
    )
    with pytest.raises(InputError, match=r"the model \(gwcs\) does not state the size of the detector: give shape"):
        Prior.from_model(wcs)
    assert np.abs(Prior.from_model(wcs, shape=(101, 101)).mean).max() < 1e-8
    assert np.abs(Prior.from_model(to_sky, shape=(101, 101), origin=1).mean).max() < 1e-4


def test_our_own_wcs_comes_back(tmp_path):
    """From the gwcs of an exposure: the distortion that it was made of."""
    mean = np.zeros((2, 10))
    mean[:, 3:] = np.random.default_rng(1).normal(0, 0.3, (2, 7))
    sky = TangentPlane(0.0, 60.0, np.array([[-1e-5, 0, 0], [0, 1e-5, 0]]))
    wcs = exposure_wcs("a", similarity.identity(), Distortion(mean, (512, 512)), sky)
    tree = {"meta": {"wcs": wcs}}
    asdf.AsdfFile(tree, version="1.5.0").write_to(tmp_path / "a.asdf")
    prior = Prior.from_file(tmp_path / "a.asdf", degree=3)
    assert prior.source["frame"] == "undistorted"
    assert_allclose(prior.mean, mean, rtol=0, atol=2e-6)
    with io.BytesIO() as stream:
        asdf.AsdfFile(tree, version="1.5.0").write_to(stream)
        raw = np.frombuffer(stream.getvalue(), np.uint8)
    column = fits.Column(name="ASDF_METADATA", array=raw[None], format=f"{raw.size}B")
    table = fits.BinTableHDU.from_columns([column], name="ASDF")
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "a.fits")
    assert_allclose(Prior.from_file(tmp_path / "a.fits", degree=3).mean, prior.mean, rtol=0, atol=1e-12)


def test_choice_among_headers(tmp_path):
    """SCI before others, and any other when asked; headers as SCAMP writes them."""
    first, second = sip_header(), sip_header(dec=30.0, ctype="TPV")
    hdus = [fits.ImageHDU(np.zeros((256, 256), np.float32), h, name=n) for h, n in ((first, "ERR"), (second, "SCI"))]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(tmp_path / "m.fits")
    assert read_source(tmp_path / "m.fits").name.endswith("m.fits[2]")
    assert read_source(tmp_path / "m.fits", ext="ERR").kind == "FITS header, RA---TAN-SIP"
    assert read_source(tmp_path / "m.fits", ext=2).kind == "FITS header, RA---TPV"
    text = "".join(h.tostring(sep="\n", endcard=False, padding=False) + "\nEND     \n" for h in (first, second))
    (tmp_path / "m.head").write_text(text)
    assert read_source(tmp_path / "m.head", ext=1).kind == "FITS header, RA---TPV"
    with pytest.raises(InputError, match=r"m.head holds 2 headers: choose one with ext \(--ext\) 0 ... 1"):
        read_source(tmp_path / "m.head")


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_headers_of_scamp(tmp_path, encoding):
    """Whose comments have letters that FITS does not know, and whose TAN with PV is a TPV."""
    path = write_head(tmp_path / "a.head", encoding=encoding)
    prior = Prior.from_file(path, shape=(1024, 1024))

    def plane(x, y):
        return touching(to_sky(to_plane(x, y)), to_sky(to_plane(511.5, 511.5)))

    assert distance(prior, plane) < max(1e-6, 1.01 * prior.truncation) < 1e-3
    assert min(prior.rms) > 0.3
    plain = tmp_path / "b.head"
    plain.write_text(path.read_text(encoding).replace("é", "e"))
    assert_array_equal(Prior.from_file(plain, shape=(1024, 1024)).mean, prior.mean)
    assert main(["prior", str(path), "--shape", "1024", "1024", "--out", str(tmp_path / "p.asdf"), "--quiet"]) == 0
    assert_allclose(Prior.read(tmp_path / "p.asdf").mean, prior.mean)


def _three_heads(tmp_path):
    """Barrels of a camera that was pointed, turned, mirrored and refocused: as each states it, and their files."""
    poses = {"sky": (266.4, -28.9)}, {"cd": matrix(40)}, {"cd": matrix(200, 0.035001 / 3600, False)}
    return [
        write_head(tmp_path / f"{k}.head", barrel(strength), **pose)
        for k, (strength, pose) in enumerate(zip((120, 126, 123), poses, strict=True))
    ]


def test_several_headers_of_a_camera(tmp_path, capsys, recwarn):
    """Their mean, and what the next one may be off by: the scatter that the textbook has of a degree."""
    heads, shape = _three_heads(tmp_path), (1024, 1024)
    each = np.array([Prior.from_file(head, shape=shape, degree=3).mean for head in heads])
    degrees = np.add(*basis.orders(3))
    out = tmp_path / "prior.asdf"
    line = ["prior", *map(str, heads), "--shape", "1024", "1024", "--degree", "3", "--out", str(out)]
    assert main(line) == 0
    told, found = capsys.readouterr(), Prior.read(out)
    assert "mean of 3 sources; static_sigma is their scatter, below 0.001, below 0.001, 0.0" in told.out
    assert "the maps are the same to 0.001 px at degree 1, 2: one fit that they have in common, or none" in told.err
    assert_allclose(found.mean, each.mean(axis=0), rtol=0, atol=1e-7)
    assert found.shape == shape
    assert sorted(found.source["files"]) == ["0.head", "1.head", "2.head"]
    cubic = each[:, :, degrees == 3]
    scatter = np.sqrt(np.var(cubic, axis=0, ddof=1).mean())
    assert scatter > 0.005
    # with the error of the mean, and 0.001 px for that of a header
    assert_allclose(found.static_sigma[:, degrees == 3], scatter * np.sqrt(4 / 3), rtol=0.02)
    assert np.all(found.static_sigma[:, degrees == 2] < 1e-3)
    of_python = combine_nights([Prior.from_file(head, shape=shape, degree=3) for head in heads]).prior()
    assert_array_equal(of_python.static_sigma, found.static_sigma)
    recwarn.clear()
    assert main([*line, "--static-sigma", "0.2", "--sigma", "0.1", "--overwrite", "--json"]) == 0
    told = capsys.readouterr()
    assert "the same to" not in told.err
    assert json.loads(told.out)["source"]["nights"] == 3
    assert set(Prior.read(out).static_sigma.ravel()) == {0.2}
    assert set(Prior.read(out).sigma.ravel()) == {0.1}


def test_several_images_with_a_distortion_are_no_maps(tmp_path):
    for k, power in enumerate((1e-4, 1.2e-4)):
        header = sip_header()
        header["A_2_0"] = power
        fits.PrimaryHDU(np.zeros((256, 256)), header).writeto(tmp_path / f"{k}.fits")
    names = [str(tmp_path / f"{k}.fits") for k in (0, 1)]
    assert main(["prior", *names, "--out", str(tmp_path / "p.asdf"), "--degree", "3", "--quiet"]) == 0
    assert Prior.read(tmp_path / "p.asdf").static_sigma.max() > 0.05
    with pytest.raises(InputError, match=r"0.fits is no FITS map of shifts.* several headers .*combine_nights\(\["):
        Prior.from_file(names)


@pytest.mark.parametrize(
    ("names", "more", "message"),
    [
        (["0.head", "0.head"], [], "a source stands twice on the command line"),
        (["0.head", "absent.head"], ["--shape", "99", "99"], "absent.head: no such file"),
        (["0.head", "1.head"], [], r"0.head \(FITS header, RA---TAN\) does not state the size .* --shape NY NX"),
        (["0.head", "two.head"], ["--shape", "9", "9"], r"two.head holds 2 headers: choose one with ext"),
        (
            ["0.head", "folder"],
            [],
            "folder is a solution, or of nights: legdistort nights combines",
        ),
    ],
)
def test_headers_that_do_not_go_together(tmp_path, capsys, names, more, message):
    _three_heads(tmp_path)
    (tmp_path / "folder").mkdir()
    write_head(tmp_path / "two.head", blocks=2)
    line = ["prior", *(str(tmp_path / name) for name in names), "--out", str(tmp_path / "p.asdf")]
    assert main([*line, *more]) == 1
    assert re.search(message, capsys.readouterr().err)


# --- priors in files, and the command -----------------------------------------------------------------------------


def test_written_and_read(tmp_path):
    prior = Prior.from_model(gsaoi_static(2), shape=(2048, 2048), direction=FORWARD, sigma=0.5, static_sigma=0.1)
    assert prior.write(tmp_path / "p.asdf") == tmp_path / "p.asdf"
    for again in (Prior.read(tmp_path / "p.asdf"), Prior.from_file(tmp_path / "p.asdf", shape=(2048, 2048))):
        for key in ("mean", "sigma", "static_sigma", "plane"):
            assert np.array_equal(getattr(again, key), getattr(prior, key)), key
        assert (again.shape, again.truncation, again.source) == (prior.shape, prior.truncation, prior.source)
    with asdf.open(tmp_path / "p.asdf") as file:
        assert file.version_string == "1.5.0"
    Prior(np.zeros((2, 3)), source="a guess").write(tmp_path / "q.asdf")
    assert Prior.read(tmp_path / "q.asdf").source == "a guess"
    wider = Prior.from_file(tmp_path / "p.asdf", sigma=2)
    assert_allclose(wider.sigma, 2)
    assert_allclose(wider.static_sigma, 0.1)
    with pytest.raises(InputError, match=r"q\.asdf exists already"):
        prior.write(tmp_path / "q.asdf")
    with pytest.raises(InputError, match=r"is a prior already: degree \(--degree\) cannot be chosen any more"):
        Prior.from_file(tmp_path / "p.asdf", degree=3)
    with pytest.raises(InputError, match="is a prior already: shape"):
        Prior.from_file(tmp_path / "p.asdf", shape=(2048, 2047))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"layout": 2}, "has layout 2, this version reads 1; update legdistort"),
        ({"layout": np.zeros(3)}, "is damaged: its layout is an array, not a number"),
        ({"coefficients": np.zeros((2, 7))}, "damaged: n = 7 is not a number of modes"),
        ({"coefficients": np.full((2, 3), np.nan)}, r"damaged: .*coefficients\[0, 0\]: nan; it should be finite"),
        ({"coefficients": np.zeros((2, 561))}, "damaged: degree must be an integer from 0 to 30"),
        ({"coefficients": [[0.0]]}, "damaged: entry legdistort_prior.coefficients"),
        ({"sigma": np.full((2, 3), -1.0)}, r"damaged: .*sigma\[0, 0\]: -1.0; it should be .*from 0"),
        ({"shape": [5, "six"]}, "damaged: entry legdistort_prior.shape"),
        ({"truncation_px": -1.0}, "damaged: entry legdistort_prior.truncation_px"),
        ({"plane": np.ones((2, 3))}, "damaged: .*plane: a map that has no inverse; it should be one that has"),
        ({"plane": np.array([[1.0, 0, 0], [0, 2.0, 0]])}, "damaged: plane is not a similarity"),
        ({"source": {"files": {"a": "b"}}}, "damaged: entry legdistort_prior.source"),
    ],
)
def test_damaged_priors(tmp_path, changes, message):
    Prior(np.zeros((2, 3)), shape=(10, 20), plane=similarity.identity()).write(tmp_path / "p.asdf")
    with asdf.open(tmp_path / "p.asdf", memmap=False, lazy_load=False) as file:
        tree = dict(file["legdistort_prior"])
    asdf.AsdfFile({"legdistort_prior": tree | changes}).write_to(tmp_path / "p.asdf")
    with pytest.raises(InputError, match=message):
        Prior.read(tmp_path / "p.asdf")
    with pytest.raises(InputError, match="holds no legdistort solution"):
        Solution.read(tmp_path / "p.asdf")


def test_command(tmp_path, nirc2, capsys):
    out = tmp_path / "prior.asdf"
    assert main(["prior", *map(str, nirc2), "--out", str(out), "--degree", "4", "--sigma", "0.2", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    prior = Prior.read(out)
    assert (printed["degree"], printed["truncation_px"]) == (4, prior.truncation)
    assert printed["rms_px"] == prior.rms.tolist()
    assert set(prior.source["files"]) == {path.name for path in nirc2}
    assert main(["prior", "gsaoi-3", "--out", str(out), "--overwrite"]) == 0
    assert capsys.readouterr().out.startswith("degree 5, truncation error 1.")
    assert main(["prior", "gsaoi-3", "--out", str(out), "--frame", "sky", "--overwrite"]) == 1
    assert "gsaoi-3 (astropy model) has no frame; leave --frame out" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_prior_of_another_field(tmp_path, capsys):
    """A solution serves as prior, by itself or from a prior.asdf, in the command as in Python."""
    sim = simulate_matches(n_exposures=4, n_stars=30, degree=2, seed=1)
    solution = solve(sim.matches, degree=2)
    solution.write(tmp_path / "solution.asdf")
    prior = Prior.from_file(tmp_path / "solution.asdf", sigma=0.5)
    assert_allclose(prior.mean, solution.coefficients.mean(axis=0))
    assert prior.shape == solution.estimate.shapes[solution.names[0]]
    assert list(prior.source["files"]) == ["solution.asdf"]
    prior.write(tmp_path / "prior.asdf")
    table = sim.matches.table.copy()
    table.meta = sim.matches.to_meta()
    table.write(tmp_path / "matched.ecsv", format="ascii.ecsv")
    command = ["solve", str(tmp_path / "matched.ecsv"), "--degree", "2", "--quiet", "--prior"]
    assert main([*command, str(tmp_path / "prior.asdf"), "--out", str(tmp_path / "out")]) == 0
    again = Solution.read(tmp_path / "out" / "solution.asdf")
    assert_allclose(again.estimate.prior_mean, [prior.mean] * 4)
    assert main([*command, "gsaoi-9", "--out", str(tmp_path / "no")]) == 1
    assert "gsaoi-9: no such file; give a file, gsaoi-1 ..." in capsys.readouterr().err


def test_a_model_in_several_places_is_one(tmp_path):
    """Aliases of YAML, which the walk through the tree follows."""
    model = gsaoi_static(1)
    part = {"wcs": model}
    asdf.AsdfFile({"first": part, "second": [part, model]}).write_to(tmp_path / "d.asdf")
    assert b"*id" in (tmp_path / "d.asdf").read_bytes()
    options = {"direction": FORWARD, "shape": (2048, 2048)}
    found = Prior.from_file(tmp_path / "d.asdf", **options)
    assert_array_equal(found.mean, Prior.from_model(model, **options).mean)
    for ext in ("first.wcs", "second.0.wcs", "second.1"):
        assert_array_equal(Prior.from_file(tmp_path / "d.asdf", ext=ext, **options).mean, found.mean)


# --- refusals -------------------------------------------------------------------------------------------------------


def files(folder):
    """One file of every kind that is refused."""
    good, flat = sip_header(), np.zeros((20, 30))
    nan, fold = flat.copy(), flat.copy()
    nan[4, 7] = np.nan
    fold[:, 10] = 3
    plain = sip_header(ctype="TAN")
    high = sip_header()
    high["A_ORDER"] = 5000
    images = {"flat": flat, "small": flat[:10], "nan": nan, "fold": fold}
    for name, data in images.items():
        fits.PrimaryHDU(data).writeto(folder / f"{name}.fits")
    for name, header in {"good": good, "plain": plain, "high": high}.items():
        fits.PrimaryHDU(np.zeros((256, 256), np.float32), header).writeto(folder / f"{name}.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns([fits.Column("a", "D", array=[1.0])])]).writeto(
        folder / "table.fits"
    )
    (folder / "cut.fits").write_bytes((folder / "good.fits").read_bytes()[:1000])
    (folder / "cut.asdf").write_bytes(b"#ASDF 1.0.0\n#ASDF_STANDARD 1.5.0\n%YAML 1.1\n---\nwcs: !core/x")
    (folder / "binary").write_bytes(bytes(range(256)))
    (folder / "text.txt").write_text("x y\n1 2\n")
    (folder / "short.txt").write_text("poly 3\n1 2 3\n")
    (folder / "words.txt").write_text("cubic\n" + "1 " * 19 + "one\n")
    bare = models.Polynomial2D(1) & models.Polynomial2D(1)
    bare = models.Mapping((0, 1, 0, 1)) | bare
    trees = {
        "empty": {"a": 1},
        "bare": {"model": bare},
        "two": {"a": bare, "b": {"c": bare.copy()}},
        "one": {"model": models.Shift(1)},
    }
    for name, tree in trees.items():
        asdf.AsdfFile(tree).write_to(folder / f"{name}.asdf")


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    files(folder)
    return folder


@pytest.mark.parametrize(
    ("where", "options", "message"),
    [
        ("absent.fits", {}, r"absent\.fits: no such file; give a file, gsaoi-1 \.\.\. gsaoi-4, or siaf:"),
        (".", {}, "not a file"),
        ("binary", {}, "binary is neither FITS, ASDF, the text of a FITS header nor a file of Drizzle coefficients"),
        ("text.txt", {}, "text.txt is neither FITS, ASDF"),
        ("short.txt", {}, r"short.txt: not a file of Drizzle coefficients, which is 'poly N'"),
        ("words.txt", {}, "words.txt: not a file of Drizzle coefficients"),
        ("cut.fits", {}, "cut.fits: cannot be read as FITS|cut.fits.* no "),
        ("cut.asdf", {}, "cut.asdf is not a readable ASDF file"),
        ("flat.fits", {}, r"flat.fits\[0\] has no celestial WCS"),
        ("table.fits", {}, r"table.fits\[0\] has no celestial WCS"),
        ("plain.fits", {}, r"plain.fits\[0\] has no distortion \(SIP, TPV or other\)"),
        ("high.fits", {}, r"high.fits\[0\]: A_ORDER = 5000; SIP polynomials have orders from 0 to 9"),
        ("good.fits", {"ext": 3}, "good.fits: no extension 3; it has 0 PRIMARY"),
        (
            "good.fits",
            {"frame": "v2v3"},
            r"good.fits\[0\] \(FITS header, RA---TAN-SIP\) has no frame; leave --frame out",
        ),
        ("good.fits", {"direction": BACKWARD}, f"has direction '{FORWARD}', not '{BACKWARD}'; leave direction"),
        ("good.fits", {"shape": (256, 255)}, r"has shape \(256, 256\), not \(256, 255\)"),
        ("good.fits", {"origin": 1}, "has origin 0, not 1"),
        ("good.fits", {"shape": (256,)}, r"shape must be \(ny, nx\) in pixels"),
        ("empty.asdf", {}, "empty.asdf holds neither a gwcs nor a distortion model"),
        ("bare.asdf", {"shape": (9, 9)}, r"bare.asdf \(astropy model\) does not state what it does: give direction"),
        ("bare.asdf", {"direction": FORWARD}, "does not state the size of the detector"),
        ("bare.asdf", {"direction": FORWARD, "shape": (9, 9)}, "cannot be inverted over the detector: it folds"),
        ("bare.asdf", {"ext": "meta.wcs"}, "bare.asdf: no gwcs or model at 'meta.wcs'; it has model"),
        ("two.asdf", {}, r"two.asdf holds several distortions: (a, b.c|b.c, a); choose one with ext"),
        ("one.asdf", {}, "one.asdf has 1 inputs and 1 outputs"),
        ("gsaoi-5", {}, "gsaoi-5: no such file"),
        ("siaf:NIRCam", {}, "not of the form siaf:INSTRUMENT/APERTURE"),
        (["flat.fits", "small.fits"], {}, r"shapes \(20, 30\) \(x\) and \(10, 30\) \(y\); the maps must be"),
        (["flat.fits", "nan.fits"], {}, r"the y map has 1 values that are not finite, the first at pixel x 7, y 4"),
        (["fold.fits", "flat.fits"], {}, r"fold.fits.* folds, or has no width, near pixel \[\d+.0, 0.0\]"),
        (
            ["flat.fits", "text.txt"],
            {},
            r"text.txt is no FITS map of shifts, of which two \(x, then y\) are one source",
        ),
        (["flat.fits", "flat.fits"], {"ext": "SCI"}, "flat.fits: no extension 'SCI'"),
        (["flat.fits"] * 3, {}, r"two maps \(x, then y\), perhaps with two of their errors \(x, then y\); got 3"),
        (["m_y.fits", "m_x.fits"], {}, "m_x.fits: the map of the shifts in x comes first"),
    ],
)
def test_refusals(bad, where, options, message):
    named = [f"{bad}/{name}" for name in where] if isinstance(where, list) else f"{bad}/{where}"
    if isinstance(where, str) and (where.startswith(("gsaoi", "siaf"))):
        named = where
    with pytest.raises(InputError, match=message):
        Prior.from_file(named, **options)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("gsaoi", "the model must be a model, a WCS, an aperture or a function, got str"),
        (models.Polynomial2D(2), "the model has 2 inputs and 1 outputs; a distortion has two of each"),
    ],
)
def test_objects_that_are_refused(model, message):
    with pytest.raises(InputError, match=message):
        Prior.from_model(model, shape=(10, 10), direction=FORWARD)


numbers = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False, width=32),
    st.integers(-20, 20),
    st.sampled_from([0.0, 1.0, 1e-5, 1e300]),
)
keywords = st.sampled_from(
    [
        "NAXIS",
        "NAXIS1",
        "NAXIS2",
        "CRPIX1",
        "CRVAL1",
        "CRVAL2",
        "CD1_1",
        "CD1_2",
        "CD2_2",
        "CDELT1",
        "A_ORDER",
        "B_ORDER",
    ]
    + ["A_2_0", "B_0_3", "A_11_0", "AP_ORDER", "PV1_1", "PV2_7", "PV1_40", "LONPOLE", "LATPOLE", "WCSAXES", "CTYPE1"]
    + ["CTYPE2", "CUNIT1", "CPDIS1", "DP1", "D2IMDIS2", "IMAGEW", "EQUINOX"]
)
words = st.sampled_from(
    ["RA---TAN", "DEC--TPV", "RA---ZPN", "GLON-TAN", "Lookup", "", "deg", "arcsec", "FREQ", "DEC--TAN-SIP"]
)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(
    st.dictionaries(keywords, st.one_of(numbers, words), max_size=8), st.sampled_from(["TAN-SIP", "TPV"]), st.booleans()
)
def test_headers_of_any_kind(tmp_path_factory, changes, ctype, as_text):
    """A prior, or a sentence; never anything else."""
    path = tmp_path_factory.mktemp("fuzz") / "f.head"
    header = sip_header(ctype=ctype, n=32)
    header.update(changes)
    if as_text:
        path.write_text(header.tostring(sep="\n", padding=False))
    else:
        path.write_bytes(header.tostring(endcard=True, padding=True).encode())
    _survive(path)


leaves = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**40), 2**40), st.floats(), st.text(max_size=8), st.just(np.zeros(3)),
    st.sampled_from([models.Shift(1), models.Identity(2), models.Scale(0) & models.Scale(1), models.Pix2Sky_TAN()]),
)  # fmt: skip
names = st.sampled_from(
    ["meta", "wcs", "model", "roman", "legdistort", "legdistort_prior", "layout", "reftype", "source"]
)
trees = st.recursive(
    leaves, lambda inner: st.one_of(st.dictionaries(names, inner, max_size=4), st.lists(inner, max_size=3))
)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(st.dictionaries(names, trees, max_size=4), st.integers(0, 10**6), st.binary(max_size=3))
def test_trees_of_any_kind(tmp_path_factory, tree, place, damage):
    path = tmp_path_factory.mktemp("fuzz") / "f.asdf"
    asdf.AsdfFile(tree).write_to(path)
    _survive(path)
    content = bytearray(path.read_bytes())
    content[place % len(content) : place % len(content) + len(damage)] = damage
    path.write_bytes(content)
    _survive(path)


def _survive(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AssumptionWarning)
        try:
            prior = Prior.from_file(path, shape=(32, 32), degree=2, direction=FORWARD)
        except LegdistortError:
            return
    assert np.all(np.isfinite(prior.mean))
