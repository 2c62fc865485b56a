"""The co-added image and its file."""

from __future__ import annotations

import bz2
import gzip
import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING

import asdf
import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.nddata import CCDData, VarianceUncertainty
from astropy.wcs import WCS

from ..exceptions import InputError
from ..inputs.frames.value_units import value_unit
from ..plots.stack_plots import plot_mosaic
from ..runtime.fits_bytes import BLOCK, sum32, with_checksum
from ..runtime.notebook import ShownAsPrinted
from ..runtime.outputs import replacing
from ..runtime.scratch import forget
from ..runtime.words import PLANES, USUAL_PLANES
from .combination import PixelFlag

if TYPE_CHECKING:
    from astropy.io.fits import HDUList
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from ..runtime.annotations import StrPath

_ENDING = re.compile(r"\.(?:(?P<asdf>asdf)|(?:fits|fit|fts)(?P<packed>\.gz|\.bz2)?)$", re.IGNORECASE)
_PACKERS = {".gz": gzip.open, ".bz2": bz2.open}
_ROWS = 256  # that are written at a time: a multiple of 4, for the checksums


@dataclass(frozen=True, eq=False, repr=False)
class Mosaic(ShownAsPrinted):
    """Co-added image.

    The planes that `legdistort.coadd` makes are arrays on disk, in a folder for temporary files; only what is worked on
    comes into memory. Processes forked from this one share them: what one changes, all see.

    Attributes
    ----------
    data : ndarray of float32, shape (ny, nx)
        In the unit of the exposures, at their mean exposure time; NaN where nothing contributes.
    variance : ndarray of float32, shape (ny, nx)
        Of each pixel by itself, with the photons of stars if there are uncertainty planes or gains. Interpolation
        correlates neighbours: the variance of a sum over many pixels is larger than the sum of theirs (about 1.3 times
        at order 3, 2.2 times at order 1).
    weight : ndarray of float32, shape (ny, nx)
        Sum of the weights of the exposures that contribute.
    footprint : ndarray of int, shape (ny, nx)
        Number of exposures that contribute to each pixel.
    flags : ndarray of uint8, shape (ny, nx)
        Bits: 1 = the distortion of an exposure that contributes is extrapolated, 2 = saturated in all exposures and
        used for want of better, 4 = an exposure was rejected (`legdistort.coaddition.combination.PixelFlag`).
    context : ndarray of uint32, shape (n, ny, nx)
        The exposures that contribute: bit i % 32 of plane i // 32 is set where ``exposures[i]`` contributes.
    wcs : `~astropy.wcs.WCS`
        TAN if the sky is known, else linear with the reference plane (0-based) as world; or the WCS asked for.
    exposures : tuple of str
        Names of the exposures used; of a camera those of the images of its detectors.
    left_out : dict
        Names of the others, with the reason.
    offset : tuple of int or None
        ``(ox, oy)``: the centre of pixel (x, y) is the point (x + ox, y + oy) of the reference plane. None = the
        mosaic has another grid.
    header : `~astropy.io.fits.Header`
        Unit, exposure times, method and what else goes into the file besides the WCS.
    extrapolated, rejected : ndarray of uint8, shape (ny, nx), or None
        Share of the exposures to which the flags 1 and 4 apply: per cent of those that contribute, and of all that are
        there, rounded up.
    planes : tuple of str
        What `write` puts beside the image, see `to_hdulist`.

    See Also
    --------
    legdistort.coadd : Makes one.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=4, seed=1)
    >>> exposures = ld.read_exposures(list(night.hdus.values()))
    >>> solution = ld.solve(ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures))
    >>> mosaic = ld.coadd(exposures, solution)
    >>> mosaic.contributors(300, 300)
    ('exp00', 'exp01', 'exp02', 'exp03')
    >>> mosaic.write("mosaic.fits").name
    'mosaic.fits'
    """

    data: np.ndarray
    variance: np.ndarray
    weight: np.ndarray
    footprint: np.ndarray
    flags: np.ndarray
    context: np.ndarray
    wcs: WCS
    exposures: tuple[str, ...]
    left_out: dict[str, str] = field(default_factory=dict)
    offset: tuple[int, int] | None = None
    header: fits.Header = field(default_factory=fits.Header)
    extrapolated: np.ndarray | None = None
    rejected: np.ndarray | None = None
    planes: tuple[str, ...] = USUAL_PLANES

    @property
    def mask(self) -> np.ndarray:
        """Where there is no value, or only saturated ones: ndarray of bool, True = bad, as astropy has it."""
        found = np.empty(self.shape, dtype=bool)
        for start in range(0, len(found), _ROWS):  # the planes may be larger than the memory
            rows = slice(start, start + _ROWS)
            found[rows] = ~np.isfinite(self.data[rows]) | ((self.flags[rows] & PixelFlag.SATURATED) > 0)
            forget(self.data)
            forget(self.flags)
        return found

    def to_ccddata(self) -> CCDData:
        """The mosaic as a `~astropy.nddata.CCDData`: unit, variance, `mask`, WCS, header.

        Its arrays are those of the mosaic, not copies. Without a unit (``BUNIT``) that is understood it is
        dimensionless.
        """
        unit = value_unit(self.header).unit or u.dimensionless_unscaled
        uncertainty = VarianceUncertainty(self.variance, copy=False)
        return CCDData(
            self.data, unit=unit, uncertainty=uncertainty, mask=self.mask, wcs=self.wcs, meta=self.header.copy()
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Image shape ``(ny, nx)``."""
        return self.data.shape

    @property
    def n_exposures(self) -> int:
        """Number of exposures, each counted once where several detectors share it."""
        return self.header.get("NEXPOSUR", len(self.exposures))

    def __repr__(self) -> str:
        ny, nx = self.shape
        n_images = len(self.exposures)
        images = f", {n_images} images of their detectors" if n_images != self.n_exposures else ""
        left_out = f", {len(self.left_out)} left out" if self.left_out else ""
        return f"<Mosaic: {nx} x {ny} px, {self.n_exposures} exposures{images}{left_out}>"

    def plot(self, *, stars: ArrayLike | None = None, ax: Axes | None = None) -> Axes:
        """The image less its smooth sky, see `legdistort.plots.stack_plots.plot_mosaic`.

        Parameters
        ----------
        stars : array_like, shape (n, 2), optional
            Positions to be circled, pixels of the mosaic.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; WCSAxes too (``projection=mosaic.wcs``, or that of another image).

        Returns
        -------
        `~matplotlib.axes.Axes`

        Raises
        ------
        InputError
            If no pixel has data, or WCSAxes and mosaic have no sky in common.
        """
        return plot_mosaic(self, stars=stars, ax=ax)

    def contributors(self, x: int, y: int) -> tuple[str, ...]:
        """Names of the exposures that contribute to pixel (x, y) of the mosaic, 0-based.

        Raises
        ------
        InputError
            If the mosaic has no such pixel, or x or y is not a whole number.
        """
        ny, nx = self.shape
        if not (x % 1 == 0 and y % 1 == 0):
            raise InputError(f"pixels are given by whole numbers, got ({x}, {y}): round them, centres are at integers")
        if not (0 <= x < nx and 0 <= y < ny):
            raise InputError(f"pixel ({x}, {y}) is not one of the {nx} x {ny} of the mosaic (x, y from 0)")
        planes = self.context[:, int(y), int(x)]
        return tuple(name for i, name in enumerate(self.exposures) if planes[i // 32] >> np.uint32(i % 32) & 1)

    def to_hdulist(self) -> HDUList:
        """The FITS file: image (primary HDU, ``SCI``), ``UNCERT``, ``MASK``, ``FOOTPRINT``, or what `planes` names.

        There are ``WEIGHT``, ``FLAGS``, ``EXTRAPOLATED``, ``REJECTED`` and ``CONTEXT`` besides. Each has the WCS.
        ``UNCERT`` is the standard deviation, the root of `variance`, here a new array in memory. ``CCDData.read`` finds
        it and the mask. ``CONTEXT`` has a third axis where there are more than 32 exposures; a bit counts them in the
        order of the keywords ``IMCMB001``, ``IMCMB002``, ...
        """
        hdulist = self._hdulist()
        if "UNCERT" in hdulist:
            hdulist["UNCERT"].data = np.sqrt(self.variance)
        return hdulist

    def _hdulist(self):
        """That of `to_hdulist`, but with the variance in the place of its root, which is taken as it is written."""
        header = self.header.copy()
        cards = self.wcs.to_header(relax=True)
        for key in [key for key in cards if key.startswith(("DATE-", "MJD-"))]:  # of the file that gave the grid
            del cards[key]
        header.update(cards)
        if self.offset is not None:  # IRAF's logical = LTM physical + LTV, 1-based: physical is the reference plane
            for axis, shift in enumerate(self.offset, start=1):
                header[f"LTM{axis}_{axis}"] = (1.0, "reference-plane pixels are mosaic pixels")
                header[f"LTV{axis}"] = (-float(shift), "reference plane + LTV = mosaic pixel")
        context = self.context.view(np.int32)  # the sign is the last bit, as drizzled images have it
        planes = {
            "SCI": self.data,
            "UNCERT": self.variance,
            "MASK": self.mask.view(np.uint8) if "MASK" in self.planes else None,
            "WEIGHT": self.weight,
            "FOOTPRINT": self.footprint,
            "FLAGS": self.flags,
            "EXTRAPOLATED": self.extrapolated,
            "REJECTED": self.rejected,
            "CONTEXT": context[0] if len(context) == 1 else context,
        }
        hdulist = fits.HDUList()
        for name, plane in planes.items():
            if plane is None or name not in ("SCI", *self.planes):
                continue
            hdu = (fits.ImageHDU if hdulist else fits.PrimaryHDU)(plane, header)
            hdu.name = name
            hdulist.append(hdu)
        if "UNCERT" in hdulist:
            hdulist["UNCERT"].header["UTYPE"] = ("StdDevUncertainty", "class of astropy.nddata")
        for name, meaning in (
            ("MASK", "1: no value, or saturated"),
            ("WEIGHT", "sum of weights"),
            ("FOOTPRINT", "number of exposures"),
            ("FLAGS", "bits: 1 extrapolated, 2 saturated, 4 rejected"),
            ("EXTRAPOLATED", "per cent of exposures that contribute"),
            ("REJECTED", "per cent of exposures"),
            ("CONTEXT", "bits: exposures IMCMBnnn"),
        ):
            if name in hdulist:
                hdulist[name].header["BUNIT"] = ("", meaning)
        return hdulist

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write the mosaic as a FITS file (see `to_hdulist`), or as ASDF; returns the path.

        The file appears under its name only when it is complete.

        Parameters
        ----------
        path : str or path
            Ending in ``.fits``, ``.fit`` or ``.fts``, with ``.gz`` or ``.bz2`` behind for a compressed file. With
            ``.asdf`` it is an ASDF file: the planes, ``wcs``, ``exposures``, ``left_out``, ``offset`` and ``header``
            under ``mosaic``, to be opened with asdf and asdf-astropy alone. Capitals do not matter.
        overwrite : bool
            Replace a file that exists.

        Raises
        ------
        InputError
            For another ending; if the file exists and `overwrite` is false, or its folder does not exist.
        """
        ending = check_ending(path)
        with replacing(path, overwrite=overwrite) as file:
            if ending["asdf"]:
                asdf.AsdfFile({"mosaic": self._tree()}).write_to(file)
            elif ending["packed"]:
                with _PACKERS[ending["packed"].lower()](file, "wb") as packer:
                    self._append_to(packer)
            else:
                self._append_to(file)
        return Path(path)

    def _append_to(self, file):
        for hdu in self._hdulist():
            _append(file, hdu, np.sqrt if hdu.name == "UNCERT" else None)

    def _tree(self):
        dropped = {"planes"} | {PLANES[name] for name in PLANES if name not in self.planes}
        tree = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in dropped}
        tree["exposures"], tree["offset"] = list(self.exposures), self.offset and list(self.offset)
        return tree | {"header": {k: v for k, v in self.header.items() if k not in ("HISTORY", "COMMENT", "")}}


