"""Images that the tables of a list were measured in, by the headers that FITS_LDAC keeps of them (LDAC_IMHEAD)."""

import logging

import numpy as np
from astropy import units as u
from astropy.io import fits

from ...exceptions import InputError, some_of
from ...geometry.epochs import header_epoch
from ..exposure_names import detector_name
from ..file_images import cards_of_detector, detectors_of_headers, named_detector

log = logging.getLogger(__name__)


def read_header(hdu):
    """The header of an image in a table ``LDAC_IMHEAD``."""
    cards = np.asarray(hdu.data.field(0)).astype("S").ravel().tolist()
    return fits.Header.fromstring(b"".join(card.ljust(80) for card in cards))


def stated(header):
    """What is kept of the header of an image, for the ``meta`` of a table: size, detector and epoch where it has them.

    Returns
    -------
    dict
        ``shape``, [ny, nx]; ``cards``, those that may name a detector; ``epoch``, a Julian year.
    """
    size = [header.get(f"Z{key}", header.get(key)) for key in ("NAXIS2", "NAXIS1")]
    known = {"shape": size} if all(isinstance(n, int) and n > 0 for n in size) else {}
    year = header_epoch(header)
    return known | {"cards": cards_of_detector(header)} | ({} if year is None else {"epoch": year})


def detectors_of_tables(parts):
    """Ids of the detectors that the tables of a file are of, ``{number: id}``; empty where nothing tells.

    How it is told is logged.

    Parameters
    ----------
    parts : dict of Table
        By their numbers, with what is `stated` in ``meta["image"]``.
    """
    images = [table.meta.get("image") for table in parts.values()]
    if None in images:
        return {}
    headers = [fits.Header(_sized(image).items()) for image in images]
    ids, keyword = detectors_of_headers(headers)
    if ids:
        log.info(
            "%d tables %s to %s of a list are taken for the detectors of one camera, by %s", len(ids), ids[0], ids[-1],
            keyword,
        )  # fmt: skip
    return dict(zip(parts, ids, strict=True)) if ids else {}


def _sized(image):
    """The cards that are kept of an image, with its size."""
    return image["cards"] | dict(zip(("NAXIS2", "NAXIS1"), image.get("shape", ()), strict=False))


def detectors_by_frames(images, whole, ids, path):
    """Ids of the detectors of frames that the tables of one list are of: by their headers, else in their order.

    Parameters
    ----------
    images : dict of dict
        ``{name of the table: what is stated}``, in the order of the file.
    whole : str
        Name of the exposure.
    ids : list of str
        Detectors of its frames, in their order.
    path : str or path
        Of the list, for messages.

    Raises
    ------
    InputError
        Where headers name others, and the numbers of tables and detectors differ.
    """
    found = {name: named_detector(image["cards"], ids) for name, image in images.items()}
    if None not in found.values() and len(set(found.values())) == len(found):
        return found
    if len(images) == len(ids):
        log.info("tables of a list are taken for the detectors %s in this order", ", ".join(ids))
        return dict(zip(images, ids, strict=True))
    named = [f"{key} = {value}" for image in images.values() for key, value in image["cards"].items()]
    raise InputError(
        f"{path}: which detectors of {whole} ({some_of(ids, 6)}) its {len(images)} tables are of cannot be told: their "
        f"headers (LDAC_IMHEAD) have {some_of(named, 6) or 'nothing that names one'}; measure the files whose frames "
        "are given, with all their extensions"
    )


def with_own_dates(tables):
    """Tables of files with a column ``epoch`` by the headers of their images, if all lists state it and none has it.

    Parameters
    ----------
    tables : dict of Path to Table
    """
    images = {path: table.meta.get("images", {}) for path, table in tables.items()}
    if not all(map(len, images.values())) or any("epoch" in table.colnames for table in tables.values()):
        return tables
    if not all("epoch" in image for each in images.values() for image in each.values()):
        return tables
    log.info("dates of the lists are those of the headers of their images (LDAC_IMHEAD)")
    out = {}
    for path, table in tables.items():
        out[path] = table.copy(copy_data=False)
        years = {name: image["epoch"] for name, image in images[path].items()}
        out[path]["epoch"] = np.array([years[name] for name in names_of_rows(table)], dtype=float) * u.yr
    return out


def names_of_rows(table):
    """Names of the image (n,) that every row of a table is of: of the exposure, or the part of it one detector took."""
    exposure = np.asarray(table["exposure"]).astype(str).tolist()
    if "detector" not in table.colnames:
        return exposure
    return [detector_name(*pair) for pair in zip(exposure, np.asarray(table["detector"]).astype(str), strict=True)]
