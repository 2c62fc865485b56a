"""Elliptical Moffat profiles, fitted to all stars of a frame at once.

The profile of the paper (its section on position measurements),
``I0 [1 + (X/dx)^2 + (Y/dy)^2]^-beta + background``, has eight parameters a star. Two changes keep
the fit well conditioned without changing the family:

* ``dx, dy, theta`` become the quadratic form ``h = a u^2 + b v^2 + 2 rho sqrt(ab) u v`` (u, v: offsets from the
  centre; log a, log b and rho are fitted): theta has no meaning at dx = dy, where the fit would stall;
* the form is 1 at half maximum, ``I0 [1 + (2^(1/beta) - 1) h]^-beta``, so that width and beta are nearly independent.

Parameters are rows (n, 8) in the order of `NAMES`; stamps are square, positions count from their central pixel.
"""

from dataclasses import dataclass

import numpy as np

NAMES = ("x", "y", "peak", "log_a", "log_b", "rho", "log_beta", "background")
#: Bounds of log(beta). Beyond 20 a Moffat profile is a Gaussian; at 1 its flux is infinite.
LOG_BETA = (np.log(1.1), np.log(20.0))
#: Standard deviation of the weak prior of the shape: log_a, log_b, rho, log_beta.
SHAPE_SIGMA = np.array([0.7, 0.7, 0.5, 0.7])

#: As `quadrature`, but the centre of the pixel alone.
CENTRES = np.zeros(1), np.ones(1)

