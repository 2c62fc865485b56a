"""What the method is compared with (Bernard et al. 2017, section 5.3): shifts, static map, relative polynomial.

Every function takes `Matches` and returns a `Solution`, whose residuals, stars and corrections are used like those of
`legdistort.solve`. Their models leave distortion in the data on purpose, so the stated errors cannot be right: all
reported errors are scaled to the residuals, and the absolute ones, ``x_err_abs`` and ``y_err_abs``, are not
available (NaN): nothing in these fits determines how far their plane is from the sky.
"""

import logging
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ..exceptions import FoldError, InputError, LegdistortError, SolveError
from ..geometry import similarity
from ..geometry.distortion import Distortion
from ..matching.matches import Matches
from ..priors.prior import means
from ..results.diagnostics import Diagnostics
from ..results.in_tables import folds
from ..results.settings import Settings
from ..solving import assembly, minimisers
from ..solving.equations import criterion
from ..solving.equations.covariances import Uncertainty
from ..solving.equations.problem import State, build_problem
from ..solving.gauge import constraints
from ..solving.single_detectors import by_detector

log = logging.getLogger(__name__)

#: Linear parts of poses that differ by less than this are the same orientation.
_SAME_ORIENTATION = 0.02
#: Name of the solution itself in a comparison.
METHOD = "all distortions solved"


def solve_shifts(matches, *, prior=None, weighted=False):
    """Shifts between exposures and nothing else; with a prior, after its static distortion was taken out.

    Rotation and scale are those of the nominal poses, averaged over the exposures of like orientation, so that none
    is fitted to single exposures.

    Parameters
    ----------
    matches : Matches
    prior : Prior or dict, optional
        Static distortion, as for `legdistort.solve`; its widths play no part.
    weighted : bool
        Weight by the stated errors; otherwise, and by default, all positions alike, because the distortion that is
        left exceeds the errors.

    Returns
    -------
    Solution
        Of degree 0, in pixels of the undistorted detector: ``settings.method`` is "shift" or "static + shift".
    """
    matches = replace(_checked(matches), poses=_without_own_turns(matches))
    prior = means(prior)
    stated = replace(build_problem(matches, 0, prior=prior), prior_sigma=None, static_covariance=None)
    problem = stated if weighted else _equal(stated)
    state = State(matches.positions.T.copy(), problem.prior_mean.copy(), _stacked(matches))
    result = minimisers.solve_joint(problem, state)
    name = "shift" if prior is None else "static + shift"
    convention = _convention(result.gauge, name, "the mean of all exposures")
    return _solution(matches, (stated, problem), result.state, convention)


def solve_relative(matches, *, degree=3, reference=None, weighted=True, error_floor=0.0):
    """A polynomial from one exposure, or from the mean of all, to every other: relative correction.

    The positions measured in the reference exposure, errors and distortion and all, are taken for the plane. The stars
    that it does not see are averaged from the others.

    Parameters
    ----------
    matches : Matches
    degree : int
        Total degree of the polynomials.
    reference : str, optional
        Exposure that serves as reference (Bernard et al. 2016: "one reference frame chosen arbitrarily"); by default
        the one with most stars. "mean" stands for a master frame: the mean of all exposures after similarities.
    weighted : bool
        Weight by the errors of both positions; otherwise all stars alike.
    error_floor : float
        Pixels, added in quadrature to every error.

    Returns
    -------
    Solution
        Errors of the coefficients include those of the reference positions, as if they were independent for every
        exposure.

    Raises
    ------
    InputError
        If there is no such exposure.
    SolveError
        Naming an exposure that shares fewer stars with the reference than the polynomial has modes.
    """
    problem = build_problem(_checked(matches), degree, error_floor=error_floor)
    target, variance, name = _reference(matches, problem, reference)
    state = State(target, np.zeros((problem.n_exposures, 2, problem.n_modes)), _stacked(matches))
    state = State(target, state.coefficients, _fit_poses(problem, state, variance))
    state, covariance = _fit_polynomials(problem, state, variance, weighted=weighted)
    state = constraints.absorb_similarities(problem, state)
    fixed = np.zeros((problem.n_exposures, 1, 1))
    fixed[slice(None) if name is None else problem.names.index(name)] = 1
    convention = constraints.make("minimal", problem, state, criterion.linearise(problem, state))
    rows = (fixed * np.eye(2 * problem.n_modes)).transpose(1, 0, 2)
    plane = "the mean of all exposures" if name is None else f"the detector of exposure {name}, taken as undistorted"
    convention = _convention(convention, "relative polynomial", plane, constraint=rows)
    state = State(_corrected_mean(matches, problem, state), state.coefficients, state.poses)
    weights = problem if weighted else _equal(problem)
    return _solution(matches, (problem, weights), state, convention, covariance, error_floor=float(error_floor))


