"""The motions that `solve` was asked for, as terms of the stars of a problem."""

from dataclasses import replace
from functools import partial

import numpy as np

from ..exceptions import AssumptionWarning, InputError, warn
from ..geometry import parallax
from ..geometry.epochs import ONE_EPOCH
from .equations.elimination import typical_stars
from .equations.star_terms import StarTerms

#: A parallax that the other unknowns take up to all but this part is not determined.
_DEGENERATE = 1e-6
#: ... and is called badly determined beyond this condition number: its error is so much larger than it need be.
_BADLY = 10.0


def terms_of(options):
    """``terms(matches, weight)`` for `legdistort.solving.equations.problem.build_problem`; None without motions."""
    if options.motion is None:
        return None
    return partial(_terms, kind=options.motion, sigma=options.motion_sigma, epoch=options.motion_epoch)


def _terms(matches, weight, *, kind, sigma, epoch):
    """`StarTerms` of matches with weights (n,); positions are those of the mean epoch unless one is given."""
    years = matches.epochs
    epoch = np.average(years[matches.observations.exposure], weights=weight) if epoch is None else epoch
    factors = parallax.on_plane(matches.sky, years) if kind == "parallax" else None
    return StarTerms.of_motion(kind, years, epoch, factors=factors, sigma=sigma)


def n_epochs(years):
    """Number of epochs of exposures, those nearer than `ONE_EPOCH` to the one before counted once."""
    ordered = np.sort(years)
    return 1 + int(np.count_nonzero(np.diff(ordered) > ONE_EPOCH)) if len(ordered) else 0


def check_epochs(matches, kind):
    """Refuse motions that the epochs of the exposures cannot determine; warn of a parallax that they determine badly.

    Raises
    ------
    InputError
        Saying what is missing.
    """
    years = matches.epochs
    if n_epochs(years) < 2:
        raise InputError(
            f"motions are not determined: all exposures were taken at {years.mean():.4f}, within {np.ptp(years):.2g} "
            "yr; give exposures of other epochs, or leave motion out"
        )
    if kind != "parallax":
        return
    if matches.sky is None:
        raise InputError(
            "parallaxes need the place of the field on the sky, which is not known: give frames with a WCS in their "
            "headers, or motion='proper'"
        )
    number = condition(years, parallax.on_plane(matches.sky, years))
    if n_epochs(years) < 3 or number > 1 / _DEGENERATE:
        raise InputError(
            f"parallaxes are not determined by exposures at {n_epochs(years)} epochs (condition number {number:.2g}): "
            "three at different times of the year are needed, or motion='proper'"
        )
    if number > _BADLY:
        warn(
            f"these epochs hardly distinguish parallaxes from proper motions (condition number {number:.2g}): their "
            "errors are so much larger than at other times of the year",
            AssumptionWarning,
        )


def condition(years, factors):
    """By how much errors of parallaxes grow as positions and proper motions are fitted as well; 1 is none."""
    time = np.asarray(years) - np.mean(years)
    design = np.column_stack([np.ones(len(time)), time])
    basis = np.linalg.qr(design)[0] if np.ptp(time) > 0 else design[:, :1] / np.sqrt(len(time))
    left = factors - basis @ (basis.T @ factors)
    return float(np.linalg.norm(factors) / max(np.linalg.norm(left), 1e-300))


def at_rest(problem, result):
    """The same `Result` with motions relative to the mean of the stars, those with far larger errors than others aside.

    What they share is a shift of every exposure with time, exactly, and is in its pose: nothing tells the two apart
    unless something is known of the poses or of the motions, and then they stay as they are.
    """
    terms, state = problem.terms, result.state
    if "vx" not in terms.names or terms.is_held or problem.pose_width is not None:
        return result
    typical, stars, poses = typical_stars(result.blocks.v), state.stars.copy(), state.poses.copy()
    for number in range(problem.n_fields):
        mine = problem.field_of_stars == number
        if not np.any(mine & typical):
            continue
        first = 2 + terms.names.index("vx")
        common = stars[first : first + 2, mine & typical].mean(axis=1)
        stars[first : first + 2, mine] -= common[:, None]
        seen = problem.fields == number
        drift = (terms.years[seen] - terms.epoch)[:, None] * common
        poses[seen, :, 2] += np.einsum("iab,ib->ia", poses[seen, :, :2], drift)
    return replace(result, state=replace(state, stars=stars, poses=poses))
