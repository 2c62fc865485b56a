"""Table of stars with structure of the pupil around them: ``python tests/benchmarks/pupil_table.py [KIND ...]``.

Frames of 45 isolated stars of signal-to-noise ratios from 5 to 1500 behind adaptive optics (`tests/pupil_images.py`:
waffle, arms, control ring, speckles), their truth without the package. For every kind: usable rows farther than 0.6
FWHM from every star, per true star; the part of the stars found, by signal-to-noise ratio; the deviations of positions
over errors, after a quadratic map of the frame (of the middle 68 %); fluxes over the light within 30 FWHM (median and
scatter of those above 50) and seconds a frame.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parent.parent))
import pupil_images

import legdistort as ld
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.flags import UNUSABLE

RATIOS = [(5, 10), (10, 30), (30, 100), (100, np.inf)]


def measured(kind, seed, psf):
    """Telescope and frame of the kind, the table and processor seconds."""
    rng = np.random.default_rng(seed)
    sampling, r0 = pupil_images.KINDS[kind]
    telescope = pupil_images.Telescope(rng, sampling=sampling, r0=r0)
    frame = pupil_images.frame(telescope, rng)
    exposure = Exposure("frame", frame.data, gain=1.0, read_noise=pupil_images.READ_NOISE)
    start = time.process_time()
    return telescope, frame, ld.measure(exposure, psf=psf), time.process_time() - start


def mapped_off(off, xy, error):
    """Deviations over errors, less a polynomial of the second degree: the centre of the PSF moves over the field."""
    u, v = (xy / xy.max() - 0.5).T
    terms = np.stack([np.ones_like(u), u, v, u**2, u * v, v**2], axis=1)
    out = []
    for d, e in zip(off.T, error.T, strict=True):
        weights = 1 / np.hypot(e, 0.01)[:, None]
        out.append((d - terms @ np.linalg.lstsq(terms * weights, d * weights[:, 0], rcond=None)[0]) / e)
    return np.stack(out, axis=1)


def show(kind, seeds, psf):
    """The line of a kind."""
    false, strehl, seconds, found, pull, light = 0, [], [], [], [], []
    for seed in seeds:
        telescope, frame, table, taken = measured(kind, seed, psf)
        table = table[(table["flags"] & UNUSABLE) == 0]
        xy = np.column_stack([table["x"].value, table["y"].value])
        off, row = cKDTree(xy).query(frame.xy)
        there = off < 0.6 * frame.fwhm
        false += np.count_nonzero(cKDTree(frame.xy).query(xy)[0] > 0.6 * frame.fwhm)
        error = np.column_stack([table["x_err"].value, table["y_err"].value])[row]
        found.append(np.column_stack([frame.snr, there]))
        good = there & (frame.snr > 10)
        pull.append(mapped_off((xy[row] - frame.xy)[good], frame.xy[good], error[good]))
        light.append((table["flux"][row] / frame.flux)[there & (frame.snr > 50)] / telescope.within(30 * frame.fwhm))
        strehl.append(telescope.strehl)
        seconds.append(taken)
    found, pull, light = (np.concatenate(parts) for parts in (found, pull, light))
    parts = [found[(found[:, 0] >= a) & (found[:, 0] < b), 1].mean() for a, b in RATIOS]
    print(
        f"{kind} (Strehl {np.mean(strehl):.2f}): false per star {false / len(found):.3f} | found "
        f"{', '.join(f'{part:.2f}' for part in parts)} | pulls {np.quantile(np.abs(pull), 0.6827):.2f} | flux "
        f"{np.median(light):.3f}, scatter {np.std(light):.3f} | {np.mean(seconds):.1f} s"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=list(pupil_images.KINDS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--psf", default="auto", help="auto, moffat or effective")
    given = parser.parse_args()
    for kind in given.kinds:
        show(kind, range(given.seeds), given.psf)
