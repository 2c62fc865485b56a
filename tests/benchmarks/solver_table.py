"""Table of the solvers on three data sets: time, peak memory, b, sigma, chi2, each in a process of its own.

Run ``python tests/benchmarks/solver_table.py [--scaling | --ratios | --covariances | --survey | --degrees]``. Times are
the best of three after a first call (which loads compiled code); memory is what the process needed beyond data and
imports.
"""

import argparse
import json
import logging
import resource
import subprocess
import sys
import time
import warnings
from pathlib import Path

SETS = ("simulation 1", "gsaoi-like", "large")
SOLVERS = ("joint", "alternating", "scipy")


def measure(name, solver, n_exposures, n_stars):
    """One row: figures of one solver on one set."""
    import rivals
    import sets

    from legdistort import Matches, paper, solve
    from legdistort.results import accuracy
    from legdistort.solving.equations import compiled

    assert compiled
    warnings.simplefilter("ignore")
    sim, prior = sets.make(name, n_exposures=n_exposures, n_stars=n_stars)
    true = sim.truth.positions[sim.matches.stars]
    table, shape, poses = sim.matches.table, sim.matches.shapes, sim.matches.poses
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    times = []
    for _ in range(4 if solver == "joint" else 1):
        begin = time.perf_counter()
        if solver == "joint":
            solution = solve(Matches.from_table(table, shape=shape, poses=poses), prior=prior)
            positions, chi2 = solution.estimate.positions, solution.chi2
        else:
            problem, start = sets.problem(sim, prior)
            if solver == "scipy":
                state, chi2 = rivals.solve_scipy(problem, start)
            else:
                result = paper.alternate(problem, start, max_iterations=300)
                state, chi2, sweeps = result.state, result.blocks.chi2, result.n_iterations
            positions = state.positions.T
        times.append(time.perf_counter() - begin)
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    row = {
        "set": name,
        "solver": solver,
        "n_obs": len(table),
        "seconds": min(times[1:] or times),
        "MB": memory,
        "b": accuracy.bias(positions, true, removed=3),
        "chi2": chi2,
    }
    if solver == "alternating":
        row["sweeps"] = sweeps
    if solver == "joint":
        row["sigma"] = float(accuracy.scatter(accuracy.corrected_positions(solution)).mean())
        begin = time.perf_counter()
        _ = solution.estimate.uncertainty.stars
        row["covariance"] = time.perf_counter() - begin
        begin = time.perf_counter()
        _ = solution.stars  # with what common maps and unknown directions add
        row["table"] = time.perf_counter() - begin
        row["MB"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return row


def ratios(n_exposures, n_stars):
    """Time of plain solutions, of default ones, which look for gross errors, and of scipy, in turn, in seconds.

    The default ones without and with gross errors of 3 pixels in one of a hundred observations. The least of several
    rounds, and that of the first plain solution in this process, which may load compiled loops.
    """
    import numpy as np
    import rivals
    import sets
    from astropy import units as u

    from legdistort import Matches, solve
    from legdistort.solving.options import CLIP

    warnings.simplefilter("ignore")
    sim, prior = sets.make("large", n_exposures=n_exposures, n_stars=n_stars)
    table, shape, poses = sim.matches.table, sim.matches.shapes, sim.matches.poses
    rng, wrong = np.random.default_rng(0), table.copy()
    wrong["x"] += np.where(rng.random(len(table)) < 0.01, rng.choice([-3, 3], len(table)), 0) * u.pix

    def ours(clip, table=table):
        return solve(Matches.from_table(table, shape=shape, poses=poses), prior=prior, clip=clip)

    ways = {
        "plain": lambda: ours(None),
        "default": lambda: ours(CLIP),
        "gross errors": lambda: ours(CLIP, wrong),
        "scipy": lambda: rivals.solve_scipy(*sets.problem(sim, prior)),
    }
    times = {way: [] for way in ways}
    for count in range(10):
        for way, function in ways.items():
            if way != "scipy" or count < (2 if len(table) > 1e5 else 5):
                begin = time.perf_counter()
                function()
                times[way].append(time.perf_counter() - begin)
    return len(table), *(min(each) for each in times.values()), times["plain"][0]


def degrees(n_exposures, n_stars):
    """CPU time of a solution with a given degree, and with the degree chosen, in turn: (2,) seconds, the least."""
    from legdistort import simulate_matches, solve

    warnings.simplefilter("ignore")
    sim = simulate_matches(n_exposures=n_exposures, n_stars=n_stars, degree=3, seed=1)
    times = {3: [], "auto": []}
    for _ in range(4):
        for degree, each in times.items():
            begin = time.process_time()
            solve(sim.matches, degree=degree)
            each.append(time.process_time() - begin)
    return [min(each) for each in times.values()]


def survey(n_exposures, n_stars, seen):
    """CPU time [s] of many exposures that see a part of the stars: solution, errors, checks, file; size of this."""
    import tempfile

    from legdistort import Solution, simulate_matches, solve

    warnings.simplefilter("ignore")
    sim = simulate_matches(n_exposures=n_exposures, n_stars=n_stars, seen=seen, degree=3, seed=1)
    solve(sim.matches)  # loads compiled loops
    with tempfile.TemporaryDirectory() as folder:
        file, out = Path(folder) / "solution.asdf", {}

        def timed(name, function):
            begin = time.process_time()
            result = function()
            out[name] = time.process_time() - begin
            return result

        solution = timed("solve", lambda: solve(sim.matches))
        timed("stars", lambda: solution.stars)
        timed("exposures", lambda: [solution[name].covariance for name in solution.names])
        timed("checks", lambda: solution.checks)
        timed("write", lambda: solution.write(file))
        timed("read", lambda: Solution.read(file))
        out["file [MB]"] = file.stat().st_size / 1e6
    return out


def run(*arguments):
    """A row from a process of its own."""
    command = [sys.executable, __file__, "--row", *map(str, arguments)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])


