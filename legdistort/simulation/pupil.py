"""Images of a star behind adaptive optics, computed from the pupil: a core at the diffraction limit in a seeing halo.

The long exposure is a product of optical transfer functions (Goodman 1985, Statistical Optics, chapter 8)::

    OTF(f) = pupil with its static phase(f) x jitter(f) x (c + (1 - c) seeing(f)) x pixel(f)

Residual turbulence that is correlated over less than the pupil leaves the part c = exp(-variance of the phase) of the
light in the core and scatters the rest into a halo as wide as the seeing.

**The position of a star** is where the light goes if the phase is flat: the phases added here have no tilt in the sense
of Zernike polynomials, so the core of a coma stands there, not the centroid of all light.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real

import numpy as np
from scipy import fft

from ..exceptions import InputError
from .gridded_psf import GriddedPSF

#: FWHM of a long exposure through Kolmogorov turbulence, in units of wavelength / Fried length (Roddier 1981).
_SEEING = 0.976
#: Samples per wavelength / diameter of the grids that stars are interpolated from, core and wings.
_FINE, _COARSE = 8.0, 4.0
#: Half sides of those grids: the core's in wavelength / diameter, the wings' in FWHM of the halo too.
_CORE, _WINGS, _HALO = 20.0, 45.0, 8.0


@dataclass(frozen=True)
class PupilPSF:
    """A round pupil with a central obstruction behind adaptive optics.

    What varies over the field does so with the distance d from the axis, in units of half the longer side of the
    detector: 1 is the middle of an edge, 1.41 a corner.

    Attributes
    ----------
    strehl : float or None
        Peak over that of a perfect telescope, on the axis, in infinitely small pixels: seeing, jitter and
        `aberrations` together. None leaves no seeing: all light is in the core.
    resolution : float
        Wavelength / diameter [pix]; a clear pupil has a core of 1.03 times this FWHM.
    obstruction : float
        Diameter of the central obstruction over that of the pupil.
    halo_fwhm : float
        Of the seeing [pix].
    jitter : float
        Rms of the image motion per axis [pix].
    elongation : float
        Rms of more motion along the line to the axis at d = 1 [pix]; it grows as d.
    coma : float
        Rms phase at d = 1 [rad], along that line; it grows as d.
    astigmatism : float
        Rms phase at d = 1 [rad], along that line; it grows as d^2.
    aberrations : tuple of float
        Rms phases [rad] all over the field: Zernike polynomials 4 (defocus), 5, 6 (astigmatism), 7, 8 (coma), 9, 10
        (trefoil), 11 (spherical) in the order of Noll (1976).
    axis : tuple of float
        Where the axis is, (x, y) in units of half the longer side from the middle of the detector.

    Raises
    ------
    InputError
        For values out of range, and a Strehl ratio that jitter and aberrations do not leave.
    """

    strehl: float | None = 0.3
    resolution: float = 2.8
    obstruction: float = 0.13
    halo_fwhm: float = 25.0
    jitter: float = 0.0
    elongation: float = 0.0
    coma: float = 0.0
    astigmatism: float = 0.0
    aberrations: tuple = ()
    axis: tuple = (0.0, 0.0)

    def __post_init__(self):
        limits = {
            "strehl": (0, 1), "resolution": (0.5, 100), "obstruction": (0, 0.9), "jitter": (0, 100),
            "elongation": (0, 100), "coma": (0, 20), "astigmatism": (0, 20),
        }  # fmt: skip
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            allowed = isinstance(value, Real) and low <= value <= high
            if not allowed and not (name == "strehl" and value is None):
                raise InputError(f"{name} of a PupilPSF must lie between {low} and {high}, got {value!r}")
        if not self.halo_fwhm >= 2 * self.resolution:
            raise InputError(
                f"halo_fwhm must be at least twice the resolution of {self.resolution:g} px, got {self.halo_fwhm!r}"
            )
        if len(self.aberrations) > len(_ZERNIKE) or not np.isfinite(self.aberrations).all():
            raise InputError(f"aberrations are up to {len(_ZERNIKE)} finite phases [rad], got {self.aberrations!r}")
        if not 0 <= self.coherent <= 1:
            least, most = (float(s) for s in self._strehl_limits)
            raise InputError(
                f"strehl={self.strehl:g} cannot be had: the halo alone gives {least:.3f}, jitter and aberrations leave "
                f"{most:.3f}"
            )

    @classmethod
    def of_telescope(cls, *, wavelength, diameter, pixel_scale, seeing, **more):
        """The same from a wavelength [m], a diameter [m], a pixel scale and the seeing [arcsec].

        `seeing` is the FWHM at that wavelength; `more` are other attributes.
        """
        resolution = np.degrees(wavelength / diameter) * 3600 / pixel_scale
        return cls(resolution=float(resolution), halo_fwhm=seeing / pixel_scale, **more)

    def varied(self, rng):
        """That of another exposure: seeing, correction and axis drawn anew about these."""
        draws = np.clip(rng.normal(size=8), -2, 2).tolist()
        names = ("jitter", "elongation", "coma", "astigmatism")
        scaled = {name: getattr(self, name) * (1 + 0.2 * d) for name, d in zip(names, draws, strict=False)}
        seeing = self.halo_fwhm * (1 + 0.1 * draws[4])
        axis = tuple(a + 0.1 * d for a, d in zip(self.axis, draws[5:7], strict=True))
        changed = replace(self, strehl=None, halo_fwhm=seeing, axis=axis, **scaled)
        return changed if self.strehl is None else changed.with_core(min(self.coherent * (1 + 0.15 * draws[7]), 0.99))

    def with_core(self, part):
        """The same with this part of the light in the core, the rest in the halo, whatever Strehl ratio that makes."""
        least, most = self._strehl_limits.tolist()
        return replace(self, strehl=least + part * (most - least))

    @cached_property
    def coherent(self):
        """Part of the light in the core; the rest is in the halo."""
        if self.strehl is None:
            return 1.0
        least, most = self._strehl_limits
        return float((self.strehl - least) / (most - least))

    @cached_property
    def _strehl_limits(self):
        """Strehl ratios on the axis of the halo and of the core, each with all the light."""
        core = self._pupil(self._phases(self.axis)) * self._motion(self.axis)
        sums = [np.sum((part * otf).real @ self._twice) for part, otf in ((core, self._seeing), (core, 1.0))]
        light = self._aperture[0]
        return np.array(sums) * np.sum(light**2) / np.sum(light) ** 2  # no FFT needed where the phase is flat

    @cached_property
    def _frequency(self):
        """Spatial frequencies [1/pix] out to the cut-off; their step is that of a period twice as wide as `over`."""
        n = int(np.ceil(4 * self._extent(_WINGS, _HALO) / self.resolution))
        return np.arange(-n, n + 1) / (n * self.resolution)

    @property
    def _f(self):
        """Frequencies of y and x that transfer functions are known at: an image is real, so half of those in x do."""
        return self._frequency[:, None], self._frequency[len(self._frequency) // 2 :]

    @property
    def _twice(self):
        """How often every frequency of x counts."""
        return np.where(self._f[1] > 0, 2.0, 1.0)

    def _extent(self, in_resolution, in_halo):
        return int(np.ceil(max(in_resolution * self.resolution, in_halo * self.halo_fwhm)))

    @cached_property
    def _seeing(self):
        """Transfer function of Kolmogorov turbulence (Fried 1966)."""
        return np.exp(-3.44 * (np.hypot(*self._f) * self.halo_fwhm / _SEEING) ** (5 / 3))

    def _phases(self, d):
        """Zernike coefficients [rad] at the place d (x, y) on the detector, in units of half its side."""
        x, y = np.subtract(d, self.axis)
        phases = np.zeros(len(_ZERNIKE))
        phases[: len(self.aberrations)] = self.aberrations
        phases[[1, 2]] += self.astigmatism * np.array([2 * x * y, x**2 - y**2])
        phases[[3, 4]] += self.coma * np.array([y, x])
        return phases

    def _pupil(self, phases):
        """Transfer function of the pupil with these phases, on `_f`."""
        n = len(self._frequency) // 2
        light, r, angle = self._aperture
        phase = sum(a * z(r, angle) for a, z in zip(phases, _ZERNIKE, strict=True) if a)
        field = fft.fft2(light * np.exp(1j * phase), (fft.next_fast_len(2 * n + 5),) * 2)
        otf = fft.rfft2(field.real**2 + field.imag**2).conj()
        return otf[np.arange(-n, n + 1), : n + 1] / otf[0, 0].real

    @cached_property
    def _aperture(self):
        """Amplitude, radius and angle over the pupil, whose diameter is n samples: the largest shift with overlap."""
        n = len(self._frequency) // 2
        x = np.arange(-(n // 2) - 1, n // 2 + 2) * (2 / n)
        r = np.hypot(x[:, None], x)
        light = np.clip((1 - r) * n / 2 + 0.5, 0, 1)
        if self.obstruction:
            light *= np.clip((r - self.obstruction) * n / 2 + 0.5, 0, 1)
        return light, r, np.arctan2(x[:, None], x)

    def _motion(self, d):
        """Transfer function of the image motion at the place d, on `_f`."""
        (fy, fx), (x, y) = self._f, np.subtract(d, self.axis) * self.elongation
        return np.exp(-2 * np.pi**2 * ((x * fx + y * fy) ** 2 + self.jitter**2 * (fx**2 + fy**2)))

    def light(self, dx, dy, d=(0.0, 0.0)):
        """Part of the light of a star in pixels at these offsets from it, without interpolation.

        Parameters
        ----------
        dx, dy : array_like, shapes (n,) and (m,)
            Pixel centre minus star [pix].
        d : (float, float)
            Place of the star on the detector, from its middle, in units of half the longer side.

        Returns
        -------
        ndarray, shape (m, n)
        """
        fy, fx = self._f
        otf = self._pupil(self._phases(d)) * self._motion(d) * (self.coherent + (1 - self.coherent) * self._seeing)
        otf *= np.sinc(fy) * np.sinc(fx)
        in_x = np.exp(2j * np.pi * np.outer(fx, dx)) * self._twice[:, None]
        part = np.exp(2j * np.pi * np.outer(dy, fy)) @ otf
        return (part.real @ in_x.real - part.imag @ in_x.imag) * fx[1] ** 2

    def over(self, shape, *, nodes=5):
        """Rendered on a grid of places over a detector.

        Parameters
        ----------
        shape : tuple of int
            ``(ny, nx)``.
        nodes : int
            Places along a side; one in all where the PSF is the same everywhere.

        Returns
        -------
        GriddedPSF
            At its places it differs from `light` by less than 1e-4 of the flux, summed over the pixels.
        """
        ny, nx = shape
        middle, side = np.array([nx - 1, ny - 1]) / 2, max(nx, ny) / 2
        if not (self.elongation or self.coma or self.astigmatism):
            nodes = 1
        halves = [self._extent(_CORE, 0), self._extent(_WINGS, _HALO)]

        def sampled(half, samples, nodes, share):
            step = max(1, int(np.ceil(samples / self.resolution)))
            offsets = np.arange(-half * step, half * step + 1) / step
            # the core passes smoothly into the wings, where coarse samples do
            core = np.cos(np.clip(2 * np.hypot(offsets[:, None], offsets) / halves[0] - 1, 0, 1) * np.pi / 2) ** 2
            places = [np.linspace(0, n - 1, nodes) if nodes > 1 else [(n - 1) / 2] for n in (nx, ny)]
            positions = np.stack(np.meshgrid(*places), axis=-1).reshape(-1, 2)
            light = [self.light(offsets, offsets, (xy - middle) / side) * share(core) for xy in positions]
            return np.array(light), step, None, positions

        wings = GriddedPSF(*sampled(halves[1], _COARSE, min(nodes, 3), lambda core: 1 - core))
        return GriddedPSF(*sampled(halves[0], _FINE, nodes, lambda core: core), wings=wings)


#: Noll's 4 to 11 as functions of radius and angle; rms 1 over a clear pupil of radius 1.
_ZERNIKE = (
    lambda r, a: np.sqrt(3) * (2 * r**2 - 1),
    lambda r, a: np.sqrt(6) * r**2 * np.sin(2 * a),
    lambda r, a: np.sqrt(6) * r**2 * np.cos(2 * a),
    lambda r, a: np.sqrt(8) * (3 * r**3 - 2 * r) * np.sin(a),
    lambda r, a: np.sqrt(8) * (3 * r**3 - 2 * r) * np.cos(a),
    lambda r, a: np.sqrt(8) * r**3 * np.sin(3 * a),
    lambda r, a: np.sqrt(8) * r**3 * np.cos(3 * a),
    lambda r, a: np.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
)
