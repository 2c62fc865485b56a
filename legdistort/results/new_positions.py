"""Positions that took no part in the solution, corrected with it, and their errors.

Stated errors of their measurement count as those of the observations do: with the floor, the scale or the law that were
found (`Diagnostics.found_errors`). The errors of the coefficients have these already.

A pixel p of exposure i is corrected to ``X = T_i^-1 D_i^-1(p)``. An error dp of its measurement and one dA_i of the
coefficients move it by ``(D_i' T_i)^-1 (dp - B dA_i)``, B the basis there. A common map g of the plane changes A_i by
``-N_i g``, to first order in the distortion of this exposure alone. Measurement, coefficients in the gauge and common
map count as independent. With a reference the noise of its stars is in coefficients and map alike. What the two share
sums to zero over the exposures, as the constraint of the gauge has it for the coefficients, and is neglected.
"""

from typing import NamedTuple

import numpy as np
from astropy import units as u
from scipy.spatial import cKDTree

from ..exceptions import AssumptionWarning, InputError, some_of, warn
from ..geometry import basis, similarity
from ..geometry.epochs import year
from ..geometry.models import like, to_pixels
from ..inputs import column_contract
from ..inputs.detector_files import with_ids_of
from .errors import absolute_errors, common_maps
from .motions import fitted

#: Positions that agree to this [pix] are one, as tables with rounded numbers have it; exposures are this far apart.
_SAME, _APART = 1e-3, 1e6
#: Positions that a warning names.
_MOST_NAMED = 3


class Corrected(NamedTuple):
    """Corrected positions with their errors, as `View.correct` gives them.

    Attributes
    ----------
    xy : ndarray, shape (n, 2)
        Reference positions, pixels.
    relative : ndarray, shape (n, 2, 2)
        Covariance once a common map of the fitted degree is taken off, px^2: the measurement and the distortion of this
        exposure. It compares positions of one field, from one exposure to another and with ``solution.stars``.
    absolute : ndarray, shape (n, 2, 2)
        Covariance with the common map, px^2; NaN where that is not known (`Gauge.unknown`).
    """

    xy: np.ndarray
    relative: np.ndarray
    absolute: np.ndarray


class Movement(NamedTuple):
    """What carries stars seen in an exposure to their places at another time.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Of the stars in the solution.
    columns : ndarray, shape (2, k)
        Displacement [pix] for a unit of each term of the motions.
    """

    rows: np.ndarray
    columns: np.ndarray

    def displacement(self, motions):
        """Displacements (n, 2) [pix]; zero for stars without a motion."""
        return np.nan_to_num(motions.values[self.rows]) @ self.columns.T


def movement(solution, name, stars, epoch, n):
    """The `Movement` of n positions of named stars from an exposure to an epoch; None without an epoch.

    Raises
    ------
    InputError
        If there are stars without an epoch or an epoch without stars, motions were not fitted, or a star is not in the
        solution.
    """
    if (epoch is None) != (stars is None):
        raise InputError(
            "a position is carried to another time by the motion of its star: give both epoch and stars, or neither"
        )
    if epoch is None:
        return None
    motions = fitted(solution.estimate.motions)
    try:
        names = np.asarray(stars).astype(str)
    except (TypeError, ValueError):
        names = np.empty(0)
    if names.shape != (n,):
        raise InputError(f"stars must name a star of the solution for each of the positions, of which there are {n}")
    order = {each: row for row, each in enumerate(np.asarray(solution.estimate.star_names).astype(str).tolist())}
    if strange := sorted({each for each in names.tolist() if each not in order}):
        raise InputError(
            f"no motion is known of {some_of(strange, 6)}: the solution has no such stars, and a position is "
            "carried to another time by the motion of its star"
        )
    there, here = motions.columns([year(epoch), motions.years[solution.names.index(name)]], solution.sky)
    return Movement(np.array([order[each] for each in names.tolist()], dtype=int), there - here)


