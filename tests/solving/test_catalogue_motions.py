"""A reference catalogue as prior on the positions, motions and parallaxes of stars that move."""

import numpy as np
import pytest
from moving_stars import AXES, CORRELATIONS, FIVE, SKY, THREE, MovingOracle, field, gaia
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from legdistort.exceptions import InputError
from legdistort.geometry.parallax import on_plane
from legdistort.results import in_tables
from legdistort.results.errors.absolute_errors import absolute_blocks, relative_blocks
from legdistort.solving.estimation import solve


class TiedOracle(MovingOracle):
    """Without constraints: what a reference knows of all stars at the epoch of the solution holds them."""

    def __init__(self, matches, solution, phi, values, covariance):
        super().__init__(matches, solution, phi)
        self.values, self.root = values, np.linalg.inv(np.linalg.cholesky(covariance))

    def residuals(self, x):
        off = self.values - self.unpack(x)[0]
        return np.concatenate([super().residuals(x), np.einsum("jab,jb->ja", self.root, off).ravel()])

    def solve(self):
        start = np.concatenate([self.values.ravel(), np.zeros(self.n_exposures * 2 * self.n_modes)])
        return least_squares(self.residuals, start, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)


def at(values, covariance, years):
    """Values and covariance of x, y, vx, vy ... so many years later."""
    step = np.eye(values.shape[1])
    step[0, 2] = step[1, 3] = years
    return values @ step.T, step @ covariance @ step.T


@pytest.mark.parametrize(
    ("kind", "epochs"), [pytest.param("proper", THREE[::2], marks=pytest.mark.slow), ("parallax", FIVE[::2])]
)
def test_the_dense_oracle_agrees(kind, epochs):
    """Posterior means and covariances, where the catalogue says more of the common maps than anything else."""
    exposures = {"n_exposures": len(epochs), "rotations": np.linspace(0, 40, len(epochs)), "epochs": epochs}
    moved = {"parallax": 0.1} if kind == "parallax" else {}
    sim = field(14, degree=1, static=0.5, dynamic=2.0, sigma=0.03, **exposures, **moved)
    table, values, covariance = gaia(sim, np.random.default_rng(5), n=14, parallax=kind == "parallax")
    solution = solve(sim.matches, degree=1, motion=kind, reference=table, clip=None)
    k = 5 if kind == "parallax" else 4
    values, covariance = at(values[:, :k], covariance[:, :k, :k], in_tables.epoch(solution) - 2016.0)
    phi = (epochs - in_tables.epoch(solution))[:, None, None] * np.eye(2)
    if k == 5:
        phi = np.concatenate([phi, on_plane(SKY, epochs)[:, :, None]], axis=2)
    oracle = TiedOracle(sim.matches, solution, phi, values, covariance)
    found = oracle.solve().x
    step = 1e-4
    jacobian = np.array(
        [(oracle.residuals(found + e) - oracle.residuals(found - e)) / (2 * step) for e in step * np.eye(len(found))]
    )
    expected = np.linalg.inv(jacobian @ jacobian.T)[: 14 * k, : 14 * k].reshape(14, k, 14, k)
    expected = np.stack([expected[j, :, j] for j in range(14)])
    errors = np.sqrt(np.einsum("jaa->ja", expected))
    stars = np.hstack([solution.estimate.positions, solution.estimate.motions.values])
    assert np.abs((stars - oracle.unpack(found)[0]) / errors).max() < 0.06
    absolute = absolute_blocks(solution.gauge, solution.estimate.uncertainty, solution.estimate.positions)
    both = errors[:, :, None] * errors[:, None, :]
    assert np.abs((absolute - expected) / both).max() < 0.02
    assert_allclose(solution.stars["x_err_abs"].value, errors[:, 0], rtol=0.01)


