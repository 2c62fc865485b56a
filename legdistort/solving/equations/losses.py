"""Robust losses of single observations, as factors on their weights."""

import numpy as np

_TUNING = {"huber": 2.0, "cauchy": 2.385}  # radii in standard errors


def loss_factors(squares, loss, scale2=None):
    """Weight factors of iteratively reweighted least squares for the squared normalised residuals (n,).

    The loss works at the observed scale if that is larger than the stated errors (`observed_variance`), or at the given
    one.
    """
    scale2 = observed_variance(squares) if scale2 is None else scale2
    s = squares / (scale2 * _TUNING[loss] ** 2)
    return 1 / np.maximum(1, np.sqrt(s)) if loss == "huber" else 1 / (1 + s)


def observed_variance(squares):
    """Variance over that of the stated errors, at least 1: the median of the squares over that of two axes, 2 ln 2."""
    seen = squares[squares > 0]
    return max(1.0, np.median(seen) / (2 * np.log(2))) if len(seen) else 1.0
