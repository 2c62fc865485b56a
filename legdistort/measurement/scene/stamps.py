"""Loops over the pixels of square stamps, compiled: between the stars of a scene and its images.

Stamps are ``(n, npix)``, rows first, around central pixels ``(x, y)``, from -half to half; pixels beyond the image do
not count.
"""

import numpy as np

from ...runtime.compiling import compiled_loop

_ANY_ORDER = {"reassoc", "contract"}  # of terms in a sum: more of them at a time
_STRIP = 512  # columns at a time: as many rows of them as a kernel has stay in the processor's cache


def stamp_pixels(centres, half, shape):
    """Flat indices of the pixels of stamps, and whether they lie in the image; (n, npix)."""
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    x, y = centres[:, :1] + dx, centres[:, 1:] + dy
    inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
    return np.clip(y, 0, shape[0] - 1) * shape[1] + np.clip(x, 0, shape[1] - 1), inside


@compiled_loop(nogil=True)
def _columns(x, half, nx):
    """Columns of an image that a stamp meets, and that of the stamp in the first of them."""
    first, last = max(x - half, 0), min(x + half + 1, nx)
    return first, last, first - x + half


@compiled_loop(nogil=True)
def lay(image, stamps, centres, half, sign):
    """Stamps times a sign added to an image."""
    side = 2 * half + 1
    ny, nx = image.shape
    for n in range(len(centres)):
        x, y = centres[n]
        first, last, start = _columns(x, half, nx)
        for row in range(max(y - half, 0), min(y + half + 1, ny)):
            at = (row - y + half) * side + start - first
            for k in range(first, last):
                image[row, k] += sign * stamps[n, at + k]


@compiled_loop(nogil=True, fastmath=_ANY_ORDER)
def weigh(slopes, centres, half, weights, left):
    """Slopes (n, k, npix) brought to units of the noise, 0 in the corners; their products with what is left, (n, k).

    Parameters
    ----------
    weights : ndarray, shape (ny, nx)
        Inverse variances.
    left : tuple of ndarray, shape (ny, nx)
        What is left: of some images the first without the others.
    """
    (n_stars, n_slopes, n_pixels), (ny, nx), side = slopes.shape, weights.shape, 2 * half + 1
    out, root, rest = np.zeros((n_stars, n_slopes)), np.zeros(n_pixels, np.float32), np.zeros(n_pixels, np.float32)
    for n in range(n_stars):
        x, y = centres[n]
        root[:] = 0
        for i in range(side):
            row, width = y + i - half, int(np.sqrt((half + 0.5) ** 2 - (i - half) ** 2))
            if 0 <= row < ny:
                at = i * side - x + half
                for k in range(max(x - width, 0), min(x + width + 1, nx)):
                    value = left[0][row, k]
                    for q in range(1, len(left)):
                        value -= left[q][row, k]
                    root[at + k] = np.sqrt(weights[row, k])
                    rest[at + k] = value * root[at + k]
        for p in range(n_slopes):
            own, total = slopes[n, p], np.float32(0)
            for k in range(n_pixels):
                own[k] *= root[k]
                total += own[k] * rest[k]
            out[n, p] = total
    return out


@compiled_loop(nogil=True, fastmath=_ANY_ORDER)
def squared_ratios(own, centres, half, weights):
    """Squared signal-to-noise ratios of stars of which nothing but the flux is unknown, from their light; (n,)."""
    side = 2 * half + 1
    ny, nx = weights.shape
    out = np.zeros(len(centres))
    for n in range(len(centres)):
        x, y = centres[n]
        first, last, start = _columns(x, half, nx)
        for row in range(max(y - half, 0), min(y + half + 1, ny)):
            at = (row - y + half) * side + start - first
            total = np.float32(0)
            for k in range(first, last):
                total += weights[row, k] * own[n, at + k] ** 2
            out[n] += total
    return out


