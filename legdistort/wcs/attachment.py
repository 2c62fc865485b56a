"""A solution goes into the frames it was made from: distortion in their headers, and the exact gwcs as a table."""

import contextlib
import io
import logging
import re
import shutil
import textwrap
import zlib
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import asdf
import numpy as np
from astropy.io import fits

from ..exceptions import ExportError, InputError, some_of, without_astropy_warnings
from ..inputs import detector_files, exposure_files, exposure_names, file_images
from ..inputs.frames import header_texts, wcs_cards
from ..inputs.frames.weight_maps import WeightMaps
from ..inputs.sky_wcs import leads_elsewhere, warn_of_another_field
from ..inputs.wcs_files import PLACES
from ..runtime import provenance
from ..runtime.asdf_files import ASDF_STANDARD
from ..runtime.checks import first_line
from ..runtime.fits_bytes import BLOCK, exchange_cards, locate, open_bytes, read_bytes, readable, splice
from ..runtime.outputs import replacing, replacing_files, replacing_folder
from ..runtime.progress import Bar
from .fits_headers import header_error, misleading_cards
from .flux_cards import FluxCards
from .footprints import former_wcs, renewed_footprint
from .foreign_trees import model_wcs, refined_tree, table_of
from .refinement import corner_move
from .storage import wcs_tree

log = logging.getLogger(__name__)

_ASDF = b"#ASDF"
#: Names that a message lists.
_MOST_NAMED = 6
#: What the header of an image records of a WCS that was written into it; `attach` takes it for its own later.
_HISTORY = "legdistort {} wrote the WCS of this image"
#: Cards of the primary WCS and its distortion, all of which give way; those of alternative WCSs end in a letter.
WCS_KEYWORDS = re.compile(
    rf"HISTORY {_HISTORY.format('.*')}.*|SOLSHA|(SIP|TPV)(MX|IV)ERR|ZHECKSUM|{wcs_cards.KEYWORDS}"
)


@dataclass(frozen=True, eq=False)
class Attachment:
    """What `attach` did for one exposure.

    Attributes
    ----------
    path : `~pathlib.Path`
        The file written.
    exposure : str
    header : `~astropy.io.fits.Header` or None
        The cards that went into the header of the image, or into the file ``.head``.
    kind : {"sip", "tpv", "head", None}
    """

    path: Path
    exposure: str
    header: fits.Header | None
    kind: str | None = "sip"

    @property
    def errors(self):
        """Largest errors of the header [pix] by keyword, ``SIPMXERR`` and so on; empty without a header."""
        return {key: value for key, value in (self.header or {}).items() if key.endswith(("MXERR", "IVERR"))}

    def __repr__(self):
        what = "".join(f"{key[:3]} within {error:.2g} px, " for key, error in self.errors.items() if "MX" in key)
        what = what.removesuffix(", ") if self.kind == "head" else f"{what}ASDF"
        return f"<Attachment: {self.exposure} in {self.path}: {what}>"


