"""Table of crowded fields: ``python tests/benchmarks/crowded_table.py [--stars N ...] [--seeds N] [--psf true]``.

Frames of a globular cluster (King profile, 1024 x 1024 px, FWHM 4 px, signal-to-noise ratios from 3 to 2000), their
truth drawn and rendered without the package. For every range of signal-to-noise ratios: the part of the stars found;
rms and robust scatter of the deviations over the joint bound, with all neighbours unknown; of rows that are not flagged
(`UNUSABLE`, ``DEFORMED``) robust scatter and rms of deviations over errors, and the part beyond 5; the part flagged.
Below: rows without a star within 2 px, and processor seconds (set OPENBLAS_NUM_THREADS=1).
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
import king_field as king

import legdistort as ld
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.flags import UNUSABLE, Flag

RATIOS = [(10, 30), (30, 100), (100, np.inf)]


def true_psf():
    """The PSF of the frames."""
    places = np.arange(-80, 81) / 4
    return ld.EffectivePSF.from_array(king.moffat(places, places[:, None]), oversampling=4, source="true")


def measured(field, psf):
    """Table of a frame, and processor seconds."""
    exposure = Exposure("frame", field.data, gain=1.0, read_noise=king.READ_NOISE)
    start = time.process_time()
    return ld.measure(exposure, psf=psf), time.process_time() - start


def compared(field, table):
    """Of true stars: ratio, found, deviations over bounds and over errors, flagged; and the number of false rows."""
    size = field.data.shape[0]
    xy, error = (np.column_stack([table[a].value, table[b].value]) for a, b in (("x", "y"), ("x_err", "y_err")))
    rows, left = king.paired(field, xy)
    found, inside = rows >= 0, ((field.xy > 3) & (field.xy < size - 4)).all(axis=1)
    off = xy[rows] - field.xy
    flagged = (table["flags"][rows] & (UNUSABLE | Flag.DEFORMED)) != 0
    values = np.column_stack([field.snr, found, off / king.joint_bounds(field), off / error[rows], flagged])
    return values[inside], np.count_nonzero(left & ((xy > 3) & (xy < size - 4)).all(axis=1))


def robust(values):
    """Standard deviation of the middle half."""
    return 1.4826 * np.median(np.abs(values))


def show(n, seeds, psf):
    """The rows of one number of stars."""
    parts, false, rows, seconds = [], 0, 0, []
    for seed in range(seeds):
        field = king.king_field(n, seed)
        table, time_taken = measured(field, psf)
        values, unpaired = compared(field, table)
        parts.append(values)
        false, rows = false + unpaired, rows + len(table)
        seconds.append(time_taken)
    values = np.concatenate(parts)
    for low, high in RATIOS:
        of = values[(values[:, 0] >= low) & (values[:, 0] < high)]
        found = of[of[:, 1] > 0]
        bound, pull, flagged = found[:, 2:4], found[found[:, 6] == 0, 4:6], found[:, 6].mean()
        print(
            f"{n} stars, {low}-{high:g}: found {found.shape[0] / of.shape[0]:.3f} | over bound "
            f"{np.sqrt(np.mean(bound**2)):.2f}, {robust(bound):.2f} | over error {robust(pull):.2f}, "
            f"{np.sqrt(np.mean(pull**2)):.2f}, beyond 5 {100 * np.mean(np.abs(pull) > 5):.1f} % | "
            f"flagged {100 * flagged:.0f} %"
        )
    print(f"{n} stars: false {100 * false / rows:.2f} % of {rows} rows; {np.mean(seconds):.1f} s")
    sys.stdout.flush()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stars", nargs="+", type=int, default=[1000, 3000])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--psf", default="auto", help="auto, moffat, effective or true")
    given = parser.parse_args()
    for number in given.stars:
        show(number, given.seeds, true_psf() if given.psf == "true" else given.psf)
