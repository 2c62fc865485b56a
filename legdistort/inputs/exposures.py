"""Images and what is known about them: FITS files, HDU lists or CCDData become `Exposure`."""

import glob
import logging
import re
import threading
import warnings
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.utils.exceptions import AstropyWarning
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_scales
from tqdm import tqdm

from ..exceptions import InputError
from .exposure_names import check_exposure_name, exposure_name

logger = logging.getLogger(__name__)

#: Header keywords in order of preference. EGAIN comes first: cameras that write it use GAIN for a setting without unit.
KEYWORDS = {
    "saturation": ("SATURATE", "SATLEVEL"),
    "gain": ("EGAIN", "GAIN", "CCDGAIN", "HIERARCH ESO DET OUT1 CONAD"),
    "read_noise": ("RDNOISE", "READNOIS", "READNSE", "RON", "HIERARCH ESO DET OUT1 RON"),
    "exposure_time": ("EXPTIME", "EXPOSURE", "XPOSURE", "ITIME"),
}

#: Names of extensions that belong to an image, and how their values become standard deviations.
UNCERTAINTY_NAMES = {"ERR": "StdDev", "UNCERT": "StdDev", "VAR": "Variance", "VARIANCE": "Variance"}
MASK_NAMES = ("DQ", "MASK")

#: A header WCS is believed for pixel scales in this range [degrees]: 0.1 mas to 6 arcmin.
PIXEL_SCALES = (0.0001 / 3600, 0.1)
#: ... and a reference pixel not farther from the centre than this many frame sizes (mosaics need several).
REFERENCE_DISTANCE = 20

_FILTERS = threading.Lock()  # warning filters belong to the process, not to the thread that changes them
_UNREADABLE = (OSError, EOFError, TypeError, ValueError, KeyError, IndexError, zlib.error, fits.VerifyError)


@dataclass(frozen=True, eq=False, repr=False)
class Exposure:
    """One image and what is known about it.

    Attributes
    ----------
    name : str
    data : ndarray of float, shape (ny, nx)
        Integers are converted (float32 up to 16 bits, float64 beyond).
    mask : ndarray of bool, shape (ny, nx)
        True = bad; pixels that are not finite are always masked. None = all good.
    uncertainty : ndarray or None
        Standard deviation of every pixel, in units of the data.
    wcs : `~astropy.wcs.WCS` or None
        Nominal WCS, celestial and believable (see `believable_wcs`).
    header : `~astropy.io.fits.Header`
    saturation : float or None
        Pixels at or above it are saturated [ADU].
    gain : float or None
        Electrons per unit of the data.
    read_noise : float or None
        Electrons.
    exposure_time : float or None
        Seconds.
    path : `~pathlib.Path` or None

    Raises
    ------
    InputError
        If the data are not a 2-D image, planes differ in shape, no pixel is good, or the name could not be that of a
        file.
    """

    name: str
    data: np.ndarray
    mask: np.ndarray | None = None
    uncertainty: np.ndarray | None = None
    wcs: WCS | None = None
    header: fits.Header = field(default_factory=fits.Header)
    saturation: float | None = None
    gain: float | None = None
    read_noise: float | None = None
    exposure_time: float | None = None
    path: Path | None = None

    def __post_init__(self):
        check_exposure_name(self.name, self.path)
        data = _as_float(np.asarray(self.data), self.name)
        mask = ~np.isfinite(data)
        if self.mask is not None:
            mask |= self._plane(self.mask, "mask", data.shape).astype(bool)
        uncertainty = self.uncertainty
        if uncertainty is not None:
            uncertainty = self._plane(uncertainty, "uncertainty", data.shape).astype(data.dtype)
            with np.errstate(invalid="ignore"):
                mask |= ~((uncertainty > 0) & np.isfinite(uncertainty))
        if mask.all():
            cause = (
                "is NaN or blank" if not np.isfinite(data).any() else "is hidden by the mask or the uncertainty plane"
            )
            raise InputError(f"{self.name}: every pixel {cause}; leave this exposure out or mend it")
        for key, value in {"data": data, "mask": mask, "uncertainty": uncertainty}.items():
            object.__setattr__(self, key, value)

    def _plane(self, plane, what, shape):
        plane = np.asarray(plane)
        if plane.shape != shape:
            raise InputError(f"{self.name}: the {what} has shape {plane.shape}, the image {shape}; they must agree")
        return plane

    @property
    def shape(self):
        """Image shape ``(ny, nx)``."""
        return self.data.shape

    def read(self):
        """The exposure itself: it has its pixels already (see `legdistort.open_exposures`)."""
        return self

    def __repr__(self):
        ny, nx = self.shape
        words = [f"{nx} x {ny} px", f"{np.count_nonzero(self.mask)} masked"]
        words += [
            f"{key.replace('_', ' ')} {getattr(self, key):g}" for key in KEYWORDS if getattr(self, key) is not None
        ]
        words += ["with uncertainty"] * (self.uncertainty is not None) + ["WCS" if self.wcs is not None else "no WCS"]
        return f"<Exposure {self.name!r}: {', '.join(words)}>"


