"""Solutions as ASDF files, plain trees that any asdf reads.

Files follow ASDF standard 1.5.0, which stacks of early 2025 read as well: arrays, numbers and strings under
``legdistort``, with a schema in ``legdistort/data``. Inverses are written with their certificate, which is checked
again when they are read.
"""

import dataclasses
from functools import partial
from pathlib import Path

import asdf
import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..cameras import storage as cameras
from ..cameras.camera import Camera
from ..exceptions import FoldError, InputError
from ..geometry import basis
from ..geometry.distortion import Distortion, Inverse
from ..geometry.tangent_plane import TangentPlane
from ..inputs import column_contract
from ..inputs.plain_columns import plain, plain_columns, restored
from ..runtime.asdf_files import ASDF_STANDARD, MAX_BYTES, check_layout, check_tree, read_tree, understood
from ..runtime.outputs import replacing, settle_for
from ..runtime.provenance import checksums, unchanged
from .check import Check
from .diagnostics import (
    AliasedDegree,
    CorrelatedErrors,
    DegreeChoice,
    Diagnostics,
    ErrorLaw,
    MotionScatter,
    UsedReference,
    Validation,
)
from .errors.camera_errors import CameraErrors
from .errors.catalogue_tie import Tie
from .estimate import Estimate, StoredUncertainty
from .gauge import Drift, Gauge, UnknownDirection, UnknownMap
from .motions import StarMotions
from .settings import Settings

#: Version of the layout under ``legdistort``.
LAYOUT = 1


def write_solution(solution, path, *, overwrite=False):
    """Write a `Solution`, its covariances included, to an ASDF file."""
    estimate, table = solution.estimate, plain_columns(solution.residuals)
    camera = estimate.uncertainty.camera
    covariances = ["coefficients", "stars", "directions", "bends"]
    covariances += ["star_unknowns", "drift_directions"] if estimate.motions is not None else []
    tree = {
        "layout": LAYOUT,
        "provenance": solution.provenance,
        "settings": dataclasses.asdict(solution.settings),
        "diagnostics": dataclasses.asdict(solution.diagnostics),
        "status": solution.status,
        "degree": solution.degree,
        "chi2": float(solution.chi2),
        "dof": int(solution.dof),
        "exposures": [_exposure_tree(view) for view in solution],
        "stars": {"star": np.asarray(estimate.star_names), "position": estimate.positions},
        "columns": table.colnames,  # their order: that of a mapping is lost in files
        "observations": {name: plain(table[name]) for name in table.colnames},
        "motions": estimate.motions and dataclasses.asdict(estimate.motions),
        "covariance": {key: getattr(estimate.uncertainty, key) for key in covariances}
        | {"weak": [dataclasses.asdict(each) for each in estimate.uncertainty.weak]}
        | {"camera": camera and dataclasses.asdict(camera)},
        "gauge": _gauge_tree(solution.gauge),
        "sky": solution.sky and dataclasses.asdict(solution.sky),
        "left_out": solution.left_out,
        "camera": cameras.to_tree(solution.camera) if solution.camera.is_known else None,
        "checks": [dataclasses.asdict(each) for each in solution.checks],
    }
    content = asdf.AsdfFile({"legdistort": tree}, version=ASDF_STANDARD)
    for column in tree["observations"].values():  # names repeat; covariances and coefficients would not get smaller
        content.set_array_compression(column["values"], "zlib")
    with replacing(path, overwrite=overwrite) as file:
        content.write_to(file)
    return Path(path)


def _gauge_tree(gauge):
    fields = dataclasses.fields(gauge)  # the responses stand with the covariances
    tree = {field.name: getattr(gauge, field.name) for field in fields if field.name != "responses"}
    return tree | {
        "tie": gauge.tie and dataclasses.asdict(gauge.tie),
        "drift": gauge.drift and dataclasses.asdict(gauge.drift),
        "unknown_maps": [dataclasses.asdict(each) for each in gauge.unknown_maps],
    }


def _exposure_tree(view):
    try:
        inverse = view.distortion.inverse
        certified = {
            "tensors": inverse.tensors,
            "error_px": inverse.error,
            "valid_undistorted_px": list(inverse.valid),
        }
    except FoldError:  # such a solution is worth a look, but has no WCS
        certified = None
    return {
        "name": view.name,
        "shape": [int(n) for n in view.shape],
        "pose": view.pose,
        "coefficients": view.coefficients,
        "prior_mean": view.prior_mean,
        "inverse": certified,
    }


