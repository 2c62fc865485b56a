"""What displaces stars and has a name, added to the sets of `dense_model`; numpy alone.

Every one of `DISPLACED` gives displacements (n, 2) of 1 px rms in both axes together at the observations of a set.
"""

import dense_model
import numpy as np

#: How exposures are taken where an effect shows.
TAKEN = {"dither": 400.0, "n_stars": 220}
ROLLED = {"rolls": 30.0, "n_stars": 160}


def _stars(data, rng):
    """A normal number for every observation, by its star."""
    return rng.normal(size=data["star"].max() + 1)[data["star"]]


def _turning(data, size):
    """Along a direction that turns through the night, of so much."""
    angle = np.deg2rad(np.linspace(-60, 60, len(data["poses"])))[data["exposure"]]
    return size[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)


def magnitude(data):
    """Magnitudes of a sky-limited list: errors go as the inverse of the flux."""
    m = 2.5 * np.log10(data["err"][:, 0])
    return (m - m.mean()) / m.std()


def by_colour(data, rng):
    data["colour"] = _stars(data, rng)
    return _turning(data, data["colour"])


def by_magnitude(data, rng):
    return _turning(data, magnitude(data))


def by_pixel_phase(data, rng):
    f = data["xy"] % 1 - 0.5
    return np.sin(2 * np.pi * f) + 0.4 * f


def by_trails(data, rng):
    way = data["xy"][:, 1] / data["n"]
    faint = np.exp(0.5 * magnitude(data))
    return np.stack([np.zeros(len(way)), way * faint], axis=1)


def by_step(data, rng):
    edge, axis = data["n"] * rng.uniform(0.3, 0.7), rng.integers(2)
    return (data["xy"][:, axis] > edge)[:, None] * rng.normal(size=2)


def _waves(place, rng):
    k = rng.normal(scale=3.5, size=(2, 6, 2))
    phase = rng.uniform(0, 2 * np.pi, (2, 6))
    return np.sin(np.einsum("akc,nc->nak", k, place) + phase).sum(axis=2)


def of_the_detector(data, rng):
    return _waves(2 * data["xy"] / data["n"] - 1, rng)


def of_the_telescope(data, rng):
    turn = data["poses"][data["exposure"], :, :2]
    place = np.einsum("nba,nb->na", turn, 2 * data["xy"] / data["n"] - 1)
    return np.einsum("nab,nb->na", turn, _waves(place, rng))


def of_turbulence(data, rng):
    """In every exposure another von Karman screen, the detector one outer scale wide, without what a cubic follows."""
    place, out = 2 * data["xy"] / data["n"] - 1, np.zeros_like(data["xy"])
    for i in range(len(data["poses"])):
        rows = data["exposure"] == i
        angle, size = rng.uniform(0, 2 * np.pi, 400), np.pi * rng.uniform(0.3, 3, 400)
        k = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        a = rng.normal(size=400) * np.sqrt(size) * (size**2 + np.pi**2) ** (-11 / 12)
        field = (a * np.cos(place[rows] @ k.T + rng.uniform(0, 2 * np.pi, 400))) @ k
        cubic = dense_model.basis(data["xy"][rows], 3, data["n"])[0]
        out[rows] = field - cubic @ np.linalg.lstsq(cubic, field, rcond=None)[0]
    return out


#: Name of the effect: how it displaces stars, and how the exposures are taken.
DISPLACED = {
    "refraction by colour": (by_colour, TAKEN),
    "refraction by magnitude": (by_magnitude, TAKEN),
    "pixel phase": (by_pixel_phase, TAKEN),
    "charge trails": (by_trails, ROLLED),
    "step": (by_step, TAKEN | {"n_stars": 450}),
    "pattern of the detector": (of_the_detector, ROLLED),
    "pattern of the telescope": (of_the_telescope, ROLLED | {"dither": 400.0, "n_stars": 700}),
    "turbulence": (of_turbulence, TAKEN),
}

#: Those of sets that take little time.
SMALL = [name for name in DISPLACED if name not in ("refraction by magnitude", "pattern of the telescope")]


def displaced(name, seed, *, size=1.0, errors=(0.02, 0.04), **changed):
    """A set with an effect of so many errors, rms per axis, and the displacements (n, 2) by it."""
    make, taken = DISPLACED[name]
    data = dense_model.drawn_set(seed, **taken | {"errors": errors} | changed)[0]
    shift = make(data, np.random.default_rng(1000 + seed))
    shift = shift - shift.mean(axis=0)
    shift *= size * np.sqrt(np.mean(data["err"] ** 2) / np.mean(shift**2))
    return data | {"xy": data["xy"] + shift}, shift
