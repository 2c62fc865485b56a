"""Positions corrected for the static distortion of a camera alone, without a solution, and their errors.

An exposure departs from the static distortion, its pose is its own, and neither is asked for: positions lie in the
focal plane of the camera (the undistorted pixels of a single detector) up to a similarity for every exposure. Errors of
the measurement, of the departure of an exposure, and of the static distortion count as independent. The departure moves
a position f by ``b(f)`` times its coefficients, and errors of a detector by `moved_by`, to first order.
"""

from dataclasses import replace

import numpy as np
from astropy import units as u

from ..exceptions import AssumptionWarning, InputError, some_of, warn
from ..geometry import basis, detector_modes, similarity
from ..geometry.distortion import Distortion
from ..inputs import column_contract
from ..inputs.detector_files import with_ids_of
from .detector import moved_by
from .stated_errors import FREE, StaticSpread, as_widths, resized

#: Beyond its edge by more [pix] a position is off a detector, and by this part of a side the series means nothing.
_BEYOND, _FAR = 1.0, 0.1
#: Positions that a message names.
_MOST_NAMED = 3


def correct_table(camera, table, sigma=None, rest=None):
    """`Camera.correct_table`; see there. `rest` is the table beside the series of the static distortion of images."""
    table = column_contract.as_table(table, "the list")
    known = {"x_err", "y_err"} & set(table.colnames)
    table = column_contract.check(table, column_contract.MEASURED if known else column_contract.LISTED, "the list")
    if not (camera.has_focal_plane or camera.states_static):
        raise InputError(f"camera {camera.name} states no static distortion: there is nothing to correct with it")
    table = with_ids_of(table, camera.detectors) if camera.has_focal_plane else table
    detector = _detectors(camera, table)
    xy = np.column_stack([table[name].to_value(u.pix) for name in "xy"])
    measured = column_contract.covariance(table) if known else np.zeros((len(xy), 2, 2))
    _check_on_detectors(camera, xy, detector)
    f, relative, absolute, moved = np.empty_like(xy), *np.empty((2, len(xy), 2, 2)), np.empty((2, len(xy)))
    for key in np.unique(detector):
        rows = detector == key
        f[rows], parts = _corrected(camera, key, xy[rows], measured[rows], sigma, rest)
        relative[rows], absolute[rows], moved[:, rows] = parts
    return _as_table(camera, table, f, relative, absolute, moved)


def _detectors(camera, table):
    """Detector of every row; that of plain images has no need of its id."""
    if "detector" not in table.colnames and len(camera.detectors) > 1:
        raise InputError(
            f"the list has no column detector, which of {', '.join(camera.detectors)} of camera {camera.name}: add it, "
            "or name the detector of all (--detector)"
        )
    if not camera.has_focal_plane and len(np.unique(table["detector"] if "detector" in table.colnames else ())) < 2:
        return np.full(len(table), *camera.detectors)
    return camera.ids(table)


def _check_on_detectors(camera, xy, detector):
    """Warn of positions (n, 2) off their detectors, as stars at an edge have them; `InputError` for those far off."""
    size = np.array([camera[key].shape[::-1] for key in detector])
    beyond = np.maximum(-0.5 - xy, xy - (size - 0.5))
    if not len(off := np.flatnonzero(np.any(beyond > _BEYOND, axis=1))):
        return
    far = np.flatnonzero(np.any(beyond > _FAR * size, axis=1))
    named = [f"row {k}, ({xy[k, 0]:.1f}, {xy[k, 1]:.1f})" for k in (far if len(far) else off)]
    nx, ny = size[far[0] if len(far) else off[0]]
    which = f", detector {detector[far[0] if len(far) else off[0]]}" * (len(camera.detectors) > 1)
    said = f"{len(off)} of {len(xy)} positions of the list lie off camera {camera.name}{which}, {nx} x {ny} px: "
    said += some_of(named, _MOST_NAMED)
    if len(far):
        raise InputError(
            f"{said}; is it the list of another detector, of binned pixels, or of a mosaic? Give the camera of the "
            "list, or leave these rows out"
        )
    warn(f"{said}; the correction is extrapolated there", AssumptionWarning)


