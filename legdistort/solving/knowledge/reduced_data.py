"""What the data say of some coefficients, with stars, poses and everything else eliminated."""

from dataclasses import dataclass, replace

import numpy as np

from ..equations import criterion, elimination
from ..equations.problem import State

_FEWEST = 5  # exposures of a group that is drawn from
_RIDGE = 1e-10  # on what is eliminated, relative: a similarity common to all exposures is not determined


@dataclass(frozen=True, eq=False)
class ReducedData:
    """The data as some coefficients see them: ``J = chi2 - 2 pull'z + z' curvature z`` for a step z of these.

    Attributes
    ----------
    curvature : ndarray, shape (n, n)
    pull : ndarray, shape (n,)
        Minus half the slope of J at the state.
    chi2 : float
        J at the state, all that is eliminated at its best.
    n_data : int
        Measured coordinates beyond those needed for what was eliminated.
    """

    curvature: np.ndarray
    pull: np.ndarray
    chi2: float
    n_data: int

    def at(self, step):
        """The same data seen from another place (n,)."""
        change = self.curvature @ step
        chi2 = self.chi2 - 2 * self.pull @ step + step @ change
        return ReducedData(self.curvature, self.pull - change, float(chi2), self.n_data)


def without_stars(problem, blocks):
    """The data of a fit as all its unknown coefficients see them, the stars eliminated.

    Parameters
    ----------
    problem : Problem
        With the weights that were in force.
    blocks : Blocks
        Where J and its derivatives are taken.
    """
    moved = elimination.symmetric_times(elimination.inverse_star_blocks(blocks.v), blocks.g_star)
    return ReducedData(
        curvature=elimination.reduced_matrix(problem, blocks),
        pull=blocks.unknowns.gather(blocks.g_exposure - elimination.to_exposures(problem, blocks, moved)),
        chi2=float(blocks.cost - (moved * blocks.g_star).sum()),
        n_data=2 * np.count_nonzero(problem.weight[0]) - elimination.star_freedom(problem, blocks),
    )


def reduced_data(problem, state, rows, motion):
    """The data of a fit as some coefficients see them.

    Parameters
    ----------
    problem : Problem
        With the weights that were in force, and widths of a prior only where they belong to what is eliminated.
    state : State
        Where J and its derivatives are taken.
    rows : ndarray, shape (n, size)
        Orthonormal: the coefficients, as combinations of the unknowns of the problem.
    motion : ndarray, shape (n_exposures, 2 k, m)
        How maps of the reference plane change the coefficients (`legdistort.results.gauge.Gauge`); they are the
        null space of the data, along which the linear model follows the noise.
    """
    data, unknowns = without_stars(problem, criterion.linearise(problem, state)), problem.unknowns
    n, pull, matrix = problem.n_modes, data.pull, data.curvature
    common = motion.reshape(problem.n_exposures, 2, -1, motion.shape[2])
    common = np.pad(common, ((0, 0), (0, 0), (0, n - common.shape[2]), (0, 0)))
    common = np.linalg.qr(unknowns.gather(common.reshape(problem.n_exposures, 2 * n, -1)))[0]
    pull -= common @ (common.T @ pull)
    matrix -= common @ (common.T @ matrix)
    matrix -= (matrix @ common) @ common.T
    others = criterion.complement(rows)
    across, inner = rows @ matrix @ others.T, others @ matrix @ others.T
    inner += _RIDGE * np.trace(inner) / max(len(inner), 1) * np.eye(len(inner))
    solved = np.linalg.solve(inner, np.column_stack([across.T, others @ pull]))
    curvature = rows @ matrix @ rows.T - across @ solved[:, :-1]
    return ReducedData(
        curvature=(curvature + curvature.T) / 2,
        pull=rows @ pull - across @ solved[:, -1],
        chi2=float(data.chi2 - others @ pull @ solved[:, -1]),
        n_data=data.n_data - len(others) + 4 * problem.n_fields,
    )


def drawn(groups, most):
    """Exposures (k,) drawn at random, alike from all groups (n_exposures,), if there are more than so many."""
    most = max(_FEWEST, most)
    if len(groups) <= most:
        return np.arange(len(groups))
    rng = np.random.default_rng(0)
    members = [np.flatnonzero(groups == first) for first in np.unique(groups)]
    return np.sort(np.concatenate([rng.permutation(g)[: max(_FEWEST, most // len(members))] for g in members]))


def part_of(problem, state, keep):
    """Problem and state of some of the exposures (k,) alone, with the stars that these have."""
    if len(keep) == problem.n_exposures:
        return problem, state
    rows = np.concatenate([np.arange(*problem.start[i : i + 2]) for i in keep])
    stars, star = np.unique(problem.star[rows], return_inverse=True)
    group = problem.group if problem.group is None else np.unique(problem.group[keep], return_inverse=True)[1]
    field = np.unique(problem.fields[keep], return_inverse=True)[1]
    part = replace(
        problem,
        names=tuple(problem.names[i] for i in keep),
        shapes=[problem.shapes[i] for i in keep],
        n_stars=len(stars),
        start=np.concatenate([[0], np.cumsum(np.diff(problem.start)[keep])]),
        star=star,
        xy=problem.xy[:, rows],
        weight=problem.weight[:, rows],
        prior_mean=problem.prior_mean[keep],
        prior_sigma=None if problem.prior_sigma is None else problem.prior_sigma[keep],
        static_errors=None if problem.static_errors is None else problem.static_errors.part(keep),
        group=group,
        field=field,
        night=problem.night if np.ndim(problem.night) == 0 else problem.night[keep],
        centre=None if problem.centre is None else problem.centre[keep],
        moving=None if problem.moving is None else problem.moving.subset(keep),
    )
    return part, State(state.stars[:, stars], state.coefficients[keep], state.poses[keep])
