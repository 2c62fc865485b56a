"""Pieces that pictures are made of: axes, titles, ticks, grids, round numbers, block means."""

from copy import deepcopy
from functools import cache

import numpy as np

from ..exceptions import InputError
from ..geometry import basis

#: Colours that stay apart for colour-blind readers and in grey print (Okabe & Ito).
BLUE, ORANGE, RED, GREEN, GREY = "#0072B2", "#E69F00", "#D55E00", "#009E73", "#9a9a9a"

_GRID_LINES = 11
_SAME = 1e-4  # pixels by which places may differ on an image that has the WCS of the axes


def round_down(value):
    """Largest of ..., 0.1, 0.2, 0.5, 1, 2, 5, 10, ... that is not above a positive `value`."""
    if not (np.isfinite(value) and value > 0):
        return 1.0
    power = float(np.floor(np.log10(value)))
    steps = [float(f"{digit}e{int(power)}") for digit in (1, 2, 5, 10)]
    return max(s for s in steps if s <= value * (1 + 1e-9))


def new_axes(ax, size):
    """The axes given, or the only ones of a new figure of this size in inches."""
    return new_figure(None, size).subplots() if ax is None else ax


def new_figure(fig, size):
    """The figure given, or a new one, set to this size in inches."""
    if fig is None:
        from matplotlib import pyplot

        fig = pyplot.figure(layout="constrained")
    fig.set_size_inches(size)
    return fig


def set_title(ax, text, size="medium"):
    """Title at the left, taken literally."""
    ax.set_title(text, fontsize=size, loc="left", parse_math=False)  # a name may hold a dollar sign


def shorten(name, length=44):
    """A name cut in its middle to a length."""
    return name if len(name) <= length else f"{name[: length // 2]}…{name[1 - length // 2 :]}"


def set_log_grid(ax):
    """Grid, and labels at 1, 2, 5 where a logarithmic axis is short, at powers of ten where it is long."""
    from matplotlib import ticker

    for axis in (each for each in (ax.xaxis, ax.yaxis) if each.get_scale() == "log"):
        low, high = axis.get_view_interval()
        axis.set_minor_formatter(ticker.NullFormatter())
        if high < 300 * low:
            axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if high > 8 * low else (1, 1.5, 2, 3, 4, 5, 6, 8)))
            axis.set_major_formatter(ticker.FormatStrFormatter("%g"))
    ax.grid(linewidth=0.3)


def peak(coefficients):
    """Largest displacement on the detector, per axis."""
    t = np.linspace(-1, 1, 17)
    u, v = np.meshgrid(t, t)
    degree = basis.degree_of(coefficients.shape[1])
    return float(np.abs(np.tensordot(coefficients, basis.values(degree, u, v), 1)).max())


def mark(artist, *, stars=None, exposures=None):
    """Say which stars and exposures the members of a collection, or axes, belong to, by their indices.

    The SVG has it as the ``id`` of a group, ``marks:s=1,2:e=0,0``; other files have nothing of it.
    """
    given = {"s": stars, "e": exposures}
    keys = (f"{key}={','.join(map(str, each))}" for key, each in given.items() if each is not None)
    artist.set_gid(":".join(["marks", *keys]))


def on_sky(ax):
    """Whether axes are WCSAxes of astropy, whose coordinates are pixels of their own WCS."""
    return hasattr(ax, "get_coords_overlay")


def to_axes(ax, xy, wcs):
    """Pixels (..., 2) of an image in the coordinates of axes: of WCSAxes by the sky, if need be, of others as they are.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
    xy : array_like, shape (..., 2)
    wcs : callable or None
        Returns the WCS of the image. None: pixels of the image are those of the axes.

    Raises
    ------
    InputError
        If WCSAxes and image have no sky in common, or the image is not on theirs.
    """
    xy = np.asarray(xy, dtype=float)
    if wcs is None or not on_sky(ax):
        return xy
    from astropy.wcs import NoConvergence
    from astropy.wcs.utils import pixel_to_pixel

    own = _unbounded(wcs())
    try:
        there = np.stack(pixel_to_pixel(own, _unbounded(ax.wcs), xy[..., 0], xy[..., 1]), axis=-1)
    except (TypeError, ValueError, AttributeError, NoConvergence) as error:
        raise InputError(
            "the picture cannot be drawn on these WCSAxes: its WCS and theirs must lie on the sky, with two axes; give "
            "axes without projection, or solve with frames whose headers have a WCS"
        ) from error
    if np.any(np.isfinite(xy) & ~np.isfinite(there)):
        raise InputError("the picture lies outside of the sky that these WCSAxes project: give axes of its own field")
    return xy if np.allclose(there, xy, rtol=0, atol=_SAME) else there  # an edge stays what a WCS is defined on


