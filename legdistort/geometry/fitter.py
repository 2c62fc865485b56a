"""A fitter for astropy's `~astropy.modeling`: Legendre distortions to matched positions, linear, with covariance.

Registered under the entry-point group ``astropy.modeling``, so that it is also found as
``astropy.modeling.fitting.LegendreDistortionFitter``.
"""

from functools import partial
from numbers import Real

import numpy as np
from astropy import units as u
from astropy.modeling import models
from astropy.modeling.core import Model  # astropy.modeling itself is half imported when it looks in here
from astropy.modeling.fitting import Covariance, Fitter, StandardDeviations

from ..exceptions import InputError, SolveError
from .models import leaves, nodes, to_pixels

#: Residuals [pix] up to this come from rounding.
_EXACT = 1e-9
#: Fits of a robust start, and at most so many until the positions used stay the same.
_ROUNDS = 10
#: Singular values below this fraction of the largest one count as zero.
_RANK = 1e-11


class LegendreDistortionFitter(Fitter):
    """Weighted linear least squares for a map of the plane with free Legendre coefficients.

    The model maps (x, y) to (x', y') and is linear in the free coefficients of its `Legendre2D` parts:
    ``Identity(2) + (Mapping((0, 1, 0, 1)) | Legendre2D & Legendre2D)``, the same with a pose in front, with a static
    part added, or a plain pair. Only these coefficients are fitted, all others parameters stay. Coefficients marked
    as ``fixed`` keep their values; ``tied`` and ``bounds`` are refused.

    Parameters
    ----------
    calc_uncertainties : bool
        Attach ``cov_matrix`` and ``stds`` to the fitted model, as astropy's fitters do.

    Attributes
    ----------
    fit_info : dict
        Of the last fit: ``param_names`` (fitted, in the order of the covariances), ``cov_x`` (at the weights given),
        ``param_cov`` (the same; without weights times chi2/dof, as astropy does), ``chi2``, ``dof``, ``rank``,
        ``condition`` (of the design with columns of unit length), ``residuals`` (2, n) [pix], data minus model,
        ``used`` (n,), whether a position took part.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.modeling.models import Identity, Legendre2D, Mapping
    >>> part = Legendre2D(1, 1, x_domain=(-0.5, 99.5), y_domain=(-0.5, 99.5), fixed={"c1_1": True})
    >>> model = Identity(2) + (Mapping((0, 1, 0, 1)) | part & part.copy())
    >>> x, y = np.array([[0.0, 99.0, 0.0, 99.0, 50.0], [0.0, 0.0, 99.0, 99.0, 50.0]])
    >>> fit = LegendreDistortionFitter()
    >>> fitted = fit(model, x, y, x + 0.5, y + 0.01 * x, weights=np.full(5, 1 / 0.02))
    >>> print(f"{fitted.c0_0_2.value:.3f} {fitted.c1_0_3.value:.3f} {fit.fit_info['dof']}")
    0.500 0.500 4
    """

    supported_constraints = ["fixed"]  # noqa: RUF012  (astropy's own declaration)

    def __init__(self, calc_uncertainties=False):
        self.fit_info = {}
        self._calc_uncertainties = calc_uncertainties

    def __call__(self, model, x, y, x_data, y_data, *, weights=None, clip=None, inplace=False):
        """Fit a map of the plane to matched positions.

        Parameters
        ----------
        model : `~astropy.modeling.Model`
            Two inputs, two outputs.
        x, y : array_like or Quantity
            Positions that the model is applied to; plain numbers are pixels.
        x_data, y_data : array_like or Quantity
            Measured positions, same shape. Masked ones are left out.
        weights : array_like or Quantity, or pair of them, optional
            1/sigma, as everywhere in astropy (*not* 1/sigma^2), [1/pix]; a pair gives x and y their own. Zero leaves
            a position out. None gives all the same weight.
        clip : float, optional
            Leave out positions that deviate by more standard errors, at the observed scale (from the median) where that
            is larger than the weights imply, from a fit of the others. ``fit_info["used"]`` marks those that are left.
            (`~astropy.modeling.fitting.FittingWithOutlierRemoval` fits one output alone, and a map of the plane has
            two: it cannot take its place.)
        inplace : bool
            Change the model itself instead of a copy.

        Returns
        -------
        `~astropy.modeling.Model`
            Fitted copy. An inverse that the model carried belonged to other coefficients and is taken off.

        Raises
        ------
        InputError
            For arrays of different shapes, values that are not finite, constraints other than ``fixed``, a model
            without free Legendre coefficients or not linear in them.
        SolveError
            Naming the coefficients that the positions do not determine.
        """
        if clip is not None and not (isinstance(clip, Real) and clip > 1):
            raise InputError(f"clip must be a number of standard errors above 1, got {clip!r}; None keeps all")
        free = free_coefficients(model)
        x, y, data, weight = _check_arrays(x, y, (x_data, y_data), weights)
        constant, columns = linear_parts(model, x, y, free)
        values, cov_x, condition, residuals, weight = _fitted(data - constant, columns, weight, free)
        if clip is not None:
            least = _EXACT if weights is None else 1.0
            again = partial(_fitted, data - constant, columns, free=free)
            values, cov_x, condition, residuals, weight = _clipped(again, weight, residuals, clip * least, clip)
        chi2 = float(((residuals * weight) ** 2).sum())
        dof = int(np.count_nonzero(weight)) - len(free)
        param_cov = cov_x if weights is not None else cov_x * (chi2 / dof if dof > 0 else np.nan)
        self.fit_info = {
            "param_names": free,
            "cov_x": cov_x,
            "param_cov": param_cov,
            "chi2": chi2,
            "dof": dof,
            "rank": len(free),
            "condition": condition,
            "residuals": residuals,
            "used": (weight > 0).any(axis=0),
        }
        fitted = model if inplace else model.copy()
        _drop_inverses(fitted)
        set_values(fitted, free, values)
        if self._calc_uncertainties:
            # astropy hands one variance to every parameter not marked as fixed, also to those that are not fitted here
            names = [name for name in fitted.param_names if not fitted.fixed[name]]
            where = np.ix_(*2 * [[names.index(name) for name in free]])
            covariance = np.zeros((len(names), len(names)))
            covariance[where] = param_cov
            fitted.cov_matrix, fitted.stds = Covariance(covariance, names), StandardDeviations(param_cov, free)
        return fitted


