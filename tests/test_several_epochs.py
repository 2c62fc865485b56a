"""Nights of several epochs: simulated, solved, and seen at another time."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose
from test_motions import FIVE, field, without_a_map
from test_reference_motions import gaia

from legdistort.cli.parser import main
from legdistort.coaddition.mosaicking import coadd
from legdistort.exceptions import InputError
from legdistort.geometry.epochs import header_epoch
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


def test_positions_of_such_a_night_give_its_motions():
    sim = simulate_gsaoi_matches(small=True, n_stars=120, motion=0.3, epochs=SIX)
    solution = solve(sim.matches, degree=1, motion="proper", clip=None)
    known = np.isin(np.arange(120), solution.star_names)
    off = solution.motions.values - sim.truth.motions[known]
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


@pytest.mark.parametrize("tied", [False, True])
def test_stars_at_another_time_are_those_of_a_solution_of_that_time(tied):
    """As of a solution whose positions are of that time, but for the gauge."""
    sim = field(60, FIVE, parallax=0.1)
    reference = {"reference": gaia(sim, np.random.default_rng(1))[0]} if tied else {}
    solution = solve(sim.matches, motion="parallax", clip=None, **reference)
    direct = solve(sim.matches, motion="parallax", clip=None, motion_epoch=2018.0, **reference)
    there, again = solution.stars_at(2018.0), direct.stars_at(2018.0)
    off = solution.positions_at(2018.0) - direct.positions_at(2018.0)
    left = off if tied else without_a_map(off, sim.truth.positions)[0]
    assert np.abs(left).max() < 0.25 * there["x_err"].value.min()
    for name in ("x_err", "y_err_abs", "ra_error", "dec_error_abs"):
        assert_allclose(there[name].value, again[name].value, rtol=0.12, err_msg=name)
    assert there["sky"].obstime.jyear == pytest.approx(2018.0)
    assert there.meta["epoch"] == 2018.0


def test_stars_at_another_time_need_motions():
    with pytest.raises(InputError, match="motions of the stars were not fitted"):
        solve(field(40).matches).stars_at(2018.0)


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
    moved = solution.positions_at(2019.2) - solution.positions
    assert np.median(np.hypot(*moved.T)) > 2
