"""Checks of the stars: are they worse than their measurements, do some contradict themselves, was much left out?"""

import numpy as np
from scipy import special

from ...exceptions import reasons_of, some_of
from ...inputs.exposure_names import ASKED
from ...results.check import FALSE_ALARM, Check
from ..equations.elimination import inverse_star_blocks
from .cures import without_static
from .limits import ALIKE, GROSS_ERRORS, MOST_NAMED, UNDETERMINED, UNFOLLOWED

#: Errors of stars over those of their measurements beyond which exposures hang together by too little. Of 150 sets of 4
#: to 40 exposures with 20 to 1000 stars on a frame, without a prior, one is beyond 3.2; a mosaic of 3 x 3 has 2.3 with
#: overlaps of a half, 16 with a third.
_WORSE = 5.0
#: Observations, and of these left out, from which a star may be said to contradict itself.
_FEWEST, _LEFT_OUT = 4, 2
#: Cuts between two groups of observations that are tried at most.
_CUTS = 64
#: Motions that observations check, from which others may be said to be unlike them; a scatter by medians (normal).
_CHECKED, _MAD = 10, 1.4826


def overlaps_check(solution, residuals):
    """Are stars much worse than their measurements, as exposures hang together by too little?"""
    own = inverse_star_blocks(residuals.blocks.v)[:2]
    errors = np.stack([solution.stars[f"{axis}_err"].value for axis in "xy"]) / solution.diagnostics.error_scale
    good = np.isfinite(errors).all(axis=0) & (own > 0).all(axis=0)
    if not good.any():
        return None
    ratio = float(np.median(np.sqrt(np.mean(errors[:, good] ** 2 / own[:, good], axis=0))))
    found = f"stars are {ratio:.2g} times as uncertain as their measurements"
    if ratio < _WORSE:
        return Check("overlaps", "pass", ratio, _WORSE, found)
    free = solution.settings.prior is None and solution.diagnostics.widths is None
    evidence = "--prior-sigma evidence, where exposures depart little from what they have in common; " * free
    tied = "more stars of the reference" if solution.gauge.tie is not None else "a --reference"
    return Check("overlaps", "warn", ratio, _WORSE, f"{found}: too few of them join the exposures",
                 f"{evidence}exposures that overlap by more, fainter stars (a lower --threshold), a lower --degree, or "
                 f"{tied}")  # fmt: skip


def stars_check(solution, observed):
    """Are there stars whose observations contradict each other, or that move unlike all others for two epochs alone?"""
    check, found = _contradictions(solution, observed), _unlike(solution)
    if not found:
        return check
    named = some_of(found, MOST_NAMED)
    move, seen = ("moves", "it was seen") if len(found) == 1 else ("move", "they were seen")
    said = (
        f"{_counted(len(found))} {move} unlike all others, and nothing checks that, {seen} at two epochs only: {named}"
    )
    if check.state == "pass":
        return Check("stars", "warn", len(found), 0, said,
                     "mismatched, or fast: look at these; take the rows of what is no single star out of matched.ecsv"
                     )  # fmt: skip
    return Check("stars", "warn", check.value + len(found), 0, f"{check.sentence}; {said}", check.cure)


def _unlike(solution):
    """Stars seen at two epochs that move farther from the others than any does that observations check, in words."""
    motions = solution.estimate.motions
    if motions is None:
        return []
    v, stars = motions.values[:, :2], solution.stars
    error = np.sqrt((stars["vx_err"].value ** 2 + stars["vy_err"].value ** 2) / 2)
    known = np.isfinite(v).all(axis=1) & np.isfinite(error)
    checked, others = known & (motions.n_epochs > 2), known & (motions.n_epochs == 2)
    if np.count_nonzero(checked) < _CHECKED:
        return []
    away = v - np.median(v[checked], axis=0)
    scatter = _MAD * np.median(np.abs(away[checked]))
    ratio = np.hypot(*away.T) / np.hypot(scatter, error)
    p = np.exp(-(ratio**2) / 2) * np.count_nonzero(others)
    odd = np.flatnonzero(others & (p < FALSE_ALARM) & (ratio > ratio[checked].max()))
    names = solution.estimate.star_names
    return [f"{names[j]} ({np.hypot(*v[j]):.2g} px/yr)" for j in odd[np.argsort(-ratio[odd])]]


