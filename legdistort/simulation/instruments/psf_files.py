"""Point-spread functions of simulators, on the pixels of a detector.

Files of TIPTOP (keyword ``PIX_MAS``, places ``CCX0000``, ``CCY0000`` ...), of MAVISIM (``XPOS``, ``YPOS`` of every
extension; the size of a sample is stated nowhere) and of ``calc_psf`` of stpsf (``PIXELSCL``) hold the light of a star
on fine samples, which is added up over pixels here. All else is what `legdistort.measure` takes as a PSF.
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from ...exceptions import InputError
from ...measurement.effective.model import EffectivePSF
from ...measurement.effective.sources import on_samples, over_pixels, psf_from
from ...runtime.checks import check_positive
from ...runtime.fits_bytes import open_fits
from ..gridded_psf import GriddedPSF
from ..pupil import PupilPSF

_CORE = 6.0  # half side of what is taken of a `PupilPSF` [wavelength / diameter]
_STEPS = 5  # samples a pixel between which cubic splines interpolate


@dataclass(frozen=True, eq=False)
class FieldPSF:
    """The PSF of one place of the field or more.

    Attributes
    ----------
    psfs : list of GriddedPSF
        On the pixels of the detector.
    places : ndarray, shape (n, 2)
        Where they hold [arcsec from the middle of the field].
    """

    psfs: list
    places: np.ndarray

    def nearest(self, xy):
        """Which of them is the nearest to some places (n, 2) [arcsec]; (n,)."""
        distance = np.hypot(*(np.asarray(xy, dtype=float)[:, None] - self.places).transpose(2, 0, 1))
        return np.argmin(distance, axis=1)


def field_psf(given, *, pixel_scale, sample_scale=None):
    """The `FieldPSF` of a file, or of what `legdistort.measure` takes as one.

    Parameters
    ----------
    given : str, path, EffectivePSF, PupilPSF, GriddedPSF, or photutils model
    pixel_scale : float
        Of the detector [arcsec].
    sample_scale : float, optional
        Of the images of a file that does not state it [arcsec].

    Raises
    ------
    InputError
        For files that hold no PSF or do not state the size of their samples, and samples coarser than the pixels.
    """
    if isinstance(given, (GriddedPSF, PupilPSF)):
        return FieldPSF([given if isinstance(given, GriddedPSF) else _of_pupil(given)], np.zeros((1, 2)))
    stated = _of_simulator(Path(given)) if isinstance(given, (str, PathLike)) and Path(given).is_file() else None
    if stated is None and sample_scale is None:
        psf = psf_from(given)
        if not isinstance(psf, EffectivePSF):
            raise InputError(f"psf must be one PSF, a file of one, or a photutils model, got {given!r}")
        return FieldPSF([_on_pixels(psf)], np.zeros((1, 2)))
    images, places, scale, averaged = _bare(Path(given)) if stated is None else stated
    if scale is None and sample_scale is None:
        raise InputError(f"{given}: the file does not state the size of its samples: give psf_scale (arcsec)")
    width = pixel_scale / (sample_scale if scale is None else scale)
    if width < 0.99:
        raise InputError(
            f"{given}: a sample of the PSF, {1e3 * pixel_scale / width:g} mas, is larger than a pixel of "
            f"{1e3 * pixel_scale:g} mas: make a finer one"
        )
    total = images.sum(axis=(1, 2), keepdims=True)
    if not (np.isfinite(images).all() and np.all(total > 0)):
        raise InputError(f"{given}: the PSF holds no light, or values that are not finite")
    light = over_pixels(np.where((total > 0.5) & (total < 1.001), images, images / total), width, averaged=averaged)
    made = [EffectivePSF.from_array(each, oversampling=float(width), source=Path(given).name) for each in light]
    return FieldPSF([_on_pixels(psf) for psf in made], places)


def _of_pupil(psf):
    """A `PupilPSF` on the axis of its field, as far out as positions depend on it."""
    half = int(np.ceil(_CORE * psf.resolution)) * _STEPS
    offsets = np.arange(-half, half + 1) / _STEPS
    return GriddedPSF(psf.light(offsets, offsets), _STEPS)


def _on_pixels(psf):
    """An `EffectivePSF` in the middle of its field as a `GriddedPSF`, as far out as positions depend on it."""
    half = min(int(np.ceil(4 * psf.fwhm)) + 3, psf.reach)
    return GriddedPSF(psf.images(psf.middle, half=half, oversampling=_STEPS)[0], _STEPS)


def _of_simulator(path):
    """Images (n, ny, nx), places (n, 2), size of a sample [arcsec] or None, and how many finer ones are averaged in it.

    None for files of another kind.
    """
    try:
        with path.open("rb") as file, open_fits(file, path) as hdus:
            tiptop = next((hdu for hdu in hdus if "PIX_MAS" in hdu.header), None)
            if tiptop is not None:
                return _of_tiptop(tiptop, hdus[0].header, path)
            of_places = [hdu for hdu in hdus if {"XPOS", "YPOS"} <= set(hdu.header)]
            if of_places:
                places = np.array([[float(hdu.header[key]) for key in ("XPOS", "YPOS")] for hdu in of_places])
                return np.array([hdu.data for hdu in of_places], dtype=float), places, None, 1
            fine = on_samples(hdus)
            if fine is not None and "PIXELSCL" in fine.header:
                return np.array([fine.data], dtype=float), np.zeros((1, 2)), float(fine.header["PIXELSCL"]), 1
    except OSError as error:
        raise InputError(f"{path}: no FITS file that could be read ({error})") from None
    return None


def _of_tiptop(hdu, parameters, path):
    """Of an image that would be undersampled it writes means of blocks of a finer one, of `averaged` samples a side."""
    images = np.asarray(hdu.data, dtype=float)
    if images.ndim == 4 and len(images) == 1:
        images = images[0]
    if images.ndim != 3:
        raise InputError(f"{path}: PSFs of several wavelengths, {images.shape}: write one of them to a file")
    scale = float(str(hdu.header["PIX_MAS"]).strip("[] ")) / 1e3
    check_positive(scale, "PIX_MAS", "number of mas")
    keys = [(f"CCX{k:04d}", f"CCY{k:04d}") for k in range(len(images))]
    if not all(key in hdu.header for pair in keys for key in pair):
        raise InputError(f"{path}: there are {len(images)} PSFs, but not as many places CCX0000, CCY0000, ...")
    averaged, diameter = 1, parameters.get("telescope TelescopeDiameter")
    if diameter is not None and "WL_NM" in hdu.header:
        in_samples = np.degrees(1e-9 * float(hdu.header["WL_NM"]) / float(diameter)) * 3600 / scale
        averaged = int(np.ceil(2 / in_samples))  # as P3 and MASTSEL, which it calls, have it
    return images, np.array([[float(hdu.header[key]) for key in pair] for pair in keys]), scale, averaged


def _bare(path):
    """The first image of a file that states nothing."""
    with path.open("rb") as file, open_fits(file, path) as hdus:
        image = next((hdu.data for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) == 2), None)
    if image is None:
        raise InputError(f"{path}: there is no image in it")
    return np.array([image], dtype=float), np.zeros((1, 2)), None, 1
