"""Every import and export against an independent reader: ``python tests/benchmarks/exchange_matrix.py [FUNCTION...]``.

A row function yields `Row` objects: the largest distance [pix] between what comes in or goes out here and what the
reader named says, over the whole detector with edges and corners, and the truncation error of a prior at its degree (of
a header, the degree it took). It raises `Skip` with the reason when data or a reader are absent. Data:
``LEGDISTORT_DATA`` or ``../shared/data``.
"""

import contextlib
import importlib
import io
import json
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import asdf
import gwcs
import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits, votable
from astropy.wcs import WCS, FITSFixedWarning
from numpy.polynomial import polynomial

from legdistort.exceptions import ExportError, LegdistortWarning
from legdistort.geometry import similarity
from legdistort.geometry.distortion import Distortion
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.priors.from_files import read_source
from legdistort.priors.prior import Prior
from legdistort.wcs.attachment import attach
from legdistort.wcs.exposure_wcs import exposure_wcs
from legdistort.wcs.refinement import refine

sys.path.insert(0, str(Path(__file__).parents[1]))
import sky_chains
from conftest import data_folder

COLUMNS = "{:40s} {:20s} {:>9s} {:>7s} {:>10s}"

#: Degrees, in extended precision.
ARCSEC = np.longdouble(1) / 3600


@dataclass
class Row:
    """One line of the table; errors in pixels, NaN and None where they mean nothing."""

    what: str
    reader: str
    error: float
    degree: int | None = None
    truncation: float = np.nan

    def __str__(self):
        degree = "" if self.degree is None else str(self.degree)
        truncation = "" if np.isnan(self.truncation) else f"{self.truncation:.1e}"
        return COLUMNS.format(self.what, self.reader, f"{self.error:.1e}", degree, truncation)


class Skip(Exception):
    """A row that cannot be made here, with the reason."""


# -- pieces


def data(*parts):
    """Path of real data."""
    if data_folder() is None:
        raise Skip("real data absent: set LEGDISTORT_DATA")
    return data_folder().joinpath(*parts)


def grid(shape, n=60):
    """Pixels x, y over the detector, edges and corners included."""
    ny, nx = shape
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, n), np.linspace(-0.5, ny - 0.5, n))
    return x.ravel(), y.ravel()


def on_plane(sky, centre):
    """Gnomonic projection [deg] of (lon, lat) [deg] about a centre, by the textbook in extended precision."""
    lon, lat, lon0, lat0 = (np.radians(np.asarray(a, dtype=np.longdouble)) for a in (*sky, *centre))
    ahead = np.sin(lat0) * np.sin(lat) + np.cos(lat0) * np.cos(lat) * np.cos(lon - lon0)
    up = np.cos(lat0) * np.sin(lat) - np.sin(lat0) * np.cos(lat) * np.cos(lon - lon0)
    return np.degrees([np.cos(lat) * np.sin(lon - lon0) / ahead, up / ahead])


def imported(what, reader, where, plane, *, degree=5, **options):
    """Row of a source; ``plane(x, y)`` is what the reader says, with 0-based pixels, on the plane of the source."""
    prior = Prior.from_file(where, degree=degree, **options)
    told = {key: value for key, value in options.items() if key not in ("ext", "frame")}
    source = read_source(where, ext=options.get("ext"), frame=options.get("frame")).stated(**told)
    x, y = grid(source.shape)
    off = np.array(source.on_plane()(x + source.origin, y + source.origin)) - plane(x, y)
    scale = similarity.describe(prior.plane)["scale"]  # pixels for a unit of the plane
    return Row(what, reader, float(scale * np.hypot(*off).max()), degree, prior.truncation)


def imported_sky(what, reader, where, sky, *, shape, unit=1.0, **options):
    """The same where the reader ends in longitude and latitude, of so many degrees a unit."""
    middle = [np.array([(n - 1) / 2]) for n in shape[::-1]]
    unit = np.longdouble(unit)
    centre = [unit * np.ravel(a)[0] for a in sky(*middle)]

    def plane(x, y):
        return on_plane([unit * np.asarray(a) for a in sky(x, y)], centre) / unit

    return imported(what, reader, where, plane, shape=shape, **options)


def by_ast(header):
    """Pixel -> sky [deg] of a FITS header by AST, the library of DS9."""
    try:
        from starlink import Ast
    except ImportError:
        raise Skip("starlink-pyast is not installed") from None
    frames = Ast.FitsChan([card.image for card in header.cards]).read()

    def sky(x, y):
        return np.degrees(frames.tran([np.asarray(x) + 1, np.asarray(y) + 1]))

    return sky


