"""Stars that are kept out of the fit: they choose the degree, and test the errors.

A star that is left out says what a fit is worth: corrected with distortions that it had no part in, its positions
scatter by their errors, plus what is wrong with the distortions. A degree too low leaves distortion in them, one too
high follows the noise of the others.
"""

import logging
from numbers import Real

import numpy as np
from astropy import units as u

from ...exceptions import InputError, LegdistortError
from ...geometry import basis, similarity
from ...inputs.matches import Matches
from ...results import accuracy

log = logging.getLogger(__name__)

#: As `degree` of `solve`: to be chosen.
AUTO = "auto"
#: Highest degree that is tried.
HIGHEST = 6
#: Parts into which stars are divided; each is left out once. So few stars are left out one by one.
N_FOLDS, FEW = 10, 30
#: No further degree is tried when so many in a row are no better than one before.
N_WORSE = 3
#: Of degrees whose scores differ by less than this part the lowest is taken.
TIE = 0.005
#: Excess of a degree's energy over its noise, in standard deviations of the latter, that raises the alarm.
ALARM = 5.0
_OUTLIER = 25.0  # times the usual squared scatter of a star, at every degree: mismatched, it has no say


def check_validate(fraction):
    """Raise `InputError` if the fraction of stars to be kept out is not between 0 and 0.5, or None."""
    real = isinstance(fraction, Real) and not isinstance(fraction, bool)
    if fraction is not None and not (real and 0 < fraction < 0.5):
        raise InputError(f"validate must be a fraction of the stars between 0 and 0.5, got {fraction!r}")


def check_degree(degree):
    """Raise `InputError` unless the degree is one, or "auto"."""
    if isinstance(degree, str):
        if degree != AUTO:
            raise InputError(f"degree must be an integer or {AUTO!r}, got {degree!r}")
    else:
        basis.check_degree(degree)


# -- stars kept out


def hold_out(matches, fraction, *, seed=0):
    """Two sets of matches: without, and of, a fraction of the stars that two exposures or more see.

    Parameters
    ----------
    matches : Matches
    fraction : float
    seed : int
        Of the choice.

    Returns
    -------
    Matches
    `~astropy.table.QTable`
        The rows kept out.

    Raises
    ------
    InputError
        If an exposure has no other stars.
    """
    seen = np.flatnonzero(np.bincount(matches.observations.star) > 1)
    if len(seen) < 2:
        raise InputError(f"validate keeps out stars that two exposures or more see; there are {len(seen)} of them")
    n = max(1, round(fraction * len(seen)))
    out = np.isin(matches.observations.star, np.random.default_rng(seed).permutation(seen)[:n])
    return _only(matches, ~out), matches.table[out]


def _only(matches, rows):
    """The same matches with some rows of the table."""
    kept = Matches.from_table(
        matches.table[rows], shape=matches.shapes, poses=matches.poses, sky=matches.sky, left_out=matches.left_out
    )
    lost = [name for name in matches.names if name not in kept.names]
    if lost:
        raise InputError(
            f"no star is left in exposure {lost[0]}, others are kept out; give more stars, or leave it out"
        )
    return kept


def corrected(solution, table):
    """Corrected positions of stars that a solution has not seen, with their errors.

    Returns
    -------
    xy : ndarray, shape (n_exposures, n_stars, 2)
        Reference-plane pixels; NaN where a star is not seen.
    sigma : ndarray, shape (n_exposures, n_stars)
        Error of the measured position, rms of the axes, pixels; the floor and scale of the solution included.
    """
    stars, star = np.unique(table["star"], return_inverse=True)
    xy = np.full((len(solution.names), len(stars), 2), np.nan)
    sigma = np.full(xy.shape[:2], np.nan)
    measured = np.column_stack([table["x"].to_value(u.pix), table["y"].to_value(u.pix)])
    error = np.sqrt((table["x_err"].to_value(u.pix) ** 2 + table["y_err"].to_value(u.pix) ** 2) / 2)
    floor, scale = (solution.settings.get(key, default) for key, default in (("error_floor", 0), ("error_scale", 1)))
    for i, name in enumerate(solution.names):
        rows = np.flatnonzero(table["exposure"] == name)
        xy[i, star[rows]] = solution.correct(name, measured[rows])
        sigma[i, star[rows]] = scale * np.hypot(error[rows], floor)
    return xy, sigma


