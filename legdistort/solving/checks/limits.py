"""What is too little to matter, and what would have shown: limits that several checks share."""

from dataclasses import replace

import numpy as np
from scipy import special

from ...results.check import FALSE_ALARM, STATES, WRONG

#: Errors right to this fraction pass, however many observations prove the rest.
NEGLIGIBLE = 0.05
#: Usual share of gross errors (Hampel et al. 1986: 1 to 10 % in routine data).
GROSS_ERRORS = 0.05
#: Errors of a star: a pattern, or a bend, of so much must show, else the question is open.
SEEN = 3.0
#: What is said of exposures left out that agree with others of their night.
ALIKE = "has another distortion"
#: What is said of exposures left out that have too few stars, or stars in a corner.
UNDETERMINED = "do not determine its distortion"
#: What is said of exposures left out that the fit cannot follow.
UNFOLLOWED = "deviate from the solution of the others"
#: Names in a sentence.
MOST_NAMED = 6
_SURELY = special.ndtri(0.95)


def addition_that_shows(nu):
    """What must be added to a chi2 of nu degrees of freedom to be found, 19 times of 20; infinite for none."""
    if nu < 1:
        return np.inf
    above, square = special.chdtri(nu, FALSE_ALARM) - nu, _SURELY**2
    # nu + a is sqrt(2 nu + 4 a) wide, so much above the limit that it is about normal
    return float(above + 2 * square + np.sqrt((above + 2 * square) ** 2 - above**2 + 2 * square * nu))


def of_chi2(dof):
    """Least and largest chi2/dof that chance explains, or that is too near unity to matter."""
    low, high = (special.chdtri(dof, p) / dof for p in (1 - FALSE_ALARM / 2, FALSE_ALARM / 2))
    return min(low, (1 - NEGLIGIBLE) ** 2), max(high, (1 + NEGLIGIBLE) ** 2)


def as_one(checks):
    """One check of several of the same name: what is wrong, or else in the worst state, joined; None of none."""
    checks = [check for check in checks if check is not None]
    if not checks:
        return None
    checks.sort(key=lambda check: -STATES.index(check.state))
    told = [check for check in checks if check.state in (checks[0].state, *WRONG)]
    return replace(
        told[0],
        sentence="; ".join(check.sentence for check in told),
        cure="; ".join(dict.fromkeys(check.cure for check in told if check.cure)),
        tests=tuple(test for check in checks for test in check.tests),
    )
