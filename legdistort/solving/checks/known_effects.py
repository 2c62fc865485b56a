"""Patterns of residuals that have a name: what astronomers know that displaces stars, as columns that may explain them.

Every entry of `EFFECTS` is one: its columns, the sentence, and the cure. Which of them are there is asked where a check
does not pass, and answered as everywhere: by the part of chi2 that falls into the columns once all that is fitted is
fitted again (`Residuals.of_columns`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ...geometry import basis
from ...results.check import CERTAIN
from ..terms.displacements import pixel_waves
from .residual_tests import in_cells, part_of_chi2

#: Effects that are named at most, and part of what chi2 is too large by that one must explain.
MOST_NAMED, SHARE = 3, 0.15
#: Columns of one effect at most, and their values: exposures are taken together, or not all of them, to keep to that.
_COLUMNS, _VALUES = 240, 30_000_000
_MOVING = 1000  # columns of motions
_EDGES = 32  # parts of the detector at whose edges a step is looked for
_BEYOND = 4  # degrees of a pattern beyond that of the fit
_FEWEST_LEFT = 10  # degrees of freedom beside an effect that tell whether it is one


def _by_exposure(observed, n_each):
    """Labels (n,) of the exposures for columns of which every one needs so many: together if they are too many."""
    n, most = observed.problem.n_exposures, min(_COLUMNS, _VALUES // (2 * len(observed.exposure)))
    return observed.exposure * min(n, max(most // n_each, 2)) // n


def _along_a_direction(observed, size):
    """Displacements in proportion to a size (n,), in every exposure along a direction of its own."""
    if size is None:
        return None
    directions = observed.linear[observed.exposure].transpose(2, 1, 0)  # of the plane, on the detector
    return in_cells(_by_exposure(observed, 2), directions * size)


def _by_colour(observed):
    return _along_a_direction(observed, observed.colour)


def _by_brightness(observed):
    return _along_a_direction(observed, observed.faintness)


def _by_pixel_phase(observed):
    return _all_alike(pixel_waves(observed))


def _by_charge_trails(observed):
    """Displacements along an axis that grow with the way to the edge, on one side or both, for fainter stars more."""
    if observed.faintness is None:
        return None
    way = np.concatenate([np.ones_like(observed.place[:1]), observed.place, np.abs(observed.place)])
    faint = np.stack([observed.faintness, observed.faintness**2])
    return _all_alike((faint[:, None] * way)[:, :, None, None] * np.eye(2)[:, :, None])


def _all_alike(displacements):
    """Columns of displacements (..., 2, n) that all observations have."""
    each = displacements.reshape(-1, *displacements.shape[-2:])
    return in_cells(np.zeros(each.shape[-1], dtype=int), each)


def _by_strips(observed):
    """Displacements of every strip of columns, and of every strip of rows."""
    strips = [np.minimum(((v + 1) / 2 * _EDGES).astype(int), _EDGES - 1) for v in observed.place]
    strips = [np.append(each, _EDGES - 1) for each in strips]  # so that none is lacking at the end
    columns = [[c[:-1] for c in in_cells(each, np.eye(2))] for each in strips]
    return [sparse.hstack([x, y], format="csr") for x, y in zip(*columns, strict=True)]


def _edges():
    """Combinations of strips that move all that lies beyond an edge, in x and in y: (2 (n - 1), 4 n, 2)."""
    beyond = np.arange(_EDGES) >= np.arange(1, _EDGES)[:, None]
    return np.einsum("ij,ab,en->iejanb", np.eye(2), np.eye(2), beyond).reshape(2 * (_EDGES - 1), -1, 2)


def _as_series(observed, place, directions):
    """A series beyond the degree of the fit along two directions (2, 2) or (2, 2, n), at places of a turned frame."""
    degree = observed.problem.degree
    modes = basis.values(degree + _BEYOND, *np.clip(place / np.sqrt(2), -1, 1))[basis.n_modes(degree) :]
    along = np.broadcast_to(np.reshape(directions, (2, 2, -1)), (2, 2, modes.shape[1]))
    return _all_alike(modes[:, None, None] * along)


def _on_the_detector(observed):
    if not observed.is_turned or observed.detector is not None:
        return None
    return _as_series(observed, observed.place, np.eye(2))


def _on_the_sky(observed):
    """A pattern that keeps its orientation while the camera turns, in its place about the middle of the field."""
    if not observed.is_turned or observed.detector is not None:
        return None
    linear = observed.linear[observed.exposure]
    place = np.einsum("nba,bn->an", linear, observed.place)  # the inverse of a rotation is its transpose
    return _as_series(observed, place, linear.transpose(2, 1, 0))


def _similarity(place):
    (x, y), one, zero = place, np.ones(place.shape[1]), np.zeros(place.shape[1])
    return np.stack([[one, zero], [zero, one], [x, y], [-y, x]])


def _by_layout(observed):
    return None if observed.detector is None else in_cells(observed.detector, _similarity(observed.place))


def _by_detector_statics(observed):
    """All of the lower degrees but a similarity, for every detector."""
    if observed.detector is None:
        return None
    modes = basis.values(3, *observed.place)[1:]
    return in_cells(observed.detector, (modes[:, None, None] * np.eye(2)[:, :, None]).reshape(-1, 2, modes.shape[1]))


def _by_detector_departures(observed):
    """A similarity of every detector in every exposure."""
    if observed.detector is None:
        return None
    n = observed.detector.max() + 1
    return in_cells(_by_exposure(observed, 4 * n) * n + observed.detector, _similarity(observed.place))


def _by_motions(observed):
    """Motions of single stars, where they are not fitted and few enough to be tried."""
    n, n_stars = len(observed.exposure), observed.problem.n_stars
    if observed.problem.terms.n or 2 * n_stars > _MOVING or 4 * n * n_stars > _VALUES:
        return None
    time = np.asarray(observed.times, dtype=float)[observed.exposure]
    if np.ptp(time) == 0:
        return None
    along = observed.linear[observed.exposure].transpose(2, 1, 0)
    return in_cells(observed.problem.star, along * (time - time.mean()) / time.std())


@dataclass(frozen=True)
class Effect:
    """Something that displaces stars in a way of its own.

    Attributes
    ----------
    name : str
    columns : callable
        ``columns(observed)`` gives those of `Residuals.of_columns`; None where there is nothing to look for.
    found : str
        What it does, as a clause; ``{where}`` is a place on the detector.
    cure : str
    parts : callable, optional
        ``parts()`` gives combinations (n, k, m) of the k columns, of which the best is sought; None: all together.
    """

    name: str
    columns: Callable
    found: str
    cure: str
    parts: Callable | None = None


MOTIONS = Effect("motions", _by_motions,
                 "every star moves by itself",
                 "see time")  # fmt: skip
LAYOUT = Effect("layout", _by_layout,
                "detectors do not lie as their layout has it, in all exposures alike",
                "--layout fit")  # fmt: skip
STATICS = Effect("statics of the detectors", _by_detector_statics,
                 "detectors have distortions of their own, in all exposures alike",
                 "--static fit")  # fmt: skip
DEPARTURES = Effect("departures of the detectors", _by_detector_departures,
                    "detectors move against each other from exposure to exposure",
                    "--dynamic detector")  # fmt: skip
EFFECTS = (
    MOTIONS,
    Effect("refraction by colour", _by_colour,
           "stars are displaced by their colours, in every exposure along a direction of its own, as refraction does",
           "--term refraction (terms=['refraction']) finds and removes it, with tan_z and parallactic_angle; or "
           "observe nearer the zenith or in a narrower band"),
    Effect("refraction by magnitude", _by_brightness,
           "stars are displaced by their magnitudes, in every exposure along a direction of its own, as refraction "
           "does where colours go with magnitudes",
           "correct the positions for differential refraction, or solve stars of like brightness"),
    Effect("pixel phase", _by_pixel_phase,
           "positions depend on the fraction of a pixel on which a star falls (pixel phase)",
           "--term pixel_phase (terms=['pixel_phase']) finds and removes it; or measure with --psf effective"),
    Effect("charge trails", _by_charge_trails,
           "fainter stars are displaced more, the further they are from an edge of the detector (charge trails)",
           "correct the frames for charge transfer, or leave faint stars out"),
    Effect("step", _by_strips,
           "positions step at {where} (stitching of the detector)",
           "give both sides as detectors of a camera, or correct the positions by the step", parts=_edges),
    Effect("pattern of the detector", _on_the_detector,
           "the pattern turns with the camera: it is of the detector",
           "raise --degree, or give a prior of the static distortion"),
    Effect("pattern of the telescope", _on_the_sky,
           "the pattern stays as it is while the camera turns: it is of the telescope, not the detector",
           "raise --degree; a prior of the detector does not describe it"),
    LAYOUT,
    STATICS,
    DEPARTURES,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Found:
    """An effect that is there.

    Attributes
    ----------
    effect : Effect
    rms : float
        Of the displacements that show, pixels per axis.
    words : str
        What it does.
    left : Residuals
        What is left without it, and without those found before.
    """

    effect: Effect
    rms: float
    words: str
    left: object


def fitted_already(errors):
    """Effects of which the solution has unknowns, by its `CameraErrors`: its residuals show something else by them."""
    free = np.zeros(4, dtype=bool) if errors is None else errors.free.any(axis=(0, 1))
    return {LAYOUT: free[:3].any(), STATICS: free[3:].any()}


def effects_in(residuals, observed, errors=None):
    """The effects that residuals show, the one that explains most first, each beside those before it.

    Parameters
    ----------
    residuals : Residuals
    observed : Observed
    errors : CameraErrors, optional
        Of the solution; what it has fitted is not named.

    Returns
    -------
    list of Found
    """
    fitted = fitted_already(errors)
    made = [(effect, effect.columns(observed)) for effect in EFFECTS if not fitted.get(effect)]
    made = [(effect, columns) for effect, columns in made if columns is not None]
    found = []
    while len(found) < MOST_NAMED and made:
        tried = [_tried(residuals, effect, columns) for effect, columns in made]
        best = int(np.argmin([cost for cost, *_ in tried]))
        _, score, which, taken = tried[best]
        effect, columns = made.pop(best)
        too_large = residuals.chi2 - residuals.dof
        if score.p * len(EFFECTS) > CERTAIN or score.t - score.nu < SHARE * too_large:
            break
        residuals = residuals.without([sparse.csr_array(c @ taken) for c in columns])
        words = effect.found.format(where=_edge(observed, which))
        found.append(Found(effect, score.rms, words, residuals))
    return found


def _tried(residuals, effect, columns):
    """How well an effect explains residuals: its cost (Schwarz 1978), its `Score`, which part, and of what columns."""
    g, information, plain = residuals.information(columns)
    parts = np.eye(len(g))[None] if effect.parts is None else effect.parts()
    best = np.inf, residuals.score(0.0, 0.0), 0, parts[0]
    for i, part in enumerate(parts):
        t, _, values = part_of_chi2(*(_combined(part, g, information, plain)))
        if residuals.dof - len(values) < _FEWEST_LEFT:
            continue
        score = residuals.score(t, float(len(values)), tests=len(parts))
        if (cost := residuals.cost(score)) < best[0]:
            best = cost, score, i, part
    return best


def _combined(part, g, information, plain):
    """Gradient and information of combinations of columns, in units of what they would have were nothing fitted."""
    unit = 1 / np.sqrt(np.maximum(np.diag(part.T @ plain @ part), 1e-300))
    return unit * (part.T @ g), unit[:, None] * (part.T @ information @ part) * unit


def _edge(observed, number):
    """The edge of a step in words."""
    axis, edge = divmod(number, _EDGES - 1)
    size = float(np.median(observed.size[axis]))
    return f"{('column', 'row')[axis]} {(edge + 1) / _EDGES * size:.0f}, to {size / _EDGES / 2:.0f} pixels"
