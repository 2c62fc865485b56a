"""Table of stacks in README.md: ``python tests/benchmarks/coadd_table.py [--small] [--only WORDS] [--rounds N]``.

A simulated GSAOI night (eleven frames of 2048 x 2048 px) is measured and solved; then legdistort, reproject, SWarp and
drizzle co-add the same frames with the same distortions on the same grid, each in a process of its own, one after the
other, on one core, from the files on disk to an image in a file. This script imports nothing but the standard library,
so that the largest memory of a process (``ru_maxrss``) is its own.
"""

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

#: Row of the table -> (kernel by which rows are compared, function, its arguments).
METHODS = {
    "legdistort, bilinear": ("bilinear", "ours", {"order": 1}),
    "legdistort with reproject's splines, bilinear": ("bilinear", "ours", {"order": 1, "compiled": False}),
    "reproject_and_coadd, defaults": ("bilinear", "reproject", {}),
    "SWarp, BILINEAR": ("bilinear", "swarp", {"kernel": "BILINEAR"}),
    "drizzle package, square": ("bilinear", "drizzle", {"kernel": "square"}),
    "legdistort, drizzle": ("bilinear", "ours", {"algorithm": "drizzle"}),
    "legdistort, order 3": ("cubic", "ours", {"order": 3}),
    "legdistort with reproject's splines, order 3": ("cubic", "ours", {"order": 3, "compiled": False}),
    "reproject_and_coadd, bicubic": ("cubic", "reproject", {"order": "bicubic"}),
    "SWarp, LANCZOS3": ("cubic", "swarp", {"kernel": "LANCZOS3"}),
    "drizzle package, lanczos3": ("cubic", "drizzle", {"kernel": "lanczos3"}),
    "legdistort, adaptive": ("adaptive", "ours", {"algorithm": "adaptive"}),
    "reproject_interp, one frame, gwcs as its file opens": ("one frame", "single_reproject", {"stock": True}),
    "reproject_interp, one frame": ("one frame", "single_reproject", {"stock": False}),
    "legdistort, bilinear, one frame": ("one frame", "single_ours", {"order": 1}),
    "legdistort, order 3, one frame": ("one frame", "single_ours", {"order": 3}),
}


# --- steps, each in its own process ------------------------------------------------------------------------------


def prepare(folder, small):
    """Frames, solution, frames with TPV headers, truth, and the grid that all use."""
    import numpy as np
    from astropy.io import fits

    from legdistort import coadd, match, measure, read_exposures, simulate_exposures, solve
    from legdistort.assessment.truth import nearest
    from legdistort.geometry.gsaoi import gsaoi_static
    from legdistort.priors.prior import Prior
    from legdistort.wcs.attachment import attach

    night = simulate_exposures(small=small, seed=0)
    paths = night.write(folder / "frames")
    shape = night.truth.shape
    exposures = read_exposures(paths)
    prior = Prior.from_model(gsaoi_static(2, size=shape[1]), shape=shape, direction="detector_to_reference", degree=5)
    solution = solve(match(measure(exposures), exposures=exposures), prior=prior, clip=5.0)
    solution.write(folder / "solution.asdf")
    attach(solution, paths, out=folder / "tpv", kind="tpv")
    mosaic = coadd(exposures[:], solution, order=1)
    header = mosaic.wcs.to_header()
    header["NAXIS1"], header["NAXIS2"] = mosaic.shape[::-1]
    fits.PrimaryHDU(header=header).header.totextfile(folder / "grid.txt", overwrite=True)
    true = nearest(solution.estimate.positions, night.truth.positions)
    index = [int(np.flatnonzero((night.truth.positions == xy).all(axis=1))[0]) for xy in true]
    np.savez(
        folder / "truth.npz",
        grid=solution.estimate.positions - mosaic.offset,
        xy=true,
        flux=night.truth.flux[index],
        fwhm=float(np.nanmedian(solution.residuals["fwhm"].value)),
    )


