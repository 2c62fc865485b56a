"""Table of joint catalogues: ``python tests/benchmarks/catalogue_table.py [--seeds N] [--hit PART ...] [--cost]
[--artificial N]``.

Eleven deep frames of 640 x 640 px, 900 stars of a signal-to-noise ratio of 0.8 to 200 a frame, most of them faint,
random dithers and distortions, rendered without the package; measured, matched and solved, then `legdistort.catalogue`.
For every part of pixels hit by cosmic rays: stars that single frames show (`run`), rows; the part of the true stars
found above 6, from 6 to 7 and above 8 (ratios of all frames together, neighbours known); false rows, within a FWHM of
no star above 3, and rows that pass for galaxies; rms of deviations over the joint bound (everything about all stars
unknown) and over the stated errors, above 8 and from 5 to 8; processor seconds of measuring and of the catalogue. With
``--cost`` eleven frames of 2048 x 2048 px with 9200 stars: seconds alone (set OPENBLAS_NUM_THREADS=1). With
``--artificial`` so many stars are put into each of the sets without hits, and nothing else is shown: the part found of
those and of true stars, and the difference; the median excess of the fluxes of rows over their errors, as ``flux_bias``
states it and as it is; by ratio of signal to noise. Below: false rows of a million pixels, those of negative light
and those that are false.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
from deep_frames import EDGE, artificial_inside, compared, deep_frames, excess

import legdistort as ld
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.flags import Flag


def catalogued(truth, **options):
    """Solution and catalogue of frames, and the seconds of measuring and of the catalogue."""
    exposures = [Exposure(f"f{k:02d}", data, gain=1.0) for k, data in enumerate(truth.frames)]
    begun = time.process_time()
    table = ld.measure(exposures, psf="moffat")
    measured = time.process_time() - begun
    solution = ld.solve(ld.match(table, exposures=exposures))
    begun = time.process_time()
    return solution, ld.catalogue(exposures, solution, **options), (measured, time.process_time() - begun)


def beside_truth(truth, solution, stars):
    """`deep_frames.compared` of a catalogue."""
    size = truth.frames[0].shape[0]
    inside = ((truth.pixels[0] > 0) & (truth.pixels[0] < size - 1)).all(axis=1)
    start = np.full_like(truth.xy, np.nan)
    start[inside] = solution["f00"].correct(truth.pixels[0][inside])
    return compared(truth, stars, start)


def show(hit, seeds):
    """The row of one part of hit pixels."""
    out = []
    for seed in range(7, 7 + seeds):
        truth = deep_frames(seed, hit=hit)
        solution, found, seconds = catalogued(truth)
        c = beside_truth(truth, solution, found.stars)
        parts = [c.found(6), c.found(6, 7), c.found(8)]
        ratios = [*c.ratios(8), *c.ratios(5, 8)]
        extended = np.count_nonzero(found.stars["flags"] & Flag.EXTENDED)
        out.append([len(solution.stars), len(found.stars), *parts, c.n_false, c.n_rows, extended, *ratios, *seconds])
    n, rows, all6, low6, all8, false, of, extended, *rest = np.mean(out, axis=0)
    cells = [f"{100 * hit:g} %", f"{n:.0f}", f"{rows:.0f}", *(f"{100 * v:.1f} %" for v in (all6, low6, all8))]
    cells += [f"{false:.1f} of {of:.0f}", f"{extended:.1f}", *(f"{v:.2f}" for v in rest[:4])]
    cells += [f"{v:.0f} s" for v in rest[4:]]
    print(f"| {' | '.join(cells)} |", flush=True)


def show_artificial(n, seeds):
    """The rows of artificial stars beside true ones."""
    true, made, bias, false, spent = [], [], [], [], 0.0
    for seed in range(7, 7 + seeds):
        truth = deep_frames(seed)
        solution, found, seconds = catalogued(truth, artificial=n)
        c, stars = beside_truth(truth, solution, found.stars), found.completeness.stars
        stars = stars[artificial_inside(truth, c, stars)]
        true.append((c.snr, c.row >= 0))
        made.append((np.asarray(stars["snr"]), np.asarray(stars["found"])))
        bias.append(excess(truth, c, found.stars))
        inside = (truth.frames[0].shape[0] - 1 - 2 * EDGE) ** 2
        false.append((found.completeness.by_flux.meta["n_false"] / found.stars.meta["area"], c.n_false / inside))
        spent += seconds[1]
    print(
        "| snr | artificial | found | true | found | difference | rows | excess stated | excess |\n" + "|---" * 9 + "|"
    )
    for low, high in ((2.7, 4), (4, 5), (5, 6), (6, 8), (8, 12), (12, 50)):
        cells, parts = [f"{low}-{high}"], []
        for sets in (made, true):
            snr, hit = np.concatenate(sets, axis=1)
            hit = hit[(snr >= low) & (snr < high)]
            parts.append((hit.mean(), (hit.sum() + 0.5) * (len(hit) - hit.sum() + 0.5) / (len(hit) + 1) ** 3))
            cells += [f"{len(hit)}", f"{100 * hit.mean():.1f} %"]
        (one, square), (other, its) = parts
        cells.append(f"{100 * (one - other):.1f} +- {100 * np.sqrt(square + its):.1f} %")
        snr, off, stated = np.concatenate(bias, axis=1)
        own = (snr >= low) & (snr < high)
        if low >= 5:
            error = 1.25 * np.std(off[own]) / np.sqrt(own.sum())
            cells += [f"{own.sum()}", f"{np.nanmedian(stated[own]):.2f}", f"{np.median(off[own]):.2f} +- {error:.2f}"]
        print(f"| {' | '.join(cells)} |", flush=True)
    print("false rows of a million pixels: {:.1f} by negative light, {:.1f} true".format(*1e6 * np.mean(false, axis=0)))
    print(f"{seeds} catalogues with {n} artificial stars each: {spent:.0f} s")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--hit", type=float, nargs="*", default=[0.0, 2e-4, 1e-2])
    parser.add_argument("--cost", action="store_true")
    parser.add_argument("--artificial", type=int)
    arguments = parser.parse_args()
    if arguments.artificial:
        show_artificial(arguments.artificial, arguments.seeds)
        return
    print(
        "| pixels hit | in `run` | rows | found > 6 | 6-7 | > 8 | false | EXTENDED | rms / bound > 8 | pull > 8 "
        "| rms / bound 5-8 | pull 5-8 | measuring | catalogue |\n" + "|---" * 14 + "|"
    )
    for hit in arguments.hit:
        show(hit, arguments.seeds)
    if arguments.cost:
        _, found, seconds = catalogued(deep_frames(7, size=2048, n_stars=9200, bounds=False))
        print(f"2048 x 2048 px: {len(found.stars)} rows, measuring {seconds[0]:.0f} s, catalogue {seconds[1]:.0f} s")


if __name__ == "__main__":
    main()
