"""Elliptical Moffat profiles.

The profile of the paper (its section on position measurements),
``I0 [1 + (X/dx)^2 + (Y/dy)^2]^-beta + background``, has eight parameters a star. Two changes keep
a fit well conditioned without changing the family:

* ``dx, dy, theta`` become the quadratic form ``h = a u^2 + b v^2 + 2 rho sqrt(ab) u v`` (u, v: offsets from the
  centre; log a, log b and rho are fitted): theta has no meaning at dx = dy, where the fit would stall;
* the form is 1 at half maximum, ``I0 [1 + (2^(1/beta) - 1) h]^-beta``, so that width and beta are nearly independent.

Parameters are rows (n, 8) in the order of `NAMES`; stamps are square, positions count from their central pixel.
"""

import numpy as np

NAMES = ("x", "y", "peak", "log_a", "log_b", "rho", "log_beta", "background")
#: Bounds of log(beta). Beyond 20 a Moffat profile is a Gaussian; at 1 its flux is infinite.
LOG_BETA = (np.log(1.1), np.log(20.0))

#: As `quadrature`, but the centre of the pixel alone.
CENTRES = np.zeros(1), np.ones(1)


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
        Gauss-Legendre nodes in one dimension, k = 1, 3, 4 or 5.
    """
    if fwhm > 3.0:
        return CENTRES
    # So many that no position is off by more than 0.05 of its error at a signal-to-noise ratio of 1000.
    nodes, weights = np.polynomial.legendre.leggauss(3 if fwhm > 1.9 else 4 if fwhm > 1.5 else 5)
    return nodes / 2, weights / 2


def shape(fwhm, beta=3.0):
    """Shape parameters (log_a, log_b, rho, log_beta) of a round profile."""
    return np.array([np.log(4 / fwhm**2), np.log(4 / fwhm**2), 0.0, np.log(beta)])


def parameters(peak, shape, xy=0.0):
    """Parameters (n, 8) of profiles without background: peaks (n,), shapes (4,) or (n, 4), positions (n, 2)."""
    out = np.zeros((len(peak), 8))
    out[:, :2], out[:, 2], out[:, 3:7] = xy, peak, shape
    return out


def fwhm(params):
    """Full width at half maximum [pix], geometric mean of the axes, of parameters (..., 8) or shapes (..., 4)."""
    log_a, log_b, rho = np.moveaxis(params[..., -5:-2] if params.shape[-1] == 8 else params[..., :3], -1, 0)
    return 2 * np.exp(-(log_a + log_b) / 4) * (1 - rho**2) ** -0.25


def axes(shape):
    """Full widths at half maximum of a shape (4,) along its axes, the longer first, and its angle from x to y [deg]."""
    a, b, c = _form(*shape[:3])
    values, vectors = np.linalg.eigh([[a, c], [c, b]])
    wide, narrow = 2 / np.sqrt(np.maximum(values, np.finfo(float).tiny))
    return float(wide), float(narrow), float(np.degrees(np.arctan2(*vectors[::-1, 0])) % 180)


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
        In the order of `NAMES`. Their precision (float32 or float64) is that of the results.
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
    x0, y0, peak, log_a, log_b, rho, log_beta = params[:, :7].T
    beta = np.exp(log_beta)
    k = np.exp2(1 / beta) - 1
    ka, kb, kc = (k * q for q in _form(log_a, log_b, rho))
    n, size, kind = len(params), 2 * half + 1, params.dtype
    grid = np.arange(-half, half + 1, dtype=kind)
    y, x = np.repeat(grid, size), np.tile(grid, size)  # of all pixels: to broadcast rows of 15 pixels takes longer
    columns = [x + kind.type(dx) - x0[:, None] for dx in nodes[0]]
    squares = [ka[:, None] * u**2 for u in columns]
    terms = np.zeros((8 if jacobian else 1, n, size**2), dtype=kind)
    s, log_s, profile = np.empty((3, n, size**2), dtype=kind)
    moments = np.empty((3, n, size**2), dtype=kind) if jacobian else ()
    for dy, wy in zip(*nodes, strict=True):
        v = y + kind.type(dy) - y0[:, None]
        slope, rest = 2 * kc[:, None] * v, kb[:, None] * v**2 + 1
        if jacobian:
            moments[:] = 0
        for u, square, wx in zip(columns, squares, nodes[1], strict=True):
            np.multiply(u, slope, out=s)
            s += square
            s += rest
            np.log(s, out=log_s)
            np.multiply(log_s, -beta[:, None], out=profile)
            np.exp(profile, out=profile)
            profile *= kind.type(wy * wx)
            terms[0] += profile
            if jacobian:
                log_s *= profile
                terms[1] += log_s
                profile /= s
                moments[0] += profile
                for moment in moments[1:]:
                    profile *= u
                    moment += profile
        if jacobian:  # what v multiplies is the same for all columns
            su, suu = moments[1:]
            terms[2] += su
            terms[4] += suu
            for i, moment in ((3, moments[0]), (5, moments[0]), (6, su)):
                moment *= v
                terms[i] += moment
    model = peak[:, None] * terms[0]
    if not jacobian:
        return model
    terms[7] = 1
    return model, _derivatives(params) @ terms.swapaxes(0, 1)


def evaluate_placed(params, half, nodes):
    """As `evaluate`, with derivatives by x, y and peak only; these (n, 3, npix)."""
    x0, y0, peak, log_a, log_b, rho, log_beta = params[:, :7].T[:, :, None]
    beta = np.exp(log_beta)
    k = np.exp2(1 / beta) - 1
    a, b, c = (k * q for q in _form(log_a, log_b, rho))
    size, kind = 2 * half + 1, params.dtype
    grid = np.arange(-half, half + 1, dtype=kind)
    y, x = np.repeat(grid, size), np.tile(grid, size)
    out = np.zeros((len(params), 3, size**2), dtype=kind)
    s, t, profile = np.empty((3, len(params), size**2), dtype=kind)
    for dy, wy in zip(*nodes, strict=True):
        v = y + kind.type(dy) - y0
        cv, bv = c * v, b * v
        square = bv * v + 1
        for dx, wx in zip(*nodes, strict=True):
            u = x + kind.type(dx) - x0
            by_u = a * u + cv
            np.multiply(by_u + cv, u, out=s)  # 1 + k h
            s += square
            np.log(s, out=t)
            t *= -beta
            np.exp(t, out=profile)
            profile *= kind.type(wy * wx)
            out[:, 2] += profile
            profile /= s
            by_u *= profile
            out[:, 0] += by_u
            np.multiply(c, u, out=t)
            t += bv
            t *= profile
            out[:, 1] += t
    model = peak * out[:, 2]
    out[:, :2] *= (2 * beta * peak)[:, None]
    return model, out


def _form(log_a, log_b, rho):
    """Coefficients of u^2, v^2 and 2uv."""
    return np.exp(log_a), np.exp(log_b), rho * np.exp((log_a + log_b) / 2)


def _derivatives(params):
    """Derivatives by the eight parameters as sums of P, P log s, Su, Sv, Su^2, Sv^2, Suv, 1; (n, 8, 8).

    P is the profile ``s^-beta`` of unit peak, ``s = 1 + k h`` and ``S = P / s``. The terms are the same for all
    stars and few, which halves the work.
    """
    peak, log_a, log_b, rho, log_beta = params[:, 2:7].T
    a, b, c = _form(log_a, log_b, rho)
    beta = np.exp(log_beta)
    k = np.exp2(1 / beta) - 1
    by_k = np.exp2(1 / beta) * np.log(2) * peak  # what beta does through k
    slope = -beta * k * peak
    out = np.zeros((len(params), 8, 8), dtype=params.dtype)
    out[:, 0, 2], out[:, 0, 3] = -2 * slope * a, -2 * slope * c
    out[:, 1, 2], out[:, 1, 3] = -2 * slope * c, -2 * slope * b
    out[:, 2, 0] = out[:, 7, 7] = 1
    out[:, 3, 4], out[:, 3, 6] = slope * a, slope * c
    out[:, 4, 5], out[:, 4, 6] = slope * b, slope * c
    out[:, 5, 6] = 2 * slope * np.exp((log_a + log_b) / 2)
    out[:, 6, 1] = -beta * peak
    out[:, 6, 4], out[:, 6, 5], out[:, 6, 6] = by_k * a, by_k * b, 2 * by_k * c
    return out
