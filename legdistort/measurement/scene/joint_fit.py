"""All stars of a frame fitted together with one PSF: sparse normal equations of positions and fluxes."""

from functools import partial

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from ..filters import gaussian_sums
from ..profiles.pixel_noise import pixel_variance

_KIND = np.float32  # of the light of stars: photons bound the ratio of signal to noise of a pixel
_CHUNK = 200  # stars: their light stays in the processor's cache
_SEEN = 0.02  # standard deviations of the sky: light of a star below that is left out
_LONGEST = 0.25  # FWHM, a step of a position
_SETTLED = 0.05  # standard deviations: a star that moves by less stays
_DAMPING = 1e-4
_NEAR = 1.5  # FWHM: what moves within it moves a star
_SKY = 3.0  # FWHM, standard deviation of the weights of the local sky: as many pixels as a stamp for a sky of its own
_OUTLIER = 3.0  # standard deviations, of pixels in the sky
_LEAST = 0.2  # of a change of the sky that stars leave, at least
_NEIGHBOURS = 10  # of a star, whose errors are part of its own
_BRIGHT = 20.0  # signal-to-noise ratio of stars that show how good the PSF is
_CORE = 1.3  # FWHM, radius of a core


class Scene:
    """The stars of a frame, their light and what the frame has beside it.

    Parameters
    ----------
    frame : `~legdistort.measurement.detection.Frame`
        Its variance is that of the sky alone.
    psf : `~legdistort.measurement.scene.moffat_field.MoffatField` or `EffectivePSF`
        What all stars share.
    half : int
        Half the side of the stamps on which stars are fitted; their light is subtracted farther out.
    photon : float
        Variance per unit of light.

    Attributes
    ----------
    xy, flux : ndarray, shape (n, 2), (n,)
        Of the stars; positions [pix] count from the middle of the PSF.
    sky : ndarray, shape (ny, nx)
        Smooth light beside that of the stars, and that which was taken off before.
    light : ndarray, shape (ny, nx)
        Of all stars.
    weights : ndarray, shape (ny, nx)
        Inverse variances of the pixels, 0 for those that do not count.
    misfit : float
        Part of its light by which a star may deviate from the PSF.
    """

    def __init__(self, frame, psf, half, photon):
        self.frame, self.half, self.photon, self.misfit = frame, half, photon, 0.0
        self.good = frame.good & ~frame.saturated
        if frame.defects is not None:
            self.good &= ~frame.defects
        self.xy, self.flux = np.zeros((0, 2)), np.zeros(0)
        self.sky = np.zeros(frame.signal.shape, dtype=np.float32)
        self.noise = float(np.sqrt(np.median(frame.variance[::8, ::8])))
        self.use(psf)

    def use(self, psf):
        """Another PSF from now on."""
        unit = self.unit(psf, 2 * self.half)
        if len(self.flux):  # the same centres and heights
            self.xy = self.xy + self.psf.centre(self.xy) - psf.centre(self.xy)
            self.flux = self.flux * self.unit(self.psf, 0).max() / unit.max()
        self.psf = psf
        edges = [np.abs(unit[row]).max() for row in (self.half, 0)]  # of stamps, and of ones twice as wide
        self._faint = _SEEN * self.noise / np.maximum(edges, 1e-30)
        self.render()

    def unit(self, psf, half):
        """A star of unit flux in the middle of the frame, (2 half + 1, 2 half + 1)."""
        return psf.light(np.array([[0.0, 0.0, 1.0]]), self.middle, half).reshape(2 * half + 1, -1)

    @property
    def middle(self):
        """The pixel in the middle of the frame, (1, 2)."""
        return np.array([self.frame.signal.shape[::-1]]) // 2

    def render(self):
        """The light of all stars made anew."""
        self.light = self.light_of(np.arange(len(self.flux)))
        self.weigh()

    def light_of(self, rows):
        """The light of some stars, (ny, nx)."""
        image = np.zeros(self.frame.signal.shape)
        self._add(rows, 1, image)
        return image

    def weigh(self):
        """Weights made anew, by the light that there is now."""
        variance = pixel_variance((self.frame.variance, self.photon), (self.light + self.sky).astype(np.float32))
        if self.misfit:
            variance = variance + np.square(self.misfit * self.light, dtype=np.float32)
        self.weights = np.where(self.good, 1 / variance, np.float32(0))

    def update_misfit(self):
        """The misfit that bright stars show, and weights with it."""
        self.misfit = 0.0
        self.weigh()
        snr, (chi2, lever) = self.snr(), self.core_chi2(lever=True)
        order = np.argsort(-snr, kind="stable")
        order = order[(snr[order] > _BRIGHT) & (lever[order] > 0)]  # of saturated ones it may be 0
        rows = order[: max(len(order) // 3, 1)]
        if len(rows):
            self.misfit = float(np.sqrt(max(np.median((chi2 - 1)[rows] / lever[rows]), 0.0)))
            self.weigh()

    @property
    def residual(self):
        """What stars and sky leave, (ny, nx)."""
        return self.frame.signal - self.sky - self.light

    def update_sky(self):
        """The sky changed by what is left around every pixel, over what a change leaves once the stars follow."""
        sigma, weights = _SKY * self.psf.fwhm, self.weights
        root = np.sqrt(weights)
        left = root * np.clip(root * self.residual, -_OUTLIER, _OUTLIER)  # a blend that has passed for a star is no sky
        left, norm = (gaussian_sums(image.astype(np.float32), sigma)[0] for image in (left, weights))
        norm = np.maximum(norm, 1e-3 * norm.max())
        if len(self.flux):
            jacobian = self.jacobian(np.arange(len(self.flux)))
            normal, right = (jacobian.T @ jacobian).tocsc(), jacobian.T @ np.sqrt(weights, dtype=float).ravel()
            taken = jacobian @ _solved(normal, right, np.sqrt(np.maximum(normal.diagonal(), 1e-30)))
            taken = (np.sqrt(weights) * taken.reshape(weights.shape)).astype(np.float32)
            norm = np.maximum(norm - gaussian_sums(taken, sigma)[0], _LEAST * norm)
        self.sky += left / norm

    def on_stamps(self, rows):
        """Of some stars `stars`, and the flat indices of the pixels of their stamps and which lie in the image."""
        params, centres = self.stars(rows)
        return params, centres, *stamp_pixels(centres, self.half, self.light.shape)

    def add(self, xy, flux):
        """More stars."""
        rows = np.arange(len(self.flux), len(self.flux) + len(flux))
        self.xy, self.flux = np.vstack([self.xy, xy]), np.append(self.flux, flux)
        self._add(rows, 1)

    def remove(self, rows):
        """Stars taken off; a mask (n,)."""
        self._add(np.flatnonzero(rows), -1)
        self.xy, self.flux = self.xy[~rows], self.flux[~rows]

    def set(self, rows, xy, flux):
        """Other positions and fluxes of some stars."""
        self._add(rows, -1)
        self.xy[rows], self.flux[rows] = xy, flux
        self._add(rows, 1)

    def stars(self, rows):
        """x and y from their central pixels and flux of some stars, (n, 3), and these pixels, (n, 2)."""
        centres = np.round(self.xy[rows]).astype(int)
        return np.column_stack([self.xy[rows] - centres, self.flux[rows]]), centres

    def _add(self, rows, sign, image=None):
        """The light of some stars added to that of all, or to an image, as far as it is seen."""
        image = self.light if image is None else image
        reach = (self.flux[rows, None] > self._faint).sum(axis=1)
        for k, width in enumerate((1, 2, 4)):
            some = rows[reach == k]
            for i in range(0, len(some), _CHUNK):
                params, centres = self.stars(some[i : i + _CHUNK])
                light = self.psf.light(params.astype(_KIND), centres, width * self.half)
                lay(image, sign * light, centres, width * self.half)

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
            step = _solved(normal, right, scale).reshape(-1, 3)
            moved = np.abs(step * scale.reshape(-1, 3)).max(axis=1)
            length = np.hypot(*step[:, :2].T)
            step[:, :2] *= np.minimum(1, _LONGEST * self.psf.fwhm / np.maximum(length, 1e-30))[:, None]
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
        return cKDTree(self.xy[stars]).query(self.xy, distance_upper_bound=_NEAR * self.psf.fwhm)[0] < np.inf

    def equations(self, rows):
        """Normal matrix (3 m, 3 m) and right side of some stars' x, y and flux, sparse."""
        jacobian, root = self.jacobian(rows), np.sqrt(self.weights, dtype=float).ravel()
        return (jacobian.T @ jacobian).tocsc(), jacobian.T @ (root * self.residual.ravel())

    def jacobian(self, rows):
        """Slopes of all pixels by some stars' x, y and flux, in units of their noise; sparse (n pixels, 3 m)."""
        (ny, nx), grid = self.frame.signal.shape, np.arange(-self.half, self.half + 1)
        circle = np.flatnonzero(
            np.hypot(grid, grid[:, None]) <= self.half + 0.5
        )  # corners say little, and cost a fifth
        root, size = np.sqrt(self.weights, dtype=float).ravel(), len(circle)
        values, index = np.empty((len(rows), 3, size)), np.empty((len(rows), 3, size), dtype=np.int32)
        for i in range(0, len(rows), _CHUNK):
            part = slice(i, i + _CHUNK)
            params, centres = self.stars(rows[part])
            pixels, inside = stamp_pixels(centres, self.half, (ny, nx))
            _, slopes = self.psf.light(params.astype(_KIND), centres, self.half, slopes=True)
            weights = np.where(inside, root[pixels], 0)[:, None, circle]
            values[part], index[part] = slopes[..., circle] * weights, pixels[:, None, circle]
        ends = np.arange(3 * len(rows) + 1) * size
        return csc_array((values.ravel(), index.ravel(), ends), shape=(ny * nx, 3 * len(rows)))

    def covariance(self):
        """Covariance of x, y and flux of every star, those of its neighbours unknown too; (n, 3, 3)."""
        n = len(self.flux)
        rows = np.arange(n)
        blocks = self.equations(rows)[0].tobsr((3, 3))
        k = min(_NEIGHBOURS + 1, n)
        near = cKDTree(self.xy).query(self.xy, k=np.arange(1, k + 1), distance_upper_bound=2.5 * self.psf.fwhm)[1]
        near[:, 0] = rows  # of stars that coincide, too
        real = near < n
        real[:, 1:] &= near[:, 1:] != rows[:, None]
        blocks.sort_indices()
        keys = np.repeat(rows, np.diff(blocks.indptr)) * n + blocks.indices
        out = np.empty((n, 3, 3))
        for i in range(0, n, _CHUNK):
            some, there = near[i : i + _CHUNK], real[i : i + _CHUNK]
            pairs = np.where(there, some, 0)
            asked = pairs[:, :, None] * n + pairs[:, None]
            at = np.minimum(np.searchsorted(keys, asked), len(keys) - 1)
            found = (keys[at] == asked) & there[:, :, None] & there[:, None]
            matrix = np.where(found[..., None, None], blocks.data[at], 0.0)
            matrix = matrix.swapaxes(2, 3).reshape(len(some), 3 * k, 3 * k)
            diagonal = np.arange(3 * k)
            matrix[:, diagonal, diagonal] += np.repeat(~there, 3, axis=1)
            scale = np.sqrt(np.maximum(matrix[:, diagonal, diagonal], 1e-30))
            matrix /= scale[:, :, None] * scale[:, None]
            matrix[:, diagonal, diagonal] += 1e-9
            inverse = np.linalg.inv(matrix)[:, :3, :3]
            out[i : i + _CHUNK] = inverse / (scale[:, :3, None] * scale[:, None, :3])
        return out

    def snr(self):
        """Signal-to-noise ratio of the stars where nothing but their flux is unknown, (n,)."""
        return self._over_stamps(lambda own, pixels, near: (self.weights.ravel()[pixels] * own**2).sum(axis=1)) ** 0.5

    def core_chi2(self, *, lever=False):
        """Mean squared residual in units of the noise, weighted with the PSF, in the core of every star; (n,).

        With `lever` also the same mean of the squared signal-to-noise ratio of the pixels.
        """
        square, weights, good = (self.weights * self.residual**2).ravel(), self.weights.ravel(), self.good.ravel()

        def mean(values, own, pixels, near):
            core = np.maximum(own, 0) * near * good[pixels]
            return (core * values(own, pixels)).sum(axis=1) / np.maximum(core.sum(axis=1), 1e-30)

        chi2 = self._over_stamps(partial(mean, lambda own, pixels: square[pixels]))
        if not lever:
            return chi2
        return chi2, self._over_stamps(partial(mean, lambda own, pixels: weights[pixels] * own**2))

    def chi2_around(self, places):
        """Sum of the squared residuals in units of the noise within a core of some places; (n,)."""
        centres = np.round(places).astype(int)
        pixels, inside = stamp_pixels(centres, self.half, self.light.shape)
        square = (self.weights * self.residual**2).ravel()[pixels]
        return (square * inside * self.near(places - centres)).sum(axis=1)

    def _over_stamps(self, function):
        out = np.zeros(len(self.flux))
        for i in range(0, len(out), _CHUNK):
            params, centres = self.stars(np.arange(i, min(i + _CHUNK, len(out))))
            pixels, inside = stamp_pixels(centres, self.half, self.frame.signal.shape)
            own = np.where(inside, self.psf.light(params.astype(_KIND), centres, self.half), 0)
            out[i : i + _CHUNK] = function(own, pixels, self.near(params))
        return out

    def near(self, params):
        """Pixels of stamps within the core of a star, (n, npix)."""
        dy, dx = np.mgrid[-self.half : self.half + 1, -self.half : self.half + 1].reshape(2, -1)
        return np.hypot(dx - params[:, :1], dy - params[:, 1:2]) <= _CORE * self.psf.fwhm


def _solved(normal, right, scale):
    """Damped normal equations solved in units of their diagonal."""
    inverse = diags_array(1 / scale)
    scaled = (inverse @ normal @ inverse + _DAMPING * diags_array(np.ones(len(scale)))).tocsc()
    factors = splu(scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factors.solve(right / scale) / scale


def stamp_pixels(centres, half, shape):
    """Flat indices of the pixels of stamps, and whether they lie in the image; (n, npix)."""
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    x, y = centres[:, :1] + dx, centres[:, 1:] + dy
    inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
    return np.clip(y, 0, shape[0] - 1) * shape[1] + np.clip(x, 0, shape[1] - 1), inside


def lay(image, light, centres, half):
    """Stamps (n, npix) around pixels added to an image."""
    side = 2 * half + 1
    for (x, y), one in zip(centres.tolist(), light.reshape(-1, side, side), strict=True):
        left, low = max(x - half, 0), max(y - half, 0)
        part = image[low : max(y + half + 1, 0), left : max(x + half + 1, 0)]
        from_x, from_y = left - x + half, low - y + half
        part += one[from_y : from_y + part.shape[0], from_x : from_x + part.shape[1]]
