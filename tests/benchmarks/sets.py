"""The data sets of the benchmarks."""

import numpy as np

from legdistort.geometry.gsaoi import gsaoi_static
from legdistort.priors.prior import Prior
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving import start_values
from legdistort.solving.equations.problem import build_problem


def make(name, *, n_exposures=100, n_stars=10_000):
    """A simulation and its prior: ``simulation 1``, ``gsaoi-like`` or ``large`` (70 % seen, degree 3)."""
    if name == "gsaoi-like":
        prior = Prior.from_model(gsaoi_static(2), shape=(2048, 2048), direction="detector_to_reference", degree=5)
        return simulate_gsaoi_matches(seed=0), prior
    if name == "large":
        sim = simulate_matches(n_exposures=n_exposures, n_stars=n_stars, seen=0.7, sigma=0.05, seed=0)
    else:
        sim = simulate_matches(seed=0)
    return sim, Prior(sim.truth.static)


def problem(sim, prior, degree=3):
    """The criterion and its start values."""
    posed = build_problem(sim.matches, degree, prior=prior)
    nominal = np.stack([sim.matches.poses[name] for name in sim.matches.names])
    return posed, start_values.start(posed, nominal)[0]
