"""Catalogues with the columns of SCAMP as a reference."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from numpy.testing import assert_allclose

from legdistort.exceptions import InputError
from legdistort.inputs.references.catalogue import read_reference

MAS = u.mas.to(u.deg)
UNFITTED = ("PMALPHA_J2000", "PMDELTA_J2000", "PMALPHAERR_J2000", "PMDELTAERR_J2000")


def written(path, names=("ALPHA_J2000", "DELTA_J2000", "EPOCH"), motion=(0.0, 0.0)):
    """A file with ellipses of 3 by 1 mas, 0, 90 and 30 degrees from east to north; of one star a motion is known."""
    table = QTable({names[0]: [150.0, 150.01, 150.02] * u.deg, names[1]: [2.0, 2.01, 2.02] * u.deg})
    for name, values in (("ERRA_WORLD", [3.0] * 3), ("ERRB_WORLD", [1.0] * 3)):
        table[name] = np.array(values) * MAS * u.deg
    table["ERRTHETA_WORLD"] = [0.0, 90.0, 30.0] * u.deg
    for name, value in zip(UNFITTED, (*motion, *np.abs(motion)), strict=True):
        table[name] = [0, 0, value] * u.mas / u.yr
    table[names[2]] = [2026.9] * 3 * u.yr
    table.write(path)
    return path


@pytest.mark.parametrize("names", [("ALPHA_J2000", "DELTA_J2000", "EPOCH"), ("X_WORLD", "Y_WORLD", "OBSDATE")])
def test_the_ellipse_of_errors(names, tmp_path):
    known = read_reference(written(tmp_path / "merged_1.fits", names))
    assert_allclose(known.sky, [[150, 2], [150.01, 2.01], [150.02, 2.02]])
    along = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    across = np.array([-along[1], along[0]])
    expected = [np.diag([9, 1]), np.diag([1, 9]), 9 * np.outer(along, along) + np.outer(across, across)]
    assert_allclose(known.covariance, expected, atol=1e-9)
    assert known.motion is None
    assert_allclose(known.epoch, 2026.9)


def test_motions_that_were_not_fitted_are_unknown(tmp_path):
    known = read_reference(written(tmp_path / "merged_1.fits", motion=(-4.0, 2.0)))
    assert np.isnan(known.motion[:2]).all()
    assert_allclose(known.motion[2], [-4, 2])


def test_an_error_of_nothing_names_its_cure(tmp_path):
    table = QTable({"ra": [150.0] * u.deg, "dec": [2.0] * u.deg, "ra_error": [1.0] * u.mas, "dec_error": [0.0] * u.mas})
    with pytest.raises(InputError, match="dec_error must be positive, got 0 in row 0; one not known is NaN, or empty"):
        read_reference(table)


@pytest.mark.parametrize("unknown", [[0.0, 0.0, 0.0], [0.0, 1761.6, 2024.1], [0.0, np.nan, 2024.1]])
def test_epochs_that_scamp_does_not_know_count_as_none(tmp_path, unknown):
    """It writes 0 for stars that it has once, and means of years with zeros."""
    table = QTable.read(written(tmp_path / "known.fits"))
    table["EPOCH"] = unknown * u.yr
    table.write(tmp_path / "merged_1.fits")
    known = read_reference(tmp_path / "merged_1.fits")
    assert len(known) == 3
    if np.max(unknown) == 0:
        assert known.epoch is None
    else:
        np.testing.assert_array_equal(known.epoch, [np.nan, np.nan, 2024.1])
        assert_allclose(known.at(2024.1, moving=True).sky, [[150.02, 2.02]])


def test_motions_without_an_epoch_are_left_out_by_count(caplog):
    caplog.set_level("INFO")
    rows = {
        "ra": [150.0, 150.01, 150.02] * u.deg,
        "dec": [2.0, 2.01, 2.02] * u.deg,
        "ref_epoch": [0, 2016, np.nan] * u.yr,
    }
    places = {f"{name}_error": [1.0] * 3 * u.mas for name in ("ra", "dec")}
    motions = {name: [1.0] * 3 * u.mas / u.yr for name in ("pmra", "pmdec", "pmra_error", "pmdec_error")}
    known = read_reference(QTable(rows | places | motions))
    assert_allclose(known.sky, [[150.01, 2.01]])
    assert "2 of 3 stars are left out, whose motions have no epoch" in caplog.text
    rows["ref_epoch"] = [0, 57388.5, np.nan] * u.yr
    with pytest.raises(InputError, match=r"ref_epoch must be the years .* got 57388.5 in row 1, and no year in any"):
        read_reference(QTable(rows | places | motions))
