"""Nights of several epochs: simulated, solved, and seen at another time."""

import re

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from moving_stars import FIVE, SKY, THREE, field, gaia, positions_at, without_a_map, without_a_similarity
from numpy.testing import assert_allclose

from legdistort.cli.parser import main
from legdistort.coaddition.mosaicking import coadd
from legdistort.exceptions import InputError
from legdistort.geometry.epochs import header_epoch
from legdistort.geometry.parallax import on_plane
from legdistort.inputs.exposures import Exposure
from legdistort.simulation.observations import simulate_exposures, simulate_gsaoi_matches
from legdistort.solving.estimation import solve

SIX = (2015.3, 2015.3, 2016.5, 2016.5, 2019.2, 2019.2)


def test_frames_of_several_epochs_show_stars_where_they_are_then():
    """Pixels are brightest where the truth has the stars at the time that the header tells."""
    night = simulate_exposures(small=True, noise=False, n_stars=20, motion=2.0, parallax=0.5, epochs=SIX)
    truth = night.truth
    for i, (name, hdus) in enumerate(night.hdus.items()):
        assert header_epoch(hdus[0].header) == pytest.approx(truth.years[i], abs=1e-7)
        xy = truth.distort(name, truth.place(name))
        x, y = np.rint(xy).astype(int).T
        inside = (np.abs(xy - 255.5) < 240).all(axis=1)
        for row, column in zip(y[inside], x[inside], strict=True):
            patch = hdus[0].data[row - 4 : row + 5, column - 4 : column + 5]
            assert np.abs(np.array(np.unravel_index(patch.argmax(), patch.shape)) - 4).max() <= 1
    still = simulate_exposures(small=True, noise=False, n_stars=20)
    assert_allclose(still.truth.positions, truth.positions)
    assert np.ptp(truth.place("exp05") - truth.positions, axis=0).min() > 5


@pytest.mark.slow
def test_positions_of_such_a_night_give_its_motions():
    sim = simulate_gsaoi_matches(small=True, n_stars=120, motion=0.3, epochs=SIX)
    solution = solve(sim.matches, degree=1, motion="proper", clip=None)
    known = np.isin(np.arange(120), solution.estimate.star_names)
    off = solution.estimate.motions.values - sim.truth.motions[known]
    assert np.nanmedian(np.abs(off - np.nanmedian(off, axis=0))) < 0.08


def test_a_night_in_the_shell_with_its_truth(tmp_path, capsys):
    arguments = ["simulate", "--out", str(tmp_path / "night"), "--small", "--motion", "0.5", "--parallax", "0.2"]
    assert main([*arguments, "--epochs", "2015", "2015", "2016.2", "2017.9"]) == 0
    assert "4 frames and truth.ecsv" in capsys.readouterr().out
    truth = QTable.read(tmp_path / "night" / "truth.ecsv")
    assert truth["vx"].unit == u.pix / u.yr
    assert np.std(truth["pmra"].to_value(u.mas / u.yr)) == pytest.approx(0.5 * 79.6, rel=0.3)  # 79.6 mas a pixel
    assert np.std(truth["parallax"].to_value(u.mas)) == pytest.approx(0.2 * 79.6, rel=0.3)
    assert truth.meta["epoch"] == pytest.approx((2015 + 2015 + 2016.2 + 2017.9) / 4, abs=1e-4)
    header = fits.getheader(tmp_path / "night" / "exp03.fits")
    assert header["DATE-OBS"].startswith("2017-11")
    assert re.fullmatch(r"[-\d]+T[:\d]+\.\d{3}", header["DATE-OBS"])  # whole milliseconds
    assert truth.meta["exp03"]["epoch"] == pytest.approx(2017.9, abs=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"motion": 0.3}, "stars that move need epochs"),
        ({"epochs": [2015.0]}, "epochs must be the years of the 6 exposures"),
        ({"epochs": [20111.0] * 6}, "epochs must be the years of the 6 exposures, 1800 to 2200"),
        ({"motion": np.zeros((3, 2)), "epochs": SIX}, "motion must be a number or an array"),
    ],
)
def test_nights_that_cannot_be(settings, message):
    with pytest.raises(InputError, match=message):
        simulate_exposures(small=True, n_stars=20, **settings)


