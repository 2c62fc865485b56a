"""Sums over the surroundings of every pixel, with Gaussian weights."""

import numpy as np

_TRUNCATED = 3.0  # standard deviations
#: Pixels of all frames from which compiled loops are used; below, loading numba takes longer than it saves.
COMPILED_FROM = 1 << 24
_loops = None  # the compiled ones, if there were so many
_ROWS = 64  # of an image at a time: they stay in the cache, and it takes a third of the time of scipy.ndimage


def gaussian_sums(image, sigma, powers=((0, 0),)):
    """Sums of weight * image * y**i * x**j around every pixel, (x, y) being offsets from it; the image is 0 outside.

    Parameters
    ----------
    image : ndarray of float, shape (ny, nx)
    sigma : float
        Standard deviation of the weights [pix], whose sum is 1.
    powers : sequence of (int, int)
        Pairs (i, j).

    Returns
    -------
    list of ndarray, shape (ny, nx)
    """
    (ny, nx), dtype = image.shape, image.dtype
    weights = {power: gaussian(sigma, power).astype(dtype) for power in {power for pair in powers for power in pair}}
    half = len(gaussian(sigma)) // 2
    band, down = np.zeros((_ROWS + 2 * half, nx + 2 * half), dtype), np.empty((_ROWS, nx + 2 * half), dtype)
    out, spare = [np.empty_like(image, order="C") for _ in powers], np.empty_like(down)
    for first in range(0, ny, _ROWS):
        begin, end = max(0, first - half), min(ny, first + _ROWS + half)
        band[: begin - first + half] = band[end - first + half :] = 0
        band[begin - first + half : end - first + half, half : half + nx] = image[begin:end]
        rows = min(_ROWS, ny - first)
        for i in sorted({i for i, _ in powers}):
            _correlate(band[: rows + 2 * half], weights[i], True, down[:rows], spare[:rows])
            for sums, (along_y, j) in zip(out, powers, strict=True):
                if along_y == i:
                    _correlate(down[:rows], weights[j], False, sums[first : first + rows], spare[:rows, :nx])
    return out


def gaussian(sigma, power=0):
    """Gaussian weights with the sum 1, times the offset to a power; (2 n + 1,)."""
    half = int(_TRUNCATED * sigma + 0.5)
    offset = np.arange(-half, half + 1)
    weight = np.exp(-0.5 * (offset / sigma) ** 2)
    return weight / weight.sum() * offset**power


def _correlate(image, weights, down, out, spare):
    """Sum of weights * images, each a pixel further down or to the right, into `out`; the weights are even or odd."""
    half = len(weights) // 2
    odd, (rows, n) = weights[0] != weights[-1], out.shape
    if _loops is not None:
        _loops(image, weights, odd, down, out)
        return
    shifted = [image[k : k + rows] if down else image[:, k : k + n] for k in range(2 * half + 1)]
    np.multiply(shifted[half], weights[half], out=out)
    for k in range(half):
        (np.subtract if odd else np.add)(shifted[-1 - k], shifted[k], out=spare)
        spare *= weights[-1 - k]
        out += spare


def use_compiled_loops(n_pixels):
    """Compiled loops from now on, in this process and its copies, if it pays to load numba for so many pixels.

    They give the same numbers to the last bit, in a third of the time.
    """
    global _loops
    if n_pixels >= COMPILED_FROM and _loops is None:
        from ..runtime.compiling import compiled_loop

        _loops = compiled_loop(nogil=True)(_to_be_compiled)


def _to_be_compiled(image, weights, odd, down, out):
    half, n = len(weights) // 2, out.shape[1]
    for r in range(out.shape[0]):
        sums, middle = out[r], image[r + half] if down else image[r, half : half + n]
        for c in range(n):
            sums[c] = middle[c] * weights[half]
        for k in range(half):
            last = 2 * half - k
            before = image[r + k] if down else image[r, k : k + n]
            behind = image[r + last] if down else image[r, last : last + n]
            if odd:
                for c in range(n):
                    sums[c] += (behind[c] - before[c]) * weights[last]
            else:
                for c in range(n):
                    sums[c] += (behind[c] + before[c]) * weights[last]


def fill_bad(data, bad, radius=2, *, of=None):
    """Bad pixels replaced by a weighted mean of the good ones near by, or the median of all good ones.

    Parameters
    ----------
    data : ndarray, shape (ny, nx)
    bad : ndarray of bool, shape (ny, nx)
    radius : int
        Of what is near by [pix].
    of : ndarray of bool, shape (ny, nx), optional
        Those of the bad pixels that are replaced; by default all.

    Returns
    -------
    ndarray
        The data themselves if there is nothing to replace.
    """
    if not bad.any():
        return data
    (y, x), (ny, nx) = np.nonzero(bad if of is None else of), bad.shape
    total, norm = np.zeros(len(x)), np.zeros(len(x))
    for dy, dx in np.ndindex(2 * radius + 1, 2 * radius + 1):
        near = np.clip(y + dy - radius, 0, ny - 1), np.clip(x + dx - radius, 0, nx - 1)
        weight = np.exp(-((dy - radius) ** 2 + (dx - radius) ** 2) / 2) * ~bad[near]
        total += weight * np.where(weight > 0, data[near], 0)
        norm += weight
    lonely = norm == 0
    out = data.copy()
    out[y, x] = total / np.where(lonely, 1, norm)
    if lonely.any():
        out[y[lonely], x[lonely]] = np.median(data[~bad])
    return out
