"""The effective point-spread function of an exposure: light that a pixel receives, by its place from the star."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.io import fits
from astropy.nddata import NDData
from scipy.interpolate import RectBivariateSpline

from ...exceptions import InputError
from ...runtime import outputs
from ...runtime.fits_bytes import open_fits
from ...runtime.guards.units import plain_numbers
from ...runtime.notebook import ShownAsPrinted
from . import splines

if TYPE_CHECKING:
    from astropy.io.fits import HDUList
    from numpy.typing import ArrayLike
    from photutils.psf import GriddedPSFModel

    from ...runtime.annotations import StrPath

#: Extension of files that holds the coefficients.
EXTENSION = "EPSF"
_RESIDUAL = "RESIDUAL"

_SAMPLES = 4  # of images a pixel: the format STDPSF knows no other
_NODES = 8  # places along x and along y from which centres are interpolated
_LIKENESS = 7  # places along x and along y for images of a PSF that is quadratic over the field
_WINDOW = 4.0  # standard deviations of the Gaussian window of the core that make a FWHM
_FINE = 4  # places between two knots in sums over the grid
_REACH = 12  # places from the centre to the end of the window of the core, at 1.5 FWHM


@dataclass(frozen=True)
class Polynomial:
    """How a PSF varies over the field: coefficients times powers of the place.

    Attributes
    ----------
    degree : int
        Total.
    zero, scale : tuple of float
        The place (x, y) is (xy - zero) / scale [pix].
    """

    degree: int = 0
    zero: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)

    @property
    def powers(self) -> list[tuple[int, int]]:
        """Powers (i, j) of x and y of every term, those of x first: the order of PSFEx."""
        return [(i, j) for j in range(self.degree + 1) for i in range(self.degree + 1 - j)]

    def __call__(self, xy: ArrayLike) -> np.ndarray:
        """Terms (n, n_terms) at some places (n, 2)."""
        u, v = ((np.asarray(xy, dtype=float) - self.zero) / self.scale).T
        return np.stack([u**i * v**j for i, j in self.powers], axis=1)

    def __str__(self) -> str:
        return ("constant", "linear", "quadratic", "cubic")[self.degree] if self.degree < 4 else f"degree {self.degree}"


@dataclass(frozen=True)
class Grid:
    """How a PSF varies over the field: bilinear between those at some places, constant beyond.

    Attributes
    ----------
    x, y : tuple of float
        Increasing [pix]; the PSFs follow each other along x, then y.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]

    def __call__(self, xy: ArrayLike) -> np.ndarray:
        """Terms (n, n_terms) at some places (n, 2)."""
        hats = []
        for places, at in zip((self.x, self.y), np.asarray(xy, dtype=float).T, strict=True):
            hats.append(np.stack([np.interp(at, places, row) for row in np.eye(len(places))], axis=1))
        return (hats[1][:, :, None] * hats[0][:, None, :]).reshape(len(xy), -1)

    def __str__(self) -> str:
        return f"a grid of {len(self.x)} x {len(self.y)}"


