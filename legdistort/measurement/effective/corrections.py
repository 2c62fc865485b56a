"""Corrections to the grid of a PSF: patterns that an image of a telescope could have, and the size expected of them.

Raw patterns are products of smooth functions of x and of y (eigenvectors of a Gaussian correlation), times the size of
corrections expected at the place: about that of the profile itself. Every term of the field takes those combinations
of them that carry no light in sum, have no first moment in the core and vanish on the edge in the mean: fluxes,
positions and local skies of the stars would take these up. Their amplitudes have a normal prior of unit width.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from . import splines
from .model import moments

_SMOOTH = 0.4  # FWHM, correlation length: shorter than any structure that a telescope makes
_CUT = (3e-3, 3e-2, 3e-2)  # part of the variance of the largest pattern, below which one is left out, by degree
_SIZE = (1.0, 0.1, 0.1)  # relative to the profile, by degree of the term
_FLOOR = 0.03  # of the peak: expected where the profile has no light, falling with the square of the distance
_REACH = 2.75  # FWHM, half the side of the square that is corrected; at most the stamp


@dataclass(frozen=True, eq=False)
class Corrections:
    """Patterns on the inner knots of a grid, and the combinations that are free.

    Attributes
    ----------
    modes : ndarray, shape (k, k, n_modes)
        Free patterns, as spline coefficients by y and x; those that the smoothest raw ones make come first.
    size : int
        Knots of the whole grid.
    numbers : tuple of int
        For every term of the field, how many of the patterns it has, the first ones.
    sizes : tuple of float
        Expected of their amplitudes, by term.
    """

    modes: np.ndarray
    size: int
    numbers: tuple
    sizes: tuple

    @classmethod
    def around(cls, base, spacing, powers, half, *, per_fwhm=4):
        """Those around a profile.

        Parameters
        ----------
        base : ndarray, shape (n, n)
            Spline coefficients of the profile.
        spacing : float
            Of its knots [pix].
        powers : sequence of tuple
            Powers of x and y of the terms of the field.
        half : int
            Half the side of the stamps.
        per_fwhm : int
            Knots a FWHM.
        """
        n, fwhm = len(base), spacing * per_fwhm
        places = splines.knots(n, spacing)
        inner = np.flatnonzero(np.abs(places) <= min(half + 0.5 + spacing, _REACH * fwhm))
        at = places[inner]
        variance, along = np.linalg.eigh(np.exp(-(((at[:, None] - at) / (_SMOOTH * fwhm)) ** 2) / 2))
        both = np.outer(variance, variance) / variance.max() ** 2
        j, i = np.nonzero(both > min(_CUT))
        order = np.argsort(-both[j, i], kind="stable")
        j, i = j[order], i[order]
        block = base[np.ix_(inner, inner)]
        expected = block + _FLOOR * base.max() / (1 + (at[:, None] ** 2 + at**2) / fwhm**2)
        modes = along[:, None, j] * along[:, i] * expected[:, :, None]
        modes *= np.sqrt(both[j, i]) * variance.max()
        light, core, first = moments(n, spacing, fwhm)[:, inner]
        edge = np.zeros_like(block)
        edge[0], edge[-1], edge[:, 0], edge[:, -1] = 1, 1, 1, 1
        taken = [np.outer(light, light), np.outer(core, first), np.outer(first, core), edge]
        taken = np.tensordot(np.stack(taken), modes, 2)
        taken /= np.linalg.norm(taken, axis=1, keepdims=True)
        degrees = [min(a + b, 2) for a, b in powers]
        raw = [np.count_nonzero(both[j, i] > _CUT[degree]) for degree in degrees]
        free, numbers = np.zeros((len(j), 0)), {}
        for m in sorted(set(raw)):  # what few of them make is part of what more of them make
            more = null_space(np.vstack([taken[:, :m], free[:m].T]))
            free = np.hstack([free, np.pad(more, ((0, len(j) - m), (0, 0)))])
            numbers[m] = free.shape[1]
        return cls(modes @ free, n, tuple(numbers[m] for m in raw), tuple(_SIZE[degree] for degree in degrees))

    @property
    def n_amplitudes(self):
        """Of all terms."""
        return sum(self.numbers)

    def by_term(self, values):
        """Values (n_terms,) repeated for the amplitudes of every term."""
        return np.repeat(values, self.numbers)

    @property
    def _inner(self):
        edge = (self.size - len(self.modes)) // 2
        return slice(edge, self.size - edge)

    def raw(self, amplitudes):
        """Amplitudes (n_amplitudes,) by term and pattern, in the units of the patterns, (n_terms, n_modes)."""
        ends = np.cumsum(self.numbers)[:-1]
        out = np.zeros((len(self.numbers), self.modes.shape[-1]))
        for row, n, size, a in zip(out, self.numbers, self.sizes, np.split(amplitudes, ends), strict=True):
            row[:n] = size * a
        return out

    def reduced(self, raw):
        """The adjoint of `raw`: (..., n_terms, n_modes) to (..., n_amplitudes)."""
        of_terms = enumerate(zip(self.numbers, self.sizes, strict=True))
        return np.concatenate([size * raw[..., t, :n] for t, (n, size) in of_terms], axis=-1)

    def pairs(self):
        """Pairs of terms, the second not after the first, by the number of patterns that these have.

        Returns
        -------
        dict
            ``{(n_first, n_second): (first, second)}``, terms as ndarray of int, shape (n_pairs,).
        """
        first, second = np.tril_indices(len(self.numbers))
        shapes = np.array(self.numbers)[np.column_stack([first, second])]
        same = ((tuple(shape.tolist()), (shapes == shape).all(axis=1)) for shape in np.unique(shapes, axis=0))
        return {shape: (first[of], second[of]) for shape, of in same}

    def normal(self, products):
        """Normal matrix of the amplitudes, its lower half, from those of the patterns for the pairs of terms.

        Parameters
        ----------
        products : dict
            ``{(n_first, n_second): ndarray, shape (n_pairs, n_first, n_second)}``, as `pairs`.

        Returns
        -------
        ndarray, shape (n_amplitudes, n_amplitudes)
        """
        ends = np.cumsum([0, *self.numbers])
        out = np.zeros((ends[-1], ends[-1]))
        for shape, terms in self.pairs().items():
            for t, u, product in zip(*terms, products[shape], strict=True):
                out[ends[t] : ends[t + 1], ends[u] : ends[u + 1]] = self.sizes[t] * self.sizes[u] * product
        return out

    def grids(self, raw):
        """Whole grids (n, size, size) of sums of patterns (n, n_modes)."""
        out = np.zeros((len(raw), self.size, self.size))
        out[:, self._inner, self._inner] = np.moveaxis(self.modes @ raw.T, -1, 0)
        return out

    def on_stamps(self, xy, half, spacing):
        """Patterns on the stamps of stars, (n, npix, n_modes), in the precision of the places."""
        x, y = self._bases(xy, half, spacing)
        k, _, m = self.modes.shape
        along = y @ self.modes.astype(xy.dtype).reshape(k, -1)
        return (x[:, None] @ along.reshape(*y.shape[:2], k, m)).reshape(len(xy), -1, m)

    def against(self, images, xy, half, spacing):
        """Products of images (n, a, npix) on the stamps of stars with the patterns there, (n, a, n_modes)."""
        n, a = images.shape[:2]
        x, y = self._bases(xy, half, spacing)
        size = 2 * half + 1
        laid = y[:, None].swapaxes(2, 3) @ images.reshape(n, a, size, size) @ x[:, None]
        return laid.reshape(n, a, -1) @ self.modes.reshape(-1, self.modes.shape[-1])

    def _bases(self, xy, half, spacing):
        pixels = np.arange(-half, half + 1, dtype=xy.dtype)
        return (splines.basis(pixels - xy[:, i, None], self.size, spacing)[..., self._inner] for i in (0, 1))