def read_exposures(paths, *, ext=None, progress=False):
    """Read images.

    The name of an exposure is the base name of its file without ``.fits``, ``.fit``, ``.fts`` and
    ``.gz``, ``.fz``, plus ``_EXT`` if `ext` was given. Images without a file are named after the
    ``FILENAME`` in their header, or ``exposure_0``, ``exposure_1`` by their place in the list.

    Extensions ``ERR``, ``UNCERT``, ``VAR`` or ``VARIANCE`` and ``DQ`` or ``MASK`` with the shape and the
    ``EXTVER`` of the image are used as its uncertainty and mask (any non-zero value is bad; of JWST
    and Roman data the bit DO_NOT_USE alone). Gain, read noise, saturation and exposure time come from
    the header (`KEYWORDS`); for integer data without such a keyword, a piled-up maximum is taken for the saturation.

    Parameters
    ----------
    paths : str, path, HDUList, CCDData, or a sequence of them
        A string with ``*`` or ``?`` is expanded if no file has that very name.
    ext : int, str or (str, int), optional
        Extension to read from every file; by default ``SCI``, or else the first with a 2-D image.
    progress : bool, optional
        Show a progress bar.

    Returns
    -------
    list of `Exposure`

    Raises
    ------
    InputError
        Naming the file: missing, not FITS, truncated, without a 2-D image or the extension wanted,
        without a good pixel, with the name of another one, or with a name that ``wcs/NAME.asdf`` could not have.
    """
    return [exposure for _, exposure in each_exposure(paths, ext, progress=progress)]


def each_exposure(paths, ext, *, progress):
    """Every source of `read_exposures` and its exposure, one after the other; names are checked."""
    origins = {}
    for i, source in enumerate(tqdm(expand_paths(paths), desc="reading", unit="frame", disable=not progress)):
        with (
            _FILTERS,
            warnings.catch_warnings(),
        ):  # headers are often a little off the standard; what matters is checked
            warnings.simplefilter("ignore", AstropyWarning)
            exposure = _read(source, ext, f"exposure_{i}")
        origin = exposure.path if exposure.path is not None else "in memory"
        if exposure.name in origins:
            raise InputError(
                f"two exposures are named {exposure.name!r} ({origins[exposure.name]} and "
                f"{origin}); rename a file, names tell exposures apart"
            )
        origins[exposure.name] = origin
        yield source, exposure


def expand_paths(paths):
    """The argument of `read_exposures` as a flat list of sources, patterns expanded."""
    if isinstance(paths, (str, Path, fits.HDUList, CCDData)):
        paths = [paths]
    sources = []
    for source in paths:
        if isinstance(source, str) and any(c in source for c in "*?") and not Path(source).exists():
            found = sorted(glob.glob(source)) or sorted(glob.glob(source.replace("[", "[[]")))
            if not found:
                raise InputError(f"no file matches {source!r}")
            sources += found
        else:
            sources.append(source)
    if not sources:
        raise InputError("no exposures to read: paths is empty")
    return sources


