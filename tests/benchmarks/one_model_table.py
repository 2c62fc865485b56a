"""Large, unequal and precise distortions: errors of positions against their bound, and stated against true errors.

``python tests/benchmarks/one_model_table.py`` makes all rows, ``--only`` some, ``--sets`` so many sets each. Sets are
those of `dense_model.drawn_set`: every normalised Legendre coefficient of the static distortion, and of an exposure's
departure from it, is drawn from N(0, so many pixels), similarities aside; eleven exposures of 2048 pixels, some 65
stars each, dithers N(0, 150 px), degree 3, errors log-uniform between 0.005 and 0.08 px by star. The bound is the rms
of the Cramer-Rao errors of the full model, in dense numpy, after the common cubic maps are projected off with the
weights of the observations; it knows nothing of scatter or statics, and estimates that do may be better.

Columns: chi2 over its degrees of freedom; relative errors (a common cubic map, weighted, taken off) over the bound, rms
over all sets; the sum of their squares over that of the stated variances; rms of absolute errors (a similarity taken
off), the same sum for those that are finite, and the share of these.
"""

import argparse
import logging
import sys
import warnings
from pathlib import Path

import numpy as np

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.results import accuracy

sys.path.insert(0, str(Path(__file__).parents[1]))
import dense_model
import drawn_sets

