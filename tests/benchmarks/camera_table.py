"""Four detectors of GSAOI solved as one focal plane, and each by itself: errors beside their bound, and the time.

``python tests/benchmarks/camera_table.py --sets 20``: 11 exposures, about 80 stars a detector, degree 3, published
statics. Positions are made from the published numbers alone (`tests/gsaoi_images.py`). Stars that lie on one detector
in three exposures and more are compared, after a common map of degree 3 of those of each detector.

``python tests/benchmarks/camera_table.py --cost 3``: what four detectors cost against one of them, step by step from
frames to mosaic, 11 exposures of 512 px detectors, each CPU time the least of so many rounds in turn.

``python tests/benchmarks/camera_table.py --calibrate 40``: layouts and static distortions found from dithers alone, and
from dithers with rolls; errors beside the bound of a dense matrix of all unknowns, over so many draws.

``python tests/benchmarks/camera_table.py --headers 5``: layouts of headers that are wrong, so many seeds each; stars
that cross from detector to detector, found and all of them, and squared pulls of stars and of the middles of detectors
after the map that these have in common; where no star crosses, those of the stars of each detector by themselves
(`tests/header_layouts.py`).
"""

import argparse
import logging
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.wcs.storage import write_wcs

sys.path.insert(0, str(Path(__file__).parents[1]))
import gsaoi_calibration
import gsaoi_images
import header_layouts

SIGMA, LEAST = 0.01, 3


def main(n_sets):
    """Print the table."""
    camera = ld.Camera.gsaoi()
    rows = {"all detectors": [], "each alone": []}
    seconds = {"all detectors": 0.0, "each alone": 0.0}
    for seed in range(n_sets):
        night = gsaoi_images.Night(n_stars=470, seed=seed)
        table = night.table(sigma=SIGMA, seed=1000 + seed, least=LEAST)
        whole, spent = solved(table, camera)
        seconds["all detectors"] += spent
        best = bounds(night, table)
        for key in camera.detectors:
            mine = table[table["detector"] == key]
            mine = mine[np.bincount(mine["star"])[mine["star"]] >= LEAST]
            alone, spent = solved(mine, ld.Camera(key, {key: camera[key]}))
            seconds["each alone"] += spent
            stars, single = alone.estimate.star_names, bounds(night, mine)
            both = [best[0][np.searchsorted(best[1], star)] for star in stars]
            for name, solution, covariance in (
                ("all detectors", whole, best[2][np.ix_(both, both)]),
                ("each alone", alone, single[2]),
            ):
                rows[name].append(compared(solution, night.sky, stars, covariance))
    print(f"{'':14s} {'error':>8s} {'bound':>8s} {'ratio':>6s} {'pull^2':>7s} {'time':>8s}")
    for name, found in rows.items():
        error, best, pull = np.sqrt(np.mean(np.square(np.array(found)), axis=0))
        spent = seconds[name] / n_sets
        print(f"{name:14s} {error:8.5f} {best:8.5f} {error / best:6.3f} {pull**2:7.3f} {1e3 * spent:6.0f} ms")


def cost(n_rounds):
    """Print what each step costs with four detectors and with one."""
    spent = {"four": [], "one": []}
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        night = gsaoi_images.Night(n_stars=350, dither=5.0, dynamic=1.6, seed=5)
        flux = 10 ** np.random.default_rng(5).uniform(4.3, 5.6, len(night.sky))
        for i in range(11):
            night.images(i, size=512, flux=flux).writeto(folder / f"frame{i:02d}.fits")
        for k in range(n_rounds):
            spent["four"].append(steps(folder, folder / f"four{k}", "SCI", ld.Camera.gsaoi(size=512)))
            spent["one"].append(steps(folder, folder / f"one{k}", ("SCI", 2), None))
    least = {name: {step: min(each[step] for each in rounds) for step in rounds[0]} for name, rounds in spent.items()}
    print(f"{'':10s} {'four':>8s} {'one':>8s} {'ratio':>6s}   (CPU seconds)")
    for step, four in least["four"].items():
        print(f"{step:10s} {four:8.3f} {least['one'][step]:8.3f} {four / least['one'][step]:6.2f}")
    total = [sum(least[name].values()) for name in ("four", "one")]
    print(f"{'all':10s} {total[0]:8.3f} {total[1]:8.3f} {total[0] / total[1]:6.2f}")


def steps(folder, out, ext, camera):
    """CPU seconds of every step, ``{name: seconds}``."""
    out.mkdir()
    seconds, begin = {}, time.process_time()

    def lap(name):
        nonlocal begin
        seconds[name], begin = time.process_time() - begin, time.process_time()

    exposures = ld.read_exposures(str(folder / "*.fits"), ext=ext)
    lap("read")
    detections = ld.measure(exposures)
    lap("measure")
    matches = ld.match(detections, exposures=exposures, camera=camera)
    lap("match")
    known = {} if camera else {"prior": ld.Prior(np.array(ld.Camera.gsaoi(size=512)["2"].static))}
    begin = time.process_time()
    solution = ld.solve(matches, degree=3, **known)
    lap("solve")
    for name in solution.names:
        for key in camera.detectors if camera else [None]:
            write_wcs(solution[name, key], out / f"{name}-{key}.asdf")
    lap("WCS files")
    ld.coadd(exposures, solution, method="clipped")
    lap("co-add")
    return seconds


def solved(table, camera):
    """A solution, and the seconds that it took from the table on."""
    start = time.perf_counter()
    solution = ld.solve(ld.Matches.from_table(table, camera=camera), degree=3)
    return solution, time.perf_counter() - start


