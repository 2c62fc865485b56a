"""One fit from beginning to end: problem, start values, minimisation, and whole exposures that do not fit left out."""

import contextlib
import logging
import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import brentq

from ..exceptions import ConvergenceWarning, LegdistortError, SolveError, warn
from ..matching.matches import Matches
from ..runtime import parallel
from . import agreement, clipping, minimisers, star_motions, start_values
from .choices import prior_widths
from .equations import criterion, effective_modes, elimination
from .equations.covariances import Uncertainty
from .equations.problem import Problem, build_problem, uses_compiled_loops
from .gauge import known_maps, most_probable
from .gauge.hierarchy import is_noise
from .gauge.higher_static import higher_errors

log = logging.getLogger(__name__)

#: Beyond this number of exposures the matrices are large enough to gain by several threads.
_MANY_EXPOSURES = 50
#: An error floor is found when chi2 is its degrees of freedom to this part; fits that are made at most to find it.
_EQUAL, _REFITS = 0.005, 4
#: Accuracy of fits on trial, in standard errors, rms over their unknowns; squares of residuals over those of the errors
#: below which one leaves nothing that the reference plane could be estimated from.
TRIAL, EXPLAINED = 0.03, 2.0
#: Typical errors of an exposure of the mean weight by which a bend of the plane moves stars in second order where it
#: counts, and so where chance does not explain the residuals.
SHOWN, SHOWN_BY_MISFIT = 1.0, 0.25
#: Times the least eigenvalue of what residuals show: below it, and with room for one that moves, the rest is held.
_FREER = 0.5


@contextlib.contextmanager
def threads(matches):
    """One thread for linear algebra, but for large matrices where no compiled loops use all cores beside it."""
    with contextlib.ExitStack() as stack:
        if uses_compiled_loops(len(matches.table)):
            from .equations.compiled import threads_kept

            stack.enter_context(threads_kept())
            stack.enter_context(parallel.one_blas_thread())
        elif len(matches.names) <= _MANY_EXPOSURES:
            stack.enter_context(parallel.one_blas_thread())
        yield


@dataclass(frozen=True, eq=False)
class Fit:
    """One minimisation: what went in (after whole exposures were dropped), and what came out.

    Attributes
    ----------
    matches : Matches
    problem : Problem
    result : Result
    used : ndarray of bool, shape (n,)
        Observations that were used, in the order of the problem.
    options : SolveOptions
        With the prior and the error floor that were in force.
    widths : `legdistort.solving.choices.prior_widths.Widths` or None
        Those of the prior that were found.
    unfollowed : dict
        ``{exposure: reason}`` of exposures that the fit cannot follow, if it was not judged.
    shared_errors : ndarray, shape (3, n_stars), or None
        See `Uncertainty`.
    camera_errors : `legdistort.results.errors.camera_errors.CameraErrors` or None
        Those of a camera that was fitted, or of the static distortion beyond the degree.
    shared_unknowns : float
        Number of unknowns of these that the data determine.
    tabled : `legdistort.solving.terms.displaced.Tabled` or None
        What terms found that is a part of distortions.
    """

    matches: Matches
    problem: Problem
    result: minimisers.Result
    used: np.ndarray
    options: object
    widths: prior_widths.Widths | None = None
    unfollowed: dict = field(default_factory=dict)
    shared_errors: np.ndarray | None = None
    camera_errors: object = None
    shared_unknowns: float = 0.0
    tabled: object = None

    @cached_property
    def weighted(self):
        """The problem with the weights that were in force."""
        if self.used.all() and np.all(self.result.robust == 1):
            return self.problem
        return self.problem.scaled(self.used * self.result.robust)

    @cached_property
    def blocks(self):
        """The normal equations with these weights."""
        if self.weighted is self.problem:
            return self.result.blocks
        return criterion.linearise(self.weighted, self.result.state)

    @cached_property
    def uncertainty(self):
        """Covariances at the stated errors."""
        return self.uncertainty_at(1.0)

    def with_higher_errors(self):
        """The fit with the errors of what exposures have in common beyond the degree, if they show any."""
        if self.result.higher is None:
            return self
        errors, n = higher_errors(self.weighted, self.result, self.uncertainty, self.result.higher)
        return replace(self, camera_errors=errors, shared_unknowns=n)

    def uncertainty_at(self, scale):
        """Covariances at the stated errors times a factor."""
        common = {"shared_errors": self.shared_errors, "camera": self.camera_errors, "system": self.system}
        return Uncertainty(self.weighted, self.blocks, self.result.gauge, scale=scale, **common)

    @property
    def system(self):
        """The reduced system that the minimisation ended with, if it is that of the weights and the gauge in force."""
        system, gauge = self.result.system, self.result.gauge
        fits = system is not None and system.problem is self.weighted and system.blocks is self.blocks
        return system if fits and np.array_equal(system.gauge.orthonormal, gauge.orthonormal) else None

    @property
    def chi2(self):
        """Weighted squares of the used residuals."""
        return self.blocks.chi2

    @cached_property
    def effective_modes(self):
        """Number of modes of its own, both axes, that the data determine in every exposure, shape (n_exposures,)."""
        return effective_modes.effective_modes(self.problem, self.result.gauge, self.uncertainty)

    @cached_property
    def dof(self):
        """Degrees of freedom: the directions fixed by the gauge are no unknowns, and a prior does part of the work."""
        problem = self.problem
        n_free = elimination.star_freedom(self.weighted, self.blocks) + self.effective_modes.sum()
        n_free += self.shared_unknowns + (0.0 if self.result.gauge.tie is None else self.result.gauge.tie.freedom)
        if problem.unknowns.shared:
            priors = problem, replace(problem, static_covariance=None)
            by_prior, by_widths = (effective_modes.done_by_prior(p, self.uncertainty).sum() for p in priors)
            n_free += problem.unknowns.n_common - self.result.n_weak - (by_prior - by_widths)
        return round(float(2 * np.count_nonzero(self.used) - n_free), 6)


