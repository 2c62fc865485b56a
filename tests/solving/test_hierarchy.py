"""The model of a common map: what counts as known, and how far single exposures scatter."""

import contextlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from legdistort.cameras.stated_errors import StaticSpread
from legdistort.exceptions import SolveError
from legdistort.geometry.detector_modes import dynamic_basis, dynamic_degrees
from legdistort.geometry.plane_modes import PlaneModes
from legdistort.matching.matches import Matches
from legdistort.results.gauge import UnknownMap
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve
from legdistort.solving.gauge import catalogue_map, constraints, dynamic_scatter, hierarchy
from legdistort.solving.gauge.catalogue_agreement import agreement


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


def test_of_a_degree_that_nothing_determines_twice_the_largest_scatter_is_assumed():
    degree = dynamic_degrees(10)
    variance, dof = np.array([9.0, 0.3, 0.7])[degree - 1], np.where(degree == 1, 0.0, 1e6)
    assert_allclose(dynamic_scatter._pooled(variance, dof, 5.0), np.array([1.4, 0.3, 0.7])[degree - 1], rtol=1e-4)
    assert_allclose(dynamic_scatter._pooled(variance, np.zeros(len(degree)), 5.0), 5.0)


@pytest.mark.parametrize(("ratio", "counts"), [(9.5, True), (10.5, False)])
def test_scatter_is_that_of_exposures_of_less_than_ten_times_the_usual_variance(ratio, counts):
    """What an exposure departs by says nothing where its errors are that large."""
    n, modes = 9, 6
    own = np.random.default_rng(0).normal(0, 0.1, (n, 2, modes))
    others = np.stack([dynamic_basis((1000, 1000), modes)] * n)

    def scatter(departure):
        own[-1] = departure
        error = 1e-4 * np.where(np.arange(n) == n - 1, ratio, 1.0)[:, None, None] * np.eye(2 * modes)
        problem = SimpleNamespace(n_modes=modes, n_exposures=n, prior_mean=0.0, has_widths=lambda i: False)
        state, maps, exact = (
            SimpleNamespace(coefficients=own),
            np.zeros((n, 8, 0)),
            StaticSpread.of_rows(np.zeros((1, 8))),
        )
        return dynamic_scatter.dynamic_covariance(problem, state, error, maps, others, None, np.zeros(n, int), exact)[
            0
        ][0]

    assert (np.trace(scatter(3.0)) > 2 * np.trace(scatter(0.1))) == counts


# --- what residuals determine ------------------------------------------------------------------------------------


def released(chi2, gain, curvature=(100.0, 100.0), dof=400):
    """Number of two unknown maps that residuals determine, of so much gain in chi2 and so much information."""
    information, n = np.diag([*curvature, 0, 0, 0, 0]), 3
    system = SimpleNamespace(
        dof=dof,
        blocks=SimpleNamespace(chi2=chi2),
        information=information,
        pull=np.sqrt(np.diag(information) * [*gain, 0, 0, 0, 0]),
    )
    maps = tuple(UnknownMap("degree 2", 2, row) for row in np.eye(2 * n)[:2])
    gauge = SimpleNamespace(unknown_maps=maps, reach=np.eye(2 * n), n_modes=n)
    return hierarchy.determined_by_residuals(system, gauge).shape[1]


def test_residuals_determine_a_map_by_five_standard_errors():
    assert [released(600.0, (200.0, gain)) for gain in (4.6**2, 5.4**2)] == [1, 2]
    assert [released(960.0, (300.0, 1.6 * z**2)) for z in (4.6, 5.4)] == [1, 2]  # at the observed scale


def test_residuals_determine_a_map_to_a_pixel():
    assert [released(600.0, (200.0, 200.0), (100.0, sigma**-2)) for sigma in (1.1, 0.9)] == [1, 2]
    assert [released(960.0, (200.0, 200.0), (100.0, 1.4 * sigma**-2)) for sigma in (1.1, 0.9)] == [1, 2]


def test_residuals_that_chance_explains_determine_nothing():
    """chi2 scatters by sqrt(2 * 400) = 28."""
    assert [released(400 + z * 28.3, (60.0, 60.0)) for z in (4.7, 5.3)] == [0, 2]


def test_residuals_with_another_cause_determine_nothing():
    """Two per degree of freedom are left, and more than a tenth."""
    assert [released(2000.0, (600.0, left)) for left in (580.0, 620.0)] == [0, 2]
    assert [released(20000.0, (9000.0, gain)) for gain in (8900.0, 9100.0)] == [0, 2]


