"""Posterior, sizes and tests of what is known, against dense Gaussian formulas and a dense model of its own."""

import warnings

import dense_model
import drawn_sets
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import optimize, sparse, stats

import legdistort as ld
from legdistort.cameras.stated_errors import StaticSpread
from legdistort.exceptions import LegdistortWarning, SolveError
from legdistort.geometry import basis
from legdistort.solving.knowledge.exposures import ExposureModel
from legdistort.solving.knowledge.factors import GIVEN, Factor
from legdistort.solving.knowledge.posterior import Posterior, most_likely
from legdistort.solving.knowledge.reduced_data import ReducedData
from legdistort.solving.knowledge.static_test import StaticTest, _symmetries, static_tests

RNG = np.random.default_rng


def solved(data, prior=None, **options):
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        return ld.solve(drawn_sets.as_matches(data), degree=data["degree"], prior=prior, **options)


def model_of(solution):
    known = solution.estimate.checked.keywords
    group = np.zeros(len(solution.names), dtype=int)
    return ExposureModel.of(known["problem"], known["state"], solution.gauge.all_motion, group)


@pytest.fixture(scope="module")
def linear():
    """Data y = D z + noise on 6 of 9 unknowns, with rows of two sizes and rows of given width on all: dense arrays."""
    rng = RNG(4)
    design, noise = rng.normal(size=(40, 6)), rng.uniform(0.5, 2, 40)
    rows = np.zeros((15, 9))
    rows[:6, :6] = np.eye(6)
    rows[np.arange(6), 6 + np.arange(6) % 3] = -1
    rows[6:12, :6] = rng.normal(size=(6, 6))
    rows[12:, 6:] = np.eye(3)
    value, size = rng.normal(size=15), np.repeat([0, 1, GIVEN], [6, 6, 3])
    width, y = np.where(size == GIVEN, 0.7, np.nan), rng.normal(size=40)
    weighted = design.T / noise**2
    data = ReducedData(weighted @ design, weighted @ y, float(((y / noise) ** 2).sum()), 40)
    return data, Factor("test", sparse.csr_array(rows), value, width, size), (design, noise, y, rows)


