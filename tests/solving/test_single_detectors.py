"""``solve(dynamic="detector")``: every detector of every exposure with a distortion of its own."""

import gsaoi_images
import numpy as np
import pytest

import legdistort
from legdistort.assessment import baselines
from legdistort.cli.parser import main
from legdistort.exceptions import InputError

SIGMA = 0.01


@pytest.fixture(scope="module")
def gsaoi():
    return legdistort.Camera.gsaoi()


def bent(table, rms, seed):
    """Positions with a cubic of its own, rms pixels in every power, on every detector of every exposure."""
    rng, out = np.random.default_rng(seed), table.copy()
    powers = [(i, j) for i in range(4) for j in range(4 - i) if i + j]
    for name in np.unique(table["exposure"]):
        for key in gsaoi_images.CHIPS:
            rows = (table["exposure"] == name) & (table["detector"] == key)
            u, v = table["x"][rows] / 1024 - 1, table["y"][rows] / 1024 - 1
            for axis in "xy":
                out[axis][rows] += sum(rng.normal(0, rms) * u**i * v**j for i, j in powers)
    return out


def without_similarity(found, true):
    z, w = found @ [1, 1j], true @ [1, 1j]
    design = np.stack([w, np.ones(len(w))], axis=1)
    left = z - design @ np.linalg.lstsq(design, z, rcond=None)[0]
    return np.stack([left.real, left.imag], axis=1)


def draw(gsaoi, seed):
    """A night, its positions, and its solution."""
    night = gsaoi_images.Night(n_exposures=8, n_stars=250, dynamic=0.0, dither=6.0, seed=seed)
    table = bent(night.table(sigma=SIGMA, seed=seed), 0.15, seed)
    return night, table, legdistort.solve(legdistort.Matches.from_table(table, camera=gsaoi), dynamic="detector")


@pytest.fixture(scope="module")
def drawn(gsaoi):
    return draw(gsaoi, 0)


@pytest.mark.slow
def test_errors(gsaoi):
    """Relative ones, projected as the positions are, and absolute ones: three draws of some fifty modes."""
    ratios, absolute = [], []
    for seed in range(3):
        night, _, solution = draw(gsaoi, seed)
        true, n = night.sky[solution.estimate.star_names], len(solution.estimate.star_names)
        left = gsaoi_images.without_common_map(solution.estimate.positions, true, 3)
        centred = gsaoi_images.without_common_map(np.eye(n), true, 3)
        matrix = solution.estimate.uncertainty.star_matrix.reshape(2, n, 2, n)
        expected = sum(np.trace(centred @ matrix[k, :, k] @ centred.T) for k in (0, 1))
        ratios.append(np.sum(left**2) / expected)
        assert solution.chi2 == pytest.approx(solution.dof, rel=0.1)
        reported = np.stack([solution.stars[name].value for name in ("x_err_abs", "y_err_abs")], axis=1)
        absolute.append(np.mean(without_similarity(solution.estimate.positions, true) ** 2) / np.mean(reported**2))
    print(ratios, absolute)
    assert np.mean(ratios) == pytest.approx(1, abs=0.5)
    assert 0.35 < np.mean(absolute) < 1.5


@pytest.mark.slow
def test_it_is_what_it_says(drawn, gsaoi, tmp_path):
    """A solution of single detectors, of which WCSs, residuals and files are as of any other."""
    _, table, solution = drawn
    assert not solution.camera.has_focal_plane
    assert solution.settings.dynamic == "detector"
    assert solution.names[:4] == ("frame00-1", "frame00-2", "frame00-3", "frame00-4")
    assert set(solution.estimate.shapes.values()) == {(2048, 2048)}
    rows = (table["exposure"] == "frame03") & (table["detector"] == "2")
    xy = np.stack([table["x"][rows], table["y"][rows]], axis=1)
    there = solution.estimate.positions[np.searchsorted(solution.estimate.star_names, table["star"][rows])]
    assert np.sqrt(np.mean((solution["frame03-2"].correct(xy) - there) ** 2)) < 1.2 * SIGMA
    again = legdistort.Solution.read(solution.write(tmp_path / "solution.asdf"))
    assert again.settings.dynamic == "detector"
    assert np.array_equal(again["frame03-2"].correct(xy), solution["frame03-2"].correct(xy))


