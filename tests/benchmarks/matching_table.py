"""How often matching is right, and rivals: ``python tests/benchmarks/matching_table.py [--fields 12] [--flips]``.

Every field has six exposures (`star_fields.grid_field`). It is right when, of the detections of stars in four exposures
or more, over 95 per cent are found, and over 99 per cent of what is found is right. Rivals lay exposures 2 to 6 on the
first one and are judged pair by pair, by the same measure, as ours is beside them. They match within one radius; 3, 10
and 30 px are tried and the best one counts, though nobody could tell which it is without the truth; after 5 s of the
processor a pair counts as failed. With headers they
get positions turned and shifted as the headers say.
``--flips`` turns two of the exposures over, ``--sizes`` prints time and memory against the number of stars (half of the
detections are false, none where there are a hundred exposures),
``--conditions`` takes what makes the grid hard apart, which the rivals do not stand all at once.
"""

import argparse
import logging
import resource
import signal
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from astropy.table import Table
from scipy.spatial import cKDTree

from legdistort.exceptions import LegdistortError
from legdistort.matching.matcher import match

sys.path.insert(0, str(Path(__file__).parents[1]))
import star_fields as fields

RADII = (3, 10, 30)
#: Seconds of the processor after which a rival counts as having failed.
PATIENCE = 5.0


def give_up(signum, frame):
    """End what takes too long."""
    raise TimeoutError


def positions(table, k):
    """Positions (n, 2) and true stars (n,) of an exposure."""
    rows = table[table["exposure"] == f"e{k:02d}"]
    return np.column_stack([rows["x"], rows["y"]]), np.asarray(rows["truth"])


def score(pairs, first, second):
    """Recall and purity of pairs (rows of the first, rows of the second) of two lists of true stars."""
    wanted = np.intersect1d(first[first >= 0], second[second >= 0]).size
    a, b = first[pairs[0]], second[pairs[1]]
    right = np.count_nonzero((a == b) & (a >= 0))
    return right / wanted, right / max(len(a), 1)


def is_right(recall, purity):
    """The target."""
    return recall > 0.95 and purity > 0.99


def neighbours(mapped, target, radius):
    """Mutual nearest neighbours within a radius."""
    forward, j = cKDTree(target).query(mapped)
    i = cKDTree(mapped).query(target)[1]
    rows = np.flatnonzero((forward < radius) & (i[j] == np.arange(len(mapped))))
    return rows, j[rows]


def astroalign_pairs(source, target):
    """Pairs by its similarity (50 points, its default), for every radius."""
    import astroalign

    signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE)
    try:
        found, _ = astroalign.find_transform(source, target)
    except (astroalign.MaxIterError, TypeError, ValueError, TimeoutError):
        return
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    mapped = found(source)
    for radius in RADII:
        yield neighbours(mapped, target, radius)


def tweakwcs_pairs(source, target):
    """Pairs by its vote on the shift, for every tolerance."""
    from tweakwcs import XYXYMatch
    from tweakwcs.matchutils import MatchSourceConfusionError

    lists = [Table({"TPx": xy[:, 0], "TPy": xy[:, 1]}) for xy in (target, source)]
    for radius in RADII:
        try:
            b, a = XYXYMatch(searchrad=450, separation=0.5, tolerance=radius)(*lists, tp_units="pix")
        except (MatchSourceConfusionError, ValueError, IndexError):
            continue
        yield a, b


def rival_pairs(pairing, table, exposures=None):
    """Recall and purity (5, 2) of a rival that lays exposures 2 to 6 on the first."""
    target, stars = positions(table, 0)
    out = []
    for k in range(1, 6):
        xy, others = positions(table, k)
        if exposures:
            xy = exposures[0].wcs.all_world2pix(exposures[k].wcs.all_pix2world(xy, 0), 0)
        scores = [score((a, b), others, stars) for a, b in pairing(xy, target)]
        out.append(max(scores, default=(0, 0), key=lambda pair: (is_right(*pair), pair)))
    return np.array(out)


def ours(table, exposures=None):
    """Recall and purity of the field (2,), and of the pairs with the first exposure (5, 2)."""
    try:
        found = match(table, exposures=exposures, shape=None if exposures else fields.SHAPE, min_exposures=2).table
    except LegdistortError:
        return np.zeros(2), np.zeros((5, 2))
    pairs = []
    for k in range(1, 6):
        rows = [found[found["exposure"] == f"e{j:02d}"] for j in (0, k)]
        _, a, b = np.intersect1d(rows[0]["star"], rows[1]["star"], return_indices=True)
        a, b = np.asarray(rows[0]["truth"])[a], np.asarray(rows[1]["truth"])[b]
        wanted = np.intersect1d(*(t[t >= 0] for t in (positions(table, 0)[1], positions(table, k)[1]))).size
        right = np.count_nonzero((a == b) & (a >= 0))
        pairs.append((right / wanted, right / max(len(a), 1)))
    _, index, count = np.unique(found["star"], return_inverse=True, return_counts=True)
    return np.array(fields.recall_and_purity(table, found[count[index] >= 4])), np.array(pairs)


