"""The degree that serves stars best which are kept out of the fit.

A degree too low leaves distortion in their positions, one too high follows the noise of the other stars.
"""

import logging
from math import ceil

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from ...exceptions import InputError, LegdistortError
from ...geometry import basis
from ...geometry.detector_modes import dynamic_basis, dynamic_degrees
from ...results.diagnostics import AliasedDegree, DegreeChoice
from ..equations import elimination
from ..gauge import constraints
from . import held_out

log = logging.getLogger(__name__)

#: As `degree` of `solve`: to be chosen.
AUTO = "auto"
#: Highest degree that is tried.
HIGHEST = 6
#: Parts into which stars are divided; each is left out once. So few stars are left out one by one.
N_FOLDS, FEW = 10, 30
#: No further degree is tried when so many in a row, of even and of odd modes, are no better than one with which the
#: squares of stars left out are less than this times those of their errors: no large distortion is left. Cubic modes,
#: the first that many optics have, are always tried.
N_WORSE, EXPLAINED, CUBIC = 2, 2.0, 3
#: Of degrees whose scores differ by less than this part the lowest is taken.
CLOSE = 0.005
#: Excess of a degree's energy over its noise, in standard deviations of the latter, that raises the alarm.
ALARM = 5.0
_SETTLED = 1e-6  # of the largest effect of a common map on an exposure
_PROBED = 600  # directions times samples from which the variance of departures is estimated
_ACCURACY = 1e-3  # of departures over their errors
_UNKNOWN = 10.0  # pixels, each mode of a common map at most
_OUTLIER = 25.0  # times the usual squared scatter of a star, at every degree: mismatched, it has no weight


def choose_degree(matches, fit, solution, *, clip, found):
    """The degree from 0 to 6 whose distortions serve stars best that had no part in them.

    Of every degree there is one fit, and `held_out.squares` gives how stars left out of it would scatter. What
    contradicts the fit of the degree chosen takes no part, and the degree is chosen once more without it, until it
    stays.

    Parameters
    ----------
    matches : Matches
    fit : callable
        ``fit(matches, degree, clip, near)``, a `legdistort.solving.single_fit.Fit`; `near` is another to begin at.
    solution : callable
        ``solution(fit)``, the `Solution`.
    clip : float or None
        Deviations beyond which observations contradict a fit; None takes all.
    found : bool
        Whether a fit finds the widths of its prior. It is then made anew without the stars left out, which takes
        twenty times as long.

    Returns
    -------
    DegreeChoice

    Raises
    ------
    LegdistortError
        If not even degree 0 can be fitted.
    """
    trials, before = _Trials(matches, fit, solution, found=found), set()
    while clip is not None and trials.degree not in before:
        before.add(trials.degree)
        kept = trials.sound(matches, clip)
        if len(kept.table) == len(trials.matches.table):
            break
        trials = _Trials(kept, fit, solution, found=found)
    if trials.error is not None:
        raise trials.error
    degree, scores = trials.degree, trials.scores
    aliasing = _aliasing(trials.fitted, degree)
    return DegreeChoice(
        degree=degree,
        degrees=tuple(range(len(scores))),
        scores=tuple(float(score) for score in scores),
        n_folds=len(trials.folds),
        aliasing=aliasing,
        alarm=any(a.excess > ALARM for a in aliasing),
        sentence=_sentence(degree, scores, aliasing),
    )


class _Trials:
    """Fits of some matches with one degree after another, and how stars left out of them would scatter.

    Attributes
    ----------
    degree : int
        The best; 0 if none can be fitted.
    scores : ndarray, shape (n_degrees,)
    error : LegdistortError or None
        Why not even degree 0 can be fitted.
    """

    def __init__(self, matches, fit, solution, *, found):
        self.matches, self.folds, self._found = matches, _folds(matches), found
        self._fit, self._solution = fit, solution
        self.degree, self.scores, self.error, self._fits, self._is_sure = 0, np.zeros(0), None, {}, False
        self._squares = []
        for tried in range(HIGHEST + 1):
            try:
                self._try(tried)
            except LegdistortError as error:
                log.debug("degree %d is beyond these stars: %s", tried, error)
                self.error = error if tried == 0 else None
                break
            if self._is_enough():
                self._make_sure()
            if self._is_enough():
                break
        self._make_sure()

    def _try(self, degree, refit=False):
        """How stars left out scatter with a degree, and the best one then.

        What the fit holds has to go without them as well, which takes a fit for every part of the stars: widths of a
        prior do; the registration at degree 0 only if that would else be the best.
        """
        if self._found or refit:
            squares = self._refitted(degree)
        else:
            squares = held_out.squares(self.fitted(degree), self.matches, self.folds)
        self._squares[degree : degree + 1] = [squares]
        self.scores = _scores(np.array(self._squares))
        self.degree = int(np.argmax(self.scores <= (1 + CLOSE) * self.scores.min()))

    def _is_enough(self):
        tried = len(self._squares) - 1
        return tried >= max(self.degree + N_WORSE, CUBIC) and self.scores[self.degree] < EXPLAINED

    def _make_sure(self):
        """Degree 0 is the best only if it is with a registration that has not seen the stars left out."""
        if self.degree == 0 and self._squares and not (self._found or self._is_sure):
            self._is_sure = True
            self._try(0, refit=True)

    def _refitted(self, degree):
        def refit(left):
            return self._solution(self._fit(left, degree, None))

        return held_out.refitted_squares(refit, self.matches, self.folds)

    def fitted(self, degree):
        """The fit with some degree to all of these matches."""
        if degree not in self._fits:
            self._fits[degree] = self._fit(self.matches, degree, None, self._fits.get(degree - 1))
        return self._fits[degree]

    def sound(self, matches, clip):
        """The given matches without what contradicts a fit with the best degree."""
        found = self._fit(matches, self.degree, clip, self._fits.get(self.degree))
        if found.matches is matches and found.used.all():
            return matches
        return held_out.only_rows(found.matches, found.problem.in_table_order(found.used))