@pytest.mark.parametrize(
    "tied", [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=pytest.mark.slow)]
)
def test_stars_at_another_time_are_those_of_a_solution_of_that_time(tied):
    """As of a solution whose positions are of that time, but for the gauge."""
    sim = field(60, FIVE, parallax=0.1)
    reference = {"reference": gaia(sim, np.random.default_rng(1))[0]} if tied else {}
    solution = solve(sim.matches, motion="parallax", clip=None, **reference)
    direct = solve(sim.matches, motion="parallax", clip=None, motion_epoch=2018.0, **reference)
    there, again = solution.stars_at(2018.0), direct.stars_at(2018.0)
    off = positions_at(solution, 2018.0) - positions_at(direct, 2018.0)
    left = off if tied else without_a_map(off, sim.truth.positions)[0]
    assert np.abs(left).max() < 0.25 * there["x_err"].value.min()
    for name in ("x_err", "y_err_abs", "ra_error", "dec_error_abs"):
        # the map that is taken off has the weights of the epoch of the positions
        tolerance = 0.12 if name.endswith("abs") else 0.2
        assert_allclose(there[name].value, again[name].value, rtol=tolerance, err_msg=name)
    assert there["sky"].obstime.jyear == pytest.approx(2018.0)
    assert there.colnames == again.colnames
    for name in ("n", "n_epochs", "span", "chi2", "vx", "vx_err", "vx_err_abs", "vx_vy_corr"):
        assert_allclose(there[name], solution.stars[name], rtol=1e-12, err_msg=name)
    moved, off = (np.abs(there["x_vx_corr"] - each.stars["x_vx_corr"]) for each in (solution, direct))
    assert np.median(off) < 0.1 * np.median(moved)
    assert there.meta == again.meta
    assert there.meta["epoch"] == 2018.0


@pytest.mark.slow
def test_stars_at_another_time_need_motions():
    with pytest.raises(InputError, match="motions of the stars were not fitted"):
        solve(field(40).matches).stars_at(2018.0)


# -- positions of known stars carried on


@pytest.fixture(scope="module")
def moving():
    sim = field(60, FIVE, parallax=0.1)
    return sim, solve(sim.matches, motion="parallax", clip=None)


def test_a_position_is_carried_along_the_path_of_its_star(moving):
    _, solution = moving
    name, year = solution.names[0], solution.estimate.motions.years[0]
    seen = solution[name].distort(positions_at(solution, year))
    inside = np.isfinite(seen[:, 0])
    seen, stars, then = (
        seen[inside],
        np.array(solution.estimate.star_names)[inside],
        positions_at(solution, 2021.0)[inside],
    )
    assert_allclose(solution[name].correct(seen, epoch=2021.0, stars=stars), then, atol=1e-6)
    there = solution[name].correct(seen[5:7] * u.pix, epoch=2021.0, stars=stars[5:7], errors=[0.05, 0.05])
    assert_allclose(there.xy.to_value(u.pix), then[5:7], atol=1e-6)
    same = solution[name].correct(seen, errors=0.05, epoch=year, stars=stars)
    for a, b in zip(solution[name].correct(seen, errors=0.05), same, strict=True):
        assert_allclose(a, b)


@pytest.mark.parametrize(
    "kind", [pytest.param("proper", marks=pytest.mark.sets), pytest.param("parallax", marks=pytest.mark.slow)]
)
def test_errors_of_positions_carried_on_are_calibrated(kind):
    """Fresh measurements in one exposure, carried on by twenty years, after which errors of rates are most of all."""
    pulls, true, stated = [], [], []
    epochs, more = (THREE, {}) if kind == "proper" else (FIVE, {"parallax": 0.1})
    for seed in range(12):
        sim = field(100, epochs, seed=seed, min_exposures=len(epochs), sigma=0.02, static=0.0, **more)
        truth, solution = sim.truth, solve(sim.matches, motion=kind, clip=None)
        name = solution.names[1]
        seen = truth.distort(name, truth.place(name))
        seen = seen + 0.02 * np.random.default_rng(seed + 5000).standard_normal(seen.shape)
        found = solution[name].correct(seen, errors=0.02, epoch=2035.0, stars=solution.estimate.star_names)
        place = truth.positions + (2035.0 - truth.epoch) * truth.motions
        if kind == "parallax":
            place = place + truth.parallaxes[:, None] * on_plane(SKY, [2035.0])
        left, m = without_a_map(found.xy - place, truth.positions)
        pulls.append(np.mean(left**2 / np.einsum("nkk->nk", found.relative)) * len(left) / (len(left) - m))
        true.append(np.mean(without_a_similarity(found.xy - place, truth.positions) ** 2))
        stated.append(np.mean(np.einsum("nkk->nk", found.absolute)))
    assert np.mean(pulls) == pytest.approx(1, abs=0.15)
    assert np.sqrt(np.mean(true) / np.mean(stated)) == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"epoch": 2021.0}, "give both epoch and stars, or neither"),
        ({"stars": ["1", "2"]}, "give both epoch and stars, or neither"),
        ({"epoch": 20111.0, "stars": ["1", "2"]}, "epoch must be a decimal year"),
        ({"epoch": 2021.0, "stars": ["1"]}, "stars must name a star of the solution for each of the .* 2"),
        ({"epoch": 2021.0, "stars": 5}, "stars must name a star"),
        ({"epoch": 2021.0, "stars": ["1", "vega"]}, "no motion is known of vega: the solution has no such stars"),
    ],
)
def test_positions_that_nothing_carries_on(moving, settings, message):
    _, solution = moving
    with pytest.raises(InputError, match=message):
        solution[solution.names[0]].correct(np.full((2, 2), 500.0), **settings)


