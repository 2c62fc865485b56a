"""ASDF files from anywhere: sizes bounded before anything is unpacked, nothing executed, nonsense refused in words.

A file is looked at three times: its blocks (what they declare to hold), its YAML as a stream of events (length,
nesting, repetition by aliases, tags), and its tree before any object is made of it (references, sizes of arrays).
Only then does asdf open it.

It guards those who read a solution, a prior or a WCS that somebody sent them or that lies on a server: against files
that fill the memory (a few kilobytes can unpack to any size), name files elsewhere, or call whatever converters are
installed; and against those that were cut off or damaged on the way, for which asdf alone has no words.
"""

import bz2
import hashlib
import io
import math
import mmap
import re
import struct
import warnings
import zlib
from contextlib import contextmanager, nullcontext
from importlib import resources
from pathlib import Path

import asdf
import numpy as np
import yaml
from asdf.resource import DirectoryResourceMapping
from asdf.tags.core.ndarray import asdf_datatype_to_numpy_dtype

from ..exceptions import InputError
from .checks import check_is_file, first_line
from .guards.memory import ANY_BYTES, MAX_BYTES, check_memory, most_bytes
from .guards.offline import offline
from .guards.yaml_text import LOADER, TooLargeError, check_yaml

#: Version of the ASDF standard that is written.
ASDF_STANDARD = "1.5.0"
#: Beginning of the ``id`` of our schemas; version and all stand in the names of their files.
SCHEMAS = "asdf://legdistort/schemas/"
#: Tags of plain trees: arrays, and what asdf records of itself.
CORE = ("tag:stsci.edu:asdf/core/",)
#: Tags of a tree with a gwcs inside.
WITH_WCS = (
    "tag:stsci.edu:asdf/",
    "tag:stsci.edu:gwcs/",
    "tag:astropy.org:astropy/coordinates/",
    "tag:astropy.org:astropy/time/",
    "tag:astropy.org:astropy/transform/",
    "tag:astropy.org:astropy/units/",
)
#: Tags of files that hold a WCS: those of gwcs, and what the archives of JWST and Roman put around it (`tweakreg`
#: leaves a table of its sources).
ARCHIVES = (
    *WITH_WCS, "tag:stsci.edu:jwst_pipeline/", "tag:stsci.edu:jwst_datamodel/", "asdf://stsci.edu/datamodels/",
    "tag:astropy.org:astropy/table/",
)  # fmt: skip
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_MOST_AXES = 100
_AT_ONCE = 1 << 20
_BYTES_PER_NODE = 2048  # what a node of YAML takes in memory while it is read, about
_BLOCK = b"\xd3BLK"
_HEADER = struct.Struct(">I4sQQQ16s")  # flags, compression, allocated, used, unpacked, checksum


def read_tree(path, *, content=None, tags=CORE, max_bytes=MAX_BYTES):
    """The tree of an ASDF file, all arrays in memory.

    Parameters
    ----------
    path : str or path
    content : bytes, optional
        What stands in the file, if it is part of another one; `path` then is a name for messages. Arrays that are
        other HDUs of that FITS file (``source: fits:SCI,1``, as JWST has them) are None in the tree.
    tags : tuple of str
        Beginnings of the YAML tags that may stand in the file; a tag makes asdf call a converter.
    max_bytes : int
        Largest size of all arrays together, unpacked. The tree itself may have one node for every 2048 of them.

    Raises
    ------
    InputError
        Naming the file and what is wrong with it.
    """
    if not isinstance(max_bytes, int) or max_bytes < 1:
        raise InputError(f"max_bytes must be a positive number of bytes, got {max_bytes!r}")
    inside = content is not None
    if inside and b"fits:" in content:
        content = _without_fits_arrays(path, content)
    if not inside:
        check_is_file(path)
    try:
        # absolute, since asdf takes ~x for somebody's home
        source = io.BytesIO(content) if inside else Path(path).absolute().open("rb")
        with source as file, open_checked(file, tags=tags, max_bytes=max_bytes) as opened:
            return dict(opened.tree)
    except TooLargeError as error:
        raise InputError(
            f"{path} is refused: {error} bytes are allowed; if you trust the file, allow more with max_bytes= "
            "(--max-bytes)"
        ) from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except MemoryError:
        raise MemoryError(f"for {path}") from None
    except Exception as error:  # whatever a broken file provokes
        raise InputError(f"{path} is not a readable ASDF file: {_fault(error)}") from None


@contextmanager
def open_checked(file, *, tags, max_bytes, packings=("zlib",), lazy_load=False):
    """An ASDF file, open, after all that it declares was checked.

    Parameters
    ----------
    file : binary file
    tags, max_bytes
        As for `read_tree`.
    packings : tuple of str
        Ways to pack arrays that are allowed: "zlib", "bzp2", "lz4".
    lazy_load : bool
        Whether arrays are read when they are asked for.

    Raises
    ------
    TooLargeError
        The sentence on what is too large, without the limit.
    Exception
        Whatever a broken file provokes.
    """
    quiet = warnings.catch_warnings(action="ignore", category=asdf.exceptions.AsdfWarning)  # the schema decides
    with offline(), quiet:
        inside = isinstance(file, io.BytesIO)
        whole = nullcontext(file.getvalue()) if inside else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        with whole as content:
            start = _check_yaml(content, tags, max_bytes)
            most = max_bytes if max_bytes != MAX_BYTES else most_bytes(len(content))  # who allows more, trusts it
            _check_blocks(content, start, most, packings)
        _check_node(asdf.util.load_yaml(file, tagged=True), "", [most], most)
        file.seek(0)
        with asdf.open(file, memmap=False, lazy_load=lazy_load) as opened:
            yield opened