def header(ctype, n=1024):
    """A header with some 20 px of distortion, near RA = 0."""
    out = fits.Header({"NAXIS": 2, "NAXIS1": n, "NAXIS2": n, "CTYPE1": f"RA---{ctype}", "CTYPE2": f"DEC--{ctype}"})
    out.update({"CRPIX1": n / 2, "CRPIX2": n / 2, "CRVAL1": 0.001, "CRVAL2": 40.0})
    out.update({"CUNIT1": "deg", "CUNIT2": "deg", "CD1_1": -3e-5, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 3e-5})
    if ctype == "TPV":
        out.update({"PV1_0": 0.0, "PV1_1": 1.0, "PV1_4": 1.5, "PV1_7": 90.0})
        out.update({"PV2_0": 0.0, "PV2_1": 1.0, "PV2_4": -2.0, "PV2_10": 60.0})
    else:
        out.update({"A_ORDER": 3, "B_ORDER": 3, "A_2_0": 4e-5, "A_1_2": 8e-8, "B_1_1": -5e-5, "B_0_3": 9e-8})
    return out


# -- rows


def astropy_models():
    """GSAOI, against powers in plain numpy."""
    table = json.loads(data("static_distortion", "gsaoi_dragons", "gsaoi_static_distortion.json").read_text())
    for detector in range(4):
        parts = [part["parameters"][detector] for part in table["forward"]]

        def plane(x, y, parts=parts):
            x, y = x + 1, y + 1
            return [
                sum(c * x ** int(k[1]) * y ** int(k[3]) for p in parts for k, c in p[axis].items()) for axis in "xy"
            ]

        yield imported(f"astropy model, GSAOI detector {detector + 1}", "numpy", f"gsaoi-{detector + 1}", plane)


def gwcs_files():
    """Every frame that a file of JWST and Roman can end in, against gwcs."""
    shapes = {"nircamwcs": (2048, 2048), "miriwcs": (1024, 1032), "roman_wcs": (5000, 5000)}
    for name, shape in shapes.items():
        path = data("gwcs_interop", f"{name}.asdf")
        with asdf.open(path, memmap=False, lazy_load=False) as file:
            wcs = file["roman"]["wcs"] if "roman" in file.tree else file["wcs"]
        wcs.bounding_box = None
        for frame in wcs.available_frames[1:]:
            sky = wcs.get_transform(wcs.available_frames[0], frame)
            options = {"shape": shape, "unit": ARCSEC if frame == "v2v3" else 1.0, "frame": frame}
            yield imported_sky(f"gwcs, {name}, to {frame}", "gwcs", path, sky, **options)


def reference_file():
    """The distortion reference file of MIRI, against the matrices in FITS that it was made from."""
    folder = data("static_distortion", "miri_miricoord")
    with fits.open(folder / "MIRI_FM_MIRIMAGE_DISTORTION_SS.09.00.fits") as hdulist:
        mi, ai, bi, ti = (hdulist[f"{key} matrix"].data for key in ("MI", "AI", "BI", "TI"))

    def sky(x, y):
        row, column, one = mi @ [y, x - 4, np.ones_like(x)]  # columns are counted from the first one in light
        return (ti @ [*(polynomial.polyval2d(row, column, c) for c in (ai, bi)), one])[:2]

    path = folder / "jwst_miri_imager_distortion_flt9.asdf"
    yield imported_sky("reference file, MIRI imager", "FITS matrices", path, sky, shape=(1024, 1032), unit=ARCSEC)


def hst_header():
    """SIP of ACS/WFC; the look-up tables are not in the text."""
    path = data("gwcs_interop", "acs_wfc.hdr")
    head = fits.Header.fromtextfile(path)
    tables = {card.keyword for card in head.cards if card.keyword.startswith(("CPDIS", "D2IMDIS", "DP", "D2IM1"))}
    for keyword in tables:
        head.remove(keyword, remove_all=True)
    wcs = WCS(head)
    sky = lambda x, y: wcs.all_pix2world(x, y, 0)  # noqa: E731
    yield imported_sky("FITS header text, HST ACS, SIP", "astropy.wcs", path, sky, shape=(2048, 4096))


