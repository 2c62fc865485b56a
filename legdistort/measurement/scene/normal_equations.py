"""Stars fitted together by Gauss-Newton steps: of one frame, or of all exposures at once."""

import numpy as np
from scipy.sparse import bsr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from .stamps import products

_CHUNK = 200  # stars: their matrices stay in the processor's cache
_LONGEST = 0.25  # FWHM, a step of a position
_SETTLED = 0.05  # standard deviations: a star that moves by less stays
_DAMPING = 1e-4
_NEAR = 1.5  # FWHM: what moves within it moves a star
_NEIGHBOURS, _REACH = 10, 2.5  # of a star, whose errors are part of its own; FWHM within which they are


class JointFit:
    """Positions and fluxes of stars whose normal equations are sparse.

    Who inherits has `xy` (n, 2), `flux` (n,) and `fwhm` [pix], ``equations(rows)``, the normal matrix (3 m, 3 m) and
    right side of some stars' x, y and flux, and ``set(rows, xy, flux)``.

    Attributes
    ----------
    starting : int
        Passes of a search in which the PSF is found anew.
    by_places : bool
        Whether a search afterwards looks only where something has changed.
    """

    starting, by_places = 3, False

    def fit(self, active, iterations):
        """Gauss-Newton steps of some stars, all together; the others stay.

        Parameters
        ----------
        active : ndarray of bool, shape (n,)
        iterations : int

        Returns
        -------
        ndarray of bool, shape (n,)
            Stars that have not come to rest.
        """
        for _ in range(iterations):
            rows = np.flatnonzero(active)
            if not len(rows):
                break
            normal, right = self.equations(rows)
            scale = np.sqrt(np.maximum(normal.diagonal(), 1e-30))
            step = solved(normal, right, scale).reshape(-1, 3)
            moved = np.abs(step * scale.reshape(-1, 3)).max(axis=1)
            length = np.hypot(*step[:, :2].T)
            step[:, :2] *= np.minimum(1, _LONGEST * self.fwhm / np.maximum(length, 1e-30))[:, None]
            flux = self.flux[rows]
            self.set(rows, self.xy[rows] + step[:, :2], np.maximum(flux + step[:, 2], 0.1 * flux))
            restless = np.zeros(len(active), dtype=bool)
            restless[rows] = moved > _SETTLED
            active = restless if len(rows) < 20 else self.around(restless)
        return active

    def around(self, stars):
        """These stars and those near them; masks (n,)."""
        if not stars.any() or stars.all():
            return stars
        return cKDTree(self.xy[stars]).query(self.xy, distance_upper_bound=_NEAR * self.fwhm)[0] < np.inf

    def covariance(self, rows=None):
        """Covariance of x, y and flux of the stars, or some, those of their neighbours unknown too; (n, 3, 3)."""
        if rows is None:
            return neighbour_covariance(self.equations(np.arange(len(self.flux)))[0], self.xy, self.fwhm)
        if not len(rows):
            return np.zeros((0, 3, 3))
        some = with_neighbours(self.xy, rows, self.fwhm)
        own = np.searchsorted(some, rows)
        return neighbour_covariance(self.equations(some)[0], self.xy[some], self.fwhm, own)


def with_neighbours(xy, rows, fwhm):
    """Some stars and those whose errors are part of theirs: rows in order, (m,)."""
    if not len(rows):
        return np.zeros(0, dtype=int)
    return np.flatnonzero(cKDTree(xy[rows]).query(xy, distance_upper_bound=_REACH * fwhm)[0] < np.inf)


