"""Table of joint catalogues: ``python tests/benchmarks/catalogue_table.py [--seeds N] [--hit PART ...] [--cost]``.

Eleven deep frames of 640 x 640 px, 900 stars of a signal-to-noise ratio of 0.8 to 200 a frame, most of them faint,
random dithers and distortions, rendered without the package; measured, matched and solved, then `legdistort.catalogue`.
For every part of pixels hit by cosmic rays: stars that single frames show (`run`), rows; the part of the true stars
found above 6, from 6 to 7 and above 8 (ratios of all frames together, neighbours known); false rows, within a FWHM of
no star above 3; rms of deviations over the joint bound (everything about all stars unknown) and over the stated errors,
above 8 and from 5 to 8; processor seconds of measuring and of the catalogue. With ``--cost`` eleven frames of
2048 x 2048 px with 9200 stars: seconds alone (set OPENBLAS_NUM_THREADS=1).
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
from deep_frames import compared, deep_frames

import legdistort as ld
from legdistort.inputs.exposures import Exposure


def catalogued(truth):
    """Solution and catalogue of frames, and the seconds of measuring and of the catalogue."""
    exposures = [Exposure(f"f{k:02d}", data, gain=1.0) for k, data in enumerate(truth.frames)]
    begun = time.process_time()
    table = ld.measure(exposures, psf="moffat")
    measured = time.process_time() - begun
    solution = ld.solve(ld.match(table, exposures=exposures))
    begun = time.process_time()
    return solution, ld.catalogue(exposures, solution), (measured, time.process_time() - begun)


def show(hit, seeds):
    """The row of one part of hit pixels."""
    out = []
    for seed in range(7, 7 + seeds):
        truth = deep_frames(seed, hit=hit)
        solution, found, seconds = catalogued(truth)
        size = truth.frames[0].shape[0]
        inside = ((truth.pixels[0] > 0) & (truth.pixels[0] < size - 1)).all(axis=1)
        start = np.full_like(truth.xy, np.nan)
        start[inside] = solution["f00"].correct(truth.pixels[0][inside])
        c = compared(truth, found.stars, start)
        parts = [c.found(6), c.found(6, 7), c.found(8)]
        ratios = [*c.ratios(8), *c.ratios(5, 8)]
        out.append([len(solution.stars), len(found.stars), *parts, c.n_false, c.n_rows, *ratios, *seconds])
    n, rows, all6, low6, all8, false, of, *rest = np.mean(out, axis=0)
    cells = [f"{100 * hit:g} %", f"{n:.0f}", f"{rows:.0f}", *(f"{100 * v:.1f} %" for v in (all6, low6, all8))]
    cells += [f"{false:.1f} of {of:.0f}", *(f"{v:.2f}" for v in rest[:4]), *(f"{v:.0f} s" for v in rest[4:])]
    print(f"| {' | '.join(cells)} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--hit", type=float, nargs="*", default=[0.0, 2e-4, 1e-2])
    parser.add_argument("--cost", action="store_true")
    arguments = parser.parse_args()
    print(
        "| pixels hit | in `run` | rows | found > 6 | 6-7 | > 8 | false | rms / bound > 8 | pull > 8 | rms / bound 5-8 "
        "| pull 5-8 | measuring | catalogue |\n" + "|---" * 13 + "|"
    )
    for hit in arguments.hit:
        show(hit, arguments.seeds)
    if arguments.cost:
        _, found, seconds = catalogued(deep_frames(7, size=2048, n_stars=9200, bounds=False))
        print(f"2048 x 2048 px: {len(found.stars)} rows, measuring {seconds[0]:.0f} s, catalogue {seconds[1]:.0f} s")


if __name__ == "__main__":
    main()
