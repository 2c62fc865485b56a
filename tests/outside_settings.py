"""Sets outside what a solution assumes: effects, wrong errors, priors, catalogues, geometry. Truth from numpy alone.

Every entry of `settings()` is ``name: make``, and ``make(seed)`` gives what `dense_model.drawn_set` does, with further
columns, the true star positions, and options of `legdistort.solve`: ``prior`` (2, m) with ``static_sigma``,
``reference`` (a table), and others.
"""

from functools import partial

import dense_model
import known_displacements
import made_catalogues
import numpy as np

#: Eleven exposures, 65 stars a frame; the exact static distortion is the prior.
_NONE = {"dither": 0.5, "n_stars": 70}
_ROLLED = {"rolls": 90.0}
#: Numbers of the cubic modes with x and y exchanged.
_EXCHANGED = [dense_model.orders(3).index((j, i)) for i, j in dense_model.orders(3)]


def _drawn(seed, *, prior="exact", **taken):
    data, truth = dense_model.drawn_set(seed, **taken)
    return data, truth, {"prior": truth["static"]} if prior == "exact" else {}


def _rms(values, size):
    return values * size / np.sqrt(np.mean(values**2))


def _once(field, data):
    """The displacements that a field has at the places of all observations: the same in every exposure."""
    alone = data | {"exposure": np.zeros(len(data["star"]), dtype=int), "poses": data["poses"][:1]}
    return field(alone)


def _turbulence(data, rng, *, low):
    """Screens as those of `known_displacements`, with or without what a cubic follows."""
    place, out = 2 * data["xy"] / data["n"] - 1, np.zeros_like(data["xy"])
    for i in range(len(data["poses"])):
        rows, screen = data["exposure"] == i, rng.spawn(1)[0]
        angle, size = screen.uniform(0, 2 * np.pi, 400), np.pi * screen.uniform(0.1, 3, 400)
        k = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        a = screen.normal(size=400) * np.sqrt(size) * (size**2 + np.pi**2 / 9) ** (-11 / 12)
        field = (a * np.cos(place[rows] @ k.T + screen.uniform(0, 2 * np.pi, 400))) @ k
        if not low:
            cubic = dense_model.basis(data["xy"][rows], 3, data["n"])[0]
            field = field - cubic @ np.linalg.lstsq(cubic, field, rcond=None)[0]
        out[rows] = field
    return out


def _bumps(data, rng):
    """Three smooth bumps in every exposure, as the anisoplanatism between guide stars leaves them."""
    out = np.zeros_like(data["xy"])
    for i in range(len(data["poses"])):
        rows, field = data["exposure"] == i, rng.spawn(1)[0]
        for _ in range(3):
            square = np.sum((data["xy"][rows] - field.uniform(0, data["n"], 2)) ** 2, axis=1)
            out[rows] += np.exp(-square / 2 / 250**2)[:, None] * field.normal(size=2)
    return out


def _pixel_phase(data, rng):
    return np.sin(2 * np.pi * data["xy"])


def _colour(data, rng, *, turns):
    data["colour"] = rng.normal(size=data["star"].max() + 1)[data["star"]]
    angle = np.deg2rad(np.linspace(-60, 60, len(data["poses"])))[data["exposure"]] * turns
    return data["colour"][:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)


def _binaries(data, rng):
    n = data["star"].max() + 1
    along = rng.normal(size=(n, 2)) * (rng.random(n) < 0.3)[:, None]
    return along[data["star"]] * rng.normal(size=len(data["star"]))[:, None]


def effect(seed, field, size, taken, *, static=False):
    """Stars displaced by a field of so many pixels rms, in every exposure or the same in all."""
    data, truth, options = _drawn(seed, **taken)
    made = partial(field, rng=np.random.default_rng(1000 + seed))
    data["xy"] = data["xy"] + _rms(_once(made, data) if static else made(data), size)
    return data, truth["stars"], options


