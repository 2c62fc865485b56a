"""An `Exposure` from an open FITS file: its image, the planes beside it, and what its headers state."""

import contextlib
import logging
import zlib
from dataclasses import replace

import numpy as np
from astropy.io import fits

from ..exceptions import DamagedError, InputError
from ..runtime.asdf_files import ARCHIVES, read_tree
from .exposure_names import exposure_name
from .exposures import Exposure
from .file_images import find_image, is_image, named_images, plane_shape
from .frames.cards import Stated
from .frames.pixel_flags import bad_pixels, descriptive_flags
from .frames.statement import read_statement
from .frames.wcs_cards import header_of_image, is_left_out, make_numbers, two_matrices
from .frames.weight_maps import NO_WEIGHT, bad_and_sky_errors, doubt_of_rms
from .sky_wcs import believable_wcs, header_wcs

log = logging.getLogger(__name__)

#: Names of extensions that belong to an image, and how their values become standard deviations.
UNCERTAINTY_NAMES = {"ERR": "StdDev", "UNCERT": "StdDev", "VAR": "Variance", "VARIANCE": "Variance"}
MASK_NAMES = ("DQ", "MASK")
_UNREADABLE = (OSError, EOFError, TypeError, ValueError, KeyError, IndexError, zlib.error, fits.VerifyError)


@contextlib.contextmanager
def told_as_damaged(label):
    """Whatever a damaged file provokes, as a `DamagedError` that begins with its name."""
    try:
        yield
    except InputError:
        raise
    except _UNREADABLE as error:
        raise DamagedError(f"{label}: truncated or damaged, its image cannot be read ({error})") from None


def from_hdulist(hdulist, ext, label, path, good=None):
    """The `Exposure` of an image of a file, see `legdistort.read_exposures`; `label` names the file in errors."""
    with told_as_damaged(label):
        hdu = find_image(hdulist, ext, label)
        primary, own = hdulist[0].header, hdu.header
        header = header_of_image(primary, own)
        lacking = make_numbers(header, label)
        integer = own.get("BITPIX", -32) > 0  # before the data are touched: scaling changes it
        _refuse_other_shapes(hdulist, hdu, label)
        planes = planes_of(hdulist, hdu, good)
    name, shape = exposure_name(label, ext), plane_shape(hdu)
    known, wcs, origin = {}, None, None
    tables = [other for other in hdulist if other.name == "ASDF"]
    if len(tables) == 1:
        owner = tables[0].header.get("EXPNAME")
        if path is not None:
            known["has_gwcs"] = owner is None or named_images(hdulist, path).get(owner) is hdu
        if owner is None and header.get("TELESCOP") == "JWST":
            wcs = _gwcs_of(tables[0], name, shape)
            origin = None if wcs is None else Stated("gwcs", "extension ASDF")
    if wcs is None and not lacking:
        wcs = header_wcs(header, hdulist, shape, name)
    stated = read_statement(
        header, planes["data"], integer=integer, own=None if hdu is hdulist[0] else own, wcs=wcs,
        seen=origin or _wcs_in_words(wcs, header, own), mask=_masks_in_words(hdulist, hdu, good),
    )  # fmt: skip
    if lacking:
        stated = stated.with_doubt(f"the WCS of the header has no card {lacking} and is not used")
    if not lacking and origin is None and (words := two_matrices(header)):
        stated = stated.with_doubt(words)
    if is_left_out(primary, own):
        stated = stated.with_doubt(
            "the primary header has a WCS, the image none, and not INHERIT = T: it is not that of the image and is not "
            "used; if it is, write INHERIT = T into the header of the image"
        )
    return Exposure(name, **planes, header=header, wcs=wcs, path=path, **known, **stated.known)


def _wcs_in_words(wcs, header, own):
    """The WCS of a header and where it stands, as `Stated`."""
    if wcs is None:
        return Stated(None, "no celestial WCS that is plausible")
    projection = ", ".join(str(header.get(f"CTYPE{k}", "")) for k in (1, 2))
    return Stated(projection, "CTYPE1" if "CTYPE1" in own else "CTYPE1 of the primary header, by INHERIT = T")


def _has_do_not_use(hdulist, hdu):
    """Whether one bit of the flags beside an image states that a pixel is not to be used."""
    return hdu.header.get("TELESCOP", hdulist[0].header.get("TELESCOP", "")) in ("JWST", "ROMAN")


def _masks_in_words(hdulist, hdu, good):
    """The planes of flags beside an image, as `Stated`."""
    beside = [other for other in _alike(hdulist, hdu) if other.name in MASK_NAMES]
    if not beside:
        return Stated(None, "no plane of flags")
    names = descriptive_flags(beside[-1].header)
    words = f"without {', '.join(f'{name} ({bit})' for name, bit in names.items())}" if names else "of all flags"
    words = "of the flag DO_NOT_USE" if not names and _has_do_not_use(hdulist, hdu) else words
    words = f"without flags {good}" if good is not None and not names else words
    return Stated(words, f"plane {beside[-1].name}")