def read_solution(path, kind, *, max_bytes=None):
    """Read a solution of class `kind` from an ASDF file or a folder of results; see `Solution.read`."""
    path = Path(path)
    path = path / "solution.asdf" if path.is_dir() else path
    settle_for(path)
    with unchanged(path):
        tree = read_tree(path, max_bytes=MAX_BYTES if max_bytes is None else max_bytes).get("legdistort")
        (checksum,) = checksums(path).values()
    if not isinstance(tree, dict) or "layout" not in tree:
        raise InputError(f"{path} holds no legdistort solution (no entry 'legdistort'); give a solution.asdf")
    check_layout(tree["layout"], LAYOUT, path)
    check_tree({"legdistort": tree}, "solution-1.0.0", path)
    return understood(path, partial(_from_tree, kind, checksum), tree)


def _made(kind, tree, **inner):
    """A dataclass from its fields by name, with dataclasses in some of them, ``field=kind``; None for None.

    Fields that files of earlier versions lack have their defaults.
    """
    if tree is None:
        return None
    made = {name: _made(each, tree[name]) for name, each in inner.items() if name in tree}
    return kind(**{name: _own(value) for name, value in tree.items()} | made)


def _own(value):
    """Arrays of our own for those of a file, tuples for lists, as frozen objects have them."""
    if isinstance(value, dict):
        return {key: _own(each) for key, each in value.items()}
    if isinstance(value, list):
        return tuple(_own(each) for each in value)
    return np.array(value) if hasattr(value, "shape") else value


def _diagnostics(tree, names):
    """`Diagnostics`; with exposures in their order, which mappings in files do not keep."""
    parts = {"selection": DegreeChoice, "validation": Validation, "error_law": ErrorLaw, "correlated": CorrelatedErrors}
    parts["motion_scatter"] = MotionScatter
    found = _made(Diagnostics, tree, reference=UsedReference, **parts)
    if (chosen := found.selection) is not None:
        degrees = tuple(AliasedDegree(**each) for each in chosen.aliasing)
        found = dataclasses.replace(found, selection=dataclasses.replace(chosen, aliasing=degrees))
    effective = found.effective_modes
    return dataclasses.replace(found, effective_modes=effective and {name: effective[name] for name in names})


def _from_tree(kind, checksum, tree):
    exposures = tree["exposures"]
    uncertainty = _made(StoredUncertainty, tree["covariance"], camera=CameraErrors)
    weak = tuple(UnknownDirection(**each) for each in uncertainty.weak)
    uncertainty = dataclasses.replace(uncertainty, weak=weak)
    gauge = _made(Gauge, tree["gauge"], tie=Tie, drift=Drift)
    maps = tuple(UnknownMap(**each) for each in gauge.unknown_maps)
    gauge = dataclasses.replace(gauge, unknown_maps=maps, responses=uncertainty)
    table = QTable({name: restored(tree["observations"][name]) for name in tree["columns"]})
    solution = kind(
        names=tuple(e["name"] for e in exposures),
        degree=tree["degree"],
        poses={e["name"]: np.array(e["pose"]) for e in exposures},
        coefficients=np.stack([np.array(e["coefficients"]) for e in exposures]),
        residuals=table,
        chi2=tree["chi2"],
        dof=tree["dof"],
        status=tree["status"],
        gauge=gauge,
        settings=Settings(**tree["settings"]),
        diagnostics=_diagnostics(tree["diagnostics"], [e["name"] for e in exposures]),
        sky=_made(TangentPlane, tree["sky"]),
        left_out=dict(tree["left_out"]),
        provenance=dict(tree["provenance"]),
        camera=tree.get("camera") and cameras.from_tree(tree["camera"], Camera),
        estimate=Estimate(
            star_names=np.array(tree["stars"]["star"]),
            positions=np.array(tree["stars"]["position"]),
            shapes={e["name"]: tuple(e["shape"]) for e in exposures},
            prior_mean=np.stack([np.array(e["prior_mean"]) for e in exposures]),
            uncertainty=uncertainty,
            motions=_made(StarMotions, tree.get("motions")),
            checked=tuple(Check(**each) for each in tree.get("checks", ())),
        ),
        checksum=checksum,
    )
    _check_consistent(solution)
    return dataclasses.replace(
        solution, estimate=dataclasses.replace(solution.estimate, certified=_certified(solution, exposures))
    )


