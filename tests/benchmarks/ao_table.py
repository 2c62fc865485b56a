"""How good positions on adaptive-optics images are: ``python tests/benchmarks/ao_table.py FOLDER [options]``.

For every PSF and third of brightness: rms deviation of positions from the truth over the Cramer-Rao bound of the true
PSF, rms of deviation / error, false stars, completeness, and the part that `match` would keep. Positions are compared
after the common polynomial of the PSF's field order, which the bounds and errors go through as well. Frames and what
every method found in them are kept in FOLDER; ``--redo`` measures again. ``--crowded`` makes the table of crowded
fields instead: rms of deviation / error of isolated stars with no other near, by signal-to-noise ratio. ``--strength``
multiplies elongation and coma, ``--halo`` sets the FWHM of the halo [pix], ``--stars`` and ``--faintest`` the number
of stars and the smallest signal-to-noise ratio: each takes a FOLDER of its own. ``--order 2`` compares positions in
crowded fields after a quadratic map: up to that order the own error of an effective PSF belongs to the distortion of
the exposure.
"""

import argparse
import os
import pickle
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parent.parent))
import ao_images as ao
import psf_rivals

from legdistort.inputs.exposures import Exposure
from legdistort.measurement.crowding import is_isolated
from legdistort.measurement.flags import UNUSABLE
from legdistort.measurement.positions import measure

#: Signal-to-noise ratios, flux over its bound, between the thirds.
THIRDS = np.geomspace(10, 1000, 4)
CELLS = [f"{kind}-{strehl:g}" for kind in ao.SHAPES for strehl in ao.STREHLS] + ["psfao-0"]
#: Strehl ratios and numbers of stars of crowded fields, the edges between their columns, and how far the next star is.
CROWDS, RATIOS, LONELY = [(0.1, 60), (0.3, 110), (0.6, 214), (0.1, 214)], [30, 100, 300], 10.0
#: A row farther from all true stars than this is false; a star's own row is nearer than the other [pix].
FALSE, OWN = 3.0, 2.0


def ours(**options):
    """`measure`: positions, errors, fluxes, and what `match` keeps."""

    def method(frame):
        exposure = Exposure("frame", frame.data, gain=ao.GAIN, read_noise=ao.READ_NOISE)
        table = measure(exposure, **options)
        table = table[(table["flags"] & UNUSABLE) == 0]
        xy, error = (np.column_stack([table[a].value, table[b].value]) for a, b in (("x", "y"), ("x_err", "y_err")))
        return xy, error, np.asarray(table["flux"]), is_isolated(table)

    return method


def true_psf(frame):
    """A fit with the true PSF from the true positions: what the bound is."""
    kind, strehl, *_, seed = frame.name.split("-")  # of crowded ones there is the number of stars, too
    strehl, seed, size = float(strehl), int(seed), len(frame.data)
    _, psf = ao.start_crowded(strehl, seed, size) if kind == "crowd" else ao.start(kind, strehl, seed, size)
    error = np.sqrt(np.einsum("naa->na", frame.covariance))
    return ao.fit_true(frame, psf), error, frame.flux


METHODS = {
    "truth": true_psf,
    "default": ours(),
    "moffat": ours(psf="moffat"),
    "effective": ours(psf="effective"),
    "sextractor": psf_rivals.sextractor,
    "psfex": psf_rivals.psfex,
    "photutils": psf_rivals.epsf_builder,
}


def frame_of(folder, cell, seed, stars):
    """A frame, from the folder if it is there; `stars`: options of `ao_images.frame`."""
    path = folder / f"{cell}-{seed}.npz"
    if not path.exists():
        kind, strehl = cell.rsplit("-", 1)
        frame = ao.frame(kind, float(strehl), seed, **stars)
        np.savez(path, **vars(frame))
    with np.load(path) as saved:
        values = {name: saved[name] for name in saved.files}
    return ao.Frame(**(values | {"name": str(values["name"]), "order": int(values["order"])}))


def found_in(folder, frame, name, redo):
    """What a method finds: positions, errors, fluxes, kept or not, and seconds."""
    path = folder / name / f"{frame.name}.npz"
    path.parent.mkdir(exist_ok=True)
    if redo or not path.exists():
        start = sum(os.times()[:4])  # of this process and of the programs that it started
        xy, error, flux, *kept = METHODS[name](frame)
        seconds = sum(os.times()[:4]) - start
        np.savez(path, xy=xy, error=error, flux=flux, kept=kept[0] if kept else np.ones(len(xy), bool), seconds=seconds)
    with np.load(path) as saved:
        return [saved[key] for key in ("xy", "error", "flux", "kept", "seconds")]