def test_a_star_without_a_motion_stays_with_an_unknown_error():
    sim = field(60)
    table = sim.matches.table
    keep = ~((table["star"] == 7) & (table["epoch"].value > 2016))
    matches = type(sim.matches).from_table(table[keep], shape=sim.matches.shapes, poses=sim.matches.poses)
    solution = solve(matches, motion="proper", clip=None)
    name, stars = solution.names[0], solution.estimate.star_names[6:9]
    here = solution[name].correct(np.full((3, 2), 500.0))
    there = solution[name].correct(np.full((3, 2), 500.0), errors=0.05, epoch=2021.0, stars=stars)
    assert_allclose(there.xy[1], here[1])
    assert np.isnan(there.relative[1]).all()
    assert np.isnan(there.absolute[1]).all()
    assert np.isfinite(there.absolute[[0, 2]]).all()


def test_a_table_of_positions_carried_on_in_the_shell(moving, tmp_path):
    _, solution = moving
    solution.write(tmp_path / "solution.asdf")
    names = [solution.names[k] for k in (3, 0, 3)]
    table = QTable({"exposure": names, "star": [solution.estimate.star_names[k] for k in (4, 5, 6)]})
    table["x"] = table["y"] = [500.0, 900.0, 700.0] * u.pix
    table["x_err"] = table["y_err"] = [0.05] * 3 * u.pix
    table.write(tmp_path / "seen.ecsv")
    files = [str(tmp_path / name) for name in ("solution.asdf", "seen.ecsv", "out.ecsv")]
    assert main(["correct", *files[:2], "--epoch", "2021", "--out", files[2]]) == 0
    out = QTable.read(files[2])
    assert out.meta["epoch"] == 2021.0
    for row, name, star in zip(out, names, table["star"], strict=True):
        seen = table[(table["star"] == star)]
        xy = np.array([[seen["x"][0].value, seen["y"][0].value]])
        single = solution[name].correct(xy, errors=0.05, epoch=2021.0, stars=[star])
        assert_allclose([row["x"].value, row["y"].value], single.xy[0])
        assert_allclose(row["x_err"].value, np.sqrt(single.relative[0, 0, 0]))
        assert_allclose(row["y_err_abs"].value, np.sqrt(single.absolute[0, 1, 1]))
    table.remove_column("star")
    with pytest.raises(InputError, match="lacks the column star"):
        solution.correct_table(table, epoch=2021.0)


@pytest.mark.slow
def test_a_stack_of_one_epoch_shows_the_stars_of_that_time():
    """Of the exposures of 2019 alone; where stars are then, not at the epoch of the solution."""
    settings = {"small": True, "n_stars": 80, "motion": 1.5, "epochs": SIX, "dynamic_rms": 0.1}
    images = simulate_exposures(**settings)
    solution = solve(simulate_gsaoi_matches(**settings).matches, degree=2, motion="proper")
    late = [Exposure(name, images.hdus[name][0].data.astype(float)) for name in images.truth.names[4:]]
    mosaic = coadd(late, solution)
    there, offsets = solution.stars_at(2019.2), []
    for row in np.argsort(-there["x_err"].value)[::-1][:20]:
        x, y = np.array([there["x"].value[row], there["y"].value[row]]) - mosaic.offset
        k, j = round(x), round(y)
        patch = np.array(mosaic.data[j - 5 : j + 6, k - 5 : k + 6])
        if patch.shape != (11, 11) or not np.isfinite(patch).all():
            continue
        weight = np.clip(patch - np.median(patch) - 0.3 * np.ptp(patch), 0, None)
        v, u_ = np.indices(patch.shape) - 5
        offsets.append([(weight * u_).sum() / weight.sum() + k - x, (weight * v).sum() / weight.sum() + j - y])
    assert len(offsets) >= 10
    assert np.median(np.hypot(*np.transpose(offsets))) < 0.15
    moved = positions_at(solution, 2019.2) - solution.estimate.positions
    assert np.median(np.hypot(*moved.T)) > 2
