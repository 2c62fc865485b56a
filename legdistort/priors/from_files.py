"""Static distortions from files and names: which kind it is shows in its first bytes."""

import contextlib
import difflib
import io
import re
import warnings
from dataclasses import replace
from pathlib import Path

import gwcs
import numpy as np
from astropy.modeling import Model

from ..cameras.source import of_maps, of_powers
from ..exceptions import AssumptionWarning, InputError, warn, without_astropy_warnings
from ..geometry import basis
from ..geometry.gsaoi import GSAOI_SIZE, gsaoi_static
from ..inputs.detector_files import stated_detector
from ..inputs.exposure_files import read_exposures
from ..inputs.frames.header_texts import headers_of, is_header, read_text
from ..inputs.sky_wcs import image_wcs
from ..runtime.asdf_files import ARCHIVES, read_tree
from ..runtime.checks import check_is_file
from ..runtime.fits_bytes import looks_like_fits, open_fits
from ..runtime.words import DIRECTIONS
from .from_objects import as_source, of_model

#: Highest order of SIP polynomials in a header (the convention allows 9).
SIP_ORDER = 20
_POLYNOMIAL = re.compile(r"^\s*(poly\s*\d+|cubic|quartic|quintic|refpix\b.*)\s*$", re.MULTILINE)
_DEGREES = {"cubic": 3, "quartic": 4, "quintic": 5}
_LOOKUP = re.compile(r"(CPDIS|D2IMDIS)[12]")
_LOOKUP_RECORD = re.compile(r"(DP|D2IM)[12](\..*)?")


def read_source(where, *, ext=None, frame=None):
    """Recognise and read a static distortion.

    Parameters
    ----------
    where : str, path, or sequence of two or four of them
        An ASDF file with a gwcs or a distortion model; a FITS file, or the text of FITS headers, with SIP, TPV or any
        other distortion that astropy reads; a file of Drizzle coefficients; ``gsaoi-1`` ... ``gsaoi-4``;
        ``siaf:INSTRUMENT/APERTURE``; or two FITS images with the shifts of every pixel in x and in y, and perhaps two
        more with their standard errors.
    ext : int, str or (str, int), optional
        Extension of FITS files, place among several headers of a text, or path in the tree of an ASDF file
        (``"roman.meta.wcs"``), where it is not clear.
    frame : str, optional
        As for `legdistort.priors.from_objects.as_source`.

    Returns
    -------
    Source

    Raises
    ------
    InputError
        Naming the file, if it is not there, damaged, or holds no distortion.
    """
    if isinstance(where, (list, tuple)):
        if len(where) > 1 and (other := no_map(where)) is not None:
            raise InputError(
                f"{other} is no FITS map of shifts, of which two (x, then y) are one source; several headers of one "
                "camera, or other sources, are read one by one, and legdistort.combine_nights([...]).prior() is their "
                "mean, with their scatter as its width"
            )
        if len(where) in (2, 4):
            return _refuse(_read_maps(where, ext), frame=frame)
        if len(where) != 1:
            raise InputError(
                "a distortion is one source, or two maps (x, then y), perhaps with two of their errors (x, then y); "
                f"got {len(where)}"
            )
        where = where[0]
    text = str(where)
    if re.fullmatch(r"gsaoi-[1-4]", text):
        known = {"direction": DIRECTIONS[0], "origin": 0, "shape": (GSAOI_SIZE, GSAOI_SIZE)}
        return _refuse(of_model(gsaoi_static(int(text[-1])), text, **known), ext=ext, frame=frame)
    if text.startswith("siaf:"):
        return _refuse(as_source(_aperture(text), frame=frame, name=text), ext=ext)
    path = Path(where)
    check_is_file(path, "give a file, gsaoi-1 ... gsaoi-4, or siaf:INSTRUMENT/APERTURE")
    # files are often a little off the standard; what matters is checked here
    with without_astropy_warnings():
        return _read_file(path, ext, frame)


def no_map(paths):
    """The first of several files that is no FITS image of shifts, but has a distortion of its own; None without one."""
    for path in paths:
        if Path(path).exists() and not looks_like_fits(path):
            return path
        with contextlib.suppress(InputError):
            read_source(path)
            return path
    return None


def _refuse(source, **given):
    """The source, unless an option was given that it does not have."""
    stray = [key for key, value in given.items() if value is not None]
    if stray:
        raise InputError(f"{source.name} ({source.kind}) has no {stray[0]}; leave --{stray[0]} out")
    return source


def _read_file(path, ext, frame):
    with path.open("rb") as file:
        start = file.read(2880)
    if start.startswith(b"#ASDF"):
        source = _from_tree(read_tree(path, tags=ARCHIVES), ext, frame, str(path))
    elif start.startswith((b"\x1f\x8b", b"BZh")) or (start.startswith(b"SIMPLE  =") and b"\n" not in start):
        source = _read_fits(path, ext, frame)
    elif b"\0" not in start:
        source = _refuse(_read_text(path, ext), frame=frame)
    else:
        raise InputError(f"{path} is neither FITS, ASDF, the text of a FITS header nor a file of Drizzle coefficients")
    return replace(source, files=(path,))


