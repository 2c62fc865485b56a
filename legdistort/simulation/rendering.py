"""Images of simulated stars: Moffat profiles integrated over pixels, sky, photon and read noise.

The profile is written apart from `legdistort.measurement.profiles.moffat`, so that an error in the one that is fitted
cannot hide in its own tests.
"""

from dataclasses import dataclass

import numpy as np

from ..exceptions import InputError


@dataclass(frozen=True)
class Moffat:
    """An elliptical Moffat profile of unit flux (Bernard et al. 2017, section 5.2, without background).

    Attributes
    ----------
    fwhm : float
        Geometric mean of the two axes' full widths at half maximum, pixels.
    beta : float
        Exponent, above 1.
    ellipticity : float
        1 - minor / major axis.
    angle : float
        Of the major axis, radians from x towards y.
    """

    fwhm: float = 4.5
    beta: float = 2.8
    ellipticity: float = 0.0
    angle: float = 0.0

    def __post_init__(self):
        if not (self.fwhm > 0 and self.beta > 1 and 0 <= self.ellipticity < 1):
            raise InputError(f"a Moffat profile needs fwhm > 0, beta > 1 and 0 <= ellipticity < 1, got {self}")

    @property
    def core(self):
        """Geometric mean of the lengths dx and dy of the profile, pixels."""
        return self.fwhm / (2 * np.sqrt(2 ** (1 / self.beta) - 1))

    @property
    def peak(self):
        """Surface brightness at the centre, 1 / pixel^2."""
        return (self.beta - 1) / (np.pi * self.core**2)

    def __call__(self, dx, dy):
        """Surface brightness [1 / pixel^2] at offsets (pixels) from the centre."""
        along = dx * np.cos(self.angle) + dy * np.sin(self.angle)
        across = dy * np.cos(self.angle) - dx * np.sin(self.angle)
        squash = 1 - self.ellipticity
        return self.peak * (1 + (along**2 * squash + across**2 / squash) / self.core**2) ** -self.beta

    def radius(self, level):
        """Where the surface brightness along the major axis has fallen to `level` [1 / pixel^2], pixels."""
        ratio = max(self.peak / level, 1.0)
        return self.core * np.sqrt((ratio ** (1 / self.beta) - 1) / (1 - self.ellipticity))


def add_star(image, xy, flux, psf, *, faintest=0.01):
    """Add one star to an image in place, integrated over every pixel.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Changed.
    xy : array_like, shape (2,)
        Centre, 0-based pixels; it may lie off the image.
    flux : float
        Total.
    psf : Moffat
        Profile.
    faintest : float
        The cut-out reaches to where a pixel holds less than this, and at least 4 FWHM.
    """
    half = int(np.ceil(max(psf.radius(faintest / flux), 4 * psf.fwhm)))
    # three Gauss-Legendre nodes a pixel and axis: relative error below 1e-6 for a FWHM of 4.5 pixels
    nodes, weights = np.polynomial.legendre.leggauss(3)
    ranges = [
        np.arange(max(round(c) - half, 0), min(round(c) + half + 1, n))
        for c, n in zip((float(xy[0]), float(xy[1])), image.shape[::-1], strict=True)
    ]
    if not all(len(r) for r in ranges):
        return
    dx, dy = ((r[:, None] + nodes / 2 - c).ravel() for r, c in zip(ranges, xy, strict=True))
    fine = psf(dx[None, :], dy[:, None]).reshape(len(ranges[1]), 3, len(ranges[0]), 3)
    stamp = np.einsum("aibj,i,j->ab", fine, weights / 2, weights / 2, optimize=True)
    image[ranges[1][0] : ranges[1][-1] + 1, ranges[0][0] : ranges[0][-1] + 1] += flux * stamp


def render(shape, xy, flux, *, psf, sky=0.0):
    """Noise-free image of stars.

    Parameters
    ----------
    shape : tuple of int
        ``(ny, nx)``.
    xy : array_like, shape (n, 2)
        Centres, 0-based pixels.
    flux : array_like, shape (n,)
        Total of every star.
    psf : Moffat
        Profile, the same for all.
    sky : float
        Of a pixel.

    Returns
    -------
    ndarray, shape (ny, nx)
    """
    image = np.full(shape, float(sky))
    for centre, f in zip(xy, flux, strict=True):
        add_star(image, centre, f, psf)
    return image


def add_noise(image, rng, *, gain, read_noise):
    """The image as a detector would count it.

    Parameters
    ----------
    image : ndarray
        Expected counts, ADU.
    rng : `~numpy.random.Generator`
        Source of the noise.
    gain : float
        Electrons per ADU.
    read_noise : float
        Electrons.

    Returns
    -------
    ndarray
        Photon noise (Poisson) and read noise (Gaussian) added, ADU.
    """
    electrons = rng.poisson(image * gain).astype(float)
    electrons += read_noise * rng.standard_normal(image.shape, dtype=np.float32)
    return electrons / gain


def position_error(flux, *, psf, sky, gain, read_noise):
    """Smallest possible error of a star's position, per axis (Cramer-Rao bound at known profile).

    It falls as 1/flux where sky and read noise rule and as 1/sqrt(flux) where the star's own photons do
    (Bernard et al. 2017, section 5.2).

    Parameters
    ----------
    flux : array_like, shape (n,)
        ADU.
    psf : Moffat
        Its ellipticity is left out.
    sky : float
        ADU a pixel.
    gain, read_noise : float
        Electrons per ADU, electrons.

    Returns
    -------
    ndarray, shape (n,)
        Pixels.
    """
    flux = np.asarray(flux, dtype=float)
    # the light of a round profile ring by ring: d profile/dx = -2 beta x profile / (core^2 + r^2), mean x^2 = r^2/2
    r = np.linspace(0, 8 * psf.fwhm, 2000)
    profile = psf.peak * (1 + (r / psf.core) ** 2) ** -psf.beta
    slope2 = (2 * psf.beta * profile / (psf.core**2 + r**2)) ** 2 * r**2 / 2
    variance = (sky + flux[..., None] * profile) / gain + (read_noise / gain) ** 2
    return 1 / np.sqrt(np.trapezoid(flux[..., None] ** 2 * slope2 / variance * 2 * np.pi * r, r, axis=-1))
