"""The synthetic truth, held against evaluations that share no code with it."""

import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS
from numpy.polynomial import legendre

from legdistort.exceptions import FoldError, InputError
from legdistort.geometry import basis, similarity
from legdistort.geometry.gsaoi import GsaoiMap, gsaoi_polynomials, gsaoi_static
from legdistort.inputs.exposure_files import read_exposures
from legdistort.priors.prior import Prior
from legdistort.simulation.gsaoi_night import Night
from legdistort.simulation.observations import simulate_exposures, simulate_gsaoi_matches, simulate_matches
from legdistort.simulation.truth import displacement


def arrays(matches):
    obs = matches.observations
    return obs.exposure, obs.star, obs.xy


def paper_displacement(a, x, y):
    """Equation of section 2.1 spelled out for one point of [-1, 1]^2."""

    def L(n, t):
        return legendre.Legendre.basis(n)(t) / np.sqrt(2 / (2 * n + 1))

    degree = int(np.sqrt(2 * a.shape[1])) - 1
    return sum(a[:, l * (l + 1) // 2 + k] * L(l - k, x) * L(k, y) for l in range(degree + 1) for k in range(l + 1))  # noqa: E741


@pytest.fixture(scope="module")
def small():
    return simulate_exposures(small=True, seed=1)


# --- the published map -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("detector", [1, 2, 3, 4])
def test_gsaoi_is_the_published_polynomial(shared_data, detector):
    path = shared_data / "static_distortion" / "gsaoi_dragons" / "gsaoi_static_distortion.json"
    parts = [part["parameters"][detector - 1] for part in json.loads(path.read_text())["forward"]]
    xy = np.random.default_rng(0).uniform(-0.5, 2047.5, (50, 2))
    x, y = (xy + 1).T
    expected = [
        sum(v * x ** int(k[1]) * y ** int(k[3]) for part in parts for k, v in part[letter].items()) for letter in "xy"
    ]
    np.testing.assert_allclose(gsaoi_static(detector)(*xy.T), expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(GsaoiMap(detector).to_arcsec(xy).T, expected, rtol=0, atol=1e-10)


def test_detector_two_is_the_lower_left():
    middles = np.array([gsaoi_static(k)(1023.5, 1023.5) for k in (1, 2, 3, 4)])
    assert np.all(middles[1] < -25)
    assert np.argmin(middles.sum(axis=1)) == 1


def test_gsaoi_on_coarser_pixels_is_the_same_field():
    corners = np.array([[-0.5, -0.5], [2047.5, -0.5], [2047.5, 2047.5], [300.0, 1200.0]])
    coarse = (corners + 0.5) / 4 - 0.5
    np.testing.assert_allclose(gsaoi_static(size=512)(*coarse.T), gsaoi_static()(*corners.T), rtol=0, atol=1e-10)
    assert GsaoiMap(size=512).pixel_scale == pytest.approx(4 * GsaoiMap().pixel_scale, rel=1e-9)


def test_gsaoi_map_inverts_to_rounding():
    instrument = GsaoiMap()
    q = np.random.default_rng(0).uniform(-500, 2500, (200, 2))
    np.testing.assert_allclose(instrument.undistort(instrument.distort(q)), q, rtol=0, atol=1e-9)


def test_gsaoi_static_coefficients_agree_with_the_prior_of_the_same_model():
    """Two routes that share no code: Newton + legvander2d here, central differences + projection there."""
    prior = Prior.from_model(gsaoi_static(), shape=(2048, 2048), direction="detector_to_reference", degree=3)
    truth = simulate_gsaoi_matches(seed=0).truth
    np.testing.assert_allclose(truth.static, prior.mean, rtol=0, atol=1e-6)
    assert 2 < np.abs(truth.static[:, 3:]).max() < 6  # L2 modes of about 4 px, not an affine map


def test_gsaoi_rejects():
    with pytest.raises(InputError, match="detector must be 1, 2, 3 or 4, got 5"):
        gsaoi_polynomials(5)
    with pytest.raises(InputError, match="size"):
        gsaoi_static(size=0)
    with pytest.raises(FoldError, match="make dithers smaller"):
        GsaoiMap().distort([[1e6, 1e6]])


# --- catalogues ----------------------------------------------------------------------------------------------------


def test_default_is_simulation_one():
    sim = simulate_matches()
    truth = sim.truth
    assert len(sim.matches.table) == 300
    assert sim.matches.names == truth.names
    assert len(truth.names) == 10
    assert truth.positions.shape == (30, 2)
    assert truth.coefficients.shape == (10, 2, 10)
    assert np.all(sim.matches.table["x_err"].value == 0.14)
    np.testing.assert_allclose(truth.dynamic.mean(axis=0), 0, atol=1e-14)
    for name in truth.names:
        np.testing.assert_array_equal(sim.matches.poses[name], similarity.identity())
    assert repr(sim) == "<Simulation: <Matches: 300 observations of 30 stars in 10 exposures>>"
    assert repr(truth) == "<Truth: 30 stars, 10 exposures, 10 modes>"


@pytest.mark.slow
def test_coefficients_have_the_stated_spread():
    sims = [simulate_matches(seed=k, zero_mean=False) for k in range(40)]
    assert np.std([s.truth.static for s in sims]) == pytest.approx(1.5, rel=0.08)
    assert np.std([s.truth.dynamic for s in sims]) == pytest.approx(0.9, rel=0.05)
    spectrum = np.arange(10.0)
    dynamic = np.concatenate([simulate_matches(seed=k, dynamic=spectrum).truth.dynamic for k in range(40)])
    np.testing.assert_allclose(dynamic.std(axis=(0, 1)), spectrum * np.sqrt(0.9), rtol=0.12)


def test_seed_decides_everything():
    first, again, other = (simulate_matches(seed=k, dither=100.0) for k in (3, 3, 4))
    np.testing.assert_array_equal(arrays(first.matches)[2], arrays(again.matches)[2])
    assert not np.any(np.isin(first.truth.positions, other.truth.positions))


def test_other_errors_keep_stars_and_distortions():
    a, b = simulate_matches(seed=3, sigma=0.1), simulate_matches(seed=3, sigma=0.2)
    np.testing.assert_array_equal(a.truth.coefficients, b.truth.coefficients)
    exact = arrays(simulate_matches(seed=3, noise=0).matches)[2]
    np.testing.assert_allclose(2 * (arrays(a.matches)[2] - exact), arrays(b.matches)[2] - exact, atol=1e-11)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"degree": 5, "shape": (600, 900), "n_stars": 60},
        {"dither": 200.0, "seen": 0.8, "n_stars": 50},
        {"n_exposures": 4, "rotations": [0, 90, 180, 33.0], "flips": [False, True, False, True], "dither": 50.0},
    ],
)
def test_positions_follow_the_equation_of_the_paper(settings):
    sim = simulate_matches(noise=0, seed=5, **settings)
    truth = sim.truth
    ny, nx = truth.shape
    exposure, star, xy = arrays(sim.matches)
    star = sim.matches.stars[star]
    for i, j, observed in zip(exposure[::7], star[::7], xy[::7], strict=True):
        q = similarity.apply(truth.poses[truth.names[i]], truth.positions[j])
        u, v = (q[0] + 0.5) * 2 / nx - 1, (q[1] + 0.5) * 2 / ny - 1
        assert max(abs(u), abs(v)) <= 1
        np.testing.assert_allclose(observed, q + paper_displacement(truth.coefficients[i], u, v), rtol=0, atol=1e-9)
        np.testing.assert_allclose(truth.distort(truth.names[i], truth.positions[j]), observed, rtol=0, atol=1e-9)


