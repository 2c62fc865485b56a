"""Positions and images on the four detectors of GSAOI, made with nothing but the published numbers.

The polynomials are evaluated, and inverted by Newton's method, here; the distortion of an exposure is one of plain
powers of angles. Neither the basis of the package nor its cameras take part.
"""

import json
from importlib import resources

import numpy as np
from astropy.io import fits
from astropy.table import QTable
from numpy.polynomial import polynomial
from scipy import special

SIZE = 2048
#: Detectors and the ids that they have in files.
CHIPS = {"1": 0, "2": 1, "3": 2, "4": 3}


def published():
    """Coefficients (4, 2, 4, 4): detector, axis, powers of the 1-based pixel x and y; arcsec."""
    place = resources.files("legdistort").joinpath("data/gsaoi_static_distortion.json")
    table = json.loads(place.read_text(encoding="utf-8"))
    out = np.zeros((4, 2, 4, 4))
    for part in ("linear", "nonlinear"):
        for chip, axes in enumerate(table[part]):
            for axis, letter in enumerate("xy"):
                for name, value in axes[letter].items():
                    i, j = (int(n) for n in name[1:].split("_"))
                    out[chip, axis, i, j] += value
    return out


def to_arcsec(c, xy):
    """Detector pixels (n, 2), 0-based -> arcsec in the focal plane, by coefficients c (2, 4, 4)."""
    return np.stack([polynomial.polyval2d(*(np.asarray(xy) + 1).T, each) for each in c], axis=1)


def to_pixels(c, arcsec, margin=0.0):
    """The opposite; NaN beyond the detector, or so many pixels from it."""
    linear = np.stack([[each[1, 0], each[0, 1]] for each in c])
    xy = (arcsec - to_arcsec(c, np.full((1, 2), SIZE / 2))) @ np.linalg.inv(linear).T + SIZE / 2
    near = np.all((xy > -200 - margin) & (xy < SIZE + 200 + margin), axis=1)
    for _ in range(30):
        here = to_arcsec(c, xy[near])
        slope = np.stack([(to_arcsec(c, xy[near] + d) - to_arcsec(c, xy[near] - d)) / 2 for d in np.eye(2)], axis=2)
        xy[near] += np.linalg.solve(slope, (arcsec[near] - here)[..., None])[..., 0]
    near &= np.all((xy > -0.5 - margin) & (xy < SIZE - 0.5 + margin), axis=1)
    xy[~near] = np.nan
    return xy


class Night:
    """Exposures of a field of stars.

    Attributes
    ----------
    sky : ndarray, shape (n_stars, 2)
        True positions, arcsec.
    focal : list of ndarray, shape (n_stars, 2)
        Where they fall in the focal plane of each exposure, arcsec.
    pixels : list of dict
        ``{detector: (n_stars, 2)}``.
    towards : list of tuple
        Where the middle of the field falls, arcsec, and the rotation (2, 2) of each exposure.
    """

    def __init__(self, *, n_exposures=11, n_stars=400, dither=4.0, turn=0.02, dynamic=0.4, degree=3, seed=1):
        rng = np.random.default_rng(seed)
        c = published()
        middle = to_arcsec(c[1], [[SIZE + 70, SIZE + 70]])[0]
        self.sky = middle + rng.uniform(-52, 52, (n_stars, 2))
        self.focal, self.pixels, self.towards, self._bends = [], [], [], []
        for i in range(n_exposures):
            angle, shift = rng.normal(0, turn), rng.uniform(-dither, dither, 2)
            rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            self.towards.append((middle + shift, rotation))
            powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i) if i + j]
            size = rng.normal(0, 1, (2, len(powers))) * 0.02 * dynamic / np.sqrt(len(powers)) * 2.5
            self._bends.append((middle, shift, list(zip(size.T, powers, strict=True))))
            self.focal.append(self.bent(i, self.sky))
            self.pixels.append({key: to_pixels(c[chip], self.focal[-1]) for key, chip in CHIPS.items()})

    def bent(self, i, sky):
        """Where places on the sky (n, 2) fall in the focal plane of exposure i, arcsec."""
        middle, shift, terms = self._bends[i]
        place = (sky - middle) @ self.towards[i][1].T + shift
        u, v = place.T / 45
        return middle + place + sum(np.outer(u**j * v**k, s) for s, (j, k) in terms)

    def table(self, *, sigma=0.01, seed=2, least=3):
        """Measured positions of the stars that lie on a detector in so many exposures, as a QTable."""
        rng, parts = np.random.default_rng(seed), []
        for i, chips in enumerate(self.pixels):
            for key, xy in chips.items():
                star = np.flatnonzero(np.isfinite(xy[:, 0]))
                x, y = (xy[star] + rng.normal(0, sigma, (len(star), 2))).T
                parts.append((np.full(len(star), f"frame{i:02d}"), np.full(len(star), key), star, x, y))
        names = ("exposure", "detector", "star", "x", "y")
        table = QTable([np.concatenate(columns) for columns in zip(*parts, strict=True)], names=names)
        table["x_err"] = table["y_err"] = np.full(len(table), sigma)
        return table[np.bincount(table["star"])[table["star"]] >= least]

    def images(self, i, *, size, flux, fwhm=3.0, sky=100.0, sensitivity=(1, 1, 1, 1), noise=1.0, seed=3):
        """Frame of an exposure, ``SCI`` of every detector, Gaussian stars; detectors may have coarser pixels.

        Parameters
        ----------
        i : int
            The exposure.
        size : int
            Pixels along a side of a detector; `SIZE` as it is.
        flux : ndarray, shape (n_stars,)
            Electrons in the exposure.
        fwhm : float
            Of the stars on the sky, in pixels of 0.0197 arcsec times 2048 / size.
        sky : float or sequence of float
            Electrons in a pixel, of every detector.
        sensitivity : sequence of float
            Of the detectors, by which their stars and sky are multiplied.
        noise : float
            Factor on the noise of the photons.
        """
        rng, coarse = np.random.default_rng([seed, i]), SIZE / size
        hdus = [fits.PrimaryHDU(header=fits.Header({"INSTRUME": "GSAOI", "DATE-OBS": f"2014-12-08T03:{i:02d}:00"}))]
        for (key, chip), gain, level in zip(CHIPS.items(), sensitivity, np.broadcast_to(sky, 4), strict=True):
            arcsec = self.focal[i]
            xy = (to_pixels(published()[chip], arcsec, margin=30 * coarse) + 0.5) / coarse - 0.5
            image = np.full((size, size), float(level))
            local = fwhm * 0.0197 / np.sqrt(abs(np.linalg.det(self.slope(chip))))
            for at, light in zip(xy, flux, strict=True):
                if np.isfinite(at[0]):
                    add_gaussian(image, at, light, local)
            image = gain * (image + noise * rng.normal(0, np.sqrt(image)))
            header = fits.Header({"CCDCHIP": int(key), "EXPTIME": 60.0, "GAIN": 1 / gain, **self.wcs(i, chip, size)})
            hdus.append(fits.ImageHDU(image.astype(np.float32), header, name="SCI", ver=int(key)))
        return fits.HDUList(hdus)

    @staticmethod
    def slope(chip):
        """Arcsec by detector pixels (2, 2) in the middle of a detector."""
        c, middle = published()[chip], np.full((1, 2), (SIZE - 1) / 2)
        return np.stack([(to_arcsec(c, middle + d) - to_arcsec(c, middle - d))[0] / 2 for d in np.eye(2)], axis=1)

    def wcs(self, i, chip, size):
        """Keywords of a linear WCS that is right in the middle of a detector, but for the pointing, 0.2 arcsec off."""
        here = to_arcsec(published()[chip], np.full((1, 2), (SIZE - 1) / 2))[0]
        back, rotation = self.towards[i]
        off = rotation.T @ (here - back) + np.random.default_rng(i).normal(0, 0.14, 2)
        east = np.diag([-1, 1]) / 3600
        cd = east @ rotation.T @ self.slope(chip) * SIZE / size
        names = ("CD1_1", "CD1_2", "CD2_1", "CD2_2")
        return {
            "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": (size + 1) / 2, "CRPIX2": (size + 1) / 2,
            "CRVAL1": 30.0 + east[0, 0] * off[0], "CRVAL2": east[1, 1] * off[1],
            **dict(zip(names, cd.ravel().tolist(), strict=True)),
        }  # fmt: skip


