"""The two error criteria of the paper (section 3.4), as measured and as expected from the covariances.

*b* is the error of the reference positions, *sigma* the scatter of corrected positions over the exposures.
All figures are rms *per axis*, ``sqrt((x^2 + y^2) / 2)``, so that they compare with the errors of positions. The
paper's equations, which sum both axes, give the *total*, sqrt(2) times as much: see `total`. (The figures that
it quotes for its simulations are per axis all the same: its slopes tend to 1, not to sqrt(2).)
"""

import math

import numpy as np

from ..exceptions import InputError
from ..geometry import basis, similarity
from .errors.absolute_errors import map_directions
from .errors.coefficient_covariance import exposure_blocks, times
from .errors.star_covariance import star_matrix
from .estimate import StoredUncertainty

#: Numbers held at once while expected scatters are computed.
_BLOCK = 2**24
#: Positions of which the responses to all errors are made at once.
_AT_ONCE = 500


def total(per_axis):
    """A criterion of both axes together, as the paper's equations write it, from one per axis: sqrt(2) times."""
    return np.sqrt(2) * np.asarray(per_axis)


def bias(estimated, true, *, removed=None):
    """Error b of reference positions, rms per axis (first criterion of the paper, section 3.4).

    ``b = sqrt(1/N_star sum_j |b_j|^2)`` with ``b_j`` of `bias_by_star`, over sqrt(2).

    Parameters
    ----------
    estimated, true : array_like, shape (n_stars, 2)
    removed : None, "similarity" or int
        What is fitted to the differences and taken out first: nothing; shift, rotation and scale; or a
        polynomial map of this total degree (what is left is free of the gauge).

    Returns
    -------
    float
        Pixels.
    """
    return float(np.sqrt(np.nanmean(bias_by_star(estimated, true, removed=removed) ** 2)))


def bias_by_star(estimated, true, *, removed=None):
    """Error ``b_j = X_est_j - X_ref_j`` of every reference position, x and y (paper, section 3.4).

    Parameters are those of `bias`.

    Returns
    -------
    ndarray, shape (n_stars, 2)
        Pixels; NaN for a star that was not estimated.
    """
    estimated, true = np.asarray(estimated, float), np.asarray(true, float)
    good = np.isfinite(estimated).all(axis=1)
    difference = (estimated - true)[good].T.ravel()
    columns = _columns(true[good], removed)
    out = np.full(estimated.shape, np.nan)
    out[good] = (difference - columns @ (columns.T @ difference)).reshape(2, -1).T
    return out


def known_offsets(solution, xy):
    """Positions of the stars from elsewhere less those of a solution, without what the solution does not know.

    A similarity of the plane, unless a reference has tied it, and the directions of `Gauge.unknown` are fitted and
    taken off, so that what is left compares with ``x_err_known``, ``y_err_known``. They are followed to second order: a
    solution that is wrong by g pixels along them is off by g times the gradient of g across them, which the directions
    at the solution, ``gauge.unknown`` by itself, leave behind.

    Parameters
    ----------
    solution : Solution
        As returned by `legdistort.solve`.
    xy : array_like, shape (n_stars, 2)
        Pixels of the reference plane; NaN for a star that is not there.

    Returns
    -------
    ndarray, shape (n_stars, 2)

    Raises
    ------
    InputError
        If the solution was read from a file and has unknown directions, or too few stars are given.
    """
    xy, unknown = np.asarray(xy, dtype=float), solution.gauge.unknown
    good = _compared(solution, xy)
    similar = np.zeros((2 * good.sum(), 0))
    if solution.gauge.tie is None:
        similar = _of_fields(solution.gauge.plane_modes().fields_of(solution.estimate.positions[good]), xy[good])
    stars = np.stack([each.stars for each in unknown], axis=2) if unknown else np.zeros((*xy.shape, 0))
    moves = [each.coefficients for each in unknown]
    return _without_directions(solution, xy, similar, stars, moves, "unknown_at")