def ours(folder, out, *, compiled=True, **options):
    """`legdistort.coadd`."""
    from legdistort import Solution, coadd, open_exposures
    from legdistort.coaddition.resampling import engines

    if not compiled:
        engines.COMPILED_FROM = float("inf")
    solution = Solution.read(folder / "solution.asdf")
    with timed():
        mosaic = coadd(open_exposures(frames(folder)), solution, **options)
        mosaic.write(out)


def reproject(folder, out, **options):
    """`reproject.mosaicking.reproject_and_coadd` with the gwcs of the solution."""
    from reproject import reproject_interp
    from reproject.mosaicking import reproject_and_coadd

    solution, wcs, shape = inputs(folder)
    with timed():
        pairs = [(read(path), unbounded(solution, path)) for path in frames(folder)]
        data, _ = reproject_and_coadd(pairs, wcs, shape_out=shape, reproject_function=reproject_interp, **options)
        write(out, data)


def drizzle(folder, out, *, kernel):
    """The drizzle package, pixel maps from the gwcs of the solution."""
    from drizzle.resample import Drizzle
    from drizzle.utils import calc_pixmap

    solution, wcs, shape = inputs(folder)
    with timed():
        resampled = Drizzle(kernel=kernel, out_shape=shape, fillval="nan")
        for path in frames(folder):
            image = read(path)
            resampled.add_image(image, 1.0, calc_pixmap(unbounded(solution, path), wcs, image.shape))
        write(out, resampled.out_img)


def swarp(folder, out, *, kernel):
    """SWarp with the TPV headers of ``legdistort attach --tpv``; each pixel scaled by its area."""
    header = (folder / "grid.txt").read_text()
    out.with_suffix(".head").write_text(_with_cd(header))
    options = {
        "IMAGEOUT_NAME": out,
        "WEIGHTOUT_NAME": out.with_name(f"weight_{out.name}"),
        "RESAMPLING_TYPE": kernel,
        "COMBINE_TYPE": "AVERAGE",
        "SUBTRACT_BACK": "N",
        "FSCALASTRO_TYPE": "VARIABLE",
        "RESAMPLE_DIR": folder,
        "VMEM_DIR": folder,
        "NTHREADS": 1,
        "WRITE_XML": "N",
        "VERBOSE_TYPE": "QUIET",
    }
    program = shutil.which("SWarp") or shutil.which("swarp")
    if program is None:
        raise SystemExit("SWarp is not installed")
    words = [word for key, value in options.items() for word in (f"-{key}", str(value))]
    with timed():
        images = map(str, sorted((folder / "tpv").glob("*.fits")))
        subprocess.run([program, *images, "-c", os.devnull, *words], check=True, stderr=subprocess.DEVNULL)


def single_ours(folder, out, **options):
    """One frame on the grid that holds it, by a program that has done one before."""
    from legdistort import Solution, coadd, open_exposures

    solution, path = Solution.read(folder / "solution.asdf"), frames(folder)[0]
    coadd(open_exposures(path), solution, **options)
    with timed():
        coadd(open_exposures(path), solution, **options)


def single_reproject(folder, out, *, stock):
    """`reproject.reproject_interp` with its defaults, on the same grid, by a program that has done one before."""
    import asdf
    from reproject import reproject_interp

    from legdistort.coaddition.grids import reference_grid
    from legdistort.wcs.storage import write_wcs

    solution, _, _ = inputs(folder)
    path = frames(folder)[0]
    grid, wcs = reference_grid([solution[path.stem]], solution.sky), unbounded(solution, path)
    if stock:
        write_wcs(solution[path.stem], folder / "wcs.asdf", overwrite=True)
        with asdf.open(folder / "wcs.asdf") as file:
            wcs = file["meta"]["wcs"]
        wcs.bounding_box = None
    reproject_interp((read(path), wcs), grid.wcs, shape_out=grid.shape)
    with timed():
        reproject_interp((read(path), wcs), grid.wcs, shape_out=grid.shape)


