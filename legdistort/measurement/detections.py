"""The rows of a table of detections: what fits of stars say, with their errors, flags and what is no star."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from astropy import units as u
from astropy.table import QTable, vstack
from scipy.spatial import cKDTree

from .flags import UNUSABLE, Flag

_COLUMNS = ("x", "y", "x_err", "y_err", "xy_corr", "flux", "flux_err", "fwhm", "chi2")
_PIXELS = ("x", "y", "x_err", "y_err", "fwhm")


class Stars(NamedTuple):
    """Fits of all stars of a frame, one row a star.

    Attributes
    ----------
    xy : ndarray, shape (n, 2)
        From the central pixels of the stamps [pix].
    covariance : ndarray, shape (n, 2, 2)
    flux, flux_err, width, chi2, dof, snr : ndarray, shape (n,)
        Width: full width at half maximum [pix].
    flags : ndarray of int, shape (n,)
    misfit : float
        Part of their light by which bright stars deviate from a PSF of their own: its error, which is in their errors.
    confusion : ndarray, shape (n,), or None
        Of a crowd: variance that stars not seen add, in units of that of the fit; chi2 is then that of the core.
    """

    xy: np.ndarray
    covariance: np.ndarray
    flux: np.ndarray
    flux_err: np.ndarray
    width: np.ndarray
    chi2: np.ndarray
    dof: np.ndarray
    snr: np.ndarray
    flags: np.ndarray
    misfit: float = 0.0
    confusion: np.ndarray | None = None


class FrameStars(NamedTuple):
    """The stars of a frame, fitted.

    Attributes
    ----------
    stamps : `~legdistort.measurement.profiles.cutouts.Stamps`
        Around them.
    stars : Stars
    verdict : `~legdistort.measurement.effective.frame_psf.Verdict`
        What they were fitted with.
    psf : `~legdistort.measurement.effective.model.EffectivePSF` or None
        None for Moffat profiles.
    photon : float
        Variance per unit of star light, as taken.
    shown : callable
        Without arguments: variance per unit of star light that the stars themselves show.
    factor_error : float
        Relative, of the factor from light in the PSF to fluxes, common to all stars.
    """

    stamps: object
    stars: Stars
    verdict: object
    psf: object
    photon: float
    shown: Callable
    factor_error: float = 0.0


class MeasuredExposure(NamedTuple):
    """Detections of one exposure.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        As from `measure`.
    photon : float or None
        Variance per unit of star light if it had to be estimated, for want of a gain.
    psf : `~legdistort.measurement.effective.model.EffectivePSF` or None
        None if Moffat profiles were fitted.
    verdict : `~legdistort.measurement.effective.frame_psf.Verdict`
    noise_ratio : float or None
        Of the noise seen to that which the gain implies, where that is doubtful (`camera_gain.contradiction`).
    shape : ndarray, shape (4,), or None
        Of its stars.
    hidden : bool
        Whether its mask hides most bright stars.
    factor_error : float
        Relative error common to all fluxes, see `legdistort.measurement.effective.total_light`.
    """

    table: QTable
    photon: float | None
    psf: object
    verdict: object
    noise_ratio: float | None = None
    shape: np.ndarray | None = None
    hidden: bool = False
    factor_error: float = 0.0

    def in_unit(self, unit):
        """The same in a unit of light that is so many times larger."""
        table = self.table.copy()
        for name in ("flux", "flux_err"):
            table[name] = table[name] / unit
        return self._replace(table=table, photon=self.photon and self.photon / unit)


def empty_table():
    """The table of a frame in which nothing is found."""
    columns = {name: np.zeros(0) * (u.pix if name in _PIXELS else 1) for name in _COLUMNS}
    kinds = {"flags": np.zeros(0, dtype=int), "crowding": np.zeros(0), "psf": np.zeros(0, dtype="U1")}
    return QTable({"exposure": np.zeros(0, dtype="U1"), **columns, **kinds})


def table_of(name, stamps, stars):
    """Table of one frame, brightest first; errors scaled where the fit leaves more than noise."""
    ny, nx = stamps.frame.signal.shape
    flags, flux, width = stars.flags, stars.flux, stars.width
    dof = np.maximum(stars.dof, 1)
    chi2 = stars.chi2 / dof
    # Near the detection limit the fit is no longer linear (measured at a ratio of 7: errors 8 to 15 % too small).
    faint = 1 + 5 / np.maximum(stars.snr, 1) ** 2
    # What all bright stars leave is the error of their PSF: the errors of positions have it, those of fluxes do not.
    if stars.confusion is None:
        own = chi2 / (1 + (stars.misfit * stars.snr) ** 2 / dof)
        scale, flux_scale = (faint * _scale(c, dof) for c in (own, chi2))
    else:
        scale = flux_scale = faint * np.sqrt(np.maximum(1, chi2) * (1 + stars.confusion))
    error = np.sqrt(np.einsum("nii->ni", stars.covariance))
    lost = ~(error < stamps.half).all(axis=1)
    corr = np.where(lost, 0.0, stars.covariance[:, 0, 1] / error.prod(axis=1))
    error = np.where(lost[:, None], stamps.half, scale[:, None] * error)
    hot = (flags & Flag.HOT) != 0  # they stay on their pixel: a profile fitted to one pixel wanders off
    xy = stamps.centres + np.where(hot[:, None], 0.0, stars.xy)
    to_edge = np.minimum(xy + 0.5, np.array([nx, ny]) - 0.5 - xy).min(axis=1)
    flags = flags | np.where(lost, Flag.NOT_CONVERGED, 0) | np.where(to_edge < width, Flag.EDGE, 0)
    columns = (xy[:, 0], xy[:, 1], error[:, 0], error[:, 1], corr, flux, flux_scale * stars.flux_err, width, chi2)
    named = {key: v * u.pix if key in _PIXELS else v for key, v in zip(_COLUMNS, columns, strict=True)}
    return QTable({"exposure": np.full(len(xy), name), **named, "flags": flags})[np.argsort(-flux, kind="stable")]


def with_defects(table, peaks):
    """The table with a row for every defect, flagged, of which a pixel is all that is known."""
    xy, height, sigma = peaks
    if not len(xy) or not len(table):
        return table
    rows = table[np.zeros(len(xy), dtype=int)]
    pixel, none = np.full(len(xy), 12**-0.5), np.zeros(len(xy))
    values = (xy[:, 0].astype(float), xy[:, 1].astype(float), pixel, pixel, none, height, sigma, none + 1, none + 1)
    for key, value in zip(_COLUMNS, values, strict=True):
        rows[key] = value * u.pix if key in _PIXELS else value
    rows["flags"], rows["crowding"] = int(Flag.HOT | Flag.DEFECT), none
    table = vstack([table, rows])
    return table[np.argsort(-table["flux"], kind="stable")]


def _scale(chi2, dof):
    """Factor on errors; three standard deviations of chi2 are chance, which must not raise those of good fits."""
    return np.sqrt(np.maximum(1, chi2 - 3 * np.sqrt(2 / dof)))


def distinct(table, fwhm, same):
    """Rows to keep: of detections within `same` FWHM, on one star, the better one; flags the close pairs that stay."""
    tree = cKDTree(np.column_stack([table["x"].value, table["y"].value]))
    keep = np.ones(len(table), dtype=bool)
    unusable = (table["flags"] & UNUSABLE) != 0
    for i, j in sorted(tree.query_pairs(same * fwhm)):  # i < j: i is the brighter
        if keep[i] and keep[j]:
            keep[i if unusable[i] and not unusable[j] else j] = False
    close = tree.query_pairs(2 * fwhm, output_type="ndarray")
    close = close[keep[close].all(axis=1)]
    table["flags"][close.ravel()] |= Flag.BLENDED
    return keep