#: Words of `dense_model.drawn_set`, and whether the static distortion is given.
ROWS = {
    "departures 10 px, exact prior of 1 px": ({"static": 1.0, "dynamic": 10.0}, True),
    "static 12, departures 0.4, prior": ({"static": 12.0, "dynamic": 0.4}, True),
    "static 12, departures 3, prior": ({"static": 12.0, "dynamic": 3.0}, True),
    "static 12, departures 0.4": ({"static": 12.0, "dynamic": 0.4}, False),
    "static 12, departures 3": ({"static": 12.0, "dynamic": 3.0}, False),
    "static 1.5": ({"static": 1.5}, False),
    "static 3": ({"static": 3.0}, False),
    "rolls, static 1.5, departures 0.9": ({"static": 1.5, "dynamic": 0.9, "rolls": 30.0}, False),
    "rolls, terms of degrees 4-5 of 0.005 px": (
        {"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "higher": 0.005},
        False,
    ),
    "rolls, terms of degrees 4-5 of 0.02 px": (
        {"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "higher": 0.02},
        False,
    ),
    "one exposure of 10 px among 0.4, exact prior": ({"static": 1.0, "odd": 10.0}, True),
    "0.001-0.005 px, rolls, static 1.5, departures 0.9": (
        {"static": 1.5, "dynamic": 0.9, "rolls": 30.0, "errors": (0.001, 0.005)},
        False,
    ),
    "balanced: departures 0.4, exact prior": ({"static": 1.0, "dynamic": 0.4}, True),
}
for _error in (0.1, 0.3, 1.0, 5.0):
    ROWS[f"one exposure of {_error} px, exact prior"] = ({"static": 1.0, "poor": (1, _error)}, True)
ROWS["8 of 11 exposures 10 times noisier, exact prior"] = ({"static": 1.0, "noisier": (8, 10.0)}, True)
ROWS["8 of 11 noisier, departures 3, exact prior"] = ({"static": 1.0, "dynamic": 3.0, "noisier": (8, 10.0)}, True)
ROWS["8 of 11 noisier, departures 3, static 1.5"] = ({"static": 1.5, "dynamic": 3.0, "noisier": (8, 10.0)}, False)
for _count in (15, 11):
    ROWS[f"one exposure of {_count} stars, exact prior"] = ({"static": 1.0, "few": _count}, True)


def drawn(seed, words):
    """A set and its truth; `poor`: (k, error) of the last k exposures, `noisier`: (k, factor), `few`: stars left."""
    words = dict(words)
    poor, noisier, few = words.pop("poor", None), words.pop("noisier", None), words.pop("few", None)
    data, truth = dense_model.drawn_set(seed, **words)
    rng, last = np.random.default_rng(seed + 5000), data["exposure"].max()
    if poor or noisier:
        mine = data["exposure"] > last - (poor or noisier)[0]
        new = np.full(data["err"].shape, poor[1]) if poor else noisier[1] * data["err"]
        extra = np.sqrt(np.maximum(new**2 - data["err"] ** 2, 0)) * rng.normal(size=new.shape)
        data["xy"] = data["xy"] + mine[:, None] * extra
        data["err"] = np.where(mine[:, None], np.maximum(new, data["err"]), data["err"])
    if few:
        mine = np.flatnonzero(data["exposure"] == last)
        lost = rng.permutation(mine)[few:]
        keep = np.ones(len(data["star"]), dtype=bool)
        keep[lost] = False
        keep &= np.bincount(data["star"], keep)[data["star"]] > 1
        used, star = np.unique(data["star"][keep], return_inverse=True)
        data |= {name: data[name][keep] for name in ("xy", "err", "exposure")} | {"star": star}
        truth = truth | {"stars": truth["stars"][used]}
    return data, truth


def projected_off(data, stars, degree):
    """Takes common maps of a degree off values of the stars (2 n, ...), x first, with the weights of observations."""
    b = dense_model.basis(stars, degree, data["n"])[0]
    weight = np.bincount(data["star"], data["err"][:, 0] ** -2.0, len(stars))
    design = np.kron(np.eye(2), b)
    w = np.tile(weight, 2)[:, None]
    fit = np.linalg.solve(design.T @ (w * design), (w * design).T)
    return np.eye(len(design)) - design @ fit


def bound(data, truth):
    """Mean variance of the stars in the full model, all else unknown, common maps projected off."""
    model = dense_model.Model(*(data[k] for k in ("xy", "err", "star", "exposure", "poses", "n", "degree")))
    model.X, model.A = truth["stars"].copy(), (truth["static"] + truth["dynamic"]).reshape(model.N, -1)
    normal = model.linear()[0]
    unit = 1 / np.sqrt(np.diag(normal))
    values, vectors = np.linalg.eigh(unit[:, None] * normal * unit)
    kept = values > 1e-11 * values.max()
    vectors = unit[:, None] * vectors[:, kept] / np.sqrt(values[kept])
    n = len(truth["stars"])
    order = np.r_[np.arange(n) * 2, np.arange(n) * 2 + 1]
    root = projected_off(data, truth["stars"], data["degree"]) @ vectors[order]
    return (root**2).sum(axis=1).mean()


def similarity_off(offset, stars):
    """Offsets (n, 2) without the similarity that fits them best."""
    (x, y), one, zero = (stars - stars.mean(axis=0)).T, np.ones(len(stars)), np.zeros(len(stars))
    columns = np.stack([np.r_[one, zero], np.r_[zero, one], np.r_[x, y], np.r_[-y, x]], axis=1)
    values = offset.T.ravel()
    return (values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]).reshape(2, -1).T


def one_set(seed, words, prior):
    """Figures of a set."""
    data, truth = drawn(seed, words)
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        given = ld.Prior(truth["static"]) if prior else None
        solution = ld.solve(drawn_sets.as_matches(data), degree=data["degree"], prior=given, clip=None)
    place = {str(name): k for k, name in enumerate(solution.stars["star"])}
    rows = [place[str(k)] for k in range(len(truth["stars"]))]
    stars = solution.stars[rows]
    xy = np.stack([stars["x"].value, stars["y"].value], axis=1)
    relative = (projected_off(data, truth["stars"], data["degree"]) @ (xy - truth["stars"]).T.ravel()).reshape(2, -1).T
    stated = np.stack([stars["x_err"].value, stars["y_err"].value], axis=1)
    absolute = similarity_off(xy - truth["stars"], truth["stars"])
    known = np.stack([stars["x_err_known"].value, stars["y_err_known"].value], axis=1)
    offset = -accuracy.known_offsets(solution, truth["stars"][np.argsort(rows)])[rows]
    finite = np.isfinite(known)
    whole = np.isfinite(stars["x_err_abs"].value).mean()
    return {
        "chi2": solution.chi2 / solution.dof,
        "relative": np.mean(relative**2),
        "bound": bound(data, truth),
        "stated": np.mean(stated**2),
        "absolute": np.mean(absolute**2),
        "known": np.sum(offset[finite] ** 2),
        "known_stated": np.sum(known[finite] ** 2),
        "finite": whole,
    }


def main(arguments=None):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=[""], help="rows whose name contains one of these")
    parser.add_argument("--sets", type=int, default=20)
    arguments = parser.parse_args(arguments)
    logging.getLogger("legdistort").setLevel(logging.ERROR)
    heads = ("chi2/dof", "over bound", "pull2", "absolute", "pull2", "finite")
    print(f"{'setting':52s}" + "".join(f"{head:>11s}" for head in heads))
    for name, (words, prior) in ROWS.items():
        if not any(part in name for part in arguments.only):
            continue
        sets = [one_set(seed, words, prior) for seed in range(arguments.sets)]
        mean = {key: np.mean([each[key] for each in sets]) for key in sets[0]}
        figures = (
            np.median([each["chi2"] for each in sets]),
            np.sqrt(mean["relative"] / mean["bound"]),
            mean["relative"] / mean["stated"],
            np.sqrt(mean["absolute"]),
            mean["known"] / mean["known_stated"],
            mean["finite"],
        )
        print(f"{name:52s}" + "".join(f"{value:11.3f}" for value in figures), flush=True)


if __name__ == "__main__":
    main()
