"""A converged solution with what a reference catalogue knows of its stars.

The shift, rotation and scale by the reference move positions and poses exactly; the other modes of a common map by the
reference become the value at which the constraints of the gauge are held.

The reference is a prior on the stars that it has: on positions and, where they are fitted, motions and parallaxes, with
their full covariance. It comes in two steps that are the posterior together, so that nothing counts
twice: the common maps g from the offsets of the reference, all else integrated out, p(g | data, reference); then the
stars with these maps held, p(stars | g, data, reference), in which the reference stands in the normal equations of its
stars. The covariance is that of the second step and, through the directions in which the stars follow g, that of g.
Static distortions of detectors, which change with g beyond first order, are found with it before (`Joining`).
"""

import logging
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from ..exceptions import AssumptionWarning, InputError, SolveError, some_of, warn
from ..geometry import similarity
from ..matching.cross_identification import identify
from ..results.diagnostics import UsedReference
from ..results.errors.absolute_errors import plain_directions, variances
from ..results.errors.catalogue_tie import HARMLESS
from . import minimisers
from .equations import criterion, elimination
from .equations.covariances import Uncertainty
from .equations.problem import State
from .equations.star_terms import StarPrior, packed, unpacked
from .gauge import bent_reference, catalogue_map, catalogue_motions, hierarchy
from .gauge.catalogue_agreement import agreement
from .gauge.catalogue_stars import Joining, offered
from .gauge.moved_fields import centred, moved_by, poses_of, similarities

log = logging.getLogger(__name__)

_ROUNDS = 10
#: The plane is settled when it would move by less than this part of its error, rms over the stars.
_SETTLED = 0.01
_TINY = 1e-9  # pixels: an error that is none
#: Offsets larger than expected by this factor in chi2 raise a warning.
_LARGE = 2.0
#: ... and this one means that stars that move were elsewhere when the reference was made.
_ELSEWHERE = 25.0
#: A map moves the solution to first order; what is left comes from another round.
_MAP_ROUNDS = 2
#: Factor on chi2 by which no map moves exposures whose detectors were fitted to the reference.
_SPOILT = 3.0
#: Modes of maps from which stars are held: of fewer, shear is one that exposures determine by themselves.
FEWEST_MODES = 3


