"""Crowded frames: one PSF for all stars, subtracted and searched for more, against frames made without the package."""

from dataclasses import replace

import king_field as king
import numpy as np
import pytest
from scipy.spatial import cKDTree

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.crowding import is_crowded
from legdistort.measurement.detection import Frame
from legdistort.measurement.flags import UNUSABLE, Flag
from legdistort.measurement.profiles import moffat
from legdistort.measurement.scene import measuring
from legdistort.measurement.scene.confusion import confusion
from legdistort.measurement.scene.joint_fit import Scene
from legdistort.measurement.scene.moffat_field import MoffatField

SIZE = 256
#: Two pairs, half a FWHM apart: x, y, flux.
PAIRS = np.array([[40.3, 50.0, 6e4], [42.2, 50.7, 4e4], [170.0, 160.4, 3e5], [171.1, 162.6, 1e5]])


def exposure(data, **changed):
    return Exposure("crowd", data, **({"gain": 1.0, "read_noise": king.READ_NOISE} | changed))


def places(table):
    return np.column_stack([table["x"].value, table["y"].value])


@pytest.fixture(scope="module")
def field():
    return king.king_field(260, 3, size=SIZE, core=60.0, extra=PAIRS)


@pytest.fixture(scope="module")
def table(field):
    return ld.measure(exposure(field.data))


def true_psf():
    x = np.arange(-80, 81) / 4
    return ld.EffectivePSF.from_array(king.moffat(x, x[:, None]), oversampling=4, source="true")


def test_stars_of_a_crowd_are_found_with_true_errors(field, table):
    rows, left = king.paired(field, places(table))
    inside = ((field.xy > 3) & (field.xy < SIZE - 4)).all(axis=1)
    for low, high, least in ((10, 30, 0.8), (30, 100, 0.93), (100, np.inf, 0.95)):
        stars = inside & (field.snr >= low) & (field.snr < high)
        assert (rows[stars] >= 0).mean() >= least
    assert left.sum() <= 2
    good = inside & (rows >= 0) & ((table["flags"][rows] & (UNUSABLE | Flag.DEFORMED)) == 0)
    error = np.column_stack([table["x_err"].value, table["y_err"].value])
    off = (places(table)[rows] - field.xy)[good]
    pull = off / error[rows[good]]
    assert 0.7 < 1.4826 * np.median(np.abs(pull)) < 1.15
    assert np.mean(np.abs(pull) > 5) < 0.02
    bound = king.joint_bounds(field)[good]
    assert 1.4826 * np.median(np.abs(off / bound)) < 1.2
    assert good.sum() > 0.9 * np.count_nonzero(rows >= 0)


def test_pairs_of_half_a_width_are_two_stars(table):
    rows = cKDTree(places(table)).query(PAIRS[:, :2])[1]
    assert len(set(rows)) == 4
    error = np.column_stack([table["x_err"].value, table["y_err"].value])[rows]
    assert np.all(np.abs(places(table)[rows] - PAIRS[:, :2]) < 4 * error)
    assert np.all(np.abs(table["flux"][rows] - PAIRS[:, 2]) < 4 * table["flux_err"][rows])
    assert np.all((table["flags"][rows] & Flag.BLENDED) != 0)


@pytest.mark.slow
def test_unit_and_orientation_do_not_matter(field, table):
    turned = ld.measure(exposure(2.5 * field.data.T.copy(), gain=0.4, read_noise=king.READ_NOISE))
    distance, row = cKDTree(places(turned)[:, ::-1]).query(places(table))
    same = distance < 0.3 * table["x_err"].value
    assert same.mean() > 0.95
    assert abs(len(turned) - len(table)) <= 2
    assert len(set(row[same])) == same.sum()
    off = turned["flux"][row[same]] / 2.5 - table["flux"][same]
    assert np.mean(np.abs(off) < 0.3 * table["flux_err"][same]) > 0.97


