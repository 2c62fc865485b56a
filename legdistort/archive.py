"""Solutions and WCSs as ASDF files that any gwcs user can open.

Files follow ASDF standard 1.5.0, which stacks of early 2025 read as well. The tree of a solution is plain: arrays,
numbers and strings under ``legdistort``; the WCS of an exposure stands at ``meta.wcs``. Both have a schema in
``legdistort/data``. Inverses are written with their certificate, which is checked again when they are read.
"""

import dataclasses
from pathlib import Path

import asdf
import gwcs
import numpy as np
from astropy import units as u
from astropy.modeling import CompoundModel, models
from astropy.table import QTable

from . import basis, catalogs, provenance
from .asdf_files import MAX_BYTES, WITH_WCS, check_tree, read_tree
from .columns import plain, plain_columns, restored
from .distortion import Distortion, Inverse, displacement_model
from .exceptions import FoldError, InputError
from .files import replacing
from .gauge import Gauge
from .poses import TangentPlane
from .solution import Solution
from .tie import Tie
from .uncertainty import StoredUncertainty

#: Version of the ASDF standard that is written.
ASDF_STANDARD = "1.5.0"
#: Version of the layout under ``legdistort``.
LAYOUT = 2


# -- one WCS


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
    }
    return {"meta": meta}


def write_wcs(solution, name, path, *, overwrite=False):
    """Write the gwcs of one exposure, with its measured inverse error, to an ASDF file."""
    with replacing(path, overwrite=overwrite) as temporary:
        asdf.AsdfFile(wcs_tree(solution, name), version=ASDF_STANDARD).write_to(temporary)
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
    `~gwcs.WCS`
        ``detector`` -> ``undistorted`` -> ``reference`` (-> ``icrs``).

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
    check_tree({"meta": meta}, "wcs-1.schema.yaml", path)
    return _understood(path, _checked_wcs, meta)


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
    Distortion(basis.from_tensor(tensors[0]), shape, meta["exposure"]).adopt(inverse)
    restored_correction = displacement_model(tensors[1], shape, name="correction")
    restored_correction.inverse = displacement_model(tensors[0], shape, valid=inverse.valid, name="distortion")
    wcs.set_transform("detector", "undistorted", restored_correction)
    wcs.bounding_box = box
    return wcs


def _series(model):
    """The two Legendre series, x and y, of a displacement model."""
    parts = model.traverse_postorder() if isinstance(model, CompoundModel) else [model]
    parts = [part for part in parts if isinstance(part, models.Legendre2D)]
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


# -- solutions


def write_solution(solution, path, *, overwrite=False):
    """Write a `Solution`, its covariances included, to an ASDF file."""
    table = plain_columns(solution.observations)
    tree = {
        "layout": LAYOUT,
        "provenance": solution.provenance or provenance.stamp(),
        "settings": solution.settings,
        "status": solution.status,
        "degree": solution.degree,
        "chi2": float(solution.chi2),
        "dof": int(solution.dof),
        "exposures": [_exposure_tree(solution, name) for name in solution.names],
        "stars": {"star": np.asarray(solution.star_names), "position": solution.positions},
        "columns": table.colnames,  # their order: that of a mapping is lost in files
        "observations": {name: plain(table[name]) for name in table.colnames},
        "covariance": solution.uncertainty.stored(),
        "gauge": _fields(solution.gauge) | {"tie": _fields(solution.gauge.tie)},
        "sky": None
        if solution.sky is None
        else {"lon": solution.sky.lon, "lat": solution.sky.lat, "matrix": solution.sky.matrix},
        "left_out": solution.left_out,
    }
    file = asdf.AsdfFile({"legdistort": tree}, version=ASDF_STANDARD)
    for column in tree["observations"].values():  # names repeat; covariances and coefficients would not get smaller
        file.set_array_compression(column["values"], "zlib")
    with replacing(path, overwrite=overwrite) as temporary:
        file.write_to(temporary)
    return Path(path)


def _exposure_tree(solution, name):
    i = solution.index(name)
    try:
        inverse = solution.distortion(name).inverse
        certified = {
            "tensors": inverse.tensors,
            "error_px": inverse.error,
            "valid_undistorted_px": list(inverse.valid),
        }
    except FoldError:  # such a solution is worth a look, but has no WCS
        certified = None
    return {
        "name": name,
        "shape": [int(n) for n in solution.shapes[name]],
        "pose": solution.poses[name],
        "coefficients": solution.coefficients[i],
        "prior_mean": solution.prior_mean[i],
        "inverse": certified,
    }


def read_solution(path, *, max_bytes=None):
    """Read a `Solution` from an ASDF file; see `Solution.read`."""
    tree = read_tree(path, max_bytes=MAX_BYTES if max_bytes is None else max_bytes).get("legdistort")
    if not isinstance(tree, dict) or "layout" not in tree:
        raise InputError(f"{path} holds no legdistort solution (no entry 'legdistort'); give a solution.asdf")
    if tree["layout"] not in (1, LAYOUT):
        raise InputError(f"{path} has layout {tree['layout']}, this version reads 1 to {LAYOUT}; update legdistort")
    if tree["layout"] == 1:
        tree = _understood(path, layout_2, tree)
    check_tree({"legdistort": tree}, "solution-2.schema.yaml", path)
    return _understood(path, _from_tree, tree)