def compare(frame, found):
    """One row a true star: third, found, kept, deviation / bound, / error in x, y; and one a detection: flux, false."""
    xy, error, flux, kept, _ = found
    row = ao.identify(xy, frame.xy, OWN)
    seen = row >= 0
    out = np.full((len(row), 7), np.nan)
    out[:, 0] = np.clip(np.digitize(frame.snr, THIRDS) - 1, 0, 2)
    out[:, 1], out[:, 2] = seen, np.where(seen, kept[row], False)
    false = np.min(np.hypot(*(xy[:, None] - frame.xy).T), axis=0) > FALSE
    if np.count_nonzero(seen) > 2 * (frame.order + 1) ** 2:
        row = row[seen]
        stated = error[row, :, None] ** 2 * np.eye(2)
        left, bound, own = ao.mapped(
            xy[row] - frame.xy[seen], frame.xy[seen], frame.order, len(frame.data), frame.covariance[seen], stated
        )
        for k, covariance in ((3, bound), (5, own)):
            out[seen, k : k + 2] = left / np.sqrt(np.einsum("naa->na", covariance))
    detections = np.column_stack([flux, false])
    return out, detections[np.isin(np.arange(len(xy)), row) | false]


def rms(values):
    """Root mean square of what is finite."""
    return np.sqrt(np.mean(values[np.isfinite(values)] ** 2))


def found_before(detections, n):
    """Part of n true stars that are brighter than all but 1 % of as many false ones."""
    false = detections[np.argsort(-detections[:, 0]), 1]
    allowed = np.cumsum(false) <= 0.01 * n
    return np.count_nonzero(allowed & (false == 0)) / n


def show(cell, name, folder, n_frames, redo, stars):
    """One row of the table."""
    parts, detections, seconds = [], [], []
    for seed in range(n_frames):
        frame = frame_of(folder, cell, seed, stars)
        found = found_in(folder, frame, name, redo)
        for collected, part in zip((parts, detections), compare(frame, found), strict=True):
            collected.append(part)
        seconds.append(float(found[-1]))
    table, detections = np.concatenate(parts), np.concatenate(detections)
    texts = []
    for third in (None, 0, 1, 2):
        rows = table if third is None else table[table[:, 0] == third]
        ratio, pull = rows[:, 3:5], rows[:, 5:7]
        text = f"{rms(ratio):6.2f} {1.4826 * np.nanmedian(np.abs(ratio)):5.2f} [{rms(pull):5.2f}]"
        texts.append(f"{text} {100 * rows[:, 1].mean():4.0f} {100 * rows[:, 2].mean():4.0f}")
    false = f"{100 * detections[:, 1].sum() / len(table):6.1f} {100 * found_before(detections, len(table)):4.0f}"
    print(f"{cell:14s} {name:11s} {false} |", " | ".join(texts), f"| {np.mean(seconds):5.1f} s")


def show_crowded(strehl, n, name, folder, n_frames, redo, order):
    """One row of the table of crowded fields."""
    parts = []
    for seed in range(n_frames):
        path = folder / f"crowd-{strehl:g}-{n}-{seed}.pickle"
        if not path.exists():
            path.write_bytes(pickle.dumps(ao.crowded_frame(strehl, seed, n=n)))
        frame = replace(pickle.loads(path.read_bytes()), order=order)
        found = found_in(folder, frame, name, redo)
        rows = compare(frame, [part[found[3]] for part in found[:4]] + found[4:])[0]
        lonely = cKDTree(frame.xy).query(frame.xy, k=2)[0][:, 1] > LONELY
        rows[:, 0] = np.digitize(frame.snr, RATIOS)
        parts.append(rows[lonely & (frame.snr > THIRDS[0]) & (rows[:, 1] > 0)])
    table = np.concatenate(parts)
    cells = (table[table[:, 0] == k] for k in range(len(RATIOS) + 1))
    texts = (f"{rms(rows[:, 3:5]):5.2f} [{rms(rows[:, 5:7]):5.2f}] {len(rows):4d}" for rows in cells)
    print(f"Strehl {strehl:g}, {n} stars, {name:11s}", " | ".join(texts))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--psf", nargs="+", default=CELLS, help="as symmetric-0.05: shape and Strehl ratio")
    parser.add_argument("--method", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--strength", type=float, default=1.0)
    parser.add_argument("--halo", type=float, default=25.0)
    parser.add_argument("--stars", type=int, default=60)
    parser.add_argument("--faintest", type=float, default=10.0)
    parser.add_argument("--crowded", action="store_true")
    parser.add_argument("--order", type=int, default=0)
    parser.add_argument("--redo", action="store_true")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    ao.SHAPES = {
        kind: {name: given.strength * by for name, by in more.items()} | {"halo_fwhm": given.halo}
        for kind, more in ao.SHAPES.items()
    }
    warnings.simplefilter("ignore")  # of photutils: fits without convergence
    if given.crowded:
        print("rms / bound, [rms of deviation / error], stars; by signal-to-noise ratio: 10-30, 30-100, 100-300, above")
        for strehl, n in CROWDS:
            for name in given.method:
                show_crowded(strehl, n, name, given.folder, given.frames, given.redo, given.order)
        sys.exit()
    print(
        "% false stars, % found that are brighter than all but 1 % of false ones; all stars, then thirds of "
        "brightness: rms / bound, the same by the median, [rms of deviation / error], % found, % kept by match"
    )
    for cell in given.psf:
        for name in given.method:
            show(cell, name, given.folder, given.frames, given.redo, {"n": given.stars, "lowest": given.faintest})
            sys.stdout.flush()
