"""A converged solution tied to a reference catalogue: its gauge alone moves, never the relative positions.

What the reference says about shift, rotation and scale moves positions and poses exactly; what it says about the other
modes of a common map becomes the value at which the constraints of the gauge are held.
"""

import logging
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..exceptions import AssumptionWarning, warn
from ..geometry import similarity
from ..geometry.detector_modes import similarity_basis
from ..geometry.similarity import robust_similarity
from ..inputs import column_contract
from ..matching.cross_identification import identify
from ..results.absolute_errors import plain_directions
from ..results.diagnostics import UsedReference
from . import minimisers
from .equations import criterion
from .equations.covariances import Uncertainty
from .equations.problem import State
from .equations.star_terms import unpacked
from .gauge import catalogue_map, catalogue_rates, hierarchy

log = logging.getLogger(__name__)

_ROUNDS = 10
#: The plane is settled when it would move by less than this part of its error, rms over the stars.
_SETTLED = 0.01
#: Not settled, but within this part of its error: absolute errors would change by 5 % at most.
_HARMLESS = 0.3
#: Offsets larger than expected by this factor in chi2 are told.
_LARGE = 2.0
#: A map of the motions of stars moves the solution to first order; what is left is told by another round.
_RATE_ROUNDS = 2


@dataclass(frozen=True, eq=False, repr=False)
class ReferenceTie:
    """What is needed to tie a solution.

    Attributes
    ----------
    identified : `legdistort.matching.cross_identification.Identified`
    label : str
        How messages call the reference.
    names : ndarray, shape (n_stars,)
    scale : float
        Factor on the stated errors of the exposures.
    solve : callable
        ``solve(problem, state, common=None)``: `legdistort.solving.minimisers.solve_joint` with the options of the fit.
    shared_errors : ndarray, optional
        See `Uncertainty`.
    """

    identified: object
    label: str
    names: np.ndarray
    scale: float
    solve: object
    shared_errors: object = None

    def tie(self, problem, result):
        """The `Result` with the plane where the reference puts it, and the `Tie` in its gauge.

        Parameters
        ----------
        problem : Problem
            With the weights of the used observations, those of the loss aside.
        result : Result
            Converged, without the reference.

        Raises
        ------
        InputError
            If most of the reference stars lie elsewhere.
        """
        status, first = result.status, self._rough(result.state)
        if first is not None:
            result = self.solve(problem, _moved(result.state, first))
        prior, rest = None, ""
        for count in range(_ROUNDS):
            if count < 2:  # afterwards the plane moves too little for another
                errors = self._errors(problem, result)
                directions = self._directions(result.gauge, errors, result.state.positions.T)
                prior = self._prior(result.gauge, directions) if prior is None else prior
            equations = self._equations(result, directions, errors, prior)
            step, made = catalogue_map.estimate(equations, catalogue_map.accepted(equations, self.label), self.names)
            moved, error = self._move(directions, step, made)
            if count and moved < max(_SETTLED * error, 1e-8):
                break
            similar = similarity_basis(prior.size, prior.n_modes)
            shift = similar.T @ (similar @ step)
            step = step - shift
            prior = replace(prior, centre=prior.centre - step)
            state = _moved(result.state, _pose(result.gauge, shift))
            common = _common(problem, result, step)
            if common is None:
                result = replace(result, state=state, blocks=criterion.linearise(problem.scaled(result.robust), state))
            else:
                result = self.solve(problem, state, common=common)
        else:
            log.warning(
                "the tie to %s is not settled after %d rounds: the last of them moved the plane by %.2g px rms, where "
                "its error is %.2g px: %s",
                *(self.label, _ROUNDS, moved, error),
                "too little to matter"
                if moved < _HARMLESS * error
                else "absolute positions may be off by as much; look for mismatched stars, or give a prior",
            )
            rest = ", not settled"
        unknown = hierarchy.named(equations.determined(made.used)[2], result.gauge, result.state.positions.T)
        self._warn(made)
        log.info("%s", made.sentence)
        if result.converged:
            result = replace(result, status=f"{status}, tied to the reference in {count + 1} rounds{rest}")
        return replace(result, gauge=replace(result.gauge, tie=made, unknown_maps=unknown))

    def tie_rates(self, problem, result):
        """The `Problem` and the `Result` with the motions of stars as those of the reference are on average.

        Motions move by a map of the reference plane, coefficients by what takes it back; the same residuals but for
        what is of second order, so that all is solved again where this leads.
        """
        gauge, rows = result.gauge, self.identified.rows
        good = np.isfinite(self.identified.motion_covariance).all(axis=(1, 2)) & result.gauge.tie.used
        size = 2 * gauge.n_modes
        centre, total = np.zeros(size), np.zeros(size)
        for _ in range(_RATE_ROUNDS):
            errors = self._errors(problem, result)
            own = unpacked(errors.star_unknowns)[rows][:, 2:4, 2:4]
            seen = good & np.isfinite(own).all(axis=(1, 2))
            positions = result.state.positions.T
            offsets = self.identified.motion - result.state.stars[2:4].T[rows]
            modes = gauge.modes_at(positions[rows[seen]])
            step, covariance, used, gain, scale = catalogue_rates.estimate(
                offsets[seen],
                (own + self.identified.motion_covariance)[seen],
                modes,
                gauge.drift,
                centre=centre - total,
                label=self.label,
            )
            total = total + step
            problem, state = _drifted(problem, result, step)
            status, result = result.status, self.solve(problem, state, hold=True)
        log.info("motions are tied to those of %d stars of %s", np.count_nonzero(used), self.label)
        if scale > np.sqrt(_LARGE):
            warn(
                f"the proper motions of {self.label} differ from those of the stars by {scale:.1f} times what the "
                "errors of both say; the absolute errors of motions rest on the stated ones",
                AssumptionWarning,
            )
        design = np.kron(np.eye(2), modes.T).reshape(2, -1, len(step)).transpose(1, 0, 2)
        follows = own[seen] @ gain.transpose(0, 2, 1) @ design.transpose(0, 2, 1)
        shared = np.zeros((2, 2, len(self.names)))
        shared[:, :, rows[seen]] = -np.moveaxis(follows + follows.transpose(0, 2, 1), 0, -1)
        drift = result.gauge.drift.tied(covariance, int(np.count_nonzero(used)), shared)
        tied = replace(result.gauge, tie=gauge.tie, unknown_maps=gauge.unknown_maps, drift=drift)
        result = replace(result, gauge=tied, status=status if result.converged else result.status)
        return problem, self._tied_anew(problem, result)

    def _tied_anew(self, problem, result):
        """The same with the `Tie` of a solution that has changed a little since it was made."""
        errors = self._errors(problem, result)
        directions = self._directions(result.gauge, errors, result.state.positions.T)
        equations = self._equations(result, directions, errors, self._prior(result.gauge, directions))
        _, made = catalogue_map.estimate(equations, result.gauge.tie.used, self.names)
        return replace(result, gauge=replace(result.gauge, tie=made))

    def _warn(self, made):
        """Tell what makes the absolute errors too small."""
        n = np.count_nonzero(made.used)
        if made.ratio > _LARGE and made.ratio > 1 + 6 * np.sqrt(1 / n):
            warn(
                f"the offsets of the stars from {self.label} are {np.sqrt(made.ratio):.1f} times larger than the "
                "errors of both say: errors stated too small, motions left out, or a static distortion that the "
                "exposures do not take back; the absolute errors rest on the stated ones",
                AssumptionWarning,
            )

    def _rough(self, state):
        """Shift, rotation and scale from the solution to the reference, gross errors left aside; None if tiny."""
        source, target = state.positions.T[self.identified.rows], self.identified.xy
        if len(source) == 1:
            pose = np.column_stack([np.eye(2), (target - source)[0]])
        elif len(source) == 2:
            pose = similarity.fit_similarity(source, target, parity=1)
        else:
            pose = robust_similarity(source, target)
        move = np.abs(similarity.apply(pose, state.positions.T) - state.positions.T)
        log.debug("first similarity of the tie: %.3g px", move.max())
        return pose if move.max() > 1e-3 else None

    def _errors(self, problem, result):
        weighted = problem.scaled(result.robust)
        blocks = criterion.linearise(weighted, result.state)
        return Uncertainty(weighted, blocks, result.gauge, scale=self.scale, shared_errors=self.shared_errors)

    def _directions(self, gauge, errors, positions):
        """How maps of three modes at least move the stars."""
        if gauge.n_modes >= 3:
            return errors.directions
        return plain_directions(gauge, positions, 3)

    def _prior(self, gauge, directions):
        """What is known of the common map beforehand."""
        n, k = gauge.n_modes, directions.shape[2] // 2
        covariance = np.zeros((2, k, 2, k))
        covariance[:, :n, :, :n] = gauge.covariance.reshape(2, n, 2, n)
        maps = np.zeros((2, k, len(gauge.unknown_maps)))
        for j, each in enumerate(gauge.unknown_maps):
            maps[:, :n, j] = each.map.reshape(2, n)
        return catalogue_map.map_prior(
            covariance.reshape(2 * k, -1), maps.reshape(2 * k, -1), directions, tuple(2 * gauge.box[1, ::-1])
        )

    def _equations(self, result, directions, errors, prior):
        positions = result.state.positions.T
        offsets = catalogue_map.Offsets(
            self.identified.rows,
            self.identified.xy - positions[self.identified.rows],
            self.identified.covariance,
        )
        relative = errors.star_matrix if len(positions) <= catalogue_map.DENSE else errors.stars
        return catalogue_map.MapEquations(offsets, directions, relative, prior)

    def _move(self, directions, step, made):
        """By how much a step of the map moves the plane, and the error of the plane: rms over the stars, pixels."""
        variance = np.einsum("nak,kl,nal->na", directions, made.covariance, directions, optimize=True)
        moved, error = np.sqrt(np.mean((directions @ step) ** 2)), np.sqrt(np.mean(variance))
        log.debug("the plane moves by %.2g px", moved)
        return moved, error


