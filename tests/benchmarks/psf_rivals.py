"""Other programs that measure stars with a PSF built from the image: PSFEx with SExtractor, photutils' EPSFBuilder.

Every function takes a frame of `ao_images` and returns positions (n, 2) [pix], errors (n, 2) [pix], and fluxes (n,).
"""

import subprocess
import tempfile
from pathlib import Path

import ao_images as ao
import numpy as np
from astropy.io import ascii as ascii_io
from astropy.io import fits
from astropy.nddata import NDData
from astropy.stats import SigmaClip, sigma_clipped_stats
from astropy.table import Table
from photutils.background import Background2D, LocalBackground, MedianBackground
from photutils.detection import DAOStarFinder
from photutils.psf import EPSFBuilder, PSFPhotometry, extract_stars

#: Detections with these flags of SExtractor (a neighbour, deblended) are kept: halos touch.
_NEIGHBOURS = 3


def _sextractor(folder, columns, **more):
    shipped = Path("/usr/share/source-extractor")
    (folder / "columns").write_text("\n".join(columns) + "\n")
    options = {
        "PARAMETERS_NAME": folder / "columns",
        "FILTER_NAME": shipped / "gauss_3.0_7x7.conv",
        "STARNNW_NAME": shipped / "default.nnw",
        "CATALOG_NAME": folder / "found.cat",
        "CATALOG_TYPE": "ASCII_HEAD",
        "GAIN": ao.GAIN,
        "DETECT_THRESH": 1.2,
        "DETECT_MINAREA": 3,
        "SATUR_LEVEL": 1e9,
        "SEEING_FWHM": 3,
        "PIXEL_SCALE": 1,
        "PHOT_APERTURES": 9,
        "BACK_SIZE": 64,
        "VERBOSE_TYPE": "QUIET",
    } | more
    words = [word for key, value in options.items() for word in (f"-{key}", str(value))]
    command = ["source-extractor", str(folder / "frame.fits"), "-c", str(shipped / "default.sex"), *words]
    subprocess.run(command, check=True, cwd=folder)


def sextractor(frame, **more):
    """Windowed positions."""
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        fits.writeto(folder / "frame.fits", frame.data)
        _sextractor(folder, ["XWIN_IMAGE", "YWIN_IMAGE", "ERRAWIN_IMAGE", "FLUX_APER(1)", "FLAGS"], **more)
        found = ascii_io.read(folder / "found.cat", format="sextractor")
    found = found[found["FLAGS"] <= _NEIGHBOURS]
    xy = np.column_stack([found["XWIN_IMAGE"], found["YWIN_IMAGE"]]) - 1
    error = np.asarray(found["ERRAWIN_IMAGE"], dtype=float)
    return xy, np.repeat(error[:, None], 2, axis=1), np.asarray(found["FLUX_APER"], dtype=float)


def psfex(frame):
    """SExtractor's PSF fits with the PSF of PSFEx, which varies as that of the frame does."""
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        fits.writeto(folder / "frame.fits", frame.data)
        stars = [
            "X_IMAGE",
            "Y_IMAGE",
            "FLUX_RADIUS",
            "FLUX_APER(1)",
            "FLUXERR_APER(1)",
            "ELONGATION",
            "FLAGS",
            "SNR_WIN",
        ]
        _sextractor(folder, [*stars, "VIGNET(35,35)"], CATALOG_TYPE="FITS_LDAC", CATALOG_NAME=folder / "stars.cat")
        options = {
            "PSFVAR_DEGREES": min(frame.order, 2), "PSF_SIZE": "61,61", "PSF_SAMPLING": 0.5, "SAMPLE_MINSN": 20,
            "SAMPLE_MAXELLIP": 0.5, "SAMPLE_FWHMRANGE": "1.5,20.0", "SAMPLE_VARIABILITY": 0.5, "CHECKPLOT_DEV": "NULL",
            "CHECKPLOT_TYPE": "NONE", "CHECKIMAGE_TYPE": "NONE", "WRITE_XML": "N", "VERBOSE_TYPE": "QUIET",
            "NTHREADS": 1,
        }  # fmt: skip
        words = [word for key, value in options.items() for word in (f"-{key}", str(value))]
        shipped = "/usr/share/psfex/default.psfex"
        subprocess.run(["psfex", str(folder / "stars.cat"), "-c", shipped, *words], check=True, cwd=folder)
        columns = ["XPSF_IMAGE", "YPSF_IMAGE", "ERRAPSF_IMAGE", "FLUX_PSF", "FLAGS"]
        _sextractor(folder, columns, PSF_NAME=folder / "stars.psf")
        found = ascii_io.read(folder / "found.cat", format="sextractor")
    found = found[(found["FLAGS"] <= _NEIGHBOURS) & (found["XPSF_IMAGE"] > 0)]
    xy = np.column_stack([found["XPSF_IMAGE"], found["YPSF_IMAGE"]]) - 1
    error = np.asarray(found["ERRAPSF_IMAGE"], dtype=float)
    return xy, np.repeat(error[:, None], 2, axis=1), np.asarray(found["FLUX_PSF"], dtype=float)


def epsf_builder(frame):
    """`PSFPhotometry` with the effective PSF of `EPSFBuilder`, one for the whole frame."""
    mesh = Background2D(frame.data, 64, filter_size=3, sigma_clip=SigmaClip(3), bkg_estimator=MedianBackground())
    data = frame.data - mesh.background
    _, _, std = sigma_clipped_stats(data)
    finder = DAOStarFinder(4 * std, 3.0)
    found = finder(data)
    found.sort("flux", reverse=True)
    middle = np.column_stack([found["x_centroid"], found["y_centroid"]])
    inside = (np.abs(middle - 511.5) < 490).all(axis=1) & (found["sharpness"] > 0.3)
    bright = Table({"x": middle[inside][:30, 0], "y": middle[inside][:30, 1]})
    stars = extract_stars(NDData(data), bright, size=25)
    model, _ = EPSFBuilder(oversampling=2, maxiters=10, progress_bar=False)(stars)
    noise = np.sqrt(std**2 + np.maximum(data, 0) / ao.GAIN)
    local = LocalBackground(8, 14)
    fitter = PSFPhotometry(model, (11, 11), finder=finder, aperture_radius=3, local_bkg_estimator=local)
    rows = fitter(data, error=noise)
    errors = np.column_stack([rows["x_err"], rows["y_err"]]).astype(float)
    keep = np.isfinite(errors).all(axis=1) & (np.asarray(rows["flux_fit"]) > 0)
    xy = np.column_stack([rows["x_fit"], rows["y_fit"]])
    return xy[keep], errors[keep], np.asarray(rows["flux_fit"])[keep]
