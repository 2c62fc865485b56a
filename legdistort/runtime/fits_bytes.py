"""FITS files as bytes: opened with their sizes bounded; and changed in some cards, every other byte as it is.

A few kilobytes can unpack to any size, and a header can claim any. What is packed is unpacked here, after it was
counted how much that is, and what a header claims must be in the file.

Writing a file anew through astropy may reformat cards, scale integers or compress again; here none of that can happen.
"""

import bz2
import gzip
import io
import lzma
import math
import re
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.io import fits

from ..exceptions import DamagedError, InputError, LegdistortError, without_astropy_warnings
from .checks import check_is_file
from .guards.memory import ANY_BYTES, check_memory, most_bytes
from .guards.offline import offline

BLOCK = 2880
_CARD = 80
_MOST_COUNTED = 999
_LONGEST = 1 << 26  # bytes of a header
#: Bytes that an image or table may claim beyond what is in its file; if more are missing, no part of it is read.
_MISSING = 1 << 26
_AT_ONCE, _PIECE = 1 << 24, 1 << 20
_UNPACKERS = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\0": lzma.open,
    b"PK\x03\x04": lambda file: (archive := zipfile.ZipFile(file)).open(archive.infolist()[0]),
}
_PACKERS = {b"\x1f\x8b": lambda raw: gzip.compress(raw, mtime=0), b"BZh": bz2.compress}


class Span(NamedTuple):
    """Where an HDU lies in a file: offsets of its header, of its data, and of what follows; and its header."""

    start: int
    data: int
    stop: int
    header: fits.Header


def read_bytes(path):
    """The unpacked content of a FITS file, and the function that packs it as it was (gzip, bzip2 or not at all).

    Raises
    ------
    InputError
        If the file is missing, damaged or not FITS.
    """
    path = Path(path)
    check_is_file(path)
    raw = path.read_bytes()
    pack = next((packer for magic, packer in _PACKERS.items() if raw.startswith(magic)), bytes)
    try:
        raw = raw if pack is bytes else unpacked(io.BytesIO(raw), path).getvalue()
    except OSError as error:
        raise InputError(f"{path}: cannot be unpacked, damaged ({error})") from None
    if not raw.startswith(b"SIMPLE  ="):
        raise InputError(f"{path}: not a FITS file, plain or packed with gzip or bzip2")
    return raw, pack


def unpacked(file, name, max_bytes=None):
    """An open file, or its content unpacked as a file in memory.

    Parameters
    ----------
    file : binary file
    name : str or path
        For the message.
    max_bytes : int, optional
        What can be expected of a file of its size if not given (`legdistort.runtime.guards.memory.most_bytes`).

    Raises
    ------
    InputError
        If it would be larger.
    OSError
        If it cannot be unpacked.
    """
    magic = file.read(6)
    file.seek(0)
    unpacker = next((unpacker for start, unpacker in _UNPACKERS.items() if magic.startswith(start)), None)
    if unpacker is None:
        return file
    most = most_bytes(file.seek(0, io.SEEK_END)) if max_bytes is None else max_bytes
    file.seek(0)
    try:
        content, size = _counted(unpacker, file, most)
    except (EOFError, ValueError, IndexError, RuntimeError, zlib.error, lzma.LZMAError, zipfile.BadZipFile) as error:
        raise OSError(f"it cannot be unpacked: {error}") from None
    if size > most:
        raise InputError(f"{name} is refused: it unpacks to more than {most} bytes; if you trust it, unpack it first")
    if len(content) < size:
        check_memory(size, f"{name} unpacks to")
        file.seek(0)
        with unpacker(file) as packed:
            content = packed.read()
    return io.BytesIO(content)


def _counted(unpacker, file, most):
    """The first bytes that a packed file unpacks to, and how many these are in all, counted until they are too many."""
    with unpacker(file) as packed:
        content = packed.read(_AT_ONCE)
        size = len(content)
        while size <= most and (piece := packed.read(_PIECE)):
            size += len(piece)
    return content, size


def looks_like_fits(path):
    """Whether a path is a file that begins as FITS does, packed or not."""
    path = Path(path)
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(9)
    return start.startswith((b"SIMPLE  =", *_UNPACKERS))


@contextmanager
def readable(name):
    """A block that reads FITS: whatever a damaged file provokes becomes a `DamagedError` that begins with its name."""
    try:
        yield
    except (LegdistortError, MemoryError):
        raise
    except Exception as error:  # astropy and wcslib raise many kinds
        raise DamagedError(
            f"{name}: cannot be read as FITS, damaged or something else ({' '.join(str(error).split())})"
        ) from None


