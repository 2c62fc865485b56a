"""Frames of isolated stars behind adaptive optics, with the structure that is fixed to the pupil: the truth of tests.

A hexagonal pupil with a hole and six arms; residual phases of the turbulence (von Karman, what the mirror follows
mostly taken off), a waffle of the mirror, a static phase; the mean of many such images, widened by motion that grows
away from a guide star. Around bright stars there are the arms, four spots, the ring where control ends, and speckles.
"""

from dataclasses import dataclass

import numpy as np
from numpy.fft import fft2, fftfreq, fftshift, ifft2

SKY, READ_NOISE = 300.0, 8.0
_N = 256  # px: side of images
_DIAMETER, _ACTUATORS = 10.0, 16  # m; across the pupil

#: Pixels per wavelength / diameter and Fried's parameter [m]: Strehl ratios of about 0.4, 0.4, 0.35 and 0.15.
KINDS = {"sampled": (2.2, 0.5), "fine": (3.2, 0.5), "coarse": (1.4, 0.5), "low": (2.2, 0.32)}


class Telescope:
    """What makes the image of a star; everything random is drawn by `rng`."""

    def __init__(self, rng, *, sampling=2.2, r0=0.5, waffle=0.25, static=0.35, jitter=0.35, growth=1.1, screens=50):
        self.fold = 1 if sampling > 2 else 2  # samples a pixel: two a wavelength / diameter, or light is aliased
        n, sampling = self.fold * _N, self.fold * sampling
        f = fftfreq(n)
        self.fy, self.fx = f[:, None], f[None, :]
        x, y = 2 * sampling * self.fx, 2 * sampling * self.fy  # the pupil's radius is 1
        across = [(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3]
        pupil = (np.hypot(x, y) >= 0.2) & np.all([x * c + y * s <= 0.92 for c, s in across], axis=0)
        for c, s in ((-s, c) for c, s in across):
            pupil &= ~((np.abs(y * c - x * s) < 0.012) & (x * c + y * s > 0))
        step = _DIAMETER * sampling / n
        ky, kx = fftfreq(n, step)[:, None], fftfreq(n, step)[None, :]
        k, cut = np.hypot(kx, ky), _ACTUATORS / (2 * _DIAMETER)
        power = 0.0229 * r0 ** (-5 / 3) * (k**2 + 25.0**-2) ** (-11 / 6)
        left = np.where((np.abs(kx) < cut) & (np.abs(ky) < cut), np.minimum(1, 0.25 * (k / cut) ** 2 + 0.01), 1.0)
        left[0, 0] = 0

        def screen(spectrum):
            return fft2((rng.normal(size=k.shape) + 1j * rng.normal(size=k.shape)) * np.sqrt(spectrum)) / (step * n)

        fixed = screen(np.where((k > 1.5 / _DIAMETER) & (k < 3 * cut), power, 0)).real
        fixed = static * (fixed - fixed[pupil].mean()) / fixed[pupil].std()
        fixed += waffle * np.cos(np.pi * cut * _DIAMETER * x) * np.cos(np.pi * cut * _DIAMETER * y)
        image = np.zeros(k.shape)
        for phases in (screen(power * left) for _ in range(screens)):
            for phase in (phases.real, phases.imag):
                image += np.abs(fft2(pupil * np.exp(1j * (phase + fixed)))) ** 2
        self.strehl = image[0, 0] / image.sum() / (np.abs(fft2(pupil)) ** 2)[0, 0] * (np.abs(fft2(pupil)) ** 2).sum()
        self.transfer = fft2(image / image.sum()) * np.sinc(self.fold * self.fx) * np.sinc(self.fold * self.fy)
        self.jitter, self.growth = jitter * sampling / 2, growth * self.fold / 2
        self.guide = rng.uniform(-1, 1, 2)

    def stamp(self, place, offset=(0.0, 0.0)):
        """A star of unit flux, (n, n), offset (x, y) from the pixel (n / 2, n / 2); place in the field -1 to 1."""
        away = np.subtract(place, self.guide)
        distance = max(np.hypot(*away), 1e-6)
        u, v = away / distance
        more = (self.growth * distance) ** 2
        along, aside = self.fx * u + self.fy * v, self.fy * u - self.fx * v
        blur = (self.jitter**2 + more) * along**2 + (self.jitter**2 + more / 3) * aside**2
        turn = -2j * np.pi * self.fold * (self.fx * offset[0] + self.fy * offset[1])
        image = fftshift(ifft2(self.transfer * np.exp(turn - 2 * np.pi**2 * blur)).real)
        return self.fold**2 * image[:: self.fold, :: self.fold]

    def within(self, radius):
        """Part of the light within a radius [pix]."""
        image, place = self.stamp((0, 0)), np.arange(_N) - _N // 2
        return image[np.hypot(place, place[:, None]) <= radius].sum()

    @property
    def fwhm(self):
        """In the middle of the field, of a circle of the area above half maximum [pix]."""
        places = np.arange(8) / 8
        rows = [
            self.stamp((0, 0), (u, v))[_N // 2 - 16 : _N // 2 + 16, _N // 2 - 16 : _N // 2 + 16]
            for v in places
            for u in places
        ]
        return 2 * np.sqrt(np.count_nonzero(np.array(rows) > np.max(rows) / 2) / np.pi) / 8


@dataclass
class Frame:
    """A frame in electrons.

    Attributes
    ----------
    xy, flux, snr : ndarray
        Of the stars; signal-to-noise ratio of the flux of each at its known place.
    data : ndarray, shape (n, n)
    fwhm : float
        In the middle of the field [pix].
    """

    xy: np.ndarray
    flux: np.ndarray
    snr: np.ndarray
    data: np.ndarray
    fwhm: float


def frame(telescope, rng, *, n=45, size=640, apart=50.0, snr=(5.0, 1500.0), xy=None, flux=None):
    """A frame of isolated stars with signal-to-noise ratios spread evenly in the logarithm."""
    if xy is None:
        xy = np.zeros((0, 2))
        while len(xy) < n:
            place = rng.uniform(12, size - 12, 2)
            if np.all(np.hypot(*(xy - place).T) > apart):
                xy = np.vstack([xy, place])
    middle = telescope.stamp((0, 0))
    ladder = np.geomspace(1e2, 1e8, 120)
    ratios = [np.sqrt(np.sum((f * middle) ** 2 / (SKY + READ_NOISE**2 + np.abs(f * middle)))) for f in ladder]
    if flux is None:
        wanted = 10 ** rng.uniform(*np.log10(snr), len(xy))
        flux = np.exp(np.interp(np.log(wanted), np.log(ratios), np.log(ladder)))
    wide = np.full((size + 2 * _N, size + 2 * _N), SKY)
    for place, light in zip(xy, flux, strict=True):
        x, y = np.round(place).astype(int)
        there = wide[y + _N // 2 : y + 3 * _N // 2, x + _N // 2 : x + 3 * _N // 2]
        there += light * telescope.stamp(2 * place / size - 1, place - (x, y))
    image = np.maximum(wide[_N:-_N, _N:-_N], 0)
    data = rng.poisson(image) + rng.normal(0, READ_NOISE, image.shape)
    return Frame(xy, flux, np.interp(flux, ladder, ratios), data, telescope.fwhm)
