"""A solution goes into the frames it was made from: distortion in their headers, and the exact gwcs as a table."""

import io
import logging
import re
import shutil
import zlib
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import asdf
import numpy as np
from astropy.io import fits
from tqdm import tqdm

from ..exceptions import ExportError, InputError
from ..inputs import exposure_files, exposure_names
from ..runtime.asdf_files import ASDF_STANDARD
from ..runtime.fits_bytes import BLOCK, exchange_cards, locate, open_bytes, read_bytes, splice
from ..runtime.outputs import replacing, replacing_folder
from .storage import wcs_tree

log = logging.getLogger(__name__)

#: Keywords of the primary WCS and its distortion, all of which give way; those of alternative WCSs end in a letter.
WCS_KEYWORDS = re.compile(
    r"WCSAXES|WCSNAME|LONPOLE|LATPOLE|RADESYS|RADECSYS|EQUINOX|D2IMARR|AXISCORR|(SIP|TPV)(MX|IV)ERR|ZHECKSUM"
    r"|(CTYPE|CUNIT|CRVAL|CRPIX|CDELT|CROTA|CNAME|CRDER|CSYER|CPDIS|CQDIS|CPERR|CQERR|D2IMDIS|D2IMERR)\d+"
    r"|(PC|CD|PV|PS)\d+_\d+|(PC|CD)\d{6}|WAT\d+_\d+|(DP|DQ|D2IM)\d+|(A|B|AP|BP)_(ORDER|DMAX|\d+_\d+)"
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
        The cards that went into the header of the image.
    """

    path: Path
    exposure: str
    header: fits.Header | None

    @property
    def errors(self):
        """Largest errors of the header [pix] by keyword, ``SIPMXERR`` and so on; empty without a header."""
        return {key: value for key, value in (self.header or {}).items() if key.endswith(("MXERR", "IVERR"))}

    def __repr__(self):
        what = "".join(f"{key[:3]} within {error:.2g} px, " for key, error in self.errors.items() if "MX" in key)
        return f"<Attachment: {self.exposure} in {self.path}: {what}ASDF>"


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
    ``stdatamodels.asdf_in_fits.open`` reads. Every other HDU, card and byte stays as it is. Nothing is written unless
    everything can be.

    Frames are told by their names, as `read_exposures` gives them. A frame that was left out of the solution is
    skipped, which is logged.

    Parameters
    ----------
    solution : Solution
    paths : str, path, or a sequence of them
        FITS files, plain or packed with gzip or bzip2; they stay packed. A string with ``*`` or ``?`` is expanded.
    out : str or path, optional
        Folder for the copies, made if it does not exist.
    in_place : bool
        Change the files themselves, each in one step. Exactly one of `out` and `in_place` must be given.
    kind : {"sip", "tpv", None}
        Form of the header; None leaves it alone and adds the ASDF extension only.
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

    Raises
    ------
    ExportError
        If no header of an exposure meets `max_error`.
    InputError
        Naming the file: not FITS, not in the solution, of another shape, without the extension, or in the way; or if
        the solution does not know the sky and a header is wanted.
    """
    if (out is None) is not bool(in_place):
        raise InputError("give either out= (--out), a folder for copies, or in_place=True (--in-place)")
    paths = _files(paths)
    targets = [path.resolve() for path in paths] if in_place else _targets(paths, Path(out), overwrite)
    plans = []
    for path, target in zip(tqdm(paths, desc="attaching", unit="frame", disable=not progress), targets, strict=True):
        plan = _plan(solution, path, target, kind=kind, max_error=max_error, ext=ext, overwrite=overwrite)
        plans += [plan] if plan.headers else []
    if not plans:
        raise InputError("none of the frames is part of the solution; give those it was made from")
    if in_place:
        for plan in plans:
            with replacing(plan.target, overwrite=True) as file:
                plan.write(file)
    else:
        with replacing_folder(out) as folder:
            for plan in plans:
                with replacing(folder / plan.target.name) as file:
                    plan.write(file)
    return [Attachment(plan.target, *item) for plan in plans for item in plan.headers.items()]


@dataclass(frozen=True, eq=False)
class _Plan:
    """What is to be done to one file: headers ``{exposure: Header or None}`` and edits of its bytes."""

    path: Path
    target: Path
    crc: int
    headers: dict
    edits: list

    def write(self, file):
        raw, pack = read_bytes(self.path)
        if zlib.crc32(raw) != self.crc:
            raise InputError(f"{self.path} changed while it was worked on; try again")
        file.write(pack(splice(raw, self.edits)))
        shutil.copymode(self.path, file.name)


def _files(paths):
    """The files meant, each once."""
    given = exposure_files.expand_paths(paths)
    other = next((path for path in given if not isinstance(path, (str, Path))), None)
    if other is not None:
        raise InputError(f"frames must be paths of FITS files, got {type(other).__name__}")
    files = [Path(path) for path in given]
    real = [file.resolve() for file in files]
    twice = next((file for file, path in zip(files, real, strict=True) if real.count(path) > 1), None)
    if twice is not None:
        raise InputError(f"{twice} is given twice")
    return files


def _targets(paths, out, overwrite):
    """Where the copies go."""
    targets = [out / path.name for path in paths]
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


def _plan(solution, path, target, *, kind, max_error, ext, overwrite):
    """The `_Plan` of one file; without headers if it was left out of the solution."""
    raw, _ = read_bytes(path)
    spans = locate(raw, path)
    headers, edits = {}, []
    images = _images(solution, raw, path, ext)
    for name, image in images.items():
        headers[name] = None
        if kind is not None:
            headers[name] = _header(solution, name, kind, max_error)
            start, data, stop, _ = spans[image]
            edits.append((start, data, exchange_cards(raw[start:data], raw[data:stop], headers[name], WCS_KEYWORDS)))
    if images:
        edits += _asdf_edits(solution, images, spans, path=path, overwrite=overwrite)
    return _Plan(path, target, zlib.crc32(raw), headers, edits)


def _header(solution, name, kind, max_error):
    try:
        return solution.header(name, kind=kind, max_error=max_error)
    except (ExportError, InputError) as error:
        raise type(error)(f"{error}; kind=None (--asdf-only) attaches the exact WCS alone") from None


def _images(solution, raw, path, ext):
    """``{exposure: number of its HDU}`` of one file; empty if it was left out of the solution."""
    with open_bytes(raw) as hdulist:
        candidates = {exposure_names.exposure_name(path, ext): ext}
        if ext is None:
            for i, hdu in enumerate(hdulist):
                forms = (i, hdu.name, (hdu.name, hdu.ver)) if hdu.name else (i,)
                candidates |= {exposure_names.exposure_name(path, form): form for form in forms}
        found = {name: form for name, form in candidates.items() if name in solution.names}
        if not found:
            return _nothing(solution, path, next(iter(candidates)))
        images = {}
        for name, form in found.items():
            # of several images the first, if the solution knows the file by its name alone
            hdu = exposure_files.find_image(hdulist, form, str(path), of_several=True)
            if hdu.shape != tuple(solution.shapes[name]):
                raise InputError(
                    f"{path}: the image has shape {hdu.shape}, exposure {name} of the solution "
                    f"{tuple(solution.shapes[name])}; give the frames that the solution was made from"
                )
            images[name] = next(i for i, other in enumerate(hdulist) if other is hdu)
    if len(set(images.values())) < len(images):
        raise InputError(f"{path}: exposures {', '.join(images)} are the same image; choose one with ext= (--ext)")
    return images


def _nothing(solution, path, name):
    if name not in solution.left_out:
        try:
            solution.index(name)
        except InputError as error:
            raise InputError(f"{path}: {error}; frames are told by their names") from None
    log.warning("%s: skipped, it was left out of the solution (%s)", path, solution.left_out[name])
    return {}


def _asdf_edits(solution, images, spans, *, path, overwrite):
    """Edits that replace or append the ASDF extensions of the images."""
    present = [span for span in spans if span.header.get("EXTNAME") == "ASDF"]
    ours = {span.header["IMAGEHDU"]: span for span in present if "IMAGEHDU" in span.header}
    foreign = [span for span in present if "IMAGEHDU" not in span.header]
    if foreign and not overwrite:
        raise InputError(
            f"{path} already has an extension ASDF of another program, {foreign[0].header.get('CREATOR', 'unnamed')}, "
            "which may hold more than the WCS; give overwrite=True (--overwrite) to replace it"
        )
    edits = [(span.start, span.stop, b"") for span in foreign]
    numbers = {image: span.header.get("EXTVER", 1) for image, span in ours.items()}
    end = spans[-1].stop
    for name, image in images.items():
        if image not in numbers:
            numbers[image] = next(n for n in range(1, len(spans) + 2) if n not in numbers.values())
        start, stop = (ours[image].start, ours[image].stop) if image in ours else (end, end)
        edits.append((start, stop, _asdf_hdu(wcs_tree(solution, name), image, numbers[image])))
    return edits


def _asdf_hdu(tree, image, number):
    """Bytes of the one-row table that holds an ASDF file."""
    content, file = io.BytesIO(), io.BytesIO()
    asdf.AsdfFile(tree, version=ASDF_STANDARD).write_to(content)
    row = np.frombuffer(content.getvalue(), np.uint8)[None]
    column = fits.Column(name="ASDF_METADATA", array=row, format=f"{row.size}B")
    hdu = fits.BinTableHDU.from_columns([column], name="ASDF", ver=number)
    hdu.header["CREATOR"] = f"legdistort {version('legdistort')}"
    hdu.header["IMAGEHDU"] = (image, "number of the HDU it belongs to, primary = 0")
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(file, checksum=True)
    return file.getvalue()[BLOCK:]
