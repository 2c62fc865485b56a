"""Check of the maps where an exposure has no stars: how much of a frame is extrapolated, and how badly?"""

import numpy as np

from ...exceptions import some_of
from ...geometry.star_hull import enclosed_area
from ...results import new_positions
from ...results.check import Check
from .limits import MOST_NAMED

_TOO_MUCH = 0.5  # of a frame without stars around
#: Part of a frame over which its map must be as uncertain as that to be called so; less lies outside of most stars.
_PART = 0.25
#: Errors of a typical measurement beyond which a map is hardly determined. Of 60 sets of 4 to 20
#: exposures with 20 to 600 stars, degrees 1 to 3, dithered by up to 400 px, the largest has 5.2.
_HARDLY = 10.0
_GRID = 16  # places along a side at which errors are taken


def extrapolation_check(solution, residuals):
    """How much of a frame lies outside its stars, and is the map of one hardly determined over a good part of it?"""
    problem = residuals.problem
    shares, numbers = np.ones(problem.n_exposures), np.zeros(problem.n_exposures)
    for i, (ny, nx) in enumerate(problem.shapes):
        xy = problem.xy[:, problem.part(i)][:, residuals.used[problem.part(i)]].T
        shares[i], numbers[i] = 1 - enclosed_area(xy) / (nx * ny), len(xy)
    if loose := _hardly_determined(solution, residuals, shares):
        return loose
    # Of n points spread evenly 8/3 ln n / n lies outside the hull in the mean (Renyi & Sulanke 1963); the scatter is
    # that of simulated points. Half of a frame is worth a word, if it is more than chance and dithers explain.
    n = np.maximum(numbers, 3)
    chance = np.minimum(0.95, 8 / 3 * np.log(n) / n + 5 / n**0.85)
    limits = np.maximum(_TOO_MUCH, chance)
    for i in np.flatnonzero(shares > limits):
        limits[i] = max(_TOO_MUCH, 1 - (1 - chance[i]) * _within_reach(residuals, i))
    worst = int(np.argmax(shares - limits)) if np.any(shares > limits) else int(np.argmax(shares))
    share, limit, name = shares[worst], limits[worst], problem.names[worst]
    words = f"up to {share:.0%} of a frame lies outside its stars, where distortions are extrapolated ({name})"
    if share > limit:
        return Check("extrapolation", "warn", share, limit, words,
                     "measure fainter stars (a lower --threshold), or trust the correction only within the stars",
                     exposures=(name,))  # fmt: skip
    return Check("extrapolation", "pass", share, limit, words)


def _within_reach(residuals, i):
    """Part of a frame that lies on as many exposures as every star must."""
    problem, poses = residuals.problem, residuals.state.poses
    fewest = np.bincount(problem.star, minlength=problem.n_stars).min()
    plane = np.linalg.solve(poses[i, :, :2], _places(problem.shapes[i], 64) - poses[i, :, 2:])
    number = 0
    for pose, (ny, nx) in zip(poses, problem.shapes, strict=True):
        x, y = pose[:, :2] @ plane + pose[:, 2:]
        number = number + ((x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5))
    return np.mean(number >= fewest)


def _places(shape, n):
    """Pixels (2, n * n) spread evenly over a frame (ny, nx)."""
    ny, nx = shape
    step = (np.arange(n) + 0.5) / n
    return np.stack(np.meshgrid(step * nx, step * ny)).reshape(2, -1) - 0.5


def _hardly_determined(solution, residuals, shares):
    """Of exposures whose maps have large errors over a good part of the frame, the worst first; None without any."""
    limit = _HARDLY * _measured(solution, residuals)
    problem, found = residuals.problem, {}
    for i in np.flatnonzero(shares > _PART):
        errors = _map_errors(solution, i, problem.shapes[i])
        if np.quantile(errors, 1 - _PART) > limit:
            found[problem.names[i]] = errors.max()
    if not found:
        return None
    names = sorted(found, key=found.get, reverse=True)
    named = some_of([f"{name} (error up to {found[name]:.2g} px)" for name in names], MOST_NAMED)
    which, without = ("maps are", "them") if len(names) > 1 else ("map is", "it")
    leave = " ".join(list(dict.fromkeys(_whole(solution, name) for name in names))[:MOST_NAMED])
    return Check("extrapolation", "warn", found[names[0]], limit,
                 f"the {which} hardly determined over a good part of the frame, where too few stars join it to the "
                 f"others: {named}",
                 f"leave {without} out (--without {leave}), add exposures that overlap it, lower the degree, or keep "
                 "to the part with stars (coadd --extrapolated mask)", exposures=tuple(names))  # fmt: skip


def _whole(solution, name):
    """Name by which an exposure is left out: without its detector, where each of these is solved by itself."""
    if solution.settings.dynamic != "detector":
        return name
    rows = solution.residuals[np.asarray(solution.residuals["exposure"]).astype(str) == name]
    return name.removesuffix(f"-{rows['detector'][0]}")


def _measured(solution, residuals):
    """Error of a typical measurement that was used, pixels."""
    weight = residuals.problem.weight[:2][:, residuals.used]
    return solution.diagnostics.error_scale / float(np.sqrt(np.median(weight[weight > 0])))


def _map_errors(solution, i, shape):
    """Errors of the map of an exposure, relative to the stars, over its frame, pixels (n,), the larger axis."""
    view = solution[solution.names[i]]
    variance = np.einsum("naa->na", new_positions.relative_errors(view, _places(shape, _GRID).T))
    return np.sqrt(np.maximum(variance, 0)).max(axis=1)