def _unbounded(wcs):
    """A WCS that has values outside its image, where magnified arrows end."""
    if getattr(wcs, "bounding_box", None) is None:
        return wcs
    wcs = deepcopy(wcs)
    wcs.bounding_box = None
    return wcs


def frame(ax, low, high, wcs):
    """Limit axes to pixels of an image between two corners, (x, y) each, and say what they are.

    WCSAxes, which say that themselves, get the limits of what holds the corners; `wcs` is that of `to_axes`.
    """
    corners = to_axes(ax, [low, (high[0], low[1]), high, (low[0], high[1])], wcs)
    low, high = corners.min(axis=0), corners.max(axis=0)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    if not on_sky(ax):
        ax.set(xlabel="x [px]", ylabel="y [px]")


def draw_cells(ax, x, y, values, wcs, **style):
    """Cells in colour between edges x (n_x + 1,) and y (n_y + 1,), pixels of an image; `wcs` is that of `to_axes`."""
    corners = to_axes(ax, np.stack(np.meshgrid(x, y), axis=-1), wcs)
    return ax.pcolormesh(corners[..., 0], corners[..., 1], np.ma.masked_invalid(values), rasterized=True, **style)


def draw_lines(ax, segments, **style):
    """Straight lines (n, 2, 2), with the limits of the axes following them."""
    from matplotlib.collections import LineCollection

    lines = ax.add_collection(LineCollection(segments, **style))
    ax.autoscale_view()
    return lines


def draw_grid(ax, shape, coefficients, **style):
    """Grid lines over the detector, displaced by a Legendre series."""
    from matplotlib.collections import LineCollection

    paths = []
    for u, v, modes in _grid(basis.degree_of(coefficients.shape[1])):
        shift = np.tensordot(coefficients, modes, 1)
        paths.extend(basis.denormalize(u, v, shape) + np.moveaxis(shift, 0, -1))
    ax.add_collection(LineCollection(paths, **style))


@cache
def _grid(degree):
    """Normalised coordinates and Legendre modes along the lines of a grid, those along x and those along y."""
    lines, along = np.linspace(-1, 1, _GRID_LINES), np.linspace(-1, 1, 6 * degree + 1)
    u, v = np.meshgrid(along, lines)
    return [(*at, basis.values(degree, *at)) for at in ((u, v), (v, u))]


def draw_image(ax, image, *, sky, soft, low, high, extent, wcs=None):
    """An image in asinh stretch, dark on light; pixels without data are pale blue.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
    image : ndarray, shape (ny, nx)
        NaN where there are no data.
    sky, soft : float
        The value in the middle of the stretch and that above it where it turns from linear to logarithmic.
    low, high : float
        Where it ends, in stretched values.
    extent : tuple
        As matplotlib takes it.
    wcs : callable, optional
        That of `to_axes`, where the axes may be WCSAxes.
    """
    from matplotlib import colormaps

    values = np.arcsinh((image - sky) / soft)
    style = {"vmin": low, "vmax": high, "cmap": colormaps["gray_r"].with_extremes(bad="#cfe0f1")}
    corners = np.reshape(extent, (2, 2)).T
    if wcs is None or np.array_equal(to_axes(ax, corners, wcs), corners):
        ax.imshow(np.ma.masked_invalid(values), origin="lower", extent=extent, **style)
    else:
        edges = (np.linspace(*limits, n + 1) for limits, n in zip(corners.T, values.shape[::-1], strict=True))
        draw_cells(ax, *edges, values, wcs, **style)


def running_median(x, y, per_bin=8):
    """Medians of x and y in bins of about equal number along x, by increasing x."""
    bins = np.array_split(np.argsort(x), int(np.clip(len(x) // per_bin, 1, 20)))
    if len(bins) == 1:
        return np.sort(x), np.full(len(x), np.median(y))
    return np.array([np.median(x[b]) for b in bins]), np.array([np.median(y[b]) for b in bins])


def block_mean(image, block):
    """Mean over square blocks of the finite pixels; incomplete blocks at the far edges are filled up with NaN."""
    image = np.pad(image, [(0, -n % block) for n in image.shape], constant_values=np.nan)
    cells = image.reshape(image.shape[0] // block, block, -1, block)
    finite = np.isfinite(cells)
    with np.errstate(invalid="ignore"):  # 0 / 0 = NaN where a block is empty
        return np.where(finite, cells, 0).sum(axis=(1, 3), dtype=float) / finite.sum(axis=(1, 3))
