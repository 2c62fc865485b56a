"""Solutions as ASDF files, plain trees that any asdf reads.

Files follow ASDF standard 1.5.0, which stacks of early 2025 read as well: arrays, numbers and strings under
``legdistort``, with a schema in ``legdistort/data``. Inverses of distortions are made when they are asked for; those
with a table, which take long, are written with their certificate, which is checked again when they are read.
"""

import dataclasses
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import asdf
import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..cameras import storage as cameras
from ..cameras.camera import Camera
from ..exceptions import FoldError, InputError
from ..geometry import basis, similarity
from ..geometry.distortion import Inverse
from ..geometry.tabulated.covariance_table import CovarianceTable
from ..geometry.tabulated.displacement_table import DisplacementTable
from ..geometry.tangent_plane import TangentPlane
from ..inputs import column_contract
from ..inputs.plain_columns import plain, plain_columns, restored
from ..runtime.asdf_files import ASDF_STANDARD, MAX_BYTES, check_layout, check_tree, read_tree, understood
from ..runtime.checks import LARGEST
from ..runtime.outputs import replacing
from ..runtime.provenance import checksums, unchanged
from ..runtime.trees.codec import from_tree, to_tree
from ..runtime.trees.facts import array, number
from . import nights
from .check import Check
from .diagnostics import Diagnostics
from .errors.absolute_errors import absolute_variance, own_blocks
from .estimate import Estimate, StoredUncertainty, plain_covariances
from .gauge import Gauge
from .motions import StarMotions
from .nights import NightsFound
from .settings import Settings

#: Version of the layout under ``legdistort``.
LAYOUT = 2
#: Entry of a file under which a solution stands.
ROOT = "legdistort"
#: Entries by name that files of earlier versions lack.
_TABLES = {
    "displacement_tables": DisplacementTable,
    "static_tables": DisplacementTable,
    "table_errors": CovarianceTable,
}
#: Largest difference [pix] of residuals from those that follow from positions, poses and coefficients.
_ROUNDING = 1e-6


@dataclasses.dataclass(frozen=True)
class StoredFit:
    """Numbers and words of a solution as a whole."""

    degree: int = dataclasses.field(metadata=number(minimum=0, maximum=30))
    chi2: float = dataclasses.field(metadata=number(minimum=0))
    dof: float
    status: str
    columns: tuple[str, ...]
    left_out: dict[str, str]
    provenance: dict[str, Any]


@dataclasses.dataclass(frozen=True, eq=False)
class StoredExposures:
    """The exposures, one after another in every array."""

    name: tuple[str, ...]
    shape: np.ndarray = dataclasses.field(metadata=array("n_exposures", 2, holds="integers", minimum=1, maximum=1e7))
    pose: np.ndarray = dataclasses.field(metadata=array("n_exposures", 2, 3, unit="pix", invertible=True))
    coefficients: np.ndarray = dataclasses.field(metadata=array("n_exposures", 2, "n_series", unit="pix"))
    prior_mean: np.ndarray = dataclasses.field(metadata=array("n_exposures", 2, "n_series", unit="pix"))


@dataclasses.dataclass(frozen=True, eq=False)
class StoredStars:
    """Names and positions of the stars."""

    star: np.ndarray = dataclasses.field(metadata=array("n_stars", holds="names"))
    position: np.ndarray = dataclasses.field(metadata=array("n_stars", 2, unit="pix", nan=True))


