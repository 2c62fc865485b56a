"""A caller's astropy model as the form of every exposure's distortion: which coefficients are free, what the rest is.

The solver represents a distortion by normalised Legendre modes of the detector. A form with other domains, fixed
coefficients or a static part of its own is expanded in these modes once, exactly, and filled with the fitted
coefficients afterwards. Coefficients that are fixed become modes whose prior has no width.
"""

from dataclasses import dataclass

import numpy as np
from astropy.modeling import CompoundModel, Model, models

from ..exceptions import FoldError, InputError
from ..geometry import basis, fitter, similarity
from ..geometry.distortion import Distortion
from ..geometry.models import FastLegendre2D, leaves, rebuilt, with_table
from ..priors.prior import Prior
from ..runtime.words import UNSTATED

#: A form must be a polynomial to this, pixels.
_EXACT = 1e-8
#: What is smaller than this part of the largest value is rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Expansion:
    """A form on one detector.

    Attributes
    ----------
    model : `~astropy.modeling.Model`
        Undistorted -> detector pixels, with the domain of this detector where none was given.
    names : list of str
        Its free coefficients, k of them.
    start : ndarray, shape (k,)
        Their values in the caller's model.
    mean : ndarray, shape (2, n_all)
        The caller's model as modes, fixed terms included.
    free : ndarray of bool, shape (2, n_modes)
        Modes that the free coefficients move.
    matrix : ndarray, shape (k, k)
        Change of these modes (flat, x first) with each free coefficient, one row a coefficient.
    """

    model: Model
    names: list
    start: np.ndarray
    mean: np.ndarray
    free: np.ndarray
    matrix: np.ndarray


class Form:
    """What `solve` may vary in every exposure.

    Parameters
    ----------
    model : `~astropy.modeling.Model`
        As for `legdistort.solve`.
    shapes : dict
        ``{exposure: (ny, nx)}``.

    Attributes
    ----------
    degree : int
        Highest total degree of a free coefficient.

    Raises
    ------
    InputError
        Saying what in the model cannot be the form of a distortion.
    """

    def __init__(self, model, shapes):
        fitter.free_coefficients(model)  # refuses what is no map of the plane, ties and bounds
        own = _without_pose(model)
        self._shapes = {name: tuple(shape) for name, shape in shapes.items()}
        self._expansions = {shape: _expand(own, shape) for shape in set(self._shapes.values())}
        first = next(iter(self._expansions.values()))
        self.degree = basis.degree_of(first.free.shape[1])
        self.n_free = len(first.names)

    def __repr__(self):
        return f"<Form: degree {self.degree}, {self.n_free} free coefficients>"

    def describe(self):
        """The form in plain numbers and strings, as files of solutions keep it."""
        model = next(iter(self._expansions.values())).model
        fixed = {
            name: float(getattr(model, name).value) for name in fitter.legendre_coefficients(model) if model.fixed[name]
        }
        return {"parts": [type(part).__name__ for part in leaves(model)], "fixed": fixed, "n_free": self.n_free}

    def prior(self):
        """The form as priors, ``{exposure: Prior}``: no width for what is fixed, an infinite one for the rest."""
        made = {}
        for shape, expansion in self._expansions.items():
            mean = expansion.mean
            sigma = np.full(mean.shape, np.inf)
            sigma[:, : expansion.free.shape[1]][~expansion.free] = 0
            sigma[:, 0] = np.inf  # a constant is a shift, which the pose carries
            # coefficients that are all zero state no static distortion
            made[shape] = Prior(mean, sigma=sigma, shape=shape, source=None if mean.any() else UNSTATED)
        return {name: made[shape] for name, shape in self._shapes.items()}

    def hold(self, names, coefficients):
        """Coefficients (n_exposures, 2, n_all) with the rounding of modes that are fixed taken out."""
        out = np.array(coefficients)
        for a, name in zip(out, names, strict=True):
            expansion = self._expansions[self._shapes[name]]
            n = expansion.free.shape[1]
            a[:, : expansion.mean.shape[1]][:, :n][~expansion.free] = expansion.mean[:, :n][~expansion.free]
        return out

    def fill(self, distortion):
        """The caller's model with the coefficients of a `Distortion` on one of its detectors, and its valid box."""
        expansion = self._expansions[tuple(distortion.shape)]
        n = expansion.free.shape[1]
        departure = (distortion.coefficients[:, :n] - expansion.mean[:, :n])[expansion.free]
        out = expansion.model.copy()
        fitter.set_values(out, expansion.names, expansion.start + np.linalg.solve(expansion.matrix.T, departure))
        for part in leaves(out):
            if isinstance(part, FastLegendre2D):
                part.valid = distortion.inverse.valid
        return with_table(out, distortion.table)


