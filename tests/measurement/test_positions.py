"""Detection and profile fits against images rendered by code of their own."""

import inspect
import re
import warnings
from dataclasses import fields

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from caller_warnings import warns_here
from numpy.testing import assert_allclose
from photutils.psf import SourceGrouper
from scipy.spatial import cKDTree
from star_images import (
    GAIN,
    READ_NOISE,
    SKY,
    errors,
    identify,
    image,
    ladder,
    observe,
    on_pixels,
    positions,
    scattered,
    usable,
)

from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs.column_contract import DETECTED, check
from legdistort.inputs.exposure_files import read_exposures
from legdistort.inputs.exposures import Exposure
from legdistort.measurement import camera_gain
from legdistort.measurement.flags import Flag
from legdistort.measurement.options import MeasureOptions
from legdistort.measurement.positions import measure
from legdistort.measurement.profiles import levenberg_marquardt, moffat
from legdistort.measurement.profiles.blends import group_stars, members


@pytest.fixture(
    scope="module",
    params=[pytest.param(4.5, id="fwhm4.5", marks=pytest.mark.sets), pytest.param(2.0, id="fwhm2")],
)
def campaign(request):
    """Two frames of 400 stars of known signal-to-noise ratio, and what was measured."""
    fwhm, rng = request.param, np.random.default_rng(11)
    ratio, flux, limit = ladder(400, fwhm)
    rows = []
    for i in range(2):
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
    n = off.size  # about 400: the rms itself is known to 3.5 %
    assert n > 320
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


@pytest.mark.parametrize(
    "fwhm",
    [
        1.0,
        pytest.param(1.51, marks=pytest.mark.slow),
        pytest.param(1.91, marks=pytest.mark.sets),
        2.0,
        pytest.param(2.5, marks=pytest.mark.sets),
        pytest.param(3.01, marks=pytest.mark.sets),
        3.5,
        pytest.param(6.0, marks=pytest.mark.slow),
    ],
)
def test_no_bias_with_the_phase_of_the_pixels(fwhm):
    """Stars without noise, at a signal-to-noise ratio of 1000: off by less than a tenth of the error."""
    flux = ladder(2, fwhm)[1][-1]
    half, phases = max(4, int(np.ceil(2 * fwhm))), np.linspace(-0.5, 0.4, 6)
    xy = np.stack(np.meshgrid(phases, phases), axis=-1).reshape(-1, 2)
    pixels = np.arange(-half, half + 1)
    light = flux * np.array([on_pixels(x, y, pixels, pixels, fwhm, 3.0, sub=21).ravel() for x, y in xy])
    weights = 1 / ((light + SKY) / GAIN + (READ_NOISE / GAIN) ** 2)
    shape = moffat.shape(fwhm)
    start = np.column_stack([np.zeros((len(xy), 2)), light.max(axis=1), np.tile(shape, (len(xy), 1)), 0 * xy[:, 0]])
    fit = levenberg_marquardt.fit(light, weights, start, nodes=moffat.quadrature(fwhm), centre=shape)
    error = np.sqrt(np.einsum("nii->ni", fit.covariance)[:, :2])
    assert np.all(fit.converged)
    assert np.abs((fit.params[:, :2] - xy) / error).max() < 0.1


@pytest.fixture(scope="module")
def faint():
    """Two frames of stars near the limit measured with all kinds of shape: {kind: rows}."""
    rng, out = np.random.default_rng(21), {}
    ratio, flux, limit = ladder(400, 3.5, 5, 60)
    for i in range(2):
        xy, order = scattered(rng, 400, 800), rng.permutation(400)
        frame = Exposure(f"frame{i}", observe(image((800, 800), xy, flux[order], 3.5), rng), gain=GAIN)
        for kind in ("own", "shared", "linear"):
            table = usable(measure(frame, profile=kind, threshold=4))
            star = identify(table, xy)
            table, star = table[star >= 0], star[star >= 0]
            which = order[star]
            off = positions(table) - xy[star]
            of_flux = (np.asarray(table["flux"]) / flux[which] - 1)[:, None]
            columns = [ratio[which, None], off / limit[which], off / errors(table), of_flux, table["flux_err"][:, None]]
            out.setdefault(kind, []).append(np.column_stack(columns))
    return {kind: np.concatenate(rows) for kind, rows in out.items()}


