"""What may enter as matched positions, and the poses found from them."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import MaskedColumn, QTable, Table, vstack
from numpy.testing import assert_allclose, assert_array_equal

from legdistort.exceptions import InputError, MatchError
from legdistort.geometry import similarity
from legdistort.inputs.table_files import read_table
from legdistort.matching.matches import Matches
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving.estimation import solve

SHAPE = (2048, 2048)


@pytest.fixture(scope="module")
def sim():
    return simulate_matches(n_stars=25, n_exposures=5, dither=80.0, degree=2, seed=3)


def table_of(sim):
    return sim.matches.table.copy()


def test_from_table_keeps_rows_and_names(sim):
    given = table_of(sim)[np.random.default_rng(0).permutation(len(sim.matches.table))]
    matches = Matches.from_table(given, shape=SHAPE, poses=sim.matches.poses)
    assert_array_equal(matches.table["x"], given["x"])
    assert matches.names == tuple(dict.fromkeys(given["exposure"].tolist()))
    assert_array_equal(matches.stars, np.unique(given["star"]))
    assert repr(matches) == f"<Matches: {len(given)} observations of 25 stars in 5 exposures>"
    one = given[given["exposure"] == "exp00"]
    assert repr(Matches.from_table(one, shape=SHAPE)).endswith("stars in 1 exposure>")


def test_observations_are_the_plain_table(sim):
    given = table_of(sim)
    given["xy_corr"] = np.linspace(-0.9, 0.9, len(given))
    given["y_err"] = given["x_err"] * 2
    given["star"] = [f"s{k:02d}" for k in given["star"]]
    obs = Matches.from_table(given, shape=SHAPE, poses=sim.matches.poses).observations
    names = np.array(sim.matches.names)
    assert_array_equal(names[obs.exposure], given["exposure"])
    assert_array_equal(np.unique(given["star"])[obs.star], given["star"])
    assert_array_equal(obs.xy, np.column_stack([given["x"].value, given["y"].value]))
    sx, sy = given["x_err"].value, given["y_err"].value
    assert_allclose(obs.covariance, np.column_stack([sx**2, sy**2, given["xy_corr"] * sx * sy]))


def test_input_is_not_changed(sim):
    given = Table(table_of(sim))
    before = given.copy()
    matches = Matches.from_table(given, shape=SHAPE)
    matches.table["x"][0] = -1 * u.pix
    assert all(np.all(given[name] == before[name]) for name in before.colnames)


def test_rough_positions_are_means_of_what_the_poses_bring_back():
    exact = simulate_matches(n_stars=9, n_exposures=3, static=0, dynamic=0, noise=0, dither=50, rotations=[0, 40, 170])
    assert_allclose(exact.matches.positions, exact.truth.positions, atol=1e-8)


# --- what is refused ---------------------------------------------------------------------------------------------


def test_bad_values_are_refused_at_the_door(sim):
    for column, value in (("x", np.nan), ("y_err", 0.0), ("x_err", -1.0)):
        given = table_of(sim)
        given[column][7] = value * u.pix
        with pytest.raises(InputError, match=f"the table of matched positions: {column} is not .*row 7"):
            Matches.from_table(given, shape=SHAPE)
    given = table_of(sim)
    given["x"] = given["x"].value * u.arcsec
    with pytest.raises(InputError, match="column 'x' cannot be read as numbers in pix"):
        Matches.from_table(given, shape=SHAPE)
    given = table_of(sim)
    given.remove_column("y_err")
    with pytest.raises(InputError, match="the table of matched positions lacks the column y_err"):
        Matches.from_table(given, shape=SHAPE)
    given = Table(table_of(sim))
    given["star"] = MaskedColumn(given["star"], mask=np.arange(len(given)) == 4)
    with pytest.raises(InputError, match=r"column 'star' has no value in 1 of .* row 4"):
        Matches.from_table(given, shape=SHAPE)


def test_duplicates_are_named(sim):
    given = table_of(sim)
    n = len(given)
    with pytest.raises(InputError, match=rf"star 3 stands twice in exposure exp00 \(rows 3 and {n}; 1 such rows"):
        Matches.from_table(vstack([given, given[3:4]]), shape=SHAPE)
    with pytest.raises(InputError, match="2 such rows in all"):
        Matches.from_table(vstack([given, given[3:5]]), shape=SHAPE)


def test_one_exposure_is_solved_by_a_reference_alone(sim):
    given = table_of(sim)
    matches = Matches.from_table(given[given["exposure"] == "exp00"], shape=SHAPE)
    assert matches.names == ("exp00",)
    with pytest.raises(MatchError, match=r"only one exposure \(exp00\).*give two of the same field.*reference="):
        solve(matches)


def test_groups_without_a_common_star_are_listed(sim):
    given = table_of(sim)
    given["star"][np.isin(given["exposure"], ["exp01", "exp04"])] += 1000
    matches = Matches.from_table(given, shape=SHAPE)
    assert matches.fields.tolist() == [0, 1, 0, 0, 1]
    with pytest.raises(MatchError, match="2 groups with no star in common: exp00, exp02, exp03; exp01, exp04") as told:
        solve(matches)
    assert told.value.groups == (["exp00", "exp02", "exp03"], ["exp01", "exp04"])


@pytest.mark.parametrize("by", [["exposure", "star"], ["star", "exposure"]])
def test_of_long_tables_some_rows_are_looked_at_first(sim, monkeypatch, by):
    """Those of some stars; where these lie on a line or are not in all exposures, the others may well do better."""
    monkeypatch.setattr("legdistort.matching.matches._SOME", 25)
    given = table_of(sim)
    given.sort(by)
    first = given["star"] < 5  # of 25
    assert len(Matches.from_table(given, shape=SHAPE).names) == 5
    on_line = given["x"][first].copy()
    given["x"][first] = given["y"][first]
    assert len(Matches.from_table(given, shape=SHAPE, poses=sim.matches.poses).names) == 5
    given["x"][first] = on_line
    by_others = given[~first | (given["exposure"] != "exp04")]
    assert len(Matches.from_table(by_others, shape=SHAPE).names) == 5
    apart = given.copy()
    apart["star"][apart["exposure"] == "exp04"] += 1000
    assert Matches.from_table(apart, shape=SHAPE).fields.tolist() == [0, 0, 0, 0, 1]
    given["x"] = given["y"]
    with pytest.raises(InputError, match="all positions lie on one line"):
        Matches.from_table(given, shape=SHAPE)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"exp00": SHAPE}, "shape has no entry for exposure 'exp01'"),
        (2048, r"shape of exposure 'exp00' must be \(ny, nx\) in pixels, got 2048"),
        ((2048, 0), "must be .* got \\(2048, 0\\)"),
        ((1, 2, 3), "must be"),
        (None, "must be .* got None"),
        (("a", "b"), "must be"),
    ],
)
def test_missing_or_bad_shape(sim, shape, message):
    with pytest.raises(InputError, match=message):
        Matches.from_table(table_of(sim), shape=shape)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (None, "poses has no entry for exposure 'exp03'"),
        (np.eye(3), r"pose of exposure 'exp03' must be a finite \(2, 3\) array"),
        ([[1, 0.2, 0], [0, 1, 0]], "pose of exposure 'exp03' is not a similarity"),
    ],
)
def test_missing_or_bad_pose(sim, pose, message):
    given = dict(sim.matches.poses)
    del given["exp03"]
    if pose is not None:
        given["exp03"] = pose
    with pytest.raises(InputError, match=message):
        Matches.from_table(table_of(sim), shape=SHAPE, poses=given)


# --- poses from positions alone ----------------------------------------------------------------------------------


def relative(pose_by_name, names):
    """Poses seen from the first exposure, so that the choice of the reference plane drops out."""
    first = similarity.invert(pose_by_name[names[0]])
    return np.stack([similarity.compose(pose_by_name[name], first) for name in names])


CORNERS = np.array([[0.0, 0.0], [2047.0, 0.0], [0.0, 2047.0], [2047.0, 2047.0]])


def pose_error(found, true, names):
    """Largest displacement of a detector corner between two sets of poses, pixels."""
    return max(
        np.abs(similarity.apply(a, CORNERS) - similarity.apply(b, CORNERS)).max()
        for a, b in zip(relative(found, names), relative(true, names), strict=True)
    )


@pytest.mark.parametrize(
    "settings",
    [
        {"dither": 300.0},
        {"rotations": [0, 33, 90, 180, 271, 359]},
        {"flips": [0, 1, 0, 1, 1, 0], "rotations": [0, 33, 90, 180, 271, 10]},
        {"dither": 300.0, "seen": 0.6, "min_exposures": 2},
    ],
)
def test_poses_are_found_exactly_without_distortion(settings):
    sim = simulate_matches(n_stars=60, n_exposures=6, static=0, dynamic=0, noise=0, seed=4, **settings)
    found = Matches.from_table(table_of(sim), shape=SHAPE).poses
    assert pose_error(found, sim.truth.poses, sim.matches.names) < 1e-6


@pytest.mark.parametrize("settings", [{}, {"flips": [0, 1, 0, 1, 1, 0]}, {"rotations": [0, 33, 90, 180, 271, 10]}])
def test_poses_survive_ten_percent_of_mismatches(settings):
    sim = simulate_matches(n_stars=80, n_exposures=6, static=0, dynamic=0, sigma=0.1, dither=100, seed=5, **settings)
    given = table_of(sim)
    rng = np.random.default_rng(0)
    wrong = rng.choice(len(given), len(given) // 10, replace=False)
    for column in ("x", "y"):
        given[column][wrong] = rng.uniform(0, 2047, len(wrong)) * u.pix
    found = Matches.from_table(given, shape=SHAPE).poses
    clean = Matches.from_table(table_of(sim), shape=SHAPE).poses
    assert pose_error(clean, sim.truth.poses, sim.matches.names) < 0.15
    assert pose_error(found, sim.truth.poses, sim.matches.names) < 0.3


def test_plane_of_estimated_poses_has_the_scale_of_the_detector():
    sim = simulate_matches(n_stars=40, n_exposures=10, static=0, dynamic=0.5, sigma=0.1, seed=6)
    found = [similarity.describe(p) for p in Matches.from_table(table_of(sim), shape=SHAPE).poses.values()]
    assert np.mean([d["scale"] for d in found]) == pytest.approx(1, abs=1e-3)  # coefficients of 0.5 px scatter by 4e-4
    assert np.mean([d["rotation"] for d in found]) == pytest.approx(0, abs=0.06)


def test_poses_of_a_chain():
    """No two ends share a star: A-B, B-C, C-D."""
    rng = np.random.default_rng(1)
    xy = np.column_stack([rng.uniform(0, 3000, 60), rng.uniform(0, 900, 60)])
    rows = []
    for i in range(4):
        on = (xy[:, 0] > 600 * i) & (xy[:, 0] < 600 * i + 1000)
        rows += [(f"e{i}", k, xy[k, 0] - 600 * i, xy[k, 1] + 10 * i, 0.1, 0.1) for k in np.flatnonzero(on)]
    table = Table(rows=rows, names=("exposure", "star", "x", "y", "x_err", "y_err"))
    found = Matches.from_table(table, shape=(1000, 1000)).poses
    for i in range(4):
        pose = similarity.compose(found[f"e{i}"], similarity.invert(found["e0"]))
        assert_allclose(pose, [[1, 0, -600 * i], [0, 1, 10 * i]], atol=1e-6)


def test_an_exposure_of_one_common_star_has_no_pose(sim):
    given = table_of(sim)
    lonely = np.flatnonzero(given["exposure"] == "exp02")[1:]
    given["star"][lonely] += 500
    with pytest.raises(
        MatchError, match=r"exposure exp02 shares 1 star with the other exposures.*at least 2: give poses"
    ):
        Matches.from_table(given, shape=SHAPE)
    Matches.from_table(given, shape=SHAPE, poses=sim.matches.poses)


# --- in and out of files -----------------------------------------------------------------------------------------


def test_the_epoch_of_what_is_left_is_its_own(sim):
    """A mean, unless the caller states another: places would be said to be of a time at which nobody looked."""
    table = table_of(sim)
    first = table["exposure"] == sim.matches.names[0]
    table["epoch"] = np.where(first, 2024.0, 2020.0)
    shape = sim.matches.shapes[sim.matches.names[0]]
    left = {sim.matches.names[0]: "another year"}
    matches = Matches.from_table(table, shape=shape)
    assert 2020.1 < matches.epoch < 2023.9
    assert matches.without(left).epoch == pytest.approx(2020)
    assert Matches.from_table(table, shape=shape, epoch=2022.0).without(left).epoch == 2022
    solution = solve(matches.without(left))
    assert solution.stars.meta["epoch"] == pytest.approx(2020)


@pytest.mark.parametrize("sky", [True, False])
def test_meta_survives_ecsv(tmp_path, sky):
    sim = simulate_gsaoi_matches(small=True, seed=1) if sky else simulate_matches(n_stars=8, n_exposures=3, dither=9)
    matches = Matches(
        sim.matches.table, sim.matches.shapes, sim.matches.poses, sim.matches.sky, {"bad": "no stars: 'none'"}
    )
    table = QTable(matches.table, copy=True)
    table.meta = matches.to_meta()
    table.write(tmp_path / "m.ecsv")
    back = read_table(tmp_path / "m.ecsv")
    again = Matches.from_table(back, **Matches.read_meta(back.meta))
    assert again.shapes == matches.shapes
    assert again.left_out == matches.left_out
    for name in matches.names:
        assert_array_equal(again.poses[name], matches.poses[name])
    if sky:
        assert (again.sky.lon, again.sky.lat) == (matches.sky.lon, matches.sky.lat)
        assert_array_equal(again.sky.matrix, matches.sky.matrix)
    else:
        assert again.sky is None
    for name in matches.table.colnames:
        assert_array_equal(again.table[name], matches.table[name])


def test_meta_of_a_foreign_table_is_nothing():
    known = "shape", "poses", "sky", "left_out", "epoch", "header_distortion", "camera", "pose_sigma"
    known = *known, "pointing", "start"
    assert Matches.read_meta({"author": "somebody"}) == dict.fromkeys(known)