def fits_headers():
    """SIP and TPV in FITS files, by two libraries each."""
    for ctype in ("TAN-SIP", "TPV"):
        head = header(ctype)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "a.fits")
            fits.PrimaryHDU(np.zeros((1024, 1024), np.uint8), head).writeto(path)
            wcs = WCS(head)
            sky = lambda x, y, wcs=wcs: wcs.all_pix2world(x, y, 0)  # noqa: E731
            for reader, of in (("astropy.wcs", sky), ("AST", by_ast(head))):
                yield imported_sky(f"FITS header, {ctype}", reader, path, of, shape=(1024, 1024))


def maps():
    """Shifts of NIRC2, against the pixels of the maps."""
    paths = [data("static_distortion", "nirc2_kai", f"nirc2_narrow_{k}geoim_512.fits") for k in "xy"]
    shifts = np.array([fits.getdata(path) for path in paths], dtype=float)
    y, x = np.indices(shifts.shape[1:]).astype(float)
    seen = np.array(read_source(paths).stated().on_plane()(x.ravel(), y.ravel())).reshape(shifts.shape)
    error = np.hypot(*(seen - [x, y] - shifts)).max()
    yield Row("two FITS maps, NIRC2", "numpy, every pixel", error, 7, Prior.from_file(paths, degree=7).truncation)


def coefficients():
    """Drizzle coefficients of NIRC2, against powers in plain numpy."""
    for path in sorted(data("static_distortion", "nirc2_kai").glob("*.coeffs.txt")):
        words = [word for line in path.read_text().splitlines() if line[:1] != "#" for word in line.split()]
        cs = np.array(words[2:] if words[0] == "poly" else words[1:], dtype=float).reshape(2, -1)
        order = [(n - k, k) for n in range(6) for k in range(n + 1)]

        def plane(x, y, cs=cs, order=order):
            x, y = x - 512, y - 512
            return [sum(a * x**i * y**j for a, (i, j) in zip(c, order, strict=False)) for c in cs]

        name = path.name.removesuffix(".coeffs.txt")
        yield imported(f"Drizzle coefficients, {name}", "numpy", path, plane, shape=(1024, 1024))


