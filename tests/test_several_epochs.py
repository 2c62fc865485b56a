"""Simulated nights of several epochs."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose

from legdistort.cli.parser import main
from legdistort.exceptions import InputError
from legdistort.geometry.epochs import header_epoch
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
