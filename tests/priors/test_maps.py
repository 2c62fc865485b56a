"""Static distortions as FITS maps with maps of their errors, in and out. Truth made by numpy alone."""

import four_detectors
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from night_sets import SIZE, Nights, field
from numpy.polynomial import legendre
from numpy.testing import assert_allclose, assert_array_equal
from rough_optics import Mask, beyond, modes
from scipy.interpolate import RectBivariateSpline

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.exceptions import InputError, SolveError
from legdistort.geometry import basis
from legdistort.geometry.tabulated.displacement_table import DisplacementTable
from legdistort.priors.maps import errors_of, map_paths, write_maps

SHAPE = (120, 160)
ROUGH = {"size": 400, "holes_along": 12, "n_exposures": 7, "shift": 16.0, "noise": 0.0015, "highest": 5.0, "rough": 0.3}


class Mild(Mask):
    """With a map of some pixels, a third of what it is, so that small detectors see little of what is beyond them."""

    def map(self, q):
        return super().map(q) / 3


def written(folder, *maps):
    """Files of maps x, y and perhaps their errors."""
    paths = map_paths(folder / "given.fits")[: len(maps)]
    for path, values in zip(paths, maps, strict=True):
        fits.PrimaryHDU(np.asarray(values, dtype=float)).writeto(path, overwrite=True)
    return paths


def squares(degree, shape):
    """Squared normalised Legendre modes at every pixel, (n_modes, ny, nx), by numpy."""
    x, y = ((2 * np.arange(n) + 1) / n - 1 for n in shape[::-1])
    u, v = (legendre.legvander(w, degree) * np.sqrt((2 * np.arange(degree + 1) + 1) / 2) for w in (x, y))
    return np.stack([np.outer(v[:, k], u[:, n - k]) ** 2 for n in range(degree + 1) for k in range(n + 1)])


def true_maps(mask, size):
    """Shifts (2, size, size) that undistort every pixel of a mask's map: by fixed point, and a fine spline between."""
    t = np.linspace(0, size - 1, 150)
    p = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    q = p.copy()
    for _ in range(20):
        q = p - mask.map(q)
    shifts = (q - p).T.reshape(2, len(t), len(t))
    return np.stack([RectBivariateSpline(t, t, each)(np.arange(size), np.arange(size)) for each in shifts])


@pytest.fixture(scope="module")
def mask():
    return Mild(**ROUGH)


@pytest.fixture(scope="module")
def rough_prior(mask, tmp_path_factory):
    return ld.Prior.from_file(written(tmp_path_factory.mktemp("maps"), *true_maps(mask, 400)), degree=5)


# -- what errors of pixels say of coefficients


def test_errors_alike_for_all_coefficients_are_found(tmp_path):
    """By numpy: the error at a pixel is the sum of squared modes, and every coefficient has the same."""
    sigma = np.sqrt(squares(4, SHAPE).sum(axis=0))
    flat = np.zeros(SHAPE)
    prior = ld.Prior.from_file(written(tmp_path, flat, flat, 0.01 * sigma, 0.03 * sigma), degree=4)
    assert_allclose(prior.static_sigma[0], 0.01, rtol=0.02)
    assert_allclose(prior.static_sigma[1], 0.03, rtol=0.02)
    assert prior.table is None


@pytest.mark.parametrize("degree", [2, 4])
def test_the_mean_square_is_kept_whatever_the_errors(tmp_path, degree):
    y, x = np.indices(SHAPE)
    sigma = 0.02 + 0.03 * (x / SHAPE[1]) ** 2 + 0.01 * np.cos(y / 20)
    flat = np.zeros(SHAPE)
    prior = ld.Prior.from_file(written(tmp_path, flat, flat, sigma, 2 * sigma), degree=degree)
    mean_square = np.sum(prior.static_sigma**2, axis=1) / 4
    assert_allclose(mean_square, np.mean(sigma**2) * np.array([1, 4]), rtol=0.02)
    assert np.all(prior.static_sigma > 0.2 * prior.static_sigma.max())  # nothing is taken as exact