def write_solution(solution, path, *, overwrite=False):
    """Write a `Solution`, its covariances included, to an ASDF file."""
    estimate, table = solution.estimate, plain_columns(solution.residuals)
    tree = {
        "layout": LAYOUT,
        "provenance": solution.provenance,
        "settings": to_tree(solution.settings),
        "diagnostics": to_tree(solution.diagnostics),
        "status": solution.status,
        "degree": solution.degree,
        "chi2": float(solution.chi2),
        "dof": float(solution.dof),
        "exposures": to_tree(_stored_exposures(solution)),
        "inverses": {name: to_tree(each) for name, each in _long_inverses(solution)},
        "stars": to_tree(StoredStars(np.asarray(estimate.star_names), estimate.positions)),
        "columns": table.colnames,  # their order: that of a mapping is lost in files
        "observations": {name: plain(table[name]) for name in table.colnames},
        "motions": estimate.motions and to_tree(estimate.motions),
        "covariance": to_tree(plain_covariances(estimate)),
        "gauge": to_tree(solution.gauge),
        "sky": solution.sky and to_tree(solution.sky),
        "left_out": solution.left_out,
        "camera": to_tree(solution.camera) if solution.camera.is_known else None,
        "checks": [to_tree(each) for each in solution.checks],
        "nights": to_tree(nights.found(solution)),
        **{kind: {key: to_tree(each) for key, each in getattr(estimate, kind).items()} for kind in _TABLES},
    }
    content = asdf.AsdfFile({"legdistort": tree}, version=ASDF_STANDARD)
    for column in tree["observations"].values():  # names repeat; covariances and coefficients would not get smaller
        content.set_array_compression(column["values"], "zlib")
    with replacing(path, overwrite=overwrite) as file:
        content.write_to(file)
    return Path(path)


def _stored_exposures(solution):
    names, estimate = solution.names, solution.estimate
    shapes = np.array([estimate.shapes[name] for name in names], dtype=int)
    poses = np.stack([solution.poses[name] for name in names])
    return StoredExposures(names, shapes, poses, solution.coefficients, estimate.prior_mean)


def _long_inverses(solution):
    """Yield names of exposures and the inverses of their distortions where these have a table."""
    for view in solution:
        if view.distortion.table is not None:
            with suppress(FoldError):  # such a solution is worth a look, but has no WCS
                yield view.name, view.distortion.inverse


def read_solution(path, kind, *, max_bytes=None):
    """Read a solution of class `kind` from an ASDF file or a folder of results; see `Solution.read`."""
    path = Path(path)
    path = path / "solution.asdf" if path.is_dir() else path
    with unchanged(path):
        tree = read_tree(path, max_bytes=MAX_BYTES if max_bytes is None else max_bytes).get("legdistort")
        (checksum,) = checksums(path).values()
    if not isinstance(tree, dict) or "layout" not in tree:
        raise InputError(f"{path} holds no legdistort solution (no entry 'legdistort'); give a solution.asdf")
    check_layout(tree["layout"], (1, LAYOUT), path)
    if tree["layout"] == 1 and isinstance(tree.get("exposures"), list):
        tree |= understood(path, _columns, tree["exposures"])
    check_tree({"legdistort": tree}, "solution-1.0.0", path)
    return understood(path, partial(_from_tree, kind, checksum), tree)


def _columns(exposures):
    """Entries of this layout for the list of exposures of the first one."""
    fields = [each.name for each in dataclasses.fields(StoredExposures)]
    inverses = {each["name"]: each["inverse"] for each in exposures}
    return {
        "exposures": {name: [each[name] for each in exposures] for name in fields},
        "inverses": {name: each for name, each in inverses.items() if each and each.get("table")},
    }


