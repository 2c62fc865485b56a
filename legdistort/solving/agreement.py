"""Exposures that contradict the others: found in pairs before the fit, or by what the fit cannot follow.

One is left out if three others or more agree, and are more than those that contradict them and agree with one another.
Otherwise the data do not determine which side is right, and the error names both.
"""

import numpy as np

from ..exceptions import SolveError, some_of
from ..geometry import pair_agreement
from . import start_values

#: Exposures that must agree before others are left out for their sake.
FEWEST = 3


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
            out[name] = (
                f"{n_off} of its {n} stars deviate from the solution of the others (mismatched, or not this field?)"
            )
    return out


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
