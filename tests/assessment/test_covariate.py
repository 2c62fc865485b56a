"""The static distortion of a camera that depends on a number of the exposures; nights and truth by numpy alone."""

import json
import re

import asdf
import header_layouts
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from night_sets import SIZE, field
from numpy.testing import assert_allclose, assert_array_equal
from rolled_night import bend, modes, night

import legdistort as ld
from legdistort.assessment.nights.combined_nights import fitted
from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, InputError

SHAPE, KEY = (SIZE, SIZE), "ROTPPOSN"
ORDERS = np.add.outer(np.arange(4), np.arange(4))
#: Degree of the coefficients that are no similarity, as nights state them: two shears, then x and y.
DEGREES = np.array([1, 1, *[2] * 3, *[3] * 4, *[2] * 3, *[3] * 4])
CENTRE, RANGE, SETS = 100.0, 60.0, 60


def curved(seed, size):
    """A map of degrees 2 and 3, so that it has no part of a similarity."""
    return field(np.random.default_rng(seed), size) * (ORDERS > 1)


def rms(map_):
    """Per axis over the detector, of normalised coefficients."""
    return np.sqrt(np.sum(map_**2) / 8)


class Campaign:
    """Solutions of nights half a year apart; 0.05 px rms over the range of the number, or as much as is said.

    Night n has its number in the mean within half a range of the centre, or of the part `between` of that, exposures
    differ from it within the part `within`.
    """

    def __init__(self, seed, n, *, size=0.05, between=1.0, within=0.15, exposures=6, nightly=0.02):
        rng = np.random.default_rng(40_000 + seed)
        slope = curved(3000 + seed, 1.0)
        self.slope = slope * size / RANGE / rms(modes(slope))
        self.static, self.solutions = curved(9000 + seed, 1.5), []
        for i in range(n):
            x = RANGE / 2 * (between * rng.uniform(-1, 1) + within * rng.uniform(-1, 1, exposures))
            own = self.static + curved(100 * seed + i, nightly)
            table = night(5000 + 100 * seed + i, own, n_stars=70, year=2014 + i / 2, slope=self.slope, numbers=x)
            table[KEY] += CENTRE
            self.solutions.append(ld.solve(ld.Matches.from_table(table, shape=SHAPE)))

    def at(self, value):
        return modes(self.static + self.slope * (value - CENTRE))


@pytest.fixture(scope="module")
def four():
    return Campaign(4, 4, exposures=5)


@pytest.fixture(scope="module")
def combined(four):
    return ld.combine_nights(four.solutions, covariate=KEY)


def off_and_stated(pair, true):
    """Summed squared errors of coefficients that are determined, and their variance."""
    found, covariance = pair
    variance = np.diag(covariance).reshape(2, -1)
    known = variance < 0.3**2
    return np.array([np.sum((found - true)[known] ** 2), variance[known].sum()])


# --- what is found ------------------------------------------------------------------------------------------------


def test_a_dependence_is_found_and_the_map_is_that_of_a_value(four, combined):
    assert combined.evidence > 10
    assert combined.odd == ()
    for value in (75.0, None, 125.0):
        at = float(np.mean([each for s in four.solutions for each in per_exposure(s)])) if value is None else value
        off, stated = off_and_stated(combined.static(value=value), four.at(at))
        assert 0.2 < off / stated < 3
    away = combined.static(value=125.0)[0] - combined.static(value=75.0)[0]
    assert_allclose(away, 50 * combined.slopes[0], atol=1e-9)
    assert rms(away - 50 * modes(four.slope)) < 0.4 * rms(away)
    (line,) = (line for line in str(combined).splitlines() if KEY in line)
    size, error = map(float, re.search(rf"depends on {KEY}, by (\S+) \+- (\S+) px rms a unit", line).groups())
    assert abs(size - rms(modes(four.slope))) < 4 * error
    assert error < size / 4
    found = combined.to_dict(value=75.0)
    assert found["slope_px"] == pytest.approx(size, rel=0.01)
    assert found["evidence"] > 10
    assert found["value"] == 75.0
    assert {"slope", "slope_error"} <= set(combined.modes().colnames)
    # a night alone, brought to the mean value, is where all are
    mean = combined.static()[0]
    for n in range(4):
        value, error = combined.seen_by(n)
        assert np.all(np.abs(value - mean)[error > 0] < 5 * error[error > 0])


def per_exposure(solution):
    table = solution.residuals
    return [table[KEY][np.asarray(table["exposure"]) == name][0] for name in solution.names]


