"""Images of simulated stars: their light in every pixel, sky, photon and read noise.

A point-spread function is anything with

- ``on_pixels(columns, rows, xy)``: the part of a star's light in these pixels, shape (rows, columns);
- ``reach(level)``: how far from the star a pixel holds more than this part of the light [pix];
- ``fwhm``, pixels.

`Moffat` and `~legdistort.simulation.gridded_psf.GriddedPSF` have them; `as_psf` makes the latter of a
`~legdistort.simulation.pupil.PupilPSF` and of what photutils calls ``ImagePSF`` and ``GriddedPSFModel``.

The Moffat profile is written apart from `legdistort.measurement.profiles.moffat`, so that an error in the one that is
fitted cannot hide in its own tests.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..exceptions import InputError
from .gridded_psf import GriddedPSF
from .pupil import PupilPSF

#: Three Gauss-Legendre nodes a pixel and axis: relative error below 1e-6 for a FWHM of 4.5 pixels.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


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
        cos, sin, squash = np.cos(self.angle), np.sin(self.angle), 1 - self.ellipticity
        xx, yy = squash * cos**2 + sin**2 / squash, squash * sin**2 + cos**2 / squash
        xy = 2 * (squash - 1 / squash) * sin * cos
        return self.peak * (1 + (xx * dx**2 + yy * dy**2 + (xy * dx) * dy) / self.core**2) ** -self.beta

    def reach(self, level):
        """Where the surface brightness along the major axis has fallen to `level` [1 / pixel^2], 4 FWHM at least."""
        ratio = max(self.peak / level, 1.0)
        radius = self.core * np.sqrt((ratio ** (1 / self.beta) - 1) / (1 - self.ellipticity))
        return int(np.ceil(max(radius, 4 * self.fwhm)))

    def on_pixels(self, columns, rows, xy):
        """Part of a star's light in every pixel, shape (rows, columns)."""
        dx, dy = ((r[:, None] + _NODES / 2 - c).ravel() for r, c in zip((columns, rows), xy, strict=True))
        along = (self(dx[None, :], dy[:, None]).reshape(-1, 3) @ (_WEIGHTS / 2)).reshape(len(rows), 3, len(columns))
        return _WEIGHTS / 2 @ along

    def varied(self, rng):
        """That of another exposure: width, ellipticity and angle drawn anew about these."""
        return replace(
            self,
            fwhm=self.fwhm * (1 + 0.05 * np.clip(rng.normal(), -2, 2)),
            ellipticity=self.ellipticity * (1 + 0.3 * np.clip(rng.normal(), -2, 2)),
            angle=rng.uniform(0, np.pi),
        )

    def information(self, flux, *, sky, gain, read_noise):
        """Fisher information on x of stars of these fluxes (n,), ellipticity left out [1 / pixel^2]."""
        # the light of a round profile ring by ring: d profile/dx = -2 beta x profile / (core^2 + r^2), mean x^2 = r^2/2
        r = np.linspace(0, 8 * self.fwhm, 2000)
        profile = self.peak * (1 + (r / self.core) ** 2) ** -self.beta
        slope2 = (2 * self.beta * profile / (self.core**2 + r**2)) ** 2 * r**2 / 2
        variance = (sky + flux[..., None] * profile) / gain + (read_noise / gain) ** 2
        return np.trapezoid(flux[..., None] ** 2 * slope2 / variance * 2 * np.pi * r, r, axis=-1)


def is_psf(psf):
    """Whether `as_psf` takes it."""
    known = isinstance(psf, (Moffat, GriddedPSF, PupilPSF))
    return known or all(hasattr(psf, name) for name in ("data", "oversampling", "origin"))  # photutils


def as_psf(psf, shape):
    """What renders stars on a detector.

    Parameters
    ----------
    psf : object
        A `Moffat`, `~legdistort.simulation.gridded_psf.GriddedPSF`, `~legdistort.simulation.pupil.PupilPSF`, photutils
        ``ImagePSF`` or ``GriddedPSFModel``.
    shape : tuple of int
        ``(ny, nx)`` of the detector, over which a `PupilPSF` varies.

    Returns
    -------
    object
        With ``on_pixels``, ``reach`` and ``fwhm``.

    Raises
    ------
    InputError
        For what is none of these, and for arrays whose sum is not that of a PSF.
    """
    if not is_psf(psf):
        raise InputError(
            "psf must be a Moffat, a PupilPSF, a GriddedPSF or a photutils ImagePSF or GriddedPSFModel, "
            f"got {type(psf).__name__}; an array goes into GriddedPSF(array, oversampling)"
        )
    if isinstance(psf, PupilPSF):
        psf = psf.over(shape)
    elif not isinstance(psf, (Moffat, GriddedPSF)):
        psf = GriddedPSF.from_model(psf)
    if isinstance(psf, GriddedPSF) and not (psf.total[0] > 0.5 and psf.total[1] < 1.1):
        low, high = (total * np.prod(psf.oversampling) for total in psf.total)
        raise InputError(
            f"with oversampling {psf.oversampling} a PSF sums to {np.prod(psf.oversampling)}, less what lies outside "
            f"the array, but this one to {low:.4g} ... {high:.4g}: multiply its values, or correct the oversampling"
        )
    return psf