def _scores(squares):
    """Squared scatter over that of the errors by degree, from (degree, star, squares and degrees of freedom)."""
    seen = squares[0, :, 1] > 0
    least = (squares[:, :, 0] / np.maximum(squares[:, :, 1], 1)).min(axis=0)
    counts = seen & (least <= _OUTLIER * np.median(least[seen]))
    return squares[:, counts, 0].sum(axis=1) / squares[:, counts, 1].sum(axis=1)


def _folds(matches):
    """Numbers of the stars to be left out, in turn."""
    seen = np.flatnonzero(np.bincount(matches.observations.star) > 1)
    if len(seen) < 2:
        raise InputError(f"degree={AUTO!r} needs stars that two exposures or more see; there are {len(seen)} of them")
    n = len(seen) if len(seen) <= FEW else N_FOLDS
    return np.array_split(np.random.default_rng(0).permutation(seen), n)


# -- the aliasing alarm


def _aliasing(fit, degree):
    """`folding` for the two degrees beyond the one chosen, as far as the stars allow; ``fit(degree)`` takes all."""
    for top in (degree + 2, degree + 1):
        try:
            return tuple(folding(fit(top), degree, higher) for higher in range(degree + 1, top + 1))
        except LegdistortError as error:
            log.debug("degree %d is beyond these stars: %s", top, error)
    return ()


def folding(fit, degree, higher):
    """What modes of a higher degree do to a fit of a lower one (paper, section 4.3).

    The fit of the lower degree takes part of them for modes that it has: at the stars of an exposure they look alike.
    To first order these parts follow from a regression of the ones on the others at these stars.

    Parameters
    ----------
    fit : `legdistort.solving.single_fit.Fit`
        Of a degree that includes `higher`.
    degree : int
        Of the fit that lacks them.
    higher : int

    Returns
    -------
    AliasedDegree
    """
    low, high = basis.n_modes(degree), slice(basis.n_modes(higher - 1), basis.n_modes(higher))
    departure, variance, excess_beside = _of_their_own(fit, high)
    excess = excess_beside()
    curved = fit.problem.degree > 1 and np.any(fit.problem.static_errors.sigma)  # maps that are not known exactly
    if excess > ALARM and curved:
        excess = excess_beside(_second_order(fit, low))
    energy = np.sum(departure**2)
    beyond = np.sqrt(max(1 - variance / max(energy, 1e-300), 0))
    folds = _folds_at_stars(fit, low, high)
    folded = folds @ departure.mT
    orders = np.array(basis.orders(higher)).T
    strongest = int(np.argmax((departure**2).sum(axis=(0, 1))))
    alone = np.mean(folds[:, :, strongest] ** 2, axis=0)
    size = beyond * np.sqrt((folded**2).mean(axis=(0, 2)))  # per mode: rms over exposures and axes
    degrees = orders[:low].sum(axis=1)
    found = float(np.sqrt((departure**2).mean(axis=(0, 1)).sum()) / 2)  # rms over the detector, exposures and axes
    return AliasedDegree(
        degree=int(higher),
        found=found,
        noise=float(found * np.sqrt(variance / max(energy, 1e-300))),
        excess=excess,
        energy=float(beyond * found),
        folds_into=tuple(float(np.sqrt(np.sum(size[degrees == d] ** 2)) / 2) for d in range(degree + 1)),
        mode=tuple(orders[high][strongest].tolist()),
        into=tuple(orders[int(np.argmax(alone))].tolist()),
    )