def test_what_is_made_of_it_is_of_that_value(combined, tmp_path):
    static, covariance = combined.static(value=120.0, further_night=True)
    assert_array_equal(combined.prior(value=120.0).mean, static)
    assert_array_equal(combined.camera(value=120.0)["1"].static_covariance, covariance)
    path = combined.write(tmp_path / "camera.asdf", value=120.0)
    assert_array_equal(ld.Prior.from_file(path).mean, static)
    again = ld.CombinedNights.read(path)
    assert str(again) == str(combined)
    assert again.evidence == combined.evidence
    assert_array_equal(again.static(value=80.0)[0], combined.static(value=80.0)[0])


@pytest.mark.slow
def test_a_night_is_compared_at_its_own_number(combined, tmp_path):
    """Far from the mean, where the map is another by more than errors; without the number it is not compared."""
    campaign = Campaign(4, 0)
    x = np.full(6, 38.0)
    table = night(77, campaign.static + curved(78, 0.02), n_stars=70, slope=campaign.slope, numbers=x, year=2017.0)
    table[KEY] += CENTRE
    new = ld.solve(ld.Matches.from_table(table, shape=SHAPE))
    for camera in (combined, combined.write(tmp_path / "camera.asdf")):
        assert ld.difference(camera, new).p > 0.003
        assert ld.difference(new, camera).p > 0.003
    assert ld.difference(combined.prior(), new).p < 0.003
    table.remove_column(KEY)
    with pytest.raises(InputError, match=f"has no number {KEY} of its exposures"):
        ld.difference(combined, ld.solve(ld.Matches.from_table(table, shape=SHAPE)))


@pytest.mark.slow
def test_nights_come_one_after_the_other(four, combined):
    assert combined.plot().axes
    later = ld.combine_nights([ld.combine_nights(four.solutions[:2], covariate=KEY), *four.solutions[2:]])
    assert later.covariate == KEY
    for one, two in zip(later.static(value=90.0), combined.static(value=90.0), strict=True):
        assert_allclose(one, two, atol=1e-9)


def test_files_of_nights_without_what_came_later_are_read(four, tmp_path):
    """As before there was a covariate."""
    plain = ld.combine_nights(four.solutions[:1])
    with asdf.open(plain.write(tmp_path / "new.asdf")) as file:
        tree = dict(file.tree) | {"legdistort_nights": dict(file.tree["legdistort_nights"])}
        own = tree["legdistort_nights"]
        own["nights"] = [dict(each) for each in own["nights"]]
        for entry in (own, *own["nights"]):
            for name in ("covariate", "slope", "evidence", "value", "spread", "lowest", "highest"):
                entry.pop(name, None)
        asdf.AsdfFile(tree).write_to(tmp_path / "old.asdf")
    old = ld.CombinedNights.read(tmp_path / "old.asdf")
    assert str(old) == str(plain)
    assert_array_equal(old.static()[0], plain.static()[0])


def test_without_a_dependence_all_is_as_without_a_covariate():
    nights = Campaign(5, 2, size=0.0, within=0.5).solutions
    plain, asked = ld.combine_nights(nights), ld.combine_nights(nights, covariate=KEY)
    assert asked.slope == 0
    assert not asked.slopes[0].any()
    assert f"No dependence on {KEY} is seen (twice ln L is larger by " in str(asked)
    for one, two in zip(plain.static(), asked.static(value=3.0), strict=True):
        assert_allclose(one, two, rtol=1e-9, atol=1e-12)
    assert_allclose(asked.scatter, plain.scatter)
    assert_allclose(asked.table["p"], plain.table["p"])


# --- what is refused, and said ------------------------------------------------------------------------------------


def changed(solution, **columns):
    """A solution of the same positions with other columns."""
    table = solution.residuals["exposure", "star", "x", "y", "x_err", "y_err", KEY]
    for name, values in columns.items():
        table[name] = values(table) if callable(values) else values
    return ld.solve(ld.Matches.from_table(table, shape=SHAPE))