def validation(solution, table, fraction):
    """How stars that a solution has not seen scatter, and how they should.

    With ``settings["clip"]`` single positions that deviate by more, as mismatches do, are left out here too.

    Parameters
    ----------
    solution : Solution
    table : `~astropy.table.QTable`
        Their rows.
    fraction : float
        As it was asked for.

    Returns
    -------
    dict
        ``fraction``, ``n_stars``, ``n_observations``, ``n_clipped``; ``scatter`` and ``expected``, rms over the stars,
        per axis, pixels (paper, section 3.4, second criterion); ``ratio`` of the two.
    """
    xy, sigma = corrected(solution, table)
    seen = np.isfinite(xy[:, :, 0])
    n_given = np.count_nonzero(seen)
    expected = _expected(solution, xy, sigma, seen)
    if solution.settings.get("clip") is not None:
        off = (
            np.sqrt(((xy - np.nanmedian(np.where(seen.any(axis=0)[:, None], xy, 0), axis=0)) ** 2).sum(axis=2))
            / expected
        )
        usual = np.nanmedian(off) / np.sqrt(2 * np.log(2))
        xy[off > solution.settings["clip"] * max(1.0, usual)] = np.nan
        seen = np.isfinite(xy[:, :, 0])
        expected = _expected(solution, xy, sigma, seen)
    scatter = accuracy.scatter(xy)
    good = np.isfinite(scatter) & np.isfinite(expected)
    if not good.any():
        raise InputError("no star that was kept out is left in two exposures; give a larger fraction for validate")
    scatter, expected = (float(np.sqrt(np.mean(a[good] ** 2))) for a in (scatter, expected))
    return {
        "fraction": float(fraction),
        "n_stars": int(good.sum()),
        "n_observations": int(np.count_nonzero(seen[:, good])),
        "n_clipped": int(n_given - np.count_nonzero(seen)),
        "scatter": scatter,
        "expected": expected,
        "ratio": scatter / expected,
    }


def _expected(solution, xy, sigma, seen):
    """Expected scatter of every star (n_stars,), NaN where fewer than two exposures see it."""
    n = np.maximum(seen.sum(axis=0), 1)[:, None]
    place = np.where(seen[..., None], xy, 0).sum(axis=0) / n
    return accuracy.expected_scatter(solution, place, np.where(seen, sigma, 1), seen=seen)


# -- the degree


def choose_degree(matches, fit):
    """The degree from 0 to 6 whose distortions serve stars best that had no part in them.

    Parameters
    ----------
    matches : Matches
    fit : callable
        ``fit(matches, degree)``, a `Solution`.

    Returns
    -------
    dict
        ``degree``; ``degrees``, those that were tried: as many as the stars allow, until three in a row are no better;
        ``scores``, the squared scatter of stars kept out over that of their errors; ``n_folds``; ``aliasing``, see
        `folding`; ``alarm``; and all in a ``sentence``.

    Raises
    ------
    LegdistortError
        If not even degree 0 can be fitted.
    """
    folds = _folds(matches)
    degrees, squares = [], []
    for tried in range(HIGHEST + 1):
        try:
            squares.append(
                np.concatenate([_squares(fit(_only(matches, ~out), tried), matches.table[out]) for out in folds])
            )
        except LegdistortError as error:
            if tried == 0:
                raise
            log.debug("degree %d is beyond these stars: %s", tried, error)
            break
        degrees.append(tried)
        scores = _scores(np.array(squares))
        degree = int(np.argmax(scores <= (1 + TIE) * scores.min()))
        if tried - degree >= N_WORSE:
            break
    aliasing = _aliasing(matches, fit, degree)
    alarm = [a for a in aliasing if a["excess"] > ALARM]
    return {
        "degree": degree,
        "degrees": degrees,
        "scores": [float(score) for score in scores],
        "n_folds": len(folds),
        "aliasing": aliasing,
        "alarm": bool(alarm),
        "sentence": _sentence(degree, degrees, scores, aliasing),
    }


