"""Where the stars of a frame are: sky, noise, and the peaks that stand out."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation

from ..inputs.frames.statement import piled_up
from .filters import gaussian_sums
from .sky.amplifiers import amplifier_levels
from .sky.background import is_steep, sky_and_noise, sky_variance
from .sky.smooth_light import mean_light, smooth_light
from .structure.pupil import pupil_structure
from .structure.sidelobes import side_light

_CLIPPED = 0.986  # standard deviation of a unit normal after clipping at 3 sigma until nothing changes
_KERNEL = 0.7  # width relative to the stars: costs 6 % of the signal-to-noise ratio, distinguishes closer pairs
_LOCAL = 5.0  # width of the local mean taken off, in that of the kernel: costs another 6 %, and removes halos
_EXTRAPOLATED = 0.5  # of a local light that is extrapolated, over an edge, part that may be wrong
_STANDS_OUT = 5.0  # signal-to-noise ratio of bright peaks
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
        Of the sky alone, or of everything if the exposure has an uncertainty plane. From `prepare` it holds the
        structure of crowded fields too, which `detect` takes out.
    sky : ndarray, shape (ny, nx)
        What was taken off.
    good, saturated : ndarray of bool, shape (ny, nx)
    photon : float or None
        Variance per unit of star light to be added: 1 / gain, 0 with an uncertainty plane, None if unknown.
    noise_given : bool
        Whether the variance comes from an uncertainty plane.
    floor : float
        The least that the variance of the sky can be.
    levels : ndarray, shape (ny, nx), or None
        Of amplifiers, the part of the sky that has steps (`legdistort.measurement.sky.amplifiers.amplifier_levels`).
    defects : ndarray of bool, shape (ny, nx), or None
        Pixels that belong to no star (`legdistort.measurement.profiles.defects`): the signal has the light around them,
        no fit counts them. From `prepare` None.
    """

    signal: np.ndarray
    variance: np.ndarray
    sky: np.ndarray
    good: np.ndarray
    saturated: np.ndarray
    photon: float | None
    noise_given: bool = False
    floor: float = 0.0
    levels: np.ndarray | None = None
    defects: np.ndarray | None = None