def add_star(image, xy, flux, psf, *, faintest=0.01):
    """Add one star to an image in place, integrated over every pixel.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Changed.
    xy : array_like, shape (2,)
        Position, 0-based pixels; it may lie off the image.
    flux : float
        Total.
    psf : object
        From `as_psf`.
    faintest : float
        The cut-out reaches to where a pixel holds less than this.
    """
    half = psf.reach(faintest / flux)
    ranges = [
        np.arange(max(round(c) - half, 0), min(round(c) + half + 1, n))
        for c, n in zip((float(xy[0]), float(xy[1])), image.shape[::-1], strict=True)
    ]
    if not all(len(r) for r in ranges):
        return
    stamp = psf.on_pixels(*ranges, xy)
    image[ranges[1][0] : ranges[1][-1] + 1, ranges[0][0] : ranges[0][-1] + 1] += flux * stamp


def render(shape, xy, flux, *, psf, sky=0.0):
    """Noise-free image of stars.

    Parameters
    ----------
    shape : tuple of int
        ``(ny, nx)``.
    xy : array_like, shape (n, 2)
        Positions, 0-based pixels.
    flux : array_like, shape (n,)
        Total of every star.
    psf : object
        What `as_psf` takes.
    sky : float
        Of a pixel.

    Returns
    -------
    ndarray, shape (ny, nx)

    Raises
    ------
    InputError
        For a psf that is none.
    """
    image, psf = np.full(shape, float(sky)), as_psf(psf, shape)
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
    psf : object
        From `as_psf`; one that varies over the field is taken in its middle.
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
    return 1 / np.sqrt(psf.information(flux, sky=sky, gain=gain, read_noise=read_noise))


def position_covariance(xy, flux, expected, *, psf, gain, read_noise, half=None):
    """Smallest possible covariance of every star's position in an image, the PSF being known.

    The Cramer-Rao bound with four free parameters a star: x, y, flux, and the sky under it. The light of the other
    stars counts as noise; that their own positions are not known does not.

    Parameters
    ----------
    xy : array_like, shape (n, 2)
        Positions, 0-based pixels.
    flux : array_like, shape (n,)
        ADU.
    expected : ndarray, shape (ny, nx)
        The image without noise, sky included, from `render`.
    psf : object
        From `as_psf`.
    gain, read_noise : float
        Electrons per ADU, electrons.
    half : int, optional
        Half side of the square around a star that is used for it [pix]; by default 4 FWHM.

    Returns
    -------
    covariance : ndarray, shape (n, 2, 2)
        Pixels^2.
    flux_error : ndarray, shape (n,)
        ADU.
    """
    half, step = half or int(np.ceil(4 * psf.fwhm)), 1e-3
    out = np.empty((len(xy), 4, 4))
    for k, (centre, f) in enumerate(zip(np.asarray(xy, dtype=float), flux, strict=True)):
        columns, rows = (
            np.arange(max(round(c) - half, 0), min(round(c) + half + 1, n))
            for c, n in zip(centre.tolist(), expected.shape[::-1], strict=True)
        )
        variance = expected[np.ix_(rows, columns)] / gain + (read_noise / gain) ** 2
        moved = [[psf.on_pixels(columns, rows, centre + s * step * e) for s in (1, -1)] for e in np.eye(2)]
        slopes = [f * (there - back) / (2 * step) for there, back in moved]
        jac = np.array([*slopes, psf.on_pixels(columns, rows, centre), np.ones(variance.shape)])
        jac = (jac / np.sqrt(variance)).reshape(4, -1)
        out[k] = np.linalg.inv(jac @ jac.T)
    return out[:, :2, :2], np.sqrt(out[:, 2, 2])
