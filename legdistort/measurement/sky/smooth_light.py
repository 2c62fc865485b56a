"""The smooth light around the stars of a frame: halos, unresolved stars."""

import numpy as np

from ..filters import gaussian, gaussian_sums

_BRIGHT = 5.0  # standard deviations of a binned pixel above the light around it: part of a star
_POWERS = (0, 0), (1, 0), (0, 1), (2, 0), (0, 2), (1, 1)  # of y and x, of the moments of a plane


def smooth_light(signal, good, sigma, *, variance=None):
    """The light around every pixel: of the plane fitted to its surroundings, the value at the pixel.

    A plane, because a mean would be wrong on slopes beside edges and gaps. The weights of the fit are Gaussian; it is
    made on pixels binned so that 2 to 4 of them make up `sigma`, and interpolated.

    Parameters
    ----------
    signal : ndarray, shape (ny, nx)
    good : ndarray of bool, shape (ny, nx)
        Pixels that count.
    sigma : float
        Standard deviation of the weights [pix].
    variance : ndarray, shape (ny, nx), optional
        Of a pixel. If given, the fit is made once more without what stands out by `_BRIGHT` standard deviations: the
        cores of stars.

    Returns
    -------
    level : ndarray, shape (ny, nx)
    extrapolated : ndarray, shape (ceil(ny / step), ceil(nx / step))
        By how much the plane differs from a mean, in the binned pixels.
    step : int
        Pixels binned along each axis.
    """
    step, (n, total), whole = _counted(signal, good, sigma)
    level, extrapolated = _planes(n, total, sigma / step, whole=whole)
    if variance is not None:
        faint = total - n * level < _BRIGHT * np.sqrt(n * variance[::step, ::step])
        level, extrapolated = _planes(n * faint, total * faint, sigma / step)
    return spread(level, step, signal.shape), extrapolated, step


def mean_light(signal, good, sigma):
    """Means around binned pixels, with Gaussian weights; and the pixels binned along each axis."""
    step, (n, total), whole = _counted(signal, good, sigma)
    (total,) = gaussian_sums(total, sigma / step)
    weight = _moments(n, sigma / step, 0)[0] if whole else gaussian_sums(n, sigma / step)[0]
    return total / np.maximum(weight, np.finfo(n.dtype).eps), step


def _counted(signal, good, sigma):
    """Pixels binned along each axis; number of good ones and their sum in these bins; whether all are good."""
    step, whole = max(1, int(sigma / 2)), good.all()
    if whole:
        rows, columns = (np.add.reduceat(np.ones(n, signal.dtype), np.arange(0, n, step)) for n in signal.shape)
        return step, (np.outer(rows, columns), binned(signal, step)), whole
    return step, (binned(good.astype(signal.dtype), step), binned(np.where(good, signal, 0), step)), whole


def _moments(n, width, order):
    """`gaussian_sums` of `n` up to an order, where `n` is a product of functions of y and of x."""
    out = []
    for part in (n[:, 0] / n[0, 0], n[0]):
        weights = [gaussian(width, power) for power in range(order + 1)]
        padded = np.pad(part, len(weights[0]) // 2)
        out.append([np.correlate(padded, weight, "valid").astype(n.dtype) for weight in weights])
    return [np.outer(out[0][i], out[1][j]) for i, j in _POWERS if i + j <= order]


def _planes(n, total, width, *, whole=False):
    """Values of planes fitted around all pixels, and how much they differ from means.

    Parameters
    ----------
    n, total : ndarray, shape (ny, nx)
        Number of measurements in a pixel, and their sum.
    width : float
        Standard deviation of the Gaussian weights.
    whole : bool
        Whether no measurement is missing; sums of `n` are then products.
    """
    area = width**2
    weight, *moments = _moments(n, width, 2) if whole else gaussian_sums(n, width, _POWERS)
    weight = 1 / (weight + np.finfo(n.dtype).eps)
    mean, by_y, by_x = (sums * weight for sums in gaussian_sums(total, width, _POWERS[:3]))
    y, x, yy, xx, xy = (moment * weight for moment in moments)
    # never narrower than a quarter of the Gaussian's width: what is left of a star beside a gap determines no slope
    xx, yy = np.maximum(xx - x**2, 0.06 * area), np.maximum(yy - y**2, 0.06 * area)
    xy, by_x, by_y = xy - x * y, by_x - x * mean, by_y - y * mean
    determinant = np.maximum(xx * yy - xy**2, 0.02 * area**2)
    shift = ((yy * by_x - xy * by_y) * x + (xx * by_y - xy * by_x) * y) / determinant
    return mean - shift, np.abs(shift)


def binned(image, step):
    """Sums over squares of pixels, the last ones padded with zeros."""
    ny, nx = image.shape
    if step == 1:
        return image
    if ny % step or nx % step:
        image = np.pad(image, ((0, -ny % step), (0, -nx % step)))
    rows = sum(image[i::step] for i in range(step))
    return sum(rows[:, j::step] for j in range(step))


def spread(image, step, shape):
    """Binned pixels interpolated linearly to all pixels."""
    for n in shape[::-1]:
        padded = np.pad(np.ascontiguousarray(image.T), ((1, 1), (0, 0)), mode="edge")
        image = np.empty((step * (len(padded) - 2), padded.shape[1]), dtype=image.dtype)
        for i in range(step):
            off = (i + 0.5) / step - 0.5  # from the middle of the bin
            beside = padded[2:] if off > 0 else padded[:-2]
            image[i::step] = (1 - abs(off)) * padded[1:-1] + abs(off) * beside
        image = image[:n]
    return image