def _corrected(camera, key, xy, measured, sigma, rest):
    """Places (n, 2) in the focal plane of pixels of a detector, relative and absolute covariance (n, 2, 2), variances.

    The last, (2, n), are the means per axis by the static distortion and by the departure of an exposure.
    """
    detector = camera[key]
    distortion = detector.distortion if rest is None else replace(detector.distortion, table=rest)
    distortion.check_fold()
    q = distortion.invert(xy)
    f = similarity.apply(similarity.invert(detector.layout), q)
    through = np.linalg.inv(distortion.jacobian(q) @ detector.layout[:, :2])
    shared = np.zeros((len(xy), 2, 0)), np.zeros(0)
    if camera.common_map is not None:
        plane = Distortion(camera.common_map, camera.field)
        f = plane.invert(f)
        through = np.linalg.inv(plane.jacobian(f)) @ through
    if camera.common_sigma is not None:
        shared = _by_modes(f, camera.field, camera.common_sigma)
    own = _by_detector(camera, key, q)
    base = with_scatter = through @ measured @ through.mT
    if sigma is not None:
        n = np.shape(sigma)[-1] if np.ndim(sigma) else detector.static.shape[1]
        with_scatter = _grown(base, *_by_modes(f, camera.field, as_widths(sigma, n, "sigma")))
    own, shared = (own, shared) if camera.has_focal_plane else (shared, own)
    relative = _grown(with_scatter, *own)
    absolute = _grown(relative, *shared)
    moved = [np.einsum("nkk->n", each) / 2 for each in (absolute - with_scatter, with_scatter - base)]
    return f, (relative, absolute, np.array(moved))


def _by_modes(f, shape, sigma):
    """Movements (n, 2, k) by independent errors of a distortion of a plane of widths (2, n_modes), and variances (k,).

    Similarities, which poses take up, are left out.
    """
    rows = detector_modes.dynamic_basis(shape, sigma.shape[1])
    values = basis.values(basis.degree_of(sigma.shape[1]), *basis.normalize(f, shape))
    through = -np.einsum("kam,mn->nak", rows.reshape(len(rows), 2, sigma.shape[1]), values)
    return through, detector_modes.row_variances(rows, sigma.ravel())


def _by_detector(camera, key, q):
    """The same by errors of the static distortion of a detector and, in a focal plane, of its layout."""
    detector = camera[key]
    n = detector.static.shape[1]
    covariance, rows = _covariance(detector.static_covariance, detector.static_sigma, n), None
    if not camera.has_focal_plane:
        rows = detector_modes.dynamic_basis(detector.shape, n)
    elif camera.covariance is not None:
        n = max(n, 3)
        place, size = list(camera.detectors).index(key), len(camera.covariance) // len(camera.detectors)
        own = slice(size * place, size * (place + 1))
        covariance = resized(camera.covariance[own, own], n)
    else:
        n = max(n, 3)
        whole = np.zeros((2, n, 2, n))
        whole[:, 3:, :, 3:] = np.zeros((2, 0, 2, 0)) if n == 3 else covariance.reshape(2, n, 2, n)[:, 3:, :, 3:]
        layout = _covariance(detector.layout_covariance, detector.layout_sigma, 3)
        whole[:, :3, :, :3] = layout.reshape(2, 3, 2, 3)
        covariance = whole.reshape(2 * n, 2 * n)
    rows = np.eye(2 * n) if rows is None else rows
    spread = StaticSpread.of(rows[None], np.zeros((1, 2 * n)), [covariance])
    directions, variance = spread.directions[0], spread.variance[0]
    return moved_by(detector, q, (rows.T @ directions).reshape(2, n, -1)), variance


def _covariance(covariance, sigma, n):
    """The one that is stated of 2 n coefficients, zero where they count as exact."""
    if covariance is not None:
        return covariance
    return np.zeros((2 * n, 2 * n)) if sigma is None else np.diag(sigma.ravel() ** 2)


def _grown(covariance, through, variance):
    """A covariance (n, 2, 2) with that by independent errors added; NaN where what is not known moves more than all."""
    free = np.isinf(variance)
    out = covariance + through * np.where(free, 0, variance) @ through.mT
    unknown = FREE**2 * np.sum(through[:, :, free] ** 2, axis=(1, 2))
    out[unknown > np.trace(out, axis1=1, axis2=2)] = np.nan
    return out


def _as_table(camera, table, f, relative, absolute, moved):
    """The table with corrected positions in the place of those measured, their errors, and what these are, in words."""
    out = table.copy()
    if camera.has_focal_plane:
        out["x_detector"], out["y_detector"] = table["x"], table["y"]
    out["x"], out["y"] = f.T * u.pix
    with np.errstate(invalid="ignore"):
        column_contract.set_covariance(out, relative)
    out["x_err_abs"], out["y_err_abs"] = np.sqrt(np.einsum("nkk->kn", absolute)) * u.pix
    for name, mean in zip(("static_error_px", "exposure_scatter_px"), moved, strict=True):
        known = mean[np.isfinite(mean)]
        out.meta[name] = float(np.sqrt(known.mean())) if len(known) else None
    out = column_contract.describe_stars(out)
    for name in "xy":
        out[name].info.description = "position without the static distortion in the focal plane, pixels from 0"
    return out
