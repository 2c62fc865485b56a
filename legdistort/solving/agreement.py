"""Exposures that contradict the others: found in pairs before the fit, or by what the fit cannot follow.

One is left out if three others or more agree, and are more than those that contradict them and agree with one another.
Otherwise the data do not determine which side is right, and the error names both.
"""

import numpy as np

from ..exceptions import SolveError, some_of
from ..geometry import pair_agreement
from . import start_values
from .checks.limits import ALIKE

#: Exposures that must agree before others are left out for their sake.
FEWEST = 3
#: Exposures of a night agree that lie by less than this part as far from one another as from the others; of these so
#: many are looked at, and pairs that share so many stars.
_NEARER, _PARTNERS, _FEWEST_SHARED = 1 / 3, 8, 10


def astray(problem):
    """Exposures whose positions have nothing to do with those of the others, ``{name: reason}``.

    Raises
    ------
    SolveError
        If there is no majority.
    """
    found = pair_agreement.compare(problem.exposure, problem.star, start_values.undistorted(problem).T)
    group, against, rivals = ([problem.names[i] for i in part] for part in (found.group, found.against, found.rivals))
    if against and (len(group) < FEWEST or len(group) <= len(rivals)):
        raise SolveError(contradiction(group, rivals if len(rivals) > 1 else against))
    where = f"nowhere near where {len(group)} other exposures have them"
    return dict.fromkeys(against, f"most of its stars lie {where} (mismatched, or not this field?)")


def unfollowed(problem, good):
    """Exposures most of whose observations the fit cannot follow, beyond chance: ``{name: reason}``.

    Parameters
    ----------
    problem : Problem
    good : ndarray of bool, shape (n,)
        Observations that do not deviate.
    """
    out = {}
    for i, name in enumerate(problem.names):
        n = problem.start[i + 1] - problem.start[i]
        n_off = n - np.count_nonzero(good[problem.part(i)])
        if n_off == n or pair_agreement.beyond_chance(n_off, n):
            why = f"{n_off} of its {n} stars deviate from the solution of the others"
            out[name] = f"{why} (mismatched, or not this field?)"
    return out | (_alike(problem, [problem.names.index(name) for name in out]) if len(out) > 1 else {})


def _alike(problem, odd):
    """What is to be said of exposures that agree with others of their night, and not with all the rest, by name.

    It is the same for all of a night.

    Parameters
    ----------
    problem : Problem
    odd : list of int
        Exposures that the fit cannot follow.
    """
    night, alike = np.broadcast_to(problem.night, problem.n_exposures), {}
    rest = [k for k in range(problem.n_exposures) if k not in odd]
    for i in odd:
        own = [_distance(problem, i, k) for k in odd if k != i and night[k] == night[i]]
        others = [_distance(problem, i, k) for k in rest[:: len(rest) // _PARTNERS + 1]]
        if own and np.median(own) < _NEARER * np.median(others):
            alike.setdefault(night[i], {})[problem.names[i]] = np.median(own)
    return {
        name: f"the exposures of its night agree to {np.median(list(apart.values())):.2g} px with one another, and "
        f"most of their stars deviate from the solution of the others: this night {ALIKE}"
        for apart in alike.values()
        for name in apart
    }


def _distance(problem, i, k):
    """Median distance [pix] of the stars that two exposures share once one is laid on the other; infinite for few."""
    a, b = problem.part(i), problem.part(k)
    _, mine, other = np.intersect1d(problem.star[a], problem.star[b], return_indices=True)
    if len(mine) < _FEWEST_SHARED:
        return np.inf
    return float(np.median(pair_agreement.affine_distances(problem.xy.T[a][mine], problem.xy.T[b][other])))


def starved(problem, used):
    """Exposures with fewer observations left than free modes: ``{name: reason}``."""
    out = {}
    for i, name in enumerate(problem.names):
        mine = used[problem.part(i)]
        if (left := np.count_nonzero(mine)) < max(problem.n_free(i), 1):
            out[name] = (
                f"{left} of its {len(mine)} stars agree with other exposures, and its distortion has "
                f"{problem.n_free(i)} modes; lower the degree, or give a prior with sigma"
            )
    return out


def without_contradictions(problem, good):
    """Observations to use: not those of stars most of whose observations, or half of them, deviate."""
    total, left = (np.bincount(problem.star, weight, problem.n_stars) for weight in (None, good))
    return good & (2 * left > total)[problem.star]


def contradiction(group, others):
    """The message where no majority shows which side is right."""
    return (
        f"exposures contradict one another, and there are not {FEWEST} or more that agree against fewer: the stars of "
        f"{some_of(group, 6)} do not lie as those of {some_of(others, 6)}; match them anew, or leave one side out"
    )