@plain_numbers
@dataclass(frozen=True, eq=False, repr=False)
class EffectivePSF(ShownAsPrinted):
    """The effective point-spread function of an exposure (Anderson & King 2000, PASP 112, 1360).

    It holds the part of the light of a star that falls into a pixel, by the offset of the pixel's centre from the
    star: optics, atmosphere and pixel in one. A cubic spline carries it.

    Attributes
    ----------
    coefficients : ndarray, shape (n_terms, ny, nx)
        Spline coefficients, for every term of the field.
    spacing : float
        Of the knots [pix].
    variation : Polynomial or Grid
        How it varies over the detector.
    shape : tuple or None
        ``(ny, nx)`` of the detector, if known.
    exposure : str or None
        Whose it is.
    n_stars : int or None
        Stars that it was made from; None if it came from elsewhere.
    source : str
        "effective", or where it came from: the entry in the column ``psf`` of detections.
    residual : ndarray, shape (k, k), or None
        Residuals of the stars that made it, on the pixels around them: the weighted mean, in parts of their light.
    halo : float
        Part of the light of its stars that their local skies contain, on each pixel: wide halos are taken for sky.
    fwhm : float
        Full width at half maximum at the centre of the field, of a circle of the area above half maximum [pix].

    See Also
    --------
    legdistort.effective_psf : Make one from the stars of an exposure.
    legdistort.measure : Measure stars with it, ``psf=``.

    Examples
    --------
    >>> import numpy as np
    >>> import legdistort as ld
    >>> y, x = np.mgrid[-40:41, -40:41] / 4  # four samples a pixel
    >>> psf = ld.EffectivePSF.from_array(np.exp(-(x**2 + y**2) / 2 / 1.5**2), oversampling=4)
    >>> round(psf.fwhm, 1)
    3.5
    """

    coefficients: np.ndarray
    spacing: float
    variation: Polynomial | Grid = Polynomial()
    shape: tuple[int, int] | None = None
    exposure: str | None = None
    n_stars: int | None = None
    source: str = "effective"
    residual: np.ndarray | None = None
    halo: float = 0.0
    fwhm: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", np.asarray(self.coefficients, dtype=float))
        object.__setattr__(self, "fwhm", width(self.grids(self.middle)[0], self.spacing))

    @property
    def middle(self) -> np.ndarray:
        """Centre of the field, (1, 2) [pix]."""
        if self.shape is not None:
            return np.array([[self.shape[1] - 1, self.shape[0] - 1]]) / 2
        if isinstance(self.variation, Grid):
            return np.array([[np.mean(self.variation.x), np.mean(self.variation.y)]])
        return np.array([self.variation.zero], dtype=float)

    def grids(self, xy: ArrayLike) -> np.ndarray:
        """Spline coefficients at some places; (n, ny, nx), or (1, ny, nx) if the PSF does not vary.

        Parameters
        ----------
        xy : ndarray, shape (n, 2)
            On the detector [pix].
        """
        if len(self.coefficients) == 1:
            return self.coefficients
        return np.tensordot(self.variation(xy), self.coefficients, 1)

    def __call__(self, dx: ArrayLike, dy: ArrayLike, *, at: tuple[float, float]) -> np.ndarray:
        """Part of the light of a star that a pixel receives.

        Parameters
        ----------
        dx, dy : array_like
            Offsets of the pixel's centre from the star [pix], of one shape.
        at : tuple
            Where the star stands, (x, y) [pix].

        Returns
        -------
        ndarray
            Of the shape of the offsets.
        """
        grid = self.grids(np.array([at], dtype=float))[0]
        dx, dy = np.broadcast_arrays(np.asarray(dx, dtype=float), np.asarray(dy, dtype=float))
        x, y = (splines.basis(d.ravel(), n, self.spacing) for d, n in ((dx, grid.shape[1]), (dy, grid.shape[0])))
        return ((y @ grid) * x).sum(axis=1).reshape(dx.shape)

    @plain_numbers
    def centre(self, xy: ArrayLike) -> np.ndarray:
        """Core-weighted centre, from where the grid has its middle, at some places; (n, 2) [pix]."""
        xy = np.asarray(xy, dtype=float)
        if len(xy) < 2 * _NODES**2 or not isinstance(self.variation, Polynomial):
            return np.broadcast_to(core_centres(self.grids(xy), self.spacing, self.fwhm), (len(xy), 2))
        ends = zip(xy.min(axis=0) - 1, xy.max(axis=0) + 1, strict=True)
        x, y = (np.linspace(*end, _NODES) for end in ends)
        there = self.centre(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(_NODES, _NODES, 2)
        return np.stack([RectBivariateSpline(x, y, there[..., i].T).ev(*xy.T) for i in (0, 1)], axis=1)

    @property
    def reach(self) -> float:
        """How far from the star there is light [pix]."""
        return int(self.spacing * (max(self.coefficients.shape[1:]) - 1) / 2)

    def on_stamps(self, centres: np.ndarray, offsets: np.ndarray, half: int) -> np.ndarray:
        """Parts of the light of stars on square stamps around pixels, the halo too, (n, npix), rows (y) first.

        Parameters
        ----------
        centres : ndarray of int, shape (n, 2)
            Central pixels (x, y) of the stamps.
        offsets : ndarray, shape (n, 2)
            Of the core-weighted centres of the stars from them [pix].
        half : int
            Stamps reach from -half to half.
        """
        xy = centres + offsets
        light = splines.on_stamps(self.grids(xy), offsets - self.centre(xy), half, self.spacing)
        if not self.halo:
            return light
        v, u = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, 1, -1)
        r = np.hypot(u - offsets[:, :1], v - offsets[:, 1:])
        return light + self.halo * np.cos(np.pi / 2 * np.clip(2 * r / self.reach - 1, 0, 1)) ** 2

    def light(
        self, params: np.ndarray, centres: np.ndarray, half: int, *, slopes: bool = False
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """Light of stars on square stamps around pixels, without the halo; (n, npix), rows (y) first.

        Parameters
        ----------
        params : ndarray, shape (n, 3)
            x, y of the middle of the grid, from the central pixels of the stamps, flux. Their kind is that of the
            results.
        centres : ndarray of int, shape (n, 2)
            Central pixels (x, y).
        half : int
            Stamps reach from -half to half.
        slopes : bool
            Whether to give the derivatives by x, y and flux too, (n, 3, npix).
        """
        flux, grids = params[:, 2:3], self.grids(centres + params[:, :2])
        if not slopes:
            return flux * splines.on_stamps(grids, params[:, :2], half, self.spacing)
        value, by_x, by_y = splines.on_stamps(grids, params[:, :2], half, self.spacing, slopes=True)
        return flux * value, np.stack([flux * by_x, flux * by_y, value], axis=1)

    @classmethod
    @plain_numbers
    def from_array(
        cls, data: ArrayLike, *, oversampling: float, positions: ArrayLike | None = None, source: str = "array"
    ) -> EffectivePSF:
        """A PSF from oversampled images, as photutils has them.

        Parameters
        ----------
        data : array_like, shape (ny, nx) or (n, ny, nx)
            The part of a star's light that falls into a pixel, the star in the middle of the array: sums are the square
            of the oversampling, or less where the array ends within the light. Images of infinitely small pixels must
            be averaged over a pixel first.
        oversampling : int or float
            Samples a pixel.
        positions : array_like, shape (n, 2), optional
            Where on the detector they hold, x and y [pix]: all corners of a rectangular grid, in any order.
        source : str
            The entry for the column ``psf`` of detections.

        Returns
        -------
        EffectivePSF

        Raises
        ------
        InputError
            For arrays that hold no PSF, and positions that are no grid.
        """
        data = np.asarray(data, dtype=float)
        data = data[None] if data.ndim == 2 else data
        if data.ndim != 3 or min(data.shape) < 1 or min(data.shape[1:]) < 5:
            raise InputError(f"{source}: a PSF is an array (ny, nx) or (n, ny, nx), 5 x 5 or more, got {data.shape}")
        if not np.isfinite(data).all():
            raise InputError(f"{source}: the PSF has {np.count_nonzero(~np.isfinite(data))} values that are not finite")
        if not (isinstance(oversampling, Real) and 0.2 <= oversampling <= 100):
            raise InputError(f"{source}: oversampling must be a number of samples a pixel, got {oversampling!r}")
        variation, order = _grid_of(positions, len(data), source)
        return cls(splines.coefficients(data[order]), 1 / oversampling, variation, source=source)

    @plain_numbers
    def images(self, xy: ArrayLike, *, half: float | None = None, oversampling: int = 4) -> np.ndarray:
        """Oversampled images at some places, (n, k, k); the star is in the middle.

        Parameters
        ----------
        xy : array_like, shape (n, 2)
            On the detector [pix].
        half : float, optional
            Where they end [pix]; by default where the grid ends.
        oversampling : int
            Samples a pixel.
        """
        grids = self.grids(np.asarray(xy, dtype=float))
        reach = self.spacing * (np.array(grids.shape[1:]) - 1) / 2 if half is None else (half, half)
        ends = [int(r * oversampling) for r in reach]
        y, x = (
            splines.basis(np.arange(-m, m + 1) / oversampling, n, self.spacing)
            for m, n in zip(ends, grids.shape[1:], strict=True)
        )
        return np.broadcast_to(y @ grids @ x.T, (len(xy), len(y), len(x)))

    def _sampled(self):
        """Images with oversampling `_SAMPLES` at places that show how the PSF varies; those in x and y [pix]."""
        if isinstance(self.variation, Grid):
            x, y = self.variation.x, self.variation.y
        elif self.variation.degree == 0:
            x, y = ((float(c),) for c in self.middle[0])
        else:
            size = 2 * self.middle[0] + 1 if self.shape is not None else 2 * np.array(self.variation.scale)
            # of a polynomial beyond the first degree the linear interpolation between the images is a good likeness
            n = 2 if self.variation.degree == 1 else _LIKENESS
            x, y = (np.linspace(c - s / 2, c + s / 2, n) for c, s in zip(self.middle[0], size, strict=True))
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return self.images(places, oversampling=_SAMPLES), x, y

    def to_photutils(self) -> GriddedPSFModel:
        """The same as ``GriddedPSFModel`` of photutils: images on a grid of places, linear in between."""
        from photutils.psf import GriddedPSFModel

        images, x, y = self._sampled()
        places = [(float(a), float(b)) for b in y for a in x]
        return GriddedPSFModel(NDData(images.copy(), meta={"grid_xypos": places, "oversampling": _SAMPLES}))

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write a FITS file; returns the path.

        The primary array holds oversampled images in the format STDPSF, which ``GriddedPSFModel.read`` of photutils
        takes; the extension ``EPSF`` the coefficients, from which `EffectivePSF.read` makes the same object again.

        Parameters
        ----------
        path : str or path
        overwrite : bool
            Replace a file that exists.
        """
        images, x, y = self._sampled()
        primary = fits.PrimaryHDU(images.astype(np.float32))
        primary.header["NXPSFS"], primary.header["NYPSFS"] = len(x), len(y)
        for key, places in (("IPSFX", x), ("JPSFY", y)):
            for k, place in enumerate(places, start=1):
                primary.header[f"{key}{k:02d}"] = (float(place) + 1, "place on the detector, from 1")
        primary.header["OVERSAMP"] = (_SAMPLES, "samples a pixel")
        exact = fits.ImageHDU(self.coefficients, name=EXTENSION)
        exact.header["SPACING"] = (self.spacing, "of the knots [pix]")
        exact.header["FWHM"] = (self.fwhm, "[pix]")
        exact.header["SOURCE"], exact.header["HALO"] = self.source, self.halo
        if self.exposure is not None:
            exact.header["EXPOSURE"] = self.exposure
        if self.n_stars is not None:
            exact.header["NSTARS"] = (self.n_stars, "that it was made from")
        if self.shape is not None:
            exact.header["DETNY"], exact.header["DETNX"] = self.shape
        if isinstance(self.variation, Polynomial):
            exact.header["DEGREE"] = (self.variation.degree, "of the polynomial in (xy - ZERO) / SCALE")
            for axis, zero, scale in zip("XY", self.variation.zero, self.variation.scale, strict=True):
                exact.header[f"ZERO{axis}"], exact.header[f"SCALE{axis}"] = zero, scale
        left = [] if self.residual is None else [fits.ImageHDU(self.residual, name=_RESIDUAL)]
        with outputs.replacing(path, overwrite=overwrite) as file:
            fits.HDUList([primary, exact, *left]).writeto(file)
        return Path(path)

    @classmethod
    def read(cls, path: StrPath) -> EffectivePSF:
        """A PSF that `write` has written.

        Raises
        ------
        InputError
            If the file is none.
        """
        try:
            with open(path, "rb") as file, open_fits(file, path) as hdus:
                return cls.from_hdus(hdus, path)
        except OSError as error:
            raise InputError(f"{path}: no FITS file that could be read ({error})") from None

    @classmethod
    def from_hdus(cls, hdus: HDUList, path: StrPath) -> EffectivePSF:
        """The same from an open file; `path` is for the messages."""
        if EXTENSION not in [hdu.name for hdu in hdus]:
            raise InputError(f"{path}: no extension {EXTENSION}, as EffectivePSF.write makes it: give it as psf=")
        header, first = hdus[EXTENSION].header, hdus[0].header
        try:
            if "DEGREE" in header:
                zero, scale = (tuple(float(header[key + axis]) for axis in "XY") for key in ("ZERO", "SCALE"))
                variation = Polynomial(int(header["DEGREE"]), zero, scale)
            else:
                sizes = {"IPSFX": first["NXPSFS"], "JPSFY": first["NYPSFS"]}
                variation = Grid(*(tuple(first[f"{k}{i:02d}"] - 1 for i in range(1, n + 1)) for k, n in sizes.items()))
            shape = (header["DETNY"], header["DETNX"]) if "DETNY" in header else None
            known = {"exposure": header.get("EXPOSURE"), "n_stars": header.get("NSTARS"), "source": header["SOURCE"]}
            known["halo"] = float(header.get("HALO", 0.0))
            if _RESIDUAL in [hdu.name for hdu in hdus]:
                known["residual"] = np.asarray(hdus[_RESIDUAL].data, dtype=float)
            coefficients = np.asarray(hdus[EXTENSION].data, dtype=float)
            return cls(coefficients, float(header["SPACING"]), variation, shape, **known)
        except KeyError as error:
            raise InputError(f"{path}: the extension {EXTENSION} is damaged: {error.args[0]}") from None

    def of_flux(self, factor: float) -> EffectivePSF:
        """The same for fluxes that are larger by a factor: with so much less light for a flux of 1."""
        residual = None if self.residual is None else self.residual / factor
        return replace(self, coefficients=self.coefficients / factor, halo=self.halo / factor, residual=residual)

    def named(self, **changes: Any) -> EffectivePSF:
        """The same with other attributes."""
        return replace(self, **changes)

    def __repr__(self) -> str:
        size = self.spacing * np.array(self.coefficients.shape[:0:-1])
        made = f"from {self.n_stars} stars" if self.n_stars is not None else f"of {self.source}"
        whose = f" {self.exposure!r}" if self.exposure else ""
        return (
            f"<EffectivePSF{whose}: {made}, {self.variation}, FWHM {self.fwhm:.2f} px, "
            f"{size[0]:.0f} x {size[1]:.0f} px, knots {self.spacing:.2f} px apart>"
        )


def _grid_of(positions, n, source):
    """The `Grid` of some positions (n, 2), and the order of their PSFs in it."""
    if positions is None:
        if n != 1:
            raise InputError(f"{source}: {n} PSFs need positions on the detector, ({n}, 2)")
        return Polynomial(), [0]
    positions = np.asarray(positions, dtype=float)
    if positions.shape != (n, 2):
        raise InputError(f"{source}: {n} PSFs need positions ({n}, 2), got {positions.shape}")
    if n == 1:
        return Polynomial(), [0]
    x, y = (np.unique(p) for p in positions.T)
    order = np.lexsort((positions[:, 0], positions[:, 1]))
    full = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    if full.shape != positions.shape or not np.array_equal(full, positions[order]):
        raise InputError(f"{source}: the positions of the PSFs must be all corners of a rectangular grid, each once")
    return Grid(tuple(x.tolist()), tuple(y.tolist())), order


def width(grid, spacing):
    """Full width at half maximum [pix] of an image by its spline coefficients: of a circle of the same area."""
    step = spacing / _FINE
    n = [int((k - 3) * _FINE) // 2 for k in grid.shape]
    y, x = (splines.basis(np.arange(-m, m + 1) * step, k, spacing) for m, k in zip(n, grid.shape, strict=True))
    image = y @ grid @ x.T
    top = image.max()
    if not top > 0:
        raise InputError("a PSF must have a positive peak")
    # pixels near the level count in part: the width must not jump
    slope = np.hypot(*np.gradient(image)) + 1e-12 * top
    part = np.clip(0.5 + (image - top / 2) / slope, 0, 1)
    return float(2 * step * np.sqrt(part.sum() / np.pi))


def moments(n, spacing, fwhm):
    """Sums over a spline's knots along one axis: all light, light in the core, and its first moment; (3, n).

    The core is what a Gaussian of the given width lets through.
    """
    step = spacing / _FINE
    reach = int(np.ceil((n + 3) * _FINE / 2))
    u = np.arange(-reach, reach + 1) * step
    window = np.exp(-((_WINDOW * u / fwhm) ** 2) / 2)
    return np.stack([np.ones_like(u), window, u * window]) @ splines.basis(u, n, spacing) * step


def core_centres(grids, spacing, fwhm):
    """Places (n, 2) where first moments under a Gaussian window of the width of the core vanish [pix]."""
    out = np.zeros((len(grids), 2))
    ny, nx = grids.shape[1:]
    u = np.arange(-_REACH, _REACH + 1) * (1.5 * fwhm / _REACH)
    window = np.exp(-((_WINDOW * u / fwhm) ** 2) / 2)
    for _ in range(20):
        x, y = (splines.basis(u + out[:, i, None], n, spacing) for i, n in ((0, nx), (1, ny)))
        core = y @ grids @ x.swapaxes(1, 2) * window[:, None] * window
        total = core.sum(axis=(1, 2))
        shift = 2 * np.stack([(core.sum(axis=1) * u).sum(axis=1), (core.sum(axis=2) * u).sum(axis=1)], 1)
        shift /= total[:, None]
        out += shift
        if np.abs(shift).max() < 1e-7:
            break
    return out