def test_nights_without_the_number_are_refused(four, combined, tmp_path):
    one, two = four.solutions[:2]
    with pytest.raises(InputError, match=r"solution 1 has no number ROTPOS of its exposures: take it from the headers"):
        ld.combine_nights([one, two], covariate="ROTPOS")
    first = one.names[0]
    lost = changed(one, **{KEY: lambda t: np.where(np.asarray(t["exposure"]) == first, np.nan, t[KEY])})
    with pytest.raises(InputError, match=rf"solution 1: {KEY} is not known of exposure {first}: give it, or leave"):
        ld.combine_nights([lost, two], covariate=KEY)
    with pytest.raises(
        InputError, match=r"solution 1: x is not one number in exposure e0: a covariate is one of every"
    ):
        ld.combine_nights([two], covariate="x")
    with pytest.raises(
        InputError, match=r"solution 1: column 'FILTER' cannot be read as numbers .*a covariate is a numb"
    ):
        ld.combine_nights([changed(one, FILTER="Ks")], covariate="FILTER")
    same = [changed(each, **{KEY: 40.0}) for each in (one, two)]
    with pytest.raises(InputError, match=rf"{KEY} is 40 in all exposures, so that nothing can depend on it: leave the"):
        ld.combine_nights(same, covariate=KEY)
    known = ld.Prior(four.at(CENTRE), shape=SHAPE)
    with pytest.raises(InputError, match=rf"map 1 is a map, which states no {KEY}: leave it out, or the covariate"):
        ld.combine_nights([known, one], covariate=KEY)
    with pytest.raises(InputError, match="covariate must be the name of a column or keyword, got 3"):
        ld.combine_nights([one], covariate=3)
    plain = ld.combine_nights([one])
    with pytest.raises(InputError, match=r"value 3.0 is that of a covariate, without which these nights were combined"):
        plain.static(value=3.0)
    with pytest.raises(
        InputError, match=rf"was combined with no covariate, not {KEY}: give the solutions of its nights"
    ):
        ld.combine_nights([plain, two], covariate=KEY)
    with pytest.raises(
        InputError, match=rf"was combined with covariate {KEY}, not PA: give the solutions of its nights"
    ):
        ld.combine_nights([combined], covariate="PA")
    with pytest.raises(InputError, match=rf"value must be a number, what {KEY} is, got nan"):
        combined.static(value=np.nan)


def test_an_angle_that_wraps_is_said(four):
    one, two = four.solutions[:2]
    wrapped = [changed(one, **{KEY: 350.0}), changed(two, **{KEY: 10.0})]
    with pytest.warns(AssumptionWarning, match=rf"{KEY} runs from 10 to 350: if it is an angle that wraps at 360 degr"):
        ld.combine_nights(wrapped, covariate=KEY)


def test_one_night_tells_by_its_exposures_alone():
    one = Campaign(6, 1, size=0.15, within=1.0, between=0.0, exposures=8)
    found = ld.combine_nights(one.solutions, covariate=KEY)
    assert found.evidence > 6
    off, stated = off_and_stated(found.slopes, modes(one.slope))
    assert 0.2 < off / stated < 4
    assert "One night does not tell how far nights scatter" in str(found)


# --- from headers to the table of matches -------------------------------------------------------------------------


def test_exposures_of_several_detectors_have_their_number():
    night = header_layouts.Night(1, n=3, n_stars=250)
    for image in night.exposures:
        image.header[KEY] = 10.0 * int(image.exposure[1:])
    table = ld.match(night.table, exposures=night.exposures, keywords=[KEY], min_exposures=2).table
    assert {(name, number) for name, number in table["exposure", KEY]} == {("e0", 0.0), ("e1", 10.0), ("e2", 20.0)}


def test_keywords_of_headers_become_columns(caplog):
    sim = ld.simulate_matches(n_stars=20, n_exposures=4, dither=50.0, seed=1).matches
    table = sim.table.copy()
    table.remove_column("star")
    frames = []
    for i, name in enumerate(sim.names):
        header = fits.Header({KEY: 3.5 * i, "FILTER": "Ks"})
        header["HIERARCH ESO ADA POSANG"] = f"1{i}.5"
        if i:
            header["ROTMODE"] = 2
        frames.append(ld.Exposure(name, np.zeros((2048, 2048), dtype=np.float32), header=header))
    with caplog.at_level("WARNING"):
        found = ld.match(table, exposures=frames, keywords=[KEY, "ESO ADA POSANG", "ROTMODE"]).table
    number = np.array([int(name[-2:]) for name in found["exposure"]])
    assert_array_equal(found[KEY], 3.5 * number)
    assert_array_equal(found["ESO ADA POSANG"], number + 10.5)
    assert_array_equal(found["ROTMODE"], np.where(number, 2.0, np.nan))
    assert "ROTMODE is no number in the headers of exp00" in caplog.text
    for keyword, words in (
        ("FILTER", r"no header states FILTER as a number: correct keywords= \(--keywords\)"),
        ("ROTPOSN", rf"no header states ROTPOSN as a number: correct .*; exp00 has {KEY}"),
    ):
        with pytest.raises(InputError, match=words):
            ld.match(table, exposures=frames, keywords=keyword)
    with pytest.raises(InputError, match=rf"keywords: {KEY} is to be read from headers, and there are no frames"):
        ld.match(table, shape=(2048, 2048), keywords=[KEY])
    with pytest.raises(InputError, match=r"keywords must be names of header keywords, got \[3\]"):
        ld.match(table, shape=(2048, 2048), keywords=[3])
    table[KEY] = 7.0  # a column of the star lists stays as it is
    assert set(ld.match(table, shape=(2048, 2048), keywords=KEY).table[KEY]) == {7.0}


