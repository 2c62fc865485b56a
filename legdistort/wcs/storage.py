"""The gwcs of an exposure as an ASDF file that any gwcs user can open."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import asdf
import gwcs
import numpy as np
from astropy.modeling import models

from ..exceptions import InputError
from ..geometry import basis
from ..geometry.distortion import TABLE_TOLERANCE, Distortion, Inverse
from ..geometry.models import correction_model, displacement_model, leaves, pose_model
from ..geometry.tabulated.displacement_table import DisplacementTable
from ..geometry.tangent_plane import PlaneToSky
from ..runtime import provenance
from ..runtime.asdf_files import ASDF_STANDARD, MAX_BYTES, WITH_WCS, check_tree, read_tree, understood
from ..runtime.checks import LARGEST
from ..runtime.outputs import replacing
from ..runtime.trees.codec import from_tree, to_tree
from ..runtime.trees.facts import number
from .exposure_wcs import ExposureWCS, exposure_wcs, from_focal_plane, rebuilt

if TYPE_CHECKING:
    from gwcs import WCS as GWCS

    from ..runtime.annotations import StrPath

#: What those should know who open a file without legdistort.
NOTE = (
    "Stock models only: asdf and gwcs are enough to read this. The models do not know where they end: keep to "
    "valid_undistorted_px from the sky to pixels. gwcs takes a box in right ascension and declination around the four "
    "corners for the footprint, so that positions near edges, and nearly all around a pole, become NaN from the sky to "
    "pixels: set wcs.bounding_box = None before resampling. Legendre2D of astropy gives wrong numbers when threads "
    "share it: give each a deep copy of the WCS. legdistort.read_wcs returns a WCS without these limits."
)


@dataclass(frozen=True)
class Certificate:
    """Round-trip error of an inverse and the box of undistorted pixels in which it holds."""

    error: float = field(metadata=number(entry="inverse_error_px", minimum=0, maximum=TABLE_TOLERANCE, unit="pix"))
    valid: tuple[float, float, float, float] = field(metadata=number(entry="valid_undistorted_px", unit="pix"))


def wcs_tree(view):
    """The ASDF tree of a view of one image: its gwcs at ``meta.wcs``, with the errors of inverses."""
    view.check_pixels()
    common, chip = view.common, view.chip
    origin = view.solution.provenance or provenance.stamp()
    wcs = exposure_wcs(view.name, common.pose, common.distortion, view.solution.sky, chip, shared=True)
    meta = {"wcs": wcs, "exposure": view.name}
    if chip is None:
        meta |= to_tree(common.distortion.inverse, Certificate)
    else:
        meta |= {"detector": view.detector} | to_tree(chip.distortion.inverse, Certificate)
        meta["focal_plane"] = to_tree(common.distortion.inverse, Certificate)
    meta |= {"provenance": {key: origin[key] for key in ("created", "versions")}, "note": NOTE}
    return {"meta": meta}


def write_wcs(view, path, *, overwrite=False):
    """Write the gwcs of a view, ``solution["exp00"]``, with its measured inverse error, to an ASDF file."""
    with replacing(path, overwrite=overwrite) as file:
        asdf.AsdfFile(wcs_tree(view), version=ASDF_STANDARD).write_to(file)
    return Path(path)


def read_wcs(path: StrPath, *, max_bytes: int | None = None) -> GWCS:
    """Read the WCS of an exposure, ``wcs/NAME.asdf``, as it was in memory.

    The stock models in the file have no limits, and its certificate of the inverse is not trusted: here the error of
    the inverse is measured again, and positions beyond the detector and its image become NaN.

    Parameters
    ----------
    path : str or path
    max_bytes : int, optional
        Largest size of the arrays in the file, unpacked; 2 GiB if not given.

    Returns
    -------
    ExposureWCS
        A `gwcs.WCS`, ``detector`` -> ``undistorted`` (-> ``focal_plane``) -> ``reference`` (-> ``icrs``).

    Raises
    ------
    InputError
        For a file that is damaged, too large, no WCS of legdistort, or was changed after it was written.

    See Also
    --------
    legdistort.results.view.View.wcs : The WCS of an exposure of a solution in memory.

    Examples
    --------
    >>> import legdistort as ld
    >>> from legdistort.wcs.storage import write_wcs
    >>> solution = ld.solve(ld.simulate_matches(n_stars=40, seed=1).matches)
    >>> path = write_wcs(solution["exp00"], "exp00.asdf")
    >>> ld.read_wcs(path).available_frames
    ['detector', 'undistorted', 'reference']
    """
    tree = read_tree(path, tags=WITH_WCS, max_bytes=MAX_BYTES if max_bytes is None else max_bytes)
    meta = tree.get("meta")
    if not isinstance(meta, dict) or "inverse_error_px" not in meta:
        raise InputError(
            f"{path} holds no WCS written by legdistort (no entry meta.inverse_error_px); open it with asdf.open"
        )
    check_tree({"meta": meta}, "wcs-1.0.0", path)
    return understood(path, _checked_wcs, meta)


def _checked_wcs(meta):
    """The gwcs of a file with its inverse checked and its region of validity."""
    wcs = meta["wcs"]
    frames = ["detector", "undistorted", *["focal_plane"] * ("focal_plane" in meta), "reference"]
    if not isinstance(wcs, gwcs.WCS) or wcs.available_frames[: len(frames)] != frames:
        raise ValueError(f"meta.wcs should be a gwcs {' -> '.join(frames)}")
    for first, second in pairwise(wcs.available_frames):
        _check_parameters(wcs.get_transform(first, second), f"meta.wcs, {first} -> {second}")
    box = wcs.bounding_box
    correction = _checked_correction(wcs.get_transform("detector", "undistorted"), meta, "meta", meta["exposure"])
    wcs.set_transform("detector", "undistorted", correction)
    if "focal_plane" in meta:
        whole = wcs.get_transform("focal_plane", "reference")
        whole.left.inverse = whole.inverse.right
        correction = _checked_correction(whole.left, meta["focal_plane"], "meta.focal_plane", meta["exposure"])
        back = pose_model(np.column_stack([whole.right.matrix.value, whole.right.translation.value]), whole.right.name)
        wcs.set_transform("focal_plane", "reference", from_focal_plane(correction, back))
    if wcs.available_frames[-1] == "icrs":
        wcs.set_transform("reference", "icrs", PlaneToSky.like(wcs.get_transform("reference", "icrs")))
    wcs.bounding_box = box
    return rebuilt(ExposureWCS, wcs)


def _check_parameters(transform, where):
    """Raise if a part of a transform has parameters that mean nothing, or is affine and has no inverse."""
    for model in leaves(transform):
        if not np.all(np.abs(model.parameters) < LARGEST):
            raise ValueError(f"entry {where}: {type(model).__name__} has parameters that are not finite")
        if isinstance(model, models.AffineTransformation2D) and not np.linalg.det(model.matrix.value):
            raise ValueError(f"entry {where}: a map that has no inverse; it should be one that has")


def _checked_correction(correction, tree, where, name):
    """A correction with its inverse checked against its certificate, and its region of validity."""
    certificate = from_tree(Certificate, tree, where, strict=False)
    parts = _series(correction.inverse)
    (x0, x1), (y0, y1) = parts[0].x_domain, parts[0].y_domain
    shape = round(y1 - y0), round(x1 - x0)
    tensors = [np.stack([part.parameters.reshape(part.y_degree + 1, -1).T for part in _series(m)])
               for m in (correction.inverse, correction)]  # fmt: skip
    tables = [_table(m) for m in (correction.inverse, correction)]
    for model, tensor, table in zip((correction.inverse, correction), tensors, tables, strict=True):
        _check_same(model, displacement_model(tensor, shape, table=table), shape)
    inverse = Inverse(tensors[1], certificate.error, certificate.valid, tables[1])
    Distortion(basis.from_tensor(tensors[0]), shape, name, inverse, tables[0])  # checks the certificate
    return correction_model(tensors[0], inverse, shape, tables[0])


def _series(model):
    """The two Legendre series, x and y, of a displacement model."""
    parts = [part for part in leaves(model) if isinstance(part, models.Legendre2D)]
    if len(parts) != 2:
        raise ValueError(f"the distortion should be made of two Legendre2D, got {len(parts)}")
    return parts


def _table(model):
    """The table of a displacement model, of two `Tabular2D`, x and y; None if it has none."""
    parts = [part for part in leaves(model) if isinstance(part, models.Tabular2D)]
    if len(parts) not in (0, 2):
        raise ValueError(f"the distortion should have two Tabular2D, x and y, or none, got {len(parts)}")
    return DisplacementTable.from_models(*parts) if parts else None


def _check_same(given, ours, shape):
    """Raise if a model of a file does anything but add its two series, and tables."""
    ny, nx = shape
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, 9), np.linspace(-0.5, ny - 0.5, 7))
    given.bounding_box = None
    if not np.allclose(given(x, y), ours(x, y), rtol=0, atol=1e-9):
        raise ValueError(
            "the distortion should be x, y plus two Legendre series, and tables, over the detector, and is not"
        )