def summary(pairs):
    """Per cent of pairs right, and of pairs with half of the stars found."""
    pairs = np.reshape(pairs, (-1, 2))
    right = np.mean([is_right(*pair) for pair in pairs])
    return f"{100 * right:4.0f} {100 * np.mean(pairs[:, 0] > 0.5):4.0f}"


def grid(n_fields, n_rivals, flips):
    """The table."""
    print(f"{n_fields} fields a cell, {n_rivals} for rivals{', two of six exposures flipped' if flips else ''}")
    print("no header / with headers: fields right, lowest recall and purity, % of pairs right and % half found")
    rivals = "  astroalign  XYXYMatch  the same with headers" if n_rivals else ""
    print(f"{'stars':>5s} {'deg':>5s} {'px':>4s}  {'no header':>28s}  {'headers':>28s}{rivals}")
    for cell in fields.CELLS:
        without, withs, others = [], [], []
        for seed in range(n_fields):
            table = fields.grid_field(cell, seed=seed, flips=flips)
            exposures = fields.grid_exposures(cell, seed=seed, flips=flips)
            without.append(ours(table))
            withs.append(ours(table, exposures))
            if seed < n_rivals:
                rivals = (astroalign_pairs, None), (tweakwcs_pairs, None), (tweakwcs_pairs, exposures)
                others.append([rival_pairs(pairing, table, known) for pairing, known in rivals])
        text = []
        for results in (without, withs):
            whole, pairs = (np.array(part) for part in zip(*results, strict=True))
            good = sum(is_right(*w) for w in whole)
            text.append(f"{good:3d} {whole[:, 0].min():.3f} {whole[:, 1].min():.3f} {summary(pairs)}")
        text += [summary(pairs) for pairs in np.swapaxes(others, 0, 1)] if others else []
        print(f"{cell[0]:5d} {cell[1]:5g} {cell[2]:4d} ", "   ".join(text), flush=True)


#: What makes a field of the grid hard, alone and together.
CONDITIONS = {
    "none of it": {},
    "half of the detections false": {"spurious": 1.0},
    "20 px of distortion": {"peak": 20.0},
    "scales 5 % off": {"scales": True},
    "all of it": {"spurious": 1.0, "peak": 20.0, "dynamic": 2.0, "depth": fields.DEPTHS, "scales": True},
}


def conditions(n_fields):
    """Per cent of pairs of exposures that are right, by what makes them hard."""
    print(f"{n_fields} fields a row, no headers: % of pairs right\nstars  deg   px{'':33s} ours  astroalign  XYXYMatch")
    for n, angle, offset in ((100, 0.2, 20), (100, 30, 20), (1000, 0.2, 20), (1000, 30, 300)):
        for name, options in CONDITIONS.items():
            pairs = []
            for seed in range(n_fields):
                made = {"common": 0.9, "spurious": 0.0, "peak": 1e-3} | options
                if "scales" in made:
                    made["scales"] = np.random.default_rng([seed, 7]).uniform(0.95, 1.05, 6)
                table = fields.make_field(n, *fields.six_poses(angle, offset, seed), seed=seed, **made)
                pairs.append(
                    [ours(table)[1], *(rival_pairs(rival, table) for rival in (astroalign_pairs, tweakwcs_pairs))]
                )
            right = [
                100 * np.mean([is_right(*p) for p in np.reshape(each, (-1, 2))]) for each in np.swapaxes(pairs, 0, 1)
            ]
            print(
                f"{n:5d} {angle:4g} {offset:4d}  {name:30s} {right[0]:5.0f} {right[1]:11.0f} {right[2]:10.0f}",
                flush=True,
            )


def sizes():
    """Time of one processor and peak of memory for six exposures and more."""
    print(f"{'stars':>6s} {'exposures':>9s} {'CPU s':>6s} {'GB':>5s} {'recall':>7s} {'purity':>7s}")
    sizes = ((20, 6), (100, 6), (100, 100), (100, 400), (1000, 6), (5000, 6), (5000, 20), (20000, 6))
    for n, n_exposures in sizes:
        spurious = 1.0 if n_exposures < 100 else 0.0
        rng = np.random.default_rng(n)
        where = rng.uniform(-2, 2, n_exposures), rng.uniform(-150, 150, (n_exposures, 2))
        shape = (4096, 4096) if n > 5000 else fields.SHAPE
        table = fields.make_field(n, *where, seed=1, shape=shape, common=0.9, spurious=spurious)
        start = time.process_time()
        matches = match(table, shape=shape)
        spent = time.process_time() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        right = fields.recall_and_purity(table, matches.table)
        print(f"{n:6d} {n_exposures:9d} {spent:6.1f} {peak:5.2f} {right[0]:7.4f} {right[1]:7.4f}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fields", type=int, default=12)
    parser.add_argument("--flips", action="store_true")
    parser.add_argument("--sizes", action="store_true")
    parser.add_argument("--conditions", action="store_true")
    parser.add_argument("--rivals", type=int, default=2, help="fields a cell that rivals try")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable()
    signal.signal(signal.SIGVTALRM, give_up)
    if arguments.sizes:
        sizes()
    elif arguments.conditions:
        conditions(min(arguments.fields, 4))
    else:
        grid(arguments.fields, arguments.rivals, fields.FLIPS if arguments.flips else None)
