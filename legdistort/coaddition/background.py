"""Noise and level of the background of an exposure, and the levels that bring all to one."""

from dataclasses import dataclass

import numpy as np

from .pairs import median_differences, values_from_differences
from .resampling.pixel_maps import trace

_BLOCK = 32  # side of the blocks whose medians stand for the background, px


@dataclass(frozen=True, eq=False, repr=False)
class Background:
    """Background of an exposure.

    Attributes
    ----------
    name : str
        Of the exposure.
    shape : tuple
        ``(ny, nx)`` of the exposure.
    noise : float
        In the unit of the data.
    medians : ndarray
        Of blocks of about 32 x 32 px.
    photons : float
        Variance of a pixel per unit of its signal above the background, by its uncertainty plane; zero without one.
    """

    name: str
    shape: tuple
    noise: float
    medians: np.ndarray
    photons: float = 0.0

    @property
    def level(self):
        """Median of all."""
        return float(np.median(self.medians))

    def sky_variance(self, data, variance):
        """Variance of pixels without the photons of stars, which would give stars less weight the brighter they are.

        Parameters
        ----------
        data, variance : ndarray
            A piece of the exposure.

        Returns
        -------
        ndarray
            At least a quarter of the variance of the background.
        """
        return np.maximum(variance - self.photons * np.maximum(data - self.level, 0), self.noise**2 / 4)


def measure_background(exposure, *, bad, filled):
    """The `Background` of an exposure.

    Parameters
    ----------
    exposure : `~legdistort.inputs.exposures.Exposure`
    bad : ndarray of bool, shape (ny, nx)
        Pixels that must not be used.
    filled : ndarray, shape (ny, nx)
        Its data with these replaced.
    """
    noise, medians = _noise(exposure, bad), _block_medians(filled)
    return Background(exposure.name, exposure.shape, noise, medians, _photons(exposure, bad, noise, np.median(medians)))


def _photons(frame, bad, noise, level):
    if frame.uncertainty is None:
        return 0.0
    signal, bright = frame.data - level, ~bad
    bright &= signal > 10 * noise
    if np.count_nonzero(bright) < 20:
        return 0.0
    return max(0.0, float(np.median((frame.uncertainty[bright] ** 2 - noise**2) / signal[bright])))


def _noise(frame, bad):
    """Background noise: median of the uncertainties, or from the differences of neighbours.

    Stars and gradients hardly touch these differences. Zero if there is none that float32 could hold.
    """
    step = max(1, frame.shape[0] // 512)
    data = np.where(bad[::step], np.nan, (frame.data if frame.uncertainty is None else frame.uncertainty)[::step])
    if frame.uncertainty is not None:
        return float(np.nanmedian(data))
    difference = np.abs(np.diff(data, axis=1))
    difference = difference[np.isfinite(difference)]
    if not difference.any():
        return 0.0
    # The median of whole numbers is coarse: the rms within 3 sigma of it, 0.987 of that of a Gaussian, is finer.
    core = difference[difference <= 3 * max(1.4826 * np.median(difference), difference[difference > 0].min())]
    sigma = float(np.sqrt(np.mean(core**2)) / 0.987 / np.sqrt(2))
    return sigma if sigma > np.finfo(np.float32).eps * np.max(np.abs(frame.data), where=~bad, initial=0) else 0.0


def _block_medians(data):
    ny, nx = (max(1, n // _BLOCK) for n in data.shape)
    by, bx = data.shape[0] // ny, data.shape[1] // nx  # what is over at the end, less than one block, is left out
    blocks = data[: ny * by, : nx * bx].reshape(ny, by, nx, bx).swapaxes(1, 2)[:, :, ::2]  # half of them are enough
    return np.median(blocks.reshape(ny, nx, -1), axis=2)


def match_backgrounds(backgrounds, views, output, factors):
    """Background level of every exposure, by differences of block medians where exposures overlap.

    Parameters
    ----------
    backgrounds : sequence of Background
    views : dict
        ``{name: View}``.
    output : `legdistort.coaddition.grids.Grid`
    factors : dict
        Flux scale of each exposure; the levels are at this scale.

    Returns
    -------
    dict
        Levels of exposures that do not overlap, even through others, are their own medians.
    """
    ny, nx = output.shape
    n_points = min(4096, max(400, 400_000 // len(backgrounds)))
    step = np.sqrt(ny * nx / n_points)
    gx, gy = np.meshgrid(np.arange(step / 2, nx, step), np.arange(step / 2, ny, step))
    points = np.stack([gx.ravel(), gy.ravel()], axis=1)
    samples = np.full((len(backgrounds), len(points)), np.nan)
    own = np.empty(len(backgrounds))
    for i, each in enumerate(backgrounds):
        blocks = factors[each.name] * each.medians
        own[i] = np.median(blocks)
        xy = trace(points, views[each.name], output)[:, :2]
        inside = np.all((xy >= -0.5) & (xy < np.array(each.shape[::-1]) - 0.5), axis=1)
        column, row = ((xy[inside] + 0.5) * np.array(blocks.shape[::-1]) / each.shape[::-1]).astype(int).T
        samples[i, inside] = blocks[row, column]
    levels = values_from_differences(*median_differences(samples), own)
    return dict(zip([b.name for b in backgrounds], levels, strict=True))
