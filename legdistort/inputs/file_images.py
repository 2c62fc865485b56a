"""Which images a FITS file holds: of the sky, of the detectors of a camera, and the planes that stand beside them."""

import contextlib
import logging
import re
from dataclasses import replace
from fnmatch import fnmatchcase
from types import SimpleNamespace

from astropy.io import fits

from ..exceptions import DamagedError, InputError
from .exposure_names import detector_name, exposure_name, in_header

log = logging.getLogger(__name__)

#: Header keywords that distinguish detectors, in order of preference.
KEYWORDS = ("CCDCHIP", "DETECTOR", "CHIP", "EXTVER", "EXTNAME")
#: The same and those by which images of one file are told apart where no other does, as in frames of Gemini.
_OF_ONE_FILE = *KEYWORDS, "FRAMEID", "CCDNAME"
#: Words in the names of extensions that are no images of the sky but stand beside one: errors, masks, weights, times,
#: backgrounds, and the look-up tables of a WCS, as the archives of HST, JWST, ESO, NOIRLab and Astropy name them.
_BESIDE = {
    "ERR", "ERROR", "ERRORS", "UNCERT", "UNCERTAINTY", "VAR", "VARIANCE", "IVAR", "INVVAR", "STAT", "STDDEV",
    "SIGMA", "RMS", "NOISE", "DQ", "PIXELDQ", "GROUPDQ", "MASK", "BPM", "FLAG", "FLAGS", "QUAL", "QUALITY", "WHT",
    "WEIGHT", "WEIGHTS", "CON", "CTX", "CONTEXT", "CONFIDENCE", "COVERAGE", "FOOTPRINT", "EXP", "EXPTIME", "EXPMAP",
    "TIME", "SAMP", "EXTRAPOLATED", "REJECTED", "AREA", "BKG", "BACKGROUND", "SKY", "PSF", "PSFIMAGE", "WCSDVARR",
    "D2IMARR",
}  # fmt: skip
#: Images of a file that a message names.
_MOST_NAMED = 8


def _numbered(hdulist):
    """``{number: HDU}`` of the images of a file, a sequence of HDUs."""
    return {i: hdu for i, hdu in enumerate(hdulist) if is_image(hdu)}


def _named(images, ext):
    """Those of ``{number: HDU}`` with the name asked for; by a pattern, those that are of the sky."""
    if not isinstance(ext, str):
        return {}
    asked = ext.strip().upper()
    named = {i: hdu for i, hdu in images.items() if hdu.name == asked}
    if named or not is_pattern(ext):
        return named
    return {i: hdu for i, hdu in images.items() if fnmatchcase(hdu.name, asked) and not _stands_beside(hdu.name)}


def is_pattern(ext):
    """Whether an extension asked for is a pattern for names, such as ``IM*``."""
    return isinstance(ext, str) and any(sign in ext for sign in "*?[")


def _forms(named):
    """``{number: extension}`` of images: by name and ``EXTVER``, or by number where these repeat."""
    distinct = len({(hdu.name, hdu.ver) for hdu in named.values()}) == len(named)
    return {i: (hdu.name, hdu.ver) if distinct else i for i, hdu in named.items()}


def detector_ids(headers, keywords=KEYWORDS):
    """Ids of the detectors of one exposure by the first keyword that all headers have with values of their own.

    None if there is no such keyword.
    """
    for keyword in keywords:
        values = [header.get(keyword) for header in headers]
        if None not in values and len(set(values)) == len(values):
            return [str(value).strip() for value in values]
    return None


def _parts(named):
    """``[(extension, id)]`` of several images ``{number: HDU}`` of one name; by their order where nothing has ids."""
    forms = _forms(named)
    versions = [form[1] if isinstance(form, tuple) else k for k, form in enumerate(forms.values(), 1)]
    ids = detector_ids([hdu.header for hdu in named.values()], _OF_ONE_FILE) or list(map(str, versions))
    return list(zip(forms.values(), ids, strict=True))