def _fitted(data, columns, weight, free):
    """Values, their covariance, condition, residuals (2, n) and weights (2, n) of a linear problem."""
    design = (columns * weight).reshape(len(free), weight.size).T
    values, cov_x, condition = _least_squares(design, (data * weight).ravel(), free, weight.shape[1])
    return values, cov_x, condition, data - np.tensordot(values, columns, 1), weight


def _clipped(fit, weight, residuals, least, clip):
    """The fit without the positions that deviate from it, after a start that gross errors hardly move (Cauchy weights).

    `fit` takes weights and gives what `_fitted` does; the limit is `clip` times the observed scale, or `least`.
    """
    for _ in range(_ROUNDS):
        radius = np.hypot(*(residuals * weight))
        scale = max(_typical(radius), _EXACT)
        residuals = fit(weight=weight / np.sqrt(1 + (radius / (2 * scale)) ** 2))[3]
    used = None
    for _ in range(_ROUNDS):
        radius = np.hypot(*(residuals * weight))
        kept = radius <= max(least, clip * _typical(radius))
        if used is not None and np.array_equal(kept, used):
            break
        used = kept
        found = fit(weight=np.where(used, weight, 0.0))
        residuals = found[3]
    return found


def _typical(radius):
    """Standard deviation per axis by the median of residuals in two axes; those of no weight do not count."""
    return np.median(radius[radius > 0]) / np.sqrt(2 * np.log(2)) if radius.any() else 0.0


def legendre_coefficients(model):
    """``{name in the model: (i, j)}`` of the coefficients of all its `Legendre2D` parts, c{i}_{j} each."""
    names, out = iter(model.param_names), {}
    for part in leaves(model):
        for own, name in zip(part.param_names, names, strict=False):
            if isinstance(part, models.Legendre2D):
                out[name] = tuple(int(order) for order in own[1:].split("_"))
    return out


def free_coefficients(model):
    """Names of the Legendre coefficients of a model that a fit may change.

    Raises
    ------
    InputError
        If it is no map of the plane, has no Legendre coefficients, or some are tied or bounded.
    """
    if not isinstance(model, Model) or (model.n_inputs, model.n_outputs) != (2, 2) or len(model) != 1:
        raise InputError(f"model must be one astropy model with two inputs and two outputs, got {model!r}")
    names = legendre_coefficients(model)
    if not names:
        raise InputError(f"the model has no Legendre2D part whose coefficients could be fitted: {leaves(model)}")
    for name in names:
        if model.tied[name] or any(limit is not None for limit in model.bounds[name]):
            raise InputError(f"coefficient {name} is tied or bounded: a linear fit knows free and fixed ones only")
    return [name for name in names if not model.fixed[name]]