@pytest.mark.slow
def test_faint_stars_gain_from_a_shared_shape(faint):
    def rms(kind, column, low, high):
        rows = faint[kind]
        return np.sqrt(np.mean(rows[(rows[:, 0] > low) & (rows[:, 0] < high)][:, column] ** 2))

    for kind in ("shared", "linear"):
        assert len(faint[kind]) >= len(faint["own"]) - 5
        assert rms(kind, slice(1, 3), 5, 10) < rms("own", slice(1, 3), 5, 10)
        # The bound of positions is the same (the shape is even, shifts are odd), fluxes gain at all brightnesses
        for low, high in ((5, 10), (10, 30), (30, 60)):
            assert rms(kind, 5, low, high) < 0.7 * rms("own", 5, low, high)
            assert rms(kind, slice(3, 5), low, high) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_shape_that_varies_over_the_field():
    """Round in the middle, elongated towards the edges: a linear shape leaves the least, and errors stay true."""
    rng = np.random.default_rng(6)
    xy, flux = scattered(rng, 196, 560), 10 ** rng.uniform(3.3, 5, 196)
    squash = 1 + 0.3 * xy[:, 0] / 560
    frame = Exposure("f", observe(image((560, 560), xy, flux, 3.5, squash=squash, theta=0 * squash), rng), gain=GAIN)
    chi2 = {}
    for kind in ("own", "shared", "linear"):
        table = usable(measure(frame, profile=kind))
        z = (positions(table) - xy[identify(table, xy)]) / errors(table)
        assert np.std(z) == pytest.approx(1, abs=0.1) or kind == "shared"
        chi2[kind] = np.mean(table["chi2"][:50])
    assert chi2["own"] < 1.3
    assert chi2["linear"] < 1.3
    assert chi2["shared"] > 2


@pytest.mark.slow
def test_blends_fitted_together_are_better():
    rng = np.random.default_rng(13)
    fwhm, n, out = 3.5, 225, {}
    _, flux, _ = ladder(n, fwhm, 80, 300)
    for i in range(2):
        first, angle = scattered(rng, n, 640), rng.uniform(0, 2 * np.pi, n)
        apart = fwhm * rng.uniform(1.5, 1.9, n)[:, None]
        xy = np.concatenate([first, first + apart * np.column_stack([np.cos(angle), np.sin(angle)])])
        light = np.concatenate([rng.permutation(flux), rng.permutation(flux)])
        frame = Exposure(f"f{i}", observe(image((640, 640), xy, light, fwhm), rng), gain=GAIN)
        for blends in ("together", "alone"):
            table = usable(measure(frame, blends=blends))
            star = identify(table, xy)
            off = (positions(table) - xy[star])[star >= 0]
            out.setdefault(blends, []).append(np.column_stack([off, off / errors(table)[star >= 0]]))
            assert np.count_nonzero(star < 0) < 5
            assert np.mean((table["flags"] & Flag.BLENDED) > 0) > 0.8
    together, alone = (np.median(np.abs(np.concatenate(out[b])), axis=0) for b in ("together", "alone"))
    assert np.all(together[:2] < 0.85 * alone[:2])
    assert np.all(1.4826 * together[2:] < 1.2)
    assert np.all(1.4826 * alone[2:] > 1.3)