def show(row):
    """One line of the table."""
    extra = (
        f"  covariance {row['covariance']:.2f} s, table of stars {row['table']:.2f} s" if "covariance" in row else ""
    )
    extra += f"  {row['sweeps']} sweeps" if "sweeps" in row else ""
    sigma = f"{row['sigma']:.4f}" if "sigma" in row else "-"
    print(
        f"{row['set']:14s} {row['solver']:12s} {row['n_obs']:9d} {row['seconds']:9.3f} s {row['MB']:8.0f} MB "
        f"b {row['b']:.4f}  sigma {sigma}  chi2 {row['chi2']:.1f}{extra}",
        flush=True,
    )


def main():
    """Print the table, or the time of the joint solver and of the errors against the size of the problem."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", nargs=4)
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument("--ratios", action="store_true", help="time of scipy over ours, and of rejection")
    parser.add_argument("--covariances", action="store_true", help="errors of all stars, many exposures or many stars")
    parser.add_argument("--survey", action="store_true", help="CPU time where exposures see a part of the stars")
    parser.add_argument("--degrees", action="store_true", help="CPU time of degree='auto' over a given degree")
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)  # of what is not known without a prior
    sys.path.insert(0, str(Path(__file__).parent))
    if arguments.row:
        name, solver, n_exposures, n_stars = arguments.row
        print(json.dumps(measure(name, solver, int(n_exposures), int(n_stars))))
    elif arguments.scaling:
        for n_exposures, n_stars in ((10, 286), (30, 1000), (100, 3000), (100, 10_000), (300, 10_000), (1000, 10_000)):
            show(run("large", "joint", n_exposures, n_stars))
    elif arguments.ratios:
        print("observations  plain [s]  first [s]  scipy / plain  default / plain  with gross errors / plain")
        for n_exposures, n_stars in ((10, 114), (10, 300), (30, 1000), (100, 3000), (100, 10_000)):
            n, plain, default, gross, scipy, first = ratios(n_exposures, n_stars)
            line = f"{n:12d} {plain:10.4f} {first:10.4f} {scipy / plain:14.1f} {default / plain:16.2f}"
            print(f"{line} {gross / plain:26.1f}", flush=True)
    elif arguments.degrees:
        print("exposures x stars  degree 3 [s]  auto [s]  auto / degree 3")
        for n_exposures, n_stars in ((11, 80), (11, 300), (30, 1000)):
            given, chosen = degrees(n_exposures, n_stars)
            print(f"{n_exposures:9d} x {n_stars:5d} {given:13.3f} {chosen:9.2f} {chosen / given:16.1f}", flush=True)
    elif arguments.survey:
        for n_exposures, n_stars, seen in ((2000, 100, 0.74), (600, 3000, 0.025), (2000, 10_000, 0.008)):
            times = survey(n_exposures, n_stars, seen)
            cells = "  ".join(f"{name} {each:.2f}" for name, each in times.items())
            print(f"{n_exposures} x {seen * n_stars:.0f} of {n_stars}: {cells}", flush=True)
    elif arguments.covariances:
        for n_exposures, n_stars in ((150, 30), (2000, 30), (400, 60), (100, 3000), (500, 2000), (500, 5000)):
            show(run("large", "joint", n_exposures, n_stars))
    else:
        for name in SETS:
            for solver in SOLVERS:
                show(run(name, solver, 100, 10_000))


if __name__ == "__main__":
    main()