def test_residuals_determine_maps_however_they_are_turned():
    """Two of three maps that are told, in a basis in which none of them is one of the maps that are listed."""
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    information = np.diag([400.0, 100.0, 1e-4, 1.0, 1.0, 1.0])
    pull = np.sqrt(np.diag(information)) * [20.0, 15.0, 10.0, 0, 0, 0]
    system = SimpleNamespace(dof=400, blocks=SimpleNamespace(chi2=1200.0), information=information, pull=pull)
    maps = tuple(UnknownMap("degree 2", 2, np.concatenate([row, np.zeros(3)])) for row in turn)
    gauge = SimpleNamespace(unknown_maps=maps, reach=np.eye(6), n_modes=3)
    found = hierarchy.determined_by_residuals(system, gauge)
    assert_allclose(found @ found.T, np.diag([1, 1, 0, 0, 0, 0]), atol=1e-9)


# --- names of unknown maps, and constraints ----------------------------------------------------------------------


BOX = np.array([[[500.0, 500], [500, 500]]])


@pytest.mark.parametrize(("share", "name"), [(0.87, "degree 2"), (0.93, "z^2")])
def test_a_map_has_the_name_of_what_it_mostly_is(share, name):
    modes, power = PlaneModes(BOX, 6), np.eye(6) / 4
    pointed = hierarchy._pointing_off(power, modes.similar.T)
    metric = hierarchy._metric(power, pointed)
    patterns = {each: pattern for each, _, pattern in hierarchy._patterns(modes)}
    u, v = np.meshgrid(*[(np.arange(200) + 0.5) / 100 - 1] * 2)
    square = np.real((u + 1j * v) ** 2)  # by its definition
    squares = [np.sqrt(5) / 2 * (3 * each**2 - 1) / np.sqrt(4) for each in (u, v)]
    along = patterns["z^2"] / np.sqrt(patterns["z^2"] @ metric @ patterns["z^2"])
    assert along[3] / along[5] == pytest.approx(np.mean(square * squares[0]) / np.mean(square * squares[1]))
    across = np.where(np.isin(np.arange(12), [3, 5]), 1.0, 0.0)  # x^2 + y^2 in x alone, which turns no angle right
    across -= along * (along @ metric @ across)
    across /= np.sqrt(across @ metric @ across)
    maps = (np.sqrt(share) * along + np.sqrt(1 - share) * across)[:, None]
    assert [each.name for each in hierarchy._named(maps, pointed, metric, modes)] == [name]


def test_patterns_have_the_degree_of_their_name():
    told = [(name, degree) for name, degree, _ in hierarchy._patterns(PlaneModes(BOX, 10))]
    assert told == [("shear", 1)] * 2 + [("z^2", 2), ("i z^2", 2), ("z^3", 3), ("i z^3", 3)]