def scales(seed, size):
    """Scales of the exposures that differ, about the middle of the detector."""
    data, truth, options = _drawn(seed)
    factor = 1 + size * np.random.default_rng(seed).normal(size=len(data["poses"]))
    middle = (data["n"] - 1) / 2
    data["xy"] = middle + factor[data["exposure"]][:, None] * (data["xy"] - middle)
    return data, truth["stars"], options


def errors(seed, kind):
    """Errors that are not those stated."""
    data, truth, options = _drawn(seed)
    err, rng = data["err"], np.random.default_rng(2000 + seed)
    if kind == "constant":
        data["err"] = np.full_like(err, 0.03)
    elif kind == "bright third":
        data["err"] = np.where(err < np.quantile(err, 1 / 3), err / 2, err)
    elif kind == "Student's t":
        data["xy"] = data["xy"] + err * (rng.standard_t(3, err.shape) - rng.normal(size=err.shape)) / np.sqrt(3)
    else:
        data["err"] = err / kind
    return data, truth["stars"], options


def wrong_rows(seed, kind):
    """Mismatches, blends, pairs, and exposures that are not what they seem."""
    data, truth, options = _drawn(seed)
    rng, n = np.random.default_rng(3000 + seed), len(data["xy"])
    if kind in (0.05, 0.2):
        wrong = rng.random(n) < kind
        data["xy"][wrong] += rng.uniform(-20, 20, (wrong.sum(), 2))
    elif kind == "blends":
        wrong = rng.random(data["star"].max() + 1)[data["star"]] < 0.1
        data["xy"][wrong] += 3 * data["err"][wrong] * np.abs(rng.normal(size=(wrong.sum(), 2)))
    elif kind == "pairs":
        wrong = (rng.random(data["star"].max() + 1)[data["star"]] < 0.05) & (data["exposure"] > 5)
        data["xy"][wrong] += rng.normal(size=2) * 3
    elif kind == "mirrored":
        rows = data["exposure"] == 3
        data["xy"][rows, 0] = data["n"] - 1 - data["xy"][rows, 0]
    elif kind == "another field":
        rows = data["exposure"] == 3
        data["xy"][rows] = rng.uniform(0, data["n"], (rows.sum(), 2))
    else:  # as many exposures twice, measured again with hardly any other noise
        parts, poses = [data], list(data["poses"])
        for i in range(kind):
            rows = data["exposure"] == i
            again = {k: data[k][rows].copy() for k in ("xy", "err", "star", "exposure")}
            again["xy"] += 0.1 * again["err"] * rng.normal(size=again["err"].shape)
            again["exposure"][:] = len(poses)
            poses.append(data["poses"][i])
            parts.append(again)
        data |= {k: np.concatenate([part[k] for part in parts]) for k in ("xy", "err", "star", "exposure")}
        data["poses"] = np.array(poses)
    return data, truth["stars"], options


def poses(seed, kind):
    """Nominal poses that are off."""
    data, truth, options = _drawn(seed)
    rng, middle = np.random.default_rng(seed), (data["n"] - 1) / 2
    for i, pose in enumerate(data["poses"][1:], start=1):
        turn, shift = np.eye(2), np.zeros(2)
        if kind == "shift":
            shift = 30 * rng.normal(size=2)
        elif kind == "turn":
            angle = np.deg2rad(0.5 * rng.normal())
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        else:
            turn = (1 + 0.01 * rng.normal()) * turn
        at = turn @ (pose[:, 2] - middle) + middle + shift
        data["poses"][i] = np.column_stack([turn @ pose[:, :2], at])
    return data, truth["stars"], options


PRIORS = {
    "wrong sign": lambda static, rng: -static,
    "x and y exchanged": lambda static, rng: static[::-1, _EXCHANGED],
    "turned by 90 degrees": lambda static, rng: (-1.0) ** np.array(dense_model.orders(3))[:, 0]
    * np.array([[-1], [1]]) * static[::-1, _EXCHANGED],
    "of another detector": lambda static, rng: rng.normal(size=static.shape) * np.sqrt(np.mean(static**2)),
    "times 0.8": lambda static, rng: 0.8 * static,
}  # fmt: skip