def attach(
    solution,
    paths,
    *,
    out=None,
    in_place=False,
    kind="sip",
    max_error=1e-3,
    ext=None,
    overwrite=False,
    progress=False,
):
    """Write the WCS of every exposure into its frame, or into a copy.

    Two things go in: in the header of the image the keywords of `legdistort.wcs.fits_headers.make_header`, instead of
    those of the former WCS, and an extension ``ASDF`` with the exact gwcs at ``meta.wcs``, which
    ``stdatamodels.asdf_in_fits.open`` reads. Where a pipeline (JWST) keeps its data model there, the gwcs in that is
    refined (`legdistort.refine`), and every other key and byte of it stays; so it is with ASDF files of Roman. Errors,
    flags and weights beside the image (``ERR``, ``DQ`` and the like, of its shape and ``EXTVER``) get the keywords as
    well. The corners of a footprint ``S_REGION`` stay at their pixels, and get new places. Every other HDU, card and
    byte stays as it is, but for what would be taken for the WCS of the image before that: plates of scans (DSS:
    ``PLTRAH``, ``AMDX1``, ``XPIXELSZ`` ...), polynomials of IRAF and wcstools. The errors hold for the header as it
    stands in the file. Nothing is written unless everything can be.

    Frames are identified by their names, as `read_exposures` gives them, with a folder before them too; where none is
    so called, by these but for the last word, as products of pipelines differ (``x_cal``, ``x_wcs``), which is logged.
    A frame that was left out of the solution is skipped, which is logged.

    Parameters
    ----------
    solution : Solution
    paths : str, path, or a sequence of them
        FITS files, plain or packed with gzip or bzip2; they stay packed. A string with ``*`` or ``?`` is expanded.
    out : str or path, optional
        Folder for the copies, made if it does not exist.
    in_place : bool
        Change the files themselves, all or none (see the page on files). Exactly one of `out` and `in_place` must be
        given.
    kind : {"sip", "tpv", "head", None}
        Form of the header; None leaves it alone and adds the ASDF extension only. "head" leaves the frames alone, and
        writes the cards (TPV) of the images of each into a text ``NAME.head``, which SWarp reads in the place of its
        headers (SCAMP writes files of this name, and reads ``NAME.ahead``): beside the frames, or into the folder `out`
        without them. With GAIN and SATURATE, which SWarp reads, where the frames state them under other keywords, and
        with FLXSCALE, the factor that brings the values of a frame to those of one of mean depth, where the fluxes of
        common stars join all exposures of the solution; fluxes of lists must be in the unit of the pixels, as
        ``FLUX_AUTO`` is.
    max_error : float
        Largest error of the header, pixels.
    ext : int, str or (str, int), optional
        The extension that was given to `read_exposures`. By default all extensions of a file that are exposures of
        the solution, by their names.
    overwrite : bool
        Replace copies in `out` that exist, and ASDF extensions that other programs wrote.
    progress : bool
        Show a progress bar.

    Returns
    -------
    list of `Attachment`

    Warns
    -----
    AssumptionWarning
        Of texts ``NAME.head`` beside files with new headers, in the place of which SWarp reads these; of headers that
        lead to another field than the solution.

    Raises
    ------
    ExportError
        If no header of an exposure meets `max_error`, or other cards of the file contradict it, naming them.
    InputError
        Naming the file: not FITS, not in the solution, of another shape, without the extension, or in the way; or if
        the solution does not know the sky and a header is wanted.
    """
    if (out is None) is not bool(in_place):
        raise InputError("give either out= (--out), a folder for copies, or in_place=True (--in-place)")
    paths = _files(paths)
    targets = [path.resolve() for path in paths]
    if kind == "head" or not in_place:
        targets = _targets(paths, None if in_place else Path(out), overwrite, as_texts=kind == "head")
    plans, images = [], _Images.of(solution)
    for path, target in zip(Bar(paths, desc="attaching", unit="frame", disable=not progress), targets, strict=True):
        plan = _plan(images, path, target, kind=kind, max_error=max_error, ext=ext, overwrite=overwrite)
        plans += [plan] if plan.headers else []
    warn_of_another_field([name for plan in plans for name in plan.elsewhere])
    if images.moved:
        far = max(images.moved, key=images.moved.get)
        kept = kind is None and any(plan.whole is None for plan in plans)
        log.info(
            "corners of %d images move by up to %.3g arcsec (%s)%s", len(images.moved), images.moved[far].arcsec, far,
            "; their headers, which --asdf-only leaves as they were, are off by as much" * kept,
        )  # fmt: skip
    if unknown := _unknown_sky(solution):
        log.warning("%s", unknown)
    attached = {images.views[name].name for plan in plans for name in plan.headers}
    for words in _untrusted(solution.checks, attached):
        log.warning("%s", words)
    if alike := [f"{plan.path.name} as {v.name}" for plan in plans for v in map(images.views.get, plan.headers)
                 if _is_another_product(plan.path, v)]:  # fmt: skip
        log.warning("frames are taken for exposures whose names differ by the last word (%d): %s", len(alike),
                    some_of(alike, 3))  # fmt: skip
    if kind != "head" and not in_place and (maps := [m for plan in plans if (m := WeightMaps().beside(plan.path))]):
        log.warning(
            "weight maps stay where they are (%s): SWarp looks for them beside the copies; copy or link them into %s",
            some_of([each.name for each in maps], 3), out,
        )  # fmt: skip
    if not plans:
        raise InputError("none of the frames is part of the solution; give those it was made from")
    if kind == "head":
        images.fluxes.tell([images.views[name] for plan in plans for name in plan.headers])
    if kind in ("sip", "tpv"):
        header_texts.warn_of_texts([plan.path if in_place else plan.target for plan in plans])
    with replacing_files([plan.target for plan in plans]) if in_place else _copies(Path(out), overwrite) as writing:
        for plan in plans:
            with writing(plan.target) as file:
                plan.write(file)
    return [Attachment(plan.target, *item, kind) for plan in plans for item in plan.headers.items()]


