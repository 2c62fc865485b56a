"""A rough static distortion and a mask of pinholes: ``python tests/benchmarks/rough_table.py``.

By map and by what is fitted: error of the map beyond a quadratic that holes and map cannot tell apart, and that of
least squares with the true covariance of the map, in units of the noise; chi2 over its degrees of freedom; error that
is stated of new positions over the true one, both beyond degree 5; seconds.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from rough_optics import Mask, beyond

from legdistort.results import new_positions

SETTINGS = {
    "1 px rms beyond degree 5": {},
    "the same, spectrum less steep": {"power": 7.5},
    "noise alone": {"rough": 1e-9},
}
FITS = {"degree 17": {"degree": 17}, "degree 5 and rough_static": {"terms": "rough_static"}}


def figures(mask, how):
    """Errors of map, optimum and new positions in units of the noise, chi2/dof, and seconds."""
    q = mask.at()
    truth, began = mask.map(q), time.perf_counter()
    solution = mask.solve(**how)
    took = time.perf_counter() - began
    errors = [values - truth for values in (solution["m0"].distortion(q) - q, mask.optimum(q)[0])]
    off, best = (np.std(beyond(each, q, mask.size, 2)) / mask.noise for each in errors)
    stated = new_positions.relative_errors(solution["m0"], q)
    stated = np.sqrt(np.trace(stated, axis1=1, axis2=2).mean() / 2) / np.std(beyond(errors[0], q, mask.size, 5))
    return off, best, solution.chi2 / solution.dof, stated, took


def main():
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--sets", type=int, default=1)
    n = arguments.parse_args().sets
    warnings.simplefilter("ignore")
    print("| map | fit | error, noise | optimum, noise | chi2/dof | stated over true error | s |")
    print("|---|---|---|---|---|---|---|")
    for name, setting in SETTINGS.items():
        for fit, how in FITS.items():
            rows = np.array([figures(Mask(seed=seed, **setting), how) for seed in range(n)])
            off, best, chi2, stated, took = np.mean(rows, axis=0)
            print(f"| {name} | {fit} | {off:.2f} | {best:.2f} | {chi2:.3f} | {stated:.2f} | {took:.0f} |", flush=True)


if __name__ == "__main__":
    main()
