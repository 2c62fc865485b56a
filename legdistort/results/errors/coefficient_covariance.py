"""The covariance of coefficients in its two forms: one matrix or, where that is too large, one block an exposure."""

import numpy as np


def exposure_blocks(covariance, n_exposures):
    """Covariance of the coefficients of every exposure, shape (n_exposures, k, k).

    Parameters
    ----------
    covariance : ndarray, shape (n_exposures * k,) squared or (n_exposures, k, k)
        Of all coefficients; or of those of every exposure, covariances between exposures neglected.
    n_exposures : int
    """
    if covariance.ndim == 3:
        return covariance
    i = np.arange(n_exposures)
    return covariance.reshape(n_exposures, len(covariance) // n_exposures, n_exposures, -1)[i, :, i]


def exposure_block(covariance, n_exposures, i):
    """That of exposure i alone, shape (k, k)."""
    if covariance.ndim == 3:
        return covariance[i]
    size = len(covariance) // n_exposures
    return covariance[i * size : (i + 1) * size, i * size : (i + 1) * size]


def times(covariance, matrix):
    """The covariance times a matrix (n_exposures * k, m); blocks count as a matrix without anything between them."""
    if covariance.ndim == 2:
        return covariance @ matrix
    return (covariance @ matrix.reshape(*covariance.shape[:2], -1)).reshape(len(matrix), -1)


def mean_covariance(covariance, n_exposures):
    """That of the mean coefficients of all exposures, shape (k, k)."""
    if covariance.ndim == 3:
        return covariance.mean(axis=0) / n_exposures
    size = len(covariance) // n_exposures
    return covariance.reshape(n_exposures, size, n_exposures, size).mean(axis=(0, 2))
