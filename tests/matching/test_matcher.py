"""Matching: synthetic fields of known truth, headers that lie, frames that do not belong, two real sets."""

import inspect
import warnings
from dataclasses import fields

import numpy as np
import pytest
from astropy.table import QTable, Table, vstack
from caller_warnings import warns_here
from star_fields import (
    CELLS,
    FLIPS,
    SHAPE,
    detections,
    exposure,
    grid_exposures,
    grid_field,
    header,
    make_field,
    recall_and_purity,
    rotation,
    six_poses,
)

from legdistort.exceptions import AssumptionWarning, InputError, MatchError
from legdistort.geometry import similarity
from legdistort.matching.exposure_groups import Group, interlink, link, unite
from legdistort.matching.matcher import match
from legdistort.matching.options import MatchOptions
from legdistort.matching.registration import Registration, register
from legdistort.matching.similarity_candidates import offset_candidates, triangle_candidates
from legdistort.matching.star_labels import label_stars
from legdistort.matching.star_lists import StarList, Warp
from legdistort.measurement.flags import Flag
from legdistort.simulation.observations import simulate_matches


def assert_good(table, matches, min_exposures=4, recall=0.95, purity=0.99):
    got = recall_and_purity(table, matches.table, min_exposures)
    assert got[0] > recall
    assert got[1] > purity
    pairs = list(zip(matches.table["exposure"], matches.table["star"], strict=True))
    assert len(set(pairs)) == len(pairs)


SAMPLE = [
    # cell, flips, headers
    ((40, 30, 300), FLIPS, False),
    ((40, 180, 300), None, False),
    ((100, 0.2, 300), None, False),
    ((100, 2, 20), FLIPS, False),
    ((100, 30, 300), FLIPS, True),
    pytest.param((1000, 2, 300), None, False, marks=pytest.mark.slow),
    pytest.param((1000, 180, 300), FLIPS, True, marks=pytest.mark.slow),
]


def assert_field(cell, *, seed, flips=None, headers=False):
    table = grid_field(cell, seed=seed, flips=flips)
    where = {"exposures": grid_exposures(cell, seed=seed, flips=flips)} if headers else {"shape": SHAPE}
    with warnings.catch_warnings():  # scales of these exposures differ by per cents, of which headers know nothing
        warnings.filterwarnings("ignore", ".*the header WCSs contradict the stars in their scale", AssumptionWarning)
        assert_good(table, match(table, **where))


@pytest.mark.parametrize(("cell", "flips", "headers"), SAMPLE, ids=str)
def test_field(cell, flips, headers):
    assert_field(cell, seed=6, flips=flips, headers=headers)


@pytest.mark.parametrize(
    "cell",
    [pytest.param(cell, marks=pytest.mark.sets if k else pytest.mark.slow) for k, cell in enumerate(CELLS)],
    ids=str,
)
def test_other_fields(cell):
    for seed in range(4):
        assert_field(cell, seed=seed)
    assert_field(cell, seed=0, flips=FLIPS)
    assert_field(cell, seed=1, flips=FLIPS, headers=True)


@pytest.mark.parametrize(("flips", "seed"), [(None, 6), (FLIPS, 11)], ids=str)
def test_stars_in_corners_where_few_pairs_tell_the_map(flips, seed):
    table = make_field(40, *six_poses(30, 300, seed), seed=seed, flips=flips, spurious=1.0 if flips else 0.2)
    assert_good(table, match(table, shape=SHAPE))


@pytest.mark.slow
def test_exposures_that_fit_no_single_one_fit_the_stars_of_all():
    table = make_field(20, *six_poses(30, 20, 6), seed=6, common=0.6, spurious=1.0, flips=FLIPS)
    names = [f"e{k:02d}" for k in range(6)]
    lists = [
        StarList(np.column_stack([t["x"], t["y"]]), np.full(len(t), 0.07), SHAPE, np.asarray(t["flux"]))
        for t in (table[table["exposure"] == name] for name in names)
    ]
    groups = link(lists, lambda i, j: None)
    assert len(groups) > 1
    (whole,) = unite(lists, groups, lambda i, j: None)
    assert sorted(whole.poses) == list(range(6))
    turned = similarity.compose(whole.poses[1], similarity.invert(whole.poses[0]))
    assert similarity.describe(turned)["parity"] == -1
    assert match(table, shape=SHAPE).names == tuple(names)


