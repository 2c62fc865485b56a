"""FITS headers: the exact chain, written here a second time, against what astropy.wcs, AST and SWarp read."""

import dataclasses
import shutil
import subprocess

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from sky_chains import SHAPE, detector, largest, pixels_of, sky_of

from legdistort.exceptions import ExportError, InputError
from legdistort.geometry import similarity
from legdistort.simulation.truth import mode_orders
from legdistort.wcs.fits_headers import header_error


def chain(solution, name):
    """What `header_error` compares a header with."""
    return solution.poses[name], solution[name].distortion, solution.sky


PLACES = {
    "plain": {},
    "mirror": {"parity": 1, "turn": -170.0},
    "pole": {"lat": 89.9, "lon": 200.0},
    "on the pole": {"lat": -90.0, "parity": 1},
    "ra 0": {"lon": 0.0, "lat": 20.0, "turn": 77.0},
    "tangent near a corner": {"shift": (400, -250)},
    "far off": {"shift": (6000, -9000), "lat": 70.0},
}
FLOOR = 2e-8  # degrees as floating-point numbers carry no more at 0.02 arcsec a pixel


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_sip_in_astropy(geometry, place):
    check_sip(geometry(3, 20, **place), 1e-3)


@pytest.mark.parametrize(
    ("degree", "peak", "max_error"), [(3, 5, 1e-3), (3, 100, 1e-3), (5, 5, 1e-3), (5, 20, 1e-3), (5, 100, 0.1)]
)
def test_sip_of_weak_and_strong_distortions(geometry, degree, peak, max_error):
    check_sip(geometry(degree, peak, lat=89.9, shape=(1700, 2048)), max_error)


def check_sip(solution, max_error):
    header = solution["a"].header(max_error=max_error)
    p, ra, dec = detector(solution, "a")
    wcs = WCS(header)
    assert header["SIPMXERR"] <= max_error
    assert header["CTYPE1"] == "RA---TAN-SIP"
    forward = largest(pixels_of(solution, "a", *wcs.all_pix2world(p, 0).T), p)
    assert forward <= header["SIPMXERR"]
    assert forward > 0.5 * header["SIPMXERR"]  # as stated, not a safe word
    # astropy's iteration inverts A and B; wcs.sip_foc2pix reads AP and BP
    assert largest(wcs.all_world2pix(np.column_stack([ra, dec]), 0, tolerance=1e-7), p) < 1.2 * header["SIPMXERR"]
    flat = wcs.wcs_world2pix(np.column_stack([ra, dec]), 1) - wcs.wcs.crpix
    assert largest(wcs.sip_foc2pix(flat, 1) - 1, p) <= header["SIPIVERR"] + FLOOR
    assert header["SIPIVERR"] < 1e-6


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_tpv_in_astropy(geometry, place):
    check_tpv(geometry(3, 20, **place), 1e-3)


@pytest.mark.parametrize(
    ("degree", "peak", "max_error"), [(3, 5, 1e-3), (3, 100, 1e-2), (5, 5, 1e-3), (5, 20, 2e-2), (5, 100, 0.5)]
)
def test_tpv_of_weak_and_strong_distortions(geometry, degree, peak, max_error):
    check_tpv(geometry(degree, peak, lon=0.0, shape=(1700, 2048)), max_error)


def check_tpv(solution, max_error):
    header = solution["a"].header(kind="tpv", max_error=max_error)
    p, ra, dec = detector(solution, "a")
    wcs = WCS(header)
    assert header["CTYPE2"] == "DEC--TPV"
    assert not {"PV1_3", "PV1_11", "PV1_23", "PV2_3", "PV2_11", "PV2_23"} & set(header)
    forward = largest(pixels_of(solution, "a", *wcs.all_pix2world(p, 0).T), p)
    assert 0.5 * header["TPVMXERR"] < forward <= header["TPVMXERR"]
    assert largest(wcs.all_world2pix(np.column_stack([ra, dec]), 0), p) <= header["TPVIVERR"] <= max_error