def apertures():
    """SIAF, against pysiaf."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import pysiaf
    except ImportError:
        raise Skip("pysiaf is not installed") from None
    for instrument, name in (
        ("NIRCam", "NRCA1_FULL"),
        ("NIRISS", "NIS_CEN"),
        ("MIRI", "MIRIM_FULL"),
        ("FGS", "FGS1_FULL"),
    ):
        aperture = pysiaf.Siaf(instrument)[name]
        plane = lambda x, y, aperture=aperture: aperture.sci_to_idl(x + 1, y + 1)  # noqa: E731
        yield imported(f"SIAF, {instrument} {name}", "pysiaf", f"siaf:{instrument}/{name}", plane)


def own_wcs():
    """The gwcs of an exposure of ours, from ASDF and from the ASDF extension of FITS, against the distortion in it."""
    mean = np.zeros((2, 10))
    mean[:, 3:] = np.random.default_rng(1).normal(0, 3, (2, 7))
    d = Distortion(mean, (512, 512))
    sky = TangentPlane(0.0, 89.9, np.array([[-1e-5, 0, 0], [0, 1e-5, 0]]))
    tree = {"meta": {"wcs": exposure_wcs("a", similarity.identity(), d, sky)}}
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder, "a.asdf"), Path(folder, "a.fits")
        asdf.AsdfFile(tree, version="1.5.0").write_to(paths[0])
        raw = np.frombuffer(paths[0].read_bytes(), np.uint8)
        table = fits.BinTableHDU.from_columns(
            [fits.Column("ASDF_METADATA", f"{raw.size}B", array=raw[None])], name="ASDF"
        )
        fits.HDUList([fits.PrimaryHDU(), table]).writeto(paths[1])
        exact = lambda x, y: d.invert(np.column_stack([x, y])).T  # noqa: E731
        for path in paths:
            yield imported(f"our WCS of an exposure, {path.suffix[1:]}", "Newton's method", path, exact, degree=3)


def prior_file():
    """A prior written and read, against itself in memory."""
    prior = Prior.from_file("gsaoi-1")
    with tempfile.TemporaryDirectory() as folder:
        again = Prior.read(prior.write(Path(folder, "prior.asdf")))
    yield Row("prior.asdf", "in memory", float(np.abs(again.mean - prior.mean).max()), 5, again.truncation)


# -- exports: the distortion of an exposure, 1100 x 700 px, as other software reads it


def closest_header(solution, kind):
    """The header of the exposure with the smallest error allowed that it can keep."""
    for allowed in (1e-3, 1e-2, 1e-1):  # strong distortions are beyond SIP and TPV
        with contextlib.suppress(ExportError):
            return solution["a"].header(kind=kind, max_error=allowed)
    raise Skip(f"no {kind.upper()} header keeps 0.1 px")


def exported(reader, read):
    """Rows of one reader: ``read(solution, header) -> ra, dec`` [deg] of pixels, for headers of several distortions."""
    make = sky_chains.geometries()
    for kind in ("sip", "tpv"):
        for degree, peak in ((3, 5), (3, 20), (3, 100), (5, 5), (5, 20)):
            solution = make(degree, peak)
            header = closest_header(solution, kind)
            p, _, _ = sky_chains.detector(solution, "a")
            back = sky_chains.pixels_of(solution, "a", *read(header, p))
            what = f"{kind.upper()} header, degree {degree}, {peak} px"
            yield Row(what, reader, sky_chains.largest(back, p), header.get("A_ORDER"))


def headers_in_astropy():
    """Our FITS headers as astropy.wcs reads them."""
    yield from exported("astropy.wcs", lambda header, p: WCS(header).all_pix2world(p, 0).T)


def headers_in_ast():
    """Our FITS headers as AST reads them, the library behind DS9."""
    try:
        import starlink.Ast as ast
    except ImportError:
        raise Skip("starlink-pyast is not installed") from None

    def read(header, p):
        channel = ast.FitsChan()
        for card in header.cards:
            channel.putfits(str(card), False)
        channel.clear("Card")
        return np.degrees(channel.read().tran((p + 1).T))

    yield from exported("AST", read)


def tables_in_fits():
    """The exact gwcs in the ASDF table of a FITS file, as stdatamodels reads it."""
    try:
        from stdatamodels import asdf_in_fits
    except ImportError:
        raise Skip("stdatamodels is not installed") from None
    solution = sky_chains.geometries()(5, 20)
    p, _, _ = sky_chains.detector(solution, "a")
    with tempfile.TemporaryDirectory() as folder:
        frame = Path(folder, "a.fits")
        fits.PrimaryHDU(np.zeros(sky_chains.SHAPE, np.int16)).writeto(frame)
        attach(solution, [frame], in_place=True)
        with asdf_in_fits.open(frame) as file:
            sky = file["meta"]["wcs"](*p.T)
    yield Row("ASDF table in FITS, degree 5, 20 px", "stdatamodels",
              sky_chains.largest(sky_chains.pixels_of(solution, "a", *sky), p), 5)  # fmt: skip


# -- peers: the exact WCS of an exposure in the hands of other packages, 25 px of distortion, the detector on a pole


def bent():
    """The solution that the tests of peers have, its pixels (n, 2) and where they are on the sky."""
    made = sky_chains.geometries()(5, 25.0, lat=90.0, turn=0.0, shape=(400, 560))
    solution = replace(made, coefficients=-made.coefficients, sky=TangentPlane(10.0, 90.0, 50 * made.sky.matrix))
    p, ra, dec = (a[404:] for a in sky_chains.detector(solution, "a"))
    return solution, p, SkyCoord(ra, dec, unit="deg")


def peer(module):
    """A module, or `Skip`."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise Skip(str(error)) from None


def apart(found, expected):
    """Largest distance [pix]; NaN if one position is lost."""
    return float(np.hypot(*(np.column_stack(found) - expected).T).max())


def wcs_in_gwcs():
    """World to pixels by our class and by the stock class that files hold."""
    solution, p, sky = bent()
    wcs = solution["a"].wcs
    yield Row("gwcs at the pole, 25 px, in memory", f"gwcs {gwcs.__version__}", apart(wcs.world_to_pixel(sky), p))
    stock = wcs.stock()
    yield Row("the same from a file", "gwcs", apart(stock.world_to_pixel(sky), p))
    stock.bounding_box = None
    yield Row("the same, bounding_box = None", "gwcs", apart(stock.world_to_pixel(sky), p))