@pytest.mark.parametrize(
    "blends", [pytest.param("alone", marks=pytest.mark.sets), pytest.param("together", marks=pytest.mark.slow)]
)
def test_isolated_stars_of_a_crowded_field_stay_calibrated(blends):
    """One star every 4 FWHM: those without another one in 3 FWHM, detected or not."""
    rng, fwhm, size, z = np.random.default_rng(14), 3.5, 450, []
    n = int((size / (4 * fwhm)) ** 2)
    _, flux, _ = ladder(n, fwhm, 8, 500)
    for i in range(2):
        xy = rng.uniform(5, size - 5, (n, 2))
        frame = observe(image((size, size), xy, rng.permutation(flux), fwhm), rng)
        table = usable(measure(Exposure(f"f{i}", frame, gain=GAIN), blends=blends))
        star = identify(table, xy)
        lonely = cKDTree(xy).query(xy, k=2)[0][:, 1] > 3 * fwhm
        rows = (star >= 0) & lonely[star]
        z.append(((positions(table) - xy[star]) / errors(table))[rows])
    z = np.concatenate(z)
    assert len(z) > 200
    # the errors of a crowd allow for neighbours that are not seen: of these stars nobody knows that they have none
    low, high = (0.92, 1.08) if blends == "alone" else (0.7, 1.08)
    assert low < np.std(z) < high


def test_groups_are_those_of_photutils():
    xy = np.random.default_rng(15).uniform(0, 300, (400, 2))
    ours, theirs = group_stars(xy, 7.0, largest=400), SourceGrouper(7.0)(*xy.T)
    pairs = np.unique(np.column_stack([ours, theirs]), axis=0)
    assert len(pairs) == len(np.unique(ours)) == len(np.unique(theirs))
    small = group_stars(xy, 30.0, largest=5)
    assert np.bincount(small).max() <= 5
    assert sorted(np.concatenate([stars.ravel() for stars in members(small)])) == list(range(400))
    assert len(group_stars(np.zeros((0, 2)), 3.0)) == 0


def test_stars_that_coincide_are_divided_somehow():
    assert np.bincount(group_stars(np.ones((20, 2)), 3.0, largest=6)).max() <= 6


def test_gain_is_found_when_it_is_missing():
    rng = np.random.default_rng(3)
    xy, flux = scattered(rng, 225, 600), 10 ** rng.uniform(3, 5, 225)
    frame = observe(image((600, 600), xy, flux, 3.5), rng)
    with warns_here(AssumptionWarning, match=r"no gain known for one: .*equivalent gain (1\.[6-9]|2\.[0-4])\d? e-/ADU"):
        table = usable(measure([Exposure("one", frame)]))
    z = (positions(table) - xy[identify(table, xy)]) / errors(table)
    assert np.std(z) == pytest.approx(1, abs=0.08)


@pytest.mark.slow
def test_one_gain_for_all_frames_of_a_camera():
    """Twelve stars a frame: alone each frame says something else, together they say what is nearly true."""
    rng = np.random.default_rng(31)
    frames = []
    for k in range(8):
        xy, flux = scattered(rng, 12, 160), 10 ** rng.uniform(3.5, 4.5, 12)
        frame = observe(image((160, 160), xy, flux, 3.5), rng)
        frames.append(Exposure(f"f{k}", frame, header=fits.Header([("INSTRUME", "CAM")])))
    singly = []
    for frame in frames[:4]:
        with pytest.warns(AssumptionWarning, match=f"no gain known for {frame.name}: ") as told:
            measure([frame])
        singly += map(float, re.findall(r"gain ([\d.]+) e-", str(told[0].message)))
    with pytest.warns(AssumptionWarning, match="no gain known for f0, f1, f2 and 5 more: .*equivalent gain") as told:
        together = measure(frames)
    gain = float(re.search(r"gain ([\d.]+) e-", str(told[0].message)).group(1))  # one for all
    assert gain == pytest.approx(GAIN, rel=0.35)
    assert len(singly) < 4 or max(singly) > 1.2 * min(singly)
    given = measure(frames, gain=gain)
    assert_allclose(together["x_err"].value, given["x_err"].value, rtol=2e-3)  # the message has three digits


