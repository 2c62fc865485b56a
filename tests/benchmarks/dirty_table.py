"""Stars that a detector with every kind of defect costs.

``python tests/benchmarks/dirty_table.py [--seeds N] [--first N]``

Nights with the defects and without (`dirty_detector`), measured and matched without any mask. A star is kept if it is
among the matches in 60 % of the frames that it lies in, or more. Two of the 22 bright stars are saturated. Untouched
are detections around which what is no star's differs by less than the noise; of them those are lost that the clean
night keeps, before matching.
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
import dirty_detector as detector

from legdistort.matching.matcher import match
from legdistort.measurement.flags import UNUSABLE, Flag
from legdistort.measurement.positions import measure

KINDS = ("hot", "lines", "amplifiers", "persistence", "hits", "streaks", "response")


def found(seed, **options):
    """A night, where its stars are in the usable detections, and where in the matches."""
    night = detector.night(seed, **options)
    table = measure(detector.exposures(night.frames))
    usable = table[(table["flags"] & (UNUSABLE | Flag.DEFORMED)) == 0]
    matches = match(table, shape=night.frames[0].shape)
    return night, detector.seen(usable, night.xy), detector.seen(matches.table, night.xy)


def row(name, seed, clean, **options):
    """One line: bright and faint stars kept, and what untouched ones lose."""
    night, usable, matched = found(seed, **options)
    kept = detector.kept(matched, detector.inside(night.xy))
    bright, faint = kept[: detector.N_BRIGHT].sum(), kept[detector.N_BRIGHT :].sum()
    lost = ""
    if clean is not None:
        far = detector.untouched(night) & clean
        lost = f"{100 * np.mean(~usable[far]):6.1f} % of {far.sum()}"
    print(f"{seed:4d} {name:20s} {bright:6d} {faint:6d}   {lost}", flush=True)
    return usable, bright


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--kinds", action="store_true", help="every kind by itself, too")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    print("seed night                bright  faint   untouched stars lost")
    for seed in range(args.first, args.first + args.seeds):
        clean, _ = row("clean", seed, None, dirty=False)
        row("dirty", seed, clean)
        for kind in KINDS if args.kinds else ():
            row(kind, seed, clean, without=[other for other in KINDS if other != kind])


if __name__ == "__main__":
    main()