def wcs_in_reproject():
    """Where every pixel of a plain grid comes from, by an image whose values are its positions."""
    reproject = peer("reproject")
    solution, _, _ = bent()
    ny, nx = solution.estimate.shapes["a"]
    y, x = np.mgrid[:ny, :nx].astype(float)
    grid_ = WCS(naxis=2)
    grid_.wcs.ctype, grid_.wcs.crval, grid_.wcs.crpix = ["RA---TAN", "DEC--TAN"], [10.0, 90.0], [140.5, 100.5]
    grid_.wcs.cdelt = np.array([-2.0, 2.0]) * solution.sky.pixel_scale / 3600
    to = np.indices((200, 280))[::-1].reshape(2, -1).T
    came = sky_chains.pixels_of(solution, "a", *grid_.all_pix2world(to, 0).T)
    well = ((came > 6) & (came < [nx - 7, ny - 7])).all(axis=1)
    for method in ("interp", "adaptive", "exact"):
        function = getattr(reproject, f"reproject_{method}")
        found = [function((a, solution["a"].wcs), grid_, shape_out=(200, 280))[0].ravel()[well] for a in (x, y)]
        yield Row("gwcs at the pole, 25 px, resampled", f"reproject_{method}", apart(found, came[well]))


def wcs_in_photutils():
    """Apertures from the sky to pixels."""
    aperture = peer("photutils.aperture")
    solution, p, sky = bent()
    found = aperture.SkyCircularAperture(sky, r=2 * u.arcsec).to_pixel(solution["a"].wcs).positions
    yield Row("sky apertures to pixels", "photutils", apart(found.T, p))


def wcs_in_ndcube():
    """The WCS of a part of a cube."""
    ndcube = peer("ndcube")
    solution, p, sky = bent()
    part = ndcube.NDCube(np.zeros(solution.estimate.shapes["a"]), wcs=solution["a"].wcs)[30:, 50:]
    inside = (p > [50, 30]).all(axis=1)
    yield Row("a part of an image", "ndcube", apart(part.wcs.world_to_pixel(sky[inside]), p[inside] - [50, 30]))


def wcs_in_regions():
    """Regions from the sky to pixels."""
    regions = peer("regions")
    solution, p, sky = bent()
    wcs = solution["a"].wcs
    found = [regions.CircleSkyRegion(s, 1 * u.arcsec).to_pixel(wcs).center.xy for s in sky[:50]]
    yield Row("sky regions to pixels", "regions", apart(np.transpose(found), p[:50]))


def wcs_in_pipelines():
    """`refine` of NIRCam's WCS, in tweakwcs, stcal and a file as Roman has them."""
    with asdf.open(data("gwcs_interop", "nircamwcs.asdf"), memmap=False, lazy_load=False) as file:
        solution = sky_chains.solution_at(file["wcs"], (2048, 2048), 5.0)
        made = refine(file["wcs"], solution["a"])
    p, ra, dec = sky_chains.detector(solution, "a")
    p, sky = p[404:], SkyCoord(ra[404:], dec[404:], unit="deg")
    with contextlib.suppress(Skip):
        info = {"v2_ref": 86.039, "v3_ref": -493.386, "roll_ref": 0.0}
        corrector = peer("tweakwcs.correctors").JWSTWCSCorrector(made, info)
        found = sky_chains.pixels_of(solution, "a", *corrector.det_to_world(*p.T))
        yield Row("refine(NIRCam), detector to sky", "tweakwcs", apart(found.T, p))
    with contextlib.suppress(Skip):
        pixmap = peer("stcal.resample.utils").calc_pixmap(made, solution["a"].fits_wcs(), shape=(2048, 2048))
        y, x = np.mgrid[:2048, :2048]
        off = np.hypot(pixmap[..., 0] - x, pixmap[..., 1] - y)
        yield Row("refine(NIRCam), map to our SIP", "stcal", float(off.max()))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "r.asdf")
        asdf.AsdfFile({"roman": {"meta": {"wcs": made}}}).write_to(path)
        with asdf.open(path, lazy_load=False, memmap=False) as file:
            back = file["roman"]["meta"]["wcs"]
        yield Row("refine(NIRCam), at roman.meta.wcs", "asdf, gwcs", apart(back.invert(sky.ra.deg, sky.dec.deg), p))


def files_for_fitsverify():
    """Errors and warnings, not pixels, of a frame with everything attached."""
    if shutil.which("fitsverify") is None:
        raise Skip("fitsverify is not installed")
    solution, _, _ = bent()
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("sip", "tpv"):
            frame = Path(folder, "a.fits")
            fits.PrimaryHDU(np.zeros(solution.estimate.shapes["a"], np.int16)).writeto(frame, overwrite=True)
            attach(solution, [frame], in_place=True, kind=kind, max_error=1.0)
            said = subprocess.run(["fitsverify", "-q", frame], capture_output=True, text=True, check=False).stdout
            counts = re.search(r"(\d+) warnings? and (\d+) errors?", said)
            yield Row(f"attached frame, {kind.upper()}: number of complaints", "fitsverify",
                      float(sum(map(int, counts.groups()))) if counts else 0.0 if "OK" in said else np.nan)  # fmt: skip


