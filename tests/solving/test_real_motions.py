"""Nine epochs of Keck NIRC2 of the field of OB150029, 2015 to 2019: motions beside those that others published."""

import warnings

import numpy as np
import pytest
from astropy.table import Table, vstack
from moving_stars import positions_at

from legdistort.exceptions import AssumptionWarning
from legdistort.inputs.table_files import read_table
from legdistort.matching.matcher import match
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.solving import estimation

MAS = 9.95 * np.array([-1, 1])  # a pixel, x to the west


def solve(matches, **settings):
    """Without the words on single stars whose lists contradict one another."""
    with warnings.catch_warnings(action="ignore", category=AssumptionWarning):
        return estimation.solve(matches, **settings)


def read_lists(shared_data, faintest):
    """All lists, with 0.02 px added to their errors, some of which are zero."""
    lists = []
    for path in sorted((shared_data / "keck_nirc2_ob150029").glob("*.lis")):
        table = read_table(path)
        table["exposure"] = [path.stem[3:10]] * len(table)
        table.meta = {}
        lists.append(table[np.asarray(table["mag"]) < faintest])
    table = vstack(lists)
    for name in ("x_err", "y_err"):
        table[name] = np.hypot(table[name], 0.02)
    return table


@pytest.fixture(scope="module")
def epochs(shared_data):
    """Stars brighter than K = 17.5."""
    return match(read_lists(shared_data, faintest=17.5), shape=(1024, 1024), min_exposures=3)


@pytest.fixture(scope="module")
def moving(epochs):
    return solve(epochs, degree=2, motion="auto")


def names(solution):
    """The name that the lists most often give a star."""
    table, found = solution.residuals, {}
    for star, name in zip(table["star"], table["name"], strict=True):
        found.setdefault(star, []).append(str(name))
    return np.array([max(set(found[star]), key=found[star].count) for star in solution.estimate.star_names])


@pytest.mark.slow
def test_motions_explain_what_positions_do_not(epochs, moving):
    still = solve(epochs, degree=2)
    assert moving.settings.motion == "proper"
    assert still.chi2 / still.dof > 100
    assert moving.chi2 / moving.dof < 3
    time = next(check for check in still.checks if check.name == "time")
    assert time.state == "fail"
    assert "--motion proper" in time.cure


def test_motions_are_those_published(shared_data, moving):
    """Star by star, after a common linear rate of both lists."""
    labels = Table.read(shared_data / "keck_nirc2_ob150029" / "ob150029_label.txt", format="ascii.commented_header")
    labels = labels[labels["vxerr"] > 0]
    _, mine, theirs = np.intersect1d(names(moving), labels["name"].astype(str), return_indices=True)
    published = np.column_stack([labels["vx"], labels["vy"]])[theirs]
    ours, xy = moving.estimate.motions.values[mine] * MAS, moving.estimate.positions[mine]
    good = np.isfinite(ours[:, 0])
    ours, published, xy = ours[good], published[good], xy[good]
    design = np.column_stack([np.ones(len(xy)), (xy - xy.mean(axis=0)) / 500])
    kept = np.ones(len(xy), dtype=bool)
    for _ in range(5):
        left = ours - published
        left -= design @ np.linalg.lstsq(design[kept], left[kept], rcond=None)[0]
        scatter = 1.4826 * np.median(np.abs(left))
        kept = (np.abs(left) < 4 * scatter).all(axis=1)
    assert len(xy) >= 15
    assert published.std() > 2  # mas/yr, the motions themselves
    assert scatter < 0.3


def test_an_epoch_kept_out_is_predicted(epochs):
    """Positions of August 2018 from the other eight lists, after a map of the degree of the fit."""
    rows = epochs.table["exposure"] == "18aug21"
    others = epochs.without({"18aug21": "kept out"})
    solution = solve(others, degree=2, motion="proper")
    year = epochs.epochs[epochs.names.index("18aug21")]
    star, xy = epochs.table["star"][rows], np.column_stack([epochs.table[k][rows].value for k in "xy"])
    _, here, there = np.intersect1d(star, solution.estimate.star_names, return_indices=True)
    seen = (solution.estimate.motions.n_epochs[there] > 2) & np.isfinite(solution.estimate.positions[there, 0])
    measured, offsets = xy[here[seen]], {}
    for what, predicted in (("moved", positions_at(solution, year)), ("still", solution.estimate.positions)):
        source = predicted[there[seen]]
        x, y = (source / 500 - 1).T
        design = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
        kept = np.ones(len(source), dtype=bool)
        for _ in range(5):
            left = measured - design @ np.linalg.lstsq(design[kept], measured[kept], rcond=None)[0]
            kept = (np.abs(left) < 4 * 1.4826 * np.median(np.abs(left))).all(axis=1)
        offsets[what] = 1.4826 * np.median(np.abs(left))
    assert offsets["moved"] < 0.1
    assert offsets["still"] > 3 * offsets["moved"]


@pytest.mark.slow
def test_positions_beyond_the_shape_are_left_out_by_name(shared_data):
    """Three of all stars lie outside 1024 pixels and their margin, all in the last list, which is used for all that."""
    with pytest.warns(AssumptionWarning, match="3 positions lie outside their detector and are left out: star") as told:
        matches = match(read_lists(shared_data, faintest=99), shape=(1024, 1024), min_exposures=3)
    words = next(str(each.message) for each in told if "outside" in str(each.message))
    assert words.count("of exposure 19apr17 at (") == 3
    assert "(1131, 215)" in words
    assert not matches.left_out
    assert len(matches.names) == 9
    inside = matches.table["exposure"] == "19apr17"
    assert np.count_nonzero(inside) > 200
    assert matches.table["x"][inside].value.max() < 1129
    solution = solve(matches.without(dict.fromkeys(matches.names[:4], "")), degree=2, motion="proper")
    assert "19apr17" in solution.names


def test_beside_a_field_of_one_date(shared_data, epochs):
    """Four lists of Orion BN/KL of one date by the same camera: known exactly, it tells nothing of OB150029 anew."""
    lists = []
    for path in sorted((shared_data / "keck_nirc2_onc_bn").glob("*.lis")):
        table = read_table(path)
        table["exposure"], table.meta = [path.stem] * len(table), {}
        table["x_err"], table["y_err"] = (np.hypot(table[name], 0.02) for name in ("x_err", "y_err"))
        lists.append(table)
    orion = match(vstack(lists), shape=(1024, 1024), min_exposures=3)
    known = {"prior": Prior(np.zeros((2, 6)), sigma=0.5), "degree": 2, "motion": "proper"}
    alone, both = solve(epochs, **known), solve(Matches.of_fields({"ob": epochs, "orion": orion}), **known)
    assert "seen at a single epoch" in str(both)
    stars = {str(name): k for k, name in enumerate(both.stars["star"])}
    rows = [stars[f"ob_{name}"] for name in alone.stars["star"]]
    assert set(both.stars["field"][rows]) <= {0, 1}
    good = np.isfinite(alone.stars["x"]) & np.isfinite(both.stars["x"][rows])
    assert np.count_nonzero(good) > 0.97 * len(good)
    for name, error in (("vx", "vx_err"), ("vy", "vy_err")):  # rates of shift, rotation and scale are not known
        off = (both.stars[name][rows] - alone.stars[name]).value[good]
        xy = np.stack([alone.stars["x"].value, alone.stars["y"].value, np.ones(len(good))], axis=1)[good]
        off -= xy @ np.linalg.lstsq(xy, off, rcond=None)[0]
        assert np.median(np.abs(off) / alone.stars[error].value[good]) < 0.1
