"""Priors as ASDF files, and reading a prior of any kind."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import asdf
import numpy as np

from ..cameras.camera import Camera
from ..cameras.detector import map_alone, maps_of_plane, widths_alone
from ..cameras.source import check_shape
from ..cameras.stated_errors import FREE
from ..exceptions import InputError, some_of
from ..geometry import similarity
from ..geometry.basis import check_degree
from ..geometry.detector_modes import pointed
from ..geometry.distortion import Distortion
from ..results.nights import blocks, found
from ..results.solution import Solution
from ..runtime import provenance
from ..runtime.asdf_files import ASDF_STANDARD, check_layout, check_tree, entry_of, read_tree, understood
from ..runtime.outputs import replacing
from ..runtime.trees.codec import from_tree, to_tree
from .from_files import read_source

#: Version of the layout under ``legdistort_prior``.
LAYOUT = 1
#: Of what the `static_sigma` of a prior that nights were combined to is the error, as its source says.
FURTHER_NIGHT, ONE_NIGHT = "further night", "night"


def write_prior(prior, path, *, overwrite=False):
    """Write a `Prior` to an ASDF file of plain arrays, numbers and strings."""
    tree = {"layout": LAYOUT, "provenance": provenance.stamp()} | to_tree(prior)
    with replacing(path, overwrite=overwrite) as file:
        asdf.AsdfFile({"legdistort_prior": tree}, version=ASDF_STANDARD).write_to(file)
    return Path(path)


def read_prior(path, kind):
    """Read a `Prior` from an ASDF file.

    Raises
    ------
    InputError
        If the file is not one that `write_prior` wrote, was damaged since, or has a newer layout.
    """
    tree = read_tree(path).get("legdistort_prior")
    if not isinstance(tree, dict) or "layout" not in tree:
        raise InputError(f"{path} holds no legdistort prior (no entry 'legdistort_prior'); make one: legdistort prior")
    check_layout(tree["layout"], LAYOUT, path)
    check_tree({"legdistort_prior": tree}, "prior-1.0.0", path)
    return understood(path, partial(_from_tree, kind), tree)


def _from_tree(kind, tree):
    prior = from_tree(kind, tree, "legdistort_prior", strict=False)
    if prior.plane is not None:
        similarity.check(prior.plane, "plane")
    check_degree(prior.degree)
    return prior


def open_prior(where, kind, *, ext=None, frame=None, sigma=None, static_sigma=None, usual_shape=None, **options):
    """Prior from whatever stands in a file (see `Prior.from_file`).

    Its detector has the `usual_shape`, (ny, nx) or None, where neither the source nor `shape` tells it.
    """
    if isinstance(where, (list, tuple)) and len(where) == 1:
        where = where[0]
    options = {key: value for key, value in options.items() if value is not None}
    widths = {key: value for key, value in (("sigma", sigma), ("static_sigma", static_sigma)) if value is not None}
    ready = _ready(where, kind, ext)
    if ready is not None:
        ext = None if ready.source and ready.source.get("detector") == str(ext) else ext
        given = options | {key: value for key, value in (("ext", ext), ("frame", frame)) if value is not None}
        if "shape" in given and ready.shape in (None, tuple(given["shape"])):
            widths["shape"] = check_shape(given.pop("shape"))
        if given:
            named = ", ".join(f"{key} (--{key})" for key in given)
            raise InputError(f"{where} is a prior already: {named} cannot be chosen any more; leave it out")
        ready = ready.with_static_sigma(widths.pop("static_sigma")) if "static_sigma" in widths else ready
        return replace(ready, **widths)
    files = where if isinstance(where, (list, tuple)) else [where]
    files = [path for path in files if isinstance(path, (str, Path))]
    with provenance.unchanged(*files):
        source = read_source(where, ext=ext, frame=frame)
        if source.shape is None and usual_shape is not None:
            options = {"shape": usual_shape} | options
        try:
            return kind.from_model(source, **options, **widths)
        except InputError:
            raise
        except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:  # of the model
            raise InputError(f"{source.name}: the distortion cannot be evaluated ({error})") from None


def _ready(where, kind, ext):
    """The prior in a file of a prior, a solution or a camera, or a folder of results; None for anything else.

    Of a camera with several detectors it is the map of that one which `ext` names.
    """
    if isinstance(where, (str, Path)) and (Path(where) / "solution.asdf").is_file():
        where = Path(where) / "solution.asdf"
    if not isinstance(where, (str, Path)):
        return None
    kinds = {"legdistort_prior": partial(read_prior, kind=kind), "legdistort": Solution.read}
    kinds |= {"legdistort_camera": Camera.read}
    if (entry := entry_of(where, kinds)) is None:
        return None
    found = kinds[entry](where)
    if entry == "legdistort_prior":
        return found
    camera = found if entry == "legdistort_camera" else found.camera
    source = {"kind": "camera", "name": str(where), "camera": camera.name} | _nights_in(where)
    if camera.has_focal_plane:
        return _of_detector(camera, ext, kind, source)
    if camera is not found:  # of a solution, the static distortion of the exposures of another field
        return of_solution(found, kind, {"name": str(where), "files": {Path(where).name: found.checksum}})
    (detector,) = camera.detectors.values()
    errors = {"static_sigma": detector.static_sigma, "static_covariance": detector.static_covariance}
    return kind(detector.static, **errors, shape=detector.shape, source=source)


def _nights_in(path):
    """What a file says of the nights that its camera was made of, and of what its errors are."""
    if entry_of(path, ["legdistort_nights"]) is None:
        return {}
    tree = read_tree(path)["legdistort_nights"]
    dates = [night["date"] for night in tree["nights"] if night["date"] is not None]
    out = {"errors_of": FURTHER_NIGHT if np.any(tree["scatter"]) else ONE_NIGHT}
    return out | ({"dates": [float(min(dates)), float(max(dates))]} if dates else {})


def _of_detector(camera, key, kind, source):
    """The map of one detector of a camera, the shear of its layout and its uncertainty in it."""
    if str(key) not in camera.detectors:
        name = source.get("name", "the solution")
        raise InputError(
            f"{name} is of camera {camera.name} with a focal plane: give it as camera (--camera), or take the map of "
            f"one of its detectors, {some_of(list(camera.detectors), 6)}, by its id: Prior.from_file(path, ext=ID), "
            "legdistort prior --ext ID"
        )
    detector = camera[str(key)]
    if camera.common_map is not None:
        return _with_common_map(camera, str(key), kind, source)
    mean = map_alone(detector)[1]
    stated = detector.static_sigma is not None or detector.layout_sigma is not None
    widths = widths_alone(detector, mean.shape[1]) if stated else None
    return kind(mean, static_sigma=widths, shape=detector.shape, source=source | {"detector": str(key)})


def _with_common_map(camera, key, kind, source):
    """The same of a camera whose focal plane has a map that a reference told, which is in that of the detector."""
    detector, n = camera[key], camera.common_map.shape[1]
    mean = pointed(map_alone(detector, Distortion(camera.common_map, camera.field))[1], detector.shape)
    size = mean.shape[1]
    shared = np.zeros((2, size, 2 * n))
    shared[:, :n] = maps_of_plane(detector, camera.field, n).reshape(2, n, -1)
    shared = shared.reshape(2 * size, -1) * np.minimum(camera.common_sigma.ravel(), FREE)
    covariance = np.diag(np.minimum(widths_alone(detector, size).ravel(), FREE) ** 2) + shared @ shared.T
    source = source | {
        "detector": key,
        "common_map_px": float(np.sqrt(np.mean(np.sum(camera.common_map**2, axis=1)) / 4)),
    }
    return kind(mean, static_covariance=covariance, shape=detector.shape, source=source)


def of_solution(solution, kind, source):
    """See `Prior.from_solution`; with where it is from."""
    if solution.camera.has_focal_plane:
        return _of_detector(solution.camera, None, kind, source)  # which says how to choose one
    shapes = set(solution.estimate.shapes.values())
    if len(shapes) > 1:
        name = source.get("name", "the solution")
        raise InputError(f"{name} has detectors of several shapes, {sorted(shapes)}; it gives no single prior")
    own, static = solution.estimate.displacement_tables, solution.estimate.static_tables
    common = next(iter(static.values())) if len(static) == 1 else None
    left_out = [*own.values(), *(static.values() if common is None else ())]
    left = max((float(np.hypot(*table.values).max()) for table in left_out), default=0.0)
    source = {"kind": "solution", "camera": solution.camera.name} | source
    years = blocks(solution)[2]
    if np.isfinite(years).any():
        source["dates"] = [float(np.nanmin(years)), float(np.nanmax(years))]
    known = {"shape": shapes.pop(), "truncation": left, "table": common}
    statics = found(solution).statics
    if len(statics) != 1:
        return kind(solution.coefficients.mean(axis=0), **known, source=source)
    known["source"] = source | {"errors_of": FURTHER_NIGHT}
    errors = {"static_sigma": statics[0].sigma, "static_covariance": statics[0].covariance}
    return kind(statics[0].mean, **errors, **known)
