"""All times in one table: ``python tests/benchmarks/speed_table.py [PART ...]``, on a machine that does nothing else.

The parts are ``start`` (of a process, of a command), ``wcs`` (a WCS at many positions) and those of other tables, each
with the accuracy that goes with its times: ``run`` (frames to mosaic, against SExtractor, SCAMP and SWarp),
``measure``, ``match``, ``solve`` (against scipy), ``errors``, ``degree`` and ``coadd`` (against reproject, drizzle and
SWarp). All if none is named, in half an hour.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
TABLES = {
    "run": ("run_table.py",),
    "measure": ("measuring_table.py", "speed"),
    "match": ("matching_table.py", "--sizes"),
    "solve": ("solver_table.py", "--ratios"),
    "errors": ("solver_table.py", "--covariances"),
    "degree": ("solver_table.py", "--degrees"),
    "coadd": ("coadd_table.py",),
}
STARTS = {
    "import numpy": ["-c", "import numpy"],
    "import astropy": ["-c", "import astropy"],
    "import legdistort": ["-c", "import legdistort"],
    "legdistort.solve": ["-c", "from legdistort import solve"],
    "legdistort --version": ["-m", "legdistort", "--version"],
    "legdistort --help": ["-m", "legdistort", "--help"],
    "legdistort run --help": ["-m", "legdistort", "run", "--help"],
}


def start():
    """Seconds from the call of a process to its end, the least of five rounds in turn."""
    times = {name: [] for name in STARTS}
    for _ in range(5):
        for name, arguments in STARTS.items():
            begin = time.perf_counter()
            subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
            times[name].append(time.perf_counter() - begin)
    for name, each in times.items():
        print(f"{name:24s} {min(each):6.2f} s")


def wcs(n=4_200_000):
    """CPU time of a WCS of degree 3 at scattered positions: ours, the stock gwcs, and astropy's SIP from our header."""
    import legdistort as ld

    sim = ld.simulate_exposures(small=True, seed=1)
    with tempfile.TemporaryDirectory() as folder:
        solution = ld.run(sim.write(folder), out=Path(folder) / "out", degree=3, psf="moffat").solution
    name = solution.names[0]
    x, y = np.random.default_rng(0).uniform(0, 511, (2, n))
    exact, header = solution.wcs(name), solution.fits_wcs(name)
    ways = {
        "ours": exact.pixel_to_world_values,
        "stock gwcs": exact.stock().pixel_to_world_values,
        "astropy, SIP": lambda x, y: header.all_pix2world(x, y, 0),
    }
    times, values = {way: [] for way in ways}, {}
    for _ in range(3):
        for way, function in ways.items():
            begin = time.process_time()
            values[way] = np.array(function(x, y))
            times[way].append(time.process_time() - begin)
    off = solution.sky.pixel_scale / 3600
    for way, each in times.items():
        apart = np.nanmax(np.abs(values[way][1] - values["stock gwcs"][1])) / off
        print(f"{way:14s} {min(each):6.2f} s  within {apart:.1e} px of the stock gwcs in declination")


def main():
    """Print the parts that were asked for."""
    parts = {"start": start, "wcs": wcs} | TABLES
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[[], *parts], metavar="PART")
    for part in parser.parse_args().parts or parts:
        print(f"\n## {part}", flush=True)
        if part in TABLES:
            script, *arguments = TABLES[part]
            subprocess.run([sys.executable, HERE / script, *arguments], check=False)
        else:
            parts[part]()


if __name__ == "__main__":
    main()
