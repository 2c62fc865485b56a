"""All times in one table: ``python tests/benchmarks/speed_table.py [PART ...]``, on a machine that does nothing else.

The parts are ``start`` (of a process, of a command), ``wcs`` (a WCS at many positions), ``profile`` (what the three
slowest steps of a run spend their time on) and those of other tables, each with the accuracy that goes with its times:
``run`` and ``ao`` (frames to mosaic, against SExtractor, SCAMP and SWarp), ``measure``, ``match``, ``solve`` (against
scipy), ``sizes`` (to 7 million observations, with memory), ``errors``, ``degree`` and ``coadd`` (against reproject,
drizzle and SWarp). All if none is named, in half an hour. ``--before PYTHON`` measures the same with another
interpreter first, that of an environment with an earlier version.
"""

import argparse
import contextlib
import cProfile
import pstats
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
TABLES = {
    "run": ("run_table.py",),
    "ao": ("run_table.py", "--ao"),
    "measure": ("measuring_table.py", "speed"),
    "match": ("matching_table.py", "--sizes"),
    "solve": ("solver_table.py", "--ratios"),
    "sizes": ("solver_table.py", "--scaling"),
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
    exact, header = solution[name].wcs, solution[name].fits_wcs()
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


def profile(most=8):
    """Shares of the time of measuring, co-adding and writing files by function, on one core."""
    import legdistort as ld
    from legdistort.pipeline import write_results

    with tempfile.TemporaryDirectory() as folder:
        paths = ld.simulate_exposures(seed=0).write(Path(folder) / "frames")
        done = ld.run(paths, out=Path(folder) / "out", degree=3)
        exposures, solution, again = ld.read_exposures(paths), done.solution, Path(folder) / "again"
        again.mkdir()
        steps = {
            "measuring": lambda: ld.measure(exposures),
            "co-adding": lambda: ld.coadd(exposures, solution),
            "writing": lambda: write_results(solution, again, mosaic=done.mosaic),
        }
        for step, function in steps.items():
            with cProfile.Profile() as profiler, contextlib.redirect_stdout(sys.stderr):
                function()
            stats = pstats.Stats(profiler)
            print(f"{step}: {stats.total_tt:.1f} s")
            own = sorted(stats.stats.items(), key=lambda item: -item[1][2])[:most]
            for (path, line, name), (_, calls, seconds, *_) in own:
                where = name if path == "~" else f"{Path(path).stem}:{line} {name}"
                print(f"  {100 * seconds / stats.total_tt:5.1f} %  {calls:7d} x  {where}")


def main():
    """Print the parts that were asked for."""
    parts = {"start": start, "wcs": wcs} | TABLES | {"profile": profile}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[[], *parts], metavar="PART")
    parser.add_argument("--before", metavar="PYTHON", help="an interpreter with the version to compare with")
    a = parser.parse_args()
    if a.before:
        print("# before", flush=True)
        subprocess.run([a.before, __file__, *a.parts], check=False)
        print("\n# now", flush=True)
    for part in a.parts or parts:
        print(f"\n## {part}", flush=True)
        if part in TABLES:
            script, *arguments = TABLES[part]
            subprocess.run([sys.executable, HERE / script, *arguments], check=False)
        else:
            parts[part]()


if __name__ == "__main__":
    main()