def schema_resources():
    """Entry point ``asdf.resource_mappings``: our schemas by their ``id``."""
    return [DirectoryResourceMapping(resources.files("legdistort") / "data" / "schemas", SCHEMAS)]


def check_layout(layout, known, path):
    """Raise `InputError` for a file of another layout than the one that this version knows."""
    if hasattr(layout, "shape"):
        raise InputError(f"{path} is damaged: its layout is an array, not a number")
    known = known if isinstance(known, tuple) else (known,)
    if layout not in known:
        raise InputError(f"{path} has layout {layout!r}, this version reads {known[-1]}; update legdistort")


def check_tree(tree, schema, path):
    """Check a tree against a schema of the package.

    Parameters
    ----------
    tree : dict
    schema : str
        Name of a file in ``legdistort/data/schemas`` without ``.yaml``.
    path : str or path
        The file, for messages.

    Raises
    ------
    InputError
        Naming the entry, what stands there and what should.
    """
    try:
        with asdf.config_context() as config:  # for those who have the package without installing it
            for mapping in schema_resources():
                config.add_resource_mapping(mapping)
            asdf.AsdfFile(tree, custom_schema=f"{SCHEMAS}{schema}").validate()
    except asdf.exceptions.ValidationError as error:
        entry = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in error.absolute_path).lstrip(".")
        known = isinstance(error.schema, dict) and error.validator != "required"
        meaning = error.schema.get("description", "") if known else ""
        raise InputError(
            f"{path} is damaged: entry {entry or 'tree'}: {first_line(error)[:200]}"
            + (f"; it should be {meaning}" if meaning else "")
        ) from None
    except Exception as error:  # a tree that asdf cannot take
        raise InputError(f"{path} is damaged: {first_line(error)}") from None


def _without_fits_arrays(path, content):
    """The file with null in the place of the arrays that are HDUs of the FITS file around it."""
    end = re.compile(rb"\r?\n\.\.\.\r?\n").search(content)
    if end is None:
        return content  # which is reported later
    kept, held, depth, elsewhere = [], [], 0, False
    try:
        for event in yaml.parse(content[: end.end()], Loader=LOADER):
            if held or (isinstance(event, yaml.events.MappingStartEvent) and "/core/ndarray-" in (event.tag or "")):
                held.append(event)
                depth += isinstance(event, yaml.events.CollectionStartEvent)
                depth -= isinstance(event, yaml.events.CollectionEndEvent)
                elsewhere |= isinstance(event, yaml.events.ScalarEvent) and event.value.startswith("fits:")
                if depth == 0:
                    null = yaml.events.ScalarEvent(held[0].anchor, None, (True, False), "null")
                    kept += [null] if elsewhere else held
                    held, elsewhere = [], False
            else:
                kept.append(event)
        comments = [line for line in content[: end.end()].splitlines() if line.startswith(b"#ASDF")]
        text = yaml.emit(kept, Dumper=_DUMPER, allow_unicode=True, width=1000).encode()
    except yaml.YAMLError as error:
        raise InputError(f"{path} is not a readable ASDF file: {_fault(error)}") from None
    text = text if text.rstrip().endswith(b"...") else text.rstrip() + b"\n..."
    return b"\n".join(comments) + b"\n" + text.rstrip() + b"\n" + content[end.end() :]