def test_truth_and_package_basis_agree():
    truth = simulate_matches(degree=6, shape=(400, 700)).truth
    xy = np.random.default_rng(0).uniform(0, 400, (100, 2))
    expected = xy + (truth.coefficients[2] @ basis.values(6, *basis.normalize(xy, truth.shape))).T
    np.testing.assert_allclose(truth.distort("exp02", xy), expected, rtol=0, atol=1e-10)


def test_noise_has_the_stated_errors():
    sigma = np.random.default_rng(0).uniform(0.01, 0.3, (20, 400, 2))
    settings = {"n_stars": 400, "n_exposures": 20, "sigma": sigma, "corr": 0.6}
    noisy, exact = (simulate_matches(noise=k, **settings).matches for k in (1, 0))
    z = (arrays(noisy)[2] - arrays(exact)[2]) / sigma.reshape(-1, 2)
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=0.04)
    np.testing.assert_allclose(np.cov(z.T), [[1, 0.6], [0.6, 1]], atol=0.04)
    cov = noisy.observations.covariance
    np.testing.assert_allclose(cov[:, 2], 0.6 * np.sqrt(cov[:, 0] * cov[:, 1]))
    np.testing.assert_allclose(noisy.table["y_err"].value, sigma[..., 1].ravel())


def test_dithered_stars_are_seen_only_on_the_detector():
    sim = simulate_matches(n_stars=200, dither=300.0, margin=20.0, min_exposures=3)
    truth = sim.truth
    exposure, star, _ = arrays(sim.matches)
    seen = np.zeros((10, 200), dtype=bool)
    seen[exposure, sim.matches.stars[star]] = True
    for row, name in zip(seen, truth.names, strict=True):
        q = similarity.apply(truth.poses[name], truth.positions)
        np.testing.assert_array_equal(row, np.all((q >= 19.5) & (q <= 2027.5), axis=1))
    assert seen.sum(axis=0).min() >= 3
    assert seen.mean() < 0.95
    shifts = np.array([simulate_matches(dither=300.0, seed=k).truth.poses["exp00"][:, 2] for k in range(200)])
    assert np.sqrt(np.mean(np.sum(shifts**2, axis=1))) == pytest.approx(300, rel=0.1)