def prior(seed, kind, taken, sigma=None):
    """A static distortion that is not that of the exposures, exact or with an uncertainty."""
    data, truth, _ = _drawn(seed, **taken)
    given = PRIORS[kind](truth["static"], np.random.default_rng(10_000 + seed))
    return data, truth["stars"], {"prior": given, "static_sigma": sigma}


def reference(seed, fault, n, with_prior):
    """A catalogue, right or not."""
    data, truth, options = _drawn(seed, prior="exact" if with_prior else None)
    table = made_catalogues.catalogue(truth["stars"], seed, fault, n=n)
    return data, truth["stars"], options | {"reference": table, "epoch": made_catalogues.EPOCH}


def regime(seed, taken, *, with_prior=True, **options):
    """Sets of another size or geometry."""
    data, truth, known = _drawn(seed, prior="exact" if with_prior else None, **taken)
    return data, truth["stars"], known | options


def noisier(seed, factor, n):
    """Some of the exposures so many times noisier, as stated."""
    data, truth, options = _drawn(seed)
    rng, rows = np.random.default_rng(seed), data["exposure"] >= 11 - n
    data["xy"][rows] += np.sqrt(factor**2 - 1) * data["err"][rows] * rng.normal(size=(rows.sum(), 2))
    data["err"] = np.where(rows[:, None], factor * data["err"], data["err"])
    return data, truth["stars"], options


def one_side(seed):
    """Stars on one side of the field alone."""
    data, truth, options = _drawn(seed, n_stars=200)
    keep = (truth["stars"][:, 0] < 900)[data["star"]]
    return _kept(data, keep), truth["stars"], options


