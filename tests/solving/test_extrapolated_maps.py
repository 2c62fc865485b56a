"""An exposure whose map few stars hold: it is named, with its error, and what is advised cures it."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import legdistort as ld
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.results.check import Check
from legdistort.solving.checks import extrapolated_maps
from legdistort.wcs import attachment
from legdistort.wcs.attachment import attach

SIDE, NOISE = 1024, 0.02


def night(far, *, n=6, seed=1, sky=None):
    """Matches of n exposures dithered by a little and of one `far` [px] beside them, from numpy alone.

    Every exposure has a distortion of degree 3 of its own; stars stand everywhere that an exposure sees.
    """
    rng = np.random.default_rng(seed)
    places = rng.uniform(-SIDE, 3 * SIDE, (1600, 2))
    shifts = [*rng.uniform(-40, 40, (n, 2)), np.array([far, 0.0])]
    static = rng.normal(0, 1.0, (4, 4, 2))
    rows, poses = [], {}
    for i, shift in enumerate(shifts):
        q = places - shift
        z = 2 * (q + 0.5) / SIDE - 1
        terms = static + rng.normal(0, 0.2, (4, 4, 2))
        terms[np.add.outer(np.arange(4), np.arange(4)) > 3] = 0
        terms[0, 0] = 0
        xy = q + np.stack([np.polynomial.legendre.legval2d(*z.T, terms[..., axis]) for axis in (0, 1)], axis=1)
        seen = np.flatnonzero(((q > 0) & (q < SIDE - 1) & (xy > 0) & (xy < SIDE - 1)).all(axis=1))
        rows += [(f"s{j}", f"e{i}", *(xy[j] + rng.normal(0, NOISE, 2))) for j in seen]
        poses[f"e{i}"] = np.column_stack([np.eye(2), -shift])
    table = Table(rows=rows, names=("star", "exposure", "x", "y"))
    star, count = np.unique(table["star"], return_counts=True)
    table = table[np.isin(table["star"], star[count > 1])]
    table["x_err"] = table["y_err"] = NOISE
    return ld.Matches.from_table(table, shape=(SIDE, SIDE), poses=poses, sky=sky)


def extrapolation(solution):
    return next(check for check in solution.checks if check.name == "extrapolation")


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.AssumptionWarning")
def test_a_map_that_a_strip_of_stars_holds_is_named_with_a_cure_that_cures():
    matches = night(700.0)
    check = extrapolation(solution := ld.solve(matches))
    _, _, sigma = solution["e6"].sigma_map(n=16, support=False)
    assert check.state == "warn"
    assert "hardly determined over a good part of the frame" in check.sentence
    assert ": e6 (error up to" in check.sentence
    assert check.value > 10 * NOISE
    assert abs(check.value / np.nanmax(sigma) - 1) < 0.6  # corners are a little farther out
    assert "(--without e6)" in check.cure
    keep = matches.table["exposure"] != "e6"
    assert extrapolation(ld.solve(matches.keep(keep))).state == "pass"


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.AssumptionWarning")
def test_half_an_overlap_is_no_fault():
    assert extrapolation(ld.solve(night(250.0))).state == "pass"


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.AssumptionWarning")
def test_attach_says_it_in_one_line(tmp_path, caplog):
    plane = TangentPlane(85.0, -70.0, np.array([[-2e-5, 0, 0.01], [0, 2e-5, -0.01]]))
    for far, name, told in ((700.0, "e6", 1), (700.0, "e0", 0), (250.0, "e6", 0)):  # of the frames attached alone
        solution = ld.solve(night(far, sky=plane))
        fits.writeto(tmp_path / f"{name}.fits", np.zeros((SIDE, SIDE), "float32"), overwrite=True)
        caplog.clear()
        attach(solution, [tmp_path / f"{name}.fits"], out=tmp_path / f"out{far:.0f}{name}")
        lines = [record.getMessage() for record in caplog.records if "hardly determined" in record.getMessage()]
        assert len(lines) == told
        assert all("e6 (error up to" in line and line.endswith("that is so in their WCSs too") for line in lines)


def test_a_check_is_of_the_exposures_that_it_names():
    check = Check("extrapolation", "warn", 1.0, 0.5, "", exposures=("e6-1", "n.2"))
    assert check.doubts({"e0", "n.2"})
    assert not check.doubts({"e6", "1", "nx2", "e0"})
    assert not Check("degree", "warn", 1.0, 0.5, "").doubts({"e0"})
    assert Check("reference", "fail", 1.0, 0.5, "").doubts({"e0"})


def test_attach_names_the_checks_that_fail():
    told = attachment._untrusted([Check(name, "fail", 2.0, 1.0, "") for name in ("reference", "time")], {"e0"})
    words = "these WCSs may be off by more than their errors say: the solution fails the checks reference, time"
    assert list(told) == [words]


@pytest.mark.parametrize(("dynamic", "whole"), [("detector", "e6"), (None, "e6-H2RG-1")])
def test_of_single_detectors_the_whole_exposure_is_left_out(dynamic, whole):
    rows = Table({"exposure": ["e5-2", "e6-H2RG-1"], "detector": ["2", "H2RG-1"]})
    solution = SimpleNamespace(settings=SimpleNamespace(dynamic=dynamic), residuals=rows)
    assert extrapolated_maps._whole(solution, "e6-H2RG-1") == whole
