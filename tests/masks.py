"""Holes of masks, and stars that lie on no lattice; numpy alone."""

import numpy as np

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
