"""Moffat profiles fitted to stars by Levenberg-Marquardt, all at once: alone, or some that touch together."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from . import moffat

#: Standard deviation of the weak prior of the shape: log_a, log_b, rho, log_beta.
SHAPE_SIGMA = np.array([0.7, 0.7, 0.5, 0.7])
#: That of a prior that holds the shape.
HELD = np.full(4, 1e-3)

_CHUNK = 36_000  # pixels: their Jacobian stays in the processor's cache
_SMALLEST = 0.3  # smallest full width at half maximum [pix]: anything narrower lies within one pixel
#: Bounds of the shape, and of the background, which has none.
_BOUNDS = (
    np.array([-np.inf, -np.inf, -0.95, moffat.LOG_BETA[0], -np.inf]),
    np.array([2 * np.log(2 / _SMALLEST)] * 2 + [0.95, moffat.LOG_BETA[1], np.inf]),
)


class Limits(NamedTuple):
    """When iterations end: after so many, or when a step would lower chi2 by less than the gain."""

    iterations: int
    gain: float


#: Of a fit that is final.
FULL = Limits(60, 1e-4)


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit: parameters of groups, or after `Fit.by_star` of stars.

    Attributes
    ----------
    params : ndarray, shape (n, 3 g + c)
        ``x``, ``y``, ``peak`` (or flux) of every star of the group, then what all have in common: of Moffat profiles
        the shape and the background (c = 5; with one star, g = 1, the order of
        `legdistort.measurement.profiles.moffat.NAMES`), of an effective PSF the background (c = 1).
    covariance : ndarray, shape (n, 3 g + c, 3 g + c)
    chi2 : ndarray, shape (n,)
        Of the pixels, without the prior.
    dof : ndarray of int, shape (n,)
        Pixels used less parameters left free.
    converged : ndarray of bool, shape (n,)
    """

    params: np.ndarray
    covariance: np.ndarray
    chi2: np.ndarray
    dof: np.ndarray
    converged: np.ndarray

    def __repr__(self):
        return f"<Fit: {len(self.params)} stars, {np.count_nonzero(self.converged)} converged>"

    def by_star(self, common=5):
        """The same with one row a star; the stars of a group follow each other and share chi2."""
        g = (self.params.shape[1] - common) // 3
        own = np.column_stack([np.arange(3 * g).reshape(g, 3), np.tile(np.arange(3 * g, 3 * g + common), (g, 1))])
        covariance = self.covariance[:, own[:, :, None], own[:, None, :]].reshape(-1, 3 + common, 3 + common)
        rest = (np.repeat(a, g) for a in (self.chi2, self.dof, self.converged))
        return Fit(self.params[:, own].reshape(-1, 3 + common), covariance, *rest)

    def updated(self, rows, other):
        """The same with some rows replaced by those of another fit."""
        merged = {name: values.copy() for name, values in vars(self).items()}
        for name, values in merged.items():
            values[rows] = getattr(other, name)
        return Fit(**merged)


