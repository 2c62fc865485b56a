"""The model of a common map: what counts as known, and how far single exposures scatter."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from legdistort.geometry.detector_modes import dynamic_degrees
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve
from legdistort.solving.gauge import dynamic_scatter, hierarchy


@pytest.fixture(scope="module")
def model():
    """The hierarchy of exposures with dithers and without a prior."""
    made, original = [], hierarchy.Hierarchy.solve

    def record(self, *arguments):
        made.append(self)
        return original(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hierarchy.Hierarchy, "solve", record)
        solve(simulate_matches(n_exposures=8, n_stars=60, dither=150.0, dynamic=0.3, zero_mean=False, seed=1).matches)
    return made[-1]


def deviations(model):
    """Posterior standard deviations of the maps, rms over the stars, ascending."""
    rows = model.rows(model.static)
    information = np.einsum("bia,iac,dc->bd", rows, model.motion, model.maps)
    metric = model.maps @ model.metric @ model.maps.T
    values = np.linalg.eigvals(np.linalg.solve(metric, (information + information.T) / 2)).real
    return np.sort(1 / np.sqrt(np.maximum(values, 1e-12)))


def test_a_map_is_unknown_beyond_a_pixel(model):
    """Weights scale all standard deviations; each leaves the known ones as it passes 1 px, rms over the stars."""
    sigma = deviations(model)
    for k in (4, 9, 12):  # orders of magnitude between them
        for factor, known in ((0.6, k + 1), (1.7, k)):
            scaled = type(model)(**{**vars_of(model), "weight": model.weight * (sigma[k] / factor) ** 2})
            limits = deviations(scaled)
            assert_allclose(limits[k], factor, rtol=1e-6)
            found = scaled.solve("minimal")
            assert found.known.shape[1] == np.count_nonzero(limits < 1)
            assert len(found.unknown) == len(model.maps) - found.known.shape[1]
            assert (found.known.shape[1] > k) == (known > k)


def vars_of(model):
    return {name: getattr(model, name) for name in type(model).__dataclass_fields__}


def test_an_exposure_of_ten_times_the_usual_variance_counts_half():
    error = np.eye(4) * np.array([1.0, 1, 1, 1, 10, 100])[:, None, None]
    counts = dynamic_scatter.influence(error, np.broadcast_to(np.eye(4), (6, 4, 4)))
    assert_allclose(counts, [1, 1, 1, 1, 0.5, 0.01], rtol=0.02)


def test_a_mode_is_drawn_to_its_degree_as_ten_exposures_would():
    """Scatter of modes of a degree that scatter alike, from few exposures: closer to the truth than each by itself."""
    degree = dynamic_degrees(10)
    variance, dof = np.where(degree == 1, 1.0, 0.5), np.full(len(degree), 10.0)
    odd = np.flatnonzero(degree == 3)[2]
    variance[odd] = 4.5
    number = 10 * np.count_nonzero(degree == 3)
    usual = (number + 0.3 * 2) / (number + 0.3)  # with a third of a degree of freedom of twice the most
    assert_allclose(dynamic_scatter._pooled(variance, dof, 9.0)[odd], (4.5 + usual) / 2, rtol=1e-4)
    spread = []
    for shared in (None, 3.3, 30.0):
        rng, off = np.random.default_rng(0), []
        with pytest.MonkeyPatch.context() as patch:
            if shared is not None:
                patch.setattr(dynamic_scatter, "_SHARED", shared)
            for _ in range(400):
                true = np.exp(rng.normal(0, np.sqrt(2 / 10), len(degree)))
                seen = true * rng.chisquare(5, len(degree)) / 5
                made = dynamic_scatter._pooled(seen, np.full(len(degree), 5.0), 9.0)
                off.append(np.mean(np.log(made / true) ** 2))
        spread.append(np.mean(off))
    assert spread[0] < min(spread[1:])
