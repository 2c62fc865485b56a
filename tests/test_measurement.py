"""Detection and profile fits against images rendered by code of their own."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from scipy.spatial import cKDTree

from legdistort import moffat
from legdistort.catalogs import DETECTED, check
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.exposures import Exposure, read_exposures
from legdistort.measurement import UNUSABLE, Flag, measure

SKY, GAIN, READ_NOISE = 100.0, 2.0, 10.0


def profile(dx, dy, fwhm, beta, squash=1.2, theta=0.5):
    """Moffat profile of unit flux; axes fwhm * squash and fwhm / squash."""
    k = 2 ** (1 / beta) - 1
    along, across = dx * np.cos(theta) + dy * np.sin(theta), dy * np.cos(theta) - dx * np.sin(theta)
    r2 = (2 * along / (fwhm * squash)) ** 2 + (2 * across * squash / fwhm) ** 2
    return (beta - 1) * 4 * k / (np.pi * fwhm**2) * (1 + k * r2) ** -beta


def on_pixels(x, y, columns, rows, *args, sub=5):
    """The profile averaged over sub x sub points of every pixel."""
    offsets = (np.arange(sub) + 0.5) / sub - 0.5
    fine_x, fine_y = (columns[:, None] + offsets).ravel() - x, (rows[:, None] + offsets).ravel() - y
    return profile(fine_x, fine_y[:, None], *args).reshape(len(rows), sub, len(columns), sub).mean(axis=(1, 3))


def image(shape, xy, flux, fwhm, beta=3.0, half=None):
    out = np.full(shape, SKY)
    half = half or int(7 * fwhm)
    for (x, y), f in zip(xy, flux, strict=True):
        columns = np.arange(max(0, int(x) - half), min(shape[1], int(x) + half + 1))
        rows = np.arange(max(0, int(y) - half), min(shape[0], int(y) + half + 1))
        out[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += f * on_pixels(
            x, y, columns, rows, fwhm, beta, sub=3 if fwhm > 3 else 5
        )
    return out


def observe(noiseless, rng):
    electrons = rng.poisson(noiseless * GAIN) + rng.normal(0, READ_NOISE, noiseless.shape)
    return (electrons / GAIN).astype(np.float32)


def scattered(rng, n, size):
    """Positions on a jittered grid: isolated stars at every pixel phase."""
    side = int(np.ceil(np.sqrt(n)))
    grid = (np.stack(np.meshgrid(*[np.arange(side) + 0.5] * 2), axis=-1).reshape(-1, 2) * size / side)[:n]
    return grid + rng.uniform(-3, 3, grid.shape)


def bound(flux, fwhm, beta=3.0, half=20):
    """Cramer-Rao bound of x and y with eight free parameters, and the signal-to-noise ratio."""
    pixels = np.arange(-half, half + 1)

    def model(p):
        return p[2] * on_pixels(p[0], p[1], pixels, pixels, p[3], np.exp(p[4]), p[5], p[6]) + p[7]

    p = np.array([0.2, 0.3, flux, fwhm, np.log(beta), 1.2, 0.5, SKY])
    variance = model(p) / GAIN + (READ_NOISE / GAIN) ** 2
    steps = np.diag(1e-4 * np.maximum(1, np.abs(p)))
    jac = np.array([((model(p + s) - model(p - s)) / (2 * s.sum()) / np.sqrt(variance)).ravel() for s in steps])
    ratio = np.sqrt(((model(p) - SKY) ** 2 / variance).sum())
    return np.sqrt(np.diag(np.linalg.inv(jac @ jac.T))[:2]), ratio


def positions(table):
    return np.column_stack([table["x"].value, table["y"].value])


def errors(table):
    return np.column_stack([table["x_err"].value, table["y_err"].value])


def identify(table, xy, radius=1.5):
    """Index of the true star of every row, -1 for none."""
    distance, index = cKDTree(xy).query(positions(table))
    return np.where(distance < radius, index, -1)


def usable(table):
    return table[(table["flags"] & UNUSABLE) == 0]


@pytest.fixture(scope="module", params=[4.5, 2.0], ids=["fwhm4.5", "fwhm2"])
def campaign(request):
    """Five frames of 400 stars of known signal-to-noise ratio, and what was measured."""
    fwhm, rng = request.param, np.random.default_rng(11)
    fluxes = np.geomspace(30, 1e6, 24)
    bounds, ratios = zip(*(bound(f, fwhm) for f in fluxes), strict=True)
    ratio = np.geomspace(9, 1000, 400)
    flux = np.exp(np.interp(np.log(ratio), np.log(ratios), np.log(fluxes)))
    limit = np.exp([np.interp(np.log(ratio), np.log(ratios), np.log(b)) for b in np.transpose(bounds)]).T
    rows = []
    for i in range(5):
        xy, order = scattered(rng, 400, 800), rng.permutation(400)
        frame = observe(image((800, 800), xy, flux[order], fwhm), rng)
        table = usable(measure(Exposure(f"frame{i}", frame, gain=GAIN)))
        star = identify(table, xy)
        assert np.count_nonzero(star < 0) <= 4  # peaks of the noise ...
        assert np.all(errors(table)[star < 0] > 0.04 * fwhm)  # ... that say so
        table, star = table[star >= 0], star[star >= 0]
        assert len(np.unique(star)) == len(star) > 380
        which = order[star]
        rows.append(
            np.column_stack(
                [ratio[which], positions(table) - xy[star], errors(table), limit[which], table["flux"] / flux[which]]
            )
        )
    return np.concatenate(rows)


@pytest.mark.parametrize(("low", "high"), [(10, 30), (30, 100), (100, 300), (300, 1000)])
def test_positions_reach_the_cramer_rao_bound_with_honest_errors(campaign, low, high):
    rows = campaign[(campaign[:, 0] >= low) & (campaign[:, 0] < high)]
    off, claimed, limit = rows[:, 1:3], rows[:, 3:5], rows[:, 5:7]
    n = off.size  # about 1000: the rms itself is known to 2.2 %
    assert n > 800
    assert np.sqrt(np.mean((off / limit) ** 2)) < 1.05 + 2 / np.sqrt(2 * n)
    assert np.std(off / claimed) == pytest.approx(1, abs=0.05 + 1 / np.sqrt(2 * n))
    assert np.abs(np.mean(off / claimed, axis=0)).max() < 3.5 / np.sqrt(n / 2)
    assert np.median(rows[:, 7]) == pytest.approx(1, abs=0.04 if low == 10 else 0.01)


def test_jacobian_is_the_derivative():
    params = np.array([[0.2, -0.3, 100, np.log(0.4), np.log(0.3), 0.2, np.log(2.5), 5.0]])
    for nodes in (moffat.CENTRES, moffat.quadrature(2.0), moffat.quadrature(1.0)):
        _, jac = moffat.evaluate(params, 6, nodes, jacobian=True)
        for i in range(7):
            step = np.zeros(8)
            step[i] = 1e-5
            difference = moffat.evaluate(params + step, 6, nodes) - moffat.evaluate(params - step, 6, nodes)
            np.testing.assert_allclose(jac[0, i], difference[0] / 2e-5, atol=1e-6 * np.abs(jac[0, i]).max())


@pytest.mark.parametrize("fwhm", [1.0, 1.6, 2.8, 4.5])
def test_profile_equals_an_independent_rendering(fwhm):
    x, y, beta, squash, theta = 0.3, -0.2, 2.7, 1.2, 0.5
    along, across = 4 / (fwhm * squash) ** 2, 4 * squash**2 / fwhm**2
    c, s = np.cos(theta), np.sin(theta)
    a, b, off = along * c**2 + across * s**2, along * s**2 + across * c**2, (along - across) * c * s
    params = np.array([[x, y, 1.0, np.log(a), np.log(b), off / np.sqrt(a * b), np.log(beta), 0.0]])
    pixels = np.arange(-8, 9)
    truth = on_pixels(x, y, pixels, pixels, fwhm, beta, squash, theta, sub=25)
    nodes = moffat.quadrature(min(fwhm, 3))  # the three sampled widths are integrated, the wide one need not be
    model = moffat.evaluate(params, 8, nodes)[0].reshape(17, 17) / moffat.flux(params)
    np.testing.assert_allclose(model, truth, atol=1e-3 * truth.max())
    assert moffat.fwhm(params)[0] == pytest.approx(fwhm)


def test_gain_is_found_when_it_is_missing():
    rng = np.random.default_rng(3)
    xy, flux = scattered(rng, 225, 600), 10 ** rng.uniform(3, 5, 225)
    frame = observe(image((600, 600), xy, flux, 3.5), rng)
    with pytest.warns(AssumptionWarning, match=r"no gain known for one: .*equivalent gain (1\.[6-9]|2\.[0-4])"):
        table = usable(measure([Exposure("one", frame)]))
    z = (positions(table) - xy[identify(table, xy)]) / errors(table)
    assert np.std(z) == pytest.approx(1, abs=0.08)


def test_uncertainty_plane_is_used():
    rng = np.random.default_rng(4)
    xy, flux = scattered(rng, 225, 600), 10 ** rng.uniform(3, 5, 225)
    clean = image((600, 600), xy, flux, 3.5)
    sigma = np.sqrt(clean / GAIN + (READ_NOISE / GAIN) ** 2)
    frame = observe(clean, rng)
    table = usable(measure([Exposure("one", frame, uncertainty=sigma)]))
    z = (positions(table) - xy[identify(table, xy)]) / errors(table)
    assert np.std(z) == pytest.approx(1, abs=0.08)
    doubled = usable(measure([Exposure("one", frame, uncertainty=2 * sigma)], threshold=2.5))
    near = identify(doubled, positions(table), 0.2)
    ratio = np.median(errors(doubled)[near >= 0] / errors(table)[near[near >= 0]])
    assert ratio == pytest.approx(2, rel=0.03)


@pytest.fixture(scope="module")
def troubled():
    """One frame with everything that can go wrong; name -> true (x, y)."""
    rng = np.random.default_rng(8)
    xy = scattered(rng, 64, 512)
    flux = np.full(64, 2e4)
    special = {"bright": xy[9], "masked": xy[18], "cosmic": xy[27], "hole": xy[45]}
    flux[9] = 3e6
    extra = np.array([xy[36] + [7.0, 2.0], [3.0, 200.0]])
    special |= {"left": xy[36], "right": extra[0], "edge": extra[1]}
    frame = observe(image((512, 512), np.vstack([xy, extra]), np.append(flux, [1e4, 2e4]), 4.0), rng)
    hot = np.array([[64, 64], [128, 192], [320, 256], [384, 448]])
    frame[hot[:, 1], hot[:, 0]] += [300, 1000, 4000, 200]
    frame = np.minimum(frame, 20000)
    mask = np.zeros(frame.shape, dtype=bool)
    mask[:, round(xy[18, 0]) + 2] = True
    frame[mask] = 1e5
    x, y = np.round(xy[27]).astype(int)
    frame[y + 2, x + 3] += 3000
    x, y = np.round(xy[45]).astype(int)
    frame[y - 1, x - 1] = np.nan
    exposure = Exposure("troubled", frame, mask=mask, gain=GAIN, saturation=20000)
    return measure(exposure), special, hot, xy


def test_trouble_is_flagged(troubled):
    table, special, hot, xy = troubled
    flags = {}
    for name, place in special.items():
        distance = np.hypot(*(positions(table) - place).T)
        flags[name] = Flag(int(table["flags"][np.argmin(distance)]))
        assert distance.min() < 1
    assert Flag.SATURATED in flags["bright"]
    assert Flag.EDGE in flags["edge"]
    assert Flag.MASKED in flags["masked"]
    assert Flag.MASKED in flags["cosmic"]
    assert Flag.MASKED in flags["hole"]
    assert Flag.BLENDED in flags["left"]
    assert Flag.BLENDED in flags["right"]
    on_hot = np.hypot(*(positions(table)[:, None] - hot).T).min(axis=1) < 1
    assert np.all(on_hot)
    i = [np.argmin(np.hypot(*(positions(table) - place).T)) for place in hot[on_hot]]
    assert np.all(table["flags"][i] & Flag.HOT)
    good = usable(table)
    assert np.all(identify(good, np.vstack([xy, special["right"]])) >= 0), "a false star passes for a good one"
    assert len(good) == 64  # all but the saturated one, and the neighbour


def test_trouble_does_not_move_the_stars(troubled):
    table, special, _, _ = troubled
    good = usable(table)
    for name in ("masked", "cosmic", "hole", "left", "right"):
        off = positions(good) - special[name]
        i = np.argmin(np.hypot(*off.T))
        assert np.all(np.abs(off[i]) < 4 * errors(good)[i]), name


def test_table_keeps_the_contract(troubled):
    table = troubled[0]
    assert set(DETECTED) | {"chi2"} == set(table.colnames)
    assert table["x"].unit == table["x_err"].unit == table["fwhm"].unit == u.pix
    check(table, DETECTED, "detections")
    assert np.all(np.diff(table["flux"]) <= 0)
    assert set(table["exposure"]) == {"troubled"}


def test_noise_alone_gives_almost_nothing():
    rng = np.random.default_rng(1)
    frames = [Exposure(f"n{i}", rng.normal(100, 7, (700, 700)), gain=GAIN) for i in range(4)]
    assert len(usable(measure(frames))) <= 2


@pytest.mark.parametrize("data", [np.zeros((64, 64)), np.full((40, 300), 7.0), np.eye(3), np.zeros((1, 9), np.int16)])
def test_empty_frames_give_no_rows(data, caplog):
    table = measure([Exposure("nothing", data, mask=np.eye(*data.shape) > 2, gain=1.0)])
    assert len(table) == 0
    assert set(table.colnames) >= set(DETECTED)
    assert "nothing: no star above 5 times the noise" in caplog.text


def test_frames_are_independent_and_inputs_untouched():
    rng = np.random.default_rng(2)
    frames = []
    for name in ("a", "b"):
        xy = scattered(rng, 49, 256)
        frames.append(Exposure(name, observe(image((256, 256), xy, np.full(49, 5e3), 3.0), rng), gain=GAIN))
    before = frames[0].data.copy()
    both, second = measure(frames), measure(frames[1])
    assert list(dict.fromkeys(both["exposure"])) == ["a", "b"]
    np.testing.assert_array_equal(both[both["exposure"] == "b"]["x"], second["x"])
    np.testing.assert_array_equal(frames[0].data, before)
    few = measure(frames, max_stars=5)
    assert [np.count_nonzero(few["exposure"] == name) for name in "ab"] == [5, 5]
    shifted = measure(Exposure("b", np.roll(frames[1].data, (3, -2), axis=(0, 1)), gain=GAIN), fwhm=3.0)
    plain = measure(frames[1], fwhm=3.0)
    star = identify(shifted, positions(plain) + [-2, 3], 0.5)
    inside = star >= 0
    assert np.count_nonzero(inside) > 40
    np.testing.assert_allclose(
        positions(shifted)[inside], positions(plain)[star[inside]] + [-2, 3], atol=0.1 * errors(plain).max()
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fwhm": 0.1}, "fwhm must lie between 0.5 and 200 pixels, got 0.1"),
        ({"fwhm": np.nan}, "fwhm must lie"),
        ({"threshold": 0}, "threshold must be at least 2"),
        ({"max_stars": 0}, "max_stars must be at least 1"),
        ({"box": 8}, "box must be an odd number of pixels, at least 5, got 8"),
        ({"gain": -1.0}, "gain must be a positive number, got -1.0"),
        ({"saturation": np.inf}, "saturation must be a positive number"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        measure([Exposure("a", np.zeros((9, 9)))], **arguments)


def test_exposures_only():
    with pytest.raises(InputError, match="as read_exposures gives them, got str"):
        measure(["frame.fits"])


def test_real_frames(shared_data):
    """Undersampled frames of a small telescope: the sky drifts over the detector, hot pixels stay."""
    paths = sorted((shared_data / "microobs_hatp32" / "frames").glob("*.fits.gz"))[::6]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AssumptionWarning)  # these headers have no gain
        exposures = read_exposures(paths)
        table = measure(exposures, threshold=15.0)
    first, second = (table[table["exposure"] == name] for name in dict.fromkeys(table["exposure"]))
    a, b = usable(first), usable(second)
    assert 190 < len(a) < 2000
    shift = (positions(b)[:200][None] - positions(a)[:200][:, None]).reshape(-1, 2)
    votes = cKDTree(shift).query_ball_point(shift, 2.0)
    best = max(votes, key=len)
    assert len(best) > 50
    moved = shift[best].mean(axis=0)
    assert np.hypot(*moved) > 50
    for exposure, found in zip(exposures, (first, second), strict=True):
        hot = lonely_pixels(exposure.data)
        assert len(hot) > 20
        # a real star may lie beside a hot pixel; its position is then its own
        assert np.count_nonzero(identify(usable(found), hot, 0.25) >= 0) <= 1, "hot pixels pass for stars"
        flagged = found[(found["flags"] & Flag.HOT) > 0]
        assert np.count_nonzero(np.hypot(*(positions(flagged)[:, None] - hot).T).min(axis=1) < 0.7) > 0.7 * len(hot)


def lonely_pixels(data):
    """Pixels (x, y) 60 ADU above the sky with nothing around them."""
    above = data - np.median(data)
    steps = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]
    around = np.max([np.roll(above, step, axis=(0, 1)) for step in steps], axis=0)
    y, x = np.nonzero((above > 60) & (around < 0.1 * above))
    inside = (np.minimum(x, y) > 3) & (x < data.shape[1] - 4) & (y < data.shape[0] - 4)
    return np.column_stack([x, y])[inside].astype(float)