@pytest.mark.parametrize(("n", "angle", "seed"), [pytest.param(1000, 4, 2, marks=pytest.mark.slow), (200, 10, 3)])
def test_angles_at_which_a_plain_vote_holds_in_a_corner_only(n, angle, seed):
    table = make_field(n, *six_poses(angle, 200, seed), seed=seed + 50)
    assert_good(table, match(table, shape=SHAPE))


@pytest.mark.parametrize("n", [4, 6])
def test_what_is_left_out_of_few_dithers_says_what_would_keep_it(n, caplog):
    """40 stars are in all exposures, 12 in three of them, 8 in two, 5 in one."""
    caplog.set_level("INFO")
    rng, rows = np.random.default_rng(1), []
    stars = rng.uniform(100, 1900, (65, 2))
    for k in range(n):
        seen = stars[: (65, 60, 52, 40)[min(k, 3)]] + rng.uniform(-80, 80, 2)
        rows += [(f"e{k}", x, y, 0.02, 0.02) for x, y in seen + rng.normal(0, 0.02, seen.shape)]
    table = Table(rows=rows, names=["exposure", "x", "y", "x_err", "y_err"])
    match(table, shape=(2000, 2000))
    words = f"57 of {40 * n + 57} detections are of stars in fewer than 4 exposures (min_exposures), and left out"
    told = ": --min-exposures 2 keeps 52, --min-exposures 3 keeps 36 of them" if n == 4 else ""
    assert words + told in caplog.messages


def test_few_stars_half_of_them_missing_or_false():
    table = make_field(20, *six_poses(0.5, 100), seed=3, common=0.8, spurious=0.5)
    assert_good(table, match(table, shape=SHAPE), recall=0.9, purity=0.97)


@pytest.mark.slow
def test_without_fluxes():
    table = make_field(120, *six_poses(30, 300), seed=5)
    table.remove_column("flux")
    matches = match(table, shape=SHAPE)
    assert_good(table, matches)
    x = [np.mean(matches.table["x"][matches.table["star"] == s]).value for s in matches.stars]
    assert np.all(np.diff(x) >= 0)


@pytest.mark.slow
def test_stars_of_few_pointings_are_joined_where_pointings_are_repeated():
    """Eight lists of each of five pointings: the exposures nearest to one are those of its own pointing."""
    rng = np.random.default_rng(5)
    stars, flux = rng.uniform(-130, 1154, (300, 2)), 10 ** rng.uniform(2, 5, 300)
    pointings, tables, true = rng.uniform(-100, 100, (5, 2)), [], []
    for night in range(8):
        for k, pointing in enumerate(pointings):
            turn = np.radians(rng.normal(0, 0.3))
            xy = (stars - 512) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + 512
            xy = xy + pointing + rng.normal(0, 3, 2) + rng.normal(0, 0.03, xy.shape)
            seen = np.flatnonzero(np.all((xy > 0) & (xy < 1023), axis=1) & (rng.random(300) < 0.95))
            tables.append(detections(f"n{night}_{k}", xy[seen], flux=flux[seen]))
            tables[-1]["truth"] = seen
            true.append(seen)
    found = match(vstack(tables), shape=(1024, 1024)).table
    pairs = np.unique(np.column_stack([found["truth"], np.unique(found["star"], return_inverse=True)[1]]), axis=0)
    names = np.bincount(pairs[:, 0])
    assert np.count_nonzero(names > 1) <= 3  # of 270; 40 where the nearest exposures are all that are compared
    assert (np.bincount(pairs[:, 1]) == 1).all()