def program(*names):
    """Path of the first of these programs that is installed, or `Skip`."""
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        raise Skip(f"{' or '.join(names)} is not installed")
    return found


def called(folder, *command):
    """What a program says; `Skip` with its last line if it fails."""
    made = subprocess.run([str(word) for word in command], cwd=folder, capture_output=True, text=True, check=False)
    if made.returncode:
        raise Skip(
            f"{command[0]} ended with {made.returncode}: {(made.stderr.strip().splitlines() or ['no word'])[-1]}"
        )
    return made.stdout


def starry_frame(path, solution, kind, *, n_stars=120, seed=0):
    """A frame with Gaussian stars and our header; positions (n, 2)."""
    ny, nx = solution.estimate.shapes["a"]
    rng = np.random.default_rng(seed)
    places = np.mgrid[12 : nx - 12 : 24, 12 : ny - 12 : 24].reshape(2, -1).T
    p = rng.choice(places, n_stars, replace=False) + rng.uniform(-2, 2, (n_stars, 2))
    y, x = np.mgrid[:ny, :nx]
    image = rng.normal(100, 1, (ny, nx))
    for x0, y0 in p:
        part = np.s_[int(y0) - 10 : int(y0) + 11, int(x0) - 10 : int(x0) + 11]
        image[part] += 3000 * np.exp(-0.5 * ((x[part] - x0) ** 2 + (y[part] - y0) ** 2) / 1.5**2)
    header = closest_header(solution, kind)
    fits.PrimaryHDU(image.astype(np.float32), header).writeto(path, overwrite=True)
    return p


def catalogue_of(folder, frame, kind):
    """SExtractor's catalogue of a frame (FITS LDAC), in the folder."""
    Path(folder, "a.param").write_text(
        "XWIN_IMAGE\nYWIN_IMAGE\nERRAWIN_IMAGE\nERRBWIN_IMAGE\nERRTHETAWIN_IMAGE\nALPHAWIN_J2000\nDELTAWIN_J2000\n"
        "FLUX_AUTO\nFLUXERR_AUTO\nFLAGS\nFLUX_RADIUS\nELONGATION\n"
    )
    options = ["-PARAMETERS_NAME", "a.param", "-FILTER", "N", "-CATALOG_TYPE", "FITS_LDAC"]
    name = f"{kind}.cat"
    called(folder, program("source-extractor", "sex"), frame, "-CATALOG_NAME", name, *options)
    return Path(folder, name)


def headers_in_sextractor():
    """Positions on the sky of the sources that SExtractor finds, taken back to the pixels where it found them."""
    solution = sky_chains.geometries()(3, 20)
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("tpv", "sip"):
            frame = Path(folder, f"{kind}.fits")
            starry_frame(frame, solution, kind)
            with fits.open(catalogue_of(folder, frame, kind)) as hdulist:
                found = np.array(hdulist["LDAC_OBJECTS"].data)
            found = found[found["FLUX_AUTO"] > 50 * found["FLUXERR_AUTO"]]
            sky = found["ALPHAWIN_J2000"], found["DELTAWIN_J2000"]
            back = sky_chains.pixels_of(solution, "a", *(np.asarray(a, dtype=float) for a in sky))
            seen = np.column_stack([found["XWIN_IMAGE"], found["YWIN_IMAGE"]]) - 1
            yield Row(f"{kind.upper()} header, degree 3, 20 px: {len(found)} stars", "SExtractor", apart(back.T, seen))


