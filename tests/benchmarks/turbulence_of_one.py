"""Turbulence of single real exposures, by a catalogue: ``python tests/benchmarks/turbulence_of_one.py``.

Offsets of stars of two exposures of the Dark Energy Survey from Gaia (Fortino et al. 2021, AJ 162, 106; real data,
found through LEGDISTORT_DATA). A fold of the stars takes no part: the mean product of their offsets over pairs closer
than one arcminute, after `View.correct` over before; the same of the Gaussian process of the authors; mean square in
stated errors, which have the factors that were found; seconds of `legdistort.solve`.
"""

import argparse
import os
import time
import warnings
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from scipy.spatial import cKDTree

import legdistort as ld

SCALE, WIDTH = 0.263, 2.18  # arcsec, degrees: pixels of the camera, and a square that the offsets are in


def exposure(path):
    """Places (n, 2) of stars and their offsets from Gaia, pixels; covariances (n, 2, 2); folds; the authors' field."""
    table = fits.getdata(path, 1)
    table = table[table["Mask0"].astype(bool) & table["Maskf"].astype(bool)]
    pixel = 1e3 * SCALE  # mas
    places = (np.column_stack([table["X"], table["Y"]]).astype(float) + WIDTH / 2) * 3.6e6 / pixel
    offsets = np.column_stack([table["dX"], table["dY"]]).astype(float) / pixel
    noise = (table["DES variance"] + table["GAIA covariance"]).astype(float) / pixel**2
    fold = np.argmax(np.stack([table[f"Subset {name}"] for name in "ABCDE"], axis=1), axis=1)
    theirs = np.column_stack([table["fbar_s dX"], table["fbar_s dY"]]) / pixel
    return places, offsets, noise, fold, theirs


def covariance(places, offsets):
    """Of offsets of stars within an arcminute."""
    first, second = cKDTree(places).query_pairs(60 / SCALE, output_type="ndarray").T
    return np.mean(np.sum(offsets[first] * offsets[second], axis=1))


def figures(path, left_out):
    """Of a file: what is left, by the authors too, the squared pull, and seconds."""
    places, offsets, noise, fold, theirs = exposure(path)
    used, size = fold != left_out, int(WIDTH * 3600 / SCALE)
    errors = np.sqrt(noise[:, [0, 1], [0, 1]])
    table = QTable({"exposure": ["e"] * used.sum(), "star": np.flatnonzero(used)})
    table["x"], table["y"] = (places + offsets)[used].T * u.pix
    table["x_err"], table["y_err"] = errors[used].T * u.pix
    known = QTable({"star": np.flatnonzero(used)})
    known["x"], known["y"] = places[used].T * u.pix
    known["x_err"] = known["y_err"] = np.full(used.sum(), 1e-3) * u.pix
    began = time.perf_counter()
    solution = ld.solve(ld.Matches.from_table(table, shape=(size, size)), reference=known, terms="turbulence")
    took = time.perf_counter() - began
    found = dict(zip(solution.terms["number"], solution.terms["value"], strict=True))
    factors = [found[f"factor on {axis} errors"] for axis in "xy"]
    corrected = solution["e"].correct((places + offsets)[~used], errors=errors[~used] * factors)
    off, before = corrected.xy - places[~used], covariance(places[~used], offsets[~used])
    pull = np.mean(np.einsum("na,nab,nb->n", off, np.linalg.inv(corrected.absolute), off)) / 2
    rest = covariance(places[~used], off), covariance(places[~used], (offsets - theirs)[~used])
    return rest[0] / before, rest[1] / before, pull, took


def main():
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--folds", type=int, default=5)
    n = arguments.parse_args().folds
    warnings.simplefilter("ignore")
    folder = Path(os.environ.get("LEGDISTORT_DATA", "../shared/data")) / "turbulence_des"
    print("| exposure | left | by the authors | squared pull | s |")
    print("|---|---|---|---|---|")
    for path in sorted(folder.glob("des_GPR*.fits")):
        left, theirs, pull, took = np.mean([figures(path, fold) for fold in range(n)], axis=0)
        print(f"| {path.stem.split('.', 1)[1]} | {left:.3f} | {theirs:.3f} | {pull:.2f} | {took:.0f} |", flush=True)


if __name__ == "__main__":
    main()