def _certified(solution, exposures):
    """``{exposure: Distortion}`` with the inverses of a file, whose certificates are checked."""
    views = {e["name"]: (solution[e["name"]], e["inverse"]) for e in exposures if e["inverse"] is not None}
    return {
        name: Distortion(view.coefficients, view.shape, name, _inverse(inverse))
        for name, (view, inverse) in views.items()
    }


def _inverse(tree):
    return Inverse(np.array(tree["tensors"]), tree["error_px"], tuple(tree["valid_undistorted_px"]))


def _check_consistent(solution):
    """Raise if parts of a solution do not fit together."""
    estimate = solution.estimate
    n, n_modes, n_stars = len(solution.names), basis.n_modes(solution.degree), len(estimate.star_names)
    if len(set(solution.names)) < n:
        raise ValueError("two exposures have the same name")
    for name, pose in solution.poses.items():
        if pose.shape != (2, 3) or not np.isfinite(pose).all() or np.linalg.det(pose[:, :2]) == 0:
            raise ValueError(f"the pose of {name} should be a finite, invertible array (2, 3)")
    own, gauge, moving = 2 * n_modes, solution.gauge, estimate.motions
    if (gauge.drift is None) != (moving is None):
        raise ValueError("motions of stars and the maps common to them come together")
    k, q = (0, 0) if moving is None else (len(moving.names), gauge.drift.motion.shape[2])
    held, modes = gauge.n_constraints, gauge.motion.shape[1]  # those that exposures have for themselves
    if modes != 2 * basis.n_modes(basis.degree_of(modes // 2)) or gauge.n_maps > modes:
        raise ValueError(f"the gauge cannot have {held} constraints on {modes} modes")
    for what, array, shape in (
        ("positions", estimate.positions, (n_stars, 2)),
        ("prior means", estimate.prior_mean, solution.coefficients.shape),
        (
            "covariance of the coefficients",
            estimate.uncertainty.coefficients,
            (n, own, own) if np.ndim(estimate.uncertainty.coefficients) == 3 else (n * own, n * own),
        ),
        ("covariance of the stars", estimate.uncertainty.stars, (3, n_stars)),
        ("directions", estimate.uncertainty.directions, (n_stars, 2, modes)),
        (
            "covariance of the stars with the bend to the convention",
            estimate.uncertainty.bends,
            (n_stars, 2 + k, modes),
        ),
        ("gauge.constraint", gauge.constraint, (held, n, modes)),
        ("gauge.convention", gauge.convention, (held, n, modes)),
        ("gauge.motion", gauge.motion, (n, modes, modes)),
        ("gauge.dynamic", gauge.dynamic, (n, modes, modes)),
        ("gauge.box", gauge.box, (2, 2)),
        ("gauge.covariance", gauge.covariance, (modes, modes)),
        *(("map of gauge.unknown_maps", each.map, (modes,)) for each in gauge.unknown_maps),
        ("gauge.values", gauge.values, (held,)),
        ("motions", None if moving is None else moving.values, (n_stars, k)),
        (
            "covariance of the motions",
            estimate.uncertainty.star_unknowns if k else None,
            ((2 + k) * (3 + k) // 2, n_stars),
        ),
        ("drift directions", estimate.uncertainty.drift_directions if k else None, (n_stars, 2 + k, modes + q)),
        ("gauge.drift.motion", None if gauge.drift is None else gauge.drift.motion, (n, modes, q)),
        ("gauge.drift.covariance", None if gauge.drift is None else gauge.drift.covariance, (q, q)),
        ("gauge.drift.joint", None if gauge.drift is None else gauge.drift.joint, (modes + q, modes + q)),
        ("gauge.tie.shared", None if gauge.tie is None else gauge.tie.shared, (3, n_stars)),
    ):
        if array is not None and array.shape != shape:
            raise ValueError(f"the {what} should have shape {shape}, not {array.shape}")
    table = column_contract.check(solution.residuals, column_contract.MATCHED, "the table of residuals")
    for name in ("dx", "dy"):
        column_contract.values(table, name, u.pix)
    if np.asarray(table["used"]).dtype != bool:
        raise ValueError("the column 'used' should be of booleans")
    for column, known in (("exposure", solution.names), ("star", estimate.star_names)):
        if not np.isin(np.asarray(table[column]), known).all():
            raise ValueError(f"the table of residuals names {column}s that are not in the list of them")