def test_fraction_seen_and_nominal_poses():
    sim = simulate_matches(n_stars=500, seen=0.7, pose_error=5.0, n_exposures=40)
    assert len(sim.matches.table) / 20000 == pytest.approx(0.7, abs=0.02)
    off = [sim.matches.poses[name] - sim.truth.poses[name] for name in sim.truth.names]
    assert np.std([o[:, 2] for o in off]) == pytest.approx(5, rel=0.3)
    assert np.all([o[:, :2] == 0 for o in off])


def test_rotation_turns_about_the_middle_of_the_detector():
    truth = simulate_matches(n_exposures=2, rotations=[0, 90], shape=(100, 100)).truth
    np.testing.assert_allclose(similarity.apply(truth.poses["exp01"], [59.5, 49.5]), [49.5, 59.5], atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_stars": 0}, "n_stars must be a positive integer, got 0"),
        ({"n_exposures": 2.5}, "n_exposures must be a positive integer, got 2.5"),
        ({"degree": -1}, "degree must be an integer of at least 0, got -1"),
        ({"sigma": 0.0}, "use noise=0"),
        ({"sigma": np.ones(7)}, r"sigma must broadcast to \(10, 30\)"),
        ({"static": np.ones(9)}, r"static must be a number, \(10,\)"),
        ({"dynamic": -1.0}, "dynamic holds standard deviations"),
        ({"rotations": [0.0, 1.0]}, "rotations must have one value for each of the 10 exposures"),
        ({"seen": 0.0}, "seen=0.0"),
        ({"corr": 1.0}, "corr=1.0"),
        ({"margin": 1100.0}, "only 0 of 30 stars found a place on 4 exposures or more: the dithers"),
        ({"dither": 20000.0}, "leave too little of the detector that 4 exposures share; make them smaller"),
    ],
)
def test_bad_arguments(settings, message):
    with pytest.raises(InputError, match=message):
        simulate_matches(**settings)


