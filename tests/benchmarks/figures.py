"""Figures of accuracy that the tests bound, printed: ``python tests/benchmarks/figures.py`` (about a minute)."""

import numpy as np
import sets

from legdistort import solve
from legdistort.results import accuracy
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches


def rms(values):
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values)))


def simulation_1(n_seeds=20):
    """The paper's Simulation 1: b of the stars, sigma on a 50 x 50 grid in the central 80 %."""
    side = np.linspace(0.1 * 2048, 0.9 * 2048, 50) - 0.5
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    b, sigma = [], []
    for seed in range(n_seeds):
        sim = simulate_matches(seed=seed)
        solution = solve(sim.matches, prior=sets.Prior(sim.truth.static))
        b.append(accuracy.bias(solution.estimate.positions, sim.truth.positions[solution.estimate.star_names]))
        rng = np.random.default_rng(1000 + seed)
        noisy = [sim.truth.distort(name, grid) + 0.14 * rng.normal(size=grid.shape) for name in solution.names]
        corrected = np.stack([solution[name].correct(xy) for name, xy in zip(solution.names, noisy, strict=True)])
        sigma.append(rms(accuracy.scatter(corrected)))
    print(f"Simulation 1, {n_seeds} seeds, per axis: b {rms(b):.4f} px, sigma {rms(sigma):.4f} px")


def gsaoi(n_seeds=50):
    """Catalogue-level twin of the demonstration: relative and absolute errors against what is reported."""
    _, prior = sets.make("gsaoi-like")
    rows = []
    for seed in range(n_seeds):
        sim = simulate_gsaoi_matches(seed=seed)
        solution = solve(sim.matches, prior=prior)
        true = sim.truth.positions[solution.estimate.star_names]
        rows.append(
            [
                accuracy.bias(solution.estimate.positions, true, removed=3),
                accuracy.expected_bias(solution, removed=3),
                accuracy.bias(solution.estimate.positions, true, removed="similarity"),
                accuracy.expected_bias(solution, removed="similarity", absolute=True),
            ]
        )
    b, bound, absolute, reported = (rms(column) for column in zip(*rows, strict=True))
    print(f"GSAOI-like, {n_seeds} seeds: b {b:.4f} px, bound {bound:.4f}, ratio {b / bound:.3f}")
    print(f"  absolute {absolute:.4f} px, reported {reported:.4f}, ratio {absolute / reported:.3f}")


if __name__ == "__main__":
    simulation_1()
    gsaoi()
