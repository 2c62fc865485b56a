"""When exposures were taken: columns of every kind, headers, and what cannot be."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time

from legdistort.exceptions import InputError
from legdistort.geometry.epochs import header_epoch, years
from legdistort.matching.matches import Matches

YEARS = np.array([2015.5, 2016.5, 2019.25])


def table(epoch=None):
    """Three exposures of twelve stars; `epoch` by exposure."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 1000, (12, 2))
    rows = {"exposure": np.repeat(["a", "b", "c"], 12), "star": np.tile(np.arange(12), 3)}
    rows |= {k: np.tile(v, 3) + rng.normal(0, 0.01, 36) for k, v in zip("xy", xy.T, strict=True)}
    rows |= {"x_err": np.full(36, 0.01), "y_err": np.full(36, 0.01)}
    out = Table(rows)
    if epoch is not None:
        out["epoch"] = epoch[np.repeat([0, 1, 2], 12)]
    return out


@pytest.mark.parametrize(
    "column",
    [
        YEARS,
        YEARS * u.yr,
        Time(YEARS, format="jyear").mjd,
        Time(YEARS, format="jyear").mjd * u.day,
        Time(YEARS, format="jyear"),
        Time(Time(YEARS, format="jyear").isot),
    ],
    ids=["years", "years with unit", "MJD", "MJD with unit", "Time", "dates"],
)
def test_the_column_epoch_of_every_kind(column):
    matches = Matches.from_table(table(column), shape=(1000, 1000))
    np.testing.assert_allclose(matches.epochs, YEARS, atol=1e-6)
    assert matches.epoch == pytest.approx(YEARS.mean())
    assert matches.times[1] == "days"


@pytest.mark.parametrize(
    ("epoch", "message"),
    [
        (None, "DATE-OBS, MJD-OBS or EXPSTART"),
        (np.array([2015.5, np.nan, 2019.0]), r"no value for 1 of 3 exposures \(b\)"),
        (np.array([2015.5, 20111.0, 2019.0]), r"1800 to 2200, MJD or Time, got b: 20111"),
        (np.array([20111.0, 20113.0, 20119.0]), r"1800 to 2200, MJD or Time, got a: 20111, b: 20113, c: 20119"),
    ],
)
def test_epochs_that_are_missing_or_cannot_be(epoch, message):
    with pytest.raises(InputError, match=message):
        Matches.from_table(table(epoch), shape=(1000, 1000)).epochs  # noqa: B018


def test_one_exposure_has_one_epoch():
    given = table(YEARS)
    given["epoch"][3] = 2015.6
    with pytest.raises(InputError, match="several values for exposure a"):
        Matches.from_table(given, shape=(1000, 1000)).epochs  # noqa: B018


def test_a_column_that_is_no_time():
    with pytest.raises(InputError, match="decimal years, MJD or Time"):
        years(Table({"epoch": ["yesterday"]})["epoch"])


def test_headers_of_hst_tell_the_time():
    assert header_epoch(fits.Header({"EXPSTART": 57204.5, "DATE-OBS": "2015-07-01"})) == pytest.approx(
        Time(57204.5, format="mjd").jyear
    )
    assert header_epoch(fits.Header({"EXPSTART": 0.0, "DATE-OBS": "2015-07-01"})) == pytest.approx(
        2000 + (57204 - 51544.5) / 365.25
    )


@pytest.mark.parametrize(
    ("epochs", "unit", "days"),
    [
        ([2015.5, 2015.5, 2018.5], "days", [0, 0, 3 * 365.25]),  # two exposures of one epoch, another years later
        ([2015.5, 2015.5, 2015.5 + 1 / 365.25], "days", [0, 0, 1]),
        ([2015.5, 2015.5, 2015.5], "exposures", [0, 1, 2]),  # of one night, by their dates
    ],
)
def test_times_of_exposures_that_share_an_epoch(epochs, unit, days):
    times, found = Matches.from_table(table(np.array(epochs)), shape=(1000, 1000)).times
    assert found == unit
    np.testing.assert_allclose(times, days, atol=1e-3)