def read(model, matches, *, degree):
    """The `Form` that `solve` was given, once its other arguments are seen to go with it.

    Raises
    ------
    InputError
        For a model that cannot be the form of a distortion, or arguments that contradict it.
    """
    form = Form(model, matches.shapes)
    if degree not in (None, form.degree):  # None where the caller gave none
        raise InputError(
            f"the model has free coefficients up to total degree {form.degree}: leave degree={degree!r} out"
        )
    return form


def _without_pose(model):
    """The model behind a leading similarity: every exposure has a pose of its own."""
    if (
        not isinstance(model, CompoundModel)
        or model.op != "|"
        or any(isinstance(part, models.Legendre2D) for part in leaves(model.left))
    ):
        return model
    if (model.left.n_inputs, model.left.n_outputs) != (2, 2):
        return model
    points = np.array([[0.0, 0.0], [1e3, 0.0], [0.0, 1e3], [700.0, 300.0]])
    image = np.column_stack(model.left(*points.T))
    pose = similarity.fit_similarity(points, image)
    if not np.abs(similarity.apply(pose, points) - image).max() < _EXACT:
        raise InputError(
            "what stands before the Legendre parts of the model must be a similarity (it is replaced by the pose of "
            f"each exposure), not {model.left!r}; put a static distortion into the sum"
        )
    return model.right


def _expand(model, shape):
    """The `Expansion` of a caller's model on a detector."""
    own = _rebuilt(model, shape)
    names = fitter.free_coefficients(own)
    start = np.array([getattr(own, name).value for name in names], dtype=float)

    def parts(u, v):
        q = basis.denormalize(u, v, shape).T
        constant, columns = fitter.linear_parts(own, *q, names)
        return np.concatenate([[constant + np.tensordot(start, columns, 1) - q], columns])

    top = basis.MAX_DEGREE
    modes = basis.project(parts, top, top + 2)
    check = np.random.default_rng(20170101).uniform(-1, 1, (2, 200))
    values = parts(*check)
    off = np.abs(values - modes @ basis.values(top, *check)) / (1 + np.abs(values).max(axis=(1, 2), keepdims=True))
    if not off.max() < _EXACT:
        raise InputError(
            f"the model is no polynomial of degree {top} or less on a detector of shape {shape} (off by "
            f"{off.max():.1g}): expand its static part with Prior.from_model and add that"
        )
    moved = np.abs(modes[1:]) > _ROUNDING * np.abs(modes[1:]).max(axis=(1, 2), keepdims=True, initial=1e-300)
    free = moved.any(axis=0)
    degree = _highest(free)
    free = free[:, : basis.n_modes(degree)]
    _check_free(free, len(names), degree)
    mean = np.where(np.abs(modes[0]) > _ROUNDING * (1 + np.abs(modes[0]).max()) * 0.1, modes[0], 0)
    mean = mean[:, : basis.n_modes(max(degree, _highest(mean != 0)))]
    try:
        Distortion(mean, shape, "the model").check_fold()
    except FoldError as error:
        raise InputError(
            f"the model with the coefficients it has cannot be where the solution starts: {error}"
        ) from None
    return Expansion(own, names, start, mean, free, modes[1:, :, : free.shape[1]][:, free])


def _highest(present):
    """Highest total degree of modes (2, n) that are present; 0 if none is."""
    order = sum(basis.orders(basis.MAX_DEGREE))
    return int(order[: present.shape[1]][present.any(axis=0)].max(initial=0))


def _check_free(free, count, degree):
    if np.count_nonzero(free) != count:
        raise InputError(
            f"the {count} free coefficients of the model move {np.count_nonzero(free)} modes of the detector, which "
            "cannot be distinguished: with a domain other than the detector's (-0.5, nx - 0.5), (-0.5, ny - 0.5) every "
            "term of lower order than a free one must be free as well, and each term may stand but once"
        )
    linear = free[:, 1:3]
    if degree and linear.any() and not linear.all():
        raise InputError(
            "of the four linear coefficients (c1_0, c0_1 in x and y) some are fixed and some free: fix all or none, "
            "since rotation and scale are carried by the poses"
        )


def _rebuilt(model, shape):
    """A copy made of `FastLegendre2D`, without inverses; series without a domain get that of the detector."""
    if isinstance(model, CompoundModel):
        right = _rebuilt(model.right, shape) if isinstance(model.right, Model) else model.right
        return CompoundModel(model.op, _rebuilt(model.left, shape), right, name=model.name)
    if not isinstance(model, models.Legendre2D):
        return model.copy()
    whole = {f"{axis}_domain": (-0.5, float(n) - 0.5) for axis, n in zip("xy", shape[::-1], strict=True)}
    missing = {name: domain for name, domain in whole.items() if getattr(model, name) is None}
    if missing and np.any(model.parameters):
        name, domain = next(iter(missing.items()))
        raise InputError(
            f"a Legendre2D of the model has coefficients but no {name}: state which pixels they are meant for, as "
            f"{name}={domain} for the whole detector"
        )
    return rebuilt(FastLegendre2D, model, **missing)