def test_errors_of_a_fitted_map(tmp_path):
    """A series fitted to many stars: its true covariance gives the map; the widths are those of its coefficients."""
    rng, degree, size = np.random.default_rng(2), 3, 200
    stars = rng.uniform(0, size - 1, (400, 2))
    design = modes(stars, size, degree) / 2  # normalised as the package has them
    covariance = 0.05**2 * np.linalg.inv(design.T @ design)
    y, x = np.indices((size, size))
    at = modes(np.column_stack([x.ravel(), y.ravel()]), size, degree) / 2
    sigma = np.sqrt(np.einsum("nm,mk,nk->n", at, covariance, at)).reshape(size, size)
    flat = np.zeros((size, size))
    prior = ld.Prior.from_file(written(tmp_path, flat, flat, sigma, sigma), degree=degree)
    assert_allclose(prior.static_sigma[0] / np.sqrt(np.diag(covariance)), 1, atol=0.15)


def test_errors_of_a_part_and_a_width_of_ones_own(tmp_path):
    sigma = np.sqrt(squares(2, SHAPE).sum(axis=0))[:, 40:100]  # a part of the detector
    flat = np.zeros(sigma.shape)
    paths = written(tmp_path, flat, flat, 0.01 * sigma, 0.01 * sigma)
    with pytest.warns(ld.exceptions.AssumptionWarning, match="covers 38 % of the detector"):
        prior = ld.Prior.from_file(paths, degree=2, offset=(40, 0), shape=SHAPE)
    assert_allclose(prior.static_sigma, 0.01, rtol=0.02)
    assert_array_equal(ld.Prior.from_file(paths, degree=2, static_sigma=0.5).static_sigma, np.full((2, 6), 0.5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda e: np.where(e == e.max(), np.nan, e),
            r"the y error map has \d+ values that are not finite.*static_sig",
        ),
        (
            lambda e: -e,
            "the y error map has negative values, the first at pixel x 0, y 0; it holds standard deviations",
        ),
        (
            lambda e: e[1:],
            r"shapes \(120, 160\) \(x\) .*\(119, 160\) \(y error\); the maps must be images of one shape",
        ),
    ],
)
def test_bad_error_maps(tmp_path, change, message):
    flat, sigma = np.zeros(SHAPE), np.full(SHAPE, 0.1) + np.indices(SHAPE)[1] / 1e4
    with pytest.raises(InputError, match=message):
        ld.Prior.from_file(written(tmp_path, flat, flat, sigma, change(sigma)))


# -- written and read again


def test_there_and_back(tmp_path):
    rng = np.random.default_rng(1)
    mean = np.zeros((2, 15))
    mean[:, 3:] = rng.normal(0, 0.5, (2, 12))
    prior = ld.Prior(mean, static_sigma=0.02, shape=SHAPE)
    assert prior.write(tmp_path / "s.fits") == tmp_path / "s.fits"
    paths = map_paths(tmp_path / "s.fits")
    assert [path.name for path in paths] == ["s_x.fits", "s_y.fits", "s_x_err.fits", "s_y_err.fits"]
    back = ld.Prior.from_file(paths, degree=4)
    assert_allclose(back.mean, mean, atol=1e-5)
    assert_allclose(back.static_sigma, 0.02, rtol=0.02)
    assert back.truncation < 1e-3
    # pixel by pixel by numpy: a map leads to where the series has the pixel, errors are those of the series there
    maps = np.array([fits.getdata(path) for path in paths])
    y, x = np.indices(SHAPE)
    q = np.column_stack([(x + maps[0]).ravel(), (y + maps[1]).ravel()])
    u, v = (2 * q + 1).T / np.array(SHAPE[::-1])[:, None] - 1
    along, across = (legendre.legvander(w, 4) * np.sqrt((2 * np.arange(5) + 1) / 2) for w in (u, v))
    values = np.stack([along[:, n - k] * across[:, k] for n in range(5) for k in range(n + 1)])
    assert_allclose(q + (mean @ values).T, np.column_stack([x.ravel(), y.ravel()]), atol=1e-9)
    assert_allclose(maps[2].ravel(), 0.02 * np.sqrt((values**2).sum(axis=0)), rtol=2e-3)
    uneven = ld.Prior(mean, static_sigma=np.linspace(0.01, 0.03, 15), shape=SHAPE)
    again = ld.Prior.from_file(write_maps(uneven, tmp_path / "u.fits"), degree=4)
    assert_allclose(np.sum(again.static_sigma**2), np.sum(uneven.static_sigma**2), rtol=0.02)


