"""Nights on a detector with every defect that a mask may lack, of known truth, made with numpy alone.

Hot pixels at fixed places (single ones, crosses of the charge they share, clusters), bad columns and rows, steps
between amplifiers, a response that falls by 2 % towards the full well, cosmic rays, streaks of satellites, and
persistence: one per cent of what the exposure before had, at its places, and less of the ones before that.
"""

from typing import NamedTuple

import numpy as np
from astropy import units as u
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree
from star_images import GAIN, READ_NOISE, SKY, image

from legdistort.inputs.exposures import Exposure

SIZE, FWHM, FULL = 400, 3.0, 60_000.0
N_BRIGHT, N_FAINT = 22, 90


class Night(NamedTuple):
    """Frames and the truth: positions (frames, stars, 2), the bright stars first, and the light that is no star's."""

    frames: list
    xy: np.ndarray
    flux: np.ndarray
    defects: list


def night(seed, *, dirty=True, n=7, size=SIZE, without=()):
    """A dithered night of 22 bright and 90 faint stars; `without` names the defects that are left out.

    Stars, dithers and noise of a clean and a dirty night of one seed are the same.
    """
    rng = np.random.default_rng([seed, 0])
    sky, flux = _stars(rng, size)
    shifts = np.vstack([np.zeros(2), rng.uniform(-35, 35, (n - 1, 2))])
    fixed = np.random.default_rng([seed, 1])
    kinds = {"hot": _hot, "lines": _lines, "amplifiers": _amplifiers} if dirty else {}
    stays = [make(fixed, size) for name, make in kinds.items() if name not in without]
    frames, defects, positions, before = [], [], [], np.zeros((size, size))
    for k, shift in enumerate(shifts):
        own, hits = np.random.default_rng([seed, 2, k]), np.random.default_rng([seed, 3, k])
        xy = _distorted(sky + shift, size)
        inside = ((xy > -20) & (xy < size + 20)).all(axis=1)
        light = image((size, size), xy[inside], flux[inside], FWHM)
        extra = sum(stays, np.zeros((size, size)))
        if dirty and "persistence" not in without:
            extra += before
        if dirty and "hits" not in without:
            extra += cosmic_rays(hits, size)
        if dirty and "streaks" not in without and k % 2:
            extra += _streak(hits, size)
        electrons = own.poisson(np.maximum(light + extra, 0) * GAIN) + own.normal(0, READ_NOISE, light.shape)
        data = electrons / GAIN + np.minimum(extra + light, 0)
        if dirty and "response" not in without:
            data = data * (1 - 0.02 * np.clip(data, 0, FULL) / FULL)
        frames.append(np.minimum(data, FULL).astype(np.float32))
        defects.append(extra)
        positions.append(xy)
        before = 0.01 * np.minimum(light - SKY, FULL) + 0.3 * before  # of stars, which stand elsewhere by now
    return Night(frames, np.array(positions), flux, defects)


def _stars(rng, size):
    """Positions and fluxes; bright stars peak at a tenth to nine tenths of the full well, two of them above."""
    margin = 45
    grid = np.stack(np.meshgrid(*[np.linspace(margin, size - margin, 11)] * 2), axis=-1).reshape(-1, 2)
    xy = rng.permutation(grid)[: N_BRIGHT + N_FAINT] + rng.uniform(-8, 8, (N_BRIGHT + N_FAINT, 2))
    peak = np.concatenate([[1.5 * FULL] * 2, np.geomspace(0.05, 0.85, N_BRIGHT - 2) * FULL])
    faint = np.exp(rng.uniform(np.log(40), np.log(1500), N_FAINT))
    return xy, np.concatenate([peak, faint]) * 1.3 * FWHM**2


def _distorted(xy, size):
    """Two pixels of distortion towards the corners."""
    x, y = (2 * xy / size - 1).T
    return xy + np.column_stack([0.7 * x**2 - 0.4 * x * y + 0.5 * y**3, 0.6 * y**2 + 0.5 * x * y - 0.4 * x**3])