@pytest.mark.slow
def test_one_detector_is_as_without_camera(gsaoi):
    """The layout of a single detector is in the poses: the positions are those of the same prior without a camera."""
    table = gsaoi_images.Night(n_exposures=5, n_stars=250).table(sigma=SIGMA)
    table = table[table["detector"] == "2"]
    table = table[np.bincount(table["star"])[table["star"]] >= 3]
    camera = legdistort.Camera("one", {"2": gsaoi["2"]})
    found = legdistort.solve(legdistort.Matches.from_table(table, camera=camera), dynamic="detector")
    table["detector"] = 2  # a number names it as well
    again = legdistort.solve(legdistort.Matches.from_table(table, camera=camera), dynamic="detector")
    assert np.array_equal(again.coefficients, found.coefficients)
    prior = legdistort.Prior(gsaoi["2"].static, sigma="evidence")
    usual = legdistort.solve(legdistort.Matches.from_table(table, shape=(2048, 2048)), prior=prior)
    both = [gsaoi_images.without_common_map(s.estimate.positions, usual.estimate.positions, 3) for s in (found, usual)]
    assert np.sqrt(np.mean((both[0] - both[1]) ** 2)) < 0.1 * np.nanmedian(usual.stars["x_err"].value)


@pytest.mark.slow
def test_other_corrections_are_of_single_detectors_too(drawn, gsaoi):
    _, table, solution = drawn
    compared = baselines.compare(legdistort.Matches.from_table(table, camera=gsaoi), solution)
    assert compared["shift"].names == solution.names
    assert compared["shift"].chi2 > 100 * solution.chi2


def test_the_whole_focal_plane_by_name(gsaoi):
    table = gsaoi_images.Night(n_exposures=5, n_stars=200).table(sigma=SIGMA)
    matches = legdistort.Matches.from_table(table, camera=gsaoi)
    named, usual = (legdistort.solve(matches, dynamic=word) for word in ("focal_plane", None))
    assert np.array_equal(named.estimate.positions, usual.estimate.positions)


def test_bad_words(gsaoi):
    table = gsaoi_images.Night(n_exposures=5, n_stars=200).table(sigma=SIGMA)
    matches = legdistort.Matches.from_table(table, camera=gsaoi)
    for given, words in (
        ({"dynamic": "chip"}, "dynamic must be"),
        ({"dynamic": "detector", "layout": "fit"}, "has a pose of its own: leave layout out"),
        ({"dynamic": "detector", "prior": legdistort.Prior(np.zeros((2, 10)))}, "leave prior and its sizes out"),
        ({"dynamic": "detector", "static": "free"}, "static must be"),
        ({"exposure_degree": 1}, "leave exposure_degree out, or take every detector by itself"),
        ({"exposure_degree": 1, "static": "fit"}, "leave exposure_degree out, or take every detector by itself"),
    ):
        with pytest.raises(InputError, match=words):
            legdistort.solve(matches, **given)
    one = table[table["detector"] == "1"]
    alone = legdistort.Matches.from_table(one[np.bincount(one["star"])[one["star"]] >= 3], shape=(2048, 2048))
    with pytest.raises(InputError, match="dynamic='detector' is for exposures with several detectors"):
        legdistort.solve(alone, dynamic="detector")


@pytest.mark.slow
def test_in_the_shell(drawn, gsaoi, tmp_path, monkeypatch):
    """A WCS for every detector of every exposure, as of a camera."""
    monkeypatch.chdir(tmp_path)
    drawn[1].write("matched.ecsv")
    gsaoi.write("camera.asdf")
    given = ["--camera", "camera.asdf", "--dynamic", "detector", "--out", "r", "--quiet"]
    assert main(["solve", "matched.ecsv", *given]) == 0
    assert len(list((tmp_path / "r" / "wcs").iterdir())) == len(drawn[2].names)
