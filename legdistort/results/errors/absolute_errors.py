"""Errors of star positions and coefficients with those of the common map: absolute, up to what is unknown.

Positions are ``X + D g``: the relative ones, as they come out in the gauge, and a common map g of the reference plane
seen through the directions D (`Gauge.directions`). To first order D are the modes of g, which a map of the same degree
takes off again. What is left of them, the product of the map with the gradient of the distortions, is part of the
relative errors.
"""

import numpy as np

from .common_maps import plain_maps


def plain_directions(gauge, xy, n):
    """Displacements (n_stars, 2, 2 n) by the modes of the reference plane themselves."""
    return plain_maps(gauge, xy, n)[:, :2, : 2 * n]


def map_directions(gauge, xy):
    """Directions (n_stars, 2, 2 n) for the modes of `Gauge.absolute_covariance`."""
    n = len(gauge.absolute_covariance) // 2
    return gauge.directions if n == gauge.n_modes else plain_directions(gauge, xy, n)


def relative_variance(gauge, uncertainty, xy):
    """Covariance xx, yy, xy (3, n_stars) of positions (n_stars, 2) once a common map of the fitted degree is taken off.

    See `legdistort.results.errors.common_maps`; with the part of the common map that is of second order.
    """
    return variances(relative_blocks(gauge, uncertainty, xy))


def variances(blocks):
    """Covariances (n, 2, 2), or larger ones that begin with them, as xx, yy, xy (3, n)."""
    return np.stack([blocks[:, 0, 0], blocks[:, 1, 1], blocks[:, 0, 1]])


def relative_blocks(gauge, uncertainty, xy):
    """The same of all unknowns of the stars, (n_stars, 2 + k, 2 + k), maps that change with time taken off too."""
    good = np.isfinite(xy[:, 0]) & np.isfinite(uncertainty.stars[0])
    out, common = own_blocks(gauge, uncertainty), uncertainty.common
    out[~np.isfinite(xy[:, 0])] = np.nan
    if gauge.plane is not None or common is None or not np.count_nonzero(good):
        return out
    if common.n_modes(gauge) >= np.count_nonzero(good):  # maps that nothing determines explain any position
        return np.full_like(out, np.nan)
    directions, hidden = _common(gauge, uncertainty, xy)
    directions = np.ascontiguousarray(np.where(good[:, None, None], directions, 0))  # rounded alike, read or not
    left = common.left(gauge, xy, directions)
    return common.without_maps(gauge, xy, out) + left @ hidden @ left.mT


def absolute_blocks(gauge, uncertainty, xy):
    """Covariance (n_stars, 2 + k, 2 + k) of all unknowns of the stars with that of common maps, unknown ones aside."""
    directions, hidden = _common(gauge, uncertainty, xy)
    out = own_blocks(gauge, uncertainty) + directions @ hidden @ directions.transpose(0, 2, 1)
    out[~np.isfinite(xy[:, 0])] = np.nan
    return out


def without_unknown_motions(gauge, covariance):
    """Covariances (n_stars, 2 + k, 2 + k) with NaN for what moves stars where an unknown direction changes it by more.

    A direction that moves the stars by a pixel, rms.
    """
    out = covariance.copy()
    for each in gauge.unknown:
        if each.motions is not None:
            lost = np.pad(each.motions**2 > np.einsum("jaa->ja", out)[:, 2:], ((0, 0), (2, 0)))
            out[lost[:, :, None] | lost[:, None, :]] = np.nan
    return out


def _common(gauge, uncertainty, xy):
    """How common maps move the unknowns of the stars, (n_stars, 2 + k, c), and the covariance (c, c) of these maps."""
    if gauge.drift is None:
        return map_directions(gauge, xy), gauge.absolute_covariance
    return uncertainty.drift_directions, gauge.joint_covariance


