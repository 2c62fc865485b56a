"""All stars of a frame fitted together with one PSF: sparse normal equations of positions and fluxes."""

from dataclasses import replace

import numpy as np

from ..detection import peaks_above
from ..filters import gaussian_sums
from ..profiles.pixel_noise import LEAST_SKY
from ..sky.smooth_light import binned, spread
from . import stamps
from .extended import spread_light
from .normal_equations import JointFit, assembled, normal_blocks, normal_matrix, solved

_KIND = np.float32  # of the light of stars: photons bound the ratio of signal to noise of a pixel
_CHUNK = 200  # stars: their light stays in the processor's cache
_SEEN = 0.02  # standard deviations of the sky: light of a star below that is left out
_SKY = 3.0  # FWHM, standard deviation of the weights of the local sky: as many pixels as a stamp for a sky of its own
_OUTLIER = 3.0  # standard deviations, of pixels in the sky
_LEAST = 0.2  # of a change of the sky that stars leave, at least
_BRIGHT = 20.0  # signal-to-noise ratio of stars that show how good the PSF is
_CORE = 1.3  # FWHM, radius of a core
_COVERED = 0.2  # part of a star, by its weight in the detection, on good pixels
_KERNEL = 1.3  # FWHM, radius of what is looked for
_SPARSE = 4  # of so many rows and columns one tells the median weight


