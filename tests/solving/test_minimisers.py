"""What a person sees of a minimisation that takes its time."""

import re

import pytest

from legdistort.runtime.progress import Bar
from legdistort.simulation.observations import simulate_matches
from legdistort.solving import minimisers
from legdistort.solving.estimation import solve


@pytest.mark.parametrize("method", ["joint", "alternating"])
@pytest.mark.filterwarnings("ignore::legdistort.exceptions.ConvergenceWarning")
def test_iterations_are_counted(method, monkeypatch, capsys):
    """As if a solution took its time: a bar comes after a second."""
    delays = []

    def patient(delay, **given):
        delays.append(delay)
        return Bar(**given, mininterval=0)

    monkeypatch.setattr(minimisers, "Bar", patient)
    matches = simulate_matches(n_stars=40, n_exposures=5, degree=2, seed=1).matches
    solve(matches, degree=2, method=method, max_iterations=20)
    assert "iterations" not in capsys.readouterr().err
    solution = solve(matches, degree=2, method=method, max_iterations=20, progress=True)
    counts = [int(n) for n in re.findall(r"solving: (\d+) iterations", capsys.readouterr().err)]
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] >= int(re.search(r"after (\d+)", solution.status).group(1))
    assert delays == [1, 1]