@dataclass(frozen=True, eq=False, repr=False)
class ReferenceTie:
    """What is needed to tie a solution.

    Attributes
    ----------
    identified : `legdistort.matching.cross_identification.Identified`
        Those stars alone whose motions the exposures determine, where stars move.
    others : `legdistort.matching.cross_identification.Identified`
        The others, which determine nothing of common maps.
    label : str
        How messages call the reference.
    names : ndarray, shape (n_stars,)
    scale : float
        Factor on the stated errors of the exposures.
    solve : callable
        ``solve(problem, state, common=None)``: `legdistort.solving.minimisers.solve_joint` with the options of the fit.
    common : dict
        Errors that stars have in common, as `Uncertainty` takes them.
    finds_errors : bool
        Whether the errors of the reference are found, its own only those of stars relative to others.
    degree : int
        Of a map that belongs to the reference alone; 0 for none.
    joined : bool
        Whether the camera was fitted to the reference too (`Joining`).
    """

    identified: object
    others: object
    label: str
    names: np.ndarray
    scale: float
    solve: object
    common: dict
    finds_errors: bool = False
    degree: int = 0
    joined: bool = False

    def tie(self, problem, result):
        """The `Result` with the plane where the reference puts it and the `Tie` in its gauge, and the `MapPrior` there.

        First the problem that it solves, last what has no map of its own any more of this `ReferenceTie`.

        Parameters
        ----------
        problem : Problem
            With the weights of the used observations, those of the loss aside.
        result : Result
            Converged, without the reference.

        Raises
        ------
        InputError
            If most of the reference stars lie elsewhere, or, where stars move, those of a reference without motions.
        """
        status, first = result.status, self._rough(problem, result.state)
        if first is not None:
            result = self.solve(problem, moved_by(problem, result.state, first))
        prior, made, rest, unsettled = None, None, "", 0.0
        for count in range(_ROUNDS):
            if count < 2:  # afterwards the plane moves too little for another
                errors = self._errors(problem, result)
                directions = self._directions(result.gauge, errors, result.state.positions.T)
                prior = self._prior(result, directions) if prior is None else prior
            equations = self._equations(result, directions, errors, prior)
            equations, step, made = self._estimate(equations, near=None if made is None else made.used)
            moved, error = self._move(directions, step, made)
            if count and moved < max(_SETTLED * error, 1e-8):
                break
            similar = prior.modes.similar
            shift = similar.T @ (similar @ step)
            step = step - shift
            prior = replace(prior, centre=prior.centre - step)
            state = moved_by(problem, result.state, poses_of(result.gauge, shift))
            common = _common(problem, result, step)
            if common is None:
                result = replace(result, state=state, blocks=criterion.linearise(problem.scaled(result.robust), state))
            elif problem.terms.n:  # what changes with time stays where it is
                gauge = result.gauge
                step = np.pad(step, (0, len(gauge.drift.covariance)))
                problem, state = _drifted(problem, replace(result, state=state), step)
                result = self._kept(self.solve(problem, state, hold=True), gauge)
            else:
                problem = centred(problem, result.gauge, step)
                before, result = result.blocks.chi2, self.solve(problem, state, common=common)
                self._check_step(problem, before, result)
        else:
            log.warning(
                "the tie to %s is not settled after %d rounds: the last of them moved the plane by %.2g px rms, where "
                "its error is %.2g px: %s",
                *(self.label, _ROUNDS, moved, error),
                "too little to matter"
                if moved < HARMLESS * error
                else "absolute positions may be off by as much; look for mismatched stars, or give a prior",
            )
            rest, unsettled = ", not settled", float(moved / max(error, _TINY))
        made = replace(made, unsettled=unsettled, moves=self.identified.maps is not None, labels=self.identified.names)
        identified, made = bent_reference.straightened(self.identified, equations, made, result, self.degree)
        straight = replace(self, identified=identified)
        common, open_maps = straight._of_reference(result.gauge, prior.n_modes, result.state.positions.T)
        made = replace(made, covariance=made.covariance + common @ common.T)
        unknown = np.hstack([equations.determined(made.used)[2], open_maps])
        unknown = hierarchy.named(unknown, result.gauge, result.state.positions.T)
        made = replace(made, agreement=self._agreement(problem, result, equations, made))
        self._warn(made)
        log.info("%s", made.sentence)
        if result.converged:
            result = replace(result, status=f"{status}, tied to the reference in {count + 1} rounds{rest}")
        return problem, replace(result, gauge=replace(result.gauge, tie=made, unknown_maps=unknown)), prior, straight

    def _check_step(self, problem, before, result):
        """Raise `SolveError` where a step of the map has spoilt exposures of fewer stars than modes."""
        if not self.joined or result.blocks.chi2 < _SPOILT * max(before, problem.xy.size):
            return
        n_stars = np.array([np.count_nonzero(problem.weight[0, problem.part(i)]) for i in range(problem.n_exposures)])
        few = [problem.names[i] for i in np.flatnonzero(n_stars < problem.n_modes)]
        if few:
            words = f"{some_of(few, 4)} have too few stars for their distortions where {self.label} puts the plane"
            raise SolveError(words, exposures=few)

    def _agreement(self, problem, result, equations, made):
        """The `Agreement` of the reference with everything else."""
        if problem.terms.n and self.identified.motion is None and made.ratio > _ELSEWHERE:
            raise InputError(
                f"the stars of {self.label}, which has no proper motions, are off by {np.sqrt(made.ratio):.0f} times "
                f"the errors of both at {problem.terms.epoch:.2f}, the epoch of the positions: give the year that they "
                "belong to as column ref_epoch, or their proper motions"
            )
        motions = None if self.identified.motion is None else self.identified.motion[:, :2]
        as_stated = self.finds_errors or made.factor == 1
        stated = equations if as_stated else equations.times(1 / made.factor)
        agrees = agreement(equations, stated, made.used, motions)
        may_be_bent = self.identified.maps is None and not (self.finds_errors or problem.terms.n)
        if not may_be_bent or bent_reference.is_as_stated(made, agrees):
            return agrees
        cure = bent_reference.cure(stated, self._estimate, result, self.identified, self.degree, problem.degree)
        return replace(agrees, **cure)

    def hold_stars(self, problem, result, prior):
        """The `Problem` and the `Result` with the stars of the reference at their values in it.

        Parameters
        ----------
        problem : Problem
        result : Result
            Of `tie`.
        prior : `legdistort.solving.gauge.catalogue_map.MapPrior`
            Of the common map, at this result.

        Raises
        ------
        InputError
            Where stars move: at degree 0, and if most motions deviate.
        """
        gauge, status = result.gauge, result.status
        values, covariance = offered(self.identified, problem.terms.n, gauge.tie.factor)
        used, joint, map_covariance = gauge.tie.used, None, gauge.tie.covariance
        if problem.terms.n:
            problem, result, used, joint = self._drifts_tied(problem, result, prior, values, covariance)
            map_covariance = joint[: 2 * gauge.n_modes, : 2 * gauge.n_modes]
        log.info("stars are held at what %s knows of %d of them", self.label, np.count_nonzero(used))
        rows = self.identified.rows
        offsets = self.identified.xy - result.state.positions.T[rows]
        more, more_covariance = offered(self.others, problem.terms.n, gauge.tie.factor)
        catalogue = StarPrior.of(
            len(self.names),
            np.concatenate([rows[used], self.others.rows]),
            np.concatenate([values[used], more]),
            np.concatenate([covariance[used], more_covariance]) / self.scale**2,
        )
        problem = replace(problem, moving=replace(problem.terms, catalogue=catalogue))
        result = self._kept(self.solve(problem, result.state, hold=True), gauge)
        known = {"known": covariance[:, :2, :2], "shared": 0 * gauge.tie.shared}
        tie = replace(gauge.tie, covariance=map_covariance, offsets=offsets, used=used, **known)
        drift = gauge.drift
        if joint is not None:
            n_tied = int(np.count_nonzero(np.isfinite(values[used, 2])))
            parallax = values.shape[1] > 4 and bool(np.isfinite(values[used, 4]).any())
            drift = result.gauge.drift.tied(joint, n_tied, parallax)
        result = replace(result, gauge=replace(result.gauge, tie=tie, drift=drift))
        return problem, replace(result, status=status if result.converged else result.status)

    def _drifts_tied(self, problem, result, prior, values, covariance):
        """Problem and result with the plane, and what changes it with time, where positions and motions put it.

        With the stars that agree, and the covariance (2 n_modes + q,) squared of all these maps.
        """
        gauge = result.gauge
        if gauge.n_modes < FEWEST_MODES:
            raise InputError(
                f"motions are tied to {self.label} at degree 1 or more: raise the degree, or leave out one of the two"
            )
        size, before = 2 * gauge.n_modes, gauge.drift
        information = block_diag(prior.information, catalogue_motions.drift_information(before))
        centre = np.concatenate([prior.centre, np.zeros(len(before.covariance))])
        used, step = gauge.tie.used, np.zeros(len(centre))
        if np.isfinite(values[used, 2:4]).all(axis=1).any():
            rates, used = self._rates(problem, result, values, covariance)
            step[size : 2 * size] = rates
        for _ in range(_MAP_ROUNDS):
            problem, state = _drifted(problem, result, step)
            centre = centre - step
            result = self._kept(self.solve(problem, state, hold=True), gauge)
            step, joint = self._whole_map(problem, result, values, covariance, used, information, centre)
        problem, state = _drifted(problem, result, step)
        return problem, replace(result, state=state), used, joint

    def _estimate(self, equations, near):
        """Equations with errors of the reference as they turn out, the map that these give, and the `Tie`."""
        used = catalogue_map.accepted(equations, self.label, near, found=self.finds_errors)
        step, made, dof = catalogue_map.estimate(equations, used, self.names)
        factor = catalogue_map.error_factor(equations, used, made.ratio, dof, found=self.finds_errors)
        if factor != 1:
            equations = equations.times(factor)
            step, again, _ = catalogue_map.estimate(equations, used, self.names)
            said = {"found": True} if self.finds_errors else {"ratio": made.ratio}
            made = replace(again, factor=factor, **said)
        return equations, step, made

    @staticmethod
    def _kept(result, gauge):
        """A result with what an earlier `gauge` knew of common maps."""
        kept = {"tie": gauge.tie, "unknown_maps": gauge.unknown_maps}
        if gauge.drift is not None:
            known = {"covariance": gauge.drift.covariance, "held": gauge.drift.held}
            kept["drift"] = replace(result.gauge.drift, **known)
        return replace(result, gauge=replace(result.gauge, **kept))

    def _rates(self, problem, result, values, covariance):
        """A map (2 n_modes,) of the motions to those of the reference, and the stars that agree with it."""
        gauge, rows = result.gauge, self.identified.rows
        own = unpacked(self._errors(problem, result).star_unknowns)[rows][:, 2:4, 2:4]
        offsets, both = values[:, 2:4] - result.state.stars[2:4].T[rows], own + covariance[:, 2:4, 2:4]
        seen = gauge.tie.used & np.isfinite(offsets).all(axis=1) & np.isfinite(both).all(axis=(1, 2))
        modes = gauge.modes_at(result.state.positions.T[rows[seen]])
        rates, good, scale = catalogue_motions.accepted(offsets[seen], both[seen], modes, gauge.drift, label=self.label)
        if scale > np.sqrt(_LARGE):
            warn(
                f"the proper motions of {self.label} differ from those of the stars by {scale:.1f} times what the "
                "errors of both imply; the absolute errors of motions rest on the stated ones",
                AssumptionWarning,
            )
        used = gauge.tie.used.copy()
        used[seen] = good
        return rates, used

    def _whole_map(self, problem, result, values, covariance, used, information, centre):
        """By how much the common map and those that change with time are off, and their covariance."""
        gauge, rows = result.gauge, self.identified.rows
        tied = replace(gauge.drift, n_tied=1)
        errors = self._errors(problem, replace(result, gauge=replace(gauge, tie=None, drift=tied)))
        directions = errors.drift_directions
        own = unpacked(errors.star_unknowns)
        seen = used & np.isfinite(own[rows]).all(axis=(1, 2))
        stars, size = rows[seen], 2 * gauge.n_modes
        equations = self._equations(result, errors.directions, errors, self._prior(result, errors.directions))
        return catalogue_motions.estimate(
            values[seen] - result.state.stars.T[stars],
            errors.covariance_between(stars, len(own[0])) if len(stars) <= catalogue_map.DENSE else own[stars],
            covariance[seen],
            directions[stars],
            maps=np.linalg.qr(equations.determined(used)[0])[0][:size],
            drift=gauge.drift,
            information=information,
            centre=centre,
        )

    def _warn(self, made):
        """Warn of what makes the absolute errors too small."""
        if not self.finds_errors and made.factor > 1 and made.ratio > _LARGE:
            warn(
                f"the offsets of the stars from {self.label} are {np.sqrt(made.ratio):.1f} times larger than the "
                "errors of both imply: errors stated too small, motions left out, or a static distortion that the "
                f"exposures cannot compensate; the errors of the reference are taken {made.factor:.2g} times as large",
                AssumptionWarning,
            )

    def _rough(self, problem, state):
        """Similarities (n_fields, 2, 3) of the fields to the reference, gross errors left aside; None if tiny."""
        rows = self.identified.rows
        poses = similarities(problem, rows, state.positions.T[rows], self.identified.xy, self.label)
        move = np.abs(similarity.apply_each(poses[problem.field_of_stars], state.positions.T) - state.positions.T).max()
        log.debug("first similarity of the tie: %.3g px", move)
        return poses if move > 1e-3 else None

    def _errors(self, problem, result):
        weighted = problem.scaled(result.robust)
        blocks = criterion.linearise(weighted, result.state)
        return Uncertainty(weighted, blocks, result.gauge, scale=self.scale, **self.common)

    def _directions(self, gauge, errors, positions):
        """How maps of three modes at least move the stars."""
        if gauge.n_modes >= FEWEST_MODES:
            return errors.directions
        return plain_directions(gauge, positions, FEWEST_MODES)

    def _of_reference(self, gauge, k, positions):
        """Maps of k modes that the positions of the reference have in common, and unknown ones, as columns (2 k, m)."""
        if self.identified.maps is None:
            return np.zeros((2, 2 * k, 0))
        fit = np.linalg.pinv(gauge.modes_at(positions[self.identified.rows], k).T)
        each = self.identified.maps, self.identified.unknown
        return [np.einsum("kn,nam->akm", fit, fields).reshape(2 * k, -1) for fields in each]

    def _prior(self, result, directions):
        """What is known beforehand of the common map by which this plane and that of the reference differ."""
        gauge = result.gauge
        n, k = gauge.n_modes, directions.shape[2] // 2
        covariance = np.zeros((2, k, 2, k))
        covariance[:, :n, :, :n] = gauge.covariance.reshape(2, n, 2, n)
        maps = np.zeros((2, k, len(gauge.unknown_maps)))
        for j, each in enumerate(gauge.unknown_maps):
            maps[:, :n, j] = each.map.reshape(2, n)
        common, unknown = self._of_reference(gauge, k, result.state.positions.T)
        covariance = covariance.reshape(2 * k, -1) + common @ common.T
        maps = np.hstack([maps.reshape(2 * k, -1), unknown])
        return catalogue_map.map_prior(covariance, maps, directions, gauge.plane_modes(k))

    def _equations(self, result, directions, errors, prior):
        positions = result.state.positions.T
        offsets = catalogue_map.Offsets(
            self.identified.rows,
            self.identified.xy - positions[self.identified.rows],
            self.identified.covariance[:, :2, :2],
        )
        relative = errors.star_matrix if len(positions) <= catalogue_map.DENSE else errors.stars
        bends = bent_reference.bends(result.gauge, positions[self.identified.rows], self.degree)
        fitted = self.common["camera"].stars[self.identified.rows, :2] if self.joined else None
        return catalogue_map.MapEquations(offsets, directions, relative, prior, bends, fitted)

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