def images_of_detectors(files, ext):
    """What an extension name stands for in several files: their image, or those of the detectors of a camera.

    Parameters
    ----------
    files : list of list of HDU
        All of every file.
    ext : int, str, (str, int) or None
        The extension asked for; a name, or a pattern for names, may stand for the images of several detectors, and none
        for those that are told to be detectors (`detectors_of`), which is logged.

    Returns
    -------
    list of list
        ``[(extension, id)]`` for every file; the id is None where it has but one image and no other file has several.
    """
    single, files = [[(ext, None)] for _ in files], list(map(_numbered, files))
    if ext is None and (told := [found for images in files if (found := detectors_of(images.values()))]):
        ext, keyword = told[0]
        most = max((list(_named(images, ext).values()) for images in files), key=len)
        which = f"images {most[0].name} to {most[-1].name}" if ext else "images without a name"
        log.info("%d %s in a file are taken for the detectors of one camera, by %s", len(most), which, keyword)
    if not isinstance(ext, str):
        return single
    found, known = [], set()
    for images in files:
        named = _named(images, ext)
        found.append(_parts(named) if len(named) > 1 else [])
        known |= {key for _, key in found[-1]}
    for k, images in enumerate(files):
        if len(_named(images, ext)) == 1:  # an exposure that lacks the other detectors
            found[k] = [part for part in _every_id(images, ext) if part[1] in known][:1]
    return [parts or one for parts, one in zip(found, single, strict=True)]


def detectors_of(images):
    """What tells that images are the detectors of one camera: their name or pattern, and the keyword; None if nothing.

    They are alike but for a number in their names (``IM1``, ``IM2``), or have none, as raw frames of Gemini, and each
    has a section of the array, ``DETSEC``, of its own; for numbered ones ``CCDNAME`` or ``DETECTOR`` do as
    well. The amplifiers of one detector, which have a section each too, share its ``CCDNAME``.
    """
    images = [hdu for hdu in images if not _stands_beside(hdu.name)]
    name = _common_name(images)
    if name is None or len({plane_shape(hdu) for hdu in images}) > 1:
        return None
    cards = {key: [hdu.header.get(key) for hdu in images] for key in ("DETSEC", "CCDNAME", "DETECTOR")}
    own = [key for key, each in cards.items() if None not in each and len(set(each)) == len(images)]
    if cards["CCDNAME"][0] is not None and "CCDNAME" not in own:
        return None
    own = own if name else [key for key in own if key == "DETSEC"]
    return (name, own[0]) if own else None


def detectors_of_headers(headers):
    """Ids of the detectors of one exposure by the headers of its images alone, as those of a file have them.

    Parameters
    ----------
    headers : list of Header
        Of images that were all asked for.

    Returns
    -------
    list of str
        Empty where they are not told to be detectors: neither by `detectors_of`, nor by one name for all and a keyword
        that tells them apart.
    str
        The keyword that tells it.
    """
    images = [
        SimpleNamespace(
            name=str(h.get("EXTNAME", "")).strip().upper(), ver=h.get("EXTVER", 1), header=h,
            shape=tuple(h.get(f"NAXIS{k}", 0) for k in (2, 1)),
        )
        for h in headers
    ]  # fmt: skip
    if len(images) < 2 or any(_stands_beside(image.name) for image in images):
        return [], ""
    told = detectors_of(images)
    if told is None and len({image.name for image in images}) == 1 and images[0].name:
        keyword = next((key for key in KEYWORDS if detector_ids(headers, [key])), None)
        told = None if keyword is None else (images[0].name, keyword)
    return ([], "") if told is None else ([key for _, key in _parts(dict(enumerate(images)))], told[1])


def named_detector(header, ids):
    """Which of the ids of detectors a header has by a keyword that may hold them, the first that does; else None."""
    stated = (str(header.get(key, "")).strip() for key in _OF_ONE_FILE)
    return next((each for each in stated if each and each in ids), None)


def cards_of_detector(header):
    """The cards of a header that may name its detector: ``{keyword: value}``."""
    return {key: header[key] for key in ("DETSEC", *_OF_ONE_FILE) if isinstance(header.get(key), (str, int))}


def _common_name(images):
    """Pattern for names of images that differ by a number at their end, "" if none has a name; else None."""
    names = [hdu.name for hdu in images]
    stems = {name.rstrip("0123456789") for name in names}
    if len(names) < 2 or len(stems) > 1:
        return None
    if set(names) == {""}:
        return ""
    stem = stems.pop()
    return f"{stem}[0-9]*" if stem and stem not in names and len(set(names)) == len(names) else None