def _fault(error):
    """What is wrong with a file, in one line; the first line of a message on its YAML says only what was being read."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        return f"{error.problem} (line {error.problem_mark.line + 1}, column {error.problem_mark.column + 1})"
    return first_line(error)


def _check_yaml(content, tags, max_bytes):
    """Check the text of the tree event by event, and return where it ends."""
    if content[:5] != b"#ASDF":
        raise ValueError("it does not begin with #ASDF")
    most = max_bytes // _BYTES_PER_NODE
    found = re.compile(rb"\r?\n\.\.\.(\r?\n|$)").search(content)
    if not found:
        raise ValueError("its tree has no end; the file is cut off")
    if found.end() > 32 * most + 10_000:
        raise TooLargeError(f"its tree is {found.end()} bytes of text, more than 1 for every 64 of arrays. {max_bytes}")
    check_yaml(content[: found.end()], tags, most, f", 1 for every {_BYTES_PER_NODE} bytes. {max_bytes}")
    return found.end()


def _check_blocks(content, start, max_bytes, packings):
    """Check what the blocks of arrays declare to hold, before any is unpacked."""
    place, total = content.find(_BLOCK, start), 0
    number = 0
    while place >= 0 and content[place : place + 4] == _BLOCK:
        (size,) = struct.unpack(">H", content[place + 4 : place + 6])
        header = content[place + 6 : place + 6 + _HEADER.size]
        flags, packing, allocated, used, unpacked, checksum = _HEADER.unpack(header)
        if flags & 1:
            raise ValueError(f"block {number} is a stream of unknown length")
        kind = packing.rstrip(b"\0").decode("latin-1")
        if kind and kind not in packings:
            raise ValueError(f"block {number} is packed with {packing!r}; write it anew with zlib, or unpacked")
        place += 6 + size
        if place + allocated > len(content) or used > allocated:
            raise ValueError(f"block {number} reaches beyond the end of the file; it is cut off")
        total += unpacked
        if total > max_bytes:
            raise TooLargeError(f"its arrays take {total} bytes and more when unpacked. {max_bytes}")
        if not _holds_what_it_declares(content[place : place + used], kind, unpacked):
            raise ValueError(f"block {number} is damaged: it does not unpack to the {unpacked} bytes that it declares")
        if any(checksum) and not _is_whole(content[place : place + used], checksum, packing, unpacked):
            raise ValueError(f"block {number} is damaged: its checksum is another")
        place += allocated
        number += 1
    if total > ANY_BYTES:
        check_memory(total, "its arrays take")


def _holds_what_it_declares(data, kind, unpacked):
    """Whether data unpack to as many bytes as declared, where more could come of them before asdf notices."""
    if kind == "bzp2":
        unpacker, found, some = bz2.BZ2Decompressor(), 0, data
        while not unpacker.eof and found <= unpacked:
            piece = unpacker.decompress(some, _AT_ONCE)
            if not piece and unpacker.needs_input:
                return False
            found, some = found + len(piece), b""
        return found == unpacked
    if kind == "lz4":  # pieces, each behind its length, and each beginning with the length that it unpacks to
        found = place = 0
        while place + 8 <= len(data):
            found += struct.unpack_from("<I", data, place + 4)[0]
            place += 4 + struct.unpack_from(">I", data, place)[0]
        return found == unpacked and place == len(data)
    return True  # zlib, a little at a time


def _is_whole(data, checksum, packing, unpacked):
    """Whether the checksum is that of the data: as they stand there or, by earlier versions of asdf, as they unpack."""
    if hashlib.md5(data, usedforsecurity=False).digest() == checksum:
        return True
    if packing != b"zlib":
        return False
    data = zlib.decompressobj().decompress(data, max(unpacked, 1))  # not a byte more than declared
    return hashlib.md5(data, usedforsecurity=False).digest() == checksum


def _check_node(node, where, left, most):
    """Check references and sizes of arrays below a node of the tree; `left` holds the bytes left for arrays."""
    if isinstance(node, dict):
        if "$ref" in node:
            raise ValueError(f"entry {where or 'tree'} refers to another file, which is not followed")
        if "/core/ndarray-" in getattr(node, "_tag", "") and "data" not in node:
            _check_array(node, where, left, most)
        for key, value in node.items():
            _check_count(key, value, where)
            _check_node(value, f"{where}.{key}" if where else str(key), left, most)
    elif isinstance(node, list):
        for k, value in enumerate(node):
            _check_node(value, f"{where}[{k}]", left, most)


def _check_count(key, value, where):
    """Refuse integers that no array can hold, and more axes than a model has: converters would count them all."""
    most = _MOST_AXES if key in ("n_dims", "n_inputs", "n_outputs", "mapping") else 2**63
    for each in value if isinstance(value, list) else [value]:
        if isinstance(each, int) and not -(2**63) <= each < most:
            raise ValueError(f"entry {where}.{key} has {each}, beyond what can be".replace("entry .", "entry "))


def _check_array(node, where, left, most):
    if not isinstance(node.get("source"), int):
        raise ValueError(f"array {where} lies in another file ({str(node.get('source'))[:80]!r}), which is not opened")
    itemsize = asdf_datatype_to_numpy_dtype(node["datatype"], node.get("byteorder", "big")).itemsize
    left[0] -= math.prod(int(n) for n in node["shape"]) * itemsize  # strides may make much of little
    if left[0] < 0:
        raise TooLargeError(f"array {where} has shape {list(node['shape'])}: too large with those before it. {most}")


def understood(path, function, tree):
    """``function(tree)``, errors in it raised with the name of the file."""
    try:
        with np.errstate(all="ignore"):
            return function(tree)
    except ValueError as error:  # of our checks, in words
        raise InputError(f"{path} is damaged: {error}") from None
    except Exception as error:  # there is no end to what can be wrong in a file
        raise InputError(f"{path} is damaged: {type(error).__name__} {error}") from None


def entry_of(path, entries):
    """The first of some entries that stands at the top of an ASDF file; None if there is no such file, or none."""
    if not Path(path).is_file():
        return None
    with open(path, "rb") as file:
        start = file.read(1 << 20)  # the arrays come later
    if not start.startswith(b"#ASDF"):
        return None
    return next((each for each in entries if re.search(rf"^{each}:".encode(), start, re.MULTILINE)), None)