def test_cameras_are_told_apart():
    data = np.arange(400.0).reshape(20, 20)

    def exposure(name, gain=None, time=None, **cards):
        return Exposure(name, data, header=fits.Header(list(cards.items())), gain=gain, exposure_time=time)

    one, two = exposure("a", DETECTOR="A"), exposure("b", DETECTOR="B")
    others = [exposure("c", DETECTOR="A"), exposure("d", gain=2.0, DETECTOR="A")]
    assert list(camera_gain.pilots([one, two, *others]).values()) == [[one, others[0]]]  # nothing for one alone
    many = [exposure(f"e{k}") for k in range(130)]
    (chosen,) = camera_gain.pilots(many).values()
    assert (len(chosen), chosen[0], chosen[-1]) == (camera_gain.PILOTS, many[0], many[-1])
    rates = [exposure(f"r{k}", time=t, BUNIT="adu/s") for k, t in enumerate((1.0, 2.0, 2.0))]
    assert list(camera_gain.pilots(rates).values()) == [rates[1:]]
    assert camera_gain.pooled([0.5, 0.1, 0.25]) == 4
    assert camera_gain.pooled([0.0, 0.0, 1.0]) is None
    assert camera_gain.pooled([0.5, None]) is None


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
    assert set(DETECTED) - {"mag"} | {"chi2", "psf"} == set(table.colnames)
    assert table["x"].unit == table["x_err"].unit == table["fwhm"].unit == u.pix
    check(table, DETECTED, "detections")
    assert np.all(np.diff(table["flux"]) <= 0)
    assert set(table["exposure"]) == {"troubled"}


@pytest.fixture(scope="module")
def field():
    """Positions, the sky-free light of 196 stars, and the noise-free frame."""
    rng = np.random.default_rng(31)
    xy = scattered(rng, 196, 512)
    return xy, image((512, 512), xy, rng.permutation(ladder(196, 3.5, 10, 500)[1]), 3.5)


def _slope(frame):
    y, x = np.mgrid[: frame.shape[0], : frame.shape[1]]
    return frame + 20.0 * x + 10.0 * y


def _bowl(frame):
    return frame + (np.arange(frame.shape[1]) - 250.0) ** 2 / 20


def _gap(frame):
    frame = frame.copy()
    frame[200:260], frame[:, 300:330] = np.nan, np.nan
    return frame


def _bleeding(frame):
    x, y = 250, 260
    frame = np.minimum(frame + image(frame.shape, [(x, y)], [3e6], 3.5) - SKY, 30000)
    frame[y - 90 : y + 90, x - 1 : x + 2] = 30000
    return frame


def _cosmics(frame):
    frame, rng = frame.copy(), np.random.default_rng(32)
    x, y = rng.integers(3, 509, (2, 200))
    frame[y, x] += rng.uniform(200, 5000, 200)
    return frame


#: What is done to a noisy frame (or, of skies, before the noise), and how many of 196 stars must stay.
FRAMES = {
    "unsigned integers": (lambda frame: np.round(frame).astype(np.uint16), False, 190),
    "big-endian integers": (lambda frame: np.round(frame).astype(">i4"), False, 190),
    "negative sky": (lambda frame: frame - 3000, False, 190),
    "steep sky": (_slope, False, 185),
    "curved sky with its noise": (_bowl, True, 170),
    "gaps": (_gap, False, 150),
    "bleeding": (_bleeding, False, 190),
    "cosmic rays": (_cosmics, False, 175),
    "units of 1e-18": (lambda frame: frame.astype(float) * 1e-18, False, 190),
}


#: What is much like another of them.
LIKE = ("big-endian integers", "negative sky", "steep sky", "gaps")


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind in LIKE)) for kind in FRAMES])
def test_frames_as_they_come(field, kind):
    """All kinds: no false star, the errors stay true."""
    xy, clean = field
    change, before, least = FRAMES[kind]
    rng = np.random.default_rng(33)
    frame = observe(change(clean), rng) if before else change(observe(clean, rng))
    gain = GAIN * 1e18 if kind == "units of 1e-18" else GAIN
    with warnings.catch_warnings():
        if kind == "steep sky":  # ten thousand counts that have no noise
            warnings.filterwarnings("ignore", "steep sky: the noise is .* too small", AssumptionWarning)
        table = usable(measure(Exposure(kind, frame, gain=gain, saturation=30000 if kind == "bleeding" else None)))
    star = identify(table, xy)
    assert np.count_nonzero(star < 0) <= 1
    assert len(table) >= least
    assert np.std(((positions(table) - xy[star]) / errors(table))[star >= 0]) == pytest.approx(1, abs=0.15)


