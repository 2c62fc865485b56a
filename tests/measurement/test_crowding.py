"""Isolation of stars: the shift that neighbours would cause, and deformed stars, against rendered images."""

import numpy as np
import pytest
from ao_images import apart, identify
from astropy import units as u
from astropy.stats import biweight_scale
from astropy.table import QTable
from scipy.spatial import cKDTree

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.crowding import LIMIT, displacement, is_deformed, is_isolated
from legdistort.measurement.flags import UNUSABLE, Flag
from legdistort.measurement.profiles.shape_field import shape_field
from legdistort.simulation.pupil import PupilPSF
from legdistort.simulation.rendering import Moffat, add_noise, as_psf, render

SKY, GAIN, READ_NOISE = 100.0, 2.0, 10.0
PSF = Moffat(4.5, 3.0)


@pytest.mark.parametrize("distance", [1.2, 2.0, 3.0])
@pytest.mark.parametrize("fwhm", [3.0, 5.0])
def test_displacement_is_that_of_a_fit_that_knows_no_neighbour(distance, fwhm):
    """Least squares of one star to a noiseless image of two, linearised at the truth."""
    half, ratio, turn = int(np.ceil(2 * fwhm)), 0.01, 0.7
    psf, xy = Moffat(fwhm, 3.0), np.array([half, half], dtype=float)
    away = distance * fwhm * np.array([np.cos(turn), np.sin(turn)])
    shape, n = (2 * half + 1,) * 2, (2 * half + 1) ** 2

    def star(at, flux=1.0):
        return render(shape, [at], [flux], psf=psf).ravel()

    step = np.eye(2) * 1e-3
    slopes = [(star(xy + s) - star(xy - s)) / 2e-3 for s in step]
    design = np.column_stack([*slopes, star(xy), np.ones(n)])
    shift = np.linalg.lstsq(design, star(xy + away, ratio), rcond=None)[0][:2]
    ours = displacement([xy, xy + away], [1.0, ratio], fwhm)
    rtol = 0.15 if distance < 3 else 0.35  # there the box ends: little pull is left, and it hangs on the corners
    np.testing.assert_allclose(ours[0], shift, atol=rtol * np.hypot(*shift))
    assert ours[0] @ away > 0  # towards the neighbour


def test_displacements_add_as_vectors():
    xy, flux = np.array([[50.0, 50], [58, 50], [42, 50], [50, 60]]), np.array([1.0, 2.0, 2.0, 0.5])
    shift = displacement(xy, flux, 4.0)
    assert shift[0, 0] == pytest.approx(0, abs=1e-12)  # two equal ones on either side
    assert shift[0, 1] > 0
    one = displacement(xy[[0, 1]], flux[[0, 1]], 4.0)[0]
    double = displacement(xy[[0, 1]], [1.0, 4.0], 4.0)[0]
    np.testing.assert_allclose(double, 2 * one)
    turned = displacement(xy[:, ::-1], flux, 4.0)
    np.testing.assert_allclose(turned, shift[:, ::-1], atol=1e-12)
    assert (displacement([[0, 0], [100, 0]], [1, 1], 4.0) == 0).all()
    dark = displacement(xy, [1.0, -2.0, 2.0, 0.5], 4.0)
    assert np.isnan(dark[1]).all()
    assert dark[0, 0] < 0
    without = displacement(xy, flux, 4.0, sources=np.array([True, False, True, True]))
    np.testing.assert_allclose(without[0], dark[0])


def crowded(seed, *, spacing=8.0, size=500):
    """A frame with one star a (`spacing` FWHM)^2 at random, mean distance to the next one `spacing` / 2 FWHM."""
    rng = np.random.default_rng(seed)
    n = int((size / (spacing * PSF.fwhm)) ** 2)
    xy = rng.uniform(-10, size + 10, (n, 2))
    low, high = 2000.0**-0.5, 1e6**-0.5  # N(> flux) goes as flux^-1/2
    flux = (low + rng.uniform(size=n) * (high - low)) ** -2.0
    image = add_noise(render((size, size), xy, flux, psf=PSF, sky=SKY), rng, gain=GAIN, read_noise=READ_NOISE)
    table = ld.measure(Exposure(f"crowd{seed}", image, gain=GAIN))
    table = table[(table["flags"] & UNUSABLE) == 0]
    found = np.column_stack([table["x"].value, table["y"].value])
    error = np.column_stack([table["x_err"].value, table["y_err"].value])
    near = cKDTree(xy).query_ball_point(found, 0.6 * PSF.fwhm)
    brightest = [max(stars, key=lambda k: flux[k]) if stars else -1 for stars in near]
    known = np.array(brightest) >= 0
    return table[known], ((found - xy[brightest]) / error)[known]


