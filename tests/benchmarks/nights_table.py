"""Absolute errors where the exposures of a night share a departure: ``python tests/benchmarks/nights_table.py``.

By setting: squared pull of finite absolute errors (nights found by the epochs, and all taken for one), by how much
chance alone would have it off 1 if errors are as stated (a set has few directions that are large), share of the sets
with finite ones, rms error in pixels and that of the same sets without the odd nights; share of the sets in which
every odd night is named with all its exposures, in which anything else is named, and in which exposures are called
duplicates; medians by set of the squared pull and of the rms error in pixels, and the largest squared pull of a set.
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from night_sets import SIZE, Nights

import legdistort as ld

ALIKE = {"nightly": 0.0, "single": 0.03}
#: Every kind of night by the roll of the last three of eight, and by whether stars move.
SETTINGS = {
    f"{kind}, roll {roll}{', motions' if moves else ''}": words | {"roll": roll} | ({"motion": 0.25} if moves else {})
    for kind, words in {"8 nights": {}, "independent": ALIKE, "odd night": {"odd": 0.5}}.items()
    for roll in (0, 0.7, 30)
    for moves in (False, True)
}
SETTINGS |= {
    "odd night, independent": {"odd": 0.5} | ALIKE,
    "odd night of one exposure": {"odd": 0.5, "alone": True},
    "2 nights": {"nights": 2},
    "3 nights": {"nights": 3},
    "3 nights, one odd, roll 0.7": {"nights": 3, "odd": 0.5, "roll": 0.7},
    "a night of one exposure": {"alone": True},
    "2 nights, departures 0.2": {"nights": 2, "nightly": 0.2},
    "3 nights, departures 0.2": {"nights": 3, "nightly": 0.2},
}
#: Which of eight nights are odd, where stars move and `motion="auto"` is to find out; the last two are turned.
SEVERAL = {
    "motions found, none odd": (),
    "motions found, one odd": (4,),
    "motions found, one odd, turned": (6,),
    "motions found, two odd, one turned": (3, 6),
    "motions found, two odd, both turned": (6, 7),
    "motions found, three odd, one turned": (1, 3, 6),
}
SETTINGS |= {name: {"odd": 0.5, "odd_ones": ones, "motion": 0.02} for name, ones in SEVERAL.items()}


def solved(table, words):
    """The solution of a table."""
    motion = ("auto" if "odd_ones" in words else "proper") if "motion" in words else None
    return ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)), motion=motion)


def square(nights, solution):
    """Squares of absolute errors and their variances, of the finite ones, the mean square error, and by chance.

    The last is the variance of the first if the errors are as stated, common maps alone.
    """
    off = nights.offsets(solution.stars, solution.stars.meta.get("epoch") or 2017.0)
    stated = np.full(off.shape, np.nan)
    if "x_err_abs" in solution.stars.colnames:  # else nothing is known of any
        stated = np.column_stack([solution.stars[c].value for c in ("x_err_abs", "y_err_abs")])
    finite = np.isfinite(stated) & np.isfinite(off)
    moved = solution.gauge.directions[finite.all(axis=1)]
    variance, maps = np.linalg.eigh(solution.gauge.absolute_covariance)
    common = moved.reshape(-1, moved.shape[2]) @ maps * np.sqrt(np.maximum(variance, 0))
    by_chance = 2 * np.sum((common.T @ common) ** 2)
    return np.sum(off[finite] ** 2), np.sum(stated[finite] ** 2), np.nanmean(off**2), by_chance


def names(solution, odd):
    """Whether the exposures of all `odd` nights are named as such, whether anything else is, and duplicates."""
    checks = {check.name: check for check in solution.checks}
    check, nights = checks["nights"], solution.nights[solution.nights["odd"]]
    tests = check.tests + checks["dynamic part"].tests
    right = [each for each in nights["exposures"] if set(each.split(", ")) in odd and f"({each})" in check.sentence]
    return 0 < len(right) == len(odd), len(tests) > len(right), checks["duplicates"].state != "pass"


def row(words, seeds, *, one=True):
    """Figures of a setting, over sets by their seeds, and as if all were `one` night."""
    sums = {"found": [], "one": [], "without": [], "names": []}
    for seed in seeds:
        nights = Nights(seed, **words)
        tables = {"found": nights.table, "one": nights.table.copy()}
        odd = words.get("odd_ones", (nights.odd,) if "odd" in words else ())
        if odd and one:
            tables["without"] = nights.table[~np.isin(nights.table["block"], odd)]
        tables["one"]["block"] = 0
        del tables["found"]["block"]
        for name, table in tables.items():
            if name == "one" and not one:
                continue
            solution = solved(table, words)
            sums[name].append(square(nights, solution))
            if name == "found":
                those = [{e for e in solution.names if e.startswith(f"n{i}e")} for i in odd]
                sums["names"].append(names(solution, those))
    return {name: np.array(each) for name, each in sums.items() if each}


def motions(n_nights, n, **how):
    """Squared pull of absolute motions over n sets of some nights that differ in nothing but a turn, and by set.

    And the share of stars of which an absolute error is stated.
    """
    sums = []
    for seed in range(n):
        nights = Nights(seed, nights=n_nights, nightly=0.0, single=0.0, motion=0.02, n_stars=120)
        given = ld.Matches.from_table(nights.table, shape=(SIZE, SIZE))
        stars = ld.solve(given, motion="auto", **how).stars
        stars = stars[np.asarray(stars["n_epochs"]) > 1]
        z, v = (stars[x].value + 1j * stars[y].value for x, y in ("xy", ("vx", "vy")))
        off = v - nights.motion[np.asarray(stars["star"], int)] @ [1, 1j]
        common = np.stack([np.ones(len(z)), z - z.mean()], axis=1)
        off = off - common @ np.linalg.lstsq(common, off, rcond=None)[0]
        stated = stars["vx_err_abs"].value ** 2 + stars["vy_err_abs"].value ** 2
        known = np.isfinite(stated)
        sums.append([np.sum(np.abs(off[known]) ** 2), np.sum(stated[known]), np.mean(known)])
    off, stated, known = np.array(sums).T
    with np.errstate(invalid="ignore"):
        return off.sum() / stated.sum(), off / stated, known.mean()


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first set")
    parser.add_argument("--only", nargs="*", default=list(SETTINGS))
    parser.add_argument("--names", action="store_true", help="alone: nothing is taken for one night")
    parser.add_argument("--motions", action="store_true", help="motions alone, of two to five nights, as static='fit'")
    asked = parser.parse_args()
    if asked.motions:
        for static in ("fit", None):
            for n_nights in (2, 3, 4, 5):
                pooled, single, known = motions(n_nights, asked.sets, **({"static": static} if static else {}))
                sets = f"single sets {single.min():9.4f} to {single.max():.4f}"
                print(f"static={static} {n_nights} nights {pooled:9.4f}   {sets}, stated of {known:.2f}", flush=True)
        return
    heads = "pull^2", "chance", "finite", "one", "chance", "finite", "rms", "without", "named", "false", "twice"
    heads += "median", "rms", "most"
    print(f"{'':36} " + " ".join(f"{head:>7}" for head in heads))
    for name in asked.only:
        sums = row(SETTINGS[name], range(asked.first, asked.first + asked.sets), one=not asked.names)
        cells = []
        for each in ("found", "one"):
            if each not in sums:
                cells += [np.nan, np.nan, np.nan]
                continue
            off, stated, _, by_chance = sums[each].T
            known = stated.sum() if stated.any() else np.nan
            cells += [off.sum() / known, np.sqrt(by_chance.sum()) / known, np.mean(stated > 0)]
        cells += [np.sqrt(sums[each][:, 2].mean()) if each in sums else np.nan for each in ("found", "without")]
        cells += sums["names"].mean(axis=0).tolist()
        off, stated, error2, _ = sums["found"].T
        pulls = off / np.where(stated > 0, stated, np.nan)
        cells += [np.nanmedian(pulls), np.median(np.sqrt(error2)), np.nanmax(pulls)]
        print(f"{name:36} " + " ".join(f"{cell:7.3f}" for cell in cells), flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