@pytest.mark.slow
def test_large_offsets_and_scale():
    shifts = np.array([[0, 0], [1200, 0], [0, 1200], [600, 600], [1200, 1200], [300, -100]])
    table = make_field(300, [0, 0.3, 10, 0, 0, -20], shifts, seed=2)
    third = table["exposure"] == "e02"
    for c in ("x", "y"):
        table[c][third] = table[c][third] * 1.04
    matches = match(table, shape=(2200, 2200))
    assert_good(table, matches)
    scales = {n: similarity.describe(p)["scale"] for n, p in matches.poses.items()}
    assert scales["e02"] / scales["e00"] == pytest.approx(1.04, abs=0.02)  # the distortion has a say in it


@pytest.mark.parametrize(
    "angles",
    [
        pytest.param([0, 90, 180, 270, 0, 90], marks=pytest.mark.slow),
        pytest.param([10, 10, -120, 77, 5, 200], marks=pytest.mark.slow),
    ],
    ids=["rolls", "any"],
)
def test_flips(angles):
    table = make_field(150, angles, np.zeros((6, 2)), seed=4, flips=[0, 1, 0, 1, 0, 0])
    matches = match(table, shape=SHAPE)
    assert_good(table, matches)
    parities = [similarity.describe(matches.poses[f"e{k:02d}"])["parity"] for k in range(6)]
    assert np.array_equal(np.array(parities) * parities[0], [1, -1, 1, -1, 1, 1])


@pytest.mark.slow
def test_depths_differ():
    table = make_field(600, *six_poses(20, 200), seed=6, depth=[1, 0.2, 1, 0.5, 0.2, 1])
    assert_good(table, match(table, shape=SHAPE))


def test_noise_frame_is_left_out_by_name():
    table = make_field(200, *six_poses(0.5, 100), seed=1)
    xy = np.random.default_rng(9).uniform(0, 2047, (30, 2))
    noise = detections("noise", xy, flux=np.linspace(1, 50, 30), truth=-np.ones(30, int))
    matches = match(vstack([noise, table]), shape=SHAPE)
    assert list(matches.left_out) == ["noise"]
    assert "better than chance" in matches.left_out["noise"]
    assert "noise" not in matches.names
    assert_good(table, matches)


@pytest.mark.slow
def test_bad_frame_of_many_detections_poisons_nothing():
    table = make_field(60, *six_poses(0.5, 100), seed=1)
    clean = match(table, shape=SHAPE)
    xy = np.random.default_rng(9).uniform(0, 2047, (200, 2))
    matches = match(vstack([table, detections("bad", xy, flux=1.0, truth=-1)]), shape=SHAPE)
    assert list(matches.left_out) == ["bad"]
    assert len(matches.table) == len(clean.table)


def test_exposure_with_too_few_detections_is_left_out():
    table = make_field(100, *six_poses(0.5, 100), seed=1)
    poor = detections("poor", np.array([[3.0, 4], [50, 60]]), flux=1.0, truth=-1)
    matches = match(vstack([table, poor]), shape=SHAPE)
    assert "only 2 usable detections" in matches.left_out["poor"]


@pytest.mark.slow
def test_unrelated_lists_do_not_match():
    rng = np.random.default_rng(8)
    for n, m in [(30, 200), (20, 20), (100, 100), (200, 200)]:
        for _ in range(2):
            lists = [StarList(rng.uniform(0, 2048, (k, 2)), np.full(k, 0.1), SHAPE, rng.random(k)) for k in (n, m)]
            assert register(*lists) is None


