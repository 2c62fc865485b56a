"""Where detectors lie, with a bend of the focal plane that all of them have in common.

Where static distortions are fitted, exposures and detectors can exchange a map of the focal plane, and layouts do not
contain it. If a reference told it (`Camera.common_map`), the place of a detector is that of its whole map, from the
plane as the sky shows it to undistorted pixels: the affine part of ``P (f + C(f))``, C the common map.
"""

from dataclasses import replace

import numpy as np

from ..geometry import basis
from ..geometry.distortion import Distortion
from ..runtime.notebook import Column, Fact, Grid
from .detector import Detector, map_beside, maps_of_plane


def shifts_and_turns(camera, n):
    """Layout modes (6 n_detectors, 2 n) of all detectors, by the n modes per axis of a map of the focal plane."""
    each = [maps_of_plane(detector, camera.field, n) for detector in camera.detectors.values()]
    return np.concatenate([modes.reshape(2, n, 2 * n)[:, :3].reshape(6, 2 * n) for modes in each])


def exchanges_a_bend(camera):
    """Whether layouts and static distortions were found, so that exposures may have taken over a bend of theirs."""
    each = camera.detectors.values()
    found = [d.layout_covariance is not None and d.static_sigma is not None and np.any(d.static_sigma) for d in each]
    return camera.has_focal_plane and any(found)


def places(camera):
    """The `Place` of every detector, ``{id: Place}``; see `Camera.places`."""
    if camera.common_map is None or not exchanges_a_bend(camera):
        return {key: each.place for key, each in camera.detectors.items()}
    errors = camera.place_errors
    errors = relative_errors(camera, _independent(camera)) if errors is None else errors
    plane, out = Distortion(camera.common_map, camera.field), {}
    for (key, each), row in zip(camera.detectors.items(), errors, strict=True):
        whole = Detector(each.shape, layout=each.layout, static=map_beside(each, each.layout, plane)).placed()
        out[key] = replace(whole.place, errors=tuple(row.tolist()))
    return out


def parts(camera):
    """The table of where detectors lie, with the errors of that where it is not exact, and whether nothing is known."""
    found = places(camera)
    unknown = all(place.errors is not None and not np.isfinite(place.errors).any() for place in found.values())
    known = any(place.errors is not None for place in found.values()) and not unknown
    sizes = [" x ".join(map(str, camera[key].shape[::-1])) for key in found]
    columns = [
        Column("detector", list(found), max(10, *map(len, found)), words=True),
        Column("size [px]", sizes, 13),
    ]
    for k, (head, name, size, digits) in enumerate(_PLACE):
        columns.append(Column(head, [f"{getattr(place, name):.{digits}f}" for place in found.values()], size))
        if known:
            errors = [f"{place.errors[k] if place.errors else 0.0:.2g}" for place in found.values()]
            columns.append(Column("+-", errors, 8))
    columns.append(Column("scale", [f"{place.scale:.6f}" for place in found.values()], 9))
    columns.append(Column("static", [f"{camera[key].rms:.3f}" for key in found], 8))
    return [Grid(columns), Fact("", "errors of the layout: not known" * unknown)]


_PLACE = ("centre x", "x", 10, 2), ("centre y", "y", 10, 2), ("rotation", "rotation", 9, 4)


def relative_errors(camera, covariance):
    """Standard deviations (n_detectors, 3) of x, y and rotation of all detectors, after one affine map of them.

    Infinite for detectors of which nothing determines the layout.

    Parameters
    ----------
    camera : Camera
    covariance : ndarray, shape (6 n_detectors, 6 n_detectors)
        Of the modes of their layouts.
    """
    each = list(camera.detectors.values())
    known = np.array([d.layout_sigma is None or bool(np.isfinite(d.layout_sigma).all()) for d in each])
    out = np.full((len(each), 3), np.inf)
    if not known.any():
        return out
    rows = np.repeat(known, 6)
    common = shifts_and_turns(camera, 3)[rows]
    left = np.eye(len(common)) - (common @ np.linalg.pinv(common) if np.count_nonzero(known) > 1 else 0.0)
    blocks = (left @ covariance[np.ix_(rows, rows)] @ left.T).reshape(-1, 6, np.count_nonzero(known), 6)
    for i, k in enumerate(np.flatnonzero(known)):
        weights = each[k].place_weights
        out[k] = np.sqrt(np.maximum(np.diag(weights @ blocks[i, :, i] @ weights.T), 0.0))
    return out


def largest_by_bend(camera, degree):
    """Largest shift [pix] and rotation [deg] of a detector by a map of 1 px rms of degrees 2 to `degree`."""
    orders = np.add(*basis.orders(degree))
    bends = shifts_and_turns(camera, basis.n_modes(degree))[:, np.tile(orders > 1, 2)]
    found = []
    for each, moved in zip(camera.detectors.values(), bends.reshape(len(camera.detectors), 6, -1), strict=True):
        x, y, turn = each.place_weights @ moved
        # modes have mean square 1/4: coefficients of a map of 1 px rms, both axes together, are 2 px long
        found.append([2 * np.linalg.norm(np.stack([x, y]), 2), 2 * np.linalg.norm(turn)])
    return np.max(found, axis=0)


def bend_in_words(camera, degree):
    """By how much a map of all detectors together, to a degree, has them elsewhere; empty of an affine one."""
    if degree < 2:
        return ""
    shift, turn = largest_by_bend(camera, degree)
    return (
        f"a bend of all together by 1 px rms, which a reference would tell (--reference), shifts single ones by up to "
        f"{shift:.2g} px and turns them by up to {turn:.2g} deg"
    )


def relative_in_words(degree):
    """That errors of a layout are after a map of all detectors, to a degree, in words."""
    which = "one affine map" if degree < 2 else f"one map of degree {degree}"
    return (
        f"errors of the layout are those of detectors relative to each other, after {which} of all together, which "
        "exposures take over"
    )


def _independent(camera):
    """Covariance of the layouts with the `common_map`, as if the errors of both had nothing in common."""
    known = np.where(np.isfinite(camera.common_sigma), camera.common_sigma, 0.0)
    moved = shifts_and_turns(camera, known.shape[1]) * known.ravel()
    out = moved @ moved.T
    for k, each in enumerate(camera.detectors.values()):
        if each.layout_sigma is not None:
            own = np.diag(each.layout_sigma.ravel() ** 2) if each.layout_covariance is None else each.layout_covariance
            part = slice(6 * k, 6 * k + 6)
            out[part, part] += np.where(np.isinf(own), 0.0, own)
    return out