def headers_in_swarp():
    """Where every pixel of SWarp's grid comes from, by frames whose values are positions."""
    swarp = program("SWarp", "swarp")
    solution = sky_chains.geometries()(3, 20)
    ny, nx = solution.estimate.shapes["a"]
    header = closest_header(solution, "tpv")
    with tempfile.TemporaryDirectory() as folder:
        found = []
        for name, values in zip("xy", np.mgrid[:ny, :nx][::-1], strict=True):
            fits.PrimaryHDU(values.astype(np.float32) + 1000, header).writeto(Path(folder, f"{name}.fits"))
            called(
                folder, swarp, f"{name}.fits", "-IMAGEOUT_NAME", f"{name}.out.fits", "-SUBTRACT_BACK", "N",
                "-FSCALASTRO_TYPE", "NONE", "-RESAMPLING_TYPE", "BILINEAR", "-WEIGHTOUT_NAME", f"{name}.weight.fits",
            )  # fmt: skip
            with fits.open(Path(folder, f"{name}.out.fits")) as hdulist:
                out, made = hdulist[0].data.astype(float), WCS(hdulist[0].header)
            weight = fits.getdata(Path(folder, f"{name}.weight.fits"))
            found.append(out - 1000)
        y, x = np.indices(out.shape)
        came = sky_chains.pixels_of(solution, "a", *made.all_pix2world(np.column_stack([x.ravel(), y.ravel()]), 0).T)
        well = ((came > 3) & (came < [nx - 4, ny - 4])).all(axis=1) & (weight.ravel() > 0)
        yield Row(
            "TPV header, degree 3, 20 px, resampled", "SWarp", apart([a.ravel()[well] for a in found], came[well])
        )


def headers_in_scamp():
    """What SCAMP says of catalogues with our headers against a reference that holds the truth: scatter, pixels.

    A plain TAN header of the same stars stands beside it, with the distortion that it leaves out.
    """
    scamp = program("scamp")
    solution = sky_chains.geometries()(3, 20)
    for n_stars in (36, 200):
        for kind in ("tpv", "tan"):
            with tempfile.TemporaryDirectory() as folder:
                frame = Path(folder, f"{kind}.fits")
                p = starry_frame(frame, solution, "tpv", n_stars=n_stars)
                if kind == "tan":
                    with fits.open(frame, mode="update") as hdulist:
                        head = hdulist[0].header
                        for key in [key for key in head if re.fullmatch(r"PV\d_\d+", key)]:
                            head.remove(key)
                        head["CTYPE1"], head["CTYPE2"] = "RA---TAN", "DEC--TAN"
                catalogue_of(folder, frame, kind)
                _reference_for_scamp(Path(folder, "ref.cat"), solution, p)
                try:
                    called(
                        folder, scamp, f"{kind}.cat", "-ASTREF_CATALOG", "FILE", "-ASTREFCAT_NAME", "ref.cat",
                        "-ASTREFCENT_KEYS", "X_WORLD,Y_WORLD", "-ASTREFMAG_KEY", "MAG", "-ASTREFMAGERR_KEY", "MAGERR",
                        "-ASTREFERR_KEYS", "ERRA_WORLD,ERRB_WORLD,ERRTHETA_WORLD", "-ASTREFOBSDATE_KEY", "OBSDATE",
                        "-CENTROID_KEYS", "XWIN_IMAGE,YWIN_IMAGE",
                        "-CENTROIDERR_KEYS", "ERRAWIN_IMAGE,ERRBWIN_IMAGE,ERRTHETAWIN_IMAGE",
                        "-SN_THRESHOLDS", "5,20", "-CROSSID_RADIUS", "3", "-MATCH", "N", "-SOLVE_ASTROM", "N",
                        "-SOLVE_PHOTOM", "N", "-CHECKPLOT_TYPE", "NONE", "-WRITE_XML", "Y", "-XML_NAME", "scamp.xml",
                    )  # fmt: skip
                    error = _scamp_scatter(Path(folder, "scamp.xml"), solution)
                except Skip as reason:
                    print(f"headers_in_scamp: {kind.upper()}, {n_stars} stars: {reason}")
                    continue
            yield Row(f"{kind.upper()} header, 20 px, {n_stars} stars, scatter", "SCAMP", error)


def _reference_for_scamp(path, solution, p):
    """Catalogue (FITS LDAC) of the true places of stars."""
    pose = solution.poses["a"]
    sky = sky_chains.sky_of(solution, "a", solution["a"].correct(p) @ pose[:, :2].T + pose[:, 2])
    small = np.full(len(p), 1e-7)
    columns = dict(zip(("X_WORLD", "Y_WORLD"), sky, strict=True))
    columns |= {"ERRA_WORLD": small, "ERRB_WORLD": small, "ERRTHETA_WORLD": 0 * small, "MAG": 15 + 0 * small}
    columns |= {"MAGERR": 0.01 + 0 * small, "OBSDATE": 2000 + 0 * small}
    cards = fits.Header({"SIMPLE": True, "BITPIX": 8, "NAXIS": 0}).tostring(padding=True)
    cards = np.array([[cards[k : k + 80] for k in range(0, len(cards), 80)]])
    fields = fits.BinTableHDU.from_columns(
        [fits.Column("Field Header Card", f"{cards.size * 80}A", array=cards, dim=f"(80, {cards.size})")],
        name="LDAC_IMHEAD",
    )
    objects = fits.BinTableHDU.from_columns(
        [fits.Column(name, "1D", array=values) for name, values in columns.items()], name="LDAC_OBJECTS"
    )
    fits.HDUList([fits.PrimaryHDU(), fields, objects]).writeto(path)


