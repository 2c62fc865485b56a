"""Example files: small simulated sets in the forms that other programs write."""

from pathlib import Path

import asdf
import gwcs
import numpy as np
from astropy import units as u
from astropy.coordinates import ICRS
from astropy.io import fits
from astropy.modeling import models
from astropy.time import Time
from gwcs import coordinate_frames as cf

from ..geometry.gsaoi import gsaoi_static
from ..priors.prior import Prior
from ..runtime import checks, outputs
from ..runtime.words import EXAMPLES
from .observations import simulate_exposures, simulate_gsaoi_matches

#: Degree of the prior: the static map is then followed to 3e-6 px.
PRIOR_DEGREE = 5
#: Instrumental magnitude of a flux of one, and the year of the lists.
_ZERO_POINT, _YEAR = 25.0, 2014.936
_SATURATED, _DO_NOT_USE = 4, 1


def write_examples(kind, out, *, seed=0, overwrite=False):
    """Write a small simulated set of exposures of one field.

    Parameters
    ----------
    kind : str
        "frames": FITS images of one detector, with the prior of its static distortion; "camera": images of the four
        detectors of GSAOI, coarser, with the camera; "headers": images with variance and flags in extensions, as
        DRAGONS writes them; "gwcs": ASDF files with a gwcs through ``v2v3``, in the form of Roman; "keck-lists": star
        lists with errors, in the form of FlyStar; "hst-lists": star lists without errors, in the form of hst1pass.
    out : str or path
        Folder.
    seed : int
        The same seed gives the same files.
    overwrite : bool
        Replace files that exist.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    InputError
        For an unknown kind, or a file that exists.
    """
    checks.check_choice(kind, EXAMPLES, "kind")
    out = Path(out)
    with outputs.replacing_folder(out, overwrite=overwrite) as target:
        _WRITERS[kind](target, seed)
        names = list(outputs.contents(target))
    return [out / name for name in names]


def published_prior(shape):
    """The published static distortion of a detector of GSAOI, that of a simulated night, as a prior."""
    known = {"shape": shape, "direction": "detector_to_reference", "degree": PRIOR_DEGREE}
    return Prior.from_model(gsaoi_static(2, size=shape[1]), **known)


# -- images


def _frames(target, seed):
    night = simulate_exposures(small=True, seed=seed)
    night.write(target)
    published_prior(night.truth.shape).write(target / "prior.asdf")


def _camera(target, seed):
    night = simulate_exposures(small=True, camera="gsaoi", seed=seed)
    night.write(target)
    night.truth.camera.write(target / "camera.asdf")


def _headers(target, seed):
    night = simulate_exposures(small=True, seed=seed)
    for name, image, header, error, flags in _calibrated(night):
        header["INSTRUME"] = "GSAOI"
        primary = fits.PrimaryHDU(header=fits.Header({"INSTRUME": "GSAOI", "OBJECT": header["OBJECT"]}))
        planes = {"SCI": image, "VAR": error**2, "DQ": flags.astype(np.uint16)}
        hdus = [fits.ImageHDU(plane, header if key == "SCI" else None, name=key) for key, plane in planes.items()]
        fits.HDUList([primary, *hdus]).writeto(target / f"{name}.fits")


def _gwcs(target, seed):
    night = simulate_exposures(small=True, seed=seed)
    for name, image, header, error, flags in _calibrated(night):
        exposure = {"exposure_time": header["EXPTIME"], "start_time": Time(header["DATE-OBS"])}
        meta = {"wcs": _pipeline_wcs(header, image.shape), "exposure": exposure, "filename": f"{name}_cal.asdf"}
        tree = {"roman": {"data": image, "err": error, "dq": flags.astype(np.uint32), "meta": meta}}
        asdf.AsdfFile(tree).write_to(target / f"{name}_cal.asdf")


def _calibrated(night):
    """Name, image, header, errors and flags of each exposure."""
    for name, hdulist in night.hdus.items():
        header = hdulist[0].header.copy()
        image = hdulist[0].data.astype(np.float32)
        error = np.sqrt(image / header["GAIN"] + (header["RDNOISE"] / header["GAIN"]) ** 2).astype(np.float32)
        flags = np.where(image >= header["SATURATE"], _SATURATED | _DO_NOT_USE, 0)
        yield name, image, header, error, flags


def _pipeline_wcs(header, shape):
    """Detector -> v2v3 (arcsec) -> world, the nominal WCS of a header."""
    cd = 3600 * np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)])
    centre = models.Shift(1 - header["CRPIX1"]) & models.Shift(1 - header["CRPIX2"])
    tangent = models.RotateNative2Celestial(header["CRVAL1"], header["CRVAL2"], 180)
    degrees = models.Scale(1 / 3600) & models.Scale(1 / 3600)
    frames = [cf.Frame2D(name=name, unit=(unit, unit)) for name, unit in (("detector", u.pix), ("v2v3", u.arcsec))]
    world = cf.CelestialFrame(name="world", reference_frame=ICRS(), unit=(u.deg, u.deg))
    steps = [centre | models.AffineTransformation2D(cd), degrees | models.Pix2Sky_TAN() | tangent, None]
    wcs = gwcs.WCS(list(zip([*frames, world], steps, strict=True)))
    wcs.bounding_box = tuple((-0.5, n - 0.5) for n in shape[::-1])
    return wcs


# -- star lists


def _keck_lists(target, seed):
    night = simulate_gsaoi_matches(n_exposures=8, n_stars=150, size=1024, dither=60.0, seed=seed)
    for letter, rows in zip("ABCDEFGH", _measured(night), strict=True):
        with (target / f"{letter}.lis").open("w", encoding="utf-8") as file:
            file.write("# name m t x y xe ye snr corr N_frames flux\n")
            for star, m, x, y, xe, ye, flux in rows:
                file.write(
                    f"star{star} {m:.3f} {_YEAR} {x:.4f} {y:.4f} {xe:.5f} {ye:.5f} {1 / xe:.2f} 0.99 4 {flux:.1f}\n"
                )


def _hst_lists(target, seed):
    night = simulate_gsaoi_matches(n_exposures=6, n_stars=300, size=1024, dither=60.0, seed=seed)
    for i, rows in enumerate(_measured(night)):
        with (target / f"ie8j01x{i + 1}q_flt.xymq").open("w", encoding="utf-8") as file:
            file.write(f"# rDAT: {_YEAR}\n#....x.... ....y.... ....m.... ....q....\n")
            for _, m, x, y, *_ in rows:  # which counts pixels from 1
                file.write(f"{x + 1:10.4f} {y + 1:10.4f} {m - _ZERO_POINT:10.4f} {0.05:10.4f}\n")


def _measured(night):
    """Star, magnitude, x, y, their errors and flux, exposure by exposure."""
    table = night.matches.table
    names = ("x", "y", "x_err", "y_err")
    for exposure in night.matches.names:
        rows = table[table["exposure"] == exposure]
        flux = np.asarray(rows["flux"])
        pixels = (rows[name].to_value(u.pix) for name in names)
        yield zip(rows["star"], _ZERO_POINT - 2.5 * np.log10(flux), *pixels, flux, strict=True)


_WRITERS = {
    "frames": _frames, "camera": _camera, "headers": _headers, "gwcs": _gwcs, "keck-lists": _keck_lists,
    "hst-lists": _hst_lists,
}  # fmt: skip
