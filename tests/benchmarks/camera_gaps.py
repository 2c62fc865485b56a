"""A mosaic over the gaps of GSAOI: sharpness and flux of stars that fell on several detectors, beside those of others.

``python tests/benchmarks/camera_gaps.py``: 8 exposures of four detectors of 512 px (the whole field on coarser pixels),
dithered by up to 5 arcsec, detectors of unlike sensitivity and background; images are made from the published numbers
alone (`tests/gsaoi_images.py`). ``--sensitivity 1 1 1 1`` makes the detectors alike.
"""

import argparse
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from scipy.optimize import curve_fit
from scipy.spatial import KDTree

import legdistort as ld
from legdistort.exceptions import LegdistortWarning

sys.path.insert(0, str(Path(__file__).parents[1]))
import gsaoi_images

SIZE, EXPOSURES, HALF, APERTURE = 512, 8, 6, 6.0
SENSITIVITY, SKY = (1.0, 1.08, 0.96, 1.02), (100.0, 140.0, 80.0, 120.0)
#: Stars with so many electrons or more are judged, if no other is nearer than this [pix].
BRIGHT, APART = 10**4.6, 14.0


def mosaic_of(folder, *, seed=5, sensitivity=SENSITIVITY, **options):
    """The night, the fluxes of its stars, and the run from its frames to the mosaic, with its options."""
    night = gsaoi_images.Night(n_exposures=EXPOSURES, n_stars=350, dither=5.0, dynamic=1.6, seed=seed)
    flux = 10 ** np.random.default_rng(seed).uniform(4.3, 5.6, len(night.sky))
    for i in range(EXPOSURES):
        images = night.images(i, size=SIZE, flux=flux, sensitivity=sensitivity, sky=SKY)
        images.writeto(Path(folder) / f"frame{i}.fits")
    frames, camera = str(Path(folder) / "*.fits"), ld.Camera.gsaoi(size=SIZE)
    return night, flux, ld.run(frames, out=Path(folder) / "out", ext="SCI", camera=camera, **options)


def on_true(night, solution):
    """Number of the true star of each star of the solution, by where it lay on the detectors."""
    found, coarse = {}, gsaoi_images.SIZE / SIZE
    for row in solution.residuals:
        xy = night.pixels[int(row["exposure"].removeprefix("frame"))][row["detector"]]
        there = np.array([row["x_detector"].value, row["y_detector"].value])
        distance = np.hypot(*((xy + 0.5) / coarse - 0.5 - there).T)
        if np.nanmin(distance) < 1:
            found[row["star"]] = int(np.nanargmin(distance))
    return np.array([found.get(star, -1) for star in solution.estimate.star_names])


def judged(night, flux, run):
    """Detectors that a star fell on (a set each), FWHM [pix], and flux in the mosaic over the true one."""
    solution, mosaic = run.solution, run.mosaic
    fell, widths, parts = [], [], []
    alone = KDTree(solution.estimate.positions).query(solution.estimate.positions, k=2)[0][:, 1] > APART
    for star, xy, good in zip(
        on_true(night, solution), solution.estimate.positions - mosaic.offset, alone, strict=True
    ):
        if not good or star < 0 or flux[star] < BRIGHT:
            continue
        x, y = np.round(xy).astype(int)
        stamp = mosaic.data[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1]
        if stamp.shape == (2 * HALF + 1, 2 * HALF + 1) and np.isfinite(stamp).all():
            width, light = shape_of(stamp, xy - [x, y])
            fell.append({key for chips in night.pixels for key, at in chips.items() if np.isfinite(at[star, 0])})
            widths.append(width)
            parts.append(light / flux[star])
    return fell, np.array(widths), np.array(parts)


def shape_of(stamp, at):
    """FWHM of the elliptical Gaussian that fits best, and the light within `APERTURE` of it."""
    y, x = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]

    def gaussian(_, peak, x0, y0, a, b, c, level):
        return (peak * np.exp(-a * (x - x0) ** 2 - b * (y - y0) ** 2 - c * (x - x0) * (y - y0)) + level).ravel()

    level = np.median(stamp)
    start = [stamp.max() - level, *at, 0.3, 0.3, 0, level]
    (_, x0, y0, a, b, c, level), _ = curve_fit(gaussian, 0, stamp.ravel(), p0=start)
    inside = np.clip(APERTURE - np.hypot(x - x0, y - y0) + 0.5, 0, 1)
    return 2 * np.sqrt(np.log(2)) * (a * b - c**2 / 4) ** -0.25, np.sum(inside * (stamp - level))


def groups(night, flux, run):
    """``{stars: (number, median FWHM, median part of the flux)}``: those of one detector each, and of several."""
    fell, widths, parts = judged(night, flux, run)
    out = {}
    for name in (*gsaoi_images.CHIPS, "several", "one"):
        several = [len(each) > 1 for each in fell]
        mine = {"several": several, "one": ~np.array(several)}.get(name, [each == {name} for each in fell])
        out[name] = np.count_nonzero(mine), float(np.median(widths[mine])), float(np.median(parts[mine]))
    return out


def main(sensitivity):
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        found = groups(*mosaic_of(folder, sensitivity=sensitivity))
    print(f"{'stars on':>10s} {'number':>7s} {'FWHM':>8s} {'flux / true':>12s}")
    for name, (number, width, part) in found.items():
        print(f"{name:>10s} {number:7d} {width:8.4f} {part / found['one'][2]:12.4f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensitivity", type=float, nargs=4, default=SENSITIVITY)
    warnings.simplefilter("ignore", LegdistortWarning)
    main(parser.parse_args().sensitivity)
