"""The checks that a run adds to those of its solution: images, stack and catalogue."""

import numpy as np
from scipy import special

from ..exceptions import some_of
from ..results.check import CERTAIN, FALSE_ALARM, STATES, Check
from ..results.in_tables import folds, largest_inverse_error
from .model_misfits import model_misfits

#: A stack whose stars are this much wider than those of single exposures has lost sharpness that can be seen.
BLURRED = 1.05
#: Excess of an exposure over the others in the logarithm of the FWHM, and distance from them in ellipticity, along and
#: across, that have a cause to look for (a trail of one FWHM makes 0.11 to 0.15 in one, 0.13 to 0.15 in the other) ...
WIDE, ELONGATED = 0.08, 0.08
#: ... if it is no more probable than this by chance, as the others scatter: few exposures determine no more.
ODD = 0.001
#: Parts of the bright peaks that may have no star, and of the stars that may stand around brighter ones beyond chance.
LOST, FALSE = 0.1, 0.1
#: Deviation of bright stars from their model, in parts of their light, that is odd where others have none; else its
#: square may be so many times the usual one. Beyond the second of each the check fails.
MISFIT, TIMES = (0.02, 0.06), (2.5, 10.0)
#: Deviation in the typical exposure that shows a PSF not to be that of the frames, and that at which the check fails.
WRONG_PSF = 0.2, 0.4
_BEYOND = 4.0  # errors by noise
_MOSAIC = "run without --no-mosaic makes one; where --from repeats that, --forget no-mosaic"
_NAMED = 6  # exposures in a sentence
_FEWEST = 4  # exposures, to determine how much they usually differ


def check_run(solution, quality=None, *, stacked=True, joint=None):
    """Checks of the images, of the stack and of the catalogue of all exposures.

    Parameters
    ----------
    solution : Solution
    quality : `~legdistort.assessment.stack_quality.Quality`, optional
        Of the stack, with the widths in single exposures.
    stacked : bool
        Whether there is a stack.
    joint : `~legdistort.photometry.catalogue.Catalogue`, optional
        Checked if there is one.

    Returns
    -------
    tuple of Check
    """
    checked = (
        image_check(quality, model_misfits(solution.residuals), stacked=stacked),
        stack_check(quality, moving=solution.estimate.motions is not None, stacked=stacked),
        inverse_check(solution),
    )
    return checked if joint is None else (*checked, joint.check)


def image_check(quality, misfits=None, *, stacked=True):
    """Are the stars of the solution those of the frames, are those of all exposures alike, and as their model has them?

    Parameters
    ----------
    quality : `~legdistort.assessment.stack_quality.Quality` or None
    misfits : dict, optional
        ``{exposure: Misfit}``, see `~legdistort.assessment.model_misfits.model_misfits`.
    stacked : bool
        Whether there is a stack, for which the shapes of stars are measured.

    Returns
    -------
    Check
    """
    light = quality.light if quality else None
    made = [*_light_checks(light), *_misfit_checks(misfits or {}), _shapes_check(quality, stacked)]
    return max(made, key=lambda check: STATES.index(check.state))


def _light_checks(light):
    """What the list of stars lacks, and what it has too much of, where that is more than usual."""
    if light is None:
        return
    lost, false = light.share_without, light.share_around
    if lost > LOST and light.p_without(LOST / 2) < FALSE_ALARM:
        state = "fail" if lost > 2 * LOST and light.p_without(LOST / 2) < CERTAIN else "warn"
        yield Check("images", state, lost, LOST,
                    f"{light.n_without} of {light.n_peaks} bright peaks of the stack have no star in the solution",
                    "look at what was cut: flags of the detections (deformed, blended), or matches that were not found"
                    )  # fmt: skip
    if false > FALSE and light.p_around < FALSE_ALARM:
        state = "fail" if false > 2 * FALSE and light.p_around < CERTAIN else "warn"
        yield Check("images", state, false, FALSE,
                    f"{light.n_around} of {light.n_stars} stars stand around much brighter ones, "
                    f"{light.by_chance:.0f} would by chance: speckles, spikes or rings taken for stars",
                    "a higher --threshold, or --psf effective, whose profile holds them")  # fmt: skip