class TestPosterior:
    SIZES = np.array([0.8, 1.7])

    def whitened(self, linear):
        """One least-squares problem: rows over widths, and values."""
        _, factor, (design, noise, y, rows) = linear
        width = factor.widths(self.SIZES)
        whole = np.concatenate([np.pad(design, ((0, 0), (0, 3))) / noise[:, None], rows / width[:, None]])
        return whole, np.concatenate([y / noise, -factor.value / width])

    def test_mean_and_covariance_are_those_of_least_squares(self, linear):
        posterior, (rows, y) = Posterior(*linear[:2], self.SIZES), self.whitened(linear)
        assert_allclose(posterior.mean, np.linalg.lstsq(rows, y, rcond=None)[0], rtol=1e-10)
        assert_allclose(posterior.covariance, np.linalg.inv(rows.T @ rows), rtol=1e-9, atol=1e-12)

    def test_likelihood_of_sizes_is_that_of_the_values_with_all_unknowns_integrated_out(self, linear):
        """Differences of it between sizes: N(0, width^2) of everything, as it is seen off the unknowns."""
        values = []
        for sizes in (self.SIZES, 1.3 * self.SIZES, np.array([2.0, 0.4])):
            data, factor, (design, noise, y, rows) = linear
            width = np.concatenate([noise, factor.widths(sizes)])
            whole = np.concatenate([np.pad(design, ((0, 0), (0, 3))), rows])
            free = np.linalg.qr(whole, mode="complete")[0][:, whole.shape[1] :].T
            seen = free @ np.concatenate([y, -factor.value])
            log = stats.multivariate_normal(np.zeros(len(seen)), free * width**2 @ free.T).logpdf(seen)
            values.append((Posterior(data, factor, sizes).cost, -2 * log))
        (a, b), others = values[0], values[1:]
        for mine, other in others:
            assert mine - a == pytest.approx(other - b, rel=1e-9)

    def test_slopes_are_those_of_differences(self, linear):
        h = 1e-4
        first, second = Posterior(*linear[:2], self.SIZES).cost_slopes
        for k in range(2):
            sizes = [np.where(np.arange(2) == k, self.SIZES * np.exp(s * h), self.SIZES) for s in (1, -1)]
            up, down = (Posterior(*linear[:2], each) for each in sizes)
            assert first[k] == pytest.approx((up.cost - down.cost) / (2 * h), rel=1e-5)
            assert_allclose(second[k], (up.cost_slopes[0] - down.cost_slopes[0]) / (2 * h), rtol=1e-5)

    def test_most_likely_sizes_are_a_minimum(self, linear):
        best = most_likely(*linear[:2], [1.0, 1.0], (1e-3, 1e3))
        for factor in (0.9, 1.1):
            for k in range(2):
                sizes = np.where(np.arange(2) == k, factor * best.sizes, best.sizes)
                assert Posterior(*linear[:2], sizes).cost > best.cost
        assert np.all(best.determined < [6, 6])

    def test_most_likely_sizes_beside_unknowns_of_no_size_are_those_of_the_dense_model(self):
        rng = RNG(7)
        design, rows = rng.normal(size=(30, 12)), np.zeros((12, 12))
        rows[:8, 2:10] = np.eye(8)
        rows[8:, [0, 1, 10, 11]] = np.eye(4)
        rows[8:, 2:6] = rng.normal(size=(4, 4))  # what is given ties both kinds of unknowns
        size, width = np.repeat([0, 1, GIVEN], 4), np.full(12, 0.7)
        value, stretch = rng.normal(size=12) * [*[3.0] * 4, *[0.5] * 4, *[0.7] * 4], rng.uniform(1, 2, 12)
        y = design @ np.linalg.solve(rows, rng.normal(size=12) * [*[3.0] * 4, *[0.5] * 4, *[0.7] * 4]) + rng.normal(
            size=30
        )
        data = ReducedData(design.T @ design, design.T @ y, float(y @ y), 30)
        factor = Factor("test", sparse.csr_array(rows), value, width, size, stretch)

        def cost(logs):  # y ~ N(mean, I + D R^-1 W^2 R'^-1 D'), for z = R^-1 (W e - value)
            widths = stretch * np.where(size == GIVEN, width, np.append(np.exp(logs), 0.0)[size])
            turned = design @ np.linalg.inv(rows)
            covariance, away = np.eye(30) + turned * widths**2 @ turned.T, y + turned @ value
            return np.linalg.slogdet(covariance)[1] + away @ np.linalg.solve(covariance, away)

        best = most_likely(data, factor, [1.0, 1.0], (1e-3, 1e3))
        expected = optimize.minimize(cost, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9})
        assert_allclose(np.log(best.sizes), expected.x, atol=0.02)  # slopes below 0.02 count as none
        assert len(best.mean) == 12

    def test_without_a_factor_is_the_limit_of_a_wide_one(self, linear):
        data, factor, _ = linear
        others = Factor(factor.name, factor.rows[:12], factor.value[:12], factor.width[:12], factor.size[:12])
        last = Factor("last", factor.rows[12:], factor.value[12:], factor.width[12:], factor.size[12:])
        information, slope = Posterior(data, Factor.joined([others, last]), self.SIZES).without(last)
        wide = Factor("wide", last.rows, last.value, np.full(3, 1e7), last.size)
        limit = Posterior(data, Factor.joined([others, wide]), self.SIZES)
        assert_allclose(np.linalg.inv(information), limit.covariance[6:, 6:], rtol=1e-6)
        assert_allclose(np.linalg.solve(information, slope), limit.mean[6:], rtol=1e-6)

    def test_what_nothing_determines_is_refused_by_name(self, linear):
        data, factor, _ = linear
        part = Factor("rows of two sizes", factor.rows[6:12], factor.value[6:12], factor.width[6:12], factor.size[6:12])
        with pytest.raises(SolveError, match=r"rows of two sizes: .* do not determine all unknowns"):
            _ = Posterior(data, part, self.SIZES).mean


@pytest.mark.parametrize(
    ("seed", "changes"),
    [pytest.param(0, {}, marks=pytest.mark.slow), (1, {"rolls": 30.0}), (2, {"n": 6, "dynamic": 0.1})],
)
def test_sizes_are_those_of_the_dense_model(seed, changes):
    data, _ = dense_model.drawn_set(seed, n_stars=60, **changes)
    dense = dense_model.Model(**data).fit()
    found = model_of(solved(data, clip=None)).posterior
    assert_allclose(found.sizes, dense.sizes[:4], rtol=0.05)


@pytest.mark.slow
def test_dense_model_reaches_the_errors_at_large_departures():
    """Of the twin itself: 10 px a mode, where a convention held while minimising leaves chi2/dof at 80 and more."""
    data, truth = dense_model.drawn_set(0, dynamic=10.0)
    dense = dense_model.Model(**data, mean=truth["static"], v=0).fit(n_iter=15)
    assert abs(dense.chi2 / dense.dof - 1) < 0.1


