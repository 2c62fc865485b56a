"""The gwcs of an exposure as an ASDF file that any gwcs user can open."""

from pathlib import Path

import asdf
import gwcs
import numpy as np
from astropy.modeling import models

from ..exceptions import InputError
from ..geometry import basis
from ..geometry.distortion import Distortion, Inverse
from ..geometry.models import correction_model, displacement_model, leaves
from ..runtime import provenance
from ..runtime.asdf_files import ASDF_STANDARD, MAX_BYTES, WITH_WCS, check_tree, read_tree, understood
from ..runtime.outputs import replacing
from .exposure_wcs import ExposureWCS, rebuilt

#: What those should know who open a file without legdistort.
NOTE = (
    "Stock models only: asdf and gwcs are enough to read this. The models do not know where they end: keep to "
    "valid_undistorted_px from the sky to pixels. gwcs takes a box in right ascension and declination around the four "
    "corners for the footprint, so that positions near edges, and nearly all around a pole, become NaN from the sky to "
    "pixels: set wcs.bounding_box = None before resampling. Legendre2D of astropy gives wrong numbers when threads "
    "share it: give each a deep copy of the WCS. legdistort.read_wcs returns a WCS without these limits."
)


def wcs_tree(solution, name):
    """The ASDF tree of one exposure: its gwcs at ``meta.wcs``, with the measured error of the inverse."""
    inverse = solution.distortion(name).inverse
    origin = solution.provenance or provenance.stamp()
    meta = {
        "wcs": solution.wcs(name),
        "exposure": name,
        "inverse_error_px": inverse.error,
        "valid_undistorted_px": list(inverse.valid),
        "provenance": {key: origin[key] for key in ("created", "versions")},
        "note": NOTE,
    }
    return {"meta": meta}


def write_wcs(solution, name, path, *, overwrite=False):
    """Write the gwcs of one exposure, with its measured inverse error, to an ASDF file."""
    with replacing(path, overwrite=overwrite) as file:
        asdf.AsdfFile(wcs_tree(solution, name), version=ASDF_STANDARD).write_to(file)
    return Path(path)


def read_wcs(path, *, max_bytes=None):
    """Read the WCS of an exposure, ``wcs/NAME.asdf``, as it was in memory.

    The stock models in the file do not know where they end, and the word of the file is not taken for the error of the
    inverse: here the certificate is checked again, and what lies beyond the detector and its image becomes NaN.

    Parameters
    ----------
    path : str or path
    max_bytes : int, optional
        Largest size of the arrays in the file, unpacked; 2 GiB if not given.

    Returns
    -------
    ExposureWCS
        A `gwcs.WCS`, ``detector`` -> ``undistorted`` -> ``reference`` (-> ``icrs``).

    Raises
    ------
    InputError
        For a file that is damaged, too large, no WCS of legdistort, or was changed after it was written.
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
    if not isinstance(wcs, gwcs.WCS) or tuple(wcs.available_frames[:3]) != ("detector", "undistorted", "reference"):
        raise ValueError("meta.wcs should be a gwcs detector -> undistorted -> reference")
    correction = wcs.get_transform("detector", "undistorted")
    box = wcs.bounding_box
    parts = _series(correction.inverse)
    (x0, x1), (y0, y1) = parts[0].x_domain, parts[0].y_domain
    shape = round(y1 - y0), round(x1 - x0)
    tensors = [np.stack([part.parameters.reshape(part.y_degree + 1, -1).T for part in _series(m)])
               for m in (correction.inverse, correction)]  # fmt: skip
    for model, tensor in zip((correction.inverse, correction), tensors, strict=True):
        _check_same(model, displacement_model(tensor, shape), shape)
    inverse = Inverse(tensors[1], meta["inverse_error_px"], tuple(meta["valid_undistorted_px"]))
    Distortion(basis.from_tensor(tensors[0]), shape, meta["exposure"], inverse)  # checks the certificate
    wcs.set_transform("detector", "undistorted", correction_model(tensors[0], inverse, shape))
    wcs.bounding_box = box
    return rebuilt(ExposureWCS, wcs)


def _series(model):
    """The two Legendre series, x and y, of a displacement model."""
    parts = [part for part in leaves(model) if isinstance(part, models.Legendre2D)]
    if len(parts) != 2:
        raise ValueError(f"the distortion should be made of two Legendre2D, got {len(parts)}")
    return parts


def _check_same(given, ours, shape):
    """Raise if a model of a file does anything but add its two series."""
    ny, nx = shape
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, 9), np.linspace(-0.5, ny - 0.5, 7))
    given.bounding_box = None
    if not np.allclose(given(x, y), ours(x, y), rtol=0, atol=1e-9):
        raise ValueError("the distortion should be x, y plus two Legendre series over the detector, and is not")
