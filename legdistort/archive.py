"""Solutions and WCSs as ASDF files that any gwcs user can open.

Files follow ASDF standard 1.5.0, which stacks of early 2025 read as well. The tree of a solution is plain: arrays,
tables, numbers and strings under ``legdistort``; the WCS of an exposure stands at ``meta.wcs``.
"""

import dataclasses
import datetime
import warnings
from importlib.metadata import version
from pathlib import Path

import asdf
import numpy as np
from astropy import units as u
from astropy.table import Column, QTable

from .exceptions import AssumptionWarning, InputError
from .files import replacing
from .gauge import Gauge
from .poses import TangentPlane
from .solution import Solution
from .uncertainty import StoredUncertainty

#: Version of the ASDF standard that is written.
ASDF_STANDARD = "1.5.0"
#: Version of the layout under ``legdistort``.
LAYOUT = 1

_GAUGE = [field.name for field in dataclasses.fields(Gauge)]


def provenance():
    """Versions and time, as plain strings."""
    packages = ("legdistort", "astropy", "gwcs", "asdf", "numpy", "scipy")
    return {
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": {name: version(name) for name in packages},
    }


def write_wcs(solution, name, path, *, overwrite=False):
    """Write the gwcs of one exposure, with its measured inverse error, to an ASDF file."""
    inverse = solution.distortion(name).inverse
    meta = {
        "wcs": solution.wcs(name),
        "exposure": name,
        "inverse_error_px": inverse.error,
        "valid_undistorted_px": list(inverse.valid),
        "provenance": provenance(),
    }
    with replacing(path, overwrite=overwrite) as temporary:
        asdf.AsdfFile({"meta": meta}, version=ASDF_STANDARD).write_to(temporary)
    return Path(path)


def write_solution(solution, path, *, overwrite=False):
    """Write a `Solution`, its covariances included, to an ASDF file."""
    table = _plain_columns(solution.observations)
    tree = {
        "layout": LAYOUT,
        "provenance": provenance(),
        "settings": solution.settings,
        "status": solution.status,
        "degree": solution.degree,
        "chi2": float(solution.chi2),
        "dof": int(solution.dof),
        "exposures": [
            {
                "name": name,
                "shape": [int(n) for n in solution.shapes[name]],
                "pose": solution.poses[name],
                "coefficients": a,
                "prior_mean": a0,
            }
            for name, a, a0 in zip(solution.names, solution.coefficients, solution.prior_mean, strict=True)
        ],
        "stars": {"star": _plain(solution.star_names), "position": solution.positions},
        "columns": table.colnames,  # their order: that of a mapping is lost in files
        "observations": {
            name: {"values": _plain(table[name]), "unit": str(table[name].unit or "")} for name in table.colnames
        },
        "covariance": solution.uncertainty.stored(),
        "gauge": {key: getattr(solution.gauge, key) for key in _GAUGE},
        "sky": None
        if solution.sky is None
        else {"lon": solution.sky.lon, "lat": solution.sky.lat, "matrix": solution.sky.matrix},
        "left_out": solution.left_out,
    }
    with replacing(path, overwrite=overwrite) as temporary:
        asdf.AsdfFile({"legdistort": tree}, version=ASDF_STANDARD).write_to(temporary, all_array_compression="zlib")
    return Path(path)


def _plain_columns(table):
    """The table without columns of composed objects (coordinates, times), which plain arrays cannot hold."""
    others = [name for name in table.colnames if not isinstance(table[name], (Column, u.Quantity))]
    if others:
        warnings.warn(
            f"column{'s' * (len(others) > 1)} {', '.join(others)} of the observations: neither numbers nor text, "
            "left out of the file",
            AssumptionWarning,
            stacklevel=4,
        )
    return table[[name for name in table.colnames if name not in others]]


def _plain(column):
    """A column as an array that ASDF takes, NaN or empty where masked; names as a list."""
    values = np.array(getattr(column, "value", column))
    mask = getattr(column, "mask", False)
    if np.any(mask):
        values = np.where(mask, "" if values.dtype.kind in "UO" else np.nan, values)
    return values.tolist() if values.dtype.kind in "UO" else values


def read_solution(path):
    """Read a `Solution` from an ASDF file.

    Raises
    ------
    InputError
        If the file is not one that `write_solution` wrote, or of a newer layout.
    """
    try:
        with asdf.open(path, memmap=False, lazy_load=False) as file:
            tree = file.tree.get("legdistort")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:  # whatever a broken file provokes
        raise InputError(f"{path} is not a readable ASDF file: {error}") from None
    if not isinstance(tree, dict) or "layout" not in tree:
        raise InputError(f"{path} holds no legdistort solution (no entry 'legdistort'); give a solution.asdf")
    if tree["layout"] != LAYOUT:
        raise InputError(f"{path} has layout {tree['layout']}, this version reads {LAYOUT}; update legdistort")
    try:
        return _from_tree(tree)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is damaged: {type(error).__name__} {error}") from None


def _gauge(tree):
    arrays = {key: tree[key] for key in _GAUGE if key not in ("kind", "prior")}
    arrays = {key: None if value is None else np.array(value) for key, value in arrays.items()}
    return Gauge(kind=tree["kind"], prior=bool(tree["prior"]), **arrays)


def _from_tree(tree):
    exposures = tree["exposures"]
    names = tuple(e["name"] for e in exposures)
    table = QTable()
    for name in tree["columns"]:
        column = tree["observations"][name]
        values = np.array(column["values"])
        table[name] = values * u.Unit(column["unit"]) if column["unit"] else values
    sky = tree["sky"]
    solution = Solution(
        names=names,
        degree=int(tree["degree"]),
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
        gauge=_gauge(tree["gauge"]),
        uncertainty=StoredUncertainty(*(np.array(tree["covariance"][key]) for key in ("coefficients", "stars"))),
        sky=None if sky is None else TangentPlane(sky["lon"], sky["lat"], np.array(sky["matrix"])),
        left_out=dict(tree["left_out"]),
        settings=dict(tree["settings"]),
    )
    _check_sizes(solution)
    return solution


def _check_sizes(solution):
    size, n_stars = len(solution.names) * solution.gauge.n_constraints, len(solution.star_names)
    for what, array, shape in (
        ("positions", solution.positions, (n_stars, 2)),
        ("covariance of the coefficients", solution.uncertainty.coefficients, (size, size)),
        ("covariance of the stars", solution.uncertainty.stars, (3, n_stars)),
    ):
        if array.shape != shape:
            raise ValueError(f"the {what} should have shape {shape}, not {array.shape}")