@pytest.mark.parametrize(
    ("n", "kind", "sigma", "accuracy"),
    [
        pytest.param(6, "proper", None, 0.2, marks=pytest.mark.slow),
        pytest.param(3, "parallax", None, 0.25, marks=pytest.mark.slow),
        pytest.param(30, "proper", None, 0.1, marks=pytest.mark.sets),
        pytest.param(30, "proper", 0.3, 0.1, marks=pytest.mark.sets),
        pytest.param(30, "parallax", None, 0.1, marks=pytest.mark.sets),
    ],
)
def test_absolute_errors_are_calibrated(n, kind, sigma, accuracy):
    """With 30 of 100 stars in a catalogue nothing is taken off, of the stars in it and of the others."""
    epochs = FIVE if kind == "parallax" else THREE
    true, stated = [], []
    for seed in range(n):
        sim = field(100, epochs, seed=seed, **({"parallax": 0.1} if kind == "parallax" else {}))
        table, *_ = gaia(sim, np.random.default_rng(seed + 100), parallax=kind == "parallax")
        solution = solve(sim.matches, motion=kind, motion_sigma=sigma, reference=table, clip=None)
        truth, years = sim.truth, in_tables.epoch(solution) - sim.truth.epoch
        off = [solution.estimate.positions - truth.positions - years * truth.motions]
        off.append(solution.estimate.motions.values[:, :2] - truth.motions)
        names = ["x_err_abs", "y_err_abs", "vx_err_abs", "vy_err_abs"]
        if kind == "parallax":
            off.append(10 * (solution.estimate.motions.values[:, 2:] - truth.parallaxes[:, None]))
            names.append("parallax_error_abs")
        errors = np.stack([solution.stars[name].value for name in names], axis=1)
        parts = slice(30), slice(30, None)
        true.append([np.nanmean(np.hstack(off)[part] ** 2, axis=0) for part in parts])  # some are on few exposures
        stated.append([np.nanmean(errors[part] ** 2, axis=0) for part in parts])
    ratio = np.sqrt(np.mean(true, axis=0) / np.mean(stated, axis=0))  # (in the catalogue or not, column)
    ratio = np.column_stack([ratio[:, :2].mean(axis=1), ratio[:, 2:4].mean(axis=1), ratio[:, 4:]])
    assert_allclose(ratio, 1, atol=accuracy)


@pytest.mark.slow
def test_stars_of_the_catalogue_have_what_it_knows_of_them():
    """Where the exposures know less the catalogue rules; a star seen once has its motion."""
    sim = field(60, sigma=0.1)
    rows = sim.matches.table
    kept = ~((rows["star"] == 3) & (rows["epoch"].value > 2016))
    matches = type(sim.matches).from_table(rows[kept], shape=sim.matches.shapes, poses=sim.matches.poses, sky=SKY)
    table, values, covariance = gaia(sim, np.random.default_rng(3), parallax=False, errors=np.full(5, 0.02))
    solution = solve(matches, motion="proper", reference=table, clip=None)
    expected, cov = at(values, covariance, in_tables.epoch(solution) - 2016.0)
    errors = np.sqrt(np.einsum("jaa->ja", cov))
    assert np.abs((solution.estimate.motions.values[:30] - expected[:, 2:4]) / errors[:, 2:4]).max() < 1
    assert_allclose(solution.stars["vx_err_abs"].value[:30], errors[:, 2], rtol=0.05)
    assert np.isfinite(solution.estimate.motions.values[3]).all()
    poor = solve(matches, motion="proper", reference=gaia(sim, np.random.default_rng(3), errors=np.full(5, 20.0))[0])
    alone = solve(matches, motion="proper")
    others = np.arange(60) != 3
    ratio = poor.stars["vx_err"].value[others] / alone.stars["vx_err"].value[others]
    assert ratio.max() < 1.05
    assert np.median(ratio) == pytest.approx(1, abs=0.05)


@pytest.mark.slow
def test_a_tie_settles_where_the_scatter_of_motions_is_known():
    """The map of the positions is not mixed with those that change with time, which the motions of stars then tell."""
    sim = field(60)
    table = gaia(sim, np.random.default_rng(1), parallax=False, errors=np.full(5, 1.0))[0]
    solution = solve(sim.matches, motion="proper", motion_sigma=0.3, reference=table, clip=None)
    assert "tied to the reference in" in solution.status
    assert "not settled" not in solution.status