@pytest.fixture(scope="module")
def crowd():
    tables, pulls = zip(*(crowded(seed) for seed in range(2)), strict=True)
    isolated = np.concatenate([is_isolated(table) for table in tables])
    return isolated, np.concatenate(pulls), np.concatenate([table["crowding"] for table in tables])


def test_isolated_stars_of_a_crowded_field_have_true_errors(crowd):
    isolated, pulls, _ = crowd
    assert 0.75 < isolated.mean() < 0.97  # not at the price of most stars
    assert biweight_scale(pulls[isolated].ravel()) == pytest.approx(1.0, abs=0.08)
    assert np.std(pulls[isolated]) < 1.25
    assert np.std(pulls[~isolated]) > 2 * np.std(pulls[isolated])
    assert np.mean(np.abs(pulls[isolated]) > 5) < 0.25 * np.mean(np.abs(pulls) > 5)


def test_column_and_flag(crowd):
    _, _, crowding = crowd
    assert (crowding >= 0).all()
    assert (crowding == 0).any()
    assert (crowding > LIMIT).any()


@pytest.mark.slow
def test_unresolved_pairs_are_deformed_and_single_stars_are_not():
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(*[np.arange(12) * 45 + 30.0] * 2), axis=-1).reshape(-1, 2)
    xy, flux = grid + rng.uniform(-3, 3, grid.shape), np.full(len(grid), 1e5)
    pairs = np.arange(0, len(grid), 12)  # one in twelve has a companion of a tenth, half a FWHM away
    turn = rng.uniform(0, 2 * np.pi, len(pairs))
    beside = xy[pairs] + 0.55 * PSF.fwhm * np.column_stack([np.cos(turn), np.sin(turn)])
    light = render((570, 570), [*xy, *beside], [*flux, *np.full(len(pairs), 1e4)], psf=PSF, sky=SKY)
    image = add_noise(light, rng, gain=GAIN, read_noise=READ_NOISE)
    table = ld.measure(Exposure("pairs", image, gain=GAIN))
    star = cKDTree(xy).query(np.column_stack([table["x"].value, table["y"].value]))[1]
    deformed = (table["flags"] & Flag.DEFORMED) != 0
    assert deformed[np.isin(star, pairs)].all()
    assert deformed[~np.isin(star, pairs)].mean() < 0.03
    assert not is_isolated(table)[deformed].any()


@pytest.mark.parametrize(
    ("shape", "least"),
    [
        pytest.param({"elongation": 2.0}, 0.4, marks=pytest.mark.sets),
        pytest.param({"coma": 0.4}, 0.9, marks=pytest.mark.slow),
    ],
)
def test_shapes_that_vary_over_the_field_make_no_star_deformed(shape, least):
    """Behind adaptive optics, images elongated and lopsided off the axis; one star in eight has a companion."""
    rng, size = np.random.default_rng(14), 1024
    psf = as_psf(PupilPSF(strehl=0.4, jitter=0.4, axis=(0.1, -0.1), **shape), (size, size))
    xy, flux = apart(rng, 120, size, 40, 25), 10 ** rng.uniform(4, 6, 120)
    turn = rng.uniform(0, 2 * np.pi, 15)
    beside = xy[:15] + 1.8 * np.column_stack([np.cos(turn), np.sin(turn)])  # 0.6 FWHM
    flux[:15] = np.geomspace(2e5, 1e6, 15)
    light = render((size, size), [*xy, *beside], [*flux, *0.15 * flux[:15]], psf=psf, sky=SKY)
    image = add_noise(light, rng, gain=GAIN, read_noise=READ_NOISE)
    table = ld.measure(Exposure("field", image, gain=GAIN), psf="moffat")
    found = identify(np.column_stack([table["x"].value, table["y"].value]), xy, 2.5)
    assert (found >= 0).all()
    deformed = (table["flags"][found] & Flag.DEFORMED) != 0
    off_axis = np.hypot(*(xy - size / 2).T) > size / 4
    assert deformed[15:][off_axis[15:]].mean() < 0.05
    assert is_isolated(table[found])[15:].mean() > 0.95
    assert deformed[:15].mean() > least


