"""What terms find, and what they leave: ``python tests/benchmarks/terms_table.py``.

By setting and by the terms that are fitted: rms error of the stars beyond a common cubic, that of the same sets without
what displaces them, squared pull, chi2 over its degrees of freedom, share of the sets in which the term is found, the
number found over the true one where it is one, and seconds.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from displaced_fields import sky

MOVING = {"years": 15.0, "n_exposures": 24, "n_stars": 40}
SETTINGS = {
    "refraction 0.02 px": ({"refraction": 0.02}, {}, ["refraction"]),
    "pixel phase 0.03 px": ({"phase": 0.03}, {}, ["pixel_phase"]),
    "both": ({"refraction": 0.02, "phase": 0.03}, {}, ["refraction", "pixel_phase"]),
    "none": ({}, {}, ["refraction", "pixel_phase"]),
    "accelerations 0.01 px/yr2": ({"acceleration": 0.01}, MOVING, ["acceleration"]),
    "orbits of 3 px": ({"orbits": 3.0}, MOVING, ["orbits"]),
    "straight motions": ({}, MOVING, ["orbits"]),
}


def figures(bent, field, terms, seed):
    """Of a set: squared errors, those of the undisplaced set, stated ones, chi2/dof, terms found, ratio, seconds."""
    displaced, free = sky(seed, **bent, **field), sky(seed, **field)
    how = {"motion": "proper", "motion_epoch": 2008.0} if field else {}
    began = time.perf_counter()
    solution = displaced.solve(terms=terms, **how)
    took = time.perf_counter() - began
    off, error = displaced.off(solution, displaced.paths(0.0))
    straight = ~np.isin(solution.stars["star"], displaced.odd) if field else slice(None)
    plain, _ = free.off(free.solve(**how))
    found = [each for each in solution.diagnostics.terms if each.size]
    ratio = found[0].values[0] / bent["refraction"] if found and found[0].name == "refraction" and bent else np.nan
    return (
        np.mean(off[straight] ** 2), np.mean(plain[straight] ** 2), np.mean(error[straight] ** 2),
        solution.chi2 / solution.dof, len(found) / max(len(terms), 1), ratio, took,
    )  # fmt: skip


def main():
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--sets", type=int, default=20)
    n = arguments.parse_args().sets
    warnings.simplefilter("ignore")
    print("| setting | terms | rms, px | without, px | squared pull | chi2/dof | found | value over truth | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, (bent, field, terms) in SETTINGS.items():
        for asked in (terms, []) if bent else (terms,):
            rows = np.array([figures(bent, field, asked, 300 + seed) for seed in range(n)])
            off, plain, stated, chi2, found, ratio, took = rows.mean(axis=0)
            row = f"| {name} | {', '.join(asked) or '-'} | {np.sqrt(off):.4f} | {np.sqrt(plain):.4f} "
            row += f"| {off / stated:.2f} | {chi2:.2f} | {found:.2f} | {ratio:.3f} | {took:.2f} |"
            print(row, flush=True)


if __name__ == "__main__":
    main()
