"""Cut-outs of stars in the mosaic and in single exposures, on one grid, for the eye to compare."""

import logging
from dataclasses import dataclass

import numpy as np

from ..exceptions import LegdistortError
from ..results.view import image_view
from .svg import grey

log = logging.getLogger(__name__)

#: Stars and exposures that are shown, and half the side of a cut-out, in FWHM and in pixels at most.
STARS, EXPOSURES, _REACH, _MOST = 12, 8, 5.0, 30


@dataclass(frozen=True)
class Cutout:
    """A star in the mosaic and in some exposures.

    Attributes
    ----------
    star : int
        Its index.
    name : str
    mosaic : str
        PNG in base64.
    exposures : list of (int, str, str)
        Index of the exposure, its name, PNG in base64.
    """

    star: int
    name: str
    mosaic: str
    exposures: list


def cut_out(solution, mosaic, exposures, *, fwhm=4.0):
    """`Cutout` of bright stars all over the mosaic; what exposures show is resampled to its pixels.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        What is shown.
    mosaic : `~legdistort.coaddition.mosaic.Mosaic`
        On the reference plane.
    exposures : sequence of Exposure or ExposureFile
    fwhm : float
        Of the stars, pixels.

    Returns
    -------
    list of Cutout
    """
    if getattr(mosaic, "offset", None) is None or not exposures:
        return []
    half = int(min(_MOST, np.ceil(_REACH * fwhm)))
    t = np.arange(-half, half + 1)
    grid = np.stack(np.meshgrid(t, t), axis=-1).astype(float)
    stars = _spread(solution, mosaic, half)
    places = {star: np.rint(solution.estimate.positions[star]) + grid for star in stars}
    shown = {star: _mosaic_at(mosaic, xy) for star, xy in places.items()}
    cuts = {star: [] for star in stars}
    kept = [(each, view) for each in exposures if (view := image_view(solution, each)) is not None]
    for exposure, view in kept[:: -(-len(kept) // EXPOSURES) or 1]:
        try:
            data = exposure.read()
        except LegdistortError as error:
            log.warning("no cut-outs of %s: %s", exposure.name, error)
            continue
        for star, xy in places.items():
            image = _sample(data, view.distort(xy.reshape(-1, 2)))
            if np.isfinite(image).mean() > 0.8:
                cuts[star].append((view.index, view.name, _drawn(image.reshape(grid.shape[:2]))))
    names = solution.estimate.star_names
    return [Cutout(star, str(names[star]), _drawn(shown[star]), each) for star, each in cuts.items() if each]


def _spread(solution, mosaic, half):
    """Indices of the brightest star of each cell of the mosaic, those without a neighbour in the cut-out."""
    xy = solution.estimate.positions - np.asarray(mosaic.offset)
    ny, nx = np.shape(mosaic.data)
    inside = np.flatnonzero(np.all((xy > half) & (xy < np.array([nx, ny]) - 1 - half), axis=1))
    used = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    if "flux" not in used.colnames or not len(inside):
        return []
    star = np.searchsorted(solution.estimate.star_names, used["star"])
    n = np.maximum(np.bincount(star, minlength=len(xy)), 1)
    flux = np.bincount(star, np.nan_to_num(np.asarray(used["flux"], dtype=float)), len(xy)) / n
    cell = (xy[inside] * [4 / nx, 3 / ny]).astype(int) @ [1, 4]
    order = np.argsort(-flux[inside], kind="stable")
    first = np.unique(cell[order], return_index=True)[1]
    return [int(i) for i in inside[order[np.sort(first)]][:STARS]]


def _mosaic_at(mosaic, xy):
    x, y = (xy - np.asarray(mosaic.offset)).reshape(-1, 2).T.astype(int)
    return np.asarray(mosaic.data[y.min() : y.max() + 1, x.min() : x.max() + 1], dtype=float)


def _sample(exposure, xy):
    """Values of an exposure at pixels (n, 2), by cubic interpolation; NaN near bad pixels and outside."""
    from scipy import ndimage

    if not np.isfinite(xy).any():
        return np.full(len(xy), np.nan)
    ny, nx = exposure.shape
    low = np.maximum(np.floor(np.nanmin(xy, axis=0)).astype(int) - 3, 0)
    high = np.minimum(np.ceil(np.nanmax(xy, axis=0)).astype(int) + 4, (nx, ny))
    if np.any(high - low < 2):
        return np.full(len(xy), np.nan)
    box = np.s_[low[1] : high[1], low[0] : high[0]]
    part, bad = np.asarray(exposure.data[box], dtype=float), exposure.mask[box]
    filled = np.where(bad, np.median(part[~bad]) if (~bad).any() else 0, part)
    at = (xy - low).T[::-1]
    out = ndimage.map_coordinates(filled, np.nan_to_num(at, nan=-9), order=3, mode="constant", cval=np.nan)
    near = ndimage.map_coordinates(bad.astype(float), np.nan_to_num(at, nan=-9), order=1, mode="constant", cval=1)
    return np.where(near > 0.5, np.nan, out)


def _drawn(image):
    low, high = np.nanpercentile(image, [20, 99.9])
    return grey(image, low, high)
