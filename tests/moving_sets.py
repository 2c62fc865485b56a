"""Sets of stars that move, seen through distortions of any size: the truth is that of `dense_model`, in numpy alone."""

import dense_model
import numpy as np

THREE, TWO = np.repeat([2015.3, 2016.5, 2019.2], 4), np.repeat([2015.3, 2019.2], 5)

#: Words of `dense_model.drawn_set`, whether the static distortion is given, and factors on the errors of the last k.
ROWS = {
    "departures 0.4 px, exact prior": ({"dynamic": 0.4}, True, None),
    "rolls, static 12, departures 3 px": ({"static": 12.0, "dynamic": 3.0, "rolls": 30.0}, False, None),
    "departures 10 px, exact prior": ({"dynamic": 10.0}, True, None),
    "rolls, errors of 0.001 to 0.005 px": (
        {"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "errors": (0.001, 0.005)},
        False,
        None,
    ),
    "rolls, terms of degrees 4-5 of 0.02 px": (
        {"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "higher": 0.02},
        False,
        None,
    ),
    "two epochs, departures 3 px, exact prior": ({"dynamic": 3.0, "years": TWO}, True, None),
    "one exposure 50 times noisier, exact prior": ({"dynamic": 0.4}, True, (1, 50.0)),
    "8 of 12 exposures 10 times noisier, exact prior": ({"dynamic": 0.4}, True, (8, 10.0)),
}


def drawn(row, seed):
    """A set, its truth, and whether the static distortion is given: three epochs of four, 0.3 px a year."""
    words, given, noisier = ROWS[row]
    data, truth = dense_model.drawn_set(seed, **{"static": 1.0, "motion": 0.3, "years": THREE} | words)
    if noisier is not None:
        bad = data["exposure"] > data["exposure"].max() - noisier[0]
        noise = np.sqrt(noisier[1] ** 2 - 1) * np.random.default_rng(seed + 50).normal(size=data["xy"].shape)
        data["xy"] = data["xy"] + bad[:, None] * noise * data["err"]
        data["err"] = np.where(bad[:, None], noisier[1], 1.0) * data["err"]
    return data, truth, given


def information(data, truth):
    """What exposures say of positions and of motions, (n, 2), were distortions known; 0 for a star seen at one epoch.

    Motions eliminated from that of positions, and the reverse.
    """
    time, n = data["epoch"] - truth["epoch"], len(truth["stars"])
    s0, s1, s2 = (np.bincount(data["star"], data["err"][:, 0] ** -2.0 * time**k, n) for k in range(3))
    left = np.where(s0 * s2 - s1**2 > 1e-9 * s0 * s2, s0 * s2 - s1**2, 0)
    return np.stack([left / np.where(left > 0, s2, 1), left / s0], axis=1)


def relative_errors(stars, data, truth):
    """True and stated errors (n, 2) of positions, and those of motions, a common cubic map of each taken off."""
    order, out = np.asarray(stars["star"]), []
    values = dense_model.basis(truth["stars"][order], 3, 2048)[0]
    kinds = (("x", "y"), truth["stars"]), (("vx", "vy"), truth["motions"])
    for (names, true), weight in zip(kinds, information(data, truth)[order].T, strict=True):
        use, root = weight > 0, np.sqrt(weight)[:, None]
        offset = np.stack([stars[name].value for name in names], axis=1) - true[order]
        stated = np.stack([stars[f"{name}_err"].value for name in names], axis=1)[use]
        offset = offset[use]
        offset -= values[use] @ np.linalg.lstsq((root * values)[use], root[use] * offset, rcond=None)[0]
        out.append((offset, stated))
    return out


def relative_squares(stars, data, truth):
    """Sums of their squares, (2, 2)."""
    return np.array([[np.sum(each**2) for each in pair] for pair in relative_errors(stars, data, truth)])


def absolute_squares(stars, truth):
    """Sums of squares of absolute errors, a shift, a rotation and a scale of each taken off; NaN if few are known."""
    order, out = np.asarray(stars["star"]), []
    for names, true in ((("x", "y"), truth["stars"]), (("vx", "vy"), truth["motions"])):
        offset = (np.stack([stars[name].value for name in names], axis=1) - true[order]) @ [1, 1j]
        stated = np.stack([stars[f"{name}_err_abs"].value for name in names], axis=1)
        moves = np.isfinite(stars["vx"].value)
        use = np.isfinite(stated).all(axis=1) & moves
        if np.count_nonzero(use) < 0.9 * np.count_nonzero(moves):
            out.append([np.nan, np.nan])
            continue
        design = np.stack([np.ones(np.count_nonzero(use)), truth["stars"][order][use] @ [1, 1j]], axis=1)
        offset = offset[use] - design @ np.linalg.lstsq(design, offset[use], rcond=None)[0]
        out.append([np.sum(np.abs(offset) ** 2), np.sum(stated[use] ** 2)])
    return np.array(out)
