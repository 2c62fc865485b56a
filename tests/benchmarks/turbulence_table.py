"""What turbulence leaves in positions: ``python tests/benchmarks/turbulence_table.py --sets 5``.

Eleven exposures of a field with a known static distortion, every one with a von Karman screen of its own (numpy, with
an aperture of a tenth of the detector). By size of the screens and number of stars: rms errors of the stars beyond a
common cubic, those that a dense Gaussian process with the true covariance would leave, squared pulls of the stars and
of others that took no part, the number of sets in which a field was found, and seconds.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from displaced_fields import displaced_by, optimum, squared_pull
from screens import covariance, screens

LAYERS = {"10 m": {}, "50 m": {"width": 50.0, "outer": 10.0, "aperture": 5.0}}
SETTINGS = [
    (0.0, "10 m", 65),
    (0.1, "10 m", 65),
    (0.5, "10 m", 65),
    (2.0, "10 m", 65),
    (0.1, "50 m", 65),
    (0.1, "10 m", 500),
    (0.5, "10 m", 500),
    (2.0, "10 m", 500),
]


def figures(rms, layer, n_stars, seed):
    """Of a set: squared errors, the least, both pulls, whether a field is found, and seconds."""
    field, others = displaced_by(seed, screens(11, 1000 + seed, rms=rms, **LAYERS[layer]) if rms else None, n_stars)
    began = time.perf_counter()
    solution = field.solve(terms=["turbulence"])
    took = time.perf_counter() - began
    off, error = field.off(solution)
    new = others.pull(solution)
    least = optimum(field, lambda a, b: covariance(a, b, rms=rms, **LAYERS[layer])) if rms else np.nan
    return np.mean(off**2), least, squared_pull(off, error), new, bool(solution.diagnostics.terms[0].size), took


def main():
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--sets", type=int, default=5)
    n = arguments.parse_args().sets
    warnings.simplefilter("ignore")
    print("| screens, px | detector | stars | rms, px | least, px | pull of stars | of others | found | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for rms, layer, n_stars in SETTINGS:
        rows = np.array([figures(rms, layer, n_stars, 500 + seed) for seed in range(n)])
        off, least, pull, new, found, took = rows.mean(axis=0)
        print(f"| {rms:g} | {layer} | {n_stars} | {np.sqrt(off):.4f} | {np.sqrt(least):.4f} | {pull:.2f} | {new:.2f} "
              f"| {found * n:.0f} of {n} | {took:.1f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