def _solved(before, problem, state, **how):
    """The `Result` of a minimisation; what a camera told of common maps `before`, a gauge, is kept."""
    result = minimisers.solve_joint(problem, state, **how)
    known = {name: getattr(before, name) for name in ("covariance", "unknown_maps") if problem.floats}
    return replace(result, gauge=replace(result.gauge, **known))


def _drifted(problem, result, step):
    """The `Problem` and the `State` moved by maps (2 n_modes + q,), those that change with time too, to first order."""
    gauge, state = result.gauge, result.state
    moved = step.reshape(-1, gauge.n_modes) @ gauge.modes_at(state.positions.T)
    coefficients = state.coefficients.copy()
    change = gauge.all_motion @ step
    coefficients[:, :, : gauge.n_modes] -= change.reshape(len(change), 2, -1)
    terms = problem.terms
    if terms.is_held:
        mean = np.zeros((terms.n, problem.n_stars)) + terms.mean
        problem = replace(problem, moving=replace(terms, mean=mean + moved[2:]))
    return centred(problem, gauge, step), State(state.stars + moved, coefficients, state.poses)


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
    there = reference.at(epoch, moving=fit.problem.terms.n > 0)
    identified = _identified(fit, there, pixel_scale)
    lost = len(reference) - len(there)
    why = f"; {lost} are left out: they have no proper motion with errors to take them to {epoch or 0:.2f}"
    missing = identified.missing if fit.problem.n_fields == 1 else ()
    told = (
        f"; {len(missing)} more lie among them and are not found, too faint or in fewer exposures than match asks for "
        f"(min_exposures): {some_of(missing, 6)}"
    ) * bool(missing)
    log.info(
        "%d of the %d stars of %s are in the exposures%s%s",
        len(identified.rows), len(reference), reference.label, told, why * bool(lost),
    )  # fmt: skip
    of = fit.options
    known = np.all(elimination.inverse_star_blocks(fit.blocks.v)[np.diag(packed(fit.problem.n_star))] > 0, axis=0)
    bent_reference.check_degree(reference, len(identified.rows), fit.problem.degree)
    if not known[identified.rows].any():
        raise InputError(f"no star of {reference.label} is seen at several epochs: leave out motion, or the reference")
    tying = ReferenceTie(
        identified.subset(known[identified.rows]),
        identified.subset(~known[identified.rows]),
        reference.label,
        matches.stars,
        scale=scale,
        solve=partial(_solved, result.gauge, loss=of.loss, max_iterations=of.max_iterations),
        common={"shared_errors": fit.shared_errors, "camera": fit.camera_errors},
        finds_errors=reference.finds_errors,
        degree=reference.degree or 0,
        joined=_has_statics(fit),
    )
    problem = fit.problem.scaled(fit.used.astype(float))
    problem, result, prior, tying = tying.tie(problem, result)
    if result.gauge.n_modes >= FEWEST_MODES or problem.terms.n:
        problem, result = tying.hold_stars(problem, result, prior)
        known = {"moving": problem.moving, "centre": problem.centre}
        fit = replace(fit, problem=replace(fit.problem, **known), **_held_back(fit, problem))
    else:  # the map moves the plane alone
        result = replace(result, gauge=replace(result.gauge, tie=replace(result.gauge.tie, freedom=0.0)))
    return replace(fit, matches=replace(matches, sky=identified.sky, epoch=epoch), result=result)