@contextmanager
def open_fits(file, name, instead=None):
    """An HDUList of an open file, unpacked if it is packed, in which nothing claims more than there may be.

    Parameters
    ----------
    file : binary file
    name : str or path
        For messages.
    instead : str, optional
        What to do with a file that is not FITS at all, for the message.

    Raises
    ------
    InputError
        For a file that unpacks to more than its size lets expect, and for more than the memory that is left.
    DamagedError
        For an image or table that claims far more than the file has, a compressed image that claims more than can come
        of it; and for whatever a damaged file provokes in the block.
    """
    with offline(), readable(name), unpacked(file, name) as content:
        size = content.seek(0, io.SEEK_END)
        _check_counts(content, size, name)
        content.seek(0)
        with without_astropy_warnings():
            hdulist = _opened(content, name, instead)
            for i, hdu in enumerate(hdulist):
                _check_claim(i, hdu, size, name)
        with hdulist:
            yield hdulist


def _opened(content, name, instead):
    start = content.read(9)
    if not start.startswith(b"SIMPLE  ="):  # before astropy tries what else it could be
        fault = "cannot be read as FITS, damaged or something else (it has no card SIMPLE)"
        raise DamagedError(f"{name}: {fault}" + (f"; {instead}" if instead else ""))
    content.seek(0)
    return fits.open(content, memmap=False)