def moving(seed, epochs, *, n_each=4, orbits=None, seen=None, motion="proper"):
    """Motions of 0.1 px a year; a few stars on orbits; some seen at few epochs."""
    data, truth, options = _drawn(seed, n=epochs * n_each)
    rng, n = np.random.default_rng(4000 + seed), data["star"].max() + 1
    data["epoch"] = 2020.0 + (data["exposure"] // n_each) * 1.0 + 0.001 * data["exposure"]
    t = data["epoch"] - data["epoch"].mean()
    off = t[:, None] * 0.1 * rng.normal(size=(n, 2))[data["star"]]
    if orbits is not None:
        share, size = orbits
        phase = 2 * np.pi * (t[:, None] / 16 + rng.random((n, 2))[data["star"]])
        off = off + size * np.sin(phase) * (rng.random(n) < share)[data["star"]][:, None]
    data["xy"] = data["xy"] + np.einsum("nab,nb->na", data["poses"][data["exposure"], :, :2], off)
    if seen is not None:
        few = rng.random(n) < 0.3
        data = _kept(data, ~few[data["star"]] | (data["exposure"] % n_each < 1) & (data["exposure"] < seen * n_each))
    return data, truth["stars"], options | {"motion": motion, "motion_epoch": float(2020 + (epochs - 1) / 2)}


def _kept(data, keep):
    return data | {k: v[keep] for k, v in data.items() if k not in ("poses", "n", "degree")}


def settings():
    """``{name: make}`` of all."""
    out = {}
    for size in (0.1, 0.5, 2.0):
        for low in (True, False):
            field, words = partial(_turbulence, low=low), "" if low else " beyond a cubic"
            out[f"turbulence of {size} px{words}"] = partial(effect, field=field, size=size, taken={})
            out[f"turbulence of {size} px{words}, the same in all, no dithers"] = partial(
                effect, field=field, size=size, taken=_NONE, static=True
            )
    out["bumps of 0.1 px"] = partial(effect, field=_bumps, size=0.1, taken={})
    out["bumps of 0.1 px, the same in all, no dithers"] = partial(
        effect, field=_bumps, size=0.1, taken=_NONE, static=True
    )
    for words, taken in (("", {}), (", rolls", _ROLLED), (", no dithers", _NONE)):
        out[f"step of 0.05 px{words}"] = partial(effect, field=known_displacements.by_step, size=0.05, taken=taken)
        out[f"pixel phase of 0.03 px{words}"] = partial(effect, field=_pixel_phase, size=0.03, taken=taken)
        for size in (0.01, 0.05):
            out[f"charge trails of {size} px{words}"] = partial(
                effect, field=known_displacements.by_trails, size=size, taken=taken
            )
    for size in (0.05, 0.3):
        for turns, way in ((1, "that turns"), (0, "in one direction")):
            for words, taken in (("", {}), (", no dithers", _NONE)):
                out[f"refraction of {size} px {way}{words}"] = partial(
                    effect, field=partial(_colour, turns=turns), size=size, taken=taken
                )
    out["variable binaries of 0.05 px, 30 %"] = partial(effect, field=_binaries, size=0.05, taken={})
    out |= {f"scales of {size:g}": partial(scales, size=size) for size in (1e-4, 0.01)}
    for kind, words in ((2, "2 times too small"), (1.35, "1.35 times too small"), (0.5, "2 times too large"),
                        ("bright third", "of the bright third 2 times too small"), ("constant", "constant"),
                        ("Student's t", "of Student's t")):  # fmt: skip
        out[f"errors {words}"] = partial(errors, kind=kind)
    for kind, words in ((0.05, "5 % mismatches"), (0.2, "20 % mismatches"), ("blends", "10 % blends of 3 sigma"),
                        ("pairs", "pairs mixed in five exposures"), (1, "an exposure twice"), (5, "five twice"),
                        ("mirrored", "an exposure mirrored"), ("another field", "an exposure of another field"),
                        ):  # fmt: skip
        out[words] = partial(wrong_rows, kind=kind)
    for kind, words in (("shift", "30 px"), ("turn", "0.5 degrees"), ("scale", "1 %")):
        out[f"poses off by {words}"] = partial(poses, kind=kind)
    taken = {"dithers of 150 px": {}, "dithers of 400 px": {"dither": 400.0}, "no dithers": _NONE, "rolls": _ROLLED}
    for kind in PRIORS:
        for words, how in taken.items():
            out[f"prior {kind}, {words}"] = partial(prior, kind=kind, taken=how)
        for sigma in (0.05, 0.2):
            out[f"prior {kind}, stated to {sigma} px"] = partial(prior, kind=kind, taken={}, sigma=sigma)
    for n in (40, 12):
        for with_prior in (True, False):
            for fault in (None, *made_catalogues.FAULTS):
                words = f"catalogue of {n} stars, {fault or 'right'}, {'with' if with_prior else 'without'} prior"
                out[words] = partial(reference, fault=fault, n=n, with_prior=with_prior)
    regimes = {
        "nothing wrong": {},
        "two exposures": {"n": 2},
        "eight stars": {"n_stars": 14},
        "six stars a frame": {"n_stars": 11},
        "200 exposures of 20 stars": {"n": 200, "n_stars": 36},
        "rolls only": _NONE | {"rolls": 30.0},
    }
    out |= {words: partial(regime, taken=how) for words, how in regimes.items()}
    for with_prior in (True, False):
        words = "with prior" if with_prior else "without prior"
        out |= {f"static of {size} px a mode, {words}": partial(regime, taken={"static": size}, with_prior=with_prior)
                for size in (3.0, 12.0, 30.0)}  # fmt: skip
    out |= {f"departures of {size} px a mode": partial(regime, taken={"dynamic": size}) for size in (1.0, 3.0, 10.0)}
    out["stars on one side"] = one_side
    out |= {f"{n} of 11 exposures {factor} times noisier": partial(noisier, factor=factor, n=n)
            for factor, n in ((10, 8), (100, 8), (100, 1))}  # fmt: skip
    out |= {f"motions, {n} epochs": partial(moving, epochs=n) for n in (2, 3, 4)}
    out["motions, stars seen two or three times"] = partial(moving, epochs=4, seen=3)
    out["motions not fitted"] = partial(moving, epochs=4, motion=None)
    out["motions, 5 % on orbits of 3 px"] = partial(moving, epochs=8, n_each=2, orbits=(0.05, 3.0))
    out["motions, 30 % on orbits of 0.1 px"] = partial(moving, epochs=8, n_each=2, orbits=(0.3, 0.1))
    return out