def layout_2(tree):
    """A tree of layout 1 as one of layout 2: text as arrays, and room for the certified inverses, which it lacks."""
    return tree | {
        "layout": 2,
        "exposures": [{**exposure, "inverse": None} for exposure in tree["exposures"]],
        "stars": tree["stars"] | {"star": np.array(tree["stars"]["star"])},
        "observations": {
            name: {"values": np.array(column["values"]), "unit": column["unit"]}
            for name, column in tree["observations"].items()
        },
    }


def _understood(path, function, tree):
    """``function(tree)``, whatever it stumbles over told with the name of the file."""
    try:
        with np.errstate(all="ignore"):
            return function(tree)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # there is no end to what can be wrong in a file
        raise InputError(f"{path} is damaged: {type(error).__name__} {error}") from None


def _fields(thing):
    """The fields of a dataclass by name; None for None."""
    return None if thing is None else {field.name: getattr(thing, field.name) for field in dataclasses.fields(thing)}


def _made(kind, tree):
    """A dataclass from its fields by name, those that are absent at their defaults; None for None."""
    if tree is None:
        return None
    known = {field.name: tree[field.name] for field in dataclasses.fields(kind) if field.name in tree}
    return kind(**{key: np.array(value) if hasattr(value, "shape") else value for key, value in known.items()})


def _from_tree(tree):
    exposures = tree["exposures"]
    table = QTable({name: restored(tree["observations"][name]) for name in tree["columns"]})
    sky = tree["sky"]
    solution = Solution(
        names=tuple(e["name"] for e in exposures),
        degree=tree["degree"],
        shapes={e["name"]: tuple(e["shape"]) for e in exposures},
        poses={e["name"]: np.array(e["pose"]) for e in exposures},
        coefficients=np.stack([np.array(e["coefficients"]) for e in exposures]),
        prior_mean=np.stack([np.array(e["prior_mean"]) for e in exposures]),
        star_names=np.array(tree["stars"]["star"]),
        positions=np.array(tree["stars"]["position"]),
        observations=table,
        chi2=tree["chi2"],
        dof=tree["dof"],
        status=tree["status"],
        gauge=_made(Gauge, tree["gauge"] | {"tie": _made(Tie, tree["gauge"].get("tie"))}),
        uncertainty=StoredUncertainty(*(np.array(tree["covariance"][key]) for key in ("coefficients", "stars"))),
        sky=None if sky is None else TangentPlane(sky["lon"], sky["lat"], np.array(sky["matrix"])),
        left_out=dict(tree["left_out"]),
        settings=dict(tree["settings"]),
        provenance=dict(tree["provenance"]),
    )
    _check_consistent(solution)
    for exposure in exposures:
        if exposure["inverse"] is not None:
            kept = exposure["inverse"]
            inverse = Inverse(np.array(kept["tensors"]), kept["error_px"], tuple(kept["valid_undistorted_px"]))
            solution.distortion(exposure["name"]).adopt(inverse)
    return solution


def _check_consistent(solution):
    """Raise if parts of a solution do not fit together."""
    n, n_modes, n_stars = len(solution.names), basis.n_modes(solution.degree), len(solution.star_names)
    if len(set(solution.names)) < n:
        raise ValueError("two exposures have the same name")
    for name, pose in solution.poses.items():
        if pose.shape != (2, 3) or not np.isfinite(pose).all() or np.linalg.det(pose[:, :2]) == 0:
            raise ValueError(f"the pose of {name} should be a finite, invertible array (2, 3)")
    own, gauge = 2 * n_modes, solution.gauge
    held = gauge.n_constraints  # with a shared static distortion those of the modes of single exposures only
    if held != 2 * basis.n_modes(basis.degree_of(held // 2)):
        raise ValueError(f"the gauge cannot have {held} constraints")
    for what, array, shape in (
        ("positions", solution.positions, (n_stars, 2)),
        ("prior means", solution.prior_mean, solution.coefficients.shape),
        ("covariance of the coefficients", solution.uncertainty.coefficients, (n * own, n * own)),
        ("covariance of the stars", solution.uncertainty.stars, (3, n_stars)),
        ("gauge.constraint", gauge.constraint, (held, n, held)),
        ("gauge.motion", gauge.motion, (n, held, held)),
        ("gauge.dynamic", gauge.dynamic, (n, held, held)),
        ("gauge.box", gauge.box, (2, 2)),
        ("gauge.static_sigma", gauge.static_sigma, (2, held // 2)),
        ("gauge.told", gauge.told, (0 if gauge.told is None else len(gauge.told), held)),
        ("gauge.values", gauge.values, (held,)),
        ("gauge.tie.shared", None if gauge.tie is None else gauge.tie.shared, (3, n_stars)),
    ):
        if array is not None and array.shape != shape:
            raise ValueError(f"the {what} should have shape {shape}, not {array.shape}")
    table = catalogs.check(solution.observations, catalogs.MATCHED, "the table of residuals")
    for name in ("dx", "dy"):
        catalogs.values(table, name, u.pix)
    if np.asarray(table["used"]).dtype != bool:
        raise ValueError("the column 'used' should be of booleans")
    for column, known in (("exposure", solution.names), ("star", solution.star_names)):
        if not np.isin(np.asarray(table[column]), known).all():
            raise ValueError(f"the table of residuals names {column}s that are not in the list of them")
