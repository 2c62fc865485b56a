"""Every star measured in all exposures at once, against frames made without the package."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table, vstack
from deep_frames import (
    SIGMA,
    SKY,
    artificial_inside,
    compared,
    deep_frames,
    excess,
    flux_level,
    light,
    with_galaxies,
    with_hits,
)
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

import legdistort as ld
from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.detection import Frame
from legdistort.measurement.flags import Flag
from legdistort.measurement.injection import distant
from legdistort.measurement.scene.joint_fit import Scene
from legdistort.measurement.scene.normal_equations import neighbour_covariance
from legdistort.photometry.agreement import catalogue_check
from legdistort.photometry.artificial_stars import flux_bias, matched
from legdistort.photometry.measuring import judged

TRANSMISSION = np.array([1.0, 0.8, 1.1, 1.0, 0.9, 1.2, 1.0, 0.7])


def exposures_of(truth):
    return [Exposure(f"f{k:02d}", data, gain=1.0) for k, data in enumerate(truth.frames)]


def solved(truth, *, wrong=0.0):
    """Solution; the brightest star of the third frame measured wrong by some pixels."""
    exposures = exposures_of(truth)
    matches = ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures)
    table = matches.table.copy()
    rows = np.flatnonzero(table["exposure"] == "f02")
    table["x"][rows[np.argmax(table["flux"][rows])]] += wrong * table["x"].unit
    return ld.solve(replace(matches, table=table), degree=3)


def beside_truth(truth, solution, stars, **options):
    start = np.full_like(truth.xy, np.nan)
    inside = ((truth.pixels[0] > 0) & (truth.pixels[0] < truth.frames[0].shape[0] - 1)).all(axis=1)
    start[inside] = solution["f00"].correct(truth.pixels[0][inside])
    return compared(truth, stars, start, **options)


@pytest.fixture(scope="module")
def truth():
    return deep_frames(3, size=320, n_stars=230, n_frames=8, transmission=TRANSMISSION)


@pytest.fixture(scope="module")
def solution(truth):
    return solved(truth, wrong=3.0)


@pytest.fixture(scope="module")
def found(truth, solution):
    return ld.catalogue(exposures_of(truth), solution, zero_point=25.0)


def test_stars_that_no_frame_shows_are_found(truth, solution, found):
    c = beside_truth(truth, solution, found.stars)
    assert len(found.stars) > 1.5 * len(solution.stars)
    assert c.found(7) >= 0.97
    assert c.n_false <= 1
    over_bound, pull = c.ratios(8)
    assert over_bound < 1.3
    assert 0.75 < pull < 1.35
    assert found.stars.meta["noise_peaks"] < 0.1
    assert not np.any(found.stars["flags"] & Flag.EXTENDED)


def test_fluxes_of_single_exposures_scatter_as_stated(truth, solution, found):
    """One flux for all, a flux each: differences are noise; transmissions are those put in."""
    zero = found.photometry.meta["zero_points"]
    level = np.array([each["magnitude"] for each in zero.values()])
    true = 2.5 * np.log10(truth.transmission)
    error = np.array([each["error"] for each in zero.values()])
    off = (level - level.mean()) - (true - true.mean())
    assert np.all(np.abs(off) < 4 * error + 0.005)
    mean = dict(zip(found.stars["star"], found.stars["flux"], strict=True))
    rows = found.photometry
    share = np.sqrt(1 - 1 / len(truth.frames))  # of its noise that differs from the mean
    pull = (rows["flux"] - [mean[star] for star in rows["star"]]) / rows["flux_err"] / share
    assert 0.85 < 1.4826 * np.median(np.abs(pull)) < 1.1
    assert np.any(rows["flux"] < 0)  # what is negative stays
    faint = found.stars["snr"] < 20
    expected = found.stars["flux_err"] * np.sqrt(found.stars["n"])
    assert np.median((found.stars["flux_scatter"] / expected)[faint]) == pytest.approx(1, abs=0.25)


def test_stars_of_the_solution_keep_their_numbers(solution, found):
    known = {name: row for row, name in enumerate(solution.stars["star"])}
    same = [row for row, name in enumerate(found.stars["star"]) if name in known]
    assert len(same) >= 0.97 * len(known)
    assert len(set(found.stars["star"])) == len(found.stars)
    assert found.stars.meta["n_new"] == len(found.stars) - len(same)
    theirs = solution.stars[[known[found.stars["star"][row]] for row in same]]
    off = np.hypot(found.stars["x"][same] - theirs["x"], found.stars["y"][same] - theirs["y"])
    error = np.hypot(theirs["x_err"], theirs["y_err"])
    assert np.median(off / error) < 1
    new = [int(name) for name in found.stars["star"] if name not in known]
    assert min(new) > max(known)
    assert list(found.stars["mag"]) == list(25 - 2.5 * np.log10(found.stars["flux"]))


@pytest.mark.slow
def test_a_star_without_a_position_in_the_solution_is_a_new_one(truth, solution, found):
    """All its observations were left out, say."""
    positions = solution.estimate.positions.copy()
    positions[3] = np.nan
    lost = replace(solution, estimate=replace(solution.estimate, positions=positions))
    again = ld.catalogue(exposures_of(truth), lost, zero_point=25)
    name = solution.estimate.star_names[3]
    assert name not in again.stars["star"]
    assert again.stars.meta["n_new"] == found.stars.meta["n_new"] + 1
    there = found.stars[found.stars["star"] == name]
    assert np.hypot(again.stars["x"] - there["x"], again.stars["y"] - there["y"]).min() < 0.5 * there["x_err"][0]


def test_stars_that_the_solution_has_elsewhere_are_flagged(truth, solution, found):
    """Those of three frames, one of which the solution has beside its place; the others are where they were."""
    assert found.check.state == "pass"
    assert found.stars.meta["n_known"] > 0.9 * len(solution.stars)
    before = found.stars.meta["displaced"]
    assert len(before) <= 1  # a blend that no single exposure shows
    estimate = solution.estimate
    bright = next(
        k for k, name in enumerate(estimate.star_names) if name in found.stars["star"][:20] and name not in before
    )
    moved = estimate.positions.copy()
    moved[bright] += [0.3, -0.3]
    wrong = replace(solution, estimate=replace(estimate, positions=moved))
    other = ld.catalogue(exposures_of(truth)[:3], wrong, threshold=9)
    rows = (other.stars["flags"] & Flag.DISPLACED) > 0
    displaced = other.stars.meta["displaced"]
    assert set(other.stars["star"][rows]) == set(displaced)
    assert estimate.star_names[bright] in displaced
    assert len(displaced) <= 2
    assert f"{len(displaced)} of {other.stars.meta['n_known']} stars lie more than 5 errors" in str(other)


@pytest.mark.parametrize(("displaced", "state"), [(0, "pass"), (3, "pass"), (9, "warn"), (30, "fail")])
def test_too_many_of_them_are_no_chance(displaced, state):
    stars = Table(meta={"n_known": 100, "displaced": list(range(displaced))})
    check = catalogue_check(stars)
    assert (check.name, check.state, check.value) == ("catalogue", state, displaced / 100)
    assert catalogue_check(Table()).state == "unknown"


def test_an_image_that_the_solution_left_out_does_not_tell_where_a_star_is(solution, found):
    rows = solution.residuals[~solution.residuals["used"]]
    assert set(rows["exposure"]) == {"f02"}
    without = found.stars[found.stars["n_left_out"] > 0]
    assert len(without) >= 1
    assert set(without["star"]) <= set(rows["star"])  # some are beyond the stars that determine the map of this frame
    assert np.all(without["n_left_out"] == 1)
    assert np.all(without["n"] > 4)  # their fluxes count there


@pytest.mark.slow
def test_an_exposure_that_is_not_in_the_solution_is_left_out_by_name(truth, solution):
    few = exposures_of(truth)[:3]
    strange = replace(few[2], name="strange", exposure="strange")
    with pytest.warns(AssumptionWarning, match="left out of the catalogue: strange: it is not in the solution"):
        found = ld.catalogue([*few[:2], strange], solution, threshold=7)
    assert found.stars.meta["n_images"] == 2
    assert set(found.left_out) == {"strange"}


def test_bad_arguments_are_named(truth, solution):
    exposures = exposures_of(truth)
    with pytest.raises(InputError, match=r"call catalogue\(exposures, solution\)"):
        ld.catalogue(solution, exposures)
    with pytest.raises(InputError, match="threshold must be a number of at least 2"):
        ld.catalogue(exposures, solution, threshold=1)
    with pytest.raises(InputError, match="zero_point must be a finite magnitude, got nan"):
        ld.catalogue(exposures, solution, zero_point=float("nan"))
    with pytest.raises(InputError, match="no exposure to measure"):
        ld.catalogue([], solution)
    with pytest.raises(InputError, match="artificial must be a positive integer, got 0"):
        ld.catalogue(exposures, solution, artificial=0)
    with pytest.raises(InputError, match="seed must be an integer, 0 or above, got -1"):
        ld.catalogue(exposures, solution, artificial=5, seed=-1)
    with pytest.raises(InputError, match="leave artificial or positions out"):
        ld.catalogue(exposures, solution, artificial=5, positions=Table({"x": [9.0], "y": [9.0]}))


def test_what_one_exposure_alone_shows_is_no_star():
    """Constant, a hit of one exposure, a flare that two confirm, a faint one, one that two see, a hit on a star."""
    rng = np.random.default_rng(1)
    flux, error = 2 + rng.normal(0, 1, (11, 6)), np.ones((11, 6))
    flux[6, 5] = 12
    flux[:, 1] -= 2
    flux[4, 1] = 30
    flux[:, 2] -= 1
    flux[[2, 3], 2] = 9
    error[2:, 4], flux[:2, 4] = np.inf, (9, 2)
    mean = np.array([np.average(f, weights=1 / e**2) for f, e in zip(flux.T, error.T, strict=True)])
    lone, varying, spoiled = judged(flux, error, mean, mean * np.sqrt((1 / error**2).sum(axis=0)), 5.0)
    assert lone.tolist() == [False, True, False, False, False, False]
    assert varying.tolist() == [False, False, True, False, False, False]
    assert np.argwhere(spoiled).tolist() == [[6, 5]]


def test_what_no_exposure_sees_has_no_row(truth, solution):
    """A bright star beyond the stars that determined the maps, whose wings alone lie where they count."""
    exposures, view = exposures_of(truth)[:1], solution["f00"]
    shape = truth.frames[0].shape
    pixels = np.stack(np.indices(shape)[::-1], axis=-1).reshape(-1, 2).astype(float)
    away = distance_transform_edt(~view.supported(pixels).reshape(shape))
    y, x = np.unravel_index(np.argmin(np.abs(away - 2 * 2.3548 * SIGMA)), shape)
    columns, rows = (np.arange(max(c - 20, 0), min(c + 21, n)) for c, n in zip((x, y), shape[::-1], strict=True))
    exposures[0].data[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += 3e5 * light((x, y), columns, rows)[0]
    out = ld.catalogue(exposures, solution)
    assert out.stars["n"].min() == 1
    assert set(out.stars["star"]) == set(out.photometry["star"])
    assert len(out.stars) > 20
    place = view.correct([[float(x), float(y)]])
    with pytest.raises(InputError, match="no exposure shows one of the positions"):
        ld.catalogue(exposures, solution, positions=Table({"x": place[:, 0], "y": place[:, 1]}))


@pytest.mark.slow
def test_a_hit_on_a_faint_star_is_left_out(truth, solution, found):
    """And a flash of one exposure; a star that brightens in two varies; what one of them alone shows is none."""
    frames = [frame.copy() for frame in truth.frames]
    start = np.full_like(truth.xy, np.nan)
    inside = ((truth.pixels > 60) & (truth.pixels < 260)).all(axis=(0, 2))
    start[inside] = solution["f00"].correct(truth.pixels[0][inside])
    apart = np.hypot(*(truth.xy[:, None] - truth.xy).T) + 99 * np.eye(len(truth.xy))
    faint = np.flatnonzero(inside & (truth.snr > 9) & (truth.snr < 18) & (apart.min(axis=0) > 8))[:4]
    (hit, other, *_), (variable, *_) = faint[:2], faint[2:]
    x, y = np.round(truth.pixels[4, other]).astype(int)
    frames[4][y, x + 1] += 400  # 40 times the noise
    for star, k, flux in ((hit, 4, 1500), (variable, 2, 700), (variable, 5, 700)):
        x, y = truth.pixels[k, star]
        columns, rows = (np.arange(round(c) - 8, round(c) + 9) for c in (x, y))
        frames[k][rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += flux * light((x, y), columns, rows)[0]
    frames[1][100, 100], frames[6][200, 150] = 3e3, 3e3
    again = ld.catalogue(exposures_of(replace(truth, frames=frames)), solution, zero_point=25.0)

    def row(stars, star):
        away = np.hypot(stars["x"].value - start[star, 0], stars["y"].value - start[star, 1])
        assert away.min() < 2
        return stars[np.argmin(away)]

    assert abs(len(again.stars) - len(found.stars)) <= 1
    for star in (hit, other):
        one, its = row(again.stars, star), row(found.stars, star)
        assert abs(one["flux"] - its["flux"]) < 1.5 * one["flux_err"]
        assert np.hypot(one["x"] - its["x"], one["y"] - its["y"]) < 1.5 * one["x_err"]
        assert not one["flags"] & Flag.VARIABLE
        images = again.photometry[again.photometry["star"] == one["star"]]
        assert set(images["exposure"][(images["flags"] & Flag.DEFECT) > 0]) == {"f04"}
    assert row(again.stars, variable)["flags"] & Flag.VARIABLE


def rows_of(truth, solution, found, *, above=3.0):
    """Rows that lie within a FWHM of a true star of some signal-to-noise ratio of all frames, in the first frame."""
    xy = solution["f00"].distort(np.column_stack([found.stars["x"].value, found.stars["y"].value]))
    return cKDTree(truth.pixels[0][truth.snr > above]).query(xy)[0] < 2.3548 * SIGMA


@pytest.mark.parametrize("n", [1, 2])
def test_where_few_exposures_see_them_pixels_tell_stars_from_hits(truth, solution, n):
    """Tracks of particles through one exposure or two: other exposures cannot tell."""
    rng = np.random.default_rng(9)
    hit = replace(truth, frames=[with_hits(rng, frame.astype(float), 0.003) for frame in truth.frames[:n]])
    clean, other = (ld.catalogue(exposures_of(each)[:n], solution) for each in (truth, hit))
    ours, theirs = (rows_of(truth, solution, each) for each in (clean, other))
    assert np.count_nonzero(~theirs) <= 1
    assert other.stars.meta["n_rejected"] >= 3
    assert np.count_nonzero(theirs) >= 0.95 * np.count_nonzero(ours)


@pytest.mark.slow
def test_a_galaxy_is_one_row(truth, solution, found):
    """Exponential discs that would be taken apart into four to eight stars; the stars stay what they are."""
    start = np.full_like(truth.xy, np.nan)
    inside = ((truth.pixels[0] > 0) & (truth.pixels[0] < 319)).all(axis=1)
    start[inside] = solution["f00"].correct(truth.pixels[0][inside])
    rng = np.random.default_rng(4)
    places = rng.uniform(50, 270, (4000, 2))
    places = places[cKDTree(truth.xy[truth.snr > 4]).query(places)[0] > 11]
    places = places[distant(places, 60, 4)]
    assert len(places) == 4
    radius = np.array([1.2, 2.2, 3.5, 2.2])
    frames = with_galaxies(truth, places, [100, 100, 100, 50], radius)
    other = ld.catalogue(exposures_of(replace(truth, frames=frames)), solution)
    c = compared(truth, other.stars, start)
    xy = np.column_stack([other.stars["x"].value, other.stars["y"].value]) - c.shift
    extended = (other.stars["flags"] & Flag.EXTENDED) > 0
    level = flux_level(truth, c, other.stars) * SKY * np.sqrt(4 * np.pi) * SIGMA
    for place, r, s in zip(places, radius, [100, 100, 100, 50], strict=True):
        near = np.hypot(*(xy - place).T) < 3 * np.hypot(2, r)
        assert np.count_nonzero(near & extended) == 1
        assert np.count_nonzero(near) <= 2
        row = other.stars[near & extended]
        assert 0.75 < row["flux"][0] / (s * level) < 1.1
        assert np.hypot(*(xy[near & extended] - place)[0]) < 0.8
        assert row["chi2_dof"][0] < 1.5
    assert np.count_nonzero(extended) == 4
    assert abs(len(other.stars) - 4 - len(found.stars)) <= 2
    assert c.found(7) >= 0.97


@pytest.mark.parametrize("k", [1, 3])
def test_covariances_are_those_of_the_whole_matrix(k):
    """Where stars have few neighbours, those of the dense inverse."""
    from scipy.sparse import csc_array

    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 60, (25, 2))
    apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    near = np.exp(-((apart / 3) ** 2)) * (apart < 6)
    blocks = rng.normal(size=(k, k))
    normal = np.kron(near + 0.2 * np.eye(25), blocks @ blocks.T + np.eye(k))
    dense = np.linalg.inv(normal).reshape(25, k, 25, k)[np.arange(25), :, np.arange(25)]
    np.testing.assert_allclose(neighbour_covariance(csc_array(normal), xy, 6.0), dense, rtol=0.02, atol=1e-6)


def written(frames, solution, folder):
    """Paths of frames that are written to a folder, beside ``solution.asdf``."""
    paths = []
    for k, data in enumerate(frames):
        paths.append(str(folder / f"f{k:02d}.fits"))
        fits.PrimaryHDU(data, fits.Header([("GAIN", 1.0)])).writeto(paths[-1])
    solution.write(folder / "solution.asdf")
    return paths


def test_files_and_command(truth, solution, tmp_path, capsys):
    paths = written(truth.frames[:4], solution, tmp_path)
    out = tmp_path / "catalogue.ecsv"
    call = ["catalogue", *paths, "--solution", str(tmp_path / "solution.asdf"), "--out", str(out), "--threshold", "7"]
    assert main(call) == 0
    printed = capsys.readouterr().out
    assert "peaks of noise are expected" in printed
    stars, photometry = (QTable.read(tmp_path / name) for name in ("catalogue.ecsv", "photometry.ecsv"))
    assert len(stars) > 20
    assert set(photometry["star"]) == set(stars["star"])
    assert main(call) == 1
    assert "catalogue.ecsv exists already; give --overwrite" in capsys.readouterr().err
    out.unlink()
    assert main(call) == 1
    assert "photometry.ecsv exists already; give --overwrite" in capsys.readouterr().err
    assert not out.exists()
    (tmp_path / "photometry.ecsv").unlink()
    assert main([*call[:-3], str(tmp_path / "photometry.ecsv")]) == 1
    assert "give the catalogue another" in capsys.readouterr().err


@pytest.mark.slow
def test_pixels_on_the_disk_give_the_same_catalogue(truth, solution, found, tmp_path, monkeypatch):
    """Bit for bit; nothing is left behind."""
    monkeypatch.setattr(ld.photometry.catalogue, "_IN_MEMORY", 0)
    other = ld.catalogue(exposures_of(truth), solution, zero_point=25.0, scratch=tmp_path)
    for one, same in ((found.stars, other.stars), (found.photometry, other.photometry)):
        assert one.meta == same.meta
        for name in one.colnames:
            np.testing.assert_array_equal(np.asarray(one[name]), np.asarray(same[name]))
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="no scratch folder can be made"):
        ld.catalogue(exposures_of(truth), solution, scratch=tmp_path / "none")


@pytest.mark.parametrize(
    "sides",
    [
        pytest.param({"_BLOCK": 61, "_SMALL": 37}, marks=pytest.mark.slow),
        pytest.param({"_WORTH": 0}, marks=pytest.mark.sets),
        pytest.param({"_AROUND": 6.0}, marks=pytest.mark.sets),
    ],
)
def test_a_catalogue_does_not_depend_on_the_blocks_that_are_searched(truth, solution, found, monkeypatch, sides):
    """Smaller ones, always all of them, more around what has changed: to a thousandth of an error."""
    for name, value in sides.items():
        monkeypatch.setattr(ld.photometry.joint_scene, name, value)
    other = ld.catalogue(exposures_of(truth), solution, zero_point=25.0)
    assert list(other.stars["star"]) == list(found.stars["star"])
    for name in ("x", "y", "flux"):
        np.testing.assert_array_less(np.abs(other.stars[name] - found.stars[name]), 1e-3 * found.stars[f"{name}_err"])


@pytest.mark.slow
def test_fluxes_at_given_places(truth, solution, found):
    """Of stars too faint to be found and of empty sky as their errors state; of bright ones as they are."""
    rng, pixels = np.random.default_rng(5), truth.pixels[0]
    apart = np.hypot(*(pixels[:, None] - pixels).T) + 99 * np.eye(len(pixels))
    alone = np.flatnonzero(((pixels > 8) & (pixels < 312)).all(axis=1) & (apart.min(axis=0) > 6))
    supported = solution["f00"].supported(pixels)
    faint, bright = alone[(truth.snr[alone] < 4) & supported[alone]], alone[truth.snr[alone] > 40][:8]
    empty = rng.uniform(20, 300, (400, 2))
    empty = empty[solution["f00"].supported(empty)]
    empty = empty[np.hypot(*(pixels[:, None] - empty).T).T.min(axis=0) > 6][:40]
    xy = solution["f00"].correct(np.vstack([truth.pixels[0][bright], truth.pixels[0][faint], empty]))
    names = [f"s{k}" for k in range(len(xy))]
    given = Table({"star": names, "x": xy[:, 0], "y": xy[:, 1]})
    out = ld.catalogue(exposures_of(truth), solution, zero_point=25.0, positions=given)
    assert out.stars["star"].tolist() == names
    np.testing.assert_allclose(out.stars["x"].value, xy[:, 0])
    b, n = len(bright), len(bright) + len(faint)
    ratio = np.asarray(out.stars["flux"][:b]) / truth.flux[bright]
    level = np.median(ratio)
    assert np.std(ratio / level) < 0.03
    true = level * np.concatenate([truth.flux[faint], np.zeros(len(empty))])
    pull = (np.asarray(out.stars["flux"][b:]) - true) / np.asarray(out.stars["flux_err"][b:])
    assert 0.75 < np.sqrt(np.mean(pull[: len(faint)] ** 2)) < 1.35
    assert 0.7 < np.sqrt(np.mean(pull[len(faint) :] ** 2)) < 1.35
    assert abs(np.mean(pull[len(faint) :])) < 0.6
    assert np.any(out.stars["flux"][n:] < 0)
    assert np.mean(out.stars["flux_limit"][b:] > true) > 0.97
    assert np.isnan(out.stars["mag"][n:][out.stars["flux"][n:] < 0]).all()
    one = out.photometry[out.photometry["star"] == names[0]]
    mean = np.sum(one["flux"] / one["flux_err"] ** 2) / np.sum(one["flux_err"] ** -2.0)
    assert mean == pytest.approx(out.stars["flux"][0], rel=1e-3)
    assert repr(out) == f"<Catalogue: {len(xy)} given positions in 8 images>"


def test_places_that_cannot_be_measured_are_named(truth, solution, tmp_path):
    exposures = exposures_of(truth)[:3]
    for table, words in (
        (Table({"x": [10.0, np.nan], "y": [5.0, 6.0]}), r"position of star 1 \(row 1\) is not finite"),
        (Table({"star": ["a", "a"], "x": [10.0, 20], "y": [5.0, 6]}), "a name in column star stands twice"),
        (Table({"ra": [10.0], "dec": [5.0]}), r"no columns x, y \(the solution does not know the sky"),
        (Table({"x": [9e5], "y": [9e5]}), r"no exposure shows one of the positions \(star 0\)"),
    ):
        with pytest.raises(InputError, match=words):
            ld.catalogue(exposures, solution, positions=table)
    place = np.array([[150.0, 150.0], [1e4, 1e4]])
    Table({"star": [7, 9], "x": place[:, 0], "y": place[:, 1]}).write(tmp_path / "given.csv")
    with pytest.warns(
        AssumptionWarning, match="no exposure shows the place of star 9, where stars determined its map: left out"
    ):
        out = ld.catalogue(exposures, solution, positions=tmp_path / "given.csv")
    assert out.stars["star"].tolist() == [7]
    assert out.stars["n"][0] == 3


@pytest.mark.slow
def test_artificial_stars_are_found_as_stars_are(truth, solution, found, monkeypatch):
    """Faint ones are missed, bright ones not, errors are those stated; the catalogue and its pixels stay."""
    measure, left = ld.photometry.catalogue.measure_completeness, []

    def watched(field, *args, **options):
        def planes():
            scenes = [each.scene for each in field.layers]
            images = [(each.frame.signal.copy(), each.light.copy(), each.sky.copy()) for each in scenes]
            return np.array(images), field.xy.copy(), field.flux.copy(), [each.rows.copy() for each in field.layers]

        left.append(planes())
        out = measure(field, *args, **options)
        left.append(planes())
        return out

    monkeypatch.setattr(ld.photometry.catalogue, "measure_completeness", watched)
    other = ld.catalogue(exposures_of(truth), solution, zero_point=25.0, artificial=24, seed=2)
    for name in found.stars.colnames:
        np.testing.assert_array_equal(np.asarray(found.stars[name]), np.asarray(other.stars[name]))
    assert set(other.stars.colnames) - set(found.stars.colnames) == {"flux_bias"}
    (images, *stars), (after, *same) = left
    np.testing.assert_allclose(images, after, atol=1e-3)  # of a noise of 10
    for each, its in zip(stars, same, strict=True):
        np.testing.assert_array_equal(each, its)
    made, table = other.completeness.stars, other.completeness.by_flux
    assert len(made) == table["n"].sum() == other.completeness.by_place["n"].sum() == 24
    assert np.mean(made["found"][made["snr"] > 8]) > 0.85
    assert np.mean(made["found"][made["snr"] < 3.5]) < 0.2
    seen = made[made["found"]]
    pull = np.concatenate([np.asarray(seen[f"{name}_off"] / seen[f"{name}_err"]) for name in ("x", "y", "flux")])
    assert 0.6 < 1.4826 * np.median(np.abs(pull)) < 1.5
    np.testing.assert_allclose(table["mag_low"], 25 - 2.5 * np.log10(table["flux_high"]))
    np.testing.assert_allclose(np.diff(table["mag_low"]), -0.5)
    assert table.meta["n_rows"] == len(found.stars)
    assert table.meta["n_false"] <= 2
    ax = other.completeness.plot()
    shown = table["n"] > 0
    np.testing.assert_allclose(ax.containers[0].lines[0].get_ydata(), 100 * table["completeness"][shown])
    assert ax.get_xlabel() == "magnitude"
    assert repr(other.completeness) == f"<Completeness: 24 artificial stars, {len(seen)} of them found>"
    assert "rows are false, by negative light" in str(other.completeness)


def test_the_brightest_star_chooses_its_row_first():
    xy, flux = np.array([[0.0, 0], [1.0, 0], [9.0, 0], [30.0, 0]]), np.array([1.0, 5.0, 2.0, 9.0])
    rows = np.array([[0.6, 0], [9.5, 0], [8.8, 0], [-0.9, 0]])
    assert matched(xy, flux, rows, 1.0).tolist() == [3, 0, 2, -1]
    assert matched(xy, flux, rows[:0], 1.0).tolist() == [-1] * 4


def test_the_bias_of_faint_fluxes_is_that_of_their_selection():
    """Unit noise, a threshold of 5, fluxes that follow a power law: the bias as computed from the definition."""
    rng = np.random.default_rng(3)
    flux = 2 * rng.uniform(size=400_000) ** (-1 / 0.7)
    measured = flux + rng.normal(size=len(flux))
    stars = QTable({"found": measured > 5, "snr_found": measured, "flux_off": measured - flux})
    stars["flux_err"] = 1.0
    snr = np.array([5.5, 7.0, 10.0])
    true = [np.median((measured - flux)[np.abs(measured - s) < 0.1]) for s in snr]
    np.testing.assert_allclose(flux_bias(stars, snr, np.array([2.0, 3, 1])), true * np.array([2.0, 3, 1]), rtol=0.15)
    few = flux_bias(stars[np.flatnonzero(stars["found"])[:400]], snr, np.ones(3))
    np.testing.assert_allclose(few, true, rtol=0.4)
    assert np.isnan(flux_bias(stars[:3], snr, np.ones(3))).all()
    assert np.isnan(flux_bias(stars[:0], snr, np.ones(3))).all()


def test_a_sky_made_anew_takes_no_more_of_a_star_that_is_not_seen():
    """However often: the mean with Gaussian weights of 3 FWHM, which has 4 % of a star; sums of means have more."""
    yx, nothing = np.mgrid[-100:101, -100:101], np.zeros((201, 201), dtype=bool)
    star = np.exp(-(yx**2).sum(axis=0) / (2 * 1.7**2)).astype(np.float32)
    psf = ld.EffectivePSF.from_array(star[90:111, 90:111], oversampling=1)
    weight = star / (star**2).sum()
    taken = {}
    for afresh in (True, False):
        frame = Frame(star.copy(), np.ones_like(star), np.zeros_like(star), ~nothing, nothing, 0.0)
        scene = Scene(frame, psf, 12, 0.0)
        taken[afresh] = []
        for _ in range(4):
            scene.update_sky(4, afresh=afresh)
            taken[afresh].append(float((weight * scene.sky).sum()))
    np.testing.assert_allclose(taken[True], 2 * (1.7 / (3 * scene.fwhm)) ** 2, rtol=0.1)
    assert taken[False][-1] > 2 * taken[False][0]


@pytest.mark.slow
def test_artificial_stars_of_the_command(truth, solution, tmp_path, capsys):
    """Tables of two calls with one seed are the same; what stands there is not replaced."""
    paths = written(truth.frames[:3], solution, tmp_path)
    call = ["completeness", *paths, "--solution", str(tmp_path / "solution.asdf"), "--stars", "3", "--threshold", "9"]
    for name in ("one", "two"):
        assert main([*call, "--out", str(tmp_path / f"{name}.ecsv"), "--seed", "4"]) == 0
    assert "Completeness: 3 artificial stars" in capsys.readouterr().out
    for what in ("", "_places", "_stars"):
        one, two = (QTable.read(tmp_path / f"{name}{what}.ecsv") for name in ("one", "two"))
        for name in one.colnames:
            np.testing.assert_array_equal(np.asarray(one[name]), np.asarray(two[name]))
    (tmp_path / "one.ecsv").unlink()
    assert main([*call, "--out", str(tmp_path / "one.ecsv")]) == 1
    assert "one_places.ecsv exists already; give --overwrite" in capsys.readouterr().err
    assert main(["catalogue", *call[1:6], "--out", str(tmp_path / "c.ecsv"), "--seed", "1"]) == 1
    assert "--seed is for the stars of --artificial" in capsys.readouterr().err


@pytest.mark.slow
def test_run_ends_with_the_catalogue(truth, tmp_path, monkeypatch):
    """That of the solution which it leaves; without one where there can be none, by a warning."""
    paths = []
    for k, data in enumerate(truth.frames[:4]):
        paths.append(tmp_path / f"f{k:02d}.fits")
        fits.PrimaryHDU(data, fits.Header([("GAIN", 1.0)])).writeto(paths[-1])
    with pytest.raises(InputError, match="catalogue must be one of 'none', 'joint', got 'all'"):
        ld.run(paths, out=tmp_path / "out", catalogue="all")
    with pytest.raises(InputError, match=r"what a catalogue misses: give catalogue='joint' \(--catalogue joint\)"):
        ld.run(paths, out=tmp_path / "out", artificial=5)
    made = ld.run(paths, out=tmp_path / "out", psf="moffat", degree=1, catalogue="joint", artificial=3)
    expected = ld.catalogue(ld.open_exposures(paths), ld.Solution.read(made.out), psf="moffat")
    stars, photometry = (QTable.read(made.out / name) for name in ("catalogue.ecsv", "photometry.ecsv"))
    for found, same in ((stars, expected.stars), (photometry, expected.photometry)):
        np.testing.assert_allclose(found["flux"], same["flux"], rtol=1e-6)
    assert str(made.checks[-1]) == str(made.catalogue.check)
    assert made.summary["catalogue"]["n_stars"] == len(made.catalogue.stars) == len(stars)
    assert {"catalogue.ecsv", "photometry.ecsv"} <= set(made.summary["files"])
    report = (made.out / "report.html").read_text()
    assert f"{len(stars)} stars, {stars.meta['n_new']} of them new" in report
    assert 'href="photometry.ecsv"' in report
    assert "The part of 3 artificial stars" in report
    assert "flux_bias" in stars.colnames

    def impossible(_):
        raise InputError("the solution has motions of stars")

    monkeypatch.setattr(ld.photometry.catalogue, "_check_solution", impossible)
    options = {"earlier": made.out, "degree": 1, "overwrite": True, "catalogue": "joint"}
    with pytest.warns(AssumptionWarning, match="no catalogue of all exposures together: the solution has motions"):
        made = ld.run(paths, out=made.out, **options)
    assert made.catalogue is None
    assert "catalogue" not in made.summary
    names = {path.name for path in made.out.iterdir()}
    assert {"mosaic.fits", "solution.asdf", "report.html"} <= names
    assert not names & {"catalogue.ecsv", "photometry.ecsv"}
    report = (made.out / "report.html").read_text()
    assert "photometry.ecsv" not in report
    assert "artificial stars" not in report
    made = ld.run(paths, out=made.out, earlier=made.out, degree=1, overwrite=True, mosaic=False)
    assert made.mosaic is None
    assert not (made.out / "mosaic.fits").exists()
    assert "mosaic.fits" not in (made.out / "report.html").read_text()
    assert "catalogue" not in {check.name for check in made.checks}
    states = {check.name: (check.state, check.sentence) for check in made.checks}
    assert states["sharpness"] == ("unknown", "no mosaic was made")
    assert states["images"][0] == "unknown"
    with pytest.raises(InputError, match=r"without a mosaic \(mosaic=False, --no-mosaic\) .*: leave order out"):
        ld.run(paths, out=tmp_path / "none", mosaic=False, coadding={"order": 1})


_PEAK = """
import sys, legdistort as ld
from legdistort.photometry import catalogue as verb
verb._IN_MEMORY = int(sys.argv.pop(1))
ld.catalogue(ld.open_exposures(sys.argv[2:]), ld.Solution.read(sys.argv[1]), threshold=9)
print(*(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="its /proc tells the largest memory")
def test_memory_does_not_grow_with_the_number_of_exposures(tmp_path):
    size = 512
    truth = deep_frames(4, size=size, n_stars=180, n_frames=6, bounds=False)
    paths = [str(tmp_path / f"f{k:02d}.fits") for k in range(6)]
    for path, data in zip(paths, truth.frames, strict=True):
        fits.PrimaryHDU(data, fits.Header([("GAIN", 1.0)])).writeto(path)
    solved(truth).write(tmp_path / "solution.asdf")
    call = [sys.executable, "-W", "ignore", "-c", _PEAK, "0", str(tmp_path / "solution.asdf")]
    peaks = [int(subprocess.run([*call, *paths[:n]], capture_output=True, check=True).stdout) for n in (2, 6)]
    assert peaks[1] - peaks[0] < 2 * 24 * size**2 / 1024  # kB: what two exposures store, of four more


@pytest.mark.sets
def test_a_deep_field_with_hits_of_particles():
    """Eleven frames, most of whose stars none of them shows, 1 % of the pixels hit."""
    truth = deep_frames(8, size=512, n_stars=600, hit=0.01)
    solution = solved(truth)
    found = ld.catalogue(exposures_of(truth), solution)
    c = beside_truth(truth, solution, found.stars)
    assert c.found(6) >= 0.93
    assert c.found(8) >= 0.97
    assert c.n_false <= 0.01 * c.n_rows
    over_bound, pull = c.ratios(8)
    assert over_bound <= 1.3
    assert 0.8 < pull < 1.2
    assert np.count_nonzero(found.stars["flags"] & Flag.VARIABLE) <= 0.02 * len(found.stars)


@pytest.mark.sets
def test_artificial_stars_tell_the_truth():
    """The part found of them is that found of true stars, and so is the excess of fluxes near the threshold."""
    true, artificial, bias = [], [], []
    for seed in range(1, 6):
        truth = deep_frames(seed, size=320, n_stars=230, n_frames=6)
        solution = solved(truth)
        found = ld.catalogue(exposures_of(truth), solution, artificial=90 if seed < 4 else None)
        c = beside_truth(truth, solution, found.stars)
        true.append((c.snr, c.row >= 0))
        bias.append(excess(truth, c, found.stars)[:2])
        if found.completeness:
            made = found.completeness.stars
            artificial.append(made[artificial_inside(truth, c, made)])
    artificial = vstack(artificial, metadata_conflicts="silent")
    sets = [np.concatenate(true, axis=1), np.array([artificial["snr"], artificial["found"]])]
    for low, high in ((2.65, 4.5), (4.5, 8), (8, 50)):
        hits = [hit[(snr >= low) & (snr < high)] for snr, hit in sets]
        n, both = [len(hit) for hit in hits], (sum(hit.sum() for hit in hits) + 0.5) / (sum(map(len, hits)) + 1)
        error = np.sqrt(both * (1 - both) * (1 / n[0] + 1 / n[1]))
        assert abs(hits[0].mean() - hits[1].mean()) < 0.03 + 2 * error, (low, high)
    snr, off = np.concatenate(bias, axis=1)
    near = snr < 8
    true, stated = np.median(off[near]), np.median(flux_bias(artificial, snr[near], np.ones(near.sum())))
    assert abs(stated - true) < true / 3 + 2 * 1.25 * np.std(off[near]) / np.sqrt(near.sum()), (stated, true)


@pytest.mark.parametrize(
    ("n_sets", "least", "within"),
    [pytest.param(1, 3, 2.5, marks=pytest.mark.slow), pytest.param(3, 10, 1.5, marks=pytest.mark.sets)],
)
def test_negative_light_tells_how_many_rows_are_false(n_sets, least, within):
    """At a threshold of 3.5, in sets of bright stars alone: whatever else is found is false."""
    false, stated = 0, 0
    for seed in range(1, 1 + n_sets):
        truth = deep_frames(seed, size=320, n_stars=60, n_frames=8, faintest=4.0)
        solution = solved(truth)
        found = ld.catalogue(exposures_of(truth), solution, threshold=3.5, artificial=1)
        false += beside_truth(truth, solution, found.stars, edge=-100).n_false
        stated += found.completeness.by_flux.meta["n_false"]
    assert false >= least
    assert false / within <= stated <= within * false


@pytest.mark.slow
def test_detectors_of_a_camera_are_measured_together():
    """One position on the plane, whichever detectors see a star; refused where nothing ties these to each other."""

    made = ld.simulate_exposures(small=True, camera="gsaoi", n_exposures=6, seed=1)
    exposures = ld.read_exposures(list(made.hdus.values()), ext="SCI")
    matches = ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures)
    solution = ld.solve(matches)
    found = ld.catalogue(exposures, solution)
    assert found.stars.meta["n_images"] == 24
    assert set(found.photometry["detector"]) == {"1", "2", "3", "4"}
    known = {name: row for row, name in enumerate(solution.stars["star"])}
    here, there = np.array([(i, known[name]) for i, name in enumerate(found.stars["star"]) if name in known]).T
    assert len(here) >= 0.95 * len(known)
    assert len(found.stars) <= len(made.truth.positions)  # none is there twice
    off = found.stars["x"][here] - solution.stars["x"][there]
    pull = off / np.hypot(found.stars["x_err"][here], solution.stars["x_err"][there])
    assert np.median(np.abs(pull)) < 1
    star, detector = (np.asarray(matches.table[name]) for name in ("star", "detector"))
    first = dict(zip(star[::-1], detector[::-1], strict=True))  # no star on two of them any more
    matches = matches.keep([detector[k] == first[name] for k, name in enumerate(star)])
    with pytest.warns(AssumptionWarning, match="unknowns of camera GSAOI are not determined"):
        apart = ld.solve(matches)
    with pytest.raises(InputError, match="no star ties some detectors of the solution to others"):
        ld.catalogue(exposures, apart)