def _untrusted(checks, names):
    """Why WCSs of some exposures may be off by more than their errors say, in words, a line each."""
    bad = [check for check in checks if check.doubts(names)]
    if failed := [check.name for check in bad if check.state == "fail"]:
        yield f"these WCSs may be off by more than their errors say: the solution fails the checks {', '.join(failed)}"
    yield from (f"{check.sentence}; that is so in their WCSs too" for check in bad if check.name == "extrapolation")


def _is_another_product(path, view):
    """Whether a frame is another product of a pipeline than the exposure is called for (`exposure_names.alike`)."""
    name = exposure_names.exposure_name(path)
    whole = name if view.detector is None else detector_files.without_id(name, view.detector) or name
    return whole != view.name == exposure_names.alike(whole, [view.name])


def _unknown_sky(solution):
    """By how much what is unknown of the common map could move the sky of the images, in words; empty for nothing."""
    unknown = [] if solution.sky is None else solution.gauge.unknown
    if not unknown:
        return ""
    far = np.sqrt(np.nanmax(np.sum([np.sum(each.stars**2, axis=1) for each in unknown], axis=0)))
    return (
        f"what is not determined of absolute positions ({solution.gauge.unknown_in_words}) is in these WCSs too: "
        f"if it is 1 px rms, it moves places on the sky by up to {far * solution.sky.pixel_scale:.2g} arcsec"
    )


@dataclass(frozen=True, eq=False)
class _Images:
    """Views of a solution by the names of images, and why others were left out; ``SOLSHA`` of its file.

    By how much each gwcs that is refined `moved` the corners of its image, and the `fluxes`.
    """

    views: dict
    left_out: dict
    checksum: str | None
    of_camera: bool
    fluxes: FluxCards
    moved: dict = field(default_factory=dict)

    def called(self, path):
        """The path of a file as exposures are named after it: with a folder before its name, where they have that."""
        labels = {*self.views, *self.left_out}
        return path.with_name(exposure_names.folder_mark(exposure_names.exposure_name(path), path, labels) + path.name)

    def of_file(self, name, header):
        """Name of the exposure, or of the part of one, in a file of one detector; None if it is of another."""
        labels = {*self.views, *self.left_out}
        found = detector_files.label_of(name, header, labels, exact=not self.of_camera)
        if found is not None or not self.of_camera:
            return found
        # a file with nothing but a gwcs has its detector in the name
        named = [k for k, view in self.views.items() if detector_files.without_id(name, view.detector) == view.name]
        return named[0] if len(named) == 1 else None

    @classmethod
    def of(cls, solution):
        left_out = dict(solution.left_out)
        if solution.camera.has_focal_plane:
            ids = solution.camera.detectors
            left_out = {exposure_names.detector_name(name, k): why for name, why in left_out.items() for k in ids}
        views = {part.label: part for view in solution for part in view.parts}
        return cls(views, left_out, solution.checksum, solution.camera.has_focal_plane, FluxCards(solution))


@dataclass(frozen=True, eq=False)
class _Plan:
    """What is to be done to one file: headers ``{exposure: Header or None}`` and edits of its bytes.

    And the names of the exposures that the headers place `elsewhere`. Or, in the place of the edits, the `whole` file.
    """

    path: Path
    target: Path
    crc: int
    headers: dict
    edits: list
    elsewhere: list
    whole: bytes | None = None

    def write(self, file):
        raw, pack = _read(self.path)
        if zlib.crc32(raw) != self.crc:
            raise InputError(f"{self.path} changed while it was worked on; try again")
        file.write(pack(splice(raw, self.edits)) if self.whole is None else self.whole)
        shutil.copymode(self.path, file.name)


def _files(paths):
    """The files meant, each once."""
    given = WeightMaps().frames_of(exposure_files.expand_paths(paths))
    other = next((path for path in given if not isinstance(path, (str, Path))), None)
    if other is not None:
        raise InputError(f"frames must be paths of FITS files, got {type(other).__name__}")
    files = [Path(path) for path in given]
    real = [file.resolve() for file in files]
    twice = next((file for file, path in zip(files, real, strict=True) if real.count(path) > 1), None)
    if twice is not None:
        raise InputError(f"{twice} is given twice")
    return files