def _from_tree(kind, checksum, tree):
    """The solution of a tree that has the outline of one."""
    names = tuple(tree["exposures"]["name"])
    sizes = {"n_modes": basis.n_modes(tree["degree"]), "n_exposures": len(names)}
    fit = from_tree(StoredFit, tree, ROOT, sizes=sizes, strict=False)
    exposures = _part(StoredExposures, tree, "exposures", sizes)
    stars = _part(StoredStars, tree, "stars", sizes, strict=False)
    motions = _part(StarMotions | None, tree, "motions", sizes)
    k = sizes.setdefault("n_terms", 0)
    sizes["n_star_pairs"] = (2 + k) * (3 + k) // 2
    gauge = _part(Gauge, tree, "gauge", sizes)
    camera = tree.get("camera") and cameras.from_tree(tree["camera"], Camera, f"{ROOT}.camera")
    sizes["n_detectors"] = len(camera.detectors) if camera else 0
    uncertainty = _part(StoredUncertainty, tree, "covariance", sizes)
    diagnostics = _part(Diagnostics, tree, "diagnostics", sizes)
    if effective := diagnostics.effective_modes:  # in the order of exposures, which mappings in files do not keep
        diagnostics = dataclasses.replace(diagnostics, effective_modes={name: effective[name] for name in names})
    solution = kind(
        names=names,
        degree=fit.degree,
        poses=dict(zip(names, exposures.pose, strict=True)),
        coefficients=exposures.coefficients,
        residuals=QTable({name: restored(tree["observations"][name]) for name in fit.columns}),
        chi2=fit.chi2,
        dof=fit.dof,
        status=fit.status,
        gauge=dataclasses.replace(gauge, responses=uncertainty),
        settings=_part(Settings, tree, "settings", sizes),
        diagnostics=diagnostics,
        sky=_part(TangentPlane | None, tree, "sky", sizes),
        left_out=fit.left_out,
        provenance=fit.provenance,
        camera=camera,
        estimate=Estimate(
            star_names=stars.star,
            positions=stars.position,
            shapes=dict(zip(names, map(tuple, exposures.shape.tolist()), strict=True)),
            prior_mean=exposures.prior_mean,
            uncertainty=uncertainty,
            motions=motions,
            checked=_part(tuple[Check, ...], tree, "checks", sizes),
            nights=_part(NightsFound | None, tree, "nights", sizes),
            **{entry: _part(dict[str, of], tree, entry, sizes) for entry, of in _TABLES.items()},
        ),
        _checksum=checksum,
    )
    _check_consistent(solution)
    for name, inverse in _part(dict[str, Inverse], tree, "inverses", sizes).items():  # checks the certificate
        solution.estimate.certified[name] = dataclasses.replace(solution[name].distortion, certified=inverse)
    return solution


def _part(kind, tree, entry, sizes, *, strict=True):
    """An entry of the tree; none of it for one that files of earlier versions lack."""
    given = tree.get(entry, [] if entry == "checks" else {} if entry in (*_TABLES, "inverses") else None)
    return from_tree(kind, given, f"{ROOT}.{entry}", sizes=sizes, strict=strict)


def _check_consistent(solution):
    """Raise if parts of a solution do not fit together, beyond their shapes."""
    if len(set(solution.names)) < len(solution.names):
        raise ValueError("two exposures have the same name")
    estimate = solution.estimate
    gauge, camera = solution.gauge, estimate.uncertainty.camera
    if (gauge.drift is None) != (estimate.motions is None):
        raise ValueError("motions of stars and the maps common to them come together")
    basis.degree_of(gauge.n_own)  # refuses a number that is none of modes
    if gauge.n_modes != gauge.n_own * gauge.n_fields:
        raise ValueError(f"{gauge.n_own} modes of {gauge.n_fields} fields do not make {gauge.n_modes} of the plane")
    for _, half in gauge.boxes:
        if not np.all(half > 0):
            raise ValueError(f"entry {ROOT}.gauge.box: half sizes should be positive, got {half.tolist()}")
    if gauge.n_maps > 2 * gauge.n_modes:
        raise ValueError(f"the gauge cannot have {gauge.n_constraints} constraints on {2 * gauge.n_modes} modes")
    if camera and np.count_nonzero(camera.free) != len(camera.changes):
        raise ValueError(f"{np.count_nonzero(camera.free)} modes of the camera are free, {len(camera.changes)} change")
    if estimate.uncertainty.common is not None:
        _check_common(gauge, estimate.uncertainty)
    if gauge.tie is not None:
        x, y, xy = absolute_variance(gauge, estimate.uncertainty, estimate.positions, without_unknown=True)
        if np.any(np.minimum(x, y) < -1e-12) or np.any(xy**2 > (1 + 1e-6) * x * y + 1e-24):
            raise ValueError(f"entry {ROOT}.gauge.tie.shared: takes more from a variance than there is of it")
    table = column_contract.check(solution.residuals, column_contract.MATCHED, "the table of residuals")
    for name in ("used", "exposure", "detector"):  # quantities select no rows
        if name in table.colnames and getattr(table[name], "unit", None) is not None:
            raise ValueError(f"the column {name!r} has a unit, {table[name].unit}")
    for name in ("x", "y", "dx", "dy"):
        if getattr(solution.residuals[name], "unit", None) != u.pix:
            raise ValueError(f"the column {name!r} should be in pixels, its unit is {solution.residuals[name].unit}")
    used = np.asarray(table["used"])
    if used.dtype != bool:
        raise ValueError("the column 'used' should be of booleans")
    for name in ("dx", "dy"):
        size = np.abs(column_contract.values(table, name, u.pix))
        if not np.all((size < LARGEST) | (np.isnan(size) & ~used)):
            raise ValueError(f"the column {name!r} should hold finite numbers of pixels, none beyond 1e30")
    lost = estimate.star_names[~np.isfinite(estimate.positions).all(axis=1)]
    if np.isin(np.asarray(table["star"])[used], lost).any():
        raise ValueError("a star without a position has observations that were used")
    for column, known in (("exposure", solution.names), ("star", estimate.star_names)):
        if not np.isin(np.asarray(table[column]), known).all():
            raise ValueError(f"the table of residuals names {column}s that are not in the list of them")
    _check_residuals(solution)
    if strange := sorted(set(estimate.displacement_tables) - set(solution.names)):
        raise ValueError(f"there is a table of displacements of {strange[0]!r}, which is no exposure")
    if (tests := nights.found(solution).tests) and len(tests) != len(nights.blocks(solution)[1]):
        raise ValueError(f"there are tests of {len(tests)} nights, and {len(nights.blocks(solution)[1])} of these")


