"""The static distortion of a camera from many nights; nights and their truth are made by numpy alone."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from night_sets import SIZE, Nights, field
from numpy.testing import assert_allclose, assert_array_equal
from rolled_night import modes, night

import legdistort as ld
from legdistort.assessment.nights.combined_nights import Chain, fitted
from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry import detector_modes

SHAPE = (SIZE, SIZE)
ORDERS = np.add.outer(np.arange(4), np.arange(4))
#: Degree of the coefficients that are no similarity, as nights state them: two shears, then x and y.
DEGREES = np.array([1, 1, *[2] * 3, *[3] * 4, *[2] * 3, *[3] * 4])


def curved(seed, size):
    """A map of degrees 2 and 3, so that it has no part of a similarity."""
    return field(np.random.default_rng(seed), size) * (ORDERS > 1)


def static(seed):
    return curved(9000 + seed, 1.5)


def solved(seed, of, **how):
    table = night(seed, of, n_stars=how.pop("n_stars", 70), exposures=how.pop("exposures", 6), **how)
    return ld.solve(ld.Matches.from_table(table, shape=SHAPE))


def campaign(seed, n, *, nightly=0.02, rate=0.0, odd=None, **how):
    """Solutions of n nights half a year apart, and their static distortion in the mean of the time."""
    slope, out = curved(7000 + seed, rate), []
    for i in range(n):
        own = curved(100 * seed + i, 0.5 if i == odd else nightly)
        out.append(
            solved(5000 + 100 * seed + i, static(seed) + own + slope * (i - (n - 1) / 2) / 2, year=2014 + i / 2, **how)
        )
    return out


@pytest.fixture(scope="module")
def three():
    return campaign(1, 3)


# --- the chain of nights ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate", "walk", "slope"),
    [(0, 0, 0), (0, 0.3, 0), (0.2, 0, 0), (0.2, 0.3, 0), (0, 0, 0.4), (0.2, 0.3, 0.4)],
)
def test_a_chain_is_a_dense_least_squares(rate, walk, slope):
    """Of S at all dates and one more, of a rate, and of slopes, with nights that determine part of S alone."""
    rng, n, k = np.random.default_rng(3), 5, 4
    dates, asked = np.array([2001.0, 2000.0, 2003.5, 2001.0, 2006.0]), 2002.2
    x, wanted = np.array([0.5, -1.0, 0.2, 1.5, -1.2]), 0.7
    roots = rng.normal(size=(n, 2 * k, 2 * k))
    roots[:, [k - 1, 2 * k - 1]] = 0
    if not slope:
        roots = roots[:, :k]
    information, scatter2 = roots @ roots.mT, rng.uniform(0.1, 1, (n, k))
    pull = np.einsum("nkl,nl->nk", information, rng.normal(size=information.shape[:2]))
    chain = Chain(information, pull, scatter2, dates, rate, walk, slope, x)
    times = np.unique([*dates, asked])

    def dense(date, x_there, used):
        # z: S without its rate at all times, the rate, B of every night, T
        size = k * (len(times) + 2 + n)
        place = {t: np.arange(k) + k * i for i, t in enumerate(times)}
        slopes = np.arange(k) + k * len(times)
        whole, right = np.zeros((size, size)), np.zeros(size)

        def row(time, number, b=None):
            out = np.zeros((2 * k, size))
            out[:k, place[time]] = np.eye(k)
            out[:k, slopes] = (time - dates.mean()) * np.eye(k) if rate else 0
            out[:k, -k:], out[k:, -k:] = number * np.eye(k), np.eye(k)
            if b is not None:
                out[:k, k * (len(times) + 1 + b) + np.arange(k)] = np.eye(k)
            return out if slope else out[:k]

        for i in used:
            seen = row(dates[i], x[i], i)
            whole += seen.T @ information[i] @ seen
            right += seen.T @ pull[i]
        for i in range(n):
            own = k * (len(times) + 1 + i) + np.arange(k)
            whole[own, own] += 1 / scatter2[i]
        whole[slopes, slopes] += 1 / (rate**2 or 1)
        own = np.arange(size - k, size)
        whole[own, own] += 1 / ((10 * slope) ** 2 or 1e-12)
        whole[place[times[0]], place[times[0]]] += 1e-6
        for early, late in pairwise(times):
            step = np.zeros((k, size))
            step[:, place[late]], step[:, place[early]] = np.eye(k), -np.eye(k)
            whole += step.T @ step / ((walk**2 or 1e-12) * (late - early))
        seen, covariance = row(date, x_there), np.linalg.inv(whole)
        return seen @ covariance @ right, seen @ covariance @ seen.T

    known = np.delete(np.arange(information.shape[1]), k - 1)  # nights say nothing of the last of S
    for found, expected in [
        (chain.at(asked, wanted), dense(asked, wanted, range(n))),
        *[(chain.others[i], dense(dates[i], x[i], [j for j in range(n) if j != i])) for i in range(n)],
    ]:
        assert_allclose(found[0][known], expected[0][known], atol=2e-4)
        assert_allclose(found[1][np.ix_(known, known)], expected[1][np.ix_(known, known)], atol=2e-4)
        assert found[1][k - 1, k - 1] > 1e4


def linear_nights(seed, n, *, scatter=0.02, rate=0.0, odd=None, unknown=2):
    """S in the mean of the time, its rate, dates, and nights that see it, two directions of it not at all."""
    rng, k = np.random.default_rng(seed), len(DEGREES)
    true, slope, dates = rng.normal(0, 2, k), rng.normal(0, rate, k), np.sort(rng.uniform(2014, 2020, n))
    nights = []
    for i in range(n):
        seen = true + slope * (dates[i] - 2017) + rng.normal(0, 0.5 if i == odd else scatter / DEGREES)
        turn = np.linalg.qr(rng.normal(size=(k, k)))[0]
        error = rng.uniform(0.005, 0.05, k)
        error[:unknown] = np.inf
        noise = np.where(np.isinf(error), rng.normal(0, 3, k), rng.normal(0, 1, k) * np.minimum(error, 1))
        nights.append((seen + turn @ noise, (turn / error**2) @ turn.T, np.zeros(k)))
    return true, slope, dates, nights


def squares(sets, date):
    """Squared error of S at a date, and its stated variance, summed; and how many sets have a drift."""
    sums = np.zeros(3)
    for true, slope, dates, nights in sets:
        chain, *_ = fitted(nights, dates, DEGREES)
        mean, covariance = chain.at(date)
        away = mean + nights[0][0] - true - slope * (date - 2017)
        sums += np.sum(away**2), np.trace(covariance), chain.rate > 0
    return sums


@pytest.mark.parametrize(
    ("words", "low", "high"),
    [
        ({"n": 12}, 0.4, 2.2),
        pytest.param({"n": 16, "rate": 0.05}, 0.4, 2.2, marks=pytest.mark.slow),
        pytest.param({"n": 12, "odd": 5}, 0.3, 2.2, marks=pytest.mark.slow),
    ],
    ids=["constant", "drift", "odd"],
)
def test_sizes_are_found(words, low, high):
    off, stated, drifts = squares([linear_nights(seed, **words) for seed in range(2)], 2019.0)
    assert low < off / stated < high
    assert drifts == (2 if "rate" in words else 0)


@pytest.mark.parametrize(
    ("words", "low", "high"),
    [
        pytest.param({"n": 20}, 0.8, 1.25, marks=pytest.mark.sets),
        pytest.param({"n": 40, "rate": 0.05}, 0.7, 1.25, marks=pytest.mark.sets),
        pytest.param({"n": 20, "odd": 5}, 0.6, 1.25, marks=pytest.mark.sets),
        pytest.param({"n": 2}, 0.6, 1.4, marks=pytest.mark.sets),
        pytest.param({"n": 3}, 0.6, 1.4, marks=pytest.mark.slow),
    ],
    ids=["constant", "drift", "odd", "two", "three"],
)
def test_a_camera_at_a_date_is_calibrated(words, low, high):
    off, stated, drifts = squares([linear_nights(100 + seed, **words) for seed in range(20)], 2019.0)
    assert low < off / stated < high
    assert drifts >= 19 if "rate" in words else drifts <= 1


# --- nights of stars ----------------------------------------------------------------------------------------------


def test_nights_make_one_camera(three, tmp_path):
    combined = ld.combine_nights(three, name="NIRC9")
    found, covariance = combined.static()
    off = (found - modes(static(1)))[:, 3:].ravel()
    error = np.sqrt(np.diag(covariance)).reshape(2, -1)[:, 3:].ravel()
    assert np.all(error < 0.05)
    assert 0.2 < np.mean((off / error) ** 2) < 3
    assert combined.odd == ()
    assert not combined.drifts
    # of a further night the scatter of nights is not known beforehand
    prior = combined.prior()
    assert_allclose(
        prior.static_sigma[:, 3:].ravel() ** 2, error**2 + np.array([combined.scatter[d - 1] for d in DEGREES[2:]]) ** 2
    )
    again = combined.write(tmp_path / "camera.asdf")
    read = ld.CombinedNights.read(again)
    assert_array_equal(read.static()[0], found)
    assert str(read) == str(combined)
    for other in (ld.Prior.from_file(again), ld.Camera.read(again)["1"]):
        assert_array_equal(other.static_sigma, prior.static_sigma)
        assert_array_equal(other.static_covariance, prior.static_covariance)
        assert other.shape == SHAPE
    assert ld.Camera.read(again).name == "NIRC9"
    assert ld.difference(again, static_prior(1)).agrees


def test_nights_without_a_date_are_named(three):
    """Not that no change with time is seen, for which nobody has looked."""
    nights = list(three)
    assert "is not looked for" not in str(ld.combine_nights(nights))
    table = three[-1].residuals.copy()
    table.remove_columns(["dx", "dy", "used", *({"epoch"} & set(table.colnames))])
    undated = ld.solve(ld.Matches.from_table(table, shape=three[-1].estimate.shapes, poses=three[-1].poses), degree=3)
    combined = str(ld.combine_nights([*nights[:-1], undated]))
    assert "Change with time is not looked for: solution 3 has no date." in combined
    assert "No change with time" not in combined


def static_prior(seed, factor=1.0):
    return ld.Prior(factor * modes(static(seed)), shape=SHAPE)


def test_what_a_night_was_solved_with_does_not_count(three):
    """A prior that is wrong by a fifth and taken as exact leaves as it is what the night says of the distortion."""
    table = night(5100, static(1) + curved(100, 0.02), n_stars=70, exposures=6, year=2014)
    matches = ld.Matches.from_table(table, shape=SHAPE)
    free, wrong = (ld.combine_nights([ld.solve(matches, prior=p)]) for p in (None, static_prior(1, 1.2)))
    error = np.sqrt(np.diag(free.static()[1])).reshape(2, -1)
    assert np.abs(wrong.static()[0] - free.static()[0])[error > 0].max() < 0.05 * error.max()
    assert "One night does not tell how far nights scatter" in str(free)


def bent_farther(seed, size):
    """A static distortion with plain Legendre terms of degrees 4 and 5 of a size [px], which no cubic has."""
    tensor = np.pad(static(seed), ((0, 0), (0, 2), (0, 2)))
    degree = np.add.outer(np.arange(6), np.arange(6))
    beyond = np.random.default_rng(40 + seed).normal(0, size, tensor.shape)
    return tensor + np.where((degree > 3) & (degree < 6), beyond, 0)


def misfit(seed, combined):
    """Mean squared error of a cubic static distortion in its stated errors, in all directions that are determined."""
    found, covariance = combined.static()
    rows = detector_modes.dynamic_basis(SHAPE, 10)
    off, sizes = rows @ (found - modes(static(seed))).ravel(), rows @ covariance @ rows.T
    variance, vectors = np.linalg.eigh(sizes)
    known = variance < 0.1**2
    assert known.sum() > 10
    return np.mean((off @ vectors[:, known]) ** 2 / variance[known])


@pytest.mark.parametrize("n", [1, pytest.param(20, marks=pytest.mark.slow)])
def test_nights_do_not_believe_that_a_cubic_is_exact(n):
    """With such terms of 0.01 px rolls and dithers would tell what they do not, if polynomials were believed exact.

    Mean squares are 1.6 and 5 then, of one night and of twenty, whose beliefs add up.
    """
    squares = []
    for seed in (1, 3):
        static = bent_farther(seed, 0.01)
        nights = [night(6000 + 50 * seed + i, static, turns=(0, 30, -30), sigma=0.01) for i in range(n)]
        solved = [ld.solve(ld.Matches.from_table(each, shape=SHAPE)) for each in nights]
        squares.append(misfit(seed, ld.combine_nights(solved)))
    assert 0.4 < np.mean(squares) < 1.25


@pytest.mark.slow
def test_nights_one_after_the_other_or_in_any_order_are_the_same(three):
    all_at_once = ld.combine_nights(three)
    later = ld.combine_nights([ld.combine_nights(three[:2]), three[2]])
    turned = ld.combine_nights([three[2], three[0], three[1]])
    for other in (later, turned):
        for one, two in zip(other.static(), all_at_once.static(), strict=True):
            assert_allclose(one, two, atol=1e-9)


@pytest.mark.slow
def test_nights_that_were_solved_together_speak_of_the_camera(three):
    """Their scatter is found inside, counts once, and is that of a further night; truth 0.05 px by order."""
    nights = Nights(4, nights=6, per=4, nightly=0.05, n_stars=90)
    joint = ld.solve(ld.Matches.from_table(nights.table, shape=SHAPE))
    combined = ld.combine_nights([joint])
    assert "from 24 exposures of 6 nights." in str(combined)
    assert "Nights scatter by" in str(combined)
    normalised = modes(np.ones((2, 4, 4)) / (1 + ORDERS))[0]
    for degree, found in enumerate(combined.scatter, 1):
        of = np.flatnonzero(np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3]) == degree)
        true = 0.05 * np.sqrt(np.mean(normalised[of] ** 2))
        assert 0.5 * true < found < 2 * true
    other = ld.Prior.from_solution(joint)
    own = combined.prior()
    known = np.isfinite(other.static_sigma[:, 3:]) & np.isfinite(own.static_sigma[:, 3:])
    assert known.mean() > 0.5
    ratio = own.static_sigma[:, 3:][known] / other.static_sigma[:, 3:][known]
    assert np.all((ratio > 0.6) & (ratio < 1.2))
    both = ld.combine_nights([joint, three[0]])  # one other does not tell how nights scatter
    assert_allclose(both.scatter, combined.scatter)


def test_the_command_prints_the_nights_of_one_solution(tmp_path, capsys):
    """One row is all that a solution is to a combination; which of its nights differs is in its own table."""
    nights = Nights(4, nights=4, per=3, odd=0.5, n_stars=60, degree=2)
    solution = ld.solve(ld.Matches.from_table(nights.table, shape=SHAPE), degree=2)
    solution.write(tmp_path / "joint.asdf")
    line = ["nights", str(tmp_path / "joint.asdf"), "--workers", "1", "--quiet", "--out", str(tmp_path / "camera.asdf")]
    assert main(line) == 0
    printed = capsys.readouterr().out
    assert "Solved together were 3 nights of " in printed
    rows = printed[printed.index("The nights that were solved together") :].splitlines()
    assert [row.split()[0] for row in rows[3:]] == solution.nights["name"].tolist()
    assert rows[3].endswith("  odd")  # three lists of the third night, alone
    assert sum(row.endswith("odd") for row in rows) == 1
    again = [line[0], str(tmp_path / "camera.asdf"), *line[2:-1], str(tmp_path / "again.asdf"), "--json"]
    assert main(again) == 0  # an earlier combination has no table of them
    assert "nights_solved_together" not in json.loads(capsys.readouterr().out)
    assert main([*line, "--overwrite", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["nights_solved_together"]
    assert [row["odd"] for row in figures] == [True, False, False, False]
    assert figures[0]["exposures"] == "n2e0, n2e1, n2e2"


@pytest.mark.slow
def test_an_odd_night_among_others_that_were_solved_with_it_is_left_out():
    nights = Nights(4, nights=6, per=4, nightly=0.02, odd=0.5, n_stars=90)
    table = nights.table
    joint, without = (
        ld.solve(ld.Matches.from_table(t, shape=SHAPE)) for t in (table, table[table["block"] != nights.odd])
    )
    combined, expected = (ld.combine_nights([each]) for each in (joint, without))
    (odd,) = combined.odd
    assert odd.endswith(" of solution 1")
    assert "Odd nights, left out: " in str(combined)
    assert "from 20 exposures of 5 nights." in str(combined)
    assert combined.dates[0] == pytest.approx(np.mean(table["epoch"][table["block"] != nights.odd]), abs=0.05)
    away = np.abs(combined.static()[0] - expected.static()[0])[:, 3:]
    error = np.sqrt(np.diag(expected.static()[1])).reshape(2, -1)[:, 3:]
    assert np.all(away < 0.3 * error)
    assert_allclose(combined.scatter, expected.scatter, rtol=0.5, atol=1e-3)
    left_out = ld.solve(ld.Matches.from_table(table[table["block"] == nights.odd], shape=SHAPE))
    assert ld.difference(combined, left_out).shared == ()  # it is not in the map, and may be told from it, or added
    assert len(ld.combine_nights([combined, left_out]).nights) == 2


@pytest.mark.slow
def test_of_two_that_contradict_one_another_neither_is_odd(three):
    other = solved(4242, static(1) + curved(5, 0.7))
    two = ld.combine_nights([three[0], other])
    assert two.odd == ()
    many = ld.combine_nights([*three, other])
    assert many.odd == ("solution 4",)


def test_an_odd_night_is_named_and_counts_less():
    solutions = campaign(2, 5, odd=3)
    combined = ld.combine_nights(solutions)
    assert combined.odd == ("solution 4",)
    without = ld.combine_nights([each for i, each in enumerate(solutions) if i != 3])
    true = modes(static(2))
    errors = [np.sqrt(np.mean((each.static()[0] - true) ** 2)) for each in (combined, without)]
    assert errors[0] < 1.5 * errors[1] + 0.002
    assert "Odd nights, which count less: solution 4." in str(combined)


@pytest.mark.slow
def test_what_nights_of_one_orientation_do_not_determine_hides_no_odd_night(tmp_path):
    """Some combinations of modes are unknown, to the coefficients of all of them: the others are known well."""
    nights = [solved(600 + i, static(3) + curved(650 + i, 0.02), turns=(0,), year=2014 + i) for i in range(4)]
    combined = ld.combine_nights(nights[:3])
    assert np.sqrt(np.diag(combined.static()[1])).max() > 0.1
    assert "4 combinations are not determined, which is in the errors of all of their coefficients" in str(combined)
    away = combined.table["departure"].value
    assert away.max() < 0.1  # not of the unknown ones
    assert ld.difference(combined, nights[3]).agrees
    odd = solved(699, static(3) + curved(698, 0.5), turns=(0,), year=2018)
    for camera in (combined, combined.write(tmp_path / "camera.asdf")):
        found = ld.difference(camera, odd)
        assert found.p < 1e-4
        assert not found.agrees
    static_, covariance = combined.static()
    further = combined.static(further_night=True)
    assert_array_equal(further[0], static_)
    assert (np.diag(further[1]) >= np.diag(covariance)).all()
    assert np.trace(further[1]) > np.trace(covariance)


def test_a_camera_makes_the_next_night_absolute(three):
    """Exposures of one orientation alone leave shears and more unknown; the camera of the nights before knows them."""
    table = night(77, static(1) + curved(78, 0.02), turns=(0,), n_stars=70, exposures=6)
    matches = ld.Matches.from_table(table, shape=SHAPE)
    alone = ld.solve(matches)
    known = ld.solve(matches, prior=ld.combine_nights(three).prior())
    assert alone.gauge.unknown
    assert not known.gauge.unknown
    assert np.nanmedian(known.stars["x_err_abs"].value) < 0.05


def further_night(seed, turns):
    """Offsets from the truth (n, 2), after a similarity, and stated absolute errors, by what is known of the camera.

    The camera is that of four nights of one orientation, with its covariance or with the widths alone; none: nothing.
    """
    nights = [
        solved(600 + 50 * seed + i, static(seed) + curved(650 + 50 * seed + i, 0.02), turns=(0,), year=2014 + i)
        for i in range(4)
    ]
    prior = ld.combine_nights(nights).prior()
    own = static(seed) + curved(77 + seed, 0.02)
    table = night(9000 + seed, own, turns=turns, n_stars=70, exposures=4)
    sky = np.random.default_rng(9000 + seed).uniform(-150, SIZE + 150, (70, 2))  # its first numbers
    found = {}
    for name, known in (("none", None), ("widths", replace(prior, static_covariance=None)), ("covariance", prior)):
        solution = ld.solve(ld.Matches.from_table(table, shape=SHAPE), prior=known)
        stars = solution.stars
        found_at = np.column_stack([stars["x"].value, stars["y"].value])
        placed, true = (a @ [1, 1j] for a in (found_at, sky[np.asarray(stars["star"])]))
        design = np.stack([np.ones_like(placed), placed], axis=1)
        off = design @ np.linalg.lstsq(design, true, rcond=None)[0] - true
        stated = np.column_stack([stars["x_err_abs"].value, stars["y_err_abs"].value])
        found[name] = np.column_stack([off.real, off.imag]), stated, solution
    return found


@pytest.mark.filterwarnings("ignore:absolute positions are not known")
def test_nights_of_one_orientation_do_not_bend_the_next():
    """What they do not tell, shear and z^2, stays unknown: the plane is not drawn to what is believed of it."""
    found = further_night(0, (0,))
    rms = {name: np.sqrt(np.mean(off**2)) for name, (off, _, _) in found.items()}
    for name in ("widths", "covariance"):
        assert rms[name] < 1.3 * rms["none"]
    solution = found["covariance"][2]
    assert [each.name for each in solution.gauge.unknown] == ["shear", "shear", "z^2", "i z^2"]
    (check,) = (each for each in solution.checks if each.name == "prior")
    assert check.state == "pass"  # the other twelve combinations are known, and tested


def rolled_after(seeds):
    """Squared offsets with nothing known, widths and covariances, and the variances stated, of rolled nights."""
    sums = np.zeros((2, 3))
    for seed in seeds:
        for k, (off, stated, _) in enumerate(further_night(seed, (0, 30)).values()):
            sums[:, k] += np.mean(off**2), np.mean(stated**2)
    return sums


def test_what_nights_of_one_orientation_know_helps_a_rolled_one():
    """Although each of its coefficients is unknown by itself: their widths tell nothing."""
    off, stated = rolled_after([1])
    assert off[2] < 0.8 * off[0]
    assert off[2] < 0.8 * off[1]
    assert 0.3 < off[2] / stated[2] < 3


@pytest.mark.parametrize(
    ("n_sets", "low", "high"),
    [pytest.param(5, 0.4, 1.7, marks=pytest.mark.slow), pytest.param(20, 0.6, 1.3, marks=pytest.mark.sets)],
)
def test_its_errors_are_calibrated(n_sets, low, high):
    off, stated = rolled_after(range(n_sets))
    assert off[2] < 0.75 * off[0]
    assert low < off[2] / stated[2] < high


@pytest.mark.slow
def test_the_scatter_of_exposures_is_found_and_stated_for_one_alone(tmp_path):
    """Exposures scatter by as much, degree by degree, as the fields that were drawn."""
    drawn = np.array([modes(field(np.random.default_rng(seed), 0.05)) for seed in range(500)])
    combined = ld.combine_nights(campaign(3, 3, single=0.05, exposures=9))
    of_degree = [np.sqrt(np.mean(drawn[:, :, each] ** 2)) for each in (slice(3, 6), slice(6, 10))]
    assert_allclose(combined.exposure_scatter[1:], of_degree, rtol=0.3)  # chance of a size: an eighth
    assert "Exposures scatter about their night by " in str(combined)
    usual, alone = combined.prior(), combined.prior(one_exposure=True)
    assert usual.sigma is None
    assert_array_equal(alone.static_sigma, usual.static_sigma)
    assert_array_equal(alone.mean, usual.mean)
    assert_array_equal(alone.sigma[:, 1:3], combined.exposure_scatter[0])
    assert_array_equal(alone.sigma[:, 3], combined.exposure_scatter[1])  # x^2 or xy: of degree 2 both
    of_map = ld.combine_nights([static_prior(1)])
    assert not of_map.exposure_scatter.any()
    assert of_map.prior(one_exposure=True).sigma is None


def test_nights_that_do_not_go_together_are_refused(three, tmp_path):
    with pytest.raises(
        InputError, match="solution 2 has an exposure that solution 1 has too: give every exposure once"
    ):
        ld.combine_nights([three[0], three[0]])
    table = three[0].residuals["exposure", "star", "x", "y", "x_err", "y_err"]
    part = ld.Matches.from_table(table[np.asarray(table["star"]).astype(int) % 4 > 0], shape=SHAPE)
    with pytest.raises(InputError, match="solution 2 has an exposure that solution 1 has too"):
        ld.combine_nights([three[0], ld.solve(part)])  # other stars of it, matched by themselves
    bent = static(1) * (ORDERS < 3)
    lower = ld.solve(ld.Matches.from_table(night(5, bent, n_stars=60, exposures=4), shape=SHAPE), degree=2)
    with pytest.raises(InputError, match=r"several degrees, 2 \(solution 2\), 3 \(solution 1\): solve all with one"):
        ld.combine_nights([three[0], lower])
    other = ld.solve(ld.Matches.from_table(night(6, static(1), n_stars=60, exposures=4), shape=(SIZE, SIZE + 8)))
    with pytest.raises(InputError, match="detectors of several shapes"):
        ld.combine_nights([three[0], other])
    alone, first = tmp_path / "alone", three[0].names[0]
    rows = three[0].residuals["exposure", "star", "x", "y", "x_err", "y_err"]
    matches = ld.Matches.from_table(rows[np.asarray(rows["exposure"]) == first], shape=SHAPE)
    known = three[0].stars["star", "x", "y", "x_err", "y_err"]
    ld.solve(matches, prior=static_prior(1), reference=known).write(alone)
    with pytest.raises(InputError, match=rf"alone has one exposure, {first}, which alone .*: bring it into a night of"):
        ld.combine_nights([*three[1:], alone])
    with pytest.raises(InputError, match="no nights: give solutions"):
        ld.combine_nights([])
    with pytest.raises(InputError, match="earlier combinations, got int"):
        ld.combine_nights([3])
    with pytest.raises(InputError, match=r"prior.asdf holds no nights \(no entry 'legdistort_nights'\)"):
        ld.CombinedNights.read(static_prior(1).write(tmp_path / "prior.asdf"))


def test_maps_count_as_nights_that_state_all(three, tmp_path):
    """With their widths: exact ones differ by the scatter alone, what has an infinite width says nothing."""
    rng, degrees = np.random.default_rng(5), np.repeat(range(4), range(1, 5))
    shears = np.zeros((6, 2, 10))
    shears[:, 0, 1] = rng.normal(0, 0.1, 6)
    shears[:, 1, 2] = -shears[:, 0, 1]
    maps = [ld.Prior(modes(static(1) + curved(50 + i, 0.03)) + shears[i], shape=SHAPE) for i in range(6)]
    found = ld.combine_nights(maps)
    assert "from 6 exposures of 6 nights" in str(found)
    assert not found.odd
    each = np.array([one.mean for one in maps])
    assert_allclose(found.static()[0], each.mean(axis=0), atol=1e-4)
    for degree in (2, 3):
        scatter = np.sqrt(np.var(each[:, :, degrees == degree], axis=0, ddof=1).mean())
        assert_allclose(found.scatter[degree - 1], scatter, rtol=0.02)
    # one that is known badly in a mode leaves it to the others, one that states nothing of it too
    for width in (5.0, np.inf):
        widths = np.full((2, 10), 1e-3)
        widths[1, 7] = width
        off = each[0].copy()
        off[1, 7] += rng.normal(0, 3)
        weighed = ld.combine_nights([ld.Prior(off, static_sigma=widths, shape=SHAPE), *maps[1:]]).static()[0]
        assert_allclose(weighed[1, 7], each[1:, 1, 7].mean(), atol=1e-4)
        assert_allclose(weighed[1, 6], each[:, 1, 6].mean(), atol=1e-4)
    found.write(tmp_path / "camera.asdf")
    again = ld.CombinedNights.read(tmp_path / "camera.asdf")
    assert_array_equal(again.static()[0], found.static()[0])
    assert again.table["p"].min() > 0.01
    assert found.plot().axes[-1].get_xlabel() == "night"  # without dates
    maps[0].write(tmp_path / "map.asdf")
    mixed = ld.combine_nights([tmp_path / "map.asdf", three[0]])
    assert sorted(night.n_stars > 0 for night in mixed.nights) == [False, True]
    assert {night.name for night in mixed.nights} == {str(tmp_path / "map.asdf"), "solution 2"}


def test_maps_that_do_not_scatter_are_named():
    """SCAMP fits one distortion to all exposures: that these are the same says nothing of how wrong they are."""
    one = ld.Prior(modes(static(1)), shape=SHAPE)
    shear = np.zeros((2, 10))
    shear[0, 1], shear[1, 2] = 0.1, -0.1
    with pytest.warns(AssumptionWarning, match=r"the same to 0.001 px at degree 2, 3: .* state a static_sigma \(--st"):
        found = ld.combine_nights([one, ld.Prior(one.mean + shear, shape=SHAPE)])
    assert_allclose(found.scatter[0], 0.1 / np.sqrt(2), rtol=0.01)  # one difference of two shears, one of which is none
    stated = ld.Prior(one.mean, static_sigma=0.05, shape=SHAPE)
    assert np.all(ld.combine_nights([stated, stated]).scatter < 0.01)
    assert not ld.combine_nights(one).scatter.any()


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: ld.Prior(None, static_sigma=2.0), "map 1 states no distortion: leave it out"),
        (lambda: ld.Prior(None, sigma="evidence"), "map 1 states no distortion"),
        (lambda: ld.Prior([[0.1], [0.0]], shape=SHAPE), "map 1 states no distortion"),
        (lambda: ld.Prior(modes(static(1))), "map 1 does not state the shape of its detector: give it shape="),
    ],
)
def test_maps_that_say_nothing_are_refused(made, words):
    with pytest.raises(InputError, match=words):
        ld.combine_nights([made(), ld.Prior(modes(static(1)), shape=SHAPE)])


@pytest.mark.slow
def test_the_command(three, tmp_path, capsys):
    for i, each in enumerate(three):
        each.write(tmp_path / f"night{i}.asdf")
    camera, picture = tmp_path / "camera.asdf", tmp_path / "all.png"
    files = [str(tmp_path / f"night{i}.asdf") for i in range(3)]
    assert main(["nights", *files[:2], "--out", str(camera), "--workers", "1", "--quiet"]) == 0
    capsys.readouterr()
    line = ["nights", str(camera), files[2], "--out", str(tmp_path / "more.asdf"), "--plot", str(picture)]
    assert main([*line, "--json", "--quiet", "--workers", "1"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert len(figures["nights"]) == 3
    assert len(figures["modes"]) == 18
    assert figures["odd"] == []
    assert picture.stat().st_size > 10_000
    found = ld.CombinedNights.read(tmp_path / "more.asdf")
    assert_allclose(found.static()[0], ld.combine_nights(three).static()[0], atol=1e-9)


@pytest.mark.parametrize(
    ("words", "n_sets"),
    [
        pytest.param({"n": 6}, 10, marks=pytest.mark.sets),
        pytest.param({"n": 6, "turns": (0, 40)}, 10, marks=pytest.mark.sets),
        pytest.param({"n": 8, "rate": 0.05}, 10, marks=pytest.mark.sets),
        pytest.param({"n": 6, "odd": 2}, 10, marks=pytest.mark.sets),
        pytest.param({"n": 6, "odd": 2}, 4, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_campaign_is_calibrated(words, n_sets):
    """Squared errors of coefficients over their variance, at the last date, of what is determined."""
    off = stated = named = 0
    for seed in range(20, 20 + n_sets):
        combined = ld.combine_nights(campaign(seed, **words))
        end = (words["n"] - 1) / 4
        true = modes(static(seed) + curved(7000 + seed, words.get("rate", 0.0)) * end)
        found, covariance = combined.static()
        variance = np.diag(covariance).reshape(2, -1)
        known = variance < 0.3**2
        off, stated = off + np.sum((found - true)[known] ** 2), stated + variance[known].sum()
        named += combined.odd == ((f"solution {words['odd'] + 1}",) if "odd" in words else ())
    few = np.sqrt(10 / n_sets) - 1  # limits are those of ten
    assert (0.4 if "odd" in words else 0.7) - 0.2 * few < off / stated < 1.4 + 0.4 * few
    assert named >= n_sets - 1
