"""The figures of a solution, against its tables."""

import json
import subprocess
import sys

import numpy as np
import pytest

from legdistort import simulate_matches, solve
from legdistort.reporting.summary import summarise


def test_figures_are_those_of_the_tables():
    solution = solve(simulate_matches(n_stars=30, n_exposures=6, seed=3).matches, degree=1)
    found = summarise(solution, timings={"solve": 0.12345})
    used = solution.residuals[solution.residuals["used"]]
    assert json.loads(json.dumps(found)) == found
    assert (found["n_exposures"], found["n_stars"], found["n_observations"]) == (6, 30, len(used))
    left = np.concatenate([used["dx"].value, used["dy"].value])
    assert found["rms_px"] == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-6)
    assert found["timings"] == {"solve": 0.123}
    assert [check["name"] for check in found["checks"]] == [check.name for check in solution.checks]


def test_a_solution_is_shown_without_what_measures_and_co_adds(tmp_path):
    """Of a command that only reads a file, imports take most of the time."""
    solve(simulate_matches(n_stars=30, n_exposures=6, seed=3).matches, degree=1).write(tmp_path / "s.asdf")
    script = (
        "import sys; from legdistort.cli import main; main(['show', sys.argv[1]]);"
        "assert not {'photutils', 'reproject', 'matplotlib', 'numba'} & set(sys.modules)"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "s.asdf"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "6 exposures, 30 stars" in run.stdout
