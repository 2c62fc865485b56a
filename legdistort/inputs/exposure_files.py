"""Images from FITS files, HDU lists, NDData and others: read at once, or when their pixels are needed."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import logging
import re
import threading
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from ..exceptions import (
    AssumptionWarning,
    DamagedError,
    InputError,
    reasons_of,
    some_of,
    warn,
    without_astropy_warnings,
)
from ..runtime.checks import check_is_file
from ..runtime.fits_bytes import open_fits, readable
from ..runtime.locks import way_back
from ..runtime.notebook import ShownAsPrinted
from ..runtime.progress import Bar
from ..runtime.provenance import checksum, unchanged
from . import repetitions
from .detector_files import with_detectors
from .exposure_names import detector_name, exposure_name, file_names, folder_marks, folders_in_words, marked
from .exposures import LEAVE_OUT, Exposure
from .file_images import as_plane, find_image, images_of_detectors, is_image, of_detector, weight_number
from .fits_images import from_hdulist, planes_of, told_as_damaged, with_weights, with_weights_stated
from .foreign_images import from_nddata, is_nddata, read_roman
from .frames.pixel_flags import good_bits
from .frames.weight_maps import WeightMaps, WeightPlane
from .sky_wcs import said_once

if TYPE_CHECKING:
    from astropy.wcs.wcsapi import BaseHighLevelWCS

    from ..runtime.annotations import Extension, Images
    from .frames.statement import FrameStatement

log = logging.getLogger(__name__)

_FILTERS = threading.Lock()  # warning filters belong to the process, not to the thread that changes them
_NO_FRAME = "tables of positions go to match(table) (legdistort match)"


@dataclass(frozen=True, eq=False, repr=False)
class ExposureFile(ShownAsPrinted):
    """What is known about an image whose pixels are in its file.

    Attributes
    ----------
    name, wcs, header, saturation, gain, read_noise, exposure_time, path
        As those of the `Exposure`; so are `has_gwcs`, `exposure`, `detector` and `stated`.
    shape : tuple
        ``(ny, nx)``.
    checksum, pixels : str
        SHA-256 of the file and of its image alone, in hexadecimal digits.
    identity : tuple
        Of the file as it was read then, see `legdistort.runtime.provenance.identity`.
    ext : int, str, (str, int) or None
        The extension asked for.
    dq_good : int or None
        Flags that are no reason to leave a pixel out.
    weights : WeightPlane or None
        Of the weight map beside it.
    """

    name: str
    shape: tuple[int, int]
    wcs: BaseHighLevelWCS | None
    header: fits.Header
    saturation: float | None
    gain: float | None
    read_noise: float | None
    exposure_time: float | None
    path: Path
    checksum: str
    pixels: str
    identity: tuple[Any, ...]
    ext: Extension | None = None
    has_gwcs: bool = False
    dq_good: int | None = None
    exposure: str | None = None
    detector: str | None = None
    stated: FrameStatement | None = None
    weights: WeightPlane | None = None

    def read(self) -> Exposure:
        """The `Exposure` with its pixels; what else is known is not worked out again.

        Raises
        ------
        InputError
            If the file is gone, or holds anything else than it did.
        """
        with unchanged(self.path) as (found,):
            _check_content(self.path, found, self)
            if _is_asdf(self.path):
                with _quiet(), _file(self.path) as file:
                    image = read_roman(file, str(self.path), self.path, self.dq_good)
                planes = {name: getattr(image, name) for name in ("data", "mask", "uncertainty")}
            else:
                with _quiet(), _opened(self.path) as hdulist, told_as_damaged(self.path):
                    planes = planes_of(hdulist, find_image(hdulist, self.ext, self.path), self.dq_good)
        exposure = Exposure(**{name: getattr(self, name) for name in _SHARED}, **planes)
        if self.weights is None:
            return exposure
        with unchanged(self.weights.path) as (found,), _quiet(), _opened(self.weights.path) as hdulist:
            _check_content(self.weights.path, found, self.weights)
            return _with_weights(exposure, hdulist, self.weights)[0]

    def __repr__(self):
        return f"<ExposureFile {self.name!r}: {self.shape[1]} x {self.shape[0]} px in {self.path}>"


def _check_content(path, found, known):
    """The file may have been touched or moved, or be seen from another machine: what counts is its content."""
    if found != known.identity:
        with _file(path) as file:
            if checksum(file) != known.checksum:
                raise InputError(f"{path} has changed since it was first read: its SHA-256 is another")


#: What an `Exposure` and an `ExposureFile` both have.
_SHARED = {field.name for field in fields(Exposure)} & {field.name for field in fields(ExposureFile)}


def read_exposures(
    paths: Images,
    *,
    ext: Extension | None = None,
    dq_good: int | str | Sequence[int] | None = None,
    weight_maps: str | None = None,
    progress: bool = False,
) -> list[Exposure]:
    """Read images.

    The name of an exposure is the base name of its file without ``.fits``, ``.fit``, ``.fts`` and
    ``.gz``, ``.fz``, plus ``_EXT`` if `ext` was given. Images without a file are named after the
    ``FILENAME`` in their header, or ``exposure_0``, ``exposure_1`` by their place in the list. Where names repeat in
    several folders, the names of these come before all of them, ``FOLDER_NAME``.

    Extensions ``ERR``, ``UNCERT``, ``VAR`` or ``VARIANCE`` and ``DQ`` or ``MASK`` with the shape and the
    ``EXTVER`` of the image are used as its uncertainty and mask (any non-zero value is bad; of JWST
    and Roman data the bit DO_NOT_USE alone; see `dq_good`). Of JWST files the gwcs at ``meta.wcs`` is the WCS,
    where they have one. Files ending in ``.asdf`` are images of Roman, with their ``dq``, ``err`` and ``meta.wcs``.
    Gain, read noise, saturation and exposure time come from the header (`KEYWORDS`); for integer data without such a
    keyword, a piled-up maximum is taken for the saturation.

    Parameters
    ----------
    paths : str, path, HDUList, NDData (as CCDData), or a sequence of them
        A string with ``*`` or ``?`` is expanded if no file has that very name.
    ext : int, str or (str, int), optional
        Extension to read from every file; by default the image, ``SCI`` if one is named so. Planes beside it (``DQ``,
        ``WHT`` and the like) do not count. A name that several extensions have, or a pattern, ``"IM*"``, stands for all
        of them, the detectors of a camera: each becomes an `Exposure` ``NAME-ID`` with the ``exposure`` NAME and the
        ``detector`` ID, which is ``CCDCHIP``, ``DETECTOR``, ``CHIP`` or ``EXTVER`` of its header, else ``EXTNAME``,
        ``FRAMEID``, ``CCDNAME`` or their order. Images without a name, or whose names differ by a number (``IM1``,
        ``IM2``), are taken so by default where each has a ``DETSEC`` of its own, as in raw files of Gemini; numbered
        ones by ``CCDNAME`` or ``DETECTOR`` too.
    dq_good : int, str or sequence of int, optional
        Flags of the DQ plane that are no reason to leave a pixel out, a sum of bits or ``"64,32"``; all others are.
    weight_maps : str, optional
        What the weight maps beside the files are: ``"MAP_WEIGHT"``, ``"MAP_VARIANCE"`` or ``"MAP_RMS"``, as SWarp calls
        them, perhaps with what their names end in, ``"MAP_RMS,.rms.fits"``; every file must have one then. ``"none"``
        reads none. By default ``NAME.weight.fits``, where there is one, is of the kind ``"MAP_WEIGHT"``.
    progress : bool, optional
        Show a progress bar.

    Returns
    -------
    list of `Exposure`

    Raises
    ------
    InputError
        Naming the file: missing, not FITS, truncated, without a 2-D image or the extension wanted, with several
        images and no `ext`, without a good pixel, with the name of another one, or with a name that ``wcs/NAME.asdf``
        could not have.

    See Also
    --------
    open_exposures : Reads the pixels when they are needed.
    legdistort.measure : Finds and measures the stars.

    Examples
    --------
    >>> import legdistort as ld
    >>> paths = ld.simulate_exposures(small=True, n_exposures=2, seed=1).write("night")
    >>> ld.read_exposures("night/*.fits")[0].shape
    (512, 512)
    """
    maps = WeightMaps.parse(weight_maps)
    return _read_each(paths, partial(_read, good=good_bits(dq_good)), ext, maps, progress)


def open_exposures(
    paths: Images,
    *,
    ext: Extension | None = None,
    dq_good: int | str | Sequence[int] | None = None,
    weight_maps: str | None = None,
    left_out: dict[str, str] | None = None,
    stop_at_bad: bool = False,
    progress: bool = False,
) -> list[ExposureFile | Exposure]:
    """Exposures for work on more images than the memory holds.

    Every file is read once, so that it is known to be sound, and read again when its pixels are needed; what is in
    memory already (HDULists, NDData) becomes an ordinary exposure. `legdistort.measure`, `match` and `coadd` take
    both.

    Parameters
    ----------
    paths, ext, dq_good, weight_maps, progress
        As for `legdistort.read_exposures`; the names are the same.
    left_out : dict, optional
        If given, what is blank (all pixels alike, hidden or NaN), truncated, damaged or without the image wanted is
        left out with one warning, and added here, ``{name: reason}``; so is, with another, an image that is there
        already under another name.
    stop_at_bad : bool
        Refuse such files instead, naming all of them.

    Returns
    -------
    list of `ExposureFile` or `Exposure`

    Raises
    ------
    InputError
        As `legdistort.read_exposures` does; with `left_out` also if fewer than two good ones remain.

    See Also
    --------
    read_exposures : The same with the pixels in memory.

    Examples
    --------
    >>> import legdistort as ld
    >>> paths = ld.simulate_exposures(small=True, n_exposures=2, seed=1).write("night")
    >>> [exposure.name for exposure in ld.open_exposures(paths)]
    ['exp00', 'exp01']
    """
    good, maps = good_bits(dq_good), WeightMaps.parse(weight_maps)
    if left_out is None and not stop_at_bad:
        return _read_each(paths, partial(_open, good=good), ext, maps, progress)
    bad, copies = {}, {}
    exposures = _read_each(paths, partial(_open, good=good, even_blank=False), ext, maps, progress, bad, copies)
    kept, reasons = {exposure.name for exposure in exposures}, repetitions.warned(copies)
    if bad:
        _tell_bad(bad, len(exposures), stop_at_bad)
        reasons |= {name: reason for name, (_, reason, _) in bad.items()}
    if left_out is not None:  # a copy may have the name of the original
        left_out.update({name: reason for name, reason in reasons.items() if name not in kept})
    return exposures


def _tell_bad(bad, n_good, stop_at_bad):
    """Warn of bad files, or raise `InputError` for all of them."""
    if n_good + len(bad) == 1:
        ((_, _, error),) = bad.values()
        raise error
    named = reasons_of({label: reason for label, reason, _ in bad.values()})
    unusable = f"{len(bad)} of {n_good + len(bad)} frames cannot be used: {named}"
    if stop_at_bad:
        raise InputError(f"{unusable}; repair them, or leave them out")
    if n_good < 2:
        raise InputError(f"{unusable}; {'one good frame is' if n_good else 'no good frame is'} left, give at least two")
    warn(f"{unusable}; they are left out; stop_at_bad=True (--stop-at-bad) refuses them", AssumptionWarning)


def _read_each(paths, read, ext, maps, progress, bad=None, copies=None):
    """What `read` makes of every source and its name in want of a better one; the names found are checked.

    What cannot be used is an error, or goes into the dict `bad`: ``{name: (file, reason, error)}``. An image that is
    there already goes into the dict `copies`, if there is one: ``{name: reason}``.
    """
    exposures, images = [], {}
    sources = maps.frames_of(expand_paths(paths))
    parts = _parts(sources, ext)
    bar = Bar(total=sum(map(len, parts)), desc="reading", unit="frame", disable=not progress)
    with bar, said_once(), contextlib.closing(_one_after_another(sources, parts, maps)) as opened:
        for i, source, ext, key in opened:
            bar.update()
            try:
                with _quiet():
                    exposure = read(source, f"exposure_{i}", ext)
                    exposure = exposure if key is None else of_detector(exposure, ext, key)
            except DamagedError as error:
                if bad is None:
                    raise
                file = source.path.name if isinstance(source, _OpenFile) else f"exposure_{i}"
                name = exposure_name(file, ext) if key is None else detector_name(exposure_name(file), key)
                reason = str(error).removeprefix(f"{sources[i]}: ").removeprefix(f"{name}: ").removesuffix(LEAVE_OUT)
                bad[name] = file, reason, error
                continue
            if copies is not None:
                first = images.setdefault(_pixels(exposure), exposure)
                if first is not exposure:
                    where = f" ({_origin(first)} and {_origin(exposure)})" * (first.name == exposure.name)
                    copies[exposure.name] = f"its pixels are those of {first.name}{where}"
                    continue
            exposures.append(exposure)
    exposures = told_apart(exposures)
    _warn_of_doubts(exposures)
    _tell_without_gwcs(exposures)
    _tell_weight_maps(sources, maps)
    return with_detectors(exposures)


def told_apart(exposures):
    """Exposures with names that differ, those of one name by the folders of their files.

    Raises
    ------
    InputError
        Naming two of one name that no folder tells apart.
    """
    marks = folder_marks([each.name for each in exposures], [each.path for each in exposures])
    if any(marks):
        log.info("%s", folders_in_words(marks[0] + exposures[0].name))
    exposures, seen = list(map(marked, exposures, marks)), {}
    for each in exposures:
        first = seen.setdefault(each.name, each)
        if first is not each:
            raise InputError(
                f"two exposures are named {each.name!r} ({_origin(first)} and {_origin(each)}); rename a file, or "
                "give one of them: exposures are distinguished by their names"
            )
    return exposures


def _origin(exposure):
    return "in memory" if exposure.path is None else exposure.path


def _tell_weight_maps(sources, maps):
    """Say once which weight maps are read."""
    read = [each for each in map(maps.beside, filter(_is_path, sources)) if each is not None]
    if read:
        log.info("weight maps are read as %s: %s", maps.kind, some_of([path.name for path in read], 3))


def _warn_of_doubts(exposures):
    """Warn of what headers state that contradicts itself or cannot be, of all frames together."""
    named = {}
    for exposure in exposures:
        for doubt in exposure.stated.doubts:  # of many values that are of one kind the first is shown
            named.setdefault(re.sub(r" = .*?(?= is )|^\d+", "", doubt), (doubt, []))[1].append(exposure.name)
    if named:
        sentences = "; ".join(f"{some_of(names, 3)}: {doubt}" for doubt, names in named.values())
        warn(f"{sentences} (legdistort show FRAME prints what a frame states)", AssumptionWarning)


def _tell_without_gwcs(exposures):
    """Say of which files the WCS of the header is taken where others of the telescope have a gwcs."""
    by_telescope = {}
    for each in exposures:
        if each.wcs is not None:
            kind = by_telescope.setdefault(each.header.get("TELESCOP"), {True: [], False: []})
            kind[isinstance(each.wcs, WCS)].append(each.name)
    for kind in by_telescope.values():
        if all(kind.values()):
            log.warning(
                "%s: no gwcs, unlike the other %d: the WCS of the header is taken in its place",
                some_of(kind[True], 3), len(kind[False]),
            )  # fmt: skip


def _one_after_another(sources, parts, maps):
    """Number of the source, the source, extension and id of the detector of every image; a file is opened but once."""
    for i, (source, images) in enumerate(zip(sources, parts, strict=True)):
        with contextlib.ExitStack() as stack:
            if _is_path(source):
                source = stack.enter_context(_OpenFile(Path(source), maps))
            for ext, key in images:
                yield i, source, ext, key


def file_checksums(exposures):
    """``{base name: SHA-256}`` of the files of exposures that `open_exposures` gave, maps too; others have none.

    Where base names repeat in several folders, these come before them.
    """
    found = checksums_of_paths(exposures)
    return dict(zip(file_names(list(found)), found.values(), strict=True))


def checksums_of_paths(exposures):
    """The same as ``{path: SHA-256}``."""
    files = [exposure for exposure in exposures if isinstance(exposure, ExposureFile)]
    files += [exposure.weights for exposure in files if exposure.weights is not None]
    return {each.path: each.checksum for each in files}


def listed(exposures, function):
    """One exposure or several as a list; `InputError` for what is none, naming the function that was called."""
    one = isinstance(exposures, (Exposure, ExposureFile)) or not np.iterable(exposures)
    exposures = [exposures] if one else list(exposures)
    for exposure in exposures:
        if not isinstance(exposure, (Exposure, ExposureFile)):
            raise InputError(f"{function} takes exposures as read_exposures gives them, got {type(exposure).__name__}")
    return exposures


def expand_paths(paths):
    """The argument of `read_exposures` as a flat list of sources, patterns expanded."""
    if isinstance(paths, (str, Path, fits.HDUList)) or is_nddata(paths):
        paths = [paths]
    if not np.iterable(paths) or hasattr(paths, "estimate"):  # a solution goes over its views
        raise InputError(
            f"frames must be a path, an HDUList, an NDData or a sequence of them, got {type(paths).__name__}"
        )
    paths = list(paths)
    sources = []
    for source in paths:
        if isinstance(source, str) and any(c in source for c in "*?") and not Path(source).exists():
            found = sorted(glob.glob(source)) or sorted(glob.glob(source.replace("[", "[[]")))
            if not found:
                raise InputError(f"no file matches {source!r}{way_back(source)}")
            sources += found
        else:
            sources.append(source)
    if not sources:
        raise InputError("no exposures to read: paths is empty")
    return sources


def _parts(sources, ext):
    """``[(extension, id of the detector)]`` to read from every source; None where it is not one of several."""
    if not (ext is None or isinstance(ext, str)):
        return [[(ext, None)] for _ in sources]
    return images_of_detectors([_headers_of(source) for source in sources], ext)


def _headers_of(source):
    """The HDUs of a FITS file, or none of what cannot be read: the error comes when it is read."""
    if isinstance(source, fits.HDUList):
        return list(source)
    try:
        with _quiet(), _opened(Path(source)) as hdulist:
            return list(hdulist)
    except (InputError, TypeError):
        return []


class _OpenFile(contextlib.ExitStack):
    """A file that stays open while its images are read one after another, and is checked to be the same in the end."""

    def __init__(self, path, maps=None):
        super().__init__()
        self.path, self.maps = path, maps

    @cached_property
    def identity(self):
        return self.enter_context(unchanged(self.path))[0]

    @cached_property
    def file(self):
        return self.enter_context(_file(self.path))

    @cached_property
    def hdulist(self):
        return self.enter_context(open_fits(self.file, self.path, _NO_FRAME))

    @cached_property
    def checksum(self):
        self.file.seek(0)
        return checksum(self.file)

    @cached_property
    def weights(self):
        """The weight map, open, or None."""
        path = None if self.maps is None or _is_asdf(self.path) else self.maps.beside(self.path)
        return None if path is None else self.enter_context(_OpenFile(path))

    def plane_of_weights(self, ext):
        """The `WeightPlane` of the image in an extension; None without a map."""
        if self.weights is None:
            return None
        image = find_image(self.hdulist, ext, str(self.path))
        number = weight_number(self.weights.hdulist, self.hdulist, image, (self.weights.path, self.path))
        return WeightPlane(self.weights.path, self.maps.kind, number, self.weights.checksum, self.weights.identity)


def _with_weights(exposure, hdulist, plane):
    with told_as_damaged(plane.path):
        return with_weights(exposure, as_plane(hdulist[plane.number].data), plane.kind)


def _read(source, default, ext, good=None):
    if is_nddata(source):
        return from_nddata(source, default, good)
    if isinstance(source, fits.HDUList):
        filename = source.filename()
        label = filename or str(source[0].header.get("FILENAME", default)) if len(source) else default
        return from_hdulist(source, ext, label, Path(filename) if filename else None, good)
    if not isinstance(source, _OpenFile):
        raise InputError(f"an exposure must be a path, an HDUList or an NDData, got {type(source).__name__}")
    if _is_asdf(source.path):
        with _file(source.path) as file:
            _check_no_extension(source.path, ext)
            return read_roman(file, str(source.path), source.path, good)
    with readable(source.path):
        exposure = from_hdulist(source.hdulist, ext, str(source.path), source.path, good)
        if (plane := source.plane_of_weights(ext)) is not None:
            exposure, doubt = _with_weights(exposure, source.weights.hdulist, plane)
            exposure = with_weights_stated(exposure, plane.path, doubt)
        for hdu in filter(is_image, source.hdulist):
            del hdu.data  # the memory need hold but one detector of a camera
    return exposure


def _open(source, default, ext, good=None, even_blank=True):
    known = {"identity": source.identity} if isinstance(source, _OpenFile) else {}  # before it is read
    exposure = _read(source, default, ext, good)
    exposure = exposure if even_blank else _not_blank(exposure)
    if not known:
        return exposure
    known |= {"shape": exposure.shape, "checksum": source.checksum, "pixels": _pixels(exposure)}
    known["weights"] = source.plane_of_weights(ext)
    return ExposureFile(**{name: getattr(exposure, name) for name in _SHARED}, **known, ext=ext, dq_good=good)


def _pixels(exposure):
    """SHA-256 of the pixels, in hexadecimal digits: the same for the same image in another file."""
    if isinstance(exposure, ExposureFile):
        return exposure.pixels
    digest = hashlib.sha256(f"{exposure.shape} {exposure.data.dtype}".encode())
    digest.update(np.ascontiguousarray(exposure.data))
    return digest.hexdigest()


def _is_path(source):
    return isinstance(source, str | Path)


def _is_asdf(path):
    return path.suffix.lower() == ".asdf"


def _check_no_extension(path, ext):
    if ext is not None:
        raise InputError(f"{path}: an ASDF file has no extensions; leave ext (--ext) out")


def _file(path):
    """A file, open; `InputError` if there is none."""
    check_is_file(path, of_folder=f"name the files in it ({path}/*)")
    return path.open("rb")


def _not_blank(exposure):
    good = exposure.data[~exposure.mask]
    if good.min() == good.max():
        raise DamagedError(f"{exposure.name}: every pixel has the same value{LEAVE_OUT}")
    return exposure


@contextlib.contextmanager
def _quiet():
    """Headers are often a little off the standard; what matters is checked."""
    with _FILTERS, without_astropy_warnings():
        yield


@contextlib.contextmanager
def _opened(path):
    """A FITS file as an HDUList."""
    with _file(path) as file, open_fits(file, path, _NO_FRAME) as hdulist:
        yield hdulist