@pytest.mark.slow
def test_true_psf_serves_as_well(field, table):
    given = ld.measure(exposure(field.data), psf=true_psf())
    assert set(given["psf"]) == {"true"}
    distance, row = cKDTree(places(given)).query(places(table))
    same = (distance < table["x_err"].value) & (table["flux"] / table["flux_err"] > 20)
    assert same.sum() > 30
    assert np.median(given["flux"][row[same]] / table["flux"][same]) == pytest.approx(1, abs=0.02)


def test_frames_that_are_no_crowd_are_none_of_this(monkeypatch):
    def never(*args):
        raise AssertionError("a sparse frame has been taken for a crowd")

    monkeypatch.setattr(measuring, "measure_crowd", never)
    rng = np.random.default_rng(5)
    xy, flux = rng.uniform(10, 290, (40, 2)), 10 ** rng.uniform(3, 5, 40)
    data = rng.poisson(king.rendered(xy, flux, 300) + king.SKY).astype(np.float32)
    assert len(ld.measure(exposure(data, read_noise=None))) > 25
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(-1, 2) * 10
    pairs = grid[:12] + [2, 0]
    none, flat = np.zeros((200, 200), dtype=bool), np.zeros((200, 200))
    frame = Frame(flat, flat + 1, flat, ~none, none, 1.0)
    assert not is_crowded(frame, grid, 4.0)
    assert not is_crowded(frame, np.vstack([grid, pairs[:10]]), 4.0)  # 20 of 410
    assert is_crowded(frame, np.vstack([grid, pairs]), 4.0)
    assert not is_crowded(frame, np.vstack([grid[:30], pairs[:4]]), 4.0)  # too few to be told
    trail = none.copy()
    trail[0, :60] = True
    assert not is_crowded(replace(frame, saturated=trail), np.vstack([grid, pairs]), 4.0)


def test_gaps_and_saturated_stars(field):
    data, mask = field.data.copy(), np.zeros(field.data.shape, dtype=bool)
    data[100:106, 60:90] = np.nan
    mask[100:106, 60:90] = True
    found = ld.measure(exposure(np.where(mask, 0, data), mask=mask, saturation=3000.0))
    saturated = (found["flags"] & Flag.SATURATED) != 0
    assert saturated.any()
    top = field.noiseless[tuple(np.clip(np.round(places(found)).astype(int), 0, SIZE - 1).T[::-1])]
    assert np.all(saturated[top > 4000])
    x, y = places(found).T
    gap = (x > 64) & (x < 86) & (y > 101) & (y < 105)
    assert np.all((found["flags"][gap] & (UNUSABLE | Flag.MASKED)) != 0)


@pytest.mark.parametrize("kind", ["moffat", "effective"])
def test_slopes_are_derivatives(kind):
    shapes = np.tile(moffat.shape(4.0), (9, 9, 1))
    shapes[..., 0] += np.linspace(0, 0.1, 9)[:, None]
    psf = MoffatField(shapes, (200, 200)) if kind == "moffat" else true_psf()
    centres, params = np.array([[50, 60], [120, 30]]), np.array([[0.2, -0.3, 100.0], [0.4, 0.1, 7.0]])
    light, by = psf.light(params, centres, 8, slopes=True)
    np.testing.assert_allclose(light, psf.light(params, centres, 8))
    for k in range(3):
        step = np.eye(3)[k] * 1e-4
        ahead, behind = (psf.light(params + s, centres, 8) for s in (step, -step))
        # the shape at the place is taken as fixed
        np.testing.assert_allclose(by[:, k], (ahead - behind) / 2e-4, atol=2e-3 * np.abs(by[:, k]).max())
    assert psf.light(params, centres, 18).sum(axis=1) == pytest.approx(params[:, 2], rel=0.04)