def estimate(matches, options, **how):
    """The fit (`Fit`) with some `SolveOptions`; with widths from the exposures where the prior asks for them.

    `how` is what `minimise` takes beside, where no widths are sought.
    """
    prior = options.prior
    if not prior_widths.sought(prior):
        return minimise(matches, options, **how)
    unit = np.hypot(np.sqrt(np.median(matches.observations.covariance[:, :2])), options.error_floor)
    fit, widths = prior_widths.find_widths(
        # with the small widths of the first fits an exposure may seem to contradict the others, and does not
        lambda resolved: minimise(matches, replace(options, prior=resolved), judged=False),
        prior,
        options.degree if options.own_degree is None else options.own_degree,
        unit,
        scale=options.errors == "scale",
    )
    if fit.unfollowed:
        fit = minimise(matches, fit.options)
        if len(fit.matches.names) < len(matches.names):
            return estimate(fit.matches, options)
    if np.mean(fit.used) < 1 - clipping.USUAL and (plain := _with_plain_widths(matches, options)):
        return plain
    if not widths.have_settled:
        fit = replace(fit, result=replace(fit.result, status=f"{fit.result.status}; widths of the prior not"))
    return _about_their_static(replace(fit, widths=widths))


def _about_their_static(fit):
    """The fit with widths about the static distortion that the exposures show, where no mean of a prior is stated.

    About none they would have its size, and exposures would be drawn to nothing by so much.
    """
    prior, options = fit.widths.priors[0], fit.options
    stated = prior.states_mean or isinstance(options.prior, dict)
    if stated or options.errors == "scale":  # which the widths were found beside
        return fit
    weight = fit.weighted.weight
    problem = replace(_problem(fit.matches, options), prior_sigma=None, weight=weight)
    if fit.matches.camera.has_focal_plane or not most_probable.is_possible(problem):
        return fit
    common = {"loss": options.loss, "max_iterations": options.max_iterations}
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning), contextlib.suppress(SolveError):
        found = most_probable.most_probable(problem, _padded(fit.result.state, problem))
        whole = found.posed(problem)
        held = minimisers.solve_joint(whole, found.state, hold=True, **common)
        if found.converged and held.converged:
            sizes = found.posterior.sizes[: fit.widths.values.shape[1]]
            widths = replace(fit.widths, values=sizes[None])
            whole = replace(whole, weight=fit.problem.weight)
            return replace(fit, problem=whole, result=_as_known(held, found, widths=True), widths=widths)
    return fit