def _scamp_scatter(path, solution):
    """Scatter against the reference, larger axis, pixels."""
    table = votable.parse(path, verify="ignore").get_table_by_id("Fields").array
    scatter = np.ravel(table["AstromSigma_Reference"])
    return float(np.max(scatter) / solution.sky.pixel_scale)


def headers_in_ds9():
    """Regions at pixels, loaded in DS9 and saved in degrees."""
    ds9, screen = program("ds9"), program("xvfb-run")
    solution = sky_chains.geometries()(3, 20)
    p = sky_chains.detector(solution, "a")[0][404:444]
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("sip", "tpv"):
            header = closest_header(solution, kind)
            fits.PrimaryHDU(np.zeros(solution.estimate.shapes["a"], np.uint8), header).writeto(
                Path(folder, "a.fits"), overwrite=True
            )
            lines = [f"image;point({x + 1:.9f},{y + 1:.9f})" for x, y in p]
            Path(folder, "in.reg").write_text("\n".join(lines) + "\n")
            called(
                folder, screen, "-a", ds9, "a.fits", "-regions", "load", "in.reg", "-regions", "system", "wcs",
                "-regions", "sky", "icrs", "-regions", "skyformat", "degrees", "-regions", "save", "out.reg", "-exit",
            )  # fmt: skip
            said = re.findall(r"point\(([-\d.]+),([-\d.]+)\)", Path(folder, "out.reg").read_text())
            back = sky_chains.pixels_of(solution, "a", *np.array(said, dtype=float).T)
            yield Row(f"{kind.upper()} header, degree 3, 20 px, regions", "DS9", apart(back.T, p))


def refined_in_roman():
    """`refine` of Roman's WCS in the data model of Roman, written and read."""
    datamodels = peer("roman_datamodels.datamodels")
    with asdf.open(data("gwcs_interop", "roman_wcs.asdf"), memmap=False, lazy_load=False) as file:
        wcs = file["roman"]["wcs"] if "roman" in file.tree else file["wcs"]
        solution = sky_chains.solution_at(wcs, (5000, 5000), 5.0)
        made = refine(wcs, solution["a"])
    p, ra, dec = sky_chains.detector(solution, "a")
    model = datamodels.ImageModel.create_fake_data(shape=(8, 8))
    model.meta.wcs = made.stock()
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder, "r.asdf"))
        back = datamodels.open(Path(folder, "r.asdf")).meta.wcs
        yield Row(
            "refine(Roman), in its data model", "roman_datamodels", apart(back.invert(ra[404:], dec[404:]), p[404:])
        )


IMPORTS = [
    astropy_models,
    gwcs_files,
    reference_file,
    hst_header,
    fits_headers,
    maps,
    coefficients,
    apertures,
    own_wcs,
    prior_file,
]
EXPORTS = [headers_in_astropy, headers_in_ast, tables_in_fits]
PEERS = [
    wcs_in_gwcs,
    wcs_in_reproject,
    wcs_in_photutils,
    wcs_in_ndcube,
    wcs_in_regions,
    wcs_in_pipelines,
    files_for_fitsverify,
    headers_in_sextractor,
    headers_in_swarp,
    headers_in_scamp,
    headers_in_ds9,
    refined_in_roman,
]


def main(functions=(*IMPORTS, *EXPORTS, *PEERS)):
    """Print the rows of all functions, or why there are none."""
    print(COLUMNS.format("what", "against", "error px", "degree", "trunc. px"))
    for function in functions:
        try:
            for row in function():
                print(row, flush=True)
        except Skip as reason:
            print(f"{function.__name__}: skipped, {reason}")


if __name__ == "__main__":
    chosen = [f for f in (*IMPORTS, *EXPORTS, *PEERS) if not sys.argv[1:] or f.__name__ in sys.argv[1:]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        warnings.simplefilter("ignore", FITSFixedWarning)
        main(chosen)