def test_expected_shape_is_that_of_images_blurred_across_the_field():
    """Half widths squared add up exactly: a blur that grows with the square of the distance, and a third are blends."""
    rng = np.random.default_rng(15)
    xy = rng.uniform(0, 1000, (80, 2))
    u, v = (xy / 500 - 1).T
    xx, yy, both = 2.0 + 1.5 * u**2, 2.0 + 1.5 * v**2, 1.5 * u * v
    form = np.linalg.inv(np.moveaxis([[xx, both], [both, yy]], -1, 0))
    a, b = form[:, 0, 0], form[:, 1, 1]
    truth = np.column_stack([np.log(a), np.log(b), form[:, 0, 1] / np.sqrt(a * b), 1.0 + 0.1 * u])
    shapes = truth + 0.01 * rng.standard_normal(truth.shape)
    shapes[:23, :2] -= rng.uniform(0.1, 0.5, (23, 1))
    covariance, use = np.tile(np.diag(np.full(4, 1e-4)), (80, 1, 1)), np.arange(80) < 70
    options = {"degree": 2, "fallback": np.median(truth, axis=0)}
    found, _ = shape_field(shapes, covariance, xy, use, **options)
    np.testing.assert_allclose(found[:70], truth[:70], atol=0.05)
    with_few, error = shape_field(shapes, covariance, xy, use & (np.arange(80) < 3), **options)
    np.testing.assert_array_equal(with_few, np.tile(options["fallback"], (80, 1)))
    assert not error.any()


def test_expected_shapes_differ_from_the_truth_by_their_errors():
    """Where 30 stars determine a polynomial of degree 2 and a term of the height, inside and in the corners."""
    rng, pulls = np.random.default_rng(16), []
    for _ in range(60):
        xy = np.vstack([rng.uniform(0, 500, (30, 2)), [[0, 0], [500, 500]]])
        u, v = (xy / 250 - 1).T
        truth = np.column_stack([-1.2 + 0.05 * u, -1.1 + 0.05 * v, 0.1 + 0 * u, 1.0 + 0 * u])
        noise = np.geomspace(0.005, 0.05, 32)
        shapes = truth + np.hypot(noise, 0.02)[:, None] * rng.standard_normal((32, 4))
        found, error = shape_field(
            shapes, noise[:, None, None] ** 2 * np.eye(4), xy, np.arange(32) < 30, degree=2,
            fallback=truth[0], peak=1 / noise,
        )  # fmt: skip
        pulls.append((found - truth) / np.sqrt(np.einsum("nii->ni", error)))
    np.testing.assert_allclose(np.std(pulls, axis=(0, 2)), 1.0, atol=0.35)
    assert abs(np.std(pulls) - 1.0) < 0.12


def test_few_bright_stars_are_compared_with_what_they_determine():
    """Their shapes are ten times as exact as the polynomial that the faint ones determine with them."""
    rng, found = np.random.default_rng(17), []
    for _ in range(40):
        snr = np.concatenate([np.geomspace(400, 1000, 8), np.geomspace(60, 200, 24)])
        noise = 4 / snr
        shapes = np.array([-1.2, -1.1, 0.1, 1.0]) + noise[:, None] * rng.standard_normal((32, 4))
        given = {"xy": rng.uniform(0, 500, (32, 2)), "peak": snr**2, "snr": snr, "usable": np.ones(32, dtype=bool)}
        found.append(is_deformed(shapes, np.eye(4) * noise[:, None, None] ** 2, chi2=np.ones(32), **given)[:8])
    assert np.mean(found) < 0.01


def test_shapes_that_scatter_make_no_star_deformed():
    """A profile that differs from star to star by much more than the noise of the shapes."""
    rng = np.random.default_rng(5)
    shapes = np.array([-1.2, -1.2, 0.0, 1.0]) + 0.1 * rng.standard_normal((200, 4))
    covariance = np.tile(np.diag(np.full(4, 1e-6)), (200, 1, 1))
    usable, snr = np.ones(200, dtype=bool), rng.uniform(10, 100, 200)
    given = {"xy": rng.uniform(0, 500, (200, 2)), "peak": snr**2, "snr": snr, "chi2": np.ones(200), "usable": usable}
    assert is_deformed(shapes, covariance, **given).mean() < 0.05
    few = {name: values[:5] for name, values in given.items()}
    assert not is_deformed(shapes[:5], covariance[:5], **few).any()  # too few to tell


