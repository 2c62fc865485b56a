"""The output grid of a mosaic: that of the reference plane, or one that is given, also by a file."""

import logging
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from ..exceptions import InputError, without_astropy_warnings
from ..geometry.tangent_plane import TangentPlane
from ..inputs.file_images import plane_shape
from ..inputs.frames.header_texts import headers_of, read_text
from ..inputs.sky_wcs import image_wcs
from ..runtime.checks import check_is_file
from ..runtime.fits_bytes import open_fits


@dataclass(frozen=True, eq=False)
class Grid:
    """Pixel grid of a mosaic.

    Attributes
    ----------
    shape : tuple
        ``(ny, nx)``.
    wcs : `~astropy.wcs.WCS`
        Celestial, or linear (world = reference plane) if the sky is not known.
    offset : tuple of int or None
        ``(ox, oy)``: a pixel (x, y) lies at (x + ox, y + oy) on the reference plane. None = elsewhere on the sky.
    sky : `~legdistort.geometry.tangent_plane.TangentPlane` or None
    """

    shape: tuple
    wcs: WCS
    offset: tuple | None = None
    sky: TangentPlane | None = None

    def to_reference(self, xy):
        """Output pixels (n, 2) -> reference plane."""
        if self.offset is not None:
            return xy + np.array(self.offset)
        return self.sky.from_sky(self.wcs.pixel_to_world(xy[:, 0], xy[:, 1]))

    def from_reference(self, xy):
        """Reference plane (n, 2) -> output pixels."""
        if self.offset is not None:
            return xy - np.array(self.offset)
        return np.stack(self.wcs.world_to_pixel(self.sky.to_sky(xy)), axis=-1)

    def pixel_area(self, xy):
        """Area of output pixels (n, 2), in pixels of the reference plane."""
        if self.offset is not None:
            return np.ones(len(xy))
        step = np.array([0.5, 0.0])
        dx = self.to_reference(xy + step) - self.to_reference(xy - step)
        dy = self.to_reference(xy + step[::-1]) - self.to_reference(xy - step[::-1])
        return np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])


def outline(shape, n=65):
    """Points along the outermost pixel centres of a detector ``(ny, nx)``, shape (4 n, 2)."""
    ny, nx = shape
    t, one = np.linspace(0, 1, n), np.ones(n)
    sides = [(t, 0 * one), (t, one), (0 * one, t), (one, t)]
    return np.concatenate([np.stack(s, axis=1) for s in sides]) * [nx - 1, ny - 1]


log = logging.getLogger(__name__)

_FLAT = 1e6  # ratio of the sides of a pixel that is none


def reference_grid(views, sky):
    """The smallest grid of reference-plane pixels that holds all exposures.

    Parameters
    ----------
    views : sequence of View
    sky : TangentPlane or None
        Where the reference plane lies on the sky.

    Returns
    -------
    Grid
        Its pixels are pixels of the reference plane, shifted by whole pixels.
    """
    edges = np.concatenate([view.correct(outline(view.shape)) for view in views])
    low = np.ceil(edges.min(axis=0) - 1e-6).astype(int)
    nx, ny = np.floor(edges.max(axis=0) + 1e-6).astype(int) - low + 1
    wcs = WCS(naxis=2)
    wcs.array_shape = (ny, nx)
    if sky is None:
        wcs.wcs.ctype = ["LINEAR", "LINEAR"]
        wcs.wcs.crpix = 1 - low
        wcs.wcs.crval = [0, 0]
    else:
        matrix = np.asarray(sky.matrix, dtype=float)
        wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
        wcs.wcs.cunit = ["deg", "deg"]
        wcs.wcs.cd = matrix[:, :2]
        wcs.wcs.crval = [sky.lon, sky.lat]
        wcs.wcs.crpix = np.linalg.solve(matrix[:, :2], -matrix[:, 2]) - low + 1
        wcs.wcs.radesys = "ICRS"
    wcs.wcs.set()
    log.info("mosaic of %d x %d px on the reference plane", nx, ny)
    return Grid((int(ny), int(nx)), wcs, (int(low[0]), int(low[1])), sky)