def _misfit_checks(misfits):
    """Exposures whose bright stars deviate more from their model than those of others, and a PSF that fits nowhere."""
    if not misfits:
        return
    names, found = list(misfits), list(misfits.values())
    square = np.array([each.square for each in found])
    least, usual = square - _BEYOND * np.array([each.error for each in found]), max(float(np.median(square)), 0.0)
    given = sorted({each.model for each in found} - {"moffat"})
    if given and np.median(least) > WRONG_PSF[0] ** 2:
        state = "fail" if np.median(least) > WRONG_PSF[1] ** 2 else "warn"
        yield Check("images", state, float(np.sqrt(usual)), WRONG_PSF[0],
                    f"bright stars deviate from their PSF ({', '.join(given)}) by {np.sqrt(usual):.0%} of their light "
                    "in most exposures", "the PSF is not that of these frames: --psf auto, or one made from them"
                    )  # fmt: skip
        return
    if len(found) < _FEWEST:
        return
    limits = [times * usual + size**2 for size, times in zip(MISFIT, TIMES, strict=True)]
    odd = np.flatnonzero(least > limits[0])
    if len(odd):
        odd = odd[np.argsort(-least[odd], kind="stable")]
        each = [f"{names[i]} ({found[i].size:.1%})" for i in odd]
        yield Check("images", "fail" if least[odd[0]] > limits[1] else "warn", found[odd[0]].size,
                    float(np.sqrt(limits[0])),
                    f"bright stars deviate from their model by more of their light than the usual "
                    f"{np.sqrt(usual):.1%} in {some_of(each, _NAMED)}",
                    "look at the frame (trailed, a jump of the guiding, a ghost, the PSF of another), or leave it out"
                    )  # fmt: skip


def _shapes_check(quality, stacked):
    """Are the stars of all exposures alike?"""
    if not stacked:
        return Check("images", "unknown", None, None, "no mosaic was made, for which shapes of stars are compared",
                     _MOSAIC)  # fmt: skip
    found = quality.exposures if quality else {}
    if len(found) < _FEWEST:
        frames = f"{len(found)} exposure{'s' * (len(found) != 1)}"
        return Check("images", "unknown", None, None, f"stars were measured in {frames}, too few to "
                     "determine whether one differs from the others", "")  # fmt: skip
    names, (fwhm, ellipticity, angle) = list(found), np.array(list(found.values())).T
    stretch = ellipticity * np.exp(2j * np.radians(angle))
    odd = [
        (*_odd_one(np.log(fwhm)[:, None]), WIDE),
        (*_odd_one(np.column_stack([stretch.real, stretch.imag])), ELONGATED),
    ]
    odd = [(p, i) for p, i, excess, least in odd if p < ODD and excess > least]
    width = np.median(fwhm)
    if not odd:
        return Check("images", "pass", width, None,
                     f"stars of all {len(names)} exposures are alike (FWHM {width:.2f} px)")  # fmt: skip
    i = min(odd)[1]
    usual = np.delete(stretch, i).mean()
    return Check("images", "warn", fwhm[i], None,
                 f"stars of {names[i]} are unlike those of the others: FWHM {fwhm[i]:.2f} px, usually {width:.2f}, "
                 f"ellipticity {ellipticity[i]:.2f} at {angle[i]:.0f} degrees from x, in the mean of the others "
                 f"{abs(usual):.2f} at {np.degrees(np.angle(usual)) / 2:.0f}",
                 "look at the frame (trailed, out of focus), or leave it out")  # fmt: skip


def _odd_one(values):
    """Which of the values (n, k) is most unlike the others: its probability by chance, index, distance from their mean.

    Single values count if they are above the others, vectors in any direction, all of which scatter alike.
    """
    (n, k), best = values.shape, (1.0, 0, 0.0)
    for i in range(n):
        others = np.delete(values, i, axis=0)
        off = values[i] - others.mean(axis=0)
        variance = others.var(axis=0, ddof=1).mean() * (1 + 1 / (n - 1))
        f = float(off @ off) / max(k * variance, 1e-18)
        p = special.fdtrc(k, k * (n - 2), f) if k > 1 else special.stdtr(n - 2, -np.sign(off[0]) * np.sqrt(f))
        best = min(best, (min(1.0, n * float(p)), i, float(np.hypot(*off) if k > 1 else off[0])))
    return best


def stack_check(quality, *, moving=False, stacked=True):
    """Is the stack, if there is one, as sharp as its frames? It cannot be where stars are `moving` between them."""
    if not stacked:
        return Check("sharpness", "unknown", None, BLURRED, "no mosaic was made", _MOSAIC)
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
    if folded := folds(solution):
        words = f"{some_of(list(folded), _NAMED)} cannot be inverted: {next(iter(folded.values()))}"
        return Check("inverse", "fail", float(len(folded)), 0.0, words, "lower --degree, or give a prior")
    error = largest_inverse_error(solution)
    return Check("inverse", "pass", error, None, f"every WCS inverts to {error:.1e} px")