def test_unknown_exposure_is_named():
    with pytest.raises(InputError, match=r"no exposure 'x' was simulated; there are exp00"):
        simulate_matches().truth.distort("x", [[0.0, 0.0]])


def test_grid_covers_the_detector():
    truth = simulate_matches(n_exposures=3, rotations=[0, 90, 45], flips=[0, 1, 0], shape=(300, 200)).truth
    q = similarity.apply(truth.poses["exp01"], truth.grid("exp01", 10))
    assert q.shape == (100, 2)
    np.testing.assert_allclose(q.min(axis=0), [9.5, 14.5])
    np.testing.assert_allclose(q.max(axis=0), [189.5, 284.5])


# --- the night -----------------------------------------------------------------------------------------------------


def test_night_is_like_the_paper():
    counts, errors, rms = [], [], []
    for seed in range(4):
        sim = simulate_gsaoi_matches(seed=seed)
        counts += np.bincount(arrays(sim.matches)[0]).tolist()
        errors.append(sim.matches.table["x_err"].value)
        truth = sim.truth
        q = truth.grid("exp00", 30)
        q = similarity.apply(truth.poses["exp00"], q)
        rms += [np.sum(displacement(a, q, truth.shape) ** 2, axis=1).mean() for a in truth.dynamic]
    assert len(truth.names) == 11
    assert 60 <= np.mean(counts) <= 80
    assert min(np.concatenate(errors)) >= 0.002 * 0.99
    assert max(np.concatenate(errors)) <= 0.14 * 1.01
    assert np.sqrt(np.mean(rms)) == pytest.approx(0.4, rel=0.1)
    assert np.all(truth.dynamic[:, :, 0] == 0)


def test_night_positions_are_static_then_dynamic():
    """The direct model backwards: without the dynamic part, the published polynomials lead to the undistorted plane."""
    truth = simulate_gsaoi_matches(seed=2).truth
    model = gsaoi_static(2)
    name, i = truth.names[3], 3
    xy = truth.distort(name, truth.positions)
    q = similarity.apply(truth.poses[name], truth.positions)
    static = xy - (truth.dynamic[i] @ basis.values(3, *basis.normalize(q, truth.shape))).T
    arcsec = np.stack(model(*static.T), axis=-1)
    np.testing.assert_allclose(arcsec, similarity.apply(truth.instrument.similarity, q), rtol=0, atol=1e-9)
    assert 15 < np.abs(xy - q).max() < 60


@pytest.mark.slow
def test_images_and_catalogue_are_twins(small):
    twin = simulate_gsaoi_matches(small=True, seed=1)
    np.testing.assert_array_equal(small.truth.positions, twin.truth.positions)
    np.testing.assert_array_equal(small.truth.coefficients, twin.truth.coefficients)
    np.testing.assert_array_equal(small.truth.flux, twin.truth.flux)


def test_images_have_shape_type_and_seed(small):
    assert list(small.hdus) == [f"exp{i:02d}" for i in range(6)]
    again = simulate_exposures(small=True, seed=1)
    for name, hdulist in small.hdus.items():
        assert hdulist[0].data.shape == (512, 512)
        assert hdulist[0].data.dtype == np.uint16
        np.testing.assert_array_equal(hdulist[0].data, again.hdus[name][0].data)
    assert repr(small) == "<SimulatedExposures: 6 images of 512 x 512 pixels, 70 stars>"


