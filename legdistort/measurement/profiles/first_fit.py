"""The first fit of stars, with the noise of the sky alone, and single bright pixels distinguished from stars."""

import numpy as np

from . import moffat
from .levenberg_marquardt import Limits, fit
from .pixel_noise import NEIGHBOUR

_LIMITS = Limits(20, 1e-4)  # what this fit leaves determines the noise


def started(stamps, shape):
    """Start values (n, 8): the brightness of the central pixels, and one shape."""
    middle = stamps.data.shape[1] // 2
    return moffat.parameters(np.maximum(stamps.data[:, middle], np.sqrt(stamps.variance[:, middle])), shape)


def weighted(good, variance):
    """Weights of pixels."""
    return np.where(good, 1 / variance, 0.0)


def fit_once(stamps, shape, nodes):
    """First pass, with the noise of the sky alone; the fit, and `point_chi2` of the same pixels."""
    start = started(stamps, shape)
    _, others = stamps.models(start, nodes)
    data, weights = stamps.data - others, weighted(stamps.good, stamps.variance + (NEIGHBOUR * others) ** 2)
    return fit(data, weights, start, nodes=nodes, centre=shape, limits=_LIMITS), point_chi2(data, weights)


def point_chi2(data, weights):
    """Chi2 of a single bright pixel on a flat background, and of the background alone; (n, 2)."""
    n, npix = data.shape
    size = round(np.sqrt(npix))
    middle = np.zeros((size, size), dtype=bool)
    middle[size // 2 - 1 : size // 2 + 2, size // 2 - 1 : size // 2 + 2] = True
    peak = np.argmax(np.where(middle.ravel() & (weights > 0), data, -np.inf), axis=1)
    rest = weights.copy()
    rest[np.arange(n), peak] = 0
    return np.column_stack([_flat_chi2(data, rest), _flat_chi2(data, weights)])


def _flat_chi2(data, weights):
    """Chi2 of a flat background, (n,)."""
    mean = (weights * data).sum(axis=1) / np.maximum(weights.sum(axis=1), np.finfo(weights.dtype).tiny)
    return (weights * (data - mean[:, None]) ** 2).sum(axis=1)