@compiled_loop(nogil=True)
def cores(own, params, centres, half, radius, planes):
    """Means over the cores of stars, weighted with their light.

    Parameters
    ----------
    own : ndarray, shape (n, npix)
        Their light.
    params : ndarray, shape (n, 3)
        x, y from the central pixels.
    radius : float
        Of the cores.
    planes : tuple of ndarray, shape (ny, nx)
        Weights, good pixels, signal, and what is taken off it, twice.

    Returns
    -------
    ndarray, shape (n, 2)
        Of the squared residual in units of the noise, and of the squared signal-to-noise ratio of a pixel.
    """
    weights, good, signal, sky, light = planes
    side, reach = 2 * half + 1, min(half, int(radius) + 1)
    ny, nx = weights.shape
    out = np.zeros((len(centres), 2))
    for n in range(len(centres)):
        x, y = centres[n]
        first, last, start = _columns(x, half, nx)
        total = 0.0
        for row in range(max(y - reach, 0), min(y + reach + 1, ny)):
            at, v = (row - y + half) * side + start - first, (row - y - params[n, 1]) ** 2
            for k in range(first, last):
                star = own[n, at + k]
                if star > 0 and v + (k - x - params[n, 0]) ** 2 <= radius * radius and good[row, k]:
                    total += star
                    weight = weights[row, k] * star
                    out[n, 0] += weight * (signal[row, k] - sky[row, k] - light[row, k]) ** 2
                    out[n, 1] += weight * star * star
        out[n] /= max(total, 1e-30)
    return out


@compiled_loop(nogil=True, fastmath=_ANY_ORDER)
def products(slopes, centres, half, i, j):
    """Sums over common pixels of the products of the slopes (n, k, npix) of pairs of stars (i, j); (m, k, k)."""
    n_slopes, side = slopes.shape[1], 2 * half + 1
    out = np.zeros((len(i), n_slopes, n_slopes), dtype=slopes.dtype)
    for m in range(len(i)):
        one, other = slopes[i[m]], slopes[j[m]]
        dx, dy = centres[i[m], 0] - centres[j[m], 0], centres[i[m], 1] - centres[j[m], 1]
        for row in range(max(-dy, 0), min(side - dy, side)):
            here, there = row * side, (row + dy) * side + dx
            for p in range(n_slopes):
                for q in range(n_slopes):
                    total = slopes.dtype.type(0)
                    for k in range(max(-dx, 0), min(side - dx, side)):
                        total += one[p, here + k] * other[q, there + k]
                    out[m, p, q] += total
    return out


@compiled_loop(nogil=True)
def inverse_variances(good, variance, light, sky, photon, least, misfit, out, boxes):
    """Inverse variances of pixels (`legdistort.measurement.profiles.pixel_noise.pixel_variance`), 0 for bad ones.

    Parameters
    ----------
    good, variance, light, sky : ndarray, shape (ny, nx)
        The variance is that without photons of stars; the sky is light beside that which was taken off.
    photon, least : float
        Variance per unit of light, and part of the variance that is left, at least.
    misfit : float
        Error of the light, relative.
    out : ndarray, shape (ny, nx)
    boxes : ndarray of int, shape (n, 4)
        First row and column, and those behind the last, of the parts that are wanted.
    """
    for top, left, bottom, right in boxes:
        for i in range(top, bottom):
            for k in range(left, right):
                one = max(variance[i, k] + photon * (light[i, k] + sky[i, k]), least * variance[i, k])
                out[i, k] = good[i, k] / (one + (misfit * light[i, k]) ** 2)


@compiled_loop(nogil=True)
def _add_four(out, image, f0, f1, f2, f3):
    for k in range(len(out)):
        out[k] += f0 * image[k] + f1 * image[k + 1] + f2 * image[k + 2] + f3 * image[k + 3]


@compiled_loop(nogil=True)
def _correlate(image, kernel, out):
    (ny, nx), (rows, columns) = out.shape, kernel.shape
    for x in range(0, nx, _STRIP):
        n = min(_STRIP, nx - x)
        for y in range(ny):
            sums = out[y, x : x + n]
            sums[:] = 0
            for i in range(rows):
                f = kernel[i]
                for k in range(0, columns, 4):
                    _add_four(sums, image[y + i, x + k : x + k + n + 3], f[k], f[k + 1], f[k + 2], f[k + 3])


def correlate(image, kernel):
    """Sums over the surroundings of every pixel, with a square kernel as weights; the image is 0 outside."""
    half, more = len(kernel) // 2, -len(kernel) % 4
    out = np.empty_like(image)
    _correlate(np.pad(image, ((half, half), (half, half + more))), np.pad(kernel, ((0, 0), (0, more))), out)
    return out