def _common(problem, result, step):
    """The map at which to hold the constraints: the present one and a step; None where there is nothing to hold."""
    gauge = result.gauge
    if len(step) > 2 * gauge.n_modes or problem.own_degree == 0:  # shears that are shared: rolls determine them
        return None
    departure = (result.state.coefficients - problem.prior_mean)[:, :, : gauge.n_modes]
    return gauge.common_map(departure) + step


def _drifted(problem, result, step):
    """The `Problem` and the `State` whose motions are moved by a map (2 n_modes,), to first order."""
    gauge, state = result.gauge, result.state
    modes = gauge.modes_at(state.positions.T)
    moved = step.reshape(2, -1) @ modes
    stars, coefficients = state.stars.copy(), state.coefficients.copy()
    stars[2:4] += moved
    change = gauge.drift.motion[:, :, : len(step)] @ step
    coefficients[:, :, : gauge.n_modes] -= change.reshape(len(change), 2, -1)
    terms = problem.terms
    if terms.is_held:
        mean = np.zeros((terms.n, problem.n_stars)) + terms.mean
        mean[:2] += moved
        problem = replace(problem, moving=replace(terms, mean=mean))
    return problem, State(stars, coefficients, state.poses)


def _pose(gauge, shift):
    """The similarity X -> X + phi(X) g of modes g (2 k,) without anything else, as a pose."""
    corners = gauge.box[0] + gauge.box[1] * np.array([[0.0, 0], [1, 0], [0, 1]])
    move = (shift.reshape(2, -1) @ gauge.modes_at(corners, len(shift) // 2)).T
    linear = np.eye(2) + (move[1:] - move[0]).T / gauge.box[1]
    return np.column_stack([linear, corners[0] + move[0] - linear @ corners[0]])


def _moved(state, pose):
    """The same solution in a plane moved by a pose: exactly as good."""
    back = similarity.invert(pose)
    moved = np.stack([similarity.compose(own, back) for own in state.poses])
    stars = state.stars.copy()
    stars[:2] = similarity.apply(pose, state.positions.T).T
    if len(stars) > 2:
        stars[2:4] = pose[:, :2] @ state.stars[2:4]  # motions turn with the plane
        stars[4:] *= np.sqrt(np.linalg.det(pose[:, :2]))
    return State(stars, state.coefficients, moved)


def tie_to(fit, reference, *, scale=1.0, epoch=None, pixel_scale=None):
    """A fit of `legdistort.solve` tied to a reference.

    Parameters
    ----------
    fit : `legdistort.solving.single_fit.Fit`
    reference : Reference
    scale : float
        Factor on the stated errors of the exposures.
    epoch : float, optional
        Year of the exposures, if not that of the matches.
    pixel_scale : float, optional
        Arcsec.

    Returns
    -------
    Fit
        With ``matches`` that know the sky, and the tied ``result``.

    Raises
    ------
    InputError
        See `Reference.at`, `legdistort.matching.cross_identification.identify`,
        `legdistort.solving.gauge.catalogue_map.accepted`.
    """
    matches, result = fit.matches, fit.result
    if fit.problem.terms.n:  # positions are those of this epoch, whatever the mean of the exposures is
        epoch = fit.problem.terms.epoch
    epoch = matches.epoch if epoch is None else epoch
    identified = identify(
        reference.at(epoch),
        matches.stars,
        np.where(fit.blocks.v[0] > 0, result.state.positions, np.nan).T,
        flux=_flux(matches),
        sky=matches.sky,
        pixel_scale=pixel_scale,
    )
    log.info("%d of the %d stars of %s are in the exposures", len(identified.rows), len(reference), reference.label)
    of = fit.options
    tying = ReferenceTie(
        identified,
        reference.label,
        matches.stars,
        scale=scale,
        solve=partial(minimisers.solve_joint, gauge=of.gauge, loss=of.loss, max_iterations=of.max_iterations),
        shared_errors=fit.shared_errors,
    )
    problem = fit.problem.scaled(fit.used.astype(float))
    result = tying.tie(problem, result)
    if problem.terms.n and identified.motion is not None:
        problem, result = tying.tie_rates(problem, result)
        fit = replace(fit, problem=replace(fit.problem, moving=problem.moving))
    return replace(fit, matches=replace(matches, sky=identified.sky, epoch=epoch), result=result)


def _flux(matches):
    """Mean flux of every star, or None."""
    if "flux" not in matches.table.colnames:
        return None
    star = matches.observations.star
    flux = np.nan_to_num(column_contract.values(matches.table, "flux"))
    return np.bincount(star, flux, len(matches.stars)) / np.bincount(star, minlength=len(matches.stars))


def used_reference(fit, reference):
    """The `UsedReference` of a tied fit; None where there is no reference."""
    if reference is None:
        return None
    made = fit.result.gauge.tie
    return UsedReference(
        name=reference.label.removeprefix("the reference").strip(),
        epoch=fit.matches.epoch,
        n_stars=int(np.count_nonzero(made.used)),
        rms_px=made.rms,
    )