def prepare(exposure, *, mesh=MESH, before=None):
    """An `Exposure` as a `Frame`.

    Parameters
    ----------
    exposure : Exposure
    mesh : int
        Pixels over which the sky is taken as constant.
    before : Frame, optional
        The same exposure with another mesh: its amplifiers are not looked for once more.

    Returns
    -------
    Frame
    """
    gain, read_noise, saturation = exposure.gain, exposure.read_noise, exposure.saturation
    data = np.where(exposure.mask, 0, exposure.data).astype(np.float32)
    saturation = saturation or piled_up(data)  # flat tops that no header mentions
    saturated = (data >= saturation) & ~exposure.mask if saturation else np.zeros(data.shape, dtype=bool)
    bad = exposure.mask | saturated
    levels = amplifier_levels(data, bad) if before is None else before.levels
    if levels is not None:
        data -= levels
    sky, rms = sky_and_noise(data, bad, mesh)
    if is_steep(sky, rms, mesh):  # the slope within the meshes has passed for noise
        sky, _ = sky_and_noise(data, bad, mesh, steep=True)
        rest, rms = sky_and_noise(data - sky, bad, mesh // 2, steep=True)
        sky += rest
    if exposure.uncertainty is not None:
        variance = np.where(exposure.mask, 1, exposure.uncertainty**2).astype(np.float32)
        noise = {"photon": 0.0, "noise_given": True}
        return _frame(data, sky, levels, variance=variance, good=~exposure.mask, saturated=saturated, **noise)
    floor = max(1e-6 * np.ptp(data[~exposure.mask]), read_noise / gain if gain and read_noise else 0.0)
    floor = float(floor or 1.0) ** 2
    variance = np.maximum((rms / np.float32(_CLIPPED)) ** 2, np.float32(floor))
    noise = {"photon": 1 / gain if gain else None, "floor": floor}
    return _frame(data, sky, levels, variance=variance, good=~exposure.mask, saturated=saturated, **noise)


def _frame(data, sky, levels, **rest):
    signal = data - sky
    return Frame(signal=signal, sky=sky if levels is None else sky + levels, levels=levels, **rest)


def bright_peaks(frame, fwhm):
    """Peaks that stand out of the light around them, among them all bright stars: they show how wide stars are.

    Parameters
    ----------
    frame : Frame
    fwhm : float
        Of the stars, roughly [pix].

    Returns
    -------
    ndarray of int, shape (n, 2)
        Pixels (x, y), the highest signal-to-noise ratio first.
    """
    sigma = _kernel(fwhm)
    seen = frame.good & ~frame.saturated
    signal = frame.signal if frame.good.all() else np.where(frame.good, frame.signal, np.float32(0))
    filtered, norm = _blur(signal, sigma), np.float32(_norm(sigma))
    y, x = _above(filtered, _STANDS_OUT, norm, frame.variance)
    mean, step = mean_light(signal, seen, _LOCAL * sigma)
    ratio = (filtered[y, x] - mean[y // step, x // step]) / np.sqrt(norm * frame.variance[y, x])
    use = (ratio > _STANDS_OUT) & _is_highest(filtered, x, y, max(1, int(fwhm / 2)))
    return np.column_stack([x, y])[use][np.argsort(-ratio[use], kind="stable")]


def sky_noise(frame, fwhm):
    """The frame with the variance of the sky alone, as `detect` gives it, without a look for stars."""
    return _filtered(frame, fwhm)[0]


def detect(frame, fwhm, threshold):
    """Peaks of the frame filtered with a Gaussian from which the local light has been taken off.

    The kernel has zero sum, so that no halo of a star and no error of the sky passes for stars; the noise is that of
    the sky and of the photons of the local light. What other bright stars have at the same vector offset is taken off
    (`legdistort.measurement.structure.pupil`). Peaks no brighter than the side lobes of other stars at the same
    distance from a bright one are left out (`legdistort.measurement.structure.sidelobes`).

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
    centres : ndarray of int, shape (n, 2)
        Pixels (x, y), the highest signal-to-noise ratio first.
    frame : Frame
        With the variance of the sky alone, as seen where there are no stars; unchanged if the noise was given.
    """
    sigma = _kernel(fwhm)
    frame, residual, filtered, noise, (extrapolated, step) = _filtered(frame, fwhm)
    image, variance = _best(residual, filtered, noise, frame, sigma)
    reach = max(1, int(fwhm / 2))
    x, y = _peaks(image, variance, threshold, reach)
    bad = frame.saturated if frame.defects is None else frame.saturated | frame.defects
    spoilt = binary_dilation(bad, iterations=int(np.ceil(2 * sigma))) if bad.any() else None
    if (structure := pupil_structure(image, variance, x, y, fwhm, threshold, hidden=spoilt)) is not None:
        image, variance = image - structure[0], variance + structure[1]
        x, y = _peaks(image, variance, threshold, reach)
    ratio = image[y, x] / np.sqrt(variance[y, x])
    # of the light of a peak, the part that is neither a side lobe nor an error of the light taken off
    other = side_light(filtered, x, y, fwhm, hidden=spoilt) + _EXTRAPOLATED * extrapolated[y // step, x // step]
    star = ratio * (1 - other / np.maximum(filtered[y, x], np.finfo(np.float32).tiny)) > threshold
    return np.column_stack([x, y])[star][np.argsort(-ratio[star], kind="stable")], frame


def _filtered(frame, fwhm):
    """The frame with its variance; what local light leaves, that filtered, its noise, what is extrapolated."""
    sigma = _kernel(fwhm)
    seen = frame.good & ~frame.saturated
    # The sky is put back: in crowded fields its map follows the halos, in steps that would pass for stars.
    sky = frame.sky if frame.levels is None else frame.sky - frame.levels
    residual = frame.signal + sky
    light, extrapolated, step = smooth_light(residual, seen, _LOCAL * sigma, variance=frame.variance)
    residual -= light
    residual[~frame.good] = 0
    light -= sky
    filtered, norm = _blur(residual, sigma), np.float32(_norm(sigma))
    variance = frame.variance
    if not frame.noise_given:
        variance, photon = sky_variance(
            residual, filtered, light, frame.good, start=variance, noise=norm, photon=frame.photon, mesh=MESH,
            floor=frame.floor,
        )  # fmt: skip
        frame = replace(frame, variance=variance)
        variance = variance + np.float32(photon) * np.maximum(light, 0, out=light)
    return frame, residual, filtered, (norm, variance), (extrapolated, step)


def peaks_above(image, limit, reach):
    """Pixels, x and y, that exceed a limit and are the highest of the square around them.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
    limit : float
    reach : int
        Half the side of the square [pix].
    """
    y, x = _exceeding(image, limit)
    peak = _is_highest(image, x, y, reach)
    return x[peak], y[peak]


def _kernel(fwhm):
    """Standard deviation of the kernel [pix]."""
    return _KERNEL * np.sqrt((fwhm / 2.3548) ** 2 + 1 / 12)  # 1/12: the pixel


def _norm(sigma):
    """Sum of the squares of the kernel of zero sum."""
    half = int(3 * _LOCAL * sigma + 3 * sigma) + 2
    point = np.zeros((2 * half + 1,) * 2)
    point[half, half] = 1
    kernel = _blur(point, sigma)
    return ((kernel - _blur(kernel, _LOCAL * sigma)) ** 2).sum()


def _peaks(image, variance, threshold, reach):
    """Pixels, x and y, that exceed the noise by the threshold and are the highest around them."""
    y, x = _exceeding(image, threshold * np.sqrt(variance.min()))  # few are left to be compared with their own noise
    above = image[y, x] > threshold * np.sqrt(variance[y, x])
    x, y = x[above], y[above]
    peak = _is_highest(image, x, y, reach)
    return x[peak], y[peak]


def _best(residual, filtered, noise, frame, sigma):
    """Height of a star at every pixel, and its variance, infinite where nothing is known.

    Best linear estimate of a Gaussian star in noise that differs from pixel to pixel, sum(g w d) / sum(g^2 w), in units
    of the filtered image; `noise` is the norm of the kernel and the variance of the image.
    """
    norm, variance = noise
    if frame.good.all() and not frame.noise_given:  # a smooth map of the variance needs no smoothing
        return filtered, norm * variance
    weight = np.where(frame.good, 1 / (norm * variance), 0)
    # The square of a Gaussian is a Gaussian narrower by sqrt(2).
    below = _blur(weight, sigma / np.sqrt(2))
    below = np.maximum(below, 1e-6 * below.max())
    image = _blur(residual * weight, sigma) / below
    if not frame.good.all():  # where most of a star would lie on bad pixels the rest determines little
        unknown = _blur(frame.good.astype(np.float32), sigma / np.sqrt(2)) < _COVERED
        image[unknown], below[unknown] = 0, np.float32(1e-30)
    return image, 1 / below


def _blur(image, sigma):
    return gaussian_sums(image, sigma)[0]


def _above(image, ratio, norm, variance):
    """Pixels, y and x, in which an image exceeds its noise, of the variance norm * variance, by a ratio."""
    y, x = _exceeding(image, ratio * np.sqrt(norm * variance.min()))  # few are left to be compared with their own noise
    above = image[y, x] > ratio * np.sqrt(norm * variance[y, x])
    return y[above], x[above]


def _exceeding(image, limit):
    """Pixels, y and x, in which an image exceeds a number."""
    return np.divmod(np.flatnonzero(image > limit), image.shape[1])  # ten times as fast as np.nonzero


def _is_highest(image, x, y, reach):
    """Whether pixels are the highest of the square around them; of the few that matter, not of all the image."""
    steps = [(dy, dx) for dy in range(-reach, reach + 1) for dx in range(-reach, reach + 1)]
    left, value, flat, (ny, nx) = np.arange(len(x)), image[y, x], image.ravel(), image.shape
    highest = np.zeros(len(x), dtype=bool)
    for dy, dx in sorted(steps, key=lambda step: abs(step[0]) + abs(step[1])):  # next to it most are decided
        stays = value >= flat[np.clip(y + dy, 0, ny - 1) * nx + np.clip(x + dx, 0, nx - 1)]
        left, value, y, x = (kept[stays] for kept in (left, value, y, x))
    highest[left] = True
    return highest