class TestStatic:
    """The test of a prior."""

    def of(self, data, given, sigma=0.0, covariance=None):
        solution = solved(data, ld.Prior(given, static_sigma=sigma or None, static_covariance=covariance))
        other = dense_model.rows(3)[1]  # the same as the package has them, but for signs and order
        from legdistort.geometry.detector_modes import dynamic_basis

        mine = dynamic_basis((2048, 2048), 10)
        assert_allclose(mine.T @ mine, other.T @ other, atol=1e-12)
        spread = StaticSpread.of(mine[None], np.full((1, 20), sigma), None if covariance is None else [covariance])
        (test,) = static_tests(model_of(solution), (mine @ np.ravel(given))[None], spread, [(2048, 2048)])
        return test

    def test_agrees_with_the_dense_model(self):
        """T of the twin: its posterior of S without the factor on it, at its own sizes."""
        data, truth = dense_model.drawn_set(3, rolls=30.0)
        dense = dense_model.Model(**data, mean=truth["static"]).fit()
        test = self.of(data, truth["static"])
        assert len(test.directions) == 16
        prior = dense_model.Model(**data, mean=truth["static"], v=0, scatter=dense.sizes[:3]).fit()
        free = dense_model.Model(**data, mean=truth["static"], v=1e3, scatter=dense.sizes[:3]).fit()
        # chi2 along S: J at the prior less J where S is free; the twin knows no projection of the common maps
        assert test.statistic() == pytest.approx(prior.cost - free.cost, rel=0.25)

    @pytest.mark.parametrize("sigma", [0.0, 0.3])
    def test_the_right_one_agrees_and_one_that_is_not_would_be_found(self, sigma):
        data, truth = dense_model.drawn_set(5, rolls=30.0)
        test = self.of(data, truth["static"], sigma)
        assert test.p > 0.01
        assert test.power(1e-3) > 0.95
        assert self.of(data, -truth["static"], sigma).p < (1e-10 if not sigma else 1e-3)

    def test_it_is_blind_along_what_is_not_known(self):
        """However wrong the mean is along a combination of unknown size, and nowhere else."""
        data, truth = dense_model.drawn_set(5, rolls=30.0)
        along = np.zeros((2, 10))
        along[:, [3, 5, 7]] = RNG(4).normal(size=(2, 3))
        across = np.roll(along, 1, axis=0) * [[1], [-1]]
        covariance = 0.01**2 * np.eye(20) + 500.0**2 * np.outer(along, along)
        right, wrong, off = (
            self.of(data, truth["static"] + each, covariance=covariance) for each in (0, 0.15 * along, 1.5 * across)
        )
        assert len(right.directions) == 15
        assert wrong.statistic() == pytest.approx(right.statistic(), rel=0.03)
        assert right.p > 0.01
        assert off.p < 1e-6

    @pytest.mark.slow
    def test_p_is_evenly_spread_for_right_priors(self):
        sets = (dense_model.drawn_set(seed, n_stars=70) for seed in range(30))
        p = [self.of(data, truth["static"]).p for data, truth in sets]
        assert stats.kstest(p, "uniform").pvalue > 1e-3
        assert 0.2 < np.mean(p) < 0.9

    @pytest.mark.parametrize("words", list(_symmetries((2048, 2048)))[1:])
    def test_maps_that_are_turned_are_named(self, words):
        data, truth = dense_model.drawn_set(6, rolls=30.0, static=1.5)
        wrong = _symmetries((2048, 2048))[words](truth["static"])
        test = self.of(data, wrong)
        better = test.better()
        back = {"turned by 90 degrees": "turned by -90 degrees", "turned by -90 degrees": "turned by 90 degrees"}
        assert min(better, key=better.get) == back.get(words, words)
        assert test.p < 1e-6

    def test_a_multiple_is_named(self):
        data, truth = dense_model.drawn_set(7, rolls=30.0, static=2.0, dynamic=0.1)
        test = self.of(data, 0.5 * truth["static"])
        gain, factor = test.along
        assert factor == pytest.approx(2.0, abs=0.1)
        better = test.better()
        assert min(better, key=better.get) == f"times {factor:.2g}"
        assert test.statistic() - gain == pytest.approx(test.statistic(factor * test.given), rel=1e-9)

    def test_nothing_is_tested_without_dithers(self):
        data, truth = dense_model.drawn_set(8, dither=2.0)
        test = self.of(data, -truth["static"])
        assert test.power(1e-3) < 0.5
        assert test.p > 1e-3

    def test_power_is_the_share_that_is_found(self):
        """Of drawn differences, for a test of any information."""
        information, given = np.diag([4.0, 1.0, 0.25]), np.array([2.0, 1.0, 1.0])
        test = StaticTest(information, np.zeros(3), given, np.zeros((3, 3)), (8, 8), np.eye(3), 1e6)
        drawn = given + RNG(4).normal(size=(20_000, 3)) / np.sqrt(np.diag(information))
        t = np.einsum("na,ab,nb->n", drawn, information, drawn)
        assert test.power(0.05) == pytest.approx(np.mean(t > stats.chi2.isf(0.025, 3)), abs=0.03)