def _check_counts(content, size, name):
    """Refuse headers with more axes or columns than FITS knows, since astropy would count them all, or less than none.

    Where a header is not understood the rest is left to astropy.
    """
    place = 0
    while place < size:
        content.seek(place)
        header = b""
        while not any(
            header[k : k + _CARD].rstrip() == b"END" for k in range(max(len(header) - BLOCK, 0), len(header), _CARD)
        ):
            block = content.read(BLOCK)
            header += block
            if len(block) < BLOCK or len(header) > _LONGEST:
                return
        known = {}
        for start in range(0, len(header), _CARD):
            card = header[start : start + _CARD]
            if found := re.match(rb"(Z?BITPIX|Z?NAXIS\d*|TFIELDS|Z?[PG]COUNT|ZTILE\d+) *= *([-+]?\d+)?", card):
                key = found[1].decode()
                if found[2] is None:  # and that many texts would be made of a text
                    told = card[9:].split(b"/")[0].strip().decode("ascii", "replace")
                    raise DamagedError(f"{name}: damaged, {key} = {told} in a header is no number")
                value = int(found[2])
                if key in ("NAXIS", "ZNAXIS", "TFIELDS") and not 0 <= value <= _MOST_COUNTED:
                    raise DamagedError(f"{name}: damaged, {key} = {value} in a header; FITS has 0 to {_MOST_COUNTED}")
                if value < 0 and not key.endswith("BITPIX"):  # it would be read again and again, from before its start
                    raise DamagedError(f"{name}: damaged, {key} = {value} in a header; FITS has 0 or more")
                if known.setdefault(key, value) != value:  # astropy takes now the one, now the other
                    raise DamagedError(f"{name}: damaged, a header has {key} twice, {known[key]} and {value}")
        axes = [known.get(f"NAXIS{k}", 0) for k in range(1, known.get("NAXIS", 0) + 1)]
        n = (known.get("PCOUNT", 0) + math.prod(axes)) * known.get("GCOUNT", 1) if axes else 0
        place += len(header) + -(-n * abs(known.get("BITPIX", 8)) // 8 // BLOCK) * BLOCK


def _check_claim(i, hdu, size, name):
    label = f"HDU {i} {hdu.name}".strip()
    if isinstance(hdu, fits.CompImageHDU):
        claimed, most = math.prod(hdu.shape) * abs(hdu.header["BITPIX"]) // 8, most_bytes(size)
        if claimed > most:
            raise DamagedError(f"{name}: {label} claims {claimed} bytes, of {size} in the file at most {most} can come")
    else:
        claimed, there = hdu.size, size - (hdu.fileinfo() or {"datLoc": 0})["datLoc"]
        if claimed > there + _MISSING:
            raise DamagedError(f"{name}: {label} claims {claimed} bytes, there are {there} in the file; it is cut off")
    if claimed > ANY_BYTES:
        check_memory(claimed, f"{name}: {label} takes")


def open_bytes(raw, **options):
    """An HDUList of the content of a file, its oddities left alone."""
    with without_astropy_warnings():
        hdulist = fits.open(io.BytesIO(raw), memmap=False, **options)
        len(hdulist)  # astropy reads headers when they are asked for
    return hdulist


def locate(raw, path):
    """The `Span` of every HDU.

    Raises
    ------
    InputError
        If one is incomplete; `path` names the file.
    """
    spans = []
    _check_counts(io.BytesIO(raw), len(raw), path)
    with readable(path), open_bytes(raw, disable_image_compression=True) as hdulist:
        for i, hdu in enumerate(hdulist):
            info = hdu.fileinfo()
            if info["datLoc"] + info["datSpan"] > len(raw):
                raise InputError(f"{path}: truncated, the data of HDU {i} {hdu.name} are incomplete".replace("  ", " "))
            spans.append(Span(info["hdrLoc"], info["datLoc"], info["datLoc"] + info["datSpan"], hdu.header))
    rest = raw[spans[-1].stop :]
    if rest.strip(b"\0 "):
        raise InputError(f"{path}: damaged or truncated, the {len(rest)} bytes after HDU {len(spans) - 1} are no HDU")
    return spans


def splice(raw, edits):
    """The bytes with parts exchanged: `edits` are ``(start, stop, replacement)`` that do not overlap."""
    pieces, position = [], 0
    for start, stop, replacement in sorted(edits, key=lambda edit: edit[:2]):
        pieces += [raw[position:start], replacement]
        position = stop
    return b"".join([*pieces, raw[position:]])


def exchange_cards(header, data, new, obsolete):
    """The bytes of a header with some cards exchanged and, if it has one, its ``CHECKSUM`` renewed.

    Parameters
    ----------
    header, data : bytes
        Of one HDU, padding included. ``DATASUM`` stays true, since the data do not change.
    new : `~astropy.io.fits.Header`
        Cards that take the place of the first card removed, or go to the end.
    obsolete : compiled regular expression
        A card whose keyword matches it wholly is removed, together with its continuation; of ``HISTORY``, one whose
        whole text with the keyword does.
    """
    cards, place, removing = [], None, False
    for start in range(0, len(header), _CARD):
        card = header[start : start + _CARD]
        keyword = card[:8].decode("ascii", "replace").rstrip()
        if keyword == "END":
            break
        label = card.decode("ascii", "replace").rstrip() if keyword == "HISTORY" else keyword
        removing = obsolete.fullmatch(label) is not None or (removing and keyword == "CONTINUE")
        if not removing:
            cards.append(card)
        elif place is None:
            place = len(cards)
    place = len(cards) if place is None else place
    text = new.tostring(sep="", endcard=False, padding=False).encode("ascii")
    content = b"".join([*cards[:place], text, *cards[place:], b"END".ljust(_CARD)])
    return _with_checksum(content.ljust(-(-len(content) // BLOCK) * BLOCK), data)


def _with_checksum(header, data):
    """The header with the value of its ``CHECKSUM`` card, if any, made true.

    By hand: ``add_checksum`` of astropy sums the header as astropy would write it, cards that it mends and the new date
    in the comment included, and not the bytes that stand here.
    """
    return with_checksum(header, sum32(data))


def with_checksum(header, datasum):
    """The bytes of a header with its ``CHECKSUM`` card, if any, made true; `datasum` is that of the data."""
    found = re.match(rb"(?:.{80})*?(?=CHECKSUM=)", header, re.DOTALL)
    if found is None:
        return header
    place = found.end()

    def with_value(value):
        return header[:place] + f"CHECKSUM= '{value}'".ljust(_CARD).encode("ascii") + header[place + _CARD :]

    return with_value(_encode(0xFFFFFFFF ^ sum32(with_value("0" * 16), datasum)))


def sum32(content, before=0):
    """Sum of 32-bit words in ones' complement (FITS standard 4.0, appendix J.1), and that of what stands before."""
    total = before + int(np.frombuffer(content, ">u4").sum(dtype=np.uint64))
    return total and (total - 1) % 0xFFFFFFFF + 1  # carries come back at the low end


def _encode(value):
    """32 bits as the sixteen letters and digits of a ``CHECKSUM`` card (FITS standard 4.0, appendix J.2)."""
    columns = []
    for byte in value.to_bytes(4, "big"):
        quotient, rest = divmod(byte, 4)
        four = [quotient + rest + 48, quotient + 48, quotient + 48, quotient + 48]
        while any(58 <= c <= 64 or 91 <= c <= 96 for c in four):  # neither letter nor digit: shift within pairs
            for k in (0, 2):
                if any(58 <= c <= 64 or 91 <= c <= 96 for c in four[k : k + 2]):
                    four[k], four[k + 1] = four[k] + 1, four[k + 1] - 1
        columns.append(four)
    letters = "".join(chr(columns[j][i]) for i in range(4) for j in range(4))
    return letters[-1] + letters[:-1]
