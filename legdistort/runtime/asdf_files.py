"""ASDF files from anywhere: sizes bounded before anything is unpacked, nothing executed, nonsense refused in words.

A file is looked at three times: its blocks (what they declare to hold), its YAML as a stream of events (length,
nesting, repetition by aliases, tags), and its tree before any object is made of it (references, sizes of arrays).
Only then does asdf open it.

It guards those who read a solution, a prior or a WCS that somebody sent them or that lies on a server: against files
that fill the memory (a few kilobytes can unpack to any size), name files elsewhere, or call whatever converters are
installed; and against those that were cut off or damaged on the way, for which asdf alone has no words.
"""

import hashlib
import io
import math
import mmap
import re
import struct
import warnings
import zlib
from contextlib import nullcontext
from importlib import resources
from pathlib import Path

import asdf
import numpy as np
import yaml
from asdf.resource import DirectoryResourceMapping
from asdf.tags.core.ndarray import asdf_datatype_to_numpy_dtype

from ..exceptions import InputError
from .checks import check_is_file, first_line

#: Version of the ASDF standard that is written.
ASDF_STANDARD = "1.5.0"
#: Beginning of the ``id`` of our schemas; version and all stand in the names of their files.
SCHEMAS = "asdf://legdistort/schemas/"
#: Bytes that the arrays of a file may take in memory, unless more are allowed.
MAX_BYTES = 2 << 30
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
#: Tags of files that hold a WCS: those of gwcs, and what the archives of JWST and Roman put around it.
ARCHIVES = (*WITH_WCS, "tag:stsci.edu:jwst_pipeline/", "tag:stsci.edu:jwst_datamodel/", "asdf://stsci.edu/datamodels/")
_PLAIN = {f"tag:yaml.org,2002:{kind}" for kind in ("str", "int", "float", "bool", "null", "seq", "map", "timestamp")}
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_MAX_DEPTH = 100
_MOST_AXES = 100
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
        quiet = warnings.catch_warnings(action="ignore", category=asdf.exceptions.AsdfWarning)  # the schema decides
        with io.BytesIO(content) if inside else Path(path).absolute().open("rb") as file, quiet:
            with nullcontext(content) if inside else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as whole:
                _check_blocks(whole, _check_yaml(whole, tags, max_bytes), max_bytes)
            _check_node(asdf.util.load_yaml(file, tagged=True), "", [max_bytes])
            file.seek(0)
            with asdf.open(file, memmap=False, lazy_load=False) as opened:
                return dict(opened.tree)
    except _TooLargeError as error:
        raise InputError(
            f"{path} is refused: {error} {max_bytes} bytes are allowed; if you trust the file, allow more "
            "with max_bytes= (--max-bytes)"
        ) from None
    except Exception as error:  # whatever a broken file provokes
        raise InputError(f"{path} is not a readable ASDF file: {_fault(error)}") from None


def schema_resources():
    """Entry point ``asdf.resource_mappings``: our schemas by their ``id``."""
    return [DirectoryResourceMapping(resources.files("legdistort") / "data" / "schemas", SCHEMAS)]


def check_layout(layout, known, path):
    """Raise `InputError` for a file of another layout than the one that this version knows."""
    if hasattr(layout, "shape"):
        raise InputError(f"{path} is damaged: its layout is an array, not a number")
    if layout != known:
        raise InputError(f"{path} has layout {layout!r}, this version reads {known}; update legdistort")


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
        for event in yaml.parse(content[: end.end()], Loader=_LOADER):
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


class _TooLargeError(Exception):
    """A size beyond the limit; the sentence without the limit."""


def _check_yaml(content, tags, max_bytes):
    """Check the text of the tree event by event, and return where it ends."""
    if content[:5] != b"#ASDF":
        raise ValueError("it does not begin with #ASDF")
    most = max_bytes // _BYTES_PER_NODE
    found = re.compile(rb"\r?\n\.\.\.(\r?\n|$)").search(content)
    if not found:
        raise ValueError("its tree has no end; the file is cut off")
    if found.end() > 32 * most + 10_000:
        raise _TooLargeError(f"its tree is {found.end()} bytes of text, more than 1 for every 64 of arrays.")
    counts, anchors = [[None, 0]], {}  # open collections: anchor, number of nodes with aliases written out
    for event in yaml.parse(content[: found.end()], Loader=_LOADER):
        if isinstance(event, yaml.events.AliasEvent):
            if event.anchor not in anchors:
                raise ValueError(f"alias *{event.anchor} of nothing, or within itself")
            counts[-1][1] += anchors[event.anchor]
        elif isinstance(event, yaml.events.CollectionEndEvent):
            anchor, number = counts.pop()
            anchors[anchor] = number
            counts[-1][1] += number
        elif isinstance(event, yaml.events.NodeEvent):
            if event.tag and event.tag not in _PLAIN and not event.tag.startswith(tags):
                raise ValueError(f"tag {event.tag[:100]!r} has no business in such a file; is it the one you mean?")
            if isinstance(event, yaml.events.CollectionStartEvent):
                counts.append([event.anchor, 1])
            else:
                anchors[event.anchor] = 1
                counts[-1][1] += 1
        if len(counts) > _MAX_DEPTH:
            raise ValueError(f"its tree is nested more than {_MAX_DEPTH} levels deep")
        if counts[-1][1] > most:
            raise _TooLargeError(f"its tree has more than {most} nodes, 1 for every {_BYTES_PER_NODE} bytes.")
    return found.end()


