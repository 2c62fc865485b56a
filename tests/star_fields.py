"""Detections of the same sky in several exposures, drawn at random, with the truth beside them."""

import numpy as np
from astropy.table import Table, vstack
from astropy.wcs import WCS

from legdistort.geometry import basis
from legdistort.inputs.exposures import Exposure

SHAPE = (2048, 2048)


def rotation(degrees, flip=False):
    """Matrix (2, 2)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s], [s, c]]) @ np.diag([-1 if flip else 1, 1])


def distortion(rng, shape, peak):
    """Random modes of degree 2 and 3, at most `peak` pixels."""
    coefficients = rng.normal(size=(10, 2)) * (np.arange(10) > 2)[:, None]
    u, v = np.meshgrid(*[np.linspace(-1, 1, 21)] * 2)
    coefficients *= peak / np.abs(basis.values(3, u.ravel(), v.ravel()).T @ coefficients).max()
    return lambda xy: xy + basis.values(3, *basis.normalize(xy, shape)).T @ coefficients


def detections(name, xy, **columns):
    """Table of one exposure."""
    table = Table({"exposure": np.full(len(xy), name), "x": xy[:, 0], "y": xy[:, 1]})
    table["x_err"] = table["y_err"] = 0.05
    for key, value in columns.items():
        table[key] = value
    return table


def make_field(
    n_stars,
    rotations,
    offsets,
    *,
    seed=0,
    shape=SHAPE,
    common=0.7,
    spurious=0.2,
    peak=20.0,
    dynamic=0.0,
    flips=None,
    depth=None,
    scales=None,
    error=0.05,
):
    """Detections of exposures turned by `rotations` [deg] about the detector's middle and shifted by `offsets` [pix].

    Of `n_stars` on a detector each exposure has sqrt(common), of these the brightest (part `depth`), and `spurious`
    times as many false ones. All share a distortion of `peak` pixels, every one has its own of `dynamic` pixels.
    The column ``truth`` says which is which (-1: false).
    """
    rng = np.random.default_rng(seed)
    size = np.array(shape[::-1])
    reach = 1.3 * size.max() + max(0, np.abs(offsets).max() - 0.5 * size.max())
    n = int(n_stars * (2 * reach) ** 2 / size.prod())
    sky, flux = rng.uniform(-reach, reach, (n, 2)), 10 ** rng.exponential(0.6, n)
    distort = distortion(rng, shape, peak)
    own = np.random.default_rng([seed, 1])
    tables = []
    for k, (angle, offset) in enumerate(zip(rotations, offsets, strict=True)):
        matrix = rotation(angle, bool(flips and flips[k])) * (1 if scales is None else scales[k])
        q = sky @ matrix.T + offset + (size - 1) / 2
        seen = np.all((q > -0.5) & (q < size - 0.5), axis=1) & (rng.random(n) < np.sqrt(common))
        seen &= flux > (np.quantile(flux, 1 - depth[k]) if depth else 0)
        ids = np.flatnonzero(seen)
        xy = distort(q[ids]) + rng.normal(0, error, (len(ids), 2))
        if dynamic:
            xy = distortion(own, shape, dynamic)(xy)
        false = int(spurious * len(ids))
        xy = np.concatenate([xy, rng.uniform(-0.5, size - 0.5, (false, 2))])
        flux_here = np.concatenate([flux[ids] * rng.lognormal(0, 0.1, len(ids)), rng.choice(flux, false)])
        ids = np.concatenate([ids, np.full(false, -1)])
        order = rng.permutation(len(ids))
        tables.append(detections(f"e{k:02d}", xy[order], flux=flux_here[order], truth=ids[order]))
    return vstack(tables)


def six_poses(angle, offset, seed=0):
    """Rotations [deg] and offsets [pix] of six exposures."""
    rng = np.random.default_rng(seed)
    shifts = rng.uniform(-0.5, 0.5, (6, 2)) * offset
    shifts[1] = shifts[0] + offset * np.array([1, rng.uniform(-1, 1)])
    return [0, angle, -angle, angle / 2, 0, angle], shifts


def recall_and_purity(table, found, min_exposures=4):
    """Part of the detections of stars in enough exposures that was found, and part of the rows found that is right."""
    truth, times = np.unique(table["truth"][table["truth"] >= 0], return_counts=True)
    wanted = np.isin(table["truth"], truth[times >= min_exposures]).sum()
    star, truth = np.asarray(found["star"]), np.asarray(found["truth"])
    right = 0
    for s in np.unique(star):
        values, times = np.unique(truth[star == s], return_counts=True)
        right += times[times.argmax()] if values[times.argmax()] >= 0 else 0
    return right / wanted, right / len(star)


def header(angle, offset, *, flip=False, scale=0.02 / 3600, error=(0, 0)):
    """TAN header of an exposure of `make_field`: detector = R sky + offset, sky y to the north, x to the west."""
    w = WCS(naxis=2)
    w.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    w.wcs.crval = [84.0, -69.0]
    w.wcs.crpix = (np.array(SHAPE[::-1]) - 1) / 2 + offset + error + 1
    w.wcs.cd = scale * np.diag([-1, 1]) @ np.linalg.inv(rotation(angle, flip))
    return w


#: Stars on a detector, rotation [deg] and offset [pix] of the grid.
CELLS = [(n, angle, offset) for n in (40, 100, 1000) for angle in (0.2, 2, 30, 180) for offset in (20, 300)]
FLIPS = (False, True, False, True, False, False)
#: What the exposures of the grid go down to: part of the stars of the deepest.
DEPTHS = (1, 0.7, 0.9, 1, 0.8, 1)


def grid_field(cell, *, seed, flips=None):
    """A field of the grid: half of the detections false, 20 px of distortion and 2 of each exposure's own, scales
    5 per cent off at most, depths differ, 5 per cent of the stars missed.
    """
    n, angle, offset = cell
    scales = np.random.default_rng([seed, 7]).uniform(0.95, 1.05, 6)
    where = six_poses(angle, offset, seed)
    return make_field(
        n, *where, seed=seed, common=0.9, spurious=1.0, dynamic=2.0, flips=flips, depth=DEPTHS, scales=scales
    )


def grid_exposures(cell, *, seed, flips=None):
    """Exposures of a field of the grid: headers 20 px and 0.3 degrees off at random; of the scales they say nothing."""
    _, angle, offset = cell
    rng = np.random.default_rng([seed, 8])
    angles, offsets = six_poses(angle, offset, seed)
    return [
        exposure(
            f"e{k:02d}", header(a + rng.normal(0, 0.3), o, flip=bool(flips and flips[k]), error=rng.normal(0, 20, 2))
        )
        for k, (a, o) in enumerate(zip(angles, offsets, strict=True))
    ]


def exposure(name, wcs):
    """Exposure without anything in its pixels."""
    return Exposure(name, np.broadcast_to(np.float32(0), SHAPE), wcs=wcs)
