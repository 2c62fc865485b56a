"""Sums over the surroundings of every pixel, with Gaussian weights."""

import numpy as np

_TRUNCATED = 3.0  # standard deviations
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
            _correlate([band[k : k + rows] for k in range(2 * half + 1)], weights[i], i, down[:rows], spare[:rows])
            columns = [down[:rows, k : k + nx] for k in range(2 * half + 1)]
            for sums, (along_y, j) in zip(out, powers, strict=True):
                if along_y == i:
                    _correlate(columns, weights[j], j, sums[first : first + rows], spare[:rows, :nx])
    return out


def gaussian(sigma, power=0):
    """Gaussian weights with the sum 1, times the offset to a power; (2 n + 1,)."""
    half = int(_TRUNCATED * sigma + 0.5)
    offset = np.arange(-half, half + 1)
    weight = np.exp(-0.5 * (offset / sigma) ** 2)
    return weight / weight.sum() * offset**power


def _correlate(shifted, weights, power, out, spare):
    """Sum of weights * images into `out`; the weights are even or odd, as the power is."""
    combine, half = np.subtract if power % 2 else np.add, len(weights) // 2
    np.multiply(shifted[half], weights[half], out=out)
    for k in range(half):
        combine(shifted[-1 - k], shifted[k], out=spare)
        spare *= weights[-1 - k]
        out += spare