@pytest.mark.parametrize("kind", ["sip", "tpv"])
@pytest.mark.parametrize("place", ["mirror", "pole", "ra 0", "far off"])
def test_ast_reads_the_same_sky(geometry, kind, place):
    """The library behind DS9 and GAIA."""
    ast = pytest.importorskip("starlink.Ast", reason="starlink-pyast is not installed")
    solution = geometry(3, 20, **PLACES[place])
    header = solution["a"].header(kind=kind)
    channel = ast.FitsChan()
    for card in header.cards:
        channel.putfits(str(card), False)
    channel.clear("Card")
    frames = channel.read()
    p, ra, dec = detector(solution, "a")
    found = np.degrees(frames.tran((p + 1).T))
    assert largest(pixels_of(solution, "a", *found), p) <= header[f"{kind.upper()}MXERR"] + FLOOR
    # how AST goes back is its own affair: with SIP it can be less exact than forwards
    back = frames.tran(np.radians([ra, dec]), False).T - 1
    assert largest(back, p) < 2e-3


def test_ap_bp_are_the_distortion_itself(geometry):
    """With the tangent point on the detector: the degree of the solution, no error beyond that of degrees."""
    for degree, peak in ((2, 20), (3, 20), (5, 20)):
        header = geometry(degree, peak, shift=(100, 60))["a"].header()
        assert header["AP_ORDER"] == header["BP_ORDER"] == degree
        assert header["SIPIVERR"] < FLOOR
        assert (header["CRVAL1"], header["CRVAL2"]) == (10.0, -30.0)


def test_reference_point_is_on_the_detector(geometry):
    header = geometry(shift=(6000, -9000))["a"].header()
    assert (header["CRPIX1"], header["CRPIX2"]) == (550.5, 350.5)
    # programs that know no distortion see the linear part: it belongs to this detector
    for key in ("A", "B", "AP", "BP"):
        assert f"{key}_0_0" not in header
    assert "A_1_0" not in header


def test_lowest_degree_that_meets_the_error(geometry):
    solution = geometry(3, 20)
    orders, errors = [], []
    for max_error in (1, 1e-2, 1e-3, 1e-5):
        header = solution["a"].header(max_error=max_error)
        orders.append(header["A_ORDER"])
        errors.append(header["SIPMXERR"])
        assert header["SIPMXERR"] <= max_error
    assert orders == sorted(orders)
    assert len(set(orders)) == 4
    # a little less than a degree reaches asks for another one
    assert solution["a"].header(max_error=0.9 * errors[2])["A_ORDER"] == orders[2] + 1


def test_better_than_taylor_series_and_least_squares(geometry):
    """Lawson's fit spreads the error: the series about the reference point of the same degree is ten times worse.

    Plain least squares on Chebyshev nodes misses more in the corners, too.
    """
    solution = geometry(3, 20)
    header = solution["a"].header()
    degree, middle = header["A_ORDER"], np.array([header["CRPIX1"], header["CRPIX2"]]) - 1
    orders = np.array(mode_orders(degree))

    def terms(p):
        return np.prod(((p - middle) / 1000)[:, None] ** orders, axis=2)

    def undistorted(p):
        return similarity.apply(solution.poses["a"], solution["a"].correct(p))

    near = middle + np.random.default_rng(0).uniform(-40, 40, (400, 2))
    taylor = np.linalg.lstsq(terms(near), undistorted(near), rcond=None)[0]
    p, _, _ = detector(solution, "a")
    assert largest(terms(p) @ taylor, undistorted(p)) > 10 * header["SIPMXERR"]
    t = (1 - np.cos(np.pi * (np.arange(30) + 0.5) / 30)) / 2
    nodes = np.stack(np.meshgrid(t * SHAPE[1], t * SHAPE[0]), axis=-1).reshape(-1, 2) - 0.5
    chebyshev = np.linalg.lstsq(terms(nodes), undistorted(nodes), rcond=None)[0]
    assert largest(terms(p) @ chebyshev, undistorted(p)) > 1.5 * header["SIPMXERR"]


@pytest.mark.parametrize(("kind", "top"), [("sip", 9), ("tpv", 7)])
def test_too_strong_a_distortion_is_refused_with_the_best_error(geometry, kind, top):
    solution = geometry(5, 100)
    with pytest.raises(
        ExportError, match=rf"a: no {kind.upper()} header .* of degree {top}, has [\d.]+ px: .* ASDF"
    ) as e:
        solution["a"].header(kind=kind)
    best = float(str(e.value).split("has ")[1].split()[0])
    assert solution["a"].header(kind=kind, max_error=best)[f"{kind.upper()}MXERR"] <= best


