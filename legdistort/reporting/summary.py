"""A solution in figures, as ``summary.json`` has them."""

from dataclasses import asdict

import numpy as np

from ..assessment.pulls import exposure_rms
from ..cameras import ties
from ..geometry import similarity
from ..results import accuracy, in_tables
from ..results import nights as night_tables
from ..results.accuracy import departures, rms_length, sizes
from ..results.errors.pose_errors import pose_numbers
from ..runtime import provenance
from ..runtime.trees.codec import to_tree


def summarise(solution, *, timings=None):
    """Figures of a solution as plain numbers and strings, as ``--json`` prints them.

    ``rms_px``: unweighted rms residual per axis, used observations. ``sigma_px``: the paper's sigma (section 3.4) over
    the fitted stars, per axis; None of one exposure.
    """
    found, square = solution.diagnostics, accuracy.scatter(accuracy.corrected_positions(solution)) ** 2
    return {
        "n_exposures": len(solution.names),
        "n_stars": int(np.count_nonzero(np.isfinite(solution.estimate.positions[:, 0]))),
        "n_observations": int(np.count_nonzero(solution.residuals["used"])),
        "chi2": float(solution.chi2),
        "dof": float(solution.dof),
        "rms_px": float(np.sqrt(np.mean(in_tables.rms(solution) ** 2))),
        "sigma_px": float(np.sqrt(np.nanmean(square))) if np.isfinite(square).any() else None,
        "angles": in_tables.in_mas(solution),
        "checks": [to_tree(check) for check in solution.checks],
        "gauge": solution.gauge.sentence,
        "unknown": list(solution.gauge.unknown_names),
        "sky": in_tables.sky_sentence(solution),
        "header_pointing": _pointing(solution),
        "reference": found.reference and asdict(found.reference),
        "max_inverse_error_px": _plain(in_tables.largest_inverse_error(solution)),
        "folded": in_tables.folds(solution),
        "left_out": dict(solution.left_out),
        "exposures": (each := exposures(solution)),
        "nights": nights(solution, each),
        "detectors": detectors(solution.camera),
        "ties": ties.pairs(solution.camera, solution.residuals) if solution.camera.has_focal_plane else [],
        "layout_errors": in_tables.layout_errors(solution) or None,
        "command": provenance.command_line(),
        **found.summary(),
        "timings": rounded(timings or {}),
    }


def _pointing(solution):
    """What headers say of where the plane lies on the sky; None where none does."""
    found, scale = solution.diagnostics.pointing, np.nan if solution.sky is None else solution.sky.pixel_scale
    if found is None:
        return None
    off = [{"name": name, "off_px": pixels, "turned_deg": turn} for name, (pixels, turn) in found.off.items()]
    return {
        "n_used": found.n_used,
        "least_err_mas": _plain(1000 * scale * found.shift), "least_rotation_err_deg": _plain(found.turn),
        "least_scale_err": _plain(found.scale), "contradicting": off, "groups": [list(group) for group in found.groups],
        "contradicting_detectors": [{"name": name, "off_px": _plain(off)} for name, off in found.detectors.items()],
    }  # fmt: skip


def exposures(solution):
    """One dict of numbers an exposure, as the schema ``summary-1.0.0.json`` has them; None where one is not known.

    In the units that end their names; `block` is the number of its night.
    """
    dx, dy, n = exposure_rms(solution)
    distortion, dynamic = sizes(solution)
    block, _, epoch = night_tables.blocks(solution)
    out = []
    for i, (name, pose) in enumerate(zip(solution.names, pose_numbers(solution), strict=True)):
        figures = {
            "n_stars": n[i], "block": block[i], "epoch_yr": epoch[i], "rms_x_px": dx[i], "rms_y_px": dy[i],
            "distortion_px": distortion[i], "dynamic_px": dynamic[i],
        }  # fmt: skip
        for key, (symbol, unit) in _POSE.items():
            figures |= {f"{key}{unit}": pose.values.get(symbol), f"{key}_err{unit}": pose.errors.get(symbol)}
            figures[f"{key}_unknown{unit}"] = pose.unknown.get(symbol)
        mirrored = similarity.describe(solution.poses[name])["parity"] < 0
        out.append({"name": name, "mirrored": mirrored} | {key: _plain(v) for key, v in figures.items()})
    return out


