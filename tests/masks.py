"""Holes of masks, and stars that lie on no lattice; numpy alone."""

import numpy as np
from astropy.table import QTable

SIZE = 2048


def mask(rng, *, pitch=100.0, turned=0.0, hexagonal=False, lost=0.0, distortion=3.0, wrong=0.3):
    """Holes (n, 2) on a detector: made wrong by so many pixels, some of them stopped up."""
    g = np.arange(-35, 36) * pitch
    x, y = np.meshgrid(g, g)
    if hexagonal:
        x, y = x + pitch / 2 * (np.arange(len(g)) % 2)[:, None], y * np.sqrt(3) / 2
    z = (x + 1j * y).ravel() * np.exp(1j * np.deg2rad(turned)) + complex(*rng.uniform(950, 1100, 2))
    xy = np.stack([z.real, z.imag], axis=1) + rng.normal(0, wrong, (len(z), 2))
    u, v = (xy / SIZE * 2 - 1).T
    xy = xy + distortion * np.stack([u**3 - v**2, u * v], axis=1)
    return xy[((xy > 0) & (xy < SIZE)).all(axis=1) & (rng.random(len(xy)) >= lost)]


def field(seed):
    """Stars anywhere, in a cluster, in long groups, or in pairs; 14 to 2000 of them."""
    rng = np.random.default_rng(seed)
    n, kind = int(np.exp(rng.uniform(np.log(14), np.log(2000)))), seed % 4
    xy = rng.uniform(0, SIZE, (n, 2))
    if kind == 1:
        xy[: n // 2] = SIZE / 2 + 60 * rng.standard_t(2, (n // 2, 2))
    elif kind == 2:
        xy = xy[rng.integers(0, min(n, 8), n)] + 30 * rng.standard_t(2, (n, 2)) * [1, 3]
    elif kind == 3:
        xy = np.vstack([xy, xy + rng.normal(0, 3, (n, 2))])
    return xy


#: Turns of an exposure by a set's word [deg].
TURNS = {
    "none": lambda rng: 0.0,
    "small": lambda rng: rng.uniform(-3, 3),
    "quarters": lambda rng: 90.0 * rng.integers(0, 3),
    "both": lambda rng: 90.0 * rng.integers(0, 3) + rng.uniform(-3, 3),
}


def night(
    seed, *, n_exposures=9, pitch=100.0, holes=27, wrong=0.3, stopped=0.0, missed=0.0, turns="none", shift=150.0,
    rough=0.0, noise=0.01,
):  # fmt: skip
    """Exposures of one mask, shifted and turned about the centre: detections with the `hole`, and shifts and turns.

    Holes are made wrong by so many px, a part is stopped up, a part missed in each exposure; the detector has a smooth
    distortion of 3 px, and a rough one of 25 px width.
    """
    rng = np.random.default_rng(seed)
    g = (np.arange(holes) - (holes - 1) / 2) * pitch
    mask_xy = np.stack(np.meshgrid(g, g), axis=-1).reshape(-1, 2) + rng.normal(0, wrong, (holes**2, 2))
    open_ones, bend = np.flatnonzero(rng.random(holes**2) >= stopped), rng.normal(0, 1.5, (2, 7))
    waves = rng.normal(0, 1 / 25, (2, 40, 2)), rng.uniform(0, 2 * np.pi, (2, 40))
    rows, stated = [], {}
    for i in range(n_exposures):
        name, step, turn = f"m{i}", rng.uniform(-shift, shift, 2), TURNS[turns](rng)
        a = np.deg2rad(turn)
        q = mask_xy[open_ones] @ [[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]] + (SIZE - 1) / 2 + step
        u, v = (q / (SIZE - 1) * 2 - 1).T
        xy = q + np.stack([u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=1) @ bend.T
        pattern = [np.sqrt(2 / 40) * np.sin(xy @ k.T + phase).sum(axis=1) for k, phase in zip(*waves, strict=True)]
        xy = xy + rough * np.stack(pattern, axis=1) + rng.normal(0, noise, xy.shape)
        seen = ((xy > 5) & (xy < SIZE - 6)).all(axis=1) & (rng.random(len(xy)) >= missed)
        for k in rng.permutation(np.flatnonzero(seen)):
            rows.append((name, *xy[k], noise, noise, open_ones[k]))
        stated[name] = (*step, turn)
    return QTable(rows=rows, names=["exposure", "x", "y", "x_err", "y_err", "hole"]), stated


def mixed(matches):
    """Number of stars of a match that have images of different holes."""
    star, hole = np.asarray(matches.table["star"]), np.asarray(matches.table["hole"])
    pairs = np.unique(np.stack([star, hole]), axis=1)
    return len(pairs.T) - len(np.unique(star))
