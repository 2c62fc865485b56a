"""Another gwcs in an ASDF file of somebody else's, in which every other key, tag and block stays as it is.

But for what pipelines keep beside the WCS in ``wcsinfo``: the footprint ``s_region``, which becomes that of the new
one, and copies of cards, which data models write over those of the header when they are saved next. Texts are exchanged
within the YAML of the file; what stands before and after them, and the arrays that follow, are not read as objects,
which would take the packages that wrote them.
"""

import io
import re

import asdf
import numpy as np
import yaml
from astropy.io import fits

from ..exceptions import InputError
from ..inputs.wcs_files import wcs_in
from ..runtime.asdf_files import ARCHIVES, read_tree
from ..runtime.fits_bytes import BLOCK
from .footprints import renewed_region
from .refinement import refine

_END = re.compile(rb"\n\.\.\.\r?\n")
_INDEX = b"#ASDF BLOCK INDEX"
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_BESIDE, _FOOTPRINT = "wcsinfo", "s_region"  # beside the WCS
_HANDLE = "%TAG ! tag:stsci.edu:asdf/"
#: Names of repeated parts, which asdf counts from one in every file.
_ANCHOR = re.compile(r"(?<=[\s,\[{])([&*])id(\d+)\b")


def model_wcs(content, label):
    """What `legdistort.inputs.wcs_files.wcs_in` gives for the bytes of an ASDF file.

    Raises
    ------
    InputError
        If the file cannot be read; `label` is how the message calls it.
    """
    try:
        tree = read_tree(label, content=content, tags=ARCHIVES)
    except InputError as error:
        raise InputError(f"{label}: the WCS in it cannot be exchanged: {error}") from None
    return wcs_in(tree)


def refined_tree(content, found, view, label, header=None, obsolete=None):
    """The bytes of an ASDF file in which the WCS of an image is that of a solution, see `legdistort.refine`.

    Parameters
    ----------
    content : bytes
        The whole file.
    found : tuple
        What `model_wcs` gives.
    view : View
    label : str
        How messages call it.
    header, obsolete : `~astropy.io.fits.Header` and pattern, optional
        Cards of the WCS in the header of the image, and which others no longer belong there: copies in the tree follow.

    Raises
    ------
    InputError
        If it cannot be refined.
    """
    keys, wcs, _ = found
    content = _exchanged(content, keys, refine(wcs, view).stock(), label)

    def renewed(key, text):
        if key == _FOOTPRINT:
            region = renewed_region(text, wcs, view)
            return text if region is None else region
        card = key.upper()
        if header is None or not obsolete.fullmatch(card):
            return text
        return yaml.safe_dump(header.get(card)).splitlines()[0]

    return _with_texts(content, (*keys[:-1], _BESIDE), renewed)


def table_of(header, content):
    """Bytes of the one-row table of FITS that holds an ASDF file, with the header of another one."""
    header = header.copy()
    header["NAXIS1"], header["TFORM1"] = len(content), f"{len(content)}B"
    raw = header.tostring().encode("ascii") + content + bytes(-len(content) % BLOCK)
    if "CHECKSUM" not in header:
        return raw
    file, hdu = io.BytesIO(), fits.BinTableHDU.fromstring(raw)
    hdu.add_checksum()
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(file)
    return file.getvalue()[BLOCK:]


def _exchanged(content, keys, wcs, label):
    end = _END.search(content)
    text, rest = content[: end.end()].decode("utf-8"), content[end.end() :]
    standard = re.search(r"#ASDF_STANDARD (\S+)", text)
    made = io.BytesIO()
    nested = wcs
    for key in reversed(keys):
        nested = {key: nested}
    asdf.AsdfFile(nested, version=standard[1] if standard else None).write_to(made, all_array_storage="inline")
    own = made.getvalue().decode("utf-8")
    if not (_HANDLE in own and _HANDLE in text):
        raise InputError(f"{label}: the WCS in it cannot be exchanged: its tags are not those of the ASDF standard")
    first, last = _span(text, keys)
    new = _ANCHOR.sub(r"\1wcs\2", "".join(own[slice(*_span(own, keys))])).rstrip()
    old = text[first:last]
    changed = text[:first] + new + old[len(old.rstrip()) :] + text[last:]
    if _others(changed, keys) != _others(text, keys):
        raise InputError(f"{label}: the WCS in it cannot be exchanged: other parts of the file refer to it")
    out = changed.encode("utf-8")
    return out + _moved(rest, len(out) - len(content) + len(rest))


def _with_texts(content, keys, renewed):
    """The bytes of an ASDF file in which ``renewed(key, text)`` stands for texts in the mapping at nested keys."""
    end = _END.search(content)
    text, rest = content[: end.end()].decode("utf-8"), content[end.end() :]
    node = _node(text, keys)
    out = text
    for name, value in reversed(node.value if isinstance(node, yaml.MappingNode) else ()):
        if isinstance(value, yaml.ScalarNode) and (new := renewed(name.value, value.value)) != value.value:
            first, last = _places(text, value)
            out = out[:first] + new + out[last:]
    raw = out.encode()
    return content if out == text else raw + _moved(rest, len(raw) - end.end())


def _node(text, keys):
    """The value of nested keys in a YAML text, None where they lead to none."""
    node = yaml.compose(text, Loader=_LOADER)
    for key in keys:
        inside = node.value if isinstance(node, yaml.MappingNode) else ()
        node = next((value for name, value in inside if name.value == key), None)
    return node


def _span(text, keys):
    """Where the value of nested keys begins and ends in a YAML text."""
    return _places(text, _node(text, keys))


def _places(text, node):
    """Where a node begins and ends in the text that it was composed of."""
    starts = np.cumsum([0, *map(len, text.splitlines(keepends=True))])
    return tuple(int(starts[mark.line]) + mark.column for mark in (node.start_mark, node.end_mark))


def _others(text, keys):
    """What a YAML text holds beside the value of nested keys, tags included."""

    def plain(node, keys):
        if isinstance(node, yaml.MappingNode):
            inner = {
                name.value: plain(value, keys[1:] if keys and name.value == keys[0] else None)
                for name, value in node.value
                if keys != (name.value,)
            }
            return node.tag, inner
        if isinstance(node, yaml.SequenceNode):
            return node.tag, [plain(value, None) for value in node.value]
        return node.tag, node.value

    try:
        return plain(yaml.compose(text, Loader=_LOADER), keys)
    except yaml.YAMLError:
        return None


def _moved(rest, by):
    """The blocks of a file with the places in their index, if there is one, moved by so many bytes."""
    place = rest.rfind(_INDEX)
    if place < 0:
        return rest
    return rest[:place] + re.sub(rb"(?m)^- (\d+)", lambda found: b"- %d" % (int(found[1]) + by), rest[place:])