def correct(view, pixels, moved=None):
    """Positions (n, 2) of pixels of an exposure, carried to another time by a `Movement`; undistorted pixels too."""
    view.distortion.check_fold()
    q = view.distortion.invert(pixels)
    corrected = similarity.apply(similarity.invert(view.pose), q)
    return corrected if moved is None else corrected + moved.displacement(view.solution.estimate.motions), q


def correct_with_errors(view, xy, errors, moved=None, flux=None):
    """`View.correct` with errors, carried to another time by a `Movement`; see there."""
    pixels = np.atleast_2d(to_pixels(xy))
    measured = _covariance(errors, len(pixels))
    flux = None if flux is None else _fluxes(flux, len(pixels))
    if view.chip is not None:
        pixels, measured = view.chip.to_focal_plane(pixels, measured)
    if measured.any():
        _warn_of_no_flux(view.solution, flux, len(pixels))
    known = {"flux": flux, "exposure": np.full(len(pixels), view.name), "axes": _axes(view)}
    measured = view.solution.diagnostics.found_errors(measured, **known)
    corrected, relative, absolute = _with_errors(view, pixels, measured, moved)
    if isinstance(xy, u.Quantity):
        relative, absolute = relative * u.pix**2, absolute * u.pix**2
    return Corrected(like(xy, corrected), relative, absolute)


def _with_errors(view, pixels, measured, moved):
    """`Corrected` of pixels of an exposure, of its focal plane if it has one, with their covariances (n, 2, 2)."""
    corrected, q = correct(view.common, pixels, moved)
    return Corrected(corrected, *covariances(view, q, measured, moved))


def _covariance(errors, n):
    """Covariance (n, 2, 2) of measured positions from what was given."""
    if isinstance(errors, u.Quantity):
        unit = u.pix**2 if errors.ndim == 3 else u.pix
        if not errors.unit.is_equivalent(unit):
            raise InputError(f"errors must be in {unit}, got {errors.unit}")
        errors = errors.to_value(unit)
    try:
        given = np.asarray(errors, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"errors must be numbers, in pixels: {error}") from None
    try:
        given = np.broadcast_to(given, (n, 2, 2) if given.ndim == 3 else (n, 2))
    except ValueError:
        raise InputError(
            f"errors must be standard deviations of shape ({n}, 2) or covariances of shape ({n}, 2, 2), one for each "
            f"position, got shape {given.shape}"
        ) from None
    finite = np.isfinite(given).all(axis=tuple(range(1, given.ndim)))
    known = np.where(finite.reshape(-1, *[1] * (given.ndim - 1)), given, -1.0)
    if given.ndim == 2:
        bad, out = (known < 0).any(axis=1), known[:, :, None] ** 2 * np.eye(2)
    else:
        bad, out = (known[:, 0, 1] != known[:, 1, 0]) | (known[:, [0, 1], [0, 1]] < 0).any(axis=1), known
        bad |= known[:, 0, 0] * known[:, 1, 1] < known[:, 0, 1] ** 2
    if bad.any():
        k = int(np.flatnonzero(bad)[0])
        raise InputError(
            "errors must be standard deviations, finite and not negative, or covariances, symmetric and positive; "
            f"row {k} has {given[k].tolist()}"
        )
    return out


def _fluxes(flux, n):
    """Fluxes (n,) of positions from what was given."""
    try:
        return np.array(np.broadcast_to(np.asarray(getattr(flux, "value", flux), dtype=float), (n,)))
    except (TypeError, ValueError):
        raise InputError(f"flux must be a number for each of the positions, of which there are {n}") from None


def _axes(view):
    """Axes (2, 2) of the reference plane in the pixels of an exposure, its columns."""
    return view.solution.poses[view.name][:, :2]


def _warn_of_no_flux(solution, flux, n):
    """Warn of positions without a flux (n,), which a law of brightness says nothing of."""
    law = solution.diagnostics.error_law
    lost = 0 if law is None else n if flux is None else np.count_nonzero(~law.knows(flux))
    if lost:
        warn(
            f"{lost} of {n} positions have no positive flux and keep the errors that were given: those of the solution "
            "follow a law of brightness that took the place of the stated ones; give their flux (flux=, in tables a "
            "column flux or mag)",
            AssumptionWarning,
        )