def fit(stamps, weights, start, *, nodes, centre, sigma=SHAPE_SIGMA, limits=FULL, offsets=None):
    """Fit profiles by Levenberg-Marquardt, all groups of stars at once, each with its own damping.

    The shape carries a weak Gaussian prior: it decides nothing that the pixels can determine (above a
    signal-to-noise ratio of 10 the errors are those of eight free parameters), and keeps faint stars
    from running away.

    Parameters
    ----------
    stamps : ndarray, shape (n, g * npix)
        Square stamps of the g stars of every group, flattened. Every stamp shows the light of all stars of its group.
    weights : ndarray, shape (n, g * npix)
        Inverse variances; 0 where a pixel is bad, or is there already in the stamp of another star.
    start : ndarray, shape (n, 3 g + 5)
        Start values, see `Fit`. The positions count from the central pixels of the stars' own stamps.
    nodes : tuple
        From `legdistort.measurement.profiles.moffat.quadrature`.
    centre : ndarray, shape (4,) or (n, 4)
        Centre of the prior: log_a, log_b, rho, log_beta.
    sigma : ndarray, shape (4,)
        Its standard deviation; a narrow one holds the shape (`HELD`).
    limits : Limits
        A pass that only prepares the next one can do with less.
    offsets : ndarray of int, shape (n, g, 2), optional
        Central pixels (x, y) of the stamps; needed for g > 1.

    Returns
    -------
    Fit
    """
    n, width = start.shape
    g = (width - 5) // 3
    size = max(1, _CHUNK // (stamps.shape[1] * g))
    centre = np.broadcast_to(centre, (n, 4))
    offsets = np.zeros((n, 1, 2)) if offsets is None else offsets
    mean, precision = np.zeros_like(start), np.zeros(width)
    mean[:, -5:-1], precision[-5:-1] = centre, 1 / np.asarray(sigma) ** 2
    parts = [
        minimise(
            _Pixels(stamps[i:j], weights[i:j], offsets[i:j], nodes),
            start[i:j],
            prior=(mean[i:j], precision),
            bounds=_BOUNDS,
            limits=limits,
        )
        for i, j in ((i, i + size) for i in range(0, max(n, 1), size))
    ]
    held = np.count_nonzero(np.asarray(sigma) <= HELD)
    dof = np.count_nonzero(weights, axis=1) - (width - held)
    params, covariance, chi2, converged = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Fit(params, covariance, chi2, dof, converged)


class _Pixels:
    """What is fitted: pixels of groups, in units of their noise."""

    def __init__(self, stamps, weights, offsets, nodes):
        g = offsets.shape[1]
        # Single precision serves: photons bound the ratio of signal to noise of a pixel. Stars that touch are
        # distinguished by small differences.
        self.kind = np.float32 if g == 1 else np.float64
        self.root = np.sqrt(weights, dtype=self.kind)
        self.target = np.where(weights > 0, stamps, 0).astype(self.kind) * self.root
        self.half = (round(np.sqrt(stamps.shape[1] // g)) - 1) // 2
        self.shift = offsets[:, :, None] - offsets[:, None]  # star i seen from the stamp of star j
        self.dof = np.maximum(np.count_nonzero(weights, axis=1) - 3 * g - 5, 1)
        self.nodes = nodes

    def linearise(self, params, rows):
        """Chi2, negative half gradient and half Hessian of some groups."""
        model, jac = self._evaluate(params.astype(self.kind), rows)
        r = self.target[rows] - (model + params[:, -1:].astype(self.kind)) * self.root[rows]
        jac *= self.root[rows, None, :]
        gradient = (jac @ r[:, :, None])[:, :, 0].astype(float)
        return np.square(r, dtype=float).sum(axis=1), gradient, (jac @ jac.swapaxes(1, 2)).astype(float)

    def _evaluate(self, params, rows):
        n, g = self.shift[rows].shape[:2]
        if g == 1:
            return moffat.evaluate(params, self.half, self.nodes, jacobian=True)
        stars = np.empty((n, g, g, 8))
        stars[..., :3] = params[:, : 3 * g].reshape(n, g, 1, 3)
        stars[..., :2] += self.shift[rows]
        stars[..., 3:] = params[:, None, None, -5:]
        model, jac = moffat.evaluate(stars.reshape(-1, 8), self.half, self.nodes, jacobian=True)
        jac = jac.reshape(n, g, g, 8, self.target.shape[1] // g).swapaxes(2, 3)  # group, star, parameter, stamp, pixel
        whole = np.empty((n, 3 * g + 5, g, jac.shape[-1]))
        whole[:, : 3 * g] = jac[:, :, :3].reshape(n, 3 * g, g, jac.shape[-1])
        whole[:, 3 * g : -1] = jac[:, :, 3:7].sum(axis=1)
        whole[:, -1] = 1
        return model.reshape(n, g, self.target.shape[1]).sum(axis=1), whole.reshape(n, 3 * g + 5, self.target.shape[1])


def minimise(pixels, start, *, prior, bounds, limits):
    """Levenberg-Marquardt iterations of groups of stars, each with its own damping.

    Parameters
    ----------
    pixels : object
        What is fitted: ``linearise(params, rows)`` gives chi2, negative half gradient and half Hessian of some groups;
        ``target`` (n, k) are the pixels in units of their noise, in the precision ``kind`` in which the model is
        computed; ``half`` is half the side of a stamp, ``dof`` (n,) the degrees of freedom.
    start : ndarray, shape (n, 3 g + c)
        As `Fit.params`.
    prior : tuple of ndarray
        Means (n, 3 g + c) and inverse variances (3 g + c,) of the parameters; 0 for none.
    bounds : tuple of ndarray, shape (c,)
        Lowest and highest values of what the stars have in common.
    limits : Limits

    Returns
    -------
    params, covariance, chi2, converged : ndarray
        As the attributes of `Fit`.
    """
    mean, precision = prior
    common = len(bounds[0])

    def linearise(p, rows):
        """As that of the pixels, the prior added; second comes chi2 with it."""
        chi2, gradient, hessian = pixels.linearise(p, rows)
        off = mean[rows] - p
        return chi2, chi2 + (off**2) @ precision, gradient + precision * off, hessian + np.diag(precision)

    params = start.copy()
    chi2, cost, gradient, hessian = linearise(params, np.arange(len(start)))
    damping = np.full(len(start), 1e-2)
    rounding = np.finfo(pixels.kind).eps * np.linalg.norm(pixels.target, axis=1)  # of the residuals
    converged = np.zeros(len(start), dtype=bool)
    for _ in range(limits.iterations):
        active = np.flatnonzero(~converged & (damping < 1e10))
        if len(active) == 0:
            break
        step, gain = _step(params[active], gradient[active], hessian[active], damping[active], bounds)
        trial = params[active] + step
        trial[:, -common:] = np.clip(trial[:, -common:], *bounds)
        legal = (np.abs(trial[:, :-common].reshape(len(trial), -1, 3)[..., :2]) < pixels.half + 1).all(axis=(1, 2))
        rows, trial, gain = active[legal], trial[legal], gain[legal]
        damping[active[~legal]] *= 10
        if len(rows) == 0:
            continue
        new = linearise(trial, rows)
        # A step that would lower chi2 by 1e-4 moves a position by a hundredth of its error, which is larger where the
        # fit is bad. The damping must be small for the foreseen gain to mean that. Such a step is taken, and any that
        # raises chi2 by no more than rounding may: else the last bits of the pixels would decide where a fit ends.
        small = gain < limits.gain * np.maximum(1, chi2[rows] / pixels.dof[rows])
        last = small & (damping[rows] <= 1)
        better = last | (new[1] <= cost[rows] + rounding[rows] * np.sqrt(chi2[rows]))
        good = rows[better]
        params[good] = trial[better]
        for kept, value in zip((chi2, cost, gradient, hessian), new, strict=True):
            kept[good] = value[better]
        converged[rows] = last | (small & ~better)
        damping[good] /= 5
        damping[rows[~better]] *= 8
    return params, _covariance(hessian), chi2, converged


def _step(params, gradient, hessian, damping, bounds):
    """Damped step of every group, and the gain foreseen; what pushes against its bound is held."""
    (low, high), common = bounds, len(bounds[0])
    last, slope = params[:, -common:], gradient[:, -common:]
    held = ((last <= low) & (slope < 0)) | ((last >= high) & (slope > 0))
    if held.any():
        free = np.pad(~held, ((0, 0), (params.shape[1] - common, 0)), constant_values=True)
        gradient, hessian = gradient * free, hessian * free[:, :, None] * free[:, None, :]
    normal, scale = _normal(hessian, damping)
    step = np.linalg.solve(normal, (gradient / scale)[:, :, None])[:, :, 0] / scale
    return step, (gradient * step).sum(axis=1)


def _normal(hessian, damping):
    """Matrices in units of their diagonal: all parameters are alike and are solved for safely."""
    scale = np.sqrt(np.einsum("nii->ni", hessian))
    scale = np.where(scale > 0, scale, 1)
    normal = hessian / (scale[:, :, None] * scale[:, None, :])
    diagonal = np.arange(hessian.shape[1])
    normal[:, diagonal, diagonal] = np.broadcast_to(1 + np.asarray(damping) + 1e-12, len(normal))[:, None]
    return normal, scale


def _covariance(hessian):
    normal, scale = _normal(hessian, 1e-6)  # what a fit does not determine gets an error that is large, not imaginary
    inverse = np.linalg.inv(normal)
    diagonal = np.arange(hessian.shape[1])
    inverse[:, diagonal, diagonal] = np.abs(inverse[:, diagonal, diagonal])  # rounding takes a large one below 0
    return inverse / (scale[:, :, None] * scale[:, None, :])
