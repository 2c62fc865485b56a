"""Lists that know nothing of bad columns: half of their rows are no stars, and stand on the detector."""

import logging

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table, vstack

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.exceptions import MatchError
from legdistort.matching.exposure_groups import Group, standing
from legdistort.matching.star_lists import StarList

SIDE, SIGMA = 500, 0.02
#: Where the columns lie, and from which row to which.
COLUMNS = ((101, 0, 500), (102, 0, 500), (311, 150, 500), (420, 0, 300))
DITHERS = np.array([[0, 0], [22, 5], [-20, 8], [6, -24], [15, 18], [-17, -15]])


def lists(seed, axis=0, n_stars=90):
    """By exposure: stars, of which 70 % are found, by number, and 60 detections on columns, or rows, of number -1."""
    rng = np.random.default_rng(seed)
    stars, bright, out = rng.uniform(-30, SIDE + 30, (n_stars, 2)), rng.pareto(1.5, n_stars) + 1, []
    for k, dither in enumerate(DITHERS):
        xy = stars - dither + rng.normal(0, SIGMA, stars.shape)
        found = np.flatnonzero(((xy > 3) & (xy < SIDE - 4)).all(axis=1) & (rng.random(n_stars) < 0.7))
        where = np.array([COLUMNS[i] for i in rng.integers(0, len(COLUMNS), 60)])
        junk = np.column_stack([where[:, 0] + rng.uniform(-0.4, 0.4, 60), rng.uniform(where[:, 1], where[:, 2] - 1)])
        xy = np.concatenate([xy[found], junk[:, ::-1] if axis else junk])
        flux = np.concatenate([bright[found], rng.pareto(1.5, 60) + 2])
        out.append(table(f"e{k}", xy, flux, np.append(found, np.full(60, -1))))
    return out


def table(exposure, xy, flux, true):
    out = Table({"x": xy[:, 0], "y": xy[:, 1], "flux": flux, "true": true})
    out["x_err"] = out["y_err"] = SIGMA
    out["exposure"] = exposure
    return out


def weights():
    out = np.ones((SIDE, SIDE), dtype="f4")
    for x, low, high in COLUMNS:
        out[low:high, x] = 0
    return out


def assert_stars(true, star):
    """Every star has one number, and nothing else has any."""
    pairs = np.unique(np.column_stack([true, star]), axis=0)
    assert np.all(true >= 0), f"{np.count_nonzero(true < 0)} rows of bad columns became stars"
    assert len(pairs) == len(np.unique(true)) == len(np.unique(star))


@pytest.mark.parametrize("axis", [0, 1])
def test_columns_and_rows_that_stand_still_are_no_stars(axis, caplog):
    caplog.set_level(logging.INFO)
    matches = ld.match(vstack(lists(1, axis)), shape=(SIDE, SIDE), min_exposures=3)
    assert len(matches.names) == len(DITHERS)
    assert len(matches.stars) > 50
    assert_stars(np.asarray(matches.table["true"]), np.asarray(matches.table["star"]))
    (said,) = [text for text in caplog.messages if "hot pixels or bad columns, not used" in text]
    assert 0.9 * 60 * len(DITHERS) < int(said.split()[0]) <= 61 * len(DITHERS)


def test_detections_in_rows_and_columns_stay():
    """Of a lattice moved by whole periods, a fifth seen at a time, lines of the detector are lines of the sky."""
    rng = np.random.default_rng(2)
    grid = np.array(list(np.ndindex(32, 32)), dtype=float) * 30 + 15
    poses = {i: np.column_stack([np.eye(2), 30.0 * rng.integers(-3, 4, 2)]) for i in range(9)}
    seen = [grid[rng.random(len(grid)) < 0.2] for _ in poses]
    stars = [StarList(xy, np.full(len(xy), SIGMA), (1000, 1000)) for xy in seen]
    still = standing(stars, Group(poses, {}))
    assert np.mean(np.concatenate(still)) < 0.1


@pytest.mark.slow
def test_rows_without_weight_in_the_frames_are_left_out(tmp_path, capsys):
    """Two exposures: too few to see what stands still."""
    paths, rng = [], np.random.default_rng(4)
    for table, dither in zip(lists(3)[:2], DITHERS, strict=False):
        path = tmp_path / f"{table['exposure'][0]}.fits"
        cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 150.0, "CRVAL2": 2.0, "CUNIT1": "deg",
                 "CUNIT2": "deg", "CDELT1": -0.3 / 3600, "CDELT2": 0.3 / 3600, "CRPIX1": 250.5 - dither[0],
                 "CRPIX2": 250.5 - dither[1]}  # fmt: skip
        fits.writeto(path, rng.normal(100, 5, (SIDE, SIDE)).astype("f4"), fits.Header(cards))
        fits.writeto(path.with_suffix(".weight.fits"), weights())
        paths.append(path)
        del table["exposure"]
        table.write(path.with_suffix(".ecsv"))
    words = [*(str(path.with_suffix(".ecsv")) for path in paths), "--wcs", *map(str, paths), "--min-exposures", "2"]
    assert main(["match", *words, "--out", str(tmp_path / "m.ecsv")]) == 0
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "lie on bad pixels of the frames" in line]
    n = sum(np.count_nonzero(Table.read(path)["true"] < 0) for path in tmp_path.glob("e?.ecsv"))
    assert n <= int(said.split()[0]) < n + 5
    found = Table.read(tmp_path / "m.ecsv")
    assert_stars(np.asarray(found["true"]), np.asarray(found["star"]))
    assert main(["match", *words, "--weight-maps", "none", "--out", str(tmp_path / "n.ecsv")]) == 0
    assert "lie on bad pixels" not in capsys.readouterr().err


def test_where_every_row_lies_on_a_flag_the_cure_is_named():
    found, flags = lists(5)[0], np.ones((SIDE, SIDE), dtype=bool)
    flags[found["y"].astype(int).max() + 2 :] = False
    frame = ld.Exposure("e0", np.random.default_rng(1).normal(100, 5, (SIDE, SIDE)), mask=flags)
    with pytest.raises(MatchError, match=r"--dq-good"):
        ld.match(found, exposures=[frame])
    found["crowding"] = 0.0  # measured here: it knew of the flags
    assert len(ld.match(found, exposures=[frame]).table) == len(found)