def test_errors_of_foreign_headers(geometry):
    solution = geometry(3, 20, turn=0)
    plain = solution["a"].header()
    for key in [key for key in plain if key.split("_")[0] in ("A", "B", "AP", "BP")]:
        del plain[key]
    plain["CTYPE1"], plain["CTYPE2"] = "RA---TAN", "DEC--TAN"
    p, ra, dec = detector(solution, "a")
    forward, inverse = header_error(plain, *chain(solution, "a"))
    assert forward == pytest.approx(largest(pixels_of(solution, "a", *WCS(plain).all_pix2world(p, 0).T), p), rel=0.02)
    assert inverse == pytest.approx(largest(WCS(plain).all_world2pix(np.column_stack([ra, dec]), 0), p), rel=0.02)
    # A and B without AP and BP: by iteration; and another frame of the sky
    sip = solution["a"].header()
    stated = sip["SIPMXERR"]
    for key in [key for key in sip if key.startswith(("AP_", "BP_"))]:
        del sip[key]
    assert max(header_error(sip, *chain(solution, "a"))) <= 1.2 * stated
    sip["RADESYS"] = "FK5"
    assert 0.5 < header_error(sip, *chain(solution, "a"))[0] < 2  # FK5 and ICRS differ by some 0.02 arcsec, one pixel


def test_bad_input(geometry):
    solution = geometry()
    with pytest.raises(InputError, match="kind must be one of 'sip', 'tpv', got 'tnx'"):
        solution["a"].header(kind="tnx")
    for wrong in (0, -1, np.nan):
        with pytest.raises(InputError, match="max_error must be a positive number of pixels"):
            solution["a"].header(max_error=wrong)
    with pytest.raises(InputError, match="no exposure 'b' in the solution"):
        solution["b"].header()
    blind = dataclasses.replace(solution, sky=None)
    for call in (lambda: blind["a"].header(), lambda: header_error(fits.Header(), *chain(blind, "a"))):
        with pytest.raises(InputError, match=r"does not know the sky.*headers have a WCS, or.*reference catalogue"):
            call()
    with pytest.raises(InputError, match="compared with exposure a has no celestial WCS"):
        header_error(fits.Header(), *chain(solution, "a"))


def test_swarp_puts_stars_where_tpv_says(geometry, tmp_path):
    swarp = shutil.which("swarp") or shutil.which("SWarp")
    if swarp is None:
        pytest.skip("SWarp is not installed")
    shape = (300, 380)
    solution = geometry(3, 8, shape=shape, turn=0)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(30, 350, 7), np.linspace(30, 270, 6)))
    rng = np.random.default_rng(3)
    p = np.column_stack([x, y]) + rng.uniform(-0.5, 0.5, (len(x), 2))
    gx, gy = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    image = sum(1e4 * np.exp(-((gx - a) ** 2 + (gy - b) ** 2) / (2 * 2.0**2)) for a, b in p)
    fits.writeto(tmp_path / "frame.fits", image.astype("float32"), solution["a"].header(kind="tpv"))
    options = {"SUBTRACT_BACK": "N", "RESAMPLING_TYPE": "LANCZOS4", "WRITE_XML": "N", "VERBOSE_TYPE": "QUIET",
               "CENTER_TYPE": "MANUAL", "CENTER": "10.0,-30.0", "PIXELSCALE_TYPE": "MANUAL", "PIXEL_SCALE": "0.02",
               "IMAGE_SIZE": "420,340", "CELESTIAL_TYPE": "EQUATORIAL", "NTHREADS": "1"}  # fmt: skip
    command = [swarp, "frame.fits", *(word for key, value in options.items() for word in (f"-{key}", value))]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    with fits.open(tmp_path / "coadd.fits") as hdus:
        data, wcs = hdus[0].data.astype(float), WCS(hdus[0].header)
    pose = solution.poses["a"]
    ra, dec = sky_of(solution, "a", similarity.apply(pose, solution["a"].correct(p)))
    offsets = []
    for a, b in wcs.all_world2pix(np.column_stack([ra, dec]), 0):
        i, j = round(a), round(b)
        box = data[j - 8 : j + 9, i - 8 : i + 9]
        u, v = np.meshgrid(np.arange(i - 8, i + 9), np.arange(j - 8, j + 9))
        offsets.append([(box * u).sum() / box.sum() - a, (box * v).sum() / box.sum() - b])
    offsets = np.array(offsets)
    # curvature of the distortion under the star, and interpolation; read without distortion: up to 8 px
    assert np.abs(offsets.mean(axis=0)).max() < 5e-3
    assert offsets.std() < 1.5e-2
