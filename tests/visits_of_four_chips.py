"""Nights of one camera of four detectors, whose headers have these wrong; numpy alone.

Every exposure bends the focal plane by quadratic and cubic terms of its own; detectors are turned, of other scales, and
distorted by quadratic and cubic terms that stay.
"""

import numpy as np
from astropy.table import Table
from numpy.polynomial.legendre import legval2d

SIZE, GAP = 1024, 70
HALF = SIZE / 2 + GAP / 2
CORNERS = np.array([(1, -1), (-1, -1), (-1, 1), (1, 1)]) * HALF
TURNS = 0.05, -0.12, 0.6, -0.4  # degrees
KEYS = "1", "2", "3", "4"


def terms(rng, quadratic, cubic):
    """Legendre terms (2, 4, 4), as `legval2d` takes them."""
    order = np.add.outer(range(4), range(4))
    return rng.normal(size=(2, 4, 4)) * np.select([order == 2, order == 3], [quadratic, cubic], 0.0)


def bent(z, of):
    return z + np.stack([legval2d(*(z.T / of[1]), each) for each in of[0]], axis=-1)


class Chips:
    """The camera as it is: what lies at f in the focal plane, whose middle is its origin, is seen at some pixel."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.centres = CORNERS + rng.normal(0, 4, (4, 2))
        self.turns, self.scales = np.radians(TURNS), 1 + rng.normal(0, 0.003, 4)
        self.statics = np.array([terms(rng, 2.2, 0.8) for _ in KEYS])

    def seen(self, k, f):
        c, s = np.cos(self.turns[k]), np.sin(self.turns[k])
        z = self.scales[k] * (f - self.centres[k]) @ np.array([[c, s], [-s, c]])
        return bent(z, (self.statics[k], SIZE / 2)) + (SIZE - 1) / 2


def night(chips, seed, *, n_stars=260, rolls=(0, 0, 0, 0, 0, 0, 45), noise=0.03, dynamic=0.25, tie=0.02):
    """A table of matches, poses by headers with errors, and a reference of 60 % of the stars."""
    rng = np.random.default_rng(seed)
    stars, rows, poses = rng.uniform(-1230, 1230, (n_stars, 2)), [], {}
    for i, roll in enumerate(rolls):
        a, shift = np.radians(roll), rng.normal(0, 80, 2) * (i > 0)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        f = bent(stars @ turn.T + shift, (terms(rng, dynamic, dynamic), 1100.0))
        poses[f"e{i}"] = np.column_stack([turn, shift + rng.normal(0, 2, 2)])
        for k, key in enumerate(KEYS):
            near = np.abs(f - chips.centres[k]).max(axis=1) < SIZE * 0.6
            q = chips.seen(k, f)
            for j in np.flatnonzero(near & ((q > 0) & (q < SIZE - 1)).all(axis=1)):
                rows.append((f"e{i}", key, str(j), *(q[j] + noise * rng.normal(size=2)), noise, noise))
    table = Table(rows=rows, names=["exposure", "detector", "star", "x", "y", "x_err", "y_err"])
    some = np.flatnonzero(rng.random(n_stars) < 0.6)
    xy = stars[some] + tie * rng.normal(size=(len(some), 2))
    known = Table({"star": some.astype(str), "x": xy[:, 0], "y": xy[:, 1]})
    known["x_err"] = known["y_err"] = tie
    return table, poses, known


def layouts(seed, by=12.0):
    """Layouts (2, 3) as headers state them: no turns, detectors off by some pixels."""
    off = np.random.default_rng((7, seed)).normal(0, by, (4, 2))
    return {key: np.column_stack([np.eye(2), (SIZE - 1) / 2 - CORNERS[k] - off[k]]) for k, key in enumerate(KEYS)}
