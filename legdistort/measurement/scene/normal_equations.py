"""Stars fitted together by Gauss-Newton steps: of one frame, or of all exposures at once."""

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

_CHUNK = 200  # stars: their matrices stay in the processor's cache
_LONGEST = 0.25  # FWHM, a step of a position
_SETTLED = 0.05  # standard deviations: a star that moves by less stays
_DAMPING = 1e-4
_NEAR = 1.5  # FWHM: what moves within it moves a star
_NEIGHBOURS = 10  # of a star, whose errors are part of its own


class JointFit:
    """Positions and fluxes of stars whose normal equations are sparse.

    Who inherits has `xy` (n, 2), `flux` (n,) and `fwhm` [pix], ``equations(rows)``, the normal matrix (3 m, 3 m) and
    right side of some stars' x, y and flux, and ``set(rows, xy, flux)``.
    """

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

    def covariance(self):
        """Covariance of x, y and flux of every star, those of its neighbours unknown too; (n, 3, 3)."""
        return neighbour_covariance(self.equations(np.arange(len(self.flux)))[0], self.xy, self.fwhm)


def neighbour_covariance(normal, xy, fwhm):
    """Covariance of the parameters of every star, those of its neighbours unknown too.

    Parameters
    ----------
    normal : sparse array, shape (k n, k n)
        Normal matrix of k parameters a star.
    xy : ndarray, shape (n, 2)
    fwhm : float
        Of the PSF [pix].

    Returns
    -------
    ndarray, shape (n, k, k)
    """
    n = len(xy)
    p, rows = normal.shape[0] // max(n, 1), np.arange(n)
    blocks = normal.tobsr((p, p))
    k = min(_NEIGHBOURS + 1, n)
    near = cKDTree(xy).query(xy, k=np.arange(1, k + 1), distance_upper_bound=2.5 * fwhm)[1]
    near[:, 0] = rows  # of stars that coincide, too
    real = near < n
    real[:, 1:] &= near[:, 1:] != rows[:, None]
    blocks.sort_indices()
    keys = np.repeat(rows, np.diff(blocks.indptr)) * n + blocks.indices
    out = np.empty((n, p, p))
    for i in range(0, n, _CHUNK):
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
    """Normal matrix of stars whose stamps overlap.

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
    csc_array, shape (k n, k n)
    """
    n, k, _ = slopes.shape
    side = 2 * half + 1
    i, j = (
        cKDTree(centres).query_pairs(side - 0.5, p=np.inf, output_type="ndarray").T if n > 1 else np.zeros((2, 0), int)
    )
    y, x = np.divmod(np.arange(side * side), side)
    blocks = np.empty((len(i), k, k))
    for start in range(0, len(i), _CHUNK):
        part = slice(start, start + _CHUNK)
        dx, dy = (centres[i[part]] - centres[j[part]]).T
        there = (x + dx[:, None], y + dy[:, None])  # where the pixels of the first star lie on the stamp of the other
        common = np.logical_and(*((t >= 0) & (t < side) for t in there))
        index = np.where(common, there[1] * side + there[0], 0)
        other = np.take_along_axis(slopes[j[part]], index[:, None], axis=2) * common[:, None]
        blocks[part] = slopes[i[part]] @ other.mT
    own = np.arange(n)
    rows, columns = np.concatenate([own, i, j]), np.concatenate([own, j, i])
    values = np.concatenate([slopes @ slopes.mT, blocks, blocks.mT])
    at = np.broadcast_arrays(
        k * rows[:, None, None] + np.arange(k)[:, None], k * columns[:, None, None] + np.arange(k), values
    )
    return coo_array((at[2].ravel(), (at[0].ravel(), at[1].ravel())), shape=(k * n, k * n)).tocsc().astype(float)


def solved(normal, right, scale):
    """Damped normal equations solved in units of their diagonal."""
    inverse = diags_array(1 / scale)
    scaled = (inverse @ normal @ inverse + _DAMPING * diags_array(np.ones(len(scale)))).tocsc()
    factors = splu(scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factors.solve(right / scale) / scale