def _read(source, ext, default):
    if isinstance(source, CCDData):
        return _from_ccddata(source, default)
    if isinstance(source, fits.HDUList):
        filename = source.filename()
        label = filename or str(source[0].header.get("FILENAME", default)) if len(source) else default
        return _from_hdulist(source, ext, label, Path(filename) if filename else None)
    if not isinstance(source, (str, Path)):
        raise InputError(f"an exposure must be a path, an HDUList or a CCDData, got {type(source).__name__}")
    path = Path(source)
    if not path.is_file():
        raise InputError(f"{path}: {'is not a file' if path.exists() else 'no such file'}")
    try:
        with path.open("rb") as file, fits.open(file, memmap=False) as hdulist:
            return _from_hdulist(hdulist, ext, str(path), path)
    except InputError:
        raise
    except _UNREADABLE as error:
        raise InputError(f"{path}: cannot be read as FITS, damaged or something else ({error})") from None


def _from_hdulist(hdulist, ext, label, path):
    try:
        hdu = find_image(hdulist, ext, label)
        header = hdulist[0].header.copy()
        header.update(hdu.header)
        integer = hdu.header.get("BITPIX", -32) > 0  # before the data are touched: scaling changes it
        data = hdu.data
        if data is None or data.shape != hdu.shape:
            raise OSError("data incomplete")
        mask, uncertainty = _siblings(hdulist, hdu, header)
    except InputError:
        raise
    except _UNREADABLE as error:
        raise InputError(f"{label}: truncated or damaged, its image cannot be read ({error})") from None
    name = exposure_name(label, ext)
    try:
        wcs = believable_wcs(WCS(header, fobj=hdulist), hdu.shape, name)
    except Exception as error:  # wcslib raises many kinds; a header WCS is a hint, never a must
        logger.info("%s: WCS of the header not used: %s", name, error)
        wcs = None
    return _assemble(name, data, header, integer, mask=mask, uncertainty=uncertainty, wcs=wcs, path=path)


def _is_image(hdu):
    return isinstance(hdu, (fits.PrimaryHDU, fits.ImageHDU, fits.CompImageHDU)) and len(hdu.shape) > 0


def find_image(hdulist, ext, label):
    """The HDU to read (see `read_exposures`); `label` names the file in errors."""
    if ext is not None:
        try:
            hdu = hdulist[ext]
        except (KeyError, IndexError):
            present = ", ".join(f"{i} {h.name}".strip() for i, h in enumerate(hdulist))
            raise InputError(f"{label}: no extension {ext!r}; the file has {present}") from None
        candidates = [hdu] if _is_image(hdu) else []
    else:
        candidates = [hdu for hdu in hdulist if _is_image(hdu)]
        candidates.sort(key=lambda hdu: hdu.name != "SCI")  # stable: SCI first, else the order of the file
    for hdu in candidates:
        if len(hdu.shape) == 2:
            return hdu
    where = "" if ext is None else f" in extension {ext!r}"
    if candidates:
        raise InputError(f"{label}: no 2-D image{where}, the data have shape {candidates[0].shape}; choose one plane")
    raise InputError(f"{label}: no image{where}")


def _siblings(hdulist, hdu, header):
    """Mask and uncertainty that stand beside an image in the same file."""
    mask = uncertainty = None
    for other in hdulist:
        alike = other is not hdu and _is_image(other) and other.shape == hdu.shape and other.ver == hdu.ver
        if alike and other.name in MASK_NAMES:
            flags = np.asarray(other.data)
            do_not_use = header.get("TELESCOP", "") in ("JWST", "ROMAN") and flags.dtype.kind in "iu"
            mask = (flags & 1 if do_not_use else flags) != 0
        elif alike and other.name in UNCERTAINTY_NAMES:
            kind = str(other.header.get("UTYPE", UNCERTAINTY_NAMES[other.name]))  # CCDData writes its class as UTYPE
            with np.errstate(invalid="ignore", divide="ignore"):
                values = np.asarray(other.data, dtype=float)
                if kind.startswith("Variance"):
                    values = np.sqrt(values)
                elif kind.startswith("InverseVariance"):
                    values = 1 / np.sqrt(values)
                uncertainty = values
    return mask, uncertainty