def _check_blocks(content, start, max_bytes):
    """Check what the blocks of arrays declare to hold, before any is unpacked."""
    place, total = content.find(_BLOCK, start), 0
    number = 0
    while place >= 0 and content[place : place + 4] == _BLOCK:
        (size,) = struct.unpack(">H", content[place + 4 : place + 6])
        header = content[place + 6 : place + 6 + _HEADER.size]
        flags, packing, allocated, used, unpacked, checksum = _HEADER.unpack(header)
        if flags & 1:
            raise ValueError(f"block {number} is a stream of unknown length")
        # bzip2 and lz4 unpack more than they declare before anyone notices
        if packing not in (b"\0\0\0\0", b"zlib"):
            raise ValueError(f"block {number} is packed with {packing!r}; write it anew with zlib, or unpacked")
        place += 6 + size
        if place + allocated > len(content) or used > allocated:
            raise ValueError(f"block {number} reaches beyond the end of the file; it is cut off")
        total += unpacked
        if total > max_bytes:
            raise _TooLargeError(f"its arrays take {total} bytes and more when unpacked.")
        if any(checksum) and not _is_whole(content[place : place + used], checksum, packing, unpacked):
            raise ValueError(f"block {number} is damaged: its checksum is another")
        place += allocated
        number += 1


def _is_whole(data, checksum, packing, unpacked):
    """Whether the checksum is that of the data: as they stand there or, by earlier versions of asdf, as they unpack."""
    if hashlib.md5(data, usedforsecurity=False).digest() == checksum:
        return True
    if packing != b"zlib":
        return False
    data = zlib.decompressobj().decompress(data, max(unpacked, 1))  # not a byte more than declared
    return hashlib.md5(data, usedforsecurity=False).digest() == checksum


def _check_node(node, where, left):
    """Check references and sizes of arrays below a node of the tree; `left` holds the bytes left for arrays."""
    if isinstance(node, dict):
        if "$ref" in node:
            raise ValueError(f"entry {where or 'tree'} refers to another file, which is not followed")
        if "/core/ndarray-" in getattr(node, "_tag", "") and "data" not in node:
            _check_array(node, where, left)
        for key, value in node.items():
            _check_count(key, value, where)
            _check_node(value, f"{where}.{key}" if where else str(key), left)
    elif isinstance(node, list):
        for k, value in enumerate(node):
            _check_node(value, f"{where}[{k}]", left)


def _check_count(key, value, where):
    """Refuse integers that no array can hold, and more axes than a model has: converters would count them all."""
    most = _MOST_AXES if key in ("n_dims", "n_inputs", "n_outputs", "mapping") else 2**63
    for each in value if isinstance(value, list) else [value]:
        if isinstance(each, int) and not -(2**63) <= each < most:
            raise ValueError(f"entry {where}.{key} has {each}, beyond what can be".replace("entry .", "entry "))


def _check_array(node, where, left):
    if not isinstance(node.get("source"), int):
        raise ValueError(f"array {where} lies in another file ({str(node.get('source'))[:80]!r}), which is not opened")
    itemsize = asdf_datatype_to_numpy_dtype(node["datatype"], node.get("byteorder", "big")).itemsize
    left[0] -= math.prod(int(n) for n in node["shape"]) * itemsize  # strides may make much of little
    if left[0] < 0:
        raise _TooLargeError(f"array {where} has shape {list(node['shape'])}: too large with those before it.")


def understood(path, function, tree):
    """``function(tree)``, errors in it raised with the name of the file."""
    try:
        with np.errstate(all="ignore"):
            return function(tree)
    except ValueError as error:  # of our checks, in words
        raise InputError(f"{path} is damaged: {error}") from None
    except Exception as error:  # there is no end to what can be wrong in a file
        raise InputError(f"{path} is damaged: {type(error).__name__} {error}") from None