def test_files_that_are_there(tmp_path):
    prior = ld.Prior(np.zeros((2, 6)), static_sigma=0.1, shape=SHAPE)
    prior.write(tmp_path / "s.fits")
    with pytest.raises(InputError, match=r"s_x.fits exists already; give overwrite=True \(--overwrite\)"):
        prior.write(tmp_path / "s.fits")
    ld.Prior(np.zeros((2, 6)), shape=SHAPE).write(tmp_path / "s.fits", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s_x.fits", "s_y.fits"]  # errors of others are gone


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mean": np.zeros((2, 6))}, "maps need a static distortion and the size of its detector"),
        ({"mean": None, "static_sigma": 1.0, "shape": SHAPE}, "maps need a static distortion"),
        (
            {"mean": np.zeros((2, 6)), "static_sigma": [0.1] * 5 + [np.inf], "shape": SHAPE},
            r"do not determine some of the static distortion.*\(static_sigma of the prior, --static-sigma\)",
        ),
    ],
)
def test_what_no_maps_can_hold(tmp_path, given, message):
    with pytest.raises(InputError, match=message):
        ld.Prior(**given).write(tmp_path / "s.fits")
    assert not list(tmp_path.iterdir())


# -- what no series follows


@pytest.mark.slow
def test_a_rough_map_is_not_truncated(mask, rough_prior, tmp_path):
    q = mask.at(4000)
    truth = mask.map(q)
    series = (rough_prior.mean @ basis.values(5, *basis.normalize(q, rough_prior.shape))).T
    assert np.std(beyond(series - truth, q, mask.size, 1)) > 0.02
    assert np.abs(beyond(series + rough_prior.table(q) - truth, q, mask.size, 1)).max() < 1e-3
    assert rough_prior.truncation < 1e-3
    back = ld.Prior.read(rough_prior.write(tmp_path / "p.asdf"))
    assert back.table == rough_prior.table
    assert "table beside" in repr(back)
    again = ld.Prior.from_file(write_maps(rough_prior, tmp_path / "r.fits"), degree=5)
    assert_allclose(again.table(q) - rough_prior.table(q), 0, atol=1e-3)
    assert_allclose(again.mean, rough_prior.mean, atol=2e-3)


@pytest.mark.slow
def test_solutions_follow_it(mask, rough_prior):
    """Exposures that are known to have this distortion and no more: the residuals are noise."""
    how = {"static": "hold", "exposure_degree": None, "degree": 5}
    prior = rough_prior.with_sigma(1e-4)
    solution, q = mask.solve(prior=prior, **how), mask.at()
    for name in ("m0", "m3"):
        off = beyond(solution[name].distortion(q) - q - mask.map(q), q, mask.size, 1)
        assert np.std(off) < mask.noise / 3
    assert_allclose(solution.chi2 / solution.dof, 1, atol=0.1)
    assert solution["m0"].distortion.table == rough_prior.table
    assert_allclose(solution.residuals["x_terms"].value, 0, atol=1e-12)
    series = ld.Prior(prior.mean, sigma=1e-4, shape=prior.shape)
    with pytest.warns(ld.exceptions.AssumptionWarning):
        assert mask.solve(prior=series, **how).chi2 > 5 * solution.chi2
    stars = solution.residuals[solution.residuals["exposure"] == "m1"]
    pixels = np.column_stack([stars["x"].value, stars["y"].value])
    corrected = solution["m1"].correct(pixels)
    holes = mask.holes[np.asarray(stars["star"]).astype(int)]
    assert np.std(beyond(corrected - holes, holes, mask.size, 1)) < 1.3 * mask.noise


