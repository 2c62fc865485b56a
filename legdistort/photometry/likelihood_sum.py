"""Likelihood images of exposures on the reference plane, summed by compiled loops."""

import numpy as np

from ..coaddition.resampling.compiled_splines import coefficients, cubic, linear, place
from ..runtime.compiling import compiled_loop

_UNSEEN = np.float32(-1e30)
_MARGIN = 8  # pixels around a piece of an image: a sample is to a coefficient so far away 3e-5 of what it is to its own


def empty_sums(shape):
    """Signal and norm (2, ny, nx) of no exposure; ratio, signal, norm of the strongest, and number, (4, ny, nx)."""
    sums, best = (np.zeros((n, *shape), np.float32) for n in (2, 4))
    best[0] = -np.inf
    return sums, best


@compiled_loop(nogil=True)
def add(signal, norm, xy, inside, transmission, sums, best):
    """The likelihood image of an exposure added to those of others.

    Parameters
    ----------
    signal : ndarray, shape (ny, nx)
        Coefficients of the cubic spline through it (`legdistort.coaddition.resampling.compiled_splines.coefficients`).
    norm : ndarray, shape (ny, nx)
        Interpolated linearly; where that is not above 0 the exposure sees nothing.
    xy : ndarray, shape (2, my, mx)
        Its pixels.
    inside : ndarray of bool, shape (my, mx)
    transmission : float
    sums, best : ndarray, shape (2, my, mx), (4, my, mx)
        From `empty_sums`.
    """
    ny, nx = signal.shape
    for r in range(inside.shape[0]):
        for k in range(inside.shape[1]):
            if not inside[r, k]:
                continue
            (j, u), (i, v) = place(xy[0, r, k], nx), place(xy[1, r, k], ny)
            if i < 0 or j < 0:
                continue
            n = transmission * transmission * linear(norm, i, j, u, v)
            if not n > 0:
                continue
            s = transmission * cubic(signal, i, j, u, v)
            sums[0, r, k] += s
            sums[1, r, k] += n
            best[3, r, k] += 1
            ratio = s / np.sqrt(n)
            if ratio > best[0, r, k]:
                best[0, r, k], best[1, r, k], best[2, r, k] = ratio, s, n


def add_layer(layer, part, sums, best):
    """The likelihood image of a `~legdistort.photometry.joint_scene.Layer` added, on some rows and columns."""
    found = layer.grid_map.piece(part, margin=_MARGIN)
    if found is None:
        return
    piece, pixels = found
    signal, norm = layer.scene.likelihood(pixels)
    if min(signal.shape) < 2:
        return
    norm[norm <= 0] = _UNSEEN
    window = np.s_[:, *(slice(w.start - p.start, w.stop - p.start) for w, p in zip(piece.window, part, strict=True))]
    add(coefficients(signal), norm, piece.xy, piece.inside, layer.transmission, sums[window], best[window])
