"""Moving the fields of the reference plane by similarities, which changes no residual."""

from dataclasses import replace

import numpy as np

from ...exceptions import InputError, some_of
from ...geometry import similarity
from ...geometry.similarity import robust_similarity
from ..equations.problem import State


def similarities(problem, rows, source, target, label):
    """Those (n_fields, 2, 3) that carry stars (n,) of a problem from `source` (n, 2) to where a reference has them.

    Raises
    ------
    InputError
        If the reference has no star of some field.
    """
    field, poses = problem.field_of_stars[rows], np.tile(similarity.identity(), (problem.n_fields, 1, 1))
    for number in range(problem.n_fields):
        mine = field == number
        if not mine.any():
            names = [problem.names[i] for i in np.flatnonzero(problem.fields == number)]
            raise InputError(
                f"{label} has no star of {some_of(names, 6)}, which have none in common with the other exposures "
                "either: give one with stars of every field, or solve these by themselves"
            )
        if np.count_nonzero(mine) == 1:
            poses[number, :, 2] = (target - source)[mine][0]
        elif np.count_nonzero(mine) == 2:
            poses[number] = similarity.fit_similarity(source[mine], target[mine], parity=1)
        else:
            poses[number] = robust_similarity(source[mine], target[mine])
    return poses


def poses_of(gauge, shift):
    """The similarities X -> X + phi(X) g of modes g (2 k,) without anything else, as a pose for every field."""
    made = []
    for centre, half in gauge.boxes:
        corners = centre + half * np.array([[0.0, 0], [1, 0], [0, 1]])
        move = (shift.reshape(2, -1) @ gauge.modes_at(corners, len(shift) // 2)).T
        linear = np.eye(2) + (move[1:] - move[0]).T / half
        made.append(np.column_stack([linear, centre + move[0] - linear @ centre]))
    return np.stack(made)


def moved_by(problem, state, poses):
    """The same solution with every field of the plane moved by a pose (n_fields, 2, 3): exactly as good."""
    stars, of_star = state.stars.copy(), poses[problem.field_of_stars]
    stars[:2] = similarity.apply_each(of_star, state.positions.T).T
    if len(stars) > 2:
        stars[2:4] = np.einsum("nab,bn->an", of_star[:, :, :2], state.stars[2:4])  # motions turn with the plane
        stars[4:] *= np.sqrt(np.linalg.det(of_star[:, :, :2]))
    return State(stars, state.coefficients, similarity.compose(state.poses, similarity.invert(poses)[problem.fields]))


def centred(problem, gauge, step):
    """The problem with widths about a mean that is not known moved along with a map of the plane.

    Its modes (2 n_modes,), or (2 n_modes + q,) with those of the maps that change with time.
    """
    if not problem.floats:
        return problem
    motion = gauge.all_motion if len(step) > 2 * gauge.n_modes else gauge.motion
    centre = np.zeros_like(problem.prior_mean) if problem.centre is None else problem.centre.copy()
    centre[:, :, : gauge.n_modes] -= (motion @ step).reshape(len(centre), 2, -1)
    return replace(problem, centre=centre)