def _check_residuals(solution):
    """Raise if residuals do not follow from positions, poses and coefficients: of one detector, these alone."""
    estimate, table = solution.estimate, solution.residuals[np.asarray(solution.residuals["used"])]
    tables = estimate.displacement_tables or estimate.static_tables or solution.diagnostics.terms
    if tables or estimate.motions is not None or solution.camera.has_focal_plane or not len(table):
        return
    found = {name: row for row, name in enumerate(solution.names)}
    exposure = np.array([found[name] for name in np.asarray(table["exposure"]).tolist()])
    star = np.searchsorted(estimate.star_names, np.asarray(table["star"]))
    poses, shapes = np.stack(list(solution.poses.values())), np.array(list(estimate.shapes.values()))
    q = similarity.apply_each(poses[exposure], estimate.positions[star])
    ny, nx = shapes[exposure].T
    along, across = (2 * q[:, 0] + 1) / nx - 1, (2 * q[:, 1] + 1) / ny - 1
    b = basis.values(basis.degree_of(solution.coefficients.shape[2]), along, across)
    p = q + np.einsum("ncm,mn->nc", solution.coefficients[exposure], b)
    given, left = (np.stack([table[n].to_value(u.pix) for n in pair], axis=1) for pair in (("x", "y"), ("dx", "dy")))
    wrong = ~(np.abs(given - p - left) <= _ROUNDING).all(axis=1)
    if wrong.any():
        name = np.asarray(table["exposure"])[wrong][0]
        raise ValueError(
            f"residuals of exposure {name} do not follow from its coefficients and pose and the positions of stars: "
            "something was changed since; solve again, or take the file as it was written"
        )


def _check_common(gauge, uncertainty):
    """Raise if covariances of the stars with the maps that fit their errors are larger than the variances allow."""
    stars = np.einsum("jaa->ja", own_blocks(gauge, uncertainty))[:, :, None]
    maps = np.maximum(np.diag(uncertainty.common.covariance), 0)
    rounding = 1e-9 * stars * np.max(maps) + 1e-24
    if np.any(uncertainty.common.stars**2 > stars * maps + rounding):
        raise ValueError(f"entry {ROOT}.covariance.common.stars: covariances larger than the variances allow")