def relative_offsets(solution, xy):
    """Positions of the stars from elsewhere less those of a solution, without common maps that exposures compensate.

    What is left compares with the covariance of relative positions. `Gauge.directions`, the directions at the solution,
    are followed to second order, as for `known_offsets`.

    Parameters and errors are those of `known_offsets`.

    Returns
    -------
    ndarray, shape (n_stars, 2)
    """
    xy, gauge = np.asarray(xy, dtype=float), solution.gauge
    moves = -gauge.motion.reshape(len(gauge.motion), 2, gauge.n_own, -1)
    similar = np.zeros((2 * _compared(solution, xy).sum(), 0))
    return _without_directions(solution, xy, similar, gauge.directions, np.moveaxis(moves, -1, 0), "directions_at")


def _of_fields(field, xy):
    """Orthonormal displacement fields (2 n, 4 n_fields) of similarities at positions (n, 2) of some fields (n,)."""
    out = []
    for number in np.unique(field):
        mine = np.tile(field == number, 2)
        out.append(np.zeros((len(mine), 4)))
        out[-1][mine] = _columns(xy[field == number], "similarity")
    return np.hstack(out)


def _compared(solution, xy):
    """Stars (n,) that have a position in both."""
    if xy.shape != solution.estimate.positions.shape:
        raise InputError(
            f"xy must have one row for each of the {len(solution.estimate.positions)} stars, got shape {xy.shape}"
        )
    if not (good := np.isfinite(xy - solution.estimate.positions).all(axis=1)).any():
        raise InputError("xy has a position of none of the stars that have one in the solution: give more of them")
    return good


def _without_directions(solution, xy, similar, stars, moves, there):
    """Offsets (n_stars, 2) without displacements `similar` (2 n, k) of stars that count, and without directions.

    The latter move the stars by `stars` (n_stars, 2, m) and the coefficients by `moves`, m of shape
    (n_exposures, 2, n_modes); where the solution has moved to, `there` of the uncertainty knows them.
    """
    good, m = np.tile(_compared(solution, xy), 2), stars.shape[2]
    if np.count_nonzero(good) <= similar.shape[1] + m:
        raise InputError(
            f"{similar.shape[1] + m} directions cannot be taken off the offsets of {good.sum() // 2} stars"
        )
    if m and not hasattr(type(solution.estimate.uncertainty), there):
        raise InputError("a solution read from a file keeps no equations; call solve again")
    values = (xy - solution.estimate.positions).T.ravel()[good]
    here = stars.transpose(1, 0, 2).reshape(2 * len(xy), m)
    design = np.hstack([similar, here[good]])
    amounts = np.linalg.lstsq(design, values, rcond=None)[0]
    if m:  # the mean of the directions at both ends is exact to second order
        coefficients = solution.coefficients.copy()
        for amount, move in zip(amounts[-m:], moves, strict=True):
            coefficients[:, :, : move.shape[2]] += amount * move
        positions = np.nan_to_num(solution.estimate.positions) + np.nan_to_num(stars) @ amounts[-m:]
        poses = np.stack([solution.poses[name] for name in solution.names])
        moved = getattr(solution.estimate.uncertainty, there)(positions, coefficients, poses)
        design = np.hstack([similar, (here + moved)[good] / 2])
        amounts = np.linalg.lstsq(design, values, rcond=None)[0]
    out = np.full(xy.shape, np.nan)
    out.T.flat[good] = values - design @ amounts
    return out


