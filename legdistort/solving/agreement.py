"""Exposures that contradict the others: found in pairs before the fit, or by what the fit cannot follow.

One is left out if three others or more agree, and are more than those that contradict them and agree with one another.
Otherwise the data do not determine which side is right, and the error names both.
"""

import functools

import numpy as np
from astropy import units as u

from ..cameras.stated_errors import undetermined_degree
from ..exceptions import AssumptionWarning, MatchError, SolveError, by_reason, some_of, warn
from ..geometry import pair_agreement
from ..geometry.star_hull import enclosed_area
from . import start_values
from .checks.limits import ALIKE, MOST_NAMED, UNDETERMINED, UNFOLLOWED, of_chi2

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
            why = f"{n_off} of its {n} stars {UNFOLLOWED}"
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
                f"{problem.n_free(i)} modes; lower the degree, or give a prior with sigma (--prior-sigma evidence)"
            )
    return out


def undetermined_left_out(estimate):
    """A function like `estimate`, ``estimate(matches, ...)``, that does without what has no answer.

    Exposures whose stars do not determine their own distortion, as one that overlaps the others in a strip, are left
    out where they are fewer than the others: one frame does not cost the results of a night.
    """

    @functools.wraps(estimate)
    def determined(matches, *how, **options):
        left, lost, first = matches, {}, None
        while True:
            try:
                return estimate(left, *how, **options)
            except SolveError as error:
                if not error.exposures:
                    raise
                first, blamed = first or error, error.exposures
            lost |= {name: _undetermined(matches, name) for name in blamed}
            if 2 * len(lost) >= len(matches.names):
                raise first
            try:
                left = matches.without(lost)
            except MatchError:  # the others are tied to one another by them alone
                raise first from None

    return determined


def _undetermined(matches, name):
    """Why an exposure is left out whose stars are too few, or lie too near to one another."""
    rows, (ny, nx) = matches.table[matches.table["exposure"] == name], matches.shapes[name]
    xy = np.column_stack([rows["x"].to_value(u.pix), rows["y"].to_value(u.pix)])
    seen = f"its {len(rows)} stars in common with others, on {enclosed_area(xy) / (nx * ny):.0%} of its frame"
    return f"{seen}, {UNDETERMINED}"


def warn_of_lost_exposures(fit, matches):
    """Warn of exposures left out: of each, but of those of a night that has another distortion together."""
    new = {n: why for n, why in fit.matches.left_out.items() if n not in matches.left_out or UNDETERMINED in why}
    degree, found = fit.problem.degree, undetermined_degree(matches.camera)
    for reason, names in by_reason(new).items():
        if found > degree and UNFOLLOWED in reason:
            reason += (
                f"; but exposures of degree {degree} cannot take over what camera {matches.camera.name}, found with "
                f"degree {found}, has of a map that all share, so that one that is turned or shifted far may be right: "
                f"degree={found} (--degree {found}) first"
            )
        if ALIKE in reason and len(names) > 1:
            warn(f"{len(names)} exposures are left out ({some_of(names, MOST_NAMED)}): {reason}", AssumptionWarning)
        else:
            for name in names:
                warn(f"exposure {name} is left out: {reason}", AssumptionWarning)


def warn_of_lost_stars(fit):
    """Warn of stars whose observations contradict one another, so that none of them is used."""
    star, used = fit.problem.star, fit.used
    if used.all():
        return
    lost = np.flatnonzero((np.bincount(star) > 0) & (np.bincount(star, used) == 0))
    if not len(lost):
        return
    named = []
    for j in lost[:MOST_NAMED]:
        seen = fit.problem.exposure[star == j]
        named.append(f"{fit.matches.stars[j]} ({some_of([fit.problem.names[i] for i in seen], MOST_NAMED)})")
    more = f" and {len(lost) - len(named)} more" * (len(lost) > len(named))
    orbits = "stars on orbits stay with terms=['orbits'] (--term orbits); " * bool(fit.problem.terms.n)
    too_large = fit.dof > 0 and fit.chi2 > of_chi2(fit.dof)[1] * fit.dof  # else no floor is found
    floor = "; bright ones may have errors that are too small: errors='floor' (--errors floor)" if too_large else ""
    warn(
        f"{len(lost)} star{'s have' if len(lost) > 1 else ' has'} no position, the observations contradict one another "
        f"and there is no majority: {', '.join(named)}{more}; if a check names what displaces stars (motions, static "
        f"distortions, a layout), see to that first; {orbits}else look whether they are matched rightly, or leave them "
        f"out{floor}",
        AssumptionWarning,
    )


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
