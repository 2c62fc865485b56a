"""Whether the stars of a set move, and by how much their motions scatter, by the evidence of the set itself.

A fit in which nothing is known of the motions gives one for every star, ``v_j``, with its covariance C_j. A map that
all stars have in common, of the degree of the distortion, is no motion that could be distinguished from the
distortions, and is fitted too. What is left has the likelihood of ``N(0, s^2 + C_j)``, marginal over that map
(restricted maximum likelihood, Patterson & Thompson 1971), whose maximum is the scatter s of the motions. Their errors
are taken at the observed scale where that is larger than the stated one.
"""

import logging
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from ..exceptions import SolveError
from ..results.diagnostics import MotionScatter
from . import single_fit, star_motions
from .equations.elimination import inverse_star_blocks
from .equations.star_terms import unpacked

log = logging.getLogger(__name__)

#: Variance of motions in that with exposures as exact, from which a weak combination of these makes most of it.
_COMMON = 4.0
#: Sizes of the scatter that are tried first.
_TRIED = 20
#: Days within which nobody asks whether stars moved.
_LONG = 365.0


def resolve(matches, options):
    """Options with motions as they are to be fitted, and the `MotionScatter` that was asked for, or None.

    Raises
    ------
    InputError
        If the epochs do not determine what was asked for.
    """
    if options.motion is None:
        _ask(matches)
        return options, None
    star_motions.check_epochs(matches, options.motion)
    if options.motion != "auto" and options.motion_sigma != "evidence":
        return options, None
    flat = single_fit.estimate(
        matches, replace(options, motion="proper", motion_sigma=None, errors="stated", error_floor=options.error_floor)
    )
    found = scatter(flat)
    log.info("%s", found)
    motion = options.motion
    if motion == "auto":
        motion = "proper" if found.is_there else None
    sigma = options.motion_sigma
    if sigma == "evidence":
        sigma = max(found.sigma, 1e-3 * flat_error(flat)) if motion else None
    return replace(options, motion=motion, motion_sigma=sigma), found


def _ask(matches):
    """Say that stars may have moved, where years lie between the exposures."""
    times, unit = matches.times
    if unit == "days" and np.ptp(times) > _LONG:
        log.info(
            "the exposures span %.1f years, in which stars may have moved: motion='auto' (--motion auto) finds out",
            np.ptp(times) / 365.25,
        )


def flat_error(fit):
    """Typical error of a proper motion, pixels a year."""
    variance = unpacked(fit.uncertainty.star_unknowns)[:, [2, 3], [2, 3]]
    return float(np.sqrt(np.nanmedian(variance)))


def scatter(fit):
    """The `MotionScatter` of the motions in a fit in which nothing was known of them.

    Raises
    ------
    SolveError
        If too few stars have one.
    """
    covariance = unpacked(fit.uncertainty.star_unknowns)[:, 2:4, 2:4]
    good = np.isfinite(covariance).all(axis=(1, 2))
    gauge, state = fit.result.gauge, fit.result.state
    values = gauge.modes_at(state.positions.T[good])
    values = values[np.any(values, axis=1)]  # those of fields with such stars
    n, m = int(np.count_nonzero(good)), 2 * len(values)
    if 2 * n <= m:
        raise SolveError(
            f"the scatter of motions cannot be found from the {n} stars seen at several epochs, {m // 2 + 1} at least "
            "are needed at this degree: give motion_sigma"
        )
    scale2 = max(1.0, fit.chi2 / fit.dof) if fit.dof > 0 else 1.0
    own = unpacked(inverse_star_blocks(fit.result.blocks.v))[good, 2:4, 2:4] * 2 * n / (2 * n - m)
    covariance = covariance[good]
    if np.median(covariance[:, [0, 1], [0, 1]]) > _COMMON * np.median(own[:, [0, 1], [0, 1]]):
        covariance = own  # nearly all of the errors is common to all stars, and no scatter of theirs
    v, c = state.stars[2:4, good].T, scale2 * covariance
    design = np.kron(np.eye(2), values.T).reshape(2, n, m).transpose(1, 0, 2)
    # a map common to all, which nothing but widths may hold, can be larger than any motion by orders of magnitude
    root = np.linalg.cholesky(np.linalg.inv(c)).mT
    flat = (root @ design).reshape(2 * n, m)
    v = v - design @ np.linalg.lstsq(flat, (root @ v[:, :, None]).ravel(), rcond=None)[0]

    def deviance(sigma):
        precision = np.linalg.inv(c + sigma**2 * np.eye(2))
        weighted = precision @ design
        normal = np.einsum("jam,jan->mn", design, weighted)
        pull = np.einsum("jam,ja->m", weighted, v)
        squares = np.einsum("ja,jab,jb->", v, precision, v) - pull @ np.linalg.solve(normal, pull)
        return squares - np.linalg.slogdet(precision)[1].sum() + np.linalg.slogdet(normal)[1]

    size = np.sqrt(np.median(np.einsum("jaa->ja", c)))
    top = np.log(10 * np.sqrt(np.mean(v**2)) / size + 10)
    tried = np.linspace(-6, top, _TRIED)  # the likelihood may be flat on both sides of its maximum
    best = np.argmin([deviance(size * np.exp(each)) for each in tried])
    bounds = tried[max(best - 1, 0)], tried[min(best + 1, _TRIED - 1)]
    found = minimize_scalar(lambda log_s: deviance(size * np.exp(log_s)), bounds=bounds, method="bounded")
    gain = max(deviance(0.0) - found.fun, 0.0)
    return MotionScatter(float(size * np.exp(found.x)) if gain > 0 else 0.0, float(gain), n)