def test_stars_on_the_border_say_so():
    rng = np.random.default_rng(34)
    across = np.tile([-1.0, 0, 1, 2, 3, 4, 5, 6, 7, 8], 3) + rng.uniform(-0.5, 0.5, 30)
    xy = np.column_stack([np.arange(20, 500, 16.0), across])
    table = measure(Exposure("border", observe(image((128, 512), xy, np.full(30, 2e4), 3.5), rng), gain=GAIN))
    edge = (table["flags"] & Flag.EDGE) > 0
    np.testing.assert_array_equal(edge, (table["y"].value + 0.5 < table["fwhm"].value))
    z = (positions(table) - xy[identify(table, xy, 2.5)]) / errors(table)
    assert np.abs(z[~edge]).max() < 4
    assert np.count_nonzero(~edge) >= 14


def test_data_that_are_no_image():
    for data in (np.zeros(5), np.zeros((3, 9, 9))):
        with pytest.raises(InputError, match=r"cube: the data have shape .*, an exposure is one 2-D image"):
            measure(Exposure("cube", data))
    with pytest.raises(InputError, match="every pixel is NaN"):
        Exposure("blank", np.full((9, 9), np.nan))
    with pytest.raises(InputError, match="every pixel is hidden by the mask"):
        Exposure("hidden", np.ones((9, 9)), mask=np.ones((9, 9), dtype=bool))


def test_noise_alone_gives_almost_nothing():
    rng = np.random.default_rng(1)
    frames = [Exposure(f"n{i}", rng.normal(100, 7, (700, 700)), gain=GAIN) for i in range(4)]
    assert len(usable(measure(frames))) <= 2


@pytest.mark.parametrize("data", [np.zeros((64, 64)), np.full((40, 300), 7.0), np.eye(3), np.zeros((1, 9), np.int16)])
def test_empty_frames_give_no_rows(data, caplog):
    table = measure([Exposure("nothing", data, mask=np.eye(*data.shape) > 2, gain=1.0)])
    assert len(table) == 0
    assert set(table.colnames) >= set(DETECTED) - {"mag"}  # of lists of other programs
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
        ({"fwhm": 0.1}, "fwhm must be a number between 0.5 and 200 pixels, got 0.1"),
        ({"fwhm": np.nan}, "fwhm must be a number"),
        ({"threshold": 0}, "threshold must be a number of at least 2"),
        ({"max_stars": 0}, "max_stars must be at least 1"),
        ({"box": 8}, "box must be an odd number of pixels, at least 5, got 8"),
        ({"box": 9.0}, "box must be an odd number of pixels, at least 5, got 9.0"),
        ({"fwhm": "4"}, "fwhm must be a number between 0.5 and 200 pixels, got '4'"),
        ({"threshold": None}, "threshold must be a number of at least 2"),
        ({"threshold": "5"}, r"threshold must be a number of at least 2 .*, got '5'"),
        ({"max_stars": 2.5}, "max_stars must be at least 1, and an integer, got 2.5"),
        ({"read_noise": "5"}, "read_noise must be a positive number, got '5'"),
        ({"gain": -1.0}, "gain must be a positive number, got -1.0"),
        ({"saturation": np.inf}, "saturation must be a positive number"),
        ({"profile": "mine"}, "profile must be one of 'own', 'shared', 'linear', got 'mine'"),
        ({"blends": "never"}, "blends must be one of 'together', 'alone', got 'never'"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        measure([Exposure("a", np.zeros((9, 9)))], **arguments)


def test_options_are_the_arguments():
    parameters = inspect.signature(measure).parameters
    options = {option.name: option.default for option in fields(MeasureOptions)}
    assert options == {name: parameters[name].default for name in options}
    assert parameters.keys() - options == {"exposures", "workers", "progress", "write_psf"}


def test_exposures_only():
    with pytest.raises(InputError, match="as read_exposures gives them, got str"):
        measure(["frame.fits"])


@pytest.mark.slow
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