@pytest.mark.slow
def test_by_exposure(mask, rough_prior):
    """Of priors by exposure every one has the table of its own, as a part of it alone."""
    how = {"static": "hold", "exposure_degree": None, "degree": 5}
    prior = rough_prior.with_sigma(1e-4)
    each = {name: prior.with_sigma(1e-4) if name == "m0" else prior for name in mask.poses}
    one, many = (mask.solve(prior=given, **how) for given in (prior, each))
    assert_allclose(one.stars["x"].value, many.stars["x"].value, atol=1e-9)
    other = DisplacementTable(0 * prior.table.values, prior.table.first, prior.table.step)
    each["m0"] = ld.Prior(prior.mean, sigma=1e-4, shape=prior.shape, table=other)
    with pytest.warns(ld.exceptions.AssumptionWarning):
        solution = mask.solve(prior=each, **how)
    assert set(solution.estimate.displacement_tables) == set(mask.poses)
    assert solution["m0"].distortion.table == other
    assert solution["m1"].distortion.table == prior.table


@pytest.mark.slow
def test_where_a_table_cannot_be(mask, rough_prior):
    with pytest.raises(SolveError, match=r"turbulence cannot be found beside a prior that has a table"):
        mask.solve(prior=rough_prior, terms="turbulence", static=None, exposure_degree=None)
    with pytest.raises(InputError, match="table must be a DisplacementTable beside a mean, or None"):
        ld.Prior(None, static_sigma=1.0, table=rough_prior.table)
    rng = np.random.default_rng(0)
    noisy = 5 * rng.uniform(0, 0.15, (2, 40, 40))
    with pytest.raises(InputError, match=r"folds|ragged"):
        ld.Prior.from_model(ld.cameras.source.of_maps(*noisy))


@pytest.mark.slow
def test_the_static_of_a_solution_with_its_errors(tmp_path):
    """Found by ``rough_static``, written, read as a prior: the same map and errors, and these are the true ones."""
    mask = Mask(**ROUGH | {"size": 1500, "shift": 60.0, "highest": 9.0, "rough": 0.1})
    solution = mask.solve(terms="rough_static")
    solution.write(tmp_path / "solution.asdf")
    assert main(["prior", str(tmp_path / "solution.asdf"), "--out", str(tmp_path / "s.fits")]) == 0
    paths = map_paths(tmp_path / "s.fits")
    maps = np.array([fits.getdata(path) for path in paths])
    inner = np.s_[:, 30:-30:20, 30:-30:20]
    y, x = np.indices((1500, 1500))[inner]
    p = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    off = (maps[:2] - true_maps(mask, 1500))[inner].reshape(2, -1).T
    stated = np.sqrt(np.mean(maps[2:][inner] ** 2))
    assert 0.8 < np.std(beyond(off, p, 1500, 1)) / stated < 1.25
    prior, q = ld.Prior.from_file(paths, degree=5), mask.at()
    found = solution["m0"].distortion(q)
    again = q + (prior.mean @ basis.values(5, *basis.normalize(q, prior.shape))).T + prior.table(q)
    assert np.abs(beyond(again - found, q, 1500, 1)).max() < 1e-3
    everywhere = np.sqrt(np.mean(maps[2:] ** 2))
    assert_allclose(np.sqrt(np.sum(prior.static_sigma**2) / 8), everywhere, rtol=0.05)
    known = ld.Prior.from_solution(solution)
    assert_array_equal([fits.getdata(each) for each in write_maps(known, tmp_path / "t.fits", solution=solution)], maps)