def neighbour_covariance(normal, xy, fwhm, rows=None):
    """Covariance of the parameters of every star, those of its neighbours unknown too.

    Parameters
    ----------
    normal : sparse array, shape (k n, k n)
        Normal matrix of k parameters a star.
    xy : ndarray, shape (n, 2)
    fwhm : float
        Of the PSF [pix].
    rows : ndarray of int, shape (m,), optional
        Of these stars alone.

    Returns
    -------
    ndarray, shape (n, k, k) or (m, k, k)
    """
    n = len(xy)
    p, rows = normal.shape[0] // max(n, 1), np.arange(n) if rows is None else rows
    blocks = normal.tobsr((p, p))
    k = min(_NEIGHBOURS + 1, n)
    near = cKDTree(xy).query(xy[rows], k=np.arange(1, k + 1), distance_upper_bound=_REACH * fwhm)[1]
    near[:, 0] = rows  # of stars that coincide, too
    real = near < n
    real[:, 1:] &= near[:, 1:] != rows[:, None]
    blocks.sort_indices()
    keys = np.repeat(np.arange(n), np.diff(blocks.indptr)) * n + blocks.indices
    out = np.empty((len(rows), p, p))
    for i in range(0, len(rows), _CHUNK):
        some, there = near[i : i + _CHUNK], real[i : i + _CHUNK]
        pairs = np.where(there, some, 0)
        asked = pairs[:, :, None] * n + pairs[:, None]
        at = np.minimum(np.searchsorted(keys, asked), len(keys) - 1)
        found = (keys[at] == asked) & there[:, :, None] & there[:, None]
        matrix = np.where(found[..., None, None], blocks.data[at], 0.0)
        matrix = matrix.swapaxes(2, 3).reshape(len(some), p * k, p * k)
        diagonal = np.arange(p * k)
        matrix[:, diagonal, diagonal] += np.repeat(~there, p, axis=1)
        scale = np.sqrt(np.maximum(matrix[:, diagonal, diagonal], 1e-30))
        matrix /= scale[:, :, None] * scale[:, None]
        matrix[:, diagonal, diagonal] += 1e-9
        inverse = np.linalg.inv(matrix)[:, :p, :p]
        out[i : i + _CHUNK] = inverse / (scale[:, :p, None] * scale[:, None, :p])
    return out


def normal_matrix(slopes, centres, half):
    """Normal matrix of stars whose stamps overlap, from `normal_blocks`; csc_array, shape (k n, k n)."""
    return assembled([normal_blocks(slopes, centres, half)], len(slopes))


def normal_blocks(slopes, centres, half):
    """The blocks that are not 0 of the normal matrix of stars whose stamps overlap.

    Parameters
    ----------
    slopes : ndarray, shape (n, k, npix)
        Of the pixels of square stamps by the k parameters of each star, in units of their noise.
    centres : ndarray of int, shape (n, 2)
        Central pixels (x, y).
    half : int
        Stamps reach from -half to half.

    Returns
    -------
    rows, columns : ndarray of int, shape (m,)
        Stars.
    blocks : ndarray, shape (m, k, k)
    """
    i, j = np.zeros((2, 0), int)
    if len(slopes):
        i, j = cKDTree(centres).query_pairs(2 * half + 0.5, p=np.inf, output_type="ndarray").T
    own, blocks = np.arange(len(slopes)), products(slopes, centres, half, i, j)
    values = np.concatenate([slopes @ slopes.mT, blocks, blocks.mT])
    return np.concatenate([own, i, j]), np.concatenate([own, j, i]), values


def assembled(parts, n):
    """The sum of some `normal_blocks` of n stars; csc_array, shape (k n, k n)."""
    rows, columns, blocks = (np.concatenate(each) for each in zip(*parts, strict=True))
    keys, place = np.unique(columns * n + rows, return_inverse=True)
    k = blocks.shape[1]
    # of the transpose, whose rows are the columns
    total = np.stack([np.bincount(place, b, len(keys)) for b in blocks.mT.reshape(len(blocks), -1).T], axis=1)
    starts = np.searchsorted(keys, np.arange(n + 1) * n)
    return bsr_array((total.reshape(-1, k, k), keys % max(n, 1), starts), shape=(k * n, k * n)).tocsr().T


def solved(normal, right, scale):
    """Damped normal equations solved in units of their diagonal."""
    inverse = diags_array(1 / scale)
    scaled = (inverse @ normal @ inverse + _DAMPING * diags_array(np.ones(len(scale)))).tocsc()
    factors = splu(scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factors.solve(right / scale) / scale
