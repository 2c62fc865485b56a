"""Several detectors in one file: which images belong to an exposure, and what the detectors are called."""

from dataclasses import replace

from .exposure_names import detector_name

#: Header keywords that tell detectors apart, in order of preference.
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


def of_detector(exposure, ext, key):
    """An exposure that was read from one of several images of a file, named after its detector."""
    frame = exposure.name.removesuffix(f"_{''.join(map(str, ext))}")
    return replace(exposure, name=detector_name(frame, key), frame=frame, detector=key)