def own_blocks(gauge, uncertainty):
    """Covariance (n_stars, 2 + k, 2 + k) of the unknowns of the stars in the gauge."""
    blocks = uncertainty.stars if gauge.drift is None else uncertainty.star_unknowns
    size = 2 if gauge.drift is None else 2 + len(gauge.drift.names)
    low, high = np.sort(np.indices((size, size)), axis=0)  # `legdistort.solving.equations.star_terms.packed`
    index = high * (high + 1) // 2 + low
    index[:2, :2] = [[0, 2], [2, 1]]
    out = np.moveaxis(blocks[index], -1, 0).copy()
    out[:, :2, :2] = np.moveaxis(uncertainty.stars[index[:2, :2]], -1, 0)
    return out


def absolute_variance(gauge, uncertainty, xy, *, without_unknown=False):
    """Covariance xx, yy, xy (3, n_stars) of positions with that of the common map.

    NaN, unless `without_unknown`, for a star that an unknown direction of unit rms moves by more than the rest of its
    error; infinite even so where it is the place of its detector that nothing determines.
    """
    if gauge.plane is not None:
        return np.full_like(uncertainty.stars, np.nan)
    out = variances(absolute_blocks(gauge, uncertainty, xy))
    if gauge.tie is not None:
        out = out + gauge.tie.shared
    if not without_unknown:
        for each in gauge.unknown:
            out[:, np.sum(each.stars**2, axis=1) > out[0] + out[1]] = np.nan
    if camera := uncertainty.camera:  # it is not one map that would have to be taken off, but detectors by themselves
        for each in np.moveaxis(camera.unknown, 2, 0):
            lost = np.sum(each**2, axis=1) > out[0] + out[1]
            out[:, lost] = np.inf if without_unknown else np.nan
    return out


def own_coefficients(gauge, uncertainty, i):
    """Covariance (2 n_modes, 2 n_modes) of the coefficients of exposure i in the gauge, a camera taken as known."""
    return uncertainty.of_exposure(i, len(gauge.motion))


def relative_coefficients(gauge, uncertainty, i):
    """Covariance (2 n_modes, 2 n_modes) of the coefficients of exposure i once a common map is taken off the stars.

    A camera is taken as known.
    """
    block, common = own_coefficients(gauge, uncertainty, i), uncertainty.common
    return block if common is None or gauge.plane is not None else common.of_coefficients(gauge, block, i)


def coefficient_variance(gauge, block, i, response=None):
    """Variance (2, n_modes) of the coefficients of exposure i from their covariance `block` in the gauge.

    NaN for what an unknown direction of unit rms changes by more than the rest of the error. Or of what follows these
    coefficients by a `response` (k, 2 n_modes), with its covariance in the place of theirs.
    """
    follow = np.eye(len(block)) if response is None else response
    moved = follow @ known_changes(gauge, follow.shape[1] // 2)[i]
    out = np.diag(block) + np.einsum("ab,bc,ac->a", moved, known_covariance(gauge), moved)
    for each in unknown_changes(gauge, follow.shape[1] // 2)[:, i]:
        out[(follow @ each) ** 2 > out] = np.nan
    return out.reshape(2, -1)


def known_changes(gauge, n_modes):
    """How coefficients change with the modes of the common map, up to the sign, (n_exposures, 2 n_modes, 2 n)."""
    n_exposures, _, n = gauge.motion.shape
    out = np.zeros((n_exposures, 2, n_modes, n))
    out[:, :, : gauge.n_own] = gauge.motion.reshape(n_exposures, 2, gauge.n_own, n)
    return out.reshape(n_exposures, 2 * n_modes, n)


def known_covariance(gauge):
    """Covariance (2 n, 2 n) of these modes, what is unknown left out; with a reference what that leaves open."""
    tied = None if gauge.tie is None else gauge.tie.covariance
    return gauge.covariance if tied is None or len(tied) != len(gauge.covariance) else tied


def unknown_changes(gauge, n_modes):
    """How coefficients change with each direction that nothing determines, (m, n_exposures, 2 n_modes), pixels."""
    out = np.zeros((len(changes := gauge.unknown_coefficients), len(gauge.motion), 2, n_modes))
    for row, each in zip(out, changes, strict=True):
        row[:, :, : each.shape[2]] = each
    return out.reshape(*out.shape[:2], 2 * n_modes)