def _contradictions(solution, observed):
    """The check of observations of one star."""
    table, star = observed.table, observed.problem.star
    out = ~np.asarray(table["used"])
    n, lost = np.bincount(star), np.bincount(star, out)
    usual = (lost.sum() - lost + 1) / (n.sum() - n + 1)  # of the other stars
    p = special.bdtrc(lost - 1, n, np.minimum(usual, 1))
    odd = np.flatnonzero((n >= _FEWEST) & (lost >= _LEFT_OUT) & (p * len(n) < FALSE_ALARM))
    if not len(odd):
        return Check("stars", "pass", 0, None, "no star contradicts itself")
    covariance = solution.diagnostics.errors_of(table)
    off = np.einsum("nba,bn->na", observed.linear[observed.exposure], np.stack([table["dx"].value, table["dy"].value]))
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    found = []
    for j in odd[np.argsort(p[odd], kind="stable")][:MOST_NAMED]:
        rows = np.flatnonzero((star == j) & np.isfinite(off).all(axis=1))
        time = np.asarray(observed.times, dtype=float)[observed.exposure[rows]]
        flux = np.asarray(table["flux"], dtype=float)[rows] if "flux" in table.colnames else None
        found.append(f"{solution.estimate.star_names[j]} ({_looks_like(off[rows], sigma[rows], time, flux)})")
    more = f" and {len(odd) - len(found)} more" * (len(odd) > len(found))
    return Check("stars", "warn", len(odd), 0,
                 f"observations of {_counted(len(odd))} contradict each other: {', '.join(found)}{more}",
                 "look at these; take the rows of what is no single star out of matched.ecsv, fit what moves "
                 "(--motion)")  # fmt: skip


def _counted(n):
    return "one star" if n == 1 else f"{n} stars"


def _looks_like(off, sigma, time, flux):
    """What offsets (n, 2) of a star with errors (n,) look like, in words (Schwarz 1978)."""
    n, one = len(off), np.ones_like(sigma)
    if n < _FEWEST:
        return "hardly any is left"
    tried = {"it scatters": (_left(off, sigma, [one]), 2)}
    first = _groups(off, sigma)
    apart = np.hypot(*(off[first].mean(axis=0) - off[~first].mean(axis=0)))
    two = _left(off, sigma, [first, ~first])
    tried[f"two places {apart:.2g} px apart: mismatches, or a binary"] = two, 4 + n / np.log(2 * n)
    if n > 4 and np.ptp(time) > 0:
        t = (time - time.mean()) / np.ptp(time)
        tried["it moves"] = _left(off, sigma, [one, t]), 4
        tried["it moves on a curve: acceleration"] = _left(off, sigma, [one, t, t**2]), 6
    if flux is not None and np.all(flux > 0) and np.ptp(flux) > 0:
        tried["it moves with its flux: a blend that varies"] = _left(off, sigma, [one, np.log(flux)]), 4
    return min(tried, key=lambda words: 2 * n * np.log(max(tried[words][0], 1e-9)) + tried[words][1] * np.log(2 * n))


def _left(off, sigma, columns):
    """Mean square, in errors, of offsets less the best combination of columns."""
    design = np.stack([np.asarray(c, dtype=float) for c in columns], axis=1) / sigma[:, None]
    values = off / sigma[:, None]
    return float(np.mean((values - design @ np.linalg.lstsq(design, values, rcond=None)[0]) ** 2)) + 0.5


def _groups(off, sigma):
    """Which of the offsets belong to the first of two groups, those of the best cut along their widest direction."""
    middle = off - np.median(off, axis=0)
    along = middle @ np.linalg.svd(middle, full_matrices=False)[2][0]
    order = np.argsort(along, kind="stable")
    sizes = np.unique(np.linspace(1, len(off) - 1, _CUTS).round().astype(int))
    cuts = [np.isin(np.arange(len(off)), order[:k]) for k in sizes]
    return min(cuts, key=lambda cut: _left(off, sigma, [cut, ~cut]))


def rejection_check(solution):
    """Was much left out?"""
    used = np.asarray(solution.residuals["used"])
    n, out = len(used), int(np.count_nonzero(~used))
    share, p = out / n, special.bdtrc(out - 1, n, GROSS_ERRORS) if out else 1.0
    lost = solution.left_out
    words = f"{out} of {n} observations ({share:.1%}) were left out" if out else f"all {n} observations were used"
    if lost:
        number = f"{len(lost)} exposures were" if len(lost) > 1 else "one exposure was"
        words += f"; {number} left out: {reasons_of(lost, 3)}"
    if any(ALIKE in why for why in lost.values()):
        own = "one distortion is not that of all nights: "
        cure = f"{own}{without_static(solution)}" if solution.settings.static == "fit" else f"{own}raise --degree"
        return Check("rejection", "warn", share, GROSS_ERRORS, words, cure)
    if p < FALSE_ALARM:
        return Check("rejection", "fail" if share > 0.3 else "warn", share, GROSS_ERRORS, words,
                     "mismatches or blends: look at the exposures with most of them; match with a smaller --tolerance"
                     )  # fmt: skip
    if odd := [why for why in lost.values() if why != ASKED]:
        cure = "add exposures that overlap them, lower the degree, or give a prior with sigma (--prior-sigma evidence)"
        cure = cure if all(UNDETERMINED in why for why in odd) else "look at these frames"
        return Check("rejection", "warn", share, GROSS_ERRORS, words, cure)
    return Check("rejection", "pass", share, GROSS_ERRORS, words)


def unfollowed(solution):
    """Names of exposures left out since most of their stars deviate from a fit of the others."""
    return [name for name, why in solution.left_out.items() if UNFOLLOWED in why]
