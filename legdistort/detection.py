"""Where the stars of a frame are: sky, noise, and the peaks that stand out."""

import logging
import warnings
from dataclasses import dataclass

import numpy as np
from astropy.stats import SigmaClip
from photutils.background import Background2D
from scipy.ndimage import gaussian_filter

logger = logging.getLogger(__name__)

_CLIPPED = 0.986  # standard deviation of a unit normal after clipping at 3 sigma until nothing changes
_KERNEL = 0.7  # width relative to the stars: costs 6 % of the signal-to-noise ratio, tells apart closer pairs
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


def prepare(exposure, *, gain=None, read_noise=None, saturation=None, mesh=MESH):
    """An `~legdistort.exposures.Exposure` as a `Frame`; the numbers stand in for its own, `mesh` is that of the sky."""
    gain = gain or exposure.gain
    read_noise = read_noise or exposure.read_noise
    saturation = saturation or exposure.saturation
    data = np.where(exposure.mask, 0, exposure.data).astype(np.float32)
    saturated = (data >= saturation) & ~exposure.mask if saturation else np.zeros(data.shape, dtype=bool)
    sky, rms = _background(data, exposure.mask | saturated, mesh)
    if exposure.uncertainty is not None:
        variance = np.where(exposure.mask, 1, exposure.uncertainty**2).astype(np.float32)
        return Frame(data - sky, variance, ~exposure.mask, saturated, 0.0, noise_given=True)
    floor = max(1e-6 * np.ptp(data[~exposure.mask]), read_noise / gain if gain and read_noise else 0.0)
    variance = np.maximum(rms / np.float32(_CLIPPED), np.float32(floor or 1.0)) ** 2
    return Frame(data - sky, variance, ~exposure.mask, saturated, 1 / gain if gain else None)


def _background(data, mask, mesh):
    """Sky and its standard deviation, smooth maps."""
    box = tuple(min(mesh, n) for n in data.shape)
    clip = SigmaClip(sigma=3.0, maxiters=10)
    with warnings.catch_warnings():  # of meshes without good pixels, which are interpolated
        warnings.simplefilter("ignore")
        for exclude in (50.0, 100.0):
            try:
                found = Background2D(data, box, mask=mask, sigma_clip=clip, exclude_percentile=exclude)
            except ValueError:
                logger.debug("background: too few good pixels with exclude_percentile=%g", exclude)
            else:
                rms = found.background_rms_mesh
                return _enlarge(found.background_mesh, box, data.shape), _enlarge(rms, box, data.shape).clip(rms.min())
    values = clip(data[~mask] if not mask.all() else data.ravel(), masked=False)
    return np.full_like(data, np.median(values)), np.full_like(data, np.std(values))


def _enlarge(mesh, box, shape):
    """Bilinear interpolation of a mesh to all pixels (the cubic one of photutils takes as long as all the fits)."""
    across = []
    for n_mesh, width, n in zip(mesh.shape, box, shape, strict=True):
        place = (np.arange(n) + 0.5) / width - 0.5
        left = np.clip(np.floor(place).astype(int), 0, max(n_mesh - 2, 0))
        share = place - left if n_mesh > 1 else np.zeros(n)
        matrix = np.zeros((n, n_mesh), dtype=np.float32)
        matrix[np.arange(n), left] = 1 - share
        matrix[np.arange(n), np.minimum(left + 1, n_mesh - 1)] += share.astype(np.float32)
        across.append(matrix)
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
    y, x = np.nonzero(ratio > threshold)
    peak = _is_highest(ratio, x, y, max(1, int(fwhm / 2)))
    x, y = x[peak], y[peak]
    order = np.argsort(-ratio[y, x], kind="stable")
    return np.column_stack([x, y])[order]


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