@pytest.mark.slow
def test_the_command(four, tmp_path, capsys):
    paths = [str(each.write(tmp_path / f"night{i}.asdf")) for i, each in enumerate(four.solutions)]
    camera = tmp_path / "camera.asdf"
    line = ["nights", *paths, "--out", str(camera), "--covariate", KEY, "--value", "75", "--workers", "1", "--quiet"]
    assert main(line) == 0
    told = capsys.readouterr().out
    assert f"It depends on {KEY}, by " in told
    assert f"The camera in {camera} is that of {KEY} 75." in told
    expected = ld.combine_nights(paths, covariate=KEY)
    assert_allclose(ld.Prior.from_file(camera).mean, expected.static(value=75.0)[0], atol=1e-9)
    assert main([*line, "--json", "--overwrite"]) == 0
    assert json.loads(capsys.readouterr().out)["covariate"] == KEY


@pytest.mark.slow
def test_lists_are_corrected_by_the_camera_of_a_number(four, combined, tmp_path, capsys):
    """What `correct` takes off follows the number as the truth does."""
    camera = combined.write(tmp_path / "camera.asdf", value=75.0)
    list_, out = tmp_path / "list.ecsv", tmp_path / "out.ecsv"
    xy = np.random.default_rng(0).uniform(0, SIZE - 1, (50, 2))
    Table({"x": xy[:, 0], "y": xy[:, 1], "x_err": np.full(50, 0.01), "y_err": np.full(50, 0.01)}).write(list_)
    taken = {}
    for number in (None, 75.0, 130.0):
        line = ["correct", str(camera), str(list_), "--out", str(out), "--overwrite"]
        assert main(line + ([] if number is None else ["--value", str(number)])) == 0
        assert (f"that of {KEY} {number or 0:g}" in capsys.readouterr().out) == (number is not None)
        table = QTable.read(out)
        taken[number] = np.column_stack([table["x"].value, table["y"].value])
    assert_allclose(taken[None], taken[75.0], atol=1e-9)
    true = -(130 - 75) * bend(*xy.T, four.slope)
    assert np.std(taken[130.0] - taken[75.0] - true) < 0.6 * np.std(true)  # nights scatter by half of it
    alone = four.solutions[0].write(tmp_path / "one.asdf")
    assert main(["correct", str(alone), str(list_), "--out", str(out), "--overwrite", "--date", "2020"]) == 1
    assert "--date is for the lists of a camera" in capsys.readouterr().err
    plain = combined.camera().write(tmp_path / "plain.asdf")
    assert main(["correct", str(plain), str(list_), "--out", str(out), "--overwrite", "--date", "2020"]) == 1
    assert "--date is for a camera of several nights" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_takes_it_from_its_frames(tmp_path):
    frames = ld.simulate_exposures(small=True, n_exposures=4, seed=1).write(tmp_path / "night")
    for i, path in enumerate(frames):
        fits.setval(path, KEY, value=10.0 * i)
    with pytest.raises(InputError, match="no header states ROT as a number"):
        ld.run(frames, out=tmp_path / "out", mosaic=False, matching={"keywords": ["ROT"]})
    ld.run(frames, out=tmp_path / "out", mosaic=False, psf="moffat", matching={"keywords": [KEY]})
    solution = ld.Solution.read(tmp_path / "out")
    assert sorted(per_exposure(solution)) == [0.0, 10.0, 20.0, 30.0]


# --- sets ---------------------------------------------------------------------------------------------------------


