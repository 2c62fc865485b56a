"""Cameras as trees of plain arrays, numbers and strings, and as ASDF files of such a tree."""

from functools import partial

import asdf

from ..exceptions import InputError
from ..runtime import provenance
from ..runtime.asdf_files import ASDF_STANDARD, check_layout, check_tree, read_tree, understood
from ..runtime.outputs import replacing
from ..runtime.trees import codec

#: Version of the layout under ``legdistort_camera``.
LAYOUT = 1
#: Entry of a file under which a camera stands.
ROOT = "legdistort_camera"


def from_tree(tree, kind, where=ROOT):
    """The `Camera`, the `kind`, of a tree; `where` is how messages call it."""
    return codec.from_tree(kind, tree, where, strict=False)


def tree_of(camera):
    """A `Camera` as the tree of a file."""
    return {ROOT: {"layout": LAYOUT, "provenance": provenance.stamp()} | codec.to_tree(camera)}


def write_camera(camera, path, *, overwrite=False):
    """Write a `Camera` to an ASDF file; returns the path."""
    with replacing(path, overwrite=overwrite) as file:
        asdf.AsdfFile(tree_of(camera), version=ASDF_STANDARD).write_to(file)
    return path


def read_camera(path, kind):
    """Read a `Camera` from an ASDF file.

    Raises
    ------
    InputError
        If the file is not one that `write_camera` wrote, was damaged since, or has a newer layout.
    """
    tree = read_tree(path).get(ROOT)
    if not isinstance(tree, dict) or "layout" not in tree:
        raise InputError(f"{path} holds no legdistort camera (no entry '{ROOT}'); write one: Camera.write")
    check_layout(tree["layout"], LAYOUT, path)
    check_tree({ROOT: tree}, "camera-1.0.0", path)
    return understood(path, partial(from_tree, kind=kind), tree)