@pytest.mark.parametrize("seed", [3, 4, 11, 14, 15, 23])
def test_lists_of_eight_stars_that_agree_are_matched(seed):
    """A shift that carries all eight of one list to stars of another of 300 is no chance."""
    rng = np.random.default_rng(seed)
    stars, static = rng.uniform(50, 974, (300, 2)), rng.normal(0, 3, (7, 2))

    def seen(rows, flux, shift=(0.0, 0.0)):
        q = stars[rows] + shift
        x, y = (q - 511.5).T / 512
        q += np.stack([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=1) @ static
        return StarList(q + rng.normal(0, 0.01, q.shape), np.full(len(q), 0.01), (1024, 1024), flux)

    few = rng.choice(40, 8, replace=False)
    full, short = seen(np.arange(300), 10 ** np.linspace(5, 2, 300)), seen(few, np.linspace(2e5, 1e5, 8), (3, -2))
    there, back = register(short, full), register(full, short)
    assert np.array_equal(there.target[np.argsort(there.source)], few)
    assert np.array_equal(back.source[np.argsort(back.target)], few)
    others = StarList(rng.uniform(0, 1023, (8, 2)), np.full(8, 0.01), (1024, 1024), np.linspace(2e5, 1e5, 8))
    assert register(others, full) is None


@pytest.mark.slow
@pytest.mark.parametrize(("n", "m"), [(8, 150), (12, 12), (15, 100), (30, 30), (20, 300)])
def test_short_lists_do_not_match_by_chance(n, m):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        lists = [StarList(rng.uniform(0, 2048, (k, 2)), np.full(k, 0.1), SHAPE, rng.random(k)) for k in (n, m)]
        assert register(*lists) is None


def test_fast_stars_are_kept_with_a_tolerance_which_is_told(caplog):
    """Stars of 0.6 px a year over six years: what is found of the tolerance is of the others, which rest."""
    rng, tables = np.random.default_rng(5), []
    stars, motion = rng.uniform(250, 1797, (80, 2)), np.zeros((80, 2))
    motion[:10] = 0.6 * np.array([[1, 0]])
    for k, year in enumerate(np.repeat([2012.0, 2015.0, 2018.0], 2)):
        xy = stars + motion * (year - 2015) + rng.uniform(-200, 200, 2) + rng.normal(0, 0.01, stars.shape)
        tables.append(detections(f"e{k}", xy, flux=np.linspace(100, 1, 80), truth=np.arange(80)))
        tables[-1]["epoch"] = year
    table = vstack(tables)
    with caplog.at_level("INFO", logger="legdistort"):
        plain = match(table, shape=SHAPE, min_exposures=2)
    assert "the exposures span 6.0 years: stars that move farther" in caplog.text
    caplog.clear()
    with caplog.at_level("INFO", logger="legdistort"):
        wide = match(table, shape=SHAPE, min_exposures=2, tolerance=4.0)
    assert "span" not in caplog.text
    assert len(plain.stars) > 80
    assert len(wide.stars) == 80
    assert len(wide.table) == 480


@pytest.mark.slow
def test_two_groups():
    one = make_field(60, *six_poses(0.5, 100), seed=1)
    other = make_field(60, *six_poses(0.5, 100), seed=2)
    other["exposure"] = [name.replace("e", "f") for name in other["exposure"]]
    with pytest.raises(MatchError, match=r"2 groups .* e00, e01, .*; f00, f01"):
        match(vstack([one, other]), shape=SHAPE)


def test_hot_pixels_do_not_become_stars():
    table = make_field(100, *six_poses(0.1, 120), seed=7, spurious=0)
    hot = np.random.default_rng(1).uniform(0, 2047, (90, 2))
    rng = np.random.default_rng(2)
    hots = [detections(f"e{k:02d}", hot + rng.normal(0, 0.02, hot.shape), flux=1e4, truth=-1) for k in range(6)]
    table = vstack([table, *hots])
    matches = match(table, shape=SHAPE)
    assert_good(table, matches)
    assert np.mean(matches.table["truth"] < 0) < 0.01


@pytest.mark.slow
def test_hot_pixels_under_a_slow_drift():
    shifts = 0.35 * np.arange(12)[:, None] * np.array([1, 0.4])
    table = make_field(100, np.zeros(12), shifts, seed=7, spurious=0, peak=2)
    hot = np.random.default_rng(1).uniform(0, 2047, (40, 2))
    table = vstack([table, *[detections(f"e{k:02d}", hot, flux=20.0, truth=-2 - np.arange(40)) for k in range(12)]])
    matches = match(table, shape=SHAPE, tolerance=0.5)
    assert np.mean(matches.table["truth"] < 0) < 0.01
    assert_good(table, matches)


def test_undithered_exposures_keep_all_stars():
    table = make_field(100, np.zeros(6), np.zeros((6, 2)), seed=7)
    assert_good(table, match(table, shape=SHAPE))


def header_case(errors, *, n=80, angles=(0, 90, 180, 40, 3, 0), wrong=()):
    rng = np.random.default_rng(3)
    shifts = rng.uniform(-200, 200, (6, 2))
    table = make_field(n, angles, shifts, seed=8, peak=5)
    headers = [header(a, s, error=e) for a, s, e in zip(angles, shifts, errors, strict=True)]
    for k in wrong:
        headers[k] = header(angles[k] + 77 * (k + 1), shifts[k] + 1500 * (k % 3))
    return table, [exposure(f"e{k:02d}", w) for k, w in enumerate(headers)], shifts


def test_headers_give_poses_and_sky():
    errors = np.random.default_rng(5).normal(0, 10, (6, 2))
    errors -= errors.mean(axis=0)
    angles = (0, 0, 0, 0, 0, 0)
    table, exposures, shifts = header_case(errors, angles=angles)
    matches = match(table, exposures=exposures)
    assert_good(table, matches)
    assert set(matches.shapes.values()) == {SHAPE}
    # headers are 10 px off at random, their mean is right; relative to one another the matches decide
    offsets = np.array([matches.poses[f"e{k:02d}"][:, 2] for k in range(6)])
    np.testing.assert_allclose(offsets - offsets[0], shifts - shifts[0], atol=1.5)
    centre = matches.sky.to_sky(
        similarity.apply(similarity.invert(matches.poses["e00"]), np.array([[1023.5, 1023.5] + shifts[0]]))
    )
    assert (
        centre.separation(header(0, shifts[0]).pixel_to_world(*(np.array([1023.5, 1023.5]) + shifts[0]))).arcsec < 0.04
    )
    assert matches.sky.pixel_scale == pytest.approx(0.02, rel=1e-3)
    first = similarity.describe(matches.poses["e00"])
    assert first["parity"] == 1
    assert abs(first["rotation"]) < 0.2


@pytest.mark.slow
def test_rolled_frames_with_headers():
    table, exposures, _ = header_case(np.random.default_rng(5).normal(0, 15, (6, 2)))
    matches = match(table, exposures=exposures)
    assert_good(table, matches)
    turned = (
        similarity.describe(matches.poses["e01"])["rotation"] - similarity.describe(matches.poses["e00"])["rotation"]
    )
    assert turned == pytest.approx(90, abs=0.3)


@pytest.mark.slow
def test_one_wrong_header_does_no_harm():
    table, exposures, _ = header_case(np.zeros((6, 2)), wrong=[2])
    with warns_here(AssumptionWarning, match="the header WCS of e02 contradicts the stars"):
        matches = match(table, exposures=exposures)
    assert_good(table, matches)
    back = similarity.apply(similarity.invert(matches.poses["e00"]), np.array([[1023.5, 1023.5]]))
    separation = matches.sky.to_sky(back)[0].separation(exposures[0].wcs.pixel_to_world(1023.5, 1023.5))
    assert separation.arcsec < 0.1


def test_headers_all_wrong_are_ignored_with_a_warning():
    table, exposures, _ = header_case(np.zeros((6, 2)), wrong=range(6))
    with warns_here(AssumptionWarning, match="header WCSs contradict"):
        matches = match(table, exposures=exposures)
    assert_good(table, matches)
    assert matches.sky is None


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param({"scale": 0.026 / 3600}, marks=pytest.mark.sets),
        pytest.param({"flip": True}, marks=pytest.mark.slow),
        pytest.param({"error": (1229, -1229)}, marks=pytest.mark.sets),
        pytest.param({"angle": 12}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_headers_wrong_in_one_way(wrong):
    angles = (0, 90, 180, 40, 3, 0)
    table, exposures, shifts = header_case(np.zeros((6, 2)), angles=angles)
    for k in (1, 4):
        kind = dict(wrong)
        exposures[k] = exposure(f"e{k:02d}", header(angles[k] + kind.pop("angle", 0), shifts[k], **kind))
    with warns_here(AssumptionWarning, match="the header WCS of e01, e04 contradicts the stars"):
        matches = match(table, exposures=exposures)
    assert_good(table, matches)


@pytest.mark.slow
def test_some_exposures_without_wcs():
    table, exposures, _ = header_case(np.zeros((6, 2)))
    exposures = [e if k % 2 else exposure(e.name, None) for k, e in enumerate(exposures)]
    matches = match(table, exposures=exposures)
    assert_good(table, matches)
    assert matches.sky is not None


@pytest.mark.slow
def test_min_exposures_and_columns():
    table = make_field(100, *six_poses(0.5, 100), seed=1)
    sizes = {k: len(match(table, shape=SHAPE, min_exposures=k).stars) for k in (2, 4, 6)}
    assert sizes[2] > sizes[4] > sizes[6] > 10
    renamed = Table(table, copy=True)
    renamed.rename_columns(["exposure", "x_err"], ["frame", "sx"])
    matches = match(renamed, shape=SHAPE, columns={"exposure": "frame", "x_err": "sx"})
    assert len(matches.stars) == sizes[4]
    assert "sx" in renamed.colnames


def test_result():
    table = make_field(100, *six_poses(0.5, 100), seed=1)
    table["xy_corr"] = 0.1
    before = Table(table, copy=True)
    matches = match(table, shape=SHAPE)
    assert table.colnames == before.colnames
    assert all(np.all(table[c] == before[c]) for c in table.colnames)
    assert isinstance(matches.table, QTable)
    assert {"star", "xy_corr", "truth"} <= set(matches.table.colnames)
    assert np.array_equal(matches.stars, np.arange(len(matches.stars)))
    fluxes = [np.sort(matches.table["flux"][matches.table["star"] == s]) for s in matches.stars]
    flux = [f[len(f) // 2] for f in fluxes]
    assert np.all(np.diff(flux) <= 0)
    again = match(table[::-1], shape=SHAPE)
    assert recall_and_purity(table, again.table) == recall_and_purity(table, matches.table)


def test_flags():
    table = make_field(100, *six_poses(0.5, 100), seed=1)
    table["flags"] = np.where(np.arange(len(table)) % 10 == 0, 2, 0)
    assert np.all(match(table, shape=SHAPE, reject_flags=2).table["flags"] == 0)
    assert np.any(match(table, shape=SHAPE, reject_flags=1).table["flags"] == 2)


def test_where_all_are_flagged_the_flags_are_named():
    table = simulate_matches(n_stars=20, n_exposures=4, seed=1).matches.table
    table = table["exposure", "x", "y", "x_err", "y_err"]
    table["flags"] = np.where(np.arange(len(table)) % 2, Flag.SATURATED, Flag.EDGE | Flag.BLENDED)
    with pytest.raises(
        MatchError,
        match=r"none of the 80 detections .*\(SATURATED 40, EDGE 40\): correct the column.*reject_flags",
    ):
        match(table, shape=(2048, 2048))
    assert len(match(table, shape=(2048, 2048), reject_flags=0, isolation=None).stars) == 20
    table["flags"] = np.where(table["exposure"] == table["exposure"][0], 1.0, np.nan)  # no flag is none
    matches = match(table, shape=(2048, 2048), min_exposures=3)
    assert matches.left_out == {table["exposure"][0]: "only 0 usable detections of at least 5"}


def test_an_empty_table_is_told_from_one_without_columns():
    with pytest.raises(InputError, match="is empty: give one with the columns exposure, x, y, x_err, y_err and a row"):
        match(Table())
    with pytest.raises(InputError, match="is empty: give one with a row for each position"):
        match(make_field(40, *six_poses(0.5, 100), seed=1)[:0], shape=SHAPE)


def test_of_one_exposure_every_detection_is_a_star():
    table = make_field(40, *six_poses(0.5, 100), seed=1)
    one = table[table["exposure"] == "e02"]
    one["flags"] = 0
    one["flags"][3] = int(Flag.SATURATED)
    matches = match(one, shape=SHAPE)
    assert matches.names == ("e02",)
    assert len(matches.stars) == len(one) - 1
    assert np.array_equal(np.sort(matches.observations.xy[:, 0]), np.sort(np.delete(one["x"].value, 3)))


def test_bad_arguments():
    table = make_field(40, *six_poses(0.5, 100), seed=1)
    three = table[np.isin(table["exposure"], ["e00", "e01", "e02"])]
    with pytest.raises(InputError, match=r"only 3 exposures: give min_exposures=3 \(--min-exposures\)"):
        match(three, shape=SHAPE)
    with pytest.raises(InputError, match="min_exposures must be"):
        match(table, shape=SHAPE, min_exposures=1)
    with pytest.raises(InputError, match="tolerance must be a positive"):
        match(table, shape=SHAPE, tolerance=-1)
    with pytest.raises(InputError, match=r"'e05'.*not among exposures"):
        match(table, exposures=[exposure(f"e{k:02d}", None) for k in range(5)])
    with pytest.raises(InputError, match="no entry for exposure 'e05'"):
        match(table, shape={f"e{k:02d}": SHAPE for k in range(5)})
    with pytest.raises(InputError, match=r"shape of exposure 'e00' must be .* got 5"):
        match(table, shape=5)
    with pytest.raises(InputError, match="lacks the column"):
        match(table["exposure", "x", "y"], shape=SHAPE)
    with warns_here(AssumptionWarning, match="no shape given: every exposure is taken as 20[0-9]+ x 20"):
        match(table)


def test_no_star_in_enough_exposures():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 2047, (4, 30, 2))
    chain = [np.concatenate([xy[k], xy[(k + 1) % 4]]) for k in range(4)]  # every star in two of four exposures
    table = vstack([detections(f"e{k}", c) for k, c in enumerate(chain)])
    with pytest.raises(MatchError, match=r"found in 4 exposures or more, the best in 2; give min_exposures=2 \("):
        match(table, shape=SHAPE)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_exposures": None}, "min_exposures must be an integer of at least 2, got None"),
        ({"min_exposures": 2.5}, "min_exposures must be an integer of at least 2, got 2.5"),
        ({"columns": "star"}, "columns must be a dict .*, got 'star'"),
        ({"tolerance": "1"}, "tolerance must be a positive number of pixels, got '1'"),
        ({"reject_flags": "hot"}, "reject_flags must be an integer, .* got 'hot'"),
        ({"isolation": "much"}, "isolation must be a positive number of standard errors, or None, got 'much'"),
    ],
)
def test_options_of_the_wrong_kind(options, message):
    with pytest.raises(InputError, match=message):
        MatchOptions(**options)


def test_options_are_the_arguments():
    parameters = inspect.signature(match).parameters
    options = {option.name: option.default for option in fields(MatchOptions)}
    assert options == {name: parameters[name].default for name in options}
    assert parameters.keys() - options == {"detections", "exposures", "shape", "camera"}


def test_candidates_hold_the_truth():
    rng = np.random.default_rng(0)
    source = rng.uniform(0, 1000, (80, 2))
    true = np.column_stack([1.03 * rotation(130, flip=True), [800.0, -200.0]])
    target = similarity.apply(true, source[20:]) + rng.normal(0, 1, (60, 2))
    best = triangle_candidates(source, target)[0]
    assert np.abs(similarity.apply(best, source) - similarity.apply(true, source)).max() < 10
    shifts = offset_candidates(source, source[30:] + [313.0, -70], size=1000)
    assert min(np.abs(s - [313, -70]).max() for s in shifts) < 1


def test_contradictory_pairs_are_taken_apart():
    def paired(source, target, distance):
        warp = Warp.from_pose(similarity.identity(), SHAPE)
        return Registration(np.array(source), np.array(target), np.array(distance), warp, 1.0, 99.0, 1.0)

    # detections 0 of three exposures are one star, detections 1 another; one bad pair joins the two
    good = {
        (0, 1): paired([0, 1], [0, 1], [0.1, 0.1]),
        (0, 2): paired([0, 1], [0, 1], [0.1, 0.1]),
        (1, 2): paired([0, 1], [0, 1], [0.1, 0.1]),
    }
    bad = {**good, (1, 2): paired([0, 1], [1, 0], [0.9, 0.9])}
    for registrations in (good, bad):
        a, b, c = label_stars([3, 2, 2], registrations)
        assert a[0] == b[0] == c[0] != a[1] == b[1] == c[1]
        assert a[2] == -1


def test_exposure_tied_by_mistake_is_found_out():
    table = make_field(100, *six_poses(0, 50), seed=1)
    rng = np.random.default_rng(0)
    positions = [np.column_stack([t["x"], t["y"]]) for t in table.group_by("exposure").groups]
    lists = [StarList(xy, np.full(len(xy), 0.1), SHAPE) for xy in [*positions, rng.uniform(0, 2047, (90, 2))]]
    (group,) = link(lists[:6], lambda i, j: None)
    false = Registration(
        np.arange(30), np.arange(30), np.zeros(30), Warp.from_pose(similarity.identity(), SHAPE), 1.0, 99.0, 1.0
    )
    tied = Group({**group.poses, 6: similarity.identity()}, {**group.registrations, (0, 6): false})
    registrations, misfits = interlink(lists, tied)
    assert list(misfits) == [6]
    assert misfits[6] == "it agrees with only 1 of 6 exposures that it should overlap"
    assert len(registrations) == 15 + 1


def test_real_star_lists(shared_data):
    lists = []
    for name in "ABCD":
        table = Table.read(shared_data / "keck_nirc2_onc_bn" / f"{name}.lis", format="ascii.commented_header")
        table["exposure"] = name
        lists.append(table)
    table = vstack(lists, metadata_conflicts="silent")
    table["xe"], table["ye"] = np.maximum(table["xe"], 0.01), np.maximum(table["ye"], 0.01)
    matches = match(table, shape=(1024, 1024), min_exposures=3, columns={"x_err": "xe", "y_err": "ye"})
    assert matches.names == ("A", "B", "C", "D")
    assert len(matches.stars) >= 70
    shift = [similarity.describe(matches.poses[n])["dx"] for n in "ABCD"]
    assert abs(abs(shift[1] - shift[2]) - 250) < 3


@pytest.mark.slow
def test_real_frames(shared_data):
    photutils = pytest.importorskip("photutils.detection")
    from astropy.io import fits

    paths = sorted((shared_data / "microobs_hatp32" / "frames").glob("*.fit*"))
    tables = []
    for path in paths:
        data = fits.getdata(path).astype(float)
        data -= np.median(data)
        noise = 1.48 * np.median(np.abs(data))
        found = photutils.DAOStarFinder(threshold=12 * noise, fwhm=2.0, n_brightest=250)(data)
        xy = np.column_stack([found["x_centroid"], found["y_centroid"]])
        tables.append(detections(path.name, xy, flux=np.asarray(found["flux"])))
    matches = match(vstack(tables), shape=data.shape)
    assert len(matches.names) == 12
    assert not matches.left_out
    assert len(matches.stars) >= 100
    # nothing that stands still on the detector
    spans = [np.ptp(matches.table["x"][matches.table["star"] == s].value) for s in matches.stars]
    assert min(spans) > 20


def test_repeated_rows_count_once(caplog):
    sim = simulate_matches(n_stars=40, dither=50.0, seed=3)
    table = sim.matches.table["exposure", "x", "y", "x_err", "y_err"]
    whole = match(table, shape=(2048, 2048))
    again = match(vstack([table, table[:5]]), shape=(2048, 2048))
    assert len(again.table) == len(whole.table)
    assert "5 detections stand twice" in caplog.text


def test_a_tolerance_that_hides_all_is_named():
    """It was given as a reach of the search."""
    rng = np.random.default_rng(3)
    stars, rows = rng.uniform(0, 500, (90, 2)), []
    for name in ("a", "b", "c", "d"):
        xy = stars + rng.uniform(-30, 30, 2)
        rows += [(name, *each, 0.02, 0.02) for each in xy[np.all((xy > 0) & (xy < 499), axis=1)]]
    table = Table(rows=rows, names=["exposure", "x", "y", "x_err", "y_err"])
    with pytest.raises(MatchError, match=r"; tolerance=60 \(--tolerance\) is no reach of the search, .* leave it out"):
        match(table, shape=(500, 500), tolerance=60)
    assert len(match(table, shape=(500, 500)).names) == 4