def test_of_what_error_maps_are(tmp_path, capsys):
    """Of a further night, where several tell how far nights scatter: six of 0.05 px a coefficient, by numpy."""
    nights = Nights(2, nights=6, per=3, nightly=0.05, n_stars=90, degree=2, roll=60.0)
    solution = ld.solve(ld.Matches.from_table(nights.table, shape=(SIZE, SIZE)), degree=2)
    known, headers = ld.Prior.from_solution(solution), []
    for prior in (known, known.with_static_sigma(0.1)):
        prior.write(tmp_path / "prior.asdf", overwrite=True)
        line = ["prior", str(tmp_path / "prior.asdf"), "--out", str(tmp_path / "s.fits"), "--overwrite"]
        assert main(line) == 0
        headers.append([fits.getheader(path) for path in map_paths(tmp_path / "s.fits")])
        words = "".join(headers[-1][0]["HISTORY"])
        assert words in capsys.readouterr().out
        if prior is known:
            error = np.array([fits.getdata(path) for path in map_paths(tmp_path / "s.fits")[2:]])
    assert {header["ERRORSOF"] for header in headers[0]} == {"further night"}
    assert {header["ERRORSOF"] for header in headers[1]} == {"stated"}
    first, last = nights.table["epoch"].min(), nights.table["epoch"].max()
    for key, year in (("DATE-BEG", first), ("DATE-END", last)):
        assert Time(headers[0][0][key]).jyear == pytest.approx(year, abs=0.01)
    assert "CAMERA" not in headers[0][0]  # it has no name
    u, v = (each.ravel() for each in np.meshgrid(*2 * [np.linspace(-1, 1, 21)]))
    rng, squares_ = np.random.default_rng(0), []
    for _ in range(200):
        z = legendre.legval2d(u, v, field(rng, 0.05, 2).transpose(1, 2, 0)).T @ [1, 1j]
        design = np.stack([np.ones(len(u)), u + 1j * v], axis=1)
        z = z - design @ np.linalg.lstsq(design, z, rcond=None)[0]
        squares_.append(np.mean(np.abs(z) ** 2) / 2)
    assert 0.7 < np.sqrt(np.mean(error**2) / np.mean(squares_)) < 1.6  # that of their mean would be 0.4 of it
    assert errors_of(ld.Prior(np.zeros((2, 6)), shape=SHAPE))[0] == "exposure"
    camera = ld.combine_nights([known], name="NIRC2")
    assert errors_of(camera.prior())[0] == "night"
    camera.write(tmp_path / "camera.asdf")
    assert main(["prior", str(tmp_path / "camera.asdf"), "--out", str(tmp_path / "c.fits")]) == 0
    header = fits.getheader(tmp_path / "c_y_err.fits")
    assert (header["ERRORSOF"], header["CAMERA"]) == ("night", "NIRC2")


@pytest.mark.slow
def test_the_map_of_one_detector_of_a_camera(tmp_path, capsys):
    """Of a solution and of its camera in a file, by the id; without one it is refused (it was a map of zeros)."""
    night = ld.solve(four_detectors.matches("static", 1), static="fit", layout="fit", degree=2)
    results, camera = night.write(tmp_path / "solution.asdf").parent, tmp_path / "camera.asdf"
    night.camera.write(camera)
    rng = np.random.default_rng(1)  # as in four_detectors
    rng.uniform(size=(160, 2)), rng.normal(size=4), rng.normal(size=(4, 2))
    bend, size = rng.normal(size=(4, 2, 3)), four_detectors.SIZE
    x, y = np.meshgrid(*2 * [2 * (np.arange(0, size, 32) + 0.5) / size - 1])
    plane = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    found = {}
    for key in "02":
        assert main(["prior", str(results), "--ext", key, "--out", str(tmp_path / f"chip{key}.fits")]) == 0
        found[key] = np.stack(
            [fits.getdata(p)[::32, ::32].ravel() for p in map_paths(tmp_path / f"chip{key}.fits")[:2]]
        )
        errors = [fits.getdata(p) for p in map_paths(tmp_path / f"chip{key}.fits")[2:]]
        assert 0.001 < np.min(errors) <= np.max(errors) < 0.2
        prior = ld.Prior.from_file(camera, ext=int(key))
        assert prior.source == {"kind": "camera", "name": str(camera), "camera": "FOUR", "detector": key}
        assert_array_equal(prior.mean, ld.Prior.from_file(results, ext=key).mean)
    # what all share the exposures may have, and a linear map the layout; from the pixels to the undistorted places
    apart = found["2"] - found["0"] + (bend[2] - bend[0]) @ np.stack([x**2, x * y, y**2]).reshape(3, -1)
    left = apart.T - plane @ np.linalg.lstsq(plane, apart.T, rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 0.02
    wanted = r"is of camera FOUR with a focal plane: give it as camera .* detectors, 0, 1, 2, 3, by its id: .* --ext ID"
    for where, ext in ((results, None), (camera, None), (results, "SCI")):
        with pytest.raises(InputError, match=wanted):
            ld.Prior.from_file(where, ext=ext)
    with pytest.raises(InputError, match=wanted):
        ld.Prior.from_solution(night)
    capsys.readouterr()
    assert main(["prior", str(results), "--out", str(tmp_path / "zeros.fits")]) == 1
    assert "legdistort prior --ext ID" in capsys.readouterr().err
