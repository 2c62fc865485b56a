"""Absolute errors where the exposures of a night share a departure: ``python tests/benchmarks/nights_table.py``.

By setting: squared pull of finite absolute errors (nights found by the epochs, and all taken for one), share of the
sets with finite ones, rms error in pixels and that of the same sets without the odd night.
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from night_sets import SIZE, Nights

import legdistort as ld

SETTINGS = {
    "8 nights, roll 30": {},
    "the same with motions": {"motion": 0.25},
    "independent, roll 30": {"nightly": 0.0, "single": 0.03},
    "independent, roll 0.7": {"nightly": 0.0, "single": 0.03, "roll": 0.7},
    "independent, roll 30, motions": {"nightly": 0.0, "single": 0.03, "motion": 0.25},
    "roll 0.7": {"roll": 0.7},
    "odd night, roll 30": {"odd": 0.5},
    "odd night, roll 0.7, motions": {"odd": 0.5, "roll": 0.7, "motion": 0.25},
    "2 nights": {"nights": 2},
    "3 nights": {"nights": 3},
    "2 nights, departures 0.2": {"nights": 2, "nightly": 0.2},
    "3 nights, departures 0.2": {"nights": 3, "nightly": 0.2},
}


def solved(table, motion):
    """The solution of a table."""
    return ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)), motion="proper" if motion else None)


def square(nights, solution):
    """Squares of absolute errors and their variances, of the finite ones, and the mean square error."""
    off = nights.offsets(solution.stars, solution.stars.meta.get("epoch") or 2017.0)
    stated = np.column_stack([solution.stars[c].value for c in ("x_err_abs", "y_err_abs")])
    finite = np.isfinite(stated) & np.isfinite(off)
    return np.sum(off[finite] ** 2), np.sum(stated[finite] ** 2), np.nanmean(off**2)


def row(words, n):
    """Figures of a setting, over n sets."""
    sums = {"found": [], "one": [], "without": []}
    for seed in range(n):
        nights = Nights(seed, **words)
        tables = {"found": nights.table, "one": nights.table.copy()}
        if "odd" in words:
            tables["without"] = nights.table[nights.table["block"] != words.get("nights", 8) // 2]
        tables["one"]["block"] = 0
        del tables["found"]["block"]
        for name, table in tables.items():
            sums[name].append(square(nights, solved(table, words.get("motion"))))
    return {name: np.array(each) for name, each in sums.items() if each}


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--only", nargs="*", default=list(SETTINGS))
    asked = parser.parse_args()
    print(f"{'':32} {'pull^2':>7} {'finite':>7} {'one':>7} {'finite':>7} {'rms':>7} {'without':>7}")
    for name in asked.only:
        sums = row(SETTINGS[name], asked.sets)
        cells = []
        for each in ("found", "one"):
            off, stated, _ = sums[each].T
            cells += [off.sum() / stated.sum() if stated.any() else np.nan, np.mean(stated > 0)]
        cells += [np.sqrt(sums[each][:, 2].mean()) if each in sums else np.nan for each in ("found", "without")]
        print(f"{name:32} " + " ".join(f"{cell:7.2f}" for cell in cells), flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