def response(view, q):
    """How coefficients move corrected positions, up to the sign, (n, 2, 2 n_modes), and pixels, (n, 2, 2).

    `q` (n, 2) are undistorted pixels of an exposure, of its focal plane if it has one.
    """
    common, degree = view.common, view.solution.degree
    back = np.linalg.inv(common.distortion.jacobian(q) @ common.pose[:, :2])
    b = basis.values(degree, *basis.normalize(q, common.shape))
    return np.einsum("nac,mn->nacm", back, b).reshape(len(q), 2, 2 * len(b)), back


def covariances(view, q, measured, moved=None):
    """Relative and absolute covariance (n, 2, 2) of positions corrected to undistorted pixels q (n, 2) of an exposure.

    `measured` (n, 2, 2) is the covariance in its pixels, those of the focal plane if it has one, with the errors that
    were found; a `Movement` carries the positions to another time. Of a camera with errors they have those too: of the
    detector of the view, or of that on which each position falls.
    """
    solution, i = view.solution, view.index
    gauge, uncertainty, positions = solution.gauge, solution.estimate.uncertainty, solution.estimate.positions
    by_modes, back = response(view, q)
    table = solution.estimate.table_errors.get(view.name)
    noise = carried(back, measured) + (0 if table is not None else by_camera(view, q, by_modes, back))
    # a random field and the distortion are known together
    together = None if table is None else noise + carried(back, table(q))
    own = noise + carried(by_modes, absolute_errors.own_coefficients(gauge, uncertainty, i))
    own = own if together is None else together
    if gauge.plane is not None:
        return own, np.full_like(own, np.nan)
    xy = similarity.apply(similarity.invert(solution.poses[view.name]), q)
    hidden = gauge.absolute_covariance
    plain = absolute_errors.plain_directions(gauge, xy, len(hidden) // 2)
    relative = noise + carried(by_modes, absolute_errors.relative_coefficients(gauge, uncertainty, i))
    directions = plain
    if len(hidden) == 2 * gauge.n_modes:
        directions = by_modes @ widened(gauge.motion[i], solution.degree)
        relative = relative + carried(directions - plain @ _taken_off(gauge, uncertainty, positions), hidden)
    relative = relative if together is None else together
    if gauge.drift is not None and len(hidden) == 2 * gauge.n_modes:  # at the time of this exposure
        directions, hidden = by_modes @ widened(gauge.all_motion[i], solution.degree), gauge.joint_covariance
    if moved is not None:
        known, terms = (gauge, uncertainty), (moved.rows, slice(2, None), slice(2, None))
        relative = relative + carried(moved.columns, absolute_errors.relative_blocks(*known, positions)[terms])
        own = own + carried(moved.columns, absolute_errors.own_blocks(*known)[terms])
        directions = directions + moved.columns @ uncertainty.drift_directions[terms[:2]]
    absolute = own + carried(directions, hidden)
    if uncertainty.camera:
        f = view.common.distortion(q)
        absolute[uncertainty.camera.lost(solution.camera, f, view.detector)] = np.nan
    for each in gauge.unknown:
        moved = by_modes @ widened(each.coefficients[i].reshape(-1, 1), solution.degree)
        absolute[np.sum(moved**2, axis=(1, 2)) > np.trace(absolute, axis1=1, axis2=2)] = np.nan
    return relative, absolute


def _taken_off(gauge, uncertainty, positions):
    """The modes (2 n, 2 n) of a map that a fit to the stars takes off each of the gauge's directions."""
    good = np.isfinite(positions[:, 0])
    plain, directions = absolute_errors.plain_directions(gauge, positions[good], gauge.n_modes), gauge.directions[good]
    common = uncertainty.common
    weights = np.broadcast_to(np.eye(2), (len(plain), 2, 2)) if common is None else common.weights[good][:, :2, :2]
    return common_maps.fitted(plain, weights, directions)


def relative_errors(view, q):
    """Relative covariance (n, 2, 2) of the correction of positions q (n, 2) of an exposure."""
    by_modes, back = response(view, q)
    table = view.solution.estimate.table_errors.get(view.name)
    if table is not None:
        return carried(back, table(q))
    own = absolute_errors.relative_coefficients(view.solution.gauge, view.solution.estimate.uncertainty, view.index)
    return carried(by_modes, own) + by_camera(view, q, by_modes, back)


def by_camera(view, q, by_modes, back):
    """Covariance (n, 2, 2) of corrected positions by the errors of what exposures have in common, such as a camera.

    Its own, and what the coefficients make of them. Zero without.
    """
    errors = view.solution.estimate.uncertainty.camera
    if errors is None:
        return np.zeros((len(q), 2, 2))
    seen = errors.of_measured(view, q)
    through = back @ seen - by_modes @ errors.coefficients[view.index]
    return through @ through.mT


def carried(through, covariance):
    """Covariance (n, 2, 2) of what follows linearly, by (n, 2, k) or (2, k), from a covariance (k, k) or (n, k, k)."""
    return through @ covariance @ np.swapaxes(through, -1, -2)


def widened(changes, degree):
    """Changes (2 n, k) of coefficients of a lower degree as those of all modes fitted, (2 n_modes, k)."""
    by_mode = np.moveaxis(changes.reshape(2, len(changes) // 2, -1), 1, 2)
    return np.moveaxis(basis.change_degree(by_mode, degree), 1, 2).reshape(-1, changes.shape[1])


def widened_all(motion, degree):
    """Maps of all exposures (n_exposures, 2 n, k) on all modes fitted, (n_exposures, 2 n_modes, k); see `widened`."""
    return np.stack([widened(each, degree) for each in motion])


def correct_table(solution, table, epoch=None):
    """`Solution.correct_table`; see there."""
    table = column_contract.check(*_with_law(solution.diagnostics.error_law, table))
    camera = solution.camera
    table = camera.in_focal_plane(with_ids_of(table, camera.detectors) if camera.has_focal_plane else table)
    if epoch is not None:
        fitted(solution.estimate.motions)
    if epoch is not None and "star" not in table.colnames:
        raise InputError(
            "the table of positions lacks the column star: it is the motion of its star that carries a position to "
            "another time"
        )
    pixels = np.column_stack([table["x"].to_value(u.pix), table["y"].to_value(u.pix)])
    _warn_of_no_flux(solution, table["flux"] if "flux" in table.colnames else None, len(table))
    xy, relative, absolute = np.empty_like(pixels), *np.empty((2, len(table), 2, 2))
    off = np.zeros(len(table), dtype=bool)
    for view, rows in _parts(solution, table):
        stars = None if epoch is None else table["star"][rows]
        moved = movement(solution, view.name, stars, epoch, len(rows))
        measured = solution.diagnostics.errors_of(table[rows], axes=_axes(view))
        xy[rows], relative[rows], absolute[rows] = _with_errors(view, pixels[rows], measured, moved)
        off[rows] = _is_off(view, table[rows])
    _warn_of_extrapolation(table, np.flatnonzero(off))
    out = table.copy()
    if "star" not in out.colnames:
        out["star"] = _stars_of(solution, table, pixels)
    out["x"], out["y"] = xy.T * u.pix
    out["x_err_abs"], out["y_err_abs"] = np.sqrt(np.einsum("nkk->kn", absolute)) * u.pix
    column_contract.set_covariance(out, relative)
    if solution.sky is not None:
        add_sky(out, solution.sky, xy, absolute_errors.variances(relative), absolute_errors.variances(absolute))
    if epoch is not None:
        out.meta["epoch"] = year(epoch)
    return column_contract.describe_stars(out)


def _with_law(law, table):
    """What `column_contract.check` takes of a table of positions: those without an error get that of a law, if any."""
    what, advice = "the table of positions", column_contract.GIVE_ERRORS
    table = column_contract.as_table(table, what)
    flux = None if law is None else column_contract.fluxes(table)
    if law is not None and flux is None:
        advice += ", or a column flux or mag: errors of the solution follow a law of brightness"
    if flux is not None and "exposure" in table.colnames:
        table, known = table.copy(), law.knows(flux)
        sigma = law.sigma(np.where(known, flux, 1.0), column_contract.labels(table, "exposure"))
        for name in ("x_err", "y_err"):
            given = (
                column_contract.values(table, name, u.pix) if name in table.colnames else np.full(len(table), np.nan)
            )
            table[name] = np.where(known & ~(np.isfinite(given) & (given > 0)), sigma, given) * u.pix
    return table, column_contract.DETECTED, what, advice


def _stars_of(solution, table, pixels):
    """Star of the solution that has the same position of the same exposure, (n,); -1, or an empty text, for none."""
    known, names = solution.residuals, np.array(solution.names)

    def points(exposures, xy):  # exposures are far apart in one more dimension
        order = np.argsort(names)
        number = order[np.searchsorted(names[order], np.asarray(exposures).astype(str))]
        return np.column_stack([number * _APART, xy])

    seen = points(known["exposure"], np.column_stack([known[name].to_value(u.pix) for name in "xy"]))
    distance, row = cKDTree(seen).query(points(table["exposure"], pixels), distance_upper_bound=_SAME)
    star, found = np.asarray(known["star"]), np.isfinite(distance)
    out = np.full(len(found), "" if star.dtype.kind == "U" else -1, dtype=star.dtype)
    out[found] = star[row[found]]
    return out


def _parts(solution, table):
    """Views and the rows of a table that are of them."""
    exposures = np.asarray(table["exposure"]).astype(str)
    for name in dict.fromkeys(exposures.tolist()):
        rows = np.flatnonzero(exposures == name)
        view = _of_exposure(solution, name)
        if not solution.camera.has_focal_plane:
            yield view, rows
            continue
        detector = solution.camera.ids(table[rows])
        yield from ((solution[name, key], rows[detector == key]) for key in dict.fromkeys(detector.tolist()))


def _of_exposure(solution, name):
    """The view of an exposure; of another one the message says what corrects its positions."""
    try:
        return solution[name]
    except InputError as error:
        several = solution.camera.has_focal_plane
        by = f"its file by legdistort {'camera' if several else 'nights'} SOLUTION --out camera.asdf, then legdistort "
        by += "correct camera.asdf LIST" + " (in Python solution.camera.correct_table(list))" * several
        raise InputError(
            f"{error}; positions of other exposures are corrected for the static distortion alone, by a camera: {by}"
        ) from None


def _is_off(view, rows):
    """Which positions lie off the detector of a view, bool (n,)."""
    x, y = (rows[name if view.chip is None else f"{name}_detector"].to_value(u.pix) for name in "xy")
    ny, nx = view.shape
    return (x < -0.5) | (y < -0.5) | (x > nx - 0.5) | (y > ny - 0.5)


def _warn_of_extrapolation(table, rows):
    """Warn of positions, rows of a table, that lie off their detector."""
    if not len(rows):
        return
    at = ("x_detector", "y_detector") if "x_detector" in table.colnames else ("x", "y")
    x, y = (table[name].to_value(u.pix) for name in at)
    named = [f"row {k}, ({x[k]:.0f}, {y[k]:.0f}) in {table['exposure'][k]}" for k in rows]
    warn(
        f"{len(rows)} of {len(table)} positions lie off their detector, where the correction is extrapolated: "
        f"{some_of(named, _MOST_NAMED)}",
        AssumptionWarning,
    )


def add_sky(table, sky, xy, relative, absolute):
    """Add the columns on the sky, named as in the Gaia catalogue, of positions (n, 2) with their variances (3, n)."""
    places = sky.to_sky(xy)
    table["ra"], table["dec"] = u.Quantity(places.ra, subok=False), u.Quantity(places.dec, subok=False)
    table["ra_error"], table["dec_error"], table["ra_dec_corr"] = sky.to_sky_errors(xy, relative)
    table["ra_error_abs"], table["dec_error_abs"], _ = sky.to_sky_errors(xy, absolute)