# --- pieces ------------------------------------------------------------------------------------------------------


class timed:
    """Prints wall and processor seconds of what happens inside, and the largest memory of the process, MB."""

    def __enter__(self):
        self.begin = time.perf_counter(), self.cpu()

    def __exit__(self, failed, *rest):
        if failed is None:
            wall, cpu = time.perf_counter() - self.begin[0], self.cpu() - self.begin[1]
            used = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
            print(json.dumps({"wall": wall, "cpu": cpu, "memory": used / 1024}))

    @staticmethod
    def cpu():
        usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def frames(folder):
    return sorted((folder / "frames").glob("*.fits"))


def inputs(folder):
    """Solution, and WCS and shape of the grid."""
    from astropy.io import fits
    from astropy.wcs import WCS

    from legdistort import Solution

    header = fits.Header.fromtextfile(folder / "grid.txt")
    return Solution.read(folder / "solution.asdf"), WCS(header), (header["NAXIS2"], header["NAXIS1"])


def read(path):
    from astropy.io import fits

    return fits.getdata(path).astype("float32")


def unbounded(solution, path):
    """The gwcs without its bounding box, which would cost strips along the edges."""
    wcs = solution[path.stem].wcs
    wcs.bounding_box = None
    return wcs


def write(out, data):
    from astropy.io import fits

    fits.writeto(out, data.astype("float32"), overwrite=True)


def _with_cd(text):
    """The grid as SWarp wants it: CD matrix instead of PC and CDELT."""
    from astropy.io import fits
    from astropy.wcs import WCS

    header = fits.Header.fromstring(text, sep="\n")
    matrix = WCS(header).pixel_scale_matrix
    for key in [key for key in header if key[:2] == "PC" or key[:5] == "CDELT"]:
        del header[key]
    for i in (1, 2):
        for j in (1, 2):
            header[f"CD{i}_{j}"] = matrix[i - 1, j - 1]
    return header.tostring(sep="\n", endcard=False, padding=False) + "\nEND     \n"


def judge(folder):
    """FWHM, position errors and flux scatter of every image, over the stars measured in all; prints JSON."""
    import numpy as np
    from astropy.io import fits

    from legdistort import Solution
    from legdistort.assessment.star_shapes import measure_shapes
    from legdistort.results import accuracy

    truth, solution = np.load(folder / "truth.npz"), Solution.read(folder / "solution.asdf")
    bright = truth["flux"] >= np.median(truth["flux"])
    grid, xy, fwhm = truth["grid"][bright], truth["xy"][bright], float(truth["fwhm"])
    single = mean_fluxes(folder, solution, solution.estimate.star_names[bright], fwhm)
    found = {}
    for path in sorted(folder.glob("out_*.fits")):
        image = fits.getdata(path).astype(float)
        found[path.stem[4:]] = measure_shapes(image, grid, fwhm=fwhm), aperture_fluxes(image, grid, fwhm) / single
    keep = np.logical_and.reduce([np.isfinite(np.column_stack(both)).all(axis=1) for both in found.values()])
    out = {"n_stars": int(keep.sum())}
    degree = 3 if keep.sum() >= 30 else 1
    for key, (shapes, ratio) in found.items():
        off, ratio = shapes[keep, :2] - grid[keep], ratio[keep]
        out[key] = {
            "fwhm": float(np.median(shapes[keep, 2])),
            "flux": float(np.std(ratio) / np.mean(ratio)),
            "x_ref": float(np.sqrt(np.mean(off**2))),
            "truth": accuracy.bias(off + grid[keep], xy[keep], removed=degree),
        }
    print(json.dumps(out))