@contextlib.contextmanager
def _copies(out, overwrite):
    """What gives an open file for a copy in a folder, which has all of them when the block ends well."""
    with replacing_folder(out, overwrite=overwrite) as folder:
        yield lambda target: replacing(folder / target.name)


def _targets(paths, out, overwrite, *, as_texts):
    """Where copies go, or texts of headers: into a folder, or beside the frames."""
    names = exposure_names.file_names(paths)
    targets = [path.resolve() if out is None else out / name for path, name in zip(paths, names, strict=True)]
    targets = [header_texts.beside(path) for path in targets] if as_texts else targets
    for i, (path, target) in enumerate(zip(paths, targets, strict=True)):
        if target in targets[:i]:
            raise InputError(
                f"two frames are named {path.name}: their copies in {out} would be one; attach in two calls"
            )
        if target.exists() and path.exists() and target.samefile(path):
            raise InputError(f"{path} is in the folder for the copies; choose another, or in_place=True (--in-place)")
        if target.exists() and not overwrite:
            raise InputError(f"{target} exists already; give overwrite=True (--overwrite) to replace it")
    return targets


def _plan(known, path, target, *, kind, max_error, ext, overwrite):
    """The `_Plan` of one file; without headers if it was left out of the solution."""
    raw, _ = _read(path)
    if raw.startswith(_ASDF):
        return _plan_of_tree(known, path, target, raw, kind)
    spans = locate(raw, path)
    headers, edits, of_images, whole = {}, [], {}, None
    with readable(path), open_bytes(raw) as hdulist:
        images = _images(known, hdulist, path, ext)
        elsewhere = [
            name
            for name, image in images.items()
            if leads_elsewhere(former_wcs(known.views[name], hdulist, hdulist[image]), known.views[name])
        ]
        for name, image in images.items():
            headers[name] = None
            if kind is not None:
                headers[name] = _header(known, name, "tpv" if kind == "head" else kind, max_error)
                planes = file_images.planes_beside(hdulist, hdulist[image])
                for number in (image, *(_number(hdulist, plane) for plane in planes)):
                    if kind == "head":
                        own = header_texts.detector_cards(hdulist, number) + known.fluxes.of(known.views[name])
                        of_images[number] = headers[name] + (own if number == image else fits.Header())
                        continue
                    start, data, stop, _ = spans[number]
                    footprint = renewed_footprint(known.views[name], hdulist, hdulist[number])
                    obsolete = WCS_KEYWORDS if not footprint else re.compile(f"S_REGION|{WCS_KEYWORDS.pattern}")
                    new = exchange_cards(raw[start:data], raw[data:stop], headers[name] + footprint, obsolete)
                    _check_written(new, headers[name], known.views[name], path)
                    edits.append((start, data, new))
        if kind == "head":
            whole = _head(hdulist, of_images)
        elif images:
            edits += _foreign_edits(known, images, spans, raw, path, headers[next(iter(images))]) or _asdf_edits(
                known, images, spans, *_tables(known, hdulist, spans, path, overwrite)
            )
    return _Plan(path, target, zlib.crc32(raw), headers, edits, elsewhere, whole)


def _read(path):
    """What `read_bytes` gives; of an ASDF file its bytes as they are."""
    if path.suffix.lower() == ".asdf" and path.is_file() and (raw := path.read_bytes()).startswith(_ASDF):
        return raw, bytes
    return read_bytes(path)


def _plan_of_tree(known, path, target, raw, kind):
    """The `_Plan` of an ASDF file of Roman, which holds no headers."""
    if kind == "head":
        raise InputError(f"{path} is no FITS file: SWarp and SCAMP do not read it")
    name = exposure_names.exposure_name(known.called(path))
    if (found := model_wcs(raw, str(path))) is None:
        raise InputError(f"{path} has no gwcs at {' or '.join('.'.join(keys) for keys in PLACES)}")
    name = name if name in known.views else known.of_file(name, found[2]) or name
    if name not in known.views:
        return _Plan(path, target, zlib.crc32(raw), _nothing(known, path, name), [], [])
    whole = refined_tree(raw, found, known.views[name], str(path))
    known.moved[name] = corner_move(found[1], known.views[name])[0]
    return _Plan(path, target, zlib.crc32(raw), {name: None}, [], [], whole)