def _hot(rng, size):
    """Of a thousand pixels two, some with the charge that goes over to their neighbours, and 12 clusters."""
    out = np.zeros((size, size))
    n = size * size // 500
    y, x = rng.integers(1, size - 1, (2, n))
    value = np.exp(rng.uniform(np.log(100), np.log(3e4), n))
    out[y, x] += value
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        np.add.at(out, (y + dy, x + dx), 0.015 * value)
    for y, x in rng.integers(3, size - 3, (12, 2)):
        wide = rng.integers(2, 4, 2)
        out[y : y + wide[0], x : x + wide[1]] += rng.uniform(200, 4000, tuple(wide))
    return out


def _lines(rng, size):
    """Six columns, bright and dark, whole and in part, and two rows."""
    out = np.zeros((size, size))
    for value, part in zip((400, -120, 30, 900, 150, -60), (1, 1, 1, 0.4, 0.6, 0.5), strict=True):
        first = rng.integers(0, max(1, int(size * (1 - part))))
        out[first : first + int(size * part), rng.integers(5, size - 5)] += value
    for value in (60, -25):
        out[rng.integers(5, size - 5)] += value
    return out


def _amplifiers(rng, size):
    """Eight of them, with levels of their own: steps of about two standard deviations of the noise."""
    return np.repeat(rng.normal(0, 15, 8), size // 8)[None, :] * np.ones((size, 1))


def cosmic_rays(rng, size, share=1.5e-3, faintest=100):
    """Tracks of one to nine pixels on a part of the pixels."""
    out, done = np.zeros((size, size)), 0
    while done < share * out.size:
        start, angle, length = rng.uniform(5, size - 6, 2), rng.uniform(0, np.pi), rng.integers(1, 10)
        steps = np.arange(length)[:, None] * [np.sin(angle), np.cos(angle)]
        y, x = np.clip(np.round(start + steps), 0, size - 1).astype(int).T
        out[y, x] += np.exp(rng.uniform(np.log(faintest), np.log(2e4)))
        done += length
    return out


def _streak(rng, size):
    """A satellite from border to border, as wide as a star."""
    angle, through = rng.uniform(0, np.pi), rng.uniform(0.2, 0.8, 2) * size
    y, x = np.indices((size, size))
    off = (x - through[0]) * np.sin(angle) - (y - through[1]) * np.cos(angle)
    return rng.uniform(200, 1500) * np.exp(-4 * np.log(2) * (off / FWHM) ** 2)


def exposures(frames):
    """Frames as `Exposure` objects, which state a gain, a read noise and a full well, and no mask."""
    known = {"gain": GAIN, "read_noise": READ_NOISE, "saturation": 0.95 * FULL}
    return [Exposure(f"e{k}", frame, **known) for k, frame in enumerate(frames)]


def seen(table, truth):
    """Whether stars (frames, stars) have a row within half a pixel of where they are, (frames, stars, 2)."""
    out, names = np.zeros(truth.shape[:2], dtype=bool), np.asarray(table["exposure"])
    xy = np.column_stack([u.Quantity(table["x"]).value, u.Quantity(table["y"]).value])
    for k, positions in enumerate(truth):
        rows = xy[names == f"e{k}"]
        if len(rows):
            out[k] = cKDTree(rows).query(positions)[0] < 0.5
    return out


def inside(truth, size=SIZE):
    """Whether stars lie 6 pixels or more within the frames."""
    return ((truth > 6) & (truth < size - 7)).all(axis=2)


def untouched(night, reach=6, most=8.0):
    """Whether around stars (frames, stars) what is no star's differs by no more than the noise."""
    out = np.zeros(night.xy.shape[:2], dtype=bool)
    for k, extra in enumerate(night.defects):
        wide = maximum_filter(extra, 2 * reach + 1) - minimum_filter(extra, 2 * reach + 1) < most
        x, y = np.clip(np.round(night.xy[k]).astype(int), 0, len(extra) - 1).T
        out[k] = wide[y, x]
    return out & inside(night.xy, len(night.frames[0]))


def kept(where, within, share=0.6):
    """Whether stars are found in this part at least of the frames that they lie in, (stars,)."""
    return (where & within).sum(axis=0) >= share * np.maximum(within.sum(axis=0), 1)
