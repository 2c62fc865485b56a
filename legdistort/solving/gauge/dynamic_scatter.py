"""How far single exposures scatter around the prior mean, how well each is known, and how much say it has."""

import numpy as np

from ...geometry import basis

_SMALLEST = 1e-6  # scatter, pixels: where none is seen beyond the errors, Lambda stays invertible


def conditional_errors(u_data):
    """C_i, covariance of the coefficients if the stars were known; huge where the data say nothing."""
    size = u_data.shape[1]
    ridge = 1e-12 * np.trace(u_data, axis1=1, axis2=2)[:, None, None] / size + 1e-300
    return np.linalg.inv(u_data + ridge * np.eye(size))


def dynamic_covariance(problem, state, error, motion, others):
    """Lambda of every exposure: from the prior if it has widths, else from the scatter seen beyond the errors.

    The common map of the reference plane that fits the departures A_i - A_0 best is taken out first, so that the
    result does not depend on the gauge of the state; then, mode by mode (shears for the linear ones), the variance
    that makes the weighted scatter what it should be (Paule & Mandel 1982).
    """
    n_modes = problem.n_modes
    departure = (state.coefficients - problem.prior_mean)[:, :, :n_modes].reshape(problem.n_exposures, -1)
    own = np.einsum("ika,ia->ik", others, departure)
    moved = others @ motion
    w = say(error, others)
    normal = np.einsum("i,ika,ikb->ab", w, moved, moved, optimize=True)
    common = np.linalg.pinv(normal, rcond=1e-10, hermitian=True) @ np.einsum("i,ika,ik->a", w, moved, own)
    variance = np.einsum("ika,iab,ikb->ik", others, error, others, optimize=True)
    scatter = _pooled(_excess_scatter(own - moved @ common, variance), problem.n_exposures - 1)
    out = others.transpose(0, 2, 1) * scatter**2 @ others
    for i in range(problem.n_exposures):
        if problem.has_widths(i):
            width = problem.prior_sigma[i].ravel()
            seen = np.maximum(np.diag(out[i]), _SMALLEST**2)
            given = np.where(np.isfinite(width) & (width > 0), width**2, seen)
            out[i] = others[i].T @ (others[i] * given @ others[i].T) @ others[i]
    return out


def _pooled(scatter, n_free):
    """Scatter per mode, shears first, drawn towards the rms of its degree by the weight of three exposures.

    A handful of exposures tells the scatter of a single mode badly, and weights that follow its noise make reported
    errors too small.
    """
    degree = np.repeat(np.arange(basis.MAX_DEGREE + 1), np.arange(basis.MAX_DEGREE + 1) + 1)[3 : len(scatter) // 2 + 2]
    degree = np.concatenate([[1, 1], degree, degree])[: len(scatter)]
    number = np.bincount(degree)[degree]
    usual = np.bincount(degree, scatter**2)[degree] / number
    return np.sqrt((n_free * scatter**2 + 3 * usual) / (n_free + 3))


def _excess_scatter(a, variance):
    """Standard deviation per column of a (n, k) beyond the given variances, by bisection.

    Values ten times less certain than usual would add noise to the answer and nothing else, so they have no say.
    """
    counts = variance <= 10 * np.median(variance, axis=0)
    n = counts.sum(axis=0)
    low, high = np.zeros(a.shape[1]), (a**2).sum(axis=0) + 1e-300

    def excess(extra):
        w = counts / (variance + extra + 1e-300)
        return (w * a**2).sum(axis=0) - (n - 1)

    present = excess(low) > 0
    for _ in range(50):
        middle = (low + high) / 2
        above = excess(middle) > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.sqrt(high * present)


def say(error, rows):
    """How much say each exposure has (n_exposures,): 1, fading where the variance exceeds ten times the usual one.

    The scatter of a convention over a bad exposure's errors would move every star for no gain.
    """
    if not rows.shape[1]:
        return np.ones(len(error))
    own = np.einsum("ika,iab,ikb->ik", rows, error, rows, optimize=True).mean(axis=1)
    return 1 / (1 + (own / (10 * np.median(own))) ** 2)