def _with_plain_widths(matches, options):
    """The fit to all observations with the widths that they determine; None unless chance explains its residuals.

    With the small widths that a search begins with, good observations of few stars may seem to deviate, and widths
    without these stay small.
    """
    explained = None
    with warnings.catch_warnings(record=True, action="always") as caught, contextlib.suppress(SolveError):
        fit = estimate(matches, replace(options, clip=None))
        if clipping.is_explained(fit.problem, fit.result, clip=options.clip):
            explained = replace(fit, options=replace(fit.options, clip=options.clip))
    for warning in caught if explained else ():
        warn(warning.message, warning.category)
    return explained


def minimise(matches, options, *, judged=True, near=None, trial=False):
    """Minimise; exposures that contradict the others are left out, with the reason, and the rest is solved again.

    With ``clip`` the fit is a plain one as long as chance explains what it leaves. Exposures that the fit cannot follow
    stay in one that is not `judged`. It begins at the fit `near`, whatever its degree, if that is one to the same
    matches. One on `trial` is for comparison with others, of which `near` is one: `TRIAL` is accurate enough, so that
    `near` serves as the plain fit of the same degree, and where it explains the observations its plane is kept.
    """
    problem = _problem(matches, options)
    nominal = np.stack([matches.poses[name] for name in matches.names])
    near_by = near is not None and near.matches is matches and near.result.converged
    if near_by:
        shared = min(problem.n_modes, near.problem.n_modes)
        start, typical = _padded(near.result.state, problem, shared), np.zeros(problem.n_exposures)
    else:
        start, typical = start_values.start(problem, nominal, robust=options.loss != "linear")
    everything = np.ones(problem.xy.shape[1], dtype=bool)
    common = {"loss": options.loss, "max_iterations": options.max_iterations}
    problem, start = _with_shown(problem, start, common)
    if options.clip is None:
        if options.loss != "linear" and (lost := _misplaced(problem, typical)):
            return minimise(matches.without(lost), options, judged=judged)
        if trial:
            common |= {"tolerance": TRIAL, "settled": near_by and near.chi2 < EXPLAINED * problem.xy.size}
        result = minimisers.solve_joint(problem, start, **common)
        problem, result, _ = _unbent(matches, problem, start, result, common)
        return Fit(matches, problem, result, everything, options).with_higher_errors()
    if start_values.far_off(problem, typical).any() and (astray := agreement.astray(problem)):
        return minimise(matches.without(astray), options, judged=judged)
    as_near = trial and near_by and (near.options.degree, near.options.clip) == (options.degree, None)
    if as_near:  # with the plane held where all is most probable it is no plain fit, and may have more modes
        as_near = near.problem.centre is None
    plain = near.result if as_near else _plain(problem, start, common)
    given = problem
    problem, plain, near, explained = _first(matches, given, start, plain, common, options.clip)
    if explained:
        return Fit(matches, problem, plain, everything, options).with_higher_errors()
    if near is None:
        near, typical = start_values.start(problem, nominal, robust=True)
        if lost := _misplaced(problem, typical):
            return minimise(matches.without(lost), options, judged=judged)
    how = {"clip": options.clip, "hold": problem is not given}
    result, used, unfollowed = clipping.solve_clipped(problem, near, plain=plain, **how, **common)
    if unfollowed and not judged and plain is not None:
        return Fit(matches, problem, plain, everything, options, unfollowed=unfollowed)
    if unfollowed:
        _check_majority(matches, options, unfollowed)
    if lost := unfollowed or agreement.starved(problem, used):
        return minimise(matches.without(lost), options, judged=judged)
    if result is not plain:
        kept = given.scaled(used)
        problem, result, _ = _unbent(matches, kept, near, result, common, or_else=problem, clip=options.clip)
        problem = replace(problem, weight=given.weight)
    fit = Fit(matches, problem, result, used, options).with_higher_errors()
    if plain is not None and plain.converged and not used.all() and fit.dof < 1:  # nothing tells what is wrong then
        return Fit(matches, problem, plain, everything, options)
    if result is plain and not plain.converged:
        warn(plain.status, ConvergenceWarning)
    return fit