def set_values(model, names, values):
    """Set parameters of a model by name."""
    for name, value in zip(names, values, strict=True):
        setattr(model, name, value)


def linear_parts(model, x, y, free):
    """A model as constant part and derivatives with respect to its free coefficients.

    Validity boxes of its parts are lifted: what is fitted is the polynomial.

    Returns
    -------
    constant : ndarray, shape (2, n)
        Value where all free coefficients are zero.
    columns : ndarray, shape (n_free, 2, n)

    Raises
    ------
    InputError
        If the model is not linear in these coefficients.
    """
    work = model.copy()
    for part in leaves(work):
        if hasattr(part, "valid"):
            part.valid = None
    set_values(work, free, np.zeros(len(free)))
    constant = np.array(work(x, y))
    columns = np.empty((len(free), *constant.shape))
    for column, name in zip(columns, free, strict=True):
        setattr(work, name, 1.0)
        np.subtract(work(x, y), constant, out=column)
        setattr(work, name, 0.0)
    trial = 1 + np.arange(len(free)) % 3
    set_values(work, free, trial)
    value = np.array(work(x, y))
    off = np.abs(value - constant - np.tensordot(trial, columns, 1)).max(initial=0)
    if not off <= 1e-8 * (1 + np.abs(value).max(initial=0)):
        raise InputError(
            f"the model is not linear in its free Legendre coefficients (off by {off:.2g}): nothing but a linear map "
            "may follow them, and no coefficient may stand in two places"
        )
    return constant, columns


def _check_arrays(x, y, data, weights):
    """Positions and data as flat float arrays in pixels, weights (2, n); zero where data are masked."""
    masked = np.stack([np.ma.getmaskarray(values).ravel() for values in data])
    arrays = [to_pixels(np.ma.getdata(values)) for values in (x, y, *data)]
    shapes = [array.shape for array in arrays]
    if len(set(shapes)) > 1 or not arrays[0].size:
        raise InputError(f"x, y, x_data and y_data must have the same shape and not be empty, got {shapes}")
    x, y, data = arrays[0].ravel(), arrays[1].ravel(), np.stack([array.ravel() for array in arrays[2:]])
    pair = weights if isinstance(weights, tuple | list) and len(weights) == 2 and np.ndim(weights[0]) else [weights] * 2
    pair = [1.0 if w is None else w.to_value(1 / u.pix) if isinstance(w, u.Quantity) else w for w in pair]
    try:
        weight = np.stack([np.broadcast_to(np.asarray(w, dtype=float), shapes[0]).ravel() for w in pair])
    except ValueError:
        raise InputError(
            f"weights must be a number, of shape {shapes[0]} as the positions, or a pair of these for x and y"
        ) from None
    if not np.all(weight >= 0) or np.any(np.isinf(weight)):
        raise InputError("weights must be finite and not negative: 1/sigma, zero leaves a position out")
    weight = np.where(masked, 0, weight)
    data = np.where(weight > 0, data, 0)
    bad = ~(np.isfinite(x) & np.isfinite(y) & np.isfinite(data).all(axis=0))
    if bad.any():
        raise InputError(
            f"{np.count_nonzero(bad)} of {bad.size} positions are not finite, the first is number "
            f"{int(np.argmax(bad))}: leave them out, or mask the data"
        )
    return x, y, data, weight


def _least_squares(design, target, free, n):
    """Solution, covariance at unit errors and condition number of a linear problem (rows, coefficients)."""
    if not free:
        return np.zeros(0), np.zeros((0, 0)), 1.0
    scale = np.sqrt((design**2).sum(axis=0))
    left, singular, right = np.linalg.svd(design / np.where(scale > 0, scale, 1), full_matrices=False)
    lost = np.full(len(free), len(design) < len(free)) | (scale == 0)
    null = singular <= _RANK * singular[0]
    if lost.any() or null.any():
        lost |= np.abs(right[null]).max(axis=0, initial=0) > 0.1
        names = [name for name, is_lost in zip(free, lost, strict=True) if is_lost]
        raise SolveError(
            f"{n} positions do not determine {len(free)} coefficients: rank {np.count_nonzero(~null)}, free are "
            f"above all {', '.join(names[:12])}{' ...' * (len(names) > 12)}; fix these, lower the degree or add stars"
        )
    inverse = right.T / singular / scale[:, None]
    return inverse @ (left.T @ target), inverse @ inverse.T, float(singular[0] / singular[-1])


def _drop_inverses(model):
    for node in nodes(model):
        if node.has_user_inverse:
            node.inverse = None