def _gwcs_of(table, name, shape):
    """The gwcs at ``meta.wcs`` of the table in which JWST keeps the data model of a file, if that can be read."""
    try:
        content = np.asarray(table.data["ASDF_METADATA"]).tobytes()
        tree = read_tree(f"{name}[ASDF]", content=content, tags=ARCHIVES)
    except (InputError, *_UNREADABLE) as error:
        log.warning("the gwcs of %s cannot be read, the WCS of its header is taken: %s", name, error)
        return None
    wcs = (tree.get("meta") or {}).get("wcs")
    if not hasattr(wcs, "pixel_to_world"):  # none in _rate files; a mapping where a package is missing
        if wcs is not None:
            log.warning("the gwcs of %s needs a package that is not there (stdatamodels); its header is taken", name)
        return None
    return believable_wcs(wcs, shape, name)


def planes_of(hdulist, hdu, good=None):
    """Data of an image, and the mask and uncertainty that stand beside it in the same file."""
    blank = hdu.header.get("BLANK") if hdu.header.get("BITPIX", -32) < 0 else None  # of integers astropy makes NaN
    data = hdu.data
    if data is None or data.shape != hdu.shape:
        raise OSError("data incomplete")
    data = data.reshape(plane_shape(hdu))
    if isinstance(blank, int) and (blanks := data == blank).any():  # of a frame that was made of an integer one
        data = np.where(blanks, data.dtype.type(np.nan), data)
    planes = {"data": data}
    for other in _alike(hdulist, hdu):
        if other.name in MASK_NAMES:
            flags, described = other.data.reshape(data.shape), sum(descriptive_flags(other.header).values())
            kept = (good or 0) | described if described or good is not None else None
            planes["mask"] = bad_pixels(flags, kept, do_not_use=_has_do_not_use(hdulist, hdu))
        elif other.name in UNCERTAINTY_NAMES:
            kind = str(other.header.get("UTYPE", UNCERTAINTY_NAMES[other.name]))  # CCDData writes its class as UTYPE
            with np.errstate(invalid="ignore", divide="ignore"):
                values = np.asarray(other.data, dtype=float).reshape(data.shape)
                if kind.startswith("Variance"):
                    values = np.sqrt(values)
                elif kind.startswith("InverseVariance"):
                    values = 1 / np.sqrt(values)
                planes["uncertainty"] = values
    return planes


def with_weights(exposure, weights, kind):
    """An exposure with what a weight map says of its pixels.

    Pixels without weight are bad. Noise that differs from pixel to pixel becomes the uncertainty, if there is none yet
    and the gain is known: that of the sky by the map, and that of the light above it by the gain, as in SExtractor.

    Parameters
    ----------
    exposure : Exposure
    weights : ndarray, shape (ny, nx)
    kind : str
        One of `legdistort.inputs.frames.weight_maps.KINDS`.

    Returns
    -------
    exposure : Exposure
    doubt : str
        What is doubtful about the map, or not used of it; empty if nothing is.
    """
    bad, errors = bad_and_sky_errors(weights, kind, exposure.data, exposure.mask)
    planes = {"mask": exposure.mask | bad, "uncertainty": exposure.uncertainty}
    if errors is not None and exposure.uncertainty is None and exposure.gain:
        light = np.maximum(exposure.data - np.median(exposure.data[~planes["mask"]]), 0)
        planes["uncertainty"] = np.sqrt(errors**2 + light / exposure.gain)
    doubt = "" if errors is None or kind != "MAP_RMS" else doubt_of_rms(exposure.data, errors, planes["mask"])
    if errors is not None and planes["uncertainty"] is None:
        doubt = "no gain is stated, so that of the weight map only pixels without weight are used, not their noise"
    return replace(exposure, **planes), doubt


def with_weights_stated(exposure, path, doubt):
    """An exposure with a weight map, whose statement names the map, and what is doubtful about it."""
    before = exposure.stated.mask
    words = [before.value, NO_WEIGHT] if before.value else [NO_WEIGHT]
    source = f"{before.source}, {path.name}" if before.value else path.name
    stated = replace(exposure.stated, mask=Stated(" and ".join(words), source))
    return replace(exposure, stated=stated.with_doubt(doubt) if doubt else stated)


def _alike(hdulist, hdu):
    """The other images of the shape and version of one."""
    shape = plane_shape(hdu)
    return [
        other
        for other in hdulist
        if other is not hdu and is_image(other) and plane_shape(other) == shape and other.ver == hdu.ver
    ]


def _refuse_other_shapes(hdulist, hdu, label):
    """Raise `InputError` for a plane of flags or errors of the version of an image that has the shape of no image."""
    same = [other for other in hdulist if is_image(other) and other.ver == hdu.ver]
    shapes = {plane_shape(other) for other in same if not _is_plane(other)}
    for other in filter(_is_plane, same):
        if other is not hdu and plane_shape(other) not in shapes:
            named = f"{other.name},{other.ver}" if other.ver != 1 else other.name
            raise InputError(
                f"{label}: the plane {named} has the shape {plane_shape(other)}, the image {plane_shape(hdu)} "
                "(ny, nx): write it in the shape of the image, or remove or rename it"
            )


def _is_plane(hdu):
    return hdu.name in MASK_NAMES or hdu.name in UNCERTAINTY_NAMES