def _has_statics(fit):
    """Whether a fit has static distortions of the detectors of a camera, which `Joining` ties."""
    errors = fit.camera_errors
    if errors is None or not fit.matches.camera.has_focal_plane or fit.problem.terms.n:
        return False
    return bool(errors.free[:, :, 3:].any())


def _identified(fit, reference, pixel_scale):
    """The stars of a reference that a fit has, `legdistort.matching.cross_identification.Identified`."""
    matches, places = fit.matches, np.where(fit.blocks.v[0] > 0, fit.result.state.positions, np.nan).T
    known = {"flux": matches.observations.flux, "sky": matches.sky, "pixel_scale": pixel_scale}
    try:
        return identify(reference, matches.stars, places, **known)
    except InputError as error:
        raise InputError(f"{error}{bent_reference.or_detectors(fit) if reference.star is None else ''}") from None


def ties_to(reference, **tying):
    """What ties a `Fit` to a reference, ``join(fit, statics)`` and ``tie(fit)``; None and None without one.

    `join` is a `Joining`, `tie` is `tie_to`.
    """
    if reference is None:
        return None, None
    how = {"find": _identified, "solve": minimisers.solve_joint}
    return Joining(reference, **how, **tying), partial(tie_to, reference=reference, **tying)


def _held_back(fit, problem):
    """Errors that stars have in common, by as much smaller as what is known of them holds the stars, as fields."""
    shared, camera = fit.shared_errors, fit.camera_errors
    if shared is None and camera is None:
        return {}
    own = unpacked(fit.blocks.v)
    follow = own @ np.linalg.pinv(own + unpacked(problem.terms.catalogue.precision), hermitian=True)
    follow, out = follow.transpose(0, 2, 1), {}
    if camera is not None:
        rows = camera.stars.shape[1]
        out["camera_errors"] = replace(camera, stars=follow[:, :rows, :rows] @ camera.stars)
    follow = follow[:, :2, :2]
    if shared is not None:
        out["shared_errors"] = variances(follow @ unpacked(shared) @ follow.transpose(0, 2, 1))
    return out


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
