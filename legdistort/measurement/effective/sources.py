"""PSFs from elsewhere: files, models of photutils."""

from os import PathLike
from pathlib import Path

import numpy as np
from scipy import fft

from ...exceptions import InputError
from ...runtime.fits_bytes import open_fits
from ...runtime.locks import way_back
from ...runtime.provenance import files_of_run, of_one_run
from . import splines
from .model import EXTENSION, EffectivePSF, Polynomial

#: Words for the PSF that `measure` is to use.
PSFS = ("auto", "moffat", "effective")


def psf_from(given):
    """What `measure` is given as the PSF: one of `PSFS`, an `EffectivePSF`, or a dict of these.

    Parameters
    ----------
    given : str, path, EffectivePSF, photutils model, or dict of these by exposure
        A path is that of a file, or of a folder with a file for every exposure.

    Raises
    ------
    InputError
        For files that hold no PSF, and whatever else is none.
    """
    if isinstance(given, dict):
        return {str(name): psf_from(one) for name, one in given.items()}
    if isinstance(given, EffectivePSF) or (isinstance(given, str) and given in PSFS):
        return given
    if isinstance(given, (str, PathLike)):
        path = Path(given)
        if path.is_dir():
            return _from_folder(path)
        if not path.exists():
            lost = f"there is no file {path}{way_back(path)}"
            raise InputError(f"psf must be one of {', '.join(map(repr, PSFS))} or a file, and {lost}")
        return read_psf(path)
    if isinstance(given, np.ndarray):
        raise InputError(
            "psf is an array, which does not state its oversampling: give "
            "EffectivePSF.from_array(array, oversampling=...)"
        )
    if all(hasattr(given, name) for name in ("data", "oversampling")):
        return from_photutils(given)
    raise InputError(
        f"psf must be one of {', '.join(map(repr, PSFS))}, an EffectivePSF, a file, a photutils ImagePSF or "
        f"GriddedPSFModel, or a dict of them by exposure, got {type(given).__name__}"
    )


def _from_folder(folder):
    """The PSFs of a folder by the names of their files."""

    def read():
        paths = sorted(p for p in folder.iterdir() if p.suffix in (".fits", ".psf"))
        if not paths:
            raise InputError(f"psf: there are neither .fits nor .psf files in the folder {folder}")
        return {path.stem: read_psf(path) for path in paths}, [path.relative_to(root).as_posix() for path in paths]

    listed = files_of_run(folder.parent) or {}
    root = folder.parent if any(name.startswith(f"{folder.name}/") for name in listed) else folder
    return of_one_run(root, read)


def from_photutils(model):
    """The PSF of an ``ImagePSF`` or ``GriddedPSFModel`` of photutils; of its parameters flux, x_0, y_0 nothing."""
    name = type(model).__name__
    steps = np.unique(np.asarray(model.oversampling))
    if len(steps) != 1:
        raise InputError(f"{name}: the oversampling must be the same in x and y, got {tuple(model.oversampling)}")
    data = np.asarray(model.data, dtype=float)
    middle = (np.array(data.shape[-2:][::-1]) - 1) / 2
    if data.ndim == 2 and not np.allclose(getattr(model, "origin", middle), middle):
        raise InputError(f"{name}: the star must be in the middle of the array, {middle}, got {model.origin}")
    return EffectivePSF.from_array(
        data, oversampling=int(steps[0]), positions=getattr(model, "grid_xypos", None), source=name
    )


def read_psf(path):
    """The PSF of a file.

    Parameters
    ----------
    path : str or path
        One that `EffectivePSF.write` made; of PSFEx (table ``PSF_DATA``); or oversampled images, (ny, nx) or (n, ny,
        nx), with the keywords ``OVERSAMP`` and, for more than one, ``DET_YX0``, ... (``psf_grid`` of stpsf) or
        ``NXPSFS``, ``IPSFX01``, ``JPSFY01``, ... (STDPSF, oversampling 4). What ``calc_psf`` of stpsf writes
        (extensions ``OVERSAMP``, ``OVERDIST``) is light on fine samples, and is added up over detector pixels here.

    Returns
    -------
    EffectivePSF

    Raises
    ------
    InputError
        If it is none of these, or states too little.
    """
    path = Path(path)
    try:
        with path.open("rb") as file, open_fits(file, path) as hdus:
            names = [hdu.name for hdu in hdus]
            if EXTENSION in names:
                return EffectivePSF.from_hdus(hdus, path)
            if "PSF_DATA" in names:
                return _from_psfex(hdus["PSF_DATA"], path)
            return _from_images(hdus, path)
    except OSError as error:
        raise InputError(f"{path}: no FITS file that could be read ({error})") from None


def _needed(header, key, path):
    if key not in header:
        raise InputError(f"{path}: the keyword {key} is missing, without which the PSF is not known")
    return header[key]