def _from_ccddata(ccd, default):
    header = fits.Header(ccd.header)
    name = exposure_name(str(header.get("FILENAME", default)))
    uncertainty = None
    if ccd.uncertainty is not None:
        uncertainty = ccd.uncertainty.represent_as(StdDevUncertainty).array
    if ccd.unit is not None:
        header["BUNIT"] = ccd.unit.to_string()
    wcs = believable_wcs(ccd.wcs, np.shape(ccd.data), name) if isinstance(ccd.wcs, WCS) else None
    integer = ccd.data.dtype.kind in "iu"
    return _assemble(name, ccd.data, header, integer, mask=ccd.mask, uncertainty=uncertainty, wcs=wcs)


def _assemble(name, data, header, integer, **planes):
    known = {key: _number(header, keywords) for key, keywords in KEYWORDS.items()}
    # Detector readings are counts; calibrated data say in BUNIT that they are electrons, or electrons per second.
    unit = str(header.get("BUNIT", "")).lower().replace(" ", "")
    if re.fullmatch(r"(e-?|electrons?)", unit):
        known["gain"] = 1.0
    elif re.fullmatch(r"(e-?|electrons?)(/s(ec)?|s-1|s\*\*-1)", unit):
        known["gain"] = known["exposure_time"]
    if known["saturation"] is None and integer:
        known["saturation"] = _piled_up(data)
    return Exposure(name, data, header=header, **planes, **known)


def _number(header, keywords):
    """First positive number under one of the keywords, or None."""
    for key in keywords:
        value = header.get(key)
        if isinstance(value, (int, float)) and not isinstance(value, bool) and np.isfinite(value) and value > 0:
            return float(value)
    return None


def _piled_up(data):
    """Saturation level of integer data: a maximum more frequent than all of the 5 % below it together."""
    top = np.nanmax(data) if np.isfinite(data).any() else np.nan
    if not top > 0:
        return None
    at_top, below = np.count_nonzero(data == top), np.count_nonzero((data > 0.95 * top) & (data < top))
    return float(top) if at_top >= 5 and at_top > below and at_top < 0.1 * data.size else None


def _as_float(data, name):
    if data.ndim != 2:
        raise InputError(f"{name}: the data have shape {data.shape}, an exposure is one 2-D image")
    if data.dtype.kind in "iub":
        return data.astype(np.float32 if data.dtype.itemsize <= 2 else np.float64)
    if data.dtype.kind != "f":
        raise InputError(f"{name}: the data must be real numbers, got {data.dtype}")
    return data.astype(data.dtype.newbyteorder("="), copy=False)


def believable_wcs(wcs, shape, name=""):
    """The celestial part of a WCS, or None with a log entry if it is not to be believed.

    Believable is a WCS that has two celestial axes, a pixel scale in `PIXEL_SCALES` that is the same in x
    and y within a factor of two, its reference pixel within `REFERENCE_DISTANCE` frame sizes of the
    centre, and that maps corners and centre to the sky and back within 0.01 of the frame.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        As the header gives it.
    shape : tuple
        ``(ny, nx)``.
    name : str, optional
        For the log.
    """
    if not wcs.has_celestial:
        return None
    wcs = wcs.celestial
    ny, nx = shape
    scales = proj_plane_pixel_scales(wcs)
    corners = np.array([[0, 0], [nx - 1, 0], [0, ny - 1], [nx - 1, ny - 1], [(nx - 1) / 2, (ny - 1) / 2]])
    off_centre = np.abs(wcs.wcs.crpix - 1 - corners[-1]).max() / max(ny, nx)
    reason = None
    if not (scales.min() > PIXEL_SCALES[0] and scales.max() < PIXEL_SCALES[1] and scales.max() < 2 * scales.min()):
        reason = f"pixel scale {scales[0]:.3g}, {scales[1]:.3g} degrees"
    elif not off_centre < REFERENCE_DISTANCE:
        reason = f"reference pixel {off_centre:.0f} frame sizes off the centre"
    else:
        try:
            back = wcs.all_world2pix(wcs.all_pix2world(corners, 0), 0, quiet=True)
        except Exception as error:  # singular matrices and the like, raised by wcslib under many names
            reason = str(error)
        else:
            if not np.all(np.abs(back - corners) < 0.01 * max(ny, nx)):
                reason = "it does not map the corners to the sky and back"
    if reason:
        logger.info("%s: WCS of the header not used: %s", name, reason)
        return None
    return wcs