def _foreign_edits(known, images, spans, raw, path, header):
    """The edit of the only extension ASDF of a file, if it is a data model of a pipeline with a gwcs; else none."""
    tables = [span for span in spans if span.header.get("EXTNAME") == "ASDF"]
    if len(images) != 1 or len(tables) != 1 or "EXPNAME" in tables[0].header or tables[0].header.get("TFIELDS") != 1:
        return []
    (name,), (span,), label = images, tables, f"{path}[ASDF]"
    content, found = raw[span.data : span.data + span.header["NAXIS1"]], None
    with contextlib.suppress(InputError):  # of another program, which may hold anything
        found = model_wcs(content, label)
    if found is None:
        return []
    whole = refined_tree(content, found, known.views[name], label, header, WCS_KEYWORDS)
    known.moved[name] = corner_move(found[1], known.views[name])[0]
    return [(span.start, span.stop, table_of(span.header, whole))]


def _head(hdulist, of_images):
    """A file ``.head``, a text: the cards of every image, ``{number: Header}``, none for one without a solution."""
    images = (k for k, hdu in enumerate(hdulist) if file_images.is_image(hdu))
    return header_texts.text_of(of_images.get(k, fits.Header()) for k in images).encode("ascii")


def _header(known, name, kind, max_error):
    try:
        header = known.views[name].header(kind=kind, max_error=max_error)
    except (ExportError, InputError) as error:
        raise type(error)(f"{error}; kind=None (--asdf-only) attaches the exact WCS alone") from None
    if known.checksum is not None:
        header["SOLSHA"] = known.checksum  # no room for a comment
    header["HISTORY"] = f"{_HISTORY.format(version('legdistort'))}, {provenance.now()[:10]}"
    return header


def _check_written(written, stated, view, path):
    """Refuse a header of a file in which other cards make another WCS of what is stated.

    Parameters
    ----------
    written : bytes
        The header as it will stand in the file.
    stated : `~astropy.io.fits.Header`
        The cards that went into it, with the largest errors.
    """
    with without_astropy_warnings():
        header = _readable_cards(written)
        if any(key.startswith("BEGAST") for key in header):
            raise ExportError(
                f"{path}: the header has a WCS of Starlink's AST as well (cards BEGAST_A to ENDAST_A), which its "
                "programs prefer; remove these cards, or attach the exact WCS alone, kind=None (--asdf-only)"
            )
        if header["NAXIS"] > 2:
            raise ExportError(
                f"{path}: the image has NAXIS = {header['NAXIS']}, and headers with SIP or TPV are read with two axes "
                "alone; write it with NAXIS = 2, or attach the exact WCS alone, kind=None (--asdf-only)"
            )
        try:
            errors = header_error(header, view.pose, view.distortion, view.solution.sky)
        except Exception as error:  # wcslib raises many kinds
            found = first_line(error)
        else:
            promised = [value for key, value in stated.items() if key.endswith(("MXERR", "IVERR"))]
            if all(error <= value for error, value in zip(errors, promised, strict=True)):
                return
            found = f"{max(errors):.2g} px off"
        cards = ", ".join(misleading_cards(header, stated)) or "other cards"
    raise ExportError(
        f"{path}: with {cards} in the header the WCS written is read as another one ({found}): remove these cards, or "
        "attach the exact WCS alone, kind=None (--asdf-only)"
    )


def _readable_cards(written):
    """A header without the cards of no sense, which are none of the WCS."""
    cards = []
    for card in fits.Header.fromstring(written).cards:
        with contextlib.suppress(fits.VerifyError, ValueError):  # the latter of letters that FITS does not know
            card.verify("silentfix")
            cards.append(fits.Card(card.keyword, card.value, card.comment))
    return fits.Header(cards)


def _number(hdulist, hdu):
    return next(i for i, other in enumerate(hdulist) if other is hdu)


def _images(known, hdulist, path, ext):
    """``{exposure: number of its HDU}`` of one file; empty if it was left out of the solution."""
    called = known.called(path)
    candidates = {exposure_names.exposure_name(called, ext): ext}
    if ext is None:
        candidates = file_images.extension_names(hdulist, called)
    candidates |= file_images.detector_names(hdulist, called, ext) | _in_a_file_of_its_own(
        known, candidates, hdulist, path
    )
    found = {name: form for name, form in candidates.items() if name in known.views}
    if not found:
        return _nothing(known, path, next((n for n in candidates if n in known.left_out), next(iter(candidates))))
    images = {}
    for name, form in found.items():
        # of several images the first, if the solution knows the file by its name alone
        hdu = file_images.find_image(hdulist, form, str(path), of_several=True)
        if (shape := file_images.plane_shape(hdu)) != tuple(known.views[name].shape):
            raise InputError(
                f"{path}: the image has shape {shape}, exposure {name} of the solution "
                f"{tuple(known.views[name].shape)}; give the frames that the solution was made from"
            )
        images[name] = _number(hdulist, hdu)
    if len(set(images.values())) < len(images):
        raise InputError(f"{path}: exposures {', '.join(images)} are the same image; choose one with ext= (--ext)")
    return images