@pytest.mark.slow
def test_a_table_of_stars_is_a_prior_of_its_motions():
    """Columns of motions in pixels, with their correlations, serve as those on the sky do."""
    sim = field(60, sky=None)
    first = solve(sim.matches, motion="proper", clip=None)
    stars = first.stars[:40]
    again = solve(sim.matches, motion="proper", reference=stars, clip=None)
    assert "tied to the proper motions of 40 stars" in str(again.gauge)
    assert np.all(again.stars["vx_err_abs"][:40] < first.stars["vx_err_abs"][:40])
    stars["vx"][5] += 100 * stars["vx"].unit  # one that deviates is left out
    kept = solve(sim.matches, motion="proper", reference=stars, clip=None)
    assert not kept.gauge.tie.used[5]
    assert np.abs(kept.estimate.motions.values - again.estimate.motions.values).max() < 0.02
    del stars["vx_err"], stars["vx_err_abs"]
    with pytest.raises(InputError, match="lacks vx_err, errors of its motions"):
        solve(sim.matches, motion="proper", reference=stars)


@pytest.mark.slow
def test_positions_alone_and_parallaxes_alone():
    """What the catalogue does not tell stays as it is: motions without rates, parallaxes without their mean."""
    sim = field(60, FIVE, parallax=0.1)
    table = gaia(sim, np.random.default_rng(1))[0]
    places = table["star", "ra", "dec", "ra_error", "dec_error"]
    with_mean = "common rates of shift, rotation and scale and the mean parallax, which are not known"
    assert with_mean in str(solve(sim.matches, motion="parallax", reference=places, motion_epoch=2016.0).gauge)
    moving = table[[name for name in table.colnames if "parallax" not in name]]
    gauge = solve(sim.matches, motion="parallax", reference=moving).gauge
    assert "the proper motions of 30 stars of the reference, after the mean parallax, which is not known" in str(gauge)
    gauge = solve(sim.matches, motion="parallax", reference=table).gauge
    assert "tied to the proper motions and parallaxes of 30 stars of the reference." in str(gauge)


def test_stars_with_two_parameters_tell_their_position_alone():
    """Gaia has no motion and no parallax of its faintest stars: they count where the epochs are the same."""
    sim = field(60, FIVE, parallax=0.1)
    table = gaia(sim, np.random.default_rng(1), ref_epoch=2016.0)[0]
    for name in ("pmra", "pmdec", "parallax", "pmra_error", "pmdec_error", "parallax_error"):
        table[name][:10] = np.nan
    assert solve(sim.matches, motion="parallax", reference=table, motion_epoch=2016.0).gauge.drift.n_tied == 20
    assert len(solve(sim.matches, motion="parallax", reference=table, motion_epoch=2017.0).gauge.tie.stars) == 20


def test_degree_0_has_no_such_prior():
    sim = field(60, degree=0, static=0.0)
    with pytest.raises(InputError, match="at degree 1 or more"):
        solve(sim.matches, degree=0, motion="proper", reference=gaia(sim, np.random.default_rng(1))[0])


def test_correlations_of_the_stars():
    """Those of the covariance of each star, named as in the Gaia catalogue."""
    sim = field(60, FIVE, parallax=0.1)
    solution = solve(sim.matches, motion="parallax", motion_epoch=2000.0)
    stars = solution.stars
    relative = relative_blocks(solution.gauge, solution.estimate.uncertainty, solution.estimate.positions).transpose(
        1, 2, 0
    )
    for (a, b), name in CORRELATIONS.items():
        expected = relative[a, b] / np.sqrt(relative[a, a] * relative[b, b]) * np.sign(AXES[a] * AXES[b])
        assert_allclose(stars[name], expected, atol=0.03, err_msg=name)
    assert np.median(stars["x_vx_corr"]) < -0.9  # years before the exposures
    assert np.median(stars["ra_pmra_corr"]) < -0.9
    assert {"x_vy_corr", "y_parallax_corr", "parallax_vx_corr"} <= set(stars.colnames)