def add_gaussian(image, xy, flux, fwhm):
    """Add a round Gaussian star, integrated over the pixels, in place."""
    scale, half = fwhm / 2.3548 * np.sqrt(2), int(np.ceil(3 * fwhm))
    parts, profiles = [], []
    for n, centre in zip(image.shape, xy[::-1], strict=True):
        low, high = max(round(centre) - half, 0), min(round(centre) + half + 1, n)
        if high <= low:
            return
        parts.append(slice(low, high))
        profiles.append(np.diff(special.erf((np.arange(low, high + 1) - 0.5 - centre) / scale)) / 2)
    image[tuple(parts)] += flux * np.outer(*profiles)


def without_common_map(found, true, degree):
    """Positions less the map of powers up to a degree of the true ones that fits them best."""
    u = (true - true.mean(axis=0)) / np.ptp(true, axis=0)
    powers = np.stack([u[:, 0] ** i * u[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
    return found - powers @ np.linalg.lstsq(powers, found, rcond=None)[0]


def covariance(star, exposure, place, sigma, degree, detector=None):
    """Covariance (n_stars, n_stars) of one coordinate of the stars that no unbiased estimate beats, up to a common map.

    Unknown are the position of each star, for each exposure powers up to a degree of the place in it, and with the
    detectors of the observations for each of these an affine map of the place.
    """
    n_stars, n_exposures = star.max() + 1, exposure.max() + 1
    u = place / np.abs(place).max()
    powers = np.stack([u[:, 0] ** i * u[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
    k = powers.shape[1]
    design = np.zeros((len(star), n_stars + n_exposures * k))
    design[np.arange(len(star)), star] = 1
    for m in range(k):
        design[np.arange(len(star)), n_stars + exposure * k + m] = powers[:, m]
    if detector is not None:
        affine = np.zeros((len(star), 3 * (detector.max() + 1)))
        for m, column in enumerate((np.ones(len(star)), *u.T)):
            affine[np.arange(len(star)), 3 * detector + m] = column
        design = np.hstack([design, affine])
    return np.linalg.pinv(design.T @ design, rcond=1e-10, hermitian=True)[:n_stars, :n_stars] * sigma**2


def bound(star, exposure, place, true, sigma, degree, detector=None):
    """Cramer-Rao bound of star positions after a common map, rms over stars and axes, in units of sigma."""
    centred = without_common_map(np.eye(star.max() + 1), true, degree)
    best = covariance(star, exposure, place, sigma, degree, detector)
    return float(np.sqrt(np.trace(centred @ best @ centred.T) / len(true)))
