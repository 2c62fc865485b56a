"""Defects that no mask shows, on images of known truth: they are found, and stars are not taken for them."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable
from caller_warnings import warns_here
from dirty_detector import cosmic_rays
from scipy.spatial import cKDTree
from star_images import GAIN, READ_NOISE, SKY, errors, image, observe, positions, scattered, usable

from legdistort.exceptions import AssumptionWarning
from legdistort.inputs.exposure_files import read_exposures
from legdistort.inputs.exposures import Exposure
from legdistort.matching.matcher import match
from legdistort.measurement.across_frames import flag_what_stays
from legdistort.measurement.flags import Flag
from legdistort.measurement.positions import measure

SIZE, N = 200, 49
SHIFTS = np.array([[0, 0], [11, 5], [-9, 10], [6, -11], [-10, -8]], dtype=float)


def stars(fwhm=3.0, n=N, seed=3):
    """Positions in the first frame and fluxes, from 2,000 to 100,000."""
    rng = np.random.default_rng(seed)
    return scattered(rng, n, SIZE), np.exp(rng.uniform(np.log(2e3), np.log(1e5), n))


def night(defects=None, fwhm=3.0, frames=5, shifts=SHIFTS):
    """Exposures, and the light of the defects, `defects(rng)`, in each."""
    xy, flux = stars(fwhm)
    exposures, added = [], []
    for k in range(frames):
        rng = np.random.default_rng(100 + k)
        data = observe(image((SIZE, SIZE), xy + shifts[k], flux, fwhm), rng)
        added.append(np.zeros((SIZE, SIZE)) if defects is None else defects(rng))
        exposures.append(Exposure(f"e{k}", (data + added[-1]).astype(np.float32), gain=GAIN, read_noise=READ_NOISE))
    return exposures, added


def untouched(table, exposures, added, shifts=SHIFTS):
    """Of stars with no defect within 6 pixels: how many there are, and which of them are usable and not deformed."""
    xy, n, kept = stars()[0], 0, 0
    for exposure, extra, shift in zip(exposures, added, shifts, strict=False):
        where = xy + shift
        inside = ((where > 6) & (where < SIZE - 7)).all(axis=1)
        y, x = np.nonzero(extra)
        far = inside if not len(x) else inside & (cKDTree(np.column_stack([x, y])).query(where)[0] > 6)
        rows = usable(table[table["exposure"] == exposure.name])
        rows = rows[(rows["flags"] & Flag.DEFORMED) == 0]
        n, kept = n + far.sum(), kept + (cKDTree(positions(rows)).query(where[far])[0] < 1).sum()
    return n, kept


def hits(rng, share=0.01):
    """Cosmic rays on a part of the pixels."""
    return cosmic_rays(rng, SIZE, share, faintest=150)


def columns(rng):
    """Bright and dark, faint ones of which no pixel stands out, half ones, two beside each other, and a row."""
    out = np.zeros((SIZE, SIZE))
    out[:, 90], out[:, 40], out[:, 140], out[77] = 400, -150, 20, 25
    out[60:140, 170] = 200
    out[:, 20:22] = 300
    return out


def hot_pixels(rng):
    """The same in all frames."""
    rng, out = np.random.default_rng(8), np.zeros((SIZE, SIZE))
    out[rng.integers(4, SIZE - 4, 80), rng.integers(4, SIZE - 4, 80)] = np.exp(
        rng.uniform(np.log(200), np.log(2e4), 80)
    )
    return out


def n_matched(table):
    """Stars that are matched."""
    return len(np.unique(match(table, shape=(SIZE, SIZE)).table["star"]))


@pytest.fixture(scope="module")
def clean():
    exposures, _ = night()
    table = measure(exposures, psf="moffat")
    return table, n_matched(table)


@pytest.mark.parametrize("defects", [hits, columns, pytest.param(hot_pixels, marks=pytest.mark.slow)])
def test_defects_cost_no_star_that_they_do_not_touch(defects, clean):
    exposures, added = night(defects)
    table = measure(exposures, psf="moffat")
    n, kept = untouched(table, exposures, added)
    assert kept >= 0.98 * untouched(clean[0], exposures, added)[1] > 0.9 * n
    assert n_matched(table) >= 0.95 * clean[1]
    rows, false = usable(table), 0
    for k, exposure in enumerate(exposures):
        own = positions(rows[rows["exposure"] == exposure.name])
        false += (cKDTree(stars()[0] + SHIFTS[k]).query(own)[0] > 2).sum()
    assert false <= 0.04 * len(rows)


@pytest.mark.parametrize(
    "fwhm",
    [
        1.2,
        pytest.param(1.5, marks=pytest.mark.slow),
        pytest.param(2.0, marks=pytest.mark.slow),
        pytest.param(3.0, marks=pytest.mark.slow),
        5.0,
    ],
)
def test_stars_are_no_defects_however_sharp(fwhm):
    """Neither bright nor faint ones, at no phase of the pixels."""
    exposures, _ = night(fwhm=fwhm, frames=2)
    table = measure(exposures, psf="moffat")
    assert not (table["flags"] & Flag.DEFECT).any()
    assert len(usable(table)) > 0.9 * len(table) > 80


@pytest.mark.parametrize("axis", [0, 1])
def test_frames_narrower_than_what_is_looked_at_around_a_pixel(axis):
    """A strip has its broken lines marked, along it and across it, and its stars measured."""
    xy = np.column_stack([np.linspace(12, 187, 9), np.tile([8.0, 14.0, 10.0], 3)])
    data = observe(image((24, 200), xy, np.full(9, 2e4), 3.0), np.random.default_rng(1))
    data[:, 100] += 600
    data[20, 20:] -= 400
    shown = data.T if axis else data
    table = measure([Exposure("strip", shown.copy(), gain=GAIN, read_noise=READ_NOISE)], psf="moffat")
    rows = usable(table)
    where = positions(rows)[:, ::-1] if axis else positions(rows)
    found = cKDTree(where).query(xy[np.abs(xy[:, 0] - 100) > 6])[0]
    assert (found < 0.2).all()
    assert len(rows) <= 9


def test_hot_pixels_are_in_the_table_with_their_flag():
    exposures, (added,) = night(hot_pixels, frames=1)
    table = measure(exposures, psf="moffat")
    y, x = np.nonzero(added > 300)
    flagged = table[(table["flags"] & Flag.HOT) > 0]
    assert np.mean(cKDTree(positions(flagged)).query(np.column_stack([x, y]))[0] < 1.5) > 0.9
    assert (flagged["flags"] & Flag.DEFECT).all()
    assert np.all(np.diff(table["flux"]) <= 0)


@pytest.mark.slow
def test_a_star_is_measured_beside_the_defects_on_it():
    """What is hit of it is left out: errors stay true."""
    pulls = []
    exposures, _ = night(lambda rng: hits(rng, 0.03))
    table = usable(measure(exposures, psf="moffat"))
    for k, exposure in enumerate(exposures):
        rows = table[(table["exposure"] == exposure.name) & ((table["flags"] & Flag.DEFECT) > 0)]
        distance, star = cKDTree(stars()[0] + SHIFTS[k]).query(positions(rows))
        rows, star = rows[distance < 1], star[distance < 1]
        pulls.append((positions(rows) - stars()[0][star] - SHIFTS[k]) / errors(rows))
    pulls = np.concatenate(pulls)
    assert len(pulls) > 25
    assert 1.4826 * np.median(np.abs(pulls)) < 1.4


def soft(rng):
    """Warm places as wide as stars: nothing but their staying tells what they are."""
    return image((SIZE, SIZE), scattered(np.random.default_rng(5), 9, SIZE), np.full(9, 5e3), 3.0) - SKY


def test_what_stays_on_the_detector_while_the_sky_moves_is_no_star():
    exposures, _ = night(soft)
    places = scattered(np.random.default_rng(5), 9, SIZE)
    table = measure(exposures, psf="moffat")
    near = cKDTree(places).query(positions(table))[0] < 0.3
    assert near.sum() > 35
    assert np.mean((table["flags"][near] & Flag.HOT) > 0) > 0.9
    far = cKDTree(places).query(positions(table))[0] > 8
    assert not (table["flags"][far] & Flag.HOT).any()


def test_what_stays_in_many_exposures():
    """Two defects and twenty stars in 250 exposures, one of them empty: just the defects have the flag, in all."""
    rng, tables = np.random.default_rng(1), []
    defects, sky = np.array([[30.2, 40.1], [150.0, 20.7]]), rng.uniform(0, SIZE, (20, 2))
    for k in range(250):
        xy = np.concatenate([defects + rng.normal(0, 0.05, (2, 2)), sky + rng.uniform(-30, 30, 2)])[
            : 0 if k == 7 else 22
        ]
        columns = {"x": xy[:, 0] * u.pix, "y": xy[:, 1] * u.pix, "flux": np.full(len(xy), 1e3)}
        tables.append(QTable({**columns, "flags": np.zeros(len(xy), int)}))
    flag_what_stays(tables, [Exposure(f"e{k}", np.ones((8, 8))) for k in range(250)])
    for k, table in enumerate(tables):
        assert list(np.flatnonzero(table["flags"])) == ([] if k == 7 else [0, 1])
        assert (table["flags"][:2] == Flag.HOT | Flag.DEFECT).all()


@pytest.mark.slow
def test_a_star_is_none_of_its_own_images_that_persist():
    """For three exposures there is light where it was, ever less; the images are defects, the star is none."""
    xy, flux = stars()
    bright = np.argsort(-flux)[:8]
    light = [xy[bright] + shift for shift in SHIFTS]
    persists = [np.zeros((SIZE, SIZE)) for _ in SHIFTS]
    for k in range(1, len(SHIFTS)):
        for ago in range(1, k + 1):
            persists[k] += 0.03 * 0.9**ago * (image((SIZE, SIZE), light[k - ago], flux[bright], 3.0) - SKY)
    frames = [
        Exposure(f"e{k}", (one.data + extra).astype(np.float32), gain=GAIN, read_noise=READ_NOISE)
        for k, (one, extra) in enumerate(zip(night()[0], persists, strict=True))
    ]
    table = measure(frames, psf="moffat")
    first = table[table["exposure"] == "e0"]
    row = cKDTree(positions(first)).query(xy[bright])[1]
    assert not (first["flags"][row] & Flag.HOT).any()
    matches = match(table, shape=(SIZE, SIZE)).table
    there = matches[np.asarray(matches["exposure"]) == "e0"]
    where = np.column_stack([np.asarray(there[name].value) for name in "xy"])
    assert (cKDTree(where).query(xy[bright])[0] < 0.1).all()


def test_stars_stay_where_the_sky_does_not_move():
    exposures, _ = night(soft, shifts=np.zeros_like(SHIFTS), frames=3)
    table = measure(exposures, psf="moffat")
    assert not (table["flags"] & Flag.HOT).any()
    assert len(usable(table)) > 3 * 45


@pytest.mark.slow
def test_a_mask_that_hides_most_stars_is_named():
    """Of all stars or of most; one of hot pixels hides none."""
    (exposure,), _ = night(frames=1)
    light = image((SIZE, SIZE), *stars(), 3.0) - SKY
    for least in (20, 200):
        with warns_here(AssumptionWarning, match=r"e0: most bright stars lie on pixels .*\(--dq-good\)"):
            measure(Exposure("e0", exposure.data, light > least, gain=GAIN, read_noise=READ_NOISE), psf="moffat")
    (exposure,), (added,) = night(hot_pixels, frames=1)
    measure(Exposure("e0", exposure.data, added > 0, gain=GAIN, read_noise=READ_NOISE), psf="moffat")


@pytest.mark.slow
def test_bad_columns_hide_no_stars_and_a_weight_map_is_named(tmp_path):
    rng, light = np.random.default_rng(3), image((SIZE, SIZE), *stars(), 3.0)
    weights, cards = np.ones((SIZE, SIZE), "f4"), fits.Header({"GAIN": GAIN, "RDNOISE": READ_NOISE})
    weights[:, [20, 21, 60, 90, 91, 110]] = 0
    data = np.where(weights > 0, observe(light, rng), rng.normal(SKY + 4000, 1500, light.shape))
    for name, bad in (("columns", weights == 0), ("stars", light - SKY > 20)):
        fits.writeto(tmp_path / f"{name}.fits", data.astype("f4"), cards)
        fits.writeto(tmp_path / f"{name}.weight.fits", np.where(bad, 0, weights).astype("f4"))
    measure(read_exposures(tmp_path / "columns.fits"), psf="moffat")
    with warns_here(AssumptionWarning, match=r"stars: most bright stars .* without weight .*--weight-maps none"):
        measure(read_exposures(tmp_path / "stars.fits"), psf="moffat")


@pytest.mark.parametrize("angle", [pytest.param(0, marks=pytest.mark.slow), 140])
def test_a_trailed_frame_is_named(angle):
    """Stars of 3 pixels drawn out to a length of 9 more."""
    xy, flux = stars()
    along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    light = [image((SIZE, SIZE), xy + t * along, flux, 3.0, squash=np.ones(N)) for t in np.linspace(-4.5, 4.5, 10)]
    data = observe(np.mean(light, axis=0), np.random.default_rng(1))
    exposures = [*night(frames=2)[0], Exposure("trailed", data, gain=GAIN, read_noise=READ_NOISE)]
    with pytest.warns(AssumptionWarning, match=r"stars are trailed \(trailed: .* degrees from x to y\)") as caught:
        measure(exposures, psf="moffat")
    (message,) = [str(one.message) for one in caught if "trailed" in str(one.message)]
    words = message.split()
    wide, narrow, found = (float(words[words.index(key) + step]) for key, step in (("by", -1), ("by", 1), ("at", 1)))
    assert 7 < wide < 14
    assert 2.5 < narrow < 4
    assert abs((found - angle + 90) % 180 - 90) < 5