class Scene(JointFit):
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
    spread : ndarray, shape (n, 2, 2)
        Of sources wider than stars, as of `legdistort.measurement.scene.extended.spread_light`; 0 for stars.
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
        self.xy, self.flux, self.spread = np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2))
        self.sky, self.light, self.weights = (np.zeros(frame.signal.shape, dtype=_KIND) for _ in range(3))
        self.noise = float(np.sqrt(np.median(frame.variance[::8, ::8])))
        self.use(psf)

    def planes(self):
        """Images of one value a pixel; some may be None."""
        frame = self.frame
        own = self.sky, self.light, self.weights, self.good
        return *own, frame.signal, frame.variance, frame.good, frame.saturated, frame.defects

    def replace_planes(self, function):
        """What a function makes of every one of the `planes` in their places."""
        self.sky, self.light, self.weights, self.good, *rest = map(function, self.planes())
        names = "signal", "variance", "good", "saturated", "defects"
        self.frame = replace(self.frame, **dict(zip(names, rest, strict=True)))

    def use(self, psf, *, render=True):
        """Another PSF from now on; without `render` the light of stars is as before, until it is made anew."""
        unit = self.unit(psf, 2 * self.half)
        if len(self.flux):  # the same centres and heights
            self.xy = self.xy + self.psf.centre(self.xy) - psf.centre(self.xy)
            self.flux = self.flux * self.unit(self.psf, 0).max() / unit.max()
        self.psf = psf
        edges = [np.abs(unit[row]).max() for row in (self.half, 0)]  # of stamps, and of ones twice as wide
        self._faint = _SEEN * self.noise / np.maximum(edges, 1e-30)
        if render:
            self.render()

    def unit(self, psf, half):
        """A star of unit flux in the middle of the frame, (2 half + 1, 2 half + 1)."""
        return psf.light(np.array([[0.0, 0.0, 1.0]]), self.middle, half).reshape(2 * half + 1, -1)

    @property
    def fwhm(self):
        """Full width at half maximum of the PSF [pix]."""
        return self.psf.fwhm

    @property
    def usual_weight(self):
        """Median weight of the good pixels."""
        if self._usual is None:
            weights = self.weights[::_SPARSE, ::_SPARSE]
            self._usual = float(np.median(weights[weights > 0])) if (weights > 0).any() else 0.0
        return self._usual

    @property
    def usual_information(self):
        """Inverse variance of the flux of a faint star on good pixels."""
        return self.usual_weight * float((self.unit(self.psf, self.half) ** 2).sum())

    @property
    def middle(self):
        """The pixel in the middle of the frame, (1, 2)."""
        return np.array([self.frame.signal.shape[::-1]]) // 2

    def render(self):
        """The light of all stars made anew."""
        self.light[:] = 0
        self._add(np.arange(len(self.flux)), 1)
        self.weigh()

    def light_of(self, rows):
        """The light of some stars, (ny, nx)."""
        image = np.zeros(self.frame.signal.shape, dtype=_KIND)
        self._add(rows, 1, image)
        return image

    def weigh(self, rows=None):
        """Weights made anew, by the light that there is now; everywhere, or on the stamps of some stars."""
        planes, limits = (self.good, self.frame.variance, self.light, self.sky), np.array(self.light.shape)
        low, high = np.zeros((1, 2), dtype=int), limits[None]
        if rows is None:
            self._usual = None
        else:
            centres = np.round(self.xy[rows, ::-1]).astype(int)
            low, high = (np.clip(centres + side, 0, limits) for side in (-self.half, self.half + 1))
        boxes = np.hstack([low, high])
        stamps.inverse_variances(*planes, float(self.photon), LEAST_SKY, float(self.misfit), self.weights, boxes)
        self._snr = None

    def mask(self, y, x):
        """Pixels that are defects from now on."""
        if self.frame.defects is None:
            self.frame = replace(self.frame, defects=np.zeros(self.good.shape, dtype=bool))
        self.frame.defects[y, x] = True
        self.good[y, x] = False
        self.weights[y, x] = 0

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
        return self.residual_in(np.s_[:, :])

    def residual_in(self, part):
        """What stars and sky leave in some rows and columns."""
        left = self.frame.signal[part] - self.sky[part]
        left -= self.light[part]
        return left

    def update_sky(self, step=1, *, afresh=False):
        """The sky changed by what is left around every pixel, over what a change leaves once the stars follow.

        Parameters
        ----------
        step : int
            Pixels are binned in squares of this side first, and the change interpolated: faster, and exact enough for
            squares within a star.
        afresh : bool
            It becomes one mean of all light that stars leave, however often it is changed. Means of what is left that
            are added up follow slopes better, and take in stars that are not seen yet, more of them with every change.
        """
        sigma, weights = _SKY * self.fwhm, self.weights
        root = np.sqrt(weights)

        def around(image):
            return gaussian_sums(binned(image.astype(np.float32), step), sigma / step)[0]

        left = root * np.clip(root * self.residual, -_OUTLIER, _OUTLIER)  # a blend that has passed for a star is no sky
        before = self.sky if afresh else np.zeros_like(weights)
        left, norm = around(left + weights * before), around(weights)
        norm = np.maximum(norm, 1e-3 * norm.max())
        planes = [left / norm]
        if len(self.flux):
            slopes, right, centres = self.slopes(np.arange(len(self.flux)), (np.ones_like(weights),))
            normal = normal_matrix(slopes, centres, self.half)
            response = solved(normal, right.ravel(), np.sqrt(np.maximum(normal.diagonal(), 1e-30))).reshape(-1, 3)
            taken = np.zeros_like(weights)
            stamps.lay(taken, np.einsum("nap,na->np", slopes, response.astype(_KIND)), centres, self.half, 1)
            planes.append(norm / np.maximum(norm - around(root * taken), _LEAST * norm))
        level, *gain = planes if step == 1 else [spread(each, step, weights.shape) for each in planes]
        self.sky += np.prod([level - before, *gain], axis=0)

    def on_stamps(self, rows):
        """Of some stars `stars`, and the flat indices of the pixels of their stamps and which lie in the image."""
        params, centres = self.stars(rows)
        return params, centres, *stamps.stamp_pixels(centres, self.half, self.light.shape)

    def add(self, xy, flux):
        """More stars."""
        rows = np.arange(len(self.flux), len(self.flux) + len(flux))
        self.xy, self.flux = np.vstack([self.xy, xy]), np.append(self.flux, flux)
        self.spread = np.concatenate([self.spread, np.zeros((len(flux), 2, 2))])
        self._add(rows, 1)

    def remove(self, rows):
        """Stars taken off; a mask (n,)."""
        self._add(np.flatnonzero(rows), -1)
        self.xy, self.flux, self.spread = self.xy[~rows], self.flux[~rows], self.spread[~rows]

    def set(self, rows, xy, flux, spread=None):
        """Other positions and fluxes of some stars, perhaps another spread."""
        if len(rows) == len(self.flux):  # half the work
            self.light[:] = 0
        else:
            self._add(rows, -1)
        self.xy[rows], self.flux[rows] = xy, flux
        if spread is not None:
            self.spread[rows] = spread
        self._add(rows, 1)

    def stars(self, rows):
        """x and y from their central pixels and flux of some stars, (n, 3), and these pixels, (n, 2)."""
        centres = np.round(self.xy[rows]).astype(int)
        return np.column_stack([self.xy[rows] - centres, self.flux[rows]]), centres

    def star_light(self, rows, params, centres, half, *, slopes=False):
        """Light of some `stars` on stamps, and with `slopes` its derivatives by x, y and flux, (m, 3, npix)."""
        out, wide = self.psf.light(params, centres, half, slopes=slopes), self.spread[rows].any(axis=(1, 2))
        if wide.any():
            own = spread_light(self.psf, params[wide], self.spread[rows][wide], centres[wide], half, slopes=slopes)
            for plane, values in zip(out, own, strict=False) if slopes else ((out, own),):
                plane[wide] = values
        return out

    def _add(self, rows, sign, image=None):
        """The light of some stars added to that of all, or to an image, as far as it is seen."""
        if image is None and len(rows):
            image, self._snr = self.light, None
        reach = (self.flux[rows, None] > self._faint).sum(axis=1)
        reach = np.maximum(reach, self.spread[rows].any(axis=(1, 2)))
        for k, width in enumerate((1, 2, 4)):
            some = rows[reach == k]
            for i in range(0, len(some), _CHUNK):
                own = some[i : i + _CHUNK]
                params, centres = self.stars(own)
                light = self.star_light(own, params.astype(_KIND), centres, width * self.half)
                stamps.lay(image, light, centres, width * self.half, sign)

    def equations(self, rows):
        """Normal matrix (3 m, 3 m) and right side of some stars' x, y and flux, sparse."""
        blocks, right = self.blocks(rows)
        return assembled([blocks], len(rows)), right.ravel()

    def blocks(self, rows):
        """`normal_blocks` and right side (m, 3) of some stars."""
        slopes, right, centres = self.slopes(rows)
        return normal_blocks(slopes, centres, self.half), right

    def residual_at(self, pixels):
        """What stars and sky leave in some pixels, by their flat indices."""
        return self.frame.signal.ravel()[pixels] - self.sky.ravel()[pixels] - self.light.ravel()[pixels]

    def slopes(self, rows, left=None, *, flux_alone=False):
        """Slopes of the pixels of stamps by some stars' x, y and flux, in units of their noise.

        Parameters
        ----------
        rows : ndarray of int, shape (m,)
        left : tuple of ndarray, optional
            Images as of `legdistort.measurement.scene.stamps.weigh`; by default what stars and sky leave.
        flux_alone : bool
            Positions are known: slopes by the flux only.

        Returns
        -------
        slopes : ndarray, shape (m, 3 or 1, npix)
            0 in the corners, which say little.
        right : ndarray, shape (m, 3 or 1)
            Their products with what is left.
        centres : ndarray of int, shape (m, 2)
        """
        left = (self.frame.signal, self.sky, self.light) if left is None else left
        params, centres = self.stars(rows)
        if flux_alone:
            params[:, 2] = 1
        params, n = params.astype(_KIND), 1 if flux_alone else 3
        out = np.empty((len(rows), n, (2 * self.half + 1) ** 2), dtype=_KIND)
        right = np.empty((len(rows), n))
        for i in range(0, len(rows), _CHUNK):
            part = slice(i, i + _CHUNK)
            if flux_alone:
                out[part, 0] = self.star_light(rows[part], params[part], centres[part], self.half)
            else:
                out[part] = self.star_light(rows[part], params[part], centres[part], self.half, slopes=True)[1]
            right[part] = stamps.weigh(out[part], centres[part], self.half, self.weights, left)
        return out, right, centres

    def likelihood(self, part=np.s_[:, :]):
        """How much likelier what is left is with one more star in the middle of a pixel.

        Parameters
        ----------
        part : tuple of slice
            Rows and columns of the frame that are asked for.

        Returns
        -------
        signal, norm : ndarray, shape (ny, nx)
            The flux of the star is ``signal / norm``, its signal-to-noise ratio ``signal / sqrt(norm)``. The norm is 0
            where bad pixels cover most of a star.
        """
        half = int(np.ceil(_KERNEL * self.fwhm))
        kernel = self.psf.light(np.array([[0.0, 0.0, 1.0]], dtype=np.float32), self.middle, half)[0]
        kernel = np.maximum(kernel, 0).reshape(2 * half + 1, -1).astype(np.float32)
        ends = [each.indices(n)[:2] for each, n in zip(part, self.light.shape, strict=True)]
        wide = tuple(slice(max(a - half, 0), b + half) for a, b in ends)  # what the kernel meets
        inner = tuple(slice(a - own.start, b - own.start) for (a, b), own in zip(ends, wide, strict=True))
        weights = self.weights[wide]
        signal = stamps.correlate(weights * self.residual_in(wide), kernel)[inner]
        norm = stamps.correlate(weights, kernel**2)[inner]
        seen = norm > _COVERED * (kernel**2).sum() * self.usual_weight
        # under bright stars weights are small, and tell nothing of what is covered
        bright = ~seen & (weights[inner] > 0)
        if bright.any():
            y, x = np.nonzero(bright)
            own = np.broadcast_to(kernel.reshape(1, -1), (len(x), kernel.size))
            there = stamps.squared_ratios(own, np.column_stack([x, y]) + [ends[1][0], ends[0][0]], half, self.good)
            seen[y, x] = there > _COVERED * (kernel**2).sum()
        return signal, np.where(seen, np.maximum(norm, 1e-12 * norm.max(initial=0)), 0)

    def candidates(self, threshold):
        """Peaks of what is left that look like stars: places (n, 2), of whole pixels, and fluxes (n,)."""
        signal, norm = self.likelihood()
        seen = norm > 0
        ratio = np.where(seen, signal / np.sqrt(np.where(seen, norm, 1)), 0).astype(np.float32)
        x, y = peaks_above(ratio, threshold, max(1, int(self.fwhm / 2)))
        return np.column_stack([x, y]).astype(float), (signal / np.maximum(norm, 1e-30))[y, x]

    def contains(self, xy):
        """Whether places (n, 2) lie in the frame."""
        ny, nx = self.light.shape
        return ((xy > -1.5) & (xy < (nx + 0.5, ny + 0.5))).all(axis=1)

    def snr(self, rows=None):
        """Signal-to-noise ratio of the stars, or some, where nothing but their flux is unknown, (n,)."""
        if self._snr is not None:
            return self._snr if rows is None else self._snr[rows]
        half, weights = self.half, self.weights
        out = self._over_stars(rows, lambda own, _, at: stamps.squared_ratios(own, at, half, weights)) ** 0.5
        if rows is None:
            self._snr = out
        return out

    def unit_snr(self, xy):
        """Ratios of signal to noise of stars of unit flux at some places, nothing but the flux unknown; (n,)."""
        out = np.zeros(len(xy))
        for i in range(0, len(xy), _CHUNK):
            centres = np.round(xy[i : i + _CHUNK]).astype(int)
            params = np.column_stack([xy[i : i + _CHUNK] - centres, np.ones(len(centres))]).astype(_KIND)
            own = self.psf.light(params, centres, self.half)
            out[i : i + _CHUNK] = stamps.squared_ratios(own, centres, self.half, self.weights) ** 0.5
        return out

    def core_chi2(self, rows=None, *, lever=False):
        """Mean squared residual in units of the noise, weighted with the PSF, in the core of stars, or some; (n,).

        With `lever` also the same mean of the squared signal-to-noise ratio of the pixels.
        """
        planes, radius = (self.weights, self.good, self.frame.signal, self.sky, self.light), _CORE * self.fwhm
        chi2, levers = self._over_stars(rows, lambda *stars: stamps.cores(*stars, self.half, radius, planes), 2).T
        return (chi2, levers) if lever else chi2

    def middles(self, rows=None):
        """Products of the light of stars, or some, in their central pixels with what is left there, and with itself.

        In units of the noise, (2, n); 0 where that is no good pixel.
        """
        rows = np.arange(len(self.flux)) if rows is None else rows
        params, centres = self.stars(rows)
        own = self.star_light(rows, params, centres, 0)[:, 0]
        pixels, inside = stamps.stamp_pixels(centres, 0, self.light.shape)
        weights = np.where(inside, self.weights.ravel()[pixels], 0)[:, 0]
        return np.array([weights * own * self.residual_at(pixels)[:, 0], weights * own**2])

    def chi2_around(self, places):
        """Sum of the squared residuals in units of the noise within a core of some places; (n,)."""
        centres = np.round(places).astype(int)
        pixels, inside = stamps.stamp_pixels(centres, self.half, self.light.shape)
        square = self.weights.ravel()[pixels] * self.residual_at(pixels) ** 2
        return (square * inside * self.near(places - centres)).sum(axis=1)

    def _over_stars(self, rows, function, *shape):
        """Values of a function of the light of stars, all or some, on their stamps, and of `stars`; (n, *shape)."""
        rows = np.arange(len(self.flux)) if rows is None else rows
        out = np.zeros((len(rows), *shape))
        for i in range(0, len(out), _CHUNK):
            some = rows[i : i + _CHUNK]
            params, centres = self.stars(some)
            own = self.star_light(some, params.astype(_KIND), centres, self.half)
            out[i : i + _CHUNK] = function(own, params, centres)
        return out

    def near(self, params):
        """Pixels of stamps within the core of a star, (n, npix)."""
        dy, dx = np.mgrid[-self.half : self.half + 1, -self.half : self.half + 1].reshape(2, -1)
        x, y = params[:, :1], params[:, 1:2]
        return (dx - x) ** 2 + (dy - y) ** 2 <= (_CORE * self.fwhm) ** 2
