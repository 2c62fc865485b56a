"""Screens of turbulence by numpy and scipy alone: gradients of wavefronts with von Karman's spectrum."""

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import j1

N = 1024


def spectrum(*, width, outer, aperture):
    """Amplitude of the wavefront by frequency (N, N), kx and ky: a plane four detectors wide, averaged over apertures.

    `width` of a detector in the layer, `outer` scale, and `aperture`, all in one unit.
    """
    k = 2 * np.pi * np.fft.fftfreq(N, 4 * width / N)
    kx, ky = np.meshgrid(k, k)
    far = np.hypot(kx, ky)
    inside = np.where(far > 0, far, 1) * aperture / 2
    amplitude = (far**2 + (2 * np.pi / outer) ** 2) ** (-11 / 12) * np.where(far > 0, 2 * j1(inside) / inside, 1)
    amplitude[0, 0] = 0
    return amplitude, kx, ky


def screens(n, seed, *, rms, size=2048, **layer):
    """n functions of positions (m, 2) in pixels of a detector: displacements (m, 2) of `rms` px an axis."""
    layer = {"width": 10.0, "outer": 25.0, "aperture": 1.0, **layer}
    rng, (amplitude, kx, ky) = np.random.default_rng(seed), spectrum(**layer)
    unit = rms / np.sqrt(np.sum(amplitude**2 * (kx**2 + ky**2)) / 2) * N

    def screen():
        wave = np.fft.fft2(rng.normal(size=(N, N))) * amplitude
        slopes = [unit * np.fft.ifft2(1j * k * wave).real for k in (kx, ky)]

        def displacements(xy):
            column, row = (np.asarray(xy).T + size / 4) * N / (4 * size)
            return np.stack([map_coordinates(s, [row, column], order=3, mode="grid-wrap") for s in slopes], axis=1)

        return displacements

    return [screen() for _ in range(n)]


def covariance(places, others, *, rms, size=2048, **layer):
    """Covariance (2 n, 2 m) of the displacements of a screen, x and y of each place."""
    layer = {"width": 10.0, "outer": 25.0, "aperture": 1.0, **layer}
    amplitude, kx, ky = spectrum(**layer)
    power = amplitude**2 / (np.sum(amplitude**2 * (kx**2 + ky**2)) / 2) * rms**2 * N**2
    apart = (places[:, None] - others[None]) * N / (4 * size)
    out = np.empty((len(places), 2, len(others), 2))
    for a, one in enumerate((kx, ky)):
        for b, other in enumerate((kx, ky)):
            field = np.fft.ifft2(power * one * other).real
            out[:, a, :, b] = map_coordinates(field, [apart[..., 1], apart[..., 0]], order=3, mode="grid-wrap")
    return out.reshape(2 * len(places), 2 * len(others))
