"""Where the stars of a frame are: sky, noise, and the peaks that stand out."""

import logging
import warnings
from dataclasses import dataclass

import numpy as np
from astropy.stats import SigmaClip
from photutils.background import Background2D
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter

log = logging.getLogger(__name__)

_CLIPPED = 0.986  # standard deviation of a unit normal after clipping at 3 sigma until nothing changes
_KERNEL = 0.7  # width relative to the stars: costs 6 % of the signal-to-noise ratio, tells apart closer pairs
_COVERED = 0.2  # part of a star, by its weight in the detection, on good pixels; in the corners of an image it is 0.25
#: Pixels over which the sky is taken as constant.
MESH = 64


@dataclass(frozen=True, eq=False)
class Frame:
    """An exposure ready for fitting.

    Attributes
    ----------
    signal : ndarray, shape (ny, nx)
        Data without the sky; float32, as the variance.
    variance : ndarray, shape (ny, nx)
        Of the sky alone, or of everything if the exposure has an uncertainty plane.
    good, saturated : ndarray of bool, shape (ny, nx)
    photon : float or None
        Variance per unit of star light to be added: 1 / gain, 0 with an uncertainty plane, None if unknown.
    noise_given : bool
        Whether the variance comes from an uncertainty plane.
    """

    signal: np.ndarray
    variance: np.ndarray
    good: np.ndarray
    saturated: np.ndarray
    photon: float | None
    noise_given: bool = False


def prepare(exposure, *, mesh=MESH):
    """An `Exposure` as a `Frame`; `mesh` is that of the sky [pix]."""
    gain, read_noise, saturation = exposure.gain, exposure.read_noise, exposure.saturation
    data = np.where(exposure.mask, 0, exposure.data).astype(np.float32)
    saturated = (data >= saturation) & ~exposure.mask if saturation else np.zeros(data.shape, dtype=bool)
    bad = exposure.mask | saturated
    sky, rms = _background(data, bad, mesh)
    if _is_steep(sky, rms, mesh):  # the slope within the meshes has passed for noise
        sky, _ = _background(data, bad, mesh, steep=True)
        rest, rms = _background(data - sky, bad, mesh // 2, steep=True)
        sky += rest
    if exposure.uncertainty is not None:
        variance = np.where(exposure.mask, 1, exposure.uncertainty**2).astype(np.float32)
        return Frame(data - sky, variance, ~exposure.mask, saturated, 0.0, noise_given=True)
    floor = max(1e-6 * np.ptp(data[~exposure.mask]), read_noise / gain if gain and read_noise else 0.0)
    variance = np.maximum(rms / np.float32(_CLIPPED), np.float32(floor or 1.0)) ** 2
    return Frame(data - sky, variance, ~exposure.mask, saturated, 1 / gain if gain else None)


def _background(data, mask, mesh, *, steep=False):
    """Sky and its standard deviation, smooth maps; of a steep sky no medians of meshes are taken."""
    box = tuple(min(mesh, n) for n in data.shape)
    clip = SigmaClip(sigma=3.0, maxiters=10)
    with warnings.catch_warnings(action="ignore"):  # of meshes without good pixels, which are interpolated
        for exclude in (50.0, 100.0):
            try:
                found = Background2D(
                    data, box, mask=mask, sigma_clip=clip, exclude_percentile=exclude, filter_size=1 if steep else 3
                )
            except ValueError:
                log.debug("background: too few good pixels with exclude_percentile=%g", exclude)
            else:
                rms = found.background_rms_mesh
                sky = _enlarge(found.background_mesh, box, data.shape, degree=3 if steep else 1)
                return sky, _enlarge(rms, box, data.shape).clip(rms.min())
    values = clip(data[~mask] if not mask.all() else data.ravel(), masked=False)
    return np.full_like(data, np.median(values)), np.full_like(data, np.std(values))


def _is_steep(sky, rms, mesh):
    """Whether the sky rises across a mesh by as much as the noise, somewhere."""
    step = max(1, mesh // 2)
    coarse, noise = sky[::step, ::step], rms[::step, ::step]
    return any(np.any(np.abs(np.diff(coarse, axis=i)) > 0.5 * np.delete(noise, 0, axis=i)) for i in (0, 1))


def _enlarge(mesh, box, shape, degree=1):
    """Spline interpolation of a mesh to all pixels (that of photutils takes as long as all the fits)."""
    across = []
    for n_mesh, width, n in zip(mesh.shape, box, shape, strict=True):
        centres, degree_here = (np.arange(n_mesh) + 0.5) * width - 0.5, min(degree, n_mesh - 1)
        across.append(make_interp_spline(centres, np.eye(n_mesh), k=degree_here)(np.arange(n)).astype(np.float32))
    return across[0] @ mesh.astype(np.float32) @ across[1].T


def detect(frame, fwhm, threshold):
    """Peaks of the frame filtered with a Gaussian.

    Parameters
    ----------
    frame : Frame
        From `prepare`.
    fwhm : float
        Of the stars [pix].
    threshold : float
        Signal-to-noise ratio.

    Returns
    -------
    ndarray of int, shape (n, 2)
        Pixels (x, y), the highest signal-to-noise ratio first.
    """
    sigma = _KERNEL * np.sqrt((fwhm / 2.3548) ** 2 + 1 / 12)  # 1/12: the pixel
    weight = np.where(frame.good, 1 / frame.variance, 0)
    # Best linear detection of a Gaussian star in noise that differs from pixel to pixel: sum(g w d) / sqrt(sum(g^2 w)).
    # The square of a Gaussian is a Gaussian narrower by sqrt(2), here with the sum `norm`.
    point = np.zeros((2 * int(4 * sigma + 2) + 1,) * 2)
    point[len(point) // 2, len(point) // 2] = 1
    norm = (_blur(point, sigma) ** 2).sum()
    if frame.good.all() and not frame.noise_given:  # a smooth map needs no smoothing
        below = norm * weight
    else:
        below = norm * _blur(weight, sigma / np.sqrt(2))
        below = np.maximum(below, 1e-6 * below.max())
    ratio = _blur(frame.signal * weight, sigma) / np.sqrt(below)
    if not frame.good.all():  # where most of a star would lie on bad pixels the rest tells little
        ratio[_blur(frame.good.astype(np.float32), sigma / np.sqrt(2)) < _COVERED] = 0
    y, x = np.nonzero(ratio > threshold)
    peak = _is_highest(ratio, x, y, max(1, int(fwhm / 2)))
    x, y = x[peak], y[peak]
    return np.column_stack([x, y])[np.argsort(-ratio[y, x], kind="stable")]


def _blur(image, sigma):
    return gaussian_filter(image, sigma, mode="constant", truncate=3.0)


def _is_highest(image, x, y, reach):
    """Whether pixels are the highest of the square around them; of the few that matter, not of all the image."""
    highest = np.ones(len(x), dtype=bool)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            other = image[np.clip(y + dy, 0, image.shape[0] - 1), np.clip(x + dx, 0, image.shape[1] - 1)]
            highest &= image[y, x] >= other
    return highest