def linear_nights(seed, n, *, size=0.05, scatter=0.02, within=0.15, exposures=4, alone=False):
    """Static distortion, slopes by a unit of the number, numbers, and nights as `fitted` takes them.

    With `alone` there is a slope of one mode, and of no other.
    """
    rng, k = np.random.default_rng(seed), len(DEGREES)
    static, slope = rng.normal(0, 2, k), rng.normal(0, 1, k)
    slope *= (np.arange(k) == 5) if alone else 1.0
    slope *= size / 2 / np.sqrt(np.sum(slope**2) / 8)  # over numbers from -1 to 1
    nights, numbers = [], rng.uniform(-1, 1, n)
    for i in range(n):
        own = static + rng.normal(0, scatter / DEGREES)
        x = numbers[i] + within * rng.uniform(-1, 1, exposures)
        numbers[i] = x.mean()
        information, pull = np.zeros((2 * k, 2 * k)), np.zeros(2 * k)
        for each in x:
            error, turn = rng.uniform(0.005, 0.03, k), np.linalg.qr(rng.normal(size=(k, k)))[0]
            error[:2] = np.inf
            seen = own + slope * each + turn @ np.where(np.isinf(error), 0, rng.normal(0, 1, k) * np.minimum(error, 1))
            design = np.hstack([np.eye(k), (each - numbers[i]) * np.eye(k)])
            known = design.T @ (turn / error**2) @ turn.T
            information, pull = information + known @ design, pull + known @ (seen - static)
        nights.append((static, information, pull))
    return static, slope, numbers, nights


@pytest.mark.parametrize(
    ("words", "low", "high"),
    [
        pytest.param({"n": 12}, 0.9, 1.1, marks=pytest.mark.sets),
        pytest.param({"n": 12, "within": 0.0}, 0.9, 1.1, marks=pytest.mark.sets),
        pytest.param({"n": 6, "within": 1.0}, 0.9, 1.15, marks=pytest.mark.sets),
        pytest.param({"n": 12, "alone": True}, 0.9, 1.15, marks=pytest.mark.sets),
        pytest.param({"n": 12, "size": 0.0}, 0.9, 1.1, marks=pytest.mark.sets),
    ],
    ids=["both", "between nights", "within nights", "one mode", "none"],
)
def test_maps_at_a_value_are_calibrated(words, low, high):
    """Sets of nights as matrices: squared errors over their variance at two values, and what is found."""
    sums, found = np.zeros(2), 0
    for seed in range(SETS):
        static, slope, numbers, nights = linear_nights(seed, **words)
        chain, *_, evidence = fitted(nights, np.full(words["n"], np.nan), DEGREES, numbers=numbers)
        assert (evidence > 6) == (chain.slope > 0)
        for value in (-1, 1):
            mean, covariance = chain.at(0.0, value)
            away = mean[: len(static)] - slope * value  # nights count from the true map
            sums += np.sum(away**2), np.trace(covariance[: len(static), : len(static)])
        found += chain.slope > 0
    assert low < sums[0] / sums[1] < high
    print(words, sums[0] / sums[1], found)
    assert found == (SETS if words.get("size", 1) else 0)


@pytest.mark.sets
@pytest.mark.parametrize(
    ("words", "count"),
    [
        ({"n": 6}, 12),
        ({"n": 4, "within": 1.0, "between": 0.2}, 12),
        ({"n": 6, "size": 0.0}, 20),
        ({"n": 3, "size": 0.0, "within": 1.0}, 20),
        ({"n": 1, "size": 0.0, "within": 1.0}, 20),
    ],
    ids=str,
)
def test_campaigns_are_calibrated(words, count):
    """Of stars: found in all sets or in none, and squared errors over their variance at an end of the range."""
    sums, slopes, found = np.zeros(2), np.zeros(2), 0
    for seed in range(60, 60 + count):
        campaign = Campaign(seed, **words)
        combined = ld.combine_nights(campaign.solutions, covariate=KEY)
        sums += off_and_stated(combined.static(value=CENTRE + 24), campaign.at(CENTRE + 24))
        slopes += off_and_stated(combined.slopes, modes(campaign.slope))
        found += combined.slope > 0
    dependent = "size" not in words
    assert found == count if dependent else found <= 1  # by chance, at this evidence
    print(found, "of", count, end=" ")
    print(words, sums[0] / sums[1], slopes[0] / slopes[1] if dependent else None)
    assert words["n"] == 1 or 0.7 < sums[0] / sums[1] < 1.3  # one night does not know how far nights scatter
    if dependent:
        assert 0.7 < slopes[0] / slopes[1] < 1.25
