"""What a person sees of a minimisation that takes its time, and where it ends."""

import re

import numpy as np
import pytest

from legdistort.priors.prior import Prior
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


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_what_the_last_steps_keep_moves_no_star(direct, loss, monkeypatch):
    """The constraints, and what was factorised, of the state before: against those of every state."""
    monkeypatch.setattr(minimisers.reduced_system, "uses_direct", lambda problem: direct)
    sim = simulate_matches(n_exposures=20, n_stars=100, seen=0.7, sigma=0.05, seed=0)
    kept = []
    moved = minimisers.reduced_system.Reduced.moved
    monkeypatch.setattr(minimisers.reduced_system.Reduced, "moved", lambda *a: kept.append(a) or moved(*a))
    found = {}
    for near in (0.0, minimisers._NEAR):
        monkeypatch.setattr(minimisers, "_NEAR", near)
        assert not kept
        found[near] = solve(sim.matches, prior=Prior(sim.truth.static), loss=loss, clip=None)
    assert kept
    new, old = found[minimisers._NEAR], found[0.0]
    off = (new.positions - old.positions) / np.stack([old.stars["x_err"], old.stars["y_err"]], axis=1)
    assert np.abs(np.asarray(off)).max() < 1e-3
    assert new.chi2 == pytest.approx(old.chi2, rel=1e-6)
    assert np.allclose(new.stars["x_err"], old.stars["x_err"], rtol=1e-4)