def _every_id(images, ext):
    """``[(extension, id)]`` of the images ``{number: HDU}`` of that name, with each id that a detector may have."""
    named = _named(images, ext)
    forms = _forms(named)
    values = [
        (forms[i], str(hdu.header.get(keyword, "")).strip()) for keyword in _OF_ONE_FILE for i, hdu in named.items()
    ]
    return [part for part in values if part[1]]


def of_detector(exposure, ext, key):
    """An exposure that was read from one of several images of a file, named after its detector."""
    parts = ext if isinstance(ext, tuple) else (ext,)
    whole = exposure.name.removesuffix(f"_{''.join(map(str, parts))}")
    return replace(exposure, name=detector_name(whole, key), exposure=whole, detector=key)


def extension_names(hdulist, path):
    """``{name of an exposure: extension}`` for every way to name an extension of a file, and for none."""
    names = {exposure_name(path): None}
    for i, hdu in enumerate(hdulist):
        forms = (i, hdu.name, (hdu.name, hdu.ver)) if hdu.name else (i,)
        names |= {exposure_name(path, form): form for form in forms}
    return names


def detector_names(hdulist, path, ext=None):
    """``{name of an exposure: extension}`` for every way to name the detectors of a file, of one extension or all."""
    images = {i: hdu for i, hdu in _numbered(hdulist).items() if not _stands_beside(hdu.name)}
    kinds = {hdu.name for hdu in images.values()} if ext is None else {ext}
    if ext is None and (told := detectors_of(images.values())):
        kinds = *kinds, told[0]
    forms = [part for kind in kinds for part in _every_id(images, kind) + _parts(_named(images, kind))]
    return {detector_name(exposure_name(path), key): form for form, key in forms}  # the last, as they are read


def named_images(hdulist, path):
    """``{name of an exposure, as headers hold it: HDU}`` for every name that an image of a file can have."""
    found = {}
    for name, ext in (extension_names(hdulist, path) | detector_names(hdulist, path)).items():
        with contextlib.suppress(InputError):
            found[in_header(name)] = find_image(hdulist, ext, str(path), of_several=True)
    return found


def planes_beside(hdulist, image):
    """HDUs of errors, flags, weights beside an image: of its shape and ``EXTVER``, and of no other image."""
    alike = [
        hdu for hdu in hdulist if is_image(hdu) and plane_shape(hdu) == plane_shape(image) and hdu.ver == image.ver
    ]
    planes = [hdu for hdu in alike if hdu is not image and _stands_beside(hdu.name)]
    return planes if len(planes) == len(alike) - 1 else []


def weight_number(weights, hdulist, image, paths):
    """Number of the extension of a weight map that belongs to an image of a file.

    That of the same name and version, or at the same place in the file, or the only one.

    Parameters
    ----------
    weights, hdulist : HDUList
        The map, and the file of the image.
    image : HDU
        One of `hdulist`.
    paths : tuple
        Their names, for the message.

    Raises
    ------
    InputError
        Where the map has none, or it has another shape.
    """
    images = {i: hdu for i, hdu in enumerate(weights) if is_image(hdu)}
    place = next(i for i, hdu in enumerate(hdulist) if hdu is image)
    named = [i for i, hdu in images.items() if hdu.name and (hdu.name, hdu.ver) == (image.name, image.ver)]
    several = sum(is_image(hdu) and hdu.name == image.name for hdu in hdulist) > 1
    number = (named or [i for i in images if i == place or (len(images) == 1 and not several)] or [None])[0]
    if number is None:
        form = f"{image.name},{image.ver}" if image.name else place
        raise InputError(
            f"the weight map {paths[0]} has no image for extension {form} of {paths[1]}: give it the same extensions, "
            "or read no maps, weight_maps='none' (--weight-maps none)"
        )
    if plane_shape(images[number]) != plane_shape(image):
        raise InputError(
            f"the weight map {paths[0]} has the shape {plane_shape(images[number])}, the image {paths[1]} "
            f"{plane_shape(image)} (ny, nx): give it that of the image, or read no maps, weight_maps='none' "
            "(--weight-maps none)"
        )
    return number


