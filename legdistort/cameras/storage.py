"""Cameras as trees of plain arrays, numbers and strings, and as ASDF files of such a tree."""

from functools import partial

import asdf
import numpy as np

from ..exceptions import InputError
from ..runtime import provenance
from ..runtime.asdf_files import ASDF_STANDARD, check_layout, check_tree, read_tree, understood
from ..runtime.outputs import replacing
from .detector import Detector

#: Version of the layout under ``legdistort_camera``.
LAYOUT = 1
_ARRAYS = "layout", "static", "layout_sigma", "static_sigma", "layout_covariance"


def to_tree(camera, *, plain=False):
    """A `Camera` as a tree; `plain` makes lists of its arrays."""
    detectors = []
    for key, each in camera.detectors.items():
        arrays = {name: getattr(each, name) for name in _ARRAYS}
        if plain:
            arrays = {name: None if array is None else array.tolist() for name, array in arrays.items()}
        detectors.append({"id": key, "shape": list(each.shape)} | arrays)
    common = camera.common_sigma
    common = common.tolist() if plain and common is not None else common
    return {"name": camera.name, "field": list(camera.field), "detectors": detectors, "common_sigma": common}


def from_tree(tree, kind):
    """The `Camera`, the `kind`, of a tree; arrays may be lists."""
    detectors = {}
    for each in tree["detectors"]:
        given = {name: each.get(name) for name in _ARRAYS}
        arrays = {name: None if array is None else np.array(array, dtype=float) for name, array in given.items()}
        detectors[each["id"]] = Detector(tuple(each["shape"]), **arrays)
    if len(detectors) < len(tree["detectors"]):
        raise InputError("two detectors have the same id")
    return kind(tree["name"], detectors, tuple(tree["field"]), tree.get("common_sigma"))


def write_camera(camera, path, *, overwrite=False):
    """Write a `Camera` to an ASDF file; returns the path."""
    tree = {"layout": LAYOUT, "provenance": provenance.stamp()} | to_tree(camera)
    with replacing(path, overwrite=overwrite) as file:
        asdf.AsdfFile({"legdistort_camera": tree}, version=ASDF_STANDARD).write_to(file)
    return path


def read_camera(path, kind):
    """Read a `Camera` from an ASDF file.

    Raises
    ------
    InputError
        If the file is not one that `write_camera` wrote, was damaged since, or has a newer layout.
    """
    tree = read_tree(path).get("legdistort_camera")
    if not isinstance(tree, dict) or "layout" not in tree:
        raise InputError(f"{path} holds no legdistort camera (no entry 'legdistort_camera'); write one: Camera.write")
    check_layout(tree["layout"], LAYOUT, path)
    check_tree({"legdistort_camera": tree}, "camera-1.0.0", path)
    return understood(path, partial(from_tree, kind=kind), tree)