def test_joint_fit_is_that_of_dense_least_squares():
    rng, size = np.random.default_rng(8), 60
    psf = MoffatField.constant(moffat.shape(4.0), (size, size))
    xy, flux = np.array([[25.3, 30.1], [28.9, 31.0], [31.5, 28.4]]), np.array([4e3, 2e3, 3e3])

    def model(params):
        params = params.reshape(-1, 3)
        image = np.zeros((size, size))
        for x, y, f in params:
            image += psf.light(np.array([[x - 30, y - 30, f]]), np.array([[30, 30]]), 29).reshape(59, 59)[
                np.ix_(np.arange(60) % 59, np.arange(60) % 59)
            ] * np.outer(np.arange(60) < 59, np.arange(60) < 59)
        return np.roll(image, (1, 1), axis=(0, 1))

    truth = np.column_stack([xy, flux]).ravel()
    data = model(truth) + rng.normal(0, 5, (size, size))
    ones = np.ones((size, size), dtype=bool)
    frame = Frame(data.astype(np.float32), np.full((size, size), 25.0, np.float32), 0 * data, ones, ~ones, 0.0)
    scene = Scene(frame, psf, 20, 0.0)
    scene.add(xy + 0.3, 0.8 * flux)
    scene.fit(np.ones(3, dtype=bool), 30)
    ours = np.column_stack([scene.xy, scene.flux]).ravel()
    params = truth.copy()
    for _ in range(6):
        steps = np.tile([1e-4, 1e-4, 1e-1], 3)
        slopes = np.stack([(model(params + s) - model(params - s)).ravel() / (2 * s.sum()) for s in np.diag(steps)])
        params += np.linalg.solve(slopes @ slopes.T, slopes @ (data - model(params)).ravel())
    covariance = 25 * np.linalg.inv(slopes @ slopes.T)
    error = np.sqrt(np.diag(covariance))
    np.testing.assert_array_less(np.abs(ours - params), 0.1 * error)
    stated = np.sqrt(np.einsum("nii->ni", scene.covariance())).ravel()
    np.testing.assert_allclose(stated, error, rtol=0.03)


def test_confusion_is_the_variance_of_shifts_by_stars_not_seen():
    """Against stars drawn by the same law, each left in as a fit of one star to both would."""
    rng, sigma, threshold, side = np.random.default_rng(9), 1.7, 5.0, 600.0
    n = 9000
    snr = 2.0 * (1 - rng.random(n)) ** (-1 / 1.0)  # N(> u) as 1 / u
    xy = rng.uniform(0, side, (n, 2))
    bright = snr > 15
    stated = confusion(xy[snr > 5], snr[snr > 5], snr[snr > 5], sigma=sigma, threshold=threshold, area=side**2)
    here = (snr[snr > 5] > 40) & (snr[snr > 5] < 60)
    shifts = []
    for _ in range(4000):  # neighbours of a star of 50, out to 6 sigma, the faintest ones too
        m = rng.poisson(10 * n / side**2 * np.pi * (6 * sigma) ** 2)
        u, d, angle = 0.2 / (1 - rng.random(m)), 6 * sigma * np.sqrt(rng.random(m)), rng.uniform(0, 2 * np.pi, m)
        square = d**2 / (2 * sigma**2)
        g = np.sqrt(square) * np.exp(-square / 2)
        hidden = (u * np.sqrt(1 - np.exp(-square) * (1 + square)) < threshold) & (u < 50) & (u * g < 5)
        shifts.append((u * g * np.cos(angle))[hidden].sum())
    assert np.count_nonzero(bright) > 1000
    assert np.median(stated[here]) == pytest.approx(np.var(shifts), rel=0.25)
    few = slice(10)
    none = confusion(xy[few], snr[few], snr[few], sigma=sigma, threshold=threshold, area=side**2)
    np.testing.assert_array_equal(none, 0)


def test_the_psf_has_to_be_one():
    field = king.king_field(60, 1, size=128, core=40.0)
    with pytest.raises(InputError, match=r"psf must be one of 'auto', 'moffat', 'effective'"):
        ld.measure(exposure(field.data), psf="shared")
