"""Several detectors in one file: which images belong to an exposure, and what the detectors are called."""

import re
from dataclasses import replace

from ..exceptions import InputError
from .exposure_names import detector_name

#: Header keywords that distinguish detectors, in order of preference.
KEYWORDS = ("CCDCHIP", "DETECTOR", "CHIP", "EXTVER", "EXTNAME")


def detector_ids(headers):
    """Ids of the detectors of one exposure by the first keyword that all headers have with values of their own.

    None if there is no such keyword.
    """
    for keyword in KEYWORDS:
        values = [header.get(keyword) for header in headers]
        if None not in values and len(set(values)) == len(values):
            return [str(value).strip() for value in values]
    return None


def images_of_detectors(files, ext):
    """What an extension name stands for in several files: their image, or those of the detectors of a camera.

    Parameters
    ----------
    files : list of list of HDU
        The images of every file.
    ext : int, str, (str, int) or None
        The extension asked for; a name may stand for the images of several detectors.

    Returns
    -------
    list of list
        ``[(extension, id)]`` for every file; the id is None where it has but one image and no other file has several.
    """
    single = [[(ext, None)] for _ in files]
    if not isinstance(ext, str):
        return single
    named = [[hdu for hdu in images if hdu.name == ext.strip().upper()] for images in files]
    found, known = [], set()
    for each in named:
        versions = [hdu.ver for hdu in each]
        several = len(set(versions)) == len(each) > 1
        ids = (detector_ids([hdu.header for hdu in each]) or list(map(str, versions))) if several else []
        found.append([((ext, version), key) for version, key in zip(versions, ids, strict=False)])
        known |= set(ids)
    for k, images in enumerate(files):
        if len(named[k]) == 1:  # an exposure that lacks the other detectors
            found[k] = [part for part in every_id(images, ext) if part[1] in known][:1]
    return [parts or one for parts, one in zip(found, single, strict=True)]


def every_id(images, ext):
    """``[(extension, id)]`` of the images of that extension name, with each id that a detector may have."""
    named = [hdu for hdu in images if isinstance(ext, str) and hdu.name == ext.strip().upper()]
    values = [((ext, hdu.ver), str(hdu.header.get(keyword, "")).strip()) for keyword in KEYWORDS for hdu in named]
    return [part for part in values if part[1]]


def of_files(exposures, ids):
    """Exposures whose detectors are in files of their own, with `frame` and `detector`.

    The detector is that of `ids` which the header names (`KEYWORDS`), the frame the name of the file without it.

    Parameters
    ----------
    exposures : list of Exposure
    ids : iterable of str

    Raises
    ------
    InputError
        For a header that names none of the detectors, or a file name that does not have it.
    """
    known, out = {key.lower(): key for key in ids}, []
    for exposure in exposures:
        if exposure.detector is not None:
            out.append(exposure)
            continue
        values = [str(exposure.header.get(keyword, "")).strip().lower() for keyword in KEYWORDS]
        key = next((known[value] for value in values if value in known), None)
        if key is None:
            raise InputError(
                f"the header of {exposure.name} names none of the detectors {', '.join(known.values())} "
                f"({', '.join(KEYWORDS)}): read all extensions of a file by their name (ext='SCI', --ext SCI), or "
                "correct the ids of the camera"
            )
        frame = re.sub(
            rf"[-_.]?(?<![A-Za-z0-9]){re.escape(key)}(?![A-Za-z0-9])", "", exposure.name, flags=re.IGNORECASE
        )
        if frame in ("", exposure.name):
            raise InputError(
                f"{exposure.name} is of detector {key}, which its name does not say: files of one exposure are those "
                f"with one name but for the detector, such as {exposure.name}_{key}; rename them"
            )
        out.append(replace(exposure, frame=frame, detector=key))
    return out


def of_detector(exposure, ext, key):
    """An exposure that was read from one of several images of a file, named after its detector."""
    frame = exposure.name.removesuffix(f"_{''.join(map(str, ext))}")
    return replace(exposure, name=detector_name(frame, key), frame=frame, detector=key)