#: Figures of a pose, with their names in `PoseNumbers` and their units.
_POSE = {
    "shift_x": ("dx", "_px"), "shift_y": ("dy", "_px"), "rotation": ("rotation", "_deg"), "scale": ("scale", ""),
    "position_angle": ("position_angle", "_deg"), "pixel_scale": ("pixel_scale", "_arcsec"),
}  # fmt: skip


def nights(solution, found):
    """One dict of numbers a night, or other block, the worst first: `Solution.nights`, and what `exposures` gives.

    `common_px` is the size of their mean departure from the static distortion, `common_err_px` that of its standard
    error, by how they scatter about it; None of one exposure.
    """
    of, departing = {}, departures(solution)
    for each in found:
        of.setdefault(each["block"], []).append(each)
    out = []
    for row in solution.nights:
        mine = of[row["block"]]
        figures = {key: row[key] for key in ("n_stars", "rms_ratio", "ratio", "chi2", "dof", "p", "odd")}
        out.append(
            {
                "name": str(row["name"]),
                "block": int(row["block"]),
                "exposures": [each["name"] for each in mine],
                "epoch_yr": _mean(each["epoch_yr"] for each in mine),
                "rms_px": _rms(each[key] for each in mine for key in ("rms_x_px", "rms_y_px")),
                "dynamic_px": _rms(each["dynamic_px"] for each in mine),
                "departure_px": _plain(row["departure"].value),
                **{key: _plain(value) for key, value in figures.items()},
                **_in_common(departing[[each["block"] == row["block"] for each in found]]),
            }
        )
    return out


def _in_common(departing):
    """Size of the mean of departures (n, 2, n_modes), and of its standard error."""
    n = len(departing)
    error = rms_length(departing.std(axis=0, ddof=1)) / np.sqrt(n) if n > 1 else None
    return {"common_px": float(rms_length(departing.mean(axis=0))), "common_err_px": _plain(error)}


def detectors(camera):
    """One dict of numbers a detector: its place in the focal plane, with errors where it is not exact."""
    out, headers, places, off = [], camera.headers, camera.places, {}
    if headers is not None:
        off = dict(
            zip(
                headers.names,
                np.column_stack([headers.shifts, headers.rotations, headers.errors]).tolist(),
                strict=True,
            )
        )
    for key, each in camera.detectors.items() if camera.has_focal_plane else ():
        place = places[key]
        x_off, y_off, turned, off_err, turned_err = off.get(key, (None,) * 5)
        x_err, y_err, rotation_err = map(_plain, place.errors or (None, None, None))
        out.append(
            {
                "name": key, "x_px": place.x, "y_px": place.y, "rotation_deg": place.rotation, "scale": place.scale,
                "x_err_px": x_err, "y_err_px": y_err, "rotation_err_deg": rotation_err, "static_px": float(each.rms),
                "header_x_off_px": x_off, "header_y_off_px": y_off, "header_turned_deg": turned,
                "header_off_err_px": _plain(off_err),
                "header_turned_err_deg": _plain(turned_err),
            }
        )  # fmt: skip
    return out


def _plain(value):
    """A number as JSON has it: None for one that is not finite."""
    return None if value is None or not np.isfinite(value) else value.item() if hasattr(value, "item") else value


def _mean(values):
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _rms(values):
    known = [value**2 for value in values if value is not None]
    return float(np.sqrt(np.mean(known))) if known else None


def rounded(timings):
    """Seconds by step, to milliseconds."""
    return {step: round(seconds, 3) for step, seconds in timings.items()}