# -- ASDF


def _from_tree(tree, ext, frame, name):
    found = dict(_models(tree))
    if ext is not None:
        if str(ext) not in found:
            raise InputError(f"{name}: no gwcs or model at {ext!r}; it has {', '.join(found) or 'none'}")
        found = {ext: found[str(ext)]}
    whole = {key: model for key, model in found.items() if isinstance(model, gwcs.WCS)}
    candidates = whole or found
    if not candidates:
        raise InputError(f"{name} holds neither a gwcs nor a distortion model that can be read here")
    model, *others = candidates.values()
    if any(other is not model for other in others):  # one may stand in several places
        raise InputError(f"{name} holds several distortions: {', '.join(candidates)}; choose one with ext (--ext)")
    if whole:
        instrument = _meta_of(tree).get("instrument")
        named = instrument.get("detector") if isinstance(instrument, dict) else None
        return _of_detector(as_source(model, frame=frame, name=name), str(named or ""))
    return _refuse(_reference_model(model, tree, name), frame=frame)


def _models(tree, path=""):
    """Path and value of every gwcs and model in a tree of dicts and lists; `read_tree` took none that holds itself."""
    if isinstance(tree, (gwcs.WCS, Model)):
        yield path, tree
    elif isinstance(tree, (dict, list)):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            if key not in ("asdf_library", "history"):
                yield from _models(value, f"{path}.{key}".lstrip("."))


def _meta_of(tree):
    """What a tree of JWST or Roman states of its data; empty for nothing."""
    roman = tree.get("roman")
    meta = roman.get("meta") if isinstance(roman, dict) else tree.get("meta")
    return meta if isinstance(meta, dict) else {}


def _reference_model(model, tree, name):
    """A bare model; distortion reference files of JWST and Roman state that it leads from pixels to V2 and V3."""
    if str(_meta_of(tree).get("reftype")).lower() != "distortion":
        return of_model(model, name)
    known = {"direction": DIRECTIONS[0], "origin": 0, "sphere": 1 / 3600, "details": {"frame": "v2v3"}}
    return of_model(model, name, **known)


# -- FITS


def _read_fits(path, ext, frame):
    with path.open("rb") as file, open_fits(file, path) as hdulist:
        if ext is None and "ASDF" in hdulist:
            return _of_detector(_from_hdu(hdulist["ASDF"], frame, str(path)), stated_detector(hdulist[0].header))
        return _refuse(_from_hdulist(hdulist, ext, str(path)), frame=frame)


def _of_detector(source, name):
    """The source with the name of its detector, if that is stated."""
    return replace(source, details=source.details | ({"detector": name} if name else {}))


def _from_hdu(hdu, frame, name):
    """The gwcs that JWST and legdistort put into a table of one row (`stdatamodels.asdf_in_fits`)."""
    name, content = f"{name}[ASDF]", np.asarray(hdu.data["ASDF_METADATA"]).tobytes()
    return _from_tree(read_tree(name, content=content, tags=ARCHIVES), None, frame, name)


def _from_hdulist(hdulist, ext, name):
    """The extension asked for, or the first with a distortion, SCI before others."""
    if ext is not None:
        try:
            return _from_header(hdulist[ext].header, f"{name}[{ext}]", hdulist)
        except (KeyError, IndexError):
            contents = ", ".join(f"{i} {hdu.name}".strip() for i, hdu in enumerate(hdulist))
            raise InputError(f"{name}: no extension {ext!r}; it has {contents}") from None
    refusals = []
    for i, hdu in sorted(enumerate(hdulist), key=lambda pair: pair[1].name != "SCI"):
        try:
            return _from_header(hdu.header, f"{name}[{i}]", hdulist)
        except InputError as error:
            refusals.append(str(error))
    raise InputError(next((r for r in refusals if "no celestial" not in r), refusals[0]))


def _from_header(header, name, hdulist=None):
    """The WCS of one header, with what it refers to in other extensions."""
    try:
        for key in ("A_ORDER", "B_ORDER", "AP_ORDER", "BP_ORDER"):
            order = header.get(key, 0)
            if not isinstance(order, (int, float)) or not 0 <= order <= SIP_ORDER:
                raise InputError(f"{name}: {key} = {order!r}; SIP polynomials have orders from 0 to 9")
        header = header.copy()
        if hdulist is None:
            _leave_out_tables(header, name)
        source = as_source(image_wcs(header, hdulist), name=name)
    except InputError:
        raise
    except Exception as error:  # wcslib raises many kinds
        raise InputError(f"{name}: its WCS cannot be read ({' '.join(str(error).split())})") from None
    kind = "FITS header, " + str(header.get("CTYPE1", "WCS"))
    named = stated_detector(header) or (stated_detector(hdulist[0].header) if hdulist else "")
    return _of_detector(replace(source, kind=kind, shape=source.shape or _shape(header)), named)


