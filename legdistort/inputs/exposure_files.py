"""Exposures that stay in their files until their pixels are asked for."""

from dataclasses import dataclass, fields
from pathlib import Path

from astropy.io import fits
from astropy.wcs import WCS

from ..exceptions import InputError
from .exposures import Exposure, each_exposure, read_exposures


@dataclass(frozen=True, eq=False, repr=False)
class ExposureFile:
    """What is known about an image whose pixels are in its file.

    Attributes
    ----------
    name, wcs, header, saturation, gain, read_noise, exposure_time, path
        As those of the `Exposure`.
    shape : tuple
        ``(ny, nx)``.
    ext : int, str, (str, int) or None
        The extension asked for.
    """

    name: str
    shape: tuple
    wcs: WCS | None
    header: fits.Header
    saturation: float | None
    gain: float | None
    read_noise: float | None
    exposure_time: float | None
    path: Path
    ext: object = None

    def read(self):
        """The `Exposure` with its pixels.

        Raises
        ------
        InputError
            If the file is gone, or has become another one.
        """
        (exposure,) = read_exposures(self.path, ext=self.ext)
        if exposure.shape != self.shape:
            raise InputError(f"{self.path} has changed: its image had shape {self.shape}, now {exposure.shape}")
        return exposure

    def __repr__(self):
        ny, nx = self.shape
        return f"<ExposureFile {self.name!r}: {nx} x {ny} px in {self.path}>"


def open_exposures(paths, *, ext=None, progress=False):
    """Exposures for work on more images than the memory holds.

    Every file is read once, so that it is known to be sound, and read again when its pixels are needed; what is in
    memory already (HDULists, CCDData) becomes an ordinary exposure. `legdistort.measure`, `match` and `coadd` take
    both.

    Parameters
    ----------
    paths, ext, progress
        As for `legdistort.read_exposures`; the names are the same.

    Returns
    -------
    list of `ExposureFile` or `Exposure`

    Raises
    ------
    InputError
        As `legdistort.read_exposures` does.
    """
    known = [field.name for field in fields(ExposureFile) if field.name != "ext"]
    return [
        ExposureFile(**{name: getattr(exposure, name) for name in known}, ext=ext) if _is_path(source) else exposure
        for source, exposure in each_exposure(paths, ext, progress=progress)
    ]


def _is_path(source):
    return isinstance(source, (str, Path))


def listed(exposures, function):
    """One exposure or several as a list; `InputError` for what is none, naming the function that was called."""
    exposures = [exposures] if isinstance(exposures, (Exposure, ExposureFile)) else list(exposures)
    for exposure in exposures:
        if not isinstance(exposure, (Exposure, ExposureFile)):
            raise InputError(f"{function} takes exposures as read_exposures gives them, got {type(exposure).__name__}")
    return exposures
