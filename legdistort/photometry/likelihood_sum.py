"""Likelihood images of exposures on the reference plane, summed by compiled loops."""

from functools import partial

import numpy as np

from ..coaddition.resampling.compiled_splines import coefficients, cubic, linear, place
from ..runtime.compiling import compiled_loop
from ..runtime.scratch import forget, spill

_UNSEEN = np.float32(-1e30)


def empty_sums(shape, folder=None):
    """Signal and norm (2, ny, nx) of no exposure; ratio, signal, norm of the strongest, and number, (4, ny, nx).

    In the memory, or on the disk of a folder.
    """
    zeros = np.full if folder is None else partial(spill, folder=folder)
    sums, best = (zeros((n, *shape), 0, np.float32) for n in (2, 4))
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


def add_layer(layer, sums, best, rows=256):
    """The likelihood image of a `~legdistort.photometry.joint_scene.Layer` added, so many rows at a time."""
    signal, norm = layer.scene.likelihood()
    norm[norm <= 0] = _UNSEEN
    signal = coefficients(signal)
    ny, nx = sums.shape[1:]
    for start in range(0, ny, rows):
        found = layer.grid_map.piece((slice(start, start + rows), slice(0, nx)), margin=0)
        if found is not None:
            piece, part = found
            piece.xy[0] += part[1].start
            piece.xy[1] += part[0].start
            window = np.s_[:, *piece.window]
            add(signal, norm, piece.xy, piece.inside, layer.transmission, sums[window], best[window])
            for planes in (sums, best):
                forget(planes)