@pytest.mark.parametrize("words", _symmetries((64, 64)))
def test_symmetries_turn_the_field_and_its_vectors(words):
    """a'(q) = R a(R^-1 q) for an orthogonal R, by the values of the field."""
    r = {
        "": [[1, 0], [0, 1]], "mirrored along x": [[-1, 0], [0, 1]], "mirrored along y": [[1, 0], [0, -1]],
        "turned by 180 degrees": [[-1, 0], [0, -1]], "with x and y exchanged": [[0, 1], [1, 0]],
        "turned by 90 degrees": [[0, -1], [1, 0]], "turned by -90 degrees": [[0, 1], [-1, 0]],
        "mirrored across the other diagonal": [[0, -1], [-1, 0]],
    }[words]  # fmt: skip
    rng = RNG(4)
    field, points = rng.normal(size=(2, basis.n_modes(3))), rng.uniform(-1, 1, (2, 20))
    turned = _symmetries((64, 64))[words](field)
    expected = np.array(r) @ field @ basis.values(3, *(np.array(r).T @ points))
    assert_allclose(turned @ basis.values(3, *points), expected, atol=1e-12)


def test_a_detector_that_is_no_square_is_not_turned_by_a_right_angle():
    assert len(_symmetries((32, 64))) == 4


class TestCheck:
    """As a user sees it."""

    def of(self, data, prior):
        return next(c for c in solved(data, prior).checks if c.name == "prior")

    def test_states(self):
        data, truth = dense_model.drawn_set(9, rolls=30.0)
        check = self.of(data, ld.Prior(truth["static"], source="map.fits"))
        assert check.state == "pass"
        assert check.sentence == "the static distortion given (map.fits) agrees with what dithers and rolls show of it"
        check = self.of(data, ld.Prior(-truth["static"], source="map.fits"))
        assert check.state == "fail"
        begin = "the static distortion given (map.fits) is not what dithers and rolls show, by "
        assert check.sentence.startswith(begin)
        assert check.sentence.endswith(" px rms; with its sign reversed it would agree")
        assert "--static-sigma" in check.cure

    def test_untested_is_said(self):
        data, truth = dense_model.drawn_set(10, dither=1.0)
        check = self.of(data, ld.Prior(-truth["static"]))
        assert check.state == "unknown"
        assert "believed, not tested" in check.sentence
        assert "dithers" in check.cure

    @pytest.mark.slow
    def test_one_of_two_detectors_is_named(self):
        """Exposures of two detectors of one field, the prior of the second with the wrong sign."""
        data, truth = dense_model.drawn_set(11, rolls=30.0, n=14)
        odd = data["exposure"] % 2 == 1
        matches = drawn_sets.as_matches(data)
        matches.table["detector"] = np.where(odd, "b", "a")
        right, wrong = ld.Prior(truth["static"]), ld.Prior(-truth["static"])
        with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
            solution = ld.solve(matches, prior={"a": right, "b": wrong})
        check = next(c for c in solution.checks if c.name == "prior")
        assert check.state == "fail"
        assert "given for e01 is not what" in check.sentence
        assert check.sentence.endswith("with its sign reversed it would agree")

    @pytest.mark.parametrize("options", [{}, {"static": "fit"}])
    def test_there_is_none_where_nothing_is_believed(self, options):
        data, _ = dense_model.drawn_set(12, rolls=30.0)
        assert not [c for c in solved(data, **options).checks if c.name == "prior"]

    @pytest.mark.slow
    def test_many_exposures_are_drawn_from(self):
        data, truth = dense_model.drawn_set(13, rolls=30.0, n=60, n_stars=60)
        assert self.of(data, ld.Prior(truth["static"])).state == "pass"
        assert self.of(data, ld.Prior(-truth["static"])).state == "fail"

    def test_errors_that_are_too_small_are_no_alarm(self):
        """Nothing scatters but the noise, which is three times what is stated."""
        data, truth = dense_model.drawn_set(15, rolls=30.0, dynamic=0.0)
        check = self.of(data | {"err": data["err"] / 3}, ld.Prior(truth["static"]))
        assert check.state == "pass"
        assert check.value > 0.02

    def test_large_shared_departures_are_an_alarm_too(self):
        """All exposures depart by the same from the prior: it is not what they show, whoever is to blame."""
        data, truth = dense_model.drawn_set(14, rolls=30.0, dynamic=0.05)
        assert self.of(data, ld.Prior(0.8 * truth["static"])).state in ("warn", "fail")
