"""A campaign of 403 lists of two clusters over six years to one camera: ``python tests/benchmarks/campaign_table.py``.

To the figures of Freeman et al. (2023, AJ 166, 125; OSIRIS): 41 nights of ten lists of some 1000 stars of 0.02 px, a
static distortion of 20 px, mostly of second order, departures of nights and of single lists. Time of solving all nights
and of combining them on some cores (the lists are made before), error of the map beside what departures alone leave of
it, and squared error over stated variance.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from night_sets import SIZE, field
from rolled_night import modes, night

import legdistort as ld
from legdistort.runtime.parallel import map_items

ORDERS = np.add.outer(np.arange(4), np.arange(4))
NIGHTLY, SINGLE = 0.1, 0.05


def curved(rng, size):
    """A map of degrees 2 and 3."""
    return field(rng, size) * (ORDERS > 1)


def solved(table):
    """What a night says, of its matched lists."""
    solution = ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)))
    return ld.combine_nights([solution])


def one_more(static, rng):
    """Print how long one list more takes that comes into a finished solution of some 400 of one field."""
    table = night(998, static + curved(rng, NIGHTLY), turns=(0, 90), exposures=403, single=SINGLE, n_stars=1700)
    names = np.asarray(table["exposure"])
    late = names == names[-1]
    known = {"shape": (SIZE, SIZE)}
    matches = ld.Matches.from_table(table[~late], **known)
    new = ld.Matches.from_table(table[late], **known)
    for _ in range(2):  # loops are compiled the first time
        begun = time.perf_counter()
        base = ld.solve(matches)
        solved = time.perf_counter()
        more = ld.solve(new, base=base)
        done = time.perf_counter()
    print(f"{len(base.names)} lists of one field, {np.sum(~late)} positions, solved in {solved - begun:.2f} s")
    print(f"one more ({len(more.names)}) in {done - solved:.2f} s")


def main():
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nights", type=int, default=41)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    rng = np.random.default_rng(1)
    static = curved(rng, 20.0) * np.where(ORDERS == 2, 1.0, 0.1)
    tables = []
    for i in range(asked.nights):
        turns = ((0, 90), (0, 200), (0, 45, 90))[i % 3]
        own = static + curved(rng, NIGHTLY)
        how = {"exposures": 10 if i else 3, "single": SINGLE, "n_stars": 1700, "year": 2010 + 6 * i / asked.nights}
        tables.append(night(i, own, turns=turns, **how))
    n_lists, n_rows = sum(len(set(t["exposure"])) for t in tables), sum(map(len, tables))
    begun = time.perf_counter()
    nights = list(map_items(solved, tables, workers=asked.workers))
    each = time.perf_counter() - begun
    camera = ld.combine_nights(nights)
    whole = time.perf_counter() - begun
    found, covariance = camera.static()
    off, variance = (found - modes(static))[:, 3:].ravel(), np.diag(covariance).reshape(2, -1)[:, 3:].ravel()
    scale = (modes(np.ones((2, 4, 4)) / (1 + ORDERS)) ** 2)[:, 3:].ravel()  # of coefficients of size 1
    least = np.sqrt(np.mean(scale) * (NIGHTLY**2 + SINGLE**2 / 10) / asked.nights)
    print(f"{n_lists} lists, {n_rows} positions; {os.cpu_count()} cores, {asked.workers} workers")
    print(f"nights solved in {each:.1f} s, all in {whole:.1f} s")
    error = np.sqrt(np.mean(off**2))
    print(f"error of a coefficient {error:.4f} px, {error / least:.2f} of what departures leave")
    print(f"squared pull {np.sum(off**2) / variance.sum():.2f}, drift {camera.rate:.3g}, odd {len(camera.odd)}")
    more = night(999, static + curved(rng, NIGHTLY), exposures=10, single=SINGLE, n_stars=1700, year=2016.2)
    begun = time.perf_counter()
    camera = ld.combine_nights([camera, solved(more)])
    print(f"one more night in {time.perf_counter() - begun:.1f} s")
    one_more(static, rng)


if __name__ == "__main__":
    main()