def test_bright_stars_that_the_detector_widens_are_not_deformed():
    """A response that falls towards the full well widens stars in proportion to their height."""
    rng = np.random.default_rng(6)
    peak = np.geomspace(1e2, 5e4, 150)
    snr = np.sqrt(peak) * 4
    noise = 1.0 / snr
    shapes = np.array([-1.2, -1.1, 0.1, 1.0]) + noise[:, None] * rng.standard_normal((150, 4))
    shapes[:, :2] -= 0.03 * peak[:, None] / peak.max()
    shapes[:, 3] += 0.01 * peak / peak.max()
    shapes[[30, 100, 140]] += [-0.2, -0.1, 0.1, 0.0]  # companions
    given = {"xy": rng.uniform(0, 500, (150, 2)), "peak": peak, "snr": snr, "usable": np.ones(150, dtype=bool)}
    found = is_deformed(shapes, np.eye(4) * noise[:, None, None] ** 2, chi2=np.ones(150), **given)
    assert found[[100, 140]].all()
    assert found.mean() < 0.04


def test_limit():
    table = QTable({"crowding": [0.0, 2.0, 5.0, np.inf], "flags": [0, 256, 0, 0]})
    np.testing.assert_array_equal(is_isolated(table), [True, False, False, False])
    np.testing.assert_array_equal(is_isolated(table, 6.0), [True, False, True, False])
    for everything in (None, np.inf):
        assert is_isolated(table, everything).all()
    assert is_isolated(table["flags",]).all()  # tables of other programs know of blends alone
    with pytest.raises(InputError, match="isolation must be a positive number of standard errors, or None, got 0"):
        is_isolated(table, 0)


def test_blends_of_other_programs_are_left_out_where_most_rows_are_none():
    """As SExtractor has FLAGS 1 to 3; of a table of blends no star would be left."""
    table = QTable({"flags": np.ma.array([0, 32, 0, 64, 33], mask=[False, False, True, False, False])})
    np.testing.assert_array_equal(is_isolated(table), [True, False, True, True, False])
    assert is_isolated(table, None).all()
    assert is_isolated(QTable({"flags": [32, 32, 0]})).all()


def test_match_says_what_it_leaves_out_of_lists(caplog):
    """Blended rows displaced, as windowed positions are: every star but these stays, and numbers are said."""
    table = ld.simulate_matches(n_stars=40, n_exposures=5, dither=50, seed=1).matches.table
    table.remove_column("star")
    table["flags"] = 0
    table["flags"][::10] = 32
    table["flags"][5::40] = 1
    table["x"][::10] += 0.3 * u.pix
    n = len(table)
    with caplog.at_level("INFO", logger="legdistort"):
        kept = ld.match(table, shape=(2048, 2048)).table
    assert not np.any(kept["flags"])
    assert f"{len(range(5, n, 40))} of {n} detections are left out for their flags (SATURATED" in caplog.text
    assert (
        "are not isolated and left out (flagged as blended in their lists; --isolation inf keeps them)" in caplog.text
    )
    assert np.any(ld.match(table, shape=(2048, 2048), isolation=None).table["flags"] == 32)


def test_match_leaves_out_what_is_not_isolated():
    rng = np.random.default_rng(6)
    xy = np.stack(np.meshgrid(np.arange(8) * 60 + 45.0, np.arange(5) * 90 + 50.0), axis=-1).reshape(-1, 2)
    xy += rng.uniform(-20, 20, xy.shape)
    rows = []
    for name, shift in (("a", 0.0), ("b", 12.0), ("c", -7.0), ("d", 3.0)):
        for k, (x, y) in enumerate(xy + shift):
            rows.append((name, x, y, 0.01, 0.01, 1e4 + k, 0, 5.0 if k < 10 else 0.5))
    names = ("exposure", "x", "y", "x_err", "y_err", "flux", "flags", "crowding")
    table = QTable(rows=rows, names=names)
    assert len(ld.match(table, shape=(520, 520)).stars) == 30
    assert len(ld.match(table, shape=(520, 520), isolation=10).stars) == 40
    assert len(ld.match(table, shape=(520, 520), isolation=None).stars) == 40
    with pytest.raises(InputError, match="isolation must be a positive number"):
        ld.match(table, shape=(520, 520), isolation=-1)