def _in_a_file_of_its_own(known, candidates, hdulist, path):
    """The part of an exposure, ``{name: extension}``, that is in a file of one detector; empty for other files."""
    found = {}
    for name, ext in candidates.items() if any(map(file_images.is_image, hdulist)) else ():
        with contextlib.suppress(InputError):  # an extension that is no image
            image = file_images.find_image(hdulist, ext, str(path), of_several=True)
            header = wcs_cards.header_of_image(hdulist[0].header, image.header)
            found.setdefault(known.of_file(name, header), ext)
    found.pop(None, None)
    return found


def _nothing(known, path, name):
    if name not in known.left_out:
        raise InputError(
            f"{path}: no exposure {name!r} in the solution; it has {some_of(list(known.views), _MOST_NAMED)}; frames "
            "are identified by their names; leave it off the list, or bring it into the solution (solve --base)"
        )
    log.warning("%s: skipped, it was left out of the solution (%s)", path, known.left_out[name])
    return {}


def _tables(known, hdulist, spans, path, overwrite):
    """Extensions ASDF of a file: ``{number of the image: Span}``, and a list of those to be removed.

    One of ours names its exposure: numbers of HDUs change when fpack and other programs move them. Where that is no
    image of this file, since the file was renamed, it is removed, and so, if asked for, is that of another program.
    """
    named, of_images, others = file_images.named_images(hdulist, known.called(path)), {}, []
    for span in spans:
        if span.header.get("EXTNAME") != "ASDF":
            continue
        exposure = span.header.get("EXPNAME")
        if exposure is None and not overwrite:
            raise InputError(
                f"{path} already has an extension ASDF of another program, {span.header.get('CREATOR', 'unnamed')}, "
                "which may hold more than the WCS; give overwrite=True (--overwrite) to replace it"
            )
        image = _number(hdulist, named[exposure]) if exposure in named else None
        if image is None or image in of_images:
            others.append(span)
            log.info("%s: the extension ASDF of %s is removed, it is of no image here", path, exposure)
        else:
            of_images[image] = span
    return of_images, others


def _asdf_edits(known, images, spans, of_images, others):
    """Edits that replace or append the ASDF extensions of the images and remove the others."""
    edits = [(span.start, span.stop, b"") for span in others]
    numbers = {image: span.header.get("EXTVER", 1) for image, span in of_images.items()}
    end = spans[-1].stop
    for name, image in images.items():
        if image not in numbers:
            numbers[image] = next(n for n in range(1, len(spans) + 2) if n not in numbers.values())
        start, stop = (of_images[image].start, of_images[image].stop) if image in of_images else (end, end)
        edits.append((start, stop, _asdf_hdu(known.views[name], numbers[image])))
    return edits


def _asdf_hdu(view, number):
    """Bytes of the one-row table that holds the ASDF file of an exposure."""
    content, file = io.BytesIO(), io.BytesIO()
    tree = wcs_tree(view)
    asdf.AsdfFile(tree, version=ASDF_STANDARD).write_to(content)
    row = np.frombuffer(content.getvalue(), np.uint8)[None]
    column = fits.Column(name="ASDF_METADATA", array=row, format=f"{row.size}B")
    hdu = fits.BinTableHDU.from_columns([column], name="ASDF", ver=number)
    header = hdu.header
    header["EXPNAME"] = exposure_names.in_header(view.label)
    header["CREATOR"] = f"legdistort {version('legdistort')}"
    now = provenance.now()
    header["DATE"] = (now, "UTC, when this extension was made")
    if view.solution.checksum is not None:
        header["SOLSHA"] = view.solution.checksum  # no room for a comment
    made = tree["meta"]["provenance"]
    packages = ", ".join(f"{package} {each}" for package, each in made["versions"].items())
    made_by = f"The solution was made {made['created']} with {packages}. SOLSHA, if known, is the SHA-256 of its file."
    for line in textwrap.wrap(made_by, 72):
        header["HISTORY"] = line
    hdu.add_checksum(when=f"updated {now}")
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(file)
    return file.getvalue()[BLOCK:]
