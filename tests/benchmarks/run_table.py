"""The whole run against the programs it replaces: ``python tests/benchmarks/run_table.py [--ao]``.

A simulated night of 11 frames of 2048 x 2048 px (``--ao``: cores in a seeing halo) goes through ``legdistort run
--degree 3``, and through source-extractor, SCAMP (the true positions of the stars as its reference) and SWarp on the
grid of our mosaic, all on the cores there are, in turn. Wall time and CPU time are the least of the rounds; of the
first run, with an empty cache of compiled loops, the time is printed too. Beside them the accuracy: scatter of star
positions in the mosaic around the truth after a cubic map, FWHM of stars there over that in a frame, and scatter of
their fluxes over the true ones, for the brighter half of the stars found in both mosaics.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.stats import mad_std
from astropy.table import Table
from astropy.wcs import WCS
from scipy.spatial import cKDTree

COLUMNS = (
    "NUMBER XWIN_IMAGE YWIN_IMAGE ERRAWIN_IMAGE ERRBWIN_IMAGE ERRTHETAWIN_IMAGE FLUX_AUTO FLUXERR_AUTO MAG_AUTO "
    "MAGERR_AUTO FLAGS"
)
KERNEL = "CONV NORM\n1 2 1\n2 4 2\n1 2 1\n"


def timed(command, folder, env=None):
    """Wall and CPU seconds and peak memory in MB of a command, all its children included but in the memory."""
    begin = time.perf_counter()
    with open(folder / "log", "ab") as log:
        process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, env=env)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{command[0]} failed: {(folder / 'log').read_text(errors='replace')[-2000:]}")
    return np.array([time.perf_counter() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024])


def total(parts):
    """Sums of times, and the largest memory."""
    parts = np.array(parts)
    return np.array([*parts[:, :2].sum(axis=0), parts[:, 2].max()])


def ours(frames, folder, env):
    """``legdistort run``, the way a user calls it."""
    command = [sys.executable, "-m", "legdistort", "run", *frames, "--degree", "3", "--out", "out", "--overwrite"]
    return timed([*map(str, command), "--quiet"], folder, env)


def extract(frames, folder):
    """Catalogues by source-extractor, one after another."""
    (folder / "columns").write_text("\n".join(COLUMNS.split()) + "\n")
    (folder / "kernel").write_text(KERNEL)
    options = {
        "CATALOG_TYPE": "FITS_LDAC", "PARAMETERS_NAME": "columns", "FILTER_NAME": "kernel", "DETECT_THRESH": 1.5,
        "DETECT_MINAREA": 5, "BACK_SIZE": 64, "VERBOSE_TYPE": "QUIET",
    }  # fmt: skip
    (folder / "sex.conf").write_text("".join(f"{key} {value}\n" for key, value in options.items()))
    program = shutil.which("source-extractor") or shutil.which("sex")
    command = [program, None, "-c", "sex.conf", "-CATALOG_NAME", None]
    for path in frames:
        command[1], command[5] = path, f"{path.stem}.cat"
        yield timed(command, folder)


def scamp(frames, folder):
    """Distortions of degree 3 by SCAMP, against the truth."""
    words = (
        "-c /dev/null -ASTREF_CATALOG FILE -ASTREFCAT_NAME truth.cat -ASTREFCENT_KEYS X_WORLD,Y_WORLD "
        "-ASTREFMAG_KEY MAG -ASTREFMAGERR_KEY MAGERR -ASTREFERR_KEYS ERRA_WORLD,ERRB_WORLD,ERRTHETA_WORLD "
        "-ASTREFOBSDATE_KEY OBSDATE -MATCH_RESOL 0.2 -POSITION_MAXERR 0.1 -CROSSID_RADIUS 0.3 -DISTORT_DEGREES 3 "
        "-CHECKPLOT_TYPE NONE -WRITE_XML N -VERBOSE_TYPE QUIET"
    )
    return timed(["scamp", *(f"{path.stem}.cat" for path in frames), *words.split()], folder)


def swarp(frames, folder):
    """The weighted mean with LANCZOS3 on the grid of our mosaic."""
    for path in frames:
        if not (folder / path.name).exists():
            (folder / path.name).symlink_to(path)
    grid = WCS(fits.getheader(folder / "out" / "mosaic.fits"))
    header = grid.to_header()
    header["NAXIS1"], header["NAXIS2"] = grid.pixel_shape
    (folder / "swarp.head").write_text(header.tostring(sep="\n", endcard=False, padding=False) + "\nEND     \n")
    cores = len(os.sched_getaffinity(0))
    words = (
        "-c /dev/null -IMAGEOUT_NAME swarp.fits -WEIGHTOUT_NAME swarp_weight.fits -RESAMPLING_TYPE LANCZOS3 "
        f"-COMBINE_TYPE WEIGHTED -WEIGHT_TYPE NONE -SUBTRACT_BACK N -NTHREADS {cores} -WRITE_XML N -VERBOSE_TYPE QUIET"
    )
    program = shutil.which("SWarp") or shutil.which("swarp")
    return timed([program, *(path.name for path in frames), *words.split()], folder)


def reference(folder, truth):
    """The true positions on the sky as a catalogue for SCAMP."""
    n = len(truth)
    values = {"X_WORLD": truth["ra"], "Y_WORLD": truth["dec"], "MAG": -2.5 * np.log10(truth["flux"]), "OBSDATE": 2015.0}
    values |= {"ERRA_WORLD": 1e-7, "ERRB_WORLD": 1e-7, "ERRTHETA_WORLD": 0.0, "MAGERR": 0.01}
    cards = fits.Header({"SIMPLE": True, "BITPIX": 8, "NAXIS": 0}).tostring(padding=True)
    cards = np.array([[cards[k : k + 80] for k in range(0, len(cards), 80)]])
    field = fits.Column("Field Header Card", f"{cards.size * 80}A", array=cards, dim=f"(80, {cards.size})")
    objects = [fits.Column(name, "1D", array=np.broadcast_to(value, n)) for name, value in values.items()]
    tables = [fits.BinTableHDU.from_columns([field], name="LDAC_IMHEAD")]
    tables.append(fits.BinTableHDU.from_columns(objects, name="LDAC_OBJECTS"))
    fits.HDUList([fits.PrimaryHDU(), *tables]).writeto(folder / "truth.cat")


def stars_of(path, truth):
    """Index in the truth, position, true position, FWHM and flux over the true one of the stars in a mosaic."""
    from legdistort import measure, read_exposures

    stars = measure(read_exposures([path], ext=0), psf="moffat")
    stars = stars[stars["flags"] == 0]
    xy = np.column_stack([stars["x"].value, stars["y"].value])
    places = np.column_stack(WCS(fits.getheader(path)).all_world2pix(truth["ra"], truth["dec"], 0))
    apart = (places - xy[:, None]).reshape(-1, 2)
    tree = cKDTree(apart)
    xy += apart[np.argmax(tree.query_ball_point(apart, 15, return_length=True))]  # the mosaics differ in their pointing
    distance, index = cKDTree(places).query(xy)
    table = Table({"star": index, "xy": xy, "places": places[index], "fwhm": stars["fwhm"].value})
    table["flux"] = stars["flux"].value / np.asarray(truth["flux"])[index]
    nearest = np.argsort(distance)
    _, first = np.unique(index[nearest], return_index=True)  # a star that was found twice counts once
    nearest = nearest[first]
    return table[nearest[distance[nearest] < 40]]


def judge(mosaics, truth, single):
    """Print scatter around the truth after a cubic map, FWHM and scatter of fluxes, of the same stars in all."""
    from legdistort.results import accuracy

    tables = {row: stars_of(path, truth) for row, path in mosaics.items()}
    common = set.intersection(*(set(table["star"]) for table in tables.values()))
    common = sorted(common, key=lambda star: truth["flux"][star])[len(common) // 2 :]
    for row, table in tables.items():
        table = table[np.isin(table["star"], common)]
        b = accuracy.bias(table["xy"], table["places"], removed=3)
        fwhm, flux = np.median(table["fwhm"]) / single, mad_std(table["flux"]) / np.median(table["flux"])
        print(f"{row:18s} {len(table)} stars, b {b:.4f} px, FWHM {fwhm:.3f} x a frame's, fluxes {100 * flux:.2f} %")


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ao", action="store_true", help="cores in a halo, Strehl ratio 0.3")
    parser.add_argument("--rounds", type=int, default=3)
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        night = [sys.executable, "-m", "legdistort", "simulate", "--out", "night", *["--strehl", "0.3"] * a.ao]
        timed(night, folder)
        frames, truth = sorted((folder / "night").glob("*.fits")), Table.read(folder / "night" / "truth.ecsv")
        env = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
        first = ours(frames, folder, env)
        reference(folder, truth)
        rows = {"legdistort run": [], "source-extractor": [], "SCAMP": [], "SWarp": []}
        with_chain = all(map(shutil.which, ("source-extractor", "scamp"))) and (
            shutil.which("SWarp") or shutil.which("swarp")
        )
        for _ in range(a.rounds):
            rows["legdistort run"].append(ours(frames, folder, env))
            if with_chain:
                rows["source-extractor"].append(total(list(extract(frames, folder))))
                rows["SCAMP"].append(scamp(frames, folder))
                rows["SWarp"].append(swarp(frames, folder))
        least = {row: np.min(times, axis=0) for row, times in rows.items() if times}
        if with_chain:
            least["chain"] = total([times for row, times in least.items() if row != "legdistort run"])
        print(f"{'':18s} wall [s]  CPU [s]  memory [MB]")
        for row, (wall, cpu, memory) in least.items():
            print(f"{row:18s} {wall:8.1f} {cpu:8.1f} {memory:8.0f}")
        print(f"first run, loops compiled: {first[0]:.1f} s")
        print("steps [s]:", json.loads((folder / "out" / "summary.json").read_text())["timings"])
        from legdistort import measure, read_exposures

        one = measure(read_exposures(frames[:1]), psf="moffat")
        single = float(np.median(one["fwhm"][(one["flags"] == 0) & (one["flux"] > np.median(one["flux"]))].value))
        mosaics = {"legdistort run": folder / "out" / "mosaic.fits", "chain": folder / "swarp.fits"}
        judge({row: path for row, path in mosaics.items() if path.exists()}, truth, single)


if __name__ == "__main__":
    main()