def _scores(squares):
    """Squared scatter over that of the errors by degree, from (degree, star, squares and degrees of freedom)."""
    seen = squares[0, :, 1] > 0
    least = (squares[:, :, 0] / np.maximum(squares[:, :, 1], 1)).min(axis=0)
    counts = seen & (least <= _OUTLIER * np.median(least[seen]))
    return squares[:, counts, 0].sum(axis=1) / squares[:, counts, 1].sum(axis=1)


def _folds(matches):
    """Rows (n,) of bool to be left out, in turn."""
    star = matches.observations.star
    seen = np.flatnonzero(np.bincount(star) > 1)
    if len(seen) < 2:
        raise InputError(f"degree={AUTO!r} needs stars that two exposures or more see; there are {len(seen)} of them")
    n = len(seen) if len(seen) <= FEW else N_FOLDS
    parts = np.array_split(np.random.default_rng(0).permutation(seen), n)
    return [np.isin(star, part) for part in parts]


def _squares(solution, table):
    """Squared scatter of every star over its errors, and its degrees of freedom, shape (n_stars, 2)."""
    xy, sigma = corrected(solution, table)
    weight = np.where(np.isfinite(xy[:, :, 0]), sigma**-2, 0.0)
    xy = np.where(np.isfinite(xy), xy, 0.0)
    total = weight.sum(axis=0)
    mean = (weight[..., None] * xy).sum(axis=0) / np.where(total > 0, total, 1)[:, None]
    squares = (weight * ((xy - mean) ** 2).sum(axis=2)).sum(axis=0)
    return np.column_stack([squares, 2 * np.maximum((weight > 0).sum(axis=0) - 1, 0)])


# -- the aliasing alarm


def _aliasing(matches, fit, degree):
    """`folding` for the two degrees beyond the one chosen, as far as the stars allow."""
    for top in (degree + 2, degree + 1):
        try:
            return [folding(fit(matches, top), degree, d) for d in range(degree + 1, top + 1)]
        except LegdistortError as error:
            log.debug("degree %d is beyond these stars: %s", top, error)
    return []


def folding(solution, degree, higher):
    """What modes of a higher degree do to a fit of a lower one (paper, section 4.3).

    The fit of the lower degree takes part of them for modes that it has: at the stars of an exposure they look alike.
    To first order these parts follow from a regression of the ones on the others at these stars.

    Parameters
    ----------
    solution : Solution
        Of a degree that includes `higher`.
    degree : int
        Of the fit that lacks them.
    higher : int

    Returns
    -------
    dict
        ``degree``, the higher one; ``found``, rms of its modes over the field, per axis, and ``noise``, what their
        errors explain of it, pixels; ``excess`` of the energy over that of noise, in standard deviations;
        ``energy``, rms beyond the noise; ``folds_into``, the same as it appears at degree 0, 1 ... ``degree``;
        ``mode`` and ``into``, the mode with most energy and the mode in which most of it appears, orders in x and y.
    """
    low, high = basis.n_modes(degree), slice(basis.n_modes(higher - 1), basis.n_modes(higher))
    departure = (solution.coefficients - solution.prior_mean)[:, :, high]
    covariance = _covariances(solution, high)
    variance = np.einsum("iaa->", covariance)
    flat = departure.reshape(len(departure), -1, 1)
    normal = float((flat * np.linalg.solve(covariance, flat)).sum())
    energy = np.sum(departure**2)
    beyond = np.sqrt(max(1 - variance / max(energy, 1e-300), 0))
    folded = np.stack(
        [_fold(solution, name, low, high) @ a.T for name, a in zip(solution.names, departure, strict=True)]
    )
    orders = np.array(basis.orders(higher)).T
    strongest = int(np.argmax((departure**2).sum(axis=(0, 1))))
    alone = np.mean([_fold(solution, name, low, high)[:, strongest] ** 2 for name in solution.names], axis=0)
    size = beyond * np.sqrt((folded**2).mean(axis=(0, 2)))  # per mode: rms over exposures and axes
    degrees = orders[:low].sum(axis=1)
    return {
        "degree": int(higher),
        "found": _rms(departure),
        "noise": float(_rms(departure) * np.sqrt(variance / max(energy, 1e-300))),
        "excess": (normal - departure.size) / np.sqrt(2 * departure.size),
        "energy": float(beyond * _rms(departure)),
        "folds_into": [float(np.sqrt(np.sum(size[degrees == d] ** 2)) / 2) for d in range(degree + 1)],
        "mode": orders[high][strongest].tolist(),
        "into": orders[int(np.argmax(alone))].tolist(),
    }