_CHUNK = 200  # stars: their Jacobian stays in the processor's cache
_SMALLEST = 0.2  # smallest full width at half maximum [pix]: anything narrower lies within one pixel


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of `fit`.

    Attributes
    ----------
    params : ndarray, shape (n, 8)
    covariance : ndarray, shape (n, 8, 8)
    chi2 : ndarray, shape (n,)
        Of the pixels, without the prior.
    converged : ndarray of bool, shape (n,)
    """

    params: np.ndarray
    covariance: np.ndarray
    chi2: np.ndarray
    converged: np.ndarray

    def __repr__(self):
        return f"<Fit: {len(self.params)} stars, {np.count_nonzero(self.converged)} converged>"


def quadrature(fwhm):
    """Offsets and weights of the points over which a profile is averaged in each pixel.

    A pixel records the mean of the image over its area; for profiles well sampled the value at the
    centre does as well (the difference is a slightly broader profile of the same family).

    Parameters
    ----------
    fwhm : float
        Full width at half maximum [pix].

    Returns
    -------
    offsets, weights : ndarray, shape (k,)
        Gauss-Legendre nodes in one dimension, k = 1, 3 or 5.
    """
    if fwhm > 3.0:
        return CENTRES
    nodes, weights = np.polynomial.legendre.leggauss(3 if fwhm > 1.3 else 5)
    return nodes / 2, weights / 2


def shape(fwhm, beta=3.0):
    """Shape parameters (log_a, log_b, rho, log_beta) of a round profile."""
    return np.array([np.log(4 / fwhm**2), np.log(4 / fwhm**2), 0.0, np.log(beta)])


def fwhm(params):
    """Full width at half maximum [pix], geometric mean of the axes, of parameters (..., 8) or shapes (..., 4)."""
    log_a, log_b, rho = np.moveaxis(params[..., -5:-2] if params.shape[-1] == 8 else params[..., :3], -1, 0)
    return 2 * np.exp(-(log_a + log_b) / 4) * (1 - rho**2) ** -0.25


def flux(params, covariance=None):
    """Flux of the whole profile (n,), and its standard deviation if a covariance is given."""
    peak, log_a, log_b, rho = params[:, 2:6].T
    beta = np.exp(params[:, 6])
    k = np.exp2(1 / beta) - 1
    unit = np.pi / (k * (beta - 1)) * np.exp(-(log_a + log_b) / 2) / np.sqrt(1 - rho**2)
    if covariance is None:
        return peak * unit
    dk = -np.exp2(1 / beta) * np.log(2) / beta**2
    half, none = np.full_like(beta, -0.5), np.zeros_like(beta)
    by_log = [none, none, none, half, half, rho / (1 - rho**2), -beta * (dk / k + 1 / (beta - 1)), none]
    gradient = (peak * unit)[:, None] * np.column_stack(by_log)
    gradient[:, 2] = unit
    return peak * unit, np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", gradient, covariance, gradient), 0))


def evaluate(params, half, nodes, *, jacobian=False):
    """Profiles on square stamps, without the background.

    Parameters
    ----------
    params : ndarray, shape (n, 8)
        In the order of `NAMES`.
    half : int
        Stamps reach from -half to half.
    nodes : tuple
        From `quadrature`.
    jacobian : bool
        Whether to give the derivatives too.

    Returns
    -------
    model : ndarray, shape (n, npix)
        Stamps flattened, rows (y) first.
    jacobian : ndarray, shape (n, 8, npix)
        Derivatives by all parameters (background included); only if asked for.
    """
    x0, y0, peak, log_a, log_b, rho, log_beta = (p[:, None, None] for p in params[:, :7].T)
    a, b, c = np.exp(log_a), np.exp(log_b), rho * np.exp((log_a + log_b) / 2)
    beta = np.exp(log_beta)
    k = np.exp2(1 / beta) - 1
    dk = -np.exp2(1 / beta) * np.log(2) / beta**2
    grid = np.arange(-half, half + 1, dtype=float)
    n, size = len(params), 2 * half + 1
    model = np.zeros((n, size, size))
    jac = np.zeros((n, 8, size, size)) if jacobian else None
    for dy, wy in zip(*nodes, strict=True):
        v = (grid + dy)[:, None] - y0
        for dx, wx in zip(*nodes, strict=True):
            u = grid + dx - x0
            au, cv = a * u, c * v
            h = u * (au + 2 * cv) + b * v**2
            s = 1 + k * h
            log_s = np.log(s)
            profile = (wy * wx) * np.exp(-beta * log_s)
            model += profile
            if jacobian:
                slope = -beta * k * profile / s
                cuv = cv * u
                jac[:, 0] -= 2 * slope * (au + cv)
                jac[:, 1] -= 2 * slope * (b * v + c * u)
                jac[:, 3] += slope * (au * u + cuv)
                jac[:, 4] += slope * (b * v**2 + cuv)
                jac[:, 5] += 2 * slope * u * v
                jac[:, 6] += beta * (slope * h * (dk / k) - profile * log_s)
    if not jacobian:
        return (peak * model).reshape(n, size**2)
    jac *= peak[:, None]
    jac[:, 5] *= np.exp((log_a + log_b) / 2)
    jac[:, 2] = model
    jac[:, 7] = 1.0
    return (peak * model).reshape(n, size**2), jac.reshape(n, 8, size**2)


def fit(stamps, weights, start, *, nodes, centre, sigma=SHAPE_SIGMA, max_iterations=60):
    """Fit a profile to every stamp by Levenberg-Marquardt, all at once, each with its own damping.

    The shape carries a weak Gaussian prior: it decides nothing that the pixels can tell (above a
    signal-to-noise ratio of 10 the errors are those of eight free parameters), and keeps faint stars
    from running away.

    Parameters
    ----------
    stamps : ndarray, shape (n, npix)
        Square stamps, flattened.
    weights : ndarray, shape (n, npix)
        Inverse variances; 0 where a pixel is bad.
    start : ndarray, shape (n, 8)
        Start values.
    nodes : tuple
        From `quadrature`.
    centre : ndarray, shape (4,)
        Centre of the prior: log_a, log_b, rho, log_beta.
    sigma : ndarray, shape (4,)
        Its standard deviation; a narrow one holds the shape.
    max_iterations : int
        A pass that only prepares the next one can do with few.

    Returns
    -------
    Fit
    """
    parts = [
        _fit(stamps[i:j], weights[i:j], start[i:j], nodes, (centre, sigma), max_iterations=max_iterations)
        for i, j in ((i, i + _CHUNK) for i in range(0, len(start), _CHUNK))
    ]
    if not parts:
        return Fit(np.zeros((0, 8)), np.zeros((0, 8, 8)), np.zeros(0), np.zeros(0, dtype=bool))
    return Fit(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _fit(stamps, weights, start, nodes, prior, *, max_iterations):
    half = (round(np.sqrt(stamps.shape[1])) - 1) // 2
    root = np.sqrt(weights)
    target = np.where(weights > 0, stamps, 0.0) * root
    mean, precision = np.zeros(8), np.zeros(8)
    mean[3:7], precision[3:7] = prior[0], 1 / prior[1] ** 2

    def linearise(p, rows):
        """Chi2, cost with the prior, negative half gradient and half Hessian."""
        model, jac = evaluate(p, half, nodes, jacobian=True)
        r = target[rows] - (model + p[:, 7:]) * root[rows]
        jac *= root[rows, None, :]
        off = mean - p
        chi2 = (r**2).sum(axis=1)
        cost = chi2 + (off**2) @ precision
        gradient = (jac @ r[:, :, None])[:, :, 0] + precision * off
        hessian = jac @ jac.swapaxes(1, 2) + np.diag(precision)
        return chi2, cost, gradient, hessian

    params = start.copy()
    every = np.arange(len(start))
    chi2, cost, gradient, hessian = linearise(params, every)
    damping = np.full(len(start), 1e-2)
    converged = np.zeros(len(start), dtype=bool)
    for _ in range(max_iterations):
        active = np.flatnonzero(~converged & (damping < 1e10))
        if len(active) == 0:
            break
        step, gain = _step(params[active], gradient[active], hessian[active], damping[active])
        trial = params[active] + step
        trial[:, 6] = np.clip(trial[:, 6], *LOG_BETA)
        legal = _legal(trial, half)
        rows, trial, gain = active[legal], trial[legal], gain[legal]
        damping[active[~legal]] *= 10
        new = linearise(trial, rows)
        better = new[1] <= cost[rows]
        good = rows[better]
        params[good] = trial[better]
        for kept, value in zip((chi2, cost, gradient, hessian), new, strict=True):
            kept[good] = value[better]
        # A step that would lower chi2 by 1e-4 moves a position by a hundredth of its error. The damping
        # must be small for the foreseen gain to mean that.
        converged[rows] = (gain < 1e-4) & ((damping[rows] <= 1) | ~better)
        damping[good] /= 5
        damping[rows[~better]] *= 8
    return params, _covariance(hessian), chi2, converged


def _step(params, gradient, hessian, damping):
    """Damped step of every star, and the gain foreseen; a beta that pushes against its bound is held."""
    low, high = LOG_BETA
    g6 = gradient[:, 6]
    held = ((params[:, 6] <= low) & (g6 < 0)) | ((params[:, 6] >= high) & (g6 > 0))
    gradient, hessian = gradient.copy(), hessian.copy()
    gradient[held, 6] = 0
    hessian[held, 6, :] = hessian[held, :, 6] = 0
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", hessian), 1e-300))
    scale[held, 6] = 1
    # In units of the diagonal all parameters are alike and the matrix is solved safely.
    normal = hessian / (scale[:, :, None] * scale[:, None, :])
    normal[:, range(8), range(8)] = (1 + damping + 1e-12)[:, None]
    step = np.linalg.solve(normal, (gradient / scale)[:, :, None])[:, :, 0] / scale
    return step, (gradient * step).sum(axis=1)


def _legal(params, half):
    inside = (np.abs(params[:, :2]) < half + 1).all(axis=1)
    return inside & (np.abs(params[:, 5]) < 0.95) & (params[:, 3:5] < 2 * np.log(2 / _SMALLEST)).all(axis=1)


def _covariance(hessian):
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", hessian), 1e-300))
    normal = hessian / (scale[:, :, None] * scale[:, None, :])
    normal[:, range(8), range(8)] = 1 + 1e-12
    return np.linalg.inv(normal) / (scale[:, :, None] * scale[:, None, :])