def aperture_fluxes(image, xy, fwhm):
    """Sums within 3 FWHM less the sky around; NaN for a star nearer than that to the edge or to an empty pixel."""
    import numpy as np
    from photutils.aperture import ApertureStats, CircularAnnulus, CircularAperture, aperture_photometry

    out = np.full(len(xy), np.nan)
    inside = (xy > 8 * fwhm).all(axis=1) & (xy < np.array(image.shape[::-1]) - 1 - 8 * fwhm).all(axis=1)
    aperture = CircularAperture(xy[inside], 3 * fwhm)
    sky = ApertureStats(image, CircularAnnulus(xy[inside], 5 * fwhm, 8 * fwhm)).median
    out[inside] = aperture_photometry(image, aperture)["aperture_sum"].value - sky * aperture.area
    return out


def mean_fluxes(folder, solution, stars, fwhm):
    """Mean over the frames of the aperture fluxes of stars: the same photons as in the mosaic."""
    import numpy as np

    table, fluxes = solution.residuals, []
    for path in frames(folder):
        rows = table[(table["exposure"] == path.stem) & np.isin(table["star"], stars)]
        flux = np.full(len(stars), np.nan)
        xy = np.column_stack([rows["x"].value, rows["y"].value])
        flux[np.searchsorted(stars, rows["star"])] = aperture_fluxes(read(path).astype(float), xy, fwhm)
        fluxes.append(flux)
    return np.nanmean(fluxes, axis=0)


def step(name, folder, *more):
    """What a step printed last, as JSON; run in a process of its own, on one core."""
    env = os.environ | dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, "-W", "ignore", __file__, "--step", name, "--keep", str(folder), *more]
    done = subprocess.run(command, env=env, stdout=subprocess.PIPE, text=True, check=False)
    lines = done.stdout.strip().splitlines()
    return json.loads(lines[-1]) if done.returncode == 0 and lines else None


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="six frames of 512 x 512 px")
    parser.add_argument("--only", default="", help="rows whose name has this regular expression")
    parser.add_argument(
        "--rounds", type=int, default=1, help="run all rows so many times in turn, and take the best of each"
    )
    parser.add_argument("--keep", type=Path, help="folder for the files; used again if it holds a night")
    parser.add_argument("--step", help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.step == "prepare":
        prepare(a.keep, a.small)
    elif a.step == "judge":
        judge(a.keep)
    elif a.step:
        number = list(METHODS).index(a.step)
        _, function, options = METHODS[a.step]
        globals()[function](a.keep, a.keep / f"out_{number}.fits", **options)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            table(a.keep or Path(temporary), a)


def table(folder, a):
    """Run everything and print the table."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "truth.npz").exists():
        step("prepare", folder, *["--small"] * a.small)
    n = len(frames(folder))
    costs = {}
    for number, name in [*enumerate(METHODS)] * a.rounds:
        if re.search(a.only, name):
            (folder / f"out_{number}.fits").unlink(missing_ok=True)
            cost = step(name, folder)
            print(f"{name}: {cost}", file=sys.stderr, flush=True)
            costs[name] = min(filter(None, [cost, costs.get(name)]), key=lambda c: c["cpu"], default=None)
    judged = step("judge", folder)
    print(f"{n} frames; {judged['n_stars']} stars; processor seconds; load {os.getloadavg()[0]:.1f}\n")
    print("| | kernel | s a frame, processor (wall) | peak memory, MB | FWHM, px | flux scatter, % "
          "| position against X_ref, px | against truth, px |")  # fmt: skip
    print("|---" * 8 + "|")
    for number, (name, (kernel, function, _)) in enumerate(METHODS.items()):
        cost, found = costs.get(name), judged.get(str(number))
        if cost is None:
            continue
        frame = 1 if function.startswith("single") else n
        cells = [f"{cost['cpu'] / frame:.2f} ({cost['wall'] / frame:.2f})", f"{cost['memory']:.0f}"]
        cells += ["", "", "", ""] if found is None else [
            f"{found['fwhm']:.3f}", f"{100 * found['flux']:.2f}", f"{found['x_ref']:.4f}", f"{found['truth']:.4f}"
        ]  # fmt: skip
        print(f"| {name} | {kernel} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
