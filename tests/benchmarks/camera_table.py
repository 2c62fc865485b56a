"""Four detectors of GSAOI solved as one focal plane, and each by itself: errors beside their bound, and the time.

``python tests/benchmarks/camera_table.py --sets 20``: 11 exposures, about 80 stars a detector, degree 3, published
statics. Positions are made from the published numbers alone (`tests/gsaoi_images.py`). Stars that lie on one detector
in three exposures and more are compared, after a common map of degree 3 of those of each detector.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np

import legdistort as ld
from legdistort.exceptions import LegdistortWarning

sys.path.insert(0, str(Path(__file__).parents[1]))
import gsaoi_images

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
            stars, single = alone.star_names, bounds(night, mine)
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
    rows = np.searchsorted(solution.star_names, stars)
    left = gsaoi_images.without_common_map(solution.positions[rows], sky[stars], 3)
    centred = gsaoi_images.without_common_map(np.eye(len(stars)), sky[stars], 3)
    best = np.sqrt(np.trace(centred @ covariance @ centred.T) / len(stars))
    errors = np.stack([solution.stars[name].value[rows] for name in ("x_err", "y_err")], axis=1)
    free = len(stars) / (len(stars) - 10)  # of the map that was fitted just now
    return np.sqrt(np.mean(left**2)), best, np.sqrt(free * np.mean((left / errors) ** 2))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=20)
    warnings.simplefilter("ignore", LegdistortWarning)
    main(parser.parse_args().sets)
