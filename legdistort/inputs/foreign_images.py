"""Images that are no plain FITS: arrays in memory with what belongs to them (NDData), and the ASDF files of Roman."""

import io
import logging

import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.time import Time

from ..exceptions import DamagedError, InputError
from ..runtime.asdf_files import ARCHIVES, MAX_BYTES, open_checked
from ..runtime.checks import first_line
from ..runtime.guards.offline import offline
from .exposure_names import exposure_name
from .exposures import Exposure
from .file_images import as_plane
from .frames.cards import Stated
from .frames.pixel_flags import bad_pixels
from .frames.statement import read_statement
from .sky_wcs import believable_wcs

log = logging.getLogger(__name__)


def from_nddata(image, default, good=0):
    """`Exposure` of an `~astropy.nddata.NDData` or CCDData.

    Parameters
    ----------
    image : `~astropy.nddata.NDData`
        Its uncertainty must be one that standard deviations can be made of, or None; its WCS any that leads from pixels
        to the sky; its ``meta`` may be a header or anything else.
    default : str
        Name if it has no ``FILENAME``.
    good : int
        Flags of the mask, if that holds flags, that are no reason to leave a pixel out.

    Raises
    ------
    InputError
        For an uncertainty or a WCS of another kind.
    """
    header = _header(image.meta)
    name = exposure_name(str(header.get("FILENAME", default)))
    uncertainty = None
    if image.uncertainty is not None:
        try:
            uncertainty = image.uncertainty.represent_as(StdDevUncertainty).array
        except Exception as error:  # astropy raises what it likes
            raise InputError(
                f"{name}: the uncertainty, {type(image.uncertainty).__name__}, is none that standard deviations can be "
                f"made of ({first_line(error)}); give a StdDevUncertainty, VarianceUncertainty or InverseVariance"
            ) from None
    if image.unit is not None:
        header["BUNIT"] = image.unit.to_string()
    data = as_plane(np.asarray(image.data))
    uncertainty = None if uncertainty is None else as_plane(np.asarray(uncertainty))
    mask = None if image.mask is None else bad_pixels(as_plane(np.asarray(image.mask)), good)
    wcs = believable_wcs(image.wcs, data.shape, name)
    return Exposure(name, data, mask, uncertainty, wcs, header, **_known(header, data, wcs))


def _known(header, data, wcs):
    """What header and WCS state, as arguments of `Exposure`."""
    seen = None if wcs is None else Stated(type(wcs).__name__, "the WCS that came with it")
    return read_statement(header, data, integer=data.dtype.kind in "iu", wcs=wcs, seen=seen).known


def _header(meta):
    """Those items of a mapping that a FITS header can hold."""
    if isinstance(meta, fits.Header):
        return meta.copy()
    header = fits.Header()
    for key, value in dict(meta or {}).items():
        try:
            header[str(key)] = value
        except (ValueError, TypeError):
            log.debug("%s of the metadata does not fit into a header", key)
    return header


def is_nddata(image):
    """Whether something is an image of astropy's NDData family (a CCDData among others)."""
    return isinstance(image, CCDData) or (hasattr(image, "data") and hasattr(image, "uncertainty"))


@offline()
def read_roman(file, label, path, good=None):
    """`Exposure` of a Roman image (level 1 or 2) in an ASDF file, with its flags, errors and gwcs.

    Only public parts of the file are used (`roman.data`, `err`, `dq`, `meta`): roman_datamodels need not be installed.

    Parameters
    ----------
    file : binary file
    label : str
        How messages call it.
    path : `~pathlib.Path` or None
    good : int, optional
        Flags that are no reason to leave a pixel out; None: of all flags only DO_NOT_USE is one.

    Raises
    ------
    DamagedError
        For what is no ASDF file, or holds no image of Roman.
    InputError
        Where a package is missing that unpacks it.
    """
    try:
        allowed = max(MAX_BYTES, 2 * file.seek(0, io.SEEK_END))  # cubes of many reads are large
        file.seek(0)
        settings = {"tags": ARCHIVES, "max_bytes": allowed, "packings": ("zlib", "bzp2", "lz4"), "lazy_load": True}
        with open_checked(file, **settings) as opened:
            roman = opened.tree.get("roman")
            image = roman if hasattr(roman, "get") else {}
            planes = {key: as_plane(np.array(image[key])) for key in ("data", "err", "dq") if key in image}
            meta = _plain(image.get("meta") or {})
    except Exception as error:  # there is no end to what a broken file provokes
        if "lz4 library" in str(error):
            raise InputError(f"{label} is packed with lz4, which needs a package: pip install lz4") from None
        raise DamagedError(
            f"{label}: cannot be read as ASDF, damaged or something else ({first_line(error)})"
        ) from None
    if "data" not in planes:
        raise DamagedError(f"{label}: no image of Roman (no entry roman.data)")
    header = header_of_meta({"telescope": "ROMAN"} | meta)
    name, data = exposure_name(label), planes["data"]
    mask = bad_pixels(planes["dq"], good, do_not_use=True) if "dq" in planes else None
    wcs = meta.get("wcs")
    if wcs is not None and not hasattr(wcs, "pixel_to_world"):
        log.warning("%s: its WCS cannot be read: %s", name, "install gwcs and asdf-astropy")
        wcs = None
    wcs = believable_wcs(wcs, data.shape, name)
    return Exposure(name, data, mask, planes.get("err"), wcs, header, path=path, **_known(header, data, wcs))


def _plain(node):
    """A tree as dicts; asdf gives those of unknown tags as mappings of its own."""
    return {key: _plain(value) if hasattr(value, "items") else value for key, value in node.items()}


def header_of_meta(meta):
    """What a FITS header would contain for an image of Roman or JWST, by the ``meta`` of its data model."""
    exposure, instrument = meta.get("exposure") or {}, meta.get("instrument") or {}
    header = fits.Header()
    telescope = meta.get("telescope")
    named = {
        "TELESCOP": telescope,
        "INSTRUME": instrument.get("name") or ("WFI" if telescope == "ROMAN" else None),
        "DETECTOR": instrument.get("detector"),
        "FILTER": instrument.get("optical_element"),
    }
    for key, value in named.items():
        if value is not None:
            header[key] = str(value)
    times = [exposure.get(key) for key in ("exposure_time", "effective_exposure_time")]
    header["EXPTIME"] = next((float(t) for t in times if isinstance(t, (int, float)) and t > 0), 0.0)
    start = exposure.get("start_time")
    if isinstance(start, (int, float)):  # of JWST
        header["MJD-OBS"] = start
    elif start is not None:
        try:
            header["DATE-OBS"] = Time(start).utc.isot
        except ValueError:
            log.debug("start time %r is not understood", start)
    return header
