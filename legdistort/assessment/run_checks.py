"""The checks that a run adds to those of its solution: images and stack."""

import numpy as np
from scipy import special

from ..exceptions import FoldError
from ..results.check import Check

#: A stack whose stars are this much wider than those of single exposures has lost sharpness that can be seen.
BLURRED = 1.05
#: Excess of an exposure over the others, in the logarithm of the FWHM and in ellipticity, that has a cause to look for
#: (a trail of one FWHM makes 0.13 in ellipticity) ...
WIDE, ELONGATED = 0.2, 0.1
#: ... if it is no more probable than this by chance, as the others scatter: few exposures say no more.
ODD = 0.01
_FEWEST = 4  # exposures, to say how much they differ usually


def check_run(solution, quality=None):
    """Checks of the images and of the stack.

    Parameters
    ----------
    solution : Solution
    quality : `~legdistort.assessment.stack_quality.Quality`, optional
        Of the stack, with the widths in single exposures.

    Returns
    -------
    tuple of Check
    """
    return (image_check(quality), stack_check(quality, moving=solution.motions is not None), inverse_check(solution))


def image_check(quality):
    """Are the stars of all exposures alike?"""
    found = quality.exposures if quality else {}
    if len(found) < _FEWEST:
        return Check("images", "unknown", None, None, f"stars were measured in {len(found)} exposures, too few to say "
                     "whether one is unlike the others", "")  # fmt: skip
    names, values = list(found), np.array(list(found.values()))
    odd = [
        (*_odd_one(np.log(values[:, 0])), WIDE, "wider", f"{np.median(values[:, 0]):.2f} px", values[:, 0]),
        (*_odd_one(values[:, 1]), ELONGATED, "more elongated", f"{np.median(values[:, 1]):.2f}", values[:, 1]),
    ]
    p, i, excess, least, word, usual, value = max(odd, key=lambda each: each[2] / each[3])
    if p < ODD and excess > least:
        what = "FWHM" if word == "wider" else "ellipticity"
        return Check("images", "warn", value[i], None,
                     f"stars of {names[i]} are {word} than those of the others ({what} {value[i]:.2f}, usually "
                     f"{usual})",
                     "look at the frame (trailed, out of focus), or leave it out")  # fmt: skip
    return Check("images", "pass", value[i], None, f"stars of all {len(names)} exposures are alike (FWHM {odd[0][5]})")


def _odd_one(values):
    """The value that is most above the others: probability by chance, index, excess over their mean."""
    n, best = len(values), (1.0, 0, 0.0)
    for i in range(n):
        others = np.delete(values, i)
        excess = values[i] - others.mean()
        t = excess / max(others.std(ddof=1) * np.sqrt(1 + 1 / (n - 1)), 1e-9)
        p = min(1.0, n * float(special.stdtr(n - 2, -t)))
        best = min(best, (p, i, excess))
    return best


def stack_check(quality, *, moving=False):
    """Is the stack as sharp as its frames? It cannot be where stars are `moving` between them."""
    ratio = quality.fwhm_ratio if quality else np.nan
    if not np.isfinite(ratio):
        return Check("sharpness", "unknown", None, BLURRED, "no star could be measured in stack and frames alike", "")
    words = f"stars of the stack are {ratio:.3f} times as wide as those of single exposures"
    if ratio > BLURRED:
        cure = "leave out exposures with wide stars or large residuals, or raise --degree"
        if moving:
            cure = "stars move from epoch to epoch: stack the exposures of one epoch by themselves"
        return Check("sharpness", "warn", ratio, BLURRED, words, cure)
    return Check("sharpness", "pass", ratio, BLURRED, words)


def inverse_check(solution):
    """Do the WCSs invert?"""
    try:
        error = solution.max_inverse_error
    except FoldError as fold:
        return Check("inverse", "fail", None, None, str(fold), "lower --degree, or give a prior")
    return Check("inverse", "pass", error, None, f"every WCS inverts to {error:.1e} px")