def expected_bias(solution, *, removed=None, absolute=False):
    """What `bias` should be, from the covariance of the solution.

    Parameters
    ----------
    solution : Solution
        As returned by `legdistort.solve`, or read.
    removed : None, "similarity" or int
        As for `bias`. With the fitted degree this is the Cramer-Rao bound of the gauge-free error.
    absolute : bool
        Add what the gauge hides (mean dynamic distortion, static uncertainty).

    Returns
    -------
    float
        Pixels, rms per axis.

    Raises
    ------
    InputError
        With `removed`, for a solution that was read if covariances between its stars do not follow from its residuals
        (robust losses, motions, references, correlated errors).
    """
    good = np.isfinite(solution.estimate.positions).all(axis=1)
    xy = solution.estimate.positions[good]
    if removed is None:  # each star by itself: the covariances between stars, a large matrix, are not needed
        blocks = solution.absolute_covariance(without_unknown=True) if absolute else None
        variance = (
            solution.estimate.uncertainty.stars[:2, good] if blocks is None else np.einsum("nkk->kn", blocks)[:, good]
        )
        return float(np.sqrt(np.mean(variance)))
    stored = isinstance(solution.estimate.uncertainty, StoredUncertainty)
    between = star_matrix(solution) if stored else solution.estimate.uncertainty.star_matrix
    covariance = between[np.ix_(np.tile(good, 2), np.tile(good, 2))]
    if absolute:
        hidden = solution.gauge.absolute_covariance
        moved = map_directions(solution.gauge, solution.estimate.positions)[good]
        moved = moved.transpose(1, 0, 2).reshape(2 * len(xy), -1)
        covariance = covariance + moved @ hidden @ moved.T
    columns = _columns(xy, removed)
    left = np.trace(covariance) - np.trace(columns.T @ covariance @ columns)
    return float(np.sqrt(left / len(covariance)))


def _columns(xy, removed):
    """Orthonormal displacement fields (2 n, k) at positions (n, 2), x first, of what is to be removed."""
    n = len(xy)
    if removed is None:
        return np.zeros((2 * n, 0))
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = (2 * (xy - low) / (high - low) - 1).T
    if removed == "similarity":
        x, y = (xy - xy.mean(axis=0)).T
        one, zero = np.ones(n), np.zeros(n)
        fields = [[one, zero], [zero, one], [x, y], [-y, x]]
        columns = np.array([np.concatenate(f) for f in fields]).T
    else:
        degree = basis.check_degree(removed, "removed")
        columns = np.kron(np.eye(2), basis.values(degree, x, y)).T
    return np.linalg.qr(columns)[0]


