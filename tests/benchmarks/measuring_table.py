"""Figures of measuring: ``python tests/benchmarks/measuring_table.py [PART ...] [--frames N]``.

``rivals``: rms error of positions over the Cramer-Rao bound, beside SExtractor (windowed positions, if the command
``source-extractor`` is there) and photutils; ``widths``: the same for legdistort at seven widths; ``profile``: what a
shape common to the frame gains; ``crowded``: blends fitted together and one by one; ``speed``: processor seconds of one
process (set OPENBLAS_NUM_THREADS=1).
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from astropy.io import ascii as ascii_io
from astropy.io import fits
from astropy.stats import sigma_clipped_stats
from photutils.detection import DAOStarFinder
from photutils.psf import GaussianPSF, MoffatPSF, PSFPhotometry
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parent.parent))
import ao_images as ao
import star_images as sky

from legdistort.inputs.exposures import Exposure
from legdistort.measurement.positions import Flag, measure

BINS = [(10, 30), (30, 100), (100, 300), (300, 1000)]


def ours(image, fwhm, **options):
    """Positions (n, 2) and errors (n, 2)."""
    table = sky.usable(measure(Exposure("frame", image, gain=sky.GAIN), **options))
    return sky.positions(table), sky.errors(table)


def shared(image, fwhm):
    """The same with the shape common to the frame."""
    return ours(image, fwhm, profile="shared")


def sextractor(image, fwhm):
    """Windowed positions."""
    shipped = Path("/usr/share/source-extractor")
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        fits.writeto(folder / "frame.fits", image)
        (folder / "columns").write_text("XWIN_IMAGE\nYWIN_IMAGE\nERRAWIN_IMAGE\nFLAGS\n")
        options = {
            "PARAMETERS_NAME": folder / "columns",
            "FILTER_NAME": shipped / "gauss_3.0_7x7.conv" if fwhm > 2.5 else shipped / "gauss_2.0_5x5.conv",
            "STARNNW_NAME": shipped / "default.nnw",
            "CATALOG_NAME": folder / "found.cat",
            "CATALOG_TYPE": "ASCII_HEAD",
            "GAIN": sky.GAIN,
            "DETECT_THRESH": 1.2,
            "DETECT_MINAREA": 3,
            "SATUR_LEVEL": 1e9,
            "SEEING_FWHM": fwhm,
            "PIXEL_SCALE": 1,
            "VERBOSE_TYPE": "QUIET",
        }
        words = [word for key, value in options.items() for word in (f"-{key}", str(value))]
        command = ["source-extractor", str(folder / "frame.fits"), "-c", str(shipped / "default.sex"), *words]
        subprocess.run(command, check=True, cwd=folder)
        found = ascii_io.read(folder / "found.cat", format="sextractor")
    found = found[found["FLAGS"] == 0]
    xy = np.column_stack([found["XWIN_IMAGE"], found["YWIN_IMAGE"]]) - 1
    return xy, np.repeat(np.asarray(found["ERRAWIN_IMAGE"])[:, None], 2, axis=1)


def daofinder(image, fwhm):
    """Positions without errors."""
    _, median, std = sigma_clipped_stats(image)
    found = DAOStarFinder(3.5 * std, fwhm)(image - median)
    return np.column_stack([found["x_centroid"], found["y_centroid"]]), None


def _photometry(image, fwhm, model, free):
    _, median, std = sigma_clipped_stats(image)
    for name in free:
        model.fixed[name] = False
    side = 2 * max(4, int(np.ceil(2 * fwhm))) + 1
    noise = np.sqrt(std**2 + np.maximum(image - median, 0) / sky.GAIN)
    fitter = PSFPhotometry(model, (side, side), finder=DAOStarFinder(3.5 * std, fwhm), aperture_radius=fwhm)
    found = fitter(image - median, error=noise)
    errors = np.column_stack([found["x_err"], found["y_err"]]).astype(float)
    keep = np.isfinite(errors).all(axis=1) & (np.asarray(found["flux_fit"]) > 0)
    return np.column_stack([found["x_fit"], found["y_fit"]])[keep], errors[keep]


def psf_moffat(image, fwhm):
    """Round Moffat profiles, width and beta free."""
    return _photometry(image, fwhm, MoffatPSF(alpha=fwhm, beta=3.0), ("alpha", "beta"))


def psf_gaussian(image, fwhm):
    """Elliptical Gaussian profiles, all free."""
    model = GaussianPSF(x_fwhm=1.1 * fwhm, y_fwhm=fwhm / 1.1, theta=20)
    return _photometry(image, fwhm, model, ("x_fwhm", "y_fwhm", "theta"))


def frames(n, fwhm, seed=0, *, lowest=9):
    """Signal-to-noise ratios and bounds of the stars of some frames, with image and true positions."""
    rng = np.random.default_rng(seed)
    ratio, flux, limit = sky.ladder(400, fwhm, lowest)
    for _ in range(n):
        xy, order = sky.scattered(rng, 400, 800), rng.permutation(400)
        yield (
            sky.observe(sky.image((800, 800), xy, flux[order], fwhm), rng),
            xy,
            ratio[order],
            limit[order],
            flux[order],
        )


def matched(xy, truth, radius):
    """Rows found, and their stars."""
    distance, star = cKDTree(truth).query(xy)
    rows = np.flatnonzero(distance < radius)
    rows = rows[np.argsort(distance[rows])]
    _, first = np.unique(star[rows], return_index=True)
    return rows[first], star[rows[first]]


def rivals(n):
    """Rms error over the bound and number of stars, by signal-to-noise ratio."""
    methods = [ours, shared, psf_moffat, psf_gaussian, daofinder]
    methods += [sextractor] * (shutil.which("source-extractor") is not None)
    for fwhm in (4.5, 2.0):
        _compare(methods, n, fwhm)


def widths(n):
    """The same for legdistort alone, from undersampled to wide images."""
    for fwhm in (1.2, 1.6, 2.0, 2.5, 3.5, 4.5, 6.0):
        _compare([ours], n, fwhm)


def _compare(methods, n, fwhm):
    print(f"\nFWHM {fwhm} px: rms / bound, (stars), [std of (x - truth) / error]")
    images = list(frames(n, fwhm))
    for method in methods:
        parts, start = [], time.process_time()
        for image, truth, ratio, limit, _ in images:
            xy, error = method(image, fwhm)
            rows, star = matched(xy, truth, 0.4 * fwhm)
            off = xy[rows] - truth[star]
            off -= np.median(off[ratio[star] > 30], axis=0)  # conventions of pixels count against nobody
            z = off / error[rows] if error is not None else np.full(off.shape, np.nan)
            parts.append(np.column_stack([ratio[star], off / limit[star], z]))
        _print_bins(method.__name__, np.concatenate(parts))
        print(f"    {(time.process_time() - start) / n:.2f} s a frame" if method is not sextractor else "")


def _print_bins(name, rows):
    cells = []
    for low, high in BINS:
        part = rows[(rows[:, 0] >= low) & (rows[:, 0] < high)]
        cells.append(f"{np.sqrt(np.mean(part[:, 1:3] ** 2)):7.3f} ({len(part)}) [{np.std(part[:, 3:5]):.3f}]")
    print(f"{name:13s}", " ".join(cells), end="")


def profiles(n, fwhm=4.5):
    """Errors of positions and fluxes near the limit, with the three kinds of shape."""
    images = list(frames(n, fwhm, seed=1, lowest=5))
    for kind in ("own", "shared", "linear"):
        parts = []
        for image, truth, ratio, limit, flux in images:
            table = sky.usable(measure(Exposure("frame", image, gain=sky.GAIN), profile=kind, threshold=4))
            rows, star = matched(sky.positions(table), truth, 0.5 * fwhm)
            off, error = (sky.positions(table)[rows] - truth[star]), sky.errors(table)[rows]
            of_flux = np.asarray(table["flux"][rows]) / flux[star] - 1
            parts.append(np.column_stack([ratio[star], off / limit[star], off / error, of_flux]))
        table = np.concatenate(parts)
        for low, high in ((5, 10), *BINS):
            rows = table[(table[:, 0] >= low) & (table[:, 0] < high)]
            rms = np.sqrt(np.mean(rows[:, 1:3] ** 2))
            z, flux = np.std(rows[:, 3:5]), 1.4826 * np.median(np.abs(rows[:, 5]))
            print(f"{kind:7s} {low:4d}-{high:4d}: {len(rows)} stars, rms / bound {rms:.3f}, z {z:.3f}, flux {flux:.4f}")


def crowded(n, fwhm=3.5, size=600):
    """Positions in a field with a star every 4 FWHM, blends fitted together or alone."""
    rng, count = np.random.default_rng(2), int((size / (4 * fwhm)) ** 2)
    _, flux, _ = sky.ladder(count, fwhm, 8, 500)
    images = []
    for _ in range(n):
        xy, order = rng.uniform(5, size - 5, (count, 2)), rng.permutation(count)
        images.append((sky.observe(sky.image((size, size), xy, flux[order], fwhm), rng), xy))
    for options in ({"blends": "alone"}, {"blends": "together"}, {"blends": "together", "profile": "shared"}):
        parts = []
        for image, truth in images:
            table = sky.usable(measure(Exposure("frame", image, gain=sky.GAIN), **options))
            rows, star = matched(sky.positions(table), truth, 1.5)
            off, error = sky.positions(table)[rows] - truth[star], sky.errors(table)[rows]
            nearest = cKDTree(truth).query(truth, k=2)[0][star, 1] / fwhm
            alone = (table["flags"][rows] & Flag.BLENDED) == 0
            parts.append(np.column_stack([nearest, alone, off, error]))
        table = np.concatenate(parts)
        apart, touching = table[:, 0], table[:, 1] == 0
        print(", ".join(f"{key} {value}" for key, value in options.items()))
        for name, which in (
            ("isolated, nearest star beyond 3 FWHM", (apart > 3) & ~touching),
            ("blend of 1.5 to 2 FWHM", (apart > 1.5) & (apart < 2) & touching),
            ("blend of 1.1 to 1.5 FWHM", (apart > 1.1) & (apart < 1.5) & touching),
        ):
            off, error = table[which, 2:4], table[which, 4:]
            z = 1.4826 * np.median(np.abs(off / error))
            print(f"  {name:37s} {len(off):5d}: median {np.median(np.abs(off)):.4f} px, (x - truth) / error {z:.2f}")


def speed(n):
    """Processor seconds of the default, of Moffat profiles and of effective PSFs on the same frames, in turn."""
    for name, exposure in timed_frames():
        times = {"auto": [], "moffat": [], "effective": []}
        for _ in range(n):
            for psf, each in times.items():
                start = time.process_time()
                found = measure(exposure, psf=psf)
                each.append(time.process_time() - start)
        least = {psf: min(each) for psf, each in times.items()}
        ratios = ", ".join(f"{psf} / moffat {least[psf] / least['moffat']:.2f}" for psf in ("auto", "effective"))
        chosen = measure(exposure)["psf"][0]
        print(
            f"{name}: {len(found)} found, moffat {least['moffat']:.2f} s, {ratios}; auto chooses {chosen}", flush=True
        )


def timed_frames():
    """Names and exposures: stars with Moffat profiles, few and many, and cores in a halo, in frames of two sizes."""
    for count in (100, 5000):
        rng = np.random.default_rng(count)
        _, flux, _ = sky.ladder(count, 4.1)
        image = sky.image((2048, 2048), sky.scattered(rng, count, 2048), rng.permutation(flux), 4.1)
        yield f"2048 x 2048, {count} Moffats", Exposure("frame", sky.observe(image, rng), gain=sky.GAIN)
    for size, count in ((1024, 60), (2048, 100)):
        frame = ao.frame("symmetric", 0.3, 0, n=count, size=size)
        exposure = Exposure("frame", frame.data, gain=ao.GAIN, read_noise=ao.READ_NOISE)
        yield f"{size} x {size}, {count} at Strehl 0.3", exposure


if __name__ == "__main__":
    parts = {"rivals": rivals, "widths": widths, "profile": profiles, "crowded": crowded, "speed": speed}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART")
    parser.add_argument("--frames", type=int, default=6)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # of photutils: fits without convergence
    for part in arguments.parts or parts:
        parts[part](arguments.frames)
