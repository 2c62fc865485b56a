"""Whether stars lie where the solution has them: the same stars, fitted in all exposures at once."""

import numpy as np
from scipy import special

from ..exceptions import some_of
from ..results.check import CERTAIN, FALSE_ALARM, Check

#: Errors from its place in the solution beyond which a star is displaced; part of the stars that may be.
BEYOND, DISPLACED = 5.0, 0.02
_NAMED = 6


def displacements(names, xy, variance, solution):
    """How far stars lie from where the solution has them, in errors.

    Errors of both count as independent: what they have in common, the light above all, makes differences smaller.

    Parameters
    ----------
    names : ndarray, shape (n,)
    xy : ndarray, shape (n, 2)
        In the reference plane.
    variance : ndarray, shape (n, 2)
        Of x and y.
    solution : Solution

    Returns
    -------
    ndarray, shape (n,)
        NaN for stars that are not in the solution.
    """
    theirs = solution.stars
    row = {name: k for k, name in enumerate(theirs["star"].tolist())}
    rows = np.array([row.get(name, -1) for name in names.tolist()])
    place, error = (np.column_stack([theirs[f"{c}{what}"].value for c in "xy"])[rows] for what in ("", "_err"))
    ratio = np.sqrt(((xy - place) ** 2 / (variance + error**2)).sum(axis=1))
    return np.where(rows >= 0, ratio, np.nan)


def catalogue_check(stars):
    """Do the stars of a catalogue lie where the solution has them?

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        Of a `~legdistort.photometry.catalogue.Catalogue`.

    Returns
    -------
    Check
    """
    n, displaced = stars.meta.get("n_known", 0), stars.meta.get("displaced", [])
    if not n:
        return Check("catalogue", "unknown", None, DISPLACED, "no star of the solution is in the catalogue", "")
    part = len(displaced) / n
    words = f"{len(displaced)} of {n} stars lie more than {BEYOND:g} errors from where the solution has them"
    p = float(special.bdtrc(len(displaced) - 1, n, DISPLACED)) if displaced else 1.0
    if part <= DISPLACED or p >= FALSE_ALARM:
        return Check("catalogue", "pass", part, DISPLACED, words)
    state = "fail" if part > 5 * DISPLACED and p < CERTAIN else "warn"
    named = f"{words}: {some_of(list(map(str, displaced)), _NAMED)}"
    cure = "look at them (flag DISPLACED): a blend is perhaps taken apart in one alone, or the PSF is not theirs"
    return Check("catalogue", state, part, DISPLACED, named, cure)