def test_image_noise_is_photon_and_read_noise():
    image = simulate_exposures(n_stars=1, n_exposures=1, size=256, dither=0.0, sigma_range=(0.14, 0.14)).hdus["exp00"]
    data = image[0].data.astype(float)
    night = Night()
    expected = np.sqrt(night.sky / night.gain + (night.read_noise / night.gain) ** 2 + 1 / 12)
    assert np.median(data) == pytest.approx(night.sky, abs=1)
    assert data[np.abs(data - night.sky) < 5 * expected].std() == pytest.approx(expected, rel=0.05)


def test_saturation_clips():
    sim = simulate_exposures(small=True, saturation=3000.0, n_exposures=2)
    assert max(h[0].data.max() for h in sim.hdus.values()) == 3000


def test_stars_stand_where_the_truth_says():
    sim = simulate_exposures(small=True, noise=False, n_stars=3, n_exposures=2, sigma_range=(0.005, 0.01))
    for name, hdulist in sim.hdus.items():
        data = hdulist[0].data.astype(float) - Night().sky
        for x, y in sim.truth.distort(name, sim.truth.positions):
            if min(x, y) < 30 or max(x, y) > 481:
                continue
            rows, columns = np.mgrid[round(y) - 22 : round(y) + 23, round(x) - 22 : round(x) + 23]
            cut = data[rows, columns]
            # a square about a rounded centre cuts the wings unevenly: weight by a wide window about the truth instead
            cut = cut * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 5.0**2))
            centre = np.array([np.sum(cut * columns), np.sum(cut * rows)]) / cut.sum()
            np.testing.assert_allclose(centre, [x, y], rtol=0, atol=0.003)


def test_header_points_off_by_the_stated_amount(small):
    truth = small.truth
    middle = np.array([[255.5, 255.5]])
    directions = []
    for name, hdulist in small.hdus.items():
        header = WCS(hdulist[0].header).pixel_to_world(*similarity.apply(truth.poses[name], middle).T)
        true = truth.sky.to_sky(middle)
        assert header.separation(true)[0].arcsec == pytest.approx(0.3, rel=1e-3)
        directions.append(true.position_angle(header)[0].deg)
    assert np.ptp(directions) > 20


def test_sky_is_north_up_east_left(small):
    sky = small.truth.sky.to_sky(np.array([[255.5, 255.5], [255.5, 355.5], [155.5, 255.5]]))
    assert sky[0].position_angle(sky[1]).wrap_at("180d").deg == pytest.approx(0, abs=1e-6)
    assert sky[0].position_angle(sky[2]).deg == pytest.approx(90, abs=0.05)
    assert sky[0].separation(sky[1]).arcsec == pytest.approx(100 * truth_scale(small), rel=1e-6)


def truth_scale(night):
    return night.truth.instrument.pixel_scale


def test_written_files_are_read_as_exposures(small, tmp_path):
    paths = small.write(tmp_path)
    exposures = read_exposures(paths)
    assert [e.name for e in exposures] == list(small.truth.names)
    np.testing.assert_array_equal(exposures[2].data, small.hdus["exp02"][0].data)
    assert (exposures[0].gain, exposures[0].read_noise, exposures[0].saturation) == (2.0, 15.0, 50000.0)
    assert fits.getheader(paths[0])["DATE-OBS"] == "2014-12-08T03:00:00"
    table = QTable.read(tmp_path / "truth.ecsv")
    np.testing.assert_array_equal(table["x"].value, small.truth.positions[:, 0])
    np.testing.assert_allclose(table.meta["exp01"]["coefficients"], small.truth.coefficients[1])
    assert table["ra"].unit == "deg"


@pytest.mark.slow
def test_unknown_setting_is_named():
    with pytest.raises(InputError, match="unknown setting 'dithers'; a night has n_exposures"):
        simulate_exposures(dithers=3)
    with pytest.raises(InputError, match="sigma_range"):
        simulate_gsaoi_matches(sigma_range=(0.1, 0.01))
    with pytest.raises(InputError, match=r"only \d+ of 300 stars found a place"):
        simulate_gsaoi_matches(n_stars=300, small=True)
