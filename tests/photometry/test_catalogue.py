"""Every star measured in all exposures at once, against frames made without the package."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from deep_frames import compared, deep_frames

import legdistort as ld
from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.flags import Flag
from legdistort.measurement.scene.normal_equations import neighbour_covariance
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


def test_an_image_that_the_solution_left_out_does_not_tell_where_a_star_is(solution, found):
    rows = solution.residuals[~solution.residuals["used"]]
    assert set(rows["exposure"]) == {"f02"}
    without = found.stars[found.stars["n_left_out"] > 0]
    assert len(without) >= 1
    assert set(without["star"]) <= set(rows["star"])  # some are beyond the stars that determine the map of this frame
    assert np.all(without["n_left_out"] == 1)
    assert np.all(without["n"] > 4)  # their fluxes count there


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


def test_what_one_exposure_alone_shows_is_no_star():
    """Constant, a hit of one exposure, a flare that two confirm, a faint one, one that two exposures see."""
    rng = np.random.default_rng(1)
    flux, error = 2 + rng.normal(0, 1, (11, 5)), np.ones((11, 5))
    flux[:, 1] -= 2
    flux[4, 1] = 30
    flux[:, 2] -= 1
    flux[[2, 3], 2] = 9
    error[2:, 4], flux[:2, 4] = np.inf, (9, 2)
    mean = np.array([np.average(f, weights=1 / e**2) for f, e in zip(flux.T, error.T, strict=True)])
    lone, varying = judged(flux, error, mean, mean * np.sqrt((1 / error**2).sum(axis=0)), 5.0)
    assert lone.tolist() == [False, True, False, False, False]
    assert varying.tolist() == [False, False, True, False, False]


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


def test_files_and_command(truth, solution, tmp_path, capsys):
    paths = []
    for k, data in enumerate(truth.frames[:4]):
        paths.append(str(tmp_path / f"f{k:02d}.fits"))
        fits.PrimaryHDU(data, fits.Header([("GAIN", 1.0)])).writeto(paths[-1])
    solution.write(tmp_path / "solution.asdf")
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


def test_pixels_on_the_disk_give_the_same_catalogue(truth, solution, found, tmp_path, monkeypatch):
    """Bit for bit, looked at a few rows at a time; nothing is left behind."""
    monkeypatch.setattr(ld.photometry.catalogue, "_IN_MEMORY", 0)
    monkeypatch.setattr(ld.photometry.joint_scene, "_ROWS", 37)
    other = ld.catalogue(exposures_of(truth), solution, zero_point=25.0, scratch=tmp_path)
    for one, same in ((found.stars, other.stars), (found.photometry, other.photometry)):
        assert one.meta == same.meta
        for name in one.colnames:
            np.testing.assert_array_equal(np.asarray(one[name]), np.asarray(same[name]))
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="no scratch folder can be made"):
        ld.catalogue(exposures_of(truth), solution, scratch=tmp_path / "none")


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


def test_run_ends_with_the_catalogue(truth, tmp_path, monkeypatch):
    """That of the solution which it leaves; without one where there can be none, by a warning."""
    paths = []
    for k, data in enumerate(truth.frames[:4]):
        paths.append(tmp_path / f"f{k:02d}.fits")
        fits.PrimaryHDU(data, fits.Header([("GAIN", 1.0)])).writeto(paths[-1])
    with pytest.raises(InputError, match="catalogue must be one of 'none', 'joint', got 'all'"):
        ld.run(paths, out=tmp_path / "out", catalogue="all")
    made = ld.run(paths, out=tmp_path / "out", psf="moffat", degree=1, catalogue="joint")
    expected = ld.catalogue(ld.open_exposures(paths), ld.Solution.read(made.out), psf="moffat")
    stars, photometry = (QTable.read(made.out / name) for name in ("catalogue.ecsv", "photometry.ecsv"))
    for found, same in ((stars, expected.stars), (photometry, expected.photometry)):
        np.testing.assert_allclose(found["flux"], same["flux"], rtol=1e-6)
    assert made.summary["catalogue"]["n_stars"] == len(made.catalogue.stars) == len(stars)
    assert {"catalogue.ecsv", "photometry.ecsv"} <= set(made.summary["files"])
    report = (made.out / "report.html").read_text()
    assert f"{len(stars)} stars, {stars.meta['n_new']} of them new" in report
    assert 'href="photometry.ecsv"' in report

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
    assert "photometry.ecsv" not in (made.out / "report.html").read_text()
    made = ld.run(paths, out=made.out, earlier=made.out, degree=1, overwrite=True, mosaic=False)
    assert made.mosaic is None
    assert not (made.out / "mosaic.fits").exists()
    assert "mosaic.fits" not in (made.out / "report.html").read_text()
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
    truth = deep_frames(4, size=768, n_stars=400, n_frames=10, bounds=False)
    paths = [str(tmp_path / f"f{k:02d}.fits") for k in range(10)]
    for path, data in zip(paths, truth.frames, strict=True):
        fits.PrimaryHDU(data, fits.Header([("GAIN", 1.0)])).writeto(path)
    solved(truth).write(tmp_path / "solution.asdf")
    call = [sys.executable, "-W", "ignore", "-c", _PEAK, "0", str(tmp_path / "solution.asdf")]
    peaks = [int(subprocess.run([*call, *paths[:n]], capture_output=True, check=True).stdout) for n in (3, 10)]
    assert peaks[1] - peaks[0] < 3 * 24 * 768**2 / 1024  # kB: what three exposures store, of seven more


@pytest.mark.slow
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


@pytest.mark.slow
def test_detectors_of_a_camera_are_measured_together():
    """One position on the plane, whichever detectors see a star; refused where nothing ties these to each other."""

    def night(n, seed):
        made = ld.simulate_exposures(small=True, camera="gsaoi", n_exposures=n, seed=seed)
        exposures = ld.read_exposures(list(made.hdus.values()), ext="SCI")
        return made, exposures, ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures)

    made, exposures, matches = night(9, 1)
    solution = ld.solve(matches)
    found = ld.catalogue(exposures, solution)
    assert found.stars.meta["n_images"] == 36
    assert set(found.photometry["detector"]) == {"1", "2", "3", "4"}
    known = {name: row for row, name in enumerate(solution.stars["star"])}
    here, there = np.array([(i, known[name]) for i, name in enumerate(found.stars["star"]) if name in known]).T
    assert len(here) >= 0.95 * len(known)
    assert len(found.stars) <= len(made.truth.positions)  # none is there twice
    off = found.stars["x"][here] - solution.stars["x"][there]
    pull = off / np.hypot(found.stars["x_err"][here], solution.stars["x_err"][there])
    assert np.median(np.abs(pull)) < 1
    _, exposures, matches = night(4, 3)
    with pytest.warns(AssumptionWarning, match="unknowns of camera GSAOI are not determined"):
        apart = ld.solve(matches)
    with pytest.raises(InputError, match="no star ties some detectors of the solution to others"):
        ld.catalogue(exposures, apart)
