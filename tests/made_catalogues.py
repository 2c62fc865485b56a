"""Reference catalogues of sets of `dense_model`, right or with one fault; numpy alone."""

import numpy as np
from astropy.table import Table

ERROR = 0.01
#: Year of the exposures, which is what a catalogue with motions says of itself.
EPOCH = 2020.0
#: What is wrong, and by how much.
FAULTS = {
    "bent by 1 px": ("bent", 1.0),
    "bent by 0.1 px": ("bent", 0.1),
    "five years off": ("epoch", 5.0),
    "20 % blunders": ("blunders", 1.0),
    "errors x 1000": ("errors", 1000.0),
    "errors / 1000": ("errors", 0.001),
    "errors / 2": ("errors", 0.5),
    "errors x 2": ("errors", 2.0),
}


def catalogue(stars, seed, fault=None, *, n=40):
    """A table of `n` of the stars, pixels of the reference plane (n_stars, 2), with errors of `ERROR` pixels."""
    kind, size = FAULTS.get(fault, (fault, 0.0))
    rng = np.random.default_rng([seed, 7])
    rows = rng.permutation(len(stars))[:n]
    xy, stated, table = stars[rows] + ERROR * rng.normal(size=(n, 2)), ERROR, Table({"star": rows})
    if kind == "bent":
        x, y = ((xy - xy.mean(axis=0)) / 1024).T
        move = np.stack([x**2, x * y, y**2], axis=1) @ rng.normal(size=(3, 2))
        move -= move.mean(axis=0)
        xy = xy + size * move / np.sqrt(np.mean(move**2))
    elif kind == "blunders":
        wrong = rng.random(n) < 0.2
        xy[wrong] += size * rng.normal(size=(np.count_nonzero(wrong), 2))
    elif kind == "errors":
        stated = ERROR * size
    elif kind in ("epoch", "motions"):
        motion = 0.1 * rng.normal(size=(n, 2))
        xy = xy + size * motion
        table["vx"], table["vy"] = motion.T
        table["vx_err"] = table["vy_err"] = 0.001
        table["ref_epoch"] = EPOCH
    table["x"], table["y"] = xy.T
    table["x_err"] = table["y_err"] = stated
    return table
