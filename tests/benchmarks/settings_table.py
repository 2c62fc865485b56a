"""Of all settings outside what is assumed: how wrong stated errors are, and whether a check says so.

``python tests/benchmarks/settings_table.py --sets 4``, or with a part of the names: ``... prior``. Errors are wrong if
true ones are more than 1.3 times larger or smaller than stated, rms over the sets: relative ones after a common map of
the fitted degree, absolute ones after shift, rotation and scale. What is not tested ("unknown": a prior, reference,
camera, absolute positions, places) counts as said. Cures that promise a chi2/dof are applied. Truth comes from numpy
alone (`outside_settings`).
"""

import argparse
import logging
import sys
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from checks_table import PROMISE

import legdistort as ld
from legdistort.exceptions import LegdistortError, LegdistortWarning

sys.path.insert(0, str(Path(__file__).parents[1]))
import dense_model
import drawn_sets
import outside_settings

LIMIT = 1.3
#: Stars with errors so many times the median are hardly known, and are a sum by themselves.
_HARDLY = 10.0
#: Checks that say that something is believed.
BELIEVED = "prior", "reference", "camera", "absolute", "place"


def looked_at(make, seed):
    """Squares of errors, true and stated: relative, absolute; who says something; chi2/dof promised and reached."""
    data, stars, options = make(seed)
    given, sigma = options.pop("prior", None), options.pop("static_sigma", None)
    prior = None if given is None else ld.Prior(given, static_sigma=sigma)
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        matches, options = drawn_sets.as_matches(data), {"degree": 3, "prior": prior} | options
        solution = ld.solve(matches, **options)
        said = Counter(c.name for c in solution.checks if c.state in ("warn", "fail"))
        said.update(f"({c.name})" for c in solution.checks if c.state == "unknown" and c.name in BELIEVED)
        promise = next(filter(None, (PROMISE.search(check.cure) for check in solution.checks)), None)
        kept = () if promise is None else (float(promise[3]), _cured(matches, options, *promise.groups()[:2]))
    true = stars[solution.stars["star"]]
    found = np.stack([solution.stars[axis].value for axis in "xy"], axis=1)
    out = []
    for names, removed in ((("x_err", "y_err"), 3), (("x_err_abs", "y_err_abs"), None)):
        stated = np.stack([solution.stars[name].value for name in names], axis=1)
        known = np.isfinite(stated).all(axis=1) & np.isfinite(found).all(axis=1)
        known &= (stated < _HARDLY * np.median(stated[known])).all(axis=1) if known.any() else known
        off = _without_common(found[known], true[known], stated[known], removed)
        out += [np.sum(off**2), np.sum(stated[known] ** 2)]
    return np.array(out), said, kept


def _cured(matches, options, name, value):
    """chi2/dof once a cure is applied."""
    solution = ld.solve(matches, **options | {name: int(value) if name == "degree" else value})
    found = next(check.value for check in solution.checks if check.name == "chi2")
    return np.nan if found is None else found  # no degrees of freedom are left


def _without_common(found, true, stated, degree):
    """Errors without a common map of a degree, weighted, or without shift, rotation and scale (degree None)."""
    if not len(found):
        return np.zeros((0, 2))
    if degree is None:
        z, w = true @ [1, 1j], found @ [1, 1j]
        design = np.stack([np.ones_like(z), z], axis=1)
        off = w - design @ np.linalg.lstsq(design, w, rcond=None)[0]
        return np.stack([off.real, off.imag], axis=1)
    low, high = true.min(axis=0), true.max(axis=0)
    while 3 * len(dense_model.orders(degree)) > len(true) and degree:
        degree -= 1
    columns = dense_model.basis(2048 * (true - low) / (high - low), degree, 2048)[0]
    off, weight = found - true, 1 / stated
    for axis in (0, 1):
        w = weight[:, [axis]]
        off[:, axis] -= columns @ np.linalg.lstsq(w * columns, w[:, 0] * off[:, axis], rcond=None)[0]
    return off


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", nargs="?", default="", help="of the names of settings")
    parser.add_argument("--sets", type=int, default=4)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    wrong, silent = 0, []
    print(f"{'setting':60s} relative absolute  said in  by")
    for name, make in outside_settings.settings().items():
        if arguments.part not in name:
            continue
        squares, names, said, refused, cures = np.zeros(4), Counter(), 0, 0, []
        for seed in range(arguments.sets):
            try:
                each, by, kept = looked_at(make, seed)
            except LegdistortError:
                refused += 1
                continue
            squares += each
            names.update(by)
            said += bool(by)
            cures += [kept] * bool(kept)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios = np.sqrt(squares[[0, 2]] / squares[[1, 3]])
        solved = arguments.sets - refused
        is_wrong = bool(np.any(np.abs(np.log(ratios[np.isfinite(ratios)])) > np.log(LIMIT)))
        wrong += is_wrong
        silent += [name] * (is_wrong and 2 * said < solved)
        words = ", ".join(f"{each} {n}" for each, n in names.most_common(6)) + f"; refused {refused}" * bool(refused)
        if cures:
            promised, reached = np.nanmedian(cures, axis=0)
            words += f"; cures promise {promised:.2f}, reach {reached:.2f}"
        mark = "*" * is_wrong + "!" * (is_wrong and 2 * said < solved)
        print(f"{name:60s} {ratios[0]:8.2f} {ratios[1]:8.2f} {mark:2s} {said} of {solved}  {words}", flush=True)
    print(f"{wrong} settings with an error wrong by more than 30 %; nothing said in {len(silent)}: {'; '.join(silent)}")


if __name__ == "__main__":
    main()