def _shape(header):
    """Detector of a header without its image, if it states it; the second pair is that of astrometry.net."""
    for keys in (("NAXIS2", "NAXIS1"), ("IMAGEH", "IMAGEW")):
        if all(isinstance(header.get(key), int) and header[key] >= 2 for key in keys):
            return header[keys[0]], header[keys[1]]
    return None


def _leave_out_tables(header, name):
    tables = [key for key in header if _LOOKUP.fullmatch(key)]
    if tables:
        for key in {key for key in header if _LOOKUP.fullmatch(key) or _LOOKUP_RECORD.fullmatch(key)}:
            header.remove(key, remove_all=True)
        sizes = [f"{key} = {header[key]}" for key in header if re.fullmatch("(CP|D2IM)ERR[12]", key)]
        warn(
            f"{name}: the look-up tables that the header refers to ({', '.join(tables + sizes)}) are not in a text: "
            "left out; give the FITS file to have them",
            AssumptionWarning,
        )


def _read_maps(paths, ext):
    names = [str(path) for path in paths]
    for x, y in zip(names[::2], names[1::2], strict=True):
        swapped = [(a, b) for a, b in zip(Path(x).name, Path(y).name, strict=False) if a != b]
        if len(x) == len(y) and [(a.lower(), b.lower()) for a, b in swapped] == [("y", "x")]:
            raise InputError(f"{x} and {y}: the map of the shifts in x comes first, then that in y")
    maps = [read_exposures(path, ext=ext)[0] for path in paths]
    values = [np.where(image.mask, np.nan, image.data) for image in maps]
    return replace(of_maps(*values, name=", ".join(names)), files=tuple(map(Path, paths)))


# -- text


def _read_text(path, ext):
    text = read_text(path)
    if is_header(text):
        return _read_header_text(text, ext, str(path))
    if _POLYNOMIAL.search(text):
        return _refuse(_read_powers(text, str(path)), ext=ext)
    raise InputError(f"{path} is neither FITS, ASDF, the text of a FITS header nor a file of Drizzle coefficients")


def _read_header_text(text, ext, name):
    """One header, or several as SCAMP writes them."""
    headers = headers_of(text)
    if ext is None and len(headers) > 1:
        raise InputError(
            f"{name} holds {len(headers)} headers: choose one with ext (--ext) 0 ... {len(headers) - 1}; of several "
            f"detectors legdistort camera FRAME --headers {name} --out camera.asdf takes all, for --camera"
        )
    if not str(ext or 0).isdigit() or int(ext or 0) >= len(headers):
        raise InputError(f"{name}: no header {ext!r}; it has {len(headers)}, counted from 0")
    return _from_header(headers[int(ext or 0)], name if len(headers) == 1 else f"{name}[{ext}]")


def _read_powers(text, name):
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    try:
        centre = None
        if lines[0].split()[0] == "refpix":
            centre = tuple(float(word) - 1 for word in lines.pop(0).split()[1:])  # FITS pixels
        kind = lines.pop(0).strip()
        degree = _DEGREES[kind] if kind in _DEGREES else int(kind.removeprefix("poly"))
        numbers = np.array([float(word.replace("D", "e")) for line in lines for word in line.split()])
        coefficients = numbers.reshape(2, basis.n_modes(basis.check_degree(degree)))
        if not np.all(np.isfinite(numbers)) or (centre is not None and not np.all(np.isfinite(centre))):
            raise ValueError("numbers that are not finite")
        if centre is not None and len(centre) != 2:
            raise ValueError("refpix needs x and y")
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise InputError(
            f"{name}: not a file of Drizzle coefficients, which is 'poly N' or 'cubic', (N+1)(N+2)/2 numbers for x "
            f"and as many for y ({error})"
        ) from None
    return of_powers(coefficients, name, centre=centre)


# -- SIAF


def _aperture(text):
    """``siaf:INSTRUMENT/APERTURE`` as a `pysiaf` aperture."""
    instrument, slash, name = text.removeprefix("siaf:").partition("/")
    if not (instrument and slash and name):
        raise InputError(f"{text!r} is not of the form siaf:INSTRUMENT/APERTURE, as in siaf:NIRCam/NRCA1_FULL")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it greets with a check of its own version
            import pysiaf
    except ImportError:
        raise InputError(f"{text}: SIAF apertures need pysiaf; pip install pysiaf") from None
    try:
        with warnings.catch_warnings(action="ignore"), contextlib.redirect_stdout(io.StringIO()):
            siaf = pysiaf.Siaf(instrument)
    except Exception as error:  # it knows its instruments by its own files
        raise InputError(f"{text}: pysiaf has no instrument {instrument!r} ({error})") from None
    if name not in siaf.apertures:
        alike = difflib.get_close_matches(name, list(siaf.apertures), n=8, cutoff=0)
        raise InputError(f"{text}: {instrument} has no aperture {name!r}; it has {', '.join(alike)}, ...")
    return siaf[name]