def _of_their_own(fit, high):
    """Departures of the exposures from the prior in the modes of a degree, without what common maps do to these.

    Maps of that degree and of higher ones, which dithers bring down to it: the stars take them up, and what they are
    follows from the convention, of which distortions of low degree are part.

    Returns
    -------
    departure : ndarray, shape (n_exposures, 2, n)
    variance : float
        Of all departures together, by their errors; from samples, to a tenth.
    excess : callable
        ``excess(effects)``: their squares over their errors beyond the degrees of freedom, in standard deviations of
        what these are by chance. What common maps do besides, `effects` (n_exposures, 2 n_modes, 2 n_modes) for one
        standard deviation of each, counts as an error.
    """
    problem, gauge, system, n = fit.problem, fit.result.gauge, fit.uncertainty.system, fit.problem.n_exposures
    departure = (fit.result.state.coefficients - problem.prior_mean)[:, :, high]
    modes = np.arange(2 * problem.n_modes).reshape(2, -1)[:, high].ravel()
    own_modes, maps = (np.arange(2 * k).reshape(2, -1) for k in (gauge.n_own, gauge.n_modes))
    n_fields = problem.n_fields
    # shears in the place of linear modes: similarities are in the poses
    of_degree = dynamic_degrees(problem.n_modes) == basis.degree_of(high.stop)
    turn = np.stack([dynamic_basis(shape, problem.n_modes) for shape in problem.shapes])[:, of_degree]

    def seen(motion, causes):
        """What common maps do to the departures, (n_exposures K, m)."""
        out = turn[:, :, modes] @ motion[:, own_modes[:, high].reshape(-1, 1), causes.ravel()]
        return out.reshape(-1, out.shape[2])

    columns, size, _ = np.linalg.svd(seen(gauge.motion, maps[:, n_fields * high.start :]), full_matrices=False)
    common, still = columns[:, size > _SETTLED * size.max()], np.zeros_like(fit.blocks.g_star)

    def own(each):
        return each - common @ (common.T @ each)

    def covariance(each):
        gradient = own(each).reshape(n, 1, -1) @ turn
        return own((turn @ system.settle(gradient[:, 0], still, 0.1 * _ACCURACY)[1][:, :, None]).ravel())

    given = own((turn[:, :, modes] @ departure.reshape(n, -1, 1)).ravel())
    dof, square = given.size - common.shape[1], (given.size, given.size)
    known = turn @ elimination.inverse_exposure_blocks(fit.blocks.u) @ turn.mT  # if the stars were

    def excess(effects=None):
        beside = (
            np.zeros((given.size, 1)) if effects is None else own(seen(effects, maps[:, n_fields * basis.n_modes(1) :]))
        )
        lifted = np.linalg.solve(known, beside.reshape(n, turn.shape[1], -1)).reshape(beside.shape)
        lifted = lifted @ np.linalg.inv(np.linalg.cholesky(np.eye(beside.shape[1]) + beside.T @ lifted)).T  # Woodbury

        def conditioned(each):
            return own(np.linalg.solve(known, own(each).reshape(n, -1, 1)).ravel() - lifted @ (lifted.T @ own(each)))

        whole = LinearOperator(square, lambda each: covariance(each) + beside @ (each @ beside))
        solved, _ = cg(whole, given, rtol=_ACCURACY, M=LinearOperator(square, conditioned))
        return float((given @ solved - dof) / np.sqrt(2 * dof)) if dof else 0.0

    signs = np.random.default_rng(0).choice([-1.0, 1.0], (ceil(_PROBED / given.size), given.size))
    variance = np.mean([each @ covariance(each) for each in signs])
    departure = turn[:, :, modes].mT @ given.reshape(n, -1, 1)
    return departure.reshape(n, 2, -1), float(variance), excess


def _second_order(fit, carried):
    """What common maps of `_UNKNOWN` pixels do by carrying the first modes of every exposure to other places.

    Beyond `Gauge.motion`, (n_exposures, 2 n_modes, 2 n_modes); less for maps that are known better.
    """
    problem, state, gauge = fit.problem, fit.result.state, fit.result.gauge
    coefficients = problem.prior_mean.copy()
    coefficients[:, :, :carried] = state.coefficients[:, :, :carried]
    whole = constraints.motion_with_distortion(problem, state.poses, coefficients, gauge.plane_modes())
    sigma = np.minimum(problem.static_errors.sigma.max(axis=0), _UNKNOWN)
    return (whole - gauge.motion) * np.repeat(sigma, problem.n_fields, axis=1).ravel()


def _folds_at_stars(fit, low, high):
    """Regression (n_exposures, n_low, n_high) of higher modes on the lower ones at the stars of each exposure."""
    n, u = fit.problem.n_modes, fit.blocks.u_data
    products = u[:, :n, :n] + u[:, n:, n:]  # both axes count
    return np.linalg.pinv(products[:, :low, :low], hermitian=True) @ products[:, :low, high]


def _sentence(degree, scores, aliasing):
    """The choice and the alarm in words."""
    highest = len(scores) - 1
    words = (
        f"{degree}, of 0 to {highest}: stars kept out scatter least with it, by {np.sqrt(scores[degree]):.2f} of their "
        "errors"
    )
    if degree == HIGHEST:
        words += "; it is the highest that was tried"
    elif degree == highest:
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
