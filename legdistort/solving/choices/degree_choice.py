"""The degree that serves stars best which are kept out of the fit.

A degree too low leaves distortion in their positions, one too high follows the noise of the other stars.
"""

import logging

import numpy as np
from astropy import units as u

from ...exceptions import InputError, LegdistortError
from ...geometry import basis, similarity
from ...results.coefficient_covariance import exposure_blocks
from ...results.diagnostics import AliasedDegree, DegreeChoice
from .held_out import corrected, only_rows

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
CLOSE = 0.005
#: Excess of a degree's energy over its noise, in standard deviations of the latter, that raises the alarm.
ALARM = 5.0
_UNTOLD = 1e-9  # part of the normal equations of a star below which they do not determine an unknown of its motion
_OUTLIER = 25.0  # times the usual squared scatter of a star, at every degree: mismatched, it has no say


def choose_degree(matches, fit, sound):
    """The degree from 0 to 6 whose distortions serve stars best that had no part in them.

    What contradicts a fit of all stars takes no part in those of the same degree without some of them.

    Parameters
    ----------
    matches : Matches
    fit : callable
        ``fit(matches, degree)``, a `Solution` of all these observations.
    sound : callable
        ``sound(degree)``, the matches without what contradicts a fit of all.

    Returns
    -------
    DegreeChoice

    Raises
    ------
    LegdistortError
        If not even degree 0 can be fitted.
    """
    folds = _folds(matches)
    degrees, squares = [], []
    for tried in range(HIGHEST + 1):
        try:
            kept = sound(tried)
            parts = [only_rows(kept, ~_of(kept, stars)) for stars in folds]
            tests = [matches.table[_of(matches, stars)] for stars in folds]
            squares.append(
                np.concatenate([_squares(fit(p, tried), table) for p, table in zip(parts, tests, strict=True)])
            )
        except LegdistortError as error:
            if tried == 0:
                raise
            log.debug("degree %d is beyond these stars: %s", tried, error)
            break
        degrees.append(tried)
        scores = _scores(np.array(squares))
        degree = int(np.argmax(scores <= (1 + CLOSE) * scores.min()))
        if tried - degree >= N_WORSE:
            break
    aliasing = _aliasing(lambda top: fit(sound(top), top), degree)
    return DegreeChoice(
        degree=degree,
        degrees=tuple(degrees),
        scores=tuple(float(score) for score in scores),
        n_folds=len(folds),
        aliasing=aliasing,
        alarm=any(a.excess > ALARM for a in aliasing),
        sentence=_sentence(degree, degrees, scores, aliasing),
    )


def _scores(squares):
    """Squared scatter over that of the errors by degree, from (degree, star, squares and degrees of freedom)."""
    seen = squares[0, :, 1] > 0
    least = (squares[:, :, 0] / np.maximum(squares[:, :, 1], 1)).min(axis=0)
    counts = seen & (least <= _OUTLIER * np.median(least[seen]))
    return squares[:, counts, 0].sum(axis=1) / squares[:, counts, 1].sum(axis=1)


def _folds(matches):
    """Stars to be left out, in turn."""
    star = matches.observations.star
    seen = np.flatnonzero(np.bincount(star) > 1)
    if len(seen) < 2:
        raise InputError(f"degree={AUTO!r} needs stars that two exposures or more see; there are {len(seen)} of them")
    n = len(seen) if len(seen) <= FEW else N_FOLDS
    return np.array_split(np.asarray(matches.stars)[np.random.default_rng(0).permutation(seen)], n)


def _of(matches, stars):
    """Rows (n,) of some stars."""
    return np.isin(matches.table["star"], stars)


def _squares(solution, table):
    """Squared scatter of every star over its errors, and its degrees of freedom, shape (n_stars, 2).

    About its mean, or its own motion where those of the stars are fitted.
    """
    xy, sigma = corrected(solution, table)
    weight = np.where(np.isfinite(xy[:, :, 0]), sigma**-2, 0.0)
    xy = np.where(np.isfinite(xy), xy, 0.0)
    rows, motions = np.tile(np.eye(2), (len(xy), 1, 1)), solution.motions  # unknowns of a star -> its place
    if motions is not None:
        rows = np.concatenate([rows, motions.columns(motions.years, solution.sky)], axis=2)
    normal = np.einsum("ij,iab,iac->jbc", weight, rows, rows)
    size, axes = np.linalg.eigh(normal)
    known = size > _UNTOLD * np.einsum("jbb->j", normal)[:, None]
    inverse = (axes * np.where(known, 1 / np.where(known, size, 1), 0)[:, None]) @ axes.transpose(0, 2, 1)
    found = np.einsum("jbc,ij,iac,ija->jb", inverse, weight, rows, xy, optimize=True)
    squares = np.einsum("ij,ija->j", weight, (xy - np.einsum("iab,jb->ija", rows, found)) ** 2)
    return np.column_stack([squares, 2 * (weight > 0).sum(axis=0) - known.sum(axis=1)])


# -- the aliasing alarm


def _aliasing(fit, degree):
    """`folding` for the two degrees beyond the one chosen, as far as the stars allow; ``fit(degree)`` takes all."""
    for top in (degree + 2, degree + 1):
        try:
            solution = fit(top)
            return tuple(folding(solution, degree, d) for d in range(degree + 1, top + 1))
        except LegdistortError as error:
            log.debug("degree %d is beyond these stars: %s", top, error)
    return ()


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
    AliasedDegree
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
    found = float(np.sqrt((departure**2).mean(axis=(0, 1)).sum()) / 2)  # rms over the detector, exposures and axes
    return AliasedDegree(
        degree=int(higher),
        found=found,
        noise=float(found * np.sqrt(variance / max(energy, 1e-300))),
        excess=float((normal - departure.size) / np.sqrt(2 * departure.size)),
        energy=float(beyond * found),
        folds_into=tuple(float(np.sqrt(np.sum(size[degrees == d] ** 2)) / 2) for d in range(degree + 1)),
        mode=tuple(orders[high][strongest].tolist()),
        into=tuple(orders[int(np.argmax(alone))].tolist()),
    )


def _covariances(solution, high):
    """Covariance (n_exposures, 2 n, 2 n) of some modes of every exposure, x before y."""
    blocks = exposure_blocks(solution.uncertainty.coefficients, len(solution.names))
    size = 2 * basis.n_modes(solution.degree)
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


def _sentence(degree, degrees, scores, aliasing):
    """The choice and the alarm in words."""
    words = (
        f"{degree}, of {degrees[0]} to {degrees[-1]}: stars kept out scatter least with it, by "
        f"{np.sqrt(scores[degrees.index(degree)]):.2f} of their errors"
    )
    if degree == HIGHEST:
        words += "; it is the highest that was tried"
    elif degree == degrees[-1]:
        words += "; there are too few stars for more"
    return ". ".join([words, *(_in_words(a, degree) for a in aliasing if a.excess > ALARM)])


def _in_words(a, degree):
    into = [f"degree {d} ({rms:.2g} px)" for d, rms in enumerate(a.folds_into) if rms > 0.2 * a.energy]
    words = f"Degree {a.degree} is there as well, {a.energy:.2g} px rms beyond its noise, mostly {_mode(a.mode)}"
    if not into:
        return f"{words}; it stays in the residuals"
    return f"{words}; a fit of degree {degree} takes it for {' and '.join(into)}, mostly {_mode(a.into)}"


def _mode(orders):
    return " ".join(f"{axis}^{n}" if n > 1 else axis for axis, n in zip("xy", orders, strict=True) if n) or "a shift"