def _covariances(solution, high):
    """Covariance (n_exposures, 2 n, 2 n) of some modes of every exposure, x before y."""
    n, size = len(solution.names), 2 * basis.n_modes(solution.degree)
    blocks = solution.uncertainty.coefficients.reshape(n, size, n, size)[np.arange(n), :, np.arange(n)]
    rows = np.arange(size).reshape(2, -1)[:, high].ravel()
    return blocks[:, rows[:, None], rows]


def _fold(solution, name, low, high):
    """Regression (n_low, n_high) of higher modes on the lower ones at the stars of an exposure."""
    rows = solution.observations[(solution.observations["exposure"] == name) & solution.observations["used"]]
    star = np.searchsorted(solution.star_names, rows["star"])
    q = similarity.apply(solution.poses[name], solution.positions[star])
    b = basis.values(solution.degree, *basis.normalize(q, solution.shapes[name]))
    weight = 1 / np.hypot(rows["x_err"].to_value(u.pix), rows["y_err"].to_value(u.pix))
    return np.linalg.lstsq((b[:low] * weight).T, (b[high] * weight).T, rcond=None)[0]


def _rms(coefficients):
    """Rms over field, exposures and axes of (n_exposures, 2, n) coefficients, pixels."""
    return float(np.sqrt((coefficients**2).mean(axis=(0, 1)).sum()) / 2)


def _sentence(degree, degrees, scores, aliasing):
    """The choice and the alarm in words."""
    words = f"{degree}, of {degrees[0]} to {degrees[-1]}: stars kept out scatter least with it, by "
    words += f"{np.sqrt(scores[degrees.index(degree)]):.2f} of their errors"
    if degree == HIGHEST:
        words += "; it is the highest that was tried"
    elif degree == degrees[-1]:
        words += "; there are too few stars for more"
    return ". ".join([words, *(_in_words(a, degree) for a in aliasing if a["excess"] > ALARM)])


def _in_words(a, degree):
    into = [f"degree {d} ({rms:.2g} px)" for d, rms in enumerate(a["folds_into"]) if rms > 0.2 * a["energy"]]
    words = (
        f"Degree {a['degree']} is there as well, {a['energy']:.2g} px rms beyond its noise, mostly {_mode(a['mode'])}"
    )
    if not into:
        return f"{words}; it stays in the residuals"
    return f"{words}; a fit of degree {degree} takes it for {' and '.join(into)}, mostly {_mode(a['into'])}"


def _mode(orders):
    factors = [f"{axis}^{n}" if n > 1 else axis for axis, n in zip("xy", orders, strict=True) if n]
    return " ".join(factors) or "a shift"