def compare(matches, solution, *, prior=None):
    """The four corrections of the paper (section 5.3.1, Figure "ercomp") on the observations that a solution used.

    Parameters
    ----------
    matches : Matches
        What was solved.
    solution : Solution
        What `legdistort.solve` made of it: the method. Its clipped observations and exposures take no part, and its
        error floor is that of the polynomial too.
    prior : Prior or dict, optional
        Static distortion; without one the second correction is left out.

    Returns
    -------
    dict
        ``{name: Solution}``: "shift", "static + shift", "relative polynomial", "all distortions solved". A
        correction that fails on these data is left out, with a warning in the log that gives the reason.
    """
    same = used_matches(matches, solution)
    floor = solution.diagnostics.error_floor
    calls = {
        "shift": lambda: solve_shifts(same),
        "static + shift": lambda: solve_shifts(same, prior=prior),
        "relative polynomial": lambda: solve_relative(same, degree=max(solution.degree, 1), error_floor=floor),
    }
    if means(prior) is None:
        del calls["static + shift"]
    out = {}
    for name, call in calls.items():
        try:
            made = call()
            for reason in folds(made).values():
                raise FoldError(reason)
            out[name] = made
        except LegdistortError as error:
            log.warning("%s is left out of the comparison: %s", name, error)
    return out | {METHOD: solution}


def used_matches(matches, solution):
    """The matches that a solution used, of which it was made: without clipped observations and exposures.

    Positions, errors and the camera are those of the solution.
    """
    if not set(solution.names) <= set(matches.names):
        matches, _ = by_detector(matches, None)
    rows = solution.residuals["used"]
    table = solution.residuals[matches.table.colnames]
    poses, left_out = {name: matches.poses[name] for name in solution.names}, dict(solution.left_out)
    known = {"poses": poses, "shapes": dict(solution.estimate.shapes), "left_out": left_out, "camera": solution.camera}
    return replace(matches, table=table, **known).keep(rows)


# -- pieces


def _checked(matches):
    if not isinstance(matches, Matches):
        raise InputError(f"matches must be Matches, got {type(matches).__name__}")
    return replace(matches, pose_sigma=None)  # poses are taken as they are


def _equal(problem):
    """The problem with one weight for all observations."""
    weight = np.zeros_like(problem.weight)
    weight[:2] = np.median(problem.weight[:2])
    return replace(problem, weight=weight)


def _stacked(matches):
    return np.stack([matches.poses[name] for name in matches.names])


def _without_own_turns(matches):
    """Poses whose linear part is the mean of those of like orientation; the middle of every detector stays put."""
    linear = _stacked(matches)[:, :, :2]
    out = {}
    for name, own in zip(matches.names, linear, strict=True):
        pose, size = matches.poses[name], np.array(matches.shapes[name][::-1])
        like = np.linalg.norm(linear - own, axis=(1, 2)) < _SAME_ORIENTATION * np.linalg.norm(own)
        mean, middle = linear[like].mean(axis=0), (size - 1) / 2
        out[name] = np.column_stack([mean, middle - mean @ similarity.apply(similarity.invert(pose), middle)])
    return out


def _reference(matches, problem, reference):
    """Reference positions (2, n_stars), their variance (2, n_stars) [pix^2], infinite if unknown, and the exposure."""
    variance = np.full((2, problem.n_stars), np.inf)
    target = matches.positions.T.copy()
    if reference == "mean":
        return target, 1 / np.stack([np.bincount(problem.star, w, problem.n_stars) for w in problem.weight[:2]]), None
    name = problem.names[int(np.argmax(np.diff(problem.start)))] if reference is None else reference
    if name not in problem.names:
        raise InputError(f"reference must be 'mean' or one of {', '.join(problem.names)}, got {reference!r}")
    part = problem.part(problem.names.index(name))
    target[:, problem.star[part]] = similarity.apply(similarity.invert(matches.poses[name]), problem.xy[:, part].T).T
    variance[:, problem.star[part]] = 1 / problem.weight[:2, part]
    return target, variance, name