def check_ending(path):
    """The parts of a name that a mosaic may have.

    Returns
    -------
    re.Match
        Its groups ``asdf`` and ``packed`` are None where the name does not ask for them.

    Raises
    ------
    InputError
        For a name that ends otherwise.
    """
    ending = _ENDING.search(Path(path).name)
    if ending is None:
        raise InputError(
            f"{path}: the ending selects the format of a mosaic; give .fits, .fit or .fts, also with .gz or .bz2 "
            "behind, or .asdf"
        )
    return ending


def _append(file, hdu, function):
    """Add an HDU with its checksums to a FITS file, a few rows at a time: astropy would turn all of it in memory.

    Its data are what a function makes of those of `hdu`, unless it is None. ``StreamingHDU``, which takes rows too,
    closes the file after each.
    """
    header, size, datasum = hdu.header.copy(), 0, 0
    for content in _pieces(hdu.data, function):
        size, datasum = size + len(content), sum32(content + bytes(-len(content) % 4), datasum)
    header["CHECKSUM"], header["DATASUM"] = ("0" * 16, "of the HDU"), (str(datasum), "of its data")
    file.write(with_checksum(header.tostring().encode("ascii"), datasum))
    for content in _pieces(hdu.data, function):
        file.write(content)
    file.write(bytes(-size % BLOCK))


def _pieces(plane, function):
    """The bytes of a plane as FITS has them, a few rows at a time; but for the last of them whole words of 32 bits."""
    rows = plane.reshape(-1, plane.shape[-1])
    for start in range(0, len(rows), _ROWS):
        part = rows[start : start + _ROWS]
        yield (part if function is None else function(part)).astype(rows.dtype.newbyteorder(">")).tobytes()
        forget(rows)