def _problem(matches, options):
    """The `Problem` of some matches with some `SolveOptions`."""
    return build_problem(
        matches,
        options.degree,
        prior=options.prior,
        error_floor=options.error_floor,
        own_degree=options.own_degree,
        motion=star_motions.terms_of(options),
        night_sigma=options.night_sigma,
    )


def _with_shown(problem, start, common):
    """The problem in which a shared distortion that exposures determine badly is free as far as residuals show it.

    And chance explains about what this leaves of them: else they show something else. With where a fit of it ended.
    """
    plain = _plain(problem, start, common) if problem.unknowns.shared else None
    start = start if plain is None else plain.state
    while plain is not None and plain.n_weak:
        system = plain.system or Uncertainty(problem.scaled(plain.robust), plain.blocks, plain.gauge).system
        if system.shown is None:
            break
        freer = replace(problem, weak=_FREER * system.shown)
        plain = _plain(freer, plain.state, common)
        if plain is None or not plain.converged or plain.blocks.chi2 > EXPLAINED * plain.blocks.residual.size:
            break
        problem, start = freer, plain.state
    return problem, start


def _plain(problem, start, common):
    """The fit of all observations; None where it has no answer, as with gross errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a warning follows if it is the result
        try:
            return minimisers.solve_joint(problem, start, **common)
        except SolveError as error:
            log.debug("the plain fit failed: %s", error)
            return None


def _first(matches, given, start, plain, common, clip):
    """The problem, the fit to all observations, where a robust one may begin, and whether chance explains the fit.

    The fit and the beginning are None where there is none.
    """
    problem, near = given, None
    explained = plain is not None and clipping.is_explained(problem, plain, clip=clip)
    if plain is not None and not explained:
        near = clipping.start_from(problem, plain)
        if near is None or clipping.is_misfit(problem, plain):
            problem, plain, found = _unbent(matches, given, start, plain, common, loss="cauchy")
            near = near if problem is given else found
            explained = plain is not None and clipping.is_explained(problem, plain, clip=clip)
    if not explained:
        return problem, plain, near, False
    problem, plain, _ = _unbent(matches, given, start, plain, common, or_else=problem, clip=clip)
    return problem, plain, near, True


def _unbent(matches, problem, start, result, common, *, loss="linear", or_else=None, clip=None):
    """Problem, fit and start of another with the plane where all that is known is most probable.

    Where distortions are large, a plane that a convention holds keeps the data from their minimum. The problem has what
    was found of the scatter of exposures and of what they have in common. If this is no better, or does not count, the
    result is the one given, with the problem that it solves (`or_else`). With a robust loss it is a beginning, and the
    fit may be None.
    """
    before = problem if or_else is None else or_else
    begun = before.centre is not None
    if begun and not most_probable.counts(problem, result.state, SHOWN):  # of what is used now alone
        again = minimisers.solve_joint(problem, _padded(result.state, problem), **common)
        if clipping.is_explained(problem, again, clip=clip):
            return problem, again, start
    plain = loss == "linear" and not begun
    misfit = plain and clipping.is_misfit(problem, result) and not most_probable.counts(problem, result.state, SHOWN)
    shown = SHOWN if plain and not misfit else SHOWN_BY_MISFIT
    # the detectors of a camera have statics of theirs
    if matches.camera.has_focal_plane or not most_probable.counts(problem, result.state, shown):
        return before, result, start
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning), contextlib.suppress(SolveError):
        # the fit with its plane elsewhere is nearer, unless gross errors moved it
        near = _padded(result.state if result.converged and loss == "linear" else start, problem)
        found = most_probable.most_probable(problem.scaled(result.robust), near, loss=loss)
        whole, held = found.posed(problem), None
        with contextlib.suppress(*[SolveError] * (loss != "linear")):  # gross errors may spoil it
            held = minimisers.solve_joint(whole, found.state, hold=True, **common)
        if loss != "linear":
            better = _typical(problem, found.blocks) < _typical(problem, result.blocks)
        else:
            was = criterion.linearise(whole, _padded(result.state, whole))
            better = held.converged and held.blocks.cost < was.cost
            better &= not misfit or is_noise(found)  # else the misfit has another cause
        if better and held is not None:
            widths = any(problem.has_widths(i) for i in range(problem.n_exposures))  # those that were given
            held = _as_known(held, found, widths=widths)
        if better:
            return whole, held, found.state
    return before, result, start


def _as_known(held, found, *, widths):
    """The `Result` of a fit with the plane held at the minimum of all that is known, with its errors there.

    `widths`: exposures have those of a prior.
    """
    positions = held.state.positions.T[elimination.typical_stars(held.blocks.v)]
    known = {"held": found.known.problem.terms.is_held}
    gauge = known_maps.as_in_posterior(held.gauge, found.blocks.unknowns, positions, *found.covariances(), **known)
    return replace(held, gauge=replace(gauge, prior=widths), higher=found.higher_covariance)


def _typical(problem, blocks):
    """Median of the squared residuals in standard errors."""
    return np.median(criterion.squares(problem, blocks.residual))


def _padded(state, problem, n=None):
    """A state with the modes of a problem: its own first n, by default all it has, then those of the prior mean."""
    coefficients, own = problem.prior_mean.copy(), state.coefficients[:, :, :n]
    k = min(own.shape[2], coefficients.shape[2])
    coefficients[:, :, :k] = own[:, :, :k]
    return replace(state, coefficients=coefficients)


def _misplaced(problem, typical):
    reason = "its stars lie nowhere near where the other exposures put them (mismatched, or not this field?)"
    return {problem.names[i]: reason for i in np.flatnonzero(start_values.misplaced(problem, typical))}


def _check_majority(matches, options, unfollowed):
    """Raise `SolveError` unless more exposures agree than contradict them with one voice."""
    group = [name for name in matches.names if name not in unfollowed]
    enough = len(group) >= agreement.FEWEST
    if enough and len(group) <= len(unfollowed):  # only then can these be as many
        with contextlib.suppress(LegdistortError), warnings.catch_warnings(action="ignore"):
            others = minimise(matches.without(dict.fromkeys(group, "")), options)
            enough = len(others.matches.names) < len(group)
    if not enough:
        raise SolveError(agreement.contradiction(group, list(unfollowed)))


def estimate_with_floor(matches, fit, options):
    """The fit whose error floor makes chi2 its degrees of freedom, to `_EQUAL`.

    The floor that does so for the residuals of one fit is the floor of the next: they hardly change with the weights.
    """
    for _ in range(_REFITS):
        if fit.dof <= 0 or fit.chi2 <= 0 or abs(np.log(fit.chi2 / fit.dof)) < _EQUAL:
            break
        floor = _floor(fit)
        if floor == fit.options.error_floor:
            break
        fit = estimate(matches, replace(options, errors="stated", error_floor=floor))
    return fit


def _floor(fit):
    """The error floor with which chi2 of the residuals of a fit, as they are, is its degrees of freedom; or 0."""
    obs, problem = fit.matches.observations, fit.problem
    x, y = fit.blocks.residual[:, fit.used]
    a, b, c = obs.covariance[problem.order][fit.used].T

    def excess(log_floor):
        p, q = a + np.exp(2 * log_floor), b + np.exp(2 * log_floor)
        return np.log(np.sum((q * x**2 + p * y**2 - 2 * c * x * y) / (p * q - c**2)) / fit.dof)

    high = np.log(4 * np.sqrt(np.mean(x**2 + y**2)))
    low = high - 12  # a floor of 1e-5 of the residuals is none
    if not excess(low) > 0:
        return 0.0
    return float(np.exp(brentq(excess, low, high, xtol=1e-4) if excess(high) < 0 else high))