def is_image(hdu):
    """Whether an HDU is an image that has pixels."""
    return isinstance(hdu, (fits.PrimaryHDU, fits.ImageHDU, fits.CompImageHDU)) and len(hdu.shape) > 0


def plane_shape(image):
    """Shape ``(ny, nx)`` of an HDU or array whose further axes have one pixel each (``NAXIS3 = 1``), else its own."""
    shape = tuple(image.shape)
    return shape[-2:] if all(n == 1 for n in shape[:-2]) else shape


def as_plane(data):
    """An array without the axes of one pixel before the last two."""
    return data.reshape(plane_shape(data))


def find_image(hdulist, ext, label, *, of_several=False):
    """The HDU to read (see `read_exposures`), `of_several` images the first; `label` names the file in errors."""
    where = "" if ext is None else f" in extension {ext!r}"
    if ext is not None:
        try:
            matching = list(_named(_numbered(hdulist), ext).values()) if is_pattern(ext) else []
            candidates = matching or [hdulist[ext]]
        except (KeyError, IndexError):
            present = ", ".join(f"{i} {h.name}".strip() for i, h in enumerate(hdulist))
            told = detectors_of([hdu for hdu in hdulist if is_image(hdu)])
            have = "are numbered" if told and told[0] else "have no name"
            cure = f"; its images {have}: leave ext (--ext) out to read all detectors" * (told is not None)
            raise DamagedError(f"{label}: no extension {ext!r}; the file has {present}{cure}") from None
        candidates = [hdu for hdu in candidates if is_image(hdu)]
    else:
        every = [hdu for hdu in hdulist if is_image(hdu)]
        science = [hdu for hdu in every if hdu.name == "SCI"]
        candidates = science or [hdu for hdu in every if not _stands_beside(hdu.name)] or every
    if not candidates:
        raise DamagedError(f"{label}: no image{where}")
    images = [hdu for hdu in candidates if len(plane_shape(hdu)) > 1]
    if len(images) > 1 and of_several:
        images.sort(key=lambda hdu: len(plane_shape(hdu)))  # stable: 2-D before cubes, else the order of the file
    elif len(images) > 1:
        raise InputError(f"{label} holds {_listed_images(hdulist, images)}")
    if not images or len(plane_shape(images[0])) > 2:
        shape = (images or candidates)[0].shape
        words = "choose one plane, and give it as a file of its own"
        raise InputError(f"{label}: no 2-D image{where}, the data have shape {shape}; {words}")
    return images[0]


def _stands_beside(name):
    """Whether an extension is by its name (``ERR``, ``VAR_POISSON``, ``CHIP1.DQ``, ``WHT2``) no image of the sky."""
    words = re.split(r"[^A-Z0-9]+", name.upper())
    return any(word in _BESIDE or word.rstrip("0123456789") in _BESIDE for word in words)


def _listed_images(hdulist, images):
    """How many images there are, which, and how to choose one."""
    numbers = [str(i) for i, hdu in enumerate(hdulist) if any(hdu is image for image in images)]
    forms = [f"{hdu.name},{hdu.ver}" if hdu.name else i for i, hdu in zip(numbers, images, strict=True)]
    if len(set(forms)) < len(forms):
        forms = numbers
    named = [f"{form} {hdu.shape}" for form, hdu in zip(forms, images, strict=True)][:_MOST_NAMED]
    more = f" and {len(images) - _MOST_NAMED} more" * (len(images) > _MOST_NAMED)
    name, comma, version = forms[0].partition(",")
    python = f"({name!r}, {version})" if comma else name
    listed_so = f"{len(images)} images, {', '.join(named)}{more} (ny, nx)"
    advice = f"choose one, such as ext={python} (--ext {forms[0]})"
    every = images[0].name if len({hdu.name for hdu in images}) == 1 else _common_name(images)
    if every is not None:
        quoted = every if every.isalnum() else repr(every)
        advice += f", or take all as the detectors of one camera, ext={every!r} (--ext {quoted})"
    return f"{listed_so}: {advice}"