def _from_psfex(table, path):
    """Polynomials of images, as PSFEx writes them (its manual, "The PSF file")."""
    header = table.header
    step = float(_needed(header, "PSF_SAMP", path))
    n_axes = int(header.get("POLNAXIS", 0))
    axes = {}
    for k in range(1, n_axes + 1):
        what = str(_needed(header, f"POLNAME{k}", path)).strip()
        if what not in ("X_IMAGE", "Y_IMAGE", "XWIN_IMAGE", "YWIN_IMAGE", "XPSF_IMAGE", "YPSF_IMAGE"):
            raise InputError(
                f"{path}: the PSF depends on {what}; only places in the image are known here (X_IMAGE, Y_IMAGE): run "
                "PSFEx with PSFVAR_KEYS X_IMAGE,Y_IMAGE"
            )
        if int(header.get(f"POLGRP{k}", 1)) != 1:
            raise InputError(f"{path}: x and y must be in one group of PSFVAR_GROUPS, 1,1")
        axes[what[0]] = float(_needed(header, f"POLZERO{k}", path)), float(_needed(header, f"POLSCAL{k}", path))
    degree = int(header.get("POLDEG1", 0)) if n_axes else 0
    images = np.asarray(table.data["PSF_MASK"][0], dtype=float)
    if images.ndim == 2:
        images = images[None]
    if n_axes == 2 and [str(header[f"POLNAME{k}"]).strip()[0] for k in (1, 2)] != ["X", "Y"]:
        raise InputError(f"{path}: PSFVAR_KEYS must name x first, then y")
    if n_axes == 1 or len(images) != (degree + 1) * (degree + 2) // 2:
        raise InputError(f"{path}: {len(images)} images are no polynomial of degree {degree} in x and y")
    (x0, dx), (y0, dy) = axes.get("X", (1.0, 1.0)), axes.get("Y", (1.0, 1.0))
    variation = Polynomial(degree, (x0 - 1, y0 - 1), (dx, dy))  # PSFEx counts pixels from 1
    total = images[0].sum() * step**2
    if not total > 0 or not np.isfinite(images).all():
        raise InputError(f"{path}: the images hold no light, or values that are not finite")
    return EffectivePSF(splines.coefficients(images) / total, step, variation, source=path.name)


def on_samples(hdus):
    """The HDU of ``calc_psf`` of stpsf that has the light of a star on fine samples, with the distortion if there."""
    return next((hdus[name] for name in ("OVERDIST", "OVERSAMP") if name in [hdu.name for hdu in hdus]), None)


def over_pixels(images, width, *, averaged=1):
    """Light that falls into a pixel around every sample.

    Parameters
    ----------
    images : ndarray, shape (..., ny, nx)
        Light of a star on samples. It is taken as if its Fourier series were complete: samples finer than half of
        wavelength / diameter.
    width : float
        Of a pixel, in samples.
    averaged : int
        Every sample is the mean of so many by so many finer ones already.

    Returns
    -------
    ndarray, shape (..., ny, nx)
        As `EffectivePSF.from_array` takes it, for ``oversampling=width``: `width` squared times the sums of `images`.
    """
    ny, nx = images.shape[-2:]
    y, x = (
        np.sinc(frequency * width) * np.sinc(frequency / averaged) / np.sinc(frequency)
        for frequency in (fft.fftfreq(ny), fft.rfftfreq(nx))
    )
    return width**2 * fft.irfft2(fft.rfft2(images) * y[:, None] * x, s=(ny, nx))


def _from_images(hdus, path):
    """Oversampled images with keywords of stpsf or STDPSF."""
    fine = on_samples(hdus)
    if fine is not None:
        steps = _needed(fine.header, "OVERSAMP", path)
        data = over_pixels(np.asarray(fine.data, dtype=float), steps)
        return EffectivePSF.from_array(data, oversampling=steps, source=path.name)
    hdu = next((hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) >= 2), None)
    if hdu is None:
        raise InputError(f"{path}: there is neither an image nor a table PSF_DATA in it")
    header, data = hdu.header, np.asarray(hdu.data, dtype=float)
    n = 1 if data.ndim == 2 else len(data)
    positions = None
    if "NXPSFS" in header and "IPSFX01" in header:
        if header["NXPSFS"] * header["NYPSFS"] != n:
            raise InputError(f"{path}: there are {n} images, not NXPSFS x NYPSFS")
        sizes = {"IPSFX": header["NXPSFS"], "JPSFY": header["NYPSFS"]}
        x, y = ([_needed(header, f"{key}{k:02d}", path) - 1 for k in range(1, m + 1)] for key, m in sizes.items())
        positions = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        oversampling = header.get("OVERSAMP", 4)
    else:
        oversampling = _needed(header, "OVERSAMP", path)
        if n > 1:
            texts = [str(_needed(header, f"DET_YX{k}", path)) for k in range(n)]
            positions = np.array([[float(v) for v in text.strip("() ").split(",")] for text in texts])[:, ::-1]
    return EffectivePSF.from_array(data, oversampling=oversampling, positions=positions, source=path.name)