def scatter(corrected):
    """Scatter sigma_j of corrected positions, rms per axis (second criterion of the paper, section 3.4).

    ``sigma_j = sqrt(1/N_im sum_i |X_corr_ij - avg_i(X_corr_ij)|^2)``, over sqrt(2). The criterion of a whole field is
    their rms, ``sigma = sqrt(1/N_grid sum_j' sigma_j'^2)``, over new stars on a grid: `new_scatter`.

    Parameters
    ----------
    corrected : array_like, shape (n_exposures, n_stars, 2)
        NaN where a star is not seen.

    Returns
    -------
    ndarray, shape (n_stars,)
        With 1/n_im as in the paper; NaN for a star seen less than twice.
    """
    corrected = np.asarray(corrected, float)
    seen = np.isfinite(corrected).all(axis=2)
    n = seen.sum(axis=0)
    filled = np.where(seen[..., None], corrected, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = filled.sum(axis=0) / n[:, None]
        variance = (np.where(seen[..., None], corrected - mean, 0) ** 2).sum(axis=(0, 2)) / (2 * n)
    return np.sqrt(np.where(n > 1, variance, np.nan))


def corrected_positions(solution):
    """Corrected positions (n_exposures, n_stars, 2) of the fitted stars (section 3.3), NaN where not used.

    And for an exposure whose map cannot be inverted. Those of stars whose motions were fitted are carried to the epoch
    of the solution.
    """
    table = solution.residuals
    out = np.full((len(solution.names), len(solution.estimate.star_names), 2), np.nan)
    for i, name in enumerate(solution.names):
        if solution[name].fold:
            continue
        rows = table[(table["exposure"] == name) & table["used"]]
        xy = np.column_stack([rows["x"].value, rows["y"].value])
        out[i, np.searchsorted(solution.estimate.star_names, rows["star"])] = solution[name].to_reference(xy)
        if solution.estimate.motions is not None:
            out[i] -= solution.estimate.motions.displacement(solution.estimate.motions.years[i], solution.sky)
    return out


def new_scatter(solution, distort, xy, sigma, *, seen=None, rng=None):
    """Scatter sigma_j' of new stars that the solution has not seen, measured in a simulation, rms per axis.

    Each is put at its true pixels, given an error, and corrected with the solution (paper, section 3.4: the
    criterion "generalised to stars that are not used in the resolution"). Over a grid it is the paper's Figure
    "ergrid"; its rms is sigma_grid, that over the stars `in_contour` sigma_contour.

    Parameters
    ----------
    solution : Solution
    distort : callable
        ``distort(name, xy)``: true pixels of reference positions, such as `legdistort.simulation.truth.Truth.distort`.
    xy : array_like, shape (n, 2)
        True reference positions, for example ``truth.grid(name, 150)``.
    sigma : float
        Error of one measured position, pixels per axis; 0 leaves the errors of the correction alone.
    seen : array_like of bool, shape (n_exposures, n), optional
        In which exposures a star is measured; by default in all.
    rng : `~numpy.random.Generator`, optional
        Of the errors.

    Returns
    -------
    ndarray, shape (n,)
        Pixels; NaN for a star seen less than twice.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    xy = np.asarray(xy, dtype=float)
    corrected = np.full((len(solution.names), len(xy), 2), np.nan)
    for i, name in enumerate(solution.names):
        on = slice(None) if seen is None else np.flatnonzero(np.asarray(seen)[i])
        measured = np.array(distort(name, xy[on]))
        if sigma:
            measured += sigma * rng.standard_normal(measured.shape)
        corrected[i, on] = solution[name].to_reference(measured)
    return scatter(corrected)


def contour(stars, *, fraction=0.9):
    """The square that holds most stars, inside which the paper (section 4.1) averages sigma.

    The paper does not state how it was chosen. Here it is centred between the outermost stars.

    Parameters
    ----------
    stars : array_like, shape (n, 2)
        Positions of the stars that were fitted.
    fraction : float
        How many of them lie inside.

    Returns
    -------
    ndarray, shape (2, 2)
        Lower and upper corner.
    """
    stars = np.asarray(stars, dtype=float)
    middle = (stars.min(axis=0) + stars.max(axis=0)) / 2
    half = np.quantile(np.abs(stars - middle).max(axis=1), fraction)
    return np.stack([middle - half, middle + half])


def in_contour(xy, square):
    """Whether positions (n, 2) lie inside a square (2, 2) of `contour`."""
    return ((xy >= square[0]) & (xy <= square[1])).all(axis=-1)


def scatter_summary(solution):
    """Mean and standard deviation of sigma_j over the stars of a solution (paper, section 5.3.1).

    Returns
    -------
    dict
        ``n_stars``; ``mean``, ``std``: per axis, pixels; ``mean_total``, ``std_total``: both axes together.
    """
    sigma = scatter(corrected_positions(solution))
    sigma = sigma[np.isfinite(sigma)]
    mean, std = float(np.mean(sigma)), float(np.std(sigma))
    both = {"mean_total": float(total(mean)), "std_total": float(total(std))}
    return {"n_stars": len(sigma), "mean": mean, "std": std, **both}


def sizes(solution):
    """Rms length over the detector of each distortion and of its dynamic part, without the constant mode, pixels.

    The basis is orthonormal on a square of area 4: the mean square is the sum of squared coefficients over 4.
    """
    return [rms_length(part) for part in (solution.coefficients, departures(solution))]


def departures(solution):
    """Dynamic parts (n_exposures, 2, n_modes): from the static distortion, without one from the median exposure.

    The median: one night that is odd is not in what all others depart from.
    """
    static = solution.estimate.prior_mean
    return solution.coefficients - (static if np.any(static) else np.median(solution.coefficients, axis=0))


def rms_length(coefficients):
    """Rms length (...) over the detector of displacements (..., 2, n_modes) without the constant mode, pixels."""
    return np.sqrt(np.sum(coefficients[..., 1:] ** 2, axis=(-2, -1))) / 2


def expected_scatter(solution, xy, sigma, *, seen=None, covariance=None):
    """What `scatter` should be for new positions that the solution has not seen, from its Fisher matrix.

    Parameters
    ----------
    solution : Solution
    xy : array_like, shape (n, 2)
        Reference positions.
    sigma : float or array_like, shape (n_exposures, n)
        Error of one detector position, pixels per axis.
    seen : array_like of bool, shape (n_exposures, n), optional
        In which exposures a position is measured; by default those on whose detector it falls.
    covariance : ndarray or callable, optional
        Of the errors of the coefficients, of this or a higher degree, shape (n_exposures * 2 n_modes,) squared or
        (n_exposures, 2 n_modes, 2 n_modes); by default that of the solution. Or, with ``covariance(i, q)``, of what is
        measured in exposure i at undistorted pixels q (k, 2): covariance (k, 2, 2) of what is its alone, and responses
        (k, 2, r) to independent errors of unit size that all exposures share.

    Returns
    -------
    ndarray, shape (n,)
        Rms per axis; NaN where fewer than two exposures see the position.
    """
    xy = np.asarray(xy, dtype=float)
    covariance = solution.estimate.uncertainty.coefficients if covariance is None else covariance
    sigma = np.broadcast_to(sigma, (len(solution.names), len(xy)))
    if callable(covariance):
        step = _AT_ONCE
    else:
        step = max(1, _BLOCK // (2 * math.prod(exposure_blocks(covariance, len(sigma)).shape[:2])))
    parts = [
        _expected_variance(
            solution, xy[part], sigma[:, part], None if seen is None else np.asarray(seen)[:, part], covariance
        )
        for part in (slice(k, k + step) for k in range(0, len(xy), step))
    ]
    return np.sqrt(np.concatenate([*parts, np.zeros(0)]))


def _expected_variance(solution, xy, sigma, seen, covariance):
    """Square of `expected_scatter` for as many positions as fit in memory."""
    places, noise, n = [], np.zeros(len(xy)), np.zeros(len(xy), dtype=int)
    for i, name in enumerate(solution.names):
        distortion, pose = solution[name].distortion, solution.poses[name]
        ny, nx = solution.estimate.shapes[name]
        q = similarity.apply(pose, xy)
        if seen is None:
            on = (np.abs(distortion(q) - [(nx - 1) / 2, (ny - 1) / 2]) <= [nx / 2, ny / 2]).all(axis=1)
        else:
            on = seen[i]
        back = np.linalg.inv(distortion.jacobian(q[on]) @ pose[:, :2])
        places.append((on, q[on], back))
        noise[on] += sigma[i, on] ** 2 * (back**2).sum(axis=(1, 2))
        n[on] += 1
    by = _by_responses if callable(covariance) else _by_coefficients
    own, together = by(solution, places, covariance, len(xy))
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = (own + noise - (together + noise) / n) / (2 * n)
    return np.where(n > 1, np.maximum(variance, 0), np.nan)


def _by_coefficients(solution, places, covariance, n):
    """Variance (n,) of n positions by errors of coefficients, summed over exposures, and that of their sum."""
    blocks = exposure_blocks(covariance, len(places))
    size = blocks.shape[1]
    degree = basis.degree_of(size // 2)
    rows, own = np.zeros((len(places), n, 2, size)), np.zeros(n)
    for i, ((on, q, back), name) in enumerate(zip(places, solution.names, strict=True)):
        b = basis.values(degree, *basis.normalize(q, solution.estimate.shapes[name]))
        rows[i, on] = mine = np.einsum("kac,mk->kacm", back, b).reshape(len(b.T), 2, size)
        own[on] += (mine @ blocks[i] * mine).sum(axis=(1, 2))
    flat = rows.transpose(1, 2, 0, 3).reshape(2 * n, -1)
    return own, (times(covariance, flat.T).T * flat).sum(axis=1).reshape(-1, 2).sum(axis=1)


def _by_responses(_, places, errors, n):
    """The same by what ``errors(i, q)`` gives of what is measured."""
    alone, own, shared = np.zeros(n), np.zeros(n), None
    for i, (on, q, back) in enumerate(places):
        if not len(q):
            continue
        covariance, moved = errors(i, q)
        moved = back @ moved
        shared = np.zeros((n, *moved.shape[1:])) if shared is None else shared
        shared[on] += moved
        alone[on] += np.einsum("kab,kbc,kac->k", back, covariance, back)
        own[on] += (moved**2).sum(axis=(1, 2))
    return own + alone, alone + (0 if shared is None else (shared**2).sum(axis=(1, 2)))
