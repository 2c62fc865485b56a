"""The covariance of coefficients in its forms: one matrix, `Coupled`, or one block an exposure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from ...runtime.trees.facts import array

if TYPE_CHECKING:
    from typing import TypeAlias

    #: Of all coefficients, shape (n_exposures * k,) squared or, covariances between exposures neglected,
    #: (n_exposures, k, k).
    CoefficientCovariance: TypeAlias = "np.ndarray | Coupled"


@dataclass(frozen=True, eq=False)
class Coupled:
    """Covariance of coefficients of exposures that come together through a few unknowns, those of the stars.

    ``own + factor core factor'``, exact, without an array as large as the whole.

    Attributes
    ----------
    own : ndarray, shape (n_exposures, k, k)
        Of every exposure if these unknowns were known, px^2.
    factor : ndarray, shape (n_exposures * k, r)
        How the coefficients follow the unknowns.
    core : ndarray, shape (r, r)
        Covariance of the unknowns; that of multipliers of constraints is negative.
    """

    own: np.ndarray = field(metadata=array("n_exposures", "2 n_modes", "2 n_modes", unit="pix2", covariance=True))
    factor: np.ndarray = field(metadata=array("n_exposures 2 n_modes", "n_coupling"))
    core: np.ndarray = field(metadata=array("n_coupling", "n_coupling"))

    @property
    def blocks(self) -> np.ndarray:
        """That of every exposure, shape (n_exposures, k, k)."""
        by_exposure = self.factor.reshape(*self.own.shape[:2], -1)
        return self.own + by_exposure @ self.core @ by_exposure.mT

    def with_shared(self, responses: np.ndarray) -> Coupled:
        """With responses (n_exposures, k, q) to independent errors of unit size more."""
        added = responses.reshape(len(self.factor), -1)
        return Coupled(self.own, np.hstack([self.factor, added]), block_diag(self.core, np.eye(added.shape[1])))


def exposure_blocks(covariance: CoefficientCovariance, n_exposures: int) -> np.ndarray:
    """Covariance of the coefficients of every exposure, shape (n_exposures, k, k)."""
    if isinstance(covariance, Coupled):
        return covariance.blocks
    if covariance.ndim == 3:
        return covariance
    i = np.arange(n_exposures)
    return covariance.reshape(n_exposures, len(covariance) // n_exposures, n_exposures, -1)[i, :, i]


def exposure_block(covariance: CoefficientCovariance, n_exposures: int, i: int) -> np.ndarray:
    """That of exposure i alone, shape (k, k)."""
    if isinstance(covariance, Coupled):
        size = covariance.own.shape[1]
        mine = covariance.factor[i * size : (i + 1) * size]
        return covariance.own[i] + mine @ covariance.core @ mine.T
    if covariance.ndim == 3:
        return covariance[i]
    size = len(covariance) // n_exposures
    return covariance[i * size : (i + 1) * size, i * size : (i + 1) * size]


def times(covariance: CoefficientCovariance, matrix: np.ndarray) -> np.ndarray:
    """The covariance times a matrix (n_exposures * k, m); blocks count as a matrix without anything between them."""
    if isinstance(covariance, Coupled):
        return times(covariance.own, matrix) + covariance.factor @ (covariance.core @ (covariance.factor.T @ matrix))
    if covariance.ndim == 2:
        return covariance @ matrix
    return (covariance @ matrix.reshape(*covariance.shape[:2], -1)).reshape(len(matrix), -1)


def mean_covariance(covariance: CoefficientCovariance, n_exposures: int) -> np.ndarray:
    """That of the mean coefficients of all exposures, shape (k, k)."""
    if isinstance(covariance, Coupled):
        mean = covariance.factor.reshape(n_exposures, -1, len(covariance.core)).mean(axis=0)
        return mean_covariance(covariance.own, n_exposures) + mean @ covariance.core @ mean.T
    if covariance.ndim == 3:
        return covariance.mean(axis=0) / n_exposures
    size = len(covariance) // n_exposures
    return covariance.reshape(n_exposures, size, n_exposures, size).mean(axis=(0, 2))


def with_shared(covariance: CoefficientCovariance, responses: np.ndarray) -> CoefficientCovariance:
    """With responses (n_exposures, k, q) to independent errors of unit size more; of blocks in each alone."""
    if isinstance(covariance, Coupled):
        return covariance.with_shared(responses)
    added = responses.reshape(-1, responses.shape[2]) if covariance.ndim == 2 else responses
    return covariance + added @ added.mT
