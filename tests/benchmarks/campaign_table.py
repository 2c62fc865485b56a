"""A campaign of 403 lists of two clusters over six years to one camera: ``python tests/benchmarks/campaign_table.py``.

To the figures of Freeman et al. (2023, AJ 166, 125; OSIRIS): 41 nights of ten lists of some 1000 stars of 0.02 px, a
static distortion of 20 px, mostly of second order, departures of nights and of single lists. Time of solving all nights
and of combining them on some cores (the lists are made before), error of the map beside what departures alone leave of
it, and squared error over stated variance.

``--reckoning``: processor time and memory of solving a night, alone in a process, and of what it says of the camera, by
the number of observations; how many bytes that is; and the time to add so many nights.
"""

import argparse
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
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


def cost(path):
    """What a night costs, in a process that does nothing else: a row of the reckoning."""
    table, times = pickle.loads(Path(path).read_bytes()), []
    for _ in range(2):  # loops are compiled, or loaded, the first time
        times.append(time.process_time())
        solution = ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)))
    times.append(time.process_time())
    says = ld.combine_nights([solution])
    times.append(time.process_time())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    file = solution.write(Path(path).with_suffix(".asdf")).stat().st_size / 1e6
    return len(table), *np.diff(times)[1:], peak, file, len(pickle.dumps(says.nights[0]))


def reckoning():
    """Print what nights cost by their size, each in a process of its own, and how long it takes to add many."""
    rng = np.random.default_rng(1)
    static = curved(rng, 20.0) * np.where(ORDERS == 2, 1.0, 0.1)
    print("lists  observations  solved [s of a processor]  reduced [s]  memory [MB]  file [MB]  sent back [bytes]")
    for exposures, n_stars in ((10, 1700), (50, 1700), (50, 5000), (50, 17_000)):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "table"
            how = {"exposures": exposures, "single": SINGLE, "n_stars": n_stars, "year": 2010}
            path.write_bytes(pickle.dumps(night(0, static, **how)))
            command = [sys.executable, __file__, "--cost", str(path)]
            done = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        row = json.loads(done.splitlines()[-1])
        print("{:5d} {:13d} {:26.2f} {:12.2f} {:12.0f} {:10.1f} {:18d}".format(exposures, *row), flush=True)
    first = solved(night(0, static, exposures=10, single=SINGLE, n_stars=400, year=2010))
    (says,) = first.nights
    for count in (50, 200, 1000, 2000):
        around = says.around + rng.normal(0, NIGHTLY, (count, *says.around.shape))
        nights = tuple(
            replace(says, name=f"{i}", date=2010 + 6 * i / count, around=each, exposures=())
            for i, each in enumerate(around)
        )
        begun = time.process_time()
        camera = ld.combine_nights([replace(first, nights=nights, oddness=np.ones(count))])
        words = f"{len(camera.odd)} odd, {time.process_time() - begun:.2f} s of a processor"
        print(f"{count} nights added: {words}", flush=True)


def main():
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nights", type=int, default=41)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--reckoning", action="store_true", help="cost of nights by their size, and of adding them")
    parser.add_argument("--cost", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.cost:
        print(json.dumps(cost(asked.cost)))
        return
    if asked.reckoning:
        reckoning()
        return
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