def bounds(night, table):
    """Numbers of the stars, the stars, and the covariance that no estimate of their positions can beat, pixels^2."""
    stars, number = np.unique(table["star"], return_inverse=True)
    exposure = np.array([int(name[5:]) for name in table["exposure"]])
    place = np.stack([night.focal[i][j] for i, j in zip(exposure, table["star"], strict=True)])
    exposure = np.unique(exposure, return_inverse=True)[1]
    covariance = gsaoi_images.covariance(number, exposure, place - place.mean(axis=0), SIGMA, 3)
    return np.arange(len(stars)), stars, covariance


def compared(solution, sky, stars, covariance):
    """Error, bound and pull, each rms, of stars after a common map of degree 3 of these stars."""
    rows = np.searchsorted(solution.estimate.star_names, stars)
    left = gsaoi_images.without_common_map(solution.estimate.positions[rows], sky[stars], 3)
    centred = gsaoi_images.without_common_map(np.eye(len(stars)), sky[stars], 3)
    best = np.sqrt(np.trace(centred @ covariance @ centred.T) / len(stars))
    errors = np.stack([solution.stars[name].value[rows] for name in ("x_err", "y_err")], axis=1)
    free = len(stars) / (len(stars) - 10)  # of the map that was fitted just now
    return np.sqrt(np.mean(left**2)), best, np.sqrt(free * np.mean((left / errors) ** 2))


def calibrate(draws):
    """Print how well a camera is found from its own exposures."""
    print(f"{'':18s} {'':8s} {'error':>8s} {'bound':>8s} {'ratio':>6s} {'pull^2':>7s}   unknown")
    for name, turn in (("dithers", 0.0), ("dithers and rolls", 0.8)):
        found = gsaoi_calibration.calibrate(turn, draws)
        unknown = ", ".join(found.solution.gauge.unknown_names) or "nothing"
        for k, what in enumerate(("stars", "layout", "static")):
            error, best = found.errors[k], found.bounds[k]
            print(
                f"{name * (k == 0):18s} {what:8s} {error:8.5f} {best:8.5f} {error / best:6.3f} {found.pulls[k]:7.3f}   "
                f"{unknown * (k == 0)}"
            )


def headers(n_seeds):
    """Print whether stars are found over the gaps, and errors are true, where headers have the detectors elsewhere."""
    print(f"{'positions':10s} {'off':>5s} {'turned':>7s} {'dither':>7s} {'found':>6s} {'of':>5s}  "
          f"{'pull^2':>7s} {'layout':>7s}  camera, absolute")  # fmt: skip
    wrong = [(1.0, 0.0), (2.5, 0.0), (5.0, 0.0), (10.0, 0.1)]
    rows = [("lists", *each, 80.0) for each in wrong] + [("lists", 2.5, 0.0, 13.0)]
    for source, off, turn, dither in [*rows, ("images", 2.5, 0.0, 80.0), ("images", 2.5, 0.0, 13.0)]:
        known = {"off": off, "turn": turn, "dither": dither}
        found = np.array([_of_headers(source, seed, **known) for seed in range(n_seeds)], dtype=object)
        n, total = found[:, :2].sum(axis=0)
        stars, layout = found[:, 2:4].astype(float).mean(axis=0)
        states = " | ".join(sorted(set(found[:, 4])))
        row = f"{source:10s} {off:5.1f} {turn:7.1f} {dither:7.0f} {n:6d} {total:5d}  {stars:7.2f} {layout:7.2f}"
        print(f"{row}  {states}")


def _of_headers(source, seed, **known):
    """Stars found over the gaps, all of them, squared pulls of stars and layout, states of two checks."""
    night = header_layouts.Night(seed, **known)
    if source == "lists":
        matches = ld.match(night.table, exposures=night.exposures)
    else:
        with tempfile.TemporaryDirectory() as folder:
            night.write(Path(folder))
            exposures = ld.read_exposures(f"{folder}/e*.fits", ext="SCI")
            matches = ld.match(ld.measure(exposures), exposures=exposures)
    solution = ld.solve(matches)
    true, seen = night.true_stars(solution), {}
    number = dict(zip(solution.stars["star"], true, strict=True))
    for star, detector in zip(solution.residuals["star"], solution.residuals["detector"], strict=True):
        seen.setdefault(star, set()).add(detector)
    crossing = night.crossing() & set(true.tolist())
    found = {number[star] for star, detectors in seen.items() if len(detectors) > 1} & crossing
    apart = "group" in solution.stars.colnames
    groups = [np.asarray(solution.stars["group"]) == g for g in range(4)] if apart else None
    layout = np.nan if apart else night.layout_pull(solution.camera)
    states = {check.name: check.state for check in solution.checks}
    stars = np.mean(night.pulls(solution, groups=groups))
    return len(found), len(crossing), stars, layout, f"{states['camera']}, {states['absolute']}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--cost", type=int, default=0, metavar="ROUNDS")
    parser.add_argument("--calibrate", type=int, default=0, metavar="DRAWS")
    parser.add_argument("--headers", type=int, default=0, metavar="SEEDS")
    warnings.simplefilter("ignore", LegdistortWarning)
    logging.disable(logging.WARNING)
    arguments = parser.parse_args()
    if arguments.cost:
        cost(arguments.cost)
    elif arguments.headers:
        headers(arguments.headers)
    elif arguments.calibrate:
        calibrate(arguments.calibrate)
    else:
        main(arguments.sets)
