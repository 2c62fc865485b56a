"""What a person sees of a minimisation that takes its time, and where it ends."""

import re

import numpy as np
import pytest

from legdistort.geometry import similarity
from legdistort.priors.prior import Prior
from legdistort.runtime.progress import Bar
from legdistort.simulation.observations import simulate_matches
from legdistort.solving import minimisers
from legdistort.solving.estimation import solve


def test_iterations_are_counted(monkeypatch, capsys):
    """As if a solution took its time: a bar comes after a second."""
    delays = []

    def patient(delay, **given):
        delays.append(delay)
        return Bar(**given, mininterval=0)

    monkeypatch.setattr(minimisers, "Bar", patient)
    matches = simulate_matches(n_stars=40, n_exposures=5, degree=2, seed=1).matches
    solve(matches, degree=2, max_iterations=20)
    assert "iterations" not in capsys.readouterr().err
    solution = solve(matches, degree=2, max_iterations=20, progress=True)
    counts = [int(n) for n in re.findall(r"solving: (\d+) iterations", capsys.readouterr().err)]
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] >= int(re.search(r"after (\d+)", solution.status).group(1))
    assert delays == [1, 1]


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_what_the_last_steps_keep_moves_no_star(known, direct, loss, monkeypatch):
    """The constraints, and what was factorised, of the state before: against those of every state."""
    monkeypatch.setattr(minimisers.reduced_system, "uses_direct", lambda problem: direct)
    sim = simulate_matches(n_exposures=20, n_stars=100, seen=0.7, sigma=0.05, seed=0)
    kept, stepped = [], []
    for system in (minimisers.reduced_system.Direct, minimisers.reduced_system.Iterative):
        step = system.step
        monkeypatch.setattr(system, "step", lambda *a, step=step: stepped.append(a) or step(*a))
    moved = minimisers.reduced_system.Reduced.moved
    monkeypatch.setattr(minimisers.reduced_system.Reduced, "moved", lambda *a: kept.append(a) or moved(*a))
    found = {}
    for near, smaller in ((0.0, 0.0), (minimisers._NEAR, minimisers._SMALLER)):
        monkeypatch.setattr(minimisers, "_NEAR", near)
        monkeypatch.setattr(minimisers, "_SMALLER", smaller)
        assert not (kept and direct)  # of conjugate gradients the preconditioner alone is kept, and always
        found[near] = solve(sim.matches, prior=Prior(sim.truth.static) if known else None, loss=loss, clip=None)
    assert kept or not (known or loss == "linear")  # an estimated gauge and weights that change keep nothing
    new, old = found[minimisers._NEAR], found[0.0]
    n_steps = sum(int(re.search(r"after (\d+)", each.status).group(1)) for each in (new, old))
    assert n_steps <= len(stepped) <= n_steps + direct  # conjugate gradients never step twice
    off = (new.estimate.positions - old.estimate.positions) / np.stack([old.stars["x_err"], old.stars["y_err"]], axis=1)
    assert np.abs(np.asarray(off)).max() < 1e-3
    assert new.chi2 == pytest.approx(old.chi2, rel=1e-6)
    assert np.allclose(new.stars["x_err"], old.stars["x_err"], rtol=1e-4)


@pytest.mark.parametrize("seed", [3, 4])
def test_conjugate_gradients_keep_to_the_constraints_up_to_rounding(seed, monkeypatch):
    """Some of the many small steps with a robust loss went far along what nothing determines, without end."""
    sim, found = simulate_matches(n_exposures=20, n_stars=100, seen=0.7, sigma=0.05, seed=seed), {}
    for direct in (True, False):
        monkeypatch.setattr(minimisers.reduced_system, "uses_direct", lambda problem, direct=direct: direct)
        found[direct] = solve(sim.matches, loss="cauchy", clip=None)
    steps = {direct: int(re.search(r"converged after (\d+)", each.status).group(1)) for direct, each in found.items()}
    assert abs(steps[True] - steps[False]) <= 2
    pose = similarity.fit_similarity(found[False].estimate.positions, found[True].estimate.positions)
    off = similarity.apply(pose, found[False].estimate.positions) - found[True].estimate.positions
    assert np.abs(off).max() < 1e-2 * found[True].stars["x_err"].value.min()


@pytest.mark.parametrize("known", [True, False])
def test_coefficients_fitted_to_the_start_values_of_the_stars_save_steps_and_move_no_star(known, monkeypatch):
    sim = simulate_matches(n_exposures=12, n_stars=80, seen=0.8, sigma=0.05, dither=150.0, seed=2)
    prior, found = Prior(sim.truth.static) if known else None, {}
    for up_to in (0, minimisers._BEGIN_UP_TO):
        monkeypatch.setattr(minimisers, "_BEGIN_UP_TO", up_to)
        found[up_to] = solve(sim.matches, prior=prior, clip=None)
    old, new = found.values()
    # the plane is that of the nominal poses to 1e-3 px, wherever the steps lead
    assert np.abs(new.estimate.positions - old.estimate.positions).max() < 1e-3
    pose = similarity.fit_similarity(new.estimate.positions, old.estimate.positions)
    off = similarity.apply(pose, new.estimate.positions) - old.estimate.positions
    errors = np.column_stack([old.stars["x_err"].value, old.stars["y_err"].value])
    assert (np.abs(off) / errors).max() < 2e-3
    steps = [int(re.search(r"after (\d+)", each.status).group(1)) for each in (old, new)]
    assert steps[1] <= steps[0]
    assert known or steps[1] < steps[0]