def test_the_origin_of_the_plane_is_of_no_matter():
    """Absolute errors and what is unknown are the same where the positions lie far from the origin."""
    sim = simulate_matches(n_exposures=5, n_stars=40, degree=2, dither=150.0, rotations=[0, 20, 40, 60, 80], seed=1)
    shift = np.array([40_000.0, -30_000.0])
    moved = {name: np.column_stack([pose[:, :2], pose[:, 2] - pose[:, :2] @ shift])
             for name, pose in sim.matches.poses.items()}  # fmt: skip
    far = Matches.from_table(sim.matches.table, shape=(2048, 2048), poses=moved)
    one, other = (solve(matches, degree=2, clip=None) for matches in (sim.matches, far))
    assert one.gauge.unknown_names == other.gauge.unknown_names
    assert_allclose(other.estimate.positions, one.estimate.positions + shift, atol=1e-4)
    for a, b in ((one, other), (other, one)):
        covariance = a.absolute_covariance(without_unknown=True)
        assert_allclose(b.absolute_covariance(without_unknown=True), covariance, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(("degrees", "refused"), [(3.0, True), (4.5, False)])
def test_the_mean_gauge_is_refused_where_rolls_nearly_cancel(degrees, refused):
    """A shift seen by two exposures 180 degrees apart, but for so much: sin^2 of half of that is left of it."""
    angle = np.radians(180 - degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = pytest.raises(SolveError, match="of these exposures cancel") if refused else contextlib.nullcontext()
    with expected:
        constraints._check_mean(np.stack([np.eye(2), turn]))


@pytest.mark.parametrize(("seen", "taken_back"), [(0.007, 8), (0.014, 7)])
def test_a_map_of_which_a_percent_is_not_taken_back_is_left_to_the_data(seen, taken_back):
    """One mode of six per axis is fixed in all exposures, and a map of the plane shows in it by so much."""
    motion = np.stack([np.eye(12)] * 3)
    motion[:, 4, 4] = seen
    problem = SimpleNamespace(n_modes=6, n_exposures=3, fixed=[np.eye(12)[4:5]] * 3)
    maps = constraints._taken_back(problem, motion, PlaneModes(BOX, 6), False)
    assert len(maps) == taken_back
    assert (np.abs(maps[:, 4]).max() > 0.1) == (taken_back == 8)


@pytest.mark.parametrize(("scale", "counts"), [(1.9, True), (2.1, False)])
def test_an_exposure_of_twice_the_scale_is_no_part_of_the_plane(scale, counts):
    poses = np.stack([np.eye(2, 3)] * 4)
    poses[-1, :, :2] /= scale
    problem = SimpleNamespace(shapes=[(1000, 1000)] * 4, n_modes=6, n_fields=1, fields=np.zeros(4))
    ((_, half),) = constraints.reference_modes(problem, SimpleNamespace(poses=poses)).boxes
    assert_allclose(half * 2, 1000 * (scale if counts else 1), rtol=1e-3)


# --- offsets of a reference --------------------------------------------------------------------------------------


def offsets(pulls):
    """Equations of a reference of unit errors, for shift, rotation and scale, whose x are so many of them off."""
    n = len(pulls)
    xy = np.random.default_rng(0).uniform(-1, 1, (n, 2))
    values = np.column_stack([np.ones(n), xy])
    directions = np.kron(np.eye(2), values).reshape(2, n, 6).transpose(1, 0, 2)
    made = catalogue_map.Offsets(np.arange(n), np.column_stack([pulls, np.zeros(n)]), np.stack([np.eye(2)] * n))
    prior = catalogue_map.MapPrior(np.zeros((6, 6)), np.zeros(6), PlaneModes(np.array([[[0.0, 0], [1, 1]]]), 3))
    return catalogue_map.MapEquations(made, directions, 1e-6 * np.eye(2 * n), prior)


def test_a_bend_that_nothing_tests_has_no_size():
    """Of two shears one is known to 0.01 px, the other not at all: what is left of its information is rounding."""
    for better in range(1, 40):
        equations = offsets(np.random.default_rng(0).normal(size=30)).times(1 / better)
        shear = equations.prior.modes.others[0]
        equations.prior = replace(equations.prior, information=1e4 * np.outer(shear, shear))
        made = agreement(equations, equations, np.ones(30, dtype=bool))
        assert made.bend_dof == 1
        assert made.unseen == np.inf


def test_mismatches_are_judged_by_the_scatter_that_is_seen():
    """The median of the lengths of offsets in a plane is sqrt(2 ln 2) of their scatter along an axis: 3.4 here."""
    for pull, fair in ((16.0, True), (19.0, False)):
        pulls = 4.0 * np.random.default_rng(2).permutation(np.tile([-1, 1], 100))
        pulls[7] = pull
        used = catalogue_map.accepted(offsets(pulls), "a catalogue")
        assert used.tolist() == [fair or k != 7 for k in range(200)]


def test_where_many_are_mismatches_an_offset_is_one_sooner():
    """30 of 100 offsets are 20 errors long: one of 4.3, which 1 of 10,000 good ones have, is rather one of them."""
    for share, fair in ((0.0, True), (0.3, False)):
        pulls = np.random.default_rng(3).normal(size=100)
        pulls[: int(100 * share)] = np.random.default_rng(4).choice([-20.0, 20.0], int(100 * share))
        pulls[50] = 4.3
        used = catalogue_map.accepted(offsets(pulls), "a catalogue")
        assert used[50] == fair
        assert used[int(100 * share) :].sum() >= 100 - int(100 * share) - (not fair)


def test_a_star_of_a_reference_is_a_mismatch_from_five_standard_errors():
    for pull, fair in ((4.7, True), (5.4, False)):
        used = catalogue_map.accepted(offsets(np.where(np.arange(80) == 7, pull, 0.0)), "a catalogue")
        assert used.tolist() == [fair or k != 7 for k in range(80)]