def checked_wcs(grid):
    """The WCS, a copy, of a grid given as a celestial WCS or FITS header with a shape; `InputError` if it is none."""
    if isinstance(grid, fits.Header):
        try:
            wcs = image_wcs(grid)
            wcs.wcs.set()
        except Exception as error:  # whatever a broken header provokes, in wcslib too
            raise InputError(f"grid: no WCS can be read from the header ({' '.join(str(error).split())})") from None
    elif isinstance(grid, WCS):
        wcs = grid.deepcopy()
    else:
        raise InputError(f"grid must be None, an astropy WCS or a FITS header, got {type(grid).__name__}")
    if not wcs.has_celestial or wcs.naxis != 2:
        raise InputError("grid must have two axes, both celestial; grid=None takes the reference plane")
    if wcs.array_shape is None:
        raise InputError(
            "grid has no shape: give NAXIS1 and NAXIS2 in the header, or set wcs.array_shape = (ny, nx); the .head of "
            "a frame, as legdistort attach --head writes it, has none: give the stack that SWarp made (--grid STACK)"
        )
    _check_pixels(wcs, "grid")
    return wcs


def given_grid(grid, sky):
    """The `Grid` of a celestial WCS or FITS header with a shape.

    Raises
    ------
    InputError
        If it is none, or the solution is not tied to the sky.
    """
    wcs = checked_wcs(grid)
    if sky is None:
        raise InputError(
            "the solution is not tied to the sky, so it cannot be put on a celestial grid; "
            "measure frames with a header WCS, or give grid=None"
        )
    return Grid(tuple(int(n) for n in wcs.array_shape), wcs, None, sky)


def read_grid(path):
    """WCS and shape of an image, or of the text of its header, for `legdistort.coadd`.

    Parameters
    ----------
    path : str or path
        A FITS file, whose first image with two axes on the sky is taken; or a text with one card a line, as
        `astropy.io.fits.Header.totextfile` and SWarp (``.head``) have it, up to its first END.

    Returns
    -------
    `~astropy.wcs.WCS`
        With ``array_shape`` if the file states it. What no grid can be made of is refused by `legdistort.coadd`.

    Raises
    ------
    InputError
        If the file is neither of these, or its WCS cannot be read.
    """
    path = Path(path)
    check_is_file(path)
    with path.open("rb") as file:
        start = file.read(2880)
    packed = start.startswith((b"\x1f\x8b", b"BZh"))
    if not packed and b"\0" in start:
        raise InputError(f"{path}: neither a FITS file nor the text of a FITS header")
    is_image = packed or re.match(rb"SIMPLE  =[^\n]*\Z", start)
    try:
        with without_astropy_warnings():  # of headers that astropy repairs
            wcs = _of_image(path) if is_image else _of_text(path)
            wcs.wcs.set()
    except Exception as error:  # whatever a broken file provokes, in wcslib too
        raise InputError(f"{path}: no grid can be read from it ({' '.join(str(error).split())})") from None
    _check_pixels(wcs, path)
    return wcs


def _check_pixels(wcs, name):
    if not all(isinstance(n, int | np.integer) and n > 0 for n in wcs.array_shape or ()):
        raise InputError(f"{name}: NAXIS1 and NAXIS2 must be positive whole numbers, got {wcs.pixel_shape}")
    if not np.isfinite([*wcs.wcs.crpix, *wcs.wcs.crval]).all():
        raise InputError(f"{name}: CRPIX and CRVAL of its WCS must be finite, got {wcs.wcs.crpix} and {wcs.wcs.crval}")
    matrix = wcs.pixel_scale_matrix
    if not np.isfinite(matrix).all() or np.linalg.cond(matrix) > _FLAT:
        raise InputError(f"{name}: the matrix of its WCS is singular: pixels have no area")


def _of_image(path):
    first = None
    with path.open("rb") as file, open_fits(file, "the file") as hdulist:
        for hdu in hdulist:
            if hdu.is_image:
                wcs = image_wcs(hdu.header, hdulist)
                if wcs.naxis == 2 == len(plane_shape(hdu)) and wcs.has_celestial:
                    return wcs
                first = first or wcs
    return first


def _of_text(path):
    headers = headers_of(read_text(path))
    if not headers or "CTYPE1" not in headers[0]:
        raise InputError("it is not FITS, and as the text of a header it has no CTYPE1")
    return WCS(headers[0])
