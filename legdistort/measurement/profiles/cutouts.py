"""Cut-outs around all stars of a frame, and the models of the stars laid over each other."""

import numpy as np

from . import moffat

_CHUNK = 200  # stars: their models stay in the processor's cache


def box_half(fwhm):
    """Half the side of the box fitted, without the central pixel."""
    return max(4, int(np.ceil(2 * fwhm)))


class Stamps:
    """Square cut-outs around integer positions, and models of all stars laid over each other.

    Parameters
    ----------
    frame : `~legdistort.measurement.detection.Frame`
    centres : ndarray of int, shape (n, 2)
        Central pixels (x, y).
    half : int
        Stamps reach from -half to half; models of neighbours twice as far.
    """

    def __init__(self, frame, centres, half):
        self.frame, self.centres, self.half = frame, centres, half
        self.index, self.inside = self._pixels()
        offsets = np.abs(np.arange(-2 * half, 2 * half + 1)) <= half
        self.core = np.flatnonzero(offsets[:, None] & offsets)
        self.data = self.cut(frame.signal)
        self.variance = self.cut(frame.variance)
        self.saturated = self.cut(frame.saturated) & self.inside
        self.defects = np.zeros_like(self.inside) if frame.defects is None else self.cut(frame.defects) & self.inside
        self.good = self.cut(frame.good) & self.inside & ~self.saturated & ~self.defects

    def _pixels(self):
        (ny, nx), half = self.frame.signal.shape, self.half
        dy, dx = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
        x, y = self.centres[:, :1] + dx, self.centres[:, 1:] + dy
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        return np.clip(y, 0, ny - 1) * nx + np.clip(x, 0, nx - 1), inside

    def cut(self, image):
        """Values of an image in the stamps, (n, npix)."""
        return image.ravel()[self.index]

    def models(self, params, nodes):
        """Every star on its own stamp, and the sum of all others there; (n, npix) each."""
        params = params.astype(self.data.dtype)
        own, total = np.empty_like(self.data), np.zeros_like(self.frame.signal)
        core = np.empty_like(own)  # what the star adds to the sum on its own stamp
        for i in range(0, len(params), _CHUNK):
            rows = slice(i, i + _CHUNK)
            own[rows] = moffat.evaluate(params[rows], self.half, nodes)
            # far from the centre pixels need no integration
            wide = moffat.evaluate(params[rows], 2 * self.half, moffat.CENTRES)
            wide[:, self.core] = own[rows]
            # a fit that has wandered off, from a saturated trail, stands for the light of another star
            wandered = np.abs(params[rows, :2]).max(axis=1) > self.half / 2
            wide[(params[rows, 2] <= 0) | wandered] = 0
            core[rows] = wide[:, self.core]
            self.add_to(total, wide, rows)
        return own, np.where(self.inside, self.cut(total) - core, 0)

    def add_to(self, image, light, rows):
        """Add the light of some stars, (m, npix) on stamps twice as wide, to an image (ny, nx)."""
        reach = 2 * self.half
        side = 2 * reach + 1
        for (x, y), one in zip(self.centres[rows].tolist(), light.reshape(-1, side, side), strict=True):
            left, low = max(x - reach, 0), max(y - reach, 0)
            part = image[low : y + reach + 1, left : x + reach + 1]
            from_x, from_y = left - x + reach, low - y + reach
            part += one[from_y : from_y + part.shape[0], from_x : from_x + part.shape[1]]

    def near(self, params, radius):
        """Pixels within a radius of the fitted centres, (n, npix)."""
        dy, dx = np.mgrid[-self.half : self.half + 1, -self.half : self.half + 1].reshape(2, -1)
        return np.hypot(dx - params[:, :1], dy - params[:, 1:2]) <= np.maximum(radius, 0.8)
