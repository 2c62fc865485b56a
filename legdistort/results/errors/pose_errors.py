"""Errors of the numbers that tell how an exposure lies: shift, rotation, scale, and on the sky angle and pixel scale.

A similarity of the coefficients is one of the pose: its error, and what a map that nothing determines does to it, are
those of the pose, to first order in the distortion. They are relative to the mean of the exposures, which is that of
the nominal poses or the headers, unless a reference or known poses determine it too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...geometry import basis, similarity
from ...geometry.detector_modes import similarity_basis, similarity_poses
from . import absolute_errors

#: What a pose tells, and on the sky: its unit, decimals, and how sentences name it.
POSE = {"dx": ("px", 2, "shift"), "dy": ("px", 2, ""), "rotation": ("deg", 4, "rotation"), "scale": ("", 6, "scale")}
SKY = {"position_angle": ("deg", 4, "PA"), "pixel_scale": ("arcsec", 6, "pixel scale")}
#: Step [px over the detector] of numerical derivatives.
_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class PoseNumbers:
    """The numbers of a pose by name, with their errors.

    Attributes
    ----------
    values : dict
        ``{name of POSE and, where the sky is known, of SKY: number}``.
    errors : dict
        Standard deviations; NaN where a map that nothing determines changes the number by more than the rest of its
        error, and where the exposure has no modes that would determine it.
    unknown : dict
        By how much maps that nothing determines change it, if each is 1 px, rms per axis.
    """

    values: dict[str, float]
    errors: dict[str, float]
    unknown: dict[str, float]

    def is_lost(self, name: str) -> bool:
        """Whether a map that nothing determines changes a number by more than it is known otherwise."""
        return bool(np.isnan(self.errors[name]) and self.unknown[name] > 0)

    def text(self, name: str) -> str:
        """A number; with ``~`` and the decimals that such maps of 1 px leave, where it is not determined."""
        digits = (POSE | SKY)[name][1]
        if not self.is_lost(name):
            return f"{self.values[name]:.{digits}f}"
        return f"~{self.values[name]:.{int(np.clip(-np.floor(np.log10(self.unknown[name])), 0, digits))}f}"


def pose_numbers(solution):
    """The `PoseNumbers` of all exposures of a solution, of their focal planes if they have these, as a list."""
    gauge, views = solution.gauge, list(solution)
    shape, size = views[0].shape, basis.n_modes(solution.degree)
    values = [_values(view, view.pose) for view in views]
    if gauge.plane is not None or size < basis.n_modes(1):  # not this package's correction, or shifts alone
        return [PoseNumbers(each, dict.fromkeys(each, np.nan), dict.fromkeys(each, 0.0)) for each in values]
    maps = [np.moveaxis(absolute_errors.known_changes(gauge, size), 2, 0), absolute_errors.unknown_changes(gauge, size)]
    if gauge.tie is None and not gauge.poses_known:  # rotation and scale of the plane itself are a convention
        turns = similarity_basis(shape, size)[2:]
        maps = [each - each.mean(axis=1, keepdims=True) @ turns.T @ turns for each in maps]
    return [_numbers(view, values[i], *(each[:, i] for each in maps)) for i, view in enumerate(views)]


def _numbers(view, values, known, unknown):
    """The `PoseNumbers` of an exposure, whose coefficients maps (2 n, 2 n_modes) and those that are unknown change."""
    response = _response(view, values, unknown.shape[1] // 2)
    of_maps, covariance = known @ response.T, absolute_errors.known_covariance(view.solution.gauge)
    variance = np.diag(response @ view.covariance @ response.T + of_maps.T @ covariance @ of_maps)
    moved = (unknown @ response.T) ** 2
    errors = np.sqrt(np.where((moved > variance).any(axis=0), np.nan, variance)).tolist()
    changes = np.sqrt(moved.sum(axis=0)).tolist()
    return PoseNumbers(values, *(dict(zip(values, each, strict=True)) for each in (errors, changes)))


def _response(view, names, size):
    """How numbers of the pose of an exposure change with its coefficients, shape (n_names, 2 n_modes)."""
    rows, poses, slopes = similarity_basis(view.shape, size), similarity_poses(view.shape, size), []
    for row in rows:
        step = _STEP * (poses @ row).reshape(2, 3)
        ends = [_values(view, similarity.compose(np.eye(2, 3) + sign * step, view.pose)) for sign in (1, -1)]
        change = {name: ends[0][name] - ends[1][name] for name in names}
        for name in {"rotation", "position_angle"} & set(change):
            change[name] = (change[name] + 180) % 360 - 180
        slopes.append([each / (2 * _STEP) for each in change.values()])
    return np.transpose(slopes) @ rows


def mean_pose_errors(solution, weights, scatter):
    """Standard deviations of scale (as a part of it) and rotation [deg] of the mean pose on the sky.

    Parameters
    ----------
    solution : Solution
    weights : ndarray, shape (n_exposures,)
        Of the mean.
    scatter : ndarray, shape (2,)
        Standard deviations of the mean of scale and rotation [rad], by how headers of the exposures differ.

    Returns
    -------
    tuple of float, or None
        Without a reference those of its camera. None without poses that were fitted, or where a map that nothing
        determines changes them.
    """
    gauge, size = solution.gauge, basis.n_modes(solution.degree)
    if gauge.tie is None:
        return solution.camera.header_errors
    if gauge.plane is not None or size < basis.n_modes(1):
        return None
    responses = [_response(view, ("scale", "rotation"), size) for view in solution]
    known = np.moveaxis(absolute_errors.known_changes(gauge, size), 2, 0)
    unknown = absolute_errors.unknown_changes(gauge, size)
    of_maps, lost = (np.einsum("i,kim,ivm->kv", weights, each, responses) for each in (known, unknown))
    own = sum(w**2 * r @ view.covariance @ r.T for w, r, view in zip(weights, responses, solution, strict=True))
    shared = of_maps.T @ absolute_errors.known_covariance(gauge) @ of_maps
    variance = np.maximum(np.diag(own), (scatter * [1, np.degrees(1)]) ** 2) + np.diag(shared)
    return None if (lost**2 > variance).any() else tuple(np.sqrt(variance).tolist())


def pose_variances(solution):
    """Variances [pix^2, per axis at the corners of the detector] of rotation and scale of every exposure, as a list.

    Of what each has by itself: errors of a map of all exposures together, which these share, are left out.
    """
    size = basis.n_modes(solution.degree)
    if size < basis.n_modes(1):
        return [0.0 for _ in solution]
    rows = [similarity_basis(view.shape, size)[2:] for view in solution]
    # a unit of a mode is 1/4 in mean square, and three times that at the corners
    return [3 / 8 * float(np.trace(r @ view.covariance @ r.T)) for r, view in zip(rows, solution, strict=True)]


def in_words(numbers):
    """How well the poses of exposures, a list of `PoseNumbers`, are known, in sentences; empty where that is not said.

    Errors are the largest of all exposures, and what maps that nothing determines do to them.
    """
    columns = {name: word for name, (_, _, word) in (POSE | SKY).items() if word and name in numbers[0].values}
    units = {name: f" {(POSE | SKY)[name][0]}".rstrip() for name in columns}
    lost = {name: max(each.unknown[name] for each in numbers) for name in columns if _any_lost(numbers, name)}
    known = {name: max(each.errors[name] for each in numbers) for name in columns if name not in lost}
    known = {name: error for name, error in known.items() if np.isfinite(error)}
    out = []
    if known:
        listed = ", ".join(f"{columns[name]} to {error:.2g}{units[name]}" for name, error in known.items())
        out.append(f"known, relative to the mean of the exposures: {listed}")
    if lost:
        listed = ", ".join(f"{columns[name]} by up to {change:.2g}{units[name]}" for name, change in lost.items())
        out.append(f"not determined (~): what is unknown, if it is 1 px rms, changes {listed}")
    return "; ".join(out)


def _any_lost(numbers, name):
    return any(each.is_lost(name) for each in numbers)


def _values(view, pose):
    out = {name: each for name, each in similarity.describe(pose).items() if name in POSE}
    if view.solution.sky is not None:
        out |= dict(zip(SKY, view.solution.sky.orientation(pose, view.shape), strict=True))
    return out
