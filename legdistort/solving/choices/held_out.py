"""Stars that are kept out of the fit: they choose the degree, and test the errors.

A star that is left out tests a fit: corrected with distortions in which it had no part, its positions scatter by their
own errors and those of the distortions.
"""

import itertools
from dataclasses import replace

import numpy as np
from astropy import units as u

from ...exceptions import InputError, SolveError
from ...results import accuracy
from ...results.diagnostics import Validation
from ..equations import criterion, elimination, reduced_system
from ..equations.star_terms import packed, symmetric_times

#: Part of the normal equations of a star below which they do not determine an unknown of its motion.
_UNDETERMINED = 1e-9
_ACCURACY = 1e-3  # of a step that conjugate gradients take


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
    """The same matches with some rows of the table (`Matches.keep`), some in every exposure.

    Raises
    ------
    InputError
        Naming an exposure without any.
    """
    kept = matches.keep(rows)
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
        Error of the measured position, rms of the axes, pixels, as it counts in the solution.
    """
    stars, star = np.unique(table["star"], return_inverse=True)
    xy = np.full((len(solution.names), len(stars), 2), np.nan)
    sigma = np.full(xy.shape[:2], np.nan)
    measured = np.column_stack([table["x"].to_value(u.pix), table["y"].to_value(u.pix)])
    error = np.sqrt(np.einsum("nkk->n", solution.diagnostics.errors_of(table)) / 2)
    for i, name in enumerate(solution.names):
        rows = np.flatnonzero(table["exposure"] == name)
        xy[i, star[rows]] = solution[name].to_reference(measured[rows])
        sigma[i, star[rows]] = error[rows]
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


# -- every star left out, from one fit


def squares(fit, matches, folds):
    """Squared scatter of every star over its errors, left out of a fit, and its degrees of freedom, (n_stars, 2).

    About its position, and its motion where those of the stars are fitted. What the others would have given follows
    from the normal equations of the fit without the part of the stars left out: one Newton step, exact in the
    coefficients, which the model is linear in. Poses and the widths of a prior stay those of the fit.

    Parameters
    ----------
    fit : `legdistort.solving.single_fit.Fit`
    matches : Matches
        Whose stars are numbered.
    folds : sequence of ndarray of int
        Stars left out together.

    Raises
    ------
    SolveError
        If the stars that are left do not determine the distortion of an exposure.
    """
    problem = fit.problem
    fold = np.full(len(matches.stars), -1)
    for k, stars in enumerate(folds):
        fold[stars] = k
    mine = np.searchsorted(np.asarray(matches.stars), np.asarray(fit.matches.stars))
    of_row = fold[mine][problem.star]
    _check_left(problem, fit.used, of_row, len(folds))
    blocks = fit.blocks if fit.weighted is problem else criterion.linearise(problem, fit.result.state)
    following = _with_stars_following(fit.weighted, fit.blocks)
    changes = np.stack([_step_without(fit, np.flatnonzero(of_row == k), *following) for k in range(len(folds))])
    left = blocks.residual.copy()  # of stars that are in no fold they mean nothing, see below
    for i in range(problem.n_exposures):
        part = problem.part(i)
        moved = changes[:, i].reshape(len(folds), 2, -1) @ blocks.values[:, part]
        left[:, part] -= moved[of_row[part], :, np.arange(moved.shape[2])].T
    out = np.zeros((len(fold), 2))
    out[mine] = _about_stars(problem, blocks, left)
    out[fold < 0] = 0
    return out


def refitted_squares(fit, matches, folds):
    """The same by solving anew without these stars.

    Parameters
    ----------
    fit : callable
        ``fit(matches)``, a `Solution` of all these observations.
    matches, folds
        As for `squares`.

    Raises
    ------
    LegdistortError
        If one of these fits cannot be made.
    """
    out = np.zeros((len(matches.stars), 2))
    for stars in folds:
        rows = np.isin(matches.observations.star, stars)
        out[np.sort(stars)] = _about_places(fit(only_rows(matches, ~rows)), matches.table[rows])
    return out


def _about_places(solution, table):
    """Weighted squares of corrected positions about the best unknowns of every star, and degrees of freedom."""
    xy, sigma = corrected(solution, table)
    weight = np.where(np.isfinite(xy[:, :, 0]), sigma**-2, 0.0)
    xy = np.where(np.isfinite(xy), xy, 0.0)
    rows, motions = np.tile(np.eye(2), (len(xy), 1, 1)), solution.estimate.motions  # unknowns of a star -> its place
    if motions is not None:
        rows = np.concatenate([rows, motions.columns(motions.years, solution.sky)], axis=2)
    normal = np.einsum("ij,iab,iac->jbc", weight, rows, rows)
    size, axes = np.linalg.eigh(normal)
    known = size > _UNDETERMINED * np.einsum("jbb->j", normal)[:, None]
    inverse = (axes * np.where(known, 1 / np.where(known, size, 1), 0)[:, None]) @ axes.transpose(0, 2, 1)
    found = np.einsum("jbc,ij,iac,ija->jb", inverse, weight, rows, xy, optimize=True)
    squares = np.einsum("ij,ija->j", weight, (xy - np.einsum("iab,jb->ija", rows, found)) ** 2)
    return np.column_stack([squares, 2 * (weight > 0).sum(axis=0) - known.sum(axis=1)])


def _check_left(problem, used, of_row, n_folds):
    """Raise `SolveError` for an exposure in which the stars left, some of them out, are fewer than its modes."""
    place = problem.exposure[used] * (n_folds + 1) + of_row[used] + 1
    counts = np.bincount(place, minlength=problem.n_exposures * (n_folds + 1)).reshape(problem.n_exposures, -1)
    fewest = counts.sum(axis=1) - counts[:, 1:].max(axis=1)
    for i, name in enumerate(problem.names):
        if fewest[i] < max(1, problem.n_free(i)):
            raise SolveError(f"exposure {name} has {fewest[i]} stars when others are left out, too few for this degree")


def _about_stars(problem, blocks, residual):
    """Weighted squares of residuals (2, n) about the best unknowns of every star, and degrees of freedom."""
    star, n = problem.star, problem.n_stars
    pull = problem.pulled((blocks.coupling * residual).sum(axis=1))
    pull = np.stack([np.bincount(star, row, n) for row in pull])
    inverse = elimination.inverse_star_blocks(blocks.v)
    total = np.bincount(star, criterion.squares(problem, residual), n)
    known = np.count_nonzero(inverse[np.diag(packed(problem.n_star))] > 0, axis=0)
    left = total - (pull * symmetric_times(inverse, pull)).sum(axis=0)
    return np.column_stack([left, 2 * np.bincount(star, minlength=n) - known])


def _with_stars_following(problem, blocks):
    """Gradients (n, 2 n_modes) where the stars follow, and what every observation adds to them: its pull (2, n)."""
    step = symmetric_times(elimination.inverse_star_blocks(blocks.v), blocks.g_star)
    (wx, wy, wxy), (x, y), f, z = problem.weight, blocks.residual, blocks.coupling, problem.placed(step)
    pull = np.stack([wx * x + wxy * y, wxy * x + wy * y]) - f[0] * z[0] - f[1] * z[1]
    return blocks.g_exposure - elimination.to_exposures(problem, blocks, step), pull


def _part_of(problem, blocks, pull, rows):
    """What observations, ascending, add to exposure blocks (n, 2 n_modes, 2 n_modes) and gradients (n, 2 n_modes)."""
    own, gradient, n = np.zeros_like(blocks.u), np.zeros_like(blocks.g_exposure), problem.n_modes
    (wx, wy, wxy), pull, b = problem.weight[:, rows], pull[:, rows], blocks.values[:, rows].astype(float)
    weighted = wx * b
    for i, (low, high) in enumerate(itertools.pairwise(np.searchsorted(rows, problem.start).tolist())):
        mine, of_modes = slice(low, high), b[:, low:high].T
        own[i, :n, :n] = own[i, n:, n:] = weighted[:, mine] @ of_modes
        if problem.unequal:
            own[i, n:, n:] = (wy[mine] * b[:, mine]) @ of_modes
            own[i, :n, n:] = own[i, n:, :n] = (wxy[mine] * b[:, mine]) @ of_modes
        gradient[i] = (pull[:, mine] @ of_modes).ravel()
        if problem.fixed is not None:
            gradient[i] -= problem.fixed[i].T @ (problem.fixed[i] @ gradient[i])
    return own, gradient


def _step_without(fit, rows, gradient, pull):
    """Step (n_exposures, 2 n_modes) of the coefficients without stars, given all rows of theirs.

    `gradient` and `pull` as `_with_stars_following` gives them.
    """
    problem, blocks, v = fit.weighted, fit.blocks, fit.blocks.v.copy()
    v[:, problem.star[rows]] = 0
    u, part = _part_of(problem, blocks, pull, rows)
    left = replace(blocks, u=blocks.u - u, v=v, g_exposure=gradient - part, g_star=np.zeros_like(blocks.g_star))
    if reduced_system.is_singular(left.u):
        raise SolveError("the stars that are left do not determine the distortion of this degree")
    gauge = fit.result.gauge
    # few iterations serve, as the solution with these stars is near, and factors would take longer; where exposures
    # hang together weakly these serve after all
    return reduced_system.Iterative(problem, left, gauge).step(np.zeros(gauge.n_constraints), _ACCURACY)[1]
