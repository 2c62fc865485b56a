"""Frames of which only the WCS and the shape are needed: images, or ASDF files that hold a gwcs and no image."""

from pathlib import Path

from ..exceptions import InputError
from ..runtime.asdf_files import ARCHIVES, read_tree
from ..runtime.provenance import checksum_of, unchanged
from .detector_files import with_detectors
from .exposure_files import ExposureFile, expand_paths, open_exposures, told_apart
from .exposure_names import exposure_name
from .foreign_images import header_of_meta
from .frames.header_texts import TEXTS
from .sky_wcs import believable_wcs

#: Where files have the gwcs of their image: data models of JWST, those of Roman, and what gwcs and asdf write.
PLACES = ("meta", "wcs"), ("roman", "meta", "wcs"), ("wcs",)


def open_wcs(paths, *, ext=None, dq_good=None, weight_maps=None, shape=None):
    """Exposures of images, as `legdistort.open_exposures`, and of ASDF files with a gwcs alone.

    Parameters
    ----------
    paths, ext, dq_good, weight_maps
        As there.
    shape : tuple, optional
        ``(ny, nx)`` of the images of a gwcs that does not state it (``pixel_shape``, or the end of its bounding box).

    Returns
    -------
    list of Exposure or ExposureFile
        Those of a gwcs have no pixels.

    Raises
    ------
    InputError
        As there; also for an ASDF file with neither image nor gwcs, and for a gwcs of unknown shape.
    """
    images, bare = [], []
    for source in expand_paths(paths):
        tree = _tree(source)
        if tree is None:
            images.append(source)
        else:
            bare.append(_of_tree(Path(source), tree, shape))
    if shape is not None and not bare:
        raise InputError("--shape comes from the frames of --wcs: leave it out")
    out = (open_exposures(images, ext=ext, dq_good=dq_good, weight_maps=weight_maps) if images else []) + bare
    return with_detectors(told_apart(out)) if bare else out


def _tree(source):
    """The tree of an ASDF file without an image; None for any other source."""
    path = Path(source) if isinstance(source, (str, Path)) else None
    if path is not None and path.suffix.lower() in TEXTS:
        raise InputError(f"{path} is the text of a header, without the size and time of its image: give the frame")
    if path is None or path.suffix.lower() != ".asdf":
        return None
    tree = read_tree(path, tags=ARCHIVES)
    roman = tree.get("roman")
    return None if hasattr(roman, "get") and "data" in roman else tree


def wcs_in(tree):
    """Keys and gwcs of a tree, where files have it (`PLACES`), and the header of its metadata; None without a gwcs."""
    for keys in PLACES:
        node, meta = tree, {}
        for key in keys:
            meta, node = node, node.get(key) if hasattr(node, "get") else None
        if hasattr(node, "available_frames"):
            return keys, node, header_of_meta({} if len(keys) == 1 else meta)
    return None


def _of_tree(path, tree, shape):
    with unchanged(path) as (found,):
        sha = checksum_of(path)
    if (known := wcs_in(tree)) is None:
        raise InputError(f"{path} has no gwcs at {' or '.join('.'.join(keys) for keys in PLACES)}, nor an image")
    _, wcs, header = known
    shape = shape or _shape_of(wcs)
    if shape is None:
        raise InputError(
            f"{path}: its gwcs states neither pixel_shape nor a bounding box: give the shape, --shape NY NX"
        )
    name = exposure_name(path)
    if (wcs := believable_wcs(wcs, shape, name)) is None:
        raise InputError(f"{path}: its gwcs does not lead from {shape[1]} x {shape[0]} pixels to the sky")
    unknown = dict.fromkeys(("saturation", "gain", "read_noise", "exposure_time"))
    return ExposureFile(name, tuple(shape), wcs, header, **unknown, path=path, checksum=sha, pixels=sha, identity=found)


def _shape_of(wcs):
    if wcs.pixel_shape is not None:
        return tuple(int(n) for n in wcs.pixel_shape[::-1])
    if wcs.bounding_box is None:
        return None
    return tuple(round(high + 0.5) for _, high in wcs.bounding_box.bounding_box(order="F"))[::-1]