def _fit_poses(problem, state, variance):
    """Similarities (n_exposures, 2, 3) from the reference positions to those of every exposure."""
    out = state.poses.copy()
    for i, name in enumerate(problem.names):
        own = problem.star[problem.part(i)]
        known = np.isfinite(variance[0, own])
        if np.count_nonzero(known) < max(problem.n_modes, 2):
            raise SolveError(
                f"exposure {name} shares {np.count_nonzero(known)} stars with the reference, fewer than the "
                f"{problem.n_modes} modes of degree {problem.degree}: lower the degree or take another reference"
            )
        xy = problem.xy[:, problem.part(i)][:, known].T
        parity = 1 if np.linalg.det(out[i, :, :2]) > 0 else -1
        out[i] = similarity.fit_similarity(state.positions[:, own[known]].T, xy, parity=parity)
    return out


def _fit_polynomials(problem, state, variance, *, weighted):
    """Coefficients of every exposure given the reference positions, and their covariances, one block an exposure."""
    coefficients, blocks = state.coefficients.copy(), []
    for i, name in enumerate(problem.names):
        part = problem.part(i)
        own, (_, b, _) = problem.star[part], criterion.predict(problem, state, i, i + 1)
        offset = problem.xy[:, part] - similarity.apply(state.poses[i], state.positions[:, own].T).T
        covariance = np.zeros((2 * problem.n_modes, 2 * problem.n_modes))
        for axis in (0, 1):
            known = np.isfinite(variance[axis, own])
            noise = 1 / problem.weight[axis, part][known] + variance[axis, own[known]]
            weight = 1 / noise if weighted else np.ones_like(noise)
            design = b[:, known] * np.sqrt(weight)
            if np.linalg.cond(design) > 1e7:
                raise SolveError(f"the stars of exposure {name} do not determine degree {problem.degree}: lower it")
            to_coefficients = np.linalg.pinv(design.T) * np.sqrt(weight)
            coefficients[i, axis] = to_coefficients @ offset[axis, known]
            span = slice(axis * problem.n_modes, (axis + 1) * problem.n_modes)
            covariance[span, span] = to_coefficients * noise @ to_coefficients.T
        blocks.append(covariance)
    return State(state.positions, coefficients, state.poses), np.stack(blocks)


def _corrected_mean(matches, problem, state):
    """Weighted mean (2, n_stars) of the corrected positions of every star."""
    weight = problem.weight[:2].sum(axis=0)
    sums = np.zeros((2, problem.n_stars))
    for i, name in enumerate(problem.names):
        part = problem.part(i)
        distortion = Distortion(state.coefficients[i], problem.shapes[i], name)
        back = similarity.apply(similarity.invert(state.poses[i]), distortion.invert(problem.xy[:, part].T))
        np.add.at(sums.T, problem.star[part], weight[part, None] * back)
    return sums / np.bincount(problem.star, weight, problem.n_stars)


def _convention(gauge, name, plane, **changes):
    """The gauge of a correction, whose plane is described in words; absolute errors come out as NaN."""
    return replace(gauge, kind=name, plane=plane, unknown_maps=(), **changes)


def _solution(matches, problems, state, gauge, covariance=None, error_floor=0.0):
    """The frozen result: chi2 by the stated errors, reported errors scaled by what the weights in force leave.

    A `covariance` of the coefficients, one block an exposure, is that at the stated errors where each exposure was
    fitted by itself: there is none between exposures.
    """
    stated, problem = problems
    blocks = criterion.linearise(problem, state)
    dof = 2 * len(matches.table) - 2 * problem.n_stars - (problem.n_exposures - 1) * 2 * problem.n_modes
    scale = float(np.sqrt(blocks.chi2 / dof)) if dof > 0 else 1.0
    coefficients = None if covariance is None else block_diag(*(scale**2 * covariance))
    return assembly.assemble(
        matches,
        problem,
        state,
        blocks,
        gauge,
        Uncertainty(problem, blocks, gauge, scale=scale, coefficients=coefficients),
        settings=Settings(problem.degree, method=gauge.kind, errors="scale"),
        diagnostics=Diagnostics(error_floor=error_floor, error_scale=scale),
        status=f"{gauge.kind}: solved directly",
        dof=dof,
        chi2=float(criterion.squares(stated, blocks.residual).sum()),
    )
