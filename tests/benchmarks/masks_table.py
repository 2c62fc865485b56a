"""Exposures of masks of 27 x 27 holes that are shifted by up to 150 px: how often holes are mixed, by what is known.

``python tests/benchmarks/masks_table.py --sets 100``; the sets are made by numpy alone (`tests/masks.py`).
"""

import argparse
import logging
import sys
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from masks import SIZE, mixed, night

import legdistort as ld
from legdistort.exceptions import MatchError

KINDS = {
    "edges outside": {},
    "edges inside, 5 % missed": {"pitch": 70.0, "missed": 0.05},
    "perfect holes": {"wrong": 0.0},
    "perfect holes, 5 % stopped up": {"wrong": 0.0, "stopped": 0.05},
    "perfect holes, rough detector": {"rough": 0.05, "wrong": 0.0},
}


def outcome(seed, kind, off):
    """What becomes of a set, and seconds: right, warned (right), mixed warned, mixed, refused, other."""
    table, stated = night(seed, **kind)
    rng, pitch = np.random.default_rng(1000 + seed), kind.get("pitch", 100.0)
    start = off and {
        name: each + rng.uniform(-1, 1, 3) * [off * pitch, off * pitch, 0.2] for name, each in stated.items()
    }
    begin = time.process_time()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            matches = ld.match(table, shape=(SIZE, SIZE), start=start)
        except MatchError as error:
            return ("refused" if "of period" in str(error) else "other"), time.process_time() - begin
    word = "mixed" if mixed(matches) else "right"
    return word + " warned" * bool(told), time.process_time() - begin


def main(n_sets):
    """Print a row for every kind of mask, turns of the exposures, and start positions."""
    words = ("right", "right warned", "refused", "mixed warned", "mixed", "other")
    print(f"| mask | turns | starts off by up to | {' | '.join(words)} | s |\n|{'---|' * (len(words) + 4)}")
    for label, kind in KINDS.items():
        for turns in ("none", "both"):
            for off in (None, 0.25):
                found = [outcome(seed, kind | {"turns": turns}, off) for seed in range(n_sets)]
                counts = [sum(word == each for each, _ in found) for word in words]
                known = "none given" if off is None else f"{off:g} of a period"
                seconds = np.mean([each for _, each in found])
                print(f"| {label} | {turns} | {known} | {' | '.join(map(str, counts))} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=100)
    logging.disable(logging.WARNING)
    main(parser.parse_args().sets)
