"""Stars that are kept out of the fit: they choose the degree, and test the errors.

A star that is left out says what a fit is worth: corrected with distortions that it had no part in, its positions
scatter by their errors, plus what is wrong with the distortions.
"""

import numpy as np
from astropy import units as u

from ...exceptions import InputError
from ...inputs.matches import Matches
from ...results import accuracy
from ...results.diagnostics import Validation


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
    return only_rows(matches, ~out), matches.table[out]


def only_rows(matches, rows):
    """The same matches with some rows of the table."""
    known = {"poses": matches.poses, "sky": matches.sky, "left_out": matches.left_out, "allow_copies": True}
    known["camera"] = matches.camera
    kept = Matches.from_table(matches.table[rows], shape=matches.shapes, **known)
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
    found = solution.diagnostics
    for i, name in enumerate(solution.names):
        rows = np.flatnonzero(table["exposure"] == name)
        xy[i, star[rows]] = solution.correct(name, measured[rows])
        sigma[i, star[rows]] = found.error_scale * np.hypot(error[rows], found.error_floor)
    return xy, sigma


def validation(solution, table, fraction):
    """How stars that a solution has not seen scatter, and how they should.

    With ``settings.clip`` single positions that deviate by more, as mismatches do, are left out here too.

    Parameters
    ----------
    solution : Solution
    table : `~astropy.table.QTable`
        Their rows.
    fraction : float
        As it was asked for.

    Returns
    -------
    Validation

    Raises
    ------
    InputError
        If no star is left in two exposures.
    """
    xy, sigma = corrected(solution, table)
    seen = np.isfinite(xy[:, :, 0])
    n_given = np.count_nonzero(seen)
    expected = _expected(solution, xy, sigma, seen)
    if solution.settings.clip is not None:
        middle = np.nanmedian(np.where(seen.any(axis=0)[:, None], xy, 0), axis=0)
        off = np.sqrt(((xy - middle) ** 2).sum(axis=2)) / expected
        usual = np.nanmedian(off) / np.sqrt(2 * np.log(2))
        xy[off > solution.settings.clip * max(1.0, usual)] = np.nan
        seen = np.isfinite(xy[:, :, 0])
        expected = _expected(solution, xy, sigma, seen)
    scatter = accuracy.scatter(xy)
    good = np.isfinite(scatter) & np.isfinite(expected)
    if not good.any():
        raise InputError("no star that was kept out is left in two exposures; give a larger fraction for validate")
    scatter, expected = (float(np.sqrt(np.mean(a[good] ** 2))) for a in (scatter, expected))
    return Validation(
        fraction=float(fraction),
        n_stars=int(good.sum()),
        n_observations=int(np.count_nonzero(seen[:, good])),
        n_clipped=int(n_given - np.count_nonzero(seen)),
        scatter=scatter,
        expected=expected,
        ratio=scatter / expected,
    )


def _expected(solution, xy, sigma, seen):
    """Expected scatter of every star (n_stars,), NaN where fewer than two exposures see it."""
    place = np.where(seen[..., None], xy, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None]
    return accuracy.expected_scatter(solution, place, np.where(seen, sigma, 1), seen=seen)
